"""Links of a problem file for ``plain``: who is linked to whom, losses, and limits of the intervals between sends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from everything.plain import Array, NotModelledError

Tables = Mapping[str, Any]


@dataclass(frozen=True)
class Law:
    """The law of a link.

    Args:
        drops, moves: loss probability of each state of the channel, and the probabilities of its next state.
        acknowledged: whether the sender learns what arrived.
        least, most: limits of the intervals between sends.
        price: of a packet.
    """

    drops: Array = field(default_factory=lambda: np.zeros(1))
    moves: Array = field(default_factory=lambda: np.eye(1))
    acknowledged: bool = True
    least: int = 1
    most: float = np.inf
    price: float = 1.0

    @property
    def lossy(self) -> bool:
        """Whether packets are lost."""
        return bool(self.drops.any())

    @property
    def limited(self) -> bool:
        """Whether the intervals have limits."""
        return self.least > 1 or self.most < np.inf

    @property
    def stationary(self) -> Array:
        """The stationary distribution of the channel."""
        count = len(self.moves)
        system = np.vstack([self.moves.T - np.eye(count), np.ones(count)])
        return np.linalg.lstsq(system, np.eye(count + 1)[-1], rcond=None)[0]

    @property
    def loss(self) -> float:
        """The mean loss."""
        return float(self.stationary @ self.drops)


def law_of(loss: float, burst: Tables | None, acknowledged: bool, rest: Tables) -> Law:
    """Return the law of the keys of a link, on which a packet that is later than the buffer is lost."""
    found = _law_of(loss, burst, acknowledged, rest)
    late = too_late(rest)
    return replace(found, drops=1 - (1 - found.drops) * (1 - late)) if late else found


def too_late(rest: Tables) -> float:
    """Return the probability that a packet never arrives, or only after the buffer."""
    delay, buffer = rest.get("delay", 0), rest.get("buffer")
    if buffer is None:
        return 0.0
    if isinstance(delay, list):
        chances, times, most = delay, list[float](range(len(delay))), buffer
    elif isinstance(delay, Mapping) and "probability" in delay:
        chances, times, most = delay["probability"], delay["seconds"], buffer["seconds"]
    else:
        return 0.0
    late = 1.0 - sum(p for p, time in zip(chances, times, strict=True) if time <= most * (1 + 1e-9))
    return late if late > 1e-9 else 0.0


def _law_of(loss: float, burst: Tables | None, acknowledged: bool, rest: Tables) -> Law:
    limits = {"least": rest.get("min_interval", 1), "most": rest.get("max_interval", np.inf)}
    price = float(rest.get("price", 1.0))
    if burst is None:
        return Law(np.array([loss]), np.eye(1), acknowledged, price=price, **limits)
    if burst.get("law", "gilbert-elliott") == "chain":
        return Law(np.array(burst["drops"]), np.array(burst["moves"]), acknowledged, price=price, **limits)
    a, b = burst["to_bad"], burst["to_good"]
    moves = np.array([[1 - a, a], [b, 1 - b]])
    return Law(np.array([burst["loss_good"], burst["loss_bad"]]), moves, acknowledged, price=price, **limits)


@dataclass(frozen=True)
class Nodes:
    """The nodes of a file: outputs and inputs by name; those without a link are at the controller's place.

    Args:
        sensors, actuators: indices by the name of the node.
        laws: the laws of the links by the name of the node.
        named: whether the file names nodes.
        delay: of computations.
        missing: laws of the missing samples by the name of the node.
    """

    sensors: Mapping[str, list[int]]
    actuators: Mapping[str, list[int]]
    laws: Mapping[str, Law]
    named: bool
    delay: int = 0
    missing: Mapping[str, Law] = field(default_factory=dict)

    @property
    def lossy(self) -> bool:
        """Whether any link loses packets."""
        return any(law.lossy for law in self.laws.values())


def nodes_of(tables: Tables, outputs: int, inputs: int) -> Nodes:
    """Return the nodes of a file; without names both links of the triangle exist, and the kind uses what it uses."""
    table, links = tables.get("network", {}), tables.get("links", {})
    delay = table.get("delay", 0)
    missing = {name: samples_of(one["missing"]) for name, one in links.items() if "missing" in one}
    if "nodes" not in tables:
        told, laws = table.get("protocol", "ideal") == "tcp", {}
        for one in ("sensor", "actuator"):
            own = {key: table[f"{one}_{key}"] for key in ("delay", "buffer") if f"{one}_{key}" in table}
            own |= links.get(one, {})
            lost = table.get(f"{one}_loss", 0.0) or table.get(f"{one}_burst") or too_late(own)
            laws[one] = law_of(
                table.get(f"{one}_loss", 0.0), table.get(f"{one}_burst"), own.get("acknowledged", told or not lost), own
            )
        return Nodes({"sensor": list(range(outputs))}, {"actuator": list(range(inputs))}, laws, False, delay, missing)
    sensors, actuators, laws = {}, {}, {}
    center = next(name for name, role in tables["nodes"].items() if role.get("controls"))
    for name, role in tables["nodes"].items():
        for key, count, found in (("measures", outputs, sensors), ("applies", inputs, actuators)):
            if role.get(key):
                found[name] = list(range(count)) if role[key] is True else list(role[key])
        if name != center and role.get("site") != center:
            own = links.get(name, {})
            lost = own.get("loss", 0.0) or own.get("burst") or too_late(own)
            laws[name] = law_of(own.get("loss", 0.0), own.get("burst"), own.get("acknowledged", not lost), own)
            if role.get("site") is not None:
                raise NotModelledError("nodes that share a place")
    return Nodes(sensors, actuators, laws, True, delay, missing)


def samples_of(law: float | Tables) -> Law:
    """Return the law of missing samples: a probability, or a table like that of bursts."""
    return law_of(0.0, law, True, {}) if isinstance(law, Mapping) else law_of(law, None, True, {})


class Samples:
    """The samples of all outputs on many paths, some of which are missing: one channel for each node with a law."""

    def __init__(self, nodes: Nodes, outputs: int) -> None:
        """Keep the laws, each with its outputs."""
        self.outputs, self.laws = outputs, [(law, nodes.sensors[name]) for name, law in nodes.missing.items()]

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        self.channels = [Channel(law, paths, rng) for law, _ in self.laws]
        self.paths = paths

    def known(self) -> Array:
        """Return which outputs are measured in this step, on each path."""
        found = np.ones((self.paths, self.outputs), dtype=bool)
        for channel, (_, own) in zip(self.channels, self.laws, strict=True):
            found[:, own] = channel.arrives(np.ones(self.paths, dtype=bool))[:, None]
        return found

    def gain(self, A: Array, C: Array, W: Array, V: Array) -> tuple[Array, Array]:
        """Return the best constant gain of a filter, and the mean covariance of its innovations, 0 where unknown.

        The covariance of the prediction's error while the channels are in a state, times the share of that state,
        moves with the chain of all channels; the gain minimises the sum of these covariances after a step.
        """
        moves, shares, cases = np.eye(1), np.ones(1), [(np.ones(1), np.ones(self.outputs))]
        for law, own in self.laws:
            gone = np.ones(self.outputs)
            gone[own] = 0.0
            cases = [
                (np.kron(chance, one), seen * mask)
                for chance, seen in cases
                for one, mask in ((1 - law.drops, np.ones(self.outputs)), (law.drops, gone))
            ]
            moves, shares = np.kron(moves, law.moves), np.kron(shares, law.stationary)
        P = [share * (W + np.eye(len(A))) for share in shares]
        for _ in range(200_000):
            cross, S = np.zeros(C.T.shape), np.zeros((len(C), len(C)))
            for chance, seen in cases:
                for p, share, one in zip(chance, shares, P, strict=True):
                    cross += p * one @ C.T * seen
                    S += p * np.outer(seen, seen) * (C @ one @ C.T + share * V)
            gain = cross @ np.linalg.pinv(S, hermitian=True)
            moved = [share * W for share in shares]
            for chance, seen in cases:
                for i, p in enumerate(chance):
                    G = gain * seen
                    left = np.eye(len(A)) - G @ C
                    moved[i] = moved[i] + p * A @ (left @ P[i] @ left.T + shares[i] * G @ V @ G.T) @ A.T
            new = [sum(moves[i, j] * moved[i] for i in range(len(P))) for j in range(len(P))]
            if np.abs(np.array(new) - np.array(P)).max() <= 1e-12 * np.abs(new).max():
                return gain, S
            P = new
        raise NotModelledError("missing samples with which the error of a filter does not settle")


class Channel:
    """A link on many paths: what arrives, and whether it may or must send."""

    def __init__(self, law: Law, paths: int, rng: np.random.Generator) -> None:
        """Begin: the channel in its stationary distribution, the count of steps at the least interval."""
        self.law, self.rng = law, rng
        self.count = np.full(paths, float(law.least))
        self.state = rng.choice(len(law.drops), paths, p=np.maximum(law.stationary, 0) / law.stationary.clip(0).sum())

    def limits(self, wants: Array) -> Array:
        """Return which paths send within the limits of intervals, if those want to."""
        return (wants | (self.count >= self.law.most)) & (self.count >= self.law.least)

    def allowed(self, wants: Array) -> Array:
        """Return which paths send, if those want to."""
        sends = self.limits(wants)
        self.count = np.where(sends, 1.0, self.count + 1)
        return sends

    def arrives(self, sends: Array) -> Array:
        """Return which packets arrive, and move the channel by a step."""
        lost = self.rng.random(len(sends)) < self.law.drops[self.state]
        totals = self.law.moves.cumsum(axis=1)[self.state]
        self.state = (self.rng.random(len(sends))[:, None] > totals).sum(axis=1).clip(max=len(self.law.drops) - 1)
        return sends & ~lost
