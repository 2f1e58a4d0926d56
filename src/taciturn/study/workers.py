"""Where the cells of a sweep run: processes of this machine, the workers of a dask cluster, or any other executor."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Generator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess
from typing import Any

from taciturn.program.machine import available_processors


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


@contextmanager
def processes(workers: int | None) -> Generator[Executor | None]:
    """Give a pool of so many processes (None: one for each processor), or nothing for one: its threads serve then."""
    if (workers := workers or available_processors()) == 1:
        yield None
        return
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # read where numpy is imported, by the processes to come
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _end_with_parent)
    try:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # inherited: Ctrl-C is this process's alone
        try:
            for _ in range(workers):
                pool.submit(abs, 0)  # each starts a process
        finally:
            signal.signal(signal.SIGINT, before)
        yield pool
    finally:  # without cancelling, work whose submission Ctrl-C has cut in two would be waited for
        pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """End this process when the one that started it is gone, killed perhaps, which a queue does not tell."""

    def watch(parent: BaseProcess) -> None:
        parent.join()
        os._exit(1)

    parent = parent_process()
    assert parent is not None
    threading.Thread(target=watch, args=(parent,), daemon=True).start()
