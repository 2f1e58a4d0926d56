"""One trial of a twin: processes run a mission under one policy, and their logs give the results."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, Progress, choice, count, number, number_of, temporary_folder
from taciturn.nodes.keys import Keys
from taciturn.nodes.packet import Wire
from taciturn.problem import Problem
from taciturn_twins.body import Body
from taciturn_twins.control import write_calibration
from taciturn_twins.faults import CAMERA, Fault, window
from taciturn_twins.mission import write_toml
from taciturn_twins.outcome import Told, Trial, put_together
from taciturn_twins.prepared import Prepared
from taciturn_twins.robot import Robot
from taciturn_twins.wire import CameraWire
from taciturn_twins.world import TwinPlant, World
from taciturn_udp.endpoint import Endpoint, parse_address
from taciturn_udp.logs import logged_lines
from taciturn_udp.namespaces import Namespaces, kernel_losses
from taciturn_udp.processes import Processes
from taciturn_udp.relay import losses


@dataclass(frozen=True, repr=False)
class Setup(Displayed):
    """Configuration of a twin's run.

    Args:
        runs: number of simultaneous robots, with consecutive seeds.
        seed: seed of the first robot.
        tick: real seconds per step; default: lockstep.
        namespaces: whether to use network namespaces, in which the kernel drops packets.
        faults: faults to inject.
        key: key that authenticates the packets.
        variant: wheel model; default: the robot's first one.
    """

    runs: int = 1
    seed: int = 0
    tick: float | None = None
    namespaces: bool = False
    faults: tuple[Fault, ...] = ()
    key: bytes | Keys | None = None
    variant: str | None = None

    def __post_init__(self) -> None:
        """Check the ranges."""
        count("runs", self.runs)
        count("seed", self.seed, 0)

    def check(self, robot: Robot, horizon: int) -> None:
        """Raise an error if a setup is invalid for a robot and a mission of ``horizon`` steps.

        Raises:
            ProblemError: the wheel model is unknown, or a fault is not possible in this run.
        """
        choice("variant", self.variant or robot.variants[0], robot.variants)
        if window(self.faults, "actuator", robot.tick) is not None and self.namespaces:
            raise ProblemError(
                "the fault 'actuator' is given with network namespaces, but only relays cause this fault, and "
                "namespaces have no relays; expected only one of the two"
            )
        for fault in self.faults:
            if fault.ticks(robot.tick)[0] >= horizon:
                end = horizon * robot.tick
                raise ProblemError(
                    f"the fault {fault} begins after the end of the mission at {end:g} s; expected an earlier start"
                )
            if fault.name == "kidnap" and len(fault.size) > len(robot.states):
                most = len(robot.states)
                raise ProblemError(
                    f"the fault {fault} has {number_of(len(fault.size), 'number')}; expected at most {most}"
                )
        number("the gain of the motors", self.gain, -1.0, 1.0)

    @property
    def gain(self) -> float:
        """Relative error of the motors' gains that is due to faults."""
        return sum(fault.size[0] for fault in self.faults if fault.name == "gain")

    def body(self, robot: Robot, run: int) -> Body:
        """Create the simulated body of the robot for one run."""
        return Body(robot, self.seed + run, gain_error=self.gain, variant=self.variant or robot.variants[0])


@dataclass(repr=False)
class Watcher(Displayed):
    """Functions that a trial calls while it runs; they observe the trial, and some can change it.

    Args:
        before: function called before each step with the number of the step and the plants.
        told: function called with the log line of the world for each step.
        stopped: function that returns whether to end the trial early.
        start: function called with the folder of the process logs.
        finish: function called when the logs are complete, before the folder is removed.
        pictures: whether the controller saves the newest picture, with the detected marker, as ``picture.jpg`` there.
    """

    before: Callable[[int, Sequence[TwinPlant]], None] = lambda tick, plants: None
    told: Callable[[Mapping[str, Any]], None] = lambda line: None
    stopped: Callable[[], bool] = lambda: False
    start: Callable[[Path], None] = lambda folder: None
    finish: Callable[[], None] = lambda: None
    pictures: bool = False


def run_trial(
    prepared: Prepared,
    setup: Setup,
    problem: Problem,
    progress: Progress | None = None,
    watcher: Watcher | None = None,
) -> Trial:
    """Run the mission of a problem as processes on this machine: camera, controller and robots.

    Args:
        prepared: the robot, its camera and its model.
        setup: configuration of the run.
        problem: problem with the policy.
        progress: function called with the completed fraction.
        watcher: callbacks that observe the steps.

    Raises:
        ProblemError: a process has ended, or this machine does not meet a requirement.
    """
    began, watcher = time.monotonic(), watcher or Watcher()
    policy, robot, horizon = problem.design(), prepared.robot, problem.cost.horizon
    assert horizon is not None
    assert problem.source is not None
    outage = window(setup.faults, "actuator", robot.tick)
    plants = [TwinPlant(problem, setup.body(robot, run)) for run in range(setup.runs)]
    killed = any(fault.name == "controller" for fault in setup.faults)
    drops = kernel_losses(problem.network, setup.seed) if setup.namespaces else {}
    with (
        temporary_folder() as folder,
        Namespaces(policy, drops, ["camera"]) if setup.namespaces else nullcontext() as spaces,
    ):
        file, calibration = folder / f"{robot.name}.toml", folder / "calibration.json"
        file.write_text(write_toml(problem.source), encoding="utf-8")
        write_calibration(calibration, robot, prepared.calibration)
        fates = losses(problem.network, setup.seed, {"actuator": outage})
        shared = ["--seed", str(setup.seed), "--loops", str(setup.runs)]
        processes = Processes(
            str(file), policy, fates, tick=setup.tick, folder=folder, options=shared,
            keeps=killed, key=setup.key, namespaces=spaces,
            through={"sensor": "camera"},
        )  # fmt: skip
        onward = processes.peers("sensor")["sensor"]
        processes.commands["camera"] = [
            "camera", robot.name, str(file), "--bind", processes.addresses["camera"],
            "--peer", processes.addresses[onward], *shared,
            *(f"--fault={fault}" for fault in setup.faults if fault.name in CAMERA),
        ]  # fmt: skip
        processes.commands["sensor"] += ["--questions"]
        processes.commands["controller"] += [
            "--eye", str(calibration), "--seen", str(folder / "seen.jsonl"),
            *(["--watch", str(folder / "picture.jpg")] if watcher.pictures else []),
        ]  # fmt: skip
        if setup.tick is not None:  # the controller does not wait for packets that may not be sent
            processes.commands["controller"] += ["--wait", "0"]
            processes.commands["actuator"] += ["--wait", "0.15"]
        with nullcontext() if spaces is None else spaces.visit("plant"):
            endpoint = Endpoint(parse_address("the plant", processes.addresses["plant"]))
        key = setup.key
        before = _Before(robot.tick, setup, processes, plants, watcher, progress, horizon)
        world = World(
            plants,
            Wire(policy, problem.network, key),
            endpoint,
            parse_address("the sensor", processes.addresses["sensor"]),
            parse_address("the camera", processes.addresses["camera"]),
            CameraWire(policy, robot.seen, problem.network, key),
            tick=setup.tick,
            told=watcher.told,
            before=before,
        )
        watcher.start(folder)
        try:
            processes.start()
            world.run(horizon, lambda: processes.ended() or watcher.stopped())
            before.settle()
            if processes.ended():
                raise ProblemError(processes.sentence())
            reports = {**processes.stop(), "world": world.finish()}
        finally:
            before.close()
            processes.kill()
            endpoint.close()
        lines = {role: logged_lines(folder / f"{role}.jsonl") for role in processes.roles}
        watcher.finish()
        dropped = 0 if spaces is None else sum(spaces.counted(link).dropped for link in processes.links)
        told = Told(lines, logged_lines(folder / "seen.jsonl"), reports, drops, dropped, killed)
    return put_together(problem, plants, world.costs, told, time.monotonic() - began)


class _Before:
    """A callback that injects the faults due before a step."""

    def __init__(
        self,
        tick: float,
        setup: Setup,
        processes: Processes,
        plants: Sequence[TwinPlant],
        watcher: Watcher,
        progress: Progress | None,
        ticks: int,
    ) -> None:
        self._due: dict[int, list[Fault]] = {}
        for fault in setup.faults:
            self._due.setdefault(fault.ticks(tick)[0], []).append(fault)
        self._processes, self._plants, self._watcher = processes, plants, watcher
        self._progress, self._ticks, self._lockstep = progress, ticks, setup.tick is None
        self._pool, self._restarts = ThreadPoolExecutor(1), list[Future[None]]()

    def _restart(self, name: str) -> None:
        """Kill a process and restart it; in real time, the world continues during the restart."""
        self._restarts.append(self._pool.submit(self._processes.restart, name))
        if self._lockstep:
            self.settle()

    def settle(self) -> None:
        """Wait for the restarted processes.

        Raises:
            ProblemError: a process did not start.
        """
        while self._restarts:
            self._restarts.pop().result()

    def close(self) -> None:
        """Wait for processes that are still starting, and ignore the errors that they raise."""
        self._pool.shutdown()

    def __call__(self, tick: int) -> None:
        for fault in self._due.get(tick, []):
            if fault.name == "controller":
                self._restart(fault.name)
            for plant in self._plants:
                happen(fault, plant.body, plant.problem.plant.states)
                plant.look()
        if self._progress is not None:
            self._progress(tick / self._ticks)
        self._watcher.before(tick, self._plants)


def happen(fault: Fault, body: Body, states: int) -> None:
    """Apply a fault to the body of a robot; faults of other kinds have no effect here."""
    if fault.name == "kidnap":
        body.kidnap([*fault.size, 0.0, 0.0][:states])
    elif fault.name == "push":
        newtons, degrees = (*fault.size, 0.0)[:2]
        body.push(newtons, fault.lasts, math.radians(degrees))
