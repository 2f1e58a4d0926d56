"""One problem, one answer: cost, rates, bound."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from taciturn.analyse.renewal import expect_affordable, solve_renewal
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.model.schedule import Schedule
from taciturn.problem import Problem
from taciturn.program.ops import Precision
from taciturn.renewal.chain import NoQuadratureError
from taciturn.renewal.policy import EventPolicy
from taciturn.simulation.average import average, check_effort
from taciturn.simulation.events import average_events
from taciturn.simulation.sampling import RELATIVE_ERROR, Averages, Progress
from taciturn.study.periodic import actuation_of, periodic_cost_at


@dataclass(frozen=True)
class Evaluation:
    """What a policy costs, how often it sends, and what is proved of it.

    Args:
        policy: its kind.
        unit: what the cost counts per: ``"step"`` or ``"second"``, or ``"mission"`` for a finite horizon or a discount.
        base_rate: rate of sending at every tick; None where sends may come at any time.
        cost: per step or per second, or the total of a finite horizon.
        cost_all_time: exact cost of sending at every tick; None where the simulated plant is not the design's.
        statement: the theorem behind the bounds, or None.
        cost_bound: proved bound, or None.
        cost_bound_at_rate: the sharper bound at the measured rate, or None.
        rates: sends per step or per second, by scheduled link; of a mission the mean fraction of its steps,
            those of a discounted sum weighed as their costs.
        seed: of the draws.
        seconds: wall time.
        steps: simulated steps; 0 where nothing was simulated.
        reached: whether the asked standard error was met.
        schedule: of sensor queries, computed offline, or None.
        cost_periodic_same_rate: of optimal periodic control at the rate found, exact; None where it is not asked for
            (policies that send on the error of a prediction have it), or where none is stable.
        mean_interval: seconds from one send to the next; where the above is asked for and anything is sent.
        notes: what the reader must know.
    """

    policy: str
    unit: Literal["step", "second", "mission"]
    base_rate: float | None
    cost: Estimate
    cost_all_time: float | None
    statement: str | None
    cost_bound: float | None
    cost_bound_at_rate: float | None
    rates: Mapping[str, Estimate]
    seed: int
    seconds: float
    steps: int
    reached: bool
    schedule: Schedule | None
    cost_periodic_same_rate: float | None
    mean_interval: Estimate | None
    notes: tuple[str, ...]

    @property
    def rate_unit(self) -> Literal["step", "second"]:
        """What a rate counts per."""
        return "step" if self.unit == "mission" else self.unit

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn evaluate --json``."""
        result: dict[str, Any] = {
            "policy": self.policy,
            "unit": self.unit,
            "base_rate": self.base_rate,
            "cost": _estimate(self.cost),
            "cost_all_time": self.cost_all_time,
            "cost_bound": self.cost_bound,
            "cost_bound_at_rate": self.cost_bound_at_rate,
            "rates": {
                link: {"value": rate.value, "standard_error": rate.standard_error} for link, rate in self.rates.items()
            },
            "seed": self.seed,
            "seconds": round(self.seconds, 4),
            "steps": self.steps,
            "reached": self.reached,
        }
        if self.mean_interval is not None:
            result["cost_periodic_same_rate"] = self.cost_periodic_same_rate
            result["mean_interval"] = _estimate(self.mean_interval)
        if self.schedule is not None:
            result["schedule"] = self.schedule.document()
        return result | ({"notes": list(self.notes)} if self.notes else {})


def evaluate(
    problem: Problem,
    *,
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    method: Literal["auto", "simulation", "exact"] = "auto",
    precision: Precision = "float64",
    progress: Progress | None = None,
) -> Evaluation:
    """Return cost, rates and bound of a problem's policy.

    The cheapest method that holds is taken: a closed form where the policy ignores the state, quadrature of renewal
    equations where every send resets the error that decides, completion of squares in the innovations form, the plain
    average with the simulated plant.

    Args:
        problem: from ``load`` or ``Problem``.
        seed: of the draws, at least 0.
        standard_error: absolute, of the cost; omitted: 1e-4 of the cost.
        steps: run this many steps of all paths together instead; nothing that can be simulated is then solved.
        method: ``"simulation"`` uses neither closed form nor quadrature, ``"exact"`` never simulates.
        precision: of what is simulated: ``"float64"``, or ``"float32"``, 1.8 times as fast.
        progress: called with the fraction done.

    Returns:
        The evaluation; ``reached`` is False where the budget ended before the asked standard error.

    Raises:
        ProblemError: data that do not fit, or no exact method.
        UnstableError: the loop diverges.

    Example:
        >>> from taciturn import load
        >>> evaluate(load("two-mass"), steps=100_000).policy
        'lqg'
    """
    check_effort(seed, standard_error, steps)
    if method not in ("auto", "simulation", "exact"):
        raise ProblemError(f"method is {method!r}; expected 'auto', 'simulation' or 'exact'")
    began = time.perf_counter()
    policy = problem.designed()
    if isinstance(policy, EventPolicy):
        if precision != "float64":
            raise ProblemError(f"precision is {precision!r}, and {policy.kind} without a period runs in 'float64' only")
        found = _events(problem, policy, seed, standard_error, steps, method, progress)
        return replace(found, seconds=time.perf_counter() - began)
    loop = replace(problem.close(policy), precision=precision)
    found, notes = None, policy.notes
    if method == "exact" or (method == "auto" and (steps is None or policy.closed_form is not None)):
        try:
            found = _solved(loop, method == "exact")
        except NoQuadratureError as error:
            if method == "exact":
                raise ProblemError(f"method is 'exact', and {error}") from None
            notes += () if policy.reset is None else (f"simulated: {error}",)
    if found is not None:
        wanted = RELATIVE_ERROR * abs(found.cost.value) if standard_error is None else standard_error
        found = replace(found, reached=found.cost.error <= wanted)
    if found is None or (method == "auto" and not found.reached):
        found = _clocked(loop, average(loop, seed=seed, standard_error=standard_error, steps=steps, progress=progress))
    guarantee = policy.guarantee if loop.nominal else None
    per_tick = found.rates[policy.scheduled[0]].value
    mission = loop.horizon is not None
    pace = 1.0 if mission else 1 / policy.tick
    return Evaluation(
        policy=policy.kind,
        unit="mission" if mission else unit_of(problem),
        base_rate=pace,
        cost=found.cost,
        cost_all_time=policy.cost_all_time if loop.nominal else None,
        statement=None if guarantee is None else guarantee.statement,
        cost_bound=None if guarantee is None else guarantee.cost,
        cost_bound_at_rate=None if guarantee is None else guarantee.at_rate(per_tick),
        rates={link: rate.scaled(pace) for link, rate in found.rates.items()},
        seed=seed,
        seconds=time.perf_counter() - began,
        steps=found.steps,
        reached=found.reached,
        schedule=policy.schedule,
        cost_periodic_same_rate=_periodic(problem, policy, per_tick) if loop.nominal else None,
        mean_interval=_interval(found.rates[policy.scheduled[0]], policy.tick) if _predicts(policy) else None,
        notes=notes + tuple(f"{text}: no guarantee holds" for text in loop.departures),
    )


def unit_of(problem: Problem) -> Literal["step", "second"]:
    """Return what averages of a problem count per."""
    return "second" if isinstance(problem.plant, ContinuousPlant) else "step"


def _events(
    problem: Problem,
    policy: EventPolicy,
    seed: int,
    standard_error: float | None,
    steps: int | None,
    method: str,
    progress: Progress | None,
) -> Evaluation:
    """Return the evaluation of a policy without ticks."""
    if method == "exact":
        raise ProblemError(f"method is 'exact', and {policy.kind} has no exact method; expected 'auto' or 'simulation'")
    for name, given in (("[plant.actual]", problem.actual), ("plant.input_limit", policy.plant.input_limit)):
        if given is not None:
            raise ProblemError(
                f"{name} is given, which {policy.kind} without a period does not use; expected policy.period, or none"
            )
    found = average_events(policy, seed=seed, standard_error=standard_error, steps=steps, progress=progress)
    rate = found.rates["sensor"]
    interval = _interval(rate, 1.0)
    assert interval is not None
    return Evaluation(
        policy=policy.kind,
        unit="second",
        base_rate=None,
        cost=found.cost,
        cost_all_time=policy.cost_all_time,
        statement=policy.statement,
        cost_bound=policy.bound(),
        cost_bound_at_rate=policy.bound(interval.value),
        rates=found.rates,
        seed=seed,
        seconds=0.0,
        steps=found.steps,
        reached=found.reached,
        schedule=None,
        cost_periodic_same_rate=periodic_cost_at(problem, rate.value, actuation_of(problem)),
        mean_interval=interval,
        notes=policy.notes,
    )


def _solved(loop: Loop, whatever_it_takes: bool) -> Averages:
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
    renewal = solve_renewal(loop)
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


def _predicts(policy: Policy) -> bool:
    """Whether both ends predict in continuous time, and events decide when the prediction is corrected."""
    return policy.prediction is not None and policy.closed_form is None


def _periodic(problem: Problem, policy: Policy, rate: float) -> float | None:
    """Return the cost of periodic control at a rate of sends per tick, for a policy that is compared with it."""
    return periodic_cost_at(problem, rate / policy.tick, actuation_of(problem)) if _predicts(policy) else None


def _interval(rate: Estimate, tick: float) -> Estimate | None:
    """Return the mean seconds between sends, or None where nothing is sent."""
    return rate.inverse(tick) if rate.value > 0 else None


def _estimate(estimate: Estimate) -> dict[str, Any]:
    found = {"value": estimate.value, "standard_error": estimate.standard_error, "method": estimate.method}
    return found | ({"error": estimate.error} if estimate.method == "quadrature" else {})
