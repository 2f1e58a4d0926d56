"""The parameters of a policy kind, which are checked against the arguments of its design function.

The function declares what the table ``[policy]`` may state: a parameter without a default is required, its annotation
is the type, and a matrix is a list of rows in a file. So a new parameter of a kind is one argument of its function.
Ranges are checked by the function itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, cast

import numpy as np

from taciturn._arrays import Array, ArrayLike, expect_unmasked, quoted
from taciturn.design.catalogue import CATALOGUE
from taciturn.design.kind import Kind
from taciturn.errors import ProblemError
from taciturn.problem.schema import Rows, ValidationError, ours, suggest, validate


def read_policy(table: Mapping[str, Any], name: str, own: Kind | None = None) -> tuple[str, dict[str, Any]]:
    """Read the policy kind and its parameters from a ``[policy]`` table."""
    parameters = {key: value for key, value in table.items() if key != "kind"}
    try:
        if "kind" not in table:
            raise ProblemError(f"policy.kind is missing; expected one of the policy kinds {', '.join(CATALOGUE)}")
        kind = own if own is not None and own.name == table["kind"] else find_kind(table["kind"])
        check_parameters(kind, parameters)
    except ProblemError as error:
        raise ProblemError(f"{name}: {error}") from None
    return kind.name, parameters


def find_kind(kind: object, what: str = "policy.kind") -> Kind:
    """Find a policy kind by name. If there is none, the error suggests similar names."""
    if not isinstance(kind, str) or kind not in CATALOGUE:
        near = suggest(str(kind), list(CATALOGUE)) if isinstance(kind, str) else ""
        raise ProblemError(f"{what} is {quoted(kind)}; expected one of the policy kinds {', '.join(CATALOGUE)}{near}")
    return CATALOGUE[kind]


def check_parameters(kind: Kind, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Check the parameters of a policy kind against the arguments of its design function, and convert their types."""
    known = _accepted(kind)
    for key in parameters:
        if key not in known:
            expected = f"one of {', '.join(known)}" if known else "no parameters"
            raise ProblemError(
                f"policy.{key} is not a parameter of the policy kind {kind.name}; expected "
                f"{expected}{suggest(key, list(known))}"
            )
    for key, (_, needed) in known.items():
        if needed and key not in parameters:
            raise ProblemError(
                f"policy.{key} is missing; expected this parameter, which the policy kind {kind.name} requires"
            )
    return {key: check_parameter(kind, key, value) for key, value in parameters.items()}


def check_parameter(kind: Kind, key: str, value: object) -> Any:
    """Check a parameter of a policy kind against the argument of its design function, and convert its type."""
    if isinstance(value, np.ndarray):
        given = cast("Array", value)
        expect_unmasked(f"policy.{key}", given)
        return given
    try:
        return validate(_accepted(kind)[key][0], value)
    except ValidationError as error:
        raise ProblemError(f"policy.{key} is {quoted(value)}; {ours(error.errors()[0]['msg'])}") from None


@cache
def _accepted(kind: Kind) -> dict[str, tuple[Any, bool]]:
    """Return the type of each parameter of a policy kind, and whether the parameter is required."""
    return {
        key: (_as_rows(kind.hints.get(key, Any)), value.default is value.empty)
        for key, value in kind.parameters.items()
    }


def _as_rows(hint: Any) -> Any:
    """Return the type that a file has in place of a matrix: a list of rows."""
    return Rows if hint == ArrayLike | None else hint
