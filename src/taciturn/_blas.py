"""The number of threads that BLAS uses. On small matrices its threads wait longer than they compute."""

from __future__ import annotations

import os

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def prefer_one_thread() -> None:
    """Set one thread, unless the user has set a number. NumPy reads this once, when it is imported."""
    for name in _THREADS:
        os.environ.setdefault(name, "1")
