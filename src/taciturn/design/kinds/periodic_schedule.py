"""The optimal repeating schedule of a given length with a given number of sends.

All cycles of intervals with this number and sum are tried, one rotation of each (necklaces), with the optimal gains and
the exact cost of each (``lqg/periodic``). A cycle in which no gain stabilises the plant is left out.

Source: bengaid2006
"""

from __future__ import annotations

from math import comb

from taciturn._arrays import count
from taciturn._text import number_of
from taciturn.base.certainty import design_certainty
from taciturn.design.at_fixed_steps import held_in_cycles
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.periodic import necklaces
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy

MOST_PATTERNS = 2000
LONGEST = 1000  # largest number of steps of a pattern


def periodic_schedule(
    plant: Plant | ContinuousPlant, cost: Cost, *, length: int, sends: int, period: float | None = None
) -> Policy:
    """Design optimal control with a repeating schedule of given length and number of sends.

    All patterns of ``length`` steps with ``sends`` sends are compared, up to rotation. The input is held between sends.
    Each pattern is evaluated with the optimal gains of its periodic Riccati equation and its exact cost.

    Args:
        plant: the plant.
        cost: the average cost.
        length: number of steps of the pattern.
        sends: number of sends in the pattern, at least 1 and at most ``length``.
        period: seconds between steps; only with a continuous plant.

    Returns:
        The policy, with its exact cost.

    Raises:
        ProblemError: if there are more sends than steps, more than 1,000 steps or more than 2,000 patterns, or period
            is missing or not applicable.
        UnstableError: if no pattern has a stabilising gain.

    Source: bengaid2006

    Example:
        >>> plant, cost = Plant([[1.1]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> periodic_schedule(plant, cost, length=5, sends=2).theory.closed_form.rates
        {'actuator': 0.4}
    """
    length, sends = count("length", length), count("sends", sends)
    if length > LONGEST:
        raise ProblemError(f"length = {length}; expected at most {LONGEST} steps")
    if sends > length:
        raise ProblemError(f"sends = {sends} and length = {length}; expected at most as many sends as steps")
    if comb(length - 1, sends - 1) > MOST_PATTERNS * sends:
        raise ProblemError(
            f"length = {length} and sends = {sends}, which gives about {comb(length, sends) // length} patterns; "
            f"expected at most {MOST_PATTERNS} patterns: choose a shorter pattern, or fewer sends"
        )
    problem = discretise(plant, cost, period)
    certainty = design_certainty("periodic-schedule", problem)
    found, lost = None, None
    for intervals in necklaces(length, sends):
        try:
            tried = certainty.held.solve(intervals)
        except UnstableError as error:
            lost = error
            continue
        found = tried if found is None or tried.cost < found.cost else found
    if found is None:
        raise UnstableError(
            f"no pattern of {number_of(sends, 'send')} in {number_of(length, 'step')} has a stabilising gain: {lost}"
        )
    return held_in_cycles("periodic-schedule", certainty, found)


KIND = Kind(
    name="periodic-schedule",
    design=periodic_schedule,
    goal="the best periodic pattern with a given number of sends",
    tuning=(TradeoffParameter("sends", least=1, whole=True, falls=False),),
    example={"length": 4, "sends": 2},
    proved="cost and rate, exactly",
    data="the step counter `clock` of the pattern; sends and gains are read by `clock`",
    order="operations of `periodic`",
    usual={"length": 5, "sends": 2},
)
