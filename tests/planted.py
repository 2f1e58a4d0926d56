"""Plant defects in a copy of the library, and find out which tests of the next three days find each.

``python tests/planted.py [--day YYYY-MM-DD] [NAME ...]`` copies the tree for each defect, changes one line of it, and
runs what ``.ci/run`` runs: the quick tests, then the shortened full counts of at most three days, until one fails. Files
of tests whose imports are nearest to the defect run first, so that an answer comes within minutes; what a run finds does
not depend on the order. A defect that no test finds is printed, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path

from imports import ROOT, distances

DAYS = 3
KEPT = ("src", "tests", "docs", "examples", "benchmarks", ".ci", "pyproject.toml", "README.md", "CHANGELOG.md",
        "CONTRIBUTING.md", "CITATION.cff", "LICENSE", "THIRD_PARTY.md", ".gitignore", ".editorconfig")  # fmt: skip


@dataclass(frozen=True)
class Planted:
    """One changed piece of a file."""

    file: str
    right: str
    wrong: str


DEFECTS = {
    # numbers
    "the input noise between samples is left out": Planted(
        "lqg/regulation.py",
        "np.block([[source.W + X @ w @ X.T, X @ w @ U.T], [U @ w @ X.T, U @ w @ U.T]])",
        "np.block([[source.W + X @ w @ X.T, 0 * X @ w @ U.T], [0 * U @ w @ X.T, 0 * U @ w @ U.T]])",
    ),
    "the bound at a rate forgets that sends are free": Planted(
        "model/theory.py", "self.per_silence * (1 - rate), self.pull)", "0.9 * self.per_silence * (1 - rate), self.pull)"
    ),
    "a share of the cost is 2 % too large": Planted(
        "design/bounds.py", 'theta, 0.0, LARGEST_PARAMETER, closed=True) * cost', 'theta, 0.0, LARGEST_PARAMETER, closed=True) * 1.02 * cost'
    ),
    "a Gilbert–Elliott link is in the wrong state at first": Planted("model/bursts/gilbert_elliott.py", "", ""),
    "rates of change are limited from the command": Planted(
        "model/saturation.py", "before[i] + float(self.rate[i]))", "before[i] + 1.5 * float(self.rate[i]))"
    ),
    "copies of paths have the weight of their original": Planted("simulation/splitting.py", "", ""),
    "a budget counts one standard error less": Planted("study/tuning/goal.py", "found.value - self.budget,", "found.value - 1.02 * self.budget,"),
}
