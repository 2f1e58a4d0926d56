"""What ticks have cost that were run one by one: a mean with its error, or the total of one mission."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.problem import Problem
from taciturn.simulation.doubts import doubt_errors
from taciturn.simulation.statistics import BATCHES, batch_means
from taciturn.study.units import cost_unit

SETTLED = 5.0  # time constants that are left out of an average


def settled(loop: Loop) -> int:
    """Return the ticks that an average leaves out."""
    return 0 if loop.horizon is not None else int(np.ceil(SETTLED * loop.policy.settling))


def cost_of_ticks(loop: Loop, costs: Array, final: float) -> tuple[Estimate | None, tuple[str, ...]]:
    """Return the cost: a mean over the ticks in the units of the problem, or the total of one mission."""
    if loop.horizon is not None:
        discount = loop.problem.cost.discount
        total = float(costs @ discount ** np.arange(len(costs))) + (final if len(costs) == loop.horizon else 0.0)
        return Estimate(total, 0.0, "exact"), ("one mission: its cost is that of these draws, and no mean",)
    skipped = settled(loop)
    kept = costs[skipped:]
    if len(kept) < 10 * BATCHES:
        needed = skipped + 10 * BATCHES
        return None, (f"{len(costs)} ticks are too few for a mean cost with its error: expected at least {needed}",)
    found = batch_means(kept)
    notes = (f"means are without the first {skipped} ticks, in which the loop settles",) if skipped else ()
    cost = _in_units(loop, found)
    return cost, notes + doubt_errors(cost, len(kept))


def _in_units(loop: Loop, found: Estimate) -> Estimate:
    """Return a mean cost of ticks in the units of the problem."""
    return found.scaled(1 / loop.problem.tick, loop.problem.noise_cost / loop.problem.tick)


def plant_cost(problem: Problem, loop: Loop, costs: Sequence[Sequence[float]], final: float) -> dict[str, Any]:
    """Return what a plant reports of the costs of each tick of each loop, (loops, ticks), and of where they ended."""
    per_tick = np.mean(costs, axis=0)
    if not per_tick.size:
        return {"cost": None, "unit": cost_unit(problem), "notes": []}
    cost, notes = cost_of_ticks(loop, per_tick, final)
    cost = cost or _in_units(loop, Estimate(float(per_tick.mean()), 0.0, "exact"))
    return {"cost": measured(cost), "unit": cost_unit(problem), "notes": list(notes)}


def measured(estimate: Estimate) -> dict[str, Any]:
    """Return what a JSON document says of a number that was measured: without a standard error where it was once."""
    once = {"standard_error": None} if estimate.method == "exact" else {}
    return estimate.document() | once | {"method": "simulation"}
