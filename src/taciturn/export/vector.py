"""Recorded measurements, losses, decisions and inputs of a loop, for bit-exact comparison with exported nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._modes import factor
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.network import REFERENCE
from taciturn.model.places import inputs_at, outputs_at, roles, set_points_at
from taciturn.model.policy import Policy, Received, Send
from taciturn.program import machine
from taciturn.program import numpy as interpreter
from taciturn.program.ir import Program
from taciturn.program.names import Entry, Name, Sent, is_entry, named


@dataclass(frozen=True, eq=False, repr=False)
class RecordedRun(Displayed):
    """A recorded run of a closed loop, step by step.

    Args:
        links: links on which packets are sent, in the order of the columns.
        measured: measurements y, (steps, p).
        drawn: uniform random numbers that the policy draws, (steps, draws).
        arrived: 1 if a packet was sent and arrived, otherwise 0, (steps, links).
        sent: 1 if a packet was sent, otherwise 0, (steps, links).
        applied: inputs u that the actuators applied, (steps, m).
        order: outputs and inputs of the plant in the order in which the nodes measure and apply them.
    """

    links: tuple[str, ...]
    measured: Array
    drawn: Array
    arrived: Array
    sent: Array
    applied: Array
    order: tuple[list[int], list[int]]

    @property
    def rows(self) -> Array:
        """All recorded columns with one row per step: inputs of the nodes first, then their expected outputs.

        The measurements and the inputs are in the order of the nodes.
        """
        outputs, inputs = self.order
        return np.hstack([self.measured[:, outputs], self.drawn, self.arrived, self.sent, self.applied[:, inputs]])


def record_loop(loop: Loop, ticks: int, seed: int = 0, drawn: Array | None = None) -> RecordedRun:
    """Run the bit-exact build of a loop's program, and return its measurements, losses, decisions and inputs.

    Args:
        loop: the loop, with the precision of its nodes.
        ticks: number of steps.
        seed: seed of noise, losses and draws.
        drawn: random numbers of the policy, (steps, draws), in place of those from the seed.

    Raises:
        ProblemError: the loop is so unstable that it leaves the range of numbers.
    """
    loop = loop.in_units
    program, plant = loop.open_program(), loop.problem.plant
    generator = np.random.default_rng(seed)
    noise = {"w": factor(plant.W), "v": factor(plant.V)}
    supplied: dict[Name, Array] = {}
    for name, spread in noise.items():
        values = generator.standard_normal((ticks, spread.shape[1])) @ spread.T
        supplied |= {Entry(name, i): column for i, column in enumerate(values.T)}
    inputs = np.array([supplied[name] if name in supplied else generator.random(ticks) for name in program.inputs])
    own = [program.inputs.index(name) for name in drawn_by_the_policy(program)]
    if drawn is not None:
        inputs[own] = drawn.T
    run = machine.Kernel(program, "parity").run if machine.available() else interpreter.run
    outputs = run(program, loop.start(program, 1, seed), ticks, inputs.T[:, :, None]).outputs
    found = {name: values[:, 0] for name, values in outputs.items()}
    measured = [*named("y", range(plant.sensed)), *named(REFERENCE, range(plant.set_points))]
    links: tuple[str, ...] = tuple(step.link for step in loop.policy.steps if isinstance(step, Send))
    vector = RecordedRun(
        links,
        _columns([found[name] for name in measured], ticks),
        _columns([inputs[i] for i in own], ticks),
        _columns([found[Received(link)] for link in links], ticks),
        _columns([found[Sent(link)] for link in links], ticks),
        _columns([found[Entry("applied", i)] for i in range(plant.inputs)], ticks),
        entries_of_nodes(loop.policy),
    )
    finite = np.isfinite(vector.rows).all(axis=1)
    if not finite.all():
        raise ProblemError(
            f"the loop leaves the range of {loop.precision} after {int(finite.argmin())} steps; "
            "expected a policy that stabilises the loop over this network"
        )
    return vector


def entries_of_nodes(policy: Policy) -> tuple[list[int], list[int]]:
    """Return the outputs and the inputs of the plant in the order in which the nodes measure and apply them."""
    names = roles(policy)
    return [i for role in names for i in (*outputs_at(policy, role), *set_points_at(policy, role))], [
        i for role in names for i in inputs_at(policy, role)
    ]


def drawn_by_the_policy(program: Program) -> list[Name]:
    """Return the inputs of ``Loop.open_program`` with the uniform numbers that the policy draws."""
    drawn = [op for name, op in program.outputs.items() if is_entry(name, "drawn")]
    return [program.inputs[program.ops[op].arguments[0]] for op in drawn]


def _columns(columns: list[Array], ticks: int) -> Array:
    return np.array(columns).reshape(len(columns), ticks).T
