"""The best scheduler at a price per send: closed forms, value iteration, simulation, the envelope, and the claims."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate
import scipy.stats
from counts import few
from drawn import rows

from taciturn.errors import ProblemError
from taciturn.lqg.riccati import regulate_continuous
from taciturn.lqg.sampling import sample
from taciturn.renewal.chain import Chain, NoQuadratureError
from taciturn.renewal.gaussian import solve_gaussian
from taciturn_limits import optimal
from taciturn_limits.optimal import solve_optimal

UNIT = np.eye(2)
TURNING = np.array([[0.9, 0.5], [-0.4, 1.0]])  # an unstable spiral
SKEW = np.array([[2.0, 0.6], [0.6, 0.5]])


def double_integrator(period):
    """Return the chain of the thesis's example at the largest consistent threshold, and the periodic cost."""
    A, B, W = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.diag([0.0, 2.5])
    none = np.zeros((2, 1))
    control = regulate_continuous(A, B, UNIT, np.array([[10.0]]), none)
    weight = 10.0 * control.L.T @ control.L
    held = sample(A, B, weight, np.zeros((1, 1)), none, W, period)
    delta = period * np.trace(weight @ held.W) - held.noise_cost
    return Chain(held.A, held.W, held.Q, float(delta), held.Q), np.trace(control.K @ W) + held.noise_cost / period


def thresholds(chain, price, multiples):
    """Return the answers under thresholds that are multiples of a price, and what each costs with it, at most."""
    found = [solve_gaussian(Chain(chain.F, chain.noise, chain.Gamma, price * m, chain.Gamma), 1e-7) for m in multiples]
    return found, [f.excess + f.excess_error + price * (f.rate + f.rate_error) for f in found]


def simulated(found, F, noise, Gamma, seed, paths=1500, checks=120, settle=40):
    """Return rate and excess of a scheduler with standard errors, over paths after the first checks."""
    draws, half, states = np.random.default_rng(seed), np.linalg.cholesky(noise), len(F)
    error, sent, cost = np.zeros((paths, states)), np.zeros(paths), np.zeros(paths)
    for check in range(checks + settle):
        error = error @ F.T + draws.standard_normal((paths, states)) @ half.T
        over = found.sends(error)
        error[over] = 0.0
        if check >= settle:
            sent += over / checks
            cost += ((error @ Gamma) * error).sum(axis=1) / checks
    return [(seen.mean(), seen.std(ddof=1) / np.sqrt(paths)) for seen in (sent, cost)]


@pytest.mark.parametrize("states", few([1, 2, 3], quick=2))
@pytest.mark.parametrize("price", [0.1, 2.0, 9.0])
def test_without_memory_the_optimum_sends_what_costs_more_than_the_price(states, price):
    """For F = 0 nothing is to come, so U = e'e − λ: the rate is a tail of χ², the excess the rest of its mean."""
    unit = np.eye(states)
    found = solve_optimal(0 * unit, unit, unit, price)
    excess = states * scipy.stats.chi2.cdf(price, states + 2)
    assert abs(found.rate - scipy.stats.chi2.sf(price, states)) <= found.rate_error
    assert abs(found.excess - excess) <= found.excess_error
    assert abs(found.cost - excess - price * scipy.stats.chi2.sf(price, states)) <= found.cost_error
    assert found.rate_error <= 1e-5 * found.rate
    e = np.random.default_rng(0).standard_normal((1000, states)) * np.sqrt(price)
    assert (found.sends(e) == ((e * e).sum(axis=1) > price)).all()


def test_a_walk_looked_at_often_has_the_threshold_of_a_brownian_motion():
    """Where steps are small, a⁴ = 6λ and g = √(2λ/3): the walk of step 1 oversteps a by 0.5826 on average."""
    for price in (1e4, 1e6):
        found = solve_optimal([[1.0]], [[1.0]], [[1.0]], price)
        threshold = (6 * price) ** 0.25
        assert found.cost == pytest.approx(np.sqrt(2 * price / 3), rel=0.5826 / threshold)
        assert found.sends([[threshold]])
        assert not found.sends([[threshold - 2 * 0.5826]])


@pytest.mark.parametrize(("F", "price"), rows([(0.6, 2.0), (1.0, 20.0), (-1.4, 5.0), (2.5, 30.0)], quick=1, start=1))
def test_a_scalar_optimum_is_that_of_value_iteration_on_a_grid(F, price):
    """Cost and boundary are those of E min(0, U) iterated on a dense line.

    A kink between two points of it costs up to slope·h²/8, at each end and weighed by a density of at most 0.4, in
    every check of an interval.
    """
    found = solve_optimal([[F]], [[1.0]], [[1.0]], price)
    g, end, slope, h = _value_iteration(F, price, 1201)
    kinks = 2 * 0.4 * slope * h * h / 8
    assert abs(g - found.cost) <= kinks + found.cost_error
    assert kinks <= 3e-5 * g
    slack = kinks / found.rate / slope + h * h
    assert found.sends([end + slack])
    assert not found.sends([end - slack])


def _value_iteration(F, price, points):
    """Return g, where U changes its sign and its slope there, by F(e) := E min(0, U(F e + w)); and the spacing."""
    x = np.linspace(-1, 1, points) * (np.sqrt(price) + 0.5)  # U > 0 beyond √λ
    kernel = scipy.stats.norm.pdf(x - F * x[:, None]) * (x[1] - x[0])
    ahead = np.zeros(points)
    for _ in range(5000):
        g = price + ahead[points // 2]
        U = x * x - g + ahead
        before, ahead = ahead, kernel @ np.minimum(U, 0)
        if np.abs(ahead - before).max() < 1e-12 * price:
            break
    outer = x > 0
    end = np.interp(0.0, U[outer], x[outer])
    return g, end, np.interp(end, x, np.gradient(U, x)), x[1] - x[0]


@pytest.mark.parametrize(("F", "price"), rows([(0.6, 2.0), (1.0, 20.0), (-1.4, 5.0)], quick=1, start=2))
def test_the_equation_of_optimality_holds_by_adaptive_quadrature(F, price):
    """In one direction U(e) = e² − g + E min(0, U(F e + w)) with an integral that knows nothing of the nodes."""
    found = solve_optimal([[F]], [[1.0]], [[1.0]], price, 1e-9)
    end = scipy.optimize.brentq(lambda x: float(found.value([x])), 0.1, np.sqrt(price) + 0.1)
    for e in (0.0, 0.4 * end, 0.9 * end, end, 1.3 * end):
        density = scipy.stats.norm(F * e, 1.0).pdf
        ahead, off = scipy.integrate.quad(
            lambda x, density=density: float(found.value([x])) * density(x), -end, end, epsabs=1e-11, epsrel=1e-11
        )
        assert abs(float(found.value([e])) - (e * e - found.cost + ahead)) <= 1e-8 * price + off


@pytest.mark.parametrize("F", [TURNING, 0.5 * TURNING, np.array([[1.0, 0.7], [0.0, 1.0]])])
@pytest.mark.evidence
def test_the_equation_of_optimality_holds_by_drawn_noise(F):
    """In two directions, at random errors, within four standard errors of drawn expectations."""
    found = solve_optimal(F, SKEW, UNIT, 6.0, 1e-6)
    draws = np.random.default_rng(3)
    half = np.linalg.cholesky(SKEW)
    for e in draws.standard_normal((6, 2)) * 1.5:
        drawn = np.minimum(found.value(F @ e + draws.standard_normal((20_000, 2)) @ half.T), 0)
        ahead = float(found.value(e)) - e @ e + found.cost
        assert abs(drawn.mean() - ahead) <= 4 * drawn.std(ddof=1) / np.sqrt(len(drawn)) + 1e-5


@pytest.mark.parametrize(
    ("F", "price"), [(TURNING, 6.0), (0.5 * TURNING, 2.0), (np.array([[1.0, 0.7], [0.0, 1.0]]), 10.0)]
)
@pytest.mark.evidence
def test_a_simulation_of_the_scheduler_agrees_within_four_standard_errors(F, price):
    """Rate and excess of what ``sends`` says, stable, unstable and neutral."""
    found = solve_optimal(F, SKEW, UNIT, price, 1e-4)
    (rate, rate_spread), (excess, excess_spread) = simulated(found, F, SKEW, UNIT, 1)
    assert abs(rate - found.rate) <= 4 * rate_spread + found.rate_error
    assert abs(excess - found.excess) <= 4 * excess_spread + found.excess_error
    assert 4 * rate_spread <= 0.02 * found.rate


@pytest.mark.evidence
def test_a_simulation_of_the_scheduler_agrees_in_three_directions():
    """Rate and excess with noise and weights that are not aligned."""
    F = np.array([[0.9, 0.5, 0.0], [-0.4, 1.0, 0.2], [0.0, 0.1, 0.7]])
    noise, Gamma = np.diag([1.0, 0.5, 2.0]) + 0.2, np.diag([1.0, 2.0, 0.3]) + 0.1
    found = solve_optimal(F, noise, Gamma, 5.0, 1e-3)
    (rate, rate_spread), (excess, excess_spread) = simulated(found, F, noise, Gamma, 1, 800, 60)
    assert abs(rate - found.rate) <= 4 * rate_spread + found.rate_error
    assert abs(excess - found.excess) <= 4 * excess_spread + found.excess_error


@pytest.mark.parametrize(
    ("F", "noise", "Gamma", "price"),
    rows(
        [
            ([[1.0]], [[1.0]], [[1.0]], 20.0),
            ([[-1.4]], [[2.0]], [[1.0]], 5.0),
            (TURNING, SKEW, UNIT, 6.0),
            (0.5 * TURNING, SKEW, np.diag([1.0, 0.0]), 2.0),
        ],
        quick=1,
    ),
)
def test_the_slope_of_the_least_cost_over_the_price_is_the_rate(F, noise, Gamma, price):
    """The envelope theorem, dg/dλ = rate: two numbers that come from different integrals."""
    step = 0.01 * price
    found = solve_optimal(F, noise, Gamma, price, 1e-10)
    slopes, noises = [], []
    for h in (step, 2 * step):
        ends = [solve_optimal(F, noise, Gamma, price + k * h, 1e-10) for k in (-2, -1, 1, 2)]
        slopes.append(sum(w * end.cost for w, end in zip((1, -8, 8, -1), ends, strict=True)) / (12 * h))
        noises.append(sum(w * end.cost_error for w, end in zip((1, 8, 8, 1), ends, strict=True)) / (12 * h))
    tolerance = abs(slopes[0] - slopes[1]) + noises[0] + found.rate_error
    assert abs(slopes[0] - found.rate) <= tolerance
    assert tolerance <= 2e-6 * found.rate


@pytest.mark.parametrize("period", few([0.1, 0.5, 1.0], quick=1, start=2))
def test_no_threshold_costs_less_for_the_double_integrator_and_the_best_hardly_more(period):
    """At the price that the consistent threshold is: less than every threshold, by less than 1.2 % of the whole."""
    chain, periodic = double_integrator(period)
    found = solve_optimal(chain.F, chain.noise, chain.Gamma, chain.delta)
    _, costs = thresholds(chain, chain.delta, (0.5, 0.65, 0.8, 1.0, 1.2))
    whole = periodic + found.cost / period
    assert found.cost + found.cost_error < min(costs)
    assert min(costs) - found.cost <= 0.012 * period * whole


@pytest.mark.parametrize("period", few([0.5, 1.0], quick=1, start=1))
def test_at_its_own_rate_the_optimum_has_less_excess_than_a_threshold_of_that_rate(period):
    """The threshold is found by bisection; the difference is more than both claim."""
    chain, _ = double_integrator(period)
    found = solve_optimal(chain.F, chain.noise, chain.Gamma, chain.delta)
    low, high = 0.3, 1.5
    for _ in range(24):
        middle = (low + high) / 2
        ((rival,), _) = thresholds(chain, chain.delta, (middle,))
        low, high = (middle, high) if rival.rate > found.rate else (low, middle)
    slack = chain.delta * abs(rival.rate - found.rate) + found.excess_error + rival.excess_error
    assert abs(rival.rate - found.rate) <= 1e-5
    assert found.excess + slack < rival.excess


def test_a_scheduler_that_looks_costs_less_than_any_period():
    """One send in so many checks, without a check, is dearer at the same price."""
    F, price = TURNING, 6.0
    found = solve_optimal(F, SKEW, UNIT, price)
    covariance, total, costs = np.zeros((2, 2)), price, [price]
    for checks in range(2, 20):
        covariance = F @ covariance @ F.T + SKEW
        total += np.trace(covariance)
        costs.append(total / checks)
    assert found.cost + found.cost_error < min(costs)


@pytest.mark.parametrize("F", [TURNING, 0.3 * TURNING, np.array([[1.0, 0.7], [0.0, 1.0]])])
@pytest.mark.evidence
def test_claimed_errors_hold_against_a_finer_answer(F):
    """For three accuracies, over stable, unstable and neutral chains, where the price is small and large."""
    for price in (0.3, 8.0):
        fine = solve_optimal(F, SKEW, UNIT, price, 1e-11)
        for accuracy in (1e-3, 1e-5, 1e-8):
            found = solve_optimal(F, SKEW, UNIT, price, accuracy)
            assert abs(found.rate - fine.rate) <= found.rate_error + fine.rate_error
            assert abs(found.excess - fine.excess) <= found.excess_error + fine.excess_error
            assert abs(found.cost - fine.cost) <= found.cost_error + fine.cost_error
            assert found.rate_error <= max(accuracy, 1e-5) * found.rate


def test_coordinates_and_units_decide_nothing():
    """A turned and stretched chain has the same numbers, and sends the same errors."""
    found = solve_optimal(TURNING, SKEW, UNIT, 6.0)
    e = np.random.default_rng(1).standard_normal((400, 2)) * 2
    for T in (np.array([[2.0, 1.0], [0.3, -1.0]]), np.diag([1e6, 1e-6])):
        back = np.linalg.inv(T)
        other = solve_optimal(T @ TURNING @ back, T @ SKEW @ T.T, back.T @ back, 6.0)
        assert abs(other.rate - found.rate) <= other.rate_error + found.rate_error
        assert abs(other.cost - found.cost) <= other.cost_error + found.cost_error
        clear = np.abs(found.value(e)) > 1e-6
        assert clear.sum() > 300
        assert (other.sends(e @ T.T) == found.sends(e))[clear].all()
    dear = solve_optimal(TURNING, SKEW, 1e9 * UNIT, 6e9)
    assert dear.cost == pytest.approx(1e9 * found.cost, rel=1e-8)


def test_directions_that_no_noise_reaches_or_nothing_sees_do_not_count():
    """Four states, of which one gets no noise and one is seen by nobody, have the numbers of the other two."""
    F, noise, Gamma = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    F[:2, :2], noise[:2, :2], Gamma[:2, :2] = TURNING, SKEW, UNIT
    F[:, 2], F[3] = [0.3, -0.2, 1.7, 0.4], [0.5, 0.5, 0.1, 1.5]
    noise[3, 3] = 1.0
    found, small = solve_optimal(F, noise, Gamma, 6.0), solve_optimal(TURNING, SKEW, UNIT, 6.0)
    assert abs(found.rate - small.rate) <= found.rate_error + small.rate_error
    assert abs(found.excess - small.excess) <= found.excess_error + small.excess_error
    assert found.value([1.0, -0.5, 0.0, 7.0]) == pytest.approx(float(small.value([1.0, -0.5])), abs=1e-6)


def test_the_scheduler_is_asked_in_any_shape_and_treats_an_error_like_its_mirror_image():
    """One error, a list, a table of them; U(−e) = U(e), and U(0) = −λ, as a send then gains nothing."""
    found = solve_optimal(TURNING, SKEW, UNIT, 6.0)
    e = np.random.default_rng(2).standard_normal((5, 4, 2))
    assert found.sends(e).shape == (5, 4)
    assert found.sends([1.0, 0.0]).shape == ()
    assert found.value(-e) == pytest.approx(found.value(e), abs=1e-12)
    assert float(found.value([0.0, 0.0])) == pytest.approx(-6.0, abs=1e-9)
    with pytest.raises(ProblemError, match="e has shape"):
        found.sends([1.0, 2.0, 3.0])


@pytest.mark.evidence
def test_the_curve_over_prices_is_convex():
    """A higher price buys fewer sends and more excess; no point of the curve is better at another's price."""
    curve = [solve_optimal(TURNING, SKEW, UNIT, price) for price in (1.0, 3.0, 9.0)]
    for one in curve:
        for other in curve:
            slack = other.excess_error + one.price * other.rate_error + one.cost_error
            assert one.cost <= other.excess + one.price * other.rate + slack


def test_a_region_with_a_gap_is_refused():
    """A strongly sheared neutral chain keeps errors on either side of some that it sends."""
    F = np.array([[2.27, 2.91], [-0.557, -0.273]])
    Gamma = np.diag([0.0014, 0.0107])
    with pytest.raises(
        NoQuadratureError, match=r"region of errors in which the policy does not send has gaps.*near-optimal"
    ):
        solve_optimal(F, UNIT, Gamma, 1.0, 1e-3)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (([[1.0, 0.0]], [[1.0]], [[1.0]], 1.0), r"F has shape \(1, 2\); expected the shape \(1, 1\)"),
        ((UNIT, [[1.0]], UNIT, 1.0), "noise has shape"),
        ((UNIT, -UNIT, UNIT, 1.0), "noise has the eigenvalue -1"),
        ((UNIT, UNIT, [[1.0, 2.0], [2.0, 1.0]], 1.0), "Gamma has the eigenvalue -1"),
        ((UNIT, UNIT, UNIT, 0.0), "price is 0; expected 0 < price"),
        ((UNIT, UNIT, UNIT, np.nan), "price is nan"),
        ((UNIT, UNIT, UNIT, 1.0, 2.0), "accuracy is 2; expected 0 < accuracy < 1"),
        ((np.eye(4), np.eye(4), np.eye(4), 1.0), "4 directions .* at most 3; .* 'near-optimal'"),
        ((np.array([[0, 1.0], [0, 0]]), np.diag([0, 1.0]), UNIT, 1.0), "excites 1 of the 2 .* 'near-optimal'"),
        ((UNIT, UNIT, 0 * UNIT, 1.0), "the policy would never send"),
        ((UNIT, 0 * UNIT, UNIT, 1.0), "the policy would never send"),
        (([[0.0]], [[1.0]], [[1.0]], 100.0), "a lower price, or near-optimal"),
    ],
)
def test_what_is_no_problem_or_no_quadrature_serves_is_refused_with_a_sentence(arguments, sentence):
    """Shapes, signs, ranges; too many states, too little noise, no sends, hardly any sends."""
    with pytest.raises(ProblemError, match=sentence):
        solve_optimal(*arguments)


def test_few_regions_converge_from_any_start(monkeypatch):
    """Four regions on coarse nodes and about two on each of four finer sets settle, from a tiny first region too."""
    chain, _ = double_integrator(0.5)
    found = solve_optimal(chain.F, chain.noise, chain.Gamma, chain.delta)
    assert found.iterations <= 16
    monkeypatch.setattr(optimal, "START", 0.05)  # a region to start from that is far too small
    other = solve_optimal(chain.F, chain.noise, chain.Gamma, chain.delta)
    assert abs(other.cost - found.cost) <= other.cost_error + found.cost_error
    assert abs(other.rate - found.rate) <= other.rate_error + found.rate_error
