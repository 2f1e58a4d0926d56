"""Functions of plants that are not linear, as problem files name them: ``file.py:name``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from taciturn._arrays import quoted
from taciturn.errors import ProblemError
from taciturn.model.dynamics import Dynamics, dynamics_of
from taciturn.model.plant import ContinuousPlant, Plant

KEY = "function"


def read_function(named: str, known: Mapping[str, Dynamics]) -> Dynamics:
    """Return the function that a problem file names.

    Args:
        named: ``file.py:name``.
        known: functions that need not be read again, by such names.

    Raises:
        ProblemError: another form, a file that cannot be read, that is no Python, or that has no such function.
    """
    if named in known:
        return known[named]
    path, _, name = named.rpartition(":")
    if not path or not name.isidentifier():
        raise ProblemError(
            f"plant.function is {quoted(named)}; expected 'file.py:name', a Python file and a function in it"
        )
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ProblemError(
            f"plant.function names {path!r}, which is not a text in UTF-8 ({error.reason}); expected a Python file"
        ) from None
    except (OSError, ValueError) as error:  # a null character in a path
        why = error.strerror if isinstance(error, OSError) else error
        raise ProblemError(
            f"plant.function names {path!r}, which cannot be read ({why}); expected a Python file, its path counted "
            "from the folder of the problem file"
        ) from None
    try:
        return dynamics_of(text, path, name)
    except ProblemError as error:
        raise ProblemError(f"plant.function: {error}") from None


def locate_functions(tables: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the tables of a file with the paths of functions counted from its folder, and written in full."""
    found = dict(tables)
    for key in ("plant", "actual"):  # [plant.actual] is within [plant]
        if isinstance(found.get(key), Mapping):
            found[key] = locate_functions(cast("Mapping[str, Any]", found[key]), folder)
    named = found.get(KEY)
    if isinstance(named, str) and ":" in named:
        path, _, name = named.rpartition(":")
        found[KEY] = f"{(folder / path).absolute()}:{name}"
    return found


def functions_of(*plants: Plant | ContinuousPlant | None) -> dict[str, Dynamics]:
    """Return the functions of plants that were read from files, as problem files name them."""
    found = [plant.function for plant in plants if isinstance(plant, Plant) and plant.function is not None]
    return {f"{one.path}:{one.name}": one for one in found if one.text is not None}
