"""The nearly optimal trigger of an error that a send resets: silence also gains what it saves later."""

from __future__ import annotations

from collections.abc import Callable

from taciturn._arrays import number
from taciturn.design.bounds import LARGEST
from taciturn.design.certainty import SEND, certainty_policy, control_steps, design_certainty
from taciturn.design.prediction import predict_continuously, predicted_policy
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.theory import Reset
from taciturn.model.trigger import Bell, Form, Trigger


def near_optimal(plant: Plant | ContinuousPlant, cost: Cost, *, price: float, period: float | None = None) -> Policy:
    """Design the schedule that nearly minimises J + λ·rate, in sends per step or per second.

    The actuator runs a model, so that a send resets the error e of what it predicts, and silence costs e'Γe beyond
    sending always. The best schedule sends iff e'Γe + V(e) > g, where −V(e) is what may still be saved if e is kept;
    this one has its best fit by a bell, −V(e) = exp(a − ½e'Πe). It is the best of all schedules to within the digits
    that ``cost_lower_bound`` shows; nothing is proved beforehand.

    Args:
        plant: the plant; where it is continuous and its full state measured, both ends predict in continuous time.
        cost: the average cost.
        price: λ > 0, of a send, in the units of the cost per step, or per second times seconds.
        period: seconds between checks; only with a continuous plant.

    Returns:
        The policy.

    Raises:
        ProblemError: λ not positive, or so large that nothing is ever sent; noise in jumps with an output that is
            measured; period missing or out of place.
        UnstableError: no stabilising gain or filter.

    Source: cogill2007

    Example:
        >>> policy = near_optimal(Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), price=10.0)
        >>> policy.decisions["send"].labels
        ('silent', 'send')
    """
    price = number("price", price, 0.0, LARGEST)
    return modelled("near-optimal", plant, cost, period, lambda problem, reset: _silence(problem, reset, price))


def modelled(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    silence: Callable[[Discrete, Reset], Form],
) -> Policy:
    """Return the policy whose actuator runs a model and that sends where a form of the model's error is above 0.

    Args:
        kind: name in the catalogue.
        plant: the plant; where it is continuous and its full state measured, both ends predict in continuous time.
        cost: the average cost.
        period: seconds between checks; only with a continuous plant.
        silence: gives the form, over the error of the reset.
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
            "the noise comes in jumps and C or V is given, so that the errors of the estimate depend on each other; "
            "expected Gaussian noise, or neither C nor V"
        )
    rule = Trigger({"silent": silence(problem, reset), SEND: Form()})
    steps, initial = control_steps(problem.plant, certainty.estimation, certainty.regulator.L, "model", rule)
    return certainty_policy(
        kind, certainty, steps, initial, identity=certainty.completed_square(), reset=reset, notes=_notes(problem)
    )


def _notes(problem: Discrete) -> tuple[str, ...]:
    """Say what a schedule under jumps is not."""
    told = "the noise comes in jumps: the best schedule is that of Gaussian noise of the same covariance"
    return () if problem.jumps is None else (told,)


def _silence(problem: Discrete, reset: Reset, price: float) -> Form:
    from taciturn.renewal.fitted import fit_schedule  # statistics, that take a while to import

    found = fit_schedule(problem.plant.A, reset.covariance, reset.square, price / problem.tick)
    return Form((reset.error,), reset.square, -found.gain, bell=Bell(-found.height, found.Pi))
