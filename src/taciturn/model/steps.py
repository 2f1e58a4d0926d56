"""Policy steps as data: what nodes compute, decide and send within a sampling step.

A policy is a list of these steps. A node assigns sums Σ matrix·signal (``Assign``), quadratic forms (``Evaluate``),
results of functions (``Apply``) and random thresholds (``Draw``); it decides by a trigger (``Decide``), and sends
packets (``Send``). A condition selects a branch of an assignment: the label of a decision, or whether a packet arrived
(``Received``), was acknowledged (``Acknowledged``), or acted in a piece of the step (``Acted``).

A ``Location`` is a finite discrete state that evolves by a table, such as the phase of a schedule. Matrices and numbers
of the steps may depend on it. A location is independent of data if it has no condition, if all columns of its table
agree where it passes, or if its decision compares constants that locations of this kind select. Then its places in all
steps are known in advance (``walk``), and so are the choices of such decisions (``fixed_choices``) and the steps after
which everything repeats (``joint_cycle``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from taciturn._arrays import ArrayLike, array, count, quoted
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger, matrix, shape_of

ONE = "one"


@dataclass(frozen=True, repr=False)
class Received(Displayed):
    """The condition "a packet arrived on this link", which the receiving node can check.

    With ``oldest``, the outcomes are the ages of the newest packet that arrives: none, sent in this step, sent one step
    ago, …, sent ``oldest`` steps ago. The signals of the packet have the values with which it was sent.

    With ``of_age``, the condition is that the packet of this age arrives in this step, even if a newer one has arrived:
    on such a link, the receiver uses all packets, and newer ones overtake none.
    """

    link: str
    oldest: int | None = None  # largest age in steps that the receiver tells apart; None: it does not know the age
    of_age: int | None = None  # steps since the packet was sent; None: the newest packet that arrives

    @property
    def outcomes(self) -> int:
        """Number of outcomes of the condition."""
        return 2 + (self.oldest or 0)


@dataclass(frozen=True, repr=False)
class Acknowledged(Displayed):
    """The condition "my packet on this link arrived", which a sender can check if the network acknowledges packets."""

    link: str


@dataclass(frozen=True, repr=False)
class Acted(Displayed):
    """The condition "my packet of this age arrived in this step, before a piece of it ended".

    A sender can check it at the end of a step, if packets arrive after random delays and the receiver sends
    acknowledgements with the time of arrival. If these are one step late, it refers to arrivals in the step before.
    """

    link: str
    age: int  # steps since the packet was sent
    piece: int  # the pieces of a period begin where a packet may arrive


Condition: TypeAlias = str | Received | Acknowledged | Acted  # a string is the name of a decision
Terms: TypeAlias = Mapping[str, Matrix]


@dataclass(frozen=True, eq=False, repr=False)
class Assign(Displayed):
    """Policy step signal := Σ matrix·signal at a node. With ``on``, there is one sum for each outcome of a condition.

    Args:
        at: the node that computes the sum.
        signal: name of the assigned signal.
        branches: a mapping {signal: matrix}, or one per outcome: (not arrived, arrived), one for each age of a packet
            after that of no packet, or one for each label.
        on: the condition that selects the branch.
    """

    at: str
    signal: str
    branches: tuple[Terms, ...]
    on: Condition | None = None

    def __init__(
        self,
        at: str,
        signal: str,
        branches: Mapping[str, ArrayLike | Scheduled] | tuple[Mapping[str, ArrayLike | Scheduled], ...],
        on: Condition | None = None,
    ) -> None:
        """Validate and store the arguments."""
        listed = (branches,) if isinstance(branches, Mapping) else branches
        checked = tuple(
            {name: matrix(f"the weight of {name} in {signal}", value) for name, value in terms.items()}
            for terms in listed
        )
        if (on is None) != (len(checked) == 1):
            raise ProblemError(
                f"the step that computes {signal} has {number_of(len(checked), 'branch')} and the condition {on}; "
                "expected one branch without a condition, or several branches that depend on a condition"
            )
        rows = {shape_of(value)[0] for terms in checked for value in terms.values()}
        if len(rows) != 1:
            raise ProblemError(
                f"the matrices that compute {signal} have {sorted(rows)} rows; expected equal numbers of rows"
            )
        object.__setattr__(self, "at", at)
        object.__setattr__(self, "signal", signal)
        object.__setattr__(self, "branches", checked)
        object.__setattr__(self, "on", on)

    @property
    def size(self) -> int:
        """Number of entries of the signal that is assigned."""
        return next(shape_of(value)[0] for terms in self.branches for value in terms.values())


@dataclass(frozen=True, eq=False, repr=False)
class Evaluate(Displayed):
    """Policy step that evaluates a quadratic form at a node. With ``on``, each outcome of a condition has its form."""

    at: str
    signal: str
    forms: tuple[Form, ...]
    on: Condition | None = None

    def __post_init__(self) -> None:
        """Check the number of forms."""
        if (self.on is None) != (len(self.forms) == 1):
            raise ProblemError(
                f"the step that computes {self.signal} has {number_of(len(self.forms), 'form')} and the condition "
                f"{self.on}; expected one form without a condition, or several forms that depend on a condition"
            )


@dataclass(frozen=True, eq=False, repr=False)
class Apply(Displayed):
    """Policy step that evaluates a nonlinear function of signals at a node, such as an extended Kalman filter.

    The function is NumPy code. It is traced once into the operations that run in simulation, in nodes and on devices,
    so it must use ``np.where`` instead of ``if``.

    Args:
        at: the node that computes the function.
        signals: number of entries of each result, by name.
        function: function with one vector parameter for each signal in ``reads``; it returns a vector, or a tuple of
            vectors for several results.
        reads: names of the signals passed to the function. A signal that is assigned later in the step, or by this
            function, has its value of the previous step.

    Raises:
        ProblemError: if there are no results, a result has no entries, ``function`` is not callable, or ``reads`` is
            empty.

    Example:
        >>> import numpy as np
        >>> Apply("controller", {"command": 1}, lambda estimate: -np.tanh(estimate[:1]), ("estimate",)).reads
        ('estimate',)
    """

    at: str
    signals: Mapping[str, int]
    function: Callable[..., object]
    reads: tuple[str, ...]

    def __post_init__(self) -> None:
        """Validate and store the arguments."""
        if not self.signals:
            raise ProblemError(
                f"a function at the node {self.at} has no results; expected the signals that it computes, and their "
                "sizes"
            )
        names = ", ".join(self.signals)
        if not callable(self.function):
            raise ProblemError(
                f"the function that computes {names} is {quoted(self.function)}; expected a Python function"
            )
        if isinstance(self.reads, str) or not self.reads:
            raise ProblemError(
                f"the function that computes {names} reads {self.reads!r}; expected a tuple with at least one signal"
            )
        sizes = {name: count(f"the number of entries of {name}", size) for name, size in self.signals.items()}
        object.__setattr__(self, "signals", sizes)
        object.__setattr__(self, "reads", tuple(self.reads))


@dataclass(frozen=True, eq=False, repr=False)
class Draw(Displayed):
    """Policy step that draws an exponential random number ξ with mean 1 at a node; other nodes do not know ξ.

    A trigger that compares a form q with ξ stays silent with probability e^{−q}.
    """

    at: str
    signal: str


@dataclass(frozen=True, eq=False, repr=False)
class Decide(Displayed):
    """Policy step in which a node decides: its trigger selects one of several labels."""

    at: str
    decision: str
    trigger: Trigger


@dataclass(frozen=True, eq=False, repr=False)
class Send(Displayed):
    """Policy step that sends a packet on a link; with ``on``, only if the decision selects one of ``labels``."""

    at: str
    link: str
    payload: tuple[str, ...]
    on: str | None = None
    labels: tuple[str, ...] = ()

    def sending(self, labels: tuple[str, ...]) -> tuple[str, ...]:
        """Return those labels of the decision with which a packet is sent."""
        return self.labels or labels[1:]


Step: TypeAlias = Assign | Evaluate | Apply | Draw | Decide | Send


def site_of(node: str, sites: Sequence[frozenset[str]]) -> frozenset[str]:
    """Return all nodes at the site of a node. A node that is in none of the ``sites`` is alone."""
    return next((site for site in sites if node in site), frozenset({node}))


def condition_of(step: Step) -> Condition | None:
    """Return the condition that selects a branch of a policy step; None if the step has only one."""
    return step.on if isinstance(step, Assign | Evaluate) else None


def hears(on: Condition | None, link: str) -> bool:
    """Return whether a condition is that a packet arrives on a link."""
    return isinstance(on, Received) and on.link == link


def uses_every_packet(steps: Iterable[Step], link: str) -> bool:
    """Return whether the receiver of a link uses the packet of each age, and not only the newest one."""
    conditions = (condition_of(step) for step in steps)
    return any(isinstance(on, Received) and on.link == link and on.of_age is not None for on in conditions)


def assigned(step: Step) -> Mapping[str, int]:
    """Return the signals that a policy step assigns, each with its number of entries."""
    if isinstance(step, Assign):
        return {step.signal: step.size}
    if isinstance(step, Evaluate | Draw):
        return {step.signal: 1}
    return step.signals if isinstance(step, Apply) else {}


def read(step: Step) -> list[str]:
    """Return the names of the signals that a policy step reads, in their order."""
    if isinstance(step, Assign):
        return [name for terms in step.branches for name in terms]
    if isinstance(step, Evaluate):
        return [name for form in step.forms for name in form.reads]
    if isinstance(step, Apply | Send):
        return list(step.reads if isinstance(step, Apply) else step.payload)
    return list(step.trigger.reads) if isinstance(step, Decide) else []


LONGEST = 1_000_000  # steps for which several locations are followed jointly; longer cycles are not detected


@dataclass(frozen=True, eq=False, repr=False)
class Location(Displayed):
    """A discrete state, such as a step counter. Its next value is table[state], or table[state, outcome of ``on``].

    Args:
        name: name by which tables refer to the location.
        table: index of the next state, (locations,) or (locations, outcomes).
        at: the node that owns the location; if omitted, the location is a step counter that all nodes share.
        on: the condition whose outcome selects the column.
        initial: index at the first step.
    """

    name: str
    table: npt.NDArray[np.int64]
    at: str | None = None
    on: Condition | None = None
    initial: int = 0

    def __post_init__(self) -> None:
        """Validate and store the arguments."""
        shape, meaning = ((None,), "(locations,)") if self.on is None else ((None, None), "(locations, outcomes)")
        table = array(f"the table of location {self.name}", self.table, shape, meaning)
        size = table.shape[0]
        if not table.size or table.min() < 0 or table.max() >= size or (table != np.floor(table)).any():
            extremes = f"entries from {table.min():g} to {table.max():g}" if table.size else "no entries"
            raise ProblemError(
                f"the table of location {self.name} has {extremes}; expected integers that are at least 0 and below "
                f"{size}"
            )
        if not 0 <= self.initial < size:
            raise ProblemError(
                f"location {self.name} starts at {self.initial}; expected an integer that is at least 0 and below "
                f"{size}"
            )
        if self.on is not None and self.at is None:
            raise ProblemError(
                f"location {self.name} depends on {self.on} but has no node; expected the node at which the location "
                "changes (at)"
            )
        indices = table.astype(np.int64)
        indices.setflags(write=False)
        object.__setattr__(self, "table", indices)

    @property
    def period(self) -> int:
        """Number of steps after which the discrete state repeats; 1 if it depends on decisions or packets."""
        return joint_cycle([self], {})


def joint_cycle(locations: Iterable[Location], triggers: Mapping[str, Trigger]) -> int:
    """Return the number of steps after which all discrete states that do not depend on data repeat together.

    A location does not depend on data if it has no condition, has equal columns in every state that it reaches, or
    depends on a decision whose options are constants or tables selected by such locations. Other locations are ignored.
    """
    named = {location.name: location for location in locations}
    return math.lcm(*(_period(location, named, triggers) for location in named.values()))


def _period(location: Location, named: Mapping[str, Location], triggers: Mapping[str, Trigger]) -> int:
    """Return the number of steps after which a location repeats, or 1 if it depends on data."""
    walked = walk(_deciders(location, named, triggers), triggers)
    return 1 if walked is None else len(walked[0]) - walked[1]


def walk(locations: Sequence[Location], triggers: Mapping[str, Trigger]) -> tuple[list[tuple[int, ...]], int] | None:
    """Return the values of discrete states until they repeat, and from which step they do; None if data decide."""
    here = tuple(one.initial for one in locations)
    visited: dict[tuple[int, ...], int] = {}
    while here not in visited:
        visited[here] = len(visited)
        places = placed(locations, here)
        following = [_next(one, places, triggers) for one in locations]
        if None in following or (len(locations) > 1 and len(visited) > LONGEST):
            return None
        here = tuple(place for place in following if place is not None)
    return list(visited), visited[here]


def placed(locations: Iterable[Location], here: Iterable[int]) -> Mapping[str, int]:
    """Return the values of the discrete states, by name."""
    return {one.name: place for one, place in zip(locations, here, strict=True)}


def _next(location: Location, places: Mapping[str, int], triggers: Mapping[str, Trigger]) -> int | None:
    """Return the next index of a location, or None if it depends on data."""
    row = np.atleast_1d(location.table[places[location.name]])
    if (row == row[0]).all():
        return int(row[0])
    trigger = triggers.get(location.on) if isinstance(location.on, str) else None
    return None if trigger is None or trigger.reads else int(row[option_at(trigger, places)])


def option_at(trigger: Trigger, places: Mapping[str, int]) -> int:
    """Return the index of the label that a trigger with constant forms selects for given values of discrete states."""
    constants = [form.constant for form in trigger.options.values()]
    values = [float(c.values[places[c.by]]) if isinstance(c, Scheduled) else c for c in constants]
    return values.index(min(values))


def _deciders(location: Location, named: Mapping[str, Location], triggers: Mapping[str, Trigger]) -> list[Location]:
    """Return the location and the other locations that select the tables of its decisions."""
    found = [location]
    for one in found:
        trigger = triggers.get(one.on) if isinstance(one.on, str) else None
        by = set[str]() if trigger is None else trigger.selected_by
        found += [named[name] for name in sorted(by) if name in named and named[name] not in found]
    return found


def fixed_choices(decision: str, locations: Iterable[Location], triggers: Mapping[str, Trigger]) -> list[str] | None:
    """Return the labels that a decision selects, until the end of the second period; None if data decide."""
    trigger, named = triggers[decision], {location.name: location for location in locations}
    if trigger.reads or trigger.limit is not None:
        return None
    found = (_deciders(named[name], named, triggers) for name in sorted(trigger.selected_by))
    deciding = list(dict.fromkeys(chain.from_iterable(found)))
    if (walked := walk(deciding, triggers)) is None:
        return None
    visited, start = walked
    labels = [trigger.labels[option_at(trigger, placed(deciding, here))] for here in visited]
    return labels + labels[start:]
