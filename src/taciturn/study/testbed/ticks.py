"""Cost of recorded steps: a mean with its standard error, or the total of one finite-horizon run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.problem import Problem
from taciturn.simulation.reliability import doubt_errors
from taciturn.simulation.statistics import BATCHES, batch_means
from taciturn.study.units import cost_unit

SETTLED = 5.0  # time constants at the start that an average omits


def settled(loop: Loop) -> int:
    """Return the number of steps at the start that an average omits."""
    return 0 if loop.horizon is not None else int(np.ceil(SETTLED * loop.policy.theory.settling))


def cost_of_ticks(loop: Loop, costs: Array, final: float) -> tuple[Estimate | None, tuple[str, ...]]:
    """Return the mean cost of the steps in the units of the problem, or the total of one finite-horizon run."""
    if loop.horizon is not None:
        discount = loop.problem.cost.discount
        total = float(costs @ discount ** np.arange(len(costs))) + (final if len(costs) == loop.horizon else 0.0)
        return Estimate(total, 0.0, "exact"), ("one finite-horizon run: its cost is one realisation, not a mean",)
    skipped = settled(loop)
    kept = costs[skipped:]
    if len(kept) < 10 * BATCHES:
        needed = skipped + 10 * BATCHES
        return None, (f"{len(costs)} steps are too few for a mean cost with its error; expected at least {needed}",)
    found = batch_means(kept)
    notes = loop.problem.remarks
    notes += (f"means omit the first {skipped} steps, in which the loop settles",) if skipped else ()
    cost = _in_units(loop, found)
    return cost, notes + doubt_errors(cost, len(kept))


def rate_of_ticks(loop: Loop, sends: Array) -> Estimate:
    """Return the share of steps with a send, without an error if the run has a finite horizon or is too short.

    Sends of successive steps are correlated, so only batch means have a valid standard error. It is at least one send
    in all these steps.
    """
    kept = sends[settled(loop) :]
    if loop.horizon is not None or len(kept) < 10 * BATCHES:
        return Estimate(float(sends.mean()), 0.0, "exact")
    found = batch_means(kept)
    return Estimate(found.value, max(found.standard_error, 1 / len(kept)), found.method)


def remark_on_rates(rates: Iterable[Estimate], steps: int) -> tuple[str, ...]:
    """Return a remark if rates were measured only once."""
    if all(rate.method != "exact" for rate in rates):
        return ()
    return (f"the rates are those of this run of {steps} steps, without standard errors",)


def _in_units(loop: Loop, found: Estimate) -> Estimate:
    """Return a mean cost per step in the units of the problem."""
    return found.scaled(1 / loop.problem.tick, loop.problem.noise_cost / loop.problem.tick)


def plant_cost(problem: Problem, loop: Loop, costs: Sequence[Sequence[float]], final: float) -> dict[str, Any]:
    """Return a plant's report on its cost, from the costs of all steps, (loops, steps), and of the final state."""
    per_tick = np.mean(costs, axis=0)
    if not per_tick.size:
        return {"cost": None, "unit": cost_unit(problem), "notes": []}
    cost, notes = cost_of_ticks(loop, per_tick, final)
    cost = cost or _in_units(loop, Estimate(float(per_tick.mean()), 0.0, "exact"))
    return {"cost": measured(cost), "unit": cost_unit(problem), "notes": list(notes)}


def measured(estimate: Estimate) -> dict[str, Any]:
    """Return the JSON document of a measured number, without a standard error if it was measured only once."""
    once = {"standard_error": None} if estimate.method == "exact" else {}
    return estimate.document() | once | {"method": "simulation"}
