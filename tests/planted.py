"""Plant defects in a copy of the library, and find out which tests of the next three days find each.

``python tests/planted.py [--day YYYY-MM-DD] [NAME ...]`` copies the tree for each defect, changes one piece of it, and
runs what ``.ci/run`` runs: the quick tests, then the shortened full counts of at most three days, until a test fails.
Files of tests whose imports are nearest to the defect run first, so that an answer comes within minutes; whether a run
finds a defect does not depend on the order. A defect that no test finds is printed, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import os
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
# it compares the text of the source with that of the defects, so it fails for every one
READS_SOURCE = "tests/test_selection.py::test_defects_can_be_planted"
KEPT = ("src", "tests", "docs", "examples", "benchmarks", ".ci", "pyproject.toml", "README.md", "CHANGELOG.md",
        "CONTRIBUTING.md", "CITATION.cff", "LICENSE", "THIRD_PARTY.md", ".gitignore", ".editorconfig")  # fmt: skip


@dataclass(frozen=True)
class Planted:
    """One changed piece of a file."""

    file: str
    right: str
    wrong: str


DEFECTS = {
    # of the sort that users found
    "the input that a disturbance needs does not move between samples": Planted(
        "lqg/discrete.py", "noise = np.vstack([-X, np.eye(q), -U])", "noise = np.vstack([-X, np.eye(q), 0 * U])"
    ),
    "a link that is beyond the table of keys has none": Planted(
        "../taciturn_export/core/taciturn_inbox.c", "TAC_FORGED : verdict;", "TAC_OK : verdict;"
    ),
    "start values have the order of a set": Planted(
        "base/given_controller.py",
        'for name in ("command", HELD, "input")',
        'for name in {"command", HELD, "input"}',
    ),
    "one link that is heard is enough for the watchdog": Planted(
        "nodes/node.py",
        "return tuple(link for link in self._heard_at if self._unheard or link in late)",
        "return tuple(link for link in self._heard_at if self._unheard or len(late) == len(self._heard_at))",
    ),
    "saved states are restored whatever they hold": Planted(
        "nodes/node.py", "if saved.get(_SEAL) != _digest(", "if saved.get(_SEAL) is None and None != _digest("
    ),
    # of designs
    "the bound at a rate counts nine tenths of what silence adds": Planted(
        "model/theory.py",
        "return self._with_silence(self.per_silence * (1 - rate))",
        "return self._with_silence(0.9 * self.per_silence * (1 - rate))",
    ),
    "a threshold that is a share of the cost is 2 % too large": Planted(
        "design/bounds.py", "LARGEST_PARAMETER, closed=True) * cost", "LARGEST_PARAMETER, closed=True) * cost * 1.02"
    ),
    "a link with bursts starts in the good state": Planted(
        "model/losses.py",
        "return np.array([1 - self.share_bad, self.share_bad])",
        "return np.array([1.0, 0.0])",
    ),
    "an input rises too fast": Planted(
        "model/saturation.py", "before[i] + float(self.rate[i]))", "before[i] + 1.01 * float(self.rate[i]))"
    ),
    "an estimate is not counted from the operating point": Planted(
        "model/policy.py", "found[ESTIMATE] = point.x", "found[ESTIMATE] = 0.99 * point.x"
    ),
    # of the engine
    "copies of paths are too heavy": Planted(
        "../taciturn_rare/splitting.py",
        "return np.power(float(COPIES), -self._level.astype(np.float64))",
        "return np.power(float(COPIES), -0.98 * self._level.astype(np.float64))",
    ),
    "a difference of the fast build is a sum": Planted(
        "program/llvm.py", 'if op.name == "sub" and first:', 'if op.name == "subtract" and first:'
    ),
    "printed C adds for subtract": Planted("program/c.py", '"sub": (REAL, "{0} - {1}")', '"sub": (REAL, "{0} + {1}")'),
    "a node rounds its products": Planted(
        "program/python.py", '"mul": "v{0} * v{1}"', '"mul": "v{0} * (1 + 2**-52) * v{1}"'
    ),
    # of estimates and studies
    "a budget may be missed by 1 %": Planted(
        "../taciturn_studies/goal.py", "return found.value - self.budget, ", "return found.value - 1.01 * self.budget, "
    ),
    "the window of a receiver admits duplicates": Planted(
        "nodes/inbox.py", "elif self.seen >> behind & 1:", "elif self.seen >> behind & 1 and behind < 900:"
    ),
    "replayed packets are admitted in C": Planted(
        "../taciturn_export/core/taciturn_inbox.c",
        "if (window->begun && epoch < window->epoch) {",
        "if (window->begun && epoch + 1U < window->epoch) {",
    ),
    "probabilities of the renewal equations lose a tail": Planted(
        "renewal/quadrature.py", "REACH = 8.0", "REACH = 3.0"
    ),
    "periodic control pays twice for noise between samples": Planted(
        "study/periodic.py", "unseen + noise_cost", "unseen + 2 * noise_cost"
    ),
    "intervals of periodic control forget the noise between samples": Planted(
        "lqg/periodic.py", "+ stretch.noise_cost", "+ 0.9 * stretch.noise_cost"
    ),
}


def plant(defect: Planted, folder: Path) -> None:
    """Change the one piece of the copied tree."""
    path = folder / "src" / "taciturn" / defect.file
    text = path.read_text(encoding="utf-8")
    assert text.count(defect.right) == 1, f"{defect.file} holds {defect.right!r} {text.count(defect.right)} times"
    path.write_text(text.replace(defect.right, defect.wrong), encoding="utf-8")


def nearest(defect: Planted) -> list[str]:
    """Return the files of tests, those whose imports are nearest to the defect first."""
    far = distances([ROOT / "src" / "taciturn" / defect.file])
    tests = sorted((ROOT / "tests").rglob("test_*.py"), key=lambda path: (far.get(path, 99), path))
    return [path.relative_to(ROOT).as_posix() for path in tests]


def found_by(defect: Planted, day: date) -> str | None:
    """Return the first run that fails, and its first failure; None if no run of the next days fails."""
    with tempfile.TemporaryDirectory(prefix="planted-") as name:
        folder = Path(name)
        for kept in KEPT:
            if (ROOT / kept).is_dir():
                shutil.copytree(ROOT / kept, folder / kept, ignore=shutil.ignore_patterns("__pycache__", "_build"))
            else:
                shutil.copy(ROOT / kept, folder / kept)
        plant(defect, folder)
        shortened = [["-m", "evidence", "--shortened", "--day", str(day + timedelta(k))] for k in range(DAYS)]
        for run, options in zip(("quick", *range(1, DAYS + 1)), ([], *shortened), strict=True):
            command = [sys.executable, "-m", "pytest", "-x", "-n", "2", "--dist", "load", "--maxschedchunk", "4",
                       "--deselect", READS_SOURCE]  # fmt: skip
            done = subprocess.run(
                [*command, *options, *nearest(defect)], cwd=folder, capture_output=True, text=True, check=False,
                env={**os.environ, "PYTHONPATH": str(folder / "src")},
            )  # fmt: skip
            failures = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
            if failures:
                name = failures[0].split(" - ")[0].removeprefix("FAILED ").removeprefix("ERROR ")
                return f"{'the quick tests' if run == 'quick' else f'the full counts of day {run}'}: {name}"
            assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return None


def main() -> int:
    """Plant the defects that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="beginnings of the names of defects; default: all")
    parser.add_argument("--day", type=date.fromisoformat, default=date.today())
    given = parser.parse_args()
    chosen = [name for name in DEFECTS if not given.names or name.startswith(tuple(given.names))]
    missed = 0
    for name in chosen:
        began = time.monotonic()
        where = found_by(DEFECTS[name], given.day)
        missed += where is None
        print(f"{name}\n    {where or 'NOT FOUND'} ({time.monotonic() - began:.0f} s)", flush=True)
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
