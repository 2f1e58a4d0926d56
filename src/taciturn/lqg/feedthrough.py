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
from taciturn._modes import summed
from taciturn.errors import ProblemError
from taciturn.lqg.enclosures import UNIT
from taciturn.lqg.quadratic import placed
from taciturn.model.display import counted_from
from taciturn.model.dynamics import Dynamics
from taciturn.model.operating_point import MovedDynamics, OperatingPoint
from taciturn.model.plant import ContinuousPlant, Plant, derived_plant

if TYPE_CHECKING:
    from taciturn.lqg.discrete import Discrete
    from taciturn.lqg.kalman import Filter

BLUR = 1e-3  # rounding of an output, relative to the deviation of the innovation, that changes no sixth digit of a cost


def fed_inputs(plant: Plant | ContinuousPlant) -> list[int]:
    """Return the inputs that an output shows directly: those with a column of D that is not zero."""
    return [] if plant.D is None else np.flatnonzero(plant.D.any(axis=0)).tolist()


def with_registers(problem: Discrete, source: Plant | ContinuousPlant) -> Discrete:
    """Return a problem with registers of the inputs that the outputs show.

    Args:
        problem: the problem of the plant without D, with disturbances and set-points.
        source: the plant before it was sampled, with D.
    """
    n, fed = source.states, fed_inputs(source)
    inputs: Array = np.eye(problem.plant.inputs)[fed]
    more = n, np.zeros((len(fed), len(fed))), inputs
    own, whole = problem.deviations, problem.quadratic.beside(*more)
    if own is not None:
        kept, new = placed(len(own.T), n, len(fed))
        own = replace(
            own,
            states=np.insert(own.states, [n] * len(fed), False),
            T=kept @ own.T @ kept.T + new @ new.T,
            U=own.U @ kept.T,
            problem=own.problem.beside(*more),
            exact=own.exact and own.exact.beside(*more),
        )
    exact = problem.exact and problem.exact.beside(*more)
    plant = registered(problem.plant, source)
    return replace(problem, plant=plant, Q=whole.Q, N=whole.N, exact=exact, deviations=own, source=source)


def registered(plant: Plant, source: Plant | ContinuousPlant) -> Plant:
    """Return a plant with registers of the inputs that its outputs show by the D of the plant before sampling."""
    n, fed, D = source.states, fed_inputs(source), source.D
    assert D is not None, "only a plant with D needs registers"
    shown = np.zeros((plant.outputs, len(fed)))
    shown[: len(D)] = D[:, fed]
    push: Array = np.eye(plant.inputs)[fed]
    kept, new = placed(plant.states, n, len(fed))
    A, W, covariance = (kept @ part @ kept.T for part in (plant.A, plant.W, plant.covariance))
    found = derived_plant(
        A, kept @ plant.B + new @ push, W, plant.C @ kept.T + shown @ new.T, plant.V, plant.dt, kept @ plant.mean,
        covariance, plant.input_limit, plant.function and RegisteredDynamics.of(plant.function, n, fed),
        input_rate=plant.input_rate,
    )  # fmt: skip
    kept = {"changes": plant.changes, "registers": tuple(fed), "alone": source if isinstance(source, Plant) else None}
    for name, value in kept.items():
        object.__setattr__(found, name, value)
    point = plant.operating_point
    return counted_from(found, None if point is None else OperatingPoint(_at_rest(point, n, fed), point.u), plant)


def expect_digits(problem: Discrete, L: Array, steady: Filter) -> None:
    """Raise an error if an output is so large next to what it tells about the state that its rounding hides this.

    An estimator computes y − D û, where a double holds each term to 2⁻⁵³ of its size, for the inputs û of the loop
    with every sample. The rounding acts as noise of the measurement; below a thousandth of the deviation of the
    innovation, it changes the cost by less than its stated tolerance of 1e-6.

    Raises:
        ProblemError: the rounding is larger.
    """
    plant, fed, keep = problem.plant, problem.registers, problem.decaying
    p, point, place = plant.sensed, plant.operating_point, np.ix_(keep, keep)
    varied = summed((plant.A + plant.B @ L)[place], (steady.prior - steady.posterior)[place])
    if not fed.any() or not np.isfinite(varied).all():  # with a discount, inputs may grow
        return
    size = np.sqrt(np.maximum(np.diag(varied)[fed[keep]], 0.0)) + np.abs(plant.mean[fed])
    if point is not None:
        size += np.abs(point.u[[*plant.registers]])
    rounded = UNIT * np.abs(plant.C[:p, fed]) @ size
    told = np.sqrt(np.maximum(np.diag(steady.innovation)[:p], 0.0))
    worst = int(np.argmax(rounded - BLUR * told))
    if rounded[worst] > BLUR * told[worst] > 0:
        shown = plant.C[worst, fed]
        raise ProblemError(
            f"D has the entry {shown[np.argmax(np.abs(shown) * size)]:.3g}, with which the inputs change output "
            f"{worst + 1} so much that a double holds y − D u only to {rounded[worst]:.2g}; expected at most {BLUR:g} "
            f"of {told[worst]:.2g}, the deviation of what a sample tells about the state: measure this output without "
            "the input, or leave it out"
        )


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
