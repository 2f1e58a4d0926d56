"""``taciturn new --from``: matrices that MATLAB and NumPy wrote, and what of theirs is refused."""

from __future__ import annotations

import io
import struct
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse
from cli.conftest import Answer, Run

import taciturn

A, B, C = [[0.9, 0.2], [0.0, 1.1]], [[0.0], [1.0]], [[1.0, 0.0]]
WHOLE: Mapping[str, Any] = {
    "A": A,
    "B": B,
    "C": C,
    "W": [[0.1, 0.02], [0.02, 0.1]],
    "V": 0.01,
    "Q": [[1.0, 2.0]],
    "R": 3.0,
    "N": [[0.1], [0.2]],
    "dt": 0.5,
}


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in a folder of its own, with nobody to answer."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO())


def write(name: str, variables: Mapping[str, Any]) -> str:
    """Write a file by its ending; ``.v73.mat`` as MATLAB does from version 7.3 on: HDF5, matrices by columns."""
    if name.endswith(".npz"):
        np.savez(name, **variables)
    elif not name.endswith(".v73.mat"):
        scipy.io.savemat(name, dict(variables))
    else:
        with h5py.File(name, "w", userblock_size=512) as file:
            for key, value in variables.items():
                item = file.create_dataset(key, data=np.atleast_2d(value).T)
                item.attrs["MATLAB_class"] = np.bytes_("double")
        header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + struct.pack("<H", 0x0200) + b"IM"
        with Path(name).open("r+b") as opened:
            opened.write(header.ljust(512, b"\0"))
    return name


def tables(run: Run, *arguments: str) -> dict[str, Any]:
    """Return what ``taciturn new`` wrote from a file."""
    told = run("new", "new.toml", "--yes", "--from", *arguments)
    assert (told.code, told.err) == (0, "")
    return tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["plant.mat", "plant.v73.mat", "plant.npz", "plant.NPZ"])
def test_all_formats_give_the_same_problem(run: Run, name: str) -> None:
    """A is no matrix whose transpose would do as well; a vector is a diagonal, a number times the identity."""
    written = tables(run, write(name, WHOLE) if name.islower() else str(Path(write(name.lower(), WHOLE)).rename(name)))
    assert written == {
        "plant": {"dt": 0.5, "A": A, "B": B, "C": C, "V": [[0.01]], "W": WHOLE["W"]},
        "cost": {"Q": [[1, 0], [0, 2]], "R": [[3]], "N": [[0.1], [0.2]]},
        "policy": {"kind": "excess", "theta": 0.1, "actuation": "model"},
    }
    assert taciturn.load("new.toml").design().kind == "excess"


def test_names_of_papers_and_of_matlab_are_known(run: Run) -> None:
    """Φ_w and Φ_v, and Ts, of which 0 is continuous; a step that is asked for must not contradict it."""
    named = {key: value for key, value in WHOLE.items() if key not in ("W", "V", "dt")} | {"Phi_w": 0.1, "Phi_v": 0.01}
    written = tables(run, write("ss.mat", {**named, "Ts": 0.0, "D": [[0.0]]}), "--kind", "excess")
    assert "dt" not in written["plant"]
    assert (written["plant"]["W"], written["plant"]["V"]) == ([[0.1, 0], [0, 0.1]], [[0.01]])
    assert set(written["policy"]) == {"kind", "period", "theta", "actuation"}
    Path("new.toml").unlink()
    assert tables(run, write("no.mat", named), "--dt", "0.2")["plant"]["dt"] == 0.2
    Path("new.toml").unlink()
    told = run("new", "new.toml", "--from", "ss.mat", "--dt", "0.2")
    assert told.sentence == "--dt is 0.2, but the time base in ss.mat is 0; expected the same value, or no --dt"


def test_what_else_a_file_holds_is_said(run: Run) -> None:
    """Numbers, texts, structures; nothing of it is used."""
    write("more.mat", {**WHOLE, "x0": [1, 2], "note": "hello", "s": {"A": 5}, "a": 7})
    told = run("new", "new.toml", "--yes", "--from", "more.mat")
    assert told.out.splitlines()[0] == "ignored in more.mat: a, note, s, x0"


@pytest.mark.parametrize("name", ["plant.mat", "plant.npz"])
def test_a_feedthrough_is_written_with_a_note(run: Run, name: str) -> None:
    """Its input is that of the step before; a zero one is none."""
    told = run("new", "new.toml", "--yes", "--from", write(name, {**WHOLE, "D": [[0.5]]}))
    assert told.out.splitlines()[0] == (
        f"D in {name} is read as a direct feedthrough: y = C x + D u + v, with the input u of the step before, as each "
        "sample is taken before the input changes"
    )
    text = Path("new.toml").read_text(encoding="utf-8")
    assert "y = C x + v + D u, u of the step before" in text
    assert tomllib.loads(text)["plant"]["D"] == [[0.5]]
    assert taciturn.load("new.toml").design().model.registers == (0,)
    Path("new.toml").unlink()
    assert "D" not in tables(run, write(name, {**WHOLE, "D": [[0.0]]}))["plant"]


def test_what_is_missing_is_asked(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """And nothing else: not A, B, the time base or Q."""
    write("part.mat", {"A": A, "B": B, "Q": 1, "Ts": 0.1})
    monkeypatch.setattr(sys, "stdin", io.StringIO("all\n0\n0.5\nlqg\n4\n\n\n\n"))
    told = run("new", "new.toml", "--from", "part.mat")
    assert told.code == 0
    asked = [line.split(",")[0].split(":")[0] for line in told.out.splitlines() if "]: " in line][:5]
    assert asked == [
        "Measured signals", "Noise of each measurement", "Noise that acts on the states", "Controller",
        "Acceptable size of each input",
    ]  # fmt: skip
    written = tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))
    assert (written["plant"]["W"][0][0], written["cost"]["R"]) == (0.25, [[0.0625]])


def test_noise_without_an_output_is_on_every_state(run: Run) -> None:
    """y = x + v."""
    written = tables(run, write("noisy.npz", {key: value for key, value in WHOLE.items() if key != "C"}))
    assert (written["plant"]["C"], written["plant"]["V"]) == ([[1, 0], [0, 1]], [[0.01, 0], [0, 0.01]])


def test_sparse_matrices_are_read_with_their_zeros(run: Run) -> None:
    """Of both versions of MATLAB's format."""
    sparse = scipy.sparse.csc_array(np.array(A))
    written = tables(run, write("sparse.mat", {**WHOLE, "A": sparse}))
    assert written["plant"]["A"] == A
    write("sparse.v73.mat", {key: value for key, value in WHOLE.items() if key != "A"})
    with h5py.File("sparse.v73.mat", "r+") as file:
        group = file.create_group("A")
        group.attrs["MATLAB_class"], group.attrs["MATLAB_sparse"] = np.bytes_("double"), np.uint64(2)
        group["data"], group["ir"], group["jc"] = sparse.data, sparse.indices.astype("u8"), sparse.indptr.astype("u8")
    Path("new.toml").unlink()
    assert tables(run, "sparse.v73.mat")["plant"]["A"] == A


def opaque(name: str, kind: str) -> bytes:
    """Return a file of version 5 that holds an object of a class, as MATLAB writes it: its content lies elsewhere."""

    def element(code: int, content: bytes) -> bytes:
        return struct.pack("<II", code, len(content)) + content.ljust(-(-len(content) // 8) * 8, b"\0")

    content = struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 1)
    inside = (
        element(6, struct.pack("<II", 13, 0))
        + element(5, struct.pack("<ii", 6, 1))
        + element(1, b"")
        + element(6, content)
    )
    words = b"".join(element(1, word.encode()) for word in (name, "MCOS", kind))
    whole = element(6, struct.pack("<II", 17, 0)) + words + element(14, inside)
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM" + element(14, whole)


@pytest.mark.parametrize("name", ["sys.mat", "sys.v73.mat"])
def test_a_system_object_is_refused_with_the_remedy(run: Run, name: str) -> None:
    """Only MATLAB opens it; its matrices are two lines away."""
    if name == "sys.mat":
        Path(name).write_bytes(opaque("sys", "ss"))
    else:
        write(name, {"Ts": 0.1})
        with h5py.File(name, "r+") as file:
            file.create_dataset("note", data=np.zeros((1, 2), "u2")).attrs["MATLAB_class"] = np.bytes_("char")
            item = file.create_dataset("sys", data=np.zeros((1, 6), "u4"))
            item.attrs["MATLAB_class"], item.attrs["MATLAB_object_decode"] = np.bytes_("ss"), np.int32(3)
    assert run("new", "new.toml", "--yes", "--from", name).sentence == (
        f"sys in {name} is an object of the MATLAB class ss, which only MATLAB can open; expected its matrices: "
        f"[A, B, C, D] = ssdata(sys); Ts = sys.Ts; save('{name}', 'A', 'B', 'C', 'D', 'Ts')"
    )


def test_a_system_object_beside_its_matrices_is_ignored(run: Run) -> None:
    """What is needed is there."""
    write("both.mat", WHOLE)
    content = Path("both.mat").read_bytes()
    Path("both.mat").write_bytes(content + opaque("sys", "ss")[128:])
    assert "ignored in both.mat: sys" in run("new", "new.toml", "--yes", "--from", "both.mat").out


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"W": None, "R": None, "dt": None}, "the file plant.npz lacks W, R, dt (or Ts; 0 for continuous time)"),
        ({"D": [[0.5], [0.5]]}, "plant.npz: D has shape (2, 1); expected the shape (1, 1) = (outputs, inputs)"),
        ({"D": [[0.0, 0.0, 0.0]]}, "plant.npz: D has shape (1, 3); expected the shape (1, 1) = (outputs, inputs)"),
        ({"E": np.eye(3)}, "plant.npz: E has shape (3, 3); expected the shape (2, 2) = (states, states)"),
        ({"C": None, "D": [[0.5]]}, "the file plant.npz has D and no C; expected C, as a direct feedthrough adds to"),
        ({"Phi_w": 1.0}, "the file plant.npz has the variables W and Phi_w; expected only one of them, since both"),
        ({"dt": None, "Ts": -1.0}, "the time base in plant.npz is -1; expected the seconds per step, or 0 for a"),
        ({"dt": [0.1, 0.2]}, "the time base in plant.npz is an array of shape (2,); expected the seconds per step"),
        ({"A": [[1.0, 2.0]]}, "plant.npz: A has shape (1, 2); expected a square matrix with at least one state"),
        ({"A": [[1j, 0], [0, 1]]}, "plant.npz: A is not an array of numbers (it contains complex128 values); expected"),
        ({"A": [[np.nan, 0], [0, 1]]}, "plant.npz: A contains the number nan at index (0, 0); expected an array"),
        ({"A": "text"}, "the variable A in plant.npz is a text or structure; expected a matrix of numbers"),
        ({"A": np.array([None])}, "the variable A in plant.npz is a pickled object; expected a matrix of numbers"),
        ({"B": [0.0, 1.0]}, "plant.npz: B has shape (2,); expected the shape (2, any) = (states, inputs)"),
        ({"Q": [[1.0, 2.0, 3.0]]}, "plant.npz: Q is a matrix of size 1×3; expected one number, 2 numbers for a"),
        ({"W": [[1.0, 2.0], [3.0, 4.0]]}, "plant.npz: W is not symmetric"),
        ({"N": [[9.0], [9.0]]}, "plant.npz: [[Q, N], [N', R]] has the eigenvalue"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_one_sentence(run: Run, changes: dict[str, Any], sentence: str) -> None:
    """That names the file, and nothing is written."""
    write("plant.npz", {key: value for key, value in {**WHOLE, **changes}.items() if value is not None})
    assert run("new", "new.toml", "--yes", "--from", "plant.npz").sentence.startswith(sentence)
    assert not Path("new.toml").exists()


def test_what_cannot_be_read_is_one_sentence(run: Run) -> None:
    """Files that are not there, are cut short, or are something else."""

    def told(name: str) -> Answer:
        return run("new", "new.toml", "--yes", "--from", name)

    Path("empty.mat").write_bytes(b"")
    Path("text.mat").write_text("A = [1 2]\n" * 50, encoding="utf-8")
    Path("text.npz").write_text("A = [1 2]", encoding="utf-8")
    for name in ("plant.mat", "plant.v73.mat", "plant.npz"):
        whole = Path(write(name, WHOLE)).read_bytes()
        Path(f"cut.{name}").write_bytes(whole[: len(whole) // 2])
    for path in sorted(Path().glob("[ect]*")):
        assert told(str(path)).sentence.startswith(f"the file '{path}' cannot be read (")
    assert (
        told("no.mat").sentence
        == "the file 'no.mat' cannot be read (No such file or directory); expected a matrix file"
    )
    assert told("a").sentence == "'a' has no ending; expected a matrix file that ends in .mat or .npz"
    assert told("a.csv").sentence == "'a.csv' ends in '.csv'; expected a matrix file that ends in .mat or .npz"


@pytest.mark.parametrize("name", ["given.mat", "given.npz", "given.v73.mat"])
def test_a_descriptor_matrix_is_kept_and_a_delay_is_not_ignored(run: Run, name: str) -> None:
    """E x⁺ = A x + B u has other poles than A, and a delay other dynamics; an identity and zeros change nothing."""
    E = np.diag([0.5, 1.0])
    write(name, {**WHOLE, "E": E})
    found = tables(run, name)
    assert (found["plant"]["A"], found["plant"]["E"]) == (A, E.tolist())
    np.testing.assert_array_equal(taciturn.load("new.toml").plant.A, np.linalg.inv(E) @ A)
    Path("new.toml").unlink()
    write(name, {**WHOLE, "E": np.zeros((2, 2))})
    assert "E is singular: its rank is 0 for 2 states" in run("new", "other.toml", "--yes", "--from", name).sentence
    write(name, {**WHOLE, "InputDelay": 2.0})
    assert (
        f"{name} has InputDelay [2.0]; expected a system without delays"
        in run("new", "made.toml", "--from", name).sentence
    )
    write(name, {**WHOLE, "E": np.eye(2), "InputDelay": 0.0})
    found = tables(run, name)
    assert found["plant"]["A"] == A
