"""Typed interface to dask.distributed, an optional dependency."""

from __future__ import annotations

import logging
from collections.abc import Generator
from concurrent.futures import Executor
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from taciturn.errors import ProblemError

PATIENCE = 5.0  # seconds


@contextmanager
def dask_workers(address: str) -> Generator[Executor]:
    """Provide an executor on the workers of a dask scheduler; each worker needs an installed Taciturn."""
    try:
        distributed: Any = import_module("distributed")
    except ImportError:
        raise ProblemError(
            "dask.distributed is not installed, but --dask requires it: pip install 'taciturn[dask]'"
        ) from None
    expected = "expected the address of a running scheduler, such as tcp://host:8786"
    for name in [
        "distributed",
        *filter(_is_dasks, logging.root.manager.loggerDict),
    ]:  # some set their own level
        logging.getLogger(name).setLevel(logging.CRITICAL)  # failures are reported by a single exception
    try:
        addressing: Any = import_module("distributed.comm.addressing")
        scheme, place = addressing.parse_address(address)
        import_module("distributed.comm.registry").get_backend(scheme)
        addressing.parse_host_port(place)  # dask logs an error when a failed client is closed
        client: Any = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ProblemError(f"no dask scheduler answers at {address!r} ({type(error).__name__}); {expected}") from None
    with client:
        if not client.nthreads():
            raise ProblemError(f"the dask scheduler at {address!r} has no workers; expected at least one worker")
        yield client.get_executor()


def _is_dasks(name: str) -> bool:
    return name.startswith("distributed.")
