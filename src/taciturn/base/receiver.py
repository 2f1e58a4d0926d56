"""Policy steps for the two links over which a given controller may send: to the actuator, or from the sensor.

The *choice* is what a packet carries: the input over the actuator link, the measurement over the sensor link. In
silence, the receiver uses a *candidate* instead, its last value or the prediction of a model. The node that decides
knows the receiver's candidate, because every packet arrives or because the network acknowledges those that arrive.
A sensor that decides on the controller's state computes it too. Its packets carry this state, which the controller
adopts, since an integral would keep a difference for ever: after a dropped packet, a restart, or rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from taciturn._arrays import Array, block_diagonal, choice
from taciturn._display import Displayed
from taciturn.base.filter import COLLOCATED, ESTIMATE, HELD, SEND
from taciturn.base.value import Base
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import Filter
from taciturn.model.controller import Controller
from taciturn.model.steps import Acknowledged, Assign, Condition, Received, Send, Step

REGISTER, NEXT, MEASURED = "register", "next register", "measured"
CANDIDATE = "candidate"
Actuation: TypeAlias = Literal["hold", "model", "zero"]


@dataclass(frozen=True, eq=False, repr=False)
class Route(Displayed):
    """A base, and the policy steps that carry its choices."""

    base: Base  # the loop that sends every sample
    node: str  # the node that decides; it has the measurement
    sites: tuple[frozenset[str], ...]  # groups of nodes at the same site
    error: dict[str, Array]  # terms of the receiver's value in silence, minus the choice
    before: tuple[Step, ...]  # policy steps that compute choice and candidate
    after: tuple[Step, ...]  # policy steps that send, receive, and store the input and the controller's next state
    initial: dict[str, Array]  # initial values of the memories
    start: Array  # state of the controller in the base at the start, (k,)
    begun: Array  # the value that the receiver of the base uses before the first packet, (c,)
    registers: int  # number of states of the controller that the node follows

    @property
    def state(self) -> tuple[str, ...]:
        """The signals of z: the state of the plant, that of the controller, and the measurement."""
        return (ESTIMATE, *((REGISTER,) if self.registers else ()), MEASURED)

    def steps(self, measured: dict[str, Array], decide: tuple[Step, ...], after: tuple[Step, ...]) -> tuple[Step, ...]:
        """Return the policy steps with those that decide on ``error``, and those that follow the packet."""
        unit = np.eye(self.registers)
        return (
            Assign(self.node, MEASURED, measured),
            *((Assign(self.node, REGISTER, {NEXT: unit}),) if self.registers else ()),
            *self.before,
            Assign(self.node, "error", self.error),
            *decide,
            *self.after,
            *after,
        )


def route_over(
    link: str,
    problem: Discrete,
    controller: Controller,
    actuation: Actuation,
    lossy: bool,
    copied: Filter | None = None,
    start: Array | None = None,
    follows: bool = True,
) -> Route:
    """Return the route of a given controller's packets."""
    start = np.zeros(len(controller.A)) if start is None else start
    choice("actuation", actuation, ("hold", "model", "zero"))
    if choice("link", link, ("actuator", "sensor")) == "actuator":
        return _over_actuator_link(problem, controller, actuation, lossy, copied, start)
    if actuation == "zero":
        raise ProblemError("actuation is 'zero', and the link is that of the sensor; expected 'hold' or 'model'")
    return _over_sensor_link(problem, controller, actuation == "model", lossy, copied, start, follows)


def _over_actuator_link(
    problem: Discrete, controller: Controller, actuation: Actuation, lossy: bool, copied: Filter | None, start: Array
) -> Route:
    """Return the route of inputs; an actuator that predicts simulates plant and controller in silence."""
    base, m, k = actuator_base(problem, controller), problem.plant.inputs, len(controller.A)
    unit, at = np.eye(m), "controller"
    known = ({CANDIDATE: unit}, {"command": unit})
    on = Acknowledged("actuator") if lossy else SEND
    copies = _copies(problem, base, start, on) if actuation == "model" else None
    own = np.zeros((m, m)) if actuation == "zero" else unit  # in silence, from the last input
    command: tuple[Step, ...] = (
        Assign(at, "command", nonempty({REGISTER: controller.C, MEASURED: controller.D})),
        Assign(at, CANDIDATE, {"prediction": base.K} if copies else {HELD: own}),
    )
    silent = {"forecast": base.K} if copies else {"input": own}
    sent: tuple[Step, ...] = (
        Send(at, "actuator", ("command", *(copies.packet if copies else {})), SEND),
        Assign("actuator", "input", (silent, {"command": unit}), Received("actuator")),
        *(copies.receiver if copies else ()),
        Assign(at, HELD, known, on),
        *(copies.decider if copies else ()),
    )
    moved = {REGISTER: controller.A, MEASURED: controller.B, HELD: controller.E}
    error = {CANDIDATE: unit, "command": -unit}
    if actuation == "zero":
        base = replace(base, candidate=np.zeros((m, m + len(base.Phi))))
    if copies and copied is not None:
        error = {"prediction": np.eye(len(base.Phi)), **{name: -matrix for name, matrix in copies.packet.items()}}
        base = predicting_actuator(problem, base, copied)
    return Route(
        base,
        at,
        COLLOCATED,
        error,
        command,
        (*sent, *((Assign(at, NEXT, moved),) if k else ())),
        {**({NEXT: start} if k else {}), **(copies.initial if copies else {})},
        start,
        copies.initial["prediction"] if copies and copied is not None else np.zeros(m),
        k,
    )


def _over_sensor_link(
    problem: Discrete,
    controller: Controller,
    model: bool,
    lossy: bool,
    copied: Filter | None,
    start: Array,
    follows: bool,
) -> Route:
    """Return the route of measurements; the sensor has a copy of the controller, if it ``follows`` it.

    In silence, a controller that predicts uses C x̃, with the state x̃ of a model that starts at the last sent estimate.
    """
    plant, c = problem.plant, controller
    p, state, at = plant.outputs, np.eye(plant.states), "sensor"
    unit, own, k = np.eye(p), np.eye(len(c.A)), len(c.A) if follows else 0
    on = Acknowledged("sensor") if lossy else SEND
    known = ({CANDIDATE: unit}, {MEASURED: unit})
    silent = {"forecast": plant.C} if model else {"used": unit}
    packet = {MEASURED: unit, **({ESTIMATE: state} if model else {}), **({REGISTER: own} if k else {})}
    adopted = Assign("controller", "state", ({"state": own}, {REGISTER: own}), Received("sensor")) if k else None
    receiver: tuple[Step, ...] = (
        Assign("controller", "used", (silent, {MEASURED: unit}), Received("sensor")),
        *((adopted,) if adopted else ()),
        Assign("controller", "command", nonempty({"state": c.C, "used": c.D})),
        Assign("actuator", "input", {"command": np.eye(plant.inputs)}),
        *((Assign("controller", "state", {"state": c.A, "used": c.B, "command": c.E}),) if len(c.A) else ()),
    )
    copy: tuple[Step, ...] = (
        Assign(at, "known", known, on),
        *((Assign(at, HELD, nonempty({REGISTER: c.C, "known": c.D})),) if follows else ()),
        *((Assign(at, NEXT, {REGISTER: c.A, "known": c.B, HELD: c.E}),) if k else ()),
    )
    base, error = sensor_base(problem, controller), {CANDIDATE: unit, MEASURED: -unit}
    begun = plant.C @ plant.mean
    first = {"prediction": plant.mean, "forecast": plant.mean} if model else {"known": begun, "used": begun}
    if model:
        followed = ({"forecast": state}, {ESTIMATE: state})
        receiver += (
            Assign("controller", "model", followed, Received("sensor")),
            Assign("controller", "forecast", {"model": plant.A, "command": plant.B}),
        )
        copy += (
            Assign(at, "copy", ({"prediction": state}, {ESTIMATE: state}), on),
            Assign(at, "prediction", {"copy": plant.A, HELD: plant.B}),
        )
        if copied is not None:
            above, below = np.eye(p + plant.states, p), np.eye(p + plant.states)[:, p:]
            error = {CANDIDATE: above, MEASURED: -above, "prediction": below, ESTIMATE: -below}
            base, begun = predicting_controller(problem, controller, copied), np.concatenate([begun, plant.mean])
    return Route(
        base,
        at,
        (frozenset({"controller", "actuator"}),),
        error,
        (Assign(at, CANDIDATE, {"prediction": plant.C} if model else {"known": unit}),),
        (Send(at, "sensor", tuple(packet), SEND), *receiver, *copy),
        dict.fromkeys((*((NEXT,) if k else ()), *(("state",) if len(start) else ())), start) | first,
        start,
        begun,
        k,
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


def predicting_actuator(problem: Discrete, base: Base, steady: Filter) -> Base:
    """Return the base whose packets carry the estimate ẑ, from which the actuator simulates plant and controller."""
    n, size = problem.plant.states, base.K.shape[1]
    used = block_diagonal(np.eye(size), base.K)
    moved = np.hstack([np.zeros((size, size)), base.Phi + base.Gamma @ base.K])
    noise, unseen = _corrections(problem, steady, size - n - problem.plant.outputs)
    return Base(base.Phi, base.Gamma @ base.K, used.T @ base.stage @ used, np.eye(size), noise, moved, unseen)


def predicting_controller(problem: Discrete, controller: Controller, steady: Filter) -> Base:
    """Return the base whose packets carry measurement and estimate, from which the controller predicts both."""
    plant, base, k = problem.plant, sensor_base(problem, controller), len(controller.A)
    (n, m), p = plant.B.shape, plant.outputs
    size = n + k + p
    state = np.hstack([np.zeros((n, size + p)), plant.A])  # from (z, (value that the controller uses, x̃))
    state += plant.B @ np.hstack([np.zeros((m, n)), controller.C, np.zeros((m, p)), controller.D, np.zeros((m, n))])
    K = np.vstack([base.K, np.eye(n, size)])
    noise, unseen = _corrections(problem, steady, k)
    return Base(
        base.Phi,
        np.hstack([base.Gamma, np.zeros((size, n))]),
        block_diagonal(base.stage, np.zeros((n, n))),
        K,
        noise,
        np.vstack([plant.C @ state, state]),
        unseen,
    )


def _corrections(problem: Discrete, steady: Filter, registers: int) -> tuple[Array, float]:
    """Return the noise of ẑ, which consists of the filter's innovations, and the cost of the error of ẑ."""
    moved = np.vstack([steady.gain, np.zeros((registers, problem.plant.outputs)), np.eye(problem.plant.outputs)])
    return moved @ steady.innovation @ moved.T, float(np.sum(problem.Q * steady.posterior))


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


def _copies(problem: Discrete, base: Base, start: Array, on: Condition) -> _Copies:
    plant, k = problem.plant, len(start)
    n, p = plant.states, plant.outputs
    unit = np.eye(n + k + p)
    packet = nonempty({ESTIMATE: unit[:, :n], REGISTER: unit[:, n : n + k], MEASURED: unit[:, n + k :]})
    begun = np.concatenate([plant.mean, start, plant.C @ plant.mean])
    return _Copies(
        packet,
        (
            Assign("actuator", "model", ({"forecast": unit}, packet), Received("actuator")),
            Assign("actuator", "forecast", {"model": base.Phi, "input": base.Gamma}),
        ),
        (
            Assign("controller", "copy", ({"prediction": unit}, packet), on),
            Assign("controller", "prediction", {"copy": base.Phi, HELD: base.Gamma}),
        ),
        {"prediction": begun, "forecast": begun},
    )
