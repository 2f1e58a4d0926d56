"""Design functions of all policies, one family of policies per file, with their guarantees on the cost.

A design function takes a plant, a cost and its parameters, and returns a ``Policy``, which is data rather than code.
The function solves the underlying LQG problem (``taciturn.lqg``), writes the policy steps, and states the theorem. The
certainty-equivalent designs share ``certainty``: with the error e of the actuator's input, completion of squares gives

    J = J_all + E[e'(R + B'KB)e in silence],

so every trigger that bounds this square bounds the cost (``bounds``). ``estimation`` writes the filters at sensor or
actuator, ``prediction`` the policies that predict in continuous time, and ``prices`` the costs that a schedule of
queries weighs. ``catalogue`` lists the policy kinds with their design functions and main parameters. A new policy
requires a file in this package, a line in the catalogue, and a test of its theorem.
"""

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
