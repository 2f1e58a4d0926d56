"""Server of the simulated camera: it receives requests and the poses of robots, and sends pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from taciturn.nodes.inbox import Window
from taciturn.nodes.packet import Packet
from taciturn_twins.camera import Camera
from taciturn_twins.faults import Fault
from taciturn_twins.wire import CameraWire
from taciturn_udp.endpoint import Address, Endpoint
from taciturn_udp.relay import of_loop
from taciturn_udp.service import take_until

KEPT = 8  # number of steps whose poses are stored, as a request may arrive when the plant is ahead
PASSED = ("mark", "answer")  # kinds of packets that the camera passes on, behind the earlier requests
PATIENT = 256  # largest number of requests and marks of a loop that wait for their poses


class CameraServer:
    """A server that renders and sends a picture for each request.

    Args:
        camera: camera that takes the pictures.
        wire: decoder of requests and poses, and encoder of pictures.
        endpoint: socket that receives requests and poses.
        peer: address to which the pictures are sent.
        tick: sampling period in seconds, which converts the times of faults to steps.
        loops: number of robots that share the camera process.
        faults: faults to apply; faults that do not affect the camera are ignored.
    """

    def __init__(
        self,
        camera: Camera,
        wire: CameraWire,
        endpoint: Endpoint,
        peer: Address,
        *,
        tick: float,
        loops: int = 1,
        faults: Sequence[Fault] = (),
    ) -> None:
        """Start without requests."""
        self.camera, self.wire, self.endpoint, self.peer = camera, wire, endpoint, peer
        self._faults = [(fault.name, fault.ticks(tick), fault.size) for fault in faults]
        self._light: list[dict[int, Packet]] = [{} for _ in range(loops)]  # newest pose of each step
        self._waiting: list[list[Packet]] = [[] for _ in range(loops)]
        self._asked = [Window() for _ in range(loops)]
        self._clients: dict[int, Address] = {}  # address of the last request, by loop
        self.counters: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()

    def run(self, stopped: Callable[[], bool]) -> dict[str, Any]:
        """Answer all requests that were sent before the stop, and return the report."""
        take_until(self.endpoint, self._take, stopped)
        return self.report()

    def report(self) -> dict[str, Any]:
        """Return the counters so far."""
        return {
            "role": "camera",
            "counters": dict(self.counters),
            "refused": dict(self.refused),
            "waiting": sum(map(len, self._waiting)),
            "datagrams": self.endpoint.counted,
        }

    def _take(self, datagrams: Sequence[bytes]) -> None:
        for datagram, sender in zip(datagrams, self.endpoint.senders, strict=True):
            packet = self.wire.decode(datagram)
            if isinstance(packet, str):
                self.refused[packet] += 1
            elif packet.loop >= len(self._light):
                self.refused["misdirected"] += 1
            elif packet.kind == "challenge":
                self._pass_on(packet)
            else:
                if packet.kind != "measurement":
                    self._clients[packet.loop] = sender
                self._sort(packet)
                self._go_on(packet.loop)

    def _pass_on(self, challenge: Packet) -> None:
        """Send a challenge to the sender of the requests, whose epoch and sequence numbers the pictures carry."""
        client = self._clients.get(challenge.loop)
        if client is None or challenge.link != "sensor":
            self.refused["misplaced"] += 1
        else:
            self.endpoint.send(self.wire.encode(challenge), client)

    def _sort(self, packet: Packet) -> None:
        light, waiting = self._light[packet.loop], self._waiting[packet.loop]
        if packet.kind == "measurement":
            self.counters["light"] += 1
            known = light.get(packet.tick)
            if known is None or (packet.epoch, packet.sequence) > (known.epoch, known.sequence):
                light[packet.tick] = packet
            while len(light) > KEPT:
                del light[min(light)]
        elif packet.link != "sensor" or packet.kind not in ("data", *PASSED) or len(waiting) >= PATIENT:
            self.refused["misplaced"] += 1
        else:
            waiting.append(packet)

    def _go_on(self, loop: int) -> None:
        """Answer requests in order if their poses have arrived; pass on a mark when earlier requests are answered."""
        light, waiting = self._light[loop], self._waiting[loop]
        while waiting and (waiting[0].kind in PASSED or (light and waiting[0].tick <= max(light))):
            packet = waiting.pop(0)
            if packet.kind in PASSED:
                self.counters[f"{packet.kind}s"] += 1
                self.endpoint.send(self.wire.encode(packet), self.peer)
            else:
                self._answer(packet, light[min(light, key=lambda tick: abs(tick - packet.tick))])

    def _answer(self, question: Packet, light: Packet) -> None:
        news = self._asked[question.loop].admit(question.epoch, question.sequence)
        self.counters["questions" if news == "new" else "questions again"] += 1
        faults = {name: size for name, (first, end), size in self._faults if first <= question.tick < end}
        if "camera" in faults:
            self.counters["unanswered"] += news == "new"
            return
        self.camera.covered = "cover" in faults
        self.camera.lighting = faults.get("light", (1.0,))[0]
        picture = self.camera.take(light.values, of_loop(question.tick, question.loop))
        self.counters["pictures" if news == "new" else "pictures again"] += 1
        self.endpoint.send(self.wire.encode_picture(question, picture), self.peer)
