"""Where the tests cannot run: without what POSIX alone has, under a locale of ASCII, in folders with any letters.

A process finds ``elsewhere/sitecustomize.py``, as do those that it starts, and loses what Windows lacks.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import taciturn

HERE = Path(__file__).parent
SOURCE = Path(taciturn.__file__).parent
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A problem file in a folder whose name has spaces and letters beyond ASCII."""
    folder = tmp_path / "Pläne für θ"
    folder.mkdir()
    text = (SOURCE / "problems" / "two-mass.toml").read_text(encoding="utf-8")
    (folder / "two masses.toml").write_text(f"# θ\n{text}", encoding="utf-8")
    return folder / "two masses.toml"


def run(file: Path, what: str) -> str:
    """Run a part of ``elsewhere/everything.py``, and return what it prints."""
    environment = {**os.environ, **ASCII, "PYTHONPATH": str(HERE / "elsewhere"), "MPLBACKEND": "agg"}
    environment["XDG_CACHE_HOME"] = str(file.with_name("kept code"))
    command = [sys.executable, "-X", "warn_default_encoding", HERE / "elsewhere" / "everything.py", what, file]
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    return done.stdout.decode(errors="replace")


@pytest.mark.evidence
def test_the_package_runs_without_what_windows_lacks(file: Path) -> None:
    """Every module is imported, a cost is measured, and nodes in threads have the costs of nodes without sockets."""
    said = run(file, "begin")
    there = [path for path in SOURCE.rglob("*.py") if (path.parent / "__init__.py").exists()]
    mains = [path for path in there if path.name == "__main__.py"]
    assert f"modules {len(there) - len(mains) - 1}\n" in said  # but for the package itself
    assert re.search(r"cost 0\.7\d+\n", said)
    assert [path.suffix for path in (file.with_name("kept code") / "taciturn").iterdir()] != []


@pytest.mark.evidence
def test_sweeps_pictures_and_exports_work_without_what_windows_lacks(file: Path) -> None:
    """Two spawned workers find what one finds; what is written lies in folders with any letters."""
    assert "tradeoff 2\n" in run(file, "go on")
    for name in ("runs of 1", "runs of 2", "the sweep.nc", "the nodes.svg", "for C", "the unit.fmu"):
        assert file.with_name(name).exists(), name


def test_the_text_of_processes_has_an_encoding() -> None:
    """What ruff does not look for (PLW1514 looks for files): ``text=True`` follows the locale."""
    there = re.compile(r"\b(text|universal_newlines)=True")
    assert there.search("run(command, text=True)")
    assert [path for path in SOURCE.rglob("*.py") if there.search(path.read_text(encoding="utf-8"))] == []
