"""Recursions over many steps that return to an earlier state bit for bit, after which they repeat.

A Riccati recursion converges up to rounding, and then stays constant or alternates between a few states. Each state
determines the next one, so the remaining steps of a long horizon need no further computation.
"""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array


class Repetition:
    """Detection that a recursion has returned to an earlier state."""

    def __init__(self) -> None:
        """Start without states."""
        # number and state of a step, by the hash of the state
        self._seen: dict[int, tuple[int, tuple[Array, ...]]] = {}

    def period(self, step: int, *state: Array) -> int | None:
        """Return after how many steps the recursion has returned to the state of this step; None: it has not yet.

        Args:
            step: number of the step, which increases or decreases by one at each call.
            state: the arrays that determine the next step; they must not change afterwards.
        """
        key = hash(b"".join(part.tobytes() for part in state))
        earlier, same = self._seen.setdefault(key, (step, state))
        alike = all(np.array_equal(one, other) for one, other in zip(state, same, strict=True))
        return abs(step - earlier) if alike and step != earlier else None


def fill_earlier(parts: tuple[Array, ...], step: int, period: int) -> None:
    """Fill the steps before a step of a backward recursion that repeats after ``period`` steps."""
    alike = step + (np.arange(step) - step) % period
    for part in parts:
        part[:step] = part[alike]
