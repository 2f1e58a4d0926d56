"""State estimation in the controller of a policy: a steady-state Kalman filter, or the measured state itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.lqg.kalman import Filter
from taciturn.model.plant import Plant
from taciturn.model.policy import Assign, NodeName, Step
from taciturn.model.theory import Innovations

ESTIMATE, HELD = "estimate", "held"


@dataclass(frozen=True, eq=False, repr=False)
class FilterSteps(Displayed):
    """Policy steps that compute the state estimate from the measurement, and the covariances of the estimation error.

    Args:
        correct: policy steps before the control is computed.
        predict: policy steps after the control is computed; they read ``held``, the input that is applied.
        initial: initial values of the memories.
        innovations: white innovations of the filter, or None.
    """

    correct: tuple[Step, ...]
    predict: tuple[Step, ...]
    initial: dict[str, Array]
    innovations: Innovations | None


def estimate_state(plant: Plant, steady: Filter, at: NodeName = "controller") -> FilterSteps:
    """Return the policy steps that compute the steady-state filtered estimate x̂_k = E[x_k | y_0, …, y_k].

    If the full state is measured, x̂ = x, Σ = 0 and Σ̃ = W.

    Source: anderson1990optimal
    """
    if plant.full_state:
        measured = Assign(at, ESTIMATE, {"y": np.eye(plant.states)})
        return FilterSteps((measured,), (), {}, None)
    correct = (
        Assign(at, "innovation", {"y": np.eye(plant.outputs), "prior": -plant.C}),
        Assign(at, ESTIMATE, {"prior": np.eye(plant.states), "innovation": steady.gain}),
    )
    predict = (Assign(at, "prior", {ESTIMATE: plant.A, HELD: plant.B}),)
    innovations = Innovations("innovation", steady.innovation, ESTIMATE, steady.posterior)
    return FilterSteps(correct, predict, {"prior": plant.mean}, innovations)
