"""Base class of tabular results, with export to pandas, CSV and LaTeX and display in notebooks.

Tables, and the interface to pandas, an optional dependency.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, cast

import numpy.typing as npt

from taciturn._display import FULL, Displayed, brief, html_pairs, html_table
from taciturn._files import write_whole
from taciturn._version import __version__
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate

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


def columns_of(records: Sequence[Record]) -> Columns:
    """Return the columns of a list of rows; missing entries are None."""
    names = dict.fromkeys(name for record in records for name in record)
    return {name: [record.get(name) for record in records] for name in names}


class Tabular(Displayed, ABC):
    """A result with rows and named columns, in which an estimate is a single entry."""

    index: ClassVar[str] = ""
    """Name of the column that numbers the rows; empty if there is no such column."""
    heading: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes that apply to the whole table, such as units and notes."""

    @abstractmethod
    def columns(self) -> Columns:
        """Return the columns by name, all with the same length."""

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
