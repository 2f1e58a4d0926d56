"""Which query price ζ and trigger threshold θ suit a radio with three packets every two steps, both ways together?"""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn

BUDGET = 1.5  # packets per step

problem = taciturn.load("remote-scalar")
grid = {"theta": np.geomspace(0.02, 2.0, 10), "zeta": np.linspace(0.2, 1.65, 8)}
# the folder stores every cell: after an interruption, or for a finer grid, the next run computes only missing cells
found = taciturn.sweep(problem, grid, standard_error=1e-3, store="radio")

packets = found.rate_sensor + found.rate_actuator
fitting = found.cost.where(packets <= BUDGET)
best = fitting.argmin(["theta", "zeta"])
chosen = found.isel(best)
theta, zeta = chosen.theta.item(), chosen.zeta.item()
print(f"θ = {theta:.3g}, ζ = {zeta:.3g}: {packets.isel(best).item():.3f} packets, cost {chosen.cost.item():.4f}")

rcParams.update(taciturn.style())
figure = Figure(figsize=(6, 4), layout="constrained")
axes = figure.subplots()
drawn = axes.pcolormesh(found.zeta, found.theta, found.cost, shading="nearest")
figure.colorbar(drawn, label="cost per step")
axes.contour(found.zeta, found.theta, packets, levels=[BUDGET], colors="white")
axes.plot(zeta, theta, "r*", markersize=14)
axes.set(xlabel="ζ, price of a query", ylabel="θ, trigger threshold", yscale="log")
axes.grid(visible=False)
figure.savefig("which_prices_fit_a_radio.svg")

# compute the best cell again, with its seed from the sweep
alone = taciturn.evaluate(problem.changed({"theta": theta, "zeta": zeta}), seed=chosen.seed.item(), standard_error=1e-3)
assert alone.cost.value == chosen.cost.item() == fitting.min().item()
assert (found.cost <= found.cost_bound + 5 * found.cost_standard_error).all()
