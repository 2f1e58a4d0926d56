"""Set-points that change while the loop runs: costs of their transients, bounds, timetables, and refusals."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from counts import few
from export.devices import needs_compiler
from runtime.loops import differing_ticks, record
from systems import make_system, well_posed

from taciturn import (
    PID,
    ContinuousPlant,
    Cost,
    Disturbance,
    Network,
    Plant,
    Problem,
    average,
    close,
    design,
    export_c,
    load,
    simulate,
)
from taciturn.base.certainty import design_certainty
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import discretise
from taciturn.model.disturbance import follow
from taciturn.model.network import NodeRole
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.signals import Changes, ExternalDisturbance, RandomSteps, Signal, Timetable
from taciturn.problem import parse
from taciturn.simulation.average import completed_squares, plain_average

A = np.array([[0.9, 0.2, 0], [0, 0.8, 0.3], [0, 0, 1.05]])
B = np.array([[0, 0.1], [0.5, 0], [0.2, 1.0]])
C = np.array([[1.0, 0, 0], [0, 0, 1.0]])
COST = Cost(C.T @ C + 0.1 * np.eye(3), 0.1 * np.eye(2))
PUSH = ExternalDisturbance([0.0, 0.3, 0.1], 1e-3)


def plant_with(*disturbances: ExternalDisturbance, value: tuple[float, ...] = (1.0, -2.0)) -> Plant:
    """Return the plant with disturbances and set-points."""
    return follow(Plant(A, B, 0.02 * np.eye(3), C, 0.05 * np.eye(2)), C, value, disturbances)


def test_a_kind_that_does_not_use_changing_set_points_says_so_of_any_nodes() -> None:
    """The set-points are outputs of the plant to the library, but not in the file: none of these is named."""
    tank = load("quadruple-tank")
    plant = follow(
        tank.plant, [[1.0, 0, 0, 0], [0, 1.0, 0, 0]], changes=Timetable([0, 30, 60], [[0, 0], [2, -1], [0, 0]])
    )
    with pytest.raises(
        ProblemError,
        match=r"the set-points change \(reference.steps or reference.file\), which the policy kind send-on-delta does",
    ):
        design.send_on_delta(plant, tank.cost, delta=0.1, network=tank.network, period=4.0)


def test_held_values_follow_set_points_that_change() -> None:
    """Of several nodes: set-points are no outputs of a sensor, and a timetable needs no more packets later."""
    tank = load("quadruple-tank")
    table = Timetable([0, 30, 60], [[0, 0], [2, -1], [0, 0]])
    plant = follow(tank.plant, [[1.0, 0, 0, 0], [0, 1.0, 0, 0]], changes=table)
    loop = close(plant, design.distributed(plant, tank.cost, theta=0.3, network=tank.network, period=4.0))
    assert average(loop, steps=20_000).notes == ()


STEPS = RandomSteps(0.01, [[4.0, 1.0], [1.0, 9.0]])
TIMES = Timetable([0, 7, 20, 31, 50], [[1, -2], [2, 0], [0, 0], [0, 5], [1, -2]])


def changing(changes: RandomSteps | Timetable) -> Plant:
    """Return the plant of the reference with a disturbance and set-points that change."""
    value = None if isinstance(changes, Timetable) else (1.0, -2.0)
    return follow(Plant(A, B, 0.02 * np.eye(3), C, 0.05 * np.eye(2)), C, value, [PUSH], changes)


@pytest.mark.parametrize("changes", [STEPS, TIMES], ids=["steps", "timetable"])
def test_set_points_that_change_cost_their_transients(changes: RandomSteps | Timetable) -> None:
    """The cost with every sample and the identity are exact: a simulation of the plant agrees."""
    plant = changing(changes)
    constant = design.all_time(plant_with(PUSH), COST).cost_all_time
    policy = design.excess(plant, COST, delta=0.1)
    assert constant is not None
    assert policy.cost_all_time is not None
    assert policy.cost_all_time > 1.5 * constant
    always, loop = close(plant, design.all_time(plant, COST)), close(plant, policy)
    assert loop.nominal
    plain = average(always, plain_average(always), seed=1, steps=2_000_000).cost
    assert abs(plain.value - policy.cost_all_time) < 4 * plain.standard_error
    whole = average(loop, plain_average(loop), seed=1, steps=2_000_000)
    assert policy.guarantee is not None
    bound = policy.guarantee.at_rates(whole.rates, "actuator")
    assert bound is not None
    assert whole.cost.value < bound.value + 4 * whole.cost.standard_error
    if isinstance(changes, Timetable):  # with whose changes an error of the input is correlated
        assert policy.theory.identity is None
        return
    squares = average(loop, completed_squares(loop), seed=2, steps=200_000).cost
    error = np.hypot(whole.cost.standard_error, squares.standard_error)
    assert abs(whole.cost.value - squares.value) < 4 * error
    assert squares.value < policy.cost_all_time + 0.1


@pytest.mark.parametrize("times", [[0, 3, 6], [0, 4, 5, 12]])
def test_a_given_controller_meets_a_change_before_the_last_one_is_over(times: list[int]) -> None:
    """The cost with every sample is that of the noise plus that of the path without noise, step by step."""
    A, B, C, W, V = np.array([[0.9, 0.2], [0, 0.7]]), np.array([0.1, 0.5]), np.array([[1.0, 0]]), 0.1 * np.eye(2), 0.2
    levels = np.array([0.0, 1, -2, 0][: len(times) - 1])
    kept = PID(0.4, 0.1, disturbance=Disturbance(deviation=0.0))
    plant, cost = Plant(A, B[:, None], W, C, [[V]], dt=1.0), Cost(np.diag([1.0, 0]), [[0.5]])
    steps = Timetable(times, [[level] for level in (*levels, levels[0])])
    policy = design.distributed(follow(plant, C, None, [], steps), cost, theta=0.5, controller=kept)
    noise = design.distributed(plant, cost, theta=0.5, controller=kept)
    x, integral, total, cycle = np.zeros(2), 0.0, 0.0, times[-1]
    per_level = 0.1 / (0.1 + 0.2 * 0.5 / 0.3)  # input that holds the output at 1
    for k in range(60 * cycle):
        r = levels[np.searchsorted(times, k % cycle, side="right") - 1]
        u = 0.4 * (r - x[0]) + 0.1 * integral
        total += ((x[0] - r) ** 2 + 0.5 * (u - per_level * r) ** 2) * (k >= 59 * cycle)
        x, integral = A @ x + B * u, integral + r - x[0]
    assert noise.cost_all_time is not None
    assert policy.cost_all_time == pytest.approx(noise.cost_all_time + total / cycle, rel=1e-9)


def test_a_controller_that_cannot_reach_set_points_is_told_what_it_lacks() -> None:
    """Its loop is stable apart from the set-points, so neither its sign nor its gains are wrong."""
    plant = follow(Plant([[0.9]], [[0.5]], [[0.1]], [[1.0]], [[0.2]]), np.eye(1), (0.0,), [], RandomSteps(0.1, [[1.0]]))
    with pytest.raises(UnstableError, match="set-points that change also need a controller that integrates"):
        design.distributed(plant, Cost([[1.0]], [[1.0]]), theta=0.5, controller=[[0.5]])


@pytest.mark.parametrize("seed", [197, *few(range(190), 3)])
def test_a_set_point_that_a_gain_cannot_hold_has_no_cost(seed: int) -> None:
    """Rounding may let the mode of a set-point decay (in 197), and the sum of infinite costs was then some number."""
    draws = np.random.default_rng(seed)
    A, B, C, D = (draws.standard_normal((2, 2)) for _ in range(4))
    D = np.diag([D[0, 0], 0.0]) if seed % 2 else D
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    A, B, C, D = (np.round(one, 4) for one in (A, B, C, D))
    while np.abs(np.linalg.eigvals(A - B @ D @ C)).max() > 0.95:
        D /= 2
    plant = Plant(A, B, 0.1 * np.eye(2), C, 0.1 * np.eye(2))
    resting = follow(plant, C, (0.0, 0.0), [], RandomSteps(0.0, np.eye(2)))
    with pytest.raises(UnstableError, match="eigenvalue 1; expected"):
        design.excess(resting, Cost(np.eye(2), np.eye(2)), theta=0.3, controller=D)


def test_a_feedthrough_is_named_where_a_given_controller_follows_set_points(tmp_path: Path) -> None:
    """The file lists no outputs of set-points, so none of these is at fault."""
    text = """
        [plant]
        A = [[0.9]]
        B = [[0.5]]
        C = [[1.0]]
        D = [[0.1]]
        W = [[0.1]]
        V = [[0.2]]
        dt = 1.0
        [reference]
        steps = {rate = 0.1, covariance = [[1.0]]}
        [cost]
        Q = [[1.0]]
        R = [[1.0]]
        [policy]
        kind = "distributed"
        theta = 0.5
        """
    kept = "[controller]\npid = {kp = 0.3, ki = 0.1}\n"
    (tmp_path / "problem.toml").write_text(text + kept, encoding="utf-8")
    with pytest.raises(ProblemError, match=r"plant\.D is given, and the set-points change"):
        load(tmp_path / "problem.toml").design()
    (tmp_path / "problem.toml").write_text(text + "guarantee = 'every path'\n", encoding="utf-8")
    assert load(tmp_path / "problem.toml").design().guarantee is not None


@pytest.mark.parametrize("pace", [1, 4])
def test_a_schedule_of_measurements_costs_the_transients_of_a_timetable(pace: int) -> None:
    """Errors of the estimate do not depend on set-points, so the means cost what they do without noise."""
    table = Timetable(pace * np.array([0, 2, 3, 5]), [[1, -2], [2, 0], [0, 5], [1, -2]])
    plant = changing(table)
    policy, constant = (design.variance(one, COST, threshold=0.2) for one in (plant, plant_with(PUSH)))
    problem = discretise(plant, COST, None)
    L, model, last = problem.regulator().L, problem.plant, 5 * pace
    x, spent = np.array(model.mean), 0.0
    for k in range(60 * last):
        x[-2:] = table.values[np.searchsorted(table.times, k % last, "right") - 1] - table.values[0]
        u = L @ x
        spent += (x @ problem.Q @ x + u @ problem.R @ u + 2 * x @ problem.N @ u) * (k >= 59 * last)
        x = model.A @ x + model.B @ u
    found, still = policy.theory.closed_form, constant.theory.closed_form
    assert found is not None
    assert still is not None
    assert found.rates == still.rates
    assert found.cost == pytest.approx(still.cost + spent / last, rel=1e-9)


@pytest.mark.parametrize("sensors", [("hold", "hold"), ("model", "model")])
def test_sensors_that_decide_need_not_know_the_set_points(sensors: tuple[str, str]) -> None:
    """Only the controller is given them; the bound of the whole holds."""
    plant = changing(STEPS)
    policy = design.distributed(plant, COST, theta=0.5, prediction=sensors[0], actuation=sensors[1])  # type: ignore[arg-type]
    found = average(close(plant, policy), seed=1, steps=200_000)
    assert policy.guarantee is not None
    assert policy.cost_all_time is not None
    assert policy.cost_all_time < found.cost.value < policy.guarantee.cost
    path = simulate(close(plant, policy), steps=20_000, seed=3)
    apart = path.state[:, :3] @ C.T - path.state[:, -2:]
    means = apart.reshape(50, -1, 2).mean(axis=1)
    assert (np.abs(means.mean(axis=0)) < 4 * means.std(axis=0, ddof=1) / np.sqrt(50)).all()


@pytest.mark.parametrize("outputs", [((0,), (1,)), ((0, 1), ())], ids=["each one", "one both"])
def test_where_the_set_points_begin_does_not_matter_to_sensors_that_predict(
    outputs: tuple[tuple[int, ...], ...],
) -> None:
    """A change moves every set-point alike, and a sensor that forgot what its output shows would send all the time."""
    nodes = {f"s{i}": NodeRole(measures=rows) for i, rows in enumerate(outputs) if rows}
    network = Network(nodes={**nodes, "c": NodeRole(controls=True), "a": NodeRole(applies=True)})
    rates = []
    for value in ((0.0, 0.0), (5.0, -20.0)):
        plant = follow(
            Plant(A, B, 0.02 * np.eye(3), C, 0.05 * np.eye(2)), C, value, changes=RandomSteps(1e-4, np.eye(2))
        )
        policy = design.distributed(plant, COST, theta=0.5, prediction="model", network=network)
        sends = simulate(close(plant, policy), 600).sends
        rates.append([float(sends[node][100:].mean()) for node in nodes])
    assert np.abs(np.subtract(*rates)).max() < 0.01
    assert max(rates[0]) < 0.9


def test_a_timetable_is_followed_from_its_first_row() -> None:
    """The last states are the set-points, which the measurement does not contain."""
    plant = changing(TIMES)
    path = simulate(close(plant, design.excess(plant, COST, delta=0.1)), 60)
    assert path.state[[0, 6, 7, 31, 49, 50], -2:].tolist() == [[1, -2], [1, -2], [2, 0], [0, 5], [0, 5], [1, -2]]
    assert path.measurement.shape == (60, 2)


def test_sends_at_fixed_steps_keep_their_phase_in_a_timetable() -> None:
    """A cycle of two steps begins with a timetable of four: a change never meets a send, though phases were mixed."""
    plant = follow(
        Plant([[0.8]], [[1.0]], [[1e-6]], [[1.0]], [[1e-6]]), changes=Timetable([0, 1, 3, 4], np.c_[[0, 9, 0, 0]])
    )
    loop = close(plant, design.periodic(plant, Cost([[1.0]], [[0.1]]), every=2))
    found, run = average(loop, steps=20_000), simulate(loop, 400, seed=1)
    x, r = run.state[200:].T
    costs = (x - r) ** 2 + 0.1 * (run.input[200:, 0] - 0.2 * r) ** 2  # deviations from x = r, u = 0.2 r
    assert abs(costs.mean() - found.cost.value) < 1e-3 * found.cost.value


def test_a_change_between_sampling_instants_takes_effect_at_the_next() -> None:
    """And its size is unchanged."""
    table = Timetable([0, 0.24, 1.0], [[0.0], [3.0], [0.0]]).sampled(0.1).table
    assert table[:, 0].tolist() == [0, 0, 3, 0, 0, 0, 0, 0, 0, -3]
    assert RandomSteps(0.5, [[2.0]]).sampled(0.1).noise == pytest.approx(0.1)


def test_the_tables_of_a_file_state_changes(tmp_path: Path) -> None:
    """As steps at random times, or as a timetable in a file."""
    tables = {
        "plant": {"A": [[0.9]], "B": [[1.0]], "C": [[1.0]], "W": [[0.1]], "V": [[0.1]], "dt": 1.0},
        "cost": {"Q": [[1.0]], "R": [[0.1]]},
        "policy": {"kind": "excess", "theta": 0.1},
    }
    (tmp_path / "levels.csv").write_text("# s, level\n0, 1\n20, 3\n50, 1\n")
    steps = {"rate": 0.01, "covariance": [[4.0]]}
    path = str(tmp_path / "levels.csv")
    for reference, noise in (({"steps": steps}, 0.04), ({"file": path}, 0.16)):
        plant = parse({**tables, "reference": reference}, "x").plant
        assert plant.exosystem is not None
        assert plant.exosystem.W[-1, -1] == pytest.approx(noise)
    for reference, words in (
        ({"steps": steps, "file": path}, "reference.steps and reference.file are both given"),
        ({"file": path, "value": [1.0]}, "reference.value and reference.file are both given"),
        ({"file": "none.csv"}, "'none.csv' cannot be read"),
        ({"steps": {"rate": 2.0, "covariance": [[1.0]]}}, "more than one step in each sampling period"),
        ({"steps": {"rate": 0.1, "covariance": [[0.0]]}}, "covariance is zero"),
        (
            {"steps": {"rate": 0.1, "covariance": [[1.0, 0], [0, 1.0]]}},
            r"covariance states changes of 2",
        ),
    ):
        with pytest.raises(ProblemError, match=words):
            parse({**tables, "reference": reference}, "x").design()


@pytest.mark.parametrize("seed", few(range(100), 3))
def test_a_timetable_pulls_at_errors_of_the_input(seed: int) -> None:
    """The bound contains the derivative of the cost of the noise-free loop with respect to each error of the input."""
    rng = np.random.default_rng(seed)
    system = make_system(seed, int(rng.integers(1, 5)), int(rng.integers(1, 3)), int(rng.integers(1, 3)), False)
    if not (well_posed(system.plant.A, system.plant.B) and well_posed(system.plant.A.T, system.plant.C.T)):
        pytest.skip("the random plant is hardly controllable")
    base, steps = system.plant, int(rng.integers(2, 7))
    values = rng.standard_normal((steps, 1))
    table = Timetable(range(steps + 1), np.vstack([values, values[:1]]))
    plant = follow(base, rng.standard_normal((1, base.states)), changes=table)
    problem = discretise(plant, system.cost, None)
    found = design_certainty("excess", problem)
    assert found.timed
    n, followed, moves = base.states, problem.followed, np.diff(table.values, axis=0)
    assert followed is not None
    shift = followed.T[:n, n:] @ moves.T  # of the deviation from (Xd, Ud), by each change
    L, cost = found.regulator.L[:, :n], system.cost
    closed = base.A + base.B @ L

    def periodic_cost(errors: np.ndarray) -> float:
        """Return the cost per step of the loop without noise, with errors of the input that repeat."""
        x, power = np.zeros(n), np.linalg.matrix_power(closed, steps)
        for k in range(steps):
            x = closed @ x + base.B @ errors[k] + shift[:, k]
        x, total = np.linalg.solve(np.eye(n) - power, x), 0.0
        for k in range(steps):
            u = L @ x + errors[k]
            total += x @ cost.Q @ x + u @ cost.R @ u + 2 * x @ cost.N @ u
            x = base.A @ x + base.B @ u + shift[:, k]
        return total / steps

    none, square = np.zeros((steps, base.inputs)), 0.0
    for k in range(steps):
        unit = np.eye(steps * base.inputs).reshape(-1, steps, base.inputs)[k * base.inputs : (k + 1) * base.inputs]
        slopes = np.array([periodic_cost(one) - periodic_cost(none - one) for one in unit]) * steps / 4  # of 2e'g
        square += slopes @ np.linalg.solve(found.regulator.H, slopes) / steps
    assert found.pull == pytest.approx(np.sqrt(square), rel=1e-6)


@pytest.mark.parametrize("theta", few([0.5, 0.05, 3.0], 1))
@pytest.mark.parametrize("seed", few(range(40), 2))
def test_bounds_hold_with_timetables(seed: int, theta: float) -> None:
    """Held inputs are correlated with the changes; the bound allows for this, in advance and at the rate."""
    rng = np.random.default_rng(seed)
    system = make_system(seed, int(rng.integers(1, 4)), int(rng.integers(1, 3)), int(rng.integers(1, 3)), False)
    if not (well_posed(system.plant.A, system.plant.B) and well_posed(system.plant.A.T, system.plant.C.T)):
        pytest.skip("the random plant is hardly controllable")
    table = Timetable([0, 4, 9, 12], [[0.0], [5.0], [-3.0], [0.0]])
    plant = follow(system.plant, rng.standard_normal((1, system.plant.states)), changes=table)
    for policy in (
        design.excess(plant, system.cost, theta=theta),
        design.distributed(plant, system.cost, theta=theta),
    ):
        found, guarantee = average(close(plant, policy), seed=seed, steps=200_000), policy.guarantee
        assert guarantee is not None
        sharper = guarantee.at_rates(found.rates, policy.scheduled[0])
        assert sharper is not None
        slack = 4 * found.cost.standard_error + 1e-9 * guarantee.cost
        assert found.cost.value <= min(sharper.value + 4 * sharper.standard_error, guarantee.cost) + slack


def test_the_error_of_a_held_input_is_correlated_with_a_timetable() -> None:
    """Nearly without noise: completed squares would give .3486, and the bound would be .3492 at the rate."""
    plant = follow(Plant([[0.7]], [[1.0]], [[1e-8]], [[1.0]], [[1e-8]]), changes=Timetable([0, 3, 6], [[0], [1], [0]]))
    policy = design.excess(plant, Cost([[1.0]], [[0.1]]), delta=0.003434)
    found = average(close(plant, policy), steps=100_000).cost
    assert found.value == pytest.approx(0.37513, abs=2e-4)  # an independent simulation
    assert policy.guarantee is not None
    assert found.value < policy.guarantee.cost < 0.42
    clocked = design.periodic(plant, Cost([[1.0]], [[0.1]]), every=2)
    assert clocked.theory.closed_form is None
    assert average(close(plant, clocked), steps=100_000).rates["actuator"].value == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("period", few([0.5, 0.1, 1.0, 2.0], 1))
@pytest.mark.parametrize("steps", [False, True])
def test_set_points_do_not_change_between_sampling_instants(period: float, steps: bool) -> None:
    """So the inter-sample noise cost is that of the noise alone, and a change costs K Δr²."""
    tank = ContinuousPlant([[-1.0]], [[1.0]], [[1e-8]], C=[[1.0]], V=[[1e-8]])
    changes = RandomSteps(0.1, [[1.0]]) if steps else Timetable([0, 10, 20], [[0.0], [1.0], [0.0]])
    cost = Cost([[1.0]], [[0.1]])
    problem = discretise(follow(tank, changes=changes), cost, period)
    alone = discretise(tank, cost, period)
    K = design_certainty("lqg", alone).regulator.K.item()
    assert problem.noise_cost == pytest.approx(alone.noise_cost, rel=1e-9)
    found = design.lqg(follow(tank, changes=changes), cost, theta=0.0, period=period).cost_all_time
    assert found == pytest.approx(K * 0.1, rel=2e-3)  # transients hardly overlap, and there is hardly any noise


def test_one_of_two_set_points_may_never_change() -> None:
    """With random steps and with a timetable; the controller is given both."""
    tank = load("quadruple-tank")
    levels = [[1.0, 0, 0, 0], [0, 1.0, 0, 0]]
    for one, nearly in (
        (RandomSteps(0.002, [[4.0, 0], [0, 0]]), RandomSteps(0.002, [[4.0, 0], [0, 1e-9]])),
        (Timetable([0, 40, 80], [[0, 1], [2, 1], [0, 1]]), Timetable([0, 40, 80], [[0, 1], [2, 1 + 1e-6], [0, 1]])),
    ):
        costs = [
            design.excess(follow(tank.plant, levels, changes=changes), tank.cost, theta=0.3, period=4.0).cost_all_time
            for changes in (one, nearly)
        ]
        assert costs[0] == pytest.approx(costs[1], rel=1e-5)


def test_tables_are_changed_as_a_whole() -> None:
    """Also those that the file did not have; a later change of a key keeps them."""
    push = {"enters": [-1.0, 0.0, 0.0, 0.0], "wander": 1e-4}
    found = load("quadruple-tank").changed({"disturbance": [push], "reference": {"value": [1.0, -1.0]}})
    assert found.plant.exosystem is not None
    assert found.plant.exosystem.start.tolist() == [0.0, 1.0, -1.0]
    without = found.changed({"disturbance": None}).plant.exosystem
    assert without is not None
    assert without.start.tolist() == [1.0, -1.0]
    with pytest.raises(ProblemError, match=r"values is \[1\]; expected a Mapping"):
        found.changed([1])  # type: ignore[arg-type]


def test_what_set_points_that_change_are_refused() -> None:
    """A timetable that would shift, disturbances that would be replaced, and thresholds that would grow."""
    tank = ContinuousPlant([[-1.0]], [[1.0]], [[0.1]], C=[[1.0]], V=[[0.1]])
    cost, table = Cost([[1.0]], [[1.0]]), Timetable([0, 10, 20], [[0.0], [1.0], [0.0]])
    with pytest.raises(ProblemError, match=r"reference.file lasts 20, .* step 0.3, .*; expected, for example, 20.1"):
        design.lqg(follow(tank, changes=table), cost, theta=0.1, period=0.3)
    with pytest.raises(ProblemError, match="already has disturbances or set-points; expected a plant without them"):
        follow(follow(tank, changes=table), value=[1.0])
    with pytest.raises(
        ProblemError, match=r"size of the state, which grows with disturbances and set-points; expected a trigger with"
    ):
        design.relative(follow(tank, value=[1.0]), cost, sigma=0.1, period=0.5)
    with pytest.raises(ProblemError, match=r"disturbance\.enters and disturbance\.measured are zero"):
        ExternalDisturbance([0.0], 1e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("# seconds, level\n0, 1\n\n5, x\n", "column 2 of line 4 is 'x', which is not a finite number"),
        ("0, 1\r\n5, nan\r\n", "column 2 of line 2 is 'nan', which is not a finite number"),
        (
            "time, level\n0, 1\n",
            "column 1 of line 1 is 'time', which is not a finite number); expected rows .* without a header",
        ),
        ("\n\n0, 1\n# held\n5, 2, 3\n", "line 5 has 3 columns, and line 3 has 2"),
        ("", "at least two times"),
    ],
)
def test_a_mistake_in_a_file_of_set_points_is_named_by_its_line_as_editors_count(
    text: str, words: str, tmp_path: Path
) -> None:
    """Comments and empty lines are lines; the first line and the first column are 1."""
    (tmp_path / "levels.csv").write_bytes(text.encode())
    tank = {"A": [[0.9]], "B": [[1.0]], "W": [[0.1]], "C": [[1.0]], "V": [[0.1]], "dt": 0.5}
    tables = {"plant": tank, "cost": {"Q": [[1.0]], "R": [[1.0]]}, "policy": {"kind": "excess", "theta": 0.1}}
    with pytest.raises(ProblemError, match=words.replace("number)", r"number\)")):
        parse({**tables, "reference": {"file": str(tmp_path / "levels.csv")}}, "tank")


class Sinusoids(Changes):
    """A form of set-point that the package does not have: a sum of sinusoids about a mean, in discrete time."""

    frequencies = (0.02, 0.11)  # radians per step
    size = 1

    def states(self, continuous: bool) -> Signal:
        """Return the sinusoids with the amplitudes 1 and 0.4, each as a state that rotates with another one."""
        S, turn = np.zeros((4, 4)), np.array([[0.0, 1.0], [-1.0, 0.0]])
        for i, w in enumerate(self.frequencies):
            S[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = np.cos(w) * np.eye(2) + np.sin(w) * turn
        return Signal(S, np.zeros((4, 4)), np.array([0.0, 1.0, 0.0, 0.4]), F=np.array([[-1.0, 0.0, -1.0, 0.0]]))


@pytest.mark.evidence
def test_a_form_of_set_point_is_one_signal(tmp_path: Path) -> None:
    """Design, simulation, nodes and C code follow it, also about an operating point, and to follow it costs nothing."""
    compiler, cost = needs_compiler(), Cost([[1.0, 0.0], [0.0, 0.0]], [[0.1]])
    matrices = [[0.95, 0.2], [0.0, 0.8]], [[0.0], [0.3]]
    plant = Plant(
        *matrices, 1e-6 * np.eye(2), [[1.0, 0.0]], [[1e-6]], operating_point=OperatingPoint([4.0, 1.0], [2.0])
    )
    still, moved = follow(plant, value=[5.0]), follow(plant, value=[5.0], changes=Sinusoids())
    policy, constant = (design.excess(one, cost, delta=1e-3) for one in (moved, still))
    assert policy.cost_all_time == pytest.approx(constant.cost_all_time, rel=1e-9)
    assert policy.model.operating_point is not None
    loop, k = close(moved, policy), np.arange(2000)
    path = simulate(loop, len(k), seed=3)
    r = 5.0 + np.sin(0.02 * k) + 0.4 * np.sin(0.11 * k)
    assert np.abs(path.state[: len(k), 0] - r)[100:].max() < 0.05
    records, draws = record(loop, 60, 2)
    assert differing_ticks(loop, records, draws)[0] == []
    export_c(Problem(moved, cost, Network(), "excess", {"delta": 1e-3}), tmp_path, name="waves")
    sources = sorted(map(str, tmp_path.glob("*.c")))
    subprocess.run([compiler, "-std=c99", "-O1", *sources, "-lm", "-o", str(tmp_path / "check")], check=True)
    told = subprocess.run([str(tmp_path / "check")], capture_output=True, text=True, check=True).stdout
    assert "every decision and every bit of the input agrees" in told
