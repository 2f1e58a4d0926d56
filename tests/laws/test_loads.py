"""Loads: paths and costs against the plant as it is written, in NumPy, and what designs know of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from counts import few
from scipy.linalg import expm

from taciturn import Nodes, average, evaluate, simulate
from taciturn.errors import ProblemError
from taciturn.problem import Problem, parse
from taciturn.study.describe import describe

A, B, C = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
E, G = np.array([0.2, 0.7]), 0.3
STEPS = [[3.05, 0.5], [6.0, -0.2]]  # the first is between two samples
TABLES: dict[str, Any] = {
    "plant": {
        # the filter has usual gains, and the noise is too small to be seen
        "A": A.tolist(), "B": B.tolist(), "C": C.tolist(), "W": (1e-17 * np.eye(2)).tolist(), "V": [[1e-18]],
    },
    "cost": {"Q": [[2.0, 0.1], [0.1, 0.5]], "R": [[0.3]], "N": [[0.05], [0.1]]},
    "policy": {"kind": "excess", "theta": 0.1, "period": 0.2},
}  # fmt: skip
PID = {"pid": {"kp": 0.6, "ki": 0.5, "kd": 0.2, "filter": 0.3}, "disturbance": "none"}
HIDDEN = {"enters": E.tolist(), "measured": [G], "wander": 0.0, "initial": 0.1, "steps": STEPS}
CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "LQG": ({}, {}),
    "LQG that estimates it": ({"wander": 5e-18}, {}),
    "LQG that knows it": ({"known": True}, {}),
    "LQG with a set-point": ({}, {"reference": {"value": [0.4]}}),
    "LQG that estimates it, with an operator": (
        {"wander": 5e-18}, {"reference": {"steps": {"rate": 0.0, "covariance": [[1.0]]}, "value": [0.4]}}
    ),
    "LQG that knows it, with an operator": (
        {"known": True}, {"reference": {"steps": {"rate": 0.0, "covariance": [[1.0]]}, "value": [0.4]}}
    ),
    "LQG over a horizon": ({}, {"cost": {**TABLES["cost"], "horizon": 45, "terminal": [[0.0, 0.0], [0.0, 0.0]]}}),
    "LQG with a feedthrough": ({}, {"plant": {**TABLES["plant"], "D": [[0.2]]}}),
    "PID": ({}, {"controller": PID}),
    "PID with a set-point": ({}, {"controller": PID, "reference": {"value": [0.4]}}),
    "PID with send on delta": (
        {}, {"controller": PID, "policy": {"kind": "send-on-delta", "delta": 0.02, "period": 0.2}}
    ),
    "PID and distributed decisions": (
        {}, {"controller": PID, "policy": {"kind": "distributed", "theta": 0.1, "period": 0.2}}
    ),
    "PID at each sample": ({}, {"controller": PID, "policy": {"kind": "periodic", "period": 0.2}}),
}  # fmt: skip


CONSISTENT: dict[str, Any] = {
    "plant": {name: TABLES["plant"][name] for name in "ABW"},
    "policy": {"kind": "consistent", "period": 0.2},
}


def problem_of(load: dict[str, Any], changes: dict[str, Any]) -> Problem:
    """Return the problem with a load."""
    return parse({**TABLES, "disturbance": [{**HIDDEN, **load}], **changes}, "tables")


def load_at(time: float) -> float:
    """Return the load at a time."""
    return 0.1 if time < STEPS[0][0] else STEPS[0][1] if time < STEPS[1][0] else STEPS[1][1]


def own_path(problem: Problem, load: dict[str, Any], steps: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return states, inputs and cost per second of a plant in NumPy, whose nodes run in Python."""
    h, parts, nodes = 0.2, 20, Nodes(problem.design())
    F = np.zeros((4, 4))  # of (x, u, load), constant within a period
    F[:2, :2], F[:2, 2:3], F[:2, 3] = A, B, E
    Phi, x, u = expm(F * h / parts), np.zeros(2), np.zeros(1)
    reference = problem.source["reference"]["value"] if problem.source and "reference" in problem.source else []
    aware = bool(load.get("wander") or load.get("known"))
    Q, R, N = (np.array(TABLES["cost"][name]) for name in "QRN")
    M, D = np.block([[Q, N], [N.T, R]]), (problem.plant.D if problem.plant.D is not None else np.zeros((1, 1)))
    # x and u at which y = r in spite of the load, if the cost counts from there
    inverse = np.linalg.inv(np.block([[A, B], [C, D]]))
    inside, states, inputs, cost = np.r_[1, np.tile([4, 2], parts // 2)[:-1], 1] / 3 / parts, [], [], 0.0
    given = problem.design().model.set_points
    for k in range(steps):
        value = load_at(k * h + 1e-9)
        y = C @ x + D @ u + G * value
        known = [*reference, value][-given:] if load.get("known") else reference
        u = np.array(nodes.step(y.tolist(), **({"reference": known} if given else {})))
        states.append(x)
        inputs.append(u)
        rest = inverse @ np.r_[-E * value * aware, [*reference] or [0.0]]
        path, z = [], np.r_[x, u, value]
        for _ in range(parts + 1):
            path.append(z[:3] - rest)
            z = Phi @ z
        cost += float(inside @ np.einsum("ki,ij,kj->k", np.array(path), M, np.array(path))) * h
        x = (np.linalg.matrix_power(Phi, parts) @ np.r_[x, u, value])[:2]
    return np.array(states), np.array(inputs), cost / (steps * h)


@pytest.mark.parametrize("case", few(CASES, 7))
def test_a_path_under_a_load_is_that_of_the_plant_as_written(case: str) -> None:
    """States, inputs, and the integral of the cost between the samples too."""
    load, changes = CASES[case]
    problem, steps = problem_of(load, changes), 45
    x, u, cost = own_path(problem, load, steps)
    path = simulate(problem.close(problem.design()), steps)
    assert path.state[:, :2] == pytest.approx(x, abs=1e-6)
    assert path.input == pytest.approx(u, abs=1e-6)
    if load.get("known"):
        assert path.estimate == pytest.approx(path.state, abs=1e-6)
    horizon = problem.cost.horizon is not None
    assert path.cost == pytest.approx(cost * (steps * 0.2 if horizon else 1.0), rel=1e-5)


def test_an_unknown_load_costs_its_offset_and_the_integral_of_a_controller_removes_it() -> None:
    """LQG keeps the output off for ever; a PID controller brings it to 0 with the input that cancels the load."""
    matched = {"enters": B[:, 0].tolist(), "measured": [0.0], "initial": None}
    for changes, offset in (({}, True), ({"controller": PID}, False)):
        problem = problem_of(matched, changes)
        path = simulate(problem.close(problem.design()), 400)
        assert bool(abs(path.state[-1, 0]) > 0.02) is offset
        if not offset:
            assert path.state[-1, 0] == pytest.approx(0.0, abs=2e-3)
            assert path.input[-1] == pytest.approx(0.2, abs=2e-2)
        found = evaluate(problem, steps=40_000)
        assert found.cost.value == pytest.approx(mean_cost(problem), rel=1e-3)
        assert found.cost_bound is None
        assert any("a load acts on the plant that the design does not know" in note for note in found.notes)
        assert any("after the last change" in note for note in found.notes)


def mean_cost(problem: Problem) -> float:
    """Return the cost per second of a path long after the last change."""
    first, last = (simulate(problem.close(problem.design()), steps).cost * steps for steps in (2000, 4000))
    return (last - first) / 2000


def test_the_average_of_an_estimated_or_known_load_is_that_of_no_load_and_its_guarantee_holds() -> None:
    """Its changes are a transient."""
    noisy = {"plant": {**TABLES["plant"], "W": [[0.1, 0.0], [0.0, 0.1]], "V": [[0.01]]}}
    for load in ({"wander": 0.05}, {"known": True}):
        given, none = (problem_of({**load, **other}, noisy) for other in ({}, {"steps": None}))
        loops = [one.close(one.design()) for one in (given, none)]
        assert all(loop.nominal and loop.policy.guarantee is not None for loop in loops)
        costs = [average(loop, steps=4096).cost.value for loop in loops]
        assert costs[0] == costs[1]


def test_a_design_for_losses_does_not_see_a_load() -> None:
    """It computes the cost of the loop that attempts every packet."""
    losing = {
        "policy": {"kind": "distributed", "theta": 0.1, "period": 0.2},
        "network": {"protocol": "tcp", "actuator_loss": 0.1},
    }
    without = parse({**TABLES, **losing}, "tables").design()
    assert problem_of({}, losing).design().cost_all_time == without.cost_all_time


@pytest.mark.parametrize(
    ("load", "changes", "words"),
    [
        ({"steps": [[2, 0.1], [1, 0.3]]}, {}, r"disturbance\[0\].steps has the times \[2.0, 1.0\]; expected times"),
        ({"steps": []}, {}, r"disturbance\[0\].steps .* expected"),
        (
            {"steps": [[0, 0.1]]},
            {},
            "disturbance.0..initial is given, and disturbance.0..steps states a value at time 0",
        ),
        ({"kind": "ramp"}, {}, r"disturbance\[0\].initial is given for a ramp; expected it for a constant"),
        (
            {"known": True, "wander": 1e-3},
            {},
            r"known is true, but disturbance\[0\].wander is 0.001; expected the wand",
        ),
        ({"file": "load.csv"}, {}, r"disturbance\[0\].steps and disturbance\[0\].file are both given"),
        ({"steps": None, "file": "none.csv"}, {}, r"disturbance\[0\].file 'none.csv' cannot be read"),
        ({"steps": None, "initial": None}, {}, r"disturbance\[0\].wander is 0; expected 0 < disturbance\[0\].wander"),
        (
            {"steps": [[1e6, 1.0]]},
            {},
            "changes at time 1e.06, after 5e.06 sampling steps; expected changes within 100000",
        ),
        ({"wander": 0.1}, {"controller": PID}, "which a given controller does not use; expected .* wander = 0"),
        ({"known": True}, {"controller": PID}, "which a given controller does not use; expected .* wander = 0"),
        ({"measured": None}, CONSISTENT, "the actuator predicts between sampling instants"),
    ],
)
def test_what_a_load_states_wrongly_is_named(load: dict[str, Any], changes: dict[str, Any], words: str) -> None:
    """The key, what is wrong, and what is expected."""
    with pytest.raises(ProblemError, match=words):
        describe(problem_of(load, changes))


def test_a_file_states_the_same_load_as_steps(tmp_path: Any) -> None:
    """Rows of a time and the value from then on."""
    (tmp_path / "load.csv").write_text("# s, value\n" + "".join(f"{time}, {value}\n" for time, value in STEPS))
    stated = problem_of({"steps": None, "file": str(tmp_path / "load.csv")}, {})
    paths = [simulate(one.close(one.design()), 45) for one in (stated, problem_of({}, {}))]
    assert np.array_equal(paths[0].state, paths[1].state)
