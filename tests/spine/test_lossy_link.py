"""Lossy links without acknowledgement (losses, time-varying gains, a finite horizon), as plain data on the spine."""

from __future__ import annotations

import numpy as np
import pytest

from taciturn import Cost, Form, InformationError, Network, Plant, Policy, Scheduled, Trigger, close
from taciturn.model.policy import Acknowledged, Assign, Decide, Identity, Location, Received, Send
from taciturn.program.numpy import run
from taciturn.simulation.average import average, plain_average

A, B, W = np.array([[1, 0.1], [0, 1]]), np.array([[0.005], [0.1]]), 0.01 * np.eye(2)
Q, R, N, ALPHA, BETA = np.eye(2), np.eye(1), 100, 0.3, 0.6
NETWORK = Network("udp", actuator_loss=ALPHA, sensor_loss=BETA)
START = np.array([1.0, 0.0])


def udp_policy(price: float, told: bool = False) -> Policy:
    """Send iff x̂'Γ_k x̂ > λ; the estimator assumes the mean of what the lossy link delivers, unless it is ``told``."""
    K, P = [Q], [np.zeros((2, 2))]
    L, Gamma, constant = [], [], 0.0
    for _ in range(N):
        M = R + B.T @ (K[0] + ALPHA * BETA * P[0]) @ B
        G = (1 - ALPHA) * A.T @ K[0] @ B @ np.linalg.solve(M, B.T @ K[0] @ A)
        L, Gamma = [-np.linalg.solve(M, B.T @ K[0] @ A), *L], [G, *Gamma]
        constant += float(np.trace((K[0] + BETA * P[0]) @ W))
        following = A.T @ K[0] @ A
        K, P = [Q + following - G, *K], [G + BETA * A.T @ P[0] @ A, *P]
    constant += float(START @ K[0] @ START)
    clock, one = Location("clock", np.minimum(np.arange(1, N + 1), N - 1)), np.eye(1)
    silence = Form(("estimate",), Scheduled("clock", Gamma))
    expected = ({"estimate": A}, {"estimate": A, "command": (1 - ALPHA) * B})
    known = ({"estimate": A}, {"estimate": A, "command": B})
    return Policy("udp", (
        Send("sensor", "sensor", ("y",)),
        Assign("controller", "estimate", ({"prior": np.eye(2)}, {"y": np.eye(2)}), Received("sensor")),
        Assign("controller", "command", {"estimate": Scheduled("clock", L)}),
        Decide("controller", "send", Trigger({"silent": silence, "send": Form(constant=price)})),
        Send("controller", "actuator", ("command",), "send"),
        Assign("actuator", "input", ({"input": 0 * one}, {"command": one}), Received("actuator")),
        Assign("controller", "prior", *((known, Acknowledged("actuator")) if told else (expected, "send"))),
    ), Plant(A, B, W, mean=START), constant, locations=(clock,), initial={"prior": START}, network=NETWORK,
        cost=Cost(Q, R, horizon=N), identity=Identity(constant, (silence, Form()), "send"))  # fmt: skip


@pytest.mark.parametrize(("price", "cost", "spread", "rate"), [(0.1, 65.520, 0.004, 0.502), (1.0, 95.03, 0.03, 0.1474)])
def test_the_udp_loop_of_figure_7_2(price: float, cost: float, spread: float, rate: float) -> None:
    """Cost by the exact identity, by the plain total with its terminal weight, and the rate."""
    policy = udp_policy(price)
    assert policy.cost_all_time == pytest.approx(63.7760, abs=5e-5)
    loop = close(policy.model, policy, NETWORK, Cost(Q, R, horizon=N))
    program = loop.program()
    program = program.keep(set(program.sums))
    paths = 20_000
    result = run(program, loop.start(program, paths, 11), N)
    x = np.array([row for row, state in zip(result.states, program.states, strict=True) if state.name == "x"])
    identity = policy.cost_all_time + result.sums["excess"]
    plain = result.sums["cost"] + (x * x).sum(axis=0)
    for total in (identity, plain):
        assert abs(total.mean() - cost) <= 4 * np.hypot(total.std(ddof=1) / np.sqrt(paths), spread)
    sent = result.sums["sent actuator"] / N
    assert abs(sent.mean() - rate) <= 4 * sent.std(ddof=1) / np.sqrt(paths) + 5e-4


def test_missions_are_averaged_with_their_terminal_weight() -> None:
    """The estimator of finite horizons: the identity and the plain total reach the asked precision and agree."""
    policy = udp_policy(0.1)
    loop = close(policy.model, policy, NETWORK, Cost(Q, R, horizon=N))
    identity = average(loop, seed=1, standard_error=0.005)
    plain = average(loop, plain_average(loop), seed=2, standard_error=0.05)
    assert identity.reached
    assert plain.reached
    assert abs(identity.cost.value - 65.520) <= 4 * np.hypot(identity.cost.standard_error, 0.004)
    assert abs(plain.cost.value - 65.520) <= 4 * np.hypot(plain.cost.standard_error, 0.004)
    assert abs(identity.rates["actuator"].value - 0.502) <= 4 * identity.rates["actuator"].standard_error + 5e-4


def test_an_acknowledgement_is_refused_under_udp_and_heard_under_tcp() -> None:
    """A controller that knows what arrived is a policy for another protocol."""
    policy, cost = udp_policy(0.1, told=True), Cost(Q, R, horizon=N)
    with pytest.raises(InformationError, match="udp sends none"):
        close(policy.model, policy, NETWORK, cost)
    assert close(policy.model, policy, Network("tcp", ALPHA, BETA), cost).network.protocol == "tcp"
