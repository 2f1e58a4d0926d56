"""The one door to dask.distributed, with types; it is an extra."""

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
    """Give an executor on the workers of a dask scheduler; they need taciturn installed.

    Args:
        address: of the scheduler, as ``tcp://host:8786``.

    Raises:
        ProblemError: dask.distributed is missing, or no scheduler with workers answers there.
    """
    try:
        distributed: Any = import_module("distributed")
    except ImportError:
        raise ProblemError(
            "dask.distributed is not installed; expected it for --dask: pip install 'taciturn[dask]'"
        ) from None
    expected = "expected the address of a running one, as tcp://host:8786"
    for name in ["distributed", *filter(_is_dasks, logging.root.manager.loggerDict)]:  # some have levels of their own
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what goes wrong is told in one sentence
    try:
        addressing: Any = import_module("distributed.comm.addressing")
        scheme, place = addressing.parse_address(address)
        import_module("distributed.comm.registry").get_backend(scheme)
        addressing.parse_host_port(place)  # a client that was never made is closed with noise
        client: Any = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ProblemError(f"no dask scheduler answers at {address!r} ({type(error).__name__}); {expected}") from None
    with client:
        if not client.nthreads():
            raise ProblemError(f"the dask scheduler at {address!r} has no workers; expected at least one: start it")
        yield client.get_executor()


def _is_dasks(name: str) -> bool:
    return name.startswith("distributed.")
