"""The rule "send when silence costs more", over a base that sends every sample or every q-th one.

In each step, the node that decides, the controller or the sensor, estimates the state, follows the controller's state
``register``, and computes the difference ``error`` = e between the value that the receiver uses in silence and the
choice, the value that a packet would carry (``base.receiver``). The value of the base (``base.value``) gives the cost
of silence, e'He + 2e'(slope) z. The node sends when this exceeds a price δ, so

    J ≤ J_base + δ (1 − rate).

* A controller of the user, over either link: ``keep_controller``. LQG over a horizon or with a discount, whose slope is
  zero: ``total_excess``. A packet in every step, without a decision: ``send_every_sample``.
* Over a link with bursts, the weights depend on the state of the channel. The node keeps its distribution, the
  ``belief``, by the acknowledgements, and the cost of silence is the mean over it (``cost_of_silence``).
* The theory assumes the model. An alarm watches it: the squares ν'S⁻¹ν of the innovations, averaged with exponential
  forgetting, exceed their 1 − 10⁻⁹ quantile only if the plant differs. Then, while an input is at a limit, and after
  a packet that was not acknowledged (``retry``), silence is forbidden.

``KeptLoop`` is the loop of a given controller at the step of the policy, with its slow disturbance and set-point; other
triggers of given controllers use it too. ``relative_to_state`` is LQG with thresholds that grow with the estimate.

Source: astrom2002, khashooei2017, schenato2009, antunes2014rollout
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, block_diagonal, choice, number, symmetrised
from taciturn._display import Displayed
from taciturn.base.anti_windup import within_limits
from taciturn.base.certainty import (
    Actuation,
    certainty_policy,
    completed_square,
    control_steps,
    design_certainty,
    error_per_unit,
)
from taciturn.base.filter import COLLOCATED, DEVIATION, ESTIMATE, HELD, SEND, StepCounter, by_clock, estimate_state
from taciturn.base.gains import price_control
from taciturn.base.given_controller import (
    Rest,
    SameControl,
    disturbed,
    note_disturbance,
    note_ringing,
    recovery,
    remedy_of,
    rest_of,
)
from taciturn.base.receiver import MEASURED, REGISTER, Route, actuator_base, nonempty, route_over
from taciturn.base.receiver import Actuation as LoopActuation
from taciturn.base.value import EVERY_SAMPLE, Advantage, Attempts, Base, advantage, note_growth
from taciturn.design.bounds import LARGEST_PARAMETER, bound_by_attempts, bound_by_errors, bound_by_state
from taciturn.errors import ProblemError, TaciturnError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.lqg.stored import controller_loop
from taciturn.model.controller import Controller, Kept, relative_to
from taciturn.model.cost import Cost
from taciturn.model.coverage import BURSTS, GAUSSIAN_THEORY, THEORY
from taciturn.model.disturbance import Disturbance
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.saturation import Saturation
from taciturn.model.steps import ONE, Acknowledged, Apply, Assign, Decide, Evaluate, Step
from taciturn.model.theory import INNOVATION, ErrorGain, Identity, Theory
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger, shape_of

BELIEF = "belief"
GOOD_OR_BAD = ("cost if good", "cost if bad")
WATCH = "watch"  # the decision with the outcomes expected and surprised
FORGOTTEN = 0.02  # weight of the newest innovation: the average extends over about 50 steps
FALSE_ALARMS = 1e-9  # probability that a step without any fault is surprised
MORE_PACKETS = "send more packets, or let a model predict the input between them (actuation)"
MISSING, WOULD, BEYOND, LIMIT = "missing", "command of a packet", "beyond limits", "limit"


def keep_controller(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    kept: Kept,
    price_at: Callable[[float], float],
    actuation: LoopActuation,
    link: str,
    network: Network,
    every: int,
    retry: bool = False,
    lqg: Controller | None = None,
) -> Policy:
    """Return the policy that sends iff E[e'He + 2 e'(slope) z] > δ, given the measurements, for a given controller."""
    loop = KeptLoop.of(plant, cost, period, kept, lqg is not None)
    problem, controller = loop.problem, loop.controller
    plant, average = problem.plant, not problem.cost.mission
    choice("actuation", actuation, ("hold", "model", "zero"))
    lossy = drops(network, link)
    copied = actuation == "model" and (lossy or every > 1)
    if copied and not average:
        why = "the link drops packets" if lossy else f"every is {every}"
        raise ProblemError(
            f"actuation is 'model', {why}, and the cost is a total; expected an average cost, or 'hold': the receiver "
            "keeps its last value"
        )
    steady = problem.filter()
    if retry and (not lossy or every > 1):
        why = f"every is {every}" if lossy else "no packet is acknowledged and dropped"
        raise ProblemError(f"retry is true, and {why}; expected an acknowledged link that drops packets, and every = 1")
    start = loop.point.start
    route = route_over(link, problem, controller, actuation, lossy, steady if copied else None, start)
    alone = route_over(link, problem, controller, actuation, False, steady) if actuation == "model" else route
    time, chain = StepCounter.of(problem, every), network.chain(link) if lossy else None
    attempts = _attempts(problem, route.base, time.pattern, chain, network.lost(link))
    found = advantage(route.base, loop.remedy, attempts)
    base = all_time = _cost(problem, found, route)
    if every > 1:
        used = controller if lqg is None else lqg
        known = steady if copied and lossy else None  # without losses, no prediction is ever used
        always = route_over(link, problem, used, actuation, lossy, known, start)
        all_time = _cost(problem, _every_sample(problem, always.base, loop.remedy, chain, network.lost(link)), always)
    proved = None
    if every == 1 and not lossy:
        proved = controller_loop(problem, controller).cost()
        base = all_time = base if proved is None else proved.value
    price = price_at(base / problem.ticks)
    estimation = estimate_state(plant, steady, route.node, time.gains)
    silence = cost_of_silence(found, route, attempts, link, time.phases, problem.unit)
    # a packet during an alarm is one of the base only if the base sends every sample
    watched = time.innovation(steady) if every == 1 and not plant.full_state else None
    # above the price in any case, also if that is 0: then silence is never the least
    at, forbidden, rule = route.node, 2 * price + base + 1, silence.cost
    watch = () if watched is None else watch_innovations(INNOVATION, watched, at)
    if watch:
        watch, rule = _unless(WATCH, watch, rule, forbidden)
    clipped = _at_limits(plant, controller, at)
    if clipped:  # the cost of silence assumes inputs without limits
        clipped, rule = _unless(LIMIT, clipped, rule, forbidden)
    again, follow = _retried(link, at) if retry else ((), ())
    if again:
        again, rule = _unless("retry", again, rule, forbidden)
    output = {"prior": plant.C, INNOVATION: np.eye(plant.outputs)}
    steps = route.steps(
        {ESTIMATE: plant.C} if plant.full_state else output,
        (
            *silence.before,
            *watch,
            *clipped,
            *again,
            Decide(route.node, SEND, Trigger({"silent": rule, SEND: Form(constant=price)})),
        ),
        (*silence.after, *follow, *estimation.predict),
    )
    alike = average and every == 1 and not lossy  # the base is the linear loop with every sample
    finite = found.fourth is None or found.fourth < 1
    theory = Theory(
        cost=problem.cost,
        cost_all_time=problem.per_unit(all_time),
        cost_all_time_error=None if proved is None else error_per_unit(problem, proved),
        cost_lqg=loop.cost_lqg,
        noise_cost=problem.noise_cost,
        settling=max(found.settling, 1 / (1 - steady.slowest)) if average else 0.0,
        recovery=recovery(route.base, plant, loop.disturbance, steady.slowest) if alike else None,
        guarantee=bound_by_attempts(problem, base, price, every, lossy, loop.lqg) if finite else None,
        identity=Identity(problem.per_unit(base), silence.identity, SEND),
        innovations=estimation.innovations,
        covers=(THEORY if plant.full_state else GAUSSIAN_THEORY) | (BURSTS if lossy else frozenset[str]()),
        functions=frozenset({BELIEF, BEYOND}),
        fourth=found.fourth,
        periodic=SameControl(problem, kept, alone.base) if average and not lossy else None,
        every=every,
    )
    policy = Policy(
        kind=kind,
        steps=(*estimation.correct, *steps),
        model=plant,
        theory=theory,
        sites=route.sites,
        locations=time.locations,
        initial={**estimation.initial, **route.initial, **silence.initial},
        network=network if lossy else Network(),
        tick=problem.tick,
        notes=(
            *([] if lossy else loop.beside_lqg(all_time)),
            *note_growth(route.base, attempts, loop.remedy),
            *loop.notes,
        ),
        disturbance=loop.disturbance,
    )
    return loop.carried_out(policy)


def send_every_sample(
    kind: str, plant: Plant | ContinuousPlant, cost: Cost, period: float | None, kept: Kept, link: str = "actuator"
) -> Policy:
    """Return the loop of a given controller with a packet at every sample.

    No node decides, so none needs a filter, and the plant need not be detectable.
    """
    loop = KeptLoop.of(plant, cost, period, kept)
    problem, average = loop.problem, not loop.problem.cost.mission
    plant = problem.plant
    route = route_over(link, problem, loop.controller, "hold", False, start=loop.point.start)
    found, proved = _every_sample(problem, route.base, loop.remedy), controller_loop(problem, loop.controller).cost()
    always = Decide(route.node, SEND, Trigger({"silent": Form(constant=1.0), SEND: Form()}))
    policy = Policy(
        kind=kind,
        steps=route.steps({"y": np.eye(plant.outputs)}, (always,), ()),
        model=plant,
        theory=Theory(
            cost=problem.cost,
            cost_all_time=problem.per_unit(_cost(problem, found, route) if proved is None else proved.value),
            cost_all_time_error=None if proved is None else error_per_unit(problem, proved),
            noise_cost=problem.noise_cost,
            settling=found.settling,
            recovery=recovery(route.base, plant, loop.disturbance) if average else None,
        ),
        sites=route.sites,
        initial=route.initial,
        tick=problem.tick,
        disturbance=loop.disturbance,
    )
    return loop.carried_out(policy)


def total_excess(kind: str, problem: Discrete, actuation: Actuation, price_at: Callable[[float], float]) -> Policy:
    """Return the policy that sends an input iff e'He > δ, with the gains and weights of each step."""
    prices, counter, plant = price_control(problem), StepCounter.of(problem, 1), problem.plant
    found = counter.filter
    errors, start = (np.zeros((1, *plant.W.shape)), None if problem.cost.horizon else 0)
    if found is not None:
        errors, start = found.posterior, found.start
    cost = prices.total(errors, start)
    price = price_at(cost / problem.ticks)
    estimation = estimate_state(plant, None, gain=counter.gains)
    rule = Trigger({"silent": Form(("error",), by_clock(prices.H)), SEND: Form(constant=price)})
    steps, initial = control_steps(plant, estimation, by_clock(prices.L), actuation, rule)
    policy = Policy(
        kind=kind,
        steps=steps,
        model=plant,
        theory=Theory(
            cost=problem.cost,
            cost_all_time=problem.per_unit(cost),
            noise_cost=problem.noise_cost,
            guarantee=bound_by_attempts(problem, cost, price, 1, False),
            identity=completed_square(problem.per_unit(cost), prices.square()),
            covers=THEORY if plant.full_state else GAUSSIAN_THEORY,
        ),
        sites=COLLOCATED,
        locations=counter.locations,
        initial=initial,
        tick=problem.tick,
    )
    return within_limits(policy)


@dataclass(frozen=True, eq=False, repr=False)
class KeptLoop(Displayed):
    """A given controller and its plant in deviations from the point at which they rest."""

    kept: Kept  # the controller, which may depend on the step, its set-points relative to the plant's operating point
    controller: Controller  # the controller at the step
    problem: Discrete  # the discrete-time problem of the deviations, with the slow disturbance
    point: Rest  # the point at which the loop rests
    disturbance: Disturbance | None  # the slow disturbance, or None
    lqg: bool = False  # whether the controller is LQG with the weights of the cost, and not one that a user has

    @staticmethod
    def of(plant: Plant | ContinuousPlant, cost: Cost, period: float | None, kept: Kept, lqg: bool = False) -> KeptLoop:
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
        return KeptLoop(kept, controller, point.deviations(problem), point, disturbance, lqg)

    def carried_out(self, policy: Policy) -> Policy:
        """Return a policy with the start of the controller and with the limits of the inputs."""
        return within_limits(self.point.begun(policy))

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

    def policy(
        self,
        kind: str,
        base: Base,
        steps: tuple[Step, ...],
        sites: tuple[frozenset[str], ...],
        initial: dict[str, Array],
        network: Network | None = None,
        errors: Mapping[str, ErrorGain] | None = None,
        functions: frozenset[str] = frozenset(),
    ) -> Policy:
        """Return a policy without a proven bound, or with the certificate that follows from the errors of its links."""
        found, problem = advantage(base, self.remedy), self.problem
        theory = Theory(
            cost=problem.cost,
            cost_all_time=problem.per_unit(found.cost),
            cost_lqg=self.cost_lqg,
            noise_cost=problem.noise_cost,
            settling=found.settling,
            guarantee=bound_by_errors(problem, found.cost, errors) if errors else None,
            errors=errors or {},
            functions=functions,
            recovery=recovery(base, problem.plant, self.disturbance),
            periodic=SameControl(problem, self.kept, base),
        )
        return self.carried_out(
            Policy(
                kind=kind,
                steps=steps,
                model=problem.plant,
                theory=theory,
                sites=sites,
                initial=initial,
                tick=problem.tick,
                notes=(*self.beside_lqg(found.cost), *self.notes),
                disturbance=self.disturbance,
                network=Network() if network is None else network,
            )
        )


def _attempts(
    problem: Discrete,
    base: Base,
    pattern: tuple[bool, ...],
    chain: tuple[Array, Array] | None = None,
    key: str = "loss",
) -> Attempts:
    """Return the attempts of the base over a link with the law ``chain``, with the weight of the final state."""
    turns, losses = (EVERY_SAMPLE.turns, EVERY_SAMPLE.losses) if chain is None else chain
    cost, terminal = problem.cost, None
    if cost.terminal is not None:
        terminal = np.pad(cost.terminal, (0, len(base.Phi) - len(cost.terminal)))
    return Attempts(pattern, turns, losses, cost.discount, terminal, key)


def _cost(problem: Discrete, found: Advantage, route: Route) -> float:
    """Return the cost of a base: per step, or in total with the mean of w'P w at the first step, w = (z, h).

    There z contains the random state of the plant, the state with which the controller starts, and the first
    measurement; h is the value with which the receiver starts. All are a mean plus what x − E x and the noise v add.
    """
    if not problem.cost.mission:
        return found.cost
    plant = problem.plant
    mean = np.concatenate([plant.mean, route.start, plant.C @ plant.mean, route.begun])
    state, noise = np.zeros((len(mean), plant.states)), np.zeros((len(mean), plant.outputs))
    place = plant.states + len(route.start)
    measured = slice(place, place + plant.outputs)
    state[: plant.states], state[measured], noise[measured] = np.eye(plant.states), plant.C, np.eye(plant.outputs)
    moment = np.outer(mean, mean) + state @ plant.covariance @ state.T + noise @ plant.V @ noise.T
    return found.cost + float(np.sum(found.P * moment))


def _every_sample(
    problem: Discrete, base: Base, remedy: str, chain: tuple[Array, Array] | None = None, key: str = "loss"
) -> Advantage:
    """Return the value of a base that attempts to send every sample."""
    pattern = (True,) * (problem.cost.horizon or 1)
    return advantage(base, remedy, _attempts(problem, base, pattern, chain, key))


def drops(network: Network, link: str) -> bool:
    """Return whether a link drops packets and acknowledges those that arrive."""
    return network.acknowledges(link) and network.loss(link) > 0


@dataclass(frozen=True, eq=False, repr=False)
class Silence(Displayed):
    """The cost of silence, and the policy steps that it needs."""

    cost: Form  # the cost of silence, at the decision
    identity: tuple[Form, Form]  # the cost beyond that of the base, in a silent step and in a step with a packet
    before: tuple[Step, ...] = ()  # policy steps before the decision
    after: tuple[Step, ...] = ()  # policy steps after the packet
    initial: Mapping[str, Array] = field(default_factory=lambda: {})  # initial values of the memories


def cost_of_silence(
    found: Advantage, route: Route, attempts: Attempts, link: str, phases: Sequence[int], unit: float
) -> Silence:
    """Return the cost of silence for the node that decides."""
    n = found.slope.shape[-1]
    none = np.zeros((*found.H.shape[:2], n, n))
    whole: Any = np.block([[found.H, found.slope], [found.slope.swapaxes(2, 3), none]])  # type: ignore[arg-type]
    square: Array = whole[list(phases)]
    tried = np.array([attempts.pattern[phase] for phase in phases])
    signals = ("error", *route.state)
    if len(attempts.losses) == 1:
        values, identity = square[:, 0], signals
        silence = Silence(Form(signals, _by_clock(values)), (Form(), Form()))
    else:
        states = range(len(attempts.losses))
        names = GOOD_OR_BAD if len(states) == 2 else tuple(f"cost in state {m}" for m in states)
        forms = [Form(signals, _by_clock(square[:, m])) for m in states]
        half = 0.5 * np.eye(len(states))
        product = np.block([[0.0 * half, half], [half, 0.0 * half]])  # of the belief and the costs
        values, identity = np.tile(product, (len(phases), 1, 1)), (BELIEF, *names)
        known = (({ONE: np.zeros((1, 1))}, {ONE: np.ones((1, 1))}),) * 2
        silence = Silence(
            Form(identity, values[0]),
            (Form(), Form()),
            (
                # first the update by the previous step, so that decision and identity read the same belief
                Apply(
                    route.node,
                    {BELIEF: len(states)},
                    ChannelBelief(attempts.turns, attempts.losses, attempts.start),
                    (BELIEF, "attempted", "arrived"),
                ),
                *(Evaluate(route.node, name, (form,)) for name, form in zip(names, forms, strict=True)),
            ),
            (
                Assign(route.node, "attempted", known[0], SEND),
                Assign(route.node, "arrived", known[1], Acknowledged(link)),
            ),
            {BELIEF: attempts.start},
        )
    here = values / unit
    saved = Form() if tried.all() else Form(identity, _by_clock(np.where(tried[:, None, None], 0.0, -here)))
    added = Form(identity, _by_clock(np.where(tried[:, None, None], here, 0.0)))
    return replace(silence, identity=(added, saved))


@dataclass(frozen=True, eq=False, repr=False)
class ChannelBelief(Displayed):
    """The update of the distribution of the channel state by the fate of an attempt, and by a step of the channel.

    After a fate that the law excludes, such as an acknowledgement that a fault has lost, it begins again at ``start``.
    """

    turns: Array
    losses: Array
    start: Array

    def __call__(self, belief: Any, attempted: Any, arrived: Any) -> Any:
        """Return the distribution at the next step; ``attempted`` and ``arrived`` are 0 or 1."""
        a, r, p = attempted[0], arrived[0], self.losses
        likelihood = 1.0 - a + a * (r * (1.0 - p) + (1.0 - r) * p)
        weights = belief * likelihood
        total = sum(weights[i] for i in range(len(p)))
        known = np.where(total > 0.0, weights / np.where(total > 0.0, total, 1.0), self.start)
        return self.turns.T @ known


def _by_clock(values: Array) -> Any:
    return by_clock(values[0] if len(values) == 1 else values)


def _unless(decision: str, before: tuple[Step, ...], silent: Form, forbidden: float) -> tuple[tuple[Step, ...], Form]:
    """Return the steps of a decision whose other options than the first forbid silence, and the cost of silence."""
    made = next(step for step in before if isinstance(step, Decide) and step.decision == decision)
    name = f"cost after {decision}" if silent.Psi is None else "cost of silence"
    others = [Form(constant=forbidden)] * (len(made.trigger.options) - 1)
    return (*before, Evaluate(made.at, name, (silent, *others), decision)), Form(plus={name: 1.0})


def watch_innovations(signal: str, covariance: Matrix, at: str) -> tuple[Step, ...]:
    """Return the policy steps that decide whether the innovations are as expected; they follow the filter's."""
    entries = shape_of(covariance)[0]
    freedom = entries * (2 - FORGOTTEN) / FORGOTTEN  # of the chi-square distribution with the average's first moments
    limit = 2 * _scipy.gamma_quantile(freedom / 2, 1 - FALSE_ALARMS) * entries / freedom
    averaged = Form((signal,), _weight(covariance), plus={"surprise": 1 - FORGOTTEN})
    same, more = Form(plus={"alarms": 1.0}), Form(constant=1.0, plus={"alarms": 1.0})
    return (
        Evaluate(at, "surprise", (averaged,)),
        Decide(at, WATCH, Trigger({"expected": Form(plus={"surprise": 1.0}), "surprised": Form(constant=limit)})),
        Evaluate(at, "alarms", (same, more), WATCH),
    )


def _weight(covariance: Matrix) -> Matrix:
    if isinstance(covariance, Scheduled):
        return Scheduled(covariance.by, _inverse(covariance.values))
    return _inverse(covariance)


def _inverse(covariance: Array) -> Array:
    return symmetrised(FORGOTTEN * np.asarray(np.linalg.pinv(covariance, hermitian=True), dtype=np.float64))


def _at_limits(plant: Plant, controller: Controller, at: str) -> tuple[Step, ...]:
    """Return the steps that decide whether an actuator cannot apply the command that a packet causes."""
    if plant.saturation is None:
        return ()
    limits, m = plant.saturation, plant.inputs
    beyond = {f"input {i + 1} limited": Form((BEYOND,), -np.diag(row)) for i, row in enumerate(np.eye(m))}
    return (
        Assign(at, WOULD, nonempty({REGISTER: controller.C, MEASURED: controller.D})),
        Apply(at, {BEYOND: m}, Beyond(limits), (WOULD, HELD) if limits.moves else (WOULD,)),
        Decide(at, LIMIT, Trigger({"within": Form(), **beyond})),
    )


@dataclass(frozen=True, eq=False, repr=False)
class Beyond(Displayed):
    """The part of a command that an actuator with limits does not apply."""

    limits: Saturation

    def __call__(self, wanted: Any, before: Any = None) -> Any:
        """Return the command minus the input that is applied."""
        return wanted - self.limits(wanted, before)


def _retried(link: str, at: str) -> tuple[tuple[Step, ...], tuple[Step, ...]]:
    """Return the steps that decide whether the last packet was acknowledged, and those that remember it."""
    none, one = np.zeros((1, 1)), np.ones((1, 1))
    # the signal is 0 or 1, so it is the least up to 0.5
    missing = Trigger({"arrived": Form(plus={MISSING: 1.0}), "missing": Form(constant=0.5)})
    after = (
        Assign(at, "tried", ({ONE: none}, {ONE: one}), SEND),
        Assign(at, MISSING, ({"tried": one}, {ONE: none}), Acknowledged(link)),
    )
    return (Decide(at, "retry", missing),), after


def relative_to_state(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    sigma: float,
    threshold: float,
    period: float | None,
    actuation: Actuation,
    source: str,
) -> Policy:
    """Return the policy that sends when the squared error |e|² exceeds the threshold σ²|x̂|² + Y²."""
    sigma = number("sigma", sigma, 0.0, LARGEST_PARAMETER, closed=True)
    threshold = number("threshold", threshold, 0.0, LARGEST_PARAMETER, closed=True)
    problem = discretise(plant, cost, period)
    certainty, unit = design_certainty(kind, problem), problem.weight()
    silent = Form((DEVIATION, ESTIMATE), block_diagonal(unit, -(sigma**2) * unit))
    rule = Trigger({"silent": silent, SEND: Form(constant=threshold**2)})
    steps, initial = control_steps(problem.plant, certainty.estimation, certainty.regulator.L, actuation, rule)
    guarantee, notes = bound_by_state(certainty, sigma, threshold, source)
    return certainty_policy(
        kind,
        certainty,
        steps,
        initial,
        identity=certainty.completed_square(),
        guarantee=guarantee,
        reset=certainty.reset(actuation),
        notes=notes,
    )
