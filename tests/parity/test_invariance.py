"""Results depend on the seed and on nothing else: not on threads, paths, chunks or lanes."""

from __future__ import annotations

import numpy as np
import pytest
from counts import few
from parity.loops import differences, every_feature, same
from systems import make_system

import taciturn
from taciturn.loop import Loop
from taciturn.program import machine
from taciturn.program.machine import Kernel

PATHS, TICKS, SEED = 53, 60, 9
BUILDS = ("parity", "fast")


def masses() -> Loop:
    """Return the loop of the two masses."""
    problem = taciturn.load("two-mass-lqg")
    return problem.close(problem.design())


LOOPS = {"two masses": masses, "every feature": lambda: every_feature(make_system(4, 4, 2, 2, False), 4)}


@pytest.fixture(params=LOOPS)
def loop(request: pytest.FixtureRequest) -> Loop:
    """Return each loop in turn."""
    return LOOPS[request.param]()


@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.parametrize("threads", few([2, 3, 5, 100], quick=2))
def test_threads_do_not_change_a_bit(loop: Loop, build: machine.Build, threads: int) -> None:
    """More threads than processors, and than blocks."""
    program = loop.program()
    kernel, states = Kernel(program, build), loop.start(program, PATHS, SEED)
    alone = kernel.run(program, states, TICKS, threads=1)
    assert differences(alone, kernel.run(program, states, TICKS, threads=threads)) == []


@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.parametrize("fewer", few([1, 2, 7, 8, 9, 52], quick=3))
def test_a_path_does_not_depend_on_how_many_are_run(loop: Loop, build: machine.Build, fewer: int) -> None:
    """The first paths of many are those of few: generators, noise and starts alike."""
    program = loop.program()
    kernel = Kernel(program, build)
    many, few = (kernel.run(program, loop.start(program, paths, SEED), TICKS) for paths in (PATHS, fewer))
    assert same(few.states, many.states[:, :fewer])
    assert all(same(few.sums[name], many.sums[name][:fewer]) for name in few.sums)
    assert all(same(few.outputs[name], many.outputs[name][:, :fewer]) for name in few.outputs)


@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.parametrize("cuts", [(1,), (7, 8, 31), tuple(range(1, TICKS))])
def test_chunks_of_ticks_are_one_run(loop: Loop, build: machine.Build, cuts: tuple[int, ...]) -> None:
    """Records and last states have the same bits; sums are added in another order."""
    program = loop.program()
    kernel, states = Kernel(program, build), loop.start(program, PATHS, SEED)
    whole, chunks = kernel.run(program, states, TICKS), []
    for first, last in zip((0, *cuts), (*cuts, TICKS), strict=True):
        chunks.append(kernel.run(program, states, last - first))
        states = chunks[-1].states
    assert same(states, whole.states)
    for name, record in whole.outputs.items():
        assert same(np.concatenate([chunk.outputs[name] for chunk in chunks]), record)
    for name, total in whole.sums.items():
        size = TICKS * np.abs(total).max() + 1e-300
        assert np.abs(sum(chunk.sums[name] for chunk in chunks) - total).max() < 1e-15 * size


@pytest.mark.parametrize("build", BUILDS)
def test_lanes_do_not_change_a_bit(loop: Loop, build: machine.Build) -> None:
    """Vectors of two to sixteen paths, whatever this processor's own hold."""
    program = loop.program()
    states, results = loop.start(program, PATHS, SEED), []
    for lanes in (2, 4, 8, 16):
        kernel = Kernel(program, build, lanes=lanes)
        assert kernel.lanes == lanes
        results.append(kernel.run(program, states, TICKS))
    assert all(differences(results[0], other) == [] for other in results[1:])


def test_a_run_does_not_touch_the_states_it_starts_from(loop: Loop) -> None:
    """A second run from the same start is the first."""
    program = loop.program()
    kernel, states = Kernel(program), loop.start(program, PATHS, SEED)
    before = states.tobytes()
    assert differences(kernel.run(program, states, TICKS), kernel.run(program, states, TICKS)) == []
    assert states.tobytes() == before


def test_states_in_any_memory_order_are_read_alike(loop: Loop) -> None:
    """Transposed and strided arrays of states."""
    program = loop.program()
    kernel, states = Kernel(program), loop.start(program, PATHS, SEED)
    expected = kernel.run(program, states, TICKS)
    for arranged in (np.asfortranarray(states), np.repeat(states, 2, axis=1)[:, ::2]):
        assert differences(kernel.run(program, arranged, TICKS), expected) == []
