"""Anti-windup for actuators with limits: the filters and predictions of a policy use the input actually applied.

A filter that uses the command instead of the input that a saturated actuator applies winds up: its estimate follows an
input that the plant never received. For a plant with limits, the policy steps of a design change as follows:

- A controller commands only inputs between the lower and the upper limit: the values of ``command``, ``candidate`` and
  ``held`` are brought within the limits.
- Triggers use the ``error`` of the command without limits, so that they see how far the state is from its place. For an
  input that a packet would not change in this step, the error is 0.
- If the change per step is limited, ``held`` is the input that the actuator has reached on its way to the command, and
  ``wanted held`` the command that it still has. Triggers compare commands; filters and models use ``held``.
- An actuator that runs a model uses the input that it applies.
- A decision on one link to an actuator that holds its input excludes a packet that would change no input in this step,
  whatever else asks for a packet, except for a heartbeat. Nothing is lost: to each rule belongs another one that sends
  the same value later, when it first changes the input, so it applies the same inputs with no more packets.
- A sender that never learns of dropped packets does not know which input is applied, so it keeps neither of the two
  rules: it would take a dropped packet for the input at a limit, and stay silent however far the state goes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn.base.filter import HELD
from taciturn.errors import ProblemError
from taciturn.model.policy import Policy
from taciturn.model.saturation import Saturation, limit_entries
from taciturn.model.steps import ONE, Apply, Assign, Decide, Send, Step, Terms, assigned, read
from taciturn.model.trigger import Form, is_unit

NAMES = ("command", "candidate", "silent", HELD)  # inputs as a node computes them; with several actuators, NAME_NODE
COMPARED = ("error", "moved")  # differences of commands
CHANGED = "changed inputs"  # number of inputs that a packet changes


def within_limits(policy: Policy, unsure: bool = False) -> Policy:
    """Add anti-windup to a policy whose plant has input limits. Return the policy unchanged if the plant has none.

    ``unsure``: the link drops packets without acknowledgement.
    """
    limits = policy.model.saturation
    if limits is None:
        return policy
    return _Limited(policy, limits, unsure).policy()


class _Limited:
    """The steps of a policy, and the inputs that its signals contain."""

    def __init__(self, policy: Policy, limits: Saturation, unsure: bool) -> None:
        """Find the signals that contain inputs: those that a node applies or holds, and those copied to them."""
        self._policy, self._limits, self._unsure = policy, limits, unsure
        self._inputs = {signal: [*rows] for signal, (_, rows) in policy.applied.items()}
        sums = [step for step in policy.steps if isinstance(step, Assign)]
        rows: dict[str, list[int]] = {HELD: [*range(policy.model.inputs)]}
        rows |= {f"{HELD}_{node}": [*held] for node, held in policy.applied.values()}
        found = {**self._inputs, **{step.signal: rows[step.signal] for step in sums if step.signal in rows}}
        waiting = list(found)
        while waiting:
            signal = waiting.pop()
            for name in (name for step in sums if step.signal == signal for name in self._copied(step)):
                if name not in found and name.partition("_")[0] in NAMES:
                    found[name] = found[signal]
                    waiting.append(name)
        self._rows: Mapping[str, list[int]] = found
        self._reached: dict[str, str] = {}  # by command, the signal of the input that an actuator applies
        self._unlimited: dict[str, str] = {}  # by input, the signal of its value before the limits
        self._errors: dict[str, Assign] = {}  # by command, the step that compares it with the input without a packet

    def policy(self) -> Policy:
        """Return the given policy with the policy steps for anti-windup added."""
        steps = tuple(found for step in self._policy.steps for found in self._steps(step))
        made = {name for step in steps for name in assigned(step)}
        added = [step for step in steps if isinstance(step, Apply) and step not in self._policy.steps]
        theory, computed = self._policy.theory, {name for step in added for name in step.signals}
        return replace(
            self._policy,
            steps=steps,
            theory=replace(theory, functions=theory.functions | computed, covers=theory.covers | {"Trigger.excluded"}),
            initial={**self._policy.initial, **{name: value for name, value in self._begun.items() if name in made}},
        )

    @cached_property
    def _begun(self) -> dict[str, Array]:
        """The values of inputs before the first step that differ from 0."""
        found = dict[str, Array]()
        for name, rows in self._rows.items():
            start = self._of(name).begun(self._policy.initial.get(name, np.zeros(len(rows))))
            names = (name, _wanted(name), _reached(name))
            found |= dict.fromkeys(names, start) if start.any() else {}
        return found

    def _of(self, signal: str) -> Saturation:
        """Return the limits of the inputs that a signal contains."""
        return self._limits.of(self._rows[signal])

    def _steps(self, step: Step) -> Iterator[Step]:
        if isinstance(step, Decide):
            yield from self._decided(step)
            return
        if not isinstance(step, Assign):
            yield step
            return
        names = dict[str, str]()
        demand = step.signal in self._rows or step.signal.partition("_")[0] in COMPARED
        for name in (name for terms in step.branches for name in terms if name in self._rows):
            if demand:
                names |= {name: _wanted(name)} if self._is_held(name) and self._limits.moves else {}
            elif name in self._inputs or (self._limits.moves and not self._is_held(name)):
                if name not in self._reached:
                    yield self._reach(step.at, name, _reached(name))
                    self._reached[name] = _reached(name)
                names[name] = self._reached[name]
        if step.signal not in self._rows and demand and self._rows.keys() & set(read(step)) and _is_difference(step):
            yield from self._compared(step, names)
            return
        branches = tuple({names.get(name, name): M for name, M in terms.items()} for terms in step.branches)
        signal = step.signal
        if signal not in self._rows or signal in self._inputs:
            yield _assigned(step, signal, branches)
            return
        target = _wanted(signal) if self._is_held(signal) and self._limits.moves else signal
        if all(self._stays(terms, signal) for terms in step.branches):
            yield _assigned(step, target, branches)
        else:
            raw = self._unlimited[signal] = f"unlimited {signal}"
            yield _assigned(step, raw, branches)
            yield Apply(step.at, {target: step.size}, replace(self._of(signal), rate=None), (raw,))
        if target != signal:
            yield self._reach(step.at, target, signal)

    def _reach(self, at: str, wanted: str, signal: str) -> Step:
        """Return the step that computes the input that an actuator applies for a command."""
        limits = self._of(signal if signal in self._rows else wanted)
        reads = (wanted, signal) if limits.moves else (wanted,)
        return Apply(at, {signal: len(limits.low)}, limits, reads)

    def _compared(self, step: Assign, names: Mapping[str, str]) -> Iterator[Step]:
        """Return the steps of a difference of commands: without limits, but 0 where the limits make them equal."""
        (terms,), raw, limited = step.branches, f"unlimited {step.signal}", f"limited {step.signal}"
        apart = {self._unlimited.get(name, names.get(name, name)): matrix for name, matrix in terms.items()}
        if self._unsure:
            yield Assign(step.at, step.signal, apart)
            return
        self._errors |= dict.fromkeys(terms, step)
        both = tuple(names.get(name, name) for name in terms)
        if self._limits.moves:  # what the actuator reaches in this step
            stem = step.signal.partition("_")[0]
            held, limits = HELD + step.signal[len(stem) :], self._of(next(name for name in terms if name in self._rows))
            found = tuple(f"{name} for {step.signal}" for name in both)
            for name, wanted in zip(found, both, strict=True):
                yield Apply(step.at, {name: step.size}, limits, (wanted, held))
            both = found
        yield Assign(step.at, raw, apart)
        yield Apply(step.at, {limited: step.size}, _where_apart, (raw, *both))
        yield Assign(step.at, step.signal, {limited: np.eye(step.size)})

    def _decided(self, step: Decide) -> Iterator[Step]:
        """Return the steps of a decision, which excludes a packet that changes no input that the actuator applies."""
        sends = [one for one in self._policy.steps if isinstance(one, Send) and one.on == step.decision]
        found = self._errors.get(sends[0].payload[0]) if len(sends) == 1 else None
        # with several links, the first or cheapest set of packets never contains one without an effect
        if (
            found is None
            or not step.trigger.reads
            or len(sends[0].payload) > 1
            or not self._policy.holds(sends[0].link)
        ):
            yield step
            return
        name = CHANGED + found.signal[len(found.signal.partition("_")[0]) :]
        yield Apply(step.at, {name: 1}, _count, (found.signal,))
        none, trigger = Form(constant=0.5, plus={name: -1.0}), step.trigger
        labels = sends[0].sending(trigger.labels)
        more = {label: (*trigger.excluded.get(label, ()), none) for label in labels}
        yield replace(step, trigger=replace(trigger, excluded={**trigger.excluded, **more}))

    def _is_held(self, signal: str) -> bool:
        return signal in self._rows and signal not in self._inputs and signal.partition("_")[0] == HELD

    def _copied(self, step: Assign) -> Iterator[str]:
        """Return the signals that a step copies, apart from a constant."""
        for terms in step.branches:
            others = {name: matrix for name, matrix in terms.items() if name != ONE}
            if len(others) == 1 and all(is_unit(matrix) for matrix in others.values()):
                yield from others

    def _stays(self, terms: Terms, signal: str) -> bool:
        """Return whether a sum stays within the limits: a copy of an input, or 0."""
        if all(isinstance(matrix, np.ndarray) and not matrix.any() for matrix in terms.values()):
            limits = self._of(signal)
            if (limits.low > 0).any() or (limits.high < 0).any():
                got = limit_entries(np.stack([limits.low, limits.high], axis=1))
                raise ProblemError(
                    f"the actuator of the policy kind {self._policy.kind} applies 0 if no packet arrives, but "
                    f"input_limit is {got}; expected limits that contain 0, or an actuator that holds its input"
                )
            return True
        return len(terms) == 1 and all(name in self._rows and is_unit(matrix) for name, matrix in terms.items())


def _assigned(step: Assign, signal: str, branches: tuple[Terms, ...]) -> Assign:
    """Return a step that assigns other sums to another signal."""
    return Assign(step.at, signal, branches if step.on is not None else branches[0], step.on)


def _where_apart(difference: Any, one: Any, other: Any) -> Any:
    """Return the difference of two commands, or 0 for inputs on which they have the same effect."""
    return np.where(one == other, 0.0, difference)


def _count(difference: Any) -> Any:
    """Return the number of entries that are not 0."""
    return sum(np.where(difference[i] == 0.0, 0.0, 1.0) for i in range(len(difference)))


def _is_difference(step: Assign) -> bool:
    """Return whether a step subtracts one signal from another."""
    weights = [matrix for terms in step.branches for matrix in terms.values()]
    if step.on is not None or len(weights) != 2:
        return False
    one, other = weights
    unlike = isinstance(one, np.ndarray) and isinstance(other, np.ndarray) and np.array_equal(one, -other)
    return unlike and (is_unit(one) or is_unit(other))


def _wanted(signal: str) -> str:
    return f"wanted {signal}"


def _reached(signal: str) -> str:
    return f"reached {signal}"
