"""How long do the batteries of two wireless level sensors last if each sensor decides when to send?

Two pumps keep the levels of two lower tanks; each pump also feeds an upper tank, diagonally. Two sensors with batteries
measure the lower levels every two seconds. Each sensor sends only if the controller's estimate needs it, and the
controller sends only to a pump whose input must change. How does the battery life depend on the cost that one allows?
"""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn

tank = taciturn.load("quadruple-tank")
rcParams.update(taciturn.style())
figure = Figure(figsize=(7, 4.2), layout="constrained")
axes = figure.subplots()
for prediction in ("hold", "model"):
    runs = [
        taciturn.evaluate(tank.changed({"theta": theta, "prediction": prediction}), steps=1_000_000)
        for theta in (0.2, 0.5, 1.0, 2.0, 4.0)
    ]
    extra = [100 * (run.cost.value / run.cost_all_time - 1) for run in runs]
    days = [run.life["level-1"].value / 86400 for run in runs]
    axes.plot(days, extra, "o-", label=f'prediction = "{prediction}"')
every = tank.network.links["level-1"].life(taciturn.Estimate(0.5, 0.0, "exact")).value / 86400
axes.axvline(every, color="k", linestyle=":", label="every sample")
best, bound = runs[2], 100 * (runs[2].cost_bound_at_rate / runs[2].cost_all_time - 1)
answer = f"The batteries last {days[2]:.0f} days instead of {every:.0f}, for {extra[2]:.1f} % more cost"
print(f"{answer}; at most {bound:.0f} % by the bound at these rates")
axes.set(xlabel="battery life of level-1 (days)", ylabel="cost above sending every sample (%)", title=answer)
axes.legend()
figure.savefig("how_long_do_two_level_sensors_last.svg")
assert days[2] > 1.3 * every
assert extra[2] + 4 * 100 * best.cost.standard_error / best.cost_all_time < bound
assert np.all(np.diff(days) > 0)
