"""Send rates of loops for a price per send, the price at which they meet a given load, and a lower bound on the cost.

At a price λ per send, each loop alone has a nearly optimal schedule: that of a fitted value function
(``taciturn_limits.fitted``), or the best threshold if sends are too rare for a fit. Its rate is simulated. The load of
all loops falls with the price, and the common price is that at which it equals the capacity.

A lower bound on the cost of any scheduler, even with full information, is the dual function at any price. Let g_i be
the least mean of e'Γe + λσ over the checks of a loop alone, where σ is 1 at a send, with one check in m_i steps. Then

    Σ J_i ≥ Σ (J_all,i + g_i(λ)/m_i) − λ·capacity.

The g_i are bounded from below by quadrature in one or two dimensions, by sampling (``taciturn_limits.dual``) in more,
or by the tail of the error if sends are rare. The confidence applies only to the sum of the sampled bounds.

Prices of the table are half an octave apart; in between, log rate is interpolated linearly in log price. Kinds with
equal matrices are computed once. The estimates of a kind depend only on its matrices and the seed, and the draws of
different kinds are independent.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, Displayed, Progress, crossing, symmetrised
from taciturn.lqg.equation import stationary
from taciturn.model.estimate import Estimate
from taciturn.model.theory import LEVEL
from taciturn.model.trigger import Form, GaussianTerm
from taciturn.renewal.chain import NoQuadratureError
from taciturn.simulation.statistics import rate_of
from taciturn_channel.classes import Kind
from taciturn_channel.simulated import RULE_ERROR, Group, measure_freely
from taciturn_limits.fitted import bound_rare_sends
from taciturn_studies.workers import answer_all, idle

if TYPE_CHECKING:
    from taciturn_limits.dual import SampledDual
    from taciturn_limits.fitted import Fitted

PER_OCTAVE = 2  # prices of the table per octave
USUAL_SLOPE = 0.25  # approximate decrease of the load between neighbouring prices of the table, in octaves
FARTHEST = 8  # largest step of a search, in prices of the table
FEW, MORE = 300, 600  # errors to which schedules are fitted: for the table, and for simulation
LOOPS, FEWEST = 4096, 256  # most and fewest loops on which a rate is measured
MEASURED = 1 << 20  # checks of all these loops together
SETTLE = 8  # mean intervals between sends that are dropped first, and that are measured
SHORTEST, LONGEST = 64, 16_384  # least and most checks that are measured
CLOCK = 4.0  # approximate price of periodic control over that of triggers: 3 for a random walk, 5 for two masses
FACTORS = (1.0, 1.5, 2.2, 3.3, 5.0, 7.5)  # thresholds that are tried, relative to the price
OFF = 0.1  # largest relative difference between the gain of a fit and the measured gain
HALVINGS = 8  # times that a price without a bound is halved
CHEAPEST = 1e-9  # least price of a search, relative to the start
RAREST = 1 / LONGEST  # sends per check below which a loop counts as silent
QUADRATURE = 2  # largest number of states for which a bound by quadrature is faster than one by sampling
ACCURATE = 1e-3  # relative accuracy of a bound by quadrature, before its error is subtracted
PRECISE = 1e-3  # target loss of the bound due to the confidence, relative to the least cost including sends
CLOSE = 5e-4  # relative distance to an attainable cost below which a bound is not improved
MOST_KNOWN = 4096  # largest number of cached answers
ALWAYS = Form(constant=1.0)
Answer = TypeVar("Answer")
_KNOWN: dict[tuple[object, Hashable], Any] = {}


@dataclass(frozen=True, eq=False, repr=False)
class Schedule(Displayed):
    """A nearly optimal send schedule for identical loops, at a given price per send."""

    price: float  # price per send, in the units of the cost times steps
    urgency: Form  # cost of silence minus cost of a send, as a function of the error
    rate: Estimate  # sends per check


@dataclass(frozen=True, eq=False, repr=False)
class Settled(Displayed):
    """A nearly optimal send schedule and a lower bound on the cost for identical loops, at a given price per send."""

    schedule: Schedule  # a nearly optimal schedule
    # lower bound on the mean cost of a check, including the price of sends: a number, or a sampled bound; None if no
    # bound was requested
    least: float | SampledDual | None


@dataclass(frozen=True, eq=False, repr=False)
class Job(Displayed):
    """Data for computing the send schedule of identical loops at a given price per send."""

    kind: Kind  # kind of loops
    price: float  # price per send
    seed: int  # seed of the random draws
    confidence: float = 0.0  # confidence of the bound on the sum over kinds; 0 for no bound
    precise: float = 0.0  # target loss of the bound per check that is due to the confidence

    @property
    def key(self) -> Hashable:
        """Key under which the cache stores the result of this computation: all data on which the result depends."""
        return _numbers(self.kind), self.price, self.seed, self.confidence, self.precise


@dataclass(frozen=True, repr=False)
class DualBound(Displayed):
    """Lower bound on the total cost of a set of loops, valid for every possible scheduler."""

    cost: float  # sum over all loops, in the units of the cost
    confidence: float | None  # confidence of the bound, or None if it is computed entirely by quadrature


class Curves:
    """Send rates of several kinds of loops for a price per send, if each loop follows its nearly optimal schedule."""

    def __init__(
        self,
        kinds: Sequence[Kind],
        seed: int = 0,
        executor: Executor | None = None,
        progress: Progress = idle,
    ) -> None:
        """Prepare an empty table."""
        self.kinds, self._seed, self._executor, self._progress, self._rounds = kinds, seed, executor, progress, 0
        places: dict[bytes, int] = {}
        self._which = np.array([places.setdefault(_numbers(kind), len(places)) for kind in kinds])
        first = dict(zip(self._which[::-1].tolist(), kinds[::-1], strict=True))
        self._different = [first[place] for place in range(len(places))]
        self._looks = np.array([kind.looks for kind in kinds])
        self.table: dict[int, Array] = {}

    def rates(self, price: float) -> Array:
        """Return the number of sends per check for each kind of loops, at a given price per send."""
        place = PER_OCTAVE * np.log2(price)
        below = int(np.floor(place))
        share = float(place - below)
        low = self._at(below)
        high = self._at(below + 1) if share else low
        power = np.power(low, 1 - share) * np.power(high, share)
        return np.where(np.minimum(low, high) > 0, power, (1 - share) * low + share * high)[self._which]

    def load(self, price: float) -> float:
        """Return the expected sends per step of all loops at a given price per send, if no loop has to wait."""
        return float(self._looks @ self.rates(price))

    def settle(self, price: float, confidence: float = 0.0) -> list[Settled]:
        """Compute each schedule at a price per send and, if ``confidence`` is given, the lower bound on the cost."""
        found = self._ask(_settle, price, confidence, self._precise(price) if confidence else 0.0)
        return [found[which] for which in self._which]

    def price_of(self, capacity: float, guess: float) -> float:
        """Return the price per send at which the loops just use the whole capacity; 0 if they never need all of it."""
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
            if 2.0 ** (place / PER_OCTAVE) < CHEAPEST * guess:  # every loop that gains from a send makes it
                return CHEAPEST * guess
        place = crossing(lambda k: self.load(2.0 ** (k / PER_OCTAVE)) - capacity, low, high)
        return float(2.0 ** (place / PER_OCTAVE))

    def bound(self, settled: Sequence[Settled], capacity: float, price: float, confidence: float = LEVEL) -> DualBound:
        """Compute a lower bound on the total cost of these loops at a given capacity, valid for every scheduler."""
        from taciturn_limits.dual import SampledDual, bound_sum

        base = sum(kind.count * kind.cost_all_time for kind in self.kinds)
        if not price:
            return DualBound(base, None)
        looks = np.bincount(self._which, self._looks).tolist()
        first = [settled[int(np.argmax(self._which == place))].least for place in range(len(looks))]
        assert None not in first, "no bounds were requested"
        known = sum(look * least for look, least in zip(looks, first, strict=True) if isinstance(least, float))
        terms = [(look, least) for look, least in zip(looks, first, strict=True) if isinstance(least, SampledDual)]
        gains = float(known + bound_sum(terms, confidence))
        return DualBound(max(base + gains - price * capacity, base), confidence if terms else None)

    def _at(self, place: int) -> Array:
        if place not in self.table:
            self.table[place] = np.array(self._ask(_rate, 2.0 ** (place / PER_OCTAVE)))
        return self.table[place]

    def _ask(
        self, question: Callable[[Job], Answer], price: float, confidence: float = 0.0, precise: float = 0.0
    ) -> list[Answer]:
        """Return the answers for all different kinds; answers that this process has cached are not computed again."""
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
        """Return the target loss per kind due to the confidence; independent kinds together then meet ``PRECISE``."""
        clocks = [look * clock_cost(kind, price) for look, kind in zip(self._looks, self.kinds, strict=True)]
        return PRECISE * float(np.sum(clocks)) / len(self._different) ** 0.5

    def _came(self, fraction: float) -> None:
        self._progress(1 - 0.5 ** (self._rounds + fraction))


def _numbers(kind: Kind) -> bytes:
    """Return the bytes of the matrices of a kind, on which all its estimates depend."""
    return b"".join(np.ascontiguousarray(part + 0.0).tobytes() for part in (kind.F, kind.noise, kind.Gamma))


def _seed_of(kind: Kind, seed: int) -> int:
    """Return the seed of a kind's draws."""
    return int.from_bytes(hashlib.blake2b(_numbers(kind), digest_size=6, key=str(seed).encode()[:64]).digest())


def _rate(job: Job) -> float:
    """Return the sends per check of a kind at a price."""
    fitted = _fit(job.kind, job.price, job.seed, FEW)
    return _schedule(job.kind, job.price, fitted, job.seed).rate.value


def _settle(job: Job) -> Settled:
    """Return the estimates of a kind at a price."""
    fitted = _fit(job.kind, job.price, job.seed, MORE)
    least = _least_gain(job, fitted) if job.confidence else None
    return Settled(_schedule(job.kind, job.price, fitted, job.seed), least)


def _fit(kind: Kind, price: float, seed: int, points: int) -> Fitted | None:
    """Return a schedule that is fitted at a price, or None if sends are too rare or there is nothing to fit."""
    from taciturn_limits.fitted import fit_schedule  # slow to import

    error = kind.F, kind.noise, kind.Gamma
    if kind.clocked.forever == 0 or bound_rare_sends(*error, price).rate < RAREST:
        return None
    try:
        return fit_schedule(*error, price, seed, points)
    except ProblemError:  # sends are too rare for a fit
        return None


def _schedule(kind: Kind, price: float, fitted: Fitted | None, seed: int) -> Schedule:
    """Return a nearly optimal schedule of a kind at a price: the fitted one, or a threshold if it is better."""
    if kind.clocked.forever == 0:  # silence costs nothing
        return Schedule(price, Form(constant=-price), Estimate(0.0, 0.0, "exact"))
    if fitted is None:
        if bound_rare_sends(kind.F, kind.noise, kind.Gamma, price).rate < RAREST:
            return Schedule(price, _saving(kind, np.inf, price), Estimate(0.0, 0.0, "bound"))
        return _threshold(kind, price, seed)
    urgency = Form((RULE_ERROR,), kind.Gamma, -fitted.gain, bell=GaussianTerm(-fitted.height, fitted.Pi))
    rate, excess = measure_alone(kind, urgency, 1 / fitted.interval, seed)
    gain, found = excess + price * rate.value, Schedule(price, urgency, rate)
    if abs(gain - fitted.gain) <= OFF * fitted.gain:
        return found
    return _threshold(kind, price, seed, found, gain)  # the fit has not converged


def _threshold(kind: Kind, price: float, seed: int, best: Schedule | None = None, least: float = np.inf) -> Schedule:
    """Return the best threshold on the immediate cost of silence, or on its cost until periodic control sends."""
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
    """Return the minimiser of the parabola through the least value and its neighbours, which varies smoothly."""
    at = int(np.clip(np.argmin(values), 1, len(values) - 2))
    near = places[at - 1 : at + 2]
    off = near - places[at]
    bend, slope, _ = np.linalg.solve(np.stack([off * off, off, np.ones(3)], axis=1), values[at - 1 : at + 2])
    lowest = places[at] - slope / (2 * bend) if bend > 0 else places[np.argmin(values)]
    return float(np.clip(lowest, near[0], near[-1]))


def clock_cost(kind: Kind, price: float) -> float:
    """Return the cost per check of the best periodic control; the cost includes the price of the sends."""
    interval = kind.clocked.interval(price)
    return kind.clocked.cost(1 / interval) + price / interval


def _saving(kind: Kind, interval: float, price: float) -> Form:
    """Return e'Se − price, S = Σ F'ʲΓFʲ over the checks of an interval."""
    F, S = kind.F, kind.Gamma
    if np.isinf(interval):
        S = stationary(F.T, S)
    for _ in range(0 if np.isinf(interval) else int(interval) - 1):
        S = F.T @ S @ F + kind.Gamma
    return Form((RULE_ERROR,), symmetrised(S), -price)


def measure_alone(kind: Kind, urgency: Form, about: float, seed: int) -> tuple[Estimate, float]:
    """Simulate loops that never wait for the channel; return send rate and cost. ``about`` is the expected rate."""
    looks = int(np.clip(SETTLE / max(about, RAREST), SHORTEST, LONGEST))
    while True:
        loops = int(np.clip(MEASURED // looks, FEWEST, LOOPS))
        sends, costs = measure_freely(Group(kind.F, kind.noise, kind.Gamma, urgency, loops), looks, seed)
        rate = rate_of(sends, loops * looks)
        if looks * rate.value >= SETTLE / 2 or looks == LONGEST:
            return rate, float(costs.mean())
        looks = min(4 * looks, LONGEST)


def _least_gain(job: Job, fitted: Fitted | None) -> float | SampledDual:
    """Return a lower bound on the least mean cost of a check at a price."""
    from taciturn_limits.dual import sample_dual
    from taciturn_limits.fitted import fit_schedule
    from taciturn_limits.optimal import solve_optimal

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
            price, fitted = price / 2, None  # sends are too rare at this price; the least mean grows with it
    return rare.gain
