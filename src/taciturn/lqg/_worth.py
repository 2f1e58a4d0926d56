"""Search for states whose cost-to-go is exactly zero, which are then left out of the Riccati equations.

Examples are registers that no noise reaches, and modes that nothing drives and that do not affect the cost. The cost of
such a state has no natural size to which an error could be relative, and iterations only halve it towards zero.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from taciturn._arrays import Array, Bits
from taciturn._modes import SCATTER, Modes, eigenvalues
from taciturn.lqg._axes import Quadratic


class Worth(NamedTuple):
    """Partition of the states into those with a nonzero cost-to-go and the others, with the modes of the others.

    Args:
        states: the states with a cost-to-go, for which the equation must be solved, (n,).
        decaying: decaying modes of the other states.
        still: marginally stable modes of the other states; no input affects them, so that they remain in the loop.
        resting: the states with these marginally stable modes, (n,).
    """

    states: Bits
    decaying: Modes
    still: Modes
    resting: Bits


def worth_of(given: Quadratic, beyond: Callable[[Modes], Array], margin: float) -> Worth:
    """Return the states with a nonzero cost-to-go, and the modes of the other states.

    A state x has no cost-to-go, Kx = 0, if it needs no input: neither the state nor any state that it affects has a
    weight, and all their modes decay, or are marginally stable and not affected by an input. Modes are computed for
    sets of states that affect each other in cycles, so that a chain of registers has the mode 0 for any length.

    Args:
        given: the problem; its exact zeros determine which state affects which.
        beyond: returns how far modes are beyond the stability limit.
        margin: how far inside the stability limit a decaying mode must be.
    """
    nothing = np.zeros(0, dtype=np.complex128)
    moved = np.asarray(given.A != 0, dtype=np.bool_)  # entry (i, j): state j affects state i
    needed = closure((given.Q != 0).any(axis=0) | (given.N != 0).any(axis=1), moved.T)
    resting = np.zeros(len(needed), dtype=np.bool_)
    if needed.all():
        return Worth(needed, nothing, nothing, resting)
    reached = closure((given.B != 0).any(axis=1), moved)
    leads = paths(moved.T)
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
    """Return the given states and all states that they affect, directly or through other states.

    Args:
        found: the states, (n,).
        leads: entry (i, j) is true if state j affects state i directly, (n, n).
    """
    while not found.all():
        more = found | leads[:, found].any(axis=1)
        if (more == found).all():
            break
        found = more
    return np.asarray(found, dtype=np.bool_)


def paths(leads: Bits) -> Bits:
    """Return the matrix whose entry (i, j) is true if i = j or a path leads from state i to state j, (n, n)."""
    found = leads | np.eye(len(leads), dtype=np.bool_)
    while True:
        more = found.astype(np.float32) @ found.astype(np.float32) > 0
        if (more == found).all():
            return found
        found = np.asarray(more, dtype=np.bool_)
