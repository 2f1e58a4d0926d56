"""Policies on several nodes: ``distributed``, dead bands on every link, and ``variance``.

The estimate of the filter of everything is a sum x̂ = ξ⁰ + Σ ξˢ. Sensor s computes ξˢ⁺ = Ωξˢ + G_s y_s, Ω = (I − GC)A,
and the controller ξ⁰⁺ = Ωξ⁰ + (I − GC)B u. Both ends of a link keep a copy of what was sent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from everything.laws import Channel, Law, Nodes
from everything.plain import Array, Model, NotModelledError, kalman, measure_update
from everything.policies import Certainty, quadratic

Tables = Mapping[str, Any]


@dataclass
class Sensor:
    """A sensor: its outputs, gain and law; its contribution, the sender's copy, the receiver's, and their models."""

    outputs: list[int]
    gain: Array
    law: Law | None
    delta: float
    own_gain: Array | None = None


class Distributed:
    """The kind ``distributed``."""

    def __init__(
        self, tables: Tables, model: Model, nodes: Nodes, all_time: float | None, always: bool = False
    ) -> None:
        """Design filter, gains and thresholds."""
        policy = tables["policy"]
        base = Certainty(model, None)
        if model.V is None:
            raise NotModelledError("distributed with a measured state")
        if not model.average:
            raise NotModelledError("distributed over a horizon")
        self.model, self.base, self.always, self.nodes = model, base, always, nodes
        self.G, self.L, self.H = base.gains[0], base.L, base.H
        self.left = np.eye(len(model.A)) - self.G @ model.C
        self.Omega = self.left @ model.A
        self.radius = base.radius
        if not nodes.lossy:
            all_time = base.nominal if base.exact is None else base.exact
        elif all_time is None:
            raise NotModelledError("what an attempt of every packet costs")
        else:
            all_time *= model.seconds
        self.exact = all_time if always and model.function is None else None
        total = policy["delta"] if "delta" in policy else policy["theta"] * (all_time - model.rest)
        links = list(nodes.laws)
        share = {link: float(policy.get("shares", {}).get(link, 1.0)) for link in links}
        whole = sum(share.values())
        delta = {link: (share[link] / whole) ** 2 * total for link in links}
        self.predicts, self.models = (policy.get(key, "hold") == "model" for key in ("prediction", "actuation"))
        if self.predicts and model.q + model.s:
            raise NotModelledError("predicted probes with disturbances")
        self.sensors = {
            name: Sensor(rows, self.G[:, rows], nodes.laws.get(name), delta.get(name, 0.0), self._local(rows))
            for name, rows in nodes.sensors.items()
        }
        self.actuators = {name: (cols, nodes.laws.get(name), delta.get(name, 0.0))
                          for name, cols in nodes.actuators.items()}  # fmt: skip
        self.joint = policy.get("joint", False)
        if self.joint and any(law.limited for law in nodes.laws.values()):
            raise NotModelledError("intervals of joint decisions")

    def _local(self, rows: list[int]) -> Array | None:
        """Return the gain of a sensor's own filter of x⁺ = (A + BL)x + noise."""
        if not self.predicts:
            return None
        model = self.model
        F = model.A + model.B @ self.L
        push = model.B @ self.L
        assert model.V is not None
        return kalman(F, model.C[rows], model.W + push @ self.base.Sigma @ push.T, model.V[np.ix_(rows, rows)])[0]

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        size = len(self.model.A)
        zero = np.zeros((paths, size))
        self.told = np.zeros((paths, self.model.s))
        self.xi0, self.held = zero.copy(), np.zeros((paths, self.model.m))
        self.xi = {name: zero.copy() for name in self.sensors}
        self.sent = {name: zero.copy() for name in self.sensors}  # the sender's copy
        self.got = {name: zero.copy() for name in self.sensors}  # the receiver's
        self.local = {name: zero.copy() for name in self.sensors}  # estimate of the sensor alone
        self.sent_model = {name: zero.copy() for name in self.sensors}
        self.got_model = {name: zero.copy() for name in self.sensors}
        self.actuator_model = {name: zero.copy() for name in self.actuators}
        self.believed_model = {name: zero.copy() for name in self.actuators}
        self.believed = self.held.copy()
        self.channels = {name: Channel(law, paths, rng) for name, law in self.nodes.laws.items()}

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Sensors measure, decide and send; then the controller; then the actuators apply."""
        model = self.model
        closed = model.A + model.B @ self.L
        flags: dict[str, Array] = {}
        self.xi0 += (r - self.told) @ self.left[:, model.known].T  # the prior contains what is told
        self.told = r
        estimate = self.xi0.copy()
        for name, one in self.sensors.items():
            self.xi[name] = self.xi[name] @ self.Omega.T + y[:, one.outputs] @ one.gain.T
            if one.law is None:
                estimate += self.xi[name]
                continue
            for copies, models in ((self.sent, self.sent_model), (self.got, self.got_model)):
                models[name] = models[name] @ closed.T
                copies[name] = copies[name] @ self.Omega.T
                if self.predicts:
                    copies[name] += models[name] @ (one.gain @ model.C[one.outputs]).T
            if one.own_gain is not None:
                prior = self.local[name] @ closed.T
                seen = y[:, one.outputs] - prior @ model.C[one.outputs].T
                self.local[name] = prior + seen @ one.own_gain.T
            error = self.xi[name] - self.sent[name]
            wants = quadratic(error @ self.L.T, self.H) > one.delta
            sends = self._sends(name, wants)
            arrived = self.channels[name].arrives(sends)
            flags[name] = sends.astype(float)
            known = arrived if one.law.acknowledged else sends
            for copies, models, which in ((self.sent, self.sent_model, known), (self.got, self.got_model, arrived)):
                copies[name] = np.where(which[:, None], self.xi[name], copies[name])
                models[name] = np.where(which[:, None], self.local[name], models[name])
            estimate += self.got[name]
        command = estimate @ self.L.T
        silent = self.believed.copy()
        real = self.held.copy()
        for name, (cols, law, _) in self.actuators.items():
            if law is not None and self.models:
                silent[:, cols] = (self.believed_model[name] @ self.L.T)[:, cols]
                real[:, cols] = (self.actuator_model[name] @ self.L.T)[:, cols]
        error = silent - command
        decided = self._joint(error) if self.joint else {
            name: quadratic(error[:, cols], self.H[np.ix_(cols, cols)]) > delta
            for name, (cols, law, delta) in self.actuators.items() if law is not None
        }  # fmt: skip
        applied, believed = real.copy(), silent.copy()
        for name, (cols, law, _) in self.actuators.items():
            if law is None:
                applied[:, cols] = believed[:, cols] = command[:, cols]
                continue
            sends = self._sends(name, decided[name])
            arrived = self.channels[name].arrives(sends)
            flags[name] = sends.astype(float)
            known = arrived if law.acknowledged else sends
            applied[:, cols] = np.where(arrived[:, None], command[:, cols], real[:, cols])
            believed[:, cols] = np.where(known[:, None], command[:, cols], silent[:, cols])
            for models, which in ((self.actuator_model, arrived), (self.believed_model, known)):
                models[name] = np.where(which[:, None], estimate, models[name]) @ closed.T
        self.held, self.believed = applied, believed
        self.xi0 = self.xi0 @ self.Omega.T + believed @ (self.left @ model.B).T
        return applied, flags

    def _sends(self, name: str, wants: Array) -> Array:
        return np.ones_like(wants) if self.always else self.channels[name].allowed(wants)

    def _joint(self, error: Array) -> dict[str, Array]:
        """Return the cheapest set of packets that leaves an error of at most δ_A."""
        linked = {name: (cols, law.price) for name, (cols, law, _) in self.actuators.items() if law is not None}
        limit = sum(np.sqrt(delta) for _, law, delta in self.actuators.values() if law is not None) ** 2
        sets = [one for count in range(len(linked) + 1) for one in combinations(linked, count)]
        sets.sort(key=lambda one: sum(linked[name][1] for name in one))
        done = np.zeros(len(error), dtype=bool)
        chosen = {name: np.zeros(len(error), dtype=bool) for name in linked}
        for one in sets:
            left = error.copy()
            for name in self.actuators:
                if name in one or name not in linked:
                    left[:, self.actuators[name][0]] = 0.0
            here = ~done & ((quadratic(left, self.H) <= limit) | (len(one) == len(linked)))
            for name in one:
                chosen[name] |= here
            done |= here
        return chosen


class Bands:
    """Dead bands on every link: ``send-on-delta``, with the filter of all outputs as if they were measured, or kept."""

    def __init__(self, tables: Tables, model: Model, nodes: Nodes) -> None:
        """Design the filter with the variance Δ²/3 of what was not sent."""
        from everything.kept import given_of

        policy = tables["policy"]
        self.model, self.nodes, self.exact = model, nodes, None
        if not model.average:
            raise NotModelledError("send-on-delta over a horizon")
        shares = {link: float(policy.get("shares", {}).get(link, 1.0)) for link in nodes.laws}
        link = policy.get("link", "sensor")
        self.laws = dict(nodes.laws) if nodes.named else {link: nodes.laws[link]}
        self.band = {name: policy["delta"] * shares.get(name, 1.0) for name in self.laws}
        self.given = None
        if "controller" in tables:
            self.given = given_of(tables, model, model.seconds if model.continuous else float(tables["plant"]["dt"]))
            if self.given.deviation is not None:
                raise NotModelledError("a slow disturbance at named nodes")
            return
        p = len(model.C)
        V = np.zeros((p, p)) if model.V is None else model.V.copy()
        for name, rows in nodes.sensors.items():
            if name in self.laws:
                V[rows, rows] += self.band[name] ** 2 / 3
        self.L = Certainty(model, None).L
        self.G = np.zeros((len(model.A), p))
        free = np.arange(len(model.A)) < model.known.start
        pick = np.flatnonzero(free)
        self.G[pick] = kalman(model.A[np.ix_(pick, pick)], model.C[:, pick], model.W[np.ix_(pick, pick)], V)[0]

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        model = self.model
        self.last = np.zeros((paths, len(model.C)))
        self.heard, self.held = self.last.copy(), np.zeros((paths, model.m))
        self.thought = self.held.copy()
        self.prior = np.zeros((paths, len(model.A)))
        self.c = np.zeros((paths, 0 if self.given is None else len(self.given.A)))
        self.channels = {name: Channel(law, paths, rng) for name, law in self.laws.items()}

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Sensors compare with what they sent last; then the controller does so."""
        model, flags = self.model, {}
        heard = y.copy()
        for name, rows in self.nodes.sensors.items():
            if name not in self.laws:
                continue
            channel, law = self.channels[name], self.laws[name]
            sends = channel.allowed((np.abs(y[:, rows] - self.last[:, rows]) > self.band[name]).any(axis=1))
            arrived = channel.arrives(sends)
            flags[name] = sends.astype(float)
            known = arrived if law.acknowledged else sends
            self.last[:, rows] = np.where(known[:, None], y[:, rows], self.last[:, rows])
            self.heard[:, rows] = np.where(arrived[:, None], y[:, rows], self.heard[:, rows])
            heard[:, rows] = self.heard[:, rows]
        if self.given is not None:
            command = self.c @ self.given.C.T + heard @ self.given.D.T
            estimate = self.prior
        else:
            if model.s:
                self.prior[:, model.known] = r
            estimate = self.prior + (heard - self.prior @ model.C.T) @ self.G.T
            command = estimate @ self.L.T
        applied = command.copy()
        for name, cols in self.nodes.actuators.items():
            if name not in self.laws:
                continue
            channel = self.channels[name]
            sends = channel.allowed((np.abs(command[:, cols] - self.held[:, cols]) > self.band[name]).any(axis=1))
            channel.arrives(sends)
            flags[name] = sends.astype(float)
            applied[:, cols] = np.where(sends[:, None], command[:, cols], self.held[:, cols])
        self.held = applied
        if self.given is not None:
            self.c = self.c @ self.given.A.T + heard @ self.given.B.T + applied @ self.given.E.T
        else:
            self.prior = estimate @ model.A.T + applied @ model.B.T
        return applied, flags


class Variances:
    """The kind ``variance``: outputs are sent where their predicted variance exceeds a threshold."""

    def __init__(self, tables: Tables, model: Model, nodes: Nodes) -> None:
        """Begin with the covariance of the prediction from all measurements."""
        self.model, self.exact = model, None
        self.threshold = tables["policy"]["threshold"]
        if model.V is None and model.q + model.s:
            raise NotModelledError("variance with disturbances")
        if not model.average:
            raise NotModelledError("variance over a horizon")
        self.sensors = {name: (rows, nodes.laws.get(name)) for name, rows in nodes.sensors.items()}
        if any(law is not None and law.limited for _, law in self.sensors.values()):
            raise NotModelledError("intervals of a schedule")
        self.pick = np.flatnonzero(np.arange(len(model.A)) < model.known.start)
        p = len(model.C)
        self.V = np.zeros((p, p)) if model.V is None else model.V
        self.A, self.W = (one[np.ix_(self.pick, self.pick)] for one in (model.A, model.W))
        self.C = model.C[:, self.pick]
        self.first = self.W if model.whole else kalman(self.A, self.C, self.W, self.V)[1]
        self.L = Certainty(model, None).L

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        self.prior, self.covariance = np.zeros((paths, len(self.model.A))), self.first

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Send by the schedule."""
        model, flags = self.model, {}
        spread = np.diag(self.C @ self.covariance @ self.C.T)
        received: list[int] = []
        for name, (rows, law) in self.sensors.items():
            sends = law is None or bool((spread[rows] > self.threshold * (1 + 1e-12)).any())
            received += rows if sends else []
            if law is not None:
                flags[name] = np.full(len(y), float(sends))
        received.sort()
        after = self.covariance
        estimate = self.prior
        if model.s:
            estimate[:, model.known] = r
        if received:
            gain, after = measure_update(self.covariance, self.C[received], self.V[np.ix_(received, received)])
            whole = np.zeros((len(model.A), len(received)))
            whole[self.pick] = gain
            estimate = estimate + (y[:, received] - estimate @ model.C[received].T) @ whole.T
        u = estimate @ self.L.T
        self.prior = estimate @ model.A.T + u @ model.B.T
        self.covariance = self.A @ after @ self.A.T + self.W
        return u, flags


def on_every_path(tables: Tables) -> bool:
    """Tell whether the bound of ``distributed`` holds on every path, and not in the mean."""
    return "controller" in tables or tables["policy"].get("guarantee") == "every path"


def node_policy(tables: Tables, model: Model, nodes: Nodes, all_time: float | None) -> tuple[Any, Any]:
    """Return the policy of a file, and its twin that sends every sample."""
    kind = tables["policy"]["kind"]
    if model.limited:
        raise NotModelledError("limits of the inputs")
    if kind == "distributed" and on_every_path(tables):
        from everything.every_path import every_path_policy

        return every_path_policy(tables, model, nodes, all_time)
    if kind == "distributed":
        return Distributed(tables, model, nodes, all_time), Distributed(tables, model, nodes, all_time, always=True)
    base = Certainty(model, None)
    if kind == "variance":
        return Variances(tables, model, nodes), base
    if not nodes.named and ("controller" in tables or tables["policy"].get("link") == "actuator"):
        raise NotModelledError("dead bands of a controller of the triangle")
    base.alike = model.loads is None  # every sample of its filter costs more under loads that no filter knows
    return Bands(tables, model, nodes), base if "controller" not in tables else None
