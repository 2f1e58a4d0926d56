"""Registers, and modes marginally stable that no cost and input, or no noise and measurement, touches."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest
from catalogue import POLICIES, Build, outputs
from digits import regulated
from drawn import law, left_out, rows
from hypothesis import assume
from hypothesis import strategies as st
from systems import System, make_system

from taciturn import ContinuousPlant, Cost, Network, Plant, close, design
from taciturn._modes import radius
from taciturn._rational import Limit, unmoved
from taciturn.analyse.switched import switched
from taciturn.errors import UnstableError
from taciturn.lqg.equation import accumulate
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.riccati import regulate, regulate_continuous
from taciturn.program.ops import Entry

seeds = st.integers(0, 2**32 - 1)


def off(found: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest error of a semidefinite matrix, each variable in the unit that makes its diagonal 1."""
    unit = np.sqrt(np.diag(exact))
    return float(np.abs((found - exact) / unit / unit[:, None]).max())


def within(found: np.ndarray, exact: np.ndarray, claim: np.ndarray) -> bool:
    """Tell whether found − exact lies between ∓ claim, but for the rounding of sixty digits to sixteen."""
    unit = np.sqrt(np.maximum(np.diag(exact), 1e-12 * np.trace(exact) + 1e-30))
    claimed, error = (part / unit / unit[:, None] for part in (claim, found - exact))
    return min(np.linalg.eigvalsh(claimed + sign * error)[0] for sign in (-1, 1)) > -1e-14


def delayed(draw, seed: int, inputs: int, outputs: int) -> tuple[np.ndarray, ...]:
    """Return A, B, C of a random plant with delays of input and output written as states, and how many are the plant's.

    Its states come first, then the registers of its inputs, the latest at the end, then those of its outputs.
    """
    c = draw(seed)
    n, m, p = len(c.A), c.B.shape[1], len(c.C)
    size = n + m * inputs + p * outputs
    A, B, C, last = np.zeros((size, size)), np.zeros((size, m)), np.zeros((p, size)), n + m * inputs
    A[:n, :n] = c.A
    for k in range(inputs):
        row = slice(n + m * (k - 1), n + m * k) if k else slice(0, n)
        A[row, n + m * k : n + m * (k + 1)] = np.eye(m) if k else c.B
    B[slice(last - m, last) if inputs else slice(0, n)] = np.eye(m) if inputs else c.B
    for k in range(outputs):
        column = slice(last + p * (k - 1), last + p * k) if k else slice(0, n)
        A[last + p * k : last + p * (k + 1), column] = np.eye(p) if k else c.C
    C[:, slice(size - p, size) if outputs else slice(0, n)] = np.eye(p) if outputs else c.C
    return A, B, C, n


@law(3, 300, seed=seeds, inputs=st.integers(0, 4), outputs=st.integers(0, 4), noise=st.booleans())
def test_plants_with_registers_are_designed_to_what_is_claimed(draw, seed, inputs, outputs, noise):
    """No noise on registers, or nowhere: the prior covariance is as near to that of sixty digits as the filter says."""
    A, _, C, n = delayed(draw, seed, inputs, outputs)
    assume(np.abs(np.abs(np.linalg.eigvals(A[:n, :n])) - 1).min() > 0.05)
    assume(len(A) <= 14)  # sixty digits take minutes of more states
    c = draw(seed)
    W = np.zeros((len(A), len(A)))
    W[:n, :n] = c.W * noise
    found = steady_filter(A, C, W, c.V)
    exact, _ = regulated(A.T, C.T, W, c.V, np.zeros(C.T.shape), -(A @ found.gain).T)
    assert within(found.prior, exact, found.error)
    assert found.slowest < 1


@law(3, 300, seed=seeds, inputs=st.integers(1, 30))
def test_a_delayed_input_costs_what_the_predictor_says(draw, seed, inputs):
    """K of registers is the sum over the delay, then K of the plant at the state predicted from them."""
    A, B, _, n = delayed(draw, seed, inputs, 0)
    c, m = draw(seed), B.shape[1]
    assume(len(A) <= 40)
    Q = np.zeros((len(A), len(A)))
    Q[:n, :n] = c.Q
    found, plain = regulate(A, B, Q, c.R, np.zeros(B.shape)), regulate(c.A, c.B, c.Q, c.R, np.zeros((n, m)))
    exact, ahead = np.zeros_like(Q), np.eye(len(A))
    for _ in range(inputs):
        exact += ahead.T @ Q @ ahead
        ahead = A @ ahead
    predicted = ahead[:n]
    exact += predicted.T @ plain.K @ predicted
    assert pytest.approx(plain.L @ predicted, rel=1e-8, abs=1e-8 * np.abs(found.L).max()) == found.L
    assert off(found.K, exact) < 1e-8


@law(3, 300, seed=seeds, inputs=st.integers(1, 30))
def test_a_delayed_input_with_a_cross_term_costs_what_the_predictor_says(draw, seed, inputs):
    """The weights [[Q, N], [N', R]] are those of state and applied input, so that what is sent has none of its own."""
    A, B, _, n = delayed(draw, seed, inputs, 0)
    c, m = draw(seed), B.shape[1]
    assume(len(A) <= 40)
    Q = np.zeros((len(A), len(A)))
    Q[: n + m, : n + m] = np.block([[c.Q, c.N], [c.N.T, c.R]])
    found, plain = regulate(A, B, Q, np.zeros((m, m)), np.zeros(B.shape)), regulate(c.A, c.B, c.Q, c.R, c.N)
    exact, ahead = np.zeros_like(Q), np.eye(len(A))
    for _ in range(inputs):
        exact += ahead.T @ Q @ ahead
        ahead = A @ ahead
    exact += ahead[:n].T @ plain.K @ ahead[:n]
    assert pytest.approx(plain.L @ ahead[:n], rel=1e-8, abs=1e-8 * np.abs(found.L).max()) == found.L
    assert off(found.K, exact) < 1e-8


@law(2, 100, seed=seeds, inputs=st.integers(0, 3), outputs=st.integers(0, 3))
def test_registers_with_a_cross_term_are_regulated_to_what_is_claimed(draw, seed, inputs, outputs):
    """Some registers are weighed, with an input at once, others not at all: K as near to sixty digits as it says."""
    A, B, _, n = delayed(draw, seed, inputs, outputs)
    assume(1 < len(A) <= 10)
    c, m = draw(seed), B.shape[1]
    weighed = np.append(c.rng.random(len(A)) < 0.5, np.ones(m)) * np.append(np.ones(n), c.rng.random(len(A) + m - n))
    root = c.rng.normal(size=(len(A) + m, len(A) + m)) * weighed[:, None]
    root[:n, -n:] += np.eye(n)  # the plant itself is seen
    joint = root @ root.T
    Q, R, N = joint[: len(A), : len(A)], joint[len(A) :, len(A) :] + 0.1 * np.eye(m), joint[: len(A), len(A) :]
    found = regulate(A, B, Q, R, N)
    exact, _ = regulated(A, B, Q, R, N, found.L)
    assert within(found.K, exact, found.error)
    assert found.slowest < 1


@law(3, 200, seed=seeds, inputs=st.integers(0, 10), outputs=st.integers(0, 10))
def test_units_of_registers_decide_nothing(draw, seed, inputs, outputs):
    """States, inputs and outputs in units from 1e-8 to 1e8: gain and covariances are the same, in these units."""
    A, B, C, n = delayed(draw, seed, inputs, outputs)
    assume(np.abs(np.abs(np.linalg.eigvals(A[:n, :n])) - 1).min() > 0.05)
    assume(len(A) <= 40)
    c = draw(seed)
    Q, W = np.zeros((2, len(A), len(A)))
    Q[:n, :n], W[:n, :n] = c.Q, c.W
    N = np.zeros(B.shape)
    N[:n] = c.N
    x, u, y = (np.exp2(c.rng.integers(-26, 27, size)) for size in (len(A), B.shape[1], len(C)))
    A_x, B_x, C_x = A / x[:, None] * x, B / x[:, None] * u, C / y[:, None] * x
    plain = regulate(A, B, Q, c.R, N), steady_filter(A, C, W, c.V)
    R_x, N_x = c.R * u * u[:, None], N * x[:, None] * u
    found = (
        regulate(A_x, B_x, Q * x * x[:, None], R_x, N_x),
        steady_filter(A_x, C_x, W / x / x[:, None], c.V / y / y[:, None]),
    )
    cost, spread = found[0].K / x / x[:, None], found[1].prior * x * x[:, None]
    for answer, exact, which in ((cost, plain[0].K, plain[0].error), (spread, plain[1].prior, plain[1].error)):
        some = np.diag(exact) > 0
        place = np.ix_(some, some)
        assert ((np.diag(answer) > 0) == some).all()
        assert off(answer[place], exact[place]) < 1e-10 + 2 * (np.diag(which)[some] / np.diag(exact)[some]).max()


@law(4, 300, seed=seeds, inputs=st.integers(0, 15), outputs=st.integers(0, 15))
def test_units_of_registers_decide_no_mode(draw, seed, inputs, outputs):
    """States and inputs in units from 1e-8 to 1e8: every mode of the plant is moved and measured through registers."""
    A, B, C, n = delayed(draw, seed, inputs, outputs)
    A[:n, :n] *= 1.2 / radius(A[:n, :n])
    rng = draw(seed).rng
    x, u, y = (np.exp2(rng.integers(-26, 27, size)) for size in (len(A), B.shape[1], len(C)))
    scaled = A / x[:, None] * x
    assert not unmoved(scaled, B / x[:, None] * u, Limit(False)).lasting.size
    assert not unmoved(scaled.T, (C / y[:, None] * x).T, Limit(False)).lasting.size


@law(3, 200, seed=seeds, inputs=st.integers(0, 15), outputs=st.integers(0, 15))
def test_the_cost_of_registers_is_that_of_their_stationary_second_moments(draw, seed, inputs, outputs):
    """tr(KW) is tr(MX), M the stage cost of the closed loop and X = Σ F^k W F'^k, nilpotent parts included.

    Where the powers of F first grow too much for sixteen digits, the sum is refused, and its examples do not count.
    """
    A, B, _, n = delayed(draw, seed, inputs, outputs)
    assume(len(A) <= 60)
    c = draw(seed)
    Q, W = np.zeros((2, len(A), len(A)))
    Q[:n, :n], W[:n, :n] = c.Q, c.W
    N = np.zeros(B.shape)
    N[:n] = c.N
    found = regulate(A, B, Q, c.R, N)
    with left_out("could not be proved"):
        X = accumulate(A + B @ found.L, W)
    stage = Q + N @ found.L + found.L.T @ N.T + found.L.T @ c.R @ found.L
    doubt = np.sum(found.error * W) / np.sum(found.K * W)
    assert np.sum(stage * X) == pytest.approx(np.sum(found.K * W), rel=1e-9 + 10 * doubt)


def test_a_chain_of_registers_without_noise_has_second_moments_of_exactly_zero():
    """Nothing is left of a start after as many steps as there are registers."""
    assert not accumulate(np.eye(30, k=1), np.zeros((30, 30))).any()
    assert np.array_equal(accumulate(np.eye(30, k=1), np.diag(np.eye(30)[-1])), np.eye(30))


def test_a_disturbance_that_the_cost_does_not_see_is_left_alone():
    """A constant that nothing drives: K and L are 0 along it; where the cost sees it, the cost is infinite."""
    A, B, N = np.array([[1.1, 0.0], [0.0, 1.0]]), np.array([[1.0], [0.0]]), np.zeros((2, 1))
    found, alone = (
        regulate(A, B, np.diag([1.0, 0.0]), [[1.0]], N),
        regulate([[1.1]], [[1.0]], [[1.0]], [[1.0]], [[0.0]]),
    )
    assert pytest.approx(np.diag([alone.K[0, 0], 0.0])) == found.K
    assert pytest.approx(np.array([[alone.L[0, 0], 0.0]])) == found.L
    assert found.slowest == pytest.approx(alone.slowest)
    for seen in (np.eye(2), np.diag([1.0, 0.0])):
        A[0, 1] = 1.0
        with pytest.raises(UnstableError, match="so that the cost is infinite"):
            regulate(A, B, seen, [[1.0]], N)


def test_a_plant_whose_loop_is_slow_leaves_a_disturbance_alone_as_well():
    """A mode at 1 − 1e-6 that the cost sees is not taken for the constant that it does not see."""
    A, B = np.diag([0.5, 1 - 1e-6, 1.0]), np.array([[1.0], [0.0], [0.0]])
    found = regulate(A, B, np.diag([1.0, 1.0, 0.0]), [[1.0]], np.zeros((3, 1)))
    assert found.slowest == pytest.approx(1 - 1e-6)
    assert found.K[1, 1] == pytest.approx(1 / (1 - (1 - 1e-6) ** 2), rel=1e-6)


def test_what_neither_noise_nor_measurement_touches_is_known_as_well_as_at_the_start():
    """By duality covariance and gain are 0; where only noise or only a measurement reaches it there is no filter."""
    A, C = np.diag([1.1, 1.0]), np.array([[1.0, 0.0]])
    found, alone = steady_filter(A, C, np.diag([1.0, 0.0]), [[1.0]]), steady_filter([[1.1]], [[1.0]], [[1.0]], [[1.0]])
    assert pytest.approx(np.diag([alone.prior[0, 0], 0.0])) == found.prior
    assert pytest.approx(np.array([[alone.gain[0, 0]], [0.0]])) == found.gain
    assert found.slowest == pytest.approx(alone.slowest)
    calm = steady_filter(A, C, np.zeros((2, 2)), [[0.0]])
    assert not calm.gain[1].any()
    assert abs(1.1 - 1.1 * calm.gain[0, 0]) < 1
    with pytest.raises(UnstableError, match="which C does not observe; it lies on the unit circle and noise W"):
        steady_filter(A, C, np.eye(2), [[1.0]])
    with pytest.raises(UnstableError, match="which the noise W does not reach"):
        steady_filter(A, np.ones((1, 2)), np.diag([1.0, 0.0]), [[1.0]])


def more(system: System, kind: str) -> System:
    """Return a system with states that its cost does not see and its inputs do not move.

    ``clock``: three registers in a ring, which nothing touches; ``drift``: a random walk of the first sensor; ``walk``:
    one that the whole measured state shows; ``odometer``: the sum of the states.
    """
    plant, cost = system.plant, system.cost
    n, k = plant.states, 3 if kind == "clock" else 1
    A, W, Q = np.zeros((3, n + k, n + k))
    A[:n, :n], W[:n, :n], Q[:n, :n] = plant.A, plant.W, cost.Q
    A[n:, n:] = np.roll(np.eye(k), 1, axis=0)
    B, N, C = (
        np.pad(part, ((0, rows), (0, columns)))
        for part, rows, columns in ((plant.B, k, 0), (cost.N, k, 0), (plant.C, 0, k))
    )
    if kind in ("drift", "walk"):
        W[n, n] = 0.01
    if kind == "drift":
        C[0, n] = 1.0
    if kind == "odometer":
        A[n, :n] = 1.0
    made = Plant(A, B, W) if plant.full_state else Plant(A, B, W, C, plant.V)
    return System(made, Cost(Q, cost.R, N), system.seed)


BEYOND = (
    "relative",
    "mixed",
    "dynamic",
    "separate",
    "pattern",
    "near-optimal",
    "variance",
    "lossy",
)  # of Q > 0, or slow
KINDS = [
    (kind, name)
    for kind in ("clock", "drift", "walk")
    for name in POLICIES
    if not any(word in name for word in BEYOND) and (kind, name[:6]) != ("drift", "remote")  # never repeats its queries
]


@pytest.mark.parametrize(("kind", "name"), rows(KINDS, 6))
def test_every_policy_leaves_alone_what_its_cost_does_not_see(kind, name):
    """Cost of every sample, bound and memory are those of the plant without it, if it does not blur what is seen."""
    build: Build = POLICIES[name]
    system = make_system(5, 3, 2, 3, True, 2) if kind == "walk" else make_system(7, 2, 1, 1, False, 2)
    policy, plain = build(more(system, kind)), build(system)
    shown = outputs(policy, 3)
    assert np.isfinite(shown[Entry("applied", 0)]).all()
    if kind == "drift":
        assert policy.cost_all_time > plain.cost_all_time  # the drift of a sensor hides the plant from it
        return
    if "remote" not in name or policy.cost is None or not policy.cost.mission:  # whose starts are drawn for the plant
        assert policy.cost_all_time == pytest.approx(plain.cost_all_time, rel=1e-9)
        assert policy.theory.settling == pytest.approx(plain.theory.settling, rel=1e-6)
    entries = sqrt(policy.model.outputs / plain.model.outputs)  # the error of a dead band has one for each output
    for link, error in plain.theory.errors.items():
        assert policy.theory.errors[link].gain == pytest.approx(error.gain, rel=1e-6)
        assert policy.theory.errors[link].largest == pytest.approx(error.largest * entries)
    longer = entries > 1 and bool(plain.theory.errors)
    if policy.guarantee and plain.guarantee and not policy.cost.mission and not longer:
        assert policy.guarantee.cost == pytest.approx(plain.guarantee.cost, rel=1e-8)


@pytest.mark.parametrize("protocol", ["udp", "tcp"])
@pytest.mark.parametrize("horizon", [None, 20])
def test_losses_do_not_concern_what_the_cost_does_not_see(protocol, horizon):
    """Fixed point, recursion and memory of the gains over lossy links are those of the plant without a random walk."""
    small = make_system(5, 3, 2, 3, True, 2)
    found, plain = (
        design.lossy_lqg(
            one.plant, Cost(one.cost.Q, one.cost.R, horizon=horizon), price=1.0, network=Network(protocol, 0.1, 0.2)
        )
        for one in (more(small, "walk"), small)
    )
    assert found.cost_all_time == pytest.approx(plain.cost_all_time, rel=1e-9)
    assert found.theory.settling == pytest.approx(plain.theory.settling, rel=1e-9)


@pytest.mark.parametrize("kind", ["excess", "periodic", "lqg", "consistent"])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_continuous_plant_may_have_an_oscillator_that_nothing_drives_or_weighs(kind, noise):
    """Undamped at 2 rad/s: what sending every sample costs is what it costs without it, held or predicted."""
    A = np.array([[0, 1.0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 2.0], [0, 0, -2.0, 0]])
    B, Q, W = np.eye(4)[:, 1:2], np.diag([1.0, 1.0, 0, 0]), np.diag([0, 1.0, 0, noise])
    build = {
        "excess": lambda plant, cost: design.excess(plant, cost, delta=0.3, period=0.1),
        "periodic": lambda plant, cost: design.periodic(plant, cost, period=0.2, actuation="model"),
        "lqg": lambda plant, cost: design.lqg(plant, cost, theta=0.3, period=0.1),
        "consistent": lambda plant, cost: design.consistent(plant, cost, delta=0.3, period=0.1),
    }[kind]
    found, plain = (build(ContinuousPlant(A[:n, :n], B[:n], W[:n, :n]), Cost(Q[:n, :n], [[0.1]])) for n in (4, 2))
    assert found.cost_all_time == pytest.approx(plain.cost_all_time, rel=1e-9)
    assert found.theory.settling == pytest.approx(plain.theory.settling, rel=1e-6)
    gain = regulate_continuous(A, B, Q, [[0.1]], np.zeros((4, 1))).L
    assert not gain[:, 2:].any()
    A[1, 2] = 1.0
    with pytest.raises(
        UnstableError, match=r"0[+-]2i, which is uncontrollable through B; this mode lies on the imaginary axis"
    ):
        regulate_continuous(A, B, Q, [[0.1]], np.zeros((4, 1)))


def test_a_disturbance_that_an_average_cannot_bear_is_no_harm_to_a_mission():
    """A constant push costs R d² in each step for ever: a horizon or a discount makes a finite cost of it."""
    plant = Plant([[0.9, 1.0], [0.0, 1.0]], [[1.0], [0.0]], np.diag([0.1, 0.0]), mean=[0.0, 1.0])
    weights = np.diag([1.0, 0.0]), [[1.0]]
    with pytest.raises(UnstableError, match="so that the cost is infinite"):
        design.excess(plant, Cost(*weights), delta=0.1)
    discounted = design.remote_lqg(plant, Cost(*weights, discount=0.9), controller="sensor", theta=0.3)
    finite = design.remote_lqg(plant, Cost(*weights, horizon=30), controller="sensor", theta=0.3)
    for policy in (discounted, finite):
        calm = Plant(plant.A, plant.B, plant.W)
        without = design.remote_lqg(calm, policy.cost, controller="sensor", theta=0.3)
        assert policy.cost_all_time > without.cost_all_time


def test_an_integrator_that_nothing_measures_or_disturbs_is_known_if_its_start_is():
    """An input is summed up, and the sum is weighed: its estimate is exact; of an unknown start it would never be."""
    A, B, C = np.diag([0.5, 1.0]), np.array([[1.0], [1.0]]), [[1.0, 0.0]]
    plant, cost = Plant(A, B, np.diag([1.0, 0.0]), C, [[0.5]], mean=[0.0, 3.0]), Cost(np.eye(2), [[1.0]])
    policy = design.all_time(plant, cost)
    shown = outputs(policy, 1)
    assert shown[Entry("estimate", 1)] == pytest.approx(shown[Entry("x", 1)], abs=1e-12)
    assert np.abs(shown[Entry("x", 1)][-1]).max() < 3  # the input brings it down
    unknown = Plant(A, B, np.diag([1.0, 0.0]), C, [[0.5]], covariance=np.diag([0.0, 1.0]))
    with pytest.raises(UnstableError, match=r"initial.covariance is 1 in state 2.*its initial error remains"):
        design.all_time(unknown, cost)
    assert any("initial state" in text for text in close(unknown, policy).violated_assumptions)
    harmless = Plant(A, B * [[1.0], [0.0]], np.diag([1.0, 0.0]), C, [[0.5]], covariance=np.diag([0.0, 1.0]))
    assert design.all_time(harmless, Cost(np.diag([1.0, 0.0]), [[1.0]])).cost_all_time > 0


def test_certificates_are_about_what_moves():
    """A sensor's drift is no coordinate of the loop, its estimation error is; with every sample all modes decay."""
    system = more(make_system(7, 2, 1, 1, False, 2), "drift")
    found = switched(close(system.plant, design.excess(system.plant, system.cost, delta=0.1)))
    assert radius(found.F[-1]) < 0.999
    assert found.X.shape[0] == 2
