"""What the robots are to do, as problem files: a model that was identified, a cost, a network, a policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from taciturn._arrays import number
from taciturn.errors import ProblemError
from taciturn.model.places import roles
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy, Send
from taciturn.problem import Problem
from taciturn.twin.catalogue import reference
from taciturn.twin.identification import Identification
from taciturn.twin.robot import Robot

ALL_TIME: Mapping[str, Mapping[str, float]] = {  # what a policy is when it sends at every step
    "remote-lqg": {"theta": 0.0, "zeta": 0.0},
    "lossy-lqg": {"price": 0.0},
}


@dataclass(frozen=True)
class Mission:
    """What a robot is to do, and under which policy.

    Args:
        cost: table of the problem file.
        network: table of the problem file.
        policy: table of the problem file.
        knob: parameter of the policy that trades cost for sends, with its range.
    """

    cost: Mapping[str, Any]
    network: Mapping[str, Any]
    policy: Mapping[str, Any]
    knob: tuple[str, float, float]

    @property
    def ticks(self) -> int:
        """Of the mission."""
        return int(self.cost["horizon"])


THESIS: Mapping[str, tuple[str, ...]] = {  # what it prints of its experiments
    "rover": ("80 % and 90 % less; cost 127.85 against 116.47 all-time (simulated there: 113.15 against 103.66)",),
    "omni": ("a picture without numbers: J below J_all at λ of 0, 0.001, 0.002 and 0.01",),
}
_UNIT = np.eye(3).tolist()
MISSIONS: Mapping[str, Mission] = {
    "rover": Mission(
        {"Q": [[10.0]], "R": [[0.003]], "terminal": [[200.0]], "horizon": 60},
        {},
        {"kind": "remote-lqg", "theta": 0.5, "zeta": 0.004},
        ("theta", 0.0, 2.0),
    ),
    "omni": Mission(
        {"Q": _UNIT, "R": _UNIT, "terminal": _UNIT, "horizon": 250},
        {"protocol": "udp", "actuator_loss": 0.1, "sensor_loss": 0.25, "delay": 1},
        {"kind": "lossy-lqg", "price": 0.01},
        ("price", 0.0, 0.05),
    ),
}


def check_parameters(robot: Robot, parameters: Mapping[str, float]) -> None:
    """Refuse parameters that the policy of a robot's mission does not have, or out of their range.

    Raises:
        ProblemError: there are such.
    """
    known = [key for key in MISSIONS[robot.name].policy if key != "kind"]
    for name, value in parameters.items():
        if name not in known:
            raise ProblemError(f"the policy of the {robot.name} has no {name}; expected {' or '.join(known)}")
        number(name, value, 0.0, closed=True)


def tables_of(robot: Robot, found: Identification, parameters: Mapping[str, float]) -> dict[str, Any]:
    """Return the tables of a robot's problem file: the model is the identified one, A = I as of an integrator.

    Args:
        robot: which one.
        found: by the experiment.
        parameters: of the policy, that replace those of the mission.

    Raises:
        ProblemError: the policy has no such parameter.
    """
    check_parameters(robot, parameters)
    mission, n = MISSIONS[robot.name], len(robot.states)
    followed = reference(robot)
    plant: dict[str, Any] = {
        "A": np.eye(n).tolist(),
        "B": found.B.tolist(),
        "W": found.W.tolist(),
        "dt": robot.tick,
        "initial": {"mean": list(robot.start) if followed is None else followed[0].tolist()},
    }
    tables: dict[str, Any] = {"plant": plant, "cost": dict(mission.cost)}
    if mission.network:
        tables["network"] = dict(mission.network)
    if followed is None:
        plant |= {"C": np.eye(n).tolist(), "V": found.V.tolist()}
    else:  # the states are those that the identified model goes through
        inputs = np.linalg.solve(found.B, np.diff(followed, axis=0).T).T
        states = np.vstack([followed[:1], followed[0] + np.cumsum(inputs @ found.B.T, axis=0)])
        tables["reference"] = {"states": states.tolist(), "inputs": inputs.tolist()}
    return {**tables, "policy": {**mission.policy, **parameters}}


def all_time(problem: Problem) -> Problem:
    """Return the problem with the policy that its own is when silence is worth nothing.

    Raises:
        ProblemError: it is of a kind that no robot runs.
    """
    if problem.kind not in ALL_TIME:
        raise ProblemError(
            f"the policy is {problem.kind}, which is nothing for a camera that is asked over a network and a mission "
            f"that ends; expected {' or '.join(ALL_TIME)}"
        )
    return problem.changed(dict(ALL_TIME[problem.kind]))


def check_mission(robot: Robot, problem: Problem, name: str) -> Policy:
    """Return the policy of a problem that a robot is to run.

    Raises:
        ProblemError: it is one for another plant.
    """
    plant, n, m = problem.plant, len(robot.states), len(robot.inputs)
    if isinstance(plant, ContinuousPlant):
        raise ProblemError(
            f"the plant of {name} is continuous in time; expected dt = {robot.tick:g}, as of the {robot.name}"
        )
    found = f"{plant.states} states, {plant.inputs} inputs, {plant.outputs} outputs and dt = {plant.dt}"
    if (plant.states, plant.inputs, plant.outputs, plant.dt) != (n, m, n, robot.tick):
        raise ProblemError(
            f"{name} is for another plant than the {robot.name}: it has {found}; expected {n} states, {m} inputs, "
            f"{n} outputs and dt = {robot.tick:g}"
        )
    if not np.array_equal(plant.C, np.eye(n)):
        raise ProblemError(
            f"{name} has a C that is not I; expected none: the camera measures {', '.join(robot.states)}"
        )
    if problem.cost.horizon is None:
        raise ProblemError(f"{name} has no cost.horizon; expected one: the mission of a robot ends")
    all_time(problem)
    policy = problem.design()
    if len(roles(policy)) < 3 or {step.link for step in policy.steps if isinstance(step, Send)} != {
        "sensor",
        "actuator",
    }:
        raise ProblemError(
            f"the policy of {name} has two of its nodes in one place, or a link that it does not use; expected sensor, "
            "controller and actuator apart: a camera, a control unit and a robot"
        )
    return policy


def write_toml(tables: Mapping[str, Any], prefix: str = "") -> str:
    """Return tables as the text of a problem file, all digits of its numbers kept."""
    lines = [f"{key} = {_written(value)}" for key, value in tables.items() if not isinstance(value, Mapping)]
    for key, value in tables.items():
        if isinstance(value, Mapping):
            lines += ["", f"[{prefix}{key}]", write_toml(cast("Mapping[str, Any]", value), f"{prefix}{key}.")]
    return "\n".join(lines).strip() + "\n"


def _written(value: object) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list):
        return f"[{', '.join(_written(entry) for entry in cast('list[object]', value))}]"
    return repr(value)
