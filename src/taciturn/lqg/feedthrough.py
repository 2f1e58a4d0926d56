"""Direct feedthrough: y_k = C x_k + D û_{k−1} + v_k, with the input û_{k−1} that the plant applied in the step before.

A sensor takes its sample before the input changes, so no output depends on an input that is computed from it. Each
input that an output shows gets a register, a state z⁺ = û. It comes after the states x of the plant and before its
disturbances and set-points, and it has neither cost nor noise:

    x⁺ = A x + B û + w,   z⁺ = û,   y = [C, D] (x, z) + v.

Loops, filters, programs and nodes treat a register as any other state. It contains what was applied after losses and
limits, since it is fed as the plant is. At the start it contains the input of the operating point.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn._arrays import Array, frozen
from taciturn._display import Displayed
from taciturn.lqg.enclosures import E, block
from taciturn.lqg.intervals import Exact, Step
from taciturn.lqg.quadratic import Quadratic
from taciturn.model.coordinates import counted_from
from taciturn.model.dynamics import Dynamics
from taciturn.model.operating_point import MovedDynamics, OperatingPoint
from taciturn.model.plant import ContinuousPlant, Plant, derived_plant

if TYPE_CHECKING:
    from taciturn.lqg.discrete import Discrete


def fed_inputs(plant: Plant | ContinuousPlant) -> list[int]:
    """Return the inputs that an output shows directly: those with a column of D that is not zero."""
    return [] if plant.D is None else np.flatnonzero(plant.D.any(axis=0)).tolist()


def with_registers(problem: Discrete, source: Plant | ContinuousPlant) -> Discrete:
    """Return a problem with registers of the inputs that the outputs show.

    Args:
        problem: the problem of the plant without D, with disturbances and set-points.
        source: the plant before it was sampled, with D.
    """
    n, fed, B = source.states, fed_inputs(source), problem.plant.B
    r, end = len(fed), len(B) - n
    push: Array = np.eye(B.shape[1])[fed]
    own = problem.deviations
    if own is not None:
        A, b, Q, R, N = own.problem
        more = Quadratic(_square(A, n, r), _rows(b, n, push), _square(Q, n, r), R, _rows(N, n, np.zeros_like(push)))
        T = _square(own.T, n, r)
        T[n : n + r, n : n + r] = np.eye(r)
        exact = None if own.exact is None else Exact(_Extended(own.exact, n, end, push))
        own = replace(own, T=T, U=_rows(own.U.T, n, np.zeros_like(push)).T, problem=more, exact=exact)
    return replace(
        problem,
        plant=registered(problem.plant, source),
        Q=_square(problem.Q, n, r),
        N=_rows(problem.N, n, np.zeros_like(push)),
        exact=None if problem.exact is None else Exact(_Extended(problem.exact, n, end, push)),
        deviations=own,
        source=source,
    )


def registered(plant: Plant, source: Plant | ContinuousPlant) -> Plant:
    """Return a plant with registers of the inputs that its outputs show by the D of the plant before sampling."""
    n, fed, D = source.states, fed_inputs(source), source.D
    assert D is not None, "only a plant with D needs registers"
    r, shown = len(fed), np.zeros((plant.outputs, len(fed)))
    shown[: len(D)] = D[:, fed]
    push: Array = np.eye(plant.inputs)[fed]
    found = derived_plant(
        _square(plant.A, n, r), _rows(plant.B, n, push), _square(plant.W, n, r), _rows(plant.C.T, n, shown.T).T,
        plant.V, plant.dt, np.insert(plant.mean, [n] * r, 0.0), _square(plant.covariance, n, r), plant.input_limit,
        plant.function and RegisteredDynamics.of(plant.function, n, fed), input_rate=plant.input_rate,
    )  # fmt: skip
    kept = {"changes": plant.changes, "registers": tuple(fed), "alone": source if isinstance(source, Plant) else None}
    for name, value in kept.items():
        object.__setattr__(found, name, value)
    point = plant.operating_point
    return counted_from(found, None if point is None else OperatingPoint(_at_rest(point, n, fed), point.u), plant)


def with_same_start(problem: Discrete, model: Plant) -> Discrete:
    """Return a problem about the operating point of a design, whose registers start with the inputs of the design."""
    plant, place = problem.plant, registers_from(problem)
    before = np.zeros(plant.inputs)
    for registers, mean in ((plant.registers, plant.mean), (model.registers, model.mean)):
        before[[*registers]] = mean[place : place + len(registers)]
    return replace(problem, plant=with_inputs_before(plant, place, before))


def with_inputs_before(plant: Plant, place: int, before: Array) -> Plant:
    """Return a plant whose registers, from the state ``place`` on, start with given inputs, (m,)."""
    found, mean = copy(plant), plant.mean.copy()
    mean[place : place + len(plant.registers)] = before[[*plant.registers]]
    object.__setattr__(found, "mean", frozen(mean))
    return found


def registers_from(problem: Discrete) -> int:
    """Return the number of the first register among the states of a problem."""
    return problem.plant.stated if problem.source is None else problem.source.states


def point_with(problem: Discrete, model: Plant) -> OperatingPoint | None:
    """Return the operating point of a design in the states of a problem, which may have registers of other inputs."""
    point, fed, place = model.operating_point, [*problem.plant.registers], registers_from(problem)
    if point is None or model.registers == problem.plant.registers:
        return point
    x = np.delete(point.x, slice(place, place + len(model.registers)))
    return OperatingPoint(np.insert(x, [place] * len(fed), point.u[fed]), point.u)


def _at_rest(point: OperatingPoint, n: int, fed: list[int]) -> Array:
    return np.insert(point.x, [n] * len(fed), point.u[fed])


def _rows(matrix: Array, place: int, rows: Array) -> Array:
    """Return a matrix with more rows before one of its rows."""
    return np.vstack([matrix[:place], rows, matrix[place:]])


def _square(matrix: Array, place: int, more: int) -> Array:
    """Return a matrix with more rows and columns of zeros."""
    zeros = [place] * more
    return np.insert(np.insert(matrix, zeros, 0.0, axis=0), zeros, 0.0, axis=1)


@dataclass(frozen=True, eq=False, repr=False)
class _Extended(Displayed):
    """A problem of one step with registers, to any precision.

    Args:
        exact: the problem without them.
        place: number of states before the registers.
        end: number of states after them.
        push: which input each register takes, (r, m).
    """

    exact: Exact
    place: int
    end: int
    push: Array

    def __call__(self, arithmetic: type[E], /) -> Step[E]:
        """Return enclosures of the problem."""
        step, whole, place, wide = self.exact(arithmetic), slice(None), self.place, len(self.push)

        def rows(matrix: E, between: Array) -> E:
            parts = [[matrix.part(slice(place), whole)], [arithmetic.exact(between)]]
            return block([*parts, [matrix.part(slice(place, None), whole)]] if self.end else parts)

        def square(matrix: E) -> E:
            size = place + self.end
            tall = rows(matrix, np.zeros((wide, size)))
            return rows(tall.T, np.zeros((wide, size + wide))).T

        none = np.zeros_like(self.push)
        return Step(
            square(step.A), rows(step.B, self.push), square(step.Q), step.R, rows(step.N, none), square(step.W), step.c
        )


@dataclass(frozen=True, eq=False, repr=False)
class RegisteredDynamics(Displayed):
    """A step function with registers of inputs: (x, z, d), u, (w, 0, w_d) → f((x, d), u, (w, w_d)) with z⁺ = u between.

    Args:
        dynamics: f.
        place: number of states before the registers.
        inputs: the inputs that have a register, as integers, (r,).
    """

    dynamics: Dynamics
    place: int
    inputs: tuple[int, ...]

    def __call__(self, x: Any, u: Any, w: Any) -> Any:
        """Return the next states of the plant, with the registers among them."""
        n, end = self.place, self.place + len(self.inputs)
        own = np.array([*range(n), *range(end, len(x))])
        found: Any = self.dynamics.function(x[own], u, w[own])
        moved = list(found)
        return np.array([*moved[:n], *(u[i] for i in self.inputs), *moved[n:]])

    @staticmethod
    def of(function: Dynamics, place: int, inputs: list[int]) -> Dynamics:
        """Return the function of a plant with registers, which is moved as the function without them is."""
        moved, fed = function.function, tuple(inputs)
        if not isinstance(moved, MovedDynamics):
            return Dynamics(RegisteredDynamics(function, place, fed))
        x, to = (np.insert(one, [place] * len(fed), moved.u[inputs]) for one in (moved.x, moved.rest))
        return Dynamics(MovedDynamics(Dynamics(RegisteredDynamics(moved.dynamics, place, fed)), x, moved.u, to))
