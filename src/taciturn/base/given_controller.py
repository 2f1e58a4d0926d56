"""Controllers that a user has, together with their plant: disturbance, point of rest, start and periodic comparison.

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

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._modes import radius
from taciturn.base.certainty import design_certainty, error_per_unit
from taciturn.base.filter import HELD
from taciturn.base.gains import price_control
from taciturn.base.nominal import Nominal
from taciturn.base.route import actuator_base
from taciturn.base.value import Attempts, Base, advantage, least_value
from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.lqg.discrete import Discrete, beyond_limits, discretise, registers_from, with_inputs_before
from taciturn.lqg.followed import Resting
from taciturn.lqg.kalman import Filter
from taciturn.lqg.periodic import Held, lift
from taciturn.lqg.stored import Proved
from taciturn.model.controller import AnyController, ContinuousController, Controller, relative_to
from taciturn.model.cost import Cost
from taciturn.model.coverage import SIMULATED
from taciturn.model.disturbance import Disturbance, padded
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.plant import ContinuousPlant, Plant, about
from taciturn.model.steps import Step, assigned
from taciturn.model.theory import Innovations

MORE_PACKETS = "send more packets, or let a model predict the input between them (actuation)"
LASTING = 1e-9  # a mode whose modulus is 1 up to this does not decay
REMEDY = (
    "check the sign of the controller (feedback is u = −K y), its gains, its step, and that no two integrals have the "
    "same output"
)
CONSTANT = (
    "the controller integrates, and the plant has no slow disturbance: a constant disturbance would make silence cost "
    "more than computed"
)


def cost_as_now(plant: Plant | ContinuousPlant, kept: AnyController, period: float | None = None) -> Cost:
    """Return the cost for which the present variances of all outputs and inputs count equally, with every sample."""
    usual = Cost(np.eye(plant.states), np.eye(plant.inputs))
    problem, controller, _ = disturbed(plant, usual, period, kept)
    base = actuator_base(problem, controller)
    F, n = base.Phi + base.Gamma @ base.K, plant.states
    seen = np.pad(plant.C, ((0, 0), (0, len(F) - n))) + (0.0 if plant.D is None else plant.D @ base.K)
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
                    f"{name.partition('_')[0]} {number} has no variance in the loop with every sample; expected noise "
                    "that moves it, or output_variance and input_variance in place of weights"
                )
            found[name].append(variance)
    return Cost.of_variances(plant.C, **found, D=plant.D)


def disturbed(
    plant: Plant | ContinuousPlant, cost: Cost, period: float | None, kept: AnyController
) -> tuple[Discrete, Controller, Disturbance | None]:
    """Return the discrete-time problem with the slow disturbance, the controller at its step, and the disturbance."""
    problem = discretise(plant, cost, period)
    controller = kept.at(problem.plant.dt, problem.plant.inputs, problem.plant.outputs)
    SIMULATED.check(controller)
    disturbance = controller.expected
    if disturbance is not None:
        disturbance = disturbance.completed(plant, period)
        problem = discretise(disturbance.added_to(plant, cost.mission), padded(cost, problem.plant.inputs), period)
    return problem, controller, disturbance


def lqg_observer(
    kind: str, problem: Discrete, every: int = 1, L: Array | None = None, zero: bool = False
) -> Controller:
    """Return LQG control as a controller, whose observer uses the input that was applied.

    Its gain is L, or by default optimal for a packet at every q-th step, and an input that is held or ``zero`` between.
    """
    if problem.cost.horizon is not None:
        raise ProblemError(
            f"cost.horizon is {problem.cost.horizon}, so the gains of LQG change with time; {kind} supports this only "
            "over an actuator link that drops no packets (no loss, no burst), with actuation 'hold' or 'model', "
            "every = 1, and gains and retry omitted; expected this, an average or discounted cost, or a controller"
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
    """Return feedback of the filtered estimate as a controller, whose filter uses the input that was applied."""
    n, m = plant.B.shape
    none = Disturbance(deviation=0.0)
    if plant.full_state:
        return Controller(np.zeros((0, 0)), np.zeros((0, n)), np.zeros((m, 0)), L, None, plant.dt, none)
    left = np.eye(n) - steady.gain @ plant.C
    return Controller(plant.A @ left, plant.A @ steady.gain, L @ left, L @ steady.gain, plant.B, plant.dt, none)


def remedy_of(problem: Discrete, controller: Controller) -> str:
    """Return the remedy if a loop of a given controller is unstable: the other sign, if this loop is stable."""
    c = controller
    base = actuator_base(problem, Controller(c.A, c.B, -c.C, -c.D, c.E, c.dt))
    if radius(base.Phi + base.Gamma @ base.K) >= 1:
        return REMEDY
    return (
        "with the other sign of the controller the loop is stable, so change the key controller.sign, the sign of each "
        "gain, or those of C and D (negative feedback is u = −K y)"
    )


def recovery(base: Base, plant: Plant, disturbance: Disturbance | None, slowest: float = 0.0) -> float | None:
    """Return the time constant in steps of a base without the slow disturbance of its plant, or None without one.

    ``slowest`` is the modulus of the slowest mode of the filter. A mode that does not decay does not count: the value
    of the base exists, so neither its cost nor its controller sees this mode, such as an integral that only counts.
    """
    if disturbance is None:
        return None
    modes, (n, m) = np.abs(np.linalg.eigvals(base.Phi + base.Gamma @ base.K)), (plant.stated, plant.inputs)
    # nothing moves the disturbances, so the loop has their decay per step as modes, up to rounding
    slow = np.argsort(np.abs(modes - abs(plant.A[n - m, n - m])))[:m]
    rest = np.delete(modes, slow)
    return float(1 / (1 - max(slowest, *rest[rest < 1 - LASTING])))


def note_disturbance(controller: Controller, disturbance: Disturbance | None) -> tuple[str, ...]:
    """Return a note on the slow disturbance of the plant."""
    if disturbance is None:
        return (CONSTANT,) if controller.integrates else ()
    stated = controller.disturbance or Disturbance()
    missing = [name for name in ("time_constant", "deviation") if getattr(stated, name) is None]
    source = f" ({' and '.join(missing)} by default, from the step, W and B)" if missing else ""
    return (f"the plant has a slowly varying disturbance at each input: {disturbance.text()}{source}",)


def note_ringing(kept: AnyController, step: float) -> tuple[str, ...]:
    """Return a note on a mode of a continuous controller that the trapezoidal rule makes alternate."""
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
    """A given controller and its plant in deviations from the point at which they rest."""

    kept: AnyController  # the controller as stated, its set-points relative to the operating point of the plant
    controller: Controller  # the controller at the step
    problem: Discrete  # the discrete-time problem of the deviations, with the slow disturbance
    point: Rest  # the point at which the loop rests
    disturbance: Disturbance | None  # the slow disturbance, or None
    lqg: bool = False  # whether the controller is LQG with the weights of the cost, and not one that a user has

    @staticmethod
    def of(
        plant: Plant | ContinuousPlant, cost: Cost, period: float | None, kept: AnyController, lqg: bool = False
    ) -> GivenLoop:
        """Return the loop of a controller, for a plant without the slow disturbance that the controller compensates."""
        if plant.exosystem is not None:
            ideal = "link = 'actuator', actuation 'hold' or 'model', every = 1 and ideal links"
            who, expected = (
                ("LQG with these options", f"the kind excess with {ideal}")
                if lqg
                else ("a given controller", f"its keys setpoint and disturbance, or LQG: the kind excess with {ideal}")
            )
            raise ProblemError(
                f"the plant has disturbances or set-points, which {who} does not use; expected {expected}"
            )
        kept = relative_to(kept, plant)
        problem, controller, disturbance = disturbed(plant, cost, period, kept)
        point = rest_of(problem, controller)
        if lqg and len(controller.A):  # its state predicts that of the plant
            point = replace(point, start=problem.plant.mean)
        return GivenLoop(kept, controller, point.deviations(problem), point, disturbance, lqg)

    @cached_property
    def remedy(self) -> str:
        """The remedy if the loop is unstable."""
        return MORE_PACKETS if self.lqg else remedy_of(self.problem, self.controller)

    def every_sample(self) -> Base:
        """Return the loop that sends every sample."""
        base = actuator_base(self.problem, self.controller)
        advantage(base, self.remedy)
        return base

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the slow disturbance, and on modes of the controller that are too fast for the step."""
        return note_disturbance(self.controller, self.disturbance) + note_ringing(self.kept, self.problem.tick)

    @cached_property
    def cost_lqg(self) -> float | None:
        """The cost of LQG with the same weights and every sample, or None if LQG does not exist for these weights."""
        try:
            return self.problem.per_unit(design_certainty("LQG", self.problem).cost_all_time)
        except TaciturnError:  # LQG needs more of the weights than a given controller
            return None

    def beside_lqg(self, all_time: float) -> list[str]:
        """Return a remark on the cost of LQG, given that of the controller per step, both with every sample."""
        if self.cost_lqg is None or self.lqg:
            return []
        cost, noise = self.problem.per_unit(all_time), self.problem.per_unit(0.0)
        if abs(self.cost_lqg - cost) <= 1e-9 * cost:
            return []
        share = (self.cost_lqg - noise) / (cost - noise)
        return [f"LQG with these weights and every sample costs {share:.3f} times as much as this controller"]

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
        """Return the loop that sends every sample; a base that is linear gives its time constant without disturbances.

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


UNSTABLE = "expected fewer steps between packets"


@dataclass(frozen=True, eq=False, repr=False)
class SameControl(Displayed):
    """Function of the steps between packets that returns the exact cost per step, without inter-sample noise cost."""

    problem: Discrete  # the discrete-time problem
    kept: AnyController  # the controller, which may depend on the step
    base: Base  # the loop that sends every sample, with the receiver's own value in silence

    def __call__(self, steps: int) -> float:
        """Return the cost."""
        found = [cost for cost in (self.at_its_step(steps), self.discretised(steps)) if cost is not None]
        if not found:
            raise UnstableError(f"the controller is unstable with a packet every {steps} steps; {UNSTABLE}")
        return min(found)

    def at_its_step(self, steps: int) -> float | None:
        """Return the cost of the controller that computes at every step; None if the loop is unstable."""
        try:
            return advantage(self.base, UNSTABLE, Attempts(tuple(k == 0 for k in range(steps)))).cost
        except UnstableError:
            return None

    def discretised(self, steps: int) -> float | None:
        """Return the cost of the controller at its discretisation for several steps; None if there is none."""
        problem, plant = self.problem, self.problem.plant
        if isinstance(self.kept, Controller) or steps == 1:
            return None
        long = lift(plant.A, plant.B, problem.Q, problem.R, problem.N, plant.W, steps)
        dt = None if plant.dt is None else plant.dt * steps
        try:
            moved = Plant(long.A, long.B, long.W, plant.C, plant.V, dt)
            slow = replace(problem, plant=moved, Q=long.Q, R=long.R, N=long.N, exact=None, deviations=None)
            base = actuator_base(slow, self.kept.at(dt, plant.inputs, plant.outputs))
            return (advantage(base, UNSTABLE).cost + long.noise_cost) / steps
        except (ProblemError, UnstableError):  # such as a filter that is faster than these steps
            return None


RESTS = 1e-9  # relative residual of an equation of the point


@dataclass(frozen=True, eq=False, repr=False)
class Rest(Displayed):
    """The point at which the loop of a controller rests, and its start, relative to the plant's own operating point."""

    state: Array  # state x* of the plant, (n,)
    input: Array  # input u*, (m,)
    start: Array  # state of the controller at the start, relative to its state at rest, (k,)
    before: Array  # the input before the start, relative to u*, (m,)

    @property
    def moved(self) -> bool:
        """True if state or input differ from zero at the point, or the controller does not start at rest."""
        return any(one.any() for one in (self.state, self.input, self.start, self.before))

    def deviations(self, problem: Discrete) -> Discrete:
        """Return the problem of the deviations from the point."""
        plant = problem.plant
        if self.state.any() or self.input.any():
            here = plant.operating_point
            x, u = (0.0, 0.0) if here is None else (here.x, here.u)
            plant = about(plant, OperatingPoint(x + self.state, u + self.input))
        if plant.registers and self.before.any():
            plant = with_inputs_before(plant, registers_from(problem), self.before)
        return replace(problem, plant=plant)

    def begun(self, steps: tuple[Step, ...], initial: Mapping[str, Array]) -> dict[str, Array]:
        """Return initial values in which the memories of the input have the input before the start."""
        signals = {name for step in steps for name in assigned(step)} if self.before.any() else set[str]()
        names = [name for name in ("command", HELD, "input") if name in signals]  # fingerprints contain their order
        return {**dict.fromkeys(names, self.before), **initial}


def rest_of(problem: Discrete, controller: Controller) -> Rest:
    """Return the point at which a loop rests."""
    plant, r = problem.plant, controller.setpoint
    (n, m), p = plant.B.shape, plant.outputs
    state, steady, rest = np.zeros(n), np.zeros(m), np.zeros(len(controller.A))
    if problem.cost.mission and (r.any() or controller.start_input is not None):
        raise ProblemError(
            "a set-point or start_input is given, and the cost is a total over a horizon or with a discount; expected "
            "an average cost"
        )
    if r.any():
        seen = np.hstack([plant.C, np.zeros((p, m))]), -r[:, None]
        what = f"the plant cannot rest at the set-point {r.tolist()}"
        state, steady = _resting(plant.A, plant.B, state, seen, what)
        limit = plant.input_limit
        if limit is not None and ((steady <= limit[:, 0]) | (steady >= limit[:, 1])).any():
            raise beyond_limits(plant, steady)
        held = controller.C, -steady[:, None]
        what = "the controller does not hold the set-point, as it does not integrate"
        caused = np.asarray(controller.E @ steady, dtype=np.float64)
        rest, _ = _resting(controller.A, np.zeros((len(controller.A), 0)), caused, held, what)
        rest = rest + controller.rest
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
        "expected an input within the limits, as the plant had it before the start"
    )


def _bumpless(c: Controller, error: Array, command: Array) -> Array:
    """Return the state of the controller with a first command, at rest apart from its integrals."""
    left = np.eye(len(c.A)) - c.A - c.E @ c.C
    state = np.asarray(np.linalg.pinv(left) @ (c.B + c.E @ c.D) @ error, dtype=np.float64)
    _, sizes, rows = np.linalg.svd(left)
    integrals = rows[sizes < 1e-9].T
    state = state + integrals @ np.linalg.pinv(c.C @ integrals) @ (command - c.C @ state - c.D @ error)
    if np.abs(c.C @ state + c.D @ error - command).max() > RESTS * max(1.0, float(np.abs(command).max())):
        raise ProblemError("start_input is given, and not every input has an integral; expected an integral for each")
    return state


def _resting(A: Array, B: Array, push: Array, wanted: tuple[Array, Array], what: str) -> tuple[Array, Array]:
    """Return the smallest state and input at rest under a constant push; a solution of the regulator equations."""
    equations = Resting.of(A, B, np.eye(1), push[:, None], wanted)
    found = equations.smallest()
    if equations.missed(found) > RESTS * np.abs(equations.right).max(initial=0.0):
        raise ProblemError(f"{what}; expected a set-point that the loop holds, or none")
    state, steady = equations.split(found)
    return state[:, 0], steady[:, 0]
