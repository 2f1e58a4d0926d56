"""Figures as data: panels that contain series, bands, levels and lanes. Only this module draws with matplotlib.

A figure says *what* is drawn, the style (``_style``) how it looks: each series names the ``thing`` that it shows, which
has one colour and one mark in all figures. ``draw`` makes the figure:

* Panels are below each other; they share the x axis if only the last one has an x label. ``Side`` s of panels are next
  to each other, with equal y axes in each row.
* A key above each panel names its series, so that it never covers a curve; ``ends`` writes the names at the right ends
  of the curves instead. A ``Level`` is a line across the axes with its name at its end, a ``Band`` a shaded region.
* The notes of points stand perpendicular to their curve, where they cover nothing, farther away with a thin line.
* A ``Lane`` is a row of packets: a stroke for a delivered one, a cross for a dropped one, an open circle for a late
  one, with its name on the left, and a note such as the number of packets on the right.
* An axis is logarithmic if its values are far apart. An axis of costs has percentages above that of sending every
  sample (``Above``), and shows what is far from it nearer, by the inverse hyperbolic sine; its label says so.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast

from taciturn._places import Spot, along, covered, in_lines, key_width, place_beside, spread, text_width
from taciturn._style import DASHED, DOTTED, STYLES, TONES, Hue, Style, StyleName, Thing, figure_class, find_style
from taciturn._text import ending_text, folded
from taciturn.errors import ProblemError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FORMATS = (".svg", ".png", ".pdf")
HEIGHT = 3.4  # of a panel that fills a figure, in inches
_LINE = 1.45  # distance of lines of text, in heights of letters
_LONGEST_NAME = 26  # largest number of letters in a line of a name next to an axis
_SLANT = 30  # degrees by which long labels of the x axis are rotated
_LARGEST = 400.0  # largest width or height in inches; matplotlib cannot draw more than 65,536 pixels
_LANE, _AROUND = 0.24, 0.12  # height of a lane, and of what is above and below all lanes, in inches
_TICK = 0.3  # half of the height of the mark of a packet, in lanes
_FLAT = 0.8  # height of a panel in inches, below which the label of its y axis is horizontal
_APART = 4.0  # ratio of the farthest value to the near ones above which an axis bends
_BESIDE = 0.88  # part of the width of the axes that a title and a key beside it fill at most, as names need room too
_NUMBER = 0.75  # width of a percentage at an axis, with a distance, in inches
ROW = 0.3  # height of a row with a name, in inches
_EDGE = 0.06  # distance of titles from the edges of a figure, in inches
_TINY = 1e-4  # end of a logarithmic axis below which its numbers are powers of ten
_RING = 1.0  # radius of a ring around a mark, in sizes of the mark
Size: TypeAlias = tuple[float, float]
Cell: TypeAlias = "tuple[Any, Panel]"  # axes of matplotlib and what they show
Curve = Literal["line", "dashed", "dotted", "steps", "points", "stems", "bars", "stalks", "histogram", "ring"]


@dataclass(frozen=True)
class Series:
    """Points (x, y) that are drawn as a curve, optionally with error bars of length ±``error``.

    The error bars of the curve ``"bars"`` are in x.

    A ``"histogram"`` has one more x, the edges of its classes. The curve ``"points"`` has marks alone, ``"stalks"`` are
    bars with lines from 0 to their marks, and a ``"ring"`` surrounds a mark of another series.
    """

    x: Sequence[float]
    y: Sequence[float]
    label: str = ""
    curve: Curve = "line"
    error: Sequence[float] | None = None
    thing: Thing | int = 0
    faint: bool = False  # whether it is secondary, such as the estimate of a state
    notes: Sequence[str] = ()  # beside its points, such as the parameter of each; those without room are left out
    signal: int | None = None  # its number among several signals of the thing, which differ in dash and tone


@dataclass(frozen=True)
class Band:
    """A shaded region between two curves or between two numbers. A bound of None is the end of the axis."""

    low: Sequence[float] | float | None
    high: Sequence[float] | float | None
    x: Sequence[float] | None = None
    label: str = ""
    thing: Thing | int = "unreachable"
    text: str = ""  # within the region, at the right of the lower end of the axis


@dataclass(frozen=True)
class Level:
    """A straight line across a panel at a constant x or y. Its name is written at the end of the line."""

    at: float
    label: str = ""
    thing: Thing | int = "every sample"
    axis: Literal["x", "y"] = "y"


@dataclass(frozen=True)
class Lane:
    """A row of a figure with a mark at the time of each packet of one link."""

    name: str
    delivered: Sequence[float]
    dropped: Sequence[float] = ()
    late: Sequence[float] = ()
    note: str = ""  # on the right, such as the number of packets


@dataclass(frozen=True)
class Above:
    """A scale of an axis: values are labelled as percentages above the number ``base``.

    A value is drawn at asinh((value − base)/bend): the axis is nearly linear within ``bend`` of the base, and nearly
    logarithmic beyond. If ``bend`` is None, the axis is linear.
    """

    base: float
    bend: float | None = None

    @classmethod
    def of(cls, base: float, near: Sequence[float], far: Sequence[float] = ()) -> Above:
        """Choose the scale such that the values ``near`` remain distinguishable when values ``far`` from them are shown
        too.
        """
        inner = max(abs(value - base) for value in near)
        outer = max((abs(value - base) for value in (*near, *far)), default=0.0)
        return cls(base, 0.3 * inner if outer > _APART * inner > 0 else None)

    def label(self, cost: str, per: str) -> str:
        """Return the label of the axis, which says whether the axis is bent."""
        bent = "" if self.bend is None else "\n(axis: logarithmic far from 0)"
        return f"{cost} above every sample, {self.base:.4g} {per}{bent}"


@dataclass(frozen=True)
class Panel:
    """A pair of axes and its contents. The axis y shows ``names`` at 0, 1, ….

    ``notes`` are on the right of the names, below their heading ``noted``. ``height`` is in inches of a figure for a
    screen; a panel with names or lanes has the height of its rows.
    """

    series: Sequence[Series] = ()
    xlabel: str = ""
    ylabel: str = ""
    title: str = ""
    names: Sequence[str] = ()
    notes: Sequence[str] = ()
    noted: str = ""
    xlim: tuple[float | None, float | None] | None = None
    ylim: tuple[float | None, float | None] | None = None
    xlog: bool = False
    ylog: bool = False
    xabove: Above | None = None
    yabove: Above | None = None
    bands: Sequence[Band] = ()
    levels: Sequence[Level] = ()
    lanes: Sequence[Lane] = ()
    ends: bool = False
    height: float = HEIGHT
    thing: Thing | int | None = None  # that all of it shows, in whose colour the title is
    step: float | None = None  # distance of the steps on the x axis, which stems and packets leave free
    note: str = ""  # above the panel, on the right
    row: float = ROW  # height of a row with a name, in inches

    @property
    def inches(self) -> float:
        """Height of the panel, in inches, in a figure for the screen."""
        if self.lanes:
            return _LANE * len(self.lanes) + _AROUND
        return self.row * len(self.names) + _AROUND if self.names else self.height

    def inches_in(self, style: Style) -> float:
        """Return the height of the panel, in inches, in a given style. The height of a row of packets depends on the
        font size.
        """
        return self.inches * (style.letters / STYLES["light"].letters if self.lanes else style.tall)


@dataclass(frozen=True)
class Side:
    """A column of a figure: several panels, one below the other."""

    panels: Sequence[Panel]


def draw(
    panels: Sequence[Panel] | Sequence[Side],
    ax: Any = None,
    figsize: Size | None = None,
    style: StyleName = "light",
) -> Figure:
    """Draw a figure of several panels, in one column or in several columns.

    Args:
        panels: the panels, or columns with equally many panels.
        ax: matplotlib axes to draw in instead of a new figure: one, or a sequence with one for each panel, row by row.
        figsize: width and height of a new figure, in inches; default: as wide as the style, as high as the panels.
        style: name of the style.

    Raises:
        ProblemError: ``ax``, ``figsize`` or ``style`` is not of this form, ``ax`` and ``figsize`` are both given, or
            the number of axes differs from the number of panels.
    """
    from matplotlib import rc_context  # pyright: ignore[reportUnknownVariableType]  # its stubs are partial

    columns = [one.panels if isinstance(one, Side) else [one] for one in panels]
    grid = list(zip(*columns, strict=True)) if isinstance(panels[0], Side) else [[*row] for row in columns]
    used, context = find_style(style), cast("Any", rc_context)
    given = _check_canvas(ax, figsize, sum(map(len, grid)))
    with context(used.settings):
        axes = given or _new_axes(grid, figsize, used)
        cells: list[Cell] = [*zip(axes, chain(*grid), strict=True)]
        rows = [cells[k : k + len(grid[0])] for k in range(0, len(cells), len(grid[0]))]
        figure = axes[0].figure
        for axis, panel in cells:
            if given:
                _dress(axis, used)
            _fill(axis, panel, used)
        if not given:
            _trim(rows)
            for flat in (False, True):
                figure.align_ylabels([axis for axis, panel in cells if (panel.inches < _FLAT) == flat])
            figure.get_layout_engine().execute(figure)  # names and keys need the places of the axes
        alone = not given and len(grid[0]) == 1  # then titles begin at the left edge of the figure
        for row in rows:
            for axis, panel in row:
                _name_ends(axis, panel, used)
            _name(row, used, alone)
        if not given:
            figure.get_layout_engine().execute(figure)  # with names and keys
            for axis, panel in cells:
                _fold_labels(axis, panel, used)
            figure.get_layout_engine().execute(figure)
            if figsize is None:
                _make_room(rows, used)
        for axis, panel in cells:
            _note_points(axis, panel, used)
            _separate(axis, used)
    return figure


def _new_axes(grid: Sequence[Sequence[Panel]], figsize: Size | None, style: Style) -> list[Any]:
    """Return the axes of a new figure for rows of panels, row by row."""
    heights = [max(panel.inches_in(style) for panel in row) for row in grid]
    heads = [sum((bool(one.title), bool(one.note), _is_named(one))) for row in grid for one in row[:1]]
    keys = sum(1.4 * style.letters / 72 * min(lines, 2) for lines in heads)
    labels = sum(2.2 * style.letters / 72 for row in grid if any(one.xlabel for one in row))
    wide = len(grid[0])
    size = figsize or (style.width if wide == 1 else style.wide, sum(heights) + keys + labels + 0.2)
    figure: Any = figure_class()(figsize=size, layout="constrained")
    figure.style = style
    own_axis = any(panel.xlabel for row in grid[:-1] for panel in row)
    axes = figure.subplots(
        len(grid), wide, squeeze=False, sharex=False if own_axis else "col", sharey="row" if wide > 1 else False,
        height_ratios=heights,
    )  # fmt: skip
    return list(axes.flat)


def _trim(rows: Sequence[Sequence[Cell]]) -> None:
    """Leave out labels of axes that are shared."""
    for row in rows:
        for place, (axis, panel) in enumerate(row):
            if place:
                axis.set_ylabel("")
                axis.tick_params(labelleft=False)
            if row is not rows[-1] and not panel.xlabel:
                axis.spines["bottom"].set_visible(False)


def _fold_labels(axis: Any, panel: Panel, style: Style) -> None:
    """Write the labels of axes in lines that have room next to the axes."""
    figure, place, letters = axis.figure, axis.get_position(), 0.9 * style.letters
    wide = 72 * figure.get_figwidth() * place.width
    tall = 72 * max(figure.get_figheight() * place.height, panel.inches_in(style))  # which it has in the end
    for label, room in ((axis.xaxis.label, wide), (axis.yaxis.label, tall)):
        label.set_text(in_lines(label.get_text(), letters, room + letters, style))  # set_label would align it anew
        label.set_linespacing(style.spacing)


def _make_room(rows: Sequence[Sequence[Cell]], style: Style) -> None:
    """Make a figure so high that its panels have their heights, whatever titles, keys and labels need."""
    figure = rows[0][0][0].figure
    wanted = sum(max(panel.inches_in(style) for _, panel in row) for row in rows)
    missing = wanted - figure.get_figheight() * sum(row[0][0].get_position().height for row in rows)
    if missing > 0.01:
        figure.set_size_inches(figure.get_figwidth(), figure.get_figheight() + missing)
        figure.get_layout_engine().execute(figure)


def _dress(axis: Any, style: Style) -> None:
    """Give existing axes the style of axes that are made in it."""
    settings = style.settings
    if style.name != "light":
        axis.figure.set_facecolor(style.background)
    axis.set_facecolor(style.background)
    axis.spines[["top", "right"]].set_visible(False)
    axis.spines[["left", "bottom"]].set(color=settings["axes.edgecolor"], linewidth=settings["axes.linewidth"])
    axis.tick_params(
        which="both", length=0, labelsize=settings["xtick.labelsize"], labelcolor=settings["xtick.labelcolor"],
        labelfontfamily=settings["font.family"],
    )  # fmt: skip
    axis.set_axisbelow(True)


def _is_named(panel: Panel) -> bool:
    """Return whether a panel has a key above it."""
    return not panel.ends and any(one.label for one in (*panel.series, *panel.bands))


def _fill(axis: Any, panel: Panel, style: Style) -> None:
    """Draw a panel in its axes."""
    logarithmic = [which for which, wanted in (("x", panel.xlog), ("y", panel.ylog)) if wanted]
    for which in logarithmic:
        getattr(axis, f"set_{which}scale")("log")
    for which, above in (("x", panel.xabove), ("y", panel.yabove)):
        if above is not None:
            _bend(axis, which, above)
    axis.grid(visible=True, color=style.hues["grid"])
    limited = [(which, limits) for which, limits in (("x", panel.xlim), ("y", panel.ylim)) if limits is not None]
    for which, limits in limited:
        if None not in limits:  # other ends follow from the series
            getattr(axis, f"set_{which}lim")(*limits)
    for series in panel.series:
        _plot(axis, series, style, panel.step)
    for which, limits in limited:
        getattr(axis, f"set_{which}lim")(*limits)
    for which in logarithmic:
        _tick_logarithm(axis, which, 4 if which == "y" and panel.inches < _FLAT else 6)
    for which, above in (("x", panel.xabove), ("y", panel.yabove)):
        if above is not None:
            _tick_percent(axis, which, above)
    for band in panel.bands:
        _shade(axis, band, style)
    for level in panel.levels:
        _level(axis, level, style)
    if panel.lanes:
        _lanes(axis, panel, style)
    axis.yaxis.get_offset_text().set_horizontalalignment("right")  # a power of ten, left of the key
    axis.set_xlabel(panel.xlabel)
    axis.set_ylabel(panel.ylabel)
    if panel.inches < _FLAT:
        axis.yaxis.label.set(rotation=0, ha="right", va="center", color=style.hues["ink"])
    if panel.names:
        names = ["\n".join(folded(name, _LONGEST_NAME)) for name in panel.names]
        axis.set_yticks(range(len(names)), names, linespacing=style.spacing)
        axis.set_ylim(-0.5, len(panel.names) - 0.5)
        axis.margins(x=0.04)  # a mark at the end is whole
        axis.grid(visible=False, axis="y")
    for row, note in enumerate(panel.notes):
        _note(axis, row, note, style)
    _note(axis, len(panel.names) - 0.5, panel.noted, style)


def _note(axis: Any, row: float, note: str, style: Style) -> None:
    """Write a note on the right of a row."""
    axis.annotate(
        note, (1.0, row), (5, 0), axis.get_yaxis_transform(), "offset points", va="center",
        color=style.hues["muted"], fontsize=0.85 * style.letters, annotation_clip=False,
    )  # fmt: skip


def _bend(axis: Any, which: str, above: Above) -> None:
    """Give an axis its scale, if it is not linear."""
    import numpy as np

    base, bend = above.base, above.bend
    if bend is None:
        return

    def there(value: Any) -> Any:
        return np.arcsinh((value - base) / bend)

    def back(place: Any) -> Any:
        return base + bend * np.sinh(place)

    getattr(axis, f"set_{which}scale")("function", functions=(there, back))


def _tick_percent(axis: Any, which: str, above: Above) -> None:
    """Write percentages above a number at an axis, where they have room."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator

    ends = [100 * (end / above.base - 1) for end in getattr(axis, f"get_{which}lim")()]
    low, high = sorted(ends)
    if above.bend is None:
        found = [float(one) for one in MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(low, high)]
    else:
        bend = 100 * above.bend / above.base
        far = math.ceil(math.log10(max(abs(low), abs(high))))
        sizes = [lead * 10.0**decade for decade in range(-9, 1 + far) for lead in (1, 2, 5)]
        most = 9 if which == "y" else max(2, int(axis.get_position().width * axis.figure.get_figwidth() / _NUMBER))
        apart, found = (math.asinh(high / bend) - math.asinh(low / bend)) / most, [0.0]
        for size in sorted(sizes):
            for sign in (1, -1):
                if all(abs(math.asinh(sign * size / bend) - math.asinh(one / bend)) > apart for one in found):
                    found.append(sign * size)
    scale = getattr(axis, f"{which}axis")
    kept = sorted(one for one in found if low <= one <= high)
    scale.set_major_locator(FixedLocator([above.base * (1 + one / 100) for one in kept]))

    def percentage(value: float, _: object) -> str:
        value = round(100 * (value / above.base - 1), 9)
        return "0" if value == 0 else f"{'+' if value > 0 else '−'}{abs(value):,g} %"

    scale.set_major_formatter(FuncFormatter(percentage))


def _tick_logarithm(axis: Any, which: str, most: int) -> None:
    """Write plain numbers at a logarithmic axis, at least two and about so many at most."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, StrMethodFormatter

    low, high = getattr(axis, f"get_{which}lim")()
    decades = math.log10(high / low)
    scale = getattr(axis, f"{which}axis")
    scale.set_major_locator(
        LogLocator(subs=(1,) if decades > 2 else (1, 3) if decades > 1 else (1, 2, 5), numticks=most)
    )
    scale.set_major_formatter(FuncFormatter(_power) if decades > 2 and low < _TINY else StrMethodFormatter("{x:g}"))
    scale.set_minor_formatter(NullFormatter())


def _power(value: float, _: object) -> str:
    """Write a power of ten."""
    return f"$10^{{{round(math.log10(value))}}}$"


def _plot(axis: Any, series: Series, style: Style, step: float | None) -> None:
    """Draw one series."""
    look, color = style.look(series.thing), style.color(series.thing, series.signal or 0)
    width = style.line * look.width * (0.6 if series.faint else 1.0)
    plain = look if series.signal is None else style.look(series.signal)
    dash: Any = {"dashed": DASHED, "dotted": DOTTED}.get(series.curve, plain.dash)
    lines: Any = {"color": color, "linewidth": width, "linestyle": (0, dash) if dash else "-", "label": series.label}
    lines |= {"zorder": 1.9} if series.faint else {}
    size = (3.2 * style.line + 1.0) * (0.6 if series.faint else 1.0)
    filled = "o" if look.marker in ("", "|", "x") else look.marker  # those of lanes have no area
    marks: Any = {"marker": filled, "markersize": size, "markeredgewidth": 0.0, "color": color}
    error: Any = None if series.error is None or not any(series.error) else series.error
    bars: Any = {"ecolor": color, "elinewidth": 0.8 * style.line, "capsize": 1.6 * style.line, "capthick": style.line}
    if series.curve == "steps":
        axis.step(series.x, series.y, where="post", **lines)
    elif series.curve == "stems":
        base = axis.get_ylim()[0] if axis.get_yscale() == "log" else 0.0
        thin = min(max(0.6 * _room(axis, series.x, step), 0.5), 0.9 * style.line)
        x, y = _strokes([(one, base, top) for one, top in zip(series.x, series.y, strict=True)])
        axis.plot(x, y, label=series.label, color=color, linewidth=thin)
    elif series.curve == "histogram":
        axis.stairs(series.y, series.x, fill=True, color=color, alpha=0.25, linewidth=0)
        axis.stairs(series.y, series.x, color=color, linewidth=0.8 * style.line, label=series.label)
    elif series.curve in ("bars", "stalks"):
        if series.curve == "stalks":
            axis.hlines(series.y, 0, series.x, color=color, linewidth=width)
        axis.errorbar(series.x, series.y, xerr=error, linestyle="none", label=series.label, **marks, **bars)
    elif series.curve == "ring":
        around = marks | {"markersize": 2 * _RING * size, "markerfacecolor": "none", "markeredgecolor": color}
        axis.plot(series.x, series.y, linestyle="none", **around | {"marker": "o", "markeredgewidth": 0.8 * style.line})
    elif series.curve == "points":
        axis.errorbar(series.x, series.y, yerr=error, linestyle="none", label=series.label, **marks, **bars)
    elif series.error is not None:
        axis.errorbar(series.x, series.y, yerr=error, **(marks | lines), **bars)
    else:
        axis.plot(series.x, series.y, **lines)


def _note_points(axis: Any, panel: Panel, style: Style) -> None:
    """Write the notes of points next to them; those without room are left out."""
    letters, pixels = 0.8 * style.letters, axis.figure.dpi / 72

    def spots(points: Sequence[tuple[float, float]]) -> list[Spot]:
        return [(float(x) / pixels, float(y) / pixels) for x, y in axis.transData.transform(points)]

    lines = [one for one in panel.series if one.curve in ("line", "dashed", "dotted")]
    drawn = [(one, along(spots([*zip(one.x, one.y, strict=True)]), letters / 4)) for one in lines]
    levels = [[(x, level.at) for x in axis.get_xlim()] for level in panel.levels if level.axis == "y"]
    taken = [spot for level in levels for spot in along(spots(level), letters / 4)]
    for text in axis.texts:
        if text.get_text():
            box = text.get_window_extent()
            taken += covered(box.x0 / pixels, box.y0 / pixels, box.width / pixels, box.height / pixels)
    rings = {(x, y) for one in panel.series if one.curve == "ring" for x, y in zip(one.x, one.y, strict=True)}
    frame = axis.get_window_extent()
    inside = frame.x0 / pixels, frame.y0 / pixels, frame.x1 / pixels, frame.y1 / pixels
    for series in (one for one in panel.series if one.notes):
        listed = [*zip(series.x, series.y, strict=True)]
        points, color = spots(listed), style.color(series.thing)
        own = [spot for one, curve in drawn if one is series for spot in curve]
        others = [spot for one, curve in drawn if one is not series for spot in curve]
        for index in sorted(range(len(series.notes)), key=lambda one: listed[one] not in rings):
            at, note = listed[index], series.notes[index]
            size, mark = (text_width(note, letters, style), 0.75 * letters), 1.9 * style.line if at in rings else 0.0
            found = place_beside(points, index, size, inside, (own, others, taken), letters, mark)
            if found is not None:
                left, below, near = found
                taken += covered(left, below, *size)
                moved = left - points[index][0], below - points[index][1]
                line: Any = {"arrowstyle": "-", "color": color, "linewidth": 0.4 * style.line, "shrinkA": 0}
                axis.annotate(
                    note, at, moved, "data", "offset points", ha="left", va="baseline", color=color, fontsize=letters,
                    arrowprops=None if near else line | {"shrinkB": 1.6 * style.line}, path_effects=_halo(style),
                )  # fmt: skip


def _halo(style: Style) -> list[Any]:
    """Return an outline of letters in the colour of the background, which keeps them legible above a region."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=2.0 * style.line, foreground=style.background)]


def _shade(axis: Any, band: Band, style: Style) -> None:
    """Shade a region, without a change of the axes."""
    hue: Hue | None = {"limits": "forbidden", "unreachable": "shade"}.get(str(band.thing))  # pyright: ignore
    color = style.hues[hue] if hue else style.color(band.thing)
    x, y = axis.get_xlim(), axis.get_ylim()
    low, high = (end if one is None else one for one, end in zip((band.low, band.high), sorted(y), strict=True))
    given: Any = {"facecolor": color, "linewidth": 0, "zorder": 0, "label": band.label, "alpha": None if hue else 0.2}
    if band.thing == "unreachable":
        given |= {"hatch": "////", "edgecolor": style.toned("shade", TONES[2])}
    if band.x is None and not isinstance(low, Sequence) and not isinstance(high, Sequence):
        axis.axhspan(low, high, **given)
    else:
        axis.fill_between(x if band.x is None else band.x, low, high, **given)
    axis.set(xlim=x, ylim=y)
    if band.text:
        right = x[1] if band.x is None else band.x[-1]
        axis.annotate(
            band.text, (right, 0.0), (-4, 5), axis.get_xaxis_transform(), "offset points", ha="right", va="bottom",
            color=style.hues["ink"], fontsize=0.85 * style.letters,
            bbox={"facecolor": color, "edgecolor": "none", "pad": 1.5},
        )  # fmt: skip


def _level(axis: Any, level: Level, style: Style) -> None:
    """Draw a line across the axes."""
    look, color = style.look(level.thing), style.color(level.thing)
    given: Any = {"color": color, "linewidth": 0.8 * style.line, "linestyle": (0, look.dash) if look.dash else "-"}
    if level.axis == "y":
        axis.axhline(level.at, **given)
    else:
        axis.axvline(level.at, **given)
        axis.annotate(
            level.label, (level.at, 1.0), (0, 3), axis.get_xaxis_transform(), "offset points", ha="center",
            color=color, fontsize=0.85 * style.letters, annotation_clip=False,
        )  # fmt: skip


def _lanes(axis: Any, panel: Panel, style: Style) -> None:
    """Draw a row for each lane, the first one uppermost."""
    lanes = panel.lanes
    axis.set_ylim(len(lanes) - 0.4, -0.6)
    axis.set_yticks(range(len(lanes)), [lane.name for lane in lanes])
    axis.tick_params(axis="y", labelcolor=style.hues["ink"])
    axis.spines["left"].set_visible(False)
    for row, lane in enumerate(lanes):
        _mark(axis, row, lane, style, panel.step)
        _note(axis, row, lane.note, style)


def _mark(axis: Any, row: int, lane: Lane, style: Style, step: float | None) -> None:
    """Draw the packets of a lane, thinner where they are dense; each kind of marks is one path."""
    each = _room(axis, (*lane.delivered, *lane.dropped, *lane.late), step)
    x, y = _strokes([(time, row - _TICK, row + _TICK) for time in lane.delivered])
    axis.plot(x, y, color=style.color("delivered"), linewidth=min(max(0.4 * each, 0.35), 0.8 * style.line), label="")
    size = min(max(0.9 * each, 2.2), 3.2 * style.line)
    marks: Any = {"linestyle": "none", "markersize": size, "zorder": 3}
    edge = min(0.7 * style.line, 0.3 * size)
    cross = {"marker": "x", "color": style.color("dropped"), "markeredgewidth": edge}
    ring = {"marker": "o", "color": style.color("late"), "markerfacecolor": "none", "markeredgewidth": 0.8 * edge}
    for those, look in ((lane.dropped, cross), (lane.late, ring)):
        if those:
            axis.plot(those, [row] * len(those), **marks, **look)


def _strokes(strokes: Sequence[tuple[float, float, float]]) -> tuple[list[float], list[float]]:
    """Return one path with gaps, of vertical strokes at x from one y to another."""
    x = [value for at, _, _ in strokes for value in (at, at, math.nan)]
    return x, [value for _, low, high in strokes for value in (low, high, math.nan)]


def _room(axis: Any, times: Sequence[float], step: float | None) -> float:
    """Return the distance of steps on the x axis, or of the nearest marks if these are not known, in points."""
    places = sorted(times)
    apart = step or min((after - before for before, after in pairwise(places) if after > before), default=1.0)
    low, high = axis.get_xlim() if step or not places else (places[0], places[-1])
    return 72 * axis.get_position().width * axis.figure.get_figwidth() / (abs(high - low) / apart + 1)


def _name_ends(axis: Any, panel: Panel, style: Style) -> None:
    """Write the names of levels and, if wanted, of series to the right of the axes, without overlaps."""
    right = axis.get_xlim()[1]
    found = [(right, level.at, level.label, style.color(level.thing)) for level in panel.levels if level.axis == "y"]
    found += [(s.x[-1], s.y[-1], s.label, style.color(s.thing)) for s in panel.series if panel.ends and len(s.y)]
    muted = style.hues["muted"]
    found += [(right, _middle(b), b.label, muted) for b in panel.bands if panel.ends and b.x is not None]
    found = [one for one in found if one[2]]
    to, back = axis.transData.transform, axis.transAxes.inverted().transform
    places = [float(back(to((x, y)))[1]) for x, y, _, _ in found]
    shown = [one for one, place in zip(found, places, strict=True) if -0.01 <= place <= 1.01]
    places = [place for place in places if -0.01 <= place <= 1.01]
    inches = axis.get_position().height * axis.figure.get_figheight()
    free = spread(places, 1.2 * style.letters / 72 / inches)
    for (x, y, label, color), place, moved in zip(shown, places, free, strict=True):
        far = x < right or abs(moved - place) > 1e-6
        line: Any = {"arrowstyle": "-", "color": color, "linewidth": 0.4 * style.line, "shrinkA": 1, "shrinkB": 0}
        axis.annotate(
            label, (x, y), (1.0 + 0.1 / axis.figure.get_figwidth() * (2 if far else 1), moved), "data", "axes fraction",
            va="center", annotation_clip=False, color=color, fontsize=0.9 * style.letters,
            arrowprops=line if far else None, linespacing=style.spacing,
        )  # fmt: skip


def _middle(band: Band) -> float:
    """Return the middle of the last end of a region."""
    low, high = (end[-1] if isinstance(end, Sequence) else end or 0.0 for end in (band.low, band.high))
    return (low + high) / 2


def _name(row: Sequence[Cell], style: Style, alone: bool) -> None:
    """Write titles and notes of a row of panels, and one key for all: each next to the other if there is room.

    Each panel has a key of its own if their curves have different colours. In a figure of one column, titles and
    the notes below them begin at the left edge of the figure.
    """
    from matplotlib.transforms import ScaledTranslation, blended_transform_factory

    keys = [_key(axis, panel) for axis, panel in row]
    looks = [{one.label: (one.thing, one.signal) for one in panel.series if one.label} for _, panel in row]
    each = any(found != looks[0].get(label, found) for one in looks[1:] for label, found in one.items())
    if not each:
        together: dict[str, Any] = {}
        for one in keys:
            together = one | together
        keys = [together]
    (first, above), letters = row[0], 0.9 * style.letters
    points, starts = 72 * first.figure.get_figwidth(), [axis.get_position().x0 for axis, _ in row]
    inside, room = points * first.get_position().width, points * (0.99 - starts[0])
    columns = [points * (end - start) - letters for start, end in pairwise((*starts, 0.99))] if each else [room]
    columns = [inside] if above.noted else columns  # the heading of the notes is on the right of the key
    titles = [text_width(panel.title, 1.25 * style.letters, style) for _, panel in row]  # bold
    notes = [text_width(panel.note, letters, style) for _, panel in row]
    sizes = [[text_width(label, letters, style) + 3.8 * letters for label in key] for key in keys]
    lines = max(
        next((n for n in range(1, len(size)) if key_width(size, n) < wide), len(size))
        for size, wide in zip(sizes, columns, strict=True)
    )
    beside = len(row) == lines == 1 and 0 < titles[0] < _BESIDE * inside - sum(sizes[0]) and not above.note
    lines = 0 if beside else lines
    place: Any = {"loc": "lower right" if beside else "lower left", "bbox_to_anchor": (float(beside), 1.0)}
    for (axis, _), key in zip(row, keys, strict=False):
        if key:
            legend = axis.legend(
                list(key.values()), list(key), ncols=-(-len(key) // max(lines, 1)), frameon=False, borderpad=0.0,
                borderaxespad=0.25, handlelength=1.9, handletextpad=0.5, columnspacing=1.4,
                labelcolor=style.hues["ink"], **place,
            )  # fmt: skip
            legend.set_in_layout(False)  # it may be wider than the axes; an empty text has its height
            axis.annotate(" ", (0, 1), (0, (max(lines, 1) - 1) * _LINE * letters + 5), "axes fraction", "offset points")
    broad = inside + (points * starts[0] if alone else 0.0)
    below = any(title and note and title + note > 0.95 * broad for title, note in zip(titles, notes, strict=True))
    above_axes = above.noted or first.yaxis.get_offset_text().get_text()
    pad = 0.5 * style.letters + max(lines, int(bool(above_axes))) * _LINE * letters
    figure = first.figure
    for axis, panel in row:
        color = style.hues["ink"] if panel.thing is None else style.color(panel.thing)
        edge = blended_transform_factory(figure.dpi_scale_trans if alone else axis.transAxes, axis.transAxes)
        start = _EDGE if alone else 0.0
        axis.text(
            start if below else 1.0, 1.0, panel.note, ha="left" if below else "right", va="baseline",
            transform=(edge if below else axis.transAxes) + ScaledTranslation(0.0, pad / 72, figure.dpi_scale_trans),
            color=style.hues["muted"], fontsize=letters,
        )  # fmt: skip
        wide = points - 144 * _EDGE if alone else room / len(row)
        title = in_lines(panel.title, 1.2 * style.letters, wide, style)
        over = pad + _LINE * letters if below else pad
        look: Any = {"color": color, "fontweight": "bold", "linespacing": style.spacing}
        axis.set_title(title, x=start, ha="left", pad=over, **look)
        axis.title.set_transform(edge + ScaledTranslation(0.0, over / 72, figure.dpi_scale_trans))


def _key(axis: Any, panel: Panel) -> dict[str, Any]:
    """Return the entries of the key of a panel, except those that are written at the ends of the curves."""
    handles, labels = axis.get_legend_handles_labels()
    drawn = dict(zip(labels[::-1], handles[::-1], strict=True))
    listed = () if panel.ends else (*panel.series, *panel.bands)
    return {one.label: drawn[one.label] for one in listed if one.label in drawn}


def _separate(axis: Any, style: Style) -> None:
    """Rotate the labels of the x axis if they would overlap."""
    low, high = sorted(axis.get_xlim())
    ticks = [tick for tick in axis.get_xticks() if low <= tick <= high]
    letters, pixels = 0.9 * style.letters, axis.figure.dpi / 72
    texts = axis.xaxis.get_major_formatter().format_ticks(ticks)
    places = [float(axis.transData.transform((tick, axis.get_ylim()[0]))[0]) / pixels for tick in ticks]
    found = [(place, text_width(text, letters, style)) for place, text in zip(places, texts, strict=True)]
    if any(right - left < (one + other) / 2 + 0.6 * letters for (left, one), (right, other) in pairwise(found)):
        axis.tick_params(axis="x", labelrotation=_SLANT)
        for label in axis.get_xticklabels():
            label.set(horizontalalignment="right", rotation_mode="anchor")


def _check_canvas(ax: Any, figsize: Any, panels: int) -> list[Any]:
    """Return the given axes, or an empty list for a new figure."""
    if figsize is not None:
        if ax is not None:
            raise ProblemError(
                "ax and figsize are both given, but figsize is the size of a new figure; expected only one of them: "
                "with ax, set the size of the figure that contains it"
            )
        sizes: list[Any] = list(figsize) if hasattr(figsize, "__iter__") else []
        if len(sizes) != 2 or not all(isinstance(size, int | float) and 0 < size < _LARGEST for size in sizes):
            raise ProblemError(
                f"figsize is {figsize!r}; expected two positive numbers, the width and the height of the figure in "
                f"inches, such as figsize=({STYLES['light'].width:g}, {HEIGHT:g})"
            )
    if ax is None:
        return []
    axes: list[Any] = list(ax) if hasattr(ax, "__iter__") else [ax]
    if not all(hasattr(axis, "set_xlabel") for axis in axes):
        raise ProblemError(
            f"ax is {ax!r}; expected axes of matplotlib, such as those from figure, ax = matplotlib.pyplot.subplots()"
        )
    if len(axes) != panels:
        raise ProblemError(
            f"the number of axes in ax is {len(axes)}; expected {panels}, one for each panel of this figure, as from "
            f"figure, ax = matplotlib.pyplot.subplots({panels})"
        )
    return axes


def blank_sheet(width: float, height: float, ax: Any = None, figsize: Size | None = None) -> tuple[Figure, Any, float]:
    """Create a figure whose coordinates are inches from the lower left corner. Also return the drawing's scale factor.

    The axes have no frame. Without ``ax`` and ``figsize`` they have the given width and height, and the factor is 1. In
    smaller axes a drawing of this size is scaled by the factor, also its letters.
    """
    given = _check_canvas(ax, figsize, 1)
    figure: Any = given[0].figure if given else figure_class()(figsize=figsize or (width, height), layout="none")
    axis: Any = given[0] if given else figure.add_axes((0.0, 0.0, 1.0, 1.0))
    place, size = axis.get_position(), figure.get_size_inches()
    room = float(place.width * size[0]), float(place.height * size[1])
    factor = min(room[0] / width, room[1] / height, 1.0)
    axis.set_axis_off()
    for limits, length, used in ((axis.set_xlim, room[0], width), (axis.set_ylim, room[1], height)):
        margin = (length / factor - used) / 2  # the drawing is in the middle
        limits(-margin, used + margin)
    return figure, axis, factor


def check_format(path: str | Path, formats: Sequence[str] = _FORMATS, what: str = "picture") -> Path:
    """Check that a file can be written, and that its extension is that of a supported format; return its path.

    Raises:
        ProblemError: the ending is not supported, or the folder does not exist or cannot be written to.
    """
    path = Path(path)
    if path.suffix.lower() not in formats:
        raise ProblemError(
            f"the file {str(path)!r} for the {what} {ending_text(path)}; expected a file name with one of the endings "
            f"{', '.join(formats)}"
        )
    if path.is_dir():
        raise ProblemError(f"the path {str(path)!r} for the {what} is a folder; expected the name of a file")
    if not path.parent.is_dir():
        raise ProblemError(
            f"the folder {str(path.parent)!r} does not exist; expected an existing folder in which the {what} can be "
            "saved"
        )
    if not os.access(path.parent, os.W_OK):
        raise ProblemError(f"the folder {str(path.parent)!r} cannot be written to; expected a writable folder")
    return path


def save(figure: Figure, path: str | Path, origin: Mapping[str, object] | None = None) -> None:
    """Write a figure to a file, in the format of the file's extension: SVG, PNG or PDF.

    Args:
        figure: the figure.
        path: path of the file.
        origin: description of the data of the figure, which is stored in the file's metadata; default: none.

    Raises:
        ProblemError: the ending is not supported, or the file cannot be written.
    """
    target = check_format(path)
    drawn: Any = figure
    try:
        form = target.suffix.lower()
        told = {} if origin is None else {"Subject" if form == ".pdf" else "Description": json.dumps(dict(origin))}
        drawn.savefig(target, dpi=150, metadata=told | ({"Date": None} if form == ".svg" else {}))
    except OSError as error:
        raise ProblemError(f"the picture {str(path)!r} cannot be written ({error}); expected a writable file") from None
