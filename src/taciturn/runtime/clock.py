"""When a tick begins: absolute deadlines, and the phase of a clock that is heard in packets.

Nodes do not agree on the time of day. Who measures begins a tick when the measurement comes; who listens takes the
phase of the ticks from the packets that arrive, so that a clock which is set, or which drifts, does not matter.
"""

from __future__ import annotations

DRIFT = 1e-3  # by which two clocks may differ in speed
JUMPED = 16.0  # ticks by which the phase is off where one of the clocks has jumped
AGREED = 8  # packets in a row that say so before it is believed


class Phase:
    """The time at which tick 0 began, as a listener hears it.

    A packet may be late and never early: the earliest says when its tick began at the latest. What is later moves the
    phase by no more than clocks may drift. What is off by many ticks is a jump, and is followed where so many packets
    in a row agree: before, one of a tick that cannot have begun is not believed.

    Args:
        tick: seconds per tick.

    Example:
        >>> phase = Phase(0.01)
        >>> phase.hear(100, 5.0), phase.hear(5000, 5.01)
        (True, False)
        >>> round(phase.begins(102), 3)
        5.02
    """

    def __init__(self, tick: float) -> None:
        """Nothing has been heard."""
        self.tick, self.zero = tick, float("nan")
        self._last, self._jump, self._agreed = 0, float("nan"), 0
        self.jumps = 0

    @property
    def known(self) -> bool:
        """Whether anything has been heard."""
        return self.zero == self.zero

    def hear(self, tick: int, now: float) -> bool:
        """Note that a packet of a tick has come now; return whether that tick can have begun."""
        found = now - tick * self.tick
        if not self.known:
            self.zero, self._last = found, tick
            return True
        off = found - self.zero
        if abs(off) > JUMPED * self.tick:
            agrees = abs(found - self._jump) < JUMPED * self.tick
            self._jump, self._agreed = found, self._agreed + 1 if agrees else 1
            if self._agreed < AGREED:
                return off > 0
            self.zero, self._last, self._agreed = found, tick, 0
            self.jumps += 1
            return True
        self._agreed = 0
        if off < 0:
            self.zero = found
        else:
            self.zero += min(off, DRIFT * self.tick * max(tick - self._last, 0))
        self._last = max(self._last, tick)
        return True

    def begins(self, tick: int) -> float:
        """Return when a tick begins."""
        return self.zero + tick * self.tick

    def now(self, time: float) -> int:
        """Return the tick that a time is in."""
        return int((time - self.zero) // self.tick)
