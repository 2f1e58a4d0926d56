"""Servers that run nodes over UDP, in lockstep (virtual time) or in real time.

In lockstep, every node sends a mark when it has finished a step, and begins a step when it has received the marks of
all nodes that send to it. Packets are therefore never late, and the same seeds give the same run. In real time, a node
begins a step when its measurement or its packet has arrived, or at an absolute deadline. That of a node with a sensor
is earlier, so that its packet arrives before the deadlines of the others. It continues without a measurement only if
its own clock shows that the plant should have sent one, and for a few steps: if the plant is silent, so is the node,
and the watchdogs of its receivers expire. A packet of the plant may also state that a sample is missing.

An actuator on a link that delays packets at random acts and acknowledges when a packet arrives (``Node.so_far``), and
executes a step when it is over. A node that works once per step hears a packet in the step after its arrival.
"""

from __future__ import annotations

import json
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import isnan
from typing import Any

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import number_of
from taciturn.model.coverage import INTERVALS, LATE, NETWORKS, Coverage
from taciturn.model.packets import plant_link
from taciturn.model.wire import EITHER, LARGEST, SETPOINT
from taciturn.nodes.clock import JUMPED, Phase
from taciturn.nodes.clock import LATE as BEHIND
from taciturn.nodes.inbox import AHEAD, OPERATOR, USABLE, WIDTH, Window
from taciturn.nodes.lateness import Lateness
from taciturn.nodes.node import Measurement, Node, Values, check_seal, sealed
from taciturn.nodes.packet import Packet, Wire
from taciturn_udp.endpoint import Address, check_plant, peers_by_link
from taciturn_udp.late import Counted
from taciturn_udp.logs import Arrival, log_line, packet_times
from taciturn_udp.proofs import OPERATED, Outbox, Reception
from taciturn_udp.service import IDLE, Port, Say, Storage, Told, Turns, drive, take_until

BLIND = 8  # steps without a measurement from the plant for which a node with a sensor goes on
LEFT_BEHIND = 8  # a node that is more steps late skips to the current step
PATIENT = 4096  # largest number of measurements that wait for their step
REMEMBERED = 100_000  # number of last steps whose lateness is reported
IN_REAL_TIME = Coverage(NETWORKS | INTERVALS | LATE, "nodes do not carry out in real time", "virtual time")
UNUSABLE = ("ahead", "duplicate", "replayed", "misdirected")  # counters of packets that were not used
SHARES = (50.0, 95.0, 99.0, 100.0)  # reported percentiles of lateness


class NodeServer:
    """Server that runs the nodes of one role on one socket; each loop has a node of this role.

    Args:
        nodes: nodes, one per loop, in order.
        wire: encoder and decoder of the packets.
        endpoint: socket of the nodes.
        peer: address that the nodes send packets to, a node or a relay, for all links or by link; None if they send no
            packets.
        plant: address of the plant; None if the nodes contain neither sensor nor actuator.
        tick: real seconds per step; default: lockstep.
        wait: fraction of a step for which a node waits for a packet of the step, in real time; for a measurement, at
            most a quarter of a step.
        heartbeat: steps without a packet on a link after which a node sends a mark, in real time.
        keep: storage to which the state is saved after every step; for a single node only.
        told: function called with the log line of each step.
        say: function called once with a message if packets of another policy or key are rejected.
        clock: function that returns the time in seconds, from any origin.
        draw: function that returns the random number of a challenge; default: one of the operating system.
        play_out: whether the nodes use each packet the buffer of its link after it was sent, in real time, as real
            plants require; a simulated plant shows the delay itself.

    Raises:
        ProblemError: a peer, a plant or a key is missing, a peer or a plant is not needed, or the saved state is not
            valid for this node.
    """

    def __init__(
        self,
        nodes: Sequence[Node],
        wire: Wire,
        endpoint: Port,
        *,
        peer: Address | Mapping[str, Address] | None = None,
        plant: Address | None = None,
        tick: float | None = None,
        wait: float = 0.5,
        heartbeat: int = 1,
        keep: Storage | None = None,
        told: Told | None = None,
        say: Say | None = None,
        clock: Callable[[], float] = time.monotonic,
        draw: Callable[[], int] | None = None,
        play_out: bool = False,
    ) -> None:
        """Check that all addresses are given, and continue from a saved state if there is one."""
        first = nodes[0]
        if not (first.measures or first.listens):
            raise ProblemError(
                f"the {first.role} of this {first.policy.kind} policy neither measures nor uses packets of other "
                "nodes, so it cannot determine when a step begins; expected a policy that uses measurements, for "
                "example with another weight of sensor queries"
            )
        self.nodes, self.wire, self.endpoint = nodes, wire, endpoint
        check_plant(f"node {first.role}", plant, first.measures or first.actuates)
        peers = peers_by_link(f"node {first.role}", peer, [*first.program.sends, *first.acknowledges])
        self._plant = plant_link(first.policy, first.role)
        if self._plant is not None and plant is not None:
            peers[self._plant] = plant
        self._tick, self._wait = tick, wait
        self._heartbeat, self._keep, self._told, self._say = heartbeat, keep, told, say
        self._played = played_after(first, tick) if play_out else None
        heard = [*first.program.hears]
        self._counted = None if tick is None else Counted(first.network, heard, first.policy.tick, tick)
        spread = 0.0 if self._counted is None else self._counted.spread
        self.phase = Phase(tick or 1.0, spread if self._played is None else self._played)
        # seconds by which the steps begin after the phase, which is that of the packets with the least delay
        self._after = self._played or 0.0
        if self._counted is not None and not first.measures and self._played is None:
            self._after = -self._counted.least
        self._at_once = tick is not None and first.acts_at_once
        if self._at_once and play_out:
            raise ProblemError(
                f"the {first.role} is to play packets out, but its link acknowledges packets, with the time at which "
                "they act; expected a link without acknowledgements, or an actuator that acts at once"
            )
        if self._at_once:
            first.check_acting()
        # of nodes that act at once: step, number and values of the last input
        self._shown: list[tuple[int, int, Values]] = [(-1, 0, ()) for _ in nodes]
        links = [*first.program.sends, *first.inbox.links, *([] if self._plant is None else [self._plant])]
        if tick is not None:
            IN_REAL_TIME.check(first.network)
        self.reception = Reception(wire, endpoint, first.role, links, say, draw, stamps=tick is None)
        self.refused = self.reception.refused
        self.arrived: Counter[str] = Counter()  # number of new data packets, by link
        self.lateness: dict[str, Lateness] = {}  # of these packets, by link, as far as this node can tell
        self._news: list[dict[str, list[Arrival]]] = [{} for _ in nodes]  # those since the last log line
        self._measurements: list[dict[int, Measurement]] = [{} for _ in nodes]
        self._seen = [node.tick for node in nodes]  # step of the last measurement that each loop has used
        self._measured = [Window() for _ in nodes]
        self._outbox = Outbox(wire, endpoint, peers, len(nodes))
        self._asked: dict[int, Address] = {}  # the operator of a loop who waits for a report
        self._held: set[int] = set()  # loops whose overflow was reported
        self._lateness: deque[float] = deque(maxlen=REMEMBERED)
        self._clock, self._began, self._cpu = clock, clock(), time.process_time()
        self._patience = (tick or 0.0) * (first.watchdog or 0)
        self._expires = self._began + self._patience  # when the watchdog expires unless a step is executed
        self._turned, self._confirmed = self._began, 0  # time of the last turn, and confirmations of the phase until it
        self._strayed = 0.0  # seconds that have passed unexpectedly since a packet confirmed the phase
        self._physical = 0
        self.measured = 0  # measurements that were stored for their step
        kept = None if keep is None else keep.read()
        if kept is not None:
            self._take_up(kept)
        self._unused = [self._unusable(node) for node in nodes]

    def run(self, steps: int | None, stopped: Callable[[], bool]) -> dict[str, Any]:
        """Execute ``steps`` steps, or fewer if the server is stopped, and return the report."""
        drive(
            self.endpoint,
            self.turns(lambda: stopped() or (steps is not None and all(node.tick >= steps - 1 for node in self.nodes))),
        )
        return self.report()

    def turns(self, ended: Callable[[], bool]) -> Turns:
        """Execute every step that can begin, each time that datagrams arrive or that a waiting time is over."""
        while not ended():
            until = self._until()
            touched = self._take((yield until))
            now = self._clock()
            self._notice(now, until)
            only = self.nodes[0].measures and self._tick is None
            for node in (self.nodes[loop] for loop in touched) if only else self.nodes:
                self._go_on(node, now)
            self._expire(now)

    def finish(self, stopped: Callable[[], bool]) -> dict[str, Any]:
        """Receive packets until the server is stopped, but execute no further step, and return the report."""
        take_until(self.endpoint, self._take, stopped)
        return self.report()

    def report(self) -> dict[str, Any]:
        """Return the counters so far."""
        counters, reasons = self._outbox.counters.copy(), Counter[str]()
        for node in self.nodes:
            counters += node.counters
            reasons += node.reasons
        found: dict[str, Any] = {
            "role": self.nodes[0].role,
            "loops": len(self.nodes),
            "tick": max(node.tick for node in self.nodes),
            "counters": dict(counters),
            "arrived": dict(self.arrived),
            "late_packets": {link: one.document() for link, one in self.lateness.items()},
            "waiting": sum(node.waiting for node in self.nodes),
            "refused": dict(self.refused),
            "proofs": dict(self.reception.counters),
            "physical": self._physical,
            "measurements": self.measured,
            "datagrams": self.endpoint.counted,
            "degraded": dict(reasons),
            "silence": [
                {"loop": loop, **life.document()} for loop, node in enumerate(self.nodes) for life in node.silence
            ],
            "seconds": round(self._clock() - self._began, 3),
            "cpu_seconds": round(time.process_time() - self._cpu, 3),
        }
        points = [(node.loop, node.set_points) for node in self.nodes if node.set_points is not None]
        if points:
            found["set_points"] = [
                {"loop": loop, "given": list(one.given), "in_effect": list(one.in_effect)} for loop, one in points
            ]
        if any(node.operable for node in self.nodes):
            found["manual"] = [None if node.manual is None else list(node.manual) for node in self.nodes]
        if self._lateness:
            late = np.percentile(1e3 * np.array(self._lateness), SHARES)
            names = ("p50", "p95", "p99", "max")
            found["lateness_ms"] = {name: round(float(value), 3) for name, value in zip(names, late, strict=True)}
            found["clock_jumps"] = self.phase.jumps
        return found

    def _take(self, datagrams: Sequence[bytes]) -> set[int]:
        """Store received packets, and return the numbers of their loops."""
        return self._take_from(zip(datagrams, self.endpoint.senders, strict=True))

    def _take_from(self, received: Iterable[tuple[bytes, Address]]) -> set[int]:
        now, touched = self._clock(), set[int]()
        for packet, sender in self.reception.packets(received):
            if packet.loop >= len(self.nodes):
                self.refused["misdirected"] += 1
            elif self._admits(packet, sender, now):
                self._sort(packet, now)
                touched.add(packet.loop)
        return touched

    def _admits(self, packet: Packet, sender: Address, now: float) -> bool:
        """Return whether a packet may be sorted; answer a challenge, and store the proof in an answer."""
        node = self.nodes[packet.loop]
        along = packet.link in node.program.sends  # whether the packets of this node travel along the link
        sends = along or packet.link in node.acknowledges or (packet.link == self._plant and node.actuates)
        if packet.kind == "challenge" and packet.link == SETPOINT and not packet.back:
            return self._greet(packet, sender)
        if packet.kind in EITHER and (packet.back != along or (packet.kind == "challenge" and not sends)):
            self.refused["misdirected"] += 1
            return False
        if packet.kind == "challenge":
            self._outbox.send([self.reception.answer(packet, node.epoch, node.tick)])
            self._outbox.repeat(packet.loop, now, packet.link)
            return False
        if packet.kind == "answer":
            if restarted := self.reception.accepts(packet):
                node.inbox.forget(packet.link, restarted == OPERATED)
                if packet.link == self._plant:
                    self._measured[packet.loop] = Window()
            return False
        admitted = self.reception.admits(packet, sender)
        if admitted and packet.kind in ("setpoint", "manual") and node.set_points is not None:
            self._asked[packet.loop] = sender
        return admitted

    def _greet(self, challenge: Packet, sender: Address) -> bool:
        """Answer an operator, who does not know the policy; the answer also states the operator's last epoch."""
        node = self.nodes[challenge.loop]
        if node.set_points is None:
            self.refused["misdirected"] += 1
        else:
            window = node.inbox.streams[OPERATOR].window
            answer = self.reception.answer(challenge, max(window.epoch, 0), node.tick)
            self.endpoint.send(self.wire.encode(answer), sender)
            self._report_set_points(node, sender)
        return False

    def _report_set_points(self, node: Node, to: Address) -> None:
        """Tell an operator the set-points given and in effect, the mode, his newest packet, and the next step."""
        window, points = node.inbox.streams[OPERATOR].window, node.set_points
        assert points is not None, "only a controller that is given set-points reports them"
        newest = max(window.newest, 0), (*points.given, *points.in_effect), max(window.epoch, 0)
        told = [Packet("report", SETPOINT, node.tick + 1, *newest, node.loop)]
        if node.operable:  # before the report, so that an operator who has a report knows the mode
            mode = (0.0,) * (1 + node.policy.model.inputs) if node.manual is None else (1.0, *node.manual)
            told.insert(0, told[0]._replace(kind="mode", values=mode))
        for packet in told:
            self.endpoint.send(self.wire.encode(packet), to)

    def _sort(self, packet: Packet, now: float) -> None:
        """Store a packet for its node; in lockstep, a repeated packet requests the last answer again."""
        loop, node = packet.loop, self.nodes[packet.loop]
        if packet.link in self.wire.physical:
            self._physical += 1
            news = self._measured[loop].admit(packet.epoch, packet.sequence)
            if packet.kind != "measurement" or packet.link != self._plant or not node.measures:
                self.refused["misplaced"] += 1
            elif news != "new":
                self.refused[news] += 1
                self._answer_again(loop, now, news == "duplicate")
            elif self._begins(packet, now) and len(self._measurements[loop]) < PATIENT:
                y = tuple(None if isnan(value) else value for value in packet.values)
                self._measurements[loop][packet.tick] = y
                self.measured += 1
            else:
                self.refused["late" if packet.tick <= node.tick else "ahead"] += 1
            return
        repeated = packet.kind == "mark" and packet.tick <= node.inbox.marked.get(packet.link, -1)
        packet = self._dated(packet, now)
        self._note(packet, node.sort_in(packet), now, repeated)

    def _dated(self, packet: Packet, now: float) -> Packet:
        """Return a packet of a link with random delays with its delay, in real time; every other one as it is."""
        counted = self._counted
        if counted is None or packet.kind != "data" or packet.link not in counted.links:
            return packet
        after = now - self._begins_at(packet.tick) if self.phase.known else 0.0
        return packet._replace(late=counted.pieces(packet.link, max(after, counted.least)))

    def _note(self, packet: Packet, handling: str, now: float, repeated: bool) -> None:
        """Draw the conclusions from a packet that a node has sorted in: it may correct the clock, and ends silence."""
        loop, node = packet.loop, self.nodes[packet.loop]
        # in lockstep, a step runs from the end of the step before
        runs = node.tick + 1 if self._tick is None or not self.phase.known else self._running(now)
        late = node.inbox.late_by(packet, runs)
        # acknowledgements arrive after their step, so they do not count; a packet far ahead shows a late phase
        if packet.link in node.program.hears and self._tick is not None and handling in USABLE | {"ahead"}:
            self.phase.hear(packet.tick, now)
        if handling not in USABLE:
            self._answer_again(loop, now, repeated)
            return
        if packet.link in node.program.hears:
            self._expires = now + self._patience
        if packet.kind == "data":
            self.arrived[packet.link] += 1
            self.lateness.setdefault(packet.link, Lateness()).add(late, handling == "late")
            if self._told is not None:
                read = packet.tick + node.listens.get(packet.link, 0)
                came = Arrival(packet.epoch, packet.sequence, packet.tick, read, now, late, handling == "late")
                self._news[loop].setdefault(packet.link, []).append(came)

    def _begins(self, packet: Packet, now: float) -> bool:
        """Return whether the step of a measurement can have begun and has not been executed."""
        last = self.nodes[packet.loop].tick
        if self._tick is not None:
            return self.phase.hear(packet.tick, now) and packet.tick > last
        return last < packet.tick <= last + AHEAD or last < 0  # the plant may be ahead of a sensor that starts late

    def _answer_again(self, loop: int, now: float, asked: bool) -> None:
        """Send the packets of the last steps again, as they may have been dropped."""
        if asked and self._tick is None:
            self._outbox.repeat(loop, now)

    def _go_on(self, node: Node, now: float) -> None:
        """Execute the steps that may begin."""
        while (tick := self._next(node, now)) is not None:
            loop = node.loop
            measurement = self._measured_in(node, tick)
            known, overflowed = node.silent_links, node.counters["overflowed"]
            packets, given = node.step(tick, measurement)
            self._report_silence(node, known)
            if node.counters["overflowed"] > overflowed:
                self._report_overflow(node)
            out = list(packets)
            out += node.mark(0 if self._tick is None else self._heartbeat)
            if given is not None and not self._at_once:
                out.append(self._input(node, tick, given))
            self._outbox.keep(loop, out)
            self._save(node)
            sent = self._clock()
            self._outbox.send(out)
            if loop in self._asked:
                self._report_set_points(node, self._asked.pop(loop))
            if self._tick is not None and self.phase.known:
                self._lateness.append(self._clock() - self._begins_at(tick) - self._at_once * self.phase.tick)
            if self._told is not None:
                news, self._news[loop] = self._news[loop], {}
                several = loop if len(self.nodes) > 1 else None
                numbers = {link: [one.sequence for one in came] for link, came in news.items()}
                line = log_line(node, measurement, packets, given, numbers, several)
                self._told(line | packet_times(packets, sent, news))
            now = self._clock()
            if not node.measures or self._seen[loop] == tick:
                self._expires = now + self._patience
        if self._at_once and self.phase.known:
            self._act(node)

    def _act(self, node: Node) -> None:
        """Acknowledge the packets that have arrived in the step that is running, and apply the newest one."""
        tick, loop = node.tick + 1, node.loop
        packets, given = node.so_far(tick)
        assert given is not None, "a node that acts at once applies inputs"
        out = list(packets)
        if (tick, given) != (self._shown[loop][0], self._shown[loop][2]):
            out.append(self._input(node, tick, given))
        self._outbox.keep_more(loop, out)
        self._outbox.send(out)

    def _measured_in(self, node: Node, tick: int) -> Measurement | None:
        """Return the measurement of a step; if none has arrived, all outputs are missing."""
        found, loop = self._measurements[node.loop].pop(tick, None), node.loop
        if found is not None:
            self._seen[loop] = tick
        return (None,) * node.measured if found is None and node.measures else found

    @property
    def _unsure(self) -> bool:
        """Whether the process was suspended, or its clock has jumped, and no packet has shown which.

        A node with a sensor is less sure: it continues without a measurement only if the plant would have sent one.
        """
        most = BEHIND if self.nodes[0].measures else JUMPED
        return self._tick is not None and self._strayed > most * self._tick

    def _notice(self, now: float, until: float) -> None:
        """Add up the time that has passed beyond that for which the server waited, until a packet confirms the phase.

        The process was suspended, or its clock has jumped. After a large jump, the node begins no step, because a node
        that is ahead of time would have to wait until its steps are due.
        """
        if self.phase.confirmations > self._confirmed:
            self._strayed = min(self._strayed, self.phase.late)
        else:
            passed, knew = now - max(until, self._turned), not self._unsure
            self._strayed += passed if passed > BEHIND * self.phase.tick else 0.0
            if knew and self._unsure:
                self._expires = now + self._patience
        self._turned, self._confirmed = now, self.phase.confirmations

    def _next(self, node: Node, now: float) -> int | None:
        """Return the step that a node may begin now, or None."""
        tick, loop = node.tick + 1, node.loop
        if self._tick is None:
            # before the first datagram arrives, the peers may not run yet, and packets would be lost
            heard = all(node.inbox.finished(link, tick - lag) for link, lag in node.listens.items())
            heard = heard and self.endpoint.received > 0
            heard = heard and node.inbox.given(tick)
            return tick if heard and (not node.measures or tick in self._measurements[loop]) else None
        known = self._measurements[loop] if node.measures else {}
        first = min(known, default=None)
        if first is not None and (first <= tick or node.tick < 0):
            return first
        if not self.phase.known or self._unsure:
            return first
        if self._played is not None or self._at_once:
            tick = self._coming(node.tick, self._present(now))
            return tick if now >= self._deadline(tick) else None
        prompt = [link for link, lag in node.listens.items() if lag == 0]
        timed = self._counted is not None and bool(self._counted.links)  # packets of earlier steps may still come

        def settled(tick: int) -> bool:
            return (
                bool(prompt)
                and not timed
                and not node.measures
                and all(node.inbox.settled(link, tick) for link in prompt)
            )

        come = node.tick
        while come >= 0 and settled(come + 1):  # a slow clock may be behind the packets
            come += 1
        tick = self._coming(node.tick, max(self._running(now), come))
        if node.measures and ((first is not None and first <= tick) or self._is_blind(node, tick)):
            return first
        return tick if settled(tick) or now >= self._deadline(tick) else None

    def _is_blind(self, node: Node, tick: int) -> bool:
        """Return whether a node with a sensor has had no measurement for too long to go on with a step."""
        return not 0 <= self._seen[node.loop] >= tick - BLIND

    def _deadline(self, tick: int) -> float:
        """Return the time until which a step waits for its measurement or its packets, plays them, or is over."""
        if self._at_once:
            return self._begins_at(tick + 1)
        if self._played is not None:
            return self._begins_at(tick)
        prompt = self.nodes[0].measures or (self._counted is not None and bool(self._counted.links))
        return self._begins_at(tick) + (min(self._wait, BEHIND) if prompt else self._wait) * self.phase.tick

    def _begins_at(self, tick: int) -> float:
        """Return the time at which a step begins, or at which its packets are played out."""
        return self.phase.begins(tick) + self._after

    def _running(self, now: float) -> int:
        """Return the step that is running, or whose packets are being played out."""
        return self.phase.now(now - self._after)

    def _present(self, now: float) -> int:
        """Return the step to execute at the present time: the running one, or the last one if it ends with packets."""
        return max(0, self._running(now) - self._at_once)

    def _coming(self, last: int, present: int) -> int:
        """Return the step that follows the last one in real time: the present step at the start, or if it is late."""
        return present if last < 0 or last + 1 < present - LEFT_BEHIND else last + 1

    def _expire(self, now: float) -> None:
        """Apply the safe inputs if no step was executed and nothing usable arrived for so long; then repeat them."""
        if not self._patience or now < self._expires:
            return
        for node in self.nodes:
            known = node.silent_links
            given = node.expire()
            self._report_silence(node, known)
            if given is not None:  # its number is before those of all later steps, whose inputs the plant prefers
                tick = node.tick + 1
                out = [self._input(node, tick, given)]
                self._outbox.keep(node.loop, out)
                self._outbox.send(out)
        self._expires = now + self._patience

    def _input(self, node: Node, tick: int, given: Values) -> Packet:
        """Return the packet that carries the input of a step to the plant."""
        assert self._plant is not None, "a node that applies inputs has a link with the plant"
        number = tick & 0xFFFFFFFF
        if self._at_once:  # several inputs in a step, each with a number of its own
            number = (self._shown[node.loop][1] + 1) & 0xFFFFFFFF
            self._shown[node.loop] = tick, number, given
        return Packet("input", self._plant, tick, number, given, node.epoch, node.loop)

    def _report_overflow(self, node: Node) -> None:
        """Print, the first time for each node, that it holds because its numbers are too large."""
        if self._say is not None and node.loop not in self._held:
            self._held.add(node.loop)
            self._say(
                f"step {node.tick} of the {node.role} has results that are not finite or beyond {LARGEST:.2g}: the "
                "node keeps its last input, sends no data in such steps, starts its memory again, and is degraded; "
                "expected measurements and packets in the range for which the policy was designed: is a sensor broken?"
            )

    def _report_silence(self, node: Node, known: Sequence[str]) -> None:
        """Print on which links a node has received nothing usable, except those that were silent before."""
        silent = [link for link in node.silent_links if link not in known]
        if self._say is None or not silent:
            return
        unused = self._unusable(node)
        news = unused - self._unused[node.loop]
        self._unused[node.loop] = unused
        found = ", ".join(f"{number} {name}" for name, number in news.items()) or "none"
        steps = min(node.limits.get(link, node.watchdog or 0) for link in silent)
        self._say(
            f"the {node.role} has received no usable packet on the link {' and '.join(silent)} for "
            f"{number_of(steps, 'step')} and "
            f"is degraded (packets discarded since the start or the last such message: {found}); expected a packet or "
            "a mark in that time: is the sender running, and is the link intact?"
        )

    def _unusable(self, node: Node) -> Counter[str]:
        """Return the numbers of packets that a node did not use."""
        return Counter({name: node.counters[name] for name in UNUSABLE}) + self.refused

    def _until(self) -> float:
        """Return the time until which to wait for datagrams."""
        idle = self._clock() + IDLE
        if self._patience:
            idle = min(idle, self._expires)
        if self._tick is None or not self.phase.known or self._unsure:
            return idle
        present = self._present(self._clock())
        due = [(node, self._coming(node.tick, present)) for node in self.nodes]
        due = [(node, tick) for node, tick in due if not (node.measures and self._is_blind(node, tick))]
        return min([idle, *(self._deadline(tick) for _, tick in due)])

    def _save(self, node: Node) -> None:
        """Save the state of the node, if a storage is given."""
        if self._keep is None:
            return
        kept = {
            "node": node.save(),
            "measured": self._measured[0].save(),
            "outbox": self._outbox.save(),
            "inputs": self._shown[0][1],
            "sessions": self.reception.save(),
        }
        self._keep.write(json.dumps(sealed(kept)).encode())

    def _take_up(self, state: bytes) -> None:
        try:
            kept = json.loads(state)
            self.nodes[0].restore(kept["node"])  # which names a state of another release, policy or node
            check_seal(kept, f"the saved state {self._keep}")
            self._measured[0].restore(kept["measured"])
            self._outbox.restore(kept["outbox"])
            self._shown[0] = -1, kept.get("inputs", 0) + WIDTH // 2, ()  # beyond those after the state was saved
            self.reception.restore(kept["sessions"])
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ProblemError(
                f"the saved state {self._keep} cannot be read ({error}); expected a saved state of this node"
            ) from None
        if self._tick is None:
            self._outbox.repeat(0, self._began)  # the process may have ended after saving and before sending


def played_after(node: Node, tick: float | None) -> float:
    """Return the seconds after the earliest arrival of a packet at which a node uses it.

    The phase of a node is that of the packets with the least delay, so a packet is used the buffer less this delay
    after the phase. If there are several links, the latest packet counts, as a step has one packet of each.
    """
    waits, period = list[float](), node.policy.tick
    for link in node.program.hears:
        law = node.network.links[link]
        if law.buffer is not None:
            least = 0.0 if law.delay is None else law.delay.wait(0).periods(period)
            waits.append(law.buffer.periods(period) - least)
    if tick is None or node.measures or not waits:
        how = "runs in virtual time, in which the plant shows delays" if tick is None else "has no link with a buffer"
        how = "begins a step with its own sample" if tick is not None and node.measures else how
        raise ProblemError(
            f"the {node.role} is to play packets out, but it {how}; expected real time, and a node without a sensor on "
            "whose link packets have a buffer"
        )
    return max(waits) * tick
