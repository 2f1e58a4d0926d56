"""Does a quadrotor hover over Wi-Fi that drops one packet in seven, in bursts, and with how few corrections?

The plant is one axis of a Crazyflie. A camera on the ground sends the state over Wi-Fi, 50 times a second. A computer
sends pitch torques back over Wi-Fi if silence would cost too much. In a step without a packet the torque is zero.
"""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn
from taciturn.lqg.discrete import discretise

INERTIA, LAG = 16.655602e-6, 1 / 15.4666  # pitch axis, kg m²; time constant of the thrust, s: forster2015
# a measured WLAN that drops 13.9 % of the packets, in bursts of 1.7 (two-state chain of milner2004)
BURST = taciturn.Burst(to_bad=1 - 0.9042, to_good=1 - 0.4060, loss_good=0.0, loss_bad=1.0)
PERIOD, STEPS = 0.02, 1_000_000

# position (m), velocity, pitch, pitch rate, pitch torque (mN m); gusts of 0.3 m/s² s^½ and 0.7 rad/s² s^½: assumed
lean = taciturn.ContinuousPlant(
    A=[[0, 1, 0, 0, 0], [0, 0, 9.81, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1e-3 / INERTIA], [0, 0, 0, 0, -1 / LAG]],
    B=[[0], [0], [0], [0], [1 / LAG]],
    W=np.diag([0, 0.09, 0, 0.5, 0]),
)
cost = taciturn.Cost(Q=np.diag([1.0, 0.1, 0.1, 0, 0]), R=[[0.01]])
distance = taciturn.Cost(Q=np.diag([1.0, 0, 0, 0, 0]), R=[[1e-9]])  # squared distance from the target
drone = discretise(lean, cost, PERIOD).plant

networks = {
    "no dropout": taciturn.Network(),
    "same dropout rate, without bursts": taciturn.Network("udp", BURST.loss, BURST.loss),
    "bursts": taciturn.Network("udp", actuator_burst=BURST, sensor_burst=BURST),
    "bursts, with acknowledgement": taciturn.Network("tcp", actuator_burst=BURST, sensor_burst=BURST),
}
rcParams.update(taciturn.style())
figure = Figure(figsize=(7, 4.2), layout="constrained")
axes = figure.subplots()
points: dict[str, list[tuple[float, float, float]]] = {}
for name, network in networks.items():
    for price in (0.0, 3e-4, 3e-3, 2e-2):
        policy = taciturn.design.lossy_lqg(drone, cost, price=price, network=network)
        found = taciturn.average(taciturn.close(drone, policy, cost=distance), steps=STEPS)
        off, rate = 100 * np.sqrt(found.cost.value), found.rates["actuator"].scaled(1 / PERIOD)
        error = 100 * 100 * found.cost.standard_error / (2 * off)
        points.setdefault(name, []).append((rate.value, off, error))
        print(f"{name}, price {price:g}: {rate} corrections per second, {off:.2f} ± {error:.2f} cm rms")
    rates, offs, errors = zip(*points[name], strict=True)
    axes.errorbar(rates, offs, 2 * np.array(errors), fmt="o-", markersize=4, label=name)
(all_of_them, least, error), (few, off, _) = points["bursts"][0], points["bursts"][2]
answer = f"It hovers: {off:.1f} cm rms with {few:.0f} corrections per second, {least:.1f} cm with {all_of_them:.0f}"
axes.set(xlabel="corrections per second", ylabel="root mean square distance from the target (cm)", title=answer)
axes.legend()
figure.savefig("does_a_quadrotor_hover_over_wifi.svg")
print(answer)
assert points["no dropout"][0][1] + 5 * error < least < 1.2 * points["no dropout"][0][1]
assert few < all_of_them / 2
