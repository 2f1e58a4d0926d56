"""A radio carries three packets every two ticks, both ways together: which prices of query and send suit it best?"""

import numpy as np
from matplotlib.figure import Figure

import taciturn

BUDGET = 1.5  # packets per tick

problem = taciturn.load("remote-scalar")
grid = {"theta": np.geomspace(0.02, 2.0, 10), "zeta": np.linspace(0.2, 1.65, 8)}
# every cell is kept in the folder: interrupted, or asked for a finer grid later, the next run computes what is missing
found = taciturn.sweep(problem, grid, standard_error=1e-3, store="radio")

packets = found.rate_sensor + found.rate_actuator
fitting = found.cost.where(packets <= BUDGET)
best = fitting.argmin(["theta", "zeta"])
chosen = found.isel(best)
theta, zeta = chosen.theta.item(), chosen.zeta.item()
print(f"θ = {theta:.3g}, ζ = {zeta:.3g}: {packets.isel(best).item():.3f} packets, cost {chosen.cost.item():.4f}")

figure = Figure(figsize=(6, 4), layout="constrained")
axes = figure.subplots()
drawn = axes.pcolormesh(found.zeta, found.theta, found.cost, shading="nearest")
figure.colorbar(drawn, label="cost per tick")
axes.contour(found.zeta, found.theta, packets, levels=[BUDGET], colors="white")
axes.plot(zeta, theta, "r*", markersize=14)
axes.set(xlabel="ζ, price of a query", ylabel="θ, price of silence", yscale="log")
figure.savefig("which_prices_fit_a_radio.svg")

# the best cell alone, with the seed that the sweep gave it
alone = taciturn.evaluate(problem.changed({"theta": theta, "zeta": zeta}), seed=chosen.seed.item(), standard_error=1e-3)
assert alone.cost.value == chosen.cost.item() == fitting.min().item()
assert (found.cost <= found.cost_bound + 5 * found.cost_standard_error).all()
