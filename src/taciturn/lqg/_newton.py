"""Newton's method for Riccati equations of either time, in coordinates that fit, and what its answer may be off by."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np

from taciturn._arrays import TINY, Array, exceeds, symmetrised
from taciturn._modes import ROUNDOFF, TOLERANCE, Modes, bound_residual, eigenvalues, radius
from taciturn.errors import UnstableError
from taciturn.lqg._axes import Axes, Quadratic, nothing, principal_axes, units_of, units_of_reach, units_of_weight
from taciturn.lqg._worth import Worth, worth_of

ENOUGH = 1e-11  # relative error of ten states, above which other coordinates are tried; rounding grows as states²
POOR = 1e-4  # relative error from which on a start that gained nothing is the last
FAIR = 1e-8  # relative error above which other starts are tried: other coordinates gain little where one start settled
TURNS = 100
HUGE = 1e60  # cost, where weights are about 1, of an unstable mode that no input moves
FAST = 1e3  # growth of a mode within a step that a shorter period would mend
RESIDUAL = 1e-9  # relative to the terms of the equation: Newton's method leaves 1e-14 where it settles


@dataclass(frozen=True, eq=False)
class Solution:
    """The stabilising solution of a Riccati equation, and what is known of its error.

    Args:
        K: cost-to-go, (n, n).
        L: gain, u = L x, (m, n).
        H: price of another input, (m, m).
        error: (n, n) with −error ⪯ K − exact ⪯ error: the equation's measured residual, and the rounding that may be
            in it, summed along the closed loop. To first order.
        residual: of the equation, relative to its terms, where K has a diagonal of 1.
        unit: cost of each state; where it is rounding, that of its terms, (n,).
        slowest: modulus of the slowest mode of the closed loop but for those that stand still; its real part in
            continuous time.
        still: modes of the closed loop on the edge of stability, which no input moves and the cost does not see.
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
        """Bound on the relative error of the cost of each state, (n,)."""
        return self.error.diagonal() / np.maximum(self.unit, TINY)

    @property
    def doubt(self) -> float:
        """Bound on the relative error of the cost tr(KW) of a noise that excites each state by its own unit of cost."""
        return float(self.relative.mean()) if len(self.K) else 0.0

    def within(self, worth: Worth, others: float) -> Solution:
        """Return the solution of a problem with more states, the cost-to-go of which is 0.

        Args:
            worth: the states of this solution, and the modes of the others.
            others: the slowest mode of the others that decay.
        """
        states, n = worth.states, len(worth.states)
        place = np.ix_(states, states)
        K, L, error, unit = np.zeros((n, n)), np.zeros((len(self.L), n)), np.zeros((n, n)), np.zeros(n)
        K[place], L[:, states], error[place], unit[states] = self.K, self.L, self.error, self.unit
        slowest = max(self.slowest, others)
        return replace(self, K=K, L=L, error=error, unit=unit, slowest=slowest, still=worth.still)

    @property
    def sound(self) -> bool:
        """Whether its residual and its error are small enough."""
        return self.residual <= RESIDUAL and self.doubt <= TOLERANCE


def refuse_doubtful(found: Solution, what: str, remedy: str, A: Array | None) -> None:
    """Refuse a solution whose residual or error is too large.

    Args:
        found: the solution.
        what: of whom the equation is.
        remedy: modes that would do better.
        A: of a step; None of continuous time.

    Raises:
        UnstableError: with what is too large, the residual or the error, and the state whose cost is least certain.
    """
    if found.sound:
        return
    failed: list[str] = []
    if not found.residual <= RESIDUAL:
        failed.append(f"its residual is {found.residual:.1e} of its terms (at most {RESIDUAL:.0e})")
    if not found.doubt <= TOLERANCE:
        worst = int(np.argmax(found.relative))
        failed.append(
            f"its solution is uncertain by {found.doubt:.1e} of its size (at most {TOLERANCE:.0e}), most in state "
            f"{worst + 1}"
        )
    growth = 1.0 if A is None else radius(A)
    step = f"a shorter period, as the plant grows by {growth:.1e} within a step, or " if growth > FAST else ""
    raise UnstableError(
        f"the Riccati equation of the {what} is too badly conditioned: {', and '.join(failed)}; units do not matter "
        f"here: expected {step}modes {remedy}"
    )


def _along(axes: Axes, K: Array, _: Quadratic) -> Axes:
    return principal_axes(axes, K)


class Answer(NamedTuple):
    """The best gain L for a cost-to-go K, the price H of another input, and its inverse where it has one."""

    K: Array
    L: Array
    H: Array
    inverse: Array


class Time(ABC):
    """What differs between a Riccati equation of steps and one of continuous time.

    Args:
        edge: pace of a mode on the edge of stability.
        fastest: pace of a mode that is gone at once.
    """

    edge: ClassVar[float]
    fastest: ClassVar[float]

    @abstractmethod
    def rough(self, given: Quadratic) -> Array | None:
        """Return a fast solution that needs refinement, or None where it overflows."""

    @abstractmethod
    def pace(self, modes: Modes) -> Array:
        """Return the moduli of modes, or their real parts in continuous time."""

    @abstractmethod
    def margin(self, given: Quadratic) -> float:
        """Return how far inside the edge of stability a mode must be to decay."""

    @abstractmethod
    def summed(self, F: Array, stage: Array) -> Array:
        """Return the cost-to-go of a stable closed loop with a stage cost."""

    @abstractmethod
    def answer(self, given: Quadratic, K: Array, L: Array) -> Answer:
        """Return the best gain for a cost-to-go, which keeps L where all gains are as good."""

    @abstractmethod
    def residual(self, given: Quadratic, F: Array, stage: Array, K: Array) -> tuple[Array, Array]:
        """Return by how much K misses the cost of its loop, and for each state the size of F in units of cost."""

    @abstractmethod
    def missed(self, given: Quadratic, F: Array, found: Answer) -> Array:
        """Return by how much the gain misses H L = −(B'KA + N'), or in continuous time R L = −(B'K + N')."""

    @abstractmethod
    def step(self, F: Array) -> Array:
        """Return a closed loop as that of a step, up to a factor."""

    def solve(self, given: Quadratic) -> Solution | None:
        """Return the best of the solutions found; None where no start stabilises or nothing settles."""
        worth = self.worth(given)
        if worth.states.all():
            return self._solved(given)
        found = self._solved(given.among(worth.states))
        slowest = float(self.pace(worth.decaying).max(initial=self.fastest))
        return None if found is None else found.within(worth, slowest)

    def worth(self, given: Quadratic) -> Worth:
        """Return which states have a cost-to-go."""
        return worth_of(given, lambda modes: self.pace(modes) - self.edge, self.margin(given))

    def slowest(self, F: Array) -> float:
        """Return the pace of the slowest mode of a closed loop."""
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
        """Return costs, gains and prices that may stabilise, the likeliest first, in coordinates that suit them.

        The problem with unit weights has a solution whenever (A, B) is stabilisable; its gain is a safe start. Where an
        input hardly moves a mode, a gain has its digits only along the axes of the cost.
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
        """Solve from a gain: in the units of its cost, in those of the best cost, then along the axes of that.

        Args:
            given: the problem.
            axes: the coordinates of the gain.
            K: about its cost.
            L: the gain.
            H: the price of another input.
        """
        here, found = axes.problem(given), None
        for _ in range(3):
            F = here.under(L)[0]
            inner = units_of(self.step(F), K, H, np.maximum(nothing(here, K, L), TINY))
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

    def _settled(self, given: Quadratic, L: Array) -> tuple[Answer, float] | None:
        """Iterate K = cost of the gain L, L = best answer to K, from a stabilising L; None if nothing settles.

        Returns:
            The answer, and the slowest mode of its loop.
        """
        previous, change = None, np.inf
        for _ in range(TURNS):
            F, stage = given.under(L)
            K = symmetrised(self.summed(F, stage))
            if not np.isfinite(K).all():
                return None
            terms = given.terms(L)
            found = self.answer(given, K, L)
            off, L = found.L - L, found.L
            # Where the terms cancel, K holds their rounding and cannot settle below it.
            size = float(np.maximum(np.abs(K.diagonal()), terms).max(initial=0.0))
            last, change = change, (np.inf if previous is None else float(np.abs(K - previous).max(initial=0.0)))
            # The next turn saves off'·H·off in each step, here below the rounding of the step's own cost. Where a
            # closed-loop mode tends to the edge the changes halve instead.
            done = (np.einsum("ij,ij->j", off, found.H @ off) <= ROUNDOFF * terms).all()
            stalled = change <= 1e-5 * size and change >= 0.9 * last
            if done or change <= 1e-14 * size or stalled:
                slowest = self.slowest(given.A + given.B @ L)
                return (found, slowest) if slowest < self.edge - self.margin(given) and exceeds(K, -TOLERANCE) else None
            previous = K
        return None

    def judged(self, given: Quadratic, axes: Axes, here: Quadratic, found: Answer, slowest: float) -> Solution:
        """Return a solution with its error, measured in the coordinates in which it was found.

        Args:
            given: the problem as it was given.
            axes: the coordinates of the answer.
            here: the problem in these.
            found: the answer.
            slowest: mode of its stable loop.
        """
        (size, weight), (K, L, H, inverse) = axes.sizes(given), found
        F, stage = here.under(L)
        missed, spread = self.residual(here, F, stage, K)
        off = self.missed(here, F, found)
        missed = missed - off.T @ inverse @ off  # what the best gain would save
        root = np.sqrt(np.maximum(K.diagonal(), 0.0))
        moved = (size + np.abs(here.B) @ np.abs(L)).T @ root
        pushed = np.abs(here.N) @ np.abs(L)
        terms = spread[:, None] * moved + weight / 2 + pushed + np.abs(L.T) @ np.abs(here.R) @ np.abs(L) / 2
        terms = terms + terms.T
        bound = bound_residual(missed, terms, len(K) + len(H))
        largest = float(terms.max(initial=0.0))
        K, L = axes.form_from(K), axes.gain_from(L)
        diagonal, least = K.diagonal(), nothing(given, K, L)
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
