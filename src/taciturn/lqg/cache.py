"""Results that were computed before, for equal data: the points of a trade-off have the same plant and cost.

The key is the data itself, as bytes: of arrays (``kept``), or of classes of data (``remembered``). Arguments hold no
function of the user, of which only the name has bytes. Results are immutable, so everyone may have the same one.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import lru_cache, wraps
from typing import NamedTuple, TypeVar, TypeVarTuple, cast

import numpy as np

from taciturn._arrays import Array
from taciturn._progress import check_time

MOST_OF_ARRAYS = 16  # latest results of a function of arrays
MOST = 8  # latest results of a function that are stored: a problem of 200 states has some megabytes

Args = TypeVarTuple("Args")
Result = TypeVar("Result")


def remembered(compute: Callable[[*Args], Result]) -> Callable[[*Args], Result]:
    """Wrap a function of immutable data in a cache of its latest results."""
    latest: dict[bytes, Result] = {}

    @wraps(compute)
    def found(*args: *Args) -> Result:
        check_time()
        try:
            key = pickle.dumps(args, protocol=5)
        except (pickle.PicklingError, AttributeError, TypeError):  # of a class that was made inside a function
            return compute(*args)
        result = latest.pop(key) if key in latest else compute(*args)
        latest[key] = result  # now the latest
        while len(latest) > MOST:
            latest.pop(next(iter(latest)), None)
        return result

    return found


class _Bits(NamedTuple):
    shape: tuple[int, ...]
    bits: bytes


def kept(solve: Callable[[*Args], Result]) -> Callable[[*Args], Result]:
    """Wrap a function of arrays in a cache of its latest results, keyed by the bytes of the arguments."""
    loose = cast("Callable[..., Result]", solve)

    @lru_cache(maxsize=MOST_OF_ARRAYS)
    def of_bits(*given: object) -> Result:
        return loose(*(np.ndarray(one.shape, np.float64, one.bits) if isinstance(one, _Bits) else one for one in given))

    @wraps(solve)
    def found(*args: *Args) -> Result:
        check_time()  # every design and every search for periodic control solves such equations
        given = cast("tuple[Array | object, ...]", args)
        return of_bits(*map(_hashable, given))

    return found


def _hashable(one: Array | object) -> object:
    return _Bits(cast("Array", one).shape, cast("Array", one).tobytes()) if isinstance(one, np.ndarray) else one
