"""Packets in flight, as policy steps of their sender: which ones there are, what acts, and what silence costs.

A sender that learns the time of arrival of its packets (``Acted``) follows them by flags, one for each packet that may
still be in flight, or if the state of a link is unknown by the probabilities of all modes (``LateBelief``). From these
follow the values that act in each piece of a period, and the cost E[z'Ψ_I^a z] + ψ_I^a of sending only on a set a of
links (``base/late``), which the decision compares with the share of the price of a packet on every link.

The values are inputs of the plant that a controller sends, or measurements that a sensor sends to a controller. In the
names of signals, ``sent j`` is the value of j steps ago, and ``acting i`` what acts in piece i.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.base.filter import SEND
from taciturn.base.late import LateValue
from taciturn.design.late_base import Receiver, Receivers
from taciturn.design.late_belief import LateBelief
from taciturn.design.several_nodes import (
    label,
)
from taciturn.errors import ProblemError
from taciturn.model.losses import stationary
from taciturn.model.steps import (
    ONE,
    Acknowledged,
    Acted,
    Apply,
    Assign,
    Condition,
    Decide,
    Evaluate,
    Step,
)
from taciturn.model.trigger import Form, Trigger

COST, TRIED, BELIEF = "cost of silence", "tried", "belief"
LAST, COSTS = "last command", "costs of silence"
MOST_BELIEVED = 64  # modes of which a sender has probabilities
MOST_FORMS = 1024  # of the cost of silence, one for each set of links and each mode
Part = TypeVar("Part")  # a form, or the terms of a sum


@dataclass(frozen=True, eq=False, repr=False)
class Watched(Displayed):
    """The policy steps that compute the cost of silence, and those that follow the packets in flight."""

    before: tuple[Step, ...]  # before the decision
    after: tuple[Step, ...]  # after the packet, with the acknowledgements of the step
    initial: dict[str, Array]


@dataclass(frozen=True, eq=False, repr=False)
class FlightSteps(Displayed):
    """The policy steps with which a sender follows its packets, and decides."""

    at: str  # the sender
    nodes: Receivers
    found: LateValue
    cuts: tuple[float, ...]  # the parts of a period at which its pieces begin
    price: float
    state: tuple[str, ...]  # the signals of s
    held: str  # the value that acts at the beginning of a step

    def decision(self) -> Step:
        """Return the decision on the set of links that send."""
        options: dict[str, Form] = {}
        for sent in self.nodes.sets[:-1]:
            share = self.price * sum(self.nodes.weights[link] for link in sent)
            options[self.nodes.label(sent)] = Form(plus={self.cost(sent): 1.0}, constant=share)
        options[self.nodes.label(self.nodes.sets[-1])] = Form(constant=self.price)
        return Decide(self.at, SEND, Trigger(options))

    def watched(self) -> Watched:
        """Return the steps that compute the cost of silence, and those that follow the packets in flight."""
        return self._watched_flight() if len(self.found.chain.delays.turns) == 1 else self._believed()

    @property
    def depth(self) -> int:
        """Largest number of whole periods after which a packet may arrive."""
        return self.found.chain.delays.depth

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
        return (*self.state, *self.sent, self.held)

    def cost(self, sent: Sequence[str]) -> str:
        """Return the name of what it costs that only a set of links sends."""
        return f"{COST} if {label(sent)}" if sent else COST

    def acting(self, command: str) -> list[Step]:
        """Return the steps that compute which inputs acted in each piece of the period, by the acknowledgements."""
        unit, nodes, found = np.eye(self.found.chain.plant.inputs), self.nodes, list[Step]()
        # a last command is one that has been sent, or repeats what is applied
        wired = nodes.chosen([one.sure if command == LAST else not one.linked for one in nodes.all])
        for piece, name in enumerate(self.pieced):
            found.append(Assign(self.at, name, nonzero({self.held: unit - wired, command: wired})))
            for one in (one for one in nodes.all if one.linked and not (one.sure and command == LAST)):
                own = nodes.chosen([other is one for other in nodes.all])
                for age in range(one.delays.depth, -1, -1):  # the newest packet last
                    value = self.sent[age - 1] if age else command
                    new = nonzero({name: unit - own, value: own})
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

    def aged(self, value: str) -> list[Step]:
        """Return the steps by which the last values grow older, and a new one is taken up."""
        unit = np.eye(self.found.chain.plant.inputs)
        found: list[Step] = [
            Assign(self.at, self.sent[age - 1], {self.sent[age - 2]: unit}) for age in range(self.depth, 1, -1)
        ]
        return [*found, self.by_set(self.sent[0], value)] if self.depth else found

    def by_set(self, name: str, value: str) -> Step:
        """Return the step that takes up those entries of a value that are sent, and keeps the others."""
        branches, unit = list[dict[str, Array]](), np.eye(self.found.chain.plant.inputs)
        for sent in self.nodes.sets:
            new = self.nodes.chosen(self.nodes.sent(sent))
            branches.append(nonzero({name: unit - new, value: new}))
        return Assign(self.at, name, tuple(branches), SEND)

    def tried(self) -> list[Step]:
        """Return the steps that remember on which links packets were sent."""
        none, one = np.zeros((1, 1)), np.ones((1, 1))
        found = list[Step]()
        for receiver in (receiver for receiver in self.nodes.all if receiver.linked and not receiver.sure):
            told = tuple({ONE: one if receiver.node in sent else none} for sent in self.nodes.sets)
            found.append(Assign(self.at, self.nodes.named(TRIED, receiver.node), told, SEND))
        return found

    def _watched_flight(self) -> Watched:
        """Return the steps of links with one state: a flag for each packet says whether it is in flight."""
        found, nodes, flags, before = self.found, self.nodes, self.flags(), list[Step]()
        if (len(nodes.sets) - 1) << len(flags) > MOST_FORMS:
            flying, choices = number_of(2 ** len(flags), "set"), number_of(len(nodes.sets), "set")
            raise ProblemError(
                f"packets that arrive up to {number_of(self.depth, 'period')} late, over "
                f"{number_of(len(nodes.links), 'link')}, have {flying} of packets in flight and {choices} of links to "
                f"choose from; expected at most {MOST_FORMS} combinations: shorter delays, a buffer, or fewer links"
            )
        for sent in nodes.sets[:-1]:
            Psi, psi = (values[nodes.sent(sent)] for values in (found.Psi, found.psi))
            # a set of packets is not a mode if they are never in flight together
            costs = {mode: Form(self.signals, Psi[i], float(psi[i])) for i, mode in enumerate(self.modes())}
            before += self.selected(costs, flags, self.cost(sent), np.ones((1, 1)), self._evaluated)
        return Watched(tuple(before), tuple(self.flown(flags)), {})

    def flags(self) -> dict[tuple[int, int], str]:
        """Name the signals, 1 or 0, that say whether a packet is in flight, by its receiver and its age."""
        found: dict[tuple[int, int], str] = {}
        for place, receiver in enumerate(self.nodes.all):
            for age in range(1, receiver.delays.depth + 1):
                found[place, age] = self.nodes.named(f"flight {age}", receiver.node)
        return found

    def modes(self) -> list[frozenset[tuple[int, int]]]:
        """Return the packets in flight in each mode, by receiver and age; with one state of the links, they are it."""
        modes = self.found.chain.modes
        return [frozenset((i, packet.age) for packet in mode.flight for i in packet.receivers) for mode in modes]

    def flown(self, flags: Mapping[tuple[int, int], str]) -> list[Step]:
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

    def in_flight_decisions(self) -> list[Step]:
        """Return the decisions whether each packet is in flight, if the states of the links are known."""
        if len(self.found.chain.delays.turns) > 1:
            return []
        found = list[Step]()
        for key, flag in self.flags().items():
            none_or_some = Trigger({"no": Form(plus={flag: 1.0}), "yes": Form(constant=0.5)})  # the flag is 0 or 1
            found.append(Decide(self.at, self._in_flight(key), none_or_some))
        return found

    def assigned(self, name: str, sums: Sequence[dict[str, Array]], on: str | None) -> Step:
        """Return the step that computes a sum by the outcome of a decision."""
        return Assign(self.at, name, tuple(sums) if on else sums[0], on)

    def _evaluated(self, name: str, forms: Sequence[Form], on: str | None) -> Step:
        return Evaluate(self.at, name, tuple(forms), on)

    def _in_flight(self, key: tuple[int, int]) -> str:
        """Return the name of the decision whether a packet is in flight, by its receiver and age."""
        return self.nodes.named(f"packet {key[1]} in flight", self.nodes.all[key[0]].node)

    def selected(
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

    def _believed(self) -> Watched:
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
        return Watched(tuple(before), tuple(after), {BELIEF: start})


def nonzero(terms: dict[str, Array]) -> dict[str, Array]:
    """Remove the terms whose matrix is zero, unless all are."""
    return {name: matrix for name, matrix in terms.items() if matrix.any()} or terms


def _subsets(keys: Sequence[tuple[int, int]]) -> list[frozenset[tuple[int, int]]]:
    """Return all sets of packets, by receiver and age."""
    return [frozenset(key for i, key in enumerate(keys) if code >> i & 1) for code in range(1 << len(keys))]
