"""The average cost of a loop with the gains as they are stored, with a proof of its error.

A controller with memory closes the loop around x⁺ = Ax + Bu + w, y = Cx + v. With the state ζ of plant and controller,

    ζ⁺ = F ζ + G w + J v,   u = T ζ + D v,

and the stage cost ζ'Mζ + v'D'RDv, the average cost is tr(PΩ) + tr(D'RDV), with the covariance Ω = GWG' + JVJ' and the
value P = M + F'PF. The matrices of the controller are the doubles that programs hold; A, B, the weights and W are
enclosures of the exact ones, such as those of a sampled plant.

The proof takes any P̃ and any X. If X ≻ 0, X − F'XF ≻ 0, and ε(X − F'XF) ± (M + F'P̃F − P̃) ≻ 0, the loop is stable and
P̃ − εX ⪯ P ⪯ P̃ + εX. Then the cost is tr(P̃Ω) ± ε tr(XΩ), whatever terms of the trace cancel. The precision grows until
the radius is small. States that the cost does not see, by the zeros of the matrices, are left out, and need not decay.

Source: anderson1990optimal, rump2006
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, Protocol, cast

import numpy as np

from taciturn._arrays import NO_VARIANCE, Array, Bits, block_diagonal, symmetrised
from taciturn._cycles import closure
from taciturn._display import Displayed
from taciturn._modes import summed
from taciturn._precision import precision
from taciturn._progress import check_time
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.enclosures import PRECISIONS, Balls, Doubles, E, UnprovedError, block, inner
from taciturn.lqg.intervals import Step
from taciturn.lqg.kalman import Filter
from taciturn.lqg.lyapunov import bounded, total
from taciturn.lqg.riccati import Regulator
from taciturn.lqg.stabilising import ASKED, FEW
from taciturn.model.controller import Controller

SMALL = 16  # most states of plant and controller for which balls are faster than doubles with bounds
MANY = 48  # states of plant and controller above which only doubles with bounds are tried: balls take seconds


class Proved(NamedTuple):
    """A number with a proved bound on its error.

    Args:
        value: the number.
        radius: bound on the distance of the exact number from ``value``.
    """

    value: float
    radius: float

    @property
    def upper(self) -> float:
        """The least double that is proved to be above the exact number."""
        return float(np.nextafter(self.value + self.radius, np.inf))

    @property
    def lower(self) -> float:
        """The largest double that is proved to be below the exact number."""
        return float(np.nextafter(self.value - self.radius, -np.inf))


class Closed(NamedTuple, Generic[E]):
    """Enclosures of a closed loop: ζ⁺ = Fζ + Gw + Jv + Me and u = Tζ + Dv + e; the first states are the plant's."""

    F: E
    G: E
    J: E
    T: E
    D: E
    M: E


class Closing(Protocol):
    """A stored controller, which closes the loop around the exact plant in any arithmetic."""

    def __call__(self, step: Step[E], arithmetic: type[E], /) -> Closed[E]:
        """Return the closed loop."""
        ...


class Valued(NamedTuple, Generic[E]):
    """A stored loop with its proof in one arithmetic.

    Args:
        cost: the average cost per step.
        step: enclosures of the plant and the weights.
        loop: the closed loop.
        states: the states that affect the cost, (ζ,).
        noise: covariance of the noise of these states.
        X: of the proof, for these states.
        falls: X − F'XF, which is definite.
    """

    cost: Proved
    step: Step[E]
    loop: Closed[E]
    states: Bits
    noise: E
    X: E
    falls: E


class Near(NamedTuple):
    """Estimates of a loop with u = L x̂ + e, in doubles.

    Args:
        K: cost-to-go of the states of the plant.
        variances: of the states of the loop, if the errors e cost as much as the rest.
    """

    K: Array
    variances: Array


@dataclass(frozen=True, eq=False, repr=False)
class Stored(Displayed):
    """A controller as it is stored, in a loop with the exact plant; what was proved once is kept.

    Args:
        problem: the discrete-time problem, with an average cost.
        close: closes the loop.
        states: number of states of the loop.
        near: for u = L x̂, estimates of its values and variances.
    """

    problem: Discrete
    close: Closing
    states: int
    near: Near | None = None
    _kept: dict[tuple[type, float], object] = field(default_factory=dict[tuple[type, float], object])

    def attempts(self, patient: bool = False) -> list[tuple[int, bool]]:
        """Return precisions in the order in which they are tried, and whether the arithmetic is that of doubles.

        Args:
            patient: whether balls, which take seconds for many states, are tried for any number of states.
        """
        doubles = [(PRECISIONS[0], True)] if self.states > SMALL else []
        return doubles + [(bits, False) for bits in PRECISIONS if patient or self.states <= MANY]

    def __call__(self, arithmetic: type[E], /) -> Valued[E]:
        """Return the loop and the proof of its cost, in the present precision.

        Raises:
            UnprovedError: the loop is not proved stable.
        """
        key = arithmetic, arithmetic.unit()
        if key not in self._kept:
            self._kept[key] = _valued(self.problem, self.close, self.near, arithmetic)
        return cast("Valued[E]", self._kept[key])

    def cost(self, patient: bool = False) -> Proved | None:
        """Return the average cost per step, or None if it is not proved to nine digits.

        The inter-sample noise cost is not part of it, but the rounding of the stored one is part of the radius. With
        disturbances and set-points, the inputs and states at rest are stored with rounding, on which the cost of a
        state that wanders for ever depends: nothing is proved.

        Args:
            patient: whether balls, which take seconds for many states, are tried for any number of states.
        """
        problem, source = self.problem, self.problem.source
        moves = problem.deviations is not None or (source is not None and source.exosystem is not None)
        for bits, doubles in [] if problem.cost.mission or moves else self.attempts(patient):
            check_time()
            with precision(bits), suppress(UnprovedError), np.errstate(all="ignore"):
                found = (self(Doubles) if doubles else self(Balls)).cost
                if found.radius <= ASKED * found.value:
                    return found
        return None


def filter_loop(problem: Discrete, steady: Filter, regulator: Regulator) -> Stored:
    """Return the loop of u = L x̂ + e with the gains of a regulator and a steady filter.

    The loop has the state ζ = (x, x − x̂⁻) with the prediction x̂⁻, in which the stored model of the plant may differ
    from the exact one by rounding.
    """
    plant = problem.plant

    def close(step: Step[E], arithmetic: type[E]) -> Closed[E]:
        A, B, C, gain, stored = (
            arithmetic.exact(part) for part in (plant.A, plant.B, plant.C, steady.gain, regulator.L)
        )
        one, none = arithmetic.exact(np.eye(plant.states)), arithmetic.exact(np.zeros_like(plant.A))
        left, moves = one - gain @ C, block([[step.B], [step.B - B]])
        T, D = block([[stored, (stored @ left).times(-1.0)]]), stored @ gain
        F = block([[step.A, none], [step.A - A, A @ left]]) + moves @ T
        sensed = block([[arithmetic.exact(np.zeros_like(steady.gain))], [A @ gain]])
        return Closed(F, block([[one], [one]]), moves @ D - sensed, T, D, moves)

    best, noise = plant.A + plant.B @ regulator.L, steady.prior - steady.posterior
    pushed = plant.B @ np.linalg.solve(regulator.H, plant.B.T)
    cost = float(np.trace(problem.Q @ steady.posterior) + np.trace(regulator.K @ noise))
    known, errors = np.diag(summed(best, best @ noise @ best.T + cost * pushed)), np.diag(steady.prior)
    return Stored(problem, close, 2 * plant.states, Near(regulator.K, np.concatenate([known + errors, errors])))


def controller_loop(problem: Discrete, controller: Controller) -> Stored:
    """Return the loop of a linear controller, with every sample.

    The loop has the state ζ = (x, z) with z⁺ = A z + B y + E u, u = C z + D y of the controller.
    """
    plant, c = problem.plant, controller

    def close(step: Step[E], arithmetic: type[E]) -> Closed[E]:
        own, read, applied, shown, D, C = (arithmetic.exact(part) for part in (c.A, c.B, c.E, c.C, c.D, plant.C))
        n, k, p = plant.states, len(c.A), plant.outputs
        if not k:
            T = D @ C
            return Closed(step.A + step.B @ T, arithmetic.exact(np.eye(n)), step.B @ D, T, D, step.B)
        T, moves = block([[D @ C, shown]]), block([[step.B], [applied]])
        F = block([[step.A, arithmetic.exact(np.zeros((n, k)))], [read @ C, own]]) + moves @ T
        J = moves @ D + block([[arithmetic.exact(np.zeros((n, p)))], [read]])
        return Closed(F, arithmetic.exact(np.eye(n + k, n)), J, T, D, moves)

    return Stored(problem, close, plant.states + len(c.A))


def _valued(problem: Discrete, close: Closing, near: Near | None, arithmetic: type[E]) -> Valued[E]:
    step, V = step_of(problem, arithmetic), arithmetic.exact(problem.plant.V)
    loop = close(step, arithmetic)
    n, size = problem.plant.states, loop.F.shape[0]
    at = block([[arithmetic.exact(np.eye(n, size))], [loop.T]])
    M = (at.T @ block([[step.Q, step.N], [step.N.T, step.R]]) @ at).symmetric()
    noise = (loop.G @ step.W @ loop.G.T + loop.J @ V @ loop.J.T).symmetric()
    constant = inner((loop.D.T @ step.R @ loop.D).symmetric(), V)
    keep = closure(  # states that affect the cost, by the zeros of the matrices
        np.asarray((M.most > 0).any(axis=1), dtype=np.bool_), np.asarray(loop.F.most > 0, dtype=np.bool_).T
    )
    F, M, noise = (part if keep.all() else part.part(keep, keep) for part in (loop.F, M, noise))
    P, X, falls, slack = _value(arithmetic, F, M, near if keep.all() else None)
    found, spread = inner(P, noise) + constant, slack * float(inner(X, noise).most.sum())
    noise_cost = 0.0 if problem.exact is None else problem.noise_cost
    rounded = float((step.c - arithmetic.exact(np.array([[noise_cost]]))).most[0, 0])
    cost = Proved(float(found.middle[0, 0]), float(found.radius[0, 0] + spread + rounded) * (1 + 1e-14))
    return Valued(cost, step, loop, keep, noise, X, falls)


def step_of(problem: Discrete, arithmetic: type[E]) -> Step[E]:
    """Return enclosures of the plant and the weights of a step, without those of other parts of the cost."""
    p = problem.plant
    if problem.exact is None:
        A, B, Q, R, N, W, c = map(arithmetic.exact, (*problem.quadratic, p.W, np.zeros((1, 1))))
        return Step(A, B, Q, R, N, W, c)
    if arithmetic is Doubles and p.states <= FEW:  # the balls of the sampling are known
        with precision(PRECISIONS[0]):
            known = problem.exact(Balls)
        A, B, Q, R, N, W, c = (arithmetic.exact(part.middle).widened(part.radius) for part in known)
        return Step(A, B, Q, R, N, W, c)
    return problem.exact(arithmetic)


def _value(arithmetic: type[E], F: E, M: E, near: Near | None) -> tuple[E, E, E, float]:
    """Return P̃, X, X − F'XF and ε of the proof.

    Raises:
        UnprovedError: the proof fails in this precision.
    """
    if arithmetic is Balls and arithmetic.unit() < 2.0 ** -PRECISIONS[0]:
        P = total(arithmetic, F, M)
    else:
        P = arithmetic.exact(_guess(F.middle, M.middle, near))
    size = np.diag(P.middle)
    size = np.maximum(size, arithmetic.unit() ** 0.5 * float(size.max(initial=0.0)) + NO_VARIANCE)
    if near is not None:
        size = size + float(size @ near.variances) / np.maximum(near.variances, NO_VARIANCE)
    missed = (M + F.T @ P @ F - P).symmetric()
    if np.linalg.norm(missed.middle) > np.linalg.norm(missed.radius):
        P = (P + arithmetic.exact(summed(F.middle.T, missed.middle))).centre()
        missed = (M + F.T @ P @ F - P).symmetric()
    return P, *bounded(arithmetic, F, missed, size)


def _guess(F: Array, M: Array, near: Near | None) -> Array:
    """Return about the sum of F'^k M F^k.

    If u = L x̂ with the best gain L, and F = [F₁ G; 0 F₂], the sum is that of K for x and of F₂'^k(M₂ + G'KG)F₂^k for
    the error, without a cross term.
    """
    if near is None:
        return summed(F.T, M)
    n, K = len(near.K), near.K
    across = F[:n, n:]
    return block_diagonal(K, summed(F[n:, n:].T, symmetrised(M[n:, n:] + across.T @ K @ across)))
