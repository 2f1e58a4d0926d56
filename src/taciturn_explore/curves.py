"""Choose the values of a trade-off parameter at which the points of a curve are computed.

They are powers of a fixed ratio, or whole numbers, so they do not depend on the present value: a point that moves along
its curve needs no new evaluations. From the first value on, the curve is followed in both directions until nearly every
sample is sent, until nearly none is, or until the share of the sent samples no longer changes. Then values are added
between the points that are farthest apart.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence
from itertools import pairwise
from typing import Any, TypeAlias

RATIO = 2.0  # of two values that follow each other
NEARLY_ALL, NEARLY_NONE = 0.985, 0.015  # shares of the samples at which a curve ends
STILL = 0.002  # change of the share from one value to the next below which a curve ends
MOST = 28  # values before those in between
FILLED, WIDE = 8, 0.08  # values that are added in between, and the least distance of shares between which they are
Point: TypeAlias = Mapping[str, Any]


def values_of_curve(along: Mapping[str, Any]) -> Generator[float, Point | None, None]:
    """Yield the parameter values of a curve; the caller sends back each computed point, or None if it failed."""
    first, whole, points = along["value"], along["whole"], list[Point]()
    before = dict[bool, float]()  # the last shares in both directions
    ahead = {True: first, False: neighbour(first, False, whole)}  # the next values in both directions
    while ahead and len(points) < MOST:
        for up, value in list(ahead.items()):
            found = (yield value) if value >= along["least"] and value > 0 else None
            if found is None:
                del ahead[up]
                continue
            share: float = found["share"]
            ends = share < NEARLY_NONE if up == along["falls"] else share > NEARLY_ALL
            points.append(found)
            if ends or abs(share - before.get(up, math.inf)) < STILL:
                del ahead[up]
            else:
                before[up], ahead[up] = share, neighbour(value, up, whole)
    for _ in range(0 if whole else FILLED):
        points.sort(key=lambda one: one["traffic"])
        value = widest(points)
        found = None if value is None else (yield value)
        if found is None:
            return
        points.append(found)


def anchor(value: float, whole: bool) -> float:
    """Round a parameter value to the nearest value of the grid on which all curves are computed."""
    if whole:
        return max(1, round(value))
    return float(f"{RATIO ** round(math.log(value, RATIO)):.6g}") if value > 0 else 0.0


def neighbour(value: float, up: bool, whole: bool) -> float:
    """Return the next larger or next smaller parameter value of the grid on which all curves are computed."""
    if whole:
        step = max(1, int(value) // 4)
        return int(value) + step if up else int(value) - step
    return float(f"{RATIO ** (round(math.log(value, RATIO)) + (1 if up else -1)):.6g}") if value > 0 else 0.0


def widest(points: Sequence[Point]) -> float | None:
    """Return a parameter value for a new point in the largest gap of a curve; None if all gaps are small."""
    gaps = [(b["share"] - a["share"], a["parameter"], b["parameter"]) for a, b in pairwise(points)]
    gap, first, second = max(gaps, key=lambda one: one[0], default=(0.0, 0.0, 0.0))
    value = float(f"{math.sqrt(first * second):.6g}")
    return None if gap < WIDE or value in (first, second) else value
