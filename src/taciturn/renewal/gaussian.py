"""Rate and cost of a chain with Gaussian noise: renewal equations by quadrature, with the error that is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, number, symmetrised
from taciturn.renewal._intervals import intervals
from taciturn.renewal._nodes import Nodes, TooManyNodes, Window, place
from taciturn.renewal._whiten import White, spread, whiten
from taciturn.renewal.chain import Chain, NoQuadratureError, Renewal

MOST_NODES = 6000  # a dense system of this size takes seconds
import os
COARSE, FIRST, FINER = 0.6, float(os.environ.get("D","0.7")), float(os.environ.get("DF","1.2"))  # densities of nodes, and their growth
NARROW, WIDER = float(os.environ.get("K",".85")), float(os.environ.get("KF","1.2"))  # windows, relative to those that coarse nodes ask for
RUNGS = 12
PASSES = 12
REACH = 10.0  # conditional standard deviations, at first
BEYOND = 0.01  # of the accuracy: the share of checks and of cost that a window may cut off
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
    window = _window(white, accuracy)
    density, factor, previous, best, errors = FIRST, NARROW, None, None, (np.inf, np.inf)
    for _ in range(RUNGS):
        try:
            found = _solve(white, place(white, window.scaled(factor), density, MOST_NODES))
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
        density, factor = density * FINER, factor * WIDER
    if best is None or errors[0] > USELESS * best.rate:
        raise NoQuadratureError(
            f"the errors that are kept spread over too many noise standard deviations for {MOST_NODES} nodes, or are "
            "sent too rarely for floating point; expected a smaller δ or more noise for a quadrature; simulate instead"
        )
    return Renewal(best.rate, best.excess, *errors, intervals(best.system.start, best.system.kernel, best.checks), len(best.checks))


def _window(white: White, accuracy: float) -> Window:
    """Return where kept errors are, as coarse nodes see it on windows that they set themselves."""
    covariance = spread(white)
    window = Window(covariance, np.full(len(covariance), REACH))
    for _ in range(PASSES):
        try:
            system = _discretise(white, place(white, window, COARSE, MOST_NODES // 2))
        except TooManyNodes:
            break
        visits = np.linalg.solve(np.eye(len(system.start)) - system.kernel.T, system.start)
        if not np.isfinite(visits).all() or visits.sum() <= 0:
            break
        found = symmetrised((system.x * visits[:, None]).T @ system.x / visits.sum())
        if np.linalg.eigvalsh(found)[0] <= 0:
            break
        reach, cut = _reach(system, visits, window, BEYOND * accuracy)
        ratio = np.linalg.eigvals(np.linalg.solve(window.covariance, found)).real
        if not cut.any() and 0.8 < ratio.min() and ratio.max() < 1.1:
            return Window(window.covariance, reach)
        window = Window(found, np.where(cut, 1.5 * window.reach, np.maximum(reach, REACH)))
    return window


def _reach(system: _System, visits: Array, window: Window, share: float) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the reach of each axis beyond which no more than a share of checks and cost lies, and where there is none.

    There the window cut off more than that.
    """
    weight = visits / visits.sum()
    if system.cost.any():
        weight = weight + visits * system.cost / (visits @ system.cost)
    reach, cut = np.empty_like(window.reach), np.zeros(len(window.reach), dtype=bool)
    for axis in range(len(reach)):
        centre, deviation = window.given_outer(system.x[:, :axis])
        away = np.abs(system.x[:, axis] - centre) / deviation
        order = np.argsort(-away)
        beyond = np.cumsum(weight[order])
        least = float(away[order[min(np.searchsorted(beyond, share), len(order) - 1)]])
        reach[axis] = 1.0 + 1.1 * least
        cut[axis] = least > window.reach[axis] - 2 / deviation - 0.5
    return reach, cut


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
