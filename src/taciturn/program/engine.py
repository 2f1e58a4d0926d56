"""Execution of programs on the fastest available back end: LLVM, or NumPy if llvmlite is not installed.

A program is a map (z, w) → (z⁺, sums, outputs) of one step, and runs on many paths at a time: the machine code computes
each operation on vectors with one lane per path (``llvm``), the reference on arrays of all paths (``numpy``). Paths do
not interact, so the result of a path depends neither on the other paths nor on the number of threads.

A sum over n steps has the form factor·Σ x + offset·n (``ops.Total``), where Σ x is added up at each step and the rest
is applied once. The factors are constants, so two programs that differ only in constants have the same machine code but
other factors.

There are three drivers:

* ``prepare`` runs many steps of one program without inputs. Its constants are shared by all paths.
* ``Stepper`` runs many programs of equal structure, one path each. Each lane has constants of its own, which are loaded
  from memory, so a step takes longer than with shared constants.
* ``StepwiseRunner`` runs programs that receive inputs at each step, for a plant that is computed elsewhere. Consecutive
  programs with few paths run together, with constants per path: one call of the machine code serves them all. A
  program with at least ``MANY`` paths runs alone, since the call then costs little compared with its work.
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
from taciturn.program.ops import Name

MANY = 1024  # least number of paths of a program that runs alone, with constants shared by all paths
Runner: TypeAlias = Callable[[Array, int, int | None], Run]
"""Function from states (states, paths), number of steps and threads (None: all processors) to a ``Run``."""


def prepare(program: Program, exact: bool = False) -> Runner:
    """Compile a program without inputs. Return a function that runs it for a number of steps."""
    if not machine.available():
        return lambda states, ticks, threads: interpreter.run(program, states, ticks)
    kernel = machine.Kernel(program, "parity" if exact else "fast")
    return lambda states, ticks, threads: kernel.run(program, states, ticks, threads=threads)


class Stepper:
    """Runs several programs that differ only in their constants, with one simulated path for each."""

    def __init__(self, programs: Sequence[Program]) -> None:
        """Compile once for all programs."""
        self._programs = programs
        self._kernel = machine.Kernel(programs[0], own=True) if machine.available() else None
        self._constants = None if self._kernel is None else self._kernel.pack(programs)
        totals = [program.totals for program in programs]
        self._factors = {name: np.array([total[name].factor for total in totals]) for name in totals[0]}
        self._offsets = {name: np.array([total[name].offset for total in totals]) for name in totals[0]}

    def run(self, states: Array, ticks: int, threads: int | None = None) -> tuple[Array, dict[Name, Array]]:
        """Run all programs for a number of steps from the given states. Return the final states and the sums."""
        if self._kernel is None:
            runs = [interpreter.run(program, states[:, [i]], ticks) for i, program in enumerate(self._programs)]
            sums = {name: np.concatenate([run.sums[name] for run in runs]) for name in self._factors}
            return np.concatenate([run.states for run in runs], axis=1), sums
        found = self._kernel.run(self._programs[0], states, ticks, threads=threads, constants=self._constants)
        return found.states, {
            name: self._factors[name] * added + self._offsets[name] * ticks for name, added in found.sums.items()
        }


class StepwiseRunner:
    """Runs all simulated paths of a program, step by step, with new inputs in each step."""

    def __init__(self, programs: Sequence[Program], paths: Sequence[int], states: Array) -> None:
        """Group the programs and compile each group."""
        self._parts: list[tuple[slice, _Compiled | _Interpreted]] = []
        ends, first = [0, *np.cumsum(paths).tolist()], 0
        while first < len(paths):
            end = first + 1
            while end < len(paths) and max(paths[first], paths[end]) < MANY:
                end += 1
            columns = slice(ends[first], ends[end])
            kind = _Compiled if machine.available() else _Interpreted
            self._parts.append((columns, kind(programs[first:end], paths[first:end], states[:, columns])))
            first = end

    def tick(self, inputs: Array) -> Array:
        """Run one step of all paths with the given inputs (inputs × paths). Return the outputs (outputs × paths)."""
        return np.concatenate([part.tick(inputs[:, columns]) for columns, part in self._parts], axis=1)

    def take_sums(self) -> dict[Name, Array]:
        """Return the sums over the steps since the last call of this method, with one entry per path."""
        taken = [part.take_sums() for _, part in self._parts]
        return {name: np.concatenate([sums[name] for sums in taken]) for name in taken[0]}


class _Compiled:
    """A group of programs that LLVM runs."""

    def __init__(self, programs: Sequence[Program], paths: Sequence[int], states: Array) -> None:
        own = len(programs) > 1
        kernel = machine.Kernel(programs[0], own=own)
        constants = kernel.pack(programs, paths) if own else None
        self._there, self._ticks = machine.Resident(kernel, programs[0], states, constants), 0
        self._totals, self._cuts = [program.totals for program in programs], np.cumsum(paths)[:-1]

    def tick(self, inputs: Array) -> Array:
        self._ticks += 1
        return self._there.tick(inputs)

    def take_sums(self) -> dict[Name, Array]:
        rows, ticks, self._ticks = self._there.take_sums(), self._ticks, 0
        return {
            name: np.concatenate(
                [
                    totals[name].of(own, ticks)
                    for totals, own in zip(self._totals, np.split(row, self._cuts), strict=True)
                ]
            )
            for name, row in zip(self._totals[0], rows, strict=True)
        }


class _Interpreted:
    """A group of programs that NumPy runs."""

    def __init__(self, programs: Sequence[Program], paths: Sequence[int], states: Array) -> None:
        self._programs, self._added = programs, [dict[Name, Array]() for _ in programs]
        self._cuts = np.cumsum(paths)[:-1]
        self._states = np.split(states, self._cuts, axis=1)

    def tick(self, inputs: Array) -> Array:
        found: list[Array] = []
        for k, told in enumerate(np.split(inputs, self._cuts, axis=1)):
            run = interpreter.run(self._programs[k], self._states[k], 1, told[None])
            self._states[k] = run.states
            self._added[k] = {name: self._added[k].get(name, 0.0) + added for name, added in run.sums.items()}
            found.append(np.concatenate(list(run.outputs.values())))
        return np.concatenate(found, axis=1)

    def take_sums(self) -> dict[Name, Array]:
        taken, self._added = self._added, [dict[Name, Array]() for _ in self._programs]
        return {name: np.concatenate([sums[name] for sums in taken]) for name in taken[0]}
