"""Validation of the parameters of a policy kind against its design function."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from functools import cache
from typing import Any, cast, get_type_hints

import numpy as np

from taciturn._arrays import Array, ArrayLike, quoted
from taciturn._pydantic import ValidationError, validate
from taciturn.design.catalogue import CATALOGUE
from taciturn.errors import ProblemError
from taciturn.problem.tables import Rows, ours, suggest


def read_policy(table: Mapping[str, Any], name: str) -> tuple[str, dict[str, Any]]:
    """Return the kind and the parameters in a ``[policy]`` table.

    Raises:
        ProblemError: if the kind or a parameter does not exist.
    """
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in CATALOGUE:
        got = f"is {quoted(kind)}" if "kind" in table else "is missing"
        near = suggest(kind, list(CATALOGUE)) if isinstance(kind, str) else ""
        raise ProblemError(f"{name}: policy.kind {got}; expected one of {', '.join(CATALOGUE)}{near}")
    parameters = {key: value for key, value in table.items() if key != "kind"}
    try:
        check_parameters(kind, parameters)
    except ProblemError as error:
        raise ProblemError(f"{name}: {error}") from None
    return kind, parameters


def expect_kind(kind: str) -> None:
    """Raise a ``ProblemError`` if the catalogue does not contain a policy kind."""
    if kind not in CATALOGUE:
        near = suggest(str(kind), list(CATALOGUE))
        raise ProblemError(f"policy.kind is {quoted(kind)}; expected one of {', '.join(CATALOGUE)}{near}")


def check_parameters(kind: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a policy kind, checked against its design function.

    Raises:
        ProblemError: if a parameter is unknown, missing, or of the wrong type.
    """
    expect_kind(kind)
    known = _accepted(kind)
    for key in parameters:
        if key not in known:
            expected = f"one of {', '.join(known)}" if known else "no parameters"
            raise ProblemError(
                f"policy.{key} is not a parameter of {kind}; expected {expected}{suggest(key, list(known))}"
            )
    for key, (_, needed) in known.items():
        if needed and key not in parameters:
            raise ProblemError(f"policy.{key} is missing; {kind} requires it")
    return {key: check_parameter(kind, key, value) for key, value in parameters.items()}


def check_parameter(kind: str, key: str, value: object) -> Any:
    """Return a parameter of a policy kind, checked against its design function.

    Raises:
        ProblemError: if the parameter is of the wrong type.
    """
    if isinstance(value, np.ndarray):
        return cast("Array", value)
    try:
        return validate(_accepted(kind)[key][0], value)
    except ValidationError as error:
        raise ProblemError(f"policy.{key} is {quoted(value)}; {ours(error.errors()[0]['msg'])}") from None


@cache
def _accepted(kind: str) -> dict[str, tuple[Any, bool]]:
    """Return the type of each parameter of a policy kind, and whether the parameter is required."""
    design = CATALOGUE[kind]
    hints = get_type_hints(design)
    return {
        key: (Rows if hints[key] == ArrayLike | None else hints[key], value.default is value.empty)
        for key, value in inspect.signature(design).parameters.items()
        if value.kind is value.KEYWORD_ONLY
        and key not in ("network", "reference")  # matrices are written as lists of rows
    }
