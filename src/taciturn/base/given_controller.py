"""Loops of a plant with a user's controller: slow disturbances, equilibrium, start, and periodic control to compare.

``GivenLoop`` is the loop of such a controller at the step of the policy, for the deviations from its point of rest.

``disturbed`` returns the problem in which such a controller is judged. If it integrates, the plant gets the slow
disturbance that it compensates, since silence would seem too cheap without one.

``rest_of`` returns the point at which the loop rests: the state x* and the input u* at which the outputs are at the
controller's set-points r, and the state of the controller that holds u*,

    x* = A x* + B u*,   C x* = r,   x_c* = A_c x_c* + E_c u*,   C_c x_c* = u*.

These are regulator equations of constant signals (``lqg.followed``). A policy is designed for the deviations from this
point. With a known input before the start, the controller begins at the state that commands this input, at rest apart
from its integrals.

``SameControl`` is the exact cost of the controller with periodic packets, at every q-th step and by the same means as
the policy. Between packets, the receiver keeps its last value or predicts it. The controller may also be discretised
for q steps, if its parameters are continuous, and then measures only when it sends. The cheaper of the two is compared.

``lqg_observer`` writes LQG as such a controller, and ``cost_as_now`` returns weights for which the present variances
of all outputs and inputs count equally.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._modes import balancing, radius
from taciturn._rational import Limit, unmoved_and_seen
from taciturn._text import number_of
from taciturn.base.certainty import design_certainty, error_per_unit
from taciturn.base.filter import HELD
from taciturn.base.gains import price_control
from taciturn.base.nominal import Nominal
from taciturn.base.route import actuator_base
from taciturn.base.value import (
    EVERY_SAMPLE,
    Advantage,
    Attempts,
    Base,
    advantage,
    cost_of_one_packet,
    least_value,
    seen_part,
)
from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.lqg.discrete import Discrete, beyond_limits, discretise, registers_from
from taciturn.lqg.followed import Resting
from taciturn.lqg.kalman import Filter
from taciturn.lqg.periodic import Held, lift
from taciturn.lqg.registers import registers_of, with_inputs_before
from taciturn.lqg.stored import Proved
from taciturn.model.controller import (
    AnyController,
    ContinuousController,
    Controller,
    following,
    integral_modes,
    pids_of,
    relative_to,
)
from taciturn.model.cost import Cost
from taciturn.model.coverage import SIMULATED
from taciturn.model.disturbance import Disturbance, padded
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.plant import ContinuousPlant, Plant, about
from taciturn.model.signals import SampledChanges
from taciturn.model.steps import Step, assigned
from taciturn.model.theory import Innovations

BESIDE_LQG = "LQG with these weights and every sample costs"  # begins a note on the loop of the design
MORE_PACKETS = "send more packets, or let a model predict the input between them (actuation)"
LASTING = 1e-9  # a mode whose modulus is 1 up to this does not decay
REMEDY = "check the sign of the controller (feedback is u = −K y), its gains, and its step"
REACHED = "set-points that change also need a controller that integrates, unless the plant does"
CONSTANT = (
    "the controller integrates, and the plant has no slow disturbance: a constant disturbance would make silence cost "
    "more than computed"
)


def cost_as_now(plant: Plant | ContinuousPlant, kept: AnyController, period: float | None = None) -> Cost:
    """Return the cost that weights each output and input by the inverse of its variance in the loop with every sample
    sent.
    """
    usual = Cost(np.eye(plant.states), np.eye(plant.inputs))
    problem, controller, _ = disturbed(plant, usual, period, kept)
    base = actuator_base(problem, controller)
    F, n = base.Phi + base.Gamma @ base.K, plant.states
    acts = base.K
    if plant.transport is not None:  # the inputs that act last in a step
        held, first = registers_of(plant, problem.tick), registers_from(problem)
        acts = held.Gu[-plant.inputs :] @ base.K
        acts[:, first : first + len(held.S)] += held.Gz[-plant.inputs :]
    seen = np.pad(plant.C, ((0, 0), (0, len(F) - n))) + (0.0 if plant.D is None else plant.D @ acts)
    rows = {"output_variance": seen, "input_variance": base.K}
    found: dict[str, list[float]] = {}
    for name, signals in rows.items():
        found[name] = []
        for number, row in enumerate(signals, 1):
            P, slowest = least_value(F, row[:, None] * row)
            variance = float(np.sum(P * base.noise))
            if slowest >= 1:
                raise UnstableError(
                    f"the loop that sends every sample is not stable; expected a stable loop: "
                    f"{remedy_of(problem, controller)}"
                )
            if variance <= 0:
                raise ProblemError(
                    f"the {name.partition('_')[0]} with the number {number} is constant in the loop that sends every "
                    "sample, so its weight cannot be computed; expected noise that affects it, or output_variance and "
                    "input_variance in place of weights"
                )
            found[name].append(variance)
    return Cost.of_variances(plant.C, **found, D=plant.D)


def disturbed(
    plant: Plant | ContinuousPlant, cost: Cost, period: float | None, kept: AnyController
) -> tuple[Discrete, Controller, Disturbance | None]:
    """Discretise a problem and a controller; the plant gets the slow disturbance that the controller compensates."""
    problem = discretise(plant, cost, period)
    controller = kept.at(problem.plant.dt, problem.plant.inputs, problem.plant.sensed)
    SIMULATED.check(controller)
    if not cost.mission:  # over a finite horizon, no mode has to decay
        _expect_moved(controller)
    controller = followed_by(plant, kept, controller)
    disturbance = controller.expected
    if disturbance is not None:
        disturbance = disturbance.completed(plant, period)
        problem = discretise(disturbance.added_to(plant, cost.mission), padded(cost, problem.plant.inputs), period)
    return problem, controller, disturbance


def _expect_moved(controller: Controller) -> None:
    """Reject a controller whose command contains a mode that neither outputs nor inputs move and that never decays."""
    c = controller
    lasting = unmoved_and_seen(
        c.A, np.hstack([c.B, c.E]), c.C, Limit(False)
    ).lasting  # exact: no rounding decides a mode at 1
    if lasting.size:
        raise UnstableError(
            f"the controller has the mode {Limit(False).named(complex(lasting[0]))}, which its command contains and no "
            "measurement moves, so the loop is not stable: with two integrals of one output, this is their difference; "
            "expected that no two integrals have the same output"
        )


def _has_set_point(kept: AnyController) -> bool:
    """Return whether a controller states a set-point of its own."""
    if isinstance(kept, Controller | ContinuousController):
        return kept.setpoint is not None and bool(np.any(kept.setpoint))
    return any(one.setpoint for one in pids_of(kept))


def followed_by(plant: Plant | ContinuousPlant, kept: AnyController, controller: Controller) -> Controller:
    """Return a discretised controller that also reads the set-points of the plant, if the plant has any."""
    own = plant.exosystem
    if own is None:
        return controller
    if own.changes is None or len(own.S) > len(own.outputs) or own.E.any() or own.G.any():
        raise ProblemError(
            "the plant has disturbances, or set-points that never change, which a given controller does not use; "
            "expected the key 'disturbance' of the controller, a load with wander = 0 that is not known, and "
            "set-points that an operator may change: RandomSteps(rate=0, covariance) if they are constant until then"
        )
    if plant.D is not None:
        raise ProblemError(
            "plant.D is given, and the set-points change, but a given controller compares set-points with "
            "measurements, which depend on the input of the previous step through D; expected no D, or LQG with "
            "guarantee = 'every path'"
        )
    if controller.F is None or pids_of(kept):  # one column for each measurement
        return following(controller, [_output_of(plant, place, row) for place, row in enumerate(own.outputs)])
    if controller.F.shape[1] != len(own.outputs):
        raise ProblemError(
            f"controller.F and controller.G have {number_of(controller.F.shape[1], 'column')}, and there are "
            f"{number_of(len(own.outputs), 'set-point')}; expected one column for each row of reference.outputs"
        )
    return following(controller, range(len(own.outputs)))


def _output_of(plant: Plant | ContinuousPlant, place: int, wanted: Array) -> int:
    """Return the measured output with which a given controller compares a set-point."""
    for i, row in enumerate(plant.C):
        if np.array_equal(row, wanted):
            return i
    raise ProblemError(
        f"row {place + 1} of reference.outputs is not a measured output, but a given controller without F and G "
        "compares its set-points with measured outputs; expected rows of plant.C, or controller.F and controller.G"
    )


def _expect_one_set_point(kept: AnyController, followed: bool) -> None:
    """Raise an error if a controller weights a set-point but has none, or if it has two."""
    if followed and _has_set_point(kept):
        raise ProblemError("controller.setpoint and [reference] are both given; expected only one of them")
    if not followed and any((one.b != 1.0 or one.c != 0.0) and not one.setpoint for one in pids_of(kept)):
        raise ProblemError(
            "pid.b or pid.c is given without pid.setpoint; expected a set-point, here or in [reference], or neither "
            "pid.b nor pid.c"
        )


def lqg_observer(
    kind: str, problem: Discrete, every: int = 1, L: Array | None = None, zero: bool = False
) -> Controller:
    """Return LQG control as a linear controller in state space. Its observer uses the input that is actually applied.

    Its gain is L, or by default optimal for a packet at every q-th step, and an input that is held or ``zero`` between.
    """
    if problem.cost.horizon is not None:
        raise ProblemError(
            f"cost.horizon is {problem.cost.horizon}, so the gains of LQG change with time; the policy kind {kind} "
            "supports this only over an actuator link that drops no packets (no loss, no burst), with actuation "
            "'hold' or 'model', every = 1, and without the parameters 'gains' and 'retry'; expected these settings, "
            "an average or discounted cost, or a given controller"
        )
    plant = problem.plant
    if L is not None:
        return observer_controller(plant, problem.filter(), L)
    if not problem.cost.mission:
        certainty = design_certainty(kind, problem)
        steady, gain, moved, shrunk = certainty.filter, certainty.regulator.L, certainty.corrections, 1.0
    else:
        steady, gain = problem.filter(), price_control(problem).L
        moved, shrunk = plant.W, np.sqrt(problem.cost.discount)
    if every > 1:  # with a discount, in states and inputs that are smaller by its root in each step
        factor = 0.0 if zero else shrunk
        between = Held(shrunk * plant.A, shrunk * plant.B, problem.Q, problem.R, problem.N, moved, factor)
        gain = between.solve((every,)).gains[0]
    return observer_controller(plant, steady, gain)


def observer_controller(plant: Plant, steady: Filter, L: Array) -> Controller:
    """Return the feedback u = L x̂ as a linear controller in state space, whose filter uses the applied input."""
    n, m = plant.B.shape
    none = Disturbance(deviation=0.0)
    if plant.full_state:
        return Controller(np.zeros((0, 0)), np.zeros((0, n)), np.zeros((m, 0)), L, None, plant.dt, none)
    left = np.eye(n) - steady.gain @ plant.C
    return Controller(plant.A @ left, plant.A @ steady.gain, L @ left, L @ steady.gain, plant.B, plant.dt, none)


def remedy_of(problem: Discrete, controller: Controller) -> str:
    """Suggest how to stabilise the unstable loop of a given controller: by the opposite sign, if this stabilises it."""
    c = controller
    base = actuator_base(problem, Controller(c.A, c.B, -c.C, -c.D, c.E, c.dt))
    if radius(base.Phi + base.Gamma @ base.K) >= 1 - LASTING:  # set-points that change last, up to rounding
        return REMEDY if problem.plant.changes is None or c.integrates else f"{REMEDY}; {REACHED}"
    return (
        "with the other sign of the controller the loop is stable, so change the key controller.sign, the sign of each "
        "gain, or those of C and D (negative feedback is u = −K y)"
    )


def recovery(base: Base, plant: Plant, disturbance: Disturbance | None, slowest: float = 0.0) -> float | None:
    """Return the time constant of a loop apart from its slow disturbance, in steps; None without a slow disturbance.

    ``slowest`` is the modulus of the slowest mode of the filter. A mode that does not decay does not count: the value
    of the base exists, so neither its cost nor its controller sees this mode, such as an integral that only counts.
    """
    if disturbance is None:
        return None
    modes = np.abs(np.linalg.eigvals(base.Phi + base.Gamma @ base.K))
    n, m = plant.stated - plant.set_points, plant.inputs
    # nothing moves the disturbances, so the loop has their decay per step as modes, up to rounding
    slow = np.argsort(np.abs(modes - abs(plant.A[n - m, n - m])))[:m]
    rest = np.delete(modes, slow)
    return float(1 / (1 - max(slowest, *rest[rest < 1 - LASTING])))


def note_disturbance(controller: Controller, disturbance: Disturbance | None) -> tuple[str, ...]:
    """Return a note that describes the slow disturbance or, if a controller with an integrator has none, says so."""
    if disturbance is None:
        return (CONSTANT,) if controller.integrates else ()
    stated = controller.disturbance or Disturbance()
    missing = [name for name in ("time_constant", "deviation") if getattr(stated, name) is None]
    source = f" ({' and '.join(missing)} by default, from the step, W and B)" if missing else ""
    return (f"the plant has a slowly varying disturbance at each input: {disturbance.text()}{source}",)


def note_ringing(kept: AnyController, step: float) -> tuple[str, ...]:
    """Return a note if discretisation makes a fast mode of a continuous controller alternate from step to step."""
    found = kept.ringing(step) if isinstance(kept, ContinuousController) else None
    if found is None:
        return ()
    return (
        f"the controller has a mode with the time constant {found[0]:.3g} s, such as a filter of its derivative, which "
        f"is faster than half a step of {step:g} s: the trapezoidal rule makes it an eigenvalue of {found[1]:.3g}, so "
        "its part of the command alternates from step to step; expected a slower filter, a shorter step, or method "
        '"zoh"',
    )


@dataclass(frozen=True, eq=False, repr=False)
class GivenLoop(Displayed):
    """The loop of a plant and a given controller, with all signals as deviations from the equilibrium of the loop."""

    stated: Plant | ContinuousPlant  # the plant as stated, before it is discretised
    kept: AnyController  # the controller as stated, its set-points relative to the operating point of the plant
    controller: Controller  # the controller at the step
    problem: Discrete  # the discrete-time problem of the deviations, with the slow disturbance
    point: Rest  # the point at which the loop rests
    disturbance: Disturbance | None  # the slow disturbance, or None
    lqg: bool = False  # whether the controller is LQG with the weights of the cost, and not one that a user has

    @staticmethod
    def of(
        plant: Plant | ContinuousPlant,
        cost: Cost,
        period: float | None,
        kept: AnyController,
        lqg: bool = False,
    ) -> GivenLoop:
        """Return the loop of a given controller. The plant gets the disturbance that the controller compensates."""
        if plant.exosystem is not None and lqg:
            raise ProblemError(
                "the plant has disturbances or set-points, which LQG with these options does not use; expected the "
                "kind excess with link = 'actuator', actuation 'hold' or 'model', every = 1 and ideal links"
            )
        _expect_one_set_point(kept, plant.exosystem is not None)
        kept = relative_to(kept, plant)
        problem, controller, disturbance = disturbed(plant, cost, period, kept)
        point = rest_of(problem, controller)
        if lqg and len(controller.A):  # its state predicts that of the plant
            point = replace(point, start=problem.plant.mean)
        return GivenLoop(plant, kept, controller, point.deviations(problem), point, disturbance, lqg)

    @cached_property
    def remedy(self) -> str:
        """The remedy that the error message for an unstable loop suggests."""
        return MORE_PACKETS if self.lqg else remedy_of(self.problem, self.controller)

    def every_sample(self) -> Base:
        """Return the base loop that sends every sample; raise an error if this loop is unstable."""
        base = actuator_base(self.problem, self.controller)
        advantage(base, self.remedy)
        return base

    def value(self, base: Base) -> tuple[Advantage, float]:
        """Compute the value function of a base loop that sends every sample, and its cost per step or in total."""
        found = advantage(
            base, self.remedy, attempts_of(self.problem, base, (True,) * (self.problem.cost.horizon or 1))
        )
        overlap, _ = self.known_steps(base, found.P)
        return found, cost_of_base(self.problem, found, self.point.start) + overlap

    def known_steps(self, base: Base, P: Array) -> tuple[float, Array | None]:
        """Return what set-points that change at known times add to the cost, and the slopes of their cost of silence.

        The first is the cost per step beyond that of independent changes, 0 for other set-points. The second, (steps,
        c), is g_k of the cost of silence e'He + 2e'(slope z + g_k); None for other set-points.
        """
        # The value is z'Pz + 2h_k'z + a constant with h_k = F'(P m_k + h_{k+1}), where the known change moves z by m_k
        # from step k to k + 1. So g_k = Γ'(P m_k + h_{k+1}). A change comes before the response to earlier ones has
        # ended: with the state z_k that they cause, the cost exceeds that of independent changes by 2m_k'P F z_k.
        plant, closed = self.problem.plant, base.replaced[:, : len(base.Phi)]
        if not isinstance(plant.changes, SampledChanges):
            return 0.0, None
        (n, p), table = (plant.states, plant.outputs), plant.changes.table
        which = slice(n - table.shape[1], n)
        moves, F = np.zeros((len(table), len(base.Phi))), base.Phi + base.Gamma @ base.K
        moves[:, which], moves[:, -p:] = table, table @ plant.C[:, which].T
        unit = balancing(F)
        F, M = F / unit[:, None] * unit, closed.T @ base.stage @ closed * unit * unit[:, None]
        seen = seen_part(F, M)  # the set-points themselves last, and the cost does not see them
        F, moves, P = (
            seen.T @ F @ seen,
            moves / unit @ seen,
            seen.T @ (P[: len(F), : len(F)] * np.outer(unit, unit)) @ seen,
        )
        none, whole, cost = np.zeros(len(F)), np.eye(len(F)), 0.0
        begun, later, power = none, none, whole
        for first, last in zip(moves, moves[::-1], strict=True):
            begun, later, power = F @ begun + first, F.T @ (P @ last + later), F @ power
        state = np.linalg.solve(whole - power, begun)  # at the end of each cycle
        ahead = np.linalg.solve(whole - power.T, later)  # at its beginning, and so at its end
        for move in moves:
            state = F @ state
            cost += 2 * float(move @ P @ state)
            state = state + move
        slopes, acts = np.empty((len(moves), base.Gamma.shape[1])), (base.Gamma / unit[:, None]).T @ seen
        for k in range(len(moves) - 1, -1, -1):
            pushed = P @ moves[k] + ahead
            slopes[k], ahead = acts @ pushed, F.T @ pushed
        return cost / len(table), slopes

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the slow disturbance, and on modes of the controller that are too fast for the sampling period."""
        return note_disturbance(self.controller, self.disturbance) + note_ringing(self.kept, self.problem.tick)

    @cached_property
    def cost_lqg(self) -> float | None:
        """Cost of LQG control with the same weights and every sample sent; None if this LQG problem has no solution."""
        try:
            return self.problem.per_unit(design_certainty("LQG", self.problem).cost_all_time)
        except TaciturnError:  # LQG needs more of the weights than a given controller
            return None

    def beside_lqg(self, all_time: float) -> list[str]:
        """Return a note that compares the costs per step of this controller and of LQG control, both with every sample
        sent.
        """
        if self.cost_lqg is None or self.lqg:
            return []
        cost, noise = self.problem.per_unit(all_time), self.problem.per_unit(0.0)
        if abs(self.cost_lqg - cost) <= 1e-9 * cost:
            return []
        share = (self.cost_lqg - noise) / (cost - noise)
        return [f"{BESIDE_LQG} {share:.3f} times as much as this controller"]

    def nominal(
        self,
        cost: float,
        settling: float,
        base: Base | None = None,
        proved: Proved | None = None,
        *,
        slowest: float = 0.0,
        innovations: Innovations | None = None,
    ) -> Nominal:
        """Return the loop that sends every sample as a reference. ``base`` determines its time constant.

        ``slowest`` is the modulus of the slowest mode of the filter.
        """
        problem = self.problem
        return Nominal(
            problem,
            cost if proved is None else proved.value,
            settling,
            None if proved is None else error_per_unit(problem, proved),
            None if base is None else recovery(base, problem.plant, self.disturbance, slowest),
            innovations,
            disturbance=self.disturbance,
        )


def attempts_of(
    problem: Discrete,
    base: Base,
    pattern: tuple[bool, ...],
    chain: tuple[Array, Array] | None = None,
    key: str = "loss",
) -> Attempts:
    """Return the steps at which a base loop attempts to send, with the link's losses and the weight of the
    final state.
    """
    turns, losses = (EVERY_SAMPLE.turns, EVERY_SAMPLE.losses) if chain is None else chain
    cost, terminal = problem.cost, None
    if cost.terminal is not None:
        terminal = np.pad(cost.terminal, (0, len(base.Phi) - len(cost.terminal)))
    return Attempts(pattern, turns, losses, cost.discount, terminal, key)


def cost_of_base(problem: Discrete, found: Advantage, start: Array, begun: Array | None = None) -> float:
    """Return the cost of a base loop: per step or, for a total cost, the expected total from the first step on.

    There z contains the random state of the plant, the state ``start`` of the controller, and the first measurement; h
    is the value ``begun`` with which the receiver starts, 0 by default. All are a mean plus what x − E x and the noise
    v add.
    """
    if not problem.cost.mission:
        return found.cost
    plant = problem.plant
    known = np.concatenate([plant.mean, start, plant.C @ plant.mean])
    begun = np.zeros(len(found.P) - len(known)) if begun is None else begun
    mean = np.concatenate([known, begun])
    state, noise = np.zeros((len(mean), plant.states)), np.zeros((len(mean), plant.outputs))
    place = plant.states + len(start)
    measured = slice(place, place + plant.outputs)
    state[: plant.states], state[measured], noise[measured] = np.eye(plant.states), plant.C, np.eye(plant.outputs)
    moment = np.outer(mean, mean) + state @ plant.covariance @ state.T + noise @ plant.V @ noise.T
    return found.cost + float(np.sum(found.P * moment))


UNSTABLE = "expected fewer steps between packets"


@dataclass(frozen=True, eq=False, repr=False)
class SameControl(Displayed):
    """Function that computes the cost per step of one controller from the number of steps between its packets.

    Over a link that drops packets, it is that of attempts to send.
    """

    loop: GivenLoop  # the loop of the controller, which may depend on the step
    base: Base  # the loop that sends every sample, with the receiver's own value in silence
    attempts: Attempts = EVERY_SAMPLE  # the losses of the link
    held: Callable[[int], Base] | None = None  # LQG with other gains, for an interval of so many steps

    def __call__(self, steps: int) -> float:
        """Return the cost."""
        found = [self.at_its_step(steps), self.discretised(steps)]
        if self.held is not None and steps > 1:
            with suppress(UnstableError):  # such a hold may prevent stabilisation
                found.append(self.at_its_step(steps, self.held(steps)))
        found = [cost for cost in found if cost is not None]
        if not found:
            raise UnstableError(
                f"the controller does not stabilise the plant if only one packet is sent in {steps} steps; {UNSTABLE}"
            )
        return min(found)

    def at_its_step(self, steps: int, base: Base | None = None) -> float | None:
        """Return the cost if the controller still computes at every step, between packets too; None for an unstable
        loop.
        """
        base = base or self.base
        if not self.attempts.losses.any():
            return cost_of_one_packet(base, steps)
        with suppress(UnstableError):
            return advantage(base, UNSTABLE, replace(self.attempts, pattern=(True, *[False] * (steps - 1)))).cost
        return None

    def discretised(self, steps: int) -> float | None:
        """Return the cost if the controller is discretised with the longer interval; None if that is impossible."""
        problem, plant, kept = self.loop.problem, self.loop.problem.plant, self.loop.kept
        if isinstance(kept, Controller) or steps == 1:
            return None
        long = lift(plant.A, plant.B, problem.Q, problem.R, problem.N, plant.W, steps)
        dt = None if plant.dt is None else plant.dt * steps
        try:
            moved = Plant(long.A, long.B, long.W, plant.C, plant.V, dt)
            slow = replace(problem, plant=moved, Q=long.Q, R=long.R, N=long.N, exact=None, deviations=None)
            controller = followed_by(self.loop.stated, kept, kept.at(dt, plant.inputs, plant.sensed))
            base, turns = actuator_base(slow, controller), np.linalg.matrix_power(self.attempts.turns, steps)
            attempts = replace(self.attempts, pattern=(True,), turns=turns)
            return (advantage(base, UNSTABLE, attempts).cost + long.noise_cost) / steps
        except (ProblemError, UnstableError):  # such as a filter that is faster than these steps
            return None


RESTS = 1e-9  # relative residual of an equation of the point


@dataclass(frozen=True, eq=False, repr=False)
class Rest(Displayed):
    """The equilibrium of a loop with a given controller, and the loop's initial deviation from this equilibrium."""

    state: Array  # state x* of the plant, (n,)
    input: Array  # input u*, (m,)
    start: Array  # state of the controller at the start, relative to its state at rest, (k,)
    before: Array  # the input before the start, relative to u*, (m,)

    @property
    def moved(self) -> bool:
        """True if the equilibrium is not the operating point, or if the controller does not start in equilibrium."""
        return any(one.any() for one in (self.state, self.input, self.start, self.before))

    def deviations(self, problem: Discrete) -> Discrete:
        """Express a discrete-time problem in deviations of its state and input from the equilibrium."""
        plant = problem.plant
        if self.state.any() or self.input.any():
            here = plant.operating_point
            x, u = (0.0, 0.0) if here is None else (here.x, here.u)
            plant = about(plant, OperatingPoint(x + self.state, u + self.input))
        if plant.registers and self.before.any():
            plant = with_inputs_before(plant, registers_from(problem), self.before)
        return replace(problem, plant=plant)

    def begun(
        self, steps: tuple[Step, ...], initial: Mapping[str, Array], applied: Mapping[str, Sequence[int]] | None = None
    ) -> dict[str, Array]:
        """Return the initial values of all signals. The stored inputs begin with the input that was applied before the
        start.

        ``applied`` are the inputs of each actuator, if there are several; the signals then have the names of these.
        """
        if not self.before.any():
            return dict(initial)
        signals, found = {name for step in steps for name in assigned(step)}, dict[str, Array]()
        suffixes = {"": range(len(self.before))} | {f"_{node}": rows for node, rows in (applied or {}).items()}
        for suffix, rows in suffixes.items():  # fingerprints contain their order
            found |= {
                f"{name}{suffix}": self.before[[*rows]]
                for name in ("command", HELD, "input")
                if f"{name}{suffix}" in signals
            }
        return {**found, **initial}


def rest_of(problem: Discrete, controller: Controller) -> Rest:
    """Compute the equilibrium of the closed loop of a plant and a controller."""
    plant, r = problem.plant, controller.setpoint
    (n, m), p = plant.B.shape, plant.outputs
    state, steady, rest = np.zeros(n), np.zeros(m), np.zeros(len(controller.A))
    if problem.cost.mission and (r.any() or controller.start_input is not None):
        raise ProblemError(
            "a set-point or start_input is given, but the cost has a horizon or a discount; expected an average cost"
        )
    if r.any():
        seen = np.hstack([plant.C, np.zeros((p, m))]), -r[:, None]
        what = f"the plant cannot rest at the set-point {r.tolist()}"
        state, steady = _resting(plant.A, plant.B, state, seen, what)
        limit = plant.input_limit
        if limit is not None and ((steady <= limit[:, 0]) | (steady >= limit[:, 1])).any():
            raise beyond_limits(plant, steady)
        F, G = controller.reads
        held = controller.C, ((controller.D + G) @ r - steady)[:, None]
        what = "the controller does not hold the set-point, as it does not integrate"
        caused = np.asarray(controller.E @ steady + (controller.B + F) @ r, dtype=np.float64)
        rest, _ = _resting(controller.A, np.zeros((len(controller.A), 0)), caused, held, what)
    start, before = -rest, -steady
    if controller.start_input is not None:
        _expect_within_limits(plant, controller.start_input)
        before = controller.start_input - steady
        if plant.registers:
            plant = with_inputs_before(plant, registers_from(problem), controller.start_input)
        start = _bumpless(controller, plant.C @ plant.mean - r, before)
    return Rest(state, steady, start, before)


def _expect_within_limits(plant: Plant, start_input: Array) -> None:
    """Raise a ``ProblemError`` if an actuator cannot have applied the stated input before the start."""
    limit, point = plant.input_limit, plant.operating_point
    if limit is None or ((start_input >= limit[:, 0]) & (start_input <= limit[:, 1])).all():
        return
    units = np.zeros(len(start_input)) if point is None else point.u
    raise ProblemError(
        f"start_input is {(start_input + units).tolist()}, beyond the input_limit {(limit + units[:, None]).tolist()}; "
        "expected an input within the limits: give the input that the plant had before the start"
    )


def _bumpless(c: Controller, error: Array, command: Array) -> Array:
    """Return the state of the controller with a first command, at rest apart from its integrals."""
    left = np.eye(len(c.A)) - c.A - c.E @ c.C
    state = np.asarray(np.linalg.pinv(left) @ (c.B + c.E @ c.D) @ error, dtype=np.float64)
    integrals = integral_modes(c.A + c.E @ c.C)
    state = state + integrals @ np.linalg.pinv(c.C @ integrals) @ (command - c.C @ state - c.D @ error)
    if np.abs(c.C @ state + c.D @ error - command).max() > RESTS * max(1.0, float(np.abs(command).max())):
        raise ProblemError(
            "start_input is given, but the controller has no integral action for some inputs; expected integral "
            "action for every input"
        )
    return state


def _resting(A: Array, B: Array, push: Array, wanted: tuple[Array, Array], what: str) -> tuple[Array, Array]:
    """Return the smallest state and input at rest under a constant push; a solution of the regulator equations."""
    equations = Resting.of(A, B, np.eye(1), push[:, None], wanted)
    found = equations.smallest()
    if equations.missed(found) > RESTS * np.abs(equations.right).max(initial=0.0):
        raise ProblemError(
            f"no equilibrium of the loop was found: {what}; expected a set-point with an equilibrium, or no set-point"
        )
    state, steady = equations.split(found)
    return state[:, 0], steady[:, 0]
