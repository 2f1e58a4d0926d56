"""Decisions that know the limits of the inputs: no packet without an effect, and silence valued by a forecast."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from catalogue import closed
from counts import few
from drawn import law
from hypothesis import strategies as st
from runtime.loops import column, differing_ticks, record
from runtime.test_nodes import TANKS

import taciturn
from taciturn import Cost, Network, Plant, design
from taciturn.loop import Loop
from taciturn.model.controller import Controller
from taciturn.model.disturbance import Disturbance
from taciturn.model.link import LinkLaw
from taciturn.model.steps import Received
from taciturn.program.ops import Sent

SEEDS = st.integers(0, 2**32 - 1)
A, B, C = np.array([[0.97, 0.2], [0.0, 0.8]]), np.array([[0.0], [0.3]]), np.array([[1.0, 0.0]])
Q, R = np.diag([1.0, 0.1]), np.array([[0.02]])
TWO = np.array([[0.0, 0.1], [0.3, -0.1]])
LIMITS: Mapping[str, Mapping[str, Any]] = {
    "sides": {"input_limit": [[-0.06, 0.05]]},
    "one side": {"input_limit": [[-0.03, np.inf]]},
    "rate": {"input_limit": [[-0.06, 0.05]], "input_rate": [0.04]},
}


def plant(limits: Mapping[str, Any], inputs: int = 1, full: bool = False) -> Plant:
    """Return a plant whose limits bind in many steps."""
    measured = (None, None) if full else (C, [[1e-3]])
    each = {name: value * inputs for name, value in limits.items()}
    return Plant(A, B if inputs == 1 else TWO, np.diag([1e-4, 4e-3]), *measured, 1.0, **each)


def reached(limits: Any, wanted: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return the input that an actuator applies."""
    rate = np.inf if limits.rate is None else limits.rate
    return np.clip(np.clip(wanted, before - rate, before + rate), limits.low, limits.high)


def packets(loop: Loop, ticks: int, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the packets that reach actuators, (steps, links), which of them change an input, and the share at a limit.

    Actuators hold their inputs, whose changes have no limits.
    """
    loop = loop.in_units
    records, draws = record(loop, ticks, seed)
    assert differing_ticks(loop, records, draws)[0] == []
    applied, limits = column(records, "applied"), loop.problem.plant.saturation
    assert limits is not None
    before = np.vstack([limits.begun(np.zeros(applied.shape[1])), applied[:-1]])
    arrived = {name.link: values[:, 0] > 0 for name, values in records.items() if isinstance(name, Received)}
    linked = {node: [*rows] for node, rows in loop.policy.applied.values() if node in arrived}
    useful = [(applied[:, rows] != before[:, rows]).any(axis=1) for rows in linked.values()]
    at = ((applied <= limits.low) | (applied >= limits.high)).any(axis=1)
    return np.array([arrived[node] for node in linked]).T, np.array(useful).T, float(at.mean())


PI = taciturn.PID(0.5, 0.03)
FOLLOWED = taciturn.PID(0.5, 0.03, tracking_time=10.0)
STATES = Controller([[0.7]], [[0.3]], [[-0.2]], [[-0.4]], [[0.05]], 1.0, Disturbance(deviation=0.0))
TCP = Network("tcp", 0.3)
RULES = {
    "LQG": lambda limits: design.excess(plant(limits), Cost(Q, R), delta=2e-4),
    "LQG, two inputs": lambda limits: design.excess(plant(limits, 2), Cost(Q, 0.02 * np.eye(2)), delta=2e-4),
    "LQG, every improvement": lambda limits: design.excess(plant(limits), Cost(Q, R), delta=0.0),
    "PI": lambda limits: design.excess(plant(limits), Cost(Q, R), delta=2e-4, controller=PI),
    "PI with anti-windup": lambda limits: design.excess(plant(limits), Cost(Q, R), delta=2e-4, controller=FOLLOWED),
    "controller in states": lambda limits: design.excess(plant(limits), Cost(Q, R), delta=2e-4, controller=STATES),
    "PI over losses": lambda limits: design.excess(
        plant(limits), Cost(Q, R), delta=2e-4, controller=PI, network=TCP, retry=True
    ),
    "PI with a slower base": lambda limits: design.excess(
        plant(limits), Cost(Q, R), delta=2e-4, controller=PI, every=2
    ),
    "discount": lambda limits: design.excess(plant(limits), Cost(Q, R, discount=0.95), delta=2e-4),
    "dead band": lambda limits: design.send_on_delta(
        plant(limits), Cost(Q, R), delta=0.02, controller=PI, link="actuator"
    ),
    "error of the state": lambda limits: design.absolute(
        plant(limits, full=True), Cost(Q, R), threshold=0.02, error="state"
    ),
    "stochastic": lambda limits: design.stochastic(plant(limits, full=True), Cost(Q, R), scale=2e4),
}


@law(6, 60, name=st.sampled_from(sorted(RULES)), limits=st.sampled_from(["one side", "sides"]), seed=SEEDS)
def test_no_packet_is_sent_that_changes_no_input(name: str, limits: str, seed: int) -> None:
    """Neither a rule, nor a retry, nor a controller with anti-windup asks for one."""
    sent, useful, share = packets(closed(RULES[name](LIMITS[limits])), 200, seed)
    assert share > 0.02
    assert sent.any()
    assert not (sent & ~useful).any()


@pytest.mark.parametrize(
    "name", few(["tank, sets of links", "tank, hold", "tank, hold, sets of inputs", "PID, sets"], 2)
)
def test_no_packet_on_several_links_is_sent_that_changes_no_input(name: str) -> None:
    """Each set of packets holds only those that change an input."""
    change = TANKS.get(name, {"actuation": "hold", "prediction": "hold"})
    if name == "PID, sets":
        pids = [{"kp": 0.3, "ki": 0.01, "output": i, "input": i} for i in (1, 2)]
        change = {**TANKS["tank, sets of links"], "controller.pid": pids}
    sides = {"plant.input_limit": [[-0.2, 0.3], 0.25]}
    problem = taciturn.load("quadruple-tank").changed({**change, **sides})
    sent, useful, share = packets(problem.close(problem.design()), 300, 2)
    assert share > 0.02
    assert sent.any()
    assert not (sent & ~useful).any()


def test_a_heartbeat_is_sent_even_if_it_changes_no_input() -> None:
    """After the longest interval, and no other packet without an effect."""
    law_of_link = Network(links={"actuator": LinkLaw(max_interval=4)})
    policy = design.excess(plant(LIMITS["sides"]), Cost(Q, R), delta=2e-3, controller=PI, network=law_of_link)
    sent, useful, _ = (one[:, 0] if isinstance(one, np.ndarray) else one for one in packets(closed(policy), 300, 1))
    gaps = np.diff(np.flatnonzero(sent))
    needless = np.flatnonzero(sent & ~useful)
    assert gaps.max() == 4
    assert len(needless) > 0
    assert set(gaps[np.flatnonzero(np.isin(np.flatnonzero(sent)[1:], needless))]) == {4}


def forecast(z: np.ndarray, wanted: np.ndarray, before: np.ndarray, loop: tuple[Any, ...], limits: Any) -> float:
    """Return what ten steps cost without noise, and the value of the state that they reach without limits."""
    Phi, Gamma, K, stage, P = loop
    total = 0.0
    for _ in range(10):
        before = reached(limits, wanted, before)
        joint = np.concatenate([z, before])
        total += float(joint @ stage @ joint)
        z = Phi @ z + Gamma @ before
        wanted = K @ z
    return total + float(z @ P @ z)


@pytest.mark.parametrize("limits", few(LIMITS, 1))
@pytest.mark.parametrize("name", ["LQG", "LQG, two inputs", "controller in states"])
def test_silence_costs_what_ten_steps_of_both_choices_differ_by(name: str, limits: str) -> None:
    """Each decision of a path is that of stage costs which are summed here, and of a value by other equations."""
    policy = RULES[name](LIMITS[limits])
    records, _ = record(closed(policy), 300, 3)
    model, own = policy.model, policy.model.saturation
    m = model.inputs
    weight = scipy.linalg.block_diag(Q, 0.02 * np.eye(m))
    if name == "controller in states":  # z = (x̂, state of the controller, y)
        Phi = np.block([[A, np.zeros((2, 2))], [np.zeros((1, 2)), STATES.A, STATES.B], [C @ A, np.zeros((1, 2))]])
        Gamma, K = np.vstack([B, STATES.E, C @ B]), np.hstack([np.zeros((1, 2)), STATES.C, STATES.D])
        register, y, u = [np.zeros(1)], column(records, "y"), column(records, "applied")
        for k in range(299):
            register.append(STATES.A @ register[-1] + STATES.B @ y[k] + STATES.E @ u[k])
        z = np.hstack([column(records, "estimate"), np.array(register), y])
        weight = scipy.linalg.block_diag(Q, np.zeros((2, 2)), R)
        closed_loop, used = Phi + Gamma @ K, np.vstack([np.eye(4), K])
        P = scipy.linalg.solve_discrete_lyapunov(closed_loop.T, used.T @ weight @ used)
    else:
        Phi, Gamma, z = A, model.B, column(records, "estimate")
        P = scipy.linalg.solve_discrete_are(A, model.B, Q, 0.02 * np.eye(m))
        K = -np.linalg.solve(0.02 * np.eye(m) + model.B.T @ P @ model.B, model.B.T @ P @ A)
    loop, held, wanted = (Phi, Gamma, K, weight, P), np.zeros(m), np.zeros(m)
    sends = next(values[:, 0] > 0 for one, values in records.items() if isinstance(one, Sent))
    applied, excesses = column(records, "applied"), []
    assert own is not None
    for k in range(300):
        told = np.clip(K @ z[k], own.low, own.high)
        assert not sends[k] or (reached(own, told, held) != reached(own, wanted, held)).any()
        excesses.append(forecast(z[k], wanted, held, loop, own) - forecast(z[k], told, held, loop, own) - 2e-4)
        wanted = told if sends[k] else wanted
        held = applied[k]
    sure = np.abs(excesses) > 1e-9
    assert sure.sum() > 290
    assert ((np.array(excesses) > 0) == sends)[sure].all()
    assert 10 < sends.sum() < 290
