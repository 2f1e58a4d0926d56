"""Optimal control over links that drop packets: finite-horizon and steady gains, and critical loss probabilities.

The actuator applies zero if no packet arrives. A packet of the sensor link contains the state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, Bits, frozen, is_definite, symmetrised
from taciturn._display import Displayed
from taciturn._modes import SCATTER, balancing, bound_residual, eigenvalues, lost_modes, mode_text, radius
from taciturn._progress import check_time
from taciturn.errors import UnstableError
from taciturn.lqg._mean_square import MeanSquare
from taciturn.lqg._repetition import Repetition, fill_earlier
from taciturn.lqg.quadratic import Quadratic, in_powers_of_two, price
from taciturn.lqg.riccati import costs_nothing, regulate, states_with_cost

TURNS = 100
MOST_MODES = 12  # most modes on or outside the unit circle for which critical losses are computed (takes seconds)
STRICT = 1e-9  # least distance to 1 of a growth that counts as stable
NILPOTENT = 1e-6  # a growth below this counts as none


@dataclass(frozen=True, repr=False)
class Channel(Displayed):
    """Properties of the lossy links that determine the optimal gains.

    Args:
        actuator_loss: α, loss probability of the actuator link, in [0, 1].
        sensor_loss: β, loss probability of the sensor link, in [0, 1].
        acknowledged: whether the actuator acknowledges packets (TCP-like) or not (UDP-like).
        delayed: whether the controller uses the measurement of step k only at step k + 1.
    """

    actuator_loss: float
    sensor_loss: float
    acknowledged: bool
    delayed: bool

    @property
    def exposure(self) -> float:
        """Probability φ that an estimation error affects the next input: the sensor loss, or 1 if there is a delay."""
        return 1.0 if self.delayed else self.sensor_loss

    @property
    def coupling(self) -> float:
        """Factor αφ by which an unacknowledged input adds to the estimation error; 0 with acknowledgements."""
        return 0.0 if self.acknowledged else self.actuator_loss * self.exposure


@dataclass(frozen=True, eq=False, repr=False)
class LossyRegulator(Displayed):
    """Optimal gains over lossy links, u = L x̂, with the cost x̂'Γx̂ of silence and the cost e'Pe of an error e.

    K and P are (n, n), L is (m, n), and Gamma is (n, n). For a finite horizon they have one more leading axis, of
    length N + 1 for K and P, and N for L and Gamma. The cost of noise, tr((K + φP)W), has an error of at most
    tr(error·W); ``error`` is 0 for a finite horizon.
    """

    K: Array
    P: Array
    L: Array
    Gamma: Array
    error: Array

    def within(self, states: Bits) -> LossyRegulator:
        """Return these gains extended to a plant with additional states that have no cost-to-go.

        Args:
            states: the states of these gains.
        """
        n, place, L = len(states), np.ix_(states, states), np.zeros((len(self.L), len(states)))
        L[:, states] = self.L
        forms = {name: np.zeros((n, n)) for name in ("K", "P", "Gamma", "error")}
        for name, form in forms.items():
            form[place] = getattr(self, name)
        return LossyRegulator(L=frozen(L), **{name: frozen(form) for name, form in forms.items()})


def lossy_step(
    A: Array, B: Array, Q: Array, R: Array, K: Array, P: Array, channel: Channel
) -> tuple[Array, Array, Array, Array]:
    """Return the weights K, P and Γ and the gain L of one step over lossy links, from K and P of the next step.

    M = R + B'(K + αφP)B (UDP-like) or R + B'KB (TCP-like),  L = −M^{-1}B'KA,  Γ = (1−α) A'KB M^{-1} B'KA,
    K ← Q + A'KA − Γ,  P ← Γ + βA'PA,  with φ = β, or 1 with a one-step delay.

    Raises:
        ProblemError: M is singular.

    Source: khashooei2017, schenato2007
    """
    M, inverse = price(B, K + channel.coupling * P, R)
    if not (is_definite(R) or is_definite(M)) and np.isfinite(M).all():
        raise costs_nothing(M, weight="R or the terminal weight")
    cross = B.T @ K @ A
    L = -inverse @ cross
    Gamma = symmetrised((1 - channel.actuator_loss) * cross.T @ inverse @ cross)
    return (
        symmetrised(Q + A.T @ K @ A - Gamma),
        symmetrised(Gamma + channel.sensor_loss * A.T @ P @ A),
        L,
        Gamma,
    )


def regulate_lossy_finite(
    A: Array, B: Array, Q: Array, R: Array, terminal: Array, horizon: int, channel: Channel
) -> LossyRegulator:
    """Return the gains that minimise x_N'Q_N x_N + Σ_{k<N} (x'Qx + û'Rû) over links that drop packets.

    The recursion starts with K_N = Q_N and P_N = 0.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        Q: (n, n) semidefinite state weight.
        R: (m, m) semidefinite input weight.
        terminal: (n, n) semidefinite weight of the final state.
        horizon: number of steps N, at least 1.
        channel: loss probabilities, acknowledgement and delay.

    Returns:
        The gains, indexed by time.

    Raises:
        ProblemError: M is singular, so that an input costs nothing.
        UnstableError: the cost overflows.

    Source: khashooei2017, schenato2007
    """
    n, m = B.shape
    K, P = np.zeros((horizon + 1, n, n)), np.zeros((horizon + 1, n, n))
    L, Gamma = np.zeros((horizon, m, n)), np.zeros((horizon, n, n))
    K[horizon], repetition = terminal, Repetition()
    for k in reversed(range(horizon)):
        with np.errstate(over="ignore", invalid="ignore"):
            K[k], P[k], L[k], Gamma[k] = lossy_step(A, B, Q, R, K[k + 1], P[k + 1], channel)
            overflown = not np.isfinite(K[k] @ K[k] + P[k] @ P[k]).all()
        if overflown:
            raise UnstableError(
                f"the cost-to-go overflows {horizon - k} steps before the end of the horizon of {horizon}: the losses "
                "are too large for this plant; expected a shorter horizon, or smaller losses"
            )
        period = repetition.period(k, K[k], P[k])
        if period is not None:
            fill_earlier((K, P, L, Gamma), k, period)
            break
    return LossyRegulator(*(frozen(part) for part in (K, P, L, Gamma, np.zeros((n, n)))))


def regulate_lossy(A: Array, B: Array, Q: Array, R: Array, channel: Channel) -> LossyRegulator:
    """Return the gains that minimise the infinite-horizon average cost over links that drop packets.

    They are the fixed point of :func:`lossy_step`.

    The gains are computed by policy iteration: the cost of a stabilising gain from linear equations, then the best gain
    for this cost. This converges quadratically, and all its gains are stabilising.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        Q: (n, n) semidefinite state weight.
        R: (m, m) semidefinite input weight.
        channel: loss probabilities, acknowledgement and delay.

    Returns:
        The gains; the average cost of sending every sample is tr((K + φP)W).

    Raises:
        UnstableError: the losses exceed those that mean-square stability allows; the message has the critical values.

    Source: khashooei2017, schenato2007
    """
    given = Quadratic(A, B, Q, R, np.zeros_like(B))
    seen = states_with_cost(*given)
    found = _fixed_point(given.among(seen), channel)
    return found if seen.all() else found.within(seen)


def _fixed_point(given: Quadratic, channel: Channel) -> LossyRegulator:
    """Return the gains of a problem whose states all have a cost-to-go."""
    A, B, Q, R, N = given
    plain = regulate(*given)  # raises an error for uncontrollable modes and for modes that do not affect the cost
    state, unit = in_powers_of_two(plain.K.diagonal()), in_powers_of_two(plain.H.diagonal())
    here = Quadratic(
        A * state / state[:, None], B * unit / state[:, None], Q * state * state[:, None], R * unit * unit[:, None], N
    )
    L = plain.L * state / unit[:, None]
    if not _loop(here.A, here.B, L, channel).bounded:
        L = _stabilising(A, B, channel) * state / unit[:, None]
    previous = gap = np.inf
    for _ in range(TURNS):
        check_time()
        try:
            K, P = _cost_of(here, L, channel)
        except np.linalg.LinAlgError:  # so close to the critical losses that the cost of the gain cannot be computed
            break
        gap = float(np.abs(K).max())
        following = lossy_step(here.A, here.B, here.Q, here.R, K, P, channel)
        change = max(float(np.abs(following[0] - K).max()), float(np.abs(following[1] - P).max()))
        if change <= 1e-13 * gap or (change <= 1e-9 * gap and change >= 0.5 * previous):
            forms = following[0], following[1], following[3], _doubt(here, K, P, following, channel)
            K, P, Gamma, error = (frozen(form / state / state[:, None]) for form in forms)
            return LossyRegulator(K, P, frozen(following[2] * unit[:, None] / state), Gamma, error)
        previous, L = change, following[2]
    raise UnstableError(
        "the lossy Riccati recursion did not converge: the last iteration had a relative change of "
        f"{previous / gap if np.isfinite(gap) else 1.0:.1e} (at most 1e-13); expected loss probabilities further from "
        "their critical values"
    )


def _stabilising(A: Array, B: Array, channel: Channel) -> Array:
    """Return a gain under which the mean square is bounded.

    Raises:
        UnstableError: the losses exceed those that mean-square stability allows.
    """
    rate, L = slowest_growth(A, B, channel)
    if rate >= 1 - STRICT:
        raise UnstableError(
            f"{loss_sentence(A, B, channel)}; expected smaller losses, or a finite horizon (cost.horizon)"
        )
    return L


def _doubt(
    here: Quadratic, K: Array, P: Array, following: tuple[Array, Array, Array, Array], channel: Channel
) -> Array:
    """Return a bound on the error of K + φP: its change in one step and its rounding, summed along the loop."""
    A, B, Q, R, _ = here
    L, alpha, beta = following[2], channel.actuator_loss, channel.sensor_loss
    pushed, price = np.abs(A) + np.abs(B) @ np.abs(L), np.abs(K) + channel.exposure * np.abs(P)
    first = np.abs(Q) + (1 - alpha) * np.abs(L.T) @ np.abs(R) @ np.abs(L) + pushed.T @ price @ pushed
    second = np.abs(Q) + np.abs(A.T) @ (np.abs(K) + beta * np.abs(P)) @ np.abs(A)
    missed = following[0] - K, following[0] + following[1] - K - P
    added = (
        bound_residual(off, terms, len(A) + B.shape[1]) for off, terms in zip(missed, (first, second), strict=True)
    )
    one, two = _loop(A, B, L, channel).solve(*added)
    return (1 - channel.exposure) * one + channel.exposure * two


def critical_losses(A: Array, B: Array, channel: Channel) -> tuple[float, float]:
    """Return the critical loss probability of each link at the given loss probability of the other link.

    The actuator link is first.

    At or above either value, no linear control keeps the mean square of an unstable plant bounded. A value is 1 if
    losses on the link cannot make the plant unstable, and 0 if the losses on the other link alone are too large.

    Source: schenato2007
    """

    def excess(actuator: float, sensor: float) -> float:
        tried = Channel(actuator, sensor, channel.acknowledged, channel.delayed)
        return slowest_growth(A, B, tried)[0] - 1.0

    return (
        _crossing(lambda loss: excess(loss, channel.sensor_loss)),
        _crossing(lambda loss: excess(channel.actuator_loss, loss)),
    )


def loss_sentence(A: Array, B: Array, channel: Channel) -> str:
    """Return a sentence that states the loss probabilities and their limits for mean-square stability."""
    many = int((np.abs(eigenvalues(A)) >= 1 - SCATTER).sum()) > MOST_MODES
    actuator, sensor = (0.0, 0.0) if many else critical_losses(A, B, channel)
    limits: list[str] = []
    if channel.actuator_loss > 0 and actuator > 0:
        limits.append(f"actuator losses below {actuator:.6g} at this sensor loss")
    if channel.sensor_loss > 0 and sensor > 0:
        limits.append(f"sensor losses below {sensor:.6g} at this actuator loss")
    allowed = " or ".join(limits) or "smaller losses on both links"
    return (
        f"network.actuator_loss is {channel.actuator_loss:g} and network.sensor_loss is {channel.sensor_loss:g}, and "
        f"for this plant (largest eigenvalue {mode_text(complex(radius(A)))}) mean-square stability allows {allowed}"
    )


def slowest_growth(A: Array, B: Array, channel: Channel) -> tuple[float, Array]:
    """Return the least mean-square growth per step over all linear gains, and a gain with this growth.

    Only modes on or outside the unit circle matter. For these, the growth under a gain is the spectral radius of a
    positive linear map on pairs of weights. Policy iteration minimises it: the cost of the gain with stage costs
    discounted by slightly more than its growth, then the best gain for this cost, whose growth is below the discount.
    The difference between discount and growth is reduced in each iteration.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        channel: loss probabilities, acknowledgement and delay.

    Returns:
        The growth (0 for a stable plant), and the gain (m, n).

    Raises:
        UnstableError: a mode on or outside the unit circle is uncontrollable.

    Source: schenato2007
    """
    n, m = B.shape
    scale = balancing(A)  # the result must not depend on the units of the states
    A, B = A / scale[:, None] * scale, B / scale[:, None]
    lost = lost_modes(A, B, False)
    if lost.size:
        raise UnstableError(f"A has the eigenvalue {mode_text(complex(lost[0]))}, which is uncontrollable through B")
    A_u, V = _scipy.unstable_part(A, 1 - SCATTER)
    B_u, count = V @ B, len(V)
    if count == 0:
        return 0.0, np.zeros((m, n))
    L = _free_gain(A_u, B_u, np.eye(count), np.eye(count), channel)
    free = Quadratic(A_u, B_u, np.eye(count), np.zeros((m, m)), np.zeros((count, m)))
    rate, slack = mean_square_rate(A_u, B_u, L, channel), 1.0
    while rate > NILPOTENT and slack > STRICT:
        check_time()
        try:
            K, P = _cost_of(free, L, channel, rate * (1 + slack))
        except np.linalg.LinAlgError:  # the discount equals the growth up to rounding
            break
        trial = _free_gain(A_u, B_u, K, P, channel)
        found = mean_square_rate(A_u, B_u, trial, channel)  # surely below rate·(1 + slack), mostly below rate
        if found < rate * (1 - slack / 8):
            rate, L = found, trial
        else:
            slack /= 4
    return rate, L @ V / scale


def mean_square_rate(A: Array, B: Array, L: Array, channel: Channel) -> float:
    """Return the factor by which the mean square of a noise-free loop with a given gain grows per step.

    Source: schenato2007
    """
    return _loop(A, B, L, channel).growth()


def _free_gain(A: Array, B: Array, K: Array, P: Array, channel: Channel) -> Array:
    return -price(B, K + channel.coupling * P, np.zeros((B.shape[1],) * 2))[1] @ B.T @ K @ A


def _loop(A: Array, B: Array, L: Array, channel: Channel, level: float = 1.0) -> MeanSquare:
    reach = 0.0 if channel.acknowledged else channel.exposure
    return MeanSquare(A, B, L, (channel.actuator_loss, channel.sensor_loss), reach, level)


def _cost_of(given: Quadratic, L: Array, channel: Channel, level: float = 1.0) -> tuple[Array, Array]:
    """Return K and P of a gain with a growth below ``level``: the sum of the stage costs divided by level^k."""
    stage = given.Q + (1 - channel.actuator_loss) * L.T @ given.R @ L
    K, total = _loop(given.A, given.B, L, channel, level).solve(stage, given.Q)
    return K, total - K


def _crossing(excess: Callable[[float], float]) -> float:
    if excess(1.0) < 0:
        return 1.0
    return 0.0 if excess(0.0) >= 0 else _scipy.crossing(excess, 0.0, 1.0)
