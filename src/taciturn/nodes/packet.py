"""Packets as bytes: encoding, checking and decoding. ``taciturn.model.wire`` contains a table of the layout.

    datagram = header | payload | CRC | tag, with a key

The payload has the encoding of its link: numbers, or multiples of a resolution. The tag is a keyed digest (BLAKE2s) of
all that stands before it. A datagram that is not a valid packet is rejected with a one-word reason, and has no other
effect: its length, version, CRC and tag are checked before a field is used, and its numbers before they are returned.
In a measurement of the plant, NaN is a missing output; every other number of a packet is finite.
"""

from __future__ import annotations

import copy
import hashlib
import hmac
import struct
import zlib
from collections.abc import Mapping, Sequence
from math import isnan
from typing import Literal, NamedTuple, Self, TypeAlias

from taciturn.errors import ProblemError
from taciturn.model.coverage import INTERVALS, LATE, NETWORKS, Coverage
from taciturn.model.network import Network
from taciturn.model.packets import carries_samples, fingerprint, packet_shapes, plant_links, wire_links
from taciturn.model.policy import Policy
from taciturn.model.wire import (
    ANY_LINK,
    ANY_POLICY,
    AUTHENTICATED,
    BACK,
    BYTES,
    CODES,
    CRC_SIZE,
    EITHER,
    FULL_SCALE,
    HEADER_FORMAT,
    HEADER_SIZE,
    KINDS,
    LARGEST,
    PERSON,
    PROOFS,
    SETPOINT,
    TAG_SIZE,
    VERSION,
    Encoding,
    PacketKind,
    fits,
)
from taciturn.nodes.keys import Keys

PacketDefect: TypeAlias = Literal["malformed", "corrupted", "foreign", "forged"]
WIRED = Coverage(NETWORKS | INTERVALS | LATE, "packets over UDP do not carry out")
REFUSALS: tuple[PacketDefect, ...] = ("malformed", "corrupted", "foreign", "forged")
_HEADER = struct.Struct(HEADER_FORMAT)
_CRC = struct.Struct("!I")
_NONCE = struct.Struct("!Q")
_ENCODINGS = tuple(CODES)
_DIRECTIONS = tuple((0, 1) if kind in EITHER else (int(kind in BACK),) for kind in KINDS)
_KIND_CODES = {kind: code for code, kind in enumerate(KINDS)}


class Packet(NamedTuple):
    """A packet from one node to another, or between a node and the plant.

    Args:
        kind: ``"data"``, ``"acknowledgement"``, ``"mark"`` (its sender has finished the step), ``"challenge"`` or
            ``"answer"`` (proof that its sender is running); between plant and nodes, ``"measurement"`` or ``"input"``;
            between an operator and the controller, ``"setpoint"``, ``"report"``, ``"manual"`` or
            ``"mode"``.
        link: name of the link, or ``"plant"`` (``"plant/NODE"`` if several nodes measure or apply inputs).
        tick: number of the step that the packet belongs to.
        sequence: sequence number among the packets of this kind on this link.
        values: payload, as the receiver decodes it; NaN in place of an output that is missing in a measurement.
        epoch: number that increases when a node starts without its state.
        loop: number of the loop.
        back: whether a mark, a challenge or an answer travels against the link; other kinds have one direction.
        nonce: random number of a challenge, which its answer repeats.
        late: of a packet on a link that delays packets at random: its delay in pieces of a period, which the link or
            the receiver states; no part of the datagram.
    """

    kind: PacketKind
    link: str
    tick: int
    sequence: int
    values: tuple[float, ...] = ()
    epoch: int = 0
    loop: int = 0
    back: bool = False
    nonce: int = 0
    late: int = 0


class Frames:
    """Encodes and decodes the datagrams of a policy that is known by its fingerprint, its links by their numbers, and
    its packets: encoding and number of entries, by kind and link. Without keys, packets are not authenticated.
    """

    def __init__(
        self,
        fingerprint: int,
        links: Mapping[int, str],
        shapes: Mapping[tuple[PacketKind, str], tuple[Encoding, int]],
        keys: Keys | None,
    ) -> None:
        """Determine the payload format of each kind of packet on each link."""
        self.fingerprint, self._names, self.keys = fingerprint, dict(links), keys
        self._codes = {link: code for code, link in links.items()}
        self._shapes = {
            (_KIND_CODES[kind], self._codes[link]): _Shape(*shape) for (kind, link), shape in shapes.items()
        }
        self._used = {link for _, link in shapes}

    def encode(self, packet: Packet) -> bytes:
        """Encode a packet as a datagram.

        Raises:
            ProblemError: the policy has no packets of this kind and link, or a value is not finite or beyond 3.4e38.
        """
        if packet.kind in PROOFS:
            return self._write(packet, BYTES, 0, _NONCE.pack(packet.nonce))
        kind, link = _KIND_CODES[packet.kind], self._codes[packet.link]
        shape = self._shapes.get((kind, link))
        if shape is None or len(packet.values) != shape.entries or not _carries(packet, packet.values):
            expected = "a kind and a link that the policy uses"
            if shape is not None:
                expected = f"{shape.entries} finite numbers, none beyond {LARGEST:.2g}"
            raise ProblemError(
                f"a packet of kind {packet.kind} on the {packet.link} link contains the numbers {packet.values}; "
                f"expected {expected}"
            )
        return self._write(packet, shape.code, shape.entries, shape.write(packet.values))

    def entries(self, kind: PacketKind, link: str) -> int:
        """Return the number of entries in the packets of a kind on a link; 0 if there are none."""
        shape = self._shapes.get((_KIND_CODES[kind], self._codes[link]))
        return 0 if shape is None else shape.entries

    def with_keys(self, keys: Keys | None) -> Self:
        """Return an encoder of the same packets that authenticates them with other keys."""
        other = copy.copy(self)
        other.keys = keys
        return other

    @property
    def keyed(self) -> bool:
        """True if keys authenticate the packets."""
        return self.keys is not None

    def decode(self, datagram: bytes) -> Packet | str:
        """Decode a datagram. Return its packet, or the reason why it is rejected.

        ``"malformed"``: the length or a field is invalid, or a number is not finite or beyond 3.4e38. ``"corrupted"``:
        the CRC is wrong. ``"foreign"``: the version or the policy differs, or only one of sender and receiver uses a
        key. ``"forged"``: the tag is wrong.
        """
        found = self._open(datagram)
        if isinstance(found, str):
            return found
        packet, coding, payload = found
        if packet.kind in PROOFS:
            valid = coding == (BYTES, 0) and len(payload) == _NONCE.size and packet.link in self._used
            return packet._replace(nonce=_NONCE.unpack(payload)[0]) if valid else "malformed"
        shape = self._shapes.get((_KIND_CODES[packet.kind], self._codes[packet.link]))
        if shape is None or coding != (shape.code, shape.entries) or len(payload) != shape.size:
            return "malformed"
        values = shape.read(payload)
        return packet._replace(values=values) if _carries(packet, values) else "malformed"

    def _write(self, packet: Packet, code: int, entries: int, payload: bytes) -> bytes:
        """Return the datagram of a payload: header, payload, CRC and, with a key, the tag."""
        flag = 0 if self.keys is None else AUTHENTICATED
        datagram = _HEADER.pack(
            packet.sequence, VERSION, _KIND_CODES[packet.kind], self._codes[packet.link], code | flag, packet.loop,
            entries, packet.back or packet.kind in BACK, packet.epoch, packet.tick, self.fingerprint,
        ) + payload  # fmt: skip
        datagram += _CRC.pack(zlib.crc32(datagram))
        return datagram if self.keys is None else datagram + _tag(datagram, self.keys.of(packet.link)[0])

    def _open(self, datagram: bytes) -> tuple[Packet, tuple[int, int], bytes] | PacketDefect:
        """Return a packet without values, the encoding and number of entries of its payload, and the payload."""
        tag = 0 if self.keys is None else TAG_SIZE
        end = len(datagram) - CRC_SIZE - tag
        if end < HEADER_SIZE:
            return "malformed"
        sequence, version, kind, link, coded, loop, entries, back, epoch, tick, policy = _HEADER.unpack_from(datagram)
        if version != VERSION or (coded & AUTHENTICATED != 0) != (self.keys is not None):
            return "foreign"
        if zlib.crc32(datagram[:end]) != _CRC.unpack_from(datagram, end)[0]:
            return "corrupted"
        asks = (policy, link, kind, back) == (ANY_POLICY, ANY_LINK, _KIND_CODES["challenge"], 0)
        asks = asks and SETPOINT in self._codes  # an operator, who does not know the policy
        if policy != self.fingerprint and not asks:
            return "foreign"
        known = SETPOINT if asks else self._names.get(link)
        if self.keys is not None and not _is_signed(datagram, self.keys.of(known) if known else ()):
            return "forged"
        if kind >= len(KINDS) or known is None or back not in _DIRECTIONS[kind]:
            return "malformed"
        packet = Packet(KINDS[kind], known, tick, sequence, (), epoch, loop, KINDS[kind] in EITHER and back > 0)
        return packet, (coded & ~AUTHENTICATED, entries), datagram[HEADER_SIZE:end]


def _carries(packet: Packet, values: Sequence[float]) -> bool:
    """Return whether a packet may contain these numbers."""
    return fits([one for one in values if not isnan(one)] if carries_samples(packet.kind, packet.link) else values)


class Wire(Frames):
    """Encodes and decodes the packets of one policy.

    Args:
        policy: policy whose nodes exchange the packets.
        network: network, which defines the rounding of payloads; default: the network of the design.
        key: shared secret of 16 to 32 bytes, or the keys of each link; default: packets are not authenticated.
        entries: number of entries of further kinds of packets, by kind and link; they replace those of the policy.

    Raises:
        ProblemError: the key is too short or too long, or the range of a rounded payload is missing.

    Example:
        >>> from taciturn import load
        >>> wire = Wire(load("two-mass-lqg").design())
        >>> datagram = wire.encode(Packet("data", "actuator", tick=7, sequence=3, values=(0.25,)))
        >>> len(datagram), wire.decode(datagram).values
        (44, (0.25,))
        >>> wire.decode(datagram[:-1])
        'corrupted'
    """

    def __init__(
        self,
        policy: Policy,
        network: Network | None = None,
        key: bytes | Keys | None = None,
        entries: Mapping[tuple[PacketKind, str], int] | None = None,
    ) -> None:
        """Determine the payload format of each kind of packet on each link."""
        network = policy.network if network is None else network
        WIRED.check(network)
        self.links: tuple[str, ...] = wire_links(policy)
        self.plant = plant_links(policy)
        self.physical = frozenset(self.plant) - {SETPOINT}  # without the set-points, which nodes take in by themselves
        keys = Keys.same(key) if isinstance(key, bytes) else key
        if keys is not None:
            keys.expect(self.links)
        others = {key: (Encoding(), number) for key, number in (entries or {}).items()}
        shapes = packet_shapes(policy, network) | others
        super().__init__(fingerprint(policy, network), dict(enumerate(self.links)), shapes, keys)


def _is_signed(datagram: bytes, keys: Sequence[bytes]) -> bool:
    """Return whether the tag of a datagram is that of one of the keys."""
    content, tag = datagram[:-TAG_SIZE], datagram[-TAG_SIZE:]
    return any(hmac.compare_digest(tag, _tag(content, key)) for key in keys)


def _tag(content: bytes, key: bytes) -> bytes:
    """Return the tag of a datagram."""
    return hashlib.blake2s(content, digest_size=TAG_SIZE, key=key, person=PERSON).digest()


class _Shape:
    """The format of the payload of a packet."""

    def __init__(self, encoding: Encoding, entries: int) -> None:
        self.entries, self.code = entries, _ENCODINGS.index(encoding.name)
        self._layout = struct.Struct(f"!{entries}{CODES[encoding.name]}")
        self.size = self._layout.size
        self._steps = tuple(scale / FULL_SCALE for scale in encoding.full_scale)
        self._factors = tuple(FULL_SCALE / scale for scale in encoding.full_scale)

    def write(self, values: Sequence[float]) -> bytes:
        if not self._steps:
            return self._layout.pack(*values)
        steps = (round(max(-FULL_SCALE, min(FULL_SCALE, v * f))) for v, f in zip(values, self._factors, strict=True))
        return self._layout.pack(*steps)

    def read(self, payload: bytes) -> tuple[float, ...]:
        found = self._layout.unpack(payload)
        return tuple(v * s for v, s in zip(found, self._steps, strict=True)) if self._steps else found
