"""Cost against rate: a policy over its parameters, beside fair clocks and the guarantee."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn._figure import Panel, Series, draw
from taciturn._progress import Progress
from taciturn.errors import ProblemError
from taciturn.problem import Problem, expect_problem
from taciturn.study.cells import Cell, Effort, check_confidence, evaluate_cells
from taciturn.study.clock import ClockKind, ClockPoint
from taciturn.study.evaluate import Evaluation
from taciturn.study.fair import clock_of
from taciturn.study.store import Store
from taciturn.study.sweep import check_grid, grid_of, label_of
from taciturn.study.units import Unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINE = 200  # points of the line above what no scheduling reaches


@dataclass(frozen=True)
class Point:
    """One evaluation.

    Args:
        values: what was varied.
        evaluation: of the policy, with the fair clock at its rate.
    """

    values: Mapping[str, Any]
    evaluation: Evaluation

    @property
    def cost_periodic_same_rate(self) -> float | None:
        """Exact cost of the fair clock; None where there is none."""
        return self.evaluation.cost_periodic_same_rate


@dataclass(frozen=True)
class Tradeoff:
    """Cost against rate.

    Args:
        points: in the order of the grid.
        periodic: the curve of the fair clock, by its kind: time-triggered control with the measurements and the
            actuation of the policy; none where plant, cost or period differ between points.
        unit: what the cost counts per: ``"step"``, ``"second"`` or ``"mission"``.
        guarantee: the theorem behind the bounds, or None.
    """

    points: tuple[Point, ...]
    periodic: Mapping[ClockKind, tuple[ClockPoint, ...]]
    unit: Unit
    guarantee: str | None

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn tradeoff --json``."""
        return {
            "points": [{"values": dict(point.values)} | point.evaluation.document() for point in self.points],
            "periodic": {
                kind: [{"rate": p.rate, "cost": p.cost} for p in curve] for kind, curve in self.periodic.items()
            },
            "unit": self.unit,
            "guarantee": self.guarantee,
        }

    def plot(self) -> Figure:
        """Return a figure of cost against the rate of each link: the policy, periodic control, the guarantee."""
        links = list(self.points[0].evaluation.rates)
        panels = [self._panel(link, f"of the {link} link " if len(links) > 1 else "") for link in links]
        return draw(panels, height=4.2 * len(panels))

    def _panel(self, link: str, named: str) -> Panel:
        series: list[Series] = []
        families: dict[tuple[tuple[str, Any], ...], list[Point]] = {}
        lead, top = (
            _lead([point.values for point in self.points]),
            1.6 * max(p.evaluation.cost.value for p in self.points),
        )
        for point in self.points:
            families.setdefault(tuple((k, v) for k, v in point.values.items() if k != lead), []).append(point)
        for index, (family, points) in enumerate(families.items()):
            found = sorted((point.evaluation for point in points), key=lambda one: one.rates[link].value)
            label = ", ".join([found[0].policy, *(_name(key, value) for key, value in family)])
            x, y = [one.rates[link].value for one in found], [one.cost.value for one in found]
            series.append(Series(x, y, label, error=[one.cost.standard_error for one in found], color=index))
            bounds = [one.cost_bound for one in found]
            inside = [(a, b) for a, b in zip(x, bounds, strict=True) if b is not None and b <= top]
            if len(inside) > 1:
                series.append(Series([a for a, _ in inside], [b for _, b in inside], "", "dotted", color=index))
        for kind, curve in self.periodic.items():
            style = "dashed" if len(self.periodic) == 1 or kind == "hold" else "line"
            shown, color = [p for p in curve if p.cost <= top], 7 if kind == "hold" else 5
            x, y = [p.rate for p in shown], [p.cost for p in shown]
            series.append(Series(x, y, f"fair clock, {kind}", style, color=color))
        series += self._impossible()
        title = "dotted: guaranteed bound" if any(s.style == "dotted" for s in series) else ""
        rate_unit = self.points[0].evaluation.rate_unit
        return Panel(series, f"sends {named}per {rate_unit}", f"cost per {self.unit}", title)

    def _impossible(self) -> list[Series]:
        """Return what no scheduling reaches: below every line that a lower bound draws through its point."""
        found = [point.evaluation for point in self.points]
        bounds = [one.lower_bound for one in found if one.lower_bound is not None]
        paces, bases = {one.base_rate for one in found}, {one.cost_all_time for one in found}
        pace, base = found[0].base_rate, found[0].cost_all_time
        if not bounds or len(paces) > 1 or len(bases) > 1 or pace is None or base is None:
            return []  # of one controller that looks at one pace
        rates = [float(rate) for rate in np.linspace(min(one.rate for one in bounds), 1.0, LINE)]
        lowest = [max(base, *(one.at_rate(rate) for one in bounds)) for rate in rates]
        return [Series([pace * rate for rate in rates], lowest, "no scheduling", "below")]


def tradeoff(
    problem: Problem,
    over: Mapping[str, Sequence[object]],
    *,
    seed: int = 0,
    standard_error: float | None = None,
    confidence: float | None = None,
    executor: Executor | None = None,
    store: str | Path | None = None,
    progress: Progress | None = None,
) -> Tradeoff:
    """Return cost against rate of a problem's policy over a grid of its parameters.

    Args:
        problem: the problem; each point changes the named keys.
        over: the values of each key (of ``[policy]``, or dotted); several keys make a grid.
        seed: of the draws, the same at every point: the errors of two points are correlated.
        standard_error: absolute, of each cost; omitted: 1e-4 of it.
        confidence: with which lower bounds are to hold of the cost of any scheduling at the rates found; omitted: none
            is sought. Points that have none go without, unless that is all of them.
        executor: runs the points, as in ``sweep``; omitted: here.
        store: folder that keeps the points, as in ``sweep``; a second run computes only what is missing.
        progress: called with the fraction done.

    Returns:
        The points with the periodic curve of the same plant and cost.

    Raises:
        ProblemError: no values, an unknown key, or data that do not fit.
    """
    expect_problem("problem", problem)
    grid = grid_of(check_grid(over))
    problems = [problem.changed(cell) for cell in grid]
    for changed in problems:
        changed.designed()  # a mistake in the last cell is told before the first one runs
    if len({changed.cost.mission for changed in problems}) > 1:
        raise ProblemError("the grid mixes averages and missions, whose costs count differently; expected one of them")
    check_confidence(problems, confidence)
    effort, cells = Effort(standard_error, confidence), [Cell(values, seed) for values in grid]
    kept = None if store is None else Store(store, label_of(problem))
    found = evaluate_cells(problem, cells, effort, executor, kept, progress)
    points = [Point(cell, evaluation) for cell, evaluation in zip(grid, found, strict=True)]
    unit, statement = points[0].evaluation.unit, points[0].evaluation.statement
    return Tradeoff(tuple(points), _curves(problems, points, over), unit, statement)


def _curves(
    problems: Sequence[Problem], points: Sequence[Point], over: Mapping[str, object]
) -> dict[ClockKind, tuple[ClockPoint, ...]]:
    """Return the curves of the clocks that all points share: none where what a clock depends on was varied."""
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


def _lead(cells: Sequence[Mapping[str, Any]]) -> str:
    """Return the key along which points are joined: the first whose values are numbers."""
    names = list(cells[0])
    return next((n for n in names if all(isinstance(cell[n], int | float) for cell in cells)), names[0])


def _name(key: str, value: object) -> str:
    """Return a value as a legend shows it: words speak for themselves."""
    return value if isinstance(value, str) else f"{key} = {value}"


def _rate(point: Point) -> float:
    return next(iter(point.evaluation.rates.values())).value
