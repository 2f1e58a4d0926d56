"""Loops whose plant is not linear, told again with scipy alone, and what becomes of them where they hardly bend."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from counts import few
from drawn import over
from hypothesis import strategies as st
from measured import average
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_are
from systems import System, systems

from taciturn import Cost, Loop, Network, Plant, UnstableError, close, design, difference, integrate, load, simulate
from taciturn.program.machine import Kernel
from taciturn.program.numpy import run
from taciturn.program.ops import Entry, Sent
from taciturn.simulation.bank import Bank
from taciturn.simulation.trajectory import course

Ode = Callable[[np.ndarray, np.ndarray], np.ndarray]
NAMES = ("pendulum-on-a-cart", "pendulum-by-encoders", "omni-heading")
LARGE = {
    "pendulum-on-a-cart": 12.0,
    "pendulum-by-encoders": 12.0,
    "omni-heading": 8.0,
}  # times the noise of the problem


def pendulum(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the motion of cart and pendulum by Lagrange's equations: mass matrix times accelerations = forces."""
    _, speed, angle, turn = x.tolist()  # on floats, as this runs a million times
    sine, cosine = math.sin(angle), math.cos(angle)
    along, both, around = 0.5 + 0.2, -0.2 * 0.3 * cosine, 0.006 + 0.2 * 0.3**2  # the entries of the mass matrix
    push, pull = float(u[0]) - 0.1 * speed - 0.2 * 0.3 * turn**2 * sine, 0.2 * 9.81 * 0.3 * sine
    determinant = along * around - both**2
    cart, swing = (around * push - both * pull) / determinant, (along * pull - both * push) / determinant
    return np.array([speed, cart, turn, swing])


def robot(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the motion of a robot whose velocities are along and across its heading."""
    turn = np.array([[np.cos(x[2]), -np.sin(x[2])], [np.sin(x[2]), np.cos(x[2])]])
    return np.array([*(turn @ u[:2]), u[2]])


ODES: dict[str, Ode] = {"pendulum-on-a-cart": pendulum, "pendulum-by-encoders": pendulum, "omni-heading": robot}


@dataclass
class Told:
    """What happened: states and inputs at each step, and whether a packet was sent."""

    x: np.ndarray
    u: np.ndarray
    sent: np.ndarray


def told_by_hand(plant: Plant, ode: Ode, theta: float, w: np.ndarray, v: np.ndarray) -> Told:
    """Return a path of chapter 2's loop with an actuator that holds, by scipy's own integration of the equation.

    Gain and filter by scipy's solver; send if and only if (1+θ) e'(R+B'KB)e − θ(x̂'Qx̂ + û'Rû) > θ tr(QΣ).
    """
    A, B, C, Q, R = plant.A, plant.B, plant.C, np.diag([10.0, 1.0, 100.0, 1.0]), np.eye(1)
    if plant.states == 3:
        Q, R = np.eye(3), np.eye(3)
    K = solve_discrete_are(A, B, Q, R)
    H = R + B.T @ K @ B
    L = -np.linalg.solve(H, B.T @ K @ A)
    gain, Sigma = np.eye(plant.states), np.zeros_like(A)
    if not plant.full_state:
        P = solve_discrete_are(A.T, C.T, plant.W, plant.V)
        gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + plant.V)
        Sigma = P - gain @ C @ P
    threshold = theta * np.trace(Q @ Sigma)
    x, prior, held = np.zeros(plant.states), np.zeros(plant.states), np.zeros(plant.inputs)
    states, inputs, sent = [], [], []
    for k in range(len(w)):
        estimate = prior + gain @ (C @ x + v[k] - C @ prior)
        error = held - L @ estimate
        silence = (1 + theta) * error @ H @ error - theta * (estimate @ Q @ estimate + held @ R @ held)
        sent.append(silence > threshold)
        held = L @ estimate if sent[-1] else held
        prior = A @ estimate + B @ held
        states.append(x)
        inputs.append(held)
        moved = solve_ivp(lambda t, x, u=held: ode(x, u), (0.0, plant.dt), x, method="DOP853", rtol=1e-11, atol=1e-13)
        x = moved.y[:, -1] + w[k]
    return Told(np.array(states), np.array(inputs), np.array(sent))


def told_by_the_loop(loop: Loop, w: np.ndarray, v: np.ndarray) -> Told:
    """Return the path of a loop with the same noise."""
    program = loop.open_program()
    noise = {Entry("w", i): column for i, column in enumerate(w.T)} | {
        Entry("v", i): column for i, column in enumerate(v.T)
    }
    supplied = np.array([noise[name] for name in program.inputs]).T[:, :, None]
    found = Kernel(program, "parity").run(program, loop.start(program, 1, 0), len(w), supplied).outputs

    def stacked(name: str, size: int) -> np.ndarray:
        return np.array([found[Entry(name, i)][:, 0] for i in range(size)]).T

    plant = loop.problem.plant
    return Told(stacked("x", plant.states), stacked("applied", plant.inputs), found[Sent("actuator")][:, 0] > 0)


def compared(name: str, ticks: int, theta: float, seed: int) -> tuple[Told, Told, float]:
    """Return a path of a built-in problem, the same by hand, and about what Runge and Kutta's rule is off by."""
    problem = load(name).changed({"theta": theta})
    plant = problem.plant
    assert isinstance(plant, Plant)
    draws = np.random.default_rng(seed)
    w = LARGE[name] * draws.multivariate_normal(np.zeros(plant.states), plant.W, ticks, check_valid="ignore")
    v = draws.multivariate_normal(np.zeros(plant.outputs), plant.V, ticks)
    loop = problem.close(problem.design())
    found = told_by_the_loop(loop, w, v)
    assert plant.function is not None
    rule = plant.function.function
    assert isinstance(rule, partial)
    ode, dt, steps = rule.args
    finer = replaced(plant, integrate(ode, dt, 2 * steps))
    other = told_by_the_loop(close(finer, loop.policy, loop.network, problem.cost), w, v)
    assert (other.sent == found.sent).all()
    return found, told_by_hand(plant, ODES[name], theta, w, v), 16 / 15 * float(np.abs(found.x - other.x).max())


def replaced(plant: Plant, function: Any, scale: float = 1.0) -> Plant:
    """Return a plant with another function, A and B as before, and so much of its noise's standard deviation."""
    C, V = (None, None) if plant.full_state else (plant.C, scale**2 * plant.V)
    return Plant(plant.A, plant.B, scale**2 * plant.W, C, V, plant.dt, function=function)


def assert_same(name: str, ticks: int, seed: int) -> None:
    """Check that a loop and the one by hand decide alike, and that the plant bends by more than rounding."""
    found, by_hand, off = compared(name, ticks, 0.5, seed)
    assert (found.sent == by_hand.sent).all()
    assert 0.05 < found.sent.mean() < 0.95
    assert np.abs(found.x - by_hand.x).max() <= 2 * off + 1e-9
    angle = np.abs(found.x[:, 2]).max()
    assert angle > 0.25  # where sin φ and φ differ by more than a percent


@pytest.mark.parametrize("name", few(NAMES, quick=1))
def test_a_loop_decides_as_one_of_scipy_with_the_same_noise(name: str) -> None:
    """Gain, filter and trigger told anew, the equation integrated by an adaptive rule of eighth order to 1e-11."""
    assert_same(name, 200, seed=3)


@pytest.mark.evidence
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", range(2))
def test_long_loops_decide_as_those_of_scipy(name: str, seed: int) -> None:
    """The same over thousands of steps."""
    assert_same(name, 2000, seed)


@pytest.mark.parametrize("examples", [4, pytest.param(25, marks=pytest.mark.evidence)])
def test_a_function_that_is_linear_is_the_linear_plant(examples: int) -> None:
    """Random systems, inputs held or predicted."""
    drawn = {"system": systems(), "model": st.booleans(), "seed": st.integers(0, 2**32 - 1)}
    over(a_linear_function_is_the_linear_plant, examples, **drawn)


def a_linear_function_is_the_linear_plant(system: System, model: bool, seed: int) -> None:
    """Random systems, unstable ones and cross terms included: the same sends, states to rounding; the same costs."""
    plant = system.plant
    same = replaced(plant, lambda x, u, w: plant.A @ x + plant.B @ u + w)
    policy = design.lqg(plant, system.cost, theta=0.3, actuation="model" if model else "hold")
    loops = [close(one, policy) for one in (plant, same)]
    assert [loop.nominal for loop in loops] == [True, False]
    draws = np.random.default_rng(seed)
    w = draws.multivariate_normal(np.zeros(plant.states), plant.W, 60, check_valid="ignore")
    v = draws.multivariate_normal(np.zeros(plant.outputs), plant.V, 60, check_valid="ignore")
    linear, function = (told_by_the_loop(loop, w, v) for loop in loops)
    assert (linear.sent == function.sent).all()
    size = np.abs(linear.x).max()
    np.testing.assert_allclose(function.x, linear.x, rtol=0, atol=1e-9 * size)
    programs = [loop.program().keep({"cost"}) for loop in loops]
    costs = [run(p, loop.start(p, 8, seed % 1000), 50).sums["cost"] for p, loop in zip(programs, loops, strict=True)]
    np.testing.assert_allclose(costs[1], costs[0], rtol=1e-7)


def scaled(name: str, scale: float) -> tuple[Loop, Loop]:
    """Return the loop of a built-in problem with so much of its noise, and that of its linearisation."""
    problem = load(name)
    plant = problem.plant
    assert isinstance(plant, Plant)
    policy = design.lqg(replaced(plant, None, scale), problem.cost, theta=0.5)
    function, linear = (close(replaced(plant, one, scale), policy) for one in (plant.function, None))
    return function, linear


@pytest.mark.parametrize("name", few(NAMES, quick=1, start=1))
def test_under_little_noise_the_cost_is_that_of_the_linearisation(name: str) -> None:
    """Cost / noise² tends to the linear one, and what it is off by shrinks with noise²: on common draws."""
    off, spread = [], []
    for scale in (4.0, 2.0):
        function, linear = scaled(name, scale)
        found = difference(function, linear, seed=1, steps=2_000_000).cost
        cost = average(linear, seed=1, steps=500_000).cost.value
        off.append(found.value / cost / scale**2)
        spread.append(found.standard_error / cost / scale**2)
    assert abs(off[0]) < 0.05
    assert off[0] != 0.0
    bend = 0.2 * abs(off[0])  # of the next order in the noise
    assert abs(off[0] - off[1]) <= 4 * float(np.hypot(*spread)) + bend


def test_losses_clips_missions_single_precision_and_threads_go_with_a_function() -> None:
    """One loop with all of it; threads change nothing, and single precision changes the cost by its errors."""
    problem = load("pendulum-on-a-cart")
    plant = problem.plant
    assert isinstance(plant, Plant)
    clipped = Plant(
        plant.A, plant.B, plant.W, dt=plant.dt, covariance=1e-3 * np.eye(4), input_limit=[3.0], function=plant.function
    )
    policy = problem.design()
    network = Network("udp", actuator_loss=0.05)
    mission = close(clipped, policy, network, Cost(problem.cost.Q, problem.cost.R, horizon=50))
    assert len(mission.violated_assumptions) >= 4
    found = [average(mission, seed=2, steps=400_000, threads=threads).cost for threads in (1, 2)]
    assert found[0] == found[1]
    single = average(replace(mission, precision="float32"), seed=2, steps=400_000).cost
    assert abs(single.value - found[0].value) <= 4 * np.hypot(single.standard_error, found[0].standard_error)


def edge(x: Any, u: Any, w: Any) -> Any:
    """Return the state after a step of a plant that ends at 1."""
    return 1.2 * x * np.sqrt(1.0 - x * x) + u + w


RUNS: dict[str, Callable[[Loop], object]] = {
    "average": lambda loop: average(loop, steps=100_000),
    "simulate": lambda loop: simulate(loop, 5000),
    "course": lambda loop: course(loop, 500, paths=64),
    "bank": lambda loop: Bank([loop] * 8).run(2000),
    "difference": lambda loop: difference(loop, loop, steps=100_000),
}


@pytest.mark.parametrize("name", RUNS)
def test_whatever_runs_a_loop_tells_where_its_function_ends(name: str) -> None:
    """With the state that is no number and the one it came from, which is beyond the end."""
    plant = Plant([[1.2]], [[1.0]], [[0.1]], function=edge)
    loop = close(plant, design.lqg(plant, Cost([[1.0]], [[1.0]]), theta=0.3))
    with pytest.raises(
        UnstableError, match=r"the plant's function returns no finite number as state 1 in the loop of lqg, from x"
    ) as told:
        RUNS[name](loop)
    assert abs(float(str(told.value).split("x = [")[1].split("]")[0])) >= 1.0
