"""Reference trajectories, and the signals of a policy that tracks a reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, ArrayLike, array
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.coverage import SIMULATED
from taciturn.model.plant import Plant

FOLLOWS = 1e-9  # tolerance of r⁺ = A r + B f, relative to the largest state


@dataclass(frozen=True, eq=False, repr=False)
class Reference(Displayed):
    """A reference trajectory of states r_0 … r_N and inputs f_0 … f_{N−1}, stored at both ends of the network.

    Args:
        states: reference states r_k, (steps + 1, n), in the units of the plant.
        inputs: feedforward inputs f_k, (steps, m), with r_{k+1} = A r_k + B f_k in deviations from the operating point.

    Raises:
        ProblemError: if the lengths of states and inputs do not match.
    """

    states: Array
    inputs: Array

    def __init__(self, states: ArrayLike, inputs: ArrayLike) -> None:
        """Validate and store the arguments."""
        object.__setattr__(self, "inputs", array("reference.inputs", inputs, (None, None), "(steps, inputs)"))
        shape, meaning = (len(self.inputs) + 1, None), "(steps + 1, states)"
        object.__setattr__(self, "states", array("reference.states", states, shape, meaning))

    def relative_to(self, plant: Plant) -> Reference:
        """Return the trajectory of the deviations from the operating point of a plant."""
        point = plant.operating_point
        fits = (self.states.shape[1], self.inputs.shape[1]) == (plant.states, plant.inputs)  # otherwise check raises
        return self if point is None or not fits else Reference(self.states - point.x, self.inputs - point.u)

    def check(self, plant: Plant, horizon: int) -> None:
        """Check that the reference satisfies r_{k+1} = A r_k + B f_k of the plant over ``horizon`` steps.

        Raises:
            ProblemError: if a size or the length differs, or a state does not follow from the step before.
        """
        SIMULATED.check(self)
        for name, found, wanted in (
            ("inputs", self.inputs.shape, (horizon, plant.inputs)),
            ("states", self.states.shape, (horizon + 1, plant.states)),
        ):
            if found != wanted:
                raise ProblemError(
                    f"reference.{name} has shape {found}; expected {wanted}, from the horizon and the dimensions of "
                    "the plant"
                )
        caused, pushes = self.states[:-1] @ plant.A.T, self.inputs @ plant.B.T
        miss = np.abs(caused + pushes - self.states[1:]).max(axis=1)
        allowed = FOLLOWS * max(float(np.abs(part).max()) for part in (self.states, caused, pushes))
        if (miss > allowed).any():
            step = int(np.argmax(miss > allowed))
            raise ProblemError(
                f"reference.states differs by {miss[step]:.3g} at step {step + 1} from A r + B f of step {step}; "
                f"expected r⁺ = A r + B f within {allowed:.3g}: compute the states from the inputs with all digits"
            )


@dataclass(frozen=True, eq=False, repr=False)
class Tracking(Displayed):
    """The reference signals of a policy; the cost penalises the deviations of state and input from these signals.

    Args:
        state: name of the signal with the reference state r_k.
        input: name of the signal with the feedforward input f_k.
        final: final reference state r_N, (n,).
    """

    state: str
    input: str
    final: Array
