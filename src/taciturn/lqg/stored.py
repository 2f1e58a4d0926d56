"""Loops whose gains are rounded to doubles: proofs of their average cost, and of how much the rounding adds.

**Average cost.** A controller with memory closes the loop around x⁺ = Ax + Bu + w, y = Cx + v. With the state ζ of
plant and controller,

    ζ⁺ = F ζ + G w + J v,   u = T ζ + D v,

and the stage cost ζ'Mζ + v'D'RDv, the average cost is tr(PΩ) + tr(D'RDV), with the covariance Ω = GWG' + JVJ' and the
value P = M + F'PF. The matrices of the controller are the doubles that programs hold; A, B, the weights and W are
enclosures of the exact ones, such as those of a sampled plant. The proof takes any P̃ and any X. If X ≻ 0, X − F'XF ≻ 0,
and ε(X − F'XF) ± (M + F'P̃F − P̃) ≻ 0, the loop is stable and P̃ − εX ⪯ P ⪯ P̃ + εX. Then the cost is
tr(P̃Ω) ± ε tr(XΩ), whatever terms of the trace cancel. States that the cost does not see, by the zeros of the matrices,
are left out, and need not decay.

**Cost of silence.** The theorem J ≤ J_all + E[e'He], for inputs u = Lx̂ + e whose error e depends on the measurements so
far, holds for the optimal gains. Let K*, L*, H*, g* be the exact solutions, L and g the stored gains, and x̂* the mean
of the state given the measurements, from which x̂ differs by d = x̂* − x̂. Completion of squares with K* gives

    J ≤ J* + E|e + (L − L*)x̂ − L*d|²   in the norm of H*,

since x − x̂* is independent of the measurements. J* is at most the cost of the stored gains with every sample. So the
rounding adds a = |(L − L*)x̂| and b = |L*d|, root mean squares, to s = |e|:  J ≤ J_all + (s + a + b)².

Both are bounded along the stored loop ζ⁺ = Fζ + noise + Me, ζ = (x, x − x̂⁻), with x̂ = Sζ + gv. If X − F'XF ⪰ X/ν, then
F contracts by √(1 − 1/ν) in the norm of X: |ζ| ≤ √(ν tr(XΩ)) + 2ν|Me|. With the innovation ι* of the exact filter, and
the differences ΔA, ΔB between the exact plant and the stored one,

    d = (I − gC)d⁻ + (g* − g)ι*,   d⁻⁺ = A d + (ΔA + ΔB L)x̂ + ΔB e.

Hence a + b ≤ fixed + slope·s, with numbers of the size of one rounding times the time constants of the loop. If several
sensors filter apart, their sum differs from the stored filter by Δ, which counts as an error LΔ of the input. A trigger
that limits e'He to a share of the stage cost computes this cost from x̂ and stored weights, which are wrong by |d| in
the norm of Q and by the rounding of the weights.

Source: khashooei2017, anderson1990optimal, rump2006
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import sqrt
from typing import Generic, NamedTuple, Protocol, cast

import numpy as np

from taciturn._arrays import NO_VARIANCE, Array, Bits, block_diagonal, symmetrised
from taciturn._display import Displayed
from taciturn._modes import COST_ERROR, ROUNDOFF, closure, summed
from taciturn._progress import check_time
from taciturn._rational import precision
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.enclosures import PRECISIONS, Balls, Doubles, E, UnprovedError, block, inner, solve
from taciturn.lqg.equation import ASKED, FEW, bounded, ranked, total
from taciturn.lqg.kalman import Filter, forgets_the_start
from taciturn.lqg.riccati import Regulator
from taciturn.lqg.sampling import Step
from taciturn.model.controller import Controller

_SMALL = 16  # most states of plant and controller for which balls are faster than doubles with bounds
_MANY = 48  # states of plant and controller above which only doubles with bounds are tried: balls take seconds
_MORE = 1 + 1e-12  # above the rounding of the few sums, products and roots of non-negative numbers
_TRIALS = 40  # doublings of a bound until it is proved
_SQUARINGS = 2  # of a matrix whose norm is sought
_ENOUGH = 1e-8  # what rounding adds, relative to the cost, below which doubles suffice


class Proved(NamedTuple):
    """A computed number with a proven bound on its error."""

    value: float  # the number
    radius: float  # bound on the distance of the exact number from ``value``

    @property
    def upper(self) -> float:
        """A double that is an upper bound on the exact number."""
        return float(np.nextafter(self.value + self.radius, np.inf))

    @property
    def lower(self) -> float:
        """A double that is a lower bound on the exact number."""
        return float(np.nextafter(self.value - self.radius, -np.inf))


class Closed(NamedTuple, Generic[E]):
    """Enclosures of a closed loop ζ⁺ = Fζ + Gw + Jv + Me, u = Tζ + Dv + e. The first entries of ζ are the plant's
    state.
    """

    F: E
    G: E
    J: E
    T: E
    D: E
    M: E


class Closing(Protocol):
    """Function that closes the loop of the exact plant and a controller in doubles, in a given arithmetic."""

    def __call__(self, step: Step[E], arithmetic: type[E], /) -> Closed[E]:
        """Return the closed loop."""
        ...


class Valued(NamedTuple, Generic[E]):
    """A loop whose controller is stored in doubles, and the proof of its cost, computed in one kind of arithmetic."""

    cost: Proved  # the average cost per step
    step: Step[E]  # enclosures of the plant and the weights
    loop: Closed[E]  # the closed loop
    states: Bits  # the states that affect the cost, (ζ,)
    noise: E  # covariance of the noise of these states
    X: E  # of the proof, for these states
    falls: E  # X − F'XF, which is definite


class Near(NamedTuple):
    """Approximate cost-to-go and variances, in doubles, of a loop with u = L x̂ + e."""

    K: Array  # cost-to-go of the states of the plant
    variances: Array  # of the states of the loop, if the errors e cost as much as the rest


@dataclass(frozen=True, eq=False, repr=False)
class Stored(Displayed):
    """A controller as it is stored, rounded to doubles, in a loop with the exact plant. Proofs are kept for reuse."""

    problem: Discrete  # the discrete-time problem, with an average cost
    close: Closing  # closes the loop
    states: int  # number of states of the loop
    near: Near | None = None  # for u = L x̂, estimates of its values and variances
    _kept: dict[tuple[type, float], object] = field(default_factory=dict[tuple[type, float], object])

    def attempts(self, patient: bool = False) -> list[tuple[int, bool]]:
        """Return the precisions to try, in order. Each has a flag that is True for double precision."""
        doubles = [(PRECISIONS[0], True)] if self.states > _SMALL else []
        return doubles + [(bits, False) for bits in PRECISIONS if patient or self.states <= _MANY]

    def __call__(self, arithmetic: type[E], /) -> Valued[E]:
        """Return the loop and the proof of its cost, in the present precision."""
        key = arithmetic, arithmetic.unit()
        if key not in self._kept:
            self._kept[key] = _valued(self.problem, self.close, self.near, arithmetic)
        return cast("Valued[E]", self._kept[key])

    def cost(self, patient: bool = False) -> Proved | None:
        """Compute the average cost per step; return None if it cannot be proved to nine digits."""
        # The inter-sample noise cost is not part of it, but the rounding of the stored one is part of the radius. With
        # disturbances and set-points, the inputs and states at rest are stored with rounding, on which the cost of a
        # state that wanders for ever depends: nothing is proved.
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
    """Return the loop with u = L x̂ + e, where L and the gain of the steady-state filter are rounded to doubles."""
    # The loop has the state ζ = (x, x − x̂⁻) with the prediction x̂⁻, in which the stored model of the plant may differ
    # from the exact one by rounding.
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
    pushed = plant.B @ np.linalg.pinv(regulator.H, hermitian=True) @ plant.B.T  # an input without a cost has no weight
    cost = float(np.trace(problem.Q @ steady.posterior) + np.trace(regulator.K @ noise))
    known, errors = np.diag(summed(best, best @ noise @ best.T + cost * pushed)), np.diag(steady.prior)
    return Stored(problem, close, 2 * plant.states, Near(regulator.K, np.concatenate([known + errors, errors])))


def controller_loop(problem: Discrete, controller: Controller) -> Stored:
    """Return the loop of a linear controller, with matrices rounded to doubles, that sends every sample."""
    # The loop has the state ζ = (x, z) with z⁺ = A z + B y + E u, u = C z + D y of the controller.
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
    step, V = _step_of(problem, arithmetic), arithmetic.exact(problem.plant.V)
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


def _step_of(problem: Discrete, arithmetic: type[E]) -> Step[E]:
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
    """Return P̃, X, X − F'XF and ε of the proof."""
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
    """Return about the sum of F'^k M F^k."""
    # If u = L x̂ with the best gain L, and F = [F₁ G; 0 F₂], the sum is that of K for x and of F₂'^k(M₂ + G'KG)F₂^k for
    # the error, without a cross term.
    if near is None:
        return summed(F.T, M)
    n, K = len(near.K), near.K
    across = F[:n, n:]
    return block_diagonal(K, summed(F[n:, n:].T, symmetrised(M[n:, n:] + across.T @ K @ across)))


class Apart(NamedTuple):
    """Sensors that each have a filter of their own, and the matrices of these filters as rounded to doubles."""

    outputs: Sequence[Sequence[int]]  # the outputs of each sensor that is not at the controller's place
    rest: Array  # about I − gC, (n, n)
    moved: Array  # Ω, about (I − gC)A, (n, n)


class _StageError(NamedTuple):
    """The largest excess of the stage cost of a trigger, from x̂ and stored weights, over the expected stage cost."""

    # If the mean of the true one is y², that of the trigger is at most (y + fixed + slope·s)² + rest + share·s².

    fixed: float
    slope: float
    rest: float
    share: float


class Allowance(NamedTuple):
    """Effect of rounding the gains: J ≤ J_all + (√(1 + excess)·s + fixed + slope·s)², where s² = E[e'He]."""

    excess: float  # ε with H* ⪯ (1 + ε)H, of the exact weight and the stored one
    fixed: float  # root of a cost that rounding adds to silence
    slope: float  # the same in units of the root of the cost of silence
    stage: _StageError  # the error of the stage cost of a trigger

    def within(self, share: float, cost: float) -> bool:
        """Return whether the rounding of the gains adds at most a given share of J_all."""
        fixed = self.fixed * (self.fixed + sqrt(cost)) <= share * cost
        return fixed and max(self.slope, self.excess) <= share

    def raised(self, base: float, silence: float) -> tuple[float, float]:
        """Return a larger J_all, and a factor for the cost of not sending, so that a bound holds despite rounding."""
        s = sqrt(silence)
        added = (self.fixed + self.slope * s) * _MORE
        factor = (1 + self.excess) * (1 + added / s) * _MORE if s > 0 else 1.0
        return (base + added * (added + s)) * _MORE, factor

    def relative(self, base: Proved, theta: float) -> float | None:
        """Return the bound on J if a trigger keeps e'He below θ/(1 + θ) of the stage cost; None without a bound."""
        # With y = √J, y² ≤ J_all + (k·y + h)². If y² is at least half of J_all, the root of the trigger's stage cost is
        # at most y + fixed + slope·s + rest/√(2J_all), besides the share of s².
        stage, share = self.stage, theta / (1 + theta)
        if not base.lower > 0 or share * stage.share >= 1:
            return None
        turn = sqrt(1 - share * stage.share) - sqrt(share) * stage.slope
        along = sqrt(1 + self.excess) + self.slope
        k = along * sqrt(share) / turn * _MORE if turn > 0 else 1.0
        if not k < 1:
            return None
        h = (k * (stage.fixed + stage.rest / sqrt(2 * base.lower)) + self.fixed) * _MORE
        free = (1 - k * k) / _MORE
        return ((k * h + sqrt((k * h) ** 2 + free * (base.upper + h * h))) / free) ** 2 * _MORE


def allowance(
    loop: Stored, regulator: Regulator, steady: Filter, cost: float, apart: Apart | None = None
) -> Allowance | None:
    """Bound how much rounding the gains increases the cost of not sending; None if this is not proved to be small."""
    if not forgets_the_start(loop.problem.plant, loop.problem.exact):
        return None
    found, given = None, (loop, regulator, steady, cost, apart)
    for bits, doubles in loop.attempts():
        if bits > PRECISIONS[1]:
            break
        with precision(bits), suppress(UnprovedError), np.errstate(all="ignore"):
            found = _allowance(Doubles, *given) if doubles else _allowance(Balls, *given)
            if not doubles or found.within(_ENOUGH, cost):  # what balls leave is the rounding of the gains
                break
    return found if found is not None and found.within(COST_ERROR, cost) else None


class _Norm(NamedTuple, Generic[E]):
    """A norm in which a loop contracts: X, 0 outside ``states``, with X − F'XF ⪰ X/ν."""

    X: E  # the square of the norm
    nu: float  # ν
    states: Bits  # the states that it measures, and which the others do not affect

    def of(self, T: E, norm: E) -> float:
        """Return the largest norm of Tζ over all ζ of norm 1. The two norms may differ."""
        seen, states, X = _squared(T, norm), self.states, self.X
        if not states.all():
            if seen.part(~states, slice(None)).most.any():
                raise UnprovedError("the cost gives weight to a state that does not decay")
            seen, X = seen.part(states, states), X.part(states, states)
        return sqrt(_ratio(seen, X))

    def noise(self, covariance: E) -> float:
        """Bound the root mean square of |ζ| if independent noise with the given covariance drives the loop."""
        return sqrt(self.nu * _most(self.X, covariance))

    def driven(self, size: float) -> float:
        """Bound the root mean square of |ζ| if an input with the given root mean square drives the loop."""
        return 2 * self.nu * size  # 1/(1 − √(1 − 1/ν)) is less than 2ν


def _norm(arithmetic: type[E], F: E, variances: Array, seen: Array) -> _Norm[E]:
    """Return a norm for the states of a loop that have an effect on ``seen``."""
    states = closure(np.asarray((seen > 0).any(axis=0), dtype=np.bool_), np.asarray(F.most > 0, dtype=np.bool_).T)
    size = np.where(variances > 0, 1 / np.maximum(variances, NO_VARIANCE), 1.0)[states]
    X, falls = ranked(arithmetic, F.part(states, states), size)
    place, middle, radius = np.ix_(states, states), np.zeros(F.shape), np.zeros(F.shape)
    middle[place], radius[place] = X.middle, X.radius
    return _Norm(arithmetic.exact(middle).widened(radius), _ratio(X, falls), states)


def _allowance(
    arithmetic: type[E],
    stored: Stored,
    regulator: Regulator,
    steady: Filter,
    cost: float,
    apart: Apart | None,
) -> Allowance:
    """Return the bounds, computed in the given arithmetic."""
    problem, plant, exact = stored.problem, stored.problem.plant, arithmetic.exact
    _, step, loop, states, noise, X, falls = stored(arithmetic)
    L, H, g, C, V = map(exact, (regulator.L, regulator.H, steady.gain, plant.C, plant.V))
    worth = exact(regulator.K), exact(regulator.error)
    weight = (step.R + _between(step.B, worth, step.B)).symmetric()
    best = solve(weight, _between(step.B, worth, step.A) + step.N.T).times(-1.0)
    left = exact(np.eye(plant.states)) - g @ C
    S = block([[exact(np.eye(plant.states)), left.times(-1.0)]])
    off, drift = L - best, step.B - exact(plant.B)
    moved = (step.A - exact(plant.A)) + drift @ L  # ΔA + ΔB L

    unlike = _unlike(problem, step, arithmetic)
    used = block([[exact(np.eye(plant.states))], [L]])  # (x̂, û) without e
    if states.all():
        norm = _Norm(X, _ratio(X, falls), states)
    else:  # other states may affect what is seen
        seen = np.concatenate([part.most for part in (off @ S, moved @ S, unlike @ used @ S)])
        noise = (loop.G @ step.W @ loop.G.T + loop.J @ V @ loop.J.T).symmetric()
        norm = _norm(arithmetic, loop.F, np.diag(summed(loop.F.middle, noise.middle)), seen)
    fixed, slope = norm.noise(noise), norm.driven(sqrt(_ratio(_squared(loop.M, norm.X), H)))  # of ζ
    share = norm.of(off @ S, weight)
    a = np.array([share * fixed + _spread(off @ g, weight, V), share * slope])
    share = norm.of(used @ S, unlike)
    far = np.array([share * fixed + _spread(used @ g, unlike, V), share * slope])
    inputs = unlike.part(slice(plant.states, None), slice(plant.states, None))
    rest, squares = 4 * far[0] ** 2, 4 * far[1] ** 2 + 2 * _ratio(inputs, H)
    b = d = np.zeros(2)
    if not plant.full_state:  # otherwise x̂ = x = x̂*
        prior = exact(steady.prior), exact(steady.error)
        innovation = (_between(C.T, prior, C.T) + V).symmetric()
        wrong = g - solve(innovation, _between(C.T, prior, exact(np.eye(plant.states)))).T
        errors = _norm(
            arithmetic, step.A @ left, np.diag(steady.prior), np.concatenate([(best @ left).most, (step.Q @ left).most])
        )
        share = norm.of(moved @ S, errors.X)
        follows = np.array([share * fixed + _spread(moved @ g, errors.X, V), share * slope])
        follows[1] += sqrt(_ratio(_squared(drift, errors.X), H))
        before = np.array([errors.driven(one) for one in follows.tolist()])  # d⁻
        before[0] += _spread(step.A @ wrong, errors.X, innovation) * sqrt(errors.nu)
        b, d = errors.of(best @ left, weight) * before, errors.of(left, step.Q) * before
        b[0] += _spread(best @ wrong, weight, innovation)
        d[0] += _spread(wrong, step.Q, innovation)
        known = left @ prior[0] @ left.T + g @ V @ g.T  # the exact variance is less by those of the error and of g − g*
        most = exact(np.array([[float(np.trace(problem.Q @ steady.posterior))]])) - inner(step.Q, known)
        more = float(most.middle[0, 0] + most.radius[0, 0])
        more += _most(step.Q, (left @ prior[1] @ left.T).symmetric()) + _spread(wrong, step.Q, innovation) ** 2
        rest += max(more, 0.0)
    stage = _StageError(float(d[0]) * _MORE, float(d[1]) * _MORE, float(rest) * _MORE, float(squares) * _MORE)
    excess, root, rise = _ratio(weight - H, H), float(a[0] + b[0]) * _MORE, float(a[1] + b[1]) * _MORE
    if apart is not None and not plant.full_state:
        # e + LΔ in place of e: s' ≤ (s + l₀)/(1 − l₁)
        first, more = _of_contributions(arithmetic, problem, regulator, steady, apart, norm, (fixed, slope))
        along = (sqrt(1 + excess) + rise) / (1 - more)
        root, rise = (root + along * first) * _MORE, (along - sqrt(1 + excess)) * _MORE + ROUNDOFF * 8
    return Allowance(excess, root, rise, stage)


def _of_contributions(
    arithmetic: type[E],
    problem: Discrete,
    regulator: Regulator,
    steady: Filter,
    apart: Apart,
    norm: _Norm[E],
    size: tuple[float, float],
) -> tuple[float, float]:
    """Return l₀ and l₁ of the bound l₀ + l₁·s on the root of E[(LΔ)'H(LΔ)]."""
    plant, exact, every = problem.plant, arithmetic.exact, slice(None)
    A, B, C, V, L, H, g = map(exact, (plant.A, plant.B, plant.C, plant.V, regulator.L, regulator.H, steady.gain))
    one = exact(np.eye(plant.states))
    left, moved = one - g @ C, apart.moved
    turn = left @ A
    wrong, product = exact(apart.rest) - left, exact(moved) - turn
    errors = _norm(  # it contracts along Ω and along the exact product
        arithmetic, turn.widened(np.abs(moved - turn.middle) * _MORE), np.diag(steady.prior), L.most
    )
    parts = np.zeros(2)
    for outputs in apart.outputs:
        chosen = np.isin(np.arange(plant.outputs), outputs)
        gain = g.part(every, chosen)
        measured = block([[gain @ C.part(chosen, every), exact(np.zeros(plant.A.shape))]])
        seen = norm.of(measured, errors.X) * np.array(size)
        seen[0] += _spread(gain, errors.X, V.part(chosen, chosen))
        parts += np.array([errors.driven(part) for part in seen.tolist()])
    S, closed = block([[one, left.times(-1.0)]]), wrong @ (A + B @ L)
    pushed = norm.of(closed @ S, errors.X) * np.array(size)
    pushed += (errors.of(wrong @ A, errors.X) + errors.of(product, errors.X)) * parts
    pushed += [_spread(closed @ g, errors.X, V), sqrt(_ratio(_squared(wrong @ B, errors.X), H))]
    kept = 1 - errors.driven(errors.of(wrong @ A, errors.X))
    if not kept > 0.5:
        raise UnprovedError("the accuracy of the sensors' contributions to the cost could not be proved")
    first, more = (errors.of(L, H) * errors.driven(part) / kept * _MORE for part in pushed.tolist())
    if not more < 0.5:
        raise UnprovedError("the accuracy of the sensors' contributions to the cost could not be proved")
    return first, more


def _unlike(problem: Discrete, step: Step[E], arithmetic: type[E]) -> E:
    """Return a diagonal weight of (x, u) above the difference between the stored and the exact weights."""
    exact, size = arithmetic.exact, sum(problem.plant.B.shape)
    if problem.exact is None:
        return exact(np.zeros((size, size)))
    stored = block([[exact(problem.Q), exact(problem.N)], [exact(problem.N.T), exact(problem.R)]])
    return exact(np.diag((stored - block([[step.Q, step.N], [step.N.T, step.R]])).most.sum(axis=1) * _MORE))


def _between(left: E, solution: tuple[E, E], right: E) -> E:
    """Return left'·X·right for all X between K − error and K + error: |x'ΔKy|² ≤ x'(error)x · y'(error)y."""
    K, error = solution
    sizes = [np.sqrt(np.diag(_squared(part, error).most)) for part in (left, right)]
    return (left.T @ K @ right).widened(np.outer(*sizes) * _MORE)


def _squared(T: E, norm: E) -> E:
    return (T.T @ norm @ T).symmetric()


def _most(one: E, other: E) -> float:
    """Return a bound on the trace of the product of two symmetric matrices."""
    return float(inner(one, other).most[0, 0])


def _spread(T: E, norm: E, covariance: E) -> float:
    """Return a bound on the root mean square of |Tv| for a v of a covariance."""
    return sqrt(_most(_squared(T, norm), covariance))


def _ratio(M: E, D: E) -> float:
    """Return a number for which M ⪯ number·D is proved, near to the least one, and not negative."""
    # It is a root of the trace of a power of D⁻¹M, which is at least the largest eigenvalue.
    if not M.most.any():
        return 0.0
    unit = 1 / np.sqrt(np.maximum(np.diag(D.middle), NO_VARIANCE))
    unit = unit * unit[:, None]
    try:
        power = np.linalg.solve(D.middle * unit, M.middle * unit + np.diag((M.radius * unit).sum(axis=1)))
    except np.linalg.LinAlgError as error:
        raise UnprovedError("a weight is not definite") from error
    size = float(np.linalg.norm(power)) + NO_VARIANCE
    power = power / size
    for _ in range(_SQUARINGS):
        power = power @ power
    trace = max(float(np.vdot(power.T, power)), 0.0)
    ratio = 1.001 * size * trace**2.0 ** -(_SQUARINGS + 1) + 1e-200
    for _ in range(_TRIALS):
        if (D.times(ratio) - M).definite():
            return ratio
        ratio *= 2
    raise UnprovedError("a bound is not proved")
