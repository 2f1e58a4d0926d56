"""Random delays of inputs for ``plain``: queues of packets on many paths, whose delays this simulation draws itself.

Without acknowledgements, the nodes are those for a constant delay, the mean of the packets that arrive: of whole steps
the nearest number. So a policy is that of the file with this delay, at a plant whose input is that of the newest packet
that has arrived. A packet that arrives with, or after, a newer one is not used. The input changes within a period where
packets arrive, and the integrals of a period are sums over its pieces.

``packets_of_a_path`` follows the packets of a single path, of which the delays are given.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from everything.laws import Channel, Law, nodes_of
from everything.plain import (
    Answer,
    Array,
    Controller,
    Model,
    NotModelledError,
    block2,
    held,
    matrix,
    mean_of,
    model_of,
    root_of,
    sampled_weights,
    weights_of,
)
from scipy.linalg import expm

Tables = Mapping[str, Any]
TOLD_LATE = "actuator_acknowledgement_delay"
Packet = tuple[int, int]  # piece of the path in which it arrives, and step in which it was sent


@dataclass(frozen=True)
class RandomInputs:
    """Random delays of all inputs, which come over one link.

    Args:
        link: its name.
        waits: the possible delays in steps.
        odds: their probabilities in each state of the link; the rest is lost.
        law: the losses of the link.
        mean: the constant delay that the nodes assume, as files state it.
    """

    link: str
    waits: tuple[float, ...]
    odds: Array
    law: Law
    mean: object


def random_inputs(tables: Tables, folder: Path) -> RandomInputs | None:
    """Return the random delays of a file, or None if it has none.

    Raises:
        NotModelledError: decisions know of them or of losses, they are from a trace, or other links are late too.
    """
    laws = [*tables.get("links", {}).values(), {"acknowledgement_delay": tables.get("network", {}).get(TOLD_LATE, 0)}]
    if any(law.get("acknowledgement_delay") for law in laws):
        raise NotModelledError("acknowledgements that come one step late")
    found = {name: law for name, law in _delays(tables).items() if _drawn(law)}
    if not found:
        return None
    plant, nodes = tables["plant"], nodes_of(tables, 1, len(tables["plant"]["B"][0]))
    if len(found) > 1 or len(_delays(tables)) > 1:
        raise NotModelledError("random delays beside others")
    ((link, law),) = found.items()
    if set(nodes.actuators) != {link}:
        raise NotModelledError("random delays of sensors, or of one of several actuators")
    network, kind, own = tables.get("network", {}), tables["policy"]["kind"], nodes.laws[link]
    told = network.get("protocol") == "tcp" or tables.get("links", {}).get(link, {}).get("acknowledged")
    if told and kind == "excess":
        raise NotModelledError("random delays that are acknowledged")
    h = tables["policy"]["period"] if "dt" not in plant else plant["dt"]
    listed = law.get("states", [law]) if isinstance(law, Mapping) else [law]
    times = sorted({time for one in listed for time in _law(one, h, folder)})
    odds = np.array([[_law(one, h, folder).get(time, 0.0) for time in times] for one in listed])
    if (own.lossy or odds.sum() < len(odds) - 1e-9) and kind not in ("all-time", "periodic"):
        raise NotModelledError("random delays with losses for decisions that know of them")
    shares = own.stationary @ odds if len(odds) > 1 else odds[0]
    mean = float(np.dot(times, shares) / shares.sum())
    steps = isinstance(listed[0], list)
    return RandomInputs(link, tuple(times), odds, own, round(mean) if steps else {"seconds": mean * h})


def _law(law: Any, h: float, folder: Path) -> dict[float, float]:
    """Return the probability of each delay, in steps of h seconds."""
    if isinstance(law, list):
        return {float(i): p for i, p in enumerate(law) if p}
    if "histogram" in law:
        rows = np.loadtxt(folder / law["histogram"], delimiter=",", skiprows=1, ndmin=2)
        return {float(time / 1000 / h): float(p) for time, p in rows}
    if "probability" not in law:
        raise NotModelledError("traces of delays")
    return {time / h: p for time, p in zip(law["seconds"], law["probability"], strict=True)}


def _delays(tables: Tables) -> dict[str, Any]:
    """Return the delays of links that a file states, without buffers."""
    network = tables.get("network", {})
    found = {
        name: network[f"{name}_delay"]
        for name in ("sensor", "actuator")
        if f"{name}_delay" in network and f"{name}_buffer" not in network
    }
    links = tables.get("links", {}).items()
    return found | {name: one["delay"] for name, one in links if "delay" in one and "buffer" not in one}


def _drawn(law: object) -> bool:
    """Return whether a law of delay is not constant."""
    return isinstance(law, list) or (isinstance(law, Mapping) and not isinstance(law.get("seconds"), int | float))


def with_delay(tables: Tables, late: RandomInputs, delay: object) -> Tables:
    """Return a file with a constant delay in place of the random one, over a link that drops nothing."""
    lost = (f"{late.link}_loss", f"{late.link}_burst")
    network = {key: value for key, value in tables.get("network", {}).items() if key not in lost}
    links = dict(tables.get("links", {}))
    key = f"{late.link}_delay"
    if key in network:
        network[key] = delay
        if network.get("protocol") == "tcp":
            network["protocol"] = "ideal"
    else:
        own = {name: one for name, one in links[late.link].items() if name != "acknowledged"}
        links[late.link] = {**own, "delay": delay}
    return {**tables, **({"network": network} if network else {}), **({"links": links} if links else {})}


@dataclass(frozen=True)
class Piece:
    """The plant between two parts of a period: x⁺ = A x + B u, and the weight of (x, u)."""

    A: Array
    B: Array
    weight: Array


def pieces_of(tables: Tables, model: Model, cuts: list[float]) -> list[Piece]:
    """Return the plant in each piece of a period that begins at one of the parts ``cuts``."""
    plant = tables["plant"].get("actual", tables["plant"])
    A, B = matrix(plant["A"]), matrix(plant["B"])
    n, m = B.shape
    if not model.continuous:
        return [Piece(model.A, model.B, model.stage)]
    Q, R, N = weights_of(tables["cost"], matrix(plant.get("C", np.eye(n))), np.zeros((1, m)), n, m)
    found = []
    for begin, end in pairwise([*cuts, 1.0]):
        h = (end - begin) * model.seconds
        Qd, Rd, Nd = sampled_weights(A, B, Q, R, N, h)
        found.append(Piece(expm(A * h), held(A, B, h), block2(Qd, Nd, Rd)))
    return found


def simulate_late(
    tables: Tables, late: RandomInputs, policy: Controller, folder: Path, seed: int, paths: int, steps: int, settle: int
) -> Answer:
    """Return cost and rates of the nodes of a file with a constant delay, at a plant with random ones."""
    model = model_of(with_delay(tables, late, 0), folder)
    unknown = model.q + model.s or model.loads is not None or model.function is not None or model.limited
    if unknown or "D" in tables["plant"] or "actual" in tables["plant"] or not model.average or model.added:
        raise NotModelledError("random delays with signals, limits, a function, a feedthrough, or a total cost")
    cuts = sorted({0.0, *(round(wait % 1.0, 9) for wait in late.waits)})
    pieces = pieces_of(tables, model, cuts)
    code = np.array([int(wait + 1e-9) * len(cuts) + cuts.index(round(wait % 1.0, 9)) for wait in late.waits])
    streams = [np.random.default_rng([seed, 7, i]) for i in range(4)]
    policy.start(paths, streams[0])
    channel = Channel(late.law, paths, np.random.default_rng([seed, 8]))
    x, u = np.zeros((paths, model.n)), np.zeros((paths, model.m))
    newest = np.full(paths, -1)
    way: list[tuple[int, Array, Array]] = []  # step of sending, pieces in which packets arrive, and their inputs
    V = np.zeros((len(model.C),) * 2) if model.V is None else model.V
    root, total, sent = root_of(V), np.zeros(paths), dict[str, Array]()
    for k in range(settle + steps):
        y = x @ model.C.T + streams[1].standard_normal((paths, len(V))) @ root
        value, packets = policy.step(k, y, np.zeros((paths, 0)))
        if value.shape[1] > model.m:
            raise NotModelledError("random delays with a slow disturbance that a controller compensates")
        sums = late.odds.cumsum(axis=1)[channel.state if len(late.odds) > 1 else 0]
        place = (streams[2].random(paths)[:, None] > sums).sum(axis=1)
        comes = channel.arrives(packets[late.link] > 0) & (place < len(code))
        arrives = np.where(comes, k * len(cuts) + code[np.minimum(place, len(code) - 1)], -1)
        way = [*(one for one in way if one[1].max() >= k * len(cuts)), (k, arrives, value.copy())]
        weight = float(k >= settle)
        for i, piece in enumerate(pieces):
            for begun, due, command in way:  # from the oldest to the newest
                here = (due == k * len(cuts) + i) & (begun > newest)
                u, newest = np.where(here[:, None], command, u), np.where(here, begun, newest)
            joint = np.hstack([x, u])
            total += weight * np.einsum("pi,ij,pj->p", joint, piece.weight, joint)
            x = x @ piece.A.T + u @ piece.B.T
        x = x + model.noise(streams[3], paths)
        total += weight * model.rest
        for link, flags in packets.items():
            sent[link] = sent.get(link, np.zeros(paths)) + weight * flags
    return Answer(
        mean_of(total / steps / model.seconds),
        {link: mean_of(flags / steps / model.seconds) for link, flags in sent.items()},
    )


def packets_of_a_path(sent: list[bool], codes: list[float], pieces: int, never: float) -> list[list[int]]:
    """Return for each step and piece the step in which the newest packet was sent that has arrived, or −1."""
    way, newest, found = list[Packet](), -1, list[list[int]]()
    for k, (packet, code) in enumerate(zip(sent, codes, strict=True)):
        if packet and code < never:
            way.append((k * pieces + int(code), k))
        row = list[int]()
        for place in range(k * pieces, (k + 1) * pieces):
            newest = max([newest, *(begun for due, begun in way if due == place)])
            row.append(newest)
        way = [one for one in way if one[0] >= (k + 1) * pieces]
        found.append(row)
    return found
