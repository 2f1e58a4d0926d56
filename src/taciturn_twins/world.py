"""Server that simulates the robots: it sends their poses to the camera, and time steps to the sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from taciturn.extend import Array
from taciturn.model.plant import Plant
from taciturn.model.wire import PLANT
from taciturn.nodes.node import Values
from taciturn.nodes.packet import Packet, Wire
from taciturn.problem import Problem
from taciturn_twins.body import Body
from taciturn_twins.wire import CameraWire
from taciturn_udp.endpoint import Address, Endpoint
from taciturn_udp.plant import PlantServer
from taciturn_udp.service import Told, Turns, take_until

FLOW = 0.01  # seconds between two updates of the bodies in real time


class TwinPlant:
    """The body of a robot as a problem's plant, without outputs, because the camera measures the robot.

    Args:
        problem: problem with the cost and the reference.
        body: body of the robot.
    """

    def __init__(self, problem: Problem, body: Body) -> None:
        """Start with the pose of the body."""
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
        """Pose of the robot, (n,), as measured by an ideal camera."""
        return self.body.pose

    def look(self) -> None:
        """Read the pose of this step again, after a fault has moved the body."""
        self.poses[-1], self.lights[-1] = self.body.pose, self.body.snapshot

    def flow(self, inputs: Sequence[float], share: float) -> None:
        """Simulate the robot up to a given fraction of the present step."""
        self.body.act(inputs)
        self.body.flow((self.tick + min(share, 1.0)) * self.tick_length)

    def move(self, inputs: Sequence[float]) -> float:
        """Simulate the rest of the present step with these inputs, and return the cost of the step."""
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
        """Return the terminal cost at the present pose of the robot."""
        cost, reference = self.problem.cost, self.problem.reference
        off = self.state - (0.0 if reference is None else reference.states[-1])
        return 0.0 if cost.terminal is None else float(off @ cost.terminal @ off)


class World(PlantServer):
    """Server that moves the robots by the inputs that nodes send, and sends the robots' poses to the camera.

    The sensor node receives only time steps.

    Args:
        plants: plants, one per loop, in order.
        wire: encoder of the time steps, and decoder of the inputs.
        endpoint: socket that receives the inputs.
        clock: address of the sensor node, which receives the time steps.
        camera: address of the camera, which receives the poses.
        light: encoder of the poses.
        tick: real seconds per step; default: lockstep.
        told: function called with the log line of each step.
        before: function called before each step; it may inject faults, or wait.
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
        """Set the state before the first step."""
        super().__init__(plants, wire, endpoint, clock, tick=tick, told=told)
        self._bodies, self._camera, self._light, self._before = plants, camera, light, before
        self._shone = 0

    def report(self) -> dict[str, Any]:
        """Return the counters so far."""
        return {**super().report(), "role": "world", "light": self._shone}

    def finish(self) -> dict[str, Any]:
        """Receive the packets that are still on their way, and return the report."""
        take_until(self.endpoint, self._take, lambda: True)
        return self.report()

    def _measure(self, tick: int, again: bool = False, asked: str | None = None) -> None:
        if self._before is not None and not again:
            self._before(tick)
        self._shine(tick)
        super()._measure(tick, again, asked)

    def _shine(self, tick: int) -> None:
        for loop, plant in enumerate(self._bodies):
            light = Packet("measurement", PLANT, tick, self._shone, plant.body.snapshot, self._epoch, loop)
            self.endpoint.send(self._light.encode(light), self._camera)
        self._shone += 1

    def _wait(self, until: float) -> Turns:
        """Apply inputs when they arrive, and simulate the bodies until a given time."""
        assert self._tick is not None
        begins = until - self._tick
        while (now := self._clock()) < until:
            self._take((yield min(until, now + FLOW)))
            share = (self._clock() - begins) / self._tick
            for loop, plant in enumerate(self._bodies):
                self._adopt(loop, self._now)
                plant.flow(self.given(loop), share)
            self._shine(self._now)
