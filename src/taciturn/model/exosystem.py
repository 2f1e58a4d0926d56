"""Disturbances and set-points of a plant: signals that no input moves, and that the outputs are to be free of.

The exosystem d⁺ = S d + w_d (or ḋ = S d + noise) acts on the plant:

    x⁺ = A x + B u + E d + w,   y = C x + G d + v,   z = C_z x + D_z u + F d,

and z is to be zero. D_z is zero, except for measured outputs of a plant with a direct feedthrough. A constant
disturbance is S = 1, and a set-point r of the output z is a state of d with F = −1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, pi, sin
from typing import Literal, TypeAlias, get_args

import numpy as np

from taciturn._arrays import (
    Array,
    ArrayLike,
    array,
    block_diagonal,
    number,
    quoted,
    semidefinite,
    square,
)
from taciturn._display import Displayed
from taciturn._exact_modes import Limit, free_modes
from taciturn.errors import ProblemError
from taciturn.model.set_points import Changes, SetPoint

Shape: TypeAlias = Literal["constant", "ramp", "sinusoid", "matrix"]


@dataclass(frozen=True, eq=False, repr=False)
class ExternalDisturbance(Displayed):
    """A disturbance of known shape and unknown size, which the filter estimates and the input compensates.

    Args:
        enters: how the disturbance moves the state: entries added to x per step, or per second, (n,).
        wander: variance per step, or intensity per second, of the noise that moves the disturbance, positive: of its
            value, for a ramp of its slope, for a sinusoid of both of its components, for a matrix of all of its states.
        shape: ``"constant"``, ``"ramp"``, ``"sinusoid"``, or ``"matrix"`` for dynamics of one's own.
        frequency: radians per step of a sinusoid, or radians per second for a continuous plant.
        measured: how the disturbance adds to the measured outputs, (p,); default 0.
        matrix: S of the shape ``"matrix"``: d⁺ = S d per step, or ḋ = S d for a continuous plant, (q, q). The first
            state is the value of the disturbance. No mode may grow.

    Raises:
        ProblemError: the wander is not positive, or a frequency or a matrix is missing or not used.

    Example:
        >>> ExternalDisturbance([0.0, 0.3], wander=1e-3).dynamics(continuous=False)
        array([[1.]])
    """

    enters: Array
    wander: float
    shape: Shape = "constant"
    frequency: float | None = None
    measured: Array | None = None
    matrix: Array | None = None

    def __init__(
        self,
        enters: ArrayLike,
        wander: float,
        shape: Shape = "constant",
        frequency: float | None = None,
        measured: ArrayLike | None = None,
        matrix: ArrayLike | None = None,
    ) -> None:
        """Validate and store the arguments."""
        object.__setattr__(self, "enters", array("disturbance.enters", enters, (None,), "(states,)"))
        object.__setattr__(self, "wander", number("disturbance.wander", wander, 0.0))
        if shape not in get_args(Shape):
            raise ProblemError(f"disturbance.kind is {quoted(shape)}; expected one of {', '.join(get_args(Shape))}")
        if (frequency is None) == (shape == "sinusoid"):
            got = "missing" if frequency is None else f"{frequency:g}"
            expected = "the radians per step or second of a sinusoid" if frequency is None else f"none for a {shape}"
            raise ProblemError(f"disturbance.frequency is {got}; expected {expected}")
        if (matrix is None) == (shape == "matrix"):
            got = "missing" if matrix is None else "given"
            expected = "S of d⁺ = S d, or of ḋ = S d" if matrix is None else f"none for a {shape}"
            raise ProblemError(f"disturbance.matrix is {got}; expected {expected}")
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "matrix", None if matrix is None else square("disturbance.matrix", matrix))
        checked = None if frequency is None else number("disturbance.frequency", frequency, 0.0)
        object.__setattr__(self, "frequency", checked)
        seen = None if measured is None else array("disturbance.measured", measured, (None,), "(outputs,)")
        object.__setattr__(self, "measured", seen)
        if not self.enters.any() and (seen is None or not seen.any()):
            raise ProblemError("disturbance.enters and measured are zero; expected an effect on a state or output")

    def dynamics(self, continuous: bool) -> Array:
        """Return S; the first state is the value of the disturbance.

        Raises:
            ProblemError: a mode of the matrix grows.
        """
        if self.matrix is not None:
            limit = Limit(continuous)
            growing = free_modes(self.matrix, limit).growing
            if growing.size:
                raise ProblemError(
                    f"disturbance.matrix has the mode {limit.named(complex(growing[0]))}, which grows; expected modes "
                    "that decay or persist"
                )
            return self.matrix
        if self.shape == "constant":
            return np.array([[0.0 if continuous else 1.0]])
        if self.shape == "ramp":
            return np.array([[0.0, 1.0], [0.0, 0.0]]) + (0.0 if continuous else np.eye(2))
        w = self.frequency or 0.0
        if not continuous and w >= pi:
            raise ProblemError(f"disturbance.frequency is {w:g}; expected below π radians per step")
        return np.array([[0.0, w], [-w, 0.0]]) if continuous else np.array([[cos(w), sin(w)], [-sin(w), cos(w)]])

    @property
    def noise(self) -> Array:
        """The covariance, or intensity, of the noise of the states."""
        moved = {"constant": [1.0], "ramp": [0.0, 1.0], "sinusoid": [1.0, 1.0]}
        own = [] if self.matrix is None else [1.0] * len(self.matrix)
        return self.wander * np.diag(moved.get(self.shape, own))


@dataclass(frozen=True, eq=False, repr=False)
class Exosystem(Displayed):
    """All disturbances and set-points of a plant.

    Args:
        S: dynamics of the states d, (q, q).
        E: effect on the state of the plant, (n, q).
        G: effect on the measured outputs, (p, q).
        W: covariance per step, or intensity per second, of the noise that moves d, (q, q).
        start: initial value of d, (q,).
        outputs: C_z, (z, n).
        F: effect on z = C_z x + D_z u + F d, (z, q).
        changes: how the last states of d change, the set-points that the controller is given; None for constant ones.
        D: D_z, (z, m), or None for zero.
    """

    S: Array
    E: Array
    G: Array
    W: Array
    start: Array
    outputs: Array
    F: Array
    changes: Changes | None = None
    D: Array | None = None

    def __post_init__(self) -> None:
        """Check the sizes and the covariance."""
        q, (z, n) = len(self.S), self.outputs.shape
        shapes: Mapping[str, tuple[int | None, ...]] = {
            "S": (q, q), "E": (n, q), "G": (None, q), "start": (q,), "outputs": (z, n), "F": (z, q)
        }  # fmt: skip
        for name, shape in shapes.items():
            object.__setattr__(self, name, array(f"exosystem.{name}", getattr(self, name), shape))
        object.__setattr__(self, "W", semidefinite("exosystem.W", self.W, q, "(q, q)"))

    @staticmethod
    def of(disturbances: Sequence[ExternalDisturbance], target: SetPoint, outputs: int, continuous: bool) -> Exosystem:
        """Return the exosystem of disturbances and of a set-point.

        Args:
            disturbances: the disturbances.
            target: the combinations of the states that are to be at their set-points.
            outputs: number of measured outputs p.
            continuous: whether the plant is continuous in time.

        Raises:
            ProblemError: a disturbance has another number of states or outputs than the plant.
        """
        z, n = target.outputs.shape
        parts, enters, seen = list[Array](), list[Array](), list[Array]()
        for place, one in enumerate(disturbances):
            try:
                S = one.dynamics(continuous)
            except ProblemError as error:
                raise ProblemError(str(error).replace("disturbance.", f"disturbance[{place}].")) from None
            measured = np.zeros(outputs) if one.measured is None else one.measured
            for name, got, expected in (("enters", one.enters, n), ("measured", measured, outputs)):
                if len(got) != expected:
                    raise ProblemError(f"disturbance[{place}].{name} has {len(got)} entries; expected {expected}")
            parts.append(S)
            rest = np.zeros((1, len(S) - 1))
            enters.append(np.hstack([one.enters[:, None], np.tile(rest, (n, 1))]))
            seen.append(np.hstack([measured[:, None], np.tile(rest, (outputs, 1))]))
        r = z if target.moved else 0  # states of the set-points
        S = block_diagonal(*parts, np.zeros((r, r)) if continuous else np.eye(r))
        q = len(S) - r
        noise = [np.zeros((r, r)) if target.changes is None else target.changes.noise]
        return Exosystem(
            S=S,
            E=np.hstack([*enters, np.zeros((n, r))]),
            G=np.hstack([*seen, np.zeros((outputs, r))]),
            W=block_diagonal(*(one.noise for one in disturbances), *noise),
            start=np.concatenate([np.zeros(q), target.value[:r]]),
            outputs=target.outputs,
            F=np.hstack([np.zeros((z, q)), -np.eye(z)[:, :r]]),
            changes=target.changes,
            D=target.D,
        )
