"""Tracing of user functions: a NumPy function is called once with symbols, and its operations are recorded."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout

import numpy as np

from taciturn.errors import ProblemError
from taciturn.program.arrays import STAND_INS
from taciturn.program.ir import Builder, Coefficient
from taciturn.program.rebound import rebind
from taciturn.program.symbols import Recorder, is_list, objects

_OF_OBJECTS = re.compile(r"has no callable \w+ method|dtype\('O'\)")  # NumPy's errors for plain arrays of objects


def trace(
    builder: Builder,
    function: Callable[..., object],
    arguments: Mapping[str, Sequence[int]],
    results: Mapping[str, int],
) -> dict[str, list[int]]:
    """Trace a NumPy function: call it once with symbols, and return the operations that compute its results.

    The function consists of NumPy code that also runs on floats. The values of its arguments are unknown while it is
    traced, so it must use ``np.where`` instead of ``if``. Values that do not depend on the arguments are computed
    during the trace. The function, and functions that it calls by name, may assign to entries of arrays from
    ``np.zeros``. Methods of objects must create arrays by ``np.zeros_like(x)`` or ``np.stack([…])``.

    Args:
        builder: collects the operations.
        function: function with one vector per argument.
        arguments: operations of the entries of each vector, by name, in the order of the parameters.
        results: number of entries of each returned vector, by name. The function returns one vector, or a tuple of
            several vectors. A number may replace a vector of one entry.

    Returns:
        The operations of the entries of each result.

    Raises:
        ProblemError: the function fails, needs the value of a number, uses a function that cannot be traced, or
            returns a wrong number of results or a result of wrong size.
    """
    name = getattr(function, "__name__", type(function).__name__)
    recorder = Recorder(builder, name)
    vectors = [recorder.symbols(values) for values in arguments.values()]
    try:
        with np.errstate(all="ignore"), redirect_stdout(sys.stderr):
            returned = rebind(function, STAND_INS)(*vectors)
    except ProblemError:
        raise
    except Exception as error:
        if isinstance(error, TypeError | AttributeError) and _OF_OBJECTS.search(str(error)):
            raise recorder.lost() from error
        raise ProblemError(
            f"{name} fails when it is traced: {type(error).__name__}: {' '.join(str(error).split())}; "
            f"expected a function of the vectors {', '.join(arguments)} in NumPy code"
        ) from error
    if returned is None:
        raise ProblemError(f"{name} returns nothing; expected the vector {', '.join(results)}")
    if len(results) == 1:
        returned = (returned,)
    elif not is_list(returned) or len(returned) != len(results):
        got = f"{len(returned)} values" if is_list(returned) else "one vector"
        raise ProblemError(f"{name} returns {got}; expected a tuple of {len(results)}: {', '.join(results)}")
    pairs = zip(results.items(), returned, strict=True)
    return {result: _result(recorder, result, size, value) for (result, size), value in pairs}


def _result(recorder: Recorder, name: str, size: int, value: object) -> list[int]:
    found = objects(value)
    if found.shape != (size,) and not (size == 1 and found.shape == ()):
        raise ProblemError(
            f"{recorder.name} returns {name} of shape {found.shape}; expected ({size},), one number per entry"
        )
    return [recorder.builder.value(_number(recorder, name, i, entry)) for i, entry in enumerate(found.ravel().tolist())]


def _number(recorder: Recorder, name: str, place: int, entry: object) -> Coefficient:
    if isinstance(entry, float) and not math.isfinite(entry):
        raise ProblemError(
            f"{recorder.name} returns {entry} as entry {place} of {name} for all arguments; expected a finite number"
        )
    return recorder.number(entry)
