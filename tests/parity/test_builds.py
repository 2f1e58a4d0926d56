"""The bit-exact build has the bits of NumPy; the fast build decides as the bit-exact build does."""

from __future__ import annotations

import numpy as np
import pytest
from catalogue import CLOSED_FORM, POLICIES, STATIONARY, closed
from counts import few, scaled
from drawn import law
from hypothesis import strategies as st
from parity.loops import assert_parity, every_feature, programs, same, with_functions, with_precision
from systems import System, make_system, systems, well_posed

import taciturn
from taciturn import Network, design
from taciturn.errors import TaciturnError
from taciturn.loop import Loop
from taciturn.program.ir import Program
from taciturn.program.machine import Kernel, host
from taciturn.program.ops import Entry, Option, Precision, Sent, is_entry

SEEDS = st.integers(0, 2**32 - 1)
PRECISIONS = st.sampled_from(["float64", "float32"])
MASSES = {
    "hold": {},
    "model": {"actuation": "model"},
    "separate": {"trigger": "separate"},
    "separate model": {"trigger": "separate", "actuation": "model"},
    "always": {"theta": 0.0},
}


def masses(name: str) -> Loop:
    """Return a loop of the two masses."""
    problem = taciturn.load("two-mass-lqg")
    if name == "periodic":
        policy = design.periodic(problem.plant, problem.cost, every=3, actuation="model")
    elif name == "lossy":
        return taciturn.close(problem.plant, problem.design(), Network("udp", 0.2), problem.cost)
    elif name == "limited":
        plant = problem.plant
        small = taciturn.Plant(plant.A, plant.B, plant.W, plant.C, plant.V, plant.dt, input_limit=[0.3])
        return taciturn.close(small, problem.design(), problem.network, problem.cost)
    else:
        policy = problem.changed(MASSES[name]).design()
    return problem.close(policy)


@pytest.mark.parametrize("name", few([*MASSES, "periodic", "lossy", "limited"], quick=3))
def test_the_loops_of_the_two_masses_agree_bit_for_bit(name: str) -> None:
    """Hold and model, joint and separate, by the clock, over a lossy link, saturating; with the plant and without."""
    loop = masses(name)
    for program in programs(loop):
        assert_parity(loop, program, seed=5, paths=37, ticks=300)  # more than a window of sums


def close_random(system: System, name: str) -> Loop | None:
    """Return the loop of a policy of the catalogue, or None where the system has none."""
    try:
        return closed(POLICIES[name](system))
    except TaciturnError:
        return None


@law(5, 70, system=systems(), name=st.sampled_from(sorted(POLICIES)), seed=SEEDS, precision=PRECISIONS)
def test_loops_of_random_systems_agree_bit_for_bit(system: System, name: str, seed: int, precision: Precision) -> None:
    """Unstable plants, cross terms, several inputs, every policy of the catalogue, in either precision."""
    loop = close_random(system, name)
    if loop is not None:
        loop = with_precision(loop, precision)
        for program in programs(loop):
            assert_parity(loop, program, seed)


@law(5, 60, system=systems(), seed=SEEDS, precision=PRECISIONS)
def test_losses_schedules_memories_draws_and_three_labels_agree_bit_for_bit(
    system: System, seed: int, precision: Precision
) -> None:
    """Everything a policy may be made of, at once."""
    loop = with_precision(every_feature(system, seed), precision)
    assert_parity(
        loop, loop.program(), seed, ticks=40 if precision == "float64" else 12
    )  # unstable: floats end at 1e38


@law(2, 25, system=systems(states=4), seed=SEEDS, precision=PRECISIONS)
def test_steps_that_are_functions_agree_bit_for_bit(system: System, seed: int, precision: Precision) -> None:
    """An extended Kalman filter, a trigger and an input made of sines, roots and exponentials."""
    loop = with_precision(with_functions(system, seed), precision)
    assert_parity(loop, loop.program(), seed, ticks=40 if precision == "float64" else 12)


@pytest.mark.evidence
def test_loops_of_three_hundred_random_systems_agree_bit_for_bit() -> None:
    """In turn every policy of the catalogue, and on each the policy with every feature; in single precision in turn."""
    found, draws = 0, np.random.default_rng(2024)
    while found < scaled(300, 2 * len(POLICIES)):  # each kind in turn, in both precisions
        n = int(draws.integers(1, 7))
        m, p = int(draws.integers(1, min(n, 3) + 1)), int(draws.integers(1, n + 1))
        system = make_system(int(draws.integers(2**32)), n, m, p, bool(draws.integers(2)))
        if not (well_posed(system.plant.A, system.plant.B) and well_posed(system.plant.A.T, system.plant.C.T)):
            continue
        loops = [close_random(system, sorted(POLICIES)[found % len(POLICIES)]), every_feature(system, found)]
        for loop in loops:
            for program in [] if loop is None else programs(loop):
                assert_parity(loop, program, found, paths=19)
        # round by round of the catalogue, so that each of its kinds has its turn
        single = loops[found // len(POLICIES) % 2]
        if single is not None:
            single = with_precision(single, "float32")
            assert_parity(single, single.program(), found, paths=19, ticks=12)
        found += loops[0] is not None


def undrawn(monkeypatch: pytest.MonkeyPatch, loop: Loop) -> Program:
    """Return the program of a loop whose draws are inputs."""
    monkeypatch.setattr("taciturn.loop.with_draws", lambda program, uniforms: program)
    return loop.program()


def assert_same_decisions(program: Program, loop: Loop, seed: int, ticks: int = 12_500) -> float:
    """Check the decisions of both builds on eight paths and the same draws, up to ties; return the rate of sending.

    After a tie that fell differently a path is another one, and no more is asked of it. On a processor without fused
    multiply-adds the two builds agree in every bit.
    """
    inputs = np.random.default_rng(seed).normal(size=(ticks, len(program.inputs), 8))
    states = loop.start(program, 8, seed)
    parity, fast = (Kernel(program, build).run(program, states, ticks, inputs).outputs for build in ("parity", "fast"))
    sent = Sent("actuator")
    differ = parity[sent] != fast[sent]
    for path in np.flatnonzero(differ.any(axis=0)):
        tick = int(np.argmax(differ[:, path]))
        options = [outputs[tick, path] for name, outputs in parity.items() if isinstance(name, Option)]
        assert abs(options[0] - options[1]) < 1e-10 * max(map(abs, options))
    assert same(parity[Entry("x", 0)], fast[Entry("x", 0)]) == ("+fma" not in host().features.split(","))
    return float(parity[sent].mean())


@pytest.mark.parametrize("name", few(["hold", "model", "separate"], quick=1, start=1))
def test_the_fast_build_decides_as_the_parity_build(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Over 1e5 steps on the same draws, except where trigger and threshold agree to 1e-10."""
    loop = masses(name)
    assert 0.1 < assert_same_decisions(undrawn(monkeypatch, loop), loop, seed=8) < 0.9


@law(2, 25, system=systems(), seed=SEEDS)
def test_the_fast_build_decides_as_the_parity_build_with_every_feature(system: System, seed: int) -> None:
    """Among three labels, by memories, draws, locations and what links lose: up to the first tie of each path."""
    loop = every_feature(system, seed)
    with pytest.MonkeyPatch.context() as patch:
        program = undrawn(patch, loop)
    ticks, draws = 60, np.random.default_rng(seed)
    uniform = np.array([is_entry(name, "uniform") for name in program.inputs])
    inputs = np.where(
        uniform[:, None], draws.random((ticks, len(uniform), 8)), draws.normal(size=(ticks, len(uniform), 8))
    )
    states = loop.start(program, 8, seed)
    parity, fast = (Kernel(program, build).run(program, states, ticks, inputs).outputs for build in ("parity", "fast"))
    labels = [name for name in parity if isinstance(name, Option)]
    chosen = [np.argmin([outputs[name] for name in labels], axis=0) for outputs in (parity, fast)]
    for path in np.flatnonzero((chosen[0] != chosen[1]).any(axis=0)):
        tick = int(np.argmax(chosen[0][:, path] != chosen[1][:, path]))
        first, second, *_ = sorted(parity[name][tick, path] for name in labels)
        size = max(abs(parity[name][: tick + 1, path]).max() for name in labels)
        assert abs(first - second) < 1e-10 * size


@law(2, 8, system=systems(), name=st.sampled_from(sorted(set(STATIONARY) - set(CLOSED_FORM))), seed=SEEDS)
def test_the_fast_build_decides_as_the_parity_build_on_random_systems(system: System, name: str, seed: int) -> None:
    """Over 1e5 steps of each."""
    loop = close_random(system, name)
    if loop is not None:
        with pytest.MonkeyPatch.context() as patch:
            program = undrawn(patch, loop)
        if program.inputs:
            assert_same_decisions(program, loop, seed)
