"""Linear controllers that a user already has, such as PID controllers, and their discretisation.

A controller computes the input from the measurement, in discrete or in continuous time, by

    z⁺ = A z + B y + E u   or   dz/dt = A z + B y,   and   u = C z + D y.

E feeds the applied input back, as observers and anti-windup do. Set-points r add F r to z⁺ (or dz/dt) and G r to u.
Without F and G, the controller reads y − r in place of y: F = −B and G = −D. The method ``at`` returns the
``Controller`` for the steps, inputs and outputs of a plant: a continuous one is discretised, and ``PIDLoops`` are
several PID controllers, each from one output to one input, whose states stand one below the other.

A set-point is constant, or a state of the plant that the controller reads (``following``). PID controllers weight it
by b and c. A controller with an integrator compensates a slow ``Disturbance`` at the inputs.

``controller_from`` converts systems of other libraries. ``relative_to`` counts set-points and inputs from the
operating point of a plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias, cast

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, ArrayLike, array, choice, count, expect_unmasked, number, quoted, set_fields
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.disturbance import Disturbance
from taciturn.model.key import NO_KEY, Rows, stated_as, table_of
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.state_space import refuse_descriptor, state_space_of, vars_of

Method: TypeAlias = Literal["tustin", "zoh"]


_KEPT = 1e-9  # change per step of a state that a controller keeps, relative to the state


@dataclass(frozen=True, eq=False, repr=False)
class Controller(Displayed):
    """A linear controller in discrete time: z⁺ = A z + B y + E u + F r and u = C z + D y + G r with set-points r.

    In z⁺, u is the applied input.

    Args:
        A: dynamics of the controller's state, (k, k).
        B: effect of the measurement on the state, (k, p).
        C: effect of the state on the input, (m, k).
        D: direct effect of the measurement, (m, p); default 0.
        E: effect of the applied input on the state, (k, m), for observers; default 0.
        dt: seconds per step; None if it is not stated.
        disturbance: slowly varying disturbance at each input of the plant; default: ``Disturbance()`` if the controller
            integrates, otherwise none.
        setpoint: constant set-point of each output, (p,), or of the only one; default 0. At an operating point of the
            plant, 0 means the output there.
        start_input: input before the start, (m,), which the first command equals on average; default: the controller
            starts with its state at zero.
        F: effect of the set-points on the state, (k, r); default −B: the controller reads y − r.
        G: direct effect of the set-points, (m, r); default −D.

    Raises:
        ProblemError: the sizes of the matrices differ.

    Example:
        >>> Controller([[1.0]], [[0.1]], [[-0.15]], [[-1.2]]).integrates
        True
    """

    A: Array = field(metadata=stated_as(Rows | None))
    B: Array = field(metadata=stated_as(Rows | None))
    C: Array = field(metadata=stated_as(Rows | None))
    D: Array = field(metadata=stated_as(Rows | None))
    E: Array = field(metadata=stated_as(Rows | None))
    dt: float | None = field(metadata=NO_KEY)
    disturbance: Disturbance | None = field(
        metadata=stated_as(
            table_of(Disturbance) | Literal["none"] | None,
            note="slow disturbance at each input, which an integral compensates",
        )
    )
    setpoint: Array = field(metadata=stated_as(list[float] | None))
    start_input: Array | None = field(metadata=NO_KEY)
    F: Array | None = field(metadata=stated_as(Rows | None))
    G: Array | None = field(metadata=stated_as(Rows | None))

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        C: ArrayLike,
        D: ArrayLike | None = None,
        E: ArrayLike | None = None,
        dt: float | None = None,
        disturbance: Disturbance | None = None,
        setpoint: ArrayLike | None = None,
        start_input: ArrayLike | None = None,
        F: ArrayLike | None = None,
        G: ArrayLike | None = None,
    ) -> None:
        """Validate and store the arguments."""
        A = array("controller.A", A, (None, None), "(controller states, controller states)")
        k = len(A)
        if A.shape[1] != k:
            raise ProblemError(f"controller.A has shape {A.shape}; expected a square matrix")
        B = array("controller.B", B, (k, None), "(controller states, outputs)")
        C = array("controller.C", C, (None, k), "(inputs, controller states)")
        m, p = len(C), B.shape[1]
        D = np.zeros((m, p)) if D is None else D
        E = np.zeros((k, m)) if E is None else E
        found: dict[str, object] = {
            "A": A,
            "B": B,
            "C": C,
            "D": array("controller.D", D, (m, p), "(inputs, outputs)"),
            "E": array("controller.E", E, (k, m), "(controller states, inputs)"),
            "dt": None if dt is None else number("controller.dt", dt, 0.0),
            "disturbance": checked_disturbance("controller.disturbance", disturbance),
        }
        expect_unmasked("controller.setpoint", setpoint)
        each = np.zeros(p) if setpoint is None else np.atleast_1d(np.asarray(setpoint))
        found["setpoint"] = array("controller.setpoint", each, (p,), f"({p},)")
        start = None if start_input is None else array("controller.start_input", start_input, (m,), "(inputs,)")
        set_fields(self, {**found, "start_input": start, **set_point_inputs(F, G, k, m)})

    @property
    def reads(self) -> tuple[Array, Array]:
        """The effects of the set-points on the state, (k, r), and on the input, (m, r)."""
        if self.F is None or self.G is None:
            return -self.B, -self.D
        return self.F, self.G

    @property
    def integrates(self) -> bool:
        """True if the controller has an integrator, so that A + E C has the eigenvalue 1."""
        applied = self.A + self.E @ self.C
        return bool(np.any(np.abs(np.linalg.eigvals(applied) - 1.0) < 1e-9)) if len(self.A) else False

    @property
    def expected(self) -> Disturbance | None:
        """The disturbance that the controller compensates: the stated one, or a default if the controller has an
        integrator.
        """
        stated = self.disturbance
        if stated is None:
            return Disturbance() if self.integrates else None
        return None if stated.absent else stated

    def at(self, dt: float | None, inputs: int, outputs: int) -> Controller:
        """Return this controller, after checking that sampling period, inputs and outputs are those of the plant.

        Raises:
            ProblemError: both steps are stated and differ, or a number differs.
        """
        if self.dt is not None and dt is not None and abs(self.dt - dt) > 1e-9 * dt:
            raise ProblemError(
                f"controller.dt is {self.dt:g} s, and a step of the policy takes {dt:g} s; expected equal steps"
            )
        for name, got, expected in zip(("input", "measurement"), self.D.shape, (inputs, outputs), strict=True):
            if got != expected:
                raise ProblemError(
                    f"the controller has {number_of(got, name)}; expected {number_of(expected, name)}, as of the plant"
                )
        return self


def set_point_inputs(F: ArrayLike | None, G: ArrayLike | None, states: int, inputs: int) -> dict[str, Array | None]:
    """Check the effects of set-points on a controller; if one of them is missing, it is zero."""
    if F is None and G is None:
        return {"F": None, "G": None}
    found = {
        name: None if value is None else array(f"controller.{name}", value, (rows, None), f"({many}, set-points)")
        for name, value, rows, many in (("F", F, states, "controller states"), ("G", G, inputs, "inputs"))
    }
    columns = {one.shape[1] for one in found.values() if one is not None}
    if len(columns) > 1:
        raise ProblemError(
            f"controller.F and controller.G have {' and '.join(map(str, sorted(columns)))} columns; expected one "
            "column for each set-point in both"
        )
    (size,) = columns
    none = {"F": np.zeros((states, size)), "G": np.zeros((inputs, size))}
    return {name: none[name] if one is None else one for name, one in found.items()}


@dataclass(frozen=True, eq=False, repr=False)
class ContinuousController(Displayed):
    """A linear controller in continuous time: dz/dt = A z + B y + F r and u = C z + D y + G r with set-points r.

    Args:
        A: dynamics of the controller's state, (k, k), per second.
        B: effect of the measurement on the state, (k, p).
        C: effect of the state on the input, (m, k).
        D: direct effect of the measurement, (m, p).
        method: ``"tustin"``: the trapezoidal rule; ``"zoh"``: measurements are constant within a step.
        disturbance: as for ``Controller``.
        setpoint: as for ``Controller``.
        F: effect of the set-points on the state, (k, r), per second; default −B: the controller reads y − r.
        G: direct effect of the set-points, (m, r); default −D.

    Raises:
        ProblemError: the sizes of the matrices differ, or the method is unknown.

    Example:
        >>> ContinuousController([[0.0]], [[1.0]], [[-1.0]], [[-2.0]]).at(0.1, 1, 1).D.tolist()
        [[-2.05]]
    """

    A: Array = field(metadata=NO_KEY)  # all keys as for ``Controller``, but for the method
    B: Array = field(metadata=NO_KEY)
    C: Array = field(metadata=NO_KEY)
    D: Array = field(metadata=NO_KEY)
    method: Method = field(default="tustin", metadata=stated_as(Method | None))
    disturbance: Disturbance | None = field(default=None, metadata=NO_KEY)
    setpoint: ArrayLike | None = field(default=None, metadata=NO_KEY)
    F: Array | None = field(default=None, metadata=NO_KEY)
    G: Array | None = field(default=None, metadata=NO_KEY)

    def __post_init__(self) -> None:
        """Validate the matrices and the method."""
        choice("controller.method", self.method, ("tustin", "zoh"))
        checked_disturbance("controller.disturbance", self.disturbance)
        stated = Controller(self.A, self.B, self.C, self.D, F=self.F, G=self.G)
        set_fields(self, {name: getattr(stated, name) for name in "ABCDFG"})

    def at(self, dt: float | None, inputs: int, outputs: int) -> Controller:
        """Discretise the controller for the sampling period ``dt`` in seconds.

        Raises:
            ProblemError: the step is not stated, or the number of inputs or outputs is not that of the plant.
        """
        method = "bilinear" if self.method == "tustin" else "zoh"
        step = stated_step(dt)
        p, B, D = self.B.shape[1], self.B, self.D
        if self.F is not None and self.G is not None:  # set-points enter as measurements do
            B, D = np.hstack([B, self.F]), np.hstack([D, self.G])
        try:
            A, B, C, D = _scipy.discrete_controller(self.A, B, self.C, D, step, method)
        except np.linalg.LinAlgError:
            raise ProblemError(
                f"the controller has a pole at 2/h = {2 / step:g} per second with steps of h = {step:g} s, so the "
                'trapezoidal rule does not apply; expected method = "zoh", or controller.dt, if the matrices of the '
                "controller describe one step"
            ) from None
        more = {} if self.F is None else {"F": B[:, p:], "G": D[:, p:]}
        return Controller(A, B[:, :p], C, D[:, :p], None, dt, self.disturbance, self.setpoint, **more).at(
            dt, inputs, outputs
        )

    def ringing(self, dt: float) -> tuple[float, float] | None:
        """Find the mode that alternates most after discretisation; return its time constant and eigenvalue, or None.

        The trapezoidal rule turns a mode e^{pt} into the eigenvalue (2 + p dt)/(2 − p dt). If the mode decays faster
        than within half a step, the eigenvalue is negative: commands alternate from step to step, and decay slowly.
        """
        if self.method != "tustin" or not len(self.A):
            return None
        poles = np.linalg.eigvals(self.A)
        fast = poles[(poles.real < 0) & (np.abs(poles) * dt > 2 * (1 + 1e-9))]
        if not len(fast):
            return None
        p = fast[np.argmax(np.abs(fast))]
        return float(1 / np.abs(p)), float(((2 + p * dt) / (2 - p * dt)).real)


def checked_disturbance(name: str, value: object) -> Disturbance | None:
    """Check that a value is a disturbance, or None for the default disturbance, and return it."""
    if value is not None and not isinstance(value, Disturbance):
        raise ProblemError(
            f"{name} is {quoted(value)}; expected a Disturbance, Disturbance(deviation=0) for no disturbance, or None "
            "for the default"
        )
    return value


def stated_step(dt: float | None) -> float:
    """Return the sampling period in seconds; raise an error if the user has not given it."""
    if dt is None:
        raise ProblemError(
            "plant.dt is missing; expected the seconds per step, which a PID or continuous controller requires"
        )
    return dt


@dataclass(frozen=True, repr=False)
class PID(Displayed):
    """A PID controller of one output y with set-point r: u = kp (b r − y) + ki ∫(r − y) dt + kd d(c r − y)/dt.

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
    disturbance: Disturbance | None = field(default=None, metadata=NO_KEY)  # of all loops, in [controller]
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
        if self.tracking_time is not None:
            number("pid.tracking_time", self.tracking_time, 0.0)
        if self.start_input is not None:
            number("pid.start_input", self.start_input)
        if self.c and self.setpoint and self.start_input is not None:
            raise ProblemError(
                f"pid.c is {self.c:g} together with start_input, so it has no effect: the derivative starts at zero, "
                "and the set-point is constant; expected no pid.c"
            )
        for name in (name for name in ("tracking_time", "start_input") if getattr(self, name) is not None):
            if not self.ki:
                raise ProblemError(
                    f"pid.{name} is given without pid.ki; expected pid.ki, because pid.{name} acts on the integral"
                )
        for name in ("input", "output"):
            count(f"pid.{name}", getattr(self, name))
        if self.c and not self.kd:
            raise ProblemError(
                f"pid.c is {self.c:g}, but pid.kd is 0; expected a nonzero pid.kd, since pid.c weights the set-point "
                "in the derivative term"
            )
        if self.filter is not None:
            number("pid.filter", self.filter, 0.0)
            if not self.kd:
                raise ProblemError(
                    f"pid.filter is {self.filter:g}, but pid.kd is 0, so there is no derivative to filter; expected a "
                    "nonzero pid.kd, or no pid.filter"
                )
        elif self.kd:
            raise ProblemError(
                "pid.filter is missing; expected the time constant of the derivative's filter in seconds, such as a "
                "tenth of kd/kp"
            )

    def at(self, dt: float | None, inputs: int, outputs: int) -> Controller:
        """Discretise the controller for the sampling period ``dt`` in seconds.

        Raises:
            ProblemError: the step is not stated, or longer than the filter's time constant; or the plant lacks the
                input or output, or has another input.
        """
        return PIDLoops((self,)).at(dt, inputs, outputs)

    def rows(self, dt: float) -> tuple[list[float], list[float], list[float], float, list[float], float]:
        """Return the diagonal of A, and the entries of B, C, D, F and G, for steps of ``dt`` seconds."""
        A, B, C, D, F, G = list[float](), list[float](), list[float](), -self.kp, list[float](), self.kp * self.b
        if self.ki:
            A, B, C, F = [1.0], [dt], [-self.ki], [-dt]
        if self.kd and self.filter is not None:
            T = self.filter
            if dt > T:
                raise ProblemError(
                    f"pid.filter is {T:g} s, and a step takes {dt:g} s; expected a time constant of at least one step"
                )
            A, B, C, D = [*A, 1.0 - dt / T], [*B, dt / T], [*C, self.kd / T], D - self.kd / T
            F, G = [*F, -dt / T * self.c], G + self.kd / T * self.c
        return A, B, C, D, F, G


@dataclass(frozen=True, repr=False)
class PIDLoops(Displayed):
    """Several PID controllers, each from one output to one input of the plant. Commands to the same input are added.

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
                "several PID controllers have the key 'disturbance'; expected this key in only one of them, for all "
                "inputs"
            )

    def at(self, dt: float | None, inputs: int, outputs: int) -> Controller:
        """Discretise the PID controllers for the period ``dt`` in seconds, and combine them into one controller.

        Raises:
            ProblemError: as for a single PID controller, or an input has no controller.
        """
        step, D, G = stated_step(dt), np.zeros((inputs, outputs)), np.zeros((inputs, outputs))
        A, B, C, F = list[float](), list[Array](), list[Array](), list[Array]()
        setpoint, tracked = np.zeros(outputs), list[tuple[int, int, float]]()
        for loop in self.loops:
            for name, size in (("input", inputs), ("output", outputs)):
                if getattr(loop, name) > size:
                    raise ProblemError(
                        f"pid.{name} is {getattr(loop, name)}; expected a number from 1 to {size}, the number of "
                        f"{name}s of the plant"
                    )
            to, read = np.eye(inputs)[loop.input - 1], np.eye(outputs)[loop.output - 1]
            a, b, c, d, f, g = loop.rows(step)
            if loop.tracking_time is not None:
                number("pid.tracking_time", loop.tracking_time, step, closed=True)
                tracked.append((len(A), loop.input - 1, step / (loop.tracking_time * loop.ki)))
            if loop.setpoint:
                setpoint[loop.output - 1] = loop.setpoint
            A += a
            B += [value * read for value in b]
            C += [value * to for value in c]
            F += [value * read for value in f]
            D += d * np.outer(to, read)
            G += g * np.outer(to, read)
        for free in sorted(set(range(1, inputs + 1)) - {loop.input for loop in self.loops}):
            raise ProblemError(
                f"no PID controller computes input {free} of the plant; expected one PID controller for each input"
            )
        k = len(A)
        disturbance = next((loop.disturbance for loop in self.loops if loop.disturbance is not None), None)
        rows = np.diag(A).reshape(k, k), np.reshape(B, (k, outputs)), np.reshape(C, (k, inputs)).T
        E, enters = np.zeros((k, inputs)), np.reshape(F, (k, outputs))
        for row, to, gain in tracked:
            rows[0][row] += gain * rows[2][to]
            rows[1][row] += gain * D[to]
            enters[row] += gain * G[to]
            E[row, to] -= gain
        return Controller(*rows, D, E, step, disturbance, setpoint, self._start_input(inputs), enters, G)

    def _start_input(self, inputs: int) -> Array | None:
        """Return the input before the start, if all loops state it; 0 for inputs of loops that do not."""
        stated = np.zeros(inputs)
        for loop in self.loops:
            stated[loop.input - 1] += loop.start_input or 0.0
        return None if all(loop.start_input is None for loop in self.loops) else stated


AnyController: TypeAlias = Controller | ContinuousController | PID | PIDLoops


def pids_of(kept: object) -> tuple[PID, ...]:
    """Return the PID controllers of which a user's controller consists; empty if it is not a PID controller."""
    return kept.loops if isinstance(kept, PIDLoops) else (kept,) if isinstance(kept, PID) else ()


def following(controller: Controller, columns: Sequence[int]) -> Controller:
    """Extend a discretised controller, so that it reads set-points, some columns of F, as further measurements."""
    c, more = controller, [*columns]
    B, D = (np.hstack([own, read[:, more]]) for own, read in zip((c.B, c.D), c.reads, strict=True))
    return Controller(c.A, B, c.C, D, c.E, c.dt, c.disturbance, None, c.start_input)


def relative_to(kept: AnyController, plant: Plant | ContinuousPlant) -> AnyController:
    """Express a controller's set-points and inputs as deviations from the operating point of a plant.

    A set-point of 0 is the one at the operating point.
    """
    point = plant.operating_point
    if point is None:
        return kept
    y = plant.rest_outputs
    if isinstance(kept, PID | PIDLoops):
        first, found = set[int](), list[PID]()
        for one in pids_of(kept):
            r = one.setpoint and one.setpoint - (float(y[one.output - 1]) if one.output <= len(y) else 0.0)
            u = one.start_input
            if u is not None and one.input <= len(point.u) and one.input not in first:
                first.add(one.input)
                u -= float(point.u[one.input - 1])
            found.append(replace(one, setpoint=r, start_input=u))
        return found[0] if isinstance(kept, PID) else PIDLoops(tuple(found))
    if kept.setpoint is None:
        return kept
    r = np.asarray(kept.setpoint, dtype=np.float64)
    moved = np.where(r != 0.0, r - y, 0.0) if np.shape(r) == np.shape(y) else r
    if isinstance(kept, ContinuousController):
        return replace(kept, setpoint=moved)
    u = None if kept.start_input is None else kept.start_input - point.u
    return Controller(kept.A, kept.B, kept.C, kept.D, kept.E, kept.dt, kept.disturbance, moved, u, kept.F, kept.G)


def integral_modes(A: Array) -> Array:
    """Return the states, as columns, that a controller x⁺ = A x keeps: its integrals."""
    _, sizes, rows = np.linalg.svd(np.eye(len(A)) - A)
    return rows[sizes < _KEPT].T


def controller_from(
    system: object,
    sign: Literal["negative", "positive"] = "negative",
    method: Method | None = None,
    E: ArrayLike | None = None,
    disturbance: Disturbance | None = None,
    setpoint: ArrayLike | None = None,
    F: ArrayLike | None = None,
    G: ArrayLike | None = None,
) -> AnyController:
    """Convert a system of python-control or scipy, a gain matrix or several PID controllers to a controller.

    Args:
        system: a system from measurements to inputs with attributes A, B, C, D and dt, or with a method ``to_ss``; a
            gain matrix K, (m, p); or PID controllers, for which no other argument is needed.
        sign: ``"negative"``: feedback u = −K y; ``"positive"``: u = K y.
        method: discretisation of a continuous system, ``"tustin"`` (default) or ``"zoh"``.
        E: effect of the applied input on the state of a discrete system, (k, m).
        disturbance: as for ``Controller``.
        setpoint: as for ``Controller``.
        F: effect of set-points on the state, as for ``Controller``; the sign does not change it.
        G: direct effect of set-points on the input, as for ``Controller``; the sign does not change it.

    Returns:
        The controller.

    Raises:
        ProblemError: the system is not linear or not proper, or an argument does not apply to it.

    Example:
        >>> import scipy.signal
        >>> controller_from(scipy.signal.TransferFunction([2.0, 1.0], [1.0, 0.0])).at(0.1, 1, 1).D.tolist()
        [[-2.05]]
    """
    factor = -1.0 if choice("sign", sign, ("negative", "positive")) == "negative" else 1.0
    others = {"method": method, "E": E, "disturbance": disturbance, "setpoint": setpoint, "F": F, "G": G}
    stated = [name for name, value in others.items() if value is not None] + ["sign"] * (factor > 0)
    listed = cast("Sequence[object]", system) if isinstance(system, list | tuple) else ()
    loops = [one for one in listed if isinstance(one, PID)]
    if isinstance(system, Controller | ContinuousController | PID | PIDLoops) or loops:
        if stated:
            raise ProblemError(
                f"{stated[0]} is given in addition to a complete controller; expected it inside this controller"
            )
        if len(loops) < len(listed):
            wrong = next(one for one in listed if not isinstance(one, PID))
            raise ProblemError(f"the list of PID controllers contains {quoted(wrong)}; expected PID controllers only")
        return PIDLoops(tuple(loops)) if loops else cast("AnyController", system)
    if isinstance(system, np.ndarray | Sequence | float | int):
        for name in (name for name in ("method", "E", "F") if name in stated):
            raise ProblemError(f"{name} is given with a gain matrix, which has no state; expected no {name}")
        K = factor * array("controller", np.atleast_2d(cast("Any", system)), (None, None), "(inputs, outputs)")
        m, p = K.shape
        if not K.size:
            raise ProblemError("the controller is empty; expected a gain matrix K, or PID controllers")
        none = np.zeros((0, 0)), np.zeros((0, p)), np.zeros((m, 0))
        return Controller(*none, K, disturbance=disturbance, setpoint=setpoint, G=G)
    linear, dt = state_space_of("controller", system)
    refuse_descriptor("controller", vars_of(linear))
    A, B, C, D = (np.asarray(getattr(linear, name), dtype=np.float64) for name in "ABCD")
    if dt == 0:
        if E is not None:
            raise ProblemError(
                "E is given with a continuous controller; expected a discrete controller: E multiplies the input "
                "that was applied in a step"
            )
        rule = method or "tustin"
        return ContinuousController(
            A, B, factor * C, factor * D, rule, disturbance, setpoint, cast("Any", F), cast("Any", G)
        )
    if method is not None:
        raise ProblemError(
            f"method is {method!r} with a discrete controller; expected no method, or dt = 0 for a continuous "
            "controller"
        )
    return Controller(A, B, factor * C, factor * D, E, dt, disturbance, setpoint, F=F, G=G)
