"""Plants whose outputs show the input of the step before, against recursions and equations written by hand.

Nothing here uses the registers of the library: the outputs are computed from the states and from the inputs that were
applied, as the documentation says: y_k = C x_k + D û_{k−1} + v_k.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal
from counts import few
from drawn import law
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_lyapunov
from systems import System, systems

import taciturn
from taciturn import (
    PID,
    ContinuousPlant,
    Controller,
    Cost,
    Jumps,
    Network,
    Nodes,
    Plant,
    ProblemError,
    close,
    design,
    load,
    plant_from,
    simulate,
)
from taciturn.design.at_fixed_steps import send_at_fixed_steps
from taciturn.lqg.discrete import discretise
from taciturn.model.disturbance import follow
from taciturn.model.limits import Limits
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.signals import ExternalDisturbance, RandomSteps
from taciturn.problem import parse
from taciturn.simulation.average import average, choose_estimator
from taciturn.study.describe import describe
from taciturn_rare.violations import violations

A, B, C, D = np.array([[1.1, 0.2], [0.0, 0.8]]), np.array([[0.1], [1.0]]), np.array([[1.0, 0.0]]), np.array([[0.7]])
W, V, COST = 0.1 * np.eye(2), np.array([[0.05]]), Cost(np.eye(2), [[1.0]])
QUIET = 1e-18  # noise that leaves eight digits of a path
FED = Plant(A, B, W, C, V, D=D)
TABLES: dict[str, Any] = {
    "plant": {"A": A.tolist(), "B": B.tolist(), "C": C.tolist(), "D": D.tolist(), "W": W.tolist(), "V": V.tolist(),
              "dt": 1.0},
    "cost": {"Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[1.0]]},
    "policy": {"kind": "excess", "theta": 0.3},
}  # fmt: skip


def fed(plant: Plant, seed: int) -> Plant:
    """Return a plant with a random feedthrough, of which one column may be zero."""
    draws = np.random.default_rng(seed)
    direct = draws.standard_normal((plant.outputs, plant.inputs)) * (draws.random(plant.inputs) < 0.7)
    return Plant(plant.A, plant.B, plant.W, plant.C, plant.V, D=direct)


def shown(plant: Plant | ContinuousPlant, run: taciturn.Trajectory, start: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the outputs without noise that follow from the states and the inputs of a trajectory."""
    assert plant.D is not None
    before = np.vstack([np.broadcast_to(start, (1, plant.inputs)), run.input[:-1]])
    return run.state[:, : plant.states] @ plant.C.T + before @ plant.D.T


def sends_by_hand(plant: Plant, policy: taciturn.Policy) -> list[bool]:
    """Return whether the nodes of a policy send, on a plant that is written here."""
    nodes, draws = Nodes(policy, seed=1), np.random.default_rng(5)
    x, u, sent = np.zeros(2), np.zeros(1), []
    for _ in range(300):
        seen = C @ x + (0.0 if plant.D is None else plant.D @ u) + np.sqrt(V[0, 0]) * draws.standard_normal(1)
        u = np.asarray(nodes.step(seen))
        sent.append(bool(nodes.sent["actuator"]))
        x = A @ x + B @ u + np.sqrt(0.1) * draws.standard_normal(2)
    return sent


CASES: dict[str, tuple[Plant | ContinuousPlant, dict[str, Any]]] = {
    "inputs that are held": (FED, {}),
    "losses": (FED, {"network": Network("tcp", actuator_loss=0.4)}),
    "zero in silence": (FED, {"actuation": "zero"}),
    "limits": (Plant(0.9 * A, B, W, C, V, input_limit=[0.3], input_rate=[0.2], D=D), {}),
    "continuous": (ContinuousPlant(A - np.eye(2), B, W, C=C, V=V, D=D), {"period": 0.2}),
    "a disturbance": (follow(FED, disturbances=ExternalDisturbance(B[:, 0], wander=1e-3)), {}),
    "two inputs, one of them shown": (
        Plant(A, np.eye(2), W, C, V, D=[[0.0, 2.0]]),
        {"cost": Cost(np.eye(2), 0.1 * np.eye(2))},
    ),
}


@pytest.mark.parametrize("name", few(list(CASES), 7))
def test_an_output_shows_the_input_that_the_plant_applied_in_the_step_before(name: str) -> None:
    """After losses, limits and holding; what is left of the measurement is the noise of the sensor."""
    plant, given = CASES[name]
    cost = given.get("cost", COST)
    policy = design.excess(plant, cost, theta=0.3, **{key: value for key, value in given.items() if key != "cost"})
    run = simulate(close(plant, policy), steps=400, seed=3)
    left = run.measurement - shown(plant, run)
    others = run.measurement - run.state[:, : plant.states] @ plant.C.T
    assert run.input.any()
    assert left.std() == pytest.approx(np.sqrt(V[0, 0]), rel=0.15)
    assert others.std() > 1.1 * left.std()
    assert abs(np.corrcoef(left[1:, 0], run.input[:-1, -1])[0, 1]) < 0.2


@law(6, 100, system=systems(states=4), seed=st.integers(0, 2**32 - 1))
def test_a_feedthrough_of_a_known_input_costs_nothing(system: System, seed: int) -> None:
    """Over ideal links the filter knows û, and subtracts D û: every cost is that of the plant without D."""
    plant = system.plant
    if plant.full_state:
        plant = Plant(plant.A, plant.B, plant.W, plant.C, 0.01 * np.eye(plant.outputs))
    one, other = fed(plant, seed), plant
    for make in (design.all_time, lambda *of: design.excess(*of, theta=0.2)):
        first, second = make(one, system.cost), make(other, system.cost)
        assert first.cost_all_time == pytest.approx(second.cost_all_time, rel=1e-8)
    found, alone = (discretise(each, system.cost, None) for each in (one, other))
    n, L, K = plant.states, found.regulator(), alone.regulator()
    np.testing.assert_allclose(L.L[:, :n], K.L, rtol=1e-7, atol=1e-9)
    assert not L.L[:, n:].any()
    np.testing.assert_allclose(found.filter().gain[:n], alone.filter().gain, rtol=1e-6, atol=1e-8)


@law(4, 60, system=systems(states=3), seed=st.integers(0, 2**32 - 1))
def test_a_static_gain_costs_what_a_lyapunov_equation_says(system: System, seed: int) -> None:
    """With u = G y the state (x, û) is linear, and D feeds the input back one step late."""
    plant, draws = system.plant, np.random.default_rng(seed)
    n, m, p = plant.states, plant.inputs, plant.outputs
    V, direct = 0.1 * np.eye(p), draws.standard_normal((p, m))
    A = plant.A * min(1.0, 0.9 / np.abs(np.linalg.eigvals(plant.A)).max())
    given = Plant(A, plant.B, plant.W + 0.01 * np.eye(n), plant.C, V, dt=1.0, D=direct)
    for size in 0.5 ** np.arange(1, 30):  # small enough for a stable loop
        G = size * draws.standard_normal((m, p))
        u = np.hstack([G @ given.C, G @ direct])
        F = np.vstack([np.hstack([A, np.zeros((n, m))]) + given.B @ u, u])
        if np.abs(np.linalg.eigvals(F)).max() < 0.95:
            break
    push = np.vstack([given.B @ G, G])
    noise = np.pad(given.W, (0, m)) + push @ V @ push.T
    S = solve_discrete_lyapunov(F, noise)
    Q, R, N = system.cost.Q, system.cost.R, system.cost.N
    inputs = u @ S @ u.T + G @ V @ G.T
    cost = np.sum(Q * S[:n, :n]) + np.sum(R * inputs) + 2 * np.sum(N * (S[:n] @ u.T))
    kept = Controller(np.zeros((0, 0)), np.zeros((0, p)), np.zeros((m, 0)), G, dt=1.0)
    found = send_at_fixed_steps("kept", given, system.cost, None, kept)
    assert found.cost_all_time == pytest.approx(cost, rel=1e-8)


@pytest.mark.parametrize("loss", few([0.3, 0.0, 0.6], 1))
def test_a_gain_over_a_lossy_link_costs_what_its_second_moments_say(loss: float) -> None:
    """Without a packet the plant keeps û, which its outputs show: a jump-linear recursion of (x, û)."""
    A, G = 0.7 * FED.A, np.array([[-0.3]])
    plant = Plant(A, B, W, C, V, dt=1.0, D=D)
    u = np.hstack([G @ C, G @ D])
    sent = np.vstack([np.hstack([A, np.zeros((2, 1))]) + B @ u, u])
    lost = np.vstack([np.hstack([A, B]), np.eye(3)[2:]])
    push = np.vstack([B @ G, G])
    noise = np.pad(W, (0, 1)) + (1 - loss) * push @ V @ push.T
    moves = (1 - loss) * np.kron(sent, sent) + loss * np.kron(lost, lost)
    S = np.linalg.solve(np.eye(9) - moves, noise.ravel()).reshape(3, 3)
    inputs = (1 - loss) * (u @ S @ u.T + G @ V @ G.T) + loss * S[2:, 2:]
    kept = Controller(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), G, dt=1.0)
    policy = design.excess(plant, COST, theta=0.0, controller=kept, network=Network("tcp", actuator_loss=loss))
    assert policy.cost_all_time == pytest.approx(np.trace(S[:2, :2]) + inputs.item(), rel=1e-8)


def test_set_points_are_those_of_the_measured_outputs() -> None:
    """Without noise, y = C x + D u settles at r; C_z of one's own remains that of the states."""
    quiet = Plant(0.7 * A, B, QUIET * np.eye(2), C, [[QUIET]], dt=1.0, D=D)
    for outputs, value in ((None, 2.0), ([[1.0, 0.0]], 2.0)):
        plant = follow(quiet, outputs, [value])
        run = simulate(close(plant, design.all_time(plant, COST)), steps=200, seed=1)
        reached = run.measurement[-1, 0] if outputs is None else run.state[-1, 0]
        assert reached == pytest.approx(value, abs=1e-6)
        assert abs(run.measurement[-1, 0] - run.state[-1, 0]) > 0.1
    kept = PID(kp=0.1, ki=0.1, setpoint=2.0)
    policy = design.excess(quiet, COST, theta=0.0, controller=kept)
    run = simulate(close(quiet, policy), steps=400, seed=1)
    assert run.measurement[-1, 0] == pytest.approx(2.0, abs=1e-6)
    assert run.state[-1, 0] == pytest.approx(2.0 - 0.7 * run.input[-1, 0], abs=1e-6)
    assert abs(run.input[-1, 0]) > 0.1


@pytest.mark.parametrize("steps", few([False, True], 2))
def test_an_operating_point_is_in_the_outputs(steps: bool) -> None:
    """At rest they are C x₀ + D u₀, and the input before the start is u₀, also of a plant that is a function."""
    point = OperatingPoint([10.0, 4.0], [3.0])

    def step(x: Any, u: Any, w: Any) -> Any:
        return point.x + 0.7 * A @ (x - point.x) + B @ (u - point.u) + w

    plant = Plant(
        0.7 * A,
        B,
        QUIET * np.eye(2),
        C,
        [[QUIET]],
        dt=1.0,
        function=step if steps else None,
        operating_point=point,
        D=D,
    )
    nodes = Nodes(design.excess(plant, COST, theta=0.3))
    run = simulate(close(plant, nodes.policy), steps=20, seed=1)
    np.testing.assert_allclose(run.measurement[:, 0], 10.0 + 0.7 * 3.0, atol=1e-6)
    np.testing.assert_allclose(nodes.step([12.1]), [3.0], atol=1e-6)


@pytest.mark.parametrize("kept", few([True, False], 2))
def test_a_set_point_at_an_operating_point_is_in_the_units_of_the_outputs(kept: bool) -> None:
    """Of a given controller and of LQG, and as an operator changes it."""
    point = OperatingPoint([10.0, 4.0], [3.0])
    quiet = Plant(0.7 * A, B, QUIET * np.eye(2), C, [[QUIET]], dt=1.0, operating_point=point, D=D)
    if kept:
        plant, given = quiet, PID(kp=0.1, ki=0.1, setpoint=14.0)
        policy = design.excess(quiet, COST, theta=0.0, controller=given)
    else:
        plant = follow(quiet, value=[14.0], changes=RandomSteps(1e-9, [[1e-9]]))
        policy = design.all_time(plant, COST)
        assert policy.model.operating_point is not None
        assert policy.model.operating_point.x[-1] == pytest.approx(12.1)
    run = simulate(close(plant, policy), steps=400, seed=1)
    assert run.measurement[-1, 0] == pytest.approx(14.0, abs=1e-5)
    assert run.measurement[0, 0] == pytest.approx(12.1, abs=1e-5)
    assert run.state[-1, 0] == pytest.approx(14.0 - 0.7 * run.input[-1, 0], abs=1e-5)
    none = Plant(0.7 * A, B, QUIET * np.eye(2), C, [[QUIET]], dt=1.0, operating_point=point)
    for one, other in ((none, quiet), (quiet, none)):
        loop = close(other, design.all_time(one, COST))
        assert loop.violated_assumptions == ("the plant is not the one of the design",)
        expected = 12.1 if other is quiet else 10.0
        assert simulate(loop, steps=1, seed=1).measurement[0, 0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("given", few([{"horizon": 12, "terminal": 5 * np.eye(2)}, {"discount": 0.9}], 2))
def test_a_total_cost_weighs_the_last_state_of_the_plant(given: dict[str, Any]) -> None:
    """And nothing of its registers: the costs are those without D."""
    cost, start = Cost(np.eye(2), [[1.0]], **given), {"mean": [3.0, 1.0]}
    plants = Plant(A, B, W, C, V, D=D, **start), Plant(A, B, W, C, V, **start)
    policies = [design.excess(plant, cost, theta=0.2) for plant in plants]
    assert policies[0].cost_all_time == pytest.approx(policies[1].cost_all_time, rel=1e-8)
    found = [
        taciturn.average(close(plant, policy), steps=60_000).cost
        for plant, policy in zip(plants, policies, strict=True)
    ]
    assert abs(found[0].value - found[1].value) < 5 * np.hypot(found[0].standard_error, found[1].standard_error)


def test_the_input_before_the_start_is_in_the_first_measurement() -> None:
    """It is start_input of a given controller, which then begins without a step of its command."""
    plant = Plant(0.7 * A, B, QUIET * np.eye(2), C, [[QUIET]], dt=1.0, D=D)
    kept = PID(kp=0.1, ki=0.1, start_input=0.5, disturbance=taciturn.Disturbance(deviation=0.0))
    run = simulate(close(plant, design.excess(plant, COST, theta=0.0, controller=kept)), steps=5, seed=1)
    assert run.measurement[0, 0] == pytest.approx(0.7 * 0.5, abs=1e-6)
    assert run.input[0, 0] == pytest.approx(0.5, abs=1e-6)
    np.testing.assert_allclose(run.measurement, shown(plant, run, 0.5), atol=1e-6)


def test_the_simulated_plant_may_have_another_feedthrough() -> None:
    """Or none, or one where the design has none; a note says so, and the outputs are those of the simulated plant."""
    none, wide = Plant(A, B, W, C, V), np.eye(2)
    alike = Plant(A, wide, W, C, V, D=[[0.0, 0.7]]), Plant(A, wide, W, C, V, D=[[0.4, 0.0]])
    for designed, actual in ((FED, none), (none, FED), (FED, Plant(A, B, W, C, V, D=2 * D)), alike, alike[::-1]):
        cost = Cost(np.eye(2), np.eye(actual.inputs))
        loop = close(actual, design.excess(designed, cost, theta=0.3))
        assert loop.violated_assumptions == ("the plant is not the one of the design",)
        run = simulate(loop, steps=300, seed=4)
        expected = shown(actual, run) if actual.D is not None else run.state[:, :2] @ C.T
        assert (run.measurement - expected).std() == pytest.approx(np.sqrt(V[0, 0]), rel=0.15)


def test_outputs_are_weighed_with_the_new_input() -> None:
    """Σ y²/variance of y = C x + D u has a cross term; the controller's own weights make each share 1."""
    found = Cost.of_variances(C, [0.5], [2.0], D)
    np.testing.assert_allclose(found.Q, 2 * C.T @ C)
    np.testing.assert_allclose(found.R, [[0.5 + 2 * 0.49]])
    np.testing.assert_allclose(found.N, 2 * C.T @ D)
    stated = {"output_variance": [0.5], "input_variance": [2.0]}
    assert parse({**TABLES, "cost": stated}, "here").cost.same_as(found)
    controller = {"D": [[0.2]], "disturbance": "none"}
    tables = {**TABLES, "cost": {"weights": "as the controller"}, "controller": controller}
    tables["plant"] = {**TABLES["plant"], "A": (0.7 * A).tolist()}
    problem = parse(tables, "here")
    every = send_at_fixed_steps("kept", problem.plant, problem.cost, None, problem.controller)
    assert every.cost_all_time == pytest.approx(2.0, rel=1e-6)  # one output and one input


def test_every_route_of_a_system_keeps_its_feedthrough(tmp_path: Path) -> None:
    """Of python-control's and of scipy's, of both times; a zero one is none, and what is improper is refused."""
    for system in (
        scipy.signal.StateSpace(A, B, C, D),
        scipy.signal.dlti(A, B, C, D, dt=0.5),
        scipy.signal.TransferFunction([1.0, 2.0, 3.0], [1.0, 0.5, 0.2]),
    ):
        plant = plant_from(system, 0.1 * np.eye(2), V)
        assert plant.D is not None
        assert plant.D.any()
    assert plant_from(scipy.signal.dlti(A, B, C, 0 * D, dt=0.5), W).D is None
    with pytest.raises(ProblemError, match="proper transfer function"):
        plant_from(scipy.signal.TransferFunction([1.0, 0.0, 1.0, 2.0], [1.0, 0.5]), [[1.0]])
    file = tmp_path / "fed.toml"
    lines = [f"[{name}]\n" + "".join(f"{k} = {v!r}\n" for k, v in table.items()) for name, table in TABLES.items()]
    file.write_text("\n".join(lines).replace("'", '"'))
    problem = load(file)
    np.testing.assert_array_equal(problem.plant.D, D)
    told = describe(problem)
    assert any("direct feedthrough D" in note for note in told.notes)
    assert told.document()["plant"]["D"] == D.tolist()
    assert any(name == "feedthrough D" for name, _ in told.lines())
    assert any("direct feedthrough D" in note for note in taciturn.evaluate(problem, steps=1024).notes)


def changed(**plant: Any) -> dict[str, Any]:
    """Return the tables with other keys of the plant; None removes one."""
    table = {**TABLES["plant"], **plant}
    return {**TABLES, "plant": {key: value for key, value in table.items() if value is not None}}


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        (changed(C=None, V=None), "D is given without C; expected C (and V), as a direct feedthrough adds to measured"),
        (changed(D=[[0.7], [0.1]]), "D has shape (2, 1); expected the shape (1, 1) = (outputs, inputs)"),
        ({**TABLES, "limits": {"high": [1.0]}}, "limits.outputs is missing, but the measured outputs have a direct"),
    ],
)
def test_what_a_feedthrough_cannot_have_is_one_sentence(tables: dict[str, Any], sentence: str) -> None:
    """In problem files."""
    with pytest.raises(ProblemError) as found:
        parse(tables, "here")
    assert sentence in str(found.value)


def test_kinds_that_cannot_have_a_feedthrough_refuse_it_by_name() -> None:
    """Jumps, predictions between samples, and policies that measure the state."""
    jumping = ContinuousPlant([[0.1]], [[1.0]], jumps=Jumps(1.0, [[1.0]]), C=[[1.0]], V=[[0.1]], D=[[1.0]])
    scalar = Cost([[1.0]], [[1.0]])
    with pytest.raises(ProblemError, match="have a direct feedthrough D, and the plant has jumps; expected Gaussian"):
        design.excess(jumping, scalar, theta=0.1, period=0.1)
    plant = ContinuousPlant([[0.1]], [[1.0]], [[1.0]], C=[[1.0]], V=[[0.1]], D=[[1.0]])
    policy = design.periodic(plant, scalar, every=2, period=0.1)
    assert policy.model.registers == (0,)
    predicting = ContinuousPlant([[0.1]], [[1.0]], [[1.0]])
    with pytest.raises(ProblemError, match="feedthrough D, and the actuator predicts between sampling instants; expec"):
        close(plant, design.consistent(predicting, scalar, period=0.1))
    with pytest.raises(ProblemError, match="C or V is given, but the policy kind lossy-lqg measures the full state"):
        design.lossy_lqg(FED, COST, price=0.1, network=Network("udp", 0.1, 0.1))


def test_registers_are_no_states_of_the_user() -> None:
    """Weights, limits of states and the first states of a trajectory are those of the plant."""
    policy = design.excess(FED, COST, theta=0.3)
    assert policy.model.stated == FED.states == 2
    assert policy.model.states == 3
    run = simulate(close(FED, policy), steps=50, seed=1)
    np.testing.assert_array_equal(run.state[1:, 2], run.input[:-1, 0])


@pytest.mark.evidence
def test_limits_of_states_are_violated_as_often_as_without_a_feedthrough() -> None:
    """They are limits of the states of the plant."""
    limits = Limits([[1.0, 0.0]], high=[3.0])
    loops = [close(one, design.excess(one, COST, theta=0.3)) for one in (FED, Plant(A, B, W, C, V))]
    first, second = (violations(loop, limits, accuracy=0.3).total.per_step for loop in loops)
    assert abs(first.value - second.value) < 5 * np.hypot(first.standard_error, second.standard_error)


@pytest.mark.parametrize("kind", few(["relative", "mixed", "dynamic", "downsampled", "stochastic", "absolute"], 6))
def test_triggers_on_the_state_do_not_count_registers(kind: str) -> None:
    """Over ideal links the sends, the cost and the bound are those without D."""
    given: dict[str, dict[str, Any]] = {
        "relative": {"sigma": 0.2},
        "mixed": {"sigma": 0.2, "threshold": 0.3},
        "dynamic": {"sigma": 0.2, "rho": 0.8, "gain": 2.0},
        "downsampled": {"fast": 1, "slow": 3, "threshold": 0.8},
        "stochastic": {"scale": 1.0, "weight": np.diag([1.0, 0.5])},
        "absolute": {"threshold": 0.8, "error": "state", "weight": np.diag([1.0, 0.5])},
    }
    plants = FED, Plant(A, B, W, C, V)
    first, second = (getattr(design, kind)(plant, COST, actuation="model", **given[kind]) for plant in plants)
    runs = [sends_by_hand(plant, policy) for plant, policy in zip(plants, (first, second), strict=True)]
    assert runs[0] == runs[1]
    assert 0 < sum(runs[0]) < len(runs[0])
    if second.guarantee is None:
        assert first.guarantee is None
    else:
        assert first.guarantee is not None
        assert first.guarantee.cost == pytest.approx(second.guarantee.cost, rel=1e-7)


def test_a_separate_trigger_does_not_count_registers() -> None:
    """The least eigenvalue of Q + L'RL + U is that of the states of the plant."""
    plants = FED, Plant(A, B, W, C, V)
    first, second = (design.lqg(plant, COST, theta=0.3, trigger="separate") for plant in plants)
    trigger = [policy.decisions["send"].options["silent"].Psi for policy in (first, second)]
    assert trigger[0] is not None
    assert trigger[1] is not None
    np.testing.assert_allclose(trigger[0][:2, :2], trigger[1][:2, :2], rtol=1e-8)
    assert not trigger[0][2].any()


@pytest.mark.evidence
def test_a_certificate_does_not_count_registers() -> None:
    """Its mean square is that of the states of the plant."""
    plants = FED, Plant(A, B, W, C, V)
    found = [taciturn.certify(taciturn.Problem(plant, COST, Network(), "excess", {"theta": 0.3})) for plant in plants]
    for name in ("cost_bound", "mean_square_bound", "mean_square_all_time"):
        one, other = (getattr(certificate, name) for certificate in found)
        assert one == pytest.approx(other, rel=1e-3)


@pytest.mark.parametrize("kind", ["excess", "lqg", "absolute"])
def test_a_run_goes_on_with_control_variates_in_the_same_states(kind: str) -> None:
    """Only the sensor reads a register, so the estimator of the cost may leave it out; x has fewer entries then."""
    given: dict[str, Any] = {"threshold": 0.1} if kind == "absolute" else {"theta": 0.2}
    loop = close(FED, getattr(design, kind)(FED, COST, actuation="model", **given))
    estimator = choose_estimator(loop)
    assert estimator.controlled is not None
    assert estimator.controlled.states == estimator.program.states
    found = average(loop, steps=16_000_000, seed=1).cost
    without = average(loop, steps=1_000_000, seed=2).cost
    assert abs(found.value - without.value) < 5 * without.standard_error


def test_a_feedthrough_that_hides_the_outputs_by_rounding_is_refused() -> None:
    """With less, a simulation in doubles costs what is claimed; with more, an estimator would lose digits."""

    def with_entry(entry: float, point: OperatingPoint | None = None) -> Plant:
        return Plant(A, B, W, C, V, D=[[entry]], operating_point=point)

    policy = design.all_time(with_entry(1e12), COST)
    found = average(close(with_entry(1e12), policy), steps=100_000).cost
    assert found.value == pytest.approx(design.all_time(with_entry(1.0), COST).cost_all_time, rel=0.03)
    far = OperatingPoint(np.linalg.solve(np.eye(2) - A, B @ [1e14]), [1e14])
    for plant, said in ((with_entry(1e14), r"1e\+14, with .* output 1 so much"), (with_entry(0.7, far), "0.7, with")):
        for kind in (design.all_time, lambda one, cost: design.remote_lqg(one, cost, controller="actuator", zeta=0.1)):
            with pytest.raises(ProblemError, match=f"D has the entry {said}"):
                kind(plant, COST)
