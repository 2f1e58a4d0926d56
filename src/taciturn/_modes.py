"""Analysis of linear maps x⁺ = A x: modes, scaling of states, factors of covariances, invariant subspaces, moments.

Units. A similarity D^{-1}AD with powers of two in D rounds nothing, so that results do not depend on the units that a
user chose. ``balancing`` makes rows and columns similar; ``reach`` makes each input of 1 move every state by about 1,
relative to the largest geometric mean of entries along a cycle, which no change of units moves (Karp's theorem).

Covariances. G with GG' = W is computed from the correlation matrix, whose entries have no units.

Subspaces. ``invariant`` adds the images of all maps to a basis until nothing new of relative length above ``_SAME``
appears. ``summed`` adds 2^k terms of Σ F^k W F'^k by k doublings.

Growth. The moments of a random linear system, such as a loop over lossy links, move by a linear map. Their growth is
the largest modulus of its eigenvalues. Arnoldi's method computes the largest eigenvalues of the restriction of the map
to the Krylov space of the moments, and estimates their error: the residual, divided by the cosine of the angle between
the left and the right eigenvector. Several eigenvalues of the same modulus, such as those of the modes of a loop with
links of their own, do not delay it. If the largest eigenvalue is defective, such as the common pole of a filter and of
its copy, this angle is a right angle and the estimate has no use. Then the growth is the average factor per step over
the second half of many steps, which converges for every map, but slowly: like 1/steps, and with beats of eigenvalues of
the same modulus.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from taciturn import _arrays
from taciturn._arrays import NO_VARIANCE, Array, Bits

Modes: TypeAlias = npt.NDArray[np.complex128]
ROUNDOFF = float(np.finfo(np.float64).eps) / 2
COST_ERROR = 1e-6  # largest relative error of a returned cost; rounding alone causes 1e-14 to 1e-9
SCATTER = 1e-7  # computed eigenvalues of a defective matrix scatter by the root of the rounding error
_LARGEST = 1e140  # limit on a power of a stable map: its square is still finite
_FADED = 1e-4  # squared norm of a power of a stable map below which its sum may have converged
_SAME = 1e-10  # relative length below which a new direction is treated as a rounding error
_STEPS = 4096  # largest number of steps from which the growth is computed
_ACCURACY = 1e-3  # relative accuracy of the logarithm of the growth, if it is computed from steps
_PRECISE = 1e-6  # relative error of an eigenvalue of Arnoldi's method that is accepted
_BASIS = 64  # largest dimension of a Krylov space
_LOOKS = 4  # dimensions between two computations of eigenvalues
_FROM = (0, 64, 512)  # steps after which a Krylov space starts; they enlarge the share of the largest eigenvalues
_VANISHES = 1e-14  # relative size of a new direction that is a rounding error


def eigenvalues(A: Array) -> Modes:
    """Compute the eigenvalues of ``A``, sorted by decreasing modulus."""
    values = np.asarray(np.linalg.eigvals(A), dtype=np.complex128)
    return values[np.argsort(-np.abs(values), kind="stable")]


def radius(A: Array) -> float:
    """Compute the spectral radius of ``A``: the largest modulus of its eigenvalues."""
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))


def pace(A: Array) -> float:
    """Compute the largest entry of the balanced matrix ``A``, with which rounding errors of its modes are compared."""
    scale = balancing(A)
    return float(np.abs(A / scale[:, None] * scale).max(initial=0.0))


def mode_text(mode: complex, digits: int = 6) -> str:
    """Write an eigenvalue as text for an error message, with the given number of digits."""
    if abs(mode.imag) <= 1e-12 * max(abs(mode), 1e-300):
        return f"{mode.real:.{digits}g}"
    return f"{mode.real:.{digits}g}{mode.imag:+.{digits}g}i"


def least_eigenvalue(matrix: Array) -> float:
    """Compute the least eigenvalue of a symmetric matrix: accurate in any units if positive, and otherwise ≤ 0."""
    # Definiteness is decided by the eigenvalues after scaling to a unit diagonal. The least eigenvalue is then computed
    # as the inverse of the largest eigenvalue of the inverse, which the rounding of large entries does not affect.
    diagonal = np.diag(matrix)
    if not (diagonal > NO_VARIANCE).all():
        return min(float(np.linalg.eigvalsh(matrix)[0]), 0.0)
    unit = np.sqrt(diagonal)
    scaled = matrix / unit / unit[:, None]
    smallest = float(np.linalg.eigvalsh(scaled)[0])
    if smallest <= 1e-12:
        return min(float(np.linalg.eigvalsh(matrix)[0]), smallest, 0.0)
    inverse = np.linalg.inv(scaled) / unit / unit[:, None]
    return 1 / float(np.linalg.eigvalsh(_arrays.symmetrised(np.asarray(inverse, dtype=np.float64)))[-1])


def balancing(A: Array) -> Array:
    """Compute a diagonal matrix D of powers of two, such that the rows and columns of D⁻¹AD have similar norms."""
    # Each state in turn is scaled so that the norms of its row and column are most similar, until no scaling gains 5 %.
    balanced, scale = A / max(float(np.abs(A).max(initial=0.0)), NO_VARIANCE), np.ones(len(A))
    while _may_gain(balanced):
        gains = False
        for i in range(len(A)):
            row, column = math.sqrt(balanced[i] @ balanced[i]), math.sqrt(balanced[:, i] @ balanced[:, i])
            if row == 0 or column == 0:
                continue
            factor = 2.0 ** round(math.log2(row / column) / 2)
            if column * factor + row / factor < 0.95 * (row + column):
                gains = True
                scale[i] *= factor
                balanced[i] /= factor
                balanced[:, i] *= factor
        if not gains:
            break
    return scale


def _may_gain(A: Array) -> bool:
    """Return whether the row and column of a state differ so much (a factor of two) that scaling may help."""
    squares = A * A
    rows, columns = squares.sum(axis=1), squares.sum(axis=0)
    return bool(((rows > 1.9 * columns) & (columns > 0) | (columns > 1.9 * rows) & (rows > 0)).any())


def reach(A: Array, B: Array) -> tuple[Array, Array]:
    """Choose units of the states and inputs, such that one unit of an input changes the affected states by about one
    unit.
    """
    # The unit of a state is the largest direct effect of an input on it. Other states get the largest effect of states
    # with known units, relative to the couplings in cycles. This reverses a change of units, also of uncoupled states.
    balanced = balancing(A)
    off = np.abs(A - np.diag(np.diag(A)))
    largest = largest_cycle(off) or 1.0  # so that no cycle increases a unit
    state, inputs = balanced, np.ones(B.shape[1])
    for _ in range(3):  # each unit depends on the other
        moved = (np.abs(B) / state[:, None]).max(axis=0, initial=0.0)
        inputs = 1 / np.where(moved > NO_VARIANCE, moved, 1.0)
        found = np.max(np.abs(B) * inputs, axis=1, initial=0.0)
        for _ in range(len(A)):
            found, before = np.maximum(found, (off * found).max(axis=1, initial=0.0) / largest), found
            if (found <= before).all():
                break
        state = np.where(found > NO_VARIANCE, found, 0.0)
        if not state.all():  # unreached states: the size that balancing gives them
            beside = np.max(state / balanced, initial=0.0)
            state = np.where(state > 0, state, balanced * (beside if beside > 0 else 1.0))
    return np.exp2(np.round(np.log2(state))), np.exp2(np.round(np.log2(inputs)))


def largest_cycle(A: Array) -> float:
    """Compute the largest geometric mean, over all cycles, of a nonnegative matrix's entries along a cycle, or 0."""
    # No change of units of the states changes it. If W_k(i) is the largest product of entries along k steps to i, it is
    # the largest over i of the least (W_n(i) / W_k(i))^(1/(n − k)) over k < n (Karp's theorem).
    n = len(A)
    with np.errstate(divide="ignore"):
        steps = np.log(A)
    walks = np.zeros((n + 1, n))
    for k in range(n):
        walks[k + 1] = (steps + walks[k]).max(axis=1, initial=-np.inf)
    cyclic = np.isfinite(walks[-1])
    if not cyclic.any():
        return 0.0
    means = (walks[-1, cyclic] - walks[:-1, cyclic]) / np.arange(n, 0, -1)[:, None]
    return float(np.exp(means.min(axis=0).max()))


def closure(found: Bits, leads: Bits) -> Bits:
    """Add to ``found`` all states that the states in ``found`` affect, directly or through other states."""
    while not found.all():
        more = found | leads[:, found].any(axis=1)
        if (more == found).all():
            break
        found = more
    return np.asarray(found, dtype=np.bool_)


def paths(leads: Bits) -> Bits:
    """Compute which states affect which: entry (i, j) is true if i = j, or if ``leads`` has a path from j to i."""
    found = leads | np.eye(len(leads), dtype=np.bool_)
    while True:
        more = found.astype(np.float32) @ found.astype(np.float32) > 0
        if (more == found).all():
            return found
        found = np.asarray(more, dtype=np.bool_)


def in_cycles(leads: Bits) -> list[Bits]:
    """Partition the states into groups whose states affect each other in cycles; return one mask per group."""
    found = list[Bits]()
    linked = paths(leads)
    both, left = linked & linked.T, np.ones(len(leads), dtype=np.bool_)
    while left.any():
        found.append(both[int(np.argmax(left))])
        left &= ~found[-1]
    return found


def root(matrix: Array, beside: Array | None = None, crumb: float = 1e-13) -> Array:
    """Compute G with ``matrix`` = G G' and one column per nonzero eigenvalue, whatever the units of the states."""
    spread = np.diag(matrix if beside is None else beside)
    scale = np.sqrt(np.where(spread > NO_VARIANCE, spread, 0.0))
    inverse = np.where(scale > 0, 1 / np.where(scale > 0, scale, 1.0), 0.0)
    values, vectors = np.linalg.eigh(matrix * inverse * inverse[:, None])
    kept = values > crumb * len(matrix)
    return scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])


def factor(covariance: Array) -> Array:
    """Compute a factor G of ``covariance`` = G G'. For an invertible covariance, G is the cheaper Cholesky factor."""
    found = root(covariance)
    if found.shape[1] == len(covariance):
        found[:] = np.linalg.cholesky(covariance)
    return found


def symmetric_factor(covariance: Array) -> Array:
    """Compute G = D S with ``covariance`` = G G': D holds standard deviations, and S S' is the correlation matrix."""
    # Unlike a Cholesky factor, it does not depend on the order of the states or on their units: states in another order
    # have the rows and columns of G in this order. A covariance of rank one has the only column that it can have.
    if (found := root(covariance)).shape[1] == 1:
        return found
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    inverse = np.where(scale > 0, 1 / np.where(scale > 0, scale, 1.0), 0.0)
    values, vectors = np.linalg.eigh(covariance * inverse * inverse[:, None])
    found = scale[:, None] * ((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
    return found[:, scale > 0]


def summed(F: Array, W: Array) -> Array:
    """Compute the infinite sum Σ_k F^k W F'^k for a stable matrix F."""
    X, power = np.array(W), np.array(F)
    with np.errstate(over="ignore", invalid="ignore"):  # the callers check for overflow
        for _ in range(64):  # 2^64 terms
            term = power @ X @ power.T
            X = X + term
            square = float(np.vdot(power, power))
            if not square < _LARGEST**2:
                return X * np.inf
            if square < _FADED and (np.abs(term.diagonal()) <= 1e-17 * np.abs(X.diagonal())).all():
                break
            power = power @ power
        return (X + X.T) / 2


def invariant(columns: Array, maps: Sequence[Array]) -> Array:
    """Compute an orthonormal basis of the smallest subspace that contains the columns and that all maps leave
    invariant.
    """
    basis = np.zeros((len(columns), 0))
    new = _added(columns, basis)
    scales = [float(np.linalg.norm(map_, 2)) or 1.0 for map_ in maps]
    while new.shape[1]:
        basis = np.column_stack([basis, new])
        moved = [map_ @ new / scale for map_, scale in zip(maps, scales, strict=True)]
        new = _added(np.column_stack(moved), basis)
    return basis


def unit_columns(columns: Array) -> Array:
    """Normalise the nonzero columns to length 1, and omit the zero columns."""
    lengths = np.linalg.norm(columns, axis=0)
    return columns[:, lengths > 0] / lengths[lengths > 0]


def _added(columns: Array, basis: Array) -> Array:
    """Return orthonormal columns for the part of the given columns that is orthogonal to the basis."""
    rest = columns
    for _ in range(2):  # the second pass removes rounding errors of the first
        rest = rest - basis @ (basis.T @ rest)
    left, values, _ = np.linalg.svd(rest, full_matrices=False)
    return left[:, values > _SAME]


def growth(move: Callable[[Array], Array], moments: Array) -> float:
    """Compute the asymptotic growth factor, per step, of moments to which the linear map ``move`` is applied in each
    step.
    """
    # The moments start from those of a distribution with a density. Then all other moments are at most a multiple of
    # these, and grow at most as fast, so that the Krylov space of these moments contains the largest eigenvalue.
    size, earlier, paces = 0.0, 0.0, [math.inf, math.inf]  # logarithms
    for step in range(_STEPS + 1):
        if step in _FROM and (found := _largest(move, moments)) is not None:
            return found
        if step and step & (step - 1) == 0:  # the average of the second half of the steps
            paces.append((size - earlier) / max(1, step - step // 2))
            earlier = size
            if step > _FROM[-1] and max(abs(pace - paces[-1]) for pace in paces[-3:]) <= _ACCURACY * abs(paces[-1]):
                break
        moments = move(moments)
        factor = float(np.linalg.norm(moments))
        if not 0.0 < factor < math.inf:
            return factor
        moments = moments / factor
        size += math.log(factor)
    return math.exp(paces[-1])


def _largest(move: Callable[[Array], Array], start: Array) -> float | None:
    """Return the largest modulus of an eigenvalue by Arnoldi's method, or None if its error may be large."""
    basis = np.zeros((_BASIS + 1, start.size))
    H = np.zeros((_BASIS + 1, _BASIS))
    basis[0] = start.ravel() / np.linalg.norm(start)
    for k in range(_BASIS):
        moved = move(basis[k].reshape(start.shape)).ravel()
        length = float(np.linalg.norm(moved))
        if not length < math.inf:
            return None
        for _ in range(2):  # again, so that rounding errors do not spoil the orthogonality
            along = basis[: k + 1] @ moved
            moved = moved - along @ basis[: k + 1]
            H[: k + 1, k] += along
        H[k + 1, k] = new = float(np.linalg.norm(moved))
        ends = new <= _VANISHES * length
        if ends or (k + 1) % _LOOKS == 0:
            found = _eigenvalue(H[: k + 1, : k + 1], 0.0 if ends else new)
            if found is not None or ends:
                return found
        basis[k + 1] = moved / new
    return None


def _eigenvalue(H: Array, rest: float) -> float | None:
    """Return the largest modulus of an eigenvalue of a Hessenberg matrix, or None if its error may be too large."""
    values, right = np.linalg.eig(H)
    i = int(np.argmax(np.abs(values)))
    largest = float(np.abs(values[i]))
    if largest == 0.0:
        return 0.0 if rest == 0.0 else None
    others, left = np.linalg.eig(H.T)
    j = int(np.argmin(np.abs(others - values[i])))
    cosine = float(np.abs(left[:, j] @ right[:, i]))
    error = (rest * float(np.abs(right[-1, i])) + np.finfo(float).eps * float(np.linalg.norm(H))) / max(cosine, 1e-300)
    return largest if error <= _PRECISE * largest else None


def normal_moments(size: int, order: int) -> Array:
    """Compute all moments of the given even order of a vector of independent standard normal variables."""
    # The result has one index per factor: the moment of order 2 is the unit matrix.
    if order == 0:
        return np.ones(())
    first = np.multiply.outer(np.eye(size), normal_moments(size, order - 2))  # the first factor paired with the second
    return np.sum([np.moveaxis(first, 1, other) for other in range(1, order)], axis=0)
