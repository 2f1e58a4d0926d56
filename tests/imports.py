"""Which files of the library and of its tests a file imports, in itself and by way of others.

Imports inside functions count, as do the names that ``taciturn`` imports when they are asked for. The kinds of the
catalogue are imported by name when a problem needs one, so who imports the catalogue may reach each kind. What is no
Python (problem files, the C core, pages) belongs to the modules of its folder, which read it.
"""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
PLACES = (ROOT / "src", ROOT / "tests")
KINDS = ROOT / "src" / "taciturn" / "design" / "kinds"


@cache
def tree(path: Path) -> ast.Module:
    """Return the syntax tree of a file, parsed once."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """Return all nodes of the syntax tree of a file, walked once."""
    return tuple(ast.walk(tree(path)))


@cache
def homes() -> dict[str, str]:
    """Return the module of each name that ``taciturn`` imports when it is asked for, also of the packages beside it."""
    text = (ROOT / "src" / "taciturn" / "__init__.py").read_text(encoding="utf-8")
    own = {name: f"taciturn.{place}" for name, place in re.findall(r'^    "(\w+)": "([\w.]+)",$', text, re.MULTILINE)}
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    return own | {name: place.partition(":")[0] for name, place in stated["taciturn.functions"].items()}


@cache
def file_of(module: str) -> Path | None:
    """Return the file of a module of the library or of the tests, None for another's."""
    parts = module.split(".")
    for place in PLACES:
        for path in (place.joinpath(*parts).with_suffix(".py"), place.joinpath(*parts, "__init__.py")):
            if parts != [""] and path.exists():
                return path
    return None


@cache
def imported(path: Path) -> frozenset[Path]:
    """Return the files that a file imports itself, those that its strings name as modules included."""
    names = set[str]()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "taciturn":
            names.add(f"taciturn.{node.attr}")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("taciturn"):
            names.add(node.value.partition(":")[0])  # what a test starts as a process, or patches
    public = {homes()[name] for name in (one.partition(".")[2] for one in names) if name in homes()}
    found = {file for name in names | public for file in above(name)} - {path}
    if path.name.startswith("test_"):
        found |= {folder / "conftest.py" for folder in path.parents if (folder / "conftest.py").exists()}
    return frozenset(found | (set(KINDS.glob("*.py")) if any(one.stem == "catalogue" for one in found) else set()))


def above(module: str) -> list[Path]:
    """Return the files of a module and of the packages that hold it; of a name in a module, those of the module."""
    parts = module.split(".")
    found = [file_of(".".join(parts[:count])) for count in range(1, len(parts) + 1)]
    own = ROOT / "src" / "taciturn" / "__init__.py"  # which imports nothing before it is asked
    return [path for path in found if path is not None and path != own]


def importers(places: Iterable[Path] = PLACES) -> dict[Path, set[Path]]:
    """Return the files that import each file of the library and of the tests."""
    found: dict[Path, set[Path]] = {}
    for place in places:
        for path in place.rglob("*.py"):
            for file in imported(path):
                found.setdefault(file, set()).add(path)
    return found


def distances(changed: Iterable[Path]) -> dict[Path, int]:
    """Return how many imports lead from each file to the nearest changed one; 0 for that itself."""
    edge = {reader for path in changed for reader in readers(path)}
    found, by = dict.fromkeys(edge, 0), importers()
    while edge:
        edge = set[Path]().union(*(by.get(path, set()) for path in edge)) - found.keys()
        found |= dict.fromkeys(edge, max(found.values()) + 1)
    return found


def readers(path: Path) -> set[Path]:
    """Return the Python files that stand for a file: itself, or for what is no Python the modules of its folder."""
    if path.suffix == ".py":
        return {path}
    folder = path.parent
    while ROOT in folder.parents and not list(folder.glob("*.py")):
        folder = folder.parent
    return set(folder.glob("*.py"))
