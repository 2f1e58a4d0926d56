"""The table of recovery times: it shows the measured times, and a loop recovers again."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def test_the_table_of_recovery_times_has_every_fault() -> None:
    """Those that the benchmark measures; every run of this version recovers, and the page shows them."""
    script = runpy.run_path(str(ROOT / "benchmarks" / "recovery.py"))
    document = json.loads((ROOT / "docs" / "recovery.json").read_text(encoding="utf-8"))
    assert "benchmark_tables.recovery()" in (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
    assert [row["fault"] for row in document["rows"]] == [*script["FAULTS"], *script["RATES"]]
    assert all(None not in row["after"] and len(row["after"]) > 1 for row in document["rows"])


@pytest.mark.evidence
@pytest.mark.parametrize("fault", ["SIGSTOP of the controller, 10 s", "the plant's step number jumps by +100"])
def test_a_loop_recovers_in_real_time(fault: str) -> None:
    """Within the minute after which the benchmark gives up, however busy this machine is."""
    script = runpy.run_path(str(ROOT / "benchmarks" / "recovery.py"))
    assert script["in_process"](fault, 0.05, 0, ROOT / "src") is not None
