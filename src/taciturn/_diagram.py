"""The diagram of a network: the controller in the middle, senders on the left, receivers on the right, plant below.

All lengths are in inches. The lines of every text are measured before anything is drawn, and boxes, wires and figure
get the size that they need; so no two texts meet and none is cut, whatever the nodes are called. In smaller axes the
whole picture is scaled. Each wire has a row of its own between two boxes, with its name and the contents of its packets
above it, and the rule and the losses below it; a cross marks a wire that drops packets. The plant is drawn as the block
that closes the loop: a line from the plant to what measures, and from what applies to the plant.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

from taciturn._figure import Size, blank_sheet
from taciturn._style import Style, StyleName, find_style
from taciturn._text import folded

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LETTERS, LINE = 8.5, 0.155  # size of the letters in points, and distance of lines
TITLE = 9.5  # size of the names of nodes
PAD, GAP, EDGE = 0.12, 0.2, 0.14  # inside a box, between boxes and wires, and at the edge of the picture
BOX, WIRE = 1.55, 2.05  # largest width of the texts in a box and at a wire
SLACK = 1.08  # of the exact width of a text, since a screen rounds the width of each letter
BUS, SET_IN = 0.36, 0.12  # from a column of boxes to the edge of the plant, and from there to their common line
FIXED = "\N{NO-BREAK SPACE}"
BETWEEN = 5 * "\N{NO-BREAK SPACE}"  # entries of the legend
CROSS = 0.045  # half the width of the cross on a wire that drops packets


@dataclass(frozen=True)
class Wire:
    """A link between the controller's box and another box of the diagram, drawn as an arrow."""

    name: str
    packet: str  # the contents of a packet
    notes: Sequence[str]  # when it is sent
    lost: str  # how many packets it drops; empty for none
    acknowledged: bool  # whether a line goes back
    inwards: bool  # whether packets go to the controller


@dataclass(frozen=True)
class Box:
    """A location in the network, drawn as a box that lists the nodes at this location."""

    title: str
    tasks: Sequence[str]
    measures: bool  # whether a line comes from the plant
    applies: bool  # whether a line goes to the plant
    wires: Sequence[Wire] = ()


@dataclass(frozen=True)
class _Text:
    """Lines of one size and weight below each other."""

    lines: tuple[str, ...]
    size: float = LETTERS
    bold: bool = False

    @cached_property
    def width(self) -> float:
        """Width of the longest line of the text, in inches."""
        return max((_measured(line, self.size, self.bold) for line in self.lines), default=0.0)

    @property
    def height(self) -> float:
        """Total height of the lines of the text, in inches."""
        return LINE * self.size / LETTERS * len(self.lines)


def _measured(line: str, size: float, bold: bool) -> float:
    """Return the width of a line of text."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(size=size, weight="bold" if bold else "normal")
    measured: Any = text_to_path.get_text_width_height_descent(line, font, ismath=False)
    return SLACK * float(measured[0]) / 72


def _wrapped(text: str, width: float, size: float = LETTERS, bold: bool = False) -> tuple[str, ...]:
    """Return the lines of a text that is wrapped to a width; a word that is longer is divided."""
    lines, words = [""], glued(text).split(" ")
    while words:
        word = words.pop(0)
        longer = f"{lines[-1]} {word}".strip()
        if _measured(longer, size, bold) <= width:
            lines[-1] = longer
        elif lines[-1]:
            lines.append("")
            words.insert(0, word)
        elif FIXED in word:
            words = [*word.split(FIXED), *words]
        else:
            letters = next(i for i in range(len(word), 0, -1) if i == 1 or _measured(word[:i], size, bold) <= width)
            first = folded(word, letters)[0]
            lines[-1] = first
            words.insert(0, word[len(first) :])
            lines.append("")
    return tuple(line.replace(FIXED, " ") for line in lines if line)


@dataclass(frozen=True)
class _Wire:
    """A wire with its texts."""

    of: Wire
    name: _Text
    packet: _Text
    notes: _Text
    lost: _Text
    back: _Text  # the word at the line of the acknowledgements, or no line

    @staticmethod
    def fitted(link: Wire, width: float) -> _Wire:
        """Lay out the texts at a link of the diagram, with lines no longer than the given width."""
        notes = [line for note in link.notes for line in _wrapped(note, width)]
        return _Wire(
            link,
            _Text(_wrapped(link.name, width, bold=True), bold=True),
            _Text(_wrapped(link.packet, width)),
            _Text(tuple(notes)),
            _Text(_wrapped(link.lost, width)),
            _Text(("acknowledgement",) if link.acknowledged else ()),
        )

    @property
    def width(self) -> float:
        """Width of the widest text at the link, in inches."""
        return max(text.width for text in (self.name, self.packet, self.notes, self.lost, self.back))

    @property
    def above(self) -> float:
        """Height of the texts above the line of the link, in inches."""
        return self.name.height + self.packet.height + 0.06

    @property
    def height(self) -> float:
        """Height of the link and of its texts, in inches."""
        below = self.notes.height + self.lost.height
        return self.above + 0.06 + below + (self.back.height + 0.1 if self.back.lines else 0.0)


@dataclass(frozen=True)
class _Box:
    """A box with its texts and wires."""

    of: Box
    title: _Text
    tasks: _Text
    wires: tuple[_Wire, ...] = ()

    @staticmethod
    def fitted(box: Box) -> _Box:
        """Lay out the texts of a box and of its links, with lines no longer than the greatest allowed width."""
        title = _wrapped(box.title, BOX, TITLE, bold=True)
        tasks = tuple(line for task in box.tasks for line in _wrapped(task, BOX))
        wires = tuple(_Wire.fitted(wire, WIRE) for wire in box.wires)
        return _Box(box, _Text(title, TITLE, bold=True), _Text(tasks), wires)

    @property
    def width(self) -> float:
        """Width of the box, including its margins, in inches."""
        return max(self.title.width, self.tasks.width) + 2 * PAD

    @property
    def texts(self) -> float:
        """Total height of the box's title and list of tasks, in inches."""
        return self.title.height + 0.04 + self.tasks.height

    @property
    def row(self) -> float:
        """Total height of all links of the box, in inches."""
        return sum(wire.height for wire in self.wires) + GAP * (len(self.wires) - 1) if self.wires else 0.0

    @property
    def height(self) -> float:
        """Height of the box, in inches, with enough room for its texts and its links."""
        return max(self.texts + 2 * PAD, self.row + 0.08)


class _Column:
    """Boxes below each other on one side of the controller, with their wires."""

    def __init__(self, boxes: Sequence[Box]) -> None:
        """Measure the boxes and the wires."""
        self.boxes = [_Box.fitted(box) for box in boxes]
        self.width = max((box.width for box in self.boxes), default=0.0)
        self.wire = max((wire.width for box in self.boxes for wire in box.wires), default=0.0) + 0.4
        self.height = sum(box.height for box in self.boxes) + GAP * (len(self.boxes) - 1) if self.boxes else 0.0
        self.bus = BUS if len(self.boxes) > 1 else 0.0

    @property
    def whole(self) -> float:
        """Width of a column of boxes, in inches, including its links and the line to the plant."""
        return self.bus + self.width + self.wire if self.boxes else 0.0


class _Pencil:
    """Texts, boxes and lines on axes in inches."""

    def __init__(self, axis: Any, factor: float, style: Style) -> None:
        """Store the axes, the factor of the letters and the colours."""
        self._axis, self._factor, self.hues = axis, factor, style.hues

    def text(self, x: float, top: float, text: _Text, color: str, align: str = "left") -> None:
        """Draw the lines of a text. The first line begins at the height ``top``."""
        step = text.height / max(len(text.lines), 1)
        for i, line in enumerate(text.lines):
            self._axis.text(
                x, top - step * (i + 0.78), line, ha=align, va="baseline", color=color, parse_math=False,
                fontsize=text.size * self._factor, fontweight="bold" if text.bold else "normal",
            )  # fmt: skip

    def box(self, x: float, y: float, width: float, height: float, fill: str) -> None:
        """Draw a box with rounded corners, whose lower left corner is at (x, y)."""
        from matplotlib.patches import FancyBboxPatch

        style: Any = "round,pad=0,rounding_size=0.06"
        self._axis.add_patch(
            FancyBboxPatch((x, y), width, height, boxstyle=style, facecolor=fill, edgecolor=self.hues["muted"],
                           linewidth=1.0 * self._factor, zorder=2)
        )  # fmt: skip

    def line(self, points: Sequence[tuple[float, float]], color: str, arrow: bool, dashed: bool = False) -> None:
        """Draw a line through the given points. If ``arrow`` is true, the line ends in an arrowhead."""
        from matplotlib.patches import FancyArrowPatch
        from matplotlib.path import Path

        style: Any = f"-|>,head_length={4 * self._factor},head_width={2 * self._factor}" if arrow else "-"
        dashes: Any = (0, (3, 2)) if dashed else "solid"
        self._axis.add_patch(
            FancyArrowPatch(path=Path(points), arrowstyle=style, color=color, linestyle=dashes, shrinkA=0, shrinkB=0,
                            linewidth=(1.0 if dashed else 1.4) * self._factor, zorder=1, joinstyle="miter",
                            capstyle="butt")
        )  # fmt: skip


def draw_star(
    hub: Box,
    others: Sequence[Box],
    plant: str,
    legend: Sequence[str],
    ax: Any = None,
    figsize: Size | None = None,
    style: StyleName = "light",
) -> Figure:
    """Draw the diagram: the controller's box, the boxes and links around it, the plant, and a legend of the symbols."""
    from matplotlib import rc_context  # pyright: ignore[reportUnknownVariableType]  # its stubs are partial

    used, context = find_style(style), cast("Any", rc_context)
    with context(used.settings):  # of the fonts that are measured
        return _drawn(hub, others, plant, legend, ax, figsize, used)


def _drawn(
    hub: Box, others: Sequence[Box], plant: str, legend: Sequence[str], ax: Any, figsize: Size | None, style: Style
) -> Figure:
    left, right = map(_Column, _sides(others))
    middle = _Box.fitted(hub)
    loop = _Text((plant,), TITLE, bold=True)
    tall = max(middle.height, left.height, right.height)
    width = max(left.whole + middle.width + right.whole, loop.width + 2 * PAD) + 2 * EDGE
    told = _Text(_flowing(legend, width - 2 * EDGE))
    below = told.height + (0.12 if told.lines else 0.0)
    block, apart = loop.height + 2 * PAD, 0.34  # the plant, and its distance from the boxes
    height = 2 * EDGE + tall + apart + block + below
    figure, axis, factor = blank_sheet(width, height, ax, figsize)
    if ax is None:
        cast("Any", figure).style = style
        figure.set_facecolor(style.background)
    pencil, hues = _Pencil(axis, factor, style), style.hues
    top, floor = height - EDGE, EDGE + below + block  # of the boxes, and of the plant
    x = EDGE + left.whole
    pencil.box(x, top - tall, middle.width, tall, hues["hub"])
    _write(pencil, middle, x, top - (tall - middle.texts) / 2)
    pencil.box(EDGE, EDGE + below, width - 2 * EDGE, block, hues["box"])
    pencil.text(width / 2, floor - PAD, loop, hues["ink"], "center")
    pencil.text(EDGE, EDGE + told.height, told, hues["muted"])
    _draw_column(pencil, left, EDGE, x, top, tall, floor)
    _draw_column(pencil, right, width - EDGE, x + middle.width, top, tall, floor)
    _couple(pencil, hub, x, middle.width, top - tall, floor)
    return figure


def _flowing(told: Sequence[str], width: float) -> tuple[str, ...]:
    """Return the lines of entries one after the other, of which each begins on a new line if it does not fit."""
    lines = list[str]()
    for entry in told:
        longer = f"{lines[-1]}{BETWEEN}{entry}" if lines else ""
        if longer and _measured(longer, LETTERS, bold=False) <= width:
            lines[-1] = longer
        else:
            lines += _wrapped(entry, width)
    return tuple(lines)


def _sides(boxes: Sequence[Box]) -> tuple[list[Box], list[Box]]:
    """Return the boxes on the left of the controller, which send to it, and those on its right, which receive."""
    ways = [{wire.inwards for wire in box.wires} for box in boxes]
    left = [box for box, inwards in zip(boxes, ways, strict=True) if inwards == {True}]
    right = [box for box, inwards in zip(boxes, ways, strict=True) if inwards == {False}]
    for box, inwards in zip(boxes, ways, strict=True):
        if len(inwards) != 1:
            (left if len(left) <= len(right) else right).append(box)
    return left, right


def _draw_column(
    pencil: _Pencil,
    column: _Column,
    outside: float,
    inside: float,
    top: float,
    tall: float,
    floor: float,
) -> None:
    """Draw the boxes between an edge of the picture and the controller's box, with wires, and lines to the plant."""
    hues, side = pencil.hues, 1.0 if outside < inside else -1.0
    outer, y = outside + side * column.bus, top - (tall - column.height) / 2
    coupled, line = list[float](), outside + side * SET_IN
    for box in column.boxes:
        x = min(outer, outer + side * column.width)
        pencil.box(x, y - box.height, column.width, box.height, hues["box"])
        _write(pencil, box, x, y - (box.height - box.texts) / 2)
        ends = sorted((outer + side * column.width, inside))
        row = y - (box.height - box.row) / 2
        for wire in box.wires:
            _draw_wire(pencil, wire, ends, row, wire.of.inwards == (side > 0))
            row -= wire.height + GAP
        middle = y - box.height / 2
        if not column.bus:
            _couple(pencil, box.of, x, column.width, y - box.height, floor)
        elif box.of.measures or box.of.applies:
            coupled.append(middle)
            if box.of.measures:
                pencil.line([(line, middle), (outer, middle)], hues["muted"], arrow=True)
            else:
                pencil.line([(outer, middle), (line, middle)], hues["muted"], arrow=False)
        y -= box.height + GAP
    if column.bus and coupled:
        applies = any(box.of.applies for box in column.boxes)
        pencil.line([(line, max(coupled)), (line, floor)], hues["muted"], arrow=applies)


def _couple(pencil: _Pencil, box: Box, x: float, width: float, bottom: float, floor: float) -> None:
    """Draw the lines between a box and the plant below it: up to nodes that measure, down from nodes that apply."""
    both = bool(box.measures and box.applies)
    for given, ends, shift in ((box.measures, (floor, bottom), -1), (box.applies, (bottom, floor), 1)):
        if given:
            middle = x + width / 2 + (0.12 * shift if both else 0.0)
            pencil.line([(middle, ends[0]), (middle, ends[1])], pencil.hues["muted"], arrow=True)


def _write(pencil: _Pencil, box: _Box, x: float, top: float) -> None:
    """Draw the texts of a box below a height."""
    pencil.text(x + PAD, top, box.title, pencil.hues["ink"])
    pencil.text(x + PAD, top - box.title.height - 0.04, box.tasks, pencil.hues["muted"])


def _draw_wire(pencil: _Pencil, wire: _Wire, ends: Sequence[float], top: float, right: bool) -> None:
    """Draw a wire from left to right or back, with its texts, below a height."""
    hues, x, y = pencil.hues, ends[0] + 0.16, top - wire.above
    pencil.text(x, top, wire.name, hues["blue"])
    pencil.text(x, top - wire.name.height, wire.packet, hues["ink"])
    start, end = ends if right else (ends[1], ends[0])
    pencil.line([(start, y), (end, y)], hues["blue"], arrow=True)
    if wire.lost.lines:
        at = end + 0.24 * (1 if start > end else -1)
        for turn in (-CROSS, CROSS):
            pencil.line([(at - CROSS, y - turn), (at + CROSS, y + turn)], hues["red"], arrow=False)
    pencil.text(x, y - 0.06, wire.notes, hues["ink"])
    y -= 0.06 + wire.notes.height
    pencil.text(x, y, wire.lost, hues["red"])
    if wire.back.lines:
        y -= wire.lost.height + 0.04
        pencil.text(x, y, wire.back, hues["muted"])
        y -= wire.back.height + 0.05
        pencil.line([(end, y), (start, y)], hues["blue"], arrow=True, dashed=True)


def glued(text: str) -> str:
    """Replace some spaces by non-breaking spaces, such as the space between a number and its unit."""
    text = re.sub(r"(?<=\d) (?=numbers?|steps?|s\b|%|\S*²)", FIXED, text)
    text = text.replace(" × ", f"{FIXED}×{FIXED}")
    return re.sub(r"(\S+) ([<>]) (\S+)", rf"\1{FIXED}\2{FIXED}\3", text)
