"""Reading of the matrices of a plant or a controller from a MATLAB or NumPy file.

MATLAB files are read with scipy, and those of version 7.3 with h5py; neither is imported for a file of NumPy.
"""

from __future__ import annotations

import math
import warnings
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeAlias
from zipfile import ZipFile, is_zipfile

import numpy as np
import numpy.typing as npt

from taciturn._arrays import array
from taciturn._display import Displayed
from taciturn._files import check_regular
from taciturn._text import ending_text
from taciturn.errors import ProblemError
from taciturn.model.state_space import DELAYS, descriptor_of, refuse_delays

ENDINGS = (".mat", ".npz")
NUMERIC = {"double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
ARRAYS = range(5, 16)  # numbers of the MATLAB classes that become dense arrays: sparse, double, single, int8 … uint64
MAGIC = b"\x93NUMPY"  # first bytes of an array in a NumPy file
PACKED = 15  # type of a compressed element in a MATLAB file
LARGEST = 2**27  # bytes of all variables of a file: a matrix of 4096 states
CHUNK = 2**16  # bytes that are expanded at a time in order to count them


@dataclass(frozen=True, repr=False)
class Foreign(Displayed):
    """A variable that is not an array, such as a MATLAB object, a structure or text."""

    kind: str


Variable: TypeAlias = npt.NDArray[Any] | Foreign


class _Sizes:
    """The bytes of the variables of a file, which are counted before any of them is read."""

    def __init__(self, path: Path) -> None:
        """Start at zero."""
        self._path, self._sum = path, 0

    def add(self, name: str, size: int) -> None:
        """Add the size in bytes of a variable to the total; raise an error if the total is too large."""
        self._sum += size
        if self._sum > LARGEST:
            raise ProblemError(
                f"the file {str(self._path)!r} expands to {self._sum:,} bytes or more (counted up to {name}); expected "
                f"at most {LARGEST:,} bytes: save only the matrices A, B, C, D, W, V, Q, R, N and dt"
            )

    def add_array(self, name: str, shape: Iterable[int], itemsize: int) -> None:
        """Add the size in bytes of an array to the total; raise an error if the total is too large."""
        self.add(name, math.prod(map(int, shape)) * itemsize)


def read_variables(path: Path) -> dict[str, Variable]:
    """Read the variables of a ``.mat`` or ``.npz`` file, by name. The orientation of matrices is that of MATLAB."""
    if path.suffix.lower() not in ENDINGS:
        expected = f"expected a matrix file that ends in {' or '.join(ENDINGS)}"
        raise ProblemError(f"{str(path)!r} {ending_text(path)}; {expected}")
    try:
        check_regular(path)  # the same error for a missing file in both formats
        return _numpy(path) if path.suffix.lower() == ".npz" else _matlab(path)
    except ProblemError:
        raise
    except OSError as error:
        why = error.strerror or "it is damaged"
        raise ProblemError(f"the file {str(path)!r} cannot be read ({why}); expected a matrix file") from None
    except Exception as error:  # damaged files raise many kinds of exceptions
        why = " ".join(str(error).split()) or type(error).__name__
        raise ProblemError(f"the file {str(path)!r} cannot be read ({why}); expected a matrix file") from None


def _numpy(path: Path) -> dict[str, Variable]:
    if not is_zipfile(path):
        raise OSError
    objects = _check_numpy(path)
    with np.load(path, allow_pickle=False) as held:
        found: Mapping[str, npt.NDArray[Any]] = held
        return {name: Foreign("pickled object") if name in objects else _numbers(found[name]) for name in found}


def _check_numpy(path: Path) -> set[str]:
    """Return the names of the pickled Python objects in a file, which are not loaded."""
    expanded, declared, objects = _Sizes(path), _Sizes(path), set[str]()
    with ZipFile(path) as packed:
        for one in packed.infolist():
            expanded.add(one.filename, one.file_size)  # more bytes than these are never expanded
        for one in packed.infolist():
            name = one.filename.removesuffix(".npy")
            with packed.open(one) as file:
                if file.read(len(MAGIC)) != MAGIC:
                    continue  # np.load returns its bytes
                first = file.read(2) == b"\x01\x00"  # version of the header
                read: Any = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
                shape, _, kind = read(file)
            declared.add_array(name, shape, kind.itemsize)
            if kind.hasobject:
                objects.add(name)
    return objects


def _numbers(value: Any) -> Variable:
    """Return an array of a file, unless it contains something other than numbers."""
    held: npt.NDArray[Any] = np.asarray(value)
    return held if held.dtype.kind in "biufc" else Foreign("text or structure")


def _matlab(path: Path) -> dict[str, Variable]:
    import scipy.io

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings about objects, which are returned as Foreign
            _check_matlab(path)
            held: dict[str, Any] = scipy.io.loadmat(path)
    except NotImplementedError:  # version 7.3 is HDF5
        return _hdf5(path)
    return dict(_plain(name, value) for name, value in held.items() if not name.startswith("__"))


def _check_matlab(path: Path) -> None:
    """Count the bytes of the variables of a MATLAB file as dense arrays; compressed variables are expanded in parts."""
    import scipy.io

    expanded, declared = _Sizes(path), _Sizes(path)
    with path.open("rb") as file:
        order: Any = {b"IM": "little", b"MI": "big"}.get(file.read(128)[126:])
        if order is None:  # version 4, which has no compression
            listed: Any = scipy.io.whosmat(path)
            for name, shape, _ in listed:
                declared.add_array(name, shape, 8)
        while order is not None and len(tag := file.read(8)) == 8:
            kind, count = int.from_bytes(tag[:4], order), int.from_bytes(tag[4:], order)
            end = file.tell() + count
            head = tag + file.read(min(CHUNK, count))
            if kind == PACKED:
                file.seek(end - count)
                head = b""
                for part in _expanded(file, count):
                    head = head or part
                    expanded.add("a compressed variable", len(part))
            declared.add_array("a variable", _shape(head, order), 8)
            file.seek(end)


def _expanded(file: IO[bytes], count: int) -> Iterator[bytes]:
    """Yield the expanded content of the next ``count`` bytes in small parts."""
    expand = zlib.decompressobj()
    while count and (packed := file.read(min(CHUNK, count))):
        count -= len(packed)
        while packed:
            yield expand.decompress(packed, CHUNK)
            packed = expand.unconsumed_tail


def _shape(head: bytes, order: Any) -> tuple[int, ...]:
    """Return the shape of a variable of a MATLAB file from its first bytes, or (0,) if it is not an array of numbers.

    The first bytes are tags of 8 bytes, each with its data: that of the variable, its flags (8 bytes) and its shape.
    """
    words = [int.from_bytes(head[i : i + 4], order) for i in range(0, min(len(head), 256) & ~3, 4)]
    if len(words) < 10 or words[4] & 0xFF not in ARRAYS:
        return (0,)
    return tuple(words[8 : 8 + words[7] // 4])


def _plain(name: str, value: Any) -> tuple[str, Variable]:
    """Return a variable with its name, as an array or as a ``Foreign`` value."""
    import scipy.io.matlab

    if isinstance(value, scipy.io.matlab.MatlabOpaque):  # scipy gives its name as None
        named: Any = value[0]
        return str(named["s0"].decode()), Foreign(str(named["s2"].decode()))
    if hasattr(value, "toarray"):  # sparse
        return name, np.asarray(value.toarray())
    held: npt.NDArray[Any] = np.asarray(value)
    if held.dtype.kind not in "biufc":
        return name, Foreign(str(getattr(value, "classname", "struct, cell or text")))
    return name, held


def _hdf5(path: Path) -> dict[str, Variable]:
    """Return the variables of a file of version 7.3, in which matrices are stored transposed."""
    import h5py

    with h5py.File(path, "r") as file:
        opened: Any = file
        sizes = _Sizes(path)
        for name, item in opened.items():
            _check_hdf5(str(name), item, sizes)
        return {str(name): _hdf5_variable(item) for name, item in opened.items() if not name.startswith("#")}


def _check_hdf5(name: str, item: Any, sizes: _Sizes) -> None:
    """Add the bytes of a variable as a dense array, by its declared shape."""
    if name.startswith("#") or _class_of(item) not in NUMERIC:
        return
    if "MATLAB_sparse" in item.attrs:
        sizes.add_array(name, (item.attrs["MATLAB_sparse"], item["jc"].size), 8)
        for part in item.values():
            sizes.add_array(name, part.shape, 8)
        return
    sizes.add_array(name, item.shape, item.dtype.itemsize)
    if "MATLAB_empty" in item.attrs:  # its values are its shape
        sizes.add_array(name, np.asarray(item).ravel().tolist(), 8)


def _class_of(item: Any) -> str:
    """Return the MATLAB class of a variable of a file of version 7.3."""
    kind = item.attrs.get("MATLAB_class", b"struct")
    return kind.decode() if isinstance(kind, bytes) else str(kind)


def _hdf5_variable(item: Any) -> Variable:
    kind = _class_of(item)
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
    """Return a sparse matrix, which is stored by columns, as a dense array."""
    starts: npt.NDArray[Any] = np.asarray(item["jc"]).astype(np.int64)
    found = np.zeros((int(item.attrs["MATLAB_sparse"]), len(starts) - 1))
    if "data" in item:  # missing for a matrix of zeros
        found[np.asarray(item["ir"]), np.repeat(np.arange(len(starts) - 1), np.diff(starts))] = np.asarray(item["data"])
    return found


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
    """The matrices and the sampling period that a file contains."""

    # matrices by key of the problem file: A, B, E, C, D if it is not 0, W, V, Q, R, N
    arrays: dict[str, npt.NDArray[Any]]
    dt: float | None  # seconds per step, 0 for a continuous-time plant, None if the file does not specify the time base
    ignored: tuple[str, ...]  # names of the other variables in the file


def read_given(path: Path) -> Given:
    """Read a problem's matrices and sampling period from a ``.mat`` or ``.npz`` file."""
    held = read_variables(path)
    found: dict[str, npt.NDArray[Any]] = {}
    for key, names in NAMES.items():
        there = [name for name in names if name in held]
        if len(there) > 1:
            raise ProblemError(
                f"the file {path} has the variables {' and '.join(there)}; expected only one of them, since both "
                f"specify {key}"
            )
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
        raise ProblemError(
            f"the file {path} has D and no C; expected C, as a direct feedthrough adds to measured outputs"
        )
    changes = {name: _expect_array(path, name, held[name]) for name in DELAYS if name in held}
    refuse_delays(str(path), changes)
    known = {name for names in NAMES.values() for name in names} | set(changes)
    dt = found.pop("dt", None)
    return Given(found, None if dt is None else _step(path, dt), tuple(sorted(set(held) - known)))


def read_controller(place: str) -> tuple[dict[str, npt.NDArray[Any]], float | None]:
    """Read a controller's matrices and period from a file. The period is 0 in continuous time, and None if missing."""
    path, named = Path(place), ""
    if ":" in path.name:
        path, named = Path(place.rpartition(":")[0]), place.rpartition(":")[2]
    held = read_variables(path)
    if named:
        if named not in held:
            raise ProblemError(
                f"the file {path} has no variable {named}; expected one of its variables {', '.join(sorted(held))}"
            )
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
        raise ProblemError(f"the variable {name} in {path} is a {value.kind}; expected a matrix of numbers")
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
