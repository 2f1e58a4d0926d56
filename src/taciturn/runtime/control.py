"""Plants, policies and loops as systems of python-control, and plants from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from taciturn._arrays import Array, ArrayLike, instance
from taciturn._control import is_linear, nonlinear_system, state_space
from taciturn.errors import ProblemError
from taciturn.loop import SENT, Loop
from taciturn.model.dynamics import Dynamics
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant, plant_from
from taciturn.model.policy import Policy
from taciturn.runtime.nodes import Nodes, Turns, Values


def to_control(
    thing: Plant | ContinuousPlant | Policy | Loop, network: Network | None = None, seed: int = 0, sent: bool = True
) -> Any:
    """Make a system of python-control of a plant, a policy or a loop.

    | of | a | from | to | dt |
    |---|---|---|---|---|
    | a plant | `StateSpace` | u | y | its own, True where it has none; 0 of a continuous one |
    | one that is not linear | `NonlinearIOSystem` | u | y | the same |
    | a policy | `NonlinearIOSystem` | y | u, sent | that of the plant it was designed for, as sampled |
    | a loop | `NonlinearIOSystem` | w, v | y, u, sent | that of its plant, as sampled |

    Signals are named ``u[0]``, ``y[0]``, …, and ``sent_actuator`` or ``sent_sensor``: 1 in a tick in which a packet is
    sent on the link, for each link whose rate the policy decides. In a loop x⁺ = A x + B u + w, or f(x, u, w), and
    y = C x + v.

    A plant's noise, initial state and input limit are not in its system; the u of a policy or loop is clipped.
    Where an actuator predicts between ticks, u is the state of its model when the tick begins, as in ``policy.model``.

    The state of a policy is what its nodes remember and, last, the number of the tick. Where that is 0 nothing is
    remembered yet, so that the initial state 0, which is python-control's own, is always the right one. That of a loop
    begins with the state x of the plant: ``X0=[loop.problem.plant.mean, 0]`` starts it there, and the rest at 0.

    Args:
        thing: the plant, policy or loop; the plant of a loop may be continuous, and is sampled then.
        network: between the nodes of a policy; omitted: that of the design.
        seed: of what is lost and of a policy's draws: those of a tick depend on it and the tick alone.
        sent: whether what is sent is put out, beside the input.

    Returns:
        The system, named after the policy's kind, or ``plant`` or ``loop``.

    Raises:
        InformationError: a node of the policy uses what it cannot know over the network.
        ProblemError: python-control is missing, the thing is none of these, or a network is given for no policy.

    Example:
        >>> import taciturn
        >>> system = to_control(taciturn.load("two-mass").design())
        >>> system.input_labels, system.output_labels, system.dt
        (['y[0]', 'y[1]'], ['u[0]', 'sent_actuator'], 0.1)
    """
    instance("thing", thing, Plant, ContinuousPlant, Policy, Loop)
    if network is not None and not isinstance(thing, Policy):
        raise ProblemError(
            f"network is given for a {type(thing).__name__}; expected it for a Policy only: "
            "a loop has its own, from close"
        )
    if isinstance(thing, ContinuousPlant):
        return state_space(thing.A, thing.B, thing.C, 0, "plant")
    if isinstance(thing, Plant) and thing.function is not None:
        return _moving(thing, thing.function)
    if isinstance(thing, Plant):
        return state_space(thing.A, thing.B, thing.C, _step(thing), "plant")
    if isinstance(thing, Policy):
        plant, (turns, links) = thing.model, (Nodes(thing, network, seed).turns, thing.scheduled)
        return _system(turns, {"y": plant.outputs}, {"applied": plant.inputs}, links if sent else (), plant, thing.kind)
    plant, links = thing.problem.plant, thing.policy.scheduled
    turns = Turns(replace(thing, precision="float64").open_program(), thing.network, seed)
    taken, shown = {"w": plant.states, "v": plant.outputs}, {"y": plant.outputs, "applied": plant.inputs}
    return _system(turns, taken, shown, links if sent else (), plant, "loop", given=plant.states)


def from_control(
    system: object,
    W: ArrayLike,
    V: ArrayLike | None = None,
    mean: ArrayLike | None = None,
    covariance: ArrayLike | None = None,
    input_limit: ArrayLike | None = None,
) -> Plant | ContinuousPlant:
    """Make a plant of a linear system of python-control; ``plant_from`` takes those of scipy as well.

    With dt = 0 it is a ContinuousPlant, with the seconds of a step or True a Plant, whose ``dt`` is then None.

    Args:
        system: a `control.StateSpace`, or a `control.TransferFunction`, which is realised.
        W: process noise, (n, n): covariance per step, or intensity per second.
        V: measurement-noise covariance, (p, p); omitted: exact measurement.
        mean: initial mean, (n,); omitted: 0.
        covariance: initial covariance, (n, n); omitted: 0.
        input_limit: symmetric clip of each input, (m,), positive; omitted: none.

    Returns:
        The plant.

    Raises:
        ProblemError: python-control is missing, the system is of another kind, D ≠ 0, dt is None, or the plant is
            none that can be controlled.

    Example:
        >>> import control
        >>> from_control(control.ss([[2.0]], [[1.0]], [[1.0]], [[0.0]], dt=0.1), W=[[1.0]]).dt
        0.1
    """
    if not is_linear(system):
        raise ProblemError(
            f"system is a {type(system).__name__}; expected a control.StateSpace or a control.TransferFunction: "
            "linearise a nonlinear one first, as with control.linearize, or use plant_from for one of scipy"
        )
    return plant_from(system, W, V, mean, covariance, input_limit)


def _system(
    turns: Turns,
    taken: Mapping[str, int],
    shown: Mapping[str, int],
    links: Sequence[str],
    plant: Plant,
    name: str,
    given: int = 0,
) -> Any:
    """Return the system of the ticks of a program, which takes and shows signals of so many entries.

    So many of its states are given also at the first tick, where the others are what they start from.
    """
    inputs = _entries(taken)
    places = [turns.outputs[output] for output in (*_entries(shown), *(f"{SENT} {link}" for link in links))]

    def turn(x: Array, u: Array) -> tuple[Values, Values]:
        *memory, tick = x.tolist()
        if tick == 0:
            memory[given:] = turns.start[given:]
        return turns.turn(int(tick), memory, dict(zip(inputs, u.tolist(), strict=True)))

    def update(t: float, x: Array, u: Array, params: object) -> Array:
        return np.array([*turn(x, u)[0], x[-1] + 1])

    def output(t: float, x: Array, u: Array, params: object) -> Array:
        values = turn(x, u)[1]
        return np.array([values[place] for place in places])

    outputs = _labels({"u" if signal == "applied" else signal: size for signal, size in shown.items()})
    outputs += [f"{SENT}_{link}" for link in links]
    return nonlinear_system(update, output, [*turns.states, "tick"], _labels(taken), outputs, _step(plant), name)


def _moving(plant: Plant, function: Dynamics) -> Any:
    """Return the system of a plant that is not linear, without its noise."""
    n, names = plant.states, _labels({"x": plant.states})

    def update(t: float, x: Array, u: Array, params: object) -> Array:
        return function(x, u, np.zeros(n))

    def output(t: float, x: Array, u: Array, params: object) -> Array:
        return plant.C @ x

    taken, shown = _labels({"u": plant.inputs}), _labels({"y": plant.outputs})
    return nonlinear_system(update, output, names, taken, shown, _step(plant), "plant")


def _step(plant: Plant) -> float | bool:
    """Return the seconds of a step as python-control has them: True where nobody has said."""
    return True if plant.dt is None else plant.dt


def _entries(signals: Mapping[str, int]) -> list[str]:
    """Return the names of the entries of signals as programs have them."""
    return [f"{name} {i}" for name, size in signals.items() for i in range(size)]


def _labels(signals: Mapping[str, int]) -> list[str]:
    """Return them as python-control has them."""
    return [f"{name}[{i}]" for name, size in signals.items() for i in range(size)]
