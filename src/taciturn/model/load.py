"""Loads: external disturbances whose value changes in steps at stated times, in the simulated plant.

    x⁺ = A x + B u + E ℓ + w,   y = C x + G ℓ + v,   with ℓ = values[j] from times[j] on.

After the last change the value stays, so a long-run average is that with the last value, and the changes before it are
a transient. A path, a run of nodes, and a cost over a horizon or with a discount begin at time 0 and contain them.

A ``Load`` is a property of the simulated plant alone, like the function of a nonlinear plant. Its design either knows
nothing of it, and then the load acts on states and outputs (E, G); or the design has a state d for this disturbance,
which its filter estimates, or which its controller is given (``signals``). Then the changes are added to d.
``SampledLoads`` is all of this from step to step, as a table that ``loop`` reads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, ArrayLike, array
from taciturn._display import Displayed
from taciturn.errors import ProblemError

LONGEST = 100_000  # sampling steps until the last change


@dataclass(frozen=True, eq=False, repr=False)
class Load(Displayed):
    """An external disturbance whose value changes in steps at stated times."""

    times: Array  # times of the changes in seconds, or in steps of a discrete plant, (k,); the first is 0
    values: Array  # the value from each time on, (k,)
    E: Array  # effect on the state per second or step, (n,)
    G: Array  # effect on the measured outputs, (p,)
    signal: int | None = None  # state of the exosystem to which the changes are added; None if the design has none
    given: bool = False  # whether the design starts with the first value of this state

    def at_steps(self, period: float, steps: int) -> Array:
        """Return the value in each sampling step, (steps,): a change between two samples takes effect at the later."""
        place = np.searchsorted(self.steps(period), np.arange(steps), side="right") - 1
        return self.values[place]

    def steps(self, period: float) -> Array:
        """Return the first sampling step of each value, (k,)."""
        found = np.ceil(self.times / period * (1 - 1e-12))
        if found[-1] >= LONGEST:
            raise ProblemError(
                f"disturbance.steps changes at time {self.times[-1]:g}, after {found[-1]:.6g} sampling steps; expected "
                f"changes within {LONGEST} steps"
            )
        return found


def stairs(initial: float | None, steps: ArrayLike | None) -> tuple[Array, Array]:
    """Check the changes of a disturbance; return their times, from 0 on, and the values from then on."""
    rows = np.zeros((0, 2)) if steps is None else array("disturbance.steps", steps, (None, 2), "(changes, 2)")
    times, values = rows.T
    if steps is not None and not len(rows):
        raise ProblemError("disturbance.steps is empty; expected rows [time, value], such as [[20, 0.3]]")
    if (times < 0).any() or not (np.diff(times) > 0).all():
        raise ProblemError(
            f"disturbance.steps has the times {times[:6].tolist()}; expected times of at least 0 that increase"
        )
    if len(rows) and times[0] == 0:
        if initial is not None:
            raise ProblemError(
                "disturbance.initial is given, and disturbance.steps states a value at time 0; expected only one of "
                "them"
            )
        return times, values
    first = 0.0 if initial is None else initial
    return np.array([0.0, *times]), np.array([first, *values])


@dataclass(frozen=True, eq=False, repr=False)
class SampledLoads(Displayed):
    """All loads of a plant from step to step: a table of signals ℓ_k, of which the last row persists."""

    table: Array  # values and changes of loads, (rows, r)
    moves: Array  # effect of ℓ on the next state, (n, r)
    shown: Array  # effect of ℓ on the outputs, (p, r)
    start: Array  # what is added to the initial state, (n,)
    weights: Array  # of ℓ in the cost of a step: entries of its matrix for (x, u, ℓ) and ℓ, (n + m + r, r)
