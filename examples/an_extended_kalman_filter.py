"""How much does an extended Kalman filter lower the cost on a stiffening spring? Two steps of a policy as functions.

The position is measured with noise. The filter of the linear design contains only the soft spring near rest. The
extended filter predicts the estimate with the nonlinear plant and its covariance with the local slope. Gain and trigger
are the same.
"""

import numpy as np

import taciturn
from taciturn.model.policy import Policy
from taciturn.model.steps import Apply, Step

DT, KEPT = 0.1, 1 - 0.1 * 0.2  # seconds per step; factor of the speed after damping
C, V, W = np.array([[1.0, 0.0]]), np.array([[0.5]]), np.diag([1e-5, 0.1])
Array = np.ndarray


def swing(x: Array, u: Array, w: Array) -> Array:
    """Return position and speed one step later, under a linear and cubic spring force, the input and noise."""
    speed = KEPT * x[1] + DT * (u[0] - x[0] - 3 * x[0] ** 3)
    return np.array([x[0] + DT * speed, speed]) + w


def slope(x: Array) -> Array:
    """Return the derivative of the next state with respect to the present one."""
    pull = -DT * (1 + 9 * x[0] ** 2)
    return np.array([[1 + DT * pull, DT * KEPT], [pull, KEPT]])


def correct(prior: Array, spread: Array, y: Array) -> tuple[Array, Array]:
    """Return the estimate and its covariance, given the measured position."""
    P = spread.reshape(2, 2)
    K = np.linalg.solve(C @ P @ C.T + V, C @ P).T
    kept = np.eye(2) - K @ C
    return prior + K @ (y - C @ prior), (kept @ P @ kept.T + K @ V @ K.T).ravel()


def predict(estimate: Array, covariance: Array, held: Array) -> tuple[Array, Array]:
    """Return estimate and covariance one step later under the held input."""
    F = slope(estimate)
    return swing(estimate, held, np.zeros(2)), (F @ covariance.reshape(2, 2) @ F.T + W).ravel()


plant = taciturn.Plant(slope(np.zeros(2)), [[DT**2], [DT]], W, C, V, dt=DT, function=swing)
cost = taciturn.Cost(Q=np.eye(2), R=[[5.0]])
fixed = taciturn.design.lqg(plant, cost, theta=0.3)
new: dict[str, Step] = {
    "estimate": Apply("controller", {"estimate": 2, "covariance": 4}, correct, ("prior", "spread", "y")),
    "prior": Apply("controller", {"prior": 2, "spread": 4}, predict, ("estimate", "covariance", "held")),
}
steps = tuple(new.get(getattr(step, "signal", ""), step) for step in fixed.steps)
extended = Policy("extended", steps, plant, taciturn.Theory(cost, settling=fixed.theory.settling), fixed.sites,
                  initial={"spread": W.ravel()}, tick=DT)  # fmt: skip
before, after = (taciturn.close(plant, policy) for policy in (fixed, extended))
saved = taciturn.difference(before, after, steps=1_000_000)  # with the same noise
print(f"fixed gain: cost {taciturn.average(before, steps=500_000).cost}; extended filter: {saved.cost} less")
assert saved.cost.value > 5 * saved.cost.standard_error
