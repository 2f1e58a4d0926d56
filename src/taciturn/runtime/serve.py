"""Drives nodes over UDP: in lockstep, where virtual time goes on when all has been heard, or in real time.

In lockstep every node sends a mark when it has finished a tick, and begins a tick when the marks of those it listens to
have come: packets cannot be too late, and the same seeds give the same run. In real time a node that measures begins a
tick when the measurement comes, and another when its packet has come, or at an absolute deadline.
"""

from __future__ import annotations

import json
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taciturn._files import write_whole
from taciturn.errors import ProblemError
from taciturn.runtime.clock import Phase
from taciturn.runtime.inbox import AHEAD, packet_of
from taciturn.runtime.node import Node, Values
from taciturn.runtime.packet import Packet, Wire
from taciturn.runtime.service import IDLE, QUIET, Say, Told, disagreement, take_until
from taciturn.runtime.udp import Address, Endpoint
from taciturn.runtime.window import Window

LEFT_BEHIND = 8  # ticks behind which a node goes on with the present
PATIENT = 4096  # measurements that wait for their tick
REMEMBERED = 100_000  # ticks whose lateness is told, the last
SHARES = (50.0, 95.0, 99.0, 100.0)  # percentiles of lateness


class NodeServer:
    """Runs the nodes of one role, one for each of many loops, on one socket.

    Args:
        nodes: one per loop, in order.
        wire: that writes and reads their packets.
        endpoint: where they listen.
        peer: who gets their packets: the next node, or a link on the way to it; None where they send none.
        plant: who measures and acts; None where the nodes do neither.
        tick: real seconds per tick; omitted: lockstep.
        wait: the share of a tick that a packet of this tick is waited for, in real time.
        heartbeat: ticks between marks, in real time.
        keep: where the state is kept after every tick; one node only.
        told: called with what happened in each tick.
        say: called with a sentence, once, where packets of another policy or key are refused.

    Raises:
        ProblemError: a peer or a plant is missing, or a kept state does not fit.
    """

    def __init__(
        self,
        nodes: Sequence[Node],
        wire: Wire,
        endpoint: Endpoint,
        *,
        peer: Address | None = None,
        plant: Address | None = None,
        tick: float | None = None,
        wait: float = 0.5,
        heartbeat: int = 1,
        keep: Path | None = None,
        told: Told | None = None,
        say: Say | None = None,
    ) -> None:
        """Check that everybody is there, and take up a kept state."""
        first = nodes[0]
        self.nodes, self.wire, self.endpoint = nodes, wire, endpoint
        if (first.measures or first.actuates) and plant is None:
            raise ProblemError(f"--plant is missing, and the {first.role} meets the plant; expected its HOST:PORT")
        if first.talks and peer is None:
            raise ProblemError(f"--peer is missing, and the {first.role} sends packets; expected HOST:PORT")
        if first.program.sends and first.acknowledges:
            raise ProblemError(
                f"the {first.role} sends packets on one link and acknowledges those of another, and a node has one "
                "peer; expected a policy that acknowledges at its actuator only"
            )
        self.peer, self.plant, self._tick, self._wait = peer, plant, tick, wait
        self._heartbeat, self._keep, self._told, self._say = heartbeat, keep, told, say
        self.phase = Phase(tick or 1.0)
        self.refused: Counter[str] = Counter()
        self.arrived: Counter[str] = Counter()  # new data, by link
        self._news: list[dict[str, list[int]]] = [{} for _ in nodes]  # sequences of those since the last line
        self._measurements: list[dict[int, Values]] = [{} for _ in nodes]
        self._measured = [Window() for _ in nodes]
        self._outbox: list[list[Packet]] = [[] for _ in nodes]
        self._answered = [0.0 for _ in nodes]  # when the outbox was sent again
        self._lateness: deque[float] = deque(maxlen=REMEMBERED)
        self._began, self._cpu = time.monotonic(), time.process_time()
        self._physical = 0
        if keep is not None and not keep.parent.is_dir():
            raise ProblemError(
                f"the state is to be kept in {keep.parent}, which is no folder; expected one that exists"
            )
        if keep is not None and keep.exists():
            self._take_up(keep)

    def run(self, ticks: int | None, stopped: Callable[[], bool]) -> dict[str, Any]:
        """Go through ticks until so many are done or until stopped, and return the report."""
        while not stopped() and not (ticks is not None and all(node.tick >= ticks - 1 for node in self.nodes)):
            touched = self._take(self.endpoint.receive(self._until()))
            now = time.monotonic()
            for node in (self.nodes[loop] for loop in touched) if self.nodes[0].measures else self.nodes:
                self._go_on(node, now)
        return self.report()

    def finish(self, stopped: Callable[[], bool]) -> dict[str, Any]:
        """Take what is still on its way until stopped, go through no more ticks, and return the report."""
        take_until(self.endpoint, self._take, stopped)
        return self.report()

    def report(self) -> dict[str, Any]:
        """Return what has been counted so far."""
        counters, reasons = Counter[str](), Counter[str]()
        for node in self.nodes:
            counters += node.counters
            reasons += node.reasons
        found: dict[str, Any] = {
            "role": self.nodes[0].role,
            "loops": len(self.nodes),
            "tick": max(node.tick for node in self.nodes),
            "counters": dict(counters),
            "arrived": dict(self.arrived),
            "waiting": sum(node.inbox.waiting for node in self.nodes),
            "refused": dict(self.refused),
            "physical": self._physical,
            "datagrams": self.endpoint.counted,
            "degraded": dict(reasons),
            "seconds": round(time.monotonic() - self._began, 3),
            "cpu_seconds": round(time.process_time() - self._cpu, 3),
        }
        if self._lateness:
            late = np.percentile(1e3 * np.array(self._lateness), SHARES)
            names = ("p50", "p95", "p99", "max")
            found["lateness_ms"] = {name: round(float(value), 3) for name, value in zip(names, late, strict=True)}
            found["clock_jumps"] = self.phase.jumps
        return found

    def _take(self, datagrams: Sequence[bytes]) -> set[int]:
        """Sort datagrams in, and return the loops that they are of."""
        now, touched = time.monotonic(), set[int]()
        for datagram, sender in zip(datagrams, self.endpoint.senders, strict=True):
            packet = self.wire.decode(datagram)
            if isinstance(packet, str):
                self.refused[packet] += 1
                sentence = disagreement(self.nodes[0].role, packet, self.wire.keyed, sender)
                if sentence and self.refused[packet] == 1 and self._say is not None:
                    self._say(sentence)
            elif packet.loop >= len(self.nodes):
                self.refused["misdirected"] += 1
            else:
                self._sort(packet, now)
                touched.add(packet.loop)
        return touched

    def _sort(self, packet: Packet, now: float) -> None:
        """Give a packet to its node's next tick; in lockstep one that comes again asks for the last answer again."""
        loop, node = packet.loop, self.nodes[packet.loop]
        if packet.link == "plant":
            self._physical += 1
            news = self._measured[loop].admit(packet.epoch, packet.sequence)
            if packet.kind != "measurement" or not node.measures:
                self.refused["misplaced"] += 1
            elif news != "new":
                self.refused[news] += 1
                self._answer_again(loop, now, news == "duplicate")
            elif self._begins(packet, now) and len(self._measurements[loop]) < PATIENT:
                self._measurements[loop][packet.tick] = packet.values
            else:
                self.refused["ahead"] += 1
            return
        repeated = packet.kind == "mark" and packet.tick <= node.inbox.marked.get(packet.link, -1)
        early = node.counters["ahead"]
        new = node.sort_in([packet])
        # an acknowledgement comes when a tick is over; a packet far ahead is dropped, and says that the clock is behind
        if packet.link in node.program.hears and self._tick is not None and (new or node.counters["ahead"] > early):
            self.phase.hear(packet.tick, now)
        if not new:
            self._answer_again(loop, now, repeated)
            return
        if packet.kind == "data":
            self.arrived[packet.link] += 1
            if self._told is not None:
                self._news[loop].setdefault(packet.link, []).append(packet.sequence)

    def _begins(self, packet: Packet, now: float) -> bool:
        """Whether the tick of a measurement can have begun, and is not past."""
        last = self.nodes[packet.loop].tick
        if self._tick is not None:
            return self.phase.hear(packet.tick, now) and packet.tick > last
        return last < packet.tick <= last + AHEAD or last < 0  # the plant may be ahead of a sensor that nobody awaits

    def _answer_again(self, loop: int, now: float, asked: bool) -> None:
        """Send what was sent last, as the answer may have been lost; not so often that others can make much of it."""
        if asked and self._tick is None and now - self._answered[loop] > QUIET:
            self._answered[loop] = now
            self._send(self._outbox[loop])

    def _go_on(self, node: Node, now: float) -> None:
        """Go through the ticks that may begin."""
        while (tick := self._next(node, now)) is not None:
            loop = node.loop
            measurement = self._measurements[loop].pop(tick, None)
            packets, given = node.step(tick, measurement)
            out = list(packets)
            if self._tick is None or tick % self._heartbeat == 0:
                out += node.mark()
            if given is not None:
                out.append(Packet("input", "plant", tick, tick & 0xFFFFFFFF, given, node.epoch, loop))
            self._outbox[loop] = out
            if self._keep is not None:
                outbox = [list(packet) for packet in out]
                kept = {"node": node.save(), "measured": self._measured[loop].save(), "outbox": outbox}
                write_whole(self._keep, json.dumps(kept).encode())
            self._send(out)
            if self._tick is not None and self.phase.known:
                self._lateness.append(time.monotonic() - self.phase.begins(tick))
            if self._told is not None:
                self._told(self._line(node, measurement, packets, given))
            now = time.monotonic()

    def _next(self, node: Node, now: float) -> int | None:
        """Return the tick that a node may begin now, or None."""
        tick, loop = node.tick + 1, node.loop
        if self._tick is None:
            # who has heard nothing at all may be alone yet: what he sends would be lost
            heard = all(node.inbox.marked[link] >= tick - lag for link, lag in node.listens.items())
            heard = heard and self.endpoint.received > 0
            return tick if heard and (not node.measures or tick in self._measurements[loop]) else None
        if node.measures:
            known = self._measurements[loop]
            return min(known) if known else None
        if not self.phase.known:
            return None
        present = self.phase.now(now)
        tick = present if tick < present - LEFT_BEHIND or node.tick < 0 else tick
        if now >= self.phase.begins(tick) + self._wait * self._tick:
            return tick
        prompt = [link for link, lag in node.listens.items() if lag == 0]
        return tick if prompt and all(node.inbox.settled(link, tick) for link in prompt) else None

    def _until(self) -> float:
        """Return until when to wait for datagrams."""
        idle = time.monotonic() + IDLE
        if self._tick is None or self.nodes[0].measures or not self.phase.known:
            return idle
        behind = min(node.tick for node in self.nodes)
        tick = self.phase.now(time.monotonic()) if behind < 0 else behind + 1
        return min(idle, self.phase.begins(tick) + self._wait * self._tick)

    def _send(self, packets: Sequence[Packet]) -> None:
        for packet in packets:
            to = self.plant if packet.link == "plant" else self.peer
            assert to is not None
            self.endpoint.send(self.wire.encode(packet), to)

    def _take_up(self, path: Path) -> None:
        try:
            kept = json.loads(path.read_bytes())
            self.nodes[0].restore(kept["node"])
            self._measured[0].restore(kept["measured"])
            self._outbox[0] = [packet_of(entry) for entry in kept["outbox"]]
        except ProblemError:
            raise
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ProblemError(f"the kept state {path} cannot be read ({error}); expected one of this node") from None
        if self._tick is None:
            self._send(self._outbox[0])  # it may have ended between keeping and sending

    def _line(
        self, node: Node, measurement: Values | None, packets: Sequence[Packet], given: Values | None
    ) -> dict[str, Any]:
        line: dict[str, Any] = {
            "timestamp": node.tick * (node.policy.model.dt or 1.0),
            "tick": node.tick,
            "role": node.role,
        }
        if len(self.nodes) > 1:
            line["loop"] = node.loop
        if measurement is not None:
            line["y"] = list(measurement)
        for link in node.program.sends:
            line[f"sent_{link}"] = int(any(packet.kind == "data" and packet.link == link for packet in packets))
        for link in node.program.hears:
            line[f"arrived_{link}"] = self._news[node.loop].pop(link, [])
        line |= {f"option_{name.replace(' ', '_')}": value for name, value in node.options.items()}
        line["memory"] = node.memory
        if given is not None:
            line["u"] = list(given)
        return line | {"degraded": int(node.degraded), "silent": int(node.silent), "waiting": node.inbox.waiting}
