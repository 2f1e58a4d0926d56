"""Answers that are kept: the cells of a sweep over a policy's values share plant and cost, and solve them once."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import TypeVar, TypeVarTuple, cast

import numpy as np

from taciturn._arrays import Array

MOST = 16  # answers of a function, the latest

Ts = TypeVarTuple("Ts")
T = TypeVar("T")


def kept(solve: Callable[[*Ts], T]) -> Callable[[*Ts], T]:
    """Return a function that keeps its latest answers, by the bits of its arguments.

    Args:
        solve: of arrays and numbers; its answers are shared, so that they must be read-only.
    """
    loose = cast("Callable[..., T]", solve)

    @lru_cache(maxsize=MOST)
    def of_bits(*given: float | tuple[tuple[int, ...], bytes]) -> T:
        return loose(*(np.ndarray(one[0], np.float64, one[1]) if isinstance(one, tuple) else one for one in given))

    @wraps(solve)
    def found(*args: *Ts) -> T:
        given = cast("tuple[Array | float, ...]", args)
        return of_bits(*((one.shape, one.tobytes()) if isinstance(one, np.ndarray) else one for one in given))

    return found
