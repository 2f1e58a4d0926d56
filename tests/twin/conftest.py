"""Where nothing can be drawn the tests that look at pictures are skipped, and that is said."""

from __future__ import annotations

from functools import cache

import pytest

from taciturn.errors import ProblemError
from taciturn.twin.body import Body
from taciturn.twin.camera import Camera
from taciturn.twin.catalogue import ROBOTS

LOOKING = ("test_vision", "test_calibration", "test_identification", "test_runs", "test_experiments")


@cache
def blind() -> str:
    """Return why nothing can be drawn here, or nothing."""
    try:
        camera = Camera(ROBOTS["rover"])
        camera.take(Body(ROBOTS["rover"]).snapshot)
        camera.close()
    except ProblemError as error:
        return str(error)
    return ""


@pytest.fixture(autouse=True)
def sight(request: pytest.FixtureRequest) -> None:
    """Skip what looks where there is nothing to be seen."""
    if request.module.__name__.split(".")[-1] in LOOKING and blind():
        pytest.skip(f"NOT SHOWN: what cameras of robots see; {blind()}")
