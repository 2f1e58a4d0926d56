"""Extensions in installed packages. They are found by their entry points, and are imported when they are used.

| group | name | value |
|---|---|---|
| `taciturn.bounds` | `schedules` | function that bounds the cost of every schedule of a loop from below |
| `taciturn.bursts` | name of the law | class derived from `taciturn.model.losses.LossLaw` |
| `taciturn.commands` | any | module that adds commands to `taciturn.cli.frame.app` when it is imported |
| `taciturn.functions` | name `f` | function that users call as `taciturn.f` |
| `taciturn.kinds` | name of the policy kind | its record, a `taciturn.design.kind.Kind` |
| `taciturn.problems` | any | package that contains problem files, which are built in |
| `taciturn.quadratures` | `jumps` | function that solves a chain whose noise consists of jumps |
| `taciturn.violations` | `limits` | function that estimates how often a loop violates limits of its states |
| `taciturn.wires` | name of the wire | function that returns the encoder and decoder of a node |
| `taciturn.worlds` | `faults` | function that runs all nodes of a problem in a world of faults |
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taciturn.errors import ProblemError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@cache
def find_plugins(group: str) -> Mapping[str, tuple[EntryPoint, ...]]:
    """Find the entry points of a group, by name, without importing them. Several packages may provide the same name."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for entry in sorted(_installed().select(group=group), key=lambda one: one.name):
        found[entry.name] = (*found.get(entry.name, ()), entry)
    return found


def load_plugin(group: str, name: str, purpose: str) -> Any:
    """Import the object to which an entry point refers, and check that only one package provides this entry point."""
    entries = find_plugins(group).get(name, ())
    if len(entries) != 1:
        got = f"is that of {' and of '.join(map(package_of, entries))}" if entries else "is missing"
        raise ProblemError(
            f"{purpose} needs the entry point {name!r} of the group {group}, but this entry point {got}; expected "
            "exactly one installed package that provides it: install taciturn again, or remove the other packages"
        )
    return load_entry(entries[0], purpose)


def load_entry(entry: EntryPoint, purpose: str) -> Any:
    """Import the object to which an entry point refers. If this fails, the error message begins with ``purpose``."""
    try:
        return entry.load()
    except (Exception, SystemExit) as error:  # whatever the code of the package raises
        raise ProblemError(
            f"{purpose} needs the Python object {entry.value}, which cannot be imported ({type(error).__name__}: "
            f"{error}); expected an object that can be imported: repair or remove {package_of(entry)}"
        ) from error


def package_of(entry: EntryPoint) -> str:
    """Name the package that provides an entry point, as text such as "the package NAME"."""
    return "taciturn itself" if in_this_wheel(entry) else f"the package {entry.dist.name if entry.dist else ''}"


def in_this_wheel(entry: EntryPoint) -> bool:
    """Check whether Taciturn itself, and not another package, provides an entry point."""
    return entry.dist is None or entry.dist.name == "taciturn"


@cache
def _installed() -> Any:
    """Return all entry points; finding them takes longer than importing this module."""
    from importlib.metadata import entry_points

    try:
        return entry_points()  # whose type differs between versions of Python
    except Exception:  # one package is broken, which need not be one that uses this library
        return _readable()


def _readable() -> Any:
    """Return the entry points of the packages whose entry points can be read; each other package causes a warning."""
    from importlib.metadata import EntryPoints, distributions

    found: dict[str, Any] = {}
    for package in distributions():
        name = "a package without a name"
        try:
            name = f"the package {package.name}"
            found.setdefault(package.name, package.entry_points)  # the first one is imported
        except Exception as error:
            warnings.warn(
                f"{name} has entry points that cannot be read ({error}), so its commands, policy kinds and problems "
                "are not used; expected UTF-8 text: install it again, or remove it",
                stacklevel=2,
            )
    return EntryPoints(entry for entries in found.values() for entry in entries)


def problem_folders() -> Iterator[Path]:
    """Yield the folders of built-in problems: first the folder of Taciturn, then those of other packages."""
    yield Path(__file__).parent / "problems"
    yield from _added_folders()


@cache
def _added_folders() -> tuple[Path, ...]:
    """Return the folders of built-in problems of other packages; each one that is broken causes one warning."""
    from importlib.util import find_spec

    found: list[Path] = []
    for entry in (entry for entries in find_plugins("taciturn.problems").values() for entry in entries):
        try:
            spec = find_spec(entry.value)  # which imports the package that contains the folder
            found += map(Path, [] if spec is None else spec.submodule_search_locations or [])
        except (Exception, SystemExit) as error:  # whatever the code of the package raises
            warnings.warn(
                f"the problems of {package_of(entry)} are not used, since {entry.value} cannot be imported "
                f"({type(error).__name__}: {error}); expected a folder of problem files: repair or remove it",
                stacklevel=2,
            )
    return tuple(found)
