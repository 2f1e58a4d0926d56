"""The precision of python-flint, a global of the process that only ``precision`` sets."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from threading import RLock

from flint import ctx

_LOCK = RLock()


@contextmanager
def precision(bits: int) -> Generator[None]:
    """Set the precision of python-flint; the one before is restored, and other threads wait."""
    with _LOCK:
        before, ctx.prec = ctx.prec, bits
        try:
            yield
        finally:
            ctx.prec = before
