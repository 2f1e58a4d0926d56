"""Cost and rates of one loop by the cheapest method that holds."""

from __future__ import annotations

from dataclasses import replace

from taciturn.analyse.limits import solve_optimum
from taciturn.analyse.renewal import decides_alone, expect_affordable, sample_renewal, solve_renewal
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.renewal.chain import NoQuadratureError
from taciturn.simulation.average import average
from taciturn.simulation.sampling import RELATIVE_ERROR, Averages

FINEST, COARSEST = 1e-8, 1e-5  # relative accuracies that a quadrature is asked for, by the standard error


def measure(
    loop: Loop,
    seed: int,
    standard_error: float | None,
    steps: int | None,
    method: str,
    progress: Progress | None,
) -> tuple[Averages, tuple[str, ...]]:
    """Return cost and rates by the cheapest method that holds, and notes: those of the policy, and why it is slow."""
    policy, found = loop.policy, None
    notes = policy.notes
    if method == "exact" or (method == "auto" and (steps is None or policy.closed_form is not None)):
        try:
            found = _solved(loop, method == "exact", standard_error)
        except NoQuadratureError as error:
            if method == "exact":
                raise ProblemError(f"method is 'exact', and {error}") from None
            found = _sampled(loop, standard_error, seed) if decides_alone(policy) else None
            notes += (f"simulated, because {error.reason}",) if decides_alone(policy) and found is None else ()
    if found is not None and not found.steps:
        found = replace(found, reached=found.cost.error <= _wanted(found.cost, standard_error))
    if found is None or (method == "auto" and not found.reached):
        found = _clocked(loop, average(loop, seed=seed, standard_error=standard_error, steps=steps, progress=progress))
    return found, notes + found.notes


def _wanted(cost: Estimate, standard_error: float | None) -> float:
    """Return the standard error that is asked for."""
    return RELATIVE_ERROR * abs(cost.value) if standard_error is None else standard_error


def _sampled(loop: Loop, standard_error: float | None, seed: int) -> Averages | None:
    """Return averages of never-die paths, where they are quicker than a simulation."""
    policy = loop.policy
    assert policy.identity is not None
    rough = Estimate(policy.identity.constant, 0.0, "simulation")  # at most the cost
    try:
        found = sample_renewal(loop, _wanted(rough, standard_error), seed)
    except NoQuadratureError:
        return None
    if found is None:
        return None
    cost = found.excess.scaled(1.0, policy.identity.constant)
    reached = cost.standard_error <= _wanted(cost, standard_error)
    return Averages(cost, {policy.scheduled[0]: found.rate}, found.steps, 0, reached, estimator="never-die paths")


def measure_optimum(loop: Loop, price: float, method: str, steps: int | None) -> Averages:
    """Return cost and rate of the best schedule at a price per send."""
    if method == "simulation" or steps is not None:
        raise ProblemError("optimal is solved and never simulated; expected near-optimal, or neither method nor steps")
    policy, best = loop.policy, solve_optimum(loop, price)
    cost = Estimate(best.excess, 0.0, "quadrature", best.excess_error).scaled(1.0, policy.cost_all_time)
    rate = Estimate(best.rate, 0.0, "quadrature", best.rate_error)
    return Averages(cost, {policy.scheduled[0]: rate}, 0, 0, cost.error <= RELATIVE_ERROR * abs(cost.value))


def _solved(loop: Loop, whatever_it_takes: bool, standard_error: float | None) -> Averages:
    """Return exact cost and rates, or those of a quadrature, if it is affordable.

    Raises:
        NoQuadratureError: the loop has neither.
    """
    policy = loop.policy
    if loop.nominal and policy.closed_form is not None:
        form = policy.closed_form
        rates = {link: Estimate(rate, 0.0, "exact") for link, rate in form.rates.items()}
        return Averages(Estimate(form.cost, 0.0, "exact"), rates, 0, 0, True)
    if not whatever_it_takes:
        expect_affordable(loop)
    accuracy = None
    if standard_error is not None and loop.problem.jumps is None and policy.identity is not None:
        share = standard_error / max(abs(policy.identity.constant), 1e-300)
        accuracy = min(max(share, FINEST), COARSEST)
    renewal = solve_renewal(loop, accuracy)
    if accuracy is not None and standard_error is not None and renewal.excess_error > standard_error:
        renewal = solve_renewal(loop, max(standard_error / renewal.excess, FINEST))
    assert policy.identity is not None
    cost = Estimate(renewal.excess, 0.0, "quadrature", renewal.excess_error).scaled(1.0, policy.identity.constant)
    rate = Estimate(renewal.rate, 0.0, "quadrature", renewal.rate_error)
    return Averages(cost, {policy.scheduled[0]: rate}, 0, 0, True)


def _clocked(loop: Loop, found: Averages) -> Averages:
    """Return simulated averages with the rates that need no estimate."""
    policy = loop.policy
    known: dict[str, float] = {**policy.fixed_rates}
    if loop.nominal and policy.closed_form is not None:
        known |= policy.closed_form.rates
    return replace(found, rates={**found.rates, **{link: Estimate(rate, 0.0, "exact") for link, rate in known.items()}})
