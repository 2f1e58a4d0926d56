"""Inputs over several actuator links: the controller decides for each link, or chooses the cheapest set of packets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, combinations

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.design.certainty import Actuation, CertaintyEquivalentDesign
from taciturn.design.contributions import SILENT, STATE, closed_loop, decision, known
from taciturn.design.estimation import SEND
from taciturn.model.network import Network
from taciturn.model.policy import Acknowledged, Assign, Decide, Received, Send, Step
from taciturn.model.trigger import Form, Trigger


@dataclass(frozen=True, eq=False, repr=False)
class InputSteps(Displayed):
    """The policy steps from the estimate ``state`` at the controller to the inputs of the actuators.

    In the names of signals, ``held`` is the controller's copy of the input that an actuator applies, and ``error`` the
    difference between the input in silence and the command Lx̃.

    Args:
        certainty: the regulator.
        network: the nodes and links; an actuator without a link is at the controller's place.
        actuation: what an actuator applies in silence: ``"hold"`` its last input, ``"model"`` the input of a simulation
            x̃⁺ = (A + BL)x̃ from the last packet.
        thresholds: δ_l by group of links that are decided together.
    """

    certainty: CertaintyEquivalentDesign
    network: Network
    actuation: Actuation
    thresholds: Mapping[tuple[str, ...], float]

    def decide(self) -> tuple[Step, ...]:
        """Return the steps of the controller's decisions, and of the actuators."""
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
        """The input of the plant as a sum of signals at the controller."""
        unit = np.eye(self.certainty.problem.plant.inputs)
        return {f"held_{node}": unit[:, rows] for node, (_, rows) in self._actuators.items()}

    @cached_property
    def _actuators(self) -> Mapping[str, tuple[str, list[int]]]:
        """The signal and the indices of the inputs that an actuator applies, by node."""
        found = self.network.applications(self.certainty.problem.plant.inputs)
        return {node: (signal, [*inputs]) for signal, (node, inputs) in found.items()}

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
        options = {
            _label(sent): self._error([node for node in group if node not in sent]) for sent in self._sets(group)
        }
        return Decide(at, decision(group), Trigger(options, limit))

    def _error(self, silent: Sequence[str]) -> Form:
        """Return the cost of the errors of silent actuators."""
        rows = [row for node in silent for row in self._actuators[node][1]]
        H = self.certainty.regulator.H[np.ix_(rows, rows)]
        return Form(tuple(f"error_{node}" for node in silent), H) if rows else Form()

    def _sets(self, group: tuple[str, ...]) -> list[tuple[str, ...]]:
        """Return the sets of packets in the order of the trigger's labels: the cheapest first."""
        sets = chain.from_iterable(combinations(group, size) for size in range(len(group) + 1))
        return sorted(sets, key=lambda sent: sum(self.network.links[link].price for link in sent))

    def _send(self, node: str, group: tuple[str, ...]) -> tuple[tuple[Step, ...], tuple[Step, ...]]:
        """Return the steps that send to an actuator and apply its input, and those that copy it at the controller."""
        at, (signal, rows), on = self.network.controller, self._actuators[node], decision(group)
        sends = [node in sent for sent in self._sets(group)]
        labels = tuple(_label(sent) for sent in self._sets(group) if node in sent) if len(group) > 1 else ()
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
        return (
            Send(at, node, (STATE,), on, labels),
            Assign(node, model, (self._moved(node, model, signal), {STATE: n}), Received(node)),
            Assign(node, signal, {model: L}),
        ), (
            Assign(at, copy, tuple({STATE: n} if sent else {copy: n} for sent in sends), told),
            Assign(at, f"held_{node}", {copy: L}),
        )


def _label(sent: tuple[str, ...]) -> str:
    """Return the label of a set of packets."""
    return " and ".join(sent) or SILENT
