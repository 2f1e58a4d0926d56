"""Best, nearly best and simple schedules in their order, and the lower bound below all of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from catalogue import POLICIES, closed, dear
from counts import scaled
from drawn import over
from hypothesis import assume
from measured import average
from scipy.optimize import newton
from systems import System, make_system, systems, well_posed

from taciturn import Plant, ProblemError, design
from taciturn.renewal.chain import Chain, NoQuadratureError, Renewal
from taciturn.renewal.gaussian import solve_gaussian
from taciturn_limits import dual
from taciturn_limits.bounds import bound_below
from taciturn_limits.dual import bound_schedules
from taciturn_limits.fitted import Fitted, fit_schedule
from taciturn_limits.optimal import Optimum, solve_optimal

ACCURACY = {1: 1e-7, 2: 1e-5, 3: 1e-3}
RATE = {1: 1e-6, 2: 1e-3, 3: 3e-3}  # of log(δ), to which a rate is met
PATHS, LOOKS, APART, BURN_IN = 400, 40, 10, 100
CONFIDENCE = 0.9999
RESETTING = ("lqg joint model", "absolute state model", "excess model", "stochastic model", "periodic model")


@pytest.fixture
def fewest_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spend a sixteenth of the paths on a bound: it holds as surely, and is a little lower."""
    monkeypatch.setattr(dual, "MOST", 1)


def spread_out(system: System) -> System:
    """Return the system with process noise in every direction, so that quadrature serves it."""
    n, plant = system.plant.states, system.plant
    turned = np.random.default_rng(system.seed).standard_normal((n, n))
    left, _, right = np.linalg.svd(turned)
    noise = 0.3 * left * np.geomspace(1.0, 0.3, n) @ right
    W = noise @ noise.T
    seen = Plant(plant.A, plant.B, W) if plant.full_state else Plant(plant.A, plant.B, W, plant.C, plant.V)
    return replace(system, plant=seen)


@dataclass(frozen=True, eq=False)
class Case:
    """An error that a send resets, at a price, and the cost of sending it always."""

    F: np.ndarray
    noise: np.ndarray
    Gamma: np.ndarray
    price: float
    base: float

    def threshold(self, delta: float) -> Renewal:
        """Return the threshold on what silence costs."""
        return solve_gaussian(Chain(self.F, self.noise, self.Gamma, delta, self.Gamma), ACCURACY[len(self.F)])


def case(seed: int, states: int) -> Case | None:
    """Return the error of a random plant, measured in full or in as many outputs as states; None if it is ill-posed."""
    draws = np.random.default_rng(seed)
    system = spread_out(make_system(seed, states, int(draws.integers(1, states + 1)), states, bool(draws.integers(2))))
    if not (well_posed(system.plant.A, system.plant.B) and well_posed(system.plant.A.T, system.plant.C.T)):
        return None
    policy = design.excess(system.plant, system.cost, delta=0.0, actuation="model")
    assert policy.theory.reset is not None
    noise, Gamma = policy.theory.reset.covariance, policy.theory.reset.weight
    price = float(np.trace(Gamma @ noise) * 10 ** draws.uniform(0.0, 1.0))
    return Case(system.plant.A, noise, Gamma, price, policy.cost_all_time)


def walk(found: Case, schedule: Fitted, best: Optimum, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return cost and price per check of a schedule, and what it loses by deciding otherwise than the best: per path.

    The loss is exact in the mean: a schedule's cost beyond g is E|U(e)| over the errors where it decides otherwise.
    """
    draws, states = np.random.default_rng(seed), len(found.F)
    half = np.linalg.cholesky(found.noise)
    error, cost, lost = np.zeros((PATHS, states)), np.zeros(PATHS), np.zeros(PATHS)
    for check in range(BURN_IN + LOOKS * APART):
        error = error @ found.F.T + draws.standard_normal((PATHS, states)) @ half.T
        sent = schedule.sends(error, found.Gamma)
        if check >= BURN_IN:
            square = ((error @ found.Gamma) * error).sum(axis=1)
            cost += np.where(sent, found.price, square) / (LOOKS * APART)
            if check % APART == 0:
                gained = best.value(error)
                lost += np.where(sent != (gained > 0), np.abs(gained), 0.0) / LOOKS
        error[sent] = 0.0
    return cost, lost


def mean_of(values: np.ndarray) -> tuple[float, float]:
    """Return mean and standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def schedules_are_in_order(seed: int, states: int) -> np.ndarray | None:
    """Lower bound ≤ best ≤ nearly best ≤ threshold at the same rate; None of what no quadrature serves.

    Returns what the bound, the nearly best and the threshold are off the best, in units of its cost.
    """
    found = case(seed, states)
    if found is None:
        return None
    try:
        best = solve_optimal(found.F, found.noise, found.Gamma, found.price, ACCURACY[states])
        if best.rate < 0.05 or best.cost_error > 1e-3 * best.cost:
            return None
        fitted = fit_schedule(found.F, found.noise, found.Gamma, found.price)
        bound = bound_schedules(found.F, found.noise, found.Gamma, found.price, fitted, CONFIDENCE)
        start = np.log(found.price / 1.6)

        def above(log_delta: float) -> float:
            return float(np.log(found.threshold(float(np.exp(log_delta))).rate / best.rate))

        # nearly a line: secants need half of what a bracket does, and what they find is checked below
        simple = found.threshold(float(np.exp(newton(above, start, x1=start + 0.3, tol=RATE[states]))))
    except NoQuadratureError:
        return None
    total = found.base + best.excess
    cost, lost = walk(found, fitted, best, seed)
    (mean, error), (loss, loss_error) = mean_of(cost), mean_of(lost)
    assert abs(mean - best.cost - loss) <= 4.5 * np.hypot(error, loss_error) + best.cost_error
    assert bound.gain <= best.cost + best.cost_error
    assert best.cost - bound.gain <= 0.01 * total
    # at the same rate, but for what the root is off, whose worth is the price
    assert abs(simple.rate - best.rate) <= 2 * RATE[states] * best.rate + simple.rate_error + best.rate_error
    of_simple = simple.excess + found.price * simple.rate
    claimed = simple.excess_error + found.price * simple.rate_error + best.cost_error
    assert of_simple >= best.cost - claimed
    if states == 1:  # an interval either way
        assert of_simple <= best.cost + claimed + 1e-9 * best.cost
    else:
        assert best.cost + loss <= of_simple + claimed + 4 * loss_error
    return np.array([best.cost - bound.gain, loss, of_simple - best.cost]) / total


def ordered(count: int, sizes: list[int], seed: int) -> np.ndarray:
    """Return what so many random plants show, of sizes in turn."""
    found: list[np.ndarray] = []
    while len(found) < count:
        shown = schedules_are_in_order(seed, sizes[len(found) % len(sizes)])
        found += [] if shown is None else [shown]
        seed += 1
    return np.array(found)


@pytest.mark.evidence
@pytest.mark.usefixtures("fewest_paths")
def test_best_nearly_best_and_threshold_are_in_order() -> None:
    """A random plant of one state and one of two: bound ≤ best ≤ nearly best ≤ threshold at the same rate."""
    ordered(2, [1, 2], seed=10)


@pytest.mark.evidence
def test_best_nearly_best_and_threshold_are_in_order_on_50_plants() -> None:
    """One, two and three states: bound ≤ best ≤ nearly best ≤ threshold at the same rate; the bound within 1 %."""
    gaps = ordered(scaled(50, 10), [1, 2, 2, 2, 2, 1, 2, 2, 2, 3], seed=1000)
    for name, gap in zip(("below the best: bound", "above it: nearly best", "threshold"), gaps.T, strict=True):
        print(f"{name}: median {np.median(gap):.2e}, most {gap.max():.2e} of the cost")
    assert np.median(gaps[1::5, 1]) < 0.1 * np.median(gaps[1::5, 2])


def nearly_best_and_bound_meet(system: System, precision: float) -> float | None:
    """Return how far above the lower bound the nearly best schedule costs, over its cost; it never costs less."""
    try:
        loop = closed(design.near_optimal(system.plant, system.cost, price=dear(system)))
        found = average(loop, seed=system.seed, standard_error=precision * loop.policy.cost_all_time)
        rate = found.rates["actuator"]
        bound = bound_below(loop, min(rate.value, 1.0), CONFIDENCE)
    except ProblemError:
        return None  # hardly anything is sent
    error = float(np.hypot(found.cost.standard_error, bound.price * rate.standard_error))
    assert bound.cost <= found.cost.value + 4 * error
    assert found.cost.value - bound.cost <= 0.01 * found.cost.value + 4 * error
    return (found.cost.value - bound.cost) / found.cost.value


def meetings(count: int, sizes: list[int], seed: int, precision: float = 1e-4) -> np.ndarray:
    """Return the gaps of so many random plants, of sizes in turn."""
    gaps: list[float] = []
    while len(gaps) < count:
        draws = np.random.default_rng(seed)
        n = sizes[len(gaps) % len(sizes)]
        system = spread_out(make_system(seed, n, int(draws.integers(1, 4)), n, bool(draws.integers(2))))
        if well_posed(system.plant.A, system.plant.B) and well_posed(system.plant.A.T, system.plant.C.T):
            gap = nearly_best_and_bound_meet(system, precision)
            gaps += [] if gap is None else [gap]
        seed += 1
    return np.array(gaps)


@pytest.mark.evidence
@pytest.mark.usefixtures("fewest_paths")
def test_little_is_left_between_the_nearly_best_schedule_and_the_lower_bound() -> None:
    """A plant of four states: at most 1 % of the cost, which bounds what the best could save."""
    meetings(1, [4], seed=50, precision=5e-4)


@pytest.mark.evidence
def test_little_is_left_between_the_nearly_best_schedule_and_the_lower_bound_on_a_dozen_plants() -> None:
    """Four, five and six states: at most 1 % of the cost."""
    gaps = meetings(scaled(12, 3), [4, 5, 6], seed=300)
    print(f"gaps over the cost: median {np.median(gaps):.2e}, most {gaps.max():.2e}")


def no_policy_beats_the_lower_bound(system: System, name: str, steps: int) -> None:
    """The cost of a policy is that of no better schedule than the bound at its rate allows."""
    loop = closed(POLICIES[name](system))
    assert loop.policy.theory.reset is not None
    found = average(loop, seed=system.seed, steps=steps)
    rate = found.rates["actuator"]
    assume(found.reached and rate.value > 0.02)
    try:
        bound = bound_below(loop, min(rate.value, 1.0), CONFIDENCE, system.seed)
    except ProblemError:
        assume(False)
        raise
    error = np.hypot(found.cost.standard_error, bound.price * rate.standard_error)
    assert found.cost.value + 4 * error >= bound.cost * (1 - 1e-9)
    assert bound.cost >= loop.policy.cost_all_time


@pytest.mark.evidence
@pytest.mark.usefixtures("fewest_paths")
@pytest.mark.parametrize("name", RESETTING[::3])
def test_no_policy_beats_the_lower_bound(name: str) -> None:
    """Random systems, unstable plants and cross terms included."""
    over(lambda system: no_policy_beats_the_lower_bound(system, name, 200_000), 2, system=systems(states=4))


@pytest.mark.evidence
@pytest.mark.parametrize("name", RESETTING)
def test_no_policy_beats_the_lower_bound_over_100_systems(name: str) -> None:
    """Random systems, unstable plants and cross terms included, 20 of each policy."""
    steps, systems_each = scaled(2_000_000, 250_000), scaled(20, 5)
    over(lambda system: no_policy_beats_the_lower_bound(system, name, steps), systems_each, system=systems())
