"""Operating points: the state and the input of a plant at which it rests, and from which a design counts deviations.

With the operating point x₀, u₀, a linear plant is x⁺ − x₀ = A (x − x₀) + B (u − u₀) + w, and y = C x + v. A plant
stores the mean of its initial state, its limits and its function in deviations from the point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, frozen, instance
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.dynamics import AT_REST, Dynamics, Map

if TYPE_CHECKING:
    from taciturn.model.plant import ContinuousPlant, Plant


@dataclass(frozen=True, eq=False, repr=False)
class OperatingPoint(Displayed):
    """The state and the input at which a plant rests without noise, in the units of the plant.

    Args:
        x: state x₀, (n,).
        u: input u₀, (m,).

    Raises:
        ProblemError: an entry is not finite.

    Example:
        >>> OperatingPoint([12.4], [3.0]).x
        array([12.4])
    """

    x: Array
    u: Array

    def __init__(self, x: ArrayLike, u: ArrayLike) -> None:
        """Validate and store the arguments."""
        object.__setattr__(self, "x", array("operating_point.x", x, (None,), "(states,)"))
        object.__setattr__(self, "u", array("operating_point.u", u, (None,), "(inputs,)"))

    def short(self) -> str:
        """Return the point as text."""
        x, u = (", ".join(f"{value:.6g}" for value in one) for one in (self.x, self.u))
        return f"x = [{x}], u = [{u}]"

    def same_as(self, other: OperatingPoint) -> bool:
        """Return whether the other point has the same state and input."""
        return np.array_equal(self.x, other.x) and np.array_equal(self.u, other.u)


@dataclass(frozen=True, eq=False, repr=False)
class MovedDynamics(Displayed):
    """A step function in other coordinates: x, u, w → f(x + x₀, u + u₀, w) − rest.

    Args:
        dynamics: f, in the units of the plant.
        x: x₀, (n,).
        u: u₀, (m,).
        rest: offset that is subtracted from the next state, (n,).
    """

    dynamics: Dynamics
    x: Array
    u: Array
    rest: Array

    def __call__(self, x: Any, u: Any, w: Any) -> Any:
        """Return the next state, relative to ``rest``."""
        found: Any = self.dynamics.function(x + self.x, u + self.u, w)
        return np.array(list(found)) - self.rest

    @staticmethod
    def of(function: Dynamics, x: Array, u: Array, to: Array) -> Dynamics:
        """Return a function in coordinates moved by x and u, without an earlier move if both cancel.

        Args:
            function: the function, which may be in moved coordinates.
            x: added to the state, (n,).
            u: added to the input, (m,).
            to: subtracted from the next state, (n,).
        """
        inner, rest = function, to
        if isinstance(function.function, MovedDynamics):
            moved = function.function
            inner, x, u, rest = moved.dynamics, x + moved.x, u + moved.u, moved.rest + to
            size = max(1.0, *(float(np.abs(one).max()) for one in (moved.x, moved.u, moved.rest)))
            if all(float(np.abs(one).max()) <= AT_REST * size for one in (x, u, rest)):
                return inner
        return Dynamics(MovedDynamics(inner, x, u, rest))


def stated_function(plant: Plant) -> Dynamics | None:
    """Return the function of a plant in the units of the plant, or None."""
    function = plant.function
    return function.function.dynamics if function and isinstance(function.function, MovedDynamics) else function


def locate(plant: Plant | ContinuousPlant, point: OperatingPoint | None, mean: bool) -> None:
    """Set the operating point of a new plant, and count its initial mean and its limits from there.

    Args:
        plant: the plant, in its units.
        point: the operating point, or None.
        mean: whether the mean of the initial state is given; it is that of the operating point otherwise.

    Raises:
        ProblemError: the point has another number of states or inputs than the plant.
    """
    object.__setattr__(plant, "operating_point", point)
    if point is None:
        return
    instance("operating_point", point, OperatingPoint)
    n, m = plant.B.shape
    array("operating_point.x", point.x, (n,), "(states,)")
    array("operating_point.u", point.u, (m,), "(inputs,)")
    if mean:
        object.__setattr__(plant, "mean", frozen(plant.mean - point.x))
    limit = plant.input_limit
    if limit is not None:
        for i in np.flatnonzero((point.u < limit[:, 0]) | (point.u > limit[:, 1])):
            raise ProblemError(
                f"operating_point.u is {point.u[i]:g} for input {i + 1}, beyond its input_limit "
                f"[{limit[i, 0]:g}, {limit[i, 1]:g}]; expected an input within the limits"
            )
        object.__setattr__(plant, "input_limit", limits_at(plant, point))


def limits_at(plant: Plant | ContinuousPlant, point: OperatingPoint | None) -> Array | None:
    """Return the limits of the inputs of a plant in deviations from a point, (m, 2), or None.

    They are computed from the limits in the units of the plant: (limit − u) + u differs from the limit by rounding.
    """
    limit = plant.stated_limit
    return limit if limit is None or point is None else frozen(limit - point.u[:, None])


def dynamics_at(function: Map | Dynamics, plant: Plant, point: OperatingPoint | None) -> Dynamics:
    """Return the function of a plant in deviations from its operating point, which A and B must linearise there.

    Raises:
        ProblemError: the function fails, does not rest at the point, or has other derivatives than A and B there.
    """
    found = function if isinstance(function, Dynamics) else Dynamics(function)
    if point is None:
        found.check(plant.A, plant.B, plant.W)
        return found
    found.check(plant.A, plant.B, plant.W, (point.x, point.u))
    rest = found(point.x, point.u, np.zeros(len(point.x)))
    return MovedDynamics.of(found, point.x, point.u, rest)
