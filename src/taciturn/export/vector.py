"""What a closed loop measured, lost, decided and applied: what exported nodes are compared with, bit for bit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import factor
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.policy import ENDS, Draw, LinkName, Send
from taciturn.program import machine
from taciturn.program import numpy as interpreter
from taciturn.program.draws import UNIFORM


@dataclass(frozen=True, eq=False)
class Vector:
    """A run of a closed loop, tick by tick.

    Args:
        links: on which packets are sent, in the order of the columns.
        measured: y, (ticks, p).
        drawn: uniform numbers of the policy's own draws, (ticks, draws).
        arrived: 1 where a packet was sent and came, (ticks, links).
        sent: 1 where a packet was sent, (ticks, links).
        applied: u, (ticks, m).
    """

    links: tuple[LinkName, ...]
    measured: Array
    drawn: Array
    arrived: Array
    sent: Array
    applied: Array

    @property
    def rows(self) -> Array:
        """All of it, a row for each tick: what is given, and then what is expected."""
        return np.hstack([self.measured, self.drawn, self.arrived, self.sent, self.applied])


def record_loop(loop: Loop, ticks: int, seed: int = 0, drawn: Array | None = None) -> Vector:
    """Run a loop by the parity build of its program, whose bits are those of NumPy.

    Args:
        loop: the loop; in single precision where its nodes compute so.
        ticks: to run.
        seed: of noise, losses and draws.
        drawn: the policy's own draws, (ticks, draws), instead of those of the seed.

    Raises:
        ProblemError: the loop is so unstable that it leaves the range of numbers.
    """
    program, plant = loop.open_program(), loop.problem.plant
    generator = np.random.default_rng(seed)
    noise = {"w": factor(plant.W), "v": factor(plant.V)}
    supplied: dict[str, Array] = {}
    for name, spread in noise.items():
        values = generator.standard_normal((ticks, spread.shape[1])) @ spread.T
        supplied |= {f"{name} {i}": column for i, column in enumerate(values.T)}
    inputs = np.array([supplied[name] if name in supplied else generator.random(ticks) for name in program.inputs])
    own = [program.inputs.index(f"{UNIFORM} {i}") for i in drawn_by_the_policy(loop)]
    if drawn is not None:
        inputs[own] = drawn.T
    run = machine.Kernel(program, "parity").run if machine.available() else interpreter.run
    outputs = run(program, loop.start(program, 1, seed), ticks, inputs.T[:, :, None]).outputs
    found = {name: values[:, 0] for name, values in outputs.items()}
    links: tuple[LinkName, ...] = tuple(step.link for step in loop.policy.steps if isinstance(step, Send))
    vector = Vector(
        links,
        _columns([found[f"y {i}"] for i in range(plant.outputs)], ticks),
        _columns([inputs[i] for i in own], ticks),
        _columns([found[f"arrived {link}"] for link in links], ticks),
        _columns([found[f"sent {link}"] for link in links], ticks),
        _columns([found[f"applied {i}"] for i in range(plant.inputs)], ticks),
    )
    finite = np.isfinite(vector.rows).all(axis=1)
    if not finite.all():
        raise ProblemError(
            f"the loop leaves the range of {loop.precision} after {int(finite.argmin())} ticks; "
            "expected a policy that stabilises it over this network"
        )
    return vector


def drawn_by_the_policy(loop: Loop) -> list[int]:
    """Return which uniform numbers of a tick are the policy's own; the rest decide on losses."""
    count, own = sum(loop.network.burst(link) is not None for link in ENDS), list[int]()
    for step in loop.policy.steps:
        if isinstance(step, Draw):
            own.append(count)
            count += 1
        elif isinstance(step, Send) and (loop.network.loss(step.link) > 0 or loop.network.burst(step.link)):
            count += 1
    return own


def _columns(columns: list[Array], ticks: int) -> Array:
    return np.array(columns).reshape(len(columns), ticks).T
