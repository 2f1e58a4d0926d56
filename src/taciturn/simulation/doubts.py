"""Where an average over paths is none, or its standard error says nothing: outages, rare large costs, silence."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from taciturn._modes import eigenvalues, lost_modes, persistent, root
from taciturn.analyse.outcomes import outcomes
from taciturn.errors import UnstableError
from taciturn.loop import Loop
from taciturn.lqg.riccati import states_with_cost
from taciturn.model.estimate import Estimate
from taciturn.model.policy import LinkName, Send

LARGE = 1 / 3  # of the cost: a standard error above it is told
NEARLY = 1e-9  # growth above 1 that counts
HEAVY = 1.6  # index of a power law, estimated from 64 paths to an eighth: two standard errors below 2


def expect_arrivals(loop: Loop) -> None:
    """Refuse a loop whose mean square outages of a link make infinite, whatever the policy sends.

    Raises:
        UnstableError: a link that loses every packet, or too many in a row, of a plant that does not come to rest.
    """
    for link, outage, growth in _outages(loop):
        if outage == 1:
            raise UnstableError(
                f"the loop of {loop.policy.kind} diverges: the {link} link loses every packet, and the plant does not "
                "come to rest by itself; expected a loss below 1"
            )
        if outage * growth**2 >= 1:
            raise UnstableError(
                f"the loop of {loop.policy.kind} diverges: an outage of the {link} link lasts another tick with "
                f"probability {outage:.4g}, in which the mean square of the error grows {growth**2:.4g} times; "
                "expected a product below 1: fewer losses, or shorter bursts"
            )
    found = outcomes(loop)
    if found is not None and not found.decides and (growth := found.growth(2)) >= 1:
        raise UnstableError(
            f"the loop of {loop.policy.kind} diverges: with these losses its mean square grows {growth:.6g} times per "
            "tick; expected fewer losses"
        )


def find_doubts(
    loop: Loop, cost: Estimate, rates: Mapping[str, Estimate], steps: int, settled: bool
) -> tuple[str, ...]:
    """Return what makes a simulated average doubtful, for the reader of its numbers.

    Args:
        loop: the closed loop.
        cost: the average.
        rates: sends per tick, by link.
        steps: simulated steps of all paths together.
        settled: whether the loop had time to forget its start.
    """
    silent = [link for link, rate in rates.items() if rate.value == 0]
    notes: tuple[str, ...] = ()
    limit = loop.problem.plant.input_limit
    if limit is not None and np.isfinite(limit).all() and _fastest(loop) > 1 + NEARLY:
        notes += (
            "the plant is unstable and its inputs are limited: sooner or later the noise carries the state to where no "
            "input brings it back, so that no average exists; this one is of the time before",
        )
    if silent and comes_never_to_rest(loop):
        notes += (
            f"nothing was sent on the {silent[0]} link in the {steps} steps simulated, and the plant does not come to "
            "rest by itself: the cost is how far it got, not an average",
        )
    elif silent:
        notes += (f"nothing was sent on the {silent[0]} link in {steps} steps: the cost is that of silence",)
    elif not settled:
        notes += (
            f"the loop has not settled within {steps} steps: cost and rates are those of a start that is not yet "
            "forgotten, not averages",
        )
    return notes + doubt_errors(cost, steps)


def doubt_moments(loop: Loop) -> tuple[str, ...]:
    """Return a sentence where outages make the variance of the stage cost infinite."""
    for link, outage, growth in _outages(loop):
        if outage * growth**4 >= 1:
            return (
                f"the variance of the cost is infinite: an outage of the {link} link lasts another tick with "
                f"probability {outage:.4g}, in which the square of the cost grows {growth**4:.4g} times. So the "
                "standard error says nothing, and the average is probably too small",
            )
    found = outcomes(loop)
    if found is None or (growth := found.growth(4)) < 1:
        return ()
    if found.decides and (square := found.growth(2)) >= 1:
        return (
            f"with these losses the mean square would grow {square:.4g} times per tick if every packet were sent: the "
            "cost is probably infinite, and this average is of the time that was simulated",
        )
    sent = " if every packet is sent" if found.decides else ""
    return (
        f"the variance of the cost is infinite: with these losses its square grows {growth:.4g} times per tick{sent}. "
        "So the standard error says nothing, and the average is probably too small",
    )


def doubt_tail(tail: float) -> tuple[str, ...]:
    """Return a sentence where the costs of the paths have a tail in which a variance has no end."""
    if tail >= HEAVY:
        return ()
    return (
        f"the costs of the dearest paths fall off as a power law of index {tail:.2g}, and below 2 the variance is "
        "infinite: do not trust the standard error; the average is probably too small",
    )


def _outages(loop: Loop) -> list[tuple[str, float, float]]:
    """Return how probably an outage of a link lasts, and how fast an error grows in it, of links that nothing replaces.

    While nothing arrives, inputs do not depend on the noise since the last packet; so the fastest mode that this noise
    moves grows on its own. Only of a linear plant of which the cost sees all modes that do not decay.
    """
    policy, growth = loop.policy, _fastest(loop)
    if growth == 0 or "actuator" in policy.site("sensor"):
        return []
    links: set[LinkName] = {step.link for step in policy.steps if isinstance(step, Send)}
    needed = [link for link in sorted(links) if "controller" not in policy.site(link)]
    return [(link, loop.network.outage(link), growth) for link in needed]


def doubt_errors(cost: Estimate, steps: int) -> tuple[str, ...]:
    """Return a sentence where a standard error is as large as what it is of."""
    if cost.standard_error <= LARGE * abs(cost.value):
        return ()
    share = cost.standard_error / abs(cost.value) if cost.value else float("inf")
    return (
        f"the standard error is {share:.2g} of the cost after {steps} steps: a few ticks or paths cost more than all "
        "others, and the mean square may not exist",
    )


def comes_never_to_rest(loop: Loop) -> bool:
    """Tell whether noise moves a mode that does not decay, in a linear plant of which the cost sees all such modes.

    States without a cost-to-go do not count.
    """
    return _fastest(loop) > 0


def _fastest(loop: Loop) -> float:
    """Return the growth per tick, at least 1, of the fastest such mode; 0 where there is none."""
    problem, plant = loop.problem, loop.problem.plant
    if plant.function is not None:
        return 0.0
    seen = states_with_cost(plant.A, plant.B, problem.Q, problem.R, problem.N)
    place = np.ix_(seen, seen)
    A = plant.A[place]
    modes = np.sort(np.abs(persistent(eigenvalues(A), A, False)))
    if not modes.size or len(lost_modes(A.T, problem.Q[place], False)):
        return 0.0
    for still in np.abs(lost_modes(A, root(plant.W[place]), False)):
        modes = np.delete(modes, np.argmin(np.abs(modes - still)))
    return max(1.0, float(modes[-1])) if modes.size else 0.0
