"""Records of runs: their kind is known by their content, and packets, faults and values are those of the files."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from runtime.silent import build, problem_of, simulate, write_logs
from twin.browser import browse, missing

import taciturn
from taciturn import ProblemError
from taciturn.study.recorded import recorded_silence
from taciturn_explore.commands import explore
from taciturn_explore.recorded_nodes import arrived
from taciturn_explore.recording import read_recording
from taciturn_explore.server import open_recording
from taciturn_worlds.world import run_world

STEPS = 40
KILLED, STOPPED, CUT = range(10, 15), range(20, 23), range(30, 34)  # steps
DROPPED = (4, 7)
Lines = Sequence[dict[str, Any]]


def line(role: str, tick: int, **more: Any) -> dict[str, Any]:
    """Return a line of a log, as nodes write them."""
    usual = {
        "timestamp": 0.5 * tick,
        "tick": tick,
        "role": role,
        "epoch": 7,
        "memory": {},
        "degraded": 0,
        "reasons": {},
    }
    return {**usual, "silent": 0, "silent_links": [], **more}


def written(folder: Path, lines: Lines) -> Path:
    """Write a log under the name of its role."""
    file = folder / f"{lines[0]['role']}.jsonl"
    file.write_text("".join(f"{json.dumps(one)}\n" for one in lines))
    return file


def logs_of_faults(folder: Path) -> list[Path]:
    """Return the logs of a controller that is killed, and of an actuator that is stopped and cut off."""
    controller, actuator, number = list[dict[str, Any]](), list[dict[str, Any]](), 0
    for tick in range(STEPS):
        number = 0 if tick == KILLED.stop else number
        runs = tick not in KILLED
        if runs:
            options = {"option_send_link_silent": 0.3 * (tick % 4), "option_send_link_send": 0.6}
            epoch = 7 if tick < KILLED.start else 8
            controller.append(line("controller", tick, epoch=epoch, y=[tick / 10], sent_link=1, **options))
        hears = runs and tick not in DROPPED and tick not in CUT
        more = {"silent_links": ["link"] if tick in CUT else [], "degraded": int(tick in CUT)}
        if tick not in STOPPED:
            reasons = {"lost": max(0, min(tick + 1, CUT.stop) - CUT.start)}
            actuator.append(
                line("actuator", tick, u=[-tick / 5], arrived_link=[number] if hears else [], reasons=reasons, **more)
            )
        number += runs
    return [written(folder, controller), written(folder, actuator)]


def test_logs_show_packets_and_faults_in_their_steps(tmp_path: Path) -> None:
    """A restart by its epoch, a stop by its gap, a cut link by the watchdog, and each dropped packet by its number."""
    found = read_recording(logs_of_faults(tmp_path), None).document()
    assert found["unit"] == "s"
    assert found["time"] == [0.5 * k for k in range(STEPS)]
    (lane,) = found["lanes"]
    assert lane["sent"] == [k for k in range(STEPS) if k not in KILLED]
    assert lane["dropped"] == [*DROPPED, *STOPPED, *CUT]
    assert lane["trigger"][1] == pytest.approx(0.5)
    assert lane["trigger"][KILLED.start] is None
    level, held = found["panels"]
    assert level["values"][25] == 2.5
    assert (level["values"][KILLED.start], held["values"][STOPPED.start]) == (None, None)
    assert [(one["name"], one["from"], one["to"], one["mild"]) for one in found["faults"]] == [
        ("controller killed", KILLED.start, KILLED.stop + 1, False),
        ("actuator stopped", STOPPED.start, STOPPED.stop, False),
        ("link cut", CUT.start, CUT.stop, False),
        ("actuator degraded", CUT.start, CUT.stop, True),
    ]
    assert "lost (4)" in found["faults"][-1]["text"]
    assert found["verdict"] == [
        "40 steps: link sent in 87.5 %; 9 of 35 packets dropped",
        "controller killed, actuator stopped, link cut",
    ]


def test_packets_are_found_by_numbers_that_no_sender_logs() -> None:
    """With a delay, out of order, from a log that begins later, and with numbers that begin again."""
    sends = [*((k, 1) for k in range(10)), *((k, 2) for k in range(12, 20))]
    numbers = [100 + k for k in range(10)] + list(range(8))
    lost = {3, 4, 12}
    late = {6: 9}  # arrives three steps later
    arrivals = sorted((late.get(i, sends[i][0]), numbers[i]) for i in range(len(sends)) if i not in lost)
    assert [i for i, came in enumerate(arrived(sends, arrivals)) if not came] == sorted(lost)


def test_the_certificate_over_time_needs_the_problem_that_the_nodes_ran(tmp_path: Path) -> None:
    """Then the page has the sentence of the library, the names of the signals, and the path with every sample."""
    files = write_logs(build("held"), simulate(build("held"), 60, 1), tmp_path)
    problem = problem_of("held")
    told, found = recorded_silence(problem, files), read_recording(files, problem).document()
    assert found["verdict"] == list(told.verdict)
    level, valve, certified = found["panels"]
    assert level["other"] == pytest.approx(told.outputs["y1_every_sample"], rel=1e-4)
    assert valve["other"] == pytest.approx(told.outputs["u1_every_sample"], rel=1e-4)
    assert certified["values"] == pytest.approx(100 * (told.ratios - 1), rel=1e-4, abs=1e-12)
    assert all(one["known"] and one["dropped"] == [] for one in found["lanes"])
    other = read_recording(files, taciturn.load("two-mass")).document()
    assert [one["bound"] for one in other["panels"]] == [False, False]
    assert "they need the problem file that the nodes ran" in other["notes"][0]


def test_the_document_of_a_world_shows_its_faults(tmp_path: Path) -> None:
    """As ``taciturn network --world`` prints it."""
    document = json.dumps(run_world(taciturn.load("two-mass"), 3).document())
    (tmp_path / "world.json").write_text(document)
    found, world = read_recording([tmp_path / "world.json"], None).document(), json.loads(document)
    assert found["verdict"] == [world["verdict"]]
    spans = sorted((one["first"], one["first"] + one["steps"], one["text"]) for one in world["faults"])
    assert sorted((one["from"], one["to"], one["text"]) for one in found["faults"] if not one["mild"]) == spans
    assert {one["name"] for one in found["faults"]} >= {"link cut, plant → controller", "recovery"}


def test_the_table_and_the_document_of_a_run_are_records(tmp_path: Path) -> None:
    """The table has the packets of each step, the document has the counters."""
    (tmp_path / "run.csv").write_text("tick,cost,sent_a\n5,0.5,True\n6,1.5,False\n7,2.5,True\n")
    found = read_recording([tmp_path / "run.csv"], None).document()
    assert (found["first"], found["panels"][0]["values"], found["lanes"][0]["sent"]) == (5, [0.5, 1.5, 2.5], [0, 2])
    run = {"verdict": "7 steps", "datagrams": {"a": {"sent": 3, "lost": 1}}, "processes": {}, "notes": ["one"]}
    (tmp_path / "run.json").write_text(json.dumps(run))
    found = read_recording([tmp_path / "run.json"], None).document()
    assert (found["verdict"], found["notes"][0]) == (["7 steps"], "one")
    assert found["table"] == {"head": ["link", "sent", "dropped"], "rows": [["a", "3", "1"]]}


def twin(folder: Path, faults: Sequence[str] = ("light@1+0.6=0.4", "controller@2.1"), **changed: Any) -> Path:
    """Write a file of a twin of two policies, one run, ten steps of 0.3 s and one state."""
    xarray = pytest.importorskip("xarray")
    steps, policies = 10, 2
    document = {
        "robot": "rover",
        "faults": list(faults),
        "cost": {"value": 3.0},
        "cost_all_time": 2.0,
        "rates": {},
        "notes": [],
    }
    shapes = {
        "pose": ("policy", "run", "instant", "state"), "given": ("policy", "run", "tick", "input"),
        "trigger": ("policy", "run", "tick", "form"), "sent": ("policy", "link", "run", "tick"),
        "arrived": ("policy", "link", "run", "tick"),
    }  # fmt: skip
    sizes = {
        "policy": policies,
        "run": 1,
        "instant": steps + 1,
        "tick": steps,
        "state": 1,
        "input": 1,
        "link": 2,
        "form": 2,
    }
    values = {
        name: np.arange(np.prod([sizes[dim] for dim in dims])).reshape([sizes[dim] for dim in dims])
        for name, dims in shapes.items()
    }
    values["sent"], values["arrived"] = np.ones(values["sent"].shape), np.ones(values["sent"].shape)
    values["arrived"][0, 1, 0, 4] = 0.0
    whole = xarray.Dataset(
        {name: (dims, np.asarray(values[name], dtype=float)) for name, dims in shapes.items()},
        coords={
            "policy": ["event-triggered", "all-time"], "state": ["x [m]"], "input": ["PWM"],
            "link": ["sensor", "actuator"], "time": ("instant", 0.3 * np.arange(steps + 1)),
        },
        attrs={"document": json.dumps({**document, **changed})},
    )  # fmt: skip
    file = folder / "twin.nc"
    file.write_bytes(bytes(whole.to_netcdf(None, engine="h5netcdf")))
    return file


@pytest.mark.evidence
def test_the_file_of_a_twin_shows_both_policies_and_the_faults(tmp_path: Path) -> None:
    """Times of faults become steps."""
    found = read_recording([twin(tmp_path)], None).document()
    assert found["verdict"] == ["rover, 50 % more cost than every sample", "light × 0.4, controller killed"]
    assert [(one["name"], one["from"], one["to"]) for one in found["faults"]] == [
        ("light × 0.4", 3, 5),
        ("controller killed", 7, 8),
    ]
    assert found["panels"][0]["values"] == list(range(10))
    assert found["panels"][0]["other"] == list(range(11, 21))
    assert [one["dropped"] for one in found["lanes"]] == [[], [4]]


def log(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Write a log whose second line is changed."""
    lines = [line("a", tick, y=[0.0], sent_l=1) for tick in range(3)]
    change(lines[1])
    return written(folder, lines)


BROKEN: dict[str, tuple[Callable[[Path], Path], str]] = {
    "text": (lambda folder: _file(folder, b"hello\n"), "is not the record of a run; expected logs of nodes"),
    "bytes": (lambda folder: _file(folder, b"\xff\xfe\x00"), "is not the record of a run"),
    "another document": (lambda folder: _file(folder, b'{"verdict": "26 %", "cost": 1}'), "is not the record of a run"),
    "nested": (lambda folder: _file(folder, b'{"a":' * 5000), "is not the record of a run"),
    "role": (
        lambda folder: log(folder, lambda one: one.update(role="b")),
        "line 2 of .* is not a line of a node's log",
    ),
    "infinite": (lambda folder: log(folder, lambda one: one.update(y=[float("inf")])), "line 2 of"),
    "entries": (lambda folder: log(folder, lambda one: one.update(y=["<b>"])), "line 2 of"),
    "arrivals": (lambda folder: log(folder, lambda one: one.update(arrived_l=[0.5])), "line 2 of"),
    "back": (lambda folder: log(folder, lambda one: one.update(tick=0)), "go back from step 0 to step 0"),
    "far": (lambda folder: written(folder, [line("a", 0), line("a", 2**50)]), "the logs span"),
    "columns": (lambda folder: _file(folder, b"tick,cost,other\n"), "expected the columns tick, cost, and sent_LINK"),
    "cell": (lambda folder: _file(folder, b"tick,cost\n0,nan\n"), "line 2 of"),
    "steps": (lambda folder: _file(folder, b"tick,cost\n0,1\n2,1\n"), "do not follow each other"),
    "world": (
        lambda folder: _file(folder, b'{"verdict": "a", "recovery": 1, "faults": [{}], "steps": 9}'),
        "a fault in",
    ),
    "no HDF5": (lambda folder: _file(folder, b"\x89HDF\r\n\x1a\n" + b"x" * 99), "is not the record of a twin"),
    "fault": (lambda folder: twin(folder, ["light@x"]), "the fault 'light@x' of the record cannot be read"),
    "no robot": (lambda folder: twin(folder, robot=3), "its document names no robot"),
    "missing": (lambda folder: folder / "none", "cannot be read: No such file"),
    "folder": (lambda folder: folder, "it is not a regular file"),
}


def _file(folder: Path, content: bytes) -> Path:
    (folder / "file").write_bytes(content)
    return folder / "file"


@pytest.mark.parametrize("name", BROKEN)
def test_a_file_that_is_no_record_is_one_sentence(name: str, tmp_path: Path) -> None:
    """Of any kind, with the place where it breaks."""
    write, told = BROKEN[name]
    with pytest.raises(ProblemError, match=told) as error:
        read_recording([write(tmp_path)], None)
    assert "\n" not in str(error.value)


def test_several_records_are_refused_unless_they_are_logs(tmp_path: Path) -> None:
    """The sentence names the other file."""
    log, other = log_of_one(tmp_path), _file(tmp_path, b'{"verdict": "a"}')
    with pytest.raises(ProblemError, match="file is not a log of a node; expected one record, or the logs"):
        read_recording([log, other], None)


def log_of_one(folder: Path) -> Path:
    """Write a log without faults."""
    return written(folder, [line("a", tick, y=[0.0]) for tick in range(3)])


@pytest.mark.evidence
def test_the_page_reads_values_by_keys_and_shows_each_fault(tmp_path: Path) -> None:
    """Served and saved: the cursor has the numbers of the files, faults are in reach of keys, and a phone fits."""
    if lacks := missing():
        pytest.skip(f"NOT SHOWN: the page of a record in a browser; {lacks}")
    logs = logs_of_faults(tmp_path)
    found = read_recording(logs, None)
    explore("two-mass", recording=logs, save=tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert not re.search(r"\b(src|href)=", re.sub(r"<script.*</script>", "", text, flags=re.DOTALL))
    errors = list[str]()
    with open_recording(found, ("127.0.0.1", 0)) as served, browse() as browser:
        for address in (served.url, (tmp_path / "page.html").as_uri()):
            tab = browser.new_page(viewport={"width": 390, "height": 844})
            tab.on("pageerror", lambda error: errors.append(str(error)))
            tab.on("console", lambda said: said.type == "error" and errors.append(said.text))
            tab.goto(address)
            run = tab.locator("svg.run")
            run.focus()
            for _ in range(DROPPED[0]):
                tab.keyboard.press("ArrowRight")
            told = run.get_attribute("aria-valuetext")
            assert told == "step 4 · 2 s · link dropped, y, measured by controller 0.4, u, applied by actuator −0.8"
            for name in ("controller killed", "actuator stopped", "link cut"):
                tab.keyboard.press("n")
                assert tab.locator(".fault-row[aria-pressed=true] b").inner_text() == name
            assert run.get_attribute("aria-valuenow") == str(CUT.start)
            tab.wait_for_selector(".band.chosen", state="attached")
            assert tab.evaluate("document.documentElement.scrollWidth") <= 390
            assert tab.locator(".verdict").inner_text() == found.verdict[0]
            tab.close()
    assert errors == []
