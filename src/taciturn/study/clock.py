"""Fair clocks: time-triggered control with the measurements and the actuator of a policy, at the policy's rate.

A clock that measures only when it sends knows less than an event-triggered policy, which measures at every tick. The
fair one measures at every tick too, holds its input or predicts as the policy does, and has the best gains for its
cycle of intervals. Its rates are those of cycles; between two of them it shares the time, over long phases. So its
least cost at a rate is on the lower hull of the costs of all cycles.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, TypeAlias

import numpy as np

from taciturn._arrays import Array
from taciturn.design.catalogue import AnyPolicy
from taciturn.design.certainty import Actuation, Certainty, design_certainty
from taciturn.design.periodic import all_time, periodic, predicted_cost
from taciturn.errors import TaciturnError
from taciturn.lqg._kept import kept
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.periodic import Held, cycles, lift
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Assign, Policy
from taciturn.problem import Problem
from taciturn.renewal.policy import EventPolicy, OptimalPolicy

SENDS = 4  # of a cycle, at most
BELOW, ABOVE = 1, 2  # ticks by which its intervals may be off the mean one
REACH = 8  # ticks by which intervals are tried that are longer than what is asked
MOST_INTERVALS, MOST_MEANS = 64, 12  # lengths that are tried of cycles of one interval, and of several
MOST_CYCLES = 2000
LONGEST = 2000  # ticks of an interval that is looked for
WORK = 3e7  # cycles, times the cube of the size of the problem that one of them is
CURVE_POINTS = 40
SAME, ALIKE = 1e-9, 1e-6  # relative
Cycle: TypeAlias = tuple[int, ...]
ClockKind: TypeAlias = Literal["hold", "model", "queries"]
Choice: TypeAlias = Callable[[Sequence["ClockPoint"]], Sequence["ClockPoint"]]


@dataclass(frozen=True)
class ClockPoint:
    """Time-triggered control at one rate, exact.

    Args:
        rate: sends per step or per second.
        cost: in the units of the cost.
        cycle: ticks from send to send; None where it sends at one real period.
    """

    rate: float
    cost: float
    cycle: Cycle | None = None


@dataclass(frozen=True)
class ClockMix:
    """Time-triggered control at a rate: one point, or two that share the time over long phases.

    Args:
        cost: exact, in the units of the cost.
        points: one or two.
        shares: of the time.
        words: ``"hold"`` or ``"model"``, its actuation; ``"queries"`` where the sensor is what it schedules.
    """

    cost: float
    points: tuple[ClockPoint, ...]
    shares: tuple[float, ...]
    words: ClockKind

    def document(self) -> dict[str, Any]:
        """Return the JSON document: cycles in ticks, null where it sends at one real period."""
        return {
            "kind": self.words,
            "cost": self.cost,
            "shares": list(self.shares),
            "cycles": [None if point.cycle is None else list(point.cycle) for point in self.points],
            "rates": [point.rate for point in self.points],
        }


class Clock(ABC):
    """The least cost that time-triggered control of one kind has, against its rate."""

    words: ClockKind

    @abstractmethod
    def around(self, rate: float) -> tuple[ClockPoint, ClockPoint] | None:
        """Return the points, of at most this rate and of at least this rate, between which the time is shared."""

    @abstractmethod
    def curve(self, fastest: float, slowest: float) -> tuple[ClockPoint, ...]:
        """Return the points from one rate down to another, joined by lines."""

    def at(self, rate: float) -> ClockMix | None:
        """Return the cheapest at a rate, or None where no stable one is known."""
        found = self.around(rate) if rate > 0 else None
        if found is None:
            return None
        low, high = found
        share = (rate - low.rate) / (high.rate - low.rate) if high.rate > low.rate else 0.0
        both = [(1 - share, low), (share, high)]
        mixed = [(1.0, point) for part, point in both if part > 1 - SAME] or both
        shares, points = zip(*mixed, strict=True)
        return ClockMix(sum(part * point.cost for part, point in mixed), points, shares, self.words)


class Timed(Clock):
    """Control that sends at one real period, as nothing happens between its sends that it could measure.

    Args:
        words: what it is.
        cost_of: the exact cost at a period, or None where it is not stable.
    """

    def __init__(self, words: ClockKind, cost_of: Callable[[float], float | None]) -> None:
        """Compute nothing yet."""
        self.words, self._cost_of = words, cost_of

    def around(self, rate: float) -> tuple[ClockPoint, ClockPoint] | None:
        """Return the point of the period."""
        cost = self._cost_of(1 / rate)
        point = None if cost is None else ClockPoint(rate, cost)
        return None if point is None else (point, point)

    def curve(self, fastest: float, slowest: float) -> tuple[ClockPoint, ...]:
        """Return the points of periods in between, those that are stable."""
        periods = np.geomspace(1 / fastest, 1.05 * max(1 / slowest, 1 / fastest), CURVE_POINTS).tolist()
        found = [(1 / period, self._cost_of(period)) for period in periods]
        return tuple(ClockPoint(rate, cost) for rate, cost in found if cost is not None)


class Ticked(Clock):
    """Control that sends at ticks: the best of the cycles that are tried.

    Args:
        words: what it is.
        tick: seconds, or 1 step.
        solve: the exact cost of a cycle; raises where it is not stable.
        screen: about what cycles of as many intervals cost, all at once; omitted: cycles are single intervals.
        most: cycles that are worth the time.
    """

    def __init__(
        self,
        words: ClockKind,
        tick: float,
        solve: Callable[[Cycle], float],
        screen: Callable[[Sequence[Cycle]], Array] | None = None,
        most: int = MOST_CYCLES,
    ) -> None:
        """Compute nothing yet."""
        self.words, self._tick, self._solve, self._most = words, tick, solve, most
        self._screen, self._sends = (screen, SENDS) if screen is not None else (self._one_by_one, 1)
        self._roughly: dict[Cycle, float] = {}
        self._exactly: dict[Cycle, float] = {}
        self._hulls: dict[tuple[int, int, int], list[ClockPoint]] = {}

    def around(self, rate: float) -> tuple[ClockPoint, ClockPoint] | None:
        """Return the two corners of the lower hull next to a rate."""
        ticks = max(1.0, 1 / (rate * self._tick))
        nearest = int(ticks * (1 + SAME))

        def next_to(corners: Sequence[ClockPoint]) -> Sequence[ClockPoint]:
            slower = [corner for corner in corners if corner.rate <= rate * (1 + SAME)]
            faster = [corner for corner in corners if corner.rate > rate * (1 + SAME)] or slower[-1:]
            return (slower[-1], faster[0]) if slower else ()

        found = self._exact((max(1, nearest // 2), 2 * nearest + REACH, nearest), next_to)
        return (found[0], found[1]) if found else None

    def around_cost(self, cost: float) -> tuple[ClockPoint, ClockPoint] | None:
        """Return the two corners next to a cost, the dearer one first; None where none costs as much, or as little."""
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
        """Return the corners of the lower hull between two rates, and the first one beyond, the fastest first."""
        first, last = (max(1, round(1 / (rate * self._tick))) for rate in (fastest, slowest))
        corners = self._exact((first, last + REACH, last), lambda corners: corners)
        beyond = sum(corner.rate < slowest * (1 - SAME) for corner in corners)
        return tuple(reversed(corners[max(0, beyond - 1) :]))

    def _exact(self, lengths: tuple[int, int, int], choose: Choice) -> Sequence[ClockPoint]:
        """Return corners of the hull of intervals of these lengths, the exact costs of those that are chosen.

        Args:
            lengths: the shortest, the longest, and the one around which cycles are tried most densely.
            choose: takes some of the corners.
        """
        while True:
            if lengths not in self._hulls:
                self._hulls[lengths] = self._hull(self._candidates(*lengths))
            chosen = choose(self._hulls[lengths])
            unknown = [point.cycle for point in chosen if point.cycle is not None and point.cycle not in self._exactly]
            if not unknown:
                return chosen
            self._exactly.update((cycle, self._solved(cycle)) for cycle in unknown)
            del self._hulls[lengths]

    def _hull(self, listed: Sequence[Cycle]) -> list[ClockPoint]:
        for sends in range(1, self._sends + 1):
            new = [cycle for cycle in listed if len(cycle) == sends and cycle not in self._roughly]
            self._roughly.update(zip(new, self._screen(new).tolist() if new else (), strict=True))
        known = [self._point(cycle, self._exactly.get(cycle, self._roughly[cycle])) for cycle in listed]
        return lower_hull(point for point in known if np.isfinite(point.cost))

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
            found |= dict.fromkeys(sorted(mixed, key=len))
        return list(found)[: self._most]

    def _point(self, cycle: Cycle, cost: float) -> ClockPoint:
        return ClockPoint(len(cycle) / (sum(cycle) * self._tick), cost, cycle)

    def _one_by_one(self, listed: Sequence[Cycle]) -> Array:
        self._exactly.update((cycle, self._solved(cycle)) for cycle in listed)
        return np.array([self._exactly[cycle] for cycle in listed])

    def _solved(self, cycle: Cycle) -> float:
        try:
            return self._solve(cycle)
        except TaciturnError:  # such as intervals at which sampling loses a mode
            return np.inf


def lower_hull(points: Iterable[ClockPoint]) -> list[ClockPoint]:
    """Return the corners of the convex lower hull, from the least rate to the cheapest point."""
    corners: list[ClockPoint] = []
    for point in sorted(points, key=lambda one: (one.rate, one.cost)):
        if corners and point.rate <= corners[-1].rate * (1 + SAME):
            continue  # the cheaper one of this rate is there
        while len(corners) > 1 and not _is_below(corners[-1], corners[-2], point):
            corners.pop()
        corners.append(point)
    costs = [corner.cost for corner in corners]
    return corners[: costs.index(min(costs)) + 1] if corners else []


def _is_below(middle: ClockPoint, before: ClockPoint, after: ClockPoint) -> bool:
    """Tell whether a point is below the line between two others."""
    return (middle.cost - before.cost) * (after.rate - before.rate) < (after.cost - before.cost) * (
        middle.rate - before.rate
    )


def clock_of(problem: Problem, policy: AnyPolicy) -> Clock | None:
    """Return the fair clock of a policy.

    Args:
        problem: its plant, cost and network.
        policy: designed for it.

    Returns:
        The clock; None where there is none: in a loop that is not the one of the design, such as over links that lose
        or round, of clipped inputs or another plant; for missions; where two links are scheduled; where the policy
        knows measurements later than the clock would.
    """
    nodes = policy.looked_at if isinstance(policy, OptimalPolicy) else policy
    if isinstance(nodes, EventPolicy) or nodes.prediction is not None:
        return sampling_clock(problem, "model")
    continuous = isinstance(problem.plant, ContinuousPlant)
    period = nodes.tick if continuous else None
    try:
        certainty = design_certainty("periodic", discretise(problem.plant, problem.cost, period))
        nominal = problem.close(all_time(problem.plant, problem.cost, period=period)).nominal
    except TaciturnError:  # a mission, or a network with a delay
        return None
    if not nominal or nodes.tracking is not None:
        return None
    always = certainty.problem.per_unit(certainty.cost_all_time)
    if abs(always - nodes.cost_all_time) > ALIKE * abs(always):
        return None
    if nodes.scheduled == ("sensor",):
        return _asking(certainty)
    if nodes.scheduled != ("actuator",):
        return None
    if actuation_of(nodes) == "model":
        return _ticked(certainty, "model", lambda cycle: predicted_cost(certainty, cycle))
    if continuous and problem.plant.full_state:
        return sampling_clock(problem)
    p = certainty.problem
    given = p.plant.A, p.plant.B, p.Q, p.R, p.N, certainty.corrections
    return _holding(*given, certainty.unseen, p.noise_cost, p.tick)


def actuation_of(policy: Policy) -> Actuation:
    """Return whether the actuator of a policy holds its input between sends, or runs a model."""
    silent = next(
        step.branches[0]
        for step in policy.steps
        if isinstance(step, Assign) and step.signal == "input" and len(step.branches) > 1
    )
    return "hold" if set(silent) == {"input"} else "model"


def sampling_clock(problem: Problem, actuation: Actuation = "hold") -> Clock:
    """Return the clock that samples a continuous plant and sends at one rate: it measures only when it sends.

    With an exact measurement of the full state that is the fair clock. Else it is a weaker one, which the thesis shows.
    """
    return Timed(actuation, lambda seconds: _cost(problem, seconds, actuation))


def _cost(problem: Problem, seconds: float, actuation: Actuation) -> float | None:
    """Return what periodic control at a real period costs, or None where it is not stable or not the designed loop."""
    try:
        policy = periodic(problem.plant, problem.cost, period=seconds, actuation=actuation)
        nominal = problem.close(policy).nominal
    except TaciturnError:  # such as sampling that loses a mode
        return None
    return policy.closed_form.cost if nominal and policy.closed_form is not None else None


def _ticked(certainty: Certainty, words: ClockKind, per_tick: Callable[[Cycle], float]) -> Clock:
    """Return a clock whose cycles of several intervals are no better than the chord between single ones."""
    problem = certainty.problem
    return Ticked(words, problem.tick, lambda cycle: problem.per_unit(per_tick(cycle)))


@kept
def _holding(
    A: Array, B: Array, Q: Array, R: Array, N: Array, corrections: Array, unseen: float, noise_cost: float, tick: float
) -> Clock:
    """Return the clock of an actuator that holds its input; points of one plant and cost share what it has tried."""
    held, known = Held(A, B, Q, R, N, corrections), unseen + noise_cost
    return Ticked(
        "hold",
        tick,
        lambda cycle: (known + held.solve(cycle).cost) / tick,
        lambda listed: (known + held.screen(listed)) / tick,
        min(MOST_CYCLES, int(WORK / (len(A) + SENDS * len(R)) ** 3)),
    )


def _asking(certainty: Certainty) -> Clock:
    """Return the clock of a sensor whose measurements reach a controller at the actuator."""
    plant, regulator = certainty.problem.plant, certainty.regulator
    noise = float(np.sum(regulator.K * plant.W))

    def per_tick(cycle: Cycle) -> float:
        (ticks,) = cycle
        free, none = np.zeros((plant.inputs, plant.inputs)), np.zeros_like(plant.B)
        asked = lift(plant.A, plant.B, certainty.square, free, none, plant.W, ticks)
        seen = steady_filter(asked.A, plant.C, asked.W, plant.V)
        return noise + (float(np.sum(asked.Q * seen.posterior)) + asked.noise_cost) / ticks

    return _ticked(certainty, "queries", per_tick)
