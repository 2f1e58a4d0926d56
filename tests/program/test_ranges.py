"""Ranges of values over all steps contain whatever a run computes, and are narrow where silence has to be proved."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
from drawn import law
from hypothesis import strategies as st
from program.test_ir import play, random_program

from taciturn.program.ir import Builder
from taciturn.program.ops import State
from taciturn.program.ranges import Range, ranges_of_sums


def ranges(builder: Builder, following: list[int], first: int = 0, **sums: int) -> dict[object, Range]:
    """Return the ranges of the sums of a program."""
    program = builder.finish(following, {**sums})
    return {**ranges_of_sums(program, [float(str(state.start)) for state in program.states], first)}


@law(12, 200, seed=st.integers(0, 2**32 - 1), first=st.integers(0, 3))
def test_every_value_of_a_run_is_in_its_range(seed: int, first: int) -> None:
    """Random programs with loops through their states, on random inputs."""
    program = random_program(seed)
    program = replace(program, sums=program.outputs)
    found = ranges_of_sums(program, [float(str(state.start)) for state in program.states], first)
    values = play(program, np.random.default_rng(seed).normal(size=(9, 2, 8))).outputs
    for name, (low, high) in found.items():
        seen = values[name][first:]
        seen = seen[np.isfinite(seen)]
        assert ((low <= seen) & (seen <= high)).all()


def test_a_counter_has_one_bound_and_a_square_is_not_negative() -> None:
    """The bound that changes becomes infinite; the other one stays."""
    b = Builder()
    count, given = b.state(State("count", 0)), b.input("in 0")
    found = ranges(b, [b.emit("add", count, b.constant(1.0))], count=count, square=b.emit("mul", given, given))
    assert found == {"count": Range(0.0, inf), "square": Range(0.0, inf)}


def test_what_is_multiplied_by_zero_or_not_selected_has_no_effect() -> None:
    """A signal stays 0 if its gain is a state that is 0, and a flag that only the first step sets is 0 afterwards."""
    b = Builder()
    gain, begun, given = b.state(State("gain", 0)), b.state(State("begun", 0)), b.input("in 0")
    one = b.constant(1.0)
    new = b.emit("less_equal", begun, b.constant(0.5))
    sums = {"signal": b.emit("mul", gain, given), "begin": b.choose(new, one, b.constant(0.0))}
    following = [b.emit("mul", gain, given), one]
    assert ranges(b, following, **sums) == {"signal": Range(0.0, 0.0), "begin": Range(0.0, 1.0)}
    assert ranges(b, following, 1, **sums)["begin"] == Range(0.0, 0.0)


def test_a_product_with_a_matrix_and_a_table_have_the_ranges_of_their_entries() -> None:
    """The row of the matrix without the unknown input is known; an unknown place may give any entry of the table."""
    b = Builder()
    state, given = b.state(State("x", 0, 2.0)), b.input("in 0")
    vector = b.product(((3.0, 0.0), (1.0, 1.0)), [state, given])
    place = b.choose(b.emit("greater", given, state), b.constant(1.0), b.constant(0.0))
    sums = {"known": b.emit("entry", vector, 0), "any": b.emit("entry", vector, 1)}
    found = ranges(b, [state], **sums, table=b.value(b.lookup([4.0, 7.0, 5.0], place)))
    assert found == {"known": Range(6.0, 6.0), "any": Range(-inf, inf), "table": Range(4.0, 7.0)}
