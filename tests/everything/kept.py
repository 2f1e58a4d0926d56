"""Controllers that a user keeps, LQG over links that drop packets, and slower bases: ``excess`` and dead bands.

The state of the loop is w = (x, d, c, y, r, h): plant, slow disturbances at the inputs, controller, measurement,
set-points, and the value that the receiver uses in silence (an input, or for a sensor link a measurement). With F_a,
M_a for a packet that arrives and F_s, M_s for silence, X_f(P) = M_f + F_f'PF_f, the loop that always attempts has the
value P, and silence costs E[w'Ψw], Ψ = (1 − p)(X_s − X_a), more. Known changes m_k of a timetable make the value w'Pw +
2v_k'w with v_k = F_a'(P m_k + v_{k+1}), so silence costs 2w'(F_s − F_a)'(P m_k + v_{k+1}) besides. LQG is the
controller whose state is the prediction of its observer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from everything.laws import Channel, Law, Nodes, Samples
from everything.plain import Array, Model, NotModelledError, block, inverse, kalman, regulator
from scipy.stats import chi2

Tables = Mapping[str, Any]


@dataclass(frozen=True)
class Given:
    """A controller: c⁺ = A c + B y + E u, command = C c + D y; with the slow disturbance that it compensates."""

    A: Array
    B: Array
    C: Array
    D: Array
    E: Array
    pole: float = 0.0
    deviation: Array | None = None


def given_of(tables: Tables, model: Model, h: float) -> Given:
    """Return the controller of [controller]."""
    table = tables["controller"]
    p, m = len(model.C), model.m
    sign = 1.0 if table.get("sign", "negative") == "positive" else -1.0
    integrates = False
    if "pid" in table:
        A, B, C, D, E = np.zeros((0, 0)), np.zeros((0, p)), np.zeros((m, 0)), np.zeros((m, p)), np.zeros((0, m))
        for one in table["pid"] if isinstance(table["pid"], list) else [table["pid"]]:
            kp, ki, kd = (sign * one.get(key, 0.0) for key in ("kp", "ki", "kd"))
            i, o = one.get("input", 1) - 1, one.get("output", 1) - 1
            unit_in, unit_out = np.eye(m)[:, [i]], np.eye(p)[[o]]
            D = D + kp * unit_in @ unit_out
            if ki:
                integrates = True
                track = one.get("tracking_time")
                A, B, E = block(A, np.eye(1)), np.vstack([B, h * unit_out]), np.vstack([E, np.zeros((1, m))])
                C = np.hstack([C, ki * unit_in])
                if track is not None:
                    E[-1] = h / (track * ki) * unit_in[:, 0]
            elif "tracking_time" in one:
                raise NotModelledError("a tracking time without integral")
            if kd:
                tf = one["filter"]
                A, B, E = (
                    block(A, np.array([[1 - h / tf]])),
                    np.vstack([B, h / tf * unit_out]),
                    np.vstack([E, np.zeros((1, m))]),
                )
                C, D = np.hstack([C, -kd / tf * unit_in]), D + kd / tf * unit_in @ unit_out
        # the integral follows the applied input: I⁺ = I + h y + h/(T ki)(u − command)
        command_c, command_y = C, D
        A, B = A - E @ command_c, B - E @ command_y
    else:
        D = sign * np.array(table.get("D", np.zeros((m, p))), dtype=float)
        k = len(table.get("A", []))
        A = np.array(table.get("A", np.zeros((0, 0))), dtype=float).reshape(k, k)
        B = np.array(table.get("B", np.zeros((0, p))), dtype=float).reshape(len(A), p)
        C = sign * np.array(table.get("C", np.zeros((m, 0))), dtype=float).reshape(m, len(A))
        E = np.array(table.get("E", np.zeros((len(A), m))), dtype=float).reshape(len(A), m)
        if "method" in table:  # Tustin: s = (2/h)(z − 1)/(z + 1)
            if table["method"] != "tustin":
                raise NotModelledError("controllers by zoh")
            inverse = np.linalg.inv(np.eye(len(A)) - h / 2 * A)
            A, B, C, D = (
                inverse @ (np.eye(len(A)) + h / 2 * A),
                h * inverse @ B,
                C @ inverse,
                D + h / 2 * C @ inverse @ B,
            )
            # in coordinates in which the state enters as it did
        integrates = bool(len(A)) and bool((np.abs(np.linalg.eigvals(A) - 1) < 1e-9).any())
    stated = table.get("disturbance")
    if stated == "none" or (stated is None and not integrates):
        return Given(A, B, C, D, E)
    stated = stated or {}
    inverse = np.linalg.pinv(np.array(tables["plant"]["B"], dtype=float))
    jumps = tables["plant"].get("jumps")
    W = np.array(tables["plant"]["W"] if jumps is None else jumps["covariance"], dtype=float)
    W = W * (1.0 if jumps is None else jumps["rate"]) / (h if model.continuous else 1.0)  # per step
    usual = 0.5 * np.sqrt(np.maximum(np.diag(inverse @ W @ inverse.T), 0.0))
    deviation = np.broadcast_to(np.asarray(stated.get("deviation", usual), dtype=float), (m,)).copy()
    return Given(A, B, C, D, E, float(np.exp(-h / stated.get("time_constant", 1000 * h))), deviation)


@dataclass(frozen=True, eq=False)
class Follows:
    """How the controller uses set-points: their effect on its state, and on the command."""

    B: Array
    D: Array


def following(tables: Tables, model: Model, given: Given, h: float) -> Follows:
    """Return the use of set-points by a given controller: it has inputs for them, or compares each with an output."""
    table, rows = tables["controller"], np.zeros((len(model.C), model.s))
    if "F" in table or "G" in table:
        if "method" in table:
            raise NotModelledError("inputs for set-points of a controller in continuous time")
        F = np.array(table.get("F", np.zeros((len(given.A), model.s))), dtype=float).reshape(len(given.A), model.s)
        return Follows(F, np.array(table.get("G", np.zeros((model.m, model.s))), dtype=float))
    if not model.s:
        return Follows(np.zeros((len(given.A), 0)), np.zeros((model.m, 0)))
    outputs = tables["reference"].get("outputs")
    stated = np.array(tables["plant"]["C"], dtype=float)
    for place in range(model.s):
        same = [place] if outputs is None else [
            i for i, row in enumerate(stated) if np.array_equal(row, np.array(outputs[place], dtype=float))
        ]  # fmt: skip
        if not same:
            raise NotModelledError("a set-point of no output")
        rows[same[0], place] = 1.0
    if "pid" not in table:
        return Follows(-given.B @ rows, -given.D @ rows)
    sign = 1.0 if table.get("sign", "negative") == "positive" else -1.0
    many = table["pid"] if isinstance(table["pid"], list) else [table["pid"]]
    D, B = np.zeros((model.m, len(rows))), list[Array]()
    for one in many:  # u = sign · (kp (y − b r) + ki Σ(y − r) + kd d(y − c r)/dt)
        i, o = one.get("input", 1) - 1, np.eye(len(rows))[one.get("output", 1) - 1]
        kp, kd = (sign * one.get(key, 0.0) for key in ("kp", "kd"))
        D[i] -= kp * one.get("b", 1.0) * o
        if one.get("ki", 0.0):
            B.append(-h * o)
        if kd:
            B.append(-h / one["filter"] * one.get("c", 0.0) * o)
            D[i] -= kd / one["filter"] * one.get("c", 0.0) * o
    moved = np.array(B).reshape(len(given.A), len(rows)) - given.E @ D  # E has the applied input, and not the command
    return Follows(moved @ rows, D @ rows)


def observer(model: Model, every: int = 1, gains: str = "lqg", law: Law | None = None, silence: str = "hold") -> Given:
    """Return LQG as a controller whose state is the prediction of its observer."""
    n = model.n
    A, B = model.A[:n, :n], model.B[:n]
    if every > 1:
        L = lifted_gain(A, B, model.Q, model.R, model.N, every)
    elif gains == "loss-optimal":
        assert law is not None
        L = gain_for_losses(A, B, model.Q, model.R, model.N, law.loss, silence)
    else:
        L = regulator(A, B, model.Q, model.R, model.N)[2]
    if model.whole:
        return Given(np.zeros((0, 0)), np.zeros((0, n)), np.zeros((model.m, 0)), L, np.zeros((0, model.m)))
    G = model.exact_gain if model.V is None else kalman(A, model.C, model.W, model.V)[0]
    left = np.eye(n) - G @ model.C
    return Given(A @ left, A @ G, L @ left, L @ G, B)


def lifted(A: Array, B: Array, Q: Array, R: Array, N: Array, steps: int) -> tuple[Array, Array, Array, Array, Array]:
    """Return the problem of several steps with one input that is held."""
    n, m = B.shape
    F = np.block([[A, B], [np.zeros((m, n)), np.eye(m)]])
    stage, total, power = np.block([[Q, N], [N.T, R]]), np.zeros((n + m, n + m)), np.eye(n + m)
    for _ in range(steps):
        total, power = total + power.T @ stage @ power, F @ power
    return power[:n, :n], power[:n, n:], total[:n, :n], total[n:, n:], total[:n, n:]


def lifted_gain(A: Array, B: Array, Q: Array, R: Array, N: Array, steps: int) -> Array:
    """Return the best gain of an input that is held for so many steps."""
    return regulator(*lifted(A, B, Q, R, N, steps))[2]


def gain_for_losses(A: Array, B: Array, Q: Array, R: Array, N: Array, loss: float, silence: str) -> Array:
    """Return the gain that costs least if every packet is attempted: value iteration over (x, held input)."""
    n, m = B.shape
    P, L = np.zeros((n + m, n + m)), np.zeros((m, n))
    stage = np.block([[Q, N], [N.T, R]])
    keep = np.eye(m) if silence == "hold" else np.zeros((m, m))
    F_u = np.block([[A, B], [np.zeros((m, n)), np.eye(m)]])  # of (x, u)
    silent = np.block([[np.eye(n), np.zeros((n, m))], [np.zeros((m, n)), keep]])
    for _ in range(20_000):
        whole = stage + F_u.T @ P @ F_u  # of (x, u), u the input that is applied
        L = -inverse(whole[n:, n:]) @ whole[n:, :n]
        best = np.hstack([np.vstack([np.eye(n), L]), np.zeros((n + m, m))])
        new = (1 - loss) * best.T @ whole @ best + loss * silent.T @ whole @ silent
        if np.abs(new - P).max() <= 1e-13 * np.abs(new).max():
            return L
        P = new
    raise NotModelledError("gains for losses that do not settle")


EVENTS = ("event-pid", "event-pid-saturated")
CYCLES = 60  # of a timetable, after which a loop is taken to repeat itself


class Base:
    """The loop that always attempts, and what silence costs more.

    Args:
        model: the plant.
        given: the controller.
        link: "actuator" or "sensor".
        silence: "hold", "zero" or "model" (in which what is used in silence is no part of the value).
        law: of the link.
        every: steps between the packets of the base.
    """

    def __init__(
        self, model: Model, given: Given, link: str, silence: str, law: Law, every: int, follows: Follows | None = None
    ) -> None:
        """Compute value, cost and advantage."""
        n, m, p, k = model.n, model.m, len(model.C), len(given.A)
        q = m if given.deviation is not None else 0
        s = 0 if follows is None else model.s
        follows = follows or Follows(np.zeros((k, 0)), np.zeros((m, 0)))
        self.sizes = (n, q, k, p, s, m if link == "actuator" else p)
        A, B, C = model.A[:n, :n], model.B[:n], model.C[:, :n]
        B_d = model.pushing[:n, :q]
        size = sum(self.sizes)
        x, d, c, y, r, h = np.split(np.eye(size), np.cumsum(self.sizes)[:-1])  # rows that pick a part of w
        X, U = (place @ r if s else 0.0 for place in (model.X, model.U))

        def loop(used: Array) -> tuple[Array, Array]:
            """Return F and M if the receiver uses a combination of w."""
            u = used if link == "actuator" else given.C @ c + given.D @ used + follows.D @ r
            seen = y if link == "actuator" else used
            moved = A @ x + B @ u + (B_d @ d if q else 0.0)
            kept = given.A @ c + given.B @ seen + given.E @ u + follows.B @ r
            F = np.vstack([moved, given.pole * d, kept, C @ moved, r, used])
            joint = np.vstack([x - X, (u + d if q else u) - U, u - U])
            return F, joint.T @ model.pushed @ joint

        sent = given.C @ c + given.D @ y + follows.D @ r if link == "actuator" else y
        self.arrives, self.silent = loop(sent), loop(h if silence != "zero" else np.zeros_like(h))
        V = np.zeros((p, p)) if model.V is None else model.V
        spread = np.vstack([np.eye(n), np.zeros((q + k, n)), C, np.zeros((s + self.sizes[5], n))])
        self.noise = spread @ model.W[:n, :n] @ spread.T
        at = np.arange(n, n + q)
        if q:
            assert given.deviation is not None
            self.noise[at, at] += given.deviation**2 * (1 - given.pole**2)
        place = n + q + k
        self.noise[place : place + p, place : place + p] += V
        self.known = slice(place + p, place + p + s)
        if s and model.changes.root is not None:
            self.noise[self.known, self.known] += model.changes.rate * model.changes.root @ model.changes.root
        self.law, self.every, self.model = law, every, model
        self._value()
        self.exact = self.cost + model.rest
        self.slopes = np.zeros((1, size))
        if s and model.changes.levels is not None:
            if law.lossy or every > 1:
                raise NotModelledError("a timetable over losses, or with a slower base")
            self._timetable(model.changes.levels)

    def _timetable(self, levels: Array) -> None:
        """Add what known changes cost, and the slopes of silence before them."""
        count = len(levels)
        moves = np.zeros((count, len(self.noise)))
        moves[:, self.known] = np.roll(levels, -1, axis=0) - levels
        F, M = self.arrives
        w = np.zeros(len(F))
        w[self.known] = levels[0]
        for k in range(CYCLES * count):
            if k == (CYCLES - 1) * count:
                before = self.exact
            if k >= (CYCLES - 1) * count:
                self.exact += float(w @ M @ w) / count
            w = F @ w + moves[k % count]
        assert self.exact >= before - 1e-12 * abs(before)
        value, self.slopes = np.zeros(len(F)), np.zeros((count, len(F)))
        for k in reversed(range(CYCLES * count)):
            ahead = self.P[0, 0] @ moves[k % count] + value
            value = F.T @ ahead
            self.slopes[k % count] = 2 * (self.silent[0] - F).T @ ahead

    def _value(self) -> None:
        law, size = self.law, len(self.noise)
        modes, phases = len(law.drops), self.every
        P = np.zeros((phases, modes, size, size))
        for _ in range(60_000):
            new = np.empty_like(P)
            for j in reversed(range(phases)):
                ahead = P[(j + 1) % phases] if j == phases - 1 else new[j + 1]
                mixed = np.tensordot(law.moves, ahead, 1) if modes > 1 else ahead
                for a in range(modes):
                    silent, sent = bellman(self.silent, mixed[a]), bellman(self.arrives, mixed[a])
                    new[j, a] = silent if j else law.drops[a] * silent + (1 - law.drops[a]) * sent
            change, largest = np.abs(new - P).max(), np.abs(new).max()
            P = new
            if change <= 1e-13 * largest:
                break
            if not largest < 1e30:
                raise NotModelledError("a base that is not stable")
        else:
            raise NotModelledError("a base that settles too slowly")
        self.P = P
        chances = law.stationary
        self.cost = float(np.mean([np.einsum("a,ab,bij,ij", chances, law.moves, P[(j + 1) % phases], self.noise)
                                   for j in range(phases)]))  # fmt: skip
        self.psi = np.empty_like(P)
        for j in range(phases):
            mixed = np.einsum("ab,bij->aij", law.moves, P[(j + 1) % phases])
            for a in range(modes):
                gain = bellman(self.silent, mixed[a]) - bellman(self.arrives, mixed[a])
                self.psi[j, a] = (1 - law.drops[a]) * gain


def bellman(branch: tuple[Array, Array], P: Array) -> Array:
    """Return the value before a step."""
    F, M = branch
    return M + F.T @ P @ F


class KeptPolicy:
    """A given controller, or LQG, whose packets are decided by what silence costs, or by a dead band."""

    def __init__(
        self, model: Model, given: Given, *, link: str, silence: str, law: Law, rule: str, level: float,
        every: int = 1, retry: bool = False, always: bool = False, told: bool = True, base: Base | None = None,
        watched: bool = True, follows: Follows | None = None, cycle: tuple[int, ...] = (1,),
    ) -> None:  # fmt: skip
        """Keep everything.

        Args:
            model, given, link, silence, law, every, retry: as in the file.
            rule: "cost", "band", "level" or "clock".
            level: δ, or Δ.
            cycle: intervals between the packets of a clock.
            always: whether every sample is attempted.
            told: whether the sender learns what arrived; otherwise it assumes that everything does.
            base: the loop that always attempts.
            watched: whether large innovations raise an alarm.
            follows: the use of set-points by the controller.
        """
        self.follows = follows or Follows(np.zeros((len(given.A), 0)), np.zeros((model.m, 0)))
        self.model, self.given, self.silence, self.law = model, given, silence, law
        self.side, self.link = link, link  # the link may have another name
        self.rule, self.level, self.every, self.retry = rule, level, every, retry
        self.sends = [k == 0 for steps in cycle for k in range(steps)]
        self.always, self.told, self.base = always, told, base
        self.precision: Array | None = None  # of the innovations, whose squares raise an alarm
        self.samples: Samples | None = None  # None: none is missing
        # a slow disturbance moves between the samples of a continuous plant, and here at samples alone
        self.approximate = model.continuous and given.deviation is not None
        self.exact = None if base is None or not always else base.exact
        n, q = model.n, model.m if given.deviation is not None else 0
        self.q = q
        self.F = np.block([[model.A[:n, :n], model.pushing[:n, :q]], [np.zeros((q, n)), given.pole * np.eye(q)]])
        self.B = np.vstack([model.B[:n], np.zeros((q, model.m))])
        self.C = np.hstack([model.C[:, :n], np.zeros((len(model.C), q))])
        W = model.W[:n, :n]
        if q:
            assert given.deviation is not None
            W = block(W, np.diag(given.deviation**2 * (1 - given.pole**2)))
        V = np.zeros((len(model.C), len(model.C))) if model.V is None else model.V
        self.W, self.V = W, V
        if model.V is None and not q:
            self.G = model.exact_gain
        else:
            self.G, prior = kalman(self.F, self.C, W, V)[:2]
            if rule == "cost" and every == 1 and watched:
                self.precision = np.linalg.pinv(self.C @ prior @ self.C.T + V)
                freedom = 99 * len(self.precision)  # the average of white squares has the moments of χ²/99
                self.largest = chi2.ppf(1 - 1e-9, freedom) / 99
        filtered = (np.eye(len(self.F)) - self.G @ self.C) @ self.F
        parts = [filtered]
        if base is not None:  # slow disturbances begin with their stationary distribution
            rest = np.delete(np.arange(len(base.noise)), [*range(n, n + q), *range(base.known.start, base.known.stop)])
            parts.append(base.arrives[0][np.ix_(rest, rest)])
        modes = np.concatenate([np.linalg.eigvals(part) for part in parts])
        modes = modes[np.abs(modes - given.pole) > 1e-9]  # the disturbance begins in its stationary distribution
        self.radius = float(np.abs(modes).max(initial=0.0))

    def miss(self, samples: Samples) -> None:
        """Let samples be missing: another gain of a filter, and no exact cost."""
        model, self.samples, self.exact = self.model, samples, None
        if self.rule == "cost" and not (model.V is None and not self.q):
            self.G, covariance = samples.gain(self.F, self.C, self.W, self.V)
            if self.precision is not None:
                self.precision = np.linalg.pinv(covariance, hermitian=True)

    def _completed(self, y: Array) -> Array:
        """Return the measurement with what the node takes for a missing one, and correct the controller after a gap."""
        assert self.samples is not None
        known = self.samples.known()
        if self.rule == "cost":
            return np.where(known, y, self.prior @ self.C.T)
        if self.model.V is None and not self.q and self.side == "actuator":  # the model of a measured state
            return np.where(known, y, self.prior @ self.C.T)
        if self.side == "actuator":
            # the states of the controller if the samples of the gap had lain on a line, and not on the last one
            slope = np.where(known, (y - self.seen) / (self.gap + 1), 0.0)
            self.c = self.c + np.einsum("pnj,pj->pn", self.turned, slope)
            self.gap = np.where(known, 0, self.gap + 1)
            grown = np.einsum("nm,pmj->pnj", self.given.A, self.turned) + self.given.B * self.gap[:, None, :]
            self.turned = np.where(known[:, None, :], 0.0, grown)
        self.seen = np.where(known, y, self.seen)
        return self.seen

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        model, given = self.model, self.given
        if self.samples is not None:
            self.samples.start(paths, rng)
        self.seen, self.gap = np.zeros((paths, len(model.C))), np.zeros((paths, len(model.C)), dtype=int)
        self.turned = np.zeros((paths, len(given.A), len(model.C)))
        self.prior = np.zeros((paths, len(self.F)))
        self.c = np.zeros((paths, len(given.A)))
        size = model.m if self.side == "actuator" else len(model.C)
        self.h = np.zeros((paths, size))  # what the sender takes the receiver to use in silence
        self.real = self.h.copy()  # what it uses
        self.copy = np.zeros((paths, len(self.F) + len(given.A)))  # plant and controller at the receiver
        self.copied = np.zeros((paths, self.follows.D.shape[1]))  # set-points there
        self.channel = Channel(self.law, paths, rng)
        self.belief = np.tile(self.law.stationary, (paths, 1))
        self.missed = np.zeros(paths, dtype=bool)
        self.surprise = np.zeros(paths)
        self.d = np.zeros((paths, self.q))
        if given.deviation is not None:
            self.d = given.deviation * self.noise(paths)
        self.rng = rng

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Make a step; a slow disturbance is added to the input that the plant gets, and moves here."""
        given, size = self.given, len(self.F)
        y = y if self.samples is None else self._completed(y)
        estimate = self.prior + (y - self.prior @ self.C.T) @ self.G.T
        r = r[:, : self.follows.D.shape[1]]
        read, taken = r @ self.follows.D.T, r @ self.follows.B.T
        command = self.c @ given.C.T + y @ given.D.T + read
        sent = command if self.side == "actuator" else y
        if self.rule == "level":  # the multiples of Δ by which the output is away from the last one
            sent = self.h + self.level * np.trunc((y - self.h) / self.level)
        if self.silence == "model":
            inner, outer = self.copy[:, :size], self.copy[:, size:]
            seen = inner @ self.C.T
            self.h = seen
            if self.side == "actuator":
                self.h = outer @ given.C.T + seen @ given.D.T + self.copied @ self.follows.D.T
            self.real = self.h
        elif self.silence == "zero":
            self.h, self.real = np.zeros_like(self.h), np.zeros_like(self.real)
        wants = self._wants(k, estimate, y, r, sent)
        wants = np.ones_like(wants) if self.always else wants | (self.missed & self.retry)
        sends = self.channel.allowed(wants)
        arrived = self.channel.arrives(sends) if self.law.lossy else sends
        self._learn(sends, arrived)
        known = arrived if self.told else sends
        used, believed = np.where(arrived[:, None], sent, self.real), np.where(known[:, None], sent, self.h)
        if self.side == "actuator":
            u, seen, thought = used, y, believed
        else:
            own = self.c @ given.C.T + read
            u, seen, thought = own + used @ given.D.T, used, own + believed @ given.D.T
        if self.silence == "model":
            self._copy(known, estimate, y, r, u)
        self.c = self.c @ given.A.T + seen @ given.B.T + thought @ given.E.T + taken
        self.prior = estimate @ self.F.T + thought @ self.B.T
        self.h, self.real, self.missed = believed, used, sends & ~arrived
        return self.pushing(u), {self.link: sends.astype(float)}

    def pushing(self, u: Array) -> Array:
        """Return the input, followed by what the plant gets, if a slow disturbance is added to it; it moves."""
        given = self.given
        if not self.q:
            return u
        assert given.deviation is not None
        applied, moved = u + self.d, given.deviation * np.sqrt(1 - given.pole**2)
        self.pushed, self.d = self.d, given.pole * self.d + moved * self.noise(len(u))
        return np.hstack([u, applied])

    def noise(self, paths: int) -> Array:
        """Return the noise of the slow disturbance, from numbers that a twin shares."""
        return self.shared.standard_normal((paths, self.q))

    def _wants(self, k: int, estimate: Array, y: Array, r: Array, sent: Array) -> Array:
        if self.rule == "clock":
            return np.full(len(y), self.sends[k % len(self.sends)])
        if self.rule == "level":
            return (np.abs(y - self.h) > self.level).any(axis=1)
        if self.rule == "band":
            return (np.abs(sent - self.h) > self.level).any(axis=1)
        assert self.base is not None
        w = np.hstack([estimate, self.c, y, r, self.h])
        psi, slopes = self.base.psi[k % self.every], self.base.slopes
        cost = np.einsum("pa,aij,pi,pj->p", self.belief, psi, w, w) + w @ slopes[k % len(slopes)]
        return (cost > self.level) | self._alarm(y)

    def _alarm(self, y: Array) -> Array:
        """Tell where the average square of the innovations is beyond what noise explains; then every sample is sent."""
        if self.precision is None:
            return np.zeros(len(y), dtype=bool)
        innovation = y - self.prior @ self.C.T
        self.surprise = 0.98 * self.surprise + 0.02 * np.einsum("pi,ij,pj->p", innovation, self.precision, innovation)
        return self.surprise > self.largest

    def _learn(self, sends: Array, arrived: Array) -> None:
        """Move the belief about the channel by what an acknowledgement says, and by a step."""
        law = self.law
        if len(law.drops) == 1:
            return
        seen = np.where(arrived[:, None], 1 - law.drops, law.drops)
        belief = np.where(sends[:, None], self.belief * seen, self.belief)
        self.belief = belief / belief.sum(axis=1, keepdims=True) @ law.moves

    def _copy(self, arrived: Array, estimate: Array, y: Array, r: Array, u: Array) -> None:
        """Let the receiver go on with plant and controller, from the packet if one arrived."""
        given, size = self.given, len(self.F)
        inner = np.where(arrived[:, None], estimate, self.copy[:, :size])
        outer = np.where(arrived[:, None], self.c, self.copy[:, size:])
        seen = np.where(arrived[:, None], y, self.copy[:, :size] @ self.C.T)
        self.copied = np.where(arrived[:, None], r, self.copied)
        new_outer = outer @ given.A.T + seen @ given.B.T + u @ given.E.T + self.copied @ self.follows.B.T
        self.copy = np.hstack([inner @ self.F.T + u @ self.B.T, new_outer])


class EventPID(KeptPolicy):
    """A PID that computes at packets, and when its set-point changes, with the time since the last computation."""

    def __init__(self, kept: KeptPolicy, tables: Tables, h: float) -> None:
        """Take everything of a dead band at the sensor."""
        vars(self).update(vars(kept))
        pids, policy = tables["controller"]["pid"], tables["policy"]
        self.pid, self.seconds = (pids[0] if isinstance(pids, list) else pids), h
        self.saturated = policy["kind"] == "event-pid-saturated"
        self.longest = policy.get("longest")
        self.sign = 1.0 if tables["controller"].get("sign", "negative") == "positive" else -1.0
        if self.pid.get("setpoint") or "start_input" in self.pid or model_rest(kept.model):
            raise NotModelledError("an event-based PID that does not start at rest")

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        super().start(paths, rng)
        self.integral, self.slope, self.filtered, self.command = (np.zeros((paths, 1)) for _ in range(4))
        self.since, self.silent = np.ones(paths, dtype=int), np.full(paths, 10**6)
        self.last: Array | None = None

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Make a step."""
        pid, h = self.pid, self.seconds
        y = y if self.samples is None else self._completed(y)
        r = r[:, : self.follows.D.shape[1]] if self.follows.D.shape[1] else np.zeros_like(y)
        last = r if self.last is None else self.last
        wants = (np.abs(y - self.h) > self.level).any(axis=1)
        if self.longest is not None:
            wants |= self.silent >= max(np.ceil(self.longest / h - 1e-9), 1.0)
        self.silent = np.where(wants, 1, self.silent + 1)
        self.h = np.where(wants[:, None], y, self.h)
        now = (wants | (r != last).any(axis=1))[:, None]
        time = (self.since * h)[:, None]
        T = pid["filter"] - h if pid.get("kd") else 0.0
        filtered = self.h - pid.get("c", 0.0) * r
        slope = (T * self.slope + pid.get("kd", 0.0) * (filtered - self.filtered)) / (T + time)
        command = self.sign * (pid.get("kp", 0.0) * (self.h - pid.get("b", 1.0) * r) + self.integral + slope)
        before = self.h - last
        area = h * before + (time - h) * (np.clip(before, -self.level, self.level) if self.saturated else before)
        integral = self.integral + pid.get("ki", 0.0) * (area + h * (last - r))
        self.command, self.integral = np.where(now, command, self.command), np.where(now, integral, self.integral)
        self.slope, self.filtered = np.where(now, slope, self.slope), np.where(now, filtered, self.filtered)
        self.since, self.last = np.where(now[:, 0], 1, self.since + 1), r
        return self.pushing(self.command), {self.link: wants.astype(float)}


def model_rest(model: Model) -> bool:
    """Return whether a plant starts away from the point around which it is regulated."""
    return bool(model.mean.any())


def kept_policy(tables: Tables, model: Model, nodes: Nodes) -> tuple[KeptPolicy, KeptPolicy | None]:
    """Return a kind that keeps a controller, or ``excess`` over losses or with a given base, and its twin."""
    policy = tables["policy"]
    kind, silence = policy["kind"], policy.get("actuation", "hold")
    bands = {"send-on-delta": "band", "symmetric-send-on-delta": "level"} | dict.fromkeys(EVENTS, "band")
    link = policy.get("link", "sensor" if kind in bands else "actuator")
    if not model.average:
        raise NotModelledError("a kept controller over a horizon")
    if model.q or (model.s and "controller" not in tables):
        raise NotModelledError("a kept controller with disturbances, or LQG of this kind with set-points")
    law = nodes.laws.get(link, Law())
    every = 1 if kind == "periodic" else policy.get("every", 1)
    h = model.seconds if model.continuous else float(tables["plant"]["dt"])
    told = law.acknowledged or not law.lossy
    design = law if told else Law(least=law.least, most=law.most)
    if silence == "model" and ((law.lossy and told) or every > 1):  # a base that predicts too
        raise NotModelledError("a model over losses, or with a slower base")
    follows = None
    if "controller" in tables:
        given = given_of(tables, model, h)
        follows = following(tables, model, given, h)
    else:
        given = observer(model, every, policy.get("gains", "lqg"), design, silence)
    base = Base(model, given, link, "hold" if silence == "model" else silence, design, every, follows)
    cycle = policy.get("every", 1) if kind == "periodic" else 1
    if kind in bands:
        rule, level = bands[kind], float(policy["delta"])
    elif kind in ("all-time", "periodic"):
        rule, level = "clock", 0.0
    else:
        level = float(policy["delta"]) if "delta" in policy else policy["theta"] * (base.exact - model.rest)
        rule = "cost"
    keys: dict[str, Any] = {"link": link, "silence": silence, "law": law, "rule": rule, "every": every, "told": told,
                            "follows": follows, "cycle": tuple(np.atleast_1d(cycle).tolist())}  # fmt: skip
    keys["retry"] = policy.get("retry", False)
    plain = link == "actuator" and every == 1 and silence != "zero" and not (law.lossy and told)
    keys["watched"] = "controller" in tables or not plain  # LQG alone needs no alarm
    own = KeptPolicy(model, given, level=level, base=base, **keys)
    if kind in EVENTS:
        own = EventPID(own, tables, h)
    twin = None
    if every == 1 and told:
        free = Law(law.drops, law.moves, law.acknowledged)
        twin = KeptPolicy(model, given, level=level, base=base, always=True, **{**keys, "law": free, "rule": "band"})
    for one in filter(None, (own, twin)):
        one.shared = np.random.default_rng(12345)  # each reads the same numbers
    if law.lossy or model.function is not None:
        twin = None  # other fates: no common noise; the exact cost is that of a linear plant
    return own, twin


def weights_as_kept(tables: Tables, model: Model) -> tuple[Array, Array, Array]:
    """Return Q, R and N with which each output and input of the present loop contributes 1."""
    given = given_of(tables, model, model.seconds if model.continuous else float(tables["plant"]["dt"]))
    base = Base(model, given, "actuator", "hold", Law(), 1)
    F, size = base.arrives[0], len(base.noise)
    S = np.zeros((size, size))
    for _ in range(200_000):
        new = F @ S @ F.T + base.noise
        if np.abs(new - S).max() <= 1e-13 * np.abs(new).max():
            break
        S = new
    n, m = model.n, model.m
    C = np.array(tables["plant"]["C"], dtype=float)
    D = np.array(tables["plant"].get("D", np.zeros((len(C), m))), dtype=float)
    x, _, c, y, _, _ = np.split(np.eye(size), np.cumsum(base.sizes)[:-1])
    acts = model.acting[:, :n] @ x + model.acting[:, -m:] @ (given.C @ c + given.D @ y)
    seen = C @ x[: n - model.added] + D @ acts  # with the input that acts then
    one = np.diag(1 / np.diag(seen @ S @ seen.T))
    R = np.diag(1 / np.diag(S[-m:, -m:])) + D.T @ one @ D
    return C.T @ one @ C, R, C.T @ one @ D
