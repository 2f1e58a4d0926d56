"""The tasks of the example that never wait compute what nodes in Python compute, and share queues alone."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from export.devices import STRICT, needs_compiler
from export.test_folders import two_mass, write

import taciturn
from taciturn_export.folder import print_folder

EXAMPLE = Path(__file__).parent.parent.parent / "docs" / "tasks.c"
STEPS = 200


def run(folder: Path, *options: str) -> list[str]:
    """Return the lines that the example prints."""
    write(folder, print_folder(two_mass(), "two_mass", rows=1))
    sources = [str(EXAMPLE), *map(str, folder.glob("taciturn_*.c")), *map(str, folder.glob("two_mass_*.c"))]
    command = [needs_compiler(), *STRICT, *options, f"-I{folder}", *sources, "-lpthread", "-o", str(folder / "loop")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0 and "tsan" in done.stderr:
        pytest.skip("NOT SHOWN: data races of the example; the compiler has no thread sanitizer")
    assert done.returncode == 0, done.stderr
    found = subprocess.run([str(folder / "loop")], capture_output=True, text=True, check=False)
    assert (found.returncode, found.stderr) == (0, "")
    return found.stdout.splitlines()


@pytest.mark.evidence
def test_tasks_that_never_wait_apply_the_inputs_of_the_nodes(tmp_path: Path) -> None:
    """Measurements by ``tac_encode`` and ``tac_decode``: every input has its bits, and no packet is lost."""
    *inputs, last = run(tmp_path)
    nodes, sent = taciturn.Nodes(two_mass().policy), 0
    for tick, told in enumerate(inputs):
        y = [(tick * 7919 + i * 104729) % 2001 / 1000.0 - 1.0 for i in range(2)]
        assert float(told) == nodes.step(y)[0]
        sent += sum(nodes.sent.values())
    assert last == f"{sent} of {STEPS} packets sent, 0 dropped"
    assert 0 < sent < STEPS == len(inputs)


@pytest.mark.evidence
def test_tasks_race_for_nothing(tmp_path: Path) -> None:
    """A checker of threads finds no data that two of them use without the lock."""
    assert run(tmp_path, "-fsanitize=thread", "-g")[-1].endswith(" 0 dropped")
