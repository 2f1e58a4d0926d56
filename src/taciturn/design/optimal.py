"""The best schedule of an error that a send resets, at a price per send."""

from __future__ import annotations

from taciturn._arrays import number
from taciturn.design.bounds import LARGEST
from taciturn.design.near_optimal import modelled
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.trigger import Form
from taciturn.renewal.policy import OptimalPolicy


def optimal(plant: Plant | ContinuousPlant, cost: Cost, *, price: float, period: float | None = None) -> OptimalPolicy:
    """Design the schedule that minimises J + λ·rate, in sends per step or per second.

    The actuator runs a model, so that a send resets the error e of what it predicts, and silence costs e'Γe beyond
    sending always. The best schedule sends iff e'Γe + V(e) > g, V(e) = E min(0, e⁺'Γe⁺ + V(e⁺) − g) the value of
    keeping e, g the least average. It is found by policy iteration on the renewal equations of at most three states
    (``renewal/optimal``). Nodes do not run it: ``near_optimal`` has a trigger that they do.

    Args:
        plant: the plant; where it is continuous and its full state measured, both ends predict in continuous time.
        cost: the average cost.
        price: λ > 0, of a send, in the units of the cost per step, or per second times seconds.
        period: seconds between checks; only with a continuous plant.

    Returns:
        What evaluation solves.

    Raises:
        ProblemError: λ not positive; noise in jumps with an output that is measured; period missing or out of place.
        UnstableError: no stabilising gain or filter.

    Source: cogill2007

    Example:
        >>> optimal(Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), price=10.0).price
        10.0
    """
    price = number("price", price, 0.0, LARGEST)
    policy = modelled(
        "optimal",
        plant,
        cost,
        period,
        lambda problem, reset: Form((reset.error,), reset.square, -price / problem.tick),
    )
    return OptimalPolicy("optimal", policy, price)
