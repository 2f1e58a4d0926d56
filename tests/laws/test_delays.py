"""Laws of constant delays: the cost of every sample is that of a loop with a queue for each packet, written anew."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg as sla
from counts import few
from systems import make_system

from taciturn import ContinuousPlant, Cost, Network, Plant
from taciturn.design import distributed, excess, lossy_lqg
from taciturn.errors import ProblemError
from taciturn.loop import close
from taciturn.model.controller import Controller
from taciturn.model.delay import Wait
from taciturn.model.disturbance import Disturbance
from taciturn.model.network import LinkLaw, NodeRole
from taciturn.model.policy import longest_silence
from taciturn.problem import parse
from taciturn.study.record import fingerprint

Array = np.ndarray
SETTLED = 1e-15


@dataclass
class Queues:
    """A problem with a queue for every command and every sample: x⁺ = A x + B u + w, y = C x + v, cov(w, v) = S."""

    A: Array
    B: Array
    C: Array
    W: Array
    V: Array
    S: Array
    stage: Array
    constant: float


def integral(A: Array, B: Array, M: Array, W: Array, time: float) -> tuple[Array, Array, Array, float]:
    """Return transition, weight, noise and the cost of noise of an interval with held inputs, by Van Loan."""
    n, m = B.shape
    F = np.block([[A, B], [np.zeros((m, n + m))]])
    N, G = n + m, np.pad(W, (0, m))
    E = sla.expm(np.block([[-F.T, M], [np.zeros((N, N)), F]]) * time)
    Phi = E[N:, N:]
    weight = Phi.T @ E[:N, N:]
    E = sla.expm(np.block([[F, G], [np.zeros((N, N)), -F.T]]) * time)
    noise = E[:N, N:] @ Phi.T
    points, shares = np.polynomial.legendre.leggauss(20)
    cost = 0.0
    for point, share in zip((points + 1) * time / 2, shares * time / 2, strict=True):
        E = sla.expm(np.block([[F, G], [np.zeros((N, N)), -F.T]]) * point)
        cost += share * float(np.trace(M @ E[:N, N:] @ sla.expm(F * point).T))
    return Phi, (weight + weight.T) / 2, (noise + noise.T) / 2, cost


def queued(plant: Plant | ContinuousPlant, cost: Cost, period: float, late: list[float], old: list[float]) -> Queues:
    """Return the problem with delays of inputs and outputs in periods. The controller acts at the latest sample."""
    (n, m), p = plant.B.shape, len(plant.C)
    part = max((one - int(one) for one in old), default=0.0)
    acts = [one + part for one in late]
    length = [int(np.ceil(one - 1e-12)) for one in acts]
    size = sum(length)
    place = np.cumsum([0, *length])
    M = np.block([[cost.Q, cost.N], [cost.N.T, cost.R]])

    def command(i: int, age: int) -> Array:
        row = np.zeros(n + size + m)
        row[n + size + i if age == 0 else n + place[i] + age - 1] = 1.0
        return row

    if isinstance(plant, ContinuousPlant):
        cuts = sorted({0.0, 1.0, *(round(one - int(one + 1e-12), 12) for one in acts)})
        F, weight, noise, constant = np.eye(n, n + size + m), np.zeros((n + size + m,) * 2), np.zeros((n, n)), 0.0
        for begin, end in pairwise(cuts):
            u = np.array([
                command(i, int(one + 1e-12) if begin >= one - int(one + 1e-12) - 1e-9 else int(one + 1e-12) + 1)
                for i, one in enumerate(acts)
            ])  # fmt: skip
            Phi, stage, shaken, spent = integral(plant.A, plant.B, M, plant.W, (end - begin) * period)
            z = np.vstack([F, u])
            weight = weight + z.T @ stage @ z
            constant += spent + float(np.trace(stage[:n, :n] @ noise))
            noise = Phi[:n, :n] @ noise @ Phi[:n, :n].T + shaken[:n, :n]
            F = Phi[:n] @ z
    else:
        u = np.array([command(i, round(one)) for i, one in enumerate(acts)])
        z = np.vstack([np.eye(n, n + size + m), u])
        F, weight, noise, constant = np.hstack([plant.A, plant.B]) @ z, z.T @ M @ z, plant.W, 0.0
    ages = [int(one) for one in old]
    total = n + size + sum(ages)
    keep = [*range(n + size), *range(total, total + m)]
    A, B, stage = np.zeros((total, total)), np.zeros((total, m)), np.zeros((total + m,) * 2)
    A[:n, : n + size], B[:n] = F[:, : n + size], F[:, n + size :]
    stage[np.ix_(keep, keep)] = weight
    for i in range(m):
        if length[i]:
            B[n + place[i], i] = 1.0
            for age in range(1, length[i]):
                A[n + place[i] + age, n + place[i] + age - 1] = 1.0
    W, C, V, S, at = np.zeros((total, total)), np.zeros((p, total)), plant.V.copy(), np.zeros((total, p)), n + size
    W[:n, :n] = noise
    starts = dict[int, int]()
    for j, age in enumerate(ages):
        if age:
            A[at, :n], starts[j] = plant.C[j], at
            for later in range(1, age):
                A[at + later, at + later - 1] = 1.0
            C[j, at + age - 1] = 1.0
            at += age
        else:
            C[j, :n] = plant.C[j]
    for j, first in starts.items():
        for i in range(p):
            if i in starts:
                W[first, starts[i]] = plant.V[j, i]
            else:
                S[first, i] = plant.V[j, i]
    V[[*starts]] = 0.0
    V[:, [*starts]] = 0.0
    return Queues(A, B, C, W, V, S, stage, constant)


def cost_of_every_sample(q: Queues) -> float:
    """Return the least average cost per step, with noise that shows in the measurement, by plain iteration."""
    n = len(q.B)
    Q, R, N = q.stage[:n, :n], q.stage[n:, n:], q.stage[:n, n:]
    K, P = Q.copy(), q.W + 1e-3 * np.eye(n)
    for _ in range(100_000):
        H, G = R + q.B.T @ K @ q.B, q.A.T @ K @ q.B + N
        after = Q + q.A.T @ K @ q.A - G @ np.linalg.pinv(H, hermitian=True, rcond=1e-12) @ G.T
        done, K = np.abs(after - K).max() <= SETTLED * np.abs(after).max(), (after + after.T) / 2
        if done:
            break
    for _ in range(100_000):
        T, U = q.C @ P @ q.C.T + q.V, q.A @ P @ q.C.T + q.S
        after = q.A @ P @ q.A.T + q.W - U @ np.linalg.pinv(T, hermitian=True, rcond=1e-12) @ U.T
        done, P = np.abs(after - P).max() <= SETTLED * np.abs(after).max(), (after + after.T) / 2
        if done:
            break
    T = np.linalg.pinv(q.C @ P @ q.C.T + q.V, hermitian=True, rcond=1e-12)
    H = R + q.B.T @ K @ q.B
    gain, known = P @ q.C.T @ T, q.S @ T
    # the optimal input is −H⁻¹((B'KA + N')x̂ + B'Kŵ), where ŵ is the part of the noise that the sample shows
    back = np.linalg.pinv(H, hermitian=True, rcond=1e-12)
    on_state, on_noise = q.B.T @ K @ q.A + N.T, q.B.T @ K
    nu = q.C @ P @ q.C.T + q.V
    total = float(np.trace(K @ q.W))
    # E|H^{-1/2}(…)(x, w)|² minus that of what is known
    both = np.block([[P, np.zeros((n, n))], [np.zeros((n, n)), q.W]])
    shown = np.vstack([gain, known])
    unknown = both - shown @ nu @ shown.T
    row = np.hstack([on_state, on_noise])
    total += float(np.trace(row.T @ back @ row @ unknown)) - float(np.trace(on_noise.T @ back @ on_noise @ q.W))
    return total + q.constant


def drawn(seed: int, parts: bool) -> tuple[Plant | ContinuousPlant, Cost, float]:
    """Return a random plant that several sensors measure, with a cross term in its cost, and a period."""
    rng = np.random.default_rng(seed)
    n, m, p = int(rng.integers(1, 4)), int(rng.integers(1, 3)), int(rng.integers(1, 4))
    system = make_system(seed, n, m, p, False)
    if not parts:
        return system.plant, system.cost, 1.0
    A = rng.normal(size=(n, n))
    A += np.eye(n) * (rng.uniform(-0.6, 0.5) - np.linalg.eigvals(A).real.max())
    plant = ContinuousPlant(A, system.plant.B, system.plant.W, C=system.plant.C, V=system.plant.V)
    return plant, system.cost, float(rng.uniform(0.1, 0.4))


def network_of(late: list[float], old: list[float], period: float, parts: bool) -> Network:
    """Return a network with a node for every input and output, each with its delay."""

    def law(delay: float) -> LinkLaw:
        return LinkLaw(delay={"seconds": delay * period} if parts else int(delay))  # type: ignore[arg-type]

    nodes = {f"s{j}": NodeRole(measures=(j,)) for j in range(len(old))} | {"c": NodeRole(controls=True)}
    nodes |= {f"a{i}": NodeRole(applies=(i,)) for i in range(len(late))}
    links = {f"s{j}": law(delay) for j, delay in enumerate(old)} | {f"a{i}": law(d) for i, d in enumerate(late)}
    return Network(nodes=nodes, links=links)


@pytest.mark.parametrize("parts", [False, True])
@pytest.mark.parametrize("seed", few(range(50), 3))
def test_the_cost_of_every_sample_is_that_of_the_loop_with_queues(seed: int, parts: bool) -> None:
    """Check it for several sensors and actuators, whole delays of discrete plants and parts of a period."""
    plant, cost, period = drawn(seed, parts)
    rng = np.random.default_rng([seed, 7])
    shape = (plant.inputs, len(plant.C))
    late, old = ([float(d) for d in rng.integers(0, 4, size)] for size in shape)
    if parts:
        late, old = ([float(round(d * rng.uniform(0, 1), 2)) for d in one] for one in (late, old))
    network = network_of(late, old, period, parts)
    more = {"period": period} if parts else {}
    policy = distributed(plant, cost, theta=0.1, network=network, **more)
    assert policy.cost_all_time is not None
    wanted = cost_of_every_sample(queued(plant, cost, period, late, old)) / period
    assert policy.cost_all_time == pytest.approx(wanted, rel=1e-9)


def test_the_reference_costs_of_a_part_of_a_period() -> None:
    """Check costs that were computed from integrals over one period."""
    A, B, C = np.array([[0.0, 1], [0, -0.5]]), np.array([[0.0], [1]]), np.eye(2)[:1]
    plant = ContinuousPlant(A, B, np.diag([0.0, 0.3]), C=C, V=[[0.01]])
    cost = Cost(np.diag([1.0, 0.1]), [[0.1]])
    for seconds, wanted in ((0.0, 0.179787806), (0.06, 0.198001584), (0.15, 0.227348977), (0.3, 0.281637822)):
        for link in ("actuator", "sensor"):
            law = LinkLaw(delay={"seconds": seconds})  # type: ignore[arg-type]
            policy = excess(plant, cost, theta=0.1, period=0.3, network=Network(links={link: law}))
            assert policy.cost_all_time == pytest.approx(wanted, abs=6e-10)


@pytest.mark.parametrize("late", [{"delay": 1, "loss": 0.1}, {"delay": [0.7, 0.2, 0.1], "buffer": 1}])
def test_a_loss_that_a_design_ignores_is_simulated_on_a_late_link_too(late: dict[str, object]) -> None:
    """Without acknowledgement, ``excess`` is designed for a link without losses; its loop has them."""
    plant, cost, _ = drawn(0, parts=False)
    network = Network(links={"actuator": LinkLaw(**late, acknowledged=False)})  # type: ignore[arg-type]
    policy = excess(plant, cost, theta=0.3, network=network)
    assert policy.network.loss("actuator") == 0.0
    assert policy.network.links["actuator"].wait == Wait(1)
    loop = close(plant, policy, network, cost)
    assert loop.violated_assumptions == ("the network is not the one of the design",)


def test_what_does_not_model_a_constant_delay_refuses_it_by_name() -> None:
    """The stage cost of outputs and inputs of the same step, and gains for inputs that are zero in silence."""
    network = Network(links={"actuator": LinkLaw(delay=2)})  # type: ignore[arg-type]
    plant, cost = Plant([[0.9]], [[1.0]], [[0.1]]), Cost([[1.0]], [[1.0]])
    with pytest.raises(ProblemError, match=r"^a link has a constant delay, with which the policy kind lossy-lqg would"):
        lossy_lqg(plant, cost, price=0.1, network=network)
    with pytest.raises(ProblemError, match=r"^rule = 'relative', but links delay their packets \(input 1 2 steps late"):
        distributed(plant, cost, theta=0.1, guarantee="every path", rule="relative", network=network)


@pytest.mark.parametrize("delay", [0, 3])
def test_a_slow_disturbance_leaves_the_delays_of_a_plant(delay: int) -> None:
    """With a tiny one, the loop of a given controller costs what it costs without."""
    plant, cost = Plant([[0.9]], [[1.0]], [[0.1]], C=[[1.0]], V=[[0.1]]), Cost([[1.0]], [[1.0]])
    network = Network(links={"actuator": LinkLaw(delay=delay)})  # type: ignore[arg-type]
    found = [
        distributed(
            plant, cost, theta=0.1, network=network,
            controller=Controller([[0.5]], [[1.0]], [[-0.1]], [[-0.1]], disturbance=Disturbance(50.0, size)),
        ).cost_all_time
        for size in (1e-9, 0.0)
    ]  # fmt: skip
    assert found[0] == pytest.approx(found[1], rel=1e-9)


def test_packets_that_are_too_late_for_the_buffer_are_told_as_lost() -> None:
    """By the text of a network and of a link, and in the digest of a problem."""
    text = """
        plant = {A = [[0.9]], B = [[1.0]], C = [[1.0]], W = [[0.1]], V = [[0.1]], dt = 1.0}
        cost = {Q = [[1.0]], R = [[1.0]]}
        network = {actuator_delay = [0.7, 0.2, 0.1], actuator_buffer = 1}
        policy = {kind = "excess", theta = 0.1}
    """
    problem = parse(tomllib.loads(text), "late.toml")
    assert "actuator drops 10 %" in problem.network.short()
    assert problem.network.links["actuator"].short().startswith("udp, drops 10 %")
    assert longest_silence(problem.network.with_laws({"max_interval": 3}), "actuator") is None
    changed = problem.changed({"network.actuator_delay": [0.5, 0.2, 0.3]})
    assert fingerprint(changed) != fingerprint(problem)


@pytest.mark.parametrize("fed", ["", "D = [[0.4]],"])
def test_weights_as_the_controller_are_those_of_the_late_loop(fed: str) -> None:
    """The output and the input that acts contribute 1 each."""
    text = f"""
        plant = {{A = [[0.9]], B = [[1.0]], C = [[1.0]], {fed} W = [[0.1]], V = [[0.1]], dt = 1.0}}
        cost = {{weights = "as the controller"}}
        network = {{actuator_delay = 2, sensor_delay = 1}}
        controller = {{D = [[0.2]]}}
        policy = {{kind = "all-time"}}
    """
    policy = parse(tomllib.loads(text), "late.toml").design()
    assert policy.cost_all_time == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize("delay", [1, 3])
def test_over_a_horizon_the_last_commands_of_a_late_input_act_no_more(delay: int) -> None:
    """The cost of every sample is that of the recursion with a chain of earlier commands, whose last gains are 0."""
    steps, plant = 6, Plant([[1.1]], [[1.0]], [[0.1]], mean=[2.0], covariance=[[0.3]])
    cost = Cost([[1.0]], [[0.5]], horizon=steps, terminal=[[2.0]])
    network = Network(links={"actuator": LinkLaw(delay=delay)})  # type: ignore[arg-type]
    A, B = np.diag(np.ones(delay), 1), np.eye(delay + 1)[:, -1:]
    A[0, 0] = 1.1
    K, Q = np.diag([2.0, *np.zeros(delay)]), np.diag([1.0, 0.5, *np.zeros(delay - 1)])
    wanted = 0.0
    for _ in range(steps):
        wanted += 0.1 * K[0, 0]
        K = Q + A.T @ (K - K @ B @ np.linalg.pinv(B.T @ K @ B) @ B.T @ K) @ A
    policy = excess(plant, cost, theta=0.1, network=network)
    assert policy.cost_all_time == pytest.approx(wanted + K[0, 0] * (2.0**2 + 0.3), rel=1e-12)
    with pytest.raises(ProblemError, match=f"has {delay} steps?, and an input acts {delay} steps? after its command"):
        excess(plant, Cost([[1.0]], [[0.5]], horizon=delay), theta=0.1, network=network)
