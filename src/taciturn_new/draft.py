"""A problem under construction, and the text of its file, as ``taciturn new`` and scripts write it.

A ``Draft`` holds the matrices that are known so far. Each new part is checked against the earlier parts by making the
plant and the cost as far as they are known: an unknown noise covariance is 0, and an unknown weight R is the identity.

A required parameter may have a suggested value (``suggest_value``): a usual one, or one digit computed from plant
and cost. A period is a fifth of the fastest time constant of the controlled plant, and the price of a send is a fifth
of the cost of a step with every sample.

The text (``problem_text``) has every key below a comment that describes it, and optional keys as comments. It is read
back, and its policy is designed, before it is written.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from textwrap import wrap
from typing import Any, cast

import numpy as np

from taciturn.design.catalogue import CATALOGUE
from taciturn.design.kind import Kind, Setting
from taciturn.design.kinds.all_time import all_time
from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import Array, ArrayLike, Displayed, is_definite, pace, radius
from taciturn.lqg.riccati import regulate_continuous
from taciturn.model.controller import PID
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.problem import Problem, load, parse
from taciturn.problem.parameters import find_kind
from taciturn.problem.schema import ControllerKeys, CostKeys, PlantKeys, keys_of
from taciturn_new.matrices import exact_number_text, matrix_text, parse_matrix, square_matrix

LOOKS = 5  # checks per time constant of the fastest mode of the controlled plant
SHARE = 0.2  # suggested price of a send, relative to the cost of a step with every sample


def needed_parameters(kind: Kind, continuous: bool) -> tuple[str, ...]:
    """Return the required parameters of a policy kind for a discrete or continuous plant."""
    required = [name for name, one in kind.parameters.items() if one.default is one.empty]
    period = ["period"] if "period" in kind.parameters and (continuous or "period" in required) else []
    needed = (*period, *(name for name in required if name != "period"))
    tunings = {tuning.name: tuning for tuning in kind.tuning if tuning.continuous in (None, continuous)}
    met = {tunings[name].link for name in needed if name in tunings}
    return (*needed, *(name for name in kind.asked if tunings[name].link not in met))


def offered_kinds() -> tuple[list[Kind], list[str]]:
    """Return the kinds that ``taciturn new`` offers by their goals, in order, and why others cannot be offered."""
    found: list[tuple[int, Kind]] = []
    wrong: list[str] = []
    for name in CATALOGUE:
        try:
            kind = CATALOGUE[name]
        except ProblemError as error:
            wrong.append(str(error))
        else:
            found += [] if kind.offered is None else [(kind.offered, kind)]
    return [kind for _, kind in sorted(found, key=lambda one: (one[0], one[1].name))], wrong


def over_losses() -> list[Kind]:
    """Return the offered kinds for links that drop packets."""
    return [kind for kind in offered_kinds()[0] if kind.for_dropouts]


def suggest_value(
    kind: Kind, name: str, plant: Plant | ContinuousPlant, cost: Cost, period: float | None
) -> Setting | None:
    """Return a suggested value: a usual value, or one digit computed from plant and cost; None if there is none."""
    if name in kind.usual:
        return kind.usual[name]
    try:
        if name == "period" and isinstance(plant, ContinuousPlant):
            fastest = pace(plant.A)
            if is_definite(cost.R):  # otherwise the loop is as fast as the period allows
                L = regulate_continuous(plant.A, plant.B, cost.Q, cost.R, cost.N).L
                fastest = radius(plant.A + plant.B @ L)
            return _digit(1 / (LOOKS * fastest)) if fastest > 0 else None
        if name in ("price", "zeta"):
            always = all_time(plant, cost, period=period)
            return _digit(SHARE * always.cost_all_time * always.tick) if always.cost_all_time > 0 else None
    except TaciturnError:  # the design reports the error
        return None
    return None


def _digit(value: float) -> float:
    """Return a number rounded to one significant digit."""
    return float(f"{value:.1g}")


def example_of(kind: Kind) -> Problem:
    """Return the example of a policy kind: a built-in problem with this kind and the parameters of the example."""
    problem = load(kind.built_in)
    removed: dict[str, Any] = dict.fromkeys(problem.parameters)
    return problem.changed({**removed, "kind": kind.name, **kind.example})


WIDTH = 98  # characters of a comment line
# what the notes of keys say of the time base
CONTINUOUS = {"per": "per second", "noise": "intensity per second", "moved": "the derivative of the state"}
DISCRETE = {"per": "per step", "noise": "covariance per step", "moved": "the next state"}


def problem_text(tables: Mapping[str, Any], name: str) -> str:
    """Return a problem file with its comments."""
    plant, policy = tables["plant"], tables["policy"]
    kind = find_kind(policy["kind"], "the kind")
    continuous = "dt" not in plant
    words = CONTINUOUS if continuous else DISCRETE
    rule = f"{'E ' if 'E' in plant else ''}{'dx/dt' if continuous else 'x⁺'} = A x + B u + w"
    fed = " + D u, u of the step before" if "D" in plant else ""
    measured = f",  y = C x + v{fed}" if "C" in plant else ",  y = x: the full state is measured"
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
    notes = _notes(PlantKeys, words)
    lines += _table(plant, notes)
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
        notes = _notes(ControllerKeys, words)
        lines += _table(tables["controller"], notes)
        lines += _offered({"disturbance": ('"none"', notes["disturbance"])})
    lines += ["", *_comment(kind.about), "[policy]"]
    lines += _table(policy, kind.notes)
    lines += _offered(_optional(kind, policy, continuous))
    return "\n".join(lines) + "\n"


def _notes(table: Any, words: Mapping[str, str]) -> dict[str, str]:
    """Return the notes on the keys of a table, which are metadata of their fields."""
    return {name: key.note.format(**words) for name, key in keys_of(table).items()}


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


COST = ("Q", "R", "N")
BY_CONTROLLER = {"weights": "as the controller"}


@dataclass(repr=False)
class Draft(Displayed):
    """A partly specified problem: the known matrices of a plant and a cost, a network and a controller."""

    dt: float = 0.0  # seconds per step; 0 for a continuous-time plant
    # matrices A, B, E, C, D, V, W by name, in the order in which they were stored
    plant: dict[str, Array] = field(default_factory=lambda: {})
    cost: dict[str, Array] = field(default_factory=lambda: {})  # matrices Q, R, N by name
    network: dict[str, Any] = field(default_factory=lambda: {})  # values of the keys of ``[network]``
    controller: dict[str, Any] = field(default_factory=lambda: {})  # values of the keys of ``[controller]``

    @property
    def continuous(self) -> bool:
        """True if the plant is continuous in time."""
        return self.dt == 0

    @property
    def counts(self) -> tuple[int, int]:
        """The numbers of inputs and outputs of the plant."""
        plant = self.made_plant()
        return plant.inputs, len(plant.C)

    def keep(self, key: str, value: ArrayLike) -> None:
        """Store a matrix if it fits the known parts; a weight or covariance may be one number or a diagonal."""
        sizes = {} if "B" not in self.plant else self._sizes()
        fitting = square_matrix(key, value, sizes[key]) if key in sizes else np.asarray(value)
        if key in COST:
            self._cost({**self.cost, key: fitting})
            self.cost[key] = fitting
        else:
            self._plant({**self.plant, key: fitting})
            self.plant[key] = fitting

    def measure_all(self) -> None:
        """Set C to the identity, so that every state is measured; the measurement noise is stored separately."""
        self.plant["C"] = np.eye(len(self.plant["A"]))

    def drop(self, key: str) -> None:
        """Remove a matrix of the plant."""
        self.plant.pop(key, None)

    def made_plant(self) -> Plant | ContinuousPlant:
        """Return the plant as far as it is known; unknown noise is zero."""
        return self._plant(self.plant)

    def made_cost(self) -> Cost:
        """Return the cost as far as it is known; an unknown weight R is the identity."""
        return self._cost(self.cost)

    def keep_pid(self, text: str) -> None:
        """Store a PID controller from the text of its gains, ``kp``, ``kp ki`` or ``kp ki kd filter``."""
        inputs, outputs = self.counts
        if (inputs, outputs) != (1, 1):
            raise ProblemError(
                f"the plant has {inputs} inputs and {outputs} outputs; expected one of each, or [controller] in the "
                "file with one PID controller per input"
            )
        gains = parse_matrix("the controller", text.replace(",", " ")).ravel().tolist()
        if len(gains) not in (1, 2, 4):
            raise ProblemError(
                f"the controller has {len(gains)} numbers; expected kp, or kp ki, or kp ki kd and the filter's time "
                "constant"
            )
        self.controller["pid"] = dict(zip(("kp", "ki", "kd", "filter"), gains, strict=False))
        PID(**self.controller["pid"])

    def fits(self, kind: Kind) -> bool:
        """Return whether a policy kind accepts this plant and cost, according to a quick check."""
        try:
            self.expect_fit(kind)
        except ProblemError:
            return False
        return True

    def expect_fit(self, kind: Kind) -> None:
        """Reject a policy kind that does not accept this plant and cost, according to a quick check."""
        if self.controller and not kind.keeps_controller:
            raise ProblemError(f"{kind.name} keeps no controller; expected another kind, such as excess")
        if kind.check is not None:
            kind.check(self.made_plant(), self.made_cost())

    def write(self, policy: Mapping[str, Any], name: str) -> str:
        """Return the text of a problem file, after reading it back and designing its policy as a check."""
        step = {} if self.continuous else {"dt": self.dt}
        tables: dict[str, Any] = {"plant": {**step, **self.plant}, "cost": self.cost or BY_CONTROLLER, "policy": policy}
        if self.network:
            tables["network"] = self.network
        if self.controller:
            tables["controller"] = self.controller
        text = problem_text(tables, name)
        parse(tomllib.loads(text), name).designed()
        return text

    def _sizes(self) -> dict[str, int]:
        """Return the number of rows of each square matrix by name."""
        states, inputs = self.plant["B"].shape
        return {"W": states, "Q": states, "R": inputs, "V": len(self.plant["C"]) if "C" in self.plant else states}

    def _plant(self, known: Mapping[str, Array]) -> Plant | ContinuousPlant:
        A, C, V, D, E = known["A"], *(known.get(name) for name in "CVDE")
        B, W = known.get("B", np.eye(len(A))), known.get("W", np.zeros((len(A), len(A))))
        if self.continuous:
            return ContinuousPlant(A, B, W, C=C, V=V, D=D, E=E)
        return Plant(A, B, W, C, V, self.dt, D=D, E=E)

    def _cost(self, known: Mapping[str, Array]) -> Cost:
        if not known and self.controller:  # weights by the controller's loop: here only outputs and inputs
            C = self.made_plant().C
            return Cost(C.T @ C, np.eye(self.plant["B"].shape[1]))
        return Cost(known["Q"], known.get("R", np.eye(self.plant["B"].shape[1])), known.get("N"))
