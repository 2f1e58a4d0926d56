"""Figures as data: panels that contain series, bands, levels and lanes. Only this module draws with matplotlib.

A figure says *what* is drawn, the style (``_style``) how it looks: each series names the ``thing`` that it shows, which
has one colour and one mark in all figures. ``draw`` makes the figure:

* Panels are below each other; they share the x axis if only the last one has an x label. ``Side`` s of panels are next
  to each other, with equal y axes in each row.
* A key above each panel names its series, so that it never covers a curve; ``ends`` writes the names at the right ends
  of the curves instead. A ``Level`` is a line across the axes with its name at its end, a ``Band`` a shaded region.
* A ``Lane`` is a row of packets: a stroke for a delivered one, a cross for a dropped one, an open circle for a late
  one, with its name on the left, and a note such as the number of packets on the right.
* An axis is logarithmic, or leaves out a ``gap``, if its values are far apart. An axis of costs has percentages above
  that of sending every sample (``Above``), and shows what is far from it nearer, by the inverse hyperbolic sine.
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

from taciturn._style import DASHED, DOTTED, STYLES, Style, StyleName, Thing, figure_class, find_style
from taciturn._text import ending_text, folded
from taciturn.errors import ProblemError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FORMATS = (".svg", ".png", ".pdf")
HEIGHT = 3.4  # of a panel that fills a figure, in inches
_LINE = 1.45  # distance of lines of text, in heights of letters
_LONGEST_NAME = 24  # largest number of letters in a line of a name next to an axis
_SLANT = 30  # degrees by which long labels of the x axis are rotated
_LARGEST = 400.0  # largest width or height in inches; matplotlib cannot draw more than 65,536 pixels
_LANE, _AROUND = 0.24, 0.12  # height of a lane, and of what is above and below all lanes, in inches
_TICK = 0.3  # half of the height of the mark of a packet, in lanes
_FLAT = 0.8  # height of a panel in inches, below which the label of its y axis is horizontal
_GAP = 0.05  # height of a gap in an axis, as a part of the axis
_APART = 4.0  # ratio of the farthest value to the near ones above which an axis bends
_BESIDE = 0.88  # part of the width of the axes that a title and a key beside it fill at most, as names need room too
_NUMBER = 0.75  # width of a percentage at an axis, with a distance, in inches
_ROW = 0.3  # height of a row with a name, in inches
_AROUND_A_POINT = ((-1, -1), (1, 1), (0, -1), (0, 1), (-1, 1), (1, -1))  # places of a note, in the order of preference
Size: TypeAlias = tuple[float, float]
Curve = Literal["line", "dashed", "dotted", "steps", "points", "stems", "bars", "stalks", "histogram"]
_BARS = "bars: ± 1 standard error"


@dataclass(frozen=True)
class Series:
    """Points (x, y) that are drawn as a curve, optionally with error bars of length ±``error``.

    The error bars of the curve ``"bars"`` are in x.

    A ``"histogram"`` has one more x, the edges of its classes. The curve ``"points"`` has marks alone, and ``"stalks"``
    are bars with lines from 0 to their marks.
    """

    x: Sequence[float]
    y: Sequence[float]
    label: str = ""
    curve: Curve = "line"
    error: Sequence[float] | None = None
    thing: Thing | int = 0
    faint: bool = False  # whether it is secondary, such as the estimate of a state
    notes: Sequence[str] = ()  # beside its points, such as the parameter of each; those without room are left out


@dataclass(frozen=True)
class Band:
    """A shaded region between two curves or between two numbers. A bound of None is the end of the axis."""

    low: Sequence[float] | float | None
    high: Sequence[float] | float | None
    x: Sequence[float] | None = None
    label: str = ""
    thing: Thing | int = "unreachable"
    text: str = ""  # within the region, at the lower end of the axis


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


@dataclass(frozen=True)
class Panel:
    """A pair of axes and its contents. The axis y shows ``names`` at 0, 1, …, and omits the interval ``gap``.

    ``notes`` are on the right of the names. ``height`` is in inches of a figure for a screen; a panel with names or
    lanes has the height of its rows.
    """

    series: Sequence[Series] = ()
    xlabel: str = ""
    ylabel: str = ""
    title: str = ""
    names: Sequence[str] = ()
    notes: Sequence[str] = ()
    xlim: tuple[float | None, float | None] | None = None
    ylim: tuple[float | None, float | None] | None = None
    xlog: bool = False
    ylog: bool = False
    xabove: Above | None = None
    yabove: Above | None = None
    gap: tuple[float, float] | None = None
    bands: Sequence[Band] = ()
    levels: Sequence[Level] = ()
    lanes: Sequence[Lane] = ()
    ends: bool = False
    height: float = HEIGHT
    thing: Thing | None = None  # that all of it shows, in whose colour the title is
    step: float | None = None  # distance of the steps on the x axis, which stems and packets leave free
    empty: str = ""  # text in place of what it does not have
    note: str = ""  # above the panel, on the right

    @property
    def inches(self) -> float:
        """Height of the panel, in inches, in a figure for the screen."""
        if self.lanes:
            return _LANE * len(self.lanes) + _AROUND
        return _ROW * len(self.names) + _AROUND if self.names else self.height

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
        figure, axes = (given[0].figure, given) if given else _new_figure(grid, figsize, used)
        for axis, panel in zip(axes, chain(*grid), strict=True):
            if given:
                _dress(axis, used)
            _fill(axis, panel, used)
        if not given:
            _trim(axes, grid)
            for flat in (False, True):
                alike = [one.inches < _FLAT for one in chain(*grid)]
                figure.align_ylabels([axis for axis, one in zip(axes, alike, strict=True) if one == flat])
            figure.get_layout_engine().execute(figure)  # names and keys need the places of the axes
        for index, row in enumerate(grid):
            beside = axes[index * len(row) : (index + 1) * len(row)]
            for axis, panel in zip(beside, row, strict=True):
                _name_ends(axis, panel, used)
            _name(beside, row, used)
        if not given:
            figure.get_layout_engine().execute(figure)  # with names and keys
            for axis, panel in zip(axes, chain(*grid), strict=True):
                _fold_labels(axis, panel, used)
            figure.get_layout_engine().execute(figure)
            if figsize is None:
                _make_room(axes, grid, used)
        for axis, panel in zip(axes, chain(*grid), strict=True):
            _note_points(axis, panel, used)
            _separate(axis, used)
    return figure


def _new_figure(grid: Sequence[Sequence[Panel]], figsize: Size | None, style: Style) -> tuple[Any, list[Any]]:
    """Return a figure with axes for rows of panels, row by row."""
    heights = [max(panel.inches_in(style) for panel in row) for row in grid]
    heads = [sum((bool(one.title), bool(one.note), _is_named(one))) for row in grid for one in row[:1]]
    keys = sum(1.4 * style.letters / 72 * min(lines, 2) for lines in heads)
    labels = sum(2.2 * style.letters / 72 for row in grid if any(one.xlabel for one in row))
    size = figsize or (
        style.width if len(grid[0]) == 1 else style.wide,
        sum(heights) + keys + labels + 0.2,
    )
    figure: Any = figure_class()(figsize=size, layout="constrained")
    figure.style = style
    own_axis = any(panel.xlabel for row in grid[:-1] for panel in row)
    wide = len(grid[0]) > 1
    axes = figure.subplots(
        len(grid), len(grid[0]), squeeze=False, sharex=False if own_axis else "col", sharey="row" if wide else False,
        height_ratios=heights,
    )  # fmt: skip
    return figure, list(axes.flat)


def _fold_labels(axis: Any, panel: Panel, style: Style) -> None:
    """Write the labels of axes in lines that have room next to the axes."""
    figure, place, letters = axis.figure, axis.get_position(), 0.9 * style.letters
    wide = 72 * figure.get_figwidth() * place.width
    tall = 72 * max(figure.get_figheight() * place.height, panel.inches_in(style))  # which it has in the end
    for label, room in ((axis.xaxis.label, wide), (axis.yaxis.label, tall)):
        label.set_text(_folded(label.get_text(), letters, room + 2 * letters, style))  # set_label would align it anew


def _make_room(axes: Sequence[Any], grid: Sequence[Sequence[Panel]], style: Style) -> None:
    """Make a figure so high that its panels have their heights, whatever titles, keys and labels need."""
    figure, wide = axes[0].figure, len(grid[0])
    wanted = sum(max(panel.inches_in(style) for panel in row) for row in grid)
    missing = wanted - figure.get_figheight() * sum(axis.get_position().height for axis in axes[::wide])
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


def _trim(axes: Sequence[Any], grid: Sequence[Sequence[Panel]]) -> None:
    """Leave out labels of axes that are shared."""
    wide = len(grid[0])
    for index, axis in enumerate(axes):
        if index % wide:
            axis.set_ylabel("")
            axis.tick_params(labelleft=False)
        if index + wide < len(axes) and not grid[index // wide][index % wide].xlabel:
            axis.spines["bottom"].set_visible(False)


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
    if panel.gap is not None:
        _leave_out(axis, panel.gap, style)
    if panel.empty:
        axis.grid(visible=False)
        axis.spines["left"].set_visible(False)
        axis.text(
            0.0,
            0.5,
            panel.empty,
            transform=axis.transAxes,
            va="center",
            color=style.hues["muted"],
            fontsize=0.9 * style.letters,
        )
    axis.yaxis.get_offset_text().set_horizontalalignment("right")  # a power of ten, left of the key
    axis.set_xlabel(panel.xlabel)
    axis.set_ylabel(panel.ylabel)
    if panel.inches < _FLAT:
        axis.yaxis.label.set(rotation=0, ha="right", va="center", color=style.hues["ink"])
    if panel.names:
        axis.set_yticks(range(len(panel.names)), ["\n".join(folded(name, _LONGEST_NAME)) for name in panel.names])
        axis.set_ylim(-0.5, len(panel.names) - 0.5)
        axis.margins(x=0.04)  # a mark at the end is whole
        axis.grid(visible=False, axis="y")
    for row, note in enumerate(panel.notes):
        _note(axis, row, note, style)


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
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    low, high = getattr(axis, f"get_{which}lim")()
    decades = math.log10(high / low)
    scale = getattr(axis, f"{which}axis")
    scale.set_major_locator(
        LogLocator(subs=(1,) if decades > 2 else (1, 3) if decades > 1 else (1, 2, 5), numticks=most)
    )
    scale.set_major_formatter(StrMethodFormatter("{x:g}"))
    scale.set_minor_formatter(NullFormatter())


def _plot(axis: Any, series: Series, style: Style, step: float | None) -> None:
    """Draw one series."""
    look, color = style.look(series.thing), style.color(series.thing)
    width = style.line * look.width * (0.6 if series.faint else 1.0)
    dash: Any = {"dashed": DASHED, "dotted": DOTTED}.get(series.curve, look.dash)
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
    elif series.curve == "points":
        axis.errorbar(series.x, series.y, yerr=error, linestyle="none", label=series.label, **marks, **bars)
    elif series.error is not None:
        axis.errorbar(series.x, series.y, yerr=error, **(marks | lines), **bars)
    else:
        axis.plot(series.x, series.y, **lines)


def _note_points(axis: Any, panel: Panel, style: Style) -> None:
    """Write the notes of points where they cover neither a curve nor each other; without room, they are left out."""
    letters, pixels = 0.8 * style.letters, axis.figure.dpi / 72
    drawn = [(*zip(one.x, one.y, strict=True),) for one in panel.series if one.curve in ("line", "dashed", "dotted")]
    drawn += [tuple((x, level.at) for x in axis.get_xlim()) for level in panel.levels if level.axis == "y"]
    taken = [place for points in drawn for place in _along(axis.transData.transform(points) / pixels, letters / 4)]
    written = [text.get_window_extent() for text in axis.texts if text.get_text()]
    taken += [
        (box.x0 / pixels + k * box.width / pixels / 40, box.y0 / pixels + n * box.height / pixels / 2)
        for box in written
        for k in range(41)
        for n in range(3)
    ]
    frame = axis.get_window_extent()
    inside = frame.x0 / pixels, frame.y0 / pixels, frame.x1 / pixels, frame.y1 / pixels
    away = 0.45 * letters
    for series in panel.series:
        for x, y, note in zip(series.x, series.y, series.notes, strict=bool(series.notes)):
            wide, tall = _width(note, letters, style), 0.75 * letters
            middle, level = (float(one) / pixels for one in axis.transData.transform((x, y)))
            for across, up in _AROUND_A_POINT:
                left = middle + across * away - wide * (1 - across) / 2
                below = level + up * away * (1 if across else 1.5) - tall * (1 - up) / 2
                box = left, below, left + wide, below + tall
                kept = inside[0] < box[0] and inside[1] < box[1] and box[2] < inside[2] and box[3] < inside[3]
                if kept and not any(box[0] - 1 < a < box[2] + 1 and box[1] - 1.5 < b < box[3] + 1.5 for a, b in taken):
                    taken += [(box[0] + k * wide / 8, box[1] + n * tall / 2) for k in range(9) for n in range(3)]
                    axis.annotate(
                        note, (x, y), (left - middle, below - level), "data", "offset points", ha="left", va="baseline",
                        color=style.color(series.thing), fontsize=letters,
                    )  # fmt: skip
                    break


def _along(points: Any, apart: float) -> list[tuple[float, float]]:
    """Return places along a curve that are so far apart at most."""
    found: list[tuple[float, float]] = []
    for (a, b), (c, d) in pairwise(points.tolist()):
        steps = 1 + min(int(math.hypot(c - a, d - b) / apart), 2000)
        found += [(a + k * (c - a) / steps, b + k * (d - b) / steps) for k in range(steps + 1)]
    return found


def _shade(axis: Any, band: Band, style: Style) -> None:
    """Shade a region, without a change of the axes."""
    hue = {"limits": "forbidden", "unreachable": "shade"}.get(str(band.thing))
    color = style.hues[cast("Any", hue)] if hue else style.color(band.thing)
    x, y = axis.get_xlim(), axis.get_ylim()
    low, high = (end if one is None else one for one, end in zip((band.low, band.high), sorted(y), strict=True))
    given: Any = {"color": color, "linewidth": 0, "zorder": 0, "label": band.label, "alpha": None if hue else 0.2}
    if band.x is None and not isinstance(low, Sequence) and not isinstance(high, Sequence):
        axis.axhspan(low, high, **given)
    else:
        axis.fill_between(x if band.x is None else band.x, low, high, **given)
    axis.set(xlim=x, ylim=y)
    if band.text:
        axis.annotate(
            band.text, (1.0, 0.0), (-4, 4), "axes fraction", "offset points", ha="right", va="bottom",
            color=style.hues["muted"], fontsize=0.85 * style.letters,
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


def _leave_out(axis: Any, gap: tuple[float, float], style: Style) -> None:
    """Compress a part of the y axis, and mark it as a gap."""
    import numpy as np
    from matplotlib.ticker import FixedLocator, MaxNLocator

    (low, high), (begin, end) = axis.get_ylim(), gap
    far = 10 * (high - low)
    kept = high - low - (end - begin)
    top = begin + _GAP / (1 - _GAP) * kept  # place of the end of the gap
    values, places = (begin - far, begin, end, end + far), (begin - far, begin, top, top + far)

    interpolate: Any = np.interp

    def forward(value: Any) -> Any:
        return interpolate(value, values, places)

    def backward(place: Any) -> Any:
        return interpolate(place, places, values)

    ticks = [*MaxNLocator(4).tick_values(low, begin), *MaxNLocator(3).tick_values(end, high)]
    axis.set_yscale("function", functions=(forward, backward))
    axis.set_ylim(low, high)
    axis.yaxis.set_major_locator(FixedLocator([one for one in ticks if low <= one <= begin or end <= one <= high]))
    axis.axhspan(begin, end, color=style.background, linewidth=0, zorder=4)
    for edge in gap:  # the two strokes of a broken axis
        axis.plot(
            [0], [edge], marker=[(-1, -0.5), (1, 0.5)], markersize=6, color=style.hues["muted"], linestyle="none",
            transform=axis.get_yaxis_transform(), clip_on=False, zorder=5, markeredgewidth=0.6 * style.line,
        )  # fmt: skip


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
    free = _spread(places, 1.2 * style.letters / 72 / inches)
    for (x, y, label, color), place, moved in zip(shown, places, free, strict=True):
        far = x < right or abs(moved - place) > 1e-6
        line: Any = {"arrowstyle": "-", "color": color, "linewidth": 0.4 * style.line, "shrinkA": 1, "shrinkB": 0}
        axis.annotate(
            label, (x, y), (1.0 + 0.1 / axis.figure.get_figwidth() * (2 if far else 1), moved), "data", "axes fraction",
            va="center", annotation_clip=False, color=color, fontsize=0.9 * style.letters,
            arrowprops=line if far else None,
        )  # fmt: skip


def _middle(band: Band) -> float:
    """Return the middle of the last end of a region."""
    low, high = (end[-1] if isinstance(end, Sequence) else end or 0.0 for end in (band.low, band.high))
    return (low + high) / 2


def _spread(places: Sequence[float], apart: float) -> list[float]:
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


def _name(axes: Sequence[Any], row: Sequence[Panel], style: Style) -> None:
    """Write titles and notes of a row of panels, and one key for all: each next to the other if there is room."""
    named: dict[str, Any] = {}
    for axis, panel in zip(axes, row, strict=True):
        ends = {one.label for one in (*panel.series, *panel.bands)} if panel.ends else set[str]()
        handles, labels = axis.get_legend_handles_labels()
        drawn = {label: one for one, label in zip(handles, labels, strict=True)}
        order = [one.label for one in (*panel.series, *panel.bands)]
        named = {label: drawn[label] for label in order if label in drawn and label not in ends} | named
    first, letters = axes[0], 0.9 * style.letters
    points = 72 * first.figure.get_figwidth()
    inside = points * first.get_position().width
    titles = [_width(panel.title, 1.25 * style.letters, style) for panel in row]  # bold
    notes = [_width(panel.note, letters, style) for panel in row]
    key = [_width(label, letters, style) + 3.8 * letters for label in named]
    room = points * (0.99 - first.get_position().x0)
    lines = next((n for n in range(1, len(key)) if _key_width(key, n) < room), len(key))
    beside = len(row) == lines == 1 and 0 < titles[0] < _BESIDE * inside - sum(key) and not row[0].note
    lines = 0 if beside else lines
    if named:
        place: Any = {"loc": "lower right" if beside else "lower left", "bbox_to_anchor": (float(beside), 1.0)}
        legend = first.legend(
            list(named.values()), list(named), ncols=-(-len(named) // max(lines, 1)), frameon=False, borderpad=0.0,
            borderaxespad=0.25, handlelength=1.9, handletextpad=0.5, columnspacing=1.4,
            labelcolor=style.hues["ink"], **place,
        )  # fmt: skip
        legend.set_in_layout(False)  # it may be wider than the axes; an empty text has its height
        first.annotate(" ", (0, 1), (0, (max(lines, 1) - 1) * _LINE * letters + 5), "axes fraction", "offset points")
    below = any(title and note and title + note > 0.95 * inside for title, note in zip(titles, notes, strict=True))
    pad = 0.5 * style.letters + lines * _LINE * letters
    for axis, panel in zip(axes, row, strict=True):
        color = style.hues["ink"] if panel.thing is None else style.color(panel.thing)
        at: Any = {"ha": "left" if below else "right", "va": "baseline", "annotation_clip": False}
        axis.annotate(
            panel.note, (0.0 if below else 1.0, 1.0), (0, pad), "axes fraction", "offset points",
            color=style.hues["muted"], fontsize=letters, **at,
        )  # fmt: skip
        above = _LINE * letters if below else 0.0
        title = _folded(panel.title, 1.2 * style.letters, room / len(row), style)
        axis.set_title(title, x=0.0, ha="left", pad=pad + above, color=color, fontweight="bold")


def _folded(text: str, letters: float, room: float, style: Style) -> str:
    """Return a text in lines that have room."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and _width(longer, letters, style) > room:
            lines.append(word)
        else:
            lines[-1] = longer
    return "\n".join(lines)


def _key_width(widths: Sequence[float], lines: int) -> float:
    """Return the width of a key with a number of lines, whose entries fill the columns in turn."""
    columns = -(-len(widths) // lines)
    short, long = divmod(len(widths), max(columns, 1))  # the first columns have one more entry
    sizes = [short + (index < long) for index in range(columns)]
    ends = [sum(sizes[: index + 1]) for index in range(columns)]
    return sum(max(widths[end - size : end]) for size, end in zip(sizes, ends, strict=True))


def _width(text: str, letters: float, style: Style) -> float:
    """Return the width of a line of text, in points."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextToPath

    measure: Any = TextToPath()
    font = FontProperties(family=style.settings["font.family"], size=letters)
    return float(measure.get_text_width_height_descent(text, font, "$" in text)[0]) if text else 0.0


def _separate(axis: Any, style: Style) -> None:
    """Rotate the labels of the x axis if they would overlap."""
    low, high = sorted(axis.get_xlim())
    ticks = [tick for tick in axis.get_xticks() if low <= tick <= high]
    letters, pixels = 0.9 * style.letters, axis.figure.dpi / 72
    texts = axis.xaxis.get_major_formatter().format_ticks(ticks)
    places = [float(axis.transData.transform((tick, axis.get_ylim()[0]))[0]) / pixels for tick in ticks]
    found = [(place, _width(text, letters, style)) for place, text in zip(places, texts, strict=True)]
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
    figure: Any = given[0].figure if given else figure_class()(figsize=figsize or (width, height))
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
