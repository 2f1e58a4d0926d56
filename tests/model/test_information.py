"""A policy whose nodes use what they cannot know is refused when its loop is closed."""

from __future__ import annotations

import numpy as np
import pytest

from taciturn import Cost, Network, Plant, Policy, Trigger, close
from taciturn.errors import InformationError
from taciturn.model.information import check_information
from taciturn.model.steps import Acknowledged, Assign, Decide, Draw, Evaluate, Location, Received, Send, Step
from taciturn.model.trigger import Form, Scheduled

PLANT = Plant([[0.9]], [[1.0]], [[1.0]])
COST = Cost([[1.0]], [[1.0]])
ONE = np.eye(1)
COLLOCATED = (frozenset[str]({"sensor", "controller"}),)
COMMAND = Assign("controller", "command", {"y": -0.5 * ONE})
DECIDE = Decide("controller", "send", Trigger({"silent": Form(("command",), ONE), "send": Form(constant=1.0)}))
SEND = Send("controller", "actuator", ("command",), "send")
INPUT = Assign("actuator", "input", ({"input": ONE}, {"command": ONE}), Received("actuator"))
LEGAL: tuple[Step, ...] = (COMMAND, DECIDE, SEND, INPUT)
HELD = Assign("controller", "held", ({"held": ONE}, {"command": ONE}), Acknowledged("actuator"))
GATES = Scheduled("mode", [[[1.0]], [[0.0]]])
SHARED = Location("mode", np.array([1, 0]))
OWNED = Location("mode", np.array([[1, 0], [0, 1]]), "controller", "send")


def make(*steps: Step, sites: tuple[frozenset[str], ...] = COLLOCATED, locations: tuple[Location, ...] = ()) -> Policy:
    """Return a policy of these steps."""
    return Policy("hand-made", steps, PLANT, sites=sites, locations=locations)


def refusal(policy: Policy, network: Network | None = None) -> str:
    """Return the sentence with which the loop is refused, by the check and by ``close`` alike."""
    with pytest.raises(InformationError) as found:
        check_information(policy, network or Network())
    with pytest.raises(InformationError) as closed:
        close(PLANT, policy, network, COST)
    assert str(closed.value) == str(found.value)
    return str(found.value)


@pytest.mark.parametrize("network", [Network(), Network("udp", 0.1), Network("tcp", 0.1)], ids=str)
def test_a_policy_that_keeps_to_its_packets_is_legal(network: Network) -> None:
    """Controller at the sensor's site, an input that changes only when a packet arrives."""
    check_information(make(*LEGAL), network)
    assert close(PLANT, make(*LEGAL), network, COST).network == network


def test_an_acknowledgement_is_heard_under_tcp_and_on_ideal_links_only() -> None:
    """Under udp the controller cannot know what arrived."""
    policy = make(*LEGAL, HELD)
    for network in (Network("tcp", 0.1), Network()):
        check_information(policy, network)
    assert refusal(policy, Network("udp", 0.1)) == (
        "the node controller uses an acknowledgement of the actuator link, but protocol 'udp' sends none; "
        "expected protocol "
        "'tcp'"
    )


def test_an_acknowledgement_goes_to_the_sender_alone() -> None:
    """Neither another node nor a link that carries nothing has one."""
    wrong = Assign("actuator", "held", ({"held": ONE}, {"input": ONE}), Acknowledged("actuator"))
    nothing = Assign("controller", "held", ({"held": ONE}, {"command": ONE}), Acknowledged("sensor"))
    for steps, node, link in ((wrong, "actuator", "actuator"), (nothing, "controller", "sensor")):
        told = refusal(make(*LEGAL, steps), Network("tcp"))
        assert told == f"the node {node} uses an acknowledgement of the {link} link; expected a link on which it sends"


def test_an_actuator_cannot_read_a_signal_of_the_controller() -> None:
    """Neither without a packet nor in the branch where none arrived."""
    told = (
        "the node actuator reads the signal 'command', which is not available there; expected a signal of its site or "
        "of a received packet"
    )
    assert refusal(make(COMMAND, Assign("actuator", "input", {"command": ONE}))) == told
    swapped = Assign("actuator", "input", ({"command": ONE}, {"input": ONE}), Received("actuator"))
    assert refusal(make(COMMAND, DECIDE, SEND, swapped)) == told


def test_a_packet_brings_its_payload_and_nothing_else() -> None:
    """What was not in the packet stays unknown when it arrives."""
    other = Assign("controller", "other", {"y": ONE})
    reads = Assign("actuator", "input", ({"input": ONE}, {"other": ONE}), Received("actuator"))
    assert refusal(make(COMMAND, other, DECIDE, SEND, reads)).startswith(
        "the node actuator reads the signal 'other', which is not available there"
    )


def test_a_measurement_belongs_to_the_sensors_site() -> None:
    """A remote controller has to be sent it."""
    assert refusal(make(*LEGAL, sites=())).startswith(
        "the node controller reads the signal 'y', which is not available there"
    )
    remote = Assign("controller", "command", ({"command": ONE}, {"y": -0.5 * ONE}), Received("sensor"))
    check_information(make(Send("sensor", "sensor", ("y",)), remote, DECIDE, SEND, INPUT, sites=()), Network())


def test_a_node_cannot_use_the_decision_of_another() -> None:
    """The actuator learns by packets, and a sensor elsewhere does not know what the controller decided."""
    told = (
        "the node actuator uses the decision 'send' of another node; expected one of its own decisions, or a "
        "received packet"
    )
    assert refusal(make(COMMAND, DECIDE, SEND, Assign("actuator", "input", ({"input": ONE},) * 2, "send"))) == told
    form = Evaluate("actuator", "memory", (Form(), Form(constant=1.0)), "send")
    assert refusal(make(*LEGAL, form)) == told
    query = Send("sensor", "sensor", ("y",), "send")
    remote = Assign("controller", "command", ({"command": ONE}, {"y": -0.5 * ONE}), Received("sensor"))
    assert refusal(make(remote, DECIDE, SEND, INPUT, query, sites=())).startswith(
        "the node sensor uses the decision 'send'"
    )


def test_a_trigger_cannot_read_what_its_node_does_not_hold() -> None:
    """Neither in its quadratic part nor among the scalars it adds."""
    far = Decide("actuator", "far", Trigger({"a": Form(("command",), ONE), "b": Form()}))
    assert refusal(make(*LEGAL, far)).startswith(
        "the node actuator reads the signal 'command', which is not available there"
    )
    draw = Draw("sensor", "draw")
    remote = Assign("controller", "command", ({"command": ONE}, {"y": -0.5 * ONE}), Received("sensor"))
    peek = Decide("controller", "send", Trigger({"a": Form(), "b": Form(plus={"draw": 1.0})}))
    steps = (draw, Send("sensor", "sensor", ("y",)), remote, peek, SEND, INPUT)
    assert refusal(make(*steps, sites=())).startswith(
        "the node controller reads the signal 'draw', which is not available there"
    )


def test_a_node_hears_its_own_links_only() -> None:
    """The sensor does not know what reached the actuator."""
    deaf = Assign("controller", "held", ({"held": ONE}, {"command": ONE}), Received("actuator"))
    assert refusal(make(*LEGAL, deaf)) == (
        "the node controller uses packets of the actuator link, which it does not receive; expected a link on "
        "which it receives "
        "packets"
    )


def test_a_signal_has_one_owner() -> None:
    """Two nodes cannot write the same memory."""
    again = Assign("actuator", "command", {"input": ONE})
    assert refusal(make(*LEGAL, again)) == (
        "the signal command is assigned at the node actuator and at another site; expected only one site "
        "that assigns this signal"
    )


@pytest.mark.parametrize(
    "read",
    [
        Assign("actuator", "scaled", {"input": GATES}),
        Evaluate("actuator", "memory", (Form(("input",), GATES),)),
        Evaluate("actuator", "memory", (Form(constant=Scheduled("mode", [0.0, 1.0])),)),
        Decide("actuator", "far", Trigger({"a": Form(("input",), GATES), "b": Form()})),
    ],
    ids=lambda step: type(step).__name__,
)
def test_a_location_is_read_at_its_site_unless_it_is_a_clock(read: Step) -> None:
    """A location that moves with the controller's decisions is unknown at the actuator."""
    told = (
        "the node actuator reads the location 'mode' of the node controller; expected a location of its own or a "
        "shared step counter"
    )
    assert refusal(make(*LEGAL, read, locations=(OWNED,))) == told
    check_information(make(*LEGAL, read, locations=(SHARED,)), Network())


def test_a_location_moves_with_what_its_own_node_sees() -> None:
    """A decision of another node, or an acknowledgement that udp does not send, cannot move it."""
    stolen = Location("mode", np.array([[1, 0], [0, 1]]), "actuator", "send")
    assert refusal(make(*LEGAL, locations=(stolen,))).startswith(
        "the node actuator uses the decision 'send' of another node"
    )
    told = Location("mode", np.array([[1, 0], [0, 1]]), "controller", Acknowledged("actuator"))
    check_information(make(*LEGAL, locations=(told,)), Network("tcp", 0.1))
    assert "protocol 'udp' sends none" in refusal(make(*LEGAL, locations=(told,)), Network("udp", 0.1))
