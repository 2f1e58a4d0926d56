"""The states whose cost-to-go is exactly zero, by the zeros of a problem: a Riccati equation is solved without them.

Registers that no noise reaches, modes that nothing drives and the cost does not see: such a state has no size of its
own by which an error could be measured, and iterations only halve its cost towards zero.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from taciturn._arrays import Array, Bits
from taciturn._modes import SCATTER, Modes, eigenvalues
from taciturn.lqg._axes import Quadratic


class Worth(NamedTuple):
    """Which states cost anything, and the modes of the others.

    Args:
        states: those for which the equation must be solved, (n,).
        decaying: modes of the others that decay.
        still: modes of the others on the edge of stability, which no input moves: they stay in the closed loop.
        resting: the states that have these modes, (n,).
    """

    states: Bits
    decaying: Modes
    still: Modes
    resting: Bits


def worth_of(given: Quadratic, beyond: Callable[[Modes], Array], margin: float) -> Worth:
    """Return the states that have a cost-to-go.

    A state x has none, Kx = 0, if no input is needed for it: it costs nothing, neither itself nor by the states that it
    moves, and the modes of all these decay, or lie on the edge of stability where no input moves them. Modes are those
    of states that move each other in circles, so that a chain of registers has the mode 0 however long it is.

    Args:
        given: the problem; its exact zeros tell what moves what.
        beyond: by how much modes are beyond the edge of stability.
        margin: how far inside it a mode must be to decay.
    """
    nothing = np.zeros(0, dtype=np.complex128)
    moved = np.asarray(given.A != 0, dtype=np.bool_)  # row by column
    needed = closure((given.Q != 0).any(axis=0) | (given.N != 0).any(axis=1), moved.T)
    resting = np.zeros(len(needed), dtype=np.bool_)
    if needed.all():
        return Worth(needed, nothing, nothing, resting)
    reached = closure((given.B != 0).any(axis=1), moved)
    leads = _paths(moved.T)
    left, decaying, still = ~needed, [nothing], [nothing]
    cycles: list[tuple[Bits, Modes]] = []
    while left.any():
        state = int(np.argmax(left))
        cycle = leads[state] & leads[:, state]
        left = left & ~cycle
        modes = eigenvalues(given.A[np.ix_(cycle, cycle)])
        cycles.append((cycle, modes))
        highest = float(beyond(modes).max())
        if highest >= -margin and (highest > SCATTER or reached[cycle].any()):
            needed = needed | leads[:, state]
    for cycle, modes in cycles:
        if not needed[cycle].any():
            inside = beyond(modes) < -margin
            decaying.append(modes[inside])
            still.append(modes[~inside])
            if not inside.all():
                resting = resting | cycle
    return Worth(needed, np.concatenate(decaying), np.concatenate(still), resting)


def closure(found: Bits, leads: Bits) -> Bits:
    """Return these states and all those to which they lead.

    Args:
        found: the states, (n,).
        leads: to which state, by row, which one leads, by column, (n, n).
    """
    while not found.all():
        more = found | leads[:, found].any(axis=1)
        if (more == found).all():
            break
        found = more
    return np.asarray(found, dtype=np.bool_)


def _paths(leads: Bits) -> Bits:
    """Return to which states, by column, each leads in any number of steps, itself included, (n, n)."""
    found = leads | np.eye(len(leads), dtype=np.bool_)
    while True:
        more = found.astype(np.float32) @ found.astype(np.float32) > 0
        if (more == found).all():
            return found
        found = np.asarray(more, dtype=np.bool_)
