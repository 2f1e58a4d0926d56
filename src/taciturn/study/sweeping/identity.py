"""Version and code of the workers that answer tasks; answers of workers with other code are refused."""

from __future__ import annotations

import hashlib
import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Generic, TypeVar, cast

from taciturn import _version
from taciturn._display import Displayed
from taciturn.errors import ProblemError

Answer = TypeVar("Answer")

PATIENCE = 5.0  # seconds in which workers must report their version after a task failed


@dataclass(frozen=True, repr=False)
class Code(Displayed):
    """The version of taciturn that a process runs, and the digest of its sources.

    Args:
        version: version of taciturn.
        digest: digest of the sources of the package.
    """

    version: str
    digest: str


@dataclass(frozen=True, repr=False)
class Report(Displayed, Generic[Answer]):
    """The answer of a worker to a task, with the name of the worker and its code.

    Args:
        worker: machine and process.
        code: code that the process runs.
        answer: the answer; None if the worker has other code than the process that asked.
    """

    worker: str
    code: Code
    answer: Answer | None


def code_of(folder: Path, version: str) -> Code:
    """Return the version of a package and a digest of the names and texts of all its Python files."""
    read = hashlib.sha256()
    for path in sorted(folder.rglob("*.py"), key=lambda path: path.relative_to(folder).as_posix()):
        text = path.read_bytes().replace(b"\r\n", b"\n")  # as a checkout on Windows may have
        read.update(f"{path.relative_to(folder).as_posix()}\n{len(text)}\n".encode() + text)
    return Code(version, read.hexdigest())


@cache
def own_code() -> Code:
    """Return version and digest of the code of this process, which is read once."""
    return code_of(Path(_version.__file__).parent, _version.__version__)


def asked(executor: Executor, ask: Callable[..., Answer], *given: Any) -> Future[Report[Answer]]:
    """Submit a task to a worker, which reports its code and computes the answer only if both codes are equal.

    Args:
        executor: executor of this or of other processes.
        ask: a module-level function.
        given: its arguments.
    """
    return executor.submit(_report, own_code(), ask, *given)


def _report(expected: Code, ask: Callable[..., Answer], *given: Any) -> Report[Answer]:
    own = own_code()
    return Report(_place(), own, ask(*given) if own == expected else None)


def _place() -> str:
    return f"process {os.getpid()} on {platform.node() or 'this machine'}"


def accepted(report: Report[Answer]) -> Answer:
    """Return the answer in the report of a worker, if the worker runs the same code as this process.

    Raises:
        ProblemError: the worker runs another version, or other code of the same version.
    """
    own = own_code()
    if report.code != own:
        raise ProblemError(_refusal(report.worker, report.code, own))
    return cast("Answer", report.answer)


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
    """Raise an error if a worker runs another version of taciturn than this process.

    This is done on dask before the first task, because a worker of dask shuts down if it cannot import a task, and on
    any executor after a task failed. The question is a function of the standard library, so every version answers.

    Args:
        executor: executor of this or of other processes.
        workers: number of questions; on dask one for each worker of the scheduler instead.
        error: exception of the failed task; None before the first task.

    Raises:
        ProblemError: a worker runs another version, or has no taciturn.
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
