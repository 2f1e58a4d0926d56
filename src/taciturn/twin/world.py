"""The world as a process: the bodies of robots, the light that falls from them into a camera, and the clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn.model.plant import Plant
from taciturn.problem import Problem
from taciturn.runtime.node import Values
from taciturn.runtime.packet import Packet, Wire
from taciturn.runtime.service import Told, take_until
from taciturn.runtime.udp import Address, Endpoint
from taciturn.runtime.world import PlantServer
from taciturn.twin.body import Body
from taciturn.twin.wire import CameraWire

FLOW = 0.01  # real seconds after which the bodies have moved on, in real time


class TwinPlant:
    """A robot's body as the plant of a problem: it says nothing of itself, for a camera is there to see it.

    Args:
        problem: that says what its mission costs, and what it is to follow.
        body: of the robot.
    """

    def __init__(self, problem: Problem, body: Body) -> None:
        """Start where the body is."""
        self.body, self.tick, self.problem = body, 0, problem
        plant = problem.plant
        assert isinstance(plant, Plant)
        assert plant.dt is not None
        self.measurement: Values = (0.0,) * plant.outputs
        self.inputs, self.tick_length = plant.inputs, plant.dt
        self.poses: list[Array] = [body.pose]
        self.lights: list[Values] = [body.snapshot]
        self.given: list[Values] = []

    @property
    def state(self) -> Array:
        """What a perfect camera would measure, (n,)."""
        return self.body.pose

    def look(self) -> None:
        """Take what can be seen now for what can be seen at this tick: something has moved the body meanwhile."""
        self.poses[-1], self.lights[-1] = self.body.pose, self.body.snapshot

    def flow(self, inputs: Sequence[float], share: float) -> None:
        """Let time pass, up to a share of the present tick."""
        self.body.act(inputs)
        self.body.flow((self.tick + min(share, 1.0)) * self.tick_length)

    def move(self, inputs: Sequence[float]) -> float:
        """Let the rest of the tick pass with these inputs, and return what the tick costs."""
        cost, reference, pose = self.problem.cost, self.problem.reference, self.poses[-1]
        given = np.array(inputs)
        if reference is not None and self.tick < len(reference.inputs):
            pose, given = pose - reference.states[self.tick], given - reference.inputs[self.tick]
        self.flow(inputs, 1.0)
        self.tick += 1
        self.poses.append(self.body.pose)
        self.lights.append(self.body.snapshot)
        self.given.append(tuple(inputs))
        return float(pose @ cost.Q @ pose + given @ cost.R @ given + 2 * pose @ cost.N @ given)

    def final_cost(self) -> float:
        """Return what the pose costs where the mission ends."""
        cost, reference = self.problem.cost, self.problem.reference
        off = self.state - (0.0 if reference is None else reference.states[-1])
        return 0.0 if cost.terminal is None else float(off @ cost.terminal @ off)


class World(PlantServer):
    """Lets robots move as nodes say, and lights a camera; the node that asks the camera gets the clock, and no more.

    Args:
        plants: one per loop, in order.
        wire: that writes the clock and reads inputs.
        endpoint: where inputs arrive.
        clock: who gets the clock: the node of the sensor, which asks.
        camera: who gets the light.
        light: that writes it.
        tick: real seconds per tick; omitted: lockstep.
        told: called with what happened in each tick.
        before: called before each tick, which may let things go wrong, or wait.
    """

    def __init__(
        self,
        plants: Sequence[TwinPlant],
        wire: Wire,
        endpoint: Endpoint,
        clock: Address,
        camera: Address,
        light: CameraWire,
        *,
        tick: float | None = None,
        told: Told | None = None,
        before: Callable[[int], None] | None = None,
    ) -> None:
        """Nothing has happened."""
        super().__init__(plants, wire, endpoint, clock, tick=tick, told=told)
        self._bodies, self._camera, self._light, self._before = plants, camera, light, before
        self._shone = 0

    def report(self) -> dict[str, Any]:
        """Return what has been counted so far."""
        return {**super().report(), "role": "world", "light": self._shone}

    def finish(self) -> dict[str, Any]:
        """Take what is still on its way, and return the report."""
        take_until(self.endpoint, self._take, lambda: True)
        return self.report()

    def _measure(self, tick: int, again: bool = False) -> None:
        if self._before is not None and not again:
            self._before(tick)
        self._shine(tick)
        super()._measure(tick, again)

    def _shine(self, tick: int) -> None:
        for loop, plant in enumerate(self._bodies):
            light = Packet("measurement", "plant", tick, self._shone, plant.body.snapshot, self._epoch, loop)
            self.endpoint.send(self._light.encode(light), self._camera)
        self._shone += 1

    def _wait(self, until: float) -> None:
        """Take inputs, which act as they come, and let the bodies move until a time."""
        assert self._tick is not None
        begins = until - self._tick
        while (now := time.monotonic()) < until:
            self._take(self.endpoint.receive(min(until, now + FLOW)))
            share = (time.monotonic() - begins) / self._tick
            for loop, plant in enumerate(self._bodies):
                self._adopt(loop, self._now)
                plant.flow(self.inputs[loop], share)
            self._shine(self._now)
