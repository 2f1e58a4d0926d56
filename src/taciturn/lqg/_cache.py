"""A cache of Riccati solutions, keyed by array bytes; the points of a sweep often have the same plant and cost."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import TypeVar, TypeVarTuple, cast

import numpy as np

from taciturn._arrays import Array
from taciturn._progress import check_time

MOST = 16  # most results in the cache of a function

Ts = TypeVarTuple("Ts")
T = TypeVar("T")


def kept(solve: Callable[[*Ts], T]) -> Callable[[*Ts], T]:
    """Wrap a function of arrays in a cache of its latest results, keyed by the bytes of the arguments.

    Args:
        solve: a function of arrays and numbers; its results must be read-only, because callers share them.
    """
    loose = cast("Callable[..., T]", solve)

    @lru_cache(maxsize=MOST)
    def of_bits(*given: float | tuple[tuple[int, ...], bytes]) -> T:
        return loose(*(np.ndarray(one[0], np.float64, one[1]) if isinstance(one, tuple) else one for one in given))

    @wraps(solve)
    def found(*args: *Ts) -> T:
        check_time()  # every design and every search for periodic control solves such equations
        given = cast("tuple[Array | float, ...]", args)
        return of_bits(*((one.shape, one.tobytes()) if isinstance(one, np.ndarray) else one for one in given))

    return found
