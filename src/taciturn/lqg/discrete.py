"""The discrete-time problem that a policy sees: a discrete plant as it is, a continuous one sampled exactly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taciturn._arrays import Array, Bits, instance, number
from taciturn._modes import eigenvalues, radius
from taciturn.errors import ProblemError
from taciturn.lqg import _dare
from taciturn.lqg._worth import closure
from taciturn.lqg.sampling import sample, sample_prediction
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, JumpNoise, Plant, Prediction

GROWTH = 1e8  # of an unstable mode within a period: half of the digits of a double


@dataclass(frozen=True, eq=False)
class Discrete:
    """A discrete plant and its cost per tick.

    Args:
        plant: the plant from tick to tick.
        Q, R, N: weights of one tick; a sampled R may be only semidefinite.
        cost: horizon, terminal weight and discount, and the weights as the user gave them.
        tick: seconds per tick; 1 where time is counted in steps.
        noise_cost: inter-sample noise cost per tick, which no policy can change.
        jumps: where the noise of a tick is that of Poisson jumps; plant.W is its covariance all the same.
    """

    plant: Plant
    Q: Array
    R: Array
    N: Array
    cost: Cost
    tick: float
    noise_cost: float
    jumps: JumpNoise | None = None

    @cached_property
    def moving(self) -> Bits:
        """The states but for those on the edge of stability that neither cost nor control touches, and what these move.

        (n,). An average cost says nothing of the others, whose variance may grow without end.
        """
        A = self.plant.A
        resting = _dare.worth(A, self.plant.B, self.Q, self.R, self.N).resting
        return ~closure(resting, np.asarray(A != 0, dtype=np.bool_))

    def slowest(self, closed: Array) -> float:
        """Return the modulus of the slowest mode of a closed loop, (n, n), but for states that do not move."""
        return radius(closed[np.ix_(self.moving, self.moving)])

    def per_unit(self, cost: float) -> float:
        """Return a cost per tick in the units of the cost: inter-sample noise added, per second for sampled plants."""
        return (cost + self.noise_cost) / self.tick


def discretise(
    plant: Plant | ContinuousPlant, cost: Cost, period: float | None, prediction: Prediction | None = None
) -> Discrete:
    """Return the problem from tick to tick.

    Args:
        plant: discrete, or continuous and then sampled exactly at ``period``.
        cost: per step, or per second.
        period: seconds between ticks; only with a continuous plant.
        prediction: of an actuator that runs a model between ticks; then the input is the model's state.

    Returns:
        The discrete plant with the weights of one tick.

    Raises:
        ProblemError: no plant or no cost, their sizes differ, period missing, out of place or too long for an unstable
            mode, or a clipped input that changes between ticks.

    Source: vanloan1978
    """
    instance("plant", plant, Plant, ContinuousPlant)
    instance("cost", cost, Cost)
    if cost.Q.shape[0] != plant.states or cost.R.shape[0] != plant.inputs:
        raise ProblemError(
            f"Q is {cost.Q.shape} and R is {cost.R.shape}; expected {(plant.states, plant.states)} and "
            f"{(plant.inputs, plant.inputs)} = the states and inputs of the plant"
        )
    if isinstance(plant, Plant):
        if period is not None:
            raise ProblemError(
                f"period is {period:g} with a discrete-time plant; expected none: its ticks are its steps "
                "(if it is continuous, give it without dt, which is plant.dt in a file)"
            )
        return Discrete(plant, cost.Q, cost.R, cost.N, cost, 1.0, 0.0)
    if period is None:
        raise ProblemError(
            "period is missing; expected the seconds between ticks, as the plant is continuous in time "
            "(give plant.dt if A and B are those of a step)"
        )
    number("period", period, 0.0)
    rate = float(eigenvalues(plant.A).real.max())
    if rate * period > np.log(GROWTH):
        raise ProblemError(
            f"period is {period:g}, within which the plant's fastest mode grows by e^{rate * period:.4g}; expected at "
            f"most {GROWTH:.0e}, so a period below about {np.log(GROWTH) / rate:.3g}"
        )
    if prediction is None:
        sampled = sample(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W, period)
    else:
        if plant.input_limit is not None:
            raise ProblemError(
                f"input_limit is {plant.input_limit.tolist()}, and the input changes between ticks, where nothing "
                "exact is known of a clipped one; expected no input_limit, or a policy that holds its input"
            )
        sampled = sample_prediction(
            plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W, prediction.L, period, prediction.dynamics
        )
    C, V = (None, None) if plant.full_state else (plant.C, plant.V)
    discrete = Plant(sampled.A, sampled.B, sampled.W, C, V, period, plant.mean, plant.covariance, plant.input_limit)
    jumps = None if plant.jumps is None else JumpNoise(plant.A, plant.jumps, period)
    return Discrete(discrete, sampled.Q, sampled.R, sampled.N, cost, period, sampled.noise_cost, jumps)
