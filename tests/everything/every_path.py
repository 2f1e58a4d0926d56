"""The kind ``distributed`` with a bound on every path: any linear controller, whose nodes count the cost of silence.

The loop that sends every sample is w⁺ = F w + G d, ζ = C w + D d, with the plant, its disturbances, its set-points and
the controller in w. A node whose silence is an error d follows q⁺ = F q + G d and knows what a silence adds to the cost
of this response, a = d'S d + 2 d'Y q, S = D'D + G'PG, Y = D'C + G'PF. LQG is the controller whose state is the
prediction of its filter. Set-points are told to the controller, and no error moves them.

``promised`` checks, on each path, that no path costs more than the certificate, and than its promise.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from itertools import combinations, pairwise, product
from typing import Any

import numpy as np
from everything.kept import Follows, Given, following, given_of
from everything.laws import Channel, Law, Nodes
from everything.plain import Array, Model, NotModelledError, World, block, kalman, root_of
from everything.policies import Certainty, quadratic
from numpy.typing import NDArray
from responses import seen_by
from scipy.linalg import solve_discrete_lyapunov

Tables = Mapping[str, Any]
ROUNDED = 1e-9
LASTING, REMEMBERED = 1e-6, 0.999  # of a mode that never decays, in the filter of one sensor


def value(F: Array, C: Array, G: Array) -> Array:
    """Return P with w'P w the sum of |C w|² for each w that G reaches, zero elsewhere.

    Raises:
        NotModelledError: the sum does not end.
    """
    reached = seen_by(F.T, G.T)
    if not len(reached):
        return np.zeros_like(F)
    F_r, C_r = reached @ F @ reached.T, C @ reached.T
    seen = seen_by(F_r, C_r)
    if not len(seen):
        return np.zeros_like(F)
    F_s, C_s = seen @ F_r @ seen.T, C_r @ seen.T
    if np.abs(np.linalg.eigvals(F_s)).max() >= 1 - 1e-9:
        raise NotModelledError("a loop whose response does not decay")
    P, both = solve_discrete_lyapunov(F_s.T, C_s.T @ C_s), seen @ reached
    return both.T @ P @ both


class Loop:
    """Plant and controller that send every sample, with errors d = (d_y, d_u); w = (z, slow disturbance, c)."""

    def __init__(self, tables: Tables, model: Model) -> None:
        """Find the controller and the loop."""
        self.model = model
        nz, p, m = len(model.A), len(model.C), model.m
        E_r = np.eye(nz)[:, model.known]  # z of set-points
        self.pole, self.deviation, self.radius = 0.0, None, 0.5
        h = model.seconds if model.continuous else float(tables["plant"]["dt"])
        if "controller" in tables:
            given = given_of(tables, model, h)
            if model.q:
                raise NotModelledError("a given controller with disturbances")
            follows = following(tables, model, given, h)
            self.pole, self.deviation = given.pole, given.deviation
            self.lqg = None
        else:
            base = Certainty(model, None)
            if not model.average:
                raise NotModelledError("LQG on every path over a horizon")
            G, told = base.gains[0], np.diag(np.arange(nz) < model.known.start).astype(float)
            left = told @ (np.eye(nz) - G @ model.C) @ told
            given = Given(model.A @ left, model.A @ G, base.L @ left, base.L @ G, model.B)
            follows = Follows(model.A @ E_r, base.L @ E_r)
            self.lqg, self.radius = base, base.radius
        self.given, self.follows = given, follows
        q = m if self.deviation is not None else 0
        self.nz, self.q, self.k = nz, q, len(given.A)
        c = given
        self.A = block(model.A, self.pole * np.eye(q))
        self.A[:nz, nz:] = model.pushing[:, :q]
        self.B, self.C = np.vstack([model.B, np.zeros((q, m))]), np.hstack([model.C, np.zeros((p, q))])
        R = np.hstack([E_r.T, np.zeros((model.s, q))])  # set-points of the plant's state
        command, moves = c.D @ self.C + follows.D @ R, c.B @ self.C + follows.B @ R
        self.K = np.hstack([command, c.C])
        self.F = np.block([[self.A + self.B @ command, self.B @ c.C], [moves + c.E @ command, c.A + c.E @ c.C]])
        self.G = np.block([[self.B @ c.D, self.B], [c.B + c.E @ c.D, c.E]])
        # (x, v, u) as the cost counts it: v the input that the plant gets
        there = np.hstack([np.eye(model.n), -model.X]) @ np.eye(nz, len(self.F))
        steady = np.hstack([np.zeros((m, model.n)), model.U]) @ np.eye(nz, len(self.F))
        slow = np.eye(len(self.F))[nz : nz + q] if q else np.zeros((m, len(self.F)))
        ahead = np.hstack([c.D, np.eye(m)])
        signals = np.vstack([there, self.K - steady + slow, self.K - steady])
        moved = np.vstack([np.zeros((model.n, p + m)), ahead, ahead])
        root = root_of((model.pushed + model.pushed.T) / 2)
        self.signals, self.moved = root @ signals, root @ moved
        V = np.zeros((p, p)) if model.V is None else model.V
        self.V = V
        W = np.zeros_like(self.F)
        W[:nz, :nz] = model.W
        if model.changes.root is not None:
            W[model.known, model.known] += model.changes.rate * model.changes.root @ model.changes.root
        if self.deviation is not None:
            at = np.arange(nz, nz + q)
            W[at, at] = self.deviation**2 * (1 - self.pole**2)
        self.W = W

    def base(self) -> float:
        """Return the cost of every sample per step, or in total."""
        model, p = self.model, len(self.model.C)
        enters, through = self.G[:, :p], self.moved[:, :p]
        if not model.average:
            return self._total(enters, through)
        noise = self.W + enters @ self.V @ enters.T
        P = value(self.F, self.signals, noise)
        found = float(np.trace(P @ noise) + np.trace(through.T @ through @ self.V)) + model.rest
        return found + (self._transients() if model.changes.levels is not None else 0.0)

    def _total(self, enters: Array, through: Array) -> float:
        model = self.model
        if model.horizon is None or model.q + model.s:
            raise NotModelledError("a total of this kind on every path")
        M = np.zeros_like(self.F)
        M[: model.n, : model.n] = model.covariance + np.outer(model.mean, model.mean)
        if self.deviation is not None:
            at = np.arange(self.nz, self.nz + self.q)
            M[at, at] = self.deviation**2
        found = 0.0
        for _ in range(model.horizon):
            found += float(np.trace(self.signals @ M @ self.signals.T) + np.trace(through @ self.V @ through.T))
            M = self.F @ M @ self.F.T + self.W + enters @ self.V @ enters.T
        return found + float(np.trace(model.terminal @ M[: model.n, : model.n])) + model.horizon * model.rest

    def _transients(self) -> float:
        """Return what a timetable costs per step without noise, in the last cycle of a few."""
        model, levels = self.model, self.model.changes.levels
        assert levels is not None
        w, cycles, total = np.zeros(len(self.F)), 1 + int(np.ceil(2000 / len(levels))), 0.0
        for k in range(cycles * len(levels)):
            w[model.known] = levels[k % len(levels)]
            out = self.signals @ w
            total += float(out @ out) * (k >= (cycles - 1) * len(levels))
            w = self.F @ w
        return total / len(levels)

    def with_gains(self, gains: Array) -> Loop:
        """Return the loop of the same controller with a plant whose inputs have other gains."""
        c, other = self.given, copy(self)
        B, size = self.B * gains, len(self.A)
        command, push = self.K[:, :size], np.zeros((size, len(self.C)))
        other.F, other.G = self.F.copy(), self.G.copy()
        other.F[:size, :size], other.F[:size, size:] = self.A + B @ command, B @ c.C
        other.G[:size] = np.hstack([push + B @ c.D, B])
        return other

    def effect(self, z: complex, entries: list[int]) -> NDArray[np.complex128]:
        """Return the effect of errors on the cost output at a point of the unit circle."""
        inner = np.linalg.solve(z * np.eye(len(self.F)) - self.F, self.G[:, entries].astype(complex))
        return self.signals @ inner + self.moved[:, entries]

    def response(self, entries: list[int]) -> tuple[Array, Array, Array]:
        """Return S, Y and G of the errors of some entries of (y, u)."""
        G, D, F, C = self.G[:, entries], self.moved[:, entries], self.F, self.signals
        P = value(F, C, G)
        if not self.model.average:
            n = self.model.n
            last = np.zeros_like(P)
            last[:n, :n] = self.model.terminal
            reached = seen_by(F.T, G.T)
            if len(reached) and np.linalg.eigvalsh(reached @ (last - P) @ reached.T)[-1] > 1e-9 * np.abs(P).max():
                raise NotModelledError("a final weight above the cost to come")
        return D.T @ D + G.T @ P @ G, D.T @ C + G.T @ P @ F, G


def local_filter(loop: Loop, rows: list[int]) -> tuple[Array, Array, Array, Array]:
    """Return F and C of the model by which a sensor predicts, the gain of its filter, and I − gain C."""
    model = loop.model
    if loop.lqg is not None:
        F, C, push = model.A + model.B @ loop.lqg.L, model.C, model.B @ loop.lqg.L
        W, enters = push @ loop.lqg.Sigma @ push.T, np.zeros((len(F), len(C)))
    else:
        F, C, enters = loop.F, np.hstack([loop.C, np.zeros((len(model.C), loop.k))]), loop.G[:, : len(model.C)]
        W = np.zeros_like(F)
    W = W + loop.W[: len(F), : len(F)]
    if model.changes.levels is not None:  # as if the changes of a timetable were random
        steps = np.roll(model.changes.levels, -1, axis=0) - model.changes.levels
        W[model.known, model.known] += steps.T @ steps / len(steps)
    W = W + enters @ loop.V @ enters.T
    own = REMEMBERED * F if (np.abs(np.abs(np.linalg.eigvals(F)) - 1) < LASTING).any() else F
    gain = kalman(own, C[rows], W, loop.V[np.ix_(rows, rows)])[0]
    return F, C[rows], gain, np.eye(len(F)) - gain @ C[rows]


class Decider:
    """A node that decides on one link, or on several together."""

    def __init__(
        self, links: list[str], entries: list[list[int]], laws: list[Law], shares: list[float], loop: Loop
    ) -> None:
        """Compute the weights of what silence adds."""
        self.links, self.sizes = links, [len(one) for one in entries]
        self.entries = [one for rows in entries for one in rows]
        self.S, self.Y, self.G = loop.response(self.entries)
        self.F = loop.F
        ends = np.cumsum([0, *self.sizes])
        self.places = [slice(a, b) for a, b in pairwise(ends)]
        sets = [set(one) for size in range(len(links) + 1) for one in combinations(range(len(links)), size)]
        sets.sort(key=lambda sent: sum(laws[i].price for i in sent))  # sets that send, the cheapest first
        worth = np.array([law.price * share for law, share in zip(laws, shares, strict=True)])
        saved = [sum(worth[i] for i in range(len(links)) if i not in sent) for sent in sets]
        self.sets, self.saved = sets, [one / (worth.sum() or 1.0) for one in saved]
        self.weight = np.zeros((0, 0))

    def start(self, paths: int) -> None:
        """Begin."""
        self.q, self.bank = np.zeros((paths, len(self.F))), np.zeros(paths)
        self.total, self.begun = np.zeros(paths), np.zeros(paths, dtype=bool)

    def added(self, d: Array) -> Array:
        """Return what an error adds."""
        return quadratic(d, self.S) + 2 * (d * (self.q @ self.Y.T)).sum(axis=1)

    def choose(self, d: Array, budget: Array, channels: Mapping[str, Channel] | None = None) -> Array:
        """Return which links send, (paths, links), if all are silent with the error d.

        The limits of intervals on the given channels leave a choice among fewer sets.
        """
        best, chosen = np.full(len(d), np.inf), np.ones((len(d), len(self.links)), dtype=bool)
        for sent, saved in zip(self.sets, self.saved, strict=True):
            worth = self.added(self.silent(d, sent)) - saved * budget if len(sent) < len(self.links) else 0 * budget
            better = self.begun & (worth < best)
            for i, link in enumerate(self.links if channels else ()):
                assert channels is not None
                wants = np.full(len(d), i in sent)
                better &= channels[link].limits(wants) == wants
            best = np.where(better, worth, best)
            chosen = np.where(better[:, None], [i in sent for i in range(len(self.links))], chosen)
        return chosen

    def silent(self, d: Array, sent: set[int]) -> Array:
        """Return the error if some links send."""
        found = d.copy()
        for i in sent:
            found[:, self.places[i]] = 0.0
        return found

    def after(self, d: Array, arrived: Array) -> Array:
        """Move the response by the error that is left, and return what it has added."""
        left = d.copy()
        for i, place in enumerate(self.places):
            left[:, place] = np.where(arrived[:, [i]], 0.0, left[:, place])
        added = np.where(arrived.all(axis=1), 0.0, self.added(left))
        self.q = self.q @ self.F.T + left @ self.G.T
        self.total += added
        self.begun |= arrived.all(axis=1)
        return added


class EveryPath:
    """The policy; with ``always``, its twin that sends every sample over links that lose none."""

    def __init__(
        self, tables: Tables, model: Model, nodes: Nodes, all_time: float | None, always: bool = False
    ) -> None:
        """Design the limits of all nodes."""
        policy = tables["policy"]
        self.model, self.nodes, self.always, self.loop = model, nodes, always, Loop(tables, model)
        loop, p = self.loop, len(model.C)
        self.approximate = model.continuous and loop.deviation is not None
        exact = loop.base()
        self.exact = exact if always and model.function is None else None
        self.alike = (
            not nodes.lossy
        )  # otherwise every sample over these links costs more than over links without losses
        if self.approximate and all_time is not None and model.average:
            exact = all_time * model.seconds  # its disturbance moves between samples
        self.modes = [policy.get(key, "hold") == "model" for key in ("prediction", "actuation")]
        own = ~np.isin(np.arange(len(loop.F)), loop.nz + np.arange(loop.q))  # slow disturbances begin stationary
        modes = np.abs(np.linalg.eigvals(loop.F[np.ix_(own, own)]))
        self.radius = max(float(modes[modes < 1 - 1e-6].max(initial=0.5)), loop.radius)
        if always:
            return
        self.rule = policy.get("rule", "relative" if "kappa" in policy else "bank")
        self.spend = policy.get("spend", 0.1)
        if self.rule != "threshold":
            self.radius = max(self.radius, 1 - self.spend / 5)
        self.laws = nodes.laws
        sensors = [[name] for name in nodes.sensors if name in self.laws]
        acting = [name for name in nodes.actuators if name in self.laws]
        ideal = not any(self.laws[name].lossy for name in acting)
        together = policy.get("joint", len(acting) > 1 and ideal)
        groups = [*sensors, *([acting] if together and acting else [[name] for name in acting])]
        entries = dict(nodes.sensors) | {name: [p + i for i in cols] for name, cols in nodes.actuators.items()}
        share = {link: float(policy.get("shares", {}).get(link, 1.0)) for link in self.laws}
        self.deciders = {
            group[0]: Decider(
                group, [entries[one] for one in group], [self.laws[one] for one in group],
                [share[one] for one in group], loop,
            )
            for group in groups
        }  # fmt: skip
        weight = {group[0]: sum(share[one] for one in group) / sum(share.values()) for group in groups}
        self._limits(policy, weight, (exact - (model.horizon or 1) * model.rest) / (model.horizon or 1))
        self.filter = None
        if self.modes[1] and any(not one.S.any() for one in self.deciders.values()):
            raise NotModelledError("a filter that reads the first packet of a sensor for ever")
        if self.modes[1] and loop.lqg is None:
            pick = np.flatnonzero(~np.isin(np.arange(loop.nz + loop.q), np.arange(loop.nz)[model.known]))
            gain = np.zeros((loop.nz + loop.q, p))
            W = loop.W[: loop.nz + loop.q, : loop.nz + loop.q]
            gain[pick] = kalman(loop.A[np.ix_(pick, pick)], loop.C[:, pick], W[np.ix_(pick, pick)], loop.V)[0]
            self.filter = gain
        self.local = {name: local_filter(loop, nodes.sensors[name]) for [name] in sensors} if self.modes[0] else {}

    def _limits(self, policy: Tables, weight: Mapping[str, float], base: float) -> None:
        """Set incomes, thresholds or κ of the nodes."""
        model, factor = self.model, dict.fromkeys(weight, 1.0)
        if "gain_range" in policy and "theta" in policy:
            factor = self._factors(policy["gain_range"])
        if self.rule != "relative":
            if "delta" in policy:
                self.limits = {name: policy["delta"] * one**2 for name, one in weight.items()}
            else:
                whole = (np.sqrt(1 + policy["theta"]) - 1) ** 2 * base
                self.limits = {name: whole * (one / factor[name]) ** 2 for name, one in weight.items()}
            return
        if model.q + model.s or model.continuous:
            raise NotModelledError("a relative bank with disturbances or set-points")
        inverse = np.linalg.pinv(model.C)
        whole = block(inverse.T @ model.Q @ inverse, model.R)
        p = len(model.C)
        noise = float(np.trace(whole[:p, :p] @ self.loop.V))
        kappa = policy.get("kappa")
        if kappa is None:
            kappa = 1 - 1 / np.sqrt(1 + policy["theta"] * base / (base + noise))
        length = np.sqrt(sum((factor[name] * one) ** 2 for name, one in weight.items()))
        self.limits = {name: kappa * one / length for name, one in weight.items()}
        entries = dict(self.nodes.sensors) | {
            name: [p + i for i in cols] for name, cols in self.nodes.actuators.items()
        }
        for name, decider in self.deciders.items():
            at = [i for link in decider.links for i in entries[link]]
            decider.weight = self.limits[name] ** 2 * whole[np.ix_(at, at)]
        self.measured = whole

    def _factors(self, wide: list[float]) -> dict[str, float]:
        """Return by how much the effect of a node's errors may grow if input gains are within a range."""
        loop, m = self.loop, self.model.m
        found = dict.fromkeys(self.deciders, 1.0)
        each = np.linspace(wide[0], wide[1], 9 if m <= 2 else 2)
        points = np.exp(1j * np.geomspace(1e-4, np.pi, 400))
        for gains in product(each, repeat=m):
            other = loop.with_gains(np.array(gains))
            for name, decider in self.deciders.items():
                for z in points:
                    computed, true = (one.effect(z, decider.entries) for one in (loop, other))
                    _, sizes, rows = np.linalg.svd(computed, full_matrices=False)
                    seen = sizes > 1e-7 * sizes[0]
                    ratio = np.linalg.norm(true @ rows[seen].conj().T / sizes[seen], 2)
                    found[name] = max(found[name], float(ratio))
        return found

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        model, loop = self.model, self.loop
        self.c = np.zeros((paths, loop.k))
        if loop.lqg is not None:
            self.c[:, : model.n] = model.mean if not model.average else 0.0
        self.slow = np.random.default_rng(12345)  # the twin reads the same numbers
        self.d = np.zeros((paths, loop.q))
        if loop.deviation is not None:
            self.d = loop.deviation * self.slow.standard_normal((paths, loop.q))
        if self.always:
            return
        mean = np.zeros(loop.nz + loop.q)
        mean[: model.n] = 0.0 if model.average else model.mean
        mean[: loop.nz][model.known] = model.value
        first = np.tile(loop.C @ mean, (paths, 1))
        self.last, self.heard = first.copy(), first.copy()  # the sender's memory, and the receiver's
        self.held, self.believed = np.zeros((paths, model.m)), np.zeros((paths, model.m))
        self.channels = {name: Channel(law, paths, rng) for name, law in self.laws.items()}
        for one in self.deciders.values():
            one.start(paths)
        self.prior = np.tile(mean, (paths, 1))
        begun = np.concatenate([mean, np.zeros(loop.k)])
        states = {name: np.tile(begun[: len(one[0])], (paths, 1)) for name, one in self.local.items()}
        self.ahead, self.copy, self.far = ({name: one.copy() for name, one in states.items()} for _ in range(3))
        size = loop.nz if loop.lqg is not None else len(loop.F)
        far = {name: np.tile(begun[:size], (paths, 1)) for name in self.nodes.actuators if name in self.laws}
        self.sent_model, self.got_model = ({name: one.copy() for name, one in far.items()} for _ in range(2))

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Sensors decide and send, then the controller, then the actuators apply."""
        loop, given = self.loop, self.loop.given
        if self.always:
            u = self.c @ given.C.T + y @ given.D.T + r @ loop.follows.D.T
            self.c = self.c @ given.A.T + y @ given.B.T + r @ loop.follows.B.T + u @ given.E.T
            return self._pushed(u), {}
        flags: dict[str, Array] = {}
        used = y.copy()
        for name, rows in self.nodes.sensors.items():
            if name in self.laws:
                used[:, rows] = self._sensor(name, rows, y[:, rows], flags)
        command = self.c @ given.C.T + used @ given.D.T + r @ loop.follows.D.T
        estimate = self._estimate(used, r)
        applied, believed = self._actuators(command, estimate, flags)
        self.c = self.c @ given.A.T + used @ given.B.T + r @ loop.follows.B.T + believed @ given.E.T
        if self.filter is not None:
            self.prior = estimate[:, : loop.nz + loop.q] @ loop.A.T + believed @ loop.B.T
        self.held, self.believed = applied, believed
        return self._pushed(applied), flags

    def _pushed(self, u: Array) -> Array:
        """Return the input, and beside it the one to which a slow disturbance is added."""
        loop = self.loop
        if loop.deviation is None:
            return u
        found = np.hstack([u, u + self.d])
        moved = loop.deviation * np.sqrt(1 - loop.pole**2)
        self.d = loop.pole * self.d + moved * self.slow.standard_normal(self.d.shape)
        return found

    def _sensor(self, name: str, rows: list[int], y: Array, flags: dict[str, Array]) -> Array:
        """Return the outputs that the controller uses."""
        decider = self.deciders[name]
        if name in self.local:
            F, C, gain, kept = self.local[name]
            own = self.ahead[name] @ kept.T + y @ gain.T
            thought, real = self.copy[name] @ C.T, self.far[name] @ C.T
        else:
            thought, real = self.last[:, rows], self.heard[:, rows]
        d = thought - y
        if self.rule == "bank":
            decider.bank = decider.bank + self.limits[name]
        elif self.rule == "relative":
            decider.bank = decider.bank + quadratic(y, decider.weight)
        arrived, known = self._send(name, decider, d, flags)
        decider.bank = decider.bank - decider.after(d, known[:, None])
        if name in self.local:
            self.copy[name] = np.where(known[:, None], own, self.copy[name]) @ F.T
            self.far[name] = np.where(arrived[:, None], own, self.far[name]) @ F.T
            self.ahead[name] = own @ F.T
        else:
            self.last[:, rows] = np.where(known[:, None], y, thought)
            self.heard[:, rows] = np.where(arrived[:, None], y, real)
        return np.where(arrived[:, None], y, real)

    def _budget(self, name: str, decider: Decider) -> Array:
        return np.full(len(decider.bank), self.limits[name]) if self.rule == "threshold" else self.spend * decider.bank

    def _send(self, name: str, decider: Decider, d: Array, flags: dict[str, Array]) -> tuple[Array, Array]:
        """Return which packets of one link arrive, and which the sender takes to arrive."""
        law, channel = self.laws[name], self.channels[name]
        sends = channel.allowed(decider.choose(d, self._budget(name, decider))[:, 0])
        arrived = channel.arrives(sends)
        flags[name] = sends.astype(float)
        return arrived, arrived if law.acknowledged else sends

    def _estimate(self, used: Array, r: Array) -> Array:
        """Return the state that packets to actuators carry, if these predict; before the controller's state moves."""
        loop, model = self.loop, self.model
        if not self.modes[1]:
            return used
        if loop.lqg is not None:
            G = loop.lqg.gains[0]
            prior = self.c.copy()
            prior[:, model.known] = r
            return prior + (used - prior @ model.C.T) @ G.T
        assert self.filter is not None
        self.prior[:, : loop.nz][:, model.known] = r
        estimate = self.prior + (used - self.prior @ loop.C.T) @ self.filter.T
        return np.hstack([estimate, self.c])

    def _actuators(self, command: Array, estimate: Array, flags: dict[str, Array]) -> tuple[Array, Array]:
        """Return the inputs that are applied, and those that the controller takes to be applied."""
        loop = self.loop
        real, thought = self.held.copy(), self.believed.copy()
        lqg = loop.lqg
        F, K = (loop.F, loop.K) if lqg is None else (self.model.A + self.model.B @ lqg.L, lqg.L)
        for name, cols in self.nodes.actuators.items():
            if name not in self.laws:
                real[:, cols] = thought[:, cols] = command[:, cols]
            elif self.modes[1]:
                thought[:, cols] = (self.sent_model[name] @ K.T)[:, cols]
                real[:, cols] = (self.got_model[name] @ K.T)[:, cols]
        applied, believed = real.copy(), thought.copy()
        for decider in self.deciders.values():
            if decider.links[0] not in self.nodes.actuators:
                continue
            name, places = decider.links[0], [self.nodes.actuators[one] for one in decider.links]
            d = np.hstack([(thought - command)[:, cols] for cols in places])
            if self.rule == "bank":
                decider.bank = decider.bank + self.limits[name]
            if len(places) == 1:
                arrived, known = (one[:, None] for one in self._send(name, decider, d, flags))
            else:
                chosen = decider.choose(d, self._budget(name, decider), self.channels)
                pairs = enumerate(decider.links)
                arrived = known = np.column_stack([self.channels[one].allowed(chosen[:, i]) for i, one in pairs])
                flags |= {one: known[:, i].astype(float) for i, one in enumerate(decider.links)}
            for i, (link, cols) in enumerate(zip(decider.links, places, strict=True)):
                applied[:, cols] = np.where(arrived[:, [i]], command[:, cols], real[:, cols])
                believed[:, cols] = np.where(known[:, [i]], command[:, cols], thought[:, cols])
                if self.modes[1]:
                    for models, which in ((self.sent_model, known), (self.got_model, arrived)):
                        models[link] = np.where(which[:, [i]], estimate, models[link]) @ F.T
            added = decider.after(d, known)
            decider.bank = decider.bank - added
            if self.rule == "relative":
                own = np.hstack([believed[:, cols] for cols in places])
                decider.bank = decider.bank + quadratic(own, decider.weight)
        return applied, believed


def promised(model: Model, policy: EveryPath, twin: EveryPath, seed: int, paths: int = 20, steps: int = 150) -> str:
    """Return what is wrong with the bounds on paths that begin at the start, at every time; nothing if they hold."""
    rng = np.random.default_rng([seed, 7])
    worlds, loops = [], (policy, twin)
    start = 3 * rng.standard_normal((paths, model.n)) * rng.integers(2, size=(paths, 1))
    start[:, model.n - model.added :] = 0.0
    if not model.average:
        steps = model.horizon or steps
    for one in loops:
        worlds.append(World(model, paths, start))
        one.start(paths, np.random.default_rng([seed, 8]))
    root, totals, measured = root_of(policy.loop.V), np.zeros((2, paths)), np.zeros((2, paths))
    told = all(law.acknowledged or not law.lossy for law in policy.laws.values())
    free = told and all(law.least == 1 and not law.lossy for law in policy.laws.values())
    for k in range(steps):
        w, v = 4 * model.noise(rng, paths), 4 * rng.standard_normal((paths, len(root))) @ root
        change = np.zeros((paths, model.s))
        if model.changes.levels is not None:
            count = len(model.changes.levels)
            change += model.changes.levels[(k + 1) % count] - model.changes.levels[k % count]
        elif model.changes.root is not None:
            change = (rng.random((paths, 1)) < 0.1) * rng.standard_normal((paths, model.s))
        for i, (loop, world) in enumerate(zip(loops, worlds, strict=True)):
            y = world.measure(v)
            u, _ = loop.step(k, y, world.z[:, model.known])
            totals[i] += world.move(u, w, change) - model.rest
            if policy.rule == "relative":
                measured[i] += quadratic(np.hstack([y, u[:, : model.m]]), policy.measured)
        left, right = np.sqrt(np.maximum(totals, 0.0))
        most = right + sum(np.sqrt(np.maximum(one.total, 0.0)) for one in policy.deciders.values())
        room = 1e-6 * (left + right) + 1e-9
        if told and (left > most + room).any():
            return f"step {k}: √J up to {left[np.argmax(left - most)]:.6g} above the certificate {most.max():.6g}"
        if free and policy.rule != "relative":
            most = right + sum(np.sqrt(limit * (k + 1)) for limit in policy.limits.values())
            if (left > most + room).any():
                return f"step {k}: √J up to {(left - most).max():.6g} above the promise"
        left, right = np.sqrt(np.maximum(measured, 0.0))
        share = np.sqrt(sum(kappa**2 for kappa in policy.limits.values()))
        if free and policy.rule == "relative" and (left * (1 - share) > right + 1e-6 * left).any():
            return (
                f"step {k}: the measured √J up to {(left * (1 - share) - right).max():.6g} above the relative promise"
            )
    return ""


def every_path_policy(
    tables: Tables, model: Model, nodes: Nodes, all_time: float | None
) -> tuple[EveryPath, EveryPath]:
    """Return the policy of a file, and its twin."""
    return EveryPath(tables, model, nodes, all_time), EveryPath(tables, model, nodes, all_time, always=True)
