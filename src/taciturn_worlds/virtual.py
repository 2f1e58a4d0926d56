"""Servers of nodes and plants in one process and in virtual time; clocks, sockets and network share an event queue.

The servers are those that run over UDP. Here their clock is a function of the virtual time, and their socket puts each
datagram into the queue of events. A run depends on its arguments alone, so that it can be repeated.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TypeAlias

from taciturn_udp.endpoint import Address
from taciturn_udp.service import Turns

Copies: TypeAlias = Sequence[tuple[float, bytes]]  # delay in seconds and datagram of every copy that arrives
SOON = 1e-9  # seconds by which a process wakes later than it asks for, so that rounding does not make it early


class VirtualTime:
    """A queue of events in order of time; simultaneous events are processed in the order in which they were added."""

    def __init__(self) -> None:
        """Start at time 0 without events."""
        self.now, self._order = 0.0, 0
        self._queue: list[tuple[float, int, Callable[[], None]]] = []

    def at(self, time: float, event: Callable[[], None]) -> None:
        """Add an event to the queue; an event whose time has passed is processed at the present time."""
        heapq.heappush(self._queue, (max(time, self.now), self._order, event))
        self._order += 1

    def run(self, until: float) -> None:
        """Process all events up to a given time."""
        while self._queue and self._queue[0][0] <= until:
            self.now, _, event = heapq.heappop(self._queue)
            event()
        self.now = until


class VirtualClock:
    """Clock of a machine, which may run fast or slow, and may jump."""

    def __init__(self, time: VirtualTime, rate: float = 1.0) -> None:
        """Start at the virtual time."""
        self._time, self._rate = time, rate
        self._set, self._shown = time.now, time.now

    def __call__(self) -> float:
        """Return the time that the clock shows."""
        return self._shown + (self._time.now - self._set) * self._rate

    def when(self, shown: float) -> float:
        """Return the virtual time at which this clock shows the given time."""
        return self._time.now + max(0.0, shown - self()) / self._rate

    def jump(self, by: float) -> None:
        """Set the clock forward by the given number of seconds; a negative number sets it back."""
        self._shown, self._set = self() + by, self._time.now

    def turn(self, rate: float) -> None:
        """Change how fast the clock runs."""
        self._shown, self._set, self._rate = self(), self._time.now, rate


class VirtualNetwork:
    """Network that delivers each datagram after a latency, or as the function ``carry`` decides.

    The counters ``sent``, ``copied`` and ``replayed`` have the same sum as ``lost``, ``unreachable`` (no process runs
    at the address), ``discarded`` (a process ended before it read them), ``delivered``, and ``flying``.
    """

    def __init__(self, time: VirtualTime, carry: Callable[[Address, Address, bytes], Copies]) -> None:
        """Start without processes."""
        self.time, self._carry = time, carry
        self.ports: dict[Address, VirtualPort] = {}
        self.counters: Counter[str] = Counter()
        self.flying = 0  # datagrams that have not arrived yet

    def send(self, datagram: bytes, sender: Address, to: Address) -> None:
        """Deliver a datagram to its receiver, under the faults of the network."""
        self.counters["sent"] += 1
        copies = self._carry(sender, to, datagram)
        self.counters["lost"] += not copies
        self.counters["copied"] += max(0, len(copies) - 1)
        for delay, copy in copies:
            self._throw(copy, sender, to, delay)

    def replay(self, datagram: bytes, sender: Address, to: Address) -> None:
        """Deliver a recorded datagram again."""
        self.counters["replayed"] += 1
        self._throw(datagram, sender, to, 0.0)

    def _throw(self, datagram: bytes, sender: Address, to: Address, delay: float) -> None:
        def arrive() -> None:
            self.flying -= 1
            port = self.ports.get(to)
            self.counters["unreachable" if port is None else "delivered"] += 1
            if port is not None:
                port.deliver(datagram, sender)

        self.flying += 1
        self.time.at(self.time.now + delay, arrive)


class VirtualPort:
    """Socket of a virtual network, with the interface of ``taciturn_udp.endpoint.Endpoint``."""

    def __init__(self, network: VirtualNetwork, address: Address) -> None:
        """Listen, without datagrams."""
        self._network, self._address = network, address
        self.sent, self.received = 0, 0
        self.senders: list[Address] = []
        self._queue: list[tuple[bytes, Address]] = []
        self.arrived: Callable[[], None] | None = None  # called after each datagram
        network.ports[address] = self

    @property
    def time(self) -> VirtualTime:
        """The virtual time of the network to which the socket belongs."""
        return self._network.time

    @property
    def address(self) -> Address:
        """The address at which the socket receives."""
        return self._address

    @property
    def counted(self) -> dict[str, int | None]:
        """Numbers of datagrams that the socket has sent and received."""
        return {"sent": self.sent, "unsent": 0, "received": self.received, "dropped_by_kernel": 0}

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram over the virtual network."""
        self.sent += 1
        self._network.send(datagram, self._address, to)

    def deliver(self, datagram: bytes, sender: Address) -> None:
        """Store a datagram until the process reads it."""
        self._queue.append((datagram, sender))
        if self.arrived is not None:
            self.arrived()

    def receive(self, until: float | None = None) -> list[bytes]:
        """Return the datagrams that have arrived; in virtual time, this method never waits."""
        found, self._queue = self._queue, []
        self.senders = [sender for _, sender in found]
        self.received += len(found)
        return [datagram for datagram, _ in found]

    def close(self) -> None:
        """Close the socket, and discard the datagrams that were not read."""
        self._network.counters["discarded"] += len(self._queue)
        self._network.counters["delivered"] -= len(self._queue)
        self._queue = []
        del self._network.ports[self._address]


class VirtualProcess:
    """A process on a virtual machine; it runs a server, and can be suspended or killed."""

    def __init__(
        self, port: VirtualPort, clock: VirtualClock, turns: Turns, before: Callable[[], None] | None = None
    ) -> None:
        """Wait for datagrams, or for the time that the server asks for."""
        self.port, self._clock, self._turns, self._before = port, clock, turns, before
        self.ended, self.paused, self._wakes = False, False, 0
        port.arrived = self._go_on
        self._sleep(lambda: next(turns))

    def pause(self) -> None:
        """Suspend the process; datagrams that arrive meanwhile wait in its socket."""
        self.paused = True

    def resume(self) -> None:
        """Continue the process."""
        self.paused = False
        self._go_on()

    def kill(self) -> None:
        """End the process at once."""
        if not self.ended:
            self.ended = True
            self._turns.close()
            self.port.close()

    def _go_on(self) -> None:
        if self.paused or self.ended:
            return
        if self._before is not None:
            self._before()
        found = self.port.receive()
        self._sleep(lambda: self._turns.send(found))

    def _sleep(self, turn: Callable[[], float]) -> None:
        """Let the server run, and wake it at the time that it asks for unless a datagram wakes it before."""
        try:
            until = turn()
        except StopIteration:
            self.kill()
            return
        self._wakes += 1
        wakes = self._wakes

        def wake() -> None:
            if wakes == self._wakes:
                self._go_on()

        self.port.time.at(self._clock.when(until) + SOON, wake)
