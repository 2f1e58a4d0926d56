"""The loop that sends every sample with the same limits and losses: its cost, the excess over it, and better ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import taciturn
from taciturn import PID, Cost, Disturbance, Network, Plant, Problem, close, design
from taciturn._arrays import Array
from taciturn.design.at_fixed_steps import sending_always
from taciturn.model.estimate import Estimate
from taciturn.problem import parse
from taciturn.simulation.average import average
from taciturn.study.baseline import HALF_DERIVATIVE, LQG, excess_over

TANK = taciturn.load("pid-tank")
COST = Cost([[1.0]], [[0.5]])
LIMITED = Plant([[0.95]], [[1.0]], [[1.0]], [[1.0]], [[0.2]], input_limit=[1.0], dt=1.0)
PATHS, STEPS, SETTLE = 4000, 300, 100
STEPS_OF_A_TEST = 400_000


def changed(**keys: Any) -> Problem:
    """Return the tank with other keys, in whose names two underscores stand for a dot."""
    return TANK.changed({name.replace("__", "."): value for name, value in keys.items()})


def pair(costs: Array, every: Array) -> Estimate:
    """Return by how much the costs of paths exceed those of others with the same noise."""
    ratio = costs.mean() / every.mean()
    error = (costs - ratio * every).std(ddof=1) / np.sqrt(len(costs)) / every.mean()
    return Estimate(float(ratio - 1), float(error), "simulation")


def agree(one: Estimate | None, other: Estimate) -> bool:
    """Return whether two estimates are within four standard errors of each other."""
    assert one is not None
    return abs(one.value - other.value) <= 4 * float(np.hypot(one.standard_error, other.standard_error))


def test_a_proportional_controller_with_a_limited_input_in_numpy() -> None:
    """The sensor sends where its measurement has moved by more than a threshold; the twin sends each one."""
    draws, gain, delta = np.random.default_rng(1), 0.6, 1.0
    x, heard, totals = np.zeros((2, PATHS)), np.zeros((2, PATHS)), np.zeros((2, PATHS))
    for k in range(SETTLE + STEPS):
        y = x + np.sqrt(0.2) * draws.standard_normal(PATHS)
        sends = np.abs(y - heard) > delta
        sends[1] = True
        heard = np.where(sends, y, heard)
        u = np.clip(-gain * heard, -1.0, 1.0)
        totals += (k >= SETTLE) * (x**2 + 0.5 * u**2)
        x = 0.95 * x + u + draws.standard_normal(PATHS)
    own = pair(*totals)
    problem = Problem(LIMITED, COST, Network(), "send-on-delta", {"delta": delta}, controller=PID(gain))
    found = taciturn.evaluate(problem, steps=STEPS_OF_A_TEST)
    assert found.measured
    assert found.cost_all_time is None
    assert agree(found.excess, own)
    assert agree(found.cost_every_sample, Estimate(float(totals[1].mean() / STEPS), 0.01, "simulation"))


def test_lqg_with_losses_that_no_acknowledgement_tells_in_numpy() -> None:
    """The controller counts on what it has sent; the twin attempts at every step. Rounding removes the exact number."""
    plant = Plant([[0.95]], [[1.0]], [[1.0]])
    told: dict[str, Any] = {"payload": "int16", "actuator_range": 100.0}
    problem = Problem(plant, COST, Network("udp", actuator_loss=0.2, **told), "excess", {"theta": 0.3})
    trigger = problem.design().decisions["send"]
    (silent, send), draws = trigger.options.values(), np.random.default_rng(2)
    assert silent.Psi is not None
    assert isinstance(silent.Psi, np.ndarray)
    assert isinstance(send.constant, float)
    H, price = float(silent.Psi[0, 0]), send.constant
    P = 1.0
    for _ in range(200):
        P = 1.0 + 0.95**2 * P - (0.95 * P) ** 2 / (0.5 + P)
    L = 0.95 * P / (0.5 + P)
    x, held, u, totals = (np.zeros((2, PATHS)) for _ in range(4))
    for k in range(SETTLE + STEPS):
        command = -L * x
        sends = H * (held - command) ** 2 > price
        sends[1] = True
        held = np.where(sends, command, held)
        u = np.where(sends & (draws.random(PATHS) >= 0.2), command, u)
        totals += (k >= SETTLE) * (x**2 + 0.5 * u**2)
        x = 0.95 * x + u + draws.standard_normal(PATHS)
    found = taciturn.evaluate(problem, steps=STEPS_OF_A_TEST)
    assert found.measured
    assert agree(found.excess, pair(*totals))


@pytest.mark.parametrize(
    "problem",
    [
        changed(plant__input_limit=[0.5], network__payload="float32"),
        changed(plant__input_rate=[0.4], network__protocol="udp", network__actuator_loss=0.2),
        changed(kind="event-pid", theta=None, delta=0.05, plant__input_limit=[0.6]),
        replace(taciturn.load("two-mass-lqg"), actual=taciturn.load("two-mass-lqg").plant).changed(
            {"plant.input_limit": [3.0]}
        ),
    ],
    ids=["clipped and rounded", "rate and losses", "event-pid", "LQG"],
)
def test_the_pair_agrees_with_two_independent_runs_and_is_more_precise(problem: Problem) -> None:
    """With another seed for the loop that sends every sample."""
    found, loop = taciturn.evaluate(problem, steps=STEPS_OF_A_TEST, after_step=False), problem.close(problem.design())
    always = replace(
        loop, policy=sending_always(loop.policy), network=loop.network.unlimited, violated_assumptions=("",)
    )
    alone = [average(one, seed=7 + k, steps=STEPS_OF_A_TEST).cost for k, one in enumerate((loop, always))]
    unpaired = excess_over(*alone)
    assert found.excess is not None
    assert unpaired is not None
    assert agree(found.cost_every_sample, alone[1])
    assert agree(found.excess, unpaired)
    assert 0 < found.excess.standard_error < 1.5 * unpaired.standard_error
    document = found.document()
    assert document["cost_every_sample"]["method"] == "simulation"
    assert document["excess_percent"]["value"] == pytest.approx(100 * found.excess.value)


MISSING = {
    "plant": {"A": [[1.12, 0.2], [0.0, 0.85]], "B": [[0.0], [0.5]], "C": [[1.0, 0.0]], "V": [[0.1]], "dt": 1.0,
              "W": [[0.02, 0.0], [0.0, 0.05]]},
    "cost": {"Q": [[1.0, 0.0], [0.0, 0.2]], "R": [[0.3]]},
}  # fmt: skip
OWN_NODES = {"s": {"measures": [0], "site": "plc"}, "plc": {"controls": True}, "m": {"applies": [0]}}


@pytest.mark.parametrize(
    ("policy", "nodes"),
    [
        ({"kind": "distributed", "theta": 1e-9}, OWN_NODES),
        ({"kind": "distributed", "theta": 1e-9, "actuation": "model"}, OWN_NODES),
        ({"kind": "excess", "theta": 1e-9}, {}),
        ({"kind": "periodic", "every": 2}, {}),
    ],
    ids=["distributed", "distributed, model", "excess", "periodic"],
)
def test_the_baseline_predicts_missing_samples_as_the_loop_does(policy: dict[str, Any], nodes: dict[str, Any]) -> None:
    """A loop that hardly saves a packet costs what its baseline does; fixed steps have the gain for the law."""
    tables = {"nodes": nodes} if nodes else {}
    name = "s" if nodes else "sensor"
    problem = parse({**MISSING, "policy": policy, **tables, "links": {name: {"missing": 0.3}}}, "a problem")
    found = taciturn.evaluate(problem, steps=STEPS_OF_A_TEST)
    if policy["kind"] == "periodic":
        best = taciturn.evaluate(problem.changed({"kind": "all-time", "every": None}), steps=2000)
        assert found.cost_every_sample == best.cost_every_sample
        return
    assert agree(found.cost_every_sample, found.cost)
    assert found.clock is None
    assert "samples are missing at random" in found.no_clock


@pytest.mark.parametrize("third", [[0.0, 0.0, 0.8], [0.0, 0.3, 0.8]], ids=["that equals its own", "of its own"])
def test_a_state_that_counts_at_the_end_only_is_that_of_the_baseline(third: list[float]) -> None:
    """Also if no input moves it, so that the loop and its baseline share it."""
    A, C = [[1.0, 0.1, 0.0], [0.0, 0.9, 0.0], third], np.eye(3)[:2]
    plant = Plant(A, [[0.0], [0.1], [0.0]], np.diag([1e-4, 4e-4, 0.1]), C, 1e-3 * np.eye(2), dt=0.1)
    cost = Cost(np.diag([1.0, 0, 0]), [[0.05]], horizon=20, terminal=np.diag([1.0, 1.0, 50.0]))
    network = Network("udp", actuator_loss=0.1)
    pid = PID(1.2, ki=0.15, input=1, output=1, disturbance=Disturbance(deviation=0.0))
    problem = Problem(plant, cost, network, "distributed", {"theta": 2.0}, controller=pid)
    found, loop = taciturn.evaluate(problem, steps=200_000), problem.close(problem.design())
    every = replace(loop, policy=sending_always(loop.policy), violated_assumptions=("every sample is sent",))
    assert agree(found.cost_every_sample, average(every, steps=200_000, seed=5).cost)


def test_the_pair_is_of_the_same_runs_over_a_horizon() -> None:
    """A scalar loop with clipped inputs, and a cost of its final state."""
    plant = Plant([[1.02]], [[1.0]], [[1.0]], input_limit=[1.5], mean=[3.0])
    cost = Cost([[1.0]], [[0.5]], horizon=20, terminal=[[5.0]])
    problem = Problem(plant, cost, Network(), "excess", {"theta": 0.3})
    found, loop = taciturn.evaluate(problem, steps=STEPS_OF_A_TEST), problem.close(problem.design())
    always = replace(loop, policy=sending_always(loop.policy))
    alone = [average(one, seed=7 + k, steps=STEPS_OF_A_TEST).cost for k, one in enumerate((loop, always))]
    assert agree(found.excess, excess_over(*alone) or alone[0])
    assert agree(found.cost_every_sample, alone[1])


@pytest.mark.parametrize("kind", ["all-time", "periodic"])
def test_a_policy_that_sends_every_sample_has_no_excess(kind: str) -> None:
    """Exactly, with limits and losses; its cost is that of its baseline."""
    problem = changed(kind=kind, theta=None, plant__input_limit=[0.5], **({"every": 1} if kind == "periodic" else {}))
    found = taciturn.evaluate(problem, steps=STEPS_OF_A_TEST)
    assert found.excess is not None
    assert (found.excess.value, found.excess.standard_error) == (0.0, 0.0)
    assert found.cost_every_sample == found.cost
    assert found.verdict[0].startswith("100 % of the packets: this policy sends every sample, at a cost of ")


def test_linear_loops_have_an_exact_baseline() -> None:
    """On another plant, and over links that drop packets without acknowledgement."""
    plant = TANK.plant
    assert isinstance(plant, Plant)
    other = Plant(1.02 * plant.A - 0.02 * np.eye(2), plant.B, plant.W, plant.C, plant.V, dt=plant.dt)
    lossy = Problem(
        Plant([[0.95]], [[1.0]], [[1.0]]), COST, Network("udp", actuator_loss=0.2), "excess", {"theta": 0.3}
    )
    for problem in (replace(TANK, actual=other), lossy):
        found, loop = (
            taciturn.evaluate(problem, steps=STEPS_OF_A_TEST, after_step=False),
            problem.close(problem.design()),
        )
        assert found.cost_every_sample is not None
        assert found.cost_every_sample.method == "exact"
        assert not found.measured
        assert found.cost_all_time is None
        always = replace(loop, policy=sending_always(loop.policy))
        assert agree(average(always, steps=STEPS_OF_A_TEST).cost, found.cost_every_sample)


def test_periodic_control_with_limits_is_compared_with_lqg_that_sends_every_sample() -> None:
    """The gains of periodic control are those of its period; the baseline has its own."""
    plant = Plant([[0.95]], [[1.0]], [[1.0]], input_limit=[2.0])
    found = taciturn.evaluate(Problem(plant, COST, Network(), "periodic", {"every": 3}), steps=STEPS_OF_A_TEST)
    every = average(close(plant, design.all_time(plant, COST)), steps=STEPS_OF_A_TEST, seed=3).cost
    assert agree(found.cost_every_sample, every)
    assert found.excess is not None
    assert found.excess.value > 10 * found.excess.standard_error


@pytest.mark.evidence
def test_a_bad_baseline_has_better_ones_beside_it() -> None:
    """Where silence costs less than sending, with the controllers that cost less than the given one, and a sentence."""
    noisy = TANK.changed(
        {"controller.pid": {"kp": 1.2, "ki": 0.15, "kd": 3.0, "filter": 0.5}, "plant.input_limit": [2.0]}
    )
    for problem in (noisy, noisy.changed({"plant.input_limit": None})):
        found = taciturn.evaluate(problem, steps=STEPS_OF_A_TEST, after_step=False)
        every = found.cost_every_sample
        assert every is not None
        assert found.excess is not None
        assert found.excess.value < -0.1
        assert found.better.keys() == {LQG, HALF_DERIVATIVE}
        assert all(one.value < every.value for one in found.better.values())
        assert f"every sample, {LQG} " in str(found)
        assert "sending less costs less here, because the controller amplifies noise" in " ".join(str(found).split())
        assert found.document()["better_every_sample"][LQG]["value"] == found.better[LQG].value
    assert found.better[LQG].value == pytest.approx(noisy.changed({"plant.input_limit": None}).design().theory.cost_lqg)
    assert not taciturn.evaluate(TANK.changed({"theta": 2.0}), steps=STEPS_OF_A_TEST).better


@pytest.mark.evidence
def test_tune_keeps_a_share_above_a_measured_baseline() -> None:
    """With clipped inputs: the answer, evaluated again with another seed, is at most so much above every sample."""
    problem = Problem(LIMITED, COST, Network(), "send-on-delta", {"delta": 1.0}, controller=PID(0.6))
    tuned = taciturn.tune(problem, cost="+10%", standard_error=4e-3)
    again = taciturn.evaluate(tuned.problem, seed=5, steps=STEPS_OF_A_TEST).excess
    assert again is not None
    assert 0.08 < again.value < 0.10 + 4 * again.standard_error
    assert tuned.budget["of"] == "cost relative to every sample"
    assert tuned.budget["at_most"] == 1.1
    assert "cost at most 10 % above every sample, met with " in tuned.verdict[0]
    assert tuned.verdict[1].endswith(" % more cost than every sample, measured")
    assert tuned.verdict[2] == "no guarantee holds: inputs are clipped (input_limit)"


@pytest.mark.parametrize(
    "changes",
    [
        {"links.sensor.missing": 0.2},
        {"reference.steps": {"rate": 0.005, "covariance": [[1.0]]}, "reference.ramp": [0.05]},
        {"disturbance": [{"enters": [0.0, -0.1], "initial": 0.3}]},
    ],
    ids=["missing samples", "ramp", "load"],
)
def test_the_baseline_has_what_the_loop_has(changes: dict[str, object]) -> None:
    """Its cost is that of ``all-time`` under the same conditions, which differs from that of the design."""
    kept = taciturn.load("pid-tank").changed(changes)
    every = kept.changed({"policy.kind": "all-time", "policy.theta": None})
    own, found = (taciturn.evaluate(one, steps=200_000, after_step=False) for one in (kept, every))
    assert own.cost_every_sample is not None
    assert found.excess is not None
    assert found.excess.value == 0.0
    errors = [own.cost_every_sample.standard_error, found.cost.standard_error]
    assert abs(own.cost_every_sample.value - found.cost.value) < 4 * np.hypot(*errors)
    assert abs(own.cost_every_sample.value - taciturn.load("pid-tank").design().cost_all_time) > 4 * np.hypot(*errors)


@pytest.mark.parametrize("kind", ["all-time", "periodic"])
@pytest.mark.parametrize("protocol", ["udp", "tcp"])
def test_controllers_at_fixed_steps_run_over_links_that_drop_packets(kind: str, protocol: str) -> None:
    """The cost is simulated, and that of every sample is exact: the same as of ``excess`` without a threshold."""
    lossy = {"network.protocol": protocol, "network.actuator_loss": 0.2}
    fixed = {"policy.kind": kind, "policy.theta": None, **({"policy.every": 1} if kind == "periodic" else {})}
    found = taciturn.evaluate(taciturn.load("pid-tank").changed({**lossy, **fixed}), steps=200_000, after_step=False)
    assert found.cost_every_sample is not None
    assert found.cost_every_sample.standard_error == 0.0
    assert abs(found.cost.value - found.cost_every_sample.value) < 4 * found.cost.standard_error
    if protocol == "tcp":
        attempts = taciturn.load("pid-tank").changed(lossy).design().cost_all_time
        assert found.cost_every_sample.value == pytest.approx(attempts, rel=1e-9)


def test_links_with_limits_and_late_packets_have_a_baseline_without_limits() -> None:
    """It was refused, as if its packets had to keep the limits."""
    late = {"links.level-1.min_interval": 2, "links.level-1.delay": [0.5, 0.5]}
    found = taciturn.evaluate(taciturn.load("quadruple-tank").changed(late), standard_error=2e-3)
    assert found.baseline is not None
    assert found.baseline.value < found.cost.value
