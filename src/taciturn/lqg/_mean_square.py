"""Mean-square cost and growth of a loop over lossy links under a given gain.

The cost-to-go has a weight K of the state and a weight P of the estimation error. One step of the loop is a linear map
of the pairs (K, T), T = K + P:

    K ← M'KM + αᾱ L'YL,   T ← A'((1−β)K + βT)A,   M = A + ᾱBL,   Y = B'((1−φ)K + φT)B.

These are two Lyapunov equations, coupled only by the symmetric matrix Y, whose size is the number of inputs. So a loop
with sixty states needs only a few Lyapunov equations with sixty states, instead of one system of 7200 unknowns.

The map preserves the order of pairs. So if it maps a definite pair to a smaller one, the mean square is bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, Literal, NamedTuple

import numpy as np

from taciturn._arrays import NO_VARIANCE, Array, symmetrised
from taciturn._display import Displayed
from taciturn._growth import growth
from taciturn._modes import summed
from taciturn.lqg.enclosures import E, UnprovedError, block
from taciturn.lqg.lyapunov import relative

SINGULAR = 1e-12  # least eigenvalue of a price of unit diagonal to which the proof is adapted


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

    def at(self, link: Literal["actuator", "sensor"], loss: float) -> Channel:
        """Return these links with another loss of one of them."""
        return replace(self, actuator_loss=loss) if link == "actuator" else replace(self, sensor_loss=loss)

    @property
    def exposure(self) -> float:
        """Probability φ that an estimation error affects the next input: the sensor loss, or 1 if there is a delay."""
        return 1.0 if self.delayed else self.sensor_loss

    @property
    def reach(self) -> float:
        """Probability that an error that an unacknowledged input makes still persists at the next control."""
        return 0.0 if self.acknowledged else self.exposure

    @property
    def coupling(self) -> float:
        """Factor αφ by which an unacknowledged input adds to the estimation error; 0 with acknowledgements."""
        return self.actuator_loss * self.reach


class MeanSquare:
    """The linear map of the pairs of weights (K, T) of a loop under a given gain, divided by a level in every step.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        L: (m, n) gain.
        channel: loss probabilities, acknowledgement and delay.
        level: growth per step by which the map is divided.
    """

    def __init__(self, A: Array, B: Array, L: Array, channel: Channel, level: float = 1.0) -> None:
        """Store the loop."""
        self.A, self.B, self.L, self.channel, self.level = A, B, L, channel, level
        self.alpha, self.beta = channel.actuator_loss, channel.sensor_loss
        self.moved = A + (1 - self.alpha) * (B @ L)  # M: the mean of A + BL and A over the losses
        self.spread = self.alpha * (1 - self.alpha)  # variance of the loss

    def step(self, K: Array, T: Array) -> tuple[Array, Array]:
        """Return the pair before a step."""
        own = self.moved.T @ K @ self.moved + self.spread * self.L.T @ self._seen(K, T) @ self.L
        both = self.A.T @ ((1 - self.beta) * K + self.beta * T) @ self.A
        return symmetrised(own) / self.level, symmetrised(both) / self.level

    def growth(self) -> float:
        """Return the factor by which the mean square of the loop, without noise, grows per step."""
        return growth(lambda pair: np.stack(self.step(*pair)), np.stack([np.eye(len(self.A))] * 2))

    def weights(self) -> tuple[Array, Array] | None:
        """Return K and T of unit costs; None if the mean square does not grow by less than the level.

        It does if and only if both are definite, and each step leaves the unit of both.
        """
        one = np.eye(len(self.A))
        try:
            with np.errstate(all="ignore"):
                pair = self.solve(one, one)
        except np.linalg.LinAlgError:
            return None
        left = (part - after for part, after in zip(pair, self.step(*pair), strict=True))
        least = [float(np.linalg.eigvalsh(part)[0]) for part in (*pair, *(self.level * part for part in left))]
        return pair if min(least) > 1e-3 else None

    def solve(self, first: Array, second: Array) -> tuple[Array, Array]:
        """Solve the coupled Lyapunov equations of the loop for the weights K and T.

        K and T are the sums over all steps of terms that are added in each step.

        Args:
            first: term added to K, (n, n).
            second: term added to T, (n, n).

        Raises:
            LinAlgError: the level is the growth itself, or so close to it that the sums overflow, or far below it.
        """
        K, T = self._apart(first, second)
        if self.spread:  # solved without coupling; then for the coupling Y = Y_0 + turn·Y
            upper = np.triu_indices(len(self.L))
            answers = [self._apart(self._pushed(i, j), np.zeros_like(self.A)) for i, j in np.transpose(upper).tolist()]
            turn = np.stack([self._seen(*pair)[upper] for pair in answers], axis=1)
            y = np.linalg.solve(np.eye(len(turn)) - turn, self._seen(K, T)[upper])
            for share, (one, two) in zip(y.tolist(), answers, strict=True):
                K, T = K + share * one, T + share * two
        if not all(np.isfinite(part).all() for part in (K, T)):
            raise np.linalg.LinAlgError
        return symmetrised(K), symmetrised(T)

    def _pushed(self, i: int, j: int) -> Array:
        """Return the term of K from an entry of Y and its mirror image."""
        one = self.spread * np.outer(self.L[i], self.L[j])
        return one if i == j else one + one.T

    def _seen(self, K: Array, T: Array) -> Array:
        return symmetrised(self.B.T @ (K + self.channel.reach * (T - K)) @ self.B)

    def _apart(self, first: Array, second: Array) -> tuple[Array, Array]:
        root = np.sqrt(self.level)
        with np.errstate(over="ignore", invalid="ignore"):  # callers check for overflow
            K = summed((self.moved / root).T, symmetrised(first)) / self.level
            second = second + (1 - self.beta) * self.A.T @ K @ self.A
            T = summed((np.sqrt(self.beta) / root * self.A).T, symmetrised(second)) / self.level
        return K, T


class LossyStep(NamedTuple, Generic[E]):
    """Enclosures of a problem and a gain over lossy links: how one step changes the pairs of weights (K, T)."""

    A: E
    B: E
    Q: E
    R: E
    L: E
    channel: Channel

    def linear(self, K: E, T: E) -> tuple[E, E]:
        """Return the weights before a step without stage costs."""
        A, L = self.A, self.L
        moved = L.T @ self.B.T @ K @ A
        first = A.T @ K @ A + self.arriving(moved + moved.T + L.T @ self.felt(K, T) @ L)
        second = A.T @ (K + (T - K).times(self.channel.sensor_loss)) @ A
        return first.symmetric(), second.symmetric()

    def felt(self, K: E, T: E) -> E:
        """Return the weight B'(K + αφP)B of an input through its effect on state and error."""
        direct = self.B.T @ K @ self.B
        if self.channel.coupling:
            wrong = self.B.T @ (T - K) @ self.B
            direct = direct + wrong.times(self.channel.actuator_loss).times(self.channel.reach)
        return direct.symmetric()

    def arriving(self, form: E) -> E:
        """Return the share 1 − α of a form."""
        return form - form.times(self.channel.actuator_loss)

    def missed(self, K: E, T: E) -> tuple[E, E]:
        """Return what a step adds to the weights."""
        first, second = self.linear(K, T)
        spent = self.arriving(self.L.T @ self.R @ self.L)
        return (first + self.Q + spent - K).symmetric(), (second + self.Q - T).symmetric()

    def falls(self, X: E, Z: E) -> tuple[E, E]:
        """Return by what a step without costs reduces a pair: the proof that the mean square is bounded.

        Raises:
            UnprovedError: the pair, or what a step reduces it by, is not proved to be definite.
        """
        after = self.linear(X, Z)
        falls = (X - after[0]).symmetric(), (Z - after[1]).symmetric()
        if not all(form.definite() for form in (X, Z, *falls)):
            raise UnprovedError("the mean square is not proved to be bounded")
        return falls

    def proved(self, K: E, T: E, X: E, Z: E, sizes: Sequence[Array]) -> float:
        """Return ε with the best weights, and those of the gain, between (K, T) ± ε(X, Z).

        Args:
            K, T: the weights.
            X, Z: a pair that a step without costs reduces.
            sizes: the diagonals of K and T.

        Raises:
            UnprovedError: the proof fails.
        """
        falls, missed = self.falls(X, Z), self.missed(K, T)
        price, pushed = self.R + self.felt(K, T), self.felt(X, Z)
        off, turned = price @ self.L + self.B.T @ K @ self.A, pushed @ self.L + self.B.T @ X @ self.A
        cost = np.sqrt(np.maximum(np.diag(price.middle), NO_VARIANCE))
        parts = [relative(form, size) for form, size in zip(missed, sizes, strict=True)]
        least = max(float(np.linalg.eigvalsh(price.middle / cost / cost[:, None]).min(initial=1.0)), SINGULAR)
        slack = 4 * max(*parts, float(((off.most / cost[:, None]) ** 2 / sizes[0]).sum()) / least)
        off, price = (self.arriving(one - more.times(slack)) for one, more in ((off, turned), (price, pushed)))
        lower = falls[0].times(slack) + missed[0]
        if self.channel.actuator_loss < 1:
            lower = block([[lower, off.T], [off, price.symmetric()]])
        above = ((falls[i].times(slack) - missed[i]).definite() for i in (0, 1))
        if not (lower.definite() and (falls[1].times(slack) + missed[1]).definite() and all(above)):
            raise UnprovedError("the error of the cost-to-go is not proved")
        return slack
