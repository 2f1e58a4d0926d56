"""Mean-square cost and growth of a loop over lossy links under a given gain.

The cost-to-go has a weight K of the state and a weight P of the estimation error. One step of the loop is a linear map
of the pairs (K, T), T = K + P:

    K ← M'KM + αᾱ L'YL,   T ← A'((1−β)K + βT)A,   M = A + ᾱBL,   Y = B'((1−φ)K + φT)B.

These are two Lyapunov equations, coupled only by the symmetric matrix Y, whose size is the number of inputs. So a loop
with sixty states needs only a few Lyapunov equations with sixty states, instead of one system of 7200 unknowns.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, symmetrised
from taciturn._modes import radius, summed

FEW = 6  # most states for which one linear system, of up to 72 unknowns, is faster
NEAREST = 1e-12  # least relative distance to the level at which the equations are singular


class MeanSquare:
    """Mean-square analysis of a loop over lossy links under a given gain: its growth and its cost.

    It represents the linear map of the pairs of weights (K, T), divided by a level in every step.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        L: (m, n) gain.
        losses: loss probabilities α of the actuator link and β of the sensor link.
        reach: φ, the probability that an error made now still persists at the next control; 0 with acknowledgements.
        level: growth per step by which the map is divided.
    """

    def __init__(
        self, A: Array, B: Array, L: Array, losses: tuple[float, float], reach: float, level: float = 1.0
    ) -> None:
        """Store the loop."""
        self.A, self.B, self.L, self.level = A, B, L, level
        self.alpha, self.beta = losses
        self.reach = reach
        self.moved = A + (1 - self.alpha) * (B @ L)  # M: the mean of A + BL and A over the losses
        self.spread = self.alpha * (1 - self.alpha)  # variance of the loss

    def at(self, level: float) -> MeanSquare:
        """Return the same analysis with a different factor ``level``, by which the weights are divided in each step."""
        return MeanSquare(self.A, self.B, self.L, (self.alpha, self.beta), self.reach, level)

    @property
    def apart(self) -> float:
        """Lower bound on the mean-square growth, which neglects the coupling of the two Lyapunov equations."""
        return max(radius(self.moved) ** 2, self.beta * radius(self.A) ** 2)

    @property
    def bounded(self) -> bool:
        """Whether the mean square of the loop grows by less than the factor ``level`` per step."""
        return self.apart < self.level and self.joined() < 1

    def growth(self) -> float:
        """Return the factor by which the mean square of the loop, without noise, grows per step."""
        if len(self.A) <= FEW:
            if self.reach:
                return radius(self._stacked)
            squared = len(self.A) ** 2
            # the map is block triangular: K and T do not affect each other's growth. The radius of A itself is more
            # accurate than that of its Kronecker square, as A may be defective.
            return max(radius(self._stacked[:squared, :squared]), self.beta * radius(self.A) ** 2)
        # the growth is the level at which the loop gain of Y (``joined``) is 1; it decreases with the level
        low = max(self.apart, 1e-12)
        if self.spread == 0 or self.at(low * (1 + NEAREST)).joined() <= 1:
            return self.apart
        high = 2 * low
        while self.at(high).joined() > 1:
            high *= 2
        return _scipy.crossing(lambda level: self.at(level).joined() - 1.0, low * (1 + NEAREST), high, 4e-16 * high)

    def joined(self) -> float:
        """Return the spectral radius of the map that couples the two Lyapunov equations of the loop.

        The sums over all steps exist if it is below 1.
        """
        if self.spread == 0:
            return 0.0
        return radius(self._turn) if np.isfinite(self._turn).all() else np.inf

    def solve(self, first: Array, second: Array) -> tuple[Array, Array]:
        """Solve the coupled Lyapunov equations of the loop for the weights K and T.

        K and T are the sums over all steps of terms that are added in each step.

        Args:
            first: term added to K, (n, n).
            second: term added to T, (n, n).

        Raises:
            LinAlgError: the level is the growth itself, or so close to it that the sums overflow.
        """
        if len(self.A) <= FEW:
            rows = np.concatenate([first.ravel(), second.ravel()])
            found = np.linalg.solve(self.level * np.eye(len(rows)) - self._stacked, rows)
            one, two = np.split(np.asarray(found, dtype=np.float64), 2)
            return symmetrised(one.reshape(first.shape)), symmetrised(two.reshape(first.shape))
        # solve without coupling, then for the coupling Y = Y_0 + turn·Y, then add the response to Y
        K, T = self._apart(first, second)
        if not all(np.isfinite(part).all() for part in (K, T, self._turn)):
            raise np.linalg.LinAlgError
        if self.spread == 0:
            return K, T
        upper = np.triu_indices(len(self.L))
        y = np.linalg.solve(np.eye(len(upper[0])) - self._turn, self._seen(K, T)[upper])
        for share, (one, two) in zip(y.tolist(), self._answers, strict=True):
            K, T = K + share * one, T + share * two
        return symmetrised(K), symmetrised(T)

    @cached_property
    def _stacked(self) -> Array:
        """The map as a matrix that acts on the entries of K and T, (2n², 2n²)."""
        pushed = self.B @ self.L
        spread, free = self.spread * np.kron(pushed.T, pushed.T), np.kron(self.A.T, self.A.T)
        upper = [np.kron(self.moved.T, self.moved.T) + (1 - self.reach) * spread, self.reach * spread]
        return np.block([upper, [(1 - self.beta) * free, self.beta * free]]).astype(np.float64)

    @cached_property
    def _answers(self) -> list[tuple[Array, Array]]:
        """The response (K, T) to each entry of the upper triangle of Y, row by row."""
        found: list[tuple[Array, Array]] = []
        for i, j in zip(*np.triu_indices(len(self.L)), strict=True):
            one = np.outer(self.L[i], self.L[j])
            one = one if i == j else one + one.T
            found.append(self._apart(self.spread * one, np.zeros_like(self.A)))
        return found

    @cached_property
    def _turn(self) -> Array:
        """The map from Y to the Y of its response (K, T)."""
        if self.spread == 0:
            return np.zeros((0, 0))
        upper = np.triu_indices(len(self.L))
        return np.stack([self._seen(*pair)[upper] for pair in self._answers], axis=1)

    def _seen(self, K: Array, T: Array) -> Array:
        return symmetrised(self.B.T @ ((1 - self.reach) * K + self.reach * T) @ self.B)

    def _apart(self, first: Array, second: Array) -> tuple[Array, Array]:
        root = np.sqrt(self.level)
        with np.errstate(over="ignore", invalid="ignore"):  # callers check for overflow
            K = summed((self.moved / root).T, symmetrised(first)) / self.level
            second = second + (1 - self.beta) * self.A.T @ K @ self.A
            T = summed((np.sqrt(self.beta) / root * self.A).T, symmetrised(second)) / self.level
        return K, T
