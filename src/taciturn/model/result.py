"""A result is one list of fields, from which JSON, tables, text and notebooks follow.

A class of results declares ``FIELDS``: each number that it holds or computes, once, with the key of its JSON document,
the label and the text of its line, and the column of a table with one such result per row. A result with rows declares
the fields of a row in ``row_fields``, with the column in pandas, CSV and LaTeX, the heading and the cell of its text,
and the key of the document of a row. So a new number of a result is one entry of one list.

* ``document()`` has the keys in the order of the fields. A field that is ``optional`` is left out if it has no value;
  the others are null.
* ``lines()`` are the labelled lines of the text, in the order of the fields, except for those that name the field after
  which they stand. ``str()`` is these lines and, for a result with rows, the table.
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
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt

from taciturn._display import FULL, Displayed, brief, html_pairs, html_table, is_empty
from taciturn._files import write_whole
from taciturn._text import Lines, pairs_text, table_text
from taciturn._version import __version__
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate, bound_text, outward

if TYPE_CHECKING:
    import pandas


def data_frame(columns: Mapping[str, object], index: str, values: Any) -> pandas.DataFrame:
    """Return a table of named columns, one row for each value of the named index."""
    try:
        import pandas
    except ImportError:
        raise ProblemError(
            "pandas is not installed, but to_pandas requires it: pip install 'taciturn[pandas]'"
        ) from None
    return pandas.DataFrame(columns, index=pandas.Index(values, name=index))


def check_table(path: Path, formats: Sequence[str] = (".csv", ".parquet")) -> None:
    """Reject an unsupported table file before a long computation starts."""
    if path.suffix not in formats:
        raise ProblemError(f"the table {str(path)!r} has an unknown format; expected {' or '.join(formats)}")
    if not path.absolute().parent.is_dir():
        raise ProblemError(f"the folder of the table {str(path)!r} does not exist; expected an existing folder")
    needed = ("pandas",) if path.suffix == ".csv" else ("pandas", "pyarrow")
    missing = " and ".join(name for name in needed if find_spec(name) is None)
    if missing:
        raise ProblemError(
            f"{missing} is not installed, but {path.suffix} files need it: pip install 'taciturn[pandas]'"
        )


def save_table(frame: pandas.DataFrame, path: Path, origin: Mapping[str, object] | None = None) -> None:
    """Write a table as CSV or parquet; only a parquet file also contains the attributes and the origin of the table."""
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
Said: TypeAlias = str | Iterable[str | tuple[str, str]]


@dataclass(frozen=True, repr=False)
class Field(Displayed, Generic[R]):
    """One number, word or part of a result or of a row.

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
        after: name of the field after whose lines its own lines stand; default: the order of the list.
        above: whether its lines stand above the table.
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
    above: bool = False

    def of(self, result: R) -> Any:
        """Return the value of a result or of a row."""
        if callable(self.value):
            return self.value(result)
        value: Any = result
        for part in (self.value or self.name).split("."):
            value = None if value is None else getattr(value, part)
        return value

    def entry(self, result: R) -> Any:
        """Return the value as tables contain it: a bound with six digits, so that it still holds."""
        value = self.of(result)
        return outward(value, 6, self.up) if self.up and isinstance(value, float) else value

    def texts(self, result: R) -> list[tuple[str, str]]:
        """Return the lines of a result, each with its label."""
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
        """Return the cell of a row."""
        return "".join(text for _, text in self.texts(row))


def plain_fields(*names: str) -> list[Field[Any]]:
    """Return fields that are only in the document, each under its own name."""
    return [Field(name) for name in names]


def document_of(result: R, listed: Iterable[Field[R]]) -> dict[str, Any]:
    """Return the JSON document of the fields of a result or of a row."""
    found: dict[str, Any] = {}
    for field in listed:
        value = None if field.key == "" else field.of(result)
        if field.key == "" or (field.optional and is_empty(value)):
            continue
        told: Any = plain(value) if field.json is None or value is None else field.json(value)
        found.update(told if field.key == SPLICED else {field.key or field.name: told})
    return found


def plain(value: Any) -> Any:
    """Return a value as JSON: an estimate as value and standard error, a part of a result as its own document."""
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
    """Return an estimate as JSON with its method, and with the error of a quadrature."""
    return estimate.document() | (estimate.document("error") if estimate.method == "quadrature" else {})


def seconds(value: float) -> float:
    """Return a time as JSON, to a tenth of a millisecond."""
    return round(value, 4)


class Result(Displayed):
    """A result, whose document and text follow from its list of fields."""

    FIELDS: ClassVar[tuple[Field[Any], ...]] = ()
    """Each number of the result, in the order of the document; empty: the fields of the class."""
    shown: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes that a line of Python and a notebook show; empty: all fields of the class."""

    def summary(self) -> Mapping[str, object]:
        """Return the displayed values by name, the most important first."""
        return {name: getattr(self, name) for name in self.shown or self._names()}

    def document(self) -> dict[str, Any]:
        """Return the JSON document of the command's ``--json``."""
        return document_of(self, self.FIELDS or plain_fields(*self._names()))

    def _names(self) -> list[str]:
        held: Any = self
        return [field.name for field in fields(held)] if is_dataclass(held) else []

    def lines(self, above: bool = False) -> Lines:
        """Return the printed lines as pairs of name and text: those below the table, or those above it."""
        order = [field for field in self.FIELDS if field.after is None]
        left = [field for field in self.FIELDS if field.after is not None]
        while left:
            places = {"": 0} | {field.name: place for place, field in enumerate(order, 1)}
            field = next(field for field in left if field.after in places)
            order.insert(places[str(field.after)], field)
            left.remove(field)
        said = [field for field in order if field.say is not None and field.above == above]
        return [line for field in said for line in field.texts(self)]

    def __str__(self) -> str:
        """Return the text that the command prints; without lines, that of Python."""
        return pairs_text(self.lines()) or repr(self)


class Tabular(Result):
    """A result with rows and named columns, in which an estimate is a single entry."""

    index: ClassVar[str] = ""
    """Name of the column that numbers the rows; empty if there is no such column."""
    heading: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes that apply to the whole table, such as units and notes."""
    gap: ClassVar[str] = "\n"
    """Text between the lines above the table, the table and the lines below it."""

    @property
    def labels(self) -> int:
        """Number of the columns on the left of the text that name a row."""
        return 1

    def table_rows(self) -> Sequence[Any]:
        """Return what has one row each in the table."""
        return ()

    def row_fields(self) -> tuple[Field[Any], ...]:
        """Return each number of a row."""
        return ()

    def row_documents(self) -> list[dict[str, Any]]:
        """Return the JSON document of each row."""
        listed = self.row_fields()
        return [document_of(row, listed) for row in self.table_rows()]

    def columns(self) -> Columns:
        """Return the columns by name, all with the same length; missing entries are None."""
        rows, found = self.table_rows(), dict[str, Column]()
        for field in self.row_fields():
            values = [field.entry(row) for row in rows] if field.column else []
            if values and not (field.optional and all(map(is_empty, values))):
                found[field.column] = values
        return found

    def table(self) -> str:
        """Return the rows as text."""
        said = [field for field in self.row_fields() if field.say is not None]
        if not said:
            return ""
        header = [field.say or "" for field in said]
        return table_text(header, [[field.cell(row) for field in said] for row in self.table_rows()], self.labels)

    def remarks(self) -> Iterable[str]:
        """Return the text below the lines."""
        return ()

    def __str__(self) -> str:
        """Return the text that the command prints."""
        parts = [pairs_text(self.lines(above=True)), self.table(), pairs_text(self.lines()), *self.remarks()]
        return self.gap.join(filter(None, parts)) or repr(self)

    def records(self) -> list[Record]:
        """Return the rows as mappings from column names to entries."""
        columns = self.columns()
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def about(self) -> dict[str, object]:
        """Return the attributes that apply to the whole table, by name."""
        return {name: getattr(self, name) for name in self.heading}

    def to_pandas(self) -> pandas.DataFrame:
        """Return the table as a data frame; an estimate has one column for its value and one for its standard error."""
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
        """Return the table of ``to_pandas`` as CSV text, and write it to a file if a path is given."""
        target = None if path is None else Path(path)
        if target is not None:
            check_table(target, (".csv",))
        frame: Any = self.to_pandas()  # pandas' types are incomplete
        frame = frame.reset_index() if self.index else frame
        if target is not None:
            save_table(frame, target)
        return frame.to_csv(index=False)

    def to_latex(self, path: str | Path | None = None) -> str:
        r"""Return the table in LaTeX, and write it to a file if a path is given.

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
        """Return the table as HTML, with its general attributes; a long table shows only its first and last rows."""
        columns = self.columns()
        rows = [[escape(_text(value)) for value in row] for row in zip(*columns.values(), strict=True)]
        told = self.about()
        if len(rows) > FIRST + LAST:
            told["omitted"] = f"{len(rows) - FIRST - LAST} of {len(rows)} rows; to_pandas() and to_csv() return all"
            rows = [*rows[:FIRST], ["…"] * len(columns), *rows[-LAST:]]
        above = html_pairs(type(self).__name__, told)
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
