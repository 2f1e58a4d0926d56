"""A scalar plant over links that drop packets: independent losses (hadjicostis2002) and bursts of them (huang2007)."""

from __future__ import annotations

import pytest

from taciturn import Burst, Cost, Network, Plant, average, close, design


@pytest.mark.parametrize(("a", "loss"), [(1.1, 0.3), (1.5, 0.4), (-1.2, 0.6), (0.8, 0.7)])
def test_the_variance_over_a_link_that_loses_packets_is_the_published_one(a: float, loss: float) -> None:
    """W/(1 − αa²): the input cancels ax where it arrives, and inputs are free."""
    plant, cost = Plant([[a]], [[1.0]], [[0.7]]), Cost([[1.0]], [[1e-12]])
    policy = design.lossy_lqg(plant, cost, price=0.0, network=Network("tcp", actuator_loss=loss))
    assert policy.cost_all_time == pytest.approx(0.7 / (1 - loss * a * a), rel=1e-11)


@pytest.mark.parametrize("steps", [2_000_000, pytest.param(2_000_000_000, marks=pytest.mark.evidence)])
def test_the_variance_over_a_link_that_loses_bursts_is_the_sum_over_their_lengths(steps: int) -> None:
    """W(1 + a²π/(1 − a²(1 − q))), which is finite iff a²(1 − q) < 1, with the share π = p/(p + q) of dropped packets.

    The link fails with the probability p and recovers with q. An error of j losses in a row has the variance
    W(a^{2j} − 1)/(a² − 1), and the j-th loss of a burst the probability πq(1 − q)^{j−1}. Here a⁴(1 − q) < 1 as well, so
    that squares have a variance and a standard error says what it seems to.
    """
    a, p, q = 1.2, 0.1, 0.6
    share = p / (p + q)
    published = 1 + a * a * share / (1 - a * a * (1 - q))
    assert published == pytest.approx(1.48518, abs=5e-6)
    assert a**4 * (1 - q) < 1
    plant, cost = Plant([[a]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1e-9]])
    network = Network("tcp", sensor_burst=Burst(to_bad=p, to_good=q, loss_good=0.0, loss_bad=1.0))
    loop = close(plant, design.lossy_lqg(plant, cost, price=0.0, network=network))
    found = average(loop, steps=steps).cost
    assert abs(found.value - published) <= 4 * found.standard_error
    assert found.standard_error < 0.01
