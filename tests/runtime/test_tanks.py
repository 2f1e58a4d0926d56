"""Four nonlinear tanks with a leak, limited pumps and level set-points in packets: one loop, processes, and C."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from export.test_folders import AGREES, compile_check, run_check, write

import taciturn
from taciturn import Loop, Nodes, run_network, simulate
from taciturn.model.dynamics import equilibrium
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.problem.read import read_function
from taciturn_export.folder import print_folder, record_loop

OUTLET = 0.071  # cm², of tank 1
POINT, VOLTS = [12.4, 12.7, 1.8, 1.4], [3.0, 3.0]
LEVELS = "0, 12.5, 13\n100, 15, 13\n200, 15, 15\n300, 10, 13\n400, 12.5, 13\n"  # seconds, cm, cm
FUNCTIONS = """
import numpy as np
from taciturn import integrate

AREA, OUTLET = np.array([28.0, 32.0, 28.0, 32.0]), np.array([0.071, 0.057, 0.071, 0.057])
FLOWS = np.array([[0.7 * 3.33, 0], [0, 0.6 * 3.35], [0, 0.4 * 3.35], [0.3 * 3.33, 0]])


def slopes(h, v, leak):
    out = OUTLET * np.array([1 + leak, 1, 1, 1]) * np.sqrt(2 * 981.0 * np.maximum(h, 0.0))
    return (FLOWS @ v + np.array([out[2], out[3], 0, 0]) - out) / AREA


sound = integrate(lambda h, v: slopes(h, v, 0.0), dt=2.0)
leaking = integrate(lambda h, v: slopes(h, v, 0.15), dt=2.0)
"""
RULES = {
    "excess": {"kind": "excess", "delta": 0.3},
    "distributed": {"kind": "distributed", "theta": 1.0, "prediction": "model", "actuation": "model"},
}


def leaking_tanks(folder: Path, kind: str) -> Path:
    """Write the problem file, whose simulated plant is the nonlinear one with the leak, and return its path."""
    (folder / "tanks.py").write_text(FUNCTIONS)
    (folder / "levels.csv").write_text(LEVELS)
    limits = "input_limit = [[0.0, 5.5], [0.0, 5.5]]"
    text = ""
    for table, name in (("plant", "sound"), ("plant.actual", "leaking")):
        function = read_function(f"{folder / 'tanks.py'}:{name}", {})
        levels = equilibrium(function.function, POINT, VOLTS)
        A, B = taciturn.linearise(function.function, 4, 2, at=(levels, VOLTS))
        text += f"[{table}]\nA = {A.tolist()}\nB = {B.tolist()}\nC = {np.eye(2, 4).tolist()}\ndt = 2.0\n{limits}\n"
        text += f"W = {np.diag([0.02, 0.02, 0.01, 0.01]).tolist()}\nV = [[0.04, 0.0], [0.0, 0.04]]\n"
        text += 'function = "tanks.py:leaking"\n' if name == "leaking" else ""
        text += f"[{table}.operating_point]\nx = {levels.tolist()}\nu = {VOLTS}\n"
    text += "[[disturbance]]\nenters = [0.0714, 0.0, 0.0, 0.0]\nwander = 1e-3\n"
    text += '[reference]\noutputs = [[1, 0, 0, 0], [0, 1, 0, 0]]\nfile = "levels.csv"\n'
    text += f"[cost]\nQ = {np.diag([1.0, 1.0, 0.0, 0.0]).tolist()}\nR = [[0.1, 0.0], [0.0, 0.1]]\n[policy]\n"
    text += "".join(f"{key} = {value!r}\n" for key, value in RULES[kind].items()).replace("'", '"')
    if kind == "distributed":
        for i in (0, 1):
            text += f"[nodes.level-{i + 1}]\nmeasures = [{i}]\n[nodes.pump-{i + 1}]\napplies = [{i}]\n"
        text += "[nodes.plc]\ncontrols = true\n"
    (folder / "tanks.toml").write_text(text)
    return folder / "tanks.toml"


def loop_of(file: Path) -> Loop:
    """Return the loop of a problem file."""
    problem = taciturn.load(file)
    return problem.close(problem.design())


@pytest.mark.parametrize("kind", ["excess", pytest.param("distributed", marks=pytest.mark.evidence)])
def test_levels_follow_their_set_points_in_spite_of_the_leak(kind: str, tmp_path: Path) -> None:
    """A pump reaches its limit, the estimated flow is the leak, and nodes agree with the loop in every bit."""
    loop = loop_of(leaking_tanks(tmp_path, kind))
    path = simulate(loop, 1600, seed=1)
    assert path.input.min() == 0.0
    assert path.input.max() == 5.5
    settled = path.state[200:].reshape(-1, 4, 50, 7)[:, :, 30:].mean(axis=(0, 2))
    assert settled[:, :2] == pytest.approx(settled[:, -2:], abs=0.3)
    leak = 0.15 * OUTLET * np.sqrt(2 * 981.0 * path.state[200:, 0]).mean()
    estimated = (
        path.estimate[200:, 4] - path.state[200:, 4]
    )  # the disturbance of the file moves the simulated plant too
    assert estimated.mean() == pytest.approx(-leak, rel=0.1)
    records, nodes = record_loop(loop, 200, 3), Nodes(loop.policy)
    applied = [nodes.step(y[:2], reference=y[2:]) for y in records.measured]
    assert np.array_equal(applied, records.applied)
    assert (records.applied == 5.5).any()


@pytest.mark.evidence
@pytest.mark.parametrize("kind", RULES)
def test_processes_and_c_follow_the_same_levels(kind: str, tmp_path: Path) -> None:
    """Set-points arrive as packets; the costs of all steps over UDP and every bit of the nodes in C are the same."""
    file = leaking_tanks(tmp_path, kind)
    loop = loop_of(file)
    simulated, nodes, costs = SimulatedPlant(loop, 4), Nodes(loop.policy), list[float]()
    for _ in range(200):
        y = simulated.measurement
        costs.append(simulated.move(nodes.step(y[:2], reference=y[2:]).tolist()))
    found = run_network(file, steps=200, seed=4)
    assert found.costs.tolist() == costs
    assert found.document()["cost_bound"] is None
    check = compile_check(write(tmp_path / "c", print_folder(loop, "tanks")))
    assert run_check(check) == (0, f"tanks: 500 {AGREES}")
