"""Cost of a policy against its rate for a range of parameters, with fair periodic control and the guarantee.

Each point of a grid is an evaluation (``points``), all with one seed, so that the errors of two points are correlated.
Its row has the upper bound (the one at the measured rate if every point has it), the cost of fair periodic control at
the same rate, and, if a confidence is given, the lower bound on every schedule. If the nodes measure a certificate, the
row and the figure have it, and also what the theorem promises in advance. A given controller on several links is
compared with periodic control of the same controller at the same traffic (``periodic_links``). The figure
(``tradeoff_figure``) shows cost against rate or, for several links, against the traffic.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import (
    Progress,
    Size,
    StyleName,
    answered_within,
    draw,
    in_notebook,
    number_of,
    per_unit,
    table_text,
)
from taciturn.model.estimate import Estimate, bound_text
from taciturn.model.result import SPLICED, VERDICT, Field, Result, Tabular, plain_fields
from taciturn.problem import Problem
from taciturn.problem.without_file import Studied, as_problem
from taciturn.simulation.average import check_effort
from taciturn.study.baseline import common_base
from taciturn.study.evaluate import SURE
from taciturn.study.evaluation import (
    Evaluation,
    TimeUnit,
    Unit,
    columns_of,
    cost_text,
    packets_text,
    rate_unit,
    withdrawn_text,
)
from taciturn.study.periodic import ClockKind, ClockPoint, clock_of
from taciturn.study.record import Store
from taciturn.study.sentences import (
    THAN,
    percent_above,
    percent_text,
    share_of,
    share_text,
    together,
)
from taciturn_studies.periodic_links import at_same_traffic
from taciturn_studies.points import Cell, Effort, check_confidence, check_grid, evaluate_cells, grid_of, label_of
from taciturn_studies.tradeoff_figure import panels_of
from taciturn_studies.tune import tunings_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STEP, EACH_WAY = 2.0, 3  # factor between the usual values of a parameter, and their number on either side


def tradeoff(
    problem: Studied,
    over: Mapping[str, Sequence[object]] | None = None,
    *,
    seed: int = 0,
    standard_error: float | None = None,
    confidence: float | None = None,
    executor: Executor | None = None,
    store: str | Path | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Tradeoff:
    """Compute the cost and the rate of a problem's policy for all values of a grid of parameters.

    Args:
        problem: the problem in which each point changes the named keys.
        over: the values of each key: a key of ``[policy]``, or a dotted path; several keys make a grid. Default: the
            present value of the parameter that trades cost for rate, and values up to eight times as large or small.
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
        over = usual_values(problem) if over is None else over
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
        points = [
            Point(cell, evaluation, at_same_traffic(changed, evaluation))
            for cell, changed, evaluation in zip(grid, problems, found, strict=True)
        ]
        stated = dict.fromkeys(one.statement for one in found if one.statement is not None)
        return Tradeoff(tuple(points), _curves(problems, points, over), found[0].unit, "; or ".join(stated) or None)


def usual_values(problem: Problem) -> dict[str, list[float]]:
    """Return values around the present value of the tuning parameter at which a policy can be designed."""
    tunings = tunings_of(problem, None)
    if not tunings:
        raise ProblemError(
            f"the policy kind {problem.kind} has no parameter that changes its rate; expected a key to vary and its "
            "values (--over or over=)"
        )
    tuning = tunings[0]
    start = tuning.value_in(problem.parameters)
    around = [tuning.least + (start - tuning.least) * STEP**k for k in range(-EACH_WAY, EACH_WAY + 1)]
    if tuning.whole:
        around = [max(int(tuning.least), round(start * STEP**k)) for k in range(-EACH_WAY, EACH_WAY + 1)]
    found = list[float]()
    for value in dict.fromkeys(one if one == start or tuning.whole else float(f"{one:.3g}") for one in around):
        try:
            problem.changed({tuning.name: value}).designed()
        except TaciturnError:
            if value == start:
                raise
        else:
            found.append(value)
    return {tuning.name: found}


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
        same_traffic: cost of periodic control of a given controller on several links at the same traffic, with the
            standard error that the traffic causes; else None.
    """

    FIELDS: ClassVar[tuple[Field[Point], ...]] = (
        Field("values"),
        Field("evaluation", key=SPLICED),
        Field("same_traffic", key="cost_periodic_same_traffic", json=Estimate.document, optional=True),
    )

    values: Mapping[str, Any] = field(hash=False)
    evaluation: Evaluation
    same_traffic: Estimate | None = None

    def summary(self) -> Mapping[str, object]:
        """Return the values of the varied keys and the resulting cost and rates, by name."""
        return {"values": self.values, "cost": self.evaluation.cost, "rates": self.evaluation.rates}

    def short(self) -> str:
        """Return a text with the values of the varied keys at this point."""
        return ", ".join(f"{name} = {value}" for name, value in self.values.items())

    @property
    def cost_periodic_same_rate(self) -> float | None:
        """Exact cost of fair periodic control at the same rate; None if that control does not exist."""
        return self.evaluation.cost_periodic_same_rate

    @property
    def periodic(self) -> Estimate | None:
        """Cost of periodic control at the same traffic or, with a single link, at the same rate; None if unknown."""
        return self.evaluation.periodic if self.same_traffic is None else self.same_traffic


def _curves_document(curves: Mapping[ClockKind, Sequence[ClockPoint]]) -> dict[str, Any]:
    return {kind: [{"rate": p.rate, "cost": p.cost} for p in curve] for kind, curve in curves.items()}


def _every_sample(found: Tradeoff) -> str:
    """Return the cost of sending every sample, and the packets of all links."""
    first, links = found.points[0].evaluation, len(found.links)
    if found.base is None or first.base_rate is None:
        return "" if found.base is None else str(found.base)
    sends = number_of(f"{links * first.base_rate:.4g}", "send")
    return f"{found.base} at {sends} per {first.rate_unit}{f' on {links} links' if links > 1 else ''}"


def _notes(found: Tradeoff) -> Iterator[str]:
    """Yield the notes, each with the points at which it applies."""
    for note in dict.fromkeys(note for point in found.points for note in point.evaluation.notes):
        at = [point.short() for point in found.points if note in point.evaluation.notes]
        yield note if len(at) == len(found.points) else f"{'; '.join(at)}: {note}"
    if found.bounded and not found.one_controller:
        yield "a figure shows no lower bounds: they belong to controllers with different costs"


def _verdict(found: Tradeoff) -> Iterator[str]:
    """Yield the points with the most and the fewest packets, and how many points cost less than periodic control."""
    listed = sorted(found.points, key=lambda point: -together(point.evaluation.rates).value)
    sure = [point for point in listed if point.evaluation.settled and not point.evaluation.doubts]
    ends = [
        f"{packets_text(one.rates, one)}, {cost_text(one, than)} ({point.short()})"
        for point, than in zip(sure[:1] + sure[1:][-1:], (THAN, ""), strict=False)
        for one in (point.evaluation,)
    ]
    if ends:
        yield f"from {' to '.join(ends)}" if len(ends) > 1 else ends[0]
    timed = [(point.evaluation.cost, one) for point in sure if (one := point.periodic) is not None]
    if timed:
        less = [cost.value + SURE * cost.standard_error < one.value for cost, one in timed]
        same = "traffic" if any(point.same_traffic is not None for point in sure) else "rate"
        yield f"less cost than periodic control at the same {same} at {sum(less)} of {number_of(len(timed), 'point')}"
    if len(sure) < len(listed):
        where = "; ".join(point.short() for point in listed if point not in sure)
        yield f"no verdict where a note doubts that the simulated cost is an average: {where}"
    yield from withdrawn_text([point.evaluation for point in listed])


@dataclass(frozen=True, repr=False)
class Tradeoff(Tabular):
    """Trade-off curve of a policy: its cost against its rate.

    Args:
        points: points in the order of the grid.
        periodic: curves of fair periodic control by actuation, that is, of time-triggered control with the measurements
            and the actuation of the policy; empty if plant, cost or period differ between points.
        unit: unit of time or run that the cost refers to: ``"step"``, ``"second"``, ``"second at the sampling
            instants"`` or ``"mission"``.
        guarantee: the theorem that proves the bounds, or all of them, or None.
    """

    FIELDS: ClassVar[tuple[Field[Tradeoff], ...]] = (
        VERDICT,
        Field("points"),
        Field("periodic", json=_curves_document),
        *plain_fields("unit", "rate_unit"),
        Field("method", say="method", part="method"),
        Field("seconds", key="", say="time", text="{:.3g} s", part="method"),
        Field("every sample", key="", say="every sample", text=_every_sample),
        Field("guarantee", say="guarantee", text=lambda found: found.guarantee or "" if found.base is not None else ""),
        Field("notes", lambda found: tuple(_notes(found)), key="", say="note"),
    )
    heading: ClassVar[tuple[str, ...]] = ("unit", "rate_unit", "method", "guarantee")

    points: tuple[Point, ...]
    periodic: Mapping[ClockKind, tuple[ClockPoint, ...]] = field(hash=False)
    unit: Unit
    guarantee: str | None

    def summary(self) -> Mapping[str, object]:
        """Return the values of the varied keys, and the rates and costs at all points, by name."""
        columns = self.columns()
        names = [*self.points[0].values, *(f"rate_{link}" for link in self.points[0].evaluation.rates), "cost"]
        shown = {name: [one.value if isinstance(one, Estimate) else one for one in columns[name]] for name in names}
        return {**shown, "unit": self.unit, "rate_unit": self.rate_unit, "method": self.method}

    @property
    def rate_unit(self) -> TimeUnit:
        """Unit of time to which the rates refer."""
        return rate_unit(self.unit)

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence about the points with the most and the fewest packets, and how many points beat periodic control."""
        return tuple(_verdict(self))

    @property
    def links(self) -> list[str]:
        """The links on which the policies decide."""
        return list(dict.fromkeys(link for point in self.points for link in point.evaluation.rates))

    @property
    def seconds(self) -> float:
        """Wall time of the evaluations."""
        return sum(point.evaluation.seconds for point in self.points)

    @property
    def method(self) -> str:
        """Methods that gave the points."""
        return ", ".join(dict.fromkeys(point.evaluation.method for point in self.points))

    @property
    def one_controller(self) -> bool:
        """Whether all points have the same sampling rate and the same cost of sending every sample."""
        return len({(one.evaluation.base_rate, one.evaluation.cost_all_time) for one in self.points}) == 1

    @property
    def base(self) -> Estimate | None:
        """Cost of sending every sample, if it is known and the same at all points: exact or measured."""
        return common_base([one.evaluation.cost_every_sample for one in self.points])

    @property
    def labels(self) -> int:
        """Number of the varied keys."""
        return len(self.points[0].values)

    def table_rows(self) -> Sequence[Point]:
        """Return the points."""
        return self.points

    def row_fields(self) -> tuple[Field[Point], ...]:
        """Return the columns of the table: varied values, rates, costs, and bounds on the cost."""
        found = [point.evaluation for point in self.points]
        links = self.links
        sharp = "guarantee, this rate" if all(one.cost_bound_at_rate is not None for one in found) else None
        measured = "certificate" if any(one.certificate is not None for one in found) else None
        timed = any(point.same_traffic is not None for point in self.points)
        clocked = any(point.periodic is not None for point in self.points)
        below, least = "lower bound, any schedule" if self.bounded else None, "no_schedule_below"
        seen = [one.violations for one in found if one.violations is not None]

        def value(name: str) -> Field[Point]:
            return Field(name, lambda p: p.values[name], column=name, say=name, text=lambda p: str(p.values[name]))

        def rate(link: str) -> Field[Point]:
            heading = None if len(links) > 1 else f"sends per {self.rate_unit}"

            def text(point: Point) -> str:
                found = point.evaluation.rates.get(link)
                return "" if found is None else found.rounded()

            return Field(
                link, lambda one: one.evaluation.rates.get(link), column=f"rate_{link}", say=heading, text=text
            )

        def extra(point: Point) -> str:
            excess = point.evaluation.excess
            return "" if excess is None else percent_text(excess)

        def above(cost: Callable[[Point], Estimate | float | None], up: int = 0) -> Callable[[Point], str]:
            """Return a function that formats a cost or bound, relative to the cost of every sample if that is known."""

            def text(point: Point) -> str:
                found, base = cost(point), point.evaluation.base
                if found is None:
                    return "none"
                known = found if isinstance(found, Estimate) else Estimate(found, 0.0, "exact")
                if not base or base <= 0:
                    return bound_text(known, up) if up else known.rounded(6)
                return percent_above(known, point.evaluation.highest_all_time if up > 0 else base, up)

            return text

        def violation(name: str) -> Field[Point]:
            heading = {"violation": "violation per step", "violation_within": f"within {seen[0].window}"}.get(name)

            def share(point: Point) -> Estimate | None:
                found = point.evaluation.violations
                return None if found is None else found.records().get(name)

            return Field(name, share, column=name, say=heading, none="none")

        return (
            *map(value, self.points[0].values),
            *map(rate, links),
            Field("share", say="of the packets" if len(links) > 1 else None, text=lambda one: _share(one, links)),
            Field("cost", "evaluation.cost", column="cost", say=f"cost {per_unit(self.unit)}"),
            Field("extra", say="extra cost", text=extra),
            Field(
                "guarantee",
                "evaluation.cost_bound",
                column="guarantee",
                say=None if sharp or not any(one.cost_bound for one in found) else "guarantee",
                text=above(lambda point: point.evaluation.cost_bound, 1),
                up=1,
            ),
            Field(
                "guarantee_at_rate",
                "evaluation.guarantee_at_rate",
                column="guarantee_at_rate",
                say=sharp,
                text=above(lambda point: point.evaluation.guarantee_at_rate, 1),
                up=1,
            ),
            Field(
                "measured bound",
                "evaluation.certificate",
                key="",
                say=measured,
                text=above(lambda point: point.evaluation.certificate, 1),
            ),
            Field(
                "periodic",
                "evaluation.periodic",
                column="periodic_same_rate",
                say="periodic, same rate" if clocked and not timed else None,
                text=above(lambda point: point.evaluation.periodic),
            ),
            Field(
                "same_traffic",
                key="",
                column="periodic_same_traffic" if timed else "",
                say="periodic, same traffic" if timed else None,
                text=above(lambda point: point.same_traffic),
            ),
            Field(
                "lowest",
                "evaluation.lower_bound.cost",
                optional=True,
                column=least,
                say=below,
                text=above(lambda point: None if (one := point.evaluation.lower_bound) is None else one.cost, -1),
                up=-1,
            ),
            *map(violation, dict.fromkeys(name for one in seen for name in one.records())),
            *columns_of(lambda point: point.evaluation),
        )

    def table_texts(self) -> Sequence[str]:
        """Return the table of points and, for several links, the table of each link's share of the packets."""
        if len(self.links) < 2:
            return (self.table(),)
        rows = [[link, *(_share(point, [link]) for point in self.points)] for link in self.links]
        return (self.table(), table_text(["of the packets", *(point.short() for point in self.points)], rows, 1))

    @property
    def bounded(self) -> bool:
        """Whether at least one point has a lower bound on the cost."""
        return any(point.evaluation.lower_bound is not None for point in self.points)

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Plot the cost against the rate of a single link, or against the traffic of several links.

        The figure shows the policy, its guarantee (the guarantee at the measured rate, if there is one), the
        certificate that its nodes measure, periodic control, and the cost of sending every sample. If several links
        have different shares of the traffic, a strip below shows these shares.

        Args:
            ax: existing axes to draw in instead of a new figure: one, or with the shares two, one above the other.
            figsize: width and height of a new figure, in inches.
            style: ``"light"``, ``"dark"``, ``"paper"`` or ``"paper-wide"``.
        """
        return draw(panels_of(self), ax, figsize, style)


def _share(point: Point, links: Sequence[str]) -> str:
    """Return the share of the packets of some links; the rates if packets may be sent at any time."""
    found = point.evaluation
    rates = {link: found.rates[link] for link in links if link in found.rates}
    share = share_of(rates, found.base_rate)
    return ", ".join(f"{rate.value:.4g}" for rate in rates.values()) if share is None else share_text(share)


def _rate(point: Point) -> float:
    return next(iter(point.evaluation.rates.values())).value
