"""When to query a sensor: the value of a measurement to the controller, and the schedule it leads to."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, frozen, is_definite, symmetrised
from taciturn._modes import radius, summed
from taciturn.errors import UnstableError
from taciturn.lqg import _dare
from taciturn.lqg._flow import flow
from taciturn.lqg.kalman import resting_states, steady_filter
from taciturn.model.plant import Plant
from taciturn.model.schedule import Schedule

NEGLIGIBLE = 1e-14  # share of a sum that its last term may add
CONVERGED = 1e-11  # relative change of a covariance from which on the map of differences is constant
SAME = 1e-11  # relative difference of covariances that count as the same place of a cycle
LONGEST = 100_000  # ticks within which a schedule must repeat
WORK = 6e10  # nanoseconds, about, for one schedule
VALUE, TERM, STEP = (
    6e5,
    2e3,
    1.5e5,
)  # of them: for one value of a query, for a term of its sum, for one that is followed
CHUNK = 64  # ticks whose matrices are at hand together
APART = 1e-6  # distance from the unit circle that computed eigenvalues of a double one can have


@dataclass(frozen=True, eq=False)
class Weights:
    """What an estimation error costs: α^k e'P_k e at tick k.

    Args:
        P: (n, n), or one for each tick of a finite horizon, (N, n, n).
        discount: α; 1 for an average or a finite horizon.
    """

    P: Array
    discount: float = 1.0

    @property
    def horizon(self) -> int | None:
        """Ticks, or None."""
        return len(self.P) if self.P.ndim == 3 else None


class Predictor:
    """The filter of a plant whose measurement of tick k reaches the control of tick k + 1.

    Args:
        plant: A, C, W and V.
    """

    def __init__(self, plant: Plant) -> None:
        """Look once at what decides how a gain is computed."""
        self.plant, self._noisy = plant, is_definite(plant.V)
        self._observer = np.zeros((plant.states, plant.outputs))
        if not self._noisy:
            with suppress(UnstableError):
                self._observer = steady_filter(plant.A, plant.C, plant.W, plant.V).gain

    def gain(self, Sigma: Array) -> Array:
        """Return AΣC'(CΣC' + V)^{-1}, (…, n, p), that of the prediction."""
        return self.plant.A @ self.correction(Sigma)

    def correction(self, Sigma: Array) -> Array:
        """Return ΣC'(CΣC' + V)^{-1}, (…, n, p), that of the filtered estimate.

        Where CΣC' + V is singular, outputs are known in advance: in these directions any gain is optimal, and that of a
        stable observer is taken, which also forgets what rounding and the start have put there.
        """
        p = self.plant
        seen = p.C @ Sigma
        if self._noisy:
            turned = np.linalg.solve(seen @ p.C.T + p.V, seen)
            return np.asarray(turned.swapaxes(-1, -2), dtype=np.float64)
        prices = [_dare.price(p.C.T, one, p.V) for one in Sigma.reshape(-1, *Sigma.shape[-2:])]
        S, inverse = (np.reshape(part, (*Sigma.shape[:-2], *p.V.shape)) for part in zip(*prices, strict=True))
        return seen.swapaxes(-1, -2) @ inverse + self._observer @ (np.eye(len(p.V)) - S @ inverse)

    def silent(self, Sigma: Array) -> Array:
        """Return AΣA' + W, the next covariance without a measurement."""
        return symmetrised(self.plant.A @ Sigma @ self.plant.A.T + self.plant.W)

    def queried(self, Sigma: Array, gain: Array) -> Array:
        """Return the next covariance with a measurement, in Joseph's form; (…, n, n)."""
        p = self.plant
        F, turned = p.A - gain @ p.C, gain.swapaxes(-1, -2)
        return symmetrised(F @ Sigma @ F.swapaxes(-1, -2) + gain @ p.V @ turned + p.W)

    def change(self, before: Array, after: Array) -> Array:
        """Return by how much covariances (…, n, n) differ from another, each state measured by its own spread.

        A variance that is small beside the products it is the sum of is measured by these: it may be their rounding.
        """
        spread = np.sqrt(np.maximum(np.diag(after), 0.0))
        unit = np.maximum(spread, 1e-2 * np.abs(self.plant.A) @ spread)
        unit = np.where(unit > 0, unit, 1.0)
        return np.abs((after - before) / unit / unit[:, None]).max(axis=(-2, -1))

    def follow(self, Sigma: Array, query: bool) -> Array:
        """Return the next covariance.

        Raises:
            UnstableError: it overflows.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            following = self.queried(Sigma, self.gain(Sigma)) if query else self.silent(Sigma)
            if not np.isfinite(following @ following).all():
                raise UnstableError(
                    "the error covariance overflows before the sensor is queried; expected a smaller zeta or threshold"
                )
        return following


class QueryValue:
    """h(Σ): what a query now saves of the optimal cost-to-go if the sensor is queried at every later tick.

    h(Σ) = Σ_{s≥0} α^{s+1} tr(P D_s),  D_s = Ric^s(AΣA' + W) − Ric^{s+1}(Σ). Of a finite horizon, P is P_{tick+1+s} and
    the sum ends with it. Nothing is subtracted: the first difference is G(CΣC' + V)G' with the gain G of Σ, and the
    others follow in closed form, of which all that does not depend on Σ is computed once. Where V is singular, or the
    steady covariance does not attract Σ, they are followed tick by tick: D_{s+1} = F(X_s) D_s F(Y_s)' with
    F(X) = A − AXC'(CXC' + V)^{-1}C and X_s and Y_s the two covariances.

    Args:
        predictor: the filter.
        weights: of the estimation error.

    Source: khashooei2017
    """

    def __init__(self, predictor: Predictor, weights: Weights) -> None:
        """Compute what is the same for all covariances."""
        self._predictor, self._weights, self._done = predictor, weights, 0.0
        self._flow = flow(predictor.plant, weights.discount, weights.horizon)
        if self._flow is not None and weights.horizon is None:
            self._weighed = self._flow.weighed(weights.P, weights.discount)

    def __call__(self, Sigma: Array, tick: int = 0) -> float:
        """Return h ≥ 0.

        Args:
            Sigma: covariance of the predicted estimate, (n, n).
            tick: of a finite horizon.

        Raises:
            UnstableError: the sum does not converge: a difference that no later query removes.
        """
        plant, flow = self._predictor.plant, self._flow
        gain = self._predictor.gain(Sigma)
        X, Y = self._predictor.silent(Sigma), self._predictor.queried(Sigma, gain)
        if flow is None or not flow.attracts(np.stack([X, Y])):
            return self._follow(np.stack([X, Y]), symmetrised(gain @ plant.C @ Sigma @ plant.A.T), tick)
        ahead = self._weights.horizon is not None
        weighed = flow.weighed(self._weights.P[tick + 1 :], 1.0) if ahead else self._weighed
        self._count(VALUE + TERM * len(weighed), len(weighed))
        S, total = plant.C @ Sigma @ plant.C.T + plant.V, 0.0
        for begin in range(0, len(weighed), CHUNK):
            ticks = slice(begin, min(begin + CHUNK, len(weighed)))
            left, right = (flow.faded(part, gain, ticks) for part in (X, Y))
            total += float((weighed[ticks] @ left @ S * right).sum())
        return total

    def _count(self, work: float, products: int) -> None:
        """Add up what is done, with products of matrices, and stop where a schedule takes too long."""
        states = self._predictor.plant.states
        self._done += work + products * 2 * states**3
        if self._done > WORK:
            late, expected = "has not repeated", "a horizon"
            if self._weights.horizon is not None:
                late, expected = f"of {self._weights.horizon} ticks has not ended", "a shorter horizon"
            raise UnstableError(
                f"the schedule of queries {late} within about a minute of work for {states} states: errors fade too "
                f"slowly; expected {expected}, fewer states, or noise W and V that let the filter forget sooner"
            )

    def _follow(self, both: Array, D: Array, tick: int) -> float:
        """Return h from X, Y and X − Y on, tick by tick."""
        predictor, alpha, horizon = self._predictor, self._weights.discount, self._weights.horizon
        A, C = predictor.plant.A, predictor.plant.C
        prices = self._weights.P[None] if horizon is None else self._weights.P[tick + 1 :]
        largest = float(np.trace(prices, axis1=-2, axis2=-1).max(initial=0.0))
        total, factor = 0.0, alpha
        for s in range(LONGEST if horizon is None else len(prices)):
            if s % 64 == 0:
                self._count(64 * STEP, 10 * 64)
            P = prices[0 if horizon is None else s]
            total += factor * float((P * D).sum())
            gains = predictor.gain(both)
            F, G = A - gains @ C
            D = symmetrised(F @ D @ G.T)
            factor *= alpha
            if factor * np.abs(D).max() * largest <= NEGLIGIBLE * total:
                return total
            before, both = both, predictor.queried(both, gains)
            if horizon is not None or s % 8 < 7:  # the test costs as much as a term
                continue
            if max(float(predictor.change(*pair)) for pair in zip(before, both, strict=True)) > CONVERGED:
                continue
            if np.abs(F - G).max() <= CONVERGED * max(1.0, float(np.abs(F).max())):
                shrinking = np.sqrt(alpha) * F
                if radius(shrinking) < 1:
                    return total + factor * float((P * summed(shrinking, D)).sum())
            elif alpha * radius(F) * radius(G) >= 1 - APART:  # both stay where they are, and apart
                break
        if horizon is not None:
            return total
        raise UnstableError(
            "the value of a query is not finite: an error that no later query removes; expected a detectable plant, "
            "noise W on every mode on the unit circle or beyond it and noise V on every output, or a discount"
        )


def schedule_queries(plant: Plant, weights: Weights, price: float, initial: Array) -> Schedule:
    """Return the schedule that queries where h(Σ_k) > ζ, from a covariance on, until it repeats or the horizon ends.

    Args:
        plant: A, C, W and V.
        weights: of the estimation error.
        price: ζ ≥ 0.
        initial: Σ_0, (n, n).

    Returns:
        The schedule, with the tick from which it repeats.

    Raises:
        UnstableError: it does not repeat within 100,000 ticks, or never queries an unstable plant.

    Source: khashooei2017
    """
    predictor, horizon = Predictor(plant), weights.horizon
    worth, covariance, value = QueryValue(predictor, weights), [initial], list[float]()
    for tick in range(horizon or LONGEST):
        value.append(worth(covariance[-1], tick))
        covariance.append(predictor.follow(covariance[-1], value[-1] > price))
        cycle = None if horizon is not None else _cycle(predictor, covariance)
        if cycle is not None:
            return _schedule(plant, covariance[: cycle[1]], value[: cycle[1]], price, cycle[0], weights.discount)
    if horizon is None:
        raise UnstableError(
            f"with zeta = {price:g} the schedule of queries does not repeat within {LONGEST} ticks; "
            "expected another zeta, or a horizon"
        )
    return _schedule(plant, covariance[:-1], value, price, None, 1.0)


def schedule_by_variance(plant: Plant, threshold: float) -> Schedule:
    """Return the part that repeats of the schedule that measures where an output is predicted too badly.

    The sensor is queried where max_i (CΣ_kC')_ii > threshold, Σ_k the covariance of the prediction.

    Args:
        plant: A, C, W and V.
        threshold: at least 0.

    Returns:
        The schedule; its value is the largest variance.

    Raises:
        UnstableError: it does not repeat within 100,000 ticks, or never queries an unstable plant.

    Source: trimpe2014
    """
    predictor = Predictor(plant)
    covariance, value = [steady_filter(plant.A, plant.C, plant.W, plant.V).prior], list[float]()
    for _ in range(LONGEST):
        value.append(float(np.diag(plant.C @ covariance[-1] @ plant.C.T).max()))
        covariance.append(predictor.follow(covariance[-1], value[-1] > threshold))
        cycle = _cycle(predictor, covariance)
        if cycle is not None:
            found = _schedule(plant, covariance[: cycle[1]], value[: cycle[1]], threshold, cycle[0], 1.0)
            return found.repeating()
    raise UnstableError(
        f"with threshold = {threshold:g} the schedule of measurements does not repeat within {LONGEST} ticks; "
        "expected another threshold"
    )


def follow_every_query(plant: Plant, initial: Array, horizon: int | None) -> tuple[Array, int | None]:
    """Return the covariances Ric^k(Σ_0) of a sensor queried at every tick, and the tick from which they repeat.

    Args:
        plant: A, C, W and V.
        initial: Σ_0, (n, n).
        horizon: ticks; None: until the covariance has converged.

    Returns:
        (ticks, n, n), and the tick from which on they repeat, or None with a horizon.

    Raises:
        UnstableError: the covariance does not converge within 100,000 ticks.

    Source: khashooei2017
    """
    predictor, covariance = Predictor(plant), [initial]
    for _ in range((horizon or LONGEST) - 1):
        covariance.append(predictor.follow(covariance[-1], True))
        cycle = None if horizon is not None else _cycle(predictor, covariance)
        if cycle is not None:
            return frozen(np.array(covariance[: cycle[1]])), cycle[0]
    if horizon is None:
        raise UnstableError(
            f"the error covariance has not converged within {LONGEST} ticks; "
            "expected noise W on slow modes, a measurement of every mode that does not decay, or a horizon"
        )
    return frozen(np.array(covariance)), None


def _schedule(
    plant: Plant, covariance: Sequence[Array], value: Sequence[float], price: float, start: int | None, discount: float
) -> Schedule:
    values = frozen(np.array(value))
    found = Schedule(values > price, values, frozen(np.array(covariance)), price, start, discount)
    moving = ~resting_states(plant)
    if start is not None and not found.queries[start:].any() and radius(plant.A[np.ix_(moving, moving)]) >= 1:
        raise UnstableError(
            f"at the price or threshold {price:g} the sensor is never queried, and the plant is unstable: nothing "
            "would tell where its state drifts; expected a smaller one, or noise W on the unstable modes"
        )
    return found


def _cycle(predictor: Predictor, covariance: Sequence[Array]) -> tuple[int, int] | None:
    """Return the first tick of the cycle and the one after its last, or None while the last tick is not the mark again.

    The marks are the ticks 0, 1, 3, 7, …: as Brent finds cycles, with one comparison per tick.
    """
    last = len(covariance) - 1
    mark = (1 << last.bit_length() - 1) - 1
    if last == 0 or predictor.change(covariance[mark], covariance[last]) > SAME:
        return None
    period, start = last - mark, mark
    while start > 0 and predictor.change(covariance[start - 1], covariance[start - 1 + period]) <= SAME:
        start -= 1
    return start, start + period
