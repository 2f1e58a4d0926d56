"""Operating points: what is given and what is measured is in the units of the plant, and costs count from the point."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from counts import few
from export.devices import needs_compiler
from runtime.loops import differing_ticks, record
from used import COST, KINDS, SEEN

import taciturn
from taciturn import PID, Cost, Network, Plant, Policy, Problem, ProblemError, Reference, design, linearise
from taciturn.lqg.discrete import discretise
from taciturn.model.disturbance import Disturbance, follow
from taciturn.model.dynamics import equilibrium
from taciturn.model.limits import Limits
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.packets import roles
from taciturn.model.plant import ContinuousPlant, about
from taciturn.model.signals import RandomSteps, Timetable
from taciturn.nodes.node import Node
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn_export.folder import record_loop
from taciturn_rare.violations import violations

QUICK = ("all-time", "lqg", "excess", "remote-lqg", "lossy-lqg", "distributed", "mixed", "consistent", "event-pid")
TANK = {"plant.operating_point.x": [12.4, 12.7, 1.8, 1.4], "plant.operating_point.u": [3.0, 3.0]}


def located(plant: Plant | ContinuousPlant, point: OperatingPoint, limit: Any = None) -> Any:
    """Return a plant around an operating point, with limits that are given in deviations."""
    limits = None if limit is None else np.array(limit) + point.u[:, None]
    others = {
        "C": plant.C, "V": plant.V, "mean": plant.mean + point.x, "covariance": plant.covariance,
        "input_limit": limits, "operating_point": point,
    }  # fmt: skip
    if isinstance(plant, Plant):
        return Plant(plant.A, plant.B, plant.W, dt=plant.dt, **others)
    return ContinuousPlant(plant.A, plant.B, None if plant.jumps else plant.W, plant.jumps, **others)


def somewhere(plant: Plant | ContinuousPlant) -> OperatingPoint:
    """Return an operating point without zeros."""
    return OperatingPoint(3.0 + np.arange(plant.states), -2.0 + 4.0 * np.arange(plant.inputs))


@pytest.mark.parametrize("kind", few(QUICK, 3, 1) + few(sorted(set(KINDS) - set(QUICK)), 0))
def test_a_point_moves_what_is_seen_and_nothing_else(kind: str) -> None:
    """Same seeds, same sends; states, inputs and measurements are moved by the point; costs and bounds are equal."""
    problem = KINDS[kind]
    point = somewhere(problem.plant)
    moved = replace(problem, plant=located(problem.plant, point))
    usual, there = problem.designed(), moved.designed()
    assert there.cost_all_time == usual.cost_all_time
    steps = None if kind == "optimal" else 2_000
    costs = [taciturn.evaluate(one, steps=steps) for one in (problem, moved)]
    assert costs[0].cost == costs[1].cost
    assert costs[0].cost_bound == costs[1].cost_bound
    if not isinstance(usual, Policy) or not isinstance(there, Policy):
        return
    loop = moved.close(there)
    one, other = taciturn.simulate(problem.close(usual), 120, seed=1), taciturn.simulate(loop, 120, seed=1)
    n = len(point.x)
    assert other.state[:, :n] - point.x == pytest.approx(one.state[:, :n], abs=1e-11)
    assert other.state[:, n:] == pytest.approx(one.state[:, n:], abs=1e-11)
    assert other.input - point.u == pytest.approx(one.input, abs=1e-11)
    assert other.measurement - problem.plant.C @ point.x == pytest.approx(one.measurement, abs=1e-11)
    if one.estimate.size:
        assert other.estimate[:, :n] - point.x == pytest.approx(one.estimate[:, :n], abs=1e-11)
    for link, sent in one.sends.items():
        assert np.array_equal(other.sends[link], sent)
    if there.prediction is None:
        for role in roles(there):  # after a fault, a node is degraded for as long as without a point
            assert (
                Node(there, role, network=moved.network).remembers == Node(usual, role, network=moved.network).remembers
            )
        records, draws = record(loop, 60, 2)
        assert differing_ticks(loop, records, draws)[0] == []


@pytest.mark.parametrize("kind", few(["lqg", "excess", "remote-lqg", "send-on-delta", "distributed", "event-pid"], 3))
def test_limits_are_in_the_units_of_the_plant(kind: str) -> None:
    """Nodes and filters use the input that is applied; the limits bind at their own values."""
    problem = KINDS[kind]
    point, limit = somewhere(problem.plant), [[-0.3, 0.2]] * problem.plant.inputs
    none = OperatingPoint(np.zeros(problem.plant.states), np.zeros(problem.plant.inputs))
    paths = []
    for at in (none, point):
        moved = replace(problem, plant=located(problem.plant, at, limit))
        loop = moved.close(moved.design())
        paths.append(taciturn.simulate(loop, 200, seed=1))
        low, high = at.u - 0.3, at.u + 0.2
        assert (paths[-1].input >= low - 1e-15).all()
        assert (paths[-1].input <= high + 1e-15).all()
        records, draws = record(loop, 80, 2)
        assert differing_ticks(loop, records, draws)[0] == []
    assert paths[1].input - point.u == pytest.approx(paths[0].input, abs=1e-10)
    assert np.ptp(paths[0].input) == pytest.approx(0.5 if kind != "event-pid" else np.ptp(paths[0].input))


@pytest.mark.evidence
def test_set_points_and_disturbances_are_in_the_units_of_the_outputs() -> None:
    """The tanks' levels are at their set-points in centimetres, and the pumps at volts."""
    tank = taciturn.load("quadruple-tank").changed({**TANK, "reference.value": [13.4, 12.2]})
    assert tank.plant.exosystem is not None
    assert tank.plant.exosystem.start == pytest.approx([1.0, -0.5])
    loop = tank.close(tank.design())
    assert loop.nominal
    path = taciturn.simulate(loop, 3_000, seed=1)
    assert path.measurement[500:].mean(axis=0) == pytest.approx([13.4, 12.2], abs=0.1)
    A, B, C = tank.plant.A, tank.plant.B, tank.plant.C
    volts = np.linalg.solve(C @ np.linalg.solve(-A, B), [1.0, -0.5])
    assert path.input[500:].mean(axis=0) == pytest.approx(3.0 + volts, abs=0.1)
    assert path.state[0, 4:] == pytest.approx([13.4, 12.2])
    records, draws = record(loop, 60, 2)
    assert differing_ticks(loop, records, draws)[0] == []


def test_a_set_point_of_a_controller_is_one_of_the_plant() -> None:
    """A PID controller around an operating point follows a set-point in the units of the output."""
    usual, point = KINDS["event-pid"], somewhere(KINDS["event-pid"].plant)
    plant = located(usual.plant, point)
    pid: Any = usual.controller
    r = float((plant.C @ point.x)[0])
    paths = []
    for one, at in ((usual.plant, 0.0), (plant, r)):
        kept = replace(pid, setpoint=at + 0.5, start_input=None if at == 0.0 else float(point.u[0]))
        kept = kept if at else replace(kept, start_input=0.0)
        policy = design.event_pid(one, usual.cost, controller=kept, **dict(usual.parameters))
        paths.append(taciturn.simulate(taciturn.close(one, policy), 200, seed=3))
    assert paths[1].measurement - r == pytest.approx(paths[0].measurement, abs=1e-10)
    assert paths[1].input - point.u == pytest.approx(paths[0].input, abs=1e-10)


def test_a_trajectory_is_one_of_the_plant() -> None:
    """A reference in the units of the plant is that of the deviations, moved by the point."""
    rover = taciturn.load("rover")
    assert rover.reference is None
    lossy, horizon = KINDS["lossy-lqg"], 8
    plant, cost = lossy.plant, Cost(np.eye(2), [[0.5]], horizon=horizon, terminal=np.eye(2))
    inputs = np.linspace(0.3, -0.2, horizon)[:, None]
    states = [np.array([1.0, 0.5])]
    for u in inputs:
        states.append(plant.A @ states[-1] + plant.B @ u)
    point = somewhere(plant)
    there = replace(lossy, plant=located(plant, point), cost=cost)
    usual = replace(lossy, cost=cost, reference=Reference(states, inputs))
    there = replace(there, reference=Reference(np.array(states) + point.x, inputs + point.u))
    one, other = (taciturn.simulate(p.close(p.design()), horizon, seed=5) for p in (usual, there))
    assert other.state - point.x == pytest.approx(one.state, abs=1e-12)
    assert other.input - point.u == pytest.approx(one.input, abs=1e-12)
    costs = [taciturn.evaluate(p, steps=4_000).cost.value for p in (usual, there)]
    assert costs[1] == pytest.approx(costs[0], rel=1e-12)
    worlds = [SimulatedPlant(p.close(p.design()), 3) for p in (usual, there)]
    stages = [
        [world.move(u + (at if i else 0.0)) for u in inputs[:3]]
        for i, (world, at) in enumerate(zip(worlds, (0, point.u), strict=True))
    ]
    assert stages[1] == pytest.approx(stages[0])
    assert worlds[1].final_cost() == pytest.approx(worlds[0].final_cost())


def tank_slopes(x: Any, u: Any) -> list[Any]:
    """Return the rates of the levels of two tanks in a row, by Torricelli's law."""
    return [u[0] - 0.5 * np.sqrt(x[0]), 0.5 * np.sqrt(x[0]) - 0.4 * np.sqrt(x[1])]


STEP = taciturn.integrate(tank_slopes, dt=0.5)


def nonlinear(**changes: Any) -> Plant:
    """Return the tanks at 16 and 25."""
    point = OperatingPoint([16.0, 25.0], [2.0])
    A, B = linearise(STEP, 2, 1, at=(point.x, point.u))
    given = {"dt": 0.5, "function": STEP, "operating_point": point, "mean": [17.0, 25.0], "input_limit": [[0.0, 5.0]]}
    return Plant(A, B, 1e-3 * np.eye(2), [[0.0, 1.0]], [[0.01]], **{**given, **changes})


def test_a_nonlinear_plant_is_a_function_of_its_own_states() -> None:
    """Real levels enter the function; the same loop with a function of deviations gives the same path and cost."""
    plant, cost = nonlinear(), Cost(np.diag([0.0, 1.0]), [[1.0]])
    x, u = np.array([16.0, 25.0]), np.array([2.0])

    def moved(z: Any, v: Any, w: Any) -> Any:
        return STEP(z + x, v + u, w) - x

    around = nonlinear(function=moved, operating_point=None, mean=[1.0, 0.0], input_limit=[[-2.0, 3.0]])
    policies = [design.excess(one, cost, theta=0.1) for one in (around, plant)]
    loops = [taciturn.close(one, policy) for one, policy in zip((around, plant), policies, strict=True)]
    one, other = (taciturn.simulate(loop, 200, seed=1) for loop in loops)
    assert other.state == pytest.approx(one.state + x, abs=1e-8)
    assert other.input == pytest.approx(one.input + u, abs=1e-8)
    assert other.state[0] == pytest.approx([17.0, 25.0])
    records = record_loop(loops[1], 80, 3)
    nodes = taciturn.Nodes(policies[1])
    assert np.array_equal([nodes.step(y) for y in records.measured], records.applied)
    costs = [taciturn.evaluate(policy, steps=3_000).cost.value for policy in policies]
    assert costs[1] == pytest.approx(costs[0], rel=1e-6)


def test_an_equilibrium_is_found_from_rounded_digits() -> None:
    """Newton's method needs a state nearby."""
    assert equilibrium(STEP, [15.2, 24.0], [2.0]) == pytest.approx([16.0, 25.0], abs=1e-10)
    with pytest.raises(ProblemError, match="no equilibrium of the function was found"):
        equilibrium(lambda x, u, w: x + 1.0, [0.0], [0.0])


def test_a_simulated_plant_elsewhere_takes_the_claims_away() -> None:
    """A plant that does not rest at the design's point is simulated in its own units, without a guarantee."""
    tank = taciturn.load("quadruple-tank").changed(TANK)
    actual = {**tank.source["plant"], "operating_point": {"x": [13.0, 13.0, 1.8, 1.4], "u": [3.0, 3.0]}}
    found = tank.changed({"plant.actual": actual})
    loop = found.close(found.design())
    assert loop.violated_assumptions == ("the plant does not rest at the operating point of the design",)
    told = found.changed({"reference.value": [13.0, 13.0], "reference.outputs": [[1, 0, 0, 0], [0, 1, 0, 0]]})
    assert "initial" not in " ".join(told.close(told.design()).violated_assumptions)  # set-points count from a point
    path = taciturn.simulate(loop, 1_500, seed=1)
    assert path.measurement[300:].mean(axis=0) == pytest.approx([12.4, 12.7], abs=0.15)
    same = tank.changed({"plant.actual": {key: rows for key, rows in actual.items() if key != "operating_point"}})
    assert same.close(same.design()).nominal
    lqg = replace(
        tank, plant=located(SEEN, somewhere(SEEN)), cost=COST, network=taciturn.Network(), kind="lqg", names=None
    )
    lqg = replace(lqg, parameters={"theta": 0.1}, actual=located(SEEN, OperatingPoint([0.0, 1.0], [1.0])))
    with pytest.raises(ProblemError, match=r"plant\.drift is given, which certificates"):
        taciturn.certify(lqg)


@pytest.mark.evidence
def test_certificates_hold_around_the_point() -> None:
    """They are those of the deviations."""
    problem = KINDS["lqg"]
    moved = replace(problem, plant=located(problem.plant, somewhere(problem.plant)))
    one, other = taciturn.certify(problem), taciturn.certify(moved)
    told = [{key: value for key, value in found.document().items() if key != "seconds"} for found in (one, other)]
    assert told[0] == told[1]


@pytest.mark.parametrize("payload", ["float32", "int16"])
def test_packets_are_rounded_in_the_units_of_the_plant(payload: str) -> None:
    """A range is that of the numbers in the packets, so it includes the point."""
    full = 128.0 if payload == "int16" else None
    moved = Problem(
        located(SEEN, OperatingPoint([300.0, 20.0], [100.0])), COST,
        taciturn.Network(payload=payload, actuator_range=full), "excess", {"theta": 0.3},
    )  # fmt: skip
    policy = moved.design()
    loop = moved.close(policy)
    path = taciturn.simulate(loop, 60, seed=1)
    assert path.input.mean() == pytest.approx(100.0, abs=3.0)
    changed = path.input[1:][np.diff(path.input[:, 0]) != 0]
    rounded = changed.astype(np.float32) if payload == "float32" else np.rint(changed / 128 * 32767) / 32767 * 128
    assert changed == pytest.approx(rounded, abs=1e-11)
    records, draws = record(loop, 60, 2)
    assert differing_ticks(loop, records, draws)[0] == []


@pytest.mark.evidence
def test_nodes_in_c_are_in_the_units_of_the_plant(tmp_path: Path) -> None:
    """The self-check compares measurements, decisions and inputs of the loop in units with those of the nodes in C."""
    compiler = needs_compiler()
    tank = taciturn.load("quadruple-tank").changed(
        {**TANK, "reference.value": [13.4, 12.2], "plant.input_limit": [[0.0, 10.0], [0.0, 10.0]]}
    )
    taciturn.export_c(tank, tmp_path, name="tank")
    sources = sorted(map(str, tmp_path.glob("*.c")))
    subprocess.run([compiler, "-std=c99", "-O1", *sources, "-lm", "-o", str(tmp_path / "check")], check=True)
    told = subprocess.run([str(tmp_path / "check")], capture_output=True, text=True, check=True).stdout
    assert "every decision and every bit of the input agrees" in told


def test_what_has_no_point_is_as_before() -> None:
    """Without an operating point, the policy in the units of the plant is the policy itself."""
    for name in ("lqg", "distributed", "event-pid"):
        policy = KINDS[name].design()
        assert policy.in_units is policy
        assert KINDS[name].close(policy).in_units.policy is policy


def test_a_controller_states_another_set_point_than_zero() -> None:
    """As 0 means the output at the operating point, a 0 that is written down is refused."""
    tank = taciturn.load("pid-tank")
    n, m = tank.plant.states, tank.plant.inputs
    point = {"plant.operating_point.x": [5.0] * n, "plant.operating_point.u": [1.0] * m}
    assert tank.changed(point).design().cost_all_time == tank.design().cost_all_time
    with pytest.raises(
        ProblemError, match=r"set-point 0 for output 1, but this output is 5 at plant.operating_point; expected"
    ):
        tank.changed({**point, "controller.pid.setpoint": 0.0})


def test_changing_set_points_are_in_the_units_of_the_outputs() -> None:
    """Steps at random times and a timetable are moved by the point, also in what the controller is given."""
    table = Timetable([0, 20, 50], [[1.0], [3.0], [1.0]])
    point = somewhere(SEEN)
    y = float((SEEN.C @ point.x)[0])
    for usual, there in (
        ({"changes": table}, {"changes": Timetable(table.times, table.values + y)}),
        (
            {"value": [1.0], "changes": RandomSteps(0.05, [[1.0]])},
            {"value": [1.0 + y], "changes": RandomSteps(0.05, [[1.0]])},
        ),
    ):
        plants = follow(SEEN, **usual), follow(located(SEEN, point), **there)
        policies = [design.excess(plant, COST, theta=0.2) for plant in plants]
        assert policies[0].cost_all_time == policies[1].cost_all_time
        loops = [taciturn.close(plant, policy) for plant, policy in zip(plants, policies, strict=True)]
        one, other = (taciturn.simulate(loop, 100, seed=4) for loop in loops)
        assert other.state - np.append(point.x, y) == pytest.approx(one.state, abs=1e-11)
        assert other.input - point.u == pytest.approx(one.input, abs=1e-11)


def test_a_set_point_at_the_operating_point_changes_nothing() -> None:
    """Cost and guarantee are those without set-points."""
    point = somewhere(SEEN)
    plants = [follow(located(SEEN, point), value=value) for value in (None, SEEN.C @ point.x)]
    policies = [design.excess(plant, COST, theta=0.2) for plant in plants]
    assert policies[0].cost_all_time == pytest.approx(policies[1].cost_all_time, rel=1e-12)
    costs = [policy.guarantee.cost for policy in policies if policy.guarantee is not None]
    assert costs[0] == pytest.approx(costs[1], rel=1e-12)


def test_the_simulated_plant_may_have_another_operating_point() -> None:
    """With a set-point at that of the design: outputs are at the set-point, and inputs are those of the plant."""
    tables: dict[str, Any] = {
        "plant": {"A": [[0.9]], "B": [[0.2]], "C": [[1.0]], "W": [[1e-4]], "V": [[1e-4]], "dt": 1.0},
        "cost": {"Q": [[1.0]], "R": [[0.1]]},
        "policy": {"kind": "lqg", "theta": 0.2},
        "disturbance": [{"enters": [1.0], "kind": "constant", "wander": 1e-6}],
        "reference": {"value": [2.0]},
    }
    plant = dict(tables["plant"])
    tables["plant"]["operating_point"] = {"x": [2.0], "u": [1.0]}
    tables["plant"]["actual"] = {**plant, "operating_point": {"x": [2.5], "u": [1.5]}}
    problem = taciturn.problem.parse(tables, "two points")
    found = taciturn.simulate(problem.close(problem.design()), 20_000, seed=1)
    assert found.measurement[2000:].mean() == pytest.approx(2.0, abs=2e-3)
    needed = 1.5 + (0.1 * (2.0 - 2.5) - found.state[:, 1]) / 0.2  # with the disturbance
    assert (found.input[:, 0] - needed)[2000:].mean() == pytest.approx(0.0, abs=5e-3)


def test_costs_count_from_the_point_of_the_design_also_if_another_plant_is_simulated() -> None:
    """Moved to a set-point elsewhere with the matrices of the simulated plant; the input that it needs costs."""
    plant = {"A": [[0.9]], "B": [[0.2]], "C": [[1.0]], "W": [[1e-4]], "V": [[1e-4]], "dt": 1.0}
    actual = {**plant, "B": [[0.25]], "operating_point": {"x": [2.5], "u": [1.5]}}
    tables: dict[str, Any] = {
        "plant": {**plant, "operating_point": {"x": [2.0], "u": [1.0]}, "actual": actual},
        "cost": {"Q": [[1.0]], "R": [[0.1]]},
        "policy": {"kind": "excess", "delta": 0.0},
        "disturbance": [{"enters": [1.0], "kind": "constant", "wander": 1e-6}],
        "reference": {"value": [3.0]},
    }
    problem = taciturn.problem.parse(tables, "two points")
    loop = problem.close(problem.design())
    path, cost = taciturn.simulate(loop, 20_000, seed=1), taciturn.average(loop, steps=200_000).cost
    x, d, u = path.state[2000:, 0], path.state[2000:, 1], path.input[2000:, 0]
    stage = (x - 3.0) ** 2 + 0.1 * (u - (1.0 + 0.1 * (3.0 - 2.0) / 0.25) + d / 0.25) ** 2
    assert stage.mean() == pytest.approx(cost.value, rel=0.05)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"operating_point.x": [12.4, 12.7, 1.8, 1.4]}, "the key plant.operating_point.u is missing; expected it in"),
        (
            {"operating_point.x": [12.4], "operating_point.u": [3.0, 3.0]},
            r"point.x has shape \(1,\); expected",
        ),
        (
            {"operating_point": {**{"x": [0.0] * 4}, "u": [3.0]}},
            r"operating_point.u has shape \(1,\); expected the shape \(2,\)",
        ),
        (
            {"operating_point.x": ["a"] * 4, "operating_point.u": [3.0, 3.0]},
            "point.x.0. is 'a'; expected a num",
        ),
        ({"operating_point": {"x": [0.0] * 4, "u": [3.0, 3.0], "y": [1.0]}}, "operating_point.y is not a known key"),
        (
            {"operating_point": {"x": [0.0] * 4, "u": [12.0, 3.0]}, "input_limit": [[0.0, 10.0], 10.0]},
            r"operating_point.u is 12 for input 1, beyond its input_limit \[0, 10\]; expected an input within",
        ),
    ],
)
def test_bad_points_are_refused_in_a_sentence(changes: dict[str, Any], message: str) -> None:
    """Sizes, numbers, keys and limits."""
    with pytest.raises(ProblemError, match=message):
        taciturn.load("quadruple-tank").changed({f"plant.{key}": value for key, value in changes.items()})


def test_a_range_that_excludes_the_point_is_refused() -> None:
    """Otherwise every packet would carry the end of the range."""
    plant = located(SEEN, OperatingPoint([2.0, 1.0], [3.0]))
    policy = design.lqg(plant, COST, theta=0.2)
    taciturn.close(plant, policy, Network(payload="int16", actuator_range=6.0))
    with pytest.raises(ProblemError, match=r"actuator_range is \[2.5\], but at the operating point .* \[3.0\]"):
        taciturn.close(plant, policy, Network(payload="int16", actuator_range=2.5))


def test_a_function_that_does_not_rest_is_refused() -> None:
    """The message has the state that is reached, and how to find one that stays."""
    with pytest.raises(
        ProblemError, match=r"the function returns 20.1\d* as state 2 at the operating point.*equilibrium\("
    ):
        nonlinear(operating_point=OperatingPoint([16.0, 20.0], [2.0]))
    plant = nonlinear()
    with pytest.raises(ProblemError, match=r"with respect to u at the operating point has .*at=\(x, u\)"):
        Plant(plant.A, 2 * plant.B, plant.W, dt=0.5, function=STEP, operating_point=plant.operating_point)


def test_limits_of_states_are_in_the_units_of_the_plant() -> None:
    """The probability of a violation is that of the deviations, with limits that are moved by the point."""
    problem, point = KINDS["lqg"], somewhere(SEEN)
    found = []
    for at in (OperatingPoint([0.0, 0.0], [0.0]), point):
        moved = replace(problem, plant=located(SEEN, at))
        limits = Limits([[1.0, 0.0]], [at.x[0] - 2.0], [at.x[0] + 1.5])
        found.append(violations(moved.close(moved.design()), limits, seed=1, steps=200_000))
    assert found[1].total.per_step.value == pytest.approx(found[0].total.per_step.value, rel=1e-9)
    assert found[0].total.per_step.value > 0


def beside(point: OperatingPoint, plant: Plant | ContinuousPlant) -> OperatingPoint:
    """Return a point of a plant that may have a slow disturbance, which rests at 0."""
    return OperatingPoint([*point.x, *np.zeros(plant.states - len(point.x))], point.u)


@pytest.mark.parametrize("of", [Plant, ContinuousPlant])
def test_limits_do_not_depend_on_the_points_between(of: Any) -> None:
    """At a point, and in the units of the plant, limits have the same bits whatever way they were counted before.

    (0.9 − u) + u is not 0.9 for most u, so that a plant compared with itself had another limit.
    """
    draws = np.random.default_rng(0)
    for _ in range(20):
        here, there = (OperatingPoint([x], [u]) for x, u in draws.uniform(-0.3, 0.9, (2, 2)))
        limit = [[-0.3, 0.9]]
        time = {"dt": 1.0} if of is Plant else {}
        plant = of([[-0.1]], [[0.1]], [[1.0]], input_limit=limit, operating_point=here, **time)
        slow = Disturbance(20.0, 0.1).completed(plant, 1.0)
        for one in (plant, slow.added_to(plant), slow.stepped(plant)):
            cost = Cost(np.eye(one.states), [[1.0]])
            sampled = discretise(one, cost, 1.0).plant if of is ContinuousPlant else one
            assert np.array_equal(about(sampled, None).input_limit, limit)
            assert np.array_equal(
                about(about(sampled, beside(there, one)), beside(here, one)).input_limit, plant.input_limit
            )
            assert sampled.linear.stated_limit is None


@pytest.mark.parametrize("setpoint", few([0.1, 0.2, 0.3, 0.5, 0.7], 1, 2))
def test_rounded_packets_take_nothing_else_away(setpoint: float) -> None:
    """With rounded packets, a loop is in the units of the plant; rows and burn-in are those of the same design."""
    plant = Plant([[0.9]], [[0.1]], [[0.001]], [[1.0]], [[0.01]], 1.0, input_limit=[[-0.3, 0.9]])
    keep = PID(0.5, 0.05, setpoint=setpoint, disturbance=Disturbance(20.0, 0.1))
    rounded, exact = (
        Problem(plant, Cost([[1.0]], [[0.1]]), Network(payload=payload), "excess", {"delta": 0.001}, controller=keep)
        for payload in ("float32", "float64")
    )
    policy = rounded.designed()
    assert policy.in_units.theory.settling == policy.theory.settling > 0
    assert policy.in_units.theory.recovers == policy.theory.recovers
    found, other = (taciturn.evaluate(one, steps=1024).after_step for one in (rounded, exact))
    assert found is not None
    assert other is not None
    assert found.cost.value == pytest.approx(other.cost.value, abs=4 * other.cost.standard_error)
