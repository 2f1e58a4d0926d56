"""Several sensors that send by the predicted variances of their outputs: schedule, cost and rates."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from drawn import law
from hypothesis import assume
from hypothesis import strategies as st
from measured import average
from scipy.linalg import block_diag, solve_discrete_are
from systems import System, make_system, well_posed

import taciturn
from taciturn import Cost, Network, Plant, Policy, Problem, ProblemError, UnstableError, close, design, simulate
from taciturn.design.kind import placed
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.model.link import LinkLaw
from taciturn.model.network import NodeRole
from taciturn.model.packets import fingerprint
from taciturn.simulation.average import plain_average
from taciturn.study.record import decode, encode

SHAPES = ((2, 1, 2), (3, 2, 3), (4, 2, 4))  # states, inputs, outputs
Owners = Mapping[str, tuple[int, ...]]
TANK = taciturn.load("quadruple-tank").changed(
    {"kind": "variance", "theta": None, "prediction": None, "actuation": None, "threshold": 0.12}
    | {"nodes.pump-1.site": "plc", "nodes.pump-2.site": "plc"}
)


def sensors(owners: Owners, here: tuple[str, ...] = (), inputs: tuple[str, ...] = ("pump",)) -> Network:
    """Return sensors with links, except for those at the controller's place, where all inputs are applied."""
    nodes = {name: NodeRole(measures=rows, site="plc" if name in here else None) for name, rows in owners.items()}
    nodes |= {"plc": NodeRole(controls=True)} | {name: NodeRole(applies=True, site="plc") for name in inputs}
    return Network(nodes=nodes)


@st.composite
def designs(draw: st.DrawFn) -> tuple[System, Network, float]:
    """Draw a system, two or three sensors that share its outputs, one of them perhaps local, and a threshold."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    system = make_system(seed, *SHAPES[rng.integers(len(SHAPES))], False)
    plant = system.plant
    assume(well_posed(plant.A, plant.B) and well_posed(plant.A.T, plant.C.T))
    order, count = rng.permutation(plant.outputs).tolist(), int(rng.integers(2, min(plant.outputs, 3) + 1))
    owners = {f"s{k}": tuple(order[k::count]) for k in range(count)}
    network = sensors(owners, ("s0",) if rng.integers(3) == 0 else ())
    prior = solve_discrete_are(plant.A.T, plant.C.T, plant.W, plant.V)
    return system, network, float(rng.uniform(0.8, 4.0) * np.median(np.diag(plant.C @ prior @ plant.C.T)))


def followed(problem: Discrete, network: Network, threshold: float, steps: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return who sends in so many steps, by link, and the covariances of the estimate, in the information form."""
    plant, Sigma, sent, posterior = problem.plant, None, [], []
    Sigma = solve_discrete_are(plant.A.T, plant.C.T, plant.W, plant.V)
    for _ in range(steps):
        variances, read, asked = np.diag(plant.C @ Sigma @ plant.C.T), [], []
        for _, (node, rows) in network.measurements(plant.outputs).items():
            sends = any(variances[row] > threshold for row in rows)
            asked += [sends] if node in network.links else []
            read += list(rows) if sends or node not in network.links else []
        C, V = plant.C[read], plant.V[np.ix_(read, read)]
        Sigma = np.linalg.inv(np.linalg.inv(Sigma) + C.T @ np.linalg.inv(V) @ C)
        sent.append(asked)
        posterior.append(Sigma)
        Sigma = plant.A @ Sigma @ plant.A.T + plant.W
    return np.array(sent), posterior


def cost_of(problem: Discrete, posterior: list[np.ndarray]) -> float:
    """Return E[x'Qx + 2x'Nu + u'Ru] with u = Lx̂ for covariances that repeat, by the covariance of x̂ in steady state."""
    plant, Q, R, N = problem.plant, problem.Q, problem.R, problem.N
    K = solve_discrete_are(plant.A, plant.B, Q, R, s=N)
    L = -np.linalg.solve(R + plant.B.T @ K @ plant.B, plant.B.T @ K @ plant.A + N.T)
    closed, X, costs = plant.A + plant.B @ L, np.zeros_like(K), list[float]()
    turns = int(np.ceil(40 / -np.log(np.abs(np.linalg.eigvals(closed)).max()) / len(posterior))) + 1
    for turn in range(turns):
        for k, Sigma in enumerate(posterior):
            before = plant.A @ posterior[k - 1] @ plant.A.T + plant.W
            X = closed @ X @ closed.T + before - Sigma  # the corrections are white
            if turn == turns - 1:
                costs.append(np.sum(Q * (X + Sigma)) + 2 * np.sum(N * (X @ L.T)) + np.sum(R * (L @ X @ L.T)))
    return float(np.mean(costs))


def designed(system: System, network: Network, threshold: float) -> Policy:
    """Return the policy if its cycle is short enough for a test."""
    policy = design.variance(system.plant, system.cost, threshold=threshold, network=network)
    assert policy.schedule is not None
    assume(policy.schedule.period < 400)
    return policy


@law(8, 100, drawn=designs())
def test_schedule_and_cost_are_those_of_the_information_filter(drawn: tuple[System, Network, float]) -> None:
    """Written anew: the rows of C and the block of V of the outputs that are read, and the loop's covariances."""
    system, network, threshold = drawn
    policy = designed(system, network, threshold)
    schedule, closed = policy.schedule, policy.theory.closed_form
    assert schedule is not None
    assert closed is not None
    assert set(schedule.links) == set(policy.scheduled) == set(network.links)
    problem, period = discretise(system.plant, system.cost, None), schedule.period
    margin = np.abs(schedule.value / threshold - 1).min()
    assume(margin > 1e-6)  # nothing is decided by a rounding error
    sent, posterior = followed(problem, network, threshold, 3000 + 2 * period)
    queries = schedule.queries.reshape(period, -1)
    turns = [shift for shift in range(period) if (sent[3000 + shift :][:period] == queries).all()]
    assert turns, "another schedule"
    assert all(sent[-period:, k].mean() == closed.rates[link] for k, link in enumerate(schedule.links))
    assert closed.cost == pytest.approx(cost_of(problem, posterior[-period:]), rel=1e-6)


@law(5, 100, drawn=designs())
def test_the_exact_cost_and_rates_are_those_of_a_simulation(drawn: tuple[System, Network, float]) -> None:
    """A plain average within four standard errors, and every packet of a trajectory at the steps of the schedule."""
    system, network, threshold = drawn
    policy = designed(system, network, threshold)
    schedule, closed = policy.schedule, policy.theory.closed_form
    assert schedule is not None
    assert closed is not None
    loop = close(system.plant, policy, cost=system.cost)
    assert loop.nominal
    found = average(loop, plain_average(loop), seed=system.seed, steps=400_000)
    assert abs(found.cost.value - closed.cost) <= 4 * found.cost.standard_error
    for link, rate in found.rates.items():
        assert rate.value == pytest.approx(closed.rates[link], abs=4 * rate.standard_error + 1e-3)
    shown = simulate(loop, 2 * schedule.period)
    for link, one in schedule.by_link.items():
        assert (shown.sends[link] == np.tile(one.queries, 2)).all()


def test_sensors_of_separate_plants_decide_as_if_alone() -> None:
    """Each has the rate of a policy of its own, and the costs add."""
    one = Plant([[1.1]], [[1.0]], [[0.5]], [[1.0]], [[0.2]])
    other = Plant([[0.9, 0.3], [0.0, 1.0]], [[0.0], [1.0]], 0.1 * np.eye(2), [[1.0, 0.0]], [[0.1]])
    costs, alone = [Cost([[1.0]], [[0.5]]), Cost(np.eye(2), [[1.0]])], list[tuple[float, float]]()
    for plant, cost in zip((one, other), costs, strict=True):
        closed = design.variance(plant, cost, threshold=2.0).theory.closed_form
        assert closed is not None
        alone.append((closed.cost, closed.rates["sensor"]))
    both = [block_diag(getattr(one, name), getattr(other, name)) for name in "ABWCV"]
    joint = Cost(block_diag(costs[0].Q, costs[1].Q), block_diag(costs[0].R, costs[1].R))
    network = sensors({"first": (0,), "second": (1,)})
    closed = design.variance(Plant(*both), joint, threshold=2.0, network=network).theory.closed_form
    assert closed is not None
    assert closed.cost == pytest.approx(alone[0][0] + alone[1][0], rel=1e-9)
    assert list(closed.rates.values()) == [rate for _, rate in alone]
    assert alone[0][1] != alone[1][1]


def test_the_ends_of_the_threshold() -> None:
    """At 0 every sensor sends every sample; at a large threshold, the outputs at the controller remain."""
    system = make_system(12, 3, 2, 2, False)
    plant = Plant(0.9 * system.plant.A / np.abs(np.linalg.eigvals(system.plant.A)).max(), *(
        getattr(system.plant, name) for name in "BWCV"
    ))  # fmt: skip
    network = sensors({"far": (0,), "near": (1,)}, ("near",))
    every = design.variance(plant, system.cost, threshold=0.0, network=network)
    assert every.theory.closed_form is not None
    assert every.theory.closed_form.rates == {"far": 1.0}
    assert every.theory.closed_form.cost == pytest.approx(every.cost_all_time, rel=1e-9)
    never = design.variance(plant, system.cost, threshold=1e6, network=network)
    only = Plant(plant.A, plant.B, plant.W, plant.C[1:], plant.V[1:, 1:])
    assert never.theory.closed_form is not None
    assert never.theory.closed_form.rates == {"far": 0.0}
    assert never.theory.closed_form.cost == pytest.approx(design.lqg(only, system.cost, theta=0.1).cost_all_time)


@pytest.mark.parametrize("rows", [(0, 1), (1, 0)])
def test_one_sensor_with_names_of_its_own_is_the_one_of_three_nodes(rows: tuple[int, ...]) -> None:
    """The same steps under other names, to the last bit, and the link of the schedule has the name of the sensor."""
    system = make_system(3, 3, 2, 2, False)
    network = sensors({"level": rows})
    direct = design.variance(system.plant, system.cost, threshold=0.5, network=network)
    renamed = placed(design.variance(system.plant, system.cost, threshold=0.5), network)
    assert fingerprint(direct, network) == fingerprint(renamed, network)
    assert direct.theory.closed_form == renamed.theory.closed_form
    assert direct.theory.fixed_rates == renamed.theory.fixed_rates
    assert direct.schedule is not None
    assert renamed.schedule is not None
    assert direct.schedule.links == renamed.schedule.links == ("level",)


@pytest.mark.evidence
def test_sampled_tanks_have_an_exact_cost_and_a_schedule_by_link(tmp_path) -> None:
    """A continuous plant with a period; each link is named in the text, the document, the table and the figure."""
    policy, found = TANK.design(), taciturn.evaluate(TANK)
    schedule = policy.schedule
    assert schedule is not None
    problem = discretise(TANK.plant, TANK.cost, policy.tick)
    sent, posterior = followed(problem, policy.network, 0.12, 600)
    assert found.method == "exact"
    assert found.cost.value == pytest.approx(
        problem.per_unit(cost_of(problem, posterior[-schedule.period :])), rel=1e-7
    )
    rates = {link: sent[-schedule.period :, k].mean() for k, link in enumerate(schedule.links)}
    assert schedule.rates == rates
    assert {link: rate.value * policy.tick for link, rate in found.rates.items()} == pytest.approx(rates)
    assert "queries, level-1" in str(found)
    assert "queries, level-2" in str(found)
    assert decode(encode(found)).schedule.document() == schedule.document()
    document = found.document()["schedule"]
    assert document["queries"] == {link: np.flatnonzero(schedule.by_link[link].queries).tolist() for link in rates}
    assert document["rate"] == rates
    assert np.array(document["value"]["level-2"]) == pytest.approx(schedule.value[:, 1])
    assert list(schedule.columns())[:5] == ["tick", "value_level-1", "query_level-1", "value_level-2", "query_level-2"]
    schedule.plot().savefig(tmp_path / "schedule.svg")
    lanes = schedule.plot().axes[-1]
    assert [label.get_text() for label in lanes.get_yticklabels()] == ["query of level-1", "query of level-2"]
    for ask in (lambda: schedule.rate, lambda: schedule.ticks):
        with pytest.raises(
            ProblemError,
            match="the schedule has the links level-1, level-2; expected a schedule with one link: for",
        ):
            ask()


@pytest.mark.evidence
def test_a_budget_on_the_traffic_or_on_one_link_is_met() -> None:
    """The threshold is the only parameter of all links."""
    by_traffic, by_link = taciturn.tune(TANK, traffic=0.2), taciturn.tune(TANK, rate=0.11, link="level-2")
    assert by_traffic.evaluation.traffic is not None
    assert by_traffic.evaluation.traffic.value <= 0.2
    assert by_link.evaluation.rates["level-2"].value <= 0.11
    with pytest.raises(
        ProblemError,
        match="a rate is given without a link; expected one of the links level-1",
    ):
        taciturn.tune(TANK, rate=0.11)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"nodes.pump-2.site": None},
            "the actuator of the policy kind variance is at the controller's site, but the node 'pump-2' has a link; "
            'expected nodes.pump-2.site = "plc", or the kind distributed',
        ),
        (
            {"nodes.level-1.site": "plc", "nodes.level-2.site": "plc", "links": None},
            "the policy kind variance uses a link between sensor and controller, but the node 'level-1' is at the "
            "controller's site",
        ),
        ({"links.level-1.loss": 0.1}, "links.level-1.loss is given, which the policy kind variance does not use"),
    ],
)
def test_networks_for_which_the_schedule_is_not_exact_are_refused(changes: dict[str, object], sentence: str) -> None:
    """In a sentence that names the node or the key."""
    with pytest.raises(ProblemError, match=sentence):
        TANK.changed(changes).design()


def test_other_mistakes_are_refused() -> None:
    """Losses without a problem file, a kind with one sensor, and unstable plants of which no sensor is ever queried."""
    one, network = np.eye(2), sensors({"a": (0,), "b": (1,)})
    lossy = Network(nodes=network.nodes, links={"a": LinkLaw(loss=0.1)})
    plant, cost = Plant(1.2 * one, one, 0 * one), Cost(one, one)
    with pytest.raises(ProblemError, match=r"links\.a\.loss is given, which the policy kind variance does not use"):
        design.variance(plant, cost, threshold=1.0, network=lossy)
    with pytest.raises(ProblemError, match="expected a single sensor node in place of these"):
        Problem(plant, cost, network, "remote-lqg", {"theta": 0.1, "zeta": 1.0}).design()
    with pytest.raises(UnstableError, match="never queried"):
        design.variance(plant, cost, threshold=1.0, network=network)
    with pytest.raises(UnstableError, match="does not decay along the schedule"):
        design.variance(plant, cost, threshold=1.0, network=sensors({"a": (0,), "b": (1,)}, ("b",)))
