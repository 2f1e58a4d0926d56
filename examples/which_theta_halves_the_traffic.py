"""At which theta does a loop of two masses send at half of its checks, and at what cost? Forty loops run at once.

A bank simulates one path of each loop, all with the same machine code, and locates theta roughly and quickly. The rate
and the cost at this theta are then computed with standard errors.
"""

from __future__ import annotations

import numpy as np

import taciturn
from taciturn.simulation.bank import Bank

WANTED = 0.5  # sends per check

problem = taciturn.load("two-mass-lqg")
thetas = np.geomspace(0.02, 2.0, 40)
loops = [problem.close(problem.changed({"theta": float(theta)}).design()) for theta in thetas]

bank = Bank(loops, seed=1)
bank.run(300)  # discard the transient
rates = bank.run(20_000).sends["actuator"]
print(f"{len(loops)} loops, {bank.structures} compiled; sends per check from {rates[0]:.2f} down to {rates[-1]:.2f}")

nearest = int(np.abs(rates - WANTED).argmin())
found = taciturn.evaluate(problem.changed({"theta": float(thetas[nearest])}), standard_error=1e-4)
rate = found.rates["actuator"]
assert found.cost_all_time is not None
more = found.cost.value / found.cost_all_time - 1
print(f"theta = {thetas[nearest]:.3f}: sends {rate} per check, costs {more:.1%} more than sending every sample")

assert abs(rate.value - WANTED) < 0.05
