"""Display of objects: one line in Python and a small table in a notebook, from the same rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from html import escape
from typing import Any, cast

LONGEST = 200  # largest number of characters in a line
SHORT = 40  # largest number of characters of one value in a line
LISTED = 4  # longest vector that a line shows entry by entry
WIDEST = 12  # most rows or columns of a matrix that a notebook shows entry by entry
STYLE = "text-align: left; vertical-align: top"


class Displayed:
    """Base class of objects with a ``repr`` of at most 200 characters and a table for notebooks.

    A dataclass is declared with ``repr=False``. It overrides ``summary`` if its fields are not suitable for readers,
    and ``short`` if a few words are more informative than its name.
    """

    def summary(self) -> Mapping[str, object]:
        """Return the displayed values by name; by default, the fields."""
        found: Any = self
        return {field.name: getattr(self, field.name) for field in fields(found)}

    def short(self) -> str:
        """Return a few words that represent this object inside another one."""
        return type(self).__name__

    def __repr__(self) -> str:
        """Return one line of at most 200 characters."""
        parts = [f"{name.replace(' ', '_')}={brief(value)}" for name, value in _rows(self.summary())]
        name = type(self).__name__
        while parts and len(f"{name}({', '.join(parts)})") > LONGEST:
            parts = [*parts[: -2 if parts[-1] == "…" else -1], "…"]
        return f"{name}({', '.join(parts)})"

    def html(self) -> str:
        """Return the HTML table of names and values that a notebook shows."""
        return html_pairs(type(self).__name__, self.summary())

    def _repr_html_(self) -> str:
        return self.html()


def html_pairs(title: str, named: Mapping[str, object]) -> str:
    """Return the HTML of a title and a table of names and values; empty values are omitted."""
    rows = [(escape(name.replace("_", " ")), _cell(value)) for name, value in _rows(named)]
    return f"<strong>{escape(title)}</strong>{html_table([], rows) if rows else ''}"


def html_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return an HTML table of HTML cells, without colours, so that it suits light and dark notebooks."""
    head = "".join(f'<th style="{STYLE}">{escape(title)}</th>' for title in header)
    lines = ["".join(f'<td style="{STYLE}">{cell}</td>' for cell in row) for row in rows]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table>{f'<thead><tr>{head}</tr></thead>' if header else ''}<tbody>{body}</tbody></table>"


def brief(value: Any) -> str:
    """Return a short text for a value: a number, the size of an array, or the number of entries of a collection."""
    if hasattr(value, "dtype"):
        return brief(value.item()) if value.size == 1 else _array(value)
    if isinstance(value, Displayed):
        text = value.short()
    elif isinstance(value, float):
        return f"{value:.6g}"
    elif isinstance(value, str):
        return repr(_cut(value))
    elif isinstance(value, Mapping):
        text = _joined("{}", [f"{name}: {brief(entry)}" for name, entry in cast("Mapping[str, Any]", value).items()])
    elif isinstance(value, Sequence | set | frozenset):
        text = _joined("[]", [brief(entry) for entry in cast("Iterable[Any]", value)])
    elif is_dataclass(value):
        text = type(value).__name__
    else:
        text = getattr(value, "__name__", "function") if callable(value) else " ".join(str(value).split())
    return _cut(text)


def _rows(named: Mapping[str, object]) -> list[tuple[str, object]]:
    return [(name, value) for name, value in named.items() if not _is_empty(value)]


def _cut(text: str) -> str:
    return text if len(text) <= SHORT else f"{text[: SHORT - 1]}…"


def _joined(ends: str, parts: Sequence[str]) -> str:
    text = f"{ends[0]}{', '.join(parts)}{ends[1]}"
    return text if len(text) <= SHORT else f"{len(parts)} entr{'y' if len(parts) == 1 else 'ies'}"


def _array(value: Any) -> str:
    if value.ndim == 1 and 0 < value.size <= LISTED:
        return f"[{', '.join(map(brief, value.tolist()))}]"
    return f"{'×'.join(map(str, value.shape))} array" if value.ndim > 1 else f"array of {value.size}"


def _cell(value: Any) -> str:
    """Return a value as HTML: text in full, a list of texts line by line, a small matrix entry by entry."""
    if isinstance(value, str):
        return escape(value)
    if isinstance(value, tuple | list):
        listed = cast("Sequence[object]", value)
        if all(isinstance(one, str) for one in listed):
            return "<br>".join(escape(str(one)) for one in listed)
    elif hasattr(value, "dtype") and value.ndim in (1, 2) and value.size > 1 and max(value.shape) <= WIDEST:
        rows = value if value.ndim == 2 else [value]
        return html_table([], [[escape(brief(entry)) for entry in row] for row in rows])
    return escape(brief(value))


def _is_empty(value: Any) -> bool:
    return value is None or (isinstance(value, str | tuple | list | dict) and not value)
