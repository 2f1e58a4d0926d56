"""What the tests of the twins share; where nothing can be drawn those that look are skipped, and that is said."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from twin.crews import blind
from twin.feeds import ROVER

from taciturn_twins.page import Page

LOOKING = ("test_vision", "test_calibration", "test_identification", "test_runs", "test_experiments")


@pytest.fixture(autouse=True)
def sight(request: pytest.FixtureRequest) -> None:
    """Skip what looks where there is nothing to be seen."""
    if request.module.__name__.split(".")[-1] in LOOKING and blind():
        pytest.skip(blind())


@pytest.fixture
def page() -> Iterator[Page]:
    """Return a page of a round that has begun, on the loopback and without a token."""
    with Page(("127.0.0.1", 0)) as page:
        page.begin(ROVER)
        yield page
