"""Text in at most 80 columns: pairs of name and value, and tables with wrapped headings."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

WIDTH = 80
NAME = 14  # least width of the names
SHORTEST = 8  # least width of a wrapped heading
GAP = "  "
Lines = list[tuple[str, str]]


def pairs_text(lines: Lines) -> str:
    """Return names and values, one pair per line; long values are wrapped with a hanging indent."""
    width = max([NAME, *(len(name) for name, _ in lines)])
    return "\n".join(line for name, text in lines for line in _hanging(f"{name:{width}s} ", text))


def table_text(header: Sequence[str], rows: Sequence[Sequence[str]], names: int = 0) -> str:
    """Return a table as text.

    Args:
        header: headings of the columns; long headings take several lines.
        rows: cells of each row.
        names: number of columns on the left that are aligned left, and repeated if the table is split.

    Returns:
        The table; if it is wider than 80 columns, it is split into several parts, one below the other.
    """
    columns = [[row[i] for row in rows] for i in range(len(header))]
    wrapped = [_wrapped(title, max(map(len, column), default=0)) for title, column in zip(header, columns, strict=True)]
    widths = [max(map(len, [*title, *column])) for title, column in zip(wrapped, columns, strict=True)]
    fixed = sum(widths[:names]) + len(GAP) * names
    parts: list[list[int]] = [[]]
    used = fixed
    for i in range(names, len(header)):
        if parts[-1] and used + widths[i] > WIDTH:
            parts.append([])
            used = fixed
        parts[-1].append(i)
        used += widths[i] + len(GAP)
    return "\n\n".join(_part([*range(names), *part], wrapped, columns, widths, names) for part in parts)


def wrapped_text(text: str, indent: str = "") -> str:
    """Return a text wrapped to at most 80 columns."""
    return "\n".join(_hanging(indent, text))


def per_unit(unit: str) -> str:
    """Return the unit of a cost as text: per step, per second, or in total for the unit ``"mission"``."""
    return "in total" if unit == "mission" else f"per {unit}"


def _part(
    chosen: Sequence[int], wrapped: list[list[str]], columns: list[list[str]], widths: list[int], names: int
) -> str:
    """Return the text of the chosen columns of a table."""
    tall = max(len(wrapped[i]) for i in chosen)
    titles = [[""] * (tall - len(wrapped[i])) + wrapped[i] for i in chosen]
    lines = zip(*(title + columns[i] for title, i in zip(titles, chosen, strict=True)), strict=True)
    return "\n".join(
        GAP.join(
            cell.ljust(widths[i]) if i < names else cell.rjust(widths[i]) for cell, i in zip(line, chosen, strict=True)
        ).rstrip()
        for line in lines
    )


def _wrapped(title: str, width: int) -> list[str]:
    """Return the lines of a heading that is wrapped to the width of its column."""
    return textwrap.wrap(title, max(width, SHORTEST), break_long_words=False, break_on_hyphens=False) or [""]


def _hanging(first: str, text: str) -> list[str]:
    """Return the lines of a text with a hanging indent; numbers and names are never broken."""
    indent = " " * len(first)
    return [
        line
        for paragraph, lead in zip(text.split("\n"), [first] + [indent] * text.count("\n"), strict=True)
        for line in textwrap.wrap(
            paragraph,
            WIDTH,
            initial_indent=lead,
            subsequent_indent=indent,
            break_long_words=False,
            break_on_hyphens=False,
        )
        or [lead.rstrip()]
    ]
