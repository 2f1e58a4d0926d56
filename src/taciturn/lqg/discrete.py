"""The discrete-time control problem of a design: the sampled plant, and the cost per step.

A discrete plant is taken as it is. A continuous plant is sampled exactly: ``sample`` integrates dynamics, noise and
cost over a period, with the input held. Two parts of a plant become states that no design, filter, program or node
treats unlike others: registers of inputs, after the states x of the plant, and the signals d of its exosystem, last.

Registers. A sensor takes its sample before the input changes, y_k = C x_k + D û_{k−1} + v_k, with the input û that the
plant applied after losses and limits. Each input that an output shows gets a register z⁺ = û without cost and noise,

    x⁺ = A x + B û + w,   z⁺ = û,   y = [C, D] (x, z) + v,

which contains the input of the operating point at the start.

Signals. With X and U of the regulator equations (``followed``), the cost counts the deviations ξ = x − Xd and
μ = u − Ud. Between the samples of a continuous plant, d moves on and the input is held, so μ moves too:

    dξ = (Aξ + Bμ) dt + w − X w_d,   dμ = −U S d dt − U w_d,   dd = S d dt + w_d,

and the cost of a period is the integral of the stage cost over this path. If a signal that does not decay changes Ud
between samples (U S d ≠ 0: a sinusoid, or a ramp that the input must follow), its ripple costs d'(…)d, which grows
without limit, so the integral has no average. The cost is then that of the deviations at the sampling instants,
Σ [ξ; μ]'M_d[ξ; μ], with X and U of the sampled plant and without noise between samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from taciturn._arrays import Array, ArrayLike, Bits, block_diagonal, frozen, instance, number, semidefinite, symmetrised
from taciturn._display import Displayed
from taciturn._modes import (
    SCATTER,
    closure,
    eigenvalues,
    invariant,
    pace,
    radius,
    summed,
    unit_columns,
)
from taciturn._rational import Limit, unmoved
from taciturn._text import number_of
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.cache import MOST_PROBLEMS, remembered
from taciturn.lqg.enclosures import UNIT
from taciturn.lqg.followed import Followed, followed, regulator_equations
from taciturn.lqg.kalman import Filter, filter_sampled
from taciturn.lqg.quadratic import Quadratic, placed, worth_of
from taciturn.lqg.registers import (
    Extended,
    Pieces,
    cuts_of,
    extend,
    in_deviations,
    registered,
    registers_of,
    rest_with,
    with_inputs_before,
)
from taciturn.lqg.riccati import Regulator, regulate_deviations, regulate_sampled
from taciturn.lqg.sampling import Exact, Sampled, Source, sample, sample_prediction
from taciturn.model.cost import Cost
from taciturn.model.coverage import SIMULATED
from taciturn.model.disturbance import DisturbedDynamics
from taciturn.model.load import SampledLoads
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.plant import (
    FED,
    ContinuousPlant,
    JumpNoise,
    Plant,
    Prediction,
    about,
    altered,
    counted_from,
    derived_plant,
)
from taciturn.model.saturation import limit_entries
from taciturn.model.signals import Exosystem

BLUR = 1e-3  # rounding of an output, relative to the deviation of the innovation, that changes no sixth digit of a cost
INSTANTS = (
    "the disturbances change the input that they need between samples, which a held input cannot follow, and they grow "
    "without limit: the integral of the cost has no average. All costs, and the guarantee, are those of the deviations "
    "at the sampling instants; nothing is claimed for the integral, or for another period"
)
LASTING = (
    "long-run costs and rates are those after the last change of the loads in [[disturbance]]; simulated paths and "
    "networks begin before it"
)
SHORTEST = 1e-100  # period whose inverse and squares are numbers
HIDDEN = "source", "rest", "instants", "exact", "deviations", "loads", "pieces"
LEAST = 1e-10  # movement within a period, in units of the state, that leaves digits of what a plant does in a step
GROWTH = 1e8  # largest growth of an unstable mode within a period: half of the digits of a double


@dataclass(frozen=True, eq=False, repr=False)
class Discrete(Displayed):
    """A discrete-time control problem: how the plant moves from step to step, and the cost per step.

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
        loads: the loads of a simulated plant; None in a design.
        pieces: the same problem with another input in each piece of a period, if packets arrive within periods.
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
    loads: SampledLoads | None = None
    pieces: Pieces | None = None

    def regulator(self) -> Regulator:
        """Compute the optimal regulator for an average cost or a discounted cost.

        Raises:
            UnstableError: no stabilising gain exists, as :func:`~taciturn.lqg.riccati.regulate` says.
        """
        if self.deviations is not None:
            return regulate_deviations(self.deviations)
        return regulate_sampled(self.exact, *self.quadratic, self.cost.discount)

    def filter(self) -> Filter:
        """Compute the steady-state Kalman filter. It takes set-points that change as they are, because they are known
        exactly.

        Raises:
            UnstableError: no stable filter exists, as :func:`~taciturn.lqg.kalman.steady_filter` says.
            ProblemError: rounding of the direct feedthrough hides what an output tells.
        """
        p = self.plant
        found = filter_sampled(self.exact, p.A, p.C, p.W, p.V, p.set_points)
        if self.source is not None and self.source.D is not None:
            with suppress(UnstableError):  # over a horizon there need be no steady regulator
                expect_digits(self, self.regulator().L, found)
        return found

    def summary(self) -> Mapping[str, object]:
        """Return the fields to display, by name. The number of states is that before sampling."""
        shown = {**super().summary(), "plant": self.short()}
        return {name: value for name, value in shown.items() if name not in HIDDEN}

    def short(self) -> str:
        """Describe the plant by its numbers of states, inputs and outputs."""
        return self.plant.short(None if self.prediction is None else len(self.prediction.L))

    @property
    def in_units(self) -> Discrete:
        """The problem in the plant's own units. Its cost weights the deviations from the operating point."""
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
        """Mask, (n,), of the states that are registers. A register stores an input or an output of an earlier step."""
        found = np.zeros(self.plant.states, dtype=np.bool_)
        first = registers_from(self)
        found[first : first + len(self.plant.registers) + len(self.plant.stored)] = True
        return found

    @property
    def decaying(self) -> Bits:
        """Mask, (n,), of the states that decay if an optimal gain controls the plant."""
        return ~self.lasting if self.source is not None and self.source.exosystem is not None else self.moving

    def weight(self, given: ArrayLike | None = None) -> Array:
        """Extend a weighting matrix of the user's states (default: identity) to (n, n), with zeros for the registers.

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
        """Mask, (n,), of states that no input affects and that do not decay, but for which the cost is finite.

        These are states that do not affect the cost, and disturbances and set-points that an input can follow.
        """
        if self.followed is not None:
            return self.followed.states
        source = self.exact and self.exact.source
        before = source and (source.given, Limit(True, 1.0, source.period))
        return worth_of(self.quadratic, rounded=self.sampled, before=before).resting

    @property
    def quadratic(self) -> Quadratic:
        """The matrices of the plant and the weights of the cost, as a linear-quadratic regulator problem."""
        return Quadratic(self.plant.A, self.plant.B, self.Q, self.R, self.N)

    @cached_property
    def followed(self) -> Followed | None:
        """States and inputs at which disturbances and set-points cost nothing; None if there are none."""
        return followed(self.quadratic)

    def slowest(self, closed: Array) -> float:
        """Return the largest modulus of a closed-loop mode, apart from the modes of the ``lasting`` states."""
        keep = self.decaying
        return radius(closed[np.ix_(keep, keep)])

    def among(self, states: Bits) -> Discrete:
        """Restrict the problem to a subset of the states. The remaining states must not depend on the others."""
        p, place = self.plant, np.ix_(states, states)
        plant = derived_plant(
            p.A[place], p.B[states], p.W[place], p.C[:, states], p.V, p.dt, p.mean[states], p.covariance[place],
            p.input_limit, input_rate=p.input_rate,
        )  # fmt: skip
        plant = counted_from(plant, p, lambda at: OperatingPoint(at.x[states], at.u))
        return replace(self, plant=plant, Q=self.Q[place], N=self.N[states], exact=None, deviations=None)

    @property
    def terminal(self) -> Array | None:
        """Weight of the final state, (n, n), with zeros for states that the design added; None if there is none."""
        given = self.cost.terminal
        return None if given is None else np.pad(given, (0, self.plant.states - len(given)))

    @property
    def gaussian(self) -> bool:
        """True if all noise is Gaussian: the plant has no jumps, and no set-points that change."""
        return self.jumps is None and self.plant.changes is None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notes on loads, a direct feedthrough, and a cost that is not the integral of the stage cost."""
        changing = self.loads is not None and not self.cost.mission and len(self.loads.table) > 1
        fed = self.source is not None and self.source.D is not None
        return (
            *((INSTANTS,) if self.instants else ()),
            *((f"the plant has a direct feedthrough D: {FED}",) if fed else ()),
            *((LASTING,) if changing else ()),
        )

    @property
    def ticks(self) -> float:
        """Sum of the weights of all steps in the cost: 1 (average), N (horizon) or 1/(1−α) (discounted sum)."""
        if self.cost.horizon is not None:
            return float(self.cost.horizon)
        return 1 / (1 - self.cost.discount) if self.cost.mission else 1.0

    @property
    def unit(self) -> float:
        """Seconds per step if the cost is an average, by which the cost per step is divided; 1 for a total."""
        return 1.0 if self.cost.mission else self.tick

    def per_unit(self, cost: float) -> float:
        """Convert a cost per step, or a total, to the user's units, including the inter-sample noise cost."""
        return (cost + self.noise_cost * self.ticks) / self.unit


def discretise(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    prediction: Prediction | None = None,
    cuts: tuple[float, ...] = (),
) -> Discrete:
    """Convert a plant and a cost to a discrete-time control problem. A continuous-time plant is sampled exactly.

    Args:
        plant: a discrete plant, or a continuous plant, which is sampled exactly.
        cost: cost per step of a discrete plant, or per second of a continuous one.
        period: seconds between steps; only for a continuous plant.
        prediction: model that the actuator runs between steps; the input is then the state of this model.
        cuts: parts of a period, in (0, 1), at which packets may arrive and change an input (``Discrete.pieces``).

    Returns:
        The discrete plant with the weights of one step.

    Raises:
        ProblemError: an argument is not a plant or a cost, their sizes differ, the period is missing, not allowed, or
            too long for an unstable mode, or a clipped input changes between steps.

    Source: vanloan1978
    """
    instance("plant", plant, Plant, ContinuousPlant)
    instance("cost", cost, Cost)
    plant = altered(plant, {"loads": ()}) if plant.loads else plant  # designs do not know them
    compute = _discretise if isinstance(plant, Plant) and plant.function is not None else _of_data
    found = compute(plant, cost, period, prediction)
    return replace(found, pieces=_pieces(found, plant, cost, cuts)) if cuts else found


def _discretise(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    prediction: Prediction | None,
) -> Discrete:
    """Return the discrete-time control problem of checked data."""
    SIMULATED.check(plant, cost)
    if plant.D is not None or plant.exosystem is not None or plant.transport is not None:
        return _with_added_states(plant, cost, period, prediction)
    return _sampled(plant, cost, period, prediction, (0.0,))


def _sampled(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    prediction: Prediction | None,
    cuts: tuple[float, ...],
) -> Discrete:
    """Return the problem of a plant without further states. Its inputs are those of each piece of a period."""
    if cost.Q.shape[0] != plant.states or cost.R.shape[0] != plant.inputs:
        raise ProblemError(
            f"Q has the shape {cost.Q.shape} and R the shape {cost.R.shape}; expected the shapes "
            f"{(plant.states, plant.states)} and {(plant.inputs, plant.inputs)}, for the states and inputs of the plant"
        )
    if isinstance(plant, Plant):
        if period is not None:
            raise ProblemError(
                f"period is {period:g}, but the plant is discrete in time; expected no period, as the steps are the "
                "sampling instants (for a plant that is continuous in time, omit dt, in a file plant.dt)"
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
            f"period is {period:g}, but in so short a step, rounding hides the motion of the plant; expected a period "
            f"of at least {least:.1g} s"
        )
    rate = float(eigenvalues(plant.A).real.max())
    if rate * period > np.log(GROWTH):
        raise ProblemError(
            f"period is {period:g}, within which the fastest mode of the plant grows by the factor "
            f"e^{rate * period:.4g}; expected a factor of at most {GROWTH:.0e}, so a period below about "
            f"{np.log(GROWTH) / rate:.3g}"
        )
    if prediction is None:
        sampled = sample(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W, period, cuts=cuts)
    else:
        limit, rate = plant.input_limit, plant.input_rate
        given = {
            "input_limit": None if limit is None else limit_entries(limit),
            "input_rate": None if rate is None else rate.tolist(),
        }
        for name in (name for name, value in given.items() if value is not None):
            raise ProblemError(
                f"{name} is {given[name]}, but the input of this policy changes between steps, and a limited input "
                f"that changes has no exact discretisation; expected no {name}, or a policy that holds its input"
            )
        sampled = sample_prediction(
            plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W, prediction.L, period, prediction.dynamics
        )
    try:
        semidefinite("W", sampled.W, plant.states)
    except ProblemError:
        raise ProblemError(
            "the noise covariance over a sampling period is not semidefinite up to rounding: the modes of A reach "
            f"{pace(plant.A):.1e} per second, so rounding of A and W hides the noise of slower states; expected modes "
            "that differ less in speed, for example by an E that is less close to singular"
        ) from None
    C, V = (None, None) if plant.full_state else (plant.C, plant.V)
    limit, rate = plant.input_limit, None if plant.input_rate is None else period * plant.input_rate
    limit, rate = (limit, rate) if len(cuts) == 1 else (None, None)  # of the commands, which are states
    discrete = derived_plant(
        sampled.A, sampled.B, sampled.W, C, V, period, plant.mean, plant.covariance, limit, input_rate=rate
    )
    # an actuator that predicts has the state of its model as its input
    discrete = counted_from(discrete, plant, None if prediction is None else lambda at: OperatingPoint(at.x, at.x))
    jumps = None if plant.jumps is None else JumpNoise(plant.A, plant.jumps, period)
    weights = sampled.Q, sampled.R, sampled.N
    return Discrete(
        discrete, *weights, cost, period, sampled.noise_cost, jumps, True, prediction, plant, exact=sampled.exact
    )


_of_data = remembered(_discretise, MOST_PROBLEMS)


def _with_added_states(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    prediction: Prediction | None,
) -> Discrete:
    """Return the problem of a plant with its disturbances, and with registers of late inputs and of those that its
    outputs show.
    """
    e, late = plant.exosystem, plant.D is not None or plant.transport is not None
    given = [(e is not None, "disturbances or set-points are given")]
    given += [(plant.D is not None, "the outputs have a direct feedthrough D"), (late, "a link delays its packets")]
    added = next(what for holds, what in given if holds)
    jumps = isinstance(plant, ContinuousPlant) and plant.jumps is not None
    refused = {
        "the cost has a horizon; expected an average cost": e is not None and cost.horizon is not None,
        "the cost is discounted; expected an average cost": e is not None and cost.discount < 1,
        "the full state is measured without noise; expected C and V": e is not None and plant.full_state,
        "the actuator predicts between sampling instants; expected a held input": prediction is not None,
        "the plant has jumps; expected Gaussian noise W": jumps,
    }
    for got in (got for got, holds in refused.items() if holds):
        raise ProblemError(f"{added}, and {got}")
    found = _by_pieces(plant, cost, period, _cuts(plant, period))
    return with_registers(found, plant) if late else found


def _by_pieces(plant: Plant | ContinuousPlant, cost: Cost, period: float | None, cuts: tuple[float, ...]) -> Discrete:
    """Return the problem of a plant, without its delays, whose inputs are those that act in each piece of a period."""
    bare = altered(plant, {"D": None, "exosystem": None, "transport": None})
    found = _sampled(bare, cost, period, None, cuts)
    return found if plant.exosystem is None else joined(found, plant, plant.exosystem, cuts)


def _pieces(problem: Discrete, plant: Plant | ContinuousPlant, cost: Cost, cuts: tuple[float, ...]) -> Pieces:
    """Return the problem in which packets may change the inputs at parts of a period."""
    if problem.prediction is not None or problem.jumps is not None:
        what = "the actuator predicts" if problem.prediction is not None else "the plant has jumps"
        raise ProblemError(
            f"{what}, and packets arrive at random within a period; expected delays of whole periods, or a buffer"
        )
    if not problem.sampled:
        raise ProblemError(
            "a link has a delay in seconds, but the plant is discrete in time; expected a whole number of steps, or a "
            "plant that is continuous in time (omit plant.dt)"
        )
    whole = cuts_of(plant, problem.tick, cuts)
    return pieces_of(_by_pieces(plant, cost, problem.tick, whole), plant, whole)


def _cuts(plant: Plant | ContinuousPlant, period: float | None) -> tuple[float, ...]:
    """Return the parts of a period at which the input that acts changes."""
    if plant.transport is None:
        return (0.0,)
    if isinstance(plant, ContinuousPlant):
        return (0.0,) if period is None else cuts_of(plant, number("period", period, 0.0))
    seconds = [wait.seconds for wait in (*plant.transport.inputs, *plant.transport.outputs) if wait.seconds]
    if seconds:
        raise ProblemError(
            f"a link has a delay of {seconds[0]:g} seconds, but the plant is discrete in time; expected a whole number "
            "of steps, or a plant that is continuous in time (omit plant.dt)"
        )
    return (0.0,)


BEYOND = 1e-9  # rounding of an input at its limit
STILL = 1e-9  # relative rate of change of an input that counts as zero


def has_average(plant: Plant | ContinuousPlant, cost: Cost) -> bool:
    """Return whether the integral of the cost has a long-run average if the input is held between samples.

    It has none if a disturbance that does not decay changes the input Ud that it needs between samples. The sums over
    the steps of a discrete plant always have one.
    """
    e = plant.exosystem
    if e is None or isinstance(plant, Plant):
        return True
    return _is_still(_equations(plant, e, cost)[1], e.S)


def _equations(plant: Plant | ContinuousPlant, e: Exosystem, cost: Cost | Discrete) -> tuple[Array, Array]:
    """Return X and U of a plant; in continuous time, they do not depend on the sampling period."""
    weights = np.block([[cost.Q, cost.N], [cost.N.T, cost.R]])
    return regulator_equations(plant.A, plant.B, e.S, e.E, e.outputs, e.F, weights, e.D)


def _is_still(U: Array, S: Array) -> bool:
    """Return whether the modes of d that do not decay leave Ud at rest, so that U S d is zero or decays."""
    seen = invariant(unit_columns(moved_inputs(U, S).T), [S.T])
    rates = eigenvalues(seen.T @ S.T @ seen).real
    return not (rates > -SCATTER * pace(S)).any()


def moved_inputs(U: Array, S: Array) -> Array:
    """Return U S, the movement of the input that d needs, without rounding errors of entries that are zero."""
    moved = U @ S
    return np.where(np.abs(moved) > STILL * (np.abs(U) @ np.abs(S)), moved, 0.0)


def joined(
    base: Discrete, source: Plant | ContinuousPlant, exosystem: Exosystem, cuts: tuple[float, ...] = (0.0,)
) -> Discrete:
    """Extend the state of a problem by an exosystem d. Its cost then weights deviations from targets that d sets."""
    plant, e = base.plant, exosystem
    n, q, m = plant.states, len(e.S), plant.inputs  # with several pieces, m is a multiple of the source's inputs
    A = before = np.block([[source.A, e.E], [np.zeros((q, n)), e.S]])
    W, noise_cost, instants, exact, own = block_diagonal(source.W, e.W), base.noise_cost, False, None, None
    stage = np.block([[base.Q, base.N], [base.N.T, base.R]])
    stage = np.insert(np.insert(stage, [n] * q, 0.0, axis=0), [n] * q, 0.0, axis=1)  # of (ξ, d, μ)
    changes = None if e.changes is None else e.changes.sampled(base.tick)
    given = 0 if changes is None else changes.size  # the controller is given the last states
    if isinstance(source, Plant):
        X, U = _equations(plant, e, base)
    else:
        fastest = float(np.abs(eigenvalues(e.S).imag).max(initial=0.0))
        if fastest * base.tick >= np.pi:
            raise ProblemError(
                f"a disturbance has the frequency {fastest:g} radians per second, which is too high for the sampling "
                f"period {base.tick:g}; expected a frequency below π/period = {np.pi / base.tick:.4g}, or a shorter "
                "period"
            )
        k = source.inputs
        B, none = np.vstack([source.B, np.zeros((q, k))]), np.zeros((n + q, n + q))
        sampled = sample(A, B, none, np.zeros((k, k)), np.zeros((n + q, k)), W, base.tick, cuts=cuts)
        A, W, exact = sampled.A, sampled.W, sampled.exact
        X, U = _equations(source, e, base.cost)
        instants = not _is_still(U, e.S)
        if instants and len(cuts) > 1:
            raise ProblemError(
                "an input acts a part of a period late, and a disturbance changes the input that it needs between "
                "samples; expected delays of whole periods, or a disturbance that is constant between samples"
            )
        if instants:
            X, U = _equations(plant, replace(e, S=A[n:, n:], E=A[:n, n:]), base)
            noise_cost = 0.0
        else:
            within = _within_a_period(source, e, base.cost, X, U, given, base.tick, cuts)
            U = np.tile(U, (len(cuts), 1))
            own = Quadratic(within.A, within.B, within.Q, within.R, within.N), within.exact
            noise_cost = within.noise_cost
            stage = np.block([[within.Q, within.N], [within.N.T, within.R]])
    _expect_reached(source, U, e)
    seen = np.vstack([np.hstack([plant.C, e.G]), np.eye(n + q)[n + q - given :]])
    _expect_shown(before, seen, n, e, source.continuous)
    deviation = np.eye(n + q + m)
    deviation[:n, n : n + q], deviation[n + q :, n : n + q] = -X, -U
    whole = symmetrised(deviation.T @ stage @ deviation)
    own = own or _apart(base, A[n:, n:], e.S)
    deviations = Followed(np.arange(n + q) >= n, deviation[: n + q, : n + q], np.pad(U, ((0, 0), (n, 0))), *own)
    at_rest = _at_point(source, e)
    with_all = derived_plant(
        A, np.vstack([plant.B, np.zeros((q, m))]), W, seen, np.pad(plant.V, (0, given)), plant.dt,
        np.concatenate([plant.mean, e.start]), np.pad(plant.covariance, (0, q)), plant.input_limit,
        plant.function and DisturbedDynamics.of(plant.function, e.E, e.S, at_rest), input_rate=plant.input_rate,
    )  # fmt: skip
    with_all = counted_from(with_all, plant, lambda at: OperatingPoint(np.concatenate([at.x, at_rest]), at.u))
    with_all = altered(with_all, {"changes": changes, "alone": source if isinstance(source, Plant) else None})
    return replace(
        base, plant=with_all, Q=whole[: n + q, : n + q], N=whole[: n + q, n + q :], noise_cost=noise_cost,
        source=source, instants=instants, exact=exact, deviations=deviations,
    )  # fmt: skip


def _at_point(source: Plant | ContinuousPlant, e: Exosystem) -> Array:
    """Return the signals at the operating point, (q,): the constant set-points, which act on nothing but z, are z."""
    point, at_rest = source.operating_point, np.zeros(len(e.S))
    if point is None:
        return at_rest
    moves = e.S if source.continuous else e.S - np.eye(len(e.S))
    free = np.where(np.vstack([e.E, e.G, moves]).any(axis=0), 0.0, e.F)
    z = e.outputs @ point.x + (0.0 if e.D is None else e.D @ point.u)
    return at_rest + np.linalg.lstsq(free, -z, rcond=None)[0] if free.any() else at_rest


def _apart(base: Discrete, S: Array, rates: Array) -> tuple[Quadratic, Exact | None]:
    """Return the problem of a plant next to states with dynamics S that cost nothing and affect no other state."""
    n, none, exact = base.plant.states, np.zeros((len(S), base.plant.inputs)), base.exact
    given = base.quadratic.beside(n, S, none)
    if exact is None:
        return given, None
    before = exact.source
    source = before and Source(before.given.beside(n, rates, none), np.pad(before.W, (0, len(S))), base.tick)
    return given, exact.beside(n, S, none, source)


def _within_a_period(
    plant: ContinuousPlant,
    e: Exosystem,
    cost: Cost,
    X: Array,
    U: Array,
    given: int,
    period: float,
    cuts: tuple[float, ...],
) -> Sampled:
    """Return the problem of the deviations (ξ, d) with the input μ over a period; only its weights and cost are
    used.
    """
    (n, m), q = plant.B.shape, len(e.S)
    rest = np.zeros((q, q))
    moves = np.where(np.arange(q) < q - given, e.W, 0.0)
    moves[q - given :] = 0.0
    noise = np.vstack([-X, np.eye(q), -U])
    W = symmetrised(noise @ moves @ noise.T + block_diagonal(plant.W, np.zeros((q + m, q + m))))
    D = np.hstack([np.zeros((m, n)), -moved_inputs(U, e.S)])
    B, N = (np.vstack([part, np.zeros((q, m))]) for part in (plant.B, cost.N))
    A, Q = block_diagonal(plant.A, e.S), block_diagonal(cost.Q, rest)
    return sample(A, B, Q, cost.R, N, W, period, D, cuts)


def beyond_limits(plant: Plant | ContinuousPlant, needed: Array) -> ProblemError:
    """Return the error for a set-point that needs a larger input than the plant's limits allow."""
    assert plant.input_limit is not None, "only limits can be exceeded"
    rest = np.zeros(len(needed)) if plant.operating_point is None else plant.operating_point.u
    return ProblemError(
        f"the set-point needs the input {(needed + rest).round(4).tolist()}, beyond the input_limit "
        f"{limit_entries(plant.input_limit + rest[:, None])}; expected a set-point within the limits"
    )


def _expect_reached(plant: Plant | ContinuousPlant, U: Array, exosystem: Exosystem) -> None:
    """Raise an error if a set-point, at the start or of a timetable, needs an input beyond its limits."""
    limit, changes, points = plant.input_limit, exosystem.changes, exosystem.start[None]
    if limit is None:
        return
    if changes is not None and changes.known is not None:
        moved = changes.known - changes.known[0]
        points = points + np.pad(moved, ((0, 0), (points.shape[1] - changes.size, 0)))
    for needed in points @ U.T:
        if ((needed < limit[:, 0] - BEYOND) | (needed > limit[:, 1] + BEYOND)).any():
            raise beyond_limits(plant, needed)


def _expect_shown(A: Array, C: Array, states: int, exosystem: Exosystem, continuous: bool) -> None:
    """Raise an error if the outputs show all modes of a plant, but not those of its disturbances."""
    unknown = np.vstack([exosystem.E, exosystem.G, exosystem.W]).any(axis=0)
    keep = np.concatenate([np.ones(states, dtype=np.bool_), unknown])
    plant = np.arange(len(A)) < states
    hidden = (unmoved(A[np.ix_(some, some)].T, C[:, some].T, Limit(continuous), True).lasting for some in (plant, keep))
    if not next(hidden).size and next(hidden).size:
        raise ProblemError(
            f"the disturbances ({number_of(int(unknown.sum()), 'state')}) are not observable from the measured outputs "
            f"({len(exosystem.G)}); expected disturbances with different effects on the outputs, and at most as many "
            "constant disturbances as outputs: remove a disturbance, or add a sensor"
        )


def with_registers(problem: Discrete, source: Plant | ContinuousPlant) -> Discrete:
    """Extend a problem, whose inputs are those that act, by the registers of late inputs and old outputs."""
    n, found, before = source.states, registers_of(source, problem.tick), problem.plant
    takes = found.taking(before.C)
    own, whole = problem.deviations, extend(problem.quadratic, n, found, takes)
    exact = problem.exact and Exact(Extended(problem.exact, n, found, takes))
    if own is not None:
        own = in_deviations(own, n, found, before.A, source.inputs, np.where(own.states, 0.0, takes))
    plant = registered(before, source, found)
    return replace(problem, plant=plant, Q=whole.Q, R=whole.R, N=whole.N, exact=exact, deviations=own, source=source)


def pieces_of(problem: Discrete, source: Plant | ContinuousPlant, cuts: tuple[float, ...]) -> Pieces:
    """Return a problem, whose inputs are those that act, with a command for each piece; registers hold the last one."""
    n, found = source.states, registers_of(source, problem.tick, cuts)
    kept, new = placed(problem.plant.states, n, len(found.S))
    m, q, z = found.P.shape[1], len(cuts), new @ found.Gz.T
    direct = np.zeros((q * m, q * m))
    for piece in range(q):
        rows = slice(piece * m, (piece + 1) * m)
        direct[rows, rows] = found.Gu[rows]
    last = np.hstack([np.zeros((m, (q - 1) * m)), np.eye(m)])
    B, N, R = problem.plant.B, problem.N, problem.R
    return Pieces(
        cuts,
        frozen(kept @ B @ direct + new @ found.P @ last),
        frozen(kept @ N @ direct + z @ R @ direct),
        frozen(direct.T @ R @ direct),
    )


def expect_digits(problem: Discrete, L: Array, steady: Filter) -> None:
    """Raise an error if an output is so large that rounding hides how it depends on the state.

    An estimator computes y − D û, where a double holds each term to 2⁻⁵³ of its size, for the inputs û of the loop
    with every sample. The rounding acts as noise of the measurement; below a thousandth of the deviation of the
    innovation, it changes the cost by less than its stated tolerance of 1e-6.
    """
    plant, keep = problem.plant, problem.decaying
    fed = np.zeros(plant.states, dtype=np.bool_)
    fed[registers_from(problem) : registers_from(problem) + len(plant.registers)] = True
    p, point, place = plant.sensed, plant.operating_point, np.ix_(keep, keep)
    varied = summed((plant.A + plant.B @ L)[place], (steady.prior - steady.posterior)[place])
    if not fed.any() or not np.isfinite(varied).all():  # with a discount, inputs may grow
        return
    size = np.sqrt(np.maximum(np.diag(varied)[fed[keep]], 0.0)) + np.abs(plant.mean[fed])
    if point is not None:
        size += np.abs(point.u[[*plant.registers]])
    rounded = UNIT * np.abs(plant.C[:p, fed]) @ size
    told = np.sqrt(np.maximum(np.diag(steady.innovation)[:p], 0.0))
    worst = int(np.argmax(rounded - BLUR * told))
    if rounded[worst] > BLUR * told[worst] > 0:
        shown = plant.C[worst, fed]
        raise ProblemError(
            f"D has the entry {shown[np.argmax(np.abs(shown) * size)]:.3g}, with which the inputs change output "
            f"{worst + 1} so much that y − D u has a rounding error of {rounded[worst]:.2g} in double precision; "
            f"expected a rounding error of at most {BLUR:g} times {told[worst]:.2g}, the standard deviation of the "
            "innovation: measure this output without the input, or leave it out"
        )


def with_same_start(problem: Discrete, model: Plant) -> Discrete:
    """Set the initial values of a problem's registers of inputs to those of the plant ``model`` of a design."""
    plant, place = problem.plant, registers_from(problem)
    before = np.zeros(plant.inputs)
    for registers, mean in ((plant.registers, plant.mean), (model.registers, model.mean)):
        before[[*registers]] = mean[place : place + len(registers)]
    return replace(problem, plant=with_inputs_before(plant, place, before))


def registers_from(problem: Discrete) -> int:
    """Return the index of the first register among the states of a problem."""
    return problem.plant.stated if problem.source is None else problem.source.states


def point_with(problem: Discrete, model: Plant) -> OperatingPoint | None:
    """Return the operating point of the plant ``model``, for a problem with other registers among its states."""
    point, place, plant = model.operating_point, registers_from(problem), problem.plant
    held = model.registers, model.stored
    if point is None or held == (plant.registers, plant.stored):
        return point
    x = np.delete(point.x, slice(place, place + len(model.registers) + len(model.stored)))
    at = OperatingPoint(x, point.u)
    source = problem.source
    if source is None or not (plant.registers or plant.stored):
        return at
    return rest_with(at, place, registers_of(source, problem.tick), source)
