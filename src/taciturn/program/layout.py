"""Where everything stands that a tick of a node reads and tells, for whoever runs its parts."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Literal, NamedTuple

from taciturn.model.policy import Acknowledged, Assign, Evaluate, Policy
from taciturn.program.draws import UNIFORM
from taciturn.program.node import NodeProgram

FORGOTTEN = 7.0  # time constants after which a fault is past: e^-7 < 1e-3
NEVER = 1 << 62


class Arrival(NamedTuple):
    """Packets of one kind on one link, and where they are read.

    Args:
        kind: ``"data"`` or ``"acknowledgement"``.
        link: that they come over.
        lag: how many ticks older than the tick that reads it a packet is.
        at: where the values stand among the inputs: whether one arrived, and then the payload.
        size: of the payload.
        part: of the tick that reads it.
        acknowledged: whether the sender is to be told what has come.
    """

    kind: Literal["data", "acknowledgement"]
    link: str
    lag: int
    at: int
    size: int
    part: int
    acknowledged: bool


class Departure(NamedTuple):
    """Packets that a node sends over one link, and where they are told.

    Args:
        link: that they go over.
        at: where the flag stands among the outputs; the payload stands behind it.
        size: of the payload.
    """

    link: str
    at: int
    size: int


@dataclass(frozen=True)
class Layout:
    """Where inputs and outputs of a node's tick stand.

    Args:
        inputs: their names: the measurement, clocks, packets, draws.
        wiring: for each part, where its inputs stand among them.
        clocks: where the first of the clocks stands.
        drawn: where the draws stand.
        arrivals: the packets that are read.
        departures: the packets that are sent.
        applied: where the plant's input stands among the outputs; None where the node has none.
        options: where the value of each option of its triggers stands among the outputs, by name.
        remembers: ticks after which what its theory does not know is forgotten.
    """

    inputs: tuple[str, ...]
    wiring: tuple[tuple[int, ...], ...]
    clocks: int
    drawn: slice
    arrivals: tuple[Arrival, ...]
    departures: tuple[Departure, ...]
    applied: slice | None
    options: dict[str, int]
    remembers: int


def lay_out(policy: Policy, program: NodeProgram) -> Layout:
    """Return where a node of a policy has its inputs and outputs."""
    sizes, arrivals = policy.sizes, list[Arrival]()
    names = [f"y {i}" for i in range(sizes["y"])]
    clocks = len(names)
    names += [f"at {place.name}" for place in program.clocks]
    for link, signals in program.hears.items():
        payload = [f"{link} {signal} {i}" for signal in signals for i in range(sizes[signal])]
        place = len(names), len(payload), int(link in program.late)
        arrivals.append(Arrival("data", link, program.lag[link], *place, _is_acknowledged(policy, link)))
        names += [f"arrived {link}", *payload]
    for link in program.acknowledged:
        arrivals.append(Arrival("acknowledgement", link, 1, len(names), 0, 1, False))
        names.append(f"acknowledged {link}")
    drawn = slice(len(names), len(names) + (0 if program.draws is None else len(program.draws.outputs)))
    names += [f"{UNIFORM} {i}" for i in range(drawn.stop - drawn.start)]
    places, outputs = (
        {name: i for i, name in enumerate(names)},
        {name: i for i, name in enumerate(program.parts[0].outputs)},
    )
    first, horizon = outputs.get("input 0"), policy.cost.horizon if policy.cost is not None else None
    return Layout(
        inputs=tuple(names),
        wiring=tuple(tuple(places[name] for name in part.inputs) for part in program.parts),
        clocks=clocks,
        drawn=drawn,
        arrivals=tuple(arrivals),
        departures=tuple(
            Departure(link, outputs[f"sent {link}"], sum(sizes[name] for name in payload))
            for link, payload in program.sends.items()
        ),
        applied=None if first is None else slice(first, first + policy.model.inputs),
        options={name.removeprefix("option "): i for name, i in outputs.items() if name.startswith("option ")},
        remembers=ceil(FORGOTTEN * policy.settling) or horizon or NEVER,
    )


def _is_acknowledged(policy: Policy, link: str) -> bool:
    conditions = [step.on for step in policy.steps if isinstance(step, Assign | Evaluate)]
    conditions += [place.on for place in policy.locations]
    return any(isinstance(on, Acknowledged) and on.link == link for on in conditions)
