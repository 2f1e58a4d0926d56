"""Policies as data: nodes that compute, decide and exchange packets, and the guarantee that holds for them.

A policy is the list of what happens within one tick, in order. A signal read before it is assigned in a tick has its
value of the tick before: that is the whole notion of memory, and a delay is an order of events.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, ArrayLike, array, number
from taciturn.errors import ProblemError
from taciturn.model.network import Network
from taciturn.model.plant import Plant
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger, matrix, shape_of

NodeName = Literal["sensor", "controller", "actuator"]
LinkName = Literal["sensor", "actuator"]
NODES: tuple[NodeName, ...] = ("sensor", "controller", "actuator")
ENDS: dict[str, NodeName] = {"sensor": "controller", "actuator": "actuator"}  # a link is named after where it matters


@dataclass(frozen=True)
class Received:
    """The condition "a packet of this link arrived", known at its receiving node."""

    link: LinkName


@dataclass(frozen=True)
class Acknowledged:
    """The condition "my packet on this link arrived", known at its sender where the network acknowledges."""

    link: LinkName


Condition: TypeAlias = str | Received | Acknowledged  # a name is that of a decision
Terms: TypeAlias = Mapping[str, Matrix]


@dataclass(frozen=True, eq=False)
class Assign:
    """signal := Σ matrix·signal at a node; with ``on``, one sum for each outcome of the condition.

    Args:
        at: the node that computes.
        signal: name of the result.
        branches: {signal: matrix}, or one such mapping per outcome: (not arrived, arrived), or one per label.
        on: the condition that picks the branch.
    """

    at: NodeName
    signal: str
    branches: tuple[Terms, ...]
    on: Condition | None = None

    def __init__(
        self,
        at: NodeName,
        signal: str,
        branches: Mapping[str, ArrayLike | Scheduled] | tuple[Mapping[str, ArrayLike | Scheduled], ...],
        on: Condition | None = None,
    ) -> None:
        listed = (branches,) if isinstance(branches, Mapping) else branches
        checked = tuple(
            {name: matrix(f"the weight of {name} in {signal}", value) for name, value in terms.items()} for terms in listed
        )
        if (on is None) != (len(checked) == 1):
            raise ProblemError(f"{signal} has {len(checked)} branches on {on}; expected one without a condition, several with one")
        rows = {shape_of(value)[0] for terms in checked for value in terms.values()}
        if len(rows) != 1:
            raise ProblemError(f"the terms of {signal} have {sorted(rows)} rows; expected one number of rows")
        object.__setattr__(self, "at", at)
        object.__setattr__(self, "signal", signal)
        object.__setattr__(self, "branches", checked)
        object.__setattr__(self, "on", on)

    @property
    def size(self) -> int:
        """Number of entries of the signal."""
        return next(shape_of(value)[0] for terms in self.branches for value in terms.values())


@dataclass(frozen=True, eq=False)
class Evaluate:
    """signal := a quadratic form at a node (a scalar memory, for one); with ``on``, one form per outcome."""

    at: NodeName
    signal: str
    forms: tuple[Form, ...]
    on: Condition | None = None

    def __post_init__(self) -> None:
        if (self.on is None) != (len(self.forms) == 1):
            raise ProblemError(f"{self.signal} has {len(self.forms)} forms on {self.on}; expected one without a condition")


@dataclass(frozen=True, eq=False)
class Draw:
    """signal := a uniform draw in (0, 1) at a node; the peers do not see it."""

    at: NodeName
    signal: str


@dataclass(frozen=True, eq=False)
class Decide:
    """decision := the label that the trigger picks at a node."""

    at: NodeName
    decision: str
    trigger: Trigger


@dataclass(frozen=True, eq=False)
class Send:
    """A packet on a link; with ``on``, only if the decision is one of ``labels`` (omitted: any but the first)."""

    at: NodeName
    link: LinkName
    payload: tuple[str, ...]
    on: str | None = None
    labels: tuple[str, ...] = ()


Step: TypeAlias = Assign | Evaluate | Draw | Decide | Send


@dataclass(frozen=True, eq=False)
class Location:
    """A finite location: next = table[location], or table[location, outcome of ``on``].

    Args:
        name: by which tables refer to it.
        table: indices of the next location, (locations,) or (locations, outcomes).
        at: the node that owns it; omitted: a clock that every node shares.
        on: the condition that picks the column.
        initial: index at the first tick.
    """

    name: str
    table: npt.NDArray[np.int64]
    at: NodeName | None = None
    on: Condition | None = None
    initial: int = 0

    def __post_init__(self) -> None:
        table = np.array(self.table, dtype=np.int64)
        size = table.shape[0]
        if table.ndim != (1 if self.on is None else 2) or table.min() < 0 or table.max() >= size:
            raise ProblemError(f"location {self.name} has a table of shape {table.shape} with entries up to {table.max()}; "
                               f"expected indices below {size}, one column per outcome")  # fmt: skip
        if not 0 <= self.initial < size:
            raise ProblemError(f"location {self.name} starts at {self.initial}; expected an index below {size}")
        if self.on is not None and self.at is None:
            raise ProblemError(f"location {self.name} depends on {self.on} but has no node; expected the node that owns it")
        table.setflags(write=False)
        object.__setattr__(self, "table", table)


@dataclass(frozen=True)
class Guarantee:
    """A proved bound on the cost.

    Args:
        cost: number that the cost cannot exceed, in the units of the cost.
        statement: the theorem in one line.
        source: key in ``docs/sources.bib``.
        base: cost at which a bound that depends on the rate starts; omitted: no such bound.
        per_silence: what a tick without a send adds to ``base`` at most.
    """

    cost: float
    statement: str
    source: str
    base: float | None = None
    per_silence: float = 0.0

    def at_rate(self, rate: float) -> float | None:
        """Return the bound at a rate of sends per tick, or None where none is proved."""
        return None if self.base is None else self.base + self.per_silence * (1 - rate)


@dataclass(frozen=True, eq=False)
class Identity:
    """The exact identity cost = constant + E[form]: completion of squares, used as the estimator.

    Args:
        constant: what no decision changes, in the units of the cost.
        forms: one form, or one for each outcome of ``on``, evaluated at the end of a tick.
        on: the decision that picks the form.
    """

    constant: float
    forms: tuple[Form, ...]
    on: str | None = None


@dataclass(frozen=True, eq=False)
class Innovations:
    """Where the policy's filter whitens the measurement: then the loop can be run without the plant.

    Args:
        signal: the signal that is white with this covariance.
        covariance: S, (p, p).
        estimate: the signal whose error is independent of everything the policy knows.
        error_covariance: Σ, (n, n).
    """

    signal: str
    covariance: Array
    estimate: str
    error_covariance: Array


@dataclass(frozen=True)
class ClosedForm:
    """Cost and rates of a policy whose actions ignore the state, in the units of the cost and per tick."""

    cost: float
    rates: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Policy:
    """Nodes that exchange packets, as data: what each computes within a tick, in order.

    Args:
        kind: name in the catalogue.
        steps: what happens within a tick, in order.
        model: the discrete-time plant the policy was designed for.
        cost_all_time: cost of sending at every tick, in the units of the cost.
        scheduled: links whose rate the policy decides.
        sites: nodes that share a place and know what each other knows.
        locations: finite locations.
        initial: first value of a memory, by signal; omitted: 0.
        tick: seconds per tick; 1 where time is counted in steps.
        noise_cost: inter-sample noise cost per tick that no policy can change.
        network: the network it was designed for.
        prediction_gain: gain L of an actuator that runs the model continuously between ticks.
        guarantee, identity, innovations, closed_form: where the theory gives them.

    Raises:
        ProblemError: a signal without origin, or a matrix that does not fit.
    """

    kind: str
    steps: tuple[Step, ...]
    model: Plant
    cost_all_time: float
    scheduled: tuple[LinkName, ...] = ("actuator",)
    sites: tuple[frozenset[NodeName], ...] = ()
    locations: tuple[Location, ...] = ()
    initial: Mapping[str, Array] = field(default_factory=lambda: {})
    tick: float = 1.0
    noise_cost: float = 0.0
    network: Network = Network()
    prediction_gain: Array | None = None
    guarantee: Guarantee | None = None
    identity: Identity | None = None
    innovations: Innovations | None = None
    closed_form: ClosedForm | None = None
    sizes: Mapping[str, int] = field(init=False)

    def __post_init__(self) -> None:
        number("tick", self.tick, 0.0)
        sizes: dict[str, int] = {"y": self.model.outputs}
        for step in self.steps:
            if isinstance(step, Assign):
                if sizes.setdefault(step.signal, step.size) != step.size:
                    raise ProblemError(f"{step.signal} has {sizes[step.signal]} entries in one step and {step.size} in another")
            elif isinstance(step, Evaluate | Draw):
                sizes[step.signal] = 1
        object.__setattr__(self, "sizes", sizes)
        object.__setattr__(
            self, "initial", {name: array(f"initial {name}", value, (self._size(name),)) for name, value in self.initial.items()}
        )
        for step in self.steps:
            self._check(step)
        if sizes.get("input") != self.model.inputs:
            raise ProblemError(f"input has {sizes.get('input')} entries; expected {self.model.inputs}, assigned at the actuator")

    @property
    def decisions(self) -> Mapping[str, Trigger]:
        """The trigger of each decision."""
        return {step.decision: step.trigger for step in self.steps if isinstance(step, Decide)}

    def outcomes(self, condition: Condition) -> int:
        """Return the number of outcomes of a condition."""
        if not isinstance(condition, str):
            return 2
        if condition not in self.decisions:
            raise ProblemError(f"the condition {condition!r} is no decision; expected one of {list(self.decisions)}")
        return len(self.decisions[condition].labels)

    def site(self, node: NodeName) -> frozenset[NodeName]:
        """Return the nodes that share a place with this one."""
        return next((site for site in self.sites if node in site), frozenset({node}))

    def _size(self, name: str) -> int:
        if name not in self.sizes:
            raise ProblemError(f"the signal {name!r} is never assigned; expected one of {sorted(self.sizes)}")
        return self.sizes[name]

    def _check(self, step: Step) -> None:
        if isinstance(step, Assign | Evaluate) and step.on is not None:
            found = len(step.branches if isinstance(step, Assign) else step.forms)
            if found != self.outcomes(step.on):
                raise ProblemError(f"{step.signal} has {found} branches; expected {self.outcomes(step.on)}, one per outcome of {step.on}")
        if isinstance(step, Assign):
            for terms in step.branches:
                for name, value in terms.items():
                    rows, columns = shape_of(value)
                    if columns != self._size(name):
                        raise ProblemError(f"the weight of {name} in {step.signal} has shape {(rows, columns)}; "
                                           f"expected {(rows, self._size(name))}. Did you pass its transpose?")  # fmt: skip
        elif isinstance(step, Evaluate):
            for form in step.forms:
                self._check_form(form)
        elif isinstance(step, Decide):
            for form in step.trigger.options.values():
                self._check_form(form)
        elif isinstance(step, Send):
            for name in step.payload:
                self._size(name)
            if step.on is not None:
                self.outcomes(step.on)

    def _check_form(self, form: Form) -> None:
        size = sum(self._size(name) for name in form.signals)
        if form.Psi is not None and shape_of(form.Psi) != (size, size):
            raise ProblemError(f"Psi over {form.signals} has shape {shape_of(form.Psi)}; expected {(size, size)}")
        for name in form.plus:
            if self._size(name) != 1:
                raise ProblemError(f"{name} has {self._size(name)} entries; expected a scalar signal")
