"""Software pipelining: random numbers, and operations that depend only on them, are computed one time step ahead.

A time step is one long chain of dependent operations: a random word, a logarithm and a root, which give a normal
number, the next state, and the decision that depends on it. A processor reorders instructions within a window of some
250 to 500 instructions, which is less than two steps, so that it would mostly wait for this chain. Random numbers
depend only on the words of the generator. They are computed one step ahead, while the previous step computes its state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

from taciturn.program.ir import Program

FREE_OPERATIONS = ("const", "word", "half")  # operations that need no instructions in the step


@dataclass(frozen=True)
class Ahead:
    """The operations of a time step that are computed one step ahead.

    Args:
        operations: the operations in the order of the program.
        carried: operations whose values the step itself reads; they are passed from one step to the next.
    """

    operations: tuple[int, ...] = ()
    carried: tuple[int, ...] = ()


def find_ahead(program: Program, printed: Sequence[int], fused: Mapping[int, int], summed: Set[int]) -> Ahead:
    """Return the operations of a program that can run one step ahead.

    They depend only on words of the random generator. The result is empty if the step itself also reads these words.

    Args:
        program: the program.
        printed: the operations that are written on their own, in order.
        fused: the product that is fused into each sum or difference.
        summed: products that are fused into sums over steps.
    """
    # an operation runs ahead if each operand is a constant, a word in memory, or an operation that runs ahead
    found, words = set[int](), set[int]()
    reads = {index: _reads(program, index, fused) for index in printed}
    for index in printed:
        op = program.ops[index]
        if op.name == "state" and program.states[op.arguments[0]].word:
            words.add(index)
        elif op.name not in (*FREE_OPERATIONS, "state", "input", "product", "entry"):
            computed = [i for i in reads[index] if program.ops[i].name not in FREE_OPERATIONS]
            if computed and found.union(words).issuperset(computed):
                found.add(index)
    # values that the step itself reads: for next states, outputs, sums, and operations that do not run ahead
    numbers = [i for i, state in zip(program.following, program.states, strict=True) if not state.word]
    totals = {total.op for total in program.totals.values()}
    read = {*numbers, *program.outputs.values(), *totals - summed}
    read.update(i for product in totals & summed for i in program.ops[product].reads)
    read.update(i for index in printed if index not in found for i in reads[index])
    # The words must be advanced together with the random numbers. This is impossible if the step itself reads a word,
    # or if the next value of a word does not run ahead.
    moved = {i for i, state in zip(program.following, program.states, strict=True) if state.word}
    carried = tuple(sorted(found & read))
    if not carried or words & read or not moved <= found | words:
        return Ahead()
    return Ahead(tuple(sorted(found)), carried)


def _reads(program: Program, index: int, fused: Mapping[int, int]) -> tuple[int, ...]:
    """Return the operations that an operation reads, with the operands of a fused product instead of the product."""
    reads, product = program.ops[index].reads, fused.get(index)
    if product is None:
        return reads
    return (*program.ops[product].reads, *(i for i in reads if i != product))
