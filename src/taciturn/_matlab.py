"""Files of matrices: MATLAB's (through scipy, and h5py from version 7.3 on) and NumPy's, with types."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias
from zipfile import is_zipfile

import numpy as np
import numpy.typing as npt

from taciturn.errors import ProblemError

ENDINGS = (".mat", ".npz")
NUMERIC = {"double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}


@dataclass(frozen=True)
class Foreign:
    """A variable that is no array: of a class of MATLAB's, a structure, a text."""

    kind: str


Variable: TypeAlias = npt.NDArray[Any] | Foreign


def read_variables(path: Path) -> dict[str, Variable]:
    """Return the variables of a ``.mat`` or ``.npz`` file, by name; matrices as MATLAB shows them.

    Raises:
        ProblemError: another ending, or a file that cannot be read.
    """
    if path.suffix.lower() not in ENDINGS:
        raise ProblemError(
            f"{str(path)!r} ends in {path.suffix!r}; expected a file of matrices, {' or '.join(ENDINGS)}"
        )
    try:
        path.open("rb").close()  # what is not there is told so by any reader
        return _numpy(path) if path.suffix.lower() == ".npz" else _matlab(path)
    except OSError as error:
        why = error.strerror or "it is damaged"
        raise ProblemError(f"{str(path)!r} cannot be read ({why}); expected a file of matrices") from None
    except Exception as error:  # what is damaged fails in many ways
        why = " ".join(str(error).split()) or type(error).__name__
        raise ProblemError(f"{str(path)!r} cannot be read ({why}); expected a file of matrices") from None


def _numpy(path: Path) -> dict[str, Variable]:
    if not is_zipfile(path):
        raise OSError
    with np.load(path, allow_pickle=False) as held:
        found: Mapping[str, npt.NDArray[Any]] = held
        return {name: _numbers(found, name) for name in found}


def _numbers(held: Mapping[str, npt.NDArray[Any]], name: str) -> Variable:
    """Return an array of a file; objects of Python are not opened."""
    try:
        value = held[name]
    except ValueError:
        return Foreign("pickled object")
    return value if value.dtype.kind in "biufc" else Foreign("text or structure")


def _matlab(path: Path) -> dict[str, Variable]:
    import scipy.io

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of objects, which are told by name
            held: dict[str, Any] = scipy.io.loadmat(path)
    except NotImplementedError:  # of version 7.3, which is HDF5
        return _hdf5(path)
    return dict(_plain(name, value) for name, value in held.items() if not name.startswith("__"))


def _plain(name: str, value: Any) -> tuple[str, Variable]:
    """Return a variable as an array, or as what else it is."""
    import scipy.io.matlab

    if isinstance(value, scipy.io.matlab.MatlabOpaque):  # which scipy calls None
        named: Any = value[0]
        return str(named["s0"].decode()), Foreign(str(named["s2"].decode()))
    if hasattr(value, "toarray"):  # sparse
        return name, np.asarray(value.toarray())
    held: npt.NDArray[Any] = np.asarray(value)
    if held.dtype.kind not in "biufc":
        return name, Foreign(str(getattr(value, "classname", "struct, cell or text")))
    return name, held


def _hdf5(path: Path) -> dict[str, Variable]:
    """Return the variables of a file of version 7.3, whose matrices lie transposed."""
    import h5py

    with h5py.File(path, "r") as file:
        opened: Any = file
        return {str(name): _hdf5_variable(item) for name, item in opened.items() if not name.startswith("#")}


def _hdf5_variable(item: Any) -> Variable:
    kind = item.attrs.get("MATLAB_class", b"struct")
    kind = kind.decode() if isinstance(kind, bytes) else str(kind)
    if "MATLAB_object_decode" in item.attrs or kind not in NUMERIC:
        return Foreign(kind)
    if "MATLAB_sparse" in item.attrs:
        return _sparse(item)
    values: npt.NDArray[Any] = np.asarray(item)
    if "MATLAB_empty" in item.attrs:
        return np.zeros([int(size) for size in values])
    if values.dtype.names is not None:  # complex, as real and imaginary parts
        values = values["real"] + 1j * values["imag"]
    return values.T


def _sparse(item: Any) -> npt.NDArray[Any]:
    """Return a sparse matrix, which is kept by columns, with its zeros."""
    starts: npt.NDArray[Any] = np.asarray(item["jc"]).astype(np.int64)
    found = np.zeros((int(item.attrs["MATLAB_sparse"]), len(starts) - 1))
    if "data" in item:  # not of a matrix of zeros
        found[np.asarray(item["ir"]), np.repeat(np.arange(len(starts) - 1), np.diff(starts))] = np.asarray(item["data"])
    return found
