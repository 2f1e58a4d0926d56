"""What the documentation makes of the package itself: its reference, its diagrams, its gallery."""

from __future__ import annotations

import importlib
import pickle
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from test_house import FLOORS

import taciturn
from taciturn._figure import Band, Panel, Series, draw
from taciturn._style import SIGNALS, STYLES, THINGS, StyleName
from taciturn_thesis.reproduce import CHAPTERS

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
IMPORT = re.compile(r"^(?: *\")?from (taciturn\S*) import (\([^)]*\)|[\w, ]+)", re.MULTILINE)


@pytest.fixture(scope="module")
def names() -> ModuleType:
    """Return the module of the documentation that lists names."""
    sys.path.insert(0, str(DOCS))
    try:
        return importlib.import_module("names")
    finally:
        sys.path.pop(0)


def test_each_caption_of_the_gallery_names_a_section_of_the_manual() -> None:
    """The build refuses a figure without a caption; a caption whose section is renamed is found here."""
    sys.path.insert(0, str(DOCS))
    try:
        captions = importlib.import_module("captions").CAPTIONS
    finally:
        sys.path.pop(0)
    for key, texts in captions.items():
        page, _, section = key.partition("#")
        (path,) = (path for kind in (".md", ".ipynb") if (path := DOCS / f"{page}{kind}").exists())
        headings = re.findall(r'^(?: *")?#+ (.*?)(?:\\n)?"?,?$', path.read_text(encoding="utf-8"), re.MULTILINE)
        assert section in {re.sub(r"[^a-z0-9]+", "-", heading.lower()).strip("-") for heading in headings}, key
        assert all(text.endswith(".") and len(text) < 100 for text in texts), key


@pytest.fixture(scope="module")
def listed(names: ModuleType) -> dict[str, object]:
    """Return what the pages of the reference list, by name."""
    text = "".join(path.read_text(encoding="utf-8") for path in sorted(DOCS.glob("reference*.md")))
    blocks = re.findall(r"```\{names\}(.*?)```", text, re.DOTALL)
    entries = [line.strip() for block in blocks for line in block.splitlines() if line.strip()]
    modules = [entry.partition(":")[0] for entry in entries]
    assert len(modules) == len(set(modules))
    found = [(entry.partition(":")[0], names.public(entry)) for entry in entries]
    return {f"{module}.{name}": value for module, public in found for name, value in public.items()}


def test_the_reference_lists_every_public_name(listed: dict[str, object]) -> None:
    """Those of the package, and of its policies."""
    for home in (taciturn, taciturn.design):
        offered = {f"{home.__name__}.{name}" for name in home.__all__} - {"taciturn.__version__", "taciturn.design"}
        assert offered <= set(listed)


def test_the_reference_lists_what_pages_and_examples_import(listed: dict[str, object]) -> None:
    """Every function and class, wherever it lives; constants and types speak for themselves."""
    known = {id(value) for value in listed.values()}
    found = 0
    for path in (ROOT / "README.md", *DOCS.glob("*.md"), *DOCS.glob("*/*.ipynb"), *(ROOT / "examples").glob("*.py")):
        for module, text in IMPORT.findall(path.read_text(encoding="utf-8")):
            home = vars(importlib.import_module(module))
            for value in (home.get(name) for name in re.findall(r"\w+", text)):
                if hasattr(value, "__qualname__"):
                    assert id(value) in known, f"{path.name}: {value} of {module}"
                    found += 1
    assert found > 40


def test_nothing_is_listed_twice(listed: dict[str, object]) -> None:
    """A name has one place in the reference, where all others point to."""
    assert len({id(value) for value in listed.values()}) == len(listed)


def test_a_docstring_becomes_markup_that_shows_what_it_says(names: ModuleType) -> None:
    """Formulas keep their lines, stars and bars are no markup, lists and examples are left alone."""
    lines = ["Of |e|:", "", "    u = L*x|", "    y_ = x", "", "By x_, ``a*b``.", "", ">>> 2*3", "6", "", "* a *list*"]
    names.mend(lines)
    assert lines[:7] == [r"Of \|e\|:", "", "::", "", "    u = L*x|", "    y_ = x", ""]
    assert lines[7:] == [r"By x\_, ``a*b``.", "", ">>> 2*3", "6", "", r"* a \*list\*"]


def test_the_page_of_benchmarks_names_every_file() -> None:
    """And the tables that they write are there."""
    text = (DOCS / "performance.md").read_text(encoding="utf-8")
    for path in (ROOT / "benchmarks").iterdir():
        assert path.is_dir() or f"{path.name}" in text
    written = re.findall(r"\| `(\w+\.json)` \|", text)
    others = {"misra.json"}  # which no benchmark writes
    assert sorted(written) == sorted({path.name for path in DOCS.glob("*.json")} - others)


def test_the_floors_of_the_diagram_are_those_that_imports_are_held_to() -> None:
    """The table of docs/architecture.md, which the diagram reads, and the walk of ``test_house``."""
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| (.*?) \|", text, re.MULTILINE)
    shown = {part: int(number) for number, parts in rows for part in re.findall(r"`(\w+)/?`", parts)}
    assert shown == {part: number for part, number in FLOORS.items() if part}


def test_the_gallery_shows_every_chapter_that_is_reproduced() -> None:
    """By the chapters that ``reproduce`` knows."""
    shown = re.findall(r'reproduce\("(\w+)"\)', (DOCS / "gallery.md").read_text(encoding="utf-8"))
    assert sorted(shown) == sorted(CHAPTERS)


@pytest.mark.parametrize(
    ("words", "page"),
    [
        ("accuracy", "limits"),
        ("anti-windup", "constraints"),
        ("citation", "help"),
        ("feedforward", "set-points"),
        ("integral action", "set-points"),
        ("limitations", "limits"),
        ("operating point", "set-points"),
        ("own policy", "own-policy"),
        ("set-point", "set-points"),
    ],
)
def test_the_search_finds_the_page(words: str, page: str) -> None:
    """A title comes first if the words are at least half of it; common words such as *own* count in titles alone."""
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8").lower()
    titles = re.findall(r"^# (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    assert any(words in title and 2 * len(words) >= len(title) for title in titles) or f" {words} " in text


def test_the_landing_page_is_the_readme() -> None:
    """The list of all pages is in the menu alone."""
    trees = re.findall(r"```\{toctree\}\n(.*?)\n\n", (DOCS / "index.md").read_text(encoding="utf-8"), re.DOTALL)
    assert trees
    assert all(":hidden:" in tree for tree in trees)


def test_a_figure_shows_itself_in_a_notebook() -> None:
    """Also where pyplot was never imported; and it can still be copied to another process."""
    figure = pickle.loads(pickle.dumps(draw([Panel([Series([0.0, 1.0], [1.0, 0.0])], "x", "y")])))
    assert figure._repr_png_().startswith(b"\x89PNG")


@pytest.mark.evidence
def test_a_picture_on_a_page_has_the_colours_that_the_reader_prefers() -> None:
    """Every colour of the light style is a variable with a value for dark pages."""
    panel = Panel([Series([0.0, 1.0], [1.0, 0.0], "one", thing="policy")], "x", "y", bands=[Band(None, 0.5)])
    light, dark = STYLES["light"], STYLES["dark"]
    svg = draw([panel])._repr_svg_()
    for hue in ("blue", "ink", "muted", "shade", "grid"):
        plain = light.hues[hue]
        assert f"fill: var(--c{plain[1:]})" in svg or f"stroke: var(--c{plain[1:]})" in svg
        assert f": {plain}" not in svg
        assert f"--c{plain[1:]}:{dark.hues[hue]};" in svg.partition("prefers-color-scheme: dark")[2]
    assert f"fill: var(--c{light.background[1:]})" in svg
    assert "var(" not in draw([panel], style="dark")._repr_svg_()


@pytest.mark.parametrize("name", STYLES)
def test_every_colour_stands_out_from_its_background(name: StyleName) -> None:
    """By the contrast ratio of the WCAG: 3 to 1 for lines and marks, 4.5 for text; regions and grids are quiet."""
    style = STYLES[name]

    def luminance(color: str) -> float:
        parts = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
        return float(np.dot([0.2126, 0.7152, 0.0722], linear))

    def contrast(color: str) -> float:
        low, high = sorted((luminance(color), luminance(style.background)))
        return (high + 0.05) / (low + 0.05)

    quiet = {"shade", "forbidden", "grid", "box", "hub"}
    assert all(contrast(color) >= 3 for hue, color in style.hues.items() if hue not in quiet)
    assert min(contrast(style.hues["ink"]), contrast(style.hues["muted"])) >= 4.5
    assert all(contrast(style.hues[hue]) < 1.6 for hue in quiet)


def test_no_two_things_look_the_same() -> None:
    """In grey, too: colours apart, no two things have one dash, marker and width."""
    for looks in ([*THINGS.values()], [*SIGNALS]):
        assert len({(one.dash, one.marker, one.width, one.hue == "shade") for one in looks}) == len(looks)
