"""The live page of a run: a browser shows the robot and its packets, and users can disturb the robot.

A run calls ``begin`` at the start of a round, ``put`` for each step, ``compare`` for each step of the loop that sends
every sample, ``show`` for a picture, and ``asked`` for the requests of users. These calls return immediately, without
waiting for a browser.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, count, number
from taciturn_twins.access_control import AccessControl
from taciturn_twins.feed import Feed, encode
from taciturn_twins.server import Server
from taciturn_udp.endpoint import Address

KEYS = (
    "tick", "time", "state", "estimate", "input", "trigger", "threshold", "sent", "arrived", "packets", "drops",
    "cost", "degraded",
)  # fmt: skip
COMPARED = ("tick", "state", "cost", "packets")  # keys of a step of the loop that sends every sample


@dataclass(frozen=True, repr=False)
class About(Displayed):
    """The description of a round, which the page shows when the round begins.

    Args:
        robot: "rover", drawn as its first state over time, or "omni", drawn as its second state over its first.
        policy: kind of the policy, e.g. "remote-lqg".
        tick: sampling period in seconds, > 0.
        ticks: steps of the round, at least 1.
        states: names of the states with units, e.g. "x [m]".
        inputs: names of the inputs with units.
        links: links on which the policy sends, e.g. ("sensor", "actuator").
        losses: design loss probability of each link, in the order of ``links``, each in [0, 1].
        bound: guaranteed upper bound on the total cost, or None.
        reference: reference state of each step; may be empty.
        parameter: name, smallest and largest value of the policy's tuning parameter; smallest ≥ 0.
        meaning: description of the parameter, with its unit.
        value: value of the parameter in this round.
        round: number of the round.
        pauses: whether the run can be paused; a run in real time cannot.

    Raises:
        ProblemError: a number is out of range, or a reference state has the wrong size.
    """

    robot: str
    policy: str
    tick: float
    ticks: int
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    links: tuple[str, ...]
    losses: tuple[float, ...]
    bound: float | None
    reference: tuple[tuple[float, ...], ...]
    parameter: tuple[str, float, float]
    meaning: str
    value: float
    round: int
    pauses: bool = True

    def __post_init__(self) -> None:
        """Check the ranges."""
        number("tick", self.tick, 0.0)
        count("ticks", self.ticks)
        count("round", self.round, 0)
        name, least, largest = self.parameter
        number(f"the least {name}", least, 0.0, closed=True)
        number(f"the largest {name}", largest, least)
        number(name, self.value, least, largest, closed=True)
        if self.bound is not None:
            number("bound", self.bound)
        if len(self.losses) != len(self.links):
            raise ProblemError(f"losses has {len(self.losses)} numbers; expected one for each of {self.links}")
        for link, loss in zip(self.links, self.losses, strict=True):
            number(f"the loss of the {link} link", loss, 0.0, 1.0, closed=True)
        needed = 2 if self.robot == "omni" else 1
        if len(self.states) < needed:
            raise ProblemError(
                f"states has {len(self.states)} names; expected at least {needed} for the robot {self.robot!r}"
            )
        for state in self.reference:
            if not needed <= len(state) <= len(self.states):
                raise ProblemError(
                    f"reference holds a state of {len(state)} numbers; expected {needed} to {len(self.states)} numbers"
                )


class Page:
    """The live page of a run, served by a separate thread.

    Args:
        bind: address to listen on, e.g. ("127.0.0.1", 8000); with port 0, the system chooses a free port.
        token: access token of the page; required if other machines can reach the page.

    Raises:
        ProblemError: the port is in use, or other machines can reach the page and no token is given.

    Example:
        >>> with Page(("127.0.0.1", 0)) as page:
        ...     page.wait("calibrating the camera")
        ...     page.asked()
        []
    """

    def __init__(self, bind: Address, token: str | None = None) -> None:
        """Start the server of the page."""
        self._access, self._feed = AccessControl(bind, token), Feed()
        self._server: Server | None = Server(bind, self._feed, self._access)
        self._about: About | None = None
        self.address: Address = self._server.address

    @property
    def url(self) -> str:
        """URL of the page on this machine; on other machines, replace 127.0.0.1 with the address of this machine."""
        host, port = self.address
        return f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{port}/{self._access.query}"

    def wait(self, text: str) -> None:
        """Show a text about the current preparation until the next round begins."""
        self._feed.tell("wait", encode("text", text))

    def begin(self, about: About) -> None:
        """Begin a round: the page clears the charts when the first step arrives.

        Raises:
            ProblemError: a number is not finite.
        """
        self._feed.begin(asdict(about), about.parameter)
        self._about = about

    def put(self, row: Mapping[str, Any]) -> None:
        """Show one step of the watched loop.

        Args:
            row: dict of ``tick``, the number of the step in the round; ``time`` in seconds; ``state``, ``estimate`` (or
                None) and ``input``, as lists or arrays; ``trigger`` and ``threshold``, numbers or None; ``sent`` and
                ``arrived``, 0 or 1 by link; ``packets`` and ``drops`` (packet losses by design), numbers so far by
                link; ``cost`` so far; and ``degraded``, 0 or 1.

        Raises:
            ProblemError: no round has begun, or the row does not match the description of the round.
        """
        about = self._check(row, KEYS)
        for key, names in (("estimate", about.states), ("input", about.inputs)):
            if row[key] is not None:
                _check_size(key, row[key], names)
        for key in ("sent", "arrived", "packets", "drops"):
            _check_links(key, row[key], about.links)
        self._feed.tell("tick", encode(f"the row of step {row['tick']}", dict(row)))

    def compare(self, row: Mapping[str, Any]) -> None:
        """Show one step of the loop that sends every sample.

        Args:
            row: dict of ``tick``, ``state``, ``cost`` so far, and ``packets`` so far by link, as in ``put``.

        Raises:
            ProblemError: no round has begun, or the row does not match the description of the round.
        """
        about = self._check(row, COMPARED)
        _check_links("packets", row["packets"], about.links)
        found = {key: row[key] for key in COMPARED}
        self._feed.tell("compared", encode(f"the compared row of step {row['tick']}", found))

    def show(self, picture: bytes) -> None:
        """Show the newest picture of the camera, a JPEG.

        Raises:
            ProblemError: the picture is not a JPEG.
        """
        if not picture.startswith(b"\xff\xd8"):
            raise ProblemError(f"picture begins with {picture[:4]!r}; expected a JPEG, which begins with b'\\xff\\xd8'")
        self._feed.show(picture)

    def note(self, text: str, step: int | None = None) -> None:
        """Add a line to the events of the page, at a given step or, by default, at the newest step."""
        self._feed.tell("note", encode("text", {"text": text, "step": step}))

    def asked(self) -> list[tuple[str, float]]:
        """Return the requests of users since the last call, in order.

        Returns:
            Pairs: ("pause", 1.0) to pause, ("pause", 0.0) to resume, ("push", 1.0) to push the robot, or ("value", v)
            to set the tuning parameter to v.
        """
        return self._feed.asked()

    def close(self) -> None:
        """Notify all browsers that the run has ended, and stop the server."""
        if self._server is not None:
            self._server.close()
            self._server = None

    def __enter__(self) -> Page:
        """Return the page, which is closed at the end of the ``with`` block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the page."""
        self.close()

    def _check(self, row: Mapping[str, Any], keys: tuple[str, ...]) -> About:
        """Return the description of the round, if a row contains the given keys and a state of the right size."""
        if self._about is None:
            raise ProblemError("a step is shown before a round begins; expected a call of begin first")
        missing = [key for key in keys if key not in row]
        if missing:
            raise ProblemError(
                f"the row of a step lacks {', '.join(map(repr, missing))}; expected the keys {', '.join(keys)}"
            )
        _check_size("state", row["state"], self._about.states)
        return self._about


def _check_size(key: str, values: Any, names: tuple[str, ...]) -> None:
    """Reject a vector of the wrong size."""
    if len(values) != len(names):
        raise ProblemError(
            f"{key} of the row of a step has {len(values)} numbers; expected {len(names)}: {', '.join(names)}"
        )


def _check_links(key: str, values: Mapping[str, Any], links: tuple[str, ...]) -> None:
    """Reject a mapping that lacks an entry for a link."""
    lacking = [link for link in links if link not in values]
    if lacking:
        raise ProblemError(
            f"the row of a step has no {key} for the link {lacking[0]!r}; expected one entry for each link"
        )
