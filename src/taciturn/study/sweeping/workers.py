"""Executors for many similar tasks: processes of this machine, workers of a dask cluster, or any other executor."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing import get_context, parent_process, util
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from taciturn._blas import prefer_one_thread
from taciturn._ending import at_once, deferred
from taciturn._progress import NoTimeLeft, Progress, check_time, seconds_left
from taciturn.errors import ProblemError, TaciturnError
from taciturn.program.machine import available_processors, one_thread
from taciturn.study.sweeping.identity import accepted, asked, refuse_other_versions

Job = TypeVar("Job")
Answer = TypeVar("Answer")

MOST_OF_WINDOWS = 61  # largest number of processes that Windows can wait for


def workers_of(executor: Executor) -> int:
    """Return the number of tasks that an executor runs at a time, as far as it is known."""
    for name in ("num_workers", "_max_workers"):  # mpi4py's; the standard library's
        known: Any = getattr(executor, name, None)
        if isinstance(known, int) and known > 0:
            return known
    client: Any = getattr(executor, "_client", None)  # dask's
    if client is not None:
        return max(1, sum(client.nthreads().values()))
    return available_processors()


def deserted(executor: Executor) -> str | None:
    """Return the address of an executor's dask scheduler if this scheduler has no workers, else None."""
    client: Any = getattr(executor, "_client", None)
    return None if client is None or client.nthreads() else str(client.scheduler.address)


def idle(fraction: float) -> None:
    """Ignore the progress."""


def answer_all(
    executor: Executor | None, answer: Callable[[Job], Answer], jobs: Sequence[Job], progress: Progress
) -> list[Answer]:
    """Return the answers to some jobs, in their order; the first exception ends the computation.

    Args:
        executor: executor that answers each job on one thread; None to answer one job after the other in this process,
            on all processors.
        answer: a module-level function, so that executors of other processes can import it.
        jobs: the arguments of the function, one for each call.
        progress: callback that receives the fraction answered.

    Raises:
        ProblemError: the executor fails, or a worker runs another version of this package.
    """
    found: list[Answer] = []
    if executor is not None:
        refuse_other_versions(executor, workers_of(executor))
    futures = [] if executor is None else [asked(executor, _alone, answer, job) for job in jobs]
    try:
        for k, job in enumerate(jobs):
            if futures:
                wait(futures[k : k + 1], timeout=min(seconds_left(), threading.TIMEOUT_MAX))
            check_time()
            found.append(accepted(futures[k].result()) if futures else answer(job))
            progress((k + 1) / len(jobs))
    except BrokenExecutor as error:
        raise ProblemError(
            f"the executor failed after {len(found)} of {len(jobs)} answers ({error}); expected workers that stay "
            "alive and can import taciturn: use fewer workers, or none"
        ) from error
    except Exception as error:
        if executor is not None and not isinstance(error, TaciturnError | NoTimeLeft):
            refuse_other_versions(executor, workers_of(executor), error)
        raise
    finally:
        for future in futures:
            future.cancel()
    return found


def _alone(answer: Callable[[Job], Answer], job: Job) -> Answer:
    with one_thread():
        return answer(job)


@contextmanager
def processes(workers: int | None) -> Generator[Executor | None]:
    """Provide a pool of worker processes, or None for one worker, because this process then uses its threads."""
    if (workers := workers or available_processors()) == 1:
        yield None
        return
    prefer_one_thread()  # in the processes to come
    workers = min(workers, MOST_OF_WINDOWS) if sys.platform == "win32" else workers
    with deferred():  # it starts a process that counts semaphores
        pool = ProcessPoolExecutor(workers, get_context("spawn"), _be_a_worker)
    with at_once(lambda: _abandon(pool)):
        try:
            with deferred():
                for _ in range(workers):
                    pool.submit(abs, 0)  # each starts a process
            yield pool
        except BaseException:  # the answers to come are not used
            _kill(pool)
            raise
        finally:  # without cancelling, shutdown would wait for a submission that Ctrl-C interrupted
            pool.shutdown(cancel_futures=True)


def _kill(pool: ProcessPoolExecutor) -> None:
    """End the processes of a pool, which would otherwise complete the tasks that they have begun."""
    running: dict[int, BaseProcess] | None = getattr(pool, "_processes", None)  # kill_workers() since Python 3.14
    for process in list((running or {}).values()):
        process.kill()


def _abandon(pool: ProcessPoolExecutor) -> None:
    """End the processes of a pool, and remove its semaphores, about which Python would print a warning."""
    _kill(pool)
    finalizers: Any = util
    finalizers._run_finalizers(0)  # the semaphores; the interpreter calls it when it ends


def _be_a_worker() -> None:
    """Ignore Ctrl-C, which the parent process handles, and exit when the parent process has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # not inherited on Windows

    def watch(parent: BaseProcess) -> None:
        parent.join()
        os._exit(1)

    parent = parent_process()
    assert parent is not None
    threading.Thread(target=watch, args=(parent,), daemon=True).start()
