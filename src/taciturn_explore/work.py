"""The worker processes that compute answers, and the queue of their jobs.

A *job* is the name of an answer with its arguments. First come the settings and points that have just been chosen, then
what is shown with them, then all others. Of equal jobs, those of the client with the least computing time so far are
next. The first worker keeps free of the other jobs, and as long as it is idle the others leave it those that are shown:
it has the caches of the last setting. A worker is busy until it has computed the ``first`` answers, by which the
library is loaded and programs are compiled.

A job that is no longer wanted leaves the queue; if it runs, the pool sends its worker a message, at which it stops when
the library next checks the time. A worker that does not stop in time is replaced. A worker that dies is replaced, and
its job fails with a sentence.

``Pool`` is used by threads; a job is a ``concurrent.futures.Future``.
"""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, TypeAlias

from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.extend import answered_within, watched
from taciturn_explore.setting import Trusted

GRACE = 5.0  # seconds in which a worker must stop after it was asked to: about what a new one needs on a busy machine
LIMIT = 30.0  # seconds of a job
PATIENCE = 0.02  # seconds between two looks at whether a running job is still wanted
LOOK = 0.005  # seconds between two looks of a worker at its messages
WORKERS = 2
AT_ONCE, SHOWN, LATER = range(3)  # ranks of jobs: settings and points, what is shown with them, and all others
REFUSED, UNSTABLE = "refused", "unstable"
ERRORS = {REFUSED: ProblemError, UNSTABLE: UnstableError}  # that a worker tells by their names
Asked: TypeAlias = tuple[str, tuple[Any, ...]]  # the name of an answer, and its arguments


class Stopped(Exception):  # noqa: N818
    """Exception that ends the computation of an answer because the answer is no longer needed."""


class EndedError(ProblemError):
    """Error raised for a job whose worker process has ended."""


class Job(Future[Any]):
    """A request for one answer, which a worker process computes."""

    def __init__(self, client: str, name: str, arguments: tuple[Any, ...], rank: int) -> None:
        """Store what to compute, and for whom."""
        super().__init__()
        self.client, self.name, self.arguments, self.rank = client, name, arguments, rank
        self.unwanted = False

    def drop(self) -> None:
        """Cancel the job, because its answer is no longer needed."""
        self.unwanted = True
        self.cancel()


class Pool:
    """Processes that compute answers."""

    def __init__(self, trusted: Trusted | None = None, workers: int = WORKERS, first: Sequence[Asked] = ()) -> None:
        """Start the processes."""
        self._trusted, self._first, self.workers = trusted, tuple(first), workers
        self._queue: list[Job] = []
        self._changed = threading.Condition()
        self._busy, self._closed = True, False  # of the first worker
        self.seconds: defaultdict[str, float] = defaultdict(float)  # computing time by client
        self.restarts = 0
        self._threads = [threading.Thread(target=self._serve, args=(i == 0,), daemon=True) for i in range(workers)]
        for thread in self._threads:
            thread.start()

    def submit(self, client: str, name: str, *arguments: Any, rank: int = LATER) -> Job:
        """Add a job to the queue."""
        job = Job(client, name, arguments, rank)
        with self._changed:
            if self._closed:
                raise ProblemError("the page has been closed; expected a page of a running `taciturn explore`")
            self._queue.append(job)
            self._changed.notify_all()
        return job

    def close(self) -> None:
        """Stop all workers."""
        with self._changed:
            self._closed = True
            for job in self._queue:
                job.drop()
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(timeout=2 * GRACE)

    def _next(self, first: bool) -> Job | None:
        """Return the next job for a worker, the first or another one; None after the pool was closed."""
        with self._changed:
            if first:
                self._busy = False
            while not self._closed:
                self._queue = [job for job in self._queue if not job.unwanted]
                fitting = [job for job in self._queue if self._suits(job, first)]
                if fitting:
                    job = min(fitting, key=lambda one: (one.rank, self.seconds[one.client]))
                    self._queue.remove(job)
                    if job.set_running_or_notify_cancel():
                        if first:
                            self._busy = True
                            self._changed.notify_all()
                        return job
                else:
                    self._changed.wait()
        return None

    def _suits(self, job: Job, first: bool) -> bool:
        """Return whether a job is for the first worker or for the other workers."""
        if first:
            return job.rank < LATER or self.workers == 1
        return job.rank == LATER or self._busy

    def _serve(self, first: bool) -> None:
        """Give jobs to one process, and replace it if it dies or does not stop."""
        worker = self._started()
        while True:
            job = self._next(first)
            if job is None:
                worker.end()
                return
            if not worker.alive:  # it has died between two jobs
                worker = self._instead(worker)
            began = time.monotonic()
            goes_on = worker.run(job, lambda: self._closed)
            with self._changed:
                self.seconds[job.client] += time.monotonic() - began
            if not goes_on:
                worker = self._instead(worker)

    def _started(self) -> _Worker:
        worker = _Worker(self._trusted, self._first)
        worker.wait(lambda: self._closed)
        return worker

    def _instead(self, worker: _Worker) -> _Worker:
        worker.end()
        self.restarts += 1
        return self._started()


class _Worker:
    """A process that computes answers one after the other."""

    def __init__(self, trusted: Trusted | None, first: Sequence[Asked]) -> None:
        """Start the process."""
        context = multiprocessing.get_context("spawn")
        self._there, here = context.Pipe()
        self._process = context.Process(target=compute, args=(here, trusted, first), daemon=True)
        self._process.start()
        here.close()
        self._number = 0

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.is_alive()

    def wait(self, closed: Callable[[], bool]) -> None:
        """Wait until the process has computed its first answers; if it dies, its first job reports the error."""
        with suppress(OSError, EOFError):
            while not closed():
                if self._there.poll(PATIENCE):
                    self._there.recv()
                    return

    def run(self, job: Job, closed: Callable[[], bool]) -> bool:
        """Let the worker process answer a job, and return whether this process can take further jobs."""
        self._number += 1
        asked: float | None = None
        try:
            self._there.send((self._number, job.name, job.arguments))
            while not self._there.poll(PATIENCE):
                if asked is None and (job.unwanted or closed()):
                    self._there.send((self._number, "", ()))
                    asked = time.monotonic()
                elif asked is not None and time.monotonic() > asked + GRACE:
                    job.set_exception(Stopped())
                    return False
            how, found = self._there.recv()
        except (OSError, EOFError, ValueError):
            job.set_exception(
                EndedError(
                    "the process that computed this answer has ended; expected enough memory: choose fewer steps, or "
                    "change the setting"
                )
            )
            return False
        if how == "answer":
            job.set_result(found)
        else:
            job.set_exception(Stopped() if how == "stopped" else ERRORS[how](found))
        return True

    def end(self) -> None:
        """End the process."""
        self._there.close()
        self._process.terminate()
        self._process.join(timeout=GRACE)
        if self._process.is_alive():
            self._process.kill()


def compute(there: Connection, trusted: Trusted | None, first: Sequence[Asked]) -> None:
    """Compute answers in a worker process until the connection is closed."""
    import signal

    from taciturn.extend import prefer_one_thread
    from taciturn.program.machine import one_thread
    from taciturn_explore.answers import Answers

    prefer_one_thread()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    answers = Answers(trusted)
    with suppress(EOFError, OSError), one_thread():
        for name, arguments in first:
            _answer(answers, there, 0, name, arguments)
        there.send("ready")
        while True:
            number, name, arguments = there.recv()
            if name:
                there.send(_answer(answers, there, number, name, arguments))


def _answer(answers: Any, there: Connection, number: int, name: str, arguments: tuple[Any, ...]) -> tuple[str, Any]:
    looked = time.monotonic()

    def stop() -> None:
        nonlocal looked
        if (now := time.monotonic()) - looked < LOOK:
            return
        looked = now
        if there.poll():
            stopped, _, _ = there.recv()
            if stopped == number:
                raise Stopped

    try:
        with answered_within(LIMIT), watched(stop):
            return "answer", answers.compute(name, arguments)
    except Stopped:
        return "stopped", None
    except TaciturnError as error:
        return UNSTABLE if isinstance(error, UnstableError) else REFUSED, str(error)
    except MemoryError:
        return REFUSED, "this needs more memory than there is; expected fewer steps, or a smaller problem"
    except Exception as error:  # a page must not end for one answer
        return REFUSED, f"this answer cannot be computed ({type(error).__name__}: {error}); expected another setting"
