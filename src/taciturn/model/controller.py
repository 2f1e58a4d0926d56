"""Linear controllers that a user already has, such as PID controllers, in the time steps of a policy.

A controller computes the input from measurements, u = C z + D y with the state z⁺ = A z + B y + E u. E feeds the
applied input back, as an observer does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, number
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.disturbance import Disturbance


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
    dt: float | None = None
    disturbance: Disturbance | None = None

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        C: ArrayLike,
        D: ArrayLike | None = None,
        E: ArrayLike | None = None,
        dt: float | None = None,
        disturbance: Disturbance | None = None,
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
        object.__setattr__(self, "disturbance", disturbance)

    @property
    def integrates(self) -> bool:
        """True if the controller has an integrator: an eigenvalue 1 of A."""
        return bool(np.any(np.abs(np.linalg.eigvals(self.A) - 1.0) < 1e-9)) if len(self.A) else False

    @property
    def expected(self) -> Disturbance | None:
        """The disturbance that the controller compensates, with default values if it integrates, or None."""
        stated = self.disturbance
        if stated is None:
            return Disturbance() if self.integrates else None
        return None if stated.absent else stated

    def at(self, dt: float | None) -> Controller:
        """Return the controller itself, whose step must be ``dt`` if both are stated.

        Raises:
            ProblemError: both steps are stated and differ.
        """
        if self.dt is not None and dt is not None and abs(self.dt - dt) > 1e-9 * dt:
            raise ProblemError(
                f"controller.dt is {self.dt:g} s, and a step of the policy takes {dt:g} s; expected equal steps"
            )
        return self


@dataclass(frozen=True, repr=False)
class PID(Displayed):
    """A PID controller of one measurement, u = −(kp y + ki ∫y dt + kd dy/dt).

    The integral and the filter of the derivative use forward differences over a step h: I⁺ = I + h y,
    f⁺ = f + (h/T)(y − f), and the derivative is (y − f)/T.

    Args:
        kp: proportional gain.
        ki: integral gain per second.
        kd: derivative gain in seconds.
        filter: time constant T of the derivative's filter in seconds, at least a step; required with ``kd``.
        disturbance: slowly varying disturbance at the input of the plant; default: ``Disturbance()`` with ``ki``,
            otherwise none.

    Raises:
        ProblemError: a gain is not finite, or the filter is missing or not positive.

    Example:
        >>> PID(1.2, 0.15, 1.0, 0.5).at(0.1).D.tolist()
        [[-3.2]]
    """

    kp: float
    ki: float = 0.0
    kd: float = 0.0
    filter: float | None = None
    disturbance: Disturbance | None = None

    def __post_init__(self) -> None:
        """Check the gains and the filter."""
        for name in ("kp", "ki", "kd"):
            number(f"pid.{name}", getattr(self, name))
        if self.filter is not None:
            number("pid.filter", self.filter, 0.0)
        elif self.kd:
            raise ProblemError(
                "pid.filter is missing; expected the time constant of the derivative's filter in seconds, such as a "
                "tenth of kd/kp"
            )

    def at(self, dt: float | None) -> Controller:
        """Return the controller at a step of ``dt`` seconds.

        Raises:
            ProblemError: the step is not stated, or longer than the filter's time constant.
        """
        if dt is None:
            raise ProblemError("plant.dt is missing; expected the seconds per step, in which a PID controller acts")
        A, B, C, D = list[float](), list[float](), list[float](), -self.kp
        if self.ki:
            A, B, C = [1.0], [dt], [-self.ki]
        if self.kd and self.filter is not None:
            T = self.filter
            if dt > T:
                raise ProblemError(
                    f"pid.filter is {T:g} s, and a step takes {dt:g} s; expected a filter of at least a step"
                )
            A, B, C, D = [*A, 1.0 - dt / T], [*B, dt / T], [*C, self.kd / T], D - self.kd / T
        k = len(A)
        return Controller(
            np.diag(A).reshape(k, k), np.reshape(B, (k, 1)), np.reshape(C, (1, k)), [[D]], None, dt, self.disturbance
        )
