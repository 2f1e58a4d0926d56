"""Dead bands on any links with any controller: a certificate of every path, against a simulation in NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Any, cast

import numpy as np
import pytest
from counts import few
from drawn import law
from hypothesis import strategies as st
from measured import average, times

import taciturn
from taciturn import ContinuousPlant, Controller, Cost, Disturbance, Plant, ProblemError, close, design
from taciturn.base.certainty import CertaintyEquivalentDesign, design_certainty
from taciturn.design.around_controller import FilteredSteps
from taciturn.errors import UnstableError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.gain import largest_gain
from taciturn.model.disturbance import follow
from taciturn.model.link import LinkLaw
from taciturn.model.network import Network, NodeRole
from taciturn.model.policy import Policy
from taciturn.model.signals import ExternalDisturbance

NODES = {
    "s1": NodeRole(measures=(0,)),
    "s2": NodeRole(measures=(1,)),
    "plc": NodeRole(controls=True),
    "v1": NodeRole(applies=(0,)),
    "v2": NodeRole(applies=(1,)),
}
PID_PLANT = Plant([[1, 0.1], [0, 0.9]], [[0], [0.1]], np.diag([1e-4, 4e-4]), [[1.0, 0]], [[1e-3]], dt=0.1)
PID_COST = Cost(np.diag([1.0, 0]), [[0.05]])
PID = Controller(
    [[1, 0], [0, 0.8]], [[0.1], [0.2]], [[-0.15, 2.0]], [[-3.2]], dt=0.1, disturbance=Disturbance(deviation=0.0)
)


@dataclass(frozen=True)
class Simulation:
    """Paths of a loop with dead bands, and of the same loop with every sample and the same noise."""

    plant: Plant
    cost: Cost
    controller: Controller
    bands: np.ndarray  # of the outputs, then of the inputs
    outputs: int

    def run(self, paths: int, steps: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the costs with dead bands and with every sample, the mean squares of the errors, and the rates."""
        plant, c, p = self.plant, self.controller, self.outputs
        draws = np.random.default_rng(seed)
        W, V = np.linalg.cholesky(plant.W), np.linalg.cholesky(plant.V)
        xs, registers = np.zeros((2, plant.states, paths)), np.zeros((2, len(c.A), paths))
        last = np.zeros((p + plant.inputs, paths))
        costs, squares, sends = np.zeros((2, paths)), np.zeros_like(last), np.zeros_like(last)
        for _ in range(steps):
            v, w = V @ draws.standard_normal((p, paths)), W @ draws.standard_normal((plant.states, paths))
            for k, always in enumerate((False, True)):
                y = plant.C @ xs[k] + v
                used = y if always else self._used(y, last[:p], squares[:p], sends[:p], self.bands[:p, None])
                u = c.C @ registers[k] + c.D @ used
                if not always:
                    u = self._used(u, last[p:], squares[p:], sends[p:], self.bands[p:, None])
                registers[k] = c.A @ registers[k] + c.B @ used + c.E @ u
                costs[k] += np.einsum("ip,ij,jp->p", xs[k], self.cost.Q, xs[k])
                costs[k] += np.einsum("ip,ij,jp->p", u, self.cost.R, u)
                costs[k] += 2 * np.einsum("ip,ij,jp->p", xs[k], self.cost.N, u)
                xs[k] = plant.A @ xs[k] + plant.B @ u + w
        return costs[0] / steps, costs[1] / steps, squares / steps, sends / steps

    @staticmethod
    def _used(
        value: np.ndarray, last: np.ndarray, squares: np.ndarray, sends: np.ndarray, bands: np.ndarray
    ) -> np.ndarray:
        sent = np.abs(value - last) > bands
        last[:] = np.where(sent, value, last)
        squares += (last - value) ** 2
        sends += sent
        return last.copy()


class Levels(Simulation):
    """The same with levels of the values, multiples of the dead band."""

    @staticmethod
    def _used(
        value: np.ndarray, last: np.ndarray, squares: np.ndarray, sends: np.ndarray, bands: np.ndarray
    ) -> np.ndarray:
        moved, unit = value - last, np.where(bands > 0, bands, 1.0)
        crossed = np.where(bands > 0, np.sign(moved) * bands * np.floor(np.abs(moved) / unit), moved)
        sent = np.abs(moved) > bands
        last += sent * crossed
        assert (np.abs(last - value) <= bands * (1 + 1e-9) + 1e-12).all()
        squares += (last - value) ** 2
        sends += sent
        return last.copy()


def bound_of(base: np.ndarray, policy: Policy, squares: np.ndarray) -> np.ndarray:
    """Return the bound of each path from the root mean squares of its errors, one entry on each link."""
    gains = [one.gain for one in policy.theory.errors.values()]
    return (np.sqrt(base) + np.array(gains) @ np.sqrt(squares)) ** 2


@law(3, 60, seed=st.integers(0, 10**6), size=st.floats(0.05, 1.5), kept=st.booleans())
def test_no_path_costs_more_than_its_certificate(seed: int, size: float, kept: bool) -> None:
    """Random systems, unstable ones and cross terms included, with LQG or a detuned controller, four deciding links."""
    draws = np.random.default_rng(seed)
    A = draws.standard_normal((2, 2))
    A *= draws.uniform(0.5, 1.15) / np.abs(np.linalg.eigvals(A)).max()
    L = draws.standard_normal((4, 4))
    weights = L @ L.T + 0.1 * np.eye(4)
    plant = Plant(
        A, np.eye(2) + 0.3 * draws.standard_normal((2, 2)), np.diag([0.1, 0.2]), np.eye(2), np.diag([0.1] * 2)
    )
    cost = Cost(weights[:2, :2], weights[2:, 2:], weights[:2, 2:])
    shares = {"s1": 1.0, "s2": 0.5, "v1": 2.0, "v2": 1.0}
    bands = size * np.array([*shares.values()])
    network = Network(nodes=NODES)
    certainty = lqg_of(plant, cost)
    controller = FilteredSteps(plant, certainty.filter.gain, 0.95 * certainty.regulator.L).controller
    if kept:
        policy = design.send_on_delta(plant, cost, delta=size, controller=controller, network=network, shares=shares)
    else:
        policy = design.send_on_delta(plant, cost, delta=size, network=network, shares=shares)
        noisy = Plant(A, plant.B, plant.W, plant.C, plant.V + np.diag(np.square(bands[:2])) / 3)
        gain = lqg_of(noisy, cost).filter.gain
        controller = FilteredSteps(plant, gain, certainty.regulator.L).controller
    found, base, squares, rates = Simulation(plant, cost, controller, bands, 2).run(40, 800 * times(), seed)
    assert (found <= bound_of(base, policy, squares) * (1 + 1e-9)).all()
    assert policy.guarantee is not None
    simulated = average(close(plant, policy), steps=200_000, seed=seed)
    assert simulated.cost.value - 4 * simulated.cost.standard_error <= policy.guarantee.cost
    if not simulated.settled:  # such as one of two limit cycles for thousands of steps: a note says so
        assert simulated.notes
        return
    late = found.std(ddof=1) / sqrt(40)
    assert abs(found.mean() - simulated.cost.value) <= 5 * np.hypot(late, simulated.cost.standard_error) + 0.02 * late
    for link, rate in zip(policy.theory.errors, rates, strict=True):
        other = simulated.rates[link]
        error = np.hypot(rate.std(ddof=1) / sqrt(40), other.standard_error)
        assert abs(rate.mean() - other.value) <= 5 * error + 2 / 800, link


@law(1, 60, seed=st.integers(0, 10**6), size=st.floats(0.05, 3.0))
def test_no_path_with_levels_costs_more_than_its_certificate(seed: int, size: float) -> None:
    """Random systems, unstable ones and cross terms included; the level is at most Δ away from the output."""
    draws = np.random.default_rng(seed)
    A = draws.standard_normal((2, 2))
    A *= draws.uniform(0.5, 1.1) / np.abs(np.linalg.eigvals(A)).max()
    L = draws.standard_normal((3, 3))
    weights = L @ L.T + 0.1 * np.eye(3)
    plant = Plant(A, draws.standard_normal((2, 1)), np.diag([0.1, 0.2]), draws.standard_normal((1, 2)), [[0.1]])
    cost = Cost(weights[:2, :2], weights[2:, 2:], weights[:2, 2:])
    certainty = lqg_of(plant, cost)
    controller = FilteredSteps(plant, certainty.filter.gain, certainty.regulator.L).controller
    policy = design.symmetric_send_on_delta(plant, cost, delta=size, controller=controller)
    found, base, squares, rates = Levels(plant, cost, controller, np.array([size, 0.0]), 1).run(40, 800 * times(), seed)
    assert (found <= bound_of(base, policy, squares[:1]) * (1 + 1e-9)).all()
    assert policy.guarantee is not None
    assert policy.theory.errors["sensor"].largest == size
    simulated = average(close(plant, policy), steps=100_000, seed=seed)
    assert simulated.cost.value - 4 * simulated.cost.standard_error <= policy.guarantee.cost
    error = np.hypot(rates[0].std(ddof=1) / sqrt(40), simulated.rates["sensor"].standard_error)
    assert abs(rates[0].mean() - simulated.rates["sensor"].value) <= 5 * error + 2 / 800


def test_levels_have_a_certificate_of_the_linear_loop_only() -> None:
    """The gain is that of send-on-delta; limited inputs have none, and neither have the event-based PID controllers."""
    pid = taciturn.PID(kp=1.2, ki=0.15, kd=1.0, filter=0.5, disturbance=Disturbance(deviation=0.0))
    levels = design.symmetric_send_on_delta(PID_PLANT, PID_COST, delta=0.04, controller=pid)
    bands = design.send_on_delta(PID_PLANT, PID_COST, delta=0.04, controller=pid)
    assert levels.theory.errors == bands.theory.errors
    assert levels.guarantee == bands.guarantee
    assert taciturn.certify(levels).errors_bound == levels.guarantee.cost  # type: ignore[union-attr]
    limited = Plant(PID_PLANT.A, PID_PLANT.B, PID_PLANT.W, PID_PLANT.C, PID_PLANT.V, dt=0.1, input_limit=[1.0])
    assert design.symmetric_send_on_delta(limited, PID_COST, delta=0.04, controller=pid).guarantee is None
    assert design.event_pid(PID_PLANT, PID_COST, delta=0.04, controller=pid).guarantee is None
    assert design.event_pid_saturated(PID_PLANT, PID_COST, delta=0.04, controller=pid).guarantee is None


def lqg_of(plant: Plant, cost: Cost) -> CertaintyEquivalentDesign:
    """Return LQG with every sample."""
    return design_certainty("lqg", discretise(plant, cost, None))


@pytest.mark.evidence
def test_the_pid_has_the_gains_of_the_reference() -> None:
    """Gains 1.15487 and .87857, bounds 3.55 and 12.7 times the cost of every sample; at the measured errors 1.90."""
    nodes = {"s": NodeRole(measures=True), "c": NodeRole(controls=True), "a": NodeRole(applies=True)}
    network = Network(nodes=nodes)
    both = design.send_on_delta(PID_PLANT, PID_COST, delta=0.04, controller=PID, network=network, shares={"a": 2.5})
    assert both.cost_all_time == pytest.approx(0.0027270602626, rel=1e-9)
    assert both.theory.errors["s"].gain == pytest.approx(1.15487, abs=1e-5)
    assert both.theory.errors["a"].gain == pytest.approx(0.87857, abs=5e-5)
    one = design.send_on_delta(PID_PLANT, PID_COST, delta=0.04, controller=PID)
    ratios = [policy.guarantee.cost / policy.cost_all_time for policy in (one, both) if policy.guarantee]
    assert ratios == [pytest.approx(3.55, abs=0.005), pytest.approx(12.7, abs=0.05)]
    found, _, squares, rates = Simulation(PID_PLANT, PID_COST, PID, np.array([0.04, 0.0]), 1).run(200, 6000, 0)
    assert rates[0].mean() == pytest.approx(0.393, abs=0.002)
    assert found.mean() / one.cost_all_time == pytest.approx(1.027, abs=0.01)
    rms = (sqrt(one.cost_all_time) + one.theory.errors["sensor"].gain * np.sqrt(squares[0].mean())) ** 2
    assert rms / one.cost_all_time == pytest.approx(1.90, abs=0.01)


@pytest.mark.parametrize("seed", few(range(60), 12))
def test_the_largest_gain_is_that_of_the_worst_frequency(seed: int) -> None:
    """Against a dense grid of frequencies around each mode, in any units of the states, with slow modes."""
    draws = np.random.default_rng(seed)
    n, m, p = draws.integers(1, 8), draws.integers(1, 4), draws.integers(1, 4)
    A = draws.standard_normal((n, n))
    A *= draws.uniform(0.3, 0.9999) / np.abs(np.linalg.eigvals(A)).max()
    B, C = draws.standard_normal((n, m)), draws.standard_normal((p, n))
    D = draws.standard_normal((p, m)) * draws.choice([0, 1, 5])
    T = 10.0 ** draws.uniform(-4, 4, n)
    found = largest_gain(A / T[:, None] * T, B / T[:, None], C * T, D)
    near = np.concatenate([-np.logspace(-8, -1, 200), [0.0], np.logspace(-8, -1, 200)])
    angles = np.concatenate([np.linspace(0, np.pi, 2001), np.add.outer(np.angle(np.linalg.eigvals(A)), near).ravel()])
    responses = C @ np.linalg.solve(np.exp(1j * angles)[:, None, None] * np.eye(n) - A, B) + D
    least = np.linalg.norm(responses, 2, axis=(1, 2)).max()
    assert least * (1 - 1e-12) <= found <= least * (1 + 1e-3)


def test_modes_without_cost_do_not_count() -> None:
    """An integrator that the cost does not contain leaves the gain as it is; one that it contains has none."""
    A, B = np.diag([0.5, 1.0]), np.ones((2, 1))
    assert largest_gain(A, B, np.array([[1.0, 0.0]]), np.zeros((1, 1))) == pytest.approx(2.0, rel=1e-6)
    assert largest_gain(A, np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), np.full((1, 1), 3.0)) == 3.0
    with pytest.raises(UnstableError, match="has a mode of modulus 1 that affects the cost"):
        largest_gain(A, B, np.ones((1, 2)), np.zeros((1, 1)))


def test_a_sampled_plant_has_the_certificate_per_second() -> None:
    """The inter-sample noise cost is no part of the errors; without dead bands the bound is that cost itself."""
    plant = ContinuousPlant([[0.5]], [[1.0]], [[0.2]], C=[[1.0]], V=[[0.01]])
    cost = Cost([[1.0]], [[0.1]])
    exact = design.send_on_delta(plant, cost, delta=0.0, period=0.2)
    assert exact.guarantee is not None
    assert exact.guarantee.cost == pytest.approx(exact.cost_all_time, rel=1e-9)
    policy = design.send_on_delta(plant, cost, delta=0.3, period=0.2)
    found = taciturn.average(close(plant, policy), steps=400_000)
    assert policy.guarantee is not None
    assert found.cost.value <= policy.guarantee.cost


def test_certify_shows_the_gains_of_several_links() -> None:
    """In the text and in the document, also where matrix inequalities do not apply; not for another loop."""
    network = Network(nodes=NODES)
    plant = Plant(0.9 * np.eye(2), np.eye(2), np.eye(2), np.eye(2), np.eye(2))
    policy = design.send_on_delta(plant, Cost(np.eye(2), np.eye(2)), delta=0.5, network=network)
    found = taciturn.certify(policy)
    assert list(found.document()["errors"]) == ["s1", "s2", "v1", "v2"]
    assert found.errors_bound == policy.guarantee.cost  # type: ignore[union-attr]
    assert "conservative" in str(found)
    assert found.notes[0].startswith(
        "only the gains from errors are available: the policy send-on-delta makes 4 send decisions"
    )
    with pytest.raises(ProblemError, match="makes 4 send decisions"):
        taciturn.certify(design.distributed(plant, Cost(np.eye(2), np.eye(2)), theta=0.1, network=network))


SHAPES: dict[str, dict[str, Any]] = {
    "constant": {}, "ramp": {}, "sinusoid": {"frequency": 0.3}, "slow sinusoid": {"frequency": 1e-3},
    "matrix": {"matrix": [[0.0, 1.0], [-1.0, 0.0]]},
}  # fmt: skip


@pytest.mark.parametrize("wander", [1e-3, 1e-8])
@pytest.mark.parametrize("shape", SHAPES)
def test_with_a_vanishing_threshold_the_base_is_lqg_in_spite_of_any_disturbance(shape: str, wander: float) -> None:
    """Disturbances never decay, and what they cost does: J_b is the cost with every sample."""
    push = ExternalDisturbance([0.0, 1.0], wander, shape.split()[-1], **SHAPES[shape])  # type: ignore[arg-type]
    plant = Plant([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]], 0.01 * np.eye(2), [[1.0, 0.0]], [[0.01]])
    policy = design.send_on_delta(follow(plant, disturbances=push), Cost(np.diag([1.0, 0.0]), [[0.1]]), delta=1e-9)
    assert policy.guarantee is not None
    assert policy.guarantee.cost == pytest.approx(policy.cost_all_time, rel=1e-6)


def test_what_dead_bands_cannot_have_is_refused() -> None:
    """A link beside named nodes, shares with one link, a set-point on several links."""
    network = Network(nodes=NODES)
    plant = Plant(0.9 * np.eye(2), np.eye(2), np.eye(2), np.eye(2), np.eye(2))
    cost = Cost(np.eye(2), np.eye(2))
    with pytest.raises(ProblemError, match="link = 'actuator' is given for a network with named nodes"):
        design.send_on_delta(plant, cost, delta=0.1, link="actuator", network=network)
    with pytest.raises(ProblemError, match="shares is given with a controller or a link"):
        design.send_on_delta(plant, cost, delta=0.1, controller=-0.5 * np.eye(2), shares={"sensor": 2.0})
    moved = Controller(np.eye(2), 0.1 * np.eye(2), -np.eye(2), -0.5 * np.eye(2), setpoint=[1.0, 0.0])
    with pytest.raises(ProblemError, match="the policy sends packets on 4 links, but the controller has a set-point"):
        design.send_on_delta(plant, cost, delta=0.1, controller=moved, network=network)


def test_policies_of_several_nodes_are_studied_without_a_problem() -> None:
    """The network of the policy is that of the study."""
    plant = Plant(0.9 * np.eye(2), np.eye(2), np.eye(2), np.eye(2), np.eye(2))
    policy = design.distributed(plant, Cost(np.eye(2), np.eye(2)), theta=0.1, network=Network(nodes=NODES))
    assert taciturn.evaluate(policy, standard_error=0.1).rates.keys() == {"s1", "s2", "v1", "v2"}


@pytest.mark.parametrize("kind", ["send-on-delta", "excess"])
def test_a_step_of_the_disturbance_is_simulated_with_nodes_of_ones_own(kind: str) -> None:
    """An integrating controller has a slow disturbance; with every sample, the loop does not depend on the nodes."""
    local = {"site": "c"} if kind == "excess" else {}
    nodes = {"s": NodeRole(measures=True, **local), "c": NodeRole(controls=True), "a": NodeRole(applies=True)}
    own = taciturn.PID(kp=1.2, ki=0.15, kd=1.0, filter=0.5)
    parameters = {"delta": 0.04} if kind == "send-on-delta" else {"theta": 0.1}
    problem = taciturn.Problem(PID_PLANT, PID_COST, Network(nodes=nodes), kind, parameters, controller=own)
    if kind == "send-on-delta":
        policy = problem.design()
        assert policy.theory.errors.keys() == {"s", "a"}
    found = taciturn.evaluate(problem, steps=40_000)
    assert found.after_step is not None
    assert found.after_step.cost_all_time.value < found.after_step.cost.value


def test_one_link_of_ones_own_has_the_certificate_by_its_name() -> None:
    """The gains of a policy that is moved to other nodes have the names of their links."""
    arm = NodeRole(applies=True, site="box")
    nodes = {"probe": NodeRole(measures=True), "box": NodeRole(controls=True), "arm": arm}
    policy = design.send_on_delta(PID_PLANT, PID_COST, delta=0.04, controller=PID, network=Network(nodes=nodes))
    assert policy.theory.errors.keys() == {"probe"} == set(policy.scheduled)


def test_a_policy_keeps_the_encoding_of_its_links() -> None:
    """Rounded numbers are no errors within the dead bands, so no guarantee holds."""
    network = Network(nodes=NODES, links={"s1": LinkLaw(payload="int16", range=5.0)})
    plant = Plant(0.9 * np.eye(2), np.eye(2), np.eye(2))
    policy = design.send_on_delta(plant, Cost(np.eye(2), np.eye(2)), delta=0.5, network=network)
    assert policy.network.links["s1"].payload == "int16"
    assert taciturn.evaluate(policy, steps=10_000).cost_bound is None


def test_mistakes_in_python_are_sentences() -> None:
    """Shares that are no mapping, a cost that is none, and no rates by link."""
    plant, cost = Plant([[0.9]], [[1.0]], [[1.0]], dt=0.1), Cost([[1.0]], [[1.0]])
    wrong: Any = [1, 2]
    with pytest.raises(ProblemError, match=r"^shares = \[1, 2\]; expected one number for each link, such as {'sensor'"):
        design.send_on_delta(plant, cost, delta=0.1, shares=wrong)
    with pytest.raises(ProblemError, match="cost is None; expected a Cost"):
        design.send_on_delta(plant, cast("Any", None), delta=0.1, controller=taciturn.PID(0.3))
    guarantee = design.distributed(plant, cost, theta=0.1).guarantee
    assert guarantee is not None
    for rates in (0.3, {"sensor": 0.3, "actuator": 0.2}, {}):
        with pytest.raises(ProblemError, match="; expected an Estimate for each of the links actuator, sensor, as in"):
            guarantee.at_rates(cast("Any", rates), "sensor")
