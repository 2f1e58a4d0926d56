"""Operating points: equilibria of a plant, from which a design measures deviations.

With the operating point x₀, u₀, a linear plant is x⁺ − x₀ = A (x − x₀) + B (u − u₀) + w, and y = C x + v. A plant
stores the mean of its initial state, its limits and its function in deviations from the point.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, set_fields
from taciturn._display import Displayed
from taciturn.model.dynamics import AT_REST, Dynamics
from taciturn.model.key import stated_as


@dataclass(frozen=True, eq=False, repr=False)
class OperatingPoint(Displayed):
    """An equilibrium of a plant without noise: its state and input, in the units of the plant.

    Args:
        x: state x₀, (n,).
        u: input u₀, (m,).

    Raises:
        ProblemError: an entry is not finite.

    Example:
        >>> OperatingPoint([12.4], [3.0]).x
        array([12.4])
    """

    x: Array = field(metadata=stated_as(list[float]))
    u: Array = field(metadata=stated_as(list[float]))

    def __init__(self, x: ArrayLike, u: ArrayLike) -> None:
        """Validate and store the arguments."""
        state = array("operating_point.x", x, (None,), "(states,)")
        set_fields(self, {"x": state, "u": array("operating_point.u", u, (None,), "(inputs,)")})

    def short(self) -> str:
        """Return the point as text."""
        x, u = (", ".join(f"{value:.6g}" for value in one) for one in (self.x, self.u))
        return f"x = [{x}], u = [{u}]"

    def same_as(self, other: OperatingPoint) -> bool:
        """Return whether the other operating point has the same state and input."""
        return np.array_equal(self.x, other.x) and np.array_equal(self.u, other.u)


@dataclass(frozen=True, eq=False, repr=False)
class MovedDynamics(Displayed):
    """A step function in shifted coordinates: (x, u, w) → f(x + x₀, u + u₀, w) − rest."""

    dynamics: Dynamics  # f, in the units of the plant
    x: Array  # x₀, (n,)
    u: Array  # u₀, (m,)
    rest: Array  # offset that is subtracted from the next state, (n,)

    def __call__(self, x: Any, u: Any, w: Any) -> Any:
        """Return the next state, relative to ``rest``."""
        found: Any = self.dynamics.function(x + self.x, u + self.u, w)
        return np.array(list(found)) - self.rest

    @staticmethod
    def of(function: Dynamics, x: Array, u: Array, to: Array) -> Dynamics:
        """Shift the coordinates of a step function by x and u. Two shifts that cancel each other are removed."""
        inner, rest = function, to
        if isinstance(function.function, MovedDynamics):
            moved = function.function
            inner, x, u, rest = moved.dynamics, x + moved.x, u + moved.u, moved.rest + to
            size = max(1.0, *(float(np.abs(one).max()) for one in (moved.x, moved.u, moved.rest)))
            if all(float(np.abs(one).max()) <= AT_REST * size for one in (x, u, rest)):
                return inner
        return Dynamics(MovedDynamics(inner, x, u, rest))
