"""Events for integrators of many dimensions: under the Euclidean norm (andren2017) and the maximum norm (meister2023).

Noise of intensity I drives n integrators, and a send resets all of them. Periodic sends at the mean wait T cost
tr(Q) T/2. Looked at N times per wait, events cost a little more than watched ones; the difference falls with 1/N.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import scipy.optimize

from taciturn import Cost, Plant, average, close
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Decide, Received, Send
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Trigger
from taciturn.renewal.chain import Chain
from taciturn.renewal.gaussian import solve_gaussian
from taciturn.renewal.paths import solve_paths


def improvement(Q: np.ndarray, excess: float, looks: float) -> float:
    """Return the periodic cost over that of events which are looked at so often per wait; time in between counts."""
    between = np.trace(Q) / 2
    return float(looks * between / (excess + between))


def limit(ratios: list[float], looks: list[float]) -> float:
    """Return what two ratios tend to if what is missing falls with 1/looks."""
    return (ratios[1] * looks[1] - ratios[0] * looks[0]) / (looks[1] - looks[0])


def best_ellipsoid(Q: np.ndarray) -> np.ndarray:
    """Return P with P tr(P) + 2P² = Q for a diagonal Q: sends at x'Px = c are the best at the price c²/2."""
    q = np.diag(Q)

    def shape(trace: float) -> np.ndarray:
        return (np.sqrt(trace**2 + 8 * q) - trace) / 4

    trace = scipy.optimize.brentq(lambda t: shape(t).sum() - t, 1e-9, 10 * np.sqrt(q.sum()), xtol=1e-14)
    return np.diag(shape(float(trace)))


QUICK, FULL = (1.5, 3.0, 6.0), pytest.param((5.0, 10.0, 20.0), marks=pytest.mark.evidence)


@pytest.mark.parametrize(("weights", "published"), [((1.0, 1.0), 2.0), ((1.0, 9.0), 2.41460)], ids=["I", "diag(1, 9)"])
@pytest.mark.parametrize("levels", [QUICK, FULL])
def test_events_in_the_plane_improve_on_the_clock_as_published(
    weights: tuple[float, float], published: float, levels: tuple[float, ...]
) -> None:
    """tr(Q)/tr(P)² at equal rate, by quadrature: 1 + 2/n for Q = I."""
    Q = np.diag(weights)
    P = best_ellipsoid(Q)
    assert np.trace(Q) / np.trace(P) ** 2 == pytest.approx(published, abs=5e-6)
    P = P / P.max()  # the level is that of the stiffest direction
    looks, ratios = [], []
    for level in levels:
        found = solve_gaussian(Chain(np.eye(2), np.eye(2), P, level**2, Q), accuracy=1e-4)
        looks.append(1 / found.rate)
        ratios.append(improvement(Q, found.excess, 1 / found.rate))
        assert ratios[-1] < published  # no schedule improves on the best one that is watched
    first, second = (limit(list(r), list(n)) for r, n in zip(pairwise(ratios), pairwise(looks), strict=True))
    assert abs(second - published) <= abs(second - first)
    assert abs(second - first) < 0.02 * published


@pytest.mark.evidence
@pytest.mark.parametrize("n", [3, 5, 10])
def test_events_in_more_dimensions_improve_on_the_clock_by_two_over_n(n: int) -> None:
    """1 + 2/n by conditional sampling, which has no limit of dimensions, extrapolated as above."""
    one = np.eye(n)
    looks, ratios, errors = [], [], []
    for level in (2.5, 5.0, 10.0):
        found = solve_paths(Chain(one, one, one, level**2, one), standard_error=2e-3, seed=0)
        waits, cost = 1 / found.rate.value, found.excess.value + n / 2
        looks.append(waits)
        ratios.append(improvement(one, found.excess.value, waits))
        relative = np.array([-waits, -1 / cost])
        errors.append(ratios[-1] * np.sqrt(relative @ found.covariance @ relative))
    first, second = (limit(list(r), list(m)) for r, m in zip(pairwise(ratios), pairwise(looks), strict=True))
    error = np.hypot(errors[2] * looks[2], errors[1] * looks[1]) / (looks[2] - looks[1])
    assert abs(second - (1 + 2 / n)) <= abs(second - first) + 4 * error
    assert 4 * error < 0.02


def worse_than_the_clock(n: int, level: float, steps: int) -> tuple[float, float, float]:
    """Return the cost of sends at max |x_i| > level over that of periodic ones, its standard error, checks per wait.

    Both are looked at as often: in N looks the periodic cost is n (N − 1)/2.
    """
    one = np.eye(n)
    plant = Plant(one, one, one)
    rule = Trigger({
        "silent": Form(),
        **{f"state {i}": Form(("y",), -np.diag(one[i]), level**2) for i in range(n)},
    })  # fmt: skip
    policy = Policy(
        kind="maximum norm",
        steps=(
            Decide("controller", "send", rule),
            Assign("controller", "command", {"y": -one}),
            Send("controller", "actuator", ("command",), "send"),
            Assign("actuator", "input", ({"input": 0 * one}, {"command": one}), Received("actuator")),
        ),
        model=plant,
        theory=Theory(cost=Cost(one, 1e-12 * one)),
        sites=(frozenset({"sensor", "controller"}),),
    )
    found = average(close(plant, policy), steps=steps)
    looks = 1 / found.rates["actuator"].value
    clock = n * (looks - 1) / 2
    return (found.cost.value - n) / clock, found.cost.standard_error / clock, looks


def lost(n: int) -> float:
    """Return the same ratio of n Wiener processes that are watched: 2 ∫ pⁿ⁻¹ m dt / (∫ pⁿ dt)², from 38 on above 1.

    p(t) is the probability that one of them has stayed within ±1, m(t) the mean square of one where it has.
    """
    t = np.linspace(1e-3, 12.0, 20_001)
    k = np.arange(40)[:, None]
    mode = (k + 0.5) * np.pi
    decay, sign = np.exp(-(mode**2) * t / 2), (-1.0) ** k
    p, m = (2 * sign / mode * decay).sum(axis=0), (2 * sign * (1 / mode - 2 / mode**3) * decay).sum(axis=0)
    wait, cost = 1e-3 + np.trapezoid(p**n, t), 5e-7 + np.trapezoid(p ** (n - 1) * m, t)
    return float(2 * cost / wait**2)


@pytest.mark.parametrize(
    ("n", "level", "steps"),
    [
        (16, 10.0, 200_000),
        pytest.param(24, 40.0, 40_000_000, marks=pytest.mark.evidence),
        pytest.param(64, 40.0, 20_000_000, marks=pytest.mark.evidence),
        pytest.param(100, 40.0, 10_000_000, marks=pytest.mark.evidence),
    ],
)
def test_the_maximum_norm_loses_against_the_clock_in_many_dimensions(n: int, level: float, steps: int) -> None:
    """It wins below 38 dimensions and loses above; the ratio is that of independent processes, to 1/looks."""
    ratio, error, looks = worse_than_the_clock(n, level, steps)
    assert abs(ratio - lost(n)) <= 4 * error + 1 / looks
    wins, loses = ratio < 1 - 4 * error, ratio > 1 + 4 * error
    assert wins if n < 38 else loses
    assert lost(37) < 1 < lost(38)
