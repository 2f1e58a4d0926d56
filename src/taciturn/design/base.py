"""A base, the loop whose sends the cost of silence refers to, and the value of its states.

In each step of the loop, a packet carries the choice c = K z, where z contains everything that the loop uses. In
silence, the receiver uses a value h of its own. With the value c or h, the loop moves by z⁺ = Φ z + Γ c + noise at the
stage cost [z; c]'S[z; c], and the receiver's own value in the next step is M (z, c): the last value, M = (0, I), or the
prediction of a model.

The base attempts to send at given steps, and the link drops a packet with the probability p_m in channel state m. A
dropout acts as silence. The value w'P_m w of w = (z, h) is computed backwards, with P' for the next step:

    Y_m = S + [Φ Γ; M]' α Σ_m' T_mm' P'_m' [Φ Γ; M],    P_m = p_m Y_m + (1 − p_m) R'Y_m R,    R = [I 0; K 0],

or P_m = Y_m in a step in which the base is silent. T contains the transition probabilities of the channel, and α is the
discount. Silence with h = K z + e costs (1 − p_m)[e'He + 2e'(slope) z] more than an attempt, now and later, with the
blocks H = Y_hh and slope = Y_hz + Y_hh K. For every policy that decides when to be silent, the cost exceeds that of the
base by the mean of this over its silent steps, where the base attempts. LQG minimises its own value: its slope is zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._display import Displayed
from taciturn._exact_modes import Limit
from taciturn._modes import radius
from taciturn._progress import check_time
from taciturn._text import ordinal
from taciturn.design import _fixed_point
from taciturn.errors import UnstableError
from taciturn.model.losses import stationary

WIDTH = 1e-6  # accuracy of the critical loss
SCANS = 32  # losses that are tried, up to the largest, before the critical one is bisected
# Growth per step above which a loop is unstable, although its cost is finite: computed modes of two integrals that
# the cost does not see lie up to 1e-8 outside the unit circle.
GROWTH = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class Base(Displayed):
    """A loop whose packets carry a linear choice, as a linear system.

    Args:
        Phi: dynamics without the choice, (n, n).
        Gamma: effect of the choice, (n, c).
        stage: weight of the stage cost, (n + c, n + c).
        K: the choice of the base, (c, n).
        noise: covariance of the noise, (n, n).
        candidate: the receiver's own value in the next step, (c, n + c); default: the value that it uses now.
        unseen: cost per step that depends on no choice.
    """

    Phi: Array
    Gamma: Array
    stage: Array
    K: Array
    noise: Array
    candidate: Array | None = None
    unseen: float = 0.0

    @property
    def silent(self) -> Array:
        """Dynamics of (z, h) in a silent step, (n + c, n + c)."""
        n, c = self.Gamma.shape
        held = np.hstack([np.zeros((c, n)), np.eye(c)]) if self.candidate is None else self.candidate
        return np.vstack([np.hstack([self.Phi, self.Gamma]), held])

    @property
    def replaced(self) -> Array:
        """The map R from (z, h) to (z, K z), as a packet replaces the receiver's value, (n + c, n + c)."""
        n, c = self.Gamma.shape
        return np.hstack([np.vstack([np.eye(n), self.K]), np.zeros((n + c, c))])


@dataclass(frozen=True, eq=False, repr=False)
class Attempts(Displayed):
    """The steps at which a base attempts to send, the link that drops its packets, and the sum that its cost is.

    Args:
        pattern: whether the base attempts in each step of a cycle, or of a finite horizon.
        turns: transition probabilities of the channel state, (s, s).
        losses: probability of a dropout in each channel state, (s,).
        discount: factor α of the cost per step.
        terminal: weight of z after a finite horizon, (n, n); None if the pattern repeats for ever.
        key: the key that states the losses, for messages.
    """

    pattern: tuple[bool, ...] = (True,)
    turns: Array = field(default_factory=lambda: np.ones((1, 1)))
    losses: Array = field(default_factory=lambda: np.zeros(1))
    discount: float = 1.0
    terminal: Array | None = None
    key: str = "loss"

    @property
    def start(self) -> Array:
        """Stationary distribution of the channel state, (s,)."""
        return stationary(self.turns)

    @property
    def often(self) -> str:
        """How often the base attempts to send, as text."""
        period = self.pattern[1:].index(True) + 1 if any(self.pattern[1:]) else len(self.pattern)
        return "every sample" if period == 1 else f"once in {period} steps"

    def scaled(self, factor: float) -> Attempts:
        """Return the same attempts over a link with ``factor`` times the losses."""
        return replace(self, losses=factor * self.losses)


EVERY_SAMPLE = Attempts()


@dataclass(frozen=True, eq=False, repr=False)
class Advantage(Displayed):
    """The value of a base, and the cost of silence in each step of its pattern and each channel state.

    Args:
        P: value w'P w of w = (z, h) at the start of the pattern, the mean over the channel states, (n + c, n + c).
        H: quadratic weight of the deviation of the choice, (steps, s, c, c).
        slope: linear weight of this deviation, (steps, s, c, n).
        cost: cost per step; of a total, the part that the noise causes.
        settling: time constant in steps of the slowest mode that the cost depends on; 0 for a finite horizon.
        fourth: growth per step of the fourth moments of the base over a lossy link, as far as the cost depends on them,
            with a discount α of α² times them; at 1 or more, the variance of the cost is infinite. None without losses,
            and over a horizon.
    """

    P: Array
    H: Array
    slope: Array
    cost: float
    settling: float
    fourth: float | None = None


def advantage(base: Base, remedy: str, attempts: Attempts = EVERY_SAMPLE) -> Advantage:
    """Return the value of a base, and the cost of silence.

    Raises:
        UnstableError: the cost of the base is infinite; the message ends with ``remedy``, or states the critical loss.
        ProblemError: the loop has too many states for the value over a lossy link.
    """
    n, alpha, losses = len(base.Phi), attempts.discount, attempts.losses
    value, settling = _last(base, attempts, remedy)
    closed, silent, start = base.replaced[:, :n], base.silent, attempts.start
    H, slope, weights = list[Array](), list[Array](), alpha ** np.arange(len(attempts.pattern))
    cost, seen = base.unseen * float(weights.sum()), np.zeros_like(base.stage)
    for attempt, weight in zip(reversed(attempts.pattern), reversed(weights), strict=True):
        ahead = alpha * np.tensordot(attempts.turns, value, 1)
        cost += weight * float(np.einsum("m,mij,ij", start, ahead[:, :n, :n], base.noise))
        Y = base.stage + silent.T @ ahead @ silent
        Y = (Y + Y.swapaxes(1, 2)) / 2
        reached = (1 - losses)[:, None, None]
        H.insert(0, reached * Y[:, n:, n:])
        slope.insert(0, reached * (Y[:, n:] @ closed))
        value = Y
        if attempt:
            value = losses[:, None, None] * Y
            value[:, :n, :n] += reached * (closed.T @ Y @ closed)
        seen = seen + value.sum(axis=0)
        if not np.abs(value).max() <= _fixed_point.LARGEST * np.abs(base.stage).max():  # also if it is NaN
            raise UnstableError(
                f"the base of the policy, which sends {attempts.often}, is not stable, and its cost exceeds "
                f"{_fixed_point.LARGEST:g} times the weights; expected a stable loop, or a shorter horizon: {remedy}"
            )
    total = attempts.terminal is not None or alpha < 1
    if not total:
        cost /= len(weights)
    elif attempts.terminal is None:
        cost /= 1 - alpha ** len(weights)
    P = symmetrised(np.tensordot(start, value, 1))
    fourth = None
    if attempts.terminal is None and losses.any():
        fourth = _fixed_point.fourth(seen, _cycle(base, attempts), attempts.turns)
    return Advantage(P, np.array(H), np.array(slope), float(cost), settling, fourth)


def note_growth(base: Base, attempts: Attempts, remedy: str) -> tuple[str, ...]:
    """Return a remark if the base of a total cost is not stable, so that its cost grows with the horizon."""
    if attempts.terminal is None:
        return ()
    grows = radius(base.Phi + base.Gamma @ base.K)
    if all(attempts.pattern) and grows > 1 + GROWTH:
        return (
            f"the loop that sends every sample is not stable, and its deviations grow by a factor of {grows:.4g} per "
            f"step: its cost, to which the bound refers, grows with the horizon; expected a stable loop: {remedy}",
        )
    return ()


def critical_scale(base: Base, attempts: Attempts) -> float:
    """Return the largest factor of the losses up to which the mean square of the base does not grow; 0 for none.

    The growth need not be monotone: with losses above a range that is too high, it may decay again, for example where
    the gain moves the plant faster than zero input. So the losses are raised step by step from zero.
    """
    most = 1 / float(attempts.losses.max())
    low = 0.0
    for high in np.linspace(0.0, most, SCANS + 1).tolist():
        if repeated_value(base, attempts.scaled(high)) is None:
            break
        low = high
    else:
        return most
    while high - low > WIDTH * max(high, WIDTH * most):
        check_time()
        middle = (low + high) / 2
        low, high = (middle, high) if repeated_value(base, attempts.scaled(middle)) is not None else (low, middle)
    return low


def _last(base: Base, attempts: Attempts, remedy: str) -> tuple[Array, float]:
    """Return the value after the pattern in each channel state, (s, n + c, n + c), and the time constant in steps."""
    c, states = len(base.K), len(attempts.losses)
    if attempts.terminal is not None:
        return np.array([np.pad(attempts.terminal, (0, c))] * states), 0.0
    if attempts.losses.any():
        _fixed_point.expect_few_states(len(base.Phi) + c, states)
    found = repeated_value(base, attempts)
    if found is not None:
        return found
    if attempts.losses.any():
        scale = critical_scale(base, attempts)
        stated = " and ".join(f"{p:.4g}" for p in attempts.losses) + " in its states" * (states > 1)
        limit = f"below {scale * attempts.losses[0]:.4g}" if states == 1 else f"below {scale:.4g} times as much"
        reason = f"a loss {limit}" if scale else f"a stable loop: {remedy}"
        raise UnstableError(
            f"{attempts.key} is {stated}, and the mean square of the loop that attempts to send {attempts.often} "
            f"grows; expected {reason}"
        )
    if len(attempts.pattern) > 1:
        raise UnstableError(
            f"the loop that sends at every {ordinal(len(attempts.pattern))} step is not stable; expected a smaller "
            f"every: {remedy}"
        )
    modes = np.linalg.eigvals(base.Phi + base.Gamma @ base.K)
    worst = complex(modes[np.argmax(np.abs(modes))])
    raise UnstableError(
        f"the loop that sends every sample is not stable: it has the eigenvalue {Limit(False).named(worst)}; expected "
        f"eigenvalues inside the unit circle: {remedy}"
    )


def repeated_value(base: Base, attempts: Attempts) -> tuple[Array, float] | None:
    """Return the least value of a repeated pattern, and its time constant in steps; None if the loop is unstable."""
    cycle = _cycle(base, attempts)
    if attempts.losses.any():
        # the receiver's own value may settle a loop that every packet destabilises; such a loop is no base
        apart = repeated_value(base, attempts.scaled(0.0)) is None
        return None if apart else _fixed_point.lossy(cycle, attempts.turns)
    F, M = np.eye(len(base.silent)), np.zeros_like(base.stage)
    for fates in cycle:
        _, step, stage = fates[0][0]
        M, F = M + F.T @ stage @ F, step @ F
    if not np.isfinite(F).all() or radius(F) > 1 + GROWTH:  # also a mode that the cost does not depend on
        return None
    P, slowest = _fixed_point.least_value(F, symmetrised(M))
    return None if slowest >= 1 else (np.array([P] * len(attempts.losses)), len(cycle) / (1 - slowest))


def _cycle(base: Base, attempts: Attempts) -> _fixed_point.Cycle:
    """Return the fates of each step and channel state: probability, dynamics of (z, h), and stage weight."""
    R, silent = base.replaced, np.sqrt(attempts.discount) * base.silent
    quiet, heard = (silent, base.stage), (silent @ R, symmetrised(R.T @ base.stage @ R))
    return [
        [[(1 - p, *heard), *([(p, *quiet)] if p else [])] if attempt else [(1.0, *quiet)] for p in attempts.losses]
        for attempt in attempts.pattern
    ]
