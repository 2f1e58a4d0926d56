"""Positions of all inputs and outputs in the time step of a node, for the back ends that run nodes."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil
from typing import Literal, NamedTuple

from taciturn.model.network import REFERENCE
from taciturn.model.places import is_acknowledged
from taciturn.model.policy import Acknowledged, Policy, Received
from taciturn.model.wire import SETPOINT
from taciturn.program.draws import UNIFORM
from taciturn.program.names import Entry, Name, Option, Sent, StepCounter
from taciturn.program.node import NodeProgram

FORGOTTEN = 7.0  # time constants after which the effect of a fault is negligible: e^-7 < 1e-3
NEVER = 1 << 62


class Arrival(NamedTuple):
    """Packets (data or acknowledgements) that a node receives on one link, and their positions among its inputs.

    Args:
        kind: ``"data"``, ``"acknowledgement"``, or ``"measurement"`` for set-points, of which the last are kept.
        link: link on which they arrive.
        lag: number of steps between the sending of a packet and the step that reads it.
        at: position of the flag "arrived" among the inputs; the payload is after it.
        size: number of entries of the payload.
        part: index of the part of the step that reads the packet.
        acknowledged: whether the receiver acknowledges packets.
    """

    kind: Literal["data", "acknowledgement", "measurement"]
    link: str
    lag: int
    at: int
    size: int
    part: int
    acknowledged: bool


class Departure(NamedTuple):
    """Packets that a node sends over one link, and their positions among its outputs.

    Args:
        link: link on which they are sent.
        at: position of the flag "sent" among the outputs; the payload is after it.
        size: number of entries of the payload.
    """

    link: str
    at: int
    size: int


@dataclass(frozen=True)
class Layout:
    """Positions of measurements, packets, random numbers and inputs of the plant in the time step of a node.

    Args:
        inputs: names of all inputs: measurement, step counters, packets, and random numbers.
        measured: number of entries of the measurement; 0 without a sensor.
        wiring: for each part of the step, the positions of its inputs among all inputs.
        clocks: position of the first step counter among the inputs.
        drawn: positions of the random numbers among the inputs.
        arrivals: the packets that the node reads.
        departures: the packets that the node sends.
        applied: positions of the plant's input among the outputs; None if the node does not apply it.
        options: positions of the values of all trigger options among the outputs, by name.
        remembers: number of steps after which the effect of a fault, which the theory excludes, is negligible.
    """

    inputs: tuple[Name, ...]
    measured: int
    wiring: tuple[tuple[int, ...], ...]
    clocks: int
    drawn: slice
    arrivals: tuple[Arrival, ...]
    departures: tuple[Departure, ...]
    applied: slice | None
    options: dict[Option, int] = field(hash=False)
    remembers: int


def lay_out(policy: Policy, program: NodeProgram) -> Layout:
    """Return the positions of all inputs and outputs in the time step of a node."""
    sizes, arrivals = policy.sizes, list[Arrival]()
    sensed = {signal: node for signal, (node, _) in policy.measured.items() if signal != REFERENCE}
    measured = [signal for signal, node in sensed.items() if node in program.site]
    others = [signal for signal in sensed if signal not in measured]  # unused, in the places of saved states
    names: list[Name] = [Entry(signal, i) for signal in (*measured, *others) for i in range(sizes[signal])]
    clocks = len(names)
    names += [StepCounter(place.name) for place in program.clocks]
    for link, signals in program.hears.items():
        payload = [Entry(signal, i, link) for signal in signals for i in range(sizes[signal])]
        place = len(names), len(payload), int(link in program.late)
        arrivals.append(Arrival("data", link, program.lag[link], *place, is_acknowledged(policy, link)))
        names += [Received(link), *payload]
    for link in program.acknowledged:
        arrivals.append(Arrival("acknowledgement", link, 1, len(names), 0, 1, False))
        names.append(Acknowledged(link))
    if policy.network.controller in program.site and REFERENCE in policy.measured:
        given = [Entry(REFERENCE, i) for i in range(sizes[REFERENCE])]
        arrivals.append(Arrival("measurement", SETPOINT, 0, len(names), len(given), 0, False))
        names += [Received(SETPOINT), *given]
    drawn = slice(len(names), len(names) + (0 if program.draws is None else len(program.draws.outputs)))
    names += [Entry(UNIFORM, i) for i in range(drawn.stop - drawn.start)]
    places, outputs = (
        {name: i for i, name in enumerate(names)},
        {name: i for i, name in enumerate(program.parts[0].outputs)},
    )
    applied = [signal for signal, (node, _) in policy.applied.items() if node in program.site]
    first, number = (outputs[Entry(applied[0], 0)], sum(sizes[name] for name in applied)) if applied else (0, 0)
    return Layout(
        inputs=tuple(names),
        measured=sum(sizes[signal] for signal in measured),
        wiring=tuple(tuple(places[name] for name in part.inputs) for part in program.parts),
        clocks=clocks,
        drawn=drawn,
        arrivals=tuple(arrivals),
        departures=tuple(
            Departure(link, outputs[Sent(link)], sum(sizes[name] for name in payload))
            for link, payload in program.sends.items()
        ),
        applied=slice(first, first + number) if applied else None,
        options={name: i for name, i in outputs.items() if isinstance(name, Option)},
        remembers=steps_of_a_fault(policy),
    )


def first_inputs(policy: Policy, layout: Layout) -> list[float]:
    """Return the inputs of a node before its first step: zeros, and the set-points at the start."""
    found = [0.0] * len(layout.inputs)
    for one in layout.arrivals:
        if one.kind == "measurement":
            found[one.at + 1 : one.at + 1 + one.size] = policy.model.given.tolist()
    return found


def steps_of_a_fault(policy: Policy) -> int:
    """Return the number of steps after which the effect of a fault, which the theory excludes, is negligible."""
    horizon = None if policy.cost is None else policy.cost.horizon
    return ceil(FORGOTTEN * policy.theory.recovers) or horizon or NEVER
