"""The catalogue: the design function of every policy kind, and its knob. A new policy is a file and a line in each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

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


@dataclass(frozen=True)
class Knob:
    """The parameter that trades the cost of a policy for its rate.

    Args:
        name: key of ``[policy]``; of several that are given, the first is turned.
        link: whose rate it turns; omitted: the only one that the policy decides.
        least: what it must exceed; a whole number may equal it.
        whole: whether it is a whole number.
        falls: whether the rate falls where it grows.
        continuous: whether it is there for continuous plants (True), for discrete ones (False), or for both (None).
        cycles: whether a list of whole numbers does too, of which the exact costs tell the best.
    """

    name: str
    link: LinkName | None = None
    least: float = 0.0
    whole: bool = False
    falls: bool = True
    continuous: bool | None = None
    cycles: bool = False


KNOBS: Mapping[str, tuple[Knob, ...]] = {
    "all-time": (Knob("period", continuous=True),),
    "periodic": (Knob("every", least=1, whole=True, cycles=True), Knob("period", continuous=True)),
    "lqg": (Knob("theta"),),
    "remote-lqg": (Knob("theta", "actuator"), Knob("zeta", "sensor")),
    "lossy-lqg": (Knob("price"),),
    "integral": (Knob("slope"),),
    "consistent": (Knob("delta"),),
    "excess": (Knob("delta"), Knob("theta")),
    "optimal": (Knob("price"),),
    "near-optimal": (Knob("price"),),
    "absolute": (Knob("threshold"),),
    "relative": (Knob("sigma"),),
    "mixed": (Knob("threshold"),),
    "dynamic": (Knob("sigma"),),
    "send-on-delta": (Knob("delta"),),
    "variance": (Knob("threshold"),),
    "rollout": (Knob("every", least=2, whole=True),),
    "self-triggered": (Knob("beta", least=1.0),),
    "stochastic": (Knob("scale", falls=False),),
    "periodic-schedule": (Knob("sends", least=1, whole=True, falls=False),),
    "downsampled": (Knob("threshold"),),
}
