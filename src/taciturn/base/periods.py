"""A period of a loop in which the inputs change at some fractions of it, because packets arrive there.

    s⁺ = F (s, u_0, …, u_q) + noise,   stage cost (s, u_0, …, u_q)'M (s, u_0, …, u_q) + unseen,

where s is the part of the loop that noise enters, u_0 is the input that acts at the beginning of the period, and u_i
acts from the i-th fraction on. Noise and its cost do not depend on the inputs. The periods of a plant are those of

1. a continuous-time plant: exact sampling over each piece between two changes (``lqg/sampling``), with the input that
   acts in it; the pieces follow each other as intervals, whose semidefinite terms only add, also over a long period;
2. a discrete-time plant, where all changes are at the beginning of a step.

The part s of an LQG loop is the estimate after the measurement, for a filter that is informed of the inputs that
acted. Its noise is gain·innovation, and its error adds tr(M_xx Σ) to the cost. With a given controller, s contains the
state of the plant, the measurement, and the state of the controller. This state may depend on the applied input only if
no input changes within a period.

Source: vanloan1978, nilsson1998
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from taciturn import _arrays
from taciturn._arrays import Array, ArrayLike, block_diagonal, symmetrised
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.lqg.enclosures import Doubles, UnprovedError
from taciturn.lqg.kalman import Filter
from taciturn.lqg.quadratic import Quadratic
from taciturn.lqg.sampling import Interval, integrated, units_of
from taciturn.model.controller import Controller


class Period(NamedTuple):
    """A period in which the inputs change at q fractions of it: s⁺ = F (s, u_0, …, u_q), with the stage weight M."""

    F: Array  # (s, s + (q + 1) m)
    M: Array  # (s + (q + 1) m, s + (q + 1) m)


@dataclass(frozen=True, eq=False, repr=False)
class Periods(Displayed):
    """The part s of a loop that noise enters, from one sample to the next, for any changes of the held inputs."""

    move: Callable[[tuple[float, ...]], Period]  # from the increasing fractions of a period at which inputs change
    inputs: int
    noise: Array  # covariance of the noise in s⁺, (s, s)
    unseen: float  # cost per step that depends on no input


def sampled_periods(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, W: ArrayLike, period: float
) -> Periods:
    """Return the periods of a continuous-time plant; all weights and the noise intensity are per unit of time."""
    given = Quadratic.checked(A, B, Q, R, N)
    W = _arrays.semidefinite("W", W, len(given.A), "states × states")
    move = _Held(given, W, _arrays.number("period", period, 0.0))
    n, whole = len(W), move.piece(1.0)
    return Periods(move, given.B.shape[1], symmetrised(whole.G.middle[:n, :n]), float(whole.c.middle[0, 0]))


def discrete_periods(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, W: ArrayLike) -> Periods:
    """Return the steps of a discrete-time plant, whose inputs change only at the beginning of a step."""
    given = Quadratic.checked(A, B, Q, R, N)
    return Periods(_Steps(given), given.B.shape[1], _arrays.semidefinite("W", W, len(given.A), "states × states"), 0.0)


def with_filter(plant: Periods, steady: Filter) -> Periods:
    """Return the periods of the estimate after the measurement, by a filter that is informed of the inputs that act."""
    n = len(plant.noise)
    error = float(np.sum(plant.move(()).M[:n, :n] * steady.posterior))
    return Periods(plant.move, plant.inputs, symmetrised(steady.prior - steady.posterior), plant.unseen + error)


def with_controller(plant: Periods, controller: Controller, C: Array, V: Array) -> tuple[Periods, Array]:
    """Return the periods of s = (x, y, state of the controller), for y = C x + v, and the gain on (s, û)."""
    k, p = len(controller.A), len(C)
    shown = np.vstack([np.eye(len(plant.noise)), C])
    noise = block_diagonal(shown @ plant.noise @ shown.T, np.zeros((k, k)))
    noise[len(noise) - k - p : len(noise) - k, len(noise) - k - p : len(noise) - k] += V
    K = np.hstack(
        [np.zeros((plant.inputs, len(plant.noise))), controller.D, controller.C, np.zeros((plant.inputs,) * 2)]
    )
    return Periods(_Controlled(plant, controller, C), plant.inputs, noise, plant.unseen), K


@dataclass(frozen=True, eq=False, repr=False)
class _Held(Displayed):
    """The periods of a sampled plant, as intervals that follow each other, each with the input that acts in it."""

    given: Quadratic
    W: Array
    period: float
    _kept: dict[float, Interval[Doubles]] = field(default_factory=dict[float, Interval[Doubles]])

    def piece(self, share: float) -> Interval[Doubles]:
        """Return the interval of a share of the period, for (x, u) with a held input."""
        if share not in self._kept:
            (A, B, Q, R, N), (n, m) = self.given, self.given.B.shape
            F, M = np.block([[A, B], [np.zeros((m, n + m))]]), np.block([[Q, N], [N.T, R]])
            one, two, noise = (Doubles.exact(part) for part in (F, M, np.pad(self.W, (0, m))))
            units = units_of(A, B, self.period)
            try:
                self._kept[share] = integrated(Doubles, one, two, noise, share * self.period, units)
            except UnprovedError as error:
                raise ProblemError(
                    f"a number of the plant, sampled over a period of {self.period:g}, exceeds the range of double "
                    "precision; expected a shorter period, or states and inputs in other units"
                ) from error
        return self._kept[share]

    def __call__(self, fractions: tuple[float, ...]) -> Period:
        """Return the period in which the input changes at the given fractions of it."""
        (n, m), whole = self.given.B.shape, None
        size = n + (len(fractions) + 1) * m
        for i, (begin, end) in enumerate(pairwise((0.0, *fractions, 1.0))):
            if end > begin:
                place = np.vstack([np.eye(n, size), np.eye(m, size, n + i * m)])
                own, rest = Doubles.exact(place), Doubles.exact(np.eye(size) - place.T @ place)
                Phi, M, G, c = self.piece(end - begin)
                wide = Interval(own.T @ Phi @ own + rest, own.T @ M @ own, own.T @ G @ own, c)
                whole = wide if whole is None else whole.then(wide)
        assert whole is not None, "a period is longer than zero"
        return Period(whole.Phi.middle[:n], symmetrised(whole.M.middle))


@dataclass(frozen=True, eq=False, repr=False)
class _Steps(Displayed):
    """The steps of a discrete-time plant."""

    given: Quadratic

    def __call__(self, fractions: tuple[float, ...]) -> Period:
        """Return the step in which the input changes at its beginning, or not at all."""
        if any(fractions):
            raise ProblemError(
                f"a packet may arrive {max(fractions):g} periods after a sample, but the inputs of a discrete plant "
                "change only at samples; expected delays of whole steps, or a continuous plant"
            )
        (A, B, Q, R, N), (n, m) = self.given, self.given.B.shape
        used = np.eye(m, (len(fractions) + 1) * m, len(fractions) * m)
        T = block_diagonal(np.eye(n), used)
        return Period(np.hstack([A, B]) @ T, T.T @ np.block([[Q, N], [N.T, R]]) @ T)


@dataclass(frozen=True, eq=False, repr=False)
class _Controlled(Displayed):
    """The periods of a plant with its measurement and a given linear controller."""

    plant: Periods
    controller: Controller
    C: Array

    def __call__(self, fractions: tuple[float, ...]) -> Period:
        """Return the period in which the input changes at the given fractions of it."""
        found, c, m = self.plant.move(fractions), self.controller, self.plant.inputs
        if c.E.any() and any(fractions):
            raise ProblemError(
                f"the controller reads the applied input (controller.E), which changes {max(fractions):g} periods "
                "after a sample; expected delays of whole periods, or a controller with E = 0"
            )
        n, (p, k) = len(found.F), (len(self.C), len(c.A))
        wide = np.eye(n + p + k + (len(fractions) + 1) * m)
        T = np.delete(wide, np.s_[n : n + p + k], axis=0)  # from (s, u_0, …) to (x, u_0, …)
        state = c.B @ wide[n : n + p] + c.A @ wide[n + p : n + p + k] + c.E @ wide[len(wide) - m :]
        x = found.F @ T
        return Period(np.vstack([x, self.C @ x, state]), T.T @ found.M @ T)
