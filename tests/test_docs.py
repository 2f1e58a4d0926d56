"""Short pages, README blocks, examples and docstring examples run; the site's build runs the long pages."""

from __future__ import annotations

import doctest
import importlib
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
import pytest
import typer
from twin.crews import blind

ROOT = Path(__file__).parent.parent
CELL = r"```\{code-cell\} python\n(?::[^\n]*\n)*(.*?)```"
PAGES = sorted(path for path in (ROOT / "docs").glob("*.md") if "```{code-cell}" in path.read_text(encoding="utf-8"))
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
PAGES.remove(ROOT / "docs" / "gallery.md")  # computes all chapters and examples: it is executed when the site is built
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
DRAWN = {path for path in EXAMPLES if "savefig(" in path.read_text(encoding="utf-8")}  # the site's gallery runs them
LONG = {  # examples that take more than two seconds in reduced counts, and modules above one
    "a_controller_in_c",
    "a_loop_over_udp_that_loses_packets",
    "a_robot_tracked_by_a_camera",
    "how_late_may_the_camera_of_a_drone_be",
    "how_many_loops_share_a_radio",
    "taciturn_certify.certify",
    "taciturn_channel.share",
    "taciturn_studies.compare",
    "taciturn_export.export",
    "taciturn_sweep.sweep",
    "taciturn_studies.tune",
    "taciturn_twins.calibration",
    "which_policy_costs_least_at_half_the_traffic",
    "will_it_settle_whatever_the_spring",
}
BY_THE_SITE = {  # pages and notebooks that take more than two seconds: the site executes them, with a cache
    "certificates",
    "channels",
    "choose-a-policy",
    "command-line",
    "comparison",
    "consistency",
    "constraints",
    "devices",
    "first-hour",
    "import-a-model",
    "keep-your-pid",
    "late-networks",
    "network",
    "operations",
    "over-a-lossy-network",
    "own-policy",
    "remote-sensing",
    "scheduling",
    "set-points",
    "several-nodes",
    "sweeps",
    "your-first-policy",
}
MODULES = sorted(
    ".".join(path.relative_to(ROOT / "src").with_suffix("").parts)
    for path in (ROOT / "src").rglob("*.py")
    if ">>>" in path.read_text(encoding="utf-8")
)


REDUCED = {
    "a_loop_over_udp_that_loses_packets": {"range(2)": "range(1)"},
    "how_many_loops_share_a_radio": {"RADIO, MORE = 10, 1.2": "RADIO, MORE = 4, 1.2"},
    "lossy-links": {"steps=20_000_000": "steps=2_000_000", "steps=10_000_000": "steps=1_000_000"},
}
"""Counts that the quick suite replaces in pages and examples. The site is built with those that they show."""


def quick(pages: Iterable[Path]) -> list[Path]:
    """Return the pages that tests execute; the site executes all, so the long ones run there alone."""
    return [path for path in pages if path.stem not in BY_THE_SITE]


def in_time(cases: Iterable[Path | str]) -> list[Any]:
    """Return examples or modules as parameters, of which the quick suite leaves out the long ones."""
    names = [(case, case.stem if isinstance(case, Path) else case) for case in cases]
    return [pytest.param(case, marks=[pytest.mark.evidence] * (name in LONG)) for case, name in names]


def reduced(name: str, text: str) -> str:
    """Return the text of a page or an example in reduced counts."""
    for shown, fewer in REDUCED.get(name, {}).items():
        assert shown in text, f"{name} no longer holds {shown!r}"
        text = text.replace(shown, fewer)
    return text


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


@pytest.mark.parametrize("path", quick(PAGES), ids=lambda path: path.stem)
def test_every_page_runs(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The cells of a page run in order next to the data they show, in reduced counts, and what they assert holds."""
    for data in (path, *(one for kind in ("json", "c", "py", "toml") for one in (ROOT / "docs").glob(f"*.{kind}"))):
        shutil.copy(data, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    text = reduced(path.stem, path.read_text(encoding="utf-8"))
    assert run_blocks(re.findall(CELL, text, flags=re.DOTALL), path.name) > 0
    reasons = re.findall(r"^skipped: (.*)$", capsys.readouterr().out, flags=re.MULTILINE)
    if reasons:
        pytest.skip(f"NOT SHOWN: a part of the page {path.stem}; {reasons[0]}")


@pytest.mark.parametrize("path", quick(NOTEBOOKS), ids=lambda path: path.stem)
def test_every_notebook_runs_and_prints_the_stored_lines(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its code cells run in order, without Jupyter, and their assertions hold. Digits may depend on the processor."""
    cells = code_of(path)
    stored = [
        line for cell in cells for one in cell["outputs"] if one["output_type"] == "stream" for line in one["text"]
    ]
    pyplot = importlib.import_module("matplotlib.pyplot")
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    try:
        assert run_blocks(["".join(cell["source"]) for cell in cells], path.name) > 0
    finally:
        pyplot.close("all")
    printed, shown = (re.sub(r"[\d.]+(?:e[-+]\d+)?", "0", text) for text in (capsys.readouterr().out, "".join(stored)))
    assert printed == shown, "run docs/notebooks/store_outputs.py"


def test_every_page_that_tells_how_to_do_something_has_a_figure() -> None:
    """A picture that it includes, or a cell that draws one."""
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    (listed,) = re.findall(r"```{toctree}\n:caption: How-to\n(?::[^\n]*\n)*\n(.*?)\n```", index, re.DOTALL)
    for name in listed.split():
        page = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
        assert re.search(r"!\[|\.plot\(|plt\.subplots\(|SVG\(", page), f"{name} has no figure"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_notebook_stores_its_outputs(path: Path) -> None:
    """A reader of the repository sees tables and figures without running it: all cells ran once, in order."""
    cells = code_of(path)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1)), "run store_outputs.py"
    kinds = {kind for cell in cells for one in cell["outputs"] for kind in one.get("data", {})}
    assert {"image/png", "text/plain"} <= kinds
    assert "<progress" not in path.read_text(encoding="utf-8")
    assert not [one for cell in cells for one in cell["outputs"] if one["output_type"] == "error"]


def test_the_index_lists_every_page() -> None:
    """Once; a page that stands in no table of contents is not found."""
    docs = ROOT / "docs"
    text = (docs / "index.md").read_text(encoding="utf-8")
    trees = re.findall(r"```\{toctree\}\n(?::[^\n]*\n)*\n(.*?)```\n", text, re.DOTALL)
    pages = [path for path in docs.rglob("*") if path.suffix in (".md", ".ipynb") and "_build" not in path.parts]
    names = [path.relative_to(docs).with_suffix("").as_posix() for path in pages]
    assert sorted([name for tree in trees for name in tree.split()] + ["index"]) == sorted(names)


def wide(path: Path) -> list[str]:
    """Return the lines of a page's code, and of the files that it includes, that need more than 88 columns."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        blocks = ["".join(cell["source"]) for cell in code_of(path)]
    else:
        plain = re.sub(r"^```\{(?!code-cell).*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
        blocks = re.findall(r"^```.*?\n(.*?)^```", plain, flags=re.DOTALL | re.MULTILINE)
        names = re.findall(r"```\{literalinclude\} (\S+\.(?:toml|py))", text)
        blocks += [(path.parent / name).read_text(encoding="utf-8") for name in names]
    return [line for block in blocks for line in block.splitlines() if len(line) > 88]


@pytest.mark.parametrize("path", [*sorted((ROOT / "docs").glob("*.md")), *NOTEBOOKS], ids=lambda path: path.stem)
def test_code_fits_the_column_of_a_page(path: Path) -> None:
    """A reader of the manual sees whole lines, without scrolling."""
    assert wide(path) == []


def test_a_wide_line_is_found(tmp_path: Path) -> None:
    """In a cell, in a shell block and in an included file; not in prose or in the list of another directive."""
    page, line = tmp_path / "page.md", "x" * 89
    (tmp_path / "file.toml").write_text(line)
    page.write_text(f"{line}\n```{{names}}\n{line}\n```\n```sh\n{line}\n```\n```{{code-cell}} python\n{line}\n```\n")
    assert len(wide(page)) == 2
    page.write_text("```{literalinclude} file.toml\n:language: toml\n```\n")
    assert wide(page) == [line]


def test_the_table_of_commands_has_every_command() -> None:
    """And no other."""
    from taciturn.cli.frame import app

    text = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
    table = text.partition("| command | result |")[2].partition("\n\n")[0]
    assert set(re.findall(r"`taciturn ([a-z]+)", table)) == set(typer.main.get_command(app).commands)


def typed(text: str) -> list[list[str]]:
    """Return the words behind each ``taciturn`` that the shell blocks of a page type."""
    blocks = re.findall(r"```(?:sh|console)\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    found = [re.search(r"(?:^|[ /])taciturn (.*?)(?: &.*)?$", line) for line in lines]
    return [shlex.split(match[1], comments=True) for match in found if match]


def test_the_command_line_understands_what_the_pages_type() -> None:
    """Commands, options and their values are parsed, and nothing is run."""
    from taciturn.cli.frame import app

    commands = typer.main.get_command(app).commands
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    lines = [words for path in pages for words in typed(path.read_text(encoding="utf-8"))]
    assert len(lines) > 30
    for words in lines:
        if words != ["--version"]:
            assert words[0] in commands, words
            assert commands[words[0]].make_context(words[0], words[1:]).args == [], words
    with pytest.raises(typer.TyperException, match="--rte"):
        commands["tune"].make_context("tune", ["two-mass-lqg", "--rte", "0.5"])


def resolves(name: str) -> bool:
    """Tell whether a dotted name within the package is a module, or what hangs on one."""
    parts = name.split(".")
    for last in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(["taciturn", *parts[:last]]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[last:]:
            found = getattr(found, attribute, None)
        return found is not None
    return False


def missing(text: str) -> tuple[list[str], int]:
    """Return what is not there of the code and the tests that a page names, and how many names there are.

    Code is named as `function` in `module`; the name of a test is a sentence, and its file stands behind it.
    """
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    folders = "|".join(path.name for path in (ROOT / "src" / "taciturn").iterdir() if (path / "__init__.py").exists())
    code = re.findall(rf"(?:`([\w.]+)` in )?`((?:{folders})(?:\.\w+)+)`", prose)
    tests = re.findall(r"\*([a-z0-9 ]+)\* \(`([\w/]+\.py)`\)", prose)
    wrong = [f"{module}.{name}" for name, module in code if not resolves(f"{module}.{name}".rstrip("."))]
    for sentence, file in tests:
        path, name = ROOT / "tests" / file, "test_" + sentence.replace(" ", "_")
        if not path.exists() or f"\ndef {name}(" not in path.read_text(encoding="utf-8"):
            wrong.append(f"{file}::{name}")
    return wrong, len(code) + len(tests)


@pytest.mark.parametrize(("page", "least"), [("appendix", 140), ("comparison", 10)])
def test_what_the_pages_of_theory_name_of_code_and_tests_is_there(page: str, least: int) -> None:
    """A theorem whose test is renamed, or whose function moves, is found out here."""
    wrong, names = missing((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8"))
    assert wrong == []
    assert names >= least


def test_a_name_that_is_not_there_is_found() -> None:
    """The search itself can fail: a module, a function, an attribute, a file, a test; code cells are left out."""
    named = "`lqg.nowhere` `nobody` in `lqg.lossy` `PredictionCost.nothing` in `lqg.prediction` "
    named += "*it* (`lqg/test_no.py`) *nothing* (`lqg/test_lossy.py`) `lossy_step` in `lqg.lossy`\n"
    named += "```python\n`lqg.nowhere`\n```\n"
    wrong, names = missing(named)
    assert len(wrong) == 5
    assert names == 6


def test_the_readme_runs_and_shows_what_it_prints(capsys: pytest.CaptureFixture[str]) -> None:
    """The words are the same, and the numbers to a thousandth; it is no longer than a visitor reads."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (code,), (shown,) = (re.findall(rf"```{of}\n(.*?)```", text, flags=re.DOTALL) for of in ("python", "text"))
    assert run_blocks([code], "README.md") == 1
    number = r"[-+]?\d+(?:\.\d+)?"
    printed = capsys.readouterr().out
    assert re.sub(number, "#", printed).split() == re.sub(number, "#", shown).split()
    numbers = [[float(one) for one in re.findall(number, where)] for where in (printed, shown)]
    assert numbers[0] == pytest.approx(numbers[1], rel=1e-3)
    assert len(text.split()) <= 450


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_is_short_and_ends_in_an_assert(path: Path) -> None:
    """What it shows holds, or the example fails."""
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 62
    assert text.rstrip().splitlines()[-1].startswith("assert ")


@pytest.mark.parametrize(
    "path",
    in_time(path for path in EXAMPLES if path not in DRAWN),
    ids=lambda path: path.stem,
)
def test_every_example_without_a_figure_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It holds in reduced counts."""
    text = path.read_text(encoding="utf-8")
    if "taciturn_twins" in text and blind():
        pytest.skip(blind())
    monkeypatch.chdir(tmp_path)
    try:
        exec(compile(reduced(path.stem, text), path.name, "exec"), {"__name__": "__main__", "__file__": str(path)})
    finally:
        importlib.import_module("matplotlib.pyplot").close("all")


def test_an_example_runs_as_a_script(tmp_path: Path) -> None:
    """One process shows what all examples need of it: nothing but the file."""
    path = ROOT / "examples" / "two_masses_over_a_network.py"
    done = subprocess.run([sys.executable, path], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_sources_that_examples_name_are_known() -> None:
    """A parameter's source is a key of docs/sources.bib."""
    keys = re.findall(r"^@\w+\{(\w+),", (ROOT / "docs" / "sources.bib").read_text(encoding="utf-8"), re.MULTILINE)
    named = {
        key for path in EXAMPLES for key in re.findall(r"\b[a-z]+(?:19|20)\d\d\b", path.read_text(encoding="utf-8"))
    }
    assert len(named) > 5
    assert named <= set(keys)


@pytest.mark.parametrize("name", in_time(MODULES))
def test_every_docstring_example_holds(name: str) -> None:
    """What a docstring shows is what happens."""
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0
