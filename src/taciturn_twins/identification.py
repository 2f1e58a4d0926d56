"""Identification of a robot's model from an experiment with known inputs and positions that the camera measures."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, count, percent, symmetrised
from taciturn.model.result import Result
from taciturn_twins.body import Body
from taciturn_twins.calibration import Calibration
from taciturn_twins.camera import Camera
from taciturn_twins.robot import Robot
from taciturn_twins.vision import Eye

RUNS, HELD_OUT = 14, 4  # number of runs for the fit, and for its validation
TICKS, HOLD = 25, 10  # number of steps of a run, and for which an input is held
START = 5  # number of first steps excluded from the fit, while the robot accelerates
PLACES, REPEATS = 8, 8  # number of places at which the robot rests, and of pictures at each place
MARGIN = 0.15  # fraction of the workspace that the experiment does not use on either side
_SEEN = 0.9  # fraction of the pictures that must show the marker


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Result):
    """Identified model x⁺ = x + B u + w, y = x + v of a robot for one step, in metres, radians and units of the input.

    The standard errors treat each run as one sample, because disturbances are correlated within a run.

    Args:
        robot: name of the robot.
        samples: number of fitted steps.
        B: fit with A = I, (n, m).
        B_standard_error: standard error of each entry of B, (n, m).
        B_nominal: B of the data sheet, (n, m).
        A_free: A from a joint fit of A and B, (n, n); its difference from I shows the error of assuming A = I.
        A_free_standard_error: standard error of each entry of ``A_free``, (n, n).
        W: covariance of w: covariance of the residuals minus the contribution of the measurement noise, (n, n).
        V: covariance of v, from pictures of a robot at rest, (n, n).
        held_out: standard deviation of x⁺ - x - B u over validation runs, (n,); it contains w and two samples of v.
    """

    robot: str
    samples: int
    B: Array
    B_standard_error: Array
    B_nominal: Array
    A_free: Array
    A_free_standard_error: Array
    W: Array
    V: Array
    held_out: Array


def identify(robot: Robot, calibration: Calibration, seed: int = 0) -> Identification:
    """Identify a robot's model from an open-loop experiment that its camera observes.

    Each run starts at rest at a random place of the workspace. The random inputs keep the nominal robot in the
    workspace, and are of the same type as in the mission (steps, or curves in the plane): because of inertia, B depends
    on the type of input, and differs during acceleration. B minimises Σ|x⁺ - x - B u|².

    Args:
        robot: the robot.
        calibration: calibration of its camera.
        seed: seed of inputs, disturbance and noise.

    Raises:
        ProblemError: more than 10 % of the pictures show no marker, the residuals are smaller than the measurement
            noise explains, or MuJoCo, OpenCV or a graphics driver is missing.
    """
    random = np.random.default_rng((count("seed", seed, 0), 1))
    watch = _Watch(robot, calibration, seed)
    V = _rest(robot, watch, random)
    runs = [_run(robot, watch, random) for _ in range(RUNS + HELD_OUT)]
    watch.close()
    if watch.missed > (1 - _SEEN) * watch.taken:
        raise ProblemError(
            f"the marker is not seen in {watch.missed} of {watch.taken} pictures; expected it in {percent(_SEEN)} of "
            "them: calibrate this camera, or clear its view"
        )
    fitted, kept = runs[:RUNS], runs[RUNS:]
    B, B_error = _fit([(u, step) for _, u, step in fitted])
    both, both_error = _fit([(np.column_stack([x, u]), x + step) for x, u, step in fitted])
    n = len(robot.states)
    residuals = np.concatenate([step - u @ B.T for _, u, step in fitted])
    W = symmetrised(residuals.T @ residuals / (len(residuals) - B.shape[1]) - 2 * V)
    if np.linalg.eigvalsh(W)[0] <= 0.0:
        raise ProblemError(
            "the residuals are smaller than those that measurement noise alone would cause; expected a robot with "
            "disturbances"
        )
    left = np.concatenate([step - u @ B.T for _, u, step in kept])
    return Identification(
        robot=robot.name,
        samples=len(residuals),
        B=B,
        B_standard_error=B_error,
        B_nominal=robot.B,
        A_free=both[:, :n],
        A_free_standard_error=both_error[:, :n],
        W=W,
        V=V,
        held_out=np.sqrt((left**2).mean(axis=0)),
    )


class _Watch:
    """A camera with image processing that counts the pictures without a marker."""

    def __init__(self, robot: Robot, calibration: Calibration, seed: int) -> None:
        self._camera, self._eye = Camera(robot, seed), Eye(robot, calibration)
        self.taken = self.missed = 0

    def measure(self, body: Body) -> Array | None:
        found = self._eye.see(self._camera.take(body.snapshot, self.taken))
        self.taken += 1
        self.missed += found is None
        return found

    def close(self) -> None:
        self._camera.close()


def _rest(robot: Robot, watch: _Watch, random: np.random.Generator) -> Array:
    """Return the covariance of measurements of a robot at rest, computed within each place."""
    off: list[Array] = []
    places = 0
    for _ in range(PLACES):
        body = Body(robot, start=_somewhere(robot, random), disturbance=0.0)
        found = [one for one in (watch.measure(body) for _ in range(REPEATS)) if one is not None]
        if found:
            turned = np.array([_difference(robot, one, found[0]) for one in found])
            off.extend(turned - turned.mean(axis=0))
            places += 1
    if len(off) < places + len(robot.states) + 1:
        raise ProblemError(
            "the marker is visible in too few pictures of the robot at rest; expected it in most of them: calibrate "
            "the camera"
        )
    spread = np.array(off)
    return symmetrised(spread.T @ spread / (len(spread) - places))


def _run(robot: Robot, watch: _Watch, random: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return states x, inputs, and differences x⁺ - x of a run, for the steps with x and x⁺ measured."""
    start = _somewhere(robot, random)
    inputs = _excite(robot, start, random)
    body = Body(robot, int(random.integers(2**32)), start=start)
    seen: list[Array | None] = []
    for k, u in enumerate(inputs, 1):
        body.act(u)
        body.flow(k * robot.tick)
        if k >= START:
            seen.append(watch.measure(body))
    pairs = [
        (x, u, _difference(robot, after, x))
        for x, u, after in zip(seen[:-1], inputs[START:], seen[1:], strict=True)
        if x is not None and after is not None
    ]
    n, m = len(robot.states), len(robot.inputs)
    states, acts, steps = (np.array([pair[part] for pair in pairs]) for part in range(3))
    return states.reshape(-1, n), acts.reshape(-1, m), steps.reshape(-1, n)


def _excite(robot: Robot, start: Array, random: np.random.Generator) -> Array:
    """Return random inputs, (steps, m), that keep the nominal robot in the workspace."""
    low, high = _inside(robot)
    while True:
        inputs = _go_round(robot, random) if robot.turns else _go_by_steps(robot, random)
        path = start + np.cumsum(inputs @ robot.B.T, axis=0)
        if (path >= low).all() and (path <= high).all():
            return inputs


def _go_by_steps(robot: Robot, random: np.random.Generator) -> Array:
    """Return inputs that are each held for several steps, as in event-triggered control."""
    largest = np.array(robot.excitation)
    return np.repeat(random.uniform(-largest, largest, (-(-TICKS // HOLD), len(largest))), HOLD, axis=0)[:TICKS]


def _go_round(robot: Robot, random: np.random.Generator) -> Array:
    """Return velocities for a curve in the plane with an oscillating heading, as on a path."""
    speed, turn = random.uniform(0.4, 1.0) * robot.excitation[0], random.uniform(-1.0, 1.0)  # radians per second
    time = robot.tick * np.arange(TICKS)
    along, swing = random.uniform(0, 2 * math.pi) + turn * time, random.uniform(0, 2 * math.pi) + 2.0 * time
    heading = random.uniform(-1.0, 1.0) * robot.excitation[2] * np.cos(swing)
    return np.column_stack([speed * np.cos(along), speed * np.sin(along), heading])


def _somewhere(robot: Robot, random: np.random.Generator) -> Array:
    return random.uniform(*_inside(robot))


def _inside(robot: Robot) -> tuple[Array, Array]:
    low, high = np.array(robot.low), np.array(robot.high)
    return low + MARGIN * (high - low), high - MARGIN * (high - low)


def _difference(robot: Robot, one: Array, other: Array) -> Array:
    found = one - other
    if robot.turns:
        found[2] = math.remainder(found[2], 2 * math.pi)
    return found


def _fit(runs: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the least-squares M in y ≈ M z over runs of (z, y), and standard errors with each run as one sample."""
    total = np.linalg.inv(sum((z.T @ z for z, _ in runs), np.zeros(2 * (runs[0][0].shape[1],))))
    M = sum((y.T @ z for z, y in runs), np.zeros((runs[0][1].shape[1], len(total)))) @ total
    scores = np.array([(y - z @ M.T).T @ z @ total for z, y in runs])
    return M, np.sqrt((scores**2).sum(axis=0) * len(runs) / (len(runs) - 1))
