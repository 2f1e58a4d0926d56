"""Controllers of users, from problem files, MATLAB files, python-control and scipy, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.signal

import taciturn
from taciturn import (
    PID,
    ContinuousPlant,
    Controller,
    Cost,
    Disturbance,
    Plant,
    ProblemError,
    UnstableError,
    controller_from,
    design,
)
from taciturn.study.record import fingerprint

STEP = 0.1
TANK = Plant([[1, STEP], [0, 0.9]], [[0], [STEP]], np.diag([1e-4, 4e-4]), [[1, 0]], [[1e-3]], dt=STEP)
WEIGHTS = Cost(np.diag([1.0, 0.0]), [[0.05]])
KEPT = PID(1.2, 0.15, 1.0, 0.5, Disturbance(deviation=0.0))
ALL_TIME = 0.00272706026
PLAIN = scipy.signal.StateSpace([[0.0]], [[1.0]], [[0.15]], [[1.2]])


def cost_of(controller: object) -> float:
    """Return the cost of a controller that sends every sample."""
    return design.excess(TANK, WEIGHTS, theta=0.1, controller=controller).cost_all_time


def test_systems_of_other_packages_are_controllers() -> None:
    """A transfer function, its state space, and the discrete system have the same cost; so have static gains."""
    control = pytest.importorskip("control")
    K = control.tf([1.2, 0.15], [1, 0]) + control.tf([1.0, 0], [0.5, 1])
    sampled = control.sample_system(control.ss(K), STEP, "tustin")
    other = scipy.signal.TransferFunction(K.num[0][0], K.den[0][0])
    costs = [cost_of(one) for one in (K, control.ss(K), sampled, other)]
    assert costs == pytest.approx([costs[0]] * 4, rel=1e-9)
    gains = [cost_of(one) for one in (1.2, [[1.2]], np.array([[1.2]]), [PID(1.2)], PID(1.2))]
    assert gains == pytest.approx([gains[0]] * 5, rel=1e-12)


@pytest.mark.parametrize("method", ["tustin", "zoh"])
def test_a_continuous_controller_is_sampled(method: str) -> None:
    """By the formulas of an integrator: the trapezoidal rule adds half a step, constant measurements do not."""
    found = controller_from(PLAIN, method=method).at(STEP, 1, 1)
    assert found.D.item() == pytest.approx(-1.2 - (0.15 * STEP / 2 if method == "tustin" else 0.0))
    assert (found.C @ found.B).item() == pytest.approx(-0.15 * STEP)
    assert found.integrates
    assert controller_from(PLAIN, sign="positive").at(STEP, 1, 1).D.item() > 0


def test_pid_loops_of_several_inputs_are_one_controller() -> None:
    """Each loop reads its output and moves its input; the loops of one input add up."""
    loops = controller_from([PID(1.0, 0.5, input=2), PID(2.0, output=2), PID(0.1, output=3)])
    found = loops.at(STEP, 2, 3)
    assert found.D.tolist() == [[0.0, -2.0, -0.1], [-1.0, 0.0, 0.0]]
    assert found.C.tolist() == [[0.0], [-0.5]]
    assert found.B.tolist() == [[STEP, 0.0, 0.0]]


def test_a_matrix_file_holds_the_controller(tmp_path: Path) -> None:
    """Its matrices with Ts, in continuous time, or a gain by its name; relative to the problem file."""
    kept = KEPT.at(STEP, 1, 1)
    scipy.io.savemat(tmp_path / "kept.mat", {"A": kept.A, "B": kept.B, "C": -kept.C, "D": -kept.D, "Ts": STEP})
    assert read(tmp_path, 'file = "kept.mat"').design().cost_all_time == pytest.approx(ALL_TIME, rel=1e-8)
    np.savez(tmp_path / "slow.npz", A=PLAIN.A, B=PLAIN.B, C=PLAIN.C, D=PLAIN.D, dt=0.0, K=[[1.2]])
    for method in ("tustin", "zoh"):
        expected = cost_of(controller_from(PLAIN, method=method, disturbance=KEPT.disturbance))
        found = read(tmp_path, f'file = "slow.npz"\nmethod = "{method}"').design().cost_all_time
        assert found == pytest.approx(expected, rel=1e-12)
    assert read(tmp_path, 'file = "slow.npz:K"').design().cost_all_time == pytest.approx(cost_of(1.2), rel=1e-12)
    for name, words in (
        ("slow.npz:L", "has no variable L; expected one of its variables A, B"),
        ("a.mat", "cannot be read"),
    ):
        with pytest.raises(ProblemError, match=words):
            read(tmp_path, f'file = "{name}"')
    with pytest.raises(ProblemError, match=r"steps of 0\.1 s; expected no method"):
        read(tmp_path, 'file = "kept.mat"\nmethod = "zoh"')


def test_the_delay_of_a_controller_in_a_matrix_file_is_not_dropped(tmp_path: Path) -> None:
    """A delay of zero is none."""
    gain = {"A": np.zeros((0, 0)), "B": np.zeros((0, 1)), "C": np.zeros((1, 0)), "D": [[1.2]], "Ts": 0.1}
    np.savez(tmp_path / "late.npz", **gain, InputDelay=1.0)
    with pytest.raises(ProblemError, match=r"late.npz has InputDelay \[1.0\]; expected a system without delays"):
        read(tmp_path, 'file = "late.npz"')


FILE = """
[plant]
A = [[1.0, 0.1], [0.0, 0.9]]
B = [[0.0], [0.1]]
C = [[1.0, 0.0]]
W = [[1e-4, 0.0], [0.0, 4e-4]]
V = [[1e-3]]
dt = 0.1

[cost]
Q = [[1.0, 0.0], [0.0, 0.0]]
R = [[0.05]]

[policy]
kind = "excess"
theta = 0.1

[controller]
"""
MATRICES = "A = [[1.0, 0.0], [0.0, 0.8]]\nB = [[0.1], [0.2]]\nC = [[0.15, -2.0]]\nD = [[3.2]]"


def read(tmp_path: Path, controller: str) -> taciturn.Problem:
    """Return the problem of a file with this controller."""
    text = FILE + controller + ("" if "disturbance" in controller else '\ndisturbance = "none"')
    (tmp_path / "tank.toml").write_text(text, encoding="utf-8")
    return taciturn.load(tmp_path / "tank.toml")


@pytest.mark.parametrize(
    "controller",
    [
        "pid = [{kp = 1.2, ki = 0.15}, {kp = 0.0, kd = 1.0, filter = 0.5}]",
        "pid = {kp = 1.2, ki = 0.15, kd = 1.0, filter = 0.5}",
        'pid = {kp = -1.2, ki = -0.15, kd = -1.0, filter = 0.5}\nsign = "positive"',
        MATRICES,
        MATRICES.replace("[[0.15, -2.0]]", "[[-0.15, 2.0]]").replace("3.2", "-3.2") + '\nsign = "positive"',
    ],
)
def test_a_problem_file_names_the_controller(tmp_path: Path, controller: str) -> None:
    """By its gains or its matrices; a changed parameter keeps it, and the digest depends on it."""
    problem = read(tmp_path, controller)
    assert problem.design().cost_all_time == pytest.approx(ALL_TIME, rel=1e-8)
    assert problem.changed({"theta": 0.2}).design().cost_all_time == pytest.approx(ALL_TIME, rel=1e-8)
    others = [problem.changed({"plant.V": [[2e-3]]}), replace(problem, controller=PID(1.0))]
    assert all(other.design().cost_all_time != pytest.approx(ALL_TIME, rel=1e-3) for other in others)
    assert len({fingerprint(one) for one in (problem, *others)}) == 3


def test_a_problem_file_states_the_disturbance(tmp_path: Path) -> None:
    """Its missing key has the default value."""
    table = "pid = {kp = 1.2, ki = 0.15, kd = 1.0, filter = 0.5}\ndisturbance = {deviation = 0.3}"
    policy = read(tmp_path, table).design()
    assert policy.disturbance.deviation.tolist() == [0.3]
    assert "deviation 0.3 (time_constant by default" in policy.notes[-1]


@pytest.mark.parametrize(
    ("controller", "words"),
    [
        ("D = [[1.2]]\npid = {kp = 1.2}", "controller.pid and controller.D are both given; expected only one of them"),
        (
            'sign = "negative"',
            "[controller] describes no controller; expected the key 'pid' or 'file', or the matrices A, B, C and D",
        ),
        ("A = [[1.0]]\nD = [[1.2]]", "the controller has A, D but no B, C; expected A, B, C and D, or only D"),
        ("D = [[1.2]]\nmethod = 'zoh'", "controller.method is given with only D"),
        ("D = [[1.2]]\ndisturbance = {time_constant = 1e7, deviation = 0.1}", "1e+08 steps; expected at most 1e+06"),
        ("pid = {kp = 1.0}\nmethod = 'zoh'", "controller.method is given with pid"),
        ("pid = {kp = 1.0}\nfile = 'a.mat'", "controller.pid and controller.file are both given"),
        ("file = 'none.mat'", "none.mat' cannot be read"),
        (MATRICES + "\nE = [[0.0], [0.0]]\nmethod = 'zoh'", "controller.E is given with a continuous controller"),
        ("pid = [{kp = 1.0, output = 2}]", "pid.output is 2; expected a number from 1 to 1"),
        ("pid = {kp = 1.2, kd = 1.0}", "pid.filter is missing"),
        ("pid = {kp = 1.2, kf = 1.0}", "controller.pid.kf is not a known key"),
        ('D = [[1.2]]\nsign = "minus"', "controller.sign is 'minus'; expected 'negative' or 'positive'"),
        ('D = [[1.2]]\ndisturbance = "some"', "controller.disturbance is 'some'; expected a table or 'none'"),
        ("D = [[1.2, 0.0]]", "the controller has 2 measurements; expected 1 measurement, as of the plant"),
        ("A = [[0.5, 0.0]]\nB = [[1.0]]\nC = [[1.0]]", "controller.A has shape (1, 2); expected a square matrix"),
    ],
)
def test_a_wrong_table_is_refused(tmp_path: Path, controller: str, words: str) -> None:
    """In one sentence."""
    with pytest.raises((ProblemError, UnstableError)) as told:
        read(tmp_path, controller).design()
    assert words in str(told.value)


def test_a_controller_can_be_removed_from_a_problem() -> None:
    """What remains is the problem with LQG."""
    problem = taciturn.load("pid-tank").changed({"controller": None})
    assert problem.controller is None
    assert problem.design().disturbance is None
    one = problem.changed({"cost.horizon": 1}).design()
    assert one.guarantee.cost == pytest.approx(1.1 * one.cost_all_time)


def test_other_kinds_refuse_a_controller(tmp_path: Path) -> None:
    """Instead of ignoring it."""
    problem = read(tmp_path, "D = [[1.2]]")
    for kind, more in (("lqg", {}), ("near-optimal", {"theta": None, "price": 0.01})):
        with pytest.raises(ProblemError, match=f"is given, which the policy kind {kind} does not use"):
            problem.changed({"kind": kind} | more).designed()


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: PID(1.0, kd=1.0), "pid.filter is missing; expected the time constant"),
        (lambda: PID(1.0, kd=1.0, filter=0.01).at(0.1, 1, 1), "pid.filter is 0.01 s, and a step takes 0.1 s"),
        (lambda: PID(1.0).at(None, 1, 1), "plant.dt is missing"),
        (lambda: PID(np.nan), "pid.kp is nan"),
        (lambda: Disturbance(0.0), "disturbance.time_constant is 0"),
        (
            lambda: Disturbance(deviation=[-1.0]),
            "disturbance.deviation is [-1.0]; expected a standard deviation of at least 0",
        ),
        (
            lambda: design.excess(TANK, WEIGHTS, theta=1, controller=replace(KEPT, disturbance=Disturbance(9, [1, 1]))),
            "disturbance.deviation has 2 entries; expected 1 entry, one for each input",
        ),
        (
            lambda: design.excess(
                Plant(TANK.A, TANK.B, np.zeros((2, 2)), TANK.C, TANK.V, STEP),
                WEIGHTS,
                theta=1,
                controller=PID(1.2, 0.15),
            ),
            "disturbance.deviation is missing, and it cannot be derived from W, because some input has no process",
        ),
        (lambda: design.excess(TANK, WEIGHTS, theta=0.1, controller=PID(-1.2)), "it has the eigenvalue 1."),
        (lambda: design.excess(TANK, WEIGHTS, theta=0.1, controller=PID(1.2).at(0.2, 1, 1)), "controller.dt is 0.2 s"),
        (
            lambda: design.excess(TANK, WEIGHTS, theta=0.1, controller=Controller([[0.5]], [[1.0, 0.0]], [[1.0]])),
            "the controller has 2 measurements; expected 1",
        ),
        (lambda: design.excess(TANK, WEIGHTS, theta=0.1, controller="K"), "controller is not an array of numbers"),
        (lambda: design.excess(TANK, WEIGHTS, theta=0.1, controller=print), "expected a state-space object"),
        (lambda: PID(1.0, input=2).at(0.1, 1, 1), "pid.input is 2; expected a number from 1 to 1"),
        (lambda: controller_from([]), "the controller is empty; expected a gain matrix K, or PID controllers"),
        (lambda: controller_from([PID(1.0), 3]), "the list of PID controllers contains 3"),
        (lambda: controller_from(PID(1.0), sign="positive"), "sign is given in addition to a complete controller"),
        (lambda: controller_from([[1.0]], method="zoh"), "method is given with a gain matrix"),
        (lambda: PID(1.0, filter=0.5), "pid.filter is 0.5, but pid.kd is 0"),
        (
            lambda: PID(1.0, 0.1, 1.0, 0.5, setpoint=1.0, c=1.0, start_input=0.0),
            "pid.c is 1 together with start_input, so it has no effect: the derivative starts at zero",
        ),
        (lambda: PID(1.0, disturbance="none"), "pid.disturbance is 'none'; expected a Disturbance, Disturbance(dev"),
        (lambda: controller_from(PLAIN, disturbance=5.0), "controller.disturbance is 5.0; expected a Disturbance"),
        (
            lambda: controller_from(scipy.signal.StateSpace([[20.0]], [[1.0]], [[0.15]], [[1.2]])).at(0.1, 1, 1),
            "the controller has a pole at 2/h = 20 per second with steps of h = 0.1 s",
        ),
        (lambda: PID(1.0, 0.1, setpoint=1.0, c=0.5), "pid.c is 0.5, but pid.kd is 0"),
        (  # the output of the controller does not see its growing state
            lambda: design.excess(TANK, WEIGHTS, theta=0.1, controller=Controller([[1.5]], [[1.0]], [[0.0]], [[-1.2]])),
            "it has the eigenvalue 1.5",
        ),
        (lambda: controller_from([PID(1.0)]).at(0.1, 2, 1), "no PID controller computes input 2"),
        (
            lambda: controller_from([replace(KEPT, disturbance=Disturbance(9.0))] * 2),
            "several PID controllers have the key 'disturbance'",
        ),
        (lambda: controller_from(PLAIN, method="euler").at(0.1, 1, 1), "controller.method is 'euler'"),
        (lambda: controller_from(PLAIN, E=[[1.0]]), "E is given with a continuous controller"),
        (lambda: controller_from(PLAIN.to_discrete(0.1), method="zoh"), "method is 'zoh' with a discrete controller"),
        (
            lambda: design.excess(TANK, Cost(np.eye(2), [[1.0]], horizon=9), theta=0.1, every=2),
            "cost.horizon is 9, so the gains of LQG change with time; the policy kind excess supports this only",
        ),
    ],
)
def test_what_is_wrong_is_refused(build: object, words: str) -> None:
    """In one sentence."""
    with pytest.raises((ProblemError, UnstableError)) as told:
        build()  # type: ignore[operator]
    assert words in str(told.value)


def test_the_energy_of_packets_gives_power_and_battery_life(tmp_path: Path) -> None:
    """Rate times energy; the same per step and per second; a link without packets is refused."""
    table = MATRICES + '\ndisturbance = "none"' + "\n\n[network]\nactuator_energy = 0.002\nactuator_battery = 9000.0"
    problem = read(tmp_path, table)
    found = taciturn.evaluate(problem, standard_error=1e-4)
    rate = found.rates["actuator"].value / STEP
    assert found.power["actuator"].value == pytest.approx(0.002 * rate)
    assert found.life["actuator"].value == pytest.approx(9000.0 / (0.002 * rate))
    told = found.document()
    assert told["power"]["actuator"]["standard_error"] > 0
    assert told["battery_days"]["actuator"]["value"] == pytest.approx(found.life["actuator"].value / 86400)
    lqg = problem.changed({"controller": None, "policy.kind": "excess"})
    assert told["cost_lqg"] == pytest.approx(lqg.design().cost_all_time)
    assert "mW for packets; the battery lasts" in str(found)
    assert problem.changed({"theta": 0.3}).network == problem.network
    for change, words in (
        ({"network.sensor_energy": 1.0}, "makes no send decisions on the sensor link"),
        ({"network.actuator_energy": None}, "network.actuator_battery is given without network.actuator_energy"),
        ({"network.actuator_energy": -1.0}, "network.actuator_energy is -1"),
    ):
        with pytest.raises(ProblemError, match=words):
            problem.changed(change).design()


@pytest.mark.parametrize(("filter_seconds", "noted"), [(0.01, True), (0.04, True), (0.06, False), (0.5, False)])
def test_a_derivative_filter_faster_than_half_a_step_rings(filter_seconds: float, noted: bool) -> None:
    """The commands after a step of the measurement alternate, and a note names the time constant."""
    T = filter_seconds
    pid = scipy.signal.StateSpace(np.diag([0.0, -1 / T]), [[1.0], [1.0]], [[0.15, -1 / T**2]], [[1.2 + 1 / T]])
    plant = ContinuousPlant([[0, 1], [0, -1]], [[0], [1]], np.diag([1e-3, 4e-3]), C=[[1, 0]], V=[[1e-3]])
    for method in ("tustin", "zoh"):
        kept = controller_from(pid, method=method, disturbance=Disturbance(deviation=0.0))  # type: ignore[arg-type]
        found = kept.at(0.1, 1, 1)
        z, commands = np.zeros(len(found.A)), list[float]()
        for _ in range(12):
            commands.append(float((found.C @ z + found.D[:, 0])[0]))
            z = found.A @ z + found.B[:, 0]
        turns = np.sign(np.diff(commands, 2))
        alternates = (turns[1:6] != turns[:5]).all()
        assert alternates == (noted and method == "tustin")
        if method == "zoh" and noted:
            continue  # zero-order hold of so fast a derivative does not stabilise this plant
        policy = design.excess(plant, Cost.of_variances(plant.C, [0.05**2], [0.3**2]), delta=0.0, period=0.1,
                               controller=kept)  # fmt: skip
        assert any("alternates from step to step" in note for note in policy.notes) == (noted and method == "tustin")
