"""Catalogue of all policy kinds, with the design function and the tuning parameters of each kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from taciturn._display import Displayed
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
from taciturn.model.policy import LinkName, Policy
from taciturn.renewal.policy import EventPolicy, OptimalPolicy

AnyPolicy: TypeAlias = Policy | EventPolicy | OptimalPolicy
CATALOGUE: Mapping[str, Callable[..., AnyPolicy]] = {
    "all-time": all_time,
    "periodic": periodic,
    "lqg": lqg,
    "remote-lqg": remote_lqg,
    "lossy-lqg": lossy_lqg,
    "integral": integral,
    "consistent": consistent,
    "excess": excess,
    "optimal": optimal,
    "near-optimal": near_optimal,
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


@dataclass(frozen=True, repr=False)
class TradeoffParameter(Displayed):
    """The main parameter of a policy kind, by which the cost of the policy is traded against its send rate.

    Args:
        name: key of ``[policy]``; if several of the kind's parameters are given, the first is varied.
        link: the link whose rate the parameter changes; default the only link that the policy decides.
        least: lower limit, which an integer parameter may equal and a real parameter must exceed.
        whole: whether the parameter is an integer.
        falls: whether the rate decreases when the parameter increases.
        continuous: whether it applies to continuous-time plants (True), discrete-time plants (False) or both (None).
        cycles: whether the parameter may also be a list of integers; the exact costs select the best list.
    """

    name: str
    link: LinkName | None = None
    least: float = 0.0
    whole: bool = False
    falls: bool = True
    continuous: bool | None = None
    cycles: bool = False


TRADEOFF_PARAMETERS: Mapping[str, tuple[TradeoffParameter, ...]] = {
    "all-time": (TradeoffParameter("period", continuous=True),),
    "periodic": (
        TradeoffParameter("every", least=1, whole=True, cycles=True),
        TradeoffParameter("period", continuous=True),
    ),
    "lqg": (TradeoffParameter("theta"),),
    "remote-lqg": (TradeoffParameter("theta", "actuator"), TradeoffParameter("zeta", "sensor")),
    "lossy-lqg": (TradeoffParameter("price"),),
    "integral": (TradeoffParameter("slope"),),
    "consistent": (TradeoffParameter("delta"),),
    "excess": (TradeoffParameter("delta"), TradeoffParameter("theta")),
    "optimal": (TradeoffParameter("price"),),
    "near-optimal": (TradeoffParameter("price"),),
    "absolute": (TradeoffParameter("threshold"),),
    "relative": (TradeoffParameter("sigma"),),
    "mixed": (TradeoffParameter("threshold"),),
    "dynamic": (TradeoffParameter("sigma"),),
    "send-on-delta": (TradeoffParameter("delta"),),
    "variance": (TradeoffParameter("threshold"),),
    "rollout": (TradeoffParameter("every", least=2, whole=True),),
    "self-triggered": (TradeoffParameter("beta", least=1.0),),
    "stochastic": (TradeoffParameter("scale", falls=False),),
    "periodic-schedule": (TradeoffParameter("sends", least=1, whole=True, falls=False),),
    "downsampled": (TradeoffParameter("threshold"),),
}
