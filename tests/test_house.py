"""The house stands as docs/architecture.md draws it."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest
from imports import nodes, tree

import taciturn
import taciturn.extend
from taciturn.design.catalogue import own_kinds

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "src" / "taciturn"
SATELLITES = tuple(sorted(path.name for path in SOURCE.parent.glob("taciturn_*")))
FLOORS = {
    "errors": 0, "_arrays": 0, "_plugins": 0, "_modes": 0, "_rational": 0, "_scipy": 0, "_style": 0, "_figure": 0,
    "_places": 0, "_diagram": 0, "_files": 0, "_version": 0, "_progress": 0, "_process": 0, "_text": 0, "_display": 0,
    "model": 1,
    "lqg": 2, "problems": 2,
    "program": 3, "renewal": 3,
    "loop": 4, "base": 4,
    "analyse": 5,
    "design": 6,
    "simulation": 7, "nodes": 7,
    "problem": 8,
    "study": 9,
    "cli": 10, "extend": 10,
    "": 11,  # the package itself: its names are imported when they are asked for
}  # fmt: skip
# siblings that may meet, in one direction; the command line uses the package as its users do
MEETINGS = {
    ("_arrays", "errors"), ("_figure", "errors"), ("_figure", "_text"), ("_figure", "_style"), ("_style", "errors"),
    ("_figure", "_places"), ("_places", "_style"), ("_display", "errors"), ("_modes", "errors"), ("_modes", "_arrays"),
    ("_diagram", "_style"), ("_diagram", "_figure"), ("_diagram", "_text"),
    ("_rational", "_arrays"), ("_rational", "_modes"), ("_scipy", "_arrays"), ("_files", "_process"),
    ("_progress", "_arrays"), ("_progress", "_text"), ("_progress", "errors"), ("_plugins", "errors"),
    ("cli", ""),
}  # fmt: skip


def part(module: str) -> str:
    """Return the folder or file of the package that a module belongs to."""
    names = module.split(".")
    return names[1] if len(names) > 1 else ""


def imports(path: Path) -> list[str]:
    """Return the modules of this package that a file imports, wherever in the file; other ways in are refused."""
    found: list[str] = []
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path.name}:{node.lineno} imports relatively; write the whole name"
            whole = node.module == "taciturn"
            found += [f"taciturn.{alias.name}" if whole else str(node.module) for alias in node.names]
        elif isinstance(node, ast.Call) and path.parent != SOURCE and isinstance(node.func, ast.Name):
            told = node.args[0].value if node.args and isinstance(node.args[0], ast.Constant) else "taciturn"  # or any
            hides = node.func.id in ("import_module", "__import__") and str(told).startswith("taciturn")
            assert not hides, f"{path.name}:{node.lineno} hides an import"
    return [name for name in found if name.split(".")[0] == "taciturn"]


def violations(source: Path) -> list[str]:
    """Return every import that does not go down, as sentences."""
    wrong: list[str] = []
    for path in sorted(source.rglob("*.py")):
        names = path.relative_to(source).with_suffix("").parts
        here = "" if names in {("__init__",), ("__main__",)} else names[0]
        assert here in FLOORS, f"{here} stands on no floor"
        for module in imports(path):
            there = part(module)
            if there not in FLOORS:
                there = ""  # a public name, imported from the package itself
            if here != there and (here, there) not in MEETINGS and FLOORS[there] >= FLOORS[here]:
                wrong.append(f"{'/'.join(names)} (floor {FLOORS[here]}) imports {module} (floor {FLOORS[there]})")
    return wrong


def private_imports(folder: Path) -> list[str]:
    """Return every import of a private module or name of another package in a folder, as sentences."""
    wrong: list[str] = []
    for path in sorted(folder.rglob("*.py")):
        for node in nodes(path):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] != folder.name:
                names = [*node.module.split("."), *(alias.name for alias in node.names)]
                if names[0].startswith("taciturn") and any(
                    name.startswith("_") and name != "__version__" for name in names
                ):
                    wrong.append(f"{path.name}:{node.lineno} imports {'.'.join(names[:-1])}.{names[-1]}")
    return wrong


def functions(path: Path) -> list[ast.FunctionDef | ast.ClassDef]:
    """Return the public functions and classes of a file, methods included."""
    found: list[ast.FunctionDef | ast.ClassDef] = []

    def walk(body: list[ast.stmt]) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                found.append(node)
                if isinstance(node, ast.ClassDef):
                    walk(node.body)

    walk(tree(path).body)
    return found


def test_a_counted_noun_agrees_with_its_number() -> None:
    """A text writes the length of a list with ``number_of``: "1 entry", not "1 entries"."""
    for path in sorted(SOURCE.parent.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        wrong = re.findall(r"\{len\([^{}]*\)\} (?!of\b|is\b)[a-z-]+s\b", text)
        assert not wrong, f"{path.name}: {wrong}"


def test_imports_only_go_down() -> None:
    """No floor knows those above it, and siblings never meet."""
    assert violations(SOURCE) == []


def test_the_page_says_which_parts_a_part_imports() -> None:
    """All but those of the lowest layer, from which every part may import."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([1-9]\d*) \| `(\w+)/?` \| .* \| (.*) \|$", text, re.MULTILINE)
    uses: dict[str, set[str]] = {}
    for path in SOURCE.rglob("*.py"):
        here = path.relative_to(SOURCE).with_suffix("").parts[0]
        uses.setdefault(here, set()).update(map(part, imports(path)))
    shown = {here: set(re.findall(r"`(\w+)`", others)) for _, here, others in rows}
    assert shown == {here: {name for name in uses[here] - {here, ""} if FLOORS.get(name)} for here in shown}
    assert shown.keys() == {name for name, floor in FLOORS.items() if floor and name}


def test_the_page_lists_every_package_of_the_wheel() -> None:
    """Next to the library, as ``src`` holds them."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^\| `(taciturn_\w+)` \|", text, re.MULTILINE)) == list(SATELLITES)


def test_a_package_lists_its_modules() -> None:
    """Its header is the way into it."""
    for header in SOURCE.glob("*/__init__.py"):
        text = header.read_text(encoding="utf-8").partition('"""\n\n')[0]
        missing = [path.stem for path in header.parent.glob("*.py") if f"``{path.stem}``" not in text]
        assert header.parent.name == "problems" or missing == ["__init__"], header.parent.name


def circles(source: Path) -> list[str]:
    """Return the files that import themselves by way of others, wherever in the files, also for types alone."""
    files = {
        ".".join((source.name, *path.relative_to(source).with_suffix("").parts)): path for path in source.rglob("*.py")
    }
    files = {name.removesuffix(".__init__"): path for name, path in files.items()}
    uses: dict[str, set[str]] = {}
    for name, path in files.items():
        stated = [node for node in nodes(path) if isinstance(node, ast.ImportFrom)]
        parts = [(str(node.module), f"{node.module}.{one.name}") for node in stated for one in node.names]
        uses[name] = {whole if whole in files else module for module, whole in parts} - {name}
    for _ in files:  # what uses nothing that is left is in no circle
        uses = {name: found & uses.keys() for name, found in uses.items() if found & uses.keys()}
    return sorted(uses)


def test_a_package_names_only_modules_that_it_has() -> None:
    """The header of a package is the way into it."""
    for header in SOURCE.glob("*/__init__.py"):
        files = list(header.parent.glob("*.py"))
        defined = {
            node.name for path in files for node in tree(path).body if isinstance(node, ast.FunctionDef | ast.ClassDef)
        }
        numbered = [line for line in (ast.get_docstring(tree(header)) or "").splitlines() if re.match(r"\d\. ", line)]
        named = {name for line in numbered for name in re.findall(r"``(\w+)``", line)}
        assert named <= defined | {path.stem for path in files}, header


def test_no_file_imports_itself_by_way_of_others(tmp_path: Path) -> None:
    """Also under ``TYPE_CHECKING``; and the search itself can fail."""
    assert circles(SOURCE) == []
    (tmp_path / "one.py").write_text(f"from {tmp_path.name}.two import b\n")
    (tmp_path / "two.py").write_text(f"def f():\n    from {tmp_path.name} import one\n")
    assert circles(tmp_path) == [f"{tmp_path.name}.one", f"{tmp_path.name}.two"]


@pytest.mark.parametrize("package", SATELLITES)
def test_a_satellite_uses_public_names_only(package: str, tmp_path: Path) -> None:
    """As a package of someone else does; the core imports no satellite, and the walk itself can fail."""
    assert private_imports(SOURCE.parent / package) == []
    for path in SOURCE.rglob("*.py"):
        assert package not in path.read_text(encoding="utf-8"), path
    (tmp_path / "of_another.py").write_text("from taciturn._arrays import Array\nfrom taciturn.loop import _add\n")
    assert len(private_imports(tmp_path)) == 2


def test_an_upward_and_a_sideways_import_are_found(tmp_path: Path) -> None:
    """The walk itself can fail."""
    (tmp_path / "model").mkdir()
    (tmp_path / "program").mkdir()
    (tmp_path / "model" / "plant.py").write_text("def f():\n    from taciturn.loop import close\n")
    (tmp_path / "program" / "ir.py").write_text("import taciturn.renewal.chain\n")
    (tmp_path / "_figure.py").write_text("from taciturn import _modes\n")
    (tmp_path / "loop.py").write_text("from taciturn.model.plant import Plant\n")
    assert len(violations(tmp_path)) == 3


@pytest.mark.parametrize(
    "path", sorted((*SOURCE.parent.rglob("*.py"), *ROOT.glob("tests/**/*.py"))), ids=lambda path: path.name
)
def test_no_file_is_longer_than_900_lines(path: Path) -> None:
    """A file that tells one story is shorter."""
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 900


def test_no_function_takes_anything() -> None:
    """No ``**kwargs`` but those of a function that is wrapped, with its types, and no module named after nothing."""
    for path in SOURCE.parent.rglob("*.py"):
        assert path.stem not in {"utils", "helpers", "manager", "config", "common", "misc"}, path
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef | ast.Lambda):
                given = node.args.kwarg
                typed = given is not None and isinstance(given.annotation, ast.Attribute)  # P.kwargs of a ParamSpec
                assert given is None or typed, f"{path.name}:{node.lineno}"


def test_every_public_name_resolves_and_says_what_it_is() -> None:
    """What ``dir(taciturn)`` lists is there, documented, holds what was promised, and fits into a head."""
    promised = {"Plant", "ContinuousPlant", "Cost", "Network", "Policy", "Trigger", "Guarantee", "Estimate", "design"}
    promised |= {"plant_from", "close", "load", "evaluate", "tradeoff", "reproduce", "simulate", "average"}
    assert promised <= set(dir(taciturn))
    assert len(taciturn.__all__) <= 46
    for name in set(dir(taciturn)) - {"__version__"}:
        assert getattr(taciturn, name).__doc__, name
    with pytest.raises(AttributeError):
        _ = taciturn.nonsense


def test_public_functions_are_documented_with_known_sources() -> None:
    """Every ``Source:`` names keys of docs/sources.bib; every policy has one, with arguments and errors."""
    keys = set(re.findall(r"^@\w+\{(\w+),", (ROOT / "docs" / "sources.bib").read_text(encoding="utf-8"), re.MULTILINE))
    for path in SOURCE.parent.rglob("*.py"):
        for node in functions(path):
            text = ast.get_docstring(node) or ""
            assert text, f"{path.name}: {node.name} has no docstring"
            named = re.search(r"Source:\s*(.+)", text)
            if named:
                assert set(re.split(r"[,;]\s*", named[1].strip())) <= keys, f"{path.name}: {node.name}"
    for name in taciturn.design.__all__:
        text = getattr(taciturn.design, name).__doc__
        assert all(section in text for section in ("Args:", "Returns:", "Raises:", "Source:", "Example:")), name


def test_docstrings_are_in_full_for_what_the_reference_lists() -> None:
    """Everything else has a sentence, and paragraphs that explain; the header of its file tells the method."""
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        names = importlib.import_module("names")
    finally:
        sys.path.pop(0)
    pages = "".join(path.read_text(encoding="utf-8") for path in sorted(ROOT.glob("docs/reference*.md")))
    entries = [one for block in re.findall(r"```\{names\}(.*?)```", pages, re.DOTALL) for one in block.split("\n")]
    listed = [value for entry in filter(None, map(str.strip, entries)) for value in names.public(entry).values()]
    published = {(value.__module__, value.__qualname__) for value in listed}
    published |= {(value.__module__, value.__qualname__) for value in vars(taciturn.extend).values() if callable(value)}
    packages = (
        SOURCE,
        *(SOURCE.parent / name for name in SATELLITES if name not in ("taciturn_thesis", "taciturn_twins")),
    )
    for path in (path for package in packages for path in package.rglob("*.py") if path.name != "commands.py"):
        module = ".".join(path.relative_to(SOURCE.parent).with_suffix("").parts).removesuffix(".__init__")
        for node in tree(path).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and (module, node.name) not in published:
                inner = [node, *(one for one in ast.walk(node) if isinstance(one, ast.FunctionDef))]
                long = [one.name for one in inner if re.search("^Args:", ast.get_docstring(one) or "", re.MULTILINE)]
                assert not long, f"{path.name}: {long}"


def test_only_its_own_file_names_a_kind() -> None:
    """The other files ask the records; those that are listed here mean another thing, or are about this kind."""
    about = {("study/periodic.py", "periodic"), ("study/evaluation.py", "periodic"), ("study/tradeoff.py", "periodic")}
    about |= {("study/compare.py", "periodic"), ("study/compare.py", "all-time"), ("study/tune.py", "consistent")}
    about |= {("study/evaluation.py", "consistent"), ("program/functions.py", "absolute"), ("loop.py", "excess")}
    about |= {("design/kinds/excess.py", "lqg")}  # the gains of LQG
    about |= {("study/evaluation.py", "excess")}  # over the cost of every sample
    # a rule of nodes that decide by themselves has the name of a rule that compares with the state
    about |= {("design/every_path.py", "relative"), ("design/kinds/distributed.py", "relative")}
    about |= {("model/schedule.py", "variance"), ("base/certainty.py", "excess")}
    about |= {("simulation/trajectory.py", "periodic"), ("cli/answers.py", "periodic")}  # the other control
    kinds, found = own_kinds(), set[tuple[str, str]]()
    for path in SOURCE.rglob("*.py"):
        place = path.relative_to(SOURCE).as_posix()
        for node in nodes(path):
            if isinstance(node, ast.Constant) and node.value in kinds and path.stem.replace("_", "-") != node.value:
                found.add((place, str(node.value)))
    assert found <= about


def test_the_repository_speaks_of_the_project_alone() -> None:
    """No path of a machine and no host of a package registry."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    words = ["/wo" + "rk/", "pypi" + ".org", "npmjs" + ".com", "files.python" + "hosted", "deb.debian" + ".org"]
    for name in listed.stdout.split():
        if name.endswith((".py", ".md", ".ipynb", ".toml", ".yaml", ".bib", "run", "versions", "-python")):
            text = (ROOT / name).read_text(encoding="utf-8")
            assert [word for word in words if word in text] == [], name
