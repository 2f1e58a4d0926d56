"""Programs: zeros elided, work shared, states merged and dropped, and none of it changes a bit of what is computed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn import law
from hypothesis import strategies as st

import taciturn
from taciturn import Network, Problem
from taciturn.program.draws import with_draws
from taciturn.program.ir import Builder, Coefficient, Program, merge_states
from taciturn.program.numpy import Run, run
from taciturn.program.ops import Sent, State

SEEDS = st.integers(0, 2**32 - 1)
STARTS = (0.0, 0.0, 1.0, -2.5)


def raw(builder: Builder, following: list[int], sums: dict[str, int], outputs: dict[str, int]) -> Program:
    """Return the program as it was written: nothing merged, nothing dropped."""
    b = builder
    parts = (tuple(b.ops), tuple(b.states), tuple(following), tuple(b.inputs), tuple(b.constants), tuple(b.tables))
    return Program(*parts, sums, outputs)


def starts(program: Program, paths: int = 3) -> np.ndarray:
    """Return the first value of each state."""
    return np.array([np.full(paths, state.start) for state in program.states]).reshape(len(program.states), paths)


def play(program: Program, supplied: np.ndarray) -> Run:
    """Run a program on inputs that are given by name: row i is ``in i``."""
    rows = [int(name.split()[1]) for name in program.inputs]
    return run(program, starts(program, supplied.shape[2]), len(supplied), supplied[:, rows])


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Tell whether two arrays of doubles hold the same bits."""
    return bool((np.ascontiguousarray(one).view(np.uint64) == np.ascontiguousarray(other).view(np.uint64)).all())


def random_program(seed: int, copies: int = 1) -> Program:
    """Return a random program, with so many copies of its states that obey the same equations."""
    builder, copied = Builder(), []
    shape = np.random.default_rng(seed)
    count, starting = int(shape.integers(1, 5)), shape.choice(STARTS, 5)
    for copy in range(copies):
        states = [builder.state(State(f"copy {copy}", i, float(starting[i]))) for i in range(count)]
        copied.append(_random_operations(builder, states, np.random.default_rng(seed + 1)))
    following = [index for values, _ in copied for index in values]
    outputs = {f"out {i}": index for i, index in enumerate(copied[0][1])}
    return raw(builder, following, {"total": copied[-1][1][0]}, outputs)


def _random_operations(b: Builder, states: list[int], draws: np.random.Generator) -> tuple[list[int], list[int]]:
    """Return what follows each state, and some other values."""
    values = [*states, b.input("in 0"), b.input("in 1"), b.constant(0.5), b.constant(-1.25)]
    flag = b.emit("select", b.emit("greater", b.input("in 0"), values[0]), b.constant(1.0), b.constant(0.0))
    for _ in range(int(draws.integers(5, 40))):
        x, y, z = (int(i) for i in draws.choice(values, 3))
        kind = draws.integers(7)
        if kind < 2:
            values.append(b.emit(["add", "sub"][kind], x, y))
        elif kind == 2:
            values.append(b.emit("mul", b.constant(0.25), b.emit("mul", x, y)))
        elif kind == 3:
            values.append(b.emit("sqrt", b.emit("mul", x, x)))
        elif kind == 4:
            truth = b.emit("and", b.emit("not", b.emit("less_equal", x, y)), b.emit("greater", z, x))
            values.append(b.emit("select", truth, y, z))
        elif kind == 5:
            values.append(b.emit("div", x, b.emit("add", b.emit("mul", y, y), b.constant(0.5))))
        else:
            table = draws.choice([0.5, 2.0], 2)
            values.append(b.value(b.scale(b.lookup(list(table), flag), x)))
    picked = [int(i) for i in draws.choice(values, len(states) + 3)]
    return picked[: len(states)], picked[len(states) :]


@law(8, 100, seed=SEEDS, copies=st.integers(1, 3))
def test_merging_and_dropping_leave_every_bit_of_the_outputs(seed: int, copies: int) -> None:
    """The program as written and the merged one say the same."""
    program = random_program(seed, copies)
    supplied = np.random.default_rng(seed).normal(size=(7, 2, 3))
    written, merged = play(program, supplied), play(merge_states(program), supplied)
    assert same(written.sums["total"], merged.sums["total"])
    assert all(same(written.outputs[name], merged.outputs[name]) for name in program.outputs)


@law(8, 100, seed=SEEDS)
def test_keeping_a_part_leaves_its_meaning(seed: int) -> None:
    """What is kept has the bits it had next to what is dropped."""
    program = random_program(seed)
    supplied = np.random.default_rng(seed).normal(size=(7, 2, 3))
    part = program.keep({"total"}, {"out 1"})
    whole, kept = play(program, supplied), play(part, supplied)
    assert set(kept.outputs) == {"out 1"}
    assert set(kept.sums) == {"total"}
    assert same(whole.outputs["out 1"], kept.outputs["out 1"])
    assert same(whole.sums["total"], kept.sums["total"])
    assert len(part.ops) <= len(program.ops)


@law(8, 100, seed=SEEDS, copies=st.integers(2, 4))
def test_copies_of_one_system_merge_into_one(seed: int, copies: int) -> None:
    """However many copies obey the same equations from the same start, the states of one remain."""
    assert merge_states(random_program(seed, copies)).states == merge_states(random_program(seed, 1)).states


@law(8, 100, seed=SEEDS)
def test_merging_twice_is_merging_once(seed: int) -> None:
    """Nothing is left to merge or drop."""
    once = merge_states(random_program(seed, 2))
    assert merge_states(once) == once


def test_what_merging_simplifies_is_merged_again() -> None:
    """Two states that are equal only once the operations of others have been simplified."""
    once = merge_states(random_program(133563636, 2))
    assert len(once.states) == 2
    assert merge_states(once) == once


def test_states_that_start_apart_stay_apart() -> None:
    """Equal equations do not make equal states."""
    b = Builder()
    one, other = b.state(State("x", 0, 0.0)), b.state(State("x", 1, 1.0))
    half = b.constant(0.5)
    program = b.finish([b.emit("mul", half, one), b.emit("mul", half, other)], {}, {"sum": b.emit("add", one, other)})
    assert len(program.states) == 2


def test_states_that_part_late_stay_apart() -> None:
    """A difference that takes three steps to arrive is seen."""
    b = Builder()
    chains = [[b.state(State(name, i)) for i in range(3)] for name in "xy"]
    following = [*chains[0][1:], b.constant(1.0), *chains[1][1:], b.constant(2.0)]
    program = b.finish(following, {}, {"x": chains[0][0], "y": chains[1][0]})
    assert len(program.states) == 6
    assert [float(play(program, np.zeros((5, 2, 1))).outputs[name][3, 0]) for name in "xy"] == [1.0, 2.0]


def test_states_that_nothing_depends_on_disappear() -> None:
    """Even where they depend on each other."""
    b = Builder()
    seen, one, other = (b.state(State("x", i, 1.0 + i)) for i in range(3))
    program = b.finish([b.emit("add", seen, seen), other, one], {}, {"seen": seen})
    assert [state.index for state in program.states] == [0]


@law(8, 100, seed=SEEDS)
def test_sums_and_forms_are_those_of_the_matrices(seed: int) -> None:
    """Zeros, ones, minus ones and entries read from tables, in any mixture."""
    draws = np.random.default_rng(seed)
    size = int(draws.integers(1, 6))
    v = draws.normal(size=size)
    tables = draws.choice([0.0, 1.0, -1.0, 2.0, 3.0, 0.3], (2, size, size))
    tables[1] = np.where(draws.random((size, size)) < 0.6, tables[0], tables[1])  # the same at both locations
    tables = (tables + tables.swapaxes(1, 2)) / 2
    for here in (0, 1):
        b = Builder()
        at = b.state(State("location", 0, float(here)))
        inputs = [b.state(State("v", i, float(value))) for i, value in enumerate(v)]
        Psi: list[list[Coefficient]] = [[b.lookup(list(tables[:, i, j]), at) for j in range(size)] for i in range(size)]
        outputs = {"form": b.quadratic(Psi, inputs), "sum": b.combine(Psi[0], inputs)}
        known = {name: b.constant(0.0) if index is None else index for name, index in outputs.items()}
        program = b.finish([at, *inputs], {}, known)
        result = run(program, starts(program, 1), 1).outputs
        assert result["form"][0, 0] == pytest.approx(v @ tables[here] @ v, abs=1e-12)
        assert result["sum"][0, 0] == pytest.approx(tables[here, 0] @ v, abs=1e-12)


def test_a_weight_from_a_table_is_not_mistaken_for_a_number() -> None:
    """Operation 1 is no weight 1.0."""
    b = Builder()
    at = b.state(State("location", 0))
    entry = b.lookup([5.0, 7.0], at)
    assert entry == 1.0
    v = [b.input("in 0"), b.input("in 1")]
    outputs = {"form": b.quadratic([[entry, 0.0], [0.0, 1.0]], v), "sum": b.combine([1.0, entry], v)}
    program = b.finish([at], {}, {name: index for name, index in outputs.items() if index is not None})
    result = run(program, np.zeros((1, 1)), 1, np.ones((1, 2, 1))).outputs
    assert (result["form"][0, 0], result["sum"][0, 0]) == (6.0, 6.0)


def test_zeros_cost_nothing() -> None:
    """A sum with one entry that is not zero is one product, and with none is nothing."""
    b = Builder()
    v = [b.input(f"in {i}") for i in range(3)]
    assert b.combine([0.0, 0.0, 0.0], v) is None
    assert b.quadratic([[0.0] * 3] * 3, v) is None
    assert b.combine([0.0, 1.0, -0.0], v) == v[1]
    product = b.combine([0.0, 0.5, 0.0], v)
    assert product is not None
    assert b.finish([], {}, {"x": product}).operations == 1


def test_equal_operations_are_shared() -> None:
    """The same sum under two names is computed once."""
    b = Builder()
    v = [b.input(f"in {i}") for i in range(3)]
    sums = [b.combine([0.1, 0.2, 0.3], v) for _ in range(2)]
    assert sums[0] == sums[1]


def test_equal_diagonal_weights_share_one_product() -> None:
    """0.1 (a² + b² + c²) has three squares and one product."""
    b = Builder()
    form = b.quadratic((0.1 * np.eye(3)).tolist(), [b.input(f"in {i}") for i in range(3)])
    assert form is not None
    assert b.finish([], {}, {"form": form}).operations == 6


def test_a_table_of_equal_values_is_a_number() -> None:
    """And stays a number where a table becomes one on the way."""
    b = Builder()
    at = b.state(State("location", 0))
    assert b.lookup([0.3, 0.3], at) == 0.3
    assert isinstance(b.lookup([0.3, 0.4], at), int)
    varying = b.value(b.lookup([0.3, 0.4], at))
    program = b.finish([at], {}, {"x": varying})
    folded = merge_states(replace(program, tables=((0.3, 0.3),)))
    assert (folded.tables, folded.constants) == ((), (0.3,))


def test_unused_inputs_constants_and_tables_disappear() -> None:
    """What nothing reads is not supplied."""
    b = Builder()
    at = b.state(State("location", 0))
    b.value(b.lookup([1.0, 2.0], at))
    b.constant(0.7)
    b.input("in 0")
    kept = b.input("in 1")
    program = b.finish([at], {}, {"x": kept})
    assert (program.inputs, program.constants, program.tables, program.states) == (("in 1",), (), (), ())


@pytest.fixture(scope="module")
def masses() -> Problem:
    """Return the two masses of the thesis."""
    return taciturn.load("two-mass-lqg")


def names(program: Program) -> set[str]:
    """Return the names of the states."""
    return {state.name for state in program.states}


def test_an_ideal_link_makes_the_controllers_note_and_the_actuators_input_one_state(masses: Problem) -> None:
    """What is sent and what is noted agree at every step."""
    assert names(masses.close(masses.design()).program()) == {"x", "prior", "held", "generator"}


def test_a_lossy_link_keeps_the_controllers_note_and_the_actuators_input_apart(masses: Problem) -> None:
    """A packet may be lost, and the controller is not told."""
    loop = taciturn.close(masses.plant, masses.design(), Network("udp", actuator_loss=0.2), masses.cost)
    assert names(loop.program()) == {"x", "prior", "held", "input", "generator"}


@pytest.mark.parametrize("size", [3, 24])
def test_a_value_may_stand_in_a_form_more_than_once(size: int) -> None:
    """Coefficient by coefficient, and as one product of a matrix."""
    draws = np.random.default_rng(size)
    Psi = draws.normal(size=(2 * size, 2 * size))
    Psi = Psi + Psi.T
    b = Builder()
    values = [b.input(f"in {i}") for i in range(size)] * 2
    form = b.quadratic(Psi.tolist(), values)
    assert form is not None
    program = b.finish([], {}, {"form": form})
    assert len(program.matrices) == (size > 16)
    inputs = draws.normal(size=(1, size, 4))
    doubled = np.vstack([inputs[0], inputs[0]])
    found = run(program, np.zeros((0, 4)), 1, inputs).outputs["form"][0]
    assert np.allclose(found, np.einsum("ip,ij,jp->p", doubled, Psi, doubled), rtol=1e-12)


def test_the_copies_of_the_model_merge_as_well(masses: Problem) -> None:
    """Controller and actuator run one model under an ideal network."""
    loop = masses.close(masses.changed({"actuation": "model"}).design())
    assert len(loop.program().states) == 4 + 4 + 4 + 4


def test_the_generator_disappears_with_the_last_draw_that_matters(masses: Problem) -> None:
    """Counting the sends of a periodic policy needs its clock alone."""
    loop = masses.close(taciturn.design.periodic(masses.plant, masses.cost, every=3))
    assert names(loop.program().keep({Sent("actuator")})) == {"clock"}


def test_draws_are_the_same_whatever_is_kept(masses: Problem) -> None:
    """The cost of a path has the bits it has in the full program."""
    loop = masses.close(masses.design())
    program = loop.program()
    kept = program.keep({"cost"})
    results = [run(p, loop.start(p, 5, 3), 20) for p in (program, kept)]
    assert same(results[0].sums["cost"], results[1].sums["cost"])


def test_a_program_without_draws_is_left_alone() -> None:
    """No generator where nothing is drawn."""
    program = random_program(1)
    assert with_draws(program) is program
