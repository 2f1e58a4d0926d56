"""Faults of a robot, its camera, its links and its processes, with the times at which they begin and end."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, number_of


@dataclass(frozen=True, repr=False)
class Kind(Displayed):
    """Default duration and default size of faults of one kind.

    Args:
        lasts: default duration in seconds; 0 for an instantaneous fault.
        size: default size; () if the fault has no size.
        most: largest number of values in a size.
    """

    lasts: float = 0.0
    size: tuple[float, ...] = ()
    most: int = 1


KINDS = {
    "camera": Kind(2.0),  # the camera answers no request
    "cover": Kind(2.0),  # the marker is covered
    "light": Kind(2.0, (0.4,)),  # the brightness is multiplied by this factor
    "actuator": Kind(2.0),  # the link to the actuator drops all packets
    "kidnap": Kind(0.0, (0.2,), 3),  # instant displacement along x in metres (along y, and rotation in radians)
    "push": Kind(0.3, (5.0, 0.0), 2),  # force in newtons (and direction in degrees)
    "gain": Kind(0.0, (0.1,)),  # relative gain error of the motors, from the beginning
    "controller": Kind(),  # the controller process is killed and restarted
}
CAMERA = ("camera", "cover", "light")  # faults applied by the camera process
_FORM = re.compile(r"(?P<name>[a-z]+)(@(?P<start>[^+=@]+))?(\+(?P<lasts>[^+=@]+))?(=(?P<size>[^+=@]+))?")


@dataclass(frozen=True, repr=False)
class Fault(Displayed):
    """A fault with its start, its duration and its size (such as a force or an offset).

    Args:
        name: one of ``KINDS``.
        start: time at which the fault begins, in seconds.
        lasts: duration in seconds.
        size: size, in the units of the fault's kind.

    Example:
        >>> parse_fault("light@6+2=0.4")
        Fault(name='light', start=6, lasts=2, size=[0.4])
    """

    name: str
    start: float
    lasts: float
    size: tuple[float, ...]

    def __str__(self) -> str:
        """Return the fault in the notation of ``parse_fault``."""
        size = f"={','.join(map(repr, self.size))}" if self.size else ""
        lasts = f"+{self.lasts!r}" if KINDS[self.name].lasts else ""
        return f"{self.name}{'' if self.name == 'gain' else f'@{self.start!r}'}{lasts}{size}"

    def ticks(self, tick: float) -> tuple[int, int]:
        """Return the first step of the fault and the first step after it; ``tick`` is the sampling period in s."""
        first = round(self.start / tick)
        return first, max(first + 1, round((self.start + self.lasts) / tick))


def parse_fault(text: str) -> Fault:
    """Parse a fault from ``NAME@START+SECONDS=SIZE``; omitted parts get the default values of this kind of fault.

    Raises:
        ProblemError: the text has another form, the name is unknown, or a number is out of range.
    """
    found = _FORM.fullmatch(text.strip())
    if found is None or found["name"] not in KINDS:
        raise ProblemError(
            f"the fault is {text!r}; expected NAME@START+SECONDS=SIZE, e.g. light@6+2=0.4; NAME: {', '.join(KINDS)}"
        )
    kind = KINDS[found["name"]]
    if (found["lasts"] and not kind.lasts) or (found["size"] and not kind.size):
        wrong = "+SECONDS" if found["lasts"] and not kind.lasts else "=SIZE"
        raise ProblemError(
            f"the fault is {text!r}, but {found['name']} has no {wrong}; expected a fault without {wrong}"
        )
    if (found["name"] == "gain") == bool(found["start"]):
        raise ProblemError(
            f"the fault is {text!r}; expected "
            + ("no @START, as a gain error lasts the whole run" if found["start"] else "@START, the time in seconds")
        )
    (start,) = _numbers(text, found["start"] or "0", 1)
    (lasts,) = _numbers(text, found["lasts"], 1) if found["lasts"] else (kind.lasts,)
    size = _numbers(text, found["size"], kind.most) if found["size"] else kind.size
    if start < 0 or lasts < 0 or (found["lasts"] and lasts == 0):
        raise ProblemError(f"the fault is {text!r}; expected START >= 0 and SECONDS > 0")
    if found["name"] == "light" and size[0] <= 0:
        raise ProblemError(f"the fault is {text!r}; expected SIZE > 0, the share of the light that remains")
    return Fault(found["name"], start, lasts, size)


def window(faults: Sequence[Fault], name: str, tick: float) -> tuple[int, int] | None:
    """Return the first step of the fault ``name`` and the first step after it; None if no such fault is given.

    Raises:
        ProblemError: the fault is given twice.
    """
    found = [fault for fault in faults if fault.name == name]
    if len(found) > 1:
        raise ProblemError(f"the fault {name} is given {number_of(len(found), 'time')}; expected it at most once")
    return found[0].ticks(tick) if found else None


def _numbers(text: str, part: str, most: int) -> tuple[float, ...]:
    try:
        found = tuple(float(number) for number in part.split(","))
    except ValueError:
        found = ()
    if not 1 <= len(found) <= most or not all(map(math.isfinite, found)):
        wanted = "a number" if most == 1 else f"up to {most} numbers"
        raise ProblemError(f"the fault is {text!r}; expected {wanted} instead of {part!r}")
    return found
