"""Linear controllers that a user already has, such as PID controllers, in the time steps of a policy.

A controller computes the input u = C z + D y with the state z⁺ = A z + B y + E u; E feeds the applied input back. The
method ``at`` of each controller returns the ``Controller`` for the steps, inputs and outputs of a plant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, ArrayLike, array, choice, expect_unmasked, number, quoted
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.disturbance import Disturbance

Method: TypeAlias = Literal["tustin", "zoh"]


@dataclass(frozen=True, eq=False, repr=False)
class Controller(Displayed):
    """A linear controller in discrete time: z⁺ = A z + B y + E u and u = C z + D y, with u as applied in each step.

    Args:
        A: dynamics of the controller's state, (k, k).
        B: effect of the measurement on the state, (k, p).
        C: effect of the state on the input, (m, k).
        D: direct effect of the measurement, (m, p); default 0.
        E: effect of the applied input on the state, (k, m), for observers; default 0.
        dt: seconds per step; None if it is not stated.
        disturbance: slowly varying disturbance at each input of the plant; default: ``Disturbance()`` if the controller
            integrates, otherwise none.
        setpoint: constant set-point of each output, (p,), or of the only one, which is subtracted from the measurement;
            default 0. At an operating point of the plant, 0 means the output there.
        rest: state of the controller when it rests at the set-point, relative to that of feedback of the error only,
            (k,); set-point weights change it; default 0.
        start_input: input before the start, (m,), which the first command equals on average; default: the controller
            starts with its state at zero.

    Raises:
        ProblemError: the sizes of the matrices differ.

    Example:
        >>> Controller([[1.0]], [[0.1]], [[-0.15]], [[-1.2]]).integrates
        True
    """

    A: Array
    B: Array
    C: Array
    D: Array
    E: Array
    dt: float | None
    disturbance: Disturbance | None
    setpoint: Array
    rest: Array
    start_input: Array | None

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
        rest: ArrayLike | None = None,
        start_input: ArrayLike | None = None,
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
        for name, value in (("A", A), ("B", B), ("C", C)):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "D", array("controller.D", D, (m, p), "(inputs, outputs)"))
        object.__setattr__(self, "E", array("controller.E", E, (k, m), "(controller states, inputs)"))
        object.__setattr__(self, "dt", None if dt is None else number("controller.dt", dt, 0.0))
        object.__setattr__(self, "disturbance", checked_disturbance("controller.disturbance", disturbance))
        for name, value, size in (("setpoint", setpoint, p), ("rest", rest, k)):
            expect_unmasked(f"controller.{name}", value)
            found = np.zeros(size) if value is None else np.atleast_1d(np.asarray(value))
            object.__setattr__(self, name, array(f"controller.{name}", found, (size,), f"({size},)"))
        found = None if start_input is None else array("controller.start_input", start_input, (m,), "(inputs,)")
        object.__setattr__(self, "start_input", found)

    @property
    def integrates(self) -> bool:
        """True if the controller has an integrator, an eigenvalue 1 of A + E C, when its commands are applied."""
        applied = self.A + self.E @ self.C
        return bool(np.any(np.abs(np.linalg.eigvals(applied) - 1.0) < 1e-9)) if len(self.A) else False

    @property
    def expected(self) -> Disturbance | None:
        """The disturbance that the controller compensates, with default values if it integrates, or None."""
        stated = self.disturbance
        if stated is None:
            return Disturbance() if self.integrates else None
        return None if stated.absent else stated

    def at(self, dt: float | None, inputs: int, outputs: int) -> Controller:
        """Return the controller itself, which must suit the steps, inputs and outputs of the plant.

        Raises:
            ProblemError: both steps are stated and differ, or a number differs.
        """
        if self.dt is not None and dt is not None and abs(self.dt - dt) > 1e-9 * dt:
            raise ProblemError(
                f"controller.dt is {self.dt:g} s, and a step of the policy takes {dt:g} s; expected equal steps"
            )
        for name, got, expected in zip(("inputs", "measurements"), self.D.shape, (inputs, outputs), strict=True):
            if got != expected:
                raise ProblemError(f"the controller has {got} {name}; expected {expected}, as for the plant")
        return self


@dataclass(frozen=True, eq=False, repr=False)
class ContinuousController(Displayed):
    """A linear controller in continuous time: dz/dt = A z + B y and u = C z + D y.

    Args:
        A: dynamics of the controller's state, (k, k), per second.
        B: effect of the measurement on the state, (k, p).
        C: effect of the state on the input, (m, k).
        D: direct effect of the measurement, (m, p).
        method: ``"tustin"``: the trapezoidal rule; ``"zoh"``: measurements are constant within a step.
        disturbance: as for ``Controller``.
        setpoint: as for ``Controller``.

    Raises:
        ProblemError: the sizes of the matrices differ, or the method is unknown.

    Example:
        >>> ContinuousController([[0.0]], [[1.0]], [[-1.0]], [[-2.0]]).at(0.1, 1, 1).D.tolist()
        [[-2.05]]
    """

    A: Array
    B: Array
    C: Array
    D: Array
    method: Method = "tustin"
    disturbance: Disturbance | None = None
    setpoint: ArrayLike | None = None

    def __post_init__(self) -> None:
        """Validate the matrices and the method."""
        choice("controller.method", self.method, ("tustin", "zoh"))
        checked_disturbance("controller.disturbance", self.disturbance)
        stated = Controller(self.A, self.B, self.C, self.D)
        for name in ("A", "B", "C", "D"):
            object.__setattr__(self, name, getattr(stated, name))

    def at(self, dt: float | None, inputs: int, outputs: int) -> Controller:
        """Return the controller at a step of ``dt`` seconds.

        Raises:
            ProblemError: the step is not stated, or the number of inputs or outputs is not that of the plant.
        """
        method = "bilinear" if self.method == "tustin" else "zoh"
        step = stated_step(dt)
        try:
            found = _scipy.discrete_controller(self.A, self.B, self.C, self.D, step, method)
        except np.linalg.LinAlgError:
            raise ProblemError(
                f"the controller has a pole at 2/h = {2 / step:g} per second with steps of h = {step:g} s, so the "
                'trapezoidal rule does not apply; expected method = "zoh", or dt of the controller if its matrices are '
                "per step"
            ) from None
        return Controller(*found, None, dt, self.disturbance, self.setpoint).at(dt, inputs, outputs)

    def ringing(self, dt: float) -> tuple[float, float] | None:
        """Return time constant and eigenvalue of the mode that rings most at a step of ``dt`` seconds, or None.

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
    """Return a disturbance, or None for the default.

    Raises:
        ProblemError: the value is something else.
    """
    if value is not None and not isinstance(value, Disturbance):
        raise ProblemError(
            f"{name} is {quoted(value)}; expected a Disturbance, Disturbance(deviation=0) for no disturbance, or None "
            "for the default"
        )
    return value


def stated_step(dt: float | None) -> float:
    """Return the seconds per step, which must be stated."""
    if dt is None:
        raise ProblemError(
            "plant.dt is missing; expected the seconds per step, in which a PID or continuous controller acts"
        )
    return dt
