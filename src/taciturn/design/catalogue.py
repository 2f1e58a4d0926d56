"""Catalogue of all policy kinds: those of Taciturn in the folder ``kinds``, and those of other installed packages.

A package registers a kind by an entry point of the group ``taciturn.kinds``: its name is the name of the kind, and its
value is the place of the ``Kind``, ``module:KIND``. A kind is imported at its first use.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from taciturn._plugins import find_plugins, in_this_wheel, load_entry, package_of
from taciturn.errors import ProblemError

if TYPE_CHECKING:
    from taciturn.design.kind import Kind

GROUP = "taciturn.kinds"


class Catalogue(Mapping[str, "Kind"]):
    """All policy kinds by name. A kind is imported only when it is used."""

    def __iter__(self) -> Iterator[str]:
        """Return the names: those of this package, then those of other packages, each in alphabetical order."""
        own = own_kinds()
        return iter((*own, *(name for name in find_plugins(GROUP) if name not in own)))

    def __len__(self) -> int:
        """Return the number of kinds."""
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        """Return whether there is a kind with this name."""
        return name in own_kinds() or name in find_plugins(GROUP)

    def __getitem__(self, name: str, /) -> Kind:
        """Return the record of a kind."""
        return _kind(name)


CATALOGUE: Mapping[str, Kind] = Catalogue()


@cache
def own_kinds() -> tuple[str, ...]:
    """Return the names of Taciturn's own policy kinds, without those of other packages."""
    registered = {name for name, found in find_plugins(GROUP).items() if any(map(in_this_wheel, found))}
    return tuple(sorted(registered | _kinds_in_files()))


@cache
def _kinds_in_files() -> frozenset[str]:
    folder = str(Path(__file__).parent / "kinds")
    return frozenset(module.name.replace("_", "-") for module in pkgutil.iter_modules([folder]))


@cache
def _kind(name: str) -> Kind:
    from importlib.metadata import EntryPoint

    from taciturn.design.kind import Kind

    entries = find_plugins(GROUP).get(name, ())
    if name in _kinds_in_files():
        entries = (EntryPoint(name, f"taciturn.design.kinds.{name.replace('-', '_')}:KIND", GROUP), *entries)
    if len(entries) > 1:
        raise ProblemError(
            f"the policy kind {name!r} is registered by {' and by '.join(map(package_of, entries))}; expected only "
            "one kind with this name: rename one of the kinds, or remove one of the packages"
        )
    if not entries:
        raise KeyError(name)
    found = load_entry(entries[0], f"the policy kind {name!r}")
    if not isinstance(found, Kind) or found.name != name:
        got = f"the kind {found.name}" if isinstance(found, Kind) else f"a {type(found).__name__}"
        raise ProblemError(
            f"the policy kind {name!r} needs the object {entries[0].value} of {package_of(entries[0])}, which is "
            f"{got}; expected an object of the class Kind with the name {name!r}"
        )
    return found
