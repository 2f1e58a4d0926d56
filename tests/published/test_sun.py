"""Sun and others: when to sample for remote estimation (sun2020: a Wiener process, ornee2021: one that decays).

Their channels delay packets by random times. Compared is the case without delay, which is what Taciturn has.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
import scipy.special
from limits import assert_tends_to, waiting

from taciturn import ContinuousPlant, Cost, Network, Problem, evaluate


def best(a: float, price: float, period: float) -> tuple[float, float]:
    """Return the mean square and the mean wait of dx = ax dt + dv at the least of mean square and price times rate.

    It is looked at every period; what it does in between counts. An input that costs hardly anything keeps the state
    at what is known to be left of it, so that the cost of control is the mean square of the error.
    """
    plant, cost = ContinuousPlant([[a]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1e-13]])
    problem = Problem(plant, cost, Network(), "optimal", {"price": price, "period": period})
    found = evaluate(problem, standard_error=1e-9)
    return found.cost.value, 1 / found.rates["sensor"].value


def test_the_best_samples_of_a_wiener_process_cost_a_sixth_of_their_interval() -> None:
    """Mse = 1/(6f) at the rate f; at the price λ of a sample the squared level, which is the mean wait, is √(6λ)."""
    mean_squares, waits = [], []
    for looks in (10.0, 20.0, 40.0):
        mean_square, wait = best(0.0, 1 / 6, looks**-2)
        mean_squares.append(mean_square * 6 / wait)
        waits.append(wait)
    assert_tends_to(1, mean_squares)
    assert_tends_to(1, waits)


@pytest.mark.parametrize(("a", "price"), [(-1.0, 0.05), (-0.3, 0.2)])
def test_the_best_threshold_of_an_ornstein_uhlenbeck_process_is_the_published_one(a: float, price: float) -> None:
    """G(v√θ) = mse∞/(mse∞ − β), with G(x) = e^{x²} ∫₀ˣ e^{−t²} dt / x, a = −θ, mse∞ = 1/2θ and β the least cost.

    A threshold that is looked at is passed by a little, as if it were higher; v is the one with the same mean wait.
    """
    ratios, never = [], 1 / (-2 * a)
    for looks in (10.0, 20.0, 40.0):
        mean_square, wait = best(a, price, looks**-2)
        v = float(scipy.optimize.brentq(lambda level, wait=wait: waiting(a, level) - wait, 0.1, 3.0))
        x = v * np.sqrt(-a)
        G = np.sqrt(np.pi) / 2 * np.exp(x * x) * scipy.special.erf(x) / x
        ratios.append(G * (never - mean_square - price / wait) / never)
    assert_tends_to(1, ratios)
