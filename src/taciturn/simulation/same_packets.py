"""Periodic control with as many packets as a policy has sent on a simulated path, to compare both in one figure.

``periodic_control`` sends on each link as many packets, in intervals that are as equal as steps allow, from the first
step on:

* If the policy is LQG whose only input is held between packets, the gains are the optimal ones of periodic LQG with
  these intervals.
* Otherwise all nodes do what they do under the policy, with a timetable in place of their decisions: there may be
  several links, links that drop packets, a horizon, a given controller, disturbances and set-points. An actuator that
  predicts has no better gains for other intervals. A link on which the policy sends at fixed steps keeps these steps.

Costs that are to be compared need averages over many paths: those of ``study.periodic``, which also tries unequal
intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from taciturn._arrays import Bits
from taciturn.design.at_fixed_steps import same_nodes
from taciturn.design.kinds.periodic import periodic
from taciturn.errors import ProblemError, TaciturnError
from taciturn.loop import Loop, close
from taciturn.model.plant import ContinuousPlant
from taciturn.model.steps import Send

BEST_GAINS, SAME_NODES = "periodic control (optimal gains)", "periodic control (same nodes)"
ALIKE = 1e-6  # relative difference of two costs that are equal


def periodic_control(loop: Loop, sends: Mapping[str, Bits]) -> tuple[Loop, str]:
    """Return a loop with periodic control that sends as many packets as ``sends`` states, and the control's name."""
    policy = loop.policy
    sending = [step for step in policy.steps if isinstance(step, Send) and step.on is not None]
    links = [step.link for step in sending if policy.decisions[str(step.on)].reads]
    if not links:
        raise ProblemError(
            f"versus is 'periodic', but the policy {policy.kind} itself sends at fixed steps; expected a policy that "
            "decides from its measurements, or another loop for the comparison"
        )
    even = {link: even_steps(int(sends[link].sum()), len(sends[link])) for link in links}
    if len(policy.scheduled) == 1 and policy.holds(links[0]) and even[links[0]].any():
        found = _with_best_gains(loop, np.diff(np.flatnonzero([*even[links[0]], True])).tolist())
        if found is not None:
            return found, BEST_GAINS
    timed = same_nodes(policy, even)
    told = ("the packets are sent in fixed steps",)
    return replace(loop, policy=timed, network=loop.network.unlimited, violated_assumptions=told), SAME_NODES


def even_steps(packets: int, steps: int) -> Bits:
    """Mark steps at which packets are sent at intervals that are as equal as possible, from the first step on."""
    sent = np.zeros(steps, dtype=np.bool_)
    sent[np.arange(packets) * steps // max(packets, 1)] = True
    return sent


def _with_best_gains(loop: Loop, intervals: Sequence[int]) -> Loop | None:
    """Return periodic LQG with these intervals; None if the policy of a loop is not LQG with every sample."""
    problem, every = loop.problem, loop.policy.theory.cost_all_time
    plant = problem.plant if problem.source is None else problem.source
    period = loop.policy.tick if isinstance(plant, ContinuousPlant) else None
    try:
        least = periodic(plant, problem.cost, every=1, period=period).cost_all_time
        designed = periodic(plant, problem.cost, every=tuple(intervals), period=period)
        found = close(plant, designed, loop.network.unlimited, problem.cost)
    except TaciturnError:  # such as a horizon, links that drop packets, or other nodes
        return None
    alike = every is not None and abs(every - least) <= ALIKE * abs(least)
    return replace(found, limits=loop.limits, names=loop.names) if alike else None
