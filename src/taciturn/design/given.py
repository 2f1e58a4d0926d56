"""Event-triggered control with a given linear controller, which sends when silence would cost too much.

In each step, the sensor measures. The node that decides, the controller or the sensor itself, filters the measurement,
follows the controller's state ``register``, and decides on the difference ``error`` between the value that the receiver
uses in silence and the choice, the value that a packet would carry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from taciturn._arrays import Array, choice
from taciturn._display import Displayed
from taciturn.design.alarm import WATCH, watch_innovations
from taciturn.design.base import EVERY_SAMPLE, Advantage, Attempts, Base, advantage, note_growth
from taciturn.design.bounds import bound_by_attempts
from taciturn.design.certainty import error_per_unit
from taciturn.design.estimation import ESTIMATE, HELD, SEND, estimate_state
from taciturn.design.kept import recovery
from taciturn.design.kept_loop import KeptLoop
from taciturn.design.routes import MEASURED, REGISTER, Actuation, Route, nonempty, route_over
from taciturn.design.same_control import SameControl
from taciturn.design.silence import BELIEF, cost_of_silence
from taciturn.design.step_counter import StepCounter
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.stored import controller_loop
from taciturn.model.controller import Controller
from taciturn.model.cost import Cost
from taciturn.model.coverage import BURSTS, GAUSSIAN_THEORY, THEORY
from taciturn.model.kept import Kept
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import ONE, Acknowledged, Apply, Assign, Decide, Evaluate, Policy, Step
from taciturn.model.saturation import Saturation
from taciturn.model.theory import INNOVATION, Identity, Theory
from taciturn.model.trigger import Form, Trigger

MISSING, WOULD, BEYOND, LIMIT = "missing", "command of a packet", "beyond limits", "limit"


def keep_controller(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    kept: Kept,
    price_at: Callable[[float], float],
    actuation: Actuation,
    link: str,
    network: Network,
    every: int,
    retry: bool = False,
    lqg: Controller | None = None,
) -> Policy:
    """Return the policy that sends iff E[e'He + 2 e'(slope) z] > δ, given the measurements, for a given controller.

    Args:
        kind: name of the policy kind.
        plant: the plant, without the slow disturbance that the controller compensates.
        cost: the cost.
        period: seconds between steps; only with a continuous plant.
        kept: the controller.
        price_at: function that returns δ per step, given the cost of the base per step.
        actuation: in silence, the receiver keeps the last value (``"hold"``), predicts it (``"model"``), or the
            actuator applies 0, or the input at rest (``"zero"``).
        link: ``"actuator"``: packets carry inputs; ``"sensor"``: packets carry measurements.
        network: the network; losses of the link must be acknowledged.
        every: q, the number of steps between packets of the base.
        retry: whether the node that decides attempts again in the step after a missing acknowledgement.
        lqg: LQG with every sample as a controller, whose cost is J_all, if ``kept`` is LQG for these packets; default:
            J_all is the cost of ``kept`` with every sample. Over a link that drops packets, both attempt every sample.

    Raises:
        ProblemError: the controller does not suit the plant, or the options do not suit each other.
        UnstableError: the base is unstable.
    """
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

    Args:
        kind: name of the policy kind, for messages.
        plant: the plant, without the slow disturbance that the controller compensates.
        cost: the cost.
        period: seconds between steps; only with a continuous plant.
        kept: the controller.
        link: ``"actuator"``: packets carry inputs; ``"sensor"``: packets carry measurements.

    Raises:
        ProblemError: the controller does not suit the plant.
        UnstableError: the loop is unstable.
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


def drops(network: Network, link: str) -> bool:
    """Return whether a link drops packets and acknowledges those that arrive."""
    return network.acknowledges(link) and network.loss(link) > 0


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


def _unless(decision: str, before: tuple[Step, ...], silent: Form, forbidden: float) -> tuple[tuple[Step, ...], Form]:
    """Return the steps of a decision whose other options than the first forbid silence, and the cost of silence."""
    made = next(step for step in before if isinstance(step, Decide) and step.decision == decision)
    name = f"cost after {decision}" if silent.Psi is None else "cost of silence"
    others = [Form(constant=forbidden)] * (len(made.trigger.options) - 1)
    return (*before, Evaluate(made.at, name, (silent, *others), decision)), Form(plus={name: 1.0})


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
