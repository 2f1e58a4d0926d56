"""A period of a loop in which the inputs change at some fractions of it, because packets arrive there.

    s⁺ = F (s, u_0, …, u_q) + noise,   stage cost (s, u_0, …, u_q)'M (s, u_0, …, u_q) + unseen,

where s is the part of the loop that noise enters, u_0 is the input that acts at the beginning of the period, and u_i
acts from the i-th fraction on. Noise and its cost do not depend on the inputs. The periods of a plant are those of

1. a continuous-time plant: the pieces of a period that begin wherever an input may change (``lqg/sampling``);
2. a discrete-time plant, where all changes are at the beginning of a step.

The part s of an LQG loop is the estimate after the measurement, for a filter that is informed of the inputs that
acted. Its noise is gain·innovation, and its error adds tr(M_xx Σ) to the cost. With a given controller, s contains the
state of the plant, the measurement, and the state of the controller. This state may depend on the applied input only if
no input changes within a period.

Source: vanloan1978, nilsson1998
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taciturn import _arrays
from taciturn._arrays import Array, ArrayLike, block_diagonal, symmetrised
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import Filter
from taciturn.lqg.quadratic import Quadratic
from taciturn.lqg.registers import Pieces
from taciturn.model.controller import Controller
from taciturn.model.delay import WHOLE


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


def periods_of(problem: Discrete, pieces: Pieces | None) -> Periods:
    """Return the periods of a problem, whose inputs change at the cuts of its ``pieces``, or only at the samples."""
    p = problem.plant
    move = _Steps(problem.quadratic) if pieces is None else _Pieced(problem, pieces)
    return Periods(move, p.inputs, p.W, problem.noise_cost)


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
class _Pieced(Displayed):
    """The periods of a problem whose pieces begin wherever an input may change."""

    problem: Discrete
    pieces: Pieces

    def __call__(self, fractions: tuple[float, ...]) -> Period:
        """Return the period in which the input changes at the given fractions of it."""
        (n, m), cuts = self.problem.plant.B.shape, np.array(self.pieces.cuts)
        size = n + (len(fractions) + 1) * m
        acts = [int((np.array(fractions) <= cut + WHOLE).sum()) for cut in cuts]  # number of the input in each piece
        T = np.vstack([np.eye(n, size), *(np.eye(m, size, n + i * m) for i in acts)])
        p = self.pieces
        stage = np.block([[self.problem.Q, p.N], [p.N.T, p.R]])
        return Period(np.hstack([self.problem.plant.A, p.B]) @ T, symmetrised(T.T @ stage @ T))


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
