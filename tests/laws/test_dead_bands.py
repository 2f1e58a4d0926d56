"""Send-on-delta over several links: against every sample, and against a simulation of its own."""

from __future__ import annotations

import numpy as np
import pytest

import taciturn
from taciturn.design.certainty import design_certainty
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.problem import Problem

SHARES = {"level-1": 0.5, "level-2": 1.0, "pump-1": 2.0, "pump-2": 0.0}
DELTA, PATHS, STEPS, SETTLED = 0.4, 400, 1500, 300


def tank(**policy: object) -> Problem:
    """Return the four tanks with dead bands on all links."""
    changed = {"kind": "send-on-delta", "theta": None, "prediction": None, "actuation": None, "delta": DELTA}
    return taciturn.load("quadruple-tank").changed(changed | policy)


def test_without_dead_bands_every_change_is_sent() -> None:
    """The cost is that of LQG with every sample, and so is the rate."""
    found = taciturn.evaluate(tank(delta=0.0), seed=1, steps=2_000_000)
    assert abs(found.cost.value - found.cost_all_time) < 4 * found.cost.standard_error
    assert all(rate.value == pytest.approx(0.5, rel=1e-5) for rate in found.rates.values())


def test_two_sensors_and_two_pumps_send_what_has_changed() -> None:
    """Cost and rates of NumPy, written anew: values that are held, and a filter that counts a dead band as noise."""
    problem = tank(shares=SHARES)
    discrete = discretise(problem.plant, problem.cost, 2.0)
    plant, L = discrete.plant, design_certainty("lqg", discrete).regulator.L
    bands = DELTA * np.array(list(SHARES.values()))
    gain = steady_filter(plant.A, plant.C, plant.W, plant.V + np.diag(bands[:2] ** 2 / 3)).gain
    draws, roots = np.random.default_rng(5), [np.linalg.cholesky(spread) for spread in (plant.W, plant.V)]
    x, prior, y, u = (np.zeros((size, PATHS)) for size in (4, 4, 2, 2))
    costs, sends = np.zeros((STEPS, PATHS)), np.zeros((STEPS, 4, PATHS))
    M = np.block([[discrete.Q, discrete.N], [discrete.N.T, discrete.R]])
    for step in range(STEPS):
        now = plant.C @ x + roots[1] @ draws.standard_normal((2, PATHS))
        sends[step, :2] = np.abs(now - y) > bands[:2, None]
        y = np.where(sends[step, :2] > 0, now, y)
        estimate = prior + gain @ (y - plant.C @ prior)
        command = L @ estimate
        sends[step, 2:] = np.abs(command - u) > bands[2:, None]
        u = np.where(sends[step, 2:] > 0, command, u)
        both = np.vstack([x, u])
        costs[step] = (both * (M @ both)).sum(axis=0)
        x = plant.A @ x + plant.B @ u + roots[0] @ draws.standard_normal((4, PATHS))
        prior = plant.A @ estimate + plant.B @ u
    found = taciturn.evaluate(problem, seed=1, steps=4_000_000)
    of_path = costs[SETTLED:].mean(axis=0)
    error = np.hypot(of_path.std() / np.sqrt(PATHS) / 2.0, found.cost.standard_error)
    assert abs(discrete.per_unit(of_path.mean()) - found.cost.value) < 4 * error
    for link, rate in zip(SHARES, sends[SETTLED:].mean(axis=0) / 2.0, strict=True):
        spread = np.hypot(rate.std() / np.sqrt(PATHS), found.rates[link].standard_error) + 1e-6
        assert abs(rate.mean() - found.rates[link].value) < 4 * spread, link


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"shares": {"plc": 1.0}}, "shares has the link 'plc'; expected links that send: level-1, level-2, pump-1"),
        ({"links.level-1.loss": 0.1}, "links.level-1.loss is given, which send-on-delta does not use"),
        ({"shares": {"level-1": -1.0}}, "shares.level-1 is -1"),
    ],
)
def test_mistakes_are_refused(changes: dict[str, object], sentence: str) -> None:
    """In a sentence that names the key."""
    with pytest.raises(ProblemError, match=sentence):
        tank(**changes).design()
