"""Delimited text: a heading with the names of the columns, and a row for each packet.

The delimiter is the tab, the semicolon or the comma that occurs most often in the heading. Cells may be quoted. With
another delimiter than the comma, the decimal mark may be a comma; nothing depends on the locale. Names of columns are
compared in lower case. A number is written in ASCII digits, with an optional exponent; NaN and infinite numbers are
refused, since an empty cell means that a packet was lost.

Every message names the file and the line, so that a user finds the cell in an editor.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, number_of, quoted

NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,4})?")
_DELIMITERS = "\t;,"
_MOST = 1e12  # of a number, so that squares and sums are finite; as seconds since 1970 it is far in the future


@dataclass(frozen=True, repr=False)
class Table(Displayed):
    """The cells of a table, by rows, with the line of the file on which each row ends."""

    path: Path
    names: tuple[str, ...]
    rows: list[list[str]] = field(hash=False)
    lines: list[int] = field(hash=False)
    decimal_comma: bool

    def where(self, row: int) -> str:
        """Name a row for an error message."""
        return f"line {self.lines[row]} of {str(self.path)!r}"

    def column(self, name: str) -> list[str]:
        """Return the cells of a column, without surrounding spaces."""
        index = self.names.index(name)
        return [row[index].strip() for row in self.rows]

    def numbers(self, name: str, low: float = 0.0, *, lost: bool = False, row_names: str = "") -> list[float]:
        """Return the numbers of a column that are at least ``low``; with ``lost``, an empty cell gives infinity."""
        return [self.number(i, name, cell, low, lost) for i, cell in enumerate(self.column(name))]

    def number(self, row: int, name: str, cell: str, low: float, lost: bool = False) -> float:
        """Return the number in a cell."""
        if lost and not cell:
            return math.inf
        low = max(low, -_MOST)
        text = cell.replace(",", ".") if self.decimal_comma else cell
        found = float(text) if NUMBER.fullmatch(text) else math.nan
        if not low <= found <= _MOST:
            empty = ", or an empty cell for a dropped packet" if lost else ""
            raise ProblemError(
                f"{name} in {self.where(row)} is {quoted(cell)}; expected a number from {low:g} to {_MOST:g}{empty}: "
                "correct the line, or remove it"
            )
        return found


def heading(text: str) -> tuple[str, tuple[str, ...]]:
    """Return the delimiter of a table and the names of its columns, as its first line states them."""
    first = next((line for line in text.split("\n", 100) if line.strip()), "")
    delimiter = max(_DELIMITERS, key=first.count)
    cells = next(csv.reader([first[:10_000]], delimiter=delimiter), list[str]())
    return delimiter, tuple(cell.strip().lower() for cell in cells)


def read_table(path: Path, text: str) -> Table:
    """Read delimited text."""
    delimiter, names = heading(text)
    if len(set(names)) < len(names):
        raise ProblemError(
            f"the heading of {str(path)!r} has a name twice: {', '.join(names)}; expected different names of the "
            "columns: rename one"
        )
    rows, lines = list[list[str]](), list[int]()
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                if rows and len(row) != len(names):
                    raise ProblemError(
                        f"line {reader.line_num} of {str(path)!r} has {number_of(len(row), 'cell')}; expected "
                        f"{len(names)}, as the heading {quoted(delimiter.join(names))}: quote cells that contain the "
                        "delimiter, and with decimal commas separate the columns by semicolons"
                    )
                rows.append(row)
                lines.append(reader.line_num)
    except csv.Error as error:
        raise ProblemError(
            f"line {reader.line_num} of {str(path)!r} is no row of a table ({error}); expected cells separated by "
            f"{quoted(delimiter)}: correct the line"
        ) from None
    if len(rows) < 2:
        raise ProblemError(
            f"the table {str(path)!r} has a heading and no rows; expected a row for each packet: measure again"
        )
    return Table(path, names, rows[1:], lines[1:], delimiter != ",")


def first_of(names: Iterable[str], wanted: Iterable[str]) -> str | None:
    """Return the first wanted name that is among the names; None if there is none."""
    there = set(names)
    return next((name for name in wanted if name in there), None)


def expect_column(table: Table, name: str | None, known: Iterable[str], what: str) -> str:
    """Return the name of a column that is stated, or is the first known one in a table."""
    found = first_of(table.names, known if name is None else (name.strip().lower(),))
    if found is None:
        stated = f"the column {quoted(name)}" if name is not None else f"a column of the {what}"
        raise ProblemError(
            f"the table {str(table.path)!r} does not have {stated}; expected the name of the {what} among its columns "
            f"{', '.join(table.names)}"
        )
    return found
