"""Measurements that come late, lost and in any order: the estimate is that of one conditioning, the costs are exact."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from counts import few
from measured import agree_together, average
from runtime.late import delays, late_sensor, record
from runtime.loops import column

from taciturn import Cost, Loop, Network, Plant, ProblemError, UnstableError, close
from taciturn.design import all_time, lossy_lqg
from taciturn.model.link import LinkLaw
from taciturn.program import translation
from taciturn.program.late import NEVER
from taciturn.simulation.average import plain_average

STEPS = 40
PLANT = Plant([[1.1, 0.2], [0.0, 0.7]], [[0.3], [1.0]], np.diag([0.1, 0.2]), [[1.0, 0.0]], [[2.0]])
COST = Cost(np.eye(2), [[0.2]])


def late(delay: Sequence[float], loss: float = 0.0, lost: float = 0.0, acknowledged: bool | None = None) -> Network:
    """Return links whose sensor packets are late or lost, and whose inputs are lost."""
    sensor, actuator = LinkLaw(loss=loss, delay=[*delay]), LinkLaw(loss=lost, acknowledged=acknowledged)
    return Network(links={"sensor": sensor, "actuator": actuator})


def drawn(seed: int, outputs: bool, acknowledged: bool | None) -> Loop:
    """Return a random plant, also unstable, with noise at its start, over links that are late, lossy and reorder."""
    rng = np.random.default_rng(seed)
    n, m, p, depth = (int(rng.integers(1, most)) for most in (4, 3, 3, 5))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    A *= rng.uniform(0.6, 1.15) / np.abs(np.linalg.eigvals(A)).max()
    root, noise, begun = rng.normal(size=(n, n)), rng.normal(size=(p, p)), rng.normal(size=(n, n))
    more: dict[str, Any] = {}
    if outputs:
        more = {"C": rng.normal(size=(p, n)), "V": noise @ noise.T + 0.05 * np.eye(p)}
    plant = Plant(A, B, root @ root.T, mean=rng.normal(size=n), covariance=begun @ begun.T, **more)
    shares = rng.dirichlet(np.ones(depth + 1))
    network = late(shares, float(rng.uniform(0.0, 0.4)), 0.0 if acknowledged is None else 0.3, acknowledged)
    terminal = np.eye(n)
    cost = Cost(np.eye(n), np.eye(m), horizon=STEPS, terminal=terminal)
    return close(plant, lossy_lqg(plant, cost, price=0.0, network=network))


def conditioned(plant: Plant, effects: np.ndarray, y: np.ndarray, came: list[int], now: int) -> np.ndarray:
    """Return E[x_now | y_t, t in came] by one conditioning of all states on these measurements."""
    n = plant.states
    # all states as a linear function of the initial state and of the noise of all steps
    whole = np.zeros((now + 1, n, (now + 1) * n))
    whole[0, :, :n] = np.eye(n)
    means = [plant.mean]
    for k in range(now):
        whole[k + 1] = plant.A @ whole[k]
        whole[k + 1, :, (k + 1) * n : (k + 2) * n] += np.eye(n)
        means.append(plant.A @ means[-1] + effects[k])
    spread = np.kron(np.eye(now + 1), plant.W)
    spread[:n, :n] = plant.covariance
    if not came:
        return means[now]
    seen = np.concatenate([plant.C @ whole[t] for t in came])
    gap = np.concatenate([y[t] - plant.C @ means[t] for t in came])
    S = seen @ spread @ seen.T + np.kron(np.eye(len(came)), plant.V)
    return means[now] + whole[now] @ spread @ seen.T @ np.linalg.lstsq(S, gap, rcond=1e-13)[0]


@pytest.mark.parametrize("acknowledged", [None, True], ids=["no losses", "acknowledged"])
@pytest.mark.parametrize("first", few(range(0, 400, 4), 2))
def test_the_input_is_that_of_one_conditioning_on_all_measurements_that_have_come(
    first: int, acknowledged: bool | None
) -> None:
    """In every step of four random loops, with delays, losses and packets that overtake others."""
    overtaken = 0
    for seed in range(first, first + 4):
        loop = drawn(seed, True, acknowledged)
        plant, gains = loop.problem.plant, gains_of(loop)
        records = record(loop, STEPS, seed, fast=False)
        y, u, codes = column(records, "y"), column(records, "applied"), delays(loop, records)["sensor"]
        used = delays(loop, records)["actuator"] < NEVER / 2
        come = [k + int(code) for k, code in enumerate(codes)]
        for k in range(STEPS):
            came = [t for t in range(k + 1) if come[t] <= k]
            x = conditioned(plant, u[:k] @ plant.B.T, y, came, k)
            wanted = gains[k] @ x * used[k]
            assert np.abs(u[k] - wanted).max() <= 1e-9 * (1 + np.abs(gains[k]).max() * np.abs(x).max())
        overtaken += sum(one > other for one, other in pairwise(t for t in come if t < NEVER / 2))
    assert overtaken or first


def gains_of(loop: Loop) -> np.ndarray:
    """Return L of each step, (steps, m, n), from the controller's sum."""
    (step,) = (one for one in loop.policy.steps if getattr(one, "signal", "") == "command")
    (terms,) = step.branches  # type: ignore[union-attr]
    return np.array(terms["estimate"].values)


@pytest.mark.parametrize("first", few(range(0, 400, 4), 2))
def test_a_measured_state_is_moved_to_the_present_by_the_mean_of_what_inputs_do(first: int) -> None:
    """Inputs are lost unnoticed; the newest measurement that has come says all of the steps before it."""
    for seed in range(first, first + 4):
        loop = drawn(seed, False, False)
        plant, gains = loop.problem.plant, gains_of(loop)
        records = record(loop, STEPS, seed, fast=False)
        y, u, codes = column(records, "y"), column(records, "applied"), delays(loop, records)["sensor"]
        used = delays(loop, records)["actuator"] < NEVER / 2
        commands = np.zeros((STEPS, plant.inputs))
        for k in range(STEPS):
            newest = max((t for t in range(k + 1) if t + codes[t] <= k), default=None)
            x, since = (plant.mean, 0) if newest is None else (y[newest], newest)
            for t in range(since, k):
                x = plant.A @ x + 0.7 * plant.B @ commands[t]
            commands[k] = gains[k] @ x
            assert np.allclose(u[k], commands[k] * used[k], rtol=0, atol=1e-9 * (1 + np.abs(commands[k]).max()))


@pytest.mark.parametrize("a", [0.6, 1.0, 1.15])
def test_the_cost_is_that_of_the_shares_of_ages(a: float) -> None:
    """Of a scalar plant: the error of a sample that is j steps old is Σ_{i<j} a^{2i} W, and the shares are products."""
    plant, cost, law, loss = Plant([[a]], [[1.0]], [[1.0]]), Cost([[1.0]], [[0.5]]), (0.3, 0.0, 0.4, 0.2), 0.1
    policy = lossy_lqg(plant, cost, price=0.2, network=late(law, loss))
    K = 1.0
    for _ in range(2000):
        K = 1.0 + a * a * K - (a * K) ** 2 / (0.5 + K)
    weight, longest = (a * K) ** 2 / (0.5 + K), len(law) - 1
    missing = 1 - (1 - loss) * np.cumsum(law)
    share, error, expected = 1.0, 0.0, K
    for age in range(4000):  # share of the steps in which the newest sample is older, and what one more step adds
        share *= missing[min(age, longest)]
        error = a ** (2 * age)
        expected += weight * share * error
        if share * error < 1e-18:
            break
    assert policy.cost_all_time == pytest.approx(expected, rel=1e-9)


def test_without_delays_the_design_is_that_of_losses() -> None:
    """A law with delay 0 and a rest that is lost, and the same loss; also over a horizon, and if nobody notices."""
    plant = Plant(PLANT.A, PLANT.B, PLANT.W)
    for cost in (COST, Cost(COST.Q, COST.R, horizon=30, terminal=np.eye(2))):
        for acknowledged in (True, False):
            lossy = Network("tcp" if acknowledged else "udp", actuator_loss=0.2, sensor_loss=0.4)
            one = lossy_lqg(plant, cost, price=0.1, network=lossy)
            other = lossy_lqg(plant, cost, price=0.1, network=late([0.8], 0.25, 0.2, acknowledged))
            assert other.cost_all_time == pytest.approx(one.cost_all_time, rel=1e-10)
            later = lossy_lqg(plant, cost, price=0.1, network=late([0.5, 0.3], 0.25, 0.2, acknowledged))
            assert later.cost_all_time > one.cost_all_time


@pytest.mark.parametrize("first", few(range(0, 400, 8), 1))
def test_cost_identity_and_bound_hold_with_late_states(first: int) -> None:
    """On eight random loops together, with acknowledgements and without, average costs and totals."""
    differences = list[float]()
    for seed in range(first, first + 8):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 4))
        A, B = rng.normal(size=(n, n)), rng.normal(size=(n, 1))
        A *= rng.uniform(0.5, 1.1) / np.abs(np.linalg.eigvals(A)).max()
        plant = Plant(A, B, np.diag(rng.uniform(0.1, 1.0, n)))
        cost = Cost(np.eye(n), [[0.3]]) if rng.integers(2) else Cost(np.eye(n), [[0.3]], horizon=50, terminal=np.eye(n))
        shares, acknowledged = rng.dirichlet(np.ones(3)), bool(rng.integers(2))
        try:
            policy = lossy_lqg(plant, cost, price=0.1, network=late(shares, 0.1, 0.2, acknowledged))
        except UnstableError:
            continue
        if policy.theory.settling > 40:
            continue
        loop = close(plant, policy)
        assert loop.nominal
        assert policy.guarantee is not None
        square = average(loop, steps=60_000, seed=seed)
        plain = average(loop, plain_average(loop), steps=60_000, seed=seed + 1)
        errors = np.hypot(plain.cost.standard_error, square.cost.standard_error)
        differences.append((plain.cost.value - square.cost.value) / errors)
        assert square.cost.value < policy.guarantee.cost
    assert len(differences) > 3
    assert agree_together(differences)


def test_all_measurements_cost_less_than_the_newest_ones_and_than_the_longest_delay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The same filter, from which the network hides overtaken packets, or whose packets all take the longest delay."""
    laws = {"fused": [0.3, 0.0, 0.0, 0.6], "longest": [0.0, 0.0, 0.0, 0.9]}
    loops = {name: close(PLANT, lossy_lqg(PLANT, COST, price=0.0, network=late(law))) for name, law in laws.items()}
    found = {name: average(loop, steps=400_000, seed=1).cost for name, loop in loops.items()}
    monkeypatch.setattr(translation, "uses_every_packet", lambda *_: False)
    fresh = close(PLANT, lossy_lqg(PLANT, COST, price=0.0, network=late(laws["fused"])))
    found["newest"] = average(fresh, steps=400_000, seed=2).cost

    def errors(*names: str) -> float:
        return float(np.hypot(*(found[name].standard_error for name in names)))

    assert found["fused"].value + 4 * errors("fused", "newest") < found["newest"].value
    assert found["newest"].value + 4 * errors("newest", "longest") < found["longest"].value


@pytest.mark.parametrize("acknowledged", [None, True], ids=["no losses", "losses"])
def test_outputs_that_arrive_at_once_have_the_exact_cost(acknowledged: bool | None) -> None:
    """Identity and plain average agree; without losses, an attempt in every step costs what LQG does."""
    network = late([0.9, 0.1], 0.0, 0.2 if acknowledged else 0.0, acknowledged).changed({"sensor": {"delay": None}})
    policy = lossy_lqg(PLANT, COST, price=0.3, network=network)
    loop = close(PLANT, policy)
    assert loop.nominal
    square, plain = (average(loop, way, steps=400_000, seed=3) for way in (None, plain_average(loop)))
    gap = plain.cost.value - square.cost.value
    assert abs(gap) < 4 * np.hypot(plain.cost.standard_error, square.cost.standard_error)
    assert policy.guarantee is not None
    assert policy.cost_all_time < square.cost.value < policy.guarantee.at_rate(square.rates["actuator"].value)
    if not acknowledged:
        assert policy.cost_all_time == pytest.approx(all_time(PLANT, COST).cost_all_time, rel=1e-9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"network.protocol": "udp"}, "its filter knows which inputs were applied, and .*actuator_loss is 0.1"),
        ({"network.delay": 1}, "network.delay is 1, and network.sensor_delay is random"),
        ({"plant.input_limit": 1.0}, "inputs have limits"),
        (
            {"network.protocol": "udp", "network.actuator_loss": 0.0, "network.actuator_delay": [0.5, 0.5]},
            "network.actuator_delay is random",
        ),
        (
            {"network.sensor_delay": {"seconds": [0.0, 0.13], "probability": [0.5, 0.5]}},
            "but the plant is discrete in time",
        ),
        ({"plant.V": [[0.0]]}, r"plant.V has the eigenvalue 0"),
        ({"network.sensor_delay": [0.04] * 25}, "keep 50 entries of states; expected at most 48"),
        ({"plant.C": None, "plant.V": None, "plant.input_limit": 1.0}, "the inputs have limits"),
    ],
)
def test_what_a_filter_of_late_measurements_cannot_do_is_refused_by_name(changes: dict[str, Any], words: str) -> None:
    """Each refusal names the key, and a remedy."""
    with pytest.raises(ProblemError, match=words):
        late_sensor(**changes).design()


def test_random_delays_of_inputs_withdraw_the_claims() -> None:
    """The filter then takes inputs for applied when they are sent; the theory does not cover it."""
    states = {"plant.C": None, "plant.V": None, "network.protocol": "udp"}
    problem = late_sensor(**states, **{"network.actuator_delay": [0.5, 0.5]})
    assert not problem.close(problem.design()).nominal
    other = late_sensor(**states)
    assert other.close(other.design()).nominal
