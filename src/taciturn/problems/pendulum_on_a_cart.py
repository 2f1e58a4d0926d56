"""Step function of ``pendulum-on-a-cart``: nonlinear dynamics of an inverted pendulum on a cart, for any angle."""

from __future__ import annotations

from typing import Any

import numpy as np

from taciturn.model.dynamics import integrate

CART, FRICTION = 0.5, 0.1  # kg, N s/m
PENDULUM, LENGTH, INERTIA = 0.2, 0.3, 0.006  # kg, m to its centre of mass, kg m² about it
GRAVITY = 9.81  # m/s²
SECONDS = 0.02  # seconds per step


def swing(x: Any, u: Any) -> Any:
    """Return dx/dt for the state x: cart position, cart velocity, angle from upright, and angular velocity.

    With the masses M and m of cart and pendulum, friction b, length l, inertia I, gravity g, force F,
    r = F − b ẋ − m l φ̇² sin φ and D = (M+m)(I+ml²) − (m l cos φ)²,

        D ẍ = (I+ml²) r + m l cos φ · m g l sin φ,   D φ̈ = (M+m) m g l sin φ + m l cos φ · r
    """
    _, velocity, angle, turning = x
    sine, cosine = np.sin(angle), np.cos(angle)
    arm = PENDULUM * LENGTH
    about_pivot, mass = INERTIA + arm * LENGTH, CART + PENDULUM
    pushed = u[0] - FRICTION * velocity - arm * turning * turning * sine
    toppled = arm * GRAVITY * sine
    lever = arm * cosine
    divisor = mass * about_pivot - lever * lever
    return np.array(
        [
            velocity,
            (about_pivot * pushed + lever * toppled) / divisor,
            turning,
            (mass * toppled + lever * pushed) / divisor,
        ]
    )


step = integrate(swing, SECONDS, steps=2)
