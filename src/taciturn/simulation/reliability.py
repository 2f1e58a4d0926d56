"""Warnings about simulated averages that do not exist, or whose standard errors are unreliable.

While a link drops packets, the error of a mode that grows by ρ per step grows without control. If an outage lasts
another step with probability q, the mean square of a loop is infinite for qρ² ≥ 1, and the variance of its cost for
qρ⁴ ≥ 1, whatever the policy decides. Where the loop is a jump linear system (``analyse.switched``), its moments of
order 2 and 4 decide instead.

Averages do not exist either if noise drives an unstable plant beyond the reach of limited inputs, if disturbances or
set-points wander beyond them, or if decisions depend on the size of such signals. They are doubted if nothing was
sent, if the loop has not settled, if few paths dominate the cost, or if the largest costs follow a power law of an
index below 2.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import root
from taciturn._rational import Limit, unmoved
from taciturn._text import number_of
from taciturn.analyse.switched import drifting, outcomes
from taciturn.errors import UnstableError
from taciturn.loop import Loop
from taciturn.lqg.quadratic import worth_of
from taciturn.model.estimate import Estimate
from taciturn.model.signals import SampledChanges
from taciturn.model.steps import Send

_LARGE = 1 / 3  # a standard error above this share of the cost gives a warning
_SAME = 1e-9  # relative distance of two computed modes that are one
_NEARLY = 1e-9  # least growth above 1 that counts as unstable
_HEAVY = 1.6  # limit for an index estimated from 64 paths, to an eighth of its value: two standard errors below 2


def expect_arrivals(loop: Loop) -> None:
    """Raise an error if a loop's mean square is infinite because of dropped packets, whatever the policy decides."""
    for link, outage, growth in _outages(loop):
        if outage == 1:
            raise UnstableError(
                f"the loop of the policy {loop.policy.kind} diverges: the {link} link drops every packet, and the "
                "plant is not stable in open loop; expected a loss probability below 1"
            )
        if outage * growth**2 >= 1:
            raise UnstableError(
                f"the loop of the policy {loop.policy.kind} diverges: an outage of the {link} link lasts another step "
                f"with probability {outage:.4g}, and in this step the mean square error grows by a factor of "
                f"{growth**2:.4g}; expected a probability and a factor whose product is below 1: smaller loss "
                "probabilities, or shorter bursts"
            )
    found = outcomes(loop)
    if found is not None and not found.decides and (growth := found.growth(2)) >= 1:
        raise UnstableError(
            f"the loop of the policy {loop.policy.kind} diverges: with these {found.reason}, the mean square of its "
            f"state grows by a factor of {growth:.6g} per step; expected smaller probabilities"
        )


def find_doubts(
    loop: Loop, cost: Estimate, rates: Mapping[str, Estimate], steps: int, settled: bool
) -> tuple[str, ...]:
    """List warnings about the reliability of a simulated average."""
    none = [link for link, rate in rates.items() if rate.value == 0]
    mute = loop.mute if none else frozenset[str]()
    silent, never = (
        " and ".join(f"the {link} link" for link in none if (link in mute) == is_mute) for is_mute in (False, True)
    )
    notes = loop.problem.remarks
    if never:
        notes += (f"after the start, nothing is ever sent on {never}, whatever the noise is",)
    if escapes(loop):
        notes += (
            "the plant is unstable and its inputs are limited: the noise eventually drives the state to a point from "
            "which no input returns it, so no average exists; this one is over the time before",
        )
    elif wanders(loop):
        notes += (
            "the disturbances or set-points wander without limit, and inputs are limited: eventually they need more "
            "input than there is, so cost and rates depend on the simulated time",
        )
    if drifts := drifts_of(loop):
        held = any(loop.policy.holds(link) for link in drifts)
        model = "; a receiver with a model (actuation or prediction 'model') may follow them" if held else ""
        notes += (
            f"the decision on {' and '.join(drifts)} depends on the size of disturbances or set-points that wander "
            f"without limit: cost and rates depend on the simulated time, and the rates have no average{model}",
        )
    if silent and comes_never_to_rest(loop):
        notes += (
            f"nothing was sent on {silent} in the {number_of(steps, 'step')} simulated, and the plant does not come to "
            "rest by itself: the cost depends on the length of the run and is not an average",
        )
    elif silent and not settled and not drifts and loop.identity is None:
        notes += (
            f"nothing was sent on {silent} in the {number_of(steps, 'step')} simulated: the cost is that of silence "
            "until the first packet, and not an average",
        )
    elif silent:
        notes += (f"nothing was sent on {silent} in {number_of(steps, 'step')}: the cost is that of silence",)
    elif not settled and not drifts:
        notes += (
            f"the loop has not settled within {number_of(steps, 'step')}: cost and rates still depend on the initial "
            "state and are not averages",
        )
    return notes + doubt_errors(cost, steps)


def doubt_moments(loop: Loop) -> tuple[str, ...]:
    """Return a warning if, because of dropped packets, the variance of the cost or of its discounted sum is
    infinite.
    """
    # With the discount α, the squared cost of a step counts α²ᵏ times after k steps. Over a horizon, all moments are
    # finite.
    cost = loop.problem.cost
    if cost.horizon is not None:
        return ()
    alpha, discounted = cost.discount, "discounted " if cost.discount < 1 else ""
    for link, outage, growth in _outages(loop):
        if outage * alpha**2 * growth**4 >= 1:
            return (
                f"the variance of the cost is infinite: an outage of the {link} link lasts another step with "
                f"probability {outage:.4g}, and in this step the {discounted}squared cost grows by a factor of "
                f"{alpha**2 * growth**4:.4g}. So the standard error is meaningless, and the average is probably too "
                "small",
            )
    found, known = outcomes(loop), loop.deviations.policy.theory.fourth
    if found is None and known is not None and known >= 1 and loop.deviations.nominal:
        every = loop.deviations.policy.theory.every
        sent = " if every packet is sent" if every == 1 else f" if a packet is sent once in {every} steps"
        return (_infinite(known, sent, discounted, "losses"),)
    if found is None or (growth := alpha**2 * found.growth(4)) < 1:
        return ()
    if found.decides and (square := alpha * found.growth(2)) >= 1:
        return (
            f"with these {found.reason} the {discounted}mean square would grow by a factor of {square:.4g} per step if "
            "every packet were sent: the cost is probably infinite, and this average depends on the simulated time",
        )
    return (_infinite(growth, " if every packet is sent" if found.decides else "", discounted, found.reason),)


def _infinite(growth: float, sent: str, discounted: str, reason: str) -> str:
    return (
        f"the variance of the cost is infinite: with these {reason} the {discounted}squared cost grows by a factor of "
        f"{growth:.4g} per step{sent}. So the standard error is meaningless, and the average is probably too small"
    )


def doubt_tail(tail: float) -> tuple[str, ...]:
    """Return a warning if the largest costs of the paths follow a power law, with infinite variance."""
    if tail >= _HEAVY:
        return ()
    return (
        f"the highest costs of paths follow a power law of index {tail:.2g}, and below an index of 2 the variance is "
        "infinite: do not trust the standard error; the average is probably too small",
    )


def doubt_errors(cost: Estimate, steps: int) -> tuple[str, ...]:
    """Return a warning if the standard error is large compared with the simulated cost."""
    if cost.standard_error <= _LARGE * abs(cost.value):
        return ()
    share = cost.standard_error / abs(cost.value) if cost.value else float("inf")
    return (
        f"the standard error is {share:.2g} of the cost after {number_of(steps, 'step')}: a few steps or paths "
        "dominate the cost, and its mean square may not exist",
    )


def escapes(loop: Loop) -> bool:
    """Check whether noise will eventually drive an unstable plant so far that limited inputs cannot bring it back."""
    plant, limits = loop.problem.plant, loop.problem.plant.saturation
    if limits is None or _fastest(loop) <= 1 + _NEARLY:
        return False
    # A mode z⁺ = λ z + w'B u + noise with left eigenvector w grows without return from |z| > sup |w'B u|/(|λ| − 1). A
    # real mode needs inputs in both directions. A complex one turns, so one direction is enough. An input with a
    # limited change follows a mode that grows exponentially too late.
    low, high = limits.low, limits.high
    if limits.rate is not None:
        late = np.isfinite(limits.rate)
        low, high = np.where(late, 0.0, low), np.where(late, 0.0, high)
    values, left = np.linalg.eig(plant.A.T)
    for value, mode in zip(values, left.T, strict=True):
        moved, pushed = np.abs(mode @ root(plant.W)), mode @ plant.B
        if abs(value) <= 1 + _NEARLY or not (moved > _NEARLY * np.abs(plant.W).max() ** 0.5).any():
            continue
        acts = np.abs(pushed) > _NEARLY * np.linalg.norm(plant.B, axis=0)
        if abs(value.imag) > _NEARLY:
            if not (acts & (np.isinf(low) | np.isinf(high))).any():
                return True
            continue
        up, down = np.where(pushed.real > 0, high, -low), np.where(pushed.real > 0, -low, high)
        if not (acts & np.isinf(up)).any() or not (acts & np.isinf(down)).any():
            return True
    return False


def wanders(loop: Loop) -> bool:
    """Check whether disturbances or set-points will eventually require inputs beyond the input limits."""
    limits, needs = loop.problem.plant.saturation, loop.problem.followed
    bounded = limits is not None and limits.bounded
    return bounded and needs is not None and needs.wanders(needs.inputs, wandering_noise(loop))


def drifts_of(loop: Loop) -> tuple[str, ...]:
    """Return the links whose send rates have no average, because drifting disturbances affect their decisions."""
    return drifting(loop, wandering_noise(loop))


def wandering_noise(loop: Loop) -> Array:
    """Return the covariance of the process noise, but without the set-points of a timetable, because it repeats."""
    plant, noise = loop.problem.plant, loop.problem.plant.W.copy()
    if isinstance(plant.changes, SampledChanges):
        noise[-plant.changes.size :] = 0.0
    return noise


def _outages(loop: Loop) -> list[tuple[str, float, float]]:
    """Return each required link, the probability that an outage lasts another step, and the growth of the error."""
    # While no packet arrives, inputs do not depend on the noise since the last packet, so the fastest mode that the
    # noise excites, and that no other sensor shows or no other actuator moves, grows freely. This applies to linear
    # plants in which all modes that do not decay are visible in the cost.
    policy, network = loop.policy, loop.policy.network
    beside = any(
        policy.site(sensor) == policy.site(actuator) for sensor in network.sensors for actuator in network.actuators
    )
    if beside or not comes_never_to_rest(loop):
        return []
    links: set[str] = {step.link for step in policy.steps if isinstance(step, Send)}
    needed = [link for link in sorted(links) if network.controller not in policy.site(link)]
    grown = [(link, loop.network.outage(link), _fastest(loop, link)) for link in needed]
    return [one for one in grown if one[2] > 0]


def comes_never_to_rest(loop: Loop) -> bool:
    """Check whether noise excites a mode of a linear plant that affects the cost and does not decay."""
    # False if some such mode has no effect on the cost; states without a cost-to-go are ignored
    return _fastest(loop) > 0


def _fastest(loop: Loop, link: str | None = None) -> float:
    """Return the growth per step, at least 1, of the fastest mode that noise excites and that does not decay, or 0."""
    # With a link, only modes count that no sensor without this link shows, or no actuator without it moves.
    problem, plant = loop.problem, loop.problem.plant
    if plant.function is not None:
        return 0.0
    own, source = problem.deviations, problem.exact and problem.exact.source
    given, W = (problem.quadratic, plant.W) if own is None else (own.problem, own.T @ plant.W @ own.T.T)
    seen, limit, period = worth_of(given).states, Limit(False), 1.0
    if own is None and source:  # the modes before sampling are known exactly
        given, W, limit, period = source.given, source.W, Limit(True), source.period
    given, W = given.among(seen), W[np.ix_(seen, seen)]
    every, unpaid, still = (
        unmoved(A, B, limit, rounded=True).lasting
        for A, B in ((given.A, np.zeros((len(W), 0))), (given.A.T, given.Q), (given.A, root(W)))
    )
    if not every.size or unpaid.size:
        return 0.0
    for mode in still:
        every = np.delete(every, np.argmin(np.abs(every - mode)))
    shown, moved = _without(loop, link)
    if shown or moved:
        if own is not None:
            return 0.0
        A, B = (given.A.T, plant.C[shown][:, seen].T) if shown else (given.A, given.B[:, moved])
        alone = unmoved(A, B, limit, rounded=True).lasting
        every = every[[bool((np.abs(alone - mode) <= _SAME * np.abs(mode)).any()) for mode in every]]
    if not every.size:
        return 0.0
    return max(1.0, float(np.exp(every.real * period).max() if limit.continuous else np.abs(every).max()))


def _without(loop: Loop, link: str | None) -> tuple[list[int], list[int]]:
    """Return the outputs of the other sensors if a link is that of a sensor, and the inputs of the other actuators."""
    network, plant = loop.policy.network, loop.problem.plant
    measured = network.measurements(plant.sensed, plant.set_points).values()
    applied = network.applications(plant.inputs).values()
    if link in network.sensors:
        return [output for node, outputs in measured if node != link for output in outputs], []
    if link in network.actuators:
        return [], [index for node, inputs in applied if node != link for index in inputs]
    return [], []
