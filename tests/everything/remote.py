"""Remote sensing (``remote-lqg``) and links that drop packets (``lossy-lqg``)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from everything.laws import Channel, Nodes
from everything.plain import Array, Model, NotModelledError, kalman, measure_update, regulator, riccati
from everything.policies import quadratic

Tables = Mapping[str, Any]


class Remote:
    """A measurement of step k reaches the control of step k + 1; queries by the value of a measurement."""

    def __init__(self, tables: Tables, model: Model, nodes: Nodes) -> None:
        """Design gains, and the schedule as far as it is needed."""
        policy = tables["policy"]
        if model.q + model.s and not model.average:
            raise NotModelledError("disturbances or set-points of remote-lqg in a total")
        if model.changes.levels is not None or model.changes.root is not None:
            raise NotModelledError("remote-lqg with changing set-points")
        if model.limited:
            raise NotModelledError("limits of the inputs")
        self.model, self.exact = model, None
        self.place = policy.get("controller", "remote")
        self.theta, self.zeta = policy.get("theta"), policy.get("zeta")
        self.laws = nodes.laws
        if any(law.limited for law in self.laws.values()):
            raise NotModelledError("intervals of remote-lqg")
        p = len(model.C)
        self.V = np.zeros((p, p)) if model.V is None else model.V
        alpha, n = model.discount, model.n
        A, B = model.A[:n, :n], model.B[:n]
        if model.horizon is not None:
            K, self.K = model.terminal, [model.terminal]
            for _ in range(model.horizon):
                K = riccati(A, B, model.Q, model.R, model.N, K)[0]
                self.K.insert(0, K)
        else:
            self.K = [regulator(A, B, model.Q, model.R, model.N, alpha)[0]]
        self.T = np.hstack([np.eye(n), -model.X])  # maps z = (x, d, r) to the deviation x − X (d, r)
        off = np.vstack([self.T, np.hstack([np.zeros((model.m, n)), -model.U])])  # and u, if it is 0
        self.doubted = off.T @ np.block([[model.Q, model.N], [model.N.T, model.R]]) @ off
        self.L, self.H = [], []
        for after in self.K[1:] or self.K:
            _, H, L = riccati(A, B, model.Q, model.R, model.N, after, alpha)
            self.L.append(np.hstack([L, model.U - L @ model.X]))
            self.H.append(H)
        self.P = [L.T @ H @ L for L, H in zip(self.L, self.H, strict=True)]
        self.Sigma0 = model.covariance
        if model.average:  # set-points are known
            self.Sigma0 = np.zeros_like(model.A)
            free = np.ix_(*2 * (np.arange(model.known.start),))
            self.Sigma0[free] = kalman(model.A[free], model.C[:, : model.known.start], model.W[free], self.V)[1]
        self.queried: dict[bytes, bool] = {}

    def at(self, values: list[Array], k: int) -> Array:
        """Return the matrix of a step."""
        return values[min(k, len(values) - 1)]

    def silent(self, S: Array) -> Array:
        """Return the covariance after a step without a measurement."""
        return self.model.A @ S @ self.model.A.T + self.model.W

    def read(self, S: Array) -> Array:
        """Return the covariance after a step with a measurement."""
        return self.silent(measure_update(S, self.model.C, self.V)[1])

    def value(self, S: Array, k: int) -> float:
        """Return the value of a measurement now."""
        X, Y, total, alpha = self.silent(S), self.read(S), 0.0, self.model.discount
        last = self.model.horizon - 1 - k if self.model.horizon is not None else 20_000
        for s in range(last):
            P = self.at(self.P, k + 1 + s) if self.model.horizon is not None else self.P[0]
            term = (
                alpha ** (s + 1) * float(np.trace(P @ (X - Y)))
                if self.model.horizon is None
                else float(np.trace(P @ (X - Y)))
            )
            total += term
            if self.model.horizon is None and abs(term) <= 1e-15 * abs(total):
                break
            X, Y = self.read(X), self.read(Y)
        return total

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        model = self.model
        self.estimate, self.held = np.zeros((paths, len(model.A))), np.zeros((paths, model.m))
        if not model.average:
            self.estimate += model.mean
        self.estimate[:, model.known] = model.value
        self.S = self.Sigma0

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Decide on the input, then on the query."""
        model, flags = self.model, {}
        L, H = self.at(self.L, k), self.at(self.H, k)
        command = self.estimate @ L.T
        if self.place == "actuator":
            u = command
        else:
            e, x = self.held - command, self.estimate @ self.T.T
            u = self.held - self.estimate[:, model.n :] @ model.U.T
            share = quadratic(x, model.Q) + quadratic(u, model.R) + 2 * np.einsum("pi,ij,pj->p", x, model.N, u)
            trigger = (1 + self.theta) * quadratic(e, H) - self.theta * share
            sends = trigger > self.theta * np.trace(self.doubted @ self.S)
            u = np.where(sends[:, None], command, self.held)
            flags["actuator"] = sends.astype(float)
        query = True
        if self.place != "sensor":
            key = np.round(self.S, 12).tobytes() + (k.to_bytes(4, "little") if model.horizon is not None else b"")
            if key not in self.queried:
                self.queried[key] = self.value(self.S, k) > self.zeta * (1 + 1e-12)
            query = self.queried[key]
            flags["sensor"] = np.full(len(y), float(query))
        if query:
            gain, after = measure_update(self.S, model.C, self.V)
            self.estimate = self.estimate + (y - self.estimate @ model.C.T) @ gain.T
        else:
            after = self.S
        self.estimate = self.estimate @ model.A.T + u @ model.B.T
        self.S, self.held = model.A @ after @ model.A.T + model.W, u
        return u, flags


class Lossy:
    """An input over lossy links, zero in silence; the sensor sends its state at every step."""

    def __init__(self, tables: Tables, model: Model, nodes: Nodes) -> None:
        """Compute gains and triggers."""
        if model.V is not None or model.limited:
            raise NotModelledError("lossy-lqg with outputs or limits")
        self.model, self.exact, self.price = model, None, tables["policy"]["price"]
        self.laws, self.delayed = nodes.laws, nodes.delay == 1
        self.names = ("sensor", "actuator")
        if nodes.named:
            if len(nodes.sensors) != 1 or len(nodes.actuators) != 1 or len(nodes.laws) != 2:
                raise NotModelledError("several links of lossy-lqg")
            self.names = (next(iter(nodes.sensors)), next(iter(nodes.actuators)))
        sensor, actuator = (self.laws[name] for name in self.names)
        if sensor.limited:
            raise NotModelledError("intervals of every step")
        a, b = actuator.loss, sensor.loss
        self.told = actuator.acknowledged
        phi = 1.0 if self.delayed else b
        self.share = 1 - a
        A, B = model.A, model.B
        K, P = (model.Q if model.horizon is None else model.terminal), np.zeros_like(model.Q)
        self.L: list[Array] = []
        self.Gamma: list[Array] = []
        for _ in range(model.horizon or 100_000):
            M = model.R + B.T @ (K + (0.0 if self.told else a * phi) * P) @ B
            inverse = np.linalg.pinv(M)  # the first M is zero if inputs cost nothing and act late
            L = -inverse @ B.T @ K @ A
            Gamma = (1 - a) * A.T @ K @ B @ inverse @ B.T @ K @ A
            new = model.Q + A.T @ K @ A - Gamma, Gamma + b * A.T @ P @ A
            settled = np.abs(new[0] - K).max() + np.abs(new[1] - P).max() <= 1e-13 * np.abs(new[0]).max()
            K, P = new
            self.L.insert(0, L)
            self.Gamma.insert(0, Gamma)
            if model.horizon is None:
                del self.L[1:], self.Gamma[1:]
                if settled:
                    break
        else:
            if model.horizon is None:
                raise NotModelledError("losses that are too frequent")

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        model = self.model
        mean = model.mean if not model.average else np.zeros(model.n)
        self.prior = np.tile(mean, (paths, 1))
        self.channels = [Channel(self.laws[name], paths, rng) for name in self.names]
        self.u, self.after = np.zeros((paths, model.m)), self.prior

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Measure, decide, apply zero in silence."""
        model = self.model
        L, Gamma = (values[min(k, len(values) - 1)] for values in (self.L, self.Gamma))
        got = self.channels[0].arrives(np.ones(len(y), dtype=bool))
        estimate = self.prior if self.delayed else np.where(got[:, None], y, self.prior)
        sends = self.channels[1].allowed(quadratic(estimate, Gamma) > self.price)
        arrived = self.channels[1].arrives(sends)
        command = estimate @ L.T
        applied = np.where(arrived[:, None], command, 0.0)
        thought = applied if self.told else self.share * np.where(sends[:, None], command, 0.0)
        now = np.where(got[:, None], y, estimate) if self.delayed else estimate
        self.prior = now @ model.A.T + thought @ model.B.T
        return applied, {self.names[1]: sends.astype(float)}


def remote_policy(tables: Tables, model: Model, nodes: Nodes) -> tuple[Any, Any]:
    """Return the policy of a file; there is no twin."""
    if tables["policy"]["kind"] == "remote-lqg":
        if nodes.named:
            raise NotModelledError("named nodes of remote-lqg")
        return Remote(tables, model, nodes), None
    return Lossy(tables, model, nodes), None
