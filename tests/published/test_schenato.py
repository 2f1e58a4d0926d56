"""Schenato and others: the critical losses of control over lossy networks (schenato2007).

With acknowledgements: 1/max|λ|² where B is invertible, 1/Π|λ|² over the unstable modes for one input. Both are laws
over many plants in ``tests/lqg/test_lossy.py``; here is what holds without acknowledgements.
"""

from __future__ import annotations

import numpy as np
import pytest
from counts import few

from taciturn import Cost, Network, Plant, UnstableError, design
from taciturn.lqg.critical_losses import Channel
from taciturn.lqg.lossy import critical_losses


def test_the_pendubot_survives_losses_below_the_product_of_its_unstable_modes() -> None:
    """The example's pendubot, of eigenvalues 1.0615, 1.0335, 0.9679 and 0.9411, and one input: 1/Π|λ|² = 0.8309."""
    A = np.array([
        [1.001, 0.005, 0.0, 0.0],
        [0.35, 1.001, -0.135, 0.0],
        [-0.001, 0.0, 1.001, 0.005],
        [-0.375, -0.001, 0.590, 1.001],
    ])  # fmt: skip
    B = np.array([[0.001], [0.540], [-0.002], [-1.066]])
    modes = np.sort(np.linalg.eigvals(A).real)[::-1]
    assert modes == pytest.approx([1.0615, 1.0335, 0.9679, 0.9411], abs=5e-5)
    found = critical_losses(A, B, Channel(0.0, 0.0, acknowledged=True, delayed=False))
    assert found[0] == pytest.approx(np.prod(modes[:2]) ** -2, rel=1e-8)
    assert found[0] == pytest.approx(0.8309, abs=5e-5)
    assert found[1] == pytest.approx(modes[0] ** -2, rel=1e-8)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("largest", few([1.25, 3.0], quick=1))
def test_without_acknowledgements_the_critical_losses_trade_as_published(largest: float, share: float) -> None:
    """|λ|²(γ + ν − 2γν) < γ + ν − γν of the arrivals ν and γ, for scalar plants and wherever B is invertible."""
    sensor = share / largest**2  # part of what the sensor link alone may lose
    actuator = (1 - largest**2 * sensor) / (largest**2 * (1 - 2 * sensor) + sensor)
    nu, gamma = 1 - actuator, 1 - sensor
    assert largest**2 * (gamma + nu - 2 * gamma * nu) == pytest.approx(gamma + nu - gamma * nu)
    link = Channel(0.0, sensor, acknowledged=False, delayed=False)
    turned = largest * np.array([[0.6, 0.8], [-0.8, 0.6]])
    for A, B in (([[largest]], [[1.0]]), (np.diag([largest, 0.9]), np.eye(2)), (turned, [[1.0, 0.5], [0.0, 2.0]])):
        assert critical_losses(np.array(A), np.array(B), link)[0] == pytest.approx(actuator, abs=1e-6)


def test_a_design_is_refused_on_the_far_side_of_the_published_losses() -> None:
    """λ = 2 and a tenth of the measurements lost: actuator losses below 2/11 are survived."""
    plant, cost = Plant([[2.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    limit = (1 - 4 * 0.1) / (4 * (1 - 2 * 0.1) + 0.1)
    assert limit == pytest.approx(2 / 11)
    below, above = (Network("udp", actuator_loss=factor * limit, sensor_loss=0.1) for factor in (0.99, 1.01))
    assert design.lossy_lqg(plant, cost, price=0.0, network=below).cost_all_time is not None
    with pytest.raises(UnstableError, match=r"actuator losses below 0\.181818 at this sensor loss"):
        design.lossy_lqg(plant, cost, price=0.0, network=above)
