"""A reference to be tracked, and what a policy that tracks one tells the loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, frozen
from taciturn.errors import ProblemError
from taciturn.model.plant import Plant

FOLLOWS = 1e-6  # of the largest state: how far a written reference may miss the plant's own steps


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

    def of(self, plant: Plant, horizon: int) -> Reference:
        """Return the reference as the plant's own motion: the inputs as they are, the states exactly those they cause.

        Raises:
            ProblemError: sizes or length differ, or the states are not those that the inputs cause.
        """
        for name, found, wanted in (
            ("inputs", self.inputs.shape, (horizon, plant.inputs)),
            ("states", self.states.shape, (horizon + 1, plant.states)),
        ):
            if found != wanted:
                raise ProblemError(
                    f"reference.{name} has shape {found}; expected {wanted}: the horizon and the sizes of the plant"
                )
        exact = [self.states[0]]
        for feedforward in self.inputs:
            exact.append(plant.A @ exact[-1] + plant.B @ feedforward)
        miss = np.abs(np.array(exact) - self.states).max(axis=1)
        worst = int(np.argmax(miss))
        if not miss[worst] <= FOLLOWS * max(float(np.abs(self.states).max()), 1e-300):
            raise ProblemError(
                f"reference.states misses by {miss[worst]:.3g} at step {worst} what reference.inputs cause; "
                "expected states with r⁺ = A r + B f: compute the inputs from the states, or the states from the inputs"
            )
        return Reference(frozen(np.array(exact)), self.inputs)


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
