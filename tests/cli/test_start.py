"""A command starts with what it needs and nothing else."""

from __future__ import annotations

import subprocess
import sys

import pytest

NEVER = {"scipy", "numpy.ma", "matplotlib", "xarray", "h5py", "pandas", "cvxpy", "rich", "multiprocessing"}
COMMANDS = {
    "--help": NEVER | {"numpy", "pydantic", "llvmlite"},
    "evaluate two-mass-lqg --steps 20000": NEVER,  # its Riccati equations need no scipy
}
SAYS = {
    "--help": ("\n  evaluate", "\n  tradeoff", "\n  reproduce"),
    "evaluate two-mass-lqg --steps 20000": ("\nthis policy",),
}


@pytest.mark.parametrize("typed", COMMANDS)
def test_a_command_imports_nothing_heavy_that_it_does_not_need(typed: str) -> None:
    """As a process: what was imported by the time it ends."""
    code = (
        f"import sys\nfrom taciturn.cli import main\nsys.argv = ['taciturn', *{typed.split()!r}]\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert end.code == 0\n"
        f"print('heavy:', sorted({COMMANDS[typed]!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=False)
    assert done.stdout.splitlines()[-1:] == ["heavy: []"], done.stderr
    assert all(words in done.stdout for words in SAYS[typed])
