"""Runs programs on the fastest interpreter there is: LLVM, or NumPy where llvmlite is missing.

There are three ways: many ticks of one program (``prepare``), any ticks of many programs (``Stepper``), and one tick
after the other of a program that is told something in each (``Resident``).
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


class Resident:
    """Paths of one program that are run tick by tick, with what they are told in each.

    Args:
        program: with inputs.
        states: the first ones, (states, paths).
    """

    def __init__(self, program: Program, states: Array) -> None:
        """Compile."""
        self._program, self._states, self._added = program, states, dict[str, Array]()
        available = machine.available()
        self._there = machine.Resident(machine.Kernel(program), program, states) if available else None
        self._ticks = 0

    def tick(self, inputs: Array) -> Array:
        """Run one tick: what it is told, (inputs, paths), to what comes out, (outputs, paths)."""
        self._ticks += 1
        if self._there is not None:
            return self._there.tick(inputs)
        run = interpreter.run(self._program, self._states, 1, inputs[None])
        self._states = run.states
        self._added = {name: self._added.get(name, 0.0) + added for name, added in run.sums.items()}
        return np.concatenate(list(run.outputs.values()))

    def take_sums(self) -> dict[str, Array]:
        """Return the sums over the ticks since this was last asked, (paths,) each."""
        ticks, self._ticks = self._ticks, 0
        if self._there is None:
            taken, self._added = self._added, {}
            return taken
        totals = self._program.totals.items()
        return {name: total.of(row, ticks) for (name, total), row in zip(totals, self._there.take_sums(), strict=True)}
