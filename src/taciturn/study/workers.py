"""Where many like tasks run: processes of this machine, the workers of a dask cluster, or any other executor."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from taciturn._blas import prefer_one_thread
from taciturn._progress import Progress
from taciturn.errors import ProblemError
from taciturn.program.machine import available_processors, one_thread

Job = TypeVar("Job")
Answer = TypeVar("Answer")

MOST_OF_WINDOWS = 61  # processes that one can wait for there


def workers_of(executor: Executor) -> int:
    """Return how many tasks an executor runs at a time, as far as it tells."""
    for name in ("num_workers", "_max_workers"):  # mpi4py's; the standard library's
        known: Any = getattr(executor, name, None)
        if isinstance(known, int) and known > 0:
            return known
    client: Any = getattr(executor, "_client", None)  # dask's
    if client is not None:
        return max(1, sum(client.nthreads().values()))
    return available_processors()


def deserted(executor: Executor) -> str | None:
    """Return the address of an executor's dask scheduler if that has no workers, else None."""
    client: Any = getattr(executor, "_client", None)
    return None if client is None or client.nthreads() else str(client.scheduler.address)


def idle(fraction: float) -> None:
    """Tell nobody of progress."""


def answer_all(
    executor: Executor | None, answer: Callable[[Job], Answer], jobs: Sequence[Job], progress: Progress
) -> list[Answer]:
    """Return the answers to some jobs, in their order; the first that raises ends it all.

    Args:
        executor: answers each job on one thread; None: here, one after the other, on all processors.
        answer: a function of a module, for executors of other processes.
        jobs: what it is called with.
        progress: called with the fraction answered.

    Raises:
        ProblemError: the executor fails.
    """
    found: list[Answer] = []
    futures = [] if executor is None else [executor.submit(_alone, answer, job) for job in jobs]
    try:
        for k, job in enumerate(jobs):
            found.append(futures[k].result() if futures else answer(job))
            progress((k + 1) / len(jobs))
    except BrokenExecutor as error:
        raise ProblemError(
            f"the executor failed after {len(found)} of {len(jobs)} answers ({error}); expected workers that live and "
            "can import taciturn: use fewer, or none"
        ) from error
    finally:
        for future in futures:
            future.cancel()
    return found


def _alone(answer: Callable[[Job], Answer], job: Job) -> Answer:
    with one_thread():
        return answer(job)


@contextmanager
def processes(workers: int | None) -> Generator[Executor | None]:
    """Give a pool of so many processes (None: one for each processor), or nothing for one: its threads serve then."""
    if (workers := workers or available_processors()) == 1:
        yield None
        return
    prefer_one_thread()  # in the processes to come
    workers = min(workers, MOST_OF_WINDOWS) if sys.platform == "win32" else workers
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _be_a_worker)
    try:
        with _uninterrupted():
            for _ in range(workers):
                pool.submit(abs, 0)  # each starts a process
        yield pool
    finally:  # without cancelling, work whose submission Ctrl-C has cut in two would be waited for
        pool.shutdown(cancel_futures=True)


@contextmanager
def _uninterrupted() -> Generator[None]:
    """Ignore Ctrl-C, as processes do that are started meanwhile; only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _be_a_worker() -> None:
    """Leave Ctrl-C to the process that started this one, and end when that is gone, killed perhaps."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # not inherited on Windows

    def watch(parent: BaseProcess) -> None:
        parent.join()
        os._exit(1)

    parent = parent_process()
    assert parent is not None
    threading.Thread(target=watch, args=(parent,), daemon=True).start()
