"""Shell completion of files, built-in problems and policy kinds, without heavy imports."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from taciturn._plugins import problem_folders


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
