"""When a simulated loop has settled, decided from the sums that its paths have had since their start.

The time constants of a design are those of the loop that always sends. A policy that seldom sends can be much slower:
while it is silent, a slow mode of the plant or an integrator of the controller moves as in open loop. So the sums
themselves decide. The steps since the start are divided into windows, and the mean over a range of windows is compared
with the mean over all later ones, path by path. The last range that differs ends at the step t. Until then, a transient
of amplitude A has decayed to the resolution r of the comparison, so by the step 2t it has decayed to about r²/A, which
is far below r. Windows that begin earlier are dropped.

Some slow transients hardly change the sums of one window. With a held input, for example, small and large commands may
alternate, and it takes hundreds of packets until the pairs of commands have their distribution in the long run, which
moves the rate by a few percent. So the distribution of each state over the paths is also compared between the ends of
windows, by the largest distance of the distribution functions (Smirnov). This prolongs the burn-in by a limited factor
and refuses nothing, because paths that send in phase have other distributions at each step although their sums have
settled.

A range reaches back to a quarter of its last step at most: it contains two windows whose lengths have doubled, which
resolves more than one window, and it does not contain the start, whose large transient would be seen at any later time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from taciturn._arrays import Array, Bits

DIFFERENT = 3.5  # standard errors by which the mean over a range may differ from that over the later windows
REACH = 4  # the first step of a range is at least its last step divided by this number
AGAIN = 2  # windows are kept from this multiple of the last step at which a difference was seen
ROUNDING = 1e-12  # relative rounding error of a mean
FAR = 2.4  # limit of Smirnov's distance, in units of √(2/paths), exceeded by equal distributions in 1 of 50,000 cases
PROLONGED = 8  # the burn-in is prolonged by at most this factor while distributions change
GROWS = 1.2  # ratio of the deviations at two steps, one twice as late, above which a state may wander: √2 if it does
GONE = 1e-6  # spread of a state, relative to its largest one, below which it has decayed
IN_PHASE = 0.5  # spread of a count over the paths below which all paths send at nearly the same steps

Window = tuple[int, Array]  # steps, and sums over them, (sums, paths)


class History:
    """The windows of steps since the start of all paths.

    Args:
        counted: which sums are numbers of sends.
    """

    def __init__(self, counted: Bits) -> None:
        """Start without windows."""
        self.counted = counted
        self.windows: list[Window] = []  # later windows may have more sums, which are not compared

    @property
    def steps(self) -> int:
        """Steps of each path since its start."""
        return sum(length for length, _ in self.windows)

    def add(self, length: int, sums: Array) -> None:
        """Add a window; earlier windows keep only the paths that are still simulated."""
        paths = sums.shape[1]
        self.windows = [(steps, earlier[:, :paths]) for steps, earlier in self.windows] + [(length, sums)]

    def drift(self) -> int:
        """Return the last step at which a range of windows ends that differs from the later ones, or 0."""
        ends, rows = np.cumsum([length for length, _ in self.windows]), len(self.counted)
        for j in range(len(self.windows) - 1, 0, -1):
            later = _joined(self.windows[j:], rows)
            for i in range(j - 1, -1, -1):
                begins = int(ends[i - 1]) if i else 0
                if i < j - 1 and begins * REACH < ends[j - 1]:
                    break
                if self._differ(_joined(self.windows[i:j], rows), later):
                    return int(ends[j - 1])
        return 0

    def settled(self) -> bool:
        """Return whether a window begins late enough after the last difference."""
        return bool(self.kept(0))

    def kept(self, first: int) -> list[Window]:
        """Return the windows that begin at the given step or later, and late enough after the last difference."""
        first = max(first, AGAIN * self.drift())
        begins = np.cumsum([0] + [length for length, _ in self.windows])
        return [window for begin, window in zip(begins, self.windows, strict=False) if begin >= first]

    def _differ(self, before: Window, after: Window) -> bool:
        """Return whether the mean of a sum differs between two ranges of windows."""
        (steps, sums), (others, late) = before, after
        earlier = sums / steps
        change = late / others - earlier
        spread = change.std(axis=1, ddof=1) / np.sqrt(change.shape[1])
        # paths that send at the same steps: a window may end just before a send
        same = self.counted & (sums.std(axis=1) < IN_PHASE) & (late.std(axis=1) < IN_PHASE)
        early = same * (1 / steps + 1 / others)
        least = DIFFERENT * spread + early + ROUNDING * np.abs(earlier.mean(axis=1))
        return bool((np.abs(change.mean(axis=1)) > least).any())


class Snapshots:
    """The states of all paths at the end of the latest window, to compare their distribution with that at the next."""

    def __init__(self) -> None:
        """Start without states."""
        self._states: Array | None = None
        self._largest: Array | float = 0.0

    def changed(self, states: Array) -> bool:
        """Return whether the distribution of a state has changed since the last call, and keep the states.

        A state whose spread grows may wander without limit, and a state that has decayed has no distribution.

        Args:
            states: states of the paths, (states, paths); there may be fewer paths than before.
        """
        before, self._states = self._states, states
        spread = states.std(axis=1)
        self._largest = np.maximum(self._largest, spread)
        if before is None:
            return True
        limit = FAR * np.sqrt(2 / states.shape[1])
        earlier = before[:, : states.shape[1]].std(axis=1)
        settles = (spread > GONE * self._largest) & (spread < GROWS * earlier)
        return any(_distance(before[i], states[i]) > limit for i in np.flatnonzero(settles))


def _distance(first: Array, second: Array) -> float:
    """Return the largest distance between two distribution functions."""
    values = np.concatenate([first, second])
    one, two = (np.searchsorted(np.sort(part), values, side="right") / len(part) for part in (first, second))
    return float(np.abs(one - two).max())


def shared_end(windows: Sequence[Window]) -> float:
    """Return the standard deviation of the error of a rate that all paths share.

    Paths that send at the same steps, as after a common start with nearly equal intervals, all end just before or just
    after a send. With intervals of ℓ steps, the number of sends of n steps is off n/ℓ by one of 0, 1/ℓ … 1 − 1/ℓ, all
    alike, so its standard deviation is √((1 − 1/ℓ²)/12). Windows of whole cycles of a schedule have equal rates, and no
    such error.

    Args:
        windows: steps and sends of each path, (paths,), of each window.
    """
    steps, sends = sum(length for length, _ in windows), np.sum([sums for _, sums in windows], axis=0)
    rates = [float(sums.mean()) / length for length, sums in windows]
    apart = sends.std() >= IN_PHASE or sends.mean() < 1
    if apart or np.ptp(rates) <= ROUNDING:
        return 0.0
    rate = min(1.0, float(sends.mean()) / steps)
    return float(np.sqrt((1 - rate**2) / 12)) / steps


def _joined(windows: Sequence[Window], rows: int) -> Window:
    """Return the steps and the first sums of several windows, which are added in turn: a stack takes much memory."""
    (_, first), *later = windows
    total = first[:rows].copy()
    for _, sums in later:
        total += sums[:rows]
    return sum(length for length, _ in windows), total
