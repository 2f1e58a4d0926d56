"""One problem, one answer: cost, rates, bound."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant
from taciturn.problem import Problem
from taciturn.simulation.average import Averages, Progress, average, check_effort


@dataclass(frozen=True)
class Evaluation:
    """What a policy costs, how often it sends, and what is proved of it.

    Args:
        policy: its kind.
        unit: what cost and rates count per: ``"step"`` or ``"second"``, or ``"mission"`` for a finite horizon.
        base_rate: sends per unit at every tick.
        cost: per step or per second, or the total of a finite horizon.
        cost_all_time: exact cost of sending at every tick; None where the simulated plant is not the design's.
        cost_bound: proved bound, or None.
        cost_bound_at_rate: the sharper bound at the measured rate, or None.
        rates: sends per step or per second, by scheduled link.
        seed: of the draws.
        seconds: wall time.
        steps: simulated steps; 0 where nothing was simulated.
        reached: whether the asked standard error was met.
        notes: what the reader must know.
    """

    policy: str
    unit: Literal["step", "second", "mission"]
    base_rate: float
    cost: Estimate
    cost_all_time: float | None
    cost_bound: float | None
    cost_bound_at_rate: float | None
    rates: Mapping[str, Estimate]
    seed: int
    seconds: float
    steps: int
    reached: bool
    notes: tuple[str, ...]

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
        return result | ({"notes": list(self.notes)} if self.notes else {})


def evaluate(
    problem: Problem,
    *,
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    method: Literal["auto", "simulation", "exact"] = "auto",
    progress: Progress | None = None,
) -> Evaluation:
    """Return cost, rates and bound of a problem's policy.

    The cheapest method that holds is taken: a closed form where the policy ignores the state, completion of squares in
    the innovations form, the plain average with the simulated plant.

    Args:
        problem: from ``load`` or ``Problem``.
        seed: of the draws, at least 0.
        standard_error: absolute, of the cost; omitted: 1e-4 of the cost.
        steps: run this many steps of all paths together instead.
        method: ``"simulation"`` never uses a closed form, ``"exact"`` never simulates.
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
    policy = problem.design()
    loop = problem.close(policy)
    form = policy.closed_form if loop.nominal else None
    if method == "exact" and form is None:
        raise ProblemError(
            f"method is 'exact', and {policy.kind} has no closed form here; expected 'auto' or 'simulation'"
        )
    if form is not None and method != "simulation":
        rates = {link: Estimate(rate, 0.0, "exact") for link, rate in form.rates.items()}
        found = Averages(Estimate(form.cost, 0.0, "exact"), rates, 0, 0, True)
    else:
        found = average(loop, seed=seed, standard_error=standard_error, steps=steps, progress=progress)
        if form is not None:  # a clock needs no estimate
            found = replace(found, rates={link: Estimate(rate, 0.0, "exact") for link, rate in form.rates.items()})
    guarantee = policy.guarantee if loop.nominal else None
    per_tick = found.rates[policy.scheduled[0]].value
    return Evaluation(
        policy=policy.kind,
        unit="mission" if loop.horizon is not None else unit_of(problem),
        base_rate=1 / policy.tick,
        cost=found.cost,
        cost_all_time=policy.cost_all_time if loop.nominal else None,
        cost_bound=None if guarantee is None else guarantee.cost,
        cost_bound_at_rate=None if guarantee is None else guarantee.at_rate(per_tick),
        rates={link: rate.scaled(1 / policy.tick) for link, rate in found.rates.items()},
        seed=seed,
        seconds=time.perf_counter() - began,
        steps=found.steps,
        reached=found.reached,
        notes=()
        if loop.nominal
        else ("the plant is not the one of the design (plant.actual or input_limit): no guarantee holds",),
    )


def unit_of(problem: Problem) -> Literal["step", "second"]:
    """Return what averages of a problem count per."""
    return "second" if isinstance(problem.plant, ContinuousPlant) else "step"


def _estimate(estimate: Estimate) -> dict[str, Any]:
    return {"value": estimate.value, "standard_error": estimate.standard_error, "method": estimate.method}
