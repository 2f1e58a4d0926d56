"""Certificates of switched linear loops from quadratic Lyapunov functions, verified with bounds on rounding errors.

V(z) = z'P_iz if the action i is taken; some certificates use one P for all actions. Some inequalities must hold only if
i is taken now (and j next). The S-procedure subtracts non-negative multiples of the margins by which i (and j) has the
lowest cost, and then requires the inequality everywhere. The constants of the trigger, times these multiples, add up to
a residual β.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from taciturn.analyse.switched import Switched
from taciturn.errors import ProblemError
from taciturn.extend import Array, Displayed, check_time, number_of
from taciturn_certify.inequalities import Inequalities, Inequality, Square, Unknowns, Widest

MARGINS = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4)  # tried in this order for the inequalities, in coordinates of unit size
HALVINGS = 13  # bisections of the interval of the decay rate, to 1.3e-4
LAST = 1 - 1e-6  # slowest decay that is tried
SPARE = 1.05  # factor by which a gain may exceed the least one, for a smaller residual
SHARES = (0.9, 0.6, 0.2)  # shares of 1 − ρ² that are tried for a smaller residual
BELOW = 1 - 1e-6  # share of a computed eigenvalue that is claimed
RARELY = 1e-3  # weight of the one-time constant relative to the residual per step
ABOVE = 1 + 1e-14  # factor that covers the rounding of a claimed product
BETA = 0  # indices of the unknown scalars: the residual,
GAMMA = TAU = 1  # the square of the gain, or the amount by which V may be below the stage cost,
ONCE = 2  # and the amount by which V may be below 0


class NoCertificateError(ProblemError):
    """Error raised if no solution of a certificate's matrix inequalities is found, or if none can be verified."""


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(Displayed):
    """Proof of a property of a loop: matrix inequalities, and a solution that was verified despite rounding errors."""

    inequalities: Inequalities  # the inequalities that were solved
    solution: Unknowns  # the matrix P of each action (or one for all), and the multipliers

    @property
    def matrices(self) -> tuple[Array, ...]:
        """Lyapunov matrices P: one matrix for each action of the loop, or a single matrix for all actions."""
        return self.solution.matrices


@dataclass(frozen=True, eq=False, repr=False)
class Decay(Displayed):
    """Proven decay rate ρ of a loop without noise: V(z⁺) ≤ ρ²V(z) + β. If β is 0, the state converges to zero."""

    rate: float  # ρ per step
    residual: float  # β, which is 0 if the trigger has no constants
    overshoot: float | None  # factor in |z_k| ≤ overshoot · ρ^k |z_0| if the trigger has no constants; otherwise None
    limit: float  # bound below which the stage cost finally falls; 0 if the state converges to zero
    proof_of_limit: Certificate | None  # proof of the limit, or None if the limit is 0
    proof: Certificate  # proof of the rate


@dataclass(frozen=True, eq=False, repr=False)
class Gain(Displayed):
    """Proven l2 gain γ from the noise w to the cost: Σ stage cost ≤ γ² Σ|w|² + β·steps + a constant.

    The inequality holds for every noise signal w, for z_0 = 0.
    """

    value: float  # γ, from noise in units of its standard deviation to the root of the stage cost
    residual: float  # β per step, which is 0 if the trigger has no constants
    once: float  # the constant of the inequality, which is 0 if the trigger has no constants
    proof: Certificate  # proof with a matrix P for each action


@dataclass(frozen=True, eq=False, repr=False)
class Moment(Displayed):
    """Proven bound on a loop's average stage cost or mean-square state under white noise of unit covariance."""

    value: float  # the bound, per step
    proof: Certificate  # proof with one P for all actions: E[z⁺'Pz⁺] ≤ z'Pz − form + bound


def find_decay(loop: Switched) -> Decay:
    """Compute a proven decay rate of a switched linear loop without noise.

    The result is the least ρ with F_i'P_jF_i ⪯ ρ²P_i after the S-procedure at i and at j, and P_i ≻ 0 if i is taken. A
    bisection finds it, and verifies each ρ that it tries.
    """
    widest = Widest(_decay(loop, 0.0, 0.0), _decay(loop, 1.0, 0.0))
    found = _falling(loop, widest, LAST)
    if found is None:
        raise NoCertificateError(
            f"a decay by {1 - LAST:.0e} per step could not be proved with quadratic Lyapunov functions of "
            f"{number_of(loop.states, 'coordinate')}, one for each of {number_of(len(loop.labels), 'action')}; "
            "expected a trigger that sends more often"
        )
    low, rate = 0.0, LAST
    for _ in range(HALVINGS):
        check_time()
        middle = (low + rate) / 2
        better = _falling(loop, widest, middle)
        if better is None:
            low = middle
        else:
            found, rate = better, middle
    proof, least = found
    if not loop.homogeneous:
        return Decay(rate, float(proof.solution.scalars[BETA]), None, *_limit(loop, rate), proof)
    largest = max(float(np.linalg.norm(P, 2)) for P in proof.matrices)
    return Decay(rate, 0.0, float(np.sqrt(largest / (BELOW * least))) * ABOVE, 0.0, None, proof)


def find_gain(loop: Switched) -> Gain:
    """Compute a proven bound on the l2 gain of a switched linear loop from arbitrary noise to the cost.

    The function first finds the least γ with V(F_iz + Gw) − z'P_iz + z'M_iz ≤ γ²|w|² + β after the S-procedure at i and
    at j, and then the least β for 1.05 γ.
    """
    if not loop.G.shape[1]:
        raise NoCertificateError(
            "the loop has no noise (W and V are zero), so it has no gain from noise to cost; expected a nonzero W or V"
        )
    unit = _unit_of(loop.M)
    proof = _minimised(_gain(loop, unit, None), {GAMMA: 1.0}, "gain")
    square = float(proof.solution.scalars[GAMMA])
    if not loop.homogeneous:
        square *= SPARE**2
        proof = _minimised(_gain(loop, unit, square), {BETA: 1.0, ONCE: RARELY}, "gain")
    residual, once = (unit * proof.solution.scalars[[BETA, ONCE]]).tolist() if not loop.homogeneous else (0.0, 0.0)
    return Gain(float(np.sqrt(square * unit)) * ABOVE, residual, once, proof)


def bound_cost(loop: Switched) -> Moment:
    """Compute a proven bound on a loop's average stage cost under white noise, and add ``constant`` to the bound.

    The result is the least β such that F_i'PF_i − P + M_i ⪯ 0 after the S-procedure at i, P ⪰ 0, and tr(PGG') plus the
    residual of the constants c is at most β. The noise must be white with zero mean and unit covariance, Gaussian or
    not.
    """
    return _moment(loop, loop.M, loop.constant)


def bound_state(loop: Switched) -> Moment:
    """Compute a proven bound on the mean square E|x|² of the plant's state under white noise."""
    return _moment(loop, (loop.X.T @ loop.X,) * len(loop.labels), loop.hidden)


class _Asked:
    """A list of the inequalities of a certificate, to which inequalities are added."""

    def __init__(self, loop: Switched, matrices: int, scalars: int) -> None:
        self.loop, self.scalars = loop, scalars
        self.sizes = (loop.states,) * matrices
        self.listed: list[Inequality] = []

    def ask(
        self,
        constant: Array,
        squares: Sequence[Square],
        where: Sequence[tuple[int, Array]] = (),
        scalars: Sequence[tuple[int, Array]] = (),
        left: Inequality | None = None,
    ) -> None:
        """Add a matrix inequality for all steps at which the loop takes the given actions."""
        terms, numbers = list(scalars), [] if left is None else list(left.scalars)
        for action, T in where:
            for D, d in self.loop.margins(action):
                size = max(float(np.abs(T.T @ D @ T).max(initial=0.0)), abs(d))
                if size > 0:
                    unit = _power_of_two(size)
                    terms.append((self.scalars, -(T.T @ D @ T) / unit))
                    numbers.append((self.scalars, np.array([[-d / unit]])))
                    self.scalars += 1
        self.listed.append(Inequality(constant, squares, terms))
        if left is not None:
            self.listed.append(Inequality(left.constant, left.squares, [each for each in numbers if each[1].any()]))

    def all(self) -> Inequalities:
        """Return all matrix inequalities that were added."""
        return Inequalities(self.sizes, self.scalars, tuple(self.listed))


def _falling(loop: Switched, widest: Widest, rate: float) -> tuple[Certificate, float] | None:
    """Return the proof that V decreases by ρ² per step, and t with V ≥ t|z|² up to a constant; None if it fails."""
    asked, found = _decay(loop, rate, 0.0), widest.at(rate**2)
    if found is None:
        return None
    least = min(np.linalg.eigvalsh(asked.value(i, found))[0] for i in range(len(loop.labels)))
    proof, settled = _decay(loop, rate, BELOW * float(least)), asked.raised(found, BETA)
    return (Certificate(proof, settled), float(least)) if least > 0 and not proof.shortfall(settled) else None


def _decay(loop: Switched, rate: float, least: float) -> Inequalities:
    """Return P_i ⪰ least and P_i ⪯ 1 for each action, and V(z⁺) ≤ ρ²V(z) + β for each pair of actions."""
    unit, actions = np.eye(loop.states), range(len(loop.labels))
    asked = _Asked(loop, len(actions), 1)
    for i in actions:
        asked.ask(-least * unit, [(1.0, i, unit)], [(i, unit)])
    for i in actions:
        asked.ask(unit, [(-1.0, i, unit)])
    left = None if loop.homogeneous else Inequality(np.zeros((1, 1)), (), [(BETA, np.ones((1, 1)))])
    for i, j in product(actions, actions):
        F = loop.F[i]
        asked.ask(0 * unit, [(rate**2, i, unit), (-1.0, j, F)], [(i, unit), (j, F)], left=left)
    return asked.all()


def _limit(loop: Switched, rate: float) -> tuple[float, Certificate]:
    """Return the final bound on the stage cost without noise: the least β/(1 − ρ²) + τ with V + τ ≥ the stage cost."""
    best: tuple[float, Certificate] | None = None
    error: NoCertificateError | None = None
    for share in SHARES:
        decay = 1 - share * (1 - rate**2)
        unit, weights = _unit_of(loop.M), {BETA: 1 / (1 - decay), TAU: 1.0}
        try:
            proof = _minimised(_ending(loop, decay, unit), weights, "limit")
        except NoCertificateError as missed:
            error = missed
            continue
        beta, tau = proof.solution.scalars[[BETA, TAU]]
        limit = unit * float(beta / (1 - decay) + tau) * ABOVE
        if best is None or limit < best[0]:
            best = (limit, proof)
    if best is None:
        assert error is not None
        raise error
    return best


def _ending(loop: Switched, decay: float, unit: float) -> Inequalities:
    """Return V + τ ≥ the stage cost, in the given unit, and V(z⁺) ≤ decay·V + β."""
    one, number, actions = np.eye(loop.states), np.ones((1, 1)), range(len(loop.labels))
    asked = _Asked(loop, len(actions), 2)
    for i in actions:
        above = Inequality(0 * number, (), [(TAU, number)])
        asked.ask(-loop.M[i] / unit, [(1.0, i, one)], [(i, one)], left=above)
    for i, j in product(actions, actions):
        F, left = loop.F[i], Inequality(0 * number, (), [(BETA, number)])
        asked.ask(0 * one, [(decay, i, one), (-1.0, j, F)], [(i, one), (j, F)], left=left)
    return asked.all()


def _gain(loop: Switched, unit: float, square: float | None) -> Inequalities:
    """Return P_i ⪰ 0 if i is taken, and the dissipation inequality: γ² unknown without β, or γ² given and β unknown."""
    r, q, actions = loop.states, loop.G.shape[1], range(len(loop.labels))
    now, noise = np.eye(r, r + q), np.diag([0.0] * r + [1.0] * q)
    asked, unlimited = _Asked(loop, len(actions), 3), square is None
    once, left = (Inequality(np.zeros((1, 1)), (), [(j, np.ones((1, 1)))]) for j in (ONCE, BETA))
    for i in actions:
        asked.ask(np.zeros((r, r)), [(1.0, i, np.eye(r))], [(i, np.eye(r))], left=None if unlimited else once)
    for i, j in product(actions, actions):
        after = np.hstack([loop.F[i], loop.G])
        constant = -(now.T @ loop.M[i] @ now) / unit + (0.0 if square is None else square) * noise
        scalars = [(GAMMA, noise)] if square is None else []
        where = [(i, now), (j, after)]
        asked.ask(constant, [(1.0, i, now), (-1.0, j, after)], where, scalars, None if unlimited else left)
    return asked.all()


def _moment(loop: Switched, forms: Sequence[Array], constant: float) -> Moment:
    """Return a bound on the average of z'M_iz + constant."""
    one, number, unit = np.eye(loop.states), np.ones((1, 1)), _unit_of(forms)
    asked = _Asked(loop, 1, 1)
    asked.ask(0 * one, [(1.0, 0, one)])
    spread = [(-1.0, 0, column[:, None]) for column in loop.G.T]
    for i, form in enumerate(forms):
        left = Inequality(0 * number, spread, [(BETA, number)])
        asked.ask(-form / unit, [(1.0, 0, one), (-1.0, 0, loop.F[i])], [(i, one)], left=left)
    proof = _minimised(asked.all(), {BETA: 1.0}, "bound on the mean square")
    return Moment((unit * float(proof.solution.scalars[BETA]) + constant) * ABOVE, proof)


def _minimised(asked: Inequalities, weights: Mapping[int, float], what: str) -> Certificate:
    """Return a verified solution with the least Σ weight·scalar."""
    missed = None
    for margin in MARGINS:
        found = asked.minimise(weights, margin)
        if found is None:
            continue
        settled = found
        for index in weights:
            settled = asked.raised(settled, index)
        missed = asked.shortfall(settled)
        if missed == 0:
            return Certificate(asked, settled)
    reason = "the solver finds none" if missed is None else f"the solution violates an inequality by {missed:.2g}"
    raise NoCertificateError(
        f"no {what} can be proved by quadratic Lyapunov functions of {asked.sizes[0]} coordinates ({reason}); "
        "expected a trigger that sends more often"
    )


def _unit_of(forms: Sequence[Array]) -> float:
    """Return the power of two nearest to the largest trace; a division by it is exact."""
    largest = max(float(np.trace(form)) for form in forms)
    return _power_of_two(largest) if largest > 0 else 1.0


def _power_of_two(value: float) -> float:
    return math.ldexp(1.0, round(math.log2(value)))
