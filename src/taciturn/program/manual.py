"""Manual operation: an operator gives the inputs in place of the controller, whose filter and integrals follow them.

After the controller has computed a command, a manual input replaces it. All that follows uses the replaced command: the
limits, the copies of the input that the actuators hold, and thereby filters and controllers that read these copies. A
decision that depends on signals sends a packet if and only if the input that the receiver uses in silence differs from
the command, within the limits of the intervals between packets. Packets at fixed steps remain as they are.

The integrals of a linear controller x⁺ = A x + B y + E u, u = C x + D y (+ G r) follow the command. With the modes N of
A + E C that do not decay, its next state becomes

    x⁺ + N (C N)⁺ (u − C x⁺ − D y − G r),

so that the first automatic command equals the last manual one if the error is unchanged. An input whose controller has
no such mode returns with a jump.

Inputs of the program of a controller's node state whether the operation is manual, and give the manual inputs. The
program of a simulation has no such inputs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn.errors import ProblemError
from taciturn.model.controller import integral_modes
from taciturn.model.policy import HELD, Policy
from taciturn.model.steps import ONE, Apply, Assign, Decide, Send, Step, Terms, assigned
from taciturn.model.trigger import Matrix
from taciturn.program.ir import Truth
from taciturn.program.translation import TimeStep

MANUAL, BY_HAND = "manual operation", "manual input"  # inputs of programs: 1 or 0; the manual inputs of the plant
_COMMAND, _UNLIMITED, _WANTED = "command", "unlimited ", "wanted "  # names of signals of all designs
_APART = "command apart"  # how much a manual command differs from that of the controller


@dataclass(frozen=True, eq=False)
class _Command:
    """A command of the controller that an actuator applies."""

    signal: str
    inputs: tuple[int, ...]  # inputs of the plant
    silent: Terms | None  # the input that the actuator uses in silence, from the sender's signals; None: not known


@dataclass(frozen=True, eq=False)
class _Sending:
    """A decision whose packets carry commands."""

    commands: tuple[_Command, ...]
    sends: str  # a label with which all packets are sent
    silent: str  # a label with which none is


@dataclass(frozen=True, eq=False)
class _Integrals:
    """The step that updates the state of a linear controller, and how the state follows the command."""

    step: Assign
    commands: Mapping[str, Terms]  # by command, its sum of the updated state and of measurements
    follows: Array  # N (C N)⁺


@dataclass(frozen=True, eq=False)
class Operation:
    """The changes that manual operation makes in the steps of a policy."""

    commands: tuple[_Command, ...]
    sends: Mapping[str, _Sending]  # by decision
    integrals: _Integrals | None

    @property
    def places(self) -> dict[str, tuple[int, ...]]:
        """The inputs of the plant in each signal that a manual input replaces."""
        return {name: one.inputs for one in self.commands for name in (_UNLIMITED + one.signal, one.signal)}


class OperatedStep(TimeStep):
    """A time step in which an operator may give the inputs."""

    operation: Operation | None = None

    def operate(self, operation: Operation | None, begins: bool = True) -> None:
        """Begin a part of the step; for a later part, it is a memory whether the operation is manual."""
        self.operation = operation
        if operation is not None and begins:
            self.signals[MANUAL] = self.supplied(MANUAL, 1)

    def take(self, step: Step) -> None:
        """Translate a policy step, and replace what manual operation changes."""
        super().take(step)
        operation = self.operation
        if operation is None:
            return
        if isinstance(step, Decide) and step.decision in operation.sends:
            self.outcomes[step.decision] = self._sent_by_hand(step, operation.sends[step.decision])
        for name in assigned(step):
            if name in operation.places and not _is_limited(step, name):
                hand = self._by_hand()
                values = zip(operation.places[name], self.signals[name], strict=True)
                self.signals[name] = [self.builder.choose(self._manual(), hand[i], value) for i, value in values]
        if operation.integrals is not None and step is operation.integrals.step:
            self._follow(operation.integrals, operation.commands)

    def _manual(self) -> Truth:
        return self.builder.greater(self.recall(MANUAL)[0], 0.0)

    def _by_hand(self) -> list[int]:
        assert self.operation is not None, "the step is operated"
        return self.supplied(BY_HAND, sum(len(one.inputs) for one in self.operation.commands))

    def _sent_by_hand(self, step: Decide, by_hand: _Sending) -> list[Truth]:
        """Return the outcomes of a decision, which sends if and only if a manual input differs from that in silence."""
        b, labels, differs = self.builder, step.trigger.labels, False
        for one in by_hand.commands:
            if one.silent is None:
                differs = True
                continue
            silent = self.combine(one.silent, len(one.inputs)) if one.silent else [b.constant(0.0)] * len(one.inputs)
            for held, value in zip(silent, self.recall(one.signal), strict=True):
                differs = b.either(differs, b.either(b.greater(held, value), b.greater(value, held)))
        found = self.outcomes[step.decision]
        for label, wanted in ((by_hand.sends, differs), (by_hand.silent, b.negated(differs))):
            forced = b.both(self._manual(), b.both(wanted, self.allowed(step.trigger, label)))
            found = [
                b.either(truth, forced) if name == label else b.both(truth, b.negated(forced))
                for name, truth in zip(labels, found, strict=False)
            ]
        return found

    def _follow(self, integrals: _Integrals, commands: tuple[_Command, ...]) -> None:
        """Let the integrals follow the command, so that the controller would command it for the same error."""
        b, state, apart = self.builder, integrals.step.signal, dict[int, int]()
        for one in commands:
            own = self.combine(integrals.commands[one.signal], len(one.inputs))
            for index, value, other in zip(one.inputs, self.recall(one.signal), own, strict=True):
                apart[index] = b.emit("sub", value, other)
        before = self.signals[state]
        self.signals[_APART] = [apart[index] for index in range(len(apart))]
        moved = self.combine({state: np.eye(len(before)), _APART: integrals.follows}, len(before))
        self.signals[state] = [b.choose(self._manual(), *values) for values in zip(moved, before, strict=True)]


def operation_of(policy: Policy) -> Operation | None:
    """Return what manual operation changes; None if actuators do not simply apply the commands of the controller."""
    home, commands = policy.site(policy.network.controller), list[_Command]()
    for signal, (node, inputs) in policy.applied.items():
        found = _command_of(policy, signal, node, inputs)
        if found is None or not _is_replaceable(policy, found.signal, home):
            return None
        commands.append(found)
    if not commands or policy.prediction is not None:
        return None
    decisions = [step for step in policy.steps if isinstance(step, Decide) and step.at in home and step.trigger.reads]
    found = {step.decision: _sending(policy, step, commands) for step in decisions}
    sends = {decision: one for decision, one in found.items() if one is not None}
    return Operation(tuple(commands), sends, _integrals_of(policy, tuple(commands)))


def _sending(policy: Policy, step: Decide, commands: Sequence[_Command]) -> _Sending | None:
    packets = [one for one in policy.steps if isinstance(one, Send) and one.on == step.decision]
    carried = tuple(one for one in commands if any(one.signal in packet.payload for packet in packets))
    sent = {label: [label in one.sending(step.trigger.labels) for one in packets] for label in step.trigger.labels}
    full, silent = [label for label in sent if all(sent[label])], [label for label in sent if not any(sent[label])]
    return _Sending(carried, full[-1], silent[0]) if carried and full and silent else None


def not_operable(policy: Policy) -> ProblemError:
    """Return the error that a policy cannot be operated by hand."""
    return ProblemError(
        f"a manual input is given, but the actuators of this {policy.kind} policy compute their inputs from other "
        "packets, or its controller is a function with a memory; expected a policy whose actuators apply the command "
        "of a linear controller, such as one with actuation = 'hold'"
    )


def _command_of(policy: Policy, signal: str, node: str, inputs: tuple[int, ...]) -> _Command | None:
    """Return the command that an actuator applies when it receives a packet, or None."""
    steps = [step for step in policy.steps if signal in assigned(step)]
    if len(steps) != 1 or not isinstance(step := steps[0], Assign):
        return None
    *others, applied = ({name: M for name, M in terms.items() if _is_present(M)} for terms in step.branches)
    name = next(iter(applied), "")
    if len(applied) != 1 or name.partition("_")[0] != _COMMAND or not _is_unit(applied[name]):
        return None
    if step.on is None:
        return _Command(name, inputs, None)
    held = next((one for one in _copies(node) if one in policy.sizes), None)
    silent: Terms | None = None
    if len(others) == 1 and others[0].keys() <= {signal, ONE} and (held or signal not in others[0]):
        whole = np.eye(policy.model.inputs)[[*inputs]]  # a copy without the name of a node is that of all inputs
        silent = {one: M for one, M in others[0].items() if one != signal}
        weight = others[0].get(signal)
        if held and isinstance(weight, np.ndarray):
            silent[held] = weight @ whole if held.endswith(HELD) else weight
    return _Command(name, inputs, silent)


def _copies(node: str) -> tuple[str, ...]:
    """Return the names that the controller's copy of a held command may have."""
    names = f"{HELD}_{node}", HELD
    return (*(_WANTED + name for name in names), *names)


def _is_replaceable(policy: Policy, command: str, home: frozenset[str]) -> bool:
    """Return whether the controller computes a command from other signals, by no function with a memory."""
    steps = [step for step in policy.steps if command in assigned(step)]
    return bool(steps) and all(
        step.at in home and not (isinstance(step, Apply) and set(step.reads) & step.signals.keys()) for step in steps
    )


def _is_limited(step: Step, name: str) -> bool:
    """Return whether a step only limits a command that has been replaced."""
    return isinstance(step, Apply) and _UNLIMITED + name in step.reads


def _integrals_of(policy: Policy, commands: tuple[_Command, ...]) -> _Integrals | None:
    """Return how the state of a linear controller follows a manual input; None if there is no such state."""
    steps, sums = policy.steps, dict[str, Assign]()
    for one in commands:
        raw = _UNLIMITED + one.signal
        found = [s for s in steps if isinstance(s, Assign) and s.signal == (raw if raw in policy.sizes else one.signal)]
        if len(found) != 1 or found[0].on is not None:
            return None
        sums[one.signal] = found[0]
    begun = max(steps.index(step) for step in sums.values())
    taken = {
        step.signal: next(iter(step.branches[0]))
        for step in steps[:begun]
        if isinstance(step, Assign) and step.on is None and [*map(_is_unit, step.branches[0].values())] == [True]
    }  # copies of memories
    read = {name for step in sums.values() for name in step.branches[0]}
    for update in steps[begun + 1 :]:
        if not isinstance(update, Assign) or update.on is not None:
            continue
        state = next((n for n in read if n == update.signal or taken.get(n) == update.signal), None)
        if state is None or state not in update.branches[0]:
            continue
        found = _following(policy, commands, sums, state, update)
        if found is not None:
            return found
    return None


def _following(
    policy: Policy, commands: tuple[_Command, ...], sums: Mapping[str, Assign], state: str, update: Assign
) -> _Integrals | None:
    terms, m, k = update.branches[0], policy.model.inputs, update.size
    C = np.zeros((m, k))
    for one in commands:
        weight = sums[one.signal].branches[0].get(state, np.zeros((len(one.inputs), k)))
        if not isinstance(weight, np.ndarray):
            return None
        C[[*one.inputs]] = weight
    places = _inputs_of(policy, commands)
    A = terms[state]
    if not isinstance(A, np.ndarray):
        return None
    for name, effect in terms.items():
        if name in places and isinstance(effect, np.ndarray):
            A = A + effect @ C[[*places[name]]]
    N = integral_modes(A)
    if not (C @ N).any():
        return None
    moved = {
        command: {update.signal if name == state else name: weight for name, weight in step.branches[0].items()}
        for command, step in sums.items()
    }
    return _Integrals(update, moved, N @ np.linalg.pinv(C @ N))


def _inputs_of(policy: Policy, commands: tuple[_Command, ...]) -> dict[str, tuple[int, ...]]:
    """Return the inputs of the plant in each signal that contains a command or the copy of an input."""
    found = {HELD: tuple(range(policy.model.inputs))} | {f"{HELD}_{at}": rows for at, rows in policy.applied.values()}
    found |= {one.signal: one.inputs for one in commands}
    return found | {f"reached {name}": rows for name, rows in found.items()}


def _is_present(matrix: Matrix) -> bool:
    return not isinstance(matrix, np.ndarray) or bool(matrix.any())


def _is_unit(matrix: Matrix) -> bool:
    return isinstance(matrix, np.ndarray) and np.array_equal(matrix, np.eye(len(matrix)))
