"""Given controllers whose set-points change: bounds and identities, their inputs for set-points, losses, and rates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import taciturn
from taciturn import PID, Cost, Disturbance, Plant, ProblemError, average, close, design
from taciturn.model.disturbance import follow
from taciturn.model.signals import Changes, RandomSteps, Timetable
from taciturn.problem import Problem, parse
from taciturn.simulation.average import completed_squares, plain_average

STEP = 0.1
TANK = Plant([[1, STEP], [0, 0.9]], [[0], [STEP]], np.diag([1e-4, 4e-4]), [[1, 0]], [[1e-3]], dt=STEP)
WEIGHTS = Cost(np.diag([1.0, 0.0]), [[0.05]])
KEPT = PID(1.2, 0.15, 1.0, 0.5, Disturbance(deviation=0.0), b=0.6, c=0.2)
OPERATOR = RandomSteps(0.02, [[0.5]])
LEVELS = Timetable([0, 60, 100, 160], [[0.0], [1.0], [-1.0], [0.0]])
FILE = """
[plant]
A = [[1, 0.1], [0, 0.9]]
B = [[0], [0.1]]
C = [[1, 0]]
W = [[1e-4, 0], [0, 4e-4]]
V = [[1e-3]]
dt = 0.1

[cost]
Q = [[1, 0], [0, 0]]
R = [[0.05]]

[policy]
kind = "excess"
theta = 0.4
"""
PID_TABLE = (
    '[controller]\npid = {kp = 1.2, ki = 0.15, kd = 1.0, filter = 0.5, b = 0.6, c = 0.2}\ndisturbance = "none"\n'
)
# the same controller: u = −(C z + D y) + G r and z⁺ = A z + B y + F r
MATRICES = """[controller]
A = [[1, 0], [0, 0.8]]
B = [[0.1], [0.2]]
C = [[0.15, -2]]
D = [[3.2]]
F = [[-0.1], [-0.04]]
G = [[1.12]]
disturbance = "none"
"""
STEPS = "[reference]\nvalue = [0.5]\nsteps = {rate = 0.02, covariance = [[0.5]]}\n"


def tank(changes: Changes) -> Plant:
    """Return the tank with set-points of its level."""
    return follow(TANK, TANK.C, None if isinstance(changes, Timetable) else [0.5], [], changes)


def problem(*tables: str) -> Problem:
    """Return the problem of the file with more tables."""
    import tomllib

    return parse(tomllib.loads("\n".join((FILE, *tables))), "tank.toml")


@pytest.mark.parametrize("changes", [OPERATOR, LEVELS], ids=["operator", "timetable"])
@pytest.mark.parametrize("options", [{}, {"actuation": "model"}], ids=["held", "predicted"])
def test_the_stage_cost_is_what_the_identity_says_and_within_the_bound(changes: Changes, options: dict) -> None:
    """Also if silence is compared with a packet before changes that the rule knows."""
    policy = design.excess(tank(changes), WEIGHTS, theta=0.4, controller=KEPT, **options)
    loop = close(tank(changes), policy, cost=WEIGHTS)
    plain = average(loop, plain_average(loop), seed=1, steps=1_000_000).cost
    found = average(loop, completed_squares(loop), seed=1, steps=1_000_000)
    assert abs(plain.value - found.cost.value) < 4 * np.hypot(plain.standard_error, found.cost.standard_error)
    assert policy.guarantee is not None
    bound = policy.guarantee.at_rates(found.rates, "actuator")
    assert bound is not None
    assert found.cost.value < bound.value + 4 * found.cost.standard_error


def test_the_path_without_noise_costs_what_a_timetable_adds() -> None:
    """Counted step by step, with a PID controller that is written out here."""
    x, integral, filtered, total, cycle = np.zeros(2), 0.0, 0.0, 0.0, 160
    levels = np.repeat([0.0, 1.0, -1.0], [60, 40, 60])
    for k in range(60 * cycle):
        r = levels[k % cycle]
        u = 1.2 * (0.6 * r - x[0]) + 0.15 * integral + (0.2 * r - x[0] - filtered) / 0.5
        total += ((x[0] - r) ** 2 + 0.05 * u**2) * (k >= 59 * cycle)
        integral += STEP * (r - x[0])
        filtered += STEP / 0.5 * (0.2 * r - x[0] - filtered)
        x = TANK.A @ x + TANK.B[:, 0] * u
    noise = design.excess(tank(RandomSteps(0.0, [[0.0]])), WEIGHTS, theta=0.4, controller=KEPT)
    found = design.excess(tank(LEVELS), WEIGHTS, theta=0.4, controller=KEPT)
    bands = design.send_on_delta(tank(LEVELS), WEIGHTS, delta=0.1, controller=KEPT)
    assert noise.cost_all_time is not None
    assert found.cost_all_time == pytest.approx(noise.cost_all_time + total / cycle, rel=1e-8)
    assert bands.cost_all_time == pytest.approx(found.cost_all_time, rel=1e-8)


@pytest.mark.parametrize("changes", [OPERATOR, LEVELS], ids=["operator", "timetable"])
@pytest.mark.parametrize("kind", ["event-pid", "event-pid-saturated", "symmetric-send-on-delta"])
def test_a_dead_band_of_almost_nothing_leaves_the_controller_as_it_was(kind: str, changes: Changes) -> None:
    """It then sends every sample: the path is that of all-time, and events at a change of the set-point do no harm."""
    every = design.all_time(tank(changes), WEIGHTS, controller=KEPT)
    events = getattr(design, kind.replace("-", "_"))(tank(changes), WEIGHTS, controller=KEPT, delta=1e-9)
    paths = [taciturn.simulate(close(tank(changes), one, cost=WEIGHTS), 400, seed=3) for one in (every, events)]
    np.testing.assert_allclose(paths[1].input, paths[0].input, atol=1e-6)
    np.testing.assert_allclose(paths[1].measurement, paths[0].measurement, atol=1e-6)


@pytest.mark.parametrize("kind", ["event_pid", "event_pid_saturated", "excess"])
def test_the_first_command_is_the_input_before_the_start(kind: str) -> None:
    """Also with a set-point that may change, which the controller weights."""
    plant = follow(
        Plant([[0.95]], [[0.05]], [[1e-4]], [[1.0]], [[1e-4]], 1.0, [5.0]), [[1.0]], [5.0], [], RandomSteps(0, [[0]])
    )
    pid = PID(0.8, 0.05, start_input=3.0, b=0.7, disturbance=Disturbance(deviation=0.0))
    given = {"theta": 0.1} if kind == "excess" else {"delta": 1e-9}
    policy = getattr(design, kind)(plant, Cost([[1.0]], [[1.0]]), controller=pid, **given)
    assert taciturn.Nodes(policy).step([5.0]) == pytest.approx([3.0])


def test_a_silent_event_pid_computes_when_its_set_point_changes() -> None:
    """Without any packet: the integral counts the steps so far with the former set-point."""
    plant = tank(Timetable([0, 1, 2], [[0.0], [2.0], [0.0]]))
    policy = design.event_pid(plant, WEIGHTS, controller=KEPT, delta=1e6)
    nodes, h, (kp, ki, kd, T, b, c) = taciturn.Nodes(policy), STEP, (1.2, 0.15, 1.0, 0.5, 0.6, 0.2)
    inputs = [nodes.step([0.0], reference=[r])[0] for r in [0.0] * 5 + [2.0] * 4 + [0.0] * 2]
    slope = [kd * -c * 2.0 / (T - h + 6 * h)]  # as if a packet had come a step before the start
    slope.append(((T - h) * slope[0] + kd * c * 2.0) / (T - h + 4 * h))
    first = -(kp * -b * 2.0 + slope[0])
    integral = -ki * h * 2.0  # of the step of the change; the four steps from then on are counted at the next change
    second = -(integral + slope[1])
    np.testing.assert_allclose(inputs, [0.0] * 5 + [first] * 4 + [second] * 2, atol=1e-12)


def test_weights_of_set_points_are_inputs_of_the_controller() -> None:
    """A PID controller with b and c, and the same controller with F and G, are one policy."""
    first, second = (problem(table, STEPS).design() for table in (PID_TABLE, MATRICES))
    assert first.cost_all_time == pytest.approx(second.cost_all_time, rel=1e-12)
    squares = [close(tank(OPERATOR), one, cost=WEIGHTS) for one in (first, second)]
    costs = [average(one, seed=3, steps=20_000).cost.value for one in squares]
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)


def test_a_continuous_controller_samples_its_inputs_for_set_points_as_its_measurements() -> None:
    """So F = −B and G = −D change nothing."""
    A, B, C, D = np.array([[0.0]]), np.array([[1.0]]), np.array([[-0.15]]), np.array([[-1.2]])
    own = taciturn.controller_from(_system(A, B, C, D), sign="positive", F=-B, G=-D).at(STEP, 1, 1)
    none = taciturn.controller_from(_system(A, B, C, D), sign="positive").at(STEP, 1, 1)
    for found, expected in zip(own.reads, none.reads, strict=True):
        assert found == pytest.approx(expected)


def _system(A: object, B: object, C: object, D: object) -> object:
    import scipy.signal

    return scipy.signal.StateSpace(A, B, C, D)


def test_a_constant_set_point_is_one_that_an_operator_may_change() -> None:
    """It costs nothing until then, and the nodes are given it."""
    still = problem(PID_TABLE, "[reference]\nvalue = [0.5]\n")
    moving = still.design()
    assert moving.model.set_points == 1
    without = problem(PID_TABLE.replace(", b = 0.6, c = 0.2", "")).design()
    assert moving.cost_all_time == pytest.approx(without.cost_all_time, rel=1e-9)
    nodes = taciturn.Nodes(moving)
    x = np.zeros(2)
    for _ in range(400):
        x = TANK.A @ x + TANK.B @ nodes.step(TANK.C @ x, reference=[2.0])
    assert x[0] == pytest.approx(2.0, abs=0.3)  # within what silence allows


@pytest.mark.parametrize("every", [1, 2])
def test_a_link_that_drops_packets_keeps_set_points(every: int) -> None:
    """Neither an attempt nor a dropped packet changes a loop at rest; the value of a lossy base is finite."""
    network = '[network]\nprotocol = "tcp"\nactuator_loss = 0.2\n'
    found = problem(PID_TABLE, STEPS, network).changed({"every": every})
    loop = found.close(found.design())
    plain = average(loop, plain_average(loop), seed=1, steps=2_000_000).cost
    squares = average(loop, completed_squares(loop), seed=1, steps=2_000_000).cost
    assert abs(plain.value - squares.value) < 4 * np.hypot(plain.standard_error, squares.standard_error)


def test_rates_around_a_change_are_told() -> None:
    """With constant set-points, that of a file without steps; shortly after a change, another one."""
    threshold = {"theta": None, "delta": 3e-3}  # θ is a share of a cost that contains the steps
    found = taciturn.evaluate(problem(PID_TABLE, STEPS).changed(threshold), steps=400_000)
    still = taciturn.evaluate(problem(PID_TABLE, "[reference]\nvalue = [0.5]\n").changed(threshold), steps=400_000)
    around = found.set_point_steps
    assert around is not None
    assert still.set_point_steps is None
    constant, after = around.steady["actuator"], around.after["actuator"]
    alone = still.rates["actuator"]
    assert abs(constant.value - alone.value) < 4 * np.hypot(constant.standard_error, alone.standard_error)
    assert abs(after.value - constant.value) > 10 * np.hypot(after.standard_error, constant.standard_error)
    document = found.document()
    assert {"rates_steady", "rate_after_step", "window"} <= document.keys()
    assert f"within {around.window:.3g} s after a change" in str(found)


@pytest.mark.evidence
def test_rates_after_a_change_are_counted_on_another_way() -> None:
    """Nodes in Python, one path after another, from rest."""
    read = problem(PID_TABLE, STEPS)
    around = taciturn.evaluate(read, steps=50_000).set_point_steps
    assert around is not None
    policy, window, rng = read.design(), round(around.window / STEP), np.random.default_rng(7)
    sent = list[int]()
    for _ in range(40):
        nodes, x, count = taciturn.Nodes(policy), np.array([0.5, 0.0]), 0
        r = 0.5
        for k in range(300 + window):
            if k == 300:
                r += np.sqrt(0.5) * rng.standard_normal()
            y = x[:1] + np.sqrt(1e-3) * rng.standard_normal(1)
            u = nodes.step(y, reference=[r])
            count += (k >= 300) * bool(nodes.sent["actuator"])
            x = TANK.A @ x + TANK.B @ u + np.sqrt(np.diag(TANK.W)) * rng.standard_normal(2)
        sent.append(count)
    rate = np.mean(sent) / window
    error = np.std(sent) / np.sqrt(len(sent)) / window
    assert abs(rate - around.after["actuator"].value) < 4 * error


def test_a_window_as_long_as_a_timetable_holds_all_packets() -> None:
    """Then there are no steps with constant set-points."""
    plant = tank(Timetable([0, 5, 10], [[0.0], [1.0], [0.0]]))
    found = taciturn.evaluate(
        Problem(plant, WEIGHTS, taciturn.Network(), "excess", {"theta": 0.4}, controller=KEPT), steps=400_000
    )
    around, rate = found.set_point_steps, found.rates["actuator"]
    assert around is not None
    assert not around.steady
    after = around.after["actuator"]
    assert abs(after.value - rate.value) < 4 * np.hypot(after.standard_error, rate.standard_error)


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ((MATRICES,), "controller.F is given, an effect of set-points, without [reference]"),
        ((MATRICES.replace("G = [[1.12]]", "G = [[1.12, 0]]"), STEPS), "controller.F and controller.G have 1 and 2"),
        ((MATRICES.replace("F = [[-0.1], [-0.04]]", "").replace("G = [[1.12]]", "G = [[1, 1]]"), STEPS), "2 columns"),
        ((PID_TABLE, STEPS.replace("[reference]", "[reference]\noutputs = [[2, 0]]")), "not a measured output"),
        ((PID_TABLE.replace("b = 0.6", "setpoint = 1.0, b = 0.6"), STEPS), "are both given"),
        ((PID_TABLE,), "pid.b or pid.c is given without pid.setpoint"),
    ],
)
def test_what_does_not_fit_is_refused(tables: tuple[str, ...], words: str) -> None:
    """In one sentence."""
    with pytest.raises(ProblemError) as told:
        problem(*tables).design()
    assert words in str(told.value)


def test_a_timetable_needs_a_link_that_drops_nothing(tmp_path: Path) -> None:
    """The cost of silence before known changes is derived for a packet in every step that arrives."""
    (tmp_path / "levels.csv").write_text("0, 0\n60, 1\n160, 0\n")
    file = f'[reference]\nfile = "{tmp_path / "levels.csv"}"\n'
    network = '[network]\nprotocol = "tcp"\nactuator_loss = 0.2\n'
    with pytest.raises(ProblemError, match=r"change at known times .* and the link drops packets"):
        problem(PID_TABLE, file, network).design()
    with pytest.raises(ProblemError, match="only the controller receives the set-points"):
        problem(PID_TABLE, STEPS).changed({"link": "sensor"}).design()


def test_only_measurements_are_watched_for_surprises() -> None:
    """A change of a set-point, however large, is no sign of a fault, so it causes no alarm."""
    read = problem(PID_TABLE, STEPS).changed({"theta": 5.0})
    nodes, x, sent = taciturn.Nodes(read.design()), np.array([0.5, 0.0]), 0
    for k in range(400):
        u = nodes.step(x[:1], reference=[0.5 if k < 100 else 50.0])
        sent += (k >= 150) * bool(nodes.sent["actuator"])
        x = TANK.A @ x + TANK.B @ u
    assert sent < 125
