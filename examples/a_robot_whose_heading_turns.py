"""How much disturbance does a linear design tolerate on an omnidirectional robot whose heading turns?

The design assumes the heading 0, where the robot is three integrators. The guarantee J ≤ (1 + θ) J_all is proved for
these integrators. It does not cover the robot, whose cost is therefore simulated.
"""

import numpy as np

import taciturn

DT, THETA = 0.1, 0.1  # seconds per step, share of the cost that silence may add


def drive(x, u):
    """Return dx/dt of position and heading, given the velocities ahead and to the left and the turning rate."""
    ahead, left, turning = u
    sine, cosine = np.sin(x[2]), np.cos(x[2])
    return np.array([cosine * ahead - sine * left, sine * ahead + cosine * left, turning])


step = taciturn.integrate(drive, DT)  # x⁺ = f(x, u, w), by the Runge-Kutta method
A, B = taciturn.linearise(step, states=3, inputs=3)
cost = taciturn.Cost(np.eye(3), np.eye(3))
ratios = []
print(f"guarantee for the linearisation: at most {1 + THETA:g} times its cost at every sample")
for size in (0.02, 0.08, 0.16, 0.24):  # standard deviation of the disturbance of a step, in m and in rad
    robot = taciturn.Plant(A, B, size**2 * np.eye(3), dt=DT, function=step)
    policy = taciturn.design.lqg(robot, cost, theta=THETA)
    found = taciturn.average(taciturn.close(robot, policy), steps=4_000_000)
    heading = np.degrees(taciturn.simulate(taciturn.close(robot, policy), 5000).state[:, 2].std())
    ratios.append(found.cost.value / policy.cost_all_time)
    print(
        f"heading ± {heading:4.1f}°: {ratios[-1]:.3f} times the linear cost at every sample, "
        f"sends in {found.rates['actuator'].value:.0%} of the steps"
    )
assert ratios[0] < 1 + THETA < ratios[-1]
