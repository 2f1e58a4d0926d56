"""Constant set-points and the start of a given controller.

A policy is designed for the deviations from the point at which the loop rests: with the state x* and the input u* for
which the outputs equal their set-points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.design.estimation import HELD
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.feedthrough import registers_from, with_inputs_before
from taciturn.lqg.regulation import beyond_limits
from taciturn.model.controller import Controller
from taciturn.model.display import about
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.plant import Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import assigned

RESTS = 1e-9  # relative residual of an equation of the point


@dataclass(frozen=True, eq=False, repr=False)
class Rest(Displayed):
    """The point at which the loop of a controller rests, and its start, relative to the plant's own operating point.

    Args:
        state: state x* of the plant, (n,).
        input: input u*, (m,).
        start: state of the controller at the start, relative to its state at rest, (k,).
        before: the input before the start, relative to u*, (m,).
    """

    state: Array
    input: Array
    start: Array
    before: Array

    @property
    def moved(self) -> bool:
        """True if state or input differ from zero at the point, or the controller does not start at rest."""
        return any(one.any() for one in (self.state, self.input, self.start, self.before))

    def deviations(self, problem: Discrete) -> Discrete:
        """Return the problem of the deviations from the point."""
        plant = problem.plant
        if self.state.any() or self.input.any():
            here = plant.operating_point
            x, u = (0.0, 0.0) if here is None else (here.x, here.u)
            plant = about(plant, OperatingPoint(x + self.state, u + self.input))
        if plant.registers and self.before.any():
            plant = with_inputs_before(plant, registers_from(problem), self.before)
        return replace(problem, plant=plant)

    def begun(self, policy: Policy) -> Policy:
        """Return a policy whose memories of the input start with the input before the start."""
        if not self.before.any():
            return policy
        signals = {name for step in policy.steps for name in assigned(step)}
        names = [name for name in ("command", HELD, "input") if name in signals]  # fingerprints contain their order
        return replace(policy, initial={**dict.fromkeys(names, self.before), **policy.initial})


def rest_of(problem: Discrete, controller: Controller) -> Rest:
    """Return the point at which a loop rests.

    Raises:
        ProblemError: the plant cannot rest at the set-point, or the controller does not hold it.
    """
    plant, r = problem.plant, controller.setpoint
    (n, m), p = plant.B.shape, plant.outputs
    state, steady, rest = np.zeros(n), np.zeros(m), np.zeros(len(controller.A))
    if problem.cost.mission and (r.any() or controller.start_input is not None):
        raise ProblemError(
            "a set-point or start_input is given, and the cost is a total over a horizon or with a discount; expected "
            "an average cost"
        )
    if r.any():
        moving = np.block([[plant.A - np.eye(n), plant.B], [plant.C, np.zeros((p, m))]])
        found = _solved(
            moving, np.concatenate([np.zeros(n), r]), f"the plant cannot rest at the set-point {r.tolist()}"
        )
        state, steady = found[:n], found[n:]
        limit = plant.input_limit
        if limit is not None and ((steady <= limit[:, 0]) | (steady >= limit[:, 1])).any():
            raise beyond_limits(plant, steady)
        k = len(controller.A)
        holding = np.vstack([np.eye(k) - controller.A, controller.C])
        caused = np.concatenate([controller.E @ steady, steady])
        rest = _solved(holding, caused, "the controller does not hold the set-point, as it does not integrate")
        rest = rest + controller.rest
    start, before = -rest, -steady
    if controller.start_input is not None:
        _expect_within_limits(plant, controller.start_input)
        before = controller.start_input - steady
        if plant.registers:
            plant = with_inputs_before(plant, registers_from(problem), controller.start_input)
        start = _bumpless(controller, plant.C @ plant.mean - r, before)
    return Rest(state, steady, start, before)


def _expect_within_limits(plant: Plant, start_input: Array) -> None:
    """Raise a ``ProblemError`` if an actuator cannot have applied the stated input before the start."""
    limit, point = plant.input_limit, plant.operating_point
    if limit is None or ((start_input >= limit[:, 0]) & (start_input <= limit[:, 1])).all():
        return
    units = np.zeros(len(start_input)) if point is None else point.u
    raise ProblemError(
        f"start_input is {(start_input + units).tolist()}, beyond the input_limit {(limit + units[:, None]).tolist()}; "
        "expected an input within the limits, as the plant had it before the start"
    )


def _bumpless(c: Controller, error: Array, command: Array) -> Array:
    """Return the state of the controller with a first command, at rest apart from its integrals.

    Args:
        c: the controller.
        error: mean measurement at the start minus set-point, (p,).
        command: deviation of the command, (m,).
    """
    left = np.eye(len(c.A)) - c.A - c.E @ c.C
    state = np.asarray(np.linalg.pinv(left) @ (c.B + c.E @ c.D) @ error, dtype=np.float64)
    _, sizes, rows = np.linalg.svd(left)
    integrals = rows[sizes < 1e-9].T
    state = state + integrals @ np.linalg.pinv(c.C @ integrals) @ (command - c.C @ state - c.D @ error)
    if np.abs(c.C @ state + c.D @ error - command).max() > RESTS * max(1.0, float(np.abs(command).max())):
        raise ProblemError("start_input is given, and not every input has an integral; expected an integral for each")
    return state


def _solved(matrix: Array, right: Array, what: str) -> Array:
    """Return the smallest solution of a linear system.

    Raises:
        ProblemError: there is none.
    """
    found = np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0], dtype=np.float64)
    if np.abs(matrix @ found - right).max(initial=0.0) > RESTS * np.abs(right).max(initial=0.0):
        raise ProblemError(f"{what}; expected a set-point that the loop holds, or none")
    return found
