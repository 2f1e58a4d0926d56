"""The rule "send when not sending costs more", over a link whose packets arrive after random delays.

The base sends a packet with the inputs in every step (``base/late``). The receiver uses the newest packet and holds its
inputs. It acknowledges each packet with the time of its arrival, so that at its next decision the controller knows the
inputs that acted in each piece of the period, and which packets are still in flight, the mode I. Therefore

* its filter predicts with the inputs that acted: x̂⁻⁺ = A x̂ + Σ_i B_i u_i, u_i the input in piece i of the period;
* silence costs E[z'Ψ_I z] more than a packet, z = (s, u_{k−1}, …, u_{k−D}, û), and a packet is sent iff this exceeds
  the price δ. So J = J_base + E[1{silent} z'Ψ_I z] and J ≤ J_base + δ (1 − rate of attempts).

The command is that of a given controller, or LQG with the gains for a constant delay, by default the mean delay of the
packets that arrive. With d whole periods and a part of one, these gains are those of the plant with registers for the
last commands (``lqg/registers``). A command that is still to act is in a packet that may be in flight or lost, so the
registers take the last commands that were sent, and the oldest one the input that acts.

Source: nilsson1998, antunes2014rollout
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from taciturn._arrays import Array, number
from taciturn.base.filter import COLLOCATED, ESTIMATE, HELD, SEND, estimate_state
from taciturn.base.given_controller import GivenLoop, lqg_observer
from taciturn.base.late import Delays, LateValue, chain_of, fourth_growth, late_value
from taciturn.base.nominal import Nominal
from taciturn.base.periods import periods_of, with_controller, with_filter
from taciturn.base.route import MEASURED, NEXT, REGISTER, nonempty
from taciturn.design.bounds import bound_by_attempts
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.lqg.registers import Pieces, registers_of
from taciturn.model.controller import AnyController
from taciturn.model.cost import Cost
from taciturn.model.coverage import GAUSSIAN_THEORY, LATE
from taciturn.model.delay import LONGEST, DelayLaw, Transport, Wait
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import ONE, Acted, Assign, Decide, Evaluate, Received, Send, Step
from taciturn.model.theory import INNOVATION, Identity, Theory
from taciturn.model.transport import with_transport
from taciturn.model.trigger import Form, Trigger

COST, TRIED = "cost of silence", "tried"
LINK, AT = "actuator", "controller"
OTHER_GAINS = "gains for another delay (design_delay)"


def acknowledges_late(network: Network) -> bool:
    """Return whether packets to the actuator have random delays, and acknowledgements state their time of arrival."""
    return LINK in network.late and network.acknowledges(LINK)


def late_excess(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    kept: AnyController | None,
    price_at: Callable[[float], float],
    network: Network,
    design_delay: float | None,
) -> Policy:
    """Return the policy that sends iff silence costs more than the price, over a link with random delays."""
    refused = {
        "the cost has a horizon or a discount; expected an average cost": cost.mission,
        "plant.D is given; expected outputs without a direct feedthrough": plant.D is not None,
        "another link has a constant delay; expected no other delay": _others(plant) is not None,
    }
    for got in (got for got, holds in refused.items() if holds):
        raise ProblemError(
            f"{network.key(LINK, 'delay')} is random and packets are acknowledged, and {got}, or a buffer"
        )
    plant = with_transport(plant, None)
    if kept is None:
        problem = discretise(plant, cost, period)
        loop = GivenLoop.of(plant, cost, period, lqg_observer(kind, problem), True)
    else:
        loop = GivenLoop.of(plant, cost, period, kept)
    problem, tick = loop.problem, loop.problem.tick
    law = network.random_delay(LINK, tick)
    assert law is not None, "the link delays packets at random"
    cuts = network.cuts(tick)
    source = problem.source
    assert source is not None, "a sampled problem knows its plant"
    pieces = discretise(source, problem.cost, tick if problem.sampled else None, None, cuts).pieces if cuts else None
    steady, delays = problem.filter(), _delays(law, network)
    whole = periods_of(problem, pieces)
    if kept is not None and design_delay is not None:
        raise ProblemError(
            f"design_delay is {design_delay:g}, and a controller is given; expected no design_delay: the controller "
            "states its own gains"
        )
    if kept is None:
        K = _gain(plant, cost, period, law, delays.depth, design_delay)
        base, state = with_filter(whole, steady), (ESTIMATE,)
    else:
        base, K = with_controller(whole, loop.controller, problem.plant.C, problem.plant.V)
        state = (ESTIMATE, MEASURED, *((REGISTER,) if len(loop.controller.A) else ()))
    found = late_value(chain_of(base, K, delays), loop.remedy if kept is not None else OTHER_GAINS)
    J = found.cost - problem.noise_cost
    price, fourth = price_at(J), fourth_growth(found)
    steps, initial = _steps(problem, loop if kept is not None else None, found, pieces, state, K, price)
    claims = Theory(
        cost_lqg=loop.cost_lqg,
        guarantee=bound_by_attempts(problem, J, price, 1, True, kept is None) if fourth < 1 else None,
        identity=Identity(problem.per_unit(J), (Form(plus={COST: 1.0 / problem.unit}), Form()), SEND),
        covers=GAUSSIAN_THEORY | LATE,
        fourth=fourth,
    )
    settling = max(1 / (1 - found.growth), 1 / (1 - steady.slowest))
    nominal = Nominal(problem, J, settling, disturbance=loop.disturbance)
    made = nominal.policy(kind, steps, loop.point.begun(steps, initial), claims, sites=COLLOCATED, network=network)
    return replace(made, notes=(*made.notes, *loop.notes))


def _others(plant: Plant | ContinuousPlant) -> Transport | None:
    """Return the constant delays of a plant, without the mean of random ones."""
    return None if plant.transport is None else plant.transport.certain


def _delays(law: DelayLaw, network: Network) -> Delays:
    """Return the law of the delays of packets, and of their losses, by the state of the link."""
    if law.sequence:
        raise ProblemError(
            f"{network.key(LINK, 'delay')} is a trace, whose delays follow each other in an order that no theory here "
            "covers; expected a histogram, a list of delays, a buffer, or acknowledged = false (then the loop is "
            "simulated without a claim)"
        )
    turns, losses = network.chain(LINK)
    odds = np.array(law.of_states(len(losses)).odds) * (1.0 - losses[:, None])
    return Delays.of(law.waits, odds if len(losses) > 1 else odds[0], 1.0, turns if len(losses) > 1 else None)


def _gain(
    plant: Plant | ContinuousPlant, cost: Cost, period: float | None, law: DelayLaw, depth: int, given: float | None
) -> Array:
    """Return the gain on z of LQG for a constant delay: that which is given, or the mean of those that arrive."""
    step = 1.0 if isinstance(plant, Plant) else float(period or 1.0)
    if given is not None:
        given = number("design_delay", given, 0.0, LONGEST * step, closed=True)
    periods = law.mean if given is None else given / step
    periods = float(np.clip(periods, law.waits[0], law.waits[-1])) if given is None else periods
    whole = float(np.round(periods)) if isinstance(plant, Plant) else periods
    wait = Wait(int(whole)) if isinstance(plant, Plant) else Wait(0, whole * step)
    late = with_transport(plant, Transport.of([wait] * plant.inputs, [Wait()] * len(plant.C)))
    L, n, m = discretise(late, cost, period).regulator().L, plant.states, plant.inputs
    K = np.zeros((m, n + m * (depth + 1)))
    K[:, :n] = L[:, :n]
    if late.transport is None:
        return K
    held = registers_of(late, step)
    for column, (i, age) in enumerate(zip(held.inputs, held.ages, strict=True), start=n):
        # the oldest command is the input that acts, unless it still is in a packet
        place = n + depth * m if age > depth or held.late[i] == 0 else n + (age - 1) * m
        K[:, place + i] += L[:, column]
    return K


def _steps(
    problem: Discrete,
    loop: GivenLoop | None,
    found: LateValue,
    pieces: Pieces | None,
    state: tuple[str, ...],
    K: Array,
    price: float,
) -> tuple[tuple[Step, ...], dict[str, Array]]:
    """Return the policy steps of all nodes, and the initial values of their memories."""
    plant, depth = problem.plant, found.chain.delays.depth
    m, unit, one, none = plant.inputs, np.eye(plant.inputs), np.ones((1, 1)), np.zeros((1, 1))
    estimation = estimate_state(plant, problem.filter())
    initial = dict(estimation.initial)
    before: list[Step] = [*estimation.correct]
    sent = [f"sent {age}" for age in range(1, depth + 1)]
    n = plant.states
    if loop is None:
        gains = np.split(K, [n, *(n + m * age for age in range(1, depth + 1))], axis=1)
        command = dict(zip((ESTIMATE, *sent, HELD), gains, strict=True))
    else:
        c = loop.controller
        measured = {ESTIMATE: plant.C} if plant.full_state else {"prior": plant.C, INNOVATION: np.eye(plant.outputs)}
        before.append(Assign(AT, MEASURED, measured))
        if len(c.A):
            before.append(Assign(AT, REGISTER, {NEXT: np.eye(len(c.A))}))
            initial[NEXT] = loop.point.start
        command = {REGISTER: c.C, MEASURED: c.D}
    before.append(Assign(AT, "command", nonempty(command)))
    Psi, psi = found.silent
    signals = (*state, *sent, HELD)
    modes = {mode.ages: i for i, mode in enumerate(found.chain.modes)}
    if len(found.chain.delays.turns) > 1:
        raise ProblemError(
            "the delays or losses of the link come in bursts, with acknowledgements of random delays; expected "
            "independent delays and losses, a buffer, or acknowledged = false (then the loop is simulated)"
        )
    flags = {age: f"flight {age}" for age in range(1, depth + 1)}
    for age, flag in flags.items():
        none_or_some = Trigger({"no": Form(plus={flag: 1.0}), "yes": Form(constant=0.5)})  # the flag is 0 or 1
        before.append(Decide(AT, f"packet {age} is in flight", none_or_some))
    costs: dict[tuple[int, ...], Form] = {ages: Form(signals, Psi[i], float(psi[i])) for ages, i in modes.items()}
    before += _selected(costs, flags)
    rule = Trigger({"silent": Form(plus={COST: 1.0}), SEND: Form(constant=price)})
    after: list[Step] = [
        Decide(AT, SEND, rule),
        Send(AT, LINK, ("command",), SEND),
        Assign(LINK, "input", ({"input": unit}, {"command": unit}), Received(LINK)),
    ]
    count = 1 if pieces is None else len(pieces.cuts)
    acting = [f"acting {piece}" for piece in range(count)]
    for piece, name in enumerate(acting):
        after.append(Assign(AT, name, {HELD: unit}))
        for age in range(depth, -1, -1):  # the newest packet last
            value = {sent[age - 1]: unit} if age else {"command": unit}
            after.append(Assign(AT, name, ({name: unit}, value), Acted(LINK, age, piece)))
    after.append(Assign(AT, TRIED, ({ONE: none}, {ONE: one}), SEND))
    names = {0: TRIED, **flags}
    for age in range(depth - 1, -1, -1):
        after.append(Assign(AT, names[age + 1], ({names[age]: one}, {ONE: none}), Acted(LINK, age, count - 1)))
        for newer in range(age):
            flag = names[age + 1]
            after.append(Assign(AT, flag, ({flag: one}, {ONE: none}), Acted(LINK, newer, count - 1)))
    for age in range(depth, 1, -1):
        after.append(Assign(AT, sent[age - 1], {sent[age - 2]: unit}))
    if depth:
        after.append(Assign(AT, sent[0], ({sent[0]: unit}, {"command": unit}), SEND))
    if not plant.full_state:
        effects = [plant.B] if pieces is None else np.split(pieces.B, count, axis=1)
        after.append(Assign(AT, "prior", {ESTIMATE: plant.A, **dict(zip(acting, effects, strict=True))}))
    after.append(Assign(AT, HELD, {acting[-1]: unit}))
    if loop is not None and len(loop.controller.A):
        c = loop.controller
        after.append(Assign(AT, NEXT, nonempty({REGISTER: c.A, MEASURED: c.B, HELD: c.E})))
    return (*before, *after), initial


def _selected(costs: dict[tuple[int, ...], Form], flags: dict[int, str]) -> list[Step]:
    """Return the steps that evaluate the cost of silence in the mode, the set of packets in flight."""
    if not flags:
        return [Evaluate(AT, COST, (costs[()],))]
    found, last = list[Step](), max(flags)
    # the first age selects a form; each further one selects between two values
    names: dict[tuple[int, ...], str] = {}
    for ages in (ages for ages in _subsets(last) if 1 not in ages):
        other = (1, *ages)
        name = COST if last == 1 else f"cost with {_named(ages)} in flight"
        found.append(
            Evaluate(AT, name, (costs.get(ages, costs[()]), costs.get(other, costs[()])), "packet 1 is in flight")
        )
        names[ages] = name
    for age in range(2, last + 1):
        merged: dict[tuple[int, ...], str] = {}
        for ages in (ages for ages in names if age not in ages):
            other = tuple(sorted((*ages, age)))
            name = COST if age == last else f"cost up to {age} with {_named(ages)} in flight"
            unit = np.ones((1, 1))
            found.append(Assign(AT, name, ({names[ages]: unit}, {names[other]: unit}), f"packet {age} is in flight"))
            merged[ages] = name
        names = merged
    return found


def _subsets(last: int) -> list[tuple[int, ...]]:
    """Return all sets of the ages 1 to ``last``."""
    return [tuple(age for age in range(1, last + 1) if code >> (age - 1) & 1) for code in range(1 << last)]


def _named(ages: tuple[int, ...]) -> str:
    return "packets " + ", ".join(map(str, ages)) if ages else "no older packet"
