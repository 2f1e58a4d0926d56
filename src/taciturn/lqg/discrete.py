"""Discrete-time control problem of a policy: a discrete plant unchanged, or a continuous plant sampled exactly."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from taciturn._arrays import Array, ArrayLike, Bits, frozen, instance, number, semidefinite
from taciturn._cycles import closure
from taciturn._display import Displayed
from taciturn._exact_modes import Limit
from taciturn._modes import eigenvalues, pace, radius
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg._followed import Followed, followed
from taciturn.lqg.feedthrough import expect_digits, registers_from, with_registers
from taciturn.lqg.intervals import Exact
from taciturn.lqg.kalman import Filter, filter_sampled
from taciturn.lqg.quadratic import Quadratic
from taciturn.lqg.riccati import Regulator, regulate_deviations, regulate_sampled
from taciturn.lqg.sampling import sample, sample_prediction
from taciturn.lqg.structure import worth_of
from taciturn.model.cost import Cost
from taciturn.model.coverage import SIMULATED
from taciturn.model.display import FED, about, counted_from
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.plant import ContinuousPlant, JumpNoise, Plant, Prediction, derived_plant
from taciturn.model.saturation import limit_entries

INSTANTS = (
    "the disturbances change the input that they need between samples, which a held input cannot follow, and they grow "
    "without limit: the integral of the cost has no average. All costs, and the guarantee, are those of the deviations "
    "at the sampling instants; nothing is claimed for the integral, or for another period"
)
SHORTEST = 1e-100  # period whose inverse and squares are numbers
HIDDEN = "source", "rest", "instants", "exact", "deviations"
LEAST = 1e-10  # movement within a period, in units of the state, that leaves digits of what a plant does in a step
GROWTH = 1e8  # largest growth of an unstable mode within a period: half of the digits of a double


@dataclass(frozen=True, eq=False, repr=False)
class Discrete(Displayed):
    """A discrete-time control problem: the plant's dynamics from step to step, and the cost per step.

    Args:
        plant: the plant from step to step.
        Q, R, N: weights of one step; a sampled R may be only semidefinite.
        cost: horizon, terminal weight and discount, and the weights as the user gave them.
        tick: seconds per step; 1 where time is counted in steps.
        noise_cost: inter-sample noise cost per step, which no policy can change.
        jumps: Poisson jumps as the noise of a step, or None; plant.W is the covariance of the noise in both cases.
        sampled: whether the plant is continuous in time, so that rates are per second.
        prediction: the model of an actuator that predicts, or None; the input of ``plant`` is the state of this model.
        source: the plant before it was sampled.
        rest: the state and input from which the cost counts deviations; None for zero.
        instants: whether the cost is that of the deviations at the sampling instants, because disturbances let the
            integral of the cost grow without limit; otherwise it is the integral, or a sum over the steps.
        exact: the sampled problem to any precision; None if its doubles are exact. With disturbances and set-points,
            it only has A, B and W.
        deviations: with disturbances and set-points, the deviations by construction, whose problem has the cost.
    """

    plant: Plant
    Q: Array
    R: Array
    N: Array
    cost: Cost
    tick: float
    noise_cost: float
    jumps: JumpNoise | None = None
    sampled: bool = False
    prediction: Prediction | None = None
    source: Plant | ContinuousPlant | None = None
    rest: OperatingPoint | None = None
    instants: bool = False
    exact: Exact | None = None
    deviations: Followed | None = None

    def regulator(self) -> Regulator:
        """Return the optimal regulator of an average or discounted cost.

        Raises:
            UnstableError: no stabilising gain exists, as :func:`~taciturn.lqg.riccati.regulate` says.
        """
        if self.deviations is not None:
            return regulate_deviations(self.deviations)
        return regulate_sampled(self.exact, *self.quadratic, self.cost.discount)

    def filter(self) -> Filter:
        """Return the steady Kalman filter; it takes over set-points that change.

        Raises:
            UnstableError: no stable filter exists, as :func:`~taciturn.lqg.kalman.steady_filter` says.
            ProblemError: rounding of the direct feedthrough hides what an output tells.
        """
        p = self.plant
        found = filter_sampled(self.exact, p.A, p.C, p.W, p.V, p.set_points)
        if p.registers:
            with suppress(UnstableError):  # over a horizon there need be no steady regulator
                expect_digits(self, self.regulator().L, found)
        return found

    def summary(self) -> Mapping[str, object]:
        """Return the fields by name, with the number of inputs of the plant before it was sampled."""
        shown = {**super().summary(), "plant": self.short()}
        return {name: value for name, value in shown.items() if name not in HIDDEN}

    def short(self) -> str:
        """Return the numbers of states, inputs and outputs of the plant, as text."""
        return self.plant.short(None if self.prediction is None else len(self.prediction.L))

    @property
    def in_units(self) -> Discrete:
        """The problem in the units of the plant; its cost counts from the operating point."""
        return replace(self, plant=about(self.plant, None), rest=self.plant.operating_point)

    @cached_property
    def moving(self) -> Bits:
        """Mask of the states, (n,), without uncontrollable, marginally stable states that do not affect the cost.

        States that the excluded ones affect are excluded too. An average cost does not depend on the excluded states,
        and their variance may grow without bound.
        """
        return ~closure(self.lasting, np.asarray(self.plant.A != 0, dtype=np.bool_))

    @cached_property
    def registers(self) -> Bits:
        """Mask of the registers, (n,), which hold inputs of the step before and are no states of the user's plant."""
        found = np.zeros(self.plant.states, dtype=np.bool_)
        first = registers_from(self)
        found[first : first + len(self.plant.registers)] = True
        return found

    @property
    def decaying(self) -> Bits:
        """Mask of the states, (n,), that decay under an optimal gain."""
        return ~self.lasting if self.source is not None and self.source.exosystem is not None else self.moving

    def weight(self, given: ArrayLike | None = None) -> Array:
        """Return a weight of the states of the user's plant, (n, n): the identity, or a given one, without registers.

        Raises:
            ProblemError: the weight has another size, or is not positive semidefinite.
        """
        size, own = self.plant.stated, ~self.registers
        found = np.zeros((len(own), len(own)))
        found[np.ix_(own, own)] = (
            np.eye(size) if given is None else semidefinite("weight", given, size, "(states, states)")
        )
        return frozen(found)

    @cached_property
    def lasting(self) -> Bits:
        """Mask of the states, (n,), that do not decay, that no input moves, and that leave the cost finite.

        These are states that do not affect the cost, and disturbances and set-points that an input can follow.
        """
        if self.followed is not None:
            return self.followed.states
        source = self.exact and self.exact.source
        before = source and (source.given, Limit(True, 1.0, source.period))
        return worth_of(self.quadratic, rounded=self.sampled, before=before).resting

    @property
    def quadratic(self) -> Quadratic:
        """The regulator problem of the plant and the weights."""
        return Quadratic(self.plant.A, self.plant.B, self.Q, self.R, self.N)

    @cached_property
    def followed(self) -> Followed | None:
        """The states and inputs at which disturbances and set-points cost nothing, or None if nothing is followed."""
        return followed(self.quadratic)

    def slowest(self, closed: Array) -> float:
        """Return the modulus of the slowest mode of a closed loop, without the modes of the lasting states."""
        keep = self.decaying
        return radius(closed[np.ix_(keep, keep)])

    def among(self, states: Bits) -> Discrete:
        """Return the problem restricted to some of the states, which the others do not affect."""
        p, place = self.plant, np.ix_(states, states)
        plant = derived_plant(
            p.A[place], p.B[states], p.W[place], p.C[:, states], p.V, p.dt, p.mean[states], p.covariance[place],
            p.input_limit, input_rate=p.input_rate,
        )  # fmt: skip
        point = p.operating_point
        plant = counted_from(plant, None if point is None else OperatingPoint(point.x[states], point.u), p)
        return replace(self, plant=plant, Q=self.Q[place], N=self.N[states], exact=None, deviations=None)

    @property
    def terminal(self) -> Array | None:
        """The weight of the states after the last step, (n, n), or None; states that were added have none."""
        given = self.cost.terminal
        return None if given is None else np.pad(given, (0, self.plant.states - len(given)))

    @property
    def gaussian(self) -> bool:
        """True if all noise is Gaussian: the plant has no jumps, and no set-points that change."""
        return self.jumps is None and self.plant.changes is None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on what the cost counts, if it is not the integral of the stage cost, and on a direct feedthrough."""
        fed = self.source is not None and self.source.D is not None
        return ((INSTANTS,) if self.instants else ()) + (
            (f"the plant has a direct feedthrough D: {FED}",) if fed else ()
        )

    @property
    def ticks(self) -> float:
        """Total weight of the steps in the cost: 1 for an average, N for a horizon, 1/(1−α) for a discounted sum."""
        if self.cost.horizon is not None:
            return float(self.cost.horizon)
        return 1 / (1 - self.cost.discount) if self.cost.mission else 1.0

    @property
    def unit(self) -> float:
        """Seconds to which an average cost refers, by which a cost per step is divided; 1 for a total."""
        return 1.0 if self.cost.mission else self.tick

    def per_unit(self, cost: float) -> float:
        """Convert a cost per step, or a total, to the user's units, and add the inter-sample noise cost."""
        return (cost + self.noise_cost * self.ticks) / self.unit


def discretise(
    plant: Plant | ContinuousPlant, cost: Cost, period: float | None, prediction: Prediction | None = None
) -> Discrete:
    """Return the discrete-time control problem of a plant and a cost; a continuous plant is sampled exactly.

    Args:
        plant: a discrete plant, or a continuous plant, which is sampled exactly.
        cost: cost per step of a discrete plant, or per second of a continuous one.
        period: seconds between steps; only for a continuous plant.
        prediction: model that the actuator runs between steps; the input is then the state of this model.

    Returns:
        The discrete plant with the weights of one step.

    Raises:
        ProblemError: an argument is not a plant or a cost, their sizes differ, the period is missing, not allowed, or
            too long for an unstable mode, or a clipped input changes between steps.

    Source: vanloan1978
    """
    instance("plant", plant, Plant, ContinuousPlant)
    instance("cost", cost, Cost)
    SIMULATED.check(plant, cost)
    if plant.D is not None or plant.exosystem is not None:
        return _with_added_states(plant, cost, period, prediction)
    if cost.Q.shape[0] != plant.states or cost.R.shape[0] != plant.inputs:
        raise ProblemError(
            f"Q has the shape {cost.Q.shape} and R the shape {cost.R.shape}; expected "
            f"{(plant.states, plant.states)} and {(plant.inputs, plant.inputs)}, for the states and inputs of the plant"
        )
    if isinstance(plant, Plant):
        if period is not None:
            raise ProblemError(
                f"period is {period:g}, and the plant is discrete in time; expected no period, as the steps are the "
                "sampling instants (define a continuous plant without dt, which is plant.dt in a file)"
            )
        return Discrete(plant, cost.Q, cost.R, cost.N, cost, 1.0, 0.0, source=plant)
    if period is None:
        raise ProblemError(
            "period is missing; expected the sampling period in seconds, as the plant is continuous in time "
            "(give plant.dt if A and B describe one step)"
        )
    number("period", period, 0.0)
    moved = pace(plant.A) * period
    if period < SHORTEST or 0 < moved < LEAST:
        least = max(SHORTEST, LEAST / pace(plant.A) if moved else 0.0)
        raise ProblemError(
            f"period is {period:g}, and rounding hides what the plant does in such a step; expected at least "
            f"{least:.1g}"
        )
    rate = float(eigenvalues(plant.A).real.max())
    if rate * period > np.log(GROWTH):
        raise ProblemError(
            f"period is {period:g}, within which the fastest mode of the plant grows by e^{rate * period:.4g}; "
            f"expected growth by at most {GROWTH:.0e}, so a period below about {np.log(GROWTH) / rate:.3g}"
        )
    if prediction is None:
        sampled = sample(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W, period)
    else:
        limit, rate = plant.input_limit, plant.input_rate
        given = {
            "input_limit": None if limit is None else limit_entries(limit),
            "input_rate": None if rate is None else rate.tolist(),
        }
        for name in (name for name, value in given.items() if value is not None):
            raise ProblemError(
                f"{name} is {given[name]}, but the input changes between steps, and a limited input that changes has "
                f"no exact discretisation; expected no {name}, or a policy that holds its input"
            )
        sampled = sample_prediction(
            plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W, prediction.L, period, prediction.dynamics
        )
    try:
        semidefinite("W", sampled.W, plant.states)
    except ProblemError:
        raise ProblemError(
            f"the noise of a period is not semidefinite up to rounding: the modes of A reach {pace(plant.A):.1e} per "
            "second, and the rounding of A and W next to them hides the noise of slower states; expected modes that "
            "differ less, such as an E that is not nearly singular"
        ) from None
    C, V = (None, None) if plant.full_state else (plant.C, plant.V)
    rate = None if plant.input_rate is None else period * plant.input_rate
    discrete = derived_plant(
        sampled.A, sampled.B, sampled.W, C, V, period, plant.mean, plant.covariance, plant.input_limit, input_rate=rate
    )
    point = plant.operating_point
    if point is not None and prediction is not None:  # the input is the state of the actuator's model
        point = OperatingPoint(point.x, point.x)
    discrete = counted_from(discrete, point, plant)
    jumps = None if plant.jumps is None else JumpNoise(plant.A, plant.jumps, period)
    return Discrete(
        discrete,
        sampled.Q,
        sampled.R,
        sampled.N,
        cost,
        period,
        sampled.noise_cost,
        jumps,
        True,
        prediction,
        plant,
        exact=sampled.exact,
    )


def _with_added_states(
    plant: Plant | ContinuousPlant, cost: Cost, period: float | None, prediction: Prediction | None
) -> Discrete:
    """Return the problem of a plant with registers of the inputs that its outputs show, or with its disturbances."""
    from taciturn.lqg.regulation import joined

    jumps = isinstance(plant, ContinuousPlant) and plant.jumps is not None
    part, given, refused = "D", "the outputs have a direct feedthrough D", dict[str, bool]()
    if plant.D is None:
        part, given = "exosystem", "disturbances or set-points are given"
        refused = {
            "the cost has a horizon; expected an average cost": cost.horizon is not None,
            "the cost is discounted; expected an average cost": cost.discount < 1,
            "the full state is measured without noise; expected C and V": plant.full_state,
        }
    refused["the actuator predicts between sampling instants; expected a held input"] = prediction is not None
    refused["the plant has jumps; expected Gaussian noise W"] = jumps
    for got in (got for got, holds in refused.items() if holds):
        raise ProblemError(f"{given}, and {got}")
    alone = copy(plant)
    object.__setattr__(alone, part, None)
    found = discretise(alone, cost, period)
    if plant.D is not None:
        return with_registers(found, plant)
    assert plant.exosystem is not None, "states are added for a part of the plant"
    return joined(found, plant, plant.exosystem)
