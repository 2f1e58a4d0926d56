"""What a printed program does one tick ahead: its draws, and what is made of them alone.

A tick is one long chain: a word is drawn, made a normal by a logarithm and a root, and moves the state, on which the
decision waits. Processors look ahead by some 250 to 500 instructions, less than two ticks, so they would wait for most
of that chain. Draws depend on the generator's words alone: drawn a tick ahead, they are computed while the state moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

from taciturn.program.ir import Program

FREE = ("const", "word", "half")  # operations that cost nothing


@dataclass(frozen=True)
class Ahead:
    """Operations that are done one tick ahead.

    Args:
        operations: in the order of the program.
        carried: those of them that the tick itself reads.
    """

    operations: tuple[int, ...] = ()
    carried: tuple[int, ...] = ()


def find_ahead(program: Program, printed: Sequence[int], fused: Mapping[int, int], summed: Set[int]) -> Ahead:
    """Return what depends on nothing but words in memory; nothing if the tick reads these words, too.

    Args:
        program: the program.
        printed: the operations that are printed, in order.
        fused: sums and differences, with the product that is printed as a part of each.
        summed: products that are printed as a part of what is added up over ticks.
    """
    found, words = set[int](), set[int]()
    reads = {index: _reads(program, index, fused) for index in printed}
    for index in printed:
        op = program.ops[index]
        if op.name == "state" and program.states[op.arguments[0]].word:
            words.add(index)
        elif op.name not in (*FREE, "state", "input", "product", "entry"):
            computed = [i for i in reads[index] if program.ops[i].name not in FREE]
            if computed and found.union(words).issuperset(computed):
                found.add(index)
    numbers = [i for i, state in zip(program.following, program.states, strict=True) if not state.word]
    totals = {total.op for total in program.totals.values()}
    read = {*numbers, *program.outputs.values(), *totals - summed}
    read.update(i for product in totals & summed for i in program.ops[product].reads)
    read.update(i for index in printed if index not in found for i in reads[index])
    moved = {i for i, state in zip(program.following, program.states, strict=True) if state.word}
    carried = tuple(sorted(found & read))
    if not carried or words & read or not moved <= found | words:
        return Ahead()
    return Ahead(tuple(sorted(found)), carried)


def _reads(program: Program, index: int, fused: Mapping[int, int]) -> tuple[int, ...]:
    """Return the operations that an operation is printed with."""
    reads, product = program.ops[index].reads, fused.get(index)
    if product is None:
        return reads
    return (*program.ops[product].reads, *(i for i in reads if i != product))
