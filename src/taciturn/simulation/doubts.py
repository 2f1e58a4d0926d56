"""Where an average over paths is none: packets that never come, and errors as large as what they are of."""

from __future__ import annotations

from collections.abc import Mapping

from taciturn._modes import eigenvalues, lost_modes, persistent, root
from taciturn.errors import UnstableError
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.model.policy import LinkName, Send

LARGE = 1 / 3  # of the cost: a standard error above it is told


def expect_arrivals(loop: Loop) -> None:
    """Refuse a loop on one of whose links nothing ever arrives, where the plant left alone costs ever more.

    Raises:
        UnstableError: such a link.
    """
    links: set[LinkName] = {step.link for step in loop.policy.steps if isinstance(step, Send)}
    for link in sorted(links):
        if _loss(loop, link) == 1 and comes_never_to_rest(loop):
            raise UnstableError(
                f"the loop of {loop.policy.kind} diverges: the {link} link loses every packet, and the plant does not "
                "come to rest by itself; expected a loss below 1"
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
    if silent and comes_never_to_rest(loop):
        notes += (
            f"nothing was sent on the {silent[0]} link in the {steps} steps simulated, and the plant does not come to "
            "rest by itself: the cost is how far it got, not an average",
        )
    elif not settled:
        notes += (
            f"the loop has not settled within {steps} steps: cost and rates are those of a start that is not yet "
            "forgotten, not averages",
        )
    return notes + doubt_errors(cost, steps)


def doubt_errors(cost: Estimate, steps: int) -> tuple[str, ...]:
    """Return a sentence where a standard error is as large as what it is of."""
    if cost.standard_error <= LARGE * abs(cost.value):
        return ()
    share = cost.standard_error / abs(cost.value) if cost.value else float("inf")
    return (
        f"the standard error is {share:.2g} of the cost after {steps} steps: a few ticks or paths cost more than all "
        "others, and the mean square may not exist",
    )


def _loss(loop: Loop, link: LinkName) -> float:
    """Return the share of a link's packets that is lost."""
    burst = loop.network.actuator_burst if link == "actuator" else loop.network.sensor_burst
    if burst is not None:
        return burst.loss
    return loop.network.actuator_loss if link == "actuator" else loop.network.sensor_loss


def comes_never_to_rest(loop: Loop) -> bool:
    """Tell whether noise moves a mode that does not decay, in a linear plant of which the cost sees all such modes."""
    plant = loop.problem.plant
    if plant.function is not None:
        return False
    A = plant.A
    all_modes = persistent(eigenvalues(A), A, False)
    still = lost_modes(A, root(plant.W), False)
    unseen = lost_modes(A.T, loop.problem.Q, False)
    return len(all_modes) > len(still) and not len(unseen)
