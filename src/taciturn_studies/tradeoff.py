"""Cost against rate of a policy over its parameters, with fair periodic control and the guarantee.

Each point of a grid is an evaluation (``points``), all with one seed, so that the errors of two points are correlated.
Its row has the upper bound (the one at the measured rate if every point has it), the cost of fair periodic control at
the same rate, and, if a confidence is given, the lower bound on every schedule. The figure shows cost against rate for
each link. Below the lower bounds of all points, max_i (c_i + λ_i (r_i − r)) over rates r, lies the region that no
schedule reaches; it is drawn if all points have one controller.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import (
    HEIGHT,
    Panel,
    Progress,
    Series,
    Size,
    answered_within,
    draw,
    in_notebook,
    per_unit,
    percent,
    wrapped_text,
)
from taciturn.model.estimate import Estimate
from taciturn.model.result import SPLICED, Field, Result, Tabular, plain_fields
from taciturn.problem import Problem
from taciturn.problem.without_file import Studied, as_problem
from taciturn.simulation.average import check_effort
from taciturn.study.evaluation import (
    Evaluation,
    TimeUnit,
    Unit,
    columns_of,
    percent_above,
    rate_unit,
)
from taciturn.study.periodic import ClockKind, ClockPoint, clock_of
from taciturn.study.record import Store
from taciturn_studies.points import Cell, Effort, check_confidence, check_grid, evaluate_cells, grid_of, label_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINE = 200  # points of the boundary of the region that no schedule reaches
ROOM = 1.25  # top of the figure, as a multiple of the highest extra cost of the policy
GRAY = 7


def tradeoff(
    problem: Studied,
    over: Mapping[str, Sequence[object]],
    *,
    seed: int = 0,
    standard_error: float | None = None,
    confidence: float | None = None,
    executor: Executor | None = None,
    store: str | Path | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Tradeoff:
    """Return cost against rate of a problem's policy over a grid of its parameters.

    Args:
        problem: the problem in which each point changes the named keys.
        over: the values of each key: a key of ``[policy]``, or a dotted path; several keys make a grid.
        seed: seed of the random draws, the same at every point, so the errors of two points are correlated.
        standard_error: absolute standard error of each cost; default: 1e-4 of the cost.
        confidence: confidence of lower bounds on the cost of any scheduling at the measured rates; default: no lower
            bounds. Points without a lower bound are allowed unless no point has one.
        executor: executor that runs the points, as in ``sweep``; default: this process.
        store: folder that stores the points, as in ``sweep``; a second run computes only the missing points.
        time_limit: time limit in seconds; default: none. Without a result in time, an error is raised; the cells that
            are stored remain.
        progress: callback that receives the fraction done.

    Returns:
        The points, with the curve of periodic control for the same plant and cost.

    Raises:
        ProblemError: no values are given, a key is unknown, or the data are inconsistent.
    """
    with answered_within(time_limit):
        problem = as_problem("problem", problem)
        check_effort(seed, standard_error, None)
        grid = grid_of(check_grid(over))
        problems = [problem.changed(cell) for cell in grid]
        for changed in problems:
            changed.designed()  # reports a mistake in the last cell before the first one runs
        if len({changed.cost.mission for changed in problems}) > 1:
            raise ProblemError(
                "the grid mixes averages and finite-horizon runs, whose costs have different units; expected costs of "
                "one kind"
            )
        check_confidence(problems, confidence)
        effort, cells = Effort(standard_error, confidence), [Cell(values, seed) for values in grid]
        kept = None if store is None else Store(store, label_of(problem))
        found = evaluate_cells(problem, cells, effort, executor, kept, in_notebook(progress))
        points = [Point(cell, evaluation) for cell, evaluation in zip(grid, found, strict=True)]
        unit, statement = points[0].evaluation.unit, points[0].evaluation.statement
        return Tradeoff(tuple(points), _curves(problems, points, over), unit, statement)


def _curves(
    problems: Sequence[Problem], points: Sequence[Point], over: Mapping[str, object]
) -> dict[ClockKind, tuple[ClockPoint, ...]]:
    """Return the curves of periodic control that all points share; there are none if plant, cost or period varies."""
    if any(name.removeprefix("policy.") == "period" or "." in name.removeprefix("policy.") for name in over):
        return {}
    fastest = max(point.evaluation.base_rate or 2 * _rate(point) for point in points)
    slowest = min((_rate(point) for point in points if _rate(point) > 0), default=fastest)
    curves: dict[ClockKind, tuple[ClockPoint, ...]] = {}
    for problem, point in zip(problems, points, strict=True):
        used = point.evaluation.clock
        if used is not None and used.words not in curves:
            clock = clock_of(problem, problem.designed())
            assert clock is not None
            curves[used.words] = clock.curve(fastest, slowest)
    return curves


@dataclass(frozen=True, repr=False)
class Point(Result):
    """One point of the trade-off.

    Args:
        values: values of the varied keys.
        evaluation: evaluation of the policy, with fair periodic control at its rate.
    """

    FIELDS: ClassVar[tuple[Field[Point], ...]] = (Field("values"), Field("evaluation", key=SPLICED))

    values: Mapping[str, Any] = field(hash=False)
    evaluation: Evaluation

    def summary(self) -> Mapping[str, object]:
        """Return the values of the varied keys, and the cost and rates at these values, by name."""
        return {"values": self.values, "cost": self.evaluation.cost, "rates": self.evaluation.rates}

    def short(self) -> str:
        """Return the values of the varied keys."""
        return ", ".join(f"{name} = {value}" for name, value in self.values.items())

    @property
    def cost_periodic_same_rate(self) -> float | None:
        """Exact cost of fair periodic control, or None if there is none."""
        return self.evaluation.cost_periodic_same_rate


def _curves_document(curves: Mapping[ClockKind, Sequence[ClockPoint]]) -> dict[str, Any]:
    return {kind: [{"rate": p.rate, "cost": p.cost} for p in curve] for kind, curve in curves.items()}


def _every_sample(found: Tradeoff) -> str:
    first = found.points[0].evaluation
    pace = "" if first.base_rate is None else f" at {first.base_rate:.4g} sends per {first.rate_unit}"
    return f"{first.cost_all_time:.6g}{pace}" if found.one_base else ""


@dataclass(frozen=True, repr=False)
class Tradeoff(Tabular):
    """Cost against rate of a policy.

    Args:
        points: points in the order of the grid.
        periodic: curves of fair periodic control by actuation, that is, of time-triggered control with the measurements
            and the actuation of the policy; empty if plant, cost or period differ between points.
        unit: unit of time or run that the cost refers to: ``"step"``, ``"second"``, ``"second at the sampling
            instants"`` or ``"mission"``.
        guarantee: the theorem that proves the bounds, or None.
    """

    FIELDS: ClassVar[tuple[Field[Tradeoff], ...]] = (
        Field("points"),
        Field("periodic", json=_curves_document),
        *plain_fields("unit", "rate_unit", "method"),
        Field("every sample", key="", say="every sample", text=_every_sample),
        Field("guarantee", say="guarantee", text=lambda found: (found.one_base and found.guarantee) or ""),
    )
    heading: ClassVar[tuple[str, ...]] = ("unit", "rate_unit", "method", "guarantee")

    points: tuple[Point, ...]
    periodic: Mapping[ClockKind, tuple[ClockPoint, ...]] = field(hash=False)
    unit: Unit
    guarantee: str | None

    def summary(self) -> Mapping[str, object]:
        """Return the values of the varied keys, and the rates and costs of all points, by name."""
        columns = self.columns()
        names = [*self.points[0].values, *(f"rate_{link}" for link in self.points[0].evaluation.rates), "cost"]
        shown = {name: [one.value if isinstance(one, Estimate) else one for one in columns[name]] for name in names}
        return {**shown, "unit": self.unit, "rate_unit": self.rate_unit, "method": self.method}

    @property
    def rate_unit(self) -> TimeUnit:
        """Unit of time of the rates."""
        return rate_unit(self.unit)

    @property
    def method(self) -> str:
        """Methods that gave the points."""
        return ", ".join(dict.fromkeys(point.evaluation.method for point in self.points))

    @property
    def one_controller(self) -> bool:
        """True if all points have the same sampling rate and cost of sending every sample."""
        return len({(one.evaluation.base_rate, one.evaluation.cost_all_time) for one in self.points}) == 1

    @property
    def one_base(self) -> bool:
        """True if sending every sample has one cost, the same at all points."""
        return len(costs := {one.evaluation.cost_all_time for one in self.points}) == 1 and None not in costs

    @property
    def labels(self) -> int:
        """Number of the varied keys."""
        return len(self.points[0].values)

    def table_rows(self) -> Sequence[Point]:
        """Return the points."""
        return self.points

    def row_fields(self) -> tuple[Field[Point], ...]:
        """Return varied values, rates, cost, bounds, and cost of periodic control at the rate of a point."""
        found = [point.evaluation for point in self.points]
        links = list(dict.fromkeys(link for one in found for link in one.rates))
        sharp = "guarantee, this rate" if all(one.cost_bound_at_rate is not None for one in found) else None
        below, least = "no schedule below" if self._bounded else None, "no_schedule_below"
        seen = [one.violations for one in found if one.violations is not None]

        def value(name: str) -> Field[Point]:
            return Field(name, lambda p: p.values[name], column=name, say=name, text=lambda p: str(p.values[name]))

        def rate(link: str) -> Field[Point]:
            heading = f"sends per {self.rate_unit}{f', {link}' if len(links) > 1 else ''}"
            return Field(link, lambda point: point.evaluation.rates.get(link), column=f"rate_{link}", say=heading)

        def extra(point: Point) -> str:
            base = point.evaluation.cost_all_time
            return percent_above(point.evaluation.cost, base) if base else ""

        def violation(name: str) -> Field[Point]:
            heading = {"violation": "violation per step", "violation_within": f"within {seen[0].window}"}.get(name)

            def share(point: Point) -> Estimate | None:
                found = point.evaluation.violations
                return None if found is None else found.records().get(name)

            return Field(name, share, column=name, say=heading, none="none")

        return (
            *map(value, self.points[0].values),
            *map(rate, links),
            Field("cost", "evaluation.cost", column="cost", say=f"cost {per_unit(self.unit)}"),
            Field("extra", say="extra cost", text=extra),
            Field("guarantee", "evaluation.cost_bound", column="guarantee", say=None if sharp else "guarantee", up=1),
            Field("guarantee_at_rate", "evaluation.guarantee_at_rate", column="guarantee_at_rate", say=sharp, up=1),
            Field(
                "periodic", "evaluation.periodic", column="periodic_same_rate", say="periodic, same rate", none="none"
            ),
            Field(
                "lowest",
                "evaluation.lower_bound.cost",
                optional=True,
                column=least,
                say=below,
                text="{:.6g}",
                none="none",
                up=-1,
            ),
            *map(violation, dict.fromkeys(name for one in seen for name in one.records())),
            *columns_of(lambda point: point.evaluation),
        )

    @property
    def _bounded(self) -> bool:
        return any(point.evaluation.lower_bound is not None for point in self.points)

    def remarks(self) -> Iterator[str]:
        """Yield the notes, each with the points at which it applies."""
        for note in dict.fromkeys(note for point in self.points for note in point.evaluation.notes):
            at = [point.short() for point in self.points if note in point.evaluation.notes]
            yield wrapped_text(note if len(at) == len(self.points) else f"{'; '.join(at)}: {note}")
        if self._bounded and not self.one_controller:
            yield wrapped_text("a figure shows no lower bounds: they belong to controllers with different costs")

    def plot(self, ax: Any = None, figsize: Size | None = None) -> Figure:
        """Return a figure of cost against the rate of each link.

        It shows the policy, its guarantee (the one at the measured rate, if there is one), periodic control, and the
        cost of sending every sample.

        Args:
            ax: existing axes to draw in instead of a new figure, one for each link.
            figsize: width and height of a new figure, in inches.
        """
        links = list(self.points[0].evaluation.rates)
        panels = [self._panel(link, f"of the {link} link " if len(links) > 1 else "") for link in links]
        return draw(panels, ax, figsize, height=HEIGHT * len(panels))

    def _panel(self, link: str, named: str) -> Panel:
        series: list[Series] = []
        families: dict[tuple[tuple[str, Any], ...], list[Point]] = {}
        cells = [point.values for point in self.points]
        names = list(cells[0])  # points are connected along the first key with numerical values
        lead = next((n for n in names if all(isinstance(cell[n], int | float) for cell in cells)), names[0])
        for point in self.points:
            families.setdefault(tuple((k, v) for k, v in point.values.items() if k != lead), []).append(point)
        for index, (family, points) in enumerate(families.items()):
            found = sorted((point.evaluation for point in points), key=lambda one: one.rates[link].value)
            words = [value if isinstance(value, str) else f"{key} = {value}" for key, value in family]
            label = ", ".join([found[0].policy, *words])
            x, y = [one.rates[link].value for one in found], [one.cost.value for one in found]
            series.append(Series(x, y, label, error=[one.cost.standard_error for one in found], color=index))
            bounds = [one.cost_bound if one.cost_bound_at_rate is None else one.cost_bound_at_rate for one in found]
            inside = [(a, b) for a, b in zip(x, bounds, strict=True) if b is not None]
            if len(inside) > 1:
                proved = "" if len(families) > 1 else "guarantee"
                series.append(Series([a for a, _ in inside], [b for _, b in inside], proved, "dotted", color=index))
        for kind, curve in self.periodic.items():
            style = "dashed" if len(self.periodic) == 1 or kind == "hold" else "line"
            x, y = [p.rate for p in curve], [p.cost for p in curve]
            series.append(Series(x, y, f"periodic control, {kind}", style, color=GRAY))
        series += self._every_sample() + self._impossible()
        title = "dotted: guarantee" if any(s.style == "dotted" and not s.label for s in series) else ""
        return Panel(
            series, f"sends {named}per {self.rate_unit}", f"cost {per_unit(self.unit)}", title, ylim=self._limits()
        )

    def _limits(self) -> tuple[float, float]:
        """Return the cost limits of the figure, from the policy only, so that a large bound does not compress it."""
        costs = [point.evaluation.cost.value for point in self.points]
        bases = [one.evaluation.cost_all_time for one in self.points if one.evaluation.cost_all_time is not None]
        low, high = min([*costs, *bases]), max(costs)
        spread = (high - low) or abs(high) or 1.0
        return low - 0.05 * spread, low + ROOM * spread

    def _every_sample(self) -> list[Series]:
        """Return the line of sending every sample, if its cost is the same for all points."""
        found = [point.evaluation for point in self.points]
        if found[0].cost_all_time is None or len({one.cost_all_time for one in found}) > 1:
            return []
        rates = [rate.value for one in found for rate in one.rates.values()]
        most = max([*rates, *(p.rate for curve in self.periodic.values() for p in curve)])
        return [Series([min(rates), most], [found[0].cost_all_time] * 2, "sending every sample", color=2)]

    def _impossible(self) -> list[Series]:
        """Return the region that no schedule reaches: below the lines of the lower bounds of all points."""
        found = [point.evaluation for point in self.points]
        bounds = [one.lower_bound for one in found if one.lower_bound is not None]
        pace, base = found[0].base_rate, found[0].cost_all_time
        if not bounds or not self.one_controller or pace is None or base is None:
            return []
        rates = [float(rate) for rate in np.linspace(min(one.rate for one in bounds), 1.0, LINE)]
        lowest = [max(base, *(one.at_rate(rate) for one in bounds)) for rate in rates]
        sure = percent(min(one.confidence for one in bounds))
        return [
            Series([pace * rate for rate in rates], lowest, f"no schedule of this controller, {sure} sure", "below")
        ]


def _rate(point: Point) -> float:
    return next(iter(point.evaluation.rates.values())).value
