"""Names of a plant's outputs and inputs, with units, for the labels of figures, such as ``level (cm)``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from taciturn._arrays import quoted
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.key import stated_as

LONGEST = 40  # letters of a name


@dataclass(frozen=True, repr=False)
class Names(Displayed):
    """Names of the outputs and inputs, for labels in figures. A name may end with a unit in parentheses.

    Args:
        outputs: names of the measured outputs, (p,); empty: those of the nodes, or y1, y2, ….
        inputs: names of the inputs, (m,); empty: those of the nodes, or u1, u2, ….

    Raises:
        ProblemError: a name is empty or too long.

    Example:
        >>> Names(outputs=("level (cm)",)).outputs
        ('level (cm)',)
    """

    outputs: tuple[str, ...] = field(default=(), metadata=stated_as(list[str] | None))
    inputs: tuple[str, ...] = field(default=(), metadata=stated_as(list[str] | None))

    def __post_init__(self) -> None:
        """Check the names."""
        for role, names in (("outputs", self.outputs), ("inputs", self.inputs)):
            for place, name in enumerate(names):
                if not name.strip() or len(name) > LONGEST or not name.isprintable():
                    raise ProblemError(
                        f"names.{role}[{place}] is {quoted(name)}; expected 1 to {LONGEST} characters, such as 'level "
                        "(cm)'"
                    )
            object.__setattr__(self, role, tuple(names))

    def fitting(self, outputs: int, inputs: int) -> Mapping[str, tuple[str, ...]]:
        """Return the names of the outputs and of the inputs, if there are as many as the plant has."""
        both = ("outputs", self.outputs, outputs), ("inputs", self.inputs, inputs)
        return {role: names for role, names, size in both if len(names) == size}

    def expect(self, outputs: int, inputs: int) -> None:
        """Check that names are given for all measured outputs or none, and for all inputs or none.

        Raises:
            ProblemError: there are more or fewer names.
        """
        for role, names, size in (("outputs", self.outputs, outputs), ("inputs", self.inputs, inputs)):
            if names and len(names) != size:
                raise ProblemError(
                    f"names.{role} has {number_of(len(names), 'entry')}; expected {number_of(size, 'entry')}, one "
                    f"for each of the {role}"
                )


def unit_of(name: str) -> tuple[str, str]:
    """Split a name such as ``level (cm)`` into the name and its unit. The unit is empty if the name has none."""
    words, opened, unit = name.removesuffix(")").rpartition(" (")
    return (words, unit) if opened and name.endswith(")") else (name, "")


def common_unit(names: Sequence[str]) -> str:
    """Return the unit of all names if it is the same; otherwise, an empty text."""
    units = {unit_of(name)[1] for name in names}
    return units.pop() if len(units) == 1 else ""
