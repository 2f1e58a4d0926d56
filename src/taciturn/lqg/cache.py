"""A cache of results that are computed often with equal data, such as gains at the points of a trade-off curve.

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

MOST = 16  # latest results of a function that are stored
MOST_PROBLEMS = 8  # of them if they are problems: one of 200 states has some megabytes

Args = TypeVarTuple("Args")
Result = TypeVar("Result")


def remembered(compute: Callable[[*Args], Result], most: int = MOST) -> Callable[[*Args], Result]:
    """Add a cache to a function. Its arrays get one memory order, so that equal data give equal rounding errors."""
    latest: dict[bytes, Result] = {}
    loose = cast("Callable[..., Result]", compute)

    @wraps(compute)
    def found(*given: *Args) -> Result:
        check_time()  # every design and every search for periodic control solves equations
        whole = cast("tuple[object, ...]", given)
        args = [np.asarray(cast("Array", a), order="C") if isinstance(a, np.ndarray) else a for a in whole]
        try:
            key = pickle.dumps(args, protocol=4)  # of later ones, the bytes of constant arrays differ
        except (pickle.PicklingError, AttributeError, TypeError):  # of a class that was made inside a function
            return loose(*args)
        result = latest.pop(key) if key in latest else loose(*args)
        latest[key] = result  # now the latest
        while len(latest) > most:
            latest.pop(next(iter(latest)), None)
        return result

    return found
