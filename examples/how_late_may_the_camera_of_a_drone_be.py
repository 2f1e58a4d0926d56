"""How late may the camera of a drone be? It is 30 to 60 ms late: wait for all pictures, for most, or ignore the delay?

A camera on the ground measures the height of a quadrotor 50 times a second, and a computer finds the quadrotor in the
picture, which takes 30 to 60 ms. A picture is sent to the quadrotor if its value exceeds a price. The controller there
predicts, so it needs to know how old a picture is: a buffer uses each one 60 ms after it was taken, or 40 ms, and drops
those that come later.
"""

import numpy as np

import taciturn
from taciturn.model.link import LinkLaw

LAG, PERIOD = 1 / 15.4666, 0.02  # time constant of the thrust of a Crazyflie, s: forster2015; s between pictures
# histogram of the delays of pictures: share of those that take so many ms, assumed
DELAYS = {30: 0.35, 35: 0.30, 40: 0.25, 45: 0.05, 50: 0.03, 60: 0.02}

# height (m), climb rate, acceleration by the thrust; gusts of 0.3 m/s² s^½, pictures accurate to 2 mm: assumed
drone = taciturn.ContinuousPlant(
    A=[[0, 1, 0], [0, 0, 1], [0, 0, -1 / LAG]], B=[[0], [0], [1 / LAG]], W=np.diag([0, 0.09, 0]), C=[[1, 0, 0]],
    V=[[4e-6]],
)  # fmt: skip
cost = taciturn.Cost(Q=np.diag([1.0, 0.01, 0]), R=[[1e-4]])
height = taciturn.Cost(Q=np.diag([1.0, 0, 0]), R=[[1e-9]])  # squared distance from the height to keep


def link_with(buffer: int) -> taciturn.Network:
    """Return the link of the camera with a buffer in ms, and acknowledgements if it drops pictures."""
    law = {"seconds": [ms / 1000 for ms in DELAYS], "probability": list(DELAYS.values())}
    late = LinkLaw(delay=law, buffer={"seconds": buffer / 1000}, acknowledged=buffer < max(DELAYS) or None)
    return taciturn.Network(links={"sensor": late})


def design(network: taciturn.Network) -> taciturn.Policy:
    """Return the rule of the camera's computer, which costs at most 10 % more than sending every picture."""
    return taciturn.design.excess(drone, cost, theta=0.1, period=PERIOD, link="sensor", actuation="model",
                                  network=network)  # fmt: skip


print("                 too late  sent per second  cm rms      cost   at most")
costs = {}
for name, policy, network in (
    ("buffer of 60 ms", design(link_with(60)), link_with(60)),
    ("buffer of 40 ms", design(link_with(40)), link_with(40)),
    ("delay ignored", design(taciturn.Network()), link_with(60)),
):
    loop = taciturn.close(drone, policy, network)
    found = taciturn.average(loop, steps=400_000)
    off = 100 * taciturn.average(taciturn.close(drone, policy, network, height), steps=400_000).cost.value ** 0.5
    bound = f"{policy.guarantee.cost:.6f}" if loop.nominal else "no claim"
    print(f"{name:17}{network.loss('sensor'):8.0%}{found.rates['sensor'].value:17.1f}{off:8.2f}"
          f"{found.cost.value:10.6f}{bound:>10}")  # fmt: skip
    costs[name] = found.cost.value
    assert not loop.nominal or found.cost.value < policy.guarantee.cost
assert costs["buffer of 40 ms"] < costs["buffer of 60 ms"] < costs["delay ignored"] / 2
