"""Imer, Yüksel and Başar: control of a measured state over links without acknowledgements (imer2006).

Their problem, solved here by its outcomes and without a Riccati equation: until the next measurement arrives inputs are
numbers, and the cost is a quadratic of them. The paper's own figures are not compared with.
"""

from __future__ import annotations

import numpy as np
import pytest
from counts import few

from taciturn.lqg.critical_losses import Channel
from taciturn.lqg.lossy import regulate_lossy_finite


def best(
    a: float, b: float, weights: tuple[float, float, float], losses: tuple[float, float], horizon: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return v_k, the least cost from x_k = 1 where that is known, and the first input of it, for every k < horizon.

    Until the next measurement inputs u_k, u_{k+1}, … are numbers z, and x_{k+j} = a^j + Σ_i a^{j−1−i} b α_i z_i with
    independent α_i, 1 where input i arrives.
    """
    q, r, terminal = weights
    lost, unseen = losses
    arrive = 1 - lost
    values, inputs = np.append(np.zeros(horizon), terminal), np.zeros(horizon)
    for k in reversed(range(horizon)):
        count = horizon - k
        square, linear, constant = np.zeros((count, count)), np.zeros(count), 0.0
        for j in range(count + 1):
            reach = np.array([a ** (j - 1 - i) * b if i < j else 0.0 for i in range(count)])
            second = arrive**2 * np.outer(reach, reach) + arrive * lost * np.diag(reach**2)
            silent = unseen**j  # nothing arrived at k + 1, …, k + j
            heard = unseen ** (j - 1) * (1 - unseen) if j else 0.0  # the first to arrive is that of k + j
            if j == count:
                weight = (silent + heard) * terminal
            else:
                weight = silent * q + heard * values[k + j]
                square[j, j] += silent * arrive * r
            square += weight * second
            linear += weight * arrive * a**j * reach
            constant += weight * a ** (2 * j)
        z = -np.linalg.solve(square, linear)
        values[k], inputs[k] = constant + linear @ z, z[0]
    return values, inputs


@pytest.mark.parametrize("losses", few([(0.0, 0.4), (0.3, 0.1), (0.3, 0.6), (0.8, 0.7)], quick=1, start=2))
@pytest.mark.parametrize("a", [0.8, 1.0, 2.0])
def test_the_best_control_without_acknowledgements_is_the_one_found_by_enumeration(
    a: float, losses: tuple[float, float]
) -> None:
    """Cost and first input from every time at which the state is known, to the end of the finite-horizon run."""
    b, (q, r, terminal), horizon = 0.7, (1.0, 0.5, 2.0), 12
    values, inputs = best(a, b, (q, r, terminal), losses, horizon)
    matrices = (np.array([[number]]) for number in (a, b, q, r, terminal))
    found = regulate_lossy_finite(*matrices, horizon, Channel(*losses, acknowledged=False, delayed=False))
    assert found.K[:, 0, 0] == pytest.approx(values, rel=1e-9)
    assert found.L[:, 0, 0] == pytest.approx(inputs, rel=1e-9)
