"""Translation of policy steps (computations, decisions and packets of nodes) to operations of a program.

``TimeStep`` stores the value of every signal while policy steps are translated in order. The closed loop (all nodes,
with the plant) and a single site (with its packets as inputs, ``node``) use this class. Two rules apply:

* A signal that is read before it is assigned has its value of the previous step. Such a signal becomes a state.
* A condition becomes selections. Every branch is computed, and a truth value selects one of the results.

A decision for the label of the least value V_i among labels 0, 1, … is a truth value for each label but the last:

    label i  ⇔  V_i ≤ V_j for every later j that is allowed, i is allowed, and no earlier label is chosen.

For an earlier label that is not chosen there is a later one with a smaller value, so by induction the chosen value is
the minimum. The last label is chosen if no other one is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import TypeAlias

import numpy as np

from taciturn._arrays import Array
from taciturn.model.coverage import INTERVALS, LATE, NETWORKS, STEPS, TRACKING, Coverage
from taciturn.model.losses import LossLaw
from taciturn.model.network import Network
from taciturn.model.plant import Plant
from taciturn.model.policy import Policy
from taciturn.model.saturation import Saturation
from taciturn.model.steps import (
    ONE,
    Acted,
    Apply,
    Assign,
    Condition,
    Decide,
    Draw,
    Evaluate,
    Location,
    Received,
    Send,
    Step,
    Terms,
    condition_of,
    uses_every_packet,
)
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger
from taciturn.model.wire import FULL_SCALE, ROUNDERS, Encoding
from taciturn.program.draws import UNIFORM, minus_two_log
from taciturn.program.functions import falling
from taciturn.program.ir import Builder, Coefficient, Program, Truth
from taciturn.program.late import Heard, Ring, is_clocked
from taciturn.program.ops import Arrived, Entry, Name, Named, Option, Scalar, Sent, State
from taciturn.program.tracing import trace

Operands = list[int]
APPLIED = "applied"  # the input that the actuators apply
Payloads: TypeAlias = Mapping[str, Mapping[str, Encoding]]
TRANSLATED = Coverage(STEPS | TRACKING | NETWORKS | INTERVALS | LATE, "programs do not carry out")


def first_input(policy: Policy, plant: Plant) -> Array:
    """Return the plant input before the first step: the policy's initial input, or 0, within the actuators' limits."""
    found = np.zeros(plant.inputs)
    for signal, (_, inputs) in policy.applied.items():
        found[[*inputs]] = policy.initial.get(signal, 0.0)
    return found if plant.saturation is None else plant.saturation.begun(found)


class TimeStep:
    """Translates the policy steps of a time step in order, and stores which operations compute each signal."""

    def __init__(
        self,
        builder: Builder,
        sizes: Mapping[str, int],
        initial: Mapping[str, Array | str],
        locations: Sequence[Location],
        payloads: Payloads | None = None,
    ) -> None:
        """Start before the first policy step."""
        self.builder, self.sizes, self.initial, self.payloads = builder, sizes, initial, payloads or {}
        self.heard: Mapping[str, Operands] = {}  # signals of an earlier packet that the current policy step reads
        self.listening: Mapping[str, Encoding] = {}  # encodings of the packet that the current policy step reads
        self.signals: dict[str, Operands] = {ONE: [builder.constant(1.0)]}
        self.memories: dict[str, Operands] = {}
        self.outcomes: dict[Condition, list[Truth]] = {}  # truth values of all outcomes but the last, by condition
        self.arrived: dict[str, Truth] = {}
        self.sent: dict[str, Truth] = {}
        self.measured: dict[str, Truth] = {}  # whether samples that may be missing are known, by measured signal
        self.options: dict[str, dict[str, int]] = {}  # value of each option of each trigger
        self.scalars: dict[Scalar, int] = {}  # scalar signals that a decision reads
        self.losses: dict[str, Coefficient] = {}  # loss probability of each link
        self.thresholds: list[int] = []  # uniform numbers that the policy draws; all others determine losses and noise
        self.rings: dict[str, Ring] = {}  # packets on their way on the links that delay them at random
        self.late: dict[str, Ring | Heard] = {}  # those that receivers hear
        self.link_states: dict[str, int] = {}  # state of each link with bursts in this step
        self.pieces: dict[str, list[Operands]] = {}  # values, in each piece of the step, of signals that packets change
        self.locations = {location.name: location for location in locations}
        self.drawn = 0  # number of uniform numbers drawn so far

    def read(self, name: str) -> Operands:
        """Return the value of a signal that a policy step reads: from the packet that has arrived, or the
        stored value.
        """
        return self.hear(name) if name in self.listening else self.recall(name)

    def hear(self, name: str) -> Operands:
        """Return the value of a signal in a packet that has arrived, rounded as the packet encodes it."""
        return self.rounded(self.heard.get(name) or self.recall(name), self.listening[name])

    def rounded(self, values: Operands, encoding: Encoding) -> Operands:
        """Round the values of a signal as the encoding of a packet does."""
        if encoding.name == "float64":
            return values
        if encoding.name == "float32":
            return [self.builder.emit("narrow", value) for value in values]
        return [self._whole(value, scale) for value, scale in zip(values, encoding.full_scale, strict=True)]

    def _whole(self, value: int, scale: float) -> int:
        """Return a number within ±scale, rounded to a multiple of the resolution scale/FULL_SCALE, ties to even."""
        b, most = self.builder, float(FULL_SCALE)
        steps, high, low = b.scale(most / scale, value), b.constant(most), b.constant(-most)
        steps = b.choose(b.emit("greater", steps, high), high, steps)
        steps = b.choose(b.emit("greater", low, steps), low, steps)
        # a sum with 1.5·2^mantissa has no bits below 1, so that adding and subtracting this number rounds to an integer
        rounder = b.constant(ROUNDERS[b.precision])
        return b.scale(scale / most, b.emit("sub", b.emit("add", steps, rounder), rounder))

    def limited(self, values: Operands, limits: Saturation | None, memory: str) -> Operands:
        """Limit the commanded inputs as actuators do. Store the applied inputs in ``memory``, and return them."""
        if limits is not None:
            given = {"command": values, **({memory: self.recall(memory)} if limits.moves else {})}
            values = trace(self.builder, limits, given, {memory: len(values)})[memory]
        self.signals[memory] = values
        return values

    def recall(self, name: str) -> Operands:
        """Return the value of a signal: that of this step or, if not yet assigned, that of the previous step."""
        if name not in self.signals:
            self.signals[name] = self.memories[name] = self._remember(name, self.sizes[name])
        return self.signals[name]

    def draw_losses(self, policy: Policy, network: Network, cuts: tuple[float, ...] = (0.0,)) -> None:
        """Set the loss probability of each link, and take up its packets that are still on their way.

        On a link with bursty losses, the probability depends on the channel state. Packets may arrive at the parts
        ``cuts`` of a period.
        """
        for link in network.links:
            burst = network.burst(link)
            self.losses[link] = network.loss(link)
            if burst is not None and any(isinstance(s, Send) and s.link == link for s in policy.steps):
                self.link_states[link] = self.read(link_state(link))[0]
                self.losses[link] = self.loss_by(burst, link_state(link))
            law = network.random_delay(link, policy.tick)
            if law is not None and any(isinstance(s, Send) and s.link == link for s in policy.steps):
                told_late = network.links[link].acknowledgement_delay > 0
                self.late[link] = self.rings[link] = Ring(
                    self, link, law, cuts, is_clocked(network, link), told_late, uses_every_packet(policy.steps, link)
                )

    def loss_by(self, law: LossLaw | float, name: str) -> Coefficient:
        """Return the loss probability in this step. A memory with the given name holds the state of a bursty law."""
        if not isinstance(law, LossLaw):
            return law
        # the state selects the loss and the probabilities of the next state
        b, (state,) = self.builder, self.read(name)
        loss = b.lookup(law.losses.tolist(), state)
        after, chance = state, self.uniform()
        for limits, nexts in reversed(law.branches()):
            moved = b.emit("greater", b.value(b.lookup(limits, state)), chance)
            after = b.choose(moved, b.value(b.lookup(nexts, state)), after)
        self.signals[name] = [after]
        return loss

    def draw_samples(self, network: Network) -> dict[str, Truth]:
        """Draw which nodes have a sample in this step, of the nodes whose samples may be missing."""
        return {
            node: self.builder.greater(self.uniform(), self.loss_by(law, sample_state(node)))
            for node, law in network.missing.items()
        }

    def take(self, step: Step) -> None:
        """Translate one policy step to operations of the program."""
        on = condition_of(step)
        self.listening = self.payloads.get(on.link, {}) if isinstance(on, Received) else {}
        if isinstance(step, Assign) and isinstance(on, Received) and on.link in self.late:
            self._assign_late(step, self.late[on.link], on.of_age)
        elif isinstance(step, Assign):
            self._follow_pieces(step)
            values = [self.combine(terms, step.size) for terms in step.branches]
            self.signals[step.signal] = [self.pick(step.on, options) for options in zip(*values, strict=True)]
        elif isinstance(step, Evaluate):
            self.signals[step.signal] = [self.pick(step.on, [self.form(form) for form in step.forms])]
        elif isinstance(step, Apply):
            arguments = {name: self.read(name) for name in step.reads}
            self.signals |= trace(self.builder, step.function, arguments, step.signals)
        elif isinstance(step, Draw):
            # −log u of a uniform u has the exponential distribution of mean 1
            self.thresholds.append(self.uniform())
            self.signals[step.signal] = [self.builder.scale(0.5, minus_two_log(self.builder, self.thresholds[-1]))]
        elif isinstance(step, Decide):
            self._decide(step)
        else:
            self._send(step)
        self.listening = {}

    def _assign_late(self, step: Assign, packets: Ring | Heard, age: int | None) -> None:
        """Assign a signal that the newest packet of a link changes, at the beginning of a piece of the step.

        With an ``age``, the packet of this age changes it.
        """
        listening, self.listening = self.listening, {}
        silent = self.combine(step.branches[0], step.size)
        self.listening = listening

        def sum_of(terms: Terms, packet: Mapping[str, Operands]) -> Operands:
            self.heard = packet
            return self.combine(terms, step.size)

        sums = [partial(sum_of, one) for one in step.branches[1:]]
        if age is not None:
            self.signals[step.signal] = packets.of_age(age, sums[0], silent)
        else:
            self.pieces[step.signal] = packets.assigned(sums, silent)
            self.signals[step.signal] = self.pieces[step.signal][-1]
        self.heard = {}

    def _follow_pieces(self, step: Assign) -> None:
        """Compute the values of a sum in each piece of the step, if it contains a signal that packets change in one."""
        moving = [name for name in step.branches[0] if name in self.pieces]
        if step.on is not None or not moving:
            return
        last = {name: self.signals[name] for name in moving}
        found = list[Operands]()
        for piece in range(len(self.pieces[moving[0]])):
            self.signals |= {name: self.pieces[name][piece] for name in moving}
            found.append(self.combine(step.branches[0], step.size))
        self.signals |= last
        self.pieces[step.signal] = found

    def combine(self, terms: Terms, rows: int) -> Operands:
        """Compute Σ matrix·signal as the product of one matrix [M_1 M_2 …] and one vector."""
        values = [value for name in terms for value in self.read(name)]
        blocks = [self.coefficients(matrix) for matrix in terms.values()]
        joined = [[c for block in blocks for c in block[i]] for i in range(rows)]
        return [self.builder.value(index) for index in self.builder.transform(joined, values)]

    def form(self, form: Form) -> int:
        """Compute the value of a trigger's form: v'Ψv, a Gaussian term, weighted scalars and a constant."""
        b = self.builder
        values = [value for name in form.signals for value in self.read(name)]
        square, bell = None if form.Psi is None else b.quadratic(self.coefficients(form.Psi), values), None
        if form.bell is not None:
            halved = b.value(b.quadratic(self.coefficients(form.bell.Pi / 2), values))
            bell = b.scale(form.bell.height, falling(b, halved))
        added = b.combine(list(form.plus.values()), [self.read(name)[0] for name in form.plus])
        constant = self.number(form.constant)
        fixed = None if constant == 0.0 and isinstance(constant, float) else b.value(constant)
        return b.value(b.add(square, bell, added, fixed))

    def pick(self, condition: Condition | None, options: Sequence[int]) -> int:
        """Select one of several values by the outcome that a condition has in this time step."""
        # t_1 ? o_1 : (t_2 ? o_2 : … o_last): at most one truth value is true; if all are false, the outcome is the last
        chosen = options[-1]
        if condition is not None:
            for truth, option in zip(reversed(self.happened(condition)), reversed(options[:-1]), strict=True):
                chosen = self.builder.choose(truth, option, chosen)
        return chosen

    def happened(self, condition: Condition) -> list[Truth]:
        """Return a truth value for each outcome of a condition except the last; for a packet: "it did not arrive".

        A link without random delays has no packet that is older than a step that reads it expects.
        """
        if isinstance(condition, str):
            return self.outcomes[condition]
        link = condition.link
        if isinstance(condition, Acted):
            return [self.builder.negated(self.rings[link].told(condition.age, condition.piece))]
        if link not in self.arrived:  # before its Send, a condition refers to the packet of the previous step
            name = _arrival(link)
            self.memories[name] = self._remember(name, 1)
            self.arrived[link] = self.builder.greater(self.memories[name][0], 0.0)
        return self.of_ages(condition, self.builder.negated(self.arrived[link]))

    def of_ages(self, condition: Condition, silent: Truth) -> list[Truth]:
        """Return the truth values of no packet, and of the ages but the last, if no packet is delayed at random."""
        if isinstance(condition, Received) and condition.of_age:
            return [True]
        more = condition.oldest or 0 if isinstance(condition, Received) else 0
        return [silent, *[self.builder.negated(silent)][:more], *[False] * (more - 1)]

    def coefficients(self, matrix: Matrix) -> list[list[Coefficient]]:
        """Return the entries of a matrix. For a table of matrices, a discrete state selects the matrix."""
        if isinstance(matrix, Scheduled):
            at = self.place(matrix.by)
            entries = np.moveaxis(matrix.values, 0, -1)
            return [[self.builder.lookup(list(entry), at) for entry in row] for row in entries]
        return [[float(value) for value in row] for row in matrix]

    def number(self, value: float | Scheduled) -> Coefficient:
        """Return a number. For a table of numbers, a discrete state selects the number."""
        if isinstance(value, Scheduled):
            return self.builder.lookup(list(value.values), self.place(value.by))
        return value

    def uniform(self) -> int:
        """Draw a new random number, uniform in (0, 1)."""
        self.drawn += 1
        return self.builder.input(Entry(UNIFORM, self.drawn - 1))

    def supplied(self, signal: str, size: int, first: int = 0, link: str | None = None) -> Operands:
        """Return the entries of a signal that is an input of the program. Their numbers begin with ``first``."""
        return [self.builder.input(Entry(signal, first + i, link)) for i in range(size)]

    def as_number(self, truth: Truth) -> int:
        """Convert a truth value to the number 1 if it is true, and 0 if it is false."""
        return self.builder.choose(truth, self.builder.constant(1.0), self.builder.constant(0.0))

    def packets(self) -> dict[Name, int]:
        """Return, for each link, two numbers of the program, 1 or 0: whether its packet is sent, and whether it
        arrives.
        """
        sent: dict[Name, int] = {Sent(link): self.as_number(truth) for link, truth in self.sent.items()}
        return sent | {Received(link): self.as_number(truth) for link, truth in self.arrived.items()}

    def option_values(self) -> dict[Name, int]:
        """Return the values of all options of each trigger, by the option's name."""
        return {
            Option(decision, label): value
            for decision, options in self.options.items()
            for label, value in options.items()
        }

    def finish(self, sums: Named, outputs: Named | None = None) -> Program:
        """Build the program of this time step. All memories and discrete states receive their next values."""
        for location in self.locations.values():
            if location.name in self.memories:
                self.signals[location.name] = [self.move(location)]
        for ring in self.rings.values():
            ring.end()
        for link, truth in self.arrived.items():
            self.signals[_arrival(link)] = [self.as_number(truth)]
        following = {(name, i): index for name in self.memories for i, index in enumerate(self.signals[name])}
        order = [following[state.name, state.index] for state in self.builder.states]
        return self.builder.finish(order, sums, outputs)

    def _remember(self, name: str, size: int) -> Operands:
        start = self.initial.get(name)
        keys = [
            (start, i) if isinstance(start, str) else 0.0 if start is None else float(start[i]) for i in range(size)
        ]
        return [self.builder.state(State(name, i, key)) for i, key in enumerate(keys)]

    def place(self, name: str) -> int:
        """Return the present value of a discrete state of the policy."""
        if name not in self.memories:
            location = self.locations[name]
            start = State(name, 0, float(location.initial))
            self.signals[name] = self.memories[name] = [self.builder.state(start)]
        return self.memories[name][0]

    def move(self, location: Location) -> int:
        """Look up the next value of a discrete state, given its present value and the outcome of a condition."""
        columns = location.table[:, None] if location.on is None else location.table
        here = self.place(location.name)
        options = [self.builder.value(self.builder.lookup([float(v) for v in column], here)) for column in columns.T]
        return self.pick(location.on, options)

    def _decide(self, step: Decide) -> None:
        """Translate a decision for the first label of the least form, or of a form that is at most the limit."""
        trigger = step.trigger
        values = [self.form(form) for form in trigger.options.values()]
        self.options[step.decision] = dict(zip(trigger.labels, values, strict=True))
        plus = {name for form in trigger.options.values() for name in form.plus}
        self.scalars |= {Scalar(step.decision, name): self.read(name)[0] for name in sorted(plus)}
        self.outcomes[step.decision] = self.chosen(trigger, values)

    def chosen(self, trigger: Trigger, values: Sequence[int]) -> list[Truth]:
        """Return, for each label except the last, whether the trigger selects it, given the values of its forms."""
        b, limit, found = self.builder, trigger.limit, list[Truth]()
        allowed = [self.allowed(trigger, label) for label in trigger.labels]
        within = [] if limit is None else [b.less_equal(value, limit) for value in values[:-1]]
        for i, value in enumerate(values[:-1]):
            truth = allowed[i]
            if limit is None:
                for other, possible in zip(values[i + 1 :], allowed[i + 1 :], strict=True):
                    truth = b.both(truth, b.either(b.less_equal(value, other), b.negated(possible)))
            else:  # if no label is within the limit, the last one that is allowed is selected
                truth = b.both(truth, b.either(within[i], self._none(allowed[i + 1 :])))
            for earlier in found:
                truth = b.both(truth, b.negated(earlier))
            found.append(truth)
        return found

    def allowed(self, trigger: Trigger, label: str) -> Truth:
        """Return whether no form excludes a label."""
        return self._none_positive(trigger.excluded.get(label, ()))

    def _none_positive(self, forms: Sequence[Form]) -> Truth:
        truth: Truth = True
        for form in forms:
            truth = self.builder.both(truth, self.builder.less_equal(self.form(form), 0.0))
        return truth

    def _none(self, truths: Iterable[Truth]) -> Truth:
        """Return whether none of some truth values is true."""
        none: Truth = True
        for truth in truths:
            none = self.builder.both(none, self.builder.negated(truth))
        return none

    def _send(self, step: Send) -> None:
        sent: Truth = True
        if step.on is not None:
            labels = tuple(self.options[step.on])
            sending = step.sending(labels)
            truths = dict(zip(labels, self.outcomes[step.on], strict=False))
            # the last label has no truth value: it is chosen if no other label is. So "sent" is expressed without it,
            # either as "one of the sending labels", or as "none of the silent labels".
            if labels[-1] in sending:
                sent = self._none(truth for label, truth in truths.items() if label not in sending)
            else:
                sent = self.builder.negated(self._none(truths[label] for label in truths if label in sending))
        elif step.payload and all(
            name in self.measured for name in step.payload
        ):  # there is nothing to send without a sample
            sent = self.builder.negated(self._none(self.measured[name] for name in step.payload))
        ring = self.rings.get(step.link)
        if ring is not None:
            ring.send(self.arrives(step.link, sent), tuple(self.payloads.get(step.link, {})))
            self.sent[step.link], self.arrived[step.link] = sent, ring.arrived()
            return
        self.sent[step.link], self.arrived[step.link] = sent, self.arrives(step.link, sent)

    def arrives(self, link: str, sent: Truth) -> Truth:
        """Return whether a packet arrives: it is sent, and a uniform random number exceeds the loss probability."""
        loss = self.losses[link]
        if isinstance(loss, float) and loss == 0.0:
            return sent
        return self.builder.both(sent, self.builder.greater(self.uniform(), loss))

    def delays(self) -> dict[Name, int]:
        """Return the delay of the packet of this step on each link with random delays, in pieces of a period."""
        return {Arrived(link, 0): ring.arrivals[0] for link, ring in self.rings.items()}

    def delayed(self, link: str, drawn: int) -> int:
        """Return the delay of the packet of this step on a link, in pieces of a period: the one that is drawn."""
        return drawn


def encode_payloads(policy: Policy, network: Network) -> dict[str, dict[str, Encoding]]:
    """Find how packets of a policy encode each signal, by link and signal."""
    TRANSLATED.check(policy.parts, network)
    payloads: dict[str, dict[str, Encoding]] = {}
    for step in policy.steps:
        if isinstance(step, Send):
            sizes = [policy.sizes[name] for name in step.payload]
            parts = network.encoding(step.link).parts(sizes)
            payloads[step.link] = dict(zip(step.payload, parts, strict=True))
    return payloads


def link_state(link: str) -> str:
    """Return the name of the memory for the channel state of a link with bursty losses."""
    return f"state of the {link} link"


def sample_state(node: str) -> str:
    """Return the name of the memory for the state of a law by which the samples of a node are missing in bursts."""
    return f"state of the samples of {node}"


def _arrival(link: str) -> str:
    return f"arrived on {link}"
