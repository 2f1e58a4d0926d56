"""Translation of all nodes and links of a policy to one program, which computes inputs from measurements.

``translate_policy`` walks through the policy steps of all nodes in order. The program reads the measurement and uniform
numbers, and gives the input of the plant, the nodes' copies of it, and whether a packet is sent and arrives on each
link. ``taciturn.loop`` walks through the same steps (``begin_time_step``, ``measure``, ``carry_out``) between its own
of the plant.

A program for real plants is informed of more (``Informed``): which outputs are missing (``program.missing``), which
input was really applied, what becomes of a packet, and which inputs an operator gives (``program.manual``).
``translate_command`` stops at the command of the controller.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from taciturn._arrays import Array
from taciturn.model.expected import sensed_by
from taciturn.model.network import REFERENCE, Network
from taciturn.model.packets import told_by
from taciturn.model.policy import HELD, Policy
from taciturn.model.saturation import Saturation
from taciturn.model.set_points import IN_EFFECT
from taciturn.model.steps import ONE, Assign, Step
from taciturn.model.trigger import Matrix, Scheduled
from taciturn.program.ir import Builder, Program, Truth
from taciturn.program.late import memories
from taciturn.program.manual import OperatedStep, operation_of
from taciturn.program.missing import complete, held_samples, known_of
from taciturn.program.node import NODES, check_pieces
from taciturn.program.ops import Precision, named
from taciturn.program.translation import (
    APPLIED,
    Operands,
    TimeStep,
    encode_payloads,
    first_input,
    link_state,
    sample_state,
)

_FILTER, _REGISTERS = "prior", ("register", "next register")  # names of signals of all designs

Begin: TypeAlias = Callable[..., TimeStep]
_COMMAND, TOLD = "command", "the applied input is known"
ACTING = "acting"  # the inputs that act in each piece of a step, if packets arrive at random times within it


def translate_policy(policy: Policy, network: Network, begin: Begin = TimeStep) -> Program:
    """Translate all nodes of a policy to a program that computes one time step: from measurement to plant input."""
    policy = policy.in_units
    tick = _measured(policy, network, begin)
    carry_out(tick, policy, policy.steps, policy.model.saturation)
    copies = {
        name: i for copy in copies_of_inputs(policy) for name, i in named(copy.held, tick.read(copy.held)).items()
    }
    kept = [name for one in policy.theory.silence.values() for name in (one.total, one.lasted)]
    kept += [IN_EFFECT] if IN_EFFECT in policy.sizes else []
    told = {name: i for signal in kept for name, i in named(signal, tick.read(signal)).items()}
    acting = named(ACTING, tick.signals.get(ACTING, ()))
    found = {**named(APPLIED, tick.signals[APPLIED]), **acting, **copies, **told, **tick.packets(), **tick.delays()}
    return tick.finish({}, found)


def carry_out(tick: TimeStep, policy: Policy, steps: Iterable[Step], limits: Saturation | None) -> None:
    """Translate the policy steps of all nodes after the measurement. Assign the limited plant input to ``APPLIED``."""
    for step in steps:
        tick.take(step)
    found = {
        index: operand
        for signal, (_, inputs) in policy.applied.items()
        for index, operand in zip(inputs, tick.signals[signal], strict=True)
    }
    tick.limited([found[index] for index in range(policy.model.inputs)], limits, APPLIED)
    if tick.pieces:
        _apply_pieces(tick, policy, limits)


def _apply_pieces(tick: TimeStep, policy: Policy, limits: Saturation | None) -> None:
    """Assign to ``ACTING`` the limited inputs of all pieces of the step, one after the other."""
    count, whole, last = max(map(len, tick.pieces.values())), list[int](), tick.signals[APPLIED]
    if count == 1:
        return
    check_pieces(limits)
    for piece in range(count):
        found = dict[int, int]()
        for signal, (_, inputs) in policy.applied.items():
            values = tick.pieces[signal][piece] if signal in tick.pieces else tick.signals[signal]
            found |= dict(zip(inputs, values, strict=True))
        whole += tick.limited([found[index] for index in range(policy.model.inputs)], limits, APPLIED)
    tick.signals[APPLIED], tick.signals[ACTING] = last, whole


@dataclass(frozen=True, eq=False)
class _CopiedInput:
    """A signal of a filter or controller into which the copy of an input enters at the end of a step."""

    signal: str  # the signal
    held: str  # the copy
    effect: Array  # its matrix
    inputs: tuple[int, ...]  # indices of the inputs


def copies_of_inputs(policy: Policy) -> tuple[_CopiedInput, ...]:
    """List the copies of the plant input that filters and given controllers use; copies of actuator models are
    no part.
    """
    names = {HELD: tuple(range(policy.model.inputs))} | {
        f"{HELD}_{node}": rows for node, rows in policy.applied.values()
    }
    found = list[_CopiedInput]()
    for step in (step for step in policy.steps if isinstance(step, Assign) and step.on is None):
        told = step.signal == _FILTER or (
            step.signal in _REGISTERS and step.at in policy.site(policy.network.controller)
        )
        for held in (name for name in step.branches[0] if told and name in names):
            effect = step.branches[0][held]
            if isinstance(effect, np.ndarray):
                found.append(_CopiedInput(step.signal, held, effect, names[held]))
    return tuple(found)


def _measured(policy: Policy, network: Network, begin: Begin) -> TimeStep:
    """Return a time step after the measurement."""
    NODES.check(policy.parts, policy.designed_for, network)
    plant = policy.model
    tick = begin_time_step(policy, network, {APPLIED: plant.inputs}, {APPLIED: first_input(policy, plant)}, begin=begin)
    tick.draw_losses(policy, network, network.cuts(policy.tick) or (0.0,))
    p, outputs = plant.sensed, plant.outputs
    y, known = [*tick.supplied("y", p), *tick.supplied(REFERENCE, outputs - p)], dict[str, Sequence[Truth]]()
    if isinstance(tick, Informed):
        tick.correct({copy.signal for copy in copies_of_inputs(policy)})
        known = tick.informed(policy)
        tick.operate(operation_of(policy))
    measure(tick, policy, y, known)
    return tick


class Informed(OperatedStep):
    """A time step for real plants: measurements may be missing, and the applied inputs and fates of packets given."""

    # Inputs of the program besides those of ``translate_policy``: for each measured signal ``known_of``, 1 or 0 for an
    # entry; for each link its ``fate_of``, 1 if a packet arrives (or, if delays are random, 1 plus its delay in
    # pieces of a period), −1 if it is dropped, and 0 if it is drawn; ``TOLD``, 1 if the input that was applied differs
    # from the nodes' copies, and then for each signal into which a copy enters its ``change_of``. These are inputs,
    # because a memory may be merged with another one or be left out.

    def correct(self, signals: Iterable[str]) -> None:
        """Correct the memories that depend on the nodes' copies of the input, if the plant received another input."""
        for signal in sorted(signals):
            held = self.read(signal)
            changes = self.supplied(change_of(signal), len(held))
            (told,) = self.supplied(TOLD, 1)
            known = self.builder.greater(told, 0.0)
            moved = add_values(self, held, changes)
            self.signals[signal] = [self.builder.choose(known, *one) for one in zip(moved, held, strict=True)]

    def arrives(self, link: str, sent: Truth) -> Truth:
        """Return whether a packet is sent and arrives. Its fate is given, or is drawn at random if it is not given."""
        b, (fate,) = self.builder, self.supplied(fate_of(link), 1)
        told, dropped = b.greater(fate, 0.0), b.greater(0.0, fate)
        return b.both(b.negated(dropped), b.either(super().arrives(link, sent), b.both(sent, told)))

    def delayed(self, link: str, drawn: int) -> int:
        """Return the delay of the packet of this step, which is given or drawn."""
        b, (fate,) = self.builder, self.supplied(fate_of(link), 1)
        return b.choose(b.greater(fate, 0.0), b.emit("sub", fate, b.constant(1.0)), drawn)

    def informed(self, policy: Policy) -> dict[str, Sequence[Truth]]:
        """Return which entries of each measured signal are known."""
        return {
            signal: [self.builder.greater(flag, 0.0) for flag in self.supplied(known_of(signal), len(outputs))]
            for signal, (_, outputs) in sensed_by(policy).items()
        }


def change_of(signal: str) -> str:
    """Return the name of the program input that corrects a memory if the plant received another input."""
    return f"change of {signal}"


def fate_of(link: str) -> str:
    """Return the name of the program input that states whether a packet on a link arrives or is dropped."""
    return f"fate of a packet on {link}"


def translate_command(policy: Policy, network: Network) -> Program | None:
    """Return the program that computes the controller's command in one step; None if no signal contains the command."""
    names = {index: (name, i) for name, rows in _commands(policy).items() for i, index in enumerate(rows)}
    tick = _measured(policy, network, Informed)
    for step in policy.steps:
        tick.take(step)
        if all(name in tick.signals and name not in tick.memories for name, _ in names.values()):
            break
    if len(names) < policy.model.inputs or not all(name in tick.signals for name, _ in names.values()):
        return None
    places = [names[index] for index in range(policy.model.inputs)]
    return tick.finish({}, named("command", [tick.signals[name][i] for name, i in places]))


def _commands(policy: Policy) -> Mapping[str, Sequence[int]]:
    """Return the signals of the controller that are the commands for some inputs, and these inputs."""
    if _COMMAND in policy.sizes:
        return {_COMMAND: range(policy.model.inputs)}
    found = {f"{_COMMAND}_{node}": rows for node, rows in policy.applied.values()}
    return {name: rows for name, rows in found.items() if name in policy.sizes}


def measure(
    tick: TimeStep, policy: Policy, y: Operands, known: Mapping[str, Sequence[Truth]] | None = None
) -> Operands:
    """Assign the plant's outputs ``y`` to the signals that the nodes measure, and return the outputs that nodes use.

    Entries of signals in ``known`` may be missing, and are then replaced.
    """
    used = [*y]
    for signal, (_, outputs) in policy.measured.items():
        values = [y[index] for index in outputs]
        tick.signals[signal] = values
        if known and signal in known:
            complete(tick, policy, signal, values, known[signal])
        for index, value in zip(outputs, tick.signals[signal], strict=True):
            used[index] = value
    return used


def begin_time_step(
    policy: Policy,
    network: Network,
    sizes: Mapping[str, int],
    initial: Mapping[str, Array | str],
    precision: Precision = "float64",
    begin: Begin = TimeStep,
) -> TimeStep:
    """Create the object that translates one time step of all nodes, before it translates the first policy step."""
    # ``sizes`` and ``initial`` add further signals; ``begin`` is the class of the time step.
    held = [link_state(link) for link in network.links]
    payloads = encode_payloads(policy, network)
    told = {link: {name: how[name] for name in told_by(policy, link)} for link, how in payloads.items()}
    samples = held_samples(policy)
    held += [sample_state(node) for node in network.missing]
    late, empty = memories(policy, network)
    sizes = {**policy.sizes, **sizes, **dict.fromkeys(held, 1), **{name: len(one) for name, one in samples.items()}}
    sizes |= late
    initial = {**policy.initial, **initial, **{name: name for name in held}, **samples, **empty}
    return begin(Builder(precision), sizes, initial, policy.locations, told)


def replaced(step: Step, signal: str, by: str, factor: Array) -> Step:
    """Replace a signal of a policy step by ``factor`` times the signal ``by``, where it is read and where it is
    assigned.
    """
    if isinstance(step, Assign) and step.signal == signal:
        return replace(step, branches=({by: factor},))
    if not isinstance(step, Assign) or not any(signal in terms for terms in step.branches):
        return step

    def term(name: str, matrix: Matrix) -> tuple[str, Matrix]:
        if name != signal:
            return name, matrix
        return by, Scheduled(matrix.by, matrix.values @ factor) if isinstance(matrix, Scheduled) else matrix @ factor

    return replace(step, branches=tuple(dict(term(*one) for one in terms.items()) for terms in step.branches))


def add_values(tick: TimeStep, values: Operands, more: Operands) -> Operands:
    """Add two vectors of the program entry by entry."""
    return [tick.builder.emit("add", value, other) for value, other in zip(values, more, strict=True)]


def deviation(tick: TimeStep, signal: str, followed: str | None, point: Array | None) -> str:
    """Return the name of a signal's deviation from its set-point and operating point, or of the signal if it has
    neither.
    """
    if followed is None and point is None:
        return signal
    size = len(tick.read(signal))
    terms = {signal: np.eye(size)}
    terms |= {} if followed is None else {followed: -np.eye(size)}
    terms |= {} if point is None else {ONE: -point[:, None]}
    tick.signals[f"{signal} off"] = tick.combine(terms, size)
    return f"{signal} off"
