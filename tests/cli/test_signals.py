"""Every command ends within two seconds of a signal, with its exit code and one line on standard error."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import pytest
from terminals import in_a_terminal

from taciturn import load, sweep

LONG = ["--standard-error", "1e-8"]
GRID = ["--over", "theta=0.01,0.02,0.05,0.1,0.2,0.5,1,2"]
COMMANDS: dict[str, tuple[float, list[str]]] = {  # seconds until the signal, and arguments
    "evaluate": (2.0, ["evaluate", "two-mass", *LONG]),
    "simulate": (3.0, ["simulate", "two-mass", "--steps", "10000000"]),
    "tradeoff": (3.0, ["tradeoff", "two-mass", *GRID, *LONG]),
    "tradeoff with workers": (4.0, ["tradeoff", "two-mass", *GRID, *LONG, "--workers", "2"]),
    "tune": (3.0, ["tune", "two-mass", "--rate", "0.3", *LONG]),
    "compare": (3.0, ["compare", "two-mass", "two-mass-lqg", "--rate", "0.3", *LONG]),
    "sweep": (3.0, ["sweep", "two-mass", *GRID, *LONG, "--store", "cells", "--workers", "1"]),
    "sweep with workers": (6.0, ["sweep", "two-mass", *GRID, *LONG, "--store", "cells", "--workers", "2"]),
    "certify": (1.0, ["certify", "two-mass"]),
    "channel": (3.0, ["channel", "wiener-double-integrator", "--copies", "500", "--capacity", "60", *LONG]),
    "channel with workers": (
        3.0, ["channel", "wiener-double-integrator", "inverted-pendulum", "--copies", "500", "--capacity", "60",
              *LONG, "--workers", "2"],
    ),
    "network": (4.0, ["network", "two-mass", "--steps", "1000000"]),
    "network in real time": (4.0, ["network", "two-mass", "--steps", "100000", "--real-time"]),
    "node": (2.0, ["node", "controller", "two-mass", "--peer", "127.0.0.1:9", "--plant", "127.0.0.1:9"]),
    "relay": (1.5, ["relay", "--peer", "127.0.0.1:9"]),
    "plant": (2.0, ["plant", "two-mass", "--peer", "127.0.0.1:9", "--steps", "100000"]),
    "camera": (3.0, ["camera", "rover", "rover", "--peer", "127.0.0.1:9"]),
    "export": (0.5, ["export", "two-mass", "--c", "c"]),
    "twin": (4.0, ["twin", "rover"]),
    "twin, live": (4.0, ["twin", "rover", "--live", "--bind", "127.0.0.1:0"]),
    "reproduce": (3.0, ["reproduce", "--out", "pictures"]),
    "bench": (3.0, ["bench", "--rounds", "100"]),
    "new": (1.5, ["new", "mine.toml"]),
    "show": (0.2, ["show", "two-mass"]),
}  # fmt: skip
POLITE = ("listens on", "the page is at", "waits for")  # lines that were printed before the signal

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="handlers are read from /proc")


def handles_signals(process: int) -> bool:
    """Return whether a process has handlers, which it has as soon as this package is imported."""
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    except OSError:
        return True
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)


def heard(arguments: Sequence[str], seconds: float, numbers: Sequence[signal.Signals], at: Path) -> tuple[int, str]:
    """Return exit code and standard error of a command that receives signals like the job of a terminal."""
    with subprocess.Popen(
        [sys.executable, "-m", "taciturn", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        cwd=at,
        start_new_session=True,
        preexec_fn=in_a_terminal,
    ) as running:
        while not handles_signals(running.pid):
            time.sleep(0.001)
        time.sleep(seconds)
        assert running.poll() is None, "the command has ended before the signal"
        for number in numbers:
            os.killpg(running.pid, number)
            time.sleep(0.02)
        began = time.monotonic()
        running.wait(60)
        took = time.monotonic() - began
        assert took < 2.0, f"the command took {took:.1f} s to end"
        _, errors = running.communicate()
    return running.returncode, "".join(
        line for line in errors.splitlines(keepends=True) if not any(word in line for word in POLITE)
    )


@pytest.mark.evidence
@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_ends_every_command(name: str, tmp_path: Path) -> None:
    """Within two seconds, with exit code 130 and one line."""
    seconds, arguments = COMMANDS[name]
    code, told = heard(arguments, seconds, [signal.SIGINT], tmp_path)
    assert code == 130, told
    assert told.startswith("taciturn: interrupted")
    assert told.count("\n") == 1


@pytest.mark.evidence
@pytest.mark.parametrize("name", ["evaluate", "sweep with workers", "network", "node", "twin, live", "new", "simulate"])
@pytest.mark.parametrize(("number", "code"), [("SIGTERM", 143), ("SIGHUP", 129)])
def test_the_end_of_a_session_ends_a_command(name: str, number: str, code: int, tmp_path: Path) -> None:
    """The same for SIGTERM and SIGHUP, which reach every process of the job."""
    seconds, arguments = COMMANDS[name]
    found, told = heard(arguments, seconds, [signal.Signals[number]], tmp_path)
    assert found == code, told
    assert told.startswith(f"taciturn: ended by {number}")
    assert told.count("\n") == 1


@pytest.mark.evidence
@pytest.mark.parametrize("name", ["simulate", "sweep with workers", "network in real time", "twin, live"])
def test_a_second_ctrl_c_prints_no_traceback(name: str, tmp_path: Path) -> None:
    """It ends the command at once."""
    seconds, arguments = COMMANDS[name]
    code, told = heard(arguments, seconds, [signal.SIGINT] * 2, tmp_path)
    assert (code, told.count("\n")) == (130, 1), told
    assert told.startswith("taciturn: interrupted")


def test_a_relay_ends_with_the_code_of_the_signal(tmp_path: Path) -> None:
    """The quick case of the tables above: a server, which prints its report first."""
    with subprocess.Popen(
        [sys.executable, "-m", "taciturn", "relay", "--peer", "127.0.0.1:9"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        assert running.stderr is not None
        assert running.stdout is not None
        assert "listens on" in running.stderr.readline()
        running.send_signal(signal.SIGTERM)
        assert '"role": "relay"' in running.stdout.read()
        assert running.stderr.read() == "taciturn: ended by SIGTERM\n"
        assert running.wait(20) == 143


class Eager(Executor):
    """Answers each block when it is submitted, as workers do while the main process is busy."""

    def submit(self, function: Any, /, *arguments: Any, **options: Any) -> Future[Any]:
        """Return the answer."""
        found: Future[Any] = Future()
        found.set_result(function(*arguments, **options))
        return found


def test_an_interrupted_sweep_stores_the_cells_that_have_arrived(tmp_path: Path) -> None:
    """Also those whose turn had not come."""

    def interrupt(fraction: float) -> None:
        raise KeyboardInterrupt

    thetas = [0.1, 0.2, 0.3, 0.4, 0.5]
    with pytest.raises(KeyboardInterrupt):
        sweep(load("two-mass-lqg"), {"theta": thetas}, executor=Eager(), steps=2000, store=tmp_path, progress=interrupt)
    assert len([file for file in tmp_path.rglob("*") if file.is_file() and file.name != "store.json"]) >= 3
