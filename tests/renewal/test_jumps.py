"""Chains with jumps: known values, a dense computation, simulation, honest claims, limits and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from counts import few
from drawn import rows
from numpy.polynomial.legendre import leggauss
from scipy.stats import poisson, qmc

from taciturn.lqg.riccati import regulate_continuous
from taciturn.model.plant import JumpNoise, Jumps
from taciturn.renewal.chain import Chain, NoQuadratureError
from taciturn_events import jumps as quadrature
from taciturn_events.jump_density import (
    TABLES_MEET,
    CompoundPoissonNoise,
    Density,
    Fineness,
    eased,
    legendre_nodes,
    plane_flow,
)
from taciturn_events.jumps import solve_jumps

# period: sends per second and average cost of the consistent periodic trigger on a double integrator
KNOWN = {
    2.0: (0.2768078, 56.249621),
    1.0: (0.5144399, 35.161147),
    0.5: (0.9347559, 27.444051),
    0.25: (1.5862694, 24.191170),
    0.1: (2.6253108, 22.438081),
    0.05: (3.3206635, 21.897809),
}


def exponential(A: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return e^{At} for many times, in one or two dimensions."""
    if len(A) == 2:
        return plane_flow(A, times)
    return np.exp(A[0, 0] * times)[:, None, None]


def chain(A, G, rate: float, period: float, delta: float, Psi=None, Gamma=None, law: str = "normal") -> Chain:
    """Return a chain with jumps Gξ."""
    A, G = np.atleast_2d(np.asarray(A, float)), np.atleast_2d(np.asarray(G, float))
    one = np.eye(len(A))
    F = exponential(A, np.array([period]))[0] if len(A) <= 2 else one + A * period
    noise = JumpNoise(A, Jumps(rate, G @ G.T, law), period)
    return Chain(F, noise, one if Psi is None else Psi, delta, one if Gamma is None else Gamma)


def consistent(period: float) -> tuple[Chain, float]:
    """Return the chain of the double integrator checked every ``period``, and what its cost starts from."""
    A, W, rate = np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, 0.5]), 5.0
    found = regulate_continuous(A, [[0.0], [1.0]], np.eye(2), [[10.0]], np.zeros((2, 1)))
    weight = found.L.T @ found.H @ found.L
    nodes, weights = leggauss(20)
    times, weights = period * (nodes + 1) / 2, weights * period / 2
    moves = plane_flow(A, times)
    Gamma = np.einsum("k,kji,jl,klm->im", weights, moves, weight, moves)

    def noise(until: float) -> np.ndarray:
        moves = plane_flow(A, times * until / period)
        return rate * until / period * np.einsum("k,kij,jl,kml->im", weights, moves, W, moves)

    over = sum(w * noise(t) for t, w in zip(times, weights, strict=True))
    delta = float(np.trace(weight @ (period * noise(period) - over)))
    base = np.trace(found.K @ (rate * W)) + np.trace(weight @ over) / period
    return chain(A, [[0.0], [np.sqrt(0.5)]], rate, period, delta, Gamma, Gamma), float(base)


def simulated(of: Chain, loops: int, checks: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return rate and excess of many loops side by side, and their standard errors."""
    rng, noise = np.random.default_rng(seed), of.noise
    values, vectors = np.linalg.eigh(noise.jumps.covariance)
    G = vectors * np.sqrt(np.maximum(values, 0))
    errors, sums = np.zeros((loops, len(of.F))), np.zeros((2, loops))
    for check in range(checks):
        errors = errors @ of.F.T
        struck = np.repeat(np.arange(loops), rng.poisson(noise.jumps.rate * noise.period, loops))
        left = rng.uniform(0, noise.period, len(struck))
        added = np.einsum("kij,kj->ki", exponential(noise.A, left), rng.normal(size=(len(struck), len(G))) @ G.T)
        np.add.at(errors, struck, added)
        sent = np.einsum("ki,ij,kj->k", errors, of.Psi, errors) > of.delta
        errors[sent] = 0
        if check >= checks // 4:
            sums += sent, np.einsum("ki,ij,kj->k", errors, of.Gamma, errors)
    sums /= checks - checks // 4
    return sums.mean(1), sums.std(1) / np.sqrt(loops)


def agree(of: Chain, loops: int = 1000, checks: int = 400) -> None:
    """Check a quadrature against a simulation, within four standard errors."""
    found = solve_jumps(of, 1e-2)
    mean, spread = simulated(of, loops, checks)
    assert abs(found.rate - mean[0]) <= 4 * spread[0] + found.rate_error
    assert abs(found.excess - mean[1]) <= 4 * spread[1] + found.excess_error


def random_chain(seed: int) -> Chain:
    """Return a chain in the plane: stable, unstable or nilpotent, jumps of rank one or two, any threshold."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2, 2))
    A -= np.eye(2) * rng.choice([-0.5, 0.0, 1.0])
    if seed % 3 == 0:
        A = np.array([[0.0, 1.0], [0.0, 0.0]])
    G = rng.normal(size=(2, 1)) if seed % 2 else np.eye(2) + 0.3 * rng.normal(size=(2, 2))
    period, mean = rng.uniform(0.2, 0.8), rng.uniform(0.4, 4.0)
    root = rng.normal(size=(2, 2))
    Psi = root @ root.T + 0.2 * np.eye(2)
    return chain(A, G, mean / period, period, rng.uniform(0.5, 4.0) * mean * np.trace(Psi @ G @ G.T) / 2, Psi)


def check_known(period: float, rate_digits: float, cost_digits: float, accuracy: float) -> None:
    """Compare with a known row."""
    of, base = consistent(period)
    found = solve_jumps(of, accuracy)
    rate, cost = KNOWN[period]
    assert found.rate / period == pytest.approx(rate, rel=rate_digits)
    assert base + found.excess / period == pytest.approx(cost, rel=cost_digits)


@pytest.mark.evidence
@pytest.mark.parametrize("period", [2.0])
def test_a_double_integrator_with_rare_checks_costs_what_is_known(period: float) -> None:
    """Rate and cost of the consistent periodic trigger, to 1e-6 at the first refinement."""
    check_known(period, 1e-6, 1e-6, 1e-3)


@pytest.mark.evidence
@pytest.mark.parametrize("period", [0.5, 1.0])
def test_a_double_integrator_costs_what_is_known(period: float) -> None:
    """Rate and cost of the consistent periodic trigger, to 1e-6."""
    check_known(period, 1e-6, 1e-6, 1e-5)


def mass_on_rays(density: Density, within: np.ndarray) -> float:
    """Return the integral of a density over the set e'Me ≤ 1, along the rays from 0 that it is tabulated on."""
    found = 0.0
    shares, share_weights = legendre_nodes(40)
    for sector, (low, high) in enumerate(density.sectors):
        angles = low + (high - low) * eased(shares)
        weights = (high - low) * 6 * shares * (1 - shares) * share_weights
        rays = np.stack([np.cos(angles), np.sin(angles)], 1)
        ends = np.minimum(np.einsum("ri,ij,rj->r", rays, within, rays) ** -0.5, density.reach)
        table = density.rays(angles, sector)
        for outer in range(2):
            last = np.clip(np.sqrt(ends / density.reach), TABLES_MEET * outer, TABLES_MEET + TABLES_MEET * outer)
            nodes, node_weights = legendre_nodes(80)
            width = (last - TABLES_MEET * outer)[:, None]
            roots = TABLES_MEET * outer + width * nodes
            mass = table.density(roots, density.reach * roots**2, outer) * 2 * density.reach * roots * width
            found += 2 * float(weights @ mass @ node_weights)
    return found


def mass_over_times(shower: CompoundPoissonNoise, within: np.ndarray, seed: int) -> float:
    """Return the same by drawing the times of the jumps, given which what they add is normal."""
    mean, angles = shower.rate * shower.period, np.pi / 2 * (np.arange(64) + 0.5) / 64  # a quarter, as all are the same
    found = 0.0
    for count in range(1, int(mean + 12 * np.sqrt(mean) + 12)):
        times = shower.period * qmc.Sobol(count, seed=seed).random_base2(11)
        moved = shower.moved(times)
        covariance = np.einsum("qkij,qklj->qil", moved, moved)
        trace = np.einsum("qil,li->q", covariance, within)
        area = np.maximum(np.linalg.det(covariance) * np.linalg.det(within), 0.0)
        large = trace / 2 + np.sqrt(np.maximum(trace**2 / 4 - area, 0.0))
        size = large[:, None] * np.cos(angles) ** 2 + (area / large)[:, None] * np.sin(angles) ** 2
        found += float(poisson.pmf(count, mean)) * (1 - np.exp(-0.5 / size).mean())
    return found


@pytest.mark.evidence
@pytest.mark.parametrize("flat", [True, False], ids=["rank one", "rank two"])
@pytest.mark.parametrize("period", [0.25, 0.5])
def test_the_density_of_a_period_has_the_mass_that_drawn_times_give(period: float, flat: bool) -> None:
    """Over an ellipse, along rays and over the times of the jumps, within four standard errors of about 1e-6."""
    A = np.array([[0.1, 1.0], [-0.3, 0.0]])
    G = np.array([[0.0], [0.7]]) if flat else np.array([[0.5, 0.1], [0.0, 0.7]])
    shower = CompoundPoissonNoise(A, G, 5.0, period)
    root = np.linalg.cholesky(shower.covariance())
    white = CompoundPoissonNoise(np.linalg.solve(root, A @ root), np.linalg.solve(root, G), 5.0, period)
    within = np.array([[0.8, 0.3], [0.3, 0.5]])
    along = mass_on_rays(Density(white, quadrature.FINENESS[1]), within)
    drawn = [mass_over_times(white, within, seed) for seed in range(8)]
    assert abs(along - np.mean(drawn)) <= 4 * np.std(drawn, ddof=1) / np.sqrt(8)
    assert np.std(drawn) < 4e-6


def dense(of: Chain, cells: int) -> tuple[float, float]:
    """Return rate and excess of a scalar chain with a = 0 by midpoints on a fine grid, the mass at 0 kept apart."""
    bound = float(np.sqrt(of.delta / of.Psi[0, 0]))
    mean, variance = of.noise.jumps.rate * of.noise.period, float(of.noise.jumps.covariance[0, 0])
    grid = (np.arange(cells) + 0.5) / cells * 2 * bound - bound
    chance, kernel = np.exp(-mean), np.zeros((cells + 1, cells))
    for count in range(1, 60):
        chance *= mean / count
        steps = np.append(grid, 0.0)[:, None] - grid
        kernel += chance * np.exp(-(steps**2) / (2 * count * variance)) / np.sqrt(2 * np.pi * count * variance)
    kernel *= 2 * bound / cells
    stay = np.exp(-mean)
    sides = np.stack([np.ones(cells), grid**2 * of.Gamma[0, 0]], 1)
    inner = np.linalg.solve((1 - stay) * np.eye(cells) - kernel[:-1], sides)
    checks, cost = (np.array([1.0, 0.0]) + kernel[-1] @ inner) / (1 - stay)
    return 1 / checks, cost / checks


def test_a_scalar_chain_agrees_with_a_dense_grid() -> None:
    """Midpoints, whose error falls with the square of their number, extrapolated."""
    of = chain(0.0, 0.8, 3.0, 0.4, 2.0, Gamma=np.array([[2.0]]))
    coarse, fine = np.array(dense(of, 500)), np.array(dense(of, 1000))
    found = solve_jumps(of)
    assert [found.rate, found.excess] == pytest.approx(fine + (fine - coarse) / 3, rel=1e-7)


@pytest.mark.parametrize(
    ("a", "rate", "delta"),
    rows([(0.0, 5.0, 4.0), (0.7, 2.0, 3.0), (-0.8, 3.0, 1.0), (-0.3, 0.4, 1.0), (0.5, 60.0, 9.0)], quick=2),
)
def test_a_scalar_chain_agrees_with_its_simulation(a: float, rate: float, delta: float) -> None:
    """Stable and unstable errors, rare and frequent jumps."""
    agree(chain(a, 1.0, rate, 0.5, delta))


@pytest.mark.parametrize("seed", [0, 2])
@pytest.mark.evidence
def test_a_chain_in_the_plane_agrees_with_its_simulation(seed: int) -> None:
    """Jumps of either rank."""
    agree(random_chain(seed), 500, 200)


@pytest.mark.evidence
@pytest.mark.parametrize(
    "seed", sorted(set(range(3, 27)) - {5, 9, 11, 14, 15, 17, 19, 22})
)  # the others: slow, or hardly settle
def test_many_chains_in_the_plane_agree_with_their_simulations(seed: int) -> None:
    """Jumps of either rank, stable, unstable and nilpotent."""
    agree(random_chain(seed), 3000, 600)


@pytest.mark.evidence
@pytest.mark.parametrize("seed", range(30))
def test_many_chains_on_a_line_agree_with_their_simulations(seed: int) -> None:
    """Rare and frequent jumps, tight and wide thresholds, stable and unstable."""
    rng = np.random.default_rng(seed)
    rate = np.exp(rng.uniform(-1, 3))
    agree(chain(rng.normal(), 1.0, rate, 0.5, np.exp(rng.uniform(-1, 2)) * rate), 3000, 600)


def honest(of: Chain, accuracy: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check claimed errors against a finer run than any that is reached otherwise."""
    found = solve_jumps(of, accuracy)
    finest = (*quadrature.FINENESS, Fineness(64, 56, 1400))
    monkeypatch.setattr(quadrature, "FINENESS", finest)
    best = solve_jumps(of, 1e-12)
    assert abs(found.rate - best.rate) <= found.rate_error + best.rate_error
    assert abs(found.excess - best.excess) <= found.excess_error + best.excess_error
    assert best.rate_error < 0.05 * best.rate


@pytest.mark.evidence
@pytest.mark.parametrize("seed", [0, 2, 3, 4])
def test_claimed_errors_in_the_plane_are_no_less_than_the_true_ones(seed: int, monkeypatch) -> None:
    """At the first refinement, against the finest."""
    honest(random_chain(seed), 1e-2, monkeypatch)


@pytest.mark.parametrize("seed", few(range(4), quick=1, start=1))
def test_claimed_errors_on_a_line_are_no_less_than_the_true_ones(seed: int) -> None:
    """At the first refinement, against the finest."""
    rng = np.random.default_rng(seed)
    rate = np.exp(rng.uniform(-1, 4))
    of = chain(rng.normal(), 1.0, rate, 0.5, np.exp(rng.uniform(-1, 2)) * rate)
    found, best = solve_jumps(of, 1e-2), solve_jumps(of, 1e-14)
    assert abs(found.rate - best.rate) <= found.rate_error
    assert abs(found.excess - best.excess) <= found.excess_error
    assert best.rate_error < 1e-8 * best.rate


def test_many_small_jumps_are_gaussian_noise() -> None:
    """At a fixed intensity the rate goes to that of a random walk, as 1/λ does."""
    rates = [solve_jumps(chain(0.0, 1 / np.sqrt(rate), rate, 1.0, 4.0)).rate for rate in (20, 40, 80)]
    limit = rates[2] + (rates[2] - rates[1])
    grid, step = np.linspace(-2, 2, 2001), 4 / 2000
    weights = np.full(2001, step)
    weights[[0, -1]] /= 2
    kernel = np.exp(-(np.subtract.outer(grid, grid) ** 2) / 2) / np.sqrt(2 * np.pi) * weights
    checks = np.linalg.solve(np.eye(2001) - kernel, np.ones(2001))[1000]
    assert (rates[1] - rates[0]) / (rates[2] - rates[1]) == pytest.approx(2, rel=0.1)
    assert limit == pytest.approx(1 / checks, rel=1e-4)


@pytest.mark.parametrize("of", few([chain(0.4, 1.0, 1.0, 0.5, 3.0), random_chain(2)], quick=1), ids=["line", "plane"])
def test_intervals_sum_to_one_and_their_mean_is_the_inverse_rate(of: Chain) -> None:
    """The survival function starts at one, falls, and its sum is the mean."""
    found = solve_jumps(of, 1e-2)
    survival = found.intervals.survival
    assert survival[0] == 1
    assert (np.diff(survival) <= 0).all()
    assert found.intervals.probability(5000).sum() == pytest.approx(1, abs=1e-9)
    assert found.intervals.mean == pytest.approx(1 / found.rate, rel=1e-12)
    whole = survival.sum() + survival[-1] * (survival[-1] / survival[-2]) / (1 - survival[-1] / survival[-2])
    assert whole == pytest.approx(1 / found.rate, rel=1e-6)


def test_directions_that_no_jump_reaches_or_nothing_sees_do_not_count() -> None:
    """Three states with jumps in one of them, one that only follows it, and one that stands still."""
    A, G = np.diag([0.3, 0.0, -0.2]), np.array([[1.0], [0.0], [0.0]])
    A[2, 0] = 1.0
    weight = np.diag([1.0, 1.0, 0.0])
    noise = JumpNoise(A, Jumps(2.0, G @ G.T), 0.5)
    F = np.diag(np.exp(0.5 * np.diag(A)))
    found = solve_jumps(Chain(F, noise, weight, 2.0, weight))
    assert found.rate == pytest.approx(solve_jumps(chain(0.3, 1.0, 2.0, 0.5, 2.0)).rate, rel=1e-9)


def refused(of: Chain, words: str) -> None:
    """Check that a chain is refused."""
    with pytest.raises(NoQuadratureError, match=words):
        solve_jumps(of)


@pytest.mark.evidence
def test_a_chain_whose_digits_do_not_settle_is_refused() -> None:
    """After the finest nodes that are tried."""
    refused(random_chain(15), "have a relative error of")


def test_chains_beyond_the_method_are_refused_in_a_sentence() -> None:
    """Another law, three dimensions, no jumps, nothing sent, a turn within a period."""
    refused(chain(0.0, 1.0, 1.0, 1.0, 1.0, law="two-point"), "two-point")
    refused(chain(0.0, 1.0, 1.0, 1.0, 1.0, law="uniform"), "uniform")
    refused(chain(np.diag([0.1, 0.2, 0.3]), np.eye(3), 1.0, 1.0, 1.0), "3 dimensions")
    refused(Chain(np.eye(1), np.eye(1), np.eye(1), 1.0, np.eye(1)), "does not consist of jumps")
    refused(chain(0.0, 1.0, 1.0, 1.0, 1.0, Psi=np.zeros((1, 1))), "the policy would never send")
    refused(chain([[0.0, 4.0], [-4.0, 0.0]], [[1.0], [0.0]], 1.0, 1.0, 1.0), "half a turn")
    refused(chain(0.0, 1.0, 0.01, 1.0, 1.0), "too rare")
    refused(chain(0.0, 0.001, 1.0, 1.0, 1e4), "more than this quadrature supports")
