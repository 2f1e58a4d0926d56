"""Schedulers of a channel: trigger rules, access rules, and the simulation that estimates their cost.

A scheduler has an urgency, a function of the error of each kind of loops, and an access rule, which decides what loops
send (``Plan``). ``Game`` has the references for all of them: the best periodic allocation, and the common price per
send at which the expected load equals the capacity, with its lower bound.

The best periodic allocation is a bound that no schedule may attain. Best schedules found are slots of its own for each
kind, and a stretch of time division, repeated for ever (``best_stretch``). Between two sends, k checks apart, a loop
costs S(k) (``classes.Clocked``), and the times at which time division sends depend on no error. So each stretch of T
steps of it is a periodic schedule, whose cost is the sum of S over the intervals of all loops, divided by T. The
interval around the end of the stretch, from the last send to the first one of the next repetition, is one of them.

``measure`` simulates several channels side by side until the sum of costs has the requested standard error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from math import ceil, lcm

import numpy as np

from taciturn.errors import UnstableError
from taciturn.extend import Array, Displayed, Progress, check_time
from taciturn.model.estimate import Estimate
from taciturn.model.trigger import Form
from taciturn.simulation.statistics import mean
from taciturn_channel.classes import Allocation, Kind, LoopClass, allocate, allocate_slots
from taciturn_channel.prices import ALWAYS, CLOCK, Curves, DualBound, Settled
from taciturn_channel.simulated import (
    RULE_ERROR,
    Access,
    Group,
    MostUrgent,
    Places,
    RandomAccess,
    RoundRobin,
    SharedChannel,
    Stretch,
    TimeDivision,
)
from taciturn_studies.workers import idle

INTERVALS = 24  # longest stretch, in the longest mean intervals between sends
SHORTEST, LONGEST = 256, 16_384  # steps of the longest stretch, if the checks of all loops repeat within them
WORK = 50_000_000  # most steps of all loops together


def best_stretch(sharers: Sequence[LoopClass], access: Access, rates: Array, cycle: int) -> float:
    """Return the least cost per step of any part of a schedule that can repeat periodically; infinity if none can."""
    classes, phases, every = _places(sharers)
    loops = len(classes)
    longest = 1 / rates[rates > 0].min() if (rates > 0).any() else 0.0
    steps = int(np.clip(INTERVALS * longest, SHORTEST, min(LONGEST, WORK // loops)))
    steps = -(-steps // cycle) * cycle
    start = -(-int(min(2 * longest, steps)) // cycle) * cycle
    first, last, total = np.full(loops, -1), np.full(loops, -1), np.zeros(loops)
    never = np.array([sharer.error.forever / sharer.every for sharer in sharers])[classes]
    active = [np.flatnonzero(tick % every == phases) for tick in range(cycle)]
    silent, best = {cycle_place: np.zeros((1, len(at))) for cycle_place, at in enumerate(active)}, np.inf

    def between(places: Places, steps: Places) -> Array:
        """Return the cost S(k) of the k checks between two sends, for each of the given loops."""
        found = np.zeros(len(places))
        for number, sharer in enumerate(sharers):
            here = classes[places] == number
            found[here] = sharer.error.sums(steps[here] // sharer.every)
        return found

    for tick in range(start + steps):
        check_time()
        at = active[tick % cycle]
        if len(at):
            sent = at[access.grant(tick, at, silent[tick % cycle]).sent[0]]
            if tick >= start:
                again = sent[first[sent] >= 0]
                total[again] += between(again, tick - last[again])
                new = sent[first[sent] < 0]
                first[new] = tick
                last[sent] = tick
        passed = tick + 1 - start
        if passed > 0 and passed % cycle == 0 and passed > steps // 2:
            known = np.flatnonzero(first >= 0)
            costs = never.copy()
            costs[known] = (total[known] + between(known, first[known] + passed - last[known])) / passed
            best = min(best, float(costs.sum()))
    return best


def _places(sharers: Sequence[LoopClass]) -> tuple[Places, Places, Places]:
    """Return the class of each loop, and the phase and the interval of its checks, as ``SharedChannel`` orders them."""
    classes, phases, every = list[int](), list[int](), list[int]()
    for number, sharer in enumerate(sharers):
        for phase in range(min(sharer.every, sharer.count)):
            many = len(range(phase, sharer.count, sharer.every))
            classes += [number] * many
            phases += [phase] * many
            every += [sharer.every] * many
    return np.array(classes), np.array(phases), np.array(every)


PATHS = 16_384  # loops that are simulated side by side; if the channel has fewer, several channels are simulated
CHANNELS = 32  # largest number of channels
BURN_IN = 20  # length of the burn-in and of a stretch, in mean intervals between sends
SETTLE = 12  # length of the burn-in for errors that decay without a send, in time constants
SHORTEST_STRETCH = 64  # least steps of a stretch
STRETCHES = 32  # least number of stretches, over all channels
BUDGET = 20_000_000_000  # checks of all loops together
RELATIVE_ERROR = 1e-3  # default standard error, relative to the cost
DIGITS = 12  # of a rate that rounding leaves
LOST = 1e6  # a loop that costs more than this multiple of the cost of every sample is not stabilised
LOADS = (1.6, 0.15)  # range of loads for the price of random access, relative to the largest throughput
TRIALS = 9  # largest number of prices that are tried for random access
PREPARED = 0.6  # approximate share of the progress before loops are simulated
RISES = 3  # consecutive increases of the cost that end these trials


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Displayed):
    """A scheduler: the urgency of a send as a function of each loop's error, and the access rule of the channel."""

    urgencies: Sequence[Form]
    access: Callable[[], Access]
    load: Estimate | None = None
    price: float | None = None
    notes: tuple[str, ...] = ()


class Game:
    """Loops on a channel of given capacity, with two costs for comparison: the best periodic one and a lower bound."""

    def __init__(
        self,
        kinds: Sequence[Kind],
        capacity: int,
        seed: int,
        confidence: float = 0.0,
        executor: Executor | None = None,
        progress: Progress = idle,
    ) -> None:
        """Find the best periodic allocation."""
        self.kinds, self.capacity, self.seed, self.confidence = kinds, capacity, seed, confidence
        self.progress = progress
        self.counts = np.array([kind.count for kind in kinds], dtype=np.float64)
        self.looks = np.array([kind.looks for kind in kinds])
        self.loops = int(self.counts.sum())
        self.cost_all_time = float(self.counts @ [kind.cost_all_time for kind in kinds])
        self.cycle = lcm(*(kind.every for kind in kinds))
        self.sharers = [LoopClass(kind.clocked, kind.count, kind.every) for kind in kinds]
        self.clocked: Allocation = allocate(self.sharers, capacity)
        self.refuse_starved(self.clocked)
        self.curves = Curves(kinds, seed, executor, lambda fraction: progress(PREPARED * fraction))

    @cached_property
    def price(self) -> float:
        """Common price per send at which the expected load equals the capacity of the channel."""
        return self.curves.price_of(self.capacity, self.clocked.price / CLOCK or 1.0)

    @cached_property
    def settled(self) -> list[Settled]:
        """Schedule and lower bound on the cost of each kind of loops, at the common price per send."""
        return self.curves.settle(self.price, self.confidence) if self.price else []

    @property
    def bound(self) -> DualBound | None:
        """Lower bound on the total cost under every scheduler; None if no confidence was requested."""
        if not self.confidence:
            return None
        return self.curves.bound(self.settled, self.capacity, self.price, self.confidence)

    def refuse_starved(self, best: Allocation) -> None:
        """Raise an error if even the best periodic control cannot stabilise all loops at this capacity."""
        every = np.array([kind.every for kind in self.kinds])
        self.refuse_lost(every * best.costs, best.rates)

    def priced(self, price: float) -> tuple[list[Form], Estimate]:
        """Return each kind's urgency function at a price per send, and the expected load if no loop waits."""
        if not price:  # every loop that gains anything from a send requests it
            load = sum(kind.looks for kind in self.kinds if kind.clocked.forever)
            return [Form((RULE_ERROR,), kind.Gamma) for kind in self.kinds], Estimate(load, 0.0, "exact")
        settled = self.settled if price == self.price else self.curves.settle(price)
        found = [one.schedule for one in settled]
        loads = [one.rate.scaled(kind.looks) for one, kind in zip(found, self.kinds, strict=True)]
        spread = float(np.sqrt(sum(load.standard_error**2 for load in loads)))
        load = Estimate(sum(load.value for load in loads), spread, "simulation")
        return [one.urgency for one in found], load

    @cached_property
    def attained(self) -> float:
        """Cost per step of the best periodic schedule that the search has found; infinity if it has found none.

        The schedules that are compared are separate slots for each kind of loops, and repeated stretches of time
        division.
        """
        apart = allocate_slots(self.sharers, self.capacity)
        if apart <= float(self.counts @ self.clocked.costs):  # no schedule costs less
            return self.cost_all_time + apart
        rates = self.clocked.rates / [kind.every for kind in self.kinds]
        return self.cost_all_time + min(apart, best_stretch(self.sharers, time_division(self), rates, self.cycle))

    def play(self, plan: Plan, channels: int) -> SharedChannel:
        """Create the channels on which a scheduler is simulated; each simulation begins with errors that are 0."""
        groups = [
            Group(kind.F, kind.noise, kind.Gamma, urgency, kind.count, kind.every)
            for kind, urgency in zip(self.kinds, plan.urgencies, strict=True)
        ]
        return SharedChannel(groups, plan.access(), channels, self.seed)

    @property
    def channels(self) -> int:
        """Number of independent channels that are simulated in parallel."""
        return int(np.clip(PATHS // self.loops, 1, CHANNELS))

    @property
    def burn_in(self) -> int:
        """Number of initial steps that are discarded, because the simulated errors start at 0."""
        longest = SHORTEST_STRETCH
        for kind, rate in zip(self.kinds, self.clocked.rates.tolist(), strict=True):
            sends = BURN_IN / rate if rate else np.inf
            decays = SETTLE / (1 - kind.clocked.growth) if kind.clocked.growth < 1 else np.inf
            if np.isfinite(forgets := min(sends, decays)):  # else no noise acts on the error
                longest = max(longest, ceil(kind.every * forgets))
        return -(-longest // self.cycle) * self.cycle

    def refuse_uncontrolled(self, stretch: Stretch) -> None:
        """Raise an error if some loops stayed unstable under the simulated scheduler."""
        self.refuse_lost(stretch.cost.mean(axis=0) / self.looks, stretch.sends.mean(axis=0) / self.looks)

    def refuse_lost(self, cost: Array, rates: Array) -> None:
        """Raise an error if unstable loops send too rarely to be stable."""
        for kind, each, rate in zip(self.kinds, cost.tolist(), rates.tolist(), strict=True):
            limit = LOST * max(kind.every * kind.cost_all_time, float(np.sum(kind.Gamma * kind.noise)))
            if kind.clocked.growth >= 1 and not each <= limit:
                raise UnstableError(
                    f"the loops of {kind.name} are unstable: an error grows by {kind.clocked.growth:.4g} per check, "
                    f"but each loop sends only {rate:.3g} times per check, so it costs over {LOST:.0e} times as much "
                    f"as with a send at every check; expected at least {kind.clocked.least_rate(limit):.3g} sends per "
                    "check for periodic control, and more for random sends: raise capacity, or reduce the number of "
                    "loops"
                )


def _price(game: Game) -> Plan:
    urgencies, load = game.priced(game.price)
    return Plan(urgencies, lambda: MostUrgent(game.capacity), load, game.price)


def _largest(game: Game) -> Plan:
    return Plan([Form((RULE_ERROR,), kind.Gamma) for kind in game.kinds], lambda: MostUrgent(game.capacity))


def _once_discard(game: Game) -> Plan:
    return Plan([Form((RULE_ERROR,), kind.L.T @ kind.L) for kind in game.kinds], lambda: MostUrgent(game.capacity))


def _round_robin(game: Game) -> Plan:
    return Plan([ALWAYS] * len(game.kinds), lambda: RoundRobin(game.capacity, game.loops))


def time_division(game: Game) -> TimeDivision:
    """Return the access rule in which each loop sends periodically, at its rate in the best periodic allocation."""
    kinds = game.kinds
    rates = np.concatenate(
        [np.full(kind.count, rate / kind.every) for kind, rate in zip(kinds, game.clocked.rates, strict=True)]
    )
    phases = np.empty(len(rates))
    _, groups = np.unique(np.round(rates, DIGITS), return_inverse=True)
    for group in range(groups.max() + 1):  # loops with the same rate take turns, whether they are copies or not
        loops = np.flatnonzero(groups == group)
        phases[loops] = (np.arange(len(loops)) + 0.5) / len(loops)
    return TimeDivision(game.capacity, rates, phases)


def _tdma(game: Game) -> Plan:
    return Plan([ALWAYS] * len(game.kinds), lambda: time_division(game))


def _random_access(game: Game) -> Plan:
    """Try prices for which the load without collisions is a given share of the largest throughput of ALOHA."""
    game.refuse_starved(allocate(game.sharers, game.capacity / np.e))
    tried: list[tuple[float, Plan, float]] = []
    price = game.price
    for share in np.geomspace(*LOADS, TRIALS).tolist():
        price = game.curves.price_of(share * game.capacity / np.e, price or 1.0)
        urgencies, load = game.priced(price)
        plan = Plan(urgencies, lambda: RandomAccess(game.capacity, game.seed), load, price)
        channel = game.play(plan, game.channels)
        channel.run(game.burn_in)
        cost = float(channel.run(game.burn_in).cost.sum(axis=1).mean())
        tried.append((cost if np.isfinite(cost) else np.inf, plan, share))
        latest = [one[0] for one in tried[-RISES:]]
        if len(latest) == RISES and latest == sorted(latest):
            break
    best = min(tried, key=lambda one: one[0])
    note = f"the price is the best of {len(tried)} tried; its load is {best[2]:.2g} times the largest ALOHA throughput"
    return Plan(best[1].urgencies, best[1].access, best[1].load, best[1].price, (note,))


SCHEDULERS: Mapping[str, Callable[[Game], Plan]] = {
    "price": _price,
    "largest": _largest,
    "round-robin": _round_robin,
    "tdma": _tdma,
    "once-discard": _once_discard,
    "random-access": _random_access,
}


@dataclass(frozen=True, eq=False, repr=False)
class Measured(Displayed):
    """Simulated results of a scheduler: extra cost and sends of each kind of loops, channel use, and waiting loops."""

    costs: Array
    sends: Array
    busy: Array
    waiting: Array
    ticks: int
    reached: bool


def measure(game: Game, plan: Plan, standard_error: float | None, steps: int | None) -> Measured:
    """Simulate several independent channels until the total cost has the requested standard error."""
    channels, channel, kept = game.channels, game.play(plan, game.channels), list[Stretch]()
    length = game.burn_in if steps is None else min(game.burn_in, -(-steps // 2 // game.cycle) * game.cycle)
    game.refuse_uncontrolled(channel.run(game.burn_in))
    while True:
        kept.append(channel.run(length))
        game.refuse_uncontrolled(kept[-1])
        measured, known = len(kept) * length, len(kept) * channels >= (2 if steps else STRETCHES)
        if not known:
            continue
        total = mean(np.concatenate([one.cost.sum(axis=1) for one in kept]))
        target = standard_error or RELATIVE_ERROR * (total.value + game.cost_all_time)
        reached = measured >= steps if steps else total.standard_error <= target
        done = measured / steps if steps else (target / (total.standard_error or target)) ** 2
        game.progress(PREPARED + (1 - PREPARED) * min(1.0, done))
        if reached or measured * channels * game.loops > BUDGET:
            return Measured(
                np.concatenate([one.cost for one in kept]),
                np.concatenate([one.sends for one in kept]),
                np.concatenate([one.busy for one in kept]),
                np.concatenate([one.waiting for one in kept]),
                measured * channels,
                reached,
            )
