"""Send rates of a loop around changes of its set-points: with constant set-points, and shortly after a change.

A rate that contains the stated changes says little about either: a loop may send rarely as long as the set-points are
constant, and at every sample for some seconds after each change. Both are simulated here.

* Steps at random times: paths of the loop without steps come to rest first. Then the set-points of each path make one
  step of the stated covariance.
* A timetable: its steps count as those after a change until the window ends, and otherwise as those of constant
  set-points. A rule that knows the timetable may also send before a change.

The window is four time constants of the loop that sends every sample, within which a transient falls to 2 %.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import ClassVar

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import factor
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.model.plant import altered
from taciturn.model.result import Field, Result, plain_fields
from taciturn.model.signals import RandomSteps, SampledChanges
from taciturn.program.engine import prepare
from taciturn.simulation.sampling import sends
from taciturn.simulation.statistics import mean
from taciturn.study.sentences import sends_text

PATHS = 2048
CONSTANTS, LONGEST = 12, 4096  # length of the transient at the start in time constants, and its most steps
SETTLED = 4  # time constants of the window
STEADY = 4  # windows over which the rate with constant set-points is averaged
MOST = 2e8  # steps of all paths together


@dataclass(frozen=True, repr=False)
class SetPointSteps(Result):
    """Send rates of a loop with constant set-points, and shortly after they change.

    Args:
        steady: sends per step or per second with constant set-points, by link; empty if a timetable has no such steps.
        after: sends per step or per second in the window after a change of the set-points, by link.
        window: length of this window in seconds, or in steps of a plant without ``dt``.
        seconds: whether the window is in seconds.
    """

    FIELDS: ClassVar[tuple[Field[SetPointSteps], ...]] = (
        Field("steady", key="rates_steady"),
        Field("after", key="rate_after_step"),
        *plain_fields("window"),
    )

    steady: Mapping[str, Estimate] = field(hash=False)
    after: Mapping[str, Estimate] = field(hash=False)
    window: float
    seconds: bool

    def sentence(self, unit: str) -> str:
        """Write the rates as one sentence. The argument states the unit of the rates."""
        length = f"{self.window:.3g} {'s' if self.seconds else 'steps'}"
        constant = f"; with constant set-points {sends_text(self.steady, unit)}" if self.steady else ""
        return f"within {length} after a change {sends_text(self.after, unit)}{constant}"


def rates_around_steps(loop: Loop, seed: int, pace: float) -> SetPointSteps | None:
    """Simulate the send rates around changes of the set-points; None if no changes are stated.

    ``pace`` converts sends per step to the unit of the rates.
    """
    plant, theory = loop.problem.plant, loop.policy.theory
    changes = plant.changes
    if loop.horizon is not None or changes is None or (isinstance(changes, RandomSteps) and not changes.rate):
        return None
    window = int(np.ceil(SETTLED * theory.recovers)) or 1
    burn = min(int(CONSTANTS * theory.settling) + 1, LONGEST)
    burn += 0 if loop.problem.loads is None else len(loop.problem.loads.table)  # until they have changed
    around = _timetable if isinstance(changes, SampledChanges) else _random
    steady, after = around(loop, seed, window, burn)
    length = window * (plant.dt or 1.0)
    scaled = [{link: one.scaled(pace) for link, one in found.items()} for found in (steady, after)]
    return SetPointSteps(scaled[0], scaled[1], length, plant.dt is not None)


Rates = dict[str, Estimate]


def _random(loop: Loop, seed: int, window: int, burn: int) -> tuple[Rates, Rates]:
    plant, cycle = loop.problem.plant, loop.policy.cycle
    changes = plant.changes
    assert isinstance(changes, RandomSteps)
    none = RandomSteps(0.0, np.zeros_like(changes.covariance))
    quiet = replace(loop, problem=replace(loop.problem, plant=altered(plant, {"changes": none})))
    program = quiet.program().keep({*sends(loop)})
    run = prepare(program)
    begun = run(quiet.start(program, PATHS, seed), _whole(burn, cycle), None)
    before = _whole(STEADY * window, cycle)
    found = run(begun.states, before, None)
    steady = {name.link: mean(found.sums[name] / before) for name in sends(loop)}
    states = found.states.copy()
    moved = [row for row, one in enumerate(program.states) if one.name == "x"][-changes.size :]
    root, draws = factor(changes.covariance), np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    states[moved] += root @ draws.standard_normal((root.shape[1], PATHS))
    found = run(states, window, None)
    return steady, {name.link: mean(found.sums[name] / window) for name in sends(loop)}


def _timetable(loop: Loop, seed: int, window: int, burn: int) -> tuple[Rates, Rates]:
    changes = loop.problem.plant.changes
    assert isinstance(changes, SampledChanges)
    rows = len(changes.table)
    length = np.lcm(rows, loop.policy.cycle)
    burn = _whole(burn, int(length))
    paths = int(max(2, min(PATHS, MOST // (burn + length))))
    program, names = loop.program().keep({*sends(loop)}), sends(loop)
    run, states = prepare(program), loop.start(program, paths, seed)
    states = run(states, burn, None).states
    changed = np.flatnonzero(np.tile(changes.table, (length // rows, 1)).any(axis=1)) + 1  # steps with new set-points
    since = np.full(length, window)
    for step in changed:
        ahead = np.arange(min(window, length))
        since[(step + ahead) % length] = np.minimum(since[(step + ahead) % length], ahead)
    fresh = since < window
    sums: dict[bool, Array] = {part: np.zeros((len(names), paths)) for part in (False, True)}
    edges = [0, *(np.flatnonzero(np.diff(fresh)) + 1).tolist(), int(length)]
    for first, last in pairwise(edges):
        found = run(states, last - first, None)
        states = found.states
        sums[bool(fresh[first])] += np.array([found.sums[name] for name in names])
    counts = {True: int(fresh.sum()), False: int((~fresh).sum())}
    steady, after = (
        {link: mean(total / counts[part]) for link, total in zip(loop.policy.scheduled, sums[part], strict=True)}
        if counts[part]
        else {}
        for part in (False, True)
    )
    return steady, after


def _whole(steps: int, cycle: int) -> int:
    """Return a number of steps as whole cycles of the policy."""
    return -(-steps // cycle) * cycle
