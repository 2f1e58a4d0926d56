"""What loops send at a price, tabulated price by price; the price that loads a channel, and what none can beat."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, symmetrised
from taciturn._modes import stationary
from taciturn._progress import Progress
from taciturn.analyse.limits import USUAL
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.trigger import Bell, Form
from taciturn.renewal.chain import NoQuadratureError
from taciturn.renewal.rare import bound_rare_sends
from taciturn.simulation.channel import ERROR, Group, measure_freely
from taciturn.simulation.statistics import rate_of
from taciturn.study.kinds import Kind
from taciturn.study.workers import answer_all, idle

if TYPE_CHECKING:
    from taciturn.renewal.dual import Sampled
    from taciturn.renewal.fitted import Fitted

PER_OCTAVE = 2  # prices of a table
USUAL_SLOPE = 0.25  # octaves that a load falls by from one price of a table to the next, about
FARTHEST = 8  # prices of a table that a step of a search passes
FEW, MORE = 300, 600  # errors that the schedules of a table are fitted to, and those that are played
LOOPS, FEWEST = 4096, 256  # that a rate is measured on
MEASURED = 1 << 20  # looks of all of them
SETTLE = 8  # mean intervals between sends that are dropped first, and that are measured
SHORTEST, LONGEST = 64, 16_384  # looks that are measured
CLOCK = 4.0  # times the price of triggers, about, is that of clocks: 3 of a random walk, 5 of two masses
FACTORS = (1.0, 1.5, 2.2, 3.3, 5.0, 7.5)  # of the price: thresholds that are tried
OFF = 0.1  # relative, by which a fit's gain and what is measured may differ
HALVINGS = 8  # of a price at which there is no bound
CHEAPEST = 1e-9  # of the price from where a search begins: next to nothing
RAREST = 1 / LONGEST  # sends per look: what sends less often never sends
QUADRATURE = 2  # states up to which a bound by quadrature takes less time than one by draws
ACCURATE = 1e-3  # relative, of a bound by quadrature, from which its error is taken
PRECISE = 1e-3  # of the least cost of all loops, sends at their price included: what the confidence should cost
CLOSE = 5e-4  # relative: bounds that are so near to what can be had need not be better
MOST_KNOWN = 4096  # answers that a process remembers
ALWAYS = Form(constant=1.0)
Answer = TypeVar("Answer")
_KNOWN: dict[tuple[object, Hashable], Any] = {}


@dataclass(frozen=True, eq=False)
class Schedule:
    """Nearly the best schedule of a kind's errors at a price.

    Args:
        price: of a send, in the units of the cost times ticks.
        urgency: over the error: what silence costs more than a send.
        rate: sends per look.
    """

    price: float
    urgency: Form
    rate: Estimate


@dataclass(frozen=True, eq=False)
class Settled:
    """What is known of a kind at a price.

    Args:
        schedule: nearly the best.
        least: what bounds the mean cost of a look from below, sends at their price included: a number, or what draws
            tell of one; None where no bound was asked for.
    """

    schedule: Schedule
    least: float | Sampled | None


@dataclass(frozen=True, eq=False)
class Job:
    """A kind that is worked on.

    Args:
        kind: of loops.
        price: of a send.
        seed: of the draws.
        confidence: of a bound of the sum over kinds; 0: none.
        precise: what the confidence should cost the bound of a look.
    """

    kind: Kind
    price: float
    seed: int
    confidence: float = 0.0
    precise: float = 0.0

    @property
    def key(self) -> Hashable:
        """All that an answer depends on."""
        return _numbers(self.kind), self.price, self.seed, self.confidence, self.precise


@dataclass(frozen=True)
class DualBound:
    """No scheduler of some loops costs less.

    Args:
        cost: summed over all loops, in the units of the cost.
        confidence: with which that holds; None where all of it is by quadrature.
    """

    cost: float
    confidence: float | None


class Curves:
    """Rates of the nearly best schedules of some kinds over the price of a send, tabulated at the prices asked about.

    Prices of the table are half an octave apart; in between log rate is linear in log price, as a power law is. Kinds
    of equal numbers are one. What is found of a kind depends on its numbers and the seed, not on the others, and draws
    of different kinds are independent.

    Args:
        kinds: of loops.
        seed: of the draws.
        executor: works on the kinds; None: here, one after the other.
        progress: called with a fraction that grows to 1 with the prices.
    """

    def __init__(
        self,
        kinds: Sequence[Kind],
        seed: int = 0,
        executor: Executor | None = None,
        progress: Progress = idle,
    ) -> None:
        """Tabulate nothing yet."""
        self.kinds, self._seed, self._executor, self._progress, self._rounds = kinds, seed, executor, progress, 0
        places: dict[bytes, int] = {}
        self._which = np.array([places.setdefault(_numbers(kind), len(places)) for kind in kinds])
        first = dict(zip(self._which[::-1].tolist(), kinds[::-1], strict=True))
        self._different = [first[place] for place in range(len(places))]
        self._looks = np.array([kind.looks for kind in kinds])
        self.table: dict[int, Array] = {}

    def rates(self, price: float) -> Array:
        """Return the sends per look of each kind at a price."""
        place = PER_OCTAVE * np.log2(price)
        below = int(np.floor(place))
        share = float(place - below)
        low = self._at(below)
        high = self._at(below + 1) if share else low
        power = np.power(low, 1 - share) * np.power(high, share)
        return np.where(np.minimum(low, high) > 0, power, (1 - share) * low + share * high)[self._which]

    def load(self, price: float) -> float:
        """Return the sends per tick of all loops at a price, if none has to wait."""
        return float(self._looks @ self.rates(price))

    def settle(self, price: float, confidence: float = 0.0) -> list[Settled]:
        """Return each kind's schedule at a price; with a confidence, its bound.

        Args:
            price: of a send.
            confidence: of a bound of the sum; 0: none.
        """
        found = self._ask(_settle, price, confidence, self._precise(price) if confidence else 0.0)
        return [found[which] for which in self._which]

    def price_of(self, capacity: float, guess: float) -> float:
        """Return the common price per send at which the loops load the channel as much as asked; 0 if they never do.

        Args:
            capacity: sends per tick.
            guess: price from where the search begins.
        """
        if sum(kind.looks for kind in self.kinds if kind.clocked.forever) <= capacity:
            return 0.0
        place = round(PER_OCTAVE * float(np.log2(guess)))
        loads: dict[int, float] = {}
        while True:
            loads[place] = self.load(2.0 ** (place / PER_OCTAVE))
            low = max((k for k, load in loads.items() if load > capacity), default=None)
            high = min((k for k, load in loads.items() if load <= capacity), default=None)
            if low is not None and high is not None:
                if high - low <= 1:
                    break
                share = np.log(loads[low] / capacity) / np.log(loads[low] / max(loads[high], RAREST * capacity))
                place = int(np.clip(round(low + share * (high - low)), low + 1, high - 1))
                continue
            off = np.log2(max(loads[place], RAREST * capacity) / capacity) / USUAL_SLOPE
            place += int(np.clip(round(off), 1, FARTHEST) if low is not None else np.clip(round(off), -FARTHEST, -1))
            if 2.0 ** (place / PER_OCTAVE) < CHEAPEST * guess:  # whoever gains by a send makes it
                return CHEAPEST * guess
        crossing = _scipy.crossing(lambda k: self.load(2.0 ** (k / PER_OCTAVE)) - capacity, low, high)
        return float(2.0 ** (crossing / PER_OCTAVE))

    def bound(self, settled: Sequence[Settled], capacity: float, price: float, confidence: float = USUAL) -> DualBound:
        """Return what no scheduler of these loops can cost less than, whatever it knows, with so many sends per tick.

        The dual function at a price λ per send: with g_i the least mean of e'Γe + λσ over the looks of a loop alone,
        one look in m_i ticks,

            Σ J_i ≥ Σ (J_all,i + g_i(λ)/m_i) − λ·capacity.

        Of what is sampled only the sum needs the confidence.

        Args:
            settled: what is known of each kind at the price, bounds included.
            capacity: sends per tick.
            price: λ; the bound holds for any, and is best where the load meets the capacity.
            confidence: with which it holds, where some of it is sampled.

        Source: everett1963, brown2010
        """
        from taciturn.renewal.dual import Sampled, bound_sum

        base = sum(kind.count * kind.cost_all_time for kind in self.kinds)
        if not price:
            return DualBound(base, None)
        looks = np.bincount(self._which, self._looks).tolist()
        first = [settled[int(np.argmax(self._which == place))].least for place in range(len(looks))]
        assert None not in first, "no bounds were asked for"
        known = sum(look * least for look, least in zip(looks, first, strict=True) if isinstance(least, float))
        terms = [(look, least) for look, least in zip(looks, first, strict=True) if isinstance(least, Sampled)]
        gains = float(known + bound_sum(terms, confidence))
        return DualBound(max(base + gains - price * capacity, base), confidence if terms else None)

    def _at(self, place: int) -> Array:
        if place not in self.table:
            self.table[place] = np.array(self._ask(_rate, 2.0 ** (place / PER_OCTAVE)))
        return self.table[place]

    def _ask(
        self, question: Callable[[Job], Answer], price: float, confidence: float = 0.0, precise: float = 0.0
    ) -> list[Answer]:
        """Return the answers for all different kinds; those that this process knows already are not computed again."""
        jobs = [
            Job(kind, price, _seed_of(kind, self._seed), confidence, precise / float(looks))
            for kind, looks in zip(self._different, np.bincount(self._which, self._looks), strict=True)
        ]
        keys: list[tuple[object, Hashable]] = [(question, job.key) for job in jobs]
        found: dict[tuple[object, Hashable], Any] = {key: _KNOWN[key] for key in keys if key in _KNOWN}
        missing = {key: job for key, job in zip(keys, jobs, strict=True) if key not in found}
        found |= zip(missing, answer_all(self._executor, question, list(missing.values()), self._came), strict=True)
        _KNOWN.update(found)
        for oldest in list(_KNOWN)[: max(len(_KNOWN) - MOST_KNOWN, 0)]:
            _KNOWN.pop(oldest, None)
        self._rounds += 1
        return [found[key] for key in keys]

    def _precise(self, price: float) -> float:
        """Return what the confidence may cost each kind, so that independent ones together cost as little as asked."""
        clocks = [look * clock_cost(kind, price) for look, kind in zip(self._looks, self.kinds, strict=True)]
        return PRECISE * float(np.sum(clocks)) / len(self._different) ** 0.5

    def _came(self, fraction: float) -> None:
        self._progress(1 - 0.5 ** (self._rounds + fraction))


def _numbers(kind: Kind) -> bytes:
    """Return what all that is computed here of a kind depends on."""
    return b"".join(np.ascontiguousarray(part + 0.0).tobytes() for part in (kind.F, kind.noise, kind.Gamma))


def _seed_of(kind: Kind, seed: int) -> int:
    """Return the seed of a kind's draws."""
    return int.from_bytes(hashlib.blake2b(_numbers(kind), digest_size=6, key=str(seed).encode()[:64]).digest())


def _rate(job: Job) -> float:
    """Return the sends per look of a kind at a price."""
    fitted = _fit(job.kind, job.price, job.seed, FEW)
    return _schedule(job.kind, job.price, fitted, job.seed).rate.value


def _settle(job: Job) -> Settled:
    """Return what is known of a kind at a price."""
    fitted = _fit(job.kind, job.price, job.seed, MORE)
    least = _least_gain(job, fitted) if job.confidence else None
    return Settled(_schedule(job.kind, job.price, fitted, job.seed), least)


def _fit(kind: Kind, price: float, seed: int, points: int) -> Fitted | None:
    """Return a schedule that is fitted at a price, or None where there is hardly a send or nothing to fit."""
    from taciturn.renewal.fitted import fit_schedule  # statistics, that take a while to import

    error = kind.F, kind.noise, kind.Gamma
    if kind.clocked.forever == 0 or bound_rare_sends(*error, price).rate < RAREST:
        return None
    try:
        return fit_schedule(*error, price, seed, points)
    except ProblemError:  # sends are too rare for a fit
        return None


def _schedule(kind: Kind, price: float, fitted: Fitted | None, seed: int) -> Schedule:
    """Return nearly the best schedule of a kind at a price: the one that is fitted, or thresholds that are better."""
    if kind.clocked.forever == 0:  # silence costs nothing
        return Schedule(price, Form(constant=-price), Estimate(0.0, 0.0, "exact"))
    if fitted is None:
        if bound_rare_sends(kind.F, kind.noise, kind.Gamma, price).rate < RAREST:
            return Schedule(price, _saving(kind, np.inf, price), Estimate(0.0, 0.0, "bound"))
        return _threshold(kind, price, seed)
    urgency = Form((ERROR,), kind.Gamma, -fitted.gain, bell=Bell(-fitted.height, fitted.Pi))
    rate, excess = measure_alone(kind, urgency, 1 / fitted.interval, seed)
    gain, found = excess + price * rate.value, Schedule(price, urgency, rate)
    if abs(gain - fitted.gain) <= OFF * fitted.gain:
        return found
    return _threshold(kind, price, seed, found, gain)  # it has not converged


def _threshold(kind: Kind, price: float, seed: int, best: Schedule | None = None, least: float = np.inf) -> Schedule:
    """Return the best threshold on what silence costs at once, or until a clock sends, if no other is better."""
    interval = kind.clocked.interval(CLOCK * price)

    def measured(looks: float, factor: float) -> tuple[Schedule, float]:
        urgency = _saving(kind, looks, factor * price)
        rate, excess = measure_alone(kind, urgency, 1 / interval, seed)
        return Schedule(price, urgency, rate), excess + price * rate.value

    for looks in {1.0, interval}:
        gains = [measured(looks, factor)[1] for factor in FACTORS]
        found, gain = measured(looks, float(np.exp(_lowest(np.log(FACTORS), np.array(gains)))))
        if gain < least:
            best, least = found, gain
    assert best is not None
    return best


def _lowest(places: Array, values: Array) -> float:
    """Return where the parabola through the least of some values and its neighbours is lowest: it moves smoothly."""
    at = int(np.clip(np.argmin(values), 1, len(values) - 2))
    near = places[at - 1 : at + 2]
    off = near - places[at]
    bend, slope, _ = np.linalg.solve(np.stack([off * off, off, np.ones(3)], axis=1), values[at - 1 : at + 2])
    lowest = places[at] - slope / (2 * bend) if bend > 0 else places[np.argmin(values)]
    return float(np.clip(lowest, near[0], near[-1]))


def clock_cost(kind: Kind, price: float) -> float:
    """Return what the best clock costs per look, sends at their price included: the least mean is no more."""
    interval = kind.clocked.interval(price)
    return kind.clocked.cost(1 / interval) + price / interval


def _saving(kind: Kind, interval: float, price: float) -> Form:
    """Return e'Se − price, S = Σ F'ʲΓFʲ over the looks of an interval."""
    F, S = kind.F, kind.Gamma
    if np.isinf(interval):
        S = stationary(F.T, S)
    for _ in range(0 if np.isinf(interval) else int(interval) - 1):
        S = F.T @ S @ F + kind.Gamma
    return Form((ERROR,), symmetrised(S), -price)


def measure_alone(kind: Kind, urgency: Form, about: float, seed: int) -> tuple[Estimate, float]:
    """Return sends and cost per look of loops that send whenever they want to, about so often."""
    looks = int(np.clip(SETTLE / max(about, RAREST), SHORTEST, LONGEST))
    while True:
        loops = int(np.clip(MEASURED // looks, FEWEST, LOOPS))
        sends, costs = measure_freely(Group(kind.F, kind.noise, kind.Gamma, urgency, loops), looks, seed)
        rate = rate_of(sends, loops * looks)
        if looks * rate.value >= SETTLE / 2 or looks == LONGEST:
            return rate, float(costs.mean())
        looks = min(4 * looks, LONGEST)


def _least_gain(job: Job, fitted: Fitted | None) -> float | Sampled:
    """Return what bounds the least mean cost of a look at a price from below."""
    from taciturn.renewal.dual import sample_dual
    from taciturn.renewal.fitted import fit_schedule
    from taciturn.renewal.optimal import solve_optimal

    kind, price = job.kind, job.price
    error = kind.F, kind.noise, kind.Gamma
    rare = bound_rare_sends(*error, price)
    if rare.gain >= (1 - CLOSE) * clock_cost(kind, price):
        return rare.gain
    for _ in range(HALVINGS):
        try:
            if len(kind.F) <= QUADRATURE:
                exact = solve_optimal(*error, price, ACCURATE)
                return max(exact.cost - exact.cost_error, rare.gain)
        except NoQuadratureError:
            pass
        try:
            fitted = fitted or fit_schedule(*error, price, job.seed, MORE)
            return sample_dual(*error, price, fitted, job.confidence, [job.seed, 1], job.precise)
        except ProblemError:
            price, fitted = price / 2, None  # hardly anything is sent at it; the least mean grows with the price
    return rare.gain
