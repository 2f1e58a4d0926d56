"""Detection of new packets of a sender by a window over their sequence numbers, as in IPsec [rfc4303]."""

from __future__ import annotations

from typing import Literal, TypeAlias

WIDTH = 1024  # width of the window in sequence numbers
News: TypeAlias = Literal["new", "duplicate", "replayed"]


class Window:
    """A window over the received sequence numbers of one sender.

    The first packet of a later epoch clears the window. A packet is a replay if it belongs to an earlier epoch, or is
    behind the newest packet by the width of the window or more.
    """

    def __init__(self) -> None:
        """Start with an empty window."""
        self.epoch, self.newest, self.seen, self.distinct = -1, -1, 0, 0

    @property
    def missing(self) -> int:
        """Number of packets of this epoch, up to the newest, that have not arrived: dropped or delayed."""
        return self.newest + 1 - self.distinct

    def admit(self, epoch: int, sequence: int) -> News:
        """Record a packet, and return whether it is new."""
        if epoch < self.epoch:
            return "replayed"
        if epoch > self.epoch:
            self.epoch, self.newest, self.seen, self.distinct = epoch, -1, 0, 0
        behind = self.newest - sequence
        if behind < 0:
            self.seen = 1 if -behind >= WIDTH else (self.seen << -behind | 1) & ((1 << WIDTH) - 1)
            self.newest = sequence
        elif behind >= WIDTH:
            return "replayed"
        elif self.seen >> behind & 1:
            return "duplicate"
        else:
            self.seen |= 1 << behind
        self.distinct += 1
        return "new"

    def save(self) -> list[int]:
        """Return the window as a list of numbers."""
        return [self.epoch, self.newest, self.seen, self.distinct]

    def restore(self, saved: list[int]) -> None:
        """Continue from a saved window."""
        self.epoch, self.newest, self.seen, self.distinct = saved
