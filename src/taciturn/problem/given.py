"""Matrices of a problem that are read from a MATLAB or NumPy file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from taciturn._arrays import array
from taciturn._display import Displayed
from taciturn._matlab import Foreign, Variable, read_variables
from taciturn.errors import ProblemError
from taciturn.model.state_space import DELAYS, descriptor_of, refuse_delays

NAMES = {
    "A": ("A",),
    "B": ("B",),
    "C": ("C",),
    "D": ("D",),
    "E": ("E",),
    "W": ("W", "Phi_w"),
    "V": ("V", "Phi_v"),
    "Q": ("Q",),
    "R": ("R",),
    "N": ("N",),
    "dt": ("dt", "Ts"),
}
"""The accepted variable names for each key of the problem file; names are case-sensitive."""

SYSTEMS = ("ss", "tf", "zpk", "idss", "frd")  # MATLAB classes of systems


@dataclass(frozen=True, eq=False, repr=False)
class Given(Displayed):
    """The part of a problem that a file contains.

    Args:
        arrays: matrices by key of the problem file: A, B, E, C, D if it is not 0, W, V, Q, R, N.
        dt: seconds per step, 0 for a continuous-time plant, None if the file does not specify the time base.
        ignored: names of the other variables in the file.
    """

    arrays: dict[str, npt.NDArray[Any]]
    dt: float | None
    ignored: tuple[str, ...]


def read_given(path: Path) -> Given:
    """Return the part of a problem that a ``.mat`` or ``.npz`` file contains.

    Args:
        path: file with variables A, B, C, D, E, W or Phi_w, V or Phi_v, Q, R, N, dt or Ts (0: continuous).

    Raises:
        ProblemError: if the file cannot be read, a variable is not an array or has two names, the time base is
            unspecified, there is a delay, or the file contains a system object that only
            MATLAB can open.
    """
    held = read_variables(path)
    found: dict[str, npt.NDArray[Any]] = {}
    for key, names in NAMES.items():
        there = [name for name in names if name in held]
        if len(there) > 1:
            raise ProblemError(f"{path} has {' and '.join(there)}; expected only one of them, since both specify {key}")
        if there:
            found[key] = _expect_array(path, there[0], held[there[0]])
    foreign = {name: value.kind for name, value in held.items() if isinstance(value, Foreign)}
    systems = [(name, kind) for name, kind in foreign.items() if kind in SYSTEMS]
    if systems and "A" not in found:
        raise ProblemError(_only_matlab(path, *systems[0]))
    A, B = (np.atleast_2d(found.get(name, np.zeros((0, 0)))) for name in "AB")
    if "D" in found and not found["D"].any():  # of the right size, or empty
        outputs = len(np.atleast_2d(found["C"])) if "C" in found else len(A)
        if not found["D"].size or found["D"].size == outputs * B.shape[1]:
            del found["D"]
    if "E" in found and descriptor_of(found) is None and found["E"].size in (0, len(A) ** 2):
        del found["E"]
    if "D" in found and "C" not in found:
        raise ProblemError(f"{path} has D and no C; expected C, as a direct feedthrough adds to measured outputs")
    changes = {name: _expect_array(path, name, held[name]) for name in DELAYS if name in held}
    refuse_delays(str(path), changes)
    known = {name for names in NAMES.values() for name in names} | set(changes)
    dt = found.pop("dt", None)
    return Given(found, None if dt is None else _step(path, dt), tuple(sorted(set(held) - known)))


def read_controller(place: str) -> tuple[dict[str, npt.NDArray[Any]], float | None]:
    """Return the matrices of a controller in a file by name, and its step: 0 in continuous time, None if not stated.

    Args:
        place: ``file.mat`` with the variables A, B, C, D, perhaps E, and dt or Ts; or ``file.mat:K``, a static gain.

    Raises:
        ProblemError: if the file cannot be read, or has no such matrices.
    """
    path, named = Path(place), ""
    if ":" in path.name:
        path, named = Path(place.rpartition(":")[0]), place.rpartition(":")[2]
    held = read_variables(path)
    if named:
        if named not in held:
            raise ProblemError(f"{path} has no variable {named}; expected one of {', '.join(sorted(held))}")
        value = held[named]
        if isinstance(value, Foreign):
            raise ProblemError(_only_matlab(path, named, value.kind))
        return {"D": _expect_array(path, named, value)}, None
    objects = [(name, one.kind) for name, one in held.items() if isinstance(one, Foreign) and one.kind in SYSTEMS]
    found = {name: _expect_array(path, name, held[name]) for name in "ABCDE" if name in held}
    if not found:
        message = _only_matlab(path, *objects[0]) if objects else f"{path} has no A, B, C, D; expected a controller"
        raise ProblemError(message)
    refuse_delays(str(path), {name: _expect_array(path, name, held[name]) for name in DELAYS if name in held})
    steps = [name for name in NAMES["dt"] if name in held]
    return found, _step(path, _expect_array(path, steps[0], held[steps[0]])) if steps else None


def _only_matlab(path: Path, name: str, kind: str) -> str:
    return (
        f"{name} in {path} is an object of the MATLAB class {kind}, which only MATLAB can open; expected its "
        f"matrices: [A, B, C, D] = ssdata({name}); Ts = {name}.Ts; save('{path.name}', 'A', 'B', 'C', 'D', 'Ts')"
    )


def _expect_array(path: Path, name: str, value: Variable) -> npt.NDArray[Any]:
    if isinstance(value, Foreign):
        raise ProblemError(f"{name} in {path} is a {value.kind}; expected a matrix of numbers")
    try:
        return array(name, value, (None,) * value.ndim)
    except ProblemError as error:
        raise ProblemError(f"{path}: {error}") from None


def _step(path: Path, value: npt.NDArray[Any]) -> float:
    step = float(value.ravel()[0]) if value.size == 1 else np.nan
    if not step >= 0:
        shown = f"{step:g}" if value.size == 1 else f"an array of shape {value.shape}"
        raise ProblemError(
            f"the time base in {path} is {shown}; expected the seconds per step, or 0 for a continuous plant; "
            "leave it out for steps of unknown length"
        )
    return step
