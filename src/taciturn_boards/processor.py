"""Processor-in-the-loop tests: a node runs on an emulated board, and the host requests its steps over a serial port."""

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
from taciturn.extend import number_of
from taciturn_boards.cortex import EmulatedBoard, emulate

BEGIN = 0x54  # first byte of a frame: see board/loop.c
GONE_THROUGH, DEGRADED, HAS_INPUT = 1, 2, 4
NO_TICK = b"\xff" * 8
LAST = 2**64 - 1  # a number that no step has
MOST_DATAGRAMS, MOST_NUMBERS, LARGEST = 8, 255, 0xFFFF  # datagrams and numbers of a request; bytes of a datagram
AGAIN = 0.5  # seconds after which a request is repeated
PIECE = 1024  # bytes of a frame that are sent to the emulator at once
SPACE = 1 << 20  # size of the receive buffer in bytes


class StepResult(NamedTuple):
    """The result of one step of a node: the packets that it sends and the control input that it computes.

    Args:
        gone: whether the node executed the step; false if it is not later than the last step, or if a measurement is
            missing.
        degraded: whether an assumption of the policy's theory was violated.
        datagrams: datagrams that the node sends, in order.
        input: input of the plant, or None if the node does not apply one.
    """

    gone: bool
    degraded: bool
    datagrams: tuple[bytes, ...]
    input: tuple[float, ...] | None


class NodeOnBoard:
    """A node on an emulated board, which runs until the end of a ``with`` block.

    Args:
        board: the board.
        program: program from ``compile_for`` with ``in_the_loop(node)``.
        patience: time limit for the start and for each answer, in seconds.

    Raises:
        ProblemError: the emulator is missing, or the program does not start in time.
    """

    def __init__(self, board: EmulatedBoard, program: Path, patience: float = 30.0) -> None:
        """Start the emulator, and wait until the node reports that it listens."""
        self._name, self._patience = board.processor, patience
        self._bytes = bytearray()
        self._line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SPACE)
        self._line.bind(("127.0.0.1", 0))
        self._line.settimeout(AGAIN)
        self._board: tuple[str, int] | None = None  # address of the board, known after the first datagram
        port = self._line.getsockname()[1]
        serial = ["-serial", f"udp:127.0.0.1:{port}@127.0.0.1:0", "-semihosting-config", "enable=on,target=native"]
        try:
            command = emulate(board, program, serial)
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                process_group=0,  # Ctrl-C in a terminal must reach only this process, which ends the emulator
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
        """Return the node, which already runs."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the emulator."""
        self.close()

    def step(
        self, tick: int, datagrams: Sequence[bytes] = (), measurement: Sequence[float] | None = None
    ) -> StepResult:
        """Make the node on the board execute one step, and return its packets and its control input.

        Args:
            tick: number of the step, larger than that of the last step.
            datagrams: at most 8 datagrams that arrived since the last step.
            measurement: measurement of the plant, if the node measures.

        Raises:
            ProblemError: the request does not fit into a frame, no answer arrives in time, or the emulator has ended.
        """
        numbers = [float(value) for value in (() if measurement is None else measurement)]
        if not 0 <= tick < LAST or len(datagrams) > MOST_DATAGRAMS or len(numbers) > MOST_NUMBERS:
            raise ProblemError(
                f"step {tick} is given with {number_of(len(datagrams), 'datagram')} and "
                f"{number_of(len(numbers), 'measurement')}; expected a "
                f"step from 0 to 2^64 - 2, at most {MOST_DATAGRAMS} datagrams and at most {MOST_NUMBERS} measurements"
            )
        if any(len(one) > LARGEST for one in datagrams):
            raise ProblemError(f"a datagram has {max(map(len, datagrams))} bytes; expected at most {LARGEST} bytes")
        body = struct.pack(">QB", tick, len(datagrams))
        body += b"".join(struct.pack(">H", len(one)) + one for one in datagrams)
        body += struct.pack(f">B{len(numbers)}d", len(numbers), *numbers)
        frame = struct.pack(">BH", BEGIN, len(body)) + body + struct.pack(">I", zlib.crc32(body))
        return _read(self._wait(frame, body[:8]))

    def _wait(self, frame: bytes, tick: bytes) -> bytes:
        """Send a frame, repeatedly if necessary, and return the body of the answer for the given step."""
        end = time.monotonic() + self._patience
        asked = -AGAIN
        while (found := self._next()) is None or found[:8] != tick:  # of a repeated request
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
        """Return the body of the first complete frame among the received bytes; invalid bytes are dropped."""
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
        """Return the error message for a missing answer."""
        if self._process.poll() is None:
            return f"the {self._name} has not answered for {self._patience:g} s; expected a board that runs a node"
        errors = self._process.stderr
        said = "" if errors is None or errors.closed else errors.read().decode(errors="replace")
        why = " ".join(said.split()) or f"code {self._process.returncode}"
        return f"the emulator of the {self._name} has ended ({why}); expected it to keep running"


def _end(process: subprocess.Popen[bytes], line: socket.socket) -> None:
    process.kill()
    process.wait()
    line.close()
    if process.stderr is not None:
        process.stderr.close()


def _read(body: bytes) -> StepResult:
    """Return the answer that the body of a frame contains."""
    flags, count = struct.unpack_from(">BB", body, 8)
    at, datagrams = 10, list[bytes]()
    for _ in range(count):
        size = int.from_bytes(body[at : at + 2], "big")
        datagrams.append(body[at + 2 : at + 2 + size])
        at += 2 + size
    numbers = struct.unpack_from(f">{body[at]}d", body, at + 1)
    applied = tuple(map(float, numbers)) if flags & HAS_INPUT else None
    return StepResult(bool(flags & GONE_THROUGH), bool(flags & DEGRADED), tuple(datagrams), applied)
