"""Starts processes of the command line as forks of one that has imported the library: none of them imports it again.

Each process that starts others has one launcher: this module, run as a program. It imports what nodes need, forks
whenever it is asked to, tells how each fork has ended, and ends with the process that asks. It has one thread and no
open files beside its own, so that a fork is as good as a new process.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import wait
from pathlib import Path
from types import FrameType
from typing import TypedDict

from taciturn.errors import ProblemError
from taciturn.runtime.namespaces import enter

IMPORTED = ("taciturn.cli", "taciturn.problem", "taciturn.runtime.serve")  # once, for all
_NUMBER = struct.Struct("=i")
_FILES = 4  # with a request: where it is read, standard output, standard error, where number and end are told


class Request(TypedDict):
    """What a fork is to be: arguments of ``taciturn``, variables, working folder, file of its network namespace."""

    arguments: list[str]
    environment: dict[str, str]
    folder: str
    namespace: str | None


class Fork:
    """A process of the command line.

    Args:
        arguments: of ``taciturn``.
        environment: all of its variables.
        namespace: file of the network namespace in which it runs; omitted: that of this process.

    Raises:
        ProblemError: the launcher does not run.
    """

    def __init__(self, arguments: Sequence[str], environment: Mapping[str, str], namespace: Path | None = None) -> None:
        """Start it."""
        request: Request = {
            "arguments": list(arguments),
            "environment": dict(environment),
            "folder": os.getcwd(),
            "namespace": None if namespace is None else str(namespace),
        }
        self._lock, self._code = threading.Lock(), None
        (asked, ask), (out, output), (errors, error) = os.pipe(), os.pipe(), os.pipe()
        self._told, told = socket.socketpair()
        self.stdout, self.stderr = (
            os.fdopen(out, encoding="utf-8"),
            os.fdopen(errors, encoding="utf-8", errors="replace"),
        )
        with open(ask, "w", encoding="utf-8") as written, told:
            try:
                _ask([asked, output, error, told.fileno()])
            finally:
                for descriptor in (asked, output, error):
                    os.close(descriptor)
            with suppress(BrokenPipeError):
                json.dump(request, written)
                written.flush()
        pid = self._hear()
        if pid is None:
            self.close()
            raise ProblemError("no process can be started, for the launcher has ended; expected it to run")
        self.pid = pid

    def poll(self) -> int | None:
        """Return its exit code, that of a signal negative, or None while it runs."""
        return self.wait(0.0)

    def wait(self, seconds: float | None = None) -> int | None:
        """Wait until it ends (omitted: however long), and return as ``poll`` does."""
        if self._code is None and wait([self._told], seconds):
            with self._lock:
                if self._code is None:
                    code = self._hear()
                    self._code = -signal.SIGKILL if code is None else code  # where the launcher itself was killed
        return self._code

    def send(self, number: int) -> None:
        """Send it a signal, if it runs."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def close(self) -> None:
        """Close what it told its end by, and both its streams."""
        for file in (self._told, self.stdout, self.stderr):
            file.close()

    def _hear(self) -> int | None:
        """Return the next number that the launcher tells, or None where it has ended."""
        with suppress(ConnectionError):
            if found := self._told.recv(_NUMBER.size, socket.MSG_WAITALL):
                return int(_NUMBER.unpack(found)[0])
        return None


class _Launcher:
    """The launcher of this process, from this side."""

    def __init__(self) -> None:
        """Start it."""
        self.owner = os.getpid()
        self.control, there = socket.socketpair()
        with there:
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__, str(there.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[there.fileno()],
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # a process of many threads must not fork
                process_group=0,  # Ctrl-C in a terminal is for the one that starts processes, who ends them
            )

    def close(self) -> None:
        """Let it end, which it does when nobody can ask any more."""
        self.control.close()
        if self.owner == os.getpid():
            self._process.wait()


_LOCK = threading.Lock()
_launcher: _Launcher | None = None


def _ask(files: Sequence[int]) -> None:
    """Ask the launcher for a fork; start it where there is none, or where it was killed."""
    global _launcher
    with _LOCK:
        for _ in range(2):
            if _launcher is None or _launcher.owner != os.getpid():
                _launcher = _Launcher()
                atexit.register(_launcher.close)
            with suppress(ConnectionError):
                socket.send_fds(_launcher.control, [b"."], list(files))
                return
            atexit.unregister(_launcher.close)
            _launcher.close()
            _launcher = None
    raise ProblemError("no process can be started, the launcher ends at once; expected it to run: see above")


def _serve(control: socket.socket) -> Request:
    """Fork on every request, and return it in the fork; the launcher itself ends with its owner."""
    running: dict[int, socket.socket] = {}

    def reap(*_: int | FrameType | None) -> None:
        while running:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if not pid:
                return
            with running.pop(pid) as told, suppress(OSError):
                told.sendall(_NUMBER.pack(os.waitstatus_to_exitcode(status)))

    signal.signal(signal.SIGCHLD, reap)
    while True:
        content, files, _, _ = socket.recv_fds(control, 1, _FILES)
        if not content:
            sys.exit()
        asked, output, error, told = files
        with open(asked, encoding="utf-8") as file:
            request = json.load(file)
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])  # until it is known whose end it is
        if not (pid := os.fork()):
            for descriptor, to in ((output, 1), (error, 2)):
                os.dup2(descriptor, to)
            for descriptor in (output, error, told):
                os.close(descriptor)
            for end in (control, *running.values()):
                end.close()
            return request
        running[pid] = socket.socket(fileno=told)
        with suppress(OSError):
            running[pid].sendall(_NUMBER.pack(pid))
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
        os.close(output)
        os.close(error)


def _become(request: Request) -> None:
    """Turn this fork into the process that was asked for."""
    os.setpgid(0, 0)  # Ctrl-C is not for it either
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    if request["namespace"] is not None:
        enter(Path(request["namespace"]))
    sys.argv = ["taciturn", *request["arguments"]]
    for name, buffering in (("stdout", -1), ("stderr", 1)):  # those of the launcher may be of files, which can seek
        before = getattr(sys, name)
        again = os.fdopen(before.fileno(), "w", buffering, before.encoding, before.errors, closefd=False)
        setattr(sys, name, again)


def main() -> None:
    """Be a launcher, or one of its forks."""
    for name in IMPORTED:
        importlib.import_module(name)
    gc.freeze()  # so that what is imported stays shared
    _become(_serve(socket.socket(fileno=int(sys.argv[1]))))
    importlib.import_module("taciturn.cli").main()


if __name__ == "__main__":
    main()
