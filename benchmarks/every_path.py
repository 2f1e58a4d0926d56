"""PID controllers on two nodes with a bound on every path: packets and cost, a night's load, and what a node takes.

    python benchmarks/every_path.py [--json docs/every_path.json]

Sensor and actuator have a link each, and the controller is between them.

* **Published controllers**: those of ``published_pids.py``. At several shares θ, the bank's promise, the certificate of
  the nodes and the cost; and at the cost of every sample plus five percent, the least traffic of the bank and of its
  rivals, with tuned shares of both links. Periodic control is the same controller at fixed steps, at its best timing
  found; it holds or predicts.
* **Loads**: a tank with loads that no model contains, over nights of eight hours. A relative bank, and a bank and dead
  bands that are designed for the quiet tank, run on the same noise and load as the loop with every sample.
* **Devices**: instructions, code and memory of the tank's nodes on emulated Cortex-M boards.

The script keeps the rows of an existing file, and computes the missing ones.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
from devices import DEVICES, tools
from published_pids import ACCURACY, CASES, MORE

import taciturn
from taciturn import PID, ContinuousPlant, Cost, Disturbance, Network, Plant, Policy, Problem
from taciturn._arrays import Array
from taciturn._files import write_whole
from taciturn.base.given_controller import cost_as_now
from taciturn.model.network import NodeRole
from taciturn.program.machine import Kernel
from taciturn.program.ops import Entry, Sent, Silence
from taciturn.study.evaluation import Evaluation
from taciturn_bench.bench import describe_machine
from taciturn_boards.cortex import count_instructions
from taciturn_export.folder import print_folder, record_loop
from taciturn_export.sizes import measure_sizes
from taciturn_studies.periodic_links import LinkClocks, clocks_or_reason

THETAS = (0.1, 0.5, 1.0, 2.0)
NODES = {"level": NodeRole(measures=True), "plc": NodeRole(controls=True), "valve": NodeRole(applies=True)}
MODEL = {"prediction": "model", "actuation": "model"}
RIVALS: dict[str, dict[str, Any]] = {
    "bank, hold": {},
    "bank, model in the valve": {"actuation": "model"},
    "threshold, hold": {"rule": "threshold"},
    "threshold, model in the valve": {"rule": "threshold", "actuation": "model"},
    "send-on-delta": {"kind": "send-on-delta", "theta": None, "delta": 0.3},
}
STEP = 0.1  # seconds
KAPPA = 0.1  # of each of the two nodes
NIGHT, NIGHTS = 8 * 36_000, 8  # steps and number of nights, each with noise of its own
DEVICE_TICKS = 2000
HALVINGS = 12  # in the search for a traffic


def on_two_nodes(case: str, theta: float) -> Problem:
    """Return a published controller on two nodes, with weights for which the loop's present variances count equally.

    Output and input are in units of their present deviations, so that dead bands begin in a ratio that makes sense.
    """
    plant, pid, period = CASES[case]()
    cost = cost_as_now(plant, pid, period)
    u = 1 / sqrt(cost.R.item())
    seen = np.linalg.pinv(plant.C)
    y = 1 / sqrt((seen.T @ cost.Q @ seen).item())
    scaled = ContinuousPlant(plant.A, plant.B * u, plant.W, C=plant.C / y, V=plant.V / y**2)
    gain = y / u
    own = replace(pid, kp=pid.kp * gain, ki=pid.ki * gain, kd=pid.kd * gain)
    weights = Cost(cost.Q, [[1.0]])
    parameters = {"theta": theta, "period": period}
    return Problem(scaled, weights, Network(nodes=NODES), "distributed", parameters, controller=own)


def row_of(problem: Problem, found: Evaluation, always: float) -> dict[str, Any]:
    """Return rates and costs; costs are relative to that of every sample."""
    policy, certificate, traffic = problem.design(), found.certificate, found.traffic
    assert isinstance(policy, Policy)
    assert traffic is not None
    return {
        "rates": {link: [rate.value, rate.standard_error] for link, rate in found.rates.items()},
        "traffic": [traffic.value, traffic.standard_error],
        "cost": [found.cost.value / always, found.cost.standard_error / always],
        "promise": policy.guarantee.cost / always if policy.guarantee else None,
        "certificate": [certificate.value / always, certificate.standard_error / always] if certificate else None,
    }


def at_theta(case: str, theta: float) -> dict[str, Any]:
    """Return what the bank does at a share θ."""
    problem = on_two_nodes(case, theta)
    always = problem.design().cost_all_time
    found = taciturn.evaluate(problem, standard_error=ACCURACY * always)
    return row_of(problem, found, always)


def at_cost(case: str, rival: str) -> dict[str, Any]:
    """Return the least traffic of a rule with the budget, with tuned shares."""
    problem = on_two_nodes(case, 1.0)
    always = problem.design().cost_all_time
    problem = problem.changed(RIVALS[rival])
    found = taciturn.tune(problem, cost=(1 + MORE) * always, standard_error=ACCURACY * always)
    assert found.shares is not None
    row = row_of(found.problem, found.evaluation, always)
    return row | {"parameter": found.parameter.value, "shares": dict(found.shares)}


def periodic(case: str, traffics: Mapping[str, float]) -> dict[str, Any]:
    """Return the least cost found of the same controller at fixed steps at some traffics, and the traffic of a cost."""
    problem = on_two_nodes(case, 1.0)
    always = problem.design().cost_all_time

    def at(traffic: float) -> LinkClocks | None:
        found = clocks_or_reason([problem, problem.changed(MODEL)], traffic)
        return None if isinstance(found, str) else found

    def row(traffic: float) -> dict[str, Any]:
        found = at(traffic)
        return {"traffic": traffic} | (
            {"refused": "no stable timing"} if found is None else {"cost": found.cost / always, "timing": found.short()}
        )

    low, high = 0.0, 2 / problem.parameters["period"]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        found = at(middle)
        low, high = (low, middle) if found is not None and found.cost <= (1 + MORE) * always else (middle, high)
    return {"same cost": row(high), **{f"traffic of {name}": row(traffic) for name, traffic in traffics.items()}}


def tank(changes: Mapping[str, Any], kind: str = "distributed") -> Problem:
    """Return a tank with inflow dynamics and its PID controller on two nodes, with a cost of output and input."""
    plant = Plant([[1, STEP], [0, 0.9]], [[0], [STEP]], np.diag([1e-4, 4e-4]), [[1, 0]], [[1e-3]], dt=STEP)
    pid = PID(1.2, 0.15, 1.0, 0.5, disturbance=Disturbance(deviation=0))
    cost = Cost.of_variances(plant.C, [1.0], [20.0])
    return Problem(plant, cost, Network(nodes=NODES), kind, dict(changes), controller=pid)


def draws_of_a_night() -> Array:
    """Return a step profile as of a recorded night: draw-offs of water with times, lengths and sizes by a formula."""
    seconds, found = STEP * np.arange(NIGHT), np.zeros(NIGHT)
    for j in range(28):
        begin, length = 60 * (17 * j + 5 * np.sin(j * j)), 90 + 60 * np.sin(3 * j)
        found[(seconds >= begin) & (seconds < begin + length)] += 0.4 + 0.6 * abs(np.sin(5 * j))
    return found


def loads() -> dict[str, Array]:
    """Return the loads at the input, in its units."""
    wave = np.sin(2 * np.pi * np.arange(NIGHT) / 100)
    return {"none": 0 * wave, "0.3 sin": 0.3 * wave, "1.0 sin": wave, "draw-offs": draws_of_a_night()}


def nights(problem: Problem, load: Array) -> dict[str, Array]:
    """Return for each night the mean measured cost, the rate of each link, and what its silence has added per step."""
    loop = problem.close(problem.design())
    policy, plant = loop.policy, loop.problem.plant
    program = loop.whole_program(supplied=True)
    added = {Silence(links): program.sums[Silence(links)] for links in policy.theory.silence}
    program = replace(program, sums={}, outputs={**program.outputs, **added})
    sent = [Sent(link) for link in problem.network.links]
    shown = [Entry("y", 0), Entry("applied", 0), *sent, *added]
    program = program.keep(outputs=set(shown))
    kernel, found = Kernel(program), list[list[float]]()
    for night in range(NIGHTS):
        draws = np.random.default_rng(night)  # the same noise for every rule
        w = draws.standard_normal((NIGHT, 2)) * np.sqrt(np.diag(plant.W)) + load[:, None] * plant.B[:, 0]
        v = draws.standard_normal((NIGHT, 1)) * np.sqrt(plant.V[0, 0])
        noise = {Entry(name, i): one[:, i] for name, one in (("w", w), ("v", v)) for i in range(one.shape[1])}
        given = np.array([noise[name] for name in program.inputs]).T[:, :, None]
        outputs = kernel.run(program, loop.start(program, 1, 1), NIGHT, given).outputs
        y, u, *rest = (outputs[name][:, 0] for name in shown)
        stage = y**2 * problem.cost.Q[0, 0] + u**2 * problem.cost.R[0, 0]
        found.append([float(stage.mean()), *(float(one.mean()) for one in rest)])
    names = ["cost", *(name.link for name in sent), *(" and ".join(name.links) for name in added)]
    columns = np.array(found).T
    values = dict(zip(names[: 1 + len(sent)], columns, strict=False))
    return values | {"added": columns[1 + len(sent) :]}


@cache
def night_rules() -> dict[str, Problem]:
    """Return the relative bank, and a bank with its promise and dead bands with its cost, both for the quiet tank."""
    share = KAPPA * sqrt(2)
    relative = tank({"kappa": share})
    quiet, noise = tank({"theta": 0.0}).design().cost_all_time, relative.cost.Q[0, 0] * relative.plant.V[0, 0]
    # a distance of the roots of costs; the measured cost contains the noise of the output
    fixed = tank({"delta": (share / (1 - share)) ** 2 * (quiet + noise)})
    cost = taciturn.evaluate(relative, standard_error=ACCURACY * quiet).cost.value
    equal = dict.fromkeys(relative.network.links, 1.0)  # the shares that a search finds here
    bands = taciturn.tune(
        tank({"delta": 0.02, "shares": equal}, "send-on-delta"), cost=cost, standard_error=ACCURACY * quiet
    )
    return {"relative bank": relative, "bank": fixed, "send-on-delta": bands.problem}


def under_load(name: str) -> dict[str, Any]:
    """Return cost, rates, certificate and promise of each rule under a load, relative to every sample on each path."""
    load = loads()[name]
    every = nights(tank({"theta": 0.0}), load)
    base, found = every["cost"], dict[str, Any]()
    assert (every["level"] == 1).all()
    assert (every["valve"] == 1).all()
    for rule, problem in night_rules().items():
        one, policy = nights(problem, load), problem.design()
        ratio = one["cost"] / base
        roots = np.sqrt(np.maximum(one["added"], 0)).sum(axis=0)
        certified = (1 + roots / np.sqrt(base)) ** 2 if len(one["added"]) else None
        if rule == "relative bank":
            promise = np.full(NIGHTS, 1 / (1 - KAPPA * sqrt(2)) ** 2)
        else:  # the promise is a distance of the roots of costs
            assert policy.guarantee is not None
            above = sqrt(policy.guarantee.cost) - sqrt(policy.cost_all_time)
            promise = (1 + above / np.sqrt(base)) ** 2
        assert (ratio <= promise + 1e-9).all()
        assert certified is None or (ratio <= certified + 1e-9).all()
        found[rule] = {
            "rates": {link: of_nights(one[link]) for link in problem.network.links},
            "cost": of_nights(ratio),
            "promise": of_nights(promise),
            "certificate": None if certified is None else of_nights(certified),
        }
    return {"every sample": of_nights(base), "rules": found}


def of_nights(values: Array) -> list[float]:
    """Return the mean over nights, and its standard error."""
    return [float(values.mean()), float(values.std(ddof=1) / sqrt(len(values)))]


DEVICE_RULES: dict[str, tuple[str, dict[str, Any]]] = {
    "bank": ("distributed", {"theta": 0.357}),
    "relative bank": ("distributed", {"kappa": KAPPA * sqrt(2)}),
    "threshold": ("distributed", {"theta": 0.357, "rule": "threshold"}),
    "bank, model in the valve": ("distributed", {"theta": 0.357, "actuation": "model"}),
    "send-on-delta": ("send-on-delta", {"delta": 0.05, "shares": {"valve": 2.5}}),
}


def on_device(rule: str, name: str) -> dict[str, Any]:
    """Return the instructions per step, the bytes of code and constants, and the memory of each node."""
    kind, changes = DEVICE_RULES[rule]
    board, precision = DEVICES[name]
    problem = tank(changes, kind)
    loop = replace(problem.close(problem.design()), precision=precision)
    folder = print_folder(loop, "device")
    sizes = measure_sizes(board.target, folder)
    counts = count_instructions(board, folder, record_loop(loop, DEVICE_TICKS, seed=1))
    nodes = {
        node.role: {
            **sizes[node.role]._asdict(),
            "operations": node.operations,
            "instructions": {what: count._asdict() for what, count in counts[node.role]._asdict().items()},
        }
        for node in folder.nodes
    }
    return {"nodes": nodes, "core": sizes["core"]._asdict()}


def main() -> None:
    """Compute what is missing in the file, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    path = parser.parse_args().json
    known: dict[str, Any] = json.loads(path.read_text()) if path and path.exists() else {}
    known.setdefault("machine", describe_machine())
    known.setdefault("tools", tools())

    def measure(table: dict[str, Any], name: str, found: Callable[[], Any]) -> None:
        if name not in table:
            table[name] = found()
            print(name, json.dumps(table[name]), flush=True)
            if path:
                write_whole(path, (json.dumps(known, indent=1) + "\n").encode())

    published = known.setdefault("published", {case: {} for case in CASES})
    for case, rows in published.items():
        for theta in THETAS:
            measure(rows, f"theta {theta:g}", lambda case=case, theta=theta: at_theta(case, theta))
        for rival in RIVALS:
            measure(rows, rival, lambda case=case, rival=rival: at_cost(case, rival))
        traffics = {rival: rows[rival]["traffic"][0] for rival in RIVALS}
        measure(rows, "periodic", lambda case=case, traffics=traffics: periodic(case, traffics))
    night = known.setdefault("nights", {})
    for name in loads():
        measure(night, name, lambda name=name: under_load(name))
    for rule in DEVICE_RULES:
        table = known.setdefault("devices", {}).setdefault(rule, {})
        for name in DEVICES:
            measure(table, name, lambda rule=rule, name=name: on_device(rule, name))


if __name__ == "__main__":
    main()
