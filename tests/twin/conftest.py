"""Where nothing can be drawn the tests that look at pictures are skipped, and that is said."""

from __future__ import annotations

import pytest
from twin.crews import blind

LOOKING = ("test_vision", "test_calibration", "test_identification", "test_runs", "test_experiments")


@pytest.fixture(autouse=True)
def sight(request: pytest.FixtureRequest) -> None:
    """Skip what looks where there is nothing to be seen."""
    if request.module.__name__.split(".")[-1] in LOOKING and blind():
        pytest.skip(blind())
