"""Loops that share a channel: their error dynamics, their common time step, and their cost under periodic control.

``gather`` reads the loops from problems. A loop of a class checks its error e⁺ = F e + w at every m-th step of the
channel; a check without a send costs e'Γe beyond the cost with every send (``Kind``).

Periodic control sends at every k-th check. At check j after a send, the mean cost is w_j = tr(Γ P_j) with P_j = F
P_{j−1} F' + W and P_0 = 0, so that an interval of k checks costs S(k) = w_1 + … + w_{k−1}. For a rate 1/k < r < 1/(k−1)
both intervals alternate, so that S is linear in between (``Clocked``). The mean cost per check is a convex function of
the rate. So one price μ per send separates the problem of several classes: each uses the interval k with the least
(S(k) + μ)/k, the first one with k w_k − S(k) ≥ μ. At the price where the load crosses the capacity, time is shared
between the intervals just below and just above this price (``allocate``). No periodic schedule in any order has a lower
cost, but none may attain it, as the sends of loops with different intervals meet in some steps. A schedule in which
each class has slots of its own is attained (``allocate_slots``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from heapq import heapify, heappop, heappush
from math import gcd, lcm

import numpy as np

from taciturn.analyse.renewal import resets
from taciturn.design.prediction import modelled
from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import Array, Displayed, count, instance, number_of, radius
from taciturn.loop import close
from taciturn.model.coverage import LINEAR_LOOP, Coverage
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant
from taciturn.model.trigger import Form
from taciturn.problem import Problem
from taciturn.problem.without_file import as_problem
from taciturn.study.evaluation import Unit, cost_unit, rate_unit
from taciturn_channel.simulated import Places
from taciturn_limits.fitted import decayed

LONGEST_INTERVAL = 1 << 17  # most checks between two sends; an error with a longer interval is never sent
FIRST = 64  # intervals that are computed first; their number is doubled when needed
SETTLED = 1e-15  # relative distance of a cost per check from its limit below which it equals the limit
HALVINGS = 200


class Clocked:
    """Error e⁺ = F e + w under periodic control: a send at every k-th check resets it, and other checks cost e'Γe."""

    def __init__(self, F: Array, noise: Array, Gamma: Array) -> None:
        """Compute the first intervals."""
        self.F, self.noise, self.Gamma = F, noise, Gamma
        self.growth = radius(F)
        covariance = decayed(F, noise)
        self.forever = np.inf if covariance is None else float(np.sum(Gamma * covariance))
        self._spread = noise
        self._weights = np.zeros(0)
        self._extend(FIRST)
        if not self._weights.any():  # no noise reaches the directions that Γ weighs
            self.forever = 0.0

    def cost(self, rate: float) -> float:
        """Return the mean cost per check of periodic control at a send rate between 0 and 1 sends per check."""
        if rate * LONGEST_INTERVAL < 1:
            return self.forever
        interval = max(1 / rate, 1.0)
        whole = int(interval)
        self._extend(whole + 1)
        below, above = self._sums[whole - 1], self._sums[whole]
        return float(rate * (below + (interval - whole) * (above - below))) if np.isfinite(above) else np.inf

    def sums(self, intervals: Places) -> Array:
        """Return the total cost S(k) of k checks between two sends, for each k; infinity if k is too large."""
        self._extend(int(intervals.max(initial=1)))
        most = len(self._sums)
        return np.where(intervals <= most, self._sums[np.minimum(intervals, most) - 1], np.inf)

    def interval(self, price: float) -> float:
        """Return how many checks between sends cost least at a price per send; infinity if sending never pays off."""
        while True:
            count = np.arange(1, len(self._weights) + 1)
            with np.errstate(over="ignore", invalid="ignore"):  # infinite values are sorted last
                gains = count * self._weights - self._sums[: len(count)]
            found = int(np.searchsorted(gains, price))
            if found < len(gains):
                return float(found + 1)
            if len(gains) >= LONGEST_INTERVAL or self._is_settled():
                return np.inf
            self._extend(2 * len(gains))

    def least_rate(self, cost: float) -> float:
        """Return the lowest periodic send rate 1/k, with integer k, whose mean cost per check is at most ``cost``."""
        while self._sums[-1] < cost * len(self._sums) and len(self._sums) < LONGEST_INTERVAL and not self._is_settled():
            self._extend(2 * len(self._weights))
        count = np.arange(1, len(self._sums) + 1)
        return 1.0 / int(np.searchsorted(self._sums / count, cost, side="right").clip(1))

    def _is_settled(self) -> bool:
        last = self._weights[-1]
        return bool(np.isfinite(self.forever) and self.forever - last <= SETTLED * self.forever)

    def _extend(self, checks: int) -> None:
        """Compute w_k up to a number of checks, at most LONGEST; numbers that overflow become infinite."""
        more: list[float] = []
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(len(self._weights), min(checks, LONGEST_INTERVAL)):
                weight = float(np.sum(self.Gamma * self._spread))
                more.append(weight if np.isfinite(weight) else np.inf)
                self._spread = self.F @ self._spread @ self.F.T + self.noise
        if more:
            self._weights = np.maximum.accumulate(np.concatenate([self._weights, more]))
            with np.errstate(over="ignore"):
                self._sums = np.concatenate([[0.0], np.cumsum(self._weights)])  # S(1), S(2), …


@dataclass(frozen=True, eq=False, repr=False)
class LoopClass(Displayed):
    """A class of identical loops that share a channel."""

    error: Clocked  # the error of one loop, with the cost of its intervals
    count: int  # number of loops in the class
    every: int = 1  # steps of the channel between two checks of a loop


@dataclass(frozen=True, eq=False, repr=False)
class Allocation(Displayed):
    """Optimal send rates for several classes of loops under periodic control on a shared channel."""

    rates: Array  # sends per check of each class, (classes,)
    price: float  # price per send at which each class would choose its rate by itself; 0 if all can send at every check
    costs: Array  # mean cost per step of one error of each class, (classes,)


def allocate(sharers: Sequence[LoopClass], capacity: float) -> Allocation:
    """Compute the send rates of all classes that minimise the total cost, with at most ``capacity`` sends per step."""
    counts = np.array([sharer.count / sharer.every for sharer in sharers])
    if counts.sum() <= capacity:
        return Allocation(np.ones(len(sharers)), 0.0, np.zeros(len(sharers)))

    def rates(price: float) -> Array:
        return np.array([1 / sharer.error.interval(price) for sharer in sharers])

    def load(price: float) -> float:
        return float(counts @ rates(price))

    high = 1.0
    while load(high) > capacity:
        high *= 2
    low = high / 2
    while low > 0 and load(low) < capacity:
        low /= 2
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        if not low < middle < high:
            break
        low, high = (middle, high) if load(middle) >= capacity else (low, middle)
    often, rarely = rates(low), rates(high)
    loads = counts @ often, counts @ rarely
    share = 1.0 if loads[0] <= capacity else (capacity - loads[1]) / (loads[0] - loads[1])
    chosen = share * often + (1 - share) * rarely
    costs = [sharer.error.cost(rate) / sharer.every for sharer, rate in zip(sharers, chosen.tolist(), strict=True)]
    return Allocation(chosen, high, np.array(costs))


def allocate_slots(sharers: Sequence[LoopClass], capacity: int) -> float:
    """Return the least cost per step if each class sends periodically in its own slots; infinity if that is impossible.

    The loops of a class check in turn: in each step, the loops of one phase. The loops send one after the other in the
    slots of the class, so that their intervals are the integers next to the mean interval, whose cost is that of
    ``Clocked``. Therefore this cost is attained, and the cost of ``allocate`` is a lower bound. Since the cost is
    convex in the number of slots, each further slot goes to the class that gains most from it.
    """

    def cost(sharer: LoopClass, slots: int) -> float:
        sizes = [-(-(sharer.count - phase) // sharer.every) for phase in range(min(sharer.every, sharer.count))]
        total = sum(size * sharer.error.cost(min(1.0, slots / size)) if slots < size else 0.0 for size in sizes)
        return total / sharer.every

    alike: dict[tuple[object, ...], LoopClass] = {}
    for sharer in sharers:
        error = sharer.error
        key = (sharer.every, *(one.tobytes() for one in (error.F, error.noise, error.Gamma)))
        alike[key] = LoopClass(error, sharer.count + (alike[key].count if key in alike else 0), sharer.every)
    sharers = list(alike.values())
    slots, costs = [0] * len(sharers), [cost(sharer, 0) for sharer in sharers]

    def gain(place: int) -> tuple[float, int]:
        following = cost(sharers[place], slots[place] + 1)
        return (-np.inf if np.isinf(costs[place]) else following - costs[place]), place

    gains = [gain(place) for place in range(len(sharers))]
    heapify(gains)
    for _ in range(capacity):
        change, place = heappop(gains)
        if change >= 0:
            break
        slots[place] += 1
        costs[place] = cost(sharers[place], slots[place])
        heappush(gains, gain(place))
    return float(sum(costs))


CHANNELS = Coverage(LINEAR_LOOP, "loops that share a channel do not support")
FINEST = 1_000_000  # periods are approximated by fractions of a second with at most this denominator
EQUAL = 1e-9  # largest relative error of this approximation
LONGEST_CYCLE = 10_000  # largest number of steps after which the checks of all loops repeat


@dataclass(frozen=True, eq=False, repr=False)
class Kind(Displayed):
    """Identical loops of one problem: plant, cost, and a controller that predicts the state at the actuator.

    The error is e⁺ = F e (1−σ) + w. A check without a send costs e'Γe beyond sending every sample, in the units of the
    cost times steps; so a loop that checks at every other step has twice the weight.
    """

    name: str  # name of the problem
    count: int  # number of loops
    every: int  # steps of the channel between two checks
    F: Array  # error dynamics, (n, n)
    noise: Array  # covariance of w, (n, n)
    Gamma: Array  # weight Γ, (n, n)
    L: Array  # matrix from the error of the state to the error of the input, (inputs, n)
    cost_all_time: float  # cost of one loop that sends at every check
    clocked: Clocked  # cost of periodic control as a function of the send interval

    @property
    def looks(self) -> float:
        """Number of checks per step, summed over all loops of this problem."""
        return self.count / self.every


def gather(problems: Mapping[str, Problem], copies: Sequence[int]) -> tuple[Kind, ...]:
    """Return the loops of several problems that share a channel, with a given number of copies of each problem."""
    instance("problems", problems, Mapping)
    if not problems:
        raise ProblemError("problems is empty; expected at least one problem, whose loops share the channel")
    if len(copies) not in (1, len(problems)):
        raise ProblemError(
            f"copies has {number_of(len(copies), 'number')} for {number_of(len(problems), 'problem')}; expected one "
            "number for each problem, or one number for all"
        )
    copies = [count("copies", number) for number in copies] * (1 if len(copies) > 1 else len(problems))
    problems = {name: as_problem(f"problems[{name!r}]", problem) for name, problem in problems.items()}
    units: dict[str, Unit] = {name: cost_unit(problem) for name, problem in problems.items()}
    for name, unit in units.items():
        first = next(iter(units))
        if unit != units[first]:
            raise ProblemError(
                f"the cost of {first} is per {units[first]}, but the cost of {name} is per {unit}; expected one unit: "
                "define all plants in continuous time with policy.period, or all with plant.dt"
            )
    every = _common_ticks(
        {name: _period(name, problem) for name, problem in problems.items()}, rate_unit(units[next(iter(units))])
    )
    return tuple(
        _kind(name, problem, number, step)
        for (name, problem), number, step in zip(problems.items(), copies, every, strict=True)
    )


def _kind(name: str, problem: Problem, number: int, every: int) -> Kind:
    try:
        if problem.network != Network():
            given = "[nodes]" if problem.network.own_nodes else "[network]"
            raise ProblemError(
                f"{given} is given, but the shared channel replaces the network; expected a problem without {given}"
            )
        if problem.controller is not None:
            raise ProblemError(
                "[controller] is given, but the loops of a shared channel have LQG control; expected no [controller]"
            )
        if problem.nonlinear:
            raise ProblemError("the plant is nonlinear; expected a linear plant in loops that share a channel")
        period = problem.parameters.get("period")
        policy = modelled(
            "channel", problem.plant, problem.cost, period, lambda _, reset: Form((reset.error,), reset.weight)
        )
        loop = close(problem.actual or problem.plant, policy)
        if loop.violated_assumptions:
            raise ProblemError(
                f"a loop on the shared channel is not that of the design: {loop.violated_assumptions[0]}; expected the "
                "plant and cost of the design"
            )
        if loop.problem.jumps is not None:
            raise ProblemError("plant.jumps is given; expected Gaussian noise (plant.W) in loops that share a channel")
        CHANNELS.check(loop.parts)
        reset = resets(loop)
    except TaciturnError as error:
        raise type(error)(f"{name}: {error}") from None
    F = loop.problem.plant.A
    Gamma, noise, seen = every * reset.weight, reset.covariance, list(reset.signals.values())
    return Kind(name, number, every, F, noise, Gamma, seen[-1], policy.cost_all_time, Clocked(F, noise, Gamma))


def _period(name: str, problem: Problem) -> float | None:
    """Return the seconds between two checks of a problem's loop, or None if time is counted in steps."""
    if not isinstance(problem.plant, ContinuousPlant):
        return problem.plant.dt
    period = problem.parameters.get("period")
    if period is None:
        raise ProblemError(
            f"{name}: the plant is continuous in time, but policy.period is missing; expected the seconds between "
            "checks (set plant.dt if A and B are discrete-time matrices)"
        )
    return float(period)


def _common_ticks(periods: Mapping[str, float | None], unit: str) -> list[int]:
    """Return the number of steps of the channel in each period."""
    seconds = [period for period in periods.values() if period is not None]
    if not seconds:
        return [1] * len(periods)
    if len(seconds) < len(periods):
        without = next(name for name, period in periods.items() if period is None)
        other = next(name for name, period in periods.items() if period is not None)
        raise ProblemError(
            f"the problem {without} has no plant.dt, but the loop of {other} checks every {periods[other]:g} s; "
            "expected plant.dt in all problems, for a common step"
        )
    if len(set(seconds)) > 1 and unit == "step":
        listed = ", ".join(f"{name} {period:g} s" for name, period in periods.items())
        raise ProblemError(
            f"costs are per step, but the steps have different lengths ({listed}); expected the same plant.dt in all "
            "problems, or plants in continuous time with policy.period"
        )
    exact = [Fraction(period).limit_denominator(FINEST) for period in seconds]
    whole = lcm(*(part.denominator for part in exact))
    steps = [int(part * whole) for part in exact]
    every = [step // gcd(*steps) for step in steps]
    off = any(abs(part / Fraction(period) - 1) > EQUAL for part, period in zip(exact, seconds, strict=True))
    if off or lcm(*every) > LONGEST_CYCLE:
        listed = ", ".join(f"{name} every {period:g} s" for name, period in periods.items())
        raise ProblemError(
            f"the loops check at different times ({listed}), and the pattern does not repeat within {LONGEST_CYCLE} "
            "common steps; expected periods that are multiples of a common step"
        )
    return every
