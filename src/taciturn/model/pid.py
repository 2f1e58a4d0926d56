"""PID controllers, alone or several of them, each from one output of a plant to one input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, count, number
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.controller import Controller, checked_disturbance, stated_step
from taciturn.model.disturbance import Disturbance


@dataclass(frozen=True, repr=False)
class PID(Displayed):
    """A PID controller of one measurement, u = kp (b r − y) + ki ∫(r − y) dt + kd d(c r − y)/dt with the set-point r.

    The integral and the filter of the derivative use forward differences over a step h: I⁺ = I + h y,
    f⁺ = f + (h/T)(y − f), and the derivative is (y − f)/T.

    Args:
        kp: proportional gain.
        ki: integral gain per second.
        kd: derivative gain in seconds.
        filter: time constant T of the derivative's filter in seconds, at least a step; required with ``kd``.
        disturbance: slowly varying disturbance at the input of the plant; default: ``Disturbance()`` with ``ki``,
            otherwise none.
        input: number of the plant's input that the controller computes, from 1 on.
        output: number of the plant's output that it measures, from 1 on.
        setpoint: constant set-point r of the output; with several loops of an output, of one of them. At an operating
            point of the plant, 0 means the output there.
        b: weight of the set-point in the proportional part.
        c: weight of the set-point in the derivative.
        tracking_time: time constant in seconds with which the integral follows the input that was applied, if a limit
            or silence changes it (back-calculation); default: it does not follow.
        start_input: input before the start, which the first command equals on average (bumpless start); default: the
            integral starts at zero.

    Raises:
        ProblemError: a gain is not finite, or the filter is missing or not positive.

    Example:
        >>> PID(1.2, 0.15, 1.0, 0.5).at(0.1, 1, 1).D.tolist()
        [[-3.2]]
    """

    kp: float
    ki: float = 0.0
    kd: float = 0.0
    filter: float | None = None
    disturbance: Disturbance | None = None
    input: int = 1
    output: int = 1
    setpoint: float = 0.0
    b: float = 1.0
    c: float = 0.0
    tracking_time: float | None = None
    start_input: float | None = None

    def __post_init__(self) -> None:
        """Check the gains and the filter."""
        for name in ("kp", "ki", "kd", "setpoint", "b", "c"):
            number(f"pid.{name}", getattr(self, name))
        checked_disturbance("pid.disturbance", self.disturbance)
        if not self.setpoint and (self.b != 1.0 or self.c != 0.0):
            raise ProblemError("pid.b or pid.c is given without setpoint; expected a set-point, or neither of them")
        if self.tracking_time is not None:
            number("pid.tracking_time", self.tracking_time, 0.0)
        if self.start_input is not None:
            number("pid.start_input", self.start_input)
        if self.c and self.start_input is not None:
            raise ProblemError(
                f"pid.c is {self.c:g} with start_input, with which the derivative starts at rest: as the set-point is "
                "constant, c has no effect; expected no c"
            )
        for name in (name for name in ("tracking_time", "start_input") if getattr(self, name) is not None):
            if not self.ki:
                raise ProblemError(f"pid.{name} is given without ki; expected an integral, whose value it concerns")
        for name in ("input", "output"):
            count(f"pid.{name}", getattr(self, name))
        if self.c and not self.kd:
            raise ProblemError(f"pid.c is {self.c:g}, and kd is 0; expected a derivative, whose set-point c weights")
        if self.filter is not None:
            number("pid.filter", self.filter, 0.0)
            if not self.kd:
                raise ProblemError(
                    f"pid.filter is {self.filter:g}, and kd is 0; expected a derivative, which it filters, or no filter"
                )
        elif self.kd:
            raise ProblemError(
                "pid.filter is missing; expected the time constant of the derivative's filter in seconds, such as a "
                "tenth of kd/kp"
            )

    def at(self, dt: float | None, inputs: int, outputs: int) -> Controller:
        """Return the controller at a step of ``dt`` seconds.

        Raises:
            ProblemError: the step is not stated, or longer than the filter's time constant; or the plant lacks the
                input or output, or has another input.
        """
        return PIDLoops((self,)).at(dt, inputs, outputs)

    def rows(self, dt: float) -> tuple[list[float], list[float], list[float], float, list[float]]:
        """Return the diagonal of A, and B, C, D and the state at rest, at a step of ``dt`` seconds."""
        A, B, C, D, rest = list[float](), list[float](), list[float](), -self.kp, list[float]()
        if self.ki:
            A, B, C, rest = [1.0], [dt], [-self.ki], [-self.kp * (1 - self.b) * self.setpoint / self.ki]
        if self.kd and self.filter is not None:
            T = self.filter
            if dt > T:
                raise ProblemError(
                    f"pid.filter is {T:g} s, and a step takes {dt:g} s; expected a filter of at least a step"
                )
            A, B, C, D = [*A, 1.0 - dt / T], [*B, dt / T], [*C, self.kd / T], D - self.kd / T
            rest = [*rest, (1 - self.c) * self.setpoint]
        return A, B, C, D, rest


@dataclass(frozen=True, repr=False)
class PIDLoops(Displayed):
    """Several PID controllers, each from one output of the plant to one input; their commands to an input are added.

    Args:
        loops: the controllers.

    Raises:
        ProblemError: there is no controller, or several of them state a disturbance.
    """

    loops: tuple[PID, ...]

    def __post_init__(self) -> None:
        """Check that there is a controller, and that at most one states a disturbance."""
        if not self.loops:
            raise ProblemError("the list of PID controllers is empty; expected at least one")
        if sum(loop.disturbance is not None for loop in self.loops) > 1:
            raise ProblemError(
                "several PID controllers state a disturbance; expected one of them to do so, for all inputs"
            )

    def at(self, dt: float | None, inputs: int, outputs: int) -> Controller:
        """Return the controller at a step of ``dt`` seconds.

        Raises:
            ProblemError: as for a single PID controller, or an input has no controller.
        """
        step, D = stated_step(dt), np.zeros((inputs, outputs))
        A, B, C, rest = list[float](), list[Array](), list[Array](), list[float]()
        setpoint, tracked = np.zeros(outputs), list[tuple[int, int, float]]()
        for loop in self.loops:
            for name, size in (("input", inputs), ("output", outputs)):
                if getattr(loop, name) > size:
                    raise ProblemError(
                        f"pid.{name} is {getattr(loop, name)}; expected a number from 1 to {size}, as the plant has "
                        f"{size} {name}{'s' if size > 1 else ''}"
                    )
            to, read = np.eye(inputs)[loop.input - 1], np.eye(outputs)[loop.output - 1]
            a, b, c, d, still = loop.rows(step)
            if loop.tracking_time is not None:
                number("pid.tracking_time", loop.tracking_time, step, closed=True)
                tracked.append((len(A), loop.input - 1, step / (loop.tracking_time * loop.ki)))
            rest += still
            if loop.setpoint:
                setpoint[loop.output - 1] = loop.setpoint
            A += a
            B += [value * read for value in b]
            C += [value * to for value in c]
            D += d * np.outer(to, read)
        for free in sorted(set(range(1, inputs + 1)) - {loop.input for loop in self.loops}):
            raise ProblemError(f"no PID controller has the input {free}; expected one for each input of the plant")
        k = len(A)
        disturbance = next((loop.disturbance for loop in self.loops if loop.disturbance is not None), None)
        rows = np.diag(A).reshape(k, k), np.reshape(B, (k, outputs)), np.reshape(C, (k, inputs)).T
        E = np.zeros((k, inputs))
        for row, to, gain in tracked:
            rows[0][row] += gain * rows[2][to]
            rows[1][row] += gain * D[to]
            E[row, to] -= gain
        return Controller(*rows, D, E, step, disturbance, setpoint, rest, self._start_input(inputs))

    def _start_input(self, inputs: int) -> Array | None:
        """Return the input before the start, if all loops state it; 0 for inputs of loops that do not."""
        stated = np.zeros(inputs)
        for loop in self.loops:
            stated[loop.input - 1] += loop.start_input or 0.0
        return None if all(loop.start_input is None for loop in self.loops) else stated
