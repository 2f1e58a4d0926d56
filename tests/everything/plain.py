"""A plain simulation of problem files, written from the pages of the documentation and from nothing else.

It shares no formula, no solver and no random number with the library: it reads the tables of a file as a user would,
and computes with NumPy and two functions of SciPy. ``Model`` is a sampled problem in deviations from the operating
point, ``simulate`` runs a policy (``policies``) on many paths side by side. Where a page does not say what happens, or
this file does not model it, ``NotModelledError`` names it.

Precision comes from a twin: the same controller, with every packet, runs on the same noise, and its cost is known
exactly. The answer is the exact cost plus the mean difference of the two.

Everything that a plant cannot influence is a part of one state z = (x, d, r): the plant, disturbances that the filter
estimates, and set-points, which the controller is told. Where outputs show inputs directly, or links are late, x also
has earlier inputs and outputs (``late``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

Array = NDArray[np.float64]
Tables = Mapping[str, Any]


class NotModelledError(Exception):
    """This simulation does not know what a problem states; the text names it."""


@dataclass(frozen=True)
class Changes:
    """How set-points change: steps at random, or levels at steps of a cycle.

    Args:
        rate: probability of a step per period.
        root: a root of the covariance of a step.
        levels: set-points of each step of the cycle, or None.
    """

    rate: float = 0.0
    root: Array | None = None
    levels: Array | None = None


@dataclass(frozen=True)
class Loads:
    """Disturbances with stated values: those that no filter knows, and changes of those with a state.

    Args:
        values: the first ones at each step, (steps, r); the last row remains.
        push: effect of the values on z; seen: on the outputs.
        joint: their weights with (x, v, u), (…, r), as of ``Model.pushed``; alone: their own.
        start: what is added to z at first.
        moves: what is added to z at the end of each step, (steps, …), then nothing.
    """

    values: Array
    push: Array
    seen: Array
    joint: Array
    alone: Array
    start: Array
    moves: Array


@dataclass(frozen=True)
class Model:
    """A problem in discrete time, in deviations from the operating point.

    Args:
        A: dynamics of z, B: effect of inputs on z; C: outputs of z.
        V: covariance of the measurement noise, or None if the state is measured.
        noise: draws the noise of z: rng, paths.
        W: its covariance.
        stage: weight of (z, u), all a step costs but ``rest``.
        pushed: the same of (x, v, u), where the plant gets v, and u counts: v − u is a disturbance at the inputs.
        rest: what noise costs between samples, per step.
        seconds: of a step if the plant is continuous, else 1.
        continuous: whether costs and rates are per second.
        n, q, s: numbers of states of the plant, of disturbances and of set-points.
        Q, R, N: weights of the deviations of plant and inputs from X d, U d.
        X, U: where the plant is at its set-points: x = X (d, r), u = U (d, r).
        mean, covariance: of x at the start.
        value: set-points at the start.
        pushing: effect of a disturbance that adds to the inputs on z.
        acting: the inputs that act first in a step, of (z, u).
        added: number of the states of the plant, the last ones, that are earlier inputs and outputs.
        fresh: whether no output is older than another.
    """

    A: Array
    B: Array
    C: Array
    V: Array | None
    noise: Callable[[np.random.Generator, int], Array]
    W: Array
    stage: Array
    pushed: Array
    rest: float
    seconds: float
    continuous: bool
    n: int
    q: int
    s: int
    Q: Array
    R: Array
    N: Array
    X: Array
    U: Array
    mean: Array
    covariance: Array
    value: Array
    changes: Changes
    horizon: int | None
    discount: float
    terminal: Array
    low: Array
    high: Array
    slew: Array
    point: tuple[Array, Array]
    function: Callable[[Array, Array, Array], Array] | None
    pushing: Array
    acting: Array
    loads: Loads | None = None
    added: int = 0
    fresh: bool = True

    @property
    def own(self) -> Array:
        """A mask of z: 0 for earlier inputs and outputs, which are no states of a file, else 1."""
        found = np.ones(len(self.A))
        found[self.n - self.added : self.n] = 0.0
        return found

    @property
    def whole(self) -> bool:
        """Whether a measurement is x."""
        return self.V is None and not self.added

    @property
    def exact_gain(self) -> Array:
        """The gain of the filter of a measured state."""
        size = len(self.A)
        if self.fresh:
            return np.eye(size, len(self.C))
        pick = np.flatnonzero(np.arange(size) < self.known.start)
        gain = np.zeros((size, len(self.C)))
        none = np.zeros((len(self.C),) * 2)
        gain[pick] = kalman(self.A[np.ix_(pick, pick)], self.C[:, pick], self.W[np.ix_(pick, pick)], none)[0]
        return gain

    @property
    def m(self) -> int:
        """Number of inputs."""
        return self.B.shape[1]

    @property
    def known(self) -> slice:
        """The set-points in z."""
        return slice(self.n + self.q, self.n + self.q + self.s)

    @property
    def limited(self) -> bool:
        """Whether inputs have limits."""
        return bool(np.isfinite([*self.low, *self.high, *self.slew]).any())

    @property
    def average(self) -> bool:
        """Whether the cost is an average."""
        return self.horizon is None and self.discount == 1.0


def model_of(tables: Tables, folder: Path) -> Model:
    """Return the model that a file states, as the simulated plant has it."""
    plant, cost = tables["plant"], tables["cost"]
    A, B = matrix(plant["A"]), matrix(plant["B"])
    n, m = B.shape
    full = "C" not in plant
    C = np.eye(n) if full else matrix(plant["C"])
    V = None if full else matrix(plant.get("V", np.zeros((len(C), len(C)))))
    if full and "V" in plant:
        raise NotModelledError("V without C")
    continuous = "dt" not in plant
    h = float(tables["policy"].get("period", np.nan)) if continuous else 1.0
    if continuous and not h > 0:
        raise NotModelledError("a continuous plant without period")
    point = plant.get("operating_point", {"x": np.zeros(n), "u": np.zeros(m)})
    x0, u0 = np.array(point["x"], dtype=float), np.array(point["u"], dtype=float)
    initial = plant.get("initial", {})
    mean = np.array(initial.get("mean", x0), dtype=float) - x0
    covariance = matrix(initial.get("covariance", np.zeros((n, n))))
    D = matrix(plant.get("D", np.zeros((len(C), m))))
    Q, R, N = weights_of(cost, C, D, n, m)
    jumps = plant.get("jumps")
    W = matrix(plant["W"]) if jumps is None else jumps["rate"] * matrix(jumps["covariance"])
    E, S, G, Wd = exosystem_of(tables, continuous, n, len(C))
    Cz, Dz, value, changes = set_points_of(tables, plant, C, D, x0, u0, h, folder)
    told = [one for one in tables.get("disturbance", []) if one.get("known")]  # given as set-points are, after them
    Ek, Gk = (np.array([one.get(key, np.zeros(size)) for one in told]).reshape(len(told), size).T
              for key, size in (("enters", n), ("measured", len(C))))  # fmt: skip
    changes = replace(
        changes, root=None if changes.root is None else block(changes.root, np.zeros((len(told), len(told)))),
        levels=None if changes.levels is None else np.pad(changes.levels, ((0, 0), (0, len(told)))),
    )  # fmt: skip
    value = np.concatenate([value, [stairs(one, folder)[1][0] for one in told]])
    q, s = len(S), len(Cz) + len(told)
    if (q or s) and full:
        raise NotModelledError("disturbances of a plant whose state is measured")
    # sampling of (x, d, u) together; set-points are constant between samples
    F = np.block([[A, E], [np.zeros((q, n)), S]])
    Wxd = block(W, Wd)
    if continuous:
        Fd, Wxd_d = sampled(F, Wxd, h)
        Ad, Bd = Fd[:n, :n], held(A, B, h)
        Qd, Rd, Nd = sampled_weights(A, B, Q, R, N, h)
        both, none = np.hstack([B, np.zeros((n, m))]), np.zeros((m, m))
        pushed = block2(*(sampled_weights(A, both, Q, block(none, R), np.hstack([np.zeros((n, m)), N]), h)[i]
                          for i in (0, 2, 1)))  # fmt: skip
    else:
        Fd, Wxd_d, Ad, Bd, Qd, Rd, Nd = F, Wxd, A, B, Q, R, N
        pushed = block2(Q, np.hstack([np.zeros((n, m)), N]), block(np.zeros((m, m)), R))
    Ed, Sd = Fd[:n, n:], Fd[n:, n:]
    Ekd = held(A, Ek, h) if continuous else Ek
    Sa, Ea = block(Sd, np.eye(s)), np.hstack([Ed, np.zeros((n, len(Cz))), Ekd])
    target = np.hstack([np.zeros((len(Cz), q)), -np.eye(s)[: len(Cz)]])
    X, U = regulator_equations(Ad, Bd, Ea, Sa, Cz, Dz, target, block2(Q, N, R)) if q + s else (np.zeros((n, 0)),
                                                                                         np.zeros((m, 0)))  # fmt: skip
    Aa = np.block([[Ad, Ea], [np.zeros((q + s, n)), Sa]])
    Ba, Ca = np.vstack([Bd, np.zeros((q + s, m))]), np.hstack([C, G, np.zeros((len(C), len(Cz))), Gk])
    to = np.block([[np.eye(n), -X, np.zeros((n, m))], [np.zeros((m, n)), -U, np.eye(m)]])
    stage = to.T @ block2(Qd, Nd, Rd) @ to
    rest = 0.0
    if continuous:
        if q and not np.allclose(S, 0):
            raise NotModelledError("the integral of a disturbance that moves between samples")
        spread = np.vstack([np.hstack([np.eye(n), -X[:, :q]]), np.hstack([np.zeros((m, n)), -U[:, :q]])])
        rest = noise_between(A, B, block2(Q, N, R), spread @ Wxd @ spread.T, h)
    Wa = block(Wxd_d, np.zeros((s, s)))
    draw = gaussian(Wa) if jumps is None else poisson(jumps, A, n, q + s, h, Wa)
    low, high, slew = limits_of(plant, u0, h, continuous)
    function = None
    if "function" in plant:
        scope: dict[str, Any] = {}
        exec((folder / plant["function"].partition(":")[0]).read_text(encoding="utf-8"), scope)
        function = scope[plant["function"].partition(":")[2]]
    terminal = matrix(cost.get("terminal", Q))
    found = Model(
        Aa, Ba, Ca, V, draw, Wa, stage, pushed, rest, h, continuous, n, q, s, Qd, Rd, Nd, X, U, mean, covariance, value,
        changes, cost.get("horizon"), float(cost.get("discount", 1.0)), terminal, low, high, slew, (x0, u0), function,
        Ba, np.hstack([np.zeros((m, n + q + s)), np.eye(m)]),
        loads_of(tables, folder, h, continuous, (A, B), (Q, R, N), q, s, len(C)),
    )  # fmt: skip
    from everything.late import Plain, late_of, with_queues

    late = late_of(tables, len(C), m, h if continuous else float(plant["dt"]))
    fed = "D" in plant or "D" in plant.get("actual", {})
    if not fed and not late.given:
        return found
    all_of_them = np.hstack([E, np.zeros((n, len(Cz))), Ek])
    return with_queues(found, late, Plain(A, B, Q, R, N, all_of_them, unknown(tables, n, len(C))[0], D, fed), Sa)


def in_plain_form(tables: Tables) -> Tables:
    """Return the file with covariances in place of amplitudes of noise, and with the plants without E.

    W, jumps and disturbances are those of the equation of E, and noise at the inputs acts as they do, by its B.
    """
    found = dict(tables)
    found["plant"] = dict(tables["plant"])
    if "actual" in found["plant"]:
        found["plant"]["actual"] = dict(found["plant"]["actual"])
    for plant in (found["plant"], found["plant"].get("actual", {})):
        noise = plant.pop("noise", {})
        if "input" in noise:
            plant["W"] = (matrix(plant["B"]) @ np.diag(np.array(noise["input"]) ** 2) @ matrix(plant["B"]).T).tolist()
        if "output" in noise:
            plant["V"] = np.diag(np.array(noise["output"]) ** 2).tolist()
        if "E" not in plant:
            continue
        inverse = np.linalg.inv(matrix(plant.pop("E")))
        plant |= {key: (inverse @ matrix(plant[key])).tolist() for key in "AB"}
        if "W" in plant:
            plant["W"] = (inverse @ matrix(plant["W"]) @ inverse.T).tolist()
        if "jumps" in plant:
            covariance = inverse @ matrix(plant["jumps"]["covariance"]) @ inverse.T
            plant["jumps"] = {**plant["jumps"], "covariance": covariance.tolist()}
        if plant is found["plant"] and "disturbance" in tables:
            moved = [(inverse @ np.array(one["enters"])).tolist() for one in tables["disturbance"]]
            found["disturbance"] = [
                {**one, "enters": enters} for one, enters in zip(tables["disturbance"], moved, strict=True)
            ]
    return found


def matrix(values: Any) -> Array:
    """Return rows as a matrix."""
    return np.array(values, dtype=float, ndmin=2)


def block(*parts: Array) -> Array:
    """Return a block-diagonal matrix."""
    size = [sum(one.shape[i] for one in parts) for i in (0, 1)]
    found, i, j = np.zeros(size), 0, 0
    for one in parts:
        found[i : i + one.shape[0], j : j + one.shape[1]] = one
        i, j = i + one.shape[0], j + one.shape[1]
    return found


def block2(Q: Array, N: Array, R: Array) -> Array:
    """Return the weight of (x, u)."""
    return np.block([[Q, N], [N.T, R]])


def weights_of(cost: Tables, C: Array, D: Array, n: int, m: int) -> tuple[Array, Array, Array]:
    """Return Q, R and N."""
    N = matrix(cost.get("N", np.zeros((n, m))))
    if "Q" in cost:
        return matrix(cost["Q"]), matrix(cost["R"]), N
    if "output_variance" in cost:
        outputs, inputs = (np.diag(1 / np.array(cost[f"{name}_variance"])) for name in ("output", "input"))
        return C.T @ outputs @ C, inputs + D.T @ outputs @ D, C.T @ outputs @ D
    return np.eye(n), np.eye(m), N  # as the controller: computed from its loop


def exosystem_of(tables: Tables, continuous: bool, n: int, p: int) -> tuple[Array, Array, Array, Array]:
    """Return E, S, G and the noise of the disturbances; the first state of each is its value."""
    E, S, G, W = np.zeros((n, 0)), np.zeros((0, 0)), np.zeros((p, 0)), np.zeros((0, 0))
    for one in tables.get("disturbance", []):
        if one.get("known") or not one["wander"]:
            continue
        kind, w = one.get("kind", "constant"), float(one.get("frequency", 0.0))
        if kind == "constant":
            own, moved = np.array([[0.0 if continuous else 1.0]]), [1.0]
        elif kind == "ramp":
            own, moved = np.array([[0.0, 1.0], [0.0, 0.0]]) + (0.0 if continuous else np.eye(2)), [0.0, 1.0]
        elif kind == "sinusoid":
            turn = np.array([[0.0, w], [-w, 0.0]])
            own, moved = (turn if continuous else expm(turn)), [1.0, 1.0]
        else:
            own = matrix(one["matrix"])
            moved = [1.0] * len(own)
        first = np.eye(len(own))[:1]
        E = np.hstack([E, np.outer(one["enters"], first)])
        G = np.hstack([G, np.outer(one.get("measured", np.zeros(p)), first)])
        S, W = block(S, own), block(W, one["wander"] * np.diag(moved))
    if "integral_action" in tables.get("reference", {}):
        raise NotModelledError("integral action")
    return E, S, G, W


def stairs(one: Tables, folder: Path) -> tuple[Array, Array]:
    """Return the times of the values of a disturbance, from 0 on, and these values."""
    rows = np.loadtxt(folder / one["file"], delimiter=",", ndmin=2) if "file" in one else matrix(one["steps"])
    return np.r_[0.0, rows[:, 0]], np.r_[one.get("initial", 0.0), rows[:, 1]]


def loads_of(
    tables: Tables, folder: Path, h: float, continuous: bool, plant: tuple[Array, Array], weights: tuple[Array, ...],
    q: int, s: int, p: int,
) -> Loads | None:  # fmt: skip
    """Return the stated values of disturbances at the steps; those that no filter knows are held between them."""
    (A, B), (Q, R, N), listed = plant, weights, tables.get("disturbance", [])
    n, m = B.shape
    stated = [one for one in listed if "steps" in one or "file" in one]
    if not stated:
        return None
    rows = 60
    sizes = [
        0 if one.get("known") or not one["wander"] else 1 if one.get("kind", "constant") == "constant" else 2
        for one in listed
    ]
    known = [one for one in listed if one.get("known")]
    start, moves = np.zeros(n + q + s), np.zeros((rows, n + q + s))
    values = list[Array]()
    for one in stated:
        times, levels = stairs(one, folder)
        level = levels[np.searchsorted(times, np.arange(rows + 1) * h * (1 + 1e-9), side="right") - 1]
        if one.get("known"):
            moves[:, n + q + s - len(known) + known.index(one)] = np.diff(level)
        elif one["wander"]:
            place = n + sum(sizes[: listed.index(one)])
            start[place], moves[:, place] = level[0], np.diff(level)
        else:
            values.append(level[:-1])
    r = len(values)
    E, G = unknown(tables, n, p)
    joint, alone = np.zeros((n + 2 * m, r)), np.zeros((r, r))
    if continuous:
        into = np.hstack([B, np.zeros((n, m)), E])
        _, Rl, Nl = sampled_weights(
            A,
            into,
            Q,
            block(np.zeros((m, m)), R, np.zeros((r, r))),
            np.hstack([np.zeros((n, m)), N, np.zeros((n, r))]),
            h,
        )
        joint, alone = np.vstack([Nl[:, 2 * m :], Rl[: 2 * m, 2 * m :]]), Rl[2 * m :, 2 * m :]
        E = held(A, E, h) if r else E
    push = np.vstack([E, np.zeros((q + s, r))])
    return Loads(np.array(values).reshape(r, rows).T, push, G, joint, alone, start, moves)


def unknown(tables: Tables, n: int, p: int) -> tuple[Array, Array]:
    """Return how the disturbances that no filter knows enter, and how the outputs show them."""
    found = [
        one for one in tables.get("disturbance", [])
        if ("steps" in one or "file" in one) and not one.get("known") and not one["wander"]
    ]  # fmt: skip
    E, G = ([one.get(key, np.zeros(size)) for one in found] for key, size in (("enters", n), ("measured", p)))
    return np.array(E, dtype=float).reshape(len(found), n).T, np.array(G, dtype=float).reshape(len(found), p).T


def set_points_of(
    tables: Tables, plant: Tables, C: Array, D: Array, x0: Array, u0: Array, h: float, folder: Path
) -> tuple[Array, Array, Array, Changes]:
    """Return what is kept at set-points, C_z x + D_z u, these as deviations, and how they change."""
    table = tables.get("reference")
    if table is None and not any(one.get("known") or one["wander"] for one in tables.get("disturbance", [])):
        return np.zeros((0, C.shape[1])), np.zeros((0, len(u0))), np.zeros(0), Changes()
    table = table or {}
    if "states" in table:
        raise NotModelledError("a trajectory")
    Cz = matrix(table.get("outputs", C))
    Dz = np.zeros((len(Cz), len(u0))) if "outputs" in table else D
    at = Cz @ x0 + Dz @ u0
    value, changes = np.array(table.get("value", at), dtype=float) - at, Changes()
    if table.keys() & {"range", "ramp"}:
        raise NotModelledError("limits of set-points")
    if "steps" in table:
        rate = table["steps"]["rate"] * (h if "dt" not in plant else 1.0)
        changes = Changes(rate, root_of(matrix(table["steps"]["covariance"])))
    if "file" in table:
        rows = np.loadtxt(folder / table["file"], delimiter=",", ndmin=2)
        times = np.rint(rows[:, 0] / h).astype(int)
        levels = np.repeat(rows[:-1, 1:] - at, np.diff(times), axis=0)
        value, changes = levels[0], Changes(levels=levels)
    return Cz, Dz, value, changes


def limits_of(plant: Tables, u0: Array, h: float, continuous: bool) -> tuple[Array, Array, Array]:
    """Return the limits of the inputs as deviations, and the largest change per step."""
    m = len(u0)
    low, high, slew = np.full(m, -np.inf), np.full(m, np.inf), np.full(m, np.inf)
    for i, one in enumerate(plant.get("input_limit", [])):
        low[i], high[i] = one if isinstance(one, list) else (-one, one)
    for i, one in enumerate(plant.get("input_rate", [])):
        slew[i] = one * (h if continuous else 1.0)
    return low - u0, high - u0, slew


def root_of(covariance: Array) -> Array:
    """Return the symmetric root."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors @ np.diag(np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def gaussian(covariance: Array) -> Callable[[np.random.Generator, int], Array]:
    """Return what draws normal vectors."""
    root = root_of(covariance)
    return lambda rng, paths: rng.standard_normal((paths, len(root))) @ root


def poisson(
    jumps: Tables, A: Array, n: int, more: int, h: float, covariance: Array
) -> Callable[[np.random.Generator, int], Array]:
    """Return what draws the sum of the jumps of a period, each carried on by the plant to the end of the period."""
    law, jump = jumps.get("distribution", "normal"), matrix(jumps["covariance"])
    if law != "normal" and np.count_nonzero(jump - np.diag(np.diag(jump))):
        raise NotModelledError("correlated jumps that are not normal")
    carried = np.array([expm(A * t) for t in np.linspace(0, h, GRID)])  # on a grid of times, then interpolated
    root, rest = root_of(jump), gaussian(covariance - block(covariance[:n, :n], np.zeros((more, more))))

    def draw(rng: np.random.Generator, paths: int) -> Array:
        counts = rng.poisson(jumps["rate"] * h, paths)
        found = rest(rng, paths)
        for place in range(int(counts.max(initial=0))):
            hit = counts > place
            unit = rng.standard_normal((int(hit.sum()), n))
            if law == "uniform":
                unit = rng.uniform(-np.sqrt(3), np.sqrt(3), unit.shape)
            if law == "two-point":
                unit = rng.choice([-1.0, 1.0], unit.shape)
            times = rng.uniform(0, h, len(unit))
            place_of, share = np.divmod(times / h * (GRID - 1), 1.0)
            lower = np.minimum(place_of.astype(int), GRID - 2)
            moves = carried[lower] + share[:, None, None] * (carried[lower + 1] - carried[lower])
            found[hit, :n] += np.einsum("pij,pj->pi", moves, unit @ root)
        return found

    return draw


GRID = 33


def sampled(F: Array, W: Array, h: float) -> tuple[Array, Array]:
    """Return e^{Fh} and the covariance of the noise of a period (Van Loan)."""
    n = len(F)
    found = expm(np.block([[-F, W], [np.zeros((n, n)), F.T]]) * h)
    move = found[n:, n:].T
    return move, move @ found[:n, n:]


def held(A: Array, B: Array, h: float) -> Array:
    """Return the effect of an input that is held for a period."""
    n, m = B.shape
    return expm(np.block([[A, B], [np.zeros((m, n + m))]]) * h)[:n, n:]


def sampled_weights(A: Array, B: Array, Q: Array, R: Array, N: Array, h: float) -> tuple[Array, Array, Array]:
    """Return the weights of the integral over a period with an input that is held."""
    n, m = B.shape
    F = np.block([[A, B], [np.zeros((m, n + m))]])
    weight = block2(Q, N, R)
    k = n + m
    found = expm(np.block([[-F.T, weight], [np.zeros((k, k)), F]]) * h)
    total = found[k:, k:].T @ found[:k, k:]
    total = (total + total.T) / 2
    return total[:n, :n], total[n:, n:], total[:n, n:]


def noise_between(A: Array, B: Array, weight: Array, spread: Array, h: float) -> float:
    """Return what the noise of a period costs in this period, from zero: the integral of tr(weight P(t)).

    P is the covariance of (ξ, μ), dξ = Aξ + Bμ, with this noise.
    """
    n, m = B.shape
    F = np.block([[A, B], [np.zeros((m, n + m))]])
    k = n + m
    unit = np.eye(k)
    moves = np.kron(F, unit) + np.kron(unit, F)  # of vec P, beside a constant 1 and the integral
    joint = np.zeros((k * k + 2, k * k + 2))
    joint[: k * k, : k * k], joint[: k * k, -2] = moves, spread.reshape(-1)
    joint[-1, : k * k] = weight.reshape(-1)
    return float(expm(joint * h)[-1, -2])


def regulator_equations(
    A: Array, B: Array, E: Array, S: Array, Cz: Array, Dz: Array, F: Array, weight: Array
) -> tuple[Array, Array]:
    """Return X and U with A X + B U + E = X S, Cz X + Dz U + F = 0, and of several the least tr [X; U]'weight[X; U].

    Raises:
        NotModelledError: there are none.
    """
    n, m = B.shape
    q = E.shape[1]
    unit = np.eye(q)
    upper = np.hstack([np.kron(unit, A) - np.kron(S.T, np.eye(n)), np.kron(unit, B)])
    lower = np.hstack([np.kron(unit, Cz), np.kron(unit, Dz)])
    M, right = np.vstack([upper, lower]), -np.concatenate([E.T.reshape(-1), F.T.reshape(-1)])
    found = np.linalg.lstsq(M, right, rcond=None)[0]
    if M.size and np.abs(M @ found - right).max(initial=0.0) > 1e-8 * (1 + np.abs(right).max(initial=0.0)):
        raise NotModelledError("regulator equations without a solution")
    values = np.linalg.svd(M)
    rank = int((values[1] > 1e-10 * values[1].max()).sum())
    free = values[2][rank:].T
    if free.shape[1]:
        big = np.block([[np.kron(unit, weight[:n, :n]), np.kron(unit, weight[:n, n:])],
                        [np.kron(unit, weight[n:, :n]), np.kron(unit, weight[n:, n:])]])  # fmt: skip
        found = found - free @ np.linalg.lstsq(free.T @ big @ free, free.T @ big @ found, rcond=None)[0]
    return found[: n * q].reshape(q, n).T, found[n * q :].reshape(q, m).T


def regulator(A: Array, B: Array, Q: Array, R: Array, N: Array, discount: float = 1.0) -> tuple[Array, Array, Array]:
    """Return K, H and L of the infinite horizon."""
    root = np.sqrt(discount)
    try:
        K = np.asarray(solve_discrete_are(root * A, root * B, Q, R, s=N))
        for _ in range(20000):  # an entry of 1e-17 in A can let scipy err by the size of K
            K, before = riccati(A, B, Q, R, N, K, discount)[0], K
            if np.abs(K - before).max() <= 1e-13 * np.abs(K).max():
                break
    except (np.linalg.LinAlgError, ValueError) as error:
        K = np.zeros_like(Q)  # with modes that the cost does not see: the recursion from 0
        for _ in range(20000):
            new = riccati(A, B, Q, R, N, K, discount)[0]
            if np.abs(new - K).max() <= 1e-13 * np.abs(new).max():
                break
            K = new
        else:
            raise NotModelledError("a Riccati equation without a solution") from error
    H = R + discount * B.T @ K @ B
    return K, H, -inverse(H) @ (discount * B.T @ K @ A + N.T)


def inverse(H: Array) -> Array:
    """Return the inverse of a weight, or the least of inputs that still act on something: a late one may not."""
    return np.linalg.pinv(H, hermitian=True, rcond=1e-12)


def riccati(
    A: Array, B: Array, Q: Array, R: Array, N: Array, K: Array, discount: float = 1.0
) -> tuple[Array, Array, Array]:
    """Return the value before a step, H and L, from the value K after it."""
    H = R + discount * B.T @ K @ B
    L = -inverse(H) @ (discount * B.T @ K @ A + N.T)
    new = Q + discount * A.T @ K @ A - L.T @ H @ L
    return (new + new.T) / 2, H, L


def measure_update(prior: Array, C: Array, V: Array) -> tuple[Array, Array]:
    """Return the gain of a measurement, and the covariance after it."""
    gain = prior @ C.T @ np.linalg.pinv(C @ prior @ C.T + V, rcond=1e-12, hermitian=True)
    left = np.eye(len(prior)) - gain @ C
    return gain, left @ prior @ left.T + gain @ V @ gain.T


def kalman(A: Array, C: Array, W: Array, V: Array) -> tuple[Array, Array, Array]:
    """Return gain, prior and posterior covariance of the steady filter, by iteration."""
    prior = W + np.eye(len(A))
    for _ in range(100_000):
        _, posterior = measure_update(prior, C, V)
        new = A @ posterior @ A.T + W
        new = (new + new.T) / 2
        if np.abs(new - prior).max() <= 1e-12 * np.abs(new).max():
            gain, posterior = measure_update(new, C, V)
            return gain, new, posterior
        prior = new
    raise NotModelledError("a filter that does not settle")


# -- running


class Controller(Protocol):
    """A policy: all its nodes together.

    ``step`` takes the number of the step, the measurements (paths, p) and the set-points (paths, s), and returns the
    inputs that are applied and what was sent, (paths,) by link.
    """

    exact: float | None

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Make a step."""
        ...


@dataclass(frozen=True)
class Answer:
    """Cost and rates with their standard errors, in the units of the documentation."""

    cost: tuple[float, float]
    rates: Mapping[str, tuple[float, float]]
    base: float | None = None
    base_found: tuple[float, float] | None = None
    excess: tuple[float, float] | None = (
        None  # of the cost over that of a twin on the same noise, whatever the world is
    )


class World:
    """Plants of many paths."""

    def __init__(self, model: Model, paths: int, start: Array) -> None:
        """Start."""
        self.model, self.z = model, np.zeros((paths, len(model.A)))
        self.z[:, : model.n] = start
        self.z[:, model.known] = model.value
        self.k = 0
        if model.loads is not None:
            self.z += model.loads.start

    def measure(self, v: Array) -> Array:
        """Return the measurements."""
        loads = self.model.loads
        return self.z @ self.model.C.T + v + (0.0 if loads is None else loads.seen @ self.load)

    @property
    def load(self) -> Array:
        """The values of the disturbances that no filter knows."""
        assert self.model.loads is not None
        return self.model.loads.values[min(self.k, len(self.model.loads.values) - 1)]

    def move(self, u: Array, w: Array, dr: Array) -> Array:
        """Apply inputs; return the costs of the step. Twice as many columns: inputs, and these with disturbances."""
        model, z = self.model, self.z
        if u.shape[1] > model.m:
            there, steady = z[:, model.n :] @ model.X.T, z[:, model.n :] @ model.U.T
            joint = np.hstack([z[:, : model.n] - there, u[:, model.m :] - steady, u[:, : model.m] - steady])
            weight = model.pushed
        else:
            joint, weight = np.hstack([z, u]), model.stage
        given, u = u[:, : model.m], u[:, -model.m :]
        cost = np.einsum("pi,ij,pj->p", joint, weight, joint) + model.rest
        if model.loads is not None:
            m, there, steady = model.m, z[:, model.n :] @ model.X.T, z[:, model.n :] @ model.U.T
            joint = np.hstack([z[:, : model.n] - there, u[:, -m:] - steady, u[:, :m] - steady])
            cost = cost + 2 * joint @ model.loads.joint @ self.load + self.load @ model.loads.alone @ self.load
        self.z = z @ model.A.T + given @ model.B.T + (u - given) @ model.pushing.T + w
        if model.function is not None:
            n, (x0, u0) = model.n - model.added, model.point
            acts = np.hstack([z, given]) @ model.acting.T + u - given
            moved = zip(z[:, :n] + x0, acts + u0, w[:, :n], strict=True)
            rest = z[:, model.n :] @ model.A[:n, model.n :].T
            self.z[:, :n] = np.array([model.function(*one) for one in moved]) - x0 + rest
        self.z[:, model.known] += dr
        if model.loads is not None:
            self.z += model.loads.push @ self.load
            self.z += model.loads.moves[self.k] if self.k < len(model.loads.moves) else 0.0
        self.k += 1
        return cost


def changed(model: Model, k: int, paths: int, rng: np.random.Generator) -> Array:
    """Return the changes of the set-points at the end of step k."""
    changes = model.changes
    if changes.levels is not None:
        count = len(changes.levels)
        return np.tile(changes.levels[(k + 1) % count] - changes.levels[k % count], (paths, 1))
    if changes.root is None:
        return np.zeros((paths, model.s))
    hit = rng.random(paths) < changes.rate
    return hit[:, None] * (rng.standard_normal((paths, model.s)) @ changes.root)


def simulate(
    model: Model, policy: Controller, twin: Controller | None, *, seed: int, paths: int, steps: int, settle: int
) -> Answer:
    """Return cost and rates of a policy; with a twin, by the difference to its cost on the same noise."""
    streams = [np.random.default_rng([seed, i]) for i in range(6)]
    start = np.zeros((paths, model.n))
    if not model.average:
        start = model.mean + streams[0].standard_normal((paths, model.n)) @ root_of(model.covariance)
    loops = [policy] if twin is None else [policy, twin]
    worlds = [World(model, paths, start) for _ in loops]
    for i, one in enumerate(loops):
        one.start(paths, streams[1 + i])
    p = len(model.C)
    V = np.zeros((p, p)) if model.V is None else model.V
    root = root_of(V)
    if model.horizon is not None:
        settle, steps = 0, model.horizon
    elif model.discount < 1:
        settle, steps = 0, int(np.ceil(np.log(1e-7) / np.log(model.discount)))
    totals, sent = np.zeros((len(loops), paths)), dict[str, Array]()
    for k in range(settle + steps):
        v = streams[3].standard_normal((paths, p)) @ root
        w, dr = model.noise(streams[4], paths), changed(model, k, paths, streams[5])
        weight = 0.0 if k < settle else model.discount**k if model.discount < 1 else 1.0
        for i, (loop, world) in enumerate(zip(loops, worlds, strict=True)):
            u, packets = loop.step(k, world.measure(v), world.z[:, model.known])
            totals[i] += weight * world.move(u, w, dr)
            if i == 0 and weight:
                for link, flags in packets.items():
                    sent[link] = sent.get(link, np.zeros(paths)) + weight * flags
    if model.horizon is not None:
        for i, world in enumerate(worlds):
            x = world.z[:, : model.n]
            totals[i] += np.einsum("pi,ij,pj->p", x, model.terminal, x)
    scale = 1.0 if not model.average else steps * model.seconds
    share = {True: steps, False: 1 / (1 - model.discount) if model.discount < 1 else steps}[model.average]
    pace = model.seconds if model.continuous and model.average else model.seconds if model.continuous else 1.0
    rates = {link: mean_of(flags / share / pace) for link, flags in sent.items()}
    excess = None if twin is None else excess_of(totals[0] / scale, totals[1] / scale)
    if twin is None or twin.exact is None:
        return Answer(mean_of(totals[0] / scale), rates, excess=excess)
    exact = twin.exact / (model.seconds if model.average else 1.0)
    assert model.loads is None or not (model.loads.push.any() or model.loads.seen.any())
    differences = mean_of((totals[0] - totals[1]) / scale)
    return Answer((exact + differences[0], differences[1]), rates, exact, mean_of(totals[1] / scale), excess)


def excess_of(costs: Array, others: Array) -> tuple[float, float] | None:
    """Return by which share the mean of costs exceeds that of others, with the error of the pairs."""
    if not others.mean() > 0:
        return None
    ratio = float(costs.mean() / others.mean())
    return ratio - 1.0, mean_of(costs - ratio * others)[1] / float(others.mean())


def mean_of(values: Array) -> tuple[float, float]:
    """Return mean and standard error of independent values."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def with_actual(model: Model, tables: Tables, folder: Path) -> Model:
    """Return the model of the simulated plant, where a file states another one than for the design."""
    actual = tables["plant"].get("actual")
    if actual is None:
        return model
    kept = {"operating_point": tables["plant"]["operating_point"]} if "operating_point" in tables["plant"] else {}
    fed = {"D": np.zeros((len(model.C), model.m))} if "D" in {**tables["plant"], **actual} else {}
    other = model_of({**tables, "plant": {**kept, **fed, **actual}}, folder)
    if model.q + model.s or model.continuous:
        if "weights" in tables["cost"]:
            raise NotModelledError("weights as a controller's for another plant that is sampled or follows set-points")
        return other  # its cost counts from where its own outputs are at their set-points
    # weights may be those of a controller with the plant of the design
    return replace(other, stage=model.stage, pushed=model.pushed)
