"""Every run draws the same examples, so that a failure can be repeated."""

from __future__ import annotations

import os

import matplotlib as mpl
from hypothesis import settings

mpl.use("Agg")
os.environ.setdefault("MPLBACKEND", "Agg")  # for the examples, which run as processes
settings.register_profile("repeatable", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("repeatable")
