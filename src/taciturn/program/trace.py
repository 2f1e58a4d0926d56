"""Records a function of NumPy arrays as operations of a program: called once, with symbols in place of numbers."""

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

_OF_OBJECTS = re.compile(r"has no callable \w+ method|dtype\('O'\)")  # NumPy of what plain arrays of objects cannot do


def trace(
    builder: Builder,
    function: Callable[..., object],
    arguments: Mapping[str, Sequence[int]],
    results: Mapping[str, int],
) -> dict[str, list[int]]:
    """Call a function once with symbols, and return the operations of what it returns.

    The function is NumPy code that runs on floats as well. Its numbers are not known while it is traced: a choice is
    ``np.where`` and no ``if``. What does not depend on its arguments is computed now. Functions that it calls by name
    may fill an array of ``np.zeros``; methods of objects make theirs by ``np.zeros_like(x)`` or ``np.stack([…])``.

    Args:
        builder: where the operations go.
        function: of one vector for each argument.
        arguments: operations of each of its vectors, by name, in the order of its parameters.
        results: entries of each vector that it returns, by name. Of one: the function returns it; of several: a tuple.
            A vector of one entry may be a number.

    Returns:
        The operations of each result.

    Raises:
        ProblemError: the function fails, asks for a number or uses what cannot be traced, or returns something else.
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
            f"expected a function of the vectors {', '.join(arguments)} that NumPy code makes of them"
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
            f"{recorder.name} returns {name} of shape {found.shape}; expected ({size},), a number for each entry"
        )
    return [recorder.builder.value(_number(recorder, name, i, entry)) for i, entry in enumerate(found.ravel().tolist())]


def _number(recorder: Recorder, name: str, place: int, entry: object) -> Coefficient:
    if isinstance(entry, float) and not math.isfinite(entry):
        raise ProblemError(
            f"{recorder.name} returns {entry} as entry {place} of {name}, whatever its arguments are; "
            "expected a finite number"
        )
    return recorder.number(entry)
