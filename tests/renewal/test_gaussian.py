"""Rate and cost of chains with Gaussian noise: literature, closed forms, a dense grid, simulation, and the claims."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.special
import scipy.stats
from counts import few
from drawn import rows

from taciturn.errors import ProblemError
from taciturn.lqg.riccati import regulate_continuous
from taciturn.lqg.sampling import sample
from taciturn.model.plant import JumpNoise, Jumps
from taciturn.renewal import gaussian
from taciturn.renewal.chain import Chain, Intervals, NoQuadratureError
from taciturn.renewal.gaussian import solve_gaussian
from taciturn.renewal.quadrature import INTERPOLATED, SOLVED

UNIT = np.eye(2)


def consistent(A, B, Q, R, W, period, multiple=1.0):
    """Return the chain of consistent periodic triggering at its largest threshold, and the periodic cost."""
    none = np.zeros(B.shape)
    control = regulate_continuous(A, B, Q, R, none)
    weight = control.L.T @ R @ control.L
    held = sample(A, B, weight, np.zeros_like(R), none, W, period)
    delta = period * np.trace(weight @ held.W) - held.noise_cost
    chain = Chain(held.A, held.W, held.Q, float(delta * multiple), held.Q)
    return chain, float(np.trace(control.K @ W)) + held.noise_cost / period


def double_integrator(period):
    """Return the chain of the thesis's example."""
    A, B, W = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.diag([0.0, 2.5])
    return consistent(A, B, UNIT, np.array([[10.0]]), W, period)


def random_chain(seed, states=None):
    """Return the error of a random sampled plant: stable, unstable or nilpotent, often with one noise only."""
    draws = np.random.default_rng(seed)
    n = states or int(draws.integers(1, 3))
    A = draws.standard_normal((n, n))
    kind = draws.integers(3)
    A = np.triu(A, 1) if kind == 0 else A - kind * np.abs(np.linalg.eigvals(A)).max() * np.eye(n) / 2
    noises = draws.standard_normal((n, n if n == 3 else int(draws.integers(1, n + 1))))
    gain = draws.standard_normal((int(draws.integers(1, n + 1)), n))
    period = float(10 ** draws.uniform(-1, 0.3))
    held = sample(A, np.zeros((n, 1)), gain.T @ gain, [[0]], np.zeros((n, 1)), noises @ noises.T, period)
    natural = period * np.trace(gain.T @ gain @ held.W) - held.noise_cost
    multiples = [0.1, 0.3, 1, 3, 10] if n == 3 else [0.1, 0.3, 1, 3, 10, 100]
    return Chain(held.A, held.W, held.Q, float(natural * draws.choice(multiples)), held.Q)


def scalar(F, delta):
    """Return the chain of one state with noise and weights of one."""
    return Chain(np.array([[F]]), np.ones((1, 1)), np.ones((1, 1)), delta, np.ones((1, 1)))


def in_coordinates(chain, T):
    """Return the same chain for T e."""
    back = np.linalg.inv(T)
    return Chain(
        T @ chain.F @ back, T @ chain.noise @ T.T, back.T @ chain.Psi @ back, chain.delta, back.T @ chain.Gamma @ back
    )


def agree(one, other):
    """Say whether two answers agree within what they claim."""
    return (
        abs(one.rate - other.rate) <= one.rate_error + other.rate_error
        and abs(one.excess - other.excess) <= one.excess_error + other.excess_error
    )


@pytest.mark.parametrize(
    ("period", "rate", "cost", "digits"),
    rows(
        [
            (0.1, 0.50154718815, 22.48453691579, 11),
            (0.2, 0.50689726308, 23.63130472075, 11),
            (0.5, 0.52107412179, 27.43720939010, 11),
            (1.0, 0.53982843573, 35.10015091224, 11),
            (2.0, 0.28283645 * 2, 56.1351962, 7),
            (0.25, 2.03778693 * 0.25, 24.2270133, 7),
            (0.05, 9.97478298 * 0.05, 21.9330583, 7),
        ],
        quick=3,
    ),
)
def test_the_double_integrator_of_the_thesis_has_its_numbers(period, rate, cost, digits):
    """Rate per check and cost of the consistent trigger are the known ones to every digit."""
    chain, periodic = double_integrator(period)
    found = solve_gaussian(chain, 1e-10)
    assert abs(found.rate - rate) <= 10.0**-digits + found.rate_error
    assert abs(periodic + found.excess / period - cost) <= 10.0**-digits + found.excess_error / period
    assert found.rate_error <= 1e-10 * found.rate


@pytest.mark.parametrize("radius", [0.01, 0.5, 1.0, 2.0, 4.0, 5.0, 6.0])
def test_without_memory_a_scalar_is_sent_with_the_probability_of_a_normal_tail(radius):
    """For F = 0 the rate is P(|w| > a), the excess E[w²; |w| ≤ a]; down to two sends in a thousand million checks."""
    found = solve_gaussian(scalar(0.0, radius**2))
    inside = scipy.special.erf(radius / np.sqrt(2))
    assert abs(found.rate - scipy.special.erfc(radius / np.sqrt(2))) <= found.rate_error
    excess = inside - 2 * radius * scipy.stats.norm.pdf(radius)
    if radius > 0.1:  # below, the difference has no digits
        assert abs(found.excess - excess) <= found.excess_error + 1e-15


@pytest.mark.parametrize("states", [2, 3])
def test_without_memory_white_noise_is_sent_with_the_probability_of_a_chi_square(states):
    """In two and three directions, for tight and wide thresholds."""
    unit = np.eye(states)
    for delta in (0.1, 1.0, 3.0) if states == 3 else (0.1, 2.0, 9.0):
        found = solve_gaussian(Chain(0 * unit, unit, unit, delta, unit), 1e-6)
        assert abs(found.rate - scipy.stats.chi2.sf(delta, states)) <= found.rate_error
        assert abs(found.excess - states * scipy.stats.chi2.cdf(delta, states + 2)) <= found.excess_error
        assert found.rate_error <= 1e-6 * found.rate


@pytest.mark.evidence
@pytest.mark.parametrize(
    ("F", "delta"), rows([(0.5, 1.0), (0.95, 9.0), (1.0, 25.0), (1.3, 4.0), (-2.0, 9.0), (8.0, 4.0)], quick=1)
)
def test_a_scalar_chain_is_that_of_a_dense_grid(F, delta):
    """Rate, excess, survival and its decay are those of 1200 nodes of Gauss, without any symmetry."""
    x, weight = np.polynomial.legendre.leggauss(1200)
    x, weight = np.sqrt(delta) * x, np.sqrt(delta) * weight
    kernel = scipy.stats.norm.pdf(x - F * x[:, None]) * weight
    start = scipy.stats.norm.pdf(x) * weight
    to_come = np.linalg.solve(np.eye(len(x)) - kernel, np.stack([np.ones(len(x)), x * x], axis=1))
    checks, cost = 1 + start @ to_come[:, 0], start @ to_come[:, 1]
    found = solve_gaussian(scalar(F, delta))
    assert found.rate == pytest.approx(1 / checks, rel=1e-12, abs=found.rate_error)
    assert found.excess == pytest.approx(cost / checks, rel=1e-12, abs=found.excess_error)
    kept, survival = start, [1.0]
    for _ in range(5):
        survival.append(kept.sum())
        kept = kept @ kernel
    assert found.intervals.beyond(np.arange(6.0)) == pytest.approx(survival, abs=1e-7)
    assert found.intervals.decay == pytest.approx(np.abs(np.linalg.eigvals(kernel)).max(), abs=1e-6)


@pytest.mark.parametrize(
    "seed", few(sorted(set(range(31)) - {0, 3, 7, 8, 16, 22}), quick=5)
)  # these need thousands of nodes
def test_claimed_errors_hold_against_a_much_finer_answer(seed):
    """Over random plants, for an accuracy that is asked for and one that is easily had."""
    chain = random_chain(seed)
    fine = _answer(chain, 1e-9)
    for accuracy in (1e-3, 1e-6):
        assert agree(solve_gaussian(chain, accuracy), fine)


@pytest.mark.parametrize("seed", few([2, 6], quick=1))
def test_claimed_errors_hold_with_three_states(seed):
    """Over random plants of full noise."""
    chain = random_chain(seed, 3)
    assert agree(_answer(chain, 1e-3), _answer(chain, 1e-5))


def _answer(chain, accuracy):
    try:
        return solve_gaussian(chain, accuracy)
    except NoQuadratureError as refusal:
        pytest.skip(str(refusal))


@pytest.mark.parametrize(("seed", "states"), rows([(1, 1), (4, 2), (5, 2), (2, 3), (6, 3)], quick=2))
def test_sums_on_a_grid_say_what_a_matrix_says(seed, states, monkeypatch):
    """Rate, excess and survival, for few and many nodes."""
    chain = random_chain(seed, states)
    with monkeypatch.context() as patched:
        patched.setattr(gaussian, "most_dense", lambda *_: 10_000)
        matrix = solve_gaussian(chain, 1e-3)
    monkeypatch.setattr(gaussian, "most_dense", lambda *_: 0)
    grid = solve_gaussian(chain, 1e-3)
    assert grid.nodes == matrix.nodes
    slack = INTERPOLATED + SOLVED * 1e-3  # what the grid claims
    assert grid.rate == pytest.approx(matrix.rate, rel=slack)
    assert grid.excess == pytest.approx(matrix.excess, rel=slack)
    checks = np.arange(30.0)
    assert grid.intervals.beyond(checks) == pytest.approx(matrix.intervals.beyond(checks), abs=slack)


def simulated(chain, seed):
    """Return rate and excess with their standard errors, over independent paths after the first hundred checks."""
    draws, paths, checks, states = np.random.default_rng(seed), 4000, 300, len(chain.F)
    half = np.linalg.cholesky(chain.noise)
    error, sent, cost = np.zeros((paths, states)), np.zeros(paths), np.zeros(paths)
    for check in range(checks + 100):
        error = error @ chain.F.T + draws.standard_normal((paths, states)) @ half.T
        over = ((error @ chain.Psi) * error).sum(axis=1) > chain.delta
        error[over] = 0.0
        if check >= 100:
            sent += over / checks
            cost += ((error @ chain.Gamma) * error).sum(axis=1) / checks
    return [(seen.mean(), seen.std(ddof=1) / np.sqrt(paths)) for seen in (sent, cost)]


def agrees_with_simulation(found, chain, seed):
    """Check rate and excess within four standard errors."""
    (rate, rate_spread), (excess, excess_spread) = simulated(chain, seed)
    assert abs(rate - found.rate) <= 4 * rate_spread + found.rate_error
    assert abs(excess - found.excess) <= 4 * excess_spread + found.excess_error


@pytest.mark.parametrize(("seed", "states"), rows([(1, 1), (2, 2), (5, 2), (4, 2), (2, 3)], quick=2))
def test_a_simulation_agrees_within_four_standard_errors(seed, states):
    """Rate and excess of one, two and three states."""
    chain = random_chain(seed, states)
    agrees_with_simulation(_answer(chain, 1e-6), chain, seed)


@pytest.mark.evidence
@pytest.mark.parametrize("seed", sorted(set(range(100, 151)) - {128}))  # that one spreads over 300 noises: refused
def test_fifty_plants_agree_with_simulation_and_with_finer_answers(seed):
    """One, two and three states; stable, unstable and nilpotent; claims against an answer of three more digits."""
    states = 1 + seed % 3
    chain = random_chain(seed, states)
    while simulated(chain, seed)[0][0] < 1e-3:  # so rare that a simulation says nothing
        chain = Chain(chain.F, chain.noise, chain.Psi, chain.delta / 3, chain.Gamma)
    found = solve_gaussian(chain, 1e-4)
    assert agree(found, solve_gaussian(chain, 1e-7))
    agrees_with_simulation(found, chain, seed)


@pytest.mark.parametrize("seed", few(range(4), quick=1))
def test_coordinates_and_units_of_the_states_decide_nothing(seed):
    """A turned, stretched and rescaled chain has the same numbers."""
    chain, _ = double_integrator(0.3)
    reference = solve_gaussian(chain)
    T = np.random.default_rng(seed).standard_normal((2, 2))
    assert agree(solve_gaussian(in_coordinates(chain, T)), reference)
    assert agree(solve_gaussian(in_coordinates(chain, np.diag([1e7, 1e-7]))), reference)


def test_scaling_noise_and_threshold_together_scales_the_excess():
    """With noise of 10^{-12} and δ likewise, the rate is the same and the excess 10^{-12} of it."""
    chain, _ = double_integrator(0.3)
    found, reference = (
        solve_gaussian(Chain(chain.F, chain.noise * unit, chain.Psi, chain.delta * unit, chain.Gamma))
        for unit in (1e-12, 1.0)
    )
    assert found.rate == pytest.approx(reference.rate, rel=1e-8)
    assert found.excess == pytest.approx(reference.excess * 1e-12, rel=1e-8)


def test_directions_that_no_noise_reaches_or_nothing_sees_do_not_count():
    """Five states, mixed, of which one gets no noise and two are seen by nobody, one of them growing."""
    chain, _ = double_integrator(0.3)
    F, noise, weight = np.zeros((5, 5)), np.zeros((5, 5)), np.zeros((5, 5))
    F[:2, :2], noise[:2, :2], weight[:2, :2] = chain.F, chain.noise, chain.Psi
    F[:, 2] = [0.3, -0.2, 1.7, 0.4, 0.1]  # never moved by noise
    F[3:, :2], F[3:, 3:] = 0.5, [[1.5, 0.2], [0.0, 0.9]]  # seen by nobody
    noise[3:, 3:] = [[1.0, 0.5], [0.5, 2.0]]
    large = Chain(F, noise, weight, chain.delta, weight)
    T = np.random.default_rng(0).standard_normal((5, 5))
    reference = solve_gaussian(chain)
    assert agree(solve_gaussian(large), reference)
    assert agree(solve_gaussian(in_coordinates(large, T)), reference)


@pytest.mark.evidence
def test_an_error_that_the_trigger_does_not_see_adds_its_own_cost():
    """A walk next to a scalar chain costs, per kept check, a unit for each check since the last send."""
    chain = Chain(np.diag([0.5, 1.0]), UNIT, np.diag([1.0, 0.0]), 1.0, UNIT)
    found, alone = solve_gaussian(chain), solve_gaussian(scalar(0.5, 1.0))
    ages = np.arange(200.0)
    walk = float((ages * alone.intervals.beyond(ages)).sum()) * alone.rate
    assert abs(found.rate - alone.rate) <= found.rate_error + alone.rate_error
    assert abs(found.excess - alone.excess - walk) <= found.excess_error + 1e-8 * found.excess


def test_a_singular_trigger_that_sees_later_is_solved():
    """Ψ sees one state, which the other drives: the answer is the limit of a Ψ that hardly sees the other."""
    F = np.array([[0.5, 0.3], [0.2, 0.9]])
    found = solve_gaussian(Chain(F, UNIT, np.diag([1.0, 0.0]), 1.0, UNIT))
    near = solve_gaussian(Chain(F, UNIT, np.diag([1.0, 1e-13]), 1.0, UNIT))
    assert agree(found, near)


@pytest.mark.parametrize("seed", few([1, 2, 4, 5, 6], quick=2))
def test_intervals_sum_to_one_and_their_mean_is_one_over_the_rate(seed):
    """Survival falls from one; the probabilities of all intervals sum to one, their mean is the checks per send."""
    found = _answer(random_chain(seed), 1e-6)
    survival = found.intervals.survival
    assert survival[0] == 1
    assert (np.diff(survival) <= 1e-15).all()
    assert 0 <= found.intervals.decay < 1
    # the decay of rare sends is a number just below one, which has no more digits
    assert found.intervals.mean * found.rate == pytest.approx(1, abs=1e-9 + 1e-15 / found.rate)
    many = len(survival) + 50
    chances = found.intervals.probability(many)
    assert chances.sum() == pytest.approx(1 - found.intervals.beyond(np.array([float(many)]))[0], abs=1e-12)


def test_long_intervals_of_a_slow_chain_keep_their_distribution():
    """A random walk on a wide interval survives as the sum of two cosines of a Brownian motion, nearly."""
    found = solve_gaussian(scalar(1.0, 1e4))
    assert found.intervals.mean * found.rate == pytest.approx(1, abs=1e-9)
    width = 100 + 0.5826  # a walk in steps leaves a little later than a Brownian motion: −ζ(1/2)/√(2π) of a step
    assert 1 / found.rate == pytest.approx(width**2, rel=1e-3)
    assert -np.log(found.intervals.decay) == pytest.approx(np.pi**2 / 8 / width**2, rel=1e-3)
    assert 0.0 < found.intervals.beyond(np.array([1e5]))[0] < 1e-4


def test_an_accuracy_out_of_reach_is_told():
    """With a send in a thousand million checks floating point leaves six digits, and the claim says so."""
    found = solve_gaussian(scalar(0.0, 36.0), 1e-12)
    assert found.rate_error > 1e-9 * found.rate
    assert abs(found.rate - scipy.special.erfc(6 / np.sqrt(2))) <= found.rate_error


@pytest.mark.parametrize(
    ("chain", "sentence"),
    [
        (Chain(np.eye(4), np.eye(4), np.eye(4), 1.0, np.eye(4)), "4 directions .* at most 3; simulate"),
        (Chain(np.array([[0, 1.0], [0, 0]]), np.diag([0, 1.0]), UNIT, 1.0, UNIT), "excites 1 of the 2 directions"),
        (Chain(UNIT, 0 * UNIT, UNIT, 1.0, UNIT), "the policy would never send"),
        (Chain(UNIT, UNIT, 0 * UNIT, 1.0, UNIT), "the policy would never send"),
        (Chain(np.diag([0.5, 2.0]), UNIT, np.diag([1.0, 0]), 1.0, UNIT), "grows without bound in a direction"),
        (Chain(0.99 * np.eye(3), np.eye(3), np.eye(3), 1e4, np.eye(3)), "spreads over too many standard deviations"),
        (scalar(0.0, 81.0), "have a relative error of .* simulate instead"),
        (Chain(UNIT, JumpNoise(UNIT, Jumps(1.0, UNIT), 1.0), UNIT, 1.0, UNIT), "the noise consists of jumps"),
    ],
)
def test_what_no_quadrature_serves_is_refused_with_a_sentence(chain, sentence):
    """Too many states, too little noise, no sends, unbounded errors, too many nodes, too few digits, jumps."""
    with pytest.raises(NoQuadratureError, match=sentence):
        solve_gaussian(chain)


def test_intervals_are_asked_in_any_shape_and_refuse_what_is_no_number_of_checks():
    """A list, a table, one number; not −1, a half or nan."""
    intervals = solve_gaussian(scalar(0.5, 1.0)).intervals
    assert intervals.beyond([0, 1, 400]).shape == (3,)
    assert intervals.beyond(np.array([[0, 1], [2, 3]])).shape == (2, 2)
    assert intervals.beyond(0) == 1
    assert intervals.quantile(1e-300) == 1
    assert Intervals(np.array([1.0, 0.5]), 0.0).quantile(0.9) == 2  # what is left after the last is sent at once
    for wrong in (-1, [0.5], np.nan, "3", True):
        with pytest.raises(ProblemError, match="is not a non-negative integer"):
            intervals.beyond(wrong)
    with pytest.raises(ProblemError, match="checks is 0"):
        intervals.probability(0)
