"""Noise by its amplitude at the inputs and outputs of a plant, in place of the covariances W and V.

A covariance of the states depends on their choice: a realisation of a transfer function has states of its own, in
which no one knows W. Inputs and outputs are the same in every realisation. Noise that adds to the inputs moves the
state as the inputs do, so W = B diag(σ²) B'. With a descriptor matrix, B is that of its equation.

The noise of an input changes the state alone: a direct feedthrough D does not show it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, set_fields
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.key import stated_as


@dataclass(frozen=True, eq=False, repr=False)
class Noise(Displayed):
    """Independent white noise that adds to the inputs and to the measured outputs: W = B diag(input²) B' and
    V = diag(output²).

    Args:
        input: standard deviation of the noise at each input, (m,), in the unit of the input: per step of a discrete
            plant. For a continuous plant it is the root of an intensity, in the unit of the input times √s: the
            integral of the noise over T seconds has the standard deviation input·√T. Omitted: W states the noise.
        output: standard deviation of the noise of each measured output, (p,), in the unit of the output. It is that of
            each sample, as V is, also if the plant is continuous. Omitted: V states the noise, or there is none.

    Raises:
        ProblemError: neither is given, or a standard deviation is negative or not finite.

    Example:
        >>> from taciturn import Plant
        >>> plant = Plant([[0.9]], [[2.0]], C=[[1.0]], noise=Noise(input=[0.5], output=[0.1]))
        >>> plant.W, plant.V.round(3)
        (array([[1.]]), array([[0.01]]))
    """

    input: Array | None = field(metadata=stated_as(list[float] | None))
    output: Array | None = field(metadata=stated_as(list[float] | None))

    def __init__(self, input: ArrayLike | None = None, output: ArrayLike | None = None) -> None:
        """Validate and store the arguments."""
        if input is None and output is None:
            raise ProblemError(
                "noise states no amplitude; expected noise.input, noise.output or both, such as noise = {input = "
                "[0.3], output = [0.01]}"
            )
        set_fields(self, {"input": _amplitudes("input", input), "output": _amplitudes("output", output)})

    def covariances(
        self, W: ArrayLike | None, V: ArrayLike | None, B: ArrayLike, outputs: int
    ) -> tuple[ArrayLike | None, ArrayLike | None]:
        """Return the covariances W and V of the noise, and the given one where the noise states none."""
        for name, given, own in (("W", W, "input"), ("V", V, "output")):
            if given is not None and getattr(self, own) is not None:
                raise ProblemError(f"{name} and noise.{own} are both given; expected only one of them: remove one")
        if self.input is not None:
            matrix = array("B", B, (None, None), "(states, inputs)")
            spread = matrix * array("noise.input", self.input, (matrix.shape[1],), "(inputs,)")
            W = spread @ spread.T
        if self.output is not None:
            V = np.diag(array("noise.output", self.output, (outputs,), "(outputs,)") ** 2)
        return W, V


def _amplitudes(name: str, value: ArrayLike | None) -> Array | None:
    if value is None:
        return None
    found = array(f"noise.{name}", value, (None,), f"({name}s,)")
    for i in np.flatnonzero(found < 0):
        raise ProblemError(f"noise.{name}[{i}] is {found[i]:g}; expected a standard deviation, at least 0")
    return found
