"""Names of the values that go into and come out of a program, as keys with typed parts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeAlias, TypeGuard

from taciturn.model.steps import Acknowledged, Received


@dataclass(frozen=True)
class Entry:
    """An entry of a signal.

    Args:
        signal: the signal, or a kind of random number.
        index: number of the entry, from 0.
        link: link whose packet contains the signal; None for a signal of the node itself.
    """

    signal: str
    index: int
    link: str | None = None


@dataclass(frozen=True)
class Sent:
    """Whether a packet is sent on a link: 1 or 0."""

    link: str


@dataclass(frozen=True)
class Option:
    """The value of the form of an option in a trigger, by the decision and the label of the option."""

    decision: str
    label: str


@dataclass(frozen=True)
class StepCounter:
    """The value of a location that changes at each step without a condition, such as the phase of a schedule."""

    location: str


@dataclass(frozen=True)
class Control:
    """A control variate: the product of normal number ``normal`` of a step and a state, or another normal number."""

    normal: int
    other: int | Entry


# A string names a single number. ``Received`` and ``Acknowledged`` name whether a packet arrived.
Name: TypeAlias = str | Entry | Sent | Received | Acknowledged | Option | StepCounter | Control
Named: TypeAlias = Mapping[Name, int]  # operations by name


def named(signal: str, values: Iterable[int], link: str | None = None) -> dict[Name, int]:
    """Return the operations that compute the entries of a signal, by name."""
    return {Entry(signal, i, link): value for i, value in enumerate(values)}


def is_entry(name: Name, *signals: str) -> TypeGuard[Entry]:
    """Return whether a name is that of an entry of one of the given signals."""
    return isinstance(name, Entry) and name.link is None and name.signal in signals


def text_of(name: Name) -> str:
    """Return a name as text, for the description of a policy's nodes."""
    if isinstance(name, Entry):
        return " ".join(filter(None, (name.link, name.signal, str(name.index))))
    if isinstance(name, Sent):
        return f"sent {name.link}"
    if isinstance(name, Received):
        return f"arrived {name.link}"
    if isinstance(name, Acknowledged):
        return f"acknowledged {name.link}"
    if isinstance(name, Option):
        return f"option {name.decision} {name.label}"
    if isinstance(name, StepCounter):
        return f"at {name.location}"
    return str(name)
