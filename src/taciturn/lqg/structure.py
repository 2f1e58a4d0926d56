"""Structure of a problem: states without a cost-to-go, and inputs that cost nothing, which are left out of equations.

States whose cost-to-go is exactly zero are, for example, registers that no noise reaches, and modes that nothing drives
and that do not affect the cost. The cost of such a state has no natural size to which an error could be relative, and
iterations only halve it towards zero. Which state affects which follows from the exact zeros of the matrices.

An input that costs nothing, now or later, moves states within a subspace in which other such inputs keep them (the
largest controllability subspace on which the cost is zero). For a filter, it is a combination of outputs that is known
in advance. The weight R + B'KB of such an input is zero, so no gain follows from the Riccati equation. The subspace is
computed in rational numbers: a double is one, and so is a rank of doubles.

Source: trentelman2001
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from flint import fmpq_mat

from taciturn._arrays import Array, Bits, is_definite
from taciturn._cycles import closure, in_cycles
from taciturn._display import Displayed
from taciturn._exact_modes import NONE, Limit, Lost, free_modes, modes_of
from taciturn._modes import SCATTER, Modes, eigenvalues, root
from taciturn._rational import above, basis, beside, is_semidefinite, kernel, lines, pivots, rational, right_inverse
from taciturn.lqg.quadratic import Quadratic

MARGIN = 1e-10  # least distance to the unit circle of a mode of rounded matrices that counts as decaying


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


Before: TypeAlias = tuple[Quadratic, Limit]  # a problem before sampling and discount, and the edge of its modes


def worth_of(given: Quadratic, continuous: bool = False, rounded: bool = True, before: Before | None = None) -> Worth:
    """Return the states with a nonzero cost-to-go, and the modes of the other states.

    A state x has no cost-to-go, Kx = 0, if it needs no input: neither the state nor any state that it affects has a
    weight, and all their modes decay, or are marginally stable and not affected by an input. Modes are computed for
    sets of states that affect each other in cycles, so that a chain of registers has the mode 0 for any length.

    Args:
        given: the problem; its exact zeros determine which state affects which.
        continuous: whether time is continuous.
        rounded: whether the doubles of the matrices are rounded, such as those of a sampled plant: the modes of several
            states then count as marginal up to this rounding. Otherwise their modes are exact.
        before: the problem before it was sampled, whose modes are known exactly and decide.
    """
    nothing = np.zeros(0, dtype=np.complex128)
    moved = np.asarray(given.A != 0, dtype=np.bool_)  # entry (i, j): state j affects state i
    needed = closure((given.Q != 0).any(axis=0) | (given.N != 0).any(axis=1), moved.T)
    resting = np.zeros(len(needed), dtype=np.bool_)
    if needed.all():
        return Worth(needed, nothing, nothing, resting)
    reached = closure((given.B != 0).any(axis=1), moved)
    cycles: list[tuple[Bits, Lost]] = []
    decaying, still = [nothing], [nothing]
    for cycle in in_cycles(moved):
        if needed[cycle].any():
            continue
        A = given.A[np.ix_(cycle, cycle)]
        modes = _modes_of(A, continuous, rounded) if before is None else _sampled(*before, cycle)
        cycles.append((cycle, modes))
        if modes.growing.size or (modes.staying.size and reached[cycle].any()):
            needed = closure(needed | cycle, moved.T)
    for cycle, modes in cycles:
        if not needed[cycle].any():
            decaying.append(modes.decaying)
            still.append(modes.staying)
            if modes.staying.size:
                resting = resting | cycle
    return Worth(needed, np.concatenate(decaying), np.concatenate(still), resting)


def _modes_of(A: Array, continuous: bool, rounded: bool) -> Lost:
    """Return the modes of states that affect each other, on each side of the stability limit."""
    if not rounded:
        return free_modes(A, Limit(continuous))
    modes = eigenvalues(A)
    outside = modes.real if continuous else np.abs(modes) - 1
    margin, scatter = (0.0, 0.0) if len(A) == 1 else (0.0 if continuous else MARGIN, SCATTER)
    growing, decaying = outside > scatter, outside < -margin
    return Lost(modes[growing], modes[~growing & ~decaying], modes[decaying])


def _sampled(given: Quadratic, limit: Limit, cycle: Bits) -> Lost:
    """Return the modes of some states from step to step, on the sides of the limit that they have before sampling."""
    found, root = free_modes(given.A[np.ix_(cycle, cycle)], limit), np.sqrt(limit.discount)
    return Lost(*(root * np.exp(modes * limit.period) for modes in found))


@dataclass(frozen=True, eq=False, repr=False)
class Free(Displayed):
    """Inputs that cost nothing, and the subspace in which they move the state.

    A state x = inside·a + e has coordinates a, its entries at ``places``, and a rest e that is zero there. The inputs
    u = keeping·a + moving·w cost nothing, and move a to (A x + B u) at ``places``.

    Args:
        inside: a basis of the subspace, the identity at ``places``, (n, r).
        places: mask of the states that are coordinates of the subspace, (n,).
        keeping: inputs that keep the columns of ``inside`` in the subspace without cost, (m, r).
        moving: inputs that move the state within the subspace without cost, (m, f).
        others: mask of inputs that complete ``moving`` to all inputs, (m,).
    """

    inside: fmpq_mat
    places: Bits
    keeping: fmpq_mat
    moving: fmpq_mat
    others: Bits


def unpaid(given: Quadratic, limit: Limit) -> Lost:
    """Return the modes along which inputs can keep the state moving at no cost; none are known with free inputs.

    They are the eigenvalues of the problem on the largest subspace in which inputs keep the state without cost, the
    invariant zeros of (A, B, [C, D]) with the weight [C, D]'[C, D] of states and inputs. The closed loop of an optimal
    gain has them, mirrored into the region of decay. So none of them may lie on its edge.

    Args:
        given: the problem, as it was before sampling; its weights are semidefinite, at least up to rounding.
        limit: the edge of the modes that count as decaying.
    """
    definite, weight = is_definite(given.R), np.block([[given.Q, given.N], [given.N.T, given.R]])
    if limit.continuous and not definite:
        return NONE  # free inputs move the state at once, but not an input that is held
    rows = rational(weight if is_semidefinite(weight) else root(weight).T)
    if not definite and free_inputs(given, rows) is not None:
        return NONE
    safe, A, B, state, push = _kept_for_nothing(given, rows)
    r = safe.ncols()
    if not r:
        return NONE
    after = fmpq_mat(rows.nrows(), r)
    found = kernel(above(beside(state * safe, push, after), beside(A * safe, B, safe * -1)))
    now, later = lines(found, range(r)), lines(found, range(found.nrows() - r, found.nrows()))
    return modes_of(later * now.inv(), limit)


def _kept_for_nothing(given: Quadratic, rows: fmpq_mat) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat]:
    """Return a basis of the states that inputs keep at no cost for ever; A and B; rows of the states and the inputs."""
    n, A, B, turned = len(given.A), rational(given.A), rational(given.B), rows.transpose()
    state, push = (lines(turned, some).transpose() for some in (range(n), range(n, turned.nrows())))
    safe, nothing = rational(np.eye(n)), fmpq_mat(rows.nrows(), n)
    while True:
        found = kernel(above(beside(state, push, nothing), beside(A, B, safe * -1)))
        smaller = basis(lines(found, range(n)))
        nothing = fmpq_mat(rows.nrows(), smaller.ncols())
        if smaller.ncols() == safe.ncols():
            return safe, A, B, state, push
        safe = smaller


def free_inputs(given: Quadratic, rows: fmpq_mat) -> Free | None:
    """Return the inputs of a problem that cost nothing, now or later; None if there is none.

    Args:
        given: the problem, of which A and B are used.
        rows: combinations of states and inputs that are zero if and only if these cost nothing, (any, n + m).
    """
    (n, m), z = given.B.shape, rows.nrows()
    safe, A, B, state, push = _kept_for_nothing(given, rows)
    inside, keeping, nothing = fmpq_mat(n, 0), fmpq_mat(m, 0), fmpq_mat(z, safe.ncols())
    while True:  # states that they reach from zero meanwhile
        r = inside.ncols()
        found = kernel(above(beside(state * inside, push, nothing), beside(A * inside, B, safe * -1)))
        larger = basis(safe * lines(found, range(r + m, found.nrows())))
        if larger.ncols() == r:
            break
        inside = larger
    r = inside.ncols()
    nothing = fmpq_mat(z, r)
    moving = basis(lines(kernel(above(beside(push, nothing), beside(B, inside * -1))), range(m)))
    if not moving.ncols():
        return None
    found = kernel(above(beside(state * inside, push, nothing), beside(A * inside, B, inside * -1)))
    keeping = lines(found, range(r, r + m)) * right_inverse(lines(found, range(r)))
    return Free(inside, pivots(inside), keeping, moving, ~pivots(moving))
