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

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from taciturn._arrays import Array
from taciturn._text import number_of
from taciturn.base.filter import COLLOCATED, ESTIMATE, HELD, SEND, estimate_state, outputs_of
from taciturn.base.given_controller import GivenLoop
from taciturn.base.late import fourth_growth
from taciturn.base.nominal import Nominal
from taciturn.base.route import MEASURED, NEXT, REGISTER, nonempty
from taciturn.design.bounds import bound_by_attempts
from taciturn.design.late_base import Gain, LateBase, PeriodicPackets, acknowledged_links
from taciturn.design.late_belief import Histories, Way
from taciturn.design.late_flight import BELIEF, COSTS, LAST, TRIED, FlightSteps
from taciturn.design.several_nodes import (
    COMMAND,
    WEIGHTED_RATE,
)
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.registers import Pieces
from taciturn.model.controller import AnyController
from taciturn.model.cost import Cost
from taciturn.model.coverage import BURSTS, GAUSSIAN_THEORY, LATE
from taciturn.model.delay import WHOLE
from taciturn.model.network import REFERENCE, Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import (
    Apply,
    Assign,
    Received,
    Send,
    Step,
    Terms,
)
from taciturn.model.theory import INNOVATION, Identity, Theory
from taciturn.model.transport import with_transport
from taciturn.model.trigger import Form

MOST_HISTORIES = 256  # outcomes of a step that is not acknowledged yet
LEAST_NOISE = 1e-12  # share of an output's error in all of them, below which it counts as none


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
    links = acknowledged_links(network)
    risky = [link for link in links if network.loss(link) > 0 or link in network.late]
    # the plant shows the mean of random delays too, and then what is certain apart from it
    delayed = plant.transport is not None and (not network.late or plant.transport.certain is not None)
    if delayed and not risky:
        raise ProblemError(
            f"{' and '.join(network.key(link, 'acknowledged') for link in links)}: acknowledgements are given together "
            "with a constant delay, although every packet arrives at a known time; expected no acknowledgements: "
            "remove them, and the design knows each delay"
        )
    first = (risky or links)[0]
    told = network.lateness(first) if first in network.late else f"{network.lost(first)} is given"
    refused = {
        "the cost has a horizon or a discount; expected an average cost": cost.mission,
        "plant.D is given; expected outputs without a direct feedthrough": plant.D is not None,
        "another link has a constant delay; expected no other delay": delayed,
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
    # where the fourth moments grow, z'Ψz has no variance, and no measured rate or cost has an error
    price, fourth = price_at(J), fourth_growth(found)
    cuts = (0.0,) if closed.pieces is None else closed.pieces.cuts
    flight = network.controller, nodes, found, cuts, price, closed.state, HELD
    made = _ActuatorSteps(*flight, problem, loop if kept is not None else None, closed.pieces, closed.K)
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
    # the growth is that of second moments, so of costs; the filter's modes are those of the state itself
    settling = max(1 / (1 - found.growth), 1 / (1 - problem.filter().slowest))
    nominal = Nominal(problem, J, settling, disturbance=loop.disturbance)
    begun = loop.point.begun(steps, initial, {one.node: one.rows for one in nodes.all})
    sites = network.sites if network.own_nodes else COLLOCATED
    policy = nominal.policy(kind, steps, begun, claims, sites=sites, network=network)
    return replace(policy, notes=(*policy.notes, *loop.notes))


@dataclass(frozen=True, eq=False, repr=False)
class _ActuatorSteps(FlightSteps):
    """The policy steps of all nodes, for packets from the controller to the actuators."""

    problem: Discrete
    given: GivenLoop | None  # the loop of a given controller; None: LQG
    pieces: Pieces | None  # of a period, if inputs change within it
    K: Gain  # of the command on z

    def steps(self) -> tuple[tuple[Step, ...], dict[str, Array]]:
        """Return the policy steps, and the initial values of their memories."""
        plant, at, given = self.problem.plant, self.at, self.given
        unit = np.eye(plant.inputs)
        if self.nodes.told_late:
            return self._steps_told_late()
        before, estimation = self._measured(), estimate_state(plant, self.problem.filter(), at)
        initial = dict(estimation.initial)
        before += estimation.correct
        in_flight = self.in_flight_decisions()
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
        watched = self.watched()
        rest = [*self.acting(COMMAND), *self.tried(), *watched.after]
        rest += self.aged(COMMAND)
        if not plant.full_state:
            effects = [plant.B] if self.pieces is None else np.split(self.pieces.B, self.count, axis=1)
            rest.append(Assign(at, "prior", {ESTIMATE: plant.A, **dict(zip(self.pieced, effects, strict=True))}))
        # the input that acts at the end of the period, which is held until a newer packet arrives
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
        flags = self.flags()
        tried = [self.nodes.named(TRIED, one.node) for one in self.nodes.all if one.linked and not one.sure]
        known = (*self.sent, HELD, LAST)  # in the order of the columns of ``Way``
        reads = (ESTIMATE, MEASURED, *((REGISTER,) if has_state else ()), *known, *tried, *flags.values())
        sets = self.nodes.sets[:-1]
        before.append(Apply(at, {COSTS: len(sets)}, self._histories(flags, len(known)), reads))
        for sent, row in zip(sets, np.eye(len(sets)), strict=True):
            before.append(Assign(at, self.cost(sent), {COSTS: row[None]}))
        effects = [plant.B] if self.pieces is None else np.split(self.pieces.B, self.count, axis=1)
        rest: list[Step] = [*self.acting(LAST), *self.flown(flags)]
        rest.append(Assign(at, "prior", {ESTIMATE: plant.A, **dict(zip(self.pieced, effects, strict=True))}))
        rest.append(Assign(at, INNOVATION, {MEASURED: np.eye(plant.outputs), "prior": -plant.C}))
        rest.append(Assign(at, ESTIMATE, {"prior": np.eye(plant.states), INNOVATION: steady.gain}))
        rest.append(Assign(at, HELD, {self.pieced[-1]: unit}))
        for age in range(depth, 0, -1):
            rest.append(Assign(at, self.sent[age - 1], {self.sent[age - 2] if age > 1 else LAST: unit}))
        rest += [self.by_set(LAST, COMMAND), *self.tried()]
        # the memories are one step old: the state before the first, from which A and the inputs lead to the mean
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
        # a history that holds lets the innovations be those of the filter; set-points tell nothing of it
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
            for mode, outcomes in zip(self.modes(), steps, strict=True):
                for one in outcomes:
                    motion, fractions = one.motion, np.array(one.motion.fractions)
                    # which of the inputs of this outcome acts in each piece of the period
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
                f"{number_of(len(ways), 'outcome')} of a step; expected at most {MOST_HISTORIES}: shorter delays, a "
                "buffer, or acknowledgements before the next step"
            )
        most = 2 * self.price + found.cost + 1  # above the price in any case
        return Histories(tuple(ways), plant.A, plant.C, steady.gain, precision, known, most)

    def _decide(self) -> list[Step]:
        """Return the decision, the packets, and what the actuators do with them."""
        nodes, found = self.nodes, list[Step]()
        found.append(self.decision())
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

    def _command(self) -> list[Step]:
        """Return the steps that compute the command of LQG, whose gain may depend on the packets in flight."""
        n, m, depth = self.problem.plant.states, self.problem.plant.inputs, self.depth
        ends = [n, *(n + m * age for age in range(1, depth + 1))]

        def terms(gain: Array) -> dict[str, Array]:
            return dict(zip((ESTIMATE, *self.sent, HELD), np.split(gain, ends, axis=1), strict=True))

        if not callable(self.K):
            return [Assign(self.at, COMMAND, terms(self.K))]
        gains = zip(self.modes(), self.found.chain.gains, strict=True)
        sums = {mode: terms(gain) for mode, gain in gains}
        return self.selected(sums, self.flags(), COMMAND, np.eye(m), self.assigned)
