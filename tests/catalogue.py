"""Every policy once: what is listed here is enrolled in every law that applies to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from systems import System

from taciturn import Policy, design

POLICIES: Mapping[str, Callable[[System], Policy]] = {
    "all-time": lambda s: design.all_time(s.plant, s.cost),
    "periodic hold": lambda s: design.periodic(s.plant, s.cost, every=2),
    "periodic model": lambda s: design.periodic(s.plant, s.cost, every=3, actuation="model"),
    "lqg joint hold": lambda s: design.lqg(s.plant, s.cost, theta=0.3),
    "lqg joint model": lambda s: design.lqg(s.plant, s.cost, theta=0.3, actuation="model"),
    "lqg separate hold": lambda s: design.lqg(s.plant, s.cost, theta=0.3, trigger="separate"),
    "lqg separate model": lambda s: design.lqg(s.plant, s.cost, theta=0.3, trigger="separate", actuation="model"),
}
GUARANTEED = tuple(name for name in POLICIES if name.startswith("lqg"))
CLOSED_FORM = tuple(name for name in POLICIES if name not in GUARANTEED)
