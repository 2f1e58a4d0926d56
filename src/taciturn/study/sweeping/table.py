"""The result of a sweep as a table for pandas, CSV files and LaTeX."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from taciturn._text import wrapped_text
from taciturn.model.estimate import Estimate
from taciturn.model.table import Columns, Tabular

if TYPE_CHECKING:
    import xarray

if TYPE_CHECKING:
    import pandas
    import xarray


class SweepTable(Tabular):
    """The result of a sweep as a table, with one row per cell and one column per name.

    Args:
        result: the labelled arrays that ``sweep`` returned, or that were read from its file.
    """

    def __init__(self, result: xarray.Dataset) -> None:
        """Store the result."""
        self.result = result

    def summary(self) -> Mapping[str, object]:
        """Return the number of values for each name of the grid."""
        return {str(name): size for name, size in self.result.sizes.items()}

    def __str__(self) -> str:
        """Return the text that ``taciturn sweep`` prints."""
        return sweep_text(self.result)

    def about(self) -> dict[str, object]:
        """Return the attributes of the result: version, seed, digest of the problem, units."""
        units = {name: array.attrs["units"] for name, array in self.result.items() if "units" in array.attrs}
        return {**self.result.attrs, "units": "; ".join(f"{name}: {unit}" for name, unit in units.items())}

    def columns(self) -> Columns:
        """Return the columns; a value and its standard error are one estimate, and missing values are None."""
        frame: Any = self.to_pandas()  # pandas' types are incomplete
        found: dict[str, list[Any]] = {
            name: [None if one != one else one for one in frame[name].tolist()] for name in frame
        }
        for name in [name for name in found if f"{name}_standard_error" in found]:
            parts = zip(found[name], found.pop(f"{name}_standard_error"), found["cost_method"], strict=True)
            found[name] = [None if value is None else Estimate(value, error, how) for value, error, how in parts]
        return found

    def to_pandas(self) -> pandas.DataFrame:
        """Return a data frame; its ``attrs`` are the attributes of the result.

        Raises:
            ProblemError: pandas is not installed.
        """
        frame = self.result.to_dataframe().reset_index()
        frame.attrs.update(self.result.attrs)
        return frame


def sweep_text(found: xarray.Dataset) -> str:
    """Return the grid of a sweep, and the cells with the smallest and the largest cost."""
    grid = " × ".join(f"{name} ({size})" for name, size in found.sizes.items())
    refused = int((found.refusal != "").sum())
    parts = [f"{found.refusal.size} cells over {grid}: {found.refusal.size - refused} evaluated, {refused} refused"]
    ends = () if refused == found.refusal.size else (("smallest", found.cost.argmin), ("largest", found.cost.argmax))
    for name, find in ends:
        at = found.isel(find(...))
        where = ", ".join(f"{key} = {at[key].item()}" for key in found.sizes)
        cost = Estimate(at.cost.item(), at.cost_standard_error.item(), at.cost_method.item(), at.cost_error.item())
        rates = [
            f"{at[key].item():.4g} {at[key].units} ({key[5:]})"
            for key in map(str, found.data_vars)
            if key.startswith("rate_") and f"{key}_standard_error" in found
        ]
        parts.append(f"{name} cost {cost} at {where}; {', '.join(rates)}")
    return "\n".join(map(wrapped_text, parts))
