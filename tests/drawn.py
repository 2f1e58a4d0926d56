"""Laws over what hypothesis draws: a few examples in the quick suite, the full count as evidence.

The full count of examples is the same in every run. A shortened run checks at most 60 of them and at most 60 more,
whose seed is the day (``--day YYYY-MM-DD`` repeats those of a day). Where an example of a day fails, the check runs
again with other draws and 16 times the steps (``measured``), and only its failure there counts.
"""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import hypothesis
import pytest
from counts import RUN, few
from hypothesis import HealthCheck, given, settings
from hypothesis.strategies import SearchStrategy
from measured import longer

from taciturn.errors import UnstableError

Law = Callable[..., None]
FIXED = DATED = 60  # examples of a shortened run
SLOW = [HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large]


def over(check: Law, count: int, **drawn: SearchStrategy) -> None:
    """Run a check on so many drawn examples, with its arguments by name; ``count`` is the full one of the evidence.

    Quick tests draw fewer than 30, which a shortened run does not change.
    """
    examples = min(count, FIXED) if RUN.shortened else count
    fixed = settings(max_examples=examples, deadline=None, suppress_health_check=SLOW)
    fixed(given(**drawn)(without_result(check)))()
    if RUN.shortened:
        of_day = settings(fixed, max_examples=min(count, DATED), derandomize=False, database=None)
        hypothesis.seed(RUN.day.toordinal())(of_day(given(**drawn)(repeated(without_result(check)))))()


@contextmanager
def left_out(words: str) -> Iterator[None]:
    """Leave out an example that is refused in these words; any other refusal remains a failure."""
    try:
        yield
    except UnstableError as refused:
        hypothesis.assume(words not in str(refused))
        raise


def without_result(check: Law) -> Law:
    """Return the check without its result, which hypothesis takes for a mistake."""

    @functools.wraps(check)
    def called(*known: object, **values: object) -> None:
        check(*known, **values)

    return called


def repeated(check: Law) -> Law:
    """Return the check that a failure repeats with other draws and more steps."""

    @functools.wraps(check)
    def twice(*known: object, **values: object) -> None:
        try:
            check(*known, **values)
        except AssertionError as error:
            with longer():
                try:
                    check(*known, **values)
                except AssertionError as again:
                    again.add_note(f"drawn by --day {RUN.day}; it fails with other draws and 16 times the steps too")
                    raise
            warnings.warn(f"by chance, with --day {RUN.day}: {error}", pytest.PytestWarning, stacklevel=2)

    twice.__signature__ = inspect.signature(check)  # type: ignore[attr-defined]
    return twice


def law(quick: int, full: int, **drawn: SearchStrategy) -> Callable[[Law], Law]:
    """Make a test of a law: its arguments are drawn so many times, or given by fixtures and parameters."""

    def tested(check: Law) -> Law:
        @pytest.mark.parametrize("examples", [quick, pytest.param(full, marks=pytest.mark.evidence)])
        def test(examples: int, **known: object) -> None:
            @functools.wraps(check)
            def once(**values: object) -> None:
                check(**known, **values)

            once.__signature__ = inspect.Signature(own)  # type: ignore[attr-defined]
            over(once, examples, **drawn)

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
