"""Do acknowledgements pay off? An inverted pendulum over links that drop packets, with and without acknowledgement.

An acknowledgement reports to the controller that its input arrived, and costs as much as a packet with an input.
"""

from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn
from taciturn.lqg.critical_losses import Channel
from taciturn.lqg.lossy import critical_losses

plant = taciturn.Plant(A=[[1.0, 0.1], [0.9, 1.0]], B=[[0.0], [0.1]], W=[[0.0, 0.0], [0.0, 0.1]], dt=0.1)
cost = taciturn.Cost(Q=[[1.0, 0.0], [0.0, 0.1]], R=[[0.01]])
price, sensor_loss = 0.02, 0.2  # price of an input packet or an acknowledgement; share of measurements dropped
NAMES = {"udp": "without acknowledgement", "tcp": "with acknowledgement"}
losses = (0.0, 0.1, 0.2, 0.3, 0.4, 0.45, 0.5)

totals: dict[str, list[float]] = {"udp": [], "tcp": []}
errors: list[float] = []
for loss in losses:
    for protocol, found in totals.items():
        name = NAMES[protocol]
        network = taciturn.Network(protocol, actuator_loss=loss, sensor_loss=sensor_loss)
        policy = taciturn.design.lossy_lqg(plant, cost, price=price, network=network)
        result = taciturn.average(taciturn.close(plant, policy), standard_error=2e-5)
        sends = result.rates["actuator"]
        packets = sends.scaled(2 - loss if protocol == "tcp" else 1)  # each packet that arrives is acknowledged by one
        found.append(result.cost.value + price * packets.value)
        errors.append(result.cost.standard_error + price * packets.standard_error)
        print(f"{loss:.0%} dropped, {name}: cost {result.cost}, {packets.value:.3f} packets per step, ", end="")
        print(f"total cost {found[-1]:.4f}, control cost guaranteed at most {policy.guarantee.cost:.4f}")

rcParams.update(taciturn.style())
figure = Figure(figsize=(7, 4.2), layout="constrained")
axes = figure.subplots()
for index, (protocol, found) in enumerate(totals.items()):
    name = NAMES[protocol]
    axes.plot(losses, found, "o-", color=f"C{index}", label=name)
    channel = Channel(0.0, sensor_loss, acknowledged=protocol == "tcp", delayed=False)
    critical = critical_losses(plant.A, plant.B, channel)[0]
    axes.axvline(critical, color=f"C{index}", linestyle=":", label=f"{name}: critical loss")
    print(f"{name}: critical actuator loss {critical:.4f} if {sensor_loss:.0%} of the measurements are dropped")
    try:
        network = taciturn.Network(protocol, actuator_loss=critical + 1e-3, sensor_loss=sensor_loss)
        taciturn.design.lossy_lqg(plant, cost, price=price, network=network)
    except taciturn.UnstableError as error:
        print(f"  {error}")
axes.set(xlabel="dropout rate of the actuator link", ylabel="total cost per step", ylim=(0.1, 1.4))
axes.legend()
figure.savefig("does_an_acknowledgement_pay.svg")

gains = dict(zip(losses, (u - t for u, t in zip(totals["udp"], totals["tcp"], strict=True)), strict=True))
print("saved by acknowledgements:", {loss: round(gain, 4) for loss, gain in gains.items()})
assert gains[0.1] < -10 * max(errors)
assert gains[0.3] > 10 * max(errors)
