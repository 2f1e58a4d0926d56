"""NumPy functions for arrays that contain traced symbols: rearrangement, selection, products, linear systems."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from taciturn.errors import ProblemError
from taciturn.program.symbols import (
    FUNCTIONS,
    Symbol,
    SymbolicArray,
    compute,
    held,
    is_list,
    matrix_product,
    objects,
    recorder_of,
    seen,
    symbols_in,
)

_PLAIN: tuple[Callable[..., Any], ...] = (  # functions that rearrange entries, or use only operators of the entries
    np.append, np.atleast_1d, np.atleast_2d, np.block, np.broadcast_to, np.column_stack, np.concatenate, np.copy,
    np.cross, np.cumsum, np.diag, np.diagonal, np.diff, np.empty_like, np.expand_dims, np.flip, np.full_like,
    np.hstack, np.kron, np.mean, np.ndim, np.ones_like, np.outer, np.prod, np.ravel, np.repeat, np.reshape, np.roll,
    np.shape, np.size, np.split, np.squeeze, np.stack, np.sum, np.swapaxes, np.tensordot, np.tile, np.trace,
    np.transpose, np.vstack, np.zeros_like,
)  # fmt: skip


def choose(condition: Any, yes: Any, no: Any) -> Any:
    """Return the result of ``np.where``: entries of ``yes`` where the condition is true, and of ``no`` elsewhere."""
    recorder = recorder_of([condition, yes, no])
    return seen(np.frompyfunc(recorder.either, 3, 1)(*(objects(one) for one in (condition, yes, no))))


def clip(a: Any, a_min: Any = None, a_max: Any = None, *, min: Any = None, max: Any = None) -> Any:
    """Return the result of ``np.clip``, which limits entries to bounds; NumPy has two names for each bound."""
    for ufunc, bound in ((np.maximum, a_min), (np.maximum, min), (np.minimum, a_max), (np.minimum, max)):
        a = a if bound is None else compute(ufunc, "__call__", (a, bound), None, 0, False)
    return a


def dot(a: Any, b: Any) -> Any:
    """Return the result of ``np.dot`` for vectors, matrices or scalars."""
    one, other = objects(a), objects(b)
    return seen(matrix_product(one, other)) if one.ndim and other.ndim else a * b


def inner(a: Any, b: Any) -> Any:
    """Return the result of ``np.inner``: the sums of products over the last axes of two arrays."""
    return dot(a, objects(b).T) if objects(b).ndim > 1 else dot(a, b)


def vdot(a: Any, b: Any) -> Any:
    """Return the result of ``np.vdot``: the sum of the products of all entries, added in order."""
    return dot(objects(a).ravel(), objects(b).ravel())


def solve(a: Any, b: Any) -> Any:
    """Return the solution a⁻¹b of a linear system by Gaussian elimination with partial pivoting."""
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
            rows[j], rows[i] = choose(larger, rows[i], rows[j]), choose(larger, rows[j], rows[i])
        for i in range(j + 1, size):
            rows[i] = rows[i] - rows[i][j] / rows[j][j] * rows[j]
    for j in reversed(range(size)):
        for k in range(j + 1, size):
            rows[j] = rows[j] - rows[j][k] * rows[k]
        rows[j] = rows[j] / rows[j][j]
    return seen(np.array([objects(row)[size:] for row in rows], dtype=object).reshape(B.shape))


def invert(a: Any) -> Any:
    """Return the inverse of a matrix, by Gaussian elimination."""
    return solve(a, np.eye(len(objects(a))))


def norm(x: Any, ord: None = None, axis: Any = None, keepdims: bool = False) -> Any:
    """Return the Euclidean norm of an array, over all entries or along an axis."""
    if ord is not None:
        raise ProblemError(f"np.linalg.norm of order {ord!r} cannot be traced; expected the Euclidean norm (no order)")
    return np.sqrt(compute(np.add, "reduce", (np.square(seen(objects(x))),), None, axis, keepdims))


def _extreme(ufunc: np.ufunc) -> Callable[..., Any]:
    def extreme(a: Any, axis: Any = None, out: Any = None, keepdims: bool = False) -> Any:
        return compute(ufunc, "reduce", (a,), out, axis, keepdims)

    return extreme


_RULES: Mapping[Callable[..., Any], Callable[..., Any]] = {
    np.where: choose, np.clip: clip, np.dot: dot, np.inner: inner, np.vdot: vdot, np.max: _extreme(np.maximum),
    np.min: _extreme(np.minimum), np.any: _extreme(np.logical_or), np.all: _extreme(np.logical_and),
    np.linalg.solve: solve, np.linalg.inv: invert, np.linalg.norm: norm,
}  # fmt: skip


def _called(rule: Callable[..., Any]) -> Callable[[Sequence[Any], Mapping[str, Any]], Any]:
    return lambda args, kwargs: rule(*args, **kwargs)


def _plainly(function: Callable[..., Any]) -> Callable[[Sequence[Any], Mapping[str, Any]], Any]:
    """Return the rule that calls the NumPy function itself with plain arrays of objects."""
    return lambda args, kwargs: seen(
        function(*map(_plain, args), **{name: _plain(one) for name, one in kwargs.items()})
    )


def _plain(value: Any) -> Any:
    """Return an argument with every ``SymbolicArray`` replaced by a plain array of objects."""
    if is_list(value):
        listed = [_plain(one) for one in value]
        return tuple(listed) if isinstance(value, tuple) else listed
    return objects(value) if isinstance(value, SymbolicArray | Symbol) else value


FUNCTIONS |= {function: _called(rule) for function, rule in _RULES.items()}
FUNCTIONS |= {function: _plainly(function) for function in _PLAIN}


def _array(value: Any, /, dtype: Any = None, *, copy: bool | None = True, order: Any = None, ndmin: int = 0) -> Any:
    if dtype is not None and np.dtype(dtype) == object:
        dtype = None
    if (isinstance(value, SymbolicArray) or symbols_in(value)) and (dtype is None or np.dtype(dtype) == float):
        return seen(np.array(value, object, copy=copy, order=order, ndmin=ndmin))
    return held(np.array(_plain(value), dtype, copy=copy, order=order, ndmin=ndmin))


def _as_array(a: Any, dtype: Any = None, order: Any = None, *, copy: bool | None = None) -> Any:
    return _array(a, dtype, copy=copy, order=order)


def _filled(value: float) -> Callable[..., Any]:
    def filled(shape: Any, dtype: Any = None) -> Any:
        return held(np.full(shape, value, dtype))

    return filled


def _full(shape: Any, fill_value: Any, dtype: Any = None) -> Any:
    if not symbols_in(fill_value):
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
        return seen(function([objects(one) for one in arrays])) if symbols_in(arrays) else held(function(arrays))

    return joined


def _joined_along(function: Callable[..., Any]) -> Callable[..., Any]:
    def joined(arrays: Any, axis: int = 0) -> Any:
        return _joined(partial(function, axis=axis))(arrays)

    return joined


def _diagonal(v: Any, k: int = 0) -> Any:
    return seen(np.diag(objects(v), k)) if symbols_in(v) else held(np.diag(v, k))


def _block(arrays: Any) -> Any:
    return held(np.block(_plain(arrays)))


STAND_INS: Mapping[Any, Callable[..., Any]] = {  # array constructors whose results can contain symbols
    np.array: _array, np.asarray: _as_array, np.zeros: _filled(0.0), np.ones: _filled(1.0), np.empty: _filled(np.nan),
    np.full: _full, np.eye: _eye, np.identity: _identity, np.concatenate: _joined_along(np.concatenate),
    np.stack: _joined_along(np.stack), np.hstack: _joined(np.hstack), np.vstack: _joined(np.vstack),
    np.column_stack: _joined(np.column_stack), np.diag: _diagonal, np.block: _block,
}  # fmt: skip
