"""Cost and rates from recorded steps: means with standard errors, or totals of runs with a horizon or a discount.

A mean omits the first steps, five time constants of the loop (``settled``). The costs of the other steps are
correlated, so the standard error is that of the means of batches. It is valid only if the batches are nearly
independent. So a batch lasts several time constants, and contains a change of set-points or a jump if these are rare
(``piece_of``). A shorter record has a mean without a standard error.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from taciturn.extend import Array, number_of
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.model.signals import RandomSteps, SampledChanges
from taciturn.problem import Problem
from taciturn.simulation.reliability import doubt_errors
from taciturn.simulation.statistics import BATCHES, batch_means
from taciturn.study.evaluation import cost_unit

SETTLED = 5.0  # time constants at the start that an average omits
FEWEST = 10  # least steps of a batch
APART = 3.0  # least length of a batch in time constants of the loop, or six of the cost, which is a square


def settled(loop: Loop) -> int:
    """Return how many steps at the start an average omits, because loads change or the loop has not settled yet."""
    loads = loop.problem.loads
    changing = 0 if loads is None else len(loads.table) - 1
    return 0 if loop.horizon is not None else changing + int(np.ceil(SETTLED * loop.policy.theory.settling))


def piece_of(loop: Loop) -> tuple[float, float, str]:
    """Return how many steps a batch needs at least for a valid standard error, and which event determines this.

    Batches are independent only if each lasts several time constants of the loop. If changes of set-points or jumps are
    rare, they determine the cost. A record with only a few such events contains only a few independent pieces, however
    many steps it has.
    """
    changes, settling = loop.problem.plant.changes, loop.policy.theory.settling
    found = [(float(FEWEST), 1.0, "steps"), (APART * settling, settling, "time constants of the loop")]
    if isinstance(changes, RandomSteps) and changes.rate:
        found.append((1 / changes.rate, 1 / changes.rate, "changes of set-points"))
    if isinstance(changes, SampledChanges):
        table = float(len(changes.table))
        found.append((table, table, "repetitions of the timetable"))
    if loop.problem.jumps is not None:
        jumps = 1 / (loop.problem.jumps.jumps.rate * loop.problem.jumps.period)
        found.append((jumps, jumps, "jumps"))
    return max(found)


def least_steps(loop: Loop) -> int:
    """Return how many steps an average needs for a valid standard error, not counting the omitted initial steps."""
    return int(np.ceil(piece_of(loop)[0])) * BATCHES


def cost_of_ticks(loop: Loop, costs: Array, final: float) -> tuple[Estimate | None, tuple[str, ...]]:
    """Return the mean cost in the problem's units; for a run with a horizon or a discount factor, the total cost."""
    if loop.horizon is not None:
        discount = loop.problem.cost.discount
        total = float(costs @ discount ** np.arange(len(costs))) + (final if len(costs) == loop.horizon else 0.0)
        run = "finite-horizon run" if discount == 1.0 else "run with discounted costs"
        return Estimate(total, 0.0, "exact"), (f"one {run}: its cost is one realisation, not a mean",)
    skipped = settled(loop)
    kept = costs[skipped:]
    _, once, why = piece_of(loop)
    needed = skipped + least_steps(loop)
    short = (
        f"a run of {number_of(len(costs), 'step')} is too short for a mean cost with its error; expected at least "
        f"{needed}"
    )
    if len(kept) < FEWEST * BATCHES:
        return None, (short,)
    if len(kept) < least_steps(loop):
        mean = _in_units(loop, Estimate(float(kept.mean()), 0.0, "exact"))
        return mean, (f"{short}: the cost is that of this run, with about {len(kept) / once:.2g} {why}",)
    found = batch_means(kept)
    notes = loop.problem.remarks
    notes += (f"means omit the first {number_of(skipped, 'step')}, in which the loop settles",) if skipped else ()
    cost = _in_units(loop, found)
    return cost, notes + doubt_errors(cost, len(kept))


def rate_of_ticks(loop: Loop, sends: Array) -> Estimate:
    """Return the fraction of steps with a send; a finite or very short run gives no standard error.

    Sends of successive steps are correlated, so only batch means have a valid standard error. The standard error is at
    least that of one send in all these steps.
    """
    kept = sends[settled(loop) :]
    if loop.horizon is not None or len(kept) < least_steps(loop):
        return Estimate(float(sends.mean()), 0.0, "exact")
    found = batch_means(kept)
    return Estimate(found.value, max(found.standard_error, 1 / len(kept)), found.method)


def remark_on_rates(loop: Loop, rates: Iterable[Estimate], steps: int) -> tuple[str, ...]:
    """Return a note that the rates have no standard errors, if they come from a single run."""
    if all(rate.method != "exact" for rate in rates):
        return ()
    counted = ", and later sends are not discounted" if loop.problem.cost.discount < 1 else ""
    return (f"the rates are those of this run of {number_of(steps, 'step')}, without standard errors{counted}",)


def _in_units(loop: Loop, found: Estimate) -> Estimate:
    """Return a mean cost per step in the units of the problem."""
    return found.scaled(1 / loop.problem.tick, loop.problem.noise_cost / loop.problem.tick)


def plant_cost(problem: Problem, loop: Loop, costs: Sequence[Sequence[float]], final: float) -> dict[str, Any]:
    """Return the plant's report on its cost, from the costs of all steps, (loops, steps), and of the final states."""
    per_tick = np.mean(costs, axis=0)
    if not per_tick.size:
        return {"cost": None, "unit": cost_unit(problem), "notes": []}
    cost, notes = cost_of_ticks(loop, per_tick, final)
    cost = cost or _in_units(loop, Estimate(float(per_tick.mean()), 0.0, "exact"))
    return {"cost": measured(cost), "unit": cost_unit(problem), "notes": list(notes)}


def measured(estimate: Estimate) -> dict[str, Any]:
    """Return the JSON document of a measured number; one measurement alone has no standard error."""
    once = {"standard_error": None} if estimate.method == "exact" else {}
    return estimate.document() | once | {"method": "simulation"}
