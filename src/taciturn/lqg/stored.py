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
from typing import Generic, NamedTuple, Protocol

import numpy as np

from taciturn._arrays import NO_VARIANCE, Array
from taciturn._cycles import closure
from taciturn._modes import summed
from taciturn._precision import precision
from taciturn._progress import check_time
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.enclosures import PRECISIONS, Balls, Doubles, E, UnprovedError, block
from taciturn.lqg.intervals import Step, inner
from taciturn.lqg.kalman import Filter
from taciturn.lqg.lyapunov import ranked
from taciturn.lqg.stabilising import ASKED, FEW
from taciturn.model.controller import Controller

MANY = 48  # states of plant and controller above which only doubles with bounds are tried: balls take seconds
TURNS = 80  # doublings of a sum


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
    """Enclosures of a closed loop: ζ⁺ = Fζ + Gw + Jv and u = Tζ + Dv; the first states are those of the plant."""

    F: E
    G: E
    J: E
    T: E
    D: E


class Closing(Protocol):
    """A stored controller, which closes the loop around the exact plant in any arithmetic."""

    def __call__(self, step: Step[E], arithmetic: type[E], /) -> Closed[E]:
        """Return the closed loop."""
        ...


def cost_of_filter(problem: Discrete, steady: Filter, L: Array) -> Proved | None:
    """Return the average cost per step of u = L x̂ with a steady filter, both as stored; None if it is not proved.

    The loop has the state ζ = (x, x − x̂⁻) with the prediction x̂⁻, in which the stored model of the plant may differ
    from the exact one by rounding. The inter-sample noise cost is not part of the cost,
    but the rounding of the stored one is part of the radius.

    Args:
        problem: the discrete-time problem, with an average cost.
        steady: the filter; its gain is used.
        L: gain, (m, n).
    """
    plant = problem.plant

    def close(step: Step[E], arithmetic: type[E]) -> Closed[E]:
        A, B, C, gain, stored = (arithmetic.exact(part) for part in (plant.A, plant.B, plant.C, steady.gain, L))
        one, none = arithmetic.exact(np.eye(plant.states)), arithmetic.exact(np.zeros_like(plant.A))
        left, moves = one - gain @ C, block([[step.B], [step.B - B]])
        T, D = block([[stored, (stored @ left).times(-1.0)]]), stored @ gain
        F = block([[step.A, none], [step.A - A, A @ left]]) + moves @ T
        sensed = block([[arithmetic.exact(np.zeros_like(steady.gain))], [A @ gain]])
        return Closed(F, block([[one], [one]]), moves @ D - sensed, T, D)

    return _proved(problem, close)


def cost_of_controller(problem: Discrete, controller: Controller) -> Proved | None:
    """Return the average cost per step of a linear controller as stored, with every sample; None if it is not proved.

    The loop has the state ζ = (x, z) with z⁺ = A z + B y + E u, u = C z + D y of the controller.
    """
    plant, c = problem.plant, controller

    def close(step: Step[E], arithmetic: type[E]) -> Closed[E]:
        own, read, applied, shown, D, C = (arithmetic.exact(part) for part in (c.A, c.B, c.E, c.C, c.D, plant.C))
        n, k, p = plant.states, len(c.A), plant.outputs
        if not k:
            T = D @ C
            return Closed(step.A + step.B @ T, arithmetic.exact(np.eye(n)), step.B @ D, T, D)
        T, moves = block([[D @ C, shown]]), block([[step.B], [applied]])
        F = block([[step.A, arithmetic.exact(np.zeros((n, k)))], [read @ C, own]]) + moves @ T
        J = moves @ D + block([[arithmetic.exact(np.zeros((n, p)))], [read]])
        return Closed(F, arithmetic.exact(np.eye(n + k, n)), J, T, D)

    return _proved(problem, close)


def _proved(problem: Discrete, close: Closing) -> Proved | None:
    """Return the proved average cost of a stored loop, or None.

    With disturbances and set-points, the inputs and states at rest are stored with rounding, on which the cost of a
    state that wanders for ever depends: nothing is proved.
    """
    source = problem.source
    if problem.cost.mission or problem.deviations is not None or (source is not None and source.exosystem is not None):
        return None
    found: Proved | None = None
    with suppress(UnprovedError), np.errstate(all="ignore"):
        found = _cost(problem, close, Doubles)
        if found.radius <= ASKED * found.value:
            return found
    for bits in PRECISIONS:
        check_time()
        with precision(bits), suppress(UnprovedError), np.errstate(all="ignore"):
            better = _cost(problem, close, Balls)
            found = better if found is None or better.radius < found.radius else found
        if found is not None and found.radius <= ASKED * found.value:
            return found
    return None


def _cost(problem: Discrete, close: Closing, arithmetic: type[E]) -> Proved:
    """Return the average cost of a stored loop in one arithmetic.

    Raises:
        UnprovedError: the loop is not proved stable, or has too many states for balls.
    """
    step, V = _step(problem, arithmetic), arithmetic.exact(problem.plant.V)
    loop = close(step, arithmetic)
    n, size = problem.plant.states, loop.F.shape[0]
    if size > MANY and arithmetic is Balls:
        raise UnprovedError("the loop has too many states for balls")
    at = block([[arithmetic.exact(np.eye(n, size))], [loop.T]])
    M = (at.T @ block([[step.Q, step.N], [step.N.T, step.R]]) @ at).symmetric()
    noise = (loop.G @ step.W @ loop.G.T + loop.J @ V @ loop.J.T).symmetric()
    constant = inner((loop.D.T @ step.R @ loop.D).symmetric(), V)
    keep = closure(  # states that affect the cost, by the zeros of the matrices
        np.asarray((M.most > 0).any(axis=1), dtype=np.bool_), np.asarray(loop.F.most > 0, dtype=np.bool_).T
    )
    F, M, noise = (part.part(keep, keep) for part in (loop.F, M, noise))
    if keep.any():
        P, X, slack = _value(arithmetic, F, M)
        spread = slack * float(inner(X, noise).most[0, 0])
        found = inner(P, noise) + constant
    else:
        spread, found = 0.0, constant
    noise_cost = 0.0 if problem.exact is None else problem.noise_cost
    rounded = float((step.c - arithmetic.exact(np.array([[noise_cost]]))).most[0, 0])
    return Proved(float(found.middle[0, 0]), float(found.radius[0, 0] + spread + rounded) * (1 + 1e-14))


def _step(problem: Discrete, arithmetic: type[E]) -> Step[E]:
    """Return enclosures of the plant and the weights of a step, without those of other parts of the cost."""
    p = problem.plant
    if problem.exact is None:
        A, B, Q, R, N, W, c = map(arithmetic.exact, (*problem.quadratic, p.W, np.zeros((1, 1))))
        return Step(A, B, Q, R, N, W, c)
    if arithmetic is Doubles and p.states <= FEW:  # the balls of the sampling are known
        with precision(PRECISIONS[0]):
            known = problem.exact(Balls)
        A, B, Q, R, N, W, c = (arithmetic.enclosing(part.middle, part.radius) for part in known)
        return Step(A, B, Q, R, N, W, c)
    return problem.exact(arithmetic)


def _value(arithmetic: type[E], F: E, M: E) -> tuple[E, E, float]:
    """Return P̃, X and ε of the proof.

    Raises:
        UnprovedError: the proof fails in this precision.
    """
    P = _candidate(arithmetic, F, M)
    size = np.diag(P.middle)
    size = np.maximum(size, arithmetic.unit() ** 0.5 * float(size.max(initial=0.0)) + NO_VARIANCE)
    X, falls = ranked(arithmetic, F, size)
    missed = (M + F.T @ P @ F - P).symmetric()
    unit = 1 / np.sqrt(size)
    slack = 4 * float((missed.most * unit * unit[:, None]).sum(axis=1).max(initial=0.0)) + 1e-200
    if not ((falls.times(slack) - missed).definite() and (falls.times(slack) + missed).definite()):
        raise UnprovedError("the cost of the loop is not proved")
    return P, X, slack


def _candidate(arithmetic: type[E], F: E, M: E) -> E:
    """Return about the sum of F'^k M F^k, without radii."""
    if arithmetic is Doubles:
        P = arithmetic.exact(summed(F.middle.T, M.middle))
        missed = (M + F.T @ P @ F - P).symmetric().middle
        return (P + arithmetic.exact(summed(F.middle.T, missed))).centre()
    P, power = M.centre(), F.centre()
    for _ in range(TURNS):
        more = (power.T @ P @ power).symmetric()
        P = (P + more).centre()
        if not np.isfinite(P.middle).all():
            break
        if np.abs(more.middle).max(initial=0.0) <= arithmetic.unit() * np.abs(np.diag(P.middle)).max(initial=0.0):
            return P
        power = (power @ power).centre()
    raise UnprovedError("the loop is not stable")
