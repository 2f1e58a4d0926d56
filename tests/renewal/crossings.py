"""A slow and different way to the same event times: polynomials in seconds, cut at their critical points."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import factorial, inf

import numpy as np
from numpy.polynomial import Polynomial

from taciturn._arrays import Array
from taciturn.program.machine import Kernel
from taciturn_events.events import ERROR, WAIT, CycleTrigger, JumpProcess, LevelTrigger, cycle_program, start_cycles


def error_polynomials(A: Array, e: Array) -> list[Polynomial]:
    """Return the entries of e(s) of a nilpotent A."""
    terms = [np.linalg.matrix_power(A, k) @ e / factorial(k) for k in range(len(A))]
    return [Polynomial([term[i] for term in terms]) for i in range(len(A))]


def form(S: Array, entries: list[Polynomial]) -> Polynomial:
    """Return e(s)'Se(s)."""
    total = Polynomial([0.0])
    for i, x in enumerate(entries):
        for j, y in enumerate(entries):
            total = total + S[i, j] * x * y
    return total


def first_crossing(f: Polynomial, low: float, high: float) -> float | None:
    """Return the first s in [low, high] with f(s) ≥ 0: bisection between critical points, where f is monotone."""
    corners = [low, *critical_points(f, low, high), high]
    if f(low) >= 0:
        return low
    for left, right in pairwise(corners):
        if f(right) < 0:
            continue
        for _ in range(200):
            middle = (left + right) / 2
            if not left < middle < right:
                break
            left, right = (left, middle) if f(middle) >= 0 else (middle, right)
        return right
    return None


def critical_points(f: Polynomial, low: float, high: float) -> list[float]:
    """Return where f may turn, in order."""
    slope = f.deriv().trim()
    roots = np.asarray(slope.roots(), dtype=complex) if slope.degree() > 0 else np.zeros(0, dtype=complex)
    near = roots[np.abs(roots.imag) <= 1e-6 * (1 + np.abs(roots))].real
    return sorted(float(root) for root in near if low < root < high)


def size(f: Polynomial, high: float) -> float:
    """Return the size of the terms of f, to which rounding is relative."""
    return float(sum(abs(c) * high**k for k, c in enumerate(f.coef)))


def jumps(process: JumpProcess, paths: int, count: int, seed: int) -> tuple[Array, Array]:
    """Return the waits (count + 1, paths) and jumps (count, n, paths), as a trigger that always fires sees them."""
    program = cycle_program(process, LevelTrigger(np.eye(len(process.A)), 1e-280)).keep(states={ERROR, WAIT})
    names = [(state.name, state.index) for state in program.states]
    rows = [names.index((ERROR, i)) for i in range(len(process.A))]
    kernel, states = Kernel(program, "parity"), start_cycles(process, program, paths, seed)
    waits, sizes = [states[names.index((WAIT, 0))].copy()], list[Array]()
    for _ in range(count):
        states = kernel.run(program, states, 1).states
        waits.append(states[names.index((WAIT, 0))].copy())
        sizes.append(states[rows].copy())
    return np.array(waits), np.array(sizes)


@dataclass
class SlowPath:
    """One path of a nilpotent process, event after event."""

    process: JumpProcess
    trigger: CycleTrigger

    def cycles(self, waits: Array, sizes: Array) -> list[tuple[float, float]]:
        """Return duration and cost of each cycle that ends before the jumps are used up."""
        found: list[tuple[float, float]] = []
        e, cost, time, rest, k = np.zeros(len(self.process.A)), 0.0, 0.0, float(waits[0]), 0
        while True:
            running = form(self.process.S, error_polynomials(self.process.A, e)).integ()
            end = self.end(e, cost, time, rest)
            if end is not None:
                found.append((time + end, cost + float(running(end))))
                e, cost, time, rest = np.zeros(len(e)), 0.0, 0.0, rest - end
                continue
            if k == len(sizes):
                return found
            cost, time = cost + float(running(rest)), time + rest
            e = np.array([float(x(rest)) for x in error_polynomials(self.process.A, e)]) + sizes[k]
            k, rest = k + 1, float(waits[k + 1])

    def end(self, e: Array, cost: float, time: float, rest: float) -> float | None:
        """Return in how many seconds the cycle ends, if no jump comes before."""
        trigger, entries = self.trigger, error_polynomials(self.process.A, e)
        last = min(rest, trigger.h_max - time)
        if not e.any():
            return last if last < rest else None
        found: float | None = None
        if isinstance(trigger, LevelTrigger):
            found = first_crossing(form(trigger.Psi, entries) - trigger.level, 0.0, last)
        else:
            gone = cost + form(self.process.S, entries).integ()
            pieces = [
                (gone - trigger.c * Polynomial([time, 1.0]), trigger.h_min - time, trigger.saturation - time),
                (gone - trigger.c * min(trigger.saturation, 1e300), max(trigger.h_min, trigger.saturation) - time, inf),
            ]
            for f, low, high in pieces:
                if found is None and max(low, 0.0) < min(high, last):
                    found = first_crossing(f, max(low, 0.0), min(high, last))
        if found is None and last < rest:
            return last
        return found
