"""Shell completion of files, built-in problems, policy kinds and links, without heavy imports."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import typer

from taciturn._files import read_text
from taciturn._plugins import problem_folders

LARGEST = 2**24  # bytes of a problem file


def complete_file(incomplete: str) -> list[str]:
    """Return the built-in problems and TOML files with this prefix; if there are none, the shell completes folders."""
    folder = incomplete[: incomplete.rfind("/") + 1]
    try:
        files = sorted(f"{folder}{path.name}" for path in Path(folder or ".").glob("*.toml"))
    except OSError:
        files = []
    names = [*files, *sorted(path.stem for folder in problem_folders() for path in folder.glob("*.toml"))]
    return [name for name in names if name.startswith(incomplete)]


def complete_from(*words: str) -> Callable[[str], list[str]]:
    """Return a completion function for these words."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    return complete


def complete_kind(incomplete: str) -> list[str]:
    """Return the policy kinds with this prefix; no kind is imported."""
    from taciturn.design.catalogue import CATALOGUE

    return complete_from(*CATALOGUE)(incomplete)


def complete_link(context: typer.Context, incomplete: str) -> list[str]:
    """Return the links with this prefix of the problem files among the words typed before."""
    links = [link for word in context.args for link in _links(word)]
    return complete_from(*dict.fromkeys(links))(incomplete)


def _links(name: str) -> Iterable[str]:
    """Return the links of a problem file: one of each node that is not at the controller's place."""
    paths = (Path(name), *(folder / f"{name}.toml" for folder in problem_folders()))
    try:
        tables: dict[str, Any] = tomllib.loads(next(read_text(path, LARGEST) for path in paths if path.is_file()))
        nodes = tables.get("nodes", {"sensor": {}, "actuator": {}})
        (controller,) = (node for node, role in nodes.items() if role.get("controls")) if "nodes" in tables else ("",)
        return [node for node, role in nodes.items() if controller not in (node, role.get("site"))]
    except (
        StopIteration,
        OSError,
        ValueError,
        AttributeError,
        RecursionError,
    ):  # a file that is not a problem has no links
        return ()
