"""Several sensors and actuators that decide for themselves: identity, bounds, and the reference of two masses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from counts import few, scaled
from drawn import over
from hypothesis import assume
from hypothesis import strategies as st
from measured import average
from scipy.linalg import expm
from systems import System, make_system, well_posed

from taciturn import Burst, Cost, Estimate, Loop, Network, Plant, Policy, UnstableError, close, design, evaluate
from taciturn.analyse.switched import outcomes
from taciturn.errors import ProblemError
from taciturn.loop import EXCESS
from taciturn.model.link import LinkLaw
from taciturn.model.network import NodeRole
from taciturn.program.numpy import run
from taciturn.simulation.average import completed_squares, plain_average


@st.composite
def designs(draw: st.DrawFn) -> tuple[System, Policy]:
    """Draw a system, a network whose nodes share its outputs and inputs, and a policy for it."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    states, inputs, outputs = (int(rng.integers(1, most + 1)) for most in (6, 4, 4))
    measured = bool(rng.integers(4) == 0)
    system = make_system(seed, states, inputs, states if measured else outputs, measured)
    assume(well_posed(system.plant.A, system.plant.B) and well_posed(system.plant.A.T, system.plant.C.T))
    network = network_for(system.plant, rng)
    assume(network.links)
    options = {"prediction": ("hold", "model"), "actuation": ("hold", "model"), "joint": (False, True)}
    chosen = {name: values[rng.integers(2)] for name, values in options.items()}
    shares = dict(zip(network.links, rng.uniform(0.0, 1.0, len(network.links)).tolist(), strict=True))
    theta = float(rng.choice([0.02, 0.2, 1.0]))
    policy = design.distributed(system.plant, system.cost, theta=theta, shares=shares, network=network, **chosen)
    return system, policy


def network_for(plant: Plant, rng: np.random.Generator) -> Network:
    """Return a network in which up to four sensors and four actuators share the outputs and inputs of a plant."""
    nodes = {"plc": NodeRole(controls=True)}
    for role, size in (("measures", plant.outputs), ("applies", plant.inputs)):
        owner = rng.integers(4, size=size)
        for k in sorted(set(owner.tolist())):
            site = "plc" if rng.integers(5) == 0 else None
            nodes[f"{role}-{k}"] = NodeRole(**{role: tuple(np.flatnonzero(owner == k).tolist())}, site=site)
    links = [name for name, role in nodes.items() if not role.controls and role.site is None]
    return Network(nodes=nodes, links={name: LinkLaw(price=float(rng.uniform(0.5, 2.0))) for name in links})


def excesses(loop: Loop, seed: int, ticks: int = 40, paths: int = 50) -> np.ndarray:
    """Return the excess (u − Lx̂)'H(u − Lx̂) of every path, (steps, paths), in the units of the cost."""
    program = loop.reduced_program()
    told = replace(program, sums={}, outputs={EXCESS: program.sums[EXCESS]})
    return run(told, loop.start(told, paths, seed), ticks).outputs[EXCESS]


def the_bound_holds_on_every_path(system: System, policy: Policy, steps: int) -> None:
    """No step of a path exceeds (Σ√δ)², no mean exceeds the bound at its rates, and the identity is the average."""
    loop = close(system.plant, policy, cost=system.cost)
    assert loop.nominal
    assert loop.reducible
    guarantee = policy.guarantee
    assert guarantee is not None
    most = guarantee.cost - policy.cost_all_time
    assert excesses(loop, system.seed).max() <= most * (1 + 1e-9) + 1e-12 * policy.cost_all_time
    identity = average(loop, completed_squares(loop), seed=system.seed, steps=steps)
    plain = average(loop, plain_average(loop), seed=system.seed + 1, steps=steps)
    error = np.hypot(identity.cost.standard_error, plain.cost.standard_error)
    assert abs(identity.cost.value - plain.cost.value) <= 5 * error + 1e-9 * policy.cost_all_time
    rates = {link: replace(rate, value=min(rate.value, 1.0)) for link, rate in identity.rates.items()}
    sharper = guarantee.at_rates(rates, policy.scheduled[0])
    assert sharper is not None
    assert identity.cost.value <= sharper.value + 5 * sharper.standard_error + 1e-9 * policy.cost_all_time
    assert sharper.value <= guarantee.cost * (1 + 1e-12)


def test_the_bound_holds_on_every_path() -> None:
    """A few systems."""
    over(lambda drawn: the_bound_holds_on_every_path(*drawn, steps=100_000), 3, drawn=designs())


@pytest.mark.evidence
def test_the_bound_holds_on_every_path_of_300_systems() -> None:
    """One to six states, one to four sensors and actuators, unstable plants and correlated noise included."""
    over(lambda drawn: the_bound_holds_on_every_path(*drawn, steps=scaled(250_000, 60_000)), 300, drawn=designs())


def two_masses() -> tuple[Plant, Cost, Network]:
    """Return two masses with a spring and a damper, each with a motor and a position sensor."""
    h = 0.3
    A = np.array([[0.0, 1, 0, 0], [-1, -0.05, 1, 0.05], [0, 0, 0, 1], [1, 0.05, -1, -0.05]])
    B = np.array([[0.0, 0], [1, 0], [0, 0], [0, 1]])
    exact = expm(h * np.block([[A, B], [np.zeros((2, 6))]]))
    C = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0]])
    W = h * np.diag([0.0, 0.1, 0.0, 0.1]) + 1e-6 * np.eye(4)
    plant = Plant(exact[:4, :4], exact[:4, 4:], W, C=C, V=np.diag([0.01, 0.02]))
    nodes = {f"sensor-{i + 1}": NodeRole(measures=(i,)) for i in range(2)}
    nodes |= {"controller": NodeRole(controls=True)} | {f"motor-{i + 1}": NodeRole(applies=(i,)) for i in range(2)}
    return plant, Cost(np.diag([1.0, 0.1, 1.0, 0.1]), 0.1 * np.eye(2)), Network(nodes=nodes)


REFERENCE = {
    (0.002, 0.002, 0.0, 0.0): (0.194397, 1e-6, (0.8909, 0.8768, 1.0, 1.0), 1e-4, 0.20224, 0.19517),
    (0.02, 0.02, 0.0, 0.0): (0.198796, 2e-6, (0.6734, 0.6346, 1.0, 1.0), 1e-4, 0.27424, 0.22190),
    (0.02, 0.02, 0.02, 0.02): (0.203507, 2e-6, (0.6752, 0.6362, 0.6213, 0.6146), 2e-4, 0.51424, 0.31033),
    (0.1, 0.1, 0.1, 0.1): (0.26742, 2e-5, (0.4287, 0.3709, 0.4103, 0.3973), 2e-4, 1.79424, 1.1511),
    (0.02, 0.005, 0.01, 0.04): (0.203876, 3e-6, (0.6733, 0.8098, 0.7186, 0.4941), 2e-4, 0.45652, 0.28848),
}
"""By δ of sensors and motors: cost and its error, rates and their error, bound, and bound at the rates."""


def with_thresholds(deltas: tuple[float, ...]) -> Loop:
    """Return the loop of two masses with a threshold for each link."""
    plant, cost, network = two_masses()
    roots = np.sqrt(deltas)
    shares: Mapping[str, float] = dict(zip(network.links, roots.tolist(), strict=True))
    policy = design.distributed(plant, cost, delta=float(roots.sum() ** 2), shares=dict(shares), network=network)
    return close(plant, policy)


@pytest.mark.parametrize("deltas", few(REFERENCE, 3))
def test_the_reference_of_two_masses(deltas: tuple[float, ...]) -> None:
    """Costs, rates and bounds of an independent simulation."""
    cost, error, rates, spread, bound, at_rates = REFERENCE[deltas]
    loop = with_thresholds(deltas)
    policy, found = loop.policy, average(loop, seed=3, steps=4_000_000)
    assert policy.cost_all_time == pytest.approx(0.194242572, abs=1e-9)
    assert abs(found.cost.value - cost) <= 4 * np.hypot(found.cost.standard_error, error) + 5e-7
    for rate, expected in zip(found.rates.values(), rates, strict=True):
        assert abs(rate.value - expected) <= 4 * np.hypot(rate.standard_error, spread) + 5e-5
    assert policy.guarantee is not None
    assert policy.guarantee.cost == pytest.approx(bound, abs=6e-6)
    sharper = policy.guarantee.at_rates(found.rates, policy.scheduled[0])
    assert sharper is not None
    assert sharper.value == pytest.approx(at_rates, abs=5e-5 + 4 * sharper.standard_error + 2 * spread)


def test_a_better_prediction_only_sends_less() -> None:
    """The same bound with a model of the measurements, at a lower rate of the sensors, as of joint decisions."""
    plant, cost, network = two_masses()
    rates: dict[str, float] = {}
    for name, more in {
        "hold": {},
        "model": {"prediction": "model", "actuation": "model"},
        "joint": {"joint": True},
    }.items():
        policy = design.distributed(plant, cost, theta=0.4, network=network, **more)
        rates[name] = sum(rate.value for rate in average(close(plant, policy), seed=1, steps=400_000).rates.values())
        assert policy.guarantee is not None
        assert policy.guarantee.cost == pytest.approx(1.4 * policy.cost_all_time)
    assert rates["model"] < rates["hold"]


@pytest.mark.evidence
def test_losses_that_are_acknowledged_keep_the_identity_and_no_bound() -> None:
    """The identity is the plain average; without acknowledgements there is neither identity nor bound."""
    plant, cost, network = two_masses()
    lossy = {link: LinkLaw(loss=0.3, acknowledged=True) for link in network.links}
    network = replace(network, links=lossy)
    loop = close(plant, design.distributed(plant, cost, delta=0.0, network=network))
    assert loop.nominal
    assert loop.policy.guarantee is None
    found, plain = (average(loop, of(loop), seed=2, steps=2_000_000) for of in (completed_squares, plain_average))
    error = np.hypot(found.cost.standard_error, plain.cost.standard_error)
    assert abs(found.cost.value - plain.cost.value) <= 4 * error
    deaf = replace(network, links=dict.fromkeys(network.links, LinkLaw(loss=0.3)))
    policy = design.distributed(plant, cost, delta=0.0, network=deaf)
    assert (policy.guarantee, policy.theory.identity) == (None, None)


@st.composite
def lossy_designs(draw: st.DrawFn) -> tuple[System, Network, dict[str, str]]:
    """Draw a system, a network of which some links drop packets, and how silence is predicted."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    system = make_system(seed, int(rng.integers(1, 3)), 2, 2, False)
    assume(well_posed(system.plant.A, system.plant.B) and well_posed(system.plant.A.T, system.plant.C.T))
    network = network_for(system.plant, rng)
    assume(network.links)
    laws = {link: random_law(rng) for link in network.links}
    modes = {name: str(rng.choice(["hold", "model"])) for name in ("prediction", "actuation")}
    return system, replace(network, links=laws), modes


def random_law(rng: np.random.Generator) -> LinkLaw:
    """Return a link that drops single packets, bursts, or nothing."""
    told = bool(rng.integers(2))
    if rng.integers(3) == 0:
        return LinkLaw(
            acknowledged=told,
            burst=Burst(to_bad=0.1, to_good=0.6, loss_good=0.0, loss_bad=float(rng.uniform(0.2, 0.9))),
        )
    return LinkLaw(loss=float(rng.choice([0.0, 0.05, 0.25])), acknowledged=told)


def j_all_is_that_of_an_attempt_on_every_link(system: System, network: Network, modes: dict[str, str]) -> None:
    """The exact J_all is the mean of the simulated stage cost if every link attempts in every step."""
    try:
        policy = design.distributed(system.plant, system.cost, delta=0.0, network=network, **modes)
    except UnstableError:
        assume(False)
    loop = close(system.plant, policy)
    found = outcomes(loop)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("taciturn.analyse.switched.MOST_MOMENTS", 1e6)
        assume(found is None or (found.F.shape[1] <= 12 and found.growth(2) < 0.8 and found.growth(4) < 0.9))
    simulated = average(loop, plain_average(loop), seed=system.seed, steps=scaled(200_000, 60_000)).cost
    assert abs(simulated.value - policy.cost_all_time) <= 5 * simulated.standard_error


@pytest.mark.evidence
def test_j_all_is_that_of_an_attempt_on_every_link() -> None:
    """A few systems."""
    over(lambda drawn: j_all_is_that_of_an_attempt_on_every_link(*drawn), 3, drawn=lossy_designs())


@pytest.mark.evidence
def test_j_all_of_100_systems_is_that_of_an_attempt() -> None:
    """Single losses and bursts, with and without acknowledgement, on any of the links."""
    over(lambda drawn: j_all_is_that_of_an_attempt_on_every_link(*drawn), 100, drawn=lossy_designs())


@pytest.mark.parametrize("seed", few(range(20), 1))
@pytest.mark.parametrize("burst", [None, Burst(to_bad=0.2, to_good=0.5, loss_good=0.0, loss_bad=0.8)])
@pytest.mark.parametrize("actuation", ["hold", "model"])
def test_the_costs_of_attempts_by_moments_and_by_values_agree(actuation: str, burst: Burst | None, seed: int) -> None:
    """Over one actuator link, the second moments of this kind give what the value of the base of excess gives."""
    system = make_system(seed, 3, 2, 2, False)
    law = LinkLaw(burst=burst, loss=0.0 if burst else 0.2, acknowledged=True)
    plc = NodeRole(measures=(0, 1), controls=True)
    network = Network(nodes={"plc": plc, "valves": NodeRole(applies=(0, 1))}, links={"valves": law})
    made = (design.distributed, design.excess)
    try:
        moments, values = (
            kind(system.plant, system.cost, theta=0.3, actuation=actuation, network=network) for kind in made
        )
    except UnstableError:  # in both ways
        for kind in made:
            with pytest.raises(UnstableError):
                kind(system.plant, system.cost, theta=0.3, actuation=actuation, network=network)
        return
    assert moments.cost_all_time == pytest.approx(values.cost_all_time, rel=1e-8)
    lossless = replace(network, links={"valves": LinkLaw()})
    least = design.distributed(system.plant, system.cost, theta=0.3, actuation=actuation, network=lossless)
    assert moments.cost_all_time > least.cost_all_time


def test_an_infinite_variance_of_the_cost_is_stated() -> None:
    """Losses of 55 % let the fourth moments of this unstable plant grow, with and without acknowledgement."""
    plant = Plant([[1.3, 0.1], [0, 1.1]], np.eye(2), 0.1 * np.eye(2), np.eye(2), 0.01 * np.eye(2))
    nodes = {"a": NodeRole(measures=[0]), "b": NodeRole(measures=[1]), "c": NodeRole(controls=True)}
    for told in (True, False):
        links = {"a": LinkLaw(loss=0.55, acknowledged=told)}
        network = Network(nodes=nodes | {"d": NodeRole(applies=True)}, links=links)
        policy = design.distributed(plant, Cost(np.eye(2), 0.1 * np.eye(2)), theta=0.2, network=network)
        found = average(close(plant, policy), steps=20_000)
        assert not found.trusted
        assert "the variance of the cost is infinite: an outage of the a link" in found.notes[0]


def test_many_links_that_drop_packets_have_too_many_outcomes() -> None:
    """With seven such links, J_all is the cost without losses, and a note says so."""
    plant = Plant(0.5 * np.eye(7), np.eye(7), np.eye(7))
    nodes = {"plc": NodeRole(measures=tuple(range(7)), controls=True)}
    nodes |= {f"valve-{i}": NodeRole(applies=(i,)) for i in range(7)}
    found = {
        loss: design.distributed(
            plant, Cost(np.eye(7), np.eye(7)), theta=0.1, network=Network(nodes=nodes).with_laws({"loss": loss})
        )
        for loss in (0.0, 0.1)
    }
    assert found[0.1].cost_all_time == found[0.0].cost_all_time
    assert "J_all is the cost without losses" in found[0.1].notes[0]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, "neither delta nor theta is given"),
        ({"delta": 1.0, "theta": 1.0}, r"delta \(1\) and theta \(1\) are both given"),
        ({"theta": -1.0}, "theta is -1; expected 0 ≤ theta"),
        (
            {"theta": 0.1, "shares": {"motor": 1.0}},
            "shares.motor is 1.0, but the policy makes no send decisions on this link; expected shares only",
        ),
        ({"theta": 0.1, "shares": [1, 2]}, r"^shares = \[1, 2\]; expected one number for each link, such as"),
        ({"theta": 0.1, "shares": dict.fromkeys(two_masses()[2].links, 0.0)}, "shares = 0 for all links"),
        ({"theta": 0.1, "joint": 1}, "joint is 1; expected true or false"),
        ({"theta": 0.1, "prediction": "zero"}, "prediction is 'zero'; expected one of the words 'hold', 'model'"),
        ({"theta": 0.1, "network": Network(delay=1)}, "network.delay is 1; expected a delay of 0 steps"),
        ({"theta": 0.1, "network": Network(nodes={"plc": NodeRole(True, True, True)})}, "no link decides"),
        (
            {
                "theta": 0.1,
                "network": Network(nodes={"plc": NodeRole((0,), False, True), "pumps": NodeRole(applies=True)}),
            },
            "the plant's output with the index 1 belongs to no node; expected exactly one node that measures it",
        ),
    ],
)
def test_bad_arguments_are_refused(given: dict[str, object], expected: str) -> None:
    """In one sentence."""
    plant, cost, network = two_masses()
    arguments: dict[str, object] = {"network": network, **given}
    with pytest.raises(ProblemError, match=expected):
        design.distributed(plant, cost, **arguments)  # type: ignore[arg-type]


def test_an_outage_of_one_sensor_is_no_reason_if_another_one_shows_the_growing_mode() -> None:
    """The duct temperature moves the room temperature, which grows and is measured: losses of the duct are survived."""
    plant = Plant([[1.03, 0.08], [0.0, 0.85]], [[0.0], [0.3]], np.diag([0.01, 0.02]), np.eye(2), 0.01 * np.eye(2))
    cost = Cost(np.diag([1.0, 0.05]), [[0.1]])
    nodes = {
        "room": NodeRole(measures=(0,)),
        "duct": NodeRole(measures=(1,)),
        "plc": NodeRole(controls=True),
        "valve": NodeRole(applies=(0,)),
    }

    def found(**losses: float) -> Estimate:
        links = {name: LinkLaw(losses.get(name, 0.1), acknowledged=True) for name in ("room", "duct", "valve")}
        policy = design.distributed(plant, cost, theta=0.0, network=Network(nodes=nodes, links=links))
        return evaluate(policy, steps=200_000).cost

    policy_cost = found(duct=0.97)
    assert 0 < policy_cost.value < 2
    for link in ("room", "valve"):
        with pytest.raises(UnstableError, match=f"an outage of the {link} link|the mean square of the state"):
            found(**{link: 0.97})
