"""How many messages does a vehicle need that follows another, and what do lost ones cost?

By radar alone these gains want a time gap of 3.16 s; here the vehicle ahead tells over radio what it commands, too.
"""

import numpy as np
from matplotlib.figure import Figure

import taciturn
from taciturn.lqg.discrete import discretise
from taciturn.model.policy import Acknowledged, Assign, Decide, Location, Policy, Received, Send
from taciturn.model.trigger import Form, Scheduled, Trigger

TAU, H, KP, KD = 0.1, 0.7, 0.2, 0.7  # s of the engine, s of the time gap, gains of the radar: ploeg2011, ploeg2014
SWING, WANE, TICK = 0.5, 0.5, 0.05  # m/s² and 1/s, how the vehicle ahead accelerates: assumed; s from look to look
LOSS = 0.3  # of the messages: assumed; each by itself, as bai2006 finds on the road

# error of the gap, relative speed, acceleration and command of the follower, the same two of the vehicle ahead
pair = taciturn.ContinuousPlant(
    A=[[0, 1, -H, 0, 0, 0], [0, 0, -1, 0, 1, 0], [0, 0, -1 / TAU, 1 / TAU, 0, 0], [KP / H, KD / H, -KD, -1 / H, 0, 0],
       [0, 0, 0, 0, -1 / TAU, 1 / TAU], [0, 0, 0, 0, 0, -WANE]], B=[[0], [0], [0], [1 / H], [0], [0]],
    W=np.diag([0, 0, 0, 0, 0, 2 * WANE * SWING**2]), C=[[0, 0, 0, 0, 0, 1]])  # fmt: skip
gap, one = taciturn.Cost(Q=np.diag([1, 0, 0, 0, 0, 0]), R=[[1e-9]]), np.eye(1)


def follow(limits: list[float], loss: float, answered: bool) -> tuple[float, float, float]:
    """Return messages and answers a second, and the gap's error in cm with its standard error; limits tick by tick."""
    changed, counts = Form(("y", "last"), [[1, -1], [-1, 1]]), Acknowledged("sensor") if answered else "send"
    steps = (
        Decide("sensor", "send", Trigger({"silent": changed, "send": Form(constant=Scheduled("clock", limits))})),
        Send("sensor", "sensor", ("y",), "send"),
        Assign("sensor", "last", ({"last": one}, {"y": one}), counts),
        Assign("controller", "input", ({"input": one}, {"y": one}), Received("sensor")),
    )
    ticks = np.arange(len(limits))  # since the last message that counts
    clock = Location("clock", np.column_stack([np.minimum(ticks + 1, ticks[-1]), 0 * ticks]), "sensor", counts)
    car = frozenset({"controller", "actuator"})
    policy = Policy("follow", steps, discretise(pair, gap, TICK).plant, 0.0, ("sensor",), (car,), (clock,), {}, TICK,
                    network=taciturn.Network("tcp" if answered else "udp", sensor_loss=loss), settling=100)  # fmt: skip
    found = taciturn.average(taciturn.close(pair, policy, cost=gap), steps=1_000_000)
    rate, off = found.rates["sensor"].value / TICK * (2 - loss if answered else 1), 100 * np.sqrt(found.cost.value)
    return rate, off, 100**2 * found.cost.standard_error / (2 * off)


clocks, changes = [[1e9] * k + [-1.0] for k in (1, 2, 4, 9)], [[d**2] for d in (0.08, 0.12, 0.2, 0.35)]
rules = {"by a clock": clocks, "on a change": changes, "by a clock, answered": clocks, "on a change, answered": changes}
axes, found = (figure := Figure(figsize=(7, 4.2), layout="constrained")).subplots(), {}
for index, (name, limits) in enumerate(rules.items()):
    for loss in (0.0, LOSS)[index // 2 :]:  # where nothing is lost nothing needs an answer
        label, line = f"{name}, {100 * loss:.0f} % lost", "o-" if loss else "o--"
        found[label] = points = np.array([follow(each, loss, index > 1) for each in limits])
        print(label, *(f"{rate:.1f} a second: {off:.1f} ± {error:.2f} cm" for rate, off, error in points), sep="; ")
        axes.errorbar(points[:, 0], points[:, 1], 2 * points[:, 2], fmt=line, color=f"C{index}", label=label)
(few, off, error), (more, worse, _) = found["on a change, answered, 30 % lost"][2], found["by a clock, 30 % lost"][0]
answer = f"With 30 % lost, {few:.0f} messages and answers a second beat {more:.0f} by a clock"
axes.set(xlabel="messages and answers per second", ylabel="error of the gap (cm)", title=answer, ylim=(0, 50))
axes.legend()
figure.savefig("how_many_messages_does_a_follower_need.svg")
print(f"{answer}: {off:.1f} ± {error:.1f} cm, not {worse:.1f}")
assert off + 4 * error < worse < found["on a change, 30 % lost"][0][1] < found["by a clock, answered, 30 % lost"][2][1]
