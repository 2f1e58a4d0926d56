"""How often must a cart hear its controller? An inverted pendulum on a cart, as it moves at any angle.

Position and angle are measured where the controller is; the motor on the cart hears it over a radio, 50 times a second
at most, and runs a model of what it would hear meanwhile. How often does that need to be, if it may cost a fifth more?
"""

import numpy as np
from matplotlib.figure import Figure

import taciturn

# cart 0.5 kg, friction 0.1 N s/m, pendulum 0.2 kg, 0.3 m to its centre of mass, 0.006 kg m² about it: University of
# Michigan, Control Tutorials for MATLAB and Simulink, "Inverted Pendulum: System Modeling" (ctms). The force is noisy
# (0.1 N s^½) and both encoders read to 1 mm and 1 mrad: assumed.
cart = taciturn.load("pendulum-by-encoders")
looks, steps = 50, 2_000_000  # a second; of a run


def sending(kind: str, **parameters: float) -> taciturn.Problem:
    """Return the cart under another policy, whose actuator predicts."""
    return cart.changed({"theta": None, "actuation": "model", "kind": kind, **parameters})


always = taciturn.evaluate(sending("periodic", every=1), steps=steps).cost


def measure(policy: taciturn.Problem) -> tuple[float, float, float, float]:
    """Return how often a policy sends a second and what it costs, relative to 50, both with standard errors."""
    found = taciturn.evaluate(policy, steps=steps)
    rate = found.rates["actuator"].scaled(looks)
    above = found.cost.value / always.value
    error = np.hypot(found.cost.standard_error, above * always.standard_error) / always.value
    print(f"{policy.kind}: {rate} packets per second, {100 * (above - 1):.1f} ± {100 * error:.1f} % more")
    return rate.value, rate.standard_error, above, error


clocks = np.array([measure(sending("periodic", every=every)) for every in (2, 3, 4, 5)])
events = np.array([measure(sending("excess", delta=delta)) for delta in (0.03, 0.1, 0.24, 0.5, 1.0)])
rate, rate_error, above, error = events[2]
answer = f"A cart must hear its controller {rate:.0f} times a second, by a clock {clocks[0, 0]:.0f} times"

figure = Figure(figsize=(7, 4.2), layout="constrained")
axes = figure.subplots()
for name, found in (("a clock", clocks), ("when silence would cost too much", events)):
    axes.errorbar(found[:, 0], found[:, 2], 2 * found[:, 3], 2 * found[:, 1], "o-", markersize=4, label=name)
axes.axhline(1.2, color="0.6", linestyle="--", label="a fifth more")
axes.set(xlabel="packets per second", ylabel="cost, relative to 50 per second", title=answer, ylim=(0.98, 2.1))
axes.legend()
figure.savefig("how_often_must_a_cart_hear_its_controller.svg")

path = taciturn.simulate(cart.close(sending("excess", delta=0.24).design()), 500, seed=1)
print(f"in ten seconds it leans {np.degrees(np.abs(path.state[:, 2]).max()):.1f}° at most")
print(f"{answer} ({rate:.2f} ± {rate_error:.2f}, for {100 * (above - 1):.1f} ± {100 * error:.1f} % more cost)")
assert clocks[0, 2] < 1.2 < clocks[1, 2]  # every second tick by the clock, and not every third
assert abs(above - 1.2) < 4 * error
