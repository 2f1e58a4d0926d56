"""Constant delays of links with every policy kind: J_all is that of a plant with registers written by hand, or refused.

The command of d steps ago acts, so the plant with the registers z₁⁺ = u, z₂⁺ = z₁, …, has the cost of the delayed loop.
Only the sum of the delays around a loop matters, so a sensor link with the delay of the actuator link costs the same.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg as sla
from test_kinds import PLANTS, SCALAR, SLOW, costs_of

import taciturn
from taciturn import PID, Cost, Network, Plant, Problem, ProblemError, average, close, design
from taciturn.design.catalogue import CATALOGUE
from taciturn.model.link import LinkLaw
from taciturn.model.network import NodeRole

PREDICTING = "a link delays its packets, and the actuator predicts between sampling instants; expected a held input"
REFUSING = {  # kinds that refuse every constant delay, and the sentence
    "consistent": PREDICTING,
    "integral": PREDICTING,
    "lossy-lqg": "a link has a constant delay, with which the policy kind lossy-lqg would not know the inputs",
}
LATE = "the loss of packets later than links.{}.buffer is given, "  # refused by kinds without losses
SIMULATED = ("all-time", "distributed", "excess", "periodic")  # kinds that take losses
STEPS = 2


def problem_of(name: str, continuous: bool = False) -> Problem:
    """Return a small problem of a kind, with outputs if the kind takes them."""
    kind = CATALOGUE[name]
    plants = SCALAR if "several" in kind.refused else PLANTS
    time = "continuous" if continuous else "discrete"
    plant = plants[(time, "outputs") if "outputs" in kind.plants else (time,)]
    given: dict[str, Any] = {key: value for key, value in kind.example.items() if key != "period"}
    period = kind.parameters.get("period")
    if period is not None and (continuous or period.default is period.empty):
        given["period"] = 0.02
    needed = kind.keeps_controller and kind.arguments["controller"].default is kind.arguments["controller"].empty
    controller = PID(0.01) if needed else None
    return Problem(plant, costs_of(plant.states)["average"], Network(), name, given, controller=controller)


def over(problem: Problem, **links: LinkLaw) -> Problem:
    """Return the problem with laws of its links."""
    return replace(problem, network=Network(links=links))


def by_hand(problem: Problem) -> Problem:
    """Return the discrete problem whose inputs act two steps later, with registers as states and no delay."""
    plant, cost = problem.plant, problem.cost
    (n, m), r = plant.B.shape, STEPS * plant.inputs
    A, B, W, Q = np.zeros((n + r, n + r)), np.zeros((n + r, m)), np.zeros((n + r, n + r)), np.zeros((n + r, n + r))
    A[:n, :n], A[:n, n + m :], A[n + m :, n : n + m], B[n : n + m] = plant.A, plant.B, np.eye(m), np.eye(m)
    W[:n, :n], Q[:n, :n], Q[n + m :, n + m :] = plant.W, cost.Q, cost.R
    shown = () if plant.full_state else (np.pad(plant.C, ((0, 0), (0, r))), plant.V)
    assert isinstance(plant, Plant)
    return replace(problem, plant=Plant(A, B, W, *shown, dt=plant.dt), cost=Cost(Q, np.zeros((m, m))))


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.evidence) if name in (*SLOW, "remote-lqg") else name for name in CATALOGUE],
)
def test_a_kind_takes_constant_delays_or_refuses_them_by_name(name: str) -> None:
    """On each link, as a delay, as a buffer, or as both; a kind of continuous-time plants also a part of a period."""
    discrete = "discrete" in CATALOGUE[name].plants
    problem = problem_of(name, continuous=not discrete)
    laws = [LinkLaw(delay=STEPS), LinkLaw(buffer=STEPS), LinkLaw(delay=[0.5, 0.2, 0.3], buffer=STEPS)]
    late = LinkLaw(delay=[0.5, 0.2, 0.3], buffer=1)
    if name in REFUSING:
        for law in (*laws, late) if name == "lossy-lqg" else laws:
            for link in ("sensor", "actuator"):
                with pytest.raises(ProblemError, match=REFUSING[name]):
                    over(problem, **{link: law}).designed()
        return
    expected = by_hand(problem).designed().cost_all_time
    for law in laws:
        for link in ("sensor", "actuator"):
            assert over(problem, **{link: law}).designed().cost_all_time == pytest.approx(expected, rel=1e-9), link
    split = over(problem, sensor=LinkLaw(delay=1), actuator=LinkLaw(buffer=1)).designed()
    assert split.cost_all_time == pytest.approx(expected, rel=1e-9)
    if name in SIMULATED:
        assert over(problem, actuator=late).designed().cost_all_time < expected
    else:
        with pytest.raises(ProblemError, match=LATE.format("actuator")):
            over(problem, actuator=late).designed()
    if "continuous" in CATALOGUE[name].plants and "outputs" in CATALOGUE[name].plants:
        costs = [
            over(problem_of(name, continuous=True), actuator=LinkLaw(delay={"seconds": late})).designed().cost_all_time
            for late in (0.0, 0.007, 0.02, 0.025)
        ]
        assert costs == sorted(costs)
        assert len(set(costs)) == 4


@pytest.mark.parametrize("name", ["optimal", "near-optimal"])
def test_an_actuator_that_predicts_between_samples_refuses_delays(name: str) -> None:
    """Also in a policy whose nodes run no steps, which would ignore the delay."""
    problem = problem_of(name, continuous=True)
    plant, unit = PLANTS["continuous",], np.eye(2)
    problem = replace(problem, plant=plant, cost=Cost(unit, [[10.0]]))
    for law in (LinkLaw(delay=1), LinkLaw(delay={"seconds": 0.005}), LinkLaw(buffer={"seconds": 0.005})):
        with pytest.raises(ProblemError, match=PREDICTING):
            over(problem, actuator=law).designed()


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("lqg", {"actuation": "model"}), ("excess", {"link": "sensor"}), ("excess", {"actuation": "zero"}),
        ("rollout", {}), ("self-triggered", {}), ("remote-lqg", {"controller": "sensor", "zeta": None}),
        ("distributed", {"prediction": "model", "actuation": "model"}), ("periodic", {"every": [1, 3]}),
        ("event-pid", {}),
    ],
)  # fmt: skip
def test_a_delayed_loop_runs_as_one_with_registers(name: str, parameters: dict[str, object]) -> None:
    """With the same random numbers: the same cost and the same packets, of actuators that hold and that predict."""
    problem = problem_of(name)
    given = {key: value for key, value in {**problem.parameters, **parameters}.items() if value is not None}
    problem = replace(problem, parameters=given)
    expected = taciturn.evaluate(by_hand(problem), steps=2000, seed=1)
    for link in ("sensor", "actuator"):
        found = taciturn.evaluate(over(problem, **{link: LinkLaw(delay=STEPS)}), steps=2000, seed=1)
        assert found.cost.value == pytest.approx(expected.cost.value, rel=1e-9)
        assert found.rates.keys() == expected.rates.keys()
        for one, rate in found.rates.items():
            assert rate.value == pytest.approx(expected.rates[one].value, rel=1e-9)


def test_a_given_controller_with_a_disturbance_acts_late() -> None:
    """The PID of the tank and its slow disturbance, d steps late, by one Lyapunov equation of the loop with a queue."""
    problem = taciturn.load("pid-tank")
    (A, B, W, V), h = ([[1, 0.1], [0, 0.9]], [0, 0.1], [1e-4, 4e-4], 1e-3), 0.1
    kp, ki, kd, filtered, kept = 1.2, 0.15, 1.0, 0.5, np.exp(-h / 100)
    for steps in (1, 3):
        n, integral, slow = 5 + steps, 3 + steps, 4 + steps  # x, d, queue, I, yf; the last column is that of v
        M, u = np.zeros((n, n + 1)), np.zeros(n + 1)
        u[[0, n]], u[integral], u[slow] = -(kp + kd / filtered), -ki, kd / filtered
        M[:2, :2], M[:2, 2], M[2, 2], M[3] = A, B, kept, u
        M[:2, 2 + steps] += B
        for place in range(1, steps):
            M[3 + place, 2 + place] = 1.0
        M[integral, [0, integral, n]] = h, 1.0, h
        M[slow, [0, slow, n]] = h / filtered, 1 - h / filtered, h / filtered
        noise = np.diag([*W, (1 - kept**2) * 0.01, *np.zeros(n - 3)]) + V * np.outer(M[:, n], M[:, n])
        P = sla.solve_discrete_lyapunov(M[:, :n], noise)
        acts = P[2 + steps, 2 + steps]
        for kind, given in (
            ("all-time", {"theta": None}),
            ("event-pid", {"theta": None, "delta": 0.05}),
            ("excess", {}),
        ):
            for key in ("actuator_delay", "sensor_delay"):
                late = problem.changed({"kind": kind, f"network.{key}": steps, **given})
                assert late.design().cost_all_time == pytest.approx(P[0, 0] + 0.05 * acts, rel=1e-9), (kind, key)


def test_queries_of_an_unstable_plant_take_delays() -> None:
    """Whose input acts on the growing mode only through registers."""
    plant = Plant([[1.1, 0.2], [0.0, 0.8]], [[0.0], [1.0]], np.diag([0.1, 0.1]), [[1.0, 0.0]], [[0.2]])
    problem = Problem(plant, Cost(np.eye(2), [[0.5]]), Network(), "remote-lqg", {"theta": 0.3, "zeta": 0.3})
    expected = by_hand(problem).designed()
    found = over(problem, actuator=LinkLaw(delay=STEPS)).design()
    assert found.cost_all_time == pytest.approx(expected.cost_all_time, rel=1e-9)


@pytest.mark.parametrize("name", SIMULATED)
def test_losses_next_to_a_delay_are_those_of_a_loop_with_registers(name: str) -> None:
    """Dropped and late packets: the same costs, and the same assumptions that do not hold, so no false guarantee."""
    problem = problem_of(name)
    lossy = replace(by_hand(problem), network=Network(links={"actuator": LinkLaw(loss=0.2)}))
    expected, told = taciturn.evaluate(lossy, steps=2000, seed=1), lossy.close(lossy.design()).violated_assumptions
    for law in (LinkLaw(loss=0.2, delay=STEPS), LinkLaw(delay=[0.4, 0.2, 0.2], buffer=STEPS)):
        late = over(problem, actuator=law)
        policy = late.design()
        assert late.close(policy).violated_assumptions == told
        assert policy.cost_all_time == pytest.approx(lossy.design().cost_all_time, rel=1e-9)
        found = taciturn.evaluate(late, steps=2000, seed=1)
        assert found.cost.value == pytest.approx(expected.cost.value, rel=1e-9)
        assert found.cost.standard_error == pytest.approx(expected.cost.standard_error, rel=1e-6)
        assert (found.cost_bound is None) == (expected.cost_bound is None)


def test_sensors_of_different_delays_predict_a_loop_that_integrates() -> None:
    """The register of the later output is measured without noise, and the integral leaves a zero on the unit circle."""
    A, B = np.array([[0.96, 0.03], [0.025, 0.95]]), np.diag([0.08, 0.06])
    plant = Plant(A, B, np.diag([0.01, 0.015]), np.eye(2), np.diag([0.02, 0.03]), dt=5.0)
    kept = [PID(1.5, 0.01, input=1, output=1), PID(1.5, 0.01, input=2, output=2)]
    nodes = {
        **{f"s{i}": NodeRole(measures=(i,)) for i in range(2)}, "plc": NodeRole(controls=True),
        **{f"v{i}": NodeRole(applies=(i,)) for i in range(2)},
    }  # fmt: skip
    network = Network(nodes=nodes, links={"s0": LinkLaw(delay=1)})
    rates = dict[str, float]()
    for prediction in ("hold", "model"):
        policy = design.distributed(
            plant, Cost(np.eye(2), 0.05 * np.eye(2)), theta=0.3, controller=kept, prediction=prediction, network=network
        )
        found = average(close(plant, policy, network), steps=20_000)
        assert policy.guarantee is not None
        assert found.cost.value < policy.guarantee.cost
        rates[prediction] = sum(found.rates[link].value for link in ("s0", "s1"))
    assert rates["model"] < rates["hold"]
