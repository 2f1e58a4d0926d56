"""What each policy kind makes of each property of a problem: it changes the simulated law, or it is refused.

``python tests/used.py`` prints the table, with the reason of every refusal.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from typing import Any
from unittest.mock import patch

import numpy as np

from taciturn import Burst, ContinuousPlant, Cost, Jumps, Network, Plant, Policy, Problem, close
from taciturn._modes import root
from taciturn.analyse.renewal import resets
from taciturn.design.catalogue import CATALOGUE
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.disturbance import Reference
from taciturn.model.estimate import Estimate
from taciturn.program.ops import Sent, is_entry
from taciturn_events.policy import EventPolicy
from taciturn_limits.optimal_kind import OptimalPolicy
from taciturn_new.draft import example_of

A, B, C, V, W = [[1.1, 0.2], [0.0, 0.8]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.2]], [[0.1, 0.0], [0.0, 0.1]]
COST = Cost(np.eye(2), [[0.5]])
SEEN = Plant(A, B, W, C, V)
FULL = Plant(A, B, W)
SCALAR = Plant([[1.1]], [[1.0]], [[0.1]])
JUMPING = ContinuousPlant([[-0.2]], [[1.0]], jumps=Jumps(2.0, [[0.1]]))
DRIVEN = Cost([[1.0]], [[1.0]])
IDEAL = Network()
STEPS = 6  # of a finite-horizon run


def stated(
    plant: Plant | ContinuousPlant, kind: str, network: Network = IDEAL, cost: Cost = COST, **parameters: Any
) -> Problem:
    """Return a problem."""
    return Problem(plant, cost, network, kind, parameters)


KINDS: dict[str, Problem] = {
    "all-time": stated(SEEN, "all-time"),
    "periodic": stated(SEEN, "periodic", every=2),
    "lqg": stated(SEEN, "lqg", theta=0.3),
    "remote-lqg": stated(SEEN, "remote-lqg", theta=0.3, zeta=0.3),
    "remote-lqg, controller at the actuator": stated(SEEN, "remote-lqg", zeta=0.3, controller="actuator"),
    "remote-lqg, controller at the sensor": stated(SEEN, "remote-lqg", theta=0.3, controller="sensor"),
    "lossy-lqg": stated(FULL, "lossy-lqg", Network("udp", 0.1, 0.1), price=0.2),
    "integral": stated(JUMPING, "integral", IDEAL, DRIVEN, slope=0.05, alpha=0.2, h_max=2.0),
    "integral, with a period": stated(
        JUMPING, "integral", IDEAL, DRIVEN, slope=0.05, alpha=0.2, h_max=1.0, period=0.05
    ),
    "consistent": stated(JUMPING, "consistent", IDEAL, DRIVEN, period=0.5),
    "excess": stated(SEEN, "excess", theta=0.3),
    "optimal": stated(FULL, "optimal", price=1.0),
    "near-optimal": stated(SCALAR, "near-optimal", IDEAL, DRIVEN, price=1.0),
    "absolute": stated(SEEN, "absolute", threshold=0.5),
    "relative": stated(SEEN, "relative", sigma=0.1),
    "mixed": stated(SEEN, "mixed", sigma=0.1, threshold=0.3),
    "dynamic": stated(SEEN, "dynamic", sigma=0.1, rho=0.8, gain=1.5),
    "send-on-delta": stated(SEEN, "send-on-delta", delta=0.5),
    "distributed": stated(SEEN, "distributed", theta=0.3),
    "variance": stated(SEEN, "variance", threshold=0.5),
    "rollout": stated(SEEN, "rollout", horizon=4, every=2),
    "self-triggered": stated(SEEN, "self-triggered", beta=1.3, max_interval=4),
    "stochastic": stated(SEEN, "stochastic", scale=1.0),
    "periodic-schedule": stated(SEEN, "periodic-schedule", length=5, sends=3),
    "downsampled": stated(SEEN, "downsampled", fast=1, slow=2, threshold=0.5),
}
KINDS |= {name: example_of(kind) for name, kind in CATALOGUE.items() if name not in KINDS}
"""A problem of each kind; next to its full state nothing is given that it need not have."""


def rebuilt(plant: Plant | ContinuousPlant, **changes: Any) -> Any:
    """Return a plant with other arguments."""
    names = ("A", "B", "W", "mean", "covariance", "input_limit", "input_rate")
    if isinstance(plant, Plant):
        given = {**{name: getattr(plant, name) for name in (*names, "dt")}, "function": plant.function, **changes}
        return Plant(**given) if plant.full_state else Plant(**given, C=plant.C, V=plant.V)
    given = {name: getattr(plant, name) for name in names if name != "W"} | changes
    return ContinuousPlant(**given) if "W" in changes else ContinuousPlant(**given, jumps=plant.jumps)


def limited(plant: Plant | ContinuousPlant) -> Any:
    """Return the plant with limits of its inputs."""
    return rebuilt(plant, input_limit=[1.0] * plant.inputs)


def slowed(plant: Plant | ContinuousPlant) -> Any:
    """Return the plant with limits of the changes of its inputs."""
    return rebuilt(plant, input_rate=[0.5] * plant.inputs)


def moved(plant: Plant | ContinuousPlant) -> Any:
    """Return the plant with another initial mean."""
    return rebuilt(plant, mean=np.linspace(0.3, 0.5, plant.states))


def spread(plant: Plant | ContinuousPlant) -> Any:
    """Return the plant with an initial covariance."""
    return rebuilt(plant, covariance=0.1 * np.eye(plant.states))


def wider(plant: Plant | ContinuousPlant) -> Any:
    """Return another plant of the same sizes."""
    return rebuilt(plant, A=0.9 * plant.A)


def in_cost(**changes: Any) -> Callable[[Problem], Problem]:
    """Return a change of the cost."""

    def changed(problem: Problem) -> Problem:
        cost = problem.cost
        given = {**{name: getattr(cost, name) for name in ("Q", "R", "N", "horizon")}, **changes}
        return replace(problem, cost=Cost(**given))

    return changed


def crossed(problem: Problem) -> Problem:
    """Return the problem with a cross weight, with which the cost remains convex whatever Q and R are."""
    of_states, of_inputs = root(problem.cost.Q), root(problem.cost.R)
    N = of_states @ np.full((of_states.shape[1], of_inputs.shape[1]), 0.1) @ of_inputs.T
    return in_cost(N=N)(problem)


def followed(problem: Problem) -> Problem:
    """Return a finite-horizon run that follows a reference."""
    plant = problem.plant
    states = np.array([[0.0] * plant.states] * (STEPS + 1))
    inputs = np.zeros((STEPS, plant.inputs))
    inputs[0] = 0.5
    for k in range(STEPS):
        states[k + 1] = plant.A @ states[k] + plant.B @ inputs[k]
    return replace(problem, reference=Reference(states, inputs))


def mission(problem: Problem) -> Problem:
    """Return the problem over a few steps; as it is, where the kind knows none."""
    found = in_cost(horizon=STEPS)(problem)
    return found if isinstance(law(found), tuple) else problem


PROPERTIES: Mapping[str, Callable[[Problem], Problem]] = {
    "plant.initial.mean": lambda problem: replace(problem, plant=moved(problem.plant)),
    "plant.initial.covariance": lambda problem: replace(problem, plant=spread(problem.plant)),
    "plant.input_limit": lambda problem: replace(problem, plant=limited(problem.plant)),
    "plant.input_rate": lambda problem: replace(problem, plant=slowed(problem.plant)),
    "plant.actual": lambda problem: replace(problem, actual=wider(problem.plant)),
    "plant.actual.initial.mean": lambda problem: replace(problem, actual=moved(problem.plant)),
    "plant.actual.initial.covariance": lambda problem: replace(problem, actual=spread(problem.plant)),
    "plant.actual.input_limit": lambda problem: replace(problem, actual=limited(problem.plant)),
    "plant.actual.input_rate": lambda problem: replace(problem, actual=slowed(problem.plant)),
    "plant.initial.mean with plant.actual": lambda problem: replace(
        problem, plant=moved(problem.plant), actual=problem.plant
    ),
    "plant.initial.covariance with plant.actual": lambda problem: replace(
        problem, plant=spread(problem.plant), actual=problem.plant
    ),
    "plant.input_limit with plant.actual": lambda problem: replace(
        problem, plant=limited(problem.plant), actual=problem.plant
    ),
    "plant.input_rate with plant.actual": lambda problem: replace(
        problem, plant=slowed(problem.plant), actual=problem.plant
    ),
    "cost.N": crossed,
    "cost.horizon": in_cost(horizon=STEPS),
    "cost.terminal": lambda problem: in_cost(terminal=3 * problem.cost.Q)(mission(problem)),
    "cost.discount": in_cost(discount=0.9),
    "reference": lambda problem: followed(mission(problem)),
}
"""Changes of a problem by one property; one that needs a horizon or another plant is compared with such a problem."""


def lossy(link: str, **law: Any) -> Callable[[Network], Network]:
    """Return a change of a link of a network on which packets may be lost."""
    return lambda network: (network.with_laws({"acknowledged": False}) if network.ideal else network).changed(
        {link: law}
    )


BURST = Burst(0.1, 0.3, 0.0, 0.8)
LINKS: Mapping[str, Callable[[Network], Network]] = {
    "network.actuator_loss": lossy("actuator", loss=0.2),
    "network.sensor_loss": lossy("sensor", loss=0.2),
    "network.actuator_burst": lossy("actuator", loss=0.0, burst=BURST),
    "network.sensor_burst": lossy("sensor", loss=0.0, burst=BURST),
    "network.delay": lambda network: replace(network, delay=1),
    "network.actuator_delay": lambda network: network.changed({"actuator": {"delay": 1}}),
    "network.sensor_delay": lambda network: network.changed({"sensor": {"delay": 1}}),
    "network.actuator_buffer": lambda network: network.changed({"actuator": {"buffer": 2}}),
    "network.sensor_buffer": lambda network: network.changed({"sensor": {"buffer": 2}}),
    "network.actuator_acknowledgement_delay": lambda network: network.changed(
        {"actuator": {"acknowledged": True, "loss": 0.2, "acknowledgement_delay": 1}}
    ),
    "network.payload": lambda network: network.with_laws({"payload": "float32"}),
    "network.actuator_range": lambda network: network.changed({"actuator": {"payload": "int16", "range": (2.0,)}}),
    "network.sensor_range": lambda network: network.changed({"sensor": {"payload": "int16", "range": (2.0,)}}),
}
"""Changes of a network by one property."""


@cache
def law(problem: Problem) -> Hashable:
    """Return what decides the simulated outputs of a problem on a seed, or the sentence with which it is refused."""
    try:
        policy = problem.designed()
        if isinstance(policy, EventPolicy):
            return ("events", repr((policy.process, policy.trigger, policy.cost_all_time)))
        if isinstance(policy, OptimalPolicy):
            loop = problem.close(policy.looked_at)
            return ("solved", repr((resets(loop), policy.price, loop.problem.plant.A, loop.policy.cost_all_time)))
        return run_law(problem.close(policy))
    except ProblemError as error:
        return str(error)


def run_law(loop: Loop) -> Hashable:
    """Return the program of a loop as far as states, inputs and sends depend on it, and its first states."""
    whole = loop.program()
    shown = {name for name in whole.outputs if isinstance(name, Sent) or is_entry(name, "x", "applied")}
    program = whole.keep(sums={"cost"}, outputs=shown)
    numbers = (program.constants, program.tables, program.matrices)
    started = loop.start(program, 4, seed=1).tobytes()
    return ("run", program.structure, numbers, started, loop.horizon, repr(loop.problem.cost.terminal))


@dataclass(frozen=True)
class Use:
    """What becomes of a property.

    Args:
        used: whether it changes the law.
        refused: the sentence, or nothing.
    """

    used: bool
    refused: str = ""

    def __str__(self) -> str:
        """Return it in words."""
        return f"refused: {self.refused}" if self.refused else "used" if self.used else "IGNORED"


def compared(changed: Hashable, base: Hashable) -> Use:
    """Return whether a law differs from that of a base, or is refused."""
    assert isinstance(base, tuple), base
    return Use(False, changed) if isinstance(changed, str) else Use(changed != base)


def of_problem(problem: Problem, name: str) -> Use:
    """Return what becomes of a property of a problem."""
    try:
        changed = PROPERTIES[name](problem)
    except ProblemError as error:
        return Use(False, str(error))
    base = replace(problem, actual=problem.plant) if name.endswith("with plant.actual") else problem
    if name in ("cost.terminal", "reference"):
        base = mission(problem)
    found = law(base)
    return compared(law(changed), found) if isinstance(found, tuple) else Use(False, str(found))


def of_network(problem: Problem, name: str) -> tuple[Use, Use]:
    """Return what becomes of a property of the network: in a problem, and where a loop is closed over it."""
    network, base = LINKS[name](problem.network), problem
    if name.endswith("range"):  # whole numbers have a range on each link that is used, and this one is finer
        policy = problem.designed()
        links = {step.link for step in getattr(policy, "steps", ()) if hasattr(step, "link")}
        ranges = {f"{link}_range": 1.0 for link in links}
        base = replace(problem, network=Network(payload="int16", **ranges))
        network = base.network.changed({name.removeprefix("network.").removesuffix("_range"): {"range": (2.0,)}})
        if not links:
            base = problem
    stated = compared(law(replace(problem, network=network)), law(base))
    policy = problem.designed()
    if not isinstance(policy, Policy):
        return stated, stated
    try:
        over = run_law(close(problem.plant, policy, network, problem.cost))
    except ProblemError as error:
        return stated, Use(False, str(error))
    return stated, compared(over, run_law(close(problem.plant, policy, base.network, problem.cost)))


@cache
def uses_of(kind: str) -> Mapping[str, tuple[Use, ...]]:
    """Return what becomes of each property with a kind; of the network in a problem, and where a loop is closed."""
    problem = KINDS[kind]
    module = import_module("taciturn_events.integral")
    slope = patch.object(module, "_largest_slope", lambda *_: np.inf)  # these two checks take long, and decide no law
    alpha = patch.object(module._Search, "given", lambda _, alpha: Estimate(alpha, 0.0, "exact"))
    with slope, alpha:
        found = {name: (of_problem(problem, name),) for name in PROPERTIES}
        return found | {name: of_network(problem, name) for name in LINKS}


def mark(ways: tuple[Use, ...]) -> str:
    """Return what becomes of a property as a word: in problems, or only where a loop is closed over a network."""
    return "yes" if ways[0].used else "close" if ways[-1].used else "no"


def table() -> str:
    """Return the table of the documentation: kinds that agree in a row, properties on which all agree in a line."""
    marks = {kind: {name: mark(ways) for name, ways in uses_of(kind).items()} for kind in KINDS}
    kinds: dict[tuple[str, ...], list[str]] = {}
    for kind, row in marks.items():
        kinds.setdefault(tuple(row.values()), []).append(kind)
    names: dict[tuple[str, ...], list[str]] = {}
    for i, name in enumerate((*PROPERTIES, *LINKS)):
        names.setdefault(tuple(row[i] for row in kinds), []).append(f"`{name}`")
    lines = [["", *(", ".join(group) for group in kinds.values())], ["---"] * (1 + len(kinds))]
    lines += [[", ".join(group), *found] for found, group in names.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    print(table(), end="\n\n")
    for kind in KINDS:
        for name, ways in uses_of(kind).items():
            words = list(dict.fromkeys(map(str, ways)))
            print(f"{kind:40} {name:46} {' | closed: '.join(words)}")
