"""Certainty-equivalent control over an actuator link: filter, gain, trigger, and an actuator that holds or predicts.

Within a tick: the sensor measures; the controller (at the sensor's site) estimates, computes ``command`` = L x̂ and the
``candidate`` that the actuator will apply if nothing is sent, and decides on their difference ``error``; the packet
travels; the actuator applies ``input``; the controller notes the same input as ``held`` and predicts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from taciturn._arrays import Array, ArrayLike, block_diagonal, choice
from taciturn.design.estimation import ESTIMATE, HELD, Estimation, estimate_state
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import Filter, expect_known_start, filter_checked
from taciturn.lqg.periodic import Held
from taciturn.lqg.riccati import Regulator, refuse_uncertain, regulate_checked
from taciturn.model.cost import Cost
from taciturn.model.plant import Plant
from taciturn.model.policy import (
    Assign,
    ClosedForm,
    Decide,
    Guarantee,
    Identity,
    LinkName,
    Location,
    NodeName,
    Policy,
    Received,
    Send,
    Step,
)
from taciturn.model.schedule import Schedule
from taciturn.model.theory import Reset
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger

Actuation: TypeAlias = Literal["hold", "model"]
COLLOCATED: tuple[frozenset[NodeName], ...] = (frozenset({"sensor", "controller"}),)
SEND, CLOCK, DEVIATION = "send", "clock", "deviation"


@dataclass(frozen=True, eq=False)
class Certainty:
    """What every such policy shares: the discrete problem, its regulator and its filter.

    Args:
        problem: the plant from tick to tick.
        regulator: K, L and H of the infinite horizon.
        filter: covariances and gain of the steady filter.
        estimation: its steps.
        cost_all_time: cost of sending at every tick, per tick, without the inter-sample noise cost.
        settling: ticks in which regulator and filter forget their start, 1/(1 − |slowest eigenvalue|).
    """

    problem: Discrete
    regulator: Regulator
    filter: Filter
    estimation: Estimation
    cost_all_time: float
    settling: float

    @property
    def corrections(self) -> Array:
        """Covariance of what a measurement adds to the estimate, Σ̃ − Σ, semidefinite under rounding too."""
        return self.filter.gain @ self.filter.innovation @ self.filter.gain.T

    @property
    def unseen(self) -> float:
        """Cost per tick of what the filter cannot know, tr(QΣ)."""
        return float(np.trace(self.problem.Q @ self.filter.posterior))

    @cached_property
    def held(self) -> Held:
        """The problem of an input that is held from send to send."""
        p = self.problem
        return Held(p.plant.A, p.plant.B, p.Q, p.R, p.N, self.corrections)

    @property
    def square(self) -> Array:
        """Price e'L'HLe of acting on a state that is off the estimate by e, (n, n)."""
        return self.regulator.L.T @ self.regulator.H @ self.regulator.L

    def reset(self, actuation: Actuation) -> Reset | None:
        """Return the error x̃ − x̂ of a model that a send corrects; None where none is corrected for good.

        It is moved by what measurements add to the estimate, which is independent from tick to tick if the state is
        measured or all noise is Gaussian.
        """
        problem, L = self.problem, self.regulator.L
        if actuation != "model" or not (problem.plant.full_state or problem.jumps is None):
            return None
        return Reset(self.corrections, {DEVIATION: np.eye(len(L.T)), "error": L}, self.square / problem.tick)

    def completed_square(self) -> Identity:
        """Return J = J_all + E[(1−σ)(û − Lx̂)'H(û − Lx̂)]."""
        problem = self.problem
        return completed_square(problem.per_unit(self.cost_all_time), self.regulator.H / problem.tick)


def design_certainty(kind: str, problem: Discrete) -> Certainty:
    """Return regulator, filter and all-time cost J_all = tr(QΣ) + tr(K(Σ̃ − Σ)) of an average cost.

    Raises:
        ProblemError: the cost has a horizon or a discount, which ``kind`` does not know.
        UnstableError: no stabilising gain.

    Source: khashooei2017, anderson1990optimal
    """
    expect_average(kind, problem.cost)
    plant = problem.plant
    regulator = regulate_checked(plant.A, plant.B, problem.Q, problem.R, problem.N, 1.0)
    steady = filter_checked(plant.A, plant.C, plant.W, plant.V)
    expect_known_start(plant, regulator.K.diagonal() > 0)
    prior, posterior = steady.prior, steady.posterior
    cost = np.trace(problem.Q @ posterior) + np.trace(regulator.K @ (prior - posterior))
    left = np.eye(plant.states) - steady.gain @ plant.C  # of an error of the prior, in the posterior
    square = regulator.L.T @ regulator.H @ regulator.L
    doubt = np.sum(regulator.error * (prior - posterior)) + np.sum(square * (left @ steady.error @ left.T))
    refuse_uncertain(float(cost), float(doubt))
    settling = 1 / (1 - max(regulator.slowest, steady.slowest))
    return Certainty(problem, regulator, steady, estimate_state(plant, steady), float(cost), settling)


def expect_average(kind: str, cost: Cost) -> None:
    """Refuse a mission.

    Raises:
        ProblemError: the cost has a horizon or a discount.
    """
    for name, absent in (("horizon", None), ("discount", 1.0)):
        got = getattr(cost, name)
        if got != absent:
            raise ProblemError(
                f"cost.{name} is {got:g}, which {kind} does not use; expected an average cost: remove it"
            )


def control_steps(
    plant: Plant,
    estimation: Estimation,
    L: Matrix,
    actuation: Actuation,
    trigger: Trigger | None,
    *,
    before: tuple[Step, ...] = (),
    after: tuple[Step, ...] = (),
) -> tuple[tuple[Step, ...], dict[str, Array]]:
    """Return the steps of a tick and the first values of the memories.

    Args:
        plant: from tick to tick.
        estimation: the steps that make the estimate.
        L: the gain of the command.
        actuation: ``"hold"``: the actuator keeps the last input; ``"model"``: it runs x̃⁺ = (A + BL) x̃, L constant.
        trigger: over ``estimate``, ``candidate``, ``error`` and ``deviation``; None: send at every tick.
        before: further steps before the decision.
        after: further steps after it.
    """
    on = None if trigger is None else SEND
    decide = () if trigger is None else (Decide("controller", SEND, trigger),)
    part = _ACTUATIONS[choice("actuation", actuation, _ACTUATIONS)](plant, L, on)
    deviates = trigger is not None and DEVIATION in trigger.reads
    steps: tuple[Step, ...] = (
        *estimation.correct,
        Assign("controller", "command", {ESTIMATE: L}),
        part.candidate,
        Assign("controller", "error", {"candidate": np.eye(plant.inputs), "command": -np.eye(plant.inputs)}),
        *(part.deviation if deviates else ()),
        *before,
        *decide,
        *part.send,
        *(part.noted if deviates else ()),
        *after,
        *estimation.predict,
    )
    return steps, {**estimation.initial, **part.initial}


def certainty_policy(
    kind: str,
    certainty: Certainty,
    steps: tuple[Step, ...],
    initial: Mapping[str, Array],
    *,
    identity: Identity | None,
    locations: tuple[Location, ...] = (),
    guarantee: Guarantee | None = None,
    closed_form: ClosedForm | None = None,
    fixed_rates: Mapping[LinkName, float] | None = None,
    reset: Reset | None = None,
    slower: float = 1.0,
    notes: tuple[str, ...] = (),
) -> Policy:
    """Return the policy whose controller sits at the sensor and sends over the actuator link.

    Args:
        kind: name in the catalogue.
        certainty: filter and regulator.
        steps: of a tick.
        initial: first values of the memories.
        identity: what the cost is exactly, by completion of squares.
        locations: finite locations.
        guarantee: what is proved.
        closed_form: what is known exactly.
        fixed_rates: sends per tick that the design fixes.
        reset: the error that a send resets.
        slower: how many times as long as sending always it takes to forget the start.
        notes: what a reader of its numbers must know.
    """
    problem = certainty.problem
    return Policy(
        kind=kind,
        steps=steps,
        model=problem.plant,
        cost_all_time=problem.per_unit(certainty.cost_all_time),
        sites=COLLOCATED,
        locations=locations,
        initial=initial,
        tick=problem.tick,
        noise_cost=problem.noise_cost,
        settling=slower * certainty.settling,
        cost=problem.cost,
        guarantee=guarantee,
        identity=identity,
        innovations=certainty.estimation.innovations,
        closed_form=closed_form,
        fixed_rates=fixed_rates or {},
        reset=reset,
        notes=notes,
    )


def sensor_policy(
    kind: str,
    certainty: Certainty,
    estimation: Estimation,
    settling: float,
    *,
    locations: tuple[Location, ...] = (),
    closed_form: ClosedForm | None = None,
    schedule: Schedule | None = None,
) -> Policy:
    """Return the policy whose controller sits at the actuator and gets what the sensor sends.

    Args:
        kind: name in the catalogue.
        certainty: filter and regulator of sending always.
        estimation: the steps that decide, send and filter.
        settling: ticks in which regulator and filter forget.
        locations: finite locations.
        closed_form: what is known exactly.
        schedule: where the sensor is scheduled offline.
    """
    problem = certainty.problem
    return Policy(
        kind=kind,
        steps=steps_at_the_actuator(problem.plant, estimation, certainty.regulator.L),
        model=problem.plant,
        cost_all_time=problem.per_unit(certainty.cost_all_time),
        scheduled=("sensor",),
        sites=(frozenset({"controller", "actuator"}),),
        locations=locations,
        initial=estimation.initial,
        tick=problem.tick,
        noise_cost=problem.noise_cost,
        settling=settling,
        cost=problem.cost,
        closed_form=closed_form,
        fixed_rates={} if schedule is None else {"sensor": schedule.rate},
        schedule=schedule,
    )


def steps_at_the_actuator(plant: Plant, estimation: Estimation, L: Matrix) -> tuple[Step, ...]:
    """Return the steps of a controller that needs no link to the actuator."""
    command = {"command": np.eye(plant.inputs)}
    return (
        *estimation.correct,
        Assign("controller", "command", {ESTIMATE: L}),
        Assign("actuator", "input", command),
        Assign("controller", HELD, command),
        *estimation.predict,
    )


def completed_square(constant: float, H: ArrayLike | Scheduled) -> Identity:
    """Return J = constant + E[(û − Lx̂)'H(û − Lx̂)]: silence costs exactly e'He, sending nothing.

    Source: khashooei2017
    """
    return Identity(constant, (Form(("error",), H), Form()), SEND)


def measure_excess(certainty: Certainty) -> tuple[Step, Identity]:
    """Return the step and the identity J = J_all + E[(u − Lx̂)'H(u − Lx̂)] of a controller with gains of its own."""
    problem, regulator = certainty.problem, certainty.regulator
    step = Assign("controller", "excess", {HELD: np.eye(problem.plant.inputs), ESTIMATE: -regulator.L})
    form = Form(("excess",), regulator.H / problem.tick)
    return step, Identity(problem.per_unit(certainty.cost_all_time), (form,))


def silence_form(problem: Discrete, H: Array, theta: float) -> Form:
    """Return (1+θ) e'He − θ·(stage cost of staying silent), which silence must keep at most θ tr(QΣ).

    It is [x̂; e]'Γ[x̂; e] of (2.13), and [x̂; û]'Γ[x̂; û] of (3.10) with e = û − Lx̂, with its terms collected.

    Args:
        problem: the weights of one tick.
        H: price of another input than Lx̂, (m, m), or one for each tick of the clock, (ticks, m, m).
        theta: the share θ.

    Source: khashooei2017
    """
    stage = np.block([[problem.Q, problem.N], [problem.N.T, problem.R]])
    signals = (ESTIMATE, "candidate", "error")
    if H.ndim == 2:
        return Form(signals, block_diagonal(-theta * stage, (1 + theta) * H))
    return Form(signals, Scheduled(CLOCK, [block_diagonal(-theta * stage, (1 + theta) * price) for price in H]))


def count_ticks(ticks: int, start: int | None) -> Location:
    """Return the clock that counts 0, 1, …, ticks − 1 and goes on at ``start``, or stays where that is None."""
    table = np.arange(1, ticks + 1)
    table[-1] = ticks - 1 if start is None else start
    return Location(CLOCK, table)


@dataclass(frozen=True, eq=False)
class _Actuation:
    """What the actuator does in silence, and how the controller follows it.

    ``deviation`` is the state that the actuator acts on less the estimate; ``noted`` the memory that takes.
    """

    candidate: Step
    send: tuple[Step, ...]
    initial: dict[str, Array]
    deviation: tuple[Step, ...]
    noted: tuple[Step, ...] = ()


def _hold(plant: Plant, L: Matrix, on: str | None) -> _Actuation:
    unit, state = np.eye(plant.inputs), np.eye(plant.states)
    known = ({"candidate": unit}, {"command": unit})
    return _Actuation(
        Assign("controller", "candidate", {HELD: unit}),
        (
            Send("controller", "actuator", ("command",), on),
            Assign("actuator", "input", ({"input": unit}, {"command": unit}), Received("actuator")),
            Assign("controller", HELD, known, on) if on else Assign("controller", HELD, known[1]),
        ),
        {},
        (_off(plant, "sent"),),
        (Assign("controller", "sent", ({"sent": state}, {ESTIMATE: state}), on),) if on else (),
    )


def _model(plant: Plant, L: Matrix, on: str | None) -> _Actuation:
    assert not isinstance(L, Scheduled)
    unit, closed = np.eye(plant.states), plant.A + plant.B @ L
    copied = ({"prediction": unit}, {ESTIMATE: unit})
    known = ({"candidate": np.eye(plant.inputs)}, {"command": np.eye(plant.inputs)})
    return _Actuation(
        Assign("controller", "candidate", {"prediction": L}),
        (
            Send("controller", "actuator", (ESTIMATE,), on),
            Assign("actuator", "input", ({"forecast": L}, {ESTIMATE: L}), Received("actuator")),
            Assign("actuator", "model", ({"forecast": unit}, {ESTIMATE: unit}), Received("actuator")),
            Assign("actuator", "forecast", {"model": closed}),
            Assign("controller", "copy", copied, on) if on else Assign("controller", "copy", copied[1]),
            Assign("controller", HELD, known, on) if on else Assign("controller", HELD, known[1]),
            Assign("controller", "prediction", {"copy": closed}),
        ),
        {"prediction": plant.mean, "forecast": plant.mean},
        (_off(plant, "prediction"),),
    )


def _off(plant: Plant, signal: str) -> Step:
    return Assign("controller", DEVIATION, {signal: np.eye(plant.states), ESTIMATE: -np.eye(plant.states)})


_ACTUATIONS: dict[Actuation, Callable[[Plant, Matrix, str | None], _Actuation]] = {"hold": _hold, "model": _model}
