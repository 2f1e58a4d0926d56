"""Disturbances and set-points of sampled plants: the cost is the integral, by quadrature and on a fine grid of NumPy.

Nothing here uses the sampling or the Riccati equations of the library. Between samples, x and d follow the matrix
exponential, and the stage cost of the deviations (x − Xd, u − Ud) is integrated by Gauss and Legendre, or by the
trapezoidal rule on simulated paths. X and U solve AX + BU + E = XS, C_z X + F = 0 in continuous time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt
from typing import Any

import numpy as np
import pytest
from counts import few
from drawn import law
from hypothesis import assume
from hypothesis import strategies as st
from scipy.linalg import block_diag, expm

from taciturn import (
    PID,
    ContinuousPlant,
    Cost,
    Jumps,
    Network,
    Nodes,
    Policy,
    Problem,
    average,
    close,
    compare,
    design,
    evaluate,
)
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.model.disturbance import follow
from taciturn.model.signals import Exosystem, ExternalDisturbance, RandomSteps, Timetable
from taciturn.problem import parse
from taciturn.simulation.average import plain_average
from taciturn.study.describe import describe
from taciturn_channel.classes import gather
from taciturn_studies.tune import tune_period

TABLES: dict[str, Any] = {
    "plant": {"A": [[0.0]], "B": [[1.0]], "C": [[1.0]], "W": [[0.01]], "V": [[0.01]]},
    "cost": {"Q": [[1.0]], "R": [[1.0]]},
    "disturbance": [{"enters": [1.0], "kind": "constant", "wander": 1.0}],
    "policy": {"kind": "excess", "theta": 0.1, "period": 1.0},
}
NODES, WEIGHTS = (part / 2 for part in np.polynomial.legendre.leggauss(12))
NODES = NODES + 0.5  # of the interval from 0 to 1
STEPS = 1500  # of the Riccati equations, which forget their start at 0.98 per step or faster
A = np.array([[-0.3, 1.0, 0.0], [0.0, -0.2, 0.4], [0.1, 0.0, 0.2]])
B = np.array([[0.0, 0.1], [0.5, 0.0], [0.2, 1.0]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
PLANT = ContinuousPlant(A, B, 0.02 * np.eye(3), C=C, V=0.05 * np.eye(2))
COST = Cost(C.T @ C + 0.1 * np.eye(3), 0.1 * np.eye(2), 0.02 * np.ones((3, 2)))


def matrix(S: list[list[float]]) -> ExternalDisturbance:
    """Return a disturbance with dynamics of its own."""
    return ExternalDisturbance([0.0, 0.3, 0.1], 1.0, "matrix", matrix=S)


CONSTANT = ExternalDisturbance([0.0, 0.3, 0.1], 0.3)
CASES = {
    "constant": follow(PLANT, C, [1.0, -2.0], CONSTANT),
    "decays": follow(PLANT, C, None, matrix([[-0.3]])),
    "decays in waves": follow(PLANT, C, [1.0, 1.0], matrix([[-0.1, 1.5], [-1.5, -0.1]])),
    "comes to rest": follow(PLANT, C, [1.0, 1.0], matrix([[0.0, 1.5], [0.0, -1.0]])),
    "steps": follow(PLANT, C, [1.0, 1.0], [CONSTANT, matrix([[-0.5]])], RandomSteps(0.1, np.diag([4.0, 1.0]))),
    "timetable": follow(PLANT, C, None, CONSTANT, Timetable([0, 7, 14], [[0.0, 0], [1, 1], [0, 0]])),
}


@dataclass(frozen=True)
class Held:
    """A plant with its disturbances and a held input in continuous time, z = (x, d, u), for computations by hand."""

    F: np.ndarray
    """Dynamics of z."""
    noise: np.ndarray
    """Intensity of the noise of z; that of set-points, which move at samples only, is left out."""
    M: np.ndarray
    """Weight of the stage cost."""
    X: np.ndarray
    U: np.ndarray
    given: int

    @staticmethod
    def of(plant: ContinuousPlant, cost: Cost) -> Held:
        """Return the plant, its cost counted from x = Xd, u = Ud."""
        e = plant.exosystem
        assert e is not None
        (n, m), q, z = plant.B.shape, len(e.S), len(e.outputs)
        unit = np.eye(q)
        moves = np.hstack([np.kron(unit, plant.A) - np.kron(e.S.T, np.eye(n)), np.kron(unit, plant.B)])
        seen = np.hstack([np.kron(unit, e.outputs), np.zeros((q * z, q * m))])
        found = np.linalg.lstsq(np.vstack([moves, seen]), -np.concatenate([e.E.T.ravel(), e.F.T.ravel()]))[0]
        X, U = found[: n * q].reshape(q, n).T, found[n * q :].reshape(q, m).T
        from_rest = np.block([[np.eye(n), -X, np.zeros((n, m))], [np.zeros((m, n)), -U, np.eye(m)]])
        given = 0 if e.changes is None else e.changes.size
        wander = e.W.copy()
        wander[q - given :], wander[:, q - given :] = 0.0, 0.0
        return Held(
            np.vstack([np.hstack([plant.A, e.E, plant.B]), np.pad(e.S, ((0, m), (n, m)))]),
            block_diag(plant.W, wander, np.zeros((m, m))),
            from_rest.T @ np.block([[cost.Q, cost.N], [cost.N.T, cost.R]]) @ from_rest,
            X,
            U,
            given,
        )

    def over(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return transition matrix and covariance of z after a time."""
        parts = [expm(self.F * time * node) for node in NODES]
        moved = sum(w * part @ self.noise @ part.T for w, part in zip(WEIGHTS, parts, strict=True))
        return expm(self.F * time), time * moved

    def integral(self, period: float) -> tuple[np.ndarray, float]:
        """Return the integral of the stage cost over a period: the weight of z at its start, and that of the noise."""
        weight, cost = np.zeros_like(self.M), 0.0
        for w, node in zip(WEIGHTS, NODES, strict=True):
            Phi, covariance = self.over(period * node)
            weight, cost = weight + period * w * Phi.T @ self.M @ Phi, cost + period * w * np.sum(self.M * covariance)
        return weight, float(cost)


def least_cost(plant: ContinuousPlant, cost: Cost, period: float) -> float:
    """Return the cost per second of LQG with every sample, by iterating the Riccati equations of (x, d) from 0."""
    e, held = plant.exosystem, Held.of(plant, cost)
    assert e is not None
    m, n, size = plant.B.shape[1], len(plant.A), len(held.F)
    Phi, W = held.over(period)
    weight, between = held.integral(period)
    states = size - m
    A, B, W = Phi[:states, :states], Phi[:states, states:], W[:states, :states]
    Q, N, R = weight[:states, :states], weight[:states, states:], weight[states:, states:]
    if held.given and e.changes is not None:
        changed = np.zeros_like(W)
        changed[states - held.given :, states - held.given :] = period * e.changes.noise
    else:
        changed = np.zeros_like(W)
    K = np.zeros_like(Q)
    for _ in range(STEPS):
        both = B.T @ K @ A + N.T
        K = Q + A.T @ K @ A - both.T @ np.linalg.solve(R + B.T @ K @ B, both)
        K = (K + K.T) / 2
    moved = np.r_[:n, n + np.flatnonzero(e.W.any(axis=0) | e.E.any(axis=0))]  # the others are known
    moved = moved[moved < states - held.given] if held.given else moved
    place, seen = np.ix_(moved, moved), np.hstack([plant.C, e.G])[:, moved]
    prior = np.eye(len(moved))
    for _ in range(STEPS):
        gain = prior @ seen.T @ np.linalg.inv(seen @ prior @ seen.T + plant.V)
        posterior = prior - gain @ seen @ prior
        prior = A[place] @ posterior @ A[place].T + W[place]
        prior = (prior + prior.T) / 2
    total = np.sum(Q[place] * posterior) + np.sum(K[place] * (prior - posterior)) + np.sum(K * changed)
    return float(total + between) / period


def random_case(seed: int) -> tuple[ContinuousPlant, Cost, float]:
    """Return a random plant with as many outputs at set-points as inputs, disturbances, a cross term, and a period."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    m = min(n, m)
    A, B, z = rng.normal(size=(n, n)) - 0.3 * np.eye(n), rng.normal(size=(n, m)), rng.normal(size=(m, n))
    root = rng.normal(size=(n + m, n + m)) / sqrt(n + m)
    joint, noise = root @ root.T + 0.1 * np.eye(n + m), 0.3 * rng.normal(size=(n, n))
    cost = Cost(joint[:n, :n], joint[n:, n:], joint[:n, n:])
    parts = [ExternalDisturbance(rng.normal(size=n), float(rng.uniform(0.01, 1.0)))]
    if rng.random() < 0.6:
        shapes = [[[-rng.uniform(0.1, 2)]], [[-0.3, rng.uniform(0.2, 2)], [-1.0, -0.2]], [[0.0, 1.0], [0.0, -0.7]]]
        S = shapes[rng.integers(3)]
        parts.append(ExternalDisturbance(rng.normal(size=n), float(rng.uniform(0.01, 1.0)), "matrix", matrix=S))
    plant = ContinuousPlant(A, B, noise @ noise.T + 0.01 * np.eye(n), C=np.eye(n), V=0.1 * np.eye(n))
    changes = RandomSteps(0.1, np.eye(m)) if rng.random() < 0.4 else None
    disturbances = parts[: min(len(parts), n)]
    return follow(plant, z, rng.normal(size=m), disturbances, changes), cost, float(rng.uniform(0.1, 0.8))


def is_tame(plant: ContinuousPlant, cost: Cost) -> bool:
    """Return whether inputs reach all of the plant, and set-points need moderate ones."""
    found = np.linalg.svd(np.hstack([np.linalg.matrix_power(plant.A, k) @ plant.B for k in range(len(plant.A))]))[1]
    try:
        held = Held.of(plant, cost)
    except np.linalg.LinAlgError:
        return False
    return found[-1] > 0.05 and max(np.abs(held.X).max(), np.abs(held.U).max()) < 30


@law(2, 200, seed=st.integers(0, 2**32 - 1))
def test_the_cost_of_a_period_is_the_integral_of_the_stage_cost(seed: int) -> None:
    """From any state, disturbance and input, with the noise between samples."""
    plant, cost, period = random_case(seed)
    assume(is_tame(plant, cost))
    problem, (weight, between) = discretise(plant, cost, period), Held.of(plant, cost).integral(period)
    found = np.block([[problem.Q, problem.N], [problem.N.T, problem.R]])
    size = np.sqrt(np.diag(weight))
    assert np.abs(found - weight).max() <= 1e-9 * (np.outer(size, size) + 1e-3 * size.max() ** 2).max()
    assert problem.noise_cost == pytest.approx(between, rel=1e-9)
    assert not problem.instants


@law(2, 200, seed=st.integers(0, 2**32 - 1))
def test_the_cost_of_every_sample_is_that_of_iterated_riccati_equations(seed: int) -> None:
    """With constants, states that decay, disturbances that come to rest, set-points that step, and cross terms."""
    plant, cost, period = random_case(seed)
    assume(is_tame(plant, cost))
    policy = design.excess(plant, cost, theta=0.1, period=period)
    assert policy.cost_all_time == pytest.approx(least_cost(plant, cost, period), rel=1e-7)
    assert policy.guarantee is not None
    assert policy.guarantee.cost > policy.cost_all_time


@pytest.mark.parametrize(("period", "expected"), [(1.0, 1.802943), (0.2, 0.4729)])
def test_the_cost_of_every_sample_of_a_wandering_load(period: float, expected: float) -> None:
    """Reference numbers of an independent computation."""
    problem = parse({**TABLES, "policy": {"kind": "excess", "theta": 0.1, "period": period}}, "tables")
    found = problem.design().cost_all_time
    assert found == pytest.approx(expected, abs=5e-7 if period == 1 else 5e-5)
    assert found == pytest.approx(least_cost(problem.plant, problem.cost, period), rel=1e-9)


def test_an_event_triggered_loop_costs_what_a_fine_grid_measures_and_less_than_its_guarantee() -> None:
    """LQG of a wandering load and its trigger, by hand in NumPy: 2,000 paths, 25 points in each period."""
    problem = parse(TABLES, "tables")
    policy, found = problem.design(), evaluate(problem, steps=400_000, seed=1)
    assert policy.guarantee is not None
    rng, h, parts, paths, steps = np.random.default_rng(0), 1.0, 25, 2000, 60
    H, L = 2.37417, np.array([-0.649, -1.0])  # of `show`
    gain, delta = np.array([0.98627, 1.17174]), 0.121461
    x, d, estimate, u = np.zeros((4, paths))
    dt, load, total, sends = h / parts, np.zeros(paths), np.zeros(paths), 0.0
    for k in range(steps):
        off = x + 0.1 * rng.standard_normal(paths) - estimate
        estimate, load = estimate + gain[0] * off, load + gain[1] * off
        command = L[0] * estimate + L[1] * load
        sent = H * (u - command) ** 2 > delta
        u = np.where(sent, command, u)
        cost, count = np.zeros(paths), 10
        for part in range(parts):
            cost += (x**2 + (u + d) ** 2) * dt * (0.5 if part == 0 else 1.0)
            step = sqrt(dt) * rng.standard_normal(paths)
            beside = sqrt(dt**3 / 12) * rng.standard_normal(paths)  # of the integral of d over dt, given its end
            x = x + (u + d + step / 2) * dt + beside + 0.1 * sqrt(dt) * rng.standard_normal(paths)
            d = d + step
        cost += (x**2 + (u + d) ** 2) * dt / 2
        estimate = estimate + (u + load) * h
        if k >= count:
            total, sends = total + cost / (steps - count), sends + sent.mean() / (steps - count)
    measured, error = float(total.mean()), float(total.std() / sqrt(paths))
    assert measured == pytest.approx(1.8077, abs=4 * error + 0.0027)
    assert found.cost.value == pytest.approx(measured, abs=4 * error + 4 * found.cost.standard_error)
    assert sends == pytest.approx(found.rates["actuator"].value, abs=5e-3)
    assert found.cost_all_time is not None
    assert found.cost_all_time < found.cost.value < policy.guarantee.cost


def measured(plant: ContinuousPlant, cost: Cost, policy: Policy, ticks: int, parts: int = 16) -> tuple[float, float]:
    """Return the mean of the integral per second on one path, with its error; the nodes run in Python."""
    e, held, h, rng = plant.exosystem, Held.of(plant, cost), policy.tick, np.random.default_rng(7)
    assert e is not None
    m, states = plant.B.shape[1], len(held.F) - plant.B.shape[1]
    Phi, covariance = held.over(h / parts)
    values, vectors = np.linalg.eigh(covariance[:states, :states])
    root, blur = vectors * np.sqrt(np.maximum(values, 0.0)), np.linalg.cholesky(plant.V)
    nodes, z, costs = Nodes(policy), np.concatenate([plant.mean, e.start, np.zeros(m)]), np.empty(ticks)
    table = None if not isinstance(e.changes, Timetable) else e.changes.sampled(h).table
    inside = np.r_[0.5, np.ones(parts - 1), 0.5] / parts
    for k in range(ticks):
        y = np.hstack([plant.C, e.G]) @ z[:states] + blur @ rng.standard_normal(len(blur))
        given = {"reference": z[states - held.given : states]} if held.given else {}
        z[states:] = nodes.step(y, **given)
        path, noise = np.empty((parts + 1, len(z))), rng.standard_normal((parts, states)) @ root.T
        path[0] = z
        for part in range(parts):
            z = Phi @ z
            z[:states] += noise[part]
            path[part + 1] = z
        costs[k] = inside @ np.einsum("ki,ij,kj->k", path, held.M, path)
        if table is not None:
            z[states - held.given : states] += table[k % len(table)]
        elif isinstance(e.changes, RandomSteps) and rng.random() < e.changes.rate * h:
            z[states - held.given : states] += rng.multivariate_normal(np.zeros(held.given), e.changes.covariance)
    blocks = costs[50:][: (ticks - 50) // 30 * 30].reshape(30, -1).mean(axis=1)
    return float(blocks.mean()), float(blocks.std(ddof=1) / sqrt(30))


KINDS = {
    "excess": lambda plant: design.excess(plant, COST, theta=0.3, period=0.7),
    "excess, model": lambda plant: design.excess(plant, COST, theta=0.3, period=0.7, actuation="model"),
    "periodic": lambda plant: design.periodic(plant, COST, period=0.35, every=2),
    "distributed": lambda plant: design.distributed(plant, COST, theta=0.3, period=0.7),
}


@pytest.mark.parametrize("kind", few(KINDS, 1))
@pytest.mark.parametrize("case", few(CASES, 2))
def test_simulated_and_exact_costs_are_those_of_a_fine_grid(case: str, kind: str) -> None:
    """Bounds hold for the integral; plain averages and identities agree."""
    plant = CASES[case]
    policy = KINDS[kind](plant)
    loop = close(plant, policy)
    mean, error = measured(plant, COST, policy, 1550)
    answers = [average(loop, plain_average(loop), steps=200_000).cost]
    if policy.theory.identity is not None:
        answers.append(average(loop, steps=200_000).cost)
    if policy.theory.closed_form is not None:
        answers.append(replace(answers[0], value=policy.theory.closed_form.cost, standard_error=0.0))
    for found in answers:
        assert mean == pytest.approx(found.value, abs=4 * np.hypot(error, found.standard_error))
    if policy.guarantee is not None:
        assert mean < policy.guarantee.cost + 4 * error
        assert policy.guarantee.cost > policy.cost_all_time


def test_periodic_control_at_any_period_costs_the_integral() -> None:
    """The comparison at the measured rate, whose period is no multiple of the policy's."""
    found = evaluate(parse(TABLES, "tables"), steps=100_000)
    assert found.clock is not None
    for point in found.clock.points:
        problem = parse(TABLES, "tables")
        assert point.cycle is None
        assert point.cost == pytest.approx(least_cost(problem.plant, problem.cost, 1 / point.rate), rel=1e-9)
    assert found.cost.value < found.clock.cost
    document = found.document()
    assert document["unit"] == "second"
    assert document["cost_all_time"] == pytest.approx(1.802943, abs=5e-7)
    assert document["cost_periodic_same_rate"] == found.clock.cost


def test_a_given_controller_with_a_slow_disturbance_costs_the_integral() -> None:
    """A PID of a motor: the cost counts x and u, so the disturbance moves x between samples, and u does not move."""
    plant = ContinuousPlant([[0.0, 1.0], [0.0, -1.0]], [[0.0], [1.0]], np.diag([0.0, 0.1]), C=[[1.0, 0.0]], V=[[0.001]])
    cost = Cost(np.diag([1.0, 0.1]), [[0.1]])
    controller = PID(1.0, 0.3, 0.8, 0.5)
    policy = design.excess(plant, cost, theta=0.2, period=0.5, controller=controller)
    assert policy.disturbance is not None
    loop = close(plant, policy)
    whole = policy.disturbance.added_to(plant)
    assert isinstance(whole, ContinuousPlant)
    nothing = Exosystem(
        np.zeros((1, 1)),
        np.zeros((3, 1)),
        np.zeros((1, 1)),
        np.zeros((1, 1)),
        np.zeros(1),
        np.eye(1, 3),
        np.zeros((1, 1)),
    )  # X = 0, U = 0: the cost counts from 0
    still = replace_exosystem(whole, nothing)
    weights = Cost(block_diag(cost.Q, np.zeros((1, 1))), cost.R)
    held = Held.of(still, weights)
    assert not held.X.any()
    weight, between = held.integral(0.5)
    keep = np.r_[:3, 4]  # without the state that does nothing
    found = np.block([[loop.problem.Q, loop.problem.N], [loop.problem.N.T, loop.problem.R]])
    assert np.allclose(found, weight[np.ix_(keep, keep)], atol=1e-12)
    assert loop.problem.noise_cost == pytest.approx(between, rel=1e-9)


def replace_exosystem(plant: ContinuousPlant, exosystem: Exosystem) -> ContinuousPlant:
    """Return a plant with an exosystem that is made by hand."""
    return ContinuousPlant(plant.A, plant.B, plant.W, C=plant.C, V=plant.V, exosystem=exosystem)


def test_the_targets_do_not_depend_on_the_period() -> None:
    """With more inputs than outputs at set-points, X and U are those of least cost in continuous time."""
    plant = follow(PLANT, C[:1], [1.0], CONSTANT)
    found = [discretise(plant, COST, period).followed for period in (0.1, 0.7)]
    assert found[0] is not None
    assert found[1] is not None
    assert np.allclose(found[0].inputs, found[1].inputs, atol=1e-9)


SINUSOID = {"enters": [1.0], "kind": "sinusoid", "frequency": 0.5, "wander": 0.01}
RAMP = {"enters": [1.0], "kind": "ramp", "wander": 0.01}


@pytest.mark.parametrize("push", [SINUSOID, RAMP])
def test_ripple_that_grows_without_limit_leaves_the_cost_at_the_sampling_instants(push: dict[str, Any]) -> None:
    """It is named so everywhere, and no other sampling period is compared."""
    rule = {"kind": "excess", "theta": 0.1, "period": 0.5, "actuation": "model"}
    problem = parse({**TABLES, "disturbance": [push], "policy": rule}, "tables")
    at = discretise(problem.plant, problem.cost, 0.5)
    assert at.instants
    assert at.noise_cost == 0.0
    found = evaluate(problem, steps=50_000)
    assert found.document()["unit"] == describe(problem).document()["unit"] == "second at the sampling instants"
    assert found.rate_unit == "second"
    simulated = average(problem.close(problem.design()), steps=50_000)
    for text in (str(found), *("".join(one.notes) for one in (describe(problem), simulated))):
        assert "nothing is claimed for the integral" in " ".join(text.split())
    assert found.statement is not None
    assert "at the sampling instants" in found.statement
    assert "at the sampling instants" in " ".join(str(found).split())
    assert found.clock is not None
    assert all(point.cycle is not None for point in found.clock.points)
    with pytest.raises(ProblemError, match="costs of several periods cannot be compared"):
        tune_period(problem, rate=1.0, least=0.1)
    with pytest.raises(
        ProblemError,
        match=r"the problem one has the period 0.5 and the problem other the period 0.25, but their costs count only",
    ):
        compare({"one": problem, "other": problem.changed({"period": 0.25})}, 1.0)
    with pytest.raises(ProblemError, match="expected equal tables in all problems"):
        compare({"one": problem, "other": parse(TABLES, "tables")}, 1.0)


def test_the_integral_grows_with_a_sinusoid_and_the_cost_at_the_sampling_instants_does_not() -> None:
    """An amplitude that is ten times as large ripples a hundred times as much; the loop at the instants is the same."""
    plant = follow(ContinuousPlant([[0.0]], [[1.0]], [[0.01]], C=[[1.0]], V=[[0.01]]), None, None, [
        ExternalDisturbance([1.0], 0.01, "sinusoid", 0.5)
    ])  # fmt: skip
    weight, _ = Held.of(plant, Cost([[1.0]], [[1.0]])).integral(0.5)
    assert np.linalg.eigvalsh(weight[1:3, 1:3] - weight[1:3, [0, 3]] @ np.linalg.solve(
        weight[np.ix_([0, 3], [0, 3])], weight[[0, 3], 1:3]))[0] > 1e-7  # fmt: skip
    policy = design.all_time(plant, Cost([[1.0]], [[1.0]]), period=0.5)
    assert average(close(plant, policy), plain_average(close(plant, policy)), steps=400_000).cost.value == (
        pytest.approx(policy.cost_all_time, rel=0.02)
    )


@pytest.mark.parametrize("case", ["a reference of a motor that ramps", "a sensor whose bias swings"])
def test_disturbances_that_need_no_other_input_between_samples_leave_the_integral_an_average(case: str) -> None:
    """Ud is constant, although d is not."""
    motor = ContinuousPlant([[0.0]], [[1.0]], [[0.01]], C=[[1.0]], V=[[0.01]])
    if case == "a sensor whose bias swings":
        two = ContinuousPlant([[-1.0]], [[1.0]], [[0.1]], C=[[1.0], [1.0]], V=0.1 * np.eye(2))
        plant = follow(two, [[1.0]], [1.0], ExternalDisturbance([0.0], 0.01, "sinusoid", 0.5, [1.0, 0.0]))
    else:
        S = np.array([[0.0, 1.0], [0.0, 0.0]])  # the set-point, and its slope
        plant = replace_exosystem(
            motor,
            Exosystem(S, np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((2, 2)), np.ones(2), np.eye(1), [[-1.0, 0.0]]),  # type: ignore[arg-type]
        )
    problem = discretise(plant, Cost([[1.0]], [[1.0]]), 0.5)
    weight, between = Held.of(plant, Cost([[1.0]], [[1.0]])).integral(0.5)
    assert not problem.instants
    assert np.allclose(np.block([[problem.Q, problem.N], [problem.N.T, problem.R]]), weight, atol=1e-12)
    assert problem.noise_cost == pytest.approx(between, rel=1e-9)


def test_loops_on_a_channel_name_the_cost_at_the_sampling_instants() -> None:
    """And are not added to loops whose cost is the integral."""
    rule = {"kind": "excess", "theta": 0.1, "period": 0.5}
    loops = {
        name: parse({**TABLES, "disturbance": [push], "policy": rule}, "tables")
        for name, push in (("swings", SINUSOID), ("rests", TABLES["disturbance"][0]))
    }
    assert gather(loops | {"rests": loops["swings"]}, [1])[0].count == 1
    with pytest.raises(ProblemError, match="is per second at the sampling instants, but the cost of rests is per sec"):
        gather(loops, [1])


def test_a_fault_of_a_node_is_over_before_a_slow_disturbance_has_decayed() -> None:
    """The simulation waits for the disturbance, a node after a fault does not."""
    fast, slow = (follow(PLANT, C, None, matrix([[-rate]])) for rate in (5.0, 1e-3))
    for kind in KINDS.values():
        quick, late = (kind(plant).theory for plant in (fast, slow))
        assert quick.recovers == quick.settling
        if kind is not KINDS["periodic"]:
            assert late.settling > 1000
            assert late.recovers < 50


def test_jumps_with_disturbances_are_refused() -> None:
    """Jumps would move the plant, and Gaussian noise the disturbance."""
    jumping = ContinuousPlant([[-1.0]], [[1.0]], C=[[1.0]], V=[[0.1]], jumps=Jumps(2.0, [[0.1]], "normal"))
    plant = follow(jumping, None, None, ExternalDisturbance([1.0], 0.1))
    with pytest.raises(ProblemError, match="the plant has jumps; expected Gaussian noise W"):
        design.lqg(plant, Cost([[1.0]], [[1.0]]), theta=0.1, period=0.5)


def test_lower_bounds_are_above_the_cost_of_every_sample_and_below_that_of_the_policy() -> None:
    """Both count the integral."""
    tables = {**TABLES, "policy": {"kind": "excess", "theta": 0.3, "period": 1.0, "actuation": "model"}}
    found = evaluate(parse(tables, "tables"), steps=50_000, confidence=0.999)
    assert found.lower_bound is not None
    assert 1.802943 < found.lower_bound.cost < found.cost.value + 4 * found.cost.standard_error


def test_problems_of_the_sampled_kind_in_a_file_and_in_python_are_one() -> None:
    """Integral action included: its disturbances are constants."""
    tables = {**TABLES, "reference": {"integral_action": ["sensor"]}}
    del tables["disturbance"]
    problem = parse(tables, "tables")
    expected = least_cost(problem.plant, problem.cost, 1.0)
    assert problem.design().cost_all_time == pytest.approx(expected, rel=1e-9)
    whole = Problem(problem.plant, problem.cost, Network(), "excess", {"theta": 0.1, "period": 1.0})
    assert whole.design().cost_all_time == problem.design().cost_all_time
