"""How much does a worse link cost? Sensor, controller and actuator are processes over UDP, and relays drop packets.

The controller is designed for links that drop 60 % of the measurements and 30 % of the inputs. It runs over such links,
and over links that also duplicate, reorder and corrupt packets. The policy treats late and corrupted packets as
dropped, so its cost is that of a loop that drops as many. Time is virtual: the same seed gives the same run.
"""

from dataclasses import replace

import taciturn
from taciturn_udp.relay import losses
from taciturn_udp.result import NetworkRun

NAME, SEEDS = "lossy-double-integrator", range(2)
problem = taciturn.load(NAME)


def run(seed: int, **more: float) -> NetworkRun:
    """Run one finite horizon over the links of the problem with more impairments."""
    fates = {link: replace(fate, **more) for link, fate in losses(problem.network, seed).items()}
    return taciturn.run_network(NAME, seed=seed, fates=fates)


designed = [run(seed) for seed in SEEDS]
impaired = [run(seed, duplicate=0.3, reorder=0.3, corrupt=0.1) for seed in SEEDS]
for name, runs in (("as designed", designed), ("impaired", impaired)):
    cost = sum(found.costs.sum() for found in runs) / len(runs)
    used = sum(found.reports["controller"]["counters"]["used"] for found in runs) / sum(len(r.costs) for r in runs)
    print(f"{name:12} cost {cost:6.1f} per finite-horizon run, {used:.0%} of the measurements used")

counters, refused = impaired[0].reports["controller"]["counters"], impaired[0].reports["controller"]["refused"]
print("first impaired run: the controller counted", dict(counters), "and rejected", dict(refused))
arrived = counters["received"] - counters["marks"]
assert arrived == counters["used"] + counters.get("late", 0) + counters.get("duplicate", 0)
assert impaired[0].reports["relay sensor"]["counters"]["delivered"] == arrived + sum(refused.values())
