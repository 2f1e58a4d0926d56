"""Display of objects: as one line of text in Python and as a small table in a notebook, with the same values."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from html import escape
from typing import Any, cast

from taciturn.errors import TaciturnError

LONGEST = 200  # largest number of characters in a line
_SHORT = 60  # largest number of characters of one value in a line
_LISTED = 4  # longest vector that a line shows entry by entry
_WIDEST = 12  # most rows or columns of a matrix that a notebook shows entry by entry
FULL = 10_000  # largest number of characters of one value in a notebook
_STYLE = "text-align: left; vertical-align: top"


class Displayed:
    """Base class of objects with a short ``repr`` (at most 200 characters) and with a table for notebooks.

    A dataclass is declared with ``repr=False``. It overrides ``summary`` if its fields are not suitable for readers,
    with the most important values first, since a long line is cut at its end. It overrides ``short`` if a few words are
    more informative than its name.
    """

    def summary(self) -> Mapping[str, object]:
        """Return the names and values that represent the object. If a class does not redefine this, it shows all
        fields.
        """
        found: Any = self
        return {field.name: getattr(self, field.name) for field in fields(found)}

    def short(self) -> str:
        """Describe this object in a few words, for the display of another object that contains it."""
        return type(self).__name__

    def __repr__(self) -> str:
        """Return one line of at most 200 characters."""
        parts = [f"{name.replace(' ', '_')}={brief(value)}" for name, value in _rows(self.summary())]
        name = type(self).__name__
        while parts and len(f"{name}({', '.join(parts)})") > LONGEST:
            parts = [*parts[: -2 if parts[-1] == "…" else -1], "…"]
        return f"{name}({', '.join(parts)})"

    def html(self) -> str:
        """Write the table of names and values, as HTML, that a notebook shows for this object."""
        return html_pairs(type(self).__name__, self.summary())

    def _repr_html_(self) -> str:
        """Return the display in a notebook: the figure of an object, if it has a figure, and the table."""
        plot = getattr(self, "plot", None)
        try:
            picture = "" if plot is None else html_picture(plot().svg(), repr(self))
        except TaciturnError:  # an object that cannot be drawn, for a reason that ``plot`` tells, has its table
            picture = ""
        return f"{picture}{self.html()}"


def html_pairs(title: str, named: Mapping[str, object]) -> str:
    """Write a title and a table of names and values as HTML. Names without a value are omitted."""
    rows = [(escape(name.replace("_", " ")), _cell(value)) for name, value in _rows(named)]
    return f"<strong>{escape(title)}</strong>{html_table([], rows) if rows else ''}"


def html_picture(svg: str, words: str) -> str:
    """Write a picture as HTML. The picture adapts its colours to light and dark pages."""
    data = b64encode(svg.encode()).decode()
    style = "display: block; max-width: 100%; border-radius: 4px"
    return f'<img alt="{escape(words)}" style="{style}" src="data:image/svg+xml;base64,{data}">'


def html_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a table as HTML, from cells that are HTML. It sets no colours, so it suits light and dark notebooks."""
    head = "".join(f'<th style="{_STYLE}">{escape(title)}</th>' for title in header)
    lines = ["".join(f'<td style="{_STYLE}">{cell}</td>' for cell in row) for row in rows]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table>{f'<thead><tr>{head}</tr></thead>' if header else ''}<tbody>{body}</tbody></table>"


def brief(value: Any, longest: int = _SHORT) -> str:
    """Write a value as short text: a number, the shape of an array, or the first entries of a collection."""
    if hasattr(value, "dtype"):
        return brief(value.item()) if value.size == 1 else _array(value)
    if isinstance(value, Displayed):
        text = value.short()
    elif isinstance(value, float):
        return f"{value:z.6g}"
    elif isinstance(value, str):
        return repr(_cut(value, longest))
    elif isinstance(value, bytes | bytearray):
        text = f"{len(value)} byte{'' if len(value) == 1 else 's'}"
    elif isinstance(value, Mapping):
        named = cast("Mapping[str, Any]", value)
        return _joined("{}", [f"{name}: {brief(entry, longest)}" for name, entry in named.items()], longest)
    elif isinstance(value, Sequence | set | frozenset):
        return _joined("[]", [brief(entry, longest) for entry in cast("Iterable[Any]", value)], longest)
    elif is_dataclass(value):
        text = type(value).__name__
    else:
        text = getattr(value, "__name__", "function") if callable(value) else " ".join(str(value).split())
    return _cut(text, longest)


def _rows(named: Mapping[str, object]) -> list[tuple[str, object]]:
    return [(name, value) for name, value in named.items() if not is_empty(value)]


def _cut(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def _joined(ends: str, parts: Sequence[str], longest: int) -> str:
    """Return those first entries of a collection that fit, or the number of entries if none fits."""
    shown = list(parts)
    while shown and sum(map(len, shown)) + 2 * len(shown) > longest:
        shown = [*shown[: -2 if shown[-1] == "…" else -1], "…"]
        if len(shown) == 1:
            return f"{len(parts)} entr{'y' if len(parts) == 1 else 'ies'}"
    return f"{ends[0]}{', '.join(shown)}{ends[1]}"


def _array(value: Any) -> str:
    if value.ndim == 1 and 0 < value.size <= _LISTED:
        return f"[{', '.join(map(brief, value.tolist()))}]"
    return f"{'×'.join(map(str, value.shape))} array" if value.ndim > 1 else f"array of {value.size}"


def _cell(value: Any) -> str:
    """Return a value as HTML: text in full, a list of texts line by line, a small matrix entry by entry."""
    if isinstance(value, str):
        return escape(value)
    if isinstance(value, Mapping):
        named = cast("Mapping[str, object]", value)
        return "<br>".join(escape(f"{name} = {brief(one, FULL)}") for name, one in named.items())
    if isinstance(value, tuple | list):
        listed = cast("Sequence[object]", value)
        return "<br>".join(escape(one if isinstance(one, str) else brief(one, FULL)) for one in listed)
    elif hasattr(value, "dtype") and value.ndim in (1, 2) and value.size > 1 and max(value.shape) <= _WIDEST:
        rows = value if value.ndim == 2 else [value]
        return html_table([], [[escape(brief(entry)) for entry in row] for row in rows])
    return escape(brief(value, FULL))


def is_empty(value: Any) -> bool:
    """Check whether there is nothing to display: the value is None, an empty text or an empty collection."""
    return value is None or (isinstance(value, str | tuple | list | dict) and not value)
