"""What does a worse link cost? Sensor, controller and actuator as processes over UDP, with relays that lose packets.

The controller was designed for links that lose 60 % of the measurements and 30 % of the inputs. Here it is run over
links that lose as much, and over links that double, reorder and harm packets besides: what comes too late or is harmed
is lost to the policy, and its cost is that of a loop that loses as much. Time is virtual: a seed gives the same run.
"""

from dataclasses import replace

import taciturn
from taciturn.study.network import NetworkRun, losses

NAME, SEEDS = "lossy-double-integrator", range(2)
problem = taciturn.load(NAME)


def run(seed: int, **worse: float) -> NetworkRun:
    """Run one mission, over links that do something else as well."""
    fates = {link: replace(fate, **worse) for link, fate in losses(problem.network, seed).items()}
    return taciturn.run_network(NAME, seed=seed, fates=fates)


plain = [run(seed) for seed in SEEDS]
worse = [run(seed, duplicate=0.3, reorder=0.3, corrupt=0.1) for seed in SEEDS]
for name, runs in (("as designed", plain), ("worse", worse)):
    cost = sum(found.costs.sum() for found in runs) / len(runs)
    used = sum(found.reports["controller"]["counters"]["used"] for found in runs) / sum(len(r.costs) for r in runs)
    print(f"{name:12} {cost:6.1f} a mission, {used:.0%} of the measurements used")

counters, refused = worse[0].reports["controller"]["counters"], worse[0].reports["controller"]["refused"]
print("the first controller counted", dict(counters), "and refused", dict(refused))
arrived = counters["received"] - counters["marks"]
assert arrived == counters["used"] + counters.get("late", 0) + counters.get("duplicate", 0)
assert worse[0].reports["relay sensor"]["counters"]["delivered"] == arrived + sum(refused.values())
