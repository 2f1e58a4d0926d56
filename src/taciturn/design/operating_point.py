"""Constant set-points and limited inputs of a given controller: policies in the units of plant and sensors.

A policy is designed for the deviations from the point at which the loop rests: with the state x* and the input u* for
which the outputs equal their set-points. Then measurements are reduced by the set-point, u* is added to the inputs, and
the cost weights the deviations. With limits, the node that decides computes the input that the actuator applied.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.design.estimation import HELD
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete
from taciturn.model.controller import Controller
from taciturn.model.plant import Plant
from taciturn.model.policy import ONE, Apply, Assign, Condition, Policy, Step
from taciturn.model.reference import Tracking
from taciturn.model.saturation import limit_entries
from taciturn.model.trigger import Matrix, Scheduled

TARGET, STEADY, WANTED, LIMITED = "target", "steady input", "wanted", "applied input"
FOLLOWED = ("state", "forecast")  # memories of a controller at the actuator that use its command
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
        limit, moved = self.plant.input_limit, self.moved
        if limit is None and not moved and not self.before.any():
            return policy
        tracked = tuple(
            Assign("actuator", name, {ONE: value[:, None]})
            for name, value in ((TARGET, self.state), (STEADY, self.input))
        )
        steps = [found for step in policy.steps for found in self._in_units(step)]
        before = {HELD: self.before - self.input, "command": self.before - self.input, "input": self.before}
        signals = [step for step in steps if isinstance(step, Assign | Apply)]
        remembered = {name for name in before if any(name in _results(step) for step in signals)}
        return replace(
            policy,
            steps=(*(tracked if moved else ()), *steps),
            model=self.plant,
            theory=replace(policy.theory, innovations=None, functions=policy.theory.functions | {HELD, LIMITED}),
            tracking=Tracking(TARGET, STEADY, self.state) if moved else None,
            initial={**{name: before[name] for name in remembered}, **policy.initial},
        )

    def _in_units(self, step: Step) -> tuple[Step, ...]:
        """Return a policy step with the measurement minus the set-point, u* in the input, and inputs as applied."""
        if not isinstance(step, Assign):
            return (step,)
        limit, before = self.plant.input_limit, tuple[Step, ...]()
        applied = "input" if "input" in _read(step) and step.signal != "input" else ""
        applied = "command" if "command" in _read(step) and step.signal in FOLLOWED else applied
        name = {applied: LIMITED} if applied and (limit is not None or applied == "input") else {}
        if name:  # the input that the actuator applies, relative to u*
            offset = np.zeros_like(self.input) if applied == "input" else self.input
            before = (Apply(step.at, {LIMITED: len(offset)}, Applied(limit, offset, self.input), (applied,)),)
        branches = tuple(
            self._terms(step, {name.get(key, key): M for key, M in terms.items()}) for terms in step.branches
        )
        if limit is None or step.signal != HELD:
            return (*before, _assigned(step.at, step.signal, branches, step.on))
        told = Apply(step.at, {HELD: len(self.input)}, Applied(limit, self.input, self.input), (WANTED,))
        return (_assigned(step.at, WANTED, branches, step.on), told)

    def _terms(self, step: Assign, terms: dict[str, Matrix]) -> dict[str, Matrix]:
        added, measured = np.zeros((step.size, 1)), terms.get("y")
        if measured is not None:
            assert not isinstance(measured, Scheduled)
            added -= measured @ self.output[:, None]
        if step.signal == "input" and "input" not in terms:
            added += self.input[:, None]
        constant = terms.get(ONE, np.zeros_like(added))
        assert not isinstance(constant, Scheduled)
        return {**terms, ONE: added + constant} if added.any() else terms


@dataclass(frozen=True, eq=False, repr=False)
class Applied(Displayed):
    """The deviation of the input that an actuator with limits applies.

    Args:
        limit: limits of each input, (m, 2), or None.
        offset: what is added to the argument to give the input, (m,).
        steady: the input u* that the deviation refers to, (m,).
    """

    limit: Array | None
    offset: Array
    steady: Array

    def __call__(self, wanted: Any) -> Any:
        """Return the deviation of the input that is applied."""
        whole = wanted + self.offset
        return (whole if self.limit is None else np.clip(whole, self.limit[:, 0], self.limit[:, 1])) - self.steady


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


def _assigned(at: str, signal: str, branches: tuple[dict[str, Matrix], ...], on: Condition | None) -> Assign:
    return Assign(at, signal, branches if on else branches[0], on)


def _read(step: Assign) -> set[str]:
    return {name for terms in step.branches for name in terms}


def _results(step: Assign | Apply) -> set[str]:
    return {step.signal} if isinstance(step, Assign) else set(step.signals)
