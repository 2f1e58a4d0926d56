"""Event-triggered control with a given linear controller, which sends when silence would cost too much.

In each step, the sensor measures. The controller, at the sensor's site, filters the measurement, computes ``command``
from its state ``register`` and the ``measured`` output, and decides on the difference ``error`` between the input that
silence would apply and the command.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from taciturn._arrays import Array, block_diagonal, choice
from taciturn.design.base import Advantage, Base, advantage
from taciturn.design.certainty import (
    COLLOCATED,
    SEND,
    Actuation,
    ActuationSteps,
    design_certainty,
    expect_average,
    hold_steps,
)
from taciturn.design.estimation import ESTIMATE, HELD, estimate_state
from taciturn.errors import ProblemError, TaciturnError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import filter_checked
from taciturn.model.controller import PID, Controller
from taciturn.model.coverage import GAUSSIAN_THEORY, SIMULATED, THEORY
from taciturn.model.policy import Assign, Decide, Policy, Received, Send, Step
from taciturn.model.theory import Guarantee, Identity, Theory
from taciturn.model.trigger import Form, Trigger

REGISTER, NEXT, MEASURED = "register", "next register", "measured"
CONSTANT = (
    "the controller integrates, and the noise of the plant has mean zero: a constant disturbance that the plant lacks "
    "would make silence cost more than computed"
)
REMEDY = "check the sign of the controller (feedback is u = −K y), its gains and its step"


def base_of(problem: Discrete, controller: Controller) -> Base:
    """Return the loop of a plant and a controller that sends every sample; z contains x, the register, and y."""
    plant, c = problem.plant, controller
    (n, m), k, p = plant.B.shape, len(c.A), plant.outputs
    Phi = np.block([
        [plant.A, np.zeros((n, k + p))],
        [np.zeros((k, n)), c.A, c.B],
        [plant.C @ plant.A, np.zeros((p, k + p))],
    ])  # fmt: skip
    Gamma = np.vstack([plant.B, c.E, plant.C @ plant.B])
    stage = block_diagonal(problem.Q, np.zeros((k + p, k + p)), problem.R)
    stage[:n, -m:], stage[-m:, :n] = problem.N, problem.N.T
    process = np.vstack([np.eye(n), np.zeros((k, n)), plant.C])
    noise = process @ plant.W @ process.T + block_diagonal(np.zeros((n + k, n + k)), plant.V)
    return Base(Phi, Gamma, stage, np.hstack([np.zeros((m, n)), c.C, c.D]), noise)


def keep_controller(
    kind: str, problem: Discrete, kept: Controller | PID, price_at: Callable[[float], float], actuation: Actuation
) -> Policy:
    """Return the policy that sends iff E[e'He + 2 e'(slope) z] > δ, given the measurements, for a given controller.

    Args:
        kind: name of the policy kind.
        problem: the discrete-time problem.
        kept: the controller.
        price_at: function that returns δ per step, given the cost of sending every sample per step.
        actuation: ``"hold"`` keeps the last input; with ``"model"`` the actuator simulates plant and controller.

    Raises:
        ProblemError: the controller does not suit the plant, or the cost is not an average.
        UnstableError: the loop that sends every sample is unstable.
    """
    expect_average(kind, problem.cost)
    plant = problem.plant
    controller = kept.at(plant.dt)
    for name, got, expected in zip(
        ("inputs", "measurements"), controller.D.shape, (plant.inputs, plant.outputs), strict=True
    ):
        if got != expected:
            raise ProblemError(f"the controller has {got} {name}; expected {expected}, as for the plant")
    SIMULATED.check(controller)
    base = base_of(problem, controller)
    found, steady = advantage(base, REMEDY), filter_checked(plant.A, plant.C, plant.W, plant.V)
    estimation = estimate_state(plant, steady)
    price = price_at(found.cost)
    silent = _silence(base, found, len(controller.A))
    choice("actuation", actuation, ("hold", "model"))
    part = hold_steps(plant, None, SEND) if actuation == "hold" else _model(base, problem, controller)
    output = {"prior": plant.C, "innovation": np.eye(plant.outputs)}
    if estimation.innovations is None:
        output = {ESTIMATE: plant.C}
    steps: tuple[Step, ...] = (
        *estimation.correct,
        Assign("controller", MEASURED, output),
        *_registered(controller),
        Assign("controller", "command", _nonempty({REGISTER: controller.C, MEASURED: controller.D})),
        part.candidate,
        Assign("controller", "error", {"candidate": np.eye(plant.inputs), "command": -np.eye(plant.inputs)}),
        Decide("controller", SEND, Trigger({"silent": silent, SEND: Form(constant=price)})),
        *part.send,
        *estimation.predict,
        *_moved(controller),
    )
    scaled = None if silent.Psi is None else np.asarray(silent.Psi) / problem.tick
    theory = Theory(
        cost=problem.cost,
        cost_all_time=problem.per_unit(found.cost),
        noise_cost=problem.noise_cost,
        settling=max(found.settling, 1 / (1 - steady.slowest)),
        guarantee=Guarantee(
            problem.per_unit(found.cost + price),
            "J ≤ J_all + δ(1 − rate), J_all the cost of this controller with every sample, δ the most that silence "
            "adds on average",
            "antunes2014rollout",
            problem.per_unit(found.cost),
            price / problem.tick,
        ),
        identity=Identity(problem.per_unit(found.cost), (Form(silent.signals, scaled), Form()), SEND),
        innovations=estimation.innovations,
        covers=THEORY if plant.full_state else GAUSSIAN_THEORY,
    )
    return Policy(
        kind=kind,
        steps=steps,
        model=plant,
        theory=theory,
        sites=COLLOCATED,
        initial={**estimation.initial, **part.initial},
        tick=problem.tick,
        notes=(*_beside(kind, problem, found.cost), *((CONSTANT,) if controller.integrates else ())),
    )


def _silence(base: Base, found: Advantage, registers: int) -> Form:
    """Return the form e'He + 2 e'(slope) z of the cost of silence."""
    n = found.slope.shape[1]
    square = np.block([[found.H, found.slope], [found.slope.T, np.zeros((n, n))]])
    return Form(("error", ESTIMATE, *((REGISTER,) if registers else ()), MEASURED), square)


def _nonempty(terms: dict[str, Array]) -> dict[str, Array]:
    return {name: matrix for name, matrix in terms.items() if matrix.size}


def _registered(controller: Controller) -> tuple[Step, ...]:
    """Return the step that keeps the controller's state of this time step, which the cost of silence needs later."""
    k = len(controller.A)
    return (Assign("controller", REGISTER, {NEXT: np.eye(k)}),) if k else ()


def _moved(controller: Controller) -> tuple[Step, ...]:
    moved = {REGISTER: controller.A, MEASURED: controller.B, HELD: controller.E}
    return (Assign("controller", NEXT, moved),) if len(controller.A) else ()


def _model(base: Base, problem: Discrete, controller: Controller) -> ActuationSteps:
    """Return the steps of an actuator that simulates plant and controller between packets of (u, x̂, register, y)."""
    plant, k = problem.plant, len(controller.A)
    n, p, m = plant.states, plant.outputs, plant.inputs
    size, unit = n + k + p, np.eye(n + k + p)
    sent = _nonempty({ESTIMATE: unit[:, :n], REGISTER: unit[:, n : n + k], MEASURED: unit[:, n + k :]})
    start = np.concatenate([plant.mean, np.zeros(k), plant.C @ plant.mean])
    moved, known = {"model": base.Phi, "input": base.Gamma}, ({"candidate": np.eye(m)}, {"command": np.eye(m)})
    return ActuationSteps(
        Assign("controller", "candidate", {"prediction": base.K}),
        (
            Send("controller", "actuator", ("command", *sent), SEND),
            Assign("actuator", "input", ({"forecast": base.K}, {"command": np.eye(m)}), Received("actuator")),
            Assign("actuator", "model", ({"forecast": np.eye(size)}, sent), Received("actuator")),
            Assign("actuator", "forecast", moved),
            Assign("controller", HELD, known, SEND),
            Assign("controller", "copy", ({"prediction": np.eye(size)}, sent), SEND),
            Assign("controller", "prediction", {"copy": base.Phi, HELD: base.Gamma}),
        ),
        {"prediction": start, "forecast": start},
    )


def _beside(kind: str, problem: Discrete, cost: float) -> tuple[str, ...]:
    """Return a note with the cost of LQG for the same weights."""
    try:
        best = design_certainty(kind, problem).cost_all_time
    except TaciturnError:  # LQG needs more of the weights than a given controller
        return ()
    return (f"LQG with these weights and every sample costs {best / cost:.3f} times as much as this controller",)
