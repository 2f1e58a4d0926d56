"""Controls of the page (sliders and choices) for a setting, derived from the records of the policy kinds.

A control has the key of a change, a label, a note, and a number with a range, a whole number, or one of several words.
The parameters of a kind are those of its design function that are stated, required, or have a default that is not None;
the kind's trade-off parameter comes first. A number that is positive has a range of ratios around its value, so that a
control moves it by equal ratios.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, cast, get_args, get_origin

from taciturn.design.catalogue import CATALOGUE
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.extend import Displayed
from taciturn.model.link import LinkLaw
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.problem import Problem
from taciturn_explore.setting import FACTOR, FACTORS, Setting, Value, is_matrix, value_at
from taciturn_new.draft import needed_parameters, suggest_value

RANGE, FACTOR_RANGE = 100.0, 10.0  # ratio of the ends of a range to the value in its middle
MOST_LOSS = 0.5
LONGEST_DELAY, SEVERAL_STEPS = 1, 5  # steps of computation, and of a link
MORE = "More parameters"  # heading of those that the problem does not state
PROTOCOLS = "ideal: every packet arrives; tcp: the sender learns whether a packet arrives; udp: it does not"
NAMES = {"cost.Q": "Q, weight of the states", "cost.R": "R, weight of the inputs", "plant.W": "W, process noise",
         "plant.V": "V, measurement noise"}  # fmt: skip


@dataclass(frozen=True, repr=False)
class Control(Displayed):
    """A control of the page."""

    key: str  # key of the change
    label: str  # name of the control
    note: str  # sentence on its meaning
    group: str  # heading under which it stands
    # ``"ratio"`` for a positive number, ``"number"``, ``"whole"`` or ``"choice"``
    form: Literal["ratio", "number", "whole", "choice"]
    value: Value  # present value
    low: float = 0.0  # lower end of the range
    high: float = 1.0  # upper end of the range
    choices: tuple[str, ...] = ()  # words of a choice
    tuning: bool = False  # whether it is the parameter by which cost is traded against traffic

    def document(self) -> dict[str, object]:
        """Return the description of the control that the page needs to show it."""
        shared = {"key": self.key, "label": self.label, "note": self.note, "group": self.group, "form": self.form}
        return {**shared, "value": self.value, "low": self.low, "high": self.high, "choices": list(self.choices),
                "tuning": self.tuning}  # fmt: skip


def controls_of(setting: Setting, problem: Problem) -> list[Control]:
    """Return the controls (sliders and choices) for a problem, in the order in which the page shows them."""
    found = [*_parameters(problem), *_factors(setting, problem), *_links(problem)]
    return sorted(found, key=lambda one: one.group == MORE)


def tuned(problem: Problem) -> TradeoffParameter | None:
    """Return the parameter of a problem's policy that trades cost against traffic; None if it has no such parameter."""
    continuous = isinstance(problem.plant, ContinuousPlant)
    fitting = [one for one in problem.record.tuning if one.continuous in (None, continuous)]
    stated = [one for one in fitting if isinstance(problem.parameters.get(one.name), int | float)]
    return stated[0] if stated else next((one for one in fitting if _default(problem.record, one.name)), None)


def tuning_value(problem: Problem, parameter: TradeoffParameter) -> float:
    """Return the present value of a problem's trade-off parameter."""
    found = problem.parameters.get(parameter.name, _default(problem.record, parameter.name))
    return float(cast("float", found))


def _default(kind: Kind, name: str) -> Any:
    one = kind.parameters.get(name)
    found = None if one is None or one.default is one.empty else one.default
    return found if isinstance(found, int | float) and not isinstance(found, bool) else None


def _parameters(problem: Problem) -> Iterator[Control]:
    kind, main = problem.record, tuned(problem)
    fitting = [name for name in kind.parameters if name != "period" or isinstance(problem.plant, ContinuousPlant)]
    for name in sorted(fitting, key=lambda name: main is None or name != main.name):
        one, hint = kind.parameters[name], kind.hints.get(name)
        given = problem.parameters.get(name, None if one.default is one.empty else one.default)
        words = _words(hint)
        stated = name in problem.parameters or (main is not None and main.name == name)
        group = "Policy" if stated else MORE
        begin = Control(f"policy.{name}", name, kind.notes.get(name, ""), group, "number", given)
        begin = replace(begin, tuning=main is not None and main.name == name)
        if words and given is not None:
            yield replace(begin, form="choice", choices=words)
        elif isinstance(given, bool) or not isinstance(given, int | float) or not math.isfinite(given):
            continue
        elif isinstance(given, int) and "float" not in str(hint):
            lowest = main.least if main is not None and main.name == name else 1
            yield replace(begin, form="whole", low=lowest, high=max(32, 2 * given))
        elif given > 0:
            middle = _rounded(given)
            yield replace(begin, form="ratio", low=middle / RANGE, high=middle * RANGE)
        else:
            yield begin


def _rounded(value: float) -> float:
    """Return the nearest power of ten, so that the ends of a range stay where they are while a control moves."""
    return 10.0 ** round(math.log10(value))


def _words(hint: Any) -> tuple[str, ...]:
    return tuple(get_args(hint)) if get_origin(hint) is Literal else ()


def _factors(setting: Setting, problem: Problem) -> Iterator[Control]:
    changed = dict(setting.changes)
    for key in FACTORS:
        if is_matrix(value_at(problem, key)):
            yield Control(
                FACTOR + key, f"{key[-1]} ×", f"factor on {NAMES[key]}", "Weights and noise", "ratio",
                changed.get(FACTOR + key, 1.0), 1 / FACTOR_RANGE, FACTOR_RANGE,
            )  # fmt: skip


def _links(problem: Problem) -> Iterator[Control]:
    network = problem.network
    kind = problem.record
    for link, law in network.links.items():
        if network.own_nodes and law.burst is None and (kind.takes_losses or law.loss > 0):
            yield Control(f"links.{link}.loss", f"loss, {link}", f"probability that a packet of {link} is dropped",
                          "Network", "number", law.loss, 0.0, MOST_LOSS)  # fmt: skip
    if not network.own_nodes and kind.takes_losses and all(law.burst is None for law in network.links.values()):
        choices = ("ideal", "tcp", "udp")
        yield Control("network.protocol", "protocol", PROTOCOLS, "Network", "choice", network.protocol, choices=choices)
        for link, law in network.links.items() if network.protocol != "ideal" else ():
            note = f"probability that a packet of the {link} link is dropped"
            yield Control(f"network.{link}_loss", f"loss, {link}", note, "Network", "number", law.loss, 0.0, MOST_LOSS)
    for link, law in network.links.items():
        yield from _delays(link, law, network)
    if kind.delay and not network.own_nodes:
        yield Control("network.delay", "delay", "steps from a measurement to the input that uses it", "Network",
                      "whole", network.delay, 0, min(kind.delay, LONGEST_DELAY))  # fmt: skip


def _delays(link: str, law: LinkLaw, network: Network) -> Iterator[Control]:
    """Yield controls of a constant delay and of a buffer that the problem states."""
    constant = None if law.delay is None else law.delay.constant
    notes = {
        "delay": "from the sending of a packet to its arrival",
        "buffer": "from the sending of a packet to its use",
    }
    for name, wait in (("delay", constant), ("buffer", law.buffer)):
        if wait is None:
            continue
        key, label = network.key(link, name), f"{name}, {link}"
        if wait.seconds:
            yield Control(f"{key}.seconds", label, f"seconds {notes[name]}", "Network", "ratio", wait.seconds,
                          wait.seconds / FACTOR_RANGE, FACTOR_RANGE * wait.seconds)  # fmt: skip
        else:
            least = 0 if name == "delay" else 1
            yield Control(key, label, f"steps {notes[name]}", "Network", "whole", wait.steps, least,
                          max(SEVERAL_STEPS, 2 * wait.steps))  # fmt: skip


def with_kind(setting: Setting, base: Problem, problem: Problem, name: str) -> Setting:
    """Return the setting with another policy kind, with values for all parameters of this kind.

    A parameter keeps its value if the present kind has one of the same name; others get the value that
    ``taciturn new`` suggests, or that of the kind's example."""
    if name not in CATALOGUE:
        raise ProblemError(f"the policy kind is {name!r}; expected one of the policy kinds {', '.join(CATALOGUE)}")
    kind, kept = CATALOGUE[name], problem.parameters
    removed = {key: None for key, _ in setting.changes if key.startswith("policy.")}
    if name == base.kind:
        return setting.to(removed)
    continuous = isinstance(base.plant, ContinuousPlant)
    found: dict[str, Value] = {}
    for one in (*needed_parameters(kind, continuous), *kind.example):
        if one in found or (one == "period" and not continuous):
            continue
        value = kept[one] if one in kept else suggest_value(kind, one, base.plant, base.cost, _period(problem))
        value = kind.example.get(one) if value is None else value
        if isinstance(value, int | float | str):
            found[one] = value
    if "actuation" in kind.parameters and "actuation" in kept:
        found["actuation"] = kept["actuation"]
    return setting.to({**removed, "policy.kind": name, **{f"policy.{key}": value for key, value in found.items()}})


def _period(problem: Problem) -> float | None:
    plant = problem.plant
    return None if isinstance(plant, Plant) else cast("float | None", problem.parameters.get("period"))


def suits(base: Problem, setting: Setting, name: str) -> bool:
    """Return whether nodes can run a policy of the given kind for the problem of a setting."""
    from taciturn.errors import TaciturnError

    try:
        problem = with_kind(setting, base, setting.problem(base), name).problem(base)
        if tuned(problem) is None:
            return False
        problem.design()
    except (TaciturnError, ArithmeticError):
        return False
    return True


def offered(kinds: Mapping[str, Kind]) -> list[str]:
    """Return the names of the policy kinds; those that ``taciturn new`` offers come first."""
    return sorted(kinds, key=lambda name: (kinds[name].offered is None, kinds[name].offered or 0, name))
