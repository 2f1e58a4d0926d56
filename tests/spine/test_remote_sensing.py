"""A scheduled sensor and a triggered actuator (two links, a periodic location), as plain data on the spine."""

from __future__ import annotations

import numpy as np
import pytest

from taciturn import Cost, Form, Plant, Policy, Scheduled, Trigger, close
from taciturn.model.policy import Assign, Decide, Location, Received, Send
from taciturn.program.numpy import run

A, B, C, W, V, Q, R, THETA = 2.0, 1.0, 3.0, 0.01, 0.02, 1.0, 2.0, 0.2


def predict(Sigma: float) -> float:
    """Ric(Σ) after a query."""
    return A * Sigma * A + W - (A * Sigma * C) ** 2 / (C * Sigma * C + V)


def remote_policy(zeta: float) -> Policy:
    """Query iff h(Σ) > ζ, send iff [x̂; û]'Γ[x̂; û] > θ tr(QΣ), with x̂ the predicted estimate."""
    K = (-(R - A * A * R - B * B * Q) + np.sqrt((R - A * A * R - B * B * Q) ** 2 + 4 * B * B * Q * R)) / (2 * B * B)
    H, L = R + B * K * B, -B * K * A / (R + B * K * B)
    P = (A * K * B) ** 2 / H

    def value_of_query(Sigma: float) -> float:
        late, early, total = A * Sigma * A + W, predict(Sigma), 0.0
        for _ in range(200):
            total, late, early = total + P * (late - early), predict(late), predict(early)
        return total

    Sigmas, queries, Sigma = [], [], 0.3
    for _ in range(1000):
        Sigmas, queries = [*Sigmas, Sigma], [*queries, value_of_query(Sigma) > zeta]
        Sigma = predict(Sigma) if queries[-1] else A * Sigma * A + W
    period = next(p for p in range(1, 50) if abs(Sigmas[-1] - Sigmas[-1 - p]) < 1e-12)
    Sigmas, queries = np.array(Sigmas[-period:]), np.array(queries[-period:])
    gains = (A * Sigmas * C / (C * Sigmas * C + V))[:, None, None]
    Gamma = [
        [(1 + THETA) * P - THETA * Q, (1 + THETA) * A * K * B],
        [(1 + THETA) * A * K * B, R + (1 + THETA) * B * K * B],
    ]
    one, location = [[1.0]], "schedule"
    silent, send = Form(("prior", "held"), Gamma), Form(constant=Scheduled(location, THETA * Q * Sigmas))
    turn = Form(constant=Scheduled(location, np.where(queries, -1.0, 1.0)))
    return Policy("remote", (
        Assign("controller", "command", {"prior": [[L]]}),
        Decide("controller", "send", Trigger({"silent": silent, "send": send})),
        Send("controller", "actuator", ("command",), "send"),
        Assign("actuator", "input", ({"input": one}, {"command": one}), Received("actuator")),
        Assign("controller", "held", ({"held": one}, {"command": one}), "send"),
        Decide("sensor", "query", Trigger({"silent": Form(), "query": turn})),
        Send("sensor", "sensor", ("y",), "query"),
        Assign("controller", "innovation", ({"prior": [[0.0]]}, {"y": one, "prior": [[-C]]}), Received("sensor")),
        Assign("controller", "prior", {"prior": [[A]], "held": [[B]], "innovation": Scheduled(location, gains)}),
    ), Plant([[A]], [[B]], [[W]], [[C]], [[V]]), K * W + P * predict(0.0), ("actuator", "sensor"),
        locations=(Location(location, np.roll(np.arange(period), -1)),))  # fmt: skip


@pytest.mark.parametrize(
    ("zeta", "queried", "sent", "cost"), [(1.5, 2 / 3, 0.90937, 0.97771), (1.65, 1 / 2, 0.93565, 1.25325)]
)
def test_the_scalar_example_of_chapter_3(zeta: float, queried: float, sent: float, cost: float) -> None:
    """Schedule, rate and cost of the scalar example at θ = 0.2."""
    policy = remote_policy(zeta)
    loop = close(policy.model, policy, cost=Cost([[Q]], [[R]]))
    program = loop.program().keep({"cost", "sent actuator", "sent sensor"})
    paths, ticks = 4000, 1200  # a multiple of both periods
    warm = run(program, loop.start(program, paths, 7), 300).states
    sums = {name: total / ticks for name, total in run(program, warm, ticks).sums.items()}
    assert sums["sent sensor"] == pytest.approx(np.full(paths, queried), abs=1e-12)
    for name, expected, digit in (("cost", cost, 5e-6), ("sent actuator", sent, 5e-6)):
        error = sums[name].std(ddof=1) / np.sqrt(paths)
        assert abs(sums[name].mean() - expected) <= 4 * error + digit, name
        assert error < 0.002
