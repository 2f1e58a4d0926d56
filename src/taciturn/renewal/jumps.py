"""Send rate and excess cost of an error with normally distributed jumps at Poisson times, by quadrature."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from taciturn._arrays import Array, number, symmetrised
from taciturn._modes import root
from taciturn._progress import OutOfTime, Progress, Stages
from taciturn.renewal._jump_density import CompoundPoissonNoise, Fineness
from taciturn.renewal._jump_line import Line
from taciturn.renewal._jump_plane import Plane, PlaneGrid
from taciturn.renewal._jump_sums import Sums
from taciturn.renewal.chain import Chain, JumpNoise, NoQuadratureError, Renewal

RANK = 1e-10  # relative: a smaller singular value is rounding
SAFETY = 16.0  # claimed error over the change at the last refinement; in the plane the levels share part of it
USELESS = 0.01  # claimed relative error above which a result is rejected
FLOOR = 1e-11  # relative error due to rounding
FORGOTTEN = 1e-12  # probability below which a longer run of checks without a jump is not followed
LONGEST = {1: 400, 2: 80}  # checks without a jump that are followed one by one, by dimension
RARE = 1e-3  # largest probability of more checks without a jump than LONGEST
FAR = 1e-6  # largest fraction of the checks with an error beyond the truncation of the set
CUTS = 14  # how many times the truncation is moved outwards
FINENESS = (Fineness(32, 24, 384), Fineness(48, 40, 800), Fineness(56, 48, 1200))


def solve_jumps(chain: Chain, accuracy: float = 1e-7, progress: Progress | None = None) -> Renewal:
    """Return the send rate and the excess cost of an error with normally distributed jumps at Poisson times.

    Between two jumps the error moves deterministically: after a fraction e^{−λτ} of the checks, e⁺ = F e exactly. So an
    expectation over later checks is discontinuous wherever F^j e leaves the set of unsent errors. After a jump it is
    smooth. The equations are therefore written for expectations after a jump, represented by polynomials, and every
    integral is split at these discontinuities.

    Args:
        chain: chain with normal jumps as noise, in at most two dimensions that the jumps reach and that Ψ or Γ weighs.
        accuracy: requested relative error; the result contains the error that was reached.
        progress: called with the fraction done.

    Returns:
        Rate and excess with claimed errors: sixteen times the change at the last refinement. In two dimensions some
        five digits take seconds, six up to a minute.

    Raises:
        NoQuadratureError: more than two dimensions, another distribution, jumps that turn by half a turn within a
            period or are nearly flat or rare, an error that is never sent, a threshold too large for the noise, or
            refinements that do not agree.
        ProblemError: an accuracy that is not positive.

    Source: khashooei2017
    """
    number("accuracy", accuracy, 0.0)
    noise = chain.noise
    if not isinstance(noise, JumpNoise):
        raise NoQuadratureError(
            "the noise does not consist of jumps; expected jump noise, the only noise that this quadrature supports"
        )
    if noise.jumps.distribution != "normal":
        raise NoQuadratureError(
            f"jumps with the distribution '{noise.jumps.distribution}' have no smooth density; expected 'normal'; "
            "simulate instead"
        )
    A, G, F, Psi, Gamma = _reduced(noise.A, root(noise.jumps.covariance), chain)
    if not Psi.size or not (np.abs(Psi) > 0).any():
        raise NoQuadratureError(
            "nothing would ever be sent: the jumps reach no direction of the error that Ψ weighs; expected at least "
            "one such direction; weigh the states that the jumps reach"
        )
    if len(A) > 2:
        raise NoQuadratureError(
            f"the jumps move the error in {len(A)} dimensions that Ψ or Γ weighs, but this quadrature supports at most "
            "two; simulate instead"
        )
    rate, period, told = noise.jumps.rate, noise.period, Stages(progress)
    checks = _followed(rate * period, LONGEST[len(A)])
    if len(A) == 1:
        jump = float(np.sqrt((G @ G.T)[0, 0]))
        bound = float(np.sqrt(chain.delta / Psi[0, 0]))
        line = Line(float(A[0, 0]), jump, rate, period, float(F[0, 0]), bound, float(Gamma[0, 0]))
        levels = zip((1.0, 1.5, 2.0, 3.0), (0.7, 0.8, 0.9, 1.0), strict=True)
        return _refined((line.sums(fineness, _share(checks, share)) for fineness, share in levels), accuracy, told)
    plane = Plane(CompoundPoissonNoise(A, G, rate, period), F, Psi / chain.delta, Gamma)
    return _refined(_planes(plane, checks), accuracy, told)


def _followed(mean: float, most: int) -> int:
    """Return the number of checks without a jump that are followed, given the mean number of jumps per period."""
    if np.exp(-mean * most) > RARE:
        raise NoQuadratureError(
            f"{mean:.3g} jumps per period on average are too rare for this quadrature; check less often, or simulate"
        )
    return max(1, min(int(np.ceil(-np.log(FORGOTTEN) / mean)), most))


def _share(checks: int, share: float) -> int:
    return max(1, int(checks * share))


def _planes(plane: Plane, checks: int) -> Iterator[Sums]:
    """Yield the equations in the plane on finer and finer grids, truncated where hardly any error comes."""

    def grid(level: int, cut: float) -> PlaneGrid:
        more = 1 + 0.25 * level
        along = 2 * int(more * (5 + 0.22 * min(cut, plane.long)))
        across = int(more * (7 + 2.5 * plane.short))
        followed = _share(checks, 0.7 + 0.15 * level)
        return PlaneGrid(along, across, 8 + 4 * level, 12 + 3 * level, followed, cut, FINENESS[level])

    cut = 8.0
    for _ in range(CUTS):
        coarse = plane.sums(grid(0, cut))
        if cut >= plane.long or coarse.outskirts() < FAR:
            break
        cut *= 1.5
    else:
        raise NoQuadratureError("between sends, the error spreads too far for this quadrature; simulate instead")
    yield coarse
    for level in range(1, len(FINENESS)):
        yield plane.sums(grid(level, cut * (1 + 0.15 * level)))


def _refined(levels: Iterator[Sums], accuracy: float, told: Stages) -> Renewal:
    """Return the result of the first level that agrees with the previous one to the accuracy, or of the last level."""
    found = np.full(2, np.nan)
    change = np.full(2, np.inf)
    sums = None
    for level, sums in enumerate(levels):
        before = found
        checks, cost = sums.cycle()
        found = np.array([1 / checks, cost / checks])
        change = SAFETY * np.abs(found - before) + FLOOR * np.abs(found)
        if (change <= accuracy * np.abs(found)).all():
            break
        try:
            told((level + 1) / len(FINENESS))
        except OutOfTime:
            if np.isnan(before).any():
                raise
            break
    assert sums is not None
    off = float((change / np.abs(found)).max())
    if off > USELESS:
        raise NoQuadratureError(
            f"rate and excess cost have a relative error of {off:.1g}; expected at most {USELESS:g}; use a smaller "
            "threshold δ, or "
            "simulate instead"
        )
    rate, excess = (float(value) for value in found)
    return Renewal(rate, excess, float(change[0]), float(change[1]), sums.intervals(1 / rate), sums.basis.shape[0])


def _reduced(A: Array, G: Array, chain: Chain) -> tuple[Array, Array, Array, Array, Array]:
    """Return A, G, F, Ψ and Γ restricted to the directions that jumps reach and that Ψ or Γ weighs."""
    reached = _span(A, G)
    A, G, F = reached.T @ A @ reached, reached.T @ G, reached.T @ chain.F @ reached
    Psi, Gamma = symmetrised(reached.T @ chain.Psi @ reached), symmetrised(reached.T @ chain.Gamma @ reached)
    seen = _span(A.T, np.hstack([root(Psi), root(Gamma)])) if len(A) else np.zeros((0, 0))
    A, G, F = seen.T @ A @ seen, seen.T @ G, seen.T @ F @ seen
    return A, G, F, symmetrised(seen.T @ Psi @ seen), symmetrised(seen.T @ Gamma @ seen)


def _span(A: Array, start: Array) -> Array:
    """Return an orthonormal basis of the smallest A-invariant subspace that contains the columns of ``start``."""
    basis, fresh = np.zeros((len(A), 0)), start
    while fresh.shape[1]:
        fresh = fresh - basis @ (basis.T @ fresh)
        lengths = np.linalg.norm(fresh, axis=0)
        fresh = fresh[:, lengths > 0]
        left, sizes, _ = np.linalg.svd(fresh, full_matrices=False)
        scale = max(float(np.linalg.norm(A, 2)), 1e-300) if basis.shape[1] else float(sizes.max(initial=0.0))
        added = left[:, sizes > RANK * scale]
        basis = np.hstack([basis, added])
        fresh = A @ added
    return basis
