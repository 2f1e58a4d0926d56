"""Simulation of a loop by importance splitting (RESTART): paths are copied when they approach a limit.

The level of a path is the number of thresholds that its height exceeds. A path that rises by a level is replaced by
four paths with a quarter of its weight each, which continue with random numbers of their own. All but the first end
when they fall below the level at which they began. So a path of level l has the weight 4^−l, and for every function of
the path, the weighted sum over all paths has the same mean as without copies: shares of time are unbiased, for any
thresholds. Without thresholds, this is plain simulation.

Source: villen2002
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from taciturn.extend import Array, Bits
from taciturn.program.draws import GENERATOR, seed_generators
from taciturn.program.engine import Runner
from taciturn.program.ir import Program

COPIES = 4  # paths by which a path that rises by a level is replaced
MOST_PATHS = 1 << 18  # above this number, the highest threshold is removed

_Whole = npt.NDArray[np.int64]


class Splitting:
    """Simulated paths of a loop, including the copies that importance splitting makes of them."""

    def __init__(
        self, program: Program, run: Runner, states: Array, seed: int, height: Callable[[Array], Array]
    ) -> None:
        """Start with the original paths, without thresholds."""
        named = [state.name for state in program.states]
        self._x, self._words = (
            np.array([i for i, name in enumerate(named) if name == wanted], dtype=np.int64)
            for wanted in ("x", GENERATOR)
        )
        self._run, self._seed, self._height = run, seed, height
        self.originals, self._drawn = states.shape[1], states.shape[1]
        self.thresholds, self.steps = np.empty(0), 0
        self.restart(states)

    def restart(self, states: Array) -> None:
        """Discard all paths, and start new original paths from the given initial states."""
        self.states = states
        self.root: _Whole = np.arange(self.originals, dtype=np.int64)
        self._level, self._first = (np.zeros(self.originals, dtype=np.int64) for _ in range(2))
        self.marks: Bits = np.zeros((0, self.originals), dtype=np.bool_)
        self.heights = self._height(self.x)
        self._branch()

    @property
    def x(self) -> Array:
        """The states of the plant on each path, shape (n, paths)."""
        return self.states[self._x]

    @property
    def weight(self) -> Array:
        """The statistical weight of each path, shape (paths,); each threshold that a path has passed reduces it."""
        return np.power(float(COPIES), -self._level.astype(np.float64))

    @property
    def top(self) -> Array:
        """Heights of those paths that are above all thresholds; the height says how close a path is to a limit."""
        return self.heights[self._level == len(self.thresholds)]

    @property
    def near(self) -> float:
        """Fraction of the paths above all thresholds, weighted by the paths' statistical weights."""
        return float(COPIES) ** -len(self.thresholds) * len(self.top) / self.originals

    @property
    def original(self) -> Bits:
        """Whether each path is an original, not a copy, shape (paths,)."""
        return np.asarray(self._first == 0, dtype=np.bool_)

    def mark(self, events: int) -> None:
        """Give each path one flag per event, which is false at first; copies of a path inherit its flags."""
        self.marks = np.zeros((events, self.states.shape[1]), dtype=np.bool_)

    def step(self) -> None:
        """Simulate one step of all paths; copy paths that rise above a threshold, and end copies that fall below."""
        self.steps += self.states.shape[1]
        self.states = self._run(self.states, 1, None).states
        self.heights = self._height(self.x)
        self._branch()

    def add(self, threshold: float) -> None:
        """Add a threshold above all present ones, and copy the paths above it."""
        self.thresholds = np.append(self.thresholds, threshold)
        self._branch()

    def sums(self, values: Bits) -> Array:
        """Return, for each original path and its copies, the total weight of the paths for which ``values`` is true."""
        return np.asarray(np.bincount(self.root, self.weight * values, self.originals), dtype=np.float64)

    def _branch(self) -> None:
        """Copy the paths that have risen to another level, and end the copies that fell below their first level."""
        while True:
            # a path that rises by l levels becomes 4^l paths with 4^−l of its weight; a copy ends below its first level
            new = np.searchsorted(self.thresholds, self.heights)
            powers = COPIES ** np.arange(len(self.thresholds) + 1)
            many = np.where(new < self._first, 0, powers[np.maximum(new - self._level, 0)])
            if many.sum() <= MOST_PATHS or not len(self.thresholds):
                break
            self._remove_highest()
        if (many == 1).all():
            self._level = new
            return
        # of 4^l paths, one continues the path, three begin one level higher, twelve two levels higher, …
        at = np.repeat(np.arange(len(many)), many)
        number = np.arange(len(at)) - np.repeat(np.cumsum(many) - many, many)  # of a copy; 0 continues the path
        first = np.where(number == 0, self._first[at], self._level[at] + np.searchsorted(powers, number, "right"))
        copied = np.flatnonzero(number)
        self._keep(at, new, first)
        if len(self._words):
            self.states[np.ix_(self._words, copied)] = seed_generators(self._seed, len(copied), self._drawn)
        self._drawn += len(copied)

    def _remove_highest(self) -> None:
        """Remove the highest threshold with the copies that began there."""
        self.thresholds = self.thresholds[:-1]
        highest = len(self.thresholds)
        self._keep(np.flatnonzero(self._first <= highest), np.minimum(self._level, highest), self._first, False)

    def _keep(self, at: _Whole, level: _Whole, first: _Whole, told: bool = True) -> None:
        """Keep the paths of some indices, each perhaps several times."""
        self.states, self.root, self.heights = self.states[:, at], self.root[at], self.heights[at]
        self.marks, self._level = self.marks[:, at], level[at]
        self._first = first if told else first[at]
