"""The part of a controller that estimates: a steady Kalman filter, or the measured state itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn.lqg.kalman import Filter
from taciturn.model.plant import Plant
from taciturn.model.policy import Assign, Innovations, Step

ESTIMATE, HELD = "estimate", "held"


@dataclass(frozen=True, eq=False)
class Estimation:
    """Steps that make ``estimate`` of ``y``, and what the theory knows of its error.

    Args:
        correct: steps before the control is computed.
        predict: steps after it, which read ``held``: the input that the controller knows is applied.
        initial: first values of the memories.
        innovations: where the filter whitens the measurement.
    """

    correct: tuple[Step, ...]
    predict: tuple[Step, ...]
    initial: dict[str, Array]
    innovations: Innovations | None


def estimate_state(plant: Plant, steady: Filter) -> Estimation:
    """Return the filtered estimate x̂_k = E[x_k | y_0, …, y_k] in steady state.

    With the full state measured, x̂ = x, Σ = 0 and Σ̃ = W.

    Source: anderson1990optimal
    """
    if plant.full_state:
        measured = Assign("controller", ESTIMATE, {"y": np.eye(plant.states)})
        return Estimation((measured,), (), {}, None)
    correct = (
        Assign("controller", "innovation", {"y": np.eye(plant.outputs), "prior": -plant.C}),
        Assign("controller", ESTIMATE, {"prior": np.eye(plant.states), "innovation": steady.gain}),
    )
    predict = (Assign("controller", "prior", {ESTIMATE: plant.A, HELD: plant.B}),)
    innovations = Innovations("innovation", steady.innovation, ESTIMATE, steady.posterior)
    return Estimation(correct, predict, {"prior": plant.mean}, innovations)
