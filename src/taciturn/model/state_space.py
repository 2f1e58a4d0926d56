"""Conversion of systems of python-control and scipy to plants.

Both libraries have state-space objects with A, B, C, D and dt, or objects that convert to them. They differ in dt:
None is continuous time in scipy and unspecified in python-control, and True is discrete time without seconds. A
descriptor matrix E, which changes the meaning of A and B, is passed on or refused, and delays are refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, cast, runtime_checkable

import numpy as np
import numpy.typing as npt

from taciturn._arrays import ArrayLike, expect_unmasked
from taciturn.errors import ProblemError
from taciturn.model.names import Names, Role, of_labels
from taciturn.model.noise import Noise
from taciturn.model.plant import ContinuousPlant, Plant

DELAYS = ("InputDelay", "OutputDelay", "IODelay", "InternalDelay", "input_delay", "output_delay")
"""Names under which systems of MATLAB and of Python packages have their delays."""


@runtime_checkable
class StateSpaceLike(Protocol):
    """Attributes that `control.StateSpace` and `scipy.signal.StateSpace`/`dlti` have in common."""

    A: npt.NDArray[np.float64]
    B: npt.NDArray[np.float64]
    C: npt.NDArray[np.float64]
    D: npt.NDArray[np.float64]


def plant_from(
    system: object,
    W: ArrayLike | None = None,
    V: ArrayLike | None = None,
    mean: ArrayLike | None = None,
    covariance: ArrayLike | None = None,
    input_limit: ArrayLike | None = None,
    input_rate: ArrayLike | None = None,
    noise: Noise | None = None,
) -> Plant | ContinuousPlant:
    """Convert a `control.StateSpace` or a `scipy.signal.StateSpace`/`dlti` to a plant.

    A continuous-time system becomes a ContinuousPlant, and W is its noise intensity; a discrete-time system becomes a
    Plant. A feedthrough D is read as that of the input in the step before, y_k = C x_k + D û_{k−1}, because a sensor
    samples before the input changes; a note of its results says this. In scipy, ``dt=None`` means continuous time;
    python-control's ``dt=None`` (unspecified) is rejected. If the system has a matrix E, as MATLAB's descriptor
    systems, W is the covariance of the noise in the equation of E.

    The labels of a system of python-control are the names of the plant, unless they are its usual ones, such as
    ``x[0]``, or longer than a name. States of a transfer function have no names, and W in them depends on the tool:
    ``noise`` states the noise at the inputs instead.

    Args:
        system: an object with attributes A, B, C, D and dt, or with a method ``to_ss`` that returns such an object.
        W: covariance or intensity of the process noise, (n, n); required unless ``noise`` states that of the inputs.
        V: measurement-noise covariance, (p, p); if omitted, the measurement is exact.
        mean: mean of the initial state, (n,).
        covariance: covariance of the initial state, (n, n).
        input_limit: limits of each input: a positive number, or a pair [low, high].
        input_rate: largest change of each input, per second of a continuous system, and per step of a discrete one.
        noise: amplitudes of noise at the inputs in place of W, and at the outputs in place of V.

    Returns:
        The plant.

    Raises:
        ProblemError: if the system lacks these attributes, is improper, E is singular, or its time base is unspecified.

    Example:
        >>> import scipy.signal
        >>> plant_from(scipy.signal.dlti([[2.0]], [[1.0]], [[1.0]], [[0.0]], dt=0.1), W=[[1.0]]).dt
        0.1
    """
    linear, step = state_space_of("system", system)
    expect_unmasked("system.D", linear.D)
    C, D = linear.C, linear.D if np.any(np.asarray(linear.D) != 0) else None
    E = descriptor_of(vars_of(linear))
    names = _names_of(system, linear)
    if step == 0:
        return ContinuousPlant(
            linear.A, linear.B, W, C=C, V=V, mean=mean, covariance=covariance, input_limit=input_limit,
            input_rate=input_rate, D=D, E=E, noise=noise, names=names,
        )  # fmt: skip
    return Plant(
        linear.A, linear.B, W, C, V, step, mean, covariance, input_limit, input_rate=input_rate, D=D, E=E, noise=noise,
        names=names,
    )  # fmt: skip


def _names_of(system: object, linear: StateSpaceLike) -> Names | None:
    """Return the names of the signals of a system of python-control; None for other systems."""
    labels: dict[Role, Sequence[str]] = {
        "states": getattr(linear, "state_labels", ()),
        "inputs": getattr(system, "input_labels", ()),
        "outputs": getattr(system, "output_labels", ()),
    }
    return of_labels(labels)


def state_space_of(name: str, system: object) -> tuple[StateSpaceLike, float | None]:
    """Convert a system of python-control or scipy to state space; also return its sampling period.

    The step is 0 for continuous time, and None for discrete time without seconds.
    """
    if not isinstance(system, StateSpaceLike):
        to_state_space = getattr(system, "to_ss", None)  # transfer functions and zero-pole-gain systems
        if to_state_space is None:
            raise ProblemError(
                f"{name} is a {type(system).__name__}; expected a state-space object with A, B, C, D: "
                "convert it first, for example with control.ss"
            )
        try:
            system = cast("StateSpaceLike", to_state_space())
        except (TypeError, ValueError, NotImplementedError, ImportError) as error:  # improper, several inputs, no data
            raise ProblemError(
                f"{name} is a {type(system).__name__} without a state-space form ({error}); expected an object with A, "
                "B, C, D, or a proper transfer function"
            ) from None
    refuse_delays(name, vars_of(system))
    dt: float | bool | None = getattr(system, "dt", None)
    if dt is None and not any(kind.__module__.startswith("scipy.") for kind in type(system).__mro__):
        raise ProblemError(
            "the sampling period dt of the system is None, so it is unspecified; expected 0 (continuous) or the "
            "seconds per step: create the system again with dt=0 or dt=…"
        )
    if dt is None or (dt is not True and dt == 0):
        return system, 0.0
    return system, None if dt is True else float(dt)


def vars_of(system: object) -> dict[str, object]:
    """Return the attributes of a system that change the meaning of A and B: descriptor matrix and delays."""
    return {name: getattr(system, name) for name in ("E", *DELAYS) if getattr(system, name, None) is not None}


def descriptor_of(held: Mapping[str, object]) -> npt.NDArray[np.float64] | None:
    """Return the descriptor matrix E of a system; None if E is missing, or is the identity."""
    matrix = np.asarray(held.get("E", ()), dtype=np.float64)
    one = matrix.ndim == 2 and np.array_equal(matrix, np.eye(len(matrix)))
    return None if one or not matrix.size else matrix


def refuse_descriptor(name: str, held: Mapping[str, object]) -> None:
    """Raise an error if a controller has a descriptor matrix E that is not the identity."""
    if descriptor_of(held) is not None:
        raise ProblemError(
            f"{name} has a descriptor matrix E, E x⁺ = A x + B u; expected a system without E: if E is invertible, "
            "use the matrices E⁻¹A and E⁻¹B"
        )


def refuse_delays(name: str, held: Mapping[str, object]) -> None:
    """Raise an error if a system has delays."""
    for delay in DELAYS:
        if np.any(np.asarray(held.get(delay, 0.0), dtype=np.float64)):
            raise ProblemError(
                f"{name} has {delay} {np.asarray(held[delay]).ravel().tolist()}; expected a system without delays: add "
                "the delayed inputs or outputs to the states, as MATLAB's absorbDelay does, or state the delay of the "
                "link in [links]"
            )
