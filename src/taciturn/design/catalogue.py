"""The catalogue: the design function of every policy kind. A new policy is one file and one line here."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from taciturn.design.absolute import absolute
from taciturn.design.consistent import consistent
from taciturn.design.downsampled import downsampled
from taciturn.design.dynamic import dynamic
from taciturn.design.integral import integral
from taciturn.design.lossy_lqg import lossy_lqg
from taciturn.design.lqg import lqg
from taciturn.design.mixed import mixed
from taciturn.design.periodic import all_time, periodic
from taciturn.design.periodic_schedule import periodic_schedule
from taciturn.design.relative import relative
from taciturn.design.remote_lqg import remote_lqg
from taciturn.design.rollout import rollout
from taciturn.design.self_triggered import self_triggered
from taciturn.design.send_on_delta import send_on_delta
from taciturn.design.stochastic import stochastic
from taciturn.design.variance import variance
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
    "absolute": absolute,
    "relative": relative,
    "mixed": mixed,
    "dynamic": dynamic,
    "send-on-delta": send_on_delta,
    "variance": variance,
    "rollout": rollout,
    "self-triggered": self_triggered,
    "stochastic": stochastic,
    "periodic-schedule": periodic_schedule,
    "downsampled": downsampled,
}
