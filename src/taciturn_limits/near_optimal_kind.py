"""Near-optimal trigger for an error that a send resets to 0; a fitted function predicts what a send saves later."""

from __future__ import annotations

from taciturn.design.bounds import LARGEST_PARAMETER
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.design.prediction import modelled
from taciturn.extend import number
from taciturn.lqg.discrete import Discrete
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.theory import Reset
from taciturn.model.trigger import Form, GaussianTerm


def near_optimal(plant: Plant | ContinuousPlant, cost: Cost, *, price: float, period: float | None = None) -> Policy:
    """Design the policy that nearly minimises J + λ·rate, where J is the cost and λ the price of a send.

    The rate is in sends per step or per second.

    The actuator runs a model. A send resets the prediction error e, and silence costs e'Γe beyond sending every sample.
    The optimal schedule sends iff e'Γe + V(e) > g, where −V(e) is the expected later saving if nothing is sent. This
    policy approximates the saving by the best fit of a Gaussian function, −V(e) = exp(a − ½e'Πe). Its distance from the
    optimum is not bounded in advance, but ``cost_lower_bound`` shows it for each problem.

    Args:
        plant: the plant; if it is continuous in time with measured full state, both ends predict in continuous time.
        cost: the average cost.
        price: price λ > 0 of a send, in cost per step (for a continuous plant, cost per second times seconds).
        period: seconds between checks; only with a continuous plant.

    Returns:
        The policy.

    Raises:
        ProblemError: if λ is not positive or so large that nothing is ever sent, the plant has jumps and C or V, or
            period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: cogill2007

    Example:
        >>> policy = near_optimal(Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), price=10.0)
        >>> policy.decisions["send"].labels
        ('silent', 'send')
    """
    price = number("price", price, 0.0, LARGEST_PARAMETER)
    return modelled("near-optimal", plant, cost, period, lambda problem, reset: _silence(problem, reset, price))


def _silence(problem: Discrete, reset: Reset, price: float) -> Form:
    from taciturn_limits.fitted import fit_schedule  # imported here, since its import is slow

    found = fit_schedule(problem.plant.A, reset.covariance, reset.weight, price / problem.tick)
    return Form((reset.error,), reset.weight, -found.gain, bell=GaussianTerm(-found.height, found.Pi))


KIND = Kind(
    name="near-optimal",
    design=near_optimal,
    goal="a price per packet, with cost + price × rate close to its minimum",
    tuning=(TradeoffParameter("price"),),
    example={"price": 1.0, "period": 0.1},
    built_in="wiener-double-integrator",
    nodes="S+C, A; for a continuous plant with measured state S, C+A",
    follows=("constant",),
    proved="no guarantee in advance; `evaluate` reports a lower bound for all schedules",
    refused="a price so high that the policy would almost never send; jumps with `C` or `V`",
    data="a trigger form with a bell, over `deviation` or `error`",
    order="operations of `lqg` with model; for S, C+A those of `consistent`",
    offered=2,
)
