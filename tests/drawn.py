"""Laws over what hypothesis draws: a few examples in the quick suite, the full count as evidence."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any

import pytest
from counts import few
from hypothesis import HealthCheck, given, settings
from hypothesis.strategies import SearchStrategy

Law = Callable[..., None]


def law(quick: int, full: int, **drawn: SearchStrategy) -> Callable[[Law], Law]:
    """Make a test of a law: its arguments are drawn so many times, or given by fixtures and parameters."""

    def tested(check: Law) -> Law:
        @pytest.mark.parametrize("examples", [quick, pytest.param(full, marks=pytest.mark.evidence)])
        def test(examples: int, **known: object) -> None:
            @functools.wraps(check)
            def once(**values: object) -> None:
                check(**known, **values)

            once.__signature__ = inspect.Signature(own)  # type: ignore[attr-defined]
            count = settings(max_examples=examples, deadline=None, suppress_health_check=[HealthCheck.too_slow])
            count(given(**drawn)(once))()

        arguments = inspect.signature(check).parameters.values()
        own = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in arguments if one.name in drawn]
        others = [one for one in arguments if one.name not in drawn]
        first = inspect.Parameter("examples", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        marks = [*test.pytestmark, *getattr(check, "pytestmark", [])]  # type: ignore[attr-defined]
        test = functools.wraps(check)(test)
        del test.__wrapped__  # type: ignore[attr-defined]
        test.pytestmark, test.__signature__ = marks, inspect.Signature([first, *others])  # type: ignore[attr-defined]
        return test

    return tested


def rows(values: Iterable[tuple[Any, ...]], quick: int = 2, start: int = 0) -> list[Any]:
    """Return what ``few`` does, for cases of several parameters each."""
    chosen = few(values, quick, start)
    return [case if isinstance(case, tuple) and not hasattr(case, "marks") else spread(case) for case in chosen]


def spread(case: Any) -> Any:
    """Return a case that is evidence, its one tuple spread over the parameters."""
    return pytest.param(*case.values[0], marks=case.marks)
