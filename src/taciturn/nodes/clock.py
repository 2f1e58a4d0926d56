"""Timing of steps in real time: a node estimates from arriving packets when step 0 began.

The wall clocks of nodes are not synchronised. The node with the sensor begins a step when the measurement arrives. The
other nodes estimate the phase of the steps from the packets that arrive. Drift or adjustment of a wall clock therefore
has no effect.
"""

from __future__ import annotations

_DRIFT = 1e-3  # largest relative difference in speed of two wall clocks
JUMPED = 16.0  # offset in steps beyond which a wall clock has jumped
AGREED = 8  # consecutive packets that must show a jump before it is accepted
LATE = 0.25  # offset in steps beyond which a packet is later than the drift of the clocks explains


class Phase:
    """Estimate of the time at which step 0 began, from the arrival times of packets."""

    # A packet may be late but not early, so the earliest packet bounds the beginning of its step. A later packet moves
    # the phase by at most the possible drift, unless several consecutive packets are late: then the estimate follows
    # the earliest of them. An offset of many steps is a jump. The estimate follows a jump after several consecutive
    # packets agree. Until then, a packet of a step that cannot have begun is ignored.

    def __init__(self, tick: float, spread: float = 0.0) -> None:
        """Start without packets. Random delays may make a packet late by ``spread`` seconds."""
        self.tick, self.zero, self._spread = tick, float("nan"), spread
        self._last, self._jump, self._agreed = 0, float("nan"), 0
        self._behind, self._least = 0, float("inf")  # consecutive late packets, and their smallest offset
        self.jumps = 0
        self.confirmations = 0  # packets that agreed with the estimate, or made it follow a jump
        self.late = 0.0  # offset in seconds by which the last of them was late

    @property
    def known(self) -> bool:
        """True if there is an estimate, because a packet has arrived."""
        return self.zero == self.zero

    def hear(self, tick: int, now: float) -> bool:
        """Update the estimate when a packet arrives. Return False if the packet's step cannot have begun yet."""
        found = now - tick * self.tick
        if not self.known:
            self._confirm(0.0)
            self.zero, self._last = found, tick
            return True
        off = found - self.zero
        if off < -JUMPED * self.tick or off > JUMPED * self.tick + self._spread:
            agrees = abs(found - self._jump) < JUMPED * self.tick
            self._jump, self._agreed = found, self._agreed + 1 if agrees else 1
            if self._agreed < AGREED:
                return off > 0
            self._confirm(0.0)
            self.zero, self._last, self._agreed = found, tick, 0
            self.jumps += 1
            return True
        self._confirm(max(off, 0.0))
        self._agreed = 0
        if off < 0:
            self.zero = found
        else:
            self.zero += min(off, _DRIFT * self.tick * max(tick - self._last, 0))
        self._last = max(self._last, tick)
        self._follow(off)
        return True

    def _confirm(self, late: float) -> None:
        self.confirmations, self.late = self.confirmations + 1, late

    def _follow(self, off: float) -> None:
        """Move the estimate if the last packets were all late, so that it was too early for each of them."""
        if off <= LATE * self.tick + self._spread:
            self._behind, self._least = 0, float("inf")
            return
        self._behind, self._least = self._behind + 1, min(self._least, off)
        if self._behind == AGREED:
            self.jumps += self._least >= self.tick
            self.zero += self._least
            self._behind, self._least = 0, float("inf")

    def begins(self, tick: int) -> float:
        """Compute the time at which a step begins."""
        return self.zero + tick * self.tick

    def now(self, time: float) -> int:
        """Compute the number of the step that is running at a given time."""
        return int((time - self.zero) // self.tick)
