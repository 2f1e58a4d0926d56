"""Policy steps for the two links over which a given controller may send: to the actuator, or from the sensor.

The *choice* is what a packet carries: the input over the actuator link, the measurement over the sensor link. In
silence, the receiver uses a *candidate* instead, its last value or the prediction of a model. The node that decides
knows the receiver's candidate, because every packet arrives or because the network acknowledges those that arrive.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, block_diagonal
from taciturn._display import Displayed
from taciturn.design.base import Base
from taciturn.design.certainty import COLLOCATED, SEND
from taciturn.design.estimation import ESTIMATE, HELD
from taciturn.lqg.discrete import Discrete
from taciturn.model.controller import Controller
from taciturn.model.policy import Acknowledged, Assign, NodeName, Received, Send, Step

REGISTER, NEXT, MEASURED = "register", "next register", "measured"
CANDIDATE = "candidate"


@dataclass(frozen=True, eq=False, repr=False)
class Route(Displayed):
    """A base, and the policy steps that carry its choices.

    Args:
        base: the loop that sends every sample.
        node: the node that decides; it has the measurement.
        sites: groups of nodes at the same site.
        choice: name of the signal of the choice.
        before: policy steps that compute choice and candidate.
        after: policy steps that send, receive, and store the input and the controller's next state.
        initial: initial values of the memories.
    """

    base: Base
    node: NodeName
    sites: tuple[frozenset[NodeName], ...]
    choice: str
    before: tuple[Step, ...]
    after: tuple[Step, ...]
    initial: dict[str, Array]


def over_actuator_link(problem: Discrete, controller: Controller, model: bool, lossy: bool) -> Route:
    """Return the route of inputs; the controller is at the sensor's site.

    Args:
        problem: the discrete-time problem.
        controller: the controller.
        model: whether the actuator simulates plant and controller in silence; otherwise it holds the last input.
        lossy: whether the network acknowledges packets, and the controller uses the acknowledgements.
    """
    base, m, k = actuator_base(problem, controller), problem.plant.inputs, len(controller.A)
    unit, at = np.eye(m), "controller"
    known = ({CANDIDATE: unit}, {"command": unit})
    moved = {REGISTER: controller.A, MEASURED: controller.B, HELD: controller.E}
    copied = _copies(problem, base, k) if model else None
    command: tuple[Step, ...] = (
        Assign(at, "command", nonempty({REGISTER: controller.C, MEASURED: controller.D})),
        Assign(at, CANDIDATE, {"prediction": base.K} if copied else {HELD: unit}),
    )
    silent = {"forecast": base.K} if copied else {"input": unit}
    sent: tuple[Step, ...] = (
        Send(at, "actuator", ("command", *(copied.packet if copied else {})), SEND),
        Assign("actuator", "input", (silent, {"command": unit}), Received("actuator")),
        *(copied.receiver if copied else ()),
        Assign(at, HELD, known, Acknowledged("actuator") if lossy else SEND),
        *(copied.decider if copied else ()),
    )
    next_state = (Assign(at, NEXT, moved),) if k else ()
    start = copied.initial if copied else {}
    return Route(base, at, COLLOCATED, "command", command, (*sent, *next_state), start)


def over_sensor_link(problem: Discrete, controller: Controller, model: bool, lossy: bool) -> Route:
    """Return the route of measurements; the controller is at the actuator's site, and the sensor has a copy of it.

    Args:
        problem: the discrete-time problem.
        controller: the controller.
        model: whether the controller uses C x̃ in silence, with the state x̃ of a model that starts at the last sent
            estimate; otherwise it uses the last measurement.
        lossy: whether the network acknowledges packets, and the sensor uses the acknowledgements.
    """
    plant, c = problem.plant, controller
    p, state, at = plant.outputs, np.eye(plant.states), "sensor"
    unit = np.eye(p)
    known = ({CANDIDATE: unit}, {MEASURED: unit})
    silent = {"forecast": plant.C} if model else {"used": unit}
    packet = {MEASURED: unit, **({ESTIMATE: state} if model else {})}
    receiver: tuple[Step, ...] = (
        Assign("controller", "used", (silent, {MEASURED: unit}), Received("sensor")),
        Assign("controller", "command", nonempty({"state": c.C, "used": c.D})),
        Assign("actuator", "input", {"command": np.eye(plant.inputs)}),
        *((Assign("controller", "state", {"state": c.A, "used": c.B, "command": c.E}),) if len(c.A) else ()),
    )
    copy: tuple[Step, ...] = (
        Assign(at, "known", known, Acknowledged("sensor") if lossy else SEND),
        Assign(at, HELD, nonempty({REGISTER: c.C, "known": c.D})),
        *((Assign(at, NEXT, {REGISTER: c.A, "known": c.B, HELD: c.E}),) if len(c.A) else ()),
    )
    if model:
        followed = ({"forecast": state}, {ESTIMATE: state})
        receiver += (
            Assign("controller", "model", followed, Received("sensor")),
            Assign("controller", "forecast", {"model": plant.A, "command": plant.B}),
        )
        copy += (
            Assign(at, "copy", ({"prediction": state}, {ESTIMATE: state}), SEND),
            Assign(at, "prediction", {"copy": plant.A, HELD: plant.B}),
        )
    return Route(
        sensor_base(problem, controller),
        at,
        (frozenset({"controller", "actuator"}),),
        MEASURED,
        (Assign(at, CANDIDATE, {"prediction": plant.C} if model else {"known": unit}),),
        (Send(at, "sensor", tuple(packet), SEND), *receiver, *copy),
        {"prediction": plant.mean, "forecast": plant.mean} if model else {},
    )


def actuator_base(problem: Discrete, controller: Controller) -> Base:
    """Return the base that chooses the input in every step; z contains x, the controller's state, and y."""
    plant, c = problem.plant, controller
    (n, m), k, p = plant.B.shape, len(c.A), plant.outputs
    Phi = np.block([
        [plant.A, np.zeros((n, k + p))],
        [np.zeros((k, n)), c.A, c.B],
        [plant.C @ plant.A, np.zeros((p, k + p))],
    ])  # fmt: skip
    Gamma = np.vstack([plant.B, c.E, plant.C @ plant.B])
    used = np.hstack([np.zeros((m, n + k + p)), np.eye(m)])
    K = np.hstack([np.zeros((m, n)), c.C, c.D])
    return Base(Phi, Gamma, _stage(problem, used), K, _noise(problem, k))


def sensor_base(problem: Discrete, controller: Controller) -> Base:
    """Return the base whose controller uses the measurement in every step; the choice is the value that it uses."""
    plant, c = problem.plant, controller
    n, k, p = plant.states, len(c.A), plant.outputs
    state, choice = np.vstack([plant.B, c.E, plant.C @ plant.B]), np.vstack([np.zeros((n, p)), c.B, np.zeros((p, p))])
    rest = block_diagonal(plant.A, c.A, np.zeros((p, p)))
    rest[n + k :, :n] = plant.C @ plant.A
    used = np.hstack([np.zeros((plant.inputs, n)), c.C, np.zeros((plant.inputs, p)), c.D])
    Phi, Gamma = rest + state @ used[:, :-p], choice + state @ c.D
    K = np.hstack([np.zeros((p, n + k)), np.eye(p)])
    return Base(Phi, Gamma, _stage(problem, used), K, _noise(problem, k))


def nonempty(terms: dict[str, Array]) -> dict[str, Array]:
    """Return the terms without those of signals that have no entries."""
    return {name: matrix for name, matrix in terms.items() if matrix.size}


def _stage(problem: Discrete, used: Array) -> Array:
    """Return the weight of the stage cost on (z, c), for the input ``used`` (z, c)."""
    n = problem.plant.states
    at = np.vstack([np.eye(n, used.shape[1]), used])
    return at.T @ np.block([[problem.Q, problem.N], [problem.N.T, problem.R]]) @ at


def _noise(problem: Discrete, registers: int) -> Array:
    plant = problem.plant
    n = plant.states
    process = np.vstack([np.eye(n), np.zeros((registers, n)), plant.C])
    return process @ plant.W @ process.T + block_diagonal(np.zeros((n + registers,) * 2), plant.V)


@dataclass(frozen=True, eq=False, repr=False)
class _Copies(Displayed):
    """The steps of an actuator that simulates plant and controller between packets of (u, x̂, register, y)."""

    packet: dict[str, Array]
    receiver: tuple[Step, ...]
    decider: tuple[Step, ...]
    initial: dict[str, Array]


def _copies(problem: Discrete, base: Base, k: int) -> _Copies:
    plant = problem.plant
    n, p = plant.states, plant.outputs
    unit = np.eye(n + k + p)
    packet = nonempty({ESTIMATE: unit[:, :n], REGISTER: unit[:, n : n + k], MEASURED: unit[:, n + k :]})
    start = np.concatenate([plant.mean, np.zeros(k), plant.C @ plant.mean])
    return _Copies(
        packet,
        (
            Assign("actuator", "model", ({"forecast": unit}, packet), Received("actuator")),
            Assign("actuator", "forecast", {"model": base.Phi, "input": base.Gamma}),
        ),
        (
            Assign("controller", "copy", ({"prediction": unit}, packet), SEND),
            Assign("controller", "prediction", {"copy": base.Phi, HELD: base.Gamma}),
        ),
        {"prediction": start, "forecast": start},
    )
