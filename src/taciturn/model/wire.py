"""The wire format: a table of the fields of a datagram, and the quantisation of the numbers in packets."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Literal, NamedTuple

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, choice
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.errors import ProblemError

EncodingName = Literal["float64", "float32", "int16"]
PacketKind = Literal[
    "data",
    "acknowledgement",
    "mark",
    "measurement",
    "input",
    "challenge",
    "answer",
    "setpoint",
    "report",
    "manual",
    "mode",
]
KINDS: tuple[PacketKind, ...] = (
    "data", "acknowledgement", "mark", "measurement", "input", "challenge", "answer", "setpoint", "report", "manual",
    "mode",
)  # fmt: skip
PLANT = "plant"  # the link between the plant and its nodes
# the link on which the controller is given set-points: by a simulated plant as measurements, by an operator as packets
# of the kind "setpoint", which the controller answers with a "report"; an operator sets the mode, automatic or manual,
# and the manual inputs with packets of the kind "manual", and the controller answers with its "mode"
SETPOINT = "setpoint"
# number of the link and fingerprint in the challenge of an operator, who learns them from the answer
ANY_LINK, ANY_POLICY = 255, 0
CODES: dict[EncodingName, str] = {"float64": "d", "float32": "f", "int16": "h"}  # format characters of struct
BYTES = len(CODES)  # encoding of a payload of raw bytes
BACK: frozenset[PacketKind] = frozenset(
    {"acknowledgement", "input", "report", "mode"}
)  # kinds that travel against their link
EITHER: frozenset[PacketKind] = frozenset({"mark", "challenge", "answer"})  # kinds that both ends of a link send
PROOFS: frozenset[PacketKind] = frozenset({"challenge", "answer"})  # kinds whose payload is a nonce
VERSION = 2
AUTHENTICATED = 0x80  # flag in the encoding field for a datagram with a tag
FULL_SCALE = 32767  # integer that represents the full scale
# adding and subtracting these constants rounds to the nearest integer, ties to even
ROUNDERS = {"float64": 1.5 * 2.0**52, "float32": 1.5 * 2.0**23}
CRC_SIZE, TAG_SIZE = 4, 16
LARGEST = (2.0 - 2.0**-23) * 2.0**127  # largest number in a payload, of any encoding: the largest float32
PERSON = b"taciturn"  # BLAKE2s personalisation string of tags and fingerprints


class FieldOfHeader(NamedTuple):
    """One field in the header of a datagram."""

    name: str  # name of the field
    code: str  # format character of ``struct``: B, H, I, Q are unsigned integers of 1, 2, 4, 8 bytes
    meaning: str  # description for developers of other implementations


HEADER = (
    FieldOfHeader("sequence", "I", "counts the packets of this kind on this link, from 0; 4294967295 ends an epoch"),
    FieldOfHeader("version", "B", f"{VERSION}"),
    FieldOfHeader("kind", "B", ", ".join(f"{code}: {name}" for code, name in enumerate(KINDS))),
    FieldOfHeader(
        "link",
        "B",
        "0: sensor, 1: actuator, 2: plant; with other nodes, the place in the list of links; "
        f"{ANY_LINK} in the challenge of an operator",
    ),
    FieldOfHeader(
        "encoding",
        "B",
        "0: float64, 1: float32, 2: int16 of the entries, 3: no entries, but bytes, as a picture or a nonce; "
        "plus 128: the datagram ends with a tag",
    ),
    FieldOfHeader("loop", "H", "which of many loops that one process serves"),
    FieldOfHeader("entries", "B", "numbers in the payload"),
    FieldOfHeader("direction", "B", "0: along the link, 1: against it"),
    FieldOfHeader("epoch", "I", "grows when a node starts without its state; sequences begin anew"),
    FieldOfHeader("tick", "Q", "that the packet belongs to"),
    FieldOfHeader(
        "fingerprint",
        "Q",
        f"of the policy; nodes of another policy are foreign; {ANY_POLICY} in the challenge of an operator",
    ),
)
HEADER_FORMAT = "!" + "".join(entry.code for entry in HEADER)
HEADER_SIZE = struct.calcsize(HEADER_FORMAT)
OFFSETS = {
    entry.name: struct.calcsize("!" + "".join(before.code for before in HEADER[:i])) for i, entry in enumerate(HEADER)
}
"""Position of each field of the header in a datagram."""
_SEEN = ("sequence", "kind", "loop", "tick")  # fields that a link reads when it inspects packets
_PLACE = struct.Struct(
    "!" + "".join(e.code if e.name in _SEEN else f"{struct.calcsize('!' + e.code)}x" for e in HEADER)
)


@dataclass(frozen=True, repr=False)
class Encoding(Displayed):
    """The number format of the entries in a packet's payload."""

    name: EncodingName = "float64"  # ``"float64"``
    full_scale: tuple[float, ...] = ()  # range of each entry; only with ``"int16"``

    def __post_init__(self) -> None:
        """Validate and store the arguments."""
        choice("the encoding", self.name, CODES)
        if (self.name == "int16") != bool(self.full_scale):
            got = "without" if self.name == "int16" else "with"
            raise ProblemError(
                f"the encoding {self.name} is given {got} a range; expected a range for int16, and no range for other "
                "encodings"
            )
        scale = array("the range of an encoding", self.full_scale, (None,))
        if not (scale > 0).all():
            raise ProblemError(f"the range of an encoding is {scale.min():g}; expected positive numbers")
        object.__setattr__(self, "full_scale", tuple(float(value) for value in scale))

    def parts(self, sizes: Sequence[int]) -> list[Encoding]:
        """Split the encoding of a payload into one encoding per signal. A single range applies to all entries."""
        entries = sum(sizes)
        if self.name != "int16":
            return [self] * len(sizes)
        if len(self.full_scale) not in (1, entries):
            raise ProblemError(
                f"the packet has {number_of(entries, 'entry')}, but its range has "
                f"{number_of(len(self.full_scale), 'number')}; expected one number for all entries, or one for each"
            )
        each = self.full_scale * (entries // len(self.full_scale))
        ends = list(accumulate(sizes, initial=0))
        return [Encoding("int16", each[begin:end]) for begin, end in pairwise(ends)]

    def rounded(self, values: ArrayLike) -> Array:
        """Round values as this encoding does: return the values that a receiver decodes."""
        exact = np.asarray(values, dtype=np.float64)
        if self.name == "float32":
            return exact.astype(np.float32).astype(np.float64)
        if self.name == "int16":
            step = np.array(self.full_scale) / FULL_SCALE
            return np.clip(np.rint(exact * (FULL_SCALE / np.array(self.full_scale))), -FULL_SCALE, FULL_SCALE) * step
        return exact


def fits(values: Iterable[float]) -> bool:
    """Return whether a payload can contain all of these numbers: finite ones, of at most ``LARGEST`` in size."""
    return all(-LARGEST <= value <= LARGEST for value in values)


def read_place(datagram: bytes) -> tuple[int, int, int, int]:
    """Read sequence number, kind, loop and step from a datagram with a complete header. Nothing else is checked."""
    return _PLACE.unpack_from(datagram)
