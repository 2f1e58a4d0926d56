"""Sensor schedules that are computed offline, and can be printed, plotted and exported as tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array
from taciturn._figure import HEIGHT, Lane, Level, Panel, Series, Size, StyleName, draw
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.result import Column, Columns, Tabular

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SHOWN = 30  # smallest number of steps shown in a figure


@dataclass(frozen=True, eq=False, repr=False)
class Schedule(Tabular):
    """A sensor schedule. The sensor is queried at the steps at which the value of a query exceeds its price.

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
        """Schedule of each sensor, by the name of the sensor's link."""
        if len(self.links) == 1:
            return {self.links[0]: self}
        columns = zip(self.links, self.queries.T, self.value.T, strict=True)
        return {link: replace(self, queries=asked, value=value, links=(link,)) for link, asked, value in columns}

    @property
    def rates(self) -> Mapping[str, float]:
        """Mean number of queries per step of each link. The attribute ``rate`` defines this mean."""
        return {link: one.rate for link, one in self.by_link.items()}

    @property
    def period(self) -> int | None:
        """Number of steps after which the schedule repeats; None if it has a finite horizon."""
        return None if self.start is None else len(self.queries) - self.start

    @property
    def rate(self) -> float:
        """Mean queries per step over a period or the horizon; with a discount α, (1−α)Σα^k over the query steps k.

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
        """Numbers of the steps at which the sensor is queried.

        Raises:
            ProblemError: the schedule has several links.
        """
        self._expect_one("by_link")
        return [int(tick) for tick in np.flatnonzero(self.queries)]

    def repeating(self) -> Schedule:
        """Return the part of the schedule that repeats, without the steps before it."""
        kept = slice(self.start or 0, None)
        start = None if self.start is None else 0
        return replace(
            self, queries=self.queries[kept], value=self.value[kept], covariance=self.covariance[kept], start=start
        )

    def document(self) -> dict[str, Any]:
        """Write the schedule as a dictionary for JSON: query steps, length, repetition and values of the queries.

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

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Draw the value of a query at each step, the price, and the steps with a query. A short period is repeated."""
        shown = list(range(len(self.queries)))
        while self.start is not None and len(shown) < SHOWN:
            shown += range(self.start, len(self.queries))
        ticks = [float(k) for k in range(len(shown))]
        where = "" if self.start is None else f"repeats every {number_of(self.period, 'step')} from step {self.start}"
        panels, lanes = list[Panel](), list[Lane]()
        for link, one in self.by_link.items():
            of = "" if len(self.links) == 1 else f" of {link}"
            asked = [k for k, tick in zip(ticks, shown, strict=True) if one.queries[tick]]
            values = [Series(ticks, one.value[shown].tolist(), f"value of a query{of}, h", "steps")]
            price = Level(self.price, "price, ζ", "limits")
            panels.append(
                Panel(values, ylabel="cost", title="" if panels else where, levels=(price,), height=HEIGHT / 2)
            )
            lanes.append(Lane(f"query{of}", asked, note=f"{len(asked)} of {len(shown)}"))
        return draw([*panels, Panel(lanes=lanes, xlabel="step")], ax, figsize, style)

    def columns(self) -> Columns:
        """Return table columns with one row per step: value of the query, whether it is made, and error variances.

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
            raise ProblemError(
                f"the schedule has the links {', '.join(self.links)}; expected a schedule with one link: for several "
                f"links, use {several}"
            )
