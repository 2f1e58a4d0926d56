"""Functions of nonlinear plants, which problem files specify as ``file.py:name``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from taciturn._arrays import quoted
from taciturn._files import read_text, why_unreadable
from taciturn._text import backslash_text
from taciturn.errors import ProblemError
from taciturn.model.dynamics import Dynamics, dynamics_of
from taciturn.model.plant import ContinuousPlant, Plant, stated_function

KEY = "function"
LARGEST = 2**20  # bytes of a Python file


def read_function(named: str, known: Mapping[str, Dynamics]) -> Dynamics:
    """Return the function that a problem file specifies.

    Args:
        named: specification ``file.py:name`` of file and function.
        known: functions that were already read, by specification.

    Raises:
        ProblemError: if the specification has another form, or the file cannot be read, is not valid Python or does
            not define the function.
    """
    if named in known:
        return known[named]
    path, _, name = named.rpartition(":")
    if not path or not name.isidentifier():
        raise ProblemError(
            f"plant.function is {quoted(named)}; expected 'file.py:name', a Python file and a function in it"
        )
    try:
        text = read_text(Path(path), LARGEST)
    except (OSError, ValueError) as error:  # ValueError: not UTF-8 text, or a null character in the path
        raise ProblemError(
            f"plant.function names {path!r}, which cannot be read ({why_unreadable(error)}); expected a Python file, "
            f"with a path relative to the folder of the problem file{backslash_text(path)}"
        ) from None
    try:
        return dynamics_of(text, path, name)
    except ProblemError as error:
        raise ProblemError(f"plant.function: {error}") from None


def refuse_functions(tables: Mapping[str, Any], name: str) -> None:
    """Refuse the tables of a file that name a function, since reading such a file executes the function's file.

    Args:
        tables: the tables as read from TOML.
        name: name of the file, for messages.

    Raises:
        ProblemError: if a table has the key ``function``, whatever its value.
    """
    for path, table in _tables((), tables):
        if KEY in table:
            raise ProblemError(
                f"{name}: {'.'.join((*path, KEY))} is {quoted(table[KEY])}, which names Python code to execute, but "
                "functions are refused (--no-functions, functions=False); expected a problem without functions"
            )


def _tables(path: tuple[str, ...], table: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], Mapping[str, Any]]]:
    """Yield a table and all tables in it, with their paths."""
    yield path, table
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _tables((*path, key), cast("Mapping[str, Any]", value))


def locate_functions(tables: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the tables of a file with absolute paths; relative paths of functions, of a controller and of
    a timetable start there."""
    found = dict(tables)
    for key in ("controller", "reference"):
        given = found.get(key)
        kept = cast("Mapping[str, Any]", given if isinstance(given, Mapping) else {})
        if isinstance(kept.get("file"), str):
            found[key] = {**kept, "file": str((folder / kept["file"]).absolute())}
    for key in ("plant", "actual"):  # [plant.actual] is within [plant]
        if isinstance(found.get(key), Mapping):
            found[key] = locate_functions(cast("Mapping[str, Any]", found[key]), folder)
    named = found.get(KEY)
    if isinstance(named, str) and ":" in named:
        path, _, name = named.rpartition(":")
        found[KEY] = f"{(folder / path).absolute()}:{name}"
    return found


def functions_of(*plants: Plant | ContinuousPlant | None) -> dict[str, Dynamics]:
    """Return the functions of plants that were read from files, by their specification ``file.py:name``."""
    found = [stated_function(plant) for plant in plants if isinstance(plant, Plant)]
    return {f"{one.path}:{one.name}": one for one in found if one is not None and one.text is not None}
