"""The catalogue: the design function of every policy kind. A new policy is one file and one line here."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from taciturn.design.consistent import consistent
from taciturn.design.integral import integral
from taciturn.design.lossy_lqg import lossy_lqg
from taciturn.design.lqg import lqg
from taciturn.design.periodic import all_time, periodic
from taciturn.design.remote_lqg import remote_lqg
from taciturn.model.policy import Policy
from taciturn.renewal.policy import EventPolicy

CATALOGUE: Mapping[str, Callable[..., Policy | EventPolicy]] = {
    "all-time": all_time,
    "periodic": periodic,
    "lqg": lqg,
    "remote-lqg": remote_lqg,
    "lossy-lqg": lossy_lqg,
    "integral": integral,
    "consistent": consistent,
}
