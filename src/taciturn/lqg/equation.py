"""Solvers for Riccati and Lyapunov equations. Each solution has a proven error bound.

**Sums** X = Σ F^k W F'^k. Let X̂ be a candidate by repeated squaring, and Y the sum of F^k D F'^k for a diagonal D ≻ 0.
If Y ≻ 0 and P = Y − FYF' ≻ 0, F is stable. If for a number ε also −εP ≺ FX̂F' + W − X̂ ≺ εP, the sum lies between
X̂ − εY and X̂ + εY. The proof holds for every F and W within one rounding of the given ones, such as the closed loop
A + BL that was computed in doubles.

**Riccati equations.** The sum of x'Qx + u'Ru + 2x'Nu along x⁺ = Ax + Bu is to be minimised with A + BL stable.

A candidate K, L follows by structured doubling from a small definite terminal weight, in double precision or in balls.
The small weight lets the doubling converge to the stabilising solution also if the cost does not see an unstable mode.
Newton's method corrects it.

The proof uses enclosures of A, B, Q, R and N. Let F = A + BL, M = Q + NL + L'N' + L'RL, and X the sum of F'^k D F^k for
a diagonal D ≻ 0, with P = X − F'XF. If X ≻ 0 and P ≻ 0, F is stable. If for a number ε

    εP − (M + F'KF − K) ≻ 0,                       so that the gain L costs at most K + εX, and

    [ εP + (M + F'KF − K)   g' − εF'XB ]
    [ g − εB'XF             R + B'(K − εX)B ] ≻ 0,   g = RL + N' + B'KF,

then H = K − εX satisfies H ≺ Ric(H), so that no stabilising gain costs less. Hence the stabilising solution exists, and
it lies between K − εX and K + εX. This holds for every method that finds K and L, and for the matrices as they were
given: each is an enclosure of the exact one, such as the matrix of a sampled plant.

The proof takes the gain as it is stored, rounded to doubles. If that fails, it takes the gain with all digits, and the
solution says that its gain is not held by doubles. The precision grows until the error is small enough.

In continuous time, the midpoint rule x⁺ − x = h(Ax̄ + Bu), x̄ = (x + x⁺)/2, with the cost h(x̄'Qx̄ + u'Ru + 2x̄'Nu) has
the same stabilising solution for every step h (Cayley's transform), so its proof is that of continuous time.

Source: anderson1978, lancaster1995
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from math import log2
from typing import Generic, NamedTuple, Protocol

import numpy as np

from taciturn import _arrays
from taciturn._arrays import NO_VARIANCE, Array, ArrayLike, Bits, is_definite, symmetrised
from taciturn._display import Displayed
from taciturn._modes import COST_ERROR, closure, eigenvalues, pace, radius, root, summed
from taciturn._progress import check_time
from taciturn._rational import Limit, is_semidefinite, modes_of, precision, rational
from taciturn.errors import UnstableError
from taciturn.lqg.enclosures import PRECISIONS, UNIT, Balls, Doubles, E, UnprovedError, block, solve
from taciturn.lqg.quadratic import Before, Free, Quadratic, Span, Worth, free_inputs, in_powers_of_two, worth_of

FEW = 10  # most states for which balls are faster than doubles with bounds
ASKED = 1e-9  # relative error of the cost-to-go of each state to which a solution is proved
_CRUMB = 2 / 3  # part of the digits up to which a cost-to-go next to the terms of its sum has a size of its own
_LAST = 1e-6  # terminal weight of the doubling, relative to the cost of moving a state
_TURNS = 100  # doublings
_CORRECTIONS = 2  # steps of Newton's method
_FAST = 10.0  # growth within a step from which on it is named as a reason
_CLEAR, _SQUARINGS = 1 - 1e-6, 52  # modulus from which on it is computed from powers, and their number


def accumulate(F: ArrayLike, W: ArrayLike) -> Array:
    """Compute X = Σ_k F^k W F'^k, the solution of the Lyapunov equation X = F X F' + W."""
    # Repeated squaring: X ← X + F X F', F ← F². The error of each variance is proved to be at most 1e-6.
    F = _arrays.square("F", F)
    W = _arrays.symmetric("W", W, F.shape[0])
    if radius(F) >= 1:
        lasting = modes_of(rational(F), Limit(False)).lasting
        if lasting.size:
            raise UnstableError(
                f"F has the eigenvalue {Limit(False).named(complex(lasting[0]))}, so the sum Σ F^k W F'^k diverges; "
                "expected all eigenvalues inside the unit circle: stabilise the loop first"
            )
        raise UnstableError(
            "F is stable, but rounding its entries can make it unstable, so no bound on the error of the sum Σ F^k W "
            "F'^k can be proved; expected a larger stability margin"
        )
    return _arrays.frozen(stationary(F, W))


def stationary(F: Array, W: Array) -> Array:
    """Compute Σ_k F^k W F'^k for a stable F and a semidefinite W, with a proven bound on the error."""
    X = summed(F, W)
    if not np.isfinite(X).all():
        raise UnstableError(
            "the sum Σ F^k W F'^k overflows: F is stable, but its powers first grow too large; scale the states"
        )
    moving = closure(np.asarray(W.any(axis=1), dtype=np.bool_), np.asarray(F != 0, dtype=np.bool_))
    place = np.ix_(moving, moving)
    if moving.any():
        X[place] = _proved_sum(F[place], W[place], X[place])
    return X


def _proved_sum(F: Array, W: Array, X: Array) -> Array:
    """Return the sum after the proof of its error, in doubles or in balls."""
    try:
        return _judged(Doubles, F, W, X)
    except UnprovedError:
        with precision(PRECISIONS[0]):
            try:
                return _judged(Balls, F, W, X)
            except UnprovedError as error:
                raise UnstableError(
                    f"the sum Σ F^k W F'^k could not be proved to have a relative error of at most {COST_ERROR:.0e}: "
                    f"{error}; F has an eigenvalue at a distance of {1 - radius(F):.1e} inside the unit circle, and "
                    "the powers of F decay too slowly, or grow too large before they decay; expected a larger "
                    "stability margin"
                ) from None


def _judged(arithmetic: type[E], F: Array, W: Array, X: Array) -> Array:
    size = np.where(np.diag(X) > NO_VARIANCE, np.diag(X), 1.0)
    step, noise = (arithmetic.exact(part).widened(UNIT * np.abs(part)) for part in (F, W))
    for _ in range(2):
        found = arithmetic.exact(X)
        missed = (step @ found @ step.T + noise - found).symmetric()
        Y, _, slack = bounded(arithmetic, step.T, missed, size)
        if slack * float(np.mean(np.diag(Y.middle) / size)) <= COST_ERROR:
            return X
        X = X + summed(F, missed.middle)
    raise UnprovedError("the rounding errors in the sum leave too large a residual in its Lyapunov equation")


def bounded(arithmetic: type[E], F: E, missed: E, size: Array) -> tuple[E, E, float]:
    """Return X, X − F'XF and ε such that −εX ⪯ Σ F'^k M F^k ⪯ εX. M is the residual of a computed Lyapunov solution."""
    X, falls = ranked(arithmetic, F, size)
    slack = 4 * relative(missed, size)
    if not ((falls.times(slack) - missed).definite() and (falls.times(slack) + missed).definite()):
        raise UnprovedError("no bound on the error of a sum along the closed loop could be proved")
    return X, falls, slack


def sizes(A: Array, Q: Array, K: Array, crumb: float) -> Array:
    """Return a scale for each state: its diagonal entry of K, but at least a fraction of the terms in its sum."""
    diagonal = np.diag(K)
    size = np.maximum(diagonal, crumb * (np.abs(np.diag(Q)) + (A * A).T @ np.abs(diagonal)))
    return np.where(size > NO_VARIANCE, size, 1.0)


def relative(form: E, size: Array) -> float:
    """Bound the form x'Mx by a positive multiple of the diagonal form with the entries ``size``; return the
    multiple.
    """
    unit = 1 / np.sqrt(size)
    return max(float((form.most * unit * unit[:, None]).sum(axis=1).max(initial=0.0)), 1e-200)


def ranked(arithmetic: type[E], F: E, size: Array) -> tuple[E, E]:
    """Compute X ≈ Σ F'^k D F^k for a diagonal D; return X and X − F'XF, both proved to be positive definite."""
    with np.errstate(all="ignore"):
        rough = summed(F.middle.T, np.diag(size))
    if np.isfinite(rough).all():
        X = arithmetic.exact(rough)
        falls = (X - F.T @ X @ F).symmetric()
        if falls.definite() and X.definite():
            return X, falls
    if arithmetic is Balls:  # double precision does not suffice for the sum
        X = total(arithmetic, F, arithmetic.exact(np.diag(size)))
        falls = (X - F.T @ X @ F).symmetric()
        if falls.definite() and X.definite():
            return X, falls
    raise UnprovedError("the stability of the closed loop could not be proved")


def total(arithmetic: type[E], F: E, M: E) -> E:
    """Approximate Σ F'^k M F^k without error bounds. Each iteration doubles the number of terms."""
    found, power = M.centre(), F.centre()
    for _ in range(_TURNS):
        more = (power.T @ found @ power).symmetric()
        found = (found + more).centre()
        if not np.isfinite(found.middle).all():
            break
        if np.abs(more.middle).max(initial=0.0) <= arithmetic.unit() * np.abs(np.diag(found.middle)).max(initial=0.0):
            return found
        power = (power @ power).centre()
    raise UnprovedError("the powers of the closed-loop matrix do not decay")


class Equation(NamedTuple, Generic[E]):
    """Enclosures of the matrices of a regulator problem: dynamics (A, B), and weights [[Q, N], [N', R]]."""

    A: E
    B: E
    Q: E
    R: E
    N: E

    def under(self, L: E) -> tuple[E, E]:
        """Return A + BL and the weight of the state in the stage cost, if the input is u = L x."""
        pushed = self.N @ L
        return self.A + self.B @ L, (self.Q + pushed + pushed.T + L.T @ self.R @ L).symmetric()


class Recipe(Protocol):
    """Function that computes the matrices of a problem in an arithmetic of any precision, for example by sampling."""

    def __call__(self, arithmetic: type[E], /) -> Equation[E]:
        """Return enclosures of the matrices."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Solution(Displayed):
    """Stabilising solution of a Riccati equation, with a proven bound on its error."""

    K: Array  # cost-to-go, (n, n)
    L: Array  # gain, u = L x, (m, n)
    H: Array  # weight R + B'KB of a deviation from the optimal input, or R in continuous time, (m, m)
    error: Array  # (n, n) with −error ⪯ K − exact ⪯ error
    correction: Array  # H⁻¹B'K; for the dual problem of a filter, the transposed gain of its correction, (m, n)
    free: bool  # whether inputs cost nothing, so that H is singular
    lacking: str  # why the bound does not hold for the cost of the gain as it is stored, in doubles
    slowest: float  # modulus of the slowest mode of A + BL, or its real part in continuous time


@dataclass(frozen=True, eq=False, repr=False)
class Problem(Displayed):
    """The problem of a regulator or a filter, which is solved by a Riccati equation."""

    given: Quadratic  # its matrices in double precision, whose zeros show its structure
    recipe: Recipe  # its matrices in any arithmetic
    continuous: bool = False  # whether time is continuous
    sampled: bool = False  # whether the recipe has more digits than doubles
    dual: bool = False  # whether the gain that is stored is H⁻¹B'K, of a filter, and not L
    before: Before | None = None  # the problem before it was sampled, if it is known; its modes are exact

    @cached_property
    def step(self) -> float:
        """Step size of the midpoint rule in continuous time: a power of two, so small that no mode changes much in a
        step.
        """
        _, B, Q, R, _ = self.given
        asked = np.sqrt(np.maximum(np.diag(B.T @ Q @ B), 0.0) / np.maximum(np.diag(R), NO_VARIANCE))
        fastest = max(pace(self.given.A), float(asked.max(initial=0.0)))  # of an integrator, how fast inputs move it
        return float(np.exp2(-np.ceil(np.log2(fastest if fastest > NO_VARIANCE else 1.0))))

    @cached_property
    def worth(self) -> Worth:
        """Partition of the states: those with a cost-to-go, for which the equation is solved, and the others."""
        return worth_of(self.given, self.continuous, self.sampled, self.before)

    def solve(self) -> Solution:
        """Compute the stabilising solution of the Riccati equation."""
        worth = self.worth
        if worth.states.all():
            return self._solved()
        found, to = self.among(worth.states)._solved(), np.eye(len(worth.states))[:, worth.states]
        others = worth.decaying.real if self.continuous else np.abs(worth.decaying)
        return replace(
            found,
            K=to @ found.K @ to.T,
            L=found.L @ to.T,
            error=to @ found.error @ to.T,
            correction=found.correction @ to.T,
            slowest=max(found.slowest, float(others.max(initial=-np.inf))),
        )

    def among(self, states: Bits) -> Problem:
        """Restrict the problem to a subset of the states. The remaining states must not depend on the others."""
        every, recipe = slice(None), self.recipe

        def restricted(arithmetic: type[E]) -> Equation[E]:
            A, B, Q, R, N = recipe(arithmetic)
            return Equation(
                A.part(states, states), B.part(states, every), Q.part(states, states), R, N.part(states, every)
            )

        before = self.before and (self.before[0].among(states), self.before[1])
        return replace(self, given=self.given.among(states), recipe=restricted, before=before)

    def _solved(self) -> Solution:
        try:
            return self._proved(PRECISIONS[:1], len(self.given.A) > FEW)
        except UnprovedError:
            definite = self.continuous or is_definite(self.given.R)
        weight = np.block([[self.given.Q, self.given.N], [self.given.N.T, self.given.R]])
        free = None if definite else free_inputs(self.given, rational(weight))
        if free is not None:
            return self._without(free)
        try:
            return self._proved(PRECISIONS[1:], False)
        except UnprovedError:
            # A weight of low rank may be semidefinite only up to the rounding of its entries.
            rows = root(weight).T  # its square may have a solution although a semidefinite weight itself has none
            if len(rows) == len(weight) or (self.sampled and definite):
                raise
            if not self.sampled and is_semidefinite(weight):
                raise
        squared, free = self._squared(rows), None if definite else free_inputs(self.given, rational(rows))
        return squared._proved(PRECISIONS, False) if free is None else squared._without(free)

    def _squared(self, rows: Array) -> Problem:
        """Return the problem whose weight is the square of rows, a change of the given weight below its rounding."""
        n, recipe = len(self.given.A), self.recipe
        x, u = slice(n), slice(n, None)

        def squared(arithmetic: type[E]) -> Equation[E]:
            A, B, *_ = recipe(arithmetic)
            D = arithmetic.exact(rows)
            M = (D.T @ D).symmetric()
            return Equation(A, B, M.part(x, x), M.part(u, u), M.part(x, u))

        return replace(self, recipe=squared)

    def _proved(self, precisions: Sequence[int], doubles: bool) -> Solution:
        """Return the solution with a proof in one of the precisions, or in double precision."""
        reason: UnprovedError | None = None
        if doubles:
            try:
                return self._from_doubles(Doubles)
            except UnprovedError as error:
                reason = error
        for bits in precisions:
            check_time()
            with precision(bits):
                if bits == PRECISIONS[0]:
                    with suppress(UnprovedError):
                        return self._from_doubles(Balls)
                try:
                    raw = self.recipe(Balls)
                    stepped = self._stepped(Balls, raw)
                    return self._judged(Balls, raw, stepped, _doubled(stepped, bits))
                except UnprovedError as error:
                    reason = error
        assert reason is not None, "at least one precision"
        raise reason

    def _stepped(self, arithmetic: type[E], raw: Equation[E]) -> Equation[E]:
        """Return the problem in steps: itself, or in continuous time that of the midpoint rule."""
        if not self.continuous:
            return raw
        A, B, Q, R, N = raw
        h, one = self.step, arithmetic.exact(np.eye(len(self.given.A)))
        Z = solve(one - A.times(h / 2), one)
        # x̄ = Z x + Y u, the mean of the states before and after a step
        moved = Z @ B
        Y, onto = moved.times(h / 2), Q @ Z
        across = (onto.T @ Y + Z.T @ N).times(h)
        side = Y.T @ N
        price = (Y.T @ Q @ Y + side + side.T + R).symmetric().times(h)
        return Equation(Z.times(2.0) - one, moved.times(h), (Z.T @ onto).symmetric().times(h), price, across)

    def _without(self, free: Free) -> Solution:
        """Return the solution of a problem with inputs that cost nothing: that of the other states and inputs."""
        n, rest, given, recipe = len(self.given.A), ~free.places, self.given, self.recipe
        T, keeping, moving = (Doubles.rational(one).middle for one in (free.inside, free.keeping, free.moving))
        others, every = np.eye(given.B.shape[1])[:, free.others], slice(None)

        def reduced(arithmetic: type[E]) -> Equation[E]:
            A, B, Q, R, N = recipe(arithmetic)
            inside = arithmetic.rational(free.inside).part(rest, every)
            beside, among = B.part(every, free.others), A.part(every, rest)

            def outside(values: E) -> E:  # the coordinates e of a state
                return values.part(rest, every) - inside @ values.part(free.places, every)

            return Equation(
                outside(among), outside(beside), Q.part(rest, rest), R.part(free.others, free.others),
                N.part(rest, free.others),
            )  # fmt: skip

        rough = Quadratic(*(part.middle for part in reduced(Doubles)))
        found = replace(self, given=rough, recipe=reduced).solve()
        onto = np.zeros((int(rest.sum()), n))
        onto[:, rest] = np.eye(len(onto))
        onto[:, free.places] = -T[rest]
        a, r, w = free.places, T.shape[1], moving.shape[1]
        inner = (given.A @ T + given.B @ keeping)[a], (given.B @ moving)[a]
        L, slowest = others @ found.L @ onto, found.slowest
        if r:
            own = exactly(Quadratic(*inner, np.eye(r), np.eye(w), np.zeros((r, w))))
            steady = Problem(*own).solve()
            L[:, a] += keeping + moving @ steady.L
            slowest = max(slowest, steady.slowest)
        K = symmetrised(onto.T @ found.K @ onto)
        H = symmetrised(given.R + given.B.T @ K @ given.B)
        correction = others @ found.correction @ onto
        return Solution(K, L, H, symmetrised(onto.T @ found.error @ onto), correction, True, found.lacking, slowest)

    def _from_doubles(self, arithmetic: type[E]) -> Solution:
        """Return the proved solution whose candidate is computed in doubles, and corrected with the enclosures."""
        raw = self.recipe(arithmetic)
        given = self._stepped(arithmetic, raw)
        A, B, Q, R, N = (part.middle for part in given)
        state, unit = _units(A, B, Q, R)
        with np.errstate(all="ignore"):
            A, B, Q = A * state / state[:, None], B * unit / state[:, None], Q * state * state[:, None]
            R, N = R * unit * unit[:, None], N * unit * state[:, None]
            last = _last(B, Q, R) * np.eye(len(A))
            try:
                inverse = np.asarray(np.linalg.inv(symmetrised(R + B.T @ last @ B)), dtype=np.float64)
                K = Span.of(Quadratic(A, B, Q, R, N), last, inverse).for_ever(last) if len(R) else summed(A.T, Q)
            except np.linalg.LinAlgError as error:
                raise UnprovedError("an input costs nothing") from error
            K = symmetrised(K / state / state[:, None])
        if not np.isfinite(K).all():
            raise UnprovedError("the cost-to-go grows without bound")
        found, reason = arithmetic.exact(K), UnprovedError()
        for _ in range(_CORRECTIONS):
            F, stage = given.under(_gain(given, found)[0])
            missed = (stage + F.T @ found @ F - found).symmetric().middle
            with np.errstate(all="ignore"):
                more = summed(F.middle.T, missed)
            if not np.isfinite(more).all():
                raise UnprovedError("the closed loop with the rounded gain is not stable")
            found = (found + arithmetic.exact(more)).centre()
            try:
                return self._judged(arithmetic, raw, given, found)
            except UnprovedError as error:
                reason = error
        raise reason

    def _judged(self, arithmetic: type[E], raw: Equation[E], given: Equation[E], K: E) -> Solution:
        """Return a solution after the proof of its error."""
        L, weight, H = _gain(given, K)
        size = sizes(given.A.middle, given.Q.middle, K.middle, arithmetic.unit() ** _CRUMB)
        X, slack, F = _proved_solution(arithmetic, given, K, L, weight, H, size)
        worth, middle = symmetrised(X.middle), symmetrised(K.middle)
        # rounding to doubles, in units of the diagonals, which bound the other entries of definite matrices
        error = slack * worth + np.diag(4 * UNIT * len(size) * (slack * np.diag(worth) + size))
        if not (np.diag(error) <= ASKED * size).all():
            raise UnprovedError("the error of the cost-to-go is too large")
        if self.continuous:
            L = solve(raw.R.centre(), (raw.B.T @ K + raw.N.T).centre()).times(-1.0)
            slowest = float(eigenvalues((raw.A + raw.B @ L).middle).real.max(initial=-np.inf))
            return Solution(middle, L.middle, raw.R.middle, error, -L.middle, False, "", slowest)
        correction = solve(H.centre(), weight.centre()).middle
        excess, lacking = self._rounded(arithmetic, given, K, L, correction, H, X, size)
        if lacking and arithmetic is Doubles:
            raise UnprovedError(lacking)
        error, price = error + excess, symmetrised(H.middle)
        return Solution(middle, L.middle, price, error, correction, False, lacking, _slowest(F))

    def _rounded(
        self, arithmetic: type[E], given: Equation[E], K: E, L: E, correction: Array, H: E, X: E, size: Array
    ) -> tuple[Array, str]:
        """Return a bound on the additional cost of the stored gain, and the reason if it is too large, or ""."""
        exact, none = arithmetic.exact, np.zeros_like(X.middle)
        stored = (exact(correction) @ given.A).times(-1.0) if self.dual else exact(L.middle)
        try:
            excess = _excess(arithmetic, given.A + given.B @ stored, stored - L, H, X, size)
        except UnprovedError as error:
            return none, f"with the rounded gain, {error}"
        if self.sampled:  # programs hold the plant in doubles as well
            A, B = exact(self.given.A), exact(self.given.B)
            stored = (exact(correction) @ A).times(-1.0) if self.dual else stored
            try:
                _expect_stable(arithmetic, A + B @ stored, X, size)
            except UnprovedError as error:
                return none, f"with the rounded gain and the rounded matrices of the sampled plant, {error}"
        # next to the terms of its sum, a cost-to-go has no digits below one rounding of the weights
        held = np.maximum(size, sizes(given.A.middle, given.Q.middle, K.middle, UNIT))
        more = float((np.diag(excess) / held).max(initial=0.0))
        if more > ASKED:
            return none, f"rounded, it costs up to {more:.1e} of the cost-to-go of a state more, above {ASKED:.0e}"
        return excess, ""


def exactly(given: Quadratic) -> tuple[Quadratic, Recipe]:
    """Return a problem whose exact matrices are the given doubles, and the function that encloses these matrices."""

    def recipe(arithmetic: type[E]) -> Equation[E]:
        A, B, Q, R, N = (arithmetic.exact(part) for part in given)
        return Equation(A, B, Q, R, N)

    return given, recipe


def not_held(what: str, A: Array, lacking: str) -> UnstableError:
    """Return the error for a gain that needs more digits than a double has. ``lacking`` says what is inaccurate."""
    grows, often = radius(A), ""
    if grows > _FAST:
        lacking, often = f"{lacking}; the plant grows by up to {grows:.1e} within a step", "a shorter period, "
    return UnstableError(
        f"the optimal gain of the {what} has more digits than a double holds: {lacking}; expected {often}modes that "
        "inputs affect and outputs show more strongly, or a plant without such modes"
    )


def _proved_solution(
    arithmetic: type[E], given: Equation[E], K: E, L: E, weight: E, H: E, size: Array
) -> tuple[E, float, E]:
    """Return X and ε of the proof that K ± εX contain the solution, with given L, B'K and H, and the closed loop."""
    F, stage = given.under(L)
    X, falls = ranked(arithmetic, F, size)
    missed = (stage + F.T @ K @ F - K).symmetric()
    pushed, off = given.B.T @ X, given.R @ L + given.N.T + weight @ F
    slack = 4 * _slack(missed, off, H, size)
    turned = off - (pushed @ F).times(slack)
    price = H - (pushed @ given.B).symmetric().times(slack)
    lower = block([[falls.times(slack) + missed, turned.T], [turned, price]])
    if not ((falls.times(slack) - missed).definite() and lower.definite()):
        raise UnprovedError("no bound on the error of the cost-to-go could be proved")
    return X, slack, F


def _doubled(given: Equation[Balls], bits: int) -> Balls:
    """Return the cost-to-go by doubling in balls, whose radii are dropped: the proof follows."""
    A, B, Q, R, N = (part.centre() for part in given)
    n = len(B.middle)
    last = Balls.exact(_last(B.middle, Q.middle, R.middle) * np.eye(n))
    H, off = R + B.T @ last @ B, B.T @ last @ A + N.T
    L, pushed = H.solve(off).times(-1.0), H.solve(B.T)
    F, G = (A + B @ L).centre(), (B @ pushed).symmetric().centre()
    K = (Q - last + A.T @ last @ A + off.T @ L).symmetric().centre()
    one, settled = Balls.exact(np.eye(n)), 2.0 ** (-bits / 2)
    for _ in range(_TURNS):
        solved = (one + G @ K).solve(block([[F, G]])).centre()
        moved, spread = solved.part(slice(n), slice(n)), solved.part(slice(n), slice(n, None))
        more = (F.T @ K @ moved).symmetric()
        K, G = (K + more).centre(), (G + F @ spread @ F.T).symmetric().centre()
        F = (F @ moved).centre()
        change, size = np.abs(np.diag(more.middle)), np.abs(np.diag((last + K).middle))
        if not np.isfinite(size).all():
            raise UnprovedError("the cost-to-go grows without bound")
        if (change <= settled * size).all():
            break
    return (last + K).centre()


def _expect_stable(arithmetic: type[E], F: E, X: E, size: Array) -> None:
    """Prove that a loop F is stable that is near the one for which X was computed."""
    if not (X - F.T @ X @ F).symmetric().definite():
        ranked(arithmetic, F, size)


def _excess(arithmetic: type[E], F: E, off: E, H: E, X: E, size: Array) -> Array:
    """Return a bound on the additional cost of a gain with the closed loop F, by ``off`` from the best gain."""
    # It is the sum of F'^k off'H off F^k. If δ(X − F'XF) is above off'H off, it is at most δX.
    if not off.most.any():
        return np.zeros(X.shape)
    spent, falls = (off.T @ H @ off).symmetric(), (X - F.T @ X @ F).symmetric()
    slack = 4 * relative(spent, size)
    if not (falls.times(slack) - spent).definite():  # otherwise X − F'XF ≻ 0, as off'H off ⪰ 0
        X, _, slack = bounded(arithmetic, F, spent, size)
    return slack * symmetrised(X.middle)


def _slowest(F: E) -> float:
    """Return the modulus of the slowest mode of a stable matrix, also if eigenvalues in doubles cannot tell it from 1.

    It is the limit of the root of |F^k|; the norm of each power is divided by a power of two, which is counted.
    """
    found = radius(F.middle)
    if found < _CLEAR:
        return found
    power, exponent, count = F.centre(), 0.0, 1
    for _ in range(_SQUARINGS):
        size = float(np.abs(power.middle).max(initial=0.0))
        if size == 0:
            return 0.0
        shift = round(log2(size))
        power, exponent = power.times(2.0**-shift), exponent + shift / count
        power, count = (power @ power).centre(), 2 * count
    return min(float(np.exp2(exponent)), 1 - UNIT)


def _gain(given: Equation[E], K: E) -> tuple[E, E, E]:
    """Return the gain −H⁻¹(B'KA + N') without its radii, as the proof holds for any gain near it, and B'K and H."""
    weight = given.B.T @ K
    H, off = (given.R + weight @ given.B).symmetric(), weight @ given.A + given.N.T
    return solve(H.centre(), off.centre()).times(-1.0).centre(), weight, H


def _slack(missed: E, off: E, H: E, size: Array) -> float:
    """Return an estimate of the least ε of the proof: the size of the residuals in units of the cost-to-go."""
    unit, price = 1 / np.sqrt(size), np.sqrt(np.maximum(np.diag(H.middle), NO_VARIANCE))
    return max(relative(missed, size), float(((off.most * unit / price[:, None]) ** 2).sum()))


def _last(B: Array, Q: Array, R: Array) -> float:
    """Return a terminal weight that is small compared with the cost of moving a state."""
    worth, reached = float(np.trace(R) + np.sum(B * (Q @ B))), float(np.sum(B * B))
    return _LAST * worth / reached if worth > 0 and reached > NO_VARIANCE else 1.0


def _units(A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """Return powers of two as units of states and inputs in which their weights are about 1."""
    natural = np.maximum(np.diag(Q), 0.0)
    for _ in range(len(natural)):
        if (natural > 0).all():
            break
        natural = np.where(natural > 0, natural, np.max(A.T**2 * natural, axis=1, initial=0.0))
    pushed = np.diag(R) + natural @ B**2
    return in_powers_of_two(natural), in_powers_of_two(pushed)
