"""Delays and buffers of links on the command line: what is shown, what is changed, and refusals in one sentence."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import taciturn

if TYPE_CHECKING:
    from conftest import Run, Write

NODES = "[nodes.gauge]\nmeasures = true\nsite = 'plc'\n[nodes.plc]\ncontrols = true\n[nodes.valve]\napplies = true\n"


def linked(law: str) -> str:
    """Return the tables of a network whose valve has a link with the given keys."""
    return f"{NODES}[links.valve]\n{law}\n"


@pytest.mark.parametrize(
    ("law", "words"),
    [
        ("delay = -1", "links.valve.delay is -1; expected a whole number of steps, a list of probabilities"),
        ("delay = 1.5", "links.valve.delay is 1.5; expected a whole number of steps"),
        ("delay = nan", "links.valve.delay is nan; expected a whole number of steps"),
        ("delay = inf", "links.valve.delay is inf; expected a whole number of steps"),
        ("delay = true", "links.valve.delay is True; expected a whole number of steps"),
        ("delay = '2'", "links.valve.delay is '2'; expected a whole number of steps"),
        ("delay = 2026-01-01", "links.valve.delay is datetime.date(2026, 1, 1); expected a whole number of steps"),
        ("delay = 1001", "links.valve.delay is 1001 steps; expected at most 1000"),
        ("delay = 1" + 400 * "0", "steps; expected at most 1000"),
        ("delay = []", "links.valve.delay has probabilities with the sum 0; expected a sum above 0 and at most 1"),
        ("delay = [0.5, 0.6]", "links.valve.delay has probabilities with the sum 1.1; expected a sum above 0"),
        ("delay = {second = 1}", "links.valve.delay.second is not a known key; expected one of seconds, probability"),
        ("delay = {seconds = -1}", "links.valve.delay.seconds is -1; expected 0 ≤ delay.seconds"),
        ("delay = {trace = 'none.csv'}", "cannot be read (No such file or directory); expected the columns sent and"),
        ("delay = {trace = 'folder'}", "cannot be read (it is not a regular file); expected the columns sent and"),
        ("delay = {histogram = 'pipe'}", "cannot be read (it is not a regular file); expected the columns milli"),
        ("delay = {histogram = 'other.csv'}", "cannot be read (line 1 is 'sent,delay'); expected the columns milli"),
        ("delay = {histogram = 'comma.csv'}", "(column 2 of line 1 is '5;0', which is not a finite number)"),
        (
            "delay = {states = [1, 2]}",
            "links.valve.delay.states has 2 laws, and the link has no burst; expected a burst",
        ),
        ("delay = 2\nbuffer = 1", "links.valve.buffer is 1 step, and the least delay is 2 steps, so every packet is"),
        ("delay = 2\nbuffer = {seconds = 1}", "links.valve.buffer is 1000 ms, and delay is 2 steps; expected both in"),
        ("buffer = -1", "links.valve.buffer is -1; expected a whole number of steps, or a table {seconds = x}"),
        ("buffer = [1]", "links.valve.buffer is [1]; expected a whole number of steps, or a table {seconds = x}"),
        ("delays = 1", "links.valve.delays is not a known key; expected one of"),
        ("delay = {seconds = 0.1}", "links.valve.delay is 100 ms, but the plant is discrete in time; expected"),
        ("delay = 300", "the delays of the links need more than 200 registers"),
        (
            "delay = [0.5, 0.5]",
            "links.valve.delay is random, which the policy kind lqg does not use; expected a constant delay",
        ),
    ],
)
def test_a_mistake_is_one_sentence(run: Run, write: Write, tmp_path: Path, law: str, words: str) -> None:
    """Exit code 2, nothing on standard output, and no traceback; files are relative to the problem file."""
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "other.csv").write_text("sent,delay\n0,0.1\n", encoding="utf-8")
    (tmp_path / "comma.csv").write_text("1,5;0,5\n", encoding="utf-8")
    told = run("evaluate", write(more=linked(law))).sentence.replace(f"{tmp_path}{os.sep}", "")
    assert told.startswith("problem.toml: ")
    assert words in told


def test_a_file_is_relative_to_the_problem_file(
    run: Run, write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever the command runs; J_all is that of the buffer."""
    (tmp_path / "5g.csv").write_text("milliseconds,probability\n1,0.9\n30,0.1\n", encoding="utf-8")
    law = linked("delay = {histogram = '5g.csv'}\nbuffer = {seconds = 0.03}")
    path = write(plant="[plant]\nA = [[-1.0]]\nB = [[1.0]]\nW = [[0.1]]\n", policy='[policy]\nkind = "lqg"\n'
                 "theta = 0.5\nperiod = 0.1\n", more=law)  # fmt: skip
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    answer = run("show", path, "--json")
    assert answer.code == 0
    found = json.loads(answer.out)
    constant = taciturn.load(path).changed({"links.valve": {"delay": {"seconds": 0.03}}})
    assert found["cost_all_time"] == pytest.approx(constant.design().cost_all_time, rel=1e-12)


def test_a_law_is_set_on_the_command_line(run: Run) -> None:
    """As a number of steps, a list, or a table; a refusal names the key."""
    costs = [
        json.loads(run("show", "two-mass", "--json", "--set", f"network.actuator_delay={law}").out)["cost_all_time"]
        for law in ("0", "2", "[0.0, 0.0, 1.0]", "none")
    ]
    assert costs[0] == costs[3] < costs[1] == costs[2]
    part = run("show", "two-mass-continuous", "--json", "--set", "network.actuator_delay={seconds=0.004}")
    assert json.loads(part.out)["network"]["delays"]["actuator"]["mean"] == 0.004
    told = run("show", "two-mass", "--set", "network.actuator_delay=1.5").sentence
    assert told.startswith("the changed problem: network.actuator_delay is 1.5; expected a whole number of steps")
    told = run("show", "two-mass", "--set", "network.actuator_buffer=x").sentence
    assert told.startswith("the changed problem: network.actuator_buffer is 'x'; expected a whole number of steps")


def test_delay_and_buffer_are_shown(run: Run) -> None:
    """In the text, in the diagram, and as numbers in the document; lost packets include the late ones."""
    law = ("--set", "network.actuator_delay=[0.5, 0.3, 0.1]", "--set", "network.actuator_buffer=1")
    found = json.loads(run("show", "two-mass", "--json", *law).out)
    assert found["network"]["losses"] == {"sensor": 0.0, "actuator": pytest.approx(0.2)}
    assert found["network"]["delays"] == {
        "actuator": {
            "text": "delay random, 0 to 2 steps, mean 0.5556 steps, 10 % lost; a packet is used 1 step after it was "
            "sent, 20 % never arrive or arrive later",
            "unit": "steps", "mean": pytest.approx(0.5 / 0.9), "largest": 2, "buffer": 1, "lost": pytest.approx(0.2),
        }
    }  # fmt: skip
    link = found["network"]["links"]["actuator"]
    assert link["delay"] == {"waits": [0.0, 1.0, 2.0], "odds": [[0.5, 0.3, 0.1]], "in_seconds": False}
    assert link["buffer"] == {"steps": 1, "seconds": 0.0}
    # a design that does not know the losses knows the buffer
    assert found["diagram"]["links"][0]["delay"] == "a packet is used 1 step after it was sent"
    text = run("show", "two-mass", *law).unwrapped
    assert "actuator drops 20 % (no acknowledgement)" in text
    assert "a packet is used 1 step after it was sent, 20 % never arrive or arrive later" in text
    assert "used after 1 step" in text


def test_a_network_without_delays_shows_none(run: Run) -> None:
    """Nothing of the text changes, and the document has an empty table."""
    found = json.loads(run("show", "two-mass", "--json").out)
    assert found["network"]["delays"] == {}
    assert {found["network"]["links"][link][key] for link in ("sensor", "actuator") for key in ("delay", "buffer")} == {
        None
    }
    assert "used after" not in run("show", "two-mass").out
    buffer = json.loads(run("show", "two-mass", "--json", "--set", "network.actuator_buffer=3").out)["network"]
    assert buffer["delays"]["actuator"] == {
        "text": "a packet is used 3 steps after it was sent", "unit": "steps", "mean": None, "largest": None,
        "buffer": 3, "lost": 0.0,
    }  # fmt: skip


def test_the_best_buffer_is_printed_and_written(run: Run, tmp_path: Path) -> None:
    """With the share of late packets and the cost of each possible delay; the file has the best one."""
    law = ("--set", "network.actuator_delay=[0.2, 0.5, 0.25, 0.05]", "--set", "network.protocol=tcp")
    given = ("tune", "inverted-pendulum", "--set", "policy.kind=excess", *law, "--buffer", "actuator")
    answer = run(*given, "--out", str(tmp_path / "out.toml"))
    assert answer.code == 0
    assert "2 steps         5.0 %" in answer.out
    found = json.loads(run(*given, "--json").out)
    assert found["key"] == "network.actuator_buffer"
    assert found["cost"]["value"] == min(row["cost"]["value"] for row in found["buffers"])
    assert taciturn.load(tmp_path / "out.toml").network.links["actuator"].buffer == (found["buffer"], 0.0)
    assert "--buffer and --least-period are both given" in run(*given, "--least-period", "0.01").sentence
