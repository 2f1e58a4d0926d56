"""The live page of a run: a browser shows the robot and its packets, and its users can disturb the robot.

A run calls ``begin`` at the start of a round, ``put`` for each step, ``compare`` for each step of the loop that sends
every sample, ``show`` for a picture, and ``asked`` for the requests of users. These calls return immediately, without
waiting for a browser. ``GET /events`` returns the events, and ``GET /picture`` the newest picture as JPEG; ``POST
/ask`` accepts a request as JSON, e.g. ``{"ask": "value", "value": 0.01}``.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, choice, count, number, number_of
from taciturn_udp.endpoint import Address
from taciturn_web.events import Log, encode
from taciturn_web.guard import guarded, hosts_of, new_token, read_json
from taciturn_web.serving import Served

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

WAITING = 64  # largest number of requests that wait for the run
LARGEST = 256  # largest body of a request in bytes
ASKS = ("pause", "value", "push")
KEYS = (
    "tick", "time", "state", "estimate", "input", "trigger", "threshold", "sent", "arrived", "packets", "drops",
    "cost", "degraded",
)  # fmt: skip
COMPARED = ("tick", "state", "cost", "packets")  # keys of a step of the loop that sends every sample


@dataclass(frozen=True, repr=False)
class About(Displayed):
    """Facts about a round of the live page, which the page shows when the round begins.

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
            raise ProblemError(
                f"'losses' has {number_of(len(self.losses), 'number')}; expected one number for each of the links "
                f"{self.links}"
            )
        for link, loss in zip(self.links, self.losses, strict=True):
            number(f"the loss of the {link} link", loss, 0.0, 1.0, closed=True)
        needed = 2 if self.robot == "omni" else 1
        if len(self.states) < needed:
            raise ProblemError(
                f"'states' has {number_of(len(self.states), 'name')}; expected at least {needed} for the robot "
                f"{self.robot!r}"
            )
        for state in self.reference:
            if not needed <= len(state) <= len(self.states):
                raise ProblemError(
                    f"'reference' contains a state of {number_of(len(state), 'number')}; expected {needed} to "
                    f"{number_of(len(self.states), 'number')}"
                )


class Page:
    """The live page of a run, served by a thread of its own; every method may be called from any thread.

    Args:
        bind: address to listen on, e.g. ("127.0.0.1", 8000); with port 0, the system chooses a free port.
        token: access token, printable ASCII without spaces; default: a random one, which the URL contains.

    Raises:
        ProblemError: the port is in use, or the token is not valid.

    Example:
        >>> with Page(("127.0.0.1", 0)) as page:
        ...     page.wait("calibrating the camera")
        ...     page.asked()
        []
    """

    def __init__(self, bind: Address, token: str | None = None) -> None:
        """Start the server of the page."""
        from starlette.routing import Route

        self._lock = threading.Lock()
        self._log, self._picture, self._pictures = Log("wait"), b"", 0
        self._about: About | None = None
        self._asked: list[tuple[str, float]] = []
        self._paused = False
        routes = [
            Route("/events", self._log.answer),
            Route("/picture", self._send_picture),
            Route("/ask", self._hear, methods=["POST"]),
        ]
        given, folder = new_token() if token is None else token, files("taciturn_twins") / "web"
        self._served = Served(guarded(routes, token=given, hosts=hosts_of(bind), assets=folder), bind)
        self.address, self.url = self._served.address, self._served.url

    def wait(self, text: str) -> None:
        """Show a text about preparations, until the next round begins."""
        self._log.tell("wait", encode("text", text))

    def begin(self, about: About) -> None:
        """Begin a round on the page; the page clears its charts when the first step arrives.

        Raises:
            ProblemError: a number is not finite.
        """
        text = encode("about", asdict(about))
        with self._lock:
            self._about = about
            self._log.begin("begin", text)
            if self._paused:
                self._tell_request("pause", 1.0)

    def put(self, row: Mapping[str, Any]) -> None:
        """Show one step of the main loop on the page.

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
        self._log.tell("tick", encode(f"the row of step {row['tick']}", dict(row)))

    def compare(self, row: Mapping[str, Any]) -> None:
        """Show one step of the second loop, which sends every sample.

        Args:
            row: dict of ``tick``, ``state``, ``cost`` so far, and ``packets`` so far by link, as in ``put``.

        Raises:
            ProblemError: no round has begun, or the row does not match the description of the round.
        """
        about = self._check(row, COMPARED)
        _check_links("packets", row["packets"], about.links)
        found = {key: row[key] for key in COMPARED}
        self._log.tell("compared", encode(f"the compared row of step {row['tick']}", found))

    def show(self, picture: bytes) -> None:
        """Show the camera's newest picture, a JPEG, on the page.

        Raises:
            ProblemError: the picture is not a JPEG.
        """
        if not picture.startswith(b"\xff\xd8"):
            raise ProblemError(
                f"'picture' begins with {picture[:4]!r}; expected a JPEG, which begins with b'\\xff\\xd8'"
            )
        with self._lock:
            self._picture, self._pictures = picture, self._pictures + 1
            self._log.replace("picture", str(self._pictures))

    def note(self, text: str, step: int | None = None) -> None:
        """Add a line to the page's list of events, at the given step or else at the newest step."""
        self._log.tell("note", encode("text", {"text": text, "step": step}))

    def asked(self) -> list[tuple[str, float]]:
        """Return the requests that users have made since the last call, in order of arrival.

        Returns:
            Pairs: ("pause", 1.0) to pause, ("pause", 0.0) to resume, ("push", 1.0) to push the robot, or ("value", v)
            to set the tuning parameter to v.
        """
        with self._lock:
            found, self._asked = self._asked, []
        return found

    def close(self) -> None:
        """Tell all browsers that the run has ended, and stop the server."""
        self._log.end()
        self._served.close()

    def __enter__(self) -> Page:
        """Return the page, which is closed at the end of the ``with`` block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the page."""
        self.close()

    async def _send_picture(self, _: Request) -> Response:
        from starlette.responses import PlainTextResponse, Response

        if not self._picture:
            return PlainTextResponse("there is no picture yet", 404)
        return Response(self._picture, media_type="image/jpeg")

    async def _hear(self, request: Request) -> Response:
        """Store a request for the run, and show it on all pages; ``ProblemError`` refuses the request."""
        from starlette.responses import JSONResponse

        asked = await read_json(request, LARGEST)
        try:
            ask, value = choice("ask", str(asked["ask"]), ASKS), asked["value"]
        except (TypeError, KeyError):
            raise ProblemError(
                'the request is malformed; expected JSON such as {"ask": "value", "value": 0.01}'
            ) from None
        with self._lock:
            if self._about is None:
                raise ProblemError("no round has begun; expected a request during a round: try again later")
            name, least, largest = self._about.parameter
            known = number(name, value, least, largest, closed=True) if ask == "value" else number("value", value)
            if ask != "value" and known not in (0.0, 1.0):
                raise ProblemError(f"the value of {ask!r} is {known:g}; expected 0 or 1")
            if len(self._asked) >= WAITING:
                raise ProblemError(
                    f"{WAITING} requests are waiting for the run; expected fewer waiting requests: check whether the "
                    "run has stopped"
                )
            self._asked.append((ask, known))
            self._paused = known == 1.0 if ask == "pause" else self._paused
            self._tell_request(ask, known)
        return JSONResponse({})

    def _tell_request(self, ask: str, value: float) -> None:
        self._log.tell("asked", encode(ask, {"ask": ask, "value": value}))

    def _check(self, row: Mapping[str, Any], keys: tuple[str, ...]) -> About:
        """Return the description of the round, if a row contains the given keys and a state of the right size."""
        if self._about is None:
            raise ProblemError("a step is shown before a round begins; expected a call of the method 'begin' first")
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
            f"the entry {key} of the row of a step has {number_of(len(values), 'number')}; expected "
            f"{number_of(len(names), 'number')}: {', '.join(names)}"
        )


def _check_links(key: str, values: Mapping[str, Any], links: tuple[str, ...]) -> None:
    """Reject a mapping that lacks an entry for a link."""
    lacking = [link for link in links if link not in values]
    if lacking:
        raise ProblemError(
            f"the row of a step has no {key} for the link {lacking[0]!r}; expected one entry for each link"
        )
