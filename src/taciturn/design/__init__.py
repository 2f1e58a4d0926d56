"""Policies, one family per file; each carries its guarantee."""

from taciturn.design.absolute import absolute
from taciturn.design.consistent import consistent
from taciturn.design.downsampled import downsampled
from taciturn.design.dynamic import dynamic
from taciturn.design.excess import excess
from taciturn.design.integral import integral
from taciturn.design.lossy_lqg import lossy_lqg
from taciturn.design.lqg import lqg
from taciturn.design.mixed import mixed
from taciturn.design.near_optimal import near_optimal
from taciturn.design.optimal import optimal
from taciturn.design.periodic import all_time, periodic
from taciturn.design.periodic_schedule import periodic_schedule
from taciturn.design.relative import relative
from taciturn.design.remote_lqg import remote_lqg
from taciturn.design.rollout import rollout
from taciturn.design.self_triggered import self_triggered
from taciturn.design.send_on_delta import send_on_delta
from taciturn.design.stochastic import stochastic
from taciturn.design.variance import variance

__all__ = [
    "absolute",
    "all_time",
    "consistent",
    "downsampled",
    "dynamic",
    "excess",
    "integral",
    "lossy_lqg",
    "lqg",
    "mixed",
    "near_optimal",
    "optimal",
    "periodic",
    "periodic_schedule",
    "relative",
    "remote_lqg",
    "rollout",
    "self_triggered",
    "send_on_delta",
    "stochastic",
    "variance",
]
