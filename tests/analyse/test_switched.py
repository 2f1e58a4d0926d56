"""A loop as a switched linear map is the loop that is simulated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from catalogue import POLICIES, closed
from counts import few
from systems import make_system

import taciturn
from taciturn import Cost, Loop, Network, Plant, ProblemError, close, design
from taciturn._modes import factor, invariant
from taciturn.analyse.switched import Switched, switched, switched_innovations
from taciturn.model.steps import Send
from taciturn.program.numpy import run
from taciturn.program.ops import Entry, Option, is_entry

TICKS, PATHS = 60, 4
SERVED = ("all-time", "lqg joint hold", "lqg joint model", "lqg separate hold", "lqg separate model", "absolute")
SERVED += ("absolute state model", "relative", "mixed model", "send-on-delta", "excess hold", "excess model")
REFUSED = {
    "near-optimal": "the exponential of a quadratic",
    "dynamic": "triggers on credit",
    "stochastic": "has a random threshold",
    "downsampled": "vary with the wait",
    "self-triggered": "4 send decisions",
    "rollout": "rollout",
    "periodic hold": "by the clock",
    "remote": "2 send decisions",
    "lossy udp": "drops packets",
    "lossy tcp, delayed": "drops packets",
    "remote, 30 steps": "horizon",
    "remote, discounted": "horizon",
}


def recorded(loop: Loop, seed: int) -> dict[str, np.ndarray]:
    """Return what the program of a loop shows, (steps, entries, paths) by signal."""
    program = loop.program()
    flat = run(program, loop.start(program, PATHS, seed), TICKS).outputs
    signals = dict.fromkeys(name.signal for name in flat if isinstance(name, Entry))
    shown = {name: np.stack([rows for key, rows in flat.items() if is_entry(key, name)], axis=1) for name in signals}
    if loop.policy.decisions:
        shown["options"] = np.stack([rows for key, rows in flat.items() if isinstance(key, Option)], axis=1)
    return shown


def expect_same(loop: Loop, found: Switched, shown: dict[str, np.ndarray], noise: np.ndarray, state: str) -> None:
    """Iterate z⁺ = F_i z + G w with the noise that was drawn, and compare state, cost and decisions.

    ``noise`` is that by which the state of each step came about, (steps, q, paths); the loop starts at zero.
    """
    problem = loop.problem
    stage = np.block([[problem.Q, problem.N], [problem.N.T, problem.R]])
    z, scale = np.zeros((found.states, PATHS)), np.abs(shown[state]).max()
    taken = np.zeros(PATHS, dtype=int)
    for tick in range(TICKS):
        moved = np.stack([F @ z for F in found.F])[taken, :, np.arange(PATHS)].T
        z = moved + found.G @ noise[tick]
        assert np.abs(found.X @ z - shown[state][tick]).max() < 1e-9 * scale
        values = [np.einsum("ip,ij,jp->p", z, Psi, z) + c for Psi, c in zip(found.Psi, found.c, strict=True)]
        if len(found.labels) > 1:
            options = shown["options"][tick]
            taken = np.argmin(options, axis=0)
            differences = np.stack(values) - values[0] - (options - options[0])
            assert np.abs(differences).max() < 1e-8 * (np.abs(options).max() + scale**2)
        both = np.vstack([shown[state][tick], shown["applied"][tick]])
        spent = np.einsum("ip,ij,jp->p", both, stage, both)
        costs = np.stack([np.einsum("ip,ij,jp->p", z, M, z) for M in found.M])[taken, np.arange(PATHS)]
        assert np.abs(costs - spent).max() < 1e-8 * np.abs(spent).max() + 1e-9 * scale**2


def drawn(loop: Loop, shown: dict[str, np.ndarray]) -> np.ndarray:
    """Return the noise of plant and measurement in directions of unit variance, as it must have been."""
    plant = loop.problem.plant
    x, applied = shown["x"], shown["applied"]
    w = x[1:] - np.einsum("ij,tjp->tip", plant.A, x[:-1]) - np.einsum("ij,tjp->tip", plant.B, applied[:-1])
    w = np.concatenate([np.zeros_like(x[:1]), w])
    parts = [np.einsum("ij,tjp->tip", np.linalg.pinv(factor(plant.W)), w)]
    if plant.V.any():
        v = shown["y"] - np.einsum("ij,tjp->tip", plant.C, x)
        parts.append(np.einsum("ij,tjp->tip", np.linalg.pinv(factor(plant.V)), v))
    return np.concatenate(parts, axis=1)


def same_map_of(name: str, full_state: bool, seeds: int) -> None:
    """State, stage cost and the values of the trigger agree step by step, driven by the noise that was drawn."""
    for seed in range(seeds):
        loop = closed(POLICIES[name](make_system(seed, 2 + seed % 2, 1 + seed % 2, 2, full_state)))
        shown = recorded(loop, seed)
        expect_same(loop, switched(loop), shown, drawn(loop, shown), "x")


@pytest.mark.parametrize("name", SERVED)
def test_the_map_does_what_the_program_does(name: str) -> None:
    """A random system whose state is measured in part."""
    same_map_of(name, False, 1)


@pytest.mark.evidence
@pytest.mark.parametrize("full_state", [True, False])
@pytest.mark.parametrize("name", SERVED)
def test_the_map_does_what_the_program_does_over_five_systems(name: str, full_state: bool) -> None:
    """Random systems, the state measured in full or in part."""
    same_map_of(name, full_state, 5)


def test_packets_with_rounded_numbers_are_refused() -> None:
    """Rounding is not linear."""
    system = make_system(1, 2, 1, 2, True)
    loop = close(system.plant, POLICIES["lqg separate hold"](system), Network(payload="float32"))
    with pytest.raises(ProblemError, match=r"^packets contain rounded numbers \(float32\), which certificates do not"):
        switched(loop)


@pytest.mark.parametrize("name", few([name for name in SERVED if name != "send-on-delta"], quick=3, start=1))
def test_the_innovations_form_does_what_the_filter_does(name: str) -> None:
    """The estimate and what it costs follow from the innovations alone."""
    for seed in range(2):
        loop = closed(POLICIES[name](make_system(seed, 3, 1, 2, False)))
        plant, innovations = loop.problem.plant, loop.policy.theory.innovations
        assert innovations is not None
        shown = recorded(loop, seed)
        estimate, applied = shown["estimate"], shown["applied"]
        prior = np.einsum("ij,tjp->tip", plant.A, estimate) + np.einsum("ij,tjp->tip", plant.B, applied)
        prior = np.concatenate([np.zeros_like(prior[:1]), prior[:-1]])
        surprise = shown["y"] - np.einsum("ij,tjp->tip", plant.C, prior)
        noise = np.einsum("ij,tjp->tip", np.linalg.inv(factor(innovations.covariance)), surprise)
        expect_same(loop, switched_innovations(loop), shown, noise, "estimate")


def test_another_plant_than_that_of_the_design_is_read() -> None:
    """The plant that is simulated stands in the matrices, not the one of the design."""
    system = make_system(3, 3, 1, 2, False)
    plant = system.plant
    policy = design.lqg(plant, system.cost, theta=0.3)
    loop = close(Plant(0.9 * plant.A, plant.B, 2 * plant.W, plant.C, plant.V), policy)
    assert not loop.nominal
    shown = recorded(loop, 1)
    expect_same(loop, switched(loop), shown, drawn(loop, shown), "x")


def test_copies_of_what_the_actuator_holds_are_one_state() -> None:
    """Two masses: x, x̂ and the input held; with a model x, x̂ and its state; the filter's view is without x."""
    problem = taciturn.load("two-mass-lqg")
    for actuation, states in (("hold", 9), ("model", 12)):
        loop = problem.close(problem.changed({"actuation": actuation}).design())
        assert switched(loop).states == states
        assert switched_innovations(loop).states == states - 4


def test_under_one_action_the_loop_is_linear() -> None:
    """Sending always is all-time control: the same state map, whatever the trigger."""
    system = make_system(5, 3, 2, 2, True)
    always = switched(closed(design.all_time(system.plant, system.cost)))
    found = switched(closed(design.lqg(system.plant, system.cost, theta=0.5)))
    assert found.sends == 1
    alone = found.under(1)
    radii = [np.abs(np.linalg.eigvals(F)).max() for F in (always.F[0], alone.F[0])]
    assert abs(radii[0] - radii[1]) < 1e-9
    assert alone.margins(0) == []


def test_invariant_subspaces_are_the_least() -> None:
    """A chain of integrators is reached from its end, and not from its front."""
    chain = np.eye(4, k=1)
    assert invariant(np.eye(4)[:, 3:], [chain]).shape == (4, 4)
    assert invariant(np.eye(4)[:, :1], [chain]).shape == (4, 1)
    assert invariant(np.zeros((4, 0)), [chain]).shape == (4, 0)


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_switched_linear_map_is_refused(name: str) -> None:
    """Drawn thresholds, quadratic memories, tables, losses and finite-horizon runs, each in one sentence."""
    loop = closed(POLICIES[name](make_system(2, 2, 1, 2, True)))
    with pytest.raises(ProblemError, match="which certificates do not support; expected") as refused:
        switched(loop)
    assert REFUSED[name] in str(refused.value)


def test_clipped_inputs_and_packets_of_the_tick_before_are_refused() -> None:
    """A clipped input is not linear, and a delay is a memory of the network."""
    plant, cost = Plant([[1.1]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    policy = design.lqg(plant, cost, theta=0.3)
    with pytest.raises(ProblemError, match="clipped"):
        switched(close(Plant([[1.1]], [[1.0]], [[1.0]], input_limit=[5.0]), policy))
    (send,) = (step for step in policy.steps if isinstance(step, Send))
    late = replace(policy, steps=(*(step for step in policy.steps if step is not send), send))
    with pytest.raises(ProblemError, match="of the previous step"):
        switched(close(plant, late))
    with pytest.raises(ProblemError, match="no innovations form"):
        switched_innovations(close(plant, policy))
