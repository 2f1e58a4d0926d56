"""Many loops that share one channel, with a lower bound on the cost: ``taciturn.share_channel`` and its result.

The loops of ``classes`` share the channel by one of the ``schedulers``, whose cost is measured by simulation. It is
compared with the best periodic control and with the lower bound at the price of a send at which the load equals the
capacity (``prices``).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias

from taciturn.errors import ProblemError
from taciturn.extend import (
    Above,
    Displayed,
    Level,
    Panel,
    Progress,
    Series,
    Size,
    StyleName,
    Thing,
    answered_within,
    choice,
    count,
    draw,
    in_notebook,
    instance,
    number,
    number_of,
    percent,
    table_text,
)
from taciturn.model.estimate import Estimate, rounded
from taciturn.model.result import VERDICT, Field, Tabular, plain_fields
from taciturn.model.theory import LEVEL
from taciturn.problem import Problem
from taciturn.simulation.statistics import mean
from taciturn.study.evaluate import SURE
from taciturn.study.evaluation import Unit, cost_unit
from taciturn.study.sentences import compared_text, more_text, percent_above
from taciturn_channel.classes import allocate, gather
from taciturn_channel.prices import DualBound
from taciturn_channel.schedulers import SCHEDULERS, SHORTEST_STRETCH, Game, measure
from taciturn_studies.workers import idle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SchedulerName: TypeAlias = Literal["price", "largest", "round-robin", "tdma", "once-discard", "random-access"]
SAME = 1e-9  # relative
BESIDE = 0.14  # distance of two marks of one row from its middle, in rows


@dataclass(frozen=True, eq=False, repr=False)
class Share(Displayed):
    """Cost and send rate of the loops of one problem on a shared channel.

    Args:
        name: name of the problem.
        copies: number of its loops.
        cost: mean cost of one loop.
        cost_all_time: cost of one loop that sends at every check.
        rate: mean sends per check of one loop.
        rate_periodic: sends per check of one loop in the best periodic allocation.
    """

    name: str
    copies: int
    cost: Estimate
    cost_all_time: float
    rate: Estimate
    rate_periodic: float


CONSISTENT = {True: "yes", False: "no", None: "undecided within the standard errors"}


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None


def _costs(found: Sharing) -> list[tuple[str, str, str]]:
    """Return name, sum of the costs and excess over every sample of the rows of the table of costs."""
    base, bound = found.cost_all_time, found.lower_bound
    rows = [("this scheduler", found.cost, str(found.cost), 0)]
    timed = {name: cost for name, cost in _periodic(found).items() if isfinite(cost)}
    rows += [(name, Estimate(cost, 0.0, "exact"), f"{cost:.6g}", 0) for name, cost in timed.items()]
    rows.append(("every sample", Estimate(base, 0.0, "exact"), f"{base:.6g}", 0))
    if bound is not None:
        rows.append(("lower bound, any scheduler", Estimate(bound.cost, 0.0, "bound"), rounded(bound.cost, 6, -1), -1))
    return [
        (name, text, "" if name == "every sample" or not base else percent_above(cost, base, up))
        for name, cost, text, up in rows
    ]


def _periodic(found: Sharing) -> dict[str, float]:
    """Return the cost of the best periodic allocation, or its bound and the best cost found, by name."""
    if found.clock_attained:
        return {"best periodic": found.cost_periodic}
    return {"lower bound, periodic": found.cost_periodic, "periodic, best found": found.cost_periodic_attained}


def _verdict(found: Sharing) -> str:
    """Return the cost, next to that of periodic control and of the best scheduler."""
    base, bound = found.cost_all_time, found.lower_bound
    start = f"{number_of(found.loops, 'loop')}, at most {number_of(found.capacity, 'send')} per step: "
    if not base:
        return f"{start}sum of costs {found.cost} per {found.unit}"
    told = [compared_text(found.cost, base)]
    if isfinite(found.cost_periodic_attained):
        best = Estimate(found.cost_periodic_attained, 0.0, "exact")
        told.append(f"best periodic{'' if found.clock_attained else ' found'} {more_text(best, base)}")
    if bound is not None:
        least = Estimate(bound.cost, 0.0, "bound")
        told.append(f"no scheduler below {percent_above(least, base, -1, signed=False)} more")
    return start + "; ".join(told)


def _sure(found: Sharing) -> str:
    bound = found.lower_bound
    if bound is None:
        return ""
    sure = "computed by quadrature" if bound.confidence is None else f"{percent(bound.confidence)} sure"
    return f"with these controllers costs less than {rounded(bound.cost, 6, -1)} per {found.unit} ({sure})"


def _busy(found: Sharing) -> str:
    return f"{found.busy} packets per step, collisions included" if found.scheduler == "random-access" else ""


def _price(found: Sharing) -> str:
    return "" if found.price is None or found.waiting is None else f"{found.price:.6g} per send"


def _waiting(found: Sharing) -> str:
    return "" if found.price is None or found.waiting is None else f"{found.waiting} loops per step"


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Sharing(Tabular):
    """Total cost and total load of loops that share a channel.

    Args:
        scheduler: rule that decides which loops send.
        capacity: largest number of sends per step.
        unit: unit that the costs refer to.
        shares: results of the loops, for each problem.
        cost: sum of the costs over all loops.
        cost_all_time: sum of the costs if all loops could send at every check.
        lower_bound: lower bound on the cost of any scheduler with these controllers; None if it was not requested.
        load: successful sends per step.
        busy: sends per step, including those that collided.
        waiting: loops per step that requested a send and did not get one; only for schedulers with a price.
        load_expected: sends per step if no loop had to wait; only for schedulers with a price.
        price: price per send, common to all loops; only for schedulers with a price.
        cost_periodic: lower bound on the cost of all periodic allocations, by their mean load.
        cost_periodic_same_load: the same for those with no more sends than were measured.
        cost_periodic_attained: cost of the best periodic schedule found: slots of its own for each problem, or a
            repeated stretch of time division. If it is ``cost_periodic``, both are that of the best periodic
            allocation.
        ticks: number of measured steps, over all channels that were simulated together.
        reached: whether the requested standard error was reached.
        seed: seed of the random draws.
        seconds: wall time; ``price_seconds`` is the part for prices, schedules and the bound.
        notes: warnings and remarks for the reader.
    """

    FIELDS: ClassVar[tuple[Field[Sharing], ...]] = (
        VERDICT,
        Field("scheduler", say="scheduler"),
        Field("loops"),
        *plain_fields("capacity", "unit"),
        Field("rate_unit", lambda _: "step"),
        Field("method", say="method", part="method"),
        Field("cost", json=Estimate.document),
        Field("cost_all_time"),
        Field("cost_lower_bound", "lower_bound.cost", say="no scheduler", text=_sure),
        Field("cost_lower_bound_confidence", "lower_bound.confidence"),
        Field("cost_periodic", json=_finite),
        Field("cost_periodic_same_load", json=_finite),
        Field("cost_periodic_attained", json=_finite),
        Field("consistent", say="consistent", text=lambda found: CONSISTENT[found.consistent]),
        Field("load", json=Estimate.document, say="load", text="{} sends per step"),
        Field("load_expected", json=Estimate.document, say="expected load", text="{} if no loop had to wait"),
        Field("busy", json=Estimate.document, say="on the channel", text=_busy),
        Field("waiting", json=Estimate.document, say="waiting", text=_waiting, after="price"),
        Field("price", say="price", text=_price),
        Field("problems", lambda found: found.row_documents()),
        Field("reached"),
        Field("seed", say="seed", part="method"),
        Field("seconds", say="time", text="{:.3g} s, {of.ticks} simulated steps", part="method"),
        Field("notes", say="note"),
    )
    heading: ClassVar[tuple[str, ...]] = (
        "scheduler",
        "loops",
        "capacity",
        "cost",
        "load",
        "unit",
        "method",
        "seed",
        "notes",
    )

    scheduler: SchedulerName
    capacity: int
    unit: Unit
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
    cost_periodic_attained: float
    ticks: int
    reached: bool
    seed: int
    seconds: float
    price_seconds: float
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence that compares the total cost of the loops with periodic control and with the lower bound."""
        return (_verdict(self),)

    @property
    def method(self) -> str:
        """Method that gave the costs."""
        return self.cost.method

    @property
    def loops(self) -> int:
        """Total number of loops that share the channel."""
        return sum(share.copies for share in self.shares)

    @property
    def consistent(self) -> bool | None:
        """Whether the loops cost no more than the best periodic allocation; None if this is statistically undecided.

        The margin is 4 standard errors. The cost of the best allocation is between ``cost_periodic`` and
        ``cost_periodic_attained``.
        """
        above, spread = self.cost.value - self.cost_periodic, SURE * self.cost.standard_error
        if above < -spread or above <= spread == 0:
            return True
        return False if self.cost.value - self.cost_periodic_attained > spread else None

    @property
    def clock_attained(self) -> bool:
        """Whether a periodic allocation is known that costs exactly ``cost_periodic``."""
        return self.cost_periodic_attained <= self.cost_periodic + SAME * abs(self.cost_periodic)

    def table_rows(self) -> Sequence[Share]:
        """Return the rows of the table, one for the loops of each problem."""
        return self.shares

    def row_fields(self) -> tuple[Field[Share], ...]:
        """Return the columns of the table: cost and send rate of the loops of each problem."""
        per = "sends per check"
        return (
            Field("name", column="name", say=""),
            Field("copies", column="loops", say="loops"),
            Field("cost", json=Estimate.document, column="cost", say=f"cost per {self.unit}"),
            Field("cost_all_time", column="cost_every_sample", say="every sample", text="{:.6g}"),
            Field("rate", json=Estimate.document, column="rate", say=per),
            Field("rate_periodic", column="rate_periodic", say="sends, best periodic", text="{:.4g}"),
        )

    def table_texts(self) -> Sequence[str]:
        """Return a table of the total costs, and a table of the costs and rates of each problem's loops."""
        return (table_text(["", f"sum of costs per {self.unit}", "extra cost"], _costs(self), 1), self.table())

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Plot the total cost next to its bounds, and the send rate of the loops of each problem.

        Args:
            ax: existing axes to draw in instead of a new figure: two, one above the other.
            figsize: width and height of a new figure, in inches.
            style: ``"light"``, ``"dark"``, ``"paper"`` or ``"paper-wide"``.
        """
        return draw([self._costs(), self._rates()], ax, figsize, style)

    def _costs(self) -> Panel:
        """Return the panel of the sum of the costs, and of the bounds and allocations to compare it with."""
        found: list[tuple[str, float, float, Thing | int]] = [
            ("this scheduler", self.cost.value, self.cost.standard_error, "policy"),
            *((name, cost, 0.0, "periodic control") for name, cost in _periodic(self).items()),
            ("every sample", self.cost_all_time, 0.0, "every sample"),
        ]
        if self.lower_bound is not None:
            found.append(("lower bound, any scheduler", self.lower_bound.cost, 0.0, "lower bound"))
        rows = [row for row in found if isfinite(row[1])][::-1]  # the first is the uppermost
        base, values = self.cost_all_time, [value for _, value, _, _ in rows]
        above = Above.of(base, [self.cost.value], values) if base > 0 else None
        more = {name: extra for name, _, extra in _costs(self)}
        shown = {"this scheduler": f"this scheduler ({self.scheduler})"}
        return Panel(
            [
                Series([value], [float(row)], "", "bars", [error], thing)
                for row, (_, value, error, thing) in enumerate(rows)
            ],
            f"sum of costs per {self.unit}" if above is None else above.label("sum of costs", f"per {self.unit}"),
            title=_verdict(self),
            names=[shown.get(name, name) for name, _, _, _ in rows],
            notes=[f"{value:.5g}  {more.get(name, '')}".rstrip().replace("-", "−") for name, value, _, _ in rows],
            xabove=above,
            levels=[Level(base, axis="x")],
        )

    def _rates(self) -> Panel:
        """Return the panel of the rates of a loop of each problem, with those of periodic control."""
        rows = self.shares[::-1]
        places = [float(row) for row in range(len(rows))]
        rates, errors = [one.rate.value for one in rows], [one.rate.standard_error for one in rows]
        clocks, timed = [one.rate_periodic for one in rows], next(iter(_periodic(self)))
        return Panel(
            [
                Series(rates, [row + BESIDE for row in places], "this scheduler", "bars", errors, "policy"),
                Series(clocks, [row - BESIDE for row in places], timed, "points", thing="periodic control"),
            ],
            "sends per check of one loop",
            names=[f"{one.copies} × {one.name}" for one in rows],
            notes=[f"{rate:.3g}" for rate in rates],
            xlim=(0.0, None),
        )


def share_channel(
    problems: Mapping[str, Problem],
    *,
    copies: int | Sequence[int],
    capacity: int,
    scheduler: SchedulerName = "price",
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    confidence: float = LEVEL,
    executor: Executor | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Sharing:
    """Simulate loops that share one channel on which only a limited number of packets is sent per step.

    Every loop has its problem's certainty-equivalent controller with an actuator that predicts. So its cost is J_i =
    J_all,i + E[(1−σ)e'Γe] with the error e that a send resets. Only the scheduler decides which loops send. The
    schedulers are:

    * ``price``: a loop requests a send if its nearly optimal trigger at a common price per send fires; at this price
      the expected load equals the capacity. If too many loops request a send, those whose silence costs least wait; if
      too few do, the loops whose silence costs most use the free slots.
    * ``largest``: the loops with the largest e'Γe send.
    * ``once-discard``: the loops with the largest error of the input, |û − Lx̂|², send (try-once-discard).
    * ``round-robin``: the loops send in a fixed order.
    * ``tdma``: each loop sends at its rate in the best periodic allocation; loops with shorter intervals go first.
    * ``random-access``: triggers at a common price request sends in randomly drawn slots, where packets can collide.

    Args:
        problems: problems by name, one for each kind of loop, with plant, cost and, for a continuous plant,
            policy.period.
        copies: number of loops of each problem, as a list or as one number for all.
        capacity: sends per step, from 1 to the number of loops; for random access, the slots per step.
        scheduler: rule that decides which loops send.
        seed: seed of the random draws; the result depends on nothing else.
        standard_error: absolute standard error of the sum of the costs; default: 1e-3 of this sum.
        steps: number of steps to measure on each channel, instead of a standard error.
        confidence: confidence of the lower bound, if a part of it is sampled; 0 for no lower bound.
        executor: executor that processes the kinds of loops in parallel, like the cells of ``sweep``; the result does
            not depend on it. Default: one after the other in this process.
        time_limit: time limit in seconds; default: none. Without a result in time, an error is raised.
        progress: callback that receives the fraction done.

    Returns:
        The sum of the costs, with the dual lower bound and the best periodic allocation for comparison.

    Raises:
        ProblemError: the capacity is below 1 or above the number of loops, the loops have no common step or different
            units, or no send resets the error of a problem.
        UnstableError: an unstable loop sends too rarely to be stabilised; the message names the loop and the rate that
            it needs.

    Source: walsh2002, rivest1987, everett1963

    Example:
        >>> import taciturn
        >>> found = share_channel({"a": taciturn.load("wiener-double-integrator")}, copies=20, capacity=4, steps=2000)
        >>> assert found.lower_bound is not None
        >>> found.lower_bound.cost < found.cost.value < found.cost_periodic
        True
    """
    with answered_within(time_limit):
        began = time.perf_counter()
        kinds = gather(problems, [copies] if isinstance(copies, int) else copies)
        plays = SCHEDULERS[choice("scheduler", scheduler, SCHEDULERS)]
        loops, capacity = sum(kind.count for kind in kinds), count("capacity", capacity)
        if capacity > loops:
            raise ProblemError(
                f"capacity is {capacity}, but the channel has only {number_of(loops, 'loop')}; expected at most {loops}"
            )
        if standard_error is not None and steps is not None:
            raise ProblemError(f"standard_error and steps={steps} are both given; expected one of them")
        standard_error = None if standard_error is None else number("standard_error", standard_error, 0.0)
        steps = None if steps is None else count("steps", steps, SHORTEST_STRETCH)
        seed = count("seed", seed, 0)
        if executor is not None:
            instance("executor", executor, Executor)
        confidence = number("confidence", confidence, 0.0, 1.0) if confidence else 0.0
        game = Game(kinds, capacity, seed, confidence, executor, in_notebook(progress) or idle)
        plan, bound = plays(game), game.bound
        prepared = time.perf_counter() - began
        measured = measure(game, plan, standard_error, steps)
        shares: list[Share] = []
        for place, (kind, rate) in enumerate(zip(kinds, game.clocked.rates.tolist(), strict=True)):
            cost = mean(measured.costs[:, place]).scaled(1 / kind.count, kind.cost_all_time)
            got = mean(measured.sends[:, place]).scaled(1 / kind.looks)
            shares.append(Share(kind.name, kind.count, cost, kind.cost_all_time, got, rate))
        base = game.cost_all_time
        load = mean(measured.sends.sum(axis=1))
        periodic = allocate(game.sharers, max(min(load.value, capacity), 1e-9))
        least = base + float(game.counts @ game.clocked.costs)
        known = game.attained <= least + SAME * abs(least)
        bounded = (
            f"cost_periodic {least:.6g} is a lower bound by the mean load, which periodic control may not attain: "
            "sends of loops with different intervals meet in some steps; the best periodic schedule found costs "
            f"{game.attained:.6g} (cost_periodic_attained)"
        )
        return Sharing(
            scheduler=scheduler,
            capacity=capacity,
            unit=cost_unit(next(iter(problems.values()))),
            shares=tuple(shares),
            cost=mean(measured.costs.sum(axis=1)).scaled(1.0, base),
            cost_all_time=base,
            lower_bound=bound,
            load=load,
            busy=mean(measured.busy),
            waiting=None if plan.price is None else mean(measured.waiting),
            load_expected=plan.load,
            price=plan.price,
            cost_periodic=least,
            cost_periodic_same_load=base + float(game.counts @ periodic.costs),
            cost_periodic_attained=game.attained,
            ticks=measured.ticks,
            reached=measured.reached,
            seed=seed,
            seconds=time.perf_counter() - began,
            price_seconds=prepared,
            notes=plan.notes + (() if known else (bounded,)),
        )
