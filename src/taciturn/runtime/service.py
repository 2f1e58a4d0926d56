"""What every process of a network does: it says where it listens, logs its ticks, and ends when it is asked to."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeAlias

from taciturn.runtime.udp import Address, Endpoint, parse_address

Told: TypeAlias = Callable[[Mapping[str, Any]], None]
Say: TypeAlias = Callable[[str], None]
LISTENS = "listens on"  # who starts a process waits for this
# Ctrl-C, and what asks a process to end: of POSIX SIGTERM, and SIGHUP when a terminal closes; of Windows SIGBREAK
ENDING = tuple(signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name))
IDLE = 0.25  # seconds after which it is seen whether to stop
QUIET = 0.05  # seconds without datagrams after which nothing is on its way any more


def say_where(name: str, address: Address) -> None:
    """Say on standard error that a process listens."""
    say(f"the {name} {LISTENS} {address[0]}:{address[1]}")


def say(sentence: str) -> None:
    """Say something on standard error."""
    print(f"taciturn: {sentence}", file=sys.stderr, flush=True)


def disagreement(name: str, why: str, keyed: bool, sender: Address) -> str | None:
    """Return the sentence of who refuses packets of a sender with which it has no policy or no key in common, if so."""
    others = {"foreign": "of another policy, or with and without a key,", "forged": "of another key"}
    others |= {"malformed": "too short for the tag of a key"} if keyed else {}
    if why not in others:
        return None
    return f"the {name} refuses packets {others[why]} from {sender[0]}:{sender[1]}: same problem file, same --key?"


def take_until(endpoint: Endpoint, take: Callable[[Sequence[bytes]], object], stopped: Callable[[], bool]) -> None:
    """Take datagrams until stopped, and then those that are still on their way."""
    while not stopped():
        take(endpoint.receive(time.monotonic() + IDLE))
    while found := endpoint.receive(time.monotonic() + QUIET):
        take(found)


@contextmanager
def until_stopped() -> Generator[Callable[[], bool]]:
    """Tell whether to stop: after any of ``ENDING``, at which the counters are still to be printed."""
    asked: list[int] = []
    before = {number: signal.signal(number, lambda found, _: asked.append(found)) for number in ENDING}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def logged(target: str | None) -> Generator[Told | None]:
    """Give what writes a JSON line per tick: to a file, ``-`` for standard output, or ``udp://HOST:PORT``."""
    if target is None:
        yield None
    elif target.startswith("udp://"):
        to = parse_address("--log", target.removeprefix("udp://"))
        with Endpoint(("0.0.0.0", 0)) as endpoint:
            yield lambda line: endpoint.send(json.dumps(line).encode(), to)
    elif target == "-":
        yield _lines(sys.stdout)
    else:
        with Path(target).open("a", encoding="utf-8") as file:
            yield _lines(file)


def _lines(file: IO[str]) -> Told:
    return lambda line: print(json.dumps(line), file=file, flush=True)
