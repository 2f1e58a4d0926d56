"""Gains over lossy links: optimality, exact costs by propagated moments, limits, and the losses that are too many."""

# ruff: noqa: SIM300 - ruff takes matrices, which carry their paper symbols, for constants
from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import scipy.linalg
from counts import few
from drawn import law
from flint import arb, arb_mat
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from systems import uncontrollable_modes

from taciturn import Cost, Network, Plant, Policy, ProblemError, Reference, UnstableError, design, evaluate
from taciturn._modes import radius
from taciturn._rational import precision
from taciturn.lqg.critical_losses import Channel, Lasting, MeanSquare
from taciturn.lqg.lossy import (
    critical_losses,
    lossy_step,
    regulate_lossy,
    regulate_lossy_finite,
)
from taciturn.lqg.riccati import regulate
from taciturn.model.steps import Assign
from taciturn.model.trigger import Scheduled

SEEDS = st.integers(0, 2**32 - 1)
LINKS = [Channel(0.0, 0.0, told, late) for told, late in product((False, True), repeat=2)]
links = pytest.mark.parametrize("link", LINKS, ids=lambda c: f"{'tcp' if c.acknowledged else 'udp'}{int(c.delayed)}")


def semidefinite(rng: np.random.Generator, size: int, rank: int | None = None) -> np.ndarray:
    """Return a random covariance."""
    root = rng.normal(size=(size, size if rank is None else rank)) / np.sqrt(size)
    return root @ root.T


def system(seed: int, largest: int, low: float = 0.4, high: float = 1.3) -> tuple[np.ndarray, ...]:
    """Return random A, B, Q, R with a spectral radius in a range, and every slow mode clearly within reach."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, largest + 1))
    m = int(rng.integers(1, min(n, 2) + 1))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    A *= rng.uniform(low, high) / radius(A)
    slow = [value for value in np.linalg.eigvals(A) if abs(value) > 0.9]
    assume(all(np.linalg.svd(np.hstack([A - s * np.eye(n), B]))[1][n - 1] > 0.2 for s in slow))
    return A, B, semidefinite(rng, n) + 0.05 * np.eye(n), semidefinite(rng, m) + 0.1 * np.eye(m)


def at_losses(link: Channel, actuator: float, sensor: float) -> Channel:
    """Return the channel with other losses."""
    return Channel(float(actuator), float(sensor), link.acknowledged, link.delayed)


def survivable(A: np.ndarray, B: np.ndarray, link: Channel, seed: int) -> Channel:
    """Return the channel with random losses, halved until the slowest growth is clearly below 1."""
    actuator, sensor = np.random.default_rng(seed + 1).uniform(0, 0.7, 2)
    while Lasting(A, B).slowest(at_losses(link, actuator, sensor))[0] >= 0.9:
        actuator, sensor = actuator / 2, sensor / 2
        assert actuator > 1e-9, "no losses are small enough"
    return at_losses(link, actuator, sensor)


def network(channel: Channel) -> Network:
    """Return the network that a channel describes."""
    losses = channel.actuator_loss, channel.sensor_loss
    return Network("tcp" if channel.acknowledged else "udp", *losses, int(channel.delayed))


def cost_to_go(L, X, S, problem, following, channel) -> float:
    """Return E[x'Qx + û'Rû] + E[x⁺'Kx⁺ + e⁺'Pe⁺] of u = Lx̂ by its four outcomes; E[x̂x̂'] = X, E[ee'] = S, E[x̂e'] = 0."""
    (A, B, Q, R), (K, P), n = problem, following, len(X)
    moment = scipy.linalg.block_diag(X, S)  # of (x̂, e)
    guess, x, u = np.eye(n, 2 * n), np.hstack([np.eye(n), np.eye(n)]), L @ np.eye(n, 2 * n)
    total = np.trace(x.T @ Q @ x @ moment)
    for moved, seen in product((0, 1), repeat=2):
        share = abs(moved - channel.actuator_loss) * abs(seen - channel.sensor_loss)  # 1 − loss, or loss
        after = A @ x + moved * B @ u
        told = moved if channel.acknowledged else 1 - channel.actuator_loss
        if channel.delayed:  # the packet holds the state of before the input
            estimate = A @ (x if seen else guess) + told * B @ u
        else:
            estimate = after if seen else A @ guess + told * B @ u
        wrong = after - estimate
        form = moved * u.T @ R @ u + after.T @ K @ after + wrong.T @ P @ wrong
        total += share * np.trace(form @ moment)
    return float(total)


@links
@law(3, 40, seed=SEEDS)
def test_one_step_is_the_best_answer_to_the_next(link, seed):
    """K and P price the step that L makes, every other gain costs its square more, and silence costs x̂'Γx̂ more."""
    problem = system(seed, 4)
    rng = np.random.default_rng(seed + 2)
    n, m = problem[1].shape
    X, S, K, P = (semidefinite(rng, n, int(rng.integers(1, n + 1))) for _ in range(4))
    channel = at_losses(link, *rng.uniform(0, 1, 2))
    before, price, L, Gamma = lossy_step(*problem, K, P, channel)
    best = cost_to_go(L, X, S, problem, (K, P), channel)
    assert best == pytest.approx(np.trace(before @ (X + S)) + np.trace(price @ S), rel=1e-11)
    coupling = 0 if link.acknowledged else channel.actuator_loss * (1 if link.delayed else channel.sensor_loss)
    M = problem[3] + problem[1].T @ (K + coupling * P) @ problem[1]
    for size in (1e-3, 1.0, 30.0):
        D = size * rng.normal(size=(m, n))
        more, less = (cost_to_go(L + E, X, S, problem, (K, P), channel) for E in (D, -D))
        square = (1 - channel.actuator_loss) * np.trace(D.T @ M @ D @ X)
        assert more - best == pytest.approx(square, rel=1e-10, abs=1e-11 * (best + square))
        assert less - best == pytest.approx(square, rel=1e-10, abs=1e-11 * (best + square))
    silent = cost_to_go(np.zeros((m, n)), X, S, problem, (K, P), channel)
    assert silent - best == pytest.approx(np.trace(Gamma @ X), rel=1e-10, abs=1e-11 * silent)


class Moments:
    """E[zz'] of a loop in which everything is sent, step by step; z holds 1, x and every signal of the policy."""

    def __init__(self, policy: Policy, cost: Cost) -> None:
        """Start with the moments of the first step."""
        self.policy, self.cost, self.clock, self.plant = policy, cost, 0, policy.model
        own = {name: size for name, size in policy.sizes.items() if name not in ("one", "y")}
        self.sizes = {"one": 1, "x": self.plant.states, **own}
        ends = np.cumsum(list(self.sizes.values()))
        self.at = {name: slice(e - size, e) for (name, size), e in zip(self.sizes.items(), ends, strict=True)}
        first, self.new = np.zeros(ends[-1]), np.zeros((ends[-1],) * 2)
        for name, value in ({"one": [1.0], "x": self.plant.mean} | dict(policy.initial)).items():
            first[self.at[name]] = value
        self.z = np.outer(first, first)
        self.z[self.at["x"], self.at["x"]] += self.plant.covariance
        self.new[self.at["x"], self.at["x"]] = self.plant.W
        self.maps: dict[int, list[tuple[float, np.ndarray, np.ndarray]]] = {}

    def tick(self) -> float:
        """Return the expected stage cost of a step, and move on."""
        if self.clock not in self.maps:
            self.maps[self.clock] = list(self._outcomes())
        cost, after = 0.0, self.new
        for share, F, S in self.maps[self.clock]:
            cost, after = cost + share * float(np.sum(S * self.z)), after + share * F @ self.z @ F.T
        self.z = after
        self.clock = int(self.policy.locations[0].table[self.clock]) if self.policy.locations else 0
        return cost

    def mission(self) -> float:
        """Return the expected total over a finite horizon, its final state taken relative to the end of a reference."""
        assert self.cost.terminal is not None
        assert self.cost.horizon is not None
        total = sum(self.tick() for _ in range(self.cost.horizon))
        target = 0 * self.plant.mean if self.policy.tracking is None else self.policy.tracking.final
        both = slice(0, 1 + len(target))  # 1 and x
        off = np.hstack([-target[:, None], np.eye(len(target))])
        return total + float(np.trace(self.cost.terminal @ off @ self.z[both, both] @ off.T))

    def _outcomes(self):
        loss = self.policy.network.loss
        for actuator, sensor in product((0, 1), repeat=2):
            share = abs(actuator - loss("actuator")) * abs(sensor - loss("sensor"))
            if share:
                yield share, *self._follow({"actuator": actuator, "sensor": sensor})

    def _follow(self, arrived: dict[str, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return F and S of z⁺ = F z + noise and the stage cost z'Sz, by following the steps as they are written."""
        now = {name: np.eye(len(self.z))[where] for name, where in self.at.items()}
        now["y"] = x = now["x"]
        for step in self.policy.steps:
            if isinstance(step, Assign):
                on = step.on
                outcome = 0 if on is None else 1 if isinstance(on, str) else arrived[on.link]
                terms = step.branches[outcome].items()
                tables = {name: weight.values[self.clock] for name, weight in terms if isinstance(weight, Scheduled)}
                now[step.signal] = sum(tables.get(name, weight) @ now[name] for name, weight in terms)
        cost, u = self.cost, now["input"]
        now["x"] = self.plant.A @ x + self.plant.B @ u
        if self.policy.tracking is not None:
            x, u = x - now[self.policy.tracking.state], u - now[self.policy.tracking.input]
        return np.vstack([now[name] for name in self.sizes]), x.T @ cost.Q @ x + u.T @ cost.R @ u


IDEAL = [Network(), Network(delay=1)]


@pytest.mark.parametrize("tracked", [False, True], ids=["", "tracking"])
@pytest.mark.parametrize("link", [*LINKS, *IDEAL], ids=lambda c: str(c)[:90])
@law(2, 10, seed=SEEDS)
def test_the_all_time_cost_of_a_mission_is_that_of_the_propagated_moments(link, tracked, seed):
    """Random start, unstable plants, losses on both links, whatever is acknowledged or late, a reference or none."""
    A, B, Q, R = system(seed, 4)
    rng = np.random.default_rng(seed + 3)
    (n, m), steps = B.shape, int(rng.integers(1, 25))
    start = {"mean": rng.normal(size=n), "covariance": semidefinite(rng, n, int(rng.integers(1, n + 1)))}
    plant = Plant(A, B, semidefinite(rng, n, int(rng.integers(1, n + 1))), **start)
    cost = Cost(Q, R, horizon=steps, terminal=semidefinite(rng, n))
    way = link if isinstance(link, Network) else network(at_losses(link, *rng.uniform(0, 0.8, 2)))
    inputs, states = rng.normal(size=(steps, m)), [rng.normal(size=n)]
    for push in inputs:
        states.append(A @ states[-1] + B @ push)
    reference = Reference(states, inputs) if tracked else None
    policy = design.lossy_lqg(plant, cost, price=0.1, network=way, reference=reference)
    assert policy.cost_all_time == pytest.approx(Moments(policy, cost).mission(), rel=1e-10)


@pytest.mark.parametrize("link", [*LINKS, *IDEAL], ids=lambda c: str(c)[:90])
@law(2, 6, seed=SEEDS)
def test_the_all_time_average_is_that_of_the_stationary_moments(link, seed):
    """Stable and unstable plants, losses that can be survived."""
    A, B, Q, R = system(seed, 3)
    way = link if isinstance(link, Network) else network(survivable(A, B, link, seed))
    cost = Cost(Q, R)
    plant = Plant(A, B, semidefinite(np.random.default_rng(seed), len(A)))
    policy = design.lossy_lqg(plant, cost, price=0, network=way)
    assume(policy.theory.settling < 50)
    moments = Moments(policy, cost)
    for _ in range(int(15 * policy.theory.settling)):
        moments.tick()
    assert policy.cost_all_time == pytest.approx(moments.tick(), rel=1e-10)


@links
@law(2, 5, seed=SEEDS)
def test_the_fixed_point_is_the_limit_of_the_recursions(link, seed):
    """From K = Q and P = 0 the steps tend to the gains of the average."""
    problem = system(seed, 4)
    channel = survivable(problem[0], problem[1], link, seed)
    found = regulate_lossy(*problem, channel)
    assume(MeanSquare(*problem[:2], found.L, channel).growth() < 0.95)
    step = (problem[2], np.zeros_like(problem[2]))
    for _ in range(800):
        step = lossy_step(*problem, *step[:2], channel)
    for limit, part in zip(step, (found.K, found.P, found.L, found.Gamma), strict=True):
        assert part == pytest.approx(limit, rel=1e-10, abs=1e-10 * np.abs(limit).max(initial=1e-6))
    assert MeanSquare(*problem[:2], found.L, channel).growth() < 1


def exact_limit(
    problem: tuple[np.ndarray, ...], channel: Channel, gain: np.ndarray | None = None
) -> tuple[arb_mat, ...]:
    """Return the limits of K, P and K + φP from K = Q and P = 0 step by step, of the best gains or of one gain."""
    A, B, Q, R = (arb_mat(part.tolist()) for part in problem)
    loss, unseen = arb(channel.actuator_loss), arb(channel.sensor_loss)
    late = 1 if channel.delayed else unseen
    coupled = 0 if channel.acknowledged else loss * late
    K, P = Q, Q * 0
    for _ in range(20_000):
        H, off = (R + B.transpose() * (K + P * coupled) * B).mid(), B.transpose() * K * A
        L = arb_mat(gain.tolist()) if gain is not None else H.solve(off) * -1
        silent = ((off.transpose() * L + L.transpose() * off + L.transpose() * H * L) * (loss - 1)).mid()
        before = K, P
        K, P = Q + A.transpose() * K * A - silent, silent + A.transpose() * P * A * unseen
        K, P = (((one + one.transpose()) * arb(0.5)).mid() for one in (K, P))  # rounding that is not symmetric grows
        change = max(abs(float(x)) for now, past in zip((K, P), before, strict=True) for x in (now - past).entries())
        if change < 1e-40 * max(abs(float(x)) for x in K.entries()):
            return K, P, P * late + K
    raise AssertionError("the recursion has not settled")


@links
@law(3, 40, seed=SEEDS)
def test_the_claimed_error_holds_the_least_cost_and_that_of_the_stored_gain(link, seed):
    """The recursion itself in 300 bits, in random units."""
    A, B, Q, R = system(seed, 4)
    rng, channel = np.random.default_rng(seed), survivable(A, B, link, seed)
    state, unit = (10 ** rng.uniform(-4, 4, size) for size in B.shape)
    problem = (
        A * state / state[:, None],
        B * unit / state[:, None],
        Q * np.outer(state, state),
        R * np.outer(unit, unit),
    )
    found = regulate_lossy(*problem, channel)
    assume(MeanSquare(*problem[:2], found.L, channel).growth() < 0.97)
    claimed = found.K + (1.0 if channel.delayed else channel.sensor_loss) * found.P
    assert (found.error.diagonal() <= 1e-9 * claimed.diagonal() * (1 + 1e-6)).all()
    with precision(300):
        for limit in exact_limit(problem, channel), exact_limit(problem, channel, found.L):
            off = np.array([float(x) for x in (limit[2] - arb_mat(claimed.tolist())).entries()]).reshape(Q.shape)
            scale = np.sqrt(found.error.diagonal())
            for sign in (1, -1):
                assert np.linalg.eigvalsh((found.error + sign * off) / scale / scale[:, None])[0] > 0


def test_an_exact_cost_of_a_rounded_gain_is_proved_for_inputs_with_similar_effects():
    """Two inputs that nearly do the same: rounding the gain costs more than the largest entries of the price show."""
    A, B, one = np.array([[-0.51, 0.36], [0.15, -0.57]]), np.array([[1.0, 1.0], [1.0, 1.0625]]), np.eye(2)
    found = regulate_lossy(A, B, one, one / 128, Channel(0.3, 0.6, acknowledged=True, delayed=False))
    assert (found.error.diagonal() < 1e-14 * found.K.diagonal()).all()


TCP, UDP, LATE = Channel(0.0, 0.0, True, False), Channel(0.0, 0.0, False, False), Channel(0.0, 0.0, True, True)


@pytest.mark.parametrize(
    "A",
    [
        np.array([[1.05]]),
        np.array([[-3.0]]),
        np.diag([1.2, 1.5]),
        np.diag([1.2, -1.3, 0.7]),
        1.3 * np.array([[0.6, 0.8], [-0.8, 0.6]]),
        np.array([[1.25, 1.0], [0.0, 1.25]]),
        np.array([[1.1, 1.0, 0.0], [0.0, 1.1, 1.0], [0.0, 0.0, 1.1]]),
    ],
    ids=["slow", "fast", "two", "two and a stable one", "complex pair", "Jordan block", "Jordan block of three"],
)
def test_one_input_survives_losses_below_the_product_of_its_unstable_modes(A):
    """Actuator 1/Π|λ|², sensor 1/ρ² (schenato2007): one packet moves one direction, one measurement shows all."""
    grown = [abs(value) for value in np.linalg.eigvals(A) if abs(value) > 1]
    B = np.ones((len(A), 1)) if np.count_nonzero(A - np.diag(np.diag(A))) == 0 else np.eye(len(A))[:, -1:]
    for link in (TCP, LATE):
        actuator, sensor = critical_losses(A, B, link)
        assert actuator == pytest.approx(np.prod(grown) ** -2, abs=1e-6)
        assert sensor == pytest.approx(max(grown) ** -2, abs=1e-6)


@law(2, 4, seed=SEEDS)
def test_as_many_inputs_as_states_survive_losses_below_one_over_the_squared_radius(seed):
    """1/ρ² (schenato2007): with an invertible B every packet moves everything."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, n)) + 2 * np.eye(n)
    A *= rng.uniform(1.05, 2) / radius(A)
    assume(np.linalg.cond(B) < 50)
    assert critical_losses(A, B, TCP) == pytest.approx((radius(A) ** -2,) * 2, abs=1e-6)


@links
@law(2, 5, seed=SEEDS)
def test_a_stable_plant_survives_every_loss(link, seed):
    """1 and 1, at any loss of the other link."""
    lost = np.random.default_rng(seed).uniform(0, 1, 2)
    assert critical_losses(*system(seed, 4, 0.2, 0.97)[:2], at_losses(link, *lost)) == (1.0, 1.0)


@law(2, 10, seed=SEEDS)
def test_losses_are_proved_on_both_sides_of_the_critical_one(seed):
    """Of one input with acknowledgements, 1/Π|λ|²; the least growth in another computation agrees without them."""
    A, B, _, _ = system(seed, 4, 1.05, 1.6)
    plant, grown = Lasting(A, B[:, :1]), [abs(value) for value in np.linalg.eigvals(A) if abs(value) > 1]
    assume(not uncontrollable_modes(A, B[:, :1]).size)
    for link, exact in (("actuator", np.prod(grown) ** -2), ("sensor", max(grown) ** -2)):
        found = plant.critical(TCP, link)
        assert found.survived * (1 - 1e-12) <= exact <= found.lost * (1 + 1e-12)
        assert found.lost - found.survived < 1e-6
        assert str(found) == f"below {found.survived:.6g}"
    plant, channel = Lasting(A, B), survivable(A, B, UDP, seed)
    found = plant.critical(channel, "actuator")
    assert found.lost - found.survived < 1e-6
    below, above = (Lasting(A, B).slowest(channel.at("actuator", loss))[0] for loss in found)
    assert below - 1e-6 < 1 < above + 1e-6
    assert not plant.exceeded(channel.at("actuator", found.survived))
    assert plant.exceeded(channel.at("actuator", found.lost * (1 + 1e-8)))


def test_an_axis_that_survives_more_losses_does_not_hide_the_other():
    """Two axes with an input each: the pair of weights that shows it is zero on one of them."""
    A, B = np.diag([2.0, 1.5, 1.25]), np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    for link, exact in (("actuator", 1 / (1.5 * 1.25) ** 2), ("sensor", 1 / 4)):
        found = Lasting(A, B).critical(TCP, link)
        expected = min(exact, 1 / 4)
        assert found.survived <= expected <= found.lost < found.survived + 1e-8


def test_modes_that_one_input_hardly_tells_apart_survive_more_than_double_precision_showed():
    """Modes at −1.218 and −1.214: losses of 0.155 were refused, with a critical loss of 0.1507."""
    A, B = np.diag([-1.218, -1.259, 1.02, -1.214]), np.array([[-0.337], [0.719], [1.812], [0.937]])
    channel = Channel(0.155, 0.22, acknowledged=False, delayed=False)
    found = Lasting(A, B).critical(channel, "actuator")
    assert 0.159 < found.survived < found.lost < 0.1591
    assert MeanSquare(A, B, Lasting(A, B).slowest(channel)[1], channel).growth() < 1


def test_what_is_not_proved_is_said():
    """A chain of five equal growing modes with two inputs, whose weights double precision does not hold."""
    A, B = 1.02 * np.eye(5) + np.eye(5, k=1), np.random.default_rng(0).normal(size=(5, 2))
    found = Lasting(A, B).critical(TCP, "actuator")
    assert 0.7 < found.survived < 1.02**-2 < found.lost
    assert str(found) == f"up to {found.survived:.6g} and below {found.lost:.6g} (more is not proved)"


def diverges(problem: tuple[np.ndarray, ...], channel: Channel) -> bool:
    """Tell whether the costs of longer and longer finite-horizon runs grow without bound."""
    K, P = problem[2], np.zeros_like(problem[2])
    for _ in range(20_000):
        size = np.trace(K + P)
        K, P, _, _ = lossy_step(*problem, K, P, channel)
        if np.trace(K + P) > 1e9 * np.trace(problem[2]):
            return True
        if np.trace(K + P) - size <= 1e-10 * size:
            return False
    raise AssertionError("neither settles nor diverges")


@pytest.mark.evidence
@pytest.mark.parametrize("link", LINKS, ids=str)
@settings(max_examples=2, deadline=None)
@given(seed=SEEDS)
def test_missions_settle_below_the_critical_losses_and_diverge_above(link, seed):
    """The recursions themselves, 3 % below and above the critical losses of either link."""
    A, B, _, _ = system(seed, 3, 1.05, 1.8)
    problem = (A, B, np.eye(len(A)), np.eye(B.shape[1]))
    channel = survivable(A, B, link, seed)
    for index, critical in enumerate(critical_losses(A, B, channel)):
        for factor in (0.97, 1.03):
            lost = [channel.actuator_loss, channel.sensor_loss]
            lost[index] = critical * factor
            if critical < 1 and lost[index] <= 1:
                assert diverges(problem, at_losses(link, *lost)) == (factor > 1)


@settings(max_examples=2, deadline=None)
@given(seed=SEEDS)
@pytest.mark.evidence
def test_less_knowledge_survives_fewer_losses(seed):
    """Critical losses without acknowledgement or with the delay are at most those with it or without."""
    A, B, _, _ = system(seed, 3, 1.02, 1.6)
    lost = np.random.default_rng(seed).uniform(0, 0.3, 2)
    udp, udp_late, tcp, tcp_late = (critical_losses(A, B, at_losses(link, *lost)) for link in LINKS)
    for worse, better in ((udp, tcp), (udp_late, tcp_late), (udp_late, udp), (tcp_late, tcp)):
        assert all(less <= more + 1e-8 for less, more in zip(worse, better, strict=True))


@pytest.mark.parametrize("link", few(LINKS, quick=1, start=2), ids=str)
@settings(max_examples=2, deadline=None)
@given(seed=SEEDS)
def test_the_units_of_states_and_inputs_decide_nothing(link, seed):
    """Critical losses and the cost of the average are the same in other units."""
    A, B, Q, R = system(seed, 3)
    n, m = B.shape
    rng = np.random.default_rng(seed + 3)
    channel = survivable(A, B, link, seed)
    T, S = np.diag(10.0 ** rng.uniform(-3, 3, n)), np.diag(10.0 ** rng.uniform(-3, 3, m))
    back = np.linalg.inv(T)
    other = T @ A @ back, T @ B @ S
    assert critical_losses(*other, channel) == pytest.approx(critical_losses(A, B, channel), abs=1e-6)
    plain, scaled = regulate_lossy(A, B, Q, R, channel), regulate_lossy(*other, back @ Q @ back, S @ R @ S, channel)
    assert S @ scaled.L @ T == pytest.approx(plain.L, rel=1e-6, abs=1e-8 * np.abs(plain.L).max())


@links
@law(2, 10, seed=SEEDS)
def test_no_gain_grows_slower_than_the_slowest_growth(link, seed):
    """The gain that comes with it attains it, and no random gain beats it, near or far."""
    A, B, _, _ = system(seed, 3, 1.02, 1.6)
    rng = np.random.default_rng(seed + 3)
    channel = at_losses(link, *rng.uniform(0, 0.8, 2))
    rate, best = Lasting(A, B).slowest(channel)
    stable = max((abs(value) ** 2 for value in np.linalg.eigvals(A) if abs(value) < 1), default=0.0)
    assert MeanSquare(A, B, best, channel).growth() <= max(rate, stable) * (1 + 1e-6)
    for size in (1e-3, 1e-2, 0.1, 1.0):
        for _ in range(10):
            gain = best + size * rng.normal(size=best.shape)
            assert rate <= MeanSquare(A, B, gain, channel).growth() * (1 + 1e-9)


@pytest.mark.parametrize("link", LINKS, ids=str)
@pytest.mark.evidence
def test_two_plants_that_share_nothing_but_the_links_survive_what_the_weaker_survives(link):
    """Two axes with an input each: growth and critical losses are those of the worse axis."""
    axes = [
        (np.array([[1.0, 0.1], [0.0, 1.2]]), np.array([[0.0], [1.0]])),
        (np.array([[1.3, 0.1], [0.0, 1.0]]), np.array([[0.1], [1.0]])),
    ]
    channel = at_losses(link, 0.1, 0.2)
    A, B = (scipy.linalg.block_diag(*parts) for parts in zip(*axes, strict=True))
    assert Lasting(A, B).slowest(channel)[0] == pytest.approx(max(Lasting(*axis).slowest(channel)[0] for axis in axes))
    if link == UDP:
        apart = [critical_losses(*axis, channel) for axis in axes]
        assert critical_losses(A, B, channel) == pytest.approx(tuple(map(min, *apart)), abs=1e-6)


def test_a_chain_of_three_integrators_is_not_refused():
    """Its growth is below 1 at every loss below 1, and without losses the gains are those of the plain regulator."""
    A, B, weights = np.eye(3) + np.eye(3, k=1), np.eye(3)[:, -1:], (np.eye(3), np.eye(1))
    assert critical_losses(A, B, TCP) == pytest.approx((1.0, 1.0), abs=1e-3)
    plain = regulate(A, B, *weights, np.zeros((3, 1)))
    assert plain.L == pytest.approx(regulate_lossy(A, B, *weights, UDP).L)


def test_more_losses_than_can_be_survived_are_refused_with_the_critical_value():
    """An average names what each lossy link would bear; a finite-horizon run is designed, and notes the same."""
    plant, cost, mission = Plant([[2.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]], horizon=20)
    way = Network("tcp", actuator_loss=0.3)
    with pytest.raises(UnstableError, match=r"actuator_loss is 0\.3 .*\(largest eigenvalue 2\).*losses below 0\.25 "):
        design.lossy_lqg(plant, cost, price=0.1, network=way)
    with pytest.raises(UnstableError, match=r"sensor losses below 0\.25 at this actuator loss"):
        design.lossy_lqg(plant, cost, price=0.1, network=Network("tcp", sensor_loss=0.26))
    (note,) = design.lossy_lqg(plant, mission, price=0.1, network=way).notes
    assert "actuator losses below 0.25 at this sensor loss: over longer horizons the cost grows without bound" in note
    for fine in (cost, mission):
        assert design.lossy_lqg(plant, fine, price=0.1, network=Network("tcp", actuator_loss=0.24)).notes == ()


def test_a_mission_whose_cost_overflows_is_refused():
    """A plant that grows beyond all numbers while everything is lost gives a sentence, not inf."""
    with pytest.raises(
        UnstableError, match=r"overflows \d+ steps before the end of the horizon of 200: the loss probabilities"
    ):
        regulate_lossy_finite(1e3 * np.eye(1), *[np.eye(1)] * 4, 200, at_losses(UDP, 1.0, 0.0))


def with_digits(given: tuple[np.ndarray, ...], K: arb_mat, P: arb_mat, channel: Channel) -> tuple[arb_mat, arb_mat]:
    """Return K and P one step earlier, as the page on lossy links states them, from the middles of balls."""
    A, B, Q, R = (arb_mat(np.asarray(part, dtype=np.float64).tolist()) for part in given)
    alpha, beta, turned = arb(channel.actuator_loss), arb(channel.sensor_loss), A.transpose()
    seen = K if channel.acknowledged else K + P * (alpha * channel.exposure)
    reach = B.transpose() * K * A
    gamma = (1 - alpha) * (reach.transpose() * (R + B.transpose() * seen * B).solve(reach))
    return (Q + turned * K * A - gamma).mid(), (gamma + beta * (turned * P * A)).mid()


LEAKING = [[-0.81, -1e-5], [1.8e5, 3.26]], [[-2e-6, -1.5e-5], [13.4, -1.03]]  # its weight of an error grows by 1e33
ALIKE = [[1.0, 0.0], [2.2e-3, 0.87]], [[0.0118, 362.0], [0.0, 0.0]]  # inputs of which a combination costs 1e-14 of both
HARD = {
    "small and large costs": (LEAKING, [[1.7e4, 0.66], [0.66, 6.3e-5]], [[6.5e-3, -1.3e-3], [-1.3e-3, 3.1e-4]], 60),
    "a cheap combination": (ALIKE, [[35.5, 0.18], [0.18, 1.2e-3]], [[6.4e-17, 8.3e-13], [8.3e-13, 7.1e-8]], 7),
}


@pytest.mark.parametrize("name", HARD)
def test_over_a_horizon_small_costs_next_to_large_ones_keep_their_digits(name):
    """Rounding would hide what a direction of states or inputs costs: K, P and L are those of 1,024 bits."""
    plant, *weights, steps = HARD[name]
    A, B, Q, R = (np.array(part) for part in (*plant, *weights))
    channel = Channel(0.05, 0.344, name == "a cheap combination", False)
    found = regulate_lossy_finite(A, B, Q, R, Q, steps, channel)
    with precision(1024):
        K, P = arb_mat(Q.tolist()), arb_mat(2, 2)
        for _ in range(steps):
            K, P = with_digits((A, B, Q, R), K, P, channel)
        for part, exact in ((found.K[0], K), (found.P[0], P)):
            assert part == pytest.approx(np.array(exact.tolist(), dtype=np.float64), rel=1e-12)


def test_inputs_that_hardly_cost_anything_together_are_solved_over_lossy_links():
    """Of two inputs that push alike, a combination costs 1e-10 of the others: no digit of its gain may be left out."""
    A = np.array([[1.0, 0, 0], [9e-5, 1, 0], [0, 11526.0, 1]])
    B, spread = np.array([[375.0, 58], [0, 0], [0, 0]]), np.array([[66827.0], [-13921.0]])
    Q, R = np.diag([0.17, 3.2e5, 6.5e-5]), spread @ spread.T + 0.05 * np.eye(2)
    channel = Channel(0.6, 0.523, False, True)
    found = regulate_lossy(A, B, Q, R, channel)
    with precision(1024):
        K, P = with_digits((A, B, Q, R), *(arb_mat(part.tolist()) for part in (found.K, found.P)), channel)
        for part, after in ((found.K, K), (found.P, P)):
            assert np.diag(np.array(after.tolist(), dtype=np.float64)) == pytest.approx(np.diag(part), rel=1e-8)


def test_a_mode_that_an_input_hardly_moves_is_not_called_uncontrollable():
    """Turned coordinates, and an input of 1e-12: doubles do not suffice, or the losses are too large."""
    T = np.array([[0.8, 0.6], [-0.6, 0.8]])
    A, B = T @ np.diag([1.2, -0.5]) @ T.T, T @ np.array([[1e-12], [1.0]])
    for loss, said in (
        (0.1, "over lossy links could not be"),
        (0.9, "mean-square stability allows actuator losses below 0.694"),
    ):
        with pytest.raises(UnstableError, match=said):
            regulate_lossy(A, B, np.eye(2), np.eye(1), Channel(loss, 0.0, True, False))


@pytest.mark.parametrize("share", [0.3, 0.6, 0.85, 0.95])
@pytest.mark.parametrize("seed", few(range(4), 1))
def test_modes_on_the_circle_in_rotated_coordinates_are_moved(seed: int, share: float):
    """Rounding puts a rotated mode ±1 inside the circle; the first gain must move it all the same."""
    draws = np.random.default_rng(seed)
    T = np.linalg.qr(draws.normal(size=(3, 3)))[0]
    A, B, one = T @ np.diag([1.0, -1.0, 1.4]) @ T.T, draws.normal(size=(3, 1)), np.eye(3)
    loss = share * critical_losses(A, B, Channel(0.1, 0.1, False, False))[0]
    found = regulate_lossy(A, B, one, np.eye(1), Channel(loss, 0.1, False, False))
    K, P = one, np.zeros((3, 3))
    for _ in range(100_000):
        price, across = 1.0 + B.T @ (K + loss * 0.1 * P) @ B, A.T @ K @ B
        Gamma = (1 - loss) * across @ across.T / price
        before, K, P = K, one + A.T @ K @ A - Gamma, Gamma + 0.1 * A.T @ P @ A
        K, P = (K + K.T) / 2, (P + P.T) / 2
        if np.abs(K - before).max() <= 1e-13 * np.abs(K).max():
            break
    assert found.K == pytest.approx(K, rel=1e-6)


@pytest.mark.evidence
def test_nearly_equal_growing_modes_have_no_critical_loss_that_is_proved():
    """Four modes that one input hardly tells apart: the cost-to-go of the regulator is flat in double precision."""
    modes = 1.0693087239676202 + 4.57993899e-5 * np.arange(4)
    B = np.array([[0.2395859911253061], [-0.3746311822420878], [0.46811523739189304], [-0.10258016582465135]])
    actuator, sensor = critical_losses(np.diag(modes), B, Channel(0.9, 0.4, False, False))
    assert 0 <= actuator < 1 / modes.max() ** 2
    assert 0 <= sensor < 1


def test_a_critical_loss_of_zero_ends_the_search():
    """Three nearly equal modes, held inputs: no loss is survived, and the message comes in a moment."""
    A = [[1.2261924503807429, 0.02733377492855151, 0.015418013022446449],
         [-0.05527376003649425, 1.1895934758663487, -0.006256884217555709],
         [0.023614686392535705, -0.05389785560346411, 1.1701578959574686]]  # fmt: skip
    plant = Plant(A, [[1.4258382457202734], [-1.1616095185495017], [-2.197671367087202]], np.eye(3))
    with pytest.raises(UnstableError, match="expected a stable loop"):
        design.excess(plant, Cost(np.eye(3), [[1.0]]), theta=0.1, network=Network("tcp", actuator_loss=0.9))


def test_a_base_with_too_many_steps_between_packets_is_refused():
    """Its value is computed step by step."""
    with pytest.raises(ProblemError, match="every = 1000000; expected at most 100000: the base policy"):
        design.excess(Plant([[1.1]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), theta=0.1, every=1_000_000)


def test_periodic_control_whose_cost_overflows_is_no_reason_to_refuse_a_policy():
    """Modes that differ by many orders of magnitude: the comparison has no row, and the evaluation its numbers."""
    E = np.diag([2.654225619093967e-08, 0.002884589368106314, 7.618909956677368])
    A = [[1.014112882512152, 0.935150145876097, -0.22625798311652073],
         [-0.7389238012383862, -0.4939488579659682, 0.32484781249843603],
         [-1.4021100044406631, 0.8995650416192922, -0.8522326004941438]]  # fmt: skip
    B = [[-1.158878942401498], [-0.08074089335854698], [1.8312448833581008]]
    plant = Plant(A, B, np.eye(3), E=E)
    found = evaluate(design.excess(plant, Cost(np.eye(3), [[1.0]]), theta=0.1), steps=10_000)
    assert np.isfinite(found.cost.value)
