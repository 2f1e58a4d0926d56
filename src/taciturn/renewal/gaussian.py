"""Rate and cost of a chain with Gaussian noise: renewal equations by quadrature, with the error that is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, number, symmetrised
from taciturn.renewal._intervals import intervals
from taciturn.renewal._nodes import Nodes, Resolution, TooManyNodes, place
from taciturn.renewal._whiten import White, spread, whiten
from taciturn.renewal.chain import Chain, NoQuadratureError, Renewal

MOST_NODES = 6000  # a dense system of this size takes seconds
COARSE = Resolution(0.6, 8.0)
FIRST = Resolution(0.75, 9.0)
FINER, WIDER = 1.25, 1.15  # from one resolution to the next
RUNGS = 12
PASSES = 8
ROUNDING = 4e-16  # per check of the mean interval
USELESS = 0.01  # relative error


@dataclass(frozen=True, eq=False)
class _System:
    """The kept error on nodes: its density times weight after one check, and the map of a check.

    Args:
        x: (nodes, n).
        start: (nodes,).
        kernel: K, from rows to columns, (nodes, nodes).
        cost: x'Γx, (nodes,).
    """

    x: Array
    start: Array
    kernel: Array
    cost: Array


@dataclass(frozen=True, eq=False)
class _Solved:
    system: _System
    checks: Array
    rate: float
    excess: float


def solve_gaussian(chain: Chain, accuracy: float = 1e-8) -> Renewal:
    """Return rate and cost of a chain with Gaussian noise.

    With k the density of the next error, E = {e: e'Ψe ≤ δ}: T = 1 + ∫_E k T and C = e'Γe + ∫_E k C are the checks
    and the cost still to come in an interval; the rate is 1/T₀, the excess C₀/T₀, both from an error of 0.

    The coordinates make the noise white and Ψ diagonal. Nodes stand on nested chords of E, as far as kept errors
    get. Resolution and window grow together until both numbers settle; what they last moved by is the error
    claimed, which is that of the coarser answer.

    Args:
        chain: with Gaussian noise.
        accuracy: relative, of rate and excess; where it is out of reach the errors say what was attained.

    Returns:
        Rate, excess, their errors and the distribution of the intervals.

    Raises:
        NoQuadratureError: more than three directions count, a direction gets no noise in a check, nothing is
            ever sent, or more nodes are needed than can be afforded.

    Source: khashooei2017

    Example:
        >>> unit = np.eye(1)
        >>> found = solve_gaussian(Chain(unit, unit, unit, 1.0, unit))
        >>> round(found.rate, 6)
        0.451889
    """
    number("accuracy", accuracy, 0.0, 1.0)
    white = whiten(chain)
    covariance = _kept_covariance(white)
    resolution, previous, best, errors = FIRST, None, None, (np.inf, np.inf)
    for _ in range(RUNGS):
        try:
            found = _solve(white, place(white, covariance, resolution, MOST_NODES))
        except TooManyNodes:
            break
        if found is not None and previous is not None:
            attained = _errors(found, previous)
            if best is None or attained[0] / found.rate <= errors[0] / best.rate:
                best, errors = found, attained
            if attained[0] <= accuracy * found.rate and attained[1] <= accuracy * found.excess:
                best, errors = found, attained
                break
        previous = found
        resolution = Resolution(resolution.density * FINER, resolution.reach * WIDER)
    if best is None or errors[0] > USELESS * best.rate:
        raise NoQuadratureError(
            f"the errors that are kept spread over too many noise standard deviations for {MOST_NODES} nodes, or are "
            "sent too rarely for floating point; expected a smaller δ or more noise for a quadrature; simulate instead"
        )
    return Renewal(best.rate, best.excess, *errors, intervals(best.system.start, best.system.kernel, best.checks), len(best.checks))


def _kept_covariance(white: White) -> Array:
    """Return the covariance of kept errors as coarse nodes see it, on windows that they set themselves."""
    covariance = spread(white)
    for _ in range(PASSES):
        try:
            system = _discretise(white, place(white, covariance, COARSE, MOST_NODES // 2))
        except TooManyNodes:
            break
        unit = np.eye(len(system.start))
        visits = np.linalg.solve(unit - system.kernel.T, system.start)
        found = symmetrised((system.x * visits[:, None]).T @ system.x / visits.sum())
        if not np.isfinite(found).all() or np.linalg.eigvalsh(found)[0] <= 0:
            break
        ratio = np.linalg.eigvals(np.linalg.solve(covariance, found)).real
        covariance = found
        if 0.8 < ratio.min() and ratio.max() < 1.1:
            break
    return covariance


def _discretise(white: White, nodes: Nodes) -> _System:
    """Return the map of a check on even functions: what comes to −x counts for x."""
    n = len(white.m)
    density = (2 * np.pi) ** (-n / 2) * nodes.weight
    kernel = _gauss(nodes.x @ white.F.T, nodes.x)
    kernel += _gauss(nodes.x @ white.F.T, -nodes.x)
    kernel *= density
    start = 2 * density * np.exp(-0.5 * (nodes.x * nodes.x).sum(axis=1))
    return _System(nodes.x, start, kernel, ((nodes.x @ white.Gamma) * nodes.x).sum(axis=1))


def _gauss(means: Array, x: Array) -> Array:
    """Return exp(−½|x_j − mean_i|²); differences, as large coordinates would cancel in squares."""
    power = np.zeros((len(means), len(x)))
    for axis in range(x.shape[1]):
        difference = means[:, axis, None] - x[:, axis]
        difference *= difference
        power += difference
    power *= -0.5
    np.maximum(power, -600.0, out=power)  # subnormal numbers are slow
    return np.exp(power, out=power)


def _solve(white: White, nodes: Nodes) -> _Solved | None:
    """Return the solution on some nodes, or None where they are too coarse to have one."""
    system = _discretise(white, nodes)
    known = np.stack([np.ones(len(system.start)), system.cost], axis=1)
    solution = np.linalg.solve(np.eye(len(known)) - system.kernel, known)
    checks, cost = 1 + float(system.start @ solution[:, 0]), float(system.start @ solution[:, 1])
    if not np.isfinite(solution).all() or checks < 1 or cost < 0:
        return None
    return _Solved(system, solution[:, 0], 1 / checks, cost / checks)


def _errors(found: _Solved, previous: _Solved) -> tuple[float, float]:
    rounding = ROUNDING * (20 + 1 / found.rate)
    return (
        abs(found.rate - previous.rate) + rounding * found.rate,
        abs(found.excess - previous.excess) + rounding * found.excess,
    )
