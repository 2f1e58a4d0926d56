"""Parts that installed packages add, found by their entry points and imported when they are needed.

| group | name | value |
|---|---|---|
| `taciturn.commands` | any | module that adds commands to `taciturn.cli.frame.app` when it is imported |
| `taciturn.functions` | name `f` | function that users call as `taciturn.f` |
| `taciturn.problems` | any | package that contains problem files, which are built in |
| `taciturn.wires` | name of the wire | function that returns the encoder and decoder of a node |
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taciturn.errors import ProblemError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@cache
def find_plugins(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name, of which nothing is imported yet."""
    from importlib.metadata import entry_points  # whose import takes longer than that of this module

    return {point.name: point for point in sorted(entry_points(group=group), key=lambda one: one.name)}


def load_plugin(group: str, name: str, purpose: str) -> Any:
    """Import what an entry point names.

    Args:
        group: group of the entry point.
        name: name of the entry point.
        purpose: what needs it, for the message.

    Raises:
        ProblemError: no installed package has the entry point, or its import fails.
    """
    point = find_plugins(group).get(name)
    if point is None:
        raise ProblemError(
            f"{purpose} needs the entry point {name!r} of the group {group}, which no installed package has; expected "
            "a complete installation of taciturn: install it again"
        )
    try:
        return point.load()
    except Exception as error:
        raise ProblemError(
            f"{purpose} needs {point.value}, which cannot be imported ({error!r}); expected an entry point that names "
            f"an existing object: update or remove the package {_package(point)}"
        ) from error


def problem_folders() -> Iterator[Path]:
    """Yield the folders of built-in problems: that of this package, and then those of other packages."""
    yield Path(__file__).parent / "problems"
    from importlib.util import find_spec

    for point in find_plugins("taciturn.problems").values():
        try:
            spec = find_spec(point.value)
        except ImportError:  # a package that is not there any more has no problems
            continue
        yield from map(Path, [] if spec is None else spec.submodule_search_locations or [])


def _package(point: EntryPoint) -> str:
    """Return the name of the package that an entry point belongs to."""
    return "of this entry point" if point.dist is None else point.dist.name
