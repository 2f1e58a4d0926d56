"""Translation of the policy steps at one site to programs, whose inputs include the packets that arrive.

A time step has one or two parts. The first part ends with the last output of the node, a packet or the input of the
plant. Later policy steps that read a packet or an acknowledgement form the second part. This part runs when the next
time step begins, so that a packet has a whole sampling period to arrive. Both parts have the same states; the outcome
of a decision in the first part is a state that the second part reads.

Nodes can be separated if each packet holds what its Send found: no signal of the packet changes before it is read, all
steps read a packet before it is sent or all after it, and no two places wait for each other within a step.

A link may delay packets at random (``late``). Then the step in which a packet arrives reads it, and the inputs
are the newest packet for each piece of that step. Acknowledgements give the sender, for the packet of each age, the
piece of the step in which it arrived (``Arrived``). An actuator has an input of the plant for each piece.

``lay_out`` gives the positions of all inputs and outputs in the time step of a node, for the back ends that run nodes:

    inputs:  measurement | 1 for each entry, or 0 if it is missing | step counters | for each link and piece: arrived,
             payload | acknowledgements, or pieces by age | set-points | manual operation: 1 or 0, the manual inputs
             | draws
    outputs: for each link: sent, payload | for each piece: input of the plant | values of the options of triggers
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Literal, NamedTuple

from taciturn.errors import ProblemError
from taciturn.model.coverage import LATE, LOOPS, Coverage
from taciturn.model.expected import sensed_by
from taciturn.model.network import REFERENCE, Network
from taciturn.model.packets import is_acknowledged, told_by
from taciturn.model.policy import Policy
from taciturn.model.saturation import Saturation
from taciturn.model.set_points import IN_EFFECT
from taciturn.model.steps import (
    Acknowledged,
    Acted,
    Assign,
    Condition,
    Evaluate,
    Location,
    Received,
    Send,
    Step,
    assigned,
    condition_of,
    hears,
    uses_every_packet,
)
from taciturn.model.wire import SETPOINT
from taciturn.program.draws import UNIFORM, draw_uniforms
from taciturn.program.ir import Builder, Program, Truth, rebuild
from taciturn.program.late import NEVER, Heard, flag_of, pieces_of_links
from taciturn.program.manual import BY_HAND, MANUAL, OperatedStep, operation_of
from taciturn.program.missing import complete, held_samples, known_of
from taciturn.program.ops import Arrived, Entry, Name, Option, Precision, Sent, State, StepCounter, named
from taciturn.program.translation import APPLIED, Operands, Payloads, encode_payloads, first_input

NODES = Coverage(LOOPS | LATE, "nodes do not carry out")
_FORGOTTEN = 7.0  # time constants after which the effect of a fault is negligible: e^-7 < 1e-3
_NEVER = 1 << 62


@dataclass(frozen=True, eq=False)
class NodeProgram:
    """The programs that the nodes of a site run in each time step."""

    # Inputs of the parts: the measurement ``y``, step counters, whether a packet or an acknowledgement arrived on a
    # link, the signals of the packet, and uniform numbers. Outputs of the first part: whether a packet is sent on a
    # link, its payload (entries named by the link), the plant's ``input``, and the values of the triggers' options.

    site: frozenset[str]  # the nodes at the site
    parts: tuple[Program, ...]  # the time step up to the last output of the node and, if any, the part after it
    draws: Program | None  # program that draws the uniform numbers of a step; None if nothing is drawn
    clocks: tuple[Location, ...]  # the step counters that the program reads
    hears: Mapping[str, tuple[str, ...]]  # for each link that ends at the site, the signals of its packet
    lag: Mapping[str, int]  # for each of these links, the age in steps of the packet that the time step reads
    late: frozenset[str]  # links whose packets the second part reads
    acknowledged: tuple[str, ...]  # links whose acknowledgements the second part reads
    manual: bool  # whether an operator may give the inputs in place of a controller at the site
    sends: Mapping[str, tuple[str, ...]]  # for each link that begins at the site, the signals of its packet
    pieces: Mapping[str, int]  # pieces of a step in which the receiver of a link hears a packet, if delays are random
    every: Mapping[str, int]  # number of ages of the packets on a link if the site uses all packets, and not the newest
    acting: int  # pieces of a step in each of which the site may apply another input

    @property
    def ages(self) -> Mapping[str, int]:
        """Number of ages of packets whose times of arrival the sender knows, by link."""
        found: dict[str, int] = {}
        for name in (name for part in self.parts for name in part.inputs if isinstance(name, Arrived)):
            found[name.link] = max(found.get(name.link, 0), name.age + 1)
        return found


def translate_node(
    policy: Policy, site: frozenset[str], network: Network, precision: Precision = "float64"
) -> NodeProgram:
    """Translate the policy steps of a site's nodes to programs of one time step."""
    policy = policy.in_units
    NODES.check(policy.parts, policy.designed_for, network)
    _check_separable(policy)
    _expect_order(policy)
    own = [step for step in policy.steps if step.at in site]
    payloads, pieces = encode_payloads(policy, network), pieces_of_links(network, policy.tick)
    applied = {signal: inputs for signal, (node, inputs) in policy.applied.items() if node in site}
    walked, operation = list[_Part](), operation_of(policy)
    for part in _parts(policy, site, own, applied.keys()):
        walked.append(_Part(policy, payloads, walked[0].drawn if walked else 0, precision, pieces))
        if len(walked) == 1:
            walked[0].measure(policy, site)
        if policy.network.controller in site:
            walked[-1].operate(operation, begins=len(walked) == 1)
        for step in part:
            walked[-1].take(step)
    limits, first = policy.model.saturation, walked[0]
    acting = max(map(len, first.pieces.values()), default=1) if applied else 1
    if acting > 1:
        check_pieces(limits)
    given = dict[Name, int]()
    for piece in range(acting):
        for signal, inputs in applied.items():
            limit = None if limits is None else limits.of(inputs)
            values = first.pieces[signal][piece] if signal in first.pieces else first.recall(signal)
            given |= named(signal, first.limited(values, limit, _applied(signal)), None, piece)
    # locations that depend on an outcome are states; step counters are inputs, set from the number of the step
    places = [place for place in policy.locations if place.on is not None and place.at in site]
    for place in places:
        walked[-1].move(place)
    states = list(dict.fromkeys(state for tick in walked for state in tick.builder.states))
    outputs = dict[Name, int]()
    for link, truth in first.sent.items():
        outputs |= {Sent(link): first.as_number(truth), **named(link, first.payload[link])}
    outputs |= given
    if any(IN_EFFECT in assigned(step) for step in own):
        outputs |= named(IN_EFFECT, first.recall(IN_EFFECT))
    outputs |= first.option_values()
    programs = tuple(
        _with_states(tick, states, outputs if tick is first else {}, places if tick is walked[-1] else [])
        for tick in walked
    )
    inputs_of = [set(program.inputs) for program in programs]
    read = set[Name]().union(*inputs_of)
    sends = {step.link: step.payload for step in policy.steps if isinstance(step, Send)}
    every = {link: network.longest(link, policy.tick) + 1 for link in sends if uses_every_packet(own, link)}
    every = {link: ages for link, ages in every.items() if link in network.late}
    flags = {link: {flag_of(link, age) for age in range(every.get(link, 1))} for link in sends}
    hears = {link: payload for link, payload in sends.items() if read & flags[link]}
    late = frozenset[str](link for link in hears if not flags[link] & inputs_of[0])
    return NodeProgram(
        site=site,
        parts=programs,
        draws=draw_uniforms(walked[-1].drawn, precision) if walked[-1].drawn else None,
        clocks=tuple(place for place in policy.locations if StepCounter(place.name) in read),
        hears=hears,
        lag={link: _age(policy, link) + (link in late) for link in hears},
        late=late,
        acknowledged=tuple(link for link in sends if Acknowledged(link) in read or Arrived(link, 0) in read),
        manual=operation is not None and policy.network.controller in site,
        sends={step.link: step.payload for step in own if isinstance(step, Send)},
        pieces={link: count for link, count in pieces.items() if link in sends},
        every=every,
        acting=acting,
    )


def check_pieces(limits: Saturation | None) -> None:
    """Raise an error if the rate of inputs is limited although they may change within a period."""
    if limits is not None and limits.moves:
        raise ProblemError(
            "input_rate is given, and packets arrive at random within a period; expected delays of whole periods, a "
            "buffer, or no input_rate"
        )


def _parts(policy: Policy, site: frozenset[str], own: Sequence[Step], applied: Set[str]) -> list[Sequence[Step]]:
    """Return the policy steps of a site, cut before the first step after its last output that waits for a packet."""
    if not own:
        raise ProblemError(
            f"the node {' and '.join(sorted(site))} of the policy {policy.kind} has no policy steps; expected another "
            "node"
        )
    leaves = [i for i, step in enumerate(own) if _is_output(step, applied)]
    behind = range(leaves[-1] + 1 if leaves else len(own), len(own))
    waits = [i for i in behind if isinstance(condition_of(own[i]), Received | Acknowledged | Acted)]
    cut = waits[0] if waits else len(own)
    if any(isinstance(condition_of(step), Acknowledged | Acted) for step in own[:cut]):
        raise ProblemError(
            f"the nodes of the policy {policy.kind} cannot be separated: a node needs an acknowledgement before its "
            "last output; expected each policy step that depends on an acknowledgement after the last Send of its node"
        )
    return [part for part in (own[:cut], own[cut:]) if part]


def _age(policy: Policy, link: str) -> int:
    """Return 1 if a step reads a packet before its Send, so that it is the packet of the previous step; else 0."""
    sent = next(i for i, step in enumerate(policy.steps) if isinstance(step, Send) and step.link == link)
    read = [i for i, step in enumerate(policy.steps) if hears(condition_of(step), link)]
    if read[0] < sent < read[-1]:
        raise ProblemError(
            f"the nodes of the policy {policy.kind} cannot be separated: the packet of the {link} link is read both "
            "before and after it is sent; expected that all steps read it before the send, or all after it"
        )
    return int(read[0] < sent)


def _with_states(
    tick: _Part, states: Sequence[State], outputs: Mapping[Name, int], places: Sequence[Location]
) -> Program:
    """Return a part as a program over the states of all parts; ``places`` are the locations that move at its end."""
    # a state that this part does not assign keeps its value, also the flags of decisions for the second part
    builder = tick.builder
    for state in states:
        builder.state(state)
    decided = {name: truths for name, truths in tick.outcomes.items() if isinstance(name, str)}
    flags = {_flags(name): [tick.as_number(truth) for truth in truths] for name, truths in decided.items()}
    signals = tick.signals | flags | {place.name: [tick.move(place)] for place in places}
    following = {
        state: signals[state.name][state.index] if state.name in signals else builder.state(state) for state in states
    }
    program = builder.collect([following[state] for state in builder.states], {}, outputs)
    return rebuild(program, lambda builder, op: None, [builder.states.index(state) for state in states])


class _Part(OperatedStep):
    """A part of the time step of one site: measurements, packets and step counters are inputs."""

    def __init__(
        self, policy: Policy, payloads: Payloads, drawn: int, precision: Precision, late: Mapping[str, int]
    ) -> None:
        counts = {_flags(name): len(trigger.labels) - 1 for name, trigger in policy.decisions.items()}
        counts |= {MANUAL: 1} | {_applied(signal): len(inputs) for signal, (_, inputs) in policy.applied.items()}
        start = first_input(policy, policy.model)
        initial = {_applied(signal): start[[*inputs]] for signal, (_, inputs) in policy.applied.items()}
        held = held_samples(policy)
        counts |= {name: len(one) for name, one in held.items()}
        initial |= {**policy.initial, **held}
        super().__init__(Builder(precision), {**policy.sizes, **counts}, initial, policy.locations, payloads)
        self.drawn = drawn
        self.losses = dict.fromkeys(payloads, 0.0)  # the arrival of a packet is an input
        self.payload: dict[str, Operands] = {}  # of the packet of each link, rounded by its encoding
        self._link = ""
        for link, pieces in late.items():
            self.late[link] = Heard(self, link, pieces, {name: self.sizes[name] for name in payloads.get(link, ())})

    def measure(self, policy: Policy, site: frozenset[str]) -> None:
        """Assign the signals that the site measures; a later part of the step reads them as memories."""
        for signal, (node, outputs) in sensed_by(policy).items():
            if node in site:
                flags = self.supplied(known_of(signal), len(outputs))
                values = self.supplied(signal, len(outputs))
                complete(self, policy, signal, values, [self._true(flag) for flag in flags])

    def take(self, step: Step) -> None:
        on = condition_of(step)
        self._link = on.link if isinstance(on, Received) else ""
        super().take(step)
        if isinstance(step, Send):
            parts = [self.rounded(self.recall(name), how) for name, how in self.payloads[step.link].items()]
            self.payload[step.link] = [value for part in parts for value in part]

    def hear(self, name: str) -> Operands:
        return self.heard[name] if name in self.heard else self.supplied(name, self.sizes[name], link=self._link)

    def recall(self, name: str) -> Operands:
        if name == REFERENCE and name not in self.signals:
            self.signals[name] = self.supplied(name, self.sizes[name])
        return super().recall(name)

    def happened(self, condition: Condition) -> list[Truth]:
        if isinstance(condition, str):
            if condition not in self.outcomes:  # decided in the first part
                self.outcomes[condition] = [self._true(flag) for flag in self.recall(_flags(condition))]
            return self.outcomes[condition]
        if isinstance(condition, Acted):
            arrived = self.builder.input(Arrived(condition.link, condition.age))
            return [self.builder.negated(self.builder.less_equal(arrived, float(condition.piece)))]
        flag = Received(condition.link) if isinstance(condition, Received) else condition
        return self.of_ages(condition, self.builder.negated(self._true(self.builder.input(flag))))

    def place(self, name: str) -> int:
        own = self.locations[name].on is not None
        return super().place(name) if own else self.builder.input(StepCounter(name))

    def _true(self, flag: int) -> Truth:
        return self.builder.greater(flag, 0.0)


def _check_separable(policy: Policy) -> None:
    """Raise an error if the nodes of a policy cannot run separately."""
    places: dict[str, int] = {}
    for place, step in enumerate(policy.steps):
        if not isinstance(step, Send):
            continue
        if policy.network.receiver(step.link) in policy.site(step.at):
            raise ProblemError(
                f"the nodes of the policy {policy.kind} cannot be separated: the {step.link} link begins and ends at "
                "the same site; expected different sites at its two ends, or no packets on this link"
            )
        places[step.link] = place
    for place, step in enumerate(policy.steps):
        if not isinstance(step, Assign | Evaluate) or not isinstance(on := step.on, Received):
            continue
        if on.link not in places:
            raise ProblemError(
                f"the node {step.at} reads packets of the {on.link} link, on which no policy step sends; expected a "
                "Send for this link"
            )
        sent, count = places[on.link], len(policy.steps)
        between = range(sent + 1, place) if sent < place else [*range(sent + 1, count), *range(place)]
        for name in told_by(policy, on.link):
            if any(name in assigned(policy.steps[i]) for i in between):
                raise ProblemError(
                    f"the nodes of the policy {policy.kind} cannot be separated: the signal {name} changes between its "
                    f"Send and the step that computes {step.signal} from the packet; expected the Send after the change"
                )


def _expect_order(policy: Policy) -> None:
    """Raise an error if places wait for each other within a step: a packet of each depends on a packet of the other."""
    sent = {step.link: i for i, step in enumerate(policy.steps) if isinstance(step, Send)}
    waits: dict[frozenset[str], set[frozenset[str]]] = {}
    for i, step in enumerate(policy.steps):
        on, here = condition_of(step), policy.site(step.at)
        if isinstance(on, Received) and sent.get(on.link, i) < i and _needed_for_output(policy, here, i):
            waits.setdefault(here, set()).add(policy.site(policy.steps[sent[on.link]].at))
    left = dict(waits)
    while ready := [place for place, others in left.items() if not others & left.keys()]:
        for place in ready:
            del left[place]
    if left:
        names = " and ".join(sorted("+".join(sorted(place)) for place in left))
        raise ProblemError(
            f"the nodes of the policy {policy.kind} cannot be separated: within a step, {names} wait for packets of "
            "each other; expected another assignment of the nodes to sites"
        )


def _needed_for_output(policy: Policy, site: frozenset[str], place: int) -> bool:
    """Return whether a place has an output in a step after an operation, which then cannot wait for the next step."""
    applied = {signal for signal, (node, _) in policy.applied.items() if node in site}
    later = (step for step in policy.steps[place:] if step.at in site)
    return any(_is_output(step, applied) for step in later)


def _is_output(step: Step, applied: Set[str]) -> bool:
    """Return whether a policy step sends a packet, or computes an input that the node applies."""
    return isinstance(step, Send) or not applied.isdisjoint(assigned(step))


def _applied(signal: str) -> str:
    """Return the name of the memory of the input that a node applied."""
    return f"{APPLIED} {signal}"


def _flags(decision: str) -> str:
    """Return the name of the memory that stores the outcome of a decision for the second part."""
    return f"decided {decision}"


class Arrival(NamedTuple):
    """Packets or acknowledgements that a node receives on one link, and where they are among the program's inputs."""

    # ``"data"``, ``"acknowledgement"``; or for set-points, of which the last are kept, ``"measurement"`` from a plant
    # and ``"setpoint"`` from an operator, in the same place; ``"manual"``: 1 or 0, and manual inputs of an operator
    kind: Literal["data", "acknowledgement", "measurement", "setpoint", "manual"]
    link: str  # link on which they arrive
    lag: int  # number of steps between the sending of a packet and the step that reads it
    at: int  # position of the flag "arrived" among the inputs; the payload is after it
    size: int  # number of entries of the payload
    part: int  # index of the part of the step that reads the packet
    acknowledged: bool  # whether the receiver acknowledges packets
    # if delays are random: the number of pieces, in each of which the inputs contain the newest packet that has
    # arrived; or for acknowledgements, the number of ages, for each of which there is one input; otherwise 0
    pieces: int = 0
    ages: int = 0
    every: int = 0  # number of ages if all packets are used, for each of which the inputs contain its packet


class Departure(NamedTuple):
    """Packets that a node sends on one link, and where they are among the program's outputs."""

    link: str  # link on which they are sent
    at: int  # position of the flag "sent" among the outputs; the payload is after it
    size: int  # number of entries of the payload


@dataclass(frozen=True)
class Layout:
    """Where a node's program has its inputs (measurements, packets, random numbers) and outputs (packets, plant
    input).
    """

    inputs: tuple[Name, ...]  # names of all inputs: measurement, step counters, packets, and random numbers
    measured: int  # number of entries of the measurement, after which as many flags follow; 0 without a sensor
    wiring: tuple[tuple[int, ...], ...]  # for each part of the step, the positions of its inputs among all inputs
    clocks: int  # position of the first step counter among the inputs
    drawn: slice  # positions of the random numbers among the inputs
    # position of the flag "manual" among the inputs, before the manual inputs of the plant; None without a controller
    manual: int | None
    arrivals: tuple[Arrival, ...]  # the packets that the node reads
    departures: tuple[Departure, ...]  # the packets that the node sends
    applied: slice | None  # positions of the plant's input among the outputs; None if the node does not apply it
    limited: slice | None  # positions of the set-points within their limits among the outputs; None without limits
    # positions of the values of all trigger options among the outputs, by name
    options: dict[Option, int] = field(hash=False)
    remembers: int  # number of steps after which the effect of a fault, which the theory excludes, is negligible


def lay_out(policy: Policy, program: NodeProgram) -> Layout:
    """Compute the positions of all inputs and outputs of a node's program."""
    sizes, arrivals = policy.sizes, list[Arrival]()
    measured = [signal for signal, (node, _) in sensed_by(policy).items() if node in program.site]
    names: list[Name] = [Entry(signal, i) for signal in measured for i in range(sizes[signal])]
    names += [Entry(known_of(signal), i) for signal in measured for i in range(sizes[signal])]
    clocks = len(names)
    names += [StepCounter(place.name) for place in program.clocks]
    for link, signals in program.hears.items():
        payload = [Entry(signal, i, link) for signal in signals for i in range(sizes[signal])]
        place = len(names), len(payload), int(link in program.late)
        pieces = program.pieces.get(link, 0)
        every, told = program.every.get(link, 0), is_acknowledged(policy, link)
        arrivals.append(Arrival("data", link, program.lag[link], *place, told, pieces, every=every))
        for piece in range(every or max(pieces, 1)):
            names += [flag_of(link, piece), *(replace(name, piece=piece) for name in payload)]
    for link in program.acknowledged:
        ages = program.ages.get(link, 0)
        behind = 1 + policy.network.links[link].acknowledgement_delay
        told = Arrival("acknowledgement", link, behind, len(names), min(ages, 1), 1, False)
        arrivals.append(told._replace(pieces=program.pieces[link], ages=ages) if ages else told)
        names += [Arrived(link, age) for age in range(ages)] or [Acknowledged(link)]
    if policy.network.controller in program.site and REFERENCE in policy.measured:
        given = [Entry(REFERENCE, i) for i in range(sizes[REFERENCE])]
        arrivals.append(Arrival("measurement", SETPOINT, 0, len(names), len(given), 0, False))
        arrivals.append(arrivals[-1]._replace(kind="setpoint"))
        names += [Received(SETPOINT), *given]
    manual = len(names) + 1 if program.manual else None
    if program.manual:
        by_hand = [Entry(MANUAL, 0), *(Entry(BY_HAND, i) for i in range(policy.model.inputs))]
        if arrivals and arrivals[-1].kind == "setpoint":
            arrivals.append(Arrival("manual", SETPOINT, 0, len(names), len(by_hand), 0, False))
        names += [Received(MANUAL), *by_hand]
    drawn = slice(len(names), len(names) + (0 if program.draws is None else len(program.draws.outputs)))
    names += [Entry(UNIFORM, i) for i in range(drawn.stop - drawn.start)]
    places = {name: i for i, name in enumerate(names)}
    outputs = {name: i for i, name in enumerate(program.parts[0].outputs)}
    applied = [signal for signal, (node, _) in policy.applied.items() if node in program.site]
    at = outputs.get(Entry(IN_EFFECT, 0))
    first, number = (outputs[Entry(applied[0], 0)], sum(sizes[name] for name in applied)) if applied else (0, 0)
    number *= program.acting
    return Layout(
        inputs=tuple(names),
        measured=sum(sizes[signal] for signal in measured),
        wiring=tuple(tuple(places[name] for name in part.inputs) for part in program.parts),
        clocks=clocks,
        drawn=drawn,
        manual=manual,
        arrivals=tuple(arrivals),
        departures=tuple(
            Departure(link, outputs[Sent(link)], sum(sizes[name] for name in payload))
            for link, payload in program.sends.items()
        ),
        applied=slice(first, first + number) if applied else None,
        limited=None if at is None else slice(at, at + sizes[IN_EFFECT]),
        options={name: i for name, i in outputs.items() if isinstance(name, Option)},
        remembers=steps_of_a_fault(policy),
    )


def acts_at_once(program: NodeProgram, layout: Layout) -> bool:
    """Return whether a node applies packets to the plant that a link may delay at random, also within a step."""
    return layout.applied is not None and any(link in program.pieces for link in program.hears)


def only_applies(program: NodeProgram, layout: Layout) -> bool:
    """Return whether such a node does nothing else in a step, so that it can apply a packet before the step ends."""
    waits = any(one.part for one in layout.arrivals)  # for a packet of the step, after its outputs
    more = layout.measured or layout.departures or program.draws is not None or waits
    return acts_at_once(program, layout) and not more


def first_inputs(policy: Policy, layout: Layout) -> list[float]:
    """Return the program inputs of a node before its first step: zeros, and the initial set-points."""
    found = [0.0] * len(layout.inputs)
    for one in layout.arrivals:
        if one.kind == "measurement":
            found[one.at + 1 : one.at + 1 + one.size] = policy.model.given.tolist()
        found[one.at : one.at + one.ages] = [NEVER] * one.ages
    return found


def steps_of_a_fault(policy: Policy) -> int:
    """Return the number of steps until the effect of a fault, such as a late packet, is negligible."""
    horizon = None if policy.cost is None else policy.cost.horizon
    return ceil(_FORGOTTEN * policy.theory.recovers) or horizon or _NEVER
