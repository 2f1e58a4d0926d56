"""Links with random delays or buffers: what designs see of several links, and messages that name what was written."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taciturn import ContinuousPlant, Cost, Network, Problem, ProblemError, UnstableError, load
from taciturn.design import excess
from taciturn.model.delay import Wait
from taciturn.model.link import LinkLaw
from taciturn.model.transport import expected_by

PLANT = ContinuousPlant([[0, 1], [2, -0.5]], [[0], [1]], np.diag([0.01, 0.3]), C=[[1, 0]], V=[[0.01]])
COST = Cost(np.diag([1.0, 0.1]), [[0.1]])
DELAYS = [0.2, 0.3, 0.5]


def pendulum(**changes: Any) -> Problem:
    """Return the inverted pendulum with keys of [network], and of [policy]."""
    keys = {
        name if name in ("kind", "design_delay", "theta") else f"network.{name}": one for name, one in changes.items()
    }
    return load("inverted-pendulum").changed({"kind": "excess", **keys})


def test_a_constant_delay_of_another_link_stays_in_the_plant_of_the_design() -> None:
    """Also if the network is stated a second time, without its constant delays."""
    links = {"sensor": LinkLaw(delay=1), "actuator": LinkLaw(delay=DELAYS)}  # type: ignore[arg-type]
    network = Network(links=links)
    once = expected_by(PLANT, network)
    again = expected_by(once, network.played())
    assert once.transport is not None
    assert again.transport == once.transport
    assert once.transport.outputs == (Wait(1),)
    with pytest.raises(ProblemError, match="another link has a constant delay"):
        pendulum(protocol="tcp", sensor_delay=1, actuator_delay=DELAYS).design()


def test_measurements_of_random_age_are_refused_without_a_link_that_sends_them() -> None:
    """The sensor is at the place of the controller."""
    problem = pendulum(sensor_delay=DELAYS)
    with pytest.raises(ProblemError, match=r"network\.sensor_delay is random.*network\.sensor_buffer"):
        problem.close(problem.design())


@pytest.mark.parametrize("kind", ["lqg", "send-on-delta"])
def test_a_kind_that_cannot_have_random_delays_names_them_and_a_buffer(kind: str) -> None:
    """And not the protocol, which nobody wrote."""
    more = {"theta": None, "delta": 0.01} if kind == "send-on-delta" else {}
    with pytest.raises(ProblemError, match=r"network\.actuator_delay is random.*network\.actuator_buffer"):
        load("inverted-pendulum").changed({"kind": kind, "network.actuator_delay": DELAYS, **more}).design()


def test_losses_by_a_buffer_name_the_buffer() -> None:
    """The buffer drops too many packets."""
    law = {"seconds": [0.01, 0.03], "probability": [0.05, 0.95]}
    with pytest.raises(
        UnstableError, match="packets that arrive up to 1 period late or never; expected a factor below 1"
    ):
        pendulum(protocol="tcp", actuator_delay=law, actuator_buffer={"seconds": 0.02}).design()


def test_the_delay_of_the_gains_is_checked() -> None:
    """It is a number from 0 on, and a given controller has its own gains."""
    network = Network(links={"actuator": LinkLaw(delay=DELAYS, acknowledged=True)})  # type: ignore[arg-type]
    for delay in (-0.1, float("nan"), 1e9):
        with pytest.raises(ProblemError, match="design_delay"):
            excess(PLANT, COST, theta=0.1, period=0.1, network=network, design_delay=delay)
    with pytest.raises(ProblemError, match="a controller is given"):
        excess(PLANT, COST, theta=0.1, period=0.1, network=network, design_delay=0.1, controller=[[-5.0]])  # type: ignore[arg-type]
    assert excess(PLANT, COST, theta=0.1, period=0.1, network=network, design_delay=0.1).guarantee is not None


def test_gains_that_do_not_fit_the_delays_are_refused_with_the_largest_delay() -> None:
    """Gains for two steps of delay make a plant unstable whose packets mostly come at once."""
    changes = {"design_delay": 0.04 * 4, "protocol": "tcp", "actuator_delay": [0.9, 0.0, 0.1]}
    with pytest.raises(UnstableError, match=r"up to 2 periods late.*design_delay"):
        pendulum(**changes).design()


def test_the_reason_without_acknowledgements_is_the_mean_delay() -> None:
    """The design assumes a constant delay, and so its plant is not another one by itself."""
    problem = pendulum(actuator_delay=DELAYS)
    (reason,) = problem.close(problem.design()).violated_assumptions
    assert reason == "packets are delayed at random, but the design assumes their mean delay"


def test_queries_are_scheduled_for_an_unstable_plant_whose_inputs_are_late() -> None:
    """Registers of late inputs have no error, and the part that is left needs no input that stabilises it."""
    problem = load("remote-scalar")
    rates = [problem.changed({"network.actuator_delay": steps}).design().schedule.rate for steps in (0, 1)]  # type: ignore[union-attr]
    assert rates[0] > 0
    assert problem.changed({"network.actuator_delay": 1}).design().cost_all_time > problem.design().cost_all_time  # type: ignore[operator]


@pytest.mark.evidence
def test_the_mean_delay_is_that_of_the_states_as_often_as_the_link_is_in_them() -> None:
    """Four fifths of the time in the first one: 0.26/0.98 of a step, and not 0.53, which would round to a step."""
    burst = {"to_bad": 0.1, "to_good": 0.4, "loss_good": 0.0, "loss_bad": 0.3}
    law = {"states": [[0.9, 0.1], [0.2, 0.5, 0.2]]}
    link = pendulum(protocol="udp", actuator_burst=burst, actuator_delay=law).network.links["actuator"]
    assert link.delay is not None
    assert link.delay.mean_by(link.states) == pytest.approx(0.26 / 0.98)
    assert link.delay.expected(link.states) == Wait(0)
    costs = [
        pendulum(protocol="tcp", actuator_burst=burst, actuator_delay=law, design_delay=delay).design().cost_all_time
        for delay in (None, 0.02 * 0.26 / 0.98, 0.02 * 1.0 / 1.9)
    ]
    assert costs[0] == pytest.approx(costs[1], rel=1e-12)
    assert abs(costs[0] - costs[2]) > 1e-6 * costs[0]


def test_several_lossy_links_may_be_late_at_random() -> None:
    """The threshold is a share of the cost of every attempt, with the losses and the mean delay."""
    problem = load("two-mass-lqg").changed({"kind": "distributed", "theta": 0.2, "network.protocol": "udp",
                                            "network.actuator_loss": 0.1, "network.sensor_loss": 0.1})  # fmt: skip
    late = problem.changed({"network.actuator_delay": [0.1, 0.8, 0.1]})
    constant = problem.changed({"network.actuator_delay": 1})
    assert late.design().cost_all_time == pytest.approx(constant.design().cost_all_time, rel=1e-12)
    assert late.close(late.design()).violated_assumptions
