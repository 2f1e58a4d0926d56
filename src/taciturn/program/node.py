"""Lowers one node of a policy: what a place computes within a tick, with its packets as inputs.

A tick has two parts. The first ends with the last thing that leaves the node, a packet or the input of the plant. What
follows and needs a packet or an acknowledgement may wait for it until the next tick begins: that is the second part,
where there is one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from taciturn.errors import ProblemError
from taciturn.model.network import Network
from taciturn.model.packets import told_by
from taciturn.model.policy import (
    ENDS,
    Acknowledged,
    Assign,
    Condition,
    Evaluate,
    Location,
    NodeName,
    Policy,
    Received,
    Send,
    Step,
)
from taciturn.model.steps import assigned
from taciturn.program.draws import draw_uniforms
from taciturn.program.ir import Builder, Program, rebuild
from taciturn.program.lower import Payloads, Tick, Truth, Vector, encode_payloads
from taciturn.program.ops import Precision, State


@dataclass(frozen=True, eq=False)
class NodeProgram:
    """What a node runs.

    Inputs of its parts: ``y i``, ``at CLOCK``, ``arrived LINK`` and ``LINK SIGNAL i`` of packets,
    ``acknowledged LINK``, ``uniform i``. Outputs of the first: ``sent LINK``, ``LINK i`` (the payload), ``input i``,
    ``option DECISION LABEL``.

    Args:
        site: the nodes that share the place.
        parts: the tick up to the last thing that leaves the node and, where there is one, the part that follows; over
            the same states.
        draws: gives the uniform numbers of a tick; None where nothing is drawn.
        clocks: clocks that are read.
        hears: of each link that ends here, the signals of its packet.
        lag: of each of them, how many ticks old the packet is that the tick wants.
        late: those whose packets the second part reads.
        acknowledged: links whose acknowledgements the second part reads.
        sends: of each link that begins here, the signals of its packet.
    """

    site: frozenset[NodeName]
    parts: tuple[Program, ...]
    draws: Program | None
    clocks: tuple[Location, ...]
    hears: Mapping[str, tuple[str, ...]]
    lag: Mapping[str, int]
    late: frozenset[str]
    acknowledged: tuple[str, ...]
    sends: Mapping[str, tuple[str, ...]]


def lower_node(
    policy: Policy, site: frozenset[NodeName], network: Network, precision: Precision = "float64"
) -> NodeProgram:
    """Return what one place of a policy runs.

    Args:
        policy: the policy.
        site: nodes that share the place, from ``Policy.site``.
        network: which tells how payloads are rounded.
        precision: of the numbers.

    Raises:
        ProblemError: the nodes cannot be separated: a signal changes between the packet that tells it and its use, two
            packets go over one link in a tick, a link stays within one place, a node waits for an acknowledgement
            before it acts, or does nothing.
    """
    check_separable(policy)
    return _Lowering(policy, site, network, precision).result()


def check_separable(policy: Policy) -> None:
    """Refuse a policy whose nodes cannot be separated.

    Raises:
        ProblemError: why they cannot.
    """
    places: dict[str, int] = {}
    for place, step in enumerate(policy.steps):
        if not isinstance(step, Send):
            continue
        if ENDS[step.link] in policy.site(step.at):
            raise ProblemError(
                f"the nodes of {policy.kind} cannot be separated: the {step.link} link begins and ends at one place; "
                "expected its ends at two, or no packets on it"
            )
        places[step.link] = place
    for place, step in enumerate(policy.steps):
        if not isinstance(step, Assign | Evaluate) or not isinstance(step.on, Received):
            continue
        on = step.on
        if on.link not in places:
            raise ProblemError(f"{step.at} listens to the {on.link} link, on which nothing is sent; expected a packet")
        sent, count = places[on.link], len(policy.steps)
        between = range(sent + 1, place) if sent < place else [*range(sent + 1, count), *range(place)]
        for name in told_by(policy, on.link):
            if any(name in assigned(policy.steps[i]) for i in between):
                raise ProblemError(
                    f"the nodes of {policy.kind} cannot be separated: {name} changes between the packet that tells it "
                    f"and {step.signal}, which reads it; expected the packet after the change"
                )


class _Part(Tick):
    """A part of a tick of one node: what others tell is an input."""

    def __init__(self, policy: Policy, payloads: Payloads, drawn: int, precision: Precision) -> None:
        counts = {_flags(name): len(trigger.labels) - 1 for name, trigger in policy.decisions.items()}
        super().__init__(Builder(precision), {**policy.sizes, **counts}, policy.initial, policy.locations, payloads)
        self.drawn = drawn
        self.packets: dict[str, Vector] = {}  # payload of each packet as it is sent
        self._link = ""

    def take(self, step: Step, losses: Mapping[str, float]) -> None:
        on = _condition(step)
        self._link = on.link if isinstance(on, Received) else ""
        super().take(step, losses)
        if isinstance(step, Send):
            parts = [self.rounded(self.recall(name), how) for name, how in self.payloads[step.link].items()]
            self.packets[step.link] = [value for part in parts for value in part]

    def hear(self, name: str) -> Vector:
        return [self.builder.input(f"{self._link} {name} {i}") for i in range(self.sizes[name])]

    def recall(self, name: str) -> Vector:
        if name == "y" and name not in self.signals:
            self.signals[name] = [self.builder.input(f"y {i}") for i in range(self.sizes[name])]
        return super().recall(name)

    def happened(self, condition: Condition) -> list[Truth]:
        if isinstance(condition, str):
            if condition not in self.outcomes:  # decided in the first part
                self.outcomes[condition] = [self._true(flag) for flag in self.recall(_flags(condition))]
            return self.outcomes[condition]
        word = "arrived" if isinstance(condition, Received) else "acknowledged"
        return [self.builder.emit("not", self._true(self.builder.input(f"{word} {condition.link}")))]

    def place(self, name: str) -> int:
        own = self.locations[name].on is not None
        return super().place(name) if own else self.builder.input(f"at {name}")

    def _true(self, flag: int) -> int:
        return self.builder.emit("greater", flag, self.builder.constant(0.0))


class _Lowering:
    """One place of a policy while it is written down."""

    def __init__(self, policy: Policy, site: frozenset[NodeName], network: Network, precision: Precision) -> None:
        self.policy, self.site = policy, site
        self.precision: Precision = precision
        self.payloads = encode_payloads(policy, network)
        self.steps = [step for step in policy.steps if step.at in site]
        if not self.steps:
            raise ProblemError(
                f"{' and '.join(sorted(site))} of {policy.kind} has nothing to do; expected another node"
            )
        leaves = [i for i, step in enumerate(self.steps) if self._leaves(step)]
        behind = range(leaves[-1] + 1 if leaves else len(self.steps), len(self.steps))
        waits = [i for i in behind if isinstance(_condition(self.steps[i]), Received | Acknowledged)]
        cut = waits[0] if waits else len(self.steps)
        self.parts = [part for part in (self.steps[:cut], self.steps[cut:]) if part]
        if any(isinstance(_condition(step), Acknowledged) for step in self.steps[:cut]):
            raise ProblemError(
                f"the nodes of {policy.kind} cannot be separated: one waits for an acknowledgement before it acts; "
                "expected what depends on it after what is sent"
            )
        # locations that an outcome moves, which are remembered; a clock is told the tick
        self.places = [place for place in policy.locations if place.on is not None and place.at in site]

    def result(self) -> NodeProgram:
        """Write the parts down, over what any of them remembers."""
        walked: list[_Part] = []
        for part in self.parts:
            walked.append(self._walk(part, walked[0].drawn if walked else 0))
        for place in self.places:
            walked[-1].move(place)
        states = list(dict.fromkeys(state for tick in walked for state in tick.builder.states))
        programs = tuple(self._program(i, tick, states) for i, tick in enumerate(walked))
        inputs = [set(program.inputs) for program in programs]
        read = {name for names in inputs for name in names}
        hears = {link: self._order(link) for link in self.payloads if f"arrived {link}" in read}
        late = frozenset(link for link in hears if f"arrived {link}" not in inputs[0])
        return NodeProgram(
            site=self.site,
            parts=programs,
            draws=draw_uniforms(walked[-1].drawn, self.precision) if walked[-1].drawn else None,
            clocks=tuple(place for place in self.policy.locations if f"at {place.name}" in read),
            hears=hears,
            lag={link: self._before(link) + (link in late) for link in hears},
            late=late,
            acknowledged=tuple(link for link in self.payloads if f"acknowledged {link}" in read),
            sends={step.link: step.payload for step in self.steps if isinstance(step, Send)},
        )

    def _leaves(self, step: Step) -> bool:
        """Whether a step is one whose result leaves the node."""
        return isinstance(step, Send) or "input" in assigned(step)

    def _order(self, link: str) -> tuple[str, ...]:
        return next(step.payload for step in self.policy.steps if isinstance(step, Send) and step.link == link)

    def _before(self, link: str) -> int:
        """Return 1 where a packet is read before it is sent, and is that of the tick before; else 0."""
        steps = self.policy.steps
        sent = next(i for i, step in enumerate(steps) if isinstance(step, Send) and step.link == link)
        conditions = [_condition(step) for step in steps]
        read = [i for i, on in enumerate(conditions) if isinstance(on, Received) and on.link == link]
        if read[0] < sent < read[-1]:
            raise ProblemError(
                f"the nodes of {self.policy.kind} cannot be separated: the packet of the {link} link is read before "
                "and after it is sent; expected all of its reading on one side"
            )
        return int(read[0] < sent)

    def _walk(self, steps: Sequence[Step], drawn: int) -> _Part:
        tick = _Part(self.policy, self.payloads, drawn, self.precision)
        for step in steps:
            tick.take(step, dict.fromkeys(self.payloads, 0.0))
        return tick

    def _program(self, index: int, tick: _Part, states: Sequence[State]) -> Program:
        """Return a part over the states of all parts."""
        builder, last = tick.builder, index == len(self.parts) - 1
        outputs = self._outputs(tick) if index == 0 else {}
        for state in states:
            builder.state(state)
        signals = dict(tick.signals)
        signals |= {
            _flags(name): [tick.as_number(t) for t in truths]
            for name, truths in tick.outcomes.items()
            if isinstance(name, str)
        }
        signals |= {place.name: [tick.move(place)] for place in self.places if last}
        following = [
            signals[state.name][state.index] if state.name in signals else builder.state(state) for state in states
        ]
        order = [builder.states.index(state) for state in states]
        program = Program(
            tuple(builder.ops),
            tuple(builder.states),
            tuple(following[states.index(state)] for state in builder.states),
            tuple(builder.inputs),
            tuple(builder.constants),
            tuple(builder.tables),
            {},
            outputs,
            builder.precision,
            tuple(builder.matrices),
        )
        return rebuild(program, lambda builder, op: None, order)

    def _outputs(self, tick: _Part) -> dict[str, int]:
        outputs: dict[str, int] = {}
        for link, truth in tick.sent.items():
            outputs |= {f"sent {link}": tick.as_number(truth)}
            outputs |= {f"{link} {i}": value for i, value in enumerate(tick.packets[link])}
        if "actuator" in self.site:
            applied = tick.clipped(tick.recall("input"), self.policy.model.input_limit)
            outputs |= {f"input {i}": value for i, value in enumerate(applied)}
        for decision, options in tick.options.items():
            outputs |= {f"option {decision} {label}": value for label, value in options.items()}
        return outputs


def _condition(step: Step) -> Condition | None:
    return step.on if isinstance(step, Assign | Evaluate) else None


def _flags(decision: str) -> str:
    """Return under which name the outcome of a decision is remembered until the second part."""
    return f"decided {decision}"
