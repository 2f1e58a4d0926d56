"""Schedules of sensor queries that are computed offline and can be printed, plotted and exported as tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array
from taciturn._figure import Panel, Series, Size, draw
from taciturn.errors import ProblemError
from taciturn.model.result import Column, Columns, Tabular

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SHOWN = 30  # smallest number of steps shown in a figure


@dataclass(frozen=True, eq=False, repr=False)
class Schedule(Tabular):
    """A schedule that queries sensors at the steps at which the value of a query exceeds its price.

    Step k is followed by step k + 1, and the last step by step ``start``, from which the schedule repeats. For a
    finite horizon the schedule does not repeat, and ``start`` is None.

    Args:
        queries: whether the sensor is queried at each step, (steps,); for several sensors, (steps, links).
        value: value h(Σ) of a query, its reduction of the optimal cost-to-go, or the largest variance of an output,
            (steps,) or (steps, links).
        covariance: error covariance Σ of the predicted estimate before the queries, (steps, n, n).
        price: price ζ of a query, or the threshold of the variances; a sensor is queried if value > price.
        start: first step of the repeating part, or None.
        discount: discount factor α per step; 1 for an average or a finite horizon.
        links: the links of the sensors.
    """

    index: ClassVar[str] = "tick"
    heading: ClassVar[tuple[str, ...]] = ("price", "discount")

    queries: npt.NDArray[np.bool_]
    value: Array
    covariance: Array
    price: float
    start: int | None
    discount: float = 1.0
    links: tuple[str, ...] = ("sensor",)

    @property
    def by_link(self) -> Mapping[str, Schedule]:
        """The schedule of each sensor by its link."""
        if len(self.links) == 1:
            return {self.links[0]: self}
        columns = zip(self.links, self.queries.T, self.value.T, strict=True)
        return {link: replace(self, queries=asked, value=value, links=(link,)) for link, asked, value in columns}

    @property
    def rates(self) -> Mapping[str, float]:
        """Mean queries per step by link, as ``rate`` states them."""
        return {link: one.rate for link, one in self.by_link.items()}

    @property
    def period(self) -> int | None:
        """Steps after which the schedule repeats, or None for a finite horizon."""
        return None if self.start is None else len(self.queries) - self.start

    @property
    def rate(self) -> float:
        """Mean queries per step over the repeating part or the horizon; if discounted, (1−α)Σα^k over query steps k.

        Raises:
            ProblemError: the schedule has several links.
        """
        self._expect_one("rates")
        if self.discount == 1 or self.start is None:
            return float(self.queries[self.start or 0 :].mean())
        weights = self.discount ** np.arange(len(self.queries)) * self.queries
        turns = 1 - self.discount ** (len(self.queries) - self.start)
        return float((1 - self.discount) * (weights[: self.start].sum() + weights[self.start :].sum() / turns))

    @property
    def ticks(self) -> list[int]:
        """The steps at which the sensor is queried.

        Raises:
            ProblemError: the schedule has several links.
        """
        self._expect_one("by_link")
        return [int(tick) for tick in np.flatnonzero(self.queries)]

    def repeating(self) -> Schedule:
        """Return the schedule without the steps before its repeating part."""
        kept = slice(self.start or 0, None)
        start = None if self.start is None else 0
        return replace(
            self, queries=self.queries[kept], value=self.value[kept], covariance=self.covariance[kept], start=start
        )

    def document(self) -> dict[str, Any]:
        """Return the schedule as a dictionary for JSON: queried steps, length, repetition and value of each query.

        For several sensors, queried steps, rate and values are dictionaries by link.
        """
        parts = self.by_link.items()
        found: dict[str, Any] = {
            "queries": {link: one.ticks for link, one in parts},
            "length": len(self.queries),
            "repeats_from": self.start,
            "period": self.period,
            "rate": dict(self.rates),
            "value": {link: one.value.tolist() for link, one in parts},
            "price": self.price,
        }
        if len(parts) == 1:
            found |= {name: found[name][self.links[0]] for name in ("queries", "rate", "value")}
        return found

    def plot(self, ax: Any = None, figsize: Size | None = None) -> Figure:
        """Return a figure of the values, the price and the queries; a short cycle is shown several times."""
        shown = list(range(len(self.queries)))
        while self.start is not None and len(shown) < SHOWN:
            shown += range(self.start, len(self.queries))
        ticks = [float(k) for k in range(len(shown))]
        limit = Series([ticks[0], ticks[-1]], [self.price] * 2, "price, ζ", "dashed", color=3)
        where = "" if self.start is None else f"repeats every {self.period} steps from step {self.start}"
        panels, marked = list[Panel](), list[Panel]()
        for link, one in self.by_link.items():
            of, query = ("", "query") if len(self.links) == 1 else (f" of {link}", f"query of {link}")
            asked = [k for k, tick in zip(ticks, shown, strict=True) if one.queries[tick]]
            values = [Series(ticks, one.value[shown].tolist(), f"value of a query{of}, h"), limit]
            marks = [Series(asked, [1.0] * len(asked), f"queries{of}: {len(asked)} of {len(shown)}", "stems")]
            panels.append(Panel(values, ylabel="cost", title="" if panels else where))
            last = "step" if link == self.links[-1] else ""
            marked.append(Panel(marks, xlabel=last, ylabel=query))
        return draw([*panels, *marked], ax, figsize)

    def columns(self) -> Columns:
        """Return the columns step, value, query and diagonal of the covariance, with one row per step.

        For several sensors, there is a column of values and of queries for each link.
        """
        columns: dict[str, Column] = {"tick": range(len(self.queries))}
        for link, one in self.by_link.items():
            of = "" if len(self.links) == 1 else f"_{link}"
            columns |= {f"value{of}": one.value, f"query{of}": one.queries}
        columns |= {f"variance{i + 1}": self.covariance[:, i, i] for i in range(self.covariance.shape[1])}
        return columns

    def _expect_one(self, several: str) -> None:
        """Raise a ``ProblemError`` with the property to use instead if the schedule has several links."""
        if len(self.links) > 1:
            raise ProblemError(f"the schedule has the links {', '.join(self.links)}; expected one link: use {several}")
