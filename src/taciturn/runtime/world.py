"""What nodes meet over UDP: a simulated plant, and links that carry their packets."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from taciturn._arrays import Array
from taciturn.runtime.inbox import AHEAD
from taciturn.runtime.node import Values
from taciturn.runtime.packet import Packet, Wire
from taciturn.runtime.relay import EmulatedLink
from taciturn.runtime.service import IDLE, QUIET, Say, Told, disagreement
from taciturn.runtime.udp import Address, Endpoint
from taciturn.runtime.window import Window

WAITED, WAITED_AGAIN = 2.0, 30.0  # seconds without an input after which the plant says that it waits, and says so again


class Physical(Protocol):
    """A plant, one tick at a time, as ``taciturn.runtime.plant.SimulatedPlant`` is one."""

    @property
    def inputs(self) -> int:
        """How many there are."""
        ...

    @property
    def tick_length(self) -> float:
        """Seconds of a tick; 1 where the problem does not say."""
        ...

    @property
    def measurement(self) -> Values:
        """y, (p,), of the present tick."""
        ...

    @property
    def state(self) -> Array:
        """x, (n,)."""
        ...

    def move(self, inputs: Sequence[float]) -> float:
        """Go through a tick with these inputs, and return what it costs."""
        ...


class PlantServer:
    """Measures and acts for the nodes of a loop: a plant that tells its measurements and takes its inputs.

    Args:
        plants: one per loop, in order.
        wire: that writes and reads the packets.
        endpoint: where inputs arrive.
        sensor: who gets the measurements.
        tick: real seconds per tick; omitted: lockstep.
        told: called with what happened in each tick.
        say: called with a sentence where no input comes in lockstep, or packets of another policy or key are refused.
    """

    def __init__(
        self,
        plants: Sequence[Physical],
        wire: Wire,
        endpoint: Endpoint,
        sensor: Address,
        *,
        tick: float | None = None,
        told: Told | None = None,
        say: Say | None = None,
    ) -> None:
        """Nothing has happened."""
        self.plants, self.wire, self.endpoint, self.sensor = plants, wire, endpoint, sensor
        self._tick, self._told, self._say = tick, told, say
        self.inputs: list[Values] = [(0.0,) * plant.inputs for plant in plants]
        self._given = [-1] * len(plants)  # tick of the last input
        self._waiting: list[dict[int, Values]] = [{} for _ in plants]  # inputs by tick: a node may be one ahead
        self._windows = [Window() for _ in plants]
        self._now, self._epoch = 0, int(time.time())
        self.costs: list[list[float]] = [[] for _ in plants]
        self.refused: Counter[str] = Counter()
        self.largest = 0.0  # entry of a state
        self.held = 0  # ticks in which no input came, and the last one went on
        self.again = 0  # measurements told again

    def run(self, ticks: int, stopped: Callable[[], bool]) -> dict[str, Any]:
        """Go through so many ticks, or until stopped, and return the report."""
        zero = time.monotonic()
        for tick in range(ticks):
            if stopped():
                break
            self._now = tick
            self._measure(tick)
            if self._tick is None:
                self._await(tick, stopped)
            else:
                self._wait(zero + (tick + 1) * self._tick)
            for loop, plant in enumerate(self.plants):
                self._adopt(loop, tick)
                before = plant.state.tolist()
                self.held += self._given[loop] < tick
                self.costs[loop].append(plant.move(self.inputs[loop]))
                self.largest = max(self.largest, float(np.abs(plant.state).max()))
                if self._told is not None:
                    line = {
                        "timestamp": tick * plant.tick_length,
                        "tick": tick,
                        "role": "plant",
                        "loop": loop,
                    }
                    line |= {
                        "from": before,
                        "x": plant.state.tolist(),
                        "u": list(self.inputs[loop]),
                        "cost": self.costs[loop][-1],
                    }
                    self._told(line)
        return self.report()

    def report(self) -> dict[str, Any]:
        """Return what has been counted so far."""
        return {
            "role": "plant",
            "tick": max(len(costs) for costs in self.costs) - 1,
            "held": self.held,
            "largest_state": self.largest,
            "measured_again": self.again,
            "refused": dict(self.refused),
            "datagrams": self.endpoint.counted,
        }

    def _measure(self, tick: int, again: bool = False) -> None:
        """Tell the measurements of a tick; again, those of the loops whose input has not come."""
        for loop, plant in enumerate(self.plants):
            if not again or tick not in self._waiting[loop]:
                sequence = tick & 0xFFFFFFFF
                packet = Packet("measurement", "plant", tick, sequence, plant.measurement, self._epoch, loop)
                self.endpoint.send(self.wire.encode(packet), self.sensor)

    def _adopt(self, loop: int, tick: int) -> None:
        """Let the input of a tick act, if it has come."""
        if tick in self._waiting[loop]:
            self.inputs[loop], self._given[loop] = self._waiting[loop].pop(tick), tick

    def _await(self, tick: int, stopped: Callable[[], bool]) -> None:
        """Wait for the inputs of a tick; tell the measurement again where none comes."""
        remind = time.monotonic() + WAITED
        while any(tick not in waiting for waiting in self._waiting) and not stopped():
            found = self.endpoint.receive(time.monotonic() + IDLE)
            self._take(found)
            if not found:
                self.again += 1
                self._measure(tick, again=True)
            if self._say is not None and time.monotonic() >= remind:
                remind += WAITED_AGAIN
                host, port = self.sensor
                self._say(
                    f"the plant still waits for the input of tick {tick} from the nodes behind {host}:{port}: "
                    "do all of them run, started after the last run ended, with the same problem file?"
                )

    def _wait(self, until: float) -> None:
        """Take inputs until a time."""
        while time.monotonic() < until:
            self._take(self.endpoint.receive(until))

    def _take(self, datagrams: Sequence[bytes]) -> None:
        for datagram, sender in zip(datagrams, self.endpoint.senders, strict=True):
            packet = self.wire.decode(datagram)
            if isinstance(packet, str):
                self.refused[packet] += 1
                sentence = disagreement("plant", packet, self.wire.keyed, sender)
                if sentence and self.refused[packet] == 1 and self._say is not None:
                    self._say(sentence)
            elif packet.kind != "input" or packet.loop >= len(self.plants):
                self.refused["misdirected"] += 1
            else:
                self._sort(packet)

    def _sort(self, packet: Packet) -> None:
        """Keep an input for its tick; one that is late acts at once, if none of a later tick has."""
        loop, news = packet.loop, self._windows[packet.loop].admit(packet.epoch, packet.sequence)
        if news != "new":
            self.refused[news] += 1
        elif packet.tick > self._now + AHEAD:
            self.refused["ahead"] += 1
        elif packet.tick >= self._now:
            self._waiting[loop][packet.tick] = packet.values
        elif packet.tick > self._given[loop]:
            self.inputs[loop], self._given[loop] = packet.values, packet.tick
        else:
            self.refused["late"] += 1


def relay(link: EmulatedLink, endpoint: Endpoint, peer: Address, stopped: Callable[[], bool]) -> dict[str, Any]:
    """Carry datagrams to a peer over a link that may lose them, until stopped; return the report."""

    def carry(until: float) -> bool:
        found = endpoint.receive(until if link.due is None else min(until, link.due))
        now = time.monotonic()
        out = [datagram for one in found for datagram in link.take(one, now)]
        for datagram in out + link.release(now):
            endpoint.send(datagram, peer)
        return bool(found)

    while not stopped():
        carry(time.monotonic() + IDLE)
    while carry(time.monotonic() + QUIET):
        pass
    return {
        "role": "relay",
        "counters": dict(link.counters),
        "pending": link.pending,
        "datagrams": endpoint.counted,
    }
