"""Worlds of faults: a problem's nodes and plant run in one process, under faults that a seed draws.

The servers of the nodes and of the plant are those that run over UDP, in real time; their clocks and sockets are
virtual. A ``KeyRing`` has the secrets of each link, and the keys that every process has in its file. A world breaks if
an invariant does not hold (``taciturn_worlds.invariants``).

Losses of the network are left to the faults. A link with random delays delays each packet by its law, with the draws of
``taciturn network``, and marks by the least delay.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar, TypeAlias

import numpy as np

from taciturn.errors import ProblemError, UnstableError
from taciturn.extend import count, number_of
from taciturn.loop import Loop
from taciturn.model.coverage import LATE, LOOPS, Coverage
from taciturn.model.network import Network
from taciturn.model.packets import is_acknowledged, links_to, outputs_at, peers_of, receiver_of, roles, sender_of
from taciturn.model.policy import Policy
from taciturn.model.result import VERDICT, Field, Result, plain_fields, seconds
from taciturn.model.steps import Send
from taciturn.model.wire import OFFSETS, PLANT, PROOFS
from taciturn.nodes.clock import AGREED, JUMPED
from taciturn.nodes.keys import MOST_KEY, Keys, RenewedKeys
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.problem import Problem
from taciturn_udp.endpoint import Address
from taciturn_udp.nodes import NodeServer
from taciturn_udp.plant import PlantServer
from taciturn_udp.relay import losses
from taciturn_udp.service import usual_wait
from taciturn_worlds.devices import DeviceNode, DeviceServer, NoCompilerError, compile_devices
from taciturn_worlds.faults import (
    Crash,
    Fault,
    Flights,
    Forgery,
    Jump,
    KeyChange,
    LinkFault,
    Path,
    Pause,
    Recording,
    Replay,
    Skew,
    draw_attacks,
    draw_faults,
)
from taciturn_worlds.invariants import (
    DEVICES,
    INVARIANTS,
    RECOVERY,
    BrokenError,
    Copy,
    Life,
    Monitor,
    differing,
    find_copies,
)
from taciturn_worlds.virtual import VirtualClock, VirtualNetwork, VirtualPort, VirtualProcess, VirtualTime


class _FileKeys(RenewedKeys):
    """The keys of a process, from a file that is a dictionary."""

    def __init__(self, file: Mapping[str, tuple[bytes, ...]], clock: Callable[[], float]) -> None:
        self._file = file
        super().__init__(clock)

    def __str__(self) -> str:
        return "the file"

    def _stamped(self) -> object:
        return dict(self._file)

    def _read(self) -> Mapping[str, tuple[bytes, ...]]:
        return dict(self._file)


class KeyRing:
    """Keys and nonces of all processes of a test, and the former keys that an attacker knows."""

    def __init__(self, seed: int, links: Sequence[str], uses: Mapping[str, Sequence[str]]) -> None:
        """Draw a key for each link."""
        self._draws = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(5,)))
        self._secrets = {link: self._draws.bytes(MOST_KEY) for link in links}
        self._former: dict[str, bytes] = {}
        self.files: dict[str, dict[str, tuple[bytes, ...]]] = {
            name: {link: (self._secrets[link],) for link in links} for name, links in uses.items()
        }

    def keys(self, name: str, clock: Callable[[], float]) -> Keys:
        """Return the keys of a process; after a change, the process reads them again."""
        return _FileKeys(self.files[name], clock)

    def nonce(self) -> int:
        """Return a new nonce."""
        return int(self._draws.integers(0, 1 << 64, dtype=np.uint64))

    def epoch(self) -> int:
        """Return a random epoch."""
        return int(self._draws.integers(1 << 31))

    def change(self, link: str) -> list[Callable[[], None]]:
        """Draw a new key for a link; return the actions that add it, use it, and remove and disclose the old key."""
        old, new = self._secrets[link], self._draws.bytes(MOST_KEY)
        self._secrets[link] = new

        def write(keys: tuple[bytes, ...]) -> None:
            for file in self.files.values():
                if link in file:
                    file[link] = keys

        def reveal() -> None:
            self._former[link] = old

        return [lambda: write((old, new)), lambda: write((new, old)), lambda: write((new,)), reveal]

    @property
    def true(self) -> Keys:
        """The present keys."""
        return Keys({link: (key,) for link, key in self._secrets.items()})

    def wrong(self, link: str, former: bool) -> Keys:
        """Return a key that no process accepts on a link: a former key, another link's key, or an unknown key."""
        other = self._former.get(link, self._secrets[next(name for name in self._secrets if name != link)])
        return Keys.same(other if former else self._draws.bytes(MOST_KEY))


WORLDS = Coverage(LOOPS | LATE, "worlds of faults do not carry out")
TICK = 0.1  # seconds per step
LATENCY = 0.02  # steps that a datagram takes
WATCHDOG, HEARTBEAT = 12, 4  # steps of the watchdog and between marks
WITHIN = 110  # steps in which faults begin
SILENT = 300  # steps after which a policy that still sends no data is reported
REST = 4  # steps that a world goes on after the recovery
EPOCH = 1000  # of a process that starts at time 0
SHIFT = 1e3  # by which the numbers in packets of an attacker differ
MakeNode: TypeAlias = Callable[..., Node]


def promised_steps(heartbeat: int, keyed: bool, hops: int) -> int:
    """Return how many steps after the last fault every node must use current packets again.

    A node corrects a clock that has jumped after ``AGREED`` packets or marks; one of these arrives in every
    ``heartbeat`` steps. Then the node may be up to ``JUMPED`` steps ahead, and waits. With keys, the first packet may
    only cause a challenge. Nodes that take their time from this node are corrected after it.
    """
    return hops * ((AGREED + 1 + keyed) * heartbeat + int(JUMPED))


def hops(policy: Policy) -> int:
    """Return the largest number of links over which the plant's time reaches a node."""
    found: dict[str, int] = {}
    for role in roles(policy):  # in the order of a step
        heard = [found[sender_of(policy, link)] for link in links_to(policy, role)]
        found[role] = 0 if outputs_at(policy, role) or not heard else 1 + max(heard)
    return max(1, *found.values())


def altered(packet: Packet, ahead: int, epoch: int) -> Packet:
    """Return a forged packet, whose step, epoch and values differ from those of the given packet."""
    values = tuple(value + SHIFT for value in packet.values)
    if packet.kind == "challenge":
        return packet._replace(nonce=packet.nonce ^ 1)
    sequence = packet.sequence if packet.kind in PROOFS else packet.sequence + ahead
    return packet._replace(
        values=values, tick=packet.tick + ahead, sequence=sequence, epoch=epoch, nonce=packet.nonce and packet.nonce ^ 1
    )


class _Memory:
    """The saved state of a node, which outlives its process."""

    def __init__(self) -> None:
        self.state: bytes | None = None

    def read(self) -> bytes | None:
        return self.state

    def write(self, state: bytes) -> None:
        self.state = state


class _ProtectedPlant(SimulatedPlant):
    """A plant that starts again where it leaves the range of numbers, as an unstable one does that is cut off."""

    trips = 0

    def move(self, inputs: Sequence[float]) -> float:
        try:
            return super().move(inputs)
        except UnstableError:
            self.restart()
            self.trips += 1
            return 0.0


class _CachedWire(Wire):
    """A wire that decodes a datagram once with the same keys, for its receiver and for the monitor."""

    def __init__(self, policy: Policy, network: Network) -> None:
        super().__init__(policy, network)
        self._decoded: dict[tuple[bytes, tuple[bytes, ...]], Packet | str] = {}

    def decode(self, datagram: bytes) -> Packet | str:
        link = datagram[OFFSETS["link"]]
        known = datagram, self.keys.of(self.links[link]) if self.keys is not None and link < len(self.links) else ()
        found = self._decoded.get(known)
        if found is None:
            found = self._decoded[known] = super().decode(datagram)
        return found


class World:
    """The processes of a loop in virtual time, and the faults that act on them."""

    def __init__(
        self, loop: Loop, seed: int, faults: Sequence[Fault] | None, devices: Mapping[str, MakeNode], keyed: bool
    ) -> None:
        """Start all processes, and enter the faults into the queue of events."""
        WORLDS.check(loop.parts, loop.policy.designed_for)
        loop = replace(loop, network=replace(loop.network, missing={}))  # faults alone let samples be missing
        self.loop, self.seed, self.made = loop, seed, devices
        policy = self.policy = loop.policy
        self.time = VirtualTime()
        self.network = VirtualNetwork(self.time, self._carry)
        self.wire = _CachedWire(policy, loop.network)
        self.monitor = Monitor(
            self.step, HEARTBEAT, WATCHDOG + 4, zero=seed % 2 == 1, keyed=keyed, plant=self.wire.plant
        )
        self.roles = roles(policy)
        self.links: list[str] = [step.link for step in policy.steps if isinstance(step, Send)]
        self._fates = {
            link: fate for link, fate in losses(loop.network, seed, None, policy.tick, 1.0).items() if fate.late
        }
        self.lag = {  # nobody listens on a link on which a schedule never sends
            link: Node(policy, receiver_of(policy, link), network=loop.network).listens.get(link, 0)
            for link in self.links
        }
        used = self._paths()
        if keyed:  # challenges travel against packets
            used += [(link, (path[1], path[0])) for link, path in used]
        self._uses: dict[Path, list[str]] = defaultdict(list)  # links by path, of which the plant may have several
        for link, path in dict.fromkeys(used):
            self._uses[path].append(link)
        paths = list(self._uses)
        self._history: dict[Path, list[tuple[float, bytes]]] = {path: [] for path in paths}
        names = [*self.roles, PLANT]
        uses = {name: sorted({link for link, path in used if name in path}) for name in names}
        self.ring = KeyRing(seed, self.wire.links, uses)
        self.keyed = keyed
        if faults is None:
            faults = draw_faults(seed, paths, self.roles, WITHIN)
            faults += draw_attacks(seed, paths, sorted({link for link, _ in used}), WITHIN, faults) if keyed else ()
        self.faults = tuple(faults)
        self._on_links = [fault for fault in self.faults if isinstance(fault, LinkFault)]
        self.end = max((fault.end for fault in self.faults), default=0.0)
        self.recovery: int | None = None
        self.promised: int | None = None
        self._down: dict[str, int] = dict.fromkeys(self.roles, 0)
        self._held: dict[str, int] = dict.fromkeys(self.roles, 0)
        self._storage = {fault.role: _Memory() for fault in self.faults if isinstance(fault, Crash)}
        self.clocks = {name: VirtualClock(self.time) for name in names}
        self.wires: dict[str, Wire] = {}  # of the present process
        self.processes: dict[str, VirtualProcess] = {}
        for role in self.roles:
            self._start(role, fresh=True)
        self.simulated = _ProtectedPlant(loop, seed)
        self.plant_port = VirtualPort(self.network, (PLANT, 0))
        measuring = {link: (ends.measures, 0) for link, ends in self.wire.plant.items() if ends.measures is not None}
        self.plant = PlantServer(
            [self.simulated], self._wire(PLANT), self.plant_port, measuring, tick=TICK,
            told=self.monitor.applied, clock=self.clocks[PLANT], epoch=EPOCH, draw=self.ring.nonce,
        )  # fmt: skip
        for fault in self.faults:
            self._enter(fault)
        VirtualProcess(self.plant_port, self.clocks[PLANT], self.plant.turns(1 << 40, lambda: False))

    def step(self) -> float:
        """Return the plant's time in steps, including the elapsed fraction of the present step."""
        return self.time.now / TICK

    def counters(self) -> dict[str, dict[str, int]]:
        """Return the counters of each role's latest process, of the plant, and of the network."""
        found = {role: dict(life.counters()) for role, life in self.monitor.lives.items()}
        plant = {"inputs": self.plant.taken, **self.plant.refused, **self.plant.reception.counters}
        plant |= {"starts again": self.simulated.trips} if self.simulated.trips else {}
        return {**found, PLANT: plant, "network": self._counted()}

    def run(self, copies: Sequence[Copy]) -> BrokenError | None:
        """Run the loop until the nodes have recovered; return the violated invariant, or None."""
        ready = int(self.end) + 1 + promised_steps(HEARTBEAT, self.keyed, hops(self.policy))
        remembers = max(life.node.remembers for life in self.monitor.lives.values())
        settled: int | None = None
        last, step, held = int(self.end), 0, 0
        try:
            while settled is None or step < settled + remembers + REST:
                self._go_to(step)
                trouble = self._trouble(step, copies) if step > self.end else None
                last = step if trouble else last
                if settled is None and step >= ready and self._has_settled(ready):
                    settled = step
                    self.promised = settled + remembers + 2 - int(self.end)
                if settled is None and step > ready + SILENT:
                    self.monitor.fail(RECOVERY, f"no data packet was used for {SILENT} steps after the faults")
                if settled is not None and self.plant.held > held:
                    self.monitor.fail(RECOVERY, "the plant has received no input for its step, after all faults")
                held = self.plant.held
                if trouble and settled is not None and step > settled + remembers + 2:
                    self.monitor.fail(
                        RECOVERY, f"{trouble}, {number_of(step - int(self.end), 'step')} after the last fault"
                    )
                step += 1
            self._check_used(ready, step - 3)
        except BrokenError as error:
            return error
        except ProblemError as error:  # a node in C refuses what its twin in Python accepts, or the reverse
            return BrokenError(DEVICES, step, str(error))
        self.recovery = last - int(self.end)
        return None

    def run_for(self, steps: int) -> BrokenError | None:
        """Run the loop for some steps; return the violated invariant, or None."""
        try:
            for step in range(steps):
                self._go_to(step)
        except BrokenError as error:
            return error
        return None

    def _go_to(self, step: int) -> None:
        self.time.run((step + 0.9) * TICK)
        alive = [role for role in self.roles if not self.processes[role].ended and not self.processes[role].paused]
        self.monitor.check(self.network, self.plant, self.plant_port, alive)

    def _trouble(self, step: int, copies: Sequence[Copy]) -> str | None:
        for role, life in self.monitor.lives.items():
            if life.node.degraded or life.node.silent:
                return f"the {role} is {'silent' if life.node.silent else 'degraded'} ({dict(life.node.reasons)})"
        return differing(self.monitor.snapshots, step - 1, copies)

    def _has_settled(self, ready: int) -> bool:
        """Return whether on each link a packet that was sent after the faults has been used."""
        used, data = self.monitor.used, self.monitor.data
        return all(
            any(tick >= ready and values in used[link] for tick, values in reversed(data[link])) for link in self.links
        )

    def _check_used(self, first: int, end: int) -> None:
        for link in self.links:
            newest = end - self.lag[link]  # step in which the newest packet arrived of those sent after the present one
            for tick, values in sorted(self.monitor.data[link], reverse=True):
                late = self._late(link, tick)
                if late is None or tick + int(late) >= newest:
                    continue  # it never arrives, or in the step of a newer one or after it
                newest = newest if link not in self._fates else tick + int(late)
                if first <= tick and values not in self.monitor.used[link]:
                    self.monitor.fail(
                        RECOVERY, f"the packet of step {tick} on the {link} link was not used, after all faults"
                    )

    def _late(self, link: str, tick: int) -> float | None:
        """Return the random delay in steps of the packet of a step, or None if it never arrives."""
        fate, sequence = self._fates.get(link), self.monitor.numbers[link].get(tick, 0)
        return 0.0 if fate is None else fate.late_by(sequence, tick)

    def _paths(self) -> list[tuple[str, Path]]:
        ends = self.wire.plant.items()
        found: list[tuple[str, Path]] = [(link, (PLANT, one.measures)) for link, one in ends if one.measures]
        found += [(link, (one.applies, PLANT)) for link, one in ends if one.applies]
        for link in self.links:
            path = sender_of(self.policy, link), receiver_of(self.policy, link)
            found.append((link, path))
            if is_acknowledged(self.policy, link):
                found.append((link, (path[1], path[0])))
        return found

    def _make(self, role: str, epoch: int) -> Node:
        watched = WATCHDOG if links_to(self.policy, role) else None
        make = self.made.get(role, Node)
        return make(
            self.policy, role, network=self.loop.network, epoch=epoch, seed=self.seed, watchdog=watched,
            safe="zero" if self.seed % 2 else "hold",
        )  # fmt: skip

    def _wire(self, name: str) -> Wire:
        """Return the wire of a process that starts."""
        self.wires[name] = self.wire.with_keys(self.ring.keys(name, self.clocks[name]) if self.keyed else None)
        return self.wires[name]

    def _start(self, role: str, fresh: bool) -> None:
        port = VirtualPort(self.network, (role, 0))
        peers = {link: (other, 0) for link, other in peers_of(self.policy, role).items()}
        node = self._make(role, self.ring.epoch() if self.keyed else EPOCH + int(self.time.now))
        plant = (PLANT, 0) if node.measures or node.actuates else None
        serve = DeviceServer if isinstance(node, DeviceNode) else NodeServer
        server = serve(
            [node], self._wire(role), port, peer=peers, plant=plant, tick=TICK,
            wait=usual_wait(self.policy, role), heartbeat=HEARTBEAT, keep=self._storage.get(role),
            told=lambda line: self.monitor.stepped(role, line), clock=self.clocks[role], draw=self.ring.nonce,
        )  # fmt: skip
        self.monitor.born(role, Life(server, port, self.step()), fresh)
        self.processes[role] = VirtualProcess(
            port, self.clocks[role], server.turns(lambda: False), lambda: self.monitor.woken(role)
        )

    def _carry(self, sender: Address, to: Address, datagram: bytes) -> list[tuple[float, bytes]]:
        path, now = (sender[0], to[0]), self.step()
        packet = self.wires[sender[0]].decode(datagram)
        self.monitor.sent(packet, sender[0])
        known = self._history[path]
        late = self._delay(packet) if isinstance(packet, Packet) else 0.0
        flights: Flights = [] if late is None else [(LATENCY + late, datagram)]
        for fault in self._on_links:
            if fault.path == path and fault.first <= now < fault.first + fault.steps:
                flights = fault.act(flights, len(known))
        known.append((now, datagram))
        for delay, copy in flights if to[0] != PLANT and sender[0] != PLANT else ():
            if copy == datagram:
                self._at(now + delay, lambda: self.monitor.heard(to[0], sender[0]))
        return [(delay * TICK, copy) for delay, copy in flights]

    def _delay(self, packet: Packet) -> float | None:
        """Return how many steps the law of a link delays a packet or a mark, or None if it never arrives."""
        fate = self._fates.get(packet.link)
        if fate is None or fate.late is None or packet.kind not in ("data", "mark") or packet.back:
            return 0.0
        return fate.late_by(packet.sequence, packet.tick) if packet.kind == "data" else fate.late.delays[0]

    def _at(self, step: float, event: Callable[[], None]) -> None:
        self.time.at(step * TICK, event)

    def _enter(self, fault: Fault) -> None:
        """Enter the events of a fault of a process, of a clock, or of an attacker."""
        first, end = fault.first, fault.first + fault.steps
        if isinstance(fault, Crash):
            self._at(first, lambda: self._crash(fault))
            self._at(end, lambda: self._restart(fault))
        elif isinstance(fault, Pause):
            self._at(first, lambda: self._hold(fault.role, 1))
            self._at(end, lambda: self._hold(fault.role, -1))
        elif isinstance(fault, Jump):
            self._at(first, lambda: self._jump(fault))
        elif isinstance(fault, Skew):
            self._at(first, lambda: self.clocks[fault.role].turn(1.0 + fault.by))
        elif isinstance(fault, Replay):
            for step in range(first, end):
                self._at(step + 0.5, lambda step=step: self._replay(fault, step - fault.age))
        elif isinstance(fault, Recording):
            self._at(first + 0.5, lambda: self._play(fault))
        elif isinstance(fault, Forgery):
            for step in range(first, end):
                self._at(step + 0.5, lambda step=step: self._forge(fault, step))
        elif isinstance(fault, KeyChange):
            for event, part in zip(self.ring.change(fault.link), (0, 1, 2, 3), strict=True):
                self._at(first + part * fault.steps / 3 if part < 3 else fault.end, event)

    def _crash(self, fault: Crash) -> None:
        role = fault.role
        self._down[role] += 1
        self.processes[role].kill()
        if not fault.kept:
            self._storage[role].state = None

    def _restart(self, fault: Crash) -> None:
        role = fault.role
        fresh = self._storage[role].state is None
        epoch = self.monitor.lives[role].node.epoch
        if fresh and not self.keyed and epoch >= EPOCH + int(self.time.now):  # not before the next second
            self._at((epoch + 1 - EPOCH) / TICK, lambda: self._restart(fault))
            return
        self._down[role] -= 1
        if self._down[role] == 0:
            self._start(role, fresh)

    def _hold(self, role: str, by: int) -> None:
        self._held[role] += by
        process = self.processes[role]
        if self._held[role] and by > 0:
            process.pause()
        elif not self._held[role]:
            self.monitor.heard(role)  # the process could not notice before
            process.resume()

    def _jump(self, fault: Jump) -> None:
        self.clocks[fault.role].jump(fault.by * TICK)
        life = self.monitor.lives[fault.role]
        life.heard = {link: max(heard, self.step()) + max(0.0, -fault.by) for link, heard in life.heard.items()}

    def _replay(self, fault: Replay, step: int) -> None:
        for sent, datagram in self._history.get(fault.path, []):
            if int(sent) == step:
                self._throw(fault.path, datagram)
                if PLANT not in fault.path:
                    self.monitor.heard(fault.path[1], fault.path[0])

    def _play(self, fault: Recording) -> None:
        """Send a recording of a path: of this session, or of one that has not run in this world."""
        recorded = [datagram for _, datagram in self._history[fault.path]]
        if fault.epochs:
            wire, true = self.wires[fault.path[0]], self.wire.with_keys(self.ring.true)
            found = [packet for packet in map(wire.decode, recorded) if isinstance(packet, Packet)]
            recorded = [
                true.encode(altered(packet, fault.ahead, max(0, packet.epoch + fault.epochs))) for packet in found
            ]
        each = -(-len(recorded) // fault.steps)
        for part in range(fault.steps):
            for datagram in recorded[part * each : (part + 1) * each]:
                self._at(self.step() + part, lambda datagram=datagram: self._throw(fault.path, datagram))
                if not fault.epochs:
                    self._at(self.step() + part, lambda: self.monitor.heard(fault.path[1], fault.path[0]))

    def _forge(self, fault: Forgery, step: int) -> None:
        """Send the packets of a step again, with other numbers and a wrong key."""
        wrong = {link: self.wire.with_keys(self.ring.wrong(link, fault.former)) for link in self._uses[fault.path]}
        for sent, datagram in self._history[fault.path]:
            packet = self.wires[fault.path[0]].decode(datagram) if int(sent) == step else ""
            if isinstance(packet, Packet):
                self._throw(fault.path, wrong[packet.link].encode(altered(packet, 1, packet.epoch)))
                self.monitor.forge(fault.path[1])

    def _throw(self, path: Path, datagram: bytes) -> None:
        self.network.replay(datagram, (path[0], 0), (path[1], 0))

    def _counted(self) -> dict[str, int]:
        return {name: number for name, number in self.network.counters.items() if number}


def _verdict(found: WorldRun) -> Iterator[str]:
    """Yield whether all invariants hold, and how fast the nodes have recovered."""
    told = "every invariant holds" if found.broken is None else f"an invariant is broken: {found.broken}"
    yield f"world {found.seed}, {number_of(found.steps, 'step')} with {number_of(len(found.faults), 'fault')}: {told}"
    if found.recovery is not None:
        late = number_of(found.recovery, "step")
        yield f"recovered {late} after the last fault; at most {found.promised} are promised"


def _faults(faults: Sequence[Fault]) -> list[dict[str, Any]]:
    return [{"kind": type(fault).__name__, **asdict(fault), "text": fault.text()} for fault in faults]


def _counters(found: WorldRun) -> list[tuple[str, str]]:
    shown = {name: [f"{n} {what}" for what, n in counted.items() if n] for name, counted in found.counters.items()}
    return [(name, ", ".join(counted) or "no packets") for name, counted in shown.items()]


@dataclass(frozen=True, eq=False, repr=False)
class WorldRun(Result):
    """Result of a test under faults: the faults, how fast the nodes recover, and the violated invariant, if any.

    Args:
        seed: seed of the world.
        faults: its faults.
        devices: roles of the nodes that ran as C code.
        keyed: whether the processes had keys.
        broken: sentence on the invariant that does not hold; None if all invariants hold.
        invariant: name of the invariant that does not hold, at which the world ends, or None.
        recovery: steps after the last fault until no node was degraded and all copies agreed.
        promised: steps within which they must.
        steps: steps of the plant.
        ticks: steps of the nodes.
        counters: packets and datagrams counted by each process, and by the network.
        seconds: processor time.
        notes: remarks for the reader.
    """

    FIELDS: ClassVar[tuple[Field[WorldRun], ...]] = (
        VERDICT,
        Field("seed"),
        Field("keyed", say="keys", text=lambda found: "one for each link" if found.keyed else "none", after="devices"),
        Field("broken"),
        Field("recovery"),
        *plain_fields("promised", "steps", "ticks"),
        Field("faults", json=_faults, say="fault", text=lambda found: [fault.text() for fault in found.faults]),
        Field("devices", say="nodes in C", text=lambda found: ", ".join(found.devices) or "none", after="seed"),
        Field("counters", say="", text=_counters),
        Field("invariants", lambda found: {name: name != found.invariant for name in INVARIANTS}),
        Field("node_ticks", "ticks"),
        Field("seconds", json=seconds, say="time", text="{:.3g} s, {of.ticks} steps of nodes", part="method"),
        Field("notes", say="note"),
    )

    seed: int
    faults: tuple[Fault, ...]
    devices: tuple[str, ...]
    keyed: bool
    broken: str | None
    recovery: int | None
    promised: int | None
    steps: int
    ticks: int
    counters: Mapping[str, Mapping[str, int]]
    seconds: float
    notes: tuple[str, ...] = ()
    invariant: str | None = None

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentences that say whether all invariants hold, and how fast the nodes recover."""
        return tuple(_verdict(self))


def run_world(
    problem: Problem,
    seed: int,
    faults: Sequence[Fault] | None = None,
    devices: Mapping[str, MakeNode] | None = None,
    keyed: bool | None = None,
) -> WorldRun:
    """Run the nodes of a problem under random faults, and check the invariants at each step.

    Args:
        problem: the problem.
        seed: seed of the faults and of the plant.
        faults: the faults; default: those of the seed.
        devices: makers of nodes in C by role (``compile_devices``), of which the seed chooses some; default: all nodes
            run in Python.
        keyed: whether the processes have keys; default: the seed chooses.

    Raises:
        ProblemError: the policy is for a finite horizon, or its nodes cannot be separated.
    """
    count("seed", seed, 0)
    loop, copies = prepare(problem)
    draws = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(3,)))
    chosen = {role: make for role, make in (devices or {}).items() if draws.random() < 0.5}
    if keyed is None:
        keyed = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(4,))).random() < 0.5
    world = World(loop, seed, faults, chosen, keyed)
    began = time.process_time()
    broken = world.run(copies)
    return WorldRun(
        seed, world.faults, tuple(world.made), keyed, broken and str(broken), world.recovery, world.promised,
        int(world.step()), world.monitor.ticks, world.counters(), time.process_time() - began,
        invariant=broken and broken.invariant,
    )  # fmt: skip


def run_world_with_devices(problem: Problem, seed: int) -> WorldRun:
    """Test a loop under faults; the seed also draws which nodes run in C. Without a C compiler, a note says so."""
    try:
        devices = compile_devices(prepare(problem)[0])
    except NoCompilerError as error:
        return replace(run_world(problem, seed), notes=(f"all nodes run in Python: {error}",))
    return run_world(problem, seed, devices=devices)


@lru_cache(maxsize=8)
def prepare(problem: Problem) -> tuple[Loop, Sequence[Copy]]:
    """Return the closed loop of a problem, and the signals that are equal in several nodes in a run without faults."""
    loop = problem.close(problem.design())
    if loop.horizon is not None:
        raise ProblemError(
            f"the policy {loop.policy.kind} is for a horizon of {number_of(loop.horizon, 'step')}, but a world of "
            "faults lasts until the nodes have recovered; expected a policy without horizon"
        )
    quiet = World(loop, 0, (), {}, keyed=False)
    broken = quiet.run_for(200)
    if broken is not None:
        raise ProblemError(f"without any fault, {broken}; expected nodes that run over this network")
    silence = loop.policy.theory.silence.values()
    own = frozenset(name for one in silence for name in (one.total, one.lasted))
    return loop, find_copies(quiet.monitor.snapshots, 20, own)
