"""Actuators that know how old a packet is: models and plans, against packets in queues that nobody rolls forward.

The other program keeps the newest estimate with the step in which it was sent, and computes the input for the present
step from it. So copies of a state, shifts of a plan and branches for each age have no part in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import scipy.linalg as la
from counts import few
from drawn import law
from hypothesis import assume
from hypothesis import strategies as st
from measured import average
from runtime.late import delays, pendulum, record
from runtime.loops import column
from systems import System, systems

import taciturn
from taciturn import Controller, Cost, Network, Plant, ProblemError, design
from taciturn.lqg.discrete import discretise
from taciturn.model.packets import fingerprint
from taciturn.model.steps import Assign, Received
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet
from taciturn.program.late import NEVER
from taciturn.program.ops import Sent
from taciturn.simulation.average import completed_squares, plain_average

STEPS = 400
SIZES = ((1, 1), (2, 1), (3, 2))  # states and inputs
LAWS: tuple[list[float], ...] = ([0.2, 0.3, 0.5], [0.5, 0.0, 0.0, 0.4], [0.1, 0.8])


def late_network(law: list[float], loss: float = 0.1) -> Network:
    """Return the usual nodes with an actuator link that delays packets, drops some and acknowledges none."""
    return Network().changed({"actuator": {"delay": law, "loss": loss}})


@dataclass(frozen=True)
class Gains:
    """LQG by the Riccati equations of SciPy."""

    L: np.ndarray
    H: np.ndarray
    filter: np.ndarray

    @staticmethod
    def of(plant: Plant, cost: Cost) -> Gains:
        """Return the gains for a plant in discrete time."""
        A, B, C = plant.A, plant.B, plant.C
        K = la.solve_discrete_are(A, B, cost.Q, cost.R, s=cost.N)
        H = cost.R + B.T @ K @ B
        L = -np.linalg.solve(H, B.T @ K @ A + cost.N.T)
        if plant.full_state:
            return Gains(L, H, np.eye(plant.states))
        prior = la.solve_discrete_are(A.T, C.T, plant.W, plant.V)
        return Gains(L, H, prior @ C.T @ np.linalg.inv(C @ prior @ C.T + plant.V))


def played(
    plant: Plant,
    gains: Gains,
    delta: float,
    y: np.ndarray,
    after: np.ndarray,
    inputs: Callable[[np.ndarray, int], np.ndarray],
) -> tuple[np.ndarray, list[bool]]:
    """Return applied inputs and decisions for given measurements and delays; ``inputs`` of an estimate, by its age."""
    prior, at_controller = np.zeros(plant.states), (0, np.zeros(plant.states))
    at_actuator, flying = at_controller, list[tuple[int, int, np.ndarray]]()
    applied, decisions = list[np.ndarray](), list[bool]()
    for k, measured in enumerate(y):
        estimate = prior + gains.filter @ (measured - plant.C @ prior)
        command, (since, told) = gains.L @ estimate, at_controller
        error = inputs(told, k - since) - command
        decisions.append(bool(error @ gains.H @ error > delta))
        if decisions[-1]:
            at_controller = k, estimate
            if after[k] < NEVER / 2:
                flying.append((k + int(after[k]), k, estimate))
        believed = inputs(at_controller[1], k - at_controller[0])
        for due, sent, carried in flying:
            if due == k and sent >= at_actuator[0]:
                at_actuator = sent, carried
        applied.append(inputs(at_actuator[1], k - at_actuator[0]))
        prior = plant.A @ estimate + plant.B @ believed
    return np.array(applied), decisions


@law(6, 60, system=systems(states=4, inputs=2), seed=st.integers(0, 2**31), plan=st.sampled_from([0, 0, 1, 2, 6]))
def test_a_receiver_has_the_inputs_that_the_newest_packet_foresaw(system: System, seed: int, plan: int) -> None:
    """Every decision and every input of random systems; ``plan`` 0 stands for a model, which has no end."""
    plant, cost, chances = system.plant, system.cost, LAWS[seed % len(LAWS)]
    gains = Gains.of(plant, cost)
    delta = 0.1 * float(np.trace(gains.L.T @ gains.H @ gains.L @ plant.W))
    assume(delta > 1e-9)
    closed = plant.A + plant.B @ gains.L

    def inputs(estimate: np.ndarray, age: int) -> np.ndarray:
        return gains.L @ np.linalg.matrix_power(closed, min(age, plan) if plan else age) @ estimate

    network = late_network(chances)
    asked = {"plan": plan} if plan else {"actuation": "model"}
    loop = taciturn.close(plant, design.excess(plant, cost, delta=delta, network=network, **asked), network)  # type: ignore[arg-type]
    records = record(loop, STEPS, seed, fast=False)
    u, after = column(records, "applied"), delays(loop, records)["actuator"]
    assume(np.abs(u).max() < 1e6)  # without acknowledgements, nothing bounds the loop
    assume(set(after[after < NEVER / 2]) == {i for i, p in enumerate(chances) if p})  # each delay has occurred
    found, decisions = played(plant, gains, delta, column(records, "y"), after, inputs)
    assert np.abs(found - u).max() <= 1e-7 * np.abs(u).max()
    assert (records[Sent("actuator")][:, 0] > 0).tolist() == decisions


@pytest.mark.parametrize("seed", few(range(40), 4))
def test_a_controller_moves_a_late_packet_with_its_own_inputs(seed: int) -> None:
    """A controller with states that hears the sensor late: every input, computed again from the step of each packet."""
    draws = np.random.default_rng(seed)
    n, m = SIZES[seed % len(SIZES)]
    A = draws.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    plant, cost = Plant(A, draws.standard_normal((n, m)), 0.1 * np.eye(n)), Cost(np.eye(n), np.eye(m))
    L, small = Gains.of(plant, cost).L, 0.1 * draws.standard_normal((2, n + m))
    kept = Controller([[0.8, 0.1], [0.0, 0.5]], small[:, :n], 0.1 * draws.standard_normal((m, 2)), L, E=small[:, n:])
    network = Network().changed({"sensor": {"delay": LAWS[seed % len(LAWS)], "loss": 0.1}})
    policy = design.excess(
        plant, cost, theta=0.1, link="sensor", actuation="model", controller=kept, network=network
    )  # fmt: skip
    loop = taciturn.close(plant, policy, network)
    records = record(loop, STEPS, seed, fast=False)
    y, u, sends = column(records, "y"), column(records, "applied"), records[Sent("sensor")][:, 0] > 0
    found = moved(plant, kept, y, sends, delays(loop, records)["sensor"])
    assert 10 < sends.sum() < STEPS - 10
    assert np.abs(found - u).max() <= 1e-9 * np.abs(u).max()


def moved(plant: Plant, kept: Controller, y: np.ndarray, sends: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the commands of a controller that starts again at the step of each packet, given what is sent and when."""
    foreseen, copied = np.zeros(plant.states), np.zeros(len(kept.A))  # by the sensor, which thinks that packets arrive
    packets, newest = list[tuple[np.ndarray, np.ndarray]](), -1
    commands, used, states, models = ([np.zeros(plant.inputs)][:0], list[np.ndarray](), [copied], [foreseen])
    for k, measured in enumerate(y):
        packets.append((measured, copied))
        known = measured if sends[k] else foreseen
        believed = kept.C @ copied + kept.D @ known
        copied = kept.A @ copied + kept.B @ known + kept.E @ believed
        foreseen = plant.A @ known + plant.B @ believed
        come = [s for s in range(newest + 1, k + 1) if s + after[s] == k]
        state, model, value = states[k], models[k], models[k]
        if come:
            newest = max(come)
            value, state = packets[newest]
            model = value
            for s in range(newest, k):
                state = kept.A @ state + kept.B @ (value if s == newest else used[s]) + kept.E @ commands[s]
                model = plant.A @ model + plant.B @ commands[s]
            value = model
        commands.append(kept.C @ state + kept.D @ value)
        used.append(value)
        states.append(kept.A @ state + kept.B @ value + kept.E @ commands[k])
        models.append(plant.A @ model + plant.B @ commands[k])
    return np.array(commands)


@law(3, 40, system=systems(states=4, inputs=2), plan=st.integers(1, 8))
def test_a_plan_has_the_guarantee_of_any_input_in_silence(system: System, plan: int) -> None:
    """Over a link that delivers every packet at once, J = J_all + E[e'He], at most J_all + δ(1 − rate)."""
    policy = design.excess(system.plant, system.cost, theta=0.3, plan=plan)
    loop = taciturn.close(system.plant, policy)
    assert not loop.violated_assumptions
    squares, plain = (average(loop, one(loop), steps=4096) for one in (completed_squares, plain_average))
    square, rate, guarantee = squares.cost, squares.rates["actuator"], policy.guarantee
    assert guarantee is not None
    assert abs(square.value - plain.cost.value) < 5 * np.hypot(square.standard_error, plain.cost.standard_error)
    bound = policy.cost_all_time + (guarantee.cost - policy.cost_all_time) * (1 - rate.value)
    assert square.value < bound + 5 * square.standard_error


def test_a_plan_without_an_end_is_a_model() -> None:
    """The applied inputs of both, with the same noise, delays and losses."""
    late = {"acknowledged": False, "delay": [0.2, 0.3, 0.5]}
    problems = [pendulum({"delta": 0.005, **one}, **late) for one in ({"plan": 50}, {"actuation": "model"})]
    records = [record(problem.close(problem.design()), 2000, 1) for problem in problems]
    one, other = (column(found, "applied") for found in records)
    assert np.diff(np.flatnonzero(records[0][Sent("actuator")])).max() < 50
    assert np.abs(one - other).max() < 1e-9 * np.abs(one).max()


def test_a_node_counts_the_age_of_a_packet_until_it_hears_it() -> None:
    """Also without a time of arrival, as in real time. A packet that is older than the law says is not used."""
    problem = pendulum({"delta": 0.05, "actuation": "model"}, acknowledged=False)
    policy, n = problem.design(), 4
    (heard,) = [step for step in policy.steps if isinstance(step, Assign) and step.signal == "model"]
    assert heard.on == Received("actuator", 2)
    discrete = discretise(problem.plant, problem.cost, 0.02)
    gains = Gains.of(discrete.plant, Cost(discrete.Q, discrete.R, discrete.N))
    closed, estimate = discrete.plant.A + discrete.plant.B @ gains.L, np.arange(1.0, n + 1)
    for age in range(4):
        actuator = Node(policy, "actuator", network=problem.network)
        for k in range(5):
            actuator.step(k)
        sent = Packet("data", "actuator", 5 - age, 0, tuple(estimate))
        used = 0 * estimate if age > 2 else np.linalg.matrix_power(closed, age) @ estimate
        assert actuator.step(5, packets=[sent]).input == pytest.approx(gains.L @ used, rel=1e-6)
        assert actuator.step(6).input == pytest.approx(gains.L @ closed @ used, rel=1e-6)


def test_two_actuators_move_the_same_state_by_different_ages() -> None:
    """Each with the gain of its own input, in a policy with a decision for each link."""
    laws = {"links.pump-1.delay": [0.2, 0.3, 0.5], "links.pump-2.delay": [0.9, 0.1]}
    problem = taciturn.load("quadruple-tank").changed(laws)
    policy, discrete = problem.design(), discretise(problem.plant, problem.cost, 2.0)
    plant, gains = discrete.plant, Gains.of(discrete.plant, Cost(discrete.Q, discrete.R, discrete.N))
    state = np.arange(1.0, plant.states + 1)
    for i, age in ((0, 0), (0, 2), (1, 1)):
        node = f"pump-{i + 1}"
        actuator = Node(policy, node, network=problem.network)
        for k in range(3):
            actuator.step(k)
        moved_to = state
        for _ in range(age):
            moved_to = plant.A @ moved_to + plant.B @ gains.L @ moved_to
        packet = Packet("data", node, 3 - age, 0, tuple(state))
        assert actuator.step(3, packets=[packet]).input == pytest.approx(gains.L[[i]] @ moved_to, rel=1e-6)


def test_an_actuator_moves_the_loop_of_a_given_controller() -> None:
    """With the state of the controller and the output of the model, as if nothing had been measured since."""
    A, B, C = np.array([[0.9, 0.2], [0.0, 0.7]]), np.array([[0.1], [0.3]]), np.array([[1.0, 0.5]])
    plant, cost = Plant(A, B, 0.1 * np.eye(2), C, [[0.1]]), Cost(np.eye(2), [[0.1]])
    kept = Controller([[0.6]], [[0.3]], [[-0.4]], [[-0.5]], E=[[0.2]])
    network = late_network([0.3, 0.3, 0.3, 0.1])
    policy = design.excess(plant, cost, theta=0.1, actuation="model", controller=kept, network=network)
    x, r, y = np.array([1.0, -2.0]), np.array([0.7]), np.array([0.4])
    packet = Packet("data", "actuator", 3, 0, (*(kept.C @ r + kept.D @ y), *x, *r, *y))
    for age in range(4):
        u = kept.C @ r + kept.D @ y
        actuator = Node(policy, "actuator", network=network)
        for k in range(3 + age):
            actuator.step(k)
        assert actuator.step(3 + age, packets=[packet]).input == pytest.approx(u)
        x, r = A @ x + B @ u, kept.A @ r + kept.B @ y + kept.E @ u
        y = C @ x
        assert actuator.step(4 + age).input == pytest.approx(kept.C @ r + kept.D @ y)


@pytest.mark.parametrize("prediction", few(["hold", "model"], 1, 1))
def test_a_controller_moves_late_contributions_of_sensors_to_the_present(prediction: str) -> None:
    """Every input of two sensors with different laws, from what each packet says, one step at a time since it was sent.

    With a model, a sensor's own filter foresees what it would have measured. Its noise has the part of the inputs that
    the estimation error of all sensors causes.
    """
    laws = {"level-1": [0.4, 0.2, 0.1, 0.2], "level-2": [0.3, 0.6]}
    changes: dict[str, Any] = {f"links.{link}.delay": law for link, law in laws.items()}
    shares = {"level-1": 1.0, "level-2": 0.5, "pump-1": 0.0, "pump-2": 0.0}  # the pumps always hear the controller
    problem = taciturn.load("quadruple-tank").changed({**changes, "prediction": prediction, "shares": shares})
    policy, discrete = problem.design(), discretise(problem.plant, problem.cost, 2.0)
    loop, plant = problem.close(policy), discrete.plant
    assert loop.violated_assumptions
    records = record(loop, STEPS, 3, fast=False)
    gains = Gains.of(plant, Cost(discrete.Q, discrete.R, discrete.N))
    A, B, C, L, G = plant.A, plant.B, plant.C, gains.L, gains.filter
    left, closed = np.eye(plant.states) - G @ C, A + B @ L
    prior = la.solve_discrete_are(A.T, C.T, plant.W, plant.V)
    noise = plant.W + B @ L @ left @ prior @ L.T @ B.T
    alone = list[np.ndarray]()  # the gains of filters that hear one sensor
    for c, v in zip(C, np.diag(plant.V), strict=True):
        P = la.solve_discrete_are(closed.T, c[:, None], noise, [[v]])
        alone.append(P @ c / (c @ P @ c + v))
    y, u, after = column(records, "y"), column(records, "applied"), delays(loop, records)
    used, models = ({link: np.zeros(plant.states) for link in laws} for _ in range(2))
    newest, packets = dict.fromkeys(laws, -1), {link: list[tuple[np.ndarray, np.ndarray]]() for link in laws}
    parts, local = ({link: np.zeros(plant.states) for link in laws} for _ in range(2))
    own, commands = np.zeros(plant.states), list[np.ndarray]()
    for k in range(STEPS):
        for i, link in enumerate(laws):
            parts[link] = left @ A @ parts[link] + G[:, i] * y[k, i]
            local[link] = closed @ local[link] + alone[i] * (y[k, i] - C[i] @ closed @ local[link])
            packets[link].append((parts[link], local[link]))

            def foreseen(part: np.ndarray, model: np.ndarray, i: int = i) -> tuple[np.ndarray, np.ndarray]:
                model = closed @ model
                return left @ A @ part + (G[:, i] * (C[i] @ model) if prediction == "model" else 0.0), model

            sent = records[Sent(link)][:, 0] > 0
            come = [s for s in range(newest[link] + 1, k + 1) if sent[s] and s + after[link][s] == k]
            if come:
                newest[link] = max(come)
                state = packets[link][newest[link]]
                for _ in range(newest[link], k):
                    state = foreseen(*state)
            else:
                state = foreseen(used[link], models[link])
            used[link], models[link] = state
        commands.append(L @ (own + sum(used.values())))
        own = left @ (A @ own + B @ commands[-1])
    found = np.array(commands)
    assert all(10 < (records[Sent(link)][:, 0] > 0).sum() < STEPS for link in laws)
    assert np.abs(found - u).max() <= 1e-9 * np.abs(u).max()


def test_what_cannot_be_predicted_is_refused_by_name() -> None:
    """Limits, horizons, acknowledgements, other routes, longer delays, and policies that do not know ages."""
    plant, cost, network = Plant([[1.1]], [[1.0]], [[0.1]]), Cost([[1.0]], [[1.0]]), late_network([0.5, 0.5])
    limited = Plant([[1.1]], [[1.0]], [[0.1]], input_limit=[5.0])
    mission = Cost([[1.0]], [[1.0]], horizon=20)
    asks: tuple[dict[str, Any], ...] = ({"plan": 3}, {"actuation": "model"})
    for asked in asks:
        with pytest.raises(ProblemError, match=r"inputs are limited.*expected a cost without a horizon, no limits"):
            design.excess(limited, cost, theta=0.1, network=network, **asked)
        with pytest.raises(ProblemError, match=r"cost has a horizon.*expected a cost without a horizon, no limits"):
            design.excess(plant, mission, theta=0.1, network=network, **asked)
        told = network.changed({"actuator": {"acknowledged": True}})
        with pytest.raises(ProblemError, match="with acknowledgements; expected"):
            design.excess(plant, cost, theta=0.1, network=told, **asked)
        policy = design.excess(plant, cost, theta=0.1, network=network, **asked)
        assert taciturn.close(plant, policy, network).violated_assumptions
        with pytest.raises(ProblemError, match="up to 2 steps, but the receiver of this excess policy was designed"):
            taciturn.close(plant, policy, late_network([0.5, 0.2, 0.3]))
        for shorter in (Network(), late_network([0.8, 0.2])):
            assert average(taciturn.close(plant, policy, shorter), steps=1024).cost.value > 0
    for wrong in (-1, 51, 1.5):
        with pytest.raises(ProblemError, match="plan is"):
            design.excess(plant, cost, theta=0.1, plan=wrong)  # type: ignore[arg-type]
    others: tuple[dict[str, Any], ...] = (
        {"actuation": "model"}, {"actuation": "zero"}, {"every": 2}, {"controller": [[-0.5]]}, {"link": "sensor"}
    )  # fmt: skip
    for other in others:
        with pytest.raises(ProblemError, match="plan is 3; expected actuation = 'hold'"):
            design.excess(plant, cost, theta=0.1, plan=3, **other)
    unaware = design.excess(plant, cost, theta=0.1, actuation="model")
    with pytest.raises(ProblemError, match="would have to know how old a packet is"):
        taciturn.close(plant, unaware, network)
    assert fingerprint(unaware, Network()) != fingerprint(policy, Network())
