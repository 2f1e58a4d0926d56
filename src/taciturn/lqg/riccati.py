"""Optimal state-feedback gains u = L x: for infinite, discounted and finite horizons, and in continuous time.

    K = Q + αA'KA − L'HL,   H = R + αB'KB,   L = −H⁻¹(αB'KA + N')

Without a horizon, ``equation`` solves this equation with a proof of its error. A discount α is a factor √α of A and B.
If disturbances or set-points move states that cost nothing while the inputs follow them (``followed``), the problem of
the deviations is solved instead. If there is no solution, the error names the mode that is the reason: it is sought in
rational numbers, among the modes before sampling if these are known.

With a horizon the equation is a recursion. It converges up to rounding, and then stays constant or alternates between a
few states. Each state determines the next one, so as soon as a state returns bit for bit (``Repetition``), the
remaining steps of a long horizon need no further computation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taciturn import _arrays
from taciturn._arrays import Array, ArrayLike, is_definite, symmetrised
from taciturn._display import Displayed
from taciturn._modes import COST_ERROR, Modes, eigenvalues, mode_text
from taciturn._progress import check_time
from taciturn._rational import NONE, Limit, unmoved, unmoved_and_seen
from taciturn._text import number_of
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.cache import remembered
from taciturn.lqg.enclosures import E, UnprovedError
from taciturn.lqg.equation import Equation, Problem, Recipe, exactly, not_held
from taciturn.lqg.followed import Followed, followed
from taciturn.lqg.quadratic import Quadratic, unpaid
from taciturn.lqg.sampling import Exact, Source


@dataclass(frozen=True, eq=False, repr=False)
class Regulator(Displayed):
    """An optimal regulator: its input u = Lx, its cost-to-go x'Kx, and the weight H of a deviation from this input.

    The cost tr(KW) of noise has an error of at most tr(error·W), which is proved. ``slowest`` is the modulus of the
    slowest mode of A + BL, with a discount that of √α(A + BL), and in continuous time its real part. Modes on the unit
    circle that no input affects and that do not affect the cost are excluded.
    """

    K: Array
    L: Array
    H: Array
    error: Array
    slowest: float


@dataclass(frozen=True, eq=False, repr=False)
class FiniteRegulator(Displayed):
    """Optimal gains L (N, m, n), costs-to-go K (N+1, n, n) and input weights H (N, m, m) for a horizon of N steps."""

    K: Array
    L: Array
    H: Array


def regulate(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, discount: float = 1.0) -> Regulator:
    """Compute the gain that minimises Σ α^k (x'Qx + u'Ru + 2x'Nu) along x⁺ = Ax + Bu.

    K = Q + αA'KA − L'HL,  L = −H^{-1}(αB'KA + N'),  H = R + αB'KB, with √α(A + BL) stable. Any other input costs
    (u − Lx)'H(u − Lx) more. This is the undiscounted problem of √α·A and √α·B. K and L are 0 along modes on the unit
    circle that no input affects and that do not affect the cost, neither directly nor through other states.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight; the caller must ensure that [[Q, N], [N', R]] is semidefinite.
        R: (m, m) symmetric input weight; may be singular as long as H is definite.
        N: (n, m) cross weight.
        discount: α, 0 < α ≤ 1.

    Returns:
        The regulator (K, L, H); noise of covariance W costs tr(KW) per step.

    Raises:
        ProblemError: data of the wrong shape or range, or H is singular.
        UnstableError: of √α·A, an unstable mode is uncontrollable, or a mode on the unit circle affects the cost and is
            uncontrollable, or is controllable and does not affect the cost.

    Source: anderson1990optimal, khashooei2017

    Example:
        >>> one = [[2.0]], [[1.0]], [[1.0]], [[2.0]], [[0.0]]
        >>> round(float(regulate(*one).L[0, 0]), 6), round(float(regulate(*one, discount=0.9).L[0, 0]), 6)
        (-1.568729, -1.522789)
    """
    given = Quadratic.checked(A, B, Q, R, N)
    discount = _arrays.number("discount", discount, 0.0)
    if discount > 1:
        raise ProblemError(f"discount is {discount:g}; expected 0 < discount ≤ 1")
    return regulate_sampled(None, *given, discount)


def regulate_finite(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, terminal: ArrayLike, horizon: int,
    late: Sequence[int] = (),
) -> FiniteRegulator:  # fmt: skip
    """Compute the gains that minimise x_N'Q_N x_N + Σ_{k<N} (x'Qx + u'Ru + 2x'Nu) along x⁺ = Ax + Bu.

    K_N = Q_N,  H_k = R + B'K_{k+1}B,  L_k = −H_k^{-1}(B'K_{k+1}A + N'),  K_k = Q + A'K_{k+1}A − L_k'H_kL_k.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight.
        R: (m, m) symmetric input weight.
        N: (n, m) cross weight.
        terminal: (n, n) symmetric terminal weight Q_N.
        horizon: number of steps N, at least 1.
        late: steps after which each input acts, by registers in x; default 0. The last commands of an input that is
            late are 0, as they act after the end.

    Returns:
        K (N+1, n, n), L (N, m, n), H (N, m, m), indexed by time.

    Raises:
        ProblemError: data of the wrong shape, an H_k is singular, or an input acts only after the end.
        UnstableError: the cost overflows, because of an uncontrollable unstable mode and a long horizon.

    Source: anderson1990optimal

    Example:
        >>> found = regulate_finite([[1.0]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], [[0.0]], 3)
        >>> found.K[:, 0, 0].tolist()
        [1.6, 1.5, 1.0, 0.0]
    """
    A, B, Q, R, N = Quadratic.checked(A, B, Q, R, N)
    horizon = _arrays.count("horizon", horizon)
    n, m = B.shape
    if max(late, default=0) >= horizon:
        raise ProblemError(
            f"the horizon has {number_of(horizon, 'step')}, and an input acts {number_of(max(late), 'step')} after its "
            "command, which is after the end; expected a longer horizon, or a shorter delay"
        )
    K, L, H = np.zeros((horizon + 1, n, n)), np.zeros((horizon, m, n)), np.zeros((horizon, m, m))
    K[horizon], repetition = _arrays.symmetric("terminal", terminal, n, "states × states"), Repetition()
    for k in reversed(range(horizon)):
        with np.errstate(over="ignore", invalid="ignore"):
            H[k] = symmetrised(R + B.T @ K[k + 1] @ B)
            cross = B.T @ K[k + 1] @ A + N.T
        if not (np.isfinite(H[k]).all() and np.isfinite(cross).all()):
            raise UnstableError(
                f"the cost-to-go overflows {number_of(horizon - k, 'step')} before the end of the horizon of "
                f"{number_of(horizon, 'step')}: A has "
                f"the eigenvalue {mode_text(complex(eigenvalues(A)[0]))}; expected a shorter horizon, or an input that "
                "affects this mode"
            )
        acts = np.array(late or [0] * m) < horizon - k
        if acts.any():
            each = np.ix_(acts, acts)
            if not is_definite(H[k][each]):
                raise costs_nothing(H[k][each], f" at step {k}", "R or the terminal weight")
            L[k][acts] = -np.linalg.solve(H[k][each], cross[acts])
        closed = A + B @ L[k]
        with np.errstate(over="ignore", invalid="ignore"):  # an overflow is detected and reported in the next step
            K[k] = symmetrised(closed.T @ K[k + 1] @ closed + Q + N @ L[k] + L[k].T @ N.T + L[k].T @ R @ L[k])
        if repetition.fills((K, L, H), k, K[k]):
            break
    if not np.isfinite(K[0]).all():
        raise UnstableError(
            f"the cost-to-go overflows at step 0 of the horizon of {number_of(horizon, 'step')}; expected a shorter "
            "horizon"
        )
    return FiniteRegulator(_arrays.frozen(K), _arrays.frozen(L), _arrays.frozen(H))


def regulate_continuous(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike) -> Regulator:
    """Compute the gain that minimises ∫ x'Qx + u'Ru + 2x'Nu dt along ẋ = Ax + Bu.

    0 = A'K + KA + Q − L'RL,  L = −R^{-1}(B'K + N'), with A + BL stable; H = R. K and L are 0 along modes on the
    imaginary axis that no input affects and that do not affect the cost, as in :func:`regulate`.

    Args:
        A: (n, n) dynamics, per unit of time.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight.
        R: (m, m) positive definite input weight.
        N: (n, m) cross weight.

    Returns:
        The regulator (K, L, H = R); noise of intensity W costs tr(KW) per unit of time.

    Raises:
        ProblemError: data of the wrong shape, or R not positive definite.
        UnstableError: an unstable mode is uncontrollable, or a mode on the imaginary axis affects the cost and is
            uncontrollable, or is controllable and does not affect the cost.

    Source: anderson1990optimal

    Example:
        >>> found = regulate_continuous([[0, 1], [0, 0]], [[0], [1]], [[1, 0], [0, 1]], [[10]], [[0], [0]])
        >>> found.L.round(6).tolist()
        [[-0.316228, -0.855836]]
    """
    given = Quadratic.checked(A, B, Q, R, N)
    if not is_definite(given.R):
        smallest = float(np.linalg.eigvalsh(given.R)[0])
        raise ProblemError(
            f"R has the eigenvalue {smallest:.3g}, and the gain −R⁻¹(B'K + N') of a continuous-time regulator needs a "
            "positive definite R, since inputs without cost could change the state instantly; expected a positive "
            "weight of each input, or a policy that holds its input between samples"
        )
    return _solved(Problem(*exactly(given), continuous=True), given, Limit(True))


def refuse_uncertain(cost: float, doubt: float) -> None:
    """Raise an error if rounding makes the computed cost of sending every sample inaccurate."""
    if not doubt <= COST_ERROR * abs(cost):
        raise UnstableError(
            f"the cost of sending every sample is {cost:.6g}, with an error of up to {doubt:.1e}; expected a relative "
            f"error of at most {COST_ERROR:.0e}: modes with hardly any noise have such a large cost-to-go that its "
            "rounding error dominates; give these modes noise W, or remove them from the plant"
        )


@remembered
def regulate_sampled(
    exact: Exact | None, A: Array, B: Array, Q: Array, R: Array, N: Array, discount: float
) -> Regulator:
    """Compute the regulator for matrices in doubles. ``exact`` gives the same matrices more precisely."""
    given = Quadratic(A, B, Q, R, N)
    if exact is None:
        return regulate_for(*exactly(given), discount)
    return regulate_for(given, exact.equation, discount, True, exact.source)


def regulate_deviations(change: Followed) -> Regulator:
    """Convert the regulator of the deviations from states without cost to a regulator of all states."""
    inner = regulate_sampled(change.exact, *change.problem, 1.0)
    K, error = (_arrays.frozen(symmetrised(change.T.T @ part @ change.T)) for part in (inner.K, inner.error))
    return Regulator(K, _arrays.frozen(inner.L @ change.T + change.U), inner.H, error, inner.slowest)


def regulate_for(
    given: Quadratic, recipe: Recipe, discount: float = 1.0, sampled: bool = False, source: Source | None = None
) -> Regulator:
    """Compute the regulator of a problem known to any precision; raise an error that says why if there is none."""
    check_time()
    root = float(np.sqrt(discount))
    scaled = given._replace(A=root * given.A, B=root * given.B)
    change = followed(scaled)
    if change is not None:  # first: such states may have modes on the unit circle, and a cost that is only rounding
        return regulate_deviations(change)

    def discounted(arithmetic: type[E]) -> Equation[E]:
        A, B, Q, R, N = recipe(arithmetic)
        factor = arithmetic.root(discount, len(given.A))
        return Equation(factor @ A, factor @ B, Q, R, N)

    before = source and (source.given, Limit(True, discount, source.period))
    problem = Problem(scaled, recipe if discount == 1 else discounted, sampled=sampled, before=before)
    return _solved(problem, *(before or (given, Limit(False, discount))))


def _solved(problem: Problem, given: Quadratic, limit: Limit) -> Regulator:
    """Return the regulator of a problem, given its matrices before sampling and discount, and the edge of decay."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # a number out of range ends the proof
            found = problem.solve()
    except UnprovedError as error:
        seen = given.among(problem.worth.states)
        _refuse_unmoved(seen, limit)
        _refuse_unpaid(unpaid(seen, limit).staying, limit, is_definite(given.R))
        what = "the Riccati equation of the regulator"
        found = f"the stabilising solution of {what}" if is_definite(given.R) else f"{what} has no solution that"
        raise UnstableError(
            f"{found} could not be proved with 1,024 bits: {error}; expected modes that decay faster or that the "
            "inputs affect more strongly, or a weight on every state and input"
        ) from None
    if found.free:
        raise costs_nothing(found.H)
    if found.lacking:
        raise not_held("regulator", problem.given.A / np.sqrt(limit.discount), found.lacking)
    K, L, H, error = (_arrays.frozen(part) for part in (found.K, found.L, found.H, found.error))
    return Regulator(K, L, H, error, found.slowest)


def _refuse_unmoved(seen: Quadratic, limit: Limit) -> None:
    """Reject modes that no input affects; for a mode on the edge, the message adds whether it affects the cost."""
    lost = unmoved(seen.A, seen.B, limit)
    if not lost.lasting.size:
        return
    costly = NONE if lost.growing.size else unmoved_and_seen(seen.A, seen.B, np.hstack([seen.Q, seen.N]).T, limit)
    mode = complex((costly if costly.staying.size else lost).lasting[0])
    digits = limit.digits(mode)
    named = f"A has the eigenvalue {mode_text(mode, digits)}, which is uncontrollable through B"
    if lost.growing.size:
        raise UnstableError(
            f"(A, B) is not stabilisable: {named}; expected (A, B) stabilisable: every eigenvalue outside "
            f"{limit.region(digits)} must be controllable; add an actuator, or remove the state of this mode from the "
            "problem"
        )
    if costly.staying.size:
        raise UnstableError(
            f"(A, B) is not stabilisable: {named}; this mode lies on {limit} and affects the cost, so that the cost is "
            "infinite or depends on exact cancellation; expected (A, B) stabilisable, or no weight in Q and N on the "
            "state of this mode and on the states that it affects; make the mode stable, or give it as a disturbance "
            "instead of a state"
        )
    raise UnstableError(
        f"(A, B) is not stabilisable: {named}; this mode lies on {limit}, does not affect the cost, and is a "
        "combination of several states, but such a mode is accepted only if it is a single state; expected "
        "coordinates in which it is a single state, for which Q, N and A have zeros, or a problem without this mode"
    )


def _refuse_unpaid(modes: Modes, limit: Limit, definite: bool) -> None:
    if not modes.size:
        return
    mode = mode_text(complex(modes[0]))
    if definite:
        raise UnstableError(
            f"the mode {mode} on {limit} does not affect the cost, so no optimal gain stabilises it; expected a small "
            "positive weight in Q on this mode"
        )
    raise UnstableError(
        f"R is singular, and inputs can keep the mode {mode} on {limit} in motion without cost, so no optimal gain "
        "stabilises it; expected a positive weight in Q or R on this motion"
    )


def costs_nothing(H: Array, where: str = "", weight: str = "R") -> ProblemError:
    """Return the error for a singular input weight H = R + B'KB, because the optimal gain is then not unique."""
    smallest = float(np.linalg.eigvalsh(H)[0])
    return ProblemError(
        f"R + B'KB is not positive definite{where}: it has the eigenvalue {smallest:.3g}, so an input "
        f"direction is free; expected every input to cost something; give {weight} a positive part, or remove the "
        "redundant input"
    )


class Repetition:
    """Detects when a recursion returns to a state that it had before."""

    def __init__(self) -> None:
        """Start without states."""
        # number and state of a step, by the hash of the state
        self._seen: dict[int, tuple[int, tuple[Array, ...]]] = {}

    def period(self, step: int, *state: Array) -> int | None:
        """Return after how many steps the recursion returned to this state; None if it has not returned to it."""
        key = hash(b"".join(part.tobytes() for part in state))
        earlier, same = self._seen.setdefault(key, (step, state))
        alike = all(np.array_equal(one, other) for one, other in zip(state, same, strict=True))
        return abs(step - earlier) if alike and step != earlier else None

    def fills(self, parts: tuple[Array, ...], step: int, *state: Array) -> bool:
        """Return whether a backward recursion repeats. If so, also fill in all earlier steps."""
        period = self.period(step, *state)
        if period is None:
            return False
        alike = step + (np.arange(step) - step) % period
        for part in parts:
            part[:step] = part[alike]
        return True
