"""The missions of the robots as problem files: identified model, cost, network and policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, number, number_of
from taciturn.model.packets import roles
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.model.steps import Send
from taciturn.problem import Problem
from taciturn_twins.catalogue import reference
from taciturn_twins.identification import Identification
from taciturn_twins.robot import Robot

ALL_TIME: Mapping[str, Mapping[str, float]] = {  # parameters at which a policy sends every sample
    "remote-lqg": {"theta": 0.0, "zeta": 0.0},
    "lossy-lqg": {"price": 0.0},
}


@dataclass(frozen=True, repr=False)
class Mission(Displayed):
    """The mission of a robot: a finite-horizon control problem with a policy.

    Args:
        cost: table ``cost`` of the problem file.
        network: table ``network`` of the problem file.
        policy: table ``policy`` of the problem file.
        parameter: tuning parameter of the policy, with its range on the live page.
        meaning: description of the parameter, with its unit.
    """

    cost: Mapping[str, Any] = field(hash=False)
    network: Mapping[str, Any] = field(hash=False)
    policy: Mapping[str, Any] = field(hash=False)
    parameter: tuple[str, float, float]
    meaning: str

    @property
    def ticks(self) -> int:
        """Number of steps."""
        return int(self.cost["horizon"])


THESIS: Mapping[str, tuple[str, ...]] = {  # results that the thesis prints
    "rover": ("80 % and 90 % fewer packets; cost 127.85, every sample 116.47 (simulated: 113.15 and 103.66)",),
    "omni": ("only a plot, without numbers: J < J_all for λ = 0, 0.001, 0.002, 0.01",),
}
_UNIT = np.eye(3).tolist()
MISSIONS: Mapping[str, Mission] = {
    "rover": Mission(
        {"Q": [[10.0]], "R": [[0.003]], "terminal": [[200.0]], "horizon": 60},
        {},
        {"kind": "remote-lqg", "theta": 0.5, "zeta": 0.004},
        ("theta", 0.0, 2.0),
        "theta is the permitted relative increase of the cost (no unit); a higher theta means fewer motor packets",
    ),
    "omni": Mission(
        {"Q": _UNIT, "R": _UNIT, "terminal": _UNIT, "horizon": 250},
        {"protocol": "udp", "actuator_loss": 0.1, "sensor_loss": 0.25, "delay": 1},
        {"kind": "lossy-lqg", "price": 0.01},
        ("price", 0.0, 0.05),
        "price per packet to the motors, in units of the cost; a higher price means fewer packets",
    ),
}


def check_parameters(robot: Robot, parameters: Mapping[str, float]) -> None:
    """Raise an error if a parameter of the policy is unknown or out of range.

    Raises:
        ProblemError: the policy of the robot's mission has no such parameter, or a value is negative.
    """
    known = [key for key in MISSIONS[robot.name].policy if key != "kind"]
    for name, value in parameters.items():
        if name not in known:
            raise ProblemError(
                f"the policy of the robot {robot.name} has no parameter {name}; expected {' or '.join(known)}"
            )
        number(name, value, 0.0, closed=True)


def tables_of(robot: Robot, found: Identification, parameters: Mapping[str, float]) -> dict[str, Any]:
    """Return the tables of a robot's problem file, with the identified model and A = I (an integrator).

    Args:
        robot: the robot.
        found: identified model.
        parameters: policy parameters that replace those of the mission.

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
    else:  # reference states of the identified model for the nominal inputs
        inputs = np.linalg.solve(found.B, np.diff(followed, axis=0).T).T
        states = np.vstack([followed[:1], followed[0] + np.cumsum(inputs @ found.B.T, axis=0)])
        tables["reference"] = {"states": states.tolist(), "inputs": inputs.tolist()}
    return {**tables, "policy": {**mission.policy, **parameters}}


def all_time(problem: Problem) -> Problem:
    """Return the problem with those policy parameters with which the policy sends every sample.

    Raises:
        ProblemError: robots cannot run this kind of policy.
    """
    if problem.kind not in ALL_TIME:
        raise ProblemError(
            f"the policy is {problem.kind}, which the robots cannot run; expected {' or '.join(ALL_TIME)}: policies "
            "with a finite horizon that request pictures"
        )
    return problem.changed(dict(ALL_TIME[problem.kind]))


def check_mission(robot: Robot, problem: Problem, name: str) -> Policy:
    """Raise an error if a robot cannot run a problem; otherwise return the policy of the problem.

    Raises:
        ProblemError: the problem has another plant, no horizon, or a policy that robots cannot run.
    """
    plant, n, m = problem.plant, len(robot.states), len(robot.inputs)
    if isinstance(plant, ContinuousPlant):
        raise ProblemError(
            f"the plant of {name} is continuous in time; expected dt = {robot.tick:g}, as for the robot {robot.name}"
        )
    sizes = zip((plant.states, plant.inputs, plant.outputs), ("state", "input", "output"), strict=True)
    found = f"{', '.join(number_of(*size) for size in sizes)} and dt = {plant.dt}"
    if (plant.states, plant.inputs, plant.outputs, plant.dt) != (n, m, n, robot.tick):
        raise ProblemError(
            f"the plant of {name} is not that of the robot {robot.name}: it has {found}; expected "
            f"{number_of(n, 'state')}, {number_of(m, 'input')}, {number_of(n, 'output')} and dt = {robot.tick:g}"
        )
    if not np.array_equal(plant.C, np.eye(n)):
        raise ProblemError(
            f"the matrix C of {name} is not the identity matrix; expected no C: the camera measures "
            f"{', '.join(robot.states)}"
        )
    if problem.cost.horizon is None:
        raise ProblemError(
            f"the problem {name} has no cost.horizon; expected a horizon, since the mission of a robot is finite"
        )
    all_time(problem)
    policy = problem.design()
    if len(roles(policy)) < 3 or {step.link for step in policy.steps if isinstance(step, Send)} != {
        "sensor",
        "actuator",
    }:
        raise ProblemError(
            f"the policy of {name} has two nodes at the same site, or does not use a link; expected separate sensor, "
            "controller and actuator: a camera, a control unit and a robot"
        )
    return policy


def write_toml(tables: Mapping[str, Any], prefix: str = "") -> str:
    """Return the text of a problem file with the given tables, in which numbers have all their digits."""
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
