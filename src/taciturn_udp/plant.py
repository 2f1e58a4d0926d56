"""Server of simulated plants: it sends measurements to nodes over UDP, and applies the inputs that it receives."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from math import nan
from typing import Any, Protocol

from taciturn.extend import Array
from taciturn.model.wire import BACK, PROOFS
from taciturn.nodes.inbox import AHEAD, Window
from taciturn.nodes.lateness import Lateness
from taciturn.nodes.node import Measurement, Values
from taciturn.nodes.packet import Packet, Wire
from taciturn_udp.endpoint import Address, peers_by_link
from taciturn_udp.proofs import Reception
from taciturn_udp.service import IDLE, Port, Say, Told, Turns, drive

WAITED, WAITED_AGAIN = 2.0, 30.0  # seconds without an input before the plant's first and each further message


class Physical(Protocol):
    """Interface of a plant that is simulated step by step, such as ``SimulatedPlant``."""

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        ...

    @property
    def tick_length(self) -> float:
        """Sampling period in seconds; 1 if the problem does not give one."""
        ...

    @property
    def measurement(self) -> Measurement:
        """Measurement y at the present step, shape (p,); None in place of an output whose sample is missing."""
        ...

    @property
    def state(self) -> Array:
        """State x, (n,)."""
        ...

    def move(self, inputs: Sequence[float]) -> float:
        """Apply these inputs to the plant for one step, and return the cost of the step."""
        ...


class _Inputs:
    """The inputs that one process sends to a plant."""

    def __init__(self, places: Sequence[int], entries: int) -> None:
        """Start with zeros, in all pieces of a step in each of which a packet has another input."""
        self.places, self.values = places, (0.0,) * entries
        self.forget()

    def forget(self) -> None:
        """Accept packets of any epoch from now on, and continue to apply the values of the last packet."""
        self.window, self.waiting = Window(), dict[int, Packet]()  # by step: a node may be one step ahead
        self.given = -1, -1  # epoch and step number of the last packet that was applied

    def apply(self, packet: Packet) -> None:
        """Apply the input that a packet carries, from now on."""
        self.values, self.given = packet.values, (packet.epoch, packet.tick)


class PlantServer:
    """Server of plants: it sends their measurements to the sensors, and applies the inputs that it receives.

    Args:
        plants: plants, one per loop, in order.
        wire: encoder and decoder of the packets.
        endpoint: socket that receives the inputs.
        sensor: address of the node that receives the measurements, or the addresses by link of the plant.
        tick: real seconds per step; default: lockstep.
        told: function called with the log line of each step.
        say: function called with a message if no input arrives in lockstep, or if packets of another policy or key are
            rejected.
        clock: function that returns the time in seconds, from any origin.
        epoch: number that increases with every start; default: the system time in seconds.
        draw: function that returns the random number of a challenge; default: one of the operating system.

    Raises:
        ProblemError: the keys contain none for the plant link.
    """

    def __init__(
        self,
        plants: Sequence[Physical],
        wire: Wire,
        endpoint: Port,
        sensor: Address | Mapping[str, Address] | None,
        *,
        tick: float | None = None,
        told: Told | None = None,
        say: Say | None = None,
        clock: Callable[[], float] = time.monotonic,
        epoch: int | None = None,
        draw: Callable[[], int] | None = None,
    ) -> None:
        """Start before the first step."""
        self.plants, self.wire, self.endpoint = plants, wire, endpoint
        self._sensors = peers_by_link("the plant", sensor, [link for link, ends in wire.plant.items() if ends.outputs])
        self._tick, self._told, self._say = tick, told, say
        applied = {link: ends.inputs for link, ends in wire.plant.items() if ends.inputs}
        self._inputs = [
            {link: _Inputs(places, wire.entries("input", link)) for link, places in applied.items()} for _ in plants
        ]
        self._shift = 0  # number of the first step, which nodes that already run determine
        self._zero: float | None = None  # time at which the first step begins
        self._clock, self._now, self._epoch = clock, 0, int(time.time()) if epoch is None else epoch
        self.lateness = {link: Lateness() for link in applied}  # of the inputs, by link
        self.taken = 0  # inputs that were applied or stored for their step
        self.costs: list[list[float]] = [[] for _ in plants]
        self.reception = Reception(wire, endpoint, "plant", list(wire.plant), say, draw)
        self.refused = self.reception.refused
        self.largest = 0.0  # largest absolute entry of a state
        self.held = 0  # steps without a new input, in which the last input was held
        self.again = 0  # measurements sent again

    def run(self, steps: int, stopped: Callable[[], bool]) -> dict[str, Any]:
        """Execute ``steps`` steps, or fewer if the server is stopped, and return the report."""
        drive(self.endpoint, self.turns(steps, stopped))
        return self.report()

    def turns(self, steps: int, stopped: Callable[[], bool]) -> Turns:
        """Execute ``steps`` steps, or fewer if the server is stopped; wait for datagrams between the steps."""
        self._zero = zero = self._clock()
        for count in range(steps):
            if stopped():
                break
            self._now = count + self._shift
            self._measure(self._now)
            if self._tick is None:
                yield from self._await(self._now, stopped)
            else:
                yield from self._wait(zero + (count + 1) * self._tick)
            self._shift = self._now - count
            tick = self._now
            for loop, plant in enumerate(self.plants):
                self._adopt(loop, tick)
                before, given = plant.state, self.given(loop)
                self.held += any(one.given[1] < tick for one in self._inputs[loop].values())
                self.costs[loop].append(plant.move(given))
                after = plant.state.tolist()
                self.largest = max(self.largest, *map(abs, after))
                if self._told is not None:
                    line = {
                        "timestamp": tick * plant.tick_length,
                        "tick": tick,
                        "role": "plant",
                        "loop": loop,
                    }
                    line |= {
                        "from": before.tolist(),
                        "x": after,
                        "u": list(given),
                        "cost": self.costs[loop][-1],
                    }
                    self._told(line)

    def begins(self, tick: int) -> float | None:
        """Return the time at which a step begins in real time, by the server's clock; None before the first step."""
        return None if self._zero is None or self._tick is None else self._zero + (tick - self._shift) * self._tick

    def report(self) -> dict[str, Any]:
        """Return the counters so far."""
        return {
            "role": "plant",
            "tick": max(len(costs) for costs in self.costs) - 1,
            "held": self.held,
            "largest_state": self.largest,
            "measured_again": self.again,
            "inputs": self.taken,
            "late_packets": {link: one.document() for link, one in self.lateness.items()},
            "refused": dict(self.refused),
            "proofs": dict(self.reception.counters),
            "datagrams": self.endpoint.counted,
        }

    def given(self, loop: int) -> Values:
        """Return the input that a plant applies at present, shape (m,), or those of all pieces of a period in turn."""
        pieces = max(len(one.values) // len(one.places) for one in self._inputs[loop].values())
        values = [[0.0] * self.plants[loop].inputs for _ in range(pieces)]
        for one in self._inputs[loop].values():
            last = one.values[-len(one.places) :]
            shown = one.values if len(one.values) > len(one.places) and one.given[1] == self._now else last * pieces
            for i, value in enumerate(shown):
                values[i // len(one.places)][one.places[i % len(one.places)]] = value
        return tuple(value for row in values for value in row)

    def _measure(self, tick: int, again: bool = False, asked: str | None = None) -> None:
        """Send the measurements of a step, perhaps only of loops of which an input has not arrived, or of one link."""
        for loop, plant in enumerate(self.plants):
            if again and self._complete(loop, tick):
                continue
            for link, to in self._sensors.items() if asked is None else [(asked, self._sensors[asked])]:
                entries = [plant.measurement[i] for i in self.wire.plant[link].outputs]
                y = tuple(nan if value is None else value for value in entries)
                packet = Packet("measurement", link, tick, tick & 0xFFFFFFFF, y, self._epoch, loop)
                self.endpoint.send(self.wire.encode(packet), to)

    def _complete(self, loop: int, tick: int) -> bool:
        """Return whether all inputs of a step have arrived."""
        return all(tick in one.waiting for one in self._inputs[loop].values())

    def _adopt(self, loop: int, tick: int) -> None:
        """Apply the inputs of a step from now on that have arrived and whose sender has not started again since."""
        for one in self._inputs[loop].values():
            packet = one.waiting.pop(tick, None)
            if packet is not None and (packet.epoch, packet.tick) > one.given:
                one.apply(packet)

    def _await(self, tick: int, stopped: Callable[[], bool]) -> Turns:
        """Wait for the inputs of a step; send the measurement again while no input arrives."""
        remind = self._clock() + WAITED
        while not all(self._complete(loop, tick) for loop in range(len(self.plants))) and not stopped():
            found = yield self._clock() + IDLE
            self._take(found)
            if not found:
                self.again += 1
                self._measure(tick, again=True)
            if self._say is not None and self._clock() >= remind:
                remind += WAITED_AGAIN
                behind = ", ".join(f"{host}:{port}" for host, port in self._sensors.values())
                self._say(
                    f"the plant still waits for the input of step {tick} from the nodes behind {behind}: "
                    "are all nodes running, were they started after the last run ended, and do they use the same "
                    "problem file?"
                )

    def _wait(self, until: float) -> Turns:
        """Receive inputs until a given time."""
        while self._clock() < until:
            self._take((yield until))

    def _take(self, datagrams: Sequence[bytes]) -> None:
        for packet, sender in self.reception.packets(zip(datagrams, self.endpoint.senders, strict=True)):
            if packet.loop >= len(self.plants) or not self._expects(packet):
                self.refused["misdirected"] += 1
            elif self._admits(packet, sender):
                self._sort(packet)

    def _expects(self, packet: Packet) -> bool:
        """Return whether nodes send such packets to the plant. Only a node that receives measurements challenges it."""
        if packet.kind == "challenge" and packet.link not in self._sensors:
            return False
        return packet.link in self.wire.plant and (packet.kind in BACK or (packet.kind in PROOFS and packet.back))

    def _admits(self, packet: Packet, sender: Address) -> bool:
        """Return whether an input may be sorted; answer a challenge, and store the proof in an answer."""
        if packet.kind == "challenge":
            answer = self.reception.answer(packet, self._epoch, self._now)
            self.endpoint.send(self.wire.encode(answer), self._sensors[packet.link])
            self._measure(self._now, again=True, asked=packet.link)
            return False
        if packet.kind == "answer":
            if self.reception.accepts(packet):
                self._inputs[packet.loop][packet.link].forget()
            return False
        return self.reception.admits(packet, sender)

    def _sort(self, packet: Packet) -> None:
        """Store an input for its step; apply a late input immediately unless a later one has been applied."""
        one = self._inputs[packet.loop][packet.link]
        news = one.window.admit(packet.epoch, packet.sequence)
        if self._tick is not None and not self.taken and news == "new" and packet.tick > self._now + 1:
            self._now = packet.tick  # the nodes run already, and this plant has started again
        if news != "new":
            self.refused[news] += 1
            return
        self.lateness[packet.link].add(max(0, self._now - packet.tick))
        if packet.tick > self._now + AHEAD:
            self.refused["ahead"] += 1
        elif packet.tick >= self._now:
            known = one.waiting.get(packet.tick)
            if known is None or (packet.epoch, packet.sequence) > (known.epoch, known.sequence):
                one.waiting[packet.tick] = packet  # an actuator that acts at once sends one for each packet
            self.taken += 1
        elif (packet.epoch, packet.tick) > one.given:
            one.apply(packet)
            self.taken += 1
        else:
            self.refused["late"] += 1
