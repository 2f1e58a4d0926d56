"""Everything that a problem file can state, as features: a name, and a function that adds it to a drawn problem.

A problem is a seed and a set of names. ``build`` draws a small plant from the seed and adds the features in the order
of the table, each with random numbers of its own: without one of its features a problem keeps the numbers of all
others, which is what shrinking needs. Features of one group exclude each other. A feature that finds nothing to which
it could be added raises ``Elsewhere``; whether the library accepts what was added is the question, not a condition.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any
from zlib import crc32

import numpy as np
from everything.amplitudes import named_signals, names, noise_at
from everything.delays import INPUTS, SAMPLES
from everything.disturbances import bias, disturbance, load, stepping_bias
from everything.draft import STEP, Array, Draft, Elsewhere, Tables, begin, need, rows, unneeded

from taciturn.design.catalogue import CATALOGUE, own_kinds

HORIZON = 12


@dataclass(frozen=True)
class Feature:
    """A feature of problems; at most one of a group is in a problem."""

    name: str
    group: str
    add: Callable[[Draft], None]


def build(names: Collection[str], seed: int) -> Draft:
    """Return the problem of a seed with the named features.

    Raises:
        Elsewhere: a feature has no place in it.
    """
    draft = Draft(np.random.default_rng([seed, 0]), {})
    shape = {name: size for names_of, name, size in SIZES.values() if names_of in names}
    modes = next((name for name in names if name.startswith("modes ")), "modes decaying")
    begin(draft, shape.get("n", 2), shape.get("m", 1), shape.get("p", 1), modes)
    for feature in FEATURES:
        if feature.name in names:
            draft.rng = np.random.default_rng([seed, crc32(feature.name.encode())])
            feature.add(draft)
    order = ("plant", "disturbance", "reference", "cost", "network", "nodes", "links", "controller", "limits", "names",
             "policy")  # fmt: skip
    draft.tables = {name: draft.tables[name] for name in order if name in draft.tables}
    return draft


SIZES = {
    one: (one, *size)
    for one, size in {
        "one state": ("n", 1), "three states": ("n", 3), "two inputs": ("m", 2), "two outputs": ("p", 2),
    }.items()
}  # fmt: skip


# -- the plant


def nothing(draft: Draft) -> None:
    """Add nothing: the plant was drawn with this size, or these modes."""


def measured(draft: Draft) -> None:
    """Measure the state."""
    del draft.plant["C"], draft.plant["V"]


def exact(draft: Draft) -> None:
    """Measure outputs without noise."""
    need(draft, "C")
    del draft.plant["V"]


def correlated(draft: Draft) -> None:
    """Let the noises of states, and of outputs, be correlated."""
    draft.plant["W"] = draft.positive(draft.states, 0.3)
    if "V" in draft.plant:
        draft.plant["V"] = draft.positive(draft.outputs, 0.3)


def singular(draft: Draft) -> None:
    """Let the noise enter in one direction."""
    one = draft.rng.standard_normal(draft.states)
    draft.plant["W"] = np.outer(np.round(one, 2), np.round(one, 2)).round(4).tolist()


def register(draft: Draft) -> None:
    """Let the input act one step late: its register is a state that the cost does not see."""
    extend(draft, np.zeros((draft.inputs, draft.inputs)), act=draft.matrix("B"), B=np.eye(draft.inputs), noise=0.0)


def late_output(draft: Draft) -> None:
    """Measure the outputs one step late: a register of them is measured."""
    need(draft, "C")
    A, B, C = (draft.matrix(name) for name in "ABC")
    n, p = draft.states, len(C)
    plant = draft.plant
    plant["A"] = np.block([[A, np.zeros((n, p))], [C, np.zeros((p, p))]]).tolist()
    plant["B"] = np.vstack([B, np.zeros((p, draft.inputs))]).tolist()
    plant["C"] = np.hstack([np.zeros((p, n)), np.eye(p)]).tolist()
    plant["W"] = np.block([[draft.matrix("W"), np.zeros((n, p))], [np.zeros((p, n)), np.zeros((p, p))]]).tolist()
    hide(draft, p)


def unseen(draft: Draft) -> None:
    """Add a state that moves by itself, is measured, and costs nothing."""
    extend(
        draft, np.array([[0.7]]), act=np.zeros((draft.states, 1)), B=np.zeros((1, draft.inputs)), noise=0.1, seen=1.0
    )


def counter(draft: Draft) -> None:
    """Add an integral of the first state, which costs nothing and is not measured."""
    n, plant = draft.states, draft.plant
    A = np.block([[draft.matrix("A"), np.zeros((n, 1))], [np.eye(n)[:1], np.eye(1)]])
    plant["A"] = A.tolist()
    plant["B"] = [*plant["B"], [0.0] * draft.inputs]
    if "C" in plant:
        plant["C"] = [[*row, 0.0] for row in plant["C"]]
    plant["W"] = np.block([[draft.matrix("W"), np.zeros((n, 1))], [np.zeros((1, n + 1))]]).tolist()
    hide(draft, 1)


def extend(draft: Draft, own: Array, act: Array, B: Array, noise: float, seen: float = 0.0) -> None:
    """Add states x₂⁺ = own x₂ + B u + w₂ that act on the others, which then have no input if the new ones do."""
    n, k, plant = draft.states, len(own), draft.plant
    acted = draft.matrix("B") if not B.any() else np.zeros((n, draft.inputs))
    plant["A"] = np.block([[draft.matrix("A"), act], [np.zeros((k, n)), own]]).tolist()
    plant["B"] = np.vstack([acted, B]).tolist()
    if "C" in plant:
        plant["C"] = np.hstack([draft.matrix("C"), seen * np.ones((draft.outputs, k))]).tolist()
    W = np.zeros((n + k, n + k))
    W[:n, :n], W[n:, n:] = draft.matrix("W"), noise * np.eye(k)
    plant["W"] = W.tolist()
    hide(draft, k)


def hide(draft: Draft, count: int) -> None:
    """Let the cost not see the last states."""
    n = draft.states
    draft.unseen += count
    draft.tables["cost"]["Q"] = rows(np.diag([1.0] * (n - draft.unseen) + [0.0] * draft.unseen))


def feedthrough(draft: Draft) -> None:
    """Let the outputs show the inputs of the step before."""
    need(draft, "C")
    draft.plant["D"] = rows(0.4 * draft.rng.standard_normal((draft.outputs, draft.inputs)))


def continuous(draft: Draft) -> None:
    """Make the plant continuous in time, with about the same plant in a step."""
    plant, n = draft.plant, draft.states
    plant["A"] = rows((draft.matrix("A") - np.eye(n)) / STEP)
    plant["B"], plant["W"] = rows(draft.matrix("B") / STEP), rows(draft.matrix("W") / STEP)
    del plant["dt"]


def half_second(draft: Draft) -> None:
    """Let a step of the discrete plant take half a second."""
    draft.plant["dt"] = 0.5


def jumps(law: str) -> Callable[[Draft], None]:
    """Disturb a continuous plant by Poisson jumps."""

    def add(draft: Draft) -> None:
        if not draft.continuous:
            raise Elsewhere
        W = draft.matrix("W")
        del draft.plant["W"]
        draft.plant["jumps"] = {"rate": 4.0, "covariance": rows(W / 4.0), "distribution": law}

    return add


def initial(draft: Draft) -> None:
    """Start elsewhere, with an uncertain state."""
    draft.plant["initial"] = {
        "mean": rows(2 * draft.rng.standard_normal(draft.states)),
        "covariance": draft.positive(draft.states),
    }


def operating_point(draft: Draft) -> None:
    """Count states and inputs from a point at which the plant rests."""
    plant = draft.plant
    x, u = rows(3 + draft.rng.standard_normal(draft.states)), rows(1 + draft.rng.standard_normal(draft.inputs))
    plant["operating_point"] = {"x": x, "u": u}
    if "initial" in plant:
        plant["initial"]["mean"] = rows(np.array(plant["initial"]["mean"]) + x)


def actual(draft: Draft) -> None:
    """Simulate a plant that differs a little from that of the design."""
    plant = draft.plant
    kept = {key: value for key, value in plant.items() if key not in ("initial", "operating_point")}
    plant["actual"] = {**kept, "A": rows(draft.matrix("A") * 0.97), "B": rows(draft.matrix("B") * 1.05)}


def another_feedthrough(draft: Draft) -> None:
    """Simulate a plant whose outputs show the inputs otherwise than those of the design."""
    need(draft, "C", "actual")
    feed = 0.2 * draft.rng.standard_normal((draft.outputs, draft.inputs))
    draft.plant["actual"]["D"] = rows(feed + (draft.matrix("D") if "D" in draft.plant else 0.0))


def function(bent: float) -> Callable[[Draft], None]:
    """State the plant by a function, which is linear or bent; at an operating point it rests there."""

    def add(draft: Draft) -> None:
        if draft.continuous or "actual" in draft.plant:
            raise Elsewhere
        point = draft.plant.get("operating_point", {"x": [0.0] * draft.states, "u": [0.0] * draft.inputs})
        draft.files["plant.py"] = (
            "import numpy as np\n\n"
            f"A = np.array({draft.plant['A']})\nB = np.array({draft.plant['B']})\n"
            f"X = np.array({point['x']})\nU = np.array({point['u']})\n\n\n"
            "def step(x, u, w):\n"
            f"    bent = {bent} * (np.sin(x[0] - X[0]) - (x[0] - X[0]))\n"
            "    moved = X + A @ (x - X) + B @ (u - U) + w\n"
            "    return np.array([moved[0] + bent, *moved[1:]])\n"
        )
        draft.plant["function"] = "plant.py:step"

    return add


def limited(sides: Callable[[float, float], Any]) -> Callable[[Draft], None]:
    """Limit the inputs."""

    def add(draft: Draft) -> None:
        at = draft.plant.get("operating_point", {}).get("u", [0.0] * draft.inputs)
        draft.plant["input_limit"] = [sides(float(np.round(u, 2)), 1.5) for u in at]

    return add


def slowed(draft: Draft) -> None:
    """Limit how fast inputs change."""
    draft.plant["input_rate"] = [(0.8 if not draft.continuous else 0.8 / STEP)] * draft.inputs


# -- disturbances and set-points


def follow(draft: Draft) -> Tables:
    """Return the table of the set-points, made if it is missing."""
    if "states" in draft.tables.get("reference", {}):
        raise Elsewhere
    return draft.table("reference")


def rest(draft: Draft) -> Array:
    """Return the outputs at the operating point."""
    need(draft, "C")
    point = draft.plant.get("operating_point", {"x": [0.0] * draft.states, "u": [0.0] * draft.inputs})
    direct = draft.matrix("D") @ np.array(point["u"]) if "D" in draft.plant else 0.0
    return draft.matrix("C") @ np.array(point["x"]) + direct


def set_point(draft: Draft) -> None:
    """Keep the measured outputs at set-points."""
    follow(draft)["value"] = rows(rest(draft) + draft.rng.standard_normal(draft.outputs))


def own_outputs(draft: Draft) -> None:
    """Keep another sum of the states at its set-point."""
    table = follow(draft)
    if table.get("value"):
        table["value"] = [1.0]
    table["outputs"] = [rows(draft.rng.standard_normal(draft.states))]


def operator(draft: Draft) -> None:
    """Let an operator change set-points at random times."""
    table = follow(draft)
    count = len(table["outputs"]) if "outputs" in table else draft.outputs
    table["steps"] = {"rate": 0.05 if not draft.continuous else 0.05 / STEP, "covariance": rows(np.eye(count))}


def timetable(draft: Draft) -> None:
    """Read set-points from a file."""
    table = follow(draft)
    if "steps" in table or "value" in table:
        raise Elsewhere
    pace, count = (STEP if draft.continuous else 1.0), len(table.get("outputs", draft.plant.get("C", [])))
    if not count:
        raise Elsewhere
    middle = rest(draft)[:count] if "outputs" not in table else np.zeros(count)
    levels = [middle, middle + 1, middle - 1, middle]
    lines = [[pace * time, *level] for time, level in zip((0, 20, 35, 60), levels, strict=True)]
    draft.files["levels.csv"] = "\n".join(",".join(f"{one:.6g}" for one in line) for line in lines) + "\n"
    table["file"] = "levels.csv"


def limited_set_points(draft: Draft) -> None:
    """Limit the set-points of an operator to a range and a ramp; those at random times leave every range."""
    table = follow(draft)
    count = len(table["outputs"]) if "outputs" in table else draft.outputs
    table["ramp"] = [0.2 if not draft.continuous else 0.2 / STEP] * count
    if "steps" not in table:
        table["range"] = [[-1e3, 1e3]] * count


def integral_action(draft: Draft) -> None:
    """Ask for integral action of the outputs of the sensors."""
    names = [name for name, role in draft.tables.get("nodes", {}).items() if "measures" in role] or ["sensor"]
    follow(draft)["integral_action"] = names[:1]


def trajectory(draft: Draft) -> None:
    """Follow a trajectory over a horizon."""
    unneeded(draft, "reference")
    if draft.continuous or "horizon" not in draft.tables["cost"]:
        raise Elsewhere
    A, B = draft.matrix("A"), draft.matrix("B")
    point = draft.plant.get("operating_point", {"x": [0.0] * draft.states, "u": [0.0] * draft.inputs})
    u = 0.5 * draft.rng.standard_normal((HORIZON, draft.inputs)).round(2)
    x = np.zeros((HORIZON + 1, draft.states))
    for k in range(HORIZON):
        x[k + 1] = A @ x[k] + B @ u[k]
    draft.tables["reference"] = {"states": (x + point["x"]).tolist(), "inputs": (u + point["u"]).tolist()}


# -- the cost


def weights(draft: Draft) -> None:
    """Draw weights of all seen states and inputs."""
    seen = draft.states - draft.unseen
    Q = np.zeros((draft.states, draft.states))
    Q[:seen, :seen] = draft.positive(seen)
    draft.tables["cost"] |= {"Q": Q.tolist(), "R": draft.positive(draft.inputs)}


def cross(draft: Draft) -> None:
    """Weigh products of states and inputs."""
    N = np.zeros((draft.states, draft.inputs))
    N[0] = 0.2
    draft.tables["cost"]["N"] = N.tolist()


def free(draft: Draft) -> None:
    """Let inputs cost nothing by themselves: only what they move does."""
    cost = draft.tables["cost"]
    if "R" not in cost or "N" in cost:
        raise Elsewhere
    cost["R"] = rows(np.zeros((draft.inputs, draft.inputs)))


def low_rank(draft: Draft) -> None:
    """Let only one combination of inputs cost something by itself, also together with the first state."""
    cost, r = draft.tables["cost"], np.round(draft.rng.standard_normal(draft.inputs), 2)
    if "R" not in cost or draft.inputs == 1:
        raise Elsewhere
    cost["R"] = rows(np.outer(r, r))
    if "N" in cost:
        cost["N"] = rows(0.2 * np.outer(np.eye(draft.states)[0], r))


def horizon(draft: Draft) -> None:
    """Let the cost be a total over a few steps."""
    draft.tables["cost"]["horizon"] = HORIZON


def terminal(draft: Draft) -> None:
    """Weigh the last state more."""
    if "horizon" not in draft.tables["cost"]:
        raise Elsewhere
    draft.tables["cost"]["terminal"] = rows(5 * np.array(draft.tables["cost"]["Q"]))


def discount(draft: Draft) -> None:
    """Let the cost be a discounted sum."""
    draft.tables["cost"]["discount"] = 0.85


def variances(draft: Draft) -> None:
    """State the weights by variances."""
    need(draft, "C")
    cost = draft.tables["cost"]
    if "N" in cost:
        raise Elsewhere
    del cost["Q"], cost["R"]
    cost["output_variance"], cost["input_variance"] = [0.5] * draft.outputs, [2.0] * draft.inputs


def as_the_controller(draft: Draft) -> None:
    """Take the weights from the loop of the given controller."""
    cost = draft.tables["cost"]
    if "controller" not in draft.tables or "N" in cost or "Q" not in cost:
        raise Elsewhere
    del cost["Q"], cost["R"]
    cost["weights"] = "as the controller"


# -- the network


BURST = {"to_bad": 0.1, "to_good": 0.4, "loss_good": 0.02, "loss_bad": 0.6}
CHAIN = {"law": "chain", "drops": [0.8, 0.0, 0.1], "moves": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.0]]}


def triangle(**keys: object) -> Callable[[Draft], None]:
    """State keys of [network]."""

    def add(draft: Draft) -> None:
        unneeded(draft, "nodes", "links")
        draft.table("network").update(keys)

    return add


def whole_numbers(draft: Draft) -> None:
    """Let packets hold 16-bit numbers, with the range of each link on which the kind sends."""
    unneeded(draft, "nodes", "links")
    found = {f"{link}_range": 50.0 for link in links_of(draft)}
    draft.table("network").update({"payload": "int16", **found})


def links_of(draft: Draft) -> list[str]:
    """Return the links of [network] on which the kind of the draft sends."""
    policy = draft.policy
    kind, where = policy["kind"], policy.get("controller", "remote")
    if kind in ("distributed", "lossy-lqg") or (kind == "remote-lqg" and where == "remote"):
        return ["sensor", "actuator"]
    state = draft.continuous and "C" not in draft.plant
    predicts = kind in ("consistent", "integral", "optimal") or (state and kind == "near-optimal")
    sensed = kind in ("variance", "event-pid", "event-pid-saturated", "symmetric-send-on-delta")
    own = policy.get("link", "sensor" if kind == "send-on-delta" else "actuator")
    return ["sensor" if predicts or sensed or own == "sensor" or where == "actuator" else "actuator"]


def energy(draft: Draft) -> None:
    """State the energy of a packet, and a battery."""
    unneeded(draft, "nodes", "links")
    for link in links_of(draft)[-1:]:
        draft.table("network").update({f"{link}_energy": 0.002, f"{link}_battery": 5000.0})


def nodes(sensors: int, actuators: int, wired: str = "") -> Callable[[Draft], None]:
    """Name the nodes of a network: so many sensors and actuators, of which the wired ones are at the controller."""

    def add(draft: Draft) -> None:
        unneeded(draft, "network")
        if draft.outputs < sensors or draft.inputs < actuators:
            raise Elsewhere
        found: Tables = {}
        for i in range(sensors):
            rest = list(range(i, draft.outputs)) if i == sensors - 1 else [i]
            found[f"probe-{i + 1}"] = {"measures": rest}
        found["plc"] = {"controls": True}
        for i in range(actuators):
            rest = list(range(i, draft.inputs)) if i == actuators - 1 else [i]
            found[f"valve-{i + 1}"] = {"applies": rest}
        for name in found:
            if wired and name.startswith(wired):
                found[name]["site"] = "plc"
        draft.tables["nodes"] = found

    return add


def links(where: str, **law: object) -> Callable[[Draft], None]:
    """State the law of the links whose names begin so; of all links that exist if it is empty."""

    def add(draft: Draft) -> None:
        if "nodes" not in draft.tables:
            raise Elsewhere
        free = [name for name, role in draft.tables["nodes"].items() if "site" not in role and "controls" not in role]
        found = [name for name in free if name.startswith(where)]
        if not found:
            raise Elsewhere
        for name in found:
            draft.table("links").setdefault(name, {}).update(law)

    return add


def missing(draft: Draft, law: object) -> None:
    """Let samples be missing: of the sensor, or of the first node that measures, whatever its place."""
    unneeded(draft, "network")
    nodes = draft.tables.get("nodes", {"sensor": {"measures": True}})
    name = next(name for name, role in nodes.items() if role.get("measures"))
    draft.table("links").setdefault(name, {})["missing"] = law


def intervals(**law: int) -> Callable[[Draft], None]:
    """Limit the intervals of the links on which the kind sends, whatever the network is called."""

    def add(draft: Draft) -> None:
        if "nodes" in draft.tables:
            return links("", **law)(draft)
        unneeded(draft, "network")
        for link in links_of(draft):
            draft.table("links").setdefault(link, {}).update(law)
        return None

    return add


# -- a controller to keep


def pid(**keys: object) -> Callable[[Draft], None]:
    """Keep a PID controller, one for each input."""

    def add(draft: Draft) -> None:
        need(draft, "C")
        sign = float(np.sign(gain(draft)) or 1.0)
        own = {"kp": round(0.25 * sign, 3), "ki": round(0.03 * sign, 3), **keys}
        if "kd" in own:
            own["kd"] = round(float(own["kd"]) * sign, 3)
        many = [{**own, "input": i + 1, "output": min(i, draft.outputs - 1) + 1} for i in range(draft.inputs)]
        draft.tables["controller"] = {"pid": own if draft.inputs == draft.outputs == 1 else many}

    return add


def gain(draft: Draft) -> float:
    """Return the response of the first output to the first input after a few steps: its sign is that of feedback."""
    A, B, C = draft.matrix("A"), draft.matrix("B"), draft.matrix("C")
    if draft.continuous:
        A, B = np.eye(len(A)) + STEP * A, STEP * B
    x, total = B[:, 0], 0.0
    for _ in range(12):
        total, x = total + float(C[0] @ x), A @ x
    return total


def in_pid(**keys: object) -> Callable[[Draft], None]:
    """Add keys to the PID controllers."""

    def add(draft: Draft) -> None:
        found = draft.tables.get("controller", {}).get("pid")
        if found is None:
            raise Elsewhere
        for one in found if isinstance(found, list) else [found]:
            one.update(keys)

    return add


def raised(draft: Draft) -> None:
    """Give the controller a set-point."""
    table = draft.tables.get("controller")
    if table is None:
        raise Elsewhere
    values = rows(rest(draft) + 1.0)
    if "pid" not in table:
        table["setpoint"] = values
        return
    for one in table["pid"] if isinstance(table["pid"], list) else [table["pid"]]:
        one["setpoint"] = values[one.get("output", 1) - 1]


def linear(dynamic: bool, told: bool = False, positive: bool = False) -> Callable[[Draft], None]:
    """Keep a linear controller: a gain, or a slow filter of the outputs with a gain."""

    def add(draft: Draft) -> None:
        need(draft, "C")
        sign = float(np.sign(gain(draft)) or 1.0) * (-1.0 if positive else 1.0)
        D = np.zeros((draft.inputs, draft.outputs))
        D[0, 0] = 0.2 * sign
        found: Tables = {"D": rows(D)}
        if dynamic:
            found |= {"A": [[0.6]], "B": [[0.4] + [0.0] * (draft.outputs - 1)], "C": rows(D[:, :1])}
        if told:
            found["E"] = [[0.1] + [0.0] * (draft.inputs - 1)]
        if positive:
            found["sign"] = "positive"
        draft.tables["controller"] = found

    return add


def per_second(draft: Draft) -> None:
    """State the controller in continuous time."""
    table = draft.tables.get("controller", {})
    if "A" not in table or "E" in table:
        raise Elsewhere
    table |= {"A": [[-2.0]], "B": [[2.0] + [0.0] * (draft.outputs - 1)], "method": "tustin"}


def inputs_for_set_points(draft: Draft) -> None:
    """Give a controller that integrates inputs for the set-point of its output."""
    table = draft.tables.get("controller", {})
    if not table.get("A") or "method" in table or "E" in table or "reference" not in draft.tables:
        raise Elsewhere
    if len(follow(draft).get("outputs", draft.plant["C"])) > 1:
        raise Elsewhere
    B = 0.2 * np.atleast_2d(table["B"])  # the integral of the output minus its set-point
    G = 0.1 * draft.rng.standard_normal((draft.inputs, 1))
    table |= {"A": [[1.0]], "B": rows(B), "F": rows(-B[:, :1]), "G": rows(G)}


def in_controller(**keys: object) -> Callable[[Draft], None]:
    """Add keys to [controller]."""

    def add(draft: Draft) -> None:
        if "controller" not in draft.tables:
            raise Elsewhere
        draft.tables["controller"].update(keys)

    return add


# -- limits of states


def state_limits(draft: Draft) -> None:
    """Ask for the probability that the first output exceeds a limit."""
    high = float(rest(draft)[0]) + 3.0 if "C" in draft.plant else 3.0
    found: Tables = {"high": [round(high, 3)], "outputs": [draft.plant["C"][0] if "C" in draft.plant else
                                                           [1.0] + [0.0] * (draft.states - 1)]}  # fmt: skip
    draft.tables["limits"] = found


# -- kinds and their options


USUAL: Mapping[str, Mapping[str, Any]] = {
    "absolute": {"threshold": 0.8},
    "all-time": {},
    "consistent": {},
    "distributed": {"theta": 0.5},
    "downsampled": {"fast": 1, "slow": 3, "threshold": 0.8},
    "dynamic": {"sigma": 0.2, "rho": 0.8, "gain": 2.0},
    "event-pid": {"delta": 0.3},
    "event-pid-saturated": {"delta": 0.3},
    "excess": {"theta": 0.3},
    "integral": {"slope": 0.5, "alpha": 0.2, "h_max": 2.0},
    "lossy-lqg": {"price": 0.3},
    "lqg": {"theta": 0.3},
    "mixed": {"sigma": 0.2, "threshold": 0.3},
    "near-optimal": {"price": 0.5},
    "optimal": {"price": 0.5},
    "periodic": {"every": 3},
    "periodic-schedule": {"length": 4, "sends": 2},
    "relative": {"sigma": 0.2},
    "remote-lqg": {"theta": 0.3, "zeta": 0.3},
    "rollout": {"horizon": 4, "every": 2},
    "self-triggered": {"beta": 1.3, "max_interval": 5},
    "send-on-delta": {"delta": 0.5},
    "stochastic": {"scale": 1.0},
    "symmetric-send-on-delta": {"delta": 0.3},
    "variance": {"threshold": 0.3},
}
"""Parameters of moderate size for the plants that are drawn; a kind without an entry has those of its record."""


def kind(name: str) -> Callable[[Draft], None]:
    """Let the policy be of a kind."""

    def add(draft: Draft) -> None:
        draft.tables["policy"] = {"kind": name, **USUAL.get(name, CATALOGUE[name].example)}
        draft.policy.pop("period", None)
        if draft.continuous:
            draft.policy["period"] = STEP

    return add


def option(**keys: object) -> Callable[[Draft], None]:
    """Set a parameter of the kind; None removes one."""

    def add(draft: Draft) -> None:
        known = CATALOGUE[draft.policy["kind"]].parameters
        if not any(key in known for key in keys):
            raise Elsewhere
        for key, value in keys.items():
            if value is None:
                draft.policy.pop(key, None)
            elif key in known:
                draft.policy[key] = value

    return add


def share_of_bank(draft: Draft) -> None:
    """State the share of the stage cost that a relative bank saves, in place of the threshold."""
    if "kappa" not in CATALOGUE[draft.policy["kind"]].parameters:
        raise Elsewhere
    draft.policy.pop("theta", None)
    draft.policy["kappa"] = 0.2


def shares(draft: Draft) -> None:
    """Divide the threshold unequally among links."""
    if "shares" not in CATALOGUE[draft.policy["kind"]].parameters or "nodes" not in draft.tables:
        raise Elsewhere
    free = [name for name, role in draft.tables["nodes"].items() if "site" not in role and "controls" not in role]
    if not free:
        raise Elsewhere
    draft.policy["shares"] = {free[0]: 2.0}


def descriptor(draft: Draft) -> None:
    """State the equation of the plants times a regular matrix, which the noise and the disturbances are part of."""
    n = draft.states
    if "function" in draft.plant or draft.plant.get("jumps", {}).get("distribution", "normal") != "normal":
        raise Elsewhere
    E = np.eye(n) + np.tril(draft.rng.integers(-2, 3, (n, n)) / 4, -1)
    E = E[draft.rng.permutation(n)] * draft.rng.choice([0.25, 1.0, 8.0], n)
    for plant in (draft.plant, draft.plant["actual"]) if "actual" in draft.plant else (draft.plant,):
        plant["E"] = E.tolist()
        plant |= {key: (E @ np.array(plant[key])).tolist() for key in "AB"}
        for table, key in ((plant, "W"), (plant.get("jumps", {}), "covariance")):
            if key in table:
                table[key] = (E @ np.array(table[key]) @ E.T).tolist()
    for entry in draft.tables.get("disturbance", []):
        entry["enters"] = (E @ np.array(entry["enters"])).tolist()


def features() -> list[Feature]:
    """Return all features in the order in which they are added: sizes first, and options after kinds."""
    kinds = [Feature(f"kind {name}", "kind", kind(name)) for name in own_kinds()]
    plants = {
        "one state": ("states", nothing),
        "three states": ("states", nothing),
        "two inputs": ("inputs", nothing),
        "two outputs": ("outputs", nothing),
        "modes unstable": ("modes", nothing),
        "modes integrating": ("modes", nothing),
        "modes swinging": ("modes", nothing),
        "modes slow": ("modes", nothing),
        "correlated noise": ("noise", correlated),
        "noise in one direction": ("noise", singular),
        "register of the input": ("register", register),
        "register of the output": ("late output", late_output),
        "unseen state": ("unseen", unseen),
        "unseen integral": ("counter", counter),
        "measured state": ("measured", measured),
        "exact outputs": ("measured", exact),
        "feedthrough": ("feedthrough", feedthrough),
        "continuous": ("time", continuous),
        "half a second": ("time", half_second),
        "normal jumps": ("jumps", jumps("normal")),
        "uniform jumps": ("jumps", jumps("uniform")),
        "two-point jumps": ("jumps", jumps("two-point")),
        "start": ("start", initial),
        "operating point": ("point", operating_point),
        "another plant": ("actual", actual),
        "another feedthrough": ("other feedthrough", another_feedthrough),
        "linear function": ("function", function(0.0)),
        "bent function": ("function", function(0.3)),
        "limited input": ("limit", limited(lambda u, size: size if u == 0 else [u - size, u + size])),
        "one-sided limit": ("limit", limited(lambda u, size: [u - size, float("inf")])),
        "limited rate": ("rate", slowed),
    }
    signals = {
        "constant disturbance": ("disturbance", disturbance("constant")),
        "load": ("load", load({"wander": 0.0})),
        "load from a file": ("load", load({"wander": 0.0}, True)),
        "known load": ("load", load({"known": True})),
        "ramp": ("disturbance", disturbance("ramp")),
        "sinusoid": ("disturbance", disturbance("sinusoid")),
        "disturbance by a matrix": ("disturbance", disturbance("matrix")),
        "biased sensor": ("bias", bias),
        "bias that steps": ("bias", stepping_bias),
    }
    networks = {
        "one sensor by name": ("nodes", nodes(1, 1)),
        "wired sensor": ("nodes", nodes(1, 1, "probe")),
        "wired actuator": ("nodes", nodes(1, 1, "valve")),
        "two sensors": ("nodes", nodes(2, 1)),
        "two actuators": ("nodes", nodes(1, 2)),
        "two wired sensors": ("nodes", nodes(2, 1, "probe")),
        "actuators of a wired sensor": ("nodes", nodes(1, 2, "probe")),
        "four nodes": ("nodes", nodes(2, 2)),
    }
    points = {
        "set-point": ("set-point", set_point),
        "own outputs": ("outputs to follow", own_outputs),
        "operator": ("changes", operator),
        "timetable": ("changes", timetable),
        "limited set-points": ("set-point limits", limited_set_points),
        "integral action": ("integral", integral_action),
    }
    costs = {
        "drawn weights": ("weights", weights),
        "cross terms": ("cross", cross),
        "inputs without cost": ("free", free),
        "some inputs without cost": ("free", low_rank),
        "horizon": ("total", horizon),
        "discount": ("total", discount),
        "terminal weight": ("terminal", terminal),
        "trajectory": ("trajectory", trajectory),
        "variances": ("weights", variances),
    }
    controllers = {
        "proportional and integral": ("controller", pid()),
        "PID": ("controller", pid(kd=0.2, filter=2.0)),
        "proportional": ("controller", pid(ki=0.0)),
        "gain": ("controller", linear(dynamic=False)),
        "linear controller": ("controller", linear(dynamic=True)),
        "linear controller that is told": ("controller", linear(dynamic=True, told=True)),
        "positive sign": ("controller", linear(dynamic=True, positive=True)),
        "controller per second": ("method", per_second),
        "controller's set-point": ("raised", raised),
        "inputs for set-points": ("set-point inputs", inputs_for_set_points),
        "weights of the set-point": ("weights of r", in_pid(b=0.5, c=0.2)),
        "tracking time": ("tracking", in_pid(tracking_time=5.0)),
        "start input": ("start input", in_pid(start_input=0.5)),
        "no drift": ("drift", in_controller(disturbance="none")),
        "stated drift": ("drift", in_controller(disturbance={"time_constant": 50.0, "deviation": 0.2})),
        "weights as the controller": ("weights", as_the_controller),
    }
    laws = {
        "losses": ("losses", triangle(protocol="udp", actuator_loss=0.15, sensor_loss=0.2)),
        "acknowledged losses": ("losses", triangle(protocol="tcp", actuator_loss=0.15)),
        "acknowledged losses of sensors": ("losses", triangle(protocol="tcp", sensor_loss=0.2)),
        "bursts": ("losses", triangle(protocol="tcp", actuator_burst=BURST)),
        "bursts by a chain": ("losses", triangle(protocol="tcp", actuator_burst=CHAIN)),
        "bursts without acknowledgement": ("losses", triangle(protocol="udp", actuator_burst=BURST)),
        "delay": ("delay", triangle(delay=1)),
        "single numbers": ("payload", triangle(payload="float32")),
        "whole numbers": ("payload", whole_numbers),
        "energy": ("energy", energy),
        "lossy probes": ("lossy probes", links("probe", loss=0.2, acknowledged=True)),
        "lossy valves": ("lossy valves", links("valve", loss=0.2, acknowledged=True)),
        "unacknowledged": ("lossy probes", links("", loss=0.15)),
        "bursty valves": ("lossy valves", links("valve", burst=BURST, acknowledged=True)),
        "missing samples": ("missing", partial(missing, law=0.1)),
        "missing samples in bursts": ("missing", partial(missing, law=BURST)),
        **{name: ("late samples", add) for name, add in SAMPLES.items()},
        **{name: ("late inputs", add) for name, add in INPUTS.items()},
        "prices": ("prices", links("valve", price=3.0)),
        "rounded probes": ("rounded", links("probe", payload="float32")),
        "energy of probes": ("joules", links("probe", energy=0.01, battery=1000.0)),
        "pauses": ("intervals", intervals(min_interval=2)),
        "heartbeats": ("intervals", intervals(max_interval=4)),
        "pauses and heartbeats": ("intervals", intervals(min_interval=2, max_interval=5)),
    }
    options = {
        "model": ("actuation", option(actuation="model")),
        "zero": ("actuation", option(actuation="zero")),
        "predicted probes": ("prediction", option(prediction="model")),
        "joint": ("joint", option(joint=True)),
        "each link for itself": ("joint", option(joint=False)),
        "every path": ("guarantee", option(guarantee="every path")),
        "bank": ("rule", option(rule="bank")),
        "relative bank": ("rule", option(rule="relative")),
        "relative bank of a share": ("rule", share_of_bank),
        "threshold of silence": ("rule", option(rule="threshold")),
        "spending": ("spend", option(spend=0.4)),
        "range of gains": ("range", option(gain_range=[0.8, 1.2])),
        "shares": ("shares", shares),
        "sensor decides": ("link", option(link="sensor")),
        "actuator link": ("link", option(link="actuator")),
        "slower base": ("every", option(every=2)),
        "gains for losses": ("gains", option(gains="loss-optimal")),
        "retry": ("retry", option(retry=True)),
        "plan": ("plan", option(plan=2)),
        "separate trigger": ("trigger", option(trigger="separate")),
        "error of the state": ("error", option(error="state")),
        "threshold itself": ("threshold", option(delta=0.2, theta=None)),
        "no threshold": ("threshold", option(theta=0.0)),
        "a cycle": ("every", option(every=[2, 3])),
        "controller at the actuator": ("place", option(controller="actuator", theta=None)),
        "controller at the sensor": ("place", option(controller="sensor", zeta=None)),
        "longest silence": ("longest", option(longest=6.0)),
        "violations": ("violations", state_limits),
        "names": ("names", names),
        "named signals": ("names", named_signals),
        "descriptor": ("descriptor", descriptor),
        "noise at the inputs": ("amplitudes", noise_at("input")),
        "noise at the outputs": ("amplitudes", noise_at("output")),
        "noise at inputs and outputs": ("amplitudes", noise_at("input", "output")),
    }
    ordered = [plants, signals, networks, points, costs, controllers]
    found = [Feature(name, group, add) for table in ordered for name, (group, add) in table.items()]
    later = [Feature(name, group, add) for table in (laws, options) for name, (group, add) in table.items()]
    return [*found, *kinds, *later]


FEATURES = features()


@cache
def by_name() -> Mapping[str, Feature]:
    """Return the features by their names."""
    return {one.name: one for one in FEATURES}
