"""Many loops on one channel: who sends when, what that costs, how far it is from the best, and from any clock."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from taciturn._arrays import choice, count, instance, number
from taciturn._figure import Panel, Series, draw
from taciturn._progress import Progress
from taciturn.analyse.limits import USUAL
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.problem import Problem
from taciturn.renewal.allocation import allocate
from taciturn.simulation.statistics import mean
from taciturn.study.evaluate import SURE
from taciturn.study.kinds import gather
from taciturn.study.prices import DualBound
from taciturn.study.schedulers import SCHEDULERS, SHORTEST, Game, measure
from taciturn.study.units import TimeUnit, time_unit
from taciturn.study.workers import idle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SchedulerName: TypeAlias = Literal["price", "largest", "round-robin", "tdma", "once-discard", "random-access"]


@dataclass(frozen=True, eq=False)
class Share:
    """What the loops of one problem get of the channel.

    Args:
        name: of the problem.
        copies: loops.
        cost: mean of one loop.
        cost_all_time: of one loop that sends at every look.
        rate: mean sends per look of one loop.
        rate_periodic: that of the best periodic allocation.
    """

    name: str
    copies: int
    cost: Estimate
    cost_all_time: float
    rate: Estimate
    rate_periodic: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Sharing:
    """Loops on a channel.

    Args:
        scheduler: who decides.
        capacity: sends per tick at most.
        unit: what costs count per.
        shares: the loops, problem by problem.
        cost: sum over all loops.
        cost_all_time: the sum if all could always send.
        lower_bound: what no scheduler of these controllers costs less than; None where it was not asked for.
        load: sends per tick that got through.
        busy: sends per tick, with those that collided.
        waiting: loops per tick that wanted to send and did not get through; of schedulers with a price.
        load_expected: sends per tick if none had to wait; of schedulers with a price.
        price: of a send, that is common to all loops; of schedulers with one.
        cost_periodic: of the best periodic allocation with as many sends per tick as there may be.
        cost_periodic_same_load: of the best with no more sends than there were.
        clock_attained: whether looks come so evenly that periodic allocations are only bound by the mean load; else the
            best of them may cost more.
        ticks: that were measured, of all channels that were simulated together.
        reached: whether the asked standard error was met.
        seed: of the draws.
        seconds: wall time; ``price_seconds`` of it for prices, schedules and the bound.
        notes: what the reader must know.
    """

    scheduler: SchedulerName
    capacity: int
    unit: TimeUnit
    shares: tuple[Share, ...]
    cost: Estimate
    cost_all_time: float
    lower_bound: DualBound | None
    load: Estimate
    busy: Estimate
    waiting: Estimate | None
    load_expected: Estimate | None
    price: float | None
    cost_periodic: float
    cost_periodic_same_load: float
    clock_attained: bool
    ticks: int
    reached: bool
    seed: int
    seconds: float
    price_seconds: float
    notes: tuple[str, ...] = ()

    @property
    def loops(self) -> int:
        """How many share the channel."""
        return sum(share.copies for share in self.shares)

    @property
    def consistent(self) -> bool | None:
        """Whether the loops cost no more than the best periodic allocation of the channel; None: not to be told.

        By 4 standard errors; where looks clash no clock may attain the best allocation's cost, and False is not told.
        """
        above, spread = self.cost.value - self.cost_periodic, SURE * self.cost.standard_error
        if above < -spread or above <= spread == 0:
            return True
        return False if above > spread and self.clock_attained else None

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn channel --json``."""
        bound = self.lower_bound
        return {
            "scheduler": self.scheduler,
            "loops": self.loops,
            "capacity": self.capacity,
            "unit": self.unit,
            "cost": self.cost.document(),
            "cost_all_time": self.cost_all_time,
            "cost_lower_bound": None if bound is None else bound.cost,
            "cost_lower_bound_confidence": None if bound is None else bound.confidence,
            "cost_periodic": _finite(self.cost_periodic),
            "cost_periodic_same_load": _finite(self.cost_periodic_same_load),
            "consistent": self.consistent,
            "load": self.load.document(),
            "load_expected": None if self.load_expected is None else self.load_expected.document(),
            "busy": self.busy.document(),
            "waiting": None if self.waiting is None else self.waiting.document(),
            "price": self.price,
            "problems": [
                {
                    "name": share.name,
                    "copies": share.copies,
                    "cost": share.cost.document(),
                    "cost_all_time": share.cost_all_time,
                    "rate": share.rate.document(),
                    "rate_periodic": share.rate_periodic,
                }
                for share in self.shares
            ],
            "reached": self.reached,
            "seed": self.seed,
            "seconds": self.seconds,
            "notes": list(self.notes),
        }

    def plot(self) -> Figure:
        """Return a figure: what the loops cost, beside the lower bound, the best clock, and sending always."""
        lines = {
            "sending always": Estimate(self.cost_all_time, 0.0, "exact"),
            self.scheduler: self.cost,
            "best periodic allocation": Estimate(self.cost_periodic, 0.0, "exact"),
        }
        if self.lower_bound is not None:
            lines["lower bound"] = Estimate(self.lower_bound.cost, 0.0, "bound")
        bars = Series(
            [estimate.value for estimate in lines.values()],
            list(range(len(lines))),
            style="bars",
            error=[estimate.standard_error for estimate in lines.values()],
        )
        title = f"{self.loops} loops, at most {self.capacity} sends per tick"
        return draw([Panel([bars], f"sum of the costs per {self.unit}", title=title, names=list(lines))])


def share_channel(
    problems: Mapping[str, Problem],
    *,
    copies: int | Sequence[int],
    capacity: int,
    scheduler: SchedulerName = "price",
    seed: int = 0,
    standard_error: float | None = None,
    ticks: int | None = None,
    confidence: float = USUAL,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Sharing:
    """Share one channel among loops, at most so many sends per tick.

    Every loop has its problem's certainty-equivalent controller with an actuator that predicts, so that J_i = J_all,i +
    E[(1−σ)e'Γe] with the error e that a send resets; the scheduler alone decides who sends. Of these

    * ``price``: a loop wants to send where its nearly optimal trigger at a common price per send says so; the price is
      where the expected load meets the capacity. If more want to send, those wait whose silence costs least; if fewer,
      those whose silence costs most take the slots that are left;
    * ``largest``: those with the largest e'Γe;
    * ``once-discard``: those with the largest error of the input, |û − Lx̂|² (try-once-discard);
    * ``round-robin``: each in its turn;
    * ``tdma``: each at its own rate, those of the best periodic allocation; who is to send again first goes first;
    * ``random-access``: triggers at a common price, in slots drawn at random, where packets collide.

    Args:
        problems: plant, cost and, with a continuous plant, policy.period of each kind of loop, by name.
        copies: loops of each problem, or of all.
        capacity: sends per tick, from 1 to the number of loops; of random access the slots per tick.
        scheduler: who decides.
        seed: of the draws; the result depends on nothing else.
        standard_error: absolute, of the sum of the costs; omitted: 1e-3 of it.
        ticks: measure so many on each channel instead.
        confidence: of the lower bound, where some of it is sampled; 0: seek none.
        executor: works on the kinds of loops side by side, as on the cells of ``sweep``; the result does not depend on
            it. Omitted: here, one after the other.
        progress: called with the fraction done.

    Returns:
        Sum of the costs with what it is measured by: the dual lower bound, and the best periodic allocation.

    Raises:
        ProblemError: capacity below 1 or above the number of loops, loops without a common tick or with other units, a
            problem whose error no send resets.
        UnstableError: an unstable loop gets so little that it is not controlled; the message says which, and what it
            needs.

    Source: walsh2002, rivest1987, everett1963

    Example:
        >>> import taciturn
        >>> found = share_channel({"a": taciturn.load("wiener-double-integrator")}, copies=20, capacity=4, ticks=2000)
        >>> assert found.lower_bound is not None
        >>> found.lower_bound.cost < found.cost.value < found.cost_periodic
        True
    """
    began = time.perf_counter()
    kinds = gather(problems, [copies] if isinstance(copies, int) else copies)
    plays = SCHEDULERS[choice("scheduler", scheduler, SCHEDULERS)]
    loops, capacity = sum(kind.count for kind in kinds), count("capacity", capacity)
    if capacity > loops:
        raise ProblemError(
            f"capacity is {capacity} and {loops} loops share the channel; expected at most {loops}: with as many sends "
            "per tick as loops they share nothing"
        )
    if standard_error is not None and ticks is not None:
        raise ProblemError("standard_error and ticks are both given; expected one of them")
    standard_error = None if standard_error is None else number("standard_error", standard_error, 0.0)
    ticks = None if ticks is None else count("ticks", ticks, SHORTEST)
    seed = count("seed", seed, 0)
    if executor is not None:
        instance("executor", executor, Executor)
    confidence = number("confidence", confidence, 0.0, 1.0) if confidence else 0.0
    game = Game(kinds, capacity, seed, confidence, executor, progress or idle)
    plan, bound = plays(game), game.bound
    prepared = time.perf_counter() - began
    measured = measure(game, plan, standard_error, ticks)
    shares: list[Share] = []
    for place, (kind, rate) in enumerate(zip(kinds, game.clocked.rates.tolist(), strict=True)):
        cost = mean(measured.costs[:, place]).scaled(1 / kind.count, kind.cost_all_time)
        got = mean(measured.sends[:, place]).scaled(1 / kind.looks)
        shares.append(Share(kind.name, kind.count, cost, kind.cost_all_time, got, rate))
    base = game.cost_all_time
    load = mean(measured.sends.sum(axis=1))
    periodic = allocate(game.sharers, max(min(load.value, capacity), 1e-9))
    few, cycle = game.clashes
    clashing = (
        f"in {few} of {cycle} ticks fewer loops look than there are slots, and in others more: the best clock keeps to "
        "the mean load alone, and what can be allocated may cost more"
    )
    return Sharing(
        scheduler=scheduler,
        capacity=capacity,
        unit=time_unit(next(iter(problems.values()))),
        shares=tuple(shares),
        cost=mean(measured.costs.sum(axis=1)).scaled(1.0, base),
        cost_all_time=base,
        lower_bound=bound,
        load=load,
        busy=mean(measured.busy),
        waiting=None if plan.price is None else mean(measured.waiting),
        load_expected=plan.load,
        price=plan.price,
        cost_periodic=base + float(game.counts @ game.clocked.costs),
        cost_periodic_same_load=base + float(game.counts @ periodic.costs),
        clock_attained=not few,
        ticks=measured.ticks,
        reached=measured.reached,
        seed=seed,
        seconds=time.perf_counter() - began,
        price_seconds=prepared,
        notes=plan.notes + ((clashing,) if few else ()),
    )


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None
