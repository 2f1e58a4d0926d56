"""The lower bounds in pyproject.toml, from which CI takes the lowest versions."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def bounds() -> ModuleType:
    """The script of CI, as a module."""
    spec = importlib.util.spec_from_file_location("bounds", ROOT / ".ci" / "bounds.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_requirement_has_one_lower_bound_and_a_package_the_same_everywhere(bounds: ModuleType) -> None:
    """Of the core and of all extras; otherwise this is refused."""
    every = bounds.requirements()
    lowest = bounds.lowest(list(every), every)
    assert {bounds.bound(text) for texts in every.values() for text in texts} == set(lowest.items())


def test_the_tests_need_what_the_extras_of_users_need(bounds: ModuleType) -> None:
    """So that CI installs every extra together with the core; the notebooks are those of a test that CI runs apart."""
    every = bounds.requirements()
    for extra in set(every) - {"core", "test", "bench", "docs", "dev", "notebooks"}:
        assert set(every[extra]) <= set(every["test"]), extra


def test_the_package_is_built_with_what_the_tests_build_it_with(bounds: ModuleType) -> None:
    """One bound of hatchling."""
    build = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["build-system"]["requires"]
    assert set(build) <= set(bounds.requirements()["test"])


def test_the_constraints_are_the_bounds_of_pyproject(bounds: ModuleType) -> None:
    """A line for each requirement of the groups that are named."""
    command = [sys.executable, str(ROOT / ".ci" / "bounds.py"), "core", "certify"]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    every = bounds.requirements()
    assert printed.splitlines() == [text.replace(">=", "==") for text in every["core"] + every["certify"]]


@pytest.mark.parametrize("text", ["numpy", "numpy>2", "numpy>=2,<3", "numpy==2.1", "numpy>=2; python_version>'3.11'"])
def test_a_requirement_without_exactly_one_lower_bound_is_refused(bounds: ModuleType, text: str) -> None:
    """Each of these would not be among the constraints, or not as it is meant."""
    with pytest.raises(ValueError, match="expected a name and one lower bound"):
        bounds.bound(text)


def test_two_lower_bounds_of_a_package_and_unknown_groups_are_refused(bounds: ModuleType) -> None:
    """Pip would take the higher one, and the lower one would never be shown."""
    groups = {"core": ["numpy>=2.1"], "test": ["numpy>=2.2"]}
    with pytest.raises(ValueError, match=r"numpy has the lower bounds 2\.1 and 2\.2"):
        bounds.lowest(["core", "test"], groups)
    with pytest.raises(ValueError, match="group 'docs'; expected one of core, test"):
        bounds.lowest(["docs"], groups)
