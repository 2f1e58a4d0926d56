"""Processes that handle signals as in a new terminal, however the tests were started."""

from __future__ import annotations

import signal

from taciturn._process import ENDING


def in_a_terminal() -> None:
    """Restore the default handling of signals; ``nohup`` and scripts in the background pass ignored ones on."""
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL)
