"""The Kalman filter of several sensors as a sum of contributions, one from each sensor and one from the inputs.

With Ω = (I − GC)A, the estimate is x̂ = ξ⁰ + Σ ξˢ, ξˢ⁺ = Ωξˢ + G_s y_s at sensor s, and ξ⁰⁺ = Ωξ⁰ + (I − GC)Bu at the
controller. The controller uses a copy of ξˢ, of which sensor s runs a duplicate. In the names of signals, ``part`` is
the contribution of a sensor, ``copy`` the sensor's duplicate, ``used`` the controller's copy, and ``own`` is ξ⁰.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taciturn._arrays import Array, Bits
from taciturn._display import Displayed
from taciturn.design.certainty import Actuation, CertaintyEquivalentDesign
from taciturn.design.estimation import ESTIMATE, SEND
from taciturn.lqg.kalman import resting_states, steady_filter
from taciturn.lqg.silence import Apart
from taciturn.model.network import Network
from taciturn.model.plant import Plant
from taciturn.model.policy import Acknowledged, Assign, Condition, Decide, Received, Send, Step, Terms
from taciturn.model.theory import Innovations
from taciturn.model.trigger import Form, Trigger

SILENT, STATE = "silent", "state"
REMEMBERED = 0.999  # factor per step of a disturbance that one sensor does not see, in its filter
SHOWN = 1e-6  # relative size of the effect of a disturbance on outputs that counts as none


@dataclass(frozen=True, eq=False, repr=False)
class ContributionSteps(Displayed):
    """The policy steps of sensors that decide when to send their contribution, and of the controller that adds them.

    Args:
        certainty: regulator and filter of all measurements.
        network: the nodes and links; a sensor without a link is at the controller's place.
        prediction: what both ends of a link assume in silence: ``"hold"`` no further measurement, ``"model"`` the
            measurements that a model predicts from the last packet.
        thresholds: δ_l by group of links that are decided together; each sensor is a group.
    """

    certainty: CertaintyEquivalentDesign
    network: Network
    prediction: Actuation
    thresholds: Mapping[tuple[str, ...], float]

    def measure(self) -> tuple[Step, ...]:
        """Return the steps of the sensors."""
        return tuple(step for node in self._remote for step in self._sensor(node))

    def add(self) -> tuple[Step, ...]:
        """Return the steps by which the controller adds its copies to ``state``, the estimate that it acts on."""
        at, n = self.network.controller, np.eye(self._plant.states)
        local = {signal: gain for node, (signal, gain, _) in self._sensors.items() if node not in self._remote}
        return (
            Assign(at, "own", {"prior": self._left, **local}),
            *(step for node in self._remote for step in self._receive(node)),
            Assign(at, STATE, {"own": n, **{f"used_{node}": n for node in self._remote}}),
        )

    def predict(self, held: Mapping[str, Array]) -> tuple[Step, ...]:
        """Return the steps after all inputs are known, as a sum ``held`` of the controller's signals."""
        moved = {name: self._plant.B @ columns for name, columns in held.items()}
        return (Assign(self.network.controller, "prior", {"own": self._plant.A, **moved}),)

    @property
    def apart(self) -> Apart:
        """The sensors that filter at another place than the controller."""
        return Apart([self._sensors[node][2] for node in self._remote], self._left, self._left @ self._plant.A)

    @property
    def initial(self) -> dict[str, Array]:
        """The initial values of the memories: models start at the mean of the initial state, as the estimate."""
        mean = self._plant.mean
        models = ("local", "copy_model", "used_model") if self.prediction == "model" and mean.any() else ()
        return {"prior": mean, **{f"{name}_{node}": mean for name in models for node in self._remote}}

    @property
    def estimate(self) -> Terms:
        """The estimate of the filter of all measurements, as a sum of signals of all nodes."""
        n = np.eye(self._plant.states)
        return {"own": n, **{f"part_{node}": n for node in self._remote}}

    def innovations(self) -> Innovations:
        """Return the white innovations of the filter of all measurements, which no node computes."""
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
        """The factor I − GC from the prior estimate to the posterior one."""
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
        return (
            *self._silent(node, at, "used", expected),
            *self._updated(node, at, "used", expected, Received(node)),
        )

    def _silent(self, node: str, at: str, copy: str, expected: str) -> tuple[Step, ...]:
        """Return the steps of one end of a link that compute the sensor's contribution as if it were silent."""
        decayed = {f"{copy}_{node}": self._left @ self._plant.A}
        if self.prediction == "hold":
            return (Assign(at, expected, decayed),)
        _, gain, outputs = self._sensors[node]
        model = f"{copy}_model_{node}"
        return (
            Assign(at, model, {model: closed_loop(self.certainty)}),
            Assign(at, expected, {**decayed, model: gain @ self._plant.C[outputs]}),
        )

    def _updated(self, node: str, at: str, copy: str, expected: str, on: Condition) -> tuple[Step, ...]:
        """Return the steps of one end of a link that set the copy, and its model, to those of a packet."""
        n, model = np.eye(self._plant.states), f"{copy}_model_{node}"
        steps = (Assign(at, f"{copy}_{node}", ({expected: n}, {f"part_{node}": n}), on),)
        if self.prediction == "hold":
            return steps
        return (*steps, Assign(at, model, ({model: n}, {f"local_{node}": n}), on))

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
    """Return the matrix A + BL of the loop that sends every sample."""
    return certainty.problem.plant.A + certainty.problem.plant.B @ certainty.regulator.L


def known(network: Network, link: str, on: str) -> Condition:
    """Return the condition by which the sender knows whether the receiver has its packet."""
    return Acknowledged(link) if network.acknowledges(link) else on


def decision(group: tuple[str, ...]) -> str:
    """Return the name of the decision on a group of links."""
    return "_".join((SEND, *group))
