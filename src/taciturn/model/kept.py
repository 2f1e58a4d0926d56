"""Controllers that a user already has, and the conversion of systems of other libraries into controllers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, TypeAlias, cast

import numpy as np

from taciturn._arrays import ArrayLike, array, choice, quoted
from taciturn.errors import ProblemError
from taciturn.model.controller import ContinuousController, Controller, Method
from taciturn.model.disturbance import Disturbance
from taciturn.model.pid import PID, PIDLoops
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.state_space import refuse_descriptor, state_space_of, vars_of

Kept: TypeAlias = Controller | ContinuousController | PID | PIDLoops


def pids_of(kept: object) -> tuple[PID, ...]:
    """Return the PID controllers of a given controller; none if it is another one."""
    return kept.loops if isinstance(kept, PIDLoops) else (kept,) if isinstance(kept, PID) else ()


def relative_to(kept: Kept, plant: Plant | ContinuousPlant) -> Kept:
    """Return a controller whose set-points and inputs are relative to the operating point of a plant.

    A set-point of 0 is the one at the operating point.
    """
    point = plant.operating_point
    if point is None:
        return kept
    y = plant.rest_outputs
    if isinstance(kept, PID | PIDLoops):
        first, found = set[int](), list[PID]()
        for one in pids_of(kept):
            r = one.setpoint and one.setpoint - (float(y[one.output - 1]) if one.output <= len(y) else 0.0)
            u = one.start_input
            if u is not None and one.input <= len(point.u) and one.input not in first:
                first.add(one.input)
                u -= float(point.u[one.input - 1])
            weights = {"b": one.b, "c": one.c} if r else {"b": 1.0, "c": 0.0}
            found.append(replace(one, setpoint=r, start_input=u, **weights))
        return found[0] if isinstance(kept, PID) else PIDLoops(tuple(found))
    if kept.setpoint is None:
        return kept
    r = np.asarray(kept.setpoint, dtype=np.float64)
    moved = np.where(r != 0.0, r - y, 0.0) if np.shape(r) == np.shape(y) else r
    if isinstance(kept, ContinuousController):
        return replace(kept, setpoint=moved)
    u = None if kept.start_input is None else kept.start_input - point.u
    return Controller(kept.A, kept.B, kept.C, kept.D, kept.E, kept.dt, kept.disturbance, moved, kept.rest, u)


def controller_from(
    system: object,
    sign: Literal["negative", "positive"] = "negative",
    method: Method | None = None,
    E: ArrayLike | None = None,
    disturbance: Disturbance | None = None,
    setpoint: ArrayLike | None = None,
) -> Kept:
    """Convert a system of python-control or scipy, a gain matrix, or a list of PID controllers into a controller.

    Args:
        system: a system from measurements to inputs with attributes A, B, C, D and dt, or with a method ``to_ss``; a
            gain matrix K, (m, p); or PID controllers, for which no other argument is needed.
        sign: ``"negative"``: feedback u = −K y; ``"positive"``: u = K y.
        method: discretisation of a continuous system, ``"tustin"`` (default) or ``"zoh"``.
        E: effect of the applied input on the state of a discrete system, (k, m).
        disturbance: as for ``Controller``.
        setpoint: as for ``Controller``.

    Returns:
        The controller.

    Raises:
        ProblemError: the system is not linear or not proper, or an argument does not apply to it.

    Example:
        >>> import scipy.signal
        >>> controller_from(scipy.signal.TransferFunction([2.0, 1.0], [1.0, 0.0])).at(0.1, 1, 1).D.tolist()
        [[-2.05]]
    """
    factor = -1.0 if choice("sign", sign, ("negative", "positive")) == "negative" else 1.0
    others = {"method": method, "E": E, "disturbance": disturbance, "setpoint": setpoint}
    stated = [name for name, value in others.items() if value is not None] + ["sign"] * (factor > 0)
    listed = cast("Sequence[object]", system) if isinstance(system, list | tuple) else ()
    loops = [one for one in listed if isinstance(one, PID)]
    if isinstance(system, Controller | ContinuousController | PID | PIDLoops) or loops:
        if stated:
            raise ProblemError(f"{stated[0]} is given with a complete controller; expected it in the controller itself")
        if len(loops) < len(listed):
            wrong = next(one for one in listed if not isinstance(one, PID))
            raise ProblemError(f"the list of PID controllers contains {quoted(wrong)}; expected PID controllers only")
        return PIDLoops(tuple(loops)) if loops else cast("Kept", system)
    if isinstance(system, np.ndarray | Sequence | float | int):
        for name in (name for name in ("method", "E") if name in stated):
            raise ProblemError(f"{name} is given with a gain matrix, which has no state; expected no {name}")
        K = factor * array("controller", np.atleast_2d(cast("Any", system)), (None, None), "(inputs, outputs)")
        m, p = K.shape
        if not K.size:
            raise ProblemError("the controller is empty; expected a gain matrix K, or PID controllers")
        return Controller(np.zeros((0, 0)), np.zeros((0, p)), np.zeros((m, 0)), K, None, None, disturbance, setpoint)
    linear, dt = state_space_of("controller", system)
    refuse_descriptor("controller", vars_of(linear))
    A, B, C, D = (np.asarray(getattr(linear, name), dtype=np.float64) for name in "ABCD")
    if dt == 0:
        if E is not None:
            raise ProblemError(
                "E is given with a continuous controller; expected a discrete controller, whose steps E refers to"
            )
        return ContinuousController(A, B, factor * C, factor * D, method or "tustin", disturbance, setpoint)
    if method is not None:
        raise ProblemError(f"method is {method!r} with a discrete controller; expected no method, or dt = 0")
    return Controller(A, B, factor * C, factor * D, E, dt, disturbance, setpoint)
