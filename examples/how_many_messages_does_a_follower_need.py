"""How many messages does a vehicle need to follow another, and how much do dropped messages cost?

By radar alone these gains require a time gap of 3.16 s. Here the vehicle ahead also sends its command over radio.
"""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn
from taciturn.lqg.discrete import discretise
from taciturn.model.steps import Acknowledged, Assign, Decide, Location, Received, Send
from taciturn.model.trigger import Form, Scheduled, Trigger

TAU, H, KP, KD = 0.1, 0.7, 0.2, 0.7  # engine's time constant (s), time gap (s), radar gains: ploeg2011, ploeg2014
SIGMA, DECAY, PERIOD = 0.5, 0.5, 0.05  # command of the vehicle ahead, m/s² and 1/s: assumed; s between checks
LOSS = 0.3  # share of messages dropped: assumed; independent, as bai2006 measured on the road

# error of the gap, relative speed, acceleration and command of the follower, acceleration and command ahead
pair = taciturn.ContinuousPlant(
    A=[[0, 1, -H, 0, 0, 0], [0, 0, -1, 0, 1, 0], [0, 0, -1 / TAU, 1 / TAU, 0, 0], [KP / H, KD / H, -KD, -1 / H, 0, 0],
       [0, 0, 0, 0, -1 / TAU, 1 / TAU], [0, 0, 0, 0, 0, -DECAY]], B=[[0], [0], [0], [1 / H], [0], [0]],
    W=np.diag([0, 0, 0, 0, 0, 2 * DECAY * SIGMA**2]), C=[[0, 0, 0, 0, 0, 1]])  # fmt: skip
gap, one = taciturn.Cost(Q=np.diag([1, 0, 0, 0, 0, 0]), R=[[1e-9]]), np.eye(1)


def follow(limits: list[float], loss: float, replies: bool) -> tuple[float, float, float]:
    """Return packets per second and the gap's error in cm with its standard error; limits per step since a message."""
    changed, counts = Form(("y", "last"), [[1, -1], [-1, 1]]), Acknowledged("sensor") if replies else "send"
    steps = (
        Decide("sensor", "send", Trigger({"silent": changed, "send": Form(constant=Scheduled("age", limits))})),
        Send("sensor", "sensor", ("y",), "send"),
        Assign("sensor", "last", ({"last": one}, {"y": one}), counts),
        Assign("controller", "input", ({"input": one}, {"y": one}), Received("sensor")),
    )
    ages = np.arange(len(limits))  # steps since the last message that counts
    age = Location("age", np.column_stack([np.minimum(ages + 1, ages[-1]), 0 * ages]), "sensor", counts)
    car, link = frozenset({"controller", "actuator"}), taciturn.Network("tcp" if replies else "udp", sensor_loss=loss)
    model, theory = discretise(pair, gap, PERIOD).plant, taciturn.Theory(settling=100)
    policy = taciturn.Policy("follow", steps, model, theory, (car,), (age,), {}, PERIOD, link)
    found = taciturn.average(taciturn.close(pair, policy, cost=gap), steps=1_000_000)
    rate, off = found.rates["sensor"].value * (2 - loss if replies else 1), 100 * np.sqrt(found.cost.value)
    return rate, off, 100**2 * found.cost.standard_error / (2 * off)


fixed, changes = [[1e9] * k + [-1.0] for k in (1, 2, 4, 9)], [[d**2] for d in (0.08, 0.12, 0.2, 0.35)]
rules = {"periodic": fixed, "on change": changes, "periodic, acknowledged": fixed, "on change, acknowledged": changes}
rcParams.update(taciturn.style())
axes, found = (figure := Figure(figsize=(7, 4.2), layout="constrained")).subplots(), {}
for index, (name, limits) in enumerate(rules.items()):
    for loss in (0.0, LOSS)[index // 2 :]:  # without dropouts no acknowledgement is needed
        label, line = f"{name}, {100 * loss:.0f} % dropped", "o-" if loss else "o--"
        found[name, loss] = points = np.array([follow(each, loss, index > 1) for each in limits])
        print(label, *(f"{rate:.1f} per second: {off:.1f} ± {error:.2f} cm" for rate, off, error in points), sep="; ")
        axes.errorbar(points[:, 0], points[:, 1], 2 * points[:, 2], fmt=line, color=f"C{index}", label=label)
(few, off, error), (more, worse, _) = found["on change, acknowledged", LOSS][2], found["periodic", LOSS][0]
answer = f"30 % dropped: {few:.0f} packets per second on change outperform {more:.0f} periodic"
axes.set(xlabel="messages and acknowledgements per second", ylabel="error of the gap (cm)", title=answer, ylim=(0, 50))
axes.legend()
figure.savefig("how_many_messages_does_a_follower_need.svg")
print(f"{answer}: {off:.1f} ± {error:.1f} cm instead of {worse:.1f}")
assert off + 4 * error < worse < found["on change", LOSS][0][1] < found["periodic, acknowledged", LOSS][2][1]
