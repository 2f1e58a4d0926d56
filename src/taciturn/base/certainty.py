"""LQG control with every sample sent, relative to which policies are designed: the controller sends the input L x̂.

In each step, the sensor measures. The controller, at the sensor's place, estimates the state, computes ``command`` =
L x̂ and the ``candidate`` that the actuator applies if nothing is sent, and decides on their difference ``error``. The
packet is transmitted, and the actuator applies ``input``. The controller stores the same input as ``held`` and predicts
the next state. In silence, the actuator keeps its last input (``hold``), or it applies L x̃ with the state x̃ of a model
x̃⁺ = (A + BL) x̃ that starts at the last sent estimate (``model``).

With the error e = û − L x̂ of the applied input and the weight H = R + B'KB, completion of squares gives

    J = J_all + E[e'He],    J_all = tr(QΣ) + tr(K(Σ̃ − Σ)),

where Σ̃ and Σ are the covariances of the filter before and after a measurement. LQG is the base whose value is known:
silence costs e'He, and nothing that is linear in e (``base.value``). ``design_certainty`` computes this base,
``control_steps`` writes its policy steps for any trigger, and ``certainty_policy`` makes them a policy with its theory.

Source: astrom2002, khashooei2017
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal, TypeAlias

import numpy as np

from taciturn._arrays import Array, ArrayLike, block_diagonal, instance
from taciturn._display import Displayed
from taciturn._modes import COST_ERROR, radius
from taciturn.base.filter import CLOCK, DEVIATION, ESTIMATE, HELD, SEND, FilterSteps, estimate_state
from taciturn.base.nominal import Nominal
from taciturn.base.route import BY_PACKETS, Ahead, estimate_to_actuator
from taciturn.errors import ProblemError
from taciturn.lqg.cache import MOST_PROBLEMS
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import Filter, expect_known_start
from taciturn.lqg.periodic import Held
from taciturn.lqg.riccati import Regulator, refuse_uncertain
from taciturn.lqg.stored import Allowance, Apart, Proved, Stored, allowance, filter_loop
from taciturn.model.cost import Cost
from taciturn.model.coverage import GAUSSIAN_THEORY, THEORY
from taciturn.model.network import IDEAL, Network
from taciturn.model.plant import Plant
from taciturn.model.policy import Policy
from taciturn.model.signals import SampledChanges
from taciturn.model.steps import Assign, Decide, Location, Step
from taciturn.model.theory import OPERATIONS, ClosedForm, Guarantee, Identity, Reset, Theory, rounded_up
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger

Actuation: TypeAlias = Literal["hold", "model"]
FASTER = 1e-6  # relative difference of two rates of decay that is no rounding
AT_INSTANTS = "J and J_all at the sampling instants"


@dataclass(frozen=True, eq=False, repr=False)
class CertaintyEquivalentDesign(Displayed):
    """Data for the design of policies that apply u = L x̂: the discrete-time problem, the regulator and the filter."""

    problem: Discrete  # the discrete-time problem
    regulator: Regulator  # cost-to-go K, gain L and weight H of the infinite-horizon regulator
    filter: Filter  # covariances and gain of the steady-state Kalman filter
    estimation: FilterSteps  # policy steps of the filter
    cost_all_time: float  # cost of sending every sample, per step, without the inter-sample noise cost
    settling: float  # time constant of regulator and filter in steps, 1/(1 − |slowest eigenvalue|)
    # γ, the root mean square by which set-points that change at known times add 2e'g to the cost e'He of an error e
    # of the input, in the norm of the inverse of H; 0 for other set-points
    pull: float = 0.0
    # what set-points that change at known times cost per step beyond unrelated changes, because one changes before
    # the transient of the change before has ended
    overlap: float = 0.0
    proved: Proved | None = None  # an enclosure of this cost for the gains as they are stored
    loop: Stored | None = None  # the loop of these gains

    @cached_property
    def allowance(self) -> Allowance | None:
        """By how much the rounding of the gains increases the cost of not sending; None if this is not proved to be
        small.
        """
        return self.allowance_of()

    def allowance_of(self, apart: Apart | None = None) -> Allowance | None:
        """Bound the effect of rounding the gains. With ``apart``, several sensors filter separately, and estimates are
        added.
        """
        if self.proved is None or self.loop is None or self.timed:
            return None
        return allowance(self.loop, self.regulator, self.filter, self.cost_all_time, apart)

    def raised(self, silence: float, allowed: Allowance | None) -> tuple[float, float]:
        """Return the J_all and the factor of the cost of silence with which bounds also hold for rounded gains.

        Without a proof, they are J_all as computed, and 1.
        """
        if self.proved is None or allowed is None:
            return self.cost_all_time, 1.0
        return allowed.raised(self.proved.upper, silence)

    def relative(self, theta: float) -> float | None:
        """Return a proven bound on J if not sending costs at most θ/(1 + θ) of the stage cost; None without a proof."""
        return None if self.proved is None or self.allowance is None else self.allowance.relative(self.proved, theta)

    @property
    def error(self) -> float | None:
        """Proven bound on the error of ``cost_all_time``, in the user's units; None if nothing is proved."""
        return None if self.proved is None else error_per_unit(self.problem, self.proved)

    @property
    def timed(self) -> bool:
        """True if the set-points change at known times. Identities and closed forms of the cost then do not hold."""
        return self.pull > 0

    @property
    def recovery(self) -> float | None:
        """Time constant of regulator and filter apart from slow disturbances; None if there are no slow disturbances.

        A fault of a node does not change the disturbances, which are states of the problem.
        """
        p, source = self.problem, self.problem.source
        if source is None or source.exosystem is None:
            return None
        plant = (p.plant.A + p.plant.B @ self.regulator.L)[: source.states, : source.states]
        slowest = max(radius(plant), self.filter.slowest)
        return 1 / (1 - slowest) if slowest < 1 - (1 + FASTER) / self.settling else None

    @property
    def stability(self) -> str:
        """Which part of the loop is mean-square stable, as text: states and inputs without cost may be unstable."""
        stable = radius(self.problem.plant.A + self.problem.plant.B @ self.regulator.L) < 1
        return "mean-square stable" if stable else "mean-square stable, except for states and inputs that cost nothing"

    @property
    def corrections(self) -> Array:
        """Covariance of the filter's corrections by measurements: prior minus posterior error covariance."""
        return self.filter.gain @ self.filter.innovation @ self.filter.gain.T

    @property
    def estimation_cost(self) -> float:
        """Cost per step, tr(QΣ), that the estimation error adds to the cost of control."""
        return float(np.trace(self.problem.Q @ self.filter.posterior))

    @cached_property
    def held(self) -> Held:
        """The optimal control problem in which the plant's input is held from one send to the next."""
        p = self.problem
        return Held(p.plant.A, p.plant.B, p.Q, p.R, p.N, self.corrections)

    @property
    def square(self) -> Array:
        """Weight L'HL: a further error e of the state estimate increases the cost by e'L'HLe."""
        return self.regulator.L.T @ self.regulator.H @ self.regulator.L

    def reset(self, actuation: Actuation) -> Reset | None:
        """Return the model of the error x̃ − x̂ if each send resets this error to zero; otherwise return None.

        The error is driven by the corrections of the estimate, which are independent between steps if the state is
        measured or all noise is Gaussian.
        """
        problem, L = self.problem, self.regulator.L
        if actuation != "model" or not (problem.plant.full_state or problem.gaussian):
            return None
        return Reset(self.corrections, {DEVIATION: np.eye(len(L.T)), "error": L}, self.square / problem.tick)

    def nominal(self, slower: float = 1.0) -> Nominal:
        """Return the loop that sends every sample, as a reference. ``slower`` multiplies its time constants."""
        recovery = None if self.recovery is None else slower * self.recovery
        settling, innovations = slower * self.settling, self.estimation.innovations
        return Nominal(self.problem, self.cost_all_time, settling, self.error, recovery, innovations)

    def completed_square(self) -> Identity:
        """Return the identity J = J_all + E[(1−σ)(û − Lx̂)'H(û − Lx̂)] for the cost, where σ = 1 if a packet is
        sent.
        """
        problem = self.problem
        return completed_square(problem.per_unit(self.cost_all_time), self.regulator.H / problem.tick)


def design_certainty(kind: str, problem: Discrete) -> CertaintyEquivalentDesign:
    """Design regulator and Kalman filter, and compute the average cost of LQG control that sends every sample."""
    expect_average(kind, problem.cost)
    return _design(problem)


@lru_cache(maxsize=MOST_PROBLEMS)  # a problem is itself, and the same one for equal data (``discretise``)
def _design(problem: Discrete) -> CertaintyEquivalentDesign:
    plant = problem.plant
    regulator = problem.regulator()
    steady = problem.filter()
    expect_known_start(plant, regulator.K.diagonal() > 0)
    prior, posterior = steady.prior, steady.posterior
    cost = np.trace(problem.Q @ posterior) + np.trace(regulator.K @ (prior - posterior))
    loop = None if plant.changes is not None else filter_loop(problem, steady, regulator)
    proved = None if loop is None else loop.cost()
    overlap, pull = 0.0, 0.0
    if isinstance(plant.changes, SampledChanges) and problem.followed is not None:
        overlap, pull = problem.followed.transients(regulator.L, regulator.K, regulator.H, plant.changes.table)
        cost += overlap
    if proved is None:
        left = np.eye(plant.states) - steady.gain @ plant.C  # factor from the prior error to the posterior error
        square = regulator.L.T @ regulator.H @ regulator.L
        doubt = np.sum(regulator.error * (prior - posterior)) + np.sum(square * (left @ steady.error @ left.T))
        if not doubt <= COST_ERROR * abs(cost) and loop is not None:  # then a proof is worth seconds
            proved = loop.cost(patient=True)
        if proved is None:
            refuse_uncertain(float(cost), float(doubt))
    if proved is not None:
        cost = proved.value
    settling = 1 / (1 - max(regulator.slowest, steady.slowest))
    return CertaintyEquivalentDesign(
        problem, regulator, steady, estimate_state(plant, steady), float(cost), settling, pull, overlap, proved, loop
    )


def error_per_unit(problem: Discrete, proved: Proved) -> float:
    """Convert the proven error bound of a cost to the user's units, and add the rounding error of this conversion."""
    return rounded_up(proved.radius / problem.unit) + OPERATIONS * abs(problem.per_unit(proved.value))


def expect_average(kind: str, cost: Cost) -> None:
    """Raise an error if the cost has a horizon or a discount, and so is not an average."""
    instance("cost", cost, Cost)
    for name, absent in (("horizon", None), ("discount", 1.0)):
        got = getattr(cost, name)
        if got != absent:
            raise ProblemError(
                f"cost.{name} is {got:g}, which the policy kind {kind} does not use; expected an average cost: remove "
                "this key"
            )


def expect_constant_set_points(kind: str, plant: Plant) -> None:
    """Raise a ``ProblemError`` if the set-points of a plant change while the loop runs."""
    if plant.changes is not None:
        raise ProblemError(
            f"the set-points change (reference.steps or reference.file), which the policy kind {kind} does not use, as "
            "it does not use known loads; expected constant set-points, or the policy kind 'excess' or 'distributed'"
        )


def control_steps(
    plant: Plant,
    estimation: FilterSteps,
    L: Matrix,
    actuation: Actuation,
    trigger: Trigger | None,
    *,
    before: tuple[Step, ...] = (),
    after: tuple[Step, ...] = (),
    ahead: Ahead = BY_PACKETS,
) -> tuple[tuple[Step, ...], dict[str, Array]]:
    """Return the policy steps of filter, trigger and actuator, and the initial values of all signals that they
    store.
    """
    on, decide = (None, ()) if trigger is None else (SEND, (Decide("controller", SEND, trigger),))
    route = estimate_to_actuator(plant, L, actuation, on, ahead)
    deviates = trigger is not None and DEVIATION in trigger.reads
    steps = route.steps((*before, *decide), (*after, *estimation.predict), deviates=deviates)
    return (*estimation.correct, *steps), {**estimation.initial, **route.initial}


def certainty_policy(
    kind: str,
    certainty: CertaintyEquivalentDesign,
    steps: tuple[Step, ...],
    initial: Mapping[str, Array],
    *,
    identity: Identity | None,
    locations: tuple[Location, ...] = (),
    guarantee: Guarantee | None = None,
    closed_form: ClosedForm | None = None,
    fixed_rates: Mapping[str, float] | None = None,
    reset: Reset | None = None,
    slower: float = 1.0,
    notes: tuple[str, ...] = (),
    functions: frozenset[str] = frozenset(),
    unsure: bool = False,
) -> Policy:
    """Return the policy whose controller is at the sensor's site and sends the inputs over the link to the actuator."""
    problem, fixed_rates = certainty.problem, fixed_rates or {}
    if certainty.timed:
        if closed_form is not None and closed_form.cost != problem.per_unit(certainty.cost_all_time):
            closed_form, fixed_rates = None, {**closed_form.rates, **fixed_rates}
        identity, reset = None, None
        guarantee = guarantee if guarantee is not None and guarantee.pull else None
    if guarantee is not None and guarantee.proved:
        guarantee = guarantee.upwards()
    if problem.instants and guarantee is not None:
        guarantee = replace(guarantee, statement=f"{guarantee.statement}; {AT_INSTANTS}")
    claims = Theory(
        guarantee=guarantee,
        identity=identity,
        closed_form=closed_form,
        reset=reset,
        fixed_rates=fixed_rates,
        functions=functions,
        covers=GAUSSIAN_THEORY if closed_form is None else THEORY,
    )
    nominal = certainty.nominal(slower)
    return nominal.policy(kind, steps, initial, claims, locations=locations, notes=notes, unsure=unsure)


def steps_at_the_actuator(
    plant: Plant, estimation: FilterSteps, L: Matrix, network: Network = IDEAL
) -> tuple[Step, ...]:
    """Return the policy steps of a controller at the same site as all actuators, which needs no link to them."""
    unit, applied = np.eye(plant.inputs), network.applications(plant.inputs)
    parts = [Assign(node, name, {"input": unit[[*rows]]}) for name, (node, rows) in applied.items() if name != "input"]
    return (
        *estimation.correct,
        Assign(network.controller, "command", {ESTIMATE: L}),
        Assign(network.actuators[0], "input", {"command": unit}),
        *parts,
        Assign(network.controller, HELD, {"command": unit}),
        *estimation.predict,
    )


def completed_square(constant: float, H: ArrayLike | Scheduled) -> Identity:
    """Return the identity J = constant + E[(1−σ)e'He] for the cost, where e = û − Lx̂, and σ = 1 if a packet is sent.

    A silent step costs exactly e'He, and a send costs 0.
    """
    return Identity(constant, (Form(("error",), H), Form()), SEND)


def measure_excess(certainty: CertaintyEquivalentDesign) -> tuple[Step, Identity]:
    """Return the policy step that computes e = u − Lx̂, and the identity J = J_all + E[e'He] for the cost.

    The identity holds for any gain.
    """
    problem, regulator = certainty.problem, certainty.regulator
    step = Assign("controller", "excess", {HELD: np.eye(problem.plant.inputs), ESTIMATE: -regulator.L})
    form = Form(("excess",), regulator.H / problem.tick)
    return step, Identity(problem.per_unit(certainty.cost_all_time), (form,))


def silence_form(problem: Discrete, H: Array, theta: float) -> Form:
    """Return the form (1+θ) e'He − θ·(stage cost without a packet), by which a trigger limits the cost of not sending.

    It is at most θ tr(QΣ) whenever nothing is sent.

    With e = û − Lx̂, the form equals [x̂; e]'Γ[x̂; e] of (2.13) and [x̂; û]'Γ[x̂; û] of (3.10).
    """
    stage = np.block([[problem.Q, problem.N], [problem.N.T, problem.R]])
    signals = (ESTIMATE, "candidate", "error")
    if H.ndim == 2:
        return Form(signals, block_diagonal(-theta * stage, (1 + theta) * H))
    return Form(signals, Scheduled(CLOCK, [block_diagonal(-theta * stage, (1 + theta) * price) for price in H]))
