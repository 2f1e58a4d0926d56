"""Problems that are tuned to cost 5 % more than every sample, and a plain simulation that measures these 5 %.

Each case is a plant with a controller and what a loop meets in use: limits, losses, loads, an operator, and several of
these. ``found`` tunes a case as a user does, and runs the tuned policy beside the loop that sends every sample, on the
same noise, losses and set-points; the policies and plants are those of ``plain`` and ``kept``, with what these lack:
limits of the inputs for a controller that is kept, and lost packets for LQG with set-points. As a script,
``python tests/everything/five_percent.py [NAME …]`` prints a table.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from everything import plain
from everything.kept import Base, KeptPolicy, following, given_of, kept_policy, observer
from everything.laws import Law, nodes_of
from everything.plain import Array, Model
from everything.policies import Certainty, Rules, quadratic, reached
from everything.toml import text_of

import taciturn

Tables = Mapping[str, Any]
Change = Callable[[dict[str, Any]], None]

PLANTS: dict[str, dict[str, Any]] = {
    "tank": {
        "plant": {"A": [[1.0, 0.1], [0.0, 0.9]], "B": [[0.0], [0.1]], "C": [[1.0, 0.0]],
                  "W": [[1e-4, 0.0], [0.0, 4e-4]], "V": [[1e-3]], "dt": 0.1},
        "cost": {"Q": [[1.0, 0.0], [0.0, 0.0]], "R": [[0.05]]},
        "pid": {"kp": 1.2, "ki": 0.15, "kd": 1.0, "filter": 0.5},
    },
    "motor": {
        "plant": {"A": [[0.0, 1.0], [0.0, -2.0]], "B": [[0.0], [5.0]], "C": [[1.0, 0.0]],
                  "W": [[0.0, 0.0], [0.0, 0.5]], "V": [[1e-3]]},
        "cost": {"Q": [[1.0, 0.0], [0.0, 0.0]], "R": [[0.1]]},
        "pid": {"kp": 2.0, "ki": 0.5, "kd": 0.3, "filter": 0.2}, "period": 0.05,
    },
    "mass": {
        "plant": {"A": [[1.0, 0.1], [0.0, 0.98]], "B": [[0.005], [0.1]], "C": [[1.0, 0.0]],
                  "W": [[1e-6, 0.0], [0.0, 1e-3]], "V": [[1e-3]], "dt": 0.1},
        "cost": {"Q": [[1.0, 0.0], [0.0, 0.1]], "R": [[0.1]]},
        "pid": {"kp": 1.5, "kd": 1.5, "filter": 0.4},
    },
    "rooms": {
        "plant": {"A": [[-0.15, 0.05], [0.05, -0.12]], "B": [[0.1, 0.0], [0.0, 0.08]],
                  "C": [[1.0, 0.0], [0.0, 1.0]], "W": [[0.01, 0.0], [0.0, 0.02]], "V": [[0.01, 0.0], [0.0, 0.01]]},
        "cost": {"Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[0.1, 0.0], [0.0, 0.1]]},
        "pid": [{"kp": 2.0, "ki": 0.3, "tracking_time": 5.0, "input": 1, "output": 1},
                {"kp": 2.5, "ki": 0.4, "tracking_time": 5.0, "input": 2, "output": 2}], "period": 0.5,
    },
    "oscillator": {
        "plant": {"A": [[0.0, 1.0], [-1.0, -0.2]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]],
                  "W": [[0.0, 0.0], [0.0, 0.1]], "V": [[0.01]]},
        "cost": {"Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[0.2]]},
        "pid": {"kp": 0.5, "ki": 0.3, "kd": 1.2, "filter": 0.5, "tracking_time": 3.0}, "period": 0.2,
    },
}  # fmt: skip
LIMITS = {"tank": 0.3, "motor": 0.5, "mass": 0.45, "rooms": 0.8, "oscillator": 0.8}
JUMPS = {"tank": 0.5, "motor": 0.5, "mass": 0.5, "rooms": 0.5, "oscillator": 0.5}  # deviations of set-points
SHIFTS = {"tank": 0.2, "motor": 0.2, "mass": 0.2, "rooms": 0.3, "oscillator": 0.2}  # loads, in units of the input


CASES = (
    "tank pid", "tank pid s", "tank pid l", "tank pid u", "tank pid ds", "tank pid so", "tank pid lu", "tank lqg",
    "tank lqg l", "tank lqg ud", "tank band", "tank band l", "tank event", "motor pid", "motor pid l", "motor pid lb",
    "motor pid uo", "motor lqg", "motor lqg l", "motor lqg a", "motor lqg uo", "mass pid l", "mass pid lu",
    "mass pid o", "mass lqg l", "mass lqg lu", "mass lqg d", "mass lqg t", "rooms pid", "rooms pid l", "rooms pid o",
    "rooms lqg l", "rooms lqg b", "rooms lqg o", "rooms lqg ld", "oscillator pid l", "oscillator pid t",
    "oscillator pid lt", "oscillator pid lu", "oscillator pid la", "oscillator lqg lu", "oscillator lqg lt",
)  # fmt: skip


def drafted(plant: str, controller: str, features: str) -> dict[str, Any]:
    """Return the tables of a problem: a plant, "lqg" or "pid", maybe with a kind, and features by their letters.

    Letters: l limits, u losses without acknowledgement, a with it, b bursts without it, d a load, o an operator,
    t a timetable, s the slow disturbance that an integrating controller is given.
    """
    base = deepcopy(PLANTS[plant])
    tables: dict[str, Any] = {"plant": base["plant"], "cost": base["cost"], "policy": {"kind": "excess", "theta": 0.1}}
    h = base.get("period", base["plant"].get("dt"))
    if "period" in base:
        tables["policy"]["period"] = base["period"]
    m, p = len(base["plant"]["B"][0]), len(base["plant"]["C"])
    if controller != "lqg":
        tables["controller"] = {"pid": base["pid"]}
        if "s" not in features:
            tables["controller"]["disturbance"] = "none"
    if controller == "band":
        tables["policy"] |= {"kind": "send-on-delta", "delta": 0.1, "link": "actuator"}
        del tables["policy"]["theta"]
    if controller == "event":
        tables["policy"] |= {"kind": "event-pid", "delta": 0.05}
        del tables["policy"]["theta"]
    if "l" in features:
        tables["plant"]["input_limit"] = [LIMITS[plant]] * m
    if "u" in features:
        tables["network"] = {"protocol": "udp", "actuator_loss": 0.2}
    if "a" in features:
        tables["network"] = {"protocol": "tcp", "actuator_loss": 0.2}
    if "b" in features:
        burst = {"to_bad": 0.05, "to_good": 0.3, "loss_good": 0.05, "loss_bad": 0.7}
        tables["network"] = {"protocol": "udp", "actuator_burst": burst}
    pace = 1.0 if "dt" in base["plant"] else h
    if "d" in features:
        enters = [SHIFTS[plant] * row[0] for row in base["plant"]["B"]]
        tables["disturbance"] = [{"enters": enters, "wander": 0.0, "initial": 0.3, "steps": [[20 * pace, 1.0]]}]
    if "o" in features:
        covariance = (JUMPS[plant] ** 2 * np.eye(p)).tolist()
        tables["reference"] = {"steps": {"rate": 0.01 / pace, "covariance": covariance}}
    if "t" in features:
        rows = [[0.0, 0.0], [60 * pace, JUMPS[plant]], [110 * pace, -JUMPS[plant]], [170 * pace, 0.0]]
        tables["reference"] = {"file": "levels.csv"}
        tables["levels"] = [[time, *[value] * p] for time, value in rows]
    return tables


def write(tables: dict[str, Any], folder: Path) -> Path:
    """Write the problem file, and the timetable that it names; the tables are then those of the file."""
    levels = tables.pop("levels", None)
    if levels is not None:
        np.savetxt(folder / "levels.csv", np.array(levels), delimiter=",", fmt="%.12g")
    path = folder / "problem.toml"
    path.write_text(text_of(tables), encoding="utf-8")
    return path


# -- what plain and kept lack


class LimitedKept(KeptPolicy):
    """A controller that is kept, with limits of the inputs, on an actuator that holds."""

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin with the input 0, or the limit that is nearest."""
        super().start(paths, rng)
        zero = np.clip(np.zeros((paths, self.model.m)), self.model.low, self.model.high)
        self.wanted, self.h, self.real_wanted, self.real = zero, zero, zero, zero

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Make a step: packets carry commands within their range, towards which the input moves by at most a rate."""
        given, model = self.given, self.model
        estimate = self.prior + (y - self.prior @ self.C.T) @ self.G.T
        r = r[:, : self.follows.D.shape[1]]
        command = self.c @ given.C.T + y @ given.D.T + r @ self.follows.D.T
        packet = np.clip(command, model.low, model.high)
        sent, silent = reached(model, packet, self.h), reached(model, self.wanted, self.h)
        changes = (sent != silent) | (not self.told)  # without acknowledgement nobody knows what a packet changes
        held = np.where(changes, self.wanted, command)  # no difference where a packet changes nothing
        if self.rule == "band":
            wants = (np.abs(held - command) > self.level).any(axis=1)
        else:
            assert self.base is not None
            w = np.hstack([estimate, self.c, y, r])
            if self.law.lossy or len(self.base.slopes) > 1:
                whole, slopes = np.hstack([w, held]), self.base.slopes
                cost = np.einsum("pa,aij,pi,pj->p", self.belief, self.base.psi[0], whole, whole)
                wants = cost + whole @ slopes[k % len(slopes)] > self.level
                wants |= (sent != command).any(axis=1)
            else:
                wants = self.ahead(w, silent) - self.ahead(w, sent) > self.level
            wants |= self._alarm(y)
        wants = np.ones_like(wants) if self.always else wants & changes.any(axis=1)
        arrived = self.channel.arrives(wants) if self.law.lossy else wants
        self._learn(wants, arrived)
        known = arrived if self.told else wants
        self.wanted = np.where(known[:, None], packet, self.wanted)
        self.real_wanted = np.where(arrived[:, None], packet, self.real_wanted)
        self.h, self.real = reached(model, self.wanted, self.h), reached(model, self.real_wanted, self.real)
        self.c = self.c @ given.A.T + y @ given.B.T + self.h @ given.E.T + r @ self.follows.B.T
        self.prior = estimate @ self.F.T + self.h @ self.B.T
        return self.pushing(self.real), {self.link: wants.astype(float)}

    def ahead(self, w: Array, u: Array) -> Array:
        """Return what ten steps cost without noise, the first with the input u, and the value of what they reach."""
        assert self.base is not None
        (F, M), given, model = self.base.silent, self.given, self.model
        _, _, c, y, r, _ = np.split(np.eye(len(F)), np.cumsum(self.base.sizes)[:-1])
        K = given.C @ c + given.D @ y + self.follows.D @ r
        w, total = np.hstack([w, u]), 0.0
        for _ in range(10):
            total = total + ((w @ M) * w).sum(axis=1)
            w = w @ F.T
            w[:, -model.m :] = reached(model, w @ K.T, w[:, -model.m :])
        return np.asarray(total + ((w @ self.base.P[0, 0]) * w).sum(axis=1))


class LossyCertainty(Certainty):
    """LQG over a link without acknowledgement: the sender assumes that all packets arrive."""

    sure = False

    def start(self, paths: int, rng: np.random.Generator) -> None:
        """Begin."""
        super().start(paths, rng)
        self.real, self.real_wanted = self.held, self.wanted

    def step(self, k: int, y: Array, r: Array) -> tuple[Array, dict[str, Array]]:
        """Return what the actuator applies."""
        _, flags = super().step(k, y, r)
        arrived = self.channel.arrives(flags[self.link] > 0)
        self.real_wanted = np.where(arrived[:, None], self.wanted, self.real_wanted)
        self.real = reached(self.model, self.real_wanted, self.real)
        return self.real, flags


def loops(tables: Tables, model: Model) -> tuple[Any, Any]:
    """Return the policy of a file, and the same loop with every sample."""
    policy, law = tables["policy"], nodes_of(tables, len(model.C), model.m).laws["actuator"]
    told = law.acknowledged or not law.lossy
    if "controller" not in tables and told is not law.lossy:
        base = Certainty(model, None)
        rule = Rules.excess(policy, base)
        if model.limited and law.lossy:
            delta = policy["theta"] * ((base.nominal if base.exact is None else base.exact) - model.rest)
            rule = lambda loop: quadratic(loop.error, loop.H) > delta  # noqa: E731
        kind = LossyCertainty if law.lossy else Certainty
        return kind(model, rule, law=law), kind(model, None, law=law)
    if not model.limited:
        own, _ = kept_policy(tables, model, nodes_of(tables, len(model.C), model.m))
        every = KeptPolicy.__new__(KeptPolicy)
        vars(every).update(vars(own))
        every.always, every.rule = True, "clock"
        return own, every
    h = model.seconds if model.continuous else float(tables["plant"]["dt"])
    keeps, follows = "controller" in tables, None
    if keeps:
        given = given_of(tables, model, h)
        follows = following(tables, model, given, h)
    else:
        given = observer(model, law=law)
    base = Base(model, given, "actuator", "hold", law if told else Law(), 1, follows)
    band = policy["kind"] == "send-on-delta"
    level = policy["delta"] if band else policy["theta"] * (base.exact - model.rest)
    keys: dict[str, Any] = {"link": "actuator", "silence": "hold", "law": law, "rule": "band" if band else "cost",
                            "told": told, "follows": follows, "level": level, "base": base}  # fmt: skip
    pair = [LimitedKept(model, given, always=always, **keys) for always in (False, True)]
    return pair[0], pair[1]


@dataclass(frozen=True)
class Pair:
    """What the policy costs more than every sample in percent, its rate, their errors, and how often a limit binds."""

    excess: tuple[float, float]
    rate: tuple[float, float]
    at_limit: float
    costs: tuple[float, float]


def paired(tables: Tables, folder: Path, *, seed: int, paths: int, steps: int, settle: int) -> Pair:
    """Simulate the policy of a file beside the loop that sends every sample, on the same random numbers."""
    model = plain.model_of(tables, folder)
    pair = loops(tables, model)
    streams = [np.random.default_rng([seed, i]) for i in range(3)]
    worlds = [plain.World(model, paths, np.zeros((paths, model.n))) for _ in pair]
    for one in pair:
        one.shared = np.random.default_rng([seed, 3])
        one.start(paths, np.random.default_rng([seed, 4]))
    root = plain.root_of(np.zeros((len(model.C),) * 2) if model.V is None else model.V)
    totals, sent, bound = np.zeros((2, paths)), np.zeros(paths), 0.0
    if model.changes.levels is not None:  # whole cycles
        steps = max(steps // len(model.changes.levels), 1) * len(model.changes.levels)
        settle = -(-settle // len(model.changes.levels)) * len(model.changes.levels)
    for k in range(settle + steps):
        v = streams[0].standard_normal((paths, len(root))) @ root
        w, dr = model.noise(streams[1], paths), plain.changed(model, k, paths, streams[2])
        for i, (loop, world) in enumerate(zip(pair, worlds, strict=True)):
            u, packets = loop.step(k, world.measure(v), world.z[:, model.known])
            cost = world.move(u, w, dr)
            if k >= settle:
                totals[i] += cost / steps / model.seconds
                if i == 0:
                    sent += next(iter(packets.values())) / steps
                    u = u[:, : model.m]
                    bound += float(((u <= model.low) | (u >= model.high)).any(axis=1).mean()) / steps
    ratio = plain.excess_of(totals[0], totals[1])
    assert ratio is not None
    rate = plain.mean_of(sent / (model.seconds if model.continuous else 1.0))
    return Pair((100 * ratio[0], 100 * ratio[1]), rate, bound, (float(totals[0].mean()), float(totals[1].mean())))


@dataclass(frozen=True)
class Found:
    """A case: what ``tune`` states, and what the simulation finds."""

    stated: tuple[float, float]
    rate: tuple[float, float]
    pair: Pair
    at_limit: float | None
    parameter: float
    evaluation: Any

    @property
    def z(self) -> float:
        """By how many standard errors the two excesses differ."""
        return abs(self.stated[0] - self.pair.excess[0]) / math.hypot(self.stated[1], self.pair.excess[1])

    @property
    def z_rate(self) -> float:
        """By how many standard errors the two rates differ."""
        return abs(self.rate[0] - self.pair.rate[0]) / max(math.hypot(self.rate[1], self.pair.rate[1]), 1e-12)


def found(
    name: str, *, paths: int = 500, steps: int = 2000, settle: int = 400, seed: int = 1, precision: float = 3e-4
) -> Found:  # fmt: skip
    """Tune a case to 5 % more than every sample, and simulate it.

    Args:
        name: plant, controller and features, such as "tank pid lu".
        paths, steps, settle: of the simulation, of which the first steps do not count.
        seed: of the simulation.
        precision: standard error of the tuned cost, as a share of it.
    """
    tables = drafted(*(name + " ").split(" ")[:3])
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        problem = taciturn.load(write(tables, folder))
        roughly = taciturn.evaluate(problem, steps=20_000, after_step=False).cost.value
        tuned = taciturn.tune(problem, cost="+5%", standard_error=precision * roughly)
        evaluation = tuned.evaluation
        parameter = "delta" if "delta" in tables["policy"] else "theta"
        value = tuned.parameter.value
        own = {**tables, "policy": {**tables["policy"], parameter: value}}
        pair = paired(own, folder, seed=seed, paths=paths, steps=steps, settle=settle)
    assert evaluation.excess is not None
    assert isinstance(value, float)
    excess, (rate,) = evaluation.excess, evaluation.rates.values()
    share: Any = evaluation.document().get("share_at_limit")
    return Found(
        (100 * excess.value, 100 * (excess.standard_error + excess.error)),
        (rate.value, rate.standard_error + rate.error),
        pair,
        None if share is None else share["value"],
        value,
        evaluation,
    )


def row(name: str, one: Found) -> str:
    """Return a line of the table."""
    limit = "" if one.at_limit is None else f"{100 * one.pair.at_limit:.1f}/{100 * one.at_limit:.1f}"
    stated, mine = (f"{value:7.3f} ±{error:6.3f}" for value, error in (one.stated, one.pair.excess))
    rate = f"{one.pair.rate[0]:8.4f} {one.z_rate:5.1f}"
    return f"{name:20s} {one.parameter:9.4g} {rate} {stated} {mine} {one.z:5.1f} {limit}"


def main(names: Sequence[str]) -> None:
    """Print the table of some cases."""
    titles = f"{'stated %':>15s} {'found %':>15s} {'z':>5s} at a limit %"
    print(f"{'case':20s} {'parameter':>9s} {'rate':>8s} {'z':>5s} {titles}")
    for name in names:
        print(row(name, found(name)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:] or CASES)
