"""The policies of problem files for ``plain``, written from the pages and docstrings that describe their rules."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from everything.laws import Channel, Law, Nodes, Samples, nodes_of
from everything.plain import (
    Array,
    Controller,
    Model,
    NotModelledError,
    kalman,
    measure_update,
    model_of,
    regulator,
    riccati,
)

Tables = Mapping[str, Any]
Rule = Callable[["Certainty"], Array]


def quadratic(left: Array, weight: Array, right: Array | None = None) -> Array:
    """Return the quadratic forms of rows."""
    return np.einsum("pi,ij,pj->p", left, weight, left if right is None else right)


class Certainty:
    """Filter and gain of LQG at the sensor, and a rule that decides when to send to the actuator.

    A rule reads the signals of the step (``estimate``, ``command``, ``candidate``, ``error``, ``deviation``) and
    returns which paths send. Between packets the actuator holds its input, or runs a model from the last estimate
    sent; or it applies the inputs of a plan that the last packet carried.
    """

    link = "actuator"
    sure = True  # whether the sender knows which input is applied, and so which packets change none

    def __init__(
        self, model: Model, rule: Rule | None, actuation: str = "hold", law: Law | None = None, plan: int = 0
    ) -> None:
        """Design filter and gain; without a rule every sample is sent."""
        self.model, self.rule, self.actuation, self.plan = model, rule, actuation, plan
        self.law = law or Law()
        self.exact: float | None = None
        self.nominal = 0.0  # the exact cost of the linear plant
        self.samples: Samples | None = None  # None: none is missing
        self._design()

    def miss(self, samples: Samples) -> None:
        """Let samples be missing: another gain, and no exact cost."""
        model, self.samples, self.exact = self.model, samples, None
        if not model.average:
            return
        if model.V is None:
            if model.q:
                raise NotModelledError("missing samples of a measured state with disturbances")
            if not model.fresh:
                raise NotModelledError("missing samples of a measured state that arrive at different times")
            return
        free = np.flatnonzero(np.arange(len(model.A)) < model.known.start)
        parts = model.A[np.ix_(free, free)], model.C[:, free], model.W[np.ix_(free, free)], model.V
        self.gains = [np.zeros_like(self.gains[0])]
        self.gains[0][free] = samples.gain(*parts)[0]

    def _design(self) -> None:
        model, n = self.model, self.model.n
        A, B = model.A[:n, :n], model.B[:n]
        free = np.arange(len(model.A)) < model.known.start  # what the filter estimates; set-points are told
        self.gains: list[Array] = []
        if model.average:
            self.K, self.H, L = regulator(A, B, model.Q, model.R, model.N)
            self.L = self.full(L)
            gain, _, posterior = self._steady(free)
            self.gains, self.Sigma = [gain], posterior
            slow = (np.eye(len(gain)) - gain @ model.C) @ model.A
            slow = slow[np.ix_(np.flatnonzero(free), np.flatnonzero(free))]
            self.radius = max(float(np.abs(np.linalg.eigvals(part)).max(initial=0.0)) for part in (A + B @ L, slow))
            T = np.hstack([np.eye(n), -model.X])
            W = model.W + self._steps_of_set_points()
            self.exact = float(np.trace(self.K @ T @ W @ T.T) + np.trace(self.H @ self.L @ posterior @ self.L.T))
            self.exact += model.rest
            if model.changes.levels is not None:
                self.exact += self._transients()
            self.Ls, self.Hs = [self.L], [self.H]
            self._expect_linear()
            return
        if model.q + model.s:
            raise NotModelledError("disturbances over a horizon")
        self._design_total(A, B)
        self._expect_linear()

    def _expect_linear(self) -> None:
        """Claim no exact cost of a nonlinear plant, or of inputs with limits."""
        if self.model.function is not None or self.model.limited:
            self.nominal, self.exact = self.exact or 0.0, None

    def _design_total(self, A: Array, B: Array) -> None:
        """Gains over a horizon, or for a discounted sum; the filter begins with the covariance of the start."""
        model, W = self.model, self.model.W
        V = np.zeros((len(model.C), len(model.C))) if model.V is None else model.V
        if model.horizon is not None:
            K, self.Ls, self.Hs, Ks = model.terminal, [], [], [model.terminal]
            for _ in range(model.horizon):
                K, H, L = riccati(A, B, model.Q, model.R, model.N, K)
                self.Ls.insert(0, L)
                self.Hs.insert(0, H)
                Ks.insert(0, K)
            steps = model.horizon
        else:
            K, H, L = regulator(A, B, model.Q, model.R, model.N, model.discount)
            self.Ls, self.Hs, Ks, steps = [L], [H], [K], 400
        prior, value = model.covariance, 0.0
        start = np.outer(model.mean, model.mean) + model.covariance
        value = float(np.trace(Ks[0] @ start))
        for k in range(steps):
            L, H = self.Ls[min(k, len(self.Ls) - 1)], self.Hs[min(k, len(self.Hs) - 1)]
            gain, posterior = measure_update(prior, model.C, V)
            if model.V is None and model.fresh:
                posterior = np.zeros_like(posterior)
            self.gains.append(gain)
            after = Ks[min(k + 1, len(Ks) - 1)]
            weight = model.discount**k
            value += weight * float(
                np.trace(H @ L @ posterior @ L.T) + model.discount * np.trace(after @ W) + model.rest
            )
            prior = A @ posterior @ A.T + W
        self.exact = value

    def _transients(self) -> float:
        """Return what a timetable costs per step without noise: the last cycle of a few, with every sample."""
        model, levels = self.model, self.model.changes.levels
        assert levels is not None
        z, cycles, total = np.zeros(len(model.A)), 1 + int(np.ceil(600 / len(levels))), 0.0
        for k in range(cycles * len(levels)):
            z[model.known] = levels[k % len(levels)]
            u = self.L @ z
            joint = np.concatenate([z, u])
            total += float(joint @ model.stage @ joint) * (k >= (cycles - 1) * len(levels))
            z = model.A @ z + model.B @ u
        return total / len(levels)

    def _steps_of_set_points(self) -> Array:
        model, found = self.model, np.zeros_like(self.model.W)
        if model.changes.root is not None:
            found[model.known, model.known] = model.changes.rate * model.changes.root @ model.changes.root
        return found

    def _steady(self, free: Array) -> tuple[Array, Array, Array]:
        """Return gain and covariances of the steady filter of z, with zeros at the set-points."""
        model, size = self.model, len(self.model.A)
        pick = np.flatnonzero(free)
        if model.V is None and model.fresh:
            return model.exact_gain, np.zeros((size, size)), np.zeros((size, size))
        V = np.zeros((len(model.C),) * 2) if model.V is None else model.V
        gain, prior, posterior = kalman(model.A[np.ix_(pick, pick)], model.C[:, pick], model.W[np.ix_(pick, pick)], V)
        whole, before, after = np.zeros((size, len(model.C))), np.zeros((size, size)), np.zeros((size, size))
        whole[pick], before[np.ix_(pick, pick)], after[np.ix_(pick, pick)] = gain, prior, posterior
        return whole, before, after

    def full(self, L: Array) -> Array:
        """Return the gain for z: u = L(x − X(d, r)) + U(d, r)."""
        return np.hstack([L, self.model.U - L @ self.model.X])

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        model = self.model
        self.rng, self.k = rng, 0
        self.channel = Channel(self.law, paths, rng)
        if self.samples is not None:
            self.samples.start(paths, rng)
        self.prior = np.zeros((paths, len(model.A)))
        if not model.average:
            self.prior[:, : model.n] = model.mean
        self.held = np.clip(np.zeros((paths, model.m)), model.low, model.high)
        self.wanted = self.held  # the last command sent
        self.last = self.prior.copy()  # the last estimate sent, or its prediction
        self.memory: dict[str, Array] = {}
        self.sent_command = self.held.copy()
        self.planned = self.foreseen(self.prior)[: self.plan] if self.plan else []  # inputs of this step and the next

    def foreseen(self, state: Array) -> list[Array]:
        """Return the inputs of this step and of those of the plan, if every packet arrives."""
        L = self.at(self.Ls)
        found = [state @ L.T]
        for _ in range(self.plan):
            state = state @ self.model.A.T + found[-1] @ self.model.B.T
            found.append(state @ L.T)
        return found

    def at(self, values: list[Array]) -> Array:
        """Return the matrix of this step."""
        return values[min(self.k, len(values) - 1)]

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Filter, decide, apply."""
        model, self.k = self.model, k
        self.L, self.H = self.at(self.Ls), self.at(self.Hs)
        if model.s:
            self.prior[:, model.known] = r
        if self.samples is not None:  # a missing sample is the predicted one
            y = np.where(self.samples.known(), y, self.prior @ model.C.T)
        if model.whole and not model.q + model.s:
            self.estimate = y
        else:
            self.estimate = self.prior + (y - self.prior @ model.C.T) @ self.at(self.gains).T
        command = self.estimate @ self.L.T
        candidate = self.last @ self.L.T if self.actuation == "model" else self.wanted
        candidate = self.planned[0] if self.plan else candidate
        self.command, self.candidate = (np.clip(one, model.low, model.high) for one in (command, candidate))
        changes = reached(model, self.command, self.held) != reached(model, self.candidate, self.held)
        changes |= not self.sure
        self.error, self.deviation = candidate - command, self.last - self.estimate
        if model.limited:  # no error where a packet changes no input, and no packet that changes none
            self.error = np.where(changes, self.error, 0.0)
        sends = np.ones(len(y), dtype=bool)
        if self.rule is not None:
            useful = changes.any(axis=1) | (not model.limited or self.actuation == "model")
            sends = self.channel.allowed(self.rule(self) & useful)
        self.decided(sends)
        self.wanted = np.where(sends[:, None], self.send(), self.candidate)
        applied = reached(model, self.wanted, self.held)
        if self.plan:
            later, sent = [*self.planned[1:], self.planned[-1]], self.foreseen(self.estimate)[1:]
            self.planned = [np.where(sends[:, None], *both) for both in zip(sent, later, strict=True)]
        self.last = np.where(sends[:, None], self.estimate, self.last)
        if self.actuation == "model":
            moved = applied if model.limited else self.last @ self.L.T
            self.last = self.last @ model.A.T + moved @ model.B.T
        self.held = applied
        self.prior = self.estimate @ model.A.T + applied @ model.B.T
        return applied, {self.link: sends.astype(float)}

    def send(self) -> Array:
        """Return the input of a packet."""
        return self.command

    def decided(self, sends: Array) -> None:
        """Update what a rule remembers."""
        update = getattr(self.rule, "update", None)
        if update is not None:
            update(self, sends)


class Rules:
    """The rules of the kinds with this structure: each returns a function of the signals."""

    @staticmethod
    def excess(policy: Tables, base: Certainty) -> Rule:
        """Send iff e'He > δ."""
        model = base.model
        if "delta" in policy:
            delta = policy["delta"]
        else:
            exact = base.nominal if base.exact is None else base.exact
            steps = model.horizon or (1 / (1 - model.discount) if model.discount < 1 else 1.0)
            delta = policy["theta"] * (exact - steps * model.rest) / steps
        if model.limited and model.average:
            return lambda loop: (followed(loop, loop.candidate) - followed(loop, loop.command)) > delta
        return lambda loop: quadratic(loop.error, loop.H) > delta

    @staticmethod
    def lqg(policy: Tables, base: Certainty) -> Rule:
        """Joint or separate trigger of chapter 2."""
        model, theta = base.model, policy["theta"]
        size = len(model.A)
        Qa, Ra, Na = model.stage[:size, :size], model.stage[size:, size:], model.stage[:size, size:]
        gamma = theta * np.trace(Qa @ base.Sigma)
        L, H = base.L, base.H
        if theta == 0:
            return lambda loop: np.ones(len(loop.command), dtype=bool)
        if policy.get("trigger", "joint") == "joint":

            def joint(loop: Certainty) -> Array:
                x, u, e = loop.estimate, loop.candidate, loop.error
                share = quadratic(x, Qa) + quadratic(u, Ra) + 2 * np.einsum("pi,ij,pj->p", x, Na, u)
                return (1 + theta) * quadratic(e, H) - theta * share > gamma

            return joint
        if model.q + model.s:
            raise NotModelledError("the separate trigger with disturbances")
        U = Na @ L + L.T @ Na.T
        M = Qa + L.T @ Ra @ L + U
        least = np.linalg.eigvalsh(M[np.ix_(model.own > 0, model.own > 0)])[0]
        epsilon = policy.get("epsilon", 0.5 * least)
        B, K = model.B, base.K
        Y = theta * (M - epsilon * np.diag(model.own))
        Z = Ra + (1 + theta) * B.T @ K @ B + theta / epsilon * (Ra @ L + Na.T) @ (L.T @ Ra + Na)
        return lambda loop: quadratic(loop.error, Z) > quadratic(loop.estimate, Y) + gamma

    @staticmethod
    def absolute(policy: Tables, base: Certainty) -> Rule:
        """Send iff e'We > Y²."""
        state = policy.get("error", "input") == "state"
        unit = np.diag(base.model.own) if state else np.eye(base.model.m)
        if state and base.model.q + base.model.s:
            raise NotModelledError("the error of a state with disturbances")
        W = np.array(policy.get("weight", unit), dtype=float)
        return lambda loop: quadratic(loop.deviation if state else loop.error, W) > policy["threshold"] ** 2

    @staticmethod
    def relative(policy: Tables, base: Certainty) -> Rule:
        """Send iff |x̃ − x̂| > σ|x̂|."""
        sigma = policy["sigma"] ** 2
        return lambda loop: squares(loop.model, loop.deviation) > sigma * squares(loop.model, loop.estimate)

    @staticmethod
    def mixed(policy: Tables, base: Certainty) -> Rule:
        """Send iff |x̃ − x̂|² > σ²|x̂|² + Y²."""
        sigma, Y = policy["sigma"] ** 2, policy["threshold"] ** 2
        return lambda loop: squares(loop.model, loop.deviation) > sigma * squares(loop.model, loop.estimate) + Y

    @staticmethod
    def dynamic(policy: Tables, base: Certainty) -> Rule:
        """Send iff gain(|x̃ − x̂|² − σ²|x̂|²) > η."""
        return Dynamic(policy["sigma"] ** 2, policy["rho"], policy["gain"])

    @staticmethod
    def stochastic(policy: Tables, base: Certainty) -> Rule:
        """Send iff ½ s e'We > ξ."""
        if base.model.q + base.model.s:
            raise NotModelledError("the error of a state with disturbances")
        W = policy.get("scale", 1.0) * np.array(policy.get("weight", np.diag(base.model.own)), dtype=float)
        return lambda loop: 0.5 * quadratic(loop.deviation, W) > loop.rng.standard_exponential(len(loop.command))

    @staticmethod
    def downsampled(policy: Tables, base: Certainty) -> Rule:
        """Check |x̃ − x̂| > Y at some steps."""
        if base.model.q + base.model.s:
            raise NotModelledError("the error of a state with disturbances")
        return Downsampled(policy["fast"], policy["slow"], policy["threshold"])


def reached(model: Model, wanted: Array, before: Array) -> Array:
    """Return the inputs that an actuator applies: towards what is wanted by at most a rate, and within limits."""
    return np.clip(np.clip(wanted, before - model.slew, before + model.slew), model.low, model.high)


def followed(loop: Certainty, wanted: Array) -> Array:
    """Return what ten steps cost without noise, if one input is wanted now and then every command, and the value of
    the state that they reach.
    """
    model, z, before, total = loop.model, loop.estimate, loop.held, 0.0
    for _ in range(10):
        before = reached(model, wanted, before)
        total = total + quadratic(np.hstack([z, before]), model.stage)
        z = z @ model.A.T + before @ model.B.T
        wanted = z @ loop.L.T
    there = z[:, : model.n] - z[:, model.n :] @ model.X.T
    return np.asarray(total + quadratic(there, loop.K))


def squares(model: Model, rows: Array) -> Array:
    """Return the squared lengths of states, of which inputs of the step before are no part."""
    return np.einsum("pi,pi->p", rows, rows @ np.diag(model.own))


class Dynamic:
    """A relative threshold on a filtered error."""

    def __init__(self, sigma: float, rho: float, gain: float) -> None:
        """Keep the parameters."""
        self.sigma, self.rho, self.gain = sigma, rho, gain

    def __call__(self, loop: Certainty) -> Array:
        """Decide."""
        eta = loop.memory.setdefault("credit", np.zeros(len(loop.command)))
        return self.gain * (squares(loop.model, loop.deviation) - self.sigma * squares(loop.model, loop.estimate)) > eta

    def update(self, loop: Certainty, sends: Array) -> None:
        """Add what was not used."""
        left = self.sigma * squares(loop.model, loop.estimate) - np.where(
            sends, 0.0, squares(loop.model, loop.deviation)
        )
        loop.memory["credit"] = self.rho * loop.memory["credit"] + left


class Downsampled:
    """Checks at some steps."""

    def __init__(self, fast: int, slow: int, threshold: float) -> None:
        """Keep the parameters."""
        self.fast, self.slow, self.limit = fast, slow, threshold**2

    def __call__(self, loop: Certainty) -> Array:
        """Decide."""
        wait = loop.memory.setdefault("wait", np.zeros(len(loop.command)))
        return (wait <= 0) & (squares(loop.model, loop.deviation) > self.limit)

    def update(self, loop: Certainty, sends: Array) -> None:
        """Count the steps to the next check."""
        wait = loop.memory["wait"]
        loop.memory["wait"] = np.where(sends, self.fast - 1, np.where(wait <= 0, self.slow - 1, wait - 1))


def resolved(tables: Tables, model: Model, folder: Path) -> Model:
    """Return a model with the weights of the controller that its cost names."""
    from everything.kept import weights_as_kept

    if "weights" not in tables["cost"]:
        return model
    if model.continuous or model.s:
        raise NotModelledError("weights as the controller of a continuous plant, or with changing set-points")
    weights = dict(zip("QRN", (one.tolist() for one in weights_as_kept(tables, model)), strict=True))
    cost = {key: value for key, value in tables["cost"].items() if key != "weights"}
    return model_of({**tables, "cost": {**cost, **weights}}, folder)


def policy_of(tables: Tables, model: Model, all_time: float | None = None) -> tuple[Controller, Controller | None]:
    """Return the policy of a file, and its twin that sends every sample.

    Args:
        tables: the file.
        model: its model.
        all_time: what the library says that an attempt of every packet costs; used, and checked by simulation, where
            this simulation has no number of its own.

    Raises:
        NotModelledError: the kind, or what is stated beside it, is not modelled here.
    """
    nodes = nodes_of(tables, len(model.C), model.m)
    own, twin = _policy_of(tables, model, nodes, all_time)
    if not nodes.missing:
        return own, twin
    if not hasattr(own, "miss"):
        raise NotModelledError("missing samples of this kind")
    own.miss(Samples(nodes, len(model.C)))
    return own, None  # no common noise where samples are missing by chance


def _policy_of(
    tables: Tables, model: Model, nodes: Nodes, all_time: float | None
) -> tuple[Controller, Controller | None]:
    from everything.clocked import clocked_policy
    from everything.kept import EVENTS, kept_policy
    from everything.nodes import node_policy
    from everything.remote import remote_policy

    policy, kind = tables["policy"], tables["policy"]["kind"]
    if kind in ("remote-lqg", "lossy-lqg"):
        return remote_policy(tables, model, nodes)
    wired = all(name not in nodes.laws for name in nodes.sensors) if nodes.named else True
    linked = [name for name in nodes.actuators if name in nodes.laws]
    alone = kind == "all-time" or hasattr(Rules, kind)
    if model.limited and not (alone and "controller" not in tables and not nodes.lossy and kind != "downsampled"):
        raise NotModelledError("limits of the inputs of this kind")
    if kind in ("distributed", "variance") or (kind == "send-on-delta" and (nodes.named or "controller" not in tables)):
        return node_policy(tables, model, nodes, all_time)
    keeps = kind in ("excess", "send-on-delta", "symmetric-send-on-delta", *EVENTS) or (
        "controller" in tables and kind in ("all-time", "periodic")
    )
    if not keeps and ("controller" in tables or nodes.lossy):
        raise NotModelledError(f"a controller or losses with {kind}")
    options = {"every", "gains", "retry", "link"} & set(policy) if keeps else set()
    if policy.get("plan"):  # which no option of another base allows
        options = set[str]()
        if nodes.lossy:
            raise NotModelledError("a plan over losses")
    if model.limited and options:
        raise NotModelledError("limits of the inputs for a base of this kind")
    if not nodes.named and ("controller" in tables or nodes.lossy or options):
        return kept_policy(tables, model, nodes)
    if nodes.named:
        if not wired or len(linked) != 1:
            raise NotModelledError(f"several links of {kind}")
        if "controller" in tables or nodes.lossy or options:
            law = nodes.laws[linked[0]]
            return renamed(kept_policy(tables, model, replace(nodes, laws={"actuator": law})), linked[0])
    law = nodes.laws[linked[0]] if nodes.named else nodes.laws["actuator"]
    name = linked[0] if nodes.named else "actuator"
    base = Certainty(model, None)
    if kind in ("periodic", "periodic-schedule", "self-triggered", "rollout"):
        found = clocked_policy(tables, model, law)
        return renamed((found, None if found.exact is not None else base), name)
    if kind == "all-time":
        return renamed((Certainty(model, None), base), name)
    rule = getattr(Rules, kind, None)
    if rule is None:
        raise NotModelledError(f"the kind {kind}")
    actuation = policy.get("actuation", "hold")
    if actuation == "zero":
        raise NotModelledError("zero in silence")
    plan = policy.get("plan", 0)
    return renamed((Certainty(model, rule(policy, base), actuation, law, plan), base), name)


def renamed(found: tuple[Any, Any], name: str) -> tuple[Any, Any]:
    """Return policies whose link has another name."""
    found[0].link = name
    return found
