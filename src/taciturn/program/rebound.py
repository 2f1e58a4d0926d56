"""Copies of user functions in which NumPy's array constructors are replaced, so that arrays can contain symbols.

``np.zeros(3)`` returns an array of floats, which cannot contain a symbol, and has no symbol as argument that could
redirect the call. Therefore a copy of a function is traced, in which names such as ``np`` refer to replacements.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from types import CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any, cast

import numpy as np

from taciturn.program.symbols import is_list


def rebind(function: Callable[..., Any], stand_ins: Mapping[Any, Callable[..., Any]]) -> Callable[..., Any]:
    """Return a copy of a function in which given NumPy functions are replaced.

    Functions that it calls by name or from a list are copied in the same way.

    Args:
        function: a function written in Python; any other function is returned unchanged.
        stand_ins: the replacement of each NumPy function.
    """
    if not isinstance(function, FunctionType | MethodType | partial) and callable(type(function).__call__):
        method = type(function).__call__
        function = MethodType(method, function) if isinstance(method, FunctionType) else function
    return _Copies(stand_ins).of(function)


class _Numpy(ModuleType):
    """The module ``numpy`` with some functions replaced."""

    def __init__(self, stand_ins: Mapping[Any, Callable[..., Any]]) -> None:
        super().__init__("numpy")
        self.__dict__.update({function.__name__: other for function, other in stand_ins.items()})

    def __getattr__(self, name: str) -> Any:
        return getattr(np, name)


class _Copies:
    """Stores the copies of functions, so that a function that is called twice is copied once."""

    def __init__(self, stand_ins: Mapping[Any, Callable[..., Any]]) -> None:
        self.stand_ins, self.numpy = stand_ins, _Numpy(stand_ins)
        self.copies: dict[int, FunctionType] = {}

    def of(self, value: Any) -> Any:
        """Return the value to use in copied functions instead of a given one; most values are unchanged."""
        if value is np:
            return self.numpy
        if isinstance(value, FunctionType):
            return self._copy(value) if _is_ours(value) else self.stand_ins.get(value, value)
        if isinstance(value, MethodType):
            return MethodType(self.of(value.__func__), value.__self__)
        if isinstance(value, partial):
            given = {name: self.of(one) for name, one in value.keywords.items()}
            return partial(self.of(value.func), *map(self.of, value.args), **given)
        if is_list(value) and any(map(callable, value)):
            return type(value)(map(self.of, value))  # type: ignore[call-arg]
        if isinstance(value, dict):
            held = cast("dict[Any, Any]", value)
            return {name: self.of(one) for name, one in held.items()} if any(map(callable, held.values())) else held
        is_function = type(value) in (type(np.zeros), type(np.concatenate))
        return self.stand_ins.get(value, value) if is_function else value

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
