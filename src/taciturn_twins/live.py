"""Live page of a twin in real time, on which users can pause the run, push the robot, and tune the policy."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from taciturn.errors import ProblemError
from taciturn.problem import Problem, parse
from taciturn_twins.baseline import Baseline
from taciturn_twins.mission import MISSIONS
from taciturn_twins.outcome import Trial
from taciturn_twins.page import About, Page
from taciturn_twins.prepared import Prepared
from taciturn_twins.run import TwinRun
from taciturn_twins.steps import LINKS, Row, Steps
from taciturn_twins.trial import Setup, Watcher, run_trial
from taciturn_twins.world import TwinPlant

NAP = 0.02  # seconds between two checks while waiting
NEWTONS, SECONDS = {"rover": 4.0, "omni": 15.0}, 0.3  # force and duration of a push


def watch_twin(
    prepared: Prepared,
    page: Page,
    setup: Setup,
    *,
    parameters: Mapping[str, float] | None = None,
    speed: float = 1.0,
    rounds: int | None = None,
    stopped: Callable[[], bool] = lambda: False,
    ended: Callable[[TwinRun], object] = lambda run: None,
) -> TwinRun | None:
    """Run missions one after another on a live page, next to a second loop that sends every sample.

    Users can set one parameter of the policy on the page. A new value ends the round, and the next round uses it.

    Args:
        prepared: the robot, its camera and its model.
        page: the page.
        setup: configuration of each round, with one robot; round k has the seed ``setup.seed + k``.
        parameters: parameters of the policy in the first round.
        speed: simulated seconds per second of real time, for runs in virtual time; 0: as fast as possible.
        rounds: number of rounds; default: until stopped.
        stopped: function that returns whether to end.
        ended: function called with each complete round.

    Returns:
        The last complete round, with the loop that sends every sample under the same faults and pushes, or None.

    Raises:
        ProblemError: as for ``taciturn_twins.run.run_twin``.
    """
    chosen, done, last = dict(parameters or {}), 0, None
    while not stopped() and (rounds is None or done < rounds):
        problem = parse(prepared.tables(chosen), "the mission")
        how = replace(setup, seed=setup.seed + done)
        page.wait(f"round {done}: starting the processes of both loops")
        began = time.monotonic()
        shown = _Round(prepared, page, problem, done, how, speed, stopped)
        try:
            found = shown.run()
        except ProblemError:
            if stopped():  # the stop request arrived while the processes started
                break
            raise
        done += 1
        if found is not None:
            trial, always = found
            last = TwinRun(prepared, problem.design(), trial, always, how, time.monotonic() - began)
            ended(last)
        if shown.value is not None:
            chosen[MISSIONS[prepared.robot.name].parameter[0]] = shown.value
    return last


class _Round:
    """One mission on the live page.

    Args:
        number: number of the round; ``watch_twin`` describes the other arguments.
    """

    def __init__(
        self,
        prepared: Prepared,
        page: Page,
        problem: Problem,
        number: int,
        setup: Setup,
        speed: float,
        stopped: Callable[[], bool],
    ) -> None:
        self._prepared, self._robot, self._page, self._problem = prepared, prepared.robot, page, problem
        self._number, self._setup, self._speed, self._stopped = number, setup, speed, stopped
        self.value: float | None = None  # new value of the tuning parameter
        self._paused, self._zero, self._pushes = False, 0.0, 0
        self._picture, self._pictured = Path(), 0
        self._steps = Steps(problem.network, setup, self._robot.tick, self._show)
        self._baseline = Baseline(prepared, setup, problem, page.compare, self._push)

    def run(self) -> tuple[Trial, Trial] | None:
        """Run the first loop and the loop that sends every sample; return both trials, or None if one ends early."""
        complete = False
        watcher = Watcher(self._before, self._steps.add, self._ends, self._start, self._steps.finish, True)
        try:
            trial = run_trial(self._prepared, self._setup, self._problem, watcher=watcher)
            complete = trial.costs.shape[1] == self._problem.cost.horizon
        finally:
            always = self._baseline.end(complete)
        return None if always is None else (trial, always)

    def _start(self, folder: Path) -> None:
        self._picture = folder / "picture.jpg"
        self._steps.start(folder)

    def _ends(self) -> bool:
        return self._stopped() or self.value is not None or self._baseline.failed

    def _before(self, step: int, plants: Sequence[TwinPlant]) -> None:
        """Execute the requests of users, and wait until the step is due."""
        virtual = self._setup.tick is None
        while virtual and not self._ends() and not self._baseline.has_ended(step - 1, NAP):
            pass
        if step == 0:
            self._begin()
            self._zero = time.monotonic()
        while True:
            for what, value in self._page.asked():
                self._obey(what, value, step, plants)
            now, due = time.monotonic(), self._zero + (step * self._robot.tick / self._speed if self._speed else 0.0)
            if not virtual or self._ends() or (now >= due and not self._paused):
                break
            if self._paused:
                self._zero += NAP
            time.sleep(NAP if self._paused else min(NAP, due - now))
        for fault in self._setup.faults:
            first, last = fault.ticks(self._robot.tick)
            if step == first:
                self._page.note(f"fault {fault} begins in both loops", step)
            elif step == last and fault.lasts:
                self._page.note(f"fault {fault} ends", step)
        self._baseline.permit(step, self._pushes)
        self._pushes = 0

    def _begin(self) -> None:
        """Describe the round on the page."""
        problem, robot = self._problem, self._robot
        policy, horizon, reference = problem.design(), problem.cost.horizon, problem.reference
        mission = MISSIONS[robot.name]
        name, low, high = mission.parameter
        value = float(problem.parameters[name])
        assert horizon is not None
        self._page.begin(
            About(
                robot=robot.name,
                policy=problem.kind,
                tick=robot.tick,
                ticks=horizon,
                states=robot.states,
                inputs=robot.inputs,
                links=LINKS,
                losses=tuple(problem.network.loss(link) for link in LINKS),
                bound=None if policy.guarantee is None or self._setup.faults else policy.guarantee.cost,
                reference=() if reference is None else tuple(map(tuple, reference.states.tolist())),
                parameter=(name, min(low, value), max(high, value)),
                meaning=mission.meaning,
                value=value,
                round=self._number,
                pauses=self._setup.tick is None,
            )
        )

    def _obey(self, what: str, value: float, step: int, plants: Sequence[TwinPlant]) -> None:
        if what == "value":
            self.value = value
        elif what == "push":
            for plant in plants:
                self._push(plant)
            self._pushes += 1
            self._page.note(f"push of both robots: {NEWTONS[self._robot.name]:g} N for {SECONDS:g} s", step)
        elif what == "pause" and self._setup.tick is not None:
            self._page.note("pause has no effect on a run in real time", step)
        elif what == "pause":
            self._paused = value > 0

    def _push(self, plant: TwinPlant) -> None:
        plant.body.push(NEWTONS[self._robot.name], SECONDS)

    def _show(self, row: Row, events: list[str]) -> None:
        self._page.put(row)
        for event in events:
            self._page.note(event, row["tick"])
        if self._picture.exists() and (written := self._picture.stat().st_mtime_ns) != self._pictured:
            self._pictured = written
            self._page.show(self._picture.read_bytes())
