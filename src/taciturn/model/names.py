"""Names of a plant's states, inputs and outputs, with their units, such as ``level (cm)``.

A plant has one ``Names``, in which a label is a name with its unit in parentheses. ``labels`` gives the labels of a
role for text, tables and figures: those that are stated, and for other signals the usual ones, such as ``x1``. A label
that is only a unit in parentheses, ``(cm)``, adds it to the usual name. No number depends on names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from taciturn._arrays import Array, quoted
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.key import NO_KEY, stated_as

LONGEST = 40  # letters of a name with its unit
Role = Literal["states", "inputs", "outputs"]
LETTERS: Mapping[Role, str] = {"states": "x", "inputs": "u", "outputs": "y"}


@dataclass(frozen=True, repr=False)
class Names(Displayed):
    """Names of the states, inputs and outputs, for text, tables and figures. A name may end with a unit in parentheses.

    Args:
        outputs: names of the measured outputs, (p,); empty: those of the nodes, or y1, y2, ….
        inputs: names of the inputs, (m,); empty: those of the nodes, or u1, u2, ….
        states: names of the states, (n,); empty: x1, x2, ….

    Raises:
        ProblemError: a name is empty or too long.

    Example:
        >>> Names(outputs=("level (cm)",)).outputs
        ('level (cm)',)
        >>> Names.stated(outputs=["level"], units={"outputs": ["cm"]}).outputs
        ('level (cm)',)
    """

    outputs: tuple[str, ...] = field(default=(), metadata=stated_as(list[str] | None))
    inputs: tuple[str, ...] = field(default=(), metadata=stated_as(list[str] | None))
    states: tuple[str, ...] = field(default=(), metadata=NO_KEY)

    def __post_init__(self) -> None:
        """Check the names."""
        for role in LETTERS:
            names = getattr(self, role)
            for place, name in enumerate(names):
                _expect_printable(f"names.{role}[{place}]", name, "level (cm)")
            object.__setattr__(self, role, tuple(names))

    @classmethod
    def stated(
        cls,
        states: Sequence[str] = (),
        inputs: Sequence[str] = (),
        outputs: Sequence[str] = (),
        units: Mapping[Role, Sequence[str]] | None = None,
    ) -> Names:
        """Join names, which differ within a role, and units. The keys of messages are those of ``[plant]``."""
        found = dict[str, tuple[str, ...]]()
        for role, names in zip(LETTERS, (states, inputs, outputs), strict=True):
            key, kept = f"{role[:-1]}_names", (units or {}).get(role, ())
            for place, name in enumerate(names):
                _expect_printable(f"plant.{key}[{place}]", name, "level")
                if (first := list(map(_name_of, names)).index(_name_of(name))) < place:
                    raise ProblemError(
                        f"plant.{key}[{place}] is {quoted(name)}, as plant.{key}[{first}]; expected different names"
                    )
                if kept and unit_of(name)[1]:
                    raise ProblemError(
                        f"plant.{key}[{place}] is {quoted(name)}, and plant.units.{role} is given; expected a unit in "
                        "one of the two: remove it from the name"
                    )
            for place, unit in enumerate(kept):
                if unit:
                    _expect_printable(f"plant.units.{role}[{place}]", unit, "cm")
            if names and kept and len(names) != len(kept):
                raise ProblemError(
                    f"plant.units.{role} has {number_of(len(kept), 'entry')}; expected "
                    f"{number_of(len(names), 'entry')}, one for each of plant.{key}"
                )
            pairs = zip(names or [""] * len(kept), kept or [""] * len(names), strict=True)
            labels = [f"{name} ({unit})".strip() if unit else name for name, unit in pairs]
            for place, label in enumerate(labels):
                _expect_printable(f"plant.{key}[{place}] with its unit", label or "()", "level (cm)")
            found[role] = tuple(label or "()" for label in labels) if any(labels) else ()
        return cls(**found)

    def __bool__(self) -> bool:
        """Return whether any signal has a name or a unit."""
        return any(getattr(self, role) for role in LETTERS)

    def labels(self, role: Role, usual: Sequence[str]) -> list[str]:
        """Return the labels of signals, which are ``usual`` for those that have no name."""
        stated: tuple[str, ...] = getattr(self, role)
        named = [_joined(label, plain) for label, plain in zip(stated, usual, strict=False)]
        return [*named, *usual[len(named) :]]

    def numbered(self, role: Role, size: int) -> list[str]:
        """Return the labels of signals, which are x1, x2, … for those that have no name."""
        return self.labels(role, [f"{LETTERS[role]}{i + 1}" for i in range(size)])

    def told(self, role: Role, place: int) -> str:
        """Write the name of a signal after its number in a message, such as `` (level)``; empty without a name."""
        stated: tuple[str, ...] = getattr(self, role)
        name = _name_of(stated[place]) if place < len(stated) else ""
        return f" ({name})" if name else ""

    def document(self) -> dict[str, dict[str, list[str]]]:
        """Return names and units by role, for JSON; roles without names are left out."""
        found = dict[str, dict[str, list[str]]]()
        for role in LETTERS:
            if stated := getattr(self, role):
                pairs = [unit_of(label) for label in self.numbered(role, len(stated))]
                found[role] = {"names": [name for name, _ in pairs], "units": [unit for _, unit in pairs]}
        return found

    def lines(self) -> Iterator[tuple[str, str]]:
        """Yield the symbols of each role that has names, each with its label, as lines of text."""
        for role, letter in LETTERS.items():
            if stated := getattr(self, role):
                symbols = [f"{letter}{i + 1}" for i in range(len(stated))] if len(stated) > 1 else [letter]
                yield (
                    role,
                    ", ".join(
                        label if label.startswith(f"{symbol} (") else f"{symbol} {label}".strip()
                        for symbol, label in zip(symbols, self.labels(role, symbols), strict=True)
                    ),
                )

    def quantities(self, rows: Array, C: Array) -> tuple[str, ...]:
        """Return labels of combinations z = (rows) x of the states, with the unit that all their states have."""
        shown = self.numbered("states", rows.shape[1])
        outputs = self.labels("outputs", [""] * len(C)) if self.outputs else []
        found = list[str]()
        for row in rows:
            measured = [i for i in range(len(outputs)) if np.array_equal(row, C[i]) and _name_of(outputs[i])]
            if measured:
                found.append(outputs[measured[0]])
                continue
            text, unit = combined(row, [unit_of(label)[0] for label in shown]), ""
            if not {abs(weight) for weight in row.tolist() if weight} - {1.0}:  # a sum has the unit of its states
                unit = common_unit([shown[i] for i in np.flatnonzero(row).tolist()])
            found.append(f"{text} ({unit})" if unit else text)
        return tuple(found)

    def expect(self, outputs: int, inputs: int, states: int) -> None:
        """Check that names are given for all signals of a role, or for none.

        Raises:
            ProblemError: there are more or fewer names.
        """
        sizes = {"outputs": outputs, "inputs": inputs, "states": states}
        for role, size in sizes.items():
            names: tuple[str, ...] = getattr(self, role)
            if names and len(names) != size:
                raise ProblemError(
                    f"names.{role} has {number_of(len(names), 'entry')}; expected {number_of(size, 'entry')}, one "
                    f"for each of the {role}"
                )


def of_labels(found: Mapping[Role, Sequence[str]]) -> Names | None:
    """Return the names of signals with labels from another program; a role has none if a label is no name here."""
    kept = dict[str, tuple[str, ...]]()
    for role, labels in found.items():
        usual = [f"{LETTERS[role]}[{i}]" for i in range(len(labels))]
        good = all(label.strip() and len(label) <= LONGEST and label.isprintable() for label in labels)
        kept[role] = tuple(labels) if good and [*labels] != usual else ()
    return Names(**kept) if any(kept.values()) else None


def combined(row: Array, names: Sequence[str]) -> str:
    """Write a combination of signals as text, such as ``2 x1 − x2``."""
    text = ""
    for i in np.flatnonzero(row).tolist():
        size = "" if abs(row[i]) == 1 else f"{abs(row[i]):.4g} "
        sign = ("−" if row[i] < 0 else "") if not text else (" − " if row[i] < 0 else " + ")
        text += f"{sign}{size}{names[i]}"
    return text


def unit_of(name: str) -> tuple[str, str]:
    """Split a name such as ``level (cm)`` into the name and its unit. The unit is empty if the name has none."""
    words, opened, unit = name.removesuffix(")").rpartition(" (")
    return (words, unit) if opened and name.endswith(")") else (name, "")


def common_unit(names: Sequence[str]) -> str:
    """Return the unit of all names if it is the same; otherwise, an empty text."""
    units = {unit_of(name)[1] for name in names}
    return units.pop() if len(units) == 1 else ""


def _only_unit(label: str) -> bool:
    return label.startswith("(") and label.endswith(")")


def _name_of(label: str) -> str:
    """Return the name in a label; it is empty if the label is only a unit."""
    return "" if _only_unit(label) else unit_of(label)[0]


def _joined(label: str, usual: str) -> str:
    """Return a label, with the usual name before a unit alone."""
    if not _only_unit(label):
        return label
    return usual if label == "()" else f"{usual} {label}".strip()


def _expect_printable(key: str, name: str, example: str) -> None:
    if not name.strip() or len(name) > LONGEST or not name.isprintable():
        raise ProblemError(f"{key} is {quoted(name)}; expected 1 to {LONGEST} characters, such as '{example}'")
