"""Where the function of a plant that is not linear stops giving finite numbers: told with the state, not as a cost."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array
from taciturn.errors import UnstableError
from taciturn.loop import Loop
from taciturn.program.engine import Runner
from taciturn.program.ir import Program


def expect_numbers(loop: Loop, states: Array) -> None:
    """Refuse a record of a path on which the plant's function has given something else than finite numbers.

    Args:
        loop: the closed loop.
        states: x at each tick, (ticks, n).

    Raises:
        UnstableError: it has; with the state and where it came from.
    """
    lost = np.flatnonzero(~np.isfinite(states).all(axis=1))
    if loop.problem.plant.function is None or not lost.size:
        return
    tick = int(lost[0])
    raise _leaves(loop, states[tick], states[tick - 1] if tick else None)


def find_loss(loop: Loop, program: Program, run: Runner, before: Array, ticks: int) -> None:
    """Refuse a run in which the plant's function has given something else than finite numbers, if that is what it was.

    One path is run again, to find the tick.

    Args:
        loop: the closed loop.
        program: of the loop, which keeps the state ``x``.
        run: what runs it.
        before: states before the run, (states, paths).
        ticks: of the run.

    Raises:
        UnstableError: it was; with the state and where it came from.
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

    good, bad = 0, ticks  # ticks after which the state is finite, and is not
    while bad - good > 1:
        middle = (good + bad) // 2
        if np.isfinite(after(middle)).all():
            good = middle
        else:
            bad = middle
    found, last = after(bad), after(good)
    if not np.isfinite(last).all():  # in the last tick of what was run before
        found, last = last, None
    raise _leaves(loop, found, last, [program.states[i].index for i in rows])


def _leaves(loop: Loop, found: Array, last: Array | None, entries: list[int] | None = None) -> UnstableError:
    """Return the error that says which state is no number any more, and from where."""
    place = int(np.flatnonzero(~np.isfinite(found))[0])
    entry = place if entries is None else entries[place]
    whence = "" if last is None else f", from x = [{', '.join(f'{value:.4g}' for value in last)}]"
    return UnstableError(
        f"the loop of {loop.policy.kind} takes the plant to where its function gives {found[place]} as state "
        f"{entry + 1}{whence}; expected finite numbers: send more often, clip the inputs (input_limit), or mend the "
        "function"
    )
