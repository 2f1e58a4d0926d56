"""Policies that send at fixed steps, each with its exact cost.

No decision depends on the state, so the loop is linear and periodic, and cost and rate have closed forms. The decision
is data: a constant that a step counter reads from a table, negative in the steps with a send.

* ``every_tick`` sends in every step. Its cost is J_all.
* ``held_in_cycles`` holds the input between the sends of a cycle, with the optimal gains of its periodic Riccati
  equation (``lqg/periodic``). The cost is tr(QΣ) plus that of the pattern.
* An actuator with a model predicts between sends. k steps after a send, the error of its prediction is the sum of k
  innovations, with the covariance V_k, and its input costs tr(L'HL V_k) more than the best one (``predicted_cost``).
* A given controller sends every sample, or at the intervals of a cycle; its cost is that of its base
  (``send_at_fixed_steps``).
* ``same_nodes`` are the nodes of any policy, whose packets a timetable sends in place of their decisions; with
  ``sending_always`` they send at every step.
* ``innovation_at_queries`` has the steps of a sensor that is read by a schedule, and of the filter that hears it.

Source: astrom1997computer, bengaid2006
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace

import numpy as np

from taciturn._arrays import Array, Bits
from taciturn.base.certainty import Actuation, CertaintyEquivalentDesign, certainty_policy, control_steps
from taciturn.base.filter import CLOCK, SEND, FilterSteps, count_ticks, estimate_state
from taciturn.base.given_controller import GivenLoop, SameControl
from taciturn.base.route import Actuation as LoopActuation
from taciturn.base.route import route_over
from taciturn.base.value import Attempts, advantage
from taciturn.errors import ProblemError
from taciturn.lqg.periodic import Pattern, lift
from taciturn.lqg.stored import controller_loop
from taciturn.model.controller import AnyController
from taciturn.model.cost import Cost
from taciturn.model.coverage import THEORY
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.signals import SampledChanges
from taciturn.model.steps import Apply, Assign, Decide, Draw, Evaluate, Location, Received, Send, Step, assigned, read
from taciturn.model.theory import ClosedForm, Theory
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger

QUERY = "query"


def every_tick(kind: str, certainty: CertaintyEquivalentDesign, notes: tuple[str, ...] = ()) -> Policy:
    """Return the policy that sends at every step, with an actuator that holds the input. Its cost is exact."""
    plant, L = certainty.problem.plant, certainty.regulator.L
    steps, initial = control_steps(plant, certainty.estimation, L, "hold", None)
    return certainty_policy(
        kind,
        certainty,
        steps,
        initial,
        identity=None,
        closed_form=ClosedForm(certainty.problem.per_unit(certainty.cost_all_time), {"actuator": 1.0}),
        notes=notes,
    )


def held_in_cycles(kind: str, certainty: CertaintyEquivalentDesign, pattern: Pattern) -> Policy:
    """Return the policy that updates the held input at the steps of a repeating pattern. Its cost is exact."""
    one = len(pattern.gains) == 1
    L = pattern.gains[0] if one else Scheduled(CLOCK, np.repeat(pattern.gains, pattern.intervals, axis=0))
    return time_triggered(kind, certainty, L, "hold", pattern.intervals, certainty.estimation_cost + pattern.cost)


def time_triggered(
    kind: str,
    certainty: CertaintyEquivalentDesign,
    L: Matrix,
    actuation: Actuation,
    intervals: Sequence[int],
    average: float,
) -> Policy:
    """Return the policy that sends at the given intervals. ``average`` is its average cost per step."""
    pattern = pattern_of(intervals)
    length = len(pattern)
    trigger = Trigger({"silent": Form(), SEND: _turn(np.array(pattern))})
    steps, initial = control_steps(certainty.problem.plant, certainty.estimation, L, actuation, trigger)
    return certainty_policy(
        kind,
        certainty,
        steps,
        initial,
        identity=None,
        locations=(count_ticks(length, 0),),
        closed_form=ClosedForm(certainty.problem.per_unit(average), {"actuator": len(intervals) / length}),
        reset=certainty.reset(actuation),
        slower=length,
    )


TIMETABLE = "timetable"  # name of its step counter


def send_at_fixed_steps(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    kept: AnyController,
    link: str = "actuator",
    intervals: Sequence[int] = (1,),
    actuation: LoopActuation = "hold",
) -> Policy:
    """Return the policy of a given controller that sends at every sample, or at the intervals of a cycle.

    No node decides, so none needs a filter unless it predicts, and the plant need not be detectable.
    """
    loop = GivenLoop.of(plant, cost, period, kept)
    problem, average = loop.problem, not loop.problem.cost.mission
    plant, pattern = problem.plant, pattern_of(intervals)
    every = len(pattern) == 1
    if not every and isinstance(plant.changes, SampledChanges):
        raise ProblemError(
            "the set-points change at known times (reference.file), and the controller does not send every sample, so "
            "its cost is not known; expected steps at random times (reference.steps), or the policy kind all-time"
        )
    steady = problem.filter() if actuation == "model" else None
    estimation = FilterSteps((), (), {}, None) if steady is None else estimate_state(plant, steady)
    route = route_over(link, problem, loop.controller, actuation, False, start=loop.point.start)
    found, whole = loop.value(route.base)
    proved = controller_loop(problem, loop.controller).cost() if plant.changes is None else None
    nominal = loop.nominal(whole, found.settling, route.base if average else None, proved)
    # between packets, a model predicts from the last one
    between = route.base
    if steady is not None:
        between = route_over(link, problem, loop.controller, actuation, False, steady, loop.point.start).base
    costs = nominal.cost if every else advantage(between, loop.remedy, Attempts(pattern)).cost
    sends = Form() if every else _turn(np.array(pattern))
    decide = Decide(route.node, SEND, Trigger({"silent": Form(constant=float(every)), SEND: sends}))
    steps = (*estimation.correct, *route.steps((decide,), estimation.predict))
    claims = Theory()
    if average:
        claims = Theory(
            closed_form=ClosedForm(problem.per_unit(costs), {link: len(intervals) / len(pattern)}),
            covers=THEORY,
            periodic=SameControl(loop, between),
        )
    return nominal.policy(
        kind,
        steps,
        loop.point.begun(steps, {**estimation.initial, **route.initial}),
        claims,
        sites=route.sites,
        locations=() if every else (count_ticks(len(pattern), 0),),
        notes=loop.notes,
    )


def pattern_of(intervals: Sequence[int]) -> tuple[bool, ...]:
    """Return whether a packet is sent, for each step of a cycle of intervals."""
    return tuple(k == 0 for steps in intervals for k in range(steps))


def same_nodes(policy: Policy, sends: Mapping[str, Bits], network: Network | None = None) -> Policy:
    """Replace the decisions of a policy by a repeating timetable of sends. All other computations stay the same.

    The timetable keeps the limits on the intervals of the ``network``; default: those of the policy.
    """
    # A decision on several links takes the option that sends on the wanted links, or else on the fewest others. Links
    # on which the policy sends at fixed steps keep these steps, for which its gains may be.
    length = len(next(iter(sends.values())))
    steps = list[Step]()
    for step in policy.steps:
        on = [one for one in policy.steps if isinstance(one, Send) and one.on is not None]
        mine = [one for one in on if isinstance(step, Decide) and one.on == step.decision]
        if not isinstance(step, Decide) or not mine or not step.trigger.reads:
            steps.append(step)
            continue
        labels = step.trigger.labels
        options = [{one.link for one in mine if label in one.sending(labels)} for label in labels]
        wanted = [{one.link for one in mine if sends[one.link][k]} for k in range(length)]
        chosen = np.array([min(range(len(labels)), key=lambda i: _missed(options[i], here)) for here in wanted])
        turns = [np.where(chosen == i, -1.0, 1.0) for i in range(len(labels))]
        forms = {
            label: Form(constant=Scheduled(TIMETABLE, turn) if length > 1 else float(turn[0]))
            for label, turn in zip(labels, turns, strict=True)
        }
        steps.append(Decide(step.at, step.decision, Trigger(forms)))
    known = policy.theory
    # which state how nodes predict missing samples
    innovations = None if any(isinstance(step, Apply) for step in steps) else known.innovations
    theory = Theory(
        known.cost, known.cost_all_time, known.noise_cost, known.settling, sums=known.sums, recovery=known.recovery,
        innovations=innovations,
    )  # fmt: skip
    counter = () if length == 1 else (Location(TIMETABLE, np.roll(np.arange(length), -1)),)
    return replace(
        policy,
        steps=tuple(steps),
        theory=theory,
        locations=(*policy.locations, *counter),
        notes=(),
        network=network or policy.network,
    )


def sending_always(policy: Policy) -> Policy:
    """Return the policy whose nodes send in every step. Limits on send intervals have no effect on them."""
    links = {step.link for step in policy.steps if isinstance(step, Send)}
    network = policy.network.unlimited
    always = same_nodes(policy, {link: np.ones(1, dtype=np.bool_) for link in sorted(links)}, network)
    steps = _without_unread(always.steps)
    made = {name for step in steps for name in assigned(step)}
    initial = {name: value for name, value in always.initial.items() if name in made}
    return replace(always, steps=steps, initial=initial)


def _without_unread(steps: tuple[Step, ...]) -> tuple[Step, ...]:
    """Return policy steps without stored quadratic forms and random numbers that only decisions have read."""
    stored = {step.signal for step in steps if isinstance(step, Evaluate | Draw)}
    unread = {name for name in stored if all({*assigned(step)} == {name} for step in steps if name in read(step))}
    kept = tuple(step for step in steps if unread.isdisjoint(assigned(step)))
    return kept if len(kept) == len(steps) else _without_unread(kept)


def decides(policy: Policy) -> bool:
    """Return whether a decision to send depends on signals."""
    on = {str(step.on) for step in policy.steps if isinstance(step, Send) and step.on is not None}
    return any(policy.decisions[name].reads for name in on)


def sends_always(policy: Policy) -> bool:
    """Return whether a policy whose decisions depend on no signal sends in every step."""
    return all(
        _always(policy.decisions[str(step.on)], step)
        for step in policy.steps
        if isinstance(step, Send) and step.on is not None
    )


def _always(trigger: Trigger, step: Send) -> bool:
    """Return whether constant forms always select a label with which a packet is sent."""
    if trigger.reads or trigger.limit is not None or trigger.excluded:
        return False
    constants = [form.constant for form in trigger.options.values()]
    rows = np.broadcast_arrays(*(one.values if isinstance(one, Scheduled) else one for one in constants))
    sending = step.sending(trigger.labels)
    return all(trigger.labels[place] in sending for place in np.unique(np.argmin(rows, axis=0)))


def _missed(option: Set[str], wanted: Set[str]) -> tuple[int, int]:
    """Return the number of wanted links on which an option does not send, and of others on which it does."""
    return len(wanted - option), len(option - wanted)


def innovation_at_queries(
    node: str, controller: str, seen: Mapping[str, Array], queries: Bits, suffix: str = ""
) -> tuple[Step, ...]:
    """Return the policy steps of a sensor with a schedule, and of the innovation, which is 0 without a packet."""
    (sent, prediction), label = seen, f"{QUERY}{suffix}"  # the innovation is the measurement less what is predicted
    nothing = {prediction: np.zeros(seen[prediction].shape)}
    return (
        Decide(node, label, Trigger({"silent": Form(), QUERY: _turn(queries)})),
        Send(node, node, (sent,), label),
        Assign(controller, f"innovation{suffix}", (nothing, seen), Received(node)),
    )


def _turn(sends: Bits) -> Form:
    """Return the form that is negative in the steps of a cycle in which something is sent."""
    return Form(constant=Scheduled(CLOCK, np.where(sends, -1.0, 1.0)))


def predicted_cost(certainty: CertaintyEquivalentDesign, intervals: Sequence[int]) -> float:
    """Return the cost per step if sends are periodic and the actuator predicts the state from one send to the next."""
    plant = certainty.problem.plant
    return certainty.cost_all_time + waiting_cost(plant.A, plant.B, certainty.square, certainty.corrections, intervals)


def waiting_cost(A: Array, B: Array, square: Array, corrections: Array, intervals: Sequence[int]) -> float:
    """Return the cost per step that prediction between sends adds to J_all. ``square`` is the weight L'HL."""
    # The sum of Σ_{j<k} tr(L'HL V_j) over all intervals k of the cycle, divided by the number of its steps. The inner
    # sum is the noise cost of k steps with the weight L'HL, driven by innovations.
    free = np.zeros((B.shape[1], B.shape[1]))
    given = A, B, square, free, np.zeros_like(B), corrections
    return sum(lift(*given, ticks).noise_cost for ticks in intervals) / sum(intervals)
