"""Plants whose outputs are to follow set-points in spite of disturbances."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import TypeVar

from taciturn._arrays import ArrayLike, instance
from taciturn.errors import ProblemError
from taciturn.model.exosystem import Exosystem, ExternalDisturbance
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.set_points import Changes, SetPoint, Timetable

AnyPlant = TypeVar("AnyPlant", bound=Plant | ContinuousPlant)


def follow(
    plant: AnyPlant,
    outputs: ArrayLike | None = None,
    value: ArrayLike | None = None,
    disturbances: Sequence[ExternalDisturbance] | ExternalDisturbance = (),
    changes: Changes | None = None,
) -> AnyPlant:
    """Return a plant with disturbances that are to be compensated, and with set-points of some outputs.

    Args:
        plant: the plant.
        outputs: C_z of the outputs z = C_z x that are to be at their set-points in spite of the disturbances, (z, n);
            default: the measured outputs, C x + D u for a plant with a direct feedthrough.
        value: the set-points, (z,), in the units of the plant; default: z at its operating point. With steps at random
            times, those at the start.
        disturbances: the disturbances, or the only one.
        changes: how the set-points change while the loop runs; None for constant set-points.

    Returns:
        The plant. A policy for it estimates the disturbances, and its cost weights the deviations from the states and
        inputs at which z is at the set-points.

    Raises:
        ProblemError: a size does not fit the plant.

    Source: francis1977

    Example:
        >>> plant = Plant([[0.9]], [[1.0]], [[0.1]], C=[[1.0]], V=[[0.1]])
        >>> follow(plant, value=[2.0], disturbances=[ExternalDisturbance([1.0], wander=1e-3)]).exosystem.start
        array([0., 2.])
    """
    instance("plant", plant, Plant, ContinuousPlant)
    listed = (disturbances,) if isinstance(disturbances, ExternalDisturbance) else disturbances
    for one in listed:
        instance("disturbances", one, ExternalDisturbance)
    if plant.exosystem is not None:
        raise ProblemError(
            "the plant already has disturbances or set-points; expected all of them in one call, for the plant without"
        )
    fed = plant.D if outputs is None else None
    target = SetPoint(plant.C if outputs is None else outputs, value, changes, D=fed)
    return with_target(plant, target, listed, value is not None)


def with_target(
    plant: AnyPlant, target: SetPoint, disturbances: Sequence[ExternalDisturbance], valued: bool
) -> AnyPlant:
    """Return a plant with disturbances and a set-point, in the units of the plant if it is ``valued`` or a timetable.

    Raises:
        ProblemError: a size does not fit the plant.
    """
    if target.outputs.shape[1] != len(plant.A):
        raise ProblemError(
            f"reference.outputs has {target.outputs.shape[1]} columns; expected {len(plant.A)}, one per state"
        )
    point = plant.operating_point
    if point is not None and (valued or isinstance(target.changes, Timetable)):
        target = target.relative_to(point.x, point.u)
    found = copy(plant)
    object.__setattr__(found, "exosystem", Exosystem.of(disturbances, target, len(plant.C), plant.continuous))
    return found
