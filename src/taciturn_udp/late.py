"""Random delays of packets on links: by emulated links, and as a receiver counts them.

A link draws the delay of a packet by the law of the network from a number that depends only on the seed and the packet.
In virtual time, it counts the delay in pieces of a period, as the simulation does (``taciturn.program.late``), and
forwards the packet before the mark of the step in which it arrives, behind a stamp of 8 bytes with the delay: the
receiver learns by it in which step, and in which piece of it, the packet arrives.

In real time, a link holds the packet for seconds, and the receiver has a clock: ``Counted`` tells the delay that it
measures in pieces of a period. Marks take the least delay, so that the receiver knows when steps begin.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from math import ceil, isfinite
from typing import Any, Self, cast

import numpy as np

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
    """The law of the delays on a link, in pieces of a period; in real time, in seconds."""

    delays: tuple[float, ...]  # the possible delays, increasing
    odds: tuple[tuple[float, ...], ...]  # their probabilities in each state of the link; the rest is lost
    pieces: int = 1  # of a period; 0: delays are in seconds
    sequence: tuple[int, ...] = ()  # of a trace: the delay of each packet as an index; their number if it is lost
    block: float = 1.0  # mean number of packets of a trace that are replayed in turn

    @classmethod
    def of(cls, network: Network, link: str, period: float, tick: float | None = None) -> Self | None:
        """Return the law of a link of a network, or None if it delays no packet at random.

        In real time, ``tick`` is the duration of a period in seconds.
        """
        law = network.random_delay(link, period)
        if law is None:
            return None
        if len(law.sequence) > MOST:
            raise ProblemError(
                f"{network.key(link, 'delay')} is a trace of {number_of(len(law.sequence), 'packet')}, but running "
                f"links replay at most {MOST}; expected a shorter trace, or a histogram"
            )
        if tick is not None:
            return cls(tuple(wait * tick for wait in law.waits), law.odds, 0, law.sequence, law.block)
        cuts, pieces = network.cuts(period) or (0.0,), pieces_of_links(network, period)[link]
        codes = [int(code) * pieces // len(cuts) for code in codes_of(law, cuts, is_clocked(network, link))]
        return cls(tuple(codes), law.odds, pieces, law.sequence, law.block)

    def text(self) -> str:
        """Write the law as text, which ``read_lateness`` reads."""
        return json.dumps({key: getattr(self, key) for key in _KEYS})

    def drawn(self, chance: float, state: int) -> float | None:
        """Return the delay that a random number in [0, 1) selects in a state of the link; None if it is lost."""
        row = self.odds[state if len(self.odds) > 1 else 0]
        found = next((i for i, total in enumerate(accumulate(row)) if chance < total), len(row))
        if found == len(row) and sum(row) >= 1.0 - SUMS:  # the sum is rounded
            found -= 1
        return self.delays[found] if found < len(row) else None

    def replayed(self, step: int, uniform: Callable[[int], float]) -> float | None:
        """Return the delay in a step, from a trace of which random pieces are replayed, with a random number by index.

        A piece begins in step 0, and in each further step with probability 1 / ``block``.
        """
        begun = next((k for k in range(step, 0, -1) if uniform(2 * k) * self.block < 1.0), 0)
        place = int(len(self.sequence) * uniform(2 * begun + 1)) + step - begun
        found = self.sequence[place % len(self.sequence)]
        return self.delays[found] if found < len(self.delays) else None


class Counted:
    """Counts the delays of packets that a node receives in real time, in pieces of a period.

    Each of them is that of the nearest piece, or at a node that works once per step of the nearest delay of the law:
    measured delays are rounded as those of a trace are.
    """

    def __init__(self, network: Network, links: Sequence[str], period: float, tick: float) -> None:
        """Take the laws of the links on which a node receives packets; ``tick`` is the real duration of a period."""
        self._tick, self._cuts = tick, np.array((*(network.cuts(period) or (0.0,)), 1.0))
        self._pieces = pieces_of_links(network, period)
        laws = {link: law for link in links if (law := network.random_delay(link, period)) is not None}
        self._waits = {link: np.array(law.waits) for link, law in laws.items() if is_clocked(network, link)}
        self.links = frozenset(laws)
        least = {link: law.waits[0] if (law := laws.get(link)) else 0.0 for link in links}
        self.least = min(least.values(), default=0.0) * tick  # seconds that every packet takes
        self.spread = max((law.waits[-1] for law in laws.values()), default=0.0) * tick - self.least

    def pieces(self, link: str, delay: float) -> int:
        """Return a delay in seconds as a number of pieces of a period."""
        periods, waits = max(delay, 0.0) / self._tick, self._waits.get(link)
        if waits is not None:
            return ceil(waits[np.abs(waits - periods).argmin()])
        whole = int(periods)
        count = len(self._cuts) - 1 if self._pieces[link] > 1 else 1
        cuts = self._cuts if count > 1 else self._cuts[[0, -1]]
        return whole * count + int(np.abs(cuts - (periods - whole)).argmin())


def read_lateness(name: str, text: str | None) -> Lateness | None:
    """Return the law of delays that a text states; None if there is no text."""
    if text is None:
        return None
    try:
        found = cast("Mapping[str, Any]", json.loads(text))
        pieces = int(found.get("pieces", 1))
        delays = tuple(map(int if pieces else float, found["delays"]))
        law = Lateness(
            delays, tuple(tuple(map(float, row)) for row in found["odds"]), pieces,
            tuple(map(int, found.get("sequence", ()))), float(found.get("block", 1.0)),
        )  # fmt: skip
        valid = set(found) <= set(_KEYS) and law.pieces >= 0 and min(law.delays) >= 0 and law.block >= 1.0
        valid = valid and all(map(isfinite, law.delays))
        valid = valid and all(len(row) == len(law.delays) and min(row) >= 0.0 for row in law.odds)
        valid = valid and len(law.odds) > 0 and all(0 <= one <= len(law.delays) for one in law.sequence)
    except (ValueError, TypeError, KeyError, AttributeError):
        valid, law = False, None
    if not valid or law is None:
        raise ProblemError(
            f'{name} is {text!r}; expected a law such as {{"delays": [0, 1, 2], "odds": [[0.7, 0.2, 0.1]]}}'
        )
    return law


def stamped(datagram: bytes, late: float) -> bytes:
    """Return a datagram behind the stamp with its delay in pieces of a period."""
    return _STAMP.pack(_MARK, int(late)) + datagram


def unstamped(datagram: bytes) -> tuple[bytes, int]:
    """Return a datagram without the stamp, and the delay; 0 if there is no stamp."""
    # the byte behind the mark is the version in the header of a packet, and 0 in a stamp
    if len(datagram) < STAMP_SIZE or not datagram.startswith(_MARK) or datagram[len(_MARK)]:
        return datagram, 0
    return datagram[STAMP_SIZE:], _STAMP.unpack_from(datagram)[1]
