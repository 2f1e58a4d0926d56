"""Loads of running plants: they act on state and measurement at the steps of a simulated path, and by ``--load``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from taciturn import Nodes, load, simulate
from taciturn.errors import ProblemError
from taciturn.model.packets import fingerprint
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.problem import Problem
from taciturn.problem.loads import with_added_loads

FILE = """
[plant]
A = [[0.9, 0.2], [0.0, 0.8]]
B = [[0.0], [1.0]]
C = [[1.0, 0.0]]
W = [[1e-18, 0.0], [0.0, 1e-18]]
V = [[1e-18]]
dt = 0.5
[cost]
Q = [[1.0, 0.0], [0.0, 1.0]]
R = [[0.1]]
{disturbance}
[policy]
kind = "lqg"
theta = 0.1
"""
PUSH = "[[disturbance]]\nenters = [0.1, 0.4]\nmeasured = [0.3]\ninitial = 0.5\nsteps = [[4, -0.2], [9, 1.0]]\n"


def problem_with(folder: Path, disturbance: str) -> Problem:
    """Read the file with a disturbance."""
    (folder / "loaded.toml").write_text(FILE.format(disturbance=disturbance), encoding="utf-8")
    return load(folder / "loaded.toml")


@pytest.mark.parametrize("more", ["wander = 0", "wander = 1e-19", "known = true"])
def test_nodes_and_a_plant_compute_the_path_of_a_simulation(tmp_path: Path, more: str) -> None:
    """The noise is too small to be seen. A measurement contains a load from the step at which it changes."""
    problem = problem_with(tmp_path, PUSH + more)
    policy, quiet = problem.design(), problem_with(tmp_path, "").plant
    loop, nodes, known = problem.close(policy), Nodes(policy), "known" in more
    path, plant, x = simulate(loop, 20), SimulatedPlant(loop), np.zeros(2)
    for k, value in enumerate([0.5] * 4 + [-0.2] * 5 + [1.0] * 11):
        assert plant.state[:2] == pytest.approx(x, abs=1e-6)
        assert plant.measurement == pytest.approx([x[0] + 0.3 * value, *[value] * known], abs=1e-6)
        u = np.array(nodes.step(plant.measurement[:1], **({"reference": plant.measurement[1:]} if known else {})))
        assert path.input[k] == pytest.approx(u, abs=1e-6)
        assert path.state[k, :2] == pytest.approx(x, abs=1e-6)
        plant.move([float(one) for one in u])
        x = quiet.A @ x + quiet.B @ u + np.array([0.1, 0.4]) * value
    assert np.abs(x).max() > 0.1


def test_an_option_adds_loads_to_the_first_disturbance_or_else_to_the_inputs(tmp_path: Path) -> None:
    """In seconds, also for a discrete plant; the nodes of the file without the option run the same policy."""
    for disturbance, enters, before in (
        ("", [0.0, 1.0], np.zeros(20)),
        (PUSH + "wander = 0", [0.1, 0.4], np.array([0.5] * 4 + [-0.2] * 5 + [1.0] * 11)),
        ('[[disturbance]]\nenters = [0.3, 0.0]\nkind = "sinusoid"\nfrequency = 0.3\nwander = 1e-4', [0.3, 0.0], None),
    ):
        problem = problem_with(tmp_path, disturbance)
        found = with_added_loads(problem, ["0.3@3", "-0.1@1.1"])  # steps 6 and 3
        (added,) = found.plant.loads
        change = np.array([0.0] * 3 + [-0.1] * 3 + [0.2] * 14)
        assert added.at_steps(1.0, 20) == pytest.approx(change if before is None else before + change)
        assert added.E.tolist() == enters
        assert fingerprint(found.design(), found.network) == fingerprint(problem.design(), problem.network)


def test_what_an_option_states_wrongly_is_named() -> None:
    """Its form, and its number of values."""
    for text, words in (
        ("0.3", "expected VALUE@SECONDS"),
        ("0.3@-1", "a time of at least 0"),
        ("inf@2", "expected VALUE@SECONDS"),
        ("1,2@3", "with 2 values; expected 1 value for the plant without"),
    ):
        with pytest.raises(ProblemError, match=words):
            with_added_loads(load("two-mass"), [text])
