"""A robot drives by velocities along and across its heading: how much disturbance does the linear design bear?

The design takes the heading for 0, where the robot is three integrators. The guarantee J ≤ (1 + θ) J_all is proved of
those; of the robot nothing is claimed, so it is measured.
"""

import numpy as np

import taciturn

DT, THETA = 0.1, 0.1  # seconds per tick, share of the cost that silence may cost


def drive(x, u):
    """Return dx/dt of position and heading, given velocities ahead, to the left, and of turning."""
    ahead, left, turning = u
    sine, cosine = np.sin(x[2]), np.cos(x[2])
    return np.array([cosine * ahead - sine * left, sine * ahead + cosine * left, turning])


step = taciturn.integrate(drive, DT)  # x⁺ = f(x, u, w), by Runge and Kutta's rule
A, B = taciturn.linearise(step, states=3, inputs=3)
cost = taciturn.Cost(np.eye(3), np.eye(3))
ratios = []
print(f"proved of the linearisation: at most {1 + THETA:g} times its all-time cost")
for size in (0.02, 0.08, 0.16, 0.24):  # standard deviation of what disturbs it in a tick, in m and in rad
    robot = taciturn.Plant(A, B, size**2 * np.eye(3), dt=DT, function=step)
    policy = taciturn.design.lqg(robot, cost, theta=THETA)
    found = taciturn.average(taciturn.close(robot, policy), steps=4_000_000)
    heading = np.degrees(taciturn.simulate(taciturn.close(robot, policy), 5000).state[:, 2].std())
    ratios.append(found.cost.value / policy.cost_all_time)
    print(
        f"heading ± {heading:4.1f}°: {ratios[-1]:.3f} times the linear all-time cost, "
        f"sends {found.rates['actuator'].value:.0%} of the time"
    )
assert ratios[0] < 1 + THETA < ratios[-1]
