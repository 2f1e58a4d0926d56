"""Runs programs on the fastest interpreter there is: LLVM, or NumPy where llvmlite is missing.

There are two ways: many ticks of one program (``prepare``), and any ticks of many programs (``Stepper``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

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


class Stepper:
    """Runs programs of one structure side by side, each on a path of its own.

    Args:
        programs: without inputs, of equal ``Program.structure``.
    """

    def __init__(self, programs: Sequence[Program]) -> None:
        """Compile once for all."""
        self._programs = programs
        self._kernel = machine.Kernel(programs[0], own=True) if machine.available() else None
        self._constants = None if self._kernel is None else self._kernel.pack(programs)
        totals = [program.totals for program in programs]
        self._factors = {name: np.array([total[name].factor for total in totals]) for name in totals[0]}
        self._offsets = {name: np.array([total[name].offset for total in totals]) for name in totals[0]}

    def run(self, states: Array, ticks: int, threads: int | None = None) -> tuple[Array, dict[str, Array]]:
        """Return states and sums after some ticks, given the states before them, (states, programs)."""
        if self._kernel is None:
            runs = [interpreter.run(program, states[:, [i]], ticks) for i, program in enumerate(self._programs)]
            sums = {name: np.concatenate([run.sums[name] for run in runs]) for name in self._factors}
            return np.concatenate([run.states for run in runs], axis=1), sums
        found = self._kernel.run(self._programs[0], states, ticks, threads=threads, constants=self._constants)
        return found.states, {
            name: self._factors[name] * added + self._offsets[name] * ticks for name, added in found.sums.items()
        }
