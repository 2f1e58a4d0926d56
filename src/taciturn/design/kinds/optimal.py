"""Optimal send schedule for an error that a send resets, for a given price per send."""

from __future__ import annotations

from taciturn._arrays import number
from taciturn.design.bounds import LARGEST_PARAMETER
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.design.prediction import modelled
from taciturn.errors import ProblemError
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.trigger import Form
from taciturn.renewal.policy import OptimalPolicy


def optimal(plant: Plant | ContinuousPlant, cost: Cost, *, price: float, period: float | None = None) -> OptimalPolicy:
    """Design the send schedule that minimises J + λ·rate, the cost J plus a price λ for each send.

    The rate is in sends per step or per second.

    The actuator runs a model. A send resets the prediction error e, and silence costs e'Γe beyond sending every sample.
    The optimal schedule sends iff e'Γe + V(e) > g, where V(e) = E min(0, e⁺'Γe⁺ + V(e⁺) − g) is the value of not
    sending and g is the least average cost. It is computed by policy iteration on the renewal equations, for at most
    three states (``renewal/optimal``). Nodes cannot run this schedule; ``near_optimal`` has a trigger for nodes.

    Args:
        plant: the plant; if it is continuous in time with measured full state, both ends predict in continuous time.
        cost: the average cost.
        price: price λ > 0 of a send, in cost per step (for a continuous plant, cost per second times seconds).
        period: seconds between checks; only with a continuous plant.

    Returns:
        The optimal stopping problem, which is solved when the policy is evaluated.

    Raises:
        ProblemError: if λ is not positive, the plant has jumps or a function, or period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: cogill2007

    Example:
        >>> optimal(Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), price=10.0).price
        10.0
    """
    price = number("price", price, 0.0, LARGEST_PARAMETER)
    if getattr(plant, "exosystem", None) is not None:
        raise ProblemError(
            "disturbances or set-points are given, which optimal does not use; expected near-optimal, or neither"
        )
    if getattr(plant, "jumps", None) is not None:
        raise ProblemError("the noise consists of jumps; expected Gaussian noise for optimal, or the kind near-optimal")
    if getattr(plant, "function", None) is not None:
        raise ProblemError("the plant has a function; expected a linear plant for optimal, or the kind near-optimal")
    policy = modelled(
        "optimal",
        plant,
        cost,
        period,
        lambda problem, reset: Form((reset.error,), reset.weight, -price / problem.tick),
    )
    return OptimalPolicy("optimal", policy, price, "near-optimal")


KIND = Kind(
    name="optimal",
    design=optimal,
    goal="the possible remaining improvement, for analysis: nodes cannot run it",
    tuning=(TradeoffParameter("price"),),
    example={"price": 1.0, "period": 0.1},
    built_in="wiener-double-integrator",
    nodes="none",
    plants=("discrete", "continuous", "outputs"),
    follows=(),
    proved="the least cost of all schedules",
    refused=(
        "a price as for `near-optimal`; jumps; nonlinear plants; errors of more than three dimensions, or with a "
        "direction that the noise between two checks does not excite"
    ),
    data=(
        "an `OptimalPolicy`: a price, and a policy with the same nodes that defines the loop; its free "
        "boundary is not a quadratic form"
    ),
    order="`close` refuses a loop of nodes",
)
