"""The loop that sends every sample over links with random delays and losses: its receivers, its value, its gains.

Each actuator receives its inputs over a link with a law of delays and losses, or is at the controller's site, where
every input arrives at once. ``LateBase`` closes the loop of LQG or of a given controller over them (``base/late``).

LQG has the gains with the least cost in each mode, or those for a constant delay, by default the mean delay of the
packets that arrive. With d whole periods and a part of one, the latter are those of the plant with registers for the
last commands (``lqg/registers``). A command that is still to act is in a packet that may be in flight or lost, so the
registers take the last commands that were sent, and the oldest one the input that acts.

If the mean square of the loop grows, the error says by how much sooner packets would have to arrive (``sooner``).
``PeriodicPackets`` is the cost of the same loop with a packet at every q-th step.

Source: nilsson1998, antunes2014rollout
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from taciturn._arrays import Array, number
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.base.filter import ESTIMATE, SEND
from taciturn.base.given_controller import GivenLoop, lqg_observer
from taciturn.base.late import Delays, LateValue, Mode, best_gains, chain_of, late_value, periodic_cost
from taciturn.base.periods import Periods, periods_of, with_controller, with_filter
from taciturn.base.route import MEASURED, REGISTER
from taciturn.design.kind import check_place
from taciturn.design.several_nodes import (
    actuators_of,
    decides_on_sets,
    expect_few_links,
    label,
    sets_of,
    shares_of_prices,
)
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.lqg.periodic import Held
from taciturn.lqg.registers import Pieces, registers_of
from taciturn.model.controller import AnyController, Controller
from taciturn.model.cost import Cost
from taciturn.model.delay import LONGEST, DelayLaw, Transport, Wait
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.transport import with_transport

Gain: TypeAlias = Array | Callable[[Mode], Array]  # of the command on z, or by the mode
OTHER_GAINS = "gains for another delay (design_delay)"
PARTS = 64  # of a period, in which delays are tried that would be short enough


def informed(network: Network) -> bool:
    """Return whether acknowledgements tell when packets arrived that are late or, on several links, may be lost."""
    told = acknowledged_links(network)
    return bool(told if decides_on_sets(network) else set(told).intersection(network.late))


def acknowledged_links(network: Network) -> tuple[str, ...]:
    """Return the links to actuators whose packets are acknowledged."""
    return tuple(node for node in network.actuators if node in network.links and network.acknowledges(node))


@dataclass(frozen=True, eq=False, repr=False)
class ClosedBase(Displayed):
    """The loop that sends every sample, with its value, and what its policy needs."""

    loop: GivenLoop
    nodes: Receivers
    pieces: Pieces | None  # of a period, if inputs change within it
    state: tuple[str, ...]  # the signals of s
    K: Gain  # of the command on z
    found: LateValue


@dataclass(frozen=True, eq=False, repr=False)
class LateBase(Displayed):
    """The plant, the control and the network that determine the loop that sends every sample."""

    kind: str
    plant: Plant | ContinuousPlant  # without delays
    cost: Cost
    period: float | None
    kept: AnyController | None  # None: LQG
    network: Network
    design_delay: float | None
    best: bool = False  # whether LQG has the gains with the least cost, by the packets in flight

    def closed(self) -> ClosedBase:
        """Close the loop and compute its value.

        Raises:
            UnstableError: its mean square grows.
        """
        plant, cost, period, kept, network = self.plant, self.cost, self.period, self.kept, self.network
        if kept is None:
            problem = discretise(plant, cost, period)
            loop = GivenLoop.of(plant, cost, period, lqg_observer(self.kind, problem), True)
        else:
            loop = GivenLoop.of(plant, cost, period, kept)
        problem, tick = loop.problem, loop.problem.tick
        nodes = Receivers.of(self.kind, network, problem.plant, tick)
        cuts = network.cuts(tick)
        source = problem.source
        assert source is not None, "a sampled problem knows its plant"
        seconds = tick if problem.sampled else None
        pieces = discretise(source, problem.cost, seconds, None, cuts).pieces if cuts else None
        delays, whole = Delays.together([one.delays for one in nodes.all]), periods_of(problem, pieces)
        rows = [tuple(one.rows) for one in nodes.all]
        if nodes.told_late:
            _expect_uninformed(nodes, loop if kept is not None else None, len(delays.turns))
        if kept is None:
            base, state = with_filter(whole, problem.filter()), (ESTIMATE,)
            K = self.gain(nodes, base, delays)
        else:
            base, K = with_controller(whole, loop.controller, problem.plant.C, problem.plant.V)
            state = (ESTIMATE, MEASURED, *((REGISTER,) if len(loop.controller.A) else ()))
        found = late_value(chain_of(base, K, delays, rows), loop.remedy if kept is not None else OTHER_GAINS)
        return ClosedBase(loop, nodes, pieces, state, K, found)

    def gain(self, nodes: Receivers, base: Periods, delays: Delays, every: int = 1) -> Gain:
        """Return the gain of LQG on z: the best one in each mode, or one for constant delays.

        With packets at every q-th step, it is the optimal one for an input that is held between them.
        """
        if not self.best:
            return self._gain_for_mean(nodes, delays.depth, every)
        if len(delays.turns) > 1:
            raise ProblemError(
                "gains = 'loss-optimal', and the state of a link with bursts is unknown; expected independent losses "
                "and delays, or gains = 'lqg'"
            )
        return best_gains(base, delays, [tuple(one.rows) for one in nodes.all], every).__getitem__

    def _gain_for_mean(self, nodes: Receivers, depth: int, every: int) -> Array:
        """Return the gain on z for constant delays: the given one, or for each link the mean of its own."""
        plant, given = self.plant, self.design_delay
        step = 1.0 if isinstance(plant, Plant) else float(self.period or 1.0)
        n, m, waits = plant.states, plant.inputs, [Wait()] * plant.inputs
        if given is not None:
            given = number("design_delay", given, 0.0, LONGEST * step, closed=True)
        for one in (one for one in nodes.all if one.law is not None):
            assert one.law is not None
            if given is not None:
                periods = given / step
            else:  # the mean of the odds may round to beyond the delays
                mean = one.law.mean_by(self.network.links[one.node].states)
                periods = float(np.clip(mean, one.law.waits[0], one.law.waits[-1]))
            for row in one.rows:
                waits[row] = Wait(int(np.round(periods))) if isinstance(plant, Plant) else Wait(0, periods * step)
        late = with_transport(plant, Transport.of(waits, [Wait()] * len(plant.C)))
        delayed = discretise(late, self.cost, self.period)
        L = delayed.regulator().L if every == 1 else _held_gain(delayed, every)
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

    def sooner(self) -> str:
        """Return by how much sooner all packets would have to arrive for a stable loop, as the end of a sentence."""
        late = {node: law for node in self.network.late if (law := self.network.links[node].played().delay) is not None}
        tick = float(self.period or 1.0) if isinstance(self.plant, ContinuousPlant) else 1.0
        whole = any(not law.in_seconds for law in late.values())
        unit = 1.0 if whole else 1.0 / PARTS  # in periods
        most = max((law.in_periods(tick).waits[-1] for law in late.values()), default=0.0)
        # bisected, as if stability were monotone: the answer is a hint in a message, and it was tried
        low, high = 0, int(np.ceil(most / unit))  # numbers of units: unstable, and perhaps stable
        if not high or not self._settles(late, high * unit, tick):
            return ""
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if self._settles(late, middle * unit, tick) else (middle, high)
        told = number_of(high, "step") if whole else f"{high * unit * tick * 1e3:.4g} ms"
        return f" (the factor is below 1 if every packet arrives {told} earlier, at the earliest at once)"

    def _settles(self, late: Mapping[str, DelayLaw], by: float, tick: float) -> bool:
        """Return whether the loop is stable if all delays are shorter by so many periods of ``tick``."""
        laws = {node: {"delay": law.later(-by * (tick if law.in_seconds else 1.0))} for node, law in late.items()}
        try:
            replace(self, network=self.network.changed(laws)).closed()
        except UnstableError:
            return False
        return True


def _held_gain(problem: Discrete, every: int) -> Array:
    """Return the optimal gain of an input that is held for ``every`` steps."""
    p = problem.plant
    return Held(p.A, p.B, problem.Q, problem.R, problem.N, np.zeros_like(p.W)).solve([every]).gains[0]


@dataclass(frozen=True, eq=False, repr=False)
class PeriodicPackets(Displayed):
    """Computes the cost per step of packets at every q-th step, with the same delays, losses and acknowledgements.

    It is the least of the costs of all gains that are known: those of the policy, and without a given controller those
    that are optimal for inputs that are held for q steps, if the delay were constant. A controller that can be designed
    for the longer period may also measure only when it sends.
    """

    base: LateBase
    closed: ClosedBase

    def __call__(self, steps: int) -> float:
        """Return the cost."""
        found = [cost for cost in (*self._every_sample(steps), self._longer(steps)) if cost is not None]
        if not found:
            raise UnstableError(f"periodic control is unstable with one packet in {number_of(steps, 'step')}")
        return min(found)

    def _every_sample(self, steps: int) -> list[float | None]:
        """Return the costs if the controller still computes at every step."""
        chain, problem = self.closed.found.chain, self.closed.loop.problem
        chains = [chain]
        if self.base.kept is None and steps > 1:
            with suppress(UnstableError):  # holding an input for so long may prevent stabilisation
                K = self.base.gain(self.closed.nodes, chain.plant, chain.delays, steps)
                rows = [tuple(one.rows) for one in self.closed.nodes.all]
                chains.append(chain_of(chain.plant, K, chain.delays, rows))
        costs = [periodic_cost(one, steps) for one in chains]
        return [None if cost is None else cost - problem.noise_cost for cost in costs]

    def _longer(self, steps: int) -> float | None:
        """Return the cost if the period is longer; None if the controller cannot be designed for it."""
        own, problem = self.base, self.closed.loop.problem
        if not isinstance(own.plant, ContinuousPlant) or own.period is None or isinstance(own.kept, Controller):
            return None
        try:
            long = replace(own, period=own.period * steps).closed()
        except (ProblemError, UnstableError):  # as with a filter that is faster than these steps
            return None
        cost = long.loop.problem.per_unit(long.found.cost - long.loop.problem.noise_cost)
        return cost * problem.unit - problem.noise_cost * problem.ticks


def _expect_uninformed(nodes: Receivers, given: GivenLoop | None, states: int) -> None:
    """Raise an error if the control needs to know which inputs act, or which state a link has, before it learns it."""
    refused = {
        "and LQG predicts with the inputs that act, which it learns too late; expected a given controller without "
        "controller.E": given is None,
        "and the controller reads the applied input (controller.E), which it learns too late; expected E = 0": (
            given is not None and bool(given.controller.E.any())
        ),
        "and the state of a link with bursts is unknown; expected independent losses and delays": states > 1,
    }
    for got in (got for got, holds in refused.items() if holds):
        raise ProblemError(f"{nodes.late_by_one} is 1, {got}, or acknowledgements before the next step")


@dataclass(frozen=True, eq=False, repr=False)
class Receiver(Displayed):
    """An actuator that receives its inputs over a link, or that is at the controller's site."""

    node: str
    signal: str  # the inputs that it applies
    rows: list[int]  # their indices among the inputs of the plant
    linked: bool
    law: DelayLaw | None  # of its link, in periods; None: a packet that arrives does so at once
    delays: Delays  # the same with the losses of the link

    @property
    def sure(self) -> bool:
        """Whether every packet arrives at once."""
        return self.delays.fates == (((0, 0.0),),)


@dataclass(frozen=True, eq=False, repr=False)
class Receivers(Displayed):
    """The actuators of a loop, and the sets of links on which the controller may send."""

    network: Network
    all: tuple[Receiver, ...]

    @staticmethod
    def of(kind: str, network: Network, plant: Plant, period: float) -> Receivers:
        """Return the actuators of a network, and check that the controller is informed of the fate of all packets."""
        found = list[Receiver]()
        for node, (signal, rows) in actuators_of(network, plant).items():
            linked = node in network.links
            if linked and not network.links[node].ideal and not network.acknowledges(node):
                raise ProblemError(
                    f"{network.key(node, 'acknowledged')} is false, and packets to other actuators are acknowledged; "
                    "expected acknowledgements on all links to actuators, or ideal links"
                )
            law = network.random_delay(node, period) if linked else None
            law_and_losses = delays_of(law, network, node) if linked else Delays.of([0.0], [1.0])
            found.append(Receiver(node, signal, rows, linked, law, law_and_losses))
        nodes = Receivers(network, tuple(found))
        expect_few_links(kind, nodes.links)
        unsure = [network.links[one.node] for one in found if one.linked and not one.sure]
        if nodes.told_late and not all(law.acknowledgement_delay for law in unsure):
            raise ProblemError(
                f"{nodes.late_by_one} is 1, and acknowledgements on another link come at once; expected the same "
                "acknowledgement_delay on all links that delay or drop packets"
            )
        for node in network.sensors if network.own_nodes else ():
            check_place(kind, network, "sensor", node, True)
        return nodes

    @property
    def told_late(self) -> bool:
        """Whether acknowledgements come one step late."""
        links = [self.network.links[one.node] for one in self.all if one.linked and not one.sure]
        return any(law.acknowledgement_delay for law in links)

    @property
    def late_by_one(self) -> str:
        """The key of problem files that states that acknowledgements come one step late."""
        return next(
            self.network.key(one.node, "acknowledgement_delay")
            for one in self.all
            if one.linked and self.network.links[one.node].acknowledgement_delay
        )

    @cached_property
    def links(self) -> tuple[str, ...]:
        """Names of the links, which are those of the actuators that have one."""
        return tuple(one.node for one in self.all if one.linked)

    @cached_property
    def weights(self) -> Mapping[str, float]:
        """Price of a packet on each link, divided by the sum of these prices over all links."""
        return shares_of_prices(self.network, self.links)

    @cached_property
    def sets(self) -> tuple[tuple[str, ...], ...]:
        """All sets of links that may send, the cheapest first; the last one contains all."""
        return sets_of(self.links, self.weights)

    def label(self, sent: Sequence[str]) -> str:
        """Return the label of the decision to send on a set of links."""
        return SEND if len(self.all) == 1 and sent else label(sent)

    def sent(self, links: Sequence[str]) -> tuple[bool, ...]:
        """Return for each actuator whether it gets a new input if a set of links sends."""
        return tuple(not one.linked or one.node in links for one in self.all)

    def chosen(self, sent: Sequence[bool]) -> Array:
        """Return the diagonal matrix, (m, m), that selects the inputs of some actuators."""
        rows = [row for one, goes in zip(self.all, sent, strict=True) for row in one.rows if goes]
        return np.diag(np.isin(np.arange(sum(len(one.rows) for one in self.all)), rows).astype(np.float64))

    def named(self, name: str, node: str) -> str:
        """Return the name of a signal that belongs to an actuator; with a single one it needs no further name."""
        return name if len(self.all) == 1 else f"{name} to {node}"


def delays_of(law: DelayLaw | None, network: Network, link: str) -> Delays:
    """Return the law of the delays of packets, and of their losses, by the state of the link."""
    if law is not None and law.sequence:
        raise ProblemError(
            f"{network.key(link, 'delay')} is a trace, whose delays follow each other in an order that no theory here "
            "covers; expected a histogram, a list of delays, a buffer, or acknowledged = false (then the loop is "
            "simulated without a claim)"
        )
    turns, losses = network.chain(link)
    waits, rows = ((0.0,), ((1.0,),) * len(losses)) if law is None else (law.waits, law.of_states(len(losses)).odds)
    odds = np.array(rows) * (1.0 - losses[:, None])
    return Delays.of(waits, odds if len(losses) > 1 else odds[0], 1.0, turns if len(losses) > 1 else None)
