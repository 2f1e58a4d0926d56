"""A cache of Riccati solutions, keyed by array bytes; the points of a sweep often have the same plant and cost."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import NamedTuple, TypeVar, TypeVarTuple, cast

import numpy as np

from taciturn._arrays import Array
from taciturn._progress import check_time

MOST = 16  # most results in the cache of a function

Ts = TypeVarTuple("Ts")
T = TypeVar("T")


class _Bits(NamedTuple):
    shape: tuple[int, ...]
    bits: bytes


def kept(solve: Callable[[*Ts], T]) -> Callable[[*Ts], T]:
    """Wrap a function of arrays in a cache of its latest results, keyed by the bytes of the arguments.

    Args:
        solve: a function of arrays, numbers and objects that do not change; its results must be read-only, because
            callers share them.
    """
    loose = cast("Callable[..., T]", solve)

    @lru_cache(maxsize=MOST)
    def of_bits(*given: object) -> T:
        return loose(*(np.ndarray(one.shape, np.float64, one.bits) if isinstance(one, _Bits) else one for one in given))

    @wraps(solve)
    def found(*args: *Ts) -> T:
        check_time()  # every design and every search for periodic control solves such equations
        given = cast("tuple[Array | object, ...]", args)
        return of_bits(*map(_hashable, given))

    return found


def _hashable(one: Array | object) -> object:
    return _Bits(cast("Array", one).shape, cast("Array", one).tobytes()) if isinstance(one, np.ndarray) else one
