"""Print the lowest versions that pyproject.toml allows, as constraints of pip.

``python .ci/bounds.py core test > lowest.txt && pip install -c lowest.txt '.[test]'`` installs exactly these versions.
``core`` is what every installation needs; the other names are those of the extras; without names, all are meant.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent / "pyproject.toml"
# a name, perhaps with extras of its own, and one lower bound; nothing else is needed here, so nothing else is read
REQUIREMENT = re.compile(r"([A-Za-z0-9._-]+)(?:\[[A-Za-z0-9,._-]+\])?>=([0-9]+(?:\.[0-9]+)*)")


def requirements(project: Path = PROJECT) -> dict[str, list[str]]:
    """Return the requirements of the core and of each extra, as pyproject.toml spells them.

    Args:
        project: The path of pyproject.toml.

    Returns:
        The requirements by ``core`` or the name of the extra.
    """
    table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    return {"core": table["dependencies"], **table["optional-dependencies"]}


def bound(requirement: str) -> tuple[str, str]:
    """Split a requirement into the name of the package and its lowest version.

    Args:
        requirement: As in pyproject.toml, for example ``numpy>=2.1``.

    Returns:
        The name and the version.

    Raises:
        ValueError: The requirement has no lower bound, or it has more than that.
    """
    found = REQUIREMENT.fullmatch(requirement)
    if found is None:
        raise ValueError(f"requirement {requirement!r}; expected a name and one lower bound, as numpy>=2.1")
    return found[1], found[2]


def lowest(groups: list[str], of: dict[str, list[str]]) -> dict[str, str]:
    """Return the lowest version of each package that these groups require.

    Args:
        groups: ``core`` and names of extras.
        of: The requirements of each group.

    Returns:
        The lowest versions by the name of the package, in the order of pyproject.toml.

    Raises:
        ValueError: A group is unknown, a requirement has no lower bound, or a package has two of them.
    """
    found: dict[str, str] = {}
    for group in groups:
        if group not in of:
            raise ValueError(f"group {group!r}; expected one of {', '.join(of)}")
        for name, version in map(bound, of[group]):
            if found.setdefault(name, version) != version:
                raise ValueError(f"{name} has the lower bounds {found[name]} and {version}; expected one of them")
    return found


if __name__ == "__main__":
    every = requirements()
    for package, version in lowest(sys.argv[1:] or list(every), every).items():
        print(f"{package}=={version}")
