"""Constant delays as properties of a plant: its inputs act later than they are commanded, and its outputs are old.

A link that delays every packet by the same time, or whose receiver uses each packet so long after it was sent
(``LinkLaw.buffer``), leaves the order of all operations as it is: each node carries out its step k later than the node
before it by the delay of the link. Seen from the plant, the input that the controller commands for step k acts later,
and the outputs of which it is computed are older. So the link is one without delay, at a plant with delays, and every
design, theorem, program and packet is that of a plant without delays (``lqg.transport``).

A loop that is later as a whole is the same loop, so only sums matter: a delay that all outputs share delays the inputs.
The controller acts when the latest sample of a step has arrived, which sets the part of a period that it waits.
"""

from __future__ import annotations

from typing import cast

from taciturn.model.delay import Transport, Wait
from taciturn.model.network import Network
from taciturn.model.plant import AnyPlant, DisplayedPlant, altered


def delayed_by(plant: AnyPlant, network: Network) -> AnyPlant:
    """Return a plant with the constant delays of the links of a network; a network without any changes no plant."""
    found = transport_of(plant, network)
    return plant if found is None or plant.transport == found else with_transport(plant, found)


def expected_by(plant: AnyPlant, network: Network) -> AnyPlant:
    """Return a plant for a design: with the constant delays of links, and the mean of random ones to actuators.

    A design gets anything else as it is, and refuses it.
    """
    if not isinstance(cast("object", plant), DisplayedPlant):
        return plant
    links = network.links.items()
    means = {name: law.delay.expected(law.states) for name, law in links if name in network.late and law.delay}
    # of a network whose constant delays the plant shows already, they are those of the plant
    certain = transport_of(plant, network) or (plant.transport and plant.transport.certain)
    found = certain or Transport((Wait(),) * plant.inputs, (Wait(),) * len(plant.C))
    inputs = list(found.inputs)
    for name, wait in means.items():
        for index in network.nodes[name].entries("applies", plant.inputs):
            if index < len(inputs):
                inputs[index] = wait
    late = Transport.of(inputs, found.outputs)
    if late is None or (not means and certain is None):
        return plant
    return with_transport(plant, Transport(late.inputs, late.outputs, certain) if means else late)


def promptly(plant: AnyPlant, network: Network) -> AnyPlant:
    """Return a plant for a design whose receivers make up for random delays: without the mean of these."""
    return with_transport(plant, plant.transport.certain) if network.late and plant.transport is not None else plant


def with_transport(plant: AnyPlant, transport: Transport | None) -> AnyPlant:
    """Return a copy of a plant with other constant delays."""
    return altered(plant, {"transport": transport})


def transport_of(plant: DisplayedPlant, network: Network) -> Transport | None:
    """Return the delays of inputs and outputs over the links of a network; None if no link has a constant delay."""
    waits = {name: law.wait for name, law in network.links.items() if any(law.wait)}
    if not waits:
        return None
    found = {"measures": [Wait()] * len(plant.C), "applies": [Wait()] * plant.inputs}
    for name, wait in waits.items():
        role = network.nodes[name]
        for key, listed in found.items():
            for index in role.entries("measures" if key == "measures" else "applies", len(listed)):
                if index < len(listed):  # an index that is too large has a message of its own
                    listed[index] = wait
    return Transport.of(found["applies"], found["measures"])
