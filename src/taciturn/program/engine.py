"""Runs a program on the fastest interpreter there is: LLVM, or NumPy where llvmlite is missing."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from taciturn._arrays import Array
from taciturn.program import machine
from taciturn.program import numpy as interpreter
from taciturn.program.ir import Program
from taciturn.program.numpy import Run

Runner: TypeAlias = Callable[[Array, int, int | None], Run]
"""States (states, paths), ticks and threads (None: all processors; the result does not depend on it) → what is left."""


def prepare(program: Program) -> Runner:
    """Compile a program without inputs, and return what runs it."""
    if not machine.available():
        return lambda states, ticks, threads: interpreter.run(program, states, ticks)
    kernel = machine.Kernel(program)
    return lambda states, ticks, threads: kernel.run(program, states, ticks, threads=threads)
