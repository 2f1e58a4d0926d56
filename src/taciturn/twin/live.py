"""A twin that is watched: round after round at the pace of the real robot, while people pause, push and turn a knob."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from taciturn.errors import ProblemError
from taciturn.model.policy import ENDS, LinkName
from taciturn.problem import Problem, parse
from taciturn.twin.mission import MISSIONS
from taciturn.twin.outcome import ESTIMATE, trigger_values
from taciturn.twin.page import About, Page
from taciturn.twin.prepared import Prepared
from taciturn.twin.robot import Robot
from taciturn.twin.run import TwinRun
from taciturn.twin.trial import Setup, Watcher, run_trial
from taciturn.twin.world import TwinPlant

LOGS = ("sensor", "controller", "actuator", "seen")
BEHIND = 2  # ticks after which all that belongs to a tick has been logged
NAP = 0.02  # seconds
NEWTONS, SECONDS = {"rover": 4.0, "omni": 15.0}, 0.3  # of a push


def watch_twin(
    prepared: Prepared,
    page: Page,
    setup: Setup,
    *,
    parameters: Mapping[str, float] | None = None,
    speed: float = 1.0,
    rounds: int | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> TwinRun | None:
    """Run mission after mission, and show them.

    The knob of the page is a parameter of the policy: where it is turned, the round ends and the next has its value.

    Args:
        prepared: the robot, its camera and its model.
        page: where it is shown.
        setup: how it runs; one robot.
        parameters: of the policy, in the first round.
        speed: of the robot's clock beside that of the wall, in virtual time; 0: as fast as may be.
        rounds: to run; omitted: until stopped.
        stopped: whether to end.

    Returns:
        The last mission that was run to its end, if any.

    Raises:
        ProblemError: as ``taciturn.twin.run.run_twin``.
    """
    chosen, done, last = dict(parameters or {}), 0, None
    while not stopped() and (rounds is None or done < rounds):
        problem = parse(prepared.tables(chosen), "the mission")
        show = _Round(prepared.robot, page, problem, done, setup, speed, stopped)
        show.begin()
        began = time.monotonic()
        how = replace(setup, seed=setup.seed + done)
        try:
            trial = run_trial(prepared, how, problem, watcher=show.watcher())
        except ProblemError:
            if stopped():  # while processes were being started
                break
            raise
        show.finish()
        done += 1
        if trial.costs.shape[1] == problem.cost.horizon:
            last = TwinRun(prepared, problem.design(), trial, None, how, time.monotonic() - began)
        if show.value is not None:
            chosen[MISSIONS[prepared.robot.name].knob[0]] = show.value
    return last


class _Tail:
    """The lines that have been added to a log."""

    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0

    def read(self) -> Iterator[Mapping[str, Any]]:
        """Give the new lines that are whole."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._at)
            for line in file:
                if not line.endswith(b"\n"):
                    break
                self._at += len(line)
                yield json.loads(line)


class _Round:
    """One mission on the page.

    Args:
        as ``watch_twin``; and the problem, and the number of the round.
    """

    def __init__(
        self,
        robot: Robot,
        page: Page,
        problem: Problem,
        number: int,
        setup: Setup,
        speed: float,
        stopped: Callable[[], bool],
    ) -> None:
        self._robot, self._page, self._problem, self._number = robot, page, problem, number
        self._setup, self._speed, self._stopped = setup, speed, stopped
        self._policy = problem.design()
        self.value: float | None = None  # of the knob, where somebody has turned it
        self._paused, self._zero = False, time.monotonic()
        self._rows: deque[dict[str, Any]] = deque()
        self._known: dict[str, dict[int, Mapping[str, Any]]] = {name: {} for name in LOGS}
        self._folder = Path()
        self._tails: dict[str, _Tail] = {}
        self._cost, self._sends = 0.0, dict[LinkName, int].fromkeys(ENDS, 0)
        self._pictured = 0

    def begin(self) -> None:
        """Tell the page what the round is."""
        problem, robot = self._problem, self._robot
        name, low, high = MISSIONS[robot.name].knob
        guarantee, horizon, reference = self._policy.guarantee, problem.cost.horizon, problem.reference
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
                links=("sensor", "actuator"),
                bound=None if guarantee is None else guarantee.cost,
                reference=() if reference is None else tuple(map(tuple, reference.states.tolist())),
                knob=(name, min(low, value), max(high, value)),
                value=value,
                round=self._number,
            )
        )

    def watcher(self) -> Watcher:
        """Return what takes part in the trial."""
        return Watcher(self._before, self._told, lambda: self._stopped() or self.value is not None, self._start, True)

    def _start(self, folder: Path) -> None:
        self._folder, self._zero = folder, time.monotonic()
        self._tails = {name: _Tail(folder / f"{name}.jsonl") for name in LOGS}

    def _before(self, tick: int, plants: Sequence[TwinPlant]) -> None:
        """Obey, and wait until the tick is due."""
        if tick == 0:
            self._zero = time.monotonic()
        while True:
            for what, value in self._page.asked():
                self._obey(what, value, plants)
            due = self._zero + (tick * self._robot.tick / self._speed if self._speed else 0.0)
            if self._setup.tick is not None or self._stopped() or self.value is not None:
                return
            if self._paused:
                self._zero += NAP
            elif time.monotonic() >= due:
                return
            time.sleep(NAP if self._paused else min(NAP, max(0.0, due - time.monotonic())))

    def _obey(self, what: str, value: float, plants: Sequence[TwinPlant]) -> None:
        if what == "value":
            self.value = value
        elif what == "push":
            for plant in plants:
                plant.body.push(NEWTONS[self._robot.name], SECONDS)
            self._page.note("somebody has pushed the robot")
        elif what == "pause" and self._setup.tick is not None:
            self._page.note("this run goes by the clock, and cannot be paused")
        elif what == "pause":
            self._paused = value > 0

    def _told(self, line: Mapping[str, Any]) -> None:
        """Note what the world tells of a tick, and show the tick of which all is known by now."""
        self._rows.append(dict(line))
        if len(self._rows) > BEHIND:
            self._show()

    def finish(self) -> None:
        """Show the ticks that are left."""
        while self._rows:
            self._show()

    def _show(self) -> None:
        for name, tail in self._tails.items():
            self._known[name].update((entry["tick"], entry) for entry in tail.read())
        world = self._rows.popleft()
        tick = world["tick"]
        asked, told, acted, seen = (self._known[name].pop(tick, {}) for name in LOGS)
        sent: dict[LinkName, int] = {"sensor": asked.get("sent_sensor", 0), "actuator": told.get("sent_actuator", 0)}
        for link, one in sent.items():
            self._sends[link] += one
        self._cost += world["cost"]
        arrived = {"sensor": int(bool(seen)), "actuator": int(bool(acted.get("arrived_actuator")))}
        values = trigger_values(told)
        self._page.put(
            {
                "tick": tick,
                "time": tick * self._robot.tick,
                "state": world["from"],
                "estimate": told.get("memory", {}).get(ESTIMATE),
                "input": world["u"],
                "trigger": values[0] if values else None,
                "threshold": values[1] if values else None,
                "sent": sent,
                "arrived": arrived,
                "cost": self._cost,
                "rate": {link: total / (tick + 1) for link, total in self._sends.items()},
                "degraded": told.get("degraded", 0),
            }
        )
        if seen and seen["seen"] is None:
            self._page.note(f"tick {tick}: no marker in the picture, the estimator runs open loop")
        elif sent["sensor"] and not arrived["sensor"]:
            self._page.note(f"tick {tick}: the camera was asked, and no picture has come")
        picture = self._folder / "picture.jpg"
        if picture.exists() and (written := picture.stat().st_mtime_ns) != self._pictured:
            self._pictured = written
            self._page.show(picture.read_bytes())
