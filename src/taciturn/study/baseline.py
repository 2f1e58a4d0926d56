"""The baseline of an evaluation: the same loop, in which every link sends at every step.

Plant, controller, limits, losses, bursts, rounding, delays and disturbances are those of the evaluated loop; over links
that drop packets, the baseline attempts at every step. Where decisions depend on signals, the nodes stay the same, and
all decisions send (``sending_always``). A policy that sends at fixed steps may have gains for these steps, so its
baseline is the kind ``all-time``: the given controller, or else LQG.

Its cost J_every is, in this order,

1. the number of the theory, if the loop is the one of the design,
2. exact, if the baseline is a linear loop, also on another plant: by its Lyapunov equation or, over links that drop
   packets or with missing samples, by the second moments of its jump linear map,
3. simulated on the random numbers of the loop itself, so that the error of the excess J/J_every − 1 is that of a pair.

A controller that amplifies noise may cost more the more often it sends. Then a policy costs less than its baseline, and
this says little about the policy. So ``better_baselines`` has loops that send every sample with a better controller:
LQG with the same weights, and PID controllers with half their derivative gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from taciturn._display import Displayed
from taciturn._progress import OutOfTime
from taciturn.analyse.every_sample import with_every_sample
from taciturn.analyse.switched import outcomes
from taciturn.design.at_fixed_steps import decides, sending_always, sends_always
from taciturn.design.kinds.all_time import KIND as ALL_TIME
from taciturn.errors import TaciturnError, UnstableError
from taciturn.loop import Loop, close
from taciturn.model.controller import PID, AnyController, PIDLoops
from taciturn.model.disturbance import padded
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.problem.without_file import BareKind
from taciturn.simulation.average import average
from taciturn.simulation.sampling import Averages

LESS = 3.0  # standard errors by which a policy costs less than its baseline, from which on better ones are shown
ROUNDING = 1e-9  # excess that is a rounding error
PRECISE = 1e-3  # standard error of the cost of a better baseline, relative to that of the baseline
LQG, HALF_DERIVATIVE = "LQG", "PID with half kd"


@dataclass(frozen=True, eq=False, repr=False)
class Baseline(Displayed):
    """The loop that sends every sample, and its cost if it is known without a simulation."""

    loop: Loop | None  # None if there is no such loop
    cost: Estimate | None  # exact cost in the unit of the cost
    why: str = ""  # reason why neither is known
    same: bool = False  # whether the evaluated loop itself sends every sample

    @property
    def simulated(self) -> Loop | None:
        """The loop to simulate, or None."""
        return self.loop if self.cost is None else None

    def compared(self, found: Averages) -> tuple[Estimate | None, Estimate | None]:
        """Return the cost of the baseline and the excess J/J_every − 1 of a cost, for which it may be simulated."""
        if self.cost is None:
            return found.baseline, found.excess
        excess = excess_over(found.cost, self.cost)
        if self.same and excess is not None:  # a simulated cost differs from an exact one by its error alone
            excess = Estimate(0.0, 0.0, excess.method)
        return self.cost, excess


def excess_over(cost: Estimate, base: Estimate) -> Estimate | None:
    """Return the excess of a cost over a base of known or independent error; None over a base that costs nothing."""
    if base.value <= 0:
        return None
    found = cost.scaled(1 / base.value, -1.0)
    share = (1 + found.value) / base.value
    error = (found.standard_error**2 + (share * base.standard_error) ** 2) ** 0.5
    return Estimate(found.value, error, found.method, found.error + abs(share) * base.error)


ALIKE = 4.0  # standard errors within which measured baselines are those of one loop


def common_base(bases: Sequence[Estimate | None]) -> Estimate | None:
    """Return the most precise one of equal costs of every sample; None if one is unknown, or if they differ."""
    known = [one for one in bases if one is not None]
    if not known or len(known) < len(bases):
        return None
    best = min(known, key=lambda one: one.standard_error)
    if all(one.standard_error == 0 for one in known):
        return best if len({one.value for one in known}) == 1 else None
    alike = all(
        abs(one.value - best.value) <= ALIKE * (one.standard_error**2 + best.standard_error**2) ** 0.5 for one in known
    )
    return best if alike else None


def baseline_of(problem: Problem, loop: Loop) -> Baseline:
    """Return the loop that sends every sample, and its cost if it is known without a simulation."""
    policy = loop.deviations.policy
    # over several links that drop packets, a design may state the cost of links that drop none
    stated = loop.network.ideal or len(policy.scheduled) == 1
    if loop.nominal and stated and policy.theory.cost_all_time is not None:
        return Baseline(None, Estimate(policy.theory.cost_all_time, 0.0, "exact"))
    try:
        every = _every_sample(problem, loop)
    except TaciturnError as error:
        return Baseline(None, None, str(error))
    try:
        found = _exact(every)
    except UnstableError as error:
        return Baseline(None, None, str(error))
    except OutOfTime:
        found = None
    same = not decides(policy) and sends_always(policy)
    return Baseline(every, None if found is None else Estimate(found, 0.0, "exact"), same=same)


def _every_sample(problem: Problem, loop: Loop) -> Loop:
    """Return the loop that sends every sample."""
    policy = loop.policy
    if decides(policy) or sends_always(policy):
        told = loop.violated_assumptions or ("every sample is sent",)
        always = replace(loop, policy=sending_always(policy), network=loop.network.unlimited)
        return replace(always, violated_assumptions=told, counted=None)
    every = _all_time(problem, policy, problem.controller)
    return replace(every, precision=loop.precision, network=every.network.unlimited)


def _all_time(problem: Problem, policy: Policy, controller: AnyController | None) -> Loop:
    """Return the loop of a controller, or of LQG, that sends every sample."""
    plant, actual, cost, assumed = problem.plant, problem.actual or problem.plant, problem.cost, policy.disturbance
    if controller is None and assumed is not None:  # that of the given controller, for which LQG is designed too
        plant, actual = assumed.added_to(plant), assumed.added_to(actual)
        cost = padded(cost, plant.inputs)
    period = policy.tick if isinstance(plant, ContinuousPlant) else None
    given = {name: value for name, value in (("period", period), ("controller", controller)) if value is not None}
    every = ALL_TIME.make(plant, cost, problem.network, given)  # with the gain for missing samples
    assert isinstance(every, Policy)
    return close(actual, every, problem.network, cost)


def _exact(every: Loop) -> float | None:
    """Return the exact cost of a loop that sends every sample, or None if it is not known."""
    plant, network = every.problem.plant, every.network
    ramped = plant.changes is not None and plant.changes.exceed  # set-points that the controller limits
    if plant.saturation is not None or ramped or network.rounded or every.horizon is not None:
        return None
    if network.ideal and not network.missing:
        known = with_every_sample(every)
        return None if known is None else every.problem.per_unit(known.cost)
    if plant.function is not None or plant.changes is not None or every.problem.plant.exosystem is not None:
        return None
    found = outcomes(every)
    return None if found is None else every.problem.per_unit(found.cost())


def costs_less(excess: Estimate | None) -> bool:
    """Return whether a policy costs less than its baseline, beyond all errors."""
    return excess is not None and excess.value + LESS * excess.standard_error + excess.error < -ROUNDING


def better_baselines(problem: Problem, loop: Loop, every: Estimate, seed: int) -> dict[str, Estimate]:
    """Return the costs of other controllers that send every sample, by name, if they cost less than the loop's own."""
    kept, policy = problem.controller, loop.deviations.policy
    if isinstance(problem.own, BareKind):
        return {}
    found = dict[str, Estimate]()
    if kept is not None and loop.nominal and loop.network.ideal and policy.theory.cost_lqg is not None:
        found[LQG] = Estimate(policy.theory.cost_lqg, 0.0, "exact")
    elif kept is not None and (one := _cost(problem, policy, None, every, seed)) is not None:
        found[LQG] = one
    half = None if kept is None else _half_derivative(kept)
    if half is not None and (one := _cost(problem, policy, half, every, seed)) is not None:
        found[HALF_DERIVATIVE] = one
    return {name: one for name, one in found.items() if one.value < every.value}


def _half_derivative(kept: AnyController) -> AnyController | None:
    """Return PID controllers with half their derivative gains; None for other controllers."""
    loops = kept.loops if isinstance(kept, PIDLoops) else (kept,)
    listed = [one for one in loops if isinstance(one, PID)]
    if len(listed) < len(loops) or not any(one.kd for one in listed):
        return None
    halved = tuple(replace(one, kd=one.kd / 2) for one in listed)
    return PIDLoops(halved) if isinstance(kept, PIDLoops) else halved[0]


def _cost(
    problem: Problem, policy: Policy, controller: AnyController | None, every: Estimate, seed: int
) -> Estimate | None:
    """Return the cost of a controller, or of LQG, that sends every sample; None if there is no such average."""
    try:
        loop = _all_time(problem, policy, controller)
        exact = loop.policy.theory.cost_all_time if loop.nominal else _exact(loop)
        if exact is not None:
            return Estimate(exact, 0.0, "exact")
        error = max(PRECISE * abs(every.value), every.standard_error)
        found = average(loop, seed=seed, standard_error=error)
    except (TaciturnError, OutOfTime):  # such as links that drop packets, or a loop whose cost is infinite
        return None
    return found.cost if found.settled and found.trusted else None
