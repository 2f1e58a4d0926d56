"""Every documentation page, notebook, README block, example and docstring example runs."""

from __future__ import annotations

import doctest
import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import pytest
from twin.crews import blind

from taciturn._figure import Panel, Series, draw

ROOT = Path(__file__).parent.parent
PAGES = sorted(path for path in (ROOT / "docs").glob("*.md") if "```{code-cell}" in path.read_text(encoding="utf-8"))
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
MODULES = sorted(
    ".".join(path.relative_to(ROOT / "src").with_suffix("").parts)
    for path in (ROOT / "src" / "taciturn").rglob("*.py")
    if ">>>" in path.read_text(encoding="utf-8")
)


def run_blocks(blocks: list[str], name: str) -> int:
    """Run the blocks of a page in one namespace; return how many there were."""
    namespace: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, name, "exec"), namespace)
    return len(blocks)


def code_of(notebook: Path) -> list[dict[str, Any]]:
    """Return the code cells of a notebook."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_every_page_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cells of a page run in order beside the data they show, and what they assert holds."""
    for data in (ROOT / "docs").glob("*.json"):
        shutil.copy(data, tmp_path)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```\{code-cell\} python\n(.*?)```", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert run_blocks(blocks, path.name) > 0


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The code cells of a notebook run in order without a Jupyter, and what they assert holds."""
    pyplot = importlib.import_module("matplotlib.pyplot")
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    try:
        assert run_blocks(["".join(cell["source"]) for cell in code_of(path)], path.name) > 0
    finally:
        pyplot.close("all")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_notebook_stores_what_it_put_out(path: Path) -> None:
    """What a reader sees is of this version: outputs are made when the site is built."""
    assert [cell for cell in code_of(path) if cell["outputs"] or cell["execution_count"] is not None] == []


def test_a_picture_displays_itself_where_no_pyplot_is_used() -> None:
    """A cell that ends in a picture of the library shows it, also on the site."""
    picture: Any = draw([Panel([Series([0.0, 1.0], [0.0, 1.0])])])
    assert picture._repr_png_().startswith(b"\x89PNG")


def test_the_index_lists_every_page() -> None:
    """Once; a page that stands in no table of contents is not found."""
    listed = re.search(
        r"```\{toctree\}\n:maxdepth: 1\n\n(.*?)```\n", (ROOT / "docs" / "index.md").read_text(), re.DOTALL
    )
    assert listed is not None
    docs = ROOT / "docs"
    pages = [path.relative_to(docs).with_suffix("").as_posix() for path in (*docs.glob("*.md"), *NOTEBOOKS)]
    assert sorted([*listed[1].split(), "index"]) == sorted(pages)


def test_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The Python of the README runs."""
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    assert run_blocks(blocks, "README.md") > 0


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


def test_the_sources_that_examples_name_are_known() -> None:
    """A parameter's source is a key of docs/sources.bib."""
    keys = re.findall(r"^@\w+\{(\w+),", (ROOT / "docs" / "sources.bib").read_text(encoding="utf-8"), re.MULTILINE)
    named = {
        key for path in EXAMPLES for key in re.findall(r"\b[a-z]+(?:19|20)\d\d\b", path.read_text(encoding="utf-8"))
    }
    assert len(named) > 5
    assert named <= set(keys)


@pytest.mark.parametrize("name", MODULES)
def test_every_docstring_example_holds(name: str) -> None:
    """What a docstring shows is what happens."""
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0
