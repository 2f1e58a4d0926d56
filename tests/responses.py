"""The response of a loop to its own silence, told again in NumPy alone: for the tests of bounds on every path.

``Whole`` is the loop z⁺ = F z + G d, ζ = C z + D d of plant and controller, in the coordinates z = (x, x_c) and with
all errors d = (d_y, d_u) of what the controller and the plant use. The value z'P z of what is still to come is computed
by scipy in the part of the state that the cost sees, found by a staircase of singular values. ``told`` runs a loop of
the library on noise that is given, and returns what it has done; the rest is recursions over steps, with all paths side
by side: arrays are (steps, paths, entries).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from taciturn import Controller, Cost, Disturbance, Loop, Plant
from taciturn.program.machine import Kernel
from taciturn.program.numpy import run
from taciturn.program.ops import Entry, Received, Sent, Silence

SHOWN = "estimate"  # a signal that programs of loops show
Links = tuple[str, ...]


def stage_of(cost: Cost) -> np.ndarray:
    """Return the weight of (x, u)."""
    return np.block([[cost.Q, cost.N], [cost.N.T, cost.R]])


def root_of(weight: np.ndarray) -> np.ndarray:
    """Return a matrix with root'root = weight, whatever the units of the states are."""
    size = np.sqrt(np.diag(weight))
    unit = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh((weight + weight.T) / 2 / unit[:, None] / unit)
    return np.sqrt(np.where(values > 1e-14 * values[-1], values, 0.0))[:, None] * vectors.T * unit


def seen_by(F: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis, in rows, of the states without the lasting modes that ζ = C z does not show."""
    modes, vectors = np.linalg.eig(F)
    shown = np.linalg.norm(C @ vectors, axis=0)  # of vectors of length 1
    hidden = vectors[:, (np.abs(modes) > 1 - 1e-6) & (shown < 1e-7 * np.linalg.norm(C, 2))]
    whole = np.hstack([hidden.real, hidden.imag])
    directions, sizes, _ = np.linalg.svd(whole, full_matrices=True)
    return directions[:, int((sizes > 1e-9).sum()) :].T


class Whole:
    """The loop of a plant and a controller that sends every sample, with errors of what they use."""

    def __init__(self, A: np.ndarray, B: np.ndarray, C: np.ndarray, controller: Controller, stage: np.ndarray) -> None:
        """Write the loop in the coordinates (x, x_c)."""
        c = controller
        self.n, (self.m, self.p) = len(A), c.D.shape
        used = c.E @ c.C + c.A, c.B + c.E @ c.D
        self.F = np.block([[A + B @ c.D @ C, B @ c.C], [used[1] @ C, used[0]]])
        self.G = np.block([[B @ c.D, B], [used[1], c.E]])
        self.signals = np.block([[np.eye(self.n, len(self.F))], [np.hstack([c.D @ C, c.C])]])  # (x, u) of z
        self.moved = np.block([[np.zeros((self.n, self.p + self.m))], [np.hstack([c.D, np.eye(self.m)])]])
        self.root = root_of(stage)
        self.C, self.D = self.root @ self.signals, self.root @ self.moved

    @cached_property
    def seen(self) -> np.ndarray:
        """What the cost sees of z if a mode does not decay, and otherwise all of z: an orthonormal basis in rows."""
        unit = np.eye(len(self.F))
        return unit if np.abs(np.linalg.eigvals(self.F)).max() < 1 - 1e-6 else seen_by(self.F, self.C)

    @cached_property
    def radius(self) -> float:
        """The largest modulus of a mode that the cost sees."""
        return float(np.abs(np.linalg.eigvals(self.seen @ self.F @ self.seen.T)).max(initial=0.0))

    @cached_property
    def P(self) -> np.ndarray:
        """The weight of z'P z, the cost to come."""
        seen = self.seen
        if not len(seen):
            return np.zeros_like(self.F)
        F, C = seen @ self.F @ seen.T, self.C @ seen.T
        return seen.T @ solve_discrete_lyapunov(F.T, C.T @ C) @ seen

    @cached_property
    def S(self) -> np.ndarray:
        """The weight of d'S d in what an error adds."""
        return self.D.T @ self.D + self.G.T @ self.P @ self.G

    @cached_property
    def Y(self) -> np.ndarray:
        """The weight of 2 d'Y q in what an error adds."""
        return self.D.T @ self.C + self.G.T @ self.P @ self.F

    def average(self, W: np.ndarray, V: np.ndarray) -> float:
        """Return the cost per step of white noise."""
        return float(np.sum(self.P[: self.n, : self.n] * W) + np.sum(self.S[: self.p, : self.p] * V))

    def total(self, W: np.ndarray, V: np.ndarray, start: np.ndarray, terminal: np.ndarray, ticks: int) -> float:
        """Return the cost of a run with white noise, for the second moment of x at its start."""
        found, P, n, p = 0.0, np.zeros_like(self.F), self.n, self.p
        P[:n, :n] = terminal
        enters, seen = self.G[:, :p], self.D[:, :p]
        for _ in range(ticks):
            found += float(np.sum(P[:n, :n] * W) + np.sum((seen.T @ seen + enters.T @ P @ enters) * V))
            P = self.C.T @ self.C + self.F.T @ P @ self.F
        return found + float(np.sum(P[:n, :n] * start))

    def path(self, z: np.ndarray, w: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (x, u) and ζ in every step of the loop with every sample, and the last states, from those at first."""
        states, enters = np.empty((len(w), *z.shape)), self.G[:, : self.p].T
        for k in range(len(w)):
            states[k] = z
            z = z @ self.F.T + v[k] @ enters
            z[:, : self.n] += w[k]
        moved, seen = self.moved[:, : self.p].T, self.D[:, : self.p].T
        return states @ self.signals.T + v @ moved, states @ self.C.T + v @ seen, z

    def response(self, d: np.ndarray) -> Response:
        """Return the response to errors, from q = 0."""
        q = np.zeros((d.shape[1], len(self.F)))
        states = np.empty((len(d) + 1, *q.shape))
        for k in range(len(d)):
            states[k] = q
            q = q @ self.F.T + d[k] @ self.G.T
        states[-1] = q
        return Response(self, d, states)


@dataclass(frozen=True, eq=False)
class Response:
    """The response of a loop to errors."""

    whole: Whole
    d: np.ndarray
    q: np.ndarray  # one step more than d

    @cached_property
    def output(self) -> np.ndarray:
        """ζ in every step."""
        return self.q[:-1] @ self.whole.C.T + self.d @ self.whole.D.T

    def would_add(self, d: np.ndarray) -> np.ndarray:
        """Return d'S d + 2 d'Y q of other errors in each step, (steps, paths)."""
        each = d @ self.whole.S * d + 2 * d * (self.q[:-1] @ self.whole.Y.T)
        return each.sum(axis=-1)

    @cached_property
    def added(self) -> np.ndarray:
        """What the errors have added in each step, (steps, paths)."""
        return self.would_add(self.d)

    @cached_property
    def size(self) -> np.ndarray:
        """The size of the terms of the sum of what was added up to each step, to which rounding errors compare."""
        pushed = np.abs(self.q[:-1] @ self.whole.Y.T) * np.abs(self.d)
        return np.cumsum(np.abs(self.d @ self.whole.S * self.d).sum(axis=-1) + 2 * pushed.sum(axis=-1), axis=0)

    @property
    def to_come(self) -> np.ndarray:
        """V(q) after each step, (steps, paths)."""
        return np.einsum("tki,ij,tkj->tk", self.q[1:], self.whole.P, self.q[1:])


@dataclass(frozen=True, eq=False)
class Told:
    """What a loop of the library has done, (steps, paths, entries)."""

    x: np.ndarray
    u: np.ndarray  # as applied
    y: np.ndarray
    gap: np.ndarray  # the value used in silence minus that of a packet, of all outputs and inputs
    d: np.ndarray  # the same where no packet has arrived, and 0 elsewhere
    sent: Mapping[str, np.ndarray]  # (steps, paths)
    arrived: Mapping[str, np.ndarray]
    added: Mapping[Links, np.ndarray]
    total: Mapping[Links, np.ndarray]  # of what was added, as the node has it
    bank: Mapping[Links, np.ndarray]
    start: np.ndarray  # x in the first step, (paths, n)
    end: np.ndarray  # x after the last step, (paths, n)


def entries_of(loop: Loop) -> dict[str, list[int]]:
    """Return the entries of (y, u) that each link carries."""
    plant, network = loop.problem.plant, loop.network
    found = {node: [*rows] for node, rows in network.measurements(plant.outputs).values() if node in network.links}
    for node, rows in network.applications(plant.inputs).values():
        if node in network.links:
            found[node] = [plant.outputs + i for i in rows]
    return found


def bank_of(links: Links) -> str:
    """Return the signal with the bank of a node."""
    return f"bank_{' and '.join(links)}"


def told(loop: Loop, w: np.ndarray, v: np.ndarray, start: np.ndarray | None = None, fast: bool = False) -> Told:
    """Run a loop on noise w and v; a loop with ``fast`` runs as machine code."""
    plant, entries, policy = loop.problem.plant, entries_of(loop), loop.policy
    signals = plant.outputs + plant.inputs
    scalars = [one.total for one in policy.theory.silence.values()]
    scalars += [name for name in map(bank_of, policy.theory.silence) if name in policy.sizes]
    unit = np.eye(signals + len(scalars))
    rows = {f"moved_{link}": unit[:, rows] for link, rows in entries.items()}
    rows |= {name: unit[:, [signals + i]] for i, name in enumerate(scalars)}
    shown = replace(policy, theory=replace(policy.theory, sums={SHOWN: rows}))
    program = replace(loop, policy=shown).whole_program(supplied=True)
    added = {Silence(links): program.sums[Silence(links)] for links in policy.theory.silence}
    program = replace(program, sums={}, outputs={**program.outputs, **added})
    program = program.keep(outputs=set(program.outputs))
    ticks, paths = w.shape[:2]
    noise = {Entry(name, i): one[..., i] for name, one in (("w", w), ("v", v)) for i in range(one.shape[2])}
    chance = np.random.default_rng(ticks)
    given = np.array([noise[name] if name in noise else chance.random((ticks, paths)) for name in program.inputs])
    states = loop.start(program, paths, 1)
    if start is not None:
        for row, state in zip(states, program.states, strict=True):
            if state.name == "x":
                row[:] = start[:, state.index]
    carry_out = Kernel(program, "parity").run if fast else run
    found = carry_out(program, states, ticks, given.transpose(1, 0, 2))
    outputs, end = (
        found.outputs,
        [row for row, state in zip(found.states, program.states, strict=True) if state.name == "x"],
    )

    def stacked(name: str, size: int) -> np.ndarray:
        return np.stack([outputs[Entry(name, i)] for i in range(size)], axis=-1)

    memories = {name: outputs[Entry(SHOWN, signals + i)] for i, name in enumerate(scalars)}
    gap, arrived = -stacked(SHOWN, signals), {link: outputs[Received(link)] > 0 for link in entries}
    silent = np.zeros(gap.shape)
    for link, rows in entries.items():
        silent[..., rows] = ~arrived[link][..., None]
    x = stacked("x", plant.states)
    return Told(
        x, stacked("applied", plant.inputs), stacked("y", plant.sensed), gap, silent * gap,
        {link: outputs[Sent(link)] > 0 for link in entries}, arrived,
        {name.links: outputs[name] for name in added},
        {links: memories[one.total] for links, one in policy.theory.silence.items()},
        {links: memories[bank_of(links)] for links in policy.theory.silence if bank_of(links) in memories},
        x[0], np.array(end).T,
    )  # fmt: skip


def lqg_by_hand(plant: Plant, cost: Cost) -> Controller:
    """Return LQG as a controller that predicts the state, by scipy's solver."""
    A, B, C = plant.A, plant.B, plant.C
    K = solve_discrete_are(A, B, cost.Q, cost.R, s=cost.N)
    L = -np.linalg.solve(cost.R + B.T @ K @ B, B.T @ K @ A + cost.N.T)
    none, n = Disturbance(deviation=0.0), len(A)
    if plant.full_state:
        return Controller(np.zeros((0, 0)), np.zeros((0, n)), np.zeros((len(L), 0)), L, disturbance=none)
    P = solve_discrete_are(A.T, C.T, plant.W, plant.V)
    gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + plant.V)
    left = np.eye(n) - gain @ C
    return Controller(A @ left, A @ gain, L @ left, L @ gain, B, disturbance=none)


def running(values: np.ndarray) -> np.ndarray:
    """Return the sum up to each step."""
    return np.cumsum(values, axis=0)
