"""How much communication does each event-triggered policy save on two masses and a spring, and at what cost?"""

import taciturn

problem = taciturn.load("two-mass-lqg")
grid = taciturn.tradeoff(problem, {"theta": [0.05, 0.2, 1.0], "trigger": ["joint", "separate"]}, standard_error=2e-4)
for point in grid.points:
    found = point.evaluation
    above = found.cost.value / found.cost_all_time - 1
    periodic = point.cost_periodic_same_rate / found.cost_all_time - 1
    print(f"{point.values}: sends {found.rates['actuator'].value:.1%}, costs {above:.2%} more than every sample,")
    print(f"  periodic control at this rate {periodic:.2%} more")
grid.plot().savefig("two_masses_over_a_network.svg")
assert all(point.evaluation.cost.value < point.cost_periodic_same_rate for point in grid.points)
