"""The nodes of a policy and the links between them, derived from its policy steps, as data and as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

from taciturn._display import Displayed
from taciturn._figure import Arrow, Size, draw_lanes
from taciturn.model.coverage import LOOPS, Coverage

if TYPE_CHECKING:
    from matplotlib.figure import Figure


DRAWN = Coverage(LOOPS, "diagrams do not show")
When = Literal["always", "decision", "schedule"]
COLUMNS = 80  # of a terminal
PLAIN = str.maketrans("┌┐└┘├┤┼┬│─▶◀┄≠", "+++++++++-><.#")
PLAIN |= {ord("│"): "|", ord("≠"): "!="}


@dataclass(frozen=True, repr=False)
class Place(Displayed):
    """A site of one or more nodes, with the signals that it measures and applies and the decisions that it takes."""

    nodes: tuple[str, ...]  # nodes at the site, in the order of the network
    measures: int  # number of measured outputs, 0 without a sensor
    decides: tuple[str, ...]  # names of the decisions taken at the site
    applies: int  # number of inputs of the plant, 0 without an actuator
    predicts: int = 0  # number of states that the actuator's model predicts between steps, 0 without such a model

    @property
    def lines(self) -> list[str]:
        """The lines of text in the box of the site."""
        found = [" + ".join(self.nodes)]
        if self.measures:
            found.append(f"measures y ({self.measures})")
        if self.decides:
            found.append(f"decides {', '.join(self.decides)}")
        if self.predicts:
            found.append(f"predicts state ({self.predicts})")
        if self.applies:
            found.append(f"applies input ({self.applies})")
        return found


@dataclass(frozen=True, repr=False)
class Link(Displayed):
    """The packets that one node sends to another node."""

    name: str  # name of the link
    sender: str  # the sending node
    receiver: str  # the receiving node
    payload: Mapping[str, int] = field(hash=False)  # number of entries of each signal in a packet, by name
    when: When  # ``"always"``, ``"decision"``
    decision: str | None = None  # name of the decision or schedule; None if a packet is sent at every step
    labels: tuple[str, ...] = ()  # labels of the decision for which a packet is sent
    silent: tuple[str, ...] = ()  # labels of the decision for which no packet is sent
    reads: tuple[str, ...] = ()  # signals and locations that the decision reads
    pattern: tuple[bool, ...] = ()  # for a schedule, whether step k sends
    repeats_from: int = 0  # first step of the repeating part of the pattern
    acknowledged: bool = False  # whether the sender uses acknowledgements of the packets

    @property
    def packet(self) -> str:
        """The signals in a packet with their numbers of entries, as text."""
        return ", ".join(f"{name} ({size})" for name, size in self.payload.items())

    @property
    def briefly(self) -> str:
        """The short description shown at the arrow of the link."""
        how = {"always": "always", "schedule": "scheduled", "decision": self._condition}
        return f"{self.packet}, {how[self.when]}"

    @property
    def condition(self) -> str:
        """The condition under which a packet is sent, as a clause."""
        if self.when == "always":
            return "at every step"
        if self.when == "decision":
            return f"{self._condition}, by {', '.join(self.reads)}"
        return f"{self._condition}, by the step counter: {pattern_text(self.pattern, self.repeats_from)}"

    @property
    def _condition(self) -> str:
        if self.labels == (self.decision,):
            return f"if {self.decision}"
        if len(self.silent) == 1:
            return f"if {self.decision} ≠ {self.silent[0]}"
        return f"if {self.decision} = {' or '.join(self.labels)}"

    def document(self) -> dict[str, Any]:
        """Return the link as a dictionary for JSON."""
        return {
            "link": self.name,
            "from": self.sender,
            "to": self.receiver,
            "payload": dict(self.payload),
            "when": self.when,
            "decision": self.decision,
            "labels": list(self.labels),
            "silent": list(self.silent),
            "reads": list(self.reads),
            "ticks": [k for k, sends in enumerate(self.pattern) if sends] if self.pattern else None,
            "length": len(self.pattern) or None,
            "repeats_from": self.repeats_from if self.pattern else None,
            "acknowledged": self.acknowledged,
        }


@dataclass(frozen=True, repr=False)
class Diagram(Displayed):
    """The sites of a policy, and its links in the order in which packets are sent within a step."""

    places: tuple[Place, ...]  # the sites, from the site of the sensor to the site of the actuator
    links: tuple[Link, ...]  # the links, in the order of their packets within a step

    def place_of(self, node: str) -> int:
        """Return the index of the site of a node."""
        return next(i for i, place in enumerate(self.places) if node in place.nodes)

    def document(self) -> dict[str, Any]:
        """Return the diagram as a dictionary for JSON."""
        places = [
            {
                "nodes": list(place.nodes),
                "measures": place.measures,
                "decides": list(place.decides),
                "applies": place.applies,
                "predicts": place.predicts,
            }
            for place in self.places
        ]
        return {"places": places, "links": [link.document() for link in self.links]}

    def text(self, *, plain: bool = False) -> str:
        """Return the diagram as text: a box for each site, and an arrow for each packet, with time running downwards.

        If the boxes do not fit side by side in 80 columns, the sites and the packets are two lists.
        """
        rows = _Rows(self)
        lines = [*rows.boxes(), *(line for link in self.links for line in rows.arrows(link)), rows.lifelines()]
        lines = self._listed() if max(map(len, lines)) > COLUMNS else lines
        drawn = "\n".join(line.rstrip() for line in lines)
        return drawn.translate(PLAIN) if plain else drawn

    def _listed(self) -> list[str]:
        """Return a line for each site, and one for each packet in the order of a step."""
        names = [" + ".join(place.nodes) for place in self.places]
        wide = max(map(len, names))
        lines = [
            f"{name:{wide}s}  {', '.join(place.lines[1:])}" for name, place in zip(names, self.places, strict=True)
        ]
        arrows = [f"{link.sender} ──▶ {link.receiver}" for link in self.links]
        width = max(map(len, arrows), default=0)
        for link, arrow in zip(self.links, arrows, strict=True):
            lines.append(f"{arrow:{width}s}  {link.briefly}{', acknowledged' * link.acknowledged}")
        return lines

    def plot(self, ax: Any = None, figsize: Size | None = None) -> Figure:
        """Return the diagram as a figure with the same contents as the text."""
        arrows: list[Arrow] = []
        for link in self.links:
            ends = self.place_of(link.sender), self.place_of(link.receiver)
            arrows.append(Arrow(*ends, link.briefly, dashed=link.when != "always"))
            if link.acknowledged:
                arrows.append(Arrow(ends[1], ends[0], "acknowledged", dashed=True))
        return draw_lanes([place.lines for place in self.places], arrows, ax, figsize)


def pattern_text(pattern: Sequence[bool], start: int) -> str:
    """Return a description of the steps at which a schedule sends."""
    if all(pattern) or not any(pattern):
        return "every step" if any(pattern) else "never"
    turn = pattern[start:]
    later = {0: "never", len(turn): "every step"}.get(sum(turn), f"{sum(turn)} of {len(turn)} steps")
    if start == 0:
        return later
    ticks = [k for k, sends in enumerate(pattern[:start]) if sends]
    listed = ", ".join(map(str, ticks[:8])) + (", …" if len(ticks) > 8 else "")
    first = f"{len(ticks)} of the first {start} steps" + (f" ({listed})" if ticks else "")
    return f"{first}, then {later}"


class _Rows:
    """The text lines of a diagram: boxes side by side, and a lifeline under each box where arrows begin and end."""

    def __init__(self, shown: Diagram) -> None:
        """Place the boxes far enough apart for the labels between them."""
        self.shown = shown
        ends = [self._ends(link) for link in shown.links]
        self.widths = [max(map(len, place.lines)) + 4 for place in shown.places]
        self.centres = [self.widths[0] // 2]
        for i, (left, right) in enumerate(pairwise(self.widths)):
            room = [left - left // 2 + right // 2 + 3]
            for link, (start, end) in zip(shown.links, ends, strict=True):
                if max(start, end) == i + 1 and start != end:
                    wide = len(link.briefly) + 8
                    room.append(wide - (self.centres[i] - self.centres[min(start, end)]))
            self.centres.append(self.centres[i] + max(room))

    def boxes(self) -> list[str]:
        """Return the lines of the boxes."""
        height = max(len(place.lines) for place in self.shown.places)
        found = [[" "] * (self.centres[-1] + self.widths[-1]) for _ in range(height + 2)]
        for place, width, centre in zip(self.shown.places, self.widths, self.centres, strict=True):
            inside = [f"│ {line:{width - 4}s} │" for line in [*place.lines, *[""] * (height - len(place.lines))]]
            left = centre - width // 2
            bottom = "└" + "─" * (width // 2 - 1) + "┬" + "─" * (width - width // 2 - 2) + "┘"
            for row, text in zip(found, ["┌" + "─" * (width - 2) + "┐", *inside, bottom], strict=True):
                row[left : left + width] = text
        return ["".join(row) for row in found]

    def arrows(self, link: Link) -> list[str]:
        """Return the lines for a packet and its acknowledgement."""
        start, end = self._ends(link)
        if start == end:
            return [self.lifelines(), self._beside(start, f"◀ {link.briefly}")]
        told = [self._arrow(end, start, "acknowledged", "┄")] if link.acknowledged else []
        return [self.lifelines(), self._arrow(start, end, link.briefly, "─"), *told]

    def lifelines(self) -> str:
        """Return a line that contains only the lifelines."""
        row = [" "] * (self.centres[-1] + 1)
        for centre in self.centres:
            row[centre] = "│"
        return "".join(row)

    def _ends(self, link: Link) -> tuple[int, int]:
        return self.shown.place_of(link.sender), self.shown.place_of(link.receiver)

    def _arrow(self, start: int, end: int, label: str, line: str) -> str:
        row = list(self.lifelines())
        low, high = sorted((self.centres[start], self.centres[end]))
        row[low + 1 : high] = f" {label} ".center(high - low - 1, line)
        row[self.centres[start]] = "├" if start < end else "┤"
        row[high - 1 if start < end else low + 1] = "▶" if start < end else "◀"
        return "".join(row)

    def _beside(self, place: int, label: str) -> str:
        row = list(self.lifelines())
        row[self.centres[place] + 1 : self.centres[place] + 1 + len(label)] = label
        return "".join(row)
