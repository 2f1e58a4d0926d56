"""Nothing that is signed depends on the order of a hash: each process of a loop must compute the same fingerprint."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SIGNED = Path(__file__).parents[1] / "signed.py"


def digests(seed: int, *options: str) -> dict[str, dict[str, str]]:
    """Return what a process with this seed of its hashes computes."""
    environment = os.environ | {"PYTHONHASHSEED": str(seed)}
    done = subprocess.run(
        [sys.executable, str(SIGNED), *options], env=environment, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


@pytest.mark.parametrize("options", [(), pytest.param(("--all",), marks=pytest.mark.evidence)], ids=["few", "all"])
def test_every_process_computes_the_same_digests(options: tuple[str, ...]) -> None:
    """Under several hash seeds: problems, fingerprints, descriptions of packets, programs, nodes in C, and units.

    With ``--all`` of each kind and of the built-in problems.
    """
    first, *others = (digests(seed, *options) for seed in range(4 if options else 2))
    for name, found in first.items():
        assert [other[name] for other in others] == [found] * len(others), name
    assert len(first["pid"]) == len(first["tank"]) == 6
