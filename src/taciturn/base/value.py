"""The value function of the base loop, from which the cost of not sending is computed.

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

The value is the least fixed point of these steps, by doubling the horizon. A mode that it does not depend on may be
marginally stable, such as an integrator that nothing reads, or a set-point that the loop follows. A solver for Lyapunov
equations would refuse such modes, and their rounding errors would grow with the horizon. So they are split off first.

Source: schenato2009, antunes2014rollout
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, pushed, symmetrised
from taciturn._display import Displayed
from taciturn._modes import balancing, growth, normal_moments, radius
from taciturn._progress import check_time
from taciturn._rational import Limit
from taciturn._text import ordinal
from taciturn.errors import ProblemError, UnstableError
from taciturn.model.losses import stationary

Fate: TypeAlias = tuple[float, Array, Array]
"""Probability, dynamics and stage weight of an outcome of a step."""
Cycle: TypeAlias = Sequence[Sequence[Sequence[Fate]]]
"""The fates of each step and channel state."""
DOUBLINGS = 64
LONGEST = 45  # doublings in which a mode of modulus 1 − 1e-12 decays
CONVERGED = 1e-14  # relative change of the value within a doubling of the horizon
LARGEST = 1e100  # a larger value has diverged
SEEN = 1e-9  # share of a mode in the value below which the cost does not depend on it
MOST_UNKNOWNS = 2500  # entries of all P_m
MEMORY = 16  # halvings of 1e-14 in the square: steps of a doubled horizon per time constant of the state
WIDTH = 1e-6  # accuracy of the critical loss
SCANS = 32  # losses that are tried, up to the largest, before the critical one is bisected
LASTING = 1 - 1e-6  # modulus from which on a mode is looked at: computed modes of two integrals are off by 1e-8
HIDDEN = 1e-7  # share of the cost below which it does not see a mode
STAYS = 1e-9  # share of a mode that rounding lets a step move into others
# Growth per step above which a loop is unstable, although its cost is finite: computed modes of two integrals that
# the cost does not see lie up to 1e-8 outside the unit circle.
GROWTH = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class Base(Displayed):
    """A linear loop in which each packet carries c = K z, a linear function of the state z."""

    Phi: Array  # dynamics without the choice, (n, n)
    Gamma: Array  # effect of the choice, (n, c)
    stage: Array  # weight of the stage cost, (n + c, n + c)
    K: Array  # the choice of the base, (c, n)
    noise: Array  # covariance of the noise, (n, n)
    candidate: Array | None = None  # the receiver's own value in the next step, (c, n + c)
    unseen: float = 0.0  # cost per step that depends on no choice

    @property
    def silent(self) -> Array:
        """Dynamics of (z, h), (n + c, n + c), in a step in which no packet arrives; h is the value that the receiver
        uses.
        """
        n, c = self.Gamma.shape
        held = np.hstack([np.zeros((c, n)), np.eye(c)]) if self.candidate is None else self.candidate
        return np.vstack([np.hstack([self.Phi, self.Gamma]), held])

    @property
    def replaced(self) -> Array:
        """Matrix R, (n + c, n + c), that maps (z, h) to (z, K z): a packet replaces the receiver's value h by K z."""
        n, c = self.Gamma.shape
        return np.hstack([np.vstack([np.eye(n), self.K]), np.zeros((n + c, c))])


@dataclass(frozen=True, eq=False, repr=False)
class Attempts(Displayed):
    """The steps at which a base loop attempts to send, the losses of its link, and the discount or horizon of
    its cost.
    """

    pattern: tuple[bool, ...] = (True,)  # whether the base attempts in each step of a cycle, or of a finite horizon
    turns: Array = field(default_factory=lambda: np.ones((1, 1)))  # transition probabilities of the channel state
    losses: Array = field(default_factory=lambda: np.zeros(1))  # probability of a dropout in each channel state, (s,)
    discount: float = 1.0  # factor α of the cost per step
    terminal: Array | None = None  # weight of z after a finite horizon, (n, n); None if the pattern repeats for ever
    key: str = "loss"  # the key that states the losses, for messages

    @property
    def start(self) -> Array:
        """Stationary distribution of the channel state of the link, (s,)."""
        return stationary(self.turns)

    @property
    def often(self) -> str:
        """How often the loop attempts to send, as text."""
        period = self.pattern[1:].index(True) + 1 if any(self.pattern[1:]) else len(self.pattern)
        return "every sample" if period == 1 else f"once in {period} steps"

    def scaled(self, factor: float) -> Attempts:
        """Return a copy in which the loss probabilities of the link are multiplied by ``factor``."""
        return replace(self, losses=factor * self.losses)


EVERY_SAMPLE = Attempts()


@dataclass(frozen=True, eq=False, repr=False)
class Advantage(Displayed):
    """Value function of a base loop, and cost of not sending, for each step of its pattern and each channel state."""

    P: Array  # value w'P w of w = (z, h) at the start of the pattern, the mean over the channel states, (n + c, n + c)
    H: Array  # quadratic weight of the deviation of the choice, (steps, s, c, c)
    slope: Array  # linear weight of this deviation, (steps, s, c, n)
    cost: float  # cost per step; of a total, the part that the noise causes
    settling: float  # time constant in steps of the slowest mode that the cost depends on; 0 for a finite horizon
    # growth per step of the fourth moments of the base over a lossy link, as far as the cost depends on them, with a
    # discount α of α² times them; at 1 or more, the variance of the cost is infinite. None without losses, and over a
    # horizon
    fourth: float | None = None


def advantage(base: Base, remedy: str, attempts: Attempts = EVERY_SAMPLE) -> Advantage:
    """Compute the value function of a base loop, and the cost of not sending in this loop."""
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
        if not np.abs(value).max() <= LARGEST * np.abs(base.stage).max():  # also if it is NaN
            raise UnstableError(
                f"the loop of the base policy, which sends {attempts.often}, is not stable: its cost exceeds "
                f"{LARGEST:g} times the weights; expected a stable loop, or a shorter horizon: {remedy}"
            )
    total = attempts.terminal is not None or alpha < 1
    if not total:
        cost /= len(weights)
    elif attempts.terminal is None:
        cost /= 1 - alpha ** len(weights)
    P = symmetrised(np.tensordot(start, value, 1))
    fourth = None
    if attempts.terminal is None and losses.any():
        fourth = fourth_moments(seen, _cycle(base, attempts), attempts.turns)
    return Advantage(P, np.array(H), np.array(slope), float(cost), settling, fourth)


def note_growth(base: Base, attempts: Attempts, remedy: str) -> tuple[str, ...]:
    """Return a note if a base loop with a total cost is unstable, because its cost then grows with the horizon."""
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
    """Return the largest factor of the loss probabilities for which the mean square stays bounded; 0 without one.

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


def repeated_value(base: Base, attempts: Attempts) -> tuple[Array, float] | None:
    """Compute the least value function of a repeating pattern, and its time constant; None for an unstable loop."""
    cycle = _cycle(base, attempts)
    if attempts.losses.any():
        # the receiver's own value may settle a loop that every packet destabilises; such a loop is no base
        if repeated_value(base, attempts.scaled(0.0)) is None:
            return None
        shown, kept = without_hidden(cycle)
        found = lossy(shown, attempts.turns)
        return None if found is None else (kept @ found[0] @ kept.T, found[1])
    F, M = np.eye(len(base.silent)), np.zeros_like(base.stage)
    for fates in cycle:
        _, step, stage = fates[0][0]
        M, F = M + F.T @ stage @ F, step @ F
    if not np.isfinite(F).all() or radius(F) > 1 + GROWTH:  # also a mode that the cost does not depend on
        return None
    P, slowest = least_value(F, symmetrised(M))
    return None if slowest >= 1 else (np.array([P] * len(attempts.losses)), len(cycle) / (1 - slowest))


def cost_of_one_packet(base: Base, steps: int) -> float | None:
    """Return the cost per step if a packet is sent in one of so many steps, without losses; None for an unstable loop.

    The silent steps are doubled, so that a million of them takes as long as twenty.
    """
    # k silent steps take the value P to M + Φ'PΦ, and their noise adds tr(PG) + c. After a steps come b more with
    # M_b + Φ_b'M_aΦ_b, Φ_aΦ_b, G_a + Φ_aG_bΦ_a' and c_a + c_b + tr(M_aG_b).
    size, n = len(base.silent), len(base.Phi)
    R, W = base.replaced, np.zeros((size, size))
    W[:n, :n] = base.noise
    one = (base.stage, base.silent, W, 0.0)
    all_of = (np.zeros((size, size)), np.eye(size), np.zeros((size, size)), 0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        for bit in f"{steps - 1:b}":
            for more in (all_of, *([one] if bit == "1" else [])):
                (M, F, G, c), (M2, F2, G2, c2) = all_of, more
                all_of = M2 + F2.T @ M @ F2, F @ F2, G + F @ G2 @ F.T, c + c2 + float(np.sum(M * G2))
        M, F, G, c = all_of
        first = base.silent @ R
        whole, cycle = symmetrised(R.T @ base.stage @ R + first.T @ M @ first), F @ first
    if not (np.isfinite(whole).all() and np.isfinite(cycle).all() and np.isfinite(G).all()):
        return None
    if radius(cycle) > 1 + GROWTH:
        return None
    P, slowest = least_value(cycle, whole)
    if slowest >= 1:
        return None
    after = M + F.T @ P @ F
    return base.unseen + (float(np.sum(P * G)) + c + float(np.sum(after * W))) / steps


def _last(base: Base, attempts: Attempts, remedy: str) -> tuple[Array, float]:
    """Return the value after the pattern in each channel state, (s, n + c, n + c), and the time constant in steps."""
    c, states = len(base.K), len(attempts.losses)
    if attempts.terminal is not None:
        return np.array([np.pad(attempts.terminal, (0, c))] * states), 0.0
    if attempts.losses.any():
        expect_few_states(len(base.Phi) + c, states)
    found = repeated_value(base, attempts)
    if found is not None:
        return found
    if attempts.losses.any():
        scale = critical_scale(base, attempts)
        stated = " and ".join(f"{p:.4g}" for p in attempts.losses) + " in its states" * (states > 1)
        limit = f"below {scale * attempts.losses[0]:.4g}" if states == 1 else f"below {scale:.4g} times as much"
        reason = f"a loss probability {limit}" if scale else f"a stable loop: {remedy}"
        raise UnstableError(
            f"{attempts.key} sets the loss probability {stated}, so the mean square of the state grows if the loop "
            f"attempts to send {attempts.often}; expected {reason}"
        )
    if len(attempts.pattern) > 1:
        raise UnstableError(
            f"the loop that sends only at every {ordinal(len(attempts.pattern))} step is not stable; expected a "
            f"smaller value of 'every': {remedy}"
        )
    modes = np.linalg.eigvals(base.Phi + base.Gamma @ base.K)
    worst = complex(modes[np.argmax(np.abs(modes))])
    raise UnstableError(
        f"the loop that sends every sample is not stable: it has the eigenvalue {Limit(False).named(worst)}; expected "
        f"eigenvalues inside the unit circle: {remedy}"
    )


def _cycle(base: Base, attempts: Attempts) -> Cycle:
    """Return the fates of each step and channel state: probability, dynamics of (z, h), and stage weight."""
    R, silent = base.replaced, np.sqrt(attempts.discount) * base.silent
    quiet, heard = (silent, base.stage), (silent @ R, symmetrised(R.T @ base.stage @ R))
    return [
        [[(1 - p, *heard), *([(p, *quiet)] if p else [])] if attempt else [(1.0, *quiet)] for p in attempts.losses]
        for attempt in attempts.pattern
    ]


def without_hidden(cycle: Cycle) -> tuple[Cycle, Array]:
    """Return the fates without the lasting modes that no fate moves into the cost, and the map back, (n, k).

    Such modes are set-points that the loop follows: at rest, a packet that is dropped changes nothing.
    """
    fates = [fate for states in cycle for each in states for fate in each]
    unit = balancing(np.sum([np.abs(F) for _, F, _ in fates], axis=0))
    moves = [F / unit[:, None] * unit for _, F, _ in fates]
    stages = [M * unit * unit[:, None] for _, _, M in fates]
    seen = seen_part(moves[0], stages[0])
    if seen.shape[1] == len(unit):
        return cycle, seen
    hidden = np.eye(len(unit)) - seen @ seen.T
    largest = max(float(np.abs(M).max(initial=0.0)) for M in stages)
    stay = all(np.abs(seen.T @ F @ hidden).max(initial=0.0) <= STAYS * max(1.0, np.abs(F).max()) for F in moves)
    if not stay or any(np.abs(M @ hidden).max(initial=0.0) > HIDDEN * largest for M in stages):
        return cycle, np.eye(len(unit))

    small = iter(
        [
            (p, seen.T @ F @ seen, symmetrised(seen.T @ M @ seen))
            for (p, _, _), F, M in zip(fates, moves, stages, strict=True)
        ]
    )
    return [[[next(small) for _ in each] for each in states] for states in cycle], seen / unit[:, None]


def least_value(F: Array, M: Array) -> tuple[Array, float]:
    """Compute the least solution of P = M + F'PF, and the modulus of its slowest mode. P is infinite if none exists.

    The horizon is doubled until the value does not change. ``_modes.summed`` also waits until the powers of F are zero,
    which those of a marginal mode never are.
    """
    if radius(F) < LASTING:
        return _doubled(F, M)
    unit = balancing(F)
    scaled = F / unit[:, None] * unit, M * unit * unit[:, None]
    seen = seen_part(*scaled)
    P, slowest = _doubled(seen.T @ scaled[0] @ seen, symmetrised(seen.T @ scaled[1] @ seen))
    return symmetrised(seen @ P @ seen.T) / unit / unit[:, None], slowest


def seen_part(F: Array, C: Array) -> Array:
    """Return coordinates, (k, n), of z⁺ = F z without the modes that neither decay nor affect C z.

    The sizes of the states must be comparable.
    """
    whole = np.eye(len(F))
    lasting, basis, many = _scipy.real_schur(F, LASTING)
    if not many:
        return whole
    rows = [C @ basis[:, :many]]
    for _ in range(1, many):
        rows.append(rows[-1] @ lasting[:many, :many])
    _, sizes, directions = np.linalg.svd(np.vstack(rows), full_matrices=True)
    rank = int((sizes > HIDDEN * np.linalg.norm(C, 2)).sum())
    hidden = basis[:, :many] @ directions[rank:].T
    return np.asarray(np.linalg.svd(hidden, full_matrices=True)[0][:, hidden.shape[1] :], dtype=np.float64)


def _doubled(F: Array, M: Array) -> tuple[Array, float]:
    """Return the sum of F'^k M F^k by doubling the horizon, and the modulus of the slowest mode that it depends on."""
    P, step = M, F
    size = float(np.abs(P).max(initial=0.0))
    for _ in range(LONGEST):
        check_time()
        added = symmetrised(step.T @ P @ step)
        P, step, size = P + added, step @ step, float(np.abs(P + added).max(initial=0.0))
        if size > LARGEST or np.abs(added).max(initial=0.0) <= CONVERGED * size:
            break
    else:
        # a mode that does not decay in so many steps is 1 up to rounding, and the sum is what rounding made of infinity
        return P, np.inf
    if size > LARGEST:
        return P, np.inf
    modes, vectors = np.linalg.eig(F)
    seen = np.abs(np.einsum("ji,jk,ki->i", vectors.conj(), P, vectors)) > SEEN * size
    return P, float(np.abs(modes)[seen].max(initial=0.0))


def lossy(cycle: Cycle, turns: Array) -> tuple[Array, float] | None:
    """Compute the least values P_m ≥ 0 at the start of a cycle, and their time constant; None if they are infinite.

    All P_m are unknowns of one linear map, and the horizon is doubled as without losses.
    """
    size, s = len(cycle[0][0][0][1]), len(turns)
    rows, columns = np.triu_indices(size)
    d = len(rows)
    spread = np.zeros((size * size, d))  # from the upper triangle to the whole matrix
    spread[rows * size + columns, np.arange(d)] = 1.0
    spread[columns * size + rows, np.arange(d)] = 1.0
    upper = rows * size + columns
    step, value = np.eye(s * d), np.zeros(s * d)
    for states in reversed(cycle):
        before, stage = np.zeros((s * d, s * d)), np.zeros(s * d)
        for m, fates in enumerate(states):
            here = slice(m * d, (m + 1) * d)
            mean = np.zeros((d, d))
            for p, F, M in fates:
                mean += p * (np.kron(F.T, F.T) @ spread)[upper]
                stage[here] += p * M[rows, columns]
            for other in range(s):
                before[here, other * d : (other + 1) * d] = turns[m, other] * mean
        step, value = before @ step, before @ value + stage
    for doubling in range(DOUBLINGS):
        check_time()
        added = step @ value
        value = value + added
        largest = float(np.abs(value).max(initial=0.0))
        if not largest <= LARGEST:
            return None
        if np.abs(added).max(initial=0.0) <= CONVERGED * largest:
            P = (spread @ value.reshape(s, d).T).T.reshape(s, size, size)
            return P, len(cycle) * 2.0**doubling / MEMORY
        step = step @ step
        if not np.isfinite(step).all():
            return None
    return None


def expect_few_states(size: int, channels: int) -> None:
    """Raise an error if the number of unknowns in the value function over a lossy link is too large."""
    if channels * size * (size + 1) // 2 > MOST_UNKNOWNS:
        raise ProblemError(
            f"the plant, the controller and the model of the link have {size} states together, too many to compute the "
            "cost-to-go over a link that drops packets; expected fewer states, or a link without losses"
        )


def fourth_moments(P: Array, cycle: Cycle, turns: Array) -> float:
    """Compute the growth factor per step of the fourth moments of the states with a nonzero weight in P."""
    size, vectors = np.linalg.eigh(P)
    seen = vectors[:, size > SEEN * size.max(initial=0.0)]
    shape = (len(turns), *[seen.shape[1]] * 4)
    reduced = [[[(p, seen.T @ F @ seen) for p, F, _ in fates] for fates in states] for states in cycle]

    def moved(moments: Array) -> Array:
        for states in reduced:
            after = np.zeros(shape)
            for m, fates in enumerate(states):
                for p, F in fates:
                    after[m] += p * pushed(F, moments[m], 4)
            moments = np.tensordot(turns.T, after, 1)
        return moments

    return growth(moved, np.stack([normal_moments(seen.shape[1], 4)] * len(turns))) ** (1 / len(cycle))
