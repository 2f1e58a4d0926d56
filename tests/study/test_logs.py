"""The logs of a run are read while it goes on, and take a bounded space."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from taciturn_udp import logs, run
from taciturn_udp.logs import Logs, logged, name_of_part
from taciturn_udp.processes import Processes
from taciturn_udp.run import run_network


def line(tick: int) -> dict[str, Any]:
    """Return an entry of a log: a node sends every third step, and receives what it sent."""
    return {"tick": tick, "sent_actuator": int(tick % 3 == 0), "arrived_actuator": [tick] if tick % 3 == 0 else []}


def test_a_log_is_written_in_parts_that_are_read_by_another_process(tmp_path: Path) -> None:
    """There are at most two files; without a reader nothing is lost."""
    path, read = tmp_path / "node.jsonl", list[int]()
    with logged(str(path), 1000) as told:
        assert told is not None
        for tick in range(500):
            told(line(tick))
            if tick % 20 == 19:  # the reader
                assert sum(file.stat().st_size for file in tmp_path.iterdir()) < 3500
                part = name_of_part(path)
                if part.exists():
                    read += [json.loads(text)["tick"] for text in part.read_text().splitlines()]
                    part.unlink()
        kept = len(read)
        for tick in range(500, 600):
            told(line(tick))
    for file in (name_of_part(path), path):
        read += [json.loads(text)["tick"] for text in file.read_text().splitlines()]
    assert 400 < kept < 500
    assert read == list(range(600))


def test_a_log_without_parts_is_one_file(tmp_path: Path) -> None:
    """As a user asks for it."""
    with logged(str(tmp_path / "log")) as told:
        assert told is not None
        for tick in range(100):
            told(line(tick))
    assert [file.name for file in tmp_path.iterdir()] == ["log"]


def test_the_packets_of_all_parts_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read while the block runs, and at its end."""
    monkeypatch.setattr(logs, "PAUSE", 0.001)
    nodes = SimpleNamespace(
        folder=tmp_path,
        roles=["controller"],
        links=["actuator"],
        sender=lambda link: "controller",
        receiver=lambda link: "controller",
    )
    found = Logs(cast("Processes", nodes), lambda step: None)
    with logged(str(tmp_path / "controller.jsonl"), 500) as told, found.followed():
        assert told is not None
        for tick in range(300):
            told(line(tick))
            if tick % 30 == 0:
                time.sleep(0.005)
        sizes = list[int]()
        for file in tmp_path.iterdir():
            with suppress(FileNotFoundError):  # a part that was read in the meantime
                sizes.append(file.stat().st_size)
        assert sum(sizes) < 300 * 65
    sent = found.sends("actuator", 250)
    assert np.array_equal(sent, np.arange(250) % 3 == 0)
    assert found.arrived("actuator") == tuple(range(0, 300, 3))
    assert [file.name for file in tmp_path.iterdir()] == ["controller.jsonl"]


@pytest.mark.evidence
def test_a_run_finds_the_same_packets_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of kilobytes, so that there are many."""
    whole = run_network("two-mass", steps=400, seed=3)
    monkeypatch.setattr(run, "PART", 2000)
    parts = run_network("two-mass", steps=400, seed=3)
    assert parts.arrived == whole.arrived
    assert all(np.array_equal(parts.sends[link], sent) for link, sent in whole.sends.items())


@pytest.mark.evidence
@pytest.mark.skipif(sys.platform != "linux", reason="children are read from /proc")
def test_the_nodes_of_a_killed_run_end(tmp_path: Path) -> None:
    """They would write their logs for ever."""
    command = [sys.executable, "-m", "taciturn", "network", "two-mass", "--real-time", "--steps", "1000000"]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, env={**os.environ, "TMPDIR": str(tmp_path)}) as running:
        until = time.monotonic() + 120
        while not list(tmp_path.glob("*/controller.jsonl")) and time.monotonic() < until:
            time.sleep(0.1)
        nodes = subprocess.run(["pgrep", "-P", str(running.pid)], capture_output=True, text=True, check=True)
        running.kill()
    pids = nodes.stdout.split()
    assert len(pids) >= 3
    until = time.monotonic() + 20
    while (left := [pid for pid in pids if alive(pid)]) and time.monotonic() < until:
        time.sleep(0.05)
    assert not left


def alive(process: str) -> bool:
    """Tell whether a process runs, and is not only still listed."""
    try:
        return Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
