"""Policies with a controller between sensors and actuators, where every sensor and actuator may have its own link.

``Around`` writes the policy steps of all nodes. A sensor with a link sends its outputs, and the controller sends the
command of each actuator with a link. In silence, the receiver uses a value that the sender knows too. So the sender
computes the ``moved`` of a link, the value that a packet would carry minus the one that is used in silence, and a
``Rule`` decides by it. Nodes at the controller's place need no link.

* **Hold.** The receiver keeps the last value that arrived.
* **Model.** A packet also carries a state of the loop, from which both ends predict the value, each by a copy of the
  model. A sensor estimates this state from its own outputs alone, by a filter of the loop that sends every sample.
  Whether the model is right decides how often a packet is sent, and nothing else.

If a link drops packets and acknowledges those that arrive, both ends keep the old value until one arrives. The control
is feedback of a filtered estimate (``FilteredSteps``) or a given controller (``GivenSteps``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._display import Displayed
from taciturn.base.filter import ESTIMATE, HELD
from taciturn.base.response import EverySample
from taciturn.base.route import nonempty
from taciturn.errors import UnstableError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import steady_filter
from taciturn.model.controller import Controller
from taciturn.model.network import Network
from taciturn.model.plant import Plant
from taciturn.model.steps import Acknowledged, Assign, Condition, Received, Send, Step, Terms
from taciturn.model.trigger import Matrix

LAST, HEARD, REGISTER, INNOVATION, PRIOR = "last", "heard", "register", "innovation", "prior"
REMEMBERED = 0.999  # factor per step of a mode that never decays, in the filter of one sensor
LASTING = 1e-6  # distance of the modulus of such a mode from 1
SLIGHT = 1e-3  # variance of a noise that is added to outputs without one, as a share of what W adds to them in a step


class Rule(Protocol):
    """Rule by which a node decides when not to send on its links."""

    def decide(self, at: str, links: Sequence[Silenced]) -> tuple[Step, ...]:
        """Return the policy steps with which the node ``at`` decides whether to send on its links."""
        ...

    def decision(self, links: Sequence[Silenced]) -> str:
        """Return the name of the decision that the node takes on the given links."""
        ...

    def sends(self, links: Sequence[Silenced]) -> Sequence[tuple[str, frozenset[str]]]:
        """Return each label of the decision with the set of links that send. With the first label, no link sends."""
        ...

    def after(self, at: str, links: Sequence[Silenced], told: Condition) -> tuple[Step, ...]:
        """Return the policy steps that follow once the node knows, by the condition ``told``, which packets arrived."""
        ...


@dataclass(frozen=True, repr=False)
class Silenced(Displayed):
    """A link on which a node may decide not to send."""

    link: str
    moved: str  # the signal with the value of a packet minus the value that is used in silence
    size: int  # entries of both
    entry: str  # ``"output"`` or ``"input"``


@dataclass(frozen=True, eq=False, repr=False)
class Model(Displayed):
    """The closed loop that sends every sample, z⁺ = F z + w. Both ends of a link use this model to predict values."""

    F: Array  # (k, k)
    W: Array  # covariance of w, (k, k)
    C: Array  # outputs of the plant, y = C z + v, (p, k)
    V: Array  # covariance of v, (p, p)
    K: Array  # command K z, (m, k)
    state: Terms  # z as a sum of the controller's signals
    start: Array  # z at the first step


class Control(Protocol):
    """Interface of classes that return a controller's policy steps, from its measurements to the applied inputs."""

    @property
    def controller(self) -> Controller:
        """The control law as a linear controller in state space."""
        ...

    def before(self, at: str, used: Mapping[str, Array]) -> tuple[Step, ...]:
        """Return the policy steps that the node ``at`` executes before it computes the command."""
        ...

    def command(self, rows: list[int], used: Mapping[str, Array]) -> Mapping[str, Array]:
        """Return the entries ``rows`` of the command as a sum of signals."""
        ...

    def after(self, at: str, used: Mapping[str, Array], held: Mapping[str, Array]) -> tuple[Step, ...]:
        """Return the policy steps that the node ``at`` executes after the packets to the actuators."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class FilteredSteps(Displayed):
    """Policy steps of LQG control, which feeds back a filtered state estimate."""

    plant: Plant  # the plant from step to step
    gain: Array  # gain of the filter, (n, p)
    L: Array  # gain of the regulator, (m, n)

    @property
    def controller(self) -> Controller:
        """LQG control as a linear controller in state space, whose state is the predicted state estimate."""
        left = np.eye(self.plant.states) - self.gain @ self.plant.C
        A, B, L = self.plant.A, self.plant.B, self.L
        return Controller(A @ left, A @ self.gain, L @ left, L @ self.gain, B, self.plant.dt)

    def before(self, at: str, used: Mapping[str, Array]) -> tuple[Step, ...]:
        """Return the policy steps that correct the predicted state with the measurements."""
        return filtered(at, self.plant, self.gain, used)

    def command(self, rows: list[int], used: Mapping[str, Array]) -> Mapping[str, Array]:
        """Return the entries ``rows`` of the command L x̂ as a sum of signals."""
        return {ESTIMATE: self.L[rows]}

    def after(self, at: str, used: Mapping[str, Array], held: Mapping[str, Array]) -> tuple[Step, ...]:
        """Return the policy step that predicts the plant's next state."""
        return predicted(at, self.plant, held)


@dataclass(frozen=True, eq=False, repr=False)
class GivenSteps(Displayed):
    """Policy steps of a given controller. If actuators predict, they include a filter that estimates the state."""

    controller: Controller  # the controller at the step of the policy
    plant: Plant
    gain: Array | None = None  # gain of the filter, (n, p)

    def before(self, at: str, used: Mapping[str, Array]) -> tuple[Step, ...]:
        """Return the policy steps that correct the filter's prediction; none if the policy has no filter."""
        return () if self.gain is None else filtered(at, self.plant, self.gain, used)

    def command(self, rows: list[int], used: Mapping[str, Array]) -> Mapping[str, Array]:
        """Return the entries ``rows`` of the controller's command C z + D y as a sum of signals."""
        c = self.controller
        return nonempty({REGISTER: c.C[rows], **{name: c.D[rows] @ columns for name, columns in used.items()}})

    def after(self, at: str, used: Mapping[str, Array], held: Mapping[str, Array]) -> tuple[Step, ...]:
        """Return the policy steps that update the controller's state and, with a filter, predict the plant's state."""
        c, found = self.controller, list[Step]()
        if len(c.A):
            moved = {name: c.B @ columns for name, columns in used.items()}
            moved |= {name: c.E @ columns for name, columns in held.items()}
            found.append(Assign(at, REGISTER, {REGISTER: c.A, **moved}))
        return (*found, *(() if self.gain is None else predicted(at, self.plant, held)))


def filtered(at: str, plant: Plant, gain: Array, used: Mapping[str, Array]) -> tuple[Step, ...]:
    """Return the policy steps that correct the predicted state with the measurements."""
    return (
        Assign(at, INNOVATION, {**used, PRIOR: -plant.C}),
        Assign(at, ESTIMATE, {PRIOR: np.eye(plant.states), INNOVATION: gain}),
    )


def predicted(at: str, plant: Plant, held: Mapping[str, Array]) -> tuple[Step, ...]:
    """Return the policy step that predicts the plant's state at the next sampling instant."""
    moved = {name: plant.B @ columns for name, columns in held.items()}
    return (Assign(at, PRIOR, {ESTIMATE: plant.A, **moved}),)


def model_of(problem: Discrete, controller: Controller, start: Array) -> Model:
    """Return the model with which both ends of a link predict the states of the plant and of the given controller."""
    plant, c, loop = problem.plant, controller, EverySample.of(problem, controller)
    n, p = plant.states, plant.outputs
    enters = loop.G[:, :p]
    W = enters @ plant.V @ enters.T
    W[:n, :n] += plant.W
    rows = {ESTIMATE: np.eye(len(W))[:, :n], REGISTER: np.eye(len(W))[:, n:]}
    return Model(
        loop.F, symmetrised(W), np.pad(plant.C, ((0, 0), (0, len(c.A)))), plant.V,
        np.hstack([c.D @ plant.C, c.C]), nonempty(rows), np.concatenate([plant.mean, start]),
    )  # fmt: skip


def model_of_estimate(problem: Discrete, L: Array, posterior: Array) -> Model:
    """Return the model with which both ends of a link predict the plant's state under LQG control."""
    plant, n = problem.plant, problem.plant.states
    moved = plant.B @ L
    return Model(
        plant.A + moved, plant.W + symmetrised(moved @ posterior @ moved.T), plant.C, plant.V, L,
        {ESTIMATE: np.eye(n)}, plant.mean,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Ends(Displayed):
    """The policy steps at both ends of a link: value used without a packet, packet, and stored values."""

    before: tuple[Step, ...]  # steps of the sender before the decision
    silent: Terms  # the value that the receiver uses in silence, as a sum of the sender's signals
    payload: tuple[str, ...]
    kept: tuple[tuple[str, Terms, Terms], ...]  # memories of the sender: without and with a packet that has arrived
    hears: tuple[Step, ...]  # steps of the receiver


class Around:
    """Assembles the policy steps of sensors, controller and actuators. A rule decides when each link sends."""

    def __init__(
        self,
        network: Network,
        plant: Plant,
        rule: Rule,
        *,
        suffixed: bool = True,
        sensing: Model | None = None,
        acting: Model | None = None,
        together: bool = False,
    ) -> None:
        """Find what each node measures and applies.

        ``sensing`` and ``acting`` are models that predict silent outputs and silent commands; None: the last value is
        kept. With ``together``, one decision is on all links from the controller.
        """
        self._network, self._plant, self._rule, self._suffixed = network, plant, rule, suffixed
        self._sensing, self._acting, self._together = sensing, acting, together
        self._measured = network.measurements(plant.sensed, plant.set_points).items()
        self._applied = network.applications(plant.inputs).items()
        self.sites = network.sites_of_controller

    @cached_property
    def used(self) -> Mapping[str, Array]:
        """The measurements that the controller uses, each as a sum of signals of the controller."""
        unit = np.eye(self._plant.outputs)
        return {self._used(signal, node): unit[:, [*rows]] for signal, (node, rows) in self._measured}

    @cached_property
    def held(self) -> Mapping[str, Array]:
        """The inputs that the actuators apply, each as a sum of signals of the controller."""
        unit = np.eye(self._plant.inputs)
        return {self._named(HELD, node): unit[:, [*rows]] for _, (node, rows) in self._applied}

    @property
    def groups(self) -> list[tuple[str, ...]]:
        """The groups of links. One decision of one node determines which links of a group send."""
        sensors = [(node,) for _, (node, _) in self._measured if self._linked(node)]
        actuators = tuple(node for _, (node, _) in self._applied if self._linked(node))
        return [*sensors, *([actuators] if self._together and actuators else [(node,) for node in actuators])]

    def errors(self, group: Sequence[str]) -> list[int]:
        """Return the indices, in the vector (measurements, inputs), of the entries that a group of links transmits."""
        found = list[int]()
        for link in group:
            found += [one for _, (node, rows) in self._measured if node == link for one in rows]
            found += [self._plant.outputs + one for _, (node, rows) in self._applied if node == link for one in rows]
        return found

    def steps(self, control: Control) -> tuple[Step, ...]:
        """Return the policy steps of all nodes for the given control law."""
        at = self._network.controller
        found = [step for signal, (node, rows) in self._measured for step in self._sensor(signal, node, [*rows])]
        found += control.before(at, self.used)
        late, waiting, groups = any(map(self._acknowledged, self._linked_actuators())), list[Step](), self._actuators()
        for signal, (node, rows) in self._applied:
            if not self._linked(node):
                found += self._wired(signal, node, control.command([*rows], self.used), len(rows))
                continue
            for group in (one for one in groups if one[0][1] == node):
                sends, copies = self._acts(group, control)
                # all packets before any acknowledgement, so that a node can wait for these until its next step
                found += sends if late else [*sends, *copies]
                waiting += copies if late else []
        return (*found, *waiting, *control.after(at, self.used, self.held))

    def begun(self, measurement: Array) -> dict[str, Array]:
        """Return the initial values of all stored outputs, given the expected measurement at the first step."""
        found = dict[str, Array]()
        for signal, (node, rows) in ((signal, one) for signal, one in self._measured if self._linked(one[0])):
            heard, expected = self._used(signal, node), measurement[[*rows]]
            if self._sensing is None:
                found |= {self._named(LAST, node): expected, heard: expected}
            else:
                found |= {self._named(name, node): self._sensing.start for name in ("local", "copy", "model")}
        if self._acting is not None:
            names = [self._named(name, node) for node in self._linked_actuators() for name in ("copy", "model")]
            found |= dict.fromkeys(names, self._acting.start)
        return found

    def _linked(self, node: str) -> bool:
        return node in self._network.links

    def _linked_actuators(self) -> list[str]:
        return [node for _, (node, _) in self._applied if self._linked(node)]

    def _actuators(self) -> list[list[tuple[str, str, list[int]]]]:
        """Return signal, node and inputs of the actuators with a link, by the group that is decided together."""
        linked = [(signal, node, [*rows]) for signal, (node, rows) in self._applied if self._linked(node)]
        return [linked] if self._together and linked else [[one] for one in linked]

    def _acknowledged(self, link: str) -> bool:
        return self._linked(link) and self._network.acknowledges(link)

    def _told(self, links: Sequence[Silenced]) -> Condition:
        """Return the condition from which the sender learns which packets have arrived."""
        link = links[0].link
        return Acknowledged(link) if self._acknowledged(link) else self._rule.decision(links)

    def _branches(self, links: Sequence[Silenced], link: str, told: Condition, kept: Terms, sent: Terms) -> Assigned:
        """Return the branches of a memory, one for each outcome of a condition on packets."""
        if isinstance(told, Acknowledged):
            return kept, sent
        return tuple(sent if link in sends else kept for _, sends in self._rule.sends(links))

    def _sensor(self, signal: str, node: str, rows: list[int]) -> list[Step]:
        if not self._linked(node):
            return []
        links = [Silenced(node, self._named("moved", node), len(rows), "output")]
        ends = self._ends_of_sensor(signal, node, rows)
        return [*self._sent(node, links, {node: (signal, ends)}), *ends.hears]

    def _acts(self, group: list[tuple[str, str, list[int]]], control: Control) -> tuple[list[Step], list[Step]]:
        """Return the steps of a decision on links from the controller, up to the inputs, and those of its copies."""
        at = self._network.controller
        links = [Silenced(node, self._named("moved", node), len(rows), "input") for _, node, rows in group]
        commands = [
            Assign(at, self._named("command", node), control.command(rows, self.used)) for _, node, rows in group
        ]
        ends = {
            node: (self._named("command", node), self._ends_of_actuator(signal, node, rows))
            for signal, node, rows in group
        }
        steps = self._sent(at, links, ends)
        many = 1 + max(i for i, step in enumerate(steps) if isinstance(step, Send))
        hears = [step for _, one in ends.values() for step in one.hears]
        if any(map(self._acknowledged, ends)):
            return [*commands, *steps[:many], *hears], steps[many:]
        return [*commands, *steps, *hears], []

    def _sent(self, at: str, links: Sequence[Silenced], ends: Mapping[str, tuple[str, Ends]]) -> list[Step]:
        """Return the sender's steps: the difference on each link, the decision, the packets, and the memory."""
        told, on = self._told(links), self._rule.decision(links)
        labels = self._rule.sends(links)
        moved = list[Step]()
        for one in links:
            value, end = ends[one.link]
            silent = {name: -_weight(matrix) for name, matrix in end.silent.items()}
            moved += [*end.before, Assign(at, one.moved, {value: np.eye(one.size), **silent})]
        sends = list[Step]()
        for one in links:
            sending = tuple(label for label, sent in labels if one.link in sent)
            several = sending if len(links) > 1 else ()
            sends.append(Send(at, one.link, ends[one.link][1].payload, on, several))
        kept = [
            Assign(at, name, self._branches(links, one.link, told, without, sent), told)
            for one in links
            for name, without, sent in ends[one.link][1].kept
        ]
        return [*moved, *self._rule.decide(at, links), *sends, *kept, *self._rule.after(at, links, told)]

    def _ends_of_sensor(self, signal: str, node: str, rows: list[int]) -> Ends:
        heard, unit, at = self._used(signal, node), np.eye(len(rows)), self._network.controller
        if self._sensing is None:
            last = self._named(LAST, node)
            receives = Assign(at, heard, ({heard: unit}, {signal: unit}), Received(node))
            return Ends((), {last: unit}, (signal,), ((last, {last: unit}, {signal: unit}),), (receives,))
        model = self._sensing
        copy, far, local = (self._named(name, node) for name in ("copy", "model", "local"))
        C, F, gain = model.C[rows], model.F, _local_gain(model, rows)
        return Ends(
            (Assign(node, local, {local: F - gain @ C @ F, signal: gain}),),
            {copy: C},
            (signal, local),
            ((copy, {copy: F}, {local: F}),),
            (
                Assign(at, heard, ({far: C}, {signal: unit}), Received(node)),
                Assign(at, far, ({far: F}, {local: F}), Received(node)),
            ),
        )

    def _ends_of_actuator(self, signal: str, node: str, rows: list[int]) -> Ends:
        unit, held = np.eye(len(rows)), self._named(HELD, node)
        command = {self._named("command", node): unit}
        if self._acting is None:
            receives = Assign(node, signal, ({signal: unit}, command), Received(node))
            return Ends((), {held: unit}, tuple(command), ((held, {held: unit}, command),), (receives,))
        model, K = self._acting, self._acting.K[rows]
        copy, far = self._named("copy", node), self._named("model", node)
        onward = {name: model.F @ _weight(columns) for name, columns in model.state.items()}
        return Ends(
            (),
            {copy: K},
            (*command, *model.state),
            ((held, {copy: K}, command), (copy, {copy: model.F}, onward)),
            (
                Assign(node, signal, ({far: K}, command), Received(node)),
                Assign(node, far, ({far: model.F}, onward), Received(node)),
            ),
        )

    def _wired(self, signal: str, node: str, terms: Mapping[str, Array], size: int) -> list[Step]:
        """Return the steps of an actuator at the controller's place."""
        at, unit, command = self._network.controller, np.eye(size), self._named("command", node)
        held = self._named(HELD, node)
        return [Assign(at, command, terms), Assign(node, signal, {command: unit}), Assign(at, held, {command: unit})]

    def _used(self, signal: str, node: str) -> str:
        """Return the signal that the controller uses as a measurement."""
        return self._named(HEARD, node) if self._linked(node) else signal

    def _named(self, name: str, node: str) -> str:
        return f"{name}_{node}" if self._suffixed else name


Assigned = tuple[Terms, ...]


def _weight(matrix: Matrix) -> Array:
    assert isinstance(matrix, np.ndarray), "no weight of this policy changes with time"
    return matrix


def _remembered(F: Array) -> Array:
    """Return the dynamics of a loop, in which each mode that never decays is made to decay slowly."""
    lasting = (np.abs(np.abs(np.linalg.eigvals(F)) - 1) < LASTING).any()
    return REMEMBERED * F if lasting else F


def _local_gain(model: Model, rows: list[int]) -> Array:
    """Return the gain of the filter by which a sensor estimates the state of the loop from its own outputs.

    The noise of the outputs moves the loop too. It counts as further noise of the loop: a sensor that took its outputs
    for those that the controller uses would follow a controller that hears everything, whose integral is another one.
    """
    C, F, V = model.C[rows], _remembered(model.F), model.V[np.ix_(rows, rows)]
    try:
        return steady_filter(F, C, model.W, V).gain
    except UnstableError:
        # outputs without noise, as those of a register, may have a zero on the unit circle: a little noise lets the
        # estimate forget it, and any estimate that both ends share will do
        seen = C @ model.W @ C.T
        if not seen.diagonal().min() > 0:
            raise
        return steady_filter(F, C, model.W, V + SLIGHT * np.diag(seen.diagonal())).gain
