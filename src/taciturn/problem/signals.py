"""Disturbances, set-points and trajectories of the tables of a problem file."""

from __future__ import annotations

from math import isfinite, nan
from pathlib import Path

import numpy as np

from taciturn._arrays import Array, quoted
from taciturn._files import read_text, why_unreadable
from taciturn._modes import pace
from taciturn._text import backslash_text
from taciturn.errors import ProblemError
from taciturn.lqg.regulation import regulator_equations
from taciturn.model.descriptor import effect_without
from taciturn.model.exosystem import ExternalDisturbance
from taciturn.model.following import with_target
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.reference import Reference
from taciturn.model.set_points import Changes, RandomSteps, SetPoint, Timetable
from taciturn.problem.tables import DisturbanceEntry, File, ReferenceTable, Rows

LARGEST = 2**24  # bytes of a timetable: more than 500,000 set-points
SLOW = 1e-3  # distance from a mode of a constant, relative to the pace of the plant
SHARE, STEPS = 0.5, 1000.0  # a disturbance of integral action moves by this share of the input noise in so many steps


def is_trajectory(table: ReferenceTable | None) -> bool:
    """Return whether a table contains a trajectory, and not set-points.

    Raises:
        ProblemError: the table contains only one of ``states`` and ``inputs``, or also a set-point.
    """
    if table is None or (table.states is None and table.inputs is None):
        return False
    for name, value in (("states", table.states), ("inputs", table.inputs)):
        if value is None:
            raise ProblemError(f"the key reference.{name} is missing; expected it in [reference], with the other one")
    for name in ("outputs", "value", "steps", "file", "integral_action"):
        if getattr(table, name) is not None:
            raise ProblemError(
                f"reference.{name} is given with reference.states; expected either a trajectory (states, inputs) or "
                "set-points"
            )
    return True


def reference_of(table: ReferenceTable | None) -> Reference | None:
    """Return the trajectory of a table, or None for a table of set-points."""
    if table is None or table.states is None or table.inputs is None:
        return None
    return Reference(table.states, table.inputs)


def with_exosystem(
    plant: Plant | ContinuousPlant | None, E: Rows | None, file: File, network: Network
) -> Plant | ContinuousPlant | None:
    """Return a plant with the disturbances and set-points of a file, if it states any.

    Args:
        plant: the plant, without E.
        E: the descriptor matrix of the equation on which disturbances act, or None.
        file: all tables.
        network: the network, which says what a node measures.
    """
    table = file.reference
    points = table if table is not None and table.states is None else None
    if plant is None or (points is None and not file.disturbance):
        return plant
    points = ReferenceTable() if points is None else points
    if points.integral_action == []:
        raise ProblemError("reference.integral_action is empty; expected nodes that measure, or no such key")
    acting = None if points.integral_action is None else _outputs_of(points.integral_action, plant, network)
    rows = np.arange(len(plant.C)) if acting is None else np.array(acting)
    fed = plant.D[rows] if points.outputs is None and plant.D is not None else None
    followed = plant.C[rows] if points.outputs is None else points.outputs
    target = SetPoint(followed, points.value, _changes(points), D=fed)
    given = [_disturbance(place, one, E) for place, one in enumerate(file.disturbance or ())]
    given += [] if acting is None else _at_inputs(plant, target)
    return with_target(plant, target, given, points.value is not None)


def _disturbance(place: int, one: DisturbanceEntry, E: Rows | None) -> ExternalDisturbance:
    """Return the disturbance of a table ``[[disturbance]]``; messages contain its place."""
    try:
        enters = one.enters if E is None else effect_without(E, "disturbance.enters", np.c_[one.enters])[:, 0]
        return ExternalDisturbance(enters, one.wander, one.kind, one.frequency, one.measured, one.matrix)  # type: ignore[arg-type]
    except ProblemError as error:
        raise ProblemError(str(error).replace("disturbance.", f"disturbance[{place}].")) from None


def _changes(table: ReferenceTable) -> Changes | None:
    """Return how the set-points of a table change, or None if they are constant."""
    if table.steps is not None and table.file is not None:
        raise ProblemError("reference.steps and reference.file are given; expected one of them")
    if table.steps is not None:
        return RandomSteps(table.steps.rate, table.steps.covariance)
    if table.file is None:
        return None
    try:
        rows = _rows(read_text(Path(table.file), LARGEST))
    except (OSError, ValueError) as error:
        raise ProblemError(
            f"reference.file {table.file!r} cannot be read ({why_unreadable(error)}); expected rows of a "
            "time and the set-points from then on, separated by commas, without a header"
            f"{backslash_text(table.file)}"
        ) from None
    return Timetable(rows[:, 0], rows[:, 1:])


def _rows(text: str) -> Array:
    """Return the numbers of a text with commas between columns, (rows, columns).

    Raises:
        ValueError: an entry is not a finite number, or the numbers of columns differ; the message names the line of the
            file, as an editor counts, and the column, both from 1 on.
    """
    rows, first = list[list[float]](), 0
    for line, content in enumerate(text.split("\n"), start=1):
        if not (content := content.partition("#")[0].strip()):
            continue
        entries, row = content.split(","), list[float]()
        first = first or line
        if rows and len(entries) != len(rows[0]):
            raise ValueError(f"line {line} has {len(entries)} columns, and line {first} has {len(rows[0])}")
        for column, entry in enumerate(entries, start=1):
            try:
                row.append(float(entry.replace("_", "?")))
            except ValueError:
                row.append(nan)
            if not isfinite(row[-1]):
                raise ValueError(
                    f"column {column} of line {line} is {quoted(entry.strip())}, which is no finite number"
                )
        rows.append(row)
    return np.array(rows).reshape(len(rows), -1) if rows else np.zeros((0, 2))


def _outputs_of(nodes: list[str], plant: Plant | ContinuousPlant, network: Network) -> list[int]:
    """Return the outputs that some nodes measure."""
    measured = dict(network.measurements(len(plant.C)).values())
    for node in (node for node in nodes if node not in measured):
        raise ProblemError(
            f"reference.integral_action names {node!r}; expected nodes that measure: {', '.join(measured)}"
        )
    for node in (node for node in nodes if nodes.count(node) > 1):
        raise ProblemError(f"reference.integral_action names {node!r} twice; expected each node once")
    return [output for node in nodes for output in measured[node]]


def _at_inputs(plant: Plant | ContinuousPlant, target: SetPoint) -> list[ExternalDisturbance]:
    """Return a constant disturbance for each output that has integral action, which enters as the inputs do.

    It enters as the inputs that change this output and no other one, and moves slowly compared with the noise.
    """
    z, n = target.outputs.shape
    weight = np.diag([*np.zeros(n), *np.ones(plant.B.shape[1])])
    moves = np.zeros((z, z)) if plant.continuous else np.eye(z)
    none: Array = np.zeros((n, z))
    _, U = regulator_equations(plant.A, plant.B, moves, none, target.outputs, -np.eye(z), weight, target.D)
    if not U.any(axis=0).all():  # a plant that integrates needs no input at rest: its response near rest decides
        near = SLOW * (pace(plant.A) or 1.0) if plant.continuous else 1.0 + SLOW
        response = target.outputs @ np.linalg.solve(near * np.eye(n) - plant.A, plant.B)
        response += 0.0 if target.D is None else target.D
        U = np.asarray(np.linalg.pinv(response), dtype=np.float64)
    U = U / np.maximum(np.abs(U).max(axis=0), 1e-300)
    inverse = np.asarray(np.linalg.pinv(plant.B @ U), dtype=np.float64)
    seen = np.maximum(np.diag(inverse @ plant.W @ inverse.T), 0.0)
    if not seen.all():
        raise ProblemError(
            "reference.integral_action is given, and W has no noise at an input, from which the speed of the "
            "disturbance follows; expected a positive W there, or [[disturbance]] with its wander"
        )
    return [
        ExternalDisturbance(plant.B @ column, SHARE**2 * size / STEPS)  # a random walk: variances add up
        for column, size in zip(U.T, seen.tolist(), strict=True)
    ]
