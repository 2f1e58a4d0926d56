"""Event-triggered control with a controller that the user has: its value, what silence costs, and the bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import control
import numpy as np
import pytest
from catalogue import outputs
from drawn import law
from hypothesis import strategies as st
from runtime.loops import differing_ticks, record

import taciturn
from taciturn import PID, Controller, Cost, Disturbance, Loop, Network, Plant, Policy, UnstableError, design
from taciturn.base.given_controller import REMEDY, lqg_observer
from taciturn.base.route import actuator_base, sensor_base
from taciturn.base.value import advantage
from taciturn.design.at_fixed_steps import send_at_fixed_steps, sending_always
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.riccati import regulate
from taciturn.program.engine import prepare
from taciturn.program.numpy import run
from taciturn.program.ops import Option, Sent
from taciturn.simulation.average import average

STEP = 0.1
TANK = Plant([[1, STEP], [0, 0.9]], [[0], [STEP]], np.diag([1e-4, 4e-4]), [[1, 0]], [[1e-3]], dt=STEP)
WEIGHTS = Cost(np.diag([1.0, 0.0]), [[0.05]])
NO_DISTURBANCE = Disturbance(deviation=0.0)
KEPT = PID(1.2, 0.15, 1.0, 0.5, NO_DISTURBANCE)
SLOW = -STEP / np.log(0.999)  # time constant in seconds
ALL_TIME, DISTURBED = 0.00272706026, {0.1: 0.00378021114, 0.3: 0.0122054181}
# actuation or the sensor link with hold, theta: packets per step, relative cost; from a simulation, ± 0.002
TABLE = {
    ("hold", 0.0): (0.738, 0.961), ("hold", 0.1): (0.547, 0.964), ("hold", 0.5): (0.308, 0.992),
    ("hold", 1.0): (0.211, 1.043), ("model", 0.0): (0.692, 0.941), ("model", 0.1): (0.497, 0.940),
    ("model", 0.5): (0.276, 0.963), ("model", 1.0): (0.181, 1.014),
    ("sensor", 0.0): (0.619, 0.942), ("sensor", 0.1): (0.389, 0.948), ("sensor", 0.5): (0.186, 1.005),
    ("sensor", 1.0): (0.123, 1.091),
}  # fmt: skip


def observer(plant: Plant, cost: Cost, told: bool) -> Controller:
    """Return LQG control as a given controller; ``told``: its observer uses the applied input, not the command."""
    steady = steady_filter(plant.A, plant.C, plant.W, plant.V)
    return observing(plant, regulate(plant.A, plant.B, cost.Q, cost.R, cost.N).L, steady.gain, told)


def by_python_control(plant: Plant, cost: Cost, told: bool) -> Controller:
    """Return the same controller with the gains of ``dlqr`` and the covariance of ``dlqe``."""
    L = -control.dlqr(plant.A, plant.B, cost.Q, cost.R, cost.N)[0]
    P = control.dlqe(plant.A, np.eye(plant.states), plant.C, plant.W, plant.V)[1]
    gain = P @ plant.C.T @ np.linalg.inv(plant.C @ P @ plant.C.T + plant.V)
    return observing(plant, L, gain, told)


def observing(plant: Plant, L: np.ndarray, gain: np.ndarray, told: bool) -> Controller:
    """Return feedback L of the filtered estimate."""
    left = np.eye(plant.states) - gain @ plant.C
    C, D = L @ left, L @ gain
    A, B = plant.A @ left, plant.A @ gain
    if told:
        return Controller(A, B, C, D, plant.B)
    return Controller(A + plant.B @ C, B + plant.B @ D, C, D)


def random_loop(seed: int) -> tuple[Plant, Cost, Controller]:
    """Return a random plant, often unstable, with cross terms, and a detuned observer and gain that stabilise it."""
    draws = np.random.default_rng(seed)
    while True:
        n, m, p = (int(number) for number in draws.integers(1, 4, 3))
        A = draws.normal(size=(n, n)) * 0.8 / np.sqrt(n) + 0.5 * np.eye(n)
        W, V = draws.normal(size=(n, n)), draws.normal(size=(p, p))
        plant = Plant(A, draws.normal(size=(n, m)), W @ W.T, draws.normal(size=(p, n)), V @ V.T + 0.1 * np.eye(p))
        root = draws.normal(size=(n + m, n + m))
        whole = root @ root.T
        cost = Cost(whole[:n, :n], whole[n:, n:], whole[:n, n:])
        other = Cost(np.eye(n) * draws.uniform(0.1, 10), np.eye(m))
        try:
            kept = observer(plant, other, bool(draws.integers(2)))
            advantage(actuator_base(discretise(plant, cost, None), kept), REMEDY)
        except UnstableError:
            continue
        return plant, cost, kept


@pytest.mark.parametrize(
    ("actuation", "theta"),
    [pytest.param(*key, marks=() if key[1] in (0.1,) else pytest.mark.evidence) for key in TABLE],
)
def test_a_pid_sends_and_costs_what_the_reference_says(actuation: str, theta: float) -> None:
    """A hand-tuned PID of an integrating tank; with θ = 0 it sends less and costs less than with every sample."""
    link, silence = ("sensor", "hold") if actuation == "sensor" else ("actuator", actuation)
    policy = design.excess(TANK, WEIGHTS, theta=theta, actuation=silence, controller=KEPT, link=link)
    assert policy.cost_all_time == pytest.approx(ALL_TIME, rel=1e-8)
    found = taciturn.evaluate(policy, standard_error=2e-6)
    packets, cost = TABLE[actuation, theta]
    assert found.rates[link].value == pytest.approx(packets, abs=0.002)
    assert found.cost.value / ALL_TIME == pytest.approx(cost, abs=0.002 + 4 * found.cost.standard_error / ALL_TIME)
    bound = policy.guarantee.at_rate(found.rates[link].value)
    assert found.cost.value < bound


@pytest.mark.parametrize(
    ("deviation", "theta", "packets", "cost"),
    [
        pytest.param(*row, marks=() if row[:2] == (0.3, 0.5) else pytest.mark.evidence)
        for row in (
            (0.1, 0.1, 0.507, 0.940), (0.1, 0.5, 0.278, 0.973), (0.1, 1.0, 0.187, 1.026),
            (0.3, 0.1, 0.304, 0.786), (0.3, 0.5, 0.150, 0.837), (0.3, 1.0, 0.103, 0.915),
        )
    ],
)  # fmt: skip
def test_a_slow_disturbance_is_part_of_plant_and_filter(
    deviation: float, theta: float, packets: float, cost: float
) -> None:
    """The reference simulates the same disturbance; after a step of it, the integrator restores the cost."""
    kept = replace(KEPT, disturbance=Disturbance(SLOW, deviation))
    policy, base = design.excess(TANK, WEIGHTS, theta=theta, controller=kept), DISTURBED[deviation]
    assert policy.cost_all_time == pytest.approx(base, rel=1e-8)
    found = taciturn.evaluate(policy, standard_error=4e-4 * base)
    assert found.rates["actuator"].value == pytest.approx(packets, abs=0.002)
    assert found.cost.value / base == pytest.approx(cost, abs=0.0036)
    after = found.after_step
    assert after.size == (deviation,)
    bare = design.excess(TANK, WEIGHTS, theta=theta, controller=KEPT).cost_all_time
    constant = bare + float(WEIGHTS.R.item()) * deviation**2  # the input compensates the disturbance, at a cost
    assert after.cost_all_time.value == pytest.approx(constant, abs=5 * after.cost_all_time.standard_error)
    assert after.cost.value < after.cost_all_time.value + policy.guarantee.per_silence
    assert 0 < after.rates["actuator"].value < 1


def test_the_averages_after_a_step_obey_the_steps_that_are_given() -> None:
    """For an event-based PID controller; the given controller with every sample has an exact cost."""
    kept = replace(KEPT, disturbance=Disturbance(SLOW, 0.3))
    problem = taciturn.Problem(TANK, WEIGHTS, Network(), "event-pid", {"delta": 0.05}, controller=kept)
    after = taciturn.evaluate(problem, steps=6_000_000).after_step
    constant = ALL_TIME + float(WEIGHTS.R.item()) * 0.3**2
    always = after.cost_all_time
    assert always.value == pytest.approx(constant, abs=4.5 * always.standard_error)
    assert always.standard_error == pytest.approx(7e-6, rel=0.3)


@law(
    3,
    60,
    kp=st.floats(0.1, 1.5),
    ki=st.floats(0.0, 0.2),
    kd=st.floats(0.1, 1.0),
    filter=st.floats(1.0, 8.0),
    r=st.sampled_from([0.0, 2.0]),
)
def test_event_based_pids_with_every_packet_are_the_given_controller(
    kp: float, ki: float, kd: float, filter: float, r: float
) -> None:
    """With Δ = 0, a packet comes at every step: the inputs, and so the costs, are those of the row "every sample"."""
    pid = PID(kp, ki, kd, filter * STEP, NO_DISTURBANCE, setpoint=r if ki else 0.0)
    try:
        given = send_at_fixed_steps("pid", TANK, WEIGHTS, None, pid, link="sensor")
    except UnstableError:
        return
    path = taciturn.simulate(taciturn.close(TANK, given), 100, seed=1)
    for kind in (design.event_pid, design.event_pid_saturated):
        policy = kind(TANK, WEIGHTS, delta=0.0, controller=pid)
        assert policy.cost_all_time == pytest.approx(given.cost_all_time, rel=1e-10)
        same = taciturn.simulate(taciturn.close(TANK, policy), 100, seed=1)
        assert same.sends["sensor"].all()
        assert same.input == pytest.approx(path.input, abs=1e-9 * np.abs(path.input).max())


def test_an_integrator_brings_the_usual_disturbance() -> None:
    """Half the noise of a step at the input, and 1,000 steps; the policy states both, and plants are completed."""
    policy = design.excess(TANK, WEIGHTS, theta=0.1, controller=PID(1.2, 0.15, 1.0, 0.5))
    assert policy.disturbance.time_constant == pytest.approx(100.0)
    assert policy.disturbance.deviation == pytest.approx([0.1])
    assert "time constant 100 s, deviation 0.1 (time_constant and deviation by default" in policy.notes[-1]
    assert taciturn.close(TANK, policy).nominal
    assert design.excess(TANK, WEIGHTS, theta=0.1, controller=PID(1.2, 0, 1.0, 0.5)).disturbance is None
    assert "has no slow disturbance" in design.excess(TANK, WEIGHTS, theta=0.1, controller=KEPT).notes[-1]


def test_a_disturbed_nonlinear_plant_is_its_function_with_a_shifted_input() -> None:
    """Sampled or discrete, the input at the plant is u + d."""
    function = taciturn.integrate(lambda x, u: [x[1], -np.sin(x[0]) - x[1] + u[0]], STEP)
    A, B = taciturn.linearise(function, 2, 1)
    plant = Plant(A, B, TANK.W, TANK.C, TANK.V, STEP, function=function)
    found = Disturbance(50.0, 0.2).added_to(plant)
    moved = found.function([0.3, -0.2, 0.7], [0.1], [0.0, 0.0, 0.01])
    assert moved[:2] == pytest.approx(np.asarray(function(np.array([0.3, -0.2]), np.array([0.8]), np.zeros(2))))
    assert moved[2] == pytest.approx(0.7 * np.exp(-STEP / 50.0) + 0.01)
    assert found.W[2, 2] == pytest.approx(0.2**2 * (1 - np.exp(-2 * STEP / 50.0)))


def test_during_an_alarm_every_sample_is_sent() -> None:
    """Noise of three times the deviation is an alarm; that of the model is none."""
    policy = design.excess(TANK, WEIGHTS, theta=1.0, controller=PID(1.2, 0.15, 1.0, 0.5))
    shaken = Plant(TANK.A, TANK.B, 9 * TANK.W, TANK.C, 9 * TANK.V, STEP)
    usual, loud = (
        run(program, loop.start(program, 4, 0), 400).outputs
        for loop in (taciturn.close(plant, policy) for plant in (TANK, shaken))
        for program in (loop.program(),)
    )
    watched = [path[Option("watch", "expected")] > path[Option("watch", "surprised")] for path in (usual, loud)]
    assert not watched[0].any()
    assert watched[1][100:].all()
    assert loud[Sent("actuator")][100:].all()
    assert not usual[Sent("actuator")].all()


@pytest.mark.parametrize("seeds", [range(12), pytest.param(range(300), marks=pytest.mark.evidence)])
def test_the_value_of_a_base_is_its_stationary_cost(seeds: range) -> None:
    """P iterates the cost backwards, the other side the covariance forwards; both to 1e-9."""
    for seed in seeds:
        plant, cost, kept = random_loop(seed)
        for choose in (actuator_base, sensor_base):
            base = choose(discretise(plant, cost, None), kept)
            F, closed = base.Phi + base.Gamma @ base.K, np.vstack([np.eye(len(base.Phi)), base.K])
            M = closed.T @ base.stage @ closed
            X = np.linalg.solve(np.eye(len(F) ** 2) - np.kron(F, F), base.noise.ravel()).reshape(F.shape)
            assert advantage(base, REMEDY).cost == pytest.approx(np.trace(M @ X), rel=1e-9)


def assert_finite_time(
    policy: Policy, plant: Plant, kept: Controller, loop: Loop, states: np.ndarray, link: str
) -> None:
    """Check J_T ≤ J_all + δ(1 − rate) + E z'P z/T far from rest, z = (x, state of the controller, y)."""
    program, steps, states = loop.program(), 12, states.copy()
    far = 5 * np.std(states[[one.name == "x" for one in program.states]], axis=1, keepdims=True)
    for name in ("x", "prior"):  # the error of the estimate stays
        states[[one.name == name for one in program.states]] += far
    base = actuator_base(discretise(plant, loop.problem.cost, None), kept)
    P = advantage(base, REMEDY).P[: len(base.Phi), : len(base.Phi)]
    named = {name: states[[one.name == name for one in program.states]] for name in ("x", "next register")}
    z = np.vstack([named["x"], named["next register"], plant.C @ named["x"]])
    first = np.einsum("ip,ij,jp->p", z, P, z) + np.sum(P[-plant.outputs :, -plant.outputs :] * plant.V)
    sums = prepare(program)(states, steps, None).sums
    room = first / steps + policy.guarantee.per_silence * (1 - sums[Sent(link)] / steps) - sums["cost"] / steps
    assert room.mean() + policy.cost_all_time > -4.5 * room.std(ddof=1) / np.sqrt(room.size)


@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(300), marks=pytest.mark.evidence)])
def test_the_identity_holds_and_the_bound_is_never_broken(seeds: range) -> None:
    """The plain average and the completed squares of the same loop agree, and both are below the bound at the rate."""
    off = []
    for seed in seeds:
        plant, cost, kept = random_loop(seed)
        way = {"actuation": ("hold", "model")[seed % 2], "link": ("actuator", "sensor")[seed // 2 % 2]}
        policy = design.excess(plant, cost, theta=(0.0, 0.2, 1.0)[seed % 3], controller=kept, **way)
        loop = taciturn.close(plant, policy)
        program, paths = loop.program(), 200
        prepared = prepare(program)
        states = prepared(loop.start(program, paths, seed), 2000, None).states
        assert_finite_time(policy, plant, kept, loop, states, way["link"])
        sums = prepared(states, 1000, None).sums
        plain, squares = sums["cost"] / 1000, policy.cost_all_time + sums["excess"] / 1000
        error = (plain - squares).std(ddof=1) / np.sqrt(paths)
        off.append(float((plain - squares).mean() / error))
        rate = float(sums[Sent(way["link"])].mean()) / 1000
        assert plain.mean() < policy.guarantee.at_rate(rate) + 4 * plain.std(ddof=1) / np.sqrt(paths)
    assert np.abs(off).max() < 4.5
    assert np.mean(np.square(off)) < 1 + 5 / np.sqrt(len(off))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.evidence) for seed in range(1, 12))])
def test_lqg_as_a_given_controller_is_the_excess_trigger(seed: int) -> None:
    """An observer that uses the applied input decides as the kind itself, with the same values of the trigger."""
    plant, cost, _ = random_loop(seed)
    own = design.excess(plant, cost, theta=0.2)
    for told in (True, False):
        kept = design.excess(plant, cost, theta=0.2, controller=by_python_control(plant, cost, told))
        assert kept.cost_all_time == pytest.approx(own.cost_all_time, rel=1e-9)
        assert kept.guarantee.cost == pytest.approx(own.guarantee.cost, rel=1e-9)
    kept = design.excess(plant, cost, theta=0.2, controller=by_python_control(plant, cost, True))
    paths = [outputs(policy, seed) for policy in (own, kept)]
    silent = [path[Option("send", "silent")] for path in paths]
    assert np.abs(silent[0] - silent[1]).max() < 1e-12 * np.abs(silent[0]).max()
    assert np.array_equal(*(path[Sent("actuator")] for path in paths))
    from_sensor = design.excess(plant, cost, theta=0.2, link="sensor", actuation="model")
    assert from_sensor.cost_all_time == pytest.approx(own.cost_all_time, rel=1e-9)
    found = lqg_observer("excess", discretise(plant, cost, None))
    assert np.allclose(found.A, observer(plant, cost, True).A, rtol=1e-9)


def test_an_integrator_that_the_cost_does_not_see_is_no_obstacle() -> None:
    """A mode at 1 whose value is zero."""
    A = [[1.0, 0.0], [0.0, 0.8]]
    kept = Controller(A, [[0.1], [0.2]], [[0.0, 2.0]], [[-3.2]], dt=STEP, disturbance=NO_DISTURBANCE)
    without = PID(1.2, 0, 1.0, 0.5)
    policies = [design.excess(TANK, WEIGHTS, theta=0.1, controller=one) for one in (kept, without)]
    assert policies[0].cost_all_time == pytest.approx(policies[1].cost_all_time, rel=1e-10)


def test_a_static_gain_on_the_measured_state_needs_no_register() -> None:
    """Nor a filter."""
    plant = Plant([[1.2]], [[1.0]], [[0.01]], dt=1.0)
    policy = design.excess(plant, Cost([[1.0]], [[1.0]]), delta=0.0, controller=PID(0.9))
    found = taciturn.evaluate(policy, standard_error=1e-4)
    assert found.cost.value < policy.cost_all_time + 4e-4
    assert found.rates["actuator"].value < 1


def test_claims_fail_closed() -> None:
    """Clipped inputs, losses and another plant leave a simulation without a bound."""
    policy = design.excess(TANK, WEIGHTS, theta=0.1, controller=KEPT)
    assert taciturn.close(TANK, policy, cost=WEIGHTS).nominal
    clipped = Plant(TANK.A, TANK.B, TANK.W, TANK.C, TANK.V, STEP, input_limit=[0.1])
    for plant, network in ((clipped, None), (TANK, Network("udp", actuator_loss=0.1))):
        loop = taciturn.close(plant, policy, network, WEIGHTS)
        assert not loop.nominal
        assert average(loop, steps=200_000).cost.value > 0


def test_nodes_apart_carry_the_bits_of_the_loop() -> None:
    """On paths with packets and silence, for both kinds of actuators."""
    ways = (("actuator", "hold"), ("actuator", "model"), ("sensor", "hold"), ("sensor", "model"))
    for number, (link, actuation) in enumerate(ways):
        kept = replace(KEPT, disturbance=Disturbance(50.0, 0.1)) if number % 3 else KEPT
        policy = design.excess(TANK, WEIGHTS, theta=0.1, controller=kept, actuation=actuation, link=link)
        loop = taciturn.close(TANK, policy)
        records, draws = record(loop, 200, 1)
        wrong, packets = differing_ticks(loop, records, draws)
        assert wrong == []
        assert 20 < packets < 180


@pytest.mark.parametrize("link", ["sensor", "actuator"])
@pytest.mark.parametrize("kind", [design.excess, design.send_on_delta])
def test_an_unstable_loop_with_the_wrong_sign_is_told_so(kind: Callable[..., Policy], link: str) -> None:
    """Only if the loop is stable with the other sign."""
    plant, cost = Plant([[1.1]], [[1.0]], [[0.1]], dt=0.1), Cost([[1.0]], [[1.0]])
    kind(plant, cost, delta=0.1, controller=PID(0.5), link=link)
    with pytest.raises(UnstableError, match=r"is not stable: .*with the other sign .* the loop is stable, so change"):
        kind(plant, cost, delta=0.1, controller=PID(-0.5), link=link)
    with pytest.raises(UnstableError, match=r"is not stable: .*inside the unit circle: check the sign of the contr"):
        kind(plant, cost, delta=0.1, controller=PID(5.0), link=link)


@pytest.mark.parametrize(("horizon", "discount"), [(20, 1.0), (None, 0.95)])
def test_a_slow_disturbance_has_its_deviation_from_the_start_of_a_run_on(horizon: int | None, discount: float) -> None:
    """Mean squares of x and d from step to step: what sending every sample costs from there."""
    plant = Plant([[0.9]], [[1.0]], [[1e-6]], [[1.0]], [[1e-6]], 1.0)
    cost = Cost([[1.0]], [[0.1]], horizon=horizon, discount=discount)
    nothing = (np.zeros(size) for size in ((0, 0), (0, 1), (1, 0)))
    controller = Controller(*nothing, [[-0.5]], None, 1.0, Disturbance(1000.0, 1.0))
    policy = design.excess(plant, cost, delta=0.0, controller=controller)
    kept = np.exp(-1 / 1000.0)
    x, d, both, total = 0.0, 1.0, 0.0, 0.0  # E x², E d², E xd
    for step in range(horizon or 2000):
        total += discount**step * (x + 0.1 * 0.25 * (x + 1e-6))
        x, d, both = 0.16 * x + 2 * 0.4 * both + d + 0.25e-6 + 1e-6, 1.0, kept * (0.4 * both + d)
    total += x if horizon else 0.0  # the weight of the final state, by default that of all others
    assert policy.cost_all_time == pytest.approx(total, rel=1e-6)


def test_an_integral_that_only_counts_does_not_delay_the_recovery_of_a_node() -> None:
    """Nothing sees it and it never decays; with it, the recovery was infinite, and nodes and show ended in a crash."""
    whole = Plant([[0.5, 0], [1, 1]], [[0.5], [0]], np.diag([0.2, 0.0]), [[1, 0]], [[0.1]], dt=1.0)
    alone = Plant([[0.5]], [[0.5]], [[0.2]], [[1]], [[0.1]], dt=1.0)
    kept = PID(0.25, 0.03)
    counts, plain = (
        design.send_on_delta(plant, Cost(weight, [[0.5]]), delta=0.3, controller=kept)
        for plant, weight in ((whole, np.diag([1.0, 0.0])), (alone, [[1.0]]))
    )
    assert counts.theory.recovers == pytest.approx(plain.theory.recovers, rel=1e-6)
    assert np.isfinite(taciturn.Nodes(counts).step([0.5])).all()


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_silence_that_saves_a_mission_from_an_unstable_controller_costs_what_a_recursion_says(noise: float) -> None:
    """The identity would be the difference of two numbers of 1e46, the base and what silence saves."""
    horizon, weights = 200, Cost([[1.0]], [[1.0]], horizon=200)
    plant = Plant([[0.9]], [[1.0]], [[noise]], dt=1.0, mean=[1.0])
    policy = design.excess(plant, weights, theta=0.1, controller=PID(2.2, disturbance=NO_DISTURBANCE))
    found = taciturn.evaluate(policy, steps=500_000)
    squares = [1.0]
    for _ in range(horizon):
        squares.append(0.81 * squares[-1] + noise)
    assert policy.cost_all_time > 1e40
    assert found.rates["actuator"].value == 0
    error = found.cost.standard_error
    assert error < 0.2
    assert abs(found.cost.value - sum(squares)) < 4 * error + 1e-9
    assert any("grow by a factor of 1.3 per step: its cost, to which the bound refers" in note for note in found.notes)


def test_a_mission_whose_base_costs_more_than_a_number_holds_is_refused_with_its_reason() -> None:
    """And with the remedy of an unstable loop."""
    plant, cost = Plant([[0.9]], [[1.0]], [[0.01]], dt=1.0), Cost([[1.0]], [[1.0]], horizon=2000)
    with pytest.raises(UnstableError, match=r"sends every sample, is not stable: .* times the weights; expected a sta"):
        design.excess(plant, cost, theta=0.1, controller=PID(2.2, disturbance=NO_DISTURBANCE))


@pytest.mark.parametrize("link", ["sensor", "actuator"])
def test_dead_bands_are_evaluated_on_a_plant_that_no_filter_could_estimate(link: str) -> None:
    """The sum of a measured state is not observed and costs nothing; the loops with every sample need no filter."""
    plant = Plant([[0.9, 0.0], [0.1, 1.0]], [[0.1], [0.0]], np.diag([1e-4, 0.0]), [[1.0, 0.0]], dt=STEP)
    alone = Plant([[0.9]], [[0.1]], [[1e-4]], [[1.0]], dt=STEP)
    parameters, kept = {"delta": 0.02, "link": link}, PID(1.2, 0.15)
    found, without = (
        taciturn.evaluate(
            taciturn.Problem(one, cost, Network(), "send-on-delta", parameters, controller=kept), steps=20_000
        )
        for one, cost in ((plant, WEIGHTS), (alone, Cost([[1.0]], [[0.05]])))
    )
    assert found.after_step is not None
    assert found.as_written is not None
    assert without.as_written is not None
    assert found.as_written.cost_all_time == pytest.approx(without.as_written.cost_all_time, rel=1e-9)
    assert found.cost_all_time == pytest.approx(without.cost_all_time, rel=1e-9)


@pytest.mark.parametrize("horizon", [None, 30])
@pytest.mark.parametrize("link", ["sensor", "actuator"])
def test_the_loop_with_every_sample_is_that_of_excess_at_no_cost_of_silence(link: str, horizon: int | None) -> None:
    """One has no filter and nothing to decide; the other has both, and triggers that always send."""
    cost = Cost(np.diag([1.0, 0.0]), [[0.05]], horizon=horizon)
    deciding = design.excess(TANK, cost, delta=0.0, controller=KEPT, link=link)
    always = send_at_fixed_steps("every sample", TANK, cost, None, KEPT, link)
    assert always.cost_all_time == pytest.approx(deciding.cost_all_time, rel=1e-12)
    path, other = (
        taciturn.simulate(taciturn.close(TANK, one, cost=cost), 30) for one in (always, sending_always(deciding))
    )
    assert np.abs(path.input - other.input).max() < 1e-12
    assert np.abs(path.state - other.state).max() < 1e-12


def test_two_integrals_of_one_output_are_not_blamed_on_the_sign() -> None:
    """Their difference never decays, with either sign, though rounding can make its computed mode smaller than 1."""
    kept = (PID(0.1, 0.02, input=1, output=1, disturbance=Disturbance(deviation=0.0)), PID(0.1, 0.02, input=2))
    for seed in range(6):
        draws = np.random.default_rng(seed)
        A = draws.standard_normal((2, 2))
        A *= 0.7 / np.abs(np.linalg.eigvals(A)).max()
        C, B = draws.standard_normal((1, 2)), draws.standard_normal((2, 2))
        plant = Plant(A, B, np.eye(2), C, [[0.2]], dt=1.0)
        with pytest.raises(UnstableError, match="no two integrals have the same output"):
            design.distributed(plant, Cost(np.eye(2), np.eye(2)), theta=0.5, controller=kept)
