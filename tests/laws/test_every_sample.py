"""Averages together with the loop that sends every sample: no bias, honest errors, exact where everything is sent."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from counts import few, scaled
from laws.test_distributed import network_for
from laws.test_estimates import SEEDS, coverage, covers
from measured import agree_together, average
from systems import make_system, well_posed

import taciturn
from taciturn import PID, Controller, Cost, Disturbance, Estimate, Loop, Network, Plant, Policy, close, design
from taciturn.analyse.every_sample import with_every_sample
from taciturn.base.given_controller import lqg_observer
from taciturn.lqg.discrete import discretise
from taciturn.model.network import NodeRole
from taciturn.simulation import sampling
from taciturn.simulation.average import difference_to_every_sample, plain_average

TANK = taciturn.load("pid-tank")
COST, BASE = TANK.cost, {"A": [[1, 0.1], [0, 0.9]], "B": [[0], [0.1]], "W": np.diag([1e-4, 4e-4]), "C": [[1, 0]]}
BASE |= {"V": [[1e-3]], "dt": 0.1}  # the tank
OTHER = Plant([[1, 0.1], [0, 0.87]], [[0], [0.11]], np.diag([1e-4, 4e-4]), C=[[1, 0]], V=[[1e-3]], dt=0.1)
DIFFERENCE = "difference to every sample"


def on_tank(kind: Callable[..., Policy], plant: Plant | None = None, **given: object) -> Loop:
    """Return the loop of the tank with its PID controller under a policy, which is designed for the tank."""
    tank = TANK.plant
    assert isinstance(tank, Plant)
    return close(plant or tank, kind(tank, TANK.cost, controller=TANK.controller, **given))


def random_loop(seed: int) -> Loop | None:
    """Return a loop of LQG as a given controller on nodes that share outputs and inputs, or None without links."""
    rng = np.random.default_rng(seed)
    states, inputs, outputs = (int(rng.integers(1, most + 1)) for most in (5, 3, 3))
    system = make_system(seed, states, inputs, outputs, False)
    network = network_for(system.plant, rng)
    if not network.links or not well_posed(system.plant.A, system.plant.B):
        return None
    kept = lqg_observer("distributed", discretise(system.plant, system.cost, None))
    theta, rule = float(rng.choice([0.05, 0.3, 1.0])), str(rng.choice(["bank", "threshold"]))
    policy = design.distributed(system.plant, system.cost, theta=theta, rule=rule, controller=kept, network=network)
    return close(system.plant, policy)


def agrees(loop: Loop, seed: int, steps: int, exact: float | None = None) -> float:
    """Return the difference from the plain average on draws of its own, over its standard error."""
    both = with_every_sample(loop)
    assert both is not None
    if exact is not None:
        assert loop.problem.per_unit(both.cost) == pytest.approx(exact, rel=1e-9)
    found = average(loop, difference_to_every_sample(loop), seed=seed, steps=steps)
    plain = average(loop, plain_average(loop), seed=seed + 1, steps=steps)
    error = float(np.hypot(found.cost.standard_error, plain.cost.standard_error))
    return (found.cost.value - plain.cost.value) / error


@pytest.mark.parametrize("systems", [5, pytest.param(scaled(300, 60), marks=pytest.mark.evidence)])
def test_the_difference_to_every_sample_has_no_bias_on_random_loops(systems: int) -> None:
    """Unstable plants, several nodes: the cost of every sample is that of the design, and both estimates agree."""
    loops = [(seed, loop) for seed in range(systems) if (loop := random_loop(seed)) is not None]
    assert len(loops) > systems / 2
    assert agree_together([agrees(loop, seed, 200_000, loop.policy.cost_all_time) for seed, loop in loops])


@pytest.mark.parametrize(
    "loop",
    few(
        [
            on_tank(design.event_pid, delta=0.05, longest=3.0),
            on_tank(design.send_on_delta, OTHER, delta=0.1),
            on_tank(design.send_on_delta, Plant(**BASE, input_limit=[[-3, 3]]), delta=0.05),
            on_tank(design.distributed, theta=0.3, network=Network("tcp", sensor_loss=0.2, actuator_loss=0.1)),
            on_tank(design.distributed, theta=0.3, network=Network("udp", actuator_loss=0.1)),
            close(Plant(**BASE), on_tank(design.distributed, theta=0.3).policy, Network(payload="float32")),
            close(OTHER, design.excess(Plant(**BASE), COST, theta=0.2)),
            close(OTHER, design.excess(Plant(**BASE), COST, theta=0.2, actuation="model")),
            close(Plant(**BASE), design.send_on_delta(Plant(**BASE), COST, delta=0.1)),
        ],
        start=0,
        quick=3,
    ),
    ids=lambda loop: f"{loop.policy.kind}",
)
def test_a_loop_need_not_be_linear_or_that_of_its_design(loop: Loop) -> None:
    """Functions, another plant, limits, dropped and rounded packets: only the loop with every sample is linear."""
    assert abs(agrees(loop, 3, scaled(4_000_000, 1_000_000))) < 4.5


@pytest.mark.parametrize("seeds", SEEDS)
def test_95_percent_intervals_of_the_difference_cover_a_long_run(seeds: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over many seeds the value of a run hundreds of times as long lies inside as often as it should."""
    plant, cost = Plant([[0.9]], [[0.1]], [[1.0]], dt=0.1), Cost([[1.0]], [[1.0]])
    loop = close(plant, design.event_pid(plant, cost, controller=PID(1.0), delta=0.3, longest=2.0))
    assert average(loop, steps=20_000).estimator == DIFFERENCE
    monkeypatch.setattr(sampling, "SIMULATED_PATHS", 128)
    truth = average(loop, seed=1000, steps=60_000 * seeds * 6).cost
    found = [average(loop, seed=seed, steps=60_000).cost for seed in range(seeds)]
    widened = [(one.value, float(np.hypot(one.standard_error, truth.standard_error))) for one in found]
    assert covers(coverage(widened, truth.value), seeds)


@pytest.mark.parametrize(
    "loop",
    [
        on_tank(design.distributed, theta=0.0),
        on_tank(design.send_on_delta, OTHER, delta=0.0),
        on_tank(design.event_pid, delta=0.0),
        close(OTHER, design.all_time(Plant(**BASE), COST)),
    ],
    ids=lambda loop: loop.policy.kind,
)
def test_a_loop_that_sends_every_sample_is_exact(loop: Loop) -> None:
    """The difference is 0 in every step, whether or not the plant is that of the design."""
    found, both = average(loop, steps=100_000), with_every_sample(loop)
    assert both is not None
    assert found.estimator == DIFFERENCE
    assert found.cost.value == pytest.approx(loop.problem.per_unit(both.cost), rel=1e-12)
    assert found.cost.standard_error <= 1e-12 * found.cost.value


def test_the_cost_is_that_of_a_simulation_in_plain_numpy() -> None:
    """A PI controller on x⁺ = 0.95 x + 0.1 u + w hears the output when it has changed by more than Δ."""
    gains, delta, h = (1.5, 0.4), 0.6, 1.0
    plant, cost = Plant([[0.95]], [[0.1]], [[0.04]], C=[[1.0]], V=[[0.01]], dt=h), Cost([[1.0]], [[0.1]])
    kept = PID(*gains, disturbance=Disturbance(deviation=0.0))
    loop = close(plant, design.send_on_delta(plant, cost, delta=delta, controller=kept))
    found = average(loop, standard_error=1e-3)
    assert found.estimator == DIFFERENCE
    rng, paths, steps, begin = np.random.default_rng(5), 4000, 1200, 400
    x, last, integral, total, sent = (np.zeros(paths) for _ in range(5))
    for step in range(steps):
        y = x + 0.1 * rng.standard_normal(paths)
        new = np.abs(y - last) > delta
        last = np.where(new, y, last)
        u = -(gains[0] * last + integral)
        integral = integral + gains[1] * h * last
        if step >= begin:
            total, sent = total + x**2 + 0.1 * u**2, sent + new
        x = 0.95 * x + 0.1 * u + 0.2 * rng.standard_normal(paths)
    for own, values in ((found.cost, total), (found.rates["sensor"].scaled(h), sent)):
        means = values / (steps - begin)
        error = np.hypot(own.standard_error, means.std(ddof=1) / np.sqrt(paths))
        assert abs(own.value - means.mean()) < 4.5 * error


def test_the_difference_has_far_less_variance_than_the_plain_average() -> None:
    """On the tank with two nodes it needs a hundredth of the steps; the steps tell both errors."""
    loop = on_tank(design.distributed, theta=0.2)
    found = average(loop, steps=1_000_000)
    plain = average(loop, plain_average(loop), steps=1_000_000)
    assert found.plain_error == pytest.approx(plain.cost.standard_error, rel=1e-6)
    assert found.cost.standard_error < 0.1 * plain.cost.standard_error
    assert found.rates == plain.rates


def test_the_plain_average_is_used_where_it_needs_less_work() -> None:
    """With few packets the loop has little in common with the one that sends every sample."""
    loop = on_tank(design.event_pid, delta=0.2)
    found, plain = average(loop, steps=1_000_000), average(loop, plain_average(loop), steps=1_000_000)
    assert found.estimator == "plain average"
    assert (found.cost, found.rates) == (plain.cost, plain.rates)


ROLES = {
    "s1": NodeRole(measures=(0,)),
    "s2": NodeRole(measures=(1,)),
    "plc": NodeRole(controls=True),
    "v1": NodeRole(applies=(0,)),
}


@pytest.mark.parametrize("growth", [0.95, 1.05])
def test_a_link_whose_command_is_always_zero_has_the_rate_zero(growth: float) -> None:
    """The loop costs as much as the one without this link, also if the plant is unstable in open loop."""
    plant = Plant([[growth, 0.1], [0, 0.9]], np.eye(2), np.diag([0.2, 0.1]), np.eye(2), 0.05 * np.eye(2), dt=1.0)
    cost = Cost(np.eye(2), np.eye(2))
    kept = Controller(
        [[0.0]], np.zeros((1, 2)), np.zeros((2, 1)), np.diag([-0.4, 0.0]), disturbance=Disturbance(deviation=0.0)
    )
    roles = {**ROLES, "v2": NodeRole(applies=(1,))}, {**ROLES, "v2": NodeRole(applies=(1,), site="plc")}
    found, without = (
        average(
            close(
                plant,
                design.send_on_delta(plant, cost, delta=0.6, controller=kept, network=Network(nodes=nodes)),
            ),
            steps=400_000,
        )
        for nodes in roles
    )
    assert found.settled
    assert found.rates["v2"] == Estimate(0.0, 0.0, "exact")
    assert found.notes == ("after the start, nothing is ever sent on the v2 link, whatever the noise is",)
    assert min(found.rates[link].value for link in ("s1", "s2", "v1")) > 0.01
    assert found.cost.value == pytest.approx(without.cost.value, rel=1e-9)
    assert {**found.rates, "v2": None} == {**without.rates, "v2": None}


@pytest.mark.parametrize(
    "kind", [partial(design.send_on_delta, delta=0.5, link="actuator"), partial(design.distributed, theta=0.5)]
)
def test_silence_costs_what_it_costs_in_open_loop_if_nothing_can_be_sent(kind: Callable[..., Policy]) -> None:
    """A controller whose command is 0 leaves the plant alone: J = q W / (1 − a²)."""
    plant, cost = Plant([[0.9]], [[1.0]], [[1.0]], dt=1.0), Cost([[1.0]], [[1.0]])
    kept = Controller([[0.0]], [[0.0]], [[0.0]], disturbance=Disturbance(deviation=0.0))
    found = average(close(plant, kind(plant, cost, controller=kept)), steps=100_000)
    assert found.settled
    assert found.rates == {link: Estimate(0.0, 0.0, "exact") for link in found.rates}
    assert found.cost.value == pytest.approx(1 / (1 - 0.9**2), rel=1e-9)


def test_a_loop_in_which_a_link_has_not_sent_yet_has_not_settled() -> None:
    """After a packet, which is rare, a PI controller sends for long; a run of 1e9 steps has a packet in 200 steps."""
    plant, cost = Plant([[0.97]], [[0.05]], [[1e-4]], C=[[1.0]], V=[[1e-4]], dt=1.0), Cost([[1.0]], [[0.1]])
    loop = close(plant, design.distributed(plant, cost, theta=300.0, controller=PID(2.0, 0.05)))
    found = average(loop, steps=200_000)
    assert found.rates["sensor"].value == 0
    assert not found.settled
    assert not found.reached
    assert found.notes[0].startswith("nothing was sent on the sensor link and the actuator link")
