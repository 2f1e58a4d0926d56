"""Kinds that know their sends in advance: ``periodic``, ``periodic-schedule``, ``self-triggered``, ``rollout``.

An input is held from one send to the next; its gain is the best one for its interval. With ``model`` the actuator runs
the model from the last estimate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from everything.kept import lifted
from everything.laws import Law
from everything.plain import Array, Model, NotModelledError, inverse, riccati
from everything.policies import Certainty, quadratic

Tables = Mapping[str, Any]


def cycle_gains(model: Model, cycle: Sequence[int], K: Array | None = None) -> tuple[list[Array], list[Array]]:
    """Return values and gains at the sends of a cycle of intervals, by backward recursion from the far future.

    Disturbances that decay are states as others are; what an interval leaves of them counts.
    """
    n, size = model.n, len(model.A)
    if model.q and np.abs(np.linalg.eigvals(model.A[n : n + model.q, n : n + model.q])).max() < 1 - 1e-6:
        n += model.q
    Q, R, N = model.stage[:n, :n], model.stage[size:, size:], model.stage[:n, size:]
    parts = [lifted(model.A[:n, :n], model.B[:n], Q, R, N, steps) for steps in cycle]
    value, values, gains = (np.eye(n) if K is None else K), [], []
    for _ in range(50_000):
        before, values, gains = value, [], []
        for A_q, B_q, Q_q, R_q, N_q in reversed(parts):
            value, _, L = riccati(A_q, B_q, Q_q, R_q, N_q, value)
            values.insert(0, value)
            gains.insert(0, L)
        if np.abs(value - before).max() <= 1e-13 * np.abs(value).max():
            return values, gains
    raise NotModelledError("a cycle that does not settle")


def innovations(base: Certainty, n: int) -> Array:
    """Return the covariance of the white noise with which the estimate of the first n states moves at every step."""
    model = base.model
    return (model.A @ base.Sigma @ model.A.T + model.W - base.Sigma)[:n, :n]


class Clocked(Certainty):
    """Sends at the steps of a cycle, with gains for the intervals."""

    def __init__(self, model: Model, cycle: Sequence[int], actuation: str) -> None:
        """Design."""
        super().__init__(model, None, actuation)
        if not model.average:
            raise NotModelledError("periodic over a horizon")
        self.cycle, self.exact = list(cycle), None
        if actuation == "hold":
            gains = cycle_gains(model, cycle)[1]
            self.own = [np.hstack([L, self.full(L[:, : model.n])[:, L.shape[1] :]]) for L in gains]
        else:
            self.own = [self.L] * len(cycle)
        self.starts = np.concatenate([[0], np.cumsum(self.cycle)[:-1]]).tolist()

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Send by the clock."""
        phase = k % sum(self.cycle)
        place = self.starts.index(phase) if phase in self.starts else None
        self.rule = lambda loop: np.full(len(loop.command), place is not None)
        if self.actuation == "hold" and place is not None:
            self.Ls = [self.own[place]]
        return super().step(k, y, r)


class SelfTriggered(Certainty):
    """Each send determines the time of the next one."""

    def __init__(self, model: Model, beta: float, longest: int) -> None:
        """Compute value and gain of every interval, and what its noise costs."""
        super().__init__(model, None, "hold")
        if model.q + model.s or not model.average:
            raise NotModelledError("self-triggered with disturbances")
        n = model.n
        A, B = model.A[:n, :n], model.B[:n]
        J = (self.nominal if self.exact is None else self.exact) - model.rest
        self.options: list[tuple[Array, Array, float]] = []
        for steps in range(1, longest + 1):
            part = lifted(A, B, model.Q, model.R, model.N, steps)
            P, _, L = riccati(*part, beta * self.K)
            # noise of the estimation error and of the plant, from the covariance after the measurement
            spread, noise = self.Sigma, 0.0
            for _ in range(steps):
                noise += float(np.trace(model.Q @ spread))
                spread = A @ spread @ A.T + model.W
            # at the end the estimate has the covariance of the state minus that of the error
            noise += beta * float(np.trace(self.K @ (spread - self.Sigma)))
            self.options.append((P, L, noise - beta * steps * J))
        self.beta, self.exact = beta, None

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        super().start(paths, rng)
        self.left = np.zeros(paths)

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Send when the announced time is reached."""
        due = self.left <= 0
        self.rule = lambda loop: due
        found = super().step(k, y, r)
        self.left = np.where(due, self.chosen - 1, self.left - 1)
        return found

    def send(self) -> Array:
        """Return the input of the longest interval that the budget allows."""
        x = self.estimate
        budget = self.beta * quadratic(x, self.K)
        chosen, u = np.ones(len(x)), self.command
        for steps, (P, L, rest) in enumerate(self.options, start=1):
            fits = quadratic(x, P) + rest <= budget + 1e-12 * np.abs(budget)
            chosen = np.where(fits, steps, chosen)
            u = np.where(fits[:, None], x @ L.T, u) if steps > 1 else x @ L.T
        self.chosen = chosen
        return u


class Rollout(Certainty):
    """The cheapest schedule of a window with as many sends as periodic control, followed by periodic control."""

    def __init__(self, model: Model, horizon: int, every: int) -> None:
        """Compute the value of every schedule: a form of (x̂, held input), and what the noise of the window costs."""
        super().__init__(model, None, "hold")
        if model.q + model.s or not model.average:
            raise NotModelledError("rollout with disturbances")
        self.exact = None
        count = max(horizon // every, 1)
        self.window = count * every
        K = cycle_gains(model, [every])[0][0]
        usual = tuple(range(0, self.window, every))
        self.schedules = [usual, *(s for s in combinations(range(self.window), count) if s != usual)]
        self.values, self.table = [], []
        n, m = model.n, model.m
        A, B = model.A[:n, :n], model.B[:n]
        F = np.block([[A, B], [np.zeros((m, n)), np.eye(m)]])
        stage = np.block([[model.Q, model.N], [model.N.T, model.R]])
        innovation = innovations(self, model.n)
        for sends in self.schedules:
            P, gains, noise = np.zeros((n + m, n + m)), {}, 0.0
            P[:n, :n] = K
            for j in reversed(range(self.window)):
                noise += float(np.trace(innovation @ P[:n, :n]))
                whole = stage + F.T @ P @ F
                if j in sends:
                    L = -inverse(whole[n:, n:]) @ whole[n:, :n]
                    gains[j] = L
                    best = np.vstack([np.eye(n), L])
                    P = np.zeros((n + m, n + m))
                    P[:n, :n] = best.T @ whole @ best
                else:
                    P = whole
            self.values.append((P, noise))
            self.table.append(gains)

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Choose at the start of a window, then follow the schedule."""
        self.place = k % self.window
        self.rule = self._due
        return super().step(k, y, r)

    def _due(self, loop: Certainty) -> Array:
        w = np.hstack([self.estimate, self.held])
        if self.place == 0:
            self.chosen = np.argmin([quadratic(w, P) + noise for P, noise in self.values], axis=0)
        due = np.array([self.place in sends for sends in self.schedules])[self.chosen]
        self.planned = self.command.copy()
        for i, gains in enumerate(self.table):
            if self.place in gains:
                here = self.chosen == i
                self.planned[here] = self.estimate[here] @ gains[self.place].T
        return due

    def send(self) -> Array:
        """Return the input of the schedule."""
        return self.planned


def clocked_policy(tables: Tables, model: Model, law: Law) -> Any:
    """Return the policy of a file."""
    policy = tables["policy"]  # sends at fixed steps keep the limits of a link, or the problem is refused
    if policy["kind"] == "periodic":
        every = policy.get("every", 1)
        if model.continuous and policy.get("actuation", "hold") == "model" and "every" not in policy:
            raise NotModelledError("periodic with a prediction in continuous time")
        return Clocked(model, every if isinstance(every, list) else [every], policy.get("actuation", "hold"))
    if policy["kind"] == "self-triggered":
        return SelfTriggered(model, policy["beta"], policy["max_interval"])
    if policy["kind"] == "rollout":
        found = Rollout(model, policy["horizon"], policy["every"])
        found.law = law  # whose limits withhold packets of the schedule, or add some
        return found
    length, sends = policy["length"], policy["sends"]
    patterns = {cycle_of(rest, length) for rest in combinations(range(length), sends)}
    found = [(cost_of(model, cycle), cycle) for cycle in sorted(patterns)]
    return Clocked(model, min(found)[1], "hold")


def cycle_of(steps: Sequence[int], length: int) -> tuple[int, ...]:
    """Return the intervals of a pattern."""
    return tuple(np.diff([*steps, steps[0] + length]).tolist())


def cost_of(model: Model, cycle: Sequence[int]) -> float:
    """Return what tells the costs of patterns apart: the mean of the noise cost over the cycle, without the filter."""
    values, _ = cycle_gains(model, cycle)
    n, m, size = len(values[0]), model.m, len(model.A)
    M = innovations(Certainty(model, None), n)  # their value depends on the phase
    F = np.block([[model.A[:n, :n], model.B[:n]], [np.zeros((m, n)), np.eye(m)]])
    stage = model.stage[np.ix_([*range(n), *range(size, size + m)], [*range(n), *range(size, size + m)])]
    total, steps = 0.0, 0
    for place, interval in enumerate(cycle):
        P = np.zeros((n + m, n + m))
        P[:n, :n] = values[(place + 1) % len(cycle)]
        for _ in range(interval):
            total += float(np.trace(M @ P[:n, :n]))
            P = stage + F.T @ P @ F
            steps += 1
    return round(total / steps, 9)
