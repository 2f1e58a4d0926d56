"""Counts of the packets that arrive late, and by how many whole steps.

A packet belongs to the step that reads it. If it arrives while a later step runs, d steps later, it is late by d steps,
whether the receiver used it or not. A packet that arrives while its step runs, but after the receiver has executed this
step, is late by 0 steps. All other packets are in time.

Which step runs is known exactly where the beginning of the steps is known: at the plant, and in a run on one machine.
A node estimates it from the packets that arrive (``clock``), so it cannot see a delay that all packets have.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from taciturn._display import Displayed
from taciturn._text import number_of, percent

SHOWN = 6  # numbers of steps that a text lists


@dataclass(repr=False)
class Lateness(Displayed):
    """Numbers of packets that have arrived, and of late ones by their lateness in steps.

    Example:
        >>> found = Lateness()
        >>> for late, missed in ((0, False), (2, True), (2, False), (0, True)):
        ...     found.add(late, missed)
        >>> found.text()
        '3 of 4 packets (75.0 %): 1 by less than a step, 2 by 2 steps'
    """

    arrived: int = 0
    steps: Counter[int] = field(default_factory=Counter[int])  # late packets, by the steps that they are late

    def add(self, late: int, missed: bool = False) -> None:
        """Count a packet that arrives ``late`` steps after the step that reads it, which may have ``missed`` it."""
        self.arrived += 1
        if late > 0 or missed:
            self.steps[late] += 1

    @property
    def late(self) -> int:
        """Number of packets that were late."""
        return self.steps.total()

    @property
    def share(self) -> float:
        """Share of the packets that were late; 0 if none has arrived."""
        return self.late / self.arrived if self.arrived else 0.0

    def document(self) -> dict[str, Any]:
        """Return the counts as values that JSON can represent."""
        by_steps = {str(late): self.steps[late] for late in sorted(self.steps)}
        return {"arrived": self.arrived, "late": self.late, "share": self.share, "steps": by_steps}

    def text(self, noun: str = "packet") -> str:
        """Write how many packets were late, and by how many steps."""
        told = [
            f"{self.steps[late]} by {number_of(late, 'step') if late else 'less than a step'}"
            for late in sorted(self.steps)
        ]
        shown = (
            told if len(told) <= SHOWN else [*told[: SHOWN - 1], f"{self._beyond()} by more, up to {max(self.steps)}"]
        )
        share = f" ({percent(self.share, 1)}): {', '.join(shown)}" if told else ""
        return f"{self.late} of {number_of(self.arrived, noun)}{share}"

    def _beyond(self) -> int:
        return sum(self.steps[late] for late in sorted(self.steps)[SHOWN - 1 :])


def total_of(counts: Iterable[Lateness]) -> Lateness:
    """Return the sum of counts."""
    found = Lateness()
    for one in counts:
        found.arrived += one.arrived
        found.steps += one.steps
    return found
