"""The text of problem files: every key below a comment that describes it, and optional keys as comments."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import wrap
from typing import Any, cast

import numpy as np

from taciturn.design.kind import Kind
from taciturn.problem.matrices import exact_number_text, matrix_text
from taciturn.problem.parameters import find_kind

WIDTH = 98  # characters of a comment line
PER = {True: "per second", False: "per step"}


def problem_text(tables: Mapping[str, Any], name: str) -> str:
    """Return a problem file with its comments.

    Args:
        tables: the tables plant, cost, policy and, optionally, network and controller of the file.
        name: name of the file, for the commands in its first lines.

    Returns:
        The text of the file in TOML, with exactly the given tables.
    """
    plant, policy = tables["plant"], tables["policy"]
    kind = find_kind(policy["kind"], "the kind")
    continuous = "dt" not in plant
    per = PER[continuous]
    rule = f"{'E ' if 'E' in plant else ''}{'dx/dt' if continuous else 'x⁺'} = A x + B u + w"
    fed = " + D u, u of the step before" if "D" in plant else ""
    measured = f",  y = C x + v{fed}" if "C" in plant else ",  y = x: the full state is measured"
    noise = "intensity per second" if continuous else "covariance per step"
    sizes = (len(plant["A"]), len(plant["B"][0]))
    states, inputs = (
        f"{count} {word}{'s' * (count > 1)}" for count, word in zip(sizes, ("state", "input"), strict=True)
    )
    lines = [
        f"# A problem of event-triggered control: {states}, {inputs}. Units of time are seconds.",
        f"#   taciturn show {name}",
        f"#   taciturn evaluate {name}",
        "",
        f"# {rule}{measured}",
        "[plant]",
    ]
    about = {
        "dt": "seconds per step; without this key the plant is continuous in time",
        "A": f"dynamics, {per}",
        "B": f"effect of the inputs, {per}",
        "E": "matrix of the derivative of the state" if continuous else "matrix of the next state",
        "C": "output matrix",
        "D": "direct feedthrough of the input of the step before, as each sample is taken before the input changes",
        "W": f"noise w: {noise}, in the units of the states squared",
        "V": "measurement noise v: covariance per sample, in the units of the outputs squared",
    }
    lines += _table(plant, about)
    lines += _offered(
        {"input_limit": ("[…]", "largest size of each input, or [low, high]; with a limit, no guarantee is shown")}
    )
    lines += ["", f"# x'Qx + u'Ru{' + 2 x' + chr(39) + 'Nu' if 'N' in tables['cost'] else ''} {per}", "[cost]"]
    about = {
        "Q": "weight of the state",
        "R": "weight of the input",
        "N": "cross weight",
        "weights": "equal weight for the present variances of outputs and inputs; or Q and R",
    }
    lines += _table(tables["cost"], about)
    if "controller" in tables and "Q" in tables["cost"]:
        lines += _offered(
            {"weights": ('"as the controller"', "in place of Q and R: equal weight for present variances")}
        )
    if "horizon" in kind.costs:
        lines += _offered({"horizon": ("60", "steps of a finite-horizon run; without this key the cost is an average")})
    if "network" in tables:
        lines += ["", "# the links between sensor, controller and actuator", "[network]"]
        about = {
            "protocol": '"udp": dropouts without acknowledgement; "tcp": with acknowledgement; "ideal": no dropouts',
            "actuator_loss": "probability that a packet to the actuator is lost",
            "sensor_loss": "probability that a measurement is lost",
            "delay": "steps from a measurement to the input that uses it: 0 or 1",
        }
        lines += _table(tables["network"], about)
    if "controller" in tables:
        lines += ["", "# the controller to keep: u = −K y", "[controller]"]
        lines += _table(
            tables["controller"], {"pid": "gains; ki per second, kd and the filter's time constant in seconds"}
        )
        lines += _offered({"disturbance": ('"none"', "slow disturbance at each input, which an integral compensates")})
    lines += ["", *_comment(kind.about), "[policy]"]
    lines += _table(policy, kind.notes)
    lines += _offered(_optional(kind, policy, continuous))
    return "\n".join(lines) + "\n"


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
    return matrix_text(np.asarray(value))


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in wrap(text, WIDTH)]
