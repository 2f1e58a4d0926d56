"""``taciturn new``: wireless nodes, losses, batteries, set-points, ts, and controllers to keep."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.conftest import Ask

import taciturn

TANK = ("d", "0.1", "[1 0.1; 0 0.9]", "[0; 0.1]", "1", "0.03", "inputs 0.2")  # a level with noise
PID = "1.2 0.15 1 0.5"
TANKS = ("d", "2", "[0.97 0 0.08 0; 0 0.98 0 0.06; 0 0 0.92 0; 0 0 0 0.94]")
TANKS += ("[0.16 0; 0 0.12; 0 0.09; 0.06 0]", "1 2", "0.2", "0.1")  # two levels and two pumps


def tables(ask: Ask, *answers: str) -> dict[str, Any]:
    """Return the tables of the file that these answers give; its policy has been designed."""
    Path("new.toml").unlink(missing_ok=True)
    told = ask(answers)
    assert told.err == ""
    return tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))


def test_a_tank_with_a_pid_and_two_batteries(ask: Ask) -> None:
    """Two wireless nodes, whose links have a battery each; the set-point is that of the controller."""
    parts = ("nodes batteries set", "level", "valve", "", "0.001", "9000", "2.5")
    found = tables(ask, *TANK, "pid", PID, *parts, "1", "0.3")
    assert found["nodes"] == {"level": {"measures": [0]}, "valve": {"applies": [0]}, "controller": {"controls": True}}
    assert found["links"] == {name: {"energy": 0.001, "battery": 9000} for name in ("level", "valve")}
    assert found["controller"]["pid"]["setpoint"] == 2.5
    assert found["cost"] == {"weights": "as the controller"}
    assert (found["policy"]["kind"], found["policy"]["theta"]) == ("distributed", 0.3)
    assert taciturn.load("new.toml").network.links["level"].battery == 9000


@pytest.mark.evidence
def test_nodes_may_share_signals_and_others_are_wired(ask: Ask) -> None:
    """Their number or their names, and the numbers of their signals from 1; what is left is at the controller."""
    found = tables(ask, *TANKS, "", "1", "2", "nodes losses", "left", "2", "a b", "0.1", "0.2", "0", "yes", "1", "")
    assert found["nodes"] == {
        "left": {"measures": [1]},
        "wired-sensor": {"measures": [0], "site": "controller"},
        "a": {"applies": [0]},
        "b": {"applies": [1]},
        "controller": {"controls": True},
    }
    assert found["links"] == {"left": {"loss": 0.1, "acknowledged": True}, "a": {"loss": 0.2, "acknowledged": True}}
    found = tables(ask, *TANKS, "", "1", "2", "nodes", "1", "1 2", "0", "1", "0.3")
    assert found["nodes"]["sensor"] == {"measures": [0, 1]}
    assert found["nodes"]["wired-actuator"] == {"applies": [0, 1], "site": "controller"}


@pytest.mark.parametrize(
    ("answers", "sentence"),
    [
        (("nodes", "3"), "the sensors are 3; expected at most 2, one for each signal of the plant"),
        (("nodes", "a a"), "the name of a node is 'a'; expected letters, digits and hyphens, with a letter first"),
        (("nodes", "plant"), "the name of a node is 'plant'; expected letters, digits and hyphens"),
        (("nodes", "1", "3"), "the outputs of sensor is '3'; expected numbers from 1 to 2, such as 1"),
        (("nodes", "0", "0"), "no node is wireless; expected at least one wireless sensor or actuator"),
        (
            ("batteries", "valve"),
            "the node with a battery is 'valve'; expected one or several of the answers actuator, sensor",
        ),
        (("set-points", "3"), "the outputs is '3'; expected numbers from 1 to 2, such as 1"),
        (("disturbances", "", "input 3"), "the effect of disturbance 1 is '3'; expected numbers from 1 to 2"),
        (("set-points", "", "file", "no.csv"), "reference.file 'no.csv' cannot be read (No such file"),
        (("limits", "5 x"), "the limits of input 1 are '5 x'; expected a lower and an upper limit"),
        (("limits", "5 -5"), "the limits of input 1 are '5 -5'; expected a lower and an upper limit, such as -5 5"),
        (
            ("7",),
            "the part is '7'; expected one or several of the answers nodes, losses, batteries, set-points, ",
        ),
    ],
)
def test_an_answer_about_a_part_that_cannot_be_is_explained(ask: Ask, answers: tuple[str, ...], sentence: str) -> None:
    """At once; from a pipe that is the end."""
    told = ask((*TANKS, "", "1", "2", *answers))
    assert told.code == 2
    assert told.err.startswith(f"taciturn: {sentence}")


def test_set_points_change_in_steps_or_by_a_file(ask: Ask) -> None:
    """Exact measurements get a noise, since set-points are estimated with the state."""
    found = tables(ask, *TANKS, "", "1", "2", "set", "2", "steps", "1.5", "0.01", "0.5", "excess", "0.2")
    assert found["reference"] == {
        "outputs": [[0, 1, 0, 0]],
        "value": [1.5],
        "steps": {"rate": 0.01, "covariance": [[0.25]]},
    }
    Path("levels.csv").write_text("0, 1.0\n50, 2.0\n90, 1.0\n", encoding="utf-8")
    exact = (*TANK[:4], "all", "0", "0.1", "", "1", "1")
    found = tables(ask, *exact, "set-points", "0.05", "1", "file", "levels.csv", "excess", "0.2")
    assert found["reference"] == {"outputs": [[1, 0]], "file": "levels.csv"}
    assert found["plant"]["V"] == [[0.0025, 0], [0, 0.0025]]


@pytest.mark.evidence
def test_disturbances_and_limits(ask: Ask) -> None:
    """Several disturbances, each with its place; limits of both sides, of one, or none."""
    shapes = ("disturbances", "", "", "0.1", "yes", "sinusoid", "0 0.3", "0.5", "0.2", "no")
    found = tables(ask, *TANK, "", "1", "2", *shapes, "excess", "0.2")
    assert found["disturbance"] == [
        {"kind": "constant", "enters": [0, 0.1], "wander": 0.01},
        {"kind": "sinusoid", "enters": [0, 0.3], "frequency": 0.5, "wander": 0.04},
    ]
    found = tables(ask, *TANKS, "", "1", "2", "limits", "3", "-1 10", "none", "-1 inf", "excess", "0.2")
    assert found["plant"]["input_limit"] == [[-3, 3], [-1, 10]]
    assert found["limits"] == {"outputs": [[0, 1, 0, 0]], "low": [-1], "high": [np.inf]}
    assert "operating_point" not in found["plant"]


def test_a_range_that_is_not_around_zero_asks_for_the_operating_point(ask: Ask) -> None:
    """A heater of 0 to 2 kW and a room of 15 to 25 °C: the middle, or another point; set-points are those there."""
    room = ("d", "60", "0.97", "0.6", "1", "0.05", "0.1", "", "0.5", "1", "set-points limits", "", "", "")
    found = tables(ask, *room, "0 2", "15 25", "1.2", "", "excess", "0.2")
    assert found["plant"]["operating_point"] == {"u": [1.2], "x": [20]}
    assert "reference" not in found  # those at the operating point
    problem = taciturn.load("new.toml")
    path = taciturn.simulate(problem.close(problem.design()), 300)
    assert 19 < path.state[100:, 0].mean() < 21
    assert 0 <= path.input.min() < path.input.max() <= 2


def test_limits_of_inputs_are_asked_where_a_policy_accepts_them(ask: Ask) -> None:
    """Not for a controller to keep on several links, whose outputs may have limits."""
    kept = ("pid", "", "2 0.01", "2", "1 0.02", "nodes limits", "2", "2")
    found = tables(ask, *TANKS, *kept, "-1 1", "none", "1", "0.2")
    assert "input_limit" not in found["plant"]
    assert found["limits"] == {"outputs": [[1, 0, 0, 0]], "low": [-1], "high": [1]}
    assert found["policy"]["kind"] == "distributed"


def test_controllers_to_keep_are_pids_gains_matrices_or_files(ask: Ask) -> None:
    """Each input has a PID controller of an output; a slow load is that of the controller."""
    pids = ("pid", "", "2 0.01", "2", "1 0.02")
    found = tables(ask, *TANKS, *pids, "disturbances", "0.3", "200", "1", "0.2")
    assert found["controller"] == {
        "pid": [
            {"input": 1, "output": 1, "kp": 2, "ki": 0.01},
            {"input": 2, "output": 2, "kp": 1, "ki": 0.02},
        ],
        "disturbance": {"deviation": 0.3, "time_constant": 200},
    }
    assert tables(ask, *TANK, "gain", "0.8", "", "1", "0.2")["controller"] == {"D": [[0.8]]}
    kept = ("matrices", "1", "0.1", "0.2", "0.8", "set", "1.5")
    assert tables(ask, *TANK, *kept, "1", "0.2")["controller"]["setpoint"] == [1.5]
    np.savez("k.npz", D=[[0.8]])
    Path("sub").mkdir()
    found = tables(ask, *TANK, "file", "k.npz", "", "1", "0.2")
    assert found["controller"] == {"file": "k.npz"}
    assert taciturn.load("new.toml").design().kind == "excess"
