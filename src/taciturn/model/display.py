"""Descriptions of plants and matrices for ``taciturn show``, Python and notebooks."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import ClassVar, Self, TypeVar

import numpy as np

from taciturn._arrays import Array, frozen
from taciturn._display import Displayed
from taciturn._exact_modes import FEWEST, Limit
from taciturn._modes import eigenvalues, mode_text
from taciturn._text import Lines
from taciturn.model.operating_point import MovedDynamics, OperatingPoint
from taciturn.model.plant import ContinuousPlant, Plant, limits_at
from taciturn.model.saturation import Saturation, saturation
from taciturn.model.trigger import Matrix, Scheduled

BLUR = 1e-6  # relative difference below which poles are considered equal
WIDEST = 12  # largest number of columns of a matrix that is printed in full
NARROW = 6  # most columns of four digits that fit a line
FED = "y = C x + D u + v, with the input u of the step before, as each sample is taken before the input changes"
NamedRows = dict[str, str | Array | None]


class DisplayedPlant(Displayed):
    """Base class of plants that print a summary before their matrices.

    A plant in continuous time replaces the description of its noise, a plant in discrete time that of its time base.
    ``stated_limit`` are the limits of the inputs in the units of the plant, (m, 2), from which ``input_limit`` is
    computed for each operating point, so that it does not depend on the points between.
    """

    A: Array
    B: Array
    C: Array
    W: Array
    V: Array
    mean: Array
    covariance: Array
    input_limit: Array | None
    stated_limit: Array | None
    input_rate: Array | None
    full_state: bool
    operating_point: OperatingPoint | None
    D: Array | None
    continuous: ClassVar[bool] = True

    @property
    def states(self) -> int:
        """Number of states n."""
        return self.A.shape[0]

    @property
    def inputs(self) -> int:
        """Number of inputs m."""
        return self.B.shape[1]

    @property
    def saturation(self) -> Saturation | None:
        """The limits of the inputs and of their changes, or None."""
        return saturation(self.input_limit, self.input_rate)

    @property
    def unlimited(self) -> Self:
        """The plant without limits of its inputs."""
        return self._without("input_limit", "stated_limit", "input_rate")

    @property
    def linear(self) -> Self:
        """The plant of the design: linear, and without limits of its inputs."""
        return self._without("input_limit", "stated_limit", "input_rate", "function")

    def _without(self, *names: str) -> Self:
        found = copy(self)
        for name in names:
            if getattr(self, name, None) is not None:
                object.__setattr__(found, name, None)
        return found

    @property
    def rest_outputs(self) -> Array:
        """The outputs at the operating point, (p,); zeros without a point."""
        point = self.operating_point
        if point is None:
            return np.zeros(len(self.C))
        return self.C @ point.x if self.D is None else self.C @ point.x + self.D @ point.u

    @property
    def stated_mean(self) -> Array:
        """The mean of the initial state in the units of the plant, (n,)."""
        return self.mean if self.operating_point is None else self.mean + self.operating_point.x

    @property
    def time(self) -> str:
        """Description of the time base."""
        return "continuous in time"

    @property
    def noise(self) -> str | None:
        """Description of noise that is not Gaussian, or None."""
        return None

    def summary(self) -> NamedRows:
        """Return the size, time base, poles, measurement, noise and matrices of the plant by name."""
        return {
            "size": self.short(),
            "time": self.time,
            "poles": _poles(self.A, self.continuous),
            "measured": "the full state, exactly" if self.full_state else FED if self.D is not None else "y = C x + v",
            "noise": self.noise,
            "A": self.A,
            "B": self.B,
            "C": None if self.full_state else self.C,
            "D": self.D,
            "W": self.W,
            "V": None if self.full_state else self.V,
            "operating point": None if self.operating_point is None else self.operating_point.short(),
            "mean": self.stated_mean if self.mean.any() else None,
            "covariance": self.covariance if self.covariance.any() else None,
            "input limit": None if self.stated_limit is None else limits_text(self.stated_limit),
            "input rate": None if self.input_rate is None else rates_text(self.input_rate, self.continuous),
        }

    def short(self, inputs: int | None = None) -> str:
        """Return the numbers of states, inputs and outputs as text; a given number of inputs replaces that of B."""
        counts = (self.states, self.inputs if inputs is None else inputs, self.C.shape[0])
        named = zip(counts, ("state", "input", "output"), strict=True)
        return ", ".join(f"{count} {name}{'s' * (count != 1)}" for count, name in named)


def limits_text(limit: Array) -> str:
    """Return the limits of the inputs, (m, 2), as text."""
    sides = (f"±{high:.6g}" if low == -high else f"{low:.6g} to {high:.6g}" for low, high in limit)
    return ", ".join(sides).replace("inf", "∞")


def rates_text(rate: Array, continuous: bool) -> str:
    """Return the largest changes of the inputs, (m,), as text."""
    listed = ", ".join(f"{value:.6g}" for value in rate).replace("inf", "∞")
    return f"at most {listed} per {'second' if continuous else 'step'}"


def _poles(A: Array, continuous: bool) -> str:
    """Return the stability of a plant without control, and its poles, as text."""
    poles = eigenvalues(A)
    size = max(float(np.abs(poles).max()), 1e-300) if continuous else 1.0
    margin = float(poles.real.max() if continuous else np.abs(poles).max() - 1) / size
    stable = "marginally stable" if abs(margin) < BLUR else "stable" if margin < 0 else "unstable"
    shown = [complex(p.real) if abs(p.imag) < BLUR * abs(p) else complex(p) for p in poles]
    shown.sort(key=lambda p: (-float(f"{abs(p):.6g}"), p.real, -p.imag))  # rounding does not decide their order
    limit = Limit(continuous)
    digits = [limit.digits(p) if stable == "unstable" else FEWEST for p in shown]
    return f"{stable}: {', '.join(map(mode_text, shown, digits))}"


def matrix_lines(name: str, value: Matrix) -> Lines:
    """Return a matrix row by row; special matrices are abbreviated, and only the first matrix of a table is shown."""
    if isinstance(value, Scheduled):
        first = value.values[0]
        if len(value.values) == 1:
            return matrix_lines(name, first)
        note = (name, f"selected by {value.by}, {len(value.values)} matrices; the first:")
        return [note, *(("", text) for _, text in matrix_lines("", first))]
    rows, columns = value.shape
    if not value.any():
        return [(name, f"0 ({rows}×{columns})")]
    diagonal = np.diag(value) if rows == columns else value[:0, 0]
    if rows == columns > 1 and np.array_equal(value, np.diag(diagonal)):
        same = (diagonal == diagonal[0]).all()
        factor = "" if diagonal[0] == 1 else f"{diagonal[0]:.6g} "
        return [(name, f"{factor}I ({rows}×{rows})" if same else f"diag({', '.join(f'{d:.4g}' for d in diagonal)})")]
    if columns > WIDEST:
        return [(name, f"{rows}×{columns}, entries from {value.min():.4g} to {value.max():.4g}")]
    digits = 4 if columns <= NARROW else 2
    return [(name if i == 0 else "", vector_text(row, digits)) for i, row in enumerate(value)]


def vector_text(values: Array, digits: int = 4) -> str:
    """Return the entries of a vector in columns of equal width."""
    return (
        f"[{' '.join(f'{value:{digits + 6}.{digits}g}' for value in values)}]"
        if len(values) > 1
        else f"[{values[0]:.6g}]"
    )


def counted_from(plant: AnyPlant, point: OperatingPoint | None, origin: Plant | ContinuousPlant) -> AnyPlant:
    """Return a plant whose states and inputs already are deviations from a point, with this point as theirs.

    Args:
        plant: the plant.
        point: the point, or None.
        origin: the plant from which this one was made, with the same inputs and limits.
    """
    if point is None:
        return plant
    found = copy(plant)
    object.__setattr__(found, "operating_point", point)
    object.__setattr__(found, "stated_limit", origin.stated_limit)
    return found


def about(plant: Plant, point: OperatingPoint | None) -> Plant:
    """Return a plant in deviations from another point; None is the point 0, so that the plant is in its own units.

    If the plant does not rest at this point, its ``drift`` is what its state moves by there.
    """
    here = plant.operating_point
    if here is point or (here is not None and point is not None and here.same_as(point)):
        return plant
    zero = OperatingPoint(np.zeros(plant.states), np.zeros(plant.inputs))
    start, end = here or zero, point or zero
    x, u = end.x - start.x, end.u - start.u
    found, terms = counted_from(plant, end, plant), [plant.A @ x, plant.B @ u, -x]
    drift = np.sum([*terms, *([] if plant.drift is None else [plant.drift])], axis=0)
    still = np.abs(drift).max() <= STILL * max(float(np.abs(term).max()) for term in terms)
    function = plant.function
    moved: Mapping[str, object] = {
        "mean": frozen(plant.mean - x),
        "input_limit": limits_at(plant, point),
        "drift": None if still or function is not None else frozen(drift),
        "function": None if function is None else MovedDynamics.of(function, x, u, x),
        "operating_point": point,
    }
    for name, value in moved.items():
        object.__setattr__(found, name, value)
    return found


AnyPlant = TypeVar("AnyPlant", bound="Plant | ContinuousPlant")


STILL = 1e-10  # drift that is a rounding error, relative to its terms
