"""Links of a problem file for ``plain``: who is linked to whom, losses, and limits of the intervals between sends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
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
    """Return the law of the keys of a link."""
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
    """

    sensors: Mapping[str, list[int]]
    actuators: Mapping[str, list[int]]
    laws: Mapping[str, Law]
    named: bool
    delay: int = 0

    @property
    def lossy(self) -> bool:
        """Whether any link loses packets."""
        return any(law.lossy for law in self.laws.values())


def nodes_of(tables: Tables, outputs: int, inputs: int) -> Nodes:
    """Return the nodes of a file; without names both links of the triangle exist, and the kind uses what it uses."""
    table, links = tables.get("network", {}), tables.get("links", {})
    if any("missing" in law for law in links.values()):
        raise NotModelledError("missing samples")
    delay = table.get("delay", 0)
    if "nodes" not in tables:
        told = table.get("protocol", "ideal") == "tcp"
        laws = {
            one: law_of(table.get(f"{one}_loss", 0.0), table.get(f"{one}_burst"), told or "protocol" not in table,
                        links.get(one, {}))
            for one in ("sensor", "actuator")
        }  # fmt: skip
        return Nodes({"sensor": list(range(outputs))}, {"actuator": list(range(inputs))}, laws, False, delay)
    sensors, actuators, laws = {}, {}, {}
    center = next(name for name, role in tables["nodes"].items() if role.get("controls"))
    for name, role in tables["nodes"].items():
        for key, count, found in (("measures", outputs, sensors), ("applies", inputs, actuators)):
            if role.get(key):
                found[name] = list(range(count)) if role[key] is True else list(role[key])
        if name != center and role.get("site") != center:
            own = links.get(name, {})
            lost = own.get("loss", 0.0) or own.get("burst")
            laws[name] = law_of(own.get("loss", 0.0), own.get("burst"), own.get("acknowledged", not lost), own)
            if role.get("site") is not None:
                raise NotModelledError("nodes that share a place")
    return Nodes(sensors, actuators, laws, True, delay)


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
