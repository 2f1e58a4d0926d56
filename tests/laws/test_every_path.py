"""Bounds on every path, of any linear controller, any noise and any number of nodes: all told again in NumPy.

The loop of the library runs on noise that is given. ``responses`` computes the same path with every sample, and the
response to the errors of each node in the coordinates of plant and controller, without the library.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import sqrt
from typing import Any

import numpy as np
import pytest
from counts import few
from drawn import law, rows
from hypothesis import strategies as st
from measured import average
from responses import Told, Whole, lqg_by_hand, running, stage_of, told
from scipy.linalg import expm, solve_discrete_are
from silences import (
    NONE,
    ROUNDED,
    Case,
    Drawn,
    Mode,
    Path,
    Rule,
    case_of,
    drawn,
    policy_of,
    signals,
    the_certificate_holds,
    the_decisions_are_those_of_the_rule,
    the_promise_holds,
)

from taciturn import (
    PID,
    Burst,
    ContinuousPlant,
    Controller,
    Cost,
    Loop,
    Network,
    Nodes,
    Plant,
    ProblemError,
    UnstableError,
    close,
    design,
    simulate,
)
from taciturn.model.link import LinkLaw
from taciturn.model.network import NodeRole

SEEDS = st.integers(0, 2**32 - 1)


@law(4, 300, seed=SEEDS)
def test_no_path_costs_more_than_its_promise_or_its_certificate(seed: int) -> None:
    """Wrong observers, integrals, states that nothing reads, unstable plants, and noise of many kinds."""
    path = Path.of(case_of(drawn(seed)), seed, 60)
    the_certificate_holds(path)
    the_decisions_are_those_of_the_rule(path)
    the_promise_holds(path)


@law(2, 100, seed=SEEDS)
def test_a_relative_bank_needs_no_number_for_the_noise(seed: int) -> None:
    """A promise on the measured cost, whose incomes are parts of the cost that each node measures itself."""
    path = Path.of(case_of(drawn(seed, "relative")), seed, 60)
    the_certificate_holds(path)
    the_decisions_are_those_of_the_rule(path)
    the_promise_holds(path)


@law(2, 100, seed=SEEDS)
def test_lqg_keeps_the_same_bounds(seed: int) -> None:
    """LQG by scipy's solver, whose filter is told which inputs are applied; measured states included."""
    path = Path.of(case_of(drawn(seed, lqg=True)), seed, 60)
    the_certificate_holds(path)
    the_decisions_are_those_of_the_rule(path)
    the_promise_holds(path)


def lossy(network: Network, rng: np.random.Generator, told: bool = True) -> Network:
    """Return a network of which the first link, and perhaps others, drop packets."""
    links = dict(network.links)
    for i, link in enumerate(links):
        if i == 0 or rng.integers(2):
            links[link] = LinkLaw(loss=float(rng.uniform(0.2, 0.5)), acknowledged=told)
            if rng.integers(3) == 0:
                burst = Burst(to_bad=0.2, to_good=0.4, loss_good=0.05, loss_bad=0.9)
                links[link] = LinkLaw(burst=burst, acknowledged=told)
    return replace(network, links=links)


@law(2, 100, seed=SEEDS)
def test_acknowledged_losses_keep_the_certificate_and_no_promise(seed: int) -> None:
    """Silence that dropouts force counts like any other, and the sums of the nodes contain it."""
    given, rng = drawn(seed), np.random.default_rng(seed)
    given = replace(given, network=lossy(given.network, rng), joint=None)
    path = Path.of(case_of(given), seed, 80)
    policy = path.case.loop.policy
    assert policy.guarantee is None
    assert any("no guarantee in advance" in note for note in policy.notes)
    the_certificate_holds(path)
    assert np.any([path.run.sent[link] & ~path.run.arrived[link] for link in path.run.sent])


@law(2, 20, seed=SEEDS)
def test_losses_without_acknowledgement_leave_neither_promise_nor_certificate(seed: int) -> None:
    """One link that does not tell is enough."""
    given, rng = drawn(seed), np.random.default_rng(seed)
    given = replace(given, network=lossy(given.network, rng, told=False), joint=None)
    policy = case_of(given).loop.policy
    assert (policy.guarantee, policy.theory.silence) == (None, {})
    assert any("neither a guarantee nor the certificate" in note for note in policy.notes)


def with_law(network: Network, **law: int) -> Network:
    """Return a network whose links all have some properties."""
    return replace(network, links={link: replace(one, **law) for link, one in network.links.items()})


@law(2, 100, seed=SEEDS)
def test_a_longest_interval_keeps_the_promise_and_a_shortest_one_withdraws_it(seed: int) -> None:
    """Packets that a limit forces only help; silence that a limit forces is certified all the same."""
    given = drawn(seed)
    longest, shortest = (
        Path.of(case_of(replace(given, network=with_law(given.network, **{name: 3}))), seed, 60)
        for name in ("max_interval", "min_interval")
    )
    for path in (longest, shortest):
        the_certificate_holds(path)
    windows = [
        [np.lib.stride_tricks.sliding_window_view(sent, 3, axis=0).sum(axis=-1) for sent in path.run.sent.values()]
        for path in (longest, shortest)
    ]
    assert min(window.min() for window in windows[0]) >= 1
    assert max(window.max() for window in windows[1]) <= 1
    the_promise_holds(longest)
    assert shortest.case.loop.policy.guarantee is None


@law(2, 100, seed=SEEDS)
def test_over_a_horizon_the_weight_of_the_final_state_counts(seed: int) -> None:
    """The cost of a run to any time, with a weight of its last state that may exceed all that stages still cost."""
    given, rng, ticks = drawn(seed), np.random.default_rng(seed), 40
    cost, n = given.cost, given.plant.states
    root = rng.standard_normal((n, n)) * rng.choice([0.0, 0.3, 30.0])
    ending = Cost(cost.Q, cost.R, cost.N, horizon=ticks, terminal=root @ root.T)
    case = case_of(replace(given, cost=ending))
    path, guarantee = Path.of(case, seed, ticks), case.loop.policy.guarantee
    assert guarantee is not None
    base, added = case.loop.policy.cost_all_time, sum(sqrt(limit * ticks) for limit in case.limits.values())
    assert guarantee.cost == pytest.approx((sqrt(base) + added) ** 2, rel=1e-7)
    ends = {"loop": path.run.end[:, :n], "base": path.every_sample[2][:, :n]}
    costs = {"loop": path.cost[-1], "base": path.base_cost[-1]}
    roots = {name: np.sqrt(costs[name] + ((end @ root) ** 2).sum(axis=1)) for name, end in ends.items()}
    sums = {links: running(one) for links, one in path.run.added.items()}
    for links, one in path.responses.items():
        last = ((one.q[1:, :, :n] @ root) ** 2).sum(axis=-1)
        energy = running((one.output**2).sum(axis=-1)) + last
        room = ROUNDED * (one.size + sums[links])
        assert (energy <= sums[links] + 100 * room).all()
        silent = running(np.any([~path.run.sent[link] for link in links], axis=0))
        limit = case.limits[links] * (silent if case.rule == "threshold" else np.arange(1, ticks + 1)[:, None])
        assert (sums[links] <= limit * (1 + ROUNDED) + room).all()
    certified = roots["base"] + sum(np.sqrt(np.maximum(one[-1], 0.0)) for one in sums.values())
    assert (roots["loop"] <= certified * (1 + 1e-7)).all()
    assert (roots["loop"] <= (roots["base"] + added) * (1 + 1e-7)).all()


TANK = Plant([[1, 0.1], [0, 0.9]], [[0], [0.1]], np.diag([1e-4, 4e-4]), [[1.0, 0]], [[1e-3]], dt=0.1)
TANK_COST = Cost(np.diag([1.0, 0]), [[0.05]])
PID_OF_TANK = Controller([[1, 0], [0, 0.8]], [[0.1], [0.2]], [[-0.15, 2]], [[-3.2]], dt=0.1, disturbance=NONE)
J_BASE = 0.00272706026
PATHS = 100
INTERPOLATED = 0.015  # error of a rate that a table has interpolated between incomes with ratios of 2.6
WIRED = Network(
    nodes={
        "sensor": NodeRole(measures=True),
        "controller": NodeRole(controls=True),
        "actuator": NodeRole(applies=True, site="controller"),
    }
)


def ratio(above: np.ndarray, below: np.ndarray) -> tuple[float, float]:
    """Return the ratio of two means over paths, and its standard error."""
    value = float(above.mean() / below.mean())
    return value, float(np.std(above - value * below) / below.mean() / sqrt(len(above)))


def assert_close(found: tuple[float, float], table: float, digit: float) -> None:
    """Check a mean against a number of a table, made from as many paths, and rounded to a digit."""
    value, error = found
    assert abs(value - table) <= 4 * sqrt(2) * error + digit / 2


@dataclass(frozen=True, eq=False)
class Tank:
    """Means over paths of the tank with its PID controller."""

    loop: Loop
    run: Told
    base: np.ndarray  # (x, u) with every sample
    v: np.ndarray

    @staticmethod
    def of(steps: int, w: np.ndarray | float = 0.0, impulses: bool = False, **chosen: Any) -> Tank:
        """Run the tank for so many steps from rest, under a load or impulses, with the arguments of the design."""
        policy = design.distributed(TANK, TANK_COST, controller=PID_OF_TANK, **chosen)
        assert policy.cost_all_time == pytest.approx(J_BASE, rel=1e-9)
        loop, draws = close(TANK, policy), np.random.default_rng(steps)
        noise = draws.standard_normal((steps, PATHS, 2)) * [0.01, 0.02]
        if impulses:
            noise *= np.where(draws.random((steps, PATHS, 1)) < 0.01, 10.0, 0.1)
        noise[..., 1] += 0.1 * np.reshape(w, (-1, 1))
        v = draws.standard_normal((steps, PATHS, 1)) * sqrt(1e-3)
        run = told(loop, noise, v, fast=True)
        whole = Whole(TANK.A, TANK.B, TANK.C, PID_OF_TANK, stage_of(TANK_COST))
        return Tank(loop, run, whole.path(np.zeros((PATHS, 4)), noise, v)[0], v)

    @property
    def rates(self) -> list[tuple[float, float]]:
        """The rate of each link with its standard error."""
        means = [sent.mean(axis=0) for sent in self.run.sent.values()]
        return [(float(one.mean()), float(one.std() / sqrt(PATHS))) for one in means]

    @cached_property
    def costs(self) -> tuple[np.ndarray, np.ndarray]:
        """The cost per step of each path, and that of sending every sample."""
        every = self.base[..., 0], self.base[..., 2]
        return tuple(  # type: ignore[return-value]
            (x**2 + 0.05 * u**2).mean(axis=0) for x, u in ((self.run.x[..., 0], self.run.u[..., 0]), every)
        )

    @cached_property
    def measured(self) -> tuple[np.ndarray, np.ndarray]:
        """The same for the cost of the measured output."""
        y = self.base[..., 0] + self.v[..., 0]
        return tuple(  # type: ignore[return-value]
            (x**2 + 0.05 * u**2).mean(axis=0)
            for x, u in ((self.run.y[..., 0], self.run.u[..., 0]), (y, self.base[..., 2]))
        )

    def bound(self, added: list[np.ndarray]) -> tuple[float, float]:
        """Return the mean bound for what nodes add per step, over the mean cost of every sample, with its error."""
        below = self.costs[1]
        bounds = (np.sqrt(below) + sum(np.sqrt(np.maximum(one, 0.0)) for one in added)) ** 2
        assert (self.costs[0] <= bounds * (1 + ROUNDED)).all()
        return ratio(bounds, below)


THRESHOLDS: dict[tuple[float, ...], tuple[tuple[float, ...], float, float, float]] = {
    (0.03,): ((0.809,), 1.0005, 1.157, 1.089),
    (0.3,): ((0.450,), 1.0155, 1.977, 1.499),
    (0.01, 0.01): ((0.889, 0.891), 1.0002, 1.137, 1.076),
    (0.03, 0.03): ((0.809, 0.801), 1.0009, 1.329, 1.167),
    (0.1, 0.1): ((0.660, 0.646), 1.0063, 1.885, 1.394),
}
"""Thresholds of the links as shares of J_base: rates, J/J_base, bound at the rates, and certificate."""


def thresholds(shares: tuple[float, ...]) -> dict[str, Any]:
    """Return the arguments for the thresholds of the links, as shares of J_base."""
    roots = np.sqrt(shares)
    network = Network() if len(shares) == 2 else WIRED
    weights: dict[str, float] = dict(zip(network.links, roots.tolist(), strict=True))
    return {"rule": "threshold", "delta": J_BASE * roots.sum() ** 2, "shares": weights, "network": network}


def assert_thresholds(
    tank: Tank, shares: tuple[float, ...], row: tuple[tuple[float, ...], float, float, float]
) -> None:
    """Check a row of the table of thresholds."""
    rates, cost, bound, certified = row
    for rate, expected in zip(tank.rates, rates, strict=True):
        assert_close(rate, expected, 1e-3)
    assert_close(ratio(*tank.costs), cost, 1e-4)
    silent = [1 - sent.mean(axis=0) for sent in tank.run.sent.values()]
    limits = [J_BASE * share * one for share, one in zip(shares, silent, strict=True)]
    assert_close(tank.bound(limits), bound, 1e-3)
    assert_close(tank.bound([one.mean(axis=0) for one in tank.run.added.values()]), certified, 1e-3)


@pytest.mark.parametrize("shares", few(THRESHOLDS, 1, start=4))
def test_thresholds_of_the_tank(shares: tuple[float, ...]) -> None:
    """Rates, costs, bounds and certificates of another implementation."""
    assert_thresholds(Tank.of(4000, **thresholds(shares)), shares, THRESHOLDS[shares])


@pytest.mark.evidence
def test_thresholds_of_the_tank_under_impulses() -> None:
    """1 % of the steps have ten times the noise, and the others a tenth."""
    row = ((0.805, 0.798), 1.0037, 1.332, 1.162)
    assert_thresholds(Tank.of(4000, impulses=True, **thresholds((0.03, 0.03))), (0.03, 0.03), row)


@pytest.mark.evidence
def test_thresholds_of_the_tank_under_a_slow_load() -> None:
    """A load three times as large as the noise, to which neither the bound nor the certificate refers."""
    tank = Tank.of(6000, 0.3 * np.sin(np.arange(6000) / 200), **thresholds((0.3, 0.3)))
    assert tank.costs[1].mean() / J_BASE == pytest.approx(3.51, abs=0.02)
    assert_thresholds(tank, (0.3, 0.3), ((0.450, 0.434), 1.0118, 2.062, 1.449))


BANKS = {
    (1.33, 1.0): (0.716, 1.004),
    (1.33, 0.1): (0.708, 1.003),
    (1.5, 1.0): (0.633, 1.010),
    (1.5, 0.1): (0.623, 1.009),
    (1.885, 1.0): (0.496, 1.028),
    (1.885, 0.1): (0.482, 1.026),
    (2.5, 1.0): (0.351, 1.076),
    (2.5, 0.1): (0.337, 1.079),
}
"""By promise and share that is spent: mean rate of both links, and J/J_base."""


@pytest.mark.parametrize(("promise", "spend"), rows(BANKS, 1, start=3))
def test_banks_of_the_tank(promise: float, spend: float) -> None:
    """A bank sends less for the same promise than a threshold, at the cost of another implementation."""
    rate, cost = BANKS[promise, spend]
    tank = Tank.of(3000, theta=promise - 1, spend=spend)
    guarantee = tank.loop.policy.guarantee
    assert guarantee is not None
    assert guarantee.cost == pytest.approx(promise * J_BASE, rel=1e-9)
    (one, error), (other, second) = tank.rates
    assert_close(((one + other) / 2, (error + second) / 2), rate, 1e-3)
    assert_close(ratio(*tank.costs), cost, 1e-3)


def test_averages_know_what_silence_adds() -> None:
    """A bank spends what it receives, and no more: in the mean over a long run, the certificate is the promise."""
    policy = design.distributed(TANK, TANK_COST, theta=0.5, controller=PID_OF_TANK)
    found = average(close(TANK, policy), seed=1, steps=400_000)
    income = (sqrt(1.5) - 1) ** 2 * J_BASE / 4
    for one in found.silence.values():
        assert one.value <= income + 4 * one.standard_error
        assert one.value >= 0.95 * income - 4 * one.standard_error
    assert (
        abs(sum(rate.value for rate in found.rates.values()) / 2 - 0.623) <= 0.006
    )  # the table's runs start from rest


def test_nodes_at_a_plant_of_numpy_do_what_the_loop_does() -> None:
    """The same inputs, packets and cost of silence as those of the loop, for the same noise."""
    policy = design.distributed(TANK, TANK_COST, kappa=0.2, controller=PID_OF_TANK)
    draws, x = np.random.default_rng(4), np.zeros(2)
    w, v = draws.standard_normal((80, 1, 2)) * [0.01, 0.02], draws.standard_normal((80, 1, 1)) * sqrt(1e-3)
    run, nodes = told(close(TANK, policy), w, v), Nodes(policy)
    for k in range(80):
        u = nodes.step(TANK.C @ x + v[k, 0])
        assert u == pytest.approx(run.u[k, 0], rel=1e-9, abs=1e-12)
        assert nodes.sent == {link: bool(sent[k, 0]) for link, sent in run.sent.items()}
        x = TANK.A @ x + TANK.B @ u + w[k, 0]


RELATIVE = {0.0: (0.676, 0.686, 1.003), 0.3: (0.355, 0.580, 0.981), 1.0: (0.203, 0.559, 1.032)}
"""By load: rates, and the cost of the measured output relative to that of every sample, with κ = 0.1 for each link."""


@pytest.mark.parametrize("load", few(RELATIVE, 1, start=1))
def test_relative_banks_of_the_tank(load: float) -> None:
    """Under a load, of which the design knows nothing, the nodes send less and keep the promise."""
    sensor, actuator, cost = RELATIVE[load]
    tank = Tank.of(6000, load * np.sin(2 * np.pi * np.arange(6000) / 100), kappa=sqrt(0.02))
    for rate, expected in zip(tank.rates, (sensor, actuator), strict=True):
        assert_close(rate, expected, 1e-3)
    assert_close(ratio(*tank.measured), cost, 1e-3)
    assert (tank.measured[0] * (1 - sqrt(0.02)) ** 2 <= tank.measured[1]).all()


def two_outputs_at_one_node() -> tuple[Plant, Cost, Controller, Network]:
    """Return a loop whose two outputs one node sends to an observer: the node controls, and the rest is its plant.

    The inputs of this plant are the outputs that the observer uses, and the controller passes on what it measures.
    """
    A, B, C = np.array([[1, 0.1], [-0.05, 0.95]]), np.array([[0], [0.1]]), np.eye(2)
    K = solve_discrete_are(A, B, np.eye(2), 0.1 * np.eye(1))
    L = -np.linalg.solve(0.1 * np.eye(1) + B.T @ K @ B, B.T @ K @ A)
    W, V = np.diag([1e-3, 4e-3]), 0.03 * np.eye(2)
    P = solve_discrete_are(A.T, C.T, W, V)
    gain = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
    zero = np.zeros((2, 2))
    whole = np.block([[A, B @ L], [zero, A + B @ L - gain @ C]])
    plant = Plant(whole, np.vstack([zero, gain]), np.block([[W, zero], [zero, zero]]), np.hstack([C, zero]), V)
    cost = Cost(np.block([[np.eye(2), zero], [zero, 0.1 * L.T @ L]]), zero)
    passes = Controller(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), np.eye(2), disturbance=NONE)
    nodes = {
        "sensor": NodeRole(measures=True, controls=True),
        "first": NodeRole(applies=(0,)),
        "second": NodeRole(applies=(1,)),
    }
    return plant, cost, passes, Network(nodes=nodes)


JOINT: dict[str, tuple[dict[str, Any], float, float | None]] = {
    # thresholds for which the bound at the rate of the table is 1.5
    "apart": ({"rule": "threshold", "joint": False, "delta": 4 * (sqrt(1.5) - 1) ** 2 / 4 / (1 - 0.616)}, 0.616, None),
    "together": ({"rule": "threshold", "joint": True, "delta": (sqrt(1.5) - 1) ** 2 / (1 - 0.455)}, 0.455, None),
    # a share of 0.1 for each packet
    "bank": ({"rule": "bank", "joint": True, "theta": 0.5, "spend": 0.2}, 0.217, 1.05),
}
"""How two links of one node decide, with thresholds as shares of J_base: mean rate and J/J_base at the promise 1.5."""


@pytest.mark.parametrize("name", few(JOINT, 1, start=2))
def test_one_node_with_two_links_decides_best_on_both_together(name: str) -> None:
    """Rates of another implementation, interpolated between seven thresholds or incomes."""
    chosen, expected, cost = JOINT[name]
    plant, weights, passes, network = two_outputs_at_one_node()
    whole = Whole(plant.A, plant.B, plant.C, passes, stage_of(weights))
    base = whole.average(plant.W, plant.V)
    chosen = {**chosen, "delta": chosen["delta"] * base} if "delta" in chosen else chosen
    loop = close(plant, design.distributed(plant, weights, controller=passes, network=network, **chosen))
    draws, steps = np.random.default_rng(3), 3000
    w = draws.standard_normal((steps, PATHS, 4)) * np.sqrt([1e-3, 4e-3, 0.0, 0.0])
    v = draws.standard_normal((steps, PATHS, 2)) * sqrt(0.03)
    run = told(loop, w, v, fast=True)
    rate = np.mean([sent.mean(axis=0) for sent in run.sent.values()], axis=0)
    assert_close((float(rate.mean()), float(rate.std() / sqrt(PATHS))), expected, 2 * INTERPOLATED)
    above = np.sum((np.concatenate([run.x, run.u], axis=-1) @ whole.root.T) ** 2, axis=(0, 2))
    below = np.sum(whole.path(np.zeros((PATHS, 4)), w, v)[1] ** 2, axis=(0, 2))
    if cost is not None:
        assert_close(ratio(above, below), cost, 1e-2)
    added = sum(np.sqrt(np.maximum(one.sum(axis=0), 0)) for one in run.added.values())
    assert (np.sqrt(above) <= np.sqrt(below) + added + ROUNDED * np.sqrt(above)).all()


def sampled_by_hand(
    plant: ContinuousPlant, cost: Cost, h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Return A, B, W, the weight of (x, u) and the noise cost c of a period, by quadrature over exponentials."""
    n, m = plant.B.shape
    whole = np.block([[plant.A, plant.B], [np.zeros((m, n + m))]])
    points, weights = np.polynomial.legendre.leggauss(30)
    times, weights = h * (points + 1) / 2, h * weights / 2
    moved = [expm(whole * t) for t in times]
    stage = sum(w * one.T @ stage_of(cost) @ one for w, one in zip(weights, moved, strict=True))
    noise = [one[:n, :n] @ plant.W @ one[:n, :n].T for one in moved]
    # noise of the time h − t has acted for t, so c is the integral of (h − t) tr(Q e^{At} W e^{A't})
    inter = sum(w * (h - t) * np.sum(cost.Q * one) for w, t, one in zip(weights, times, noise, strict=True))
    end = expm(whole * h)
    W = sum(w * one for w, one in zip(weights, noise, strict=True))
    return end[:n, :n], end[:n, n:], np.asarray(W), np.asarray(stage), float(inter)


@pytest.mark.parametrize("lqg", [False, True])
def test_a_continuous_plant_keeps_the_bounds_of_its_sampled_stage(lqg: bool) -> None:
    """Sampled by quadrature; the noise between samples is on both sides of the bound, without a root."""
    A, B, C = np.array([[0.0, 1.0], [0.8, -0.4]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    plant = ContinuousPlant(A, B, np.diag([0.0, 0.02]), C=C, V=np.array([[0.001]]))
    cost, h = Cost(np.diag([1.0, 0.2]), [[0.1]], [[0.05], [0.0]]), 0.2
    kept = None if lqg else PID(4.0, 0.5, 2.0, 0.5, disturbance=NONE)
    Ad, Bd, W, stage, inter = sampled_by_hand(plant, cost, h)
    step = Plant(Ad, Bd, W, C, plant.V, dt=h)
    hand = lqg_by_hand(step, Cost(stage[:2, :2], stage[2:, 2:], stage[:2, 2:])) if kept is None else kept.at(h, 1, 1)
    whole = Whole(Ad, Bd, C, hand, stage)
    base = whole.average(W, plant.V)
    policy = design.distributed(plant, cost, theta=0.5, period=h, controller=kept, guarantee="every path")
    assert policy.cost_all_time == pytest.approx((base + inter) / h, rel=1e-7)
    assert policy.guarantee is not None
    assert policy.guarantee.cost == pytest.approx((1.5 * base + inter) / h, rel=1e-7)
    loop = close(plant, policy)
    limit = (sqrt(1.5) - 1) ** 2 * base / 4
    case = Case(loop, hand, "bank", {("sensor",): limit, ("actuator",): limit}, 0.1, {"sensor": 1.0, "actuator": 1.0})
    np.testing.assert_allclose(case.stage, stage, rtol=1e-9, atol=1e-12)
    path = Path.of(case, 5, 200)
    the_certificate_holds(path)
    the_decisions_are_those_of_the_rule(path)
    steps = np.arange(1, 201)[:, None]
    assert (np.sqrt(path.cost) <= np.sqrt(path.base_cost) + 2 * np.sqrt(limit * steps)).all()
    thresholds = design.distributed(
        plant, cost, delta=0.04, period=h, controller=kept, guarantee="every path", rule="threshold"
    )
    assert thresholds.guarantee is not None
    assert thresholds.guarantee.cost == pytest.approx(((sqrt(base) + 0.2) ** 2 + inter) / h, rel=1e-7)


@pytest.mark.parametrize("always", [False, True])
def test_a_set_point_is_reached_at_the_promised_cost(always: bool) -> None:
    """A PID controller by hand in the units of the plant, from rest to a set-point that needs an input."""
    plant = Plant([[0.98, 0.1], [0, 0.9]], [[0], [0.1]], np.diag([1e-4, 4e-4]), [[1.0, 0]], [[1e-3]], dt=0.1)
    kept = PID(1.2, 0.15, 1.0, 0.5, setpoint=2.0, disturbance=NONE)
    law = LinkLaw(max_interval=1) if always else LinkLaw()
    network = Network(links={"sensor": law, "actuator": law})
    policy = design.distributed(plant, TANK_COST, theta=0.5, controller=kept, network=network)
    ticks, draws = 300, np.random.default_rng(1)
    w = draws.standard_normal((ticks, 1, 2)) * [0.01, 0.02]
    v = draws.standard_normal((ticks, 1, 1)) * sqrt(1e-3)
    run = told(close(plant, policy), w, v)
    x, integral, slow = np.zeros(2), 0.0, 0.0
    states, inputs = [], []
    for k in range(ticks):
        y = x[0] + v[k, 0, 0]
        u = 1.2 * (2.0 - y) + 0.15 * integral - (y - slow) / 0.5
        states.append(x)
        inputs.append(u)
        integral, slow = integral + 0.1 * (2.0 - y), slow + 0.2 * (y - slow)
        x = plant.A @ x + plant.B[:, 0] * u + w[k, 0]
    rest = np.array([2.0, 0.4, 0.4])  # x and u
    base = np.column_stack([states, inputs]) - rest
    found = np.concatenate([run.x, run.u], axis=-1)[:, 0]
    if always:
        np.testing.assert_allclose(found, base, rtol=0, atol=1e-9)
    else:
        assert np.mean([sent.mean() for sent in run.sent.values()]) < 0.9
    cost, every = (running((one[:, [0, 2]] ** 2) @ [1.0, 0.05]) for one in (found, base))
    added = sum(np.sqrt(np.maximum(running(one[:, 0]), 0.0)) for one in run.added.values())
    most = (sqrt(1.5) - 1) * np.sqrt(policy.cost_all_time * np.arange(1, ticks + 1))
    assert (added <= most * (1 + ROUNDED) + 1e-12).all()
    assert (np.sqrt(cost) <= np.sqrt(every) + added + 1e-9).all()


@pytest.mark.parametrize("rule", ["bank", "relative", "threshold"])
@pytest.mark.parametrize("mode", ["hold", "model"])
def test_sensors_predict_the_loop_of_a_controller_that_integrates(rule: Rule, mode: Mode) -> None:
    """The integral of the controller is known to whoever knows the outputs, and no noise moves it."""
    policy = design.distributed(
        TANK, TANK_COST, theta=0.5, controller=PID_OF_TANK, rule=rule, prediction="model", actuation=mode
    )
    loop = close(TANK, policy)
    limits = policy.theory.silence
    case = Case(loop, PID_OF_TANK, rule, dict.fromkeys(limits, 0.0), 0.1, {})
    the_certificate_holds(Path.of(case, 3, 100))


def test_a_sensor_finds_out_what_the_controller_has_added_up_in_silence() -> None:
    """Otherwise its copy of the integral drifts away, and in the end it sends at every step."""
    A, B, C = np.array([[-0.6775, -0.3456], [0.7069, 1.0099]]), [[0.4685], [-0.952]], [[0.8849, -1.0358]]
    plant = Plant(A, B, 0.2 * np.eye(2), C, [[0.1]], dt=1.0)
    kept = PID(0.25, 0.03, disturbance=NONE)
    rates = {}
    for mode in ("hold", "model"):
        policy = design.distributed(plant, Cost(np.eye(2), [[0.5]]), theta=0.5, controller=kept, prediction=mode)
        draws = np.random.default_rng(1)
        w, v = sqrt(0.2) * draws.standard_normal((20_000, 8, 2)), sqrt(0.1) * draws.standard_normal((20_000, 8, 1))
        rates[mode] = told(close(plant, policy), w, v, fast=True).sent["sensor"]
    each = rates["model"][10_000:].mean(axis=0) - rates["hold"][10_000:].mean(axis=0)
    assert each.mean() < -4 * each.std(ddof=1) / sqrt(8)


@pytest.mark.parametrize("mode", few([1.0, -1.0], 2))
def test_a_state_that_nothing_reads_changes_neither_cost_nor_promise(mode: float) -> None:
    """It counts, and never decays, in whatever coordinates the states of the controller are."""
    for seed in range(12):
        draws = np.random.default_rng(seed)
        turned = draws.standard_normal((3, 3))
        back = np.linalg.inv(turned)
        own, reads = np.diag([1, 0.8, mode]), np.array([[0.1], [0.2], [0.3]])
        kept = Controller(
            turned @ own @ back, turned @ reads, np.array([[-0.15, 2, 0]]) @ back, [[-3.2]], dt=0.1, disturbance=NONE
        )
        policy = design.distributed(TANK, TANK_COST, theta=0.5, controller=kept)
        assert policy.cost_all_time == pytest.approx(J_BASE, rel=1e-6)
        assert policy.guarantee is not None
        assert policy.guarantee.cost == pytest.approx(1.5 * J_BASE, rel=1e-6)


def test_inputs_that_the_cost_does_not_tell_apart_need_no_lqg() -> None:
    """The comparison with LQG is left out where the weights do not determine LQG."""
    A, B, C = np.array([[0.5, 0.1], [0.0, 0.3]]), np.array([[1.0, 1.0], [0.2, 1.0]]), np.array([[1.0, 0.0]])
    plant, row = Plant(A, B, np.eye(2), C, [[0.1]]), np.array([[1.0, 0.3]])
    cost = Cost(row.T @ row, np.zeros((2, 2)))
    gains = Controller(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((2, 0)), [[-0.1], [-0.1]])
    policy = design.distributed(plant, cost, theta=0.5, controller=gains)
    base = Whole(A, B, C, gains, stage_of(cost)).average(plant.W, plant.V)
    assert policy.cost_all_time == pytest.approx(base, rel=1e-9)
    assert policy.guarantee is not None
    assert policy.guarantee.cost == pytest.approx(1.5 * base, rel=1e-9)


PLAIN = {"controller": PID_OF_TANK, "theta": 0.5}
LOSSY = Network(links={"actuator": LinkLaw(loss=0.1, acknowledged=True)})
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "no amount": ({"theta": None}, "neither delta nor theta is given"),
    "two amounts": ({"delta": 0.1}, "are both given"),
    "kappa with another rule": ({"theta": None, "kappa": 0.1, "rule": "bank"}, "kappa is given with rule = 'bank'"),
    "kappa and theta": ({"kappa": 0.1}, "both or neither of the parameters kappa and theta"),
    "kappa of 1": ({"theta": None, "kappa": 1.0}, "kappa is 1"),
    "kappa below 0": ({"theta": None, "kappa": -0.1}, "kappa is -0.1"),
    "delta of a relative bank": (
        {"theta": None, "delta": 0.1, "rule": "relative"},
        "both or neither of the parameters kappa and theta",
    ),
    "theta below 0": ({"theta": -0.1}, "theta is -0.1"),
    "spend of 0": ({"spend": 0.0}, "spend = 0"),
    "spend above 1": ({"spend": 1.5}, "spend is 1.5"),
    "spend of a threshold": ({"spend": 0.5, "rule": "threshold"}, "spend = 0.5 is given with rule = 'threshold'"),
    "an unknown rule": ({"rule": "loan"}, "rule is 'loan'"),
    "an unknown guarantee": ({"guarantee": "always"}, "guarantee is 'always'"),
    "the average of a controller": ({"guarantee": "average"}, "controller is given, but the guarantee is a bound on"),
    "no share": ({"shares": {"sensor": 0.0, "actuator": 0.0}}, "shares = 0 for all links"),
    "a share of another link": ({"shares": {"valve": 1.0}}, "valve"),
    "a discount": ({"cost": Cost(np.diag([1.0, 0]), [[0.05]], discount=0.9)}, "discount is 0.9"),
    "lqg over a horizon": ({"cost": Cost(np.diag([1.0, 0]), [[0.05]], horizon=9), "controller": None}, "horizon"),
    "limits of inputs": ({"plant": (1.0, None)}, "plant.input_limit is given"),
    "limits of changes": ({"plant": (None, 1.0)}, "plant.input_rate is given"),
    "a cost of states": (
        {"cost": Cost(np.eye(2), [[0.05]]), "rule": "relative"},
        "weights states that the outputs do not measure",
    ),
    "a cross weight": (
        {"cost": Cost(np.diag([1.0, 0]), [[0.05]], [[0.1], [0.0]]), "rule": "relative"},
        "products of states and inputs",
    ),
    "sets over a link that drops packets": ({"joint": True, "network": LOSSY}, "actuator"),
    "no link": ({"network": Network(nodes={"all": NodeRole(measures=True, controls=True, applies=True)})}, "no link"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_bound_covers_is_refused_by_name(name: str) -> None:
    """In one sentence that states the argument."""
    changed, words = REFUSED[name]
    given = {**PLAIN, "guarantee": "every path", **changed}
    limit, rate = given.pop("plant", (None, None))
    plant = TANK
    if limit or rate:
        limits = None if limit is None else [limit]
        rates = None if rate is None else [rate]
        plant = Plant(TANK.A, TANK.B, TANK.W, TANK.C, TANK.V, 0.1, input_limit=limits, input_rate=rates)
    with pytest.raises(ProblemError, match=words):
        design.distributed(plant, given.pop("cost", TANK_COST), **given)


def test_a_relative_bank_is_refused_for_a_continuous_plant() -> None:
    """No node measures an integral."""
    plant = ContinuousPlant([[-1.0]], [[1.0]], [[1.0]], C=[[1.0]], V=[[0.1]])
    for given in ({"theta": 0.5, "rule": "relative"}, {"kappa": 0.1}):
        with pytest.raises(ProblemError, match="the plant is continuous"):
            design.distributed(plant, Cost([[1.0]], [[1.0]]), period=0.1, controller=[[0.5]], **given)


@pytest.mark.parametrize("name", ["rule", "spend", "kappa"])
def test_arguments_of_every_path_are_refused_for_the_average(name: str) -> None:
    """They would have no effect."""
    given: dict[str, Any] = {"rule": {"rule": "bank"}, "spend": {"spend": 0.1}, "kappa": {"kappa": 0.1}}[name]
    with pytest.raises(ProblemError, match=f"{name} is given, but the guarantee is a bound on the average"):
        design.distributed(TANK, TANK_COST, theta=0.5, **given)


def test_a_loop_whose_cost_sees_no_end_of_silence_is_refused() -> None:
    """Without the controller, the integral of the tank never forgets."""
    with pytest.raises(UnstableError, match=r"not stable|never ends"):
        design.distributed(TANK, TANK_COST, theta=0.5, controller=[[0.0]])


def in_other_units(given: Drawn, sizes: np.ndarray, kept: np.ndarray) -> Drawn:
    """Return the same problem with states of the plant and of the controller in other units."""
    plant, cost, own = given.plant, given.cost, given.kept
    assert own is not None
    to, back, c = np.diag(sizes), np.diag(1 / sizes), np.diag(kept)
    same = Plant(to @ plant.A @ back, to @ plant.B, to @ plant.W @ to, plant.C @ back, plant.V)
    weights = Cost(back @ cost.Q @ back, cost.R, back @ cost.N)
    away = np.diag(1 / kept)
    other = Controller(c @ own.A @ away, c @ own.B, own.C @ away, own.D, c @ own.E, disturbance=NONE)
    return replace(given, plant=same, cost=weights, kept=other)


@law(2, 60, seed=SEEDS)
def test_the_units_of_states_change_no_decision(seed: int) -> None:
    """Micrometres beside pascals: weights whose ratio is 1e20 count both."""
    given, draws = drawn(seed), np.random.default_rng(seed)
    assert given.kept is not None
    given = replace(given, prediction="hold", actuation="hold")
    sizes, kept = (np.exp2(draws.integers(-18, 19, size=size)) for size in (given.plant.states, len(given.kept.A)))
    ones = np.ones(len(sizes)), np.ones(len(kept))
    first, second = (policy_of(in_other_units(given, *units)) for units in (ones, (sizes, kept)))
    assert second.cost_all_time == pytest.approx(first.cost_all_time, rel=1e-6)
    w, v = signals(draws, 60, len(sizes), 1.0), signals(draws, 60, given.plant.outputs, 1.0)
    other = in_other_units(given, sizes, kept).plant
    one, two = told(close(given.plant, first), w, v), told(close(other, second), w * sizes, v)
    for link, sent in one.sent.items():
        assert (two.sent[link] == sent).all()
    for links, added in one.added.items():
        most = np.abs(running(added)).max()
        np.testing.assert_allclose(running(two.added[links]), running(added), rtol=0, atol=1e-6 * most)


def test_a_small_cross_weight_of_large_units_is_no_cost_of_outputs_and_inputs() -> None:
    """Whether the cost weighs states and inputs together does not depend on their units."""
    for size in (1.0, 1e-10):
        plant = Plant([[0.5]], [[size]], [[size**2]], [[1.0]], [[0.1 * size**2]])
        cost = Cost([[size**-2]], [[1.0]], [[0.5 / size]])
        with pytest.raises(ProblemError, match="products of states and inputs"):
            design.distributed(plant, cost, kappa=0.1, controller=[[0.1 / size]])


def test_a_small_weight_of_large_units_is_part_of_the_response() -> None:
    """Two tanks beside each other, the second in units of a hundred-millionth: neither is silent for ever."""
    sizes = np.array([1.0, 1e8])
    back = np.diag(1 / sizes)
    plant = Plant(0.9 * np.eye(2), np.diag(sizes), np.diag(sizes**2), np.eye(2), 0.01 * np.diag(sizes**2))
    kept = Controller(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), -0.5 * back, disturbance=NONE)
    nodes = {"first": NodeRole(measures=(0,)), "second": NodeRole(measures=(1,))}
    nodes |= {"plc": NodeRole(controls=True), "valves": NodeRole(applies=True, site="plc")}
    policy = design.distributed(
        plant, Cost(back @ back, 0.01 * np.eye(2)), theta=0.5, controller=kept, network=Network(nodes=nodes)
    )
    w, v = np.random.default_rng(1).standard_normal((400, 4, 2)) * sizes, np.zeros((400, 4, 2))
    run, whole = (
        told(close(plant, policy), w, v),
        Whole(plant.A, plant.B, plant.C, kept, np.diag([1, 1e-16, 0.01, 0.01])),
    )
    every = running((whole.path(run.start, w, v)[1] ** 2).sum(axis=-1))
    cost = running((np.concatenate([run.x, run.u], axis=-1) ** 2) @ np.array([1, 1e-16, 0.01, 0.01]))
    promised = (sqrt(1.5) - 1) * np.sqrt(policy.cost_all_time * np.arange(1, 401)[:, None])
    assert (np.sqrt(cost) <= np.sqrt(every) + promised).all()
    rates = [sent.mean() for sent in run.sent.values()]
    assert rates[1] == pytest.approx(rates[0], abs=0.08)
    assert sum(one.sum() for one in run.added[("second",)]) == pytest.approx(run.added[("first",)].sum(), rel=0.3)


@pytest.mark.parametrize("actuation", ["hold", "model"])
def test_a_sensor_that_predicts_does_not_drift_from_the_controller(actuation: Any) -> None:
    """Its copy of the controller hears every sample, and the controller does not: their integrals differ."""
    policy = design.distributed(
        TANK, TANK_COST, controller=PID_OF_TANK, theta=0.5, prediction="model", actuation=actuation
    )
    sends = simulate(close(TANK, policy), steps=60_000, seed=3).sends["sensor"]
    early, late = sends[2_000:10_000].mean(), sends[-8_000:].mean()
    assert abs(early - late) < 5 * np.sqrt(2 * early * (1 - early) / 800), (early, late)  # ten steps are correlated
