"""Search for the shares of several links in a common threshold that meet a budget at the least traffic or cost.

A policy that decides on several links divides its threshold among them. With the threshold of link l as the square of
a scale times a share, the common scale and the shares are the unknowns; their logarithms are searched, in trials of a
few steps that all use the same draws.

* At a given cost, or at a given traffic, one share is changed at a time, by a step that is halved until it gains
  nothing. For each trial of the shares the common scale is adapted, by secant steps within a bracket, until the budget
  is met; what is left of the distance is corrected along the slope of the last two trials.
* At given rates of single links, each of these links gets the share at which it reaches its limit, in turns, since each
  share changes the rates of the others a little. All other links send every sample.

Source: khashooei2017
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from taciturn.design.kind import TradeoffParameter
from taciturn.errors import TaciturnError, UnstableError
from taciturn.extend import Array, Displayed, Progress, Stages
from taciturn.problem import Problem
from taciturn.study.evaluation import Evaluation
from taciturn_studies.goal import Goal, RatesGoal
from taciturn_studies.search import LONGER, Search, out_of_reach, settled

EFFORT = 400_000  # steps of a trial, or more if the loop settles later; all trials use the same draws
FIRST, LAST = 1.6, 0.2  # first and last step of the search, in the logarithm of a share
WORTH = 3e-4  # least relative improvement for which the search continues
CLOSE = 3e-3  # relative distance from the budget at which a scale is accepted, and the rest corrected
TRIES, ROUNDS = 12, 8  # trials for one scale, and rounds over all links for given rates
SLOPE = 0.5  # first guess of the change of the logarithm of a rate or cost, per unit of the scale
STRIDE, FARTHEST = 1.5, 12.0  # longest step of a scale, and longest way from the start, in the logarithm
LEAST = 1e-6  # least ratio to the budget, for rates of 0
LEFT = 0.97  # share of the remaining progress that a trial leaves


@dataclass(frozen=True, eq=False, repr=False)
class Trial(Displayed):
    """A trial with a threshold for each link."""

    # logarithm of the share of each link, plus that of a common scale, whose square is the tuning parameter
    logs: Array
    evaluation: Evaluation  # cost and rates


class Division:
    """Search for the shares of the links in a common threshold, for the links on which a policy decides."""

    def __init__(
        self, problem: Problem, tuning: TradeoffParameter, goal: Goal, seed: int, progress: Progress | None
    ) -> None:
        """Prepare the search; nothing is tried yet."""
        assert problem.record.shares is not None
        self._problem, self._tuning, self._goal, self._seed = problem, tuning, goal, seed
        self._name, self._links = problem.record.shares, list(problem.network.links)
        self._progress, self._done = progress, 0
        self._effort = EFFORT
        self._longer = LONGER if isinstance(goal, RatesGoal) else 1  # other shares that do not settle are left out
        # slopes of the limited and of the minimised quantity, at the last scale
        self._slopes: tuple[float, float] | None = None

    def best(self) -> dict[str, object]:
        """Return the best shares, rounded to three digits and scaled to the mean 1, and the threshold for them."""
        logs = self._given_rates(self._goal) if isinstance(self._goal, RatesGoal) else self._cheapest()
        return {self._tuning.name: self._whole(logs), self._name: self._shares(logs)}

    def _cheapest(self) -> Array:
        """Return the shares of the least traffic at the budgeted cost, or of the least cost at the budgeted traffic.

        The search changes one share at a time, and adapts the threshold of all links so that the budget is met. Equal
        shares are first, for which the threshold is sought as for given shares.
        """
        equal = self._problem.changed({self._name: dict.fromkeys(self._links, 1.0)})
        search = Search(equal, self._tuning, self._goal, self._seed, self._stage())
        found, _ = search.close_in(*search.bracket())
        logs = np.full(len(self._links), 0.5 * np.log(found.value) - np.log(len(self._links)))
        best, worth = self._first(logs) or (Trial(logs, found.evaluation), self._other(found.evaluation))
        step = FIRST
        while step >= LAST:
            before = worth
            for place in range(len(self._links)):
                for by in (step, -step):
                    logs = best.logs.copy()
                    logs[place] += by
                    try:
                        tried, value = self._scaled(logs)
                    except TaciturnError:
                        continue  # this budget cannot be met with these shares
                    if value < worth - WORTH * abs(worth):
                        best, worth = tried, value
                        break
            if worth >= before - WORTH * abs(before):
                step /= 2
        return best.logs

    def _first(self, logs: Array) -> tuple[Trial, float] | None:
        """Return the first trial, in which the loop settles if one does; None if this budget cannot be met."""
        # It has the draws of all trials, since other draws may cost less by chance. A loop that does not settle in it
        # does so with no shares, so all trials are longer.
        for longer in (1, LONGER):
            self._effort = longer * EFFORT
            try:
                return self._scaled(logs)
            except UnstableError:
                continue
            except TaciturnError:
                return None
        return None

    def _other(self, found: Evaluation) -> float:
        """Return the quantity to be minimised."""
        return self._goal.use(found).value if self._goal.limits_cost else found.cost.value

    def _scaled(self, logs: Array) -> tuple[Trial, float]:
        """Return a trial whose common scale meets the budget, and the quantity to be minimised there."""
        goal = self._goal
        sign = 1.0 if goal.limits_cost else -1.0  # of the change of the limited quantity with the scale

        def above(trial: Trial) -> float:
            return float(np.log(max(goal.of(trial.evaluation).value / goal.budget, LEAST)))

        def other(trial: Trial) -> float:
            return self._other(trial.evaluation)

        return self._root(logs, np.ones(len(logs)), above, other, sign, (goal.name, goal.budget))

    def _root(
        self,
        logs: Array,
        direction: Array,
        above: Callable[[Trial], float],
        other: Callable[[Trial], float],
        sign: float,
        budget: tuple[str, float],
    ) -> tuple[Trial, float]:
        """Return a trial along a direction at which ``above`` is 0, and the value of ``other`` exactly there."""
        place, last = 0.0, None
        slope, along = self._slopes or (SLOPE * sign, None)
        low, high = -FARTHEST, FARTHEST
        tried: list[tuple[float, float]] = []
        for _ in range(TRIES):
            trial = self._try(logs + place * direction)
            missing = above(trial)
            tried.append((self._whole(trial.logs), budget[1] * float(np.exp(missing))))
            if last is not None and place != last[0]:
                along = (other(trial) - last[2]) / (place - last[0])
                if (missing - last[1]) * (place - last[0]) * sign > 0:
                    slope = (missing - last[1]) / (place - last[0])
            if abs(missing) <= CLOSE and along is not None:
                self._slopes = slope, along
                return trial, other(trial) - along * missing / slope
            if missing * sign > 0:
                high = min(high, place)
            else:
                low = max(low, place)
            last = place, missing, other(trial)
            moved = place - float(np.clip(missing / slope, -STRIDE, STRIDE))
            place = moved if low < moved < high else (low + high) / 2
        raise out_of_reach(self._problem.kind, self._tuning.name, *budget, tried)

    def _given_rates(self, goal: RatesGoal) -> Array:
        """Return the shares at which the links with a limit reach it; the others send every sample."""
        named = [self._links.index(link) for link in goal.limits]
        logs = np.full(len(self._links), -np.inf)
        given = self._problem.parameters.get(self._tuning.name)
        start = 0.5 * float(np.log(given)) if isinstance(given, int | float) and given > 0 else 0.0
        logs[named] = start - np.log(len(named))
        axes = np.eye(len(self._links))
        for _ in range(ROUNDS):
            before = logs.copy()
            for place in named:
                self._slopes = None
                link = self._links[place]

                def above(trial: Trial, link: str = link) -> float:
                    least = 0.5 * (trial.evaluation.base_rate or 1.0) / EFFORT  # half a send in a trial
                    return float(np.log(max(trial.evaluation.rates[link].value, least) / goal.limits[link]))

                limit = f"rate of {link}", goal.limits[link]
                logs = self._root(logs, axes[place], above, lambda _: 0.0, -1.0, limit)[0].logs
            if np.abs(logs[named] - before[named]).max() < CLOSE or len(named) == 1:
                break
        return logs

    def _try(self, logs: Array) -> Trial:
        changed = self._problem.changed(
            {self._tuning.name: self._whole(logs), self._name: self._shares(logs, digits=17)}
        )
        stage = self._stage()
        found = settled(changed, self._tuning.name, self._seed, self._effort, stage, self._longer)
        stage(1.0)
        return Trial(logs, found)

    def _stage(self) -> Stages:
        """Return the progress of the next trial."""
        self._done += 1
        return Stages(self._progress, *(1 - LEFT ** (self._done - k) for k in (1, 0)))

    def _whole(self, logs: Array) -> float:
        """Return the tuning parameter."""
        return float(np.exp(2 * np.logaddexp.reduce(logs[np.isfinite(logs)])))

    def _shares(self, logs: Array, digits: int = 3) -> dict[str, float]:
        """Return the shares with the mean 1 of the links that do not send every sample."""
        finite = np.isfinite(logs)
        share = np.exp(logs - np.logaddexp.reduce(logs[finite])) * finite.sum()
        return {link: float(f"{one:.{digits}g}") for link, one in zip(self._links, share, strict=True)}
