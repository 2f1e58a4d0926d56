"""Poisson jumps within a step: the flow of each exactly, their number and their covariance."""

from __future__ import annotations

import numpy as np
import pytest
from counts import few
from scipy.linalg import expm, sqrtm

from taciturn import ContinuousPlant, Cost, Jumps, Plant, ProblemError, average, close, design
from taciturn.lqg.prediction import prediction_cost
from taciturn.model.plant import JumpNoise
from taciturn.program import numpy as interpreter
from taciturn.program.ir import Builder, Program
from taciturn.program.ops import Entry, named
from taciturn.program.signals import add_jumps
from taciturn.program.translation import TimeStep
from taciturn.simulation.average import completed_squares, plain_average

PLANTS = {
    "double integrator": [[0.0, 1.0], [0.0, 0.0]],
    "unstable spiral": [[0.4, 3.0], [-3.0, 0.4]],
    "fast and slow": [[-8.0, 1.0], [0.0, 0.2]],
    "scalar": [[0.7]],
}


def program_of(noise: JumpNoise) -> Program:
    """Return the program of what one step adds, before its draws are drawn inside."""
    tick = TimeStep(Builder(), {}, {}, ())
    return tick.finish({}, named("w", add_jumps(tick, noise)))


@pytest.mark.parametrize("name", PLANTS)
def test_every_jump_flows_to_the_end_of_its_tick(name: str) -> None:
    """Given waiting times and sizes, against matrix exponentials; what comes after the step adds nothing."""
    A = np.array(PLANTS[name])
    n, period, rate = len(A), 0.8, 3.0
    spread = np.diag(np.arange(1.0, n + 1))
    program = program_of(JumpNoise(A, Jumps(rate, spread @ spread.T), period))
    draws = np.random.default_rng(1)
    drawn = {"uniform": lambda: draws.uniform(0.05, 1, 200), "normal": lambda: draws.normal(size=200)}
    given = np.array([drawn[name.signal]() for name in program.inputs])
    found = interpreter.run(program, np.zeros((0, 200)), 1, given[None])
    uniforms = [row for row, name in zip(given, program.inputs, strict=True) if name.signal == "uniform"]
    normals = [row for row, name in zip(given, program.inputs, strict=True) if name.signal == "normal"]
    wanted = np.zeros((n, 200))
    for path in range(200):
        time = 0.0
        for i, uniform in enumerate(uniforms):
            time += -np.log(uniform[path]) / rate
            if time < period:
                size = spread @ [normal[path] for normal in normals[n * i : n * (i + 1)]]
                wanted[:, path] += expm(A * (period - time)) @ size
    got = np.array([found.outputs[Entry("w", i)][0] for i in range(n)])
    assert got == pytest.approx(wanted, abs=1e-7 * np.abs(wanted).max())  # the logarithm has nine digits


def test_more_jumps_than_are_drawn_are_refused() -> None:
    """A step of a hundred jumps is close to Wiener noise, and the sentence says so."""
    with pytest.raises(ProblemError, match=r"a step of 10 s has 100 jumps on average, too many .* or Wiener noise"):
        program_of(JumpNoise(np.zeros((1, 1)), Jumps(10.0, [[1.0]]), 10.0))


@pytest.mark.parametrize("distribution", few(["normal", "uniform", "two-point"], quick=1))
def test_a_loop_that_always_sends_has_the_cost_of_the_covariance(distribution) -> None:
    """Second moments decide the cost of linear control, whatever the law of the jumps."""
    covariance = np.array([[0.2, 0.1], [0.1, 0.5]])
    plant = ContinuousPlant([[0.0, 1.0], [0.5, 0.0]], [[0.0], [1.0]], jumps=Jumps(2.0, covariance, distribution))
    cost = Cost(np.eye(2), [[1.0]])
    policy = design.periodic(plant, cost, period=0.5)
    loop = close(plant, policy)
    assert loop.nominal
    found = average(loop, plain_average(loop), seed=4, steps=6_000_000)
    assert policy.theory.closed_form is not None
    assert abs(found.cost.value - policy.theory.closed_form.cost) <= 4 * found.cost.standard_error
    assert found.cost.standard_error < 0.005 * found.cost.value


@pytest.mark.evidence
def test_the_identity_holds_under_jumps_with_the_full_state_and_is_not_claimed_with_a_filter() -> None:
    """White noise is all that completion of squares needs where the state is known; a filter needs Gaussian noise."""
    jumps = Jumps(1.5, np.diag([0.1, 0.4]))
    cost = Cost(np.eye(2), [[0.5]])
    plant = ContinuousPlant([[0.0, 1.0], [0.0, -0.2]], [[0.0], [1.0]], jumps=jumps)
    loop = close(plant, design.lqg(plant, cost, theta=0.5, period=0.3))
    assert loop.nominal
    exact, plain = (
        average(loop, make(loop), seed=seed, steps=6_000_000)
        for seed, make in ((1, completed_squares), (2, plain_average))
    )
    spread = np.hypot(exact.cost.standard_error, plain.cost.standard_error)
    assert abs(exact.cost.value - plain.cost.value) <= 4 * spread
    watched = ContinuousPlant([[0.0, 1.0], [0.0, -0.2]], [[0.0], [1.0]], jumps=jumps, C=[[1.0, 0.0]], V=[[0.01]])
    assert close(watched, design.lqg(watched, cost, theta=0.5, period=0.3)).violated_assumptions == (
        "the noise has jumps, but the filter's theory assumes Gaussian noise",
    )
    always = close(watched, design.all_time(watched, cost, period=0.3))
    assert always.nominal
    assert not always.reducible


def test_a_plant_with_jumps_has_the_intensity_of_their_rate_when_it_is_sampled() -> None:
    """The covariance of a step is that of Wiener noise with W = rate · covariance."""
    jumps = Jumps(5.0, np.diag([0.0, 0.5]))
    plant = ContinuousPlant([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], jumps=jumps)
    model = design.consistent(plant, Cost(np.eye(2), [[10.0]]), period=0.4).model
    price = prediction_cost(plant.A, plant.B, np.eye(2), [[10.0]], np.zeros((2, 1)), 5.0 * jumps.covariance)
    assert isinstance(model, Plant)
    assert pytest.approx(price.spread(0.4), rel=1e-12) == model.W


@pytest.mark.parametrize("distribution", ["uniform", "two-point"])
def test_jumps_do_not_depend_on_the_order_of_the_states_or_their_units(distribution: str) -> None:
    """A jump is Gξ with independent ξ: renumbered states have the rows and columns of G in the new order."""
    draws = np.random.default_rng(4)
    for n in (2, 3, 4):
        half = draws.normal(size=(n, n))
        covariance, order, units = half @ half.T, draws.permutation(n), 10.0 ** draws.integers(-3, 4, n)
        G = Jumps(1.0, covariance, distribution).spread  # type: ignore[arg-type]
        assert pytest.approx(covariance, rel=1e-9, abs=1e-12) == G @ G.T
        other = Jumps(1.0, covariance[np.ix_(order, order)], distribution).spread  # type: ignore[arg-type]
        assert other == pytest.approx(G[np.ix_(order, order)], rel=1e-9, abs=1e-12)
        scaled = Jumps(1.0, units[:, None] * covariance * units, distribution).spread  # type: ignore[arg-type]
        assert scaled == pytest.approx(units[:, None] * G, rel=1e-9)
        deviations = np.sqrt(np.diag(covariance))
        assert pytest.approx(deviations[:, None] * sqrtm(covariance / np.outer(deviations, deviations)), rel=1e-8) == G
    one = Jumps(1.0, np.outer([2.0, -1.0], [2.0, -1.0]), distribution).spread  # type: ignore[arg-type]
    assert one.shape == (2, 1)
    apart = Jumps(1.0, np.diag([4.0, 0.0, 9.0]), distribution).spread  # type: ignore[arg-type]
    assert apart == pytest.approx(np.array([[2.0, 0.0], [0.0, 0.0], [0.0, 3.0]]))
