"""Every documentation page, README block, example and docstring example runs."""

from __future__ import annotations

import doctest
import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from twin.crews import blind

ROOT = Path(__file__).parent.parent
CELL = r"```\{code-cell\} python\n(?::[^\n]*\n)*(.*?)```"
PAGES = sorted(path for path in (ROOT / "docs").glob("*.md") if "```{code-cell}" in path.read_text(encoding="utf-8"))
PAGES.remove(ROOT / "docs" / "gallery.md")  # computes all chapters and examples: it is executed when the site is built
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
MODULES = sorted(
    ".".join(path.relative_to(ROOT / "src").with_suffix("").parts)
    for path in (ROOT / "src" / "taciturn").rglob("*.py")
    if ">>>" in path.read_text(encoding="utf-8")
)


def run_blocks(text: str, pattern: str, name: str) -> int:
    """Run the blocks of a page in one namespace; return how many there were."""
    blocks = re.findall(pattern, text, flags=re.DOTALL)
    namespace: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, name, "exec"), namespace)
    return len(blocks)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_every_page_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cells of a page run in order beside the data they show, and what they assert holds."""
    for data in (path, *(ROOT / "docs").glob("*.json")):
        shutil.copy(data, tmp_path)
    monkeypatch.chdir(tmp_path)
    assert run_blocks(path.read_text(encoding="utf-8"), CELL, path.name) > 0


def test_the_index_lists_every_page() -> None:
    """Once; a page that stands in no table of contents is not found."""
    docs = ROOT / "docs"
    text = (docs / "index.md").read_text(encoding="utf-8")
    trees = re.findall(r"```\{toctree\}\n(?::[^\n]*\n)*\n(.*?)```\n", text, re.DOTALL)
    pages = [path for path in docs.rglob("*") if path.suffix in (".md", ".ipynb") and "_build" not in path.parts]
    names = [path.relative_to(docs).with_suffix("").as_posix() for path in pages]
    assert sorted([name for tree in trees for name in tree.split()] + ["index"]) == sorted(names)


def test_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The Python of the README runs."""
    monkeypatch.chdir(tmp_path)
    assert run_blocks((ROOT / "README.md").read_text(encoding="utf-8"), r"```python\n(.*?)```", "README.md") > 0


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_runs(path: Path, tmp_path: Path) -> None:
    """An example is short, ends in an assert, and runs as a user runs it."""
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    assert text.rstrip().splitlines()[-1].startswith("assert ")
    if "taciturn.twin" in text and blind():
        pytest.skip(blind())
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, path], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", MODULES)
def test_every_docstring_example_holds(name: str) -> None:
    """What a docstring shows is what happens."""
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0
