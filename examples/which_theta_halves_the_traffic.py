"""Forty loops at once: at which theta do two masses send half as often as they look, and what does that cost?

A bank runs one path of each loop side by side, all with the same machine code; it finds the place, roughly and at once.
The answer is then computed with a standard error.
"""

from __future__ import annotations

import numpy as np

import taciturn
from taciturn.simulation.bank import Bank

WANTED = 0.5  # sends per look

problem = taciturn.load("two-mass")
thetas = np.geomspace(0.02, 2.0, 40)
loops = [problem.close(problem.changed({"theta": float(theta)}).design()) for theta in thetas]

bank = Bank(loops, seed=1)
bank.run(300)  # what the start leaves
rates = bank.run(20_000).sends["actuator"]
print(f"{len(loops)} loops, {bank.structures} compiled; sends per look from {rates[0]:.2f} down to {rates[-1]:.2f}")

nearest = int(np.abs(rates - WANTED).argmin())
found = taciturn.evaluate(problem.changed({"theta": float(thetas[nearest])}), standard_error=1e-4)
rate = found.rates["actuator"]
assert found.cost_all_time is not None
more = found.cost.value / found.cost_all_time - 1
print(f"theta = {thetas[nearest]:.3f}: sends {rate}, costs {more:.1%} more than sending always")

assert abs(rate.value - WANTED) < 0.05
