"""The rule "send when not sending costs more", over a link whose packets arrive after random delays.

The base sends a packet with the inputs in every step (``base/late``). The receiver uses the newest packet and holds its
inputs. It acknowledges each packet with the time of its arrival, so that at its next decision the controller knows the
inputs that acted in each piece of the period, and which packets are still in flight, the mode I. Therefore

* its filter predicts with the inputs that acted: x̂⁻⁺ = A x̂ + Σ_i B_i u_i, u_i the input in piece i of the period;
* silence costs E[z'Ψ_I z] more than a packet, z = (s, u_{k−1}, …, u_{k−D}, û), and a packet is sent iff this exceeds
  the price δ. So J = J_base + E[1{silent} z'Ψ_I z] and J ≤ J_base + δ (1 − rate of attempts).

If delays and losses come in bursts, nobody knows the state of the link. The controller keeps the probabilities of all
modes by the arrivals (``LateBelief``), and silence costs the mean over them.

The command is that of a given controller, or LQG with the gains for a constant delay, by default the mean delay of the
packets that arrive. With d whole periods and a part of one, these gains are those of the plant with registers for the
last commands (``lqg/registers``). A command that is still to act is in a packet that may be in flight or lost, so the
registers take the last commands that were sent, and the oldest one the input that acts.

Source: nilsson1998, antunes2014rollout
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from taciturn._arrays import Array, number
from taciturn._display import Displayed
from taciturn._text import number_of
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
from taciturn.model.coverage import BURSTS, GAUSSIAN_THEORY, LATE
from taciturn.model.delay import LONGEST, DelayLaw, Transport, Wait
from taciturn.model.losses import stationary
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import ONE, Acted, Apply, Assign, Decide, Evaluate, Received, Send, Step
from taciturn.model.theory import INNOVATION, Identity, Theory
from taciturn.model.transport import with_transport
from taciturn.model.trigger import Form, Trigger

COST, TRIED, BELIEF = "cost of silence", "tried", "belief"
MOST_BELIEVED = 64  # modes of which a controller has probabilities
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
        "another link has a constant delay; expected no other delay": plant.transport is not None
        and plant.transport.certain is not None,
    }
    for got in (got for got, holds in refused.items() if holds):
        raise ProblemError(
            f"{network.lateness(LINK)}, with acknowledgements, and {got}, or a link without acknowledgements"
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
        K = _gain(plant, cost, period, law, network.links[LINK].states, delays.depth, design_delay)
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
        covers=GAUSSIAN_THEORY | LATE | BURSTS,
        functions=frozenset({BELIEF}),
        fourth=fourth,
    )
    settling = max(1 / (1 - found.growth), 1 / (1 - steady.slowest))
    nominal = Nominal(problem, J, settling, disturbance=loop.disturbance)
    made = nominal.policy(kind, steps, loop.point.begun(steps, initial), claims, sites=COLLOCATED, network=network)
    return replace(made, notes=(*made.notes, *loop.notes))


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
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    law: DelayLaw,
    shares: Sequence[float],
    depth: int,
    given: float | None,
) -> Array:
    """Return the gain on z of LQG for a constant delay: that which is given, or the mean of those that arrive.

    The mean is that for the shares of the states of the link.
    """
    step = 1.0 if isinstance(plant, Plant) else float(period or 1.0)
    if given is not None:
        given = number("design_delay", given, 0.0, LONGEST * step, closed=True)
        periods = given / step
    else:  # the mean of the odds may round to beyond the delays
        periods = float(np.clip(law.mean_by(shares), law.waits[0], law.waits[-1]))
    wait = Wait(int(np.round(periods))) if isinstance(plant, Plant) else Wait(0, periods * step)
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
    signals = (*state, *sent, HELD)
    count = 1 if pieces is None else len(pieces.cuts)
    watched = _watched_flight(found, signals, count) if len(found.chain.delays.turns) == 1 else _believed(
        found, signals, (0.0,) if pieces is None else pieces.cuts
    )  # fmt: skip
    before += watched.before
    initial |= watched.initial
    rule = Trigger({"silent": Form(plus={COST: 1.0}), SEND: Form(constant=price)})
    after: list[Step] = [
        Decide(AT, SEND, rule),
        Send(AT, LINK, ("command",), SEND),
        Assign(LINK, "input", ({"input": unit}, {"command": unit}), Received(LINK)),
    ]
    acting = [f"acting {piece}" for piece in range(count)]
    for piece, name in enumerate(acting):
        after.append(Assign(AT, name, {HELD: unit}))
        for age in range(depth, -1, -1):  # the newest packet last
            value = {sent[age - 1]: unit} if age else {"command": unit}
            after.append(Assign(AT, name, ({name: unit}, value), Acted(LINK, age, piece)))
    after.append(Assign(AT, TRIED, ({ONE: none}, {ONE: one}), SEND))
    after += watched.after
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


@dataclass(frozen=True, eq=False, repr=False)
class _Watched(Displayed):
    """The policy steps that compute the cost of silence, and those that follow the packets in flight."""

    before: tuple[Step, ...]  # before the decision
    after: tuple[Step, ...]  # after the packet, with the acknowledgements of the step
    initial: dict[str, Array]


def _watched_flight(found: LateValue, signals: tuple[str, ...], count: int) -> _Watched:
    """Return the steps of a link with one state: a flag for each age says whether the packet is in flight."""
    (Psi, psi), depth = found.silent, found.chain.delays.depth
    # a set of ages is not a mode if packets of these ages are never in flight together
    costs = {mode.ages: Form(signals, Psi[i], float(psi[i])) for i, mode in enumerate(found.chain.modes)}
    flags, before = {age: f"flight {age}" for age in range(1, depth + 1)}, list[Step]()
    for age, flag in flags.items():
        none_or_some = Trigger({"no": Form(plus={flag: 1.0}), "yes": Form(constant=0.5)})  # the flag is 0 or 1
        before.append(Decide(AT, f"packet {age} is in flight", none_or_some))
    before += _selected(costs, flags)
    after, names, one = list[Step](), {0: TRIED, **flags}, np.ones((1, 1))
    for age in range(depth - 1, -1, -1):
        flag = names[age + 1]
        after.append(Assign(AT, flag, ({names[age]: one}, {ONE: 0.0 * one}), Acted(LINK, age, count - 1)))
        for newer in range(age):
            after.append(Assign(AT, flag, ({flag: one}, {ONE: 0.0 * one}), Acted(LINK, newer, count - 1)))
    return _Watched(tuple(before), tuple(after), {})


def _believed(found: LateValue, signals: tuple[str, ...], cuts: tuple[float, ...]) -> _Watched:
    """Return the steps of a link with several states, which nobody knows: the cost is the mean over the modes."""
    (Psi, psi), chain = found.silent, found.chain
    modes, depth, one = len(chain.modes), chain.delays.depth, np.ones((1, 1))
    if modes > MOST_BELIEVED:
        raise ProblemError(
            f"packets that arrive up to {number_of(depth, 'period')} late, over a link of "
            f"{number_of(len(chain.delays.turns), 'state')}, have {number_of(modes, 'mode')}; expected at most "
            f"{MOST_BELIEVED}: shorter delays, a buffer, or fewer states"
        )
    names = [f"cost in mode {i}" for i in range(modes)]
    before: list[Step] = [Evaluate(AT, name, (Form(signals, Psi[i], float(psi[i])),)) for i, name in enumerate(names)]
    half = 0.5 * np.eye(modes)
    product = np.block([[0.0 * half, half], [half, 0.0 * half]])  # of the belief and the costs
    before.append(Evaluate(AT, COST, (Form((BELIEF, *names), product),)))
    arrivals, after = [f"arrival {age}" for age in range(depth + 1)], list[Step]()
    for age, name in enumerate(arrivals):
        after.append(Assign(AT, name, {ONE: -one}))
        for piece in reversed(range(len(cuts))):
            after.append(Assign(AT, name, ({name: one}, {ONE: piece * one}), Acted(LINK, age, piece)))
    start = np.zeros(modes)
    for i, mode in enumerate(chain.modes):
        if not mode.flight:
            start[i] = stationary(chain.delays.turns)[mode.link]
    after.append(Apply(AT, {BELIEF: modes}, LateBelief.of(found, cuts, start), (BELIEF, TRIED, *arrivals)))
    return _Watched(tuple(before), tuple(after), {BELIEF: start})


@dataclass(frozen=True, eq=False, repr=False)
class LateBelief(Displayed):
    """Updates the controller's probabilities of the modes by the arrivals of a step, and predicts the next modes.

    After arrivals that the law excludes, such as a lost acknowledgement, it begins again at ``start``.
    """

    ways: tuple[tuple[int, bool, tuple[int, ...], int, float], ...]  # mode, sent, pieces by age, next mode, probability
    start: Array

    @staticmethod
    def of(found: LateValue, cuts: tuple[float, ...], start: Array) -> LateBelief:
        """Return the update for the outcomes of a chain."""
        chain, ways = found.chain, dict[tuple[int, bool, tuple[int, ...], int], float]()
        for sent, steps in chain.outcomes.items():
            for mode, outcomes in enumerate(steps):
                for outcome in outcomes:
                    pieces = [-1] * (chain.delays.depth + 1)
                    for fraction, age in outcome.path[0]:
                        pieces[age] = int(np.abs(np.array(cuts) - fraction).argmin())
                    key = mode, sent[0], tuple(pieces), outcome.after
                    ways[key] = ways.get(key, 0.0) + outcome.chance
        return LateBelief(tuple((*key, chance) for key, chance in ways.items()), start)

    def __call__(self, belief: Any, tried: Any, *arrivals: Any) -> Any:
        """Return the distribution at the next step; an arrival is the piece of a packet of that age, or −1."""
        acted: list[Any] = []  # an arrival that finds a newer packet changes nothing
        for age, found in enumerate(arrivals):
            here = found[0]
            for newer in arrivals[:age]:
                here = np.where(newer[0] < -0.5, here, np.where(newer[0] <= here, -1.0, here))
            acted.append(here)
        seen = dict[tuple[bool, tuple[int, ...]], Any]()
        for _, sent, pieces, _, _ in self.ways:
            if (sent, pieces) not in seen:
                likely = tried[0] if sent else 1.0 - tried[0]
                for here, piece in zip(acted, pieces, strict=True):
                    likely = likely * np.where(np.abs(here - piece) < 0.5, 1.0, 0.0)
                seen[sent, pieces] = likely
        weights: list[Any] = [0.0] * len(self.start)
        for mode, sent, pieces, after, chance in self.ways:
            weights[after] = weights[after] + chance * seen[sent, pieces] * belief[mode]
        total = sum(weights)
        share = np.where(total > 0.0, total, 1.0)
        pairs = zip(weights, self.start.tolist(), strict=True)
        known: list[Any] = [np.where(total > 0.0, weight / share, start) for weight, start in pairs]
        return np.array(known)


def _selected(costs: Mapping[tuple[int, ...], Form], flags: Mapping[int, str]) -> list[Step]:
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
