"""References: what fits a plant, and that tracking one is controlling the deviation from it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from counts import few
from drawn import law
from hypothesis import strategies as st

from taciturn import Cost, Network, Plant, Policy, ProblemError, Reference, average, close, design
from taciturn.loop import Loop
from taciturn.model.steps import ONE, Assign, Draw, Evaluate, Received, Send
from taciturn.model.trigger import Form
from taciturn.program import numpy as interpreter
from taciturn.program.numpy import Run
from taciturn.program.ops import Entry, Sent
from taciturn.simulation.average import plain_average

SEEDS = st.integers(0, 2**32 - 1)
A, B = np.array([[1.0, 0.1], [0.0, 1.02]]), np.array([[0.005], [0.1]])
STEPS = 30
COST = Cost(np.diag([1.0, 0.3]), [[0.2]], horizon=STEPS, terminal=np.diag([40.0, 5.0]))
NETWORKS = [Network("udp", 0.3, 0.2), Network("udp", 0.3, 0.2, 1), Network("tcp", 0.3, 0.2), Network()]
networks = pytest.mark.parametrize("network", few(NETWORKS, quick=2), ids=["udp", "udp late", "tcp", "ideal"])


def refusal(action: Callable[[], object]) -> str:
    """Return the sentence with which an action is refused."""
    with pytest.raises(ProblemError) as found:
        action()
    return str(found.value)


def motion(seed: int, steps: int = STEPS, size: float = 3.0) -> Reference:
    """Return a random motion of the plant."""
    draws = np.random.default_rng(seed)
    inputs, states = size * draws.normal(size=(steps, 1)), [size * draws.normal(size=2)]
    for push in inputs:
        states.append(A @ states[-1] + B @ push)
    return Reference(states, inputs)


def plant(mean: np.ndarray | None = None, noise: float = 0.02) -> Plant:
    """Return the plant of these tests with an uncertain start."""
    return Plant(A, B, noise * np.eye(2), mean=mean, covariance=0.1 * np.eye(2))


def test_a_reference_is_frozen_and_its_own() -> None:
    """States at N + 1 times, inputs at N; neither can be written to, or changed from outside."""
    inputs, states = np.zeros((3, 1)), np.zeros((4, 2))
    reference = Reference(states, inputs)
    for held, given_ in ((reference.states, states), (reference.inputs, inputs)):
        assert held.shape == given_.shape
        assert not np.shares_memory(held, given_)
        with pytest.raises(ValueError, match="read-only"):
            held[...] = 7


SIZES = "expected the shape (4, any) = (steps + 1, states)"
SHORT, PUSH = np.zeros((4, 2)), np.zeros((3, 1))


@pytest.mark.parametrize(
    ("states", "inputs", "sentence"),
    [
        (np.zeros((3, 2)), PUSH, "reference.states has shape (3, 2); " + SIZES),
        (np.zeros((5, 2)), PUSH, "reference.states has shape (5, 2); " + SIZES),
        (np.zeros(4), PUSH, "reference.states has shape (4,); " + SIZES),
        (SHORT, np.zeros(3), "reference.inputs has shape (3,); expected the shape (any, any) = (steps, inputs)"),
        (
            SHORT * np.nan,
            PUSH,
            "reference.states contains the number nan at index (0, 0); expected an array of finite numbers",
        ),
        (
            SHORT,
            [[0], [np.inf], [0]],
            "reference.inputs contains the number inf at index (1, 0); expected an array of finite numbers",
        ),
        (
            [[0, 0], [0]],
            [[0]],
            "reference.states has rows of different lengths: row 2 has 1 entry, and row 1 has 2 entries; expected rows",
        ),
        (
            "abc",
            [[0]],
            "reference.states is not an array of numbers (it contains str values); expected an array of the shape",
        ),
    ],
    ids=["too few", "too many", "flat", "flat inputs", "nan", "inf", "ragged", "text"],
)
def test_what_is_no_reference_is_refused(states: Any, inputs: Any, sentence: str) -> None:
    """Lengths that do not fit, and entries that are no numbers."""
    assert refusal(lambda: Reference(states, inputs)).startswith(sentence)


@pytest.mark.parametrize(
    ("reference", "sentence"),
    [
        (
            Reference(SHORT, PUSH),
            "reference.inputs has shape (3, 1); expected the shape (30, 1), from the horizon and the dimensions of the",
        ),
        (
            Reference(np.zeros((32, 2)), np.zeros((31, 1))),
            "reference.inputs has shape (31, 1); expected the shape (30, 1), from",
        ),
        (
            Reference(np.zeros((31, 2)), np.zeros((30, 2))),
            "reference.inputs has shape (30, 2); expected the shape (30, 1), from",
        ),
        (
            Reference(np.zeros((31, 3)), np.zeros((30, 1))),
            "reference.states has shape (31, 3); expected the shape (31, 2), from",
        ),
    ],
    ids=["short", "long", "two inputs", "three states"],
)
def test_a_reference_of_another_size_is_refused(reference: Reference, sentence: str) -> None:
    """Horizon, states and inputs are those of the finite-horizon run, for the plant and for the design."""
    assert refusal(lambda: reference.check(plant(), STEPS)).startswith(sentence)
    assert refusal(lambda: design.lossy_lqg(plant(), COST, price=1, reference=reference)).startswith(sentence)


@law(2, 25, seed=SEEDS, size=st.floats(1e-6, 1e6))
def test_states_written_with_eleven_digits_are_a_motion_and_with_eight_are_none(seed: int, size: float) -> None:
    """Each step is tested alone, so an unstable plant that is pushed for long needs no more digits than another."""
    unstable, steps = Plant([[1.3]], [[1.0]], [[0.01]]), 200
    states = np.append(size * np.random.default_rng(seed).uniform(-1, 1, size=steps), size)[:, None]
    inputs = states[1:] - 1.3 * states[:-1]
    for digits in (11, 8):
        written = Reference(np.round(states / size, digits) * size, inputs)
        if digits == 11:
            written.check(unstable, steps)
            cost = Cost([[1.0]], [[1.0]], horizon=steps)
            policy = design.lossy_lqg(unstable, cost, price=1, reference=written)
            assert policy.tracking.final == written.states[-1]
        else:
            assert "differs by" in refusal(lambda written=written: written.check(unstable, steps))


def test_a_reference_that_stands_still_at_zero_fits() -> None:
    """Zero states and zero inputs: nothing to compare with, and nothing missed."""
    Reference(np.zeros((STEPS + 1, 2)), np.zeros((STEPS, 1))).check(plant(), STEPS)


def test_a_reference_that_the_plant_cannot_follow_is_refused_at_the_first_step_that_misses() -> None:
    """A single wrong state is named by its step and by how much it is off."""
    exact = motion(1)
    for step in (1, 17, STEPS):
        wrong = np.array(exact.states)
        wrong[step, 1] += 0.5
        told = refusal(
            lambda wrong=wrong: design.lossy_lqg(plant(), COST, price=1, reference=Reference(wrong, exact.inputs))
        )
        assert told.startswith(f"reference.states differs by 0.5 at step {step} from A r + B f of step {step - 1}")
    late = np.roll(exact.inputs, 1)
    assert "differs by" in refusal(lambda: Reference(exact.states, late).check(plant(), STEPS))


def test_a_reference_without_an_end_is_refused() -> None:
    """An average has no last step."""
    endless = Cost(COST.Q, COST.R)
    told = refusal(lambda: design.lossy_lqg(plant(), endless, price=1, reference=motion(1)))
    assert (
        told == "a reference trajectory is given without cost.horizon; expected cost.horizon as well, because the "
        "trajectory is finite"
    )


def tracked(reference: Reference | None, network: Network, off: np.ndarray, price: float = 0.5) -> Loop:
    """Return the loop that follows a reference, its mean start off by so much; None: one that regulates to zero."""
    start = off if reference is None else reference.states[0] + off
    policy = design.lossy_lqg(plant(start), COST, price=price, network=network, reference=reference)
    return close(plant(start), policy)


def ran(loop: Loop, seed: int = 3, paths: int = 300) -> tuple[Run, np.ndarray]:
    """Return a finite-horizon run of many paths, and the states from first to last, (steps + 1, n, paths)."""
    program = loop.program()
    run = interpreter.run(program, loop.start(program, paths, seed), STEPS)
    last = [row for row, state in zip(run.states, program.states, strict=True) if state.name == "x"]
    path = np.stack([run.outputs[Entry("x", 0)], run.outputs[Entry("x", 1)]], axis=1)
    return run, np.concatenate([path, np.array(last)[None]])


OFF = np.array([0.5, -0.3])


@networks
def test_the_law_of_the_deviation_does_not_depend_on_the_reference(network: Network) -> None:
    """On the same draws the same packets are sent and lost, and the states differ by the reference."""
    zero, x = ran(tracked(None, network, OFF))
    assert 0.1 < zero.outputs[Sent("actuator")].mean() < 0.95
    for seed in (1, 2):
        reference = motion(seed)
        run, y = ran(tracked(reference, network, OFF))
        for name in (Sent("actuator"), Received("actuator"), Received("sensor")):
            assert np.array_equal(run.outputs[name], zero.outputs[name]), name
        assert y - reference.states[:, :, None] == pytest.approx(x, abs=1e-11)
        pushed = run.outputs[Entry("applied", 0)] - reference.inputs
        assert pushed == pytest.approx(zero.outputs[Entry("applied", 0)], abs=1e-10)
        for name in ("cost", "excess"):
            assert run.sums[name] == pytest.approx(zero.sums[name], rel=1e-9, abs=1e-9)


@networks
def test_tracking_costs_what_regulating_costs(network: Network) -> None:
    """All-time cost and guarantees are those of the deviation."""
    zero, other = tracked(None, network, OFF).policy, tracked(motion(1), network, OFF).policy
    assert other.cost_all_time == pytest.approx(zero.cost_all_time, rel=1e-12)
    assert other.guarantee.cost == pytest.approx(zero.guarantee.cost, rel=1e-12)
    assert other.guarantee.at_rate(0.3) == pytest.approx(zero.guarantee.at_rate(0.3), rel=1e-12)


@networks
def test_the_final_weight_counts_from_the_end_of_the_reference(network: Network) -> None:
    """The plain total with its terminal weight is that of the paths, and its mean that of the exact identity."""
    loop, reference = tracked(motion(4, size=10.0), network, OFF), motion(4, size=10.0)
    assert loop.policy.tracking.final == pytest.approx(reference.states[-1], rel=1e-12)
    plain = average(loop, plain_average(loop), seed=5, steps=4096 * STEPS)
    exact = average(loop, seed=6, steps=4096 * STEPS)
    spread = np.hypot(plain.cost.standard_error, exact.cost.standard_error)
    assert abs(plain.cost.value - exact.cost.value) <= 4 * spread
    run, x = ran(loop, seed=5, paths=4096)
    e = x - reference.states[:, :, None]
    v = run.outputs[Entry("applied", 0)] - reference.inputs
    total = np.einsum("kip,ij,kjp->p", e[:-1], COST.Q, e[:-1]) + COST.R[0, 0] * (v * v).sum(axis=0)
    total += np.einsum("ip,ij,jp->p", e[-1], COST.terminal, e[-1])
    assert plain.cost.value == pytest.approx(total.mean(), rel=1e-9)
    assert exact.cost.value <= loop.policy.guarantee.cost


def test_another_plant_follows_the_reference_by_its_own_dynamics() -> None:
    """Closed with the plant that is there, x⁺ = A x + B u is that plant's, and no theory is claimed."""
    reference = motion(1)
    policy = tracked(reference, NETWORKS[0], OFF).policy
    actual = Plant(A + np.array([[0.0, 0.02], [-0.03, 0.0]]), 0.9 * B, np.zeros((2, 2)), mean=reference.states[0] + OFF)
    loop = close(actual, policy)
    assert not loop.nominal
    assert set(loop.violated_assumptions) >= {"the plant is not the one of the design"}
    run, x = ran(loop)
    u = run.outputs[Entry("applied", 0)][:, None]
    assert x[1:] == pytest.approx(np.einsum("ij,kjp->kip", actual.A, x[:-1]) + actual.B[None] * u, abs=1e-10)
    assert "excess" not in run.sums
    e = x[:-1] - reference.states[:-1, :, None]
    v = u[:, 0] - reference.inputs
    stage = np.einsum("kip,ij,kjp->p", e, COST.Q, e) + COST.R[0, 0] * (v * v).sum(axis=0)
    assert run.sums["cost"] == pytest.approx(stage, rel=1e-10)
    assert np.abs(e[-1]).max() < 20


def test_a_mission_of_another_length_is_refused() -> None:
    """The reference ends where the finite-horizon run ends."""
    policy = tracked(motion(1), NETWORKS[0], OFF).policy
    told = refusal(lambda: close(plant(), policy, cost=Cost(COST.Q, COST.R, horizon=STEPS + 1)))
    assert told == "cost.horizon is 31, but the reference has 30 steps; expected a horizon as long as the reference"
    other = Cost(2 * COST.Q, COST.R, horizon=STEPS)
    assert "the cost is not the one of the design" in close(policy.model, policy, cost=other).violated_assumptions


SITES = (frozenset({"sensor", "controller"}),)
WRONG = [
    Assign("controller", ONE, {"y": np.eye(1, 2)}),
    Draw("controller", ONE),
    Evaluate("controller", ONE, (Form(),)),
]


@pytest.mark.parametrize("step", WRONG, ids=lambda step: type(step).__name__)
def test_the_number_one_cannot_be_assigned(step: Any) -> None:
    """It is known at every node, and no step may make it another."""
    steps = (
        Assign("controller", "command", {"y": np.zeros((1, 2))}),
        Send("controller", "actuator", ("command",)),
        Assign("actuator", "input", ({"input": [[1.0]]}, {"command": [[1.0]], ONE: [[0.5]]}), Received("actuator")),
    )
    assert close(plant(), Policy("pushes", steps, plant(), sites=SITES), cost=COST).policy.sizes[ONE] == 1
    told = refusal(lambda: Policy("wrong", (*steps, step), plant()))
    assert told == "a policy step assigns 'one', but this name denotes the number 1; expected another name"
