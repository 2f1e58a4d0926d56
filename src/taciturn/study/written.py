"""The loop of a policy on the plant as written, without the slow disturbance that a default has added.

If a given controller integrates and its file states no disturbance, the plant gets a slow disturbance at each input
with usual values, since silence costs more under a load than without one. Then cost, rates and guarantee are those of
the plant with this disturbance. The user has not written it. So the same policy is also simulated on the plant as
written.
"""

from __future__ import annotations

from dataclasses import replace

from taciturn._progress import Progress
from taciturn.design.given import send_every_sample
from taciturn.errors import TaciturnError
from taciturn.model.controller import ContinuousController, Controller
from taciturn.model.disturbance import Disturbance
from taciturn.model.kept import Kept
from taciturn.model.pid import PID, PIDLoops
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.problem.bare import BareKind
from taciturn.study.disturbed import averages_on, precisely
from taciturn.study.lines import AsWritten
from taciturn.study.measure import Request


def plant_as_written(
    problem: Problem, policy: object, request: Request, progress: Progress | None = None
) -> AsWritten | None:
    """Return cost and rates of a policy on the plant as written, or None if no default has added anything.

    Args:
        problem: the problem.
        policy: its policy.
        request: seed and steps; a standard error applies if it is larger than 0.1 % of the cost of every sample.
        progress: callback that receives the fraction done.

    Raises:
        OutOfTime: the time limit passed before any answer was available.
    """
    kept = problem.controller
    if kept is None or not isinstance(policy, Policy) or isinstance(problem.own, BareKind):
        return None
    added = policy.disturbance
    listed = kept.loops if isinstance(kept, PIDLoops) else (kept,)
    if added is None or any(one.disturbance is not None for one in listed):
        return None
    plain = Disturbance(added.time_constant, 0.0 * (0.0 if added.deviation is None else added.deviation))
    plant = plain.added_to(problem.actual or problem.plant)
    found = averages_on(plant, problem, policy, precisely(request, policy), progress)
    return AsWritten(added.text(), found.cost, _every_sample(problem, kept), found.rates, found.settled)


def _every_sample(problem: Problem, kept: Kept) -> float | None:
    """Return the cost of the controller with every sample on the plant as written, or None if it is not known."""
    if problem.actual is not None or problem.nonlinear or problem.plant.saturation is not None:
        return None
    period = problem.parameters.get("period") if isinstance(problem.plant, ContinuousPlant) else None
    try:
        plain = without_disturbance(kept)
        return send_every_sample("this controller", problem.plant, problem.cost, period, plain).cost_all_time
    except TaciturnError:  # such as a loop whose cost is infinite
        return None


def without_disturbance(kept: Kept) -> Kept:
    """Return a controller whose plant gets no slow disturbance."""
    none = Disturbance(deviation=0.0)
    if isinstance(kept, PIDLoops):
        first, *others = kept.loops
        return PIDLoops((replace(first, disturbance=none), *others))
    if isinstance(kept, PID | ContinuousController):
        return replace(kept, disturbance=none)
    return Controller(kept.A, kept.B, kept.C, kept.D, kept.E, kept.dt, none, kept.setpoint, kept.rest, kept.start_input)
