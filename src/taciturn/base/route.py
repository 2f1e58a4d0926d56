"""Routes: the policy steps of the link over which a base loop sends, and the base loop of a given controller.

A route goes from the controller to the actuator, or from the sensor to the controller.

The *choice* is what a packet carries: the input over the actuator link, the measurement over the sensor link. In
silence, the receiver uses a *candidate* instead, its last value or the prediction of a model. The node that decides
knows the receiver's candidate, because every packet arrives or because the network acknowledges those that arrive.
A sensor that decides on the controller's state computes it too. Its packets carry this state, which the controller
adopts, since an integral would keep a difference for ever: after a dropped packet, a restart, or rounding.

An actuator that predicts makes up for random delays: with a packet that was sent j steps ago and carries x̂, its model
continues from (A + BL)ʲ x̂, as if the packet had come at once. With a plan, a packet carries the inputs L (A + BL)ⁱ x̂ of
the next steps, of which an actuator that has no model applies the one of the packet's age.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from taciturn._arrays import Array, block_diagonal, choice
from taciturn._display import Displayed
from taciturn.base.filter import COLLOCATED, DEVIATION, ESTIMATE, HELD, SEND, outputs_of
from taciturn.base.value import Base
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import Filter
from taciturn.model.controller import Controller
from taciturn.model.plant import Plant
from taciturn.model.steps import Acknowledged, Assign, Condition, Received, Send, Step
from taciturn.model.trigger import Matrix, Scheduled

REGISTER, NEXT, MEASURED = "register", "next register", "measured"
CANDIDATE = "candidate"
COMMANDS, USES = "past commands", "past values"  # of a controller that hears packets late, the newest ones first
PLAN, PLANNED, AHEAD = "plan", "planned", "ahead"  # inputs of the next steps: in a packet, copied, at the actuator
Actuation: TypeAlias = Literal["hold", "model", "zero"]
PREDICTED = "delays are random and actuation is 'model'"


class Ahead(NamedTuple):
    """How far an actuator looks ahead of what it has received."""

    oldest: int = 0  # largest age in steps of a packet, if packets are delayed at random
    plan: int = 0  # number of inputs of later steps in a packet; after them the actuator holds the last one


BY_PACKETS = Ahead()


@dataclass(frozen=True, eq=False, repr=False)
class Route(Displayed):
    """The policy steps of one link: the value to send, the packet, and the value that the receiver uses."""

    node: str  # the node that decides
    choice: tuple[Step, ...]  # policy steps that compute choice and candidate
    error: Mapping[str, Array]  # terms of the receiver's value in silence, minus the choice
    sent: tuple[Step, ...]  # policy steps that send, receive, and store the input and the next state
    initial: dict[str, Array]  # initial values of the memories
    deviation: tuple[Step, ...] = ()  # policy steps that compute the state of the receiver minus the estimate
    noted: tuple[Step, ...] = ()  # policy steps that this deviation needs after the packet

    def steps(
        self, decide: tuple[Step, ...], after: tuple[Step, ...] = (), *, deviates: bool = False
    ) -> tuple[Step, ...]:
        """Return all policy steps of the link: before, for and after the decision whether to send, which depends on
        ``error``.
        """
        return (
            *self.choice,
            Assign(self.node, "error", self.error),
            *(self.deviation if deviates else ()),
            *decide,
            *self.sent,
            *(self.noted if deviates else ()),
            *after,
        )


@dataclass(frozen=True, eq=False, repr=False)
class GivenRoute(Route):
    """The policy steps of one link of a given controller, and the base loop that sends every sample over this link."""

    base: Base = field(kw_only=True)  # the loop that sends every sample
    sites: tuple[frozenset[str], ...] = field(kw_only=True)  # groups of nodes at the same site
    start: Array = field(kw_only=True)  # state of the controller in the base at the start, (k,)
    begun: Array = field(kw_only=True)  # the value that the receiver of the base uses before the first packet, (c,)
    registers: int = field(kw_only=True)  # number of states of the controller that the node follows

    @property
    def state(self) -> tuple[str, ...]:
        """Names of the signals that form the base loop's state z: plant state, controller state and measurement."""
        return (ESTIMATE, *((REGISTER,) if self.registers else ()), MEASURED)


def estimate_to_actuator(plant: Plant, L: Matrix, actuation: str, on: str | None, ahead: Ahead = BY_PACKETS) -> Route:
    """Return the policy steps of a link that carries the input L x̂. The actuator holds the input, or predicts it.

    ``on`` is the decision to send; None: every sample is sent.
    """
    if ahead.plan or (ahead.oldest and actuation == "model"):
        _expect_linear(plant, isinstance(L, Scheduled), "packets carry a plan" if ahead.plan else PREDICTED)
    command = Assign("controller", "command", {ESTIMATE: L})
    unit = np.eye(plant.inputs)
    error = {CANDIDATE: unit, "command": -unit}
    if choice("actuation", actuation, ("hold", "model")) == "hold":
        memory = {ESTIMATE: np.eye(plant.states)}
        noted = (Assign("controller", "sent", ({"sent": memory[ESTIMATE]}, memory), on),) if on else ()
        if ahead.plan and not isinstance(L, Scheduled):
            plans = _Plans(plant, L, ahead.plan, ahead.oldest)
            initial: dict[str, Array] = {AHEAD: plans.begun, PLANNED: plans.begun}
            choices, deviation = (command, *plans.choice), _deviation(plant, "sent")
            return Route("controller", choices, error, plans.sent(on), initial, deviation, noted)
        candidate, sent = _held_input(plant.inputs, unit, on, on)
        return Route("controller", (command, candidate), error, sent, {}, _deviation(plant, "sent"), noted)
    closed = Scheduled(L.by, plant.A + plant.B @ L.values) if isinstance(L, Scheduled) else plant.A + plant.B @ L
    moved, followed = {"model": closed}, {"copy": closed}
    if plant.saturation is not None:  # the input that is applied differs from the command
        moved, followed = {"model": plant.A, "input": plant.B}, {"copy": plant.A, HELD: plant.B}
    packet = _Packet({ESTIMATE: np.eye(plant.states)}, L, {ESTIMATE: L}, closed, ahead.oldest)
    copies = _Copies.of(packet, (moved, followed), on, plant.mean)
    candidate, stored = Assign("controller", CANDIDATE, {"prediction": L}), _stored(plant.inputs, on)
    copied, predicted = copies.decider
    sent = (Send("controller", "actuator", (ESTIMATE,), on), *copies.receiver, copied, stored, predicted)
    return Route("controller", (command, candidate), error, sent, copies.initial, _deviation(plant, "prediction"))


def _expect_linear(plant: Plant, scheduled: bool, why: str) -> None:
    """Raise an error if the inputs of the next steps are no fixed multiples of the state."""
    got = "the cost has a horizon" if scheduled else ""
    got = "the inputs are limited (input_limit or input_rate)" if plant.saturation is not None else got
    if got:
        raise ProblemError(
            f"{why}, and {got}, so the inputs of the next steps are not known in advance; expected a cost without "
            "a horizon, no limits, actuation = 'hold' without a plan, or a buffer"
        )


def heard_on(link: str, oldest: int) -> Received:
    """Return the condition that a packet arrives, by its age if packets are up to ``oldest`` > 0 steps old."""
    return Received(link, oldest or None)


@dataclass(frozen=True, eq=False, repr=False)
class _Plans(Displayed):
    """The steps of packets with the inputs of this and the next steps, i = 0, …, N: L (A + BL)ⁱ x̂."""

    plant: Plant
    L: Array
    length: int  # N
    oldest: int  # largest age in steps of a packet

    @property
    def _rows(self) -> list[Array]:
        closed = self.plant.A + self.plant.B @ self.L
        return [self.L @ np.linalg.matrix_power(closed, i) for i in range(self.length + 1)]

    @property
    def begun(self) -> Array:
        """The inputs before the first packet, those of the mean of the initial state, (N m,)."""
        return np.concatenate([row @ self.plant.mean for row in self._rows[:-1]])

    @property
    def _shift(self) -> Array:
        """The matrix by which each input of a plan takes the place of the one before it; the last one stays."""
        m, last = self.plant.inputs, (self.length - 1) * self.plant.inputs
        return np.eye(self.length * m)[[*range(m, self.length * m), *range(last, self.length * m)]]

    @property
    def _first(self) -> Array:
        """The matrix that selects the first input of a plan."""
        return np.eye(self.plant.inputs, self.length * self.plant.inputs)

    @property
    def choice(self) -> tuple[Step, ...]:
        """The steps that compute the plan, and the input of the actuator in silence."""
        return (
            Assign("controller", PLAN, {ESTIMATE: np.vstack(self._rows[1:])}),
            Assign("controller", CANDIDATE, {PLANNED: self._first}),
        )

    def sent(self, on: str | None) -> tuple[Step, ...]:
        """Return the steps of the packet, of the actuator that applies its inputs, and of the copy of the sender."""
        m, whole = self.plant.inputs, np.eye(self.length * self.plant.inputs)
        heard, powers = heard_on("actuator", self.oldest), [whole]
        for _ in range(self.oldest):
            powers.append(self._shift @ powers[-1])
        late = ({PLAN: self._first @ power} for power in powers[:-1])
        applied = ({AHEAD: self._first}, {"command": np.eye(m)}, *late)
        return (
            Send("controller", "actuator", ("command", PLAN), on),
            Assign("actuator", "input", applied, heard),
            Assign("actuator", AHEAD, ({AHEAD: self._shift}, *({PLAN: power} for power in powers)), heard),
            _stored(m, on),
            Assign("controller", PLANNED, ({PLANNED: self._shift}, {PLAN: whole}), on)
            if on
            else Assign("controller", PLANNED, {PLAN: whole}),
        )


def _held_input(
    inputs: int, own: Array, sent: str | None, known: Condition | str | None
) -> tuple[Step, tuple[Step, ...]]:
    """Return the candidate of an actuator that uses ``own`` times its last input in silence, and the steps to it."""
    unit = np.eye(inputs)
    return Assign("controller", CANDIDATE, {HELD: own}), (
        Send("controller", "actuator", ("command",), sent),
        Assign("actuator", "input", ({"input": own}, {"command": unit}), Received("actuator")),
        _stored(inputs, known),
    )


def _stored(inputs: int, known: Condition | str | None) -> Step:
    """Return the step by which the controller stores the input that the actuator applies."""
    silent, sent = {CANDIDATE: np.eye(inputs)}, {"command": np.eye(inputs)}
    return Assign("controller", HELD, (silent, sent), known) if known else Assign("controller", HELD, sent)


def _deviation(plant: Plant, signal: str) -> tuple[Step, ...]:
    return (Assign("controller", DEVIATION, {signal: np.eye(plant.states), ESTIMATE: -np.eye(plant.states)}),)


def route_over(
    link: str,
    problem: Discrete,
    controller: Controller,
    actuation: Actuation,
    lossy: bool,
    copied: Filter | None = None,
    start: Array | None = None,
    measured: Mapping[str, Array] | None = None,
    follows: bool = True,
    oldest: int = 0,
) -> GivenRoute:
    """Return the policy steps of a link of a given controller. ``measured`` is the measurement as a sum of signals.

    A receiver that predicts hears packets of up to ``oldest`` steps.
    """
    start = np.zeros(len(controller.A)) if start is None else start
    at = "sensor" if link == "sensor" else "controller"
    measured = outputs_of(problem.plant, at) if measured is None else measured
    choice("actuation", actuation, ("hold", "model", "zero"))
    if choice("link", link, ("actuator", "sensor")) == "actuator":
        return _over_actuator_link(problem, controller, actuation, lossy, copied, start, measured, oldest)
    if actuation == "zero":
        raise ProblemError(
            "actuation is 'zero', but the policy sends its packets on the sensor link; expected actuation = 'hold' or "
            "'model'"
        )
    model = actuation == "model"
    return _over_sensor_link(problem, controller, model, lossy, copied, start, measured, follows, oldest * model)


def _begins(node: str, measured: Mapping[str, Array], registers: int) -> tuple[Step, ...]:
    """Return the steps by which a node takes up the measurement and the state of the controller."""
    taken = (Assign(node, REGISTER, {NEXT: np.eye(registers)}),) if registers else ()
    return (Assign(node, MEASURED, measured), *taken)


def _over_actuator_link(
    problem: Discrete,
    controller: Controller,
    actuation: Actuation,
    lossy: bool,
    copied: Filter | None,
    start: Array,
    measured: Mapping[str, Array],
    oldest: int,
) -> GivenRoute:
    """Return the route of inputs; an actuator that predicts simulates plant and controller in silence."""
    base, m, k = actuator_base(problem, controller), problem.plant.inputs, len(controller.A)
    unit, at = np.eye(m), "controller"
    on = Acknowledged("actuator") if lossy else SEND
    command = Assign(at, "command", nonempty({REGISTER: controller.C, MEASURED: controller.D}))
    moved = {REGISTER: controller.A, MEASURED: controller.B, HELD: controller.E}
    error, begun, initial = {CANDIDATE: unit, "command": -unit}, np.zeros(m), {NEXT: start} if k else {}
    if actuation == "model":
        if oldest:
            _expect_linear(problem.plant, False, PREDICTED)
        plant, whole = problem.plant, np.eye(len(base.Phi))
        n = plant.states
        packet = nonempty({ESTIMATE: whole[:, :n], REGISTER: whole[:, n : n + k], MEASURED: whole[:, n + k :]})
        follows = {"model": base.Phi, "input": base.Gamma}, {"copy": base.Phi, HELD: base.Gamma}
        first = np.concatenate([plant.mean, start, plant.C @ plant.mean])
        whole_packet = _Packet(packet, base.K, {"command": unit}, base.Phi + base.Gamma @ base.K, oldest)
        copies = _Copies.of(whole_packet, follows, on, first)
        candidate = Assign(at, CANDIDATE, {"prediction": base.K})
        sent = (Send(at, "actuator", ("command", *packet), SEND), *copies.receiver, _stored(m, on), *copies.decider)
        initial |= copies.initial
        if copied is not None:
            error = {"prediction": whole, **{name: -matrix for name, matrix in packet.items()}}
            base, begun = predicting_actuator(problem, base, copied), first
    else:
        own = np.zeros((m, m)) if actuation == "zero" else unit
        candidate, sent = _held_input(m, own, SEND, on)
        if actuation == "zero":
            base = replace(base, candidate=np.zeros((m, m + len(base.Phi))))
    return GivenRoute(
        at,
        (*_begins(at, measured, k), command, candidate),
        error,
        (*sent, *((Assign(at, NEXT, moved),) if k else ())),
        initial,
        base=base,
        sites=COLLOCATED,
        start=start,
        begun=begun,
        registers=k,
    )


def _over_sensor_link(
    problem: Discrete,
    controller: Controller,
    model: bool,
    lossy: bool,
    copied: Filter | None,
    start: Array,
    measured: Mapping[str, Array],
    follows: bool,
    oldest: int,
) -> GivenRoute:
    """Return the route of measurements; the sensor has a copy of the controller, if it ``follows`` it.

    In silence, a controller that predicts uses C x̃, with the state x̃ of a model that starts at the last sent estimate.
    It moves an older packet to the present with its own inputs since then (``_Past``).
    """
    plant, c = problem.plant, controller
    p, state, at = plant.outputs, np.eye(plant.states), "sensor"
    unit, own, k = np.eye(p), np.eye(len(c.A)), len(c.A) if follows else 0
    on = Acknowledged("sensor") if lossy else SEND
    known = ({CANDIDATE: unit}, {MEASURED: unit})
    silent = {"forecast": plant.C} if model else {"used": unit}
    packet = {MEASURED: unit, **({ESTIMATE: state} if model else {}), **({REGISTER: own} if k else {})}
    if oldest:
        _expect_linear(plant, False, PREDICTED)
    past, heard = _Past(plant, c, oldest), heard_on("sensor", oldest)
    adopted = Assign("controller", "state", ({"state": own}, *past.states), heard) if k else None
    receiver: tuple[Step, ...] = (
        Assign("controller", "used", (silent, {MEASURED: unit}, *past.outputs), heard),
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
        receiver += (
            Assign("controller", "model", ({"forecast": state}, *past.models), heard),
            Assign("controller", "forecast", {"model": plant.A, "command": plant.B}),
            *past.kept,
        )
        copy += (
            Assign(at, "copy", ({"prediction": state}, {ESTIMATE: state}), on),
            Assign(at, "prediction", {"copy": plant.A, HELD: plant.B}),
        )
        if copied is not None:
            above, below = np.eye(p + plant.states, p), np.eye(p + plant.states)[:, p:]
            error = {CANDIDATE: above, MEASURED: -above, "prediction": below, ESTIMATE: -below}
            base, begun = predicting_controller(problem, controller, copied), np.concatenate([begun, plant.mean])
    candidate = Assign(at, CANDIDATE, {"prediction": plant.C} if model else {"known": unit})
    return GivenRoute(
        at,
        (*_begins(at, measured, k), candidate),
        error,
        (Send(at, "sensor", tuple(packet), SEND), *receiver, *copy),
        dict.fromkeys((*((NEXT,) if k else ()), *(("state",) if len(start) else ())), start) | first,
        base=base,
        sites=(frozenset({"controller", "actuator"}),),
        start=start,
        begun=begun,
        registers=k,
    )


@dataclass(frozen=True, eq=False, repr=False)
class _Past(Displayed):
    """How a controller moves a packet of the sensor to the present, j steps after it was sent.

    With the commands u and the values ν that it has used since then,

        x̃_k = Aʲ x̂_{k−j} + Σ_{i=1}^{j} Aⁱ⁻¹ B u_{k−i},
        x^c_k = A_cʲ x^c_{k−j} + Σ_{i=1}^{j} A_cⁱ⁻¹ (B_c ν_{k−i} + E_c u_{k−i}),

    where ν_{k−j} is the measurement in the packet. In place of a measurement for step k, it uses C x̃_k.
    """

    plant: Plant
    controller: Controller
    oldest: int  # largest age in steps of a packet

    @property
    def models(self) -> list[Mapping[str, Array]]:
        """The state of the plant's model, by the age of the packet."""
        A, B, found = self.plant.A, self.plant.B, [dict[str, Array]({ESTIMATE: np.eye(self.plant.states)})]
        for age in range(1, self.oldest + 1):
            since = self._since(A, B, range(age))
            found.append({ESTIMATE: np.linalg.matrix_power(A, age), COMMANDS: since})
        return [*found]

    @property
    def outputs(self) -> list[Mapping[str, Array]]:
        """The value that the controller uses, by the age of a packet that is not of this step."""
        return [{name: self.plant.C @ matrix for name, matrix in one.items()} for one in self.models[1:]]

    @property
    def states(self) -> list[Mapping[str, Array]]:
        """The state of the controller, by the age of the packet."""
        c = self.controller
        found = [dict[str, Array]({REGISTER: np.eye(len(c.A))})]
        for age in range(1, self.oldest + 1):
            first = np.linalg.matrix_power(c.A, age - 1)
            used, commands = self._since(c.A, c.B, range(age - 1)), self._since(c.A, c.E, range(age))
            found.append({REGISTER: first @ c.A, MEASURED: first @ c.B, USES: used, COMMANDS: commands})
        return [*found]

    @property
    def kept(self) -> tuple[Step, ...]:
        """The steps by which the controller stores its last commands, and the values that it used."""
        sizes = {COMMANDS: ("command", self.plant.inputs), USES: ("used", self.plant.outputs)}
        names = [COMMANDS, *([USES] if len(self.controller.A) else [])] if self.oldest else []
        found = list[Step]()
        for name, (one, size) in ((name, sizes[name]) for name in names):
            whole = np.eye(self.oldest * size)
            found.append(Assign("controller", name, {name: np.eye(len(whole), k=-size), one: whole[:, :size]}))
        return tuple(found)

    def _since(self, A: Array, B: Array, steps: range) -> Array:
        """Return the matrix of past values, newest first: Aⁱ B for each of the steps, and 0 for those before."""
        found = np.zeros((len(A), self.oldest * B.shape[1]))
        for i in steps:
            found[:, i * B.shape[1] : (i + 1) * B.shape[1]] = np.linalg.matrix_power(A, i) @ B
        return found


def actuator_base(problem: Discrete, controller: Controller) -> Base:
    """Return the base loop in which packets carry the input. Its state z contains plant state, controller state
    and y.
    """
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
    """Return the base loop in which packets carry the measurement to the controller, which knows the set-points."""
    plant, c = problem.plant, controller
    n, k, p, q = plant.states, len(c.A), plant.outputs, plant.sensed
    state, choice = (
        np.vstack([plant.B, c.E, plant.C @ plant.B]),
        np.vstack([np.zeros((n, q)), c.B[:, :q], np.zeros((p, q))]),
    )
    rest = block_diagonal(plant.A, c.A, np.zeros((p, p)))
    rest[n + k :, :n] = plant.C @ plant.A
    rest[n : n + k, n + k + q :] = c.B[:, q:]
    used = np.hstack([np.zeros((plant.inputs, n)), c.C, np.zeros((plant.inputs, q)), c.D[:, q:], c.D[:, :q]])
    Phi, Gamma = rest + state @ used[:, :-q], choice + state @ c.D[:, :q]
    K = np.hstack([np.zeros((q, n + k)), np.eye(q, p)])
    return Base(Phi, Gamma, _stage(problem, used), K, _noise(problem, k))


def predicting_actuator(problem: Discrete, base: Base, steady: Filter) -> Base:
    """Return the base loop in which packets carry the estimate ẑ; with it, the actuator simulates the closed loop."""
    n, size = problem.plant.states, base.K.shape[1]
    used = block_diagonal(np.eye(size), base.K)
    moved = np.hstack([np.zeros((size, size)), base.Phi + base.Gamma @ base.K])
    noise, unseen = _corrections(problem, steady, size - n - problem.plant.outputs)
    return Base(base.Phi, base.Gamma @ base.K, used.T @ base.stage @ used, np.eye(size), noise, moved, unseen)


def predicting_controller(problem: Discrete, controller: Controller, steady: Filter) -> Base:
    """Return the base loop in which packets carry measurement and estimate; with them, the controller predicts both."""
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
    """Remove the terms with an empty matrix from a sum of signals."""
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
class _Packet(Displayed):
    """A packet with the state of a model, of which a receiver that predicts makes input and state by its age."""

    terms: Mapping[str, Array]  # the state as a sum of the signals in the packet
    K: Matrix  # gain of the input
    sent: Mapping[str, Matrix]  # the input as a sum of the signals in a packet that has just been sent
    closed: Matrix  # matrix of the model with this input
    oldest: int  # largest age in steps of a packet

    @property
    def states(self) -> list[Mapping[str, Array]]:
        """The state of the model, by the age of the packet."""
        found = [self.terms]
        for _ in range(self.oldest):
            found.append({name: _fixed(self.closed) @ matrix for name, matrix in found[-1].items()})
        return found

    @property
    def inputs(self) -> list[Mapping[str, Matrix]]:
        """The input, by the age of the packet."""
        late = self.states[1:]
        return [self.sent, *({name: _fixed(self.K) @ matrix for name, matrix in one.items()} for one in late)]


def _fixed(matrix: Matrix) -> Array:
    """Return a matrix that is the same in every step, as it is for packets with an age."""
    assert not isinstance(matrix, Scheduled)
    return matrix


@dataclass(frozen=True, eq=False, repr=False)
class _Copies(Displayed):
    """The steps of an actuator that predicts its input between packets, and of the node that decides, which copies it.

    Both start at the values of the last packet.
    """

    receiver: tuple[Step, ...]
    decider: tuple[Step, Step]
    initial: dict[str, Array]

    @staticmethod
    def of(
        packet: _Packet,
        moved: tuple[Mapping[str, Matrix], Mapping[str, Matrix]],
        known: Condition | str | None,
        begun: Array,
    ) -> _Copies:
        """Return the policy steps by which both ends of a link update their copies of a value, by a model and by
        packets.
        """
        unit, heard, terms = np.eye(len(begun)), heard_on("actuator", packet.oldest), packet.terms
        return _Copies(
            (
                Assign("actuator", "input", ({"forecast": packet.K}, *packet.inputs), heard),
                Assign("actuator", "model", ({"forecast": unit}, *packet.states), heard),
                Assign("actuator", "forecast", moved[0]),
            ),
            (
                Assign("controller", "copy", ({"prediction": unit}, terms), known)
                if known
                else Assign("controller", "copy", terms),
                Assign("controller", "prediction", moved[1]),
            ),
            {"prediction": begun, "forecast": begun},
        )
