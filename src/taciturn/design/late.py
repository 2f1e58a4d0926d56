"""The rule "send when not sending costs more", over a link whose packets arrive after random delays.

The base sends a packet with the inputs in every step (``base/late``). The receiver uses the newest packet and holds its
inputs. It acknowledges each packet with the time of its arrival, so that at its next decision the controller knows the
inputs that acted in each piece of the period, and which packets are still in flight, the mode I. Therefore

* its filter predicts with the inputs that acted: x̂⁻⁺ = A x̂ + Σ_i B_i u_i, u_i the input in piece i of the period;
* silence costs E[z'Ψ_I z] more than a packet, z = (s, u_{k−1}, …, u_{k−D}, û), and a packet is sent iff this exceeds
  the price δ. So J = J_base + E[1{silent} z'Ψ_I z] and J ≤ J_base + δ (1 − rate of attempts).

If delays and losses come in bursts, nobody knows the state of the link. The controller keeps the probabilities of all
modes by the arrivals (``LateBelief``), and silence costs the mean over them.

With several actuators, the fate of a packet is a vector with a delay for each receiver, and the controller chooses the
set of links that send: that with the least sum of the cost of silence on the others, E[z'Ψ_I^a z], and δ times the
share of its packets in the price of packets on all links. Sending on all links costs δ, so the bound holds with the
mean of the rates, weighted by the prices.

If acknowledgements come one step late, the controller weighs all histories of the step before (``Histories``). Such a
controller cannot be LQG, whose estimate depends on the inputs that acted.

The command is that of a given controller, or LQG with the gains for a constant delay (``design/late_base``).

Source: nilsson1998, antunes2014rollout
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.base.filter import COLLOCATED, ESTIMATE, HELD, SEND, estimate_state, outputs_of
from taciturn.base.given_controller import GivenLoop
from taciturn.base.late import LateValue, fourth_growth
from taciturn.base.nominal import Nominal
from taciturn.base.route import MEASURED, NEXT, REGISTER, nonempty
from taciturn.design.bounds import bound_by_attempts
from taciturn.design.late_base import Gain, LateBase, PeriodicPackets, Receiver, Receivers
from taciturn.design.late_belief import Histories, LateBelief, Way
from taciturn.design.several_nodes import (
    COMMAND,
    WEIGHTED_RATE,
    label,
)
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.registers import Pieces
from taciturn.model.controller import AnyController
from taciturn.model.cost import Cost
from taciturn.model.coverage import BURSTS, GAUSSIAN_THEORY, LATE
from taciturn.model.delay import WHOLE
from taciturn.model.losses import stationary
from taciturn.model.network import REFERENCE, Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import (
    ONE,
    Acknowledged,
    Acted,
    Apply,
    Assign,
    Condition,
    Decide,
    Evaluate,
    Received,
    Send,
    Step,
    Terms,
)
from taciturn.model.theory import INNOVATION, Identity, Theory
from taciturn.model.transport import with_transport
from taciturn.model.trigger import Form, Trigger

COST, TRIED, BELIEF = "cost of silence", "tried", "belief"
MOST_BELIEVED = 64  # modes of which a controller has probabilities
LAST, COSTS = "last command", "costs of silence"
MOST_HISTORIES = 256  # of a step that is not acknowledged yet
LEAST_NOISE = 1e-12  # share of an output's error in all of them, below which it counts as none
Part = TypeVar("Part")  # a form, or the terms of a sum
MOST_FORMS = 1024  # of the cost of silence, one for each set of links and each mode


def late_excess(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    kept: AnyController | None,
    price_at: Callable[[float], float],
    network: Network,
    design_delay: float | None,
    best: bool = False,
) -> Policy:
    """Return the policy that sends iff silence costs more than the price, over links with random delays and losses."""
    informs = next(link for link in network.actuators if link in network.links and network.acknowledges(link))
    told = network.lateness(informs)
    refused = {
        "the cost has a horizon or a discount; expected an average cost": cost.mission,
        "plant.D is given; expected outputs without a direct feedthrough": plant.D is not None,
        "another link has a constant delay; expected no other delay": plant.transport is not None
        and plant.transport.certain is not None,
    }
    for got in (got for got, holds in refused.items() if holds):
        raise ProblemError(f"{told}, with acknowledgements, and {got}, or a link without acknowledgements")
    if kept is not None and design_delay is not None:
        raise ProblemError(
            f"design_delay is {design_delay:g}, and a controller is given; expected no design_delay: the controller "
            "states its own gains"
        )
    base = LateBase(kind, with_transport(plant, None), cost, period, kept, network, design_delay, best)
    try:
        closed = base.closed()
    except UnstableError as error:
        raise UnstableError(f"{error}{base.sooner()}") from None
    loop, found, nodes, problem = closed.loop, closed.found, closed.nodes, closed.loop.problem
    J = found.cost - problem.noise_cost
    price, fourth = price_at(J), fourth_growth(found)
    made = _LateSteps(
        problem, loop if kept is not None else None, found, closed.pieces, closed.state, closed.K, price, nodes
    )
    steps, initial = made.steps()
    bound = bound_by_attempts(problem, J, price, 1, True, kept is None) if fourth < 1 else None
    if bound is not None and len(nodes.links) > 1:
        bound = replace(bound, statement=f"{bound.statement}; {WEIGHTED_RATE}", weights=nodes.weights)
    added = [Form(plus={made.cost(sent): 1.0 / problem.unit}) for sent in nodes.sets[:-1]]
    claims = Theory(
        cost_lqg=loop.cost_lqg,
        guarantee=bound,
        identity=Identity(problem.per_unit(J), (*added, Form()), SEND),
        covers=GAUSSIAN_THEORY | LATE | BURSTS,
        functions=frozenset({BELIEF, COSTS}),
        fourth=fourth,
        periodic=PeriodicPackets(base, closed) if len(nodes.links) == 1 else None,
    )
    settling = max(1 / (1 - found.growth), 1 / (1 - problem.filter().slowest))
    nominal = Nominal(problem, J, settling, disturbance=loop.disturbance)
    begun = loop.point.begun(steps, initial, {one.node: one.rows for one in nodes.all})
    sites = network.sites if network.own_nodes else COLLOCATED
    policy = nominal.policy(kind, steps, begun, claims, sites=sites, network=network)
    return replace(policy, notes=(*policy.notes, *loop.notes))


@dataclass(frozen=True, eq=False, repr=False)
class _LateSteps(Displayed):
    """The policy steps of all nodes. In the names of signals, ``sent j`` is the command of j steps ago."""

    problem: Discrete
    given: GivenLoop | None  # the loop of a given controller; None: LQG
    found: LateValue
    pieces: Pieces | None  # of a period, if inputs change within it
    state: tuple[str, ...]  # the signals of s
    K: Gain  # of the command on z
    price: float
    nodes: Receivers

    def steps(self) -> tuple[tuple[Step, ...], dict[str, Array]]:
        """Return the policy steps, and the initial values of their memories."""
        plant, at, depth, given = self.problem.plant, self.at, self.depth, self.given
        unit = np.eye(plant.inputs)
        if self.nodes.told_late:
            return self._steps_told_late()
        before, estimation = self._measured(), estimate_state(plant, self.problem.filter(), at)
        initial = dict(estimation.initial)
        before += estimation.correct
        in_flight = self._in_flight_decisions()
        if given is None:
            before += [*in_flight, *self._command()]
        else:
            c = given.controller
            shown = {ESTIMATE: plant.C} if plant.full_state else {"prior": plant.C, INNOVATION: np.eye(plant.outputs)}
            before.append(Assign(at, MEASURED, shown))
            if len(c.A):
                before.append(Assign(at, REGISTER, {NEXT: np.eye(len(c.A))}))
                initial[NEXT] = given.point.start
            before += [Assign(at, COMMAND, nonempty({REGISTER: c.C, MEASURED: c.D})), *in_flight]
        watched = self._watched_flight() if len(self.found.chain.delays.turns) == 1 else self._believed()
        rest = [*self._acting(COMMAND), *self._tried(), *watched.after]
        for age in range(depth, 1, -1):
            rest.append(Assign(at, self.sent[age - 1], {self.sent[age - 2]: unit}))
        if depth:
            rest.append(self._by_set(self.sent[0], unit, COMMAND))
        if not plant.full_state:
            effects = [plant.B] if self.pieces is None else np.split(self.pieces.B, self.count, axis=1)
            rest.append(Assign(at, "prior", {ESTIMATE: plant.A, **dict(zip(self.pieced, effects, strict=True))}))
        rest.append(Assign(at, HELD, {self.pieced[-1]: unit}))
        if given is not None and len(given.controller.A):
            c = given.controller
            rest.append(Assign(at, NEXT, nonempty({REGISTER: c.A, MEASURED: c.B, HELD: c.E})))
        return (*before, *watched.before, *self._decide(), *rest), {**initial, **watched.initial}

    def _measured(self) -> list[Step]:
        """Return the step that collects the measurements of several sensors, if there are any."""
        plant = self.problem.plant
        measured = self.nodes.network.measurements(plant.sensed, plant.set_points)
        if "y" in measured:
            return []
        outputs = {name: rows for name, (_, rows) in measured.items() if name != REFERENCE}
        return [Assign(self.at, "y", {name: np.eye(plant.sensed)[:, [*rows]] for name, rows in outputs.items()})]

    def _steps_told_late(self) -> tuple[tuple[Step, ...], dict[str, Array]]:
        """Return the policy steps and initial values if acknowledgements tell, after a decision, of the step before.

        All memories are those of the beginning of that step, and follow once its outcome is known.
        """
        plant, at, given, depth = self.problem.plant, self.at, self.given, self.depth
        assert given is not None, "LQG needs to know which inputs act"
        c, steady, unit = given.controller, self.problem.filter(), np.eye(plant.inputs)
        has_state = bool(len(c.A))
        before = [*self._measured(), Assign(at, MEASURED, outputs_of(plant))]
        if has_state:
            before.append(Assign(at, REGISTER, {NEXT: np.eye(len(c.A))}))
        before.append(Assign(at, COMMAND, nonempty({REGISTER: c.C, MEASURED: c.D})))
        flags = self._flags()
        tried = [self.nodes.named(TRIED, one.node) for one in self.nodes.all if one.linked and not one.sure]
        known = (*self.sent, HELD, LAST)  # in the order of the columns of ``Way``
        reads = (ESTIMATE, MEASURED, *((REGISTER,) if has_state else ()), *known, *tried, *flags.values())
        sets = self.nodes.sets[:-1]
        before.append(Apply(at, {COSTS: len(sets)}, self._histories(flags, len(known)), reads))
        for sent, row in zip(sets, np.eye(len(sets)), strict=True):
            before.append(Assign(at, self.cost(sent), {COSTS: row[None]}))
        effects = [plant.B] if self.pieces is None else np.split(self.pieces.B, self.count, axis=1)
        rest: list[Step] = [*self._acting(LAST), *self._flown(flags)]
        rest.append(Assign(at, "prior", {ESTIMATE: plant.A, **dict(zip(self.pieced, effects, strict=True))}))
        rest.append(Assign(at, INNOVATION, {MEASURED: np.eye(plant.outputs), "prior": -plant.C}))
        rest.append(Assign(at, ESTIMATE, {"prior": np.eye(plant.states), INNOVATION: steady.gain}))
        rest.append(Assign(at, HELD, {self.pieced[-1]: unit}))
        for age in range(depth, 0, -1):
            rest.append(Assign(at, self.sent[age - 1], {self.sent[age - 2] if age > 1 else LAST: unit}))
        rest += [self._by_set(LAST, unit, COMMAND), *self._tried()]
        begun = plant.mean - plant.B @ given.point.before
        first: Array = np.asarray(np.linalg.lstsq(plant.A, begun, rcond=None)[0], dtype=np.float64)
        initial: dict[str, Array] = {ESTIMATE: first}
        if given.point.before.any():
            initial |= dict.fromkeys((*self.sent, LAST), given.point.before)
        if has_state:
            rest.append(Assign(at, NEXT, nonempty({REGISTER: c.A, MEASURED: c.B})))
            initial[NEXT] = given.point.start
        return (*before, *self._decide(), *rest), initial

    def _histories(self, flags: Mapping[tuple[int, int], str], known: int) -> Histories:
        """Return the function that weighs the outcomes of the last step."""
        found, nodes, plant = self.found, self.nodes, self.problem.plant
        steady, n = self.problem.filter(), len(found.chain.plant.noise)
        S = steady.innovation[: plant.sensed, : plant.sensed]
        if np.linalg.eigvalsh(S)[0] <= LEAST_NOISE * np.trace(S):
            raise ProblemError(
                f"{nodes.late_by_one} is 1, and a combination of the outputs has no noise (plant.V, plant.W); expected "
                "noise on all outputs, which tells how likely each history is"
            )
        precision = np.zeros_like(steady.innovation)
        precision[: plant.sensed, : plant.sensed] = np.linalg.inv(S)
        effects = plant.B if self.pieces is None else self.pieces.B
        watched = [i for i, one in enumerate(nodes.all) if one.linked and not one.sure]
        ways = list[Way]()
        for sent, steps in found.chain.outcomes.items():
            if not all(goes for i, goes in enumerate(sent) if i not in watched):  # their inputs are those of LAST
                continue
            for mode, outcomes in zip(self._modes(), steps, strict=True):
                for one in outcomes:
                    motion, fractions = one.motion, np.array(one.motion.fractions)
                    acts = [int((fractions <= cut + WHOLE).sum()) for cut in self.cuts]
                    moved = effects @ np.vstack([motion.inputs[i][:, n:] for i in acts])
                    kept = np.hstack([motion.problem.A[n:, n:], motion.problem.B[n:]])
                    Psi = np.array([found.Psi[nodes.sent(links)][one.after] for links in nodes.sets[:-1]])
                    psi = np.array([found.psi[nodes.sent(links)][one.after] for links in nodes.sets[:-1]])
                    flight, tried = tuple(key in mode for key in flags), tuple(sent[i] for i in watched)
                    ways.append(Way(flight, tried, one.chance, moved, kept, Psi, psi))
        if len(ways) > MOST_HISTORIES:
            raise ProblemError(
                f"{nodes.late_by_one} is 1, and packets that arrive up to {number_of(self.depth, 'period')} late have "
                f"{len(ways)} histories of a step; expected at most {MOST_HISTORIES}: shorter delays, a buffer, or "
                "acknowledgements before the next step"
            )
        most = 2 * self.price + found.cost + 1  # above the price in any case
        return Histories(tuple(ways), plant.A, plant.C, steady.gain, precision, known, most)

    @property
    def at(self) -> str:
        """The node that controls."""
        return self.nodes.network.controller

    @property
    def depth(self) -> int:
        """Largest number of whole periods after which a packet may arrive."""
        return self.found.chain.delays.depth

    @property
    def cuts(self) -> tuple[float, ...]:
        """The parts of a period at which its pieces begin."""
        return (0.0,) if self.pieces is None else self.pieces.cuts

    @property
    def count(self) -> int:
        """Number of the pieces of a period."""
        return len(self.cuts)

    @property
    def sent(self) -> list[str]:
        """Names of the last commands, the newest first."""
        return [f"sent {age}" for age in range(1, self.depth + 1)]

    @property
    def pieced(self) -> list[str]:
        """Names of the inputs that act in each piece of the period."""
        return [f"acting {piece}" for piece in range(self.count)]

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals of z."""
        return (*self.state, *self.sent, HELD)

    def cost(self, sent: Sequence[str]) -> str:
        """Return the name of what it costs that only a set of links sends."""
        return f"{COST} if {label(sent)}" if sent else COST

    def _acting(self, command: str) -> list[Step]:
        """Return the steps that compute which inputs acted in each piece of the period, by the acknowledgements."""
        unit, nodes, found = np.eye(self.problem.plant.inputs), self.nodes, list[Step]()
        # a last command is one that has been sent, or repeats what is applied
        wired = nodes.chosen([one.sure if command == LAST else not one.linked for one in nodes.all])
        for piece, name in enumerate(self.pieced):
            found.append(Assign(self.at, name, _nonzero({HELD: unit - wired, command: wired})))
            for one in (one for one in nodes.all if one.linked and not (one.sure and command == LAST)):
                own = nodes.chosen([other is one for other in nodes.all])
                for age in range(one.delays.depth, -1, -1):  # the newest packet last
                    value = self.sent[age - 1] if age else command
                    new = _nonzero({name: unit - own, value: own})
                    on, told = self._arrival(one, age, piece)
                    found.append(Assign(self.at, name, tuple(new if goes else {name: unit} for goes in told), on))
        return found

    def _arrival(self, one: Receiver, age: int, piece: int) -> tuple[Condition, tuple[bool, ...]]:
        """Return the condition that shows whether a packet arrived before a piece ends, and its outcomes that do."""
        if one.law is not None:
            return Acted(one.node, age, piece), (False, True)
        if not one.sure:
            return Acknowledged(one.node), (False, True)
        return SEND, tuple(one.node in sent for sent in self.nodes.sets)

    def _by_set(self, name: str, unit: Array, value: str) -> Step:
        """Return the step that takes up those entries of a value that are sent, and keeps the others."""
        branches = list[dict[str, Array]]()
        for sent in self.nodes.sets:
            new = self.nodes.chosen(self.nodes.sent(sent))
            branches.append(_nonzero({name: unit - new, value: new}))
        return Assign(self.at, name, tuple(branches), SEND)

    def _decide(self) -> list[Step]:
        """Return the decision, the packets, and what the actuators do with them."""
        nodes, found = self.nodes, list[Step]()
        options: dict[str, Form] = {}
        for sent in nodes.sets[:-1]:
            share = self.price * sum(nodes.weights[link] for link in sent)
            options[nodes.label(sent)] = Form(plus={self.cost(sent): 1.0}, constant=share)
        options[nodes.label(nodes.sets[-1])] = Form(constant=self.price)
        found.append(Decide(self.at, SEND, Trigger(options)))
        unit = np.eye(self.problem.plant.inputs)
        alone = len(nodes.all) == 1
        names = {one.node: COMMAND if alone else f"{COMMAND}_{one.node}" for one in nodes.all}
        for one in nodes.all if not alone else ():
            found.append(Assign(self.at, names[one.node], {COMMAND: unit[one.rows]}))
        for one in (one for one in nodes.all if one.linked):
            labels = () if alone else tuple(nodes.label(sent) for sent in nodes.sets if one.node in sent)
            found.append(Send(self.at, one.node, (names[one.node],), SEND, labels))
        for one in nodes.all:
            own = {names[one.node]: np.eye(len(one.rows))}
            held: Terms = {one.signal: np.eye(len(one.rows))}
            if one.linked:
                found.append(Assign(one.node, one.signal, (held, own), Received(one.node)))
            else:
                found.append(Assign(one.node, one.signal, own))
        return found

    def _tried(self) -> list[Step]:
        """Return the steps that remember on which links packets were sent."""
        none, one = np.zeros((1, 1)), np.ones((1, 1))
        found = list[Step]()
        for receiver in (receiver for receiver in self.nodes.all if receiver.linked and not receiver.sure):
            told = tuple({ONE: one if receiver.node in sent else none} for sent in self.nodes.sets)
            found.append(Assign(self.at, self.nodes.named(TRIED, receiver.node), told, SEND))
        return found

    def _watched_flight(self) -> _Watched:
        """Return the steps of links with one state: a flag for each packet says whether it is in flight."""
        found, nodes, flags, before = self.found, self.nodes, self._flags(), list[Step]()
        if (len(nodes.sets) - 1) << len(flags) > MOST_FORMS:
            raise ProblemError(
                f"packets that arrive up to {number_of(self.depth, 'period')} late, over "
                f"{number_of(len(nodes.links), 'link')}, have {2 ** len(flags)} sets of packets in flight and "
                f"{len(nodes.sets)} sets of links to choose from; expected at most {MOST_FORMS} combinations: shorter "
                "delays, a buffer, or fewer links"
            )
        for sent in nodes.sets[:-1]:
            Psi, psi = (values[nodes.sent(sent)] for values in (found.Psi, found.psi))
            # a set of packets is not a mode if they are never in flight together
            costs = {mode: Form(self.signals, Psi[i], float(psi[i])) for i, mode in enumerate(self._modes())}
            before += self._selected(costs, flags, self.cost(sent), np.ones((1, 1)), self._evaluated)
        return _Watched(tuple(before), tuple(self._flown(flags)), {})

    def _flags(self) -> dict[tuple[int, int], str]:
        """Name the signals, 1 or 0, that say whether a packet is in flight, by its receiver and its age."""
        found: dict[tuple[int, int], str] = {}
        for place, receiver in enumerate(self.nodes.all):
            for age in range(1, receiver.delays.depth + 1):
                found[place, age] = self.nodes.named(f"flight {age}", receiver.node)
        return found

    def _modes(self) -> list[frozenset[tuple[int, int]]]:
        """Return the packets in flight in each mode, by receiver and age; with one state of the links, they are it."""
        modes = self.found.chain.modes
        return [frozenset((i, packet.age) for packet in mode.flight for i in packet.receivers) for mode in modes]

    def _flown(self, flags: Mapping[tuple[int, int], str]) -> list[Step]:
        """Return the steps that follow the packets in flight, by the acknowledgements of a step."""
        nodes, after, one = self.nodes, list[Step](), np.ones((1, 1))
        for place, receiver in enumerate(nodes.all):
            names = {0: nodes.named(TRIED, receiver.node)}
            names |= {age: flags[place, age] for age in range(1, receiver.delays.depth + 1)}
            for age in range(receiver.delays.depth - 1, -1, -1):
                flag = names[age + 1]
                arrived = Acted(receiver.node, age, self.count - 1)
                after.append(Assign(self.at, flag, ({names[age]: one}, {ONE: 0.0 * one}), arrived))
                for newer in range(age):
                    arrived = Acted(receiver.node, newer, self.count - 1)
                    after.append(Assign(self.at, flag, ({flag: one}, {ONE: 0.0 * one}), arrived))
        return after

    def _in_flight_decisions(self) -> list[Step]:
        """Return the decisions whether each packet is in flight, if the states of the links are known."""
        if len(self.found.chain.delays.turns) > 1:
            return []
        found = list[Step]()
        for key, flag in self._flags().items():
            none_or_some = Trigger({"no": Form(plus={flag: 1.0}), "yes": Form(constant=0.5)})  # the flag is 0 or 1
            found.append(Decide(self.at, self._in_flight(key), none_or_some))
        return found

    def _command(self) -> list[Step]:
        """Return the steps that compute the command of LQG, whose gain may depend on the packets in flight."""
        n, m, depth = self.problem.plant.states, self.problem.plant.inputs, self.depth
        ends = [n, *(n + m * age for age in range(1, depth + 1))]

        def terms(gain: Array) -> dict[str, Array]:
            return dict(zip((ESTIMATE, *self.sent, HELD), np.split(gain, ends, axis=1), strict=True))

        if not callable(self.K):
            return [Assign(self.at, COMMAND, terms(self.K))]
        gains = zip(self._modes(), self.found.chain.gains, strict=True)
        sums = {mode: terms(gain) for mode, gain in gains}
        return self._selected(sums, self._flags(), COMMAND, np.eye(m), self._assigned)

    def _assigned(self, name: str, sums: Sequence[dict[str, Array]], on: str | None) -> Step:
        return Assign(self.at, name, tuple(sums) if on else sums[0], on)

    def _evaluated(self, name: str, forms: Sequence[Form], on: str | None) -> Step:
        return Evaluate(self.at, name, tuple(forms), on)

    def _in_flight(self, key: tuple[int, int]) -> str:
        """Return the name of the decision whether a packet is in flight, by its receiver and age."""
        return f"{self.nodes.named(f'packet {key[1]}', self.nodes.all[key[0]].node)} is in flight"

    def _selected(
        self,
        costs: Mapping[frozenset[tuple[int, int]], Part],
        flags: Mapping[tuple[int, int], str],
        cost: str,
        unit: Array,
        step: Callable[[str, Sequence[Part], str | None], Step],
    ) -> list[Step]:
        """Return the steps that compute what depends on the mode, the set of packets in flight."""
        empty = frozenset[tuple[int, int]]()
        if not flags:
            return [step(cost, (costs[empty],), None)]
        first, *others = flags
        found = list[Step]()
        # the first packet selects a form; each further one selects between two values
        names: dict[frozenset[tuple[int, int]], str] = {}
        for mode in _subsets(others):
            name = cost if not others else f"{cost} with {self._packets(mode)} in flight"
            forms = (costs.get(mode, costs[empty]), costs.get(mode | {first}, costs[empty]))
            found.append(step(name, forms, self._in_flight(first)))
            names[mode] = name
        for key in others:
            merged: dict[frozenset[tuple[int, int]], str] = {}
            for mode in (mode for mode in names if key not in mode):
                till = self.nodes.named(str(key[1]), self.nodes.all[key[0]].node)
                name = cost if key == others[-1] else f"{cost} up to {till} with {self._packets(mode)} in flight"
                branches = {names[mode]: unit}, {names[mode | {key}]: unit}
                found.append(Assign(self.at, name, branches, self._in_flight(key)))
                merged[mode] = name
            names = merged
        return found

    def _packets(self, mode: frozenset[tuple[int, int]]) -> str:
        """Name the packets that are in flight."""
        if not mode:
            return "no older packet"
        if len(self.nodes.all) == 1:
            return "packets " + ", ".join(str(age) for _, age in sorted(mode))
        return "packets " + ", ".join(f"{age} to {self.nodes.all[i].node}" for i, age in sorted(mode))

    def _believed(self) -> _Watched:
        """Return the steps of links with several states, which nobody knows: the cost is the mean over the modes."""
        found, chain, nodes = self.found, self.found.chain, self.nodes
        modes, depth, one = len(chain.modes), chain.delays.depth, np.ones((1, 1))
        if modes > MOST_BELIEVED:
            raise ProblemError(
                f"packets that arrive up to {number_of(depth, 'period')} late, over links of "
                f"{number_of(len(chain.delays.turns), 'state')}, have {number_of(modes, 'mode')}; expected at most "
                f"{MOST_BELIEVED}: shorter delays, a buffer, or fewer states"
            )
        before = list[Step]()
        half = 0.5 * np.eye(modes)
        product = np.block([[0.0 * half, half], [half, 0.0 * half]])  # of the belief and the costs
        for sent in nodes.sets[:-1]:
            Psi, psi = (values[nodes.sent(sent)] for values in (found.Psi, found.psi))
            names = [f"cost {f'if {label(sent)} ' if sent else ''}in mode {i}" for i in range(modes)]
            forms = [Form(self.signals, Psi[i], float(psi[i])) for i in range(modes)]
            before += [Evaluate(self.at, name, (form,)) for name, form in zip(names, forms, strict=True)]
            before.append(Evaluate(self.at, self.cost(sent), (Form((BELIEF, *names), product),)))
        after, tried, arrivals = list[Step](), list[str](), list[str]()
        unsure = [place for place, receiver in enumerate(nodes.all) if not receiver.sure]
        for receiver in (nodes.all[place] for place in unsure):
            tried.append(nodes.named(TRIED, receiver.node))
            for age in range(receiver.delays.depth + 1):
                name = nodes.named(f"arrival {age}", receiver.node)
                arrivals.append(name)
                after.append(Assign(self.at, name, {ONE: -one}))
                for piece in reversed(range(self.count if receiver.law is not None else 1)):
                    on, _ = self._arrival(receiver, age, piece)
                    after.append(Assign(self.at, name, ({name: one}, {ONE: piece * one}), on))
        start = np.zeros(modes)
        for i, mode in enumerate(chain.modes):
            if not mode.flight:
                start[i] = stationary(chain.delays.turns)[mode.link]
        ages = [nodes.all[place].delays.depth + 1 for place in unsure]
        update = LateBelief.of(found, self.cuts, start, dict(zip(unsure, ages, strict=True)))
        after.append(Apply(self.at, {BELIEF: modes}, update, (BELIEF, *tried, *arrivals)))
        return _Watched(tuple(before), tuple(after), {BELIEF: start})


@dataclass(frozen=True, eq=False, repr=False)
class _Watched(Displayed):
    """The policy steps that compute the cost of silence, and those that follow the packets in flight."""

    before: tuple[Step, ...]  # before the decision
    after: tuple[Step, ...]  # after the packet, with the acknowledgements of the step
    initial: dict[str, Array]


def _nonzero(terms: dict[str, Array]) -> dict[str, Array]:
    """Remove the terms whose matrix is zero, unless all are."""
    return {name: matrix for name, matrix in terms.items() if matrix.any()} or terms


def _subsets(keys: Sequence[tuple[int, int]]) -> list[frozenset[tuple[int, int]]]:
    """Return all sets of packets, by receiver and age."""
    return [frozenset(key for i, key in enumerate(keys) if code >> i & 1) for code in range(1 << len(keys))]
