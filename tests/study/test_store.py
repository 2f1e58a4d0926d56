"""Stores: nothing is lost, whatever dies; nothing is used that belongs to something else, or is damaged."""

from __future__ import annotations

import errno
import os
import re
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray
from counts import few

from taciturn import Cost, Problem, ProblemError, evaluate, load, sweep
from taciturn._files import PART
from taciturn.study import record as stores
from taciturn.study.record import Store, decode, encode, fingerprint, save_whole

GRID: dict[str, list[object]] = {"theta": [0.1, 1.0, 3.0], "actuation": ["hold", "model"]}
EFFORT = 3e-3


def computed(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Return the list of what is evaluated from now on."""
    from taciturn_studies import points

    seen: list[object] = []
    real = points.evaluate

    def watched(problem: Problem, **given: object) -> object:
        seen.append(problem.parameters["theta"])
        return real(problem, **given)  # type: ignore[arg-type]

    monkeypatch.setattr(points, "evaluate", watched)
    return seen


def swept(folder: Path, **given: object) -> xarray.Dataset:
    """Return the small sweep with a store."""
    return sweep(load("two-mass-lqg"), **{"over": GRID, "store": folder, "standard_error": EFFORT, **given})  # type: ignore[arg-type]


def files(folder: Path) -> list[Path]:
    """Return the files of cells that are whole."""
    return sorted(path for path in (folder / "cells").glob("*/*") if path.suffix != PART)


@pytest.mark.evidence
def test_a_second_run_computes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a larger one what is new; another seed, precision or problem everything."""
    first = swept(tmp_path)
    seen = computed(monkeypatch)
    assert swept(tmp_path).identical(first)
    assert seen == []
    swept(tmp_path, over={**GRID, "theta": [0.1, 2.0]})
    assert seen == [2.0, 2.0]
    for changed in ({"seed": 1}, {"standard_error": 2e-3}):
        before = len(seen)
        swept(tmp_path, **changed)
        assert len(seen) == before + 6
    problem = load("two-mass-lqg").changed({"cost.R": [[0.2]]})
    before = len(seen)
    with pytest.warns(UserWarning, match=r"was filled by another problem [0-9a-f]{12}, now [0-9a-f]{12}: its"):
        sweep(problem, GRID, store=tmp_path, standard_error=EFFORT)
    assert len(seen) == before + 6
    assert swept(tmp_path).identical(first)  # without a warning, as its own cells are there
    assert len(seen) == before + 6


@pytest.mark.evidence
def test_a_run_says_what_it_finds_in_its_store(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """How many of its cells, and how many others; of an empty one nothing."""
    with caplog.at_level("INFO", logger="taciturn"):
        swept(tmp_path)
        swept(tmp_path, over={**GRID, "theta": [0.1, 2.0]})
        swept(tmp_path, over={"theta": [0.1], "actuation": ["hold", "model"]}, standard_error=4e-3)
        swept(tmp_path / "alone", over={"theta": [0.1]})
        swept(tmp_path / "alone", over={"theta": [0.1]})
    others = (
        "other answers in it are for other values, or for another precision, seed, problem or version: "
        "they stay in the store, unused"
    )
    assert caplog.messages == [
        f"2 of 4 cells: read from {tmp_path}; 4 {others}",
        f"0 of 2 cells: read from {tmp_path}; 8 {others}",
        f"1 of 1 cell: read from {tmp_path / 'alone'}",
    ]


@pytest.mark.evidence
def test_another_version_computes_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the old one kept stays."""
    swept(tmp_path)
    monkeypatch.setattr("taciturn_studies.points.__version__", "0.0.9")
    seen = computed(monkeypatch)
    with pytest.warns(UserWarning, match=r"was filled by another version .*, now 0\.0\.9"):
        swept(tmp_path)
    assert len(seen) == 6
    assert len(files(tmp_path)) == 12


@pytest.mark.parametrize("damage", few(["flip", "cut", "empty", "words"], quick=1))
def test_a_damaged_cell_is_found_and_mended(damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One byte is enough, wherever it is."""
    first = swept(tmp_path)
    for turn, path in enumerate(files(tmp_path)[:3]):
        whole = path.read_bytes()
        at = (turn * len(whole)) // 3 + 7
        flipped = whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :]
        path.write_bytes({"flip": flipped, "cut": whole[:at], "empty": b"", "words": b"no cell\n{}"}[damage])
    seen = computed(monkeypatch)
    with pytest.warns(
        UserWarning, match=r"is damaged, or is the file of another cell under this name; the cell is comp"
    ):
        assert swept(tmp_path).identical(first)
    assert len(seen) == 3
    assert swept(tmp_path).identical(first)
    assert len(seen) == 3


def test_a_file_under_the_name_of_another_cell_is_not_believed(tmp_path: Path) -> None:
    """Files that were exchanged, and a copy under a name that was free: each is reported, and counts as missing."""
    store, keys = Store(tmp_path, {"problem": "1"}), ["a" * 64, "b" * 64, "c" * 64]
    for key in keys[:2]:
        store.write(key, {"cost": key})
    one, two = files(tmp_path)
    texts = one.read_bytes(), two.read_bytes()
    copy = tmp_path / "cells" / "cc" / ("c" * 62)
    copy.parent.mkdir()
    for path, text in ((one, texts[1]), (two, texts[0]), (copy, texts[0])):
        path.write_bytes(text)
    for key in keys:
        with pytest.warns(UserWarning, match=r"is damaged, or is the file of another cell under this name"):
            assert store.read(key) is None
    store.write(keys[0], {"cost": keys[0]})
    assert store.read(keys[0]) == {"cost": keys[0]}
    assert one.read_bytes() == texts[0]


def test_a_complete_store_on_a_read_only_disk_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of the problem that did not write last; a result that cannot be written is a note, and a cell an error."""
    cell: dict[str, object] = {"over": {"theta": [0.1]}, "standard_error": None, "steps": 2000}
    first = swept(tmp_path, **cell)
    sign = tmp_path / "store.json"
    sign.write_text(sign.read_text().replace(fingerprint(load("two-mass-lqg")), "0" * 64))
    before = {path: path.read_bytes() for path in tmp_path.glob("**/*") if path.is_file()}

    def refuse(path: Path, content: bytes) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    seen = computed(monkeypatch)
    monkeypatch.setattr(stores, "write_whole", refuse)
    assert swept(tmp_path, **cell).identical(first)
    assert seen == []
    note = f"{tmp_path}/result.nc is not written (Read-only file system); --table writes the results to another folder"
    assert save_whole(first, tmp_path / "result.nc") == (False, note)
    assert {path: path.read_bytes() for path in tmp_path.glob("**/*") if path.is_file()} == before
    with (
        pytest.raises(ProblemError, match=r"cannot be written to \(Read-only file system\); its results are intact"),
        pytest.warns(UserWarning, match="was filled by another problem"),
    ):
        swept(tmp_path, **cell, seed=1)
    with pytest.raises(
        ProblemError, match=r"new' cannot be used \(Read-only file system\); expected a writable folder"
    ):
        swept(tmp_path / "new", **cell)


READ_ONLY = """
set -e
mount --bind "$1" "$1"
mount -o remount,ro,bind "$1"
shift
if touch "$STORE/probe" 2> /dev/null; then exit 99; fi
exec "$@"
"""


@pytest.mark.evidence
@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root mounts")
def test_the_command_reads_a_store_on_a_read_only_mount(tmp_path: Path) -> None:
    """With result.nc, which stays as it is, and without: the numbers are printed, with exit code 0."""
    store = tmp_path / "s"
    command = [*COMMAND, "--over", "theta=0.1,1", "--standard-error", "3e-3", "--workers", "1", "--store", str(store)]
    first = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    mounted = ["unshare", "--mount", "sh", "-c", READ_ONLY, "sh", str(store), *command]
    env = os.environ | {"STORE": str(store)}
    again = subprocess.run(mounted, capture_output=True, text=True, timeout=120, check=False, env=env)
    if again.returncode in (1, 32, 99):
        pytest.skip("no rights to mount")
    assert (again.returncode, again.stdout) == (0, first.stdout)
    (store / "result.nc").unlink()
    without = subprocess.run(mounted, capture_output=True, text=True, timeout=120, check=False, env=env)
    assert (without.returncode, without.stdout) == (0, first.stdout.replace(f"result: {store}/result.nc\n", ""))
    assert f"taciturn: {store}/result.nc is not written (Read-only file system)" in without.stderr


def test_an_answer_is_the_same_after_it_was_kept() -> None:
    """Every field, a schedule and a bound included; numbers that no decimal writes in short."""
    line = load("two-mass-lqg").changed({"actuation": "model"})
    for found in (
        evaluate(load("rover"), steps=60 * 1000),
        evaluate(line, standard_error=1e-2, confidence=0.9),
    ):
        again = decode(encode(found))
        assert encode(again) == encode(found)
        assert again.document() == found.document()
        assert type(again.notes) is tuple
    assert encode({"x": np.float64(0.1), "y": np.arange(2)}) == encode({"y": np.arange(2), "x": 0.1})
    with pytest.raises(ValueError, match="not a class of result data"):
        decode(encode(load("two-mass-lqg").plant))


def test_a_fingerprint_is_of_what_is_evaluated() -> None:
    """Of a problem from a file and of one made in Python, and not of the file where Python replaced a part."""
    problem = load("two-mass-lqg")
    made = Problem(problem.plant, problem.cost, problem.network, problem.kind, problem.parameters)
    assert fingerprint(made) == fingerprint(problem)
    dearer = replace(problem, cost=Cost(problem.cost.Q, 2 * problem.cost.R))
    others = [problem.changed({"theta": 7.0}), problem.changed({"plant.dt": 0.3}), dearer]
    assert len({fingerprint(one) for one in (problem, *others)}) == 4
    assert np.array_equal(dearer.changed({"plant.dt": 0.3}).cost.R, dearer.cost.R)


def test_a_folder_that_is_no_store_is_refused(tmp_path: Path) -> None:
    """One with other files, and one that cannot be."""
    (tmp_path / "thesis.txt").write_text("do not touch")
    with pytest.raises(
        ProblemError, match=r"is not a store and contains other files, such as 'thesis.txt'; expected an empty"
    ):
        swept(tmp_path)
    with pytest.raises(ProblemError, match=r"cannot be used \(.*\); expected a writable folder"):
        swept(tmp_path / "thesis.txt" / "store")
    with pytest.raises(ProblemError, match=r"thesis.txt' is a file; expected a folder or an unused name"):
        swept(tmp_path / "thesis.txt")
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "store.json.1.part").touch()  # killed while the label was written
    Store(tmp_path / "begun", {"problem": "1"})
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "store.json").write_text("{")
    with pytest.warns(UserWarning, match=r"store.json of the store .* is damaged and is written again"):
        Store(tmp_path / "damaged", {"problem": "1"})
    Store(tmp_path / "damaged", {"problem": "1"})


COMMAND = [sys.executable, "-m", "taciturn", "sweep", "two-mass-lqg", "--over", "actuation=hold,model"]


def run_with_files_of(most: int, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run six cells where no file may have more bytes than so many."""

    def limited() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))

    command = [
        *COMMAND,
        "--over",
        "theta=0.1,1,3",
        "--store",
        str(folder),
        "--standard-error",
        "3e-3",
        "--workers",
        "1",
    ]
    whole = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}  # Python itself would keep modules cut off at the limit
    return subprocess.run(
        command, preexec_fn=limited, env=whole, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.evidence
def test_a_full_disk_is_a_sentence_and_what_was_kept_stays(tmp_path: Path) -> None:
    """A limit on the size of files stands for a disk without room; then there is room again."""
    ran = run_with_files_of(256, tmp_path / "s")
    assert ran.returncode == 2
    assert ran.stderr.startswith("taciturn: the store")
    assert "cannot be written to (File too large); its results are intact: free disk space" in ran.stderr
    assert ran.stderr.count("\n") == 1
    assert files(tmp_path / "s") == []
    sweep(load("two-mass-lqg"), {"theta": [0.1, 1.0]}, store=tmp_path / "s", standard_error=1e-2)
    assert len(files(tmp_path / "s")) == 2


@pytest.mark.evidence
def test_a_disk_that_is_full_at_the_end_is_a_sentence_too(tmp_path: Path) -> None:
    """Room for the cells, none for the whole: nothing that looks like a result is left; then there is room again."""
    ran = run_with_files_of(4096, tmp_path / "s")
    assert ran.returncode == 2
    assert re.fullmatch(
        r"taciturn: '.*result.nc' cannot be written .*; the results are in the store: free disk space.*\n", ran.stderr
    )
    assert len(files(tmp_path / "s")) == 6
    assert not list((tmp_path / "s").glob("result*"))
    assert run_with_files_of(resource.RLIM_INFINITY, tmp_path / "s").returncode == 0
    assert (tmp_path / "s" / "result.nc").is_file()


def in_a_terminal() -> None:
    """Let Ctrl-C be heard, which whoever runs the tests in the background may have had ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.evidence
def test_an_interrupted_sweep_says_where_it_goes_on(tmp_path: Path) -> None:
    """Ctrl-C reaches every process of a terminal's job; what is kept is whole, and the same command continues."""
    grid = "theta=" + ",".join(f"{0.1 + 0.01 * i:.2f}" for i in range(200))
    command = [*COMMAND, "--over", grid, "--store", str(tmp_path / "s"), "--standard-error", "2e-3", "--workers", "2"]
    running = subprocess.Popen(
        command, preexec_fn=in_a_terminal, start_new_session=True, stderr=subprocess.PIPE, text=True
    )
    while len(files(tmp_path / "s")) < 3 and running.poll() is None:
        time.sleep(0.01)
    os.killpg(running.pid, signal.SIGINT)
    _, errors = running.communicate(timeout=60)
    assert running.returncode == 130
    assert (
        errors
        == f"taciturn: interrupted; the results so far are in {tmp_path / 's'}; run the same command to continue\n"
    )
    kept = len(files(tmp_path / "s"))
    assert 3 <= kept < 400
    store = Store(tmp_path / "s", decode((tmp_path / "s" / "store.json").read_text()))
    assert all(store.read("".join(file.parts[-2:])) for file in files(tmp_path / "s"))


def test_an_interrupt_within_a_submission_ends_the_pool() -> None:
    """Work that is noted and not queued yet is not waited for."""
    text = (
        "from unittest.mock import patch\n"
        "from taciturn_studies.workers import processes\n"
        "if __name__ == '__main__':\n"
        "    with processes(2) as pool, patch.object(pool._work_ids, 'put', side_effect=KeyboardInterrupt):\n"
        "        pool.submit(abs, 1)\n"
    )
    done = subprocess.run([sys.executable, "-c", text], stderr=subprocess.PIPE, text=True, check=False, timeout=60)
    assert done.stderr.strip().endswith("KeyboardInterrupt")


@pytest.mark.evidence
def test_the_processes_of_a_killed_sweep_end(tmp_path: Path) -> None:
    """They would wait for work for ever."""
    grid = "theta=" + ",".join(f"{0.1 + 0.01 * i:.2f}" for i in range(200))
    command = [*COMMAND, "--over", grid, "--store", str(tmp_path / "s"), "--standard-error", "2e-3", "--workers", "2"]
    running = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
    while len(files(tmp_path / "s")) < 3 and running.poll() is None:
        time.sleep(0.01)
    assert session(running.pid) >= 3
    running.kill()
    running.wait()
    ended = time.monotonic()
    while session(running.pid) and time.monotonic() < ended + 30:
        time.sleep(0.1)
    assert session(running.pid) == 0


def session(leader: int) -> int:
    """Return how many processes are left of a session."""
    stats = [path.read_text().rpartition(")")[2].split() for path in Path("/proc").glob("[0-9]*/stat")]
    return sum(stat[3] == str(leader) and stat[0] != "Z" for stat in stats)


def killed_ten_times(tmp_path: Path, values: int, precision: str) -> None:
    """Kill a sweep and all its processes ten times, let it end, and compare it with one that was left alone."""
    grid = "theta=" + ",".join(f"{0.1 + 0.01 * i:.2f}" for i in range(values))
    run = [*COMMAND, "--over", grid, "--standard-error", precision, "--workers", "2", "--store"]
    draws, kept = np.random.default_rng(0), [0]
    for _ in range(10):
        process = subprocess.Popen([*run, str(tmp_path / "killed")], start_new_session=True, stderr=subprocess.DEVNULL)
        started = time.monotonic()
        while (
            len(files(tmp_path / "killed")) == kept[-1] and process.poll() is None and time.monotonic() < started + 60
        ):
            time.sleep(0.01)
        time.sleep(draws.uniform(0.0, 0.3))
        assert process.poll() is None, "the sweep ended before it could be killed: take more cells"
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        kept.append(len(files(tmp_path / "killed")))
        assert kept[-1] >= kept[-2], "a kill lost what was kept"
    for name in ("killed", "whole"):
        subprocess.run([*run, str(tmp_path / name)], check=True, capture_output=True, timeout=600)
    found = [
        xarray.open_dataset(tmp_path / name / "result.nc", engine="h5netcdf").load() for name in ("killed", "whole")
    ]
    xarray.testing.assert_identical(*found)


@pytest.mark.evidence
def test_ten_kills_leave_the_bits_of_an_uninterrupted_run(tmp_path: Path) -> None:
    """600 cells on two processes."""
    killed_ten_times(tmp_path, 300, "3e-3")
