"""Schedules of several sensors, computed from the variances of the predicted outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, frozen
from taciturn.errors import UnstableError
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.queries import LONGEST, Predictor, cycle_of, expect_queries
from taciturn.model.plant import Plant
from taciturn.model.schedule import Schedule

Sensors = Mapping[str, Sequence[int]]  # the outputs of each sensor by its link; the other outputs are always measured


def schedule_by_variance(plant: Plant, threshold: float, sensors: Sensors) -> Schedule:
    """Return the periodic schedule of sensors that send if the variance of a predicted output exceeds a threshold.

    Sensor l is queried if (CΣ_kC')_ii > threshold for one of its outputs i, where Σ_k is the covariance of the
    prediction from the measurements of all sensors that were queried before.

    Args:
        plant: plant with A, C, W and V.
        threshold: largest variance without a query, at least 0.
        sensors: the outputs of each sensor by its link; outputs that are not listed are measured at every step.

    Returns:
        The schedule; its value at each step is the largest variance of an output of each sensor.

    Raises:
        UnstableError: the schedule does not repeat within 100,000 steps, or never queries an unstable plant.

    Source: trimpe2014
    """
    every = Predictor(plant)
    predictors = {tuple(range(plant.outputs)): every, (): every}
    covariance, value = [steady_filter(plant.A, plant.C, plant.W, plant.V).prior], list[list[float]]()
    for _ in range(LONGEST):
        variances = np.diag(plant.C @ covariance[-1] @ plant.C.T)
        value.append([float(variances[[*outputs]].max()) for outputs in sensors.values()])
        read = tuple(np.flatnonzero(_measured(plant, np.array(value[-1]) > threshold, sensors)).tolist())
        if read not in predictors:
            predictors[read] = Predictor(plant, read)
        covariance.append(predictors[read].follow(covariance[-1], len(read) > 0))
        cycle = cycle_of(every, covariance)
        if cycle is not None:
            return _repeating(plant, covariance[slice(*cycle)], value[slice(*cycle)], threshold, sensors)
    raise UnstableError(
        f"with threshold = {threshold:g} the schedule of measurements does not repeat within {LONGEST} steps; "
        "expected another threshold"
    )


def corrections_of(plant: Plant, schedule: Schedule, sensors: Sensors) -> Array:
    """Return the gains ΣC'(CΣC' + V)^{-1} of the measured outputs in each step, 0 for all other outputs, (steps, n, p).

    Args:
        plant: plant with A, C, W and V.
        schedule: schedule of the sensors.
        sensors: the outputs of each sensor by its link; outputs that are not listed are measured at every step.
    """
    measured = _measured(plant, schedule.queries.reshape(len(schedule.queries), -1), sensors)
    found = Predictor(plant).correction(schedule.covariance) * measured[:, None, :]
    for row in np.unique(measured, axis=0):
        if row.any() and not row.all():
            ticks, outputs = (measured == row).all(axis=1), np.flatnonzero(row).tolist()
            gains = Predictor(plant, outputs).correction(schedule.covariance[ticks])
            found[np.ix_(ticks, range(plant.states), outputs)] = gains
    return found


def _repeating(
    plant: Plant, covariance: Sequence[Array], value: Sequence[Sequence[float]], threshold: float, sensors: Sensors
) -> Schedule:
    values = np.array(value)
    values = frozen(values[:, 0] if len(sensors) == 1 else values)
    found = Schedule(values > threshold, values, frozen(np.array(covariance)), threshold, 0, links=(*sensors,))
    if sum(map(len, sensors.values())) == plant.outputs:
        expect_queries(plant, found)
    return found


def _measured(plant: Plant, queries: npt.NDArray[np.bool_], sensors: Sensors) -> npt.NDArray[np.bool_]:
    """Return whether each output is measured, (…, p), if the sensors are queried or not, (…, links)."""
    measured = np.ones((*queries.shape[:-1], plant.outputs), dtype=np.bool_)
    for column, outputs in enumerate(sensors.values()):
        measured[..., [*outputs]] = queries[..., column, None]
    return measured
