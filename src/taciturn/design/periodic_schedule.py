"""The best offline pattern: so many sends within so many ticks, again and again."""

from __future__ import annotations

from math import comb

from taciturn._arrays import count
from taciturn.design.certainty import design_certainty
from taciturn.design.periodic import held_by_the_clock
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.periodic import Pattern, necklaces
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy

MOST_PATTERNS = 2000
LONGEST = 1000  # ticks of a pattern


def periodic_schedule(
    plant: Plant | ContinuousPlant, cost: Cost, *, length: int, sends: int, period: float | None = None
) -> Policy:
    """Design the best controller that sends at fixed places of a pattern that repeats.

    Every pattern of ``length`` ticks with ``sends`` sends is tried, up to rotation. Between sends the input is held;
    each has the optimal gains of its periodic Riccati equation and its exact cost.

    Args:
        plant: the plant.
        cost: the average cost.
        length: ticks of the pattern.
        sends: of these, at least 1 and at most ``length``.
        period: seconds between ticks; only with a continuous plant.

    Returns:
        The policy, with its exact cost.

    Raises:
        ProblemError: more sends than ticks, more than 1,000 ticks or 2,000 patterns, period missing or out of place.
        UnstableError: no pattern has a stabilising gain.

    Source: bengaid2006

    Example:
        >>> plant, cost = Plant([[1.1]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> periodic_schedule(plant, cost, length=5, sends=2).closed_form.rates
        {'actuator': 0.4}
    """
    length, sends = count("length", length), count("sends", sends)
    if length > LONGEST:
        raise ProblemError(f"length is {length}; expected at most {LONGEST} ticks")
    if sends > length:
        raise ProblemError(f"sends is {sends} and length is {length}; expected at most as many sends as ticks")
    if comb(length - 1, sends - 1) > MOST_PATTERNS * sends:
        raise ProblemError(
            f"length is {length} and sends is {sends}, which is some {comb(length, sends) // length} patterns; "
            f"expected at most {MOST_PATTERNS}: a shorter pattern, or fewer sends"
        )
    problem = discretise(plant, cost, period)
    certainty = design_certainty("periodic-schedule", problem)
    found: Pattern | None = None
    for intervals in necklaces(length, sends):
        try:
            tried = certainty.held.solve(intervals)
        except UnstableError:
            continue
        found = tried if found is None or tried.cost < found.cost else found
    if found is None:
        raise UnstableError(
            f"no pattern of {sends} sends in {length} ticks can be stabilised: held so long, the input loses a mode; "
            "expected another length, or more sends"
        )
    return held_by_the_clock("periodic-schedule", certainty, found)
