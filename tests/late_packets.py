"""Loops with late packets, packet by packet: the delay of each is drawn when it is sent, and kept in the state.

``taciturn.base.late`` knows a packet in flight by the law of what it may still do. Here the state of a finite Markov
chain contains the delay itself, so that hazards, modes and their values are checked by something that has none. The
second moments of plant, estimate and inputs follow for decisions that are drawn; their sum is the exact cost.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.linalg as la

from taciturn._arrays import block_diagonal, symmetrised
from taciturn.base.late import Delays, LateValue
from taciturn.base.periods import Period, Periods
from taciturn.lqg.quadratic import Quadratic
from taciturn.lqg.sampling import Sampled, sample


def held(
    A: np.ndarray, B: np.ndarray, S: np.ndarray, W: np.ndarray, time: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Return Φ, Γ, the weight of (x, u), the covariance and its cost over a time with a held input, by exponentials."""
    n, m = B.shape
    F = np.block([[A, B], [np.zeros((m, n + m))]])
    E = la.expm(np.block([[-F.T, S], [np.zeros_like(F), F]]) * time)
    P = E[n + m :, n + m :]
    none, unit = np.zeros((n, n)), np.eye(n)
    G = la.expm(np.block([[-A, unit, none], [none, -A, W], [none, none, A.T]]) * time)
    last = G[2 * n :, 2 * n :].T
    cost = float(np.trace(last @ G[:n, 2 * n :] @ S[:n, :n]))
    return P[:n, :n], P[:n, n:], P.T @ E[: n + m, n + m :], last @ G[n : 2 * n, 2 * n :], cost


@dataclass(frozen=True, eq=False)
class LateLoop:
    """A plant, discrete or with a period, its outputs, and a filter or a given controller; the gain by the mode."""

    A: np.ndarray
    B: np.ndarray
    S: np.ndarray  # weight of (x, u), per step or unit of time
    W: np.ndarray
    C: np.ndarray
    V: np.ndarray
    delays: Delays
    gain: Callable[[tuple[int, ...]], np.ndarray]  # of (s, registers, û), by the ages of the packets in flight
    period: float | None = None
    filter: np.ndarray | None = None  # gain of the filter; or the matrices of a controller
    controller: tuple[np.ndarray, np.ndarray, np.ndarray] = ()  # A, B, E
    receivers: tuple[tuple[int, ...], ...] = ()
    _kept: dict[Any, Any] = field(default_factory=dict)

    def moves(self, cuts: Sequence[tuple[float, int]], count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Return x⁺ and weight for (x, u_0, …), covariance and its cost, with the input of each piece of the period."""
        (n, m), h = self.B.shape, self.period
        if h is None:
            used = cuts[-1][1]
            T = np.vstack([np.eye(n, n + count * m), np.eye(m, n + count * m, n + used * m)])
            return np.hstack([self.A, self.B]) @ T, T.T @ self.S @ T, self.W, 0.0
        E, M = np.eye(n, n + count * m), np.zeros((n + count * m,) * 2)
        for (begin, used), (end, _) in pairwise([*cuts, (1.0, 0)]):
            if end <= begin:
                continue
            Phi, Gamma, S, _, _ = held(self.A, self.B, self.S, self.W, (end - begin) * h)
            u = np.eye(m, n + count * m, n + used * m)
            T = np.vstack([E, u])
            M, E = M + T.T @ S @ T, Phi @ E + Gamma @ u
        *_, W, c = held(self.A, self.B, self.S, self.W, h)
        return E, (M + M.T) / 2, W, c

    def step(self, path: tuple[tuple[float, int, int], ...], sent: tuple[bool, ...], ages: tuple[int, ...]) -> Any:
        """Return F, M, the covariance and the cost of noise for (x, further, registers, û), after arrivals in order."""
        key = (path, sent, ages)
        if key in self._kept:
            return self._kept[key]
        (n, m), D = self.B.shape, self.delays.depth
        k = n if self.filter is not None else len(self.C) + len(self.controller[0])  # estimate, or (y, xc)
        size = n + k + m * (D + 1)
        whole = np.eye(size)
        known = whole[n:] if self.filter is not None else whole  # what the gain reads
        command, last = self.gain(ages) @ known, whole[size - m :]
        inputs, cuts = [last], [(0.0, 0)]
        for fraction, age, receiver in path:
            u = inputs[-1].copy()
            rows = [*self.receivers[receiver]]
            u[rows] = (command if age == 0 else whole[n + k + (age - 1) * m : n + k + age * m])[rows]
            cuts.append((fraction, len(inputs)))
            inputs.append(u)
        E, M, W, c = self.moves(cuts, len(inputs))
        T = np.vstack([whole[:n], *inputs])
        x = E @ T
        if self.filter is not None:
            predicted = E @ np.vstack([whole[n : n + n], *inputs])
            G = self.filter
            rest = predicted + G @ self.C @ (x - predicted)
            noise = np.vstack([np.eye(n), G @ self.C]), np.vstack([np.zeros((n, len(self.V))), G])
        else:
            (Ac, Bc, Ec), p = self.controller, len(self.C)
            rest = np.vstack([
                self.C @ x, Bc @ whole[n : n + p] + Ac @ whole[n + p : n + k] + Ec @ inputs[-1]
            ])  # fmt: skip
            zero = np.zeros((len(Ac), n))
            noise = np.vstack([np.eye(n), self.C, zero]), np.vstack([
                np.zeros((n, p)), np.eye(p), np.zeros((len(Ac), p))
            ])  # fmt: skip
        packet = (whole[n + k : n + k + m] if D else last).copy()
        for rows, goes in zip(self.receivers, sent, strict=True):
            if goes:
                packet[[*rows]] = command[[*rows]]
        registers = np.vstack([packet, whole[n + k : size - m]])[: D * m]
        F = np.vstack([x, rest, registers, inputs[-1]])
        N = np.zeros((size, size))
        N[: n + k, : n + k] = noise[0] @ W @ noise[0].T + noise[1] @ self.V @ noise[1].T
        self._kept[key] = F, T.T @ M @ T, N, c
        return self._kept[key]


def sampled_periods(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, N: np.ndarray, W: np.ndarray, period: float
) -> Periods:
    """Return the periods of a continuous-time plant; all weights and the noise intensity are per unit of time."""
    given = Quadratic.checked(A, B, Q, R, N)
    move = _Held(given, W, period)
    whole = move.piece(())
    return Periods(move, given.B.shape[1], whole.W, whole.noise_cost)


@dataclass(frozen=True, eq=False)
class _Held:
    """The periods of a sampled plant, each sampled with the input that acts in each of its pieces."""

    given: Quadratic
    W: np.ndarray
    period: float
    _kept: dict[tuple[float, ...], Sampled] = field(default_factory=dict[tuple[float, ...], Sampled])

    def piece(self, fractions: tuple[float, ...]) -> Sampled:
        """Return the sampled period in which the input changes at the given fractions."""
        if fractions not in self._kept:
            cuts = (0.0, *(one for one in fractions if one > 0.0))
            self._kept[fractions] = sample(*self.given, self.W, self.period, cuts=cuts)
        return self._kept[fractions]

    def __call__(self, fractions: tuple[float, ...]) -> Period:
        """Return the period in which the input changes at the given fractions of it."""
        found, m = self.piece(fractions), self.given.B.shape[1]
        A, B, Q, R, N = found.quadratic
        if fractions[:1] == (0.0,):  # the input before the first change does not act
            B, N = (np.hstack([np.zeros((len(A), m)), part]) for part in (B, N))
            R = block_diagonal(np.zeros((m, m)), R)
        return Period(np.hstack([A, B]), symmetrised(np.block([[Q, N], [N.T, R]])))


Packet = tuple[int, tuple[bool, ...], int, tuple[Any, ...]]  # state of the link, receivers, fate, what is known


def key_of(delays: Delays, link: int, packets: Sequence[Packet | None]) -> tuple[Any, ...]:
    """Return the state of the link, and of each packet in flight its age, receivers, and the law of its fate."""
    found = []
    for age, packet in enumerate(packets, 1):
        if packet is None:
            continue
        sending, _, _, known = packet
        law: dict[tuple[Any, ...], float] = {}
        waiting = [i for i, one in enumerate(known) if one == "waiting"]
        for fate, chance in zip(delays.fates, delays.chances[sending], strict=True):
            fits = chance > 0
            for one, state in zip(fate, known, strict=True):
                after = np.inf if one is None else one[0]
                if state == "waiting":
                    fits = fits and after >= age
                elif state is not None and state[0] == "seen":
                    fits = fits and one == state[1]
                elif state is not None:
                    fits = fits and after > state[1]
            if fits:
                name = tuple(fate[i] for i in waiting)
                law[name] = law.get(name, 0.0) + chance
        kept = [j for j in range(len(waiting)) if any(name[j] is not None for name in law)]
        if not kept:
            continue
        total, merged = sum(law.values()), dict[Any, float]()
        for name, chance in law.items():
            short = tuple(name[j] for j in kept)
            merged[short] = merged.get(short, 0.0) + chance / total
        found.append((age, tuple(waiting[j] for j in kept), frozenset((k, round(p, 8)) for k, p in merged.items())))
    return link, tuple(found)


def lasting(
    loop: LateLoop, decisions: Mapping[tuple[bool, ...], float], value: LateValue, steps: int = 4000
) -> tuple[float, float] | None:
    """Return the cost per step with decisions that are drawn with these probabilities, and the one by the identity.

    None: the second moments do not settle.
    """
    delays, value_keys = loop.delays, dict[Any, int]()
    for i, mode in enumerate(value.chain.modes):
        law = tuple((one.age, one.receivers, frozenset((k, round(p, 8)) for k, p in one.law)) for one in mode.flight)
        value_keys[mode.link, law] = i
    D, R = delays.depth, delays.receivers
    states = [(link, (None,) * D) for link in range(len(delays.turns))]
    place = {state: i for i, state in enumerate(states)}
    rows = dict[tuple[int, int, int, int], float]()  # from, to, motion, decision
    motions, names = list[Any](), dict[int, int]()
    modes = list[int]()
    for link, packets in states:  # which grows
        key = key_of(delays, link, packets)
        modes.append(value_keys[key])
        ages = value.chain.modes[modes[-1]].ages
        for number, (sent, share) in enumerate(decisions.items()):
            fates = [(f, p) for f, p in enumerate(delays.chances[link]) if p > 0] if any(sent) else [(0, 1.0)]
            for fate, chance in fates:
                new = (link, sent, fate, tuple("waiting" if goes else None for goes in sent)) if any(sent) else None
                after, path = moved(delays, (new, *packets), R)
                found = loop.step(path, sent, ages)
                if id(found) not in names:
                    names[id(found)] = len(motions)
                    motions.append(found)
                for to, turn in enumerate(delays.turns[link]):
                    state = (to, after[:D])
                    if turn > 0 and state not in place:
                        place[state] = len(states)
                        states.append(state)
                    if turn > 0:
                        row = place[link, packets], place[state], names[id(found)], number
                        rows[row] = rows.get(row, 0.0) + share * chance * turn
    start, end, motion, _ = np.array([*rows]).T
    p = np.array([*rows.values()])
    F, M, N = (np.array([one[i] for one in motions]) for i in range(3))
    size = F.shape[1]
    mass, X = np.full(len(states), 1 / len(states)), np.zeros((len(states), size, size))
    T = np.zeros((len(states),) * 2)
    np.add.at(T, (start, end), p)
    for _ in range(500):
        mass = mass @ T
    for _ in range(steps):
        part = (
            p[:, None, None] * (F[motion] @ X[start] @ F[motion].swapaxes(1, 2))
            + (p * mass[start])[:, None, None] * N[motion]
        )
        Y = np.zeros_like(X)
        np.add.at(Y, end, part)
        change, X = np.abs(Y - X).max(), Y
        if change <= 1e-12 * np.abs(X).max():
            break
        if not np.abs(X).max() < 1e6:
            return None
    else:
        return None
    cost = float(np.einsum("t,tij,tij", p, M[motion], X[start])) + motions[0][3]
    skipped = len(loop.A) if loop.filter is not None else 0
    identity = value.cost
    for sent, share in decisions.items():
        Psi, psi = value.Psi[sent], value.psi[sent]
        Z = X[:, skipped:, skipped:]
        identity += share * (float(np.einsum("sij,sij", Psi[modes], Z)) + float(psi[modes] @ mass))
    return cost, identity


def moved(
    delays: Delays, packets: Sequence[Packet | None], receivers: int
) -> tuple[tuple[Packet | None, ...], tuple[tuple[float, int, int], ...]]:
    """Return the packets after a step and the changes of the inputs in it: fraction, age and receiver, in order."""
    events = []
    for age, packet in enumerate(packets):
        if packet is not None:
            for receiver, state in enumerate(packet[3]):
                fate = delays.fates[packet[2]][receiver]
                if state == "waiting" and fate is not None and fate[0] == age:
                    events.append((fate[1], -age, receiver))
    newest, path, arrived = [10**6] * receivers, [], set()
    for fraction, younger, receiver in sorted(events):
        arrived.add((-younger, receiver))
        if -younger < newest[receiver]:
            newest[receiver] = -younger
            path.append((fraction, -younger, receiver))
    after: list[Packet | None] = []
    for age, packet in enumerate(packets):
        if packet is None:
            after.append(None)
            continue
        known = list(packet[3])
        for receiver, state in enumerate(known):
            if state == "waiting":
                if (age, receiver) in arrived:
                    known[receiver] = ("seen", delays.fates[packet[2]][receiver])
                elif newest[receiver] < age:
                    known[receiver] = ("past", age)
        after.append((*packet[:3], tuple(known)) if "waiting" in known else None)
    return tuple(after), tuple(path)
