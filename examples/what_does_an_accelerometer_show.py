"""What does it cost to ignore that an accelerometer shows the force that the motor of a cart applies?"""

import numpy as np

import taciturn

# cart of 2 kg with friction, whose position and acceleration are measured; acceleration = (u - 0.5 v)/2
A, B, W = [[0, 1], [0, -0.25]], [[0], [0.5]], np.diag([0, 0.2])
C, D, V = [[1, 0], [0, -0.25]], [[0], [0.5]], np.diag([1e-3, 0.05])
cart = taciturn.ContinuousPlant(A, B, W, C=C, V=V, D=D)  # D u: the sample shows the force of the step before
cost = taciturn.Cost(np.diag([4, 1]), [[0.1]])

found = {}
for name, model in {"with D": cart, "without D": taciturn.ContinuousPlant(A, B, W, C=C, V=V)}.items():
    policy = taciturn.design.excess(model, cost, theta=0.2, period=0.1)
    loop = taciturn.close(cart, policy)  # the plant has D in both cases
    found[name] = taciturn.average(loop, steps=4_000_000, seed=1).cost.value
    print(f"designed {name:9s}: cost {found[name]:.3f}; {', '.join(loop.violated_assumptions) or 'as designed'}")
print(f"a design that ignores D costs {found['without D'] / found['with D'] - 1:.0%} more")
assert found["without D"] > 1.05 * found["with D"]
