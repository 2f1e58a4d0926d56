"""Loops with another disturbance or without input limits, with which an evaluation compares its own loop.

* ``AfterStep``: cost and rate under a constant disturbance of one standard deviation, for a policy that assumes a slow
  disturbance, next to the same control that sends every sample.
* ``WithoutLimits``: the loop without the limits of its inputs, and the share of the steps in which a limit binds. This
  share is counted on paths that start after twelve time constants.
* ``AsWritten``: the loop on the plant as written, without a slow disturbance that a default has added.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from taciturn._arrays import Array
from taciturn._progress import Progress, Stages
from taciturn.design.at_fixed_steps import decides, send_at_fixed_steps, sending_always
from taciturn.design.kind import usual_nodes
from taciturn.loop import Loop, close
from taciturn.model.estimate import Estimate
from taciturn.model.expected import predicted_outputs
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.result import Field, Result, plain_fields
from taciturn.model.saturation import Saturation
from taciturn.problem import Problem
from taciturn.problem.without_file import BareKind
from taciturn.program.engine import prepare
from taciturn.program.ops import Entry
from taciturn.program.translation import APPLIED, first_input
from taciturn.simulation.average import average
from taciturn.simulation.reliability import escapes, wanders
from taciturn.simulation.sampling import Averages
from taciturn.study.measure import Request, measure
from taciturn.study.sentences import sends_text


@dataclass(frozen=True, repr=False)
class AsWritten(Result):
    """Averages for the plant as the user wrote it, without the slow disturbance that Taciturn has added by default.

    Args:
        added: time constant and deviation of this disturbance, as text.
        cost: cost of the policy on the plant as written.
        cost_all_time: exact cost of sending every sample there; None if it is not known.
        rates: sends per step or per second there, by scheduled link.
        settled: whether the initial transient has decayed.
        cost_every_sample: cost of sending every sample there, exact or simulated on the same random numbers, or None.
        excess: cost/cost_every_sample − 1, or None.
    """

    FIELDS: ClassVar[tuple[Field[AsWritten], ...]] = (
        *plain_fields("added", "cost", "cost_all_time", "cost_every_sample"),
        Field("excess_percent", lambda found: None if found.excess is None else found.excess.scaled(100.0)),
        *plain_fields("rates", "settled"),
    )

    added: str
    cost: Estimate
    cost_all_time: float | None
    rates: Mapping[str, Estimate] = field(hash=False)
    settled: bool = True
    cost_every_sample: Estimate | None = None
    excess: Estimate | None = None


ACCURACY = 1e-3  # standard error relative to the cost of sending every sample


@dataclass(frozen=True, repr=False)
class AfterStep(Result):
    """Averages of a loop under a constant disturbance, after the transient that its onset causes.

    Args:
        size: the disturbance at each input.
        cost: cost of the policy.
        cost_all_time: cost of the same control if it sends every sample, under the same disturbance.
        rates: sends per step or per second, by scheduled link.
        settled: whether the transient has decayed within the steps.
    """

    size: tuple[float, ...]
    cost: Estimate
    cost_all_time: Estimate
    rates: Mapping[str, Estimate] = field(hash=False)
    settled: bool = True

    def sentence(self, unit: str) -> str:
        """Write the averages as one sentence. The argument states the unit of the rates."""
        size = ", ".join(f"{value:.4g}" for value in self.size)
        sent = sends_text(self.rates, unit)
        late = "" if self.settled else "; the transient has not decayed: more steps are required"
        return f"of {size} at the input: cost {self.cost}, with every sample {self.cost_all_time}; {sent}{late}"


def averages_after_step(
    problem: Problem, policy: Policy, request: Request, progress: Progress | None = None
) -> AfterStep | None:
    """Compute averages under a constant disturbance of one standard deviation; None if the policy assumes none."""
    assumed = policy.disturbance
    if assumed is None or assumed.deviation is None:
        return None
    plant, told = problem.actual or problem.plant, Stages(progress)
    if isinstance(plant, Plant) and plant.stated == policy.model.stated:  # a policy without a problem: its own model
        plant = assumed.removed_from(plant)
    plant = assumed.stepped(plant)
    precise = precisely(request, policy)
    found = averages_on(plant, problem, policy, precise, told.stage(0.0, 0.5))
    always = averages_on(plant, problem, _with_every_sample(problem, policy), precise, told.stage(0.5, 1.0))
    size = tuple(float(value) for value in np.atleast_1d(assumed.deviation))
    return AfterStep(size, found.cost, always.cost, found.rates, found.settled and always.settled)


def precisely(request: Request, policy: Policy) -> Request:
    """Request a standard error of 0.1 % of the cost of sending every sample, or the user's if that is larger."""
    return replace(request, standard_error=max(ACCURACY * policy.cost_all_time, request.standard_error or 0.0))


def averages_on(
    plant: Plant | ContinuousPlant,
    problem: Problem,
    policy: Policy,
    request: Request,
    progress: Progress | None,
    compared: bool = False,
) -> Averages:
    """Simulate a policy on a plant with another disturbance than in the design, and return the averages.

    If it is to be ``compared``, the same nodes that send every sample are the baseline. The loop recovers from such a
    disturbance as slowly as from a fault. The time constant of this recovery determines how many initial steps are
    dropped.
    """
    policy = replace(policy, theory=replace(policy.theory, settling=policy.theory.recovers))
    network = problem.network if policy.network.nodes == problem.network.nodes else policy.network
    loop = close(plant, policy, network.with_intervals(policy.network), problem.cost)
    every = replace(loop, policy=sending_always(policy), network=loop.network.unlimited)
    baseline = every if compared and decides(policy) else None
    error = None if request.steps else request.standard_error
    return average(
        loop, seed=request.seed, standard_error=error, steps=request.steps, progress=progress, baseline=baseline
    )


def _with_every_sample(problem: Problem, policy: Policy) -> Policy:
    """Return the same control with a packet at every sample; some rules, such as levels of the output, have none."""
    if problem.controller is None or (problem.network.missing and predicted_outputs(policy) is not None):
        return sending_always(policy)  # of the same nodes, whose filter predicts missing samples
    period = policy.tick if isinstance(problem.plant, ContinuousPlant) else None
    network, links = problem.network, policy.scheduled
    # over several links, which are ideal, the loop with every sample is that of one link; so it is where a sensor
    # decides that does not know the set-points
    sensed = len(links) == 1 and bool(network.nodes[links[0]].measures) and problem.plant.exosystem is None
    link = "sensor" if sensed else "actuator"
    always = send_at_fixed_steps(policy.kind, problem.plant, problem.cost, period, problem.controller, link)
    return replace(always, network=usual_nodes(network, policy.kind)) if len(links) == 1 else always


PATHS, TICKS = 512, 512  # over which the share of steps at a limit is counted, after the transient
FEWEST, NUMBERS = 64, 20_000_000  # paths at least, and most inputs that are recorded with more
CONSTANTS, LONGEST = 12, 4096  # length of the transient in time constants, and its most steps
NEAR = 1e-9  # relative distance at which an input is at its limit: the rounding of set-points


@dataclass(frozen=True, repr=False)
class WithoutLimits(Result):
    """Averages of the loop without its input limits, for comparison with the loop that has them.

    Args:
        share: share of the steps in which a limit binds, in the loop with limits; None if it has no average.
        cost: cost of the loop without limits; None for a policy that is given without its problem.
        cost_bound: proven upper bound on this cost, or None.
        rates: sends per step or per second without limits, by scheduled link.
    """

    FIELDS: ClassVar[tuple[Field[WithoutLimits], ...]] = (
        Field("share", key="share_at_limit"),
        Field(
            "without_limits",
            lambda found: {"cost": found.cost, "cost_bound": found.cost_bound, "rates": found.rates},
        ),
    )

    share: Estimate | None
    cost: Estimate | None
    cost_bound: float | None
    rates: Mapping[str, Estimate] = field(hash=False)

    def sentence(self, unit: str) -> str:
        """Write the comparison as one sentence. The argument states the unit of the rates."""
        bind = "the share of the steps in which a limit binds has no average"
        if self.share is not None:
            bind = f"a limit binds in {self.share.scaled(100)} % of the steps"
        bound = "" if self.cost_bound is None else f", guarantee {self.cost_bound:.6g}"
        if self.cost is None:
            return bind + bound.replace(", ", "; without limits: ", 1)
        return f"{bind}; without limits: cost {self.cost}{bound}, {sends_text(self.rates, unit)}"


def compare_without_limits(
    problem: Problem, loop: Loop, request: Request, pace: float, progress: Progress | None
) -> WithoutLimits | None:
    """Compare a loop that has input limits with the same loop without them; return None if it has none."""
    limits = loop.problem.plant.saturation
    if limits is None:
        return None
    # it would be that of the first steps, before the noise or the disturbances have come near the limits
    share = None if escapes(loop) or wanders(loop) else share_at_limits(loop, limits, request.seed)
    if isinstance(problem.own, BareKind):
        bound = loop.policy.guarantee
        return WithoutLimits(share, None, None if bound is None else bound.cost, {})
    actual = None if problem.actual is None else problem.actual.unlimited
    free = replace(problem, plant=problem.plant.unlimited, actual=actual)
    policy = free.designed()
    assert isinstance(policy, Policy)  # the others refuse limits
    other = replace(free.close(policy), precision=loop.precision)
    found, proved = measure(other, request, progress).averages, policy.guarantee if other.nominal else None
    rates = {link: rate.scaled(pace) for link, rate in found.rates.items()}
    return WithoutLimits(share, found.cost, None if proved is None else proved.cost, rates)


def share_at_limits(loop: Loop, limits: Saturation, seed: int) -> Estimate:
    """Estimate in which share of the steps an input, or its change, is at a limit.

    The paths begin at random steps of a timetable of set-points, which may be longer than the paths. Each path ends at
    the end of a cycle of the policy.
    """
    inputs, horizon, cycle = loop.problem.plant.inputs, loop.horizon, loop.policy.cycle
    burn = 0 if horizon is not None else min(int(CONSTANTS * loop.policy.theory.settling) + 1, LONGEST)
    program = loop.program().keep(outputs={Entry(APPLIED, i) for i in range(inputs)})
    ticks = burn + -(-TICKS // cycle) * cycle if horizon is None else horizon
    paths = max(FEWEST, min(PATHS, NUMBERS // (ticks * inputs)))
    start = loop.start(program, paths, seed, stationary=horizon is None)
    outputs = prepare(program)(start, ticks, None).outputs
    applied = np.stack([outputs[Entry(APPLIED, i)] for i in range(inputs)], axis=-1)
    first = np.broadcast_to(first_input(loop.policy, loop.problem.plant), (1, *applied.shape[1:]))
    at = _at_limits(limits, applied, np.concatenate([first, applied[:-1]]))[burn:].mean(axis=0)
    return Estimate(float(at.mean()), float(at.std(ddof=1) / np.sqrt(paths)), "simulation")


def _at_limits(limits: Saturation, applied: Array, before: Array) -> Array:
    """Return whether an input is at a limit, by step and path, given inputs (steps, paths, inputs)."""
    with np.errstate(invalid="ignore"):
        found = (applied <= limits.low + NEAR * np.abs(limits.low)) | (
            applied >= limits.high - NEAR * np.abs(limits.high)
        )
    if limits.rate is not None:
        found |= np.abs(applied - before) >= limits.rate * (1 - NEAR)
    return np.asarray(found.any(axis=-1), dtype=np.float64)
