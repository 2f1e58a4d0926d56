"""Programs with the function of a plant in them: the bit-exact build agrees with NumPy, the fast one decides alike."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from counts import few
from drawn import law
from hypothesis import strategies as st
from parity.loops import assert_parity
from systems import System, systems

from taciturn import Loop, Network, Plant, close, design, load
from taciturn.model.steps import Received
from taciturn.program import numpy as interpreter
from taciturn.program.machine import Kernel
from taciturn.program.ops import Entry, Precision, Sent
from taciturn.program.python import compile_python

NAMES = ("pendulum-on-a-cart", "pendulum-by-encoders", "omni-heading")


def built_in(name: str, precision: Precision) -> Loop:
    """Return the loop of a built-in problem over a link that drops packets."""
    problem = load(name)
    return replace(close(problem.plant, problem.design(), Network("udp", 0.02), problem.cost), precision=precision)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("name", few(NAMES, quick=1))
def test_loops_with_a_function_agree_bit_for_bit(name: str, precision: Precision) -> None:
    """Sines, quotients and Runge–Kutta steps, in either precision."""
    loop = built_in(name, precision)
    assert_parity(loop, loop.program(), seed=3, paths=19, ticks=300)


@law(2, 25, system=systems(states=4), seed=st.integers(0, 2**32 - 1), precision=st.sampled_from(["float64", "float32"]))
def test_random_functions_agree_bit_for_bit(system: System, seed: int, precision: Precision) -> None:
    """Of sines, exponentials, roots, quotients, clips and choices; linear at 0 as the random plant."""
    draws, linear = np.random.default_rng(seed), system.plant
    P = 0.3 * draws.normal(size=(linear.states, linear.states))

    def bent(x: Any, u: Any, w: Any) -> Any:
        moved = linear.A @ np.sin(x) + linear.B @ np.tanh(u) + w
        curved = np.cos(P @ x) - 1.0 + np.sqrt(1.0 + x * x) - 1.0
        return np.where(x > 0.5, np.minimum(moved, 3.0), moved) + 0.1 * curved / (1.0 + np.exp(-x[0]))

    C, V = (None, None) if linear.full_state else (linear.C, linear.V)
    plant = Plant(linear.A, linear.B, linear.W, C, V, input_limit=np.ones(linear.inputs), function=bent)
    loop = replace(close(plant, design.lqg(linear, system.cost, theta=0.3)), precision=precision)
    program = loop.program()
    states = loop.start(program, 9, seed % 1000)
    meaning = interpreter.run(program, states, 30)
    found = Kernel(program, "parity").run(program, states, 30)
    for name, row in meaning.outputs.items():
        np.testing.assert_array_equal(found.outputs[name], row)
    assert found.states.tobytes() == meaning.states.tobytes()


@pytest.mark.parametrize("name", few(NAMES, quick=1, start=1))
def test_the_fast_build_decides_as_the_parity_build(name: str) -> None:
    """Fused multiplications and additions move the states in their last bits, and no decision."""
    loop = built_in(name, "float64")
    program = loop.program()
    states = loop.start(program, 16, 1)
    parity, fast = (Kernel(program, build).run(program, states, 200).outputs for build in ("parity", "fast"))
    for key, row in parity.items():
        if isinstance(key, Sent | Received):
            np.testing.assert_array_equal(fast[key], row)
    for i in range(loop.problem.plant.states):
        np.testing.assert_allclose(fast[Entry("x", i)], parity[Entry("x", i)], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", few(NAMES, quick=1, start=2))
def test_the_plant_of_a_network_has_the_bits_of_numpy(name: str) -> None:
    """Its step as a Python function of numbers."""
    loop = built_in(name, "float64")
    program = loop.plant_program()
    turn, states = compile_python(program), loop.start(program, 1, 5)
    inputs = 0.3 * np.random.default_rng(2).normal(size=(40, loop.problem.plant.inputs, 1))
    meaning = interpreter.run(program, states, 40, inputs)
    memory: Any = [
        int(value.view(np.uint64)) if state.word else float(value)
        for value, state in zip(states[:, 0], program.states, strict=True)
    ]
    for tick in range(40):
        memory, outputs = turn(memory, inputs[tick, :, 0].tolist())
        assert list(outputs) == [meaning.outputs[key][tick, 0] for key in program.outputs]
