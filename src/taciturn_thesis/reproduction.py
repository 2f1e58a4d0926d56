"""Reproduction of a chapter of the thesis: tables of printed and computed numbers, and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import TYPE_CHECKING, Any, ClassVar

from taciturn.extend import number_of, percent, table_text, wrapped_text
from taciturn.model.estimate import Estimate
from taciturn.model.result import VERDICT, Columns, Field, Result, Tabular, plain_fields, seconds
from taciturn.problem import Problem

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _whole(computed: Mapping[str, Estimate]) -> dict[str, Any]:
    return {name: found.document() for name, found in computed.items()}


@dataclass(frozen=True, repr=False)
class Row(Result):
    """One row of a table: a setting, the numbers that the thesis prints for it, and the computed numbers.

    Args:
        setting: names and values that identify the line.
        printed: numbers of the thesis, by column; the thesis does not print missing columns.
        computed: computed numbers, by column.
    """

    setting: Mapping[str, Any] = field(hash=False)
    printed: Mapping[str, float] = field(hash=False)
    computed: Mapping[str, Estimate] = field(hash=False)

    FIELDS: ClassVar[tuple[Field[Row], ...]] = (Field("setting"), Field("printed"), Field("computed", json=_whole))


@dataclass(frozen=True, repr=False)
class Table(Tabular):
    """A table or figure of the thesis, with printed and computed numbers.

    Args:
        name: name in the thesis.
        rows: lines of the table, or points of a figure.
        notes: explanations of the differences.
        headings: headings of columns that are shown under another name.
    """

    FIELDS: ClassVar[tuple[Field[Table], ...]] = (*plain_fields("name", "rows", "notes"),)
    heading: ClassVar[tuple[str, ...]] = ("name", "notes")

    name: str
    rows: tuple[Row, ...]
    notes: tuple[str, ...]
    headings: Mapping[str, str] = field(hash=False, default_factory=dict[str, str])

    def __str__(self) -> str:
        """Return the table as text, with each published number next to the computed number."""
        return _published_text(self)

    def columns(self) -> Columns:
        """Return the columns of the table: the settings, and each printed number next to the computed one."""
        records: list[dict[str, object]] = []
        for row in self.rows:
            records.append(dict(row.setting))
            for key, computed in row.computed.items():
                records[-1] |= {f"{key}, printed": row.printed[key]} if key in row.printed else {}
                records[-1][key] = computed
        names = dict.fromkeys(name for record in records for name in record)
        return {name: [record.get(name) for record in records] for name in names}


@dataclass(frozen=True, repr=False)
class Reproduction(Result):
    """Tables and figures of one chapter of the thesis.

    Args:
        name: name of the chapter.
        tables: tables of the chapter.
        pictures: figures of the chapter, by the name under which they are saved; figures over the same axis share a
            picture.
        problems: problems that the chapter solves, each with the parameters of the tables.
        seconds: wall time of the computation.
    """

    FIELDS: ClassVar[tuple[Field[Reproduction], ...]] = (
        VERDICT,
        *plain_fields("name", "tables"),
        Field("seconds", json=seconds, say="time", text="{:.3g} s", part="method"),
    )

    name: str
    tables: tuple[Table, ...]
    pictures: Mapping[str, Figure] = field(hash=False)
    problems: Mapping[str, Problem] = field(hash=False)
    seconds: float = 0.0

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence that says how many numbers the thesis prints, and how much the computed ones differ from them."""
        rows = [row for table in self.tables for row in table.rows]
        pairs = [
            (row.printed[key], one.value) for row in rows for key, one in row.computed.items() if key in row.printed
        ]
        apart = [abs(computed / printed - 1) for printed, computed in pairs if printed]
        told = f"{self.name}: {number_of(len(self.tables), 'table')}, {number_of(len(pairs), 'printed number')}"
        if not apart:
            return (told,)
        middle, most = percent(median(apart), 2), percent(max(apart), 2)
        return (f"{told}; the computed ones differ by {middle} (median), by {most} at most",)

    def table_texts(self) -> Sequence[str]:
        """Return the tables, each with its title and its notes."""
        return [*map(str, self.tables)]

    def html(self) -> str:
        """Return the verdict and the tables as HTML."""
        return self._verdict() + "".join(table.html() for table in self.tables)


def _published_text(found: Table) -> str:
    """Return a table of published numbers next to computed numbers."""
    notes = [wrapped_text(note, "  ") for note in found.notes]
    return "\n".join([found.name, table_text(*_columns(found), len(found.rows[0].setting)), *notes])


def _columns(table: Table) -> tuple[list[str], list[list[str]]]:
    """Return header and rows, with each printed number next to the computed number."""
    columns = list(table.rows[0].computed)
    printed = [name for name in columns if any(name in row.printed for row in table.rows)]
    header = list(table.rows[0].setting)
    for name in columns:
        heading = table.headings.get(name, name)
        header += [f"{heading}, printed", "computed"] if name in printed else [heading]
    rows: list[list[str]] = []
    for row in table.rows:
        cells = [str(value) for value in row.setting.values()]
        for name in columns:
            if name in printed:
                cells.append(f"{row.printed[name]:g}" if name in row.printed else "")
            cells.append(str(row.computed[name]) if name in row.computed else "")
        rows.append(cells)
    return header, rows
