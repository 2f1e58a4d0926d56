"""Newton's method for discrete-time and continuous-time Riccati equations, with an error bound."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np

from taciturn._arrays import NO_VARIANCE, Array, exceeds, symmetrised
from taciturn._display import Displayed
from taciturn._modes import COST_ERROR, ROUNDOFF, Modes, bound_residual, eigenvalues, radius
from taciturn.errors import UnstableError
from taciturn.lqg._axes import (
    Axes,
    Quadratic,
    principal_axes,
    rounding_floor,
    units_of,
    units_of_reach,
    units_of_weight,
)
from taciturn.lqg._worth import Worth, worth_of

ENOUGH = 1e-11  # relative error, for ten states, above which other coordinates are tried; rounding grows as states²
POOR = 1e-4  # relative error below which no further start is tried after one without improvement
FAIR = 1e-8  # relative error above which other starts are tried; below, other coordinates improve it little
TURNS = 100
HUGE = 1e60  # cost, for weights of about 1, that indicates an uncontrollable unstable mode
FAST = 1e3  # growth of a mode per step from which on a shorter period is recommended
RESIDUAL = 1e-9  # largest residual relative to the terms of the equation; after convergence it is about 1e-14


@dataclass(frozen=True, eq=False, repr=False)
class Solution(Displayed):
    """The stabilising solution of a Riccati equation, with a bound on its error.

    Args:
        K: cost-to-go, (n, n).
        L: gain, u = L x, (m, n).
        H: weight of a deviation from the optimal input, (m, m).
        error: (n, n) with −error ⪯ K − exact ⪯ error, to first order: the computed residual of the equation and the
            bound on its rounding, summed along the closed loop.
        residual: residual of the equation relative to its terms, in units in which K has a diagonal of 1.
        unit: cost of each state, or the size of its terms if the cost is only rounding, (n,).
        slowest: modulus of the slowest mode of the closed loop except ``still``; its real part in continuous time.
        still: marginally stable modes of the closed loop, which no input affects and which do not affect the cost.
    """

    K: Array
    L: Array
    H: Array
    error: Array
    residual: float
    unit: Array
    slowest: float
    still: Modes

    @property
    def relative(self) -> Array:
        """Bound on the relative error of the cost-to-go of each state, (n,)."""
        return self.error.diagonal() / np.maximum(self.unit, NO_VARIANCE)

    @property
    def doubt(self) -> float:
        """Bound on the relative error of the noise cost tr(KW), for noise that costs the same in every state."""
        return float(self.relative.mean()) if len(self.K) else 0.0

    def within(self, worth: Worth, others: float) -> Solution:
        """Return this Riccati solution extended by states that have no cost-to-go.

        Args:
            worth: the states of this solution, and the modes of the additional states.
            others: pace of the slowest decaying mode of the additional states.
        """
        states, n = worth.states, len(worth.states)
        place = np.ix_(states, states)
        K, L, error, unit = np.zeros((n, n)), np.zeros((len(self.L), n)), np.zeros((n, n)), np.zeros(n)
        K[place], L[:, states], error[place], unit[states] = self.K, self.L, self.error, self.unit
        slowest = max(self.slowest, others)
        return replace(self, K=K, L=L, error=error, unit=unit, slowest=slowest, still=worth.still)

    @property
    def sound(self) -> bool:
        """Whether the residual and the error bound of this Riccati solution are within the tolerances."""
        return self.residual <= RESIDUAL and self.doubt <= COST_ERROR


def refuse_doubtful(found: Solution, what: str, remedy: str, A: Array | None) -> None:
    """Raise an error if the residual or the error bound of a Riccati solution is too large.

    Args:
        found: the solution.
        what: name of the problem, such as regulator or filter.
        remedy: which modes the plant should have instead, for the message.
        A: dynamics of a step; None in continuous time.

    Raises:
        UnstableError: residual or error is too large; the message names the state with the least certain cost.
    """
    if found.sound:
        return
    failed: list[str] = []
    if not found.residual <= RESIDUAL:
        failed.append(f"its relative residual is {found.residual:.1e} (at most {RESIDUAL:.0e})")
    if not found.doubt <= COST_ERROR:
        worst = int(np.argmax(found.relative))
        failed.append(
            f"its solution has a relative error of up to {found.doubt:.1e} (at most {COST_ERROR:.0e}), most of it in "
            f"state {worst + 1}"
        )
    growth = 1.0 if A is None else radius(A)
    step = f"a shorter period, as the plant grows by {growth:.1e} within a step, or " if growth > FAST else ""
    raise UnstableError(
        f"the Riccati equation of the {what} is too badly conditioned: {', and '.join(failed)}; expected "
        f"{step}modes {remedy}; other units would not help"
    )


def _along(axes: Axes, K: Array, _: Quadratic) -> Axes:
    return principal_axes(axes, K)


class Gains(NamedTuple):
    """Optimal gain L for a cost-to-go K, the weight H of a deviation from the optimal input, and the inverse of H."""

    K: Array
    L: Array
    H: Array
    inverse: Array


class Time(ABC):
    """Operations of Newton's method that differ between discrete-time and continuous-time Riccati equations.

    Args:
        edge: pace (modulus or real part) of a marginally stable mode.
        fastest: pace of a mode that vanishes immediately.
    """

    edge: ClassVar[float]
    fastest: ClassVar[float]

    @abstractmethod
    def rough(self, given: Quadratic) -> Array | None:
        """Return an approximate Riccati solution from which Newton's method starts, or None if it overflows."""

    @abstractmethod
    def pace(self, modes: Modes) -> Array:
        """Return the moduli of eigenvalues in discrete time, or their real parts in continuous time."""

    @abstractmethod
    def margin(self, given: Quadratic) -> float:
        """Return how far inside the stability limit an eigenvalue must be to count as stable."""

    @abstractmethod
    def summed(self, F: Array, stage: Array) -> Array:
        """Return the cost-to-go of a stable closed loop with a given stage cost, by a Lyapunov equation."""

    @abstractmethod
    def answer(self, given: Quadratic, K: Array, L: Array) -> Gains:
        """Return the optimal gain for a cost-to-go; in directions in which all gains are optimal, L is unchanged."""

    @abstractmethod
    def residual(self, given: Quadratic, F: Array, stage: Array, K: Array) -> tuple[Array, Array]:
        """Return the Lyapunov residual of a cost-to-go K for a closed loop F, and the size of F for each state.

        The size is in units of cost.
        """

    @abstractmethod
    def missed(self, given: Quadratic, F: Array, found: Gains) -> Array:
        """Return the residual of the gain equation: H L = −(B'KA + N'), or R L = −(B'K + N') in continuous time."""

    @abstractmethod
    def step(self, F: Array) -> Array:
        """Return the closed-loop matrix of one discrete step, up to a scalar factor, from the closed-loop matrix F."""

    def solve(self, given: Quadratic) -> Solution | None:
        """Return the most accurate Riccati solution found, or None if Newton's method did not start or converge."""
        worth = self.worth(given)
        if worth.states.all():
            return self._solved(given)
        found = self._solved(given.among(worth.states))
        slowest = float(self.pace(worth.decaying).max(initial=self.fastest))
        return None if found is None else found.within(worth, slowest)

    def worth(self, given: Quadratic) -> Worth:
        """Return the states with a nonzero cost-to-go, and the modes of the other states."""
        return worth_of(given, lambda modes: self.pace(modes) - self.edge, self.margin(given))

    def slowest(self, F: Array) -> float:
        """Return the modulus, or in continuous time the real part, of the slowest mode of a closed loop."""
        return float(self.pace(eigenvalues(F)).max(initial=self.fastest))

    def _solved(self, given: Quadratic) -> Solution | None:
        best: Solution | None = None
        enough = ENOUGH * max(1.0, len(given.A) / 10) ** 2
        for start in self._starts(given):
            before = np.inf if best is None else best.doubt
            for found in self._refined(given, *start):
                if best is None or found.doubt < best.doubt:
                    best = found
                if best.doubt <= enough:
                    return best
            if best is not None and (best.doubt <= FAIR or before / 2 <= best.doubt <= POOR):
                return best
        return best

    def _starts(self, given: Quadratic) -> Iterator[tuple[Axes, Array, Array, Array]]:
        """Yield starts (costs, gains and input weights) in suitable coordinates, the most promising first.

        The problem with unit weights has a solution whenever (A, B) is stabilisable; its gain is a safe start. If an
        input hardly affects a mode, a gain is accurate only in coordinates along the principal axes of the cost.
        """
        n, m = given.B.shape
        unit, none = (np.eye(n), np.eye(m), np.zeros((n, m))), np.zeros((m, n))
        kinds = [(units_of_weight, True), (units_of_reach, True), (units_of_reach, False)]
        for _ in range(3):
            further: list[tuple[Callable[[Quadratic], Axes], bool]] = []
            for coordinates, weighed in kinds:
                axes = coordinates(given)
                here = axes.problem(given)
                asked = here if weighed else Quadratic(here.A, here.B, *unit)
                rough = self.rough(asked)
                if rough is None or not np.abs(rough).max(initial=0.0) < HUGE:
                    continue
                _, L, H, _ = self.answer(asked, rough, none)
                K = rough if weighed else self.summed(*here.under(L))
                if np.abs(K).max(initial=0.0) < HUGE:
                    yield axes, K, L, (H if weighed else self.answer(here, K, L).H)
                further.append((partial(_along, axes, rough), weighed))
            kinds = further

    def _refined(self, given: Quadratic, axes: Axes, K: Array, L: Array, H: Array) -> Iterator[Solution]:
        """Yield solutions that start from a gain: in units of its cost, then along the principal axes of the best cost.

        Args:
            given: the problem.
            axes: the coordinates of the gain.
            K: approximate cost of the gain.
            L: the gain.
            H: weight of a deviation from the input.
        """
        here, found = axes.problem(given), None
        for _ in range(3):
            F = here.under(L)[0]
            inner = units_of(self.step(F), K, H, np.maximum(rounding_floor(here, K, L), NO_VARIANCE))
            axes, L = axes.then(inner), inner.gain(L)
            here = axes.problem(given)
            found = self._settled(here, L)
            if found is None:
                return
            K, L, H, _ = found[0]
            if K.diagonal().max(initial=0.0) <= 4 and K.diagonal().min(initial=1.0) >= 1 / 4:
                break
        if found is None:
            return
        yield self.judged(given, axes, here, *found)
        turned = principal_axes(axes, K)
        here = turned.problem(given)
        found = self._settled(here, turned.gain(axes.gain_from(L)))
        if found is not None:
            yield self.judged(given, turned, here, *found)

    def _settled(self, given: Quadratic, L: Array) -> tuple[Gains, float] | None:
        """Iterate K = cost of the gain L, L = best gain for K, from a stabilising L; None if this does not converge.

        Returns:
            The answer, and the pace of the slowest mode of its loop.
        """
        previous, change = None, np.inf
        for _ in range(TURNS):
            F, stage = given.under(L)
            K = self.summed(F, stage)
            if not np.isfinite(K).all():
                return None
            K = symmetrised(K)
            terms = given.terms(L)
            found = self.answer(given, K, L)
            off, L = found.L - L, found.L
            # If the terms cancel, K contains their rounding and cannot converge below it.
            size = float(np.maximum(np.abs(K.diagonal()), terms).max(initial=0.0))
            last, change = change, (np.inf if previous is None else float(np.abs(K - previous).max(initial=0.0)))
            # The next iteration saves off'·H·off per step; it is done if this is below the rounding of the stage cost.
            # If a closed-loop mode tends to the stability limit, the changes only halve in each iteration.
            done = (np.einsum("ij,ij->j", off, found.H @ off) <= ROUNDOFF * terms).all()
            stalled = change <= 1e-5 * size and change >= 0.9 * last
            if done or change <= 1e-14 * size or stalled:
                slowest = self.slowest(given.A + given.B @ L)
                return (
                    (found, slowest) if slowest < self.edge - self.margin(given) and exceeds(K, -COST_ERROR) else None
                )
            previous = K
        return None

    def judged(self, given: Quadratic, axes: Axes, here: Quadratic, found: Gains, slowest: float) -> Solution:
        """Return a Riccati solution with its error bound, evaluated in the coordinates of the solver.

        Args:
            given: the problem as it was given.
            axes: the coordinates of the answer.
            here: the problem in these coordinates.
            found: the answer.
            slowest: pace of the slowest mode of its loop.
        """
        (size, weight), (K, L, H, inverse) = axes.sizes(given), found
        F, stage = here.under(L)
        missed, spread = self.residual(here, F, stage, K)
        off = self.missed(here, F, found)
        missed = missed - off.T @ inverse @ off  # minus what the best gain would save
        root = np.sqrt(np.maximum(K.diagonal(), 0.0))
        moved = (size + np.abs(here.B) @ np.abs(L)).T @ root
        pushed = np.abs(here.N) @ np.abs(L)
        terms = spread[:, None] * moved + weight / 2 + pushed + np.abs(L.T) @ np.abs(here.R) @ np.abs(L) / 2
        terms = terms + terms.T
        bound = bound_residual(missed, terms, len(K) + len(H))
        largest = float(terms.max(initial=0.0))
        K, L = axes.form_from(K), axes.gain_from(L)
        diagonal, least = K.diagonal(), rounding_floor(given, K, L)
        error = axes.form_from(self.summed(F, bound))
        error.flat[:: len(K) + 1] += 2 * np.sqrt(len(K)) * ROUNDOFF * np.maximum(diagonal, 0.0)  # the rounding of K
        return Solution(
            K,
            L,
            axes.price_from(H),
            error,
            float(np.abs(missed).max(initial=0.0)) / largest if largest > 0 else 0.0,
            np.where(diagonal > least, diagonal, np.maximum(least, given.terms(L) + given.moved(K, L))),
            slowest,
            np.zeros(0, dtype=np.complex128),
        )
