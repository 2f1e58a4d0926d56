"""Packets between controller, camera and robot: requests for pictures, pictures, and poses to be rendered.

A request is a packet of the sensor link without payload. The picture that answers the request is a packet of the same
link, with a JPEG instead of numbers and with the sequence number, step and loop of the request. Links therefore drop
and count pictures like any packet of the sensor link. For the controller, a picture is a measurement in another
encoding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

from taciturn.model.network import Network
from taciturn.model.policy import Policy
from taciturn.model.wire import BYTES
from taciturn.nodes.keys import Keys
from taciturn.nodes.packet import Packet, Wire

UNSEEN = "unseen"  # reason for the rejection of a picture without a marker
Seen: TypeAlias = Callable[[Packet, bytes, Sequence[float] | None], None]


class QuestionWire(Wire):
    """Encoder of the controller's requests for pictures, and decoder of the time steps that it receives.

    Args:
        policy: policy with a camera as sensor.
        network: network; default: that of the design.
        key: shared secret; default: packets without authentication.
    """

    def __init__(self, policy: Policy, network: Network | None = None, key: bytes | Keys | None = None) -> None:
        """Define packets without payload on the sensor link."""
        super().__init__(policy, network, key, {("data", "sensor"): 0})

    def encode(self, packet: Packet) -> bytes:
        """Encode a packet as a datagram; a picture request omits the measurement."""
        asks = packet.kind == "data" and packet.link == "sensor"
        return super().encode(packet._replace(values=()) if asks else packet)


class CameraWire(Wire):
    """Decoder of the requests and poses that the camera receives, and encoder of its pictures.

    Args:
        policy: policy with a camera as sensor.
        light: number of coordinates that determine a picture.
        network: network; default: that of the design.
        key: shared secret; default: packets without authentication.
    """

    def __init__(
        self, policy: Policy, light: int, network: Network | None = None, key: bytes | Keys | None = None
    ) -> None:
        """Define requests without payload, and poses on the plant link."""
        super().__init__(policy, network, key, {("data", "sensor"): 0, ("measurement", "plant"): light})

    def encode_picture(self, question: Packet, picture: bytes) -> bytes:
        """Encode a picture that answers a request, as a datagram."""
        return self._write(question, BYTES, 0, picture)


class PictureWire(Wire):
    """Decoder that converts each picture that the controller receives to a measurement.

    Args:
        policy: policy with a camera as sensor.
        see: function that returns the measurement y, (p,), of a picture, or None.
        network: network; default: that of the design.
        key: shared secret; default: packets without authentication.
        told: function called with the packet, the picture and the measurement.
    """

    def __init__(
        self,
        policy: Policy,
        see: Callable[[bytes], Sequence[float] | None],
        network: Network | None = None,
        key: bytes | Keys | None = None,
        told: Seen | None = None,
    ) -> None:
        """Start without pictures."""
        super().__init__(policy, network, key)
        self._see, self._told, self._outputs = see, told, policy.model.outputs

    def decode(self, datagram: bytes) -> Packet | str:
        """Decode a datagram to a packet or, if it is rejected, to the reason, such as ``"unseen"`` without a marker."""
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
