"""How often must a cart with an inverted pendulum receive its input? The pendulum is simulated at any angle.

Position and angle are measured at the controller. The controller sends inputs to the motor on the cart over a radio, at
most 50 per second. Between packets the motor predicts them with a model. How many are needed at a fifth more cost?
"""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn

# cart 0.5 kg, friction 0.1 N s/m, pendulum 0.2 kg, 0.3 m to its centre of mass, 0.006 kg m² about it: University of
# Michigan, Control Tutorials for MATLAB and Simulink, "Inverted Pendulum: System Modeling" (ctms). Assumed: noise of
# the force of 0.1 N s^½, and encoders that read to 1 mm and 1 mrad.
cart = taciturn.load("pendulum-by-encoders")
checks, steps = 50, 2_000_000  # per second; per run


def sending(kind: str, **parameters: float) -> taciturn.Problem:
    """Return the problem with another policy, whose actuator predicts."""
    return cart.changed({"theta": None, "actuation": "model", "kind": kind, **parameters})


every_sample = taciturn.evaluate(sending("periodic", every=1), steps=steps).cost


def measure(policy: taciturn.Problem) -> tuple[float, float, float, float]:
    """Return sends per second, and the cost relative to 50 per second, both with standard errors."""
    found = taciturn.evaluate(policy, steps=steps)
    rate = found.rates["actuator"].scaled(checks)
    above = found.cost.value / every_sample.value
    error = np.hypot(found.cost.standard_error, above * every_sample.standard_error) / every_sample.value
    print(f"{policy.kind}: {rate} packets per second, {100 * (above - 1):.1f} ± {100 * error:.1f} % more cost")
    return rate.value, rate.standard_error, above, error


periodic = np.array([measure(sending("periodic", every=every)) for every in (2, 3, 4, 5)])
events = np.array([measure(sending("excess", delta=delta)) for delta in (0.03, 0.1, 0.24, 0.5, 1.0)])
rate, rate_error, above, error = events[2]
enough = float(np.interp(1.2, periodic[:, 2], periodic[:, 0]))  # two intervals that alternate: the chord of their costs
answer = f"A cart needs {rate:.0f} packets per second, under periodic control {enough:.0f}"

rcParams.update(taciturn.style())
figure = Figure(figsize=(7, 4.2), layout="constrained")
axes = figure.subplots()
for name, found in (("periodic", periodic), ("event-triggered", events)):
    axes.errorbar(found[:, 0], found[:, 2], 2 * found[:, 3], 2 * found[:, 1], "o-", markersize=4, label=name)
axes.axhline(1.2, color="0.6", linestyle="--", label="a fifth more")
axes.set(xlabel="packets per second", ylabel="cost relative to 50 per second", title=answer, ylim=(0.98, 2.1))
axes.legend()
figure.savefig("how_often_must_a_cart_receive_its_input.svg")

path = taciturn.simulate(cart.close(sending("excess", delta=0.24).design()), 500, seed=1)
print(f"largest angle in ten seconds: {np.degrees(np.abs(path.state[:, 2]).max()):.1f}°")
print(f"{answer} ({rate:.2f} ± {rate_error:.2f}, at {100 * (above - 1):.1f} ± {100 * error:.1f} % more cost)")
assert periodic[0, 2] < 1.2 < periodic[1, 2]  # a packet every second step suffices, every third does not
assert 2 * rate < enough
assert abs(above - 1.2) < 4 * error
