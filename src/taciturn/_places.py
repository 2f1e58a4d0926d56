"""Where texts have room in a figure: widths and lines of texts, and places next to points and curves, in points.

A text is divided into as few lines as have room, of nearly equal lengths. Names that would overlap move apart by as
little as possible. The note of a point stands perpendicular to its curve, where it covers nothing, nearer to its own
point than to the others; a place that is far from other curves comes first, also if it is far from the point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, TypeAlias

from taciturn._style import Style

Spot: TypeAlias = tuple[float, float]
Box: TypeAlias = tuple[float, float, float, float]  # left, below, right, top
_AROUND = ((0, -1), (-1, -1), (1, -1), (-1, 0), (1, 0), (0, 1), (-1, 1), (1, 1))  # directions from a point
_OTHER_SIDE = math.pi / 6  # by how much the place of a note is worse above a curve than below it, as an angle
_NEAR, _FAR = 0.45, 1.9  # distances of the note of a point from it, in heights of letters
_CLEAR = 1.5  # least distance of a note from a curve, in points


def in_lines(text: str, letters: float, room: float, style: Style) -> str:
    """Return a text in as few lines as have room, of nearly equal lengths; a percent sign stays with its number.

    A text that needs more than one line is first divided where it has ends of lines.
    """
    words = text.replace("\n", " ").replace(" %", "\N{NO-BREAK SPACE}%").split(" ")
    whole = text_width(" ".join(words), letters, style)
    if "\n" in text and whole > room:
        return "\n".join(in_lines(part, letters, room, style) for part in text.splitlines())
    lines = _filled(words, letters, room, style)
    for share in range(20, 10, -1):
        even = _filled(words, letters, min(room, 0.1 * share * whole / len(lines)), style)
        lines = even if len(even) == len(lines) else lines
    return "\n".join(lines).replace("\N{NO-BREAK SPACE}", " ")


def _filled(words: Sequence[str], letters: float, room: float, style: Style) -> list[str]:
    """Return words in lines that have room, if each word has."""
    lines = [""]
    for word in words:
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and text_width(longer, letters, style) > room:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def key_width(widths: Sequence[float], lines: int) -> float:
    """Return the width of a key with a number of lines, whose entries fill the columns in turn."""
    columns = -(-len(widths) // lines)
    short, long = divmod(len(widths), max(columns, 1))  # the first columns have one more entry
    sizes = [short + (index < long) for index in range(columns)]
    ends = [sum(sizes[: index + 1]) for index in range(columns)]
    return sum(max(widths[end - size : end]) for size, end in zip(sizes, ends, strict=True))


def text_width(text: str, letters: float, style: Style) -> float:
    """Return the width of a line of text, in points."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextToPath

    measure: Any = TextToPath()
    font = FontProperties(family=style.settings["font.family"], size=letters)
    return float(measure.get_text_width_height_descent(text, font, "$" in text)[0]) if text else 0.0


def spread(places: Sequence[float], apart: float) -> list[float]:
    """Return places in the order of the given places, as near to them as possible, with at least a given distance."""
    order = sorted(range(len(places)), key=lambda index: places[index])
    groups: list[tuple[float, int]] = []  # centre and number of places that touch
    for index in order:
        centre, size = places[index], 1
        while groups and groups[-1][0] + apart * (groups[-1][1] + size) / 2 > centre:
            other, more = groups.pop()
            centre = (centre * size + other * more) / (size + more)
            size += more
        groups.append((centre, size))
    found = [centre + apart * (k - (size - 1) / 2) for centre, size in groups for k in range(size)]
    return [place for _, place in sorted(zip(order, found, strict=True))]


def place_beside(
    points: Sequence[Spot],
    index: int,
    size: Spot,
    frame: Box,
    curves: tuple[Sequence[Spot], Sequence[Spot], Sequence[Spot]],
    letters: float,
    mark: float,
) -> tuple[float, float, bool] | None:
    """Return the lower left corner of the note of a point, and whether it is so near that it needs no line to it.

    The note has a width and a height, and must be inside of a frame. It must not cover the places ``curves``: those of
    the curve itself, of other curves, and of texts and levels. A point with a ring has a ``mark`` around it.
    """
    own, others, taken = curves
    (x, y), (wide, tall) = points[index], size
    directions = _perpendicular(points, index)
    for near, clear in ((True, letters), (False, letters), (True, _CLEAR), (False, _CLEAR)):
        away = (_NEAR if near else _FAR) * letters + mark
        for across, up in directions:
            reach = away * (1 if across and up else 1.5)
            left = x + across * reach - wide * (1 - across) / 2
            below = y + up * reach - tall * (1 - up) / 2
            box = left, below, left + wide, below + tall
            inside = frame[0] < box[0] and frame[1] < box[1] and box[2] < frame[2] and box[3] < frame[3]
            if not inside or meets(box, _CLEAR, own) or meets(box, _CLEAR, taken) or meets(box, clear, others):
                continue
            apart = [_distance(box, point) for point in points]
            line = [] if near else along([(x, y), ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)], _CLEAR)
            if apart[index] <= min(apart) and not any(meets((*spot, *spot), _CLEAR, others) for spot in line):
                return left, below, near
    return None


def _perpendicular(points: Sequence[Spot], index: int) -> list[tuple[int, int]]:
    """Return directions from a point of a curve, those perpendicular to it first, and those below it before others."""
    before, after = points[max(index - 1, 0)], points[min(index + 1, len(points) - 1)]
    curve = math.atan2(after[1] - before[1], after[0] - before[0]) if before != after else 0.0
    below = curve - math.pi / 2 if math.cos(curve) >= 0 else curve + math.pi / 2

    def apart(angle: float) -> float:
        return abs(math.remainder(angle, 2 * math.pi))

    def worse(direction: tuple[int, int]) -> float:
        angle = math.atan2(direction[1], direction[0])
        return min(apart(angle - below), apart(angle - below - math.pi) + _OTHER_SIDE)

    return sorted(_AROUND, key=worse)


def _distance(box: Box, spot: Spot) -> float:
    """Return the distance of a place from a box."""
    (left, below, right, top), (x, y) = box, spot
    return math.hypot(max(left - x, 0.0, x - right), max(below - y, 0.0, y - top))


def meets(box: Box, margin: float, spots: Sequence[Spot]) -> bool:
    """Return whether a box with a margin contains one of some places."""
    left, below, right, top = box[0] - margin, box[1] - margin, box[2] + margin, box[3] + margin
    return any(left < x < right and below < y < top for x, y in spots)


def covered(left: float, below: float, wide: float, tall: float) -> list[Spot]:
    """Return places in a box that are so dense that no text fits between them."""
    across = 1 + int(wide / 4)
    return [(left + k * wide / across, below + n * tall / 2) for k in range(across + 1) for n in range(3)]


def along(points: Sequence[Spot], apart: float) -> list[Spot]:
    """Return places along a curve that are so far apart at most."""
    found = list[Spot]()
    for (a, b), (c, d) in pairwise(points):
        steps = 1 + min(int(math.hypot(c - a, d - b) / apart), 2000)
        found += [(a + k * (c - a) / steps, b + k * (d - b) / steps) for k in range(steps + 1)]
    return found
