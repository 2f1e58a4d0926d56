"""Nearly best schedules: what they lose, the errors they are fitted to, units, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from counts import few
from drawn import rows
from scipy import stats
from scipy.optimize import brentq

from taciturn.errors import ProblemError
from taciturn.renewal.chain import Chain
from taciturn.renewal.gaussian import solve_gaussian
from taciturn_limits.dual import PRECISE
from taciturn_limits.fitted import PATHS, SNAPSHOTS, Lattice, fit_schedule, keep_errors
from taciturn_limits.optimal import solve_optimal

UNIT = np.eye(1)
SPIRAL = np.array([[0.9, 0.4], [-0.3, 1.0]])
NOISE = np.array([[1.0, 0.3], [0.3, 0.5]])
SEEN = np.array([[1.0, 0.2], [0.2, 0.4]])


def squares(error: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return e'Me of each row."""
    return ((error @ weight) * error).sum(axis=1)


@pytest.mark.parametrize(
    ("F", "price"), rows([(0.5, 2.0), (0.9, 5.0), (1.0, 10.0), (1.0, 0.5), (1.3, 20.0), (-1.1, 3.0)], quick=2, start=1)
)
def test_a_fitted_threshold_on_a_scalar_loses_less_than_a_lower_bound_can_tell(F: float, price: float) -> None:
    """What is sent lies beyond one point; as a threshold there it is solved exactly, and held against the optimum."""
    A = np.array([[F]])
    found = fit_schedule(A, UNIT, UNIT, price)

    def gained(e: float) -> float:
        return e * e - found.height * float(np.exp(-0.5 * found.Pi[0, 0] * e * e)) - found.gain

    last = float(brentq(gained, 0.0, 2 * np.sqrt(found.gain + found.height)))
    assert list(found.sends(np.array([[0.999 * last], [1.001 * last], [-1.001 * last]]), UNIT)) == [False, True, True]
    exact = solve_gaussian(Chain(A, UNIT, UNIT, last**2, UNIT))
    best = solve_optimal(A, UNIT, UNIT, price)
    cost = exact.excess + price * exact.rate
    assert best.cost * (1 - 1e-9) <= cost <= best.cost * (1 + PRECISE)


@pytest.mark.parametrize("states", [1, 2])
@pytest.mark.parametrize("delta", few([1.0, 3.0, 8.0], quick=1, start=1))
def test_the_errors_that_a_threshold_keeps_come_at_its_rate(states: int, delta: float) -> None:
    """Mean interval and mean cost against quadrature; intervals vary less than those of a coin."""
    F, noise, seen = (SPIRAL, NOISE, SEEN) if states == 2 else (UNIT, UNIT, UNIT)
    kept, interval = keep_errors(F, noise, lambda e: squares(e, seen) > delta)
    exact = solve_gaussian(Chain(F, noise, seen, delta, seen))
    counted = SNAPSHOTS * PATHS * exact.rate
    assert interval * exact.rate == pytest.approx(1.0, abs=4 / np.sqrt(counted))
    assert len(kept) == pytest.approx(SNAPSHOTS * PATHS * (1 - exact.rate), abs=4 * np.sqrt(counted))
    assert (squares(kept, seen) <= delta).all()
    mean = exact.excess / (1 - exact.rate)
    correlated = squares(kept, seen).std() / np.sqrt(len(kept) * exact.rate)  # one independent error per interval
    assert squares(kept, seen).mean() == pytest.approx(mean, abs=4 * correlated)


def test_units_of_error_and_cost_decide_nothing() -> None:
    """Errors a thousand times as large, costs a hundred times: the same errors are sent."""
    found = fit_schedule(SPIRAL, NOISE, SEEN, 5.0)
    large = fit_schedule(SPIRAL, 1e6 * NOISE, 1e-4 * SEEN, 500.0)
    assert large.gain == pytest.approx(100 * found.gain, rel=1e-6)
    assert large.height == pytest.approx(100 * found.height, rel=1e-5)
    assert large.interval == found.interval
    np.testing.assert_allclose(1e6 * large.Pi, found.Pi, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("seed", few(range(3), quick=1))
def test_what_no_noise_reaches_and_no_cost_sees_decides_nothing(seed: int) -> None:
    """A third state without noise, and a fourth that costs nothing: about the gain of the two others."""
    alone = fit_schedule(SPIRAL, NOISE, SEEN, 5.0, seed)
    F = np.zeros((4, 4))
    F[:2, :2], F[2, 2], F[3] = SPIRAL, 0.5, [0.2, 0.1, 0.0, 0.7]
    noise, seen = np.zeros((4, 4)), np.zeros((4, 4))
    noise[:2, :2], seen[:2, :2] = NOISE, SEEN
    noise[3, 3] = 1.0
    found = fit_schedule(F, noise, seen, 5.0, seed)
    best = solve_optimal(SPIRAL, NOISE, SEEN, 5.0).cost
    assert abs(found.gain - best) <= 0.02 * best  # the gain is an estimate, of 1200 errors
    assert abs(alone.gain - best) <= 0.02 * best
    assert np.isfinite(found.Pi).all()
    assert np.linalg.eigvalsh(found.Pi)[0] >= -1e-9 * np.linalg.eigvalsh(found.Pi)[-1]


def test_what_is_hardly_ever_sent_is_refused() -> None:
    """A price beyond what a stable error ever costs, and an error that nothing moves."""
    with pytest.raises(ProblemError, match=r"less than once in 5000 checks; expected a lower price or threshold"):
        fit_schedule(0.5 * UNIT, UNIT, UNIT, 100.0)
    with pytest.raises(
        ProblemError, match=r"affects no direction of the error to which Γ gives weight; expected at least one"
    ):
        fit_schedule(UNIT, 0 * UNIT, UNIT, 1.0)


def test_where_every_error_is_sent_there_are_errors_to_fit_to() -> None:
    """A price that no error is below: the schedule sends every sample, at its price."""
    found = fit_schedule(UNIT, UNIT, UNIT, 1e-9)
    assert found.interval == pytest.approx(1.0, abs=1e-3)
    assert found.gain == pytest.approx(1e-9, rel=1e-2)


@pytest.mark.parametrize("dimensions", [1, 2, 5])
def test_a_shifted_lattice_is_fair_and_even(dimensions: int) -> None:
    """Each point is standard normal over the copies; means over a copy are right, closer than drawn ones."""
    points, copies = 64, 2000
    found = Lattice(points, dimensions).normals(np.random.default_rng(3), copies)
    assert found.shape == (copies, points, dimensions)
    for point in (0, 17, 63):
        for entry in range(dimensions):
            assert stats.kstest(found[:, point, entry], "norm").pvalue > 1e-4
    means = np.exp(0.5 * found.sum(axis=2)).mean(axis=1)  # of a lognormal
    exact = np.exp(dimensions / 8)
    assert abs(means.mean() - exact) <= 4 * means.std(ddof=1) / np.sqrt(copies)
    drawn = np.sqrt((np.exp(dimensions / 4) - 1) * np.exp(dimensions / 4) / points)
    assert means.std() < 0.8 * drawn
    assert abs(found.mean(axis=1).mean(axis=0)).max() <= 4 / np.sqrt(points * copies)


def test_a_lattice_of_no_dimension_has_points() -> None:
    """Noise of rank zero is drawn like any."""
    assert Lattice(8, 0).normals(np.random.default_rng(0), 3).shape == (3, 8, 0)
