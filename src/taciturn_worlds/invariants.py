"""Invariants that a simulated network must satisfy at each step, also under faults.

The monitor decodes every datagram that a process sends, and compares what nodes and plant use with it. It reads the
counters and the state of the nodes, but it does not rely on their handling of packets.
"""

from __future__ import annotations

import bisect
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from math import isnan
from typing import Any, TypeAlias

from taciturn.extend import number_of
from taciturn.model.packets import PlantLink, plant_link, sender_of
from taciturn.model.wire import PROOFS
from taciturn.nodes.clock import JUMPED
from taciturn.nodes.node import Measurement, Node, Values
from taciturn.nodes.packet import REFUSALS, Packet
from taciturn_udp.nodes import LEFT_BEHIND, NodeServer
from taciturn_udp.plant import PlantServer
from taciturn_udp.proofs import VALID, Reception
from taciturn_worlds.virtual import VirtualNetwork, VirtualPort

Order: TypeAlias = tuple[int, int]  # epoch and step of a packet
Entry: TypeAlias = tuple[str, str, int]  # role, signal and index of a stored number
BEFORE: Order = (-1, -1)
CLOSE = 1e-9  # largest relative difference of two copies of a number
EARLY = 2 * JUMPED + 1.0  # steps by which a node may be ahead of the plant: its clock and its sender's may be fast
AWAKE = 1000  # largest number of times that a process wakes in a step
DATAGRAMS = ("received", *REFUSALS, "unproven", "proofs")  # counters of a node, which count each datagram once
UNCOUNTED = (
    "sent ",
    "missed",
    "missing",
    "repeated",
    "unsent",
    "overflowed",
    *DATAGRAMS,
)  # counters that do not count handled packets


ORDER, COUNTS, NUMBERS, MARKS, FORGERY, DEVICES, SILENCE, PACE, RECOVERY = INVARIANTS = (
    "order of commands",
    "counts of datagrams",
    "numbers and nonces",
    "marks",
    "forgery",
    "nodes in C and Python",
    "silence",
    "pace",
    "recovery",
)


class BrokenError(Exception):
    """An invariant does not hold."""

    def __init__(self, invariant: str, step: int, sentence: str) -> None:
        """Keep invariant, step and sentence."""
        super().__init__(f"step {step}: {sentence}")
        self.invariant = invariant


def count_proofs(reception: Reception) -> int:
    """Return how many challenges and answers a process has received."""
    return sum(number for name, number in reception.counters.items() if name != "challenges")


class Life:
    """One process of a node from its start to its end, as the monitor of invariants observes it."""

    def __init__(self, server: NodeServer, port: VirtualPort, began: float) -> None:
        """Store the values of the counters at the start."""
        self.server, self.port = server, port
        self.node: Node = server.nodes[0]
        self.plant = plant_link(self.node.policy, self.node.role)
        self._kept = Counter(self.node.counters)  # of an earlier life, if the state was saved
        # last step in which a datagram of its sender arrived, or which excuses silence, by link
        self.heard = dict.fromkeys(self.node.limits, began)
        self.turn = 0  # steps since the process woke
        self.wakes = 0  # times that it woke in this step
        self.forged = 0  # forged datagrams that it was sent
        self.read: dict[tuple[str, str], Order] = defaultdict(lambda: BEFORE)

    def counters(self) -> Counter[str]:
        """Return the counters of the node and its server, including those of earlier processes with the same state."""
        measured = Counter({"measurements": self.server.measured})
        return self.node.counters + self.server.refused + self.server.reception.counters + measured

    def count(self, *names: str) -> int:
        """Return how many datagrams this process has counted under the given names; without names, under all names."""
        server = self.server
        own = sum(self.node.counters[name] - self._kept[name] for name in names or DATAGRAMS)
        if names:
            return own + sum(server.refused[name] for name in names)
        return own + sum(server.refused.values()) + server.measured + count_proofs(server.reception)


class Monitor:
    """The invariants of a world."""

    def __init__(
        self,
        step: Callable[[], float],
        heartbeat: int,
        patience: int,
        zero: bool = False,
        keyed: bool = False,
        plant: Mapping[str, PlantLink] | None = None,
    ) -> None:
        """Start without processes."""
        self._plant = plant or {}
        self._zero, self._keyed = zero, keyed
        self._step, self._heartbeat, self._patience = step, heartbeat, patience
        self.lives: dict[str, Life] = {}
        self._starts: dict[str, dict[int, int]] = defaultdict(dict)  # number of an epoch, by its sender
        self._forged = 0  # forged datagrams that the plant was sent
        self._nonces: dict[tuple[str, str], list[int]] = defaultdict(list)  # of challenges, by sender and link
        self._sent: dict[tuple[str, str, Measurement], list[Order]] = defaultdict(list)
        self._last: dict[tuple[str, str, int], int] = {}  # last step with a packet, by sender, link and epoch
        self._numbered: dict[tuple[str, str, str, int, int], Packet] = {}  # by sender, kind, link, epoch and sequence
        self._applied: dict[str, Order] = {}  # by link of the plant
        self.data: dict[str, list[tuple[int, Values]]] = defaultdict(list)  # step and payload of the data, by link
        self.numbers: dict[str, dict[int, int]] = defaultdict(dict)  # of these, by link and step
        self.used: dict[str, dict[Values, int]] = defaultdict(dict)  # step that has read a payload, by link
        self.snapshots: dict[int, dict[Entry, float]] = defaultdict(dict)
        self.ticks = 0  # steps of nodes

    def fail(self, invariant: str, sentence: str) -> None:
        """Report that an invariant is violated."""
        raise BrokenError(invariant, int(self._step()), sentence)

    def born(self, role: str, life: Life, fresh: bool) -> None:
        """Record that a process starts; a process with a saved state still knows which packets it has read.

        With a key, also a process without its state uses no older packets, except those that its sender repeats.
        """
        before = self.lives.get(role)
        if before is not None and not fresh:
            life.read = before.read
        elif before is not None and self._keyed:
            life.read.update({name: (start, tick - VALID) for name, (start, tick) in before.read.items()})
        self.lives[role] = life

    def sent(self, packet: Packet | str, role: str) -> None:
        """Record a packet that a process sends, for later checks."""
        if isinstance(packet, str):
            self.fail(NUMBERS, f"the {role} has sent a datagram that is {packet}")
            return
        if packet.kind in PROOFS:
            self._check_nonce(packet, role)
            return
        starts = self._starts[role]
        order = (starts.setdefault(packet.epoch, len(starts)), packet.tick)
        if packet.kind in ("data", "input", "measurement"):
            values = tuple(None if isnan(value) else value for value in packet.values)  # a missing sample
            known = self._sent[packet.kind, packet.link, values]
            if order in known:
                return  # again, after a challenge
            bisect.insort(known, order)
            size = len(self._plant[packet.link].inputs) if packet.kind == "input" else len(values)
            if size < len(values):  # the input of the last piece of a step, which the plant may hold
                bisect.insort(self._sent[packet.kind, packet.link, values[-size:]], order)
        if packet.link in self._plant:
            life = self.lives.get(role)
            if packet.kind == "input" and self._zero and life is not None and life.node.silent and any(packet.values):
                self.fail(
                    SILENCE,
                    f"the {role} is silent, but sends the input {list(packet.values)}; expected the safe input 0",
                )
        else:
            number = role, packet.kind, packet.link, packet.epoch, packet.sequence
            if number in self._numbered:
                if self._numbered[number] != packet:
                    self.fail(
                        NUMBERS, f"the {role} sends {packet}, but has sent {self._numbered[number]} with this number"
                    )
                return  # again, after a challenge
            self._numbered[number] = packet
            if packet.kind == "data":
                self.data[packet.link].append((packet.tick, packet.values))
                self.numbers[packet.link][packet.tick] = packet.sequence
            last = self._last.get((role, packet.link, packet.epoch))
            if packet.kind == "mark" and last is not None and packet.tick - last < self._heartbeat:
                self.fail(
                    MARKS,
                    f"the {role} sends a mark in step {packet.tick}, but a packet in step {last}; expected a mark "
                    f"after {number_of(self._heartbeat, 'step')} without a packet",
                )
            self._last[role, packet.link, packet.epoch] = max(packet.tick, -1 if last is None else last)

    def forge(self, role: str) -> None:
        """Record that a process is sent a forged datagram."""
        if role == "plant":
            self._forged += 1
        else:
            self.lives[role].forged += 1

    def _check_nonce(self, packet: Packet, role: str) -> None:
        """Check that a nonce is used in one challenge only, which may be sent again until it is answered."""
        known = self._nonces[role, packet.link]
        if packet.kind == "challenge" and packet.nonce not in known[-1:]:
            if packet.nonce in known:
                self.fail(NUMBERS, f"the {role} challenges with an old nonce on the {packet.link} link")
            known.append(packet.nonce)

    def stepped(self, role: str, line: Mapping[str, Any]) -> None:
        """Check a node's step: steps are in order, and the node reads no packet older than those it has read.

        A node that uses all packets of a link may read older ones.
        """
        life, now = self.lives[role], self._step()
        node = life.node
        self.ticks += 1
        life.turn += 1
        if life.turn > LEFT_BEHIND + 2 and not node.measures:
            self.fail(PACE, f"the {role} executes {life.turn} steps at once; expected at most {LEFT_BEHIND + 2}")
        if node.tick > now + EARLY:
            self.fail(PACE, f"the {role} executes step {node.tick}; expected none more than {EARLY:.0f} steps ahead")
        given = life.plant
        y = tuple(line.get("y", ()))
        some = any(value is not None for value in y)  # a node goes on without a measurement that has not arrived
        if some and given and (0, node.tick) not in self._sent["measurement", given, y]:
            self.fail(
                ORDER, f"the {role} uses the measurement {line['y']} in step {node.tick}, which the plant has not sent"
            )
        for (kind, link), values in node.readings.items():
            if kind == "data" and values is not None:
                last = BEFORE if link in node.program.every else life.read[kind, link]
                order = self._next("data", link, values, last)
                if order is None:
                    self.fail(
                        ORDER,
                        f"the {role} reads {list(values)} from the {link} link in step {node.tick}, which is older "
                        f"than the packet of step {life.read[kind, link][1]} that it has read",
                    )
                    return
                life.read[kind, link] = order
                self.used[link][values] = int(now)
        snapshot = self.snapshots[node.tick]
        for name, numbers in node.memory.items():
            for i, number in enumerate(numbers):
                snapshot[role, name, i] = number

    def applied(self, line: Mapping[str, Any]) -> None:
        """Check the input that the plant applies at a step: it must not be older than an input applied before."""
        m = 1 + max(i for ends in self._plant.values() for i in ends.inputs)
        for link, ends in self._plant.items():
            values = tuple(line["u"][k + i] for k in range(0, len(line["u"]), m) for i in ends.inputs)
            row, last = values[-len(ends.inputs) :], self._applied.get(link, BEFORE)
            if last == BEFORE and not any(values):
                continue
            order = self._next("input", link, values, last)
            if order is None and values == row * (len(values) // len(row)):  # the plant holds it in all pieces
                order = self._next("input", link, row, last)
            if order is None:
                self.fail(ORDER, f"the plant applies {list(values)}, which is older than the input of step {last[1]}")
                return
            self._applied[link] = order

    def woken(self, role: str) -> None:
        """Record that a process wakes to read datagrams, and check that it wakes rarely enough."""
        life = self.lives[role]
        life.turn, life.wakes = 0, life.wakes + 1
        if life.wakes > AWAKE:
            self.fail(PACE, f"the {role} wakes more than {AWAKE} times in a step; expected a process that waits")

    def check(self, network: VirtualNetwork, plant: PlantServer, plant_port: VirtualPort, alive: Sequence[str]) -> None:
        """Check the invariants of a step: each datagram is counted, and a node that gets no packets reports this."""
        counted = network.counters
        added = counted["sent"] + counted["copied"] + counted["replayed"]
        ended = sum(counted[name] for name in ("lost", "unreachable", "discarded", "delivered"))
        if added != ended + network.flying:
            self.fail(COUNTS, f"{added} datagrams were sent, but {ended} ended and {network.flying} are on their way")
        if plant_port.received != plant.taken + sum(plant.refused.values()) + count_proofs(plant.reception):
            self.fail(COUNTS, f"the plant has received {plant_port.received} datagrams, but counted {plant.report()}")
        if plant.refused["forged"] < self._forged:
            self.fail(
                FORGERY,
                f"the plant has received {self._forged} forged datagrams, but refuses {plant.refused['forged']}",
            )
        for life in self.lives.values():
            life.wakes = 0
        for role in alive:
            self._check_life(role, self.lives[role])

    def _check_life(self, role: str, life: Life) -> None:
        node, received = life.node, life.node.counters["received"]
        if life.port.received != life.count():
            self.fail(
                COUNTS, f"the {role} has received {life.port.received} datagrams, but counts {dict(life.counters())}"
            )
        if life.count("forged") < life.forged:
            self.fail(
                FORGERY, f"the {role} has received {life.forged} forged datagrams, but refuses {life.count('forged')}"
            )
        handled = sum(number for name, number in node.counters.items() if not name.startswith(UNCOUNTED))
        if received != handled + node.waiting:
            self.fail(
                COUNTS, f"the {role} counts {received} packets, but {dict(node.counters)} and {node.waiting} waiting"
            )
        for link, limit in node.limits.items():
            silence = self._step() - life.heard[link]
            if silence > limit + self._patience and not (link in node.silent_links and node.degraded):
                self.fail(SILENCE, f"the link {link} of the {role} is cut for {silence:.0f} steps, but not reported")

    def heard(self, role: str, sender: str | None = None) -> None:
        """Record that a sender's datagram has arrived or, without a sender, an event that excuses missing datagrams."""
        if role in self.lives:
            life = self.lives[role]
            life.heard |= {
                link: self._step() for link in life.heard if sender in (None, sender_of(life.node.policy, link))
            }

    def _next(self, kind: str, link: str, values: Values, last: Order) -> Order | None:
        """Return the oldest sent packet with a payload that is not older than the last one, or None."""
        orders = self._sent.get((kind, link, values), [])
        place = bisect.bisect_left(orders, last)
        return orders[place] if place < len(orders) else None


Copy: TypeAlias = tuple[Entry, Entry, int]  # two numbers, and the steps by which the second one is later


def find_copies(
    snapshots: Mapping[int, Mapping[Entry, float]], first: int, own: frozenset[str] = frozenset()
) -> list[Copy]:
    """Find pairs of varying signals in different nodes that are equal at all steps of a run without faults.

    Signals in ``own`` count actions of one node, so they are not copies.
    """
    steps = sorted(tick for tick in snapshots if tick >= first)[:-2]
    names = [name for name in snapshots[steps[0]] if name[1] not in own]
    rows = {name: [snapshots[tick][name] for tick in steps] for name in names}
    return [
        (one, two, late)
        for one in names
        for two in names
        for late in (0, 1)
        if one[0] != two[0] and (one < two or late) and len(set(rows[one])) > 2
        if _agree(rows[one][: len(steps) - late], rows[two][late:])
    ]


def differing(snapshots: Mapping[int, Mapping[Entry, float]], step: int, copies: Sequence[Copy]) -> str | None:
    """Return a text about the first copies of a signal that differ at a step; None if all copies agree."""
    for one, two, late in copies:
        a, b = snapshots.get(step - late, {}).get(one), snapshots.get(step, {}).get(two)
        if a is not None and b is not None and not abs(a - b) <= CLOSE * max(1.0, abs(a)):
            return f"{one[1]} of the {one[0]} is {a:.12g}, but its copy {two[1]} of the {two[0]} is {b:.12g}"
    return None


def _agree(one: Sequence[float], two: Sequence[float]) -> bool:
    scale = max(map(abs, one))
    return all(abs(a - b) <= 1e-12 * scale for a, b in zip(one, two, strict=True))
