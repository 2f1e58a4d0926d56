"""The threads of BLAS: on small matrices they wait for each other longer than they compute."""

from __future__ import annotations

import os

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def prefer_one_thread() -> None:
    """Ask for one thread where the user asks for no number; what has imported NumPy already keeps its threads."""
    for name in _THREADS:
        os.environ.setdefault(name, "1")
