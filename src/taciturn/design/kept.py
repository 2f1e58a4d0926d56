"""Controllers that a user has, together with the plant: the slow disturbance, LQG as a controller, usual weights."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import radius
from taciturn.design._fixed_point import least_value
from taciturn.design.base import Base
from taciturn.design.certainty import design_certainty
from taciturn.design.prices import price_control
from taciturn.design.routes import actuator_base
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.lqg.kalman import Filter
from taciturn.lqg.periodic import Held
from taciturn.model.controller import ContinuousController, Controller
from taciturn.model.cost import Cost
from taciturn.model.coverage import SIMULATED
from taciturn.model.disturbance import Disturbance, padded
from taciturn.model.kept import Kept
from taciturn.model.plant import ContinuousPlant, Plant

LASTING = 1e-9  # a mode whose modulus is 1 up to this does not decay
REMEDY = (
    "check the sign of the controller (feedback is u = −K y), its gains, its step, and that no two integrals have the "
    "same output"
)
CONSTANT = (
    "the controller integrates, and the plant has no slow disturbance: a constant disturbance would make silence cost "
    "more than computed"
)


def cost_as_kept(plant: Plant | ContinuousPlant, kept: Kept, period: float | None = None) -> Cost:
    """Return the cost for which the present variances of all outputs and inputs count equally, with every sample.

    Args:
        plant: the plant, without the slow disturbance that the controller compensates.
        kept: the controller.
        period: seconds between steps; only with a continuous plant.

    Raises:
        UnstableError: the loop is unstable, or a variance is infinite.
        ProblemError: an output or an input does not move.
    """
    usual = Cost(np.eye(plant.states), np.eye(plant.inputs))
    problem, controller, _ = disturbed(plant, usual, period, kept)
    base = actuator_base(problem, controller)
    F, n = base.Phi + base.Gamma @ base.K, plant.states
    seen = np.pad(plant.C, ((0, 0), (0, len(F) - n))) + (0.0 if plant.D is None else plant.D @ base.K)
    rows = {"output_variance": seen, "input_variance": base.K}
    found: dict[str, list[float]] = {}
    for name, signals in rows.items():
        found[name] = []
        for number, row in enumerate(signals, 1):
            P, slowest = least_value(F, row[:, None] * row)
            variance = float(np.sum(P * base.noise))
            if slowest >= 1:
                raise UnstableError(
                    f"the loop that sends every sample is not stable; expected a stable loop: "
                    f"{remedy_of(problem, controller)}"
                )
            if variance <= 0:
                raise ProblemError(
                    f"{name.partition('_')[0]} {number} has no variance in the loop with every sample; expected noise "
                    "that moves it, or output_variance and input_variance in place of weights"
                )
            found[name].append(variance)
    return Cost.of_variances(plant.C, **found, D=plant.D)


def disturbed(
    plant: Plant | ContinuousPlant, cost: Cost, period: float | None, kept: Kept
) -> tuple[Discrete, Controller, Disturbance | None]:
    """Return the discrete-time problem with the slow disturbance, the controller at its step, and the disturbance."""
    problem = discretise(plant, cost, period)
    controller = kept.at(problem.plant.dt, problem.plant.inputs, problem.plant.outputs)
    SIMULATED.check(controller)
    disturbance = controller.expected
    if disturbance is not None:
        disturbance = disturbance.completed(plant, period)
        problem = discretise(disturbance.added_to(plant, cost.mission), padded(cost, problem.plant.inputs), period)
    return problem, controller, disturbance


def lqg_observer(
    kind: str, problem: Discrete, every: int = 1, L: Array | None = None, zero: bool = False
) -> Controller:
    """Return LQG control as a controller, whose observer uses the input that was applied.

    Its gain is L, or by default optimal for a packet at every q-th step, and an input that is held or ``zero`` between.

    Raises:
        ProblemError: the cost has a horizon, so that the gains change.
        UnstableError: no stabilising gain or filter exists.
    """
    if problem.cost.horizon is not None:
        raise ProblemError(
            f"cost.horizon is {problem.cost.horizon}, so the gains of LQG change with time; {kind} supports this only "
            "over an actuator link that drops no packets (no loss, no burst), with actuation 'hold' or 'model', "
            "every = 1, and gains and retry omitted; expected this, an average or discounted cost, or a controller"
        )
    plant = problem.plant
    if L is not None:
        return observer_controller(plant, problem.filter(), L)
    if not problem.cost.mission:
        certainty = design_certainty(kind, problem)
        steady, gain, moved, shrunk = certainty.filter, certainty.regulator.L, certainty.corrections, 1.0
    else:
        steady, gain = problem.filter(), price_control(problem).L
        moved, shrunk = plant.W, np.sqrt(problem.cost.discount)
    if every > 1:  # with a discount, in states and inputs that are smaller by its root in each step
        factor = 0.0 if zero else shrunk
        between = Held(shrunk * plant.A, shrunk * plant.B, problem.Q, problem.R, problem.N, moved, factor)
        gain = between.solve((every,)).gains[0]
    return observer_controller(plant, steady, gain)


def observer_controller(plant: Plant, steady: Filter, L: Array) -> Controller:
    """Return feedback of the filtered estimate as a controller, whose filter uses the input that was applied."""
    n, m = plant.B.shape
    none = Disturbance(deviation=0.0)
    if plant.full_state:
        return Controller(np.zeros((0, 0)), np.zeros((0, n)), np.zeros((m, 0)), L, None, plant.dt, none)
    left = np.eye(n) - steady.gain @ plant.C
    return Controller(plant.A @ left, plant.A @ steady.gain, L @ left, L @ steady.gain, plant.B, plant.dt, none)


def remedy_of(problem: Discrete, controller: Controller) -> str:
    """Return the remedy if a loop of a given controller is unstable: the other sign, if this loop is stable."""
    c = controller
    base = actuator_base(problem, Controller(c.A, c.B, -c.C, -c.D, c.E, c.dt))
    if radius(base.Phi + base.Gamma @ base.K) >= 1:
        return REMEDY
    return (
        "with the other sign of the controller the loop is stable, so change the key controller.sign, the sign of each "
        "gain, or those of C and D (negative feedback is u = −K y)"
    )


def recovery(base: Base, plant: Plant, disturbance: Disturbance | None, slowest: float = 0.0) -> float | None:
    """Return the time constant in steps of a base without the slow disturbance of its plant, or None without one.

    ``slowest`` is the modulus of the slowest mode of the filter. A mode that does not decay does not count: the value
    of the base exists, so neither its cost nor its controller sees this mode, such as an integral that only counts.
    """
    if disturbance is None:
        return None
    modes, (n, m) = np.abs(np.linalg.eigvals(base.Phi + base.Gamma @ base.K)), (plant.stated, plant.inputs)
    # nothing moves the disturbances, so the loop has their decay per step as modes, up to rounding
    slow = np.argsort(np.abs(modes - abs(plant.A[n - m, n - m])))[:m]
    rest = np.delete(modes, slow)
    return float(1 / (1 - max(slowest, *rest[rest < 1 - LASTING])))


def note_disturbance(controller: Controller, disturbance: Disturbance | None) -> tuple[str, ...]:
    """Return a note on the slow disturbance of the plant."""
    if disturbance is None:
        return (CONSTANT,) if controller.integrates else ()
    stated = controller.disturbance or Disturbance()
    missing = [name for name in ("time_constant", "deviation") if getattr(stated, name) is None]
    source = f" ({' and '.join(missing)} by default, from the step, W and B)" if missing else ""
    return (f"the plant has a slowly varying disturbance at each input: {disturbance.text()}{source}",)


def note_ringing(kept: Kept, step: float) -> tuple[str, ...]:
    """Return a note on a mode of a continuous controller that the trapezoidal rule makes alternate."""
    found = kept.ringing(step) if isinstance(kept, ContinuousController) else None
    if found is None:
        return ()
    return (
        f"the controller has a mode with the time constant {found[0]:.3g} s, such as a filter of its derivative, which "
        f"is faster than half a step of {step:g} s: the trapezoidal rule makes it an eigenvalue of {found[1]:.3g}, so "
        "its part of the command alternates from step to step; expected a slower filter, a shorter step, or method "
        '"zoh"',
    )
