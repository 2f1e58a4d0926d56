"""Set-points, limits and the start of a given PID controller, against a loop written by hand in the plant's units."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from counts import few
from laws.test_given_controllers import KEPT, STEP, TANK, WEIGHTS
from runtime.loops import differing_ticks, record

import taciturn
from taciturn import PID, Cost, Network, Plant, ProblemError, design
from taciturn.base.given_controller import cost_as_now
from taciturn.design.at_fixed_steps import sending_always
from taciturn.program.numpy import run
from taciturn.program.ops import Entry
from taciturn.simulation.average import average

STABLE = Plant([[0.5]], [[1.0]], [[1.0]], dt=1.0)
QUIET = 1e-18  # noise that leaves eight digits of a path


def by_hand(pid: PID, limit: float, steps: int) -> list[float]:
    """Return the outputs of the tank with a PID controller as textbooks print it, every sample, from rest at 0."""
    x, integral, slow, found = np.zeros(2), 0.0, 0.0, []
    r, h, T = pid.setpoint, STEP, pid.filter
    for k in range(steps):
        y = float(x[0])
        if k == 0 and pid.start_input is not None:
            slow = y - pid.c * r
            integral = pid.start_input - pid.kp * (pid.b * r - y)
        v = pid.kp * (pid.b * r - y) + integral + pid.kd / T * ((pid.c * r - y) + slow)
        u = float(np.clip(v, -limit, limit))
        integral += pid.ki * h * (r - y)
        if pid.tracking_time is not None:
            integral += h / pid.tracking_time * (u - v)
        slow += h / T * (y - pid.c * r - slow)
        found.append(y)
        x = TANK.A @ x + TANK.B @ np.array([u])
    return found


CHANGES: list[dict[str, float]] = [
    {},
    {"b": 0.3, "c": 0.5},
    {"tracking_time": 1.5},
    {"b": 0.3, "tracking_time": 1.5, "start_input": 0.4},
]


@pytest.mark.parametrize("of", few(itertools.product(["actuator", "sensor"], CHANGES, [np.inf, 0.8]), 5, 1), ids=str)
def test_a_step_of_the_set_point_is_that_of_a_textbook(of: tuple[str, dict[str, float], float]) -> None:
    """Weights of the set-point, back-calculation under a limit, and a bumpless start; a packet at every sample."""
    link, changes, limit = of
    noise, limits = QUIET * np.eye(2), None if np.isinf(limit) else [limit]
    plant = Plant(TANK.A, TANK.B, noise, TANK.C, [[QUIET]], STEP, input_limit=limits)
    pid = replace(KEPT, setpoint=2.0, **changes)
    policy = sending_always(design.excess(plant, WEIGHTS, delta=0.0, controller=pid, link=link))
    loop = taciturn.close(plant, policy).in_units
    program = loop.program()
    found = run(program, loop.start(program, 1, 0), 300).outputs[Entry("y", 0)][:, 0]
    assert found == pytest.approx(by_hand(pid, limit, 300), abs=1e-6)
    assert taciturn.close(plant, policy).nominal == np.isinf(limit)


@pytest.mark.evidence
def test_costs_are_those_of_the_deviations() -> None:
    """The set-point changes no average, and no packet in the long run; send-on-delta and its kin take it too."""
    options = {"theta": 0.1, "actuation": "model"}
    usual, held = (
        average(taciturn.close(TANK, design.excess(TANK, WEIGHTS, controller=pid, **options)), steps=400_000)
        for pid in (KEPT, replace(KEPT, setpoint=2.0))
    )
    assert held.cost.value == pytest.approx(
        usual.cost.value, abs=4 * np.hypot(held.cost.standard_error, usual.cost.standard_error)
    )
    pid = replace(KEPT, setpoint=2.0, b=0.5)
    for policy in (
        design.send_on_delta(TANK, WEIGHTS, delta=0.04, controller=pid),
        design.event_pid(TANK, WEIGHTS, delta=0.04, longest=2.0, controller=pid),
        design.event_pid_saturated(TANK, WEIGHTS, delta=0.04, controller=pid),
        design.symmetric_send_on_delta(TANK, WEIGHTS, delta=0.04, controller=pid),
    ):
        loop = taciturn.close(TANK, policy).in_units
        program = loop.program()
        late = run(program, loop.start(program, 100, 0), 900).outputs[Entry("y", 0)][600:]
        assert late.mean() == pytest.approx(2.0, abs=0.03)


@pytest.mark.parametrize(
    ("link", "actuation", "limit"),
    [("actuator", "hold", [3.0]), ("actuator", "model", [3.0]), ("sensor", "model", [3.0]), ("actuator", "zero", None)],
)
def test_nodes_apart_carry_the_bits_of_the_loop(link: str, actuation: str, limit: list[float] | None) -> None:
    """With a set-point, limits, back-calculation and dropouts."""
    plant = Plant(TANK.A, TANK.B, TANK.W, TANK.C, TANK.V, STEP, input_limit=limit)
    pid = replace(KEPT, setpoint=2.0, tracking_time=2.0)
    network = Network("tcp", actuator_loss=0.2) if link == "actuator" else None
    options = {"link": link, "actuation": actuation, "network": network}
    loop = taciturn.close(plant, design.excess(plant, WEIGHTS, theta=0.1, controller=pid, **options))
    records, draws = record(loop, 150, 1)
    wrong, packets = differing_ticks(loop, records, draws)
    assert wrong == []
    assert packets > 5


@pytest.mark.parametrize("actuation", ["hold", "model"])
@pytest.mark.parametrize("link", ["actuator", "sensor"])
def test_the_first_command_is_the_given_input(link: str, actuation: str) -> None:
    """With and without a packet, and however far the set-point is."""
    pid = replace(KEPT, setpoint=10.0, b=0.0, start_input=0.1)
    policy = design.excess(TANK, WEIGHTS, theta=0.1, controller=pid, link=link, actuation=actuation)
    first = [taciturn.simulate(taciturn.close(TANK, policy), 1, seed=seed).input[0, 0] for seed in range(40)]
    assert np.mean(first) == pytest.approx(0.1, abs=4 * 3.2 * np.sqrt(TANK.V.item() / 40))


def test_a_command_beyond_a_limit_is_sent_at_every_sample() -> None:
    """A sensor that kept silent, as a packet's command would seem to cost too much, let the level run away."""
    plant = taciturn.ContinuousPlant(
        [[-0.00333333, 0, 0], [0.1, -0.1, 0], [0, 0.1, -0.1]], [[0.133333], [0], [0]], np.diag([0.002, 0, 0]),
        C=[[0, 0, 1]], V=[[0.01]], input_limit=[0.4],
    )  # fmt: skip
    slow = taciturn.Disturbance(1000.0, 0.05)
    pid = PID(0.18, 0.0011, 1.0, 3.0, slow, setpoint=10.0, b=0.6, tracking_time=20.0)
    cost = cost_as_now(plant, pid, 2.0)
    policy = design.excess(plant, cost, theta=0.3, controller=pid, link="sensor", period=2.0)
    path = taciturn.simulate(taciturn.close(plant, policy), 3000, seed=3)
    assert abs(path.state[500:, 2] - 10.0).max() < 1.5
    assert path.sends["sensor"].sum() < 600


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (
            lambda: design.excess(STABLE, Cost([[1.0]], [[1.0]]), theta=0.1, controller=PID(0.1, setpoint=1.0)),
            "the controller does not hold the set-point, as it does not integrate",
        ),
        (
            lambda: design.excess(
                Plant(0.5 * np.eye(2), [[1], [0]], np.eye(2), dt=1.0), Cost(np.eye(2), [[1.0]]), theta=0.1,
                controller=[PID(0.1, 0.1, output=2, setpoint=1.0)],
            ),
            "the plant cannot rest at the set-point [0.0, 1.0]",
        ),
        *(
            (
                lambda kind=kind: kind(
                    Plant(TANK.A, TANK.B, TANK.W, TANK.C, TANK.V, TANK.dt, input_limit=[[-0.1, 0.3]]), WEIGHTS,
                    delta=0.1, controller=replace(KEPT, start_input=0.4),
                ),
                "start_input is [0.4], beyond the input_limit [[-0.1, 0.3]]; expected an input within the limits",
            )
            for kind in (design.excess, design.event_pid, design.send_on_delta)
        ),
        (lambda: PID(1.2, start_input=1.0), "pid.start_input is given without pid.ki"),
        (lambda: PID(1.2, 1.0, tracking_time=0.0), "pid.tracking_time is 0"),
        (
            lambda: design.excess(
                TANK, Cost(WEIGHTS.Q, WEIGHTS.R, horizon=9), theta=0.1, controller=replace(KEPT, setpoint=1.0)
            ),
            "a set-point or start_input is given, but the cost has a horizon",
        ),
        (
            lambda: design.event_pid(TANK, WEIGHTS, delta=0.1, controller=replace(KEPT, tracking_time=1.0)),
            "pid.tracking_time is 1, which the policy kind event-pid does not use",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_held_is_refused(build: object, words: str) -> None:
    """In one sentence."""
    with pytest.raises(ProblemError) as told:
        build()  # type: ignore[operator]
    assert words in str(told.value)
