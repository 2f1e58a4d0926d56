"""Renewal analysis of loops: which loops it serves, what evaluate makes of it, and that it agrees with simulation."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import taciturn
from taciturn import ContinuousPlant, Cost, Network, Plant, Policy, ProblemError, Trigger, close, design
from taciturn.analyse.renewal import chain_of, solve_renewal
from taciturn.model.steps import Assign, Decide, Received, Send
from taciturn.model.theory import Identity, Reset, Theory
from taciturn.model.trigger import Form
from taciturn.problem import parse
from taciturn.renewal.chain import NoQuadratureError

COST = Cost(np.eye(2), [[10.0]])
PLANT = ContinuousPlant([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.diag([0.0, 2.5]))
FEW = settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def absolute(plant: Plant, cost: Cost, weight: np.ndarray, threshold: float) -> Policy:
    """Return a hand-made policy of a discrete plant: a prediction at both ends, any weight of its error."""
    base = design.all_time(plant, cost)
    (command,) = (step for step in base.steps if isinstance(step, Assign) and step.signal == "command")
    L = np.asarray(command.branches[0]["estimate"])
    unit, closed = np.eye(plant.states), plant.A + plant.B @ L
    H = L.T @ (cost.R + plant.B.T @ riccati(plant, cost) @ plant.B) @ L
    rule = Trigger({"silent": Form(("error",), weight), "send": Form(constant=threshold)})
    steps = (
        Assign("sensor", "error", {"y": unit, "prediction": -unit}),
        Decide("sensor", "send", rule),
        Send("sensor", "sensor", ("y",), "send"),
        Assign("controller", "estimate", ({"forecast": unit}, {"y": unit}), Received("sensor")),
        Assign("actuator", "input", {"estimate": L}),
        Assign("controller", "forecast", {"estimate": closed}),
        Assign("sensor", "copy", ({"prediction": unit}, {"y": unit}), "send"),
        Assign("sensor", "prediction", {"copy": closed}),
    )
    return Policy(
        "absolute",
        steps,
        plant,
        Theory(
            cost,
            base.cost_all_time,
            base.theory.settling,
            identity=Identity(base.cost_all_time, (Form(("error",), H), Form()), "send"),
            reset=Reset(plant.W, {"error": unit}, H),
        ),
        sites=(frozenset({"controller", "actuator"}),),
    )


def riccati(plant: Plant, cost: Cost) -> np.ndarray:
    """Return K of the average cost."""
    from scipy.linalg import solve_discrete_are

    return solve_discrete_are(plant.A, plant.B, cost.Q, cost.R, s=cost.N)


@FEW
@given(seed=st.integers(0, 2**32 - 1))
def test_any_threshold_on_a_prediction_is_solved_as_it_is_simulated(seed: int) -> None:
    """A Euclidean threshold for a random discrete plant: a weight that the cost does not know."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 3))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, n))
    A *= rng.uniform(0.8, 1.2) / np.abs(np.linalg.eigvals(A)).max()
    noise = 0.3 * rng.normal(size=(n, n))
    assume(np.linalg.cond(noise) < 5 and np.linalg.cond(B) < 30)
    plant, cost = Plant(A, B, noise @ noise.T), Cost(np.eye(n), np.eye(n))
    policy = absolute(plant, cost, np.eye(n), float(rng.uniform(0.5, 3)) * float(np.trace(plant.W)))
    loop = close(plant, policy)
    found = solve_renewal(loop)
    simulated = taciturn.average(loop, seed=seed, steps=200_000)
    assume(simulated.reached)
    rate = simulated.rates["sensor"]
    assert abs(rate.value - found.rate) <= 4.5 * rate.standard_error + found.rate_error
    cost_of = policy.theory.identity.constant + found.excess
    assert abs(simulated.cost.value - cost_of) <= 4.5 * simulated.cost.standard_error + found.excess_error
    assert found.intervals.mean == pytest.approx(1 / found.rate, rel=1e-7)


def test_evaluate_solves_what_it_can_and_says_how() -> None:
    """Quadrature by default, with its claimed error; simulation where it is asked for, or steps are given."""
    tables = {
        "plant": {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "W": [[0, 0], [0, 2.5]]},
        "cost": {"Q": [[1, 0], [0, 1]], "R": [[10]]},
        "policy": {"kind": "consistent", "period": 0.5},
    }
    problem = parse(tables, "here")
    found = taciturn.evaluate(problem)
    document = json.loads(json.dumps(found.document()))
    assert document["cost"]["method"] == "quadrature"
    assert document["cost"]["value"] == pytest.approx(27.43720939010, abs=1e-9)
    assert 0 < document["cost"]["error"] < 1e-6
    assert document["cost"]["standard_error"] == document["steps"] == 0
    assert document["mean_interval"]["value"] == pytest.approx(1 / 1.04214824, rel=1e-8)
    assert document["mean_interval"]["method"] == "quadrature"
    assert document["cost_periodic_same_rate"] > document["cost"]["value"]
    assert document["reached"]
    exact = taciturn.evaluate(problem, method="exact", steps=10_000)
    assert exact.cost == found.cost
    for simulated in (taciturn.evaluate(problem, steps=500_000), taciturn.evaluate(problem, method="simulation")):
        assert simulated.cost.method == "simulation"
        assert abs(simulated.cost.value - found.cost.value) <= 4 * simulated.cost.standard_error
        assert simulated.mean_interval.standard_error > 0


@pytest.mark.evidence
def test_what_no_quadrature_serves_is_simulated_and_told() -> None:
    """Four states: by conditional sampling where intervals are short, else simulated and told why; never exact."""
    tables = {
        "plant": {"A": (np.eye(4, k=1) - 0.5 * np.eye(4)).tolist(), "B": np.eye(4).tolist(), "W": np.eye(4).tolist()},
        "cost": {"Q": np.eye(4).tolist(), "R": np.eye(4).tolist()},
        "policy": {"kind": "consistent", "period": 0.3},
    }
    problem = parse(tables, "here")
    paths = taciturn.evaluate(problem, standard_error=2e-5)
    plain = taciturn.evaluate(problem, standard_error=1e-4, method="simulation")
    spread = np.hypot(paths.cost.standard_error, plain.cost.standard_error)
    assert abs(paths.cost.value - plain.cost.value) <= 4 * spread
    assert (paths.cost.method, paths.estimator, paths.notes) == ("simulation", "conditional sampling", ())
    assert plain.estimator == "completed squares"
    assert paths.steps != plain.steps
    seldom = taciturn.evaluate(problem.changed({"delta": 20.0}), standard_error=0.05)
    assert seldom.cost.method == "simulation"
    (told,) = [note for note in seldom.notes if note.startswith("simulated, because ")]
    assert "directions of the error" in told
    assert "instead" not in told
    assert "expected" not in told
    with pytest.raises(ProblemError, match=r"method is 'exact', but .*simulate"):
        taciturn.evaluate(problem, method="exact")


def test_only_loops_that_one_error_decides_are_chains() -> None:
    """Another plant, losses, a trigger that looks at more than the error, or no reset: refused with the reason."""
    policy = design.consistent(PLANT, COST, period=0.5)
    chain = chain_of(close(PLANT, policy))
    assert pytest.approx(np.array([[1, 0.5], [0, 1]])) == chain.F
    assert chain.delta == pytest.approx(2.891818, abs=5e-7)
    assert chain.Gamma == pytest.approx(chain.Psi / 0.5)
    other = ContinuousPlant([[0.0, 1.1], [0.0, 0.0]], [[0.0], [1.0]], PLANT.W)
    with pytest.raises(NoQuadratureError, match="the plant is not the one of the design; expected the plant, network"):
        chain_of(close(other, policy))
    with pytest.raises(NoQuadratureError, match="the network is not the one of the design"):
        chain_of(close(PLANT, policy, Network("tcp", sensor_loss=0.1)))
    with pytest.raises(NoQuadratureError, match="the cost of lqg has no closed form in this problem, and its trigger"):
        chain_of(close(PLANT, design.lqg(PLANT, COST, theta=0.1, period=0.5)))
    with pytest.raises(NoQuadratureError, match="the threshold is 0; expected a threshold above 0"):
        chain_of(close(PLANT, design.consistent(PLANT, COST, period=0.5, delta=0.0)))
