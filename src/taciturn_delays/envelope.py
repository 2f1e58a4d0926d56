"""Offset and drift between the times of two computers, from one-way measurements.

The sender observes the time of sending s by its own time, and the receiver the time of reception r by its own. If the
time of the receiver is s + a + b s when that of the sender is s, then

    r − s = a + b s + d,

where d ≥ 0 is the delay, a the offset in seconds and b the drift (1e-6 is one part per million, ppm). All measured
points (s, r − s) are above the line a + b s, up to the smallest delay. Among the lines below all points, the estimate
is the one that is closest to them on average,

    maximise  a + b s̄   subject to   a + b s ≤ r − s for every packet,

with the mean s̄ of the times of sending. Its solution is the edge of the lower convex hull of the points over s̄, which
is found in one pass over sorted times. It is unbiased if the smallest delay does not change.

The constant part cannot be known: a larger offset and smaller delays give the same measurements. So the smallest
remaining delay is set to a stated value, 0 by default. For the same reason, a smallest delay that changes slowly counts
as drift. Computers drift by less than 500 ppm. If the offset does not change linearly, as after an adjustment of the
time, the smallest remaining delay is not about the same in each quarter of the measurement. Notes report both.

Source: moon1999, zhang2002
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from taciturn.extend import Array

_PARTS = 4  # of the time, in each of which some packet should have about the smallest delay


class Line(NamedTuple):
    """The line offset + drift·s."""

    offset: float
    drift: float

    def at(self, times: Array) -> Array:
        """Return the values of the line at some times."""
        return self.offset + self.drift * times


def lower_line(times: Array, values: Array) -> Line:
    """Return the highest line at the mean time that is not above any point; times are sorted, and not all equal."""
    middle = float(times.mean())
    hull = _lower_hull(times, values)
    x, y = times[hull], values[hull]
    right = int(np.clip(np.searchsorted(x, middle, side="right"), 1, len(x) - 1))
    drift = float((y[right] - y[right - 1]) / (x[right] - x[right - 1]))
    return Line(float(y[right - 1] - drift * x[right - 1]), drift)


def uneven(times: Array, rest: Array) -> float:
    """Return the largest of the smallest delays in each quarter of the time; zero if the offset is a line."""
    quarter = np.minimum((times - times[0]) / (times[-1] - times[0]) * _PARTS, _PARTS - 1).astype(np.int64)
    least = [float(rest[quarter == part].min()) for part in range(_PARTS) if np.count_nonzero(quarter == part)]
    return max(least)


def _lower_hull(times: Array, values: Array) -> list[int]:
    """Return the indices of the corners of the lower convex hull, from left to right (monotone chain)."""
    hull: list[int] = []
    x, y = times.tolist(), values.tolist()
    for i in range(len(x)):
        if hull and x[hull[-1]] == x[i]:
            if y[hull[-1]] <= y[i]:
                continue
            hull.pop()
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (x[b] - x[a]) * (y[i] - y[a]) > (y[b] - y[a]) * (x[i] - x[a]):
                break
            hull.pop()
        hull.append(i)
    return hull
