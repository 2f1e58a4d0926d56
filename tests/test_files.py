"""Every file of the user's is opened by one function, which refuses what blocks, never ends, or fills the memory."""

from __future__ import annotations

import ast
import os
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import pytest
import xarray
from imports import nodes

import taciturn
from taciturn import ProblemError, load
from taciturn._files import read_bytes
from taciturn.cli.frame import _links
from taciturn.nodes.keys import read_keys
from taciturn.problem import parse
from taciturn.problem.matlab_and_numpy import read_variables
from taciturn.program import machine
from taciturn.study.record import Store, save_whole
from taciturn_twins.control import read_eye
from taciturn_udp.service import FileStorage

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders here")
SEEN = 30  # seconds after which a test that waits for the other end of a pipe fails
TABLES = {
    "plant": {"A": [[1.0]], "B": [[1.0]], "W": [[0.01]], "dt": 1.0},
    "cost": {"Q": [[1.0]], "R": [[1.0]]},
    "policy": {"kind": "excess", "theta": 0.1},
}
SOURCE = Path(taciturn.__file__).parent.parent
OWN = {  # files that the library itself wrote or contains, or of the operating system
    "bench.py": "/proc/cpuinfo",
    "bundle.py": "files of pages of this package",
    "cortex.py": "C files of this package",
    "devices.py": "C files of this package",
    "fmu.py": "C files of this package",
    "folder.py": "C files of this package, and the first line of regular files",
    "kind.py": "Python files of installed packages",
    "live.py": "a picture of a process that it started",
    "logs.py": "logs of processes that it started, and logs, which it writes",
    "namespaces.py": "/proc",
    "without_file.py": "a problem of the process that started this one",
    "record.py": "tables, which it writes",
    "rover.py": "models of this package",
    "guard.py": "files of pages of this package",
    "workers.py": "Python files of this package",
    "steps.py": "logs of processes that it started",
    "matlab_and_numpy.py": "after check_regular, by the libraries of these formats",
}


@pytest.fixture(autouse=True)
def awake() -> Iterator[None]:
    """Fail, instead of waiting for ever."""

    def fail(number: int, frame: FrameType | None) -> None:
        raise AssertionError("it waits")

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(SEEN)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def timetable(path: Path) -> object:
    """Read a file of set-points."""
    return parse({**TABLES, "reference": {"file": str(path)}}, "x")


def function(path: Path) -> object:
    """Read a file with the function of a plant."""
    return parse({**TABLES, "plant": {**TABLES["plant"], "function": f"{path}:f"}}, "x")


def label(path: Path) -> object:
    """Open a store with this label."""
    store = path.parent / "store"
    store.mkdir()
    path.rename(store / "store.json")
    return Store(store, {"problem": "1"})


def result(path: Path) -> object:
    """Replace a result."""
    return save_whole(xarray.Dataset({"cost": ("x", [1.0])}), path)


REFUSED: dict[str, Callable[[Path], object]] = {
    "problem": load,
    "timetable": timetable,
    "function": function,
    "matrices": lambda path: read_variables(path.rename(path.with_suffix(".mat"))),
    "keys": read_keys,
    "state": lambda path: FileStorage(path).read(),
    "label": label,
    "result": result,
    "calibration": read_eye,
}


@pytest.mark.parametrize("read", REFUSED.values(), ids=REFUSED)
def test_a_pipe_is_refused_in_a_sentence_and_not_waited_for(read: Callable[[Path], object], tmp_path: Path) -> None:
    """Nobody writes to it."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with pytest.raises(ProblemError, match=r"it is not a regular file"):
        read(path)


@pytest.mark.parametrize("name", [name for name in REFUSED if name not in ("label", "result", "matrices")])
def test_a_device_and_a_file_larger_than_the_memory_are_refused(name: str, tmp_path: Path) -> None:
    """Of a terabyte of zeros that takes no room on the disk nothing is read beyond the limit."""
    bomb = tmp_path / "bomb"
    with bomb.open("wb") as file:
        file.truncate(2**40)
    bomb.chmod(0o600)
    with pytest.raises(ProblemError, match=r"it has more than [0-9,]+ bytes"):
        REFUSED[name](bomb)
    (tmp_path / "device").symlink_to("/dev/zero")
    with pytest.raises(ProblemError, match="it is not a regular file"):
        REFUSED[name](tmp_path / "device")


@pytest.mark.parametrize("name", ["problem", "timetable", "function", "keys"])
def test_text_in_another_encoding_is_refused(name: str, tmp_path: Path) -> None:
    """Also one that a library would unpack."""
    path = tmp_path / "text.csv.gz"
    for content in ("0, 1".encode("utf-16"), b"\x1f\x8b"):
        path.write_bytes(content)
        path.chmod(0o600)
        with pytest.raises(ProblemError, match="it is not UTF-8 text"):
            REFUSED[name](path)


def test_a_pipe_among_the_cells_and_the_compiled_programs_is_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As any other damaged file there."""
    store, key = Store(tmp_path / "store", {"problem": "1"}), "a" * 64
    store.write(key, {"cost": 1.0})
    (cell,) = (tmp_path / "store").glob("cells/*/*")
    cell.unlink()
    os.mkfifo(cell)
    with pytest.warns(UserWarning, match="is damaged"):
        assert store.read(key) is None
    store.write(key, {"cost": 1.0})
    assert store.read(key) == {"cost": 1.0}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = machine.cache_folder()
    assert folder is not None
    os.mkfifo(folder / "a.o", 0o600)
    assert machine.read_code(folder, "a") is None
    machine.write_code(folder, "a", b"code", 9)
    assert machine.read_code(folder, "a") == b"code"


def test_a_label_nested_deeply_is_damaged(tmp_path: Path) -> None:
    """100,000 brackets are no traceback."""
    (tmp_path / "store.json").write_text("[" * 100_000)
    with pytest.warns(UserWarning, match=r"store.json of the store .* is damaged and is written again"):
        Store(tmp_path, {"problem": "1"})


def test_completion_reads_no_more_than_a_problem_file(tmp_path: Path) -> None:
    """A shell asks for it at each key."""
    path = tmp_path / "bomb.toml"
    with path.open("wb") as file:
        file.truncate(2**40)
    assert list(_links(str(path))) == []
    path.write_text("A = " + "[" * 5000)
    assert list(_links(str(path))) == []


def test_a_pipe_that_takes_the_place_of_a_checked_file_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was opened is checked, not what had the name before."""
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr("taciturn._files.check_regular", lambda path: None)
    with pytest.raises(OSError, match="it is not a regular file"):
        read_bytes(tmp_path / "pipe", 10)


@pytest.mark.parametrize("value", [r"C:\new.csv", r"C:\Users\new.csv", r"C:\data\new.csv"])
def test_a_windows_path_in_double_quotes_is_answered_with_the_backslash(tmp_path: Path, value: str) -> None:
    r"""``\n`` is a new line in TOML, ``\U`` a wrong letter and ``\d`` an unknown escape."""
    path = tmp_path / "p.toml"
    text = "[plant]\nA = [[1.0]]\nB = [[1.0]]\nW = [[0.01]]\ndt = 1.0\n[cost]\nQ = [[1.0]]\nR = [[1.0]]\n[policy]\n"
    text += "kind = 'excess'\ntheta = 0.1\n"
    path.write_text(f'{text}[reference]\nfile = "{value}"\n')
    with pytest.raises(ProblemError, match="a backslash in double quotes is an escape in TOML: write C:/folder/file"):
        load(path)
    path.write_text(f"{text}[reference]\nfile = '{value}'\n")
    with pytest.raises(ProblemError, match="No such file") as refused:
        load(path)
    assert "double quotes" not in str(refused.value)


def test_no_module_opens_a_file_of_the_user_by_itself() -> None:
    """All others are files of the library itself, and the list of them is complete."""
    found = set[str]()
    openers = re.compile(r"(^|\.)(open|loadtxt|genfromtxt|fromfile|loadmat|load)$|\.read_(text|bytes)$")
    for path in SOURCE.glob("taciturn*/**/*.py"):
        for node in nodes(path):
            if not isinstance(node, ast.Call) or path.name == "_files.py":
                continue
            name = f".{node.func.attr}" if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if openers.search(name):  # to write a call as text takes most of the time
                called = ast.unparse(node.func)
                mode = "".join(ast.unparse(one) for one in node.args[:1])
                ours = called.rpartition(".")[0] in ("taciturn", "entry", "json", "pickle", "os", "tomllib")
                if not ours and "x" not in mode and called not in ("load", "self.load", "webbrowser.open"):
                    found.add(path.name)
    assert found == set(OWN)
