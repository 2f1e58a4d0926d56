"""Every documentation page, README block, example and docstring example runs."""

from __future__ import annotations

import doctest
import importlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from twin.crews import blind

ROOT = Path(__file__).parent.parent
PAGES = sorted(path for path in (ROOT / "docs").glob("*.md") if "```{code-cell}" in path.read_text(encoding="utf-8"))
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
    for data in (ROOT / "docs").glob("*.json"):
        shutil.copy(data, tmp_path)
    monkeypatch.chdir(tmp_path)
    assert run_blocks(path.read_text(encoding="utf-8"), r"```\{code-cell\} python\n(.*?)```", path.name) > 0


def test_the_index_lists_every_page() -> None:
    """Once; a page that stands in no table of contents is not found."""
    listed = re.search(
        r"```\{toctree\}\n:maxdepth: 1\n\n(.*?)```\n", (ROOT / "docs" / "index.md").read_text(), re.DOTALL
    )
    assert listed is not None
    assert sorted([*listed[1].split(), "index"]) == sorted(path.stem for path in (ROOT / "docs").glob("*.md"))


def typed(text: str) -> list[list[str]]:
    """Return the words behind each ``taciturn`` that the shell blocks of a page type."""
    blocks = re.findall(r"```(?:sh|console)\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    found = [re.search(r"(?:^|[ /])taciturn (.*?)(?: &.*)?$", line) for line in lines]
    return [shlex.split(match[1], comments=True) for match in found if match]


def test_the_command_line_understands_what_the_pages_type() -> None:
    """Commands, options and their values are parsed, and nothing is run."""
    from taciturn.cli import app

    commands = typer.main.get_command(app).commands
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    lines = [words for path in pages for words in typed(path.read_text(encoding="utf-8"))]
    assert len(lines) > 30
    for words in lines:
        if words != ["--version"]:
            assert words[0] in commands, words
            assert commands[words[0]].make_context(words[0], words[1:]).args == [], words
    with pytest.raises(typer.TyperException, match="--rte"):
        commands["tune"].make_context("tune", ["two-mass", "--rte", "0.5"])


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
