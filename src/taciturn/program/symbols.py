"""Symbols that represent unknown numbers while a NumPy function is traced, and the recorder of its operations.

An array of symbols is an array of objects, so that NumPy itself does the indexing, slicing and reshaping. Computations
on entries are recorded by the rules in ``elementary``, and functions of whole arrays by the rules in ``FUNCTIONS``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from itertools import chain
from typing import Any, TypeGuard, cast

import numpy as np
import numpy.typing as npt

from taciturn.errors import ProblemError
from taciturn.program.elementary import COMPARISONS, LOGIC, NUMBERS, choose
from taciturn.program.ir import Builder, Coefficient

Objects = npt.NDArray[Any]  # floats, truth values and symbols
FUNCTIONS: dict[object, Callable[[Any, Any], Any]] = {}  # rules for functions of whole arrays, filled by ``arrays``
_UNKNOWN = "but numbers are unknown while the function is traced"
_ARRAYS = "functions of NumPy, and arrays made by np.stack([…]), np.copy(x) or np.zeros_like(x)"


class Symbol(np.lib.mixins.NDArrayOperatorsMixin):
    """Placeholder that a traced function receives instead of a number or a truth value.

    Args:
        recorder: records operations on the symbol.
        index: operation that the symbol represents.
    """

    def __init__(self, recorder: Recorder, index: int) -> None:
        """Store recorder and operation."""
        self.recorder, self.index = recorder, index

    def __array_ufunc__(
        self,
        ufunc: np.ufunc,
        method: str,
        *inputs: Any,
        out: Any = None,
        axis: Any = 0,
        keepdims: bool = False,
        dtype: object = None,
        where: object = True,
        initial: object = None,
    ) -> Any:
        """Record an operator or a NumPy function of single entries."""
        if where is not True or initial is not None or dtype is not None:
            raise recorder_of(inputs).refused(f"{ufunc.__name__} with where, initial or dtype")
        return compute(ufunc, method, inputs, out, axis, keepdims)

    def __array_function__(self, function: Any, types: object, args: Any, kwargs: Any) -> Any:
        """Record a NumPy function of whole arrays."""
        given = [*args, *kwargs.values()]
        if not symbols_in(given):
            named = {name: _as_floats(value) for name, value in kwargs.items()}
            return held(function(*map(_as_floats, args), **named))
        if function not in FUNCTIONS:
            raise recorder_of(given).refused(function.__name__)
        return FUNCTIONS[function](args, kwargs)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """Return the method, such as ``sqrt``, that NumPy calls on entries of plain arrays of objects."""
        if name not in NUMBERS:
            raise AttributeError(f"{self!r} has no {name}")
        return lambda *others: self.recorder.entry(getattr(np, name), self, *others)

    def __repr__(self) -> str:
        """Return a description such as "a traced number"."""
        return f"a traced {type(self).__name__.lower()}"

    def __bool__(self) -> bool:
        """Raise an error, since the value is unknown."""
        raise ProblemError(
            f"{self.recorder.name} needs the truth value of a condition (for if, and, or, max), {_UNKNOWN}; "
            f"expected np.where, & and |, np.maximum: {_ARRAYS}"
        )

    def __float__(self) -> float:
        """Raise an error, since the value is unknown."""
        raise ProblemError(
            f"{self.recorder.name} converts a traced number to a float (as math.sin, float() and np.zeros(n)[i] = do), "
            f"{_UNKNOWN}; expected {_ARRAYS}"
        )

    def __int__(self) -> int:
        """Raise an error, since the value is unknown."""
        raise ProblemError(
            f"{self.recorder.name} converts a traced number to an integer (as int() and round() do), {_UNKNOWN}; "
            "expected np.floor or np.rint"
        )

    __index__ = __int__


class Number(Symbol):
    """Placeholder of a number whose value is known only when the program runs."""


class SymbolicTruth(Symbol):
    """Placeholder of a truth value that is known only when the program runs."""


class SymbolicArray(np.ndarray[Any, Any]):
    """A NumPy array whose entries can be placeholders of unknown numbers (symbols)."""

    __array_ufunc__ = Symbol.__array_ufunc__  # type: ignore[assignment]
    __array_function__ = Symbol.__array_function__  # type: ignore[assignment]


class Recorder:
    """Recorder of a traced function: stores its computations as operations of a program.

    Args:
        builder: collects the operations.
        name: name of the function, for messages.
    """

    def __init__(self, builder: Builder, name: str) -> None:
        """Start without operations."""
        self.builder, self.name = builder, name

    def symbols(self, values: Sequence[int]) -> SymbolicArray:
        """Return a vector of symbols, one for each of the given operations."""
        vector = np.empty(len(values), dtype=object)
        vector[:] = [self.symbol(self._known(value)) for value in values]
        return vector.view(SymbolicArray)

    def symbol(self, value: Coefficient) -> float | Number:
        """Return a constant unchanged, or the symbol that represents an operation."""
        return value if isinstance(value, float) else Number(self, value)

    def number(self, value: object) -> Coefficient:
        """Return an array entry as a constant if it is a number, else as the operation that computes it.

        Raises:
            ProblemError: the entry is not a number.
        """
        if isinstance(value, Number):
            return value.index
        if isinstance(value, SymbolicTruth):
            return choose(self.builder, value.index, 1.0, 0.0)
        try:
            found = float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            raise ProblemError(
                f"{self.name} computes with {value!r:.60}; expected numbers, or arrays of numbers"
            ) from None
        if math.isnan(found):
            raise ProblemError(f"{self.name} computes with a constant NaN; expected finite numbers")
        return found

    def truth(self, value: object) -> int | bool:
        """Return an array entry as a truth value if it is known, or else as the operation that computes it."""
        if isinstance(value, SymbolicTruth):
            return value.index
        if isinstance(value, Number):
            return COMPARISONS["not_equal"](self.builder, value.index, 0.0)
        return bool(value)

    def entry(self, ufunc: np.ufunc, *values: Any) -> Any:
        """Return the result of an element-wise NumPy function for single entries, which can be symbols."""
        name = "divide" if ufunc.__name__ == "true_divide" else ufunc.__name__
        if not any(isinstance(value, Symbol) for value in values):
            return ufunc(*(float(value) if type(value) is int else value for value in values))
        if name in LOGIC:
            return self.condition(LOGIC[name](self.builder, *(self.truth(value) for value in values)))
        if name in COMPARISONS:
            return self.condition(COMPARISONS[name](self.builder, *(self.number(value) for value in values)))
        if name in NUMBERS:
            return self.symbol(NUMBERS[name](self.builder, *(self.number(value) for value in values)))
        raise self.refused(name)

    def condition(self, truth: int | bool) -> bool | SymbolicTruth:
        """Return a known truth value unchanged, or the symbol that represents an operation."""
        return truth if isinstance(truth, bool) else SymbolicTruth(self, truth)

    def either(self, condition: object, yes: object, no: object) -> object:
        """Return the value ``yes`` if the condition is true, and ``no`` otherwise."""
        truth = self.truth(condition)
        if isinstance(truth, bool):
            return yes if truth else no
        return self.symbol(choose(self.builder, truth, self.number(yes), self.number(no)))

    def product(self, matrix: Objects, column: Objects) -> list[object]:
        """Return the product of a matrix and a column; a large constant matrix becomes one operation."""
        b, values = self.builder, [self.number(value) for value in column]
        rows = [[self.number(entry) for entry in row] for row in matrix]
        known = all(isinstance(entry, float) for row in rows for entry in row)
        if known and all(isinstance(value, int) for value in values):
            found = b.transform(rows, [b.value(value) for value in values])
            return [self.symbol(0.0 if index is None else index) for index in found]
        return [self.symbol(self._inner(row, values)) for row in rows]

    def _inner(self, row: Sequence[Coefficient], values: Sequence[Coefficient]) -> Coefficient:
        """Return Σ row·values; products of two constants are evaluated in advance."""
        fixed, pairs = 0.0, list[tuple[Coefficient, int]]()
        for one, other in zip(row, values, strict=True):
            if isinstance(other, int):
                pairs.append((one, other))
            elif isinstance(one, int):
                pairs.append((other, one))
            else:
                fixed += one * other
        total = self.builder.combine([weight for weight, _ in pairs], [value for _, value in pairs])
        return fixed if total is None else NUMBERS["add"](self.builder, total, fixed)

    def lost(self) -> ProblemError:
        """Return the exception to raise if a traced function computes with plain arrays of objects."""
        return ProblemError(
            f"{self.name} computes with traced numbers in a plain array of objects, such as np.array and np.asarray "
            f"create in methods of objects; expected {_ARRAYS}"
        )

    def refused(self, name: str) -> ProblemError:
        """Return the exception to raise if a function uses a NumPy function that cannot be traced."""
        known = sorted({*NUMBERS, "where", "dot", "sum", "linalg.solve"} - {"conjugate", "fabs", "float_power"})
        return ProblemError(f"{self.name} uses np.{name}, which cannot be traced; expected one of {', '.join(known)}")

    def _known(self, index: int) -> Coefficient:
        """Return the value of a constant operation, or the index of another operation."""
        op = self.builder.ops[index]
        return self.builder.constants[op.arguments[0]] if op.name == "const" else index


def compute(ufunc: np.ufunc, method: str, inputs: Sequence[Any], out: Any, axis: Any, keepdims: bool) -> Any:
    """Return the result of an element-wise NumPy function (or its ``reduce``) for arrays that contain symbols."""
    if not symbols_in(inputs):
        more = {"axis": axis, "keepdims": keepdims} if method == "reduce" else {}
        result = held(getattr(ufunc, method)(*map(_as_floats, inputs), **more))
    elif method == "reduce":
        result = _reduced(ufunc, objects(inputs[0]), axis, keepdims)
    elif method == "__call__" and ufunc.__name__ == "matmul":
        result = matrix_product(objects(inputs[0]), objects(inputs[1]))
    elif method == "__call__":
        recorder = recorder_of(inputs)
        rule = np.frompyfunc(lambda *values: recorder.entry(ufunc, *values), len(inputs), 1)
        result = rule(*(objects(one) for one in inputs))
    else:
        raise recorder_of(inputs).refused(f"{ufunc.__name__}.{method}")
    if out is None or isinstance(out[0], Symbol):  # in x[0] += 1, the symbol is immutable
        return seen(result)
    out[0][...] = result
    return out[0]


def matrix_product(A: Objects, B: Objects) -> Any:
    """Return the matrix product of vectors and matrices that contain symbols."""
    if A.ndim not in (1, 2) or B.ndim not in (1, 2) or A.shape[-1] != len(B):
        raise ProblemError(
            f"the operands of @ have the shapes {A.shape} and {B.shape}; expected vectors or matrices of matching sizes"
        )
    recorder = recorder_of([A, B])
    columns = B[:, None] if B.ndim == 1 else B
    found = [recorder.product(A[None] if A.ndim == 1 else A, column) for column in columns.T]
    result = np.empty((1 if A.ndim == 1 else len(A), columns.shape[1]), dtype=object)
    for j, column in enumerate(found):
        result[:, j] = column
    return result.reshape((*A.shape[:-1], *B.shape[1:]))[()]


def objects(value: object) -> Objects:
    """Return a value as a plain NumPy array of objects."""
    return np.asarray(value, dtype=object).view(np.ndarray)


def seen(value: Any) -> Any:
    """Return an array of objects as a ``SymbolicArray``, which records operations; return other values unchanged."""
    if isinstance(value, list):
        return [seen(one) for one in cast("list[Any]", value)]
    return value.view(SymbolicArray) if is_array(value) and value.dtype == object else value


def held(value: Any) -> Any:
    """Return an array of floats as an array that can contain symbols; return other values unchanged."""
    return seen(value.astype(object) if is_array(value) and value.dtype.kind == "f" else value)


def is_array(value: object) -> TypeGuard[Objects]:
    """Return whether a value is a NumPy array."""
    return isinstance(value, np.ndarray)


def is_list(value: object) -> TypeGuard[Sequence[Any]]:
    """Return whether a value is a list or a tuple."""
    return isinstance(value, list | tuple)


def _as_floats(value: Any) -> Any:
    """Return an argument that contains no symbols, with arrays of objects converted to floats."""
    if is_list(value):
        return [_as_floats(one) for one in value]
    return objects(value).astype(float) if isinstance(value, SymbolicArray) else value


def symbols_in(value: object) -> list[Symbol]:
    """Return all symbols among given arguments, including those in arrays and lists."""
    if isinstance(value, Symbol):
        return [value]
    if is_array(value) and value.dtype == object:
        return [entry for entry in value.ravel().tolist() if isinstance(entry, Symbol)]
    return list(chain.from_iterable(map(symbols_in, value))) if is_list(value) else []


def recorder_of(values: Sequence[object]) -> Recorder:
    """Return the recorder of the symbols in given arguments, or a new recorder if there are no symbols."""
    found = symbols_in(list(values))
    return found[0].recorder if found else Recorder(Builder(), "the function")


def _reduced(ufunc: np.ufunc, values: Objects, axis: Any, keepdims: bool) -> Any:
    """Return the reduction of all entries, or along one axis, in the order of the entries."""
    shape = values.shape
    lines = values.ravel() if axis is None else np.moveaxis(values, axis, 0)
    if not len(lines):
        return ufunc.reduce(np.zeros(shape), axis=axis, keepdims=keepdims)
    result = reduce(lambda one, other: compute(ufunc, "__call__", (one, other), None, 0, False), lines)
    if keepdims:
        kept = [1] * len(shape) if axis is None else [1 if i == axis % len(shape) else n for i, n in enumerate(shape)]
        result = np.asarray(result, dtype=object).reshape(kept)
    return result
