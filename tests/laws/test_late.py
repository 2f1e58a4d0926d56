"""Packets that arrive late: the value against packets whose delay is drawn, the identity, and published references."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg as la
from drawn import law, left_out
from hypothesis import assume
from hypothesis import strategies as st
from late_packets import LateLoop, held, lasting, sampled_periods
from laws.test_given_controllers import random_loop
from measured import times
from systems import System, continuous_system, systems

from taciturn import Controller, ProblemError, UnstableError
from taciturn.base import late
from taciturn.base.late import Delays, LateValue, chain_of, delayed_problem, fourth_growth, histories, late_value
from taciturn.base.periods import Periods, discrete_periods, with_controller, with_filter
from taciturn.base.route import actuator_base
from taciturn.base.value import Attempts, advantage
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import Filter, steady_filter
from taciturn.lqg.riccati import regulate
from taciturn.lqg.sampling import sample

ALWAYS, MAYBE = {(True,): 1.0}, {(True,): 0.9, (False,): 0.1}
ONE = np.eye(1)
PLANT = np.array([[0.0, 1.0], [2.0, -0.5]]), np.array([[0.0], [1.0]]), np.diag([1.0, 0.1]), 0.1 * ONE, np.zeros((2, 1))
SLOWER = np.array([[0.0, 1.0], [0.3, -0.5]]), *PLANT[1:]
NOISE, SHOWN, PERIOD = np.diag([0.01, 0.3]), np.array([[1.0, 0.0]]), 0.3
STEPS = (
    np.array([[1.02, 0.1], [0.0, 0.98]]),
    np.array([[0.005], [0.1]]),
    np.diag([1.0, 0.1]),
    0.1 * ONE,
    np.zeros((2, 1)),
)
DRIVEN, SCALAR = np.diag([0.001, 0.01]), (1.1 * ONE, ONE, ONE, 0.1 * ONE, 0 * ONE)


def weight(Q: np.ndarray, R: np.ndarray, N: np.ndarray) -> np.ndarray:
    """Return the weight of (x, u)."""
    return np.block([[Q, N], [N.T, R]])


def lqg(plant: Periods, C: np.ndarray, V: np.ndarray, delay: float) -> tuple[Periods, np.ndarray, Filter]:
    """Return the periods of the estimate, and the gain on (x̂, û) for a constant delay below a period."""
    n = len(plant.noise)
    steady = steady_filter(plant.move(()).F[:, :n], C, plant.noise, V)
    return with_filter(plant, steady), regulate(*delayed_problem(plant, min(delay, 0.999))).L, steady


def sampled_value(plant: tuple[np.ndarray, ...], delays: list[float], chances: list[float]) -> tuple[LateValue, float]:
    """Return the value with LQG gains for the mean delay of the packets that arrive, and the period."""
    periods = sampled_periods(*plant, NOISE, PERIOD)
    base, K, _ = lqg(periods, SHOWN, 0.01 * ONE, float(np.dot(delays, chances)) / sum(chances) / PERIOD)
    return late_value(chain_of(base, K, Delays.of(delays, chances, PERIOD)), ""), PERIOD


def discrete_value(
    plant: tuple[np.ndarray, ...], W: np.ndarray, V: float, K: list[float], chances: list[float]
) -> tuple[LateValue, float]:
    """Return the value with the gain K on the estimate, for delays of 0, 1, … steps, and the length of a step."""
    base = with_filter(discrete_periods(*plant, W), steady_filter(plant[0], np.eye(1, len(W)), W, V * ONE))
    delays = Delays.of(np.arange(len(chances)), chances)
    return late_value(chain_of(base, np.array([[*K, 0.0]]), delays), ""), 1.0


@pytest.mark.parametrize(
    ("found", "cost", "growth", "fourth"),
    [
        (lambda: sampled_value(PLANT, [0.0, 0.29], [0.5, 0.5]), 0.891575, None, None),
        (lambda: sampled_value(PLANT, [0.06, 0.15, 0.27], [0.45, 0.25, 0.2]), 0.827941847, 0.5535, 0.8217),
        (lambda: sampled_value(PLANT, [0.06, 0.15, 0.27], [0.4, 0.2, 0.2]), 1.409264, None, 1.40),
        (lambda: sampled_value(SLOWER, [0.06, 0.21, 0.36, 0.45], [0.4, 0.25, 0.15, 0.1]), 0.392159461, None, None),
        (lambda: sampled_value(SLOWER, [0.06, 0.15, 0.45, 0.66], [0.4, 0.25, 0.15, 0.1]), 0.447738197, None, None),
        (lambda: discrete_value(SCALAR, ONE, 0.5, [-0.35], [0.5, 0.4]), 3.543623064, None, None),
        (lambda: discrete_value(STEPS, DRIVEN, 0.05, [-1.6, -1.9], [0.4, 0.3, 0.2]), 0.203473554, None, None),
    ],
)
def test_the_references_come_out(
    found: Callable[[], tuple[LateValue, float]], cost: float, growth: float | None, fourth: float | None
) -> None:
    """Costs per unit of time of another program, which simulations of packets confirm within their errors."""
    value, period = found()
    digits = len(f"{cost:.10g}".partition(".")[2])
    assert value.cost / period == pytest.approx(cost, abs=0.6 * 10.0**-digits)
    if growth is not None:
        assert value.growth == pytest.approx(growth, abs=6e-5)
    if fourth is not None:
        assert fourth_growth(value) == pytest.approx(fourth, abs=6e-3)
        assert (fourth_growth(value) > 1) == (fourth > 1)


def random_delays(rng: np.random.Generator, depth: int, fractions: bool, receivers: int = 1, states: int = 1) -> Delays:
    """Return a law with up to three delays, of which the first is short, and a loss; correlated with several states."""
    count = int(rng.integers(1, 4))
    delays = rng.integers(0, depth + 1, (count, receivers)) + (
        rng.choice([0.0, 0.25, 0.6], (count, receivers)) * fractions
    )
    delays[0] -= np.floor(delays[0])
    delays[rng.random(delays.shape) < 0.1 * (receivers > 1)] = np.inf
    p = rng.dirichlet(np.ones(count), states) * 0.9
    p = 0.6 * np.eye(1, count) + 0.4 * p
    turns = rng.dirichlet(np.ones(states), states)
    return Delays.of(delays if receivers > 1 else delays[:, 0], p, turns=turns if states > 1 else None)


def agrees(loop: LateLoop, value: LateValue, maybe: dict[tuple[bool, ...], float]) -> None:
    """Check cost and identity by the moments of packets, and what every value of this theory satisfies."""
    every = value.chain.every
    assume(value.growth < 0.93)
    cost, identity = lasting(loop, {every: 1.0}, value) or (np.nan, np.nan)
    assert cost == pytest.approx(value.cost, rel=1e-7)
    found = lasting(loop, maybe, value)
    if found is not None and found[0] < 1e3 * cost:
        assert found[0] == pytest.approx(found[1], rel=1e-7)
    for i, P in enumerate(value.P):
        again = sum(
            one.chance * (one.M + one.F.T @ value.P[one.after] @ one.F) for one in value.chain.outcomes[every][i]
        )
        assert np.abs(again - P).max() <= 1e-9 * np.abs(value.P).max()
        assert np.linalg.eigvalsh(P)[0] >= -1e-10 * np.abs(value.P).max()
    assert identity == value.cost
    assert not value.Psi[every].any()


def one_trace(value: LateValue) -> None:
    """Check that with one gain, noise has the same later cost in all modes of a state of the link."""
    n = len(value.chain.plant.noise)
    for link in {mode.link for mode in value.chain.modes}:
        own = [P[:n, :n] for P, mode in zip(value.P, value.chain.modes, strict=True) if mode.link == link]
        assert np.ptp([np.sum(P * value.chain.plant.noise) for P in own]) <= 1e-9 * value.cost
        assert np.abs(np.array(own) - own[0]).max() <= 1e-9 * np.abs(own[0]).max()


@law(3, 60, system=systems(states=3, inputs=2), seed=st.integers(0, 2**32 - 1), states=st.sampled_from([1, 1, 2]))
def test_a_discrete_lqg_loop_has_the_cost_of_its_packets(system: System, seed: int, states: int) -> None:
    """Also with correlated delays, for which the delay has the law of the state in which the packet was sent."""
    rng, plant, cost = np.random.default_rng(seed), system.plant, system.cost
    delays = random_delays(rng, 3 - states, False, states=states)
    periods = discrete_periods(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W)
    base, K, steady = lqg(periods, plant.C, plant.V, 0.0)
    with left_out("mean square"):
        value = late_value(chain_of(base, K, delays), "")
    gain = value.chain.gains[0]
    loop = LateLoop(
        plant.A, plant.B, weight(cost.Q, cost.R, cost.N), plant.W, plant.C, plant.V, delays, lambda _: gain,
        filter=steady.gain, receivers=(tuple(range(plant.inputs)),),
    )  # fmt: skip
    agrees(loop, value, MAYBE)
    one_trace(value)


@law(3, 60, seed=st.integers(0, 2**32 - 1))
def test_a_sampled_lqg_loop_has_the_cost_of_its_packets(seed: int) -> None:
    """With fractions of a period, several packets that arrive within one, and losses."""
    rng = np.random.default_rng(seed)
    plant, cost, h = continuous_system(seed, "wiener", 2)
    C, V, delays = rng.normal(size=(1, plant.states)), 0.1 * ONE, random_delays(rng, 2, True)
    W = plant.W + 0.01 * np.eye(plant.states)
    periods = sampled_periods(plant.A, plant.B, cost.Q, cost.R, cost.N, W, h)
    with left_out("mean square"):
        base, K, steady = lqg(periods, C, V, 0.3)
        value = late_value(chain_of(base, K, delays), "")
    gain = value.chain.gains[0]
    loop = LateLoop(
        plant.A, plant.B, weight(cost.Q, cost.R, cost.N), W, C, V, delays, lambda _: gain, h, steady.gain,
        receivers=(tuple(range(plant.inputs)),),
    )  # fmt: skip
    agrees(loop, value, MAYBE)
    one_trace(value)


@law(2, 40, seed=st.integers(0, 2**32 - 1), fractions=st.booleans())
def test_the_loop_of_a_given_controller_has_the_cost_of_its_packets(seed: int, fractions: bool) -> None:
    """The controller of a user, or an observer that believes that its commands act at once."""
    rng = np.random.default_rng(seed)
    h, delays = None, random_delays(rng, 2, fractions)
    if fractions:
        source, cost, h = continuous_system(seed, "wiener", 2)
        A, B, C, V, W = (
            source.A,
            source.B,
            rng.normal(size=(1, source.states)),
            0.1 * ONE,
            source.W + 0.01 * np.eye(source.states),
        )
        periods = sampled_periods(A, B, cost.Q, cost.R, cost.N, W, h)
        _, K, steady = lqg(periods, C, V, 0.0)
        Phi, L, n = periods.move(()).F, K[:, : source.states], source.states
        closed = Phi[:, :n] + Phi[:, n:] @ L
        told = np.eye(n) - steady.gain @ C
        kept = Controller(closed @ told, closed @ steady.gain, L @ told, L @ steady.gain)
    else:
        plant, cost, kept = random_loop(seed % 60)
        A, B, C, V, W = plant.A, plant.B, plant.C, plant.V, plant.W
        periods = discrete_periods(A, B, cost.Q, cost.R, cost.N, W)
    base, K = with_controller(periods, kept, C, V)
    with left_out("mean square"):
        value = late_value(chain_of(base, K, delays), "")
    gain, n = value.chain.gains[0], len(W)
    assert np.abs(value.silent[0][:, :n, :n]).max() <= 1e-9 * np.abs(value.P).max()  # no packet depends on x
    loop = LateLoop(
        A, B, weight(cost.Q, cost.R, cost.N), W, C, V, delays, lambda _: gain, h,
        controller=(kept.A, kept.B, kept.E), receivers=(tuple(range(B.shape[1])),),
    )  # fmt: skip
    agrees(loop, value, MAYBE)
    one_trace(value)


@law(2, 40, seed=st.integers(0, 2**32 - 1), joint=st.booleans())
def test_a_decider_may_send_to_some_of_several_receivers(seed: int, joint: bool) -> None:
    """Each receiver with its own law, or a joint law of both delays; the cost of each subset is exact."""
    rng = np.random.default_rng(seed)
    A, B, C = rng.normal(size=(2, 2)) * 0.5, rng.normal(size=(2, 2)), np.eye(2)
    W, V, S = 0.1 * np.eye(2), 0.05 * np.eye(2), np.eye(4) + 0.3 * np.diag([1.0], 3) + 0.3 * np.diag([1.0], -3)
    both = random_delays(rng, 1, True, 2)
    delays = both if joint else Delays.together([random_delays(rng, 1, True), random_delays(rng, 1, True)])
    periods = sampled_periods(A, B, S[:2, :2], S[2:, 2:], S[:2, 2:], W, 0.4)
    base, K, steady = lqg(periods, C, V, 0.3)
    with left_out("mean square"):
        value = late_value(chain_of(base, K, delays, ((0,), (1,))), "")
    gain = value.chain.gains[0]
    loop = LateLoop(A, B, S, W, C, V, delays, lambda _: gain, 0.4, steady.gain, receivers=((0,), (1,)))
    agrees(loop, value, {(True, True): 0.7, (True, False): 0.1, (False, True): 0.1, (False, False): 0.1})
    one_trace(value)


@law(2, 30, seed=st.integers(0, 2**32 - 1), states=st.sampled_from([1, 2]))
def test_a_gain_that_depends_on_the_mode_has_a_cost_of_its_change(seed: int, states: int) -> None:
    """Without ψ, the identity is wrong."""
    rng = np.random.default_rng(seed)
    A, B, Q, R, N = STEPS
    W, V, C = DRIVEN, 0.05 * ONE, SHOWN
    delays = random_delays(rng, 2, False, states=states)
    assume(delays.depth > 0)
    base = with_filter(discrete_periods(A, B, Q, R, N, W), steady := steady_filter(A, C, W, V))
    table = {ages: np.array([[*(-rng.uniform(0.4, 1.2, 2)), *rng.normal(0, 0.02, delays.depth + 1)]])
             for ages in [(), (1,), (2,), (1, 2)]}  # fmt: skip
    with left_out("mean square"):
        value = late_value(chain_of(base, lambda mode: table[mode.ages], delays), "")
    loop = LateLoop(A, B, weight(Q, R, N), W, C, V, delays, table.__getitem__, None, steady.gain, receivers=((0,),))
    agrees(loop, value, {(True,): 0.7, (False,): 0.3})
    assert np.abs(value.silent[1]).max() > 1e-6 * value.cost


def test_one_gain_for_all_modes_is_the_same_as_a_table_of_it() -> None:
    """The cost of a change of the mode, which is set to zero for one gain, comes out as zero."""
    A, B, Q, R, N = STEPS
    W, delays = (
        DRIVEN,
        Delays.of([0, 1, 2], [[0.4, 0.3, 0.2], [0.8, 0.1, 0.1]], turns=[[0.9, 0.1], [0.4, 0.6]]),
    )
    base, K, _ = lqg(discrete_periods(A, B, Q, R, N, W), SHOWN, 0.05 * ONE, 0.0)
    one, table = (late_value(chain_of(base, gain, delays), "") for gain in (K, lambda _: K))
    assert one.cost == pytest.approx(table.cost, rel=1e-12)
    assert np.abs(table.silent[1]).max() < 1e-12 * one.cost
    assert np.array_equal(one.P, table.P)


@pytest.mark.parametrize("states", [2, 3])
def test_equal_rows_of_a_chain_are_independent_delays(states: int) -> None:
    """The same modes, values and costs in each state; laws that agree are not kept apart."""
    A, B, Q, R, N = STEPS
    rng = np.random.default_rng(states)
    base, K, _ = lqg(discrete_periods(A, B, Q, R, N, DRIVEN), SHOWN, 0.05 * ONE, 0.0)
    p = [0.4, 0.3, 0.2]
    plain = late_value(chain_of(base, K, Delays.of([0, 1, 2], p)), "")
    turns = rng.dirichlet(np.ones(states), states)
    chain = late_value(chain_of(base, K, Delays.of([0, 1, 2], [p] * states, turns=turns)), "")
    assert len(chain.P) == states * len(plain.P)
    assert chain.cost == pytest.approx(plain.cost, rel=1e-11)
    assert chain.growth == pytest.approx(plain.growth, rel=1e-5)
    places = {mode.ages: i for i, mode in enumerate(plain.chain.modes)}
    for mode, P, Psi in zip(chain.chain.modes, chain.P, chain.silent[0], strict=True):
        i = places[mode.ages]
        assert np.abs(P - plain.P[i]).max() <= 1e-11 * np.abs(plain.P).max()
        assert np.abs(Psi - plain.silent[0][i]).max() <= 1e-11 * np.abs(plain.P).max()


@law(3, 40, seed=st.integers(0, 2**32 - 1), whole=st.integers(0, 2), fraction=st.sampled_from([0.0, 0.3, 0.8]))
def test_with_a_constant_delay_lqg_never_gains_by_silence(seed: int, whole: int, fraction: float) -> None:
    """Its cost is that of the delayed plant by the Riccati equation, and Ψ is e'He with the error e of the input."""
    plant, cost, h = continuous_system(seed, "wiener", 2)
    n, m, delay = plant.states, plant.inputs, whole + fraction
    W, C, V = plant.W + 0.01 * np.eye(n), np.eye(n), 0.1 * np.eye(n)
    periods = sampled_periods(plant.A, plant.B, cost.Q, cost.R, cost.N, W, h)
    steady = steady_filter(periods.move(()).F[:, :n], C, periods.noise, V)
    base, best = with_filter(periods, steady), regulate(*delayed_problem(periods, delay))
    value = late_value(chain_of(base, best.L, Delays.of([delay], [1.0])), "")
    assert value.cost == pytest.approx(base.unseen + float(np.sum(best.K[:n, :n] * base.noise)), rel=1e-9)
    largest = np.abs(value.P).max()
    for mode, Psi in zip(value.chain.modes, value.silent[0], strict=True):
        whose = np.eye(len(Psi))  # a silent step repeats the command before it, and at last û
        for age in range(whole, 0, -1):
            if age not in mode.ages:
                whose[n + (age - 1) * m : n + age * m] = whose[n + age * m : n + (age + 1) * m]
        e = (np.eye(m, len(Psi), n) - best.L) @ whose
        assert np.abs(whose.T @ Psi @ whose - e.T @ best.H @ e).max() <= 1e-8 * largest


@pytest.mark.parametrize("seed", range(3))
def test_without_delay_it_is_the_base_of_a_link_that_drops_packets(seed: int) -> None:
    """Of a given controller: cost, growth of fourth moments, and the weights of the error in silence."""
    plant, cost, kept = random_loop(seed)
    base = actuator_base(discretise(plant, cost, None), kept)
    found = advantage(base, "", Attempts(losses=np.array([0.02])))
    periods = discrete_periods(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W)
    value = late_value(chain_of(*with_controller(periods, kept, plant.C, plant.V), Delays.of([0.0], [0.98])), "")
    assert value.cost == pytest.approx(found.cost, rel=1e-9)
    assert found.fourth is not None
    assert fourth_growth(value) == pytest.approx(found.fourth, rel=1e-3)
    n, p, k = plant.states, plant.outputs, len(kept.A)
    order = [*range(n), *range(n + k, n + k + p), *range(n, n + k)]  # (x, y, controller) of (x, controller, y)
    K = base.K[:, order]
    e = np.hstack([-K, np.eye(len(K))])
    half = e.T @ np.hstack([found.slope[0, 0][:, order], np.zeros((len(K),) * 2)])
    expected = e.T @ found.H[0, 0] @ e + half + half.T
    assert value.silent[0][0] == pytest.approx(expected, abs=1e-9 * np.abs(value.P).max())


def test_a_mode_that_the_cost_does_not_see_may_last() -> None:
    """A controller with a state that it only adds up, and a set-point that the loop follows, change no number."""
    A, B, Q, R, N = STEPS
    W, V, delays = DRIVEN, 0.05 * ONE, Delays.of([0, 1, 2], [0.5, 0.3, 0.1])
    periods = discrete_periods(A, B, Q, R, N, W)
    plain, whole = (
        Controller([[0.6]], [[0.4]], [[0.8]], [[-2.0]]),
        Controller([[0.6, 0], [0, 1]], [[0.4], [1.0]], [[0.8, 0]], [[-2.0]]),
    )
    values = [late_value(chain_of(*with_controller(periods, one, SHOWN, V), delays), "") for one in (plain, whole)]
    assert values[1].cost == pytest.approx(values[0].cost, rel=1e-9)
    assert values[1].growth == pytest.approx(values[0].growth, rel=1e-4)
    for i, P in enumerate(values[1].P):
        assert np.delete(np.delete(P, 4, 0), 4, 1) == pytest.approx(values[0].P[i], rel=1e-6, abs=1e-9)
    X, U = np.array([[1.0], [-0.02 / 0.101]]), np.array([[-0.004 / 0.101]])  # at rest at the set-point r
    T, steady = (
        np.block([[np.eye(2), -X, np.zeros((2, 1))], [np.zeros((1, 2)), -U, ONE]]),
        steady_filter(A, SHOWN, W, V),
    )
    S = T.T @ weight(Q, R, N) @ T
    base, K, _ = lqg(periods, SHOWN, V, 0.0)
    more = discrete_periods(
        la.block_diag(A, 1.0), np.vstack([B, 0]), S[:3, :3], S[3:, 3:], S[:3, 3:], np.pad(W, (0, 1))
    )
    known = replace(steady, prior=np.pad(steady.prior, (0, 1)), posterior=np.pad(steady.posterior, (0, 1)))
    follows = np.hstack([K[:, :2], U - K[:, :2] @ X, K[:, 2:]])
    one, other = (
        late_value(chain_of(base, K, delays), ""),
        late_value(chain_of(with_filter(more, known), follows, delays), ""),
    )
    assert other.cost == pytest.approx(one.cost, rel=1e-9)
    assert other.growth == pytest.approx(one.growth, rel=1e-4)


def test_a_long_period_and_its_pieces_keep_their_digits() -> None:
    """The pieces of a stiff plant over a long period add up to the sampled plant; equal inputs change nothing."""
    A, B = (
        np.array([[-1.0, 1.0, 0.0], [0.0, 0.5, 1.0], [0.0, 0.0, -300.0]]),
        np.array([[0.0, 1.0], [0.0, 0.0], [300.0, 0.0]]),
    )
    Q, R, N, W = np.eye(3), np.eye(2), 0.1 * np.ones((3, 2)), np.diag([0.1, 0.2, 3.0])
    plain, periods = sample(A, B, Q, R, N, W, 4.0), sampled_periods(A, B, Q, R, N, W, 4.0)
    whole = np.block([[plain.Q, plain.N], [plain.N.T, plain.R]])
    assert periods.noise == pytest.approx(plain.W, rel=1e-12)
    assert periods.unseen == pytest.approx(plain.noise_cost, rel=1e-12)
    for fractions in ((), (0.0,), (0.3,), (0.01, 0.5, 0.999)):
        F, M = periods.move(fractions)
        T = la.block_diag(np.eye(3), np.vstack([np.eye(2)] * (len(fractions) + 1)))
        assert np.allclose(F @ T, np.hstack([plain.A, plain.B]), rtol=1e-12, atol=0)
        assert np.allclose(T.T @ M @ T, whole, rtol=1e-12, atol=0)
        assert np.linalg.eigvalsh(M)[0] >= -1e-13 * np.abs(M).max()


def walk(
    value: LateValue, plant: tuple[np.ndarray, ...], delays: list[float], p: list[float], theta: float
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate packets in continuous time; return the means and errors of the rate, the identity, and its misses."""
    A, B, Q, R, _ = plant
    rng, count, steps, substeps, K = np.random.default_rng(7), 400, 250 * times(), 10, value.chain.gains[0]
    h, D, far = PERIOD, value.chain.delays.depth, 10**9
    pieces = held(A, B, np.zeros((3, 3)), NOISE, h / substeps)
    Phi, Gamma, root = *pieces[:2], np.linalg.cholesky(pieces[3])
    # the stage of a piece, exactly: the weight of (x, u), and the cost of its own noise, which no input changes
    _, _, S, _, c = held(A, B, la.block_diag(Q, R), NOISE, h / substeps)
    steady = steady_filter(held(A, B, S, NOISE, h)[0], SHOWN, held(A, B, S, NOISE, h)[3], 0.01 * ONE)
    places = {mode.ages: i for i, mode in enumerate(value.chain.modes)}
    table = np.array([places.get(tuple(j + 1 for j in range(D) if bits >> j & 1), 0) for bits in range(2**D)])
    lasts = np.append(np.round(np.array(delays) / h * substeps), far)
    x = rng.normal(size=(count, 2)) @ np.linalg.cholesky(steady.posterior).T
    estimate, u, registers = np.zeros((count, 2)), np.zeros((count, 1)), np.zeros((count, D + 1, 1))
    due, newest = np.full((count, D + 1), far), np.full(count, -far)
    cost, saved, sent, begin = np.zeros(count), np.zeros(count), np.zeros(count), 50
    Psi, delta = value.silent[0], theta * value.cost
    for k in range(begin + steps):
        registers[:, 1:], due[:, 1:] = registers[:, :-1].copy(), due[:, :-1].copy()
        waits = [(due[:, j] >= k * substeps) & (due[:, j] < 2 * far) & (k - j > newest) for j in range(1, D + 1)]
        mode = table[sum(one.astype(int) << j for j, one in enumerate(waits))]
        z = np.hstack([estimate, registers[:, 1:, 0], u])
        silence = np.einsum("pi,pij,pj->p", z, Psi[mode], z)
        sends = silence > delta
        registers[:, 0] = np.where(sends[:, None], z @ K.T, u)
        drawn = lasts[rng.choice(len(lasts), count, p=[*p, 1 - sum(p)])]
        due[:, 0] = np.where(sends, np.minimum(k * substeps + drawn, far), 2 * far)
        for i in range(substeps):
            for j in range(D, -1, -1):
                acts = (due[:, j] == k * substeps + i) & (k - j > newest)
                u[acts], newest[acts] = registers[acts, j], k - j
            if k >= begin:
                both = np.hstack([x, u])
                cost += np.einsum("pi,ij,pj->p", both, S, both) + c
            estimate = estimate @ Phi.T + u @ Gamma.T
            x = x @ Phi.T + u @ Gamma.T + rng.normal(size=(count, 2)) @ root.T
        y = x @ SHOWN.T + 0.1 * rng.normal(size=(count, 1))
        estimate = estimate + (y - estimate @ SHOWN.T) @ steady.gain.T
        if k >= begin:
            saved += np.where(sends, 0.0, silence)
            sent += sends
    found = np.array([sent, value.cost * steps + saved, cost - value.cost * steps - saved]) / steps
    return found.mean(axis=1), found.std(axis=1) / np.sqrt(count)


def test_the_identity_is_the_cost_of_a_simulation_in_continuous_time() -> None:
    """Delays of up to three periods and losses; the rule reaches the rate and the cost of the reference."""
    delays, p = [0.06, 0.15, 0.45, 0.66], [0.4, 0.25, 0.15, 0.1]
    value, _ = sampled_value(SLOWER, delays, p)
    mean, error = walk(value, SLOWER, delays, p, 0.4)
    assert (np.abs(mean - [0.6548, 0.464184 * PERIOD, 0.0]) < 4.5 * error).all()
    assert (error < [0.004, 0.0001, 0.02 * value.cost]).all()


def test_acknowledgements_one_step_late_leave_histories_to_weigh() -> None:
    """With the likelihood of the measurement, the believed cost of silence is the true one; without it, it is not."""
    W, V, C = ONE, 0.5 * ONE, ONE
    plant = discrete_periods(1.1 * ONE, ONE, ONE, 0.1 * ONE, 0 * ONE, W)
    base, K = with_controller(plant, Controller([[0.7]], ONE, [[-0.05]], [[-0.35]]), C, V)
    value = late_value(chain_of(base, K, Delays.of([0, 1], [0.5, 0.4])), "")
    assert value.cost == pytest.approx(3.159125595, abs=1e-9)
    steady, chain, Psi = steady_filter(1.1 * ONE, C, W, V), value.chain, value.silent[0]
    for sent in chain.outcomes:
        for i in range(len(chain.modes)):
            found = histories(chain, i, sent)
            assert sum(one.chance for one in found) == pytest.approx(1.0)
            for one in found:  # x⁺ = 1.1 x + the input that acts last
                assert one.F[0] == pytest.approx(1.1 * np.eye(5)[0] + one.inputs[-1, 0])
                assert one.F[-1] == pytest.approx(one.inputs[-1, 0])
    gaps = {}
    for weighs in (True, False):
        rng, count, steps, delta = np.random.default_rng(3), 1500, 150 * times(), 0.3 * value.cost
        z, known, mode = np.zeros((count, 5)), np.zeros(count), np.zeros(count, int)  # z = (x, y, xc, u⁻, û)
        believed, true, before = np.zeros(count), np.zeros(count), None
        for k in range(steps):
            seen = z.copy()
            seen[:, 0] = known
            cost = np.einsum("pi,pij,pj->p", seen, Psi[mode], seen)
            guess = cost
            if before is not None:
                old, old_known, old_mode, old_sends = before
                total, mean = np.zeros(count), np.zeros(count)
                for i in range(len(chain.modes)):
                    for sends in (True, False):
                        own = (old_mode == i) & (old_sends == sends)
                        for one in histories(chain, i, (sends,)):
                            then = old[own] @ one.F.T
                            prior = 1.1 * old_known[own] + old[own] @ one.inputs[-1, 0]
                            gap = z[own, 1] - prior
                            likely = np.exp(-0.5 * gap**2 / steady.innovation[0, 0]) if weighs else 1.0
                            then[:, 0], then[:, 1:3] = prior + steady.gain[0, 0] * gap, z[own, 1:3]
                            form = np.einsum("pi,ij,pj->p", then, Psi[one.after], then)
                            total[own] += one.chance * likely
                            mean[own] += one.chance * likely * form
                guess = mean / total
            sends = guess > delta
            if k >= 50:
                believed, true = believed + np.where(sends, 0.0, guess), true + np.where(sends, 0.0, cost)
            before = z.copy(), known.copy(), mode.copy(), sends.copy()
            step, after, acts, draws = np.zeros_like(z), np.zeros(count, int), np.zeros(count), rng.random(count)
            for i in range(len(chain.modes)):
                for goes in (True, False):
                    low = 0.0
                    for one in histories(chain, i, (goes,)):
                        own = (mode == i) & (sends == goes) & (draws >= low) & (draws < low + one.chance + 1e-15)
                        low += one.chance
                        step[own], after[own], acts[own] = z[own] @ one.F.T, one.after, z[own] @ one.inputs[-1, 0]
            noise = rng.normal(size=count)
            step[:, 0] += noise
            step[:, 1] = step[:, 0] + np.sqrt(0.5) * rng.normal(size=count)
            prior = 1.1 * known + acts
            known, z, mode = prior + steady.gain[0, 0] * (step[:, 1] - prior), step, after
        off = (believed - true) / (steps - 50)
        gaps[weighs] = float(off.mean()), float(off.std() / np.sqrt(count))
    assert abs(gaps[True][0]) < 4.5 * gaps[True][1]
    assert abs(gaps[False][0]) > 5 * gaps[False][1]


def test_delays_are_counted_in_periods_and_the_rest_is_lost() -> None:
    """Rounding of a quotient makes no fraction; a fate without probability is none; independent laws multiply."""
    delays = Delays.of([0.3 * 3, 0.1, np.inf, 0.5], [0.5, 0.2, 0.1, 0.0], 0.3)
    assert delays.fates == ((((3, 0.0)),), ((0, pytest.approx(1 / 3)),), (None,), (None,))
    assert delays.chances.tolist() == [[0.5, 0.2, 0.1, pytest.approx(0.2)]]
    assert delays.depth == 3
    both = Delays.together([delays, Delays.of([1], [1.0])])
    assert both.receivers == 2
    assert both.fates[0] == ((3, 0.0), (1, 0.0))
    assert both.chances.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda: Delays.of([0, 1], [0.5]), "one for each of the 2 delays"),
        (lambda: Delays.of([0, -1], [0.5, 0.5]), "expected numbers of at least 0"),
        (lambda: Delays.of([0, 1], [0.5, 0.6]), "with a sum of at most 1"),
        (lambda: Delays.of([0], [[1], [1]], turns=np.eye(2)), "one group of states that the link never leaves"),
        (lambda: Delays.of([0], [1.0], 0.0), "period is 0; expected 0 < period"),
    ],
)
def test_a_wrong_law_is_refused(made: Callable[[], Delays], words: str) -> None:
    """In one sentence with the given value and the expected one."""
    with pytest.raises(ProblemError, match=words):
        made()


def test_a_base_is_refused_that_has_no_value() -> None:
    """Unstable loops, too many packets, delays below a step of a discrete plant, and wrong gains and receivers."""
    A, B, Q, R, N = STEPS
    base, K, _ = lqg(discrete_periods(A, B, Q, R, N, DRIVEN), SHOWN, 0.05 * ONE, 0.0)
    fast, gain, _ = lqg(discrete_periods(2.0 * ONE, ONE, ONE, ONE, 0 * ONE, ONE), ONE, ONE, 0.0)
    with pytest.raises(UnstableError, match=r"grows by a factor of 2\..*expected a factor below 1.*or other gains"):
        late_value(chain_of(fast, gain, Delays.of([0, 1], [0.4, 0.2])), "other gains")
    with pytest.raises(ProblemError, match="up to 12 periods late are in flight in more than 512 different sets"):
        chain_of(base, K, Delays.of([0, 12], [0.8, 0.1]))
    with pytest.raises(ProblemError, match=r"0\.5 periods after a sample.*expected delays of whole steps"):
        chain_of(base, K, Delays.of([0.5], [0.8]))
    with pytest.raises(ProblemError, match=r"gain has the shape \(1, 2\); expected \(1, 3\)"):
        chain_of(base, K[:, :2], Delays.of([0, 1], [0.5, 0.4]))
    with pytest.raises(ProblemError, match="expected each of the 1 input at one receiver"):
        chain_of(base, K, Delays.of([0], [1.0]), ((0,), (0,)))
    told = Controller([[0.5]], ONE, ONE, ONE, ONE)
    plant, own = with_controller(sampled_periods(*PLANT, NOISE, PERIOD), told, SHOWN, ONE)
    with pytest.raises(
        ProblemError, match=r"controller.E.*expected delays of whole periods, or a controller with E = 0"
    ):
        chain_of(plant, own, Delays.of([0.5], [1.0]))
    wide = discrete_periods(0.5 * np.eye(70), np.eye(70, 1), np.eye(70), ONE, np.zeros((70, 1)), np.eye(70))
    with pytest.raises(ProblemError, match=r"72 states together, in 2 modes, too many"):
        late_value(chain_of(wide, np.zeros((1, 71)), Delays.of([0, 1], [0.5, 0.5])), "")
    some = discrete_periods(0.5 * np.eye(26), np.eye(26, 1), np.eye(26), ONE, np.zeros((26, 1)), np.eye(26))
    with pytest.raises(ProblemError, match="fourth moments, with packets of up to 1 period"):
        fourth_growth(late_value(chain_of(some, np.zeros((1, 27)), Delays.of([0, 1], [0.5, 0.5])), ""))
    assert late.MOST_MODES == 2**9
