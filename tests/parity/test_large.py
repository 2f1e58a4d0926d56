"""Large programs multiply matrices in loops, and many programs of one structure run side by side: the same numbers."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from counts import few, scaled
from drawn import law
from hypothesis import strategies as st
from parity.loops import assert_parity, differences, programs, with_precision
from systems import make_system

import taciturn
from taciturn import Cost, Plant, close, design
from taciturn.errors import ProblemError, UnstableError
from taciturn.loop import Loop
from taciturn.program import engine, ir, machine
from taciturn.program import numpy as interpreter
from taciturn.program.ir import Builder, Program
from taciturn.program.llvm import SMALL
from taciturn.program.machine import Kernel
from taciturn.program.ops import Entry, Precision, Sent, tiles
from taciturn.simulation.bank import Bank

PRECISIONS = st.sampled_from(["float64", "float32"])


def large(seed: int, n: int, m: int, p: int) -> Loop:
    """Return the event-triggered loop of a random system."""
    system = make_system(seed, n, m, p, False)
    return close(system.plant, design.lqg(system.plant, system.cost, theta=0.2))


def products(program: Program) -> int:
    """Return how many matrices are multiplied in loops."""
    return sum(op.name == "product" for op in program.ops)


@law(2, 6, seed=st.integers(0, 2**32 - 1), n=st.integers(17, 24), precision=PRECISIONS)
def test_large_loops_agree_bit_for_bit(seed: int, n: int, precision: Precision) -> None:
    """With plant and filter, and in the innovations form."""
    loop = with_precision(large(seed, n, 3, 5), precision)
    for program in programs(loop):
        assert products(program) > 0
        assert program.operations > SMALL
        assert_parity(loop, program, seed, ticks=7)


@pytest.mark.evidence
def test_products_are_what_single_coefficients_would_give(monkeypatch: pytest.MonkeyPatch) -> None:
    """To rounding, step for step, while the decisions agree."""
    loop = large(1, 18, 2, 4)
    blocked = loop.program()
    monkeypatch.setattr(ir, "BLOCK", 10**9)
    single = loop.program()
    assert products(blocked) > 0 == products(single)
    assert blocked.operations < 1.3 * single.operations
    one, other = (interpreter.run(program, loop.start(program, 5, 3), 30) for program in (blocked, single))
    size = np.abs(one.outputs[Entry("x", 0)]).max()
    assert np.abs(one.outputs[Entry("x", 0)] - other.outputs[Entry("x", 0)]).max() < 1e-9 * size


@law(5, 60, seed=st.integers(0, 2**32 - 1), rows=st.integers(1, 40), columns=st.integers(1, 40), share=st.floats(0, 1))
def test_a_transform_is_the_matrix_times_the_numbers(seed: int, rows: int, columns: int, share: float) -> None:
    """Whatever its zeros: dense, sparse, with empty rows and columns."""
    draws = np.random.default_rng(seed)
    matrix = draws.normal(size=(rows, columns)) * (draws.random((rows, columns)) < share)
    matrix[draws.random(rows) < 0.2] = 0
    matrix[:, draws.random(columns) < 0.2] = 0
    b = Builder()
    values = [b.input(Entry("in", j)) for j in range(columns)]
    found = b.transform(matrix.tolist(), values)
    assert [index is None for index in found] == [not row.any() for row in matrix]
    program = b.finish([], {}, {f"{i}": index for i, index in enumerate(found) if index is not None})
    inputs = draws.normal(size=(2, columns, 9))
    supplied = inputs[:, [name.index for name in program.inputs]]
    meaning = interpreter.run(program, np.zeros((0, 9)), 2, supplied)
    assert differences(meaning, Kernel(program, "parity").run(program, np.zeros((0, 9)), 2, supplied)) == []
    for name, row in meaning.outputs.items():
        assert np.abs(row - matrix[int(name)] @ inputs).max() < 1e-12
    covered = sum(tile.rows * (tile.end - tile.begin) for rows_ in program.matrices for tile in tiles(rows_))
    assert covered <= rows * columns


def own(loops: list[Loop]) -> list[Program]:
    """Return the programs of the loops."""
    return [loop.program() for loop in loops]


@pytest.mark.parametrize("precision", few(["float64", "float32"], quick=1))
@pytest.mark.parametrize("size", few([4, 20], quick=1))
def test_programs_with_numbers_of_their_own_agree_with_each_alone(precision: Precision, size: int) -> None:
    """Lane by lane, bit for bit: constants, tables of schedules, matrices."""
    draws = np.random.default_rng(size)
    loops: list[Loop] = []
    for _ in range(11):
        A = draws.normal(size=(size, size)) / size
        plant = Plant(
            A, draws.normal(size=(size, 1)), draws.uniform(1, 2) * np.eye(size), np.eye(2, size), np.diag([1.0, 2.0])
        )
        policy = design.periodic(plant, Cost(np.eye(size), np.eye(1)), every=3)
        loops.append(with_precision(close(plant, policy), precision))
    written = own(loops)
    assert len({program.structure for program in written}) == 1
    assert written[0].tables
    assert (products(written[0]) > 0) == (size == 20)
    starts = [loop.start(p, 1, 7, first=i) for i, (loop, p) in enumerate(zip(loops, written, strict=True))]
    states = np.concatenate(starts, axis=1)
    kernel = Kernel(written[0], "parity", own=True)
    together = kernel.run(written[0], states, 40, constants=kernel.pack(written))
    for i, program in enumerate(written):
        alone = interpreter.run(program, states[:, [i]], 40)
        assert np.array_equal(together.states[:, [i]], alone.states, equal_nan=True)
        for name, total in program.totals.items():
            assert total.of(together.sums[name][i : i + 1], 40) == alone.sums[name]


@cache
def two_masses() -> taciturn.Problem:
    """Return the problem, read once."""
    return taciturn.load("two-mass-lqg")


def masses(theta: float) -> Loop:
    """Return a loop of the two masses."""
    problem = two_masses()
    return problem.close(design.lqg(problem.plant, problem.cost, theta=theta))


@pytest.mark.evidence
def test_a_bank_costs_and_sends_what_its_loops_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixty values of theta compile once, and each loop has the mean of its own path; one step at a time or many."""
    compiled: list[str] = []
    compile_once = machine._load
    monkeypatch.setattr(machine, "_load", lambda text: compiled.append(text) or compile_once(text))
    loops = [masses(theta) for theta in np.linspace(0.05, 1.0, 60)]
    bank = Bank(loops, seed=3)
    assert (bank.structures, len(compiled)) == (1, 1)
    steps = [bank.run() for _ in range(30)]
    many = bank.run(400)
    for i in (0, 17, 59):
        program = loops[i].program()
        states = loops[i].start(program, 1, 3, first=i)
        first = interpreter.run(program, states, 30)
        rest = interpreter.run(program, first.states, 400)
        noise = loops[i].problem.noise_cost
        assert sum(step.cost[i] for step in steps) == pytest.approx(first.sums["cost"][0] + 30 * noise, rel=1e-9)
        assert sum(step.sends["actuator"][i] for step in steps) == first.sums[Sent("actuator")][0]
        assert many.cost[i] == pytest.approx(rest.sums["cost"][0] / 400 + noise, rel=1e-9)
        assert many.sends["actuator"][i] == rest.sums[Sent("actuator")][0] / 400


@pytest.mark.evidence
def test_a_sweep_of_ten_thousand_values_compiles_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """From theta 0.01 to 2, in one bank; the sends fall with theta."""
    compiled: list[str] = []
    compile_once = machine._load
    monkeypatch.setattr(machine, "_load", lambda text: compiled.append(text) or compile_once(text))
    loops = scaled(10_000, 1_000)
    bank = Bank([masses(float(theta)) for theta in np.linspace(0.01, 2.0, loops)])
    bank.run(300)
    sends = bank.run(300).sends["actuator"].reshape(10, loops // 10).mean(axis=1)
    assert (bank.structures, len(compiled)) == (1, 1)
    assert (np.diff(sends) < 0).all()


def test_a_bank_holds_loops_of_any_structure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Different policies and plants, and the same numbers without machine code."""
    plant, cost = Plant([[1.2]], [[1.0]], [[0.01]]), Cost([[1.0]], [[1.0]])
    scalar = [close(plant, design.lqg(plant, cost, theta=theta)) for theta in (0.1, 0.3)]
    remote = close(plant, design.remote_lqg(plant, cost, theta=0.1, zeta=0.1))
    loops = [scalar[0], masses(0.2), scalar[1], remote]
    bank = Bank(loops)
    assert bank.structures == 3
    tally = bank.run(50)
    assert tally.sends["sensor"][0] == 0 < tally.sends["sensor"][3]
    monkeypatch.setattr(engine.machine, "available", lambda: False)
    slow = Bank(loops).run(50)
    assert np.allclose(tally.cost, slow.cost, rtol=1e-9)
    assert all(np.array_equal(tally.sends[link], slow.sends[link]) for link in slow.sends)


def test_what_a_bank_cannot_hold_is_refused() -> None:
    """Nothing, something else, a finite-horizon run, a loop that diverges, no threads."""
    loop = masses(0.2)
    assert len(Bank(each for each in [loop, loop]).run(2).cost) == 2
    for wrong in ([], iter([])):
        with pytest.raises(ProblemError, match="loops is empty"):
            Bank(wrong)
    for wrong in (None, 5, loop, [taciturn.load("two-mass-lqg")]):
        with pytest.raises(ProblemError, match="loops is "):
            Bank(wrong)  # type: ignore[arg-type]
    for threads in (0, -1, 2.5, True):
        with pytest.raises(ProblemError, match="threads is "):
            Bank([loop]).run(1, threads)  # type: ignore[arg-type]
    plant = Plant([[1.2]], [[1.0]], [[0.01]])
    policy = design.all_time(plant, Cost([[1.0]], [[1.0]]))
    for cost, told in (
        (Cost([[1.0]], [[1.0]], discount=0.9), "discount 0.9"),
        (Cost([[1.0]], [[1.0]], horizon=9), "horizon 9"),
    ):
        with pytest.raises(ProblemError, match=f"with {told}; expected an average"):
            Bank([close(plant, policy, cost=cost)])
    unstable = Plant([[2.0]], [[1.0]], [[0.01]], input_limit=[1e-3])
    lost = close(unstable, design.all_time(Plant([[2.0]], [[1.0]], [[0.01]]), Cost([[1.0]], [[1.0]])))
    with pytest.raises(UnstableError, match="loop 1 of the bank"):
        Bank([loop, lost]).run(3000)
