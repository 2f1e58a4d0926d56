"""Finite discrete states ("locations") that evolve by tables, and the common period of data-independent ones."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from taciturn._arrays import array
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.steps import Condition
from taciturn.model.trigger import Form, Scheduled, Trigger

LONGEST = 1_000_000  # steps for which several locations are followed jointly; longer cycles are not detected


@dataclass(frozen=True, eq=False, repr=False)
class Location(Displayed):
    """A discrete state (location), whose next value is table[location], or table[location, outcome of ``on``].

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
        """Steps after which the location repeats; 1 if the location depends on decisions or packets."""
        return joint_cycle([self], {})


def joint_cycle(locations: Iterable[Location], triggers: Mapping[str, Trigger]) -> int:
    """Return the number of steps after which all locations that are independent of data repeat.

    Such a location has no condition, has equal columns in every state that it reaches, or depends on a decision whose
    options are constants or tables selected by such locations. Other locations are ignored.

    Args:
        locations: the locations of a policy.
        triggers: the trigger of each decision, by name.
    """
    named = {location.name: location for location in locations}
    return math.lcm(*(_period(location, named, triggers) for location in named.values()))


def _period(location: Location, named: Mapping[str, Location], triggers: Mapping[str, Trigger]) -> int:
    """Return the number of steps after which a location repeats, or 1 if it depends on data."""
    deciding = _deciders(location, named, triggers)
    places = {one.name: one.initial for one in deciding}
    visited: dict[tuple[int, ...], int] = {}
    while (here := tuple(places.values())) not in visited:
        visited[here] = len(visited)
        following = {one.name: _next(one, places, triggers) for one in deciding}
        if None in following.values() or (len(deciding) > 1 and len(visited) > LONGEST):
            return 1
        places = {name: place for name, place in following.items() if place is not None}
    return len(visited) - visited[here]


def _deciders(location: Location, named: Mapping[str, Location], triggers: Mapping[str, Trigger]) -> list[Location]:
    """Return the location and the other locations that select the tables of its decisions."""
    found = [location]
    for one in found:
        trigger = triggers.get(one.on) if isinstance(one.on, str) else None
        constants = [] if trigger is None else [form.constant for form in trigger.options.values()]
        by = {constant.by for constant in constants if isinstance(constant, Scheduled)}
        found += [named[name] for name in sorted(by) if name in named and named[name] not in found]
    return found


def fixed_choices(decision: str, locations: Iterable[Location], triggers: Mapping[str, Trigger]) -> list[str] | None:
    """Return the labels that a decision selects until they repeat, twice, or None if they depend on data.

    Args:
        decision: name of the decision.
        locations: the locations of a policy.
        triggers: the trigger of each decision, by name.
    """
    trigger, named = triggers[decision], {location.name: location for location in locations}
    if trigger.reads or trigger.limit is not None:
        return None
    by = {form.constant.by for form in trigger.options.values() if isinstance(form.constant, Scheduled)}
    deciding = list(dict.fromkeys(one for name in sorted(by) for one in _deciders(named[name], named, triggers)))
    places, found, start = {one.name: one.initial for one in deciding}, list[str](), -1
    visited: dict[tuple[int, ...], int] = {}
    while start < 0 or len(found) < 2 * len(visited) - start:
        here = tuple(places.values())
        start = visited[here] if start < 0 and here in visited else start
        visited.setdefault(here, len(visited))
        values = [_constant(form, places) for form in trigger.options.values()]
        found.append(trigger.labels[values.index(min(values))])
        following = {one.name: _next(one, places, triggers) for one in deciding}
        if None in following.values() or len(visited) > LONGEST:
            return None
        places = {name: place for name, place in following.items() if place is not None}
    return found


def _next(location: Location, places: Mapping[str, int], triggers: Mapping[str, Trigger]) -> int | None:
    """Return the next index of a location, or None if it depends on data."""
    row = np.atleast_1d(location.table[places[location.name]])
    if (row == row[0]).all():
        return int(row[0])
    trigger = triggers.get(location.on) if isinstance(location.on, str) else None
    if trigger is None or trigger.reads:
        return None
    values = [_constant(form, places) for form in trigger.options.values()]
    return int(row[values.index(min(values))])


def _constant(form: Form, places: Mapping[str, int]) -> float:
    constant = form.constant
    return float(constant.values[places[constant.by]]) if isinstance(constant, Scheduled) else constant
