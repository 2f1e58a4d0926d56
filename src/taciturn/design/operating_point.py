"""Constant set-points of a given controller: policies in the units of plant and sensors.

A policy is designed for the deviations from the point at which the loop rests: with the state x* and the input u* for
which the outputs equal their set-points. Then measurements are reduced by the set-point, u* is added to the inputs, and
the cost weights the deviations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.design.anti_windup import within_limits
from taciturn.design.estimation import HELD
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete
from taciturn.model.controller import Controller
from taciturn.model.plant import Plant
from taciturn.model.policy import ONE, Assign, Policy, Step
from taciturn.model.reference import Tracking
from taciturn.model.saturation import limit_entries
from taciturn.model.steps import Terms, assigned
from taciturn.model.trigger import Scheduled

TARGET, STEADY = "target", "steady input"
RESTS = 1e-9  # relative residual of an equation of the point


@dataclass(frozen=True, eq=False, repr=False)
class OperatingPoint(Displayed):
    """The point at which a loop rests, and the deviation of the controller from it at the start.

    Args:
        plant: the plant in its own units.
        state: state x* of the plant, (n,).
        input: input u*, (m,).
        output: set-point of each output, (p,).
        start: state of the controller at the start, relative to its state at rest, (k,).
        before: the input before the start, (m,).
    """

    plant: Plant
    state: Array
    input: Array
    output: Array
    start: Array
    before: Array

    @property
    def moved(self) -> bool:
        """True if state or input differ from zero at the point."""
        return bool(self.state.any() or self.input.any())

    def deviations(self, problem: Discrete) -> Discrete:
        """Return the problem of the deviations from the point."""
        p = self.plant
        moved = Plant(
            p.A, p.B, p.W, p.C, p.V, p.dt, p.mean - self.state, p.covariance, p.input_limit, p.function,
            input_rate=p.input_rate,
        )  # fmt: skip
        return replace(problem, plant=moved)

    def applied_to(self, policy: Policy) -> Policy:
        """Return a policy of deviations in the units of the plant; without a set-point and limits, it is the same."""
        if not self.moved and not self.before.any():
            return within_limits(policy)
        tracked = tuple(
            Assign("actuator", name, {ONE: value[:, None]})
            for name, value in ((TARGET, self.state), (STEADY, self.input))
        )
        steps = [self._in_units(step) for step in policy.steps]
        before = {HELD: self.before - self.input, "command": self.before - self.input, "input": self.before}
        remembered = {name for name in before if any(name in assigned(step) for step in steps)}
        found = replace(
            policy,
            steps=(*(tracked if self.moved else ()), *steps),
            theory=replace(policy.theory, innovations=None),
            tracking=Tracking(TARGET, STEADY, self.state) if self.moved else None,
            initial={**{name: before[name] for name in remembered}, **policy.initial},
            model=self.plant,
        )
        return within_limits(found, self.input)

    def _in_units(self, step: Step) -> Step:
        """Return a policy step with the measurement minus the set-point, and with u* in the input."""
        if not isinstance(step, Assign):
            return step
        branches = tuple(self._terms(step, terms) for terms in step.branches)
        return Assign(step.at, step.signal, branches if step.on else branches[0], step.on)

    def _terms(self, step: Assign, terms: Terms) -> Terms:
        added = np.zeros((step.size, 1))
        for name, value in {"y": self.output, "input": self.input}.items():
            if name in terms and name != step.signal:
                matrix = terms[name]
                assert not isinstance(matrix, Scheduled)
                added -= matrix @ value[:, None]
        if step.signal == "input" and "input" not in terms:
            added += self.input[:, None]
        constant = terms.get(ONE, np.zeros_like(added))
        assert not isinstance(constant, Scheduled)
        return {**terms, ONE: added + constant} if added.any() else terms


def operating_point(problem: Discrete, controller: Controller) -> OperatingPoint:
    """Return the point at which a loop rests.

    Raises:
        ProblemError: the plant cannot rest at the set-point, or the controller does not hold it.
    """
    plant, r = problem.plant, controller.setpoint
    (n, m), p = plant.B.shape, plant.outputs
    state, steady, rest = np.zeros(n), np.zeros(m), np.zeros(len(controller.A))
    if problem.cost.mission and (r.any() or controller.start_input is not None):
        raise ProblemError("a set-point or start_input is given, and the cost is a total; expected an average cost")
    if r.any():
        moving = np.block([[plant.A - np.eye(n), plant.B], [plant.C, np.zeros((p, m))]])
        found = _solved(
            moving, np.concatenate([np.zeros(n), r]), f"the plant cannot rest at the set-point {r.tolist()}"
        )
        state, steady = found[:n], found[n:]
        limit = plant.input_limit
        if limit is not None and ((steady <= limit[:, 0]) | (steady >= limit[:, 1])).any():
            raise ProblemError(
                f"the set-point needs the input {steady.round(4).tolist()}, beyond the input_limit "
                f"{limit_entries(limit)}; "
                "expected a set-point within the limits"
            )
        k = len(controller.A)
        holding = np.vstack([np.eye(k) - controller.A, controller.C])
        caused = np.concatenate([controller.E @ steady, steady])
        rest = _solved(holding, caused, "the controller does not hold the set-point, as it does not integrate")
        rest = rest + controller.rest
    start, before = -rest, np.zeros(m) if controller.start_input is None else controller.start_input
    if controller.start_input is not None:
        start = _bumpless(controller, plant.C @ plant.mean - r, controller.start_input - steady)
    return OperatingPoint(plant, state, steady, r, start, before)


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
