"""Tables: the one door to pandas, which is an extra."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from taciturn.errors import ProblemError

if TYPE_CHECKING:
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
