"""Tables: the one door to pandas, which is an extra."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from taciturn.errors import ProblemError

if TYPE_CHECKING:
    from pathlib import Path

    import pandas

    from taciturn._arrays import Array


def data_frame(columns: Mapping[str, object], index: str, values: Array | range) -> pandas.DataFrame:
    """Return a table of named columns, one row for each value of the named index.

    Raises:
        ProblemError: pandas is not installed.
    """
    try:
        import pandas
    except ImportError:
        raise ProblemError(
            "pandas is not installed; expected it for to_pandas: pip install 'taciturn[pandas]'"
        ) from None
    return pandas.DataFrame(columns, index=pandas.Index(values, name=index))


def check_table(path: Path) -> None:
    """Refuse a file that no table is written to, before long work.

    Raises:
        ProblemError: the ending is neither .csv nor .parquet, or what writes it is not installed.
    """
    if path.suffix not in (".csv", ".parquet"):
        raise ProblemError(f"the table {str(path)!r} has an unknown format; expected .csv or .parquet")
    if not path.absolute().parent.is_dir():
        raise ProblemError(f"the folder of the table {str(path)!r} is not there; expected one that is")
    needed = ("pandas",) if path.suffix == ".csv" else ("pandas", "pyarrow")
    missing = " and ".join(name for name in needed if find_spec(name) is None)
    if missing:
        raise ProblemError(f"{missing} is not installed; expected it for {path.suffix}: pip install 'taciturn[pandas]'")


def save_table(frame: pandas.DataFrame, path: Path) -> None:
    """Write a table; parquet keeps its attributes, text does not.

    Raises:
        ProblemError: the file cannot be written.
    """
    table: Any = frame  # whose types are open
    try:
        if path.suffix == ".csv":
            table.to_csv(path, index=False)
        else:
            table.to_parquet(path, index=False)
    except OSError as error:
        raise ProblemError(
            f"the table {str(path)!r} cannot be written ({error.strerror or error}); "
            "expected a file that can be written to"
        ) from None
