"""What loops send at a price, tabulated kind by kind; the price that loads a channel, and what none can beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taciturn import _scipy
from taciturn._arrays import symmetrised
from taciturn._modes import stationary
from taciturn.analyse.limits import USUAL
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.trigger import Bell, Form
from taciturn.renewal.chain import NoQuadratureError
from taciturn.renewal.rare import bound_rare_sends
from taciturn.simulation.channel import ERROR, Group, measure_freely
from taciturn.simulation.statistics import rate_of
from taciturn.study.kinds import Kind

if TYPE_CHECKING:
    from taciturn.renewal.fitted import Fitting

PER_OCTAVE = 2  # prices of a table
FEW = 300  # errors that the schedules of a table are fitted to
LOOPS, FEWEST = 4096, 256  # that a rate is measured on
MEASURED = 1 << 21  # looks of all of them
SETTLE = 8  # mean intervals between sends that are dropped first, and that are measured
SHORTEST, LONGEST = 64, 16_384  # looks that are measured
CLOCK = 4.0  # times the price of triggers, about, is that of clocks: 3 of a random walk, 5 of two masses
FACTORS = (1.0, 1.5, 2.2, 3.3, 5.0, 7.5)  # of the price: thresholds that are tried
OFF = 0.1  # relative, by which a fit's gain and what is measured may differ
HALVINGS = 8  # of a price at which there is no bound
CHEAPEST = 1e-9  # of the price from where a search begins: next to nothing
RAREST = 1 / LONGEST  # sends per look: what sends less often never sends
ACCURATE = 1e-3  # relative, of a bound by quadrature, from which its error is taken
ALWAYS = Form(constant=1.0)


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


class Curve:
    """Rate of nearly the best schedule over the price of a send, tabulated at the prices that are asked about.

    Prices of a table are half an octave apart; in between log rate is linear in log price, as a power law is.

    Args:
        kind: of loops.
        seed: of the draws.
    """

    def __init__(self, kind: Kind, seed: int = 0) -> None:
        """Tabulate nothing yet."""
        from taciturn.renewal.fitted import Fitting  # statistics, that take a while to import

        self.kind, self._seed = kind, seed
        self._coarse = Fitting(kind.F, kind.noise, kind.Gamma, seed, FEW)
        self._fine = Fitting(kind.F, kind.noise, kind.Gamma, seed)
        self.table: dict[int, float] = {}

    def rate(self, price: float) -> float:
        """Return the sends per look at a price."""
        place = PER_OCTAVE * np.log2(price)
        below = int(np.floor(place))
        low, high = self._at(below), self._at(below + 1)
        share = float(place - below)
        if min(low, high) <= 0:
            return (1 - share) * low + share * high
        return float(low ** (1 - share) * high**share)

    def schedule(self, price: float) -> Schedule:
        """Return the schedule at a price, as well fitted as a design is."""
        return self._measured(price, self._fine)

    def _at(self, place: int) -> float:
        if place not in self.table:
            self.table[place] = self._measured(2.0 ** (place / PER_OCTAVE), self._coarse).rate.value
        return self.table[place]

    def _measured(self, price: float, fitting: Fitting) -> Schedule:
        kind = self.kind
        if kind.clocked.forever == 0:  # silence costs nothing
            return Schedule(price, Form(constant=-price), Estimate(0.0, 0.0, "exact"))
        if bound_rare_sends(kind.F, kind.noise, kind.Gamma, price).rate < RAREST:
            return Schedule(price, self._saving(np.inf, price), Estimate(0.0, 0.0, "bound"))
        try:
            found = fitting.at(price)
        except ProblemError:  # sends are too rare for a fit
            return self._rare(price)
        urgency = Form((ERROR,), kind.Gamma, -found.gain, bell=Bell(-found.height, found.Pi))
        rate, excess = measure_alone(kind, urgency, 1 / found.interval, self._seed)
        gain = excess + price * rate.value
        fitted = Schedule(price, urgency, rate)
        if abs(gain - found.gain) <= OFF * found.gain:
            return fitted
        return self._rare(price, fitted, gain)  # it has not converged

    def _rare(self, price: float, best: Schedule | None = None, least: float = np.inf) -> Schedule:
        """Return the best threshold on what silence costs at once, or until a clock sends, if no other is better."""
        interval = self.kind.clocked.interval(CLOCK * price)
        for looks in {1.0, interval}:
            for factor in FACTORS:
                urgency = self._saving(looks, factor * price)
                rate, excess = measure_alone(self.kind, urgency, 1 / interval, self._seed)
                if excess + price * rate.value < least:
                    best, least = Schedule(price, urgency, rate), excess + price * rate.value
        assert best is not None
        return best

    def _saving(self, interval: float, price: float) -> Form:
        """Return e'Se − price, S = Σ F'ʲΓFʲ over the looks of an interval."""
        F, S = self.kind.F, self.kind.Gamma
        if np.isinf(interval):
            S = stationary(F.T, S)
        for _ in range(0 if np.isinf(interval) else int(interval) - 1):
            S = F.T @ S @ F + self.kind.Gamma
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


def find_price(curves: Sequence[Curve], capacity: float, guess: float) -> float:
    """Return the common price per send at which the loops load the channel as much as asked; 0 if they never do.

    Args:
        curves: of the kinds.
        capacity: sends per tick.
        guess: price from where the search begins.
    """
    if sum(curve.kind.looks for curve in curves if curve.kind.clocked.forever) <= capacity:
        return 0.0

    def excess(place: float) -> float:
        price = 2.0 ** (place / PER_OCTAVE)
        loads = [curve.kind.looks * curve.rate(price) for curve in curves]
        return sum(loads) - capacity

    low = high = round(PER_OCTAVE * float(np.log2(guess)))
    stride = 1
    while excess(high) > 0:
        low, high, stride = high, high + stride, 2 * stride
    while excess(low) <= 0:
        low, high, stride = low - stride, low, 2 * stride
        if 2.0 ** (low / PER_OCTAVE) < CHEAPEST * guess:  # whoever gains anything by a send makes it, and has room
            return CHEAPEST * guess
    return float(2.0 ** (_scipy.crossing(excess, low, high) / PER_OCTAVE))


@dataclass(frozen=True)
class DualBound:
    """No scheduler of some loops costs less.

    Args:
        cost: summed over all loops, in the units of the cost.
        confidence: with which that holds; None where all of it is by quadrature.
    """

    cost: float
    confidence: float | None


def bound_schedulers(
    kinds: Sequence[Kind], capacity: float, price: float, confidence: float = USUAL, seed: int = 0
) -> DualBound:
    """Return what no scheduler of these loops can cost less than, whatever it knows, with so many sends per tick.

    The dual function at a price λ per send: with g_i the least mean of e'Γe + λσ over the looks of a loop alone, one
    look in m_i ticks,

        Σ J_i ≥ Σ (J_all,i + g_i(λ)/m_i) − λ·capacity.

    Args:
        kinds: the loops.
        capacity: sends per tick.
        price: λ; the bound holds for any, and is best where the load meets the capacity.
        confidence: with which it holds, where some of it is sampled.
        seed: of the draws.

    Source: everett1963, brown2010
    """
    base = sum(kind.count * kind.cost_all_time for kind in kinds)
    if not price:
        return DualBound(base, None)
    found = [_least_gain(kind, price, 1 - (1 - confidence) / len(kinds), seed) for kind in kinds]
    gains = sum(kind.looks * gain for kind, (gain, _) in zip(kinds, found, strict=True))
    sampled = any(is_sampled for _, is_sampled in found)
    return DualBound(max(base + gains - price * capacity, base), confidence if sampled else None)


def _least_gain(kind: Kind, price: float, confidence: float, seed: int) -> tuple[float, bool]:
    """Return a lower bound of the least mean cost of a look at a price, and whether it was sampled."""
    from taciturn.renewal.dual import bound_schedules
    from taciturn.renewal.fitted import fit_schedule
    from taciturn.renewal.optimal import solve_optimal

    error = kind.F, kind.noise, kind.Gamma
    rare = bound_rare_sends(*error, price)
    if rare.rate < RAREST:
        return rare.gain, False
    for _ in range(HALVINGS):
        try:
            exact = solve_optimal(*error, price, ACCURATE)
            return max(exact.cost - exact.cost_error, rare.gain), False
        except NoQuadratureError:
            pass
        try:
            found = bound_schedules(*error, price, fit_schedule(*error, price, seed), confidence, seed)
            return max(found.gain, rare.gain), True
        except ProblemError:
            price /= 2  # hardly anything is sent at it; the least mean grows with the price
    return rare.gain, False
