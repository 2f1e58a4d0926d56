"""Translation of a whole policy (all nodes and the links between them) to a program with measurements as inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from taciturn._arrays import Array
from taciturn.model.network import REFERENCE, Network
from taciturn.model.packets import told_by
from taciturn.model.policy import Assign, Policy, Step
from taciturn.model.trigger import Matrix, Scheduled
from taciturn.program.ir import Builder, Program
from taciturn.program.lower import APPLIED, Operands, TimeStep, encode_payloads, first_input, link_state
from taciturn.program.names import named
from taciturn.program.node import NODES
from taciturn.program.ops import Precision

FILTER, REGISTERS, HELD = "prior", ("register", "next register"), "held"  # names of signals of all designs

Begin: TypeAlias = Callable[..., TimeStep]


def lower_policy(policy: Policy, network: Network) -> Program:
    """Return the program of one time step of all nodes of a policy, from the measurement to the plant's input.

    Inputs: the measurement ``y``, and uniform numbers. Outputs: the input ``applied``, within the limits of the model's
    inputs, the nodes' copies of it, and whether a packet is sent and received on each link.

    Args:
        policy: the policy.
        network: the links between its nodes.
    """
    policy = policy.in_units
    NODES.check(policy.parts, policy.designed_for, network)
    plant = policy.model
    tick = begin_time_step(policy, network, {APPLIED: plant.inputs}, {APPLIED: first_input(policy, plant)})
    tick.draw_losses(policy, network)
    measure(tick, policy, [*tick.supplied("y", plant.sensed), *tick.supplied(REFERENCE, plant.outputs - plant.sensed)])
    for step in policy.steps:
        tick.take(step)
    applied = tick.limited(gather_input(tick, policy), plant.saturation, APPLIED)
    copies = {
        name: i for copy in copies_of_inputs(policy) for name, i in named(copy.held, tick.read(copy.held)).items()
    }
    return tick.finish({}, {**named(APPLIED, applied), **copies, **tick.packets()})


@dataclass(frozen=True, eq=False)
class CopiedInput:
    """A signal of a filter or controller into which the copy of an input enters at the end of a step.

    Args:
        signal: the signal.
        held: the copy.
        effect: its matrix.
        inputs: indices of the inputs.
    """

    signal: str
    held: str
    effect: Array
    inputs: tuple[int, ...]


def copies_of_inputs(policy: Policy) -> tuple[CopiedInput, ...]:
    """Return the copies of inputs that filters and given controllers use, apart from models of the actuator."""
    names = {HELD: tuple(range(policy.model.inputs))} | {
        f"{HELD}_{node}": rows for node, rows in policy.applied.values()
    }
    found = list[CopiedInput]()
    for step in (step for step in policy.steps if isinstance(step, Assign) and step.on is None):
        told = step.signal == FILTER or (step.signal in REGISTERS and step.at in policy.site(policy.network.controller))
        for held in (name for name in step.branches[0] if told and name in names):
            effect = step.branches[0][held]
            if isinstance(effect, np.ndarray):
                found.append(CopiedInput(step.signal, held, effect, names[held]))
    return tuple(found)


def measure(tick: TimeStep, policy: Policy, y: Operands) -> None:
    """Set the signals that the nodes measure to the outputs of the plant."""
    for signal, (_, outputs) in policy.measured.items():
        tick.signals[signal] = [y[index] for index in outputs]


def gather_input(tick: TimeStep, policy: Policy) -> Operands:
    """Return the input of the plant, from the signals that the nodes apply."""
    found = {
        index: operand
        for signal, (_, inputs) in policy.applied.items()
        for index, operand in zip(inputs, tick.signals[signal], strict=True)
    }
    return [found[index] for index in range(policy.model.inputs)]


def begin_time_step(
    policy: Policy,
    network: Network,
    sizes: Mapping[str, int],
    initial: Mapping[str, Array | str],
    precision: Precision = "float64",
    begin: Begin = TimeStep,
) -> TimeStep:
    """Return a new time step of all nodes of a policy, before its first policy step is translated.

    ``sizes`` and ``initial`` add further signals; ``begin`` is the class of the time step.
    """
    held = [link_state(link) for link in network.links]
    payloads = encode_payloads(policy, network)
    told = {link: {name: how[name] for name in told_by(policy, link)} for link, how in payloads.items()}
    sizes = {**policy.sizes, **sizes, **dict.fromkeys(held, 1)}
    initial = {**policy.initial, **initial, **{name: name for name in held}}
    return begin(Builder(precision), sizes, initial, policy.locations, told)


def replaced(step: Step, signal: str, by: str, factor: Array) -> Step:
    """Return a policy step with a signal replaced by the product of a matrix and another signal."""
    if not isinstance(step, Assign) or not any(signal in terms for terms in step.branches):
        return step

    def term(name: str, matrix: Matrix) -> tuple[str, Matrix]:
        if name != signal:
            return name, matrix
        return by, Scheduled(matrix.by, matrix.values @ factor) if isinstance(matrix, Scheduled) else matrix @ factor

    return replace(step, branches=tuple(dict(term(*one) for one in terms.items()) for terms in step.branches))


def add_values(tick: TimeStep, values: Operands, more: Operands) -> Operands:
    """Return the sum of two vectors."""
    return [tick.builder.emit("add", value, other) for value, other in zip(values, more, strict=True)]

