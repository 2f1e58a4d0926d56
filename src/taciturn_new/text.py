"""The text of a new problem file: a comment before each key describes it, and unused keys are commented out.

The notes on keys of ``[plant]``, ``[cost]`` and ``[controller]`` are metadata of the classes of the model, and those on
parameters of the policy come from the docstring of its design function.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any, cast

import numpy as np

from taciturn.design.kind import Kind
from taciturn.extend import ArrayLike, number_of
from taciturn.problem.parameters import find_kind
from taciturn.problem.schema import ControllerKeys, CostKeys, PlantKeys, keys_of
from taciturn_new.matrices import exact_number_text, rows_text

WIDTH = 98  # characters of a comment line
# what the notes of keys say of the time base
CONTINUOUS = {"per": "per second", "noise": "intensity per second", "moved": "the derivative of the state"}
DISCRETE = {"per": "per step", "noise": "covariance per step", "moved": "the next state"}
NETWORK = {
    "protocol": '"udp": dropouts without acknowledgement; "tcp": with acknowledgement; "ideal": no dropouts',
    "actuator_loss": "probability that a packet to the actuator is lost",
    "sensor_loss": "probability that a measurement is lost",
    "sensor_energy": "joules per packet of the sensor",
    "sensor_battery": "joules of the battery of the sensor",
    "actuator_energy": "joules per packet to the actuator",
    "actuator_battery": "joules of the battery of the sender to the actuator",
}
NODES = {
    "measures": "outputs that the node measures, counted from 0",
    "applies": "inputs that the node applies, counted from 0",
    "site": "node at the same place; the two need no link",
}
LINKS = {
    "loss": "probability that a packet is lost",
    "acknowledged": "whether the sender learns which packets arrive",
    "energy": "joules per packet",
    "battery": "joules of the battery",
}
DISTURBANCE = {
    "kind": '"constant", "ramp" or "sinusoid"',
    "enters": "effect on each state, {per}",
    "wander": "how fast its size changes: {noise}",
    "frequency": "radians {per}",
}
REFERENCE = {
    "outputs": "combinations of the states that follow the set-points",
    "value": "the set-points",
    "steps": "steps at random times: their mean number {per}, and the covariance of a step",
    "file": "rows of a time and the set-points from then on",
}
LIMITS = {"low": "least value of each output", "high": "largest value of each output"}


def problem_text(tables: Mapping[str, Any], name: str) -> str:
    """Return the text of a problem file, with a comment on each key."""
    plant, policy = tables["plant"], tables["policy"]
    kind = find_kind(policy["kind"], "the kind")
    continuous = "dt" not in plant
    words = CONTINUOUS if continuous else DISCRETE
    rule = f"{'E ' if 'E' in plant else ''}{'dx/dt' if continuous else 'x⁺'} = A x + B u + w"
    fed = " + D u, u of the step before" if "D" in plant else ""
    measured = f",  y = C x + v{fed}" if "C" in plant else ",  y = x: the full state is measured"
    sizes = (len(plant["A"]), len(plant["B"][0]))
    states, inputs = (number_of(count, word) for count, word in zip(sizes, ("state", "input"), strict=True))
    lines = [
        f"# A problem of event-triggered control: {states}, {inputs}. Units of time are seconds.",
        f"#   taciturn show {name}",
        f"#   taciturn evaluate {name}",
        "",
        f"# {rule}{measured}",
        "[plant]",
    ]
    notes = _notes(PlantKeys, words)
    lines += _table(plant, notes)
    if "input_limit" not in plant:
        lines += _offered({"input_limit": ("[…]", notes["input_limit"])})
    cross = " + 2 x'Nu" if "N" in tables["cost"] else ""
    lines += ["", f"# x'Qx + u'Ru{cross} {words['per']}", "[cost]"]
    notes = _notes(CostKeys, words)
    lines += _table(tables["cost"], notes)
    if "controller" in tables and "Q" in tables["cost"]:
        lines += _offered(
            {"weights": ('"as the controller"', "in place of Q and R: equal weight for present variances")}
        )
    if "horizon" in kind.costs:
        lines += _offered({"horizon": ("60", notes["horizon"])})
    lines += _links(tables)
    for one in tables.get("disturbance", ()):
        lines += ["", "# a disturbance, which is estimated and compensated", "[[disturbance]]"]
        lines += _table(one, _worded(DISTURBANCE, words))
    for table, what, about in (
        ("reference", "the set-points that the outputs follow", REFERENCE),
        ("limits", "limits of the outputs, whose probability of violation is computed", LIMITS),
    ):
        if table in tables:
            lines += ["", f"# {what}", f"[{table}]", *_table(tables[table], _worded(about, words))]
    if "controller" in tables:
        lines += ["", "# the controller to keep: u = −K y", "[controller]"]
        notes = _notes(ControllerKeys, words)
        lines += _table(tables["controller"], notes)
        lines += _offered(
            {"disturbance": ('"none"', notes["disturbance"])} if "disturbance" not in tables["controller"] else {}
        )
    lines += ["", *_comment(kind.about), "[policy]"]
    lines += _table(policy, kind.notes)
    lines += _offered(_optional(kind, policy, continuous))
    return "\n".join(lines) + "\n"


def _links(tables: Mapping[str, Any]) -> list[str]:
    """Return the lines of the network: its short form, or its nodes and links."""
    lines: list[str] = []
    if "network" in tables:
        lines += ["", "# the links between sensor, controller and actuator", "[network]"]
        lines += _table(tables["network"], NETWORK)
    for start, group, about in (("a node", "nodes", NODES), ("its link", "links", LINKS)):
        for name, keys in tables.get(group, {}).items():
            what = "the controller" if keys.get("controls") else start
            lines += ["", f"# {what}", f"[{group}.{name}]", *_table(keys, about)]
    return lines


def _notes(table: Any, words: Mapping[str, str]) -> dict[str, str]:
    """Return the notes on the keys of a table, which are metadata of their fields."""
    return _worded({name: key.note for name, key in keys_of(table).items()}, words)


def _worded(about: Mapping[str, str], words: Mapping[str, str]) -> dict[str, str]:
    return {name: note.format(**words) for name, note in about.items()}


def _table(table: Mapping[str, Any], about: Mapping[str, str]) -> list[str]:
    """Return the lines of a table, with each key below a comment that describes it."""
    lines: list[str] = []
    for key, value in table.items():
        lines += [*_comment(about.get(key, "")), f"{key} = {_value(value)}"]
    return lines


def _offered(keys: Mapping[str, tuple[str, str]]) -> list[str]:
    """Return optional keys that are not set, as comments."""
    return [line for key, (value, note) in keys.items() for line in [*_comment(note), f"# {key} = {value}"]]


def _optional(kind: Kind, given: Mapping[str, Any], continuous: bool) -> dict[str, tuple[str, str]]:
    """Return the optional parameters of a policy kind, with placeholders."""
    found: dict[str, tuple[str, str]] = {}
    for name, parameter in kind.parameters.items():
        if name not in given and (name != "period" or continuous):
            default: Any = parameter.default
            shown = "…" if default is None or default is parameter.empty else _value(default)
            found[name] = (shown, kind.notes.get(name, ""))
    return found


def _value(value: object) -> str:
    if isinstance(value, bool | str):
        return f'"{value}"' if isinstance(value, str) else str(value).lower()
    if isinstance(value, Mapping):
        entries = ", ".join(f"{key} = {_value(one)}" for key, one in cast("Mapping[str, object]", value).items())
        return f"{{{entries}}}"
    if isinstance(value, int | float):
        return exact_number_text(value)
    if isinstance(value, Sequence) and any(isinstance(one, Mapping) for one in cast("Sequence[object]", value)):
        entries = "".join(f"  {_value(one)},\n" for one in cast("Sequence[object]", value))
        return f"[\n{entries}]"
    return rows_text(np.asarray(cast("ArrayLike", value)))


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in wrap(text, WIDTH)]
