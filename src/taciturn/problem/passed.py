"""A problem that a process passes to the processes that it starts, if there is no problem file that they could read."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

from taciturn.problem import Problem

PASSED = "TACITURN_PASSED_PROBLEM"  # environment variable of the started processes: the file with the problem


def pass_problem(problem: Problem, folder: Path) -> dict[str, str]:
    """Write a problem to a private folder, and return the environment variable that makes a process read it."""
    path = folder / "problem.pickle"
    path.write_bytes(pickle.dumps(problem))
    return {PASSED: str(path)}


def passed_problem(file: str) -> Problem | None:
    """Return the problem in a file that the starting process has written, or None for any other file.

    Reading a pickle executes code, so a file is read only if the environment of this process names it.
    """
    if os.environ.get(PASSED) != file:
        return None
    found: Problem = pickle.loads(Path(file).read_bytes())
    return found
