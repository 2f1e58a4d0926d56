"""A schedule of sensor queries: computed offline, seen, plotted and exported as what it is, a table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array
from taciturn._figure import Panel, Series, draw
from taciturn._table import data_frame

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


SHOWN = 30  # ticks of a picture, at least


@dataclass(frozen=True, eq=False)
class Schedule:
    """When a sensor is queried: at the ticks whose query is worth more than its price.

    Tick k of the list is followed by tick k + 1, and the last by tick ``start``: from there on the schedule repeats.
    A finite horizon has no repetition: ``start`` is None.

    Args:
        queries: whether the sensor is queried, (ticks,).
        value: h(Σ), what a query now saves of the optimal cost-to-go, (ticks,).
        covariance: Σ of the predicted estimate before the query, (ticks, n, n).
        price: ζ; the sensor is queried where value > price.
        start: first tick of the part that repeats, or None.
        discount: α of a discounted sum, whose ticks count less the later they are.
    """

    queries: npt.NDArray[np.bool_]
    value: Array
    covariance: Array
    price: float
    start: int | None
    discount: float = 1.0

    @property
    def period(self) -> int | None:
        """Ticks after which the schedule repeats, or None for a finite horizon."""
        return None if self.start is None else len(self.queries) - self.start

    @property
    def rate(self) -> float:
        """Queries per tick: of the part that repeats, of the whole horizon, or (1−α)Σα^k of a discounted sum."""
        if self.discount == 1 or self.start is None:
            return float(self.queries[self.start or 0 :].mean())
        weights = self.discount ** np.arange(len(self.queries)) * self.queries
        turns = 1 - self.discount ** (len(self.queries) - self.start)
        return float((1 - self.discount) * (weights[: self.start].sum() + weights[self.start :].sum() / turns))

    @property
    def ticks(self) -> list[int]:
        """The ticks at which the sensor is queried."""
        return [int(tick) for tick in np.flatnonzero(self.queries)]

    def repeating(self) -> Schedule:
        """Return the part that repeats, alone."""
        kept = slice(self.start or 0, None)
        start = None if self.start is None else 0
        return Schedule(self.queries[kept], self.value[kept], self.covariance[kept], self.price, start, self.discount)

    def document(self) -> dict[str, Any]:
        """Return what JSON holds of it: queried ticks, length, where it repeats, and the value of each query."""
        return {
            "queries": self.ticks,
            "length": len(self.queries),
            "repeats_from": self.start,
            "period": self.period,
            "rate": self.rate,
            "value": self.value.tolist(),
            "price": self.price,
        }

    def plot(self) -> Figure:
        """Return a figure: the value of a query, its price, and the queries; a short cycle several times."""
        shown = list(range(len(self.queries)))
        while self.start is not None and len(shown) < SHOWN:
            shown += range(self.start, len(self.queries))
        ticks = [float(k) for k in range(len(shown))]
        asked = [k for k, tick in zip(ticks, shown, strict=True) if self.queries[tick]]
        values = [
            Series(ticks, self.value[shown].tolist(), "value of a query, h"),
            Series([ticks[0], ticks[-1]], [self.price] * 2, "price, ζ", "dashed", color=3),
        ]
        marks = [Series(asked, [1.0] * len(asked), f"queries: {len(asked)} of {len(shown)}", "stems")]
        where = "" if self.start is None else f"from tick {self.start} on it repeats every {self.period}"
        return draw([Panel(values, ylabel="cost", title=where), Panel(marks, xlabel="tick", ylabel="query")])

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with one row per tick: value, query, and the diagonal of the covariance.

        Raises:
            ProblemError: pandas is not installed.
        """
        columns: dict[str, object] = {"value": self.value, "query": self.queries}
        columns |= {f"variance{i + 1}": self.covariance[:, i, i] for i in range(self.covariance.shape[1])}
        return data_frame(columns, "tick", range(len(self.queries)))
