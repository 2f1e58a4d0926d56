"""Tables, and the interface to pandas, an optional dependency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from taciturn.errors import ProblemError

if TYPE_CHECKING:
    from pathlib import Path

    import pandas


def data_frame(columns: Mapping[str, object], index: str, values: Any) -> pandas.DataFrame:
    """Return a table of named columns, one row for each value of the named index.

    Raises:
        ProblemError: pandas is not installed.
    """
    try:
        import pandas
    except ImportError:
        raise ProblemError(
            "pandas is not installed, but to_pandas requires it: pip install 'taciturn[pandas]'"
        ) from None
    return pandas.DataFrame(columns, index=pandas.Index(values, name=index))


def check_table(path: Path, formats: Sequence[str] = (".csv", ".parquet")) -> None:
    """Reject an unsupported table file before a long computation starts.

    Raises:
        ProblemError: the format is not supported, the folder does not exist, or pandas or pyarrow is not installed.
    """
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
    """Write a table as CSV or parquet; only a parquet file also contains the attributes and the origin of the table.

    Raises:
        ProblemError: the file cannot be written.
    """
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
