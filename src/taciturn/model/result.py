"""Base classes of results. JSON, tables, text and notebook output follow from one list of fields.

A class of results declares ``FIELDS``: each number that it holds or computes, once, with the key of its JSON document,
the label and the text of its line, and the column of a table with one such result per row. A result with rows declares
the fields of a row in ``row_fields``, with the column in pandas, CSV and LaTeX, the heading and the cell of its text,
and the key of the document of a row. So a new number of a result is one entry of one list.

* ``document()`` has the keys in the order of the fields. A field that is ``optional`` is left out if it has no value;
  the others are null.
* ``text()`` is an answer that is read from the top: the verdict, sentences that answer the question; the tables; the
  details, labelled lines, of which notes are the last; and, if they are requested, methods, seeds and times. ``str()``
  is the text without the latter. ``part`` of a field says to which of these its lines belong, and ``lines()`` are those
  of a part in the order of the fields, except for fields that name the field after which their lines are.
* ``columns()`` are the columns of the rows. ``to_pandas``, ``to_csv`` and ``to_latex`` write them; an estimate is one
  entry, but in pandas and CSV it is two columns, its value and its standard error.
* ``summary()``, the values that a line of Python and a notebook show, are those that ``shown`` names.

pandas is optional, and is imported only where a table is requested.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt

from taciturn._display import FULL, Displayed, brief, html_pairs, html_table, is_empty
from taciturn._files import write_whole
from taciturn._text import Lines, number_of, pairs_text, table_text, wrapped_text
from taciturn._version import __version__
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate, bound_text, outward

if TYPE_CHECKING:
    import pandas


def data_frame(columns: Mapping[str, object], index: str, values: Any) -> pandas.DataFrame:
    """Make a pandas data frame from named columns, with one row for each value of the index."""
    try:
        import pandas
    except ImportError:
        raise ProblemError(
            "pandas is not installed, but to_pandas requires it: pip install 'taciturn[pandas]'"
        ) from None
    return pandas.DataFrame(columns, index=pandas.Index(values, name=index))


def check_table(path: Path, formats: Sequence[str] = (".csv", ".parquet")) -> None:
    """Check the file for a table before a long computation: format, folder and required packages."""
    if path.suffix not in formats:
        raise ProblemError(
            f"the table {str(path)!r} has an unknown format; expected a file name that ends in {' or '.join(formats)}"
        )
    if not path.absolute().parent.is_dir():
        raise ProblemError(f"the folder of the table {str(path)!r} does not exist; expected an existing folder")
    needed = ("pandas",) if path.suffix == ".csv" else ("pandas", "pyarrow")
    missing = " and ".join(name for name in needed if find_spec(name) is None)
    if missing:
        raise ProblemError(
            f"{missing} is not installed, but {path.suffix} files require it: pip install 'taciturn[pandas]'"
        )


def save_table(frame: pandas.DataFrame, path: Path, origin: Mapping[str, object] | None = None) -> None:
    """Write a table as CSV or parquet. A parquet file also contains attributes and origin of the table."""
    table: Any = frame  # pandas' types are incomplete
    table.attrs.update(origin or {})
    try:
        if path.suffix == ".csv":
            table.to_csv(path, index=False)
        else:
            table.to_parquet(path, index=False)
    except OSError as error:
        raise ProblemError(
            f"the table {str(path)!r} cannot be written ({error.strerror or error}); expected a writable file"
        ) from None


SPECIAL = {"\\": r"\textbackslash{}", **{letter: rf"\{letter}" for letter in "&%$#_{}"}}
FIRST, LAST = 20, 10  # numbers of first and last rows that a notebook shows of a long table
Record = Mapping[str, object]
Column: TypeAlias = Sequence[Any] | npt.NDArray[Any]
Columns: TypeAlias = Mapping[str, Column]


SPLICED = "*"  # key of a field whose document is a part of that of the result
R = TypeVar("R")
Part: TypeAlias = Literal["verdict", "details", "method"]
Said: TypeAlias = str | Iterable[str | tuple[str, str]]


@dataclass(frozen=True, repr=False)
class Field(Displayed, Generic[R]):
    """A named entry of a result or of a table row, such as a number, and how it is written in JSON, tables and text.

    Args:
        name: name of the attribute, and of whatever has no other name.
        value: function that gives the value, or a path of attributes, such as ``"lower_bound.cost"``, in which an
            attribute of None is None; default: the attribute with this name.
        key: key in the JSON document; default: the name; empty: it is not in the document; ``"*"``: its own document is
            spliced in.
        json: function that gives the value in the document; default: ``plain``.
        optional: whether key and column are left out if there is no value.
        column: name of its column in a table with one such result or row per row, as that of a sweep; empty: none.
        unit: unit of this column, in which ``of`` is the result.
        say: label of its line, or heading of its column in the text; None: it is not in the text.
        text: format of the value as text, in which ``of`` is the result, as in ``"{} per {of.unit}"``; or function that
            gives the text of the line or the cell, or several lines, each perhaps with its own label. An empty line is
            left out. A mapping has a line for each entry, whose name the label contains, as in ``"rate, {}"``.
        none: text of a missing value.
        up: direction in which a bound is rounded in text and tables so that it still holds: 1 up, −1 down.
        after: name of the field after whose lines its own lines are; default: the order of the list.
        part: part of the text to which its lines belong.
    """

    name: str
    value: str | Callable[[R], Any] = ""
    key: str | None = None
    json: Callable[[Any], object] | None = None
    optional: bool = False
    column: str = ""
    unit: str = ""
    say: str | None = None
    text: str | Callable[[R], Said] = "{}"
    none: str = ""
    up: int = 0
    after: str | None = None
    part: Part = "details"

    def of(self, result: R) -> Any:
        """Return the value that this field has in a result or a table row."""
        if callable(self.value):
            return self.value(result)
        value: Any = result
        for part in (self.value or self.name).split("."):
            value = None if value is None else getattr(value, part)
        return value

    def entry(self, result: R) -> Any:
        """Return the value for a table. A bound is rounded to six digits, in the direction in which it still holds."""
        value = self.of(result)
        return outward(value, 6, self.up) if self.up and isinstance(value, float) else value

    def texts(self, result: R) -> list[tuple[str, str]]:
        """Return the lines, each with a label, that this field adds to the text of a result."""
        if callable(self.text):
            said = self.text(result)
            lines = [said] if isinstance(said, str) else said
            return [(self.say or "", one) if isinstance(one, str) else one for one in lines if one]
        value, label = self.entry(result), self.say or ""
        if isinstance(value, Mapping):
            entries = cast("Mapping[str, Any]", value).items()
            return [(label.format(name), self.text.format(one, of=result)) for name, one in entries]
        if isinstance(value, tuple):
            return [(label, self.text.format(one, of=result)) for one in cast("tuple[Any, ...]", value)]
        if value is None:
            return [(label, self.none)] if self.none else []
        if self.up and self.text == "{}":
            bound = value if isinstance(value, Estimate) else Estimate(value, 0.0, "bound")
            return [(label, bound_text(bound, self.up))]
        return [(label, self.text.format(value, of=result))] if value != "" else []

    def cell(self, row: R) -> str:
        """Write this field of one table row as text."""
        return "".join(text for _, text in self.texts(row))


VERDICT: Field[Any] = Field("verdict", json="; ".join, say="", part="verdict")
"""Sentences that answer the question of a command, of a result with a property of this name."""


def rows_text(listed: Iterable[Field[R]], rows: Sequence[R], names: int = 1) -> str:
    """Write rows as a text table, without columns that are empty. The first ``names`` columns name a row."""
    columns = [(field.say, [field.cell(row) for row in rows]) for field in listed if field.say is not None]
    shown = [(say, cells) for place, (say, cells) in enumerate(columns) if place < names or any(cells)]
    if not rows or not shown:
        return ""
    return table_text([say for say, _ in shown], [*zip(*(cells for _, cells in shown), strict=True)], names)


def plain_fields(*names: str) -> list[Field[Any]]:
    """Return fields that only the JSON document contains, each under its attribute's name."""
    return [Field(name) for name in names]


def document_of(result: R, listed: Iterable[Field[R]]) -> dict[str, Any]:
    """Write a result or a table row as a JSON document, with one key for each field."""
    found: dict[str, Any] = {}
    for field in listed:
        value = None if field.key == "" else field.of(result)
        if field.key == "" or (field.optional and is_empty(value)):
            continue
        told: Any = plain(value) if field.json is None or value is None else field.json(value)
        found.update(told if field.key == SPLICED else {field.key or field.name: told})
    return found


def plain(value: Any) -> Any:
    """Convert a value to JSON: an estimate to value and standard error, and a nested result to its document."""
    if isinstance(value, Estimate):
        return value.document("value", "standard_error")
    if isinstance(value, np.ndarray):
        return cast("npt.NDArray[Any]", value).tolist()
    if isinstance(value, Mapping):
        return {name: plain(one) for name, one in cast("Mapping[str, Any]", value).items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in cast("Sequence[Any]", value)]
    return value.document() if hasattr(value, "document") else value


def whole(estimate: Estimate) -> dict[str, Any]:
    """Return the JSON of an estimate with its method and, for a quadrature, its error bound."""
    return estimate.document() | (estimate.document("error") if estimate.method == "quadrature" else {})


def seconds(value: float) -> float:
    """Round a duration in seconds to 0.1 ms, for JSON."""
    return round(value, 4)


class Result(Displayed):
    """Base class of results. It derives the JSON document and the text from a list of fields."""

    FIELDS: ClassVar[tuple[Field[Any], ...]] = ()
    """Each number of the result, in the order of the document; empty: the fields of the class."""
    shown: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes that a line of Python and a notebook show; empty: all fields of the class."""

    def summary(self) -> Mapping[str, object]:
        """Return the values to display, by name. The most important comes first."""
        return {name: getattr(self, name) for name in self.shown or self._names()}

    def document(self) -> dict[str, Any]:
        """Return the JSON document that a command prints for this result with ``--json``."""
        return document_of(self, self.FIELDS or plain_fields(*self._names()))

    def _names(self) -> list[str]:
        held: Any = self
        return [field.name for field in fields(held)] if is_dataclass(held) else []

    def lines(self, part: Part = "details") -> Lines:
        """Return the lines of one part of the text, such as the verdict. Each line is a pair of label and text."""
        order = [field for field in self.FIELDS if field.after is None]
        left = [field for field in self.FIELDS if field.after is not None]
        while left:
            places = {"": 0} | {field.name: place for place, field in enumerate(order, 1)}
            field = next(field for field in left if field.after in places)
            order.insert(places[str(field.after)], field)
            left.remove(field)
        said = [field for field in order if field.say is not None and field.part == part]
        return [line for field in said for line in field.texts(self)]

    def table_texts(self) -> Sequence[str]:
        """Return the tables that the printed text contains."""
        return ()

    def text(self, verbose: bool = False) -> str:
        """Return the text that a command prints, with the details of ``--verbose`` or without; if empty, the
        ``repr``.
        """
        verdict = "\n".join(wrapped_text(sentence) for _, sentence in self.lines("verdict"))
        details = pairs_text([*self.lines(), *(self.lines("method") if verbose else ())])
        return "\n\n".join(filter(None, (verdict, *self.table_texts(), details))) or repr(self)

    def __str__(self) -> str:
        """Return the text that the command prints without --verbose."""
        return self.text()

    def html(self) -> str:
        """Write the verdict and a table of names and values as HTML."""
        return self._verdict() + super().html()

    def _verdict(self) -> str:
        return "".join(f"<div>{escape(sentence)}</div>" for _, sentence in self.lines("verdict"))


class Tabular(Result):
    """Base class of results that are tables with rows and named columns. An estimate is one entry of a row."""

    index: ClassVar[str] = ""
    """Name of the column that numbers the rows; empty if there is no such column."""
    heading: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes that apply to the whole table, such as units and notes."""

    @property
    def labels(self) -> int:
        """Number of columns, from the left, whose entries name a row of the text table."""
        return 1

    def table_rows(self) -> Sequence[Any]:
        """Return the objects that the table shows, one for each row."""
        return ()

    def row_fields(self) -> tuple[Field[Any], ...]:
        """Return the fields that a row of the table shows."""
        return ()

    def row_documents(self) -> list[dict[str, Any]]:
        """Write each row of the table as a JSON document."""
        listed = self.row_fields()
        return [document_of(row, listed) for row in self.table_rows()]

    def columns(self) -> Columns:
        """Return the columns by name. All columns have the same length; a missing entry is None."""
        rows, found = self.table_rows(), dict[str, Column]()
        for field in self.row_fields():
            values = [field.entry(row) for row in rows] if field.column else []
            if values and not (field.optional and all(map(is_empty, values))):
                found[field.column] = values
        return found

    def table(self) -> str:
        """Return the rows as text."""
        return rows_text(self.row_fields(), self.table_rows(), self.labels)

    def table_texts(self) -> Sequence[str]:
        """Return the rows as text."""
        return (self.table(),)

    def records(self) -> list[Record]:
        """Return the rows, each as a mapping from column name to entry."""
        columns = self.columns()
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def about(self) -> dict[str, object]:
        """Return the attributes, by name, that apply to the whole table, such as a price."""
        return {name: getattr(self, name) for name in self.heading}

    def to_pandas(self) -> pandas.DataFrame:
        """Convert the table to a pandas data frame. An estimate becomes two columns: value and standard error."""
        columns: dict[str, Column] = {}
        for name, values in self.columns().items():
            columns[name] = values
            if any(isinstance(value, Estimate) for value in values):
                columns[name] = [value.value if isinstance(value, Estimate) else value for value in values]
                errors = [value.standard_error if isinstance(value, Estimate) else None for value in values]
                columns[f"{name}_standard_error"] = errors
        if self.index:
            return data_frame(columns, self.index, columns.pop(self.index))
        return data_frame(columns, "row", range(len(next(iter(columns.values()), ()))))

    def to_csv(self, path: str | Path | None = None) -> str:
        """Write the table of ``to_pandas`` as CSV text. If a path is given, also write it to this file."""
        target = None if path is None else Path(path)
        if target is not None:
            check_table(target, (".csv",))
        frame: Any = self.to_pandas()  # pandas' types are incomplete
        frame = frame.reset_index() if self.index else frame
        if target is not None:
            save_table(frame, target)
        return frame.to_csv(index=False)

    def to_latex(self, path: str | Path | None = None) -> str:
        r"""Write the table in LaTeX. If a path is given, also write it to this file.

        An estimate is a single entry, value \\pm standard error. The error has two digits, and the value is rounded to
        the same decimal place. A number without an error has six digits. Comments above the table contain version,
        units and notes.
        """
        columns = self.columns()
        told = {type(self).__name__: f"Taciturn {__version__}", **self.about()}
        comments = [f"% {name.replace('_', ' ')}: {line}" for name, value in told.items() for line in _lines(value)]
        lines = [" & ".join(_plain(name.replace("_", " ")) for name in columns)]
        lines += [" & ".join(map(_entry, row)) for row in zip(*columns.values(), strict=True)]
        head, *body = [rf"{line} \\" for line in lines]
        parts = [rf"\begin{{tabular}}{{l{'r' * (len(columns) - 1)}}}", r"\hline", head, r"\hline", *body, r"\hline"]
        text = "\n".join([*comments, *parts, r"\end{tabular}"]) + "\n"
        if path is not None:
            write_whole(Path(path), text.encode())
        return text

    def html(self) -> str:
        """Write the table and its attributes as HTML. Only the first and last rows of a long table are shown."""
        columns = self.columns()
        rows = [[escape(_text(value)) for value in row] for row in zip(*columns.values(), strict=True)]
        told = self.about()
        if len(rows) > FIRST + LAST:
            told["omitted"] = (
                f"{len(rows) - FIRST - LAST} of {number_of(len(rows), 'row')}; to_pandas() and to_csv() return all"
            )
            rows = [*rows[:FIRST], ["…"] * len(columns), *rows[-LAST:]]
        above = self._verdict() + html_pairs(type(self).__name__, told)
        return above + html_table([name.replace("_", " ") for name in columns], rows)


def _lines(value: object) -> list[str]:
    """Return the lines of a comment, one for each sentence; an empty value gives an empty list."""
    if isinstance(value, tuple):
        return [" ".join(str(one).split()) for one in cast("tuple[object, ...]", value)]
    return [] if value in (None, "") else [_text(value)]


def _text(value: Any) -> str:
    if hasattr(value, "dtype"):
        value = value.item()
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "" if value is None else str(value) if isinstance(value, str | Estimate) else brief(value, FULL)


def _entry(value: object) -> str:
    if isinstance(value, Estimate):
        return "$" + str(value).replace("±", r"\pm") + "$"
    return f"${value:z.6g}$" if isinstance(value, float) else _plain(_text(value))


def _plain(text: str) -> str:
    return "".join(SPECIAL.get(letter, letter) for letter in text)
