"""What `taciturn bench` measures is there; nothing is asserted of how fast it is."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from taciturn.errors import ProblemError
from taciturn.program import machine
from taciturn_bench import bench

RUN = """
import sys, taciturn
found = taciturn.evaluate(taciturn.load("two-mass-lqg"), steps=int(float(sys.argv[1])))
lines = open("/proc/self/status").read().splitlines()
print(found.steps, next(line.split()[1] for line in lines if line.startswith("VmHWM")))
"""


@pytest.mark.evidence
def test_the_main_ratios_are_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one JSON document, and for people, from a tenth of the usual steps."""
    monkeypatch.setattr(bench, "TICKS", bench.TICKS // 10)
    told: list[float] = []
    found = bench.bench(3, told.append)
    document = json.loads(json.dumps(found.document()))
    assert set(document) == {"machine", "steps_per_second", "ratios", "compile_seconds", "variance_ratios"}
    assert {"full_over_numpy", "innovations_over_numpy", "float32_over_float64"} <= set(document["ratios"])
    numbers = [value for key, part in document.items() if key != "machine" for value in part.values()]
    assert all(value > 0 for value in numbers)
    assert document["variance_ratios"]["completed_squares"] > 1000
    assert document["machine"]["vectors"] in ("avx512", "avx2", "baseline")
    assert told == sorted(told)
    assert told[-1] == 1
    assert "innovations over numpy" in str(found)


def test_the_contestants_run_the_same_law() -> None:
    """Their rates of sending agree to the first steps and standard errors."""
    rates = {name: run(1)[1] for name, run in bench.contestants(bench.masses()).items()}
    assert max(rates.values()) - min(rates.values()) < 0.01
    assert min(rates.values()) > 0.5


def test_without_an_engine_there_is_nothing_to_measure(monkeypatch: pytest.MonkeyPatch) -> None:
    """It says so."""
    monkeypatch.setattr(machine, "available", lambda: False)
    with pytest.raises(ProblemError, match="llvmlite is not installed"):
        bench.bench()


@pytest.mark.evidence
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the most memory held from /proc")
def test_memory_does_not_grow_with_the_steps() -> None:
    """The peak at 1e9 steps is within a tenth of that at 1e7."""
    peaks: list[float] = []
    for steps in ("1e7", "1e9"):
        command = [sys.executable, "-c", RUN, steps]
        run, peak = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
        assert int(run) > 0.98 * float(steps)
        peaks.append(float(peak))
    assert peaks[1] < 1.1 * peaks[0]
