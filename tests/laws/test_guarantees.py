"""What is proved of the policies holds for random systems, unstable plants and cross terms included."""

from __future__ import annotations

import numpy as np
import pytest
from catalogue import CLOSED_FORM, FIELD, GUARANTEED, IDENTITY, POLICIES, closed
from counts import few, scaled
from drawn import over
from hypothesis import assume
from hypothesis import strategies as st
from measured import agree_together, average
from systems import System, systems

from taciturn import ContinuousPlant, Cost, Loop, Policy, close, design
from taciturn.base.certainty import Actuation
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.riccati import regulate
from taciturn.lqg.sampling import sample
from taciturn.model.steps import Decide
from taciturn.simulation.average import completed_squares, plain_average
from taciturn.simulation.sampling import Averages, Estimator

STEPS, FEW_STEPS = scaled(500_000, 120_000), 100_000
MOST_STEPS = 5_000_000  # a loop that keeps its start for longer hardly sends, and more steps show little


def settled(loop: Loop, estimator: Estimator | None, seed: int, steps: int) -> Averages:
    """Return an average over at least so many steps, more where the loop needs them to forget its start."""
    found = average(loop, estimator, seed=seed, steps=steps)
    return found if found.reached or steps > MOST_STEPS else settled(loop, estimator, seed, 4 * steps)


def no_policy_exceeds_its_guarantee(system: System, name: str, steps: int = STEPS // 2) -> None:
    """J_all ≤ J ≤ bound, and J ≤ bound at its rate where there is one, as simulated with the full plant's law."""
    policy = POLICIES[name](system)
    found = settled(closed(policy), None, system.seed, steps)
    assert policy.guarantee is not None
    assert found.cost.value - 4 * found.cost.standard_error <= policy.guarantee.cost * (1 + 1e-9)
    assert found.cost.value + 4 * found.cost.standard_error >= policy.cost_all_time * (1 - 1e-9)
    sharper = policy.guarantee.at_rates(found.rates, policy.scheduled[0])
    if sharper is not None:
        slack = 4 * (found.cost.standard_error + sharper.standard_error)
        assert found.cost.value <= sharper.value * (1 + 1e-9) + slack


def test_the_statement_of_a_sampled_plant_leaves_out_what_noise_costs_between_samples() -> None:
    """θ and β multiply only what control changes, and the number is that of the statement."""
    plant = ContinuousPlant([[0.0, 1.0], [3.0, -0.1]], [[0.0], [1.0]], [[0.1, 0.0], [0.0, 0.2]])
    cost, h = Cost(np.eye(2), [[0.5]]), 0.2
    best = design.all_time(plant, cost, period=h).cost_all_time
    noise = sample(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W, h).noise_cost / h
    plain = "c the inter-sample noise cost in the same unit, mean-square stable"
    proved = {
        f"J ≤ (1+θ) J_all − θc, {plain}": (design.lqg(plant, cost, theta=0.1, period=h), 1.1 * best - 0.1 * noise),
        f"J ≤ β J_all − (β−1)c, {plain}": (
            design.self_triggered(plant, cost, beta=1.5, max_interval=3, period=h),
            1.5 * best - 0.5 * noise,
        ),
        f"J ≤ (1+θ)(J_all + ζ) − θc, {plain}": (
            design.remote_lqg(plant, cost, theta=0.1, zeta=0.2, period=h),
            1.1 * (design.remote_lqg(plant, cost, theta=0.0, zeta=0.0, period=h).cost_all_time + 0.2 / h) - 0.1 * noise,
        ),
    }
    assert noise > 0.005 * best
    for statement, (policy, value) in proved.items():
        assert policy.guarantee is not None
        assert policy.guarantee.statement == statement
        assert policy.guarantee.cost == pytest.approx(value, rel=1e-9)
    excess = design.excess(plant, cost, theta=0.5, period=h)
    assert excess.guarantee is not None
    assert excess.guarantee.cost == pytest.approx(best + 0.5 * (best - noise), rel=1e-9)
    relative = design.relative(plant, cost, sigma=0.01, period=h)
    assert relative.guarantee is not None
    assert "s (tr(QΣ) + c)" in relative.guarantee.statement


def both_estimators_agree(system: System, name: str, steps: int = STEPS) -> float:
    """Completed squares without the plant and the average of the stage cost with it are one number; return z."""
    loop = closed(POLICIES[name](system))
    squares = settled(loop, completed_squares(loop), system.seed, steps)
    plain = settled(loop, plain_average(loop), system.seed + 1, 4 * steps)
    assume(squares.reached and plain.reached)  # a loop that keeps its start for longer is told, not compared
    combined = np.hypot(squares.cost.standard_error, plain.cost.standard_error)
    z = (squares.cost.value - plain.cost.value) / combined if combined else 0.0
    assert combined or squares.cost.value == pytest.approx(plain.cost.value, rel=1e-12)
    assert abs(z) <= 4.5  # 300 comparisons: 4 would fail once in 50 runs
    for link in loop.policy.scheduled:
        combined = np.hypot(squares.rates[link].standard_error, plain.rates[link].standard_error)
        rare = 20 / min(squares.steps, plain.steps)  # sends so rare that one run may have seen none
        assert abs(squares.rates[link].value - plain.rates[link].value) <= 4.5 * combined + rare
    return z


def closed_forms_are_what_is_simulated(system: System, name: str, steps: int = 2 * STEPS) -> None:
    """The exact cost of a policy that ignores the state is the average of its stage cost."""
    policy = POLICIES[name](system)
    loop = closed(policy)
    found = settled(loop, plain_average(loop), system.seed, steps)
    assert policy.theory.closed_form is not None
    assert abs(found.cost.value - policy.theory.closed_form.cost) <= 4.5 * found.cost.standard_error


@pytest.mark.parametrize("name", GUARANTEED[::4])
def test_no_policy_exceeds_its_guarantee(name: str) -> None:
    """J_all ≤ J ≤ bound."""
    over(lambda system: no_policy_exceeds_its_guarantee(system, name, FEW_STEPS), 2, system=systems())


@pytest.mark.evidence
@pytest.mark.parametrize("name", GUARANTEED)
def test_no_policy_exceeds_its_guarantee_over_300_systems(name: str) -> None:
    """J_all ≤ J ≤ bound, 300 systems each."""
    drawn = systems(states=4, inputs=2) if name in FIELD else systems()
    over(lambda system: no_policy_exceeds_its_guarantee(system, name), 300, system=drawn)


@pytest.mark.parametrize("name", few(IDENTITY[::6], 3))
def test_reduced_and_plain_estimators_agree(name: str) -> None:
    """One number by two programs."""
    over(lambda system: both_estimators_agree(system, name, FEW_STEPS), 2, system=systems())


@pytest.mark.evidence
@pytest.mark.parametrize("name", IDENTITY)
def test_reduced_and_plain_estimators_agree_whatever_the_policy(name: str) -> None:
    """One number by two programs, five systems each."""
    steps = 500_000  # paths start in phase: short runs of nearly periodic sends would see the ends of the paths
    over(lambda system: both_estimators_agree(system, name, steps), 5, system=systems())


@pytest.mark.evidence
@pytest.mark.parametrize("name", ["lqg joint hold", "lqg separate model"])
def test_reduced_and_plain_estimators_agree_over_300_systems(name: str) -> None:
    """One number by two programs, 300 systems each, in runs of half the length."""
    found: list[float] = []
    over(lambda system: found.append(both_estimators_agree(system, name, STEPS // 2)), 300, system=systems())
    assert agree_together(found)


@pytest.mark.parametrize("name", few(CLOSED_FORM[1::3], 2))
def test_closed_forms_are_what_is_simulated(name: str) -> None:
    """Exact against simulated."""
    over(lambda system: closed_forms_are_what_is_simulated(system, name, 2 * FEW_STEPS), 2, system=systems())


@pytest.mark.evidence
@pytest.mark.parametrize("name", CLOSED_FORM)
def test_closed_forms_are_what_is_simulated_over_a_dozen_systems(name: str) -> None:
    """Exact against simulated, whatever the policy."""
    over(lambda system: closed_forms_are_what_is_simulated(system, name), 12, system=systems())


def trigger_values(policy: Policy, estimate: np.ndarray, candidate: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return silence's value minus that of sending, for columns of signals."""
    (decide,) = (step for step in policy.steps if isinstance(step, Decide))
    silent, send = decide.trigger.options.values()
    known = {"estimate": estimate, "candidate": candidate, "error": error}
    stacked = np.vstack([known[name] for name in silent.signals])
    assert isinstance(silent.Psi, np.ndarray)
    assert isinstance(send.constant, float)
    return np.einsum("ip,ij,jp->p", stacked, silent.Psi, stacked) - send.constant


def separate_fires_whenever_joint_does(system: System, theta: float, share: float) -> None:
    """diag(−Y, Z) ⪰ Γ: 400 points around both thresholds, any admissible ε."""
    joint = design.lqg(system.plant, system.cost, theta=theta)
    L = close_gain(joint)
    M = system.cost.Q + L.T @ system.cost.R @ L + system.cost.N @ L + (system.cost.N @ L).T
    limit = float(np.linalg.eigvalsh(M)[0])
    separate = design.lqg(system.plant, system.cost, theta=theta, trigger="separate", epsilon=share * limit)
    draws = np.random.default_rng(system.seed)
    estimate = draws.standard_normal((system.plant.states, 400)) * draws.lognormal(0, 2, 400)
    candidate = L @ estimate + draws.standard_normal((system.plant.inputs, 400)) * draws.lognormal(-1, 2, 400)
    error = candidate - L @ estimate
    at_joint = trigger_values(joint, estimate, candidate, error)
    at_separate = trigger_values(separate, estimate, candidate, error)
    rounding = 1e-9 * (np.abs(at_joint) + np.abs(at_separate))
    assert (at_joint > 0).any()
    assert (at_separate[at_joint > 0] > -rounding[at_joint > 0]).all()
    assert (at_separate + rounding >= at_joint - rounding).all()


@pytest.mark.parametrize("examples", [8, pytest.param(300, marks=pytest.mark.evidence)])
def test_the_separate_trigger_fires_whenever_the_joint_one_does(examples: int) -> None:
    """Random systems, any θ."""
    drawn = {"system": systems(), "theta": st.floats(0.001, 20), "share": st.floats(0.01, 0.99)}
    over(separate_fires_whenever_joint_does, examples, **drawn)


def silence_adds_what_the_joint_trigger_says(system: System, theta: float, actuation: Actuation) -> None:
    """Stage cost and (1+θ)x̂'Kx̂ of the next step, in silence and after a send, whose own stage counts 1 + θ."""
    plant, cost = system.plant, system.cost
    policy = design.lqg(plant, cost, theta=theta, actuation=actuation)
    K, L = regulate(plant.A, plant.B, cost.Q, cost.R, cost.N).K, close_gain(policy)
    unseen = np.trace(cost.Q @ steady_filter(plant.A, plant.C, plant.W, plant.V).posterior)
    draws = np.random.default_rng(system.seed)
    x, held = draws.standard_normal((plant.states, 50)), draws.standard_normal((plant.inputs, 50))

    def quadratic(M: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.einsum("ip,ij,jp->p", z, M, z)

    weight = np.block([[cost.Q, cost.N], [cost.N.T, cost.R]])
    stages, later = ([], [])
    for u in (held, L @ x):
        stages.append(quadratic(weight, np.vstack([x, u])) + unseen)
        later.append((1 + theta) * quadratic(K, plant.A @ x + plant.B @ u))
    added = stages[0] + later[0] - (1 + theta) * stages[1] - later[1]
    size = np.abs(stages[1]) + np.abs(later[0]) + np.abs(later[1])
    assert (np.abs(trigger_values(policy, x, held, held - L @ x) - added) <= 1e-9 * size).all()


@pytest.mark.parametrize("examples", [6, pytest.param(50, marks=pytest.mark.evidence)])
def test_the_joint_trigger_is_what_silence_adds_to_the_cost_to_go(examples: int) -> None:
    """Random systems, any θ, both actuators."""
    drawn = {"system": systems(), "theta": st.floats(0.001, 20), "actuation": st.sampled_from(["hold", "model"])}
    over(silence_adds_what_the_joint_trigger_says, examples, **drawn)


def close_gain(policy: Policy) -> np.ndarray:
    """Return the gain L of the command."""
    (step,) = (step for step in policy.steps if getattr(step, "signal", "") == "command")
    return step.branches[0]["estimate"]


def vanishes_into_all_time_control(system: System, trigger: str, actuation: str) -> None:
    """θ = 0 sends every sample and costs J_all exactly; θ → 0 approaches both."""
    all_time = design.all_time(system.plant, system.cost)
    assert all_time.theory.closed_form is not None
    exact = all_time.theory.closed_form.cost
    rates = []
    for theta in (0.0, 1e-13, 1e-3):
        policy = design.lqg(system.plant, system.cost, theta=theta, trigger=trigger, actuation=actuation)
        found = average(close(system.plant, policy), seed=system.seed, steps=200_000)
        rates.append(found.rates["actuator"].value)
        assert found.cost.value - exact <= theta * exact + 4 * found.cost.standard_error + 1e-12 * exact
    assert rates[0] >= 1 - 1e-3  # a tie (an error of exactly zero) is silence
    assert rates[1] >= 0.99
    assert rates[0] >= rates[1] >= rates[2] - 0.02


@pytest.mark.parametrize(("trigger", "actuation"), [("joint", "model"), ("separate", "hold")])
def test_a_vanishing_theta_is_all_time_control(trigger: str, actuation: str) -> None:
    """θ = 0 and θ → 0."""
    over(lambda system: vanishes_into_all_time_control(system, trigger, actuation), 2, system=systems())


@pytest.mark.evidence
@pytest.mark.parametrize("actuation", ["hold", "model"])
@pytest.mark.parametrize("trigger", ["joint", "separate"])
def test_a_vanishing_theta_is_all_time_control_over_300_systems(trigger: str, actuation: str) -> None:
    """θ = 0 and θ → 0, 300 systems, a quarter of them for each variant."""
    over(lambda system: vanishes_into_all_time_control(system, trigger, actuation), 75, system=systems())
