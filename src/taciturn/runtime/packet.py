"""Packets as bytes: encoding, checking and decoding; ``taciturn.model.wire`` contains a table of the layout.

A datagram that is not a valid packet is rejected with a one-word reason, and has no other effect.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import os
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
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
from taciturn.runtime.udp import is_loopback

Refusal: TypeAlias = Literal["malformed", "corrupted", "foreign", "forged"]
REFUSALS: tuple[Refusal, ...] = ("malformed", "corrupted", "foreign", "forged")
KEY, LEAST_KEY, MOST_KEY = "TACITURN_KEY", 16, 32  # environment variable; shortest and longest BLAKE2s key in bytes
_HEADER = struct.Struct(HEADER_FORMAT)
_CRC = struct.Struct("!I")
_ENCODINGS = tuple(CODES)
_KIND_CODES = {kind: code for code, kind in enumerate(KINDS)}
_LINK_CODES = {link: code for code, link in enumerate(LINKS)}


class Packet(NamedTuple):
    """A packet between nodes, or between a node and the plant.

    Args:
        kind: ``"data"``, ``"acknowledgement"``, ``"mark"`` (its sender has finished the step), or, between plant and
            nodes, ``"measurement"`` or ``"input"``.
        link: ``"sensor"``, ``"actuator"`` or ``"plant"``.
        tick: number of the step that the packet belongs to.
        sequence: sequence number among the packets of this kind on this link.
        values: payload, as the receiver decodes it.
        epoch: number that increases when a node starts without its state.
        loop: number of the loop.
    """

    kind: PacketKind
    link: str
    tick: int
    sequence: int
    values: tuple[float, ...] = ()
    epoch: int = 0
    loop: int = 0


class Wire:
    """An encoder and decoder of the packets of one policy.

    Args:
        policy: policy whose nodes exchange the packets.
        network: network, which defines the rounding of payloads; default: the network of the design.
        key: shared secret of 16 to 32 bytes; default: packets are not authenticated.
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
        key: bytes | None = None,
        entries: Mapping[tuple[PacketKind, str], int] | None = None,
    ) -> None:
        """Determine the payload format of each kind of packet on each link."""
        network = policy.network if network is None else network
        if key is not None and not LEAST_KEY <= len(key) <= MOST_KEY:
            raise ProblemError(
                f"the key has {len(key)} bytes; expected {LEAST_KEY} to {MOST_KEY}: use `openssl rand -hex 32`"
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
            ProblemError: the policy has no packets of this kind and link, or a value of the packet is not finite.
        """
        kind, link = _KIND_CODES[packet.kind], _LINK_CODES[packet.link]
        shape = self._shapes.get((kind, link))
        if shape is None or len(packet.values) != shape.entries or not all(map(math.isfinite, packet.values)):
            raise ProblemError(
                f"a packet of kind {packet.kind} on the {packet.link} link contains {packet.values}; expected "
                f"{'a kind and a link that the policy uses' if shape is None else f'{shape.entries} finite numbers'}"
            )
        return self._write(packet, shape.code, shape.entries, shape.write(packet.values))

    @property
    def keyed(self) -> bool:
        """True if packets are authenticated."""
        return self._key is not None

    def decode(self, datagram: bytes) -> Packet | str:
        """Return the packet in a datagram, or the reason why the datagram is rejected.

        ``"malformed"``: the length or a field is invalid. ``"corrupted"``: the CRC is wrong. ``"foreign"``: the version
        or the policy differs, or only one of sender and receiver uses a key. ``"forged"``: the tag is wrong.
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
        """Return the datagram of a payload: header, payload, CRC and, with a key, the tag."""
        flag = 0 if self._key is None else AUTHENTICATED
        datagram = _HEADER.pack(
            packet.sequence, VERSION, _KIND_CODES[packet.kind], _LINK_CODES[packet.link], code | flag, packet.loop,
            entries, 0, packet.epoch, packet.tick, self.fingerprint,
        ) + payload  # fmt: skip
        datagram += _CRC.pack(zlib.crc32(datagram))
        return datagram if self._key is None else datagram + self._tag(datagram)

    def _open(self, datagram: bytes) -> tuple[Packet, tuple[int, int], bytes] | Refusal:
        """Return a packet without values, the encoding and number of entries of its payload, and the payload."""
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
    """The format of the payload of a packet."""

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


def read_key(path: str | Path | None = None, hosts: Iterable[str] = ()) -> bytes | None:
    """Return the shared secret from a file or from the environment variable ``TACITURN_KEY``, or None if it is not set.

    Args:
        path: file that contains the secret as hexadecimal digits; default: the environment variable is read.
        hosts: addresses of this process and of its peers; an empty environment variable is accepted on the loopback
            only.

    Raises:
        ProblemError: the file cannot be read, or other users can read it (POSIX); the secret is not a valid number of
            hexadecimal digits; the environment variable is empty, and a host is not the loopback.
    """
    if path is None:
        text, source = os.environ.get(KEY, ""), f"the environment variable {KEY}"
        other = next((host for host in hosts if not is_loopback(host)), None)
        if not text and KEY in os.environ and other is not None:
            raise ProblemError(
                f"{source} is empty, so packets from and to {other} would not be authenticated; expected "
                f"{2 * LEAST_KEY} to {2 * MOST_KEY} hexadecimal digits: use `openssl rand -hex 32`, or unset the "
                "variable to run without a key"
            )
        if not text:
            return None
    else:
        source = f"the key file {path}"
        try:
            text = Path(path).read_text(encoding="ascii")
            mode = Path(path).stat().st_mode & 0o777
        except (OSError, UnicodeDecodeError) as error:
            raise ProblemError(f"{source} cannot be read ({error}); expected hexadecimal digits") from None
        if os.name == "posix" and mode & 0o077:
            raise ProblemError(
                f"{source} has the mode {mode:04o}, with which other users can read it; expected 0600: use "
                f"`chmod 600 {path}`, and a new key if another user may have read this one"
            )
    try:
        key = bytes.fromhex(text.strip())
    except ValueError:
        raise ProblemError(
            f"{source} contains other characters than hexadecimal digits; expected {2 * LEAST_KEY} to "
            f"{2 * MOST_KEY} digits"
        ) from None
    if not LEAST_KEY <= len(key) <= MOST_KEY:
        raise ProblemError(
            f"{source} holds {len(key)} bytes; expected {LEAST_KEY} to {MOST_KEY}: use `openssl rand -hex 32`"
        )
    return key
