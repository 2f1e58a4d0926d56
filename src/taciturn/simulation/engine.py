"""Runs a program on the fastest interpreter there is: LLVM, or NumPy where llvmlite is missing."""

from __future__ import annotations

from taciturn._arrays import Array
from taciturn.program import machine
from taciturn.program import numpy as interpreter
from taciturn.program.ir import Program
from taciturn.program.numpy import Run


def run(program: Program, states: Array, ticks: int, threads: int | None = None) -> Run:
    """Run ``ticks`` ticks of a program on every path.

    Args:
        program: the program, without inputs.
        states: value of each state, (states, paths).
        ticks: number of ticks.
        threads: omitted: as many as there are processors; the result does not depend on it.

    Returns:
        States, sums and outputs.
    """
    if machine.available():
        return machine.Kernel(program).run(program, states, ticks, threads=threads)
    return interpreter.run(program, states, ticks)
