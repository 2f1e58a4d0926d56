"""What can go wrong with a robot, its camera and its links, and when."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from taciturn.errors import ProblemError


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    Args:
        lasts: seconds that it lasts where nothing is said; 0: it happens at once.
        size: where nothing is said; () where it has none.
        most: numbers that a size has at most.
    """

    lasts: float = 0.0
    size: tuple[float, ...] = ()
    most: int = 1


KINDS = {
    "camera": Kind(2.0),  # it answers no question
    "cover": Kind(2.0),  # something lies over the marker
    "light": Kind(2.0, (0.4,)),  # it is this many times as strong
    "actuator": Kind(2.0),  # the link to it is dead
    "kidnap": Kind(0.0, (0.2,), 3),  # the robot is moved at once by so many metres (and metres, and radians)
    "push": Kind(0.3, (5.0, 0.0), 2),  # with so many newtons (in a direction, in degrees)
    "gain": Kind(0.0, (0.1,)),  # the motors are stronger by this share, from the beginning on
    "controller": Kind(),  # its process is killed and started again
}
CAMERA = ("camera", "cover", "light")  # those of the camera's process
_FORM = re.compile(r"(?P<name>[a-z]+)(@(?P<start>[^+=@]+))?(\+(?P<lasts>[^+=@]+))?(=(?P<size>[^+=@]+))?")


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong.

    Args:
        name: one of ``KINDS``.
        start: seconds from the beginning.
        lasts: seconds.
        size: what its kind says.

    Example:
        >>> parse_fault("light@6+2=0.4")
        Fault(name='light', start=6.0, lasts=2.0, size=(0.4,))
    """

    name: str
    start: float
    lasts: float
    size: tuple[float, ...]

    def __str__(self) -> str:
        """Return it as it is written."""
        size = f"={','.join(map(repr, self.size))}" if self.size else ""
        lasts = f"+{self.lasts!r}" if KINDS[self.name].lasts else ""
        return f"{self.name}{'' if self.name == 'gain' else f'@{self.start!r}'}{lasts}{size}"

    def ticks(self, tick: float) -> tuple[int, int]:
        """Return the first tick of the fault, and the one at which it is over, of ticks of so many seconds."""
        first = round(self.start / tick)
        return first, max(first + 1, round((self.start + self.lasts) / tick))


def parse_fault(text: str) -> Fault:
    """Return the fault that is written ``NAME@START+SECONDS=SIZE``; what is left out is as usual for its kind.

    Raises:
        ProblemError: no such form, an unknown name, or numbers out of range.
    """
    found = _FORM.fullmatch(text.strip())
    if found is None or found["name"] not in KINDS:
        raise ProblemError(
            f"the fault is {text!r}; expected NAME@START+SECONDS=SIZE, as light@6+2=0.4, with one of {', '.join(KINDS)}"
        )
    kind = KINDS[found["name"]]
    if (found["lasts"] and not kind.lasts) or (found["size"] and not kind.size):
        wrong = "+SECONDS" if found["lasts"] and not kind.lasts else "=SIZE"
        raise ProblemError(f"the fault is {text!r}, and {found['name']} has no {wrong}; expected it left out")
    if (found["name"] == "gain") == bool(found["start"]):
        raise ProblemError(
            f"the fault is {text!r}; expected "
            + ("no @START: a gain is from the beginning on" if found["start"] else "@START: when, in seconds")
        )
    (start,) = _numbers(text, found["start"] or "0", 1)
    (lasts,) = _numbers(text, found["lasts"], 1) if found["lasts"] else (kind.lasts,)
    size = _numbers(text, found["size"], kind.most) if found["size"] else kind.size
    if start < 0 or lasts < 0 or (found["lasts"] and lasts == 0) or (found["name"] == "light" and size[0] <= 0):
        raise ProblemError(f"the fault is {text!r}; expected a start of at least 0, and positive seconds and light")
    return Fault(found["name"], start, lasts, size)


def window(faults: Sequence[Fault], name: str, tick: float) -> tuple[int, int] | None:
    """Return in which ticks a link is dead, or None.

    Raises:
        ProblemError: it is to be dead twice.
    """
    found = [fault for fault in faults if fault.name == name]
    if len(found) > 1:
        raise ProblemError(f"the fault {name} is given {len(found)} times; expected it once")
    return found[0].ticks(tick) if found else None


def _numbers(text: str, part: str, most: int) -> tuple[float, ...]:
    try:
        found = tuple(float(number) for number in part.split(","))
    except ValueError:
        found = ()
    if not 1 <= len(found) <= most or not all(map(math.isfinite, found)):
        wanted = "a number" if most == 1 else f"up to {most} numbers"
        raise ProblemError(f"the fault is {text!r}; expected {wanted} in the place of {part!r}")
    return found
