"""Plants, networks and controllers from the tables of a problem file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from taciturn._arrays import Array
from taciturn.design.kind import Kind
from taciturn.errors import ProblemError
from taciturn.model.controller import PID, Controller
from taciturn.model.disturbance import Disturbance
from taciturn.model.dynamics import Dynamics
from taciturn.model.network import Burst, Network
from taciturn.model.plant import ContinuousPlant, Jumps, Plant
from taciturn.problem.functions import read_function
from taciturn.problem.tables import (
    IDEAL_LINKS,
    BurstTable,
    ControllerTable,
    InitialTable,
    JumpsTable,
    NetworkTable,
    PlantTable,
)


def expect_argument(kind: Kind, name: str, given: str, expected: str) -> None:
    """Raise a ``ProblemError`` if the policy kind takes no argument of this name from a table."""
    if name not in kind.tables:
        raise ProblemError(f"{given} is given, which {kind.name} does not use; expected {expected}")


def plant_of(table: PlantTable, known: Mapping[str, Dynamics]) -> Plant | ContinuousPlant:
    """Return the plant of a table."""
    initial = table.initial or InitialTable()
    if table.dt is None:
        if table.function is not None:
            raise ProblemError(
                "plant.function is given without plant.dt; expected dt, the seconds per step of the function: "
                "taciturn.integrate converts a differential equation into such a function"
            )
        jumps = None if table.jumps is None else _jumps(table.jumps)
        return ContinuousPlant(
            table.A, table.B, table.W, jumps, table.C, table.V, initial.mean, initial.covariance, table.input_limit
        )
    if table.jumps is not None:
        raise ProblemError(
            "plant.jumps is given with plant.dt; expected jumps only with a continuous-time plant: remove dt"
        )
    if table.W is None:
        raise ProblemError("plant.W is missing; expected the process-noise covariance per step (zeros for none)")
    function = None if table.function is None else read_function(table.function, known)
    return Plant(
        table.A, table.B, table.W, table.C, table.V, table.dt, initial.mean, initial.covariance, table.input_limit,
        function,
    )  # fmt: skip


def actual_of(
    table: PlantTable, dt: float | None, design: Plant | ContinuousPlant, known: Mapping[str, Dynamics]
) -> Plant | ContinuousPlant:
    """Return the simulated plant, which must have the time base and the sizes of the design plant."""
    try:
        plant = plant_of(table, known)
    except ProblemError as error:
        raise ProblemError(f"[plant.actual]: {error}") from None
    if table.dt != dt:
        got, expected = ("missing" if step is None else f"{step:g} s" for step in (table.dt, dt))
        raise ProblemError(f"plant.actual.dt is {got}, but plant.dt is {expected}; expected the same time base in both")
    for name, axis in (("A", 0), ("B", 1), ("C", 0)):
        got, expected = getattr(plant, name).shape[axis], getattr(design, name).shape[axis]
        if got != expected:
            size = {"A": "states", "B": "inputs", "C": "outputs"}[name]
            raise ProblemError(f"[plant.actual] has {got} {size}; expected {expected}, as in [plant]")
    return plant


def controller_of(table: ControllerTable) -> Controller | PID:
    """Return the controller of a table."""
    sign = 1.0 if table.sign == "positive" else -1.0
    disturbance = table.disturbance
    if disturbance is not None:
        disturbance = Disturbance(deviation=0.0) if disturbance == "none" else Disturbance(**vars(disturbance))
    stated = {name: rows for name in "ABCDE" if (rows := getattr(table, name)) is not None}
    if table.pid is not None:
        if stated:
            raise ProblemError(f"controller.pid and controller.{next(iter(stated))} are given; expected one of the two")
        gains = {name: -sign * getattr(table.pid, name) for name in ("kp", "ki", "kd")}
        return PID(**gains, filter=table.pid.filter, disturbance=disturbance)
    if "D" not in stated and not {"A", "B", "C"} <= stated.keys():
        raise ProblemError("[controller] has no controller; expected pid, or A, B, C and D, or D alone, a static gain")
    m, p = np.shape(stated["D"]) if "D" in stated else (len(stated["C"]), len(stated["B"][0]))
    A, B, C = (stated.get(name, np.zeros(shape)) for name, shape in (("A", (0, 0)), ("B", (0, p)), ("C", (m, 0))))
    D = None if "D" not in stated else sign * np.array(stated["D"])
    return Controller(A, B, sign * np.array(C), D, stated.get("E"), disturbance=disturbance)


def _jumps(table: JumpsTable) -> Jumps:
    return Jumps(table.rate, cast("Array", table.covariance), cast("Any", table.distribution))


def network_of(table: NetworkTable | None, kind: Kind) -> Network:
    """Return the network of a table, or ideal links; ``kind`` must use losses that no protocol states."""
    if table is None:
        return Network()
    lost = [key for key in vars(table) if key.endswith(("_loss", "_burst")) and getattr(table, key)]
    if lost and table.protocol == "ideal":
        expect_argument(kind, "network", f"network.{lost[0]}", IDEAL_LINKS)
    return Network(
        cast("Any", table.protocol),
        table.actuator_loss,
        table.sensor_loss,
        table.delay,
        _burst("actuator", table.actuator_burst),
        _burst("sensor", table.sensor_burst),
        cast("Any", table.payload),
        cast("Any", table.actuator_range),
        cast("Any", table.sensor_range),
    )


def _burst(link: str, table: BurstTable | None) -> Burst | None:
    try:
        return None if table is None else Burst(**vars(table))
    except ProblemError as error:
        raise ProblemError(f"network.{link}_burst: {error}") from None
