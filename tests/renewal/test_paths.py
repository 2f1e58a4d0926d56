"""Conditional (survival-weighted) sampling: against closed forms, the quadrature, plain simulation, its own claims."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.special
import scipy.stats
from counts import few
from drawn import rows
from renewal.chains import KINDS, large_chain, simulated

import taciturn
from taciturn.analyse.renewal import chain_of
from taciturn.errors import ProblemError
from taciturn.model.plant import JumpNoise, Jumps
from taciturn.renewal import paths
from taciturn.renewal import paths as _randomisation
from taciturn.renewal.chain import Chain, NoQuadratureError
from taciturn.renewal.gaussian import solve_gaussian
from taciturn.renewal.paths import solve_paths
from taciturn.simulation.average import average

UNIT = np.eye(2)


def agrees(found, rate, excess):
    """Check an answer against numbers with errors of their own, within four standard errors."""
    for one, (value, error) in ((found.rate, rate), (found.excess, excess)):
        assert abs(one.value - value) <= 4 * np.hypot(one.standard_error, error) + 1e-13 * abs(value)


@pytest.mark.parametrize("states", few([1, 2, 4, 6], quick=2, start=1))
@pytest.mark.parametrize("delta", [0.5, 3.0])
def test_without_memory_white_noise_is_sent_with_the_probability_of_a_chi_square(states, delta):
    """For F = 0 the rate is P(χ² > δ) and the excess n P(χ²_{n+2} ≤ δ)."""
    unit = np.eye(states)
    found = solve_paths(Chain(0 * unit, unit, unit, delta, unit), standard_error=1e-3)
    excess = states * scipy.stats.chi2.cdf(delta, states + 2)
    agrees(found, (scipy.stats.chi2.sf(delta, states), 0.0), (excess, 0.0))


@pytest.mark.evidence
@pytest.mark.parametrize("seed", few(range(6), quick=1, start=1))
def test_the_quadrature_agrees_within_four_standard_errors(seed):
    """Rate, excess and survival of chains in one, two and three dimensions of each kind."""
    states = 1 + seed % 3
    chain = large_chain(seed, states, states, list(KINDS)[seed // 2])
    wanted = 1e-3 if states == 3 else 2e-4
    exact, found = solve_gaussian(chain, 1e-2 * wanted), solve_paths(chain, standard_error=wanted, seed=seed)
    agrees(found, (exact.rate, exact.rate_error), (exact.excess, exact.excess_error))
    assert found.reached
    checks = np.arange(min(12, len(found.survival_error)))
    spread = scipy.stats.t.isf(1e-5, found.randomisations - 1) * found.survival_error[: len(checks)]
    off = found.intervals.beyond(checks) - exact.intervals.beyond(checks)
    assert (np.abs(off) <= spread + exact.rate_error / exact.rate**2).all()  # what the sum of all is off by


@pytest.mark.parametrize(
    ("states", "noises", "seen", "kind"),
    rows(
        [
            (4, 4, None, "stable"),
            (4, 2, None, "unstable"),
            (4, 2, 1, "neutral"),
            (5, 1, None, "neutral"),
            (6, 3, 2, "stable"),
            (6, 1, 1, "unstable"),
        ],
        quick=1,
    ),
)
def test_a_simulation_in_many_dimensions_agrees_within_four_standard_errors(states, noises, seen, kind):
    """Four to six states, noise of full and of low rank, kept sets that are ellipsoids, cylinders and slabs."""
    chain = large_chain(states + noises, states, noises, kind, seen=seen)
    agrees(solve_paths(chain, standard_error=1e-3), *simulated(chain, 0))


@pytest.mark.evidence
def test_a_rank_that_rounding_blurs_changes_nothing():
    """One noise in five states, whose covariance has further eigenvalues of rounding."""
    chain = large_chain(34, 5, 1, "neutral", 6.4)
    agrees(solve_paths(chain, standard_error=2e-3), *simulated(chain, 34))


def test_a_check_that_sees_none_of_its_own_noise_is_solved():
    """A chain of four integrators, noise on the first, Ψ on the last: the first three checks keep every error."""
    F = np.eye(4) + np.diag([0.5] * 3, -1)
    chain = Chain(F, np.diag([1.0, 0, 0, 0]), np.diag([0, 0, 0, 1.0]), 0.02, np.eye(4))
    found = solve_paths(chain, standard_error=1e-3)
    assert found.intervals.beyond([1, 2, 3]) == pytest.approx(1.0, abs=1e-12)
    assert found.intervals.beyond(4) == pytest.approx(scipy.special.erf(np.sqrt(0.02 / 2) / 0.5**3), rel=2e-3)
    agrees(found, *simulated(chain, 1))


def test_directions_that_nothing_sees_do_not_count():
    """A growing direction that neither Ψ nor Γ sees changes no number, to the last digits."""
    chain = large_chain(3, 4, 4)
    F, noise, Psi, Gamma = (np.zeros((5, 5)) for _ in range(4))
    F[:4, :4], noise[:4, :4], Psi[:4, :4], Gamma[:4, :4] = chain.F, chain.noise, chain.Psi, chain.Gamma
    F[4], noise[4, 4] = 3.0, 1.0
    alone, beside = (solve_paths(each, standard_error=1e-3) for each in (chain, Chain(F, noise, Psi, 2.0, Gamma)))
    agrees(beside, (alone.rate.value, alone.rate.standard_error), (alone.excess.value, alone.excess.standard_error))


def test_a_cost_of_what_the_trigger_does_not_see_counts():
    """A walk next to independent draws costs a unit per kept check since the last send: p/(1 − p) in the mean."""
    chain = Chain(np.diag([0.0, 1.0]), UNIT, np.diag([1.0, 0.0]), 1.0, np.diag([0.0, 1.0]))
    kept = scipy.special.erf(1 / np.sqrt(2))
    found = solve_paths(chain, standard_error=1e-3)
    agrees(found, (1 - kept, 0.0), (kept / (1 - kept), 0.0))


def test_the_weights_of_resampled_paths_stay_unbiased(monkeypatch):
    """Resampled in every check, from pseudo-random numbers alone, the paths have the survival that is known."""
    monkeypatch.setattr(_randomisation, "DEGENERATE", 2.0)
    monkeypatch.setattr(_randomisation, "DIMENSIONS", 0)
    unit = np.eye(1)
    chain = Chain(0.7 * unit, unit, unit, 4.0, unit)
    exact, found = solve_gaussian(chain), solve_paths(chain, standard_error=2e-3)
    agrees(found, (exact.rate, exact.rate_error), (exact.excess, exact.excess_error))


@pytest.mark.parametrize("states", [1, 4])
@pytest.mark.evidence
def test_standard_errors_are_those_of_repeated_runs(states):
    """Over 30 seeds the answers spread as they claim, and their covariance is theirs: a chi-square test of 29."""
    chain = large_chain(2, states, min(states, 2), delta=3.0)
    runs = [solve_paths(chain, standard_error=0.1, seed=seed) for seed in range(30)]
    for name, index in (("rate", 0), ("excess", 1)):
        values = np.array([getattr(run, name).value for run in runs])
        claimed = np.mean([run.covariance[index, index] for run in runs])
        low, high = scipy.stats.chi2.ppf([1e-4, 1 - 1e-4], 29) / 29
        assert 0.8 * low <= values.var(ddof=1) / claimed <= 1.2 * high  # the claims' own mean is known to a tenth
    both = np.array([[run.rate.value, run.excess.value] for run in runs])
    assert np.sign(np.corrcoef(both.T)[0, 1]) == np.sign(np.mean([run.covariance[0, 1] for run in runs]))


def test_points_that_fill_space_beat_pseudo_random_ones(monkeypatch):
    """On short intervals the same number of paths has a tenth of the standard error, or less."""
    chain = large_chain(1, 4, 2, delta=1.0)
    even = solve_paths(chain, standard_error=0.5)
    monkeypatch.setattr(_randomisation, "DIMENSIONS", 0)
    random = solve_paths(chain, standard_error=0.5)
    assert even.paths == random.paths
    assert even.rate.standard_error < random.rate.standard_error / 3


@pytest.mark.evidence
def test_an_accuracy_that_the_budget_does_not_reach_is_told():
    """The answer of a budget that ends first says so, and still agrees."""
    chain = large_chain(5, 2, 2, delta=5.0)
    exact, found = solve_gaussian(chain, 1e-5), solve_paths(chain, standard_error=1e-7, steps=300_000)
    assert not found.reached
    assert found.rate.standard_error > 1e-7 * found.rate.value
    agrees(found, (exact.rate, exact.rate_error), (exact.excess, exact.excess_error))


@pytest.mark.evidence
def test_a_tail_that_is_cut_early_is_extrapolated_and_counted(monkeypatch):
    """Left at a survival of a fifth, the answer is still right within its errors, which are larger for it."""
    unit = np.eye(1)
    chain = Chain(0.7 * unit, unit, unit, 4.0, unit)
    whole = solve_paths(chain, standard_error=1e-2)
    monkeypatch.setattr(paths, "CUT", 20.0)
    cut, exact = solve_paths(chain, standard_error=1e-2), solve_gaussian(chain)
    assert len(cut.intervals.survival) < len(whole.intervals.survival)
    assert cut.rate.standard_error > whole.rate.standard_error
    agrees(cut, (exact.rate, exact.rate_error), (exact.excess, exact.excess_error))


def test_intervals_sum_to_the_mean_that_the_rate_says():
    """Survival falls from one, its decay is below one, and the mean interval is one over the rate."""
    found = solve_paths(large_chain(8, 5, 2), standard_error=1e-3)
    assert found.intervals.survival[0] == 1
    assert (np.diff(found.intervals.survival) <= 1e-15).all()
    assert 0 <= found.intervals.decay < 1
    assert found.intervals.mean * found.rate.value == pytest.approx(1, abs=1e-12)


def test_a_seed_decides_every_digit():
    """The same seed gives the same answer, another one another."""
    chain = large_chain(7, 4, 2)
    first, again, other = (solve_paths(chain, standard_error=1e-2, seed=seed) for seed in (3, 3, 4))
    assert first.rate == again.rate
    assert first.rate != other.rate


@pytest.mark.parametrize(("low", "high"), [(-1.0, 2.0), (37.0, 38.0), (-38.5, -37.0), (50.0, 60.0), (-1e17, 1e17)])
def test_truncated_draws_stay_on_their_chord_however_far_out_it_is(low, high):
    """Finite, ordered, between the ends, with the share of the chord; where that is no number, it is 0."""
    uniform = np.array([2.0**-31, 0.3, 0.5, 0.9, 1 - 2.0**-31])
    draws, share = _randomisation._truncated(np.full(5, low), np.full(5, high), uniform)
    assert (draws >= low).all()
    assert (draws <= high).all()
    assert (np.diff(draws) >= 0).all()
    nearer, farther = sorted((abs(low), abs(high)))
    expected = scipy.special.ndtr(-nearer) - scipy.special.ndtr(-farther) if low * high > 0 else None
    assert share == pytest.approx(scipy.special.ndtr(high) - scipy.special.ndtr(low) if expected is None else expected)


@pytest.mark.evidence
@pytest.mark.parametrize(
    ("chain", "sentence"),
    [
        (Chain(UNIT, 0 * UNIT, UNIT, 1.0, UNIT), "the policy would never send"),
        (Chain(UNIT, UNIT, 0 * UNIT, 1.0, UNIT), "the policy would never send"),
        (Chain(0 * UNIT, UNIT, UNIT, 60.0, UNIT), "the probability of no send in 4096 checks is 1, "),
        (Chain(np.diag([0.5, 2.0]), UNIT, np.diag([1.0, 0]), 1.0, UNIT), "grows without bound in a direction"),
        (Chain(UNIT, JumpNoise(UNIT, Jumps(1.0, UNIT), 1.0), UNIT, 1.0, UNIT), "the noise consists of jumps"),
    ],
)
def test_what_paths_do_not_solve_is_refused_with_a_sentence(chain, sentence):
    """No sends, hardly any, a cost without end, jumps."""
    with pytest.raises(NoQuadratureError, match=sentence):
        solve_paths(chain)


@pytest.mark.parametrize("wrong", [{"standard_error": 0.0}, {"standard_error": np.nan}, {"seed": -1}, {"steps": 0}])
def test_an_effort_that_is_none_is_refused(wrong):
    """An accuracy of 0, no number, a negative seed, no steps."""
    with pytest.raises(ProblemError):
        solve_paths(large_chain(1, 2, 2), **wrong)


@pytest.mark.evidence
@pytest.mark.parametrize("seed", range(60))
def test_sixty_chains_in_many_dimensions_agree_with_simulation(seed):
    """One to six states, every kind and rank of noise and trigger."""
    draws = np.random.default_rng(seed)
    states = 1 + seed % 6
    chain = large_chain(
        seed, states, int(draws.integers(1, states + 1)), list(KINDS)[seed % 3], 10 ** draws.uniform(-0.5, 1)
    )
    agrees(solve_paths(chain, standard_error=2e-3, seed=seed), *simulated(chain, seed))


@pytest.mark.evidence
def test_a_weight_of_rank_one_is_one_chord_whatever_rounding_makes_of_its_other_directions() -> None:
    """The pendulum's input alone decides: the rate falls smoothly with the threshold, and is what is simulated."""
    pendulum = taciturn.load("inverted-pendulum")
    rates: list[float] = []
    for threshold in [*np.linspace(0.17, 0.19, 9), 0.18174077747525766]:
        rule = {"theta": None, "kind": "absolute", "threshold": float(threshold), "actuation": "model"}
        problem = pendulum.changed(rule)
        loop = problem.close(problem.design())
        rates.append(solve_paths(chain_of(loop), standard_error=1e-3).rate.value)
    falls = -np.diff(rates[:-1])
    assert falls.max() < 1.1 * falls.min()
    simulated = average(loop, steps=4_000_000, seed=1).rates["actuator"].scaled(loop.policy.tick)  # per check
    assert abs(rates[-1] - simulated.value) <= 4 * simulated.standard_error
