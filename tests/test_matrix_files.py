"""Matrix files are refused by the sizes that they declare, before they fill the memory."""

from __future__ import annotations

import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse

from taciturn.errors import ProblemError
from taciturn.problem import matlab_and_numpy
from taciturn.problem.matlab_and_numpy import Foreign, read_variables

MANY = 20_000  # rows and columns: 3.2 GB of numbers


def npy(shape: tuple[int, ...], kind: str = "<f8") -> bytes:
    """Return the header of an array in a NumPy file."""
    text = repr({"descr": kind, "fortran_order": False, "shape": shape}).ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def zeros(path: Path) -> None:
    """Write an array of zeros, which is compressed a thousand times, without expanding it here."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed, packed.open("A.npy", "w") as file:
        file.write(npy((1000, 1000)) + bytes(8 * 1000**2))


def declared(path: Path) -> None:
    """Write the header of a large array without its numbers."""
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("A.npy", npy((MANY, MANY)))


def long_header(path: Path) -> None:
    """Write a header of 8 MB."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed, packed.open("A.npy", "w") as file:
        file.write(b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**23) + b" " * 2**23)


def element(kind: int, shape: tuple[int, int], count: int) -> bytes:
    """Return the beginning of an uncompressed variable of a MATLAB file, of a class with the given number."""
    body = struct.pack("<IIIIIIii", 6, 8, kind, 0, 5, 8, *shape) + struct.pack("<HH4s", 1, 1, b"A\0\0\0")
    return struct.pack("<II", 14, len(body) + count) + body


def packed(path: Path) -> None:
    """Write a compressed variable, of which 8 MB are there."""
    expand = zlib.compressobj(1)
    content = expand.compress(element(6, (MANY, MANY), 8 * MANY * MANY) + struct.pack("<II", 9, 8 * MANY * MANY))
    content += expand.compress(bytes(2**23)) + expand.flush()
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    path.write_bytes(head + struct.pack("<II", 15, len(content)) + content)


def structure(path: Path) -> None:
    """Write a compressed structure, whose shape is small."""
    expand = zlib.compressobj(1)
    content = expand.compress(element(2, (1, 1), 2**23))
    content += expand.compress(bytes(2**23)) + expand.flush()
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    path.write_bytes(head + struct.pack("<II", 15, len(content)) + content)


def sparse(path: Path, compress: bool = True) -> None:
    """Write a sparse matrix with one number."""
    scipy.io.savemat(path, {"A": scipy.sparse.csc_matrix(([1.0], ([0], [0])), (MANY, MANY))}, do_compression=compress)


def old(path: Path) -> None:
    """Write it in version 4."""
    scipy.io.savemat(path, {"A": scipy.sparse.csc_matrix(([1.0], ([0], [0])), (MANY, MANY))}, format="4")


def hdf5(path: Path) -> None:
    """Write a dataset of zeros that were never stored."""
    with h5py.File(path, "w", userblock_size=512) as file:
        item = file.create_dataset("A", (MANY, MANY), "f8", chunks=(100, 100))
        item.attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as opened:
        opened.write((b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<H", 0x0200) + b"IM").ljust(512, b"\0"))


WRITERS = {
    "zeros.npz": zeros,
    "declared.npz": declared,
    "long header.npz": long_header,
    "packed.mat": packed,
    "structure.mat": structure,
    "sparse.mat": sparse,
    "plain sparse.mat": lambda path: sparse(path, False),
    "version 4.mat": old,
    "version 7.3.mat": hdf5,
}


@pytest.fixture
def measured() -> Iterator[None]:
    """Measure the memory that Python and NumPy allocate."""
    tracemalloc.start()
    yield
    tracemalloc.stop()


@pytest.mark.usefixtures("measured")
@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_expands_is_refused_before_it_does(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its size and the limit, and not as a pickled object; the file itself is small."""
    monkeypatch.setattr(matlab_and_numpy, "LARGEST", 2**20)
    write: Callable[[Path], object] = WRITERS[name]
    write(tmp_path / name)
    assert (tmp_path / name).stat().st_size < 2**20
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    with pytest.raises(
        ProblemError, match=r"expands to [\d,]+ bytes or more \(counted up to .*\); expected at most 1,048,576"
    ):
        read_variables(tmp_path / name)
    assert tracemalloc.get_traced_memory()[1] - before < 2e6


def test_the_limit_is_far_beyond_what_designs_can_compute(tmp_path: Path) -> None:
    """Three megabytes that declare 3.2 GB are beyond it; 4000 states are not."""
    declared(tmp_path / "a.npz")
    with pytest.raises(ProblemError, match=r"expands to 3,200,000,000 bytes .* expected at most 134,217,728"):
        read_variables(tmp_path / "a.npz")
    assert matlab_and_numpy.LARGEST > 8 * 4000**2


def test_objects_are_recognised_by_their_header(tmp_path: Path) -> None:
    """They are not loaded; numbers in the same file are."""
    np.savez(tmp_path / "a.npz", A=np.eye(2), B=np.array([{}, None], dtype=object), C=np.array("text"))
    found = read_variables(tmp_path / "a.npz")
    assert np.array_equal(found["A"], np.eye(2))  # pyright: ignore[reportArgumentType]
    assert (found["B"], found["C"]) == (Foreign("pickled object"), Foreign("text or structure"))


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("kind", ["f8", "f4", "i2", "u1", "c16", "?"])
def test_all_types_of_numbers_are_read(tmp_path: Path, kind: str, compress: bool) -> None:
    """Sizes are counted without an error for every class, byte order and structure."""
    whole = {"A": np.ones((30, 20), kind), "s": {"x": np.ones(3)}, "c": np.array([[1], "b"], dtype=object), "t": "text"}
    whole["S"] = scipy.sparse.eye(5, format="csc")
    scipy.io.savemat(tmp_path / "a.mat", whole, do_compression=compress)
    found = read_variables(tmp_path / "a.mat")
    assert np.array_equal(found["A"], whole["A"])  # pyright: ignore[reportArgumentType]
    assert np.array_equal(found["S"], np.eye(5))  # pyright: ignore[reportArgumentType]
