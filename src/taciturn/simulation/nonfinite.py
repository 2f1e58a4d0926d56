"""Search for the state at which the function of a nonlinear plant gives a non-finite number."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array
from taciturn.errors import UnstableError
from taciturn.loop import Loop
from taciturn.program.engine import Runner
from taciturn.program.ir import Program


def expect_numbers(loop: Loop, states: Array) -> None:
    """Raise an error if a simulated path contains non-finite states of a nonlinear plant.

    Args:
        loop: the closed loop.
        states: x at each step, (steps, n).

    Raises:
        UnstableError: there is a non-finite value; the message contains the entry and the previous state.
    """
    lost = np.flatnonzero(~np.isfinite(states).all(axis=1))
    if loop.problem.plant.function is None or not lost.size:
        return
    tick = int(lost[0])
    raise _leaves(loop, states[tick], states[tick - 1] if tick else None)


def find_loss(loop: Loop, program: Program, run: Runner, before: Array, ticks: int) -> None:
    """Raise an error if the function of a nonlinear plant gave non-finite values in a simulation.

    One path is run again to find the step.

    Args:
        loop: the closed loop.
        program: program of the loop, which contains the state ``x``.
        run: function that runs the program.
        before: states before the run, (states, paths).
        ticks: number of steps of the run.

    Raises:
        UnstableError: there is a non-finite value; the message contains the entry and the previous state.
    """
    rows = [i for i, state in enumerate(program.states) if state.name == "x"]
    if loop.problem.plant.function is None or not rows:
        return
    lost = np.flatnonzero(~np.isfinite(run(before, ticks, None).states[rows]).all(axis=0))
    if not lost.size:
        return
    path = before[:, [int(lost[0])]]

    def after(wanted: int) -> Array:
        return (run(path, wanted, 1).states if wanted else path)[rows, 0]

    good, bad = 0, ticks  # steps after which the state is finite, and is not
    while bad - good > 1:
        middle = (good + bad) // 2
        if np.isfinite(after(middle)).all():
            good = middle
        else:
            bad = middle
    found, last = after(bad), after(good)
    if not np.isfinite(last).all():  # in the last step before this run
        found, last = last, None
    raise _leaves(loop, found, last, [program.states[i].index for i in rows])


def _leaves(loop: Loop, found: Array, last: Array | None, entries: list[int] | None = None) -> UnstableError:
    """Return the error that names the non-finite entry of the state and the previous state."""
    place = int(np.flatnonzero(~np.isfinite(found))[0])
    entry = place if entries is None else entries[place]
    point = loop.problem.plant.operating_point
    if last is not None and point is not None:
        last = last + (point.x if entries is None else point.x[entries])
    whence = "" if last is None else f", from x = [{', '.join(f'{value:.4g}' for value in last)}]"
    return UnstableError(
        f"the plant's function gives no finite number as state {entry + 1} in the loop of {loop.policy.kind}{whence}; "
        "expected finite numbers: send more often, clip the inputs (input_limit), or correct the function"
    )
