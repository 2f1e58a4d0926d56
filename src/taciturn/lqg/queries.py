"""When to query a sensor: the value of a measurement to the controller, and the schedule it leads to."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, frozen, symmetrised
from taciturn._modes import radius, summed
from taciturn.errors import UnstableError
from taciturn.lqg import _dare
from taciturn.lqg.kalman import steady_filter
from taciturn.model.plant import Plant
from taciturn.model.schedule import Schedule

NEGLIGIBLE = 1e-14  # share of a sum that its last term may add
CONVERGED = 1e-11  # relative change of a covariance from which on the map of differences is constant
SAME = 1e-11  # relative difference of covariances that count as the same place of a cycle
LONGEST = 100_000  # ticks within which a schedule must repeat
BATCH = 64  # values of queries that are summed at once


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
        self.plant, self._noisy = plant, _dare.is_definite(plant.V)
        self._observer = np.zeros((plant.states, plant.outputs))
        if not self._noisy:
            with suppress(UnstableError):
                self._observer = plant.A @ steady_filter(plant.A, plant.C, plant.W, plant.V).gain

    def gain(self, Sigma: Array) -> Array:
        """Return AΣC'(CΣC' + V)^{-1}, (…, n, p).

        Where CΣC' + V is singular, outputs are known in advance: in these directions any gain is optimal, and that of a
        stable observer is taken, which also forgets what rounding and the start have put there.
        """
        p = self.plant
        seen = p.C @ Sigma
        if self._noisy:
            turned = np.linalg.solve(seen @ p.C.T + p.V, seen @ p.A.T)
            return np.asarray(turned.swapaxes(-1, -2), dtype=np.float64)
        prices = [_dare.price(p.C.T, one, p.V) for one in Sigma.reshape(-1, *Sigma.shape[-2:])]
        S, inverse = (np.reshape(part, (*Sigma.shape[:-2], *p.V.shape)) for part in zip(*prices, strict=True))
        return p.A @ seen.swapaxes(-1, -2) @ inverse + self._observer @ (np.eye(len(p.V)) - S @ inverse)

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
                    "the error covariance overflows before a query is worth its price; expected a smaller zeta"
                )
        return following


def query_value(predictor: Predictor, Sigma: Array, weights: Weights, tick: int = 0) -> float:
    """Return h(Σ): what a query now saves of the optimal cost-to-go if the sensor is queried at every later tick.

    h(Σ) = Σ_{s≥0} α^{s+1} tr(P D_s),  D_s = Ric^s(AΣA' + W) − Ric^{s+1}(Σ). The differences are never subtracted: they
    obey D_{s+1} = F(X_s) D_s F(Y_s)' with F(X) = A − AXC'(CXC' + V)^{-1}C, X_s and Y_s the two covariances. Once these
    have converged the rest is the solution of a Lyapunov equation. Of a finite horizon, P is P_{tick+1+s} and the sum
    ends with it.

    Args:
        predictor: the filter.
        Sigma: covariance of the predicted estimate, (n, n).
        weights: of the estimation error.
        tick: of a finite horizon.

    Returns:
        h(Σ) ≥ 0.

    Raises:
        UnstableError: the sum does not converge: a difference that no later query removes.

    Source: khashooei2017
    """
    return float(_query_values(predictor, Sigma[None], weights, tick)[0])


def _query_values(predictor: Predictor, Sigma: Array, weights: Weights, tick: int) -> Array:
    """Return h of the covariances of ticks that follow one another, (ticks, n, n), all sums at once."""
    A, C = predictor.plant.A, predictor.plant.C
    gain = predictor.gain(Sigma)
    both = np.stack([predictor.silent(Sigma), predictor.queried(Sigma, gain)])  # X and Y
    D = gain @ C @ Sigma @ A.T
    alpha, total, factor = weights.discount, np.zeros(len(Sigma)), weights.discount
    horizon, n = weights.horizon, len(A)
    prices = weights.P[None] if horizon is None else np.concatenate([weights.P, np.zeros((1, n, n))])
    largest = float(np.trace(prices, axis1=-2, axis2=-1).max())
    now = tick + 1 + np.arange(len(Sigma))
    for s in range(LONGEST if horizon is None else horizon - tick):
        P = prices[0] if horizon is None else prices[np.minimum(now + s, horizon)]
        total += factor * (P * D).sum(axis=(1, 2))
        gains = predictor.gain(both)
        F, G = A - gains @ C
        D = symmetrised(F @ D @ G.swapaxes(-1, -2))
        factor *= alpha
        if (factor * np.abs(D).max(axis=(1, 2)) * largest <= NEGLIGIBLE * total).all():
            return total
        before, both = both, predictor.queried(both, gains)
        if horizon is not None or s % 8 < 7:  # the test costs as much as a term
            continue
        if max(predictor.change(*pair).max() for pair in zip(before[:, -1:], both[:, -1], strict=True)) <= CONVERGED:
            shrinking = np.sqrt(alpha) * F[-1]
            others = max(float(np.abs(part - F[-1]).max()) for part in (F, G)) <= CONVERGED * max(1.0, np.abs(F).max())
            if others and radius(shrinking) < 1:
                return total + factor * np.array([np.sum(P * summed(shrinking, part)) for part in D])
    if horizon is not None:
        return total
    raise UnstableError(
        "the value of a query is not finite: an error that no later query removes; expected a detectable plant whose "
        "noise reaches every mode on the unit circle, or a discount"
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
    covariance, value = [initial], list[float]()
    last, batch = horizon or LONGEST, 1
    while len(value) < last:
        # The covariances of a silence are known before the values that may end it: many sums at once are faster.
        silence = [covariance[-1]]
        while len(silence) < min(batch, last - len(value)):
            silence.append(predictor.follow(silence[-1], False))
        batch = min(2 * batch, BATCH)
        for Sigma, found in zip(silence, _query_values(predictor, np.array(silence), weights, len(value)), strict=True):
            value.append(float(found))
            covariance.append(predictor.follow(Sigma, value[-1] > price))
            cycle = None if horizon is not None else _cycle(predictor, covariance)
            if cycle is not None:
                return _schedule(plant, covariance[: cycle[1]], value[: cycle[1]], price, cycle[0])
            if value[-1] > price:
                batch = 1
                break
    if horizon is None:
        raise UnstableError(
            f"with zeta = {price:g} the schedule of queries does not repeat within {LONGEST} ticks; "
            "expected another zeta, or a horizon"
        )
    return _schedule(plant, covariance[:-1], value, price, None)


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
            "expected noise W on slow modes, or a horizon"
        )
    return frozen(np.array(covariance)), None


def _schedule(
    plant: Plant, covariance: Sequence[Array], value: Sequence[float], price: float, start: int | None
) -> Schedule:
    values = frozen(np.array(value))
    found = Schedule(values > price, values, frozen(np.array(covariance)), price, start)
    if start is not None and not found.rate and radius(plant.A) >= 1:
        raise UnstableError(
            f"with zeta = {price:g} the sensor is never queried, and the plant is unstable: nothing would tell where "
            "its state drifts; expected a smaller zeta, or noise W on the unstable modes"
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
