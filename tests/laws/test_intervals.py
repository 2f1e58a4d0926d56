"""Limits on the intervals between sends: kept by every kind, with the claims that hold and without the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from catalogue import POLICIES, UNPROVED, closed
from counts import few
from drawn import law
from hypothesis import strategies as st
from measured import average
from systems import System, make_system, systems

import taciturn
from taciturn import Cost, Loop, Network, Plant, Policy, ProblemError, close, design
from taciturn.model.link import LinkLaw
from taciturn.model.network import NodeRole
from taciturn.model.steps import Assign, Decide, Send, fixed_choices
from taciturn.model.trigger import Form, Trigger
from taciturn.program.numpy import run
from taciturn.program.ops import Sent
from taciturn.simulation.average import plain_average
from taciturn.study.describe import describe
from taciturn.study.record import origin

DECIDING = tuple(
    name
    for name in POLICIES
    if not name.startswith(("all-time", "periodic", "cycle", "pattern", "variance")) and "at the actuator" not in name
)
PROVED = ("lqg joint hold", "lqg separate model", "excess hold", "excess model", "absolute", "relative", "dynamic",
          "distributed", "distributed model", "lossy udp", "lossy tcp", "remote, at the sensor")  # fmt: skip


def limited(policy: Policy, least: int, most: int | None) -> Loop:
    """Close the loop of a policy over links with limits, where a decision depends on data."""
    laws = {
        step.link: {"min_interval": least, "max_interval": most}
        for step in policy.steps
        if isinstance(step, Send) and step.on is not None and data(policy, step.on)
    }
    return close(policy.model, policy, policy.network.changed(laws))


def data(policy: Policy, decision: str) -> bool:
    """Return whether a decision depends on data."""
    return fixed_choices(decision, policy.locations, policy.decisions) is None


def intervals(loop: Loop, paths: int = 3, ticks: int = 80) -> dict[str, list[np.ndarray]]:
    """Return the steps of the sends on each limited link, by path; NumPy itself runs the program."""
    program = loop.program()
    found = run(program, loop.start(program, paths, 1), min(ticks, loop.horizon or ticks)).outputs
    sent = {name.link: values.T for name, values in found.items() if isinstance(name, Sent)}
    wanted = [link for link in sent if loop.network.links[link].intervals != LinkLaw().intervals]
    return {link: [np.flatnonzero(one) for one in sent[link]] for link in wanted}


@pytest.mark.parametrize("name", few(DECIDING, 10, 1))
@law(2, 20, system=systems(states=3), least=st.integers(1, 4), more=st.one_of(st.none(), st.integers(0, 6)))
def test_every_kind_keeps_the_intervals(name: str, system: System, least: int, more: int | None) -> None:
    """From the first step on: no two sends are closer than the least, none is later than the largest interval."""
    most = None if more is None else least + more
    loop = limited(POLICIES[name](system), least, most)
    for paths in intervals(loop).values():
        for ticks in paths:
            assert np.diff(ticks).min(initial=least) >= least
            assert most is None or np.diff(ticks, prepend=-least).max() <= most


@pytest.mark.parametrize("name", few(PROVED, 4))
@law(1, 12, system=systems(states=3), least=st.integers(1, 2), more=st.integers(1, 5))
def test_the_identity_is_exact_with_limits(name: str, system: System, least: int, more: int) -> None:
    """The plain average of the stage cost and the identity, within standard errors."""
    policy = POLICIES[name](system)
    least = least if np.abs(np.linalg.eigvals(system.plant.A)).max() < 1 else 1  # else the mean square may grow
    loop = limited(policy, least, least + more)
    assert loop.identity is not None
    exact, plain = average(loop, steps=60_000), average(loop, plain_average(loop), steps=60_000, seed=1)
    error = np.hypot(exact.cost.standard_error, plain.cost.standard_error)
    assert abs(exact.cost.value - plain.cost.value) <= 5 * error


@pytest.mark.parametrize("name", few(PROVED, 4, 1))
@law(1, 12, system=systems(states=3), most=st.integers(1, 5))
def test_a_bound_by_the_cost_of_silence_holds_with_a_largest_interval(name: str, system: System, most: int) -> None:
    """Also the bound at the rate, which is at least 1/N; a least interval takes the bound away, with a note."""
    policy = POLICIES[name](system)
    loop = limited(policy, 1, most)
    guarantee = loop.policy.guarantee
    assert loop.nominal
    assert guarantee is policy.guarantee is not None
    found = average(loop, steps=60_000)
    assert found.cost.value <= guarantee.cost + 4 * found.cost.standard_error
    sharper = guarantee.at_rates(found.rates, loop.policy.scheduled[0])
    if sharper is not None:
        margin = 4 * np.hypot(found.cost.standard_error, sharper.standard_error)
        assert found.cost.value <= sharper.value * (1 + 1e-9) + margin
    for link, rate in found.rates.items():
        if loop.network.links[link].max_interval is not None:
            assert rate.value >= 1 / most - 1e-3
    withheld = limited(policy, 2, None).policy
    assert withheld.guarantee is None
    assert "min_interval withholds packets against the decision" in withheld.notes[-1]


def test_bounds_of_other_theorems_are_withdrawn_by_name() -> None:
    """A forced packet is not one of a rollout; the identity remains, and no exact method ignores the limits."""
    system = make_system(3, 2, 1, 2, True)
    for name in ("rollout", "self-triggered", "stochastic model"):
        loop = limited(POLICIES[name](system), 1, 3)
        assert loop.nominal
        assert loop.policy.guarantee is loop.policy.theory.closed_form is None
        assert "actuator.max_interval forces packets" in loop.policy.notes[-1]
    reset = limited(design.excess(system.plant, system.cost, theta=0.3, actuation="model"), 1, 3)
    for method in ("exact", "conditional sampling"):
        with pytest.raises(ProblemError, match=r"links.max_interval is given, which renewal equations do not support"):
            taciturn.evaluate(reset.policy, method=method)
    assert taciturn.evaluate(reset.policy, steps=10_000).method == "simulation"
    with pytest.raises(ProblemError, match=r"max_interval\) are given, which certificates"):
        taciturn.certify(reset.policy)


def test_a_loop_in_numpy_has_the_same_sends_and_cost() -> None:
    """The count by hand: the trigger decides only from the least interval on, and no later than the largest one."""
    plant, cost, least, most, theta = Plant([[1.05]], [[1.0]], [[0.2]]), Cost([[1.0]], [[0.5]]), 2, 6, 1.0
    policy = design.excess(plant, cost, theta=theta)
    loop = limited(policy, least, most)
    found = average(loop, steps=400_000)
    silent = next(step for step in policy.steps if isinstance(step, Decide)).trigger.options["silent"]
    assert isinstance(silent.Psi, np.ndarray)
    H, K = float(silent.Psi[0, 0]), policy.steps
    L = next(float(step.branches[0]["estimate"][0, 0]) for step in K if getattr(step, "signal", "") == "command")
    delta = theta * policy.cost_all_time
    draws, paths, ticks = np.random.default_rng(4), 400, 1500
    x, u, count = np.zeros(paths), np.zeros(paths), np.full(paths, least)
    total, sends = np.zeros(paths), np.zeros(paths)
    for k in range(ticks):
        send = (((u - L * x) ** 2 * H > delta) & (count >= least)) | (count >= most)
        u, count = np.where(send, L * x, u), np.where(send, 1, count + 1)
        if k >= 200:
            total, sends = total + x * x + 0.5 * u * u, sends + send
        x = 1.05 * x + u + np.sqrt(0.2) * draws.standard_normal(paths)
    for exact, values in ((found.cost, total), (found.rates["actuator"], sends)):
        mean, error = values.mean() / (ticks - 200), values.std() / (ticks - 200) / np.sqrt(paths)
        assert abs(exact.value - mean) <= 4.5 * np.hypot(error, exact.standard_error)


def test_sets_of_links_keep_the_intervals_of_each() -> None:
    """Two actuators with different limits in one decision: the cheapest set that the limits allow."""
    nodes = {"s": NodeRole(measures=True, site="plc"), "plc": NodeRole(controls=True)}
    nodes |= {f"v{i}": NodeRole(applies=(i,)) for i in range(2)}
    system = make_system(8, 3, 2, 3, True)
    for kind in (design.excess, design.distributed):
        more = {} if kind is design.excess else {"joint": True}
        laws = {"v0": LinkLaw(min_interval=2, max_interval=3), "v1": LinkLaw(price=2.0, max_interval=5)}
        policy = kind(system.plant, system.cost, theta=0.5, network=Network(nodes=nodes, links=laws), **more)
        loop = closed(policy)
        gaps = {link: {int(gap) for one in paths for gap in np.diff(one)} for link, paths in intervals(loop).items()}
        assert gaps["v0"] == {2, 3}
        assert gaps["v1"] <= {1, 2, 3, 4, 5}
        exact, plain = average(loop, steps=60_000), average(loop, plain_average(loop), steps=60_000, seed=1)
        margin = 5 * np.hypot(exact.cost.standard_error, plain.cost.standard_error)
        assert abs(exact.cost.value - plain.cost.value) <= margin


def test_packets_that_are_dropped_count_as_sent() -> None:
    """The sender may not know of a drop, so the intervals are those between attempts."""
    system = make_system(5, 2, 1, 2, True)
    network = Network(links={"actuator": LinkLaw(0.4, acknowledged=True, min_interval=2, max_interval=4)})
    policy = design.excess(system.plant, system.cost, theta=0.5, network=network)
    for ticks in intervals(closed(policy))["actuator"]:
        assert np.diff(ticks).min() >= 2
        assert np.diff(ticks).max() <= 4


def test_fixed_steps_are_checked_and_unchanged() -> None:
    """A schedule that keeps the limits has its exact cost; another one is refused."""
    system = make_system(5, 2, 1, 2, True)
    problem = taciturn.Problem(system.plant, system.cost, Network(), "periodic", {"every": (2, 3)})
    within = Network(links={"actuator": LinkLaw(min_interval=2, max_interval=3)})
    assert taciturn.evaluate(replace(problem, network=within)).cost == taciturn.evaluate(problem).cost
    for name, limit, gap in (("min_interval", 3, 2), ("max_interval", 2, 3)):
        links = {"actuator": LinkLaw(**{name: limit})}
        with pytest.raises(
            ProblemError, match=rf"{name} is {limit}, but the policy periodic sends at fixed .* interval of {gap}"
        ):
            close(system.plant, problem.design(), Network(links=links))
    with pytest.raises(
        ProblemError, match=r"min_interval is 2, but the policy all-time sends at fixed steps .* of 1 step;"
    ):
        close(
            system.plant,
            design.all_time(system.plant, system.cost),
            Network(links={"actuator": LinkLaw(min_interval=2)}),
        )


def test_baselines_and_studies_take_limits() -> None:
    """Periodic control at the same rate, the text of the link, and a certificate for any noise."""
    problem = taciturn.load("two-mass").changed({"links.actuator.min_interval": 2, "links.actuator.max_interval": 9})
    assert origin(problem) != origin(taciturn.load("two-mass"))
    found = taciturn.evaluate(problem, steps=100_000)
    assert found.cost_periodic_same_rate is not None
    assert found.cost_bound is None
    assert any("so no guarantee is claimed" in note for note in found.notes)
    assert "at least 2 steps between sends; at most 9 steps between sends" in str(describe(problem).lines())
    band = {"kind": "send-on-delta", "theta": None, "actuation": None, "delta": 0.2}
    free, forced, withheld = (
        taciturn.load("two-mass").changed(band | more).design()
        for more in ({}, {"links.sensor.max_interval": 4}, {"links.sensor.min_interval": 2})
    )
    assert forced.guarantee == free.guarantee is not None
    assert forced.theory.errors == free.theory.errors
    assert not withheld.theory.errors


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        ({"min_interval": 0}, "min_interval is 0; expected a whole number of at least 1"),
        ({"max_interval": 0}, "max_interval is 0; expected a whole number of at least 1"),
        ({"min_interval": 2.5}, r"min_interval is 2\.5; expected a whole number"),
        (
            {"min_interval": 5, "max_interval": 3},
            "max_interval is 3, and min_interval is 5; expected max_interval ≥",
        ),
        ({"max_interval": 10**7}, "max_interval is 10000000; expected at most 1000000 steps"),
    ],
)
def test_nonsense_is_refused(law: dict[str, int], expected: str) -> None:
    """In one sentence, by the key of the link in a file."""
    with pytest.raises(ProblemError, match=f"^{expected}"):
        LinkLaw(**law)
    if all(isinstance(value, int) for value in law.values()):
        with pytest.raises(ProblemError, match=f"links.actuator.{expected}"):
            taciturn.load("two-mass").changed({f"links.actuator.{name}": value for name, value in law.items()})


@pytest.mark.evidence
def test_limits_of_another_design_and_of_a_link_without_packets_are_refused() -> None:
    """Nodes do not ignore the limits of their network; a decision on sets needs a label for every set."""
    policy = taciturn.load("two-mass").changed({"links.actuator.max_interval": 5}).design()
    with pytest.raises(
        ProblemError, match="policy was designed for other limits of the intervals between sends on the actuator link"
    ):
        close(policy.model, policy, Network(links={"actuator": LinkLaw(max_interval=6)}))
    with pytest.raises(
        ProblemError, match=r"sensor\.max_interval is given, but no node of the policy excess receives a packet on"
    ):
        taciturn.load("two-mass").changed({"links.sensor.max_interval": 5}).design()
    without = {"kind": "integral", "slope": 0.1, "period": None, "delta": None, "links.sensor.max_interval": 5}
    with pytest.raises(
        ProblemError, match="min_interval or max_interval is given, which the policy integral without a period does"
    ):
        taciturn.load("double-integrator").changed(without).designed()
    plant = Plant(np.eye(2), np.eye(2), np.eye(2))
    nodes = {"plc": NodeRole(controls=True), "s": NodeRole(measures=True, site="plc")}
    nodes |= {name: NodeRole(applies=(i,)) for i, name in enumerate("ab")}
    forms = {"silent": Form(("y",), np.eye(2)), "both": Form(constant=1.0)}
    sends = (Send("plc", name, ("y",), "choice") for name in "ab")
    inputs = (Assign(name, f"input_{name}", {"one": np.zeros((1, 1))}) for name in "ab")
    network = Network(nodes=nodes, links={name: LinkLaw(max_interval=2) for name in "ab"})
    with pytest.raises(ProblemError, match="'choice' has no label that sends only on b"):
        Policy("own", (Decide("plc", "choice", Trigger(forms)), *sends, *inputs), plant, network=network)
    with pytest.raises(ProblemError, match="excludes 'never'; expected one of its options"):
        Trigger(forms, excluded={"never": (Form(),)})


def test_the_names_of_the_catalogue_are_all_listed() -> None:
    """A new policy of the catalogue is one of these laws."""
    assert set(UNPROVED) <= set(DECIDING)
    assert set(PROVED) <= set(DECIDING)


def test_a_link_that_sends_in_every_step_keeps_any_longest_interval() -> None:
    """Also over a horizon: no interval follows its last step."""
    links = {"sensor": {"loss": 0.2, "max_interval": 3}, "actuator": {"loss": 0.2, "acknowledged": True}}
    problem = taciturn.load("lossy-double-integrator").changed({"network": None, "links": links})
    assert problem.cost.horizon is not None
    assert problem.design().network.links["sensor"].max_interval == 3
