"""Servers of nodes and plants in one process, in virtual time: clocks, sockets and a network as a queue of events.

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
    """A queue of events in the order of their times; events at one time happen in the order of their entry."""

    def __init__(self) -> None:
        """Start at time 0 without events."""
        self.now, self._order = 0.0, 0
        self._queue: list[tuple[float, int, Callable[[], None]]] = []

    def at(self, time: float, event: Callable[[], None]) -> None:
        """Enter an event, which happens now if its time is past."""
        heapq.heappush(self._queue, (max(time, self.now), self._order, event))
        self._order += 1

    def run(self, until: float) -> None:
        """Let all events up to a time happen."""
        while self._queue and self._queue[0][0] <= until:
            self.now, _, event = heapq.heappop(self._queue)
            event()
        self.now = until


class VirtualClock:
    """The clock of a machine, which may be fast or slow, and may jump."""

    def __init__(self, time: VirtualTime, rate: float = 1.0) -> None:
        """Start at the virtual time."""
        self._time, self._rate = time, rate
        self._set, self._shown = time.now, time.now

    def __call__(self) -> float:
        """Return the time that the clock shows."""
        return self._shown + (self._time.now - self._set) * self._rate

    def when(self, shown: float) -> float:
        """Return the virtual time at which the clock shows a given time."""
        return self._time.now + max(0.0, shown - self()) / self._rate

    def jump(self, by: float) -> None:
        """Set the clock forward, or back if the number of seconds is negative."""
        self._shown, self._set = self() + by, self._time.now

    def turn(self, rate: float) -> None:
        """Change the speed of the clock."""
        self._shown, self._set, self._rate = self(), self._time.now, rate


class VirtualNetwork:
    """A network that delivers each datagram after a latency, or as ``carry`` says.

    The counter ``sent`` and what was added (``copied``, ``replayed``) equal ``lost``, ``unreachable`` (no process
    runs at the address), ``discarded`` (a process ended before it read them), ``delivered``, and ``flying``.
    """

    def __init__(self, time: VirtualTime, carry: Callable[[Address, Address, bytes], Copies]) -> None:
        """Start without processes."""
        self.time, self._carry = time, carry
        self.ports: dict[Address, VirtualPort] = {}
        self.counters: Counter[str] = Counter()
        self.flying = 0  # datagrams that have not arrived yet

    def send(self, datagram: bytes, sender: Address, to: Address) -> None:
        """Carry a datagram to its receiver."""
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
    """A socket on a virtual network, with the interface of ``taciturn_udp.endpoint.Endpoint``."""

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
        """The virtual time of its network."""
        return self._network.time

    @property
    def address(self) -> Address:
        """The address that it listens on."""
        return self._address

    @property
    def counted(self) -> dict[str, int | None]:
        """The counters of datagrams sent and received."""
        return {"sent": self.sent, "unsent": 0, "received": self.received, "dropped_by_kernel": 0}

    def send(self, datagram: bytes, to: Address) -> None:
        """Give a datagram to the network."""
        self.sent += 1
        self._network.send(datagram, self._address, to)

    def deliver(self, datagram: bytes, sender: Address) -> None:
        """Store a datagram until the process reads it."""
        self._queue.append((datagram, sender))
        if self.arrived is not None:
            self.arrived()

    def receive(self, until: float | None = None) -> list[bytes]:
        """Return the datagrams that have arrived; the caller waits, as the time is virtual."""
        found, self._queue = self._queue, []
        self.senders = [sender for _, sender in found]
        self.received += len(found)
        return [datagram for datagram, _ in found]

    def close(self) -> None:
        """Stop listening; datagrams that were not read are discarded."""
        self._network.counters["discarded"] += len(self._queue)
        self._network.counters["delivered"] -= len(self._queue)
        self._queue = []
        del self._network.ports[self._address]


class VirtualProcess:
    """A process on a machine: it runs a server, may be suspended, and may be killed."""

    def __init__(
        self, port: VirtualPort, clock: VirtualClock, turns: Turns, before: Callable[[], None] | None = None
    ) -> None:
        """Wait for datagrams, or for the time that the server asks for."""
        self.port, self._clock, self._turns, self._before = port, clock, turns, before
        self.ended, self.paused, self._wakes = False, False, 0
        port.arrived = self._go_on
        self._sleep(lambda: next(turns))

    def pause(self) -> None:
        """Suspend the process; the datagrams that arrive wait in its socket."""
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
