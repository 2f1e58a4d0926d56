"""What reproducing a chapter of the thesis gives: tables of numbers, printed beside computed, and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from taciturn.model.estimate import Estimate

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Row:
    """One line of a table: what was set, what the thesis prints, what is computed.

    Args:
        setting: names and values that identify the line.
        printed: numbers of the thesis, by column; a missing column is not printed there.
        computed: ours, by column.
    """

    setting: Mapping[str, Any]
    printed: Mapping[str, float]
    computed: Mapping[str, Estimate]


@dataclass(frozen=True)
class Table:
    """A table or figure of the thesis.

    Args:
        name: as in the thesis.
        rows: its lines, or the points of a figure.
        notes: what explains the differences.
        headings: of columns that are shown by another name.
    """

    name: str
    rows: tuple[Row, ...]
    notes: tuple[str, ...]
    headings: Mapping[str, str] = field(default_factory=dict[str, str])


@dataclass(frozen=True)
class Reproduction:
    """The tables of a chapter and its pictures.

    Args:
        name: of the chapter.
        tables: its tables.
        pictures: its figures, by the name under which they are saved; figures over one axis share a picture.
    """

    name: str
    tables: tuple[Table, ...]
    pictures: Mapping[str, Figure]

    def document(self) -> dict[str, Any]:
        """Return the JSON document of one reproduction."""
        return {
            "name": self.name,
            "tables": [
                {
                    "name": table.name,
                    "rows": [
                        {
                            "setting": dict(row.setting),
                            "printed": dict(row.printed),
                            "computed": {key: found.document() for key, found in row.computed.items()},
                        }
                        for row in table.rows
                    ],
                    "notes": list(table.notes),
                }
                for table in self.tables
            ],
        }
