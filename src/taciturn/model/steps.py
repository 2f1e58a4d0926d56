"""The steps of a policy: what its nodes compute, decide and send within a tick, as data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from taciturn._arrays import ArrayLike, count, quoted
from taciturn.errors import ProblemError
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger, matrix, shape_of

NodeName = Literal["sensor", "controller", "actuator"]
LinkName = Literal["sensor", "actuator"]
NODES: tuple[NodeName, ...] = ("sensor", "controller", "actuator")
ONE = "one"
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
        """Check and freeze."""
        listed = (branches,) if isinstance(branches, Mapping) else branches
        checked = tuple(
            {name: matrix(f"the weight of {name} in {signal}", value) for name, value in terms.items()}
            for terms in listed
        )
        if (on is None) != (len(checked) == 1):
            raise ProblemError(
                f"{signal} has {len(checked)} branches on {on}; expected one without a condition, several with one"
            )
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
        """Check the number of forms."""
        if (self.on is None) != (len(self.forms) == 1):
            raise ProblemError(
                f"{self.signal} has {len(self.forms)} forms on {self.on}; "
                "expected one without a condition, several with one"
            )


@dataclass(frozen=True, eq=False)
class Apply:
    """signals := function(signals) at a node: what is not linear, such as an extended Kalman filter.

    The function is NumPy code, traced once into the operations that run in simulation, in nodes and on devices: a
    choice is ``np.where`` and no ``if``.

    Args:
        at: the node that computes.
        signals: entries of each result, by name.
        function: of the vectors that are read, one parameter each; it returns a vector, or a tuple where there are
            several results.
        reads: signals that it is given; one that is assigned later in the tick, or by itself, is that of the tick
            before.

    Raises:
        ProblemError: no results, a result without entries, no function, or nothing to read.

    Example:
        >>> import numpy as np
        >>> Apply("controller", {"command": 1}, lambda estimate: -np.tanh(estimate[:1]), ("estimate",)).reads
        ('estimate',)
    """

    at: NodeName
    signals: Mapping[str, int]
    function: Callable[..., object]
    reads: tuple[str, ...]

    def __post_init__(self) -> None:
        """Check and freeze."""
        if not self.signals:
            raise ProblemError(f"a function at {self.at} has no results; expected signals, each with its entries")
        names = ", ".join(self.signals)
        if not callable(self.function):
            raise ProblemError(f"the function of {names} is {quoted(self.function)}; expected a function")
        if isinstance(self.reads, str) or not self.reads:
            raise ProblemError(
                f"the function of {names} reads {self.reads!r}; expected a tuple of signals, at least one"
            )
        sizes = {name: count(f"the number of entries of {name}", size) for name, size in self.signals.items()}
        object.__setattr__(self, "signals", sizes)
        object.__setattr__(self, "reads", tuple(self.reads))


@dataclass(frozen=True, eq=False)
class Draw:
    """signal := a draw ξ of the exponential law of mean 1 at a node; the peers do not see it.

    A trigger that compares a form q with ξ keeps silent with the probability e^{−q}.
    """

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


Step: TypeAlias = Assign | Evaluate | Apply | Draw | Decide | Send


def assigned(step: Step) -> Mapping[str, int]:
    """Return the entries of each signal that a step assigns, by name."""
    if isinstance(step, Assign):
        return {step.signal: step.size}
    if isinstance(step, Evaluate | Draw):
        return {step.signal: 1}
    return step.signals if isinstance(step, Apply) else {}


def read(step: Step) -> list[str]:
    """Return the signals that a step reads, in order."""
    if isinstance(step, Assign):
        return [name for terms in step.branches for name in terms]
    if isinstance(step, Evaluate):
        return [name for form in step.forms for name in form.reads]
    if isinstance(step, Apply | Send):
        return list(step.reads if isinstance(step, Apply) else step.payload)
    return list(step.trigger.reads) if isinstance(step, Decide) else []
