"""Which of the full counts a shortened run runs, and in which order.

First those whose turn it is: each test has its turn every fourth day, by a hash of its name, so nothing is stored. Then
those that a change can reach, by what their files import: the change since the last commit whose full counts all ran,
which ``.ci/fully-checked`` names; everything, if git does not know this commit. Tests whose files import a changed file
themselves come before those that reach it by way of others.
"""

from __future__ import annotations

import subprocess
from collections.abc import Collection, Iterable, Mapping, Sequence
from datetime import date
from pathlib import Path
from zlib import crc32

from imports import ROOT, distances

TURNS = 4
CHECKED = ROOT / ".ci" / "fully-checked"


def in_turn(name: str, day: date) -> bool:
    """Tell whether it is the turn of a test on a day."""
    return (crc32(name.encode()) + day.toordinal()) % TURNS == 0


def changed_files() -> list[Path] | None:
    """Return what changed since the commit whose full counts ran, uncommitted changes included; None if unknown."""
    since = CHECKED.read_text(encoding="utf-8").split()[0]
    command = ["git", "diff", "--name-only", "--no-renames", since]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return [ROOT / name for name in done.stdout.splitlines()] if done.returncode == 0 else None


def reach(files: Iterable[Path], changed: Iterable[Path] | None) -> Mapping[Path, int]:
    """Return how many imports lie between each file of tests and the nearest changed file; none if it reaches none."""
    if changed is None:
        return dict.fromkeys(files, 0)
    far = distances(changed)
    return {path: far[path] for path in set(files) & far.keys()}


def order(
    tests: Sequence[tuple[str, Path]], day: date, changed: Iterable[Path] | None, daily: Collection[str] = ()
) -> list[int]:
    """Return the positions of the tests that run, in their order, from names and files; those of each day are first."""
    near = reach({path for _, path in tests}, changed)
    turns = [-2 if name in daily else -1 if in_turn(name, day) else None for name, _ in tests]
    ranks = [near.get(path) if turn is None else turn for turn, (_, path) in zip(turns, tests, strict=True)]
    chosen = [(rank, position) for position, rank in enumerate(ranks) if rank is not None]
    return [position for _, position in sorted(chosen)]
