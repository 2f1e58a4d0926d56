"""The loop of a policy on the plant as written, without the slow disturbance that a default has added.

If a given controller integrates and its file states no disturbance, the plant gets a slow disturbance at each input
with usual values, since silence costs more under a load than without one. Then cost, rates and guarantee are those of
the plant with this disturbance. The user has not written it. So the same policy is also simulated on the plant as
written.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from taciturn._display import Displayed
from taciturn._progress import Progress
from taciturn.design.given import send_every_sample
from taciturn.errors import TaciturnError
from taciturn.model.controller import ContinuousController, Controller
from taciturn.model.disturbance import Disturbance
from taciturn.model.estimate import Estimate
from taciturn.model.kept import Kept
from taciturn.model.pid import PID, PIDLoops
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.problem.bare import BareKind
from taciturn.study.disturbed import averages_on, precisely
from taciturn.study.lines import percent_above
from taciturn.study.measure import Request


@dataclass(frozen=True, repr=False)
class AsWritten(Displayed):
    """The policy on the plant as written, without a slow disturbance that a default has added.

    Args:
        added: time constant and deviation of this disturbance, as text.
        cost: cost of the policy on the plant as written.
        cost_all_time: cost of sending every sample there; None if it is not known.
        rates: sends per step or per second there, by scheduled link.
        settled: whether the initial transient has decayed.
    """

    added: str
    cost: Estimate
    cost_all_time: float | None
    rates: Mapping[str, Estimate] = field(hash=False)
    settled: bool = True

    def document(self) -> dict[str, Any]:
        """Return the part of the JSON document of ``taciturn evaluate --json``."""
        return {
            "added": self.added,
            "cost": self.cost.document("value", "standard_error"),
            "cost_all_time": self.cost_all_time,
            "rates": {link: rate.document("value", "standard_error") for link, rate in self.rates.items()},
            "settled": self.settled,
        }

    def extra(self) -> str:
        """Return by how much the policy costs more than sending every sample on the plant as written, as text."""
        if not self.cost_all_time:
            return "without known cost of every sample"
        return percent_above(self.cost, self.cost_all_time)

    def text(self, unit: str) -> str:
        """Return what is added and the numbers without it as one sentence."""
        every = "" if self.cost_all_time is None else f", every sample {self.cost_all_time:.6g} ({self.extra()})"
        rates = ", ".join(f"{rate} sends {unit}" for rate in self.rates.values())
        late = "" if self.settled else "; the loop has not settled: more steps are required"
        return (
            f"a slow disturbance at each input that the problem does not state ({self.added}); on the plant as "
            f"written, this policy costs {self.cost}{every}, {rates}{late}"
        )


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
