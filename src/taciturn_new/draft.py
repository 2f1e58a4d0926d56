"""An incomplete problem, which ``taciturn new`` or a script completes and writes as a problem file.

A ``Draft`` holds the matrices and tables that are known so far. Each new matrix is checked against the earlier ones by
making the plant and the cost as far as they are known: an unknown noise covariance is 0, and an unknown weight R is the
identity. The text of the file (``text``) is read back, and its policy is designed, before it is written.

Whether a policy kind fits is known from a quick check of plant and cost, which the record of the kind has. If the
problem has links with losses, nodes, disturbances, set-points or limits, the kind is designed for it as a check.

A required parameter may have a suggested value (``suggest_value``): a usual one, or one digit computed from plant
and cost. A period is a fifth of the fastest time constant of the controlled plant, and the price of a send is a fifth
of the cost of a step with every sample.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from taciturn.design.catalogue import CATALOGUE
from taciturn.design.kind import Kind, Setting
from taciturn.design.kinds.all_time import all_time
from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import Array, ArrayLike, Displayed, is_definite, number_of, pace, radius
from taciturn.lqg.riccati import regulate_continuous
from taciturn.model.controller import PID
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.problem import Problem, load, parse
from taciturn.problem.read import locate_functions
from taciturn_new.matrices import parse_matrix, square_matrix
from taciturn_new.text import problem_text

LOOKS = 5  # checks per time constant of the fastest mode of the controlled plant
SHARE = 0.2  # suggested price of a send, relative to the cost of a step with every sample


def needed_parameters(kind: Kind, continuous: bool) -> tuple[str, ...]:
    """Return the required parameters of a policy kind for a plant in discrete or in continuous time."""
    required = [name for name, one in kind.parameters.items() if one.default is one.empty]
    period = ["period"] if "period" in kind.parameters and (continuous or "period" in required) else []
    needed = (*period, *(name for name in required if name != "period"))
    tunings = {tuning.name: tuning for tuning in kind.tuning if tuning.continuous in (None, continuous)}
    met = {tunings[name].link for name in needed if name in tunings}
    return (*needed, *(name for name in kind.asked if tunings[name].link not in met))


def offered_kinds() -> tuple[list[Kind], list[str]]:
    """Return the policy kinds that ``taciturn new`` offers, by goal, and the errors of kinds that cannot be loaded."""
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


def suggest_value(
    kind: Kind, name: str, plant: Plant | ContinuousPlant, cost: Cost, period: float | None
) -> Setting | None:
    """Suggest a parameter value: a usual one, or one computed from plant and cost; None if there is no suggestion."""
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
    """Return an example of a policy kind: a built-in problem with this kind and its example parameters."""
    problem = load(kind.built_in)
    removed: dict[str, Any] = dict.fromkeys(problem.parameters)
    return problem.changed({**removed, "kind": kind.name, **kind.example})


COST = ("Q", "R", "N")
BY_CONTROLLER = {"weights": "as the controller"}


@dataclass(repr=False)
class Draft(Displayed):
    """An incomplete problem: the matrices of plant and cost that are given so far, and other tables of the file."""

    dt: float = 0.0  # seconds per step; 0 for a continuous-time plant
    # matrices A, B, E, C, D, V, W by name, in the order in which they were stored, and the limits of the inputs
    plant: dict[str, Array] = field(default_factory=lambda: {})
    cost: dict[str, Array] = field(default_factory=lambda: {})  # matrices Q, R, N by name
    network: dict[str, Any] = field(default_factory=lambda: {})  # values of the keys of ``[network]``
    nodes: dict[str, dict[str, Any]] = field(default_factory=lambda: {})  # those of ``[nodes.NAME]``
    links: dict[str, dict[str, Any]] = field(default_factory=lambda: {})  # those of ``[links.NAME]``
    controller: dict[str, Any] = field(default_factory=lambda: {})  # values of the keys of ``[controller]``
    disturbance: list[dict[str, Any]] = field(default_factory=lambda: [])  # those of each ``[[disturbance]]``
    reference: dict[str, Any] = field(default_factory=lambda: {})
    limits: dict[str, Any] = field(default_factory=lambda: {})
    operating_point: dict[str, Array] = field(default_factory=lambda: {})  # x and u from which A and B count; or 0

    @property
    def continuous(self) -> bool:
        """Whether the plant is a model in continuous time."""
        return self.dt == 0

    @property
    def counts(self) -> tuple[int, int]:
        """Numbers of inputs and of outputs of the plant."""
        plant = self.made_plant()
        return plant.inputs, len(plant.C)

    def keep(self, key: str, value: ArrayLike) -> None:
        """Store a matrix if its size is correct; a weight or covariance may be a number or a diagonal."""
        sizes = {} if "B" not in self.plant else self._sizes()
        fitting = square_matrix(key, value, sizes[key]) if key in sizes else np.asarray(value)
        if key in COST:
            self._cost({**self.cost, key: fitting})
            self.cost[key] = fitting
        else:
            self._plant({**self.plant, key: fitting})
            self.plant[key] = fitting

    def measure_all(self) -> None:
        """Set C to the identity matrix, so that every state is measured, and keep the measurement noise."""
        self.plant["C"] = np.eye(len(self.plant["A"]))

    def drop(self, key: str) -> None:
        """Remove a matrix of the plant from the draft."""
        self.plant.pop(key, None)

    def clear_parts(self) -> None:
        """Remove the network, the disturbances, the set-points and the limits from the draft."""
        tables = self.network, self.nodes, self.links, self.disturbance, self.reference, self.limits
        for table in (*tables, self.operating_point):
            table.clear()
        self.plant.pop("input_limit", None)

    def made_plant(self) -> Plant | ContinuousPlant:
        """Return the plant with the matrices given so far; a missing noise covariance is zero."""
        return self._plant(self.plant)

    def made_cost(self) -> Cost:
        """Return the cost with the weights given so far; a missing weight R is the identity matrix."""
        return self._cost(self.cost)

    def keep_pid(self, text: str, place: Mapping[str, int] | None = None) -> None:
        """Store a PID controller, given as the text of its gains: ``kp``, ``kp ki`` or ``kp ki kd filter``.

        ``place`` contains the numbers of the controller's input and output, if there are several controllers.
        """
        gains = parse_matrix("the controller", text.replace(",", " ")).ravel().tolist()
        if len(gains) not in (1, 2, 4):
            raise ProblemError(
                f"the controller has {number_of(len(gains), 'number')}; expected kp, or kp ki, or kp ki kd and the "
                "filter's time constant"
            )
        named = dict(zip(("kp", "ki", "kd", "filter"), gains, strict=False))
        PID(**named)
        self.controller["pid"] = [*self.controller.get("pid", ()), {**place, **named}] if place else named

    @property
    def remote(self) -> list[str]:
        """The nodes that are separate from the controller; among the default nodes, sensor and actuator."""
        if not self.nodes:
            return ["actuator", "sensor"]
        return [name for name, role in self.nodes.items() if not role.get("controls") and "site" not in role]

    @property
    def remote_sensors(self) -> bool:
        """Whether at least one node that measures is separate from the controller."""
        return any("measures" in self.nodes.get(name, {}) for name in self.remote)

    @property
    def loses(self) -> bool:
        """Whether links drop packets."""
        keys = [key for law in (self.network, *self.links.values()) for key in law]
        return any(key.endswith("loss") for key in keys)

    def fits(self, kind: Kind) -> bool:
        """Return whether a policy kind accepts this problem."""
        return self.refusal(kind) is None

    def refusal(self, kind: Kind) -> ProblemError | None:
        """Return the error that a policy kind raises for this problem; None if the kind accepts the problem."""
        try:
            if kind.nodes == "any" and not self.nodes:
                raise ProblemError(
                    f"the policy kind {kind.name!r} is for networks with named nodes; expected at least one wireless "
                    "sensor or actuator"
                )
            self.expect_fit(kind)
            if self._extended:
                self._designed(self.completed(kind, self._usual(kind)))
        except TaciturnError as error:
            return ProblemError(str(error).removeprefix(": "))  # of a problem without a name
        return None

    def takes_input_limits(self) -> bool:
        """Return whether a policy accepts input limits, judged by the parts that are given so far."""
        limited = replace(self, plant={**self.plant, "input_limit": np.tile([-1.0, 1.0], (self.counts[0], 1))})
        return any(limited.fits(kind) for kind in offered_kinds()[0])

    def expect_fit(self, kind: Kind) -> None:
        """Raise an error if a quick check shows that a policy kind cannot control this plant with this cost."""
        if self.controller and not kind.keeps_controller:
            raise ProblemError(
                f"the policy kind {kind.name!r} cannot use a controller of your own; expected another kind, such as "
                "'excess'"
            )
        if kind.check is not None:
            kind.check(self.made_plant(), self.made_cost())

    def completed(self, kind: Kind, policy: Mapping[str, Any]) -> dict[str, Any]:
        """Return all parameters of a policy, with usual values for those that ``taciturn new`` does not ask for."""
        given = {"kind": kind.name, **policy}
        if "link" in kind.parameters and self.nodes and all("measures" in self.nodes[name] for name in self.remote):
            given["link"] = "sensor"
        asked = (*needed_parameters(kind, self.continuous), *kind.asked)
        usual = given | {name: value for name, value in kind.usual.items() if name not in asked}
        if not self._extended and not self.controller:
            return usual
        try:
            self._designed(usual)
        except TaciturnError:  # usual values are for problems without further parts
            return given
        return usual

    def write(self, policy: Mapping[str, Any], path: Path) -> str:
        """Return the text of the problem file, after a test that it can be read and its policy can be designed."""
        text = problem_text(self._tables(policy), path.name)
        parse(locate_functions(tomllib.loads(text), path.parent), path.name).designed()
        return text

    @property
    def _extended(self) -> bool:
        """Whether the problem has more than a plant, a cost and a controller on ideal links of the usual nodes."""
        tables = self.network, self.nodes, self.disturbance, self.reference, self.limits
        return any(tables) or "input_limit" in self.plant

    def _tables(self, policy: Mapping[str, Any]) -> dict[str, Any]:
        step = {} if self.continuous else {"dt": self.dt}
        plant: dict[str, Any] = {**step, **self.plant}
        if self.operating_point:
            plant["operating_point"] = self.operating_point
        tables: dict[str, Any] = {"plant": plant, "cost": self.cost or BY_CONTROLLER, "policy": policy}
        for name in ("network", "nodes", "links", "controller", "disturbance", "reference", "limits"):
            if value := getattr(self, name):
                tables[name] = value
        return tables

    def _designed(self, policy: Mapping[str, Any]) -> None:
        """Design a policy for the problem, to see whether that fails."""
        parse(tomllib.loads(problem_text(self._tables(policy), "")), "").designed()

    def _usual(self, kind: Kind) -> dict[str, Any]:
        """Return values of the parameters that ``new`` asks for: suggested ones, or those of the kind's example."""
        policy: dict[str, Any] = {}
        plant, cost = self.made_plant(), self.made_cost()
        for name in needed_parameters(kind, self.continuous):
            found = suggest_value(kind, name, plant, cost, policy.get("period"))
            policy[name] = kind.example.get(name, 1.0) if found is None else found
        return policy

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
