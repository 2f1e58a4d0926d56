"""What the wire carries between a control unit and its camera: questions, pictures, and the light that falls in.

A question is a packet of the sensor link without its payload, and the picture that answers it is the same packet with a
picture in the place of numbers: sequence, tick and loop are those of the question. So links lose and count pictures as
they do any packet of the sensor link, and to the controller a picture is its measurement, in another encoding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

from taciturn.model.network import Network
from taciturn.model.policy import Policy
from taciturn.model.wire import BYTES
from taciturn.runtime.packet import Packet, Wire

UNSEEN = "unseen"  # the word for a picture in which nothing is found
Seen: TypeAlias = Callable[[Packet, bytes, Sequence[float] | None], None]


class QuestionWire(Wire):
    """Writes the questions of a control unit, and reads its clock.

    Args:
        policy: whose sensor is a camera.
        network: omitted: that of the design.
        key: shared secret; omitted: packets are not authenticated.
    """

    def __init__(self, policy: Policy, network: Network | None = None, key: bytes | None = None) -> None:
        """Let packets of the sensor link be empty."""
        super().__init__(policy, network, key, {("data", "sensor"): 0})

    def encode(self, packet: Packet) -> bytes:
        """Return a packet as a datagram; what is measured is not known yet."""
        asks = packet.kind == "data" and packet.link == "sensor"
        return super().encode(packet._replace(values=()) if asks else packet)


class CameraWire(Wire):
    """Reads questions and light, and writes pictures.

    Args:
        policy: whose sensor is a camera.
        light: numbers that say what can be seen.
        network: omitted: that of the design.
        key: shared secret; omitted: packets are not authenticated.
    """

    def __init__(self, policy: Policy, light: int, network: Network | None = None, key: bytes | None = None) -> None:
        """Let questions be empty, and what the plant says be all that can be seen."""
        super().__init__(policy, network, key, {("data", "sensor"): 0, ("measurement", "plant"): light})

    def encode_picture(self, question: Packet, picture: bytes) -> bytes:
        """Return the answer to a question."""
        return self._write(question, BYTES, 0, picture)


class PictureWire(Wire):
    """Reads pictures as measurements.

    Args:
        policy: whose sensor is a camera.
        see: finds y, (p,), in a picture, or None.
        network: omitted: that of the design.
        key: shared secret; omitted: packets are not authenticated.
        told: called with the packet, the picture and what was seen.
    """

    def __init__(
        self,
        policy: Policy,
        see: Callable[[bytes], Sequence[float] | None],
        network: Network | None = None,
        key: bytes | None = None,
        told: Seen | None = None,
    ) -> None:
        """Nothing has been seen."""
        super().__init__(policy, network, key)
        self._see, self._told, self._outputs = see, told, policy.model.outputs

    def decode(self, datagram: bytes) -> Packet | str:
        """Return the packet of a datagram, or why it is none; ``"unseen"``: a picture in which nothing is found."""
        found = self._open(datagram)
        if isinstance(found, str) or (found[0].kind, found[0].link) != ("data", "sensor"):
            return super().decode(datagram)
        packet, coding, picture = found
        if coding != (BYTES, 0):
            return "malformed"
        values = self._see(picture)
        if self._told is not None:
            self._told(packet, picture, values)
        if values is None or len(values) != self._outputs or not all(map(math.isfinite, values)):
            return UNSEEN
        return packet._replace(values=tuple(values))
