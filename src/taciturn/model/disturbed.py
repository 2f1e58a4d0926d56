"""Step functions of nonlinear plants with their disturbances and set-points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.model.dynamics import Dynamics
from taciturn.model.operating_point import MovedDynamics


@dataclass(frozen=True, eq=False, repr=False)
class DisturbedDynamics(Displayed):
    """A step function with an exosystem: (x, d), u, (w, w_d) → (f(x, u, w) + E d, S d + w_d).

    Args:
        dynamics: f.
        E: effect of the disturbances on the next state, (n, q).
        S: dynamics of disturbances and set-points, (q, q).
    """

    dynamics: Dynamics
    E: Array
    S: Array

    def __call__(self, x: Any, u: Any, w: Any) -> Any:
        """Return the next states of the plant, its disturbances and its set-points."""
        n = len(self.E)
        found: Any = self.dynamics.function(x[:n], u, w[:n])
        return np.array([*(np.array(list(found)) + self.E @ x[n:]), *(self.S @ x[n:] + w[n:])])

    @staticmethod
    def of(function: Dynamics, E: Array, S: Array, rest: Array) -> Dynamics:
        """Return the function of a plant with its exosystem, which is moved as the function of the plant alone is.

        Args:
            function: f, which may be moved to an operating point.
            E: effect of the disturbances on the next state, (n, q).
            S: dynamics of disturbances and set-points, (q, q).
            rest: disturbances and set-points at the operating point, with E d = 0 and S d = d, (q,).
        """
        moved = function.function
        if not isinstance(moved, MovedDynamics):
            return Dynamics(DisturbedDynamics(function, E, S))
        x, to = (np.concatenate([one, rest]) for one in (moved.x, moved.rest))
        return Dynamics(MovedDynamics(Dynamics(DisturbedDynamics(moved.dynamics, E, S)), x, moved.u, to))
