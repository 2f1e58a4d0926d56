"""Tracing of a user's NumPy function: a call with symbols records the operations that the function computes.

An array of symbols is an array of objects, so that NumPy itself does the indexing, slicing and reshaping. Three kinds
of functions are recorded:

* Functions of single entries, and their reductions, by the rules in ``functions`` (``__array_ufunc__``).
* Functions of whole arrays, such as ``np.linalg.solve``, by the rules at the end of this file; rearrangements are done
  by NumPy (``__array_function__``).
* Constructors such as ``np.zeros(3)``. It returns an array of floats, which cannot contain a symbol, and has no symbol
  as argument that could redirect the call. Therefore a copy of the user's function is traced, in which names such as
  ``np`` refer to replacements; functions that it calls are copied as well.

The values of symbols are unknown while a function is traced: where a function needs one, an error names the remedy.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from functools import partial, reduce
from itertools import chain
from types import CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any, TypeGuard, cast

import numpy as np
import numpy.typing as npt

from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.program.functions import COMPARISONS, LOGIC, NUMBERS
from taciturn.program.ir import Builder, Coefficient, equals

Objects = npt.NDArray[Any]  # floats, truth values and symbols
_UNKNOWN = "but numbers are unknown while the function is traced"
_ARRAYS = "functions of NumPy, and arrays made by np.stack([…]), np.copy(x) or np.zeros_like(x)"
_PLAIN: tuple[Callable[..., Any], ...] = (  # functions that rearrange entries, or use only operators of the entries
    np.append, np.atleast_1d, np.atleast_2d, np.block, np.broadcast_to, np.column_stack, np.concatenate, np.copy,
    np.cross, np.cumsum, np.diag, np.diagonal, np.diff, np.empty_like, np.expand_dims, np.flip, np.full_like,
    np.hstack, np.kron, np.mean, np.ndim, np.ones_like, np.outer, np.prod, np.ravel, np.repeat, np.reshape, np.roll,
    np.shape, np.size, np.split, np.squeeze, np.stack, np.sum, np.swapaxes, np.tensordot, np.tile, np.trace,
    np.transpose, np.vstack, np.zeros_like,
)  # fmt: skip
_OF_OBJECTS = re.compile(r"has no callable \w+ method|dtype\('O'\)")  # NumPy's errors for plain arrays of objects


def trace(
    builder: Builder,
    function: Callable[..., object],
    arguments: Mapping[str, Sequence[int]],
    results: Mapping[str, int],
) -> dict[str, list[int]]:
    """Call a NumPy function once with symbols, and return the operations that compute its results."""
    # The function consists of NumPy code that also runs on floats. The values of its arguments are unknown while it is
    # traced, so it must use ``np.where`` instead of ``if``. Values that do not depend on the arguments are computed
    # during the trace. The function, and functions that it calls by name, may assign to entries of arrays from
    # ``np.zeros``. Methods of objects must create arrays by ``np.zeros_like(x)`` or ``np.stack([…])``.
    name = getattr(function, "__name__", type(function).__name__)
    recorder = _Recorder(builder, name)
    vectors = [recorder.symbols(values) for values in arguments.values()]
    try:
        with np.errstate(all="ignore"), redirect_stdout(sys.stderr):
            returned = _rebind(function)(*vectors)
    except ProblemError:
        raise
    except Exception as error:
        if isinstance(error, TypeError | AttributeError) and _OF_OBJECTS.search(str(error)):
            raise recorder.lost() from error
        raise ProblemError(
            f"the function {name} fails when it is traced: {type(error).__name__}: {' '.join(str(error).split())}; "
            f"expected a function of the vectors {', '.join(arguments)} in NumPy code"
        ) from error
    if returned is None:
        raise ProblemError(f"the function {name} returns nothing; expected the vector {', '.join(results)}")
    if len(results) == 1:
        returned = (returned,)
    elif not _is_list(returned) or len(returned) != len(results):
        got = f"{number_of(len(returned), 'value')}" if _is_list(returned) else "one vector"
        raise ProblemError(
            f"the function {name} returns {got}; expected a tuple of {number_of(len(results), 'vector')}: "
            f"{', '.join(results)}"
        )
    pairs = zip(results.items(), returned, strict=True)
    return {result: _result(recorder, result, size, value) for (result, size), value in pairs}


def _result(recorder: _Recorder, name: str, size: int, value: object) -> list[int]:
    found = objects(value)
    if found.shape != (size,) and not (size == 1 and found.shape == ()):
        raise ProblemError(
            f"the function {recorder.name} returns {name} of shape {found.shape}; expected the shape ({size},), one "
            "number for each entry"
        )
    entries: list[object] = found.ravel().tolist()
    for place, entry in enumerate(entries):
        if isinstance(entry, float) and not math.isfinite(entry):
            raise ProblemError(
                f"the function {recorder.name} returns {entry} as entry {place} of {name} for all arguments; expected "
                "a finite number"
            )
    return [recorder.builder.value(recorder.number(entry)) for entry in entries]


class _Symbol(np.lib.mixins.NDArrayOperatorsMixin):
    """Placeholder that a traced function receives instead of a number or a truth value."""

    def __init__(self, recorder: _Recorder, index: int) -> None:
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
            raise _recorder_of(inputs).refused(f"{ufunc.__name__} with one of the arguments where, initial and dtype")
        return compute(ufunc, method, inputs, out, axis, keepdims)

    def __array_function__(self, function: Any, types: object, args: Any, kwargs: Any) -> Any:
        """Record a NumPy function of whole arrays."""
        given = [*args, *kwargs.values()]
        if not _symbols_in(given):
            named = {name: _as_floats(value) for name, value in kwargs.items()}
            return held(function(*map(_as_floats, args), **named))
        if function in _PLAIN:
            return seen(function(*map(_plain, args), **{name: _plain(one) for name, one in kwargs.items()}))
        if function not in _RULES:
            raise _recorder_of(given).refused(function.__name__)
        return _RULES[function](*args, **kwargs)

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
            f"the function {self.recorder.name} needs the truth value of a condition (for if, and, or, max), "
            f"{_UNKNOWN}; expected np.where, & and |, np.maximum: {_ARRAYS}"
        )

    def __float__(self) -> float:
        """Raise an error, since the value is unknown."""
        raise ProblemError(
            f"the function {self.recorder.name} converts a traced number to a float (as math.sin, float() and "
            f"np.zeros(n)[i] = do), {_UNKNOWN}; expected {_ARRAYS}"
        )

    def __int__(self) -> int:
        """Raise an error, since the value is unknown."""
        raise ProblemError(
            f"the function {self.recorder.name} converts a traced number to an integer (as int() and round() do), "
            f"{_UNKNOWN}; expected np.floor or np.rint"
        )

    __index__ = __int__


class Number(_Symbol):
    """Symbol for a number whose value is known only when the program runs."""


class SymbolicTruth(_Symbol):
    """Symbol for a truth value that is known only when the program runs."""


class _SymbolicArray(np.ndarray[Any, Any]):
    """A NumPy array whose entries can be placeholders of unknown numbers (symbols)."""

    __array_ufunc__ = _Symbol.__array_ufunc__  # type: ignore[assignment]
    __array_function__ = _Symbol.__array_function__  # type: ignore[assignment]


class _Recorder:
    """Recorder of a traced function: stores its computations as operations of a program."""

    def __init__(self, builder: Builder, name: str) -> None:
        """Start without operations."""
        self.builder, self.name = builder, name

    def symbols(self, values: Sequence[int]) -> _SymbolicArray:
        """Create a vector with a symbol for each of the given operations."""
        vector = np.empty(len(values), dtype=object)
        vector[:] = [self.symbol(self._known(value)) for value in values]
        return vector.view(_SymbolicArray)

    def symbol(self, value: Coefficient) -> float | Number:
        """Return a symbol for the operation that computes a number. If it is a constant, return it unchanged."""
        return value if isinstance(value, float) else Number(self, value)

    def number(self, value: object) -> Coefficient:
        """Return the constant, or the operation that computes it, for a number in an array."""
        if isinstance(value, Number):
            return value.index
        if isinstance(value, SymbolicTruth):
            return self.builder.choose(value.index, self.builder.constant(1.0), self.builder.constant(0.0))
        try:
            found = float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            raise ProblemError(
                f"the function {self.name} computes with {value!r:.60}; expected numbers, or arrays of numbers"
            ) from None
        if math.isnan(found):
            raise ProblemError(f"the function {self.name} computes with a constant NaN; expected finite numbers")
        return found

    def truth(self, value: object) -> int | bool:
        """Return True or False, or the operation that computes it, for a truth value in an array."""
        if isinstance(value, SymbolicTruth):
            return value.index
        if isinstance(value, Number):
            return COMPARISONS["not_equal"](self.builder, value.index, 0.0)
        return bool(value)

    def entry(self, ufunc: np.ufunc, *values: Any) -> Any:
        """Apply an element-wise NumPy function to single entries, which may be symbols."""
        name = "divide" if ufunc.__name__ == "true_divide" else ufunc.__name__
        if not any(isinstance(value, _Symbol) for value in values):
            return ufunc(*(float(value) if type(value) is int else value for value in values))
        if name in LOGIC:
            return self.condition(LOGIC[name](self.builder, *(self.truth(value) for value in values)))
        if name in COMPARISONS:
            return self.condition(COMPARISONS[name](self.builder, *(self.number(value) for value in values)))
        if name in NUMBERS:
            return self.symbol(NUMBERS[name](self.builder, *(self.number(value) for value in values)))
        raise self.refused(name)

    def condition(self, truth: int | bool) -> bool | SymbolicTruth:
        """Return a symbol for the operation that computes a truth value. If it is known, return it unchanged."""
        return truth if isinstance(truth, bool) else SymbolicTruth(self, truth)

    def either(self, condition: object, yes: object, no: object) -> object:
        """Select ``yes`` if a condition is true, and ``no`` otherwise, like ``np.where``."""
        truth, b = self.truth(condition), self.builder
        if isinstance(truth, bool):
            return yes if truth else no
        one, other = self.number(yes), self.number(no)
        if isinstance(other, float) and equals(one, other):  # the constant stays known
            return other
        return self.symbol(b.choose(truth, b.value(one), b.value(other)))

    def product(self, matrix: Objects, column: Objects) -> list[object]:
        """Multiply a matrix by a column vector. The product with a large constant matrix is one operation."""
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
        """Create the exception for a traced function that converts symbols to plain arrays of objects."""
        return ProblemError(
            f"{self.name} computes with traced numbers in a plain array of objects, such as np.array and np.asarray "
            f"create in methods of objects; expected {_ARRAYS}"
        )

    def refused(self, name: str) -> ProblemError:
        """Create the exception for a traced function that calls a NumPy function which cannot be traced."""
        known = sorted({*NUMBERS, "where", "dot", "sum", "linalg.solve"} - {"conjugate", "fabs", "float_power"})
        return ProblemError(f"{self.name} uses np.{name}, which cannot be traced; expected one of {', '.join(known)}")

    def _known(self, index: int) -> Coefficient:
        """Return the value of a constant operation, or the index of another operation."""
        op = self.builder.ops[index]
        return self.builder.constants[op.arguments[0]] if op.name == "const" else index


def compute(ufunc: np.ufunc, method: str, inputs: Sequence[Any], out: Any, axis: Any, keepdims: bool) -> Any:
    """Apply an element-wise NumPy function, or its method ``reduce``, to arrays that contain symbols."""
    if not _symbols_in(inputs):
        more = {"axis": axis, "keepdims": keepdims} if method == "reduce" else {}
        result = held(getattr(ufunc, method)(*map(_as_floats, inputs), **more))
    elif method == "reduce":
        result = _reduced(ufunc, objects(inputs[0]), axis, keepdims)
    elif method == "__call__" and ufunc.__name__ == "matmul":
        result = _matrix_product(objects(inputs[0]), objects(inputs[1]))
    elif method == "__call__":
        recorder = _recorder_of(inputs)
        rule = np.frompyfunc(lambda *values: recorder.entry(ufunc, *values), len(inputs), 1)
        result = rule(*(objects(one) for one in inputs))
    else:
        raise _recorder_of(inputs).refused(f"{ufunc.__name__}.{method}")
    if out is None or isinstance(out[0], _Symbol):  # in x[0] += 1, the symbol is immutable
        return seen(result)
    out[0][...] = result
    return out[0]


def _matrix_product(A: Objects, B: Objects) -> Any:
    """Return the matrix product of vectors and matrices that contain symbols."""
    if A.ndim not in (1, 2) or B.ndim not in (1, 2) or A.shape[-1] != len(B):
        raise ProblemError(
            f"the operands of @ have the shapes {A.shape} and {B.shape}; expected vectors or matrices of matching sizes"
        )
    recorder = _recorder_of([A, B])
    columns = B[:, None] if B.ndim == 1 else B
    found = [recorder.product(A[None] if A.ndim == 1 else A, column) for column in columns.T]
    result = np.empty((1 if A.ndim == 1 else len(A), columns.shape[1]), dtype=object)
    for j, column in enumerate(found):
        result[:, j] = column
    return result.reshape((*A.shape[:-1], *B.shape[1:]))[()]


def objects(value: object) -> Objects:
    """Convert a value to a plain NumPy array of objects."""
    return np.asarray(value, dtype=object).view(np.ndarray)


def seen(value: Any) -> Any:
    """Convert an array of objects to a ``_SymbolicArray``, which records operations. Return other values unchanged."""
    if isinstance(value, list):
        return [seen(one) for one in cast("list[Any]", value)]
    return value.view(_SymbolicArray) if _is_array(value) and value.dtype == object else value


def held(value: Any) -> Any:
    """Convert an array of floats to an array that can contain symbols. Return other values unchanged."""
    return seen(value.astype(object) if _is_array(value) and value.dtype.kind == "f" else value)


def _is_array(value: object) -> TypeGuard[Objects]:
    """Return whether a value is a NumPy array."""
    return isinstance(value, np.ndarray)


def _is_list(value: object) -> TypeGuard[Sequence[Any]]:
    """Return whether a value is a list or a tuple."""
    return isinstance(value, list | tuple)


def _as_floats(value: Any) -> Any:
    """Return an argument that contains no symbols, with arrays of objects converted to floats."""
    if _is_list(value):
        return [_as_floats(one) for one in value]
    return objects(value).astype(float) if isinstance(value, _SymbolicArray) else value


def _symbols_in(value: object) -> list[_Symbol]:
    """Return all symbols among given arguments, including those in arrays and lists."""
    if isinstance(value, _Symbol):
        return [value]
    if _is_array(value) and value.dtype == object:
        return [entry for entry in value.ravel().tolist() if isinstance(entry, _Symbol)]
    return list(chain.from_iterable(map(_symbols_in, value))) if _is_list(value) else []


def _recorder_of(values: Sequence[object]) -> _Recorder:
    """Return the recorder of the symbols in given arguments, or a new recorder if there are no symbols."""
    found = _symbols_in(list(values))
    return found[0].recorder if found else _Recorder(Builder(), "the function")


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


def _choose_entries(condition: Any, yes: Any, no: Any) -> Any:
    """Return the result of ``np.where``: entries of ``yes`` where the condition is true, and of ``no`` elsewhere."""
    recorder = _recorder_of([condition, yes, no])
    return seen(np.frompyfunc(recorder.either, 3, 1)(*(objects(one) for one in (condition, yes, no))))


def clip(a: Any, a_min: Any = None, a_max: Any = None, *, min: Any = None, max: Any = None) -> Any:
    """Limit entries to bounds, like ``np.clip``, in which each bound has two names."""
    for ufunc, bound in ((np.maximum, a_min), (np.maximum, min), (np.minimum, a_max), (np.minimum, max)):
        a = a if bound is None else compute(ufunc, "__call__", (a, bound), None, 0, False)
    return a


def dot(a: Any, b: Any) -> Any:
    """Multiply vectors, matrices or scalars, like ``np.dot``."""
    one, other = objects(a), objects(b)
    return seen(_matrix_product(one, other)) if one.ndim and other.ndim else a * b


def inner(a: Any, b: Any) -> Any:
    """Sum products along the last axes of two arrays, like ``np.inner``."""
    return dot(a, objects(b).T) if objects(b).ndim > 1 else dot(a, b)


def vdot(a: Any, b: Any) -> Any:
    """Sum the products of all entries of two arrays in order, like ``np.vdot``."""
    return dot(objects(a).ravel(), objects(b).ravel())


def solve(a: Any, b: Any) -> Any:
    """Solve the linear system a·x = b by Gaussian elimination with partial pivoting."""
    A, B = objects(a), objects(b)
    size = len(A)
    if A.shape != (size, size) or B.ndim not in (1, 2) or len(B) != size:
        raise ProblemError(
            f"the arguments of np.linalg.solve have the shapes {A.shape} and {B.shape}; expected a square matrix, and "
            "as many rows in the second argument"
        )
    rows: list[Any] = [seen(row) for row in np.concatenate([A, B.reshape(size, -1)], axis=1)]
    for j in range(size):
        # the values are unknown while tracing, so that selections compare and exchange the row with every row below it
        for i in range(j + 1, size):
            larger = abs(rows[i][j]) > abs(rows[j][j])
            rows[j], rows[i] = _choose_entries(larger, rows[i], rows[j]), _choose_entries(larger, rows[j], rows[i])
        for i in range(j + 1, size):
            rows[i] = rows[i] - rows[i][j] / rows[j][j] * rows[j]
    for j in reversed(range(size)):
        for k in range(j + 1, size):
            rows[j] = rows[j] - rows[j][k] * rows[k]
        rows[j] = rows[j] / rows[j][j]
    return seen(np.array([objects(row)[size:] for row in rows], dtype=object).reshape(B.shape))


def invert(a: Any) -> Any:
    """Compute the inverse of a matrix by Gaussian elimination."""
    return solve(a, np.eye(len(objects(a))))


def norm(x: Any, ord: None = None, axis: Any = None, keepdims: bool = False) -> Any:
    """Compute the Euclidean norm of an array, over all entries or along an axis."""
    if ord is not None:
        raise ProblemError(f"np.linalg.norm of order {ord!r} cannot be traced; expected the Euclidean norm (no order)")
    return np.sqrt(compute(np.add, "reduce", (np.square(seen(objects(x))),), None, axis, keepdims))


def _extreme(ufunc: np.ufunc) -> Callable[..., Any]:
    def extreme(a: Any, axis: Any = None, out: Any = None, keepdims: bool = False) -> Any:
        return compute(ufunc, "reduce", (a,), out, axis, keepdims)

    return extreme


_RULES: Mapping[Callable[..., Any], Callable[..., Any]] = {
    np.where: _choose_entries, np.clip: clip, np.dot: dot, np.inner: inner, np.vdot: vdot, np.max: _extreme(np.maximum),
    np.min: _extreme(np.minimum), np.any: _extreme(np.logical_or), np.all: _extreme(np.logical_and),
    np.linalg.solve: solve, np.linalg.inv: invert, np.linalg.norm: norm,
}  # fmt: skip


def _plain(value: Any) -> Any:
    """Return an argument with every ``_SymbolicArray`` replaced by a plain array of objects."""
    if _is_list(value):
        listed = [_plain(one) for one in value]
        return tuple(listed) if isinstance(value, tuple) else listed
    return objects(value) if isinstance(value, _SymbolicArray | _Symbol) else value


def _array(value: Any, /, dtype: Any = None, *, copy: bool | None = True, order: Any = None, ndmin: int = 0) -> Any:
    if dtype is not None and np.dtype(dtype) == object:
        dtype = None
    if (isinstance(value, _SymbolicArray) or _symbols_in(value)) and (dtype is None or np.dtype(dtype) == float):
        return seen(np.array(value, object, copy=copy, order=order, ndmin=ndmin))
    return held(np.array(_plain(value), dtype, copy=copy, order=order, ndmin=ndmin))


def _as_array(a: Any, dtype: Any = None, order: Any = None, *, copy: bool | None = None) -> Any:
    return _array(a, dtype, copy=copy, order=order)


def _filled(value: float) -> Callable[..., Any]:
    def filled(shape: Any, dtype: Any = None) -> Any:
        return held(np.full(shape, value, dtype))

    return filled


def _full(shape: Any, fill_value: Any, dtype: Any = None) -> Any:
    if not _symbols_in(fill_value):
        return held(np.full(shape, fill_value, dtype))
    found = seen(np.empty(shape, dtype=object))
    found[...] = fill_value
    return found


def _eye(N: int, M: int | None = None, k: int = 0, dtype: Any = None) -> Any:
    return held(np.eye(N, M, k, float if dtype is None else dtype))


def _identity(n: int, dtype: Any = None) -> Any:
    return _eye(n, dtype=dtype)


def _joined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of several arrays that also accepts lists with symbols."""

    def joined(arrays: Any) -> Any:
        return seen(function([objects(one) for one in arrays])) if _symbols_in(arrays) else held(function(arrays))

    return joined


def _joined_along(function: Callable[..., Any]) -> Callable[..., Any]:
    def joined(arrays: Any, axis: int = 0) -> Any:
        return _joined(partial(function, axis=axis))(arrays)

    return joined


def _diagonal(v: Any, k: int = 0) -> Any:
    return seen(np.diag(objects(v), k)) if _symbols_in(v) else held(np.diag(v, k))


def _block(arrays: Any) -> Any:
    return held(np.block(_plain(arrays)))


_STAND_INS: Mapping[Any, Callable[..., Any]] = {  # array constructors whose results can contain symbols
    np.array: _array, np.asarray: _as_array, np.zeros: _filled(0.0), np.ones: _filled(1.0), np.empty: _filled(np.nan),
    np.full: _full, np.eye: _eye, np.identity: _identity, np.concatenate: _joined_along(np.concatenate),
    np.stack: _joined_along(np.stack), np.hstack: _joined(np.hstack), np.vstack: _joined(np.vstack),
    np.column_stack: _joined(np.column_stack), np.diag: _diagonal, np.block: _block,
}  # fmt: skip


def _rebind(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a copy of a function in which constructors of arrays are replaced."""
    # Functions that it calls by name or from a list are copied in the same way.
    if not isinstance(function, FunctionType | MethodType | partial) and callable(type(function).__call__):
        method = type(function).__call__
        function = MethodType(method, function) if isinstance(method, FunctionType) else function
    return _Copies().of(function)


class _Numpy(ModuleType):
    """The module ``numpy`` with constructors of arrays replaced."""

    def __init__(self) -> None:
        super().__init__("numpy")
        self.__dict__.update({function.__name__: other for function, other in _STAND_INS.items()})

    def __getattr__(self, name: str) -> Any:
        return getattr(np, name)


class _Copies:
    """Stores the copies of functions, so that a function that is called twice is copied once."""

    def __init__(self) -> None:
        self.numpy, self.copies = _Numpy(), dict[int, FunctionType]()

    def of(self, value: Any) -> Any:
        """Return the substitute for a value that a traced function uses, such as ``np``. Most values are their own
        substitute.
        """
        if value is np:
            return self.numpy
        if isinstance(value, FunctionType):
            return self._copy(value) if _is_ours(value) else _STAND_INS.get(value, value)
        if isinstance(value, MethodType):
            return MethodType(self.of(value.__func__), value.__self__)
        if isinstance(value, partial):
            given = {name: self.of(one) for name, one in value.keywords.items()}
            return partial(self.of(value.func), *map(self.of, value.args), **given)
        if _is_list(value) and any(map(callable, value)):
            return type(value)(map(self.of, value))  # type: ignore[call-arg]
        if isinstance(value, dict):
            held = cast("dict[Any, Any]", value)
            return {name: self.of(one) for name, one in held.items()} if any(map(callable, held.values())) else held
        is_function = type(value) in (type(np.zeros), type(np.concatenate))
        return _STAND_INS.get(value, value) if is_function else value

    def _copy(self, function: FunctionType) -> FunctionType:
        if id(function) in self.copies:
            return self.copies[id(function)]
        known = dict(function.__globals__)
        cells = tuple(CellType() for _ in function.__closure__ or ())
        copy = FunctionType(function.__code__, known, function.__name__, function.__defaults__, cells or None)
        copy.__kwdefaults__ = function.__kwdefaults__
        self.copies[id(function)] = copy  # stored before its contents, as the function may call itself
        for cell, original in zip(cells, function.__closure__ or (), strict=True):
            if _is_filled(original):
                cell.cell_contents = self.of(original.cell_contents)
        known.update({name: self.of(known[name]) for name in _names(function.__code__) if name in known})
        return copy


def _is_ours(function: FunctionType) -> bool:
    """Return whether a function is not part of NumPy or SciPy, so that a copy is traced."""
    return str(function.__module__).split(".")[0] not in ("numpy", "scipy")


def _is_filled(cell: CellType) -> bool:
    try:
        return cell.cell_contents is not cell
    except ValueError:
        return False


def _names(code: CodeType) -> Iterator[str]:
    """Yield the names that a function and its inner functions read."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)
