"""A given controller whose links send at fixed steps: its exact cost, the best timings, and the comparison with it."""

from __future__ import annotations

import itertools
from dataclasses import replace
from math import lcm

import numpy as np
import pytest
from counts import few, scaled
from drawn import law
from hypothesis import strategies as st
from measured import average
from systems import System, systems

import taciturn
from taciturn.base.given_controller import GivenLoop, SameControl, lqg_observer
from taciturn.errors import UnstableError
from taciturn.loop import close
from taciturn.lqg.discrete import discretise
from taciturn.lqg.periodic import Timing
from taciturn.model.controller import PID, ContinuousController, Controller
from taciturn.model.disturbance import Disturbance
from taciturn.model.link import LinkLaw
from taciturn.model.network import Network, NodeRole
from taciturn.model.policy import Policy
from taciturn.model.steps import Decide, Location
from taciturn.model.trigger import Form, Scheduled, Trigger
from taciturn.problem import Problem
from taciturn.study.periodic import ClockPoint, beside, lower_hull
from taciturn.study.timed_links import TimedLinks
from taciturn_studies.periodic_links import LinkClocks, clocks_of_links, clocks_or_reason

NONE = Disturbance(deviation=0.0)
NODES = {"level": NodeRole(measures=(0,)), "plc": NodeRole(controls=True), "valve": NodeRole(applies=(0,))}
TANK = taciturn.Plant([[1, 0.1], [0, 0.9]], [[0], [0.1]], np.diag([1e-4, 4e-4]), [[1.0, 0]], [[1e-3]], dt=0.1)
COST = taciturn.Cost(np.diag([1.0, 0]), [[0.05]])
KEPT = Controller([[1, 0], [0, 0.8]], [[0.1], [0.2]], [[-0.15, 2.0]], [[-3.2]], dt=0.1, disturbance=NONE)
ALL = {link: Timing(1) for link in ("level", "valve")}


def tank(kind: str = "distributed", prices: dict[str, float] | None = None, **policy: object) -> Problem:
    """Return a tank with a PID controller, whose level and valve have a link each."""
    network = Network(nodes=NODES, links={link: LinkLaw(price=price) for link, price in (prices or {}).items()})
    given = policy or ({"theta": 0.5} if kind == "distributed" else {"delta": 0.05})
    return Problem(TANK, COST, network, kind, given, controller=KEPT)


def heated(**policy: object) -> Problem:
    """Return a continuous plant with a continuous controller that integrates, and the cost of the time in between."""
    plant = taciturn.ContinuousPlant([[0, 1], [0, -1]], [[0], [1]], np.diag([1e-3, 4e-3]), C=[[1.0, 0]], V=[[1e-3]])
    pid = PID(kp=1.2, ki=0.15, kd=1.0, filter=2.0, disturbance=NONE)
    return Problem(plant, COST, Network(nodes=NODES), "distributed", {"period": 0.2, **policy}, controller=pid)


def timed(problem: Problem) -> TimedLinks:
    """Return the problem with a timetable in place of its policy's decisions."""
    policy = problem.designed()
    assert isinstance(policy, Policy)
    return TimedLinks.of(problem, policy)


def by_timetable(policy: Policy, timings: dict[str, Timing]) -> Policy:
    """Return a policy whose nodes decide by the step alone, for the library's own simulation."""
    length = lcm(*(one.period for one in timings.values()))
    steps = []
    for step in policy.steps:
        if isinstance(step, Decide):
            (link,) = (link for link in timings if step.decision.endswith(link))
            silent, send = step.trigger.labels
            sign = [1.0 if timings[link].age(k) == 0 else -1.0 for k in range(length)]
            trigger = Trigger({silent: Form(constant=Scheduled("clock", sign)), send: Form()})
            steps.append(Decide(step.at, step.decision, trigger))
        else:
            steps.append(step)
    clock = Location("clock", (np.arange(length) + 1) % length)
    return replace(policy, steps=tuple(steps), locations=(clock,))


def cost_by_moments(plant: taciturn.Plant, cost: taciturn.Cost, c: Controller, timings: dict[str, Timing]) -> float:
    """Return the cost of held values by the second moments of (x, the controller's state, outputs, inputs)."""
    n, k, p, m = plant.states, len(c.A), plant.outputs, plant.inputs
    size = n + k + p + m
    x, z, heard, held = np.split(np.eye(size), np.cumsum([n, k, p]))
    length = lcm(*(one.period for one in timings.values()))
    weight = np.block([[cost.Q, cost.N], [cost.N.T, cost.R]])
    maps, noises, stages = [], [], []
    for step in range(length):
        fresh = np.diag([float(timings[f"s{i}"].age(step) == 0) for i in range(p)])
        told = np.diag([float(timings[f"a{i}"].age(step) == 0) for i in range(m)])
        used = fresh @ plant.C @ x + (np.eye(p) - fresh) @ heard  # plus fresh v
        applied = told @ (c.C @ z + c.D @ used) + (np.eye(m) - told) @ held
        by_noise = told @ c.D @ fresh
        F = np.vstack([plant.A @ x + plant.B @ applied, c.A @ z + c.B @ used + c.E @ applied, used, applied])
        G = np.vstack([plant.B @ by_noise, c.B @ fresh + c.E @ by_noise, fresh, by_noise])
        maps.append(F)
        noises.append(G @ plant.V @ G.T + np.pad(plant.W, (0, size - n)))
        both, moved = np.vstack([x, applied]), np.vstack([np.zeros((n, p)), by_noise])
        stages.append((both.T @ weight @ both, float(np.sum(weight * (moved @ plant.V @ moved.T)))))
    cycle, added = np.eye(size), np.zeros((size, size))
    for F, W in zip(maps, noises, strict=True):
        cycle, added = F @ cycle, F @ added @ F.T + W
    if np.abs(np.linalg.eigvals(cycle)).max() >= 1:
        raise UnstableError("unstable")
    X = np.linalg.solve(np.eye(size**2) - np.kron(cycle, cycle), added.ravel()).reshape(size, size)
    total = 0.0
    for F, W, (M, constant) in zip(maps, noises, stages, strict=True):
        total += float(np.sum(M * X)) + constant
        X = F @ X @ F.T + W
    return total / length


@law(4, 300, system=systems(3, 2), seed=st.integers(0, 2**32 - 1))
def test_the_cost_of_a_timetable_is_that_of_the_second_moments(system: System, seed: int) -> None:
    """A node for each output and input, any periods and phases; both find the same timings unstable."""
    draws = np.random.default_rng(seed)
    plant, cost = system.plant, system.cost
    nodes = {f"s{i}": NodeRole(measures=(i,)) for i in range(plant.outputs)}
    nodes |= {f"a{i}": NodeRole(applies=(i,)) for i in range(plant.inputs)}
    network = Network(nodes=nodes | {"plc": NodeRole(controls=True)})
    kept = lqg_observer("distributed", discretise(plant, cost, None))
    problem = Problem(plant, cost, network, "distributed", {"theta": 0.2}, controller=kept)
    here = timed(problem)
    for _ in range(3):
        periods = draws.integers(1, 4, size=len(network.links))
        timings = {link: Timing(int(q), int(draws.integers(q))) for link, q in zip(network.links, periods, strict=True)}
        try:
            expected = cost_by_moments(plant, cost, kept, timings)
        except UnstableError:
            with pytest.raises(UnstableError, match="expected shorter periods"):
                here.cost(timings)
            continue
        # near the limit of stability, both solve equations that amplify rounding
        assert here.cost(timings) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("every", few(range(2, 9), 2))
def test_one_timed_link_costs_what_the_base_of_this_link_states(every: int) -> None:
    """The algebra of the base of one link is another one; continuous controllers are discretised anew."""
    nodes = {"plc": NodeRole(measures=(0,), controls=True), "valve": NodeRole(applies=(0,))}
    for problem in (tank(), heated(theta=0.5)):
        own = replace(problem, network=Network(nodes=nodes))
        kept = own.changed({"kind": "excess"}).designed().theory.periodic
        assert isinstance(kept, SameControl)
        here = timed(own)
        found = here.cost({"valve": Timing(every)})
        assert found == pytest.approx(here.loop.problem.per_unit(kept(every)), rel=1e-9)
        anew = kept.discretised(every)
        assert (anew is None) == (problem.controller is KEPT)


def test_equal_periods_also_try_the_controller_of_the_longer_step() -> None:
    """Its cost is that of the plant sampled with this step; other timings cannot use it."""
    problem = heated(theta=0.5)
    here, slow = timed(problem), heated(theta=0.5, period=0.8)
    given = GivenLoop.of(slow.plant, slow.cost, 0.8, slow.controller)
    anew = given.problem.per_unit(given.value(given.every_sample())[1])
    kept = replace(here, slower=None).cost({"level": Timing(4), "valve": Timing(4)})
    assert anew < 0.99 * kept
    assert here.cost({"level": Timing(4), "valve": Timing(4)}) == pytest.approx(anew, rel=1e-9)
    apart = {"level": Timing(4), "valve": Timing(2)}
    assert here.cost(apart) == replace(here, slower=None).cost(apart)


@pytest.mark.parametrize("mode", few(["hold", "model"], 2))
def test_a_simulation_by_a_timetable_has_the_exact_cost(mode: str) -> None:
    """The library's own engine, for a sampled plant with the cost of the time in between."""
    problem = heated(theta=0.5, actuation=mode)
    timings = {"level": Timing(2, 1), "valve": Timing(3, 2)}
    policy = problem.designed()
    found = average(close(problem.plant, by_timetable(policy, timings)), seed=2, steps=scaled(4_000_000, 400_000))
    exact = timed(problem).cost(timings)
    assert found.cost.standard_error < 0.01 * exact
    assert abs(found.cost.value - exact) < 4.5 * found.cost.standard_error
    assert [one.value for one in found.rates.values()] == pytest.approx([1 / 0.4, 1 / 0.6], rel=1e-3)


def test_a_prediction_at_both_ends_is_that_of_the_policy() -> None:
    """Simulated for a controller without an integral, whose sensor predicts too; it differs from holding."""
    slack = ContinuousController([[-2.0]], [[1.0]], [[2.0]], [[-3.2]], disturbance=NONE)
    problem = replace(heated(theta=0.5, prediction="model", actuation="model"), controller=slack)
    timings = {"level": Timing(3, 1), "valve": Timing(2)}
    found = average(close(problem.plant, by_timetable(problem.designed(), timings)), seed=1, steps=400_000)
    exact = timed(problem).cost(timings)
    assert abs(found.cost.value - exact) < 4.5 * found.cost.standard_error
    held = timed(problem.changed({"prediction": "hold", "actuation": "hold"})).cost(timings)
    assert abs(held - exact) > 20 * found.cost.standard_error


@pytest.mark.parametrize("kind", ["distributed", "send-on-delta"])
def test_a_timetable_does_not_depend_on_the_rule_that_it_replaces(kind: str) -> None:
    """Banks and dead bands hold alike; with a packet in every step the cost is that of every sample."""
    here = timed(tank(kind))
    assert here.cost(ALL) == pytest.approx(here.loop.policy.cost_all_time, rel=1e-12)
    timings = {"level": Timing(3, 1), "valve": Timing(2)}
    assert here.cost(timings) == pytest.approx(timed(tank()).cost(timings), rel=1e-12)


@pytest.mark.parametrize("price", few([1.0, 4.0, 0.3], 2))
def test_the_timings_found_are_the_best_of_all_periods_and_phases(price: float) -> None:
    """No mixture of timings with periods up to 7 costs less at the same priced traffic."""
    problem = tank(prices={"level": price})
    here, points = timed(problem), dict[ClockPoint, None]()
    for level, valve in itertools.product(range(1, 8), repeat=2):
        for phase in range(valve):
            try:
                cost = here.cost({"level": Timing(level), "valve": Timing(valve, phase)})
            except UnstableError:
                continue
            points[ClockPoint(price / level + 1 / valve, cost)] = None
    corners = lower_hull(points)
    for share in (0.35, 0.5, 0.8):
        traffic = share * (price + 1)
        low, high = beside(corners, traffic)
        part = (traffic - low.rate) / (high.rate - low.rate) if high.rate > low.rate else 0.0
        found = clocks_of_links(problem, traffic)
        assert found.cost <= ((1 - part) * low.cost + part * high.cost) * (1 + 1e-9)
        parts = zip(found.shares, found.timings, strict=True)
        spent = sum(one * (price / each["level"].period + 1 / each["valve"].period) for one, each in parts)
        assert spent == pytest.approx(traffic, rel=1e-9)


def test_searches_share_the_costs_of_loops_that_are_alike_at_fixed_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy that allows more silence is compared with the same periodic control; another cost is not."""
    problem = tank()
    first = clocks_of_links(problem, 0.7)
    monkeypatch.setattr(TimedLinks, "cost", lambda *_: pytest.fail("a known cost is computed once more"))
    assert clocks_of_links(problem.changed({"theta": 0.3}), 0.7) == first
    monkeypatch.setattr(TimedLinks, "cost", lambda *_: 1.0)
    assert clocks_of_links(replace(problem, cost=taciturn.Cost(COST.Q, COST.R)), 0.7).cost == 1.0


def test_timings_keep_the_limits_of_intervals() -> None:
    """Without the limits, both links would share the traffic; a traffic below the limits is refused."""
    links = {"level": LinkLaw(max_interval=2), "valve": LinkLaw(min_interval=3)}
    problem = replace(tank(), network=Network(nodes=NODES, links=links))
    found, free = clocks_of_links(problem, 0.9), clocks_of_links(tank(), 0.9)
    for one in found.timings:
        assert one["level"].period <= 2
        assert one["valve"].period >= 3
    assert free.cost < found.cost
    assert "no allowed periods" in str(clocks_or_reason([problem], 0.3))


def test_a_comparison_has_the_cheapest_means_of_its_policies() -> None:
    """A policy that predicts lends its model to the timetable; a controller to keep is named as such."""
    hold, model = tank(), tank(theta=0.5, actuation="model")
    both = clocks_or_reason([hold, model, tank("send-on-delta")], 0.7)
    each = [clocks_of_links(one, 0.7) for one in (hold, model)]
    assert isinstance(both, LinkClocks)
    assert both.cost == min(one.cost for one in each) < max(one.cost for one in each)
    assert {one.document()["gains"] for one in (both, *each)} == {"given"}
    assert each[1].document()["kind"] == "model"
    lossy = Network(nodes=NODES, links={"level": LinkLaw(loss=0.1, acknowledged=True)})
    assert "deliver every packet" in str(clocks_or_reason([replace(hold, network=lossy)], 0.7))


def test_a_single_link_has_the_periodic_control_of_its_controller() -> None:
    """Not that of LQG: at a packet in every second step, the exact cost of this timetable."""
    nodes = {"plc": NodeRole(measures=(0,), controls=True), "valve": NodeRole(applies=(0,))}
    problem = replace(tank(), network=Network(nodes=nodes))
    found = taciturn.evaluate(problem, steps=4096)
    assert found.clock is not None
    (rate,) = found.rates.values()
    costs = {every: timed(problem).cost({"valve": Timing(every)}) for every in (1, 2, 3)}
    ends = [(1 / every, cost) for every, cost in sorted(costs.items(), reverse=True)]
    assert found.clock.cost == pytest.approx(np.interp(rate.value, *np.array(ends).T), rel=1e-9)
