"""How does a policy get onto a microcontroller? Its nodes are exported as C99, compiled and checked against the design.

The self-check exchanges datagrams between the nodes for 500 steps of a simulated loop, and compares every decision and
every bit of the input. It detects a gain that is wrong in its last digit.
"""

import subprocess
import tempfile
from pathlib import Path

import taciturn

problem = taciturn.load("two-mass")
with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    written = taciturn.export_c(problem, folder, name="two-mass")
    for node in written.nodes:
        print(f"{node.role}: {node.operations} operations per step, {node.constants} constants")

    def compare() -> subprocess.CompletedProcess[str]:
        """Compile the files of the folder and run the self-check."""
        subprocess.run(f"cc -std=c99 -O2 {folder}/*.c -o {folder}/selfcheck", shell=True, check=True)
        return subprocess.run([folder / "selfcheck"], capture_output=True, text=True, check=False)

    right = compare()
    print(right.stdout, end="")

    source = folder / "two_mass_controller.c"
    gain = next(word.rstrip(",") for word in source.read_text().split() if word.startswith("-0."))
    source.write_text(source.read_text().replace(gain, repr(float(gain) * (1 + 1e-15)), 1))
    wrong = compare()
    print(wrong.stdout, end="")

assert right.returncode == 0
assert "500 steps compared" in right.stdout
assert wrong.returncode == 1
