"""Triggers: decisions that select the action with the smallest of several quadratic forms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, expect_unmasked, frozen, number, semidefinite
from taciturn._display import Displayed
from taciturn.errors import ProblemError


@dataclass(frozen=True, eq=False, repr=False)
class Scheduled(Displayed):
    """A table of matrices or numbers, from which the value i of a discrete state selects ``values[i]``.

    Args:
        by: name of the location, a finite discrete state.
        values: entries of the table, (locations, …).

    Example:
        >>> Scheduled("clock", [[[1.0]], [[2.0]]]).entry_shape
        (1, 1)
    """

    by: str
    values: Array

    def __init__(self, by: str, values: ArrayLike) -> None:
        """Validate and store the arguments."""
        expect_unmasked(f"the table indexed by {by!r}", values)
        try:
            table = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ProblemError(
                f"the table indexed by {by!r} is not an array of numbers ({error}); expected entries of equal shape"
            ) from None
        if table.ndim not in (1, 3) or not len(table):
            raise ProblemError(
                f"the table indexed by {by!r} has shape {table.shape}; expected the shape (locations,) or (locations, "
                "rows, columns)"
            )
        object.__setattr__(self, "by", by)
        object.__setattr__(self, "values", array(f"the table indexed by {by!r}", table, (None,) * table.ndim))

    @property
    def entry_shape(self) -> tuple[int, ...]:
        """Number of rows and columns of each entry of the table."""
        return self.values.shape[1:]


Matrix = Array | Scheduled
"""A constant matrix, or a table with one matrix for each state of a location."""


def matrix(name: str, value: ArrayLike | Scheduled) -> Matrix:
    """Convert a value to a read-only matrix. A table of matrices is returned unchanged."""
    if isinstance(value, Scheduled):
        if value.values.ndim != 3:
            raise ProblemError(f"{name} is a table of numbers; expected a table of matrices")
        return value
    return array(name, value, (None, None), "(rows, columns)")


def shape_of(value: Matrix) -> tuple[int, ...]:
    """Return the number of rows and of columns of a matrix, or of the matrices in a table."""
    return value.entry_shape if isinstance(value, Scheduled) else value.shape


def is_unit(value: Matrix) -> bool:
    """Return whether a matrix is constant and the identity."""
    return isinstance(value, np.ndarray) and np.array_equal(value, np.eye(len(value)))


@dataclass(frozen=True, eq=False, repr=False)
class GaussianTerm(Displayed):
    """A Gaussian term of a form: height · exp(−½ η'Πη).

    Args:
        height: value of the term at η = 0.
        Pi: weight Π in the exponent, (d, d), positive semidefinite.

    Raises:
        ProblemError: if Π is not symmetric or not positive semidefinite.

    Example:
        >>> GaussianTerm(-2.0, [[1.0]]).height
        -2.0
    """

    height: float
    Pi: Array

    def __init__(self, height: float, Pi: ArrayLike) -> None:
        """Validate and store the arguments."""
        object.__setattr__(self, "height", number("the height of a bell", height))
        size = len(array("Pi", Pi, (None, None), "(entries, entries)"))
        object.__setattr__(self, "Pi", semidefinite("Pi", Pi, size, "(entries, entries)"))


@dataclass(frozen=True, eq=False, repr=False)
class Form(Displayed):
    """A form η'Ψη + height·exp(−½η'Πη) + Σ weight·s + constant, where η stacks signals and the s are scalar signals.

    Args:
        signals: names of the signals stacked in η.
        Psi: symmetric weight Ψ of the quadratic term, (d, d); if omitted, the term is absent.
        constant: constant term: a number, or a table of numbers that a location selects.
        plus: weight of each scalar signal s by name, such as a memory or a drawn threshold.
        bell: Gaussian term; if omitted, the term is absent.

    Raises:
        ProblemError: if Psi is given without signals or is not symmetric.
    """

    signals: tuple[str, ...]
    Psi: Matrix | None
    constant: float | Scheduled
    plus: Mapping[str, float]
    bell: GaussianTerm | None

    def __init__(
        self,
        signals: tuple[str, ...] = (),
        Psi: ArrayLike | Scheduled | None = None,
        constant: float | Scheduled = 0.0,
        plus: Mapping[str, float] | None = None,
        bell: GaussianTerm | None = None,
    ) -> None:
        """Validate and store the arguments."""
        if (Psi is None) != (not signals) and not (bell is not None and signals):
            got = f"signals {signals} without Psi" if Psi is None else "Psi without signals"
            raise ProblemError(f"a quadratic form has {got}; expected Psi and signals, or neither of them")
        checked = None if Psi is None else matrix("Psi", Psi)
        if checked is not None:
            values = checked.values if isinstance(checked, Scheduled) else checked
            swapped = np.swapaxes(values, -1, -2)
            same = values.shape == swapped.shape and (
                np.array_equal(values, swapped)
                or np.allclose(values, swapped, rtol=1e-9, atol=1e-12 * np.abs(values).max(initial=0.0))
            )
            if not same:
                raise ProblemError(
                    f"the matrix Psi for the signals {signals} is not symmetric; expected a symmetric matrix"
                )
            halves = (values + swapped) / 2
            checked = Scheduled(checked.by, halves) if isinstance(checked, Scheduled) else frozen(halves)
        object.__setattr__(self, "signals", signals)
        object.__setattr__(self, "Psi", checked)
        object.__setattr__(self, "constant", _constant(constant))
        weights = {name: number(f"the weight of {name}", value) for name, value in (plus or {}).items()}
        object.__setattr__(self, "plus", weights)
        if bell is not None and not signals:
            raise ProblemError(
                "a quadratic form has a Gaussian term (bell) without signals; expected signals as well, or no "
                "Gaussian term"
            )
        object.__setattr__(self, "bell", bell)

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of all signals in the form."""
        return (*self.signals, *self.plus)


@dataclass(frozen=True, eq=False, repr=False)
class Trigger(Displayed):
    """A decision that selects the action j with the smallest η'Ψ_j η + c_j; of several, it selects the first.

    Silence is therefore listed first. With a limit, the trigger selects the first listed action whose form is at most
    the limit, and the last action if there is none. An action is excluded while one of certain forms is positive.

    Args:
        options: the form of each action, by label.
        limit: the limit of the forms; None for the smallest form.
        excluded: the forms that exclude an action while one of them is positive, by label.

    Raises:
        ProblemError: if there are fewer than two options, or another action is excluded.

    Example: send when e'e exceeds 2.

        >>> Trigger({"silent": Form(("error",), [[1.0]]), "send": Form(constant=2.0)}).labels
        ('silent', 'send')
    """

    options: Mapping[str, Form]
    limit: float | None = None
    excluded: Mapping[str, tuple[Form, ...]] = field(default_factory=lambda: {})

    def __post_init__(self) -> None:
        """Validate and store the arguments."""
        if self.limit is not None:
            object.__setattr__(self, "limit", number("the limit of a trigger", self.limit))
        if len(self.options) < 2:
            raise ProblemError(f"a trigger has the options {list(self.options)}; expected at least two options")
        for label in (label for label in self.excluded if label not in self.options):
            raise ProblemError(f"a trigger excludes {label!r}; expected one of its options {list(self.options)}")
        object.__setattr__(self, "options", dict(self.options))

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the actions, in order. If two forms are equal, the action that comes first is selected."""
        return tuple(self.options)

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of all signals in the forms of the trigger."""
        return tuple(dict.fromkeys(name for form in self.forms for name in form.reads))

    @property
    def selected_by(self) -> set[str]:
        """Names of the discrete states that select constants of the forms from tables."""
        constants = [form.constant for form in self.options.values()]
        return {constant.by for constant in constants if isinstance(constant, Scheduled)}

    @property
    def forms(self) -> tuple[Form, ...]:
        """All forms of the trigger: those that are compared, and those that exclude an action."""
        return (*self.options.values(), *(form for forms in self.excluded.values() for form in forms))


def _constant(value: float | Scheduled) -> float | Scheduled:
    if not isinstance(value, Scheduled):
        return number("the constant of a form", value)
    if value.values.ndim != 1:
        raise ProblemError(f"the constant indexed by {value.by!r} is a table of matrices; expected a table of numbers")
    return value
