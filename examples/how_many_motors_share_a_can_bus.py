"""How many DC motors share a CAN bus, if each may cost a quarter more than alone on it?

Each motor's encoder and controller send an estimate over the bus to its driver, at most every 5 ms, and the driver
predicts from it. Under periodic control the motors send in turn. Under event-triggered control the largest error has
the most urgent identifier and is sent first (walsh2002).
"""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn
from taciturn.lqg.discrete import discretise

# kg m², N m s, N m/A = V s, Ω of a motor of Carnegie Mellon's laboratory (ctms, "DC Motor Position"); its inductance of
# 2.75 µH is neglected (time constant 0.7 µs)
J, FRICTION, K, R = 3.2284e-6, 3.5077e-6, 0.0274, 4.0
LOAD, DECAY, COUNTS = 5e-3, 0.05, 2000  # load torque (N m), its time constant (s), encoder counts per turn: assumed
PERIOD, MORE = 5e-3, 1.25
BITS = 55 + 10 * 6  # of a frame with an 11-bit identifier and 6 bytes (three numbers of 16 bits): davis2007

motor = taciturn.ContinuousPlant(  # states: angle (rad), speed, load torque; input: volts
    A=[[0, 1, 0], [0, -(FRICTION + K**2 / R) / J, 1 / J], [0, 0, -1 / DECAY]],
    B=[[0], [K / (R * J)], [0]],
    W=np.diag([0, 0, 2 * LOAD**2 / DECAY]),
    C=[[1, 0, 0]],
    V=[[(2 * np.pi / COUNTS) ** 2 / 12]],
)
sampled = discretise(motor, taciturn.Cost(Q=np.diag([1.0, 0, 0]), R=[[1e-5]]), PERIOD)
cost = taciturn.Cost(sampled.Q, sampled.R, sampled.N)
problem = taciturn.Problem(sampled.plant, cost, taciturn.Network(), "excess", {"delta": 1e-6, "actuation": "model"})

rcParams.update(taciturn.style())
figure = Figure(figsize=(7, 4.2), layout="constrained")
axes, most, in_turn = figure.subplots(), [], []
for index, (bitrate, counts) in enumerate({125_000: (5, 6, 7, 8), 250_000: (10, 11, 13, 15, 16)}.items()):
    capacity = int(bitrate * PERIOD / BITS)  # frames of the largest length per step
    urgent, periodic, name = [], [], f"{bitrate / 1000:.0f} kbit/s"
    for motors in counts:
        shared = {"copies": motors, "capacity": capacity, "scheduler": "largest"}
        found = taciturn.share_channel({"motor": problem}, **shared, steps=2000, confidence=0)
        urgent.append(found.cost.scaled(1 / found.cost_all_time))
        periodic.append(found.cost_periodic / found.cost_all_time)
        load = found.load.scaled(100 * BITS / (bitrate * PERIOD)).value
        print(f"{name}, {motors} motors: bus load {load:.0f} %, cost {urgent[-1]}, in turn {periodic[-1]:.2f}")
    surely = [each.value + 4 * each.standard_error for each in urgent]
    most.append(max(motors for motors, each in zip(counts, surely, strict=True) if each < MORE))
    in_turn.append(max(motors for motors, each in zip(counts, periodic, strict=True) if each < MORE))
    style = {"color": f"C{index}", "markersize": 4}
    axes.plot(counts, periodic, "o--", label=f"{name}, in turn", **style)
    costs, errors = zip(*((each.value, 2 * each.standard_error) for each in urgent), strict=True)
    axes.errorbar(counts, costs, errors, fmt="o-", label=f"{name}, largest error first", **style)
answer = "{} motors share 125 kbit/s and {} share 250 kbit/s; in turn {} and {}".format(*most, *in_turn)
axes.axhline(MORE, color="0.6", linestyle=":", label="a quarter more")
axes.set(xlabel="motors on the bus", ylabel="cost of a motor, relative to alone", xlim=(4, 24), ylim=(0.9, 3.2))
axes.set_title(answer)
axes.legend()
figure.savefig("how_many_motors_share_a_can_bus.svg")
print(answer)
assert min(many / few for many, few in zip(most, in_turn, strict=True)) > 1.3
