"""Convert plants, policies and loops to systems of python-control, and such systems to plants.

No other module imports python-control, an optional dependency. A linear plant becomes a ``StateSpace``. A policy or a
loop becomes a ``NonlinearIOSystem`` whose state holds the memories of its program and the number of the step, and whose
functions run one step of the program (``together.StepFunction``): the numbers are those of the nodes, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, ArrayLike, instance
from taciturn.loop import Loop
from taciturn.lqg.registers import registered, registers_of
from taciturn.model.coverage import LOADS, PLANTS, POINT, Coverage
from taciturn.model.dynamics import Dynamics
from taciturn.model.names import Names, Role, unit_of
from taciturn.model.network import REFERENCE, Network
from taciturn.model.noise import Noise
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.state_space import plant_from
from taciturn.nodes.node import Values
from taciturn.nodes.together import Nodes, StepFunction
from taciturn.program.all_nodes import translate_policy
from taciturn.program.ops import Entry, Sent

_NAMES = {"applied": "u", REFERENCE: "setpoint"}  # of signals in python-control
_ROLES: Mapping[str, Role] = {"x": "states", "u": "inputs", "applied": "inputs", "y": "outputs"}
_CONVERTED = Coverage(PLANTS - POINT - LOADS, "systems of python-control do not model")


def to_control(
    thing: Plant | ContinuousPlant | Policy | Loop,
    network: Network | None = None,
    seed: int = 0,
    sent: bool = True,
    names: Names | None = None,
) -> Any:
    """Convert a plant, a policy or a loop to a system of python-control.

    | converted object | result | inputs | outputs | dt |
    |---|---|---|---|---|
    | linear plant | `StateSpace` | u | y | dt of the plant; True if unspecified; 0 for a continuous plant |
    | nonlinear plant | `NonlinearIOSystem` | u | y | the same |
    | policy | `NonlinearIOSystem` | y | u, sent | dt of the (sampled) plant of the design |
    | loop | `NonlinearIOSystem` | w, v | y, u, sent | dt of its (sampled) plant |

    Signals are named ``u[0]``, ``y[0]``, and so on, or by ``names``, without units. For each link whose rate the policy
    decides, ``sent_actuator`` or ``sent_sensor`` is 1 in each step in which a packet is sent on the link. In a loop,
    x⁺ = A x + B u + w or x⁺ = f(x, u, w), and y = C x + v.

    Set-points that change are inputs ``setpoint[i]`` of a policy. In a loop they are outputs and the last states of the
    plant, which w moves; the last entries of v add to them.

    If a discrete plant has a direct feedthrough, inputs of the step before are states of its system, after the others.
    The system of a continuous plant has the matrix D.

    The system of a plant excludes its noise, disturbances, set-points, initial state and limits of inputs. The output u
    of a policy or loop is clipped. If an actuator predicts between steps, u is the state of its model at the beginning
    of the step, as in ``policy.model``.

    The state of a policy consists of the stored values of its nodes and, as last entry, the number of the step. At
    step 0 the stored values are replaced by their correct start values, so the default initial state 0 of
    python-control is always valid. The state of a loop begins with the plant state x; ``X0=[loop.problem.plant.mean,
    0]`` starts the plant at its mean.

    Args:
        thing: plant, policy or loop; a continuous plant of a loop is sampled.
        network: network between the nodes of a policy; default: the network of the design.
        seed: seed of packet drops and of a policy's random draws; the draws of a step depend only on seed and step.
        sent: whether the system has the outputs ``sent_…`` in addition to the input.
        names: names of the states of a plant, and of inputs and outputs, such as ``names`` of a plant or a problem.

    Returns:
        The system, named ``plant``, ``loop``, or by the kind of the policy.

    Raises:
        InformationError: a node of the policy uses a value that is not available to it over the network.
        ProblemError: python-control is missing, ``thing`` has another type, or a network is given without a policy.

    Example:
        >>> import taciturn
        >>> system = to_control(taciturn.load("two-mass").design())
        >>> system.input_labels, system.output_labels, system.dt
        (['y[0]', 'y[1]'], ['u[0]', 'sent_actuator'], 0.1)
    """
    instance("thing", thing, Plant, ContinuousPlant, Policy, Loop)
    if network is not None and not isinstance(thing, Policy):
        raise ProblemError(
            f"network is given for a {type(thing).__name__}; expected this argument only for a Policy: pass the "
            "network of a loop to `close`"
        )
    if isinstance(thing, Plant | ContinuousPlant):
        _CONVERTED.check(thing)
    named = _Named(names or Names())
    if isinstance(thing, ContinuousPlant):
        D = 0 if thing.D is None else thing.D
        return _control().StateSpace(thing.A, thing.B, thing.C, D, 0, name="plant", **named.of_plant(thing))
    if isinstance(thing, Plant) and thing.D is not None:
        thing = registered(thing, thing, registers_of(thing, 1.0))
    if isinstance(thing, Plant) and thing.function is not None:
        return _moving(thing, thing.function, named)
    if isinstance(thing, Plant):
        return _control().StateSpace(
            thing.A, thing.B, thing.C, 0, _step(thing), name="plant", **named.of_plant(thing)
        )  # fmt: skip
    if isinstance(thing, Policy):
        nodes, plant, links = Nodes(thing, network, seed), thing.model, thing.scheduled
        if len(nodes.cuts) > 1:
            raise ProblemError(
                f"packets on the link {' and '.join(nodes.network.late)} arrive at random within a period, and a "
                "system of python-control has one input in each step; expected delays of whole periods, or a buffer"
            )
        taken = {"y": plant.sensed, REFERENCE: plant.set_points}
        turns = StepFunction(translate_policy(nodes.policy, nodes.network), taken, nodes.network, seed)
        return _system(turns, taken, {"applied": plant.inputs}, links if sent else (), plant, thing.kind, named)
    thing = thing.in_units
    plant, links = thing.problem.plant, thing.policy.scheduled
    taken = {"w": plant.states, "v": plant.outputs}
    shown = {"y": plant.sensed, REFERENCE: plant.set_points, "applied": plant.inputs}
    turns = StepFunction(replace(thing, precision="float64").open_program(), taken, thing.network, seed)
    return _system(turns, taken, shown, links if sent else (), plant, "loop", named, plant.states)


def from_control(
    system: object,
    W: ArrayLike | None = None,
    V: ArrayLike | None = None,
    mean: ArrayLike | None = None,
    covariance: ArrayLike | None = None,
    input_limit: ArrayLike | None = None,
    input_rate: ArrayLike | None = None,
    noise: Noise | None = None,
) -> Plant | ContinuousPlant:
    """Convert a linear system of python-control to a plant; ``plant_from`` also accepts systems of scipy.

    A feedthrough D is read as that of the input in the step before, y_k = C x_k + D û_{k−1}: a sensor samples before
    the input changes. The result is a ContinuousPlant if dt = 0, and otherwise a Plant. If dt is True, the ``dt`` of
    the plant is None. Labels of the system are the names of the plant, unless they are those that python-control gives.

    Args:
        system: a `control.StateSpace`, or a `control.TransferFunction`, for which a realisation is computed.
        W: process noise, (n, n): covariance per step, or intensity per second. The states of a realisation depend on
            python-control, so state the noise of a transfer function by ``noise``.
        V: measurement-noise covariance, (p, p); default: exact measurement.
        mean: initial mean, (n,); default: 0.
        covariance: initial covariance, (n, n); default: 0.
        input_limit: limits of each input: a positive number, or a pair [low, high]; default: no limit.
        input_rate: largest change of each input, per second if dt = 0, and otherwise per step; default: no limit.
        noise: amplitudes of noise at the inputs in place of W, and at the outputs in place of V.

    Returns:
        The plant.

    Raises:
        ProblemError: python-control is missing, the system has another type, dt is None, or the plant cannot be
            controlled.

    Example:
        >>> import control
        >>> from_control(control.ss([[2.0]], [[1.0]], [[1.0]], [[0.0]], dt=0.1), W=[[1.0]]).dt
        0.1
    """
    control = _control()
    if not isinstance(system, (control.StateSpace, control.TransferFunction)):
        raise ProblemError(
            f"system is a {type(system).__name__}; expected a control.StateSpace or a control.TransferFunction: "
            "linearise a nonlinear system first, e.g. with control.linearize, or use plant_from for a system of scipy"
        )
    return plant_from(system, W, V, mean, covariance, input_limit, input_rate, noise)


def _system(
    turns: StepFunction,
    taken: Mapping[str, int],
    shown: Mapping[str, int],
    links: Sequence[str],
    plant: Plant,
    name: str,
    named: _Named,
    given: int = 0,
) -> Any:
    """Return the system of a program, with input and output signals of the given sizes."""
    # The first ``given`` states are taken from the initial state; the others begin with their start values. The
    # functions have the arguments time, state, input and parameters.
    places = [turns.outputs[Entry(signal, i)] for signal, size in shown.items() for i in range(size)]
    places += [turns.outputs[Sent(link)] for link in links]

    def turn(x: Array, u: Array) -> tuple[Values, Values]:
        *memory, tick = x.tolist()
        if tick == 0:
            memory[given:] = turns.start[given:]
        return turns.turn(int(tick), memory, u.tolist())

    def update(t: float, x: Array, u: Array, params: object) -> Array:
        return np.array([*turn(x, u)[0], x[-1] + 1])

    def output(t: float, x: Array, u: Array, params: object) -> Array:
        values = turn(x, u)[1]
        return np.array([values[place] for place in places])

    outputs = [*named.labels(shown), *(f"sent_{link}" for link in links)]
    return _control().NonlinearIOSystem(
        update, output, states=[*turns.states, "tick"], inputs=named.labels(taken), outputs=outputs, dt=_step(plant),
        name=name,
    )  # fmt: skip


def _moving(plant: Plant, function: Dynamics, named: _Named) -> Any:
    """Return the system of a nonlinear plant, without its noise."""
    n = plant.states

    def update(t: float, x: Array, u: Array, params: object) -> Array:
        return function(x, u, np.zeros(n))

    def output(t: float, x: Array, u: Array, params: object) -> Array:
        return plant.C @ x

    return _control().NonlinearIOSystem(update, output, dt=_step(plant), name="plant", **named.of_plant(plant))


def _step(plant: Plant) -> float | bool:
    """Return the seconds per step in python-control's convention: True if unspecified."""
    return True if plant.dt is None else plant.dt


@dataclass(frozen=True)
class _Named:
    """Names of the entries of signals in python-control."""

    names: Names

    def __post_init__(self) -> None:
        """Check that the names are ones."""
        instance("names", self.names, Names)

    def labels(self, signals: Mapping[str, int]) -> list[str]:
        """Return the labels of signals by name, such as ``y[0]``, or the name of this output."""
        found = list[str]()
        for name, size in signals.items():
            usual = [f"{_NAMES.get(name, name)}[{i}]" for i in range(size)]
            role = _ROLES.get(name)
            stated = usual if role is None else self.names.labels(role, usual)
            found += [usual[i] if label.startswith(usual[i]) else unit_of(label)[0] for i, label in enumerate(stated)]
        for label in (label for label in found if found.count(label) > 1):
            raise ProblemError(f"names has {label!r} twice; expected different names of signals")
        return found

    def of_plant(self, plant: Plant | ContinuousPlant) -> dict[str, list[str]]:
        """Return the labels of a plant's signals, as arguments of a system."""
        return {
            "states": self.labels({"x": plant.states}),
            "inputs": self.labels({"u": plant.inputs}),
            "outputs": self.labels({"y": len(plant.C)}),
        }


def _control() -> Any:
    try:
        return import_module("control")
    except ImportError:
        raise ProblemError(
            "python-control is not installed, but to_control and from_control require it: "
            "pip install 'taciturn[control]'"
        ) from None
