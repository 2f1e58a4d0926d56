"""Twins and cameras at the command line: what they answer, and what a user can get wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from twin.crews import blind, short_mission, stand_in

from taciturn_twins.control import write_calibration
from taciturn_udp.endpoint import Endpoint

if TYPE_CHECKING:
    from conftest import Run


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["twin", "car"], "the robot 'car' does not exist; expected the robot rover or omni"),
        (["twin", "rover", "two-mass-lqg"], "the plant of two-mass-lqg is not that of the robot rover"),
        (["twin", "omni", "rover"], "the plant of rover is not that of the robot omni"),
        (["twin", "rover", "lossy-double-integrator"], "is not that of the robot rover"),
        (["twin", "rover", "no-such-file"], "no-such-file"),
        (
            ["twin", "rover", "rover", "--theta", "1"],
            "parameters (theta) are given with the file rover, which sets the parameters of the policy",
        ),
        (["twin", "omni", "--theta", "1"], "the policy of the robot omni has no parameter theta; expected price"),
        (["twin", "rover", "--runs", "0"], "--runs is 0; expected a whole number of at least 1"),
        (["twin", "rover", "--runs", "70000"], "--runs is 70000"),
        (["twin", "rover", "--theta", "nan"], "--theta is nan"),
        (["twin", "rover", "--fault", "camera@18"], "begins after the end of the mission at 18 s"),
        (["twin", "rover", "--fault", "kidnap@1=1,2"], "has 2 numbers; expected at most 1"),
        (["twin", "rover", "--fault", "gain=-2"], "the gain of the motors is -2"),
        (["twin", "rover", "--fault", "actuator@1", "--fault", "actuator@5"], "the fault actuator is given 2 times"),
        (["twin", "rover", "--speed", "2"], "--speed is given without --live"),
        (["twin", "rover", "--live", "--real-time", "--speed", "2"], "--speed is given with --real-time"),
        (["camera", "omni", "rover", "--peer", ":9"], "the plant of rover is not that of the robot omni"),
        (["twin", "rover", "--seed", "-1"], "seed is -1"),
        (["twin", "rover", "--tick", "0.1"], "--tick is given without --real-time"),
        (["twin", "rover", "--fault", "fire@3"], "the fault is 'fire@3'; expected NAME@START+SECONDS=SIZE"),
        (["twin", "rover", "--wheels", "square"], "square"),
        (
            ["twin", "omni", "--namespaces", "--fault", "actuator@1"],
            "the fault 'actuator' is given with network namespaces, but only relays cause this fault",
        ),
        (
            ["twin", "rover", "--video", "out.avi"],
            "the file 'out.avi' for the video ends in '.avi'; expected a file name with one of the endings .webp",
        ),
        (
            ["twin", "rover", "--record", "out.csv"],
            "the file 'out.csv' for the record ends in '.csv'; expected a file name with one of the endings .nc",
        ),
        (["twin", "rover", "--plot", "out.txt"], "the file 'out.txt' for the picture ends in '.txt'"),
        (["twin", "rover", "--live", "--runs", "2"], "--runs 2 is given with --live"),
        (["twin", "rover", "rover", "--live"], "a problem file is given with --live"),
        (
            ["twin", "rover", "--live", "--bind", "127.0.0.1:0", "--token", "two words"],
            "token is 'two words'; expected",
        ),
        (["twin", "rover", "--live", "--bind", "here"], "--bind is 'here'; expected HOST:PORT"),
        (["twin", "rover", "--live", "--rounds", "0"], "--rounds is 0; expected a whole number of at least 1"),
        (["twin", "rover", "--live", "--speed", "-1"], "--speed is -1"),
        (["twin", "rover", "--price", "-1"], "--price is -1"),
        (["camera", "rover", "rover", "--peer", "nowhere"], "--peer is 'nowhere'; expected HOST:PORT"),
        (["camera", "car", "rover", "--peer", ":9"], "the robot 'car' does not exist"),
        (["node", "controller", "rover", "--questions"], "--questions is given for the controller"),
        (
            ["node", "sensor", "rover", "--eye", "c.json"],
            "--eye is given for the sensor; expected this option for",
        ),
        (["node", "controller", "rover", "--peer", ":9", "--eye", "none.json"], "the calibration none.json cannot be"),
        (["node", "controller", "rover", "--peer", ":9", "--seen", "-"], "--seen or --watch is given without --eye"),
        (["reproduce", "chapter2", "--twin"], "'chapter2' is not a reproducible chapter; expected one of chapter6"),
    ],
)
def test_what_cannot_run_is_refused_in_a_sentence(run: Run, arguments: list[str], told: str) -> None:
    """Robots, policies for other plants, faults, files and pages: one sentence, exit code 2, and nothing rendered."""
    assert told in run(*arguments).sentence


@pytest.mark.evidence
def test_a_port_in_use_is_refused(run: Run) -> None:
    """The page's, and the camera's."""
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"{port}" in run("twin", "rover", "--live", "--bind", f"127.0.0.1:{port}").sentence
    with Endpoint(("127.0.0.1", 0)) as endpoint:
        at = "{}:{}".format(*endpoint.address)
        assert f"{at} cannot be bound" in run("camera", "rover", "rover", "--peer", ":9", "--bind", at).sentence


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"robot": "rover"}', '{"robot": "car"}'])
def test_a_calibration_that_is_none_is_refused(run: Run, tmp_path: Path, text: str) -> None:
    """Of another robot there is none either."""
    path = tmp_path / "calibration.json"
    path.write_text(text)
    said = run("node", "controller", "rover", "--peer", ":9", "--eye", str(path)).sentence
    assert "expected" in said


@pytest.mark.evidence
def test_an_eye_for_a_policy_of_another_size_sees_nothing_that_is_used(run: Run, tmp_path: Path) -> None:
    """A calibration of the omni's camera for the rover's controller is refused."""
    path = tmp_path / "calibration.json"
    if blind():
        pytest.skip(blind())
    omni = stand_in("omni")
    write_calibration(path, omni.robot, omni.calibration)
    said = run("node", "controller", "rover", "--peer", ":9", "--eye", str(path)).sentence
    assert "the calibration is for the omni, whose camera measures 3 numbers; expected 1" in said


def counts_add_up(found: dict[str, Any]) -> None:
    """Check that no datagram of a document has gone missing."""
    assert found["datagrams"]["unaccounted"] == 0
    for link in ("sensor", "actuator"):
        counted = found["datagrams"][link]
        assert counted["sent"] == counted["delivered"] + counted["lost"] > 0


@pytest.mark.evidence
def test_a_twin_ends_with_one_document(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A short mission: rates of both links, costs, how well the camera sees, every datagram; and all is recorded."""
    if blind():
        pytest.skip(blind())
    monkeypatch.setattr("taciturn_twins.run.prepare", lambda name, _: stand_in(name))
    targets = {name: tmp_path / f"run{end}" for name, end in (("record", ".nc"), ("video", ".webp"), ("plot", ".svg"))}
    options = [word for name, path in targets.items() for word in (f"--{name}", str(path))]
    answer = run("twin", "rover", short_mission("rover", 12, tmp_path), "--seed", "2", "--json", *options)
    assert answer.code == 0, answer.err
    found = json.loads(answer.out)
    assert (found["ticks"], found["seed"], found["all_time"]["rates"]["actuator"]["value"]) == (12, 2, 1.0)
    assert found["cost"]["value"] > 0
    assert found["cost_all_time"] > 0
    assert abs(found["vision"]["x"]["bias_mm"]) <= 3
    counts_add_up(found)
    counts_add_up(found["all_time"])
    assert targets["video"].read_bytes()[8:12] == b"WEBP"
    assert all(target.stat().st_size > 1000 for target in targets.values())


@pytest.mark.evidence
def test_a_twin_that_prepares_itself_ends_with_one_document(run: Run, tmp_path: Path) -> None:
    """The whole finite-horizon run with a model identified there: questions, sends, the guarantee, and millimetres."""
    if blind():
        pytest.skip(blind())
    record, video, plot = (tmp_path / name for name in ("run.nc", "run.webp", "run.svg"))
    targets = ("--record", str(record), "--video", str(video), "--plot", str(plot))
    answer = run("twin", "rover", "--seed", "2", "--json", *targets)
    assert answer.code == 0, answer.err
    found = json.loads(answer.out)
    assert found["rates"]["sensor"]["value"] == pytest.approx(11 / 60, abs=3.5 / 60)  # the noise is as identified
    assert found["rates"]["actuator"]["value"] <= 0.15
    assert found["cost"]["value"] < found["cost_bound"]
    assert found["cost_all_time"] > 0
    assert abs(found["vision"]["x"]["bias_mm"]) <= 1
    assert found["vision"]["x"]["standard_deviation_mm"] <= 2
    counts_add_up(found)
    assert all(target.stat().st_size > 1000 for target in (record, video, plot))
