"""Random delays of packets on emulated links in virtual time, and the stamp by which a link states them.

A link counts the delay of a packet in pieces of a period, as the simulation does (``taciturn.program.late``), and draws
it by the law of the network from a number that depends only on the seed and the packet. It forwards the packet before
the mark of the step in which it arrives, behind a stamp of 8 bytes with the delay: the receiver learns by it in which
step, and in which piece of it, the packet arrives. In real time a receiver has a clock, and expects no stamp.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Self, cast

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, number_of
from taciturn.model.delay import SUMS
from taciturn.model.network import Network
from taciturn.program.late import codes_of, is_clocked, pieces_of_links

MOST = 20_000  # packets of a trace, which a process is given as an argument
_STAMP = struct.Struct("!4sI")
_MARK = b"late"
STAMP_SIZE = _STAMP.size
_KEYS = ("delays", "odds", "pieces", "sequence", "block")


@dataclass(frozen=True, repr=False)
class Lateness(Displayed):
    """The law of the delays on a link, in pieces of a period."""

    delays: tuple[int, ...]  # the possible delays, increasing
    odds: tuple[tuple[float, ...], ...]  # their probabilities in each state of the link; the rest is lost
    pieces: int = 1  # of a period
    sequence: tuple[int, ...] = ()  # of a trace: the delay of each packet as an index; their number if it is lost
    block: float = 1.0  # mean number of packets of a trace that are replayed in turn

    @classmethod
    def of(cls, network: Network, link: str, period: float) -> Self | None:
        """Return the law of a link of a network, or None if it delays no packet at random."""
        law = network.random_delay(link, period)
        if law is None:
            return None
        if len(law.sequence) > MOST:
            raise ProblemError(
                f"{network.key(link, 'delay')} is a trace of {number_of(len(law.sequence), 'packet')}, but running "
                f"links replay at most {MOST}; expected a shorter trace, or a histogram"
            )
        cuts, pieces = network.cuts(period) or (0.0,), pieces_of_links(network, period)[link]
        codes = [int(code) * pieces // len(cuts) for code in codes_of(law, cuts, is_clocked(network, link))]
        return cls(tuple(codes), law.odds, pieces, law.sequence, law.block)

    def text(self) -> str:
        """Write the law as text, which ``read_lateness`` reads."""
        return json.dumps({key: getattr(self, key) for key in _KEYS})

    def drawn(self, chance: float, state: int) -> int | None:
        """Return the delay that a random number in [0, 1) selects in a state of the link; None if it is lost."""
        row = self.odds[state if len(self.odds) > 1 else 0]
        found = next((i for i, total in enumerate(accumulate(row)) if chance < total), len(row))
        if found == len(row) and sum(row) >= 1.0 - SUMS:  # the sum is rounded
            found -= 1
        return self.delays[found] if found < len(row) else None

    def replayed(self, step: int, uniform: Callable[[int], float]) -> int | None:
        """Return the delay in a step, from a trace of which random pieces are replayed, with a random number by index.

        A piece begins in step 0, and in each further step with probability 1 / ``block``.
        """
        begun = next((k for k in range(step, 0, -1) if uniform(2 * k) * self.block < 1.0), 0)
        place = int(len(self.sequence) * uniform(2 * begun + 1)) + step - begun
        found = self.sequence[place % len(self.sequence)]
        return self.delays[found] if found < len(self.delays) else None


def read_lateness(name: str, text: str | None) -> Lateness | None:
    """Return the law of delays that a text states; None if there is no text."""
    if text is None:
        return None
    try:
        found = cast("Mapping[str, Any]", json.loads(text))
        law = Lateness(
            tuple(map(int, found["delays"])), tuple(tuple(map(float, row)) for row in found["odds"]),
            int(found.get("pieces", 1)), tuple(map(int, found.get("sequence", ()))), float(found.get("block", 1.0)),
        )  # fmt: skip
        valid = set(found) <= set(_KEYS) and law.pieces >= 1 and min(law.delays) >= 0 and law.block >= 1.0
        valid = valid and all(len(row) == len(law.delays) and min(row) >= 0.0 for row in law.odds)
        valid = valid and len(law.odds) > 0 and all(0 <= one <= len(law.delays) for one in law.sequence)
    except (ValueError, TypeError, KeyError, AttributeError):
        valid, law = False, None
    if not valid or law is None:
        raise ProblemError(
            f'{name} is {text!r}; expected a law such as {{"delays": [0, 1, 2], "odds": [[0.7, 0.2, 0.1]]}}'
        )
    return law


def stamped(datagram: bytes, late: int) -> bytes:
    """Return a datagram behind the stamp with its delay in pieces of a period."""
    return _STAMP.pack(_MARK, late) + datagram


def unstamped(datagram: bytes) -> tuple[bytes, int]:
    """Return a datagram without the stamp, and the delay; 0 if there is no stamp."""
    # the byte behind the mark is the version in the header of a packet, and 0 in a stamp
    if len(datagram) < STAMP_SIZE or not datagram.startswith(_MARK) or datagram[len(_MARK)]:
        return datagram, 0
    return datagram[STAMP_SIZE:], _STAMP.unpack_from(datagram)[1]
