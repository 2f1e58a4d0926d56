"""Diagram of a policy's nodes and of the links between them: as data, as text and as a figure.

The controller's place is the hub of a star: every other place has one link for each of its nodes. A box says what its
nodes measure, estimate, compute and apply. A wire has the name of its link, the contents of a packet, the rule by which
it is sent (``rule``), its losses, and a dashed line back if the sender uses acknowledgements. All words come from the
steps of the policy (``words``).

In the text the hub and the other places are two columns, whose wires have a row each, so that nothing crosses, and
every line fits into 80 columns.
"""

from __future__ import annotations

import re
import textwrap
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any, Literal

from taciturn._diagram import FIXED, Box, Wire, draw_star, glued
from taciturn._display import Displayed
from taciturn._text import folded, number_text, percent
from taciturn.model.coverage import LATE, LOOPS, Coverage
from taciturn.model.link import IDEAL_LINK, LinkLaw
from taciturn.model.network import REFERENCE, entry_numbers, symbols_text
from taciturn.model.rule import Rule, listed, rule_of, step_seconds, timetable
from taciturn.model.steps import Acknowledged, Assign, Decide, Received, Send, Step, assigned, condition_of
from taciturn.model.trigger import Scheduled
from taciturn.model.words import PolicyData, Words, is_identity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from taciturn._figure import Size, StyleName


WIDTH = 80  # columns of the diagram as text, which is laid out once, for every terminal
DRAWN = Coverage(LOOPS | LATE, "diagrams do not show")
When = Literal["always", "decision", "schedule"]
ESTIMATING = {"innovation", "own", "seen"}  # signals by which a node estimates the state
FILTERING = {"part", "local"}  # signals by which a sensor filters its measurements
PREDICTING = {"model", "estimate", "used", "input"}  # signals that an actuator predicts without a packet
BOX = 22  # letters of a line in a box
BETWEEN = "   "  # entries of the legend
LINES = str.maketrans("┌┐└┘├┤│─▶◀┄", "+++++||-><.")
PLAIN: Mapping[str, str] = {
    "x̂": "xhat", "x̃": "xtilde", "x̄": "xbar", "ȳ": "ybar", "û": "uhat", "ŷ": "yhat", "Ψ": "Psi", "Θ": "Theta",
    "Φ": "Phi", "Λ": "Lambda", "Ξ": "Xi", "Ω": "Omega", "Π": "Pi", "Γ": "Gamma", "Σ": "Sigma", "Δ": "d", "η": "eta",
    "ν": "nu", "ξ": "xi", "²": "^2", "½": "0.5 ", "−": "-", "≤": "<=", "×": "*", "′": "'", "…": "...",
}  # fmt: skip
"""Signs of the sentences, as a terminal prints them that has only ASCII."""


@dataclass(frozen=True, repr=False)
class Place(Displayed):
    """A site of the diagram with one or more nodes: what they measure, decide, predict and apply."""

    nodes: tuple[str, ...]  # nodes at the site, in the order of the network
    measures: int  # number of measured outputs, 0 without a sensor
    decides: tuple[str, ...]  # names of the decisions taken at the site
    applies: int  # number of inputs of the plant, 0 without an actuator
    predicts: int = 0  # number of states that the actuator's model predicts between steps, 0 without such a model
    tasks: tuple[str, ...] = ()  # what the nodes do, in words

    @property
    def title(self) -> str:
        """Names of the nodes at the site, joined by plus signs."""
        return " + ".join(self.nodes)


@dataclass(frozen=True, repr=False)
class Link(Displayed):
    """A link of the diagram, on which one node sends packets to another node."""

    name: str  # name of the link
    sender: str  # the sending node
    receiver: str  # the receiving node
    payload: Mapping[str, int] = field(hash=False)  # number of entries of each signal in a packet, by name
    packet: str  # the contents of a packet, in words
    when: When  # ``"always"``, ``"decision"``, ``"schedule"``
    rule: Rule = field(hash=False)  # when a packet is sent, in words
    decision: str | None = None  # name of the decision or schedule; None if a packet is sent at every step
    labels: tuple[str, ...] = ()  # labels of the decision for which a packet is sent
    silent: tuple[str, ...] = ()  # labels of the decision for which no packet is sent
    reads: tuple[str, ...] = ()  # signals and locations that the decision reads
    pattern: tuple[bool, ...] = ()  # for a schedule, whether step k sends
    repeats_from: int = 0  # first step of the repeating part of the pattern
    acknowledged: bool = False  # whether the sender uses acknowledgements of the packets
    law: LinkLaw = IDEAL_LINK  # the losses of the link
    later: bool = False  # whether the receiver has acted before the packet arrives, so that it acts on it a step later

    @property
    def lost(self) -> str:
        """How many packets the link drops, in words; empty if every packet arrives."""
        law = self.law.played()
        bursts = ", in bursts" if law.burst is not None else ""
        return f"drops {percent(law.mean_loss)}{bursts}" if law.mean_loss else ""

    @property
    def notes(self) -> tuple[str, ...]:
        """When the link sends a packet, in words, and a note if the receiver uses the packet only in the next step."""
        return (self.rule.sentence, *(("used in the next step",) if self.later else ()))

    @property
    def lateness(self) -> str:
        """After what time a packet is used, in words; empty if it is used at once or the time varies."""
        return f"used after {self.law.wait.text()}" if any(self.law.wait) else ""

    def document(self) -> dict[str, Any]:
        """Write the link as a dictionary for JSON."""
        return {
            "link": self.name,
            "from": self.sender,
            "to": self.receiver,
            "payload": dict(self.payload),
            "packet": self.packet,
            "when": self.when,
            "sends_when": self.rule.sentence,
            "symbols": dict(self.rule.symbols),
            "decision": self.decision,
            "labels": list(self.labels),
            "silent": list(self.silent),
            "reads": list(self.reads),
            "ticks": [k for k, sends in enumerate(self.pattern) if sends] if self.pattern else None,
            "length": len(self.pattern) or None,
            "repeats_from": self.repeats_from if self.pattern else None,
            "acknowledged": self.acknowledged,
            "delay": "; ".join(self.law.lateness()) or None,
        }


@dataclass(frozen=True, repr=False)
class Diagram(Displayed):
    """The sites and links of a policy. The links are in the order in which they send within a step."""

    places: tuple[Place, ...]  # the places, in the order of the nodes
    links: tuple[Link, ...]  # the links, in the order of their packets within a step
    controller: str  # the node that all links lead to or come from
    seconds: float | None = None  # duration of a step, or None if it is not known

    @property
    def hub(self) -> Place:
        """The site of the controller. Every link begins or ends there."""
        return self.places[self.place_of(self.controller)]

    def place_of(self, node: str) -> int:
        """Return the index of the site at which a node is."""
        return next(i for i, place in enumerate(self.places) if node in place.nodes)

    def wires(self, place: Place) -> list[Link]:
        """Return the links between a site and the controller."""
        return [link for link in self.links if {link.sender, link.receiver} & {*place.nodes}]

    def inwards(self, link: Link) -> bool:
        """Return whether a link ends at the controller."""
        return link.receiver in self.hub.nodes

    @property
    def period(self) -> str:
        """The sampling period as text; empty if it is not known."""
        return "" if self.seconds is None else f"every {number_text(self.seconds)} s"

    @property
    def explained(self) -> dict[str, list[str]]:
        """Explanations of symbols, such as "e: error". Each is listed with the links whose rules use the symbol."""
        found: dict[str, list[str]] = {}
        for link in self.links:
            for told in link.rule.explained:
                found.setdefault(told, []).append(link.name)
        return found

    @property
    def legend(self) -> tuple[str, ...]:
        """Explanations of all symbols. If a symbol has several meanings, each meaning names its links."""
        symbols = [told.partition(":")[0] for told in self.explained]
        return tuple(
            f"{told} ({listed(links)})" if symbols.count(told.partition(":")[0]) > 1 else told
            for told, links in self.explained.items()
        )

    def document(self) -> dict[str, Any]:
        """Write the diagram as a dictionary for JSON."""
        places = [
            {
                "nodes": list(place.nodes),
                "measures": place.measures,
                "decides": list(place.decides),
                "applies": place.applies,
                "predicts": place.predicts,
                "tasks": list(place.tasks),
            }
            for place in self.places
        ]
        return {"places": places, "links": [link.document() for link in self.links]}

    def text(self, *, plain: bool = False, legend: bool = True) -> str:
        """Draw the diagram as text of at most 80 columns: boxes, the links between them, and a legend of the symbols.

        A ``plain`` text has only ASCII.
        """
        columns = _Columns(self, plain)
        return "\n".join(line.rstrip() for line in (*columns.lines(), *(columns.below() if legend else [])))

    def html(self) -> str:
        """Write the diagram as preformatted HTML text for notebooks."""
        return f"<pre>{escape(self.text())}</pre>"

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Draw the diagram as a figure, in which the plant closes the control loop."""
        hub, *others = (self._box(place) for place in (self.hub, *(one for one in self.places if one is not self.hub)))
        plant = f"plant, sampled {self.period}" if self.period else "plant"
        return draw_star(hub, others, plant, self.legend, ax, figsize, style)

    def _box(self, place: Place) -> Box:
        """Return a place with its wires as it is drawn."""
        wires = [
            Wire(
                link.name,
                link.packet,
                (*link.notes, *filter(None, [link.lateness])),
                link.lost,
                link.acknowledged,
                self.inwards(link),
            )
            for link in (() if place is self.hub else self.wires(place))
        ]
        return Box(place.title, place.tasks, place.measures > 0, place.applies > 0, wires)


def diagram_of(policy: PolicyData) -> Diagram:
    """Make the diagram that shows the sites and links of a policy."""
    places = list[list[str]]()
    for node in policy.network.nodes:
        together = [
            group
            for group in places
            if any(node in policy.site(one) or policy.network.place(node) == policy.network.place(one) for one in group)
        ]
        if together:
            together[0].append(node)
        else:
            places.append([node])
    sends = [step for step in policy.steps if isinstance(step, Send)]
    return Diagram(
        tuple(_place(policy, tuple(nodes)) for nodes in places),
        tuple(_link(policy, step) for step in sends),
        policy.network.controller,
        step_seconds(policy),
    )


def _place(policy: PolicyData, nodes: tuple[str, ...]) -> Place:
    measures = sum(len(entries) for node, entries in policy.measured.values() if node in nodes)
    applies = sum(len(entries) for node, entries in policy.applied.values() if node in nodes)
    applied, predicted = (applies, 0) if policy.prediction is None or not applies else policy.prediction.L.shape
    decisions = tuple(step.decision for step in policy.steps if isinstance(step, Decide) and step.at in nodes)
    return Place(nodes, measures, decisions, applied, predicted, _tasks(policy, nodes))


def _tasks(policy: PolicyData, nodes: tuple[str, ...]) -> tuple[str, ...]:
    """Return the tasks of the nodes of a place, in words."""
    words, found = Words(policy), list[str]()
    steps = [step for step in policy.steps if step.at in nodes]
    stems = {words.plain(name) for step in steps for name in assigned(step)}
    measured = [name for name, (node, _) in policy.measured.items() if node in nodes]
    applied = [name for name, (node, _) in policy.applied.items() if node in nodes]
    for name in measured:
        found.append(f"{'is given' if name == REFERENCE else 'measures'} {words.numbered(name)}")
    if stems & ESTIMATING:
        found.append("estimates the state")
    elif stems & FILTERING and measured:
        found.append(f"filters {', '.join(map(words.numbered, measured))}")
    commands = {name for step in steps for name in assigned(step) if words.plain(name) == "command"}
    numbers = sorted({i for name in commands for i in (words.entries(name) or ("", ()))[1]})
    found += [f"computes {symbols_text('u', numbers)}"] if numbers else []
    found += [f"applies {words.numbered(name)}" for name in applied]
    acts = applied and (not stems & ESTIMATING or any(node in policy.network.links for node in nodes))
    silence = [silent for step in steps if acts and (silent := _in_silence(policy, step, words))]
    if policy.prediction is not None and applied:  # its inputs are those of a model of the plant between steps
        inputs = len(policy.prediction.L)
        found[-1] = f"applies {symbols_text('u', entry_numbers(range(inputs), inputs))}"
        silence = ["predicts it between steps"]
    return (*found, *silence[:1])


def _in_silence(policy: PolicyData, step: Step, words: Words) -> str:
    """Return the input of an actuator without a packet, in words, if a policy step determines it."""
    if not isinstance(step, Assign) or not isinstance(step.on, Received):
        return ""
    silent = step.branches[0]
    own = silent.get(step.signal) if len(silent) == 1 else None
    if step.signal not in policy.applied or own is None:
        return "predicts it in silence" if words.plain(step.signal) in PREDICTING else ""
    if is_identity(own, 1.0):
        return "holds it in silence"
    return "applies 0 in silence" if not isinstance(own, Scheduled) and not own.any() else ""


def _link(policy: PolicyData, step: Send) -> Link:
    payload = {name: policy.sizes[name] for name in step.payload}
    conditions = [*map(condition_of, policy.steps), *(location.on for location in policy.locations)]
    told = Acknowledged(step.link) in conditions
    receiver, law = policy.network.receiver(step.link), policy.network.links[step.link]
    packet, rule = Words(policy).packet(step.payload), rule_of(policy, step)
    before = policy.steps[: policy.steps.index(step)]
    later = any(
        one.at in policy.site(receiver)
        and (isinstance(one, Send) or any(name in policy.applied for name in assigned(one)))
        for one in before
    )
    ends = (step.link, step.at, receiver, payload, packet)
    if step.on is None:
        return Link(*ends, "always", rule, acknowledged=told, law=law, later=later)
    trigger = policy.decisions[step.on]
    labels = step.sending(trigger.labels)
    decided = (step.on, labels, tuple(label for label in trigger.labels if label not in labels))
    weights = [weight for form in trigger.forms for weight in (form.Psi, form.constant)]
    read_by = {weight.by for weight in weights if isinstance(weight, Scheduled)}
    turning = tuple(one.name for one in policy.locations if one.name in read_by and len(one.table) > 1)
    pattern, start = timetable(policy, trigger, labels) or ((), 0)
    when, reads = ("schedule", turning) if pattern else ("decision", (*trigger.reads, *turning))
    return Link(*ends, when, rule, *decided, reads, pattern, start, told, law, later)


class _Columns:
    """The lines of a diagram as text: two columns of boxes, the hub and the other places, and wires between them."""

    def __init__(self, shown: Diagram, plain: bool) -> None:
        """Choose the widths of the columns and of the wires."""
        self._shown, self._plain, self._hub = shown, plain, shown.hub
        self._places = [place for place in shown.places if place is not self._hub]
        self._hub_left = not any(map(shown.inwards, shown.links))
        self._near = self._boxed(self._hub)
        self._far = [self._boxed(place) for place in self._places]
        self._widths = _width([self._near]), _width(self._far)
        room = WIDTH - sum(self._widths)
        natural = [_columns(line) for place in self._places for line in self._labels(place, WIDTH)]
        self._wire = min(room, max([len("acknowledgement") + 8, *(length + 2 for length in natural)]))

    def lines(self) -> list[str]:
        """Return the text lines of the diagram without its legend."""
        rows = list[tuple[list[str], list[str]]]()  # wires and box of each place
        for place, box in zip(self._places, self._far, strict=True):
            wires = "\n\n".join("\n".join(self._drawn(link)) for link in self._shown.wires(place)).split("\n")
            height = max(len(box) + 2, len(wires))
            rows.append((wires + [""] * (height - len(wires)), _framed(box, self._widths[1], height)))
        wires, boxes = list[str](), list[str]()
        for one, box in rows:
            gap = [""] if wires else []
            wires, boxes = [*wires, *gap, *one], [*boxes, *gap, *box]
        height = max(len(self._near) + 2, len(wires))
        hub = _framed(self._near, self._widths[0], height)
        found = list[str]()
        for i in range(height):
            wire = _padded(wires[i] if i < len(wires) else "", self._wire)
            box = (boxes[i] if i < len(boxes) else "").ljust(self._widths[1])
            found.append("".join((hub[i], wire, box) if self._hub_left else (box, wire, hub[i])) if boxes else hub[i])
        found = [self._joined(line) for line in found]
        return [line.translate(LINES) if self._plain else line for line in found]

    def _joined(self, line: str) -> str:
        """Return a line whose wire begins at the frame of its sender."""
        return re.sub(r"│(?=[─┄])", "├", re.sub(r"(?<=[─┄])│", "┤", line))

    def below(self) -> list[str]:
        """Return the text lines of the legend: the meanings of the symbols, and the duration of a step."""
        period = f"one step: {self._shown.period.removeprefix('every ')}" if self._shown.period else ""
        lines = list[str]()
        for told in (*self._shown.legend, *([period] if period else [])):
            entry = textwrap.wrap(self._ascii(told), WIDTH, subsequent_indent="  ", break_on_hyphens=False)
            if lines and _columns(f"{lines[-1]}{BETWEEN}{entry[0]}") <= WIDTH and len(entry) == 1:
                lines[-1] += BETWEEN + entry[0]
            else:
                lines += entry
        return lines

    def _boxed(self, place: Place) -> list[str]:
        tasks = [line for task in place.tasks for line in _wrapped(self._ascii(task), BOX)]
        return [*_wrapped(place.title, BOX), *tasks]

    def _labels(self, place: Place, width: int) -> list[str]:
        return [
            line for link in self._shown.wires(place) for line in (*self._above(link, width), *self._notes(link, width))
        ]

    def _above(self, link: Link, width: int) -> list[str]:
        return _wrapped(self._ascii(f"{link.name}: {link.packet}"), width)

    def _notes(self, link: Link, width: int) -> list[str]:
        notes = (*link.notes, *filter(None, (link.lateness, link.lost)))
        return [line for note in notes for line in _wrapped(self._ascii(note), width)]

    def _drawn(self, link: Link) -> list[str]:
        """Return the lines of a link: the contents of its packets, the wire, and when it sends."""
        width, right = self._wire, self._shown.inwards(link) != self._hub_left
        wire = "─" * (width - 1) + "▶" if right else "◀" + "─" * (width - 1)
        found = [f" {line}" for line in self._above(link, width - 2)] + [wire]
        found += [f" {line}" for line in self._notes(link, width - 2)]
        if link.acknowledged:
            dashes = " acknowledgement ".center(width - 1, "┄")
            found.append(f"◀{dashes}" if right else f"{dashes}▶")
        return found

    def _ascii(self, text: str) -> str:
        return ascii_text(text) if self._plain else text


def ascii_text(text: str) -> str:
    """Replace the special characters of a diagram by ASCII characters."""
    for sign, letters in PLAIN.items():
        text = text.replace(sign, letters)
    return text


def _columns(text: str) -> int:
    """Return the columns that a text takes on a terminal, where accents have none of their own."""
    return sum(not unicodedata.combining(letter) for letter in text)


def _padded(text: str, width: int) -> str:
    return text + " " * (width - _columns(text))


def _width(boxes: Sequence[Sequence[str]]) -> int:
    """Return the width of the widest of some boxes with its frame, or 0 without boxes."""
    return max((_columns(line) + 4 for box in boxes for line in box), default=0)


def _framed(box: Sequence[str], width: int, height: int) -> list[str]:
    """Return the lines of a box of a given size."""
    inside = [*box, *[""] * (height - 2 - len(box))]
    edge = "─" * (width - 2)
    return [f"┌{edge}┐", *(f"│ {_padded(line, width - 4)} │" for line in inside), f"└{edge}┘"]


def _wrapped(text: str, width: int) -> list[str]:
    """Return the lines of a text; a comparison, and a number with its noun, stay on one line if they fit."""
    found = list[str]()
    for line in _split(glued(text), width):
        words = [line] if len(line) <= width else _split(line.replace(FIXED, " "), width)
        found += [part.replace(FIXED, " ") for word in words for part in folded(word, width)]
    return found


def _split(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width, break_on_hyphens=False, break_long_words=False) or [""]
