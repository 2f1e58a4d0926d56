"""What rounding, units and bad conditioning do to the equations: right to what is claimed, or refused."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from digits import regulated, sampled
from drawn import law
from hypothesis import reject
from hypothesis import strategies as st
from systems import uncontrollable_modes

from taciturn import Cost, Plant, design
from taciturn._modes import least_eigenvalue, radius
from taciturn._rational import Limit, modes_of, rational
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.critical_losses import Channel, MeanSquare
from taciturn.lqg.equation import Problem, accumulate, exactly
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.lossy import lossy_step, regulate_lossy
from taciturn.lqg.quadratic import Quadratic
from taciturn.lqg.riccati import regulate, regulate_continuous
from taciturn.lqg.sampling import sample

seeds = st.integers(0, 2**32 - 1)
times = pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
TOLERANCE = 1e-6  # what the documentation promises


def off(found: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest error of a semidefinite matrix, each variable in the unit that makes its diagonal 1."""
    unit = np.sqrt(np.diag(exact))
    return float(np.abs((found - exact) / unit / unit[:, None]).max())


def in_units(c, x: np.ndarray, u: np.ndarray, cost: float) -> tuple[np.ndarray, ...]:
    """Return A, B, Q, R, N of a case whose state, input and cost are measured in other units."""
    A, B = c.A / x[:, None] * x, c.B / x[:, None] * u
    return A, B, cost * c.Q * x * x[:, None], cost * c.R * u * u[:, None], cost * c.N * x[:, None] * u


@times
@law(3, 40, seed=seeds)
def test_units_from_1e_8_to_1e8_leave_the_regulator_as_it_is(draw, seed, continuous):
    """K and L of a problem in other units are those of sixty digits, to 1e-8 of the cost and gain of each state."""
    c = draw(seed)
    n, m = c.B.shape
    x, u, cost = 10.0 ** c.rng.uniform(-8, 8, n), 10.0 ** c.rng.uniform(-8, 8, m), 10.0 ** c.rng.uniform(-8, 8)
    problem = in_units(c, x, u, cost)
    found = (regulate_continuous if continuous else regulate)(*problem)
    K, L = regulated(*problem, found.L, continuous)
    assert off(found.K, K) < 1e-8
    price = np.sqrt(np.diag(found.H))  # u'Hu of what each state asks for, next to what the state costs
    assert np.abs((found.L - L) * price[:, None] / np.sqrt(np.diag(K))).max() < 1e-8


@times
@law(3, 40, seed=seeds, weak=st.integers(0, 6))
def test_the_error_of_a_solution_is_within_what_is_claimed(draw, seed, weak, continuous):
    """K − exact lies between − and + error, for inputs that reach the states unequally well."""
    c = draw(seed)
    B = c.B * 10.0 ** c.rng.uniform(-weak, 0, (len(c.A), 1))
    found = Problem(*exactly(Quadratic(c.A, B, c.Q, c.R, c.N)), continuous).solve()
    K, _ = regulated(c.A, B, c.Q, c.R, c.N, found.L, continuous)
    unit = np.sqrt(np.diag(K))
    claimed, error = (part / unit / unit[:, None] for part in (found.error, found.K - K))
    assert np.linalg.eigvalsh(claimed - error)[0] > -1e-16  # of the difference itself
    assert np.linalg.eigvalsh(claimed + error)[0] > -1e-16


def structured(family: str, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B and C of a plant whose equations are easy, or hard in a way of their own."""
    A, B, C = rng.normal(size=(n, n)), rng.normal(size=(n, 1 + n // 6)), rng.normal(size=(1 + n // 6, n))
    if family == "sparse":
        A = 0.5 * np.eye(n) + np.where(rng.random((n, n)) < 2 / n, A, 0)
    if family in ("dense", "sparse", "hidden"):
        A = A * rng.uniform(0.5, 1.2) / np.abs(np.linalg.eigvals(A)).max()
    if family == "chain":  # moved at its start and seen at its end
        A = np.diag(rng.uniform(0.3, 1.05, n)) + np.diag(rng.uniform(0.2, 0.5, n - 1), -1)
        B, C = np.eye(n)[:, :1], np.eye(n)[-1:]
    if family == "masses":  # between springs, hardly damped, pushed at one end and seen at the other
        springs = np.zeros((n, n))
        springs[0::2, 1::2] = np.eye(n // 2)
        springs[1::2, 0::2] = np.eye(n // 2, k=1) + np.eye(n // 2, k=-1) - 2 * np.eye(n // 2)
        A, B, C = scipy.linalg.expm(0.2 * springs), np.eye(n)[:, 1:2], np.eye(n)[-2:-1]
    if family == "stiff":  # paces a million times apart, in turned coordinates
        turn = np.linalg.qr(A)[0]
        paces = np.append(rng.uniform(0, 0.5), -(10.0 ** rng.uniform(-3, 3, n - 1)))
        A = (turn * np.exp(0.1 * paces)) @ turn.T
    if family == "hidden":  # a growing mode that hardly shows and is hardly moved
        A[-1], A[:, -1], A[-1, -1] = 0, 0, 1.1
        B[-1], C[:, -1] = 10.0 ** rng.uniform(-4, 0), 10.0 ** rng.uniform(-4, 0)
    return A, B, C


@pytest.mark.parametrize("family", ["dense", "sparse", "chain", "masses", "stiff", "hidden"])
@law(2, 25, seed=seeds, half=st.integers(2, 7))
def test_the_error_of_a_design_is_within_what_is_claimed_in_every_family(family, seed, half):
    """K and the prior covariance are as near to those of sixty digits as regulator and filter say."""
    n, rng = 2 * half, np.random.default_rng(seed)
    A, B, C = structured(family, n, rng)
    Q, R = np.diag(10.0 ** rng.uniform(-2, 2, n)), np.diag(10.0 ** rng.uniform(-2, 2, B.shape[1]))
    W, V = np.diag(10.0 ** rng.uniform(-2, 2, n)), np.diag(10.0 ** rng.uniform(-2, 2, len(C)))
    try:
        found, steady = regulate(A, B, Q, R, np.zeros(B.shape)), steady_filter(A, C, W, V)
    except UnstableError:
        reject()
    K, _ = regulated(A, B, Q, R, np.zeros(B.shape), found.L)
    prior, _ = regulated(A.T, C.T, W, V, np.zeros(C.T.shape), -(A @ steady.gain).T)
    for answer, exact, claim in ((found.K, K, found.error), (steady.prior, prior, steady.error)):
        unit = np.sqrt(np.diag(exact))
        claimed, error = (part / unit / unit[:, None] for part in (claim, answer - exact))
        assert np.linalg.eigvalsh(claimed - error)[0] > -1e-16
        assert np.linalg.eigvalsh(claimed + error)[0] > -1e-16
        assert np.trace(claimed) <= 1.01 * TOLERANCE * n
    assert found.slowest == pytest.approx(radius(A + B @ found.L), abs=1e-6)
    assert steady.slowest == pytest.approx(radius(A - A @ steady.gain @ C), abs=1e-6)


@law(3, 40, seed=seeds)
def test_units_from_1e_8_to_1e8_leave_the_filter_as_it_is(draw, seed):
    """Covariance and gain in other units are those of sixty digits; no variance is taken for rounding."""
    c = draw(seed)
    x, y = 10.0 ** c.rng.uniform(-8, 8, len(c.A)), 10.0 ** c.rng.uniform(-8, 8, len(c.C))
    A, C, W, V = c.A / x[:, None] * x, c.C / y[:, None] * x, c.W / x / x[:, None], c.V / y / y[:, None]
    found = steady_filter(A, C, W, V)
    start = -(A @ found.gain).T
    Sigma, _ = regulated(A.T, C.T, W, V, np.zeros(C.T.shape), start)
    assert off(found.prior, Sigma) < 1e-8
    assert radius(A - A @ found.gain @ C) < 1


def turned(unstable: float, reached: float, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a plant with an unstable mode that the input reaches weakly, in coordinates that hide it."""
    T = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return T @ np.diag([unstable, -0.5]) @ T.T, T @ np.array([[reached], [1.0]])


def test_a_stable_gain_that_costs_too_much_is_not_called_unproved():
    """A Jordan block that was turned, so that it grows by the rounding of its entries, and an input hardly moves it."""
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(8, 8)))[0]
    A, B = np.diag([1.1, 0.7, *[0.9999] * 6]) + np.diag([0, 0, *[1.0] * 5], 1), np.eye(8)[:, :1]
    A[0, 2:], A, B = 1.0, turn @ A @ turn.T, turn @ B
    weights = np.eye(8), np.eye(1), np.zeros((8, 1))
    found = Problem(*exactly(Quadratic(A, B, *weights))).solve()
    assert not modes_of(rational(A) + rational(B) * rational(found.L), Limit(False)).lasting.size  # it is stable
    with pytest.raises(UnstableError, match=r"more digits than a double holds: rounded, it costs up to .* above 1e-09"):
        regulate(A, B, *weights)


@times
@pytest.mark.parametrize("angle", [0.0, 0.7])
@pytest.mark.parametrize("digits", range(2, 15, 2))
def test_an_unstable_mode_that_is_hardly_reached_is_right_or_refused(digits, angle, continuous):
    """Reached by 1e-2 … 1e-14: K to nine digits, or a gain that no double holds."""
    A, B = turned(0.2 if continuous else 1.2, 10.0**-digits, angle)
    problem = A, B, np.eye(2), np.eye(1), np.zeros((2, 1))
    try:
        found = (regulate_continuous if continuous else regulate)(*problem)
    except UnstableError as error:
        refusal = str(error)
    else:
        refusal = ""
    if refusal:
        assert angle, "what is only a matter of units is solved"
        assert digits >= 10, refusal
        assert "more digits than a double holds" in refusal  # a rounded gain of 1e8 does not stabilise
        return
    K, _ = regulated(*problem, found.L, continuous)
    assert off(found.K, K) < 1e-9


@times
@pytest.mark.parametrize("digits", range(2, 15, 2))
def test_a_stable_mode_beyond_reach_near_the_edge_is_right_or_refused(digits, continuous):
    """A pole at 1 − 1e-k, or at −1e-k, that nothing moves: its cost 1/(1 − λ²), or 1/(2|λ|), or a refusal."""
    slow = -(10.0**-digits) if continuous else 1 - 10.0**-digits
    A, B = np.diag([slow, -0.5]), np.array([[0.0], [1.0]])
    try:
        found = (regulate_continuous if continuous else regulate)(A, B, np.eye(2), np.eye(1), np.zeros((2, 1)))
    except UnstableError:
        found = None
    if found is None:
        assert digits >= 10
        return
    exact = -1 / (2 * slow) if continuous else 1 / ((1 - slow) * (1 + slow))
    assert found.K[0, 0] == pytest.approx(exact, rel=TOLERANCE)


@times
@pytest.mark.parametrize("size", [2, 4, 8])
def test_jordan_blocks_at_the_edge_are_solved_to_twelve_digits(size, continuous):
    """Chains of integrators, moved at their end and weighed at their start."""
    A = np.diag(np.ones(size - 1), 1) + (0 if continuous else np.eye(size))
    problem = A, np.eye(size)[:, -1:], np.diag(np.eye(size)[0]), np.eye(1), np.zeros((size, 1))
    found = (regulate_continuous if continuous else regulate)(*problem)
    K, _ = regulated(*problem, found.L, continuous)
    assert off(found.K, K) < 1e-12


@pytest.mark.parametrize("small", [1e-4, 1e-8, 1e-12])
def test_next_to_free_inputs_and_next_to_worthless_states_are_priced(small):
    """R or Q of 1e-12 next to ones, against sixty digits."""
    A, B, N = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.0], [1.0]]), np.zeros((2, 1))
    for Q, R in ((np.eye(2), [[small]]), (small * np.eye(2), [[1.0]]), (np.diag([1.0, small]), [[1.0]])):
        found = regulate(A, B, Q, R, N)
        assert off(found.K, regulated(A, B, Q, R, N, found.L)[0]) < 1e-12


def test_a_cost_whose_trace_cancels_in_doubles_is_proved():
    """The noise excites only a stable mode, next to one that costs 1e20 times as much: tr(KW) has no digit left."""
    A, B = turned(1.2, 1e-8, 0.7)
    stable = np.linalg.eig(A)
    calm = stable.eigenvectors[:, [int(np.argmin(np.abs(stable.eigenvalues)))]].real
    found = design.all_time(Plant(A, B, calm @ calm.T), Cost(np.eye(2), np.eye(1))).theory
    assert found.cost_all_time_error <= 1e-9 * found.cost_all_time


def test_a_sum_over_all_time_is_right_or_refused():
    """Σ λ^2k = 1/(1 − λ²) while 1 − λ has the digits for it."""
    for distance in (1e-3, 1e-6, 1e-9):
        assert accumulate([[1 - distance]], [[1.0]])[0, 0] == pytest.approx(
            0.5 / distance, rel=2 * distance + TOLERANCE
        )
    with pytest.raises(UnstableError, match="expected a larger stability margin"):
        accumulate([[1 - 1e-12]], [[1.0]])


def test_units_of_decoupled_states_do_not_decide_what_is_reached():
    """An input of 1e-8 into one state and 1e8 into another moves both; into none it moves none."""
    A = np.diag([1.1, 1.2, 1.3])
    assert uncontrollable_modes(A, [[1e-8], [1e8], [1.0]]).size == 0
    assert uncontrollable_modes(A, [[1e-8], [0.0], [1e8]]) == pytest.approx([1.2])
    assert uncontrollable_modes(np.diag([1.1, 1.1]), [[1e-8], [1e8]]) == pytest.approx([1.1])


def test_units_of_weights_do_not_decide_whether_they_are_definite():
    """R = diag(1e-8, 1e8) is definite and a negative weight next to a large one is not rounding."""
    assert Cost(np.eye(2), np.diag([1e-8, 1e8])).R[0, 0] == 1e-8
    with pytest.raises(ProblemError, match="Q has the eigenvalue -1e-08"):
        Cost(np.diag([1e8, -1e-8]), [[1.0]])
    with pytest.raises(ProblemError, match=r"R has the eigenvalue .*positive semidefinite"):
        Cost([[1.0]], [[1e8, 1e3], [1e3, 1e-8]])
    assert Cost([[1.0]], [[1e8, 1.0], [1.0, 1e-8]]).R[0, 1] == 1.0  # singular up to rounding
    with pytest.raises(ProblemError, match="Q is not symmetric"):
        Cost(np.array([[1e9, 0, 0], [0, 1, 0.5], [0, 0, 1]]), [[1.0]])
    column = np.array([[1.0], [1e-12], [0.0]])
    assert np.linalg.matrix_rank(Cost(column @ column.T, [[1.0]]).Q) == 1


@pytest.mark.parametrize("fast", [2e-13, 2.0, 2e13])
def test_a_slow_mode_beyond_reach_decays_in_any_unit_of_time(fast):
    """−1e-13 per second is a stable mode, next to another one of any pace."""
    found = regulate_continuous(np.diag([-1e-13, -fast]), [[0.0], [fast]], np.eye(2), np.eye(1), np.zeros((2, 1)))
    assert found.K[0, 0] == pytest.approx(5e12)


@pytest.mark.parametrize("fast", [1e2, 1e5, 1e8])
def test_a_stiff_plant_keeps_the_digits_of_its_slow_mode(fast):
    """Modes that decay 1e8 times and 1e-8 times in a period: the slow one decays by what sixty digits say."""
    A, B, N = np.diag([-fast, -1 / fast]) + np.array([[0, 0.3], [0, 0]]), np.ones((2, 1)), np.zeros((2, 1))
    found = sample(A, B, np.eye(2), np.eye(1), N, np.eye(2), 1.0)
    Phi, weight, noise = sampled(A, B, np.eye(2), np.eye(1), N, np.eye(2), 1.0)
    assert 1 - found.A[1, 1] == pytest.approx(1 - Phi[1, 1], rel=1e-12 + 2e-16 * fast)
    assert off(found.W, noise) < 1e-12
    assert off(np.block([[found.Q, found.N], [found.N.T, found.R]]), weight) < 1e-12


def test_a_phase_keeps_its_digits_over_any_number_of_turns():
    """An undamped oscillator of 1e12 rad/s over 10 s: 1e13 radians, whose cosine a library reduces exactly."""
    A, B, N = np.array([[0.0, 1e12], [-1e12, 0.0]]), np.array([[0.0], [1.0]]), np.zeros((2, 1))
    found = sample(A, B, np.eye(2), np.eye(1), N, np.eye(2), 10.0)
    assert found.A[0] == pytest.approx([np.cos(1e13), np.sin(1e13)], rel=1e-15)


def chain(masses: int) -> tuple[np.ndarray, np.ndarray]:
    """Return masses in a row between springs, undamped, pushed at one end."""
    stiffness = 2 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    A = np.block([[np.zeros((masses, masses)), np.eye(masses)], [-stiffness, np.zeros((masses, masses))]])
    return A, np.eye(2 * masses)[:, -1:]


def test_thirty_masses_in_a_row_are_solved_and_lose_packets():
    """Sixty undamped states: regulator and lossy fixed point hold their equations and claim an error below 1e-8."""
    A, B = chain(30)
    plant = sample(A, B, np.eye(60), np.eye(1), np.zeros((60, 1)), np.eye(60), 0.3)
    found = Problem(*exactly(Quadratic(plant.A, plant.B, plant.Q, plant.R, plant.N))).solve()
    assert (found.error.diagonal() < 1e-8 * found.K.diagonal()).all()
    channel = Channel(0.2, 0.3, acknowledged=False, delayed=False)
    lossy = regulate_lossy(plant.A, plant.B, plant.Q, np.eye(1), channel)
    K, P, *_ = lossy_step(plant.A, plant.B, plant.Q, np.eye(1), lossy.K, lossy.P, channel)
    assert off(K, lossy.K) < 1e-12
    assert off(P + lossy.K, lossy.P + lossy.K) < 1e-12
    assert np.trace(lossy.error) < 1e-8 * np.trace(lossy.K)


@law(2, 30, seed=seeds, told=st.booleans(), late=st.booleans(), lost=st.floats(0, 0.9), unseen=st.floats(0, 0.9))
def test_two_lyapunov_equations_grow_and_sum_like_the_stacked_rows(draw, seed, told, late, lost, unseen):
    """The mean square of a loop by equations of n rows is that of one linear map of 2n² rows."""
    c, channel = draw(seed), Channel(lost, unseen, told, late)
    A, pushed = c.A, c.B @ (L := 0.3 * c.rng.normal(size=c.B.T.shape))
    moved, reach = A + (1 - lost) * pushed, 0.0 if told else 1.0 if late else unseen
    spread, free = lost * (1 - lost) * np.kron(pushed.T, pushed.T), np.kron(A.T, A.T)
    first = [np.kron(moved.T, moved.T) + (1 - reach) * spread, reach * spread]
    stacked = np.block([first, [(1 - unseen) * free, unseen * free]])
    growth = MeanSquare(A, c.B, L, channel).growth()
    assert growth == pytest.approx(radius(stacked), rel=1e-5)  # of a double eigenvalue
    level, terms = 1.3 * growth + 0.1, np.concatenate([c.Q.ravel(), c.W.ravel()])
    expected = np.linalg.solve(level * np.eye(len(stacked)) - stacked, terms).reshape(2, *A.shape)
    for one, other in zip(MeanSquare(A, c.B, L, channel, level).solve(c.Q, c.W), expected, strict=True):
        assert off(one, other) < 1e-9


def test_the_least_eigenvalue_keeps_its_digits_beside_large_entries():
    """Of a definite matrix in units of 1e-8 … 1e8, whose largest eigenvalue is 1e32 times the least."""
    matrix = np.array([[2.0, 1.0], [1.0, 2.0]]) * np.outer([1e8, 1e-8], [1e8, 1e-8])
    assert least_eigenvalue(matrix) == pytest.approx(1.5e-16, rel=1e-12)  # the determinant over the trace
    assert least_eigenvalue(np.diag([1.0, -1.0])) == -1.0
    assert least_eigenvalue(np.diag([1.0, 0.0])) == 0.0
    assert least_eigenvalue(np.ones((2, 2))) <= 0.0


@pytest.mark.parametrize("seed", range(12))
def test_a_cost_that_the_input_can_avoid_is_solved(seed):
    """The square of one output cx + du: the input keeps it at zero, and what rounding leaves has no digits."""
    draws = np.random.default_rng(seed)
    (c, d), b = draws.normal(size=2), 1.0
    a = b * c / d + draws.uniform(-0.99, 0.99)
    found = regulate([[a]], [[b]], [[c * c]], [[d * d]], [[c * d]])
    assert found.L[0, 0] == pytest.approx(-c / d, rel=1e-6)
    assert abs(found.K[0, 0]) < 1e-12 * c * c
