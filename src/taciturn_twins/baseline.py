"""A second loop that sends every sample, with the disturbances and packet losses of the first loop on the live page."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from taciturn.errors import ProblemError
from taciturn.problem import Problem
from taciturn_twins.mission import all_time
from taciturn_twins.outcome import Trial
from taciturn_twins.prepared import Prepared
from taciturn_twins.steps import Row, Steps
from taciturn_twins.trial import Setup, Watcher, run_trial
from taciturn_twins.world import TwinPlant


class Baseline:
    """A thread that runs the policy that sends every sample, in virtual time and never ahead of the loop on the page.

    Args:
        prepared: the robot, its camera and its model.
        setup: configuration of the watched loop; packet k of a link is dropped in both loops or in neither.
        problem: problem of the watched loop.
        show: function called with each step.
        push: function that pushes a robot, as a user does on the page.
    """

    def __init__(
        self,
        prepared: Prepared,
        setup: Setup,
        problem: Problem,
        show: Callable[[Row], None],
        push: Callable[[TwinPlant], None],
    ) -> None:
        """Start the processes of the loop."""
        self._push, self._turn = push, threading.Condition()
        self._permitted = self._finished = -1  # last step that the loop may begin, and last step that it has completed
        self._ready = self._ended = False
        self._pushes: dict[int, int] = {}
        self._steps = Steps(problem.network, setup, prepared.robot.tick, lambda row, _: show(row))
        watcher = Watcher(self._before, self._told, lambda: self._ended, self._steps.start, self._steps.finish)
        self._pool = ThreadPoolExecutor(1, "baseline")
        how = replace(setup, tick=None)
        self._trial = self._pool.submit(run_trial, prepared, how, all_time(problem), None, watcher)

    @property
    def failed(self) -> bool:
        """Whether the loop has ended with an error."""
        return self._trial.done() and self._trial.exception() is not None

    def permit(self, step: int, pushes: int) -> None:
        """Allow the loop to begin a step, after users have pushed the robot ``pushes`` times."""
        with self._turn:
            self._permitted, self._pushes[step] = step, pushes
            self._turn.notify_all()

    def has_ended(self, step: int, patience: float) -> bool:
        """Wait at most ``patience`` seconds until the loop has completed a step; return whether it has completed it.

        Step -1 is completed when the loop is ready for its first step. For a loop that has failed or was stopped, the
        result is True for every step.
        """
        with self._turn:
            return self._turn.wait_for(
                lambda: (self._ready and self._finished >= step) or self._ended or self._trial.done(), patience
            )

    def end(self, complete: bool) -> Trial | None:
        """End this loop and return its trial; if ``complete`` is true, first wait until its last step is done.

        Raises:
            ProblemError: the loop failed before this call, or after the watched loop was complete.
        """
        failed = self.failed
        with self._turn:
            self._ended = not complete
            self._turn.notify_all()
        self._pool.shutdown()
        try:
            trial = self._trial.result()
        except ProblemError:
            if complete or failed:
                raise
            return None  # the processes were still starting
        return trial if complete else None

    def _before(self, step: int, plants: Sequence[TwinPlant]) -> None:
        with self._turn:
            self._ready = True
            self._turn.notify_all()
            self._turn.wait_for(lambda: self._permitted >= step or self._ended)
            pushes = self._pushes.pop(step, 0)
        for _ in range(pushes):
            for plant in plants:
                self._push(plant)

    def _told(self, line: Mapping[str, Any]) -> None:
        self._steps.add(line)
        with self._turn:
            self._finished = line["tick"]
            self._turn.notify_all()
