"""Fair periodic control: it has the measurements, the actuator and the send rate of a policy, but a fixed timetable.

An event-triggered policy measures at every step. Periodic control that measures only when it sends has less
information. Fair periodic control measures at every step too, holds or predicts its input as the policy does, and has
the optimal gains for its cycle of intervals. A rate between those of two cycles is reached by time sharing: long phases
of one cycle and of the other. So the least cost at a rate is on the lower convex hull of the costs of all cycles.

With a held input, cycles of very different intervals can cost much less than those of equal ones, such as two sends in
a row that bring a state to zero, and then a long pause. No search covers all cycles, so a cost is the least *found*. It
covers cycles of up to four intervals that differ from the mean one by two steps, any two intervals, and a long
interval with up to three short ones.

``Clock`` is the least cost as a function of the rate: ``Ticked`` at sampling instants, ``Timed`` at any period,
``Either`` for the cheaper of both. ``fair_clock`` chooses for a policy: by the actuation that its steps show, by the
exact cost that a given controller states for periodic sends or has with a timetable (``timed_links``), or for queries
of a sensor. Where no fair control exists or can be computed, such as for lossy links, ``NoClockError`` gives the
reason.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, Literal, TypeAlias

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._progress import OutOfTime, check_time, late_text
from taciturn._text import number_of
from taciturn.base.certainty import Actuation, CertaintyEquivalentDesign, design_certainty
from taciturn.base.filter import ESTIMATE
from taciturn.design.at_fixed_steps import waiting_cost
from taciturn.design.kind import AnyPolicy, usual_nodes
from taciturn.design.kinds.all_time import all_time
from taciturn.design.kinds.periodic import periodic
from taciturn.errors import TaciturnError
from taciturn.loop import close
from taciturn.lqg.cache import remembered
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.periodic import Held, Timing, cycles, lift
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.model.result import Field, Result, plain_fields
from taciturn.model.signals import SampledChanges
from taciturn.model.steps import Assign, Send, Terms
from taciturn.problem import Problem
from taciturn.renewal.without_steps import nodes_of
from taciturn.study.timed_links import TimedLinks, modes_of

SENDS = 4  # of a cycle, at most
BELOW, ABOVE = 1, 2  # steps by which its intervals may be off the mean one
REACH = 8  # steps by which intervals are tried that are longer than what is asked
MOST_INTERVALS, MOST_MEANS = 64, 12  # lengths that are tried of cycles of one interval, and of several alike
DENSE, MOST_LENGTHS = 16, 20  # lengths that are tried of two unequal intervals: all up to 16 steps, and so many others
SHORT, MORE = (1, 2, 3), (2, 3)  # short intervals, and how many of them follow a long one, if they are more than one
MOST_MIXED_CYCLES = 2000
LONGEST = 2000  # steps of an interval that is looked for
CURVE_POINTS = 40
SAME = 1e-9  # relative
FREE = 16  # steps up to which a real period is tried
Cycle: TypeAlias = tuple[int, ...]
ClockKind: TypeAlias = Literal["hold", "model", "zero", "queries"]
Choice: TypeAlias = Callable[[Sequence["ClockPoint"]], Sequence["ClockPoint"]]
ALIKE = 1e-6  # relative
UNSTABLE = "periodic control is unstable, or does not follow the disturbances, with all periods that were tried"
OF_A_DESIGN = "the cost of periodic control is computed for the loop of a design, and here"  # the difference
NEAR, SMALL = 8, 10  # real periods that are tried next to the one at a rate, of plants with so many states at most
WORK = 3e7  # cycles, times the cube of the size of the problem that one of them is


@dataclass(frozen=True, repr=False)
class ClockPoint(Displayed):
    """Send rate and exact cost of periodic control with one cycle of send intervals.

    Args:
        rate: sends per step or per second.
        cost: exact cost.
        cycle: steps from send to send; None for a period that need not be a whole number of steps.
    """

    rate: float
    cost: float
    cycle: Cycle | None = None


@dataclass(frozen=True, repr=False)
class ClockMix(Result):
    """Periodic control with a given send rate: one cycle of send intervals, or two cycles that alternate for long
    times.

    Args:
        cost: exact cost.
        points: one or two cycles.
        shares: share of the time of each cycle.
        words: actuation, ``"hold"`` or ``"model"``; ``"queries"`` if queries of the sensor are scheduled.
        standard_error: standard error of the cost that is due to the standard error of a measured rate.
    """

    FIELDS: ClassVar[tuple[Field[ClockMix], ...]] = (
        Field("words", key="kind"),
        *plain_fields("cost", "standard_error", "shares"),
        Field("cycles", lambda found: [point.cycle for point in found.points]),  # in steps; None: any period
        Field("rates", lambda found: [point.rate for point in found.points]),
    )

    cost: float
    points: tuple[ClockPoint, ...]
    shares: tuple[float, ...]
    words: ClockKind
    standard_error: float = 0.0

    @property
    def rate(self) -> float:
        """Sends per step or per second. It is below the requested rate if fewer sends cost no more."""
        return sum(share * point.rate for share, point in zip(self.shares, self.points, strict=True))


class NoClockError(Exception):
    """Raised if there is no fair periodic control to compare a policy with. The message states the reason."""


def periodic_at(problem: Problem, policy: AnyPolicy, rate: Estimate) -> tuple[ClockMix | None, str]:
    """Compute fair periodic control with the measured rate of a policy, or the reason why there is none."""
    if rate.value == 0:
        return None, "the policy sent nothing"
    try:
        found = fair_clock(problem, policy).at(rate.value, rate.standard_error)
    except NoClockError as reason:
        return None, str(reason)
    except OutOfTime:
        return None, late_text()
    if found is None:
        return None, UNSTABLE
    return found, ""


def clock_of(problem: Problem, policy: AnyPolicy) -> Clock | None:
    """Prepare fair periodic control for a policy; return None if it does not exist."""
    try:
        return fair_clock(problem, policy)
    except NoClockError:
        return None


def fair_clock(problem: Problem, policy: AnyPolicy) -> Clock:
    """Prepare fair periodic control for a policy: with its measurements and actuator, and with optimal gains."""
    nodes = nodes_of(policy)
    if nodes is None or nodes.prediction is not None:
        return sampling_clock(problem, "model")
    continuous = isinstance(problem.plant, ContinuousPlant)
    period = nodes.tick if continuous else None
    if problem.cost.mission:
        raise NoClockError(
            "the horizon is finite or the cost is discounted, but periodic control is computed for average costs only"
        )
    lossy = any(problem.network.loss(link) for link in problem.network.links)
    told = nodes.theory.periodic is not None and all(map(problem.network.acknowledges, nodes.scheduled))
    if lossy and not told:
        raise NoClockError(
            "the links drop packets, but periodic control is computed for links that deliver every packet, or "
            "acknowledge those that arrive"
        )
    if problem.network.late and not told:
        raise NoClockError(
            "packets are delayed at random, but periodic control is computed for constant delays, or for "
            "acknowledgements with the times of arrival"
        )
    if problem.network.missing:
        raise NoClockError(f"{OF_A_DESIGN} samples are missing at random")
    if len(nodes.scheduled) > 1:
        raise NoClockError(
            f"the policy makes send decisions on {number_of(len(nodes.scheduled), 'link')}, and a single rate does "
            "not determine the rate of each link"
        )
    if isinstance(nodes.model.changes, SampledChanges):
        raise NoClockError(
            "the set-points change at known times, and the cost of periodic control is computed only if they are "
            "constant or change at random times"
        )
    varies = lossy or bool(problem.network.late)
    if nodes.theory.periodic is not None and (problem.controller is not None or varies):
        loop = problem.close(nodes)
        if not loop.nominal:
            raise NoClockError(f"{OF_A_DESIGN} {loop.violated_assumptions[0]}")
        silent = _silent_input(nodes).get("input")
        zero = isinstance(silent, np.ndarray) and not silent.any()
        return _given("zero" if zero else actuation_of(nodes), nodes.theory.periodic, loop.problem)
    if problem.controller is not None:
        return _same_control(problem, nodes)
    try:
        certainty = design_certainty("periodic", discretise(problem.plant, problem.cost, period))
        every = all_time(problem.plant, problem.cost, period=period)
        links = usual_nodes(problem.network, "periodic control")
        differences = close(problem.actual or problem.plant, every, links, problem.cost).violated_assumptions
    except TaciturnError as error:
        raise NoClockError(f"no periodic control can be designed for this problem ({error})") from None
    if differences:
        raise NoClockError(f"{OF_A_DESIGN} {differences[0]}")
    if nodes.targets:
        raise NoClockError("the policy follows a stored reference, for which periodic control is not computed")
    least = certainty.problem.per_unit(certainty.cost_all_time)
    if nodes.theory.periodic is None and abs(least - nodes.cost_all_time) > ALIKE * abs(least):
        if problem.own is None:
            raise NoClockError("the policy uses its measurements later than periodic control would use them")
        more = nodes.cost_all_time / least
        raise NoClockError(
            f"if it sends every sample, the policy costs {more:.4g} times as much as LQG, which periodic control uses"
        )
    actuation, p = actuation_of(nodes), certainty.problem
    if any(nodes.network.nodes[link].measures for link in nodes.scheduled) and actuation == "hold":
        return _asking(certainty)
    if actuation == "model":  # cycles of several intervals are no better than the chord between single ones
        given = p.plant.A, p.plant.B, certainty.square, certainty.corrections
        ticked = _predicting(*given, certainty.cost_all_time, p.noise_cost * p.ticks, p.unit, p.tick)
    else:
        given = p.plant.A, p.plant.B, p.Q, p.R, p.N, certainty.corrections
        ticked = _holding(*given, certainty.estimation_cost, p.noise_cost, p.tick)
    near = NEAR if p.plant.states <= SMALL else 0
    if not continuous or p.instants:  # costs at the sampling instants of another period count something else
        return ticked
    if problem.plant.full_state and actuation == "hold":  # neither filter nor model runs between the sends
        return Either(ticked, sampling_clock(problem), p.tick, near, np.inf)

    def spaced(seconds: float) -> float | None:  # with measurements no more often than the policy's
        return _cost_of_period(problem, seconds, max(1, int(seconds / p.tick * (1 + ALIKE))), actuation)

    return Either(ticked, Timed(actuation, spaced), p.tick, near)


def _same_control(problem: Problem, policy: Policy) -> Clock:
    """Return the given controller with periodic packets on its only link, and with what the policy does in silence."""
    if differences := problem.close(policy).violated_assumptions:
        raise NoClockError(f"{OF_A_DESIGN} {differences[0]}")
    (link,), timed = policy.scheduled, TimedLinks.of(problem, policy)
    return Ticked(
        "model" if "model" in modes_of(problem) else "hold",
        policy.tick,
        lambda cycle: timed.cost({link: Timing(*cycle)}),
    )


def actuation_of(policy: Policy) -> Actuation:
    """Return how the receiver of a link behaves between packets: ``"hold"`` if it holds a value, ``"model"`` if it
    predicts.
    """
    sends, nodes = (step for step in policy.steps if isinstance(step, Send)), policy.network.nodes
    packet = next((step.payload for step in sends if nodes[step.link].measures), None)
    if packet is not None:
        return "model" if ESTIMATE in packet else "hold"
    return "hold" if set(_silent_input(policy)) == {"input"} else "model"


def _silent_input(policy: Policy) -> Terms:
    """Return the terms of the input in silence; none if the actuator computes it alike in every step."""
    steps = [step for step in policy.steps if isinstance(step, Assign) and step.signal == "input"]
    found = [step.branches[0] for step in steps if len(step.branches) > 1]
    return found[0] if found else {}


def sampling_clock(problem: Problem, actuation: Actuation = "hold") -> Timed:
    """Prepare periodic control of a continuous-time plant that measures only when it sends.

    For an exact measurement of the full state, this control is fair periodic control. Otherwise it is weaker; the
    thesis uses it for comparison.
    """
    return Timed(actuation, lambda seconds: _cost_of_period(problem, seconds, None, actuation))


def _cost_of_period(problem: Problem, seconds: float, samples: int | None, actuation: Actuation) -> float | None:
    """Return the exact cost of sends at a real period, perhaps with several samples in each, or None if unstable."""
    period = seconds / (samples or 1)
    try:
        policy = periodic(problem.plant, problem.cost, period=period, every=samples, actuation=actuation)
        loop = close(problem.actual or problem.plant, policy, problem.network.unlimited, problem.cost)
    except TaciturnError:  # such as sampling that loses a mode
        return None
    exact = policy.theory.closed_form
    return exact.cost if loop.nominal and exact is not None else None


@remembered
def _holding(
    A: Array, B: Array, Q: Array, R: Array, N: Array, corrections: Array, unseen: float, noise_cost: float, tick: float
) -> Ticked:
    """Return periodic control of an actuator that holds its input; points of one plant and cost share its results."""
    held, known = Held(A, B, Q, R, N, corrections), unseen + noise_cost
    return Ticked(
        "hold",
        tick,
        lambda cycle: (known + held.solve(cycle).cost) / tick,
        lambda listed: (known + held.screen(listed)) / tick,
        min(MOST_MIXED_CYCLES, int(WORK / (len(A) + SENDS * len(R)) ** 3)),
    )


@remembered
def _predicting(
    A: Array, B: Array, square: Array, corrections: Array, every: float, noise_cost: float, unit: float, tick: float
) -> Ticked:
    """Return periodic control of an actuator that predicts the state; points of one plant and cost share results."""
    # every: cost per step of sending every sample, to which the noise between the samples adds noise_cost

    def cost(cycle: Cycle) -> float:
        return (every + waiting_cost(A, B, square, corrections, cycle) + noise_cost) / unit

    return Ticked("model", tick, cost)


@remembered
def _given(words: ClockKind, cost_of: Callable[..., float], problem: Discrete) -> Ticked:
    """Return periodic control of a given controller; points of one loop share its results."""
    return Ticked(words, problem.tick, lambda cycle: problem.per_unit(cost_of(*cycle)))


def _asking(certainty: CertaintyEquivalentDesign) -> Clock:
    """Return periodic control of a sensor whose measurements reach a controller at the actuator."""
    problem, plant = certainty.problem, certainty.problem.plant
    noise = float(np.sum(certainty.regulator.K * plant.W))

    def cost(cycle: Cycle) -> float:
        (ticks,) = cycle
        free, none = np.zeros((plant.inputs, plant.inputs)), np.zeros_like(plant.B)
        asked = lift(plant.A, plant.B, certainty.square, free, none, plant.W, ticks)
        seen = steady_filter(asked.A, plant.C, asked.W, plant.V)
        return problem.per_unit(noise + (float(np.sum(asked.Q * seen.posterior)) + asked.noise_cost) / ticks)

    return Ticked("queries", problem.tick, cost)


class Clock(ABC):
    """Least cost of periodic control as a function of the send rate, for one way to actuate between sends."""

    words: ClockKind

    @abstractmethod
    def around(self, rate: float) -> tuple[ClockPoint, ClockPoint] | None:
        """Return the two cycles that alternate: one with a rate of at most ``rate``, the other of at least ``rate``."""

    @abstractmethod
    def curve(self, fastest: float, slowest: float) -> tuple[ClockPoint, ...]:
        """Return points of the cost curve between two rates. Straight lines connect them."""

    def at(self, rate: float, error: float = 0.0) -> ClockMix | None:
        """Return the cheapest periodic control with a send rate; None if no stable one was found."""
        found = self.around(rate) if rate > 0 else None
        if found is None:
            return None
        low, high = found
        share = (rate - low.rate) / (high.rate - low.rate) if high.rate > low.rate else 0.0
        both = [(1 - share, low), (share, high)]
        mixed = [(1.0, point) for part, point in both if part > 1 - SAME] or both
        shares, points = zip(*mixed, strict=True)
        cost = sum(part * point.cost for part, point in mixed)
        near = [(low.rate, low.cost), (high.rate, high.cost)]
        if error > 0 and len(mixed) == 1 and mixed[0][1].cycle is None:  # the cost changes along the curve of periods
            tried = [(one, self._timed_cost(one)) for one in (rate - error, rate + error) if one > 0]
            near = sorted([(rate, cost), *((one, found) for one, found in tried if found is not None)])
        (first, from_cost), (last, to_cost) = near[0], near[-1]
        slope = abs(to_cost - from_cost) / (last - first) if last > first else 0.0
        return ClockMix(cost, points, shares, self.words, slope * error)

    def _timed_cost(self, rate: float) -> float | None:
        """Return the exact cost of the single real period with this rate; None if there is no such control."""
        return None


class Timed(Clock):
    """Periodic control that measures only when it sends. Its period may be any number of seconds."""

    def __init__(self, words: ClockKind, cost_of: Callable[[float], float | None]) -> None:
        """Compute nothing yet."""
        self.words, self._cost_of = words, cost_of

    def around(self, rate: float) -> tuple[ClockPoint, ClockPoint] | None:
        """Return the point with this rate twice: a single period achieves any rate, so that no cycles alternate."""
        cost = self._timed_cost(rate)
        point = None if cost is None else ClockPoint(rate, cost)
        return None if point is None else (point, point)

    def _timed_cost(self, rate: float) -> float | None:
        return self._cost_of(1 / rate)

    def curve(self, fastest: float, slowest: float) -> tuple[ClockPoint, ...]:
        """Compute rate and cost for several periods between ``1/fastest`` and ``1/slowest``. Unstable loops are
        omitted.
        """
        periods = np.geomspace(1 / fastest, 1.05 * max(1 / slowest, 1 / fastest), CURVE_POINTS).tolist()
        found = [(1 / period, self._cost_of(period)) for period in periods]
        return tuple(ClockPoint(rate, cost) for rate, cost in found if cost is not None)


class Ticked(Clock):
    """Periodic control that sends at sampling instants, with the best of many cycles of send intervals."""

    def __init__(
        self,
        words: ClockKind,
        tick: float,
        solve: Callable[[Cycle], float],
        screen: Callable[[Sequence[Cycle]], Array] | None = None,
        most: int = MOST_MIXED_CYCLES,
    ) -> None:
        """Compute nothing yet."""
        self.words, self._tick, self._solve, self._most = words, tick, solve, most
        self._screen, self._sends = (screen, SENDS) if screen is not None else (self._one_by_one, 1)
        self._roughly: dict[Cycle, float] = {}
        self._exactly: dict[Cycle, float] = {}
        self._tried: dict[tuple[int, int, int], list[Cycle]] = {}

    def around(self, rate: float) -> tuple[ClockPoint, ClockPoint] | None:
        """Return the corners of the lower convex hull on either side of a rate."""
        ticks = max(1.0, 1 / (rate * self._tick))
        nearest = int(ticks * (1 + SAME))
        lengths = max(1, nearest // 2), 2 * nearest + REACH, nearest
        found = self._exact(lengths, lambda corners: beside(corners, rate))
        return (found[0], found[1]) if found else None

    def around_cost(self, cost: float) -> tuple[ClockPoint, ClockPoint] | None:
        """Return the corners of the lower convex hull on either side of a cost, the larger cost first; None without
        such.
        """
        last = REACH
        while last <= LONGEST:
            corners = self._exact((1, last, last // 2), lambda corners: corners)
            for dear, cheap in pairwise(corners):
                if cheap.cost <= cost * (1 + SAME) and cost <= dear.cost * (1 + SAME):
                    share = (cost - cheap.cost) / (dear.cost - cheap.cost)
                    return self.around(share * dear.rate + (1 - share) * cheap.rate)
            last *= 2
        return None

    def curve(self, fastest: float, slowest: float) -> tuple[ClockPoint, ...]:
        """Return the corners of the lower convex hull between two rates, and the next corner below, by falling rate."""
        first, last = (max(1, round(1 / (rate * self._tick))) for rate in (fastest, slowest))
        corners = self._exact((first, last + REACH, last), lambda corners: corners)
        beyond = sum(corner.rate < slowest * (1 - SAME) for corner in corners)
        return tuple(reversed(corners[max(0, beyond - 1) :]))

    def _exact(self, lengths: tuple[int, int, int], choose: Choice) -> Sequence[ClockPoint]:
        """Return some corners of the lower hull, with exact costs.

        The answer does not depend on earlier calls, which threads may make in any order: each call begins with the
        approximate costs and replaces those of the chosen corners by the exact ones until the choice stays the same.
        """
        if lengths not in self._tried:
            self._tried[lengths] = self._screened(self._candidates(*lengths))
        costs = {cycle: self._roughly[cycle] for cycle in self._tried[lengths]}
        exact: set[Cycle] = set()
        while True:
            points = (self._point(cycle, cost) for cycle, cost in costs.items() if np.isfinite(cost))
            chosen = choose(lower_hull(points))
            unknown = {point.cycle for point in chosen if point.cycle is not None} - exact
            if not unknown:
                return chosen
            costs.update((cycle, self._solved(cycle)) for cycle in unknown)
            exact |= unknown

    def _screened(self, listed: list[Cycle]) -> list[Cycle]:
        """Compute the approximate costs of cycles, rounded so that their batch does not decide between equal ones."""
        for sends in range(1, self._sends + 1):
            new = [cycle for cycle in listed if len(cycle) == sends and cycle not in self._roughly]
            found: list[float] = self._screen(new).tolist() if new else []
            self._roughly.update((cycle, float(f"{cost:.9g}")) for cycle, cost in zip(new, found, strict=True))
        return listed

    def _candidates(self, first: int, last: int, nearest: int) -> list[Cycle]:
        """Return the cycles that are tried, those of the fewest sends first."""

        def spread(longest: int, most: int) -> set[int]:
            return {int(ticks) for ticks in np.geomspace(first, longest, most)}

        close = {ticks for ticks in range(nearest - 1, nearest + 2) if ticks >= 1}
        found = {(ticks,): None for ticks in sorted({1} | close | spread(last, MOST_INTERVALS))}
        if self._sends > 1:
            mixed = [
                cycle
                for mean in sorted(
                    close | spread(min(last, 2 * nearest + 1), MOST_MEANS), key=lambda mean: abs(mean - nearest)
                )
                for cycle in cycles(range(max(1, mean - BELOW), mean + ABOVE + 1), self._sends)
            ]
            apart = sorted(set(range(1, DENSE + 1)) | close | spread(last, MOST_LENGTHS))
            unequal = {(long, short) for long in apart for short in apart if short < long}
            unequal |= {(long, *[short] * more) for long in apart for short in SHORT if short < long for more in MORE}
            unequal = {cycle for cycle in unequal if sum(cycle) <= last * len(cycle)}
            found |= dict.fromkeys(sorted(mixed, key=len))
            found |= dict.fromkeys(
                sorted(unequal, key=lambda cycle: (abs(np.log(sum(cycle) / len(cycle) / nearest)), cycle))
            )
        return list(found)[: self._most]

    def _point(self, cycle: Cycle, cost: float) -> ClockPoint:
        return ClockPoint(len(cycle) / (sum(cycle) * self._tick), cost, cycle)

    def _one_by_one(self, listed: Sequence[Cycle]) -> Array:
        return np.array([self._solved(cycle) for cycle in listed])

    def _solved(self, cycle: Cycle) -> float:
        if cycle not in self._exactly:
            check_time()
            try:
                self._exactly[cycle] = self._solve(cycle)
            except TaciturnError:  # such as intervals at which the sampled plant is not stabilisable
                self._exactly[cycle] = np.inf
        return self._exactly[cycle]


class Either(Clock):
    """Periodic control that sends at sampling instants, or with any period, or alternates between both.

    A period of 1.5 steps, for example, reaches a rate that needs two cycles at sampling instants.
    """

    def __init__(self, ticked: Ticked, timed: Timed, tick: float, near: int, longest: float = FREE) -> None:
        """Compute nothing yet."""
        self.words, self.ticked, self._timed, self._tick, self._near = ticked.words, ticked, timed, tick, near
        self._slowest = 1 / (longest * tick)

    def around(self, rate: float) -> tuple[ClockPoint, ClockPoint] | None:
        """Return the corners of the lower convex hull of all costs on either side of a rate."""
        near = max(rate / 1.5, self._slowest), min(1.5 * rate, 1 / self._tick)
        found = beside(lower_hull([*(self.ticked.around(rate) or ()), *self._free(rate, *near)]), rate)
        return (found[0], found[1]) if found else None

    def curve(self, fastest: float, slowest: float) -> tuple[ClockPoint, ...]:
        """Return the corners of the lower convex hull of all costs, beginning with the highest rate."""
        slow = max(slowest, self._slowest)
        free = self._free(fastest, slow, min(fastest, 1 / self._tick))
        return tuple(reversed(lower_hull([*self.ticked.curve(fastest, slowest), *free])))

    def _timed_cost(self, rate: float) -> float | None:
        found = self._timed.around(rate)
        return None if found is None else found[0].cost

    def _free(self, rate: float, slowest: float, fastest: float) -> list[ClockPoint]:
        """Return points of real periods at rates in between, and at the rate itself."""
        if slowest > fastest:
            return []
        rates = [*np.geomspace(slowest, fastest, self._near).tolist(), min(max(rate, slowest), fastest)]
        found = [self._timed.around(one) for one in rates]
        return [points[0] for points in found if points is not None]


def beside(corners: Sequence[ClockPoint], rate: float) -> Sequence[ClockPoint]:
    """Return the next slower and the next faster corner at a rate; an empty list if all corners are faster."""
    slower = [corner for corner in corners if corner.rate <= rate * (1 + SAME)]
    faster = [corner for corner in corners if corner.rate > rate * (1 + SAME)] or slower[-1:]
    return (slower[-1], faster[0]) if slower else ()


def lower_hull(points: Iterable[ClockPoint]) -> list[ClockPoint]:
    """Compute the lower convex hull of cost over rate: its corners from the lowest rate to the least cost."""
    corners: list[ClockPoint] = []
    for point in sorted(points, key=lambda one: (one.rate, one.cost)):
        if corners and point.rate <= corners[-1].rate * (1 + SAME):  # one rate, but for rounding
            if point.cost >= corners[-1].cost:
                continue
            corners.pop()
        while len(corners) > 1:
            before, middle = corners[-2:]
            if (middle.cost - before.cost) * (point.rate - before.rate) < (point.cost - before.cost) * (
                middle.rate - before.rate
            ):  # below the line between its neighbours
                break
            corners.pop()
        corners.append(point)
    costs = [corner.cost for corner in corners]
    return corners[: costs.index(min(costs)) + 1] if corners else []
