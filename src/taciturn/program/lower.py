"""Lowers the steps of a policy into operations: what each node computes, decides and sends within one tick.

The same walk serves the closed loop (all nodes, the plant between them) and a single node (its packets as inputs).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from taciturn._arrays import Array
from taciturn.model.network import Network
from taciturn.model.policy import (
    ONE,
    Apply,
    Assign,
    Condition,
    Decide,
    Draw,
    Evaluate,
    Location,
    Policy,
    Received,
    Send,
    Step,
    Terms,
)
from taciturn.model.trigger import Bell, Form, Matrix, Scheduled
from taciturn.model.wire import LARGEST, ROUNDERS, Encoding
from taciturn.program.draws import UNIFORM, minus_two_log
from taciturn.program.exponential import falling
from taciturn.program.ir import Builder, Coefficient, Program
from taciturn.program.ops import State
from taciturn.program.trace import trace

Vector = list[int]
Payloads: TypeAlias = Mapping[str, Mapping[str, Encoding]]
Truth = int | bool  # an operation, or known now


class Tick:
    """The values of one tick while it is being written down.

    A signal that is read before it is assigned becomes a memory.

    Args:
        builder: where the operations go.
        sizes: entries of each signal.
        initial: first value of a memory; omitted: 0. A string names values that differ from path to path.
        locations: finite locations.
        payloads: how each signal in the packets of a link is rounded, by link; omitted: what is read is exact.
    """

    def __init__(
        self,
        builder: Builder,
        sizes: Mapping[str, int],
        initial: Mapping[str, Array | str],
        locations: Sequence[Location],
        payloads: Payloads | None = None,
    ) -> None:
        """Start before the first step."""
        self.payloads = payloads or {}
        self.listening: Mapping[str, Encoding] = {}  # what the packet tells that the step being taken reads
        self.builder, self.sizes, self.initial = builder, sizes, initial
        self.signals: dict[str, Vector] = {ONE: [builder.constant(1.0)]}
        self.memories: dict[str, Vector] = {}
        self.outcomes: dict[Condition, list[Truth]] = {}  # one truth value per outcome but the last
        self.arrived: dict[str, Truth] = {}
        self.sent: dict[str, Truth] = {}
        self.options: dict[str, dict[str, int]] = {}  # value of each option of each decision
        self.locations = {location.name: location for location in locations}
        self.drawn = 0  # uniform numbers

    def read(self, name: str) -> Vector:
        """Return the signal's value now, or of the tick before; as the packet tells it, where one is read."""
        return self.hear(name) if name in self.listening else self.recall(name)

    def hear(self, name: str) -> Vector:
        """Return a signal as the packet tells it."""
        return self.rounded(self.recall(name), self.listening[name])

    def rounded(self, values: Vector, encoding: Encoding) -> Vector:
        """Return numbers as a packet holds them."""
        if encoding.name == "float64":
            return values
        if encoding.name == "float32":
            return [self.builder.emit("narrow", value) for value in values]
        return [self._whole(value, scale) for value, scale in zip(values, encoding.full_scale, strict=True)]

    def _whole(self, value: int, scale: float) -> int:
        """Round to a whole number of steps, ties to even."""
        b, most = self.builder, float(LARGEST)
        steps = self.clip(b.scale(most / scale, value), most)
        rounder = b.constant(ROUNDERS[b.precision])
        return b.scale(scale / most, b.emit("sub", b.emit("add", steps, rounder), rounder))

    def clipped(self, values: Vector, limit: Array | None) -> Vector:
        """Return numbers within ± their limits, or as they are where there are none."""
        return (
            values if limit is None else [self.clip(v, bound) for v, bound in zip(values, limit.tolist(), strict=True)]
        )

    def clip(self, value: int, limit: float) -> int:
        """Return a number within ±limit."""
        high, low = self.builder.constant(limit), self.builder.constant(-limit)
        below = self.choose(self.builder.emit("greater", value, high), high, value)
        return self.choose(self.builder.emit("greater", low, below), low, below)

    def recall(self, name: str) -> Vector:
        """Return the signal's value now, or of the tick before."""
        if name not in self.signals:
            self.signals[name] = self.memories[name] = self._remember(name, self.sizes[name])
        return self.signals[name]

    def take(self, step: Step, losses: Mapping[str, Coefficient]) -> None:
        """Write down one step; ``losses`` gives the loss probability of each link."""
        on = step.on if isinstance(step, Assign | Evaluate) else None
        self.listening = self.payloads.get(on.link, {}) if isinstance(on, Received) else {}
        if isinstance(step, Assign):
            values = [self.combine(terms, step.size) for terms in step.branches]
            self.signals[step.signal] = [self.pick(step.on, options) for options in zip(*values, strict=True)]
        elif isinstance(step, Evaluate):
            self.signals[step.signal] = [self.pick(step.on, [self.form(form) for form in step.forms])]
        elif isinstance(step, Apply):
            arguments = {name: self.read(name) for name in step.reads}
            self.signals |= trace(self.builder, step.function, arguments, step.signals)
        elif isinstance(step, Draw):
            self.signals[step.signal] = [self.builder.scale(0.5, minus_two_log(self.builder, self.uniform()))]
        elif isinstance(step, Decide):
            self._decide(step)
        else:
            self._send(step, losses[step.link])
        self.listening = {}

    def combine(self, terms: Terms, rows: int) -> Vector:
        """Return Σ matrix·signal."""
        values = [value for name in terms for value in self.read(name)]
        blocks = [self.coefficients(matrix) for matrix in terms.values()]
        joined = [[c for block in blocks for c in block[i]] for i in range(rows)]
        return [self.value(index) for index in self.builder.transform(joined, values)]

    def form(self, form: Form) -> int:
        """Return the value of a form."""
        b = self.builder
        values = [value for name in form.signals for value in self.read(name)]
        square = None if form.Psi is None else b.quadratic(self.coefficients(form.Psi), values)
        bell = None if form.bell is None else self._bell(form.bell, values)
        added = b.combine(list(form.plus.values()), [self.read(name)[0] for name in form.plus])
        constant = self.number(form.constant)
        fixed = None if constant == 0.0 and isinstance(constant, float) else b.value(constant)
        return self.value(b.add(square, bell, added, fixed))

    def _bell(self, bell: Bell, values: Vector) -> int:
        halved = self.value(self.builder.quadratic(self.coefficients(bell.Pi / 2), values))
        return self.builder.scale(bell.height, falling(self.builder, halved))

    def pick(self, condition: Condition | None, options: Sequence[int]) -> int:
        """Return the option of the outcome that came."""
        chosen = options[-1]
        if condition is not None:
            for truth, option in zip(reversed(self.happened(condition)), reversed(options[:-1]), strict=True):
                chosen = self.choose(truth, option, chosen)
        return chosen

    def choose(self, truth: Truth, yes: int, no: int) -> int:
        """Return one of two values."""
        if isinstance(truth, bool):
            return yes if truth else no
        return self.builder.choose(truth, yes, no)

    def as_number(self, truth: Truth) -> int:
        """Return 1 for true and 0 for false."""
        return self.choose(truth, self.builder.constant(1.0), self.builder.constant(0.0))

    def happened(self, condition: Condition) -> list[Truth]:
        """Return a truth value for each outcome but the last."""
        if isinstance(condition, str):
            return self.outcomes[condition]
        return [self._not(self._arrived(condition.link))]

    def coefficients(self, matrix: Matrix) -> list[list[Coefficient]]:
        """Return the entries of a matrix, read at the location now where it is scheduled."""
        if isinstance(matrix, Scheduled):
            at = self.place(matrix.by)
            entries = np.moveaxis(matrix.values, 0, -1)
            return [[self.builder.lookup(list(entry), at) for entry in row] for row in entries]
        return [[float(value) for value in row] for row in matrix]

    def number(self, value: float | Scheduled) -> Coefficient:
        """Return a number, read at the location now where it is scheduled."""
        if isinstance(value, Scheduled):
            return self.builder.lookup(list(value.values), self.place(value.by))
        return value

    def uniform(self) -> int:
        """Return a fresh draw, uniform in (0, 1)."""
        self.drawn += 1
        return self.builder.input(f"{UNIFORM} {self.drawn - 1}")

    def finish(self, sums: Mapping[str, int], outputs: Mapping[str, int] | None = None) -> Program:
        """Close the tick: move the locations, carry the memories over."""
        for location in self.locations.values():
            if location.name in self.memories:
                self.signals[location.name] = [self.move(location)]
        for link, truth in self.arrived.items():
            self.signals[_arrival(link)] = [self.as_number(truth)]
        following = {(name, i): index for name in self.memories for i, index in enumerate(self.signals[name])}
        order = [following[state.name, state.index] for state in self.builder.states]
        return self.builder.finish(order, sums, outputs)

    def _remember(self, name: str, size: int) -> Vector:
        start = self.initial.get(name)
        keys = [
            (start, i) if isinstance(start, str) else 0.0 if start is None else float(start[i]) for i in range(size)
        ]
        return [self.builder.state(State(name, i, key)) for i, key in enumerate(keys)]

    def value(self, index: int | None) -> int:
        """Return the operation, or zero where nothing is left of a sum."""
        return self.builder.constant(0.0) if index is None else index

    def place(self, name: str) -> int:
        """Return where a location is in this tick."""
        if name not in self.memories:
            location = self.locations[name]
            start = State(name, 0, float(location.initial))
            self.signals[name] = self.memories[name] = [self.builder.state(start)]
        return self.memories[name][0]

    def move(self, location: Location) -> int:
        """Return where a location is in the next tick."""
        columns = location.table[:, None] if location.on is None else location.table
        here = self.place(location.name)
        options = [self.builder.value(self.builder.lookup([float(v) for v in column], here)) for column in columns.T]
        return self.pick(location.on, options)

    def _decide(self, step: Decide) -> None:
        """The first label that no other undercuts wins."""
        values = [self.form(form) for form in step.trigger.options.values()]
        self.options[step.decision] = dict(zip(step.trigger.labels, values, strict=True))
        truths: list[Truth] = []
        for i, value in enumerate(values[:-1]):
            truth: Truth = True
            for other in values[i + 1 :]:
                truth = self._and(truth, self.builder.emit("less_equal", value, other))
            for earlier in truths:
                truth = self._and(truth, self._not(earlier))
            truths.append(truth)
        self.outcomes[step.decision] = truths

    def _send(self, step: Send, loss: Coefficient) -> None:
        sent: Truth = True
        if step.on is not None:
            labels = list(self.options[step.on])
            silent = [label not in (step.labels or labels[1:]) for label in labels]
            truths = self.outcomes[step.on]
            flags = zip(truths, silent[:-1], strict=True)
            if silent[-1]:  # sent if one of the other labels is picked that sends
                none: Truth = True
                for truth in (truth for truth, quiet in flags if not quiet):
                    none = self._and(none, self._not(truth))
                sent = self._not(none)
            else:
                for truth in (truth for truth, quiet in flags if quiet):
                    sent = self._and(sent, self._not(truth))
        self.sent[step.link] = arrives = sent
        if not (isinstance(loss, float) and loss == 0.0):
            arrives = self._and(arrives, self.builder.emit("greater", self.uniform(), self.builder.value(loss)))
        self.arrived[step.link] = arrives

    def _arrived(self, link: str) -> Truth:
        """Whether this tick's packet arrived; read before this tick's sending, that of the tick before."""
        if link not in self.arrived:
            name = _arrival(link)
            self.memories[name] = self._remember(name, 1)
            self.arrived[link] = self.builder.emit("greater", self.memories[name][0], self.builder.constant(0.0))
        return self.arrived[link]

    def _and(self, one: Truth, other: Truth) -> Truth:
        if isinstance(one, bool):
            return other if one else False
        if isinstance(other, bool):
            return one if other else False
        return self.builder.emit("and", one, other)

    def _not(self, truth: Truth) -> Truth:
        if isinstance(truth, bool):
            return not truth
        op = self.builder.ops[truth]
        return op.arguments[0] if op.name == "not" else self.builder.emit("not", truth)


def encode_payloads(policy: Policy, network: Network) -> dict[str, dict[str, Encoding]]:
    """Return how each signal that a packet tells its receiver is rounded, by link and signal.

    Raises:
        ProblemError: a range is missing, or has another number of entries than the packet.
    """
    payloads: dict[str, dict[str, Encoding]] = {}
    for step in policy.steps:
        if isinstance(step, Send):
            sizes = [policy.sizes[name] for name in step.payload]
            parts = network.encoding(step.link).parts(sizes)
            payloads[step.link] = dict(zip(step.payload, parts, strict=True))
    return payloads


def _arrival(link: str) -> str:
    return f"arrived on {link}"
