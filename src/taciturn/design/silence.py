"""The rule "send when not sending costs more": relative to a base loop that sends every or every q-th sample.

In each step, the node that decides, the controller or the sensor, estimates the state, follows the controller's state
``register``, and computes the difference ``error`` = e between the value that the receiver uses in silence and the
choice, the value that a packet would carry (``base.route``). The value of the base (``base.value``) gives the cost
of silence, e'He + 2e'(slope) z. The node sends when this exceeds a price δ, so

    J ≤ J_base + δ (1 − rate).

* A controller of the user, over either link: ``send_for_given``. LQG over a horizon or with a discount, whose slope is
  zero: ``total_excess``.
* Over a link with bursts, the weights depend on the state of the channel. The node keeps its distribution, the
  ``belief``, by the acknowledgements, and the cost of silence is the mean over it (``cost_of_silence``).
* The theory assumes the model. An alarm watches it: the squares ν'S⁻¹ν of the innovations, averaged with exponential
  forgetting, exceed their 1 − 10⁻⁹ quantile only if the plant differs. Then, and after a packet that was not
  acknowledged (``retry``), silence is forbidden.
* If inputs have limits, the cost of silence is that of a forecast with them (``base/limited_value``). For the sensor
  link, links that drop packets with or without acknowledgement, slower bases, totals, and set-points at known times, it
  is the cost without limits, and silence is forbidden while a limit cuts the command. Over the sensor link, a forecast
  in which both choices reach the limit finds silence free, and the controller, which then integrates an old
  measurement, leaves its place for long. The same happens if a packet is dropped without acknowledgement.

``relative_to_state`` is LQG with thresholds that grow with the estimate.

Source: astrom2002, khashooei2017, schenato2009, antunes2014rollout
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, block_diagonal, choice, number, symmetrised
from taciturn._display import Displayed
from taciturn.base.certainty import (
    Actuation,
    certainty_policy,
    completed_square,
    control_steps,
    design_certainty,
)
from taciturn.base.filter import (
    CLOCK,
    DEVIATION,
    ESTIMATE,
    HELD,
    SEND,
    StepCounter,
    by_clock,
    count_ticks,
    estimate_state,
)
from taciturn.base.gains import price_control
from taciturn.base.given_controller import GivenLoop, SameControl, attempts_of, cost_of_base, lqg_observer
from taciturn.base.limited_value import COST, LimitedSilence
from taciturn.base.nominal import Nominal
from taciturn.base.route import (
    BY_PACKETS,
    CANDIDATE,
    MEASURED,
    REGISTER,
    Ahead,
    GivenRoute,
    nonempty,
    route_over,
)
from taciturn.base.route import Actuation as LoopActuation
from taciturn.base.value import Advantage, Attempts, Base, advantage, note_growth
from taciturn.design.bounds import LARGEST_PARAMETER, bound_by_attempts, bound_by_state
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.lqg.stored import controller_loop
from taciturn.model.controller import AnyController, Controller
from taciturn.model.cost import Cost
from taciturn.model.coverage import BURSTS, GAUSSIAN_THEORY
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.saturation import Saturation
from taciturn.model.signals import SampledChanges
from taciturn.model.steps import ONE, Acknowledged, Apply, Assign, Decide, Evaluate, Step
from taciturn.model.theory import INNOVATION, Identity, Theory
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger

BELIEF = "belief"
GOOD_OR_BAD = ("cost if good", "cost if bad")
SURPRISE = "surprise"  # how large innovations are, relative to their covariance: an average
WATCH = "watch"  # the decision with the outcomes expected and surprised
FORGOTTEN = 0.02  # weight of the newest innovation: the average extends over about 50 steps
FALSE_ALARMS = 1e-9  # probability that a step without any fault is surprised
MORE_PACKETS = "send more packets, or let a model predict the input between them (actuation)"
MISSING, WOULD, BEYOND, LIMIT = "missing", "command of a packet", "beyond limits", "limit"
COMING = "coming set-points"  # the slope that known changes of set-points add to the cost of silence


def send_for_given(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    kept: AnyController,
    price_at: Callable[[float], float],
    actuation: LoopActuation,
    link: str,
    network: Network,
    every: int,
    retry: bool = False,
    lqg: Controller | None = None,
) -> Policy:
    """Return the policy of a given controller that sends iff E[e'He + 2 e'(slope) z] > δ, given the measurements."""
    stated, loop = plant, GivenLoop.of(plant, cost, period, kept, lqg is not None)
    problem, controller = loop.problem, loop.controller
    plant, average = problem.plant, not problem.cost.mission
    choice("actuation", actuation, ("hold", "model", "zero"))
    lossy, unacknowledged = drops(network, link), unsure(network, link)
    timed = isinstance(plant.changes, SampledChanges)
    if timed and (lossy or every > 1 or not average):
        why = "the link drops packets" if lossy else f"every is {every}" if every > 1 else "the cost is a total"
        raise ProblemError(
            f"the set-points change at known times (reference.file), and {why}; expected an average cost, every = 1 "
            "and ideal links, or steps at random times (reference.steps)"
        )
    copied = actuation == "model" and (lossy or every > 1)
    if copied and not average:
        why = "the link drops packets" if lossy else f"every is {every}"
        raise ProblemError(
            f"actuation is 'model', {why}, and the cost has a horizon or a discount; expected an average cost, or "
            "actuation = 'hold', with which the receiver keeps its last value"
        )
    steady = problem.filter()
    if retry and (not lossy or every > 1):
        why = f"every is {every}" if lossy else "no packet is acknowledged and dropped"
        raise ProblemError(
            f"retry = true, but {why}; expected a link that drops packets and acknowledges the packets that arrive, "
            "and every = 1"
        )
    start = loop.point.start
    measured = {ESTIMATE: plant.C} if plant.full_state else {"prior": plant.C, INNOVATION: np.eye(plant.outputs)}
    oldest, sent_on = network.longest(link, problem.tick), steady if copied else None
    route = route_over(link, problem, controller, actuation, lossy, sent_on, start, measured, oldest=oldest)
    alone = route_over(link, problem, controller, actuation, False, steady) if actuation == "model" else route
    time, chain = StepCounter.of(problem, every), network.chain(link) if lossy else None
    attempts = attempts_of(problem, route.base, time.pattern, chain, network.lost(link))
    found = advantage(route.base, loop.remedy, attempts)
    overlap, slopes = loop.known_steps(route.base, found.P) if timed else (0.0, None)
    base = all_time = cost_of_base(problem, found, route.start, route.begun) + overlap
    if every > 1:
        used = controller if lqg is None else lqg
        known = steady if copied and lossy else None  # without losses, no prediction is ever used
        always = route_over(link, problem, used, actuation, lossy, known, start)
        always_found = _every_sample(problem, always.base, loop.remedy, chain, network.lost(link))
        all_time = cost_of_base(problem, always_found, always.start, always.begun)
    proved = None
    if every == 1 and not lossy and plant.changes is None:  # set-points that change last, and the proof sees them
        proved = controller_loop(problem, controller).cost()
        base = all_time = base if proved is None else proved.value
    price = price_at(base / problem.ticks)
    estimation = estimate_state(plant, steady, route.node, time.gains)

    # without losses, fair periodic control has the best gains of any cycle
    alike = lossy and lqg is not None and actuation != "model"
    held = HeldFor(kind, stated, cost, period, actuation, link, start) if alike else None
    silence = cost_of_silence(found, route, attempts, link, time.phases, problem.unit, slopes)
    # a packet during an alarm is one of the base only if the base sends every sample
    watched = time.innovation(steady) if every == 1 and not plant.full_state else None
    # above the price in any case, also if that is 0: then silence is never the least
    at, forbidden = route.node, 2 * price + base + 1
    clipped = tuple[Step, ...]()
    followed = link == "actuator" and every == 1 and average
    if plant.saturation is not None and followed and not (lossy or unacknowledged or timed):
        F = route.base.Phi + route.base.Gamma @ route.base.K
        limited = LimitedSilence.of(
            F, route.base.Gamma, route.base.K, found.H[0, 0], found.slope[0, 0], plant.saturation
        )
        foreseen = limited.step(at, route.state, CANDIDATE, "command")
        silence = replace(silence, cost=Form(plus={COST: 1.0}), before=(foreseen,))
    else:
        clipped = _at_limits(plant, controller, at)
    rule = silence.cost
    watch = () if watched is None else watch_innovations(INNOVATION, watched, at, plant.sensed)
    if watch:
        watch, rule = _unless(WATCH, watch, rule, forbidden)
    if clipped:  # the cost of silence assumes inputs without limits
        clipped, rule = _unless(LIMIT, clipped, rule, forbidden)
    again, follow = _retried(link, at) if retry else ((), ())
    if again:
        again, rule = _unless("retry", again, rule, forbidden)
    rules = Trigger({"silent": rule, SEND: Form(constant=price)})
    steps = route.steps(
        (*silence.before, *watch, *clipped, *again, Decide(route.node, SEND, rules)),
        (*silence.after, *follow, *estimation.predict),
    )
    steps, initial = (*estimation.correct, *steps), {**estimation.initial, **route.initial, **silence.initial}
    alike = average and every == 1 and not lossy  # the base is the linear loop with every sample
    finite = found.fourth is None or found.fourth < 1
    claims = Theory(
        cost_lqg=loop.cost_lqg,
        guarantee=bound_by_attempts(problem, base, price, every, lossy, loop.lqg) if finite else None,
        identity=Identity(problem.per_unit(base), silence.identity, SEND),
        covers=GAUSSIAN_THEORY | BURSTS if lossy else GAUSSIAN_THEORY,
        functions=frozenset({BELIEF, BEYOND, COST}),
        fourth=found.fourth,
        periodic=SameControl(loop, route.base if lossy else alone.base, attempts, held) if average else None,
        every=every,
    )
    nominal = loop.nominal(
        all_time,
        max(found.settling, 1 / (1 - steady.slowest)) if average else 0.0,
        route.base if alike else None,
        proved,
        slowest=steady.slowest,
        innovations=estimation.innovations,
    )
    notes = [] if lossy else loop.beside_lqg(all_time)
    return nominal.policy(
        kind,
        steps,
        loop.point.begun(steps, initial),
        claims,
        sites=route.sites,
        locations=time.locations if slopes is None else (count_ticks(len(slopes), 0),),
        network=network if lossy else None,
        notes=(*notes, *note_growth(route.base, attempts, loop.remedy), *loop.notes),
        unsure=unacknowledged,
    )


@dataclass(frozen=True, eq=False, repr=False)
class HeldFor(Displayed):
    """The base of LQG whose gains are optimal for an input that lasts for a number of steps, over a lossy link."""

    kind: str
    plant: Plant | ContinuousPlant
    cost: Cost
    period: float | None
    actuation: LoopActuation
    link: str
    start: Array  # state of the controller at the start

    def __call__(self, steps: int) -> Base:
        """Return the base for packets at every q-th step."""
        problem = discretise(self.plant, self.cost, self.period)
        observer = lqg_observer(self.kind, problem, steps, zero=self.actuation == "zero")
        other = GivenLoop.of(self.plant, self.cost, self.period, observer, True)
        return route_over(self.link, other.problem, other.controller, self.actuation, True, None, self.start).base


def total_excess(
    kind: str,
    problem: Discrete,
    actuation: Actuation,
    price_at: Callable[[float], float],
    unacknowledged: bool = False,
    ahead: Ahead = BY_PACKETS,
) -> Policy:
    """Return the policy that sends an input iff e'He > δ, for a cost with a horizon or a discount."""
    prices, counter, plant = price_control(problem), StepCounter.of(problem, 1), problem.plant
    found = counter.filter
    errors, start = (np.zeros((1, *plant.W.shape)), None if problem.cost.horizon else 0)
    if found is not None:
        errors, start = found.posterior, found.start
    cost = prices.total(errors, start)
    price = price_at(cost / problem.ticks)
    estimation = estimate_state(plant, None, gain=counter.gains)
    rule = Trigger({"silent": Form(("error",), by_clock(prices.H)), SEND: Form(constant=price)})
    steps, initial = control_steps(plant, estimation, by_clock(prices.L), actuation, rule, ahead=ahead)
    claims = Theory(
        guarantee=bound_by_attempts(problem, cost, price, 1, False),
        identity=completed_square(problem.per_unit(cost), prices.square()),
    )
    nominal = Nominal(problem, cost, 0.0)
    return nominal.policy(kind, steps, initial, claims, locations=counter.locations, unsure=unacknowledged)


def _every_sample(
    problem: Discrete, base: Base, remedy: str, chain: tuple[Array, Array] | None = None, key: str = "loss"
) -> Advantage:
    """Return the value of a base that attempts to send every sample."""
    pattern = (True,) * (problem.cost.horizon or 1)
    return advantage(base, remedy, attempts_of(problem, base, pattern, chain, key))


def drops(network: Network, link: str) -> bool:
    """Return whether a link drops some packets, and acknowledges the packets that arrive."""
    return network.acknowledges(link) and network.loss(link) > 0


def unsure(network: Network, link: str) -> bool:
    """Return whether a link drops some packets, and its sender never learns which."""
    return network.loss(link) > 0 and not network.acknowledges(link)


@dataclass(frozen=True, eq=False, repr=False)
class Silence(Displayed):
    """The cost of not sending as a form of a trigger, and the policy steps that compute the signals of this form."""

    cost: Form  # the cost of silence, at the decision
    identity: tuple[Form, Form]  # the cost beyond that of the base, in a silent step and in a step with a packet
    before: tuple[Step, ...] = ()  # policy steps before the decision
    after: tuple[Step, ...] = ()  # policy steps after the packet
    initial: Mapping[str, Array] = field(default_factory=lambda: {})  # initial values of the memories


def cost_of_silence(
    found: Advantage,
    route: GivenRoute,
    attempts: Attempts,
    link: str,
    phases: Sequence[int],
    unit: float,
    slopes: Array | None = None,
) -> Silence:
    """Compute the cost of not sending as a form, and the policy steps with which the deciding node evaluates it.

    ``slopes`` are those that known changes of set-points cause, (steps, c), one row for each step of the timetable.
    """
    n = found.slope.shape[-1]
    none = np.zeros((*found.H.shape[:2], n, n))
    whole: Any = np.block([[found.H, found.slope], [found.slope.swapaxes(2, 3), none]])  # type: ignore[arg-type]
    square: Array = whole[list(phases)]
    tried = np.array([attempts.pattern[phase] for phase in phases])
    signals = ("error", *route.state)
    if len(attempts.losses) == 1:
        values, identity, before = square[:, 0], signals, tuple[Step, ...]()
        if slopes is not None:
            c = slopes.shape[1]
            values, identity = np.pad(values, ((0, 0), (0, c), (0, c))), (*signals, COMING)
            values[:, :c, -c:] = values[:, -c:, :c] = np.eye(c)
            before = (Assign(route.node, COMING, {ONE: Scheduled(CLOCK, slopes[:, :, None])}),)
        silence = Silence(Form(identity, _by_clock(values)), (Form(), Form()), before)
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
    """Updates a node's probabilities of the channel states after each attempt to send, and predicts the next ones.

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


def watch_innovations(signal: str, covariance: Matrix, at: str, entries: int) -> tuple[Step, ...]:
    """Return policy steps that check whether the innovations of a filter are larger than the model predicts.

    Only the first ``entries`` count, those of measurements: set-points follow, and an operator may move them as he
    likes.
    """
    freedom = entries * (2 - FORGOTTEN) / FORGOTTEN  # of the chi-square distribution with the average's first moments
    limit = 2 * _scipy.gamma_quantile(freedom / 2, 1 - FALSE_ALARMS) * entries / freedom
    same, more = Form(plus={"alarms": 1.0}), Form(constant=1.0, plus={"alarms": 1.0})
    return (
        surprise(signal, covariance, at, entries),
        Decide(at, WATCH, Trigger({"expected": Form(plus={SURPRISE: 1.0}), "surprised": Form(constant=limit)})),
        Evaluate(at, "alarms", (same, more), WATCH),
    )


def surprise(signal: str, covariance: Matrix, at: str, entries: int) -> Evaluate:
    """Return the policy step that averages how large the innovations are, relative to their covariance."""
    return Evaluate(at, SURPRISE, (Form((signal,), _weight(covariance, entries), plus={SURPRISE: 1 - FORGOTTEN}),))


def _weight(covariance: Matrix, entries: int) -> Matrix:
    if isinstance(covariance, Scheduled):
        return Scheduled(covariance.by, _inverse(covariance.values, entries))
    return _inverse(covariance, entries)


def _inverse(covariance: Array, entries: int) -> Array:
    found = np.zeros_like(covariance)
    measured = covariance[..., :entries, :entries]
    found[..., :entries, :entries] = FORGOTTEN * np.linalg.pinv(measured, hermitian=True)
    return symmetrised(found)


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
    """Computes the part of a command that exceeds the limits of the actuator, and so is not applied."""

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
    """Design the policy that sends when the squared error |e|² exceeds the threshold σ²|x̂|² + Y²."""
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
