"""Typed interface to python-control, an optional dependency; no other module imports it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, TypeAlias

from taciturn._arrays import Array
from taciturn.errors import ProblemError

Function: TypeAlias = Callable[[float, Array, Array, object], Array]
"""Function from time, state, input and parameters to the next state, or to the output."""


def state_space(A: Array, B: Array, C: Array, D: Array | None, dt: float | bool, name: str) -> Any:
    """Return the `control.StateSpace` x⁺ = A x + B u, y = C x + D u, with D = 0 for None.

    Raises:
        ProblemError: python-control is missing.
    """
    return _control().StateSpace(A, B, C, 0 if D is None else D, dt, name=name)


def nonlinear_system(
    update: Function,
    output: Function,
    states: Sequence[str],
    inputs: Sequence[str],
    outputs: Sequence[str],
    dt: float | bool,
    name: str,
) -> Any:
    """Return the `control.NonlinearIOSystem` of two functions.

    Raises:
        ProblemError: python-control is missing.
    """
    return _control().NonlinearIOSystem(
        update, output, states=list(states), inputs=list(inputs), outputs=list(outputs), dt=dt, name=name
    )


def is_linear(system: object) -> bool:
    """Return whether an object is a `control.StateSpace` or a `control.TransferFunction`.

    Raises:
        ProblemError: python-control is missing.
    """
    control = _control()
    return isinstance(system, (control.StateSpace, control.TransferFunction))


def _control() -> Any:
    try:
        return import_module("control")
    except ImportError:
        raise ProblemError(
            "python-control is not installed, but to_control and from_control require it: "
            "pip install 'taciturn[control]'"
        ) from None
