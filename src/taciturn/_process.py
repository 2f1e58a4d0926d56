"""Handling of the signals that end a process, such as Ctrl-C, in all commands. Also sets the number of BLAS threads.

The first signal raises ``Interrupted`` in the main thread, or stops a server (``until_stopped``). A thread waits for
signals too. It ends the process if the main thread has not done so after a grace period, for example because compiled
code is running, and it ends the process at once on a second signal. Exit codes are 128 + signal, as in a shell.

For small matrices one thread of BLAS is fastest (``prefer_one_thread``).
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn

# signals that end a process: SIGINT (Ctrl-C), on POSIX SIGTERM and SIGHUP (the terminal closes), on Windows SIGBREAK
ENDING = tuple(signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name))
GRACE = "TACITURN_GRACE"  # environment variable with the grace period in seconds
_USUAL_GRACE = 1.2  # seconds, so that with the last calls every command ends within 2 s
LIFELINE = "TACITURN_LIFELINE"  # environment variable of a process that ends when its standard input ends
ENDED = "ended by"  # text of the line about a signal other than Ctrl-C
_LAST = 0.6  # seconds that the last calls, and the output so far, may take when the process is ended at once
_present: Ending | None = None  # of the command that runs in this process
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class Interrupted(KeyboardInterrupt):
    """Raised in the main thread when a signal, such as Ctrl-C, asks this process to end."""


class Ending:
    """Handler of the signals that end this process, such as Ctrl-C. It stores the signal that has arrived."""

    def __init__(self) -> None:
        """Start without a signal."""
        self.number: signal.Signals | None = None
        self.serves = 0  # number of servers that stop by themselves
        self.remarks: list[str] = []
        self.last: list[Callable[[], object]] = []
        self.raises = True  # on the first signal, and until the block ends
        self._told = threading.Lock()

    def hear(self, number: int, _frame: FrameType | None = None) -> None:
        """Handle a signal in the main thread: store it, and raise ``Interrupted`` if it is the first signal."""
        raises, self.raises = self.raises and not self.serves, False
        self._note(number)
        if raises:
            raise Interrupted

    def watch(self, pipe: int) -> None:
        """Wait in a second thread for a signal. End the process if the main thread does not react in time."""
        if (number := _next_ending(pipe)) is None:
            os.close(pipe)
            return
        self._note(number)
        limit = threading.Timer(_grace(), self._end_at_once, (number,))
        limit.daemon = True
        limit.start()
        self._end_at_once(_next_ending(pipe) or number)

    def finish(self) -> None:
        """End the process if a signal has arrived. This is called last, so that a second signal is still handled."""
        if self.number is not None:
            for stream in (sys.stdout, sys.stderr):
                _try(stream.flush)
            os._exit(128 + self.number)

    def _note(self, number: int) -> None:
        """Record the first signal; from now on, no thread prints a warning or a traceback about unfinished tasks."""
        if self.number is None:
            self.number = signal.Signals(number)
            warnings.filterwarnings("ignore")
            sys.unraisablehook = threading.excepthook = _ignore

    def _end_at_once(self, number: int) -> NoReturn:
        end = time.monotonic() + _LAST
        calls = [threading.Thread(target=_try, args=(call,), daemon=True) for call in (*reversed(self.last), self.tell)]
        calls.append(threading.Thread(target=_try, args=(sys.stdout.flush,), daemon=True))
        for call in calls:  # in order, unless one blocks
            call.start()
            call.join(_LAST / 4)
        for call in calls:
            call.join(max(0.0, end - time.monotonic()))
        os._exit(128 + number)

    def tell(self) -> None:
        """Print the line about the signal to standard error, but only once."""
        if self.number is not None and self._told.acquire(blocking=False):
            how = "interrupted" if self.number == signal.SIGINT else f"{ENDED} {self.number.name}"
            with suppress(OSError, ValueError):
                start = "\n" if sys.stderr.isatty() else ""  # after the ^C that a terminal shows
                print(start + "; ".join([f"taciturn: {how}", *self.remarks]), file=sys.stderr, flush=True)


@contextmanager
def ends_on_signals() -> Generator[Ending]:
    """While the block runs, a signal ends this process with one line of text and the exit code 128 + signal number."""
    # An inner block uses the outer one. A signal that the process ignored before, as SIGHUP under ``nohup``, stays
    # ignored.
    global _present
    if _present is not None or threading.current_thread() is not threading.main_thread():
        yield _present or Ending()
        return
    _present = ending = Ending()
    atexit.register(ending.finish)  # the first one that is registered is called last
    receives, sends = os.pipe()
    if sys.platform != "win32":  # where it is not needed
        os.set_blocking(sends, False)
    handlers = {number: signal.getsignal(number) for number in ENDING}
    before = {number: handler for number, handler in handlers.items() if handler is not signal.SIG_IGN}
    before_fd = signal.set_wakeup_fd(sends, warn_on_full_buffer=False)
    threading.Thread(target=ending.watch, args=(receives,), name="ending", daemon=True).start()
    if LIFELINE in os.environ:  # and not in the processes that this one starts
        del os.environ[LIFELINE]
        threading.Thread(target=_follow_parent, name="lifeline", daemon=True).start()
    try:
        try:
            for number in before:
                signal.signal(number, ending.hear)
            yield ending
        finally:
            ending.raises = False
    except BaseException:
        if ending.number is None:
            raise
    finally:
        _present = None
        if ending.number is None:  # otherwise the thread ensures that the interpreter ends, too
            signal.set_wakeup_fd(before_fd)
            for number, handler in before.items():
                signal.signal(number, handler)
            os.close(sends)
            atexit.unregister(ending.finish)
    if ending.number is not None:
        ending.tell()
        sys.exit(128 + ending.number)


def has_ended() -> bool:
    """Check whether a signal that ends this process has arrived."""
    return _present is not None and _present.number is not None


@contextmanager
def until_stopped() -> Generator[Callable[[], bool]]:
    """Yield a function that returns whether a signal has arrived. With it, a server stops its loop and prints its
    report.
    """
    with ends_on_signals() as ending:
        ending.serves += 1
        ignored = _main() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        if ignored:  # a server in the background of a script, where shells ignore Ctrl-C, stops on request
            signal.signal(signal.SIGINT, ending.hear)
        try:
            yield lambda: ending.number is not None
        finally:
            ending.serves -= 1
            if ignored:
                signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def remark(text: str) -> Generator[None]:
    """While the block runs, add ``text`` to the line that a signal prints, such as where results are stored."""
    if _present is None:
        yield
        return
    remarks = _present.remarks
    remarks.append(text)
    yield
    remarks.remove(text)  # after an exception, the text is still to be printed


@contextmanager
def at_once(call: Callable[[], object]) -> Generator[None]:
    """While the block runs, call ``call`` if a signal ends the process at once, for example to end child processes."""
    last = [] if _present is None else _present.last
    last.append(call)
    try:
        yield
    finally:
        last.remove(call)


@contextmanager
def deferred() -> Generator[None]:
    """Handle signals only after the block. Child processes that start in the block ignore SIGINT and SIGHUP."""
    if not _main():
        yield
        return
    heard: list[tuple[int, FrameType | None]] = []

    def hear(number: int, frame: FrameType | None) -> None:
        heard.append((number, frame))

    handled = [number for number in ENDING if callable(signal.getsignal(number))]
    before: dict[Any, Any] = {number: signal.signal(number, hear) for number in handled}
    mask = None
    if sys.platform != "win32" and hasattr(signal, "pthread_sigmask"):  # Windows cannot block a signal
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        if sys.platform != "win32" and mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in before.items():
            signal.signal(number, handler)
        for number, frame in heard[:1]:
            before[number](number, frame)


def _next_ending(pipe: int) -> int | None:
    """Return the number of the next signal of ``ENDING``, or None if the other end of the pipe is closed."""
    while found := os.read(pipe, 1):
        if found[0] in ENDING:
            return found[0]
    return None


def _follow_parent() -> None:
    """End this process when the parent process, which holds the other end of standard input, has ended."""
    with suppress(OSError):
        while os.read(0, 1):
            pass
    os.kill(os.getpid(), signal.SIGTERM)


def _grace() -> float:
    """Return the grace period of this process in seconds."""
    try:
        return max(0.0, float(os.environ.get(GRACE, _USUAL_GRACE)))
    except ValueError:
        return _USUAL_GRACE


def _main() -> bool:
    return threading.current_thread() is threading.main_thread()


def _try(call: Callable[[], object]) -> None:
    with suppress(Exception):
        call()


def _ignore(_: object) -> None:
    """Print nothing."""


def prefer_one_thread() -> None:
    """Set the number of BLAS threads to one unless the user has set it. Call this before NumPy is imported."""
    for name in _THREADS:
        os.environ.setdefault(name, "1")
