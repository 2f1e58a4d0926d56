"""Processor in the loop: a node on an emulated board, asked tick by tick over its serial port."""

from __future__ import annotations

import socket
import struct
import subprocess
import time
import weakref
import zlib
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from taciturn.errors import ProblemError
from taciturn.export.cortex import Board, emulate

BEGIN = 0x54  # first byte of a frame: see board/loop.c
GONE_THROUGH, DEGRADED, HAS_INPUT = 1, 2, 4
NO_TICK = b"\xff" * 8
LAST = 2**64 - 1  # which is no tick
MOST_DATAGRAMS, MOST_NUMBERS, LARGEST = 8, 255, 0xFFFF  # of a question; bytes of a datagram
AGAIN = 0.5  # seconds after which a question is repeated
PIECE = 1024  # bytes of a frame that are handed to the emulator at once
SPACE = 1 << 20  # bytes of answers that may wait


class Answer(NamedTuple):
    """What a node does in a tick.

    Args:
        gone: whether it went through the tick: false where it is not later than the last, or a measurement is missing.
        degraded: whether something has happened that its theory does not know.
        datagrams: that it sends, in order.
        input: of the plant; None where the node has none.
    """

    gone: bool
    degraded: bool
    datagrams: tuple[bytes, ...]
    input: tuple[float, ...] | None


class NodeOnBoard:
    """A node that runs on an emulated board, until the end of a ``with`` block.

    Args:
        board: the board.
        program: from ``compile_for`` with ``in_the_loop(node)``.
        patience: seconds that it may take to begin, and each answer.

    Raises:
        ProblemError: no emulator, or the program does not begin in time.
    """

    def __init__(self, board: Board, program: Path, patience: float = 30.0) -> None:
        """Start it, and wait until it has said that it listens."""
        self._name, self._patience = board.processor, patience
        self._bytes = bytearray()
        self._line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SPACE)
        self._line.bind(("127.0.0.1", 0))
        self._line.settimeout(AGAIN)
        self._board: tuple[str, int] | None = None  # where it sends from: known when it has begun
        port = self._line.getsockname()[1]
        serial = ["-serial", f"udp:127.0.0.1:{port}@127.0.0.1:0", "-semihosting-config", "enable=on,target=native"]
        try:
            command = emulate(board, program, serial)
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                process_group=0,  # Ctrl-C in a terminal is for the one that started it, who ends this
            )  # fmt: skip
        except ProblemError:
            self._line.close()
            raise
        self.close = weakref.finalize(self, _end, self._process, self._line)  # also when the interpreter ends
        try:
            self._wait(b"", NO_TICK)
        except ProblemError:
            self.close()
            raise

    def __enter__(self) -> NodeOnBoard:
        """Return it: it runs already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the emulator."""
        self.close()

    def step(self, tick: int, datagrams: Sequence[bytes] = (), measurement: Sequence[float] | None = None) -> Answer:
        """Have the node go through a tick.

        Args:
            tick: later than the last.
            datagrams: that have come since then, at most 8.
            measurement: of the plant, where the node measures.

        Raises:
            ProblemError: what does not fit into a frame, no answer in time, or the emulator has ended.
        """
        numbers = [float(value) for value in (() if measurement is None else measurement)]
        if not 0 <= tick < LAST or len(datagrams) > MOST_DATAGRAMS or len(numbers) > MOST_NUMBERS:
            raise ProblemError(
                f"tick {tick} comes with {len(datagrams)} datagrams and {len(numbers)} measurements; expected a tick "
                f"from 0 to 2^64 - 2, at most {MOST_DATAGRAMS} datagrams and at most {MOST_NUMBERS} measurements"
            )
        if any(len(one) > LARGEST for one in datagrams):
            raise ProblemError(f"a datagram has more than {LARGEST} bytes; expected those of the policy's nodes")
        body = struct.pack(">QB", tick, len(datagrams))
        body += b"".join(struct.pack(">H", len(one)) + one for one in datagrams)
        body += struct.pack(f">B{len(numbers)}d", len(numbers), *numbers)
        frame = struct.pack(">BH", BEGIN, len(body)) + body + struct.pack(">I", zlib.crc32(body))
        return _read(self._wait(frame, body[:8]))

    def _wait(self, frame: bytes, tick: bytes) -> bytes:
        """Send a frame, again and again if need be, and return the body of the answer that is of a tick."""
        end = time.monotonic() + self._patience
        asked = -AGAIN
        while (found := self._next()) is None or found[:8] != tick:  # of another: a question was repeated
            now = time.monotonic()
            if self._process.poll() is not None or now > end:
                raise ProblemError(self._sentence())
            if now - asked > AGAIN and self._board is not None:
                for first in range(0, len(frame), PIECE):
                    self._line.sendto(frame[first : first + PIECE], self._board)
                asked = now
            try:
                piece, self._board = self._line.recvfrom(1 << 16)
                self._bytes += piece
            except TimeoutError:
                pass
        return found

    def _next(self) -> bytes | None:
        """Return the body of the first whole frame among the bytes that have come; what is none is dropped."""
        while (first := self._bytes.find(BEGIN)) >= 0:
            del self._bytes[:first]
            if len(self._bytes) < 3:
                return None
            end = 3 + int.from_bytes(self._bytes[1:3], "big")
            if len(self._bytes) < end + 4:
                return None
            body, told = bytes(self._bytes[3:end]), int.from_bytes(self._bytes[end : end + 4], "big")
            if zlib.crc32(body) == told:
                del self._bytes[: end + 4]
                return body
            del self._bytes[0]
        self._bytes.clear()
        return None

    def _sentence(self) -> str:
        """Return why there is no answer."""
        if self._process.poll() is None:
            return f"the {self._name} has not answered for {self._patience:g} s; expected the program of a node"
        errors = self._process.stderr
        said = "" if errors is None or errors.closed else errors.read().decode(errors="replace")
        why = " ".join(said.split()) or f"code {self._process.returncode}"
        return f"the emulator of the {self._name} has ended ({why}); expected it to run"


def _end(process: subprocess.Popen[bytes], line: socket.socket) -> None:
    process.kill()
    process.wait()
    line.close()
    if process.stderr is not None:
        process.stderr.close()


def _read(body: bytes) -> Answer:
    """Return an answer as it stands in a frame."""
    flags, count = struct.unpack_from(">BB", body, 8)
    at, datagrams = 10, list[bytes]()
    for _ in range(count):
        size = int.from_bytes(body[at : at + 2], "big")
        datagrams.append(body[at + 2 : at + 2 + size])
        at += 2 + size
    numbers = struct.unpack_from(f">{body[at]}d", body, at + 1)
    applied = tuple(map(float, numbers)) if flags & HAS_INPUT else None
    return Answer(bool(flags & GONE_THROUGH), bool(flags & DEGRADED), tuple(datagrams), applied)
