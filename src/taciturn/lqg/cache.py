"""Results that were computed before, for equal data: the points of a trade-off have the same plant and cost.

The key is the data itself, as bytes. Arguments hold no function of the user, of which only the name has bytes. Results
are immutable, so everyone may have the same one.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import wraps
from typing import TypeVar, TypeVarTuple, cast

import numpy as np

from taciturn._arrays import Array
from taciturn._progress import check_time

MOST_OF_ARRAYS = 16  # latest results of a function of arrays
MOST = 8  # latest results of a function that are stored: a problem of 200 states has some megabytes

Args = TypeVarTuple("Args")
Result = TypeVar("Result")


def remembered(compute: Callable[[*Args], Result], most: int = MOST) -> Callable[[*Args], Result]:
    """Wrap a function of immutable data in a cache of its latest results."""
    latest: dict[bytes, Result] = {}

    @wraps(compute)
    def found(*args: *Args) -> Result:
        check_time()  # every design and every search for periodic control solves equations
        try:
            key = pickle.dumps(args, protocol=4)  # of later ones, the bytes of constant arrays differ
        except (pickle.PicklingError, AttributeError, TypeError):  # of a class that was made inside a function
            return compute(*args)
        result = latest.pop(key) if key in latest else compute(*args)
        latest[key] = result  # now the latest
        while len(latest) > most:
            latest.pop(next(iter(latest)), None)
        return result

    return found


def kept(solve: Callable[[*Args], Result]) -> Callable[[*Args], Result]:
    """Wrap a function of arrays in a cache; they are brought in one order of memory, on which rounding may depend."""
    of_rows = cast("Callable[..., Result]", remembered(solve, MOST_OF_ARRAYS))

    @wraps(solve)
    def found(*args: *Args) -> Result:
        given = cast("tuple[object, ...]", args)
        return of_rows(*(np.ascontiguousarray(cast("Array", a)) if isinstance(a, np.ndarray) else a for a in given))

    return found
