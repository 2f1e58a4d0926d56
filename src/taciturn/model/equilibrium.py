"""Equilibria of nonlinear plants, which are their operating points."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, quoted
from taciturn.errors import ProblemError
from taciturn.model.dynamics import Dynamics, Map

NEWTON, REST = 50, 1e-13  # most steps of Newton's method, and its largest residual relative to the first state


def equilibrium(function: Map, x: ArrayLike, u: ArrayLike) -> Array:
    """Return the state at which x⁺ = f(x, u, w) rests with a constant input and w = 0, by Newton's method.

    Args:
        function: f(x, u, w), as for :func:`linearise`.
        x: a state near the equilibrium, (n,), such as one with rounded digits.
        u: the input, (m,).

    Returns:
        The state, (n,), with f(x, u, 0) = x within rounding errors.

    Raises:
        ProblemError: the function fails, or no equilibrium is found.

    Example:
        >>> import numpy as np
        >>> from taciturn import integrate
        >>> tank = integrate(lambda x, u: [u[0] - 0.5 * np.sqrt(x[0])], dt=1.0)
        >>> equilibrium(tank, [15.0], [2.0]).round(9).tolist()
        [16.0]
    """
    if not callable(function):
        raise ProblemError(f"function is {quoted(function)}; expected a function x, u, w → x⁺")
    found, input = array("x", x, (None,), "(states,)"), array("u", u, (None,), "(inputs,)")
    f, n, size = Dynamics(function), len(found), max(1.0, float(np.abs(found).max()))
    for _ in range(NEWTON):
        off = f(found, input, np.zeros(n)) - found
        if not np.isfinite(off).all():
            break
        if np.abs(off).max() <= REST * size:
            return found
        slope = f.derivatives(found, input)[0] - np.eye(n)
        found = found - np.linalg.lstsq(slope, off, rcond=None)[0]
    raise ProblemError(
        f"no equilibrium of function is found from x = {np.asarray(x).tolist()} with u = {input.tolist()}; expected a "
        "state near an equilibrium, and an input with which the plant rests"
    )
