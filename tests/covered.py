"""Which interpreters notice a property that they do not know: a table of classes and interpreters.

    python tests/covered.py

Each class of the model gets a further property with a value that is not neutral. First nothing in the library knows
the property. Then the simulation has learnt it (``LEARNT``), and the table shows what the others do.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from taciturn import ContinuousPlant, Cost, Jumps, Network, Plant, ProblemError, Reference, close, design
from taciturn.analyse.renewal import chain_of, resets
from taciturn.analyse.switched import switched
from taciturn.loop import Loop
from taciturn.model.coverage import SIMULATED
from taciturn.model.information import INFORMED
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Decide, Send
from taciturn.model.trigger import Trigger
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.nodes.together import Nodes
from taciturn.program.node import translate_node
from taciturn.program.translation import TRANSLATED
from taciturn.renewal.chain import NoQuadratureError
from taciturn.simulation.average import average
from taciturn_channel.classes import CHANNELS
from taciturn_control.systems import to_control
from taciturn_export.fmu import print_fmu
from taciturn_export.folder import print_folder
from taciturn_udp.relay import losses
from taciturn_worlds.world import World

LEARNT = (SIMULATED, TRANSLATED, INFORMED)
ONE = [[1.0]]
IDEAL, PLANT, COST = Network(), Plant([[1.1]], ONE, ONE), Cost(ONE, ONE)


@dataclass(frozen=True)
class Quantise:
    """A class of policy steps that nothing knows."""

    at: str = "controller"
    signal: str = "input"
    on: None = None


@dataclass(frozen=True)
class Case:
    """A loop with a property of the given name, from parts that may have it."""

    name: str
    plant: Plant | ContinuousPlant = PLANT
    cost: Cost = COST
    network: Network = IDEAL
    change: Callable[[Any], Any] = lambda step: step
    more: tuple[Any, ...] = ()
    around: str = ""  # a known property that contains the unknown one, and whose refusal suffices

    def policy(self) -> Policy:
        """Return a policy whose send resets the error, so that every analysis serves it without the property."""
        period = 0.1 if isinstance(self.plant, ContinuousPlant) else None
        found = design.excess(self.plant, self.cost, delta=2.0, actuation="model", period=period)
        return replace(found, steps=(*map(self.change, found.steps), *self.more))

    def loop(self, claimed: bool = False) -> Loop:
        """Return the closed loop; ``claimed`` makes the theory claim to cover the property."""
        policy = self.policy()
        if claimed:
            theory = replace(policy.theory, covers=policy.theory.covers | {self.name})
            policy = replace(policy, theory=theory, network=self.network)
        return close(self.plant, policy, self.network, self.cost)


def grown(thing: Any, name: str, value: float = 0.3, init: bool = False) -> Any:
    """Return a copy of an object whose class has a further property, which is 0 by default."""
    kind = type(thing)
    made = type(kind.__name__, (kind,), {"__annotations__": {name: "float"}, name: 0.0, "__module__": __name__})
    made = dataclass(frozen=True, eq=False, repr=False, init=init)(made)
    found = object.__new__(made)
    found.__dict__.update(vars(thing) | {name: value})
    return found


def only(kind: type, build: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a change of the policy steps of one class."""
    return lambda step: build(step) if isinstance(step, kind) else step


def with_form(step: Decide) -> Decide:
    """Return a decision whose forms have a further property."""
    return replace(step, trigger=Trigger({k: grown(one, "cubic") for k, one in step.trigger.options.items()}))


CONTINUOUS = ContinuousPlant([[0.1]], ONE, ONE)
JUMPS = grown(Jumps(1.0, np.eye(1)), "skewness")
CASES = (
    Case("plant.dead_zone", plant=grown(PLANT, "dead_zone")),
    Case("plant.dead_zone", plant=grown(CONTINUOUS, "dead_zone")),
    Case("jumps.skewness", plant=ContinuousPlant([[0.1]], ONE, jumps=JUMPS), around="jumps"),
    Case("cost.risk_aversion", cost=grown(COST, "risk_aversion")),
    Case("network.jamming", network=grown(Network(), "jamming", init=True)),
    Case("Assign.saturation", change=only(Assign, lambda step: grown(step, "saturation"))),
    Case("Decide.hysteresis", change=only(Decide, lambda step: grown(step, "hysteresis"))),
    Case("Send.repeats", change=only(Send, lambda step: grown(step, "repeats", init=True))),
    Case("Form.cubic", change=only(Decide, with_form)),
    Case("Quantise", more=(Quantise(),)),
)
PREVIEW = grown(Reference([[0.0]] * 4, [[0.0]] * 3), "preview")
DESIGNS: Mapping[str, Callable[[], object]] = {  # designs from parts that no policy contains
    "reference.preview": lambda: design.lossy_lqg(PLANT, Cost(ONE, ONE, horizon=3), price=1.0, reference=PREVIEW),
    "network.jamming": lambda: design.lossy_lqg(PLANT, COST, network=CASES[4].network, price=1.0),
    "plant.dead_zone": lambda: design.integral(grown(CONTINUOUS, "dead_zone"), COST, slope=1.0),
    "cost.risk_aversion": lambda: design.consistent(CONTINUOUS, grown(COST, "risk_aversion"), period=0.1),
}


def quiet(loop: Loop) -> None:
    """Raise an error if a loop does not claim anything and names the reason."""
    if not loop.nominal and loop.identity is None and not loop.reducible:
        raise NoQuadratureError(" ".join(loop.violated_assumptions))


def policy_of(case: Case) -> Policy:
    """Return the policy with the network of the case as that of its design."""
    return replace(case.policy(), network=case.network)


UNKNOWN: Mapping[str, Callable[[Case], object]] = {
    "design": lambda case: policy_of(case).diagram(),
    "close": lambda case: case.loop(),
    "simulate": lambda case: average(case.loop(), steps=2000),
}
OTHERS: Mapping[str, Callable[[Case], object]] = {
    "claims": lambda case: quiet(case.loop()),
    "renewal": lambda case: chain_of(case.loop(claimed=True)),
    "bounds": lambda case: resets(case.loop(claimed=True)),
    "certificates": lambda case: switched(case.loop()),
    "channel": lambda case: CHANNELS.check(case.loop(claimed=True).parts),
    "node": lambda case: translate_node(policy_of(case), frozenset({"controller", "sensor"}), case.network),
    "nodes": lambda case: Nodes(policy_of(case), case.network),
    "diagram": lambda case: policy_of(case).diagram(),
    "C": lambda case: print_folder(case.loop(), "device", rows=3),
    "FMU": lambda case: print_fmu(case.loop(), "unit", compiler=None),
    "links": lambda case: losses(case.network, 1),
    "plant": lambda case: SimulatedPlant(case.loop()),
    "worlds": lambda case: World(case.loop(), 1, (), {}, False),
    "control": lambda case: to_control(case.plant),
}
SAMPLED = dict.fromkeys(("node", "nodes", "diagram"), lambda case: isinstance(case.plant, ContinuousPlant))
IRRELEVANT = SAMPLED | {  # interpreters that do not see the class
    "links": lambda case: not case.name.startswith("network"),
    "control": lambda case: not case.name.startswith(("plant", "jumps")),
}


@contextmanager
def learnt(name: str) -> Iterator[None]:
    """Add a property to what the simulation covers; a class of steps needs code there, and is refused."""
    before = [one.names for one in LEARNT]
    for one in LEARNT if "." in name else ():
        object.__setattr__(one, "names", one.names | {name})
    try:
        yield
    finally:
        for one, names in zip(LEARNT, before, strict=True):
            object.__setattr__(one, "names", names)


def answer(case: Case, interpret: Callable[[Case], object]) -> str:
    """Return what an interpreter does with a property: ``refused`` if its message names it, or else ``silent``."""
    try:
        interpret(case)
    except ProblemError as error:
        named = any(text and text in str(error) for text in (case.name, *case.around.split("|")))
        told = "no claim" if isinstance(error, NoQuadratureError) else "refused"
        return told if named else f"silent: {error}"
    return "silent"


def table() -> dict[tuple[str, str], dict[str, str]]:
    """Return the answers of all interpreters, by class and property."""
    found: dict[tuple[str, str], dict[str, str]] = {}
    for case in CASES:
        answers = {name: answer(case, interpret) for name, interpret in UNKNOWN.items()}
        with learnt(case.name):
            for name, interpret in OTHERS.items():
                unseen = name in IRRELEVANT and IRRELEVANT[name](case)
                answers[name] = "-" if unseen else answer(case, interpret)
        found[f"{type(case.plant).__name__}", case.name] = answers
    return found


if __name__ == "__main__":
    rows = table()
    print(f"{'property':34}" + "".join(f"{name:>13}" for name in (*UNKNOWN, *OTHERS)))
    for (plant, name), answers in rows.items():
        print(f"{plant + ', ' + name:34}" + "".join(f"{text[:12]:>13}" for text in answers.values()))
    sys.exit(any(text.startswith("silent") for answers in rows.values() for text in answers.values()))
