"""The network of a setting: its links, and a long simulated path from which each link's packet intervals are counted.

A histogram counts the intervals of one, two, three … steps; its last bar contains all longer ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from taciturn_explore.disturbed import run_path
from taciturn_explore.plane import Designed
from taciturn_explore.setting import Setting

LENGTH = 6000  # steps of the path
BARS = 32  # of a histogram
COVERED = 0.99  # share of the intervals that have a bar of their own


def network(setting: Setting, given: Designed) -> dict[str, Any]:
    """Return the nodes with their links, and for each link the histogram of the intervals between its packets."""
    path = run_path(given.loop, LENGTH, setting.seed)
    graph = given.loop.policy.network
    return {
        "controller": graph.controller,
        "links": [
            {
                "link": link,
                "sender": graph.sender(link),
                "receiver": graph.receiver(link),
                "loss": graph.loss(link) if link in graph.links else 0.0,
                "delay": "; ".join(graph.links[link].lateness()) if link in graph.links else "",
                **histogram(np.diff(np.flatnonzero(sent))),
            }
            for link, sent in path.sent.items()
        ],
    }


def histogram(intervals: Any) -> dict[str, Any]:
    """Return which fractions of the intervals last 1, 2, 3, … steps, and the longest interval."""
    if not len(intervals):
        return {"bars": [], "longest": None}
    last = int(min(BARS, max(2, np.quantile(intervals, COVERED))))
    bars = np.bincount(np.minimum(intervals, last + 1), minlength=last + 2)[1:]
    return {"bars": (bars / len(intervals)).tolist(), "longest": int(intervals.max())}
