"""The live page of a run: a browser shows what the robot does and what is sent, and people disturb it.

Who runs the robot calls ``begin`` once a round, ``put`` once a tick, ``show`` for a picture and ``asked`` for what
people want; none of them waits for a browser.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from taciturn._arrays import count, number
from taciturn.errors import ProblemError
from taciturn.runtime.udp import Address
from taciturn.twin.door import Door
from taciturn.twin.feed import Feed, encode
from taciturn.twin.server import Server

KEYS = (
    "tick", "time", "state", "estimate", "input", "trigger", "threshold", "sent", "arrived", "cost", "rate", "degraded",
)  # fmt: skip


@dataclass(frozen=True)
class About:
    """What a page is told when a round of a run begins.

    Args:
        robot: "rover", which is drawn as its first state over time, or "omni": its second state over its first.
        policy: kind of the policy, as "remote-lqg".
        tick: seconds per tick, > 0.
        ticks: of the round, at least 1.
        states: their names with units, as "x [m]".
        inputs: their names with units.
        links: those that a policy sends on, as ("sensor", "actuator").
        bound: guarantee of the total cost; None: there is none.
        reference: one state per tick to be tracked; may be empty.
        knob: name, least and largest value of what people may turn, least ≥ 0.
        value: of the knob in this round.
        round: its number.

    Raises:
        ProblemError: a number outside its range, or a state to be tracked that does not fit.
    """

    robot: str
    policy: str
    tick: float
    ticks: int
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    links: tuple[str, ...]
    bound: float | None
    reference: tuple[tuple[float, ...], ...]
    knob: tuple[str, float, float]
    value: float
    round: int

    def __post_init__(self) -> None:
        """Check the ranges."""
        number("tick", self.tick, 0.0)
        count("ticks", self.ticks)
        count("round", self.round, 0)
        name, least, largest = self.knob
        number(f"the least {name}", least, 0.0, closed=True)
        number(f"the largest {name}", largest, least)
        number(name, self.value, least, largest, closed=True)
        if self.bound is not None:
            number("bound", self.bound)
        needed = 2 if self.robot == "omni" else 1
        if len(self.states) < needed:
            raise ProblemError(
                f"states has {len(self.states)} names; expected at least {needed} of the robot {self.robot!r}"
            )
        for state in self.reference:
            if not needed <= len(state) <= len(self.states):
                raise ProblemError(
                    f"reference holds a state of {len(state)} numbers; expected {needed} to {len(self.states)} of them"
                )


class Page:
    """Serves the page of a run from a thread of its own.

    Args:
        bind: where to listen, as ("127.0.0.1", 8000); port 0: any free one.
        token: what whoever watches must know; needed where others than this machine can reach the page.

    Raises:
        ProblemError: the port is in use, or a page that others can reach has no token.

    Example:
        >>> with Page(("127.0.0.1", 0)) as page:
        ...     page.note("the camera is warming up")
        ...     page.asked()
        []
    """

    def __init__(self, bind: Address, token: str | None = None) -> None:
        """Start to serve."""
        self._door, self._feed = Door(bind, token), Feed()
        self._server: Server | None = Server(bind, self._feed, self._door)
        self._about: About | None = None
        self.address: Address = self._server.address

    @property
    def url(self) -> str:
        """What to open on this machine; on others, its address takes the place of 127.0.0.1."""
        host, port = self.address
        return f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{port}/{self._door.query}"

    def begin(self, about: About) -> None:
        """Begin a round: the curves start anew.

        Raises:
            ProblemError: a number that is not finite.
        """
        self._feed.begin(asdict(about), about.knob)
        self._about = about

    def put(self, row: Mapping[str, Any]) -> None:
        """Show one tick.

        Args:
            row: ``tick``, its number in the round; ``time`` in seconds; ``state``, ``estimate`` (or None) and
                ``input``, lists; ``trigger`` and ``threshold``, numbers or None; ``sent``, ``arrived`` and ``rate`` by
                link; ``cost`` so far; ``degraded``, 0 or 1. Arrays are lists.

        Raises:
            ProblemError: no round has begun, or the row does not fit what was said of it.
        """
        if self._about is None:
            raise ProblemError("a row is put before a round; expected a call of begin first")
        _check(self._about, row)
        self._feed.tell("tick", encode(f"the row of tick {row['tick']}", dict(row)))

    def show(self, picture: bytes) -> None:
        """Show the newest picture of the camera, a JPEG.

        Raises:
            ProblemError: it is none.
        """
        if not picture.startswith(b"\xff\xd8"):
            raise ProblemError(f"picture begins with {picture[:4]!r}; expected a JPEG, which begins with b'\\xff\\xd8'")
        self._feed.show(picture)

    def note(self, text: str) -> None:
        """Write a line into the log of the page."""
        self._feed.tell("note", encode("text", text))

    def asked(self) -> list[tuple[str, float]]:
        """Return what people asked since the last call, in their order.

        Returns:
            ("pause", 1.0) and ("pause", 0.0) to go on, ("value", of the knob), ("push", 1.0).
        """
        return self._feed.asked()

    def close(self) -> None:
        """Tell the pages that the run has ended, and stop serving."""
        if self._server is not None:
            self._server.close()
            self._server = None

    def __enter__(self) -> Page:
        """Be closed at the end of a block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()


def _check(about: About, row: Mapping[str, Any]) -> None:
    """Refuse a row whose curves could not be drawn."""
    missing = [key for key in KEYS if key not in row]
    if missing:
        raise ProblemError(f"a row lacks {', '.join(map(repr, missing))}; expected the keys {', '.join(KEYS)}")
    for key, names in (("state", about.states), ("estimate", about.states), ("input", about.inputs)):
        if row[key] is not None and len(row[key]) != len(names):
            raise ProblemError(f"{key} of a row has {len(row[key])} numbers; expected {len(names)}: {', '.join(names)}")
    for key in ("sent", "arrived", "rate"):
        lacking = [link for link in about.links if link not in row[key]]
        if lacking:
            raise ProblemError(f"{key} of a row lacks the link {lacking[0]!r}; expected one entry for each link")
