"""Disturbances and set-points: costs by two computations, identity, guarantees, and no offset."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np
import pytest
from counts import few
from scipy.linalg import block_diag, solve_discrete_are
from systems import make_system, well_posed

from taciturn import (
    ContinuousPlant,
    Cost,
    Network,
    Plant,
    Policy,
    Problem,
    TaciturnError,
    average,
    certify,
    close,
    design,
    load,
    simulate,
)
from taciturn.base.certainty import design_certainty
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise, has_average
from taciturn.lqg.followed import regulator_equations
from taciturn.model.disturbance import follow
from taciturn.model.signals import Exosystem, ExternalDisturbance, SetPoint, Timetable
from taciturn.problem import parse
from taciturn.simulation.average import completed_squares, plain_average
from taciturn.study.describe import describe
from taciturn_limits.bounds import bound_below

A = np.array([[0.9, 0.2, 0], [0, 0.8, 0.3], [0, 0, 1.05]])
B = np.array([[0, 0.1], [0.5, 0], [0.2, 1.0]])
C = np.array([[1.0, 0, 0], [0, 0, 1.0]])
COST = Cost(C.T @ C + 0.1 * np.eye(3), 0.1 * np.eye(2))
COST_OF_ONE = Cost(np.diag([1.0, 0.0]), [[0.1]])
KEPT, OPTIONS = "which a given controller does not use", "which LQG with these options does not use; expected"
PUSH = ExternalDisturbance([0.0, 0.3, 0.1], 1e-3)


def plant_with(*disturbances: ExternalDisturbance, value: tuple[float, ...] = (1.0, -2.0)) -> Plant:
    """Return the plant of the reference with disturbances and set-points."""
    return follow(Plant(A, B, 0.02 * np.eye(3), C, 0.05 * np.eye(2)), C, value, disturbances)


REFERENCE = {0.05: (0.2045, 0.641), 0.3: (0.2712, 0.405)}
"""Cost and rate by δ, from an independent simulation of 3000 paths."""


@pytest.mark.parametrize("delta", REFERENCE)
def test_the_reference_of_set_points_and_a_wandering_disturbance(delta: float) -> None:
    """Its cost with every sample, cost and rate, and the bound."""
    policy = design.excess(plant_with(PUSH), COST, delta=delta)
    loop = close(plant_with(PUSH), policy)
    assert policy.cost_all_time == pytest.approx(0.19629, abs=5e-6)
    found = average(loop, seed=2, steps=1_000_000)
    cost, rate = REFERENCE[delta]
    assert found.cost.value == pytest.approx(cost, abs=4 * found.cost.standard_error + 3e-4)
    assert found.rates["actuator"].value == pytest.approx(rate, abs=1.5e-3)
    assert policy.guarantee is not None
    bound = policy.guarantee.at_rates(found.rates, "actuator")
    assert bound is not None
    assert policy.cost_all_time < found.cost.value < bound.value


def random_dynamics(rng: np.random.Generator, shape: str) -> np.ndarray | None:
    """Return the dynamics of a disturbance of one's own, whose modes decay or persist; None for another shape."""
    if shape != "matrix":
        return None
    S = rng.standard_normal((2, 2))
    return S / np.abs(np.linalg.eigvals(S)).max() * rng.choice([0.9, 1.0])


def random_exosystem(rng: np.random.Generator, states: int, measured: np.ndarray, inputs: int) -> Exosystem:
    """Return one or two disturbances of any shape, and set-points of at most as many outputs as inputs."""
    shapes = ("constant", "ramp", "sinusoid", "matrix")
    parts = list[ExternalDisturbance]()
    for _ in range(int(rng.integers(1, min(len(measured), 2) + 1))):
        shape = shapes[rng.integers(4)]
        frequency = float(rng.uniform(0.2, 2.0)) if shape == "sinusoid" else None
        enters, matrix = rng.standard_normal(states), random_dynamics(rng, shape)
        wander = float(rng.uniform(1e-4, 1e-2))
        parts.append(ExternalDisturbance(enters, wander, shape, frequency, matrix=matrix))  # type: ignore[arg-type]
    z = int(rng.integers(1, min(inputs, states) + 1))
    return Exosystem.of(parts, SetPoint(rng.standard_normal((z, states)), rng.standard_normal(z)), len(measured), False)


def by_hand(plant: Plant, cost: Cost) -> float:
    """Return tr(K T W T') + tr(H L_a Σ L_a') with equations of scipy, and X and U by plain linear algebra."""
    e = plant.exosystem
    assert e is not None
    n, q = len(plant.A), len(e.S)
    K = solve_discrete_are(plant.A, plant.B, cost.Q, cost.R, s=cost.N)
    H = cost.R + plant.B.T @ K @ plant.B
    L = -np.linalg.solve(H, plant.B.T @ K @ plant.A + cost.N.T)
    weight = np.block([[cost.Q, cost.N], [cost.N.T, cost.R]])
    X, U = regulator_equations(plant.A, plant.B, e.S, e.E, e.outputs, e.F, weight)
    assert np.allclose(plant.A @ X + plant.B @ U + e.E, X @ e.S, atol=1e-8 * (1 + np.abs(X).max()))
    assert np.allclose(e.outputs @ X + e.F, 0, atol=1e-8 * (1 + np.abs(X).max()))
    moved = e.W.any(axis=0) | (e.E != 0).any(axis=0)  # set-points are known
    size = int(moved.sum())
    S, E, G, W = e.S[:size, :size], e.E[:, :size], e.G[:, :size], e.W[:size, :size]
    whole = np.block([[plant.A, E], [np.zeros((size, n)), S]])
    seen, noise = np.hstack([plant.C, G]), block_diag(plant.W, W)
    prior = solve_discrete_are(whole.T, seen.T, noise, plant.V)
    gain = prior @ seen.T @ np.linalg.inv(seen @ prior @ seen.T + plant.V)
    posterior = prior - gain @ seen @ prior
    T, La = np.hstack([np.eye(n), -X[:, :size]]), np.hstack([L, (U - L @ X)[:, :size]])
    assert q >= size
    return float(np.trace(K @ T @ noise @ T.T) + np.trace(H @ La @ posterior @ La.T))


@pytest.mark.parametrize("seed", few(range(100), 3))
def test_the_cost_of_every_sample_by_two_computations(seed: int) -> None:
    """For random plants with random exosystems."""
    rng = np.random.default_rng(seed)
    system = make_system(seed, int(rng.integers(2, 6)), int(rng.integers(1, 4)), int(rng.integers(1, 4)), False)
    plant, cost = system.plant, system.cost
    if not (well_posed(plant.A, plant.B) and well_posed(plant.A.T, plant.C.T)):
        pytest.skip("the random plant is hardly controllable")
    exosystem = random_exosystem(rng, plant.states, plant.C, plant.inputs)
    whole = Plant(plant.A, plant.B, plant.W, plant.C, plant.V, exosystem=exosystem)
    policy = design.excess(whole, cost, theta=0.2)
    assert policy.cost_all_time == pytest.approx(by_hand(whole, cost), rel=1e-9)
    loop = close(whole, policy)
    assert loop.nominal
    found = average(loop, completed_squares(loop), seed=seed, steps=100_000)
    assert policy.guarantee is not None
    assert policy.cost_all_time <= found.cost.value <= policy.guarantee.cost


SHAPES = {  # of disturbances of a servo, with three to five states that wander
    "constant, sinusoid": [("constant", None, 0.01), ("sinusoid", 6.2832, 1e-4)],
    "ramp, sinusoid": [("ramp", None, 1e-3), ("sinusoid", 6.2832, 1e-4)],
    "constant, two sinusoids": [("constant", None, 0.01), ("sinusoid", 6.2832, 1e-4), ("sinusoid", 3.0, 1e-3)],
}


@pytest.mark.parametrize("theta", few([0.3, 0.05, 1.0], 1))
@pytest.mark.parametrize("shapes", few(SHAPES, 1))
def test_lower_bounds_hold_with_several_disturbances(shapes: str, theta: float) -> None:
    """Their noise is that of one output, and drives all states of the error; the bound is close to a policy's cost."""
    rates = [[0.0, 1, 0], [0, -0.5, 20], [0, -20, -100]]
    noise = np.diag([0.0, 0.05, 0.01])
    servo = ContinuousPlant(rates, [[0.0], [0], [50]], noise, C=[[1.0, 0, 0]], V=[[1e-4]])
    parts = [ExternalDisturbance([0.0, -10, 0], wander, kind, at) for kind, at, wander in SHAPES[shapes]]  # type: ignore[arg-type]
    plant = follow(servo, [[1.0, 0, 0]], None, parts)
    policy = design.lqg(plant, Cost(np.diag([10.0, 0.1, 0]), [[0.01]]), theta=theta, period=0.02, actuation="model")
    loop = close(plant, policy)
    found = average(loop, completed_squares(loop), seed=1, steps=1_000_000)
    rate = found.rates["actuator"].value * 0.02
    bound, slack = bound_below(loop, rate).cost, 4 * found.cost.standard_error
    assert policy.cost_all_time < bound < found.cost.value + slack
    assert bound - policy.cost_all_time > 0.7 * (found.cost.value - policy.cost_all_time)


@pytest.mark.parametrize(
    ("shape", "actuation", "noted"),
    [
        (("constant", None, None), "hold", False),
        (("ramp", None, None), "hold", True),
        (("ramp", None, None), "model", False),
        (("sinusoid", 0.3, None), "hold", True),
        (("matrix", None, [[0.9, 0.3], [-0.3, 0.9]]), "hold", False),  # decays
        (("matrix", None, [[1.0, 0.1], [0.0, 0.9]]), "hold", False),  # comes to rest at a constant
    ],
)
def test_a_held_input_that_cannot_follow_a_disturbance_is_noted(
    shape: tuple[str, float | None, list[list[float]] | None], actuation: str, noted: bool
) -> None:
    """Its packets become more frequent: the rate at the end of a long run is above that at its start."""
    name, frequency, matrix = shape
    plant = plant_with(
        ExternalDisturbance([0.0, 0.3, 0.1], 1e-2 if frequency else 1e-3, name, frequency, matrix=matrix)
    )  # type: ignore[arg-type]
    loop = close(plant, design.lqg(plant, COST, theta=0.5, actuation=actuation))  # type: ignore[arg-type]
    found = average(loop, steps=20_000)
    assert any("wander without limit" in note and "may follow them" in note for note in found.notes) == noted
    assert not (noted and found.settled)
    sends = simulate(loop, 40_000, seed=1).sends["actuator"]
    first, last = sends[:2000].mean(), sends[-4000:].mean()
    assert (last > first + 0.1) == noted


@cache
def policies(*value: float) -> dict[str, Policy]:
    """Return a policy of each kind that takes a disturbance, for the plant of the reference at set-points."""
    plant = plant_with(PUSH, value=value)
    return {
        "all-time": design.all_time(plant, COST),
        "periodic": design.periodic(plant, COST, every=2),
        "excess": design.excess(plant, COST, delta=0.1),
        "excess, model": design.excess(plant, COST, delta=0.1, actuation="model"),
        "lqg": design.lqg(plant, COST, theta=0.2),
        "distributed": design.distributed(plant, COST, theta=0.5),
        "near-optimal": design.near_optimal(plant, COST, price=0.1),
        "rollout": design.rollout(plant, COST, horizon=2, every=2),
        "absolute": design.absolute(plant, COST, threshold=0.5),
        "variance": design.variance(plant, COST, threshold=0.2),
        "stochastic": design.stochastic(plant, COST),
        "remote-lqg": design.remote_lqg(plant, COST, theta=0.2, zeta=0.05),
    }


KINDS = list(policies(1.0, -2.0))


@pytest.mark.parametrize("kind", KINDS)
def test_a_constant_set_point_changes_no_number_of_the_theory(kind: str) -> None:
    """It is known, so it moves the point of rest, and neither costs, bounds, exact rates nor queries."""
    at_rest, moved = policies(0.0, 0.0)[kind], policies(1.0, -2.0)[kind]
    one, two = at_rest.theory, moved.theory
    assert two.cost_all_time == pytest.approx(one.cost_all_time, rel=1e-9)
    assert (two.guarantee is None) == (one.guarantee is None)
    if one.guarantee is not None and two.guarantee is not None:
        assert two.guarantee.cost == pytest.approx(one.guarantee.cost, rel=1e-8)
    assert two.fixed_rates == one.fixed_rates
    if one.closed_form is not None and two.closed_form is not None:
        assert two.closed_form.cost == pytest.approx(one.closed_form.cost, rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_no_kind_leaves_an_offset(kind: str) -> None:
    """Under a constant disturbance of three units, the mean of the outputs is at the set-points within its error."""
    e = plant_with(PUSH).exosystem
    assert e is not None
    still = Exosystem(e.S, e.E, e.G, 0.0 * e.W, np.array([3.0, 1.0, -2.0]), e.outputs, e.F)  # it does not move
    plant = Plant(A, B, 0.02 * np.eye(3), C, 0.05 * np.eye(2), exosystem=still)
    path = simulate(close(plant, policies(1.0, -2.0)[kind]), steps=40_000, seed=3)
    outputs = path.state[500:, :3] @ C.T
    means = outputs[: len(outputs) // 50 * 50].reshape(50, -1, 2).mean(axis=1)
    error = means.std(axis=0, ddof=1) / np.sqrt(50)
    assert (np.abs(means.mean(axis=0) - [1.0, -2.0]) < 4 * error).all()
    assert (error < 0.02).all()


@pytest.mark.parametrize(
    ("disturbances", "outputs", "error", "words"),
    [
        (
            [PUSH, ExternalDisturbance([0, 0.1, 0.3], 1e-3)],
            C[:1],
            ProblemError,
            "are not observable from the measured outputs",
        ),
        (
            [PUSH],
            np.eye(3),
            ProblemError,
            r"no input keeps output 2 of the reference, .* .3 outputs, 2 inputs",
        ),
    ],
)
def test_what_cannot_be_compensated_or_seen_is_refused(
    disturbances: list[ExternalDisturbance], outputs: np.ndarray, error: type[TaciturnError], words: str
) -> None:
    """With the output, or the mode."""
    plant = follow(Plant(A, B, 0.02 * np.eye(3), C[:1], [[0.05]]), outputs, None, disturbances)
    with pytest.raises(error, match=words):
        design.excess(plant, COST, delta=0.1)


@pytest.mark.parametrize(
    ("design_it", "words"),
    [
        (
            lambda plant: design.excess(plant, COST, delta=0.1, link="sensor"),
            OPTIONS,
        ),
        (lambda plant: design.excess(plant, COST, delta=0.1, every=2), OPTIONS),
        (
            lambda plant: design.excess(plant, COST, delta=0.1, network=Network("tcp", actuator_loss=0.1)),
            OPTIONS,
        ),
        (
            lambda plant: design.distributed(plant, COST, theta=0.1, network=Network("tcp", sensor_loss=0.1)),
            "network.sensor_loss is given, together with disturbances or set-points",
        ),
        (
            lambda plant: certify(Problem(plant, COST, Network(), "excess", {"delta": 0.1})),
            "disturbances or set-points are given, which certificates do not support",
        ),
    ],
)
def test_options_without_disturbances_are_refused(design_it: Callable[[Plant], object], words: str) -> None:
    """By name, where the theory does not have them."""
    with pytest.raises(ProblemError, match=words):
        design_it(plant_with(PUSH))


@pytest.mark.parametrize("frequency", np.linspace(0.05, 3.0, 24))
def test_a_disturbance_that_an_input_cancels_leaves_the_gain_of_the_states(frequency: float) -> None:
    """Whatever its shape: the gain is that of the plant alone, and −1 for the disturbance, at every frequency."""
    plant, weights = Plant([[0.9, 0.1], [0, 0.8]], [[0], [1.0]], 0.01 * np.eye(2), [[1.0, 0]], [[0.01]]), [[0.1]]
    cost = Cost(np.diag([1.0, 0.0]), weights)
    K = solve_discrete_are(plant.A, plant.B, cost.Q, cost.R)
    L = -np.linalg.solve(cost.R + plant.B.T @ K @ plant.B, plant.B.T @ K @ plant.A)
    push = ExternalDisturbance([0.0, 1.0], 1e-3, "sinusoid", frequency)
    found = design_certainty("lqg", discretise(follow(plant, disturbances=push), cost, None))
    assert pytest.approx(np.hstack([L, [[-1.0, 0.0]]]), abs=1e-9) == found.regulator.L


@pytest.mark.parametrize("size", [1e-300, 1e-200, 1e-150, 1e-9])
def test_extreme_disturbances_are_refused_in_a_sentence_or_followed(size: float) -> None:
    """With the bound of an error, or a reason; never with an error of the linear algebra."""
    plant = Plant([[0.9, 0.1], [0, 0.8]], [[0], [1.0]], 0.01 * np.eye(2), [[1.0, 0]], [[0.01]])
    for matrix in ([[0, size], [-size, 0]], [[1, size], [0, 1]], [[1, 1 / size], [0, 1]]):
        with suppress(TaciturnError), np.errstate(all="ignore"):
            push = ExternalDisturbance([0.0, 1.0], 1.0, "matrix", matrix=matrix)
            policy = design.excess(follow(plant, disturbances=push), COST_OF_ONE, delta=0.1)
            assert policy.cost_all_time > 0


def test_a_failing_computation_with_matrices_is_a_sentence() -> None:
    """Whatever part of a design it is in, in Python."""

    def fails(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("SVD did not converge")

    problem = Problem(plant_with(), COST, Network(), "excess", {"delta": 0.1})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("taciturn.design.kinds.excess.discretise", fails)
        with pytest.raises(ProblemError, match=r"fails \(SVD did not converge\); expected numbers closer to 1"):
            problem.designed()


@pytest.mark.parametrize("shape", ["constant", "ramp", "sinusoid"])
def test_continuous_plants_have_all_shapes(shape: str) -> None:
    """The identity is the plain average, between samples included; a constant is exact."""
    frequency = 0.3 if shape == "sinusoid" else None
    push = ExternalDisturbance([0, 0.3, 0.1], 1e-3, shape, frequency)  # type: ignore[arg-type]
    plant = ContinuousPlant(A - np.eye(3), B, 0.02 * np.eye(3), C=C, V=0.05 * np.eye(2))
    plant = follow(plant, C[:1], [2.0], [push])
    policy = design.excess(plant, COST, delta=0.05, period=0.5)
    loop = close(plant, policy)
    one, two = (average(loop, of(loop), seed=1, steps=400_000).cost for of in (completed_squares, plain_average))
    assert abs(one.value - two.value) <= 4 * np.hypot(one.standard_error, two.standard_error)


def test_a_problem_file_states_them() -> None:
    """As arrays do in Python."""
    tables = {
        "plant": {"A": A.tolist(), "B": B.tolist(), "C": C.tolist(), "W": (0.02 * np.eye(3)).tolist(), "dt": 0.1,
                  "V": (0.05 * np.eye(2)).tolist()},
        "cost": {"Q": COST.Q.tolist(), "R": COST.R.tolist()},
        "disturbance": [{"enters": [0.0, 0.3, 0.1], "wander": 1e-3}],
        "reference": {"outputs": C.tolist(), "value": [1.0, -2.0]},
        "policy": {"kind": "excess", "delta": 0.05},
    }  # fmt: skip
    problem = parse(tables, "tables")
    assert problem.design().cost_all_time == design.excess(plant_with(PUSH), COST, delta=0.05).cost_all_time
    told = describe(problem).document()
    assert told["plant"]["exosystem"]["start"] == [0.0, 1.0, -2.0]
    acting = parse({**tables, "disturbance": [], "reference": {"integral_action": ["sensor"]}}, "tables")
    assert acting.plant.exosystem is not None
    assert acting.plant.exosystem.E.shape == (3, 2)
    with pytest.raises(ProblemError, match="names 'probe'; expected nodes that measure: sensor"):
        parse({**tables, "reference": {"integral_action": ["probe"]}}, "tables")
    assert load("two-mass").plant.exosystem is None


def test_integral_action_expects_half_of_the_noise_in_a_thousand_steps() -> None:
    """A random walk: the variance of a thousand steps is a quarter of that of the noise at the input."""
    tables = {
        "plant": {"A": [[0.9]], "B": [[1.0]], "C": [[1.0]], "W": [[0.1]], "V": [[0.1]], "dt": 1.0},
        "cost": {"Q": [[1.0]], "R": [[0.1]]},
        "nodes": {"s": {"measures": [0]}, "c": {"controls": True, "applies": True}},
        "reference": {"integral_action": ["s"]},
        "policy": {"kind": "distributed", "theta": 0.5},
    }
    problem = parse(tables, "tables")
    assert problem.plant.exosystem is not None
    assert 1000 * problem.plant.exosystem.W[0, 0] == pytest.approx(0.25 * 0.1)
    assert problem.design().cost_all_time == pytest.approx(0.159277, abs=5e-7)


PUSHED = {"enters": [1.0], "kind": "sinusoid", "wander": 1e-3}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"disturbance": [{"enters": [1.0]}]}, r"disturbance\[0\].wander is missing; expected the variance of what"),
        ({"disturbance": [PUSHED | {"size": 1}]}, r"disturbance\[0\].size is not a known key; expected one of enters"),
        ({"disturbance": PUSHED}, r"\[disturbance\] is a single table; expected \[\[disturbance\]\] for each"),
        (
            {"disturbance": [PUSHED | {"frequency": 4.0}]},
            "frequency is 4; expected a frequency below π radians per step",
        ),
        ({"reference": {"integral_action": ["sensor", "sensor"]}}, "names 'sensor' twice"),
        (
            {"reference": {"outputs": [[1.0, 0.0]]}},
            "reference.outputs has 2 columns; expected 1 column, one for each state",
        ),
        ({"cost.horizon": 5}, "the cost has a horizon; expected an average cost"),
        ({"cost.discount": 0.9}, "the cost is discounted; expected an average cost"),
        (
            {"policy": {"kind": "event-pid", "delta": 0.1, "longest": 2.0}},
            r"\[controller\] is missing, which the policy kind event-pid",
        ),
    ],
)
def test_what_a_file_states_wrongly_is_named(changes: dict[str, Any], words: str) -> None:
    """The key, what is wrong, and what is expected."""
    tables: dict[str, Any] = {
        "plant": {"A": [[0.9]], "B": [[1.0]], "C": [[1.0]], "W": [[0.1]], "V": [[0.1]], "dt": 1.0},
        "cost": {"Q": [[1.0]], "R": [[0.1]]},
        "policy": {"kind": "excess", "theta": 0.1},
        "reference": {"value": [1.0]},
    }
    for key, value in changes.items():
        table, _, name = key.partition(".")
        tables[table] = {**tables[table], name: value} if name else value
    with pytest.raises(ProblemError, match=words):
        parse(tables, "x").design()


def test_a_disturbance_faster_than_the_sampling_is_refused() -> None:
    """A sinusoid that a period aliases, and one disturbance needs no list."""
    push = ExternalDisturbance([1.0], 1e-3, "sinusoid", 40.0)
    plant = follow(ContinuousPlant([[-1.0]], [[1.0]], [[0.1]], C=[[1.0]], V=[[0.1]]), disturbances=push)
    assert design.lqg(plant, Cost([[1.0]], [[1.0]]), theta=0.1, period=0.05).model.states == 3
    with pytest.raises(ProblemError, match=r"40 radians per second, .*; expected a frequency below π/period"):
        design.lqg(plant, Cost([[1.0]], [[1.0]]), theta=0.1, period=0.1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shape": "matrix"}, "disturbance.matrix is missing"),
        ({"matrix": [[1.0]]}, "disturbance.matrix is given; expected none for a constant"),
        ({"shape": "matrix", "matrix": [[1.0, 0.0], [0.0, 1.1]]}, "has the mode 1.1, which grows"),
    ],
)
def test_dynamics_of_a_disturbance_neither_lack_nor_grow(changes: dict[str, object], words: str) -> None:
    """In one sentence."""
    with pytest.raises(ProblemError, match=words):
        plant_with(ExternalDisturbance([0.0, 0.3, 0.1], 1e-3, **changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [1.0, 1e-13])
def test_a_ramp_has_no_average_in_any_units(size: float) -> None:
    """Beside a constant disturbance, whose input is larger by the ratio of the units."""
    plant = ContinuousPlant([[-1.0]], [[1.0]], [[0.1]], C=[[1.0]], V=[[0.1]])
    ramp = ExternalDisturbance([size], 1e-3 / size**2, "ramp")
    moving = follow(plant, disturbances=[ExternalDisturbance([1.0], 1e-3), ramp])
    assert not has_average(moving, Cost([[1.0]], [[1.0]]))


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (ExternalDisturbance([0.0, 0.3], 1e-3), r"disturbance\[1\].enters has 2 entries; expected 3"),
        (
            ExternalDisturbance([0.0, 0.3, 0.1], 1e-3, measured=[1.0]),
            r"disturbance\[1\].measured has 1 ent.*; expected 2",
        ),
        (
            ExternalDisturbance([0.0, 0.3, 0.1], 1e-3, "sinusoid", 4.0),
            r"disturbance\[1\].frequency is 4; expected a frequency below",
        ),
        (ExternalDisturbance([1.0, 0, 0], 1e-3, "matrix", matrix=[[1.1]]), r"disturbance\[1\].matrix has the mode 1.1"),
    ],
)
def test_messages_name_the_disturbance_by_its_place(second: ExternalDisturbance, words: str) -> None:
    """As in the file, from 0 on."""
    with pytest.raises(ProblemError, match=words):
        plant_with(PUSH, second)


def test_a_dead_band_without_noise_leaves_an_offset_below_its_bound() -> None:
    """|z| ≤ √(δ M H⁻¹ M') with M = C_z (I − A − BL)⁻¹ B, and the band is wide enough for an offset."""
    delta = 0.3
    policy = design.excess(plant_with(PUSH), COST, delta=delta)
    K = solve_discrete_are(A, B, COST.Q, COST.R)
    H = COST.R + B.T @ K @ B
    L = -np.linalg.solve(H, B.T @ K @ A)
    M = C @ np.linalg.inv(np.eye(3) - A - B @ L) @ B
    bound = np.sqrt(delta * np.diag(M @ np.linalg.inv(H) @ M.T))
    offsets = list[np.ndarray]()
    for start in np.random.default_rng(1).normal(size=(8, 3)):
        e = plant_with(PUSH).exosystem
        assert e is not None
        still = Exosystem(e.S, e.E, e.G, 0.0 * e.W, np.array([2.0, 1.0, -2.0]), e.outputs, e.F)
        quiet = Plant(A, B, np.zeros((3, 3)), C, np.zeros((2, 2)), mean=start, exosystem=still)
        path = simulate(close(quiet, policy), steps=3_000)
        assert not path.sends["actuator"][-500:].any() or np.ptp(path.state[-500:, :3], axis=0).max() < 1
        offsets.append(np.abs(path.state[-500:, :3] @ C.T - [1.0, -2.0]).max(axis=0))
    assert (np.array(offsets) <= bound * (1 + 1e-9)).all()
    assert (np.array(offsets) > 0.05 * bound).any()


@pytest.mark.parametrize(
    ("value", "changes"),
    [((3.0,), None), (None, Timetable([0, 5, 9], [[0.5], [3.0], [0.5]]))],
    ids=["constant", "timetable"],
)
def test_a_set_point_that_needs_more_than_the_limits_is_refused(
    value: tuple[float, ...] | None, changes: Timetable | None
) -> None:
    """With the input that it needs; within the limits it is accepted."""
    plant = Plant([[0.9]], [[1.0]], [[0.1]], [[1.0]], [[0.1]], input_limit=[[0.0, 0.2]])
    cost = Cost([[1.0]], [[1.0]])
    with pytest.raises(ProblemError, match=r"the set-point needs the input \[0\.3\], beyond the input_limit"):
        design.excess(follow(plant, None, value, (), changes), cost, delta=0.1)
    design.excess(follow(plant, None, [2.0]), cost, delta=0.1)
