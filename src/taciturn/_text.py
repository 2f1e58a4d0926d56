"""Text that fits the width of the terminal: lists of names and values, tables with wrapped headings, percentages."""

from __future__ import annotations

import math
import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Decimal
from itertools import zip_longest
from pathlib import Path

NARROWEST, PLAIN, WIDEST = 40, 80, 120  # columns: of a terminal at least, of a file or a pipe, of a terminal at most
_NAME = 14  # least width of the names
_SHORTEST, _HEADING = 8, 16  # least and largest width of a heading; longer headings take several lines
_LONGEST_NAME = 28  # largest width of a column of names; longer names take several lines
_SMALL, LARGE = 1e-4, 1e6  # numbers below and from here on have an exponent
_FINE = 1e-9  # relative errors up to here are rounding errors, and are not printed
_ROUNDED = 12  # digits of a number that are not affected by rounding errors
_PROVED = 8  # digits of a percentage that are not affected by the radius of a proved number
_GAP = "  "
_FIXED = "\N{NO-BREAK SPACE}"
Lines = list[tuple[str, str]]


def width() -> int:
    """Return the length of a line in columns: the terminal's width within limits, or 80 if the output is a file."""
    if not _is_terminal():
        return PLAIN
    return min(max(shutil.get_terminal_size((PLAIN, 0)).columns, NARROWEST), WIDEST)


def _is_terminal() -> bool:
    try:
        return sys.stdout.isatty()
    except (AttributeError, ValueError):  # no standard output, or a closed one
        return False


def pairs_text(lines: Lines) -> str:
    """Write names and values in two columns. Long names and values are wrapped to several lines."""
    longest = min(max([_NAME, *(len(name) for name, _ in lines)]), _LONGEST_NAME)
    found = list[str]()
    for name, text in lines:
        both = zip_longest(folded(name, longest), _hanging(" " * (longest + 1), text), fillvalue="")
        found += [f"{first:{longest}s}{line[longest:]}".rstrip() for first, line in both]
    return "\n".join(found)


def table_text(header: Sequence[str], rows: Sequence[Sequence[str]], names: int = 0) -> str:
    """Write a table as text, with lines that fit the terminal.

    Args:
        header: headings of the columns; long headings take several lines.
        rows: cells of each row.
        names: number of columns on the left that are aligned left, and repeated if the table is split.

    Returns:
        The table; if it is wider than a line, it is split into several parts, one below the other.
    """
    rows, most = _fitted(header, rows, names), width()
    columns = [[row[i] for row in rows] for i in range(len(header))]
    wrapped, widths = _headed(header, columns, _SHORTEST)
    for longest in range(_HEADING, _SHORTEST, -1):  # headings have as few lines as fit
        few, wide = _headed(header, columns, longest)
        if sum(wide) + len(_GAP) * (len(wide) - 1) <= most:
            wrapped, widths = few, wide
            break
    fixed = sum(widths[:names]) + len(_GAP) * names
    parts: list[list[int]] = [[]]
    used = fixed
    for i in range(names, len(header)):
        if parts[-1] and used + widths[i] > most:
            parts.append([])
            used = fixed
        parts[-1].append(i)
        used += widths[i] + len(_GAP)
    return "\n\n".join(_part([*range(names), *part], wrapped, columns, widths, names) for part in parts)


def ordinal(number: int) -> str:
    """Write an integer as an ordinal number, such as 1st."""
    last = 0 if number // 10 % 10 == 1 else number % 10
    return str(number) + {1: "st", 2: "nd", 3: "rd"}.get(last, "th")


def wrapped_text(text: str, indent: str = "") -> str:
    """Wrap a text to the width of a line."""
    return "\n".join(_hanging(indent, text))


def folded(name: str, longest: int) -> list[str]:
    """Split a long name, such as a path, into several lines, if possible between words or parts of words."""
    lines = [""]
    for piece in re.findall(r"[^/ _-]*[/ _-]|[^/ _-]+", name):
        if lines[-1] and len(lines[-1] + piece.rstrip()) > longest:
            lines.append("")
        lines[-1] += piece
        while len(lines[-1].rstrip()) > longest:
            lines[-1:] = [lines[-1][:longest], lines[-1][longest:]]
    return [line.rstrip() for line in lines]


def percent(share: float, decimals: int | None = None, *, error: float = 0.0, up: int = 0, signed: bool = False) -> str:
    """Write a fraction, such as 0.25, as a percentage.

    A zero has no sign, and a very large percentage has six digits and an exponent.

    Args:
        share: the share; 1 is 100 %.
        decimals: number of decimals; default: those of six significant digits, without trailing zeros.
        error: standard error of the share; if it is more than a rounding error, it is printed and determines the
            decimals.
        up: direction of rounding: 1 up and -1 down, for bounds; 0 to the nearest.
        signed: whether a positive number has a sign.
    """
    value, spread = 100 * share, 100 * error
    if not math.isfinite(value):
        return f"{value:g} %"
    if not negligible(error, share):
        return f"{measured_text(value, spread)} %"
    way = {1: ROUND_CEILING, 0: ROUND_HALF_EVEN, -1: ROUND_FLOOR}[up]
    last = 5 - magnitude(value) if decimals is None or abs(value) >= LARGE else decimals
    shown = Decimal(f"{value:.{_PROVED}g}").quantize(Decimal(1).scaleb(-last), way)
    sign = "+" if signed and shown > 0 else ""
    if abs(value) >= LARGE:
        return f"{sign}{number_text(float(shown))} %"
    text = f"{sign}{abs(shown) if shown == 0 else shown:f}"
    return f"{text.rstrip('0').rstrip('.') if decimals is None and '.' in text else text} %"


def number_text(value: float, digits: int = 6) -> str:
    """Write a number with at most ``digits`` digits. Very small and very large numbers are written with an exponent."""
    if not LARGE <= abs(value) < 10.0**digits:
        return f"{value:z.{digits}g}"
    leading, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{leading.rstrip('0').rstrip('.')}e{exponent}"


def measured_text(value: float, error: float) -> str:
    """Write value ± error in a common notation, rounded to two digits of the error, which must be positive."""
    last = magnitude(error) - 1
    if _SMALL <= max(abs(value), error) < LARGE and last >= -_ROUNDED:
        decimals = max(0, -last)
        return f"{value:z.{decimals}f} ± {error:.{decimals}f}"
    nearest = float(Decimal(value).quantize(Decimal(1).scaleb(last)))
    shown = f"{nearest:.{max(0, magnitude(nearest) - last)}e}" if nearest else "0"
    return f"{shown} ± {error:.1e}"


def negligible(error: float, value: float) -> bool:
    """Check whether the error of a value is so small that it may be a rounding error."""
    return error <= _FINE * abs(value)


def magnitude(value: float) -> int:
    """Return the power of ten of a number's first nonzero digit; 0 for the number 0."""
    return math.floor(math.log10(abs(value))) if value else 0


def ending_text(path: Path) -> str:
    """Write the file-name extension of a path for an error message, or that the path has none."""
    return f"ends in {path.suffix!r}" if path.suffix else "has no ending"


def backslash_text(path: str, error: str = "") -> str:
    """Write a hint for an error message if TOML has read backslashes in a path as escapes; otherwise an empty text."""
    if path.isprintable() and not any(word in error for word in ("Unescaped", "hex value", "Escaped")):
        return ""
    return (
        "; a backslash in double quotes is an escape in TOML: write C:/folder/file, or 'C:\\folder\\file' in single "
        "quotes"
    )


def number_of(number: object, noun: str) -> str:
    """Return a number, or its text, with its noun in the singular or plural: 1 step, 0 steps, 2 entries."""
    text, ending = f"{number}", "es" if noun.endswith("ch") else "s"
    plural = f"{noun[:-1]}ies" if noun.endswith("try") else noun + ending
    return f"{text} {noun if text == '1' else plural}"


def link_names(links: Iterable[str]) -> dict[str, str]:
    """Return the name of each link in a figure: that of its packets if it is the only link, else "link level-1"."""
    names = [*links]
    if len(names) == 1:
        return {names[0]: "packets"}
    return {name: name if name.startswith("link") else f"link {name}" for name in names}


def per_unit(unit: str) -> str:
    """Write the unit of a cost as text: "per step", "per second", or "in total" for the unit ``"mission"``."""
    return "in total" if unit == "mission" else f"per {unit}"


def _part(
    chosen: Sequence[int], wrapped: list[list[str]], columns: list[list[str]], widths: list[int], names: int
) -> str:
    """Return the text of the chosen columns of a table."""
    tall = max(len(wrapped[i]) for i in chosen)
    titles = [[""] * (tall - len(wrapped[i])) + wrapped[i] for i in chosen]
    lines = zip(*(title + columns[i] for title, i in zip(titles, chosen, strict=True)), strict=True)
    return "\n".join(
        _GAP.join(
            cell.ljust(widths[i]) if i < names else cell.rjust(widths[i]) for cell, i in zip(line, chosen, strict=True)
        ).rstrip()
        for line in lines
    )


def _fitted(header: Sequence[str], rows: Sequence[Sequence[str]], names: int) -> list[Sequence[str]]:
    """Return the rows with additional lines for long names, so that the widest other column fits next to the names."""
    widths = [max([len(row[i]) for row in rows] + [_SHORTEST]) for i in range(len(header))]
    room = width() - len(_GAP) * names - max(widths[names:], default=0)
    limits = [min(one, _LONGEST_NAME) for one in widths[:names]]
    while sum(limits) > room and max(limits) > _SHORTEST:
        limits[limits.index(max(limits))] -= 1
    found: list[Sequence[str]] = []
    for row in rows:
        lines = [folded(cell, limit) for cell, limit in zip(row, limits, strict=False)]
        for k in range(max(map(len, lines), default=1)):
            rest = row[names:] if k == 0 else [""] * (len(header) - names)
            found.append([*(line[k] if k < len(line) else "" for line in lines), *rest])
    return found


def _headed(header: Sequence[str], columns: list[list[str]], longest: int) -> tuple[list[list[str]], list[int]]:
    """Return the lines of the headings, wrapped to a width or to that of the column, and the widths of the columns."""
    wrapped = [
        textwrap.wrap(title, max([longest, *map(len, column)]), break_long_words=False, break_on_hyphens=False) or [""]
        for title, column in zip(header, columns, strict=True)
    ]
    return wrapped, [max(map(len, [*title, *column])) for title, column in zip(wrapped, columns, strict=True)]


def _hanging(first: str, text: str) -> list[str]:
    """Return the lines of a text with a hanging indent; only words that are longer than a line are broken."""
    # A number, its standard error and its percent sign stay on one line.
    indent = " " * len(first)
    text = re.sub("(?<=[0-9]) (?=[%±])|(?<=±) (?=[0-9])", _FIXED, text)
    return [
        line.replace(_FIXED, " ")
        for paragraph, lead in zip(text.split("\n"), [first] + [indent] * text.count("\n"), strict=True)
        for line in textwrap.wrap(
            paragraph,
            width(),
            initial_indent=lead,
            subsequent_indent=indent,
            break_on_hyphens=False,
        )
        or [lead.rstrip()]
    ]
