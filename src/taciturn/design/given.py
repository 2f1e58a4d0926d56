"""Event-triggered control with a given linear controller, which sends when silence would cost too much.

In each step, the sensor measures. The node that decides, the controller or the sensor itself, filters the measurement,
follows the controller's state ``register``, and decides on the difference ``error`` between the value that the receiver
uses in silence and the choice, the value that a packet would carry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from taciturn._arrays import Array, choice
from taciturn._display import Displayed
from taciturn.design.alarm import WATCH, watch_innovations
from taciturn.design.base import Base, advantage, least_value
from taciturn.design.certainty import CLOCK, SEND, Actuation, count_ticks, design_certainty, expect_average
from taciturn.design.estimation import ESTIMATE, FilterSteps, estimate_state
from taciturn.design.losses import ChannelBelief, lossy_advantage
from taciturn.design.periodic_base import periodic_advantage
from taciturn.design.routes import (
    CANDIDATE,
    MEASURED,
    NEXT,
    REGISTER,
    actuator_base,
    over_actuator_link,
    over_sensor_link,
)
from taciturn.design.same_control import SameControl
from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.lqg.kalman import filter_checked
from taciturn.model.controller import Controller, Kept
from taciturn.model.cost import Cost
from taciturn.model.coverage import BURSTS, GAUSSIAN_THEORY, SIMULATED, THEORY
from taciturn.model.disturbance import Disturbance, padded
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import ONE, Acknowledged, Apply, Assign, Decide, Evaluate, LinkName, NodeName, Policy, Step
from taciturn.model.theory import Guarantee, Identity, Theory
from taciturn.model.trigger import Form, Scheduled, Trigger

WITH_EVERY, WITH_ATTEMPTS = (
    f"J ≤ J_all + δ(1 − rate), J_all the cost of this controller with {every}, δ the most that silence adds on average"
    for every in ("every sample", "an attempt to send every sample")
)
SILENCE, BELIEF = "cost of silence", "belief"
CONSTANT = (
    "the controller integrates, and the plant has no slow disturbance: a constant disturbance would make silence cost "
    "more than computed"
)
REMEDY = "check the sign of the controller (feedback is u = −K y), its gains and its step"


def keep_controller(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    kept: Kept,
    price_at: Callable[[float], float],
    actuation: Actuation,
    link: LinkName,
    network: Network,
    every: int,
) -> Policy:
    """Return the policy that sends iff E[e'He + 2 e'(slope) z] > δ, given the measurements, for a given controller.

    Args:
        kind: name of the policy kind.
        plant: the plant, without the slow disturbance that the controller compensates.
        cost: the average cost.
        period: seconds between steps; only with a continuous plant.
        kept: the controller.
        price_at: function that returns δ per step, given the cost of sending every sample per step.
        actuation: in silence, the receiver keeps the last value (``"hold"``) or predicts it (``"model"``).
        link: ``"actuator"``: packets carry inputs; ``"sensor"``: packets carry measurements.
        network: the network; losses of the link must be acknowledged.
        every: q, the number of steps between packets of the base.

    Raises:
        ProblemError: the controller does not suit the plant, or the cost is not an average.
        UnstableError: the loop that sends every sample is unstable.
    """
    expect_average(kind, cost)
    problem, controller, disturbance = disturbed(plant, cost, period, kept)
    plant = problem.plant
    model = choice("actuation", actuation, ("hold", "model")) == "model"
    choice("link", link, ("actuator", "sensor"))
    lossy = drops(network, link)
    if model and (lossy or every > 1):
        why = "the link drops packets" if lossy else f"every is {every}"
        raise ProblemError(f"actuation is 'model', and {why}; expected 'hold': the receiver keeps its last value")
    if lossy and every > 1:
        raise ProblemError(f"every is {every}, and the link drops packets; expected every = 1, or no losses")
    route = (over_actuator_link if link == "actuator" else over_sensor_link)(problem, controller, model, lossy)
    at, k, steady = route.node, len(controller.A), filter_checked(plant.A, plant.C, plant.W, plant.V)
    estimation = estimate_state(plant, steady, at)
    if every > 1:
        found = _at_sends(route.base, every, k)
    else:
        found = _over_losses(route.base, network, link, at, k) if lossy else _over_ideal(route.base, k)
    price = price_at(found.cost)
    # a packet during an alarm is one of the base only if the base sends every sample
    watch, rule = _watched(estimation if every == 1 else None, found.silence, 2 * price + found.cost + 1, at)
    output = {"prior": plant.C, "innovation": np.eye(plant.outputs)}
    if estimation.innovations is None:
        output = {ESTIMATE: plant.C}
    unit = np.eye(len(route.base.K))
    steps: tuple[Step, ...] = (
        *estimation.correct,
        Assign(at, MEASURED, output),
        *((Assign(at, REGISTER, {NEXT: np.eye(k)}),) if k else ()),  # the state of this step, which P refers to
        *route.before,
        Assign(at, "error", {CANDIDATE: unit, route.choice: -unit}),
        *found.before,
        *watch,
        Decide(at, SEND, Trigger({"silent": rule, SEND: Form(constant=price)})),
        *route.after,
        *found.after,
        *estimation.predict,
    )
    theory = Theory(
        cost=problem.cost,
        cost_all_time=problem.per_unit(found.all_time),
        noise_cost=problem.noise_cost,
        settling=max(found.settling, 1 / (1 - steady.slowest)),
        guarantee=None
        if found.fourth is not None and found.fourth >= 1
        else Guarantee(
            problem.per_unit(found.cost + price / every),
            found.statement,
            "antunes2014rollout",
            problem.per_unit(found.cost + price * (1 / every - 1)),
            price / problem.tick,
        ),
        identity=Identity(
            problem.per_unit(found.cost), tuple(_scaled(form, 1 / problem.tick) for form in found.forms), SEND
        ),
        innovations=estimation.innovations,
        covers=(THEORY if plant.full_state else GAUSSIAN_THEORY) | (BURSTS if lossy else frozenset[str]()),
        functions=frozenset({BELIEF}),
        fourth=found.fourth,
        periodic=None if lossy else SameControl(problem, kept, route.base, steady if model else None),
    )
    return Policy(
        kind=kind,
        steps=steps,
        model=plant,
        theory=theory,
        sites=route.sites,
        locations=() if every == 1 else (count_ticks(every, 0),),
        initial={**estimation.initial, **route.initial, **found.initial},
        network=network if lossy else Network(),
        tick=problem.tick,
        notes=(*(() if lossy else _beside(kind, problem, found.all_time)), *_assumed(controller, disturbance)),
        disturbance=disturbance,
    )


def cost_as_kept(plant: Plant | ContinuousPlant, kept: Kept, period: float | None = None) -> Cost:
    """Return the cost for which the present variances of all outputs and inputs count equally, with every sample.

    Args:
        plant: the plant, without the slow disturbance that the controller compensates.
        kept: the controller.
        period: seconds between steps; only with a continuous plant.

    Raises:
        UnstableError: the loop is unstable, or a variance is infinite.
        ProblemError: an output or an input does not move.
    """
    usual = Cost(np.eye(plant.states), np.eye(plant.inputs))
    problem, controller, _ = disturbed(plant, usual, period, kept)
    base = actuator_base(problem, controller)
    F, n = base.Phi + base.Gamma @ base.K, plant.states
    rows = {"output_variance": np.pad(plant.C, ((0, 0), (0, len(F) - n))), "input_variance": base.K}
    found: dict[str, list[float]] = {}
    for name, signals in rows.items():
        found[name] = []
        for number, row in enumerate(signals, 1):
            P, slowest = least_value(F, row[:, None] * row)
            variance = float(np.sum(P * base.noise))
            if slowest >= 1:
                raise UnstableError(f"the loop that sends every sample is not stable; expected a stable loop: {REMEDY}")
            if variance <= 0:
                raise ProblemError(
                    f"{name.partition('_')[0]} {number} has no variance in the loop with every sample; expected noise "
                    "that moves it, or output_variance and input_variance in place of weights"
                )
            found[name].append(variance)
    return Cost.of_variances(plant.C, **found)


def disturbed(
    plant: Plant | ContinuousPlant, cost: Cost, period: float | None, kept: Kept
) -> tuple[Discrete, Controller, Disturbance | None]:
    """Return the discrete-time problem with the slow disturbance, the controller at its step, and the disturbance."""
    problem = discretise(plant, cost, period)
    controller = kept.at(problem.plant.dt, problem.plant.inputs, problem.plant.outputs)
    SIMULATED.check(controller)
    disturbance = controller.expected
    if disturbance is not None:
        disturbance = disturbance.completed(plant, period)
        problem = discretise(disturbance.added_to(plant), padded(cost, problem.plant.inputs), period)
    return problem, controller, disturbance


def lqg_observer(kind: str, problem: Discrete, every: int = 1) -> Controller:
    """Return LQG control as a controller, whose observer uses the input that was applied.

    Its gain is optimal for a packet at every q-th step, and a held input.
    """
    certainty, plant = design_certainty(kind, problem), problem.plant
    L = certainty.regulator.L if every == 1 else certainty.held.solve((every,)).gains[0]
    gain, none = certainty.filter.gain, Disturbance(deviation=0.0)
    if plant.full_state:
        n, m = plant.B.shape
        return Controller(np.zeros((0, 0)), np.zeros((0, n)), np.zeros((m, 0)), L, None, plant.dt, none)
    left = np.eye(plant.states) - gain @ plant.C
    return Controller(plant.A @ left, plant.A @ gain, L @ left, L @ gain, plant.B, plant.dt, none)


@dataclass(frozen=True, eq=False, repr=False)
class _Silence(Displayed):
    """The cost of silence as a form, the steps that it needs, and the cost of the base.

    ``all_time`` is the cost with every sample. The identity has the form ``silent`` in silence (default: ``silence``),
    and ``more`` at a packet.
    """

    silence: Form
    cost: float
    settling: float
    all_time: float
    statement: str
    silent: Form | None = None
    more: Form | None = None
    fourth: float | None = None
    before: tuple[Step, ...] = ()
    after: tuple[Step, ...] = ()
    initial: Mapping[str, Array] = field(default_factory=lambda: {})

    @property
    def forms(self) -> tuple[Form, Form]:
        """The forms of the identity, in silence and at a packet."""
        return self.silent or self.silence, self.more or Form()


def drops(network: Network, link: LinkName) -> bool:
    """Return whether a link drops packets and acknowledges those that arrive."""
    return network.protocol == "tcp" and network.loss(link) > 0


def _over_ideal(base: Base, k: int) -> _Silence:
    """Return the cost of silence e'He + 2e'(slope)z over a link without losses."""
    found = advantage(base, REMEDY)
    n = found.slope.shape[1]
    square = np.block([[found.H, found.slope], [found.slope.T, np.zeros((n, n))]])
    return _Silence(Form(("error", *_state(k)), square), found.cost, found.settling, found.cost, WITH_EVERY)


def _over_losses(base: Base, network: Network, link: LinkName, at: NodeName, k: int) -> _Silence:
    """Return the cost of silence over an acknowledged link; with bursts, it depends on the belief about the channel."""
    turns, losses = network.chain(link)
    found = lossy_advantage(base, turns, losses, REMEDY)
    forms = [Form((*_state(k), CANDIDATE), weight) for weight in found.silence]
    if len(forms) == 1:
        return _Silence(forms[0], found.cost, found.settling, found.cost, WITH_ATTEMPTS, fourth=found.fourth)
    names = ("cost if good", "cost if bad")
    means = np.zeros((4, 4))
    means[0, 2] = means[2, 0] = means[1, 3] = means[3, 1] = 0.5
    told = (({ONE: np.zeros((1, 1))}, {ONE: np.ones((1, 1))}),) * 2
    return _Silence(
        Form((BELIEF, *names), means),
        found.cost,
        found.settling,
        found.cost,
        WITH_ATTEMPTS,
        fourth=found.fourth,
        before=tuple(Evaluate(at, name, (form,)) for name, form in zip(names, forms, strict=True)),
        after=(
            Assign(at, "attempted", told[0], SEND),
            Assign(at, "arrived", told[1], Acknowledged(link)),
            Apply(at, {BELIEF: 2}, ChannelBelief(turns, losses), (BELIEF, "attempted", "arrived")),
        ),
        initial={BELIEF: found.start},
    )


def _at_sends(base: Base, every: int, k: int) -> _Silence:
    """Return the cost of silence for a base that sends at every q-th step."""
    found, signals = periodic_advantage(base, every, REMEDY), (*_state(k), CANDIDATE)
    first = (np.arange(every) == 0)[:, None, None]
    return _Silence(
        Form(signals, Scheduled(CLOCK, found.silence)),
        found.cost,
        found.settling,
        advantage(base, REMEDY).cost,
        "J ≤ J_q + δ(1/q − rate), J_q the cost of this controller with a packet at every q-th step, and the rate per "
        "step",
        Form(signals, Scheduled(CLOCK, np.where(first, found.silence, 0.0))),
        Form(signals, Scheduled(CLOCK, np.where(first, 0.0, -found.silence))),
    )


def _scaled(form: Form, factor: float) -> Form:
    """Return a form times a factor."""
    if form.Psi is None:
        return form
    Psi = form.Psi
    scaled = Scheduled(Psi.by, factor * Psi.values) if isinstance(Psi, Scheduled) else factor * np.asarray(Psi)
    return Form(form.signals, scaled)


def _state(registers: int) -> tuple[str, ...]:
    """Return the signals of z, the state of plant, controller and measurement."""
    return (ESTIMATE, *((REGISTER,) if registers else ()), MEASURED)


def _watched(
    estimation: FilterSteps | None, silent: Form, forbidden: float, at: NodeName
) -> tuple[tuple[Step, ...], Form]:
    """Return the steps of the alarm, and the cost of silence, which is ``forbidden`` during an alarm."""
    if estimation is None or estimation.innovations is None:  # a measured state needs no model
        return (), silent
    steps = watch_innovations(estimation.innovations, at)
    return (
        *steps,
        Evaluate(at, SILENCE, (silent, Form(constant=forbidden)), WATCH),
    ), Form(plus={SILENCE: 1.0})


def _assumed(controller: Controller, disturbance: Disturbance | None) -> tuple[str, ...]:
    """Return a note on the slow disturbance of the plant."""
    if disturbance is None:
        return (CONSTANT,) if controller.integrates else ()
    stated = controller.disturbance or Disturbance()
    missing = [name for name in ("time_constant", "deviation") if getattr(stated, name) is None]
    source = f" ({' and '.join(missing)} by default, from the step, W and B)" if missing else ""
    return (f"the plant has a slowly varying disturbance at each input: {disturbance.text()}{source}",)


def _beside(kind: str, problem: Discrete, cost: float) -> tuple[str, ...]:
    """Return a note with the cost of LQG for the same weights."""
    try:
        best = design_certainty(kind, problem).cost_all_time
    except TaciturnError:  # LQG needs more of the weights than a given controller
        return ()
    if abs(best - cost) <= 1e-9 * cost:
        return ()
    return (f"LQG with these weights and every sample costs {best / cost:.3f} times as much as this controller",)
