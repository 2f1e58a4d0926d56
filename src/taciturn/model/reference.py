"""A reference to be tracked, and what a policy that tracks one tells the loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, ArrayLike, array
from taciturn.errors import ProblemError
from taciturn.model.plant import Plant

FOLLOWS = 1e-9  # of the largest state: how far a written state may miss the one its step leads to


@dataclass(frozen=True, eq=False)
class Reference:
    """The states r_0 … r_N and inputs f_0 … f_{N−1} of a desired motion, stored at both ends of the network.

    Args:
        states: r_k, (steps + 1, n).
        inputs: the feedforward f_k, (steps, m), with r_{k+1} = A r_k + B f_k.

    Raises:
        ProblemError: lengths that do not fit.
    """

    states: Array
    inputs: Array

    def __init__(self, states: ArrayLike, inputs: ArrayLike) -> None:
        """Check and freeze."""
        object.__setattr__(self, "inputs", array("reference.inputs", inputs, (None, None), "(steps, inputs)"))
        shape, meaning = (len(self.inputs) + 1, None), "(steps + 1, states)"
        object.__setattr__(self, "states", array("reference.states", states, shape, meaning))

    def check(self, plant: Plant, horizon: int) -> None:
        """Check that this is a motion of the plant over so many ticks: each step is the one that its input causes.

        Raises:
            ProblemError: sizes or length differ, or a state is not the one that the step before it leads to.
        """
        for name, found, wanted in (
            ("inputs", self.inputs.shape, (horizon, plant.inputs)),
            ("states", self.states.shape, (horizon + 1, plant.states)),
        ):
            if found != wanted:
                raise ProblemError(
                    f"reference.{name} has shape {found}; expected {wanted}: the horizon and the sizes of the plant"
                )
        caused, pushes = self.states[:-1] @ plant.A.T, self.inputs @ plant.B.T
        miss = np.abs(caused + pushes - self.states[1:]).max(axis=1)
        allowed = FOLLOWS * max(float(np.abs(part).max()) for part in (self.states, caused, pushes))
        if (miss > allowed).any():
            step = int(np.argmax(miss > allowed))
            raise ProblemError(
                f"reference.states misses by {miss[step]:.3g} at step {step + 1} what step {step} and its input cause; "
                f"expected r⁺ = A r + B f within {allowed:.3g}: compute the states from the inputs with all digits"
            )


@dataclass(frozen=True, eq=False)
class Tracking:
    """The signals of a policy from which state and input deviate; the cost is then that of the deviations.

    Args:
        state: signal that holds r_k.
        input: signal that holds f_k.
        final: r_N, from which the final state deviates, (n,).
    """

    state: str
    input: str
    final: Array
