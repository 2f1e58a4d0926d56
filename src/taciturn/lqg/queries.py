"""Sensor schedules: the controller queries if this is worth its price, or if an output's variance is large.

The controller uses the measurement of step k at step k + 1. Let Ric(Σ) be the next error covariance with a measurement,
and P the weight of the error in the cost. If all later steps query the sensor, a query at Σ saves

    h(Σ) = Σ_{s≥0} α^{s+1} tr(P D_s),   D_s = Ric^s(AΣA' + W) − Ric^{s+1}(Σ),

and ``schedule_queries`` queries the sensor if h(Σ_k) exceeds the price of a query. ``schedule_by_variance`` queries the
sensors of which the variance of a predicted output exceeds a threshold. Both end when the covariance returns to an
earlier one (Brent's algorithm), so that the schedule repeats.

The differences are computed without subtraction: D_0 = G(CΣC' + V)G' with the gain G of Σ. The others follow from the
recursion in closed form, relative to the steady covariance Σ̄: with F̄ = A − ḠC and
O_s = Σ_{j<s} F̄'^j C'(CΣ̄C' + V)⁻¹C F̄^j,

    Ric^s(X) − Ric^s(Y) = F̄^s (I + (X − Σ̄)O_s)⁻¹ (X − Y) (I + O_s(Y − Σ̄))⁻¹ F̄'^s.

The parts that do not depend on Σ are computed once. Over a block of many steps, the terms of a slow filter are smooth:
the sum over a block is that over a few of its steps, near those of Gauss and Legendre. If V is singular, or Σ does not
converge to Σ̄, the differences are computed step by step.

Source: khashooei2017
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, frozen, is_definite, symmetrised
from taciturn._display import Displayed
from taciturn._modes import closure, radius, root, summed
from taciturn._progress import check_time
from taciturn.errors import UnstableError
from taciturn.lqg.cache import remembered
from taciturn.lqg.kalman import CRUMB, resting_states, steady_filter
from taciturn.lqg.quadratic import price
from taciturn.lqg.riccati import Repetition
from taciturn.model.plant import Plant, derived_plant
from taciturn.model.schedule import Schedule

_NEGLIGIBLE = 1e-14  # last term of a sum, relative to the sum
_ROUNDING = 1e-17  # relative size of a term below which it does not change a sum
_FORGOTTEN = 1e-12  # remaining fraction of an error that is negligible, as its square is below rounding
_MOST, _NUMBERS = 100_000, 20_000_000  # most steps of a closed form, and most entries of all their matrices
_DENSE, _NODES = 64, 24  # most steps of a block that are all summed, and steps of a longer block
_EXACT = 1e-13  # relative error of a block
_CONDITION = 1e6  # largest condition number of the inverted matrix, for nine accurate digits
_CONVERGED = 1e-11  # relative change of a covariance from which on the map of differences is constant
_SAME = 1e-11  # relative difference of covariances that count as equal when a cycle is sought
_WEIGHTLESS = 1e-20  # share of the largest weighed variance of a state below which later steps do not count
_USUAL = 1000  # steps within which most covariances converge
LONGEST = 100_000  # steps within which a schedule must repeat
_WORK = 6e10  # longest time for one schedule, approximate nanoseconds
# nanoseconds: for one value of a query, for a term of its sum, for a term that is computed step by step
_VALUE, _TERM, _STEP = 6e5, 2e3, 1.5e5
_SILENT = 1, 16, 256  # steps without a query before which the sum over few steps is checked
_CHUNK = 512  # steps whose matrices are computed together
_APART = 1e-6  # rounding error of a double eigenvalue on the unit circle
Sensors = Mapping[str, Sequence[int]]  # the outputs of each sensor by its link; the other outputs are always measured


@dataclass(frozen=True, eq=False, repr=False)
class Weights(Displayed):
    """Weights of the estimation error e in the cost, which at step k is α^k e'P_k e.

    Args:
        P: weight, (n, n), or one for each step of a finite horizon, (N, n, n).
        discount: α; 1 for an average or a finite horizon.
    """

    P: Array
    discount: float = 1.0

    @property
    def horizon(self) -> int | None:
        """Number of steps of the horizon; None for an infinite horizon."""
        return len(self.P) if self.P.ndim == 3 else None


def schedule_queries(plant: Plant, weights: Weights, price: float, initial: Array) -> Schedule:
    """Compute the sensor schedule that queries at step k if the value h(Σ_k) of a query exceeds its price ζ."""
    # It begins with the covariance Σ_0 and ends when it repeats or the horizon ends. A state that neither noise nor the
    # initial covariance ever makes uncertain, such as a set-point, has no error. It is left out: in the sums over all
    # later steps, a weight of such a state would not decay.
    uncertain = (plant.W.diagonal() > 0) | (initial.diagonal() > 0)
    unknown = closure(uncertain, np.asarray(plant.A != 0, dtype=np.bool_))
    unknown = unknown if unknown.any() else ~unknown
    block = np.ix_(unknown, unknown)
    A, W, C, first = plant.A[block], plant.W[block], plant.C[:, unknown], initial[block]
    found = _scheduled(A, plant.B[unknown], W, C, plant.V, weights.P[..., *block], weights.discount, price, first)
    covariance = np.zeros((len(found.covariance), plant.states, plant.states))
    covariance[:, *block] = found.covariance
    return replace(found, covariance=frozen(covariance))


@remembered
def _scheduled(
    A: Array, B: Array, W: Array, C: Array, V: Array, P: Array, discount: float, price: float, initial: Array
) -> Schedule:
    """Return the schedule of ``schedule_queries``; every trial of a search for another parameter needs it again."""
    # inputs that act through states without an error, such as late ones, need not stabilise the part that is left
    rest = np.zeros(len(A)), np.zeros_like(A)
    plant, weights = derived_plant(A, B, W, C, V, None, *rest, None), Weights(P, discount)
    predictor, horizon = Predictor(plant), weights.horizon
    worth, covariance, value = QueryValue(predictor, weights), [initial], list[float]()
    for tick in range(horizon or LONGEST):
        check_time()
        value.append(worth(covariance[-1], tick))
        covariance.append(predictor.follow(covariance[-1], value[-1] > price))
        cycle = None if horizon is not None else _cycle_of(predictor, covariance)
        if cycle is not None:
            return _schedule(plant, covariance[: cycle[1]], value[: cycle[1]], price, cycle[0], weights.discount)
    if horizon is None:
        raise UnstableError(
            f"with zeta = {price:g} the schedule of queries does not repeat within {LONGEST} steps; expected another "
            "value of zeta, or a horizon"
        )
    return _schedule(plant, covariance[:-1], value, price, None, 1.0)


def _schedule(
    plant: Plant, covariance: Sequence[Array], value: Sequence[float], price: float, start: int | None, discount: float
) -> Schedule:
    values = frozen(np.array(value))
    queries = values > price
    queries.setflags(write=False)  # designs share a schedule
    found = Schedule(queries, values, frozen(np.array(covariance)), price, start, discount)
    _expect_queries(plant, found)
    return found


def _expect_queries(plant: Plant, schedule: Schedule) -> None:
    """Raise an ``UnstableError`` if the plant is unstable and no query is in the repeating part of a schedule."""
    moving, start = ~resting_states(plant), schedule.start
    if start is not None and not schedule.queries[start:].any() and radius(plant.A[np.ix_(moving, moving)]) >= 1:
        raise UnstableError(
            f"at the price or threshold {schedule.price:g} the sensor is never queried, and the plant is unstable, so "
            "that the estimation error would grow; expected a smaller price or threshold, or noise W on the unstable "
            "modes"
        )


def _cycle_of(predictor: Predictor, covariance: Sequence[Array]) -> tuple[int, int] | None:
    """Return the first step of the cycle and the step after its last one, or None if no cycle is found yet."""
    # The last covariance is compared with that of the latest of the steps 0, 1, 3, 7, … (Brent's algorithm), so that
    # one comparison per step suffices.
    last = len(covariance) - 1
    mark = (1 << last.bit_length() - 1) - 1
    if last == 0 or predictor.change(covariance[mark], covariance[last]) > _SAME:
        return None
    period, start = last - mark, mark
    while start > 0 and predictor.change(covariance[start - 1], covariance[start - 1 + period]) <= _SAME:
        start -= 1
    return start, start + period


def follow_every_query(
    plant: Plant, initial: Array, horizon: int | None, discount: float = 1.0
) -> tuple[Array, int | None]:
    """Compute the error covariances with a sensor query at every step, and the step from which they repeat.

    Args:
        plant: plant with A, C, W and V.
        initial: Σ_0, covariance of the initial prediction, (n, n).
        horizon: number of steps; None: until the covariance has converged.
        discount: α, by which the cost of a later step counts less: a covariance that has not converged within 1,000
            steps stays as it is at the step from which on α^k leaves no variance a weight.

    Returns:
        The covariances, (steps, n, n), and the step from which they repeat, or None with a horizon.

    Raises:
        UnstableError: the covariance does not converge within 100,000 steps.

    Source: khashooei2017
    """
    predictor, covariance, repetition = Predictor(plant), [initial], Repetition()
    weight, largest = 1.0, initial.diagonal()
    for _ in range((horizon or LONGEST) - 1):
        check_time()
        covariance.append(predictor.follow(covariance[-1], True))
        if horizon is None:
            cycle = _cycle_of(predictor, covariance)
            if cycle is not None:
                return frozen(np.array(covariance[: cycle[1]])), cycle[0]
            weight *= discount
            weighed = weight * covariance[-1].diagonal()
            largest = np.maximum(largest, weighed)
            if len(covariance) > _USUAL and (weighed <= _WEIGHTLESS * (1 - discount) * largest).all():
                return frozen(np.array(covariance)), len(covariance) - 1
            continue
        period = repetition.period(len(covariance), covariance[-1])
        if period is not None:
            repeated = covariance[-period:]
            covariance += [repeated[k % period] for k in range(horizon - len(covariance))]
            break
    if horizon is None:
        raise UnstableError(
            f"the error covariance has not converged within {LONGEST} steps; "
            "expected noise W on slow modes, a measurement of every mode that does not decay, or a horizon"
        )
    return frozen(np.array(covariance)), None


def schedule_by_variance(plant: Plant, threshold: float, sensors: Sensors) -> Schedule:
    """Compute the periodic schedule of sensors that send when an output's predicted variance exceeds a threshold."""
    # Sensor l is queried if (CΣ_kC')_ii > threshold for one of its outputs i, where Σ_k is the covariance of the
    # prediction from the measurements of all sensors that were queried before.
    every = Predictor(plant)
    predictors = {tuple(range(plant.outputs)): every, (): every}
    covariance, value = [steady_filter(plant.A, plant.C, plant.W, plant.V).prior], list[list[float]]()
    for _ in range(LONGEST):
        variances = np.diag(plant.C @ covariance[-1] @ plant.C.T)
        value.append([float(variances[[*outputs]].max()) for outputs in sensors.values()])
        read = tuple(np.flatnonzero(_measured(plant, np.array(value[-1]) > threshold, sensors)).tolist())
        if read not in predictors:
            predictors[read] = Predictor(plant, read)
        covariance.append(predictors[read].follow(covariance[-1], len(read) > 0))
        cycle = _cycle_of(every, covariance)
        if cycle is not None:
            values = np.array(value[slice(*cycle)])
            values = frozen(values[:, 0] if len(sensors) == 1 else values)
            repeating = frozen(np.array(covariance[slice(*cycle)]))
            found = Schedule(values > threshold, values, repeating, threshold, 0, links=(*sensors,))
            if sum(map(len, sensors.values())) == plant.outputs:  # no output is measured in every step
                _expect_queries(plant, found)
            return found
    raise UnstableError(
        f"with threshold = {threshold:g} the schedule of measurements does not repeat within {LONGEST} steps; "
        "expected another value of the threshold"
    )


def corrections_of(plant: Plant, schedule: Schedule, sensors: Sensors) -> Array:
    """Return the filter gains ΣC'(CΣC' + V)⁻¹ of each step, (steps, n, p), with zeros for unmeasured outputs."""
    measured = _measured(plant, schedule.queries.reshape(len(schedule.queries), -1), sensors)
    found = Predictor(plant).correction(schedule.covariance) * measured[:, None, :]
    for row in np.unique(measured, axis=0):
        if row.any() and not row.all():
            ticks, outputs = (measured == row).all(axis=1), np.flatnonzero(row).tolist()
            gains = Predictor(plant, outputs).correction(schedule.covariance[ticks])
            found[np.ix_(ticks, range(plant.states), outputs)] = gains
    return found


def _measured(plant: Plant, queries: npt.NDArray[np.bool_], sensors: Sensors) -> npt.NDArray[np.bool_]:
    """Return whether each output is measured, (…, p), if the sensors are queried or not, (…, links)."""
    measured = np.ones((*queries.shape[:-1], plant.outputs), dtype=np.bool_)
    for column, outputs in enumerate(sensors.values()):
        measured[..., [*outputs]] = queries[..., column, None]
    return measured


class Predictor:
    """One-step Kalman predictor of a plant: at step k + 1, the controller uses the measurement of step k.

    Args:
        plant: plant with A, C, W and V.
        outputs: indices of the outputs that a measurement contains; default all.
    """

    def __init__(self, plant: Plant, outputs: Sequence[int] | None = None) -> None:
        """Select the rows of C and the block of V, and prepare the gains, which depend on whether V is definite."""
        self.plant, self._C, self._V = plant, plant.C, plant.V
        if outputs is not None:
            self._C, self._V = plant.C[[*outputs]], plant.V[np.ix_(outputs, outputs)]
        self._noisy = is_definite(self._V)
        self._observer = np.zeros(self._C.T.shape)
        if not self._noisy:
            with suppress(UnstableError):
                self._observer = steady_filter(plant.A, self._C, plant.W, self._V).gain

    def gain(self, Sigma: Array) -> Array:
        """Return the gain AΣC'(CΣC' + V)^{-1} of the Kalman predictor for an error covariance Σ, (…, n, p)."""
        return self.plant.A @ self.correction(Sigma)

    def correction(self, Sigma: Array) -> Array:
        """Return the gain ΣC'(CΣC' + V)^{-1} of the Kalman filter for an error covariance Σ, (…, n, p).

        If CΣC' + V is singular, some outputs are known in advance, and any gain is optimal in these directions. The
        gain of a stable observer is used there, so that errors from rounding and from the initial state decay.
        """
        C, V = self._C, self._V
        seen = C @ Sigma
        if self._noisy:
            with suppress(np.linalg.LinAlgError):  # rounding may make the sum singular next to a tiny V
                turned = np.linalg.solve(seen @ C.T + V, seen)
                return np.asarray(turned.swapaxes(-1, -2), dtype=np.float64)
        prices = [price(C.T, one, V) for one in Sigma.reshape(-1, *Sigma.shape[-2:])]
        S, inverse = (np.reshape(part, (*Sigma.shape[:-2], *V.shape)) for part in zip(*prices, strict=True))
        return seen.swapaxes(-1, -2) @ inverse + self._observer @ (np.eye(len(V)) - S @ inverse)

    def silent(self, Sigma: Array) -> Array:
        """Return the next error covariance, AΣA' + W, if no measurement arrives."""
        return symmetrised(self.plant.A @ Sigma @ self.plant.A.T + self.plant.W)

    def queried(self, Sigma: Array, gain: Array) -> Array:
        """Return the next error covariance, (…, n, n), if a measurement arrives; it is computed in Joseph's form."""
        p = self.plant
        F, turned = p.A - gain @ self._C, gain.swapaxes(-1, -2)
        moved = symmetrised(F @ Sigma @ F.swapaxes(-1, -2) + gain @ self._V @ turned)
        if not self._noisy and np.isfinite(moved).all():
            # outputs without noise leave exact zeros, whose rounding the next gain must not divide by
            before = symmetrised(p.A @ Sigma @ p.A.T)
            pairs = zip(moved.reshape(-1, *p.A.shape), before.reshape(-1, *p.A.shape), strict=True)
            halves = (root(one, beside, CRUMB) for one, beside in pairs)
            moved = np.reshape([half @ half.T for half in halves], moved.shape)
        return moved + p.W

    def change(self, before: Array, after: Array) -> Array:
        """Return the largest difference between covariances, relative to the standard deviations of ``after``.

        A variance that is small compared with the products in its sum may be their rounding; its difference is relative
        to these products.
        """
        spread = np.sqrt(np.maximum(np.diag(after), 0.0))
        unit = np.maximum(spread, 1e-2 * np.abs(self.plant.A) @ spread)
        unit = np.where(unit > 0, unit, 1.0)
        return np.abs((after - before) / unit / unit[:, None]).max(axis=(-2, -1))

    def follow(self, Sigma: Array, query: bool) -> Array:
        """Return the next error covariance. ``query`` states whether the sensor is queried in this step.

        Raises:
            UnstableError: the covariance overflows.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            following = self.queried(Sigma, self.gain(Sigma)) if query else self.silent(Sigma)
            if not np.isfinite(following @ following).all():
                raise UnstableError(
                    "the error covariance overflows before the sensor is queried; expected a smaller zeta or threshold"
                )
        return following


class QueryValue:
    """Value h(Σ) of a sensor query at the error covariance Σ: the cost that the query saves, if all later steps query.

    h(Σ) = Σ_{s≥0} α^{s+1} tr(P D_s),  D_s = Ric^s(AΣA' + W) − Ric^{s+1}(Σ). With a finite horizon, P is P_{k+1+s} at
    step k, and the sum ends with the horizon. The differences D_s are computed without subtraction: D_0 = G(CΣC' + V)G'
    with the gain G of Σ, and the others follow in closed form, whose parts that do not depend on Σ are computed once.
    If V is singular, or Σ does not converge to the steady covariance, they are computed step by step:
    D_{s+1} = F(X_s) D_s F(Y_s)' with F(X) = A − AXC'(CXC' + V)^{-1}C and the two covariances X_s and Y_s.

    Args:
        predictor: the filter.
        weights: weights of the estimation error.

    Source: khashooei2017
    """

    def __init__(self, predictor: Predictor, weights: Weights) -> None:
        """Compute the parts that are common to all covariances."""
        self._predictor, self._weights, self._done = predictor, weights, 0.0
        self._flow = _riccati_flow(predictor.plant, weights.discount, weights.horizon)
        if self._flow is not None and weights.horizon is None:
            # a weight of a mode that does not decay, such as a set-point's, has no sum over all later steps
            if np.sqrt(weights.discount) * radius(self._flow.step) >= 1 - _APART:
                self._flow = None
                return
            if not (self._flow.steady.diagonal() > 0).all():
                # Blocks are judged at covariances near the steady one. If that is 0, an error that is left from the
                # start is far from all of them, so every step counts by itself.
                self._weighed, self._observed = self._flow.weighed(weights.P, weights.discount), self._flow.observed
                return
            expected = [self._flow.steady, *self._starts(self._flow)]
            self._weighed, self._observed = self._flow.thinned(weights.P, weights.discount, np.array(expected))

    def _starts(self, flow: _Flow) -> Iterator[Array]:
        """Yield covariances from which later queries begin: one that is known, and those after silence."""
        found, after = np.zeros_like(flow.steady), 0
        for steps in (0, *_SILENT):
            with np.errstate(over="ignore", invalid="ignore"):
                for _ in range(steps - after):
                    found = self._predictor.silent(found if after else flow.steady)
                    after += 1
            if not np.isfinite(found).all():
                return
            if flow.attracts(found):
                yield found

    def __call__(self, Sigma: Array, tick: int = 0) -> float:
        """Return h ≥ 0.

        Args:
            Sigma: covariance of the predicted estimate, (n, n).
            tick: step k within a finite horizon.

        Raises:
            UnstableError: the sum does not converge, because later queries do not remove a difference.
        """
        plant, flow = self._predictor.plant, self._flow
        gain = self._predictor.gain(Sigma)
        X, Y = self._predictor.silent(Sigma), self._predictor.queried(Sigma, gain)
        if flow is None or not flow.attracts(np.stack([X, Y])):
            return self._follow(np.stack([X, Y]), symmetrised(gain @ plant.C @ Sigma @ plant.A.T), tick)
        ahead = self._weights.horizon is not None
        weighed = flow.weighed(self._weights.P[tick + 1 :], 1.0) if ahead else self._weighed
        observed = flow.observed[: len(weighed)] if ahead else self._observed
        self._count(_VALUE + _TERM * len(weighed), len(weighed))
        S, total = plant.C @ Sigma @ plant.C.T + plant.V, 0.0
        for begin in range(0, len(weighed), _CHUNK):
            ticks = slice(begin, min(begin + _CHUNK, len(weighed)))
            left, right = (flow.faded(part, gain, observed[ticks]) for part in (X, Y))
            total += float((weighed[ticks] @ left @ S * right).sum())
        return total

    def _count(self, work: float, products: int) -> None:
        """Add up the work, with a number of matrix products, and raise an error if a schedule takes too long."""
        states = self._predictor.plant.states
        self._done += work + products * 2 * states**3
        if self._done > _WORK:
            late, expected = "has not repeated", "a horizon"
            if self._weights.horizon is not None:
                late, expected = f"of {self._weights.horizon} steps has not ended", "a shorter horizon"
            raise UnstableError(
                f"after about a minute of computation for {states} states, the schedule of queries {late}: errors "
                f"decay too slowly; expected {expected}, fewer states, or noise W and V for which the filter error "
                "decays faster"
            )

    def _follow(self, both: Array, D: Array, tick: int) -> float:
        """Return h, computed step by step from X, Y and D = X − Y."""
        predictor, alpha, horizon = self._predictor, self._weights.discount, self._weights.horizon
        A, C = predictor.plant.A, predictor.plant.C
        prices = self._weights.P[None] if horizon is None else self._weights.P[tick + 1 :]
        largest = float(np.trace(prices, axis1=-2, axis2=-1).max(initial=0.0))
        total, factor = 0.0, alpha
        for s in range(LONGEST if horizon is None else len(prices)):
            check_time()
            if s % 64 == 0:
                self._count(64 * _STEP, 10 * 64)
            P = prices[0 if horizon is None else s]
            total += factor * float((P * D).sum())
            gains = predictor.gain(both)
            F, G = A - gains @ C
            D = symmetrised(F @ D @ G.T)
            factor *= alpha
            if factor * np.abs(D).max() * largest <= _NEGLIGIBLE * total:
                return total
            before, both = both, predictor.queried(both, gains)
            if horizon is not None or s % 8 < 7:  # the convergence test takes as long as a term
                continue
            if max(float(predictor.change(*pair)) for pair in zip(before, both, strict=True)) > _CONVERGED:
                continue
            # of a state that is known, the difference is and remains 0, whether its mode decays or not
            at = np.ix_(*2 * (closure(D.diagonal() > 0, np.asarray((F != 0) | (G != 0), dtype=np.bool_)),))
            if np.abs(F - G).max() <= _CONVERGED * max(1.0, float(np.abs(F).max())):
                shrinking = np.sqrt(alpha) * F[at]
                if radius(shrinking) < 1:
                    return total + factor * float((P[at] * summed(shrinking, D[at])).sum())
            elif alpha * radius(F[at]) * radius(G[at]) >= 1 - _APART:  # the covariances have different limits
                break
        if horizon is not None:
            return total
        raise UnstableError(
            "the value of a query is not finite, because no later query reduces some of the estimation errors; "
            "expected a detectable plant, noise W on every mode on or outside the unit circle and noise V on every "
            "output, or a discount"
        )


class _Flow(NamedTuple):
    """Closed form of the filter's Riccati recursion over s = 0, 1, … steps, relative to the steady covariance Σ̄."""

    steady: Array  # Σ̄, the steady covariance, (n, n)
    unit: Array  # standard deviation of each state, (n,)
    step: Array  # F̄, (n, n)
    powers: Array  # F̄^s, (steps, n, n)
    observed: Array  # O_s, (steps + 1, n, n); without a horizon, the last one is valid for all later steps

    def attracts(self, covariances: Array) -> bool:
        """Return whether covariances converge to the steady state, which the accuracy of the closed form requires."""
        off = (covariances - self.steady) @ self.observed[-1]
        return bool((np.linalg.cond(np.eye(len(self.unit)) + off / self.unit[:, None] * self.unit) < _CONDITION).all())

    def weighed(self, P: Array, discount: float) -> Array:
        """Return α^{s+1} F̄'^s P F̄^s for each step s. For a constant P, add the sum over all later steps."""
        powers = self.powers if P.ndim == 2 else self.powers[: len(P)]
        factors: Array = np.power(discount, np.arange(1.0, len(powers) + 2))[:, None, None]
        each: Array = factors[:-1] * (powers.swapaxes(-1, -2) @ (P if P.ndim == 2 else P[: len(powers)]) @ powers)
        if P.ndim == 3:
            return each
        last = powers[-1] @ self.step
        rest = summed(np.sqrt(discount) * self.step.T, symmetrised(last.T @ P @ last))
        return np.concatenate([each, factors[-1:] * rest])

    def thinned(self, P: Array, discount: float, covariances: Array) -> tuple[Array, Array]:
        """Select a few steps that suffice to compute the sum; return their weights and their matrices O_s."""
        # Over a block of many steps, the terms of a slow filter are smooth. So the sum over a block is that over a few
        # of its steps, with the weights for which sums of polynomials are exact. It replaces the block if it agrees
        # with the sum over all steps of the block, for terms with covariances that are to be expected; otherwise it is
        # halved.
        weighed = self.weighed(P, discount)
        steps, unit = len(weighed), np.diag(self.unit)
        terms = np.zeros((len(covariances), steps))
        if steps > _DENSE:
            for found, covariance in zip(terms, covariances, strict=True):
                left = self.faded(covariance, unit, self.observed)
                found[:] = (weighed @ left * left).sum(axis=(1, 2))
        least = _EXACT * np.abs(terms).sum(axis=1)
        kept, factors = list[npt.NDArray[np.int64]](), list[Array]()
        open_blocks = [(0, steps - 1)]  # the last one is the sum over all later steps
        while open_blocks:
            begin, end = open_blocks.pop()
            places, shares = np.arange(begin, end, dtype=np.int64), np.ones(end - begin)
            if end - begin > _DENSE:
                some, weights = _few_places(end - begin)
                off = np.abs(terms[:, begin + some] @ weights - terms[:, begin:end].sum(axis=1))
                if not (off <= least).all():
                    middle = begin + (end - begin) // 2 if begin else max(_DENSE, end // 2)
                    open_blocks += [(begin, middle), (middle, end)]
                    continue
                places, shares = begin + some, weights
            kept.append(places)
            factors.append(shares)
        places = np.append(np.concatenate(kept), steps - 1)
        shares = np.append(np.concatenate(factors), 1.0)
        return weighed[places] * shares[:, None, None], self.observed[places]

    def faded(self, covariance: Array, parts: Array, observed: Array) -> Array:
        """Return (I + (X − Σ̄)O_s)^{-1}·``parts`` of the closed form, for a covariance X and several steps s."""
        off = np.eye(len(self.unit)) + (covariance - self.steady) @ observed
        return np.asarray(np.linalg.solve(off, np.broadcast_to(parts, (len(off), *parts.shape))), dtype=np.float64)


def _riccati_flow(plant: Plant, discount: float, horizon: int | None) -> _Flow | None:
    """Return the closed form of the filter's recursion, up to the step after which its terms are negligible."""
    # It is None if V is singular, if no steady filter exists, or if its errors decay too slowly.
    if not is_definite(plant.V):
        return None
    try:
        steady = steady_filter(plant.A, plant.C, plant.W, plant.V)
    except UnstableError:
        return None
    F = plant.A - plant.A @ steady.gain @ plant.C
    seen = symmetrised(plant.C.T @ np.linalg.solve(steady.innovation, plant.C))
    unit = np.sqrt(np.where(np.diag(steady.prior) > 0, np.diag(steady.prior), 1.0))
    relative, most = unit[:, None] * unit, horizon or min(_MOST, _NUMBERS // len(F) ** 2)
    powers, observed = np.eye(len(F))[None], np.stack([np.zeros_like(F), symmetrised(seen)])
    while True:  # F̄^s and O_{s+1} of twice as many steps, by F̄^{r+s} = F̄^s F̄^r and O_{r+s} = O_r + F̄'^r O_s F̄^r
        steps = np.arange(len(powers))
        left = np.power(discount, steps / 2) * np.abs(powers @ F / unit[:, None] * unit).max(axis=(1, 2))
        added = np.abs(powers.swapaxes(1, 2) @ seen @ powers * relative).max(axis=(1, 2))
        enough = left <= _FORGOTTEN
        if horizon is None:
            enough |= added <= _ROUNDING * np.abs(observed[1:] * relative).max(axis=(1, 2))
        if enough.any() or len(powers) == most:
            break
        further = powers[-1] @ F
        more = min(len(powers), most - len(powers))
        powers = np.concatenate([powers, powers[:more] @ further])
        following = observed[-1] + symmetrised(further.T @ observed[1 : more + 1] @ further)
        observed = np.concatenate([observed, following])
    if horizon is None and not enough.any():
        return None
    last = int(np.argmax(enough)) + 1 if enough.any() else len(powers)
    return _Flow(steady.prior, unit, F, powers[:last], observed[: last + 1])


@cache
def _few_places(steps: int) -> tuple[npt.NDArray[np.int64], Array]:
    """Return some of the steps of a block, near those of Gauss and Legendre, whose sums of polynomials are exact."""
    legendre = np.polynomial.legendre
    nodes = np.asarray(legendre.leggauss(_NODES)[0], dtype=np.float64)
    places = np.unique(np.rint((nodes + 1) / 2 * (steps - 1)).astype(np.int64))
    values = np.asarray(legendre.legvander(np.linspace(-1, 1, steps), len(places) - 1), dtype=np.float64)
    return places, np.asarray(np.linalg.solve(values[places].T, values.sum(axis=0)), dtype=np.float64)
