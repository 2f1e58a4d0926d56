"""Which clock is fair to a policy: the measurements, the actuator and the rate of the policy, and the best gains."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from taciturn._arrays import Array
from taciturn.design.catalogue import AnyPolicy
from taciturn.design.certainty import Actuation, Certainty, design_certainty
from taciturn.design.periodic import all_time, periodic, predicted_cost
from taciturn.errors import TaciturnError
from taciturn.lqg._kept import kept
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.periodic import Held, lift
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Assign, Policy
from taciturn.problem import Problem
from taciturn.renewal.policy import EventPolicy, OptimalPolicy
from taciturn.study.clock import FREE, MOST_CYCLES, SENDS, Clock, ClockKind, Cycle, Either, Ticked, Timed

ALIKE = 1e-6  # relative
NEAR, SMALL = 8, 10  # real periods that are tried beside the one at a rate, of plants with so many states at most
WORK = 3e7  # cycles, times the cube of the size of the problem that one of them is


def clock_of(problem: Problem, policy: AnyPolicy) -> Clock | None:
    """Return the fair clock of a policy.

    Args:
        problem: its plant, cost and network.
        policy: designed for it.

    Returns:
        The clock; None where there is none: in a loop that is not the one of the design, such as over links that lose
        or round, of clipped inputs or another plant; for missions; where two links are scheduled; where the policy
        knows measurements later than the clock would.
    """
    nodes = policy.looked_at if isinstance(policy, OptimalPolicy) else policy
    if isinstance(nodes, EventPolicy) or nodes.prediction is not None:
        return sampling_clock(problem, "model")
    continuous = isinstance(problem.plant, ContinuousPlant)
    period = nodes.tick if continuous else None
    try:
        certainty = design_certainty("periodic", discretise(problem.plant, problem.cost, period))
        nominal = problem.close(all_time(problem.plant, problem.cost, period=period)).nominal
    except TaciturnError:  # a mission, or a network with a delay
        return None
    if not nominal or nodes.tracking is not None:
        return None
    always = certainty.problem.per_unit(certainty.cost_all_time)
    if abs(always - nodes.cost_all_time) > ALIKE * abs(always):
        return None
    if nodes.scheduled == ("sensor",):
        return _asking(certainty)
    if nodes.scheduled != ("actuator",):
        return None
    p = certainty.problem
    if actuation_of(nodes) == "model":
        ticked = _ticked(certainty, "model", lambda cycle: predicted_cost(certainty, cycle))
    else:
        given = p.plant.A, p.plant.B, p.Q, p.R, p.N, certainty.corrections
        ticked = _holding(*given, certainty.unseen, p.noise_cost, p.tick)
    near = NEAR if p.plant.states <= SMALL else 0
    longest = np.inf if problem.plant.full_state else FREE  # a state that is known needs no measurement in between
    return Either(ticked, sampling_clock(problem), p.tick, near, longest) if continuous else ticked


def actuation_of(policy: Policy) -> Actuation:
    """Return whether the actuator of a policy holds its input between sends, or runs a model."""
    silent = next(
        step.branches[0]
        for step in policy.steps
        if isinstance(step, Assign) and step.signal == "input" and len(step.branches) > 1
    )
    return "hold" if set(silent) == {"input"} else "model"


def sampling_clock(problem: Problem, actuation: Actuation = "hold") -> Timed:
    """Return the clock that samples a continuous plant and sends at one rate: it measures only when it sends.

    With an exact measurement of the full state that is the fair clock. Else it is a weaker one, which the thesis shows.
    """
    return Timed(actuation, lambda seconds: _cost(problem, seconds, actuation))


def _cost(problem: Problem, seconds: float, actuation: Actuation) -> float | None:
    """Return what periodic control at a real period costs, or None where it is not stable or not the designed loop."""
    try:
        policy = periodic(problem.plant, problem.cost, period=seconds, actuation=actuation)
        nominal = problem.close(policy).nominal
    except TaciturnError:  # such as sampling that loses a mode
        return None
    return policy.closed_form.cost if nominal and policy.closed_form is not None else None


def _ticked(certainty: Certainty, words: ClockKind, per_tick: Callable[[Cycle], float]) -> Ticked:
    """Return a clock whose cycles of several intervals are no better than the chord between single ones."""
    problem = certainty.problem
    return Ticked(words, problem.tick, lambda cycle: problem.per_unit(per_tick(cycle)))


@kept
def _holding(
    A: Array, B: Array, Q: Array, R: Array, N: Array, corrections: Array, unseen: float, noise_cost: float, tick: float
) -> Ticked:
    """Return the clock of an actuator that holds its input; points of one plant and cost share what it has tried."""
    held, known = Held(A, B, Q, R, N, corrections), unseen + noise_cost
    return Ticked(
        "hold",
        tick,
        lambda cycle: (known + held.solve(cycle).cost) / tick,
        lambda listed: (known + held.screen(listed)) / tick,
        min(MOST_CYCLES, int(WORK / (len(A) + SENDS * len(R)) ** 3)),
    )


def _asking(certainty: Certainty) -> Clock:
    """Return the clock of a sensor whose measurements reach a controller at the actuator."""
    plant, regulator = certainty.problem.plant, certainty.regulator
    noise = float(np.sum(regulator.K * plant.W))

    def per_tick(cycle: Cycle) -> float:
        (ticks,) = cycle
        free, none = np.zeros((plant.inputs, plant.inputs)), np.zeros_like(plant.B)
        asked = lift(plant.A, plant.B, certainty.square, free, none, plant.W, ticks)
        seen = steady_filter(asked.A, plant.C, asked.W, plant.V)
        return noise + (float(np.sum(asked.Q * seen.posterior)) + asked.noise_cost) / ticks

    return _ticked(certainty, "queries", per_tick)
