"""Matrices of a problem that come from a file of MATLAB's or NumPy's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from taciturn._arrays import array
from taciturn._matlab import Foreign, Variable, read_variables
from taciturn.errors import ProblemError

NAMES = {
    "A": ("A",),
    "B": ("B",),
    "C": ("C",),
    "D": ("D",),
    "W": ("W", "Phi_w"),
    "V": ("V", "Phi_v"),
    "Q": ("Q",),
    "R": ("R",),
    "N": ("N",),
    "dt": ("dt", "Ts"),
}
"""What a variable may be called, by key of the problem file; upper and lower case as here."""

SYSTEMS = ("ss", "tf", "zpk", "idss", "frd")  # classes of MATLAB's


@dataclass(frozen=True, eq=False)
class Given:
    """What a file says of a problem.

    Args:
        arrays: by key of the problem file: A, B, C, W, V, Q, R, N.
        dt: seconds per step, 0 for a plant that is continuous in time, None where the file does not say.
        ignored: names of its other variables.
    """

    arrays: dict[str, npt.NDArray[Any]]
    dt: float | None
    ignored: tuple[str, ...]


def read_given(path: Path) -> Given:
    """Return what a ``.mat`` or ``.npz`` file says of a problem.

    Args:
        path: with variables A, B, C, D (which must be 0), W or Phi_w, V or Phi_v, Q, R, N, dt or Ts (0: continuous).

    Raises:
        ProblemError: it cannot be read; a variable is no array, or given under two names; D is not 0; a time base that
            is not specified; or a system that only MATLAB can open.
    """
    held = read_variables(path)
    found: dict[str, npt.NDArray[Any]] = {}
    for key, names in NAMES.items():
        there = [name for name in names if name in held]
        if len(there) > 1:
            raise ProblemError(f"{path} has {' and '.join(there)}; expected one of them, as both are {key}")
        if there:
            found[key] = _expect_array(path, there[0], held[there[0]])
    foreign = {name: value.kind for name, value in held.items() if isinstance(value, Foreign)}
    systems = [(name, kind) for name, kind in foreign.items() if kind in SYSTEMS]
    if systems and "A" not in found:
        name, kind = systems[0]
        raise ProblemError(
            f"{name} in {path} is an object of MATLAB's class {kind}, which only MATLAB opens; expected its matrices: "
            f"[A, B, C, D] = ssdata({name}); Ts = {name}.Ts; save('{path.name}', 'A', 'B', 'C', 'D', 'Ts')"
        )
    if "D" in found and found.pop("D").any():
        raise ProblemError(f"D in {path} is not zero; expected no direct feedthrough from input to measurement")
    known = {name for names in NAMES.values() for name in names}
    dt = found.pop("dt", None)
    return Given(found, None if dt is None else _step(path, dt), tuple(sorted(set(held) - known)))


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
            f"the time base in {path} is {shown}; expected the seconds per step, or 0 for a continuous plant"
        )
    return step
