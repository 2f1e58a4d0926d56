"""Constant delays of links for ``plain``: queues of commands and of samples beside the states of a plant.

A sample of output j that is taken at step k is there a_j steps and a part of a period later. The controller computes
step k when its last sample is there, so it has y_j of step k − a_j, and what it commands for input i acts d_i periods
after step k: the delay of the link, and the part that the controller has waited. Where all samples are late, the inputs
are later instead.

x has behind it the earlier commands of each input, the earlier samples of each output with their noise, and, where
V correlates outputs of different age, the noise of this step. In a period one command acts after the other, and the
integrals are sums over the pieces between. An output shows by D the input that acts just before its sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from everything.laws import nodes_of
from everything.plain import Array, Model, NotModelledError, block2, root_of
from numpy.linalg import matrix_power
from scipy.linalg import expm

Tables = Mapping[str, Any]
ROUNDED = 1e-9


@dataclass(frozen=True)
class Late:
    """After how many periods each input acts, and how many steps older than the newest each output is."""

    acts: tuple[float, ...]
    ages: tuple[int, ...]

    @property
    def given(self) -> bool:
        """Whether anything is late."""
        return any(self.acts) or any(self.ages)


@dataclass(frozen=True)
class Plain:
    """What a file states of a plant, before it is sampled; E of disturbances, set-points and what is told; loads."""

    A: Array
    B: Array
    Q: Array
    R: Array
    N: Array
    E: Array
    loads: Array
    D: Array
    shown: bool


def late_of(tables: Tables, outputs: int, inputs: int, h: float) -> Late:
    """Return the delays of a file, whose steps take h seconds."""
    network, links = tables.get("network", {}), tables.get("links", {})
    nodes, waits = nodes_of(tables, outputs, inputs), dict[str, float]()
    for name, law in nodes.laws.items():
        usual = {key: network[f"{name}_{key}"] for key in ("delay", "buffer") if f"{name}_{key}" in network}
        waits[name] = wait_of({**usual, **links.get(name, {})}, h)
        if waits[name] and law.lossy and law.acknowledged:
            raise NotModelledError("losses of which a sender learns only after a delay")
    read, commanded = [0.0] * outputs, [0.0] * inputs
    for found, places in ((read, nodes.sensors), (commanded, nodes.actuators)):
        for name, listed in places.items():
            for i in listed:
                found[i] = waits.get(name, 0.0)
    part = max(one % 1.0 for one in read)
    least = min(int(one) for one in read)
    acts = [one + least + part for one in commanded]
    acts = [float(round(one)) if abs(one - round(one)) < ROUNDED else one for one in acts]
    if "dt" in tables["plant"] and any(one % 1 for one in acts):
        raise NotModelledError("parts of a period of a discrete plant")
    return Late(tuple(acts), tuple(int(one) - least for one in read))


def wait_of(link: Tables, h: float) -> float:
    """Return after how many steps of h seconds a packet is used."""
    given = link.get("buffer", link.get("delay", 0))
    if isinstance(given, list) or (isinstance(given, Mapping) and not isinstance(given.get("seconds"), int | float)):
        raise NotModelledError("delays that are drawn, without a buffer")
    exact = given["seconds"] / h if isinstance(given, Mapping) else float(given)
    return float(round(exact)) if abs(exact - round(exact)) < ROUNDED else exact


def with_queues(model: Model, late: Late, plant: Plain, S: Array) -> Model:
    """Return a model with queues of commands and samples, whose outputs may show inputs.

    Args:
        model: the model without them.
        late: the delays.
        plant: what the file states.
        S: dynamics of disturbances and set-points in a step.
    """
    n, m, p, e = model.n, model.m, len(model.C), len(S)
    whole = [int(one) for one in late.acts]
    parts = [one - int(one) for one in late.acts]
    depths = [d + int(part > 0 or plant.shown) for d, part in zip(whole, parts, strict=True)]
    V = np.zeros((p, p)) if model.V is None else model.V
    ages = np.array(late.ages)
    joint = bool((V[ages[:, None] != ages] != 0).any())
    places = [("u", i, age) for i in range(m) for age in range(1, depths[i] + 1)]
    places += [("y", j, age) for j in range(p) for age in range(1, ages[j] + 1)]
    places += [("v", j, 0) for j in range(p)] if joint else []
    at = {one: n + i for i, one in enumerate(places)}
    r, loads = len(places), plant.loads.shape[1]
    size = n + r + e
    unit = np.eye(size + 2 * m + loads)
    x, _, exo, u, pushed, load = np.split(unit, np.cumsum([n, r, e, m, m]))

    def command(i: int, age: int) -> Array:
        return unit[at["u", i, age]] if age else u[i]

    # a period, one command after the other
    weight, total, passed = block2(plant.Q, plant.N, plant.R), np.zeros((len(unit),) * 2), unit
    for begin, end in pairwise([*sorted({0.0, *parts}), 1.0]):
        acting = np.array([command(i, whole[i] + int(begin < parts[i])) for i in range(m)])
        counted = np.vstack([x - model.X @ exo, acting - model.U @ exo])
        moves = plant.A @ x + plant.B @ (acting + pushed) + plant.E @ exo + plant.loads @ load
        M = counted.T @ weight @ counted
        if model.continuous:
            F = np.vstack([moves, np.zeros((len(unit) - n, len(unit)))])
            both = expm(np.block([[-F.T, M], [np.zeros_like(F), F]]) * (end - begin) * model.seconds)
            now = both[len(F) :, len(F) :]
            total, passed = total + passed.T @ now.T @ both[: len(F), len(F) :] @ passed, now @ passed
        else:
            total, passed = M, moves
    total = (total + total.T) / 2

    # what is measured in this step, without the noise that is no state
    seen = model.C[:, :n] @ x + model.C[:, n:] @ exo + (0.0 if model.loads is None else model.loads.seen @ load)
    if plant.shown:
        seen = seen + plant.D @ np.array([command(i, whole[i] + 1) for i in range(m)])
    if joint:
        seen = seen + unit[[at["v", j, 0] for j in range(p)]]
    shown = model.C[:, :n] @ model.X + model.C[:, n:]
    if plant.shown:
        shown = shown + plant.D @ model.U @ matrix_power(S, -1)
    rows, resting = list[Array](), list[Array]()
    for kind, i, age in places:
        if kind == "u":
            rows.append(command(i, age - 1))
            resting.append(model.U[i] @ matrix_power(S, whole[i] - age))
        elif kind == "y":
            rows.append(seen[i] if age == 1 else unit[at["y", i, age - 1]])
            resting.append(shown[i] @ matrix_power(S, -age))
        else:
            rows.append(0.0 * unit[0])
            resting.append(np.zeros(e))
    moved = np.vstack([passed[:n], *rows, S @ exo])
    X = np.vstack([model.X, *resting])
    U = np.array([model.U[i] @ matrix_power(S, whole[i]) for i in range(m)]).reshape(m, e)
    read = np.array([unit[at["y", j, ages[j]]] if ages[j] else seen[j] for j in range(p)])

    first = {j: at["y", j, 1] for j in range(p) if ages[j]}
    noise = np.zeros((size, size))
    listed = [at["v", j, 0] for j in range(p)] if joint else list(first.values())
    noise[np.ix_(listed, listed)] = V if joint else V[np.ix_(list(first), list(first))]
    left = np.where(joint | (ages[:, None] > 0) | (ages > 0), 0.0, V)
    root = root_of(noise)

    def wide(one: Array) -> Array:
        return np.insert(one, [n] * r, 0.0, axis=1)

    def tall(one: Array) -> Array:
        return np.insert(one, [n] * r, 0.0, axis=0)

    z, own, inputs = slice(0, size), slice(0, n + r), slice(size, size + m)
    apart = np.zeros((len(unit), n + r + 2 * m))  # of (x, v, u), v the input that the plant gets, at set-points of 0
    apart[own, : n + r] = np.eye(n + r)
    apart[inputs, n + r + m :] = np.eye(m)
    apart[size + m : size + 2 * m, n + r :] = np.hstack([np.eye(m), -np.eye(m)])
    found = model.loads
    if found is not None:
        old = np.array([bool(age) for age in ages])
        found = replace(
            found, push=moved[:, size + 2 * m :], seen=np.where(old[:, None], 0.0, found.seen),
            joint=apart.T @ total[:, size + 2 * m :], alone=total[size + 2 * m :, size + 2 * m :],
            start=tall(found.start[:, None])[:, 0], moves=wide(found.moves),
        )  # fmt: skip
    covariance = wide(tall(model.covariance))
    if joint:
        covariance[np.ix_(listed, listed)] = V
    acting = np.array([command(i, whole[i]) for i in range(m)])
    stage = [*range(size + m)]

    def drawn(rng: np.random.Generator, paths: int) -> Array:
        moves = wide(model.noise(rng, paths))
        return moves + rng.standard_normal((paths, size)) @ root if noise.any() else moves

    return replace(
        model, A=moved[:, z], B=moved[:, inputs], C=read[:, z], V=None if model.V is None else left, noise=drawn,
        W=wide(tall(model.W)) + noise, stage=total[np.ix_(stage, stage)], pushed=apart.T @ total @ apart, n=n + r,
        Q=total[own, own], R=total[inputs, inputs], N=total[own, inputs], X=X, U=U,
        mean=np.concatenate([model.mean, np.zeros(r)]), covariance=covariance, terminal=wide(tall(model.terminal)),
        added=r, loads=found, pushing=moved[:, size + m : size + 2 * m], acting=acting[:, : size + m],
        fresh=not ages.any(),
    )  # fmt: skip
