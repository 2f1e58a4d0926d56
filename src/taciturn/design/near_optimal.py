"""Nearly optimal trigger for an error that a send resets, with a fitted function for the savings in later steps."""

from __future__ import annotations

from collections.abc import Callable

from taciturn._arrays import number
from taciturn.design.bounds import LARGEST_PARAMETER
from taciturn.design.certainty import SEND, certainty_policy, control_steps, design_certainty
from taciturn.design.prediction import predict_continuously, predicted_policy
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.theory import Reset
from taciturn.model.trigger import Form, GaussianTerm, Trigger


def near_optimal(plant: Plant | ContinuousPlant, cost: Cost, *, price: float, period: float | None = None) -> Policy:
    """Design the policy that nearly minimises J + λ·rate, the cost J plus a price λ for each send.

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


def modelled(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    silence: Callable[[Discrete, Reset], Form],
) -> Policy:
    """Return a policy whose actuator runs a model, and which sends if a function of the model's error is positive.

    Args:
        kind: name of the policy kind in the catalogue.
        plant: the plant; if it is continuous in time with measured full state, both ends predict in continuous time.
        cost: the average cost.
        period: seconds between checks; only with a continuous plant.
        silence: function that returns the form over the error of the reset.
    """
    if isinstance(plant, ContinuousPlant) and plant.full_state:
        found = predict_continuously(kind, plant, cost, period)
        rule = Trigger({"silent": silence(found.problem, found.reset), SEND: Form()})
        return predicted_policy(kind, found, rule, notes=_notes(found.problem))
    problem = discretise(plant, cost, period)
    certainty = design_certainty(kind, problem)
    reset = certainty.reset("model")
    if reset is None:
        raise ProblemError(
            "the plant has jumps and C or V is given, so successive estimation errors are dependent; "
            "expected Gaussian noise, or neither C nor V"
        )
    rule = Trigger({"silent": silence(problem, reset), SEND: Form()})
    steps, initial = control_steps(problem.plant, certainty.estimation, certainty.regulator.L, "model", rule)
    return certainty_policy(
        kind, certainty, steps, initial, identity=certainty.completed_square(), reset=reset, notes=_notes(problem)
    )


def _notes(problem: Discrete) -> tuple[str, ...]:
    """Return a note on the approximation of jumps by Gaussian noise, if the plant has jumps."""
    told = "the plant has jumps: the schedule is optimised for Gaussian noise of the same covariance"
    return () if problem.jumps is None else (told,)


def _silence(problem: Discrete, reset: Reset, price: float) -> Form:
    from taciturn.renewal.fitted import fit_schedule  # imported here, since its import is slow

    found = fit_schedule(problem.plant.A, reset.covariance, reset.weight, price / problem.tick)
    return Form((reset.error,), reset.weight, -found.gain, bell=GaussianTerm(-found.height, found.Pi))
