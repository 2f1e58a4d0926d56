"""Rabi and others: one sample of a Wiener process (rabi2012), and packets that are lost (rabi2009).

Both estimate a Wiener process from samples. Taciturn controls, so the process is a plant and what a sample says is an
input; the policies are written out as data, because the catalogue has none that sends once or that forgets a loss.
"""

from __future__ import annotations

import numpy as np
import pytest
from counts import few

from taciturn import Cost, Network, Plant, average, close
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Decide, Location, Received, Send
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Scheduled, Trigger
from taciturn.renewal.chain import Chain
from taciturn.renewal.gaussian import solve_gaussian
from taciturn.simulation.sampling import Averages

ONE, NEVER = np.eye(1), 1e9
CLOCK, LEFT, SEND = "clock", "left", "send"


def sampled_once(thresholds: np.ndarray, steps: int) -> Averages:
    """Return E ∫ e² of a Wiener process on [0, 1] that is sent once, when e² first exceeds the threshold of its step.

    Steps are 1/N apart. A sample sets the state to zero by an input, and the cost is Σ x²/N.
    """
    N = len(thresholds)
    plant = Plant(ONE, ONE, ONE / N)
    cost = Cost(ONE / N, 1e-12 * ONE, horizon=N, terminal=[[0.0]])
    rule = Trigger({
        "silent": Form(("y",), ONE, Scheduled(LEFT, np.array([0.0, -NEVER]))),
        SEND: Form(constant=Scheduled(CLOCK, thresholds)),
    })  # fmt: skip
    policy = Policy(
        kind="one sample",
        steps=(
            Decide("controller", SEND, rule),
            Assign("controller", "command", {"y": -ONE}),
            Send("controller", "actuator", ("command",), SEND),
            Assign("actuator", "input", ({"input": 0 * ONE}, {"command": ONE}), Received("actuator")),
        ),
        model=plant,
        theory=Theory(cost=cost),
        sites=(frozenset({"sensor", "controller"}),),
        locations=(
            Location(CLOCK, np.minimum(np.arange(1, N + 1), N - 1)),
            Location(LEFT, np.array([[0, 1], [1, 1]]), at="controller", on=SEND),
        ),
    )
    return average(close(plant, policy), steps=steps)


@pytest.mark.parametrize(("fine", "missions"), [(200, 20_000), pytest.param(1600, 200_000, marks=pytest.mark.evidence)])
def test_one_sample_at_the_best_envelope_costs_a_quarter_of_the_root_of_three_less_one(
    fine: int, missions: int
) -> None:
    """(√3 − 1)/4 where e² is compared with √3 (1 − t); steps raise it by a multiple of 1/N, which two N tell apart."""
    costs = {}
    for N in (fine, fine // 4):
        left = 1 - np.arange(N) / N
        costs[N] = sampled_once(np.sqrt(3) * left, N * missions).cost
    value = (4 * costs[fine].value - costs[fine // 4].value) / 3
    error = np.hypot(4 * costs[fine].standard_error, costs[fine // 4].standard_error) / 3
    assert abs(value - (np.sqrt(3) - 1) / 4) <= 4 * error
    assert error < 2e-3


def test_one_sample_at_the_best_time_costs_a_quarter() -> None:
    """1/4 for the clock, which samples in the middle: (1 − 1/N²)/4 of N steps."""
    N = 51
    middle = np.full(N, NEVER / 2)
    middle[N // 2] = -1.0
    found = sampled_once(middle, N * 20_000).cost
    assert abs(found.value - (1 - N**-2.0) / 4) <= 4 * found.standard_error
    assert found.standard_error < 4e-3


def sent_on_delta(delta: float, loss: float, steps: int) -> Averages:
    """Return E e² before a send, of a Wiener process that is sent when it has moved by Δ since the last try.

    The second state is the estimate, which a packet that arrives sets to what it tells. Nothing is acknowledged. The
    input of the process stays zero, and the sensor reads the process alone.
    """
    process = np.array([[1.0, 0.0]])
    plant = Plant(np.eye(2), np.eye(2), np.diag([1.0, 0.0]))
    rule = Trigger({"silent": Form(("moved",), ONE), SEND: Form(constant=delta**2)})
    policy = Policy(
        kind="delta sampling",
        steps=(
            Assign("sensor", "process", {"y": process}),
            Assign("sensor", "moved", {"process": ONE, "last": -ONE}),
            Decide("sensor", SEND, rule),
            Send("sensor", "sensor", ("process",), SEND),
            Assign("sensor", "last", ({"last": ONE}, {"process": ONE}), SEND),
            Assign("controller", "heard", ({"held": ONE}, {"process": ONE}), Received("sensor")),
            Assign("actuator", "input", {"heard": np.array([[0.0], [1.0]]), "held": np.array([[0.0], [-1.0]])}),
            Assign("controller", "held", {"heard": ONE}),
        ),
        model=plant,
        theory=Theory(cost=Cost([[1.0, -1.0], [-1.0, 1.0]], 1e-12 * np.eye(2))),
        sites=(frozenset({"controller", "actuator"}),),
        network=Network("udp", sensor_loss=loss) if loss else Network(),
    )
    return average(close(plant, policy), steps=steps)


@pytest.mark.parametrize("loss", few([0.0, 0.2, 0.5], quick=1, start=1))
@pytest.mark.parametrize(("delta", "steps"), [(5.0, 2_000_000), pytest.param(20.0, 2e9, marks=pytest.mark.evidence)])
def test_a_wiener_process_over_a_link_that_loses_packets_costs_its_closed_form(
    loss: float, delta: float, steps: float
) -> None:
    """(5p + 1)/(6(1 − p)) of a level of 1: the mean square times the rate of tries, which has no unit of time.

    Looks every step pass the level by a little. Without losses, quadrature says by how much the product then differs
    from 1/6; losses add p/(1 − p) of the mean square at a try, which is 1/rate whatever the level.
    """
    published = (5 * loss + 1) / (6 * (1 - loss))
    unlost = solve_gaussian(Chain(ONE, ONE, ONE, delta**2, ONE))
    by_ticks = unlost.excess * unlost.rate - 1 / 6
    found = sent_on_delta(delta, loss, int(steps))
    tries = found.rates["sensor"]
    assert abs(tries.value - unlost.rate) <= 4 * tries.standard_error
    product, error = (found.cost.value - 1) * unlost.rate, found.cost.standard_error * unlost.rate
    assert abs(product - published - by_ticks) <= 4 * error
    assert abs(by_ticks) < 1 / delta**2
    assert error < 0.02 * published
