"""Optimal control over a link that drops inputs, if measurements of the state arrive late: gains, and their exact cost.

The controller moves the newest measurement x_{k−a} to the present with the inputs that it has sent since then. So its
error is the sum of what noise and unnoticed losses have added in the last a steps, each moved on by A. A measurement
arrives at most j steps after it was sent with the probability F_j, independently of others. An error that was added in
a step is still there a steps later if no measurement of that step or of a later one has come:

    S_a = q_0 q_1 ⋯ q_a,   q_j = 1 − F_j,   q_j = q_D for j > D.

With the cost x̂'Γx̂ of silence (``lossy``), an error that is a steps old costs from now on, if it was not corrected now,

    X_a ← Γ + q_{a+1} A' X_{a+1} A,   X_D ← Γ + q_D A' X_D A,

and what is added in a step costs G = q_0 X_0 from the next step on. So all equations of lossy links hold with G in
place of φP: M = R + B'(K + αG)B without acknowledgements, and the average cost of attempts in every step is
tr((K + G)W).

With acknowledgements, or without losses of inputs, K does not depend on G, and X_D is the weight P of a link that drops
measurements with the probability q_D, which is proved. Otherwise, the recursion is repeated from there to its limit;
its error is estimated from the last change and the growth of the mean square.

Source: khashooei2017, schenato2007, schenato2008
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from taciturn._arrays import Array, frozen, symmetrised
from taciturn._modes import growth
from taciturn._progress import check_time
from taciturn.errors import UnstableError
from taciturn.lqg.critical_losses import Channel
from taciturn.lqg.lossy import LossyRegulator, lossy_step, regulate_lossy, regulate_lossy_finite

MOST_STEPS = 100_000
SAME = 1e-14  # relative change of the weights in a step with which the recursion ends
HUGE = 1e12  # growth of the weights, relative to those without delays, from which on they diverge


class LateSamples(NamedTuple):
    """The channel of measurements that arrive late, independently of each other."""

    channel: Channel  # its sensor loss is the probability q_0 that a measurement does not arrive at once
    missing: tuple[float, ...]  # probability q_j that a measurement has not arrived j steps after it was sent

    @staticmethod
    def of(channel: Channel, arriving: Sequence[float]) -> LateSamples:
        """Return the channel whose packets, if not dropped, have a delay of 0, 1, … steps with given probabilities."""
        come = (1 - channel.sensor_loss) * np.cumsum(arriving)
        missing = tuple(np.clip(1 - come, 0.0, 1.0).round(15).tolist())
        return LateSamples(replace(channel, sensor_loss=missing[0]), missing)

    @property
    def settled(self) -> bool:
        """Whether the cost-to-go does not depend on the errors."""
        return self.channel.acknowledged or self.channel.actuator_loss == 0.0

    def aged(self, A: Array, Gamma: Array, X: Sequence[Array]) -> list[Array]:
        """Return the weights X_a of errors by their age, from those of the next step and the cost Γ of silence."""
        later = (*range(1, len(X)), len(X) - 1)
        return [symmetrised(Gamma + self.missing[age] * A.T @ X[age] @ A) for age in later]

    def growth(self, A: Array, B: Array, L: Array) -> float:
        """Compute the factor by which the mean square of the loop without noise grows per step, with a given gain."""
        # in pairs (K, T_a = K + X_a), whose order a step preserves
        alpha, q = self.channel.actuator_loss, self.missing
        moved, spread = A + (1 - alpha) * B @ L, alpha * (1 - alpha)
        reach = 0.0 if self.channel.acknowledged else q[0]
        later = (*range(1, len(q)), len(q) - 1)

        def step(forms: Array) -> Array:
            K, T = forms[0], forms[1:]
            felt = B.T @ ((1 - reach) * K + reach * T[0]) @ B
            own = moved.T @ K @ moved + spread * L.T @ felt @ L
            return np.stack([own, *(A.T @ ((1 - q[age]) * K + q[age] * T[age]) @ A for age in later)])

        return growth(step, np.stack([np.eye(len(A))] * (1 + len(q))))


def regulate_late(A: Array, B: Array, Q: Array, R: Array, late: LateSamples) -> LossyRegulator:
    """Compute the gain with the least average cost if measurements arrive late; ``P`` is X_0.

    Raises:
        UnstableError: losses and delays exceed those that mean-square stability allows.
    """
    at_last = replace(late.channel, sensor_loss=late.missing[-1])
    found = regulate_lossy(A, B, Q, R, at_last)
    K, X, L, Gamma = found.K, [found.P] * len(late.missing), found.L, found.Gamma
    error = found.error
    for age in reversed(range(len(X) - 1)):
        X[age] = symmetrised(Gamma + late.missing[age + 1] * A.T @ X[age + 1] @ A)
    if late.settled:
        # the error of P moves on as P does
        moved = error
        for q in late.missing[:-1]:
            moved = q * A.T @ moved @ A
        return LossyRegulator(K, frozen(X[0]), L, Gamma, symmetrised(error + moved))
    most = HUGE * max(float(np.abs(K).max()), float(np.abs(X[-1]).max()))
    for step in range(MOST_STEPS):
        if step % 1000 == 0:
            check_time()
        following = lossy_step(A, B, Q, R, K, X[0], late.channel)
        after = late.aged(A, following[3], X)
        pairs = zip((K, *X), (following[0], *after), strict=True)
        sizes = [(float(np.abs(new - old).max()), float(np.abs(new).max())) for old, new in pairs]
        K, X, L, Gamma = following[0], after, following[2], following[3]
        if not max(size for _, size in sizes) < most:
            break
        if all(change <= SAME * size for change, size in sizes):
            rate = late.growth(A, B, L)
            if not rate < 1:
                break
            left = [change / (1 - rate) for change, _ in sizes]
            return LossyRegulator(
                frozen(K), frozen(X[0]), frozen(L), frozen(Gamma), error + np.eye(len(A)) * (left[0] + left[1])
            )
    raise UnstableError(
        f"{late.channel.keys[0]} is {late.channel.actuator_loss:g}, no packet is acknowledged, and "
        f"{100 * late.missing[0]:.4g} % of the measurements are late or lost, so the mean square of the state grows "
        "without limit or settles too slowly; expected smaller losses or delays, acknowledgements (protocol = 'tcp'), "
        "or a finite horizon (cost.horizon)"
    )


def regulate_late_finite(
    A: Array, B: Array, Q: Array, R: Array, terminal: Array, horizon: int, late: LateSamples
) -> LossyRegulator:
    """Compute the gains for a total cost over a horizon if measurements arrive late; ``P`` is X_0 of each step."""
    if late.settled:
        found = regulate_lossy_finite(A, B, Q, R, terminal, horizon, late.channel)
        K, L, Gamma = (np.array(part) for part in (found.K, found.L, found.Gamma))
    else:
        K, L, Gamma = (np.zeros((horizon + (part is A), *part.shape)) for part in (A, B.T, Q))
        K[horizon] = terminal
    X, P = [np.zeros_like(A)] * len(late.missing), np.zeros((horizon + 1, *A.shape))
    for k in reversed(range(horizon)):
        if not late.settled:
            K[k], _, L[k], Gamma[k] = lossy_step(A, B, Q, R, K[k + 1], X[0], late.channel)
        X = late.aged(A, Gamma[k], X)
        P[k] = X[0]
        if not np.isfinite(K[k] @ K[k] + P[k] @ P[k]).all():
            raise UnstableError(
                f"the cost-to-go overflows before the start of the horizon of {horizon}: losses and delays are too "
                "large for this plant; expected a shorter horizon, or smaller losses and delays"
            )
    return LossyRegulator(*(frozen(part) for part in (K, P, L, Gamma, np.zeros_like(A))))
