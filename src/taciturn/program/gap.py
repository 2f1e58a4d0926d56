"""After a gap of missing samples: the memories of a controller as if the samples had lain on a straight line.

A node that cannot predict an output y holds its last measurement y₀ while samples are missing (``missing``). If the
next one, y₁, comes after n missing ones, a derivative would see the change d = y₁ − y₀ of the whole gap in one step.
So the memories s of the controller are corrected first. In a step they become s⁺ = F s + E y + …, so with the samples
y₀ + d j/(n + 1), j = 1, …, n, on the line they would be larger by

    T_n d/(n + 1),   T_0 = 0,   T_j = F T_{j−1} + j E.

Then the step uses y₁: the proportional part has the new value, an integral that of the trapezoid, and a
derivative the mean slope of the gap. The node remembers n and T_n of each output, since gaps may be long.

F and E follow from the policy steps at the controller's site (``response_to``). Inputs that were applied, and the
commands that actuators copied, are what they were, so the terms with these inputs remain: an integral that follows the
applied input still follows it. A memory that depends on y through a condition, a quadratic form, a function or a
table keeps its value, since its response is not linear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn.model.policy import Policy
from taciturn.model.steps import ONE, Assign, Step, assigned, read
from taciturn.model.trigger import Matrix, is_unit
from taciturn.program.ir import Truth
from taciturn.program.translation import Operands, TimeStep

Sum = dict[str, Array]  # how a signal responds: Σ matrix·signal of memories and of the measured signal


@dataclass(frozen=True, eq=False)
class Response:
    """How memories respond to one output: s⁺ = F s + E y + …"""

    output: int  # its place in the measured signal
    memories: tuple[tuple[str, int], ...]  # signal and entry
    F: Array  # (memories, memories)
    E: Array  # (memories,)


def response_to(policy: Policy, signal: str) -> tuple[Response, ...]:
    """Return the linear responses of the controller's memories to the outputs in a measured signal."""
    home = policy.site(policy.network.controller)  # its steps read signals of other sites only from packets: none
    walk = _Walk(policy, signal, [step for step in policy.steps if step.at in home])
    names = walk.linear()
    sizes = [policy.sizes[name] for name in names]
    if not names:
        return ()
    count = policy.sizes[signal]
    whole = np.vstack([np.hstack([walk.weight(name, other) for other in (*names, signal)]) for name in names])
    entries = [(name, i) for name, size in zip(names, sizes, strict=True) for i in range(size)]
    F, E = whole[:, :-count], whole[:, -count:]
    found = list[Response]()
    for output in range(count):
        rows = _reached(F, E[:, output])
        if rows:
            part = np.ix_(rows, rows)
            found.append(Response(output, tuple(entries[i] for i in rows), F[part], E[rows, output]))
    return tuple(found)


def gap_memories(policy: Policy, signal: str) -> dict[str, Array]:
    """Return the memories of gaps in a signal that is held, with their first values; none without a response."""
    responses = response_to(policy, signal)
    if not responses:
        return {}
    counts, moved = np.zeros(len(responses)), np.zeros(sum(len(one.E) for one in responses))
    return {_missed(signal): counts, _moved(signal): moved}


def bridge(
    tick: TimeStep, policy: Policy, signal: str, values: Operands, last: Operands, known: Sequence[Truth]
) -> None:
    """Correct the memories of the controller for outputs that are known again, before the policy steps read them."""
    responses = response_to(policy, signal)
    if not responses:
        return
    b, zero, one = tick.builder, tick.builder.constant(0.0), tick.builder.constant(1.0)
    counts, moved = tick.recall(_missed(signal)), iter(tick.recall(_moved(signal)))
    following, after = Operands(), Operands()
    for count, response in zip(counts, responses, strict=True):
        T, place = [next(moved) for _ in response.E], response.output
        more, truth = b.emit("add", count, one), known[place]
        ended = b.both(truth, b.greater(count, 0.0))  # without a gap, a memory keeps its bits: x + 0 may change −0
        slope = b.emit("div", b.emit("sub", values[place], last[place]), more)
        for (name, i), moves in zip(response.memories, T, strict=True):
            memory = [*tick.recall(name)]  # with the corrections by other outputs, which end gaps of their own
            memory[i] = b.choose(ended, b.emit("add", memory[i], b.emit("mul", moves, slope)), memory[i])
            tick.signals[name] = memory
        joined = [[float(c) for c in row] for row in np.column_stack([response.F, response.E])]
        grown = [b.value(index) for index in b.transform(joined, [*T, more])]
        after += [b.choose(truth, zero, value) for value in grown]
        following.append(b.choose(truth, zero, more))
    tick.signals[_missed(signal)], tick.signals[_moved(signal)] = following, after


class _Walk:
    """Follows a measured signal through the policy steps of a site, to the memories that depend on it."""

    def __init__(self, policy: Policy, signal: str, steps: Sequence[Step]) -> None:
        self._signal, self._steps, self._sizes = signal, steps, policy.sizes
        self._assigned = {name for step in steps for name in assigned(step)} - _applied(policy)
        self._reached, self._curved = set[str](), set[str]()  # memories that depend on it, those that do not linearly
        self._found: dict[str, Sum | None] = {}  # the response of each signal; None if it is not linear

    def linear(self) -> list[str]:
        """Return the memories that depend on the signal, and only linearly."""
        while True:  # a memory that responds makes others respond in later steps, until no further one does
            memories = self._pass()
            after = {name: self._found[name] for name in memories}
            reached = {name for name, terms in after.items() if terms is None or terms}
            curved = {name for name, terms in after.items() if terms is None}
            if reached == self._reached and curved == self._curved:
                return [name for name in memories if name in reached - curved]
            self._reached, self._curved = reached, curved

    def weight(self, name: str, other: str) -> Array:
        """Return the matrix by which a memory's next value depends on a memory or on the measured signal."""
        terms = self._found[name] or {}
        return terms.get(other, np.zeros((self._sizes[name], self._sizes[other])))

    def _pass(self) -> list[str]:
        """Find the responses of all signals in one step, and return the signals that are read before assigned."""
        self._found = {self._signal: {self._signal: np.eye(self._sizes[self._signal])}}
        memories = list[str]()
        for step in self._steps:
            for name in read(step):
                if name in self._assigned and name not in self._found:
                    memories.append(name)
                    known = {name: np.eye(self._sizes[name])} if name in self._reached else {}
                    self._found[name] = None if name in self._curved else known
            found = self._response(step)
            self._found |= {name: found for name in assigned(step) if name in self._assigned}
        return memories

    def _response(self, step: Step) -> Sum | None:
        """Return how the result of a step responds; None if not linearly."""
        if isinstance(step, Assign) and step.on is None:
            total = Sum()
            for name, weight in step.branches[0].items():
                terms = self._found.get(name, {})
                if terms == {} or not _is_present(weight):
                    continue
                if terms is None or not isinstance(weight, np.ndarray):
                    return None
                for other, one in terms.items():
                    total[other] = total.get(other, 0.0) + weight @ one
            return {name: one for name, one in total.items() if one.any()}
        return None if any(self._found.get(name, {}) != {} for name in read(step)) else {}


def _applied(policy: Policy) -> set[str]:
    """Return the inputs that actuators apply, and the commands that they copy."""
    # the walk ends at them: in the gap they had the values that were applied, whatever the samples would have been
    found = {*policy.applied, ONE}
    for step in policy.steps:
        for terms in step.branches if isinstance(step, Assign) and step.signal in policy.applied else ():
            present = {name: weight for name, weight in terms.items() if _is_present(weight)}
            found |= {name for name, weight in present.items() if len(present) == 1 and is_unit(weight)}
    return found


def _reached(F: Array, enters: Array) -> list[int]:
    """Return the places of the memories that depend on an output, at once or through others."""
    found = enters != 0.0
    for _ in range(len(found)):
        found = found | (F[:, found] != 0.0).any(axis=1)
    return [int(i) for i in np.flatnonzero(found)]


def _is_present(weight: Matrix) -> bool:
    return not isinstance(weight, np.ndarray) or bool(weight.any())


def _missed(signal: str) -> str:
    """Return the name of the memory with the number of missing samples of each output."""
    return f"missing samples of {signal}"


def _moved(signal: str) -> str:
    """Return the name of the memory with T_n of each output."""
    return f"response to a line of {signal}"
