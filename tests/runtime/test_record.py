"""The record of a run: all packets with their fates, and the signals of all steps."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from counts import few
from runtime.silent import problem_of as silent
from runtime.virtual import LATENCY, run_virtually

import taciturn
from taciturn.errors import ProblemError
from taciturn.nodes.inbox import WIDTH
from taciturn.nodes.packet import Packet, Wire
from taciturn.study.recorded import recorded_silence
from taciturn_explore.recording import read_recording
from taciturn_udp.logs import Arrival, Logs, logged
from taciturn_udp.record import HELD, Record, signal_names
from taciturn_udp.relay import Fate
from taciturn_udp.run import run_network

HEAD = ["time", "step", "link", "event", "delay", "bytes", "trigger"]


def events(packets: list[list[str]], *kinds: str) -> list[list[str]]:
    """Return the rows of some kinds of events."""
    return [row for row in packets[1:] if row[3] in kinds]


def test_each_packet_is_recorded_with_its_fate(tmp_path: Path) -> None:
    """In virtual time: sent, then delivered or lost as the link does, with the trigger of its decision."""
    fate = Fate(1, loss=0.3)
    found = run_virtually("two-mass", tmp_path, 80, {"actuator": fate})
    assert found.packets[0] == HEAD
    sent = events(found.packets, "sent")
    assert [int(row[1]) for row in sent] == np.flatnonzero(found.logs.sends("actuator", 80)).tolist()
    assert len(events(found.packets, "lost")) == found.links["actuator"].counters["lost"] > 3
    gone = [row[1] for row in sent if fate.lost(sent.index(row), int(row[1]))]
    assert [row[1] for row in events(found.packets, "lost")] == gone
    came = events(found.packets, "delivered")
    assert [row[1] for row in came] == [row[1] for row in sent if row[1] not in gone]
    assert all(row[4:] == ["0.0", row[5], ""] for row in came)
    period = taciturn.load("two-mass").plant.dt
    assert all(row[0] == repr(int(row[1]) * period) and row[2] == "actuator" for row in found.packets[1:])
    lines = [*read_lines(tmp_path / "controller.jsonl.1"), *read_lines(tmp_path / "controller.jsonl")]
    values = {line["tick"]: min(v for k, v in line.items() if k.endswith("_silent")) for line in lines}
    assert all(float(row[6]) == values[int(row[1])] for row in sent if int(row[1]) in values)
    size = len(Wire(taciturn.load("two-mass").design()).encode(packet_of("two-mass")))
    assert {int(row[5]) for row in found.packets[1:]} == {size}


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a log, if it has not been read and deleted."""
    return [json.loads(row) for row in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def packet_of(problem: str) -> Packet:
    """Return a data packet to the actuator."""
    policy = taciturn.load(problem).design()
    size = sum(policy.sizes[name] for step in policy.steps if hasattr(step, "payload") for name in step.payload)
    return Packet("data", "actuator", 0, 0, (0.0,) * size)


def test_signals_are_those_of_the_plant_with_all_digits(tmp_path: Path) -> None:
    """A row for each step, under the names of the table of ``simulate``; in virtual time, the same seed gives them."""
    found = run_virtually("two-mass", tmp_path / "a", 40, {})
    loop = taciturn.load("two-mass").close(taciturn.load("two-mass").design())
    table = taciturn.simulate(loop, steps=3).to_pandas()
    assert found.signals[0] == ["time", "step", "y1", "y2", "u1"]
    assert {"time", *found.signals[0][2:]} <= {*table.reset_index().columns}
    assert [row[1] for row in found.signals[1:]] == [str(step) for step in range(40)]
    assert all(repr(float(one)) == one for row in found.signals[1:] for one in row[2:])
    again = run_virtually("two-mass", tmp_path / "b", 40, {})
    assert (again.signals, again.packets) == (found.signals, found.packets)


def test_times_are_measured_in_real_time(tmp_path: Path) -> None:
    """Seconds from the beginning of step 0; the delay is that of the link, to a nanosecond."""
    found = run_virtually("two-mass", tmp_path, 60, {"actuator": Fate(delay=0.004)}, 0.02)
    assert [float(row[0]) for row in found.signals[1:]] == pytest.approx([0.02 * k for k in range(60)], abs=1e-6)
    came = events(found.packets, "delivered")
    assert len(came) == len(events(found.packets, "sent")) > 10
    assert [float(row[4]) for row in came] == pytest.approx([0.004 + LATENCY] * len(came), abs=1e-6)
    times = [float(row[0]) for row in found.packets[1:]]
    assert times == sorted(times)


def test_a_problem_with_set_points_and_several_links_has_their_columns(tmp_path: Path) -> None:
    """Set-points of the simulated plant come last, and every link has its packets."""
    tanks = taciturn.load("quadruple-tank")
    assert signal_names(tanks.close(tanks.design())) == ("time", "step", "y1", "y2", "u1", "u2")
    found = run_virtually("quadruple-tank", tmp_path, 20, {})
    assert {row[2] for row in found.packets[1:]} == {"level-1", "level-2", "pump-1", "pump-2"}
    problem = taciturn.load("pid-tank").changed({"reference.steps.rate": 0.1, "reference.steps.covariance": [[1.0]]})
    names = signal_names(problem.close(problem.design()))
    assert names[-1] == "set_point1"


def empty_record(folder: Path, lost: bool = False) -> Record:
    """Return a record of a run in virtual time, whose link drops nothing or is not foreseen."""
    problem = taciturn.load("two-mass")
    loop = problem.close(problem.design())
    record = Record(folder, loop, Wire(loop.policy), None, {"actuator": lambda *_: False} if lost else {})
    record.begin(lambda _: None, ["controller", "actuator"])
    return record


def sender_line(step: int, time_of: float = 0.0) -> dict[str, Any]:
    """Return the line of a log of a controller that has sent a packet."""
    return {"tick": step, "monotonic": time_of, "departures_actuator": [[1, step, step]]}


def test_the_memory_of_a_record_is_limited(tmp_path: Path) -> None:
    """Packets without arrival are lost behind the window of the receiver, and no killed node holds rows back."""
    record = empty_record(tmp_path / "record")
    for step in range(2 * WIDTH + 5):
        record.take_sends("actuator", sender_line(step))
    assert len(record._roads["actuator"]) == WIDTH
    for step in range(HELD):
        record.take_arrival("actuator", Arrival(0, step, step, step, 0.0, 0, False))  # whose departures are not logged
        if step % 1000 == 999:
            record.write()
    record.write()
    assert len(record._early["actuator"]) <= WIDTH
    assert len(record._rows) <= HELD
    record.close()
    rows = list(csv.reader((tmp_path / "record" / "packets.csv").read_text(encoding="utf-8").splitlines()))
    assert sum(row[3] == "lost" for row in rows) == WIDTH + 5
    assert {row[4] for row in rows if row[3] == "delivered"} == {""}


def test_an_arrival_that_is_read_before_its_departure_gets_its_delay(tmp_path: Path) -> None:
    """The logs of two nodes are read one after the other."""
    record = empty_record(tmp_path / "record")
    record.take_arrival("actuator", Arrival(1, 3, 3, 3, 0.0, 2, True))
    record.write()
    record.take_sends("actuator", sender_line(3))
    record.finish({})
    record.close()
    rows = list(csv.reader((tmp_path / "record" / "packets.csv").read_text(encoding="utf-8").splitlines()))
    assert [(row[3], row[4]) for row in rows[1:]] == [("sent", ""), ("late", "0.2")]


def test_packets_on_the_way_are_not_lost(tmp_path: Path) -> None:
    """At the end of a run, a link holds as many as its relay reports; an interrupted run does not tell."""
    for name, pending, lost in (("end", {"actuator": 2}, ["0"]), ("interrupted", None, [])):
        record = empty_record(tmp_path / name)
        for step in range(3):
            record.take_sends("actuator", sender_line(step))
        if pending is not None:
            record.finish(pending)
        record.close()
        rows = list(csv.reader((tmp_path / name / "packets.csv").read_text(encoding="utf-8").splitlines()))
        assert [row[1] for row in rows if row[3] == "lost"] == lost


def test_a_record_is_not_overwritten(tmp_path: Path) -> None:
    """Neither a file of a record, nor a file in place of the folder; a run that has not begun leaves none."""
    folder = tmp_path / "deep" / "record"
    empty_record(folder).close()
    assert list(folder.iterdir()) == []
    record = empty_record(folder)
    record.take_sends("actuator", sender_line(0))
    record.close()
    for path, said in ((folder, r"already contains packets.csv; expected"), (folder / "packets.csv", "is a file")):
        with pytest.raises(ProblemError, match=said):
            empty_record(path)
    with pytest.raises(ProblemError, match="already contains"):
        run_network("two-mass", steps=5, record=folder)


def test_a_full_disk_ends_the_record_and_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A note says that the record is not complete."""
    record = empty_record(tmp_path / "record")
    record.take_sends("actuator", sender_line(0))
    file = record._files["packets.csv"]

    class Full:
        closed = False
        tell, truncate, close = file.tell, file.truncate, file.close

        def write(self, content: bytes) -> int:
            return file.write(content[: len(content) // 2])

    monkeypatch.setitem(record._files, "packets.csv", Full())
    (note,) = record.finish({})
    assert note.endswith("is not complete: the disk is full")
    record.close()
    assert (tmp_path / "record" / "packets.csv").read_text(encoding="utf-8") == ",".join(HEAD) + "\n"


def logs_of(folder: Path) -> Logs:
    """Return the reader of the log of a controller that sends to an actuator."""
    processes = SimpleNamespace(
        folder=folder, roles=["controller"], links=["actuator"], sender=lambda _: "controller", receiver=lambda _: "x"
    )
    return Logs(cast("Any", processes), lambda step: None)


def test_every_line_of_a_log_is_read_once_while_its_node_writes_parts(tmp_path: Path) -> None:
    """Parts are deleted, half a line waits for its end, and a killed process costs its last line only."""
    log, logs = tmp_path / "controller.jsonl", logs_of(tmp_path)
    with logged(str(log), 200) as told:
        assert told is not None
        for step in range(100):
            told({"tick": step, "sent_actuator": 1})
            if step % 7 == 3:
                logs._go_on()
    with log.open("a") as file:
        file.write('{"tick": 100, "sent')
    logs._go_on()
    assert logs.sends("actuator", 101).sum() == 100
    with logged(str(log), 200) as told:  # the process has started again
        assert told is not None
        told({"tick": 101, "sent_actuator": 1})
    logs._go_on(ended=True)
    assert logs.sends("actuator", 102).tolist() == [1.0] * 100 + [0.0, 1.0]
    assert not (tmp_path / "controller.jsonl.1").exists()


def test_the_page_shows_a_recorded_folder(tmp_path: Path) -> None:
    """Signals under the names of the problem, packets with their fate, and late packets."""
    found = run_virtually("two-mass", tmp_path, 40, {"actuator": Fate(1, hold=1)})
    problem = taciturn.load("two-mass")
    shown = read_recording([tmp_path / "record"], problem)
    assert (shown.first, shown.steps, shown.period) == (0, 40, pytest.approx(problem.plant.dt))
    assert [len(one.values) for one in shown.traces] == [40, 40, 40]
    assert shown.traces[0].values.tolist() == [float(row[2]) for row in found.signals[1:]]
    (lane,) = shown.lanes
    assert (lane.link, lane.sender, lane.receiver) == ("actuator", "controller", "actuator")
    assert np.flatnonzero(lane.sent).tolist() == [int(row[1]) for row in events(found.packets, "sent")]
    late = len(events(found.packets, "late"))
    assert f"{late} of {late} late" in shown.verdict[0]
    assert len(shown.faults) == late
    assert shown.document()["lanes"][0]["known"]
    signals = (tmp_path / "record" / "signals.csv").read_text(encoding="utf-8")
    (tmp_path / "record" / "signals.csv").write_text(signals[:-9], encoding="utf-8")  # the last line is cut
    assert read_recording([tmp_path / "record"], None).steps == 39


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("signals.csv", "", "is no table"),
        ("signals.csv", "a,b\n1,2\n", "has the columns a, b; expected time, step"),
        ("signals.csv", "time,step,y1\n0.0,0\n", "line 2 .* has 2 entries; expected 3"),
        ("signals.csv", "time,step,y1\n0.0,0,x\n", "line 2 .* has 'x'; expected a finite number"),
        ("signals.csv", "time,step,y1\n0.0,0,1\n0.1,5,1\n", "do not follow each other"),
        ("packets.csv", "time,step\n", "has the columns time, step; expected time"),
        ("packets.csv", ",".join(HEAD) + "\n0.0,0,actuator,eaten,,68,\n", "has the event 'eaten'"),
        ("packets.csv", None, "cannot be read"),
    ],
)
def test_a_damaged_folder_is_refused(tmp_path: Path, name: str, text: str | None, said: str) -> None:
    """In one sentence, which names the file and the line."""
    files = {"signals.csv": "time,step,y1\n0.0,0,1.5\n", "packets.csv": ",".join(HEAD) + "\n"}
    for file, content in (files | {name: text}).items():
        if content is not None:
            (tmp_path / file).write_text(content, encoding="utf-8")
    with pytest.raises(ProblemError, match=said):
        read_recording([tmp_path], None)


def test_a_folder_stands_alone(tmp_path: Path) -> None:
    """Among logs, and where the cost of silence is asked for, a folder is refused."""
    (tmp_path / "packets.csv").touch()
    with pytest.raises(ProblemError, match="expected one folder, or the logs"):
        read_recording([tmp_path, tmp_path], None)
    with pytest.raises(ProblemError, match="is the folder of a record, and the packets"):
        recorded_silence(silent("held"), [tmp_path])


@pytest.mark.evidence
@pytest.mark.parametrize("tick", few([None, 0.01], 2))
def test_processes_leave_a_record(tmp_path: Path, tick: float | None) -> None:
    """As many packets as the run counts, and a row for each step."""
    found = run_network(
        "two-mass", steps=100, seed=1, tick=tick, fates={"actuator": Fate(1, 0.2)}, record=tmp_path / "r"
    )
    rows = list(csv.reader((tmp_path / "r" / "packets.csv").read_text(encoding="utf-8").splitlines()))
    counted = found.datagrams["actuator"]
    assert sum(row[3] == "sent" for row in rows) == counted["sent"]
    assert sum(row[3] == "lost" for row in rows) == counted["lost"]
    assert sum(row[3] in ("delivered", "late") for row in rows) == counted["delivered"]
    assert len((tmp_path / "r" / "signals.csv").read_text(encoding="utf-8").splitlines()) == 101


@pytest.mark.evidence
@pytest.mark.skipif(sys.platform == "win32", reason="SIGINT ends a process on POSIX")
def test_an_interrupted_run_leaves_whole_lines(tmp_path: Path) -> None:
    """Ctrl-C ends the command with code 130, and both files end with a whole row."""
    folder = tmp_path / "r"
    process = subprocess.Popen(
        [sys.executable, "-m", "taciturn", "network", "two-mass", "--steps", "1000000", "--record", str(folder)],
        stderr=subprocess.PIPE,
    )
    packets = folder / "packets.csv"
    while not (packets.exists() and packets.stat().st_size > 5000):
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGINT)
    assert process.wait(60) == 130
    process.stderr and process.stderr.close()
    for name, width in (("packets.csv", 7), ("signals.csv", 5)):
        text = (folder / name).read_text(encoding="utf-8")
        assert text.endswith("\n")
        assert {len(row) for row in csv.reader(text.splitlines())} == {width}


@pytest.mark.evidence
def test_a_killed_node_leaves_whole_lines(tmp_path: Path) -> None:
    """The run ends with a sentence about the node, and the record has what was read before."""

    def kill(processes: Any) -> None:
        while not (tmp_path / "r" / "packets.csv").stat().st_size > 2000:
            time.sleep(0.05)
        processes.running["actuator"].kill()

    def disturb(processes: Any) -> None:
        kill(processes)
        raise ProblemError("the actuator was killed")

    with pytest.raises(ProblemError, match="was killed"):
        run_network("two-mass", steps=1_000_000, record=tmp_path / "r", meanwhile=disturb)
    for name, width in (("packets.csv", 7), ("signals.csv", 5)):
        text = (tmp_path / "r" / name).read_text(encoding="utf-8")
        assert text.endswith("\n")
        assert {len(row) for row in csv.reader(text.splitlines())} == {width}
