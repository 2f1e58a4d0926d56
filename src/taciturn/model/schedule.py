"""Schedules of sensor queries that are computed offline and can be printed, plotted and exported as tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array
from taciturn._figure import Panel, Series, Size, draw
from taciturn.model.table import Column, Columns, Tabular

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SHOWN = 30  # smallest number of steps shown in a figure


@dataclass(frozen=True, eq=False, repr=False)
class Schedule(Tabular):
    """A schedule that queries a sensor at the steps at which a query saves more than its price.

    Step k is followed by step k + 1, and the last step by step ``start``, from which the schedule repeats. For a
    finite horizon the schedule does not repeat, and ``start`` is None.

    Args:
        queries: whether the sensor is queried at each step, (steps,).
        value: value h(Σ) of a query, its reduction of the optimal cost-to-go, (steps,).
        covariance: error covariance Σ of the predicted estimate before the query, (steps, n, n).
        price: price ζ of a query; the sensor is queried if value > price.
        start: first step of the repeating part, or None.
        discount: discount factor α per step; 1 for an average or a finite horizon.
    """

    index: ClassVar[str] = "tick"
    heading: ClassVar[tuple[str, ...]] = ("price", "discount")

    queries: npt.NDArray[np.bool_]
    value: Array
    covariance: Array
    price: float
    start: int | None
    discount: float = 1.0

    @property
    def period(self) -> int | None:
        """Steps after which the schedule repeats, or None for a finite horizon."""
        return None if self.start is None else len(self.queries) - self.start

    @property
    def rate(self) -> float:
        """Mean queries per step over the repeating part or the horizon; if discounted, (1−α)Σα^k over query steps k."""
        if self.discount == 1 or self.start is None:
            return float(self.queries[self.start or 0 :].mean())
        weights = self.discount ** np.arange(len(self.queries)) * self.queries
        turns = 1 - self.discount ** (len(self.queries) - self.start)
        return float((1 - self.discount) * (weights[: self.start].sum() + weights[self.start :].sum() / turns))

    @property
    def ticks(self) -> list[int]:
        """The steps at which the sensor is queried."""
        return [int(tick) for tick in np.flatnonzero(self.queries)]

    def repeating(self) -> Schedule:
        """Return the schedule without the steps before its repeating part."""
        kept = slice(self.start or 0, None)
        start = None if self.start is None else 0
        return Schedule(self.queries[kept], self.value[kept], self.covariance[kept], self.price, start, self.discount)

    def document(self) -> dict[str, Any]:
        """Return the schedule as a dictionary for JSON: queried steps, length, repetition and value of each query."""
        return {
            "queries": self.ticks,
            "length": len(self.queries),
            "repeats_from": self.start,
            "period": self.period,
            "rate": self.rate,
            "value": self.value.tolist(),
            "price": self.price,
        }

    def plot(self, ax: Any = None, figsize: Size | None = None) -> Figure:
        """Return a figure of the values, the price and the queries; a short cycle is shown several times."""
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
        where = "" if self.start is None else f"repeats every {self.period} steps from step {self.start}"
        return draw(
            [Panel(values, ylabel="cost", title=where), Panel(marks, xlabel="step", ylabel="query")], ax, figsize
        )

    def columns(self) -> Columns:
        """Return the columns step, value, query and diagonal of the covariance, with one row per step."""
        columns: dict[str, Column] = {
            "tick": range(len(self.queries)),
            "value": self.value,
            "query": self.queries,
        }
        columns |= {f"variance{i + 1}": self.covariance[:, i, i] for i in range(self.covariance.shape[1])}
        return columns
