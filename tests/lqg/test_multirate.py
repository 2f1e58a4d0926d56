"""Control over links with a period each: against one link, Gaussian conditioning, and least squares over a horizon."""

from __future__ import annotations

import numpy as np
import pytest
from counts import few
from hypothesis import given, settings
from hypothesis import strategies as st
from systems import System, systems

import taciturn
from taciturn import Cost, Network, Plant
from taciturn.base.certainty import design_certainty
from taciturn.design.at_fixed_steps import predicted_cost
from taciturn.errors import UnstableError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.periodic import Held, MultirateControl, Timing
from taciturn.model.network import NodeRole

NODES = {
    "s1": NodeRole(measures=(0,)), "s2": NodeRole(measures=(1,)), "plc": NodeRole(controls=True),
    "a1": NodeRole(applies=(0,)), "a2": NodeRole(applies=(1,)),
}  # fmt: skip
MANY = Network(nodes=NODES)
V = np.array([[0.3, 0.1], [0.1, 0.2]])  # correlated


def two_by_two(seed: int) -> tuple[Plant, Cost]:
    """Return a random plant with two sensors and two actuators, and a cost with cross terms."""
    draws = np.random.default_rng(seed)
    A = draws.normal(size=(3, 3))
    A *= draws.uniform(0.7, 1.08) / np.abs(np.linalg.eigvals(A)).max()
    W, M = (root @ root.T for root in (draws.normal(size=(3, 3)), draws.normal(size=(5, 5))))
    plant = Plant(A, draws.normal(size=(3, 2)), W + 0.1 * np.eye(3), C=draws.normal(size=(2, 3)), V=V)
    return plant, Cost(M[:3, :3] + 0.1 * np.eye(3), M[3:, 3:] + 0.1 * np.eye(2), M[:3, 3:] * 0.9)


@given(systems(states=3), st.integers(1, 6))
@settings(max_examples=8, deadline=None)
def test_one_link_is_that_of_a_single_clock(system: System, period: int) -> None:
    """Held inputs as lifted, and planned inputs as a model at the actuator predicts them."""
    problem = discretise(system.plant, system.cost, None)
    certainty = design_certainty("periodic", problem)
    timings = {"sensor": Timing(1), "actuator": Timing(period)}
    planned = MultirateControl(problem, Network(), plans=True).cost(timings)
    assert planned == pytest.approx(predicted_cost(certainty, (period,)), rel=1e-6)
    held = Held(problem.plant.A, problem.plant.B, problem.Q, problem.R, problem.N, certainty.corrections)
    control = MultirateControl(problem, Network(), plans=False)
    try:
        known = held.solve((period,)).cost + certainty.estimation_cost
    except UnstableError:
        with pytest.raises(UnstableError, match=r"packets actuator every .* do not stabilise"):
            control.cost(timings)
        return
    assert control.cost(timings) == pytest.approx(known, rel=1e-6)
    assert planned <= known * (1 + 1e-9)


@pytest.mark.parametrize("seed", few(range(20), 3))
def test_every_sample_costs_what_lqg_does(seed: int) -> None:
    """With two sensors and two actuators, held or planned."""
    problem = discretise(*two_by_two(seed), None)
    known = design_certainty("periodic", problem).cost_all_time
    for plans in (False, True):
        found = MultirateControl(problem, MANY, plans).cost(dict.fromkeys(MANY.links, Timing(1)))
        assert found == pytest.approx(known, rel=1e-8)


@pytest.mark.parametrize("seed", few(range(20), 2))
@pytest.mark.parametrize("ages", [(0, 3), (2, 0), (1, 4), (2, 2)])
def test_the_error_is_that_of_conditioning_on_all_measurements_that_arrived(seed: int, ages: tuple[int, int]) -> None:
    """The measurements of a window and the state are jointly Gaussian; the filter gives the covariance at its start."""
    plant, cost = two_by_two(seed)
    found = MultirateControl(discretise(plant, cost, None), MANY, plans=False)._error(ages)
    before, window, n = steady_filter(plant.A, plant.C, plant.W, plant.V).prior, max(ages) + 1, plant.states
    spread = np.zeros((n * window, n * window))  # of the first state and the noises, as a sum of which each is known
    spread[:n, :n] = before
    reach = [np.zeros((n, n * window)) for _ in range(window)]
    reach[0][:, :n] = np.eye(n)
    for step in range(1, window):
        reach[step] = plant.A @ reach[step - 1]
        reach[step][:, n * step : n * (step + 1)] = np.eye(n)
        spread[n * step : n * (step + 1), n * step : n * (step + 1)] = plant.W
    seen = [(step, s) for step in range(window) for s, age in enumerate(ages) if window - 1 - step >= age]
    H = np.array([plant.C[s] @ reach[step] for step, s in seen])
    noise = np.array([[V[s, r] * (step == other) for other, r in seen] for step, s in seen])
    last = reach[-1]
    cross = last @ spread @ H.T
    known = last @ spread @ last.T - cross @ np.linalg.solve(H @ spread @ H.T + noise, cross.T)
    np.testing.assert_allclose(found, known, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("seed", few(range(20), 2))
@pytest.mark.parametrize("plans", [False, True], ids=["hold", "plans"])
def test_the_cost_to_go_is_that_of_least_squares(seed: int, plans: bool) -> None:
    """The inputs of a long horizon, as free numbers of the packets, minimise the same sum."""
    plant, cost = two_by_two(seed)
    timings = (Timing(2), Timing(3, 1))
    values, _ = MultirateControl(discretise(plant, cost, None), MANY, plans)._regulated(timings)
    horizon, n, m = 90, plant.states, plant.inputs
    free = horizon * m if plans else sum(-(-horizon // one.period) for one in timings)
    chosen = np.zeros((horizon, m, free))  # each input as one of the free numbers
    for a, one in enumerate(timings):
        at = 0 if a == 0 else -(-horizon // timings[0].period)
        for step in range(horizon):
            packet = (step - one.phase) // one.period
            if packet >= 0:  # before its first packet an actuator applies 0
                chosen[step, a, step * m + a if plans else at + packet] = 1.0
    root = np.linalg.cholesky(np.block([[cost.Q, cost.N], [cost.N.T, cost.R]])).T
    state, rows = np.hstack([np.eye(n), np.zeros((n, free))]), list[np.ndarray]()
    for step in range(horizon):
        both = np.vstack([state, np.hstack([np.zeros((m, n)), chosen[step]])])
        rows.append(root @ both)
        state = plant.A @ state + plant.B @ both[n:]
    of_state, of_inputs = np.vstack(rows)[:, :n], np.vstack(rows)[:, n:]
    rest = of_state - of_inputs @ np.linalg.lstsq(of_inputs, of_state, rcond=None)[0]
    least = rest.T @ rest
    first = values[-1]  # of the state before the first step, with nothing held
    np.testing.assert_allclose(least, first, rtol=1e-4, atol=1e-5 * np.abs(first).max())


@pytest.mark.evidence
def test_timings_that_do_not_stabilise_are_refused() -> None:
    """Two masses, whose spring swings half a period while the input is held."""
    masses = taciturn.load("two-mass-lqg")
    control = MultirateControl(discretise(masses.plant, masses.cost, None), Network(), plans=False)
    with pytest.raises(
        UnstableError, match=r"periodic packets on the links \(actuator every 5 steps\) do not stabilise"
    ):
        control.cost({"sensor": Timing(1), "actuator": Timing(5)})
