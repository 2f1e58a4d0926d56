"""Does a policy designed for the linear model balance the nonlinear pendulum, and with how many packets?"""

import control
import numpy as np

import taciturn

GRAVITY, FRICTION, TORQUE = 9.81 / 0.5, 0.1, 4.0  # a pendulum of 0.5 m, upright at 0
period, seconds = 0.02, 5.0


def fall(t, x, u, params):
    """Return the time derivative of angle and angular velocity under a torque."""
    return np.array([x[1], GRAVITY * np.sin(x[0]) - FRICTION * x[1] + TORQUE * u[0]])


def move(t, x, u, params):
    """Return the state one period later under a constant torque, by four Runge-Kutta steps."""
    h = period / 4
    for _ in range(4):
        a = fall(t, x, u, params)
        b = fall(t, x + h / 2 * a, u, params)
        c = fall(t, x + h / 2 * b, u, params)
        x = x + h / 6 * (a + 2 * b + 2 * c + fall(t, x + h * c, u, params))
    return x


def measure(t, x, u, params):
    """Return the angle that an encoder with 1000 lines measures."""
    return np.round(x[:1] * 1000 / (2 * np.pi)) / 1000 * (2 * np.pi)


pendulum = control.nlsys(fall, lambda t, x, u, params: x[:1], inputs=1, outputs=1, states=2, name="smooth")
upright = control.linearize(pendulum, [0, 0], [0])
plant = taciturn.from_control(upright, W=np.diag([0, 0.05]), V=[[1e-5]])
cost = taciturn.Cost(Q=np.diag([10, 1]), R=[[0.1]])
policy = taciturn.design.lqg(plant, cost, theta=0.3, period=period, actuation="model")

real = control.nlsys(move, measure, inputs=["u[0]"], outputs=["y[0]"], states=2, dt=period, name="pendulum")
diagram = control.interconnect(
    [real, taciturn.to_control(policy)], inplist=[], outlist=["pendulum.y[0]", "lqg.u[0]", "lqg.sent_actuator"]
)
times = np.arange(0, seconds, period)
angle, torque, sent = control.input_output_response(diagram, times, X0=[0.5, 0.0]).outputs
print(
    f"from {angle[0]:.2f} to at most {abs(angle[-50:]).max():.3f} rad, {sent.sum():.0f} packets in {len(times)} steps"
)
assert abs(angle[-50:]).max() < 0.05
assert sent.mean() < 0.5
