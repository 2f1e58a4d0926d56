"""Packets as bytes: written, checked and read; the layout is the table of ``taciturn.model.wire``.

A datagram that is not a packet of ours is refused with a word that says why, and nothing else happens.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from taciturn.errors import ProblemError
from taciturn.model.network import Network
from taciturn.model.packets import fingerprint, packet_shapes
from taciturn.model.policy import Policy
from taciturn.model.wire import (
    AUTHENTICATED,
    CODES,
    CRC_SIZE,
    HEADER_FORMAT,
    HEADER_SIZE,
    KINDS,
    LARGEST,
    LINKS,
    PERSON,
    TAG_SIZE,
    VERSION,
    Encoding,
    PacketKind,
)

Refusal: TypeAlias = Literal["malformed", "corrupted", "foreign", "forged"]
REFUSALS: tuple[Refusal, ...] = ("malformed", "corrupted", "foreign", "forged")
KEY, LEAST_KEY, MOST_KEY = "TACITURN_KEY", 16, 32  # environment variable; bytes of a key of BLAKE2s
_HEADER = struct.Struct(HEADER_FORMAT)
_CRC = struct.Struct("!I")
_ENCODINGS = tuple(CODES)
_KIND_CODES = {kind: code for code, kind in enumerate(KINDS)}
_LINK_CODES = {link: code for code, link in enumerate(LINKS)}


class Packet(NamedTuple):
    """One packet.

    Args:
        kind: ``"data"``, ``"acknowledgement"``, ``"mark"`` (its sender has finished the tick), or of the plant's own
            wires ``"measurement"`` and ``"input"``.
        link: ``"sensor"``, ``"actuator"`` or ``"plant"``.
        tick: that it belongs to.
        sequence: counts the packets of this kind on this link.
        values: the payload, as the receiver reads it.
        epoch: grows when a node starts without its state.
        loop: which of many loops.
    """

    kind: PacketKind
    link: str
    tick: int
    sequence: int
    values: tuple[float, ...] = ()
    epoch: int = 0
    loop: int = 0


class Wire:
    """Writes and reads the packets of one policy.

    Args:
        policy: whose nodes talk.
        network: how payloads are rounded; omitted: that of the design.
        key: shared secret of 16 to 32 bytes; omitted: packets are not authenticated.
        entries: of the packets that hold another number of entries than the policy says, by kind and link.

    Raises:
        ProblemError: a key that is too short or too long, or payloads without their range.

    Example:
        >>> from taciturn import load
        >>> wire = Wire(load("two-mass").design())
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
        key: bytes | None = None,
        entries: Mapping[tuple[PacketKind, str], int] | None = None,
    ) -> None:
        """Note what a packet of each kind on each link holds."""
        network = policy.network if network is None else network
        if key is not None and not LEAST_KEY <= len(key) <= MOST_KEY:
            raise ProblemError(
                f"the key has {len(key)} bytes; expected {LEAST_KEY} to {MOST_KEY}: as `openssl rand -hex 32` gives"
            )
        self.fingerprint = fingerprint(policy, network)
        self._key = key
        others = {key: (Encoding(), number) for key, number in (entries or {}).items()}
        shapes = packet_shapes(policy, network) | others
        self._shapes = {
            (_KIND_CODES[kind], _LINK_CODES[link]): _Shape(*shape) for (kind, link), shape in shapes.items()
        }

    def encode(self, packet: Packet) -> bytes:
        """Return a packet as a datagram.

        Raises:
            ProblemError: the policy has no such packet, or it holds what is no finite number.
        """
        kind, link = _KIND_CODES[packet.kind], _LINK_CODES[packet.link]
        shape = self._shapes.get((kind, link))
        if shape is None or len(packet.values) != shape.entries or not all(map(math.isfinite, packet.values)):
            raise ProblemError(
                f"a packet of kind {packet.kind} on the {packet.link} link holds {packet.values}; "
                f"expected {'no such packet' if shape is None else f'{shape.entries} finite numbers'}"
            )
        return self._write(packet, shape.code, shape.entries, shape.write(packet.values))

    @property
    def keyed(self) -> bool:
        """Whether packets are authenticated."""
        return self._key is not None

    def decode(self, datagram: bytes) -> Packet | str:
        """Return the packet of a datagram, or why it is none.

        ``"malformed"``: its length or a field is impossible; ``"corrupted"``: its CRC is wrong; ``"foreign"``: it is of
        another version or policy, or not authenticated alike; ``"forged"``: its tag is wrong.
        """
        found = self._open(datagram)
        if isinstance(found, str):
            return found
        packet, coding, payload = found
        shape = self._shapes.get((_KIND_CODES[packet.kind], _LINK_CODES[packet.link]))
        if shape is None or coding != (shape.code, shape.entries) or len(payload) != shape.size:
            return "malformed"
        values = shape.read(payload)
        return packet._replace(values=values) if all(map(math.isfinite, values)) else "malformed"

    def _write(self, packet: Packet, code: int, entries: int, payload: bytes) -> bytes:
        """Return a payload with all that stands around it."""
        flag = 0 if self._key is None else AUTHENTICATED
        datagram = _HEADER.pack(
            packet.sequence, VERSION, _KIND_CODES[packet.kind], _LINK_CODES[packet.link], code | flag, packet.loop,
            entries, 0, packet.epoch, packet.tick, self.fingerprint,
        ) + payload  # fmt: skip
        datagram += _CRC.pack(zlib.crc32(datagram))
        return datagram if self._key is None else datagram + self._tag(datagram)

    def _open(self, datagram: bytes) -> tuple[Packet, tuple[int, int], bytes] | Refusal:
        """Return a packet without its values, how its payload is coded and its entries, and the payload."""
        tag = 0 if self._key is None else TAG_SIZE
        end = len(datagram) - CRC_SIZE - tag
        if end < HEADER_SIZE:
            return "malformed"
        sequence, version, kind, link, coded, loop, entries, zero, epoch, tick, policy = _HEADER.unpack_from(datagram)
        if version != VERSION or (coded & AUTHENTICATED != 0) != (self._key is not None):
            return "foreign"
        if zlib.crc32(datagram[:end]) != _CRC.unpack_from(datagram, end)[0]:
            return "corrupted"
        if policy != self.fingerprint:
            return "foreign"
        if self._key is not None and not hmac.compare_digest(datagram[-TAG_SIZE:], self._tag(datagram[:-TAG_SIZE])):
            return "forged"
        if kind >= len(KINDS) or link >= len(LINKS) or zero:
            return "malformed"
        packet = Packet(KINDS[kind], LINKS[link], tick, sequence, (), epoch, loop)
        return packet, (coded & ~AUTHENTICATED, entries), datagram[HEADER_SIZE:end]

    def _tag(self, content: bytes) -> bytes:
        assert self._key is not None
        return hashlib.blake2s(content, digest_size=TAG_SIZE, key=self._key, person=PERSON).digest()


class _Shape:
    """How the payload of a packet is written."""

    def __init__(self, encoding: Encoding, entries: int) -> None:
        self.entries, self.code = entries, _ENCODINGS.index(encoding.name)
        self._layout = struct.Struct(f"!{entries}{CODES[encoding.name]}")
        self.size = self._layout.size
        self._steps = tuple(scale / LARGEST for scale in encoding.full_scale)
        self._factors = tuple(LARGEST / scale for scale in encoding.full_scale)

    def write(self, values: Sequence[float]) -> bytes:
        if not self._steps:
            return self._layout.pack(*values)
        steps = (round(max(-LARGEST, min(LARGEST, v * f))) for v, f in zip(values, self._factors, strict=True))
        return self._layout.pack(*steps)

    def read(self, payload: bytes) -> tuple[float, ...]:
        found = self._layout.unpack(payload)
        return tuple(v * s for v, s in zip(found, self._steps, strict=True)) if self._steps else found


def read_key(path: str | Path | None = None) -> bytes | None:
    """Return the shared secret: of a file, or of the environment variable ``TACITURN_KEY``; None where there is none.

    Args:
        path: of a file that holds it as hexadecimal digits; omitted: the environment is asked.

    Raises:
        ProblemError: no such file, no hexadecimal digits, too few or too many.
    """
    if path is None:
        text, source = os.environ.get(KEY, ""), f"the environment variable {KEY}"
        if not text:
            return None
    else:
        source = f"the key file {path}"
        try:
            text = Path(path).read_text(encoding="ascii")
        except (OSError, UnicodeDecodeError) as error:
            raise ProblemError(f"{source} cannot be read ({error}); expected hexadecimal digits") from None
    try:
        key = bytes.fromhex(text.strip())
    except ValueError:
        raise ProblemError(
            f"{source} holds no hexadecimal digits; expected {2 * LEAST_KEY} to {2 * MOST_KEY}"
        ) from None
    if not LEAST_KEY <= len(key) <= MOST_KEY:
        raise ProblemError(
            f"{source} holds {len(key)} bytes; expected {LEAST_KEY} to {MOST_KEY}, as `openssl rand -hex 32` gives"
        )
    return key
