"""Stage cost and sends of a loop at each step, averaged over independent simulated paths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, count, instance
from taciturn._display import Displayed
from taciturn.loop import COST, Loop
from taciturn.model.estimate import Estimate
from taciturn.program.engine import prepare
from taciturn.simulation.nonfinite import find_loss
from taciturn.simulation.parts import sends
from taciturn.simulation.statistics import mean

PATHS = 4096


@dataclass(frozen=True, eq=False, repr=False)
class Course(Displayed):
    """Mean stage cost and sends of a loop over time, with standard errors.

    For an average cost, the stage cost is per unit of time, so that it converges to the average. For a finite horizon
    or a discount, it is the weighted cost of each step, so that the stage costs and the final cost add up to the total.

    Args:
        time: time in seconds, or in steps if the plant has no ``dt``, (steps,).
        cost: mean of x'Qx + û'Rû + 2x'Nû, (steps,).
        standard_error: standard error of the cost, (steps,).
        sends: fraction of the paths that send, by link, (steps,).
        sends_standard_error: standard error of these fractions, (steps,); 0 if all paths agree.
        final: mean cost of the final state; None before the end of a finite-horizon run, or without a terminal weight.
        paths: number of paths.
    """

    time: Array
    cost: Array
    standard_error: Array
    sends: Mapping[str, Array]
    sends_standard_error: Mapping[str, Array]
    final: Estimate | None
    paths: int


def course(loop: Loop, ticks: int, *, paths: int = PATHS, seed: int = 0) -> Course:
    """Simulate independent paths of a loop from its initial distribution, and average cost and sends at each step.

    Args:
        loop: the closed loop.
        ticks: number of steps, at least 1, and not beyond the end of a finite-horizon run.
        paths: number of paths, at least 2.
        seed: seed of the random draws.

    Returns:
        Cost and sends at each step.

    Raises:
        ProblemError: steps, paths or seed are out of range.
        UnstableError: the function of a nonlinear plant gives a non-finite number.

    Example:
        >>> from taciturn import Cost, Plant, close, design
        >>> plant, cost = Plant([[1.2]], [[1.0]], [[0.01]], mean=[3.0]), Cost([[1.0]], [[1.0]])
        >>> round(float(course(close(plant, design.all_time(plant, cost)), 20).cost[0]), 3)
        14.667
    """
    instance("loop", loop, Loop)
    ticks, paths, seed = loop.ticks(ticks), count("paths", paths, 2), count("seed", seed, 0)
    names = sends(loop)
    program = loop.program().keep({COST}, {*names}, {"x"})
    run, states = prepare(program), loop.start(program, paths, seed)
    state = [i for i, one in enumerate(program.states) if one.name == "x"]
    cost, sent = list[Estimate](), list[list[Estimate]]()
    for _ in range(ticks):
        found = run(states, 1, None)
        if not np.isfinite(found.states[state]).all():
            find_loss(loop, program, run, states, 1)
        states = found.states
        cost.append(mean(found.sums[COST]))
        sent.append([mean(found.outputs[name][0]) for name in names])
    final = loop.final_cost(program, states) if ticks == loop.problem.cost.horizon else None
    problem, unit = loop.problem, 1.0 if loop.horizon is not None else loop.problem.tick
    noise: Array = problem.noise_cost * np.power(problem.cost.discount, np.arange(float(ticks)))
    return Course(
        np.arange(ticks, dtype=np.float64) * (problem.plant.dt or 1.0),
        (np.array([stage.value for stage in cost]) + noise) / unit,
        np.array([stage.standard_error for stage in cost]) / unit,
        {link: np.array([tick[i].value for tick in sent]) for i, link in enumerate(loop.policy.scheduled)},
        {link: np.array([tick[i].standard_error for tick in sent]) for i, link in enumerate(loop.policy.scheduled)},
        None if final is None else mean(final),
        paths,
    )
