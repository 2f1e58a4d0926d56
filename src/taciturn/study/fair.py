"""Fair periodic control for a policy: the same measurements, actuator and rate, with the optimal gains."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from taciturn._arrays import Array
from taciturn._progress import OutOfTime, late_text
from taciturn.design.certainty import Actuation, CertaintyEquivalentDesign, design_certainty
from taciturn.design.clocked import predicted_cost
from taciturn.design.estimation import ESTIMATE
from taciturn.design.kind import AnyPolicy
from taciturn.design.kinds.all_time import all_time
from taciturn.design.kinds.periodic import periodic
from taciturn.errors import TaciturnError
from taciturn.loop import Loop, close
from taciturn.lqg._cache import kept
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.periodic import Held, lift
from taciturn.model.estimate import Estimate
from taciturn.model.placement import three_nodes
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Assign, Policy, Send, Terms
from taciturn.problem import Problem
from taciturn.renewal.policy import EventPolicy, OptimalPolicy
from taciturn.study.clock import MOST_MIXED_CYCLES, SENDS, Clock, ClockKind, ClockMix, Cycle, Either, Ticked, Timed

ALIKE = 1e-6  # relative
OF_A_DESIGN = "the cost of periodic control is computed for the loop of a design, and here"  # the difference
NEAR, SMALL = 8, 10  # real periods that are tried next to the one at a rate, of plants with so many states at most
WORK = 3e7  # cycles, times the cube of the size of the problem that one of them is


class NoClockError(Exception):
    """Error that states why a policy has no fair periodic control to compare with."""


def clock_of(problem: Problem, policy: AnyPolicy) -> Clock | None:
    """Return fair periodic control for a policy, or None if ``fair_clock`` gives a reason why there is none."""
    try:
        return fair_clock(problem, policy)
    except NoClockError:
        return None


def fair_clock(problem: Problem, policy: AnyPolicy) -> Clock:
    """Return fair periodic control for a policy: the same measurements and actuator, and optimal gains.

    Args:
        problem: plant, cost and network.
        policy: policy that was designed for the problem.

    Returns:
        The least cost of periodic control as a function of its rate.

    Raises:
        NoClockError: the simulated loop differs from the design, the horizon is finite, the policy schedules two
            links or follows a reference, or with every sample it costs more than LQG: it keeps a controller,
            or it uses measurements later than periodic control would.
    """
    nodes = policy.looked_at if isinstance(policy, OptimalPolicy) else policy
    if isinstance(nodes, EventPolicy) or nodes.prediction is not None:
        return sampling_clock(problem, "model")
    continuous = isinstance(problem.plant, ContinuousPlant)
    period = nodes.tick if continuous else None
    if problem.cost.mission:
        raise NoClockError(
            "the horizon is finite or the cost is discounted, but periodic control is computed for average costs only"
        )
    if any(problem.network.loss(link) for link in problem.network.links):
        raise NoClockError(
            "the links drop packets, but periodic control is computed for links that deliver every packet"
        )
    if len(nodes.scheduled) > 1:
        raise NoClockError(
            f"the policy decides on {len(nodes.scheduled)} links, and a single rate does not determine the rate of "
            "each link"
        )
    if nodes.theory.periodic is not None and problem.controller is not None:
        loop = problem.close(nodes)
        if not loop.nominal:
            raise NoClockError(f"{OF_A_DESIGN} {loop.violated_assumptions[0]}")
        return _kept(loop, nodes.theory.periodic, "zero" if _applies_zero(nodes) else actuation_of(nodes))
    try:
        certainty = design_certainty("periodic", discretise(problem.plant, problem.cost, period))
        every = all_time(problem.plant, problem.cost, period=period)
        links = three_nodes(problem.network, "periodic control")
        differences = close(problem.actual or problem.plant, every, links, problem.cost).violated_assumptions
    except TaciturnError as error:
        raise NoClockError(f"no periodic control can be designed for this problem ({error})") from None
    if differences:
        raise NoClockError(f"{OF_A_DESIGN} {differences[0]}")
    if nodes.tracking is not None:
        raise NoClockError("the policy follows a stored reference")
    if certainty.timed:
        raise NoClockError(
            "the set-points change at known times, and the cost of periodic control is computed for other changes only"
        )
    least = certainty.problem.per_unit(certainty.cost_all_time)
    if nodes.theory.periodic is None and abs(least - nodes.cost_all_time) > ALIKE * abs(least):
        if problem.own is None:
            raise NoClockError("the policy uses its measurements later than periodic control would")
        more = nodes.cost_all_time / least
        raise NoClockError(
            f"with every sample the policy costs {more:.4g} times as much as LQG, which periodic control uses"
        )
    if any(nodes.network.nodes[link].measures for link in nodes.scheduled) and actuation_of(nodes) == "hold":
        return _asking(certainty)
    p = certainty.problem
    if actuation_of(nodes) == "model":
        ticked = _ticked(certainty, "model", lambda cycle: predicted_cost(certainty, cycle))
    else:
        given = p.plant.A, p.plant.B, p.Q, p.R, p.N, certainty.corrections
        ticked = _holding(*given, certainty.estimation_cost, p.noise_cost, p.tick)
    near = NEAR if p.plant.states <= SMALL else 0
    if not continuous or p.instants:  # costs at the sampling instants of another period count something else
        return ticked
    actuation = actuation_of(nodes)
    if problem.plant.full_state and actuation == "hold":  # neither filter nor model runs between the sends
        return Either(ticked, sampling_clock(problem), p.tick, near, np.inf)
    return Either(ticked, Timed(actuation, lambda seconds: _spaced(problem, seconds, p.tick, actuation)), p.tick, near)


def periodic_at(problem: Problem, policy: AnyPolicy, rate: Estimate) -> tuple[ClockMix | None, str]:
    """Return fair periodic control for a policy at a measured rate, or the reason why there is none."""
    if rate.value == 0:
        return None, "the policy sent nothing"
    try:
        found = fair_clock(problem, policy).at(rate.value, rate.standard_error)
    except NoClockError as reason:
        return None, str(reason)
    except OutOfTime:
        return None, late_text()
    if found is None:
        return (
            None,
            "periodic control is unstable, or does not follow the disturbances, with all periods that were tried",
        )
    return found, ""


def _applies_zero(policy: Policy) -> bool:
    """Return whether the actuator applies 0 in silence."""
    kept = _silent_input(policy).get("input")
    return isinstance(kept, np.ndarray) and not kept.any()


def _silent_input(policy: Policy) -> Terms:
    """Return the terms of the input in silence; none if the actuator computes it alike in every step."""
    steps = [step for step in policy.steps if isinstance(step, Assign) and step.signal == "input"]
    found = [step.branches[0] for step in steps if len(step.branches) > 1]
    return found[0] if found else {}


def actuation_of(policy: Policy) -> Actuation:
    """Return ``"hold"`` if the receiver of a policy holds its last value between sends, ``"model"`` if it predicts."""
    sends, nodes = (step for step in policy.steps if isinstance(step, Send)), policy.network.nodes
    packet = next((step.payload for step in sends if nodes[step.link].measures), None)
    if packet is not None:
        return "model" if ESTIMATE in packet else "hold"
    return "hold" if set(_silent_input(policy)) == {"input"} else "model"


def sampling_clock(problem: Problem, actuation: Actuation = "hold") -> Timed:
    """Return periodic control of a continuous plant that measures only when it sends.

    For an exact measurement of the full state, this control is fair periodic control. Otherwise it is weaker; the
    thesis uses it for comparison.
    """
    return Timed(actuation, lambda seconds: _cost(problem, seconds, actuation))


def _cost(problem: Problem, seconds: float, actuation: Actuation) -> float | None:
    """Return the cost of periodic control that samples and sends at a real period, or None."""
    return _cost_of(problem, lambda: periodic(problem.plant, problem.cost, period=seconds, actuation=actuation))


def _cost_of(problem: Problem, design: Callable[[], Policy]) -> float | None:
    """Return the exact cost of a periodic policy, or None where it is not stable or not the designed loop."""
    try:
        policy = design()
        network = problem.network.with_intervals(None)
        nominal = close(problem.actual or problem.plant, policy, network, problem.cost).nominal
    except TaciturnError:  # such as sampling that loses a mode
        return None
    return policy.theory.closed_form.cost if nominal and policy.theory.closed_form is not None else None


def _spaced(problem: Problem, seconds: float, tick: float, actuation: Actuation) -> float | None:
    """Return the cost of sends at a real period with equally spaced measurements, no more often than the policy's."""
    samples = max(1, int(seconds / tick * (1 + ALIKE)))
    return _cost_of(
        problem,
        lambda: periodic(problem.plant, problem.cost, period=seconds / samples, every=samples, actuation=actuation),
    )


def _ticked(certainty: CertaintyEquivalentDesign, words: ClockKind, per_tick: Callable[[Cycle], float]) -> Ticked:
    """Return periodic control whose cycles of several intervals are no better than the chord between single ones."""
    problem = certainty.problem
    return Ticked(words, problem.tick, lambda cycle: problem.per_unit(per_tick(cycle)))


def _kept(loop: Loop, cost_of: Callable[[int], float], words: ClockKind) -> Ticked:
    """Return periodic sends of a given controller."""
    problem = loop.problem
    return Ticked(words, problem.tick, lambda cycle: problem.per_unit(cost_of(*cycle)))


@kept
def _holding(
    A: Array, B: Array, Q: Array, R: Array, N: Array, corrections: Array, unseen: float, noise_cost: float, tick: float
) -> Ticked:
    """Return periodic control of an actuator that holds its input; points of one plant and cost share its results."""
    held, known = Held(A, B, Q, R, N, corrections), unseen + noise_cost
    return Ticked(
        "hold",
        tick,
        lambda cycle: (known + held.solve(cycle).cost) / tick,
        lambda listed: (known + held.screen(listed)) / tick,
        min(MOST_MIXED_CYCLES, int(WORK / (len(A) + SENDS * len(R)) ** 3)),
    )


def _asking(certainty: CertaintyEquivalentDesign) -> Clock:
    """Return periodic control of a sensor whose measurements reach a controller at the actuator."""
    plant, regulator = certainty.problem.plant, certainty.regulator
    noise = float(np.sum(regulator.K * plant.W))

    def per_tick(cycle: Cycle) -> float:
        (ticks,) = cycle
        free, none = np.zeros((plant.inputs, plant.inputs)), np.zeros_like(plant.B)
        asked = lift(plant.A, plant.B, certainty.square, free, none, plant.W, ticks)
        seen = steady_filter(asked.A, plant.C, asked.W, plant.V)
        return noise + (float(np.sum(asked.Q * seen.posterior)) + asked.noise_cost) / ticks

    return _ticked(certainty, "queries", per_tick)
