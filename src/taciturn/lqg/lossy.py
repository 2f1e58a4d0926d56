"""Optimal control over links that drop packets: finite-horizon and stationary gains, and critical loss probabilities.

The actuator applies zero if no packet arrives. A packet of the sensor link contains the state. With the losses α of the
actuator link and β of the sensor link, the cost-to-go has a weight K of the estimate and a weight P of its error:

    M = R + B'(K + αφP)B without acknowledgements, or R + B'KB with them,   L = −M⁻¹B'KA,
    Γ = (1−α) A'KB M⁻¹ B'KA,   K ← Q + A'KA − Γ,   P ← Γ + βA'PA,   φ = β, or 1 with a delay of one step.

**Steady gains** are the fixed point, which policy iteration finds: the cost of a stabilising gain from coupled Lyapunov
equations (``critical_losses``), then the best gain for this cost. The first gain is that of the plant without losses,
or one that survives the most losses.

**The proof.** One step under a gain maps the pairs (K, T), T = K + P, to larger pairs for larger pairs, and the best
gain is the best one for both weights, since T⁺ does not depend on it. So pairs have the proof of ``equation``. Let
(X, Z) ≻ 0 be a pair that the step without stage costs maps to a pair below (X, Z): then L stabilises in mean square. If
the step under L maps (K, T) + ε(X, Z) to a smaller pair, L costs at most this pair. If the best step maps
(K, T) − ε(X, Z) to a larger pair, no stabilising gain costs less. The gain is the one that is stored, in doubles.

Source: khashooei2017, schenato2007
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from taciturn._arrays import NO_VARIANCE, Array, frozen, is_definite, symmetrised
from taciturn._display import Displayed
from taciturn._modes import mode_text, radius
from taciturn._progress import check_time
from taciturn._rational import Limit, precision, unmoved
from taciturn._text import number_of
from taciturn.errors import UnstableError
from taciturn.lqg.critical_losses import Channel, Lasting, Link, LossyStep, MeanSquare
from taciturn.lqg.enclosures import PRECISIONS, UNIT, Balls, Doubles, E, UnprovedError, solve
from taciturn.lqg.equation import ASKED, FEW, sizes
from taciturn.lqg.quadratic import Quadratic, in_powers_of_two, price, worth_of
from taciturn.lqg.riccati import Repetition, costs_nothing, regulate

_TURNS = 100
_NARROW = 1e-6  # least eigenvalue of a form with a unit diagonal that rounding of a recursion leaves its digits
_CRUMB = 1e-11  # part of the terms of a sum up to which a cost next to them has a size of its own
_CORRECTIONS = 5  # steps of Newton's method
FourMatrices: TypeAlias = tuple[Array, Array, Array, Array]  # A, B, Q and R, or K, P, L and Γ
MOST_MODES = 12  # most modes on or outside the unit circle for which critical losses are computed (takes seconds)


@dataclass(frozen=True, eq=False, repr=False)
class LossyRegulator(Displayed):
    """Optimal gains u = L x̂ over lossy links: not sending costs x̂'Γx̂, and an estimation error e costs e'Pe.

    K and P are (n, n), L is (m, n), and Gamma is (n, n). For a finite horizon they have one more leading axis, of
    length N + 1 for K and P, and N for L and Gamma. The least cost of noise, and that of the gain L, differ from
    tr((K + φP)W) by at most tr(error·W), which is proved; ``error`` is 0 for a finite horizon.
    """

    K: Array
    P: Array
    L: Array
    Gamma: Array
    error: Array


def regulate_lossy(A: Array, B: Array, Q: Array, R: Array, channel: Channel) -> LossyRegulator:
    """Compute the gain with the least average cost, over an infinite horizon, for links that drop packets.

    They are the fixed point of :func:`lossy_step`.

    The gains are computed by policy iteration: the cost of a stabilising gain from linear equations, then the best gain
    for this cost. This converges quadratically, and all its gains are stabilising. Balls, or doubles with bounds on
    their rounding, prove that the gain as it is stored is stabilising, and the errors of the costs.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        Q: (n, n) semidefinite state weight.
        R: (m, m) semidefinite input weight.
        channel: loss probabilities, acknowledgement and delay.

    Returns:
        The gains; the average cost of sending every sample is tr((K + φP)W).

    Raises:
        UnstableError: the losses exceed those that mean-square stability allows (the message has the critical values),
            or the cost of some state is not proved to nine digits.

    Source: khashooei2017, schenato2007
    """
    given = Quadratic(A, B, Q, R, np.zeros_like(B))
    seen = worth_of(given).states
    found = _fixed_point(given.among(seen), channel)
    to = np.eye(len(seen))[:, seen]
    K, P, Gamma, error = (frozen(to @ form @ to.T) for form in (found.K, found.P, found.Gamma, found.error))
    return LossyRegulator(K, P, frozen(found.L @ to.T), Gamma, error)


def _fixed_point(given: Quadratic, channel: Channel) -> LossyRegulator:
    """Return the gains of a problem whose states all have a cost-to-go."""
    A, B, Q, R, N = given
    plain = regulate(*given)  # raises an error for uncontrollable modes and for modes that do not affect the cost
    state, unit = in_powers_of_two(plain.K.diagonal()), in_powers_of_two(plain.H.diagonal())
    here = Quadratic(
        A * state / state[:, None], B * unit / state[:, None], Q * state * state[:, None], R * unit * unit[:, None], N
    )
    L = plain.L * state / unit[:, None]
    if MeanSquare(here.A, here.B, L, channel).weights() is None:
        plant = Lasting(A, B)
        gain = plant.gain(channel)
        if gain is None:
            raise UnstableError(
                f"the loop is not mean-square stable: {loss_sentence(A, B, channel)}; expected smaller loss "
                "probabilities, or a finite horizon (cost.horizon)"
            )
        L = gain * state / unit[:, None]
    K, T = _iterated(here, L, channel)
    reason = UnprovedError()
    for bits in (0, *PRECISIONS) if len(A) > FEW else PRECISIONS:
        check_time()
        try:
            with precision(max(bits, PRECISIONS[0])), np.errstate(all="ignore"):
                found = _proved(Balls, here, K, T, channel) if bits else _proved(Doubles, here, K, T, channel)
        except UnprovedError as error:
            reason = error
            continue
        K, P, Gamma, error = (frozen(found[i] / state / state[:, None]) for i in (0, 1, 3, 4))
        return LossyRegulator(K, P, frozen(found[2] * unit[:, None] / state), Gamma, error)
    raise UnstableError(
        f"the gains over lossy links could not be proved to have an error of at most {ASKED:.0e} of the cost-to-go of "
        f"each state: {reason}; expected loss probabilities further from their critical values, modes that the inputs "
        "affect more strongly, or states that decay faster"
    )


def _iterated(here: Quadratic, L: Array, channel: Channel) -> tuple[Array, Array]:
    """Return K and T = K + P by policy iteration in double precision, from a stabilising gain."""
    previous = np.inf
    for _ in range(_TURNS):
        check_time()
        try:
            stage = here.Q + (1 - channel.actuator_loss) * L.T @ here.R @ L
            K, T = MeanSquare(here.A, here.B, L, channel).solve(stage, here.Q)
        except np.linalg.LinAlgError:  # the mean square grows, or hardly decays
            break
        following = lossy_step(here.A, here.B, here.Q, here.R, K, T - K, channel)
        change = float(max(np.abs(following[0] - K).max(), np.abs(following[0] + following[1] - T).max()))
        if change <= 1e-13 * float(np.abs(K).max()) or not change < 0.5 * previous:
            return K, T
        previous, L = change, following[2]
    raise UnstableError(
        "the gains over lossy links could not be computed: the cost with a computed gain is too large; expected loss "
        "probabilities further from their critical values"
    )


def _proved(
    arithmetic: type[E], here: Quadratic, K: Array, T: Array, channel: Channel
) -> tuple[Array, Array, Array, Array, Array]:
    """Return K, P, L and Γ near given K and T = K + P, and a proved bound on the error of the cost K + φP of L."""
    exact, reason = arithmetic.exact, UnprovedError()
    A, B, Q, R = (exact(part) for part in here[:4])
    own, both = exact(K), exact(T)
    for _ in range(_CORRECTIONS):
        price = (R + LossyStep(A, B, Q, R, R, channel).felt(own, both)).centre()  # it needs no gain
        L = solve(price, (B.T @ own @ A).centre()).times(-1.0).middle
        loop, step = MeanSquare(here.A, here.B, L, channel), LossyStep(A, B, Q, R, exact(L), channel)
        try:
            missed = step.missed(own, both)
            own, both = (
                (one + exact(more)).centre()
                for one, more in zip((own, both), loop.solve(missed[0].middle, missed[1].middle), strict=True)
            )
            scale = [sizes(here.A, here.Q, one.middle, _CRUMB) for one in (own, both)]
            X, Z = (exact(one) for one in loop.solve(*(np.diag(size) for size in scale)))
        except np.linalg.LinAlgError as error:
            raise UnprovedError("the cost with the computed gain is too large") from error
        try:
            slack = step.proved(own, both, X, Z, scale)
        except UnprovedError as error:
            reason = error
            continue
        errors = [slack * form.middle for form in (X, Z)]
        if all((np.diag(error) <= ASKED * size).all() for error, size in zip(errors, scale, strict=True)):
            break
        reason = UnprovedError("the error of the cost-to-go is too large")
    else:
        raise reason
    K, T = symmetrised(own.middle), symmetrised(both.middle)
    Gamma = symmetrised((1 - channel.actuator_loss) * L.T @ price.middle @ L)
    P = symmetrised(Gamma + channel.sensor_loss * here.A.T @ (T - K) @ here.A)
    phi = channel.exposure
    rounding = np.abs(K + P - T).sum(axis=1) + 4 * UNIT * np.abs(T).sum(axis=1)
    return K, P, L, Gamma, symmetrised((1 - phi) * errors[0] + phi * errors[1]) + np.diag(rounding)


def lossy_step(
    A: Array, B: Array, Q: Array, R: Array, K: Array, P: Array, channel: Channel
) -> tuple[Array, Array, Array, Array]:
    """Compute the weights K, P, Γ and the gain L of a step over lossy links, from the weights K and P after the step.

    M = R + B'(K + αφP)B (UDP-like) or R + B'KB (TCP-like),  L = −M^{-1}B'KA,  Γ = (1−α) A'KB M^{-1} B'KA,
    K ← Q + A'KA − Γ,  P ← Γ + βA'PA,  with φ = β, or 1 with a one-step delay.

    Raises:
        ProblemError: M is singular.

    Source: khashooei2017, schenato2007
    """
    M, inverse = price(B, K + channel.coupling * P, R)
    if not (is_definite(R) or is_definite(M)) and np.isfinite(M).all():
        raise costs_nothing(M, weight="R or the terminal weight")
    L, alpha = -inverse @ B.T @ K @ A, channel.actuator_loss
    Gamma = symmetrised((1 - alpha) * L.T @ M @ L)
    # Q + A'KA − Γ as a sum of semidefinite terms, whose difference would lose the digits of states that inputs control
    arrived = A + B @ L
    spent = arrived.T @ K @ arrived + L.T @ (R + channel.coupling * B.T @ P @ B) @ L
    return (
        symmetrised(Q + alpha * A.T @ K @ A + (1 - alpha) * spent),
        symmetrised(Gamma + channel.sensor_loss * A.T @ P @ A),
        L,
        Gamma,
    )


def regulate_lossy_finite(
    A: Array, B: Array, Q: Array, R: Array, terminal: Array, horizon: int, channel: Channel
) -> LossyRegulator:
    """Compute the gains that minimise x_N'Q_N x_N + Σ_{k<N} (x'Qx + û'Rû) over links that drop packets."""
    # The recursion starts with K_N = Q_N and P_N = 0. If a cost-to-go is so much smaller than another one that rounding
    # could hide it, the recursion is computed with more digits than doubles have, until these change nothing.
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
                f"the cost-to-go overflows {number_of(horizon - k, 'step')} before the end of the horizon of "
                f"{horizon}: the loss "
                "probabilities are too large for this plant; expected a shorter horizon, or smaller loss "
                "probabilities"
            )
        if repetition.fills((K, P, L, Gamma), k, K[k], P[k]):
            break
    found = (K, P, L, Gamma)
    H = R + B.T @ (K[1] + channel.coupling * P[1]) @ B
    if is_definite(R) and any(map(_is_narrow, (H, *(part[k] for part in (K, P) for k in (0, horizon // 2))))):
        found = _finite_in_balls((A, B, Q, R), terminal, horizon, channel)
    return LossyRegulator(*(frozen(part) for part in (*found, np.zeros((n, n)))))


def _is_narrow(form: Array) -> bool:
    """Return whether a semidefinite form is much smaller in some direction than its diagonal is."""
    kept = np.diag(form) > NO_VARIANCE
    unit = np.sqrt(np.diag(form)[kept])
    return bool(kept.any() and np.linalg.eigvalsh(form[np.ix_(kept, kept)] / unit / unit[:, None])[0] < _NARROW)


def _finite_in_balls(given: FourMatrices, terminal: Array, horizon: int, channel: Channel) -> FourMatrices:
    """Return K, P, L and Γ of :func:`regulate_lossy_finite`, which do not change with twice the number of bits."""
    before: FourMatrices | None = None
    for bits in PRECISIONS:
        with precision(bits):
            try:
                found = _recursion_in_balls(given, terminal, horizon, channel)
            except UnprovedError:
                continue
        if before is not None:
            first, last = ([np.diag(part[0]) for part in forms[:2]] for forms in (before, found))
            if all((np.abs(one - other) <= ASKED * other).all() for one, other in zip(first, last, strict=True)):
                return found
        before = found
    raise UnstableError(
        f"the costs-to-go over lossy links differ so much after {horizon} steps that 1,024 bits are too few for their "
        "sums; expected a shorter horizon, or smaller loss probabilities"
    )


def _recursion_in_balls(given: FourMatrices, terminal: Array, horizon: int, channel: Channel) -> FourMatrices:
    """Return K, P, L and Γ by the recursion of :func:`lossy_step` with the middles of balls."""
    A, B, Q, R = (Balls.exact(part) for part in given)
    K: Balls = Balls.exact(terminal)
    P: Balls = Balls.exact(np.zeros_like(terminal))
    weights, gains = [(K.middle, P.middle)], list[tuple[Array, Array]]()
    for _ in range(horizon):
        check_time()
        felt = K if channel.acknowledged else K + P.times(channel.exposure).times(channel.actuator_loss)
        M = R + B.T @ felt @ B
        L = M.centre().solve((B.T @ K @ A).centre()).times(-1.0).centre()
        whole = (L.T @ M @ L).symmetric()
        Gamma = whole - whole.times(channel.actuator_loss)
        K = (Q + A.T @ K @ A - Gamma).symmetric().centre()
        P = (Gamma + (A.T @ P @ A).times(channel.sensor_loss)).symmetric().centre()
        weights.append((K.middle, P.middle))
        gains.append((L.middle, Gamma.middle))
    forms, answers = zip(*weights[::-1], strict=True), zip(*gains[::-1], strict=True)
    K_all, P_all = (np.array(part) for part in forms)
    L_all, Gamma_all = (np.array(part) for part in answers)
    return K_all, P_all, L_all, Gamma_all


def critical_losses(A: Array, B: Array, channel: Channel) -> tuple[float, float]:
    """Compute the critical loss probability of each link, given the loss probability of the other link.

    The actuator link is first. At or above either value, no linear control keeps the mean square of an unstable plant
    bounded. A value is 1 if losses on the link cannot make the plant unstable, and 0 if the losses on the other link
    alone are too large.

    The values are proved from below: some linear control survives losses below them. That none survives losses above
    them is proved too, at a distance that is mostly 1e-9 of the value.

    Raises:
        UnstableError: a mode on or outside the unit circle is uncontrollable.

    Source: schenato2007
    """
    plant = Lasting(A, B)
    return plant.critical(channel, "actuator").survived, plant.critical(channel, "sensor").survived


def loss_sentence(A: Array, B: Array, channel: Channel) -> str:
    """Write a sentence with the loss probabilities, and their limits for mean-square stability."""
    plant = Lasting(A, B)
    many = plant.count > MOST_MODES
    limits: list[str] = []
    losses: dict[Link, float] = {"actuator": channel.actuator_loss, "sensor": channel.sensor_loss}
    for (link, loss), other in zip(losses.items(), reversed(losses), strict=True):
        if loss and not many and (found := plant.critical(channel, link)).survived > 0:
            limits.append(f"{link} losses {found} at this {other} loss")
    allowed = " or ".join(limits) or "smaller losses on both links"
    return (
        f"{channel.keys[0]} is {channel.actuator_loss:g} and {channel.keys[1]} is {channel.sensor_loss:g}, and for"
        f" this plant (largest eigenvalue {mode_text(complex(radius(A)))}) mean-square stability allows {allowed}"
    )


def no_gain_survives(A: Array, B: Array, channel: Channel) -> bool:
    """Return whether it is proved that, for an unstable plant, every linear gain makes the mean square unbounded."""
    # Only modes that inputs move, and at most twelve that do not decay, are examined.
    if radius(A) <= 1 or unmoved(A, B, Limit(False)).lasting.size:
        return False
    plant = Lasting(A, B)
    return plant.grows and plant.count <= MOST_MODES and plant.exceeded(channel)
