"""Number of threads that BLAS uses; for small matrices, one thread is fastest."""

from __future__ import annotations

import os

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def prefer_one_thread() -> None:
    """Set one BLAS thread unless the user has set a number; NumPy reads this setting once, at its import."""
    for name in _THREADS:
        os.environ.setdefault(name, "1")
