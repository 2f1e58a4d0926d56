"""Random loops that keep a bound on every path, and what must hold on each of their paths.

``drawn`` returns a problem, ``case_of`` its loop in the library with all limits by hand, and ``Path`` what this loop
does on noise of several kinds next to the same path with every sample. The functions that begin with ``the_`` check
the claims at every time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from math import sqrt
from typing import Literal

import numpy as np
import pytest
from hypothesis import assume
from responses import Links, Response, Told, Whole, entries_of, lqg_by_hand, running, stage_of, told
from scipy.linalg import solve_discrete_are
from systems import make_system, well_posed

from taciturn import Controller, Cost, Disturbance, Loop, Network, Plant, Policy, close, design
from taciturn.model.link import LinkLaw
from taciturn.model.network import NodeRole

Rule = Literal["bank", "relative", "threshold"]
Mode = Literal["hold", "model"]
NONE = Disturbance(deviation=0.0)
ROUNDED = 1e-9  # relative
RECORDED = np.array([0.0, 0.4, 0.9, 1.0, 0.2, -1.3, -1.1, -1.1, 2.5, 0.1, 0.0, 0.0, -0.7, 3.0, 1.5, -2.0, -2.2])


@dataclass(frozen=True, eq=False)
class Case:
    """A loop of the library, with what it was designed from."""

    loop: Loop
    controller: Controller  # as the loop with every sample
    rule: Rule
    limits: dict[Links, float]  # incomes, thresholds or κ
    spend: float
    shares: dict[str, float]

    @cached_property
    def whole(self) -> Whole:
        """The loop with every sample, by hand."""
        plant = self.loop.problem.plant
        return Whole(plant.A, plant.B, plant.C, self.controller, self.stage)

    @cached_property
    def stage(self) -> np.ndarray:
        """The weight of (x, u)."""
        problem = self.loop.problem
        return np.block([[problem.Q, problem.N], [problem.N.T, problem.R]])


def network_for(plant: Plant, rng: np.random.Generator, most: int = 4) -> Network:
    """Return a network in which one to four sensors and actuators, and perhaps nodes without a link, share a plant."""
    while True:
        nodes = {"plc": NodeRole(controls=True)}
        for role, size in (("measures", plant.outputs), ("applies", plant.inputs)):
            owner = rng.integers(3, size=size)
            wired = rng.choice(["none", "some", "all"], p=[0.5, 0.3, 0.2])
            for k in sorted(set(owner.tolist())):
                site = "plc" if wired == "all" or (wired == "some" and rng.integers(2)) else None
                nodes[f"{role}-{k}"] = NodeRole(**{role: tuple(np.flatnonzero(owner == k).tolist())}, site=site)
        links = [name for name, role in nodes.items() if not role.controls and role.site is None]
        if 1 <= len(links) <= most:
            return Network(nodes=nodes, links={name: LinkLaw(price=float(rng.uniform(0.5, 2.0))) for name in links})


def controller_for(plant: Plant, rng: np.random.Generator) -> Controller:
    """Return an observer with wrong gains, perhaps with integrals of outputs, and perhaps with a state nobody reads."""
    A, B, C = plant.A, plant.B, plant.C
    (n, m), p = B.shape, len(C)
    integrals = min(m, p, int(rng.integers(0, 3)))
    longer = np.block([[A, np.zeros((n, integrals))], [C[:integrals], np.eye(integrals)]])
    pushed = np.vstack([B, np.zeros((integrals, m))])
    assume(well_posed(longer, pushed))
    K = solve_discrete_are(longer, pushed, 0.1 * np.eye(n + integrals), np.eye(m))
    L = -np.linalg.solve(np.eye(m) + pushed.T @ K @ pushed, pushed.T @ K @ longer)
    P = solve_discrete_are(A.T, C.T, np.eye(n), np.eye(p))
    gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(p))
    left, Lx, wrong = np.eye(n) - gain @ C, L[:, :n], 1 + 0.1 * rng.standard_normal()
    own = np.block([[A @ left, np.zeros((n, integrals))], [np.zeros((integrals, n)), np.eye(integrals)]])
    reads, gains = np.vstack([A @ gain, np.eye(integrals, p)]), wrong * np.hstack([Lx @ left, L[:, n:]])
    through, hears = wrong * Lx @ gain, pushed
    if rng.integers(2):  # it computes with its own command, whether it is applied or not
        own, reads, hears = own + pushed @ gains, reads + pushed @ through, 0 * pushed
    if rng.integers(3) == 0:  # a state that nothing reads, and that does not decay
        k = len(own)
        hidden = np.pad(own, ((0, 1), (0, 1)))
        hidden[k, k] = rng.choice([1.0, -1.0])
        turned = np.linalg.qr(rng.standard_normal((k + 1, k + 1)))[0] if rng.integers(2) else np.eye(k + 1)
        reads, hears = (np.vstack([one, rng.standard_normal((1, one.shape[1]))]) for one in (reads, hears))
        own, gains = turned @ hidden @ turned.T, np.pad(gains, ((0, 0), (0, 1))) @ turned.T
        reads, hears = turned @ reads, turned @ hears
    disturbance = None if rng.integers(4) == 0 else NONE
    return Controller(own, reads, gains, through, hears, disturbance=disturbance)


def signals(rng: np.random.Generator, ticks: int, size: int, large: float) -> np.ndarray:
    """Return Gaussian noise, rare impulses, a load, and a recorded signal, each twice: (ticks, 8, size)."""
    noise = rng.standard_normal((ticks, 8, size))
    noise[:, 2:4] *= np.where(rng.random((ticks, 2, 1)) < 0.03, 12.0, 0.05)
    wave = np.sin(2 * np.pi * np.arange(ticks) / rng.uniform(5, 90)) + rng.choice([0.0, 1.0])
    noise[:, 4:6] = 0.1 * noise[:, 4:6] + wave[:, None, None] * rng.standard_normal((1, 2, size))
    taken = RECORDED[(np.arange(ticks)[:, None] + rng.integers(99, size=size)) % len(RECORDED)]
    noise[:, 6:] = taken[:, None] * np.array([1.0, -3.0])[:, None]
    return large * noise


@dataclass(frozen=True, eq=False)
class Drawn:
    """A problem, and the arguments of its design."""

    plant: Plant
    cost: Cost
    network: Network
    kept: Controller | None  # None: LQG
    theta: float
    shares: dict[str, float]
    rule: Rule
    spend: float
    prediction: Mode
    actuation: Mode
    joint: bool | None


def drawn(seed: int, rule: Rule | None = None, lqg: bool = False) -> Drawn:
    """Return the problem of a seed."""
    rng = np.random.default_rng(seed)
    states, inputs, outputs = (int(rng.integers(1, most + 1)) for most in (6, 3, 3))
    measured = lqg and bool(rng.integers(4) == 0)
    system = make_system(seed, states, inputs, states if measured else outputs, measured)
    plant, cost = system.plant, system.cost
    assume(well_posed(plant.A, plant.B) and well_posed(plant.A.T, plant.C.T))
    network = network_for(plant, rng)
    usual: Rule = "bank" if rng.integers(2) else "threshold"
    if rule == "relative":
        assume(outputs <= states)
        cost = cost_of_outputs(plant, network, rng)
    elif not lqg and rng.integers(4) == 0:  # a cost that sees little
        row = rng.standard_normal((1, states + inputs))
        row[:, states:] *= rng.integers(2)
        weight = row.T @ row
        cost = Cost(weight[:states, :states], weight[states:, states:], weight[:states, states:])
    kept = None if lqg else controller_for(plant, rng)
    hand = kept or lqg_by_hand(plant, cost)
    assume(Whole(plant.A, plant.B, plant.C, hand, stage_of(cost)).radius < 0.98)
    modes: list[Mode] = ["hold", "model"]
    return Drawn(
        plant, cost, network, kept, float(rng.choice([0.1, 0.5, 2.0, 10.0])),
        {link: float(rng.uniform(0.2, 1.0)) for link in network.links}, rule or usual,
        float(rng.choice([0.03, 0.1, 1.0])), modes[rng.integers(2)], modes[rng.integers(2)],
        [None, False, True][int(rng.integers(3))],
    )  # fmt: skip


def policy_of(given: Drawn) -> Policy:
    """Return the policy of the library."""
    return design.distributed(
        given.plant, given.cost, theta=given.theta, shares=given.shares, controller=given.kept, network=given.network,
        guarantee="every path", rule=given.rule, spend=None if given.rule == "threshold" else given.spend,
        prediction=given.prediction, actuation=given.actuation, joint=given.joint,
    )  # fmt: skip


def case_of(given: Drawn) -> Case:
    """Return the loop of the library, with the limits of all nodes by hand."""
    policy = policy_of(given)
    loop, hand = close(given.plant, policy), given.kept or lqg_by_hand(given.plant, given.cost)
    plant = loop.problem.plant
    whole, ticks = Whole(plant.A, plant.B, plant.C, hand, padded(given.cost, loop)), given.cost.horizon
    base, n = whole.average(plant.W, plant.V), given.plant.states
    if ticks is not None:
        assert given.cost.terminal is not None
        start, end = plant.covariance + np.outer(plant.mean, plant.mean), np.zeros_like(plant.A)
        end[:n, :n] = given.cost.terminal
        base = whole.total(plant.W, plant.V, start, end, ticks)
    assert policy.cost_all_time == pytest.approx(base, rel=1e-7)
    groups, total = groups_of(given), sum(given.shares.values())
    weights = {links: sum(given.shares[link] for link in links) / total for links in groups}
    if given.rule == "relative":
        length = sqrt(sum(weight**2 for weight in weights.values()))
        seen = np.asarray(np.linalg.pinv(given.plant.C))  # θ is a share of J without the noise of the outputs
        noise = float(np.sum((seen.T @ given.cost.Q @ seen) * given.plant.V))
        kappa = 1 - 1 / sqrt(1 + given.theta * base / (base + noise))
        limits = {links: kappa * weight / length for links, weight in weights.items()}
    else:
        whole_limit = (sqrt(1 + given.theta) - 1) ** 2 * base / (ticks or 1)
        limits = {links: whole_limit * weight**2 for links, weight in weights.items()}
    return Case(loop, hand, given.rule, limits, given.spend, given.shares)


def groups_of(given: Drawn) -> list[Links]:
    """Return the links that are decided together."""
    network = given.network
    sensors = [(node,) for node in network.sensors if node in network.links]
    actuators = tuple(node for node in network.actuators if node in network.links)
    ideal = all(network.links[link].ideal for link in actuators)
    together = ideal if given.joint is None else given.joint
    return [*sensors, *([actuators] if together and actuators else [(node,) for node in actuators])]


def padded(cost: Cost, loop: Loop) -> np.ndarray:
    """Return the weight of (x, u), with zeros for the disturbances that a loop has as further states."""
    more = loop.problem.plant.states - len(cost.Q)
    return stage_of(Cost(np.pad(cost.Q, (0, more)), cost.R, np.pad(cost.N, ((0, more), (0, 0)))))


def cost_of_outputs(plant: Plant, network: Network, rng: np.random.Generator) -> Cost:
    """Return a cost of outputs and inputs without products of different nodes."""
    weights = []
    for size, found in (
        (plant.outputs, network.measurements(plant.outputs)),
        (plant.inputs, network.applications(plant.inputs)),
    ):
        weight = np.zeros((size, size))
        for _, rows in found.values():
            root = rng.standard_normal((len(rows), len(rows)))
            weight[np.ix_(rows, rows)] = root @ root.T + 0.05 * np.eye(len(rows))
        weights.append(weight)
    return Cost(plant.C.T @ weights[0] @ plant.C, weights[1])


@dataclass(frozen=True, eq=False)
class Path:
    """Paths of a loop with what is computed by hand: the sums up to each step, (steps, paths)."""

    case: Case
    run: Told
    v: np.ndarray
    w: np.ndarray

    @staticmethod
    def of(case: Case, seed: int, ticks: int, fast: bool = False) -> Path:
        """Run a loop on many kinds of noise, from any state."""
        rng, plant = np.random.default_rng(seed), case.loop.problem.plant
        large = 10 ** rng.uniform(-1, 1)
        w = signals(rng, ticks, plant.states, large * 0.3)
        v = signals(rng, ticks, plant.outputs, large * 0.3)
        if plant.full_state:
            v = 0 * v
        start = rng.standard_normal((8, plant.states)) * rng.choice([0.0, 3.0 * large], size=(8, 1))
        return Path(case, told(case.loop, w, v, start, fast), v, w)

    @cached_property
    def every_sample(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(x, u) and ζ of the loop with every sample, from the same start on the same noise, and its last states."""
        whole, plant = self.case.whole, self.case.loop.problem.plant
        z = np.zeros((len(self.run.start), len(whole.F)))
        z[:, : whole.n] = self.run.start
        if "prior" in self.case.loop.policy.initial and len(z[0]) == 2 * whole.n:  # LQG starts with what it expects
            z[:, whole.n :] = plant.mean
        return whole.path(z, self.w, self.v)

    @property
    def base(self) -> np.ndarray:
        """ζ of the loop with every sample."""
        return self.every_sample[1]

    @cached_property
    def output(self) -> np.ndarray:
        """ζ of the loop."""
        return np.concatenate([self.run.x, self.run.u], axis=-1) @ self.case.whole.root.T

    @cached_property
    def responses(self) -> dict[Links, Response]:
        """The response to the errors of each node."""
        found, entries = {}, entries_of(self.case.loop)
        for links in self.case.limits:
            d, at = np.zeros(self.run.d.shape), [entry for link in links for entry in entries[link]]
            d[..., at] = self.run.d[..., at]
            found[links] = self.case.whole.response(d)
        return found

    @property
    def cost(self) -> np.ndarray:
        """The cost of the loop up to each step."""
        return running((self.output**2).sum(axis=-1))

    @property
    def base_cost(self) -> np.ndarray:
        """The cost of every sample up to each step."""
        return running((self.base**2).sum(axis=-1))

    @property
    def certificate(self) -> np.ndarray:
        """The sum of √Σa over the nodes, up to each step, with room for rounding."""
        return sum(np.sqrt(np.maximum(running(one.added), 0) + 1e-13 * one.size) for one in self.responses.values())  # type: ignore[return-value]


def the_certificate_holds(path: Path) -> None:
    """Responses add up to the path; what silence adds is their energy; and no horizon costs more than certified."""
    total = path.base + sum(one.output for one in path.responses.values())
    scale = np.abs(total).max() + sum(np.abs(one.output).max() for one in path.responses.values())
    np.testing.assert_allclose(path.output, total, rtol=0, atol=1e-8 * scale)
    for links, one in path.responses.items():
        energy = running((one.output**2).sum(axis=-1))
        assert (np.abs(running(one.added) - one.to_come - energy) <= ROUNDED * one.size).all()
        assert (np.abs(running(one.added) - running(path.run.added[links])) <= ROUNDED * one.size).all()
    left, right = np.sqrt(path.cost), np.sqrt(path.base_cost) + path.certificate
    assert (left <= right * (1 + ROUNDED)).all()
    assert (np.sqrt(path.base_cost) <= (left + path.certificate) * (1 + ROUNDED)).all()


def income(path: Path, links: Links) -> np.ndarray:
    """Return what a bank receives in each step, (steps, paths)."""
    case, run = path.case, path.run
    limit = np.full(run.u.shape[:2], case.limits[links])
    if case.rule != "relative":
        return limit
    at = [entry for link in links for entry in entries_of(case.loop)[link]]
    seen = np.concatenate([run.y, run.u], axis=-1)[..., at]
    return limit**2 * np.einsum("tki,ij,tkj->tk", seen, measured_weight(case)[np.ix_(at, at)], seen)


def measured_weight(case: Case) -> np.ndarray:
    """Return the weight of (y, u) of a cost that outputs and inputs measure."""
    problem = case.loop.problem
    inverse, p = np.linalg.pinv(problem.plant.C), problem.plant.outputs
    weight = np.zeros((p + problem.plant.inputs, p + problem.plant.inputs))
    weight[:p, :p], weight[p:, p:] = inverse.T @ problem.Q @ inverse, problem.R
    return weight


def the_decisions_are_those_of_the_rule(path: Path) -> None:
    """Each node sends the set of packets that its rule chooses, and all packets until they have arrived once."""
    case, run, entries = path.case, path.run, entries_of(path.case.loop)
    laws = case.loop.network.links
    for links, response in path.responses.items():
        gains, paid = income(path, links), running(response.added)
        before = np.vstack([np.zeros((1, paid.shape[1])), paid[:-1]])
        is_sensor = links[0] in case.loop.network.sensors
        earned = running(gains) if is_sensor or case.rule == "bank" else running(gains) - gains
        price = gains if case.rule == "threshold" else case.spend * (earned - before)
        begun = np.logical_or.accumulate(np.all([run.arrived[link] for link in links], axis=0), axis=0)
        begun = np.vstack([np.zeros((1, begun.shape[1]), dtype=bool), begun[:-1]])
        sets = [one for size in range(1, len(links) + 1) for one in combinations(links, size)]
        prices = {link: laws[link].price * case.shares[link] for link in links}  # what packets are worth
        worth, whole = {(): np.zeros(price.shape)}, sum(prices.values())
        scale = response.size + np.abs(price)
        for silent in sets:
            d, at = np.zeros(run.gap.shape), [entry for link in silent for entry in entries[link]]
            d[..., at] = run.gap[..., at]
            saved = sum(prices[link] for link in silent) / whole
            worth[silent] = response.would_add(d) - saved * price
            scale = scale + np.abs(response.would_add(d))
        best = np.min([*worth.values()], axis=0)
        silent_now = {link: ~run.sent[link] for link in links}
        chosen = np.zeros(price.shape)
        for silent, value in worth.items():
            taken = np.all([silent_now[link] == (link in silent) for link in links], axis=0)
            chosen = np.where(taken, value, chosen)
        assert np.where(begun, chosen - best <= ROUNDED * scale, True).all()
        for link in links:
            assert run.sent[link][~begun].all()


def the_promise_holds(path: Path) -> None:
    """No bank is overdrawn, no silence adds more than a threshold, and no horizon costs more than promised."""
    case = path.case
    steps = np.arange(1, len(path.run.u) + 1)[:, None]
    guarantee = case.loop.policy.guarantee
    assert guarantee is not None
    assert guarantee.every_path
    for links, one in path.responses.items():
        silent = running(np.any([~path.run.sent[link] for link in links], axis=0))
        most = running(income(path, links)) if case.rule != "threshold" else case.limits[links] * silent
        assert (running(one.added) <= most + ROUNDED * (one.size + most)).all()
        assert (np.abs(path.run.total[links] - running(one.added)) <= ROUNDED * one.size).all()
        if case.rule != "threshold":
            bank = most - running(one.added)
            assert (np.abs(path.run.bank[links] - bank) <= ROUNDED * (one.size + most)).all()
    if case.rule == "relative":
        the_relative_promise_holds(path)
        return
    left, right = np.sqrt(path.cost), np.sqrt(path.base_cost)
    most = right + sum(np.sqrt(limit * steps) for limit in case.limits.values())
    assert (left <= most * (1 + ROUNDED)).all()
    base = case.loop.policy.cost_all_time
    whole = (sqrt(base) + sum(sqrt(limit) for limit in case.limits.values())) ** 2
    assert guarantee.cost == pytest.approx(whole, rel=1e-7)


def the_relative_promise_holds(path: Path) -> None:
    """The cost of what is measured is at most that of every sample over (1 − κ)², on every path and at every time."""
    case, run, guarantee = path.case, path.run, path.case.loop.policy.guarantee
    plant, weight = case.loop.problem.plant, measured_weight(case)
    share = sqrt(sum(kappa**2 for kappa in case.limits.values()))
    every = path.every_sample[0]
    pairs = (run.y, run.u), (every[..., : plant.states] @ plant.C.T + path.v, every[..., plant.states :])
    costs = []
    for y, u in pairs:
        both = np.concatenate([y, u], axis=-1)
        costs.append(np.sqrt(running(np.einsum("tki,ij,tkj->tk", both, weight, both))))
    assert (costs[0] * (1 - share) <= costs[1] + ROUNDED * costs[0]).all()
    assert guarantee is not None
    noise = float(np.sum(weight[: plant.outputs, : plant.outputs] * plant.V))
    most = (case.loop.policy.cost_all_time + noise) / (1 - share) ** 2 - noise
    assert guarantee.cost == pytest.approx(most, rel=1e-7)
