"""Which packets of one sender are new: a window over their sequence numbers, as IPsec has it [rfc4303]."""

from __future__ import annotations

from typing import Literal, TypeAlias

WIDTH = 1024  # sequence numbers behind the newest that are still told apart
News: TypeAlias = Literal["new", "duplicate", "replayed"]


class Window:
    """Sequence numbers that have come.

    Of a later epoch everything is new, and what came of an earlier one is forgotten; of an earlier epoch, and of what
    lies more than a window behind the newest, everything is replayed.
    """

    def __init__(self) -> None:
        """Nothing has come."""
        self.epoch, self.newest, self.seen, self.distinct = -1, -1, 0, 0

    @property
    def missing(self) -> int:
        """Sequence numbers of this epoch up to the newest that have not come: lost, or still under way."""
        return self.newest + 1 - self.distinct

    def admit(self, epoch: int, sequence: int) -> News:
        """Note a packet, and tell whether it is new."""
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
        """Return the window as numbers."""
        return [self.epoch, self.newest, self.seen, self.distinct]

    def restore(self, saved: list[int]) -> None:
        """Go on from a window that was saved."""
        self.epoch, self.newest, self.seen, self.distinct = saved
