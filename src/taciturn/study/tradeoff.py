"""Cost against rate: a policy over its parameters, beside optimal periodic control and the guarantee."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn._figure import Panel, Series, draw
from taciturn._progress import Progress
from taciturn.design.certainty import Actuation
from taciturn.errors import ProblemError
from taciturn.problem import Problem, expect_problem
from taciturn.study.cells import Cell, Effort, check_confidence, evaluate_cells
from taciturn.study.evaluate import Evaluation
from taciturn.study.periodic import PeriodicPoint, actuation_of, periodic_cost_at, periodic_curve, why_no_periodic
from taciturn.study.store import Store
from taciturn.study.sweep import check_grid, grid_of, label_of
from taciturn.study.units import Unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINE = 200  # points of the line above what no scheduling reaches


@dataclass(frozen=True)
class Point:
    """One evaluation, and optimal periodic control at its rate with the same actuation.

    Args:
        values: what was varied.
        evaluation: of the policy.
        actuation: of the policy, and of the periodic controller it is compared with.
        cost_periodic_same_rate: exact; a discrete plant time-shares the two nearest rates. None where none is stable,
            or none is comparable: with scheduled queries, for missions, in a loop that is not the one of its design.
    """

    values: Mapping[str, Any]
    evaluation: Evaluation
    actuation: Actuation
    cost_periodic_same_rate: float | None


@dataclass(frozen=True)
class Tradeoff:
    """Cost against rate.

    Args:
        points: in the order of the grid.
        periodic: the curve of optimal periodic control, by actuation; none where plant or cost differ between points.
        unit: what the cost counts per: ``"step"``, ``"second"`` or ``"mission"``.
        guarantee: the theorem behind the bounds, or None.
        notes: what is missing, and why.
    """

    points: tuple[Point, ...]
    periodic: Mapping[Actuation, tuple[PeriodicPoint, ...]]
    unit: Unit
    guarantee: str | None
    notes: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn tradeoff --json``."""
        return {
            "points": [
                {"values": dict(point.values), "cost_periodic_same_rate": point.cost_periodic_same_rate}
                | point.evaluation.document()
                for point in self.points
            ],
            "periodic": {
                actuation: [{"rate": p.rate, "cost": p.cost} for p in curve]
                for actuation, curve in self.periodic.items()
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
        for actuation, curve in self.periodic.items():
            style = "dashed" if len(self.periodic) == 1 or actuation == "hold" else "line"
            shown, color = [p for p in curve if p.cost <= top], 7 if actuation == "hold" else 5
            x, y = [p.rate for p in shown], [p.cost for p in shown]
            series.append(Series(x, y, f"periodic, {actuation}", style, color=color))
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
        if len(bounds) < len(found) or len(paces | bases) > 2 or pace is None or base is None:
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
        seed: of the draws, the same at every point.
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
    points: list[Point] = []
    for cell, changed, evaluation in zip(grid, problems, found, strict=True):
        actuation = actuation_of(changed)
        rate = next(iter(evaluation.rates.values())).value
        same = None if evaluation.schedule else periodic_cost_at(changed, rate, actuation)
        points.append(Point(cell, evaluation, actuation, same))
    reasons = [why_no_periodic(one, point.actuation) for one, point in zip(problems, points, strict=True)]
    notes = tuple(dict.fromkeys(reason for reason in reasons if reason is not None))
    unit, statement = points[0].evaluation.unit, points[0].evaluation.statement
    return Tradeoff(tuple(points), _curves(problems, points, over), unit, statement, notes)


def _curves(
    problems: Sequence[Problem], points: Sequence[Point], over: Mapping[str, object]
) -> dict[Actuation, tuple[PeriodicPoint, ...]]:
    """Return the periodic curves that all points share: none where a key outside [policy] was varied."""
    if any("." in name and not name.startswith("policy.") for name in over):
        return {}
    if any(point.evaluation.schedule for point in points):
        return {}
    used: set[Actuation] = {point.actuation for point in points}
    fastest = max(point.evaluation.base_rate or 2 * _rate(point) for point in points)
    slowest = min((_rate(point) for point in points if _rate(point) > 0), default=fastest)
    curves: dict[Actuation, tuple[PeriodicPoint, ...]] = {}
    for actuation in sorted(used):
        curve = periodic_curve(problems[0], fastest, slowest, actuation)
        if curve:
            curves[actuation] = curve
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
