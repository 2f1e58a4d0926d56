"""Several sensors and actuators: the estimate as a sum of the sensors' contributions, and decisions on sets of links.

**Sensors** (``ContributionSteps``). The Kalman filter of several sensors is a sum of contributions, one from each
sensor and one from the inputs. With Ω = (I − GC)A, the estimate is x̂ = ξ⁰ + Σ ξˢ, ξˢ⁺ = Ωξˢ + G_s y_s at sensor s, and
ξ⁰⁺ = Ωξ⁰ + (I − GC)Bu at the controller. The controller uses a copy of ξˢ, of which sensor s runs a duplicate. In the
names of signals, ``part`` is the contribution of a sensor, ``copy`` the sensor's duplicate, ``used`` the controller's
copy, and ``own`` is ξ⁰.

**Actuators of LQG control** (``InputSteps``). The controller decides for each link whether the error of its input
exceeds its threshold, or chooses the cheapest set of packets that leaves a total error of at most the threshold.

**Actuators of any policy** (``JointSets``). A policy that decides on one actuator link is put on a network with several
of them. In silence on some links, the inputs of these links differ from the command by their part of the error. The
cost of this silence is the form of the policy with the other entries of the error replaced by zero. Two rules choose
the set of links that send:

- If silence costs nothing without an error, its cost is compared with a price δ of a packet on every link, of which a
  set has the share of its packets' prices. The set with the least sum of cost and price sends.
- Otherwise, the cheapest set sends whose silence costs at most δ.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations

import numpy as np

from taciturn._arrays import Array, Bits
from taciturn._display import Displayed
from taciturn.base.certainty import Actuation, CertaintyEquivalentDesign
from taciturn.base.filter import ESTIMATE, SEND
from taciturn.base.limited_value import LimitedSilence
from taciturn.errors import PlacementError, ProblemError
from taciturn.lqg.kalman import resting_states, steady_filter
from taciturn.lqg.stored import Apart
from taciturn.model.network import Network
from taciturn.model.plant import Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import (
    Acknowledged,
    Apply,
    Assign,
    Condition,
    Decide,
    Evaluate,
    Received,
    Send,
    Step,
    Terms,
    assigned,
    read,
)
from taciturn.model.theory import Innovations, Theory
from taciturn.model.trigger import Form, Scheduled, Trigger

SILENT, STATE = "silent", "state"
REMEMBERED = 0.999  # factor per step of a disturbance that one sensor does not see, in its filter
SHOWN = 1e-6  # relative size of the effect of a disturbance on outputs that counts as none


@dataclass(frozen=True, eq=False, repr=False)
class ContributionSteps(Displayed):
    """Policy steps of sensors that send contributions to the state estimate, and of a controller that adds them."""

    certainty: CertaintyEquivalentDesign  # regulator and filter of all measurements
    network: Network  # the nodes and links; a sensor without a link is at the controller's place
    # what both ends of a link assume in silence: ``"hold"`` no further measurement, ``"model"`` the measurements that
    # a model predicts from the last packet
    prediction: Actuation
    thresholds: Mapping[tuple[str, ...], float]  # δ_l by group of links that are decided together

    def measure(self) -> tuple[Step, ...]:
        """Return the policy steps of all sensors that send over a link."""
        return tuple(step for node in self._remote for step in self._sensor(node))

    def add(self) -> tuple[Step, ...]:
        """Return the policy steps with which the controller adds the contributions of the sensors to its estimate
        ``state``.
        """
        at, n = self.network.controller, np.eye(self._plant.states)
        local = {signal: gain for node, (signal, gain, _) in self._sensors.items() if node not in self._remote}
        return (
            Assign(at, "own", {"prior": self._left, **local}),
            *(step for node in self._remote for step in self._receive(node)),
            Assign(at, STATE, {"own": n, **{f"used_{node}": n for node in self._remote}}),
        )

    def predict(self, held: Mapping[str, Array]) -> tuple[Step, ...]:
        """Return the policy step that predicts the part of the state that the applied input ``held`` causes."""
        moved = {name: self._plant.B @ columns for name, columns in held.items()}
        return (Assign(self.network.controller, "prior", {"own": self._plant.A, **moved}),)

    @property
    def apart(self) -> Apart:
        """The filters of the sensors that are not at the controller's site."""
        return Apart([self._sensors[node][2] for node in self._remote], self._left, self._left @ self._plant.A)

    @property
    def initial(self) -> dict[str, Array]:
        """Initial values of the stored signals. The models start at the mean of the initial state."""
        mean = self._plant.mean
        models = ("local", "copy_model", "used_model") if self.prediction == "model" and mean.any() else ()
        return {"prior": mean, **{f"{name}_{node}": mean for name in models for node in self._remote}}

    @property
    def estimate(self) -> Terms:
        """The estimate from the measurements of all sensors, as a sum of signals of all nodes."""
        n = np.eye(self._plant.states)
        return {"own": n, **{f"part_{node}": n for node in self._remote}}

    def innovations(self) -> Innovations:
        """Return the innovations of a filter of all measurements, which are white. They exist only in the theory."""
        steady, C = self.certainty.filter, self._plant.C
        predicted = {"prior": C, **{f"part_{node}": C @ self._plant.A for node in self._remote}}
        return Innovations(None, steady.innovation, ESTIMATE, steady.posterior, predicted)

    @property
    def _plant(self) -> Plant:
        return self.certainty.problem.plant

    @cached_property
    def _sensors(self) -> Mapping[str, tuple[str, Array, list[int]]]:
        """The signal that each sensor measures, the columns of the filter's gain for it, and its outputs."""
        plant, gain = self._plant, self.certainty.filter.gain
        found = self.network.measurements(plant.sensed, plant.set_points)
        return {node: (signal, gain[:, [*outputs]], [*outputs]) for signal, (node, outputs) in found.items()}

    @cached_property
    def _remote(self) -> list[str]:
        return [node for node in self._sensors if node in self.network.links]

    @cached_property
    def _left(self) -> Array:
        """The factor I − GC from the prior estimate to the posterior estimate."""
        return np.eye(self._plant.states) - self.certainty.filter.gain @ self._plant.C

    def _sensor(self, node: str) -> tuple[Step, ...]:
        signal, gain, _ = self._sensors[node]
        part, expected, L = f"part_{node}", f"expected_{node}", self.certainty.regulator.L
        silent = Form((f"gap_{node}",), self.certainty.regulator.H)
        rule = Trigger({SILENT: silent, SEND: Form(constant=self.thresholds[node,])})
        models = self.prediction == "model"
        return (
            Assign(node, part, {part: self._left @ self._plant.A, signal: gain}),
            *((self._local(node),) if models else ()),
            *self._silent(node, node, "copy", expected),
            Assign(node, f"gap_{node}", {part: L, expected: -L}),
            Decide(node, decision((node,)), rule),
            Send(node, node, (part, f"local_{node}") if models else (part,), decision((node,))),
            *self._updated(node, node, "copy", expected, known(self.network, node, decision((node,)))),
        )

    def _receive(self, node: str) -> tuple[Step, ...]:
        at, expected = self.network.controller, f"predicted_{node}"
        oldest = self.network.longest(node, self.certainty.problem.tick)
        return (
            *self._silent(node, at, "used", expected),
            *self._updated(node, at, "used", expected, Received(node, oldest or None), oldest),
        )

    def _silent(self, node: str, at: str, copy: str, expected: str) -> tuple[Step, ...]:
        """Return the steps of one end of a link that compute the sensor's contribution as if it were silent."""
        decayed = {f"{copy}_{node}": self._left @ self._plant.A}
        if self.prediction == "hold":
            return (Assign(at, expected, decayed),)
        model = f"{copy}_model_{node}"
        return (
            Assign(at, model, {model: closed_loop(self.certainty)}),
            Assign(at, expected, {**decayed, model: self._measured(node)}),
        )

    def _updated(
        self, node: str, at: str, copy: str, expected: str, on: Condition, oldest: int = 0
    ) -> tuple[Step, ...]:
        """Return the steps of one end of a link that set the copy, and its model, to those of a packet.

        A packet that was sent up to ``oldest`` steps ago is moved to the present: the copy becomes what it would be if
        the packet had come at once, and the sensor had been silent since.
        """
        n, model, part, local = np.eye(self._plant.states), f"{copy}_model_{node}", f"part_{node}", f"local_{node}"
        moves, closed = self._left @ self._plant.A, closed_loop(self.certainty)
        models = [{local: np.linalg.matrix_power(closed, age)} for age in range(oldest + 1)]
        parts: list[dict[str, Array]] = [{part: n}]
        for foreseen in models[1:]:
            parts.append({name: moves @ matrix for name, matrix in parts[-1].items()})
            if self.prediction == "model":
                parts[-1][local] = parts[-1].get(local, 0.0) + self._measured(node) @ foreseen[local]
        steps = (Assign(at, f"{copy}_{node}", ({expected: n}, *parts), on),)
        if self.prediction == "hold":
            return steps
        return (*steps, Assign(at, model, ({model: n}, *models), on))

    def _measured(self, node: str) -> Array:
        """Return the part G_s C_s of the contribution of a sensor that the present state causes."""
        _, gain, outputs = self._sensors[node]
        return gain @ self._plant.C[outputs]

    def _local(self, node: str) -> Step:
        """Return the step of the Kalman filter of x⁺ = (A + BL)x + w̌ from the measurements of one sensor.

        An output that the controller keeps free of a disturbance does not show it, so the filter forgets it slowly. It
        does not forget disturbances and set-points that its outputs show, and does not estimate set-points that are
        known and constant.
        """
        plant, (signal, _, outputs) = self._plant, self._sensors[node]
        moved, closed = plant.B @ self.certainty.regulator.L, closed_loop(self.certainty)
        known = resting_states(plant)
        closed = closed - (1 - REMEMBERED) * self._unseen(outputs, ~known) @ closed
        W = plant.W + moved @ self.certainty.filter.posterior @ moved.T
        C, V = plant.C[outputs], plant.V[np.ix_(outputs, outputs)]
        gain, place = np.zeros((plant.states, len(outputs))), np.ix_(~known, ~known)
        gain[~known] = steady_filter(closed[place], C[:, ~known], W[place], V).gain
        kept = (np.eye(plant.states) - gain @ C) @ closed
        return Assign(node, f"local_{node}", {f"local_{node}": kept, signal: gain})

    def _unseen(self, outputs: list[int], among: Bits) -> Array:
        """Return the projection on the lasting states, of some, that outputs do not show where x = Xd, (n, n).

        These are the unobservable directions of d⁺ = Sd with the outputs (CX + C_d)d. No prediction of these outputs
        depends on them.
        """
        problem = self.certainty.problem
        d, found = problem.lasting & among, np.zeros(self._plant.A.shape)
        if problem.followed is None:
            return np.diag(d.astype(np.float64))
        S, shown = self._plant.A[np.ix_(d, d)], problem.followed.outputs(self._plant.C[outputs])[:, d]
        rows = [shown]
        for _ in range(1, len(S)):
            rows.append(rows[-1] @ S)
        seen = np.vstack(rows)
        size = np.abs(seen).max(axis=0, initial=0.0)  # so that the result does not depend on the units
        size[size == 0] = 1.0
        _, lengths, directions = np.linalg.svd(seen / size, full_matrices=True)
        rank = int((lengths > SHOWN * lengths.max(initial=0.0)).sum())
        hidden = directions[rank:]
        found[np.ix_(d, d)] = (hidden.T @ hidden) / size[:, None] * size
        return found


def closed_loop(certainty: CertaintyEquivalentDesign) -> Array:
    """Return the closed-loop matrix A + BL of the loop that sends every sample."""
    return certainty.problem.plant.A + certainty.problem.plant.B @ certainty.regulator.L


def known(network: Network, link: str, on: str) -> Condition:
    """Return the condition that shows a sender whether its packet arrived: an acknowledgement, or its own decision."""
    return Acknowledged(link) if network.acknowledges(link) else on


def decision(group: tuple[str, ...]) -> str:
    """Return the name of the joint decision on a group of links."""
    return "_".join((SEND, *group))


@dataclass(frozen=True, eq=False, repr=False)
class InputSteps(Displayed):
    """Policy steps that compute the applied inputs from the signal ``state``, the controller's estimate.

    In the names of signals, ``held`` is the controller's copy of the input that an actuator applies, and ``error`` the
    difference between the input in silence and the command Lx̃.
    """

    certainty: CertaintyEquivalentDesign  # the regulator
    network: Network  # the nodes and links; an actuator without a link is at the controller's place
    # what an actuator applies in silence: ``"hold"`` its last input, ``"model"`` the input of a simulation x̃⁺ = (A +
    # BL)x̃ from the last packet
    actuation: Actuation
    thresholds: Mapping[tuple[str, ...], float]  # δ_l by group of links that are decided together

    def decide(self) -> tuple[Step, ...]:
        """Return the policy steps of the controller's decisions, and those of the actuators."""
        groups = [group for group in self.thresholds if not self._linked.isdisjoint(group)]
        commands = [step for node in self._actuators for step in self._command(node)]
        sends = [self._send(node, group) for group in groups for node in group]
        # all packets before any acknowledgement, so that a node can wait for these until its next step
        return (
            *commands,
            *map(self._decide, groups),
            *(step for packet, _ in sends for step in packet),
            *(step for _, copies in sends for step in copies),
        )

    @property
    def held(self) -> Mapping[str, Array]:
        """The input that the actuators apply, as a sum of signals of the controller."""
        unit = np.eye(self.certainty.problem.plant.inputs)
        return {f"held_{node}": unit[:, rows] for node, (_, rows) in self._actuators.items()}

    @cached_property
    def _actuators(self) -> Mapping[str, tuple[str, list[int]]]:
        return actuators_of(self.network, self.certainty.problem.plant)

    @cached_property
    def _linked(self) -> set[str]:
        return set(self._actuators).intersection(self.network.links)

    def _command(self, node: str) -> tuple[Step, ...]:
        """Return the steps that compute the command of an actuator, and its error in silence."""
        at, (signal, rows), L = self.network.controller, self._actuators[node], self.certainty.regulator.L
        unit, name = np.eye(len(rows)), f"command_{node}"
        command = Assign(at, name, {STATE: L[rows]})
        if node not in self._linked:
            return (command, Assign(node, signal, {name: unit}), Assign(at, f"held_{node}", {name: unit}))
        silent: tuple[Step, ...] = (Assign(at, f"silent_{node}", {f"held_{node}": unit}),)
        if self.actuation == "model":
            model = f"held_model_{node}"
            silent = (
                Assign(at, model, self._moved(node, model, f"held_{node}")),
                Assign(at, f"silent_{node}", {model: L[rows]}),
            )
        return (command, *silent, Assign(at, f"error_{node}", {f"silent_{node}": unit, name: -unit}))

    def _moved(self, node: str, model: str, applied: str) -> dict[str, Array]:
        """Return the next state of an actuator's model: it uses the input that it applies, and for others Lx̃."""
        closed, plant, (_, rows) = closed_loop(self.certainty), self.certainty.problem.plant, self._actuators[node]
        if plant.saturation is None:
            return {model: closed}
        return {model: closed - plant.B[:, rows] @ self.certainty.regulator.L[rows], applied: plant.B[:, rows]}

    def _decide(self, group: tuple[str, ...]) -> Step:
        """Return the decision on a group: to send if the error exceeds the limit, or the first set that prevents it."""
        limit, at = self.thresholds[group], self.network.controller
        if len(group) == 1:
            return Decide(at, decision(group), Trigger({SILENT: self._error(group), SEND: Form(constant=limit)}))
        options = {label(sent): self._error([node for node in group if node not in sent]) for sent in self._sets(group)}
        return Decide(at, decision(group), Trigger(options, limit))

    def _error(self, silent: Sequence[str]) -> Form:
        """Return the cost of the errors of silent actuators."""
        rows = [row for node in silent for row in self._actuators[node][1]]
        H = self.certainty.regulator.H[np.ix_(rows, rows)]
        return Form(tuple(f"error_{node}" for node in silent), H) if rows else Form()

    def _sets(self, group: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
        return sets_of(group, {link: self.network.links[link].price for link in group})

    def _send(self, node: str, group: tuple[str, ...]) -> tuple[tuple[Step, ...], tuple[Step, ...]]:
        """Return the steps that send to an actuator and apply its input, and those that copy it at the controller."""
        at, (signal, rows), on = self.network.controller, self._actuators[node], decision(group)
        sends = [node in sent for sent in self._sets(group)]
        labels = tuple(label(sent) for sent in self._sets(group) if node in sent) if len(group) > 1 else ()
        told = known(self.network, node, on)
        sends = [False, True] if isinstance(told, Acknowledged) else sends
        unit, n, L = np.eye(len(rows)), np.eye(len(closed_loop(self.certainty))), self.certainty.regulator.L[rows]
        command, silent = {f"command_{node}": unit}, {f"silent_{node}": unit}
        if self.actuation == "hold":
            return (
                Send(at, node, (f"command_{node}",), on, labels),
                Assign(node, signal, ({signal: unit}, command), Received(node)),
            ), (Assign(at, f"held_{node}", tuple(command if sent else silent for sent in sends), told),)
        model, copy = f"model_{node}", f"held_model_{node}"
        closed, oldest = closed_loop(self.certainty), self.network.longest(node, self.certainty.problem.tick)
        if oldest and self.certainty.problem.plant.saturation is not None:
            raise ProblemError(
                f"{self.network.lateness(node)}, actuation is 'model', and the inputs are limited (input_limit or "
                "input_rate), so the inputs of the next steps are not known in advance; expected no limits, actuation "
                "= 'hold', or a buffer"
            )
        by_age = tuple({STATE: np.linalg.matrix_power(closed, age)} for age in range(oldest + 1))
        return (
            Send(at, node, (STATE,), on, labels),
            Assign(node, model, (self._moved(node, model, signal), *by_age), Received(node, oldest or None)),
            Assign(node, signal, {model: L}),
        ), (
            Assign(at, copy, tuple({STATE: n} if sent else {copy: n} for sent in sends), told),
            Assign(at, f"held_{node}", {copy: L}),
        )


def sets_of(links: tuple[str, ...], worth: Mapping[str, float]) -> tuple[tuple[str, ...], ...]:
    """Return all sets of links that may send. The cheapest set comes first, in the order of a trigger's labels."""
    sets = chain.from_iterable(combinations(links, size) for size in range(len(links) + 1))
    return tuple(sorted(sets, key=lambda sent: sum(worth[link] for link in sent)))


def label(sent: Sequence[str]) -> str:
    """Return the label with which a decision selects the given set of links to send."""
    return " and ".join(sent) or SILENT


def actuators_of(network: Network, plant: Plant) -> dict[str, tuple[str, list[int]]]:
    """Return, for each actuator, the signal that it applies and the indices of its inputs."""
    found = network.applications(plant.inputs)
    return {node: (signal, [*rows]) for signal, (node, rows) in found.items()}


MOST_LINKS = 4  # whose sets are compared
WEIGHTED_RATE = "rate: Σ π_l r_l / Σ π_l with the price π_l of a packet on link l"
ERROR, CANDIDATE, COMMAND, INPUT = "error", "candidate", "command", "input"


def shares_of_prices(network: Network, links: Sequence[str]) -> dict[str, float]:
    """Return the price of a packet on each link, divided by the sum of these prices over all links."""
    prices = {link: network.links[link].price for link in links}
    return {link: price / sum(prices.values()) for link, price in prices.items()}


def expect_few_links(kind: str, links: Sequence[str]) -> None:
    """Raise a ``PlacementError`` if a controller would choose among too many sets of links."""
    if len(links) > MOST_LINKS:
        raise PlacementError(
            f"the policy kind {kind} chooses among the {2 ** len(links)} sets of {len(links)} actuator links; expected "
            f"at most {MOST_LINKS} actuator links"
        )


def decides_on_sets(network: Network) -> bool:
    """Return whether a decision on sets is needed: several actuators have links, or some have one and others none."""
    linked = [node for node in network.actuators if node in network.links]
    return len(linked) > 1 or (bool(linked) and len(linked) < len(network.actuators))


def expect_ideal_sets(network: Network, kind: str, links: Sequence[str]) -> None:
    """Raise a ``PlacementError`` if the controller would decide on sets that contain a link that drops packets."""
    for link in (link for link in links if not network.links[link].ideal):
        law = network.links[link]
        name = "burst" if law.burst is not None else "loss" if law.loss else "acknowledged"
        name = "delay" if law.delay is not None else name
        got = f"{law.loss}" if name == "loss" else "given"
        raise PlacementError(
            f"{network.key(link, name)} is {got}, but the controller of the policy kind {kind} chooses among sets of "
            f"the links {', '.join(links)}; expected ideal links"
        )


@dataclass(frozen=True, eq=False, repr=False)
class JointSets(Displayed):
    """The sets of actuator links that may send at the same time, and the policy steps that decide among these sets."""

    policy: Policy  # a policy of a sensor, a controller and an actuator
    network: Network  # the nodes and links. The steps may have the names of its nodes, the actuator that of any of them

    @cached_property
    def actuators(self) -> Mapping[str, tuple[str, list[int]]]:
        """For each actuator, the signal that it applies and the indices of its inputs."""
        return actuators_of(self.network, self.policy.model)

    @cached_property
    def links(self) -> tuple[str, ...]:
        """Names of the actuators that receive their inputs over a link."""
        return tuple(node for node in self.actuators if node in self.network.links)

    @cached_property
    def weights(self) -> Mapping[str, float]:
        """Price of a packet on each link, divided by the sum of these prices over all links."""
        return shares_of_prices(self.network, self.links)

    @cached_property
    def all(self) -> tuple[tuple[str, ...], ...]:
        """All sets of links that may send, the cheapest set first. The last set contains all links."""
        return sets_of(self.links, self.weights)

    @cached_property
    def decision(self) -> str:
        """Name of the decision whether to send to the actuator; empty if the policy has no such decision with two
        labels.
        """
        on = [step.on for step in self.policy.steps if isinstance(step, Send)]
        made = [step for step in self.policy.steps if isinstance(step, Decide) and [step.decision] == on]
        return made[0].decision if len(made) == 1 and len(made[0].trigger.options) == 2 else ""

    @cached_property
    def partial(self) -> frozenset[str]:
        """Names of the signals that depend on the set of links: ``error``, ``candidate``, and costs of silence that are
        computed from these.
        """
        found = {ERROR, CANDIDATE}
        for step in self.policy.steps:
            if _is_cost(step) and found.intersection(read(step)):
                found.update(assigned(step))
        return frozenset(found)

    @cached_property
    def greedy(self) -> bool:
        """True if not sending costs nothing while the error is zero."""
        silent = next(
            next(iter(step.trigger.options.values()))
            for step in self.policy.steps
            if isinstance(step, Decide) and step.decision == self.decision
        )
        first = {step.signal: step.forms[0] for step in self.policy.steps if isinstance(step, Evaluate)}
        forms = [silent, *(first[name] for name in silent.plus if name in first)]
        return all(self._vanishes(form) for form in forms)

    def _vanishes(self, form: Form) -> bool:
        sizes = [self.policy.sizes[name] for name in form.signals]
        rest = np.repeat([name != ERROR for name in form.signals], sizes)
        values = form.Psi.values if isinstance(form.Psi, Scheduled) else form.Psi
        constant = form.constant.values if isinstance(form.constant, Scheduled) else form.constant
        weighed = values is not None and values[..., rest, :][..., rest].any()
        return not weighed and not np.any(constant) and form.bell is None and self.partial.issuperset(form.plus)

    def check(self) -> None:
        """Raise an error if the controller of this policy cannot decide which set of actuator links sends."""
        kind, listed = self.policy.kind, ", ".join(self.links)
        sends = [step for step in self.policy.steps if isinstance(step, Send)]
        expect_few_links(kind, self.links)
        if any(step.payload != (COMMAND,) for step in sends):
            raise PlacementError(
                f"the packets of the policy kind {kind} carry more than the input, but the controller chooses among "
                f"several links ({listed}); expected actuators that hold their input (actuation = 'hold')"
            )
        if len(sends) != 1 or not self.decision:
            raise PlacementError(
                f"the policy kind {kind} has no single send decision on its actuator link, but several links "
                f"({listed}) need decisions; expected one actuator link"
            )
        identity = self.policy.theory.identity
        if identity is not None and len(identity.forms) > 1 and _weighs(identity.forms[1]):
            raise PlacementError(
                f"the base policy of the policy kind {kind} sends only at some steps, but the controller chooses among "
                f"several links ({listed}); expected every = 1, or one actuator link"
            )

    def named(self, signal: str, sent: Sequence[str]) -> str:
        """Return the name of a signal's value for the case that a set of links sends. For the empty set, it is
        unchanged.
        """
        differs = signal in self.partial and (sent or len(self.links) < len(self.actuators))
        return f"{signal} if {label(sent)}" if differs else signal

    def form(self, form: Form, sent: Sequence[str]) -> Form:
        """Return a form for the case that a set of links sends: it reads the error that remains after these sends."""
        signals = tuple(self.named(name, sent) for name in form.signals)
        plus = {self.named(name, sent): weight for name, weight in form.plus.items()}
        return Form(signals, form.Psi, form.constant, plus, form.bell)

    def silent(self, sent: Sequence[str]) -> Array:
        """Return the diagonal matrix, (m, m), that selects the inputs of the links that do not send."""
        found = np.zeros(self.policy.model.inputs)
        for link in self.links:
            found[self.actuators[link][1]] = link not in sent
        return np.diag(found)

    def of(self, step: Step) -> tuple[Step, ...]:
        """Replace a policy step by those steps that treat, one by one, the sets of links that may send."""
        if isinstance(step, Decide) and step.decision == self.decision:
            return (replace(step, trigger=self._trigger(step.trigger)),)
        if isinstance(step, Send):
            return tuple(found for node in self.actuators for found in self._send(step, node))
        if isinstance(step, Apply) and self.partial.issuperset(step.signals):
            return tuple(
                replace(
                    step,
                    signals={self.named(name, sent): size for name, size in step.signals.items()},
                    reads=tuple(self.named(name, sent) for name in step.reads),
                )
                for sent in self.all[:-1]
            )
        if isinstance(step, Evaluate) and step.signal in self.partial:
            return tuple(
                Evaluate(
                    step.at, self.named(step.signal, sent), tuple(self.form(one, sent) for one in step.forms), step.on
                )
                for sent in self.all[:-1]
            )
        if not isinstance(step, Assign):
            return (step,)
        if step.signal == INPUT:
            return tuple(self._receive(step, node) for node in self.actuators)
        if step.on == self.decision:
            return (self._copied(step),)
        return (step, *self._errors(step)) if step.signal == ERROR else (step,)

    def theory(self, theory: Theory) -> Theory:
        """Convert the theory of the policy, in which one link decides, to decisions on sets of links."""
        identity, guarantee = theory.identity, theory.guarantee
        if identity is not None and identity.on is not None:
            forms = (*(self.form(identity.forms[0], sent) for sent in self.all[:-1]), Form())
            identity = replace(identity, forms=forms)
        if guarantee is not None and guarantee.base is not None:
            statement = f"{guarantee.statement}; {WEIGHTED_RATE}"
            guarantee = replace(guarantee, statement=statement, weights=self.weights)
        functions = theory.functions | {self.named(name, sent) for name in theory.functions for sent in self.all}
        return replace(
            theory, identity=identity, guarantee=guarantee, reset=None, periodic=None, functions=frozenset(functions)
        )

    def _trigger(self, trigger: Trigger) -> Trigger:
        silent, price = trigger.options.values()
        options = {label(sent): self.form(silent, sent) for sent in self.all[:-1]}
        last = label(self.all[-1])
        limit = price.constant
        if not self.greedy:
            if isinstance(limit, Scheduled):
                raise ProblemError(
                    f"the threshold of the policy {self.policy.kind} depends on the {limit.by}; expected one actuator "
                    "link"
                )
            return Trigger({**options, last: Form()}, limit)
        for sent in self.all[1:-1]:
            share = sum(self.weights[link] for link in sent)
            part = Scheduled(limit.by, share * limit.values) if isinstance(limit, Scheduled) else share * limit
            form = options[label(sent)]
            added = part if isinstance(part, Scheduled) else part + _number(form.constant)
            options[label(sent)] = Form(form.signals, form.Psi, added, form.plus, form.bell)
        return Trigger({**options, last: price})

    def _errors(self, step: Assign) -> tuple[Step, ...]:
        """Return the error and the input of the plant for each set that leaves some links silent."""
        found = list[Step]()
        unit = np.eye(step.size)
        for sent in (one for one in self.all[:-1] if self.named(ERROR, one) != ERROR):
            silent = self.silent(sent)
            found.append(Assign(step.at, self.named(ERROR, sent), {ERROR: silent}))
            if any(
                CANDIDATE in read(other) for other in self.policy.steps if isinstance(other, Decide) or _is_cost(other)
            ):
                found.append(Assign(step.at, self.named(CANDIDATE, sent), {CANDIDATE: silent, COMMAND: unit - silent}))
        return tuple(found)

    def _send(self, step: Send, node: str) -> tuple[Step, ...]:
        _, rows = self.actuators[node]
        part = Assign(step.at, f"{COMMAND}_{node}", {COMMAND: np.eye(self.policy.model.inputs)[rows]})
        if node not in self.links:
            return (part,)
        labels = tuple(label(sent) for sent in self.all if node in sent)
        return (part, Send(step.at, node, (f"{COMMAND}_{node}",), step.on, labels))

    def _receive(self, step: Assign, node: str) -> Step:
        signal, rows = self.actuators[node]
        command = {f"{COMMAND}_{node}": np.eye(len(rows))}
        if node not in self.links:
            return Assign(node, signal, command)
        kept = step.branches[0][INPUT]
        assert not isinstance(kept, Scheduled)
        return Assign(node, signal, ({signal: kept[np.ix_(rows, rows)]}, command), Received(node))

    def _copied(self, step: Assign) -> Step:
        """Return the controller's copy of the inputs: the commands that are sent, and the old inputs of other links."""
        unit, branches = np.eye(self.policy.model.inputs), list[dict[str, Array]]()
        for sent in self.all:
            silent, terms = self.silent(sent), dict[str, Array]()
            for rows, branch in zip((silent, unit - silent), step.branches, strict=True):
                for name, matrix in branch.items():
                    assert not isinstance(matrix, Scheduled)
                    terms[name] = terms.get(name, 0.0 * matrix) + rows @ matrix
            branches.append(terms)
        return Assign(step.at, step.signal, tuple(branches), step.on)


def _is_cost(step: Step) -> bool:
    """Return whether a policy step computes a cost that forms of a decision may read."""
    return isinstance(step, Evaluate) or (isinstance(step, Apply) and isinstance(step.function, LimitedSilence))


def _number(value: float | Scheduled) -> float:
    return 0.0 if isinstance(value, Scheduled) else value


def _weighs(form: Form) -> bool:
    return form.Psi is not None or bool(form.plus) or bool(np.any(_number(form.constant)))
