"""Executors of many similar tasks: processes on this machine, workers of a dask cluster, or other executors.

``processes`` provides a pool of processes, ``answer_all`` the answers of any executor in the order of the tasks.
Workers run one thread each, end with their parent process, and answer only if they run the code of the process that
asks: each report contains version and digest of the sources, since another code may give other numbers (``Code``,
``Report``).
"""

from __future__ import annotations

import hashlib
import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context, parent_process, util
from multiprocessing.process import BaseProcess
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Generic, TypeVar, cast

import taciturn
from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import (
    Displayed,
    NoTimeLeft,
    Progress,
    at_once,
    check_time,
    deferred,
    number_of,
    prefer_one_thread,
    seconds_left,
)
from taciturn.program.machine import available_processors, one_thread

Answer = TypeVar("Answer")
PATIENCE = 5.0  # seconds in which workers must report their version after a task failed
Job = TypeVar("Job")
MOST_ON_WINDOWS = 61  # largest number of processes that Windows can wait for


@dataclass(frozen=True, repr=False)
class Code(Displayed):
    """The version of Taciturn in a process, and the digest of its source files."""

    version: str  # version of taciturn
    digest: str  # digest of the sources of the package


@dataclass(frozen=True, repr=False)
class Report(Displayed, Generic[Answer]):
    """A worker's answer to a task, with the worker's name and the version of its code."""

    worker: str  # machine and process
    code: Code  # code that the process runs
    answer: Answer | None  # the answer; None if the worker has other code than the process that asked


@contextmanager
def processes(workers: int | None) -> Generator[Executor | None]:
    """Provide a pool of worker processes; None for one worker, because this process then uses several threads."""
    if (workers := workers or available_processors()) == 1:
        yield None
        return
    prefer_one_thread()  # in the processes to come
    workers = min(workers, MOST_ON_WINDOWS) if sys.platform == "win32" else workers
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


def answer_all(
    executor: Executor | None, answer: Callable[[Job], Answer], jobs: Sequence[Job], progress: Progress
) -> list[Answer]:
    """Compute the answers to jobs, in the order of the jobs; the first exception ends the computation."""
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
            f"the executor failed after {len(found)} of {number_of(len(jobs), 'result')} ({error}); expected workers "
            "that stay alive and can import taciturn: use fewer workers, or none"
        ) from error
    except Exception as error:
        if executor is not None and not isinstance(error, TaciturnError | NoTimeLeft):
            refuse_other_versions(executor, workers_of(executor), error)
        raise
    finally:
        for future in futures:
            future.cancel()
    return found


def workers_of(executor: Executor) -> int:
    """Return how many tasks an executor runs in parallel, or an estimate."""
    for name in ("num_workers", "_max_workers"):  # mpi4py's; the standard library's
        known: Any = getattr(executor, name, None)
        if isinstance(known, int) and known > 0:
            return known
    client: Any = getattr(executor, "_client", None)  # dask's
    if client is not None:
        return max(1, sum(client.nthreads().values()))
    return available_processors()


def deserted(executor: Executor) -> str | None:
    """Return the address of the executor's dask scheduler if it has no workers; otherwise None."""
    client: Any = getattr(executor, "_client", None)
    return None if client is None or client.nthreads() else str(client.scheduler.address)


def asked(executor: Executor, ask: Callable[..., Answer], *given: Any) -> Future[Report[Answer]]:
    """Submit a task to a worker, which computes the answer only if its code is that of this process."""
    return executor.submit(_report, own_code(), ask, *given)


def accepted(report: Report[Answer]) -> Answer:
    """Return the answer in a worker's report; raise an error if the worker's code differs from this process's."""
    own = own_code()
    if report.code != own:
        raise ProblemError(_refusal(report.worker, report.code, own))
    return cast("Answer", report.answer)


@cache
def own_code() -> Code:
    """Return the version and the digest of this process's code; the files are read only once."""
    return code_of(Path(taciturn.__file__).parent.parent, taciturn.__version__)


def code_of(folder: Path, version: str) -> Code:
    """Return the given version with the digest of all Python files of the packages in a folder."""
    read = hashlib.sha256()
    for path in sorted(folder.glob("taciturn*/**/*.py"), key=lambda path: path.relative_to(folder).as_posix()):
        text = path.read_bytes().replace(b"\r\n", b"\n")  # as a checkout on Windows may have
        read.update(f"{path.relative_to(folder).as_posix()}\n{len(text)}\n".encode() + text)
    return Code(version, read.hexdigest())


def _report(expected: Code, ask: Callable[..., Answer], *given: Any) -> Report[Answer]:
    own = own_code()
    return Report(_place(), own, ask(*given) if own == expected else None)


def _place() -> str:
    return f"process {os.getpid()} on {platform.node() or 'this machine'}"


def _refusal(worker: str, code: Code, own: Code) -> str:
    if code.version != own.version:
        return (
            f"the worker ({worker}) runs taciturn {code.version}, and this process {own.version}; expected the same "
            f"version, so that all cells are computed alike: install taciturn {own.version} there, or omit this worker"
        )
    return (
        f"the worker ({worker}) runs taciturn {code.version} with the sources {code.digest:.12}, and this process the "
        f"sources {own.digest:.12}; expected the same code, so that all cells are computed alike: install the same "
        "build there, or omit this worker"
    )


def refuse_other_versions(executor: Executor, workers: int, error: BaseException | None = None) -> None:
    """Raise an error if the code of a worker differs from the code of this process.

    This is done on dask before the first task, because a worker of dask shuts down if it cannot import a task, and on
    any executor after a task failed. The question is a function of the standard library, so every version answers.
    """
    client: Any = getattr(executor, "_client", None)
    if client is None and error is None:
        return
    wanted, end = own_code().version, time.monotonic() + PATIENCE
    for worker, future in _ask_versions(executor, client, workers):
        try:
            found = str(future.result(max(0.0, end - time.monotonic())))
        except ImportError:
            raise ProblemError(
                f"the worker ({worker}) cannot import taciturn; expected taciturn {wanted} on every worker: install "
                "it there, or omit this worker"
            ) from error
        except Exception:  # the worker is gone or busy
            future.cancel()
        else:
            if found != wanted:
                raise ProblemError(_refusal(worker, Code(found, ""), own_code())) from error


def _ask_versions(executor: Executor, client: Any, workers: int) -> list[tuple[str, Future[Any]]]:
    """Return a future of the version for each worker, with its address on dask; other executors have no addresses."""
    version = resolve_name, "taciturn._version:__version__"
    try:
        if client is None:
            return [("one of them", executor.submit(*version)) for _ in range(workers)]
        return [(place, client.submit(*version, workers=[place], pure=False)) for place in client.nthreads()]
    except Exception:  # the executor is broken, and the first error is reported
        return []


def idle(fraction: float) -> None:
    """Ignore the progress."""


def _alone(answer: Callable[[Job], Answer], job: Job) -> Answer:
    with one_thread():
        return answer(job)


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
