"""Figures, and the only interface to matplotlib; a figure consists of panels, and a panel of series."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from taciturn._text import ending_text, folded
from taciturn.errors import ProblemError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FORMATS = (".svg", ".png", ".pdf")
_COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#8A6D00", "#555555")
"""Palette of Okabe and Ito for colour-blind readers; the yellow is darker here, since it is pale on white."""
_MARKERS = "os^DvPX*"
_EMBEDDED = {"svg.hashsalt": "taciturn", "pdf.fonttype": 42, "ps.fonttype": 42}
"""Settings for reproducible files with embedded TrueType fonts, which publishers require."""
_WIDTH, HEIGHT = 7.0, 4.2  # inches
_LETTER = 0.08  # width of a letter of a label, in inches
_LONGEST_NAME = 24  # largest number of letters in a line of a name next to an axis
_SLANT = 30  # degrees by which long labels of the x axis are rotated
_LARGEST = 400.0  # largest width or height in inches; matplotlib cannot draw more than 65,536 pixels
Size: TypeAlias = tuple[float, float]
_BARS = "bars: ± 1 standard error"
Style = Literal["line", "dashed", "dotted", "steps", "stems", "stars", "bars", "below"]


@dataclass(frozen=True)
class Series:
    """One curve of points (x, y) in a style, with optional error bars of ±``error`` (in x for the style ``"bars"``)."""

    x: Sequence[float]
    y: Sequence[float]
    label: str = ""
    style: Style = "line"
    error: Sequence[float] | None = None
    color: int | None = None


@dataclass(frozen=True)
class Panel:
    """One pair of axes with its series; ``names`` are the labels at y = 0, 1, …

    A legend ``beside`` the axes never covers a curve that fills them.
    """

    series: Sequence[Series]
    xlabel: str = ""
    ylabel: str = ""
    title: str = ""
    names: Sequence[str] = ()
    ylim: tuple[float, float] | None = None
    beside: bool = False


def draw(panels: Sequence[Panel], ax: Any = None, figsize: Size | None = None, height: float = HEIGHT) -> Figure:
    """Draw panels one below the other; they share the x axis if only the last panel has an x label.

    Args:
        panels: the panels.
        ax: matplotlib axes to draw in instead of a new figure: one, or a sequence with one for each panel.
        figsize: width and height of a new figure, in inches.
        height: height of a new figure in inches, if no ``figsize`` is given.

    Raises:
        ProblemError: ``ax`` or ``figsize`` is not of this form, both are given, or the number of axes differs from the
            number of panels.
    """
    given = _check_canvas(ax, figsize, len(panels))
    if not given:
        figure: Any = _figure_class()(figsize=figsize or (_WIDTH, height), layout="constrained")
        shared = not any(panel.xlabel for panel in panels[:-1])
        axes: Any = list(figure.subplots(len(panels), 1, squeeze=False, sharex=shared)[:, 0])
    else:
        axes, figure = given, given[0].figure
    for axis, panel in zip(axes, panels, strict=True):
        axis.set_prop_cycle(color=_COLORS)
        for series in panel.series:
            _plot(axis, series)
        if panel.ylim is not None:
            axis.set_ylim(*panel.ylim)
        axis.set_xlabel(panel.xlabel)
        axis.set_ylabel(panel.ylabel)
        axis.set_title(panel.title, fontsize="medium")
        axis.grid(True, alpha=0.3)
        if panel.names:
            axis.set_yticks(range(len(panel.names)), ["\n".join(folded(name, _LONGEST_NAME)) for name in panel.names])
        if any(series.label for series in panel.series):
            bars = any(series.error is not None and any(series.error) for series in panel.series)
            place: Any = (
                {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "borderaxespad": 0.0} if panel.beside else {}
            )
            title = _BARS if bars else None
            axis.legend(fontsize="small", framealpha=0.8, title=title, title_fontsize="x-small", **place)
        _separate(axis, panel)
    return figure


def _separate(axis: Any, panel: Panel) -> None:
    """Rotate the labels of the x axis if they would overlap."""
    low, high = sorted(axis.get_xlim())
    ticks = [tick for tick in axis.get_xticks() if low <= tick <= high]
    longest = max(map(len, axis.xaxis.get_major_formatter().format_ticks(ticks)), default=0)
    beside = max((len(line) for name in panel.names for line in folded(name, _LONGEST_NAME)), default=0)
    room = axis.get_position().width * axis.figure.get_figwidth() - _LETTER * beside
    if _LETTER * (longest + 1) * len(ticks) > room:
        axis.tick_params(axis="x", labelrotation=_SLANT)
        for label in axis.get_xticklabels():
            label.set(horizontalalignment="right", rotation_mode="anchor")


def _check_canvas(ax: Any, figsize: Any, panels: int) -> list[Any]:
    """Return the given axes, or an empty list for a new figure."""
    if figsize is not None:
        if ax is not None:
            raise ProblemError(
                "ax and figsize are both given, but figsize is the size of a new figure; expected one of them: set the "
                "size of the figure that contains ax"
            )
        sizes: list[Any] = list(figsize) if hasattr(figsize, "__iter__") else []
        if len(sizes) != 2 or not all(isinstance(size, int | float) and 0 < size < _LARGEST for size in sizes):
            raise ProblemError(
                f"figsize is {figsize!r}; expected two positive numbers, the width and the height of the figure in "
                f"inches, such as figsize=({_WIDTH:g}, {HEIGHT:g})"
            )
    if ax is None:
        return []
    axes: list[Any] = list(ax) if hasattr(ax, "__iter__") else [ax]
    if not all(hasattr(axis, "set_xlabel") for axis in axes):
        raise ProblemError(f"ax is {ax!r}; expected axes of matplotlib: figure, ax = matplotlib.pyplot.subplots()")
    if len(axes) != panels:
        raise ProblemError(
            f"ax has {len(axes)} axes; expected {panels}, one for each panel of this figure: "
            f"figure, ax = matplotlib.pyplot.subplots({panels})"
        )
    return axes


def __getattr__(name: str) -> Any:
    """Return the class of the figures by its name, so that figures can be pickled."""
    if name == "Drawn":
        return _figure_class()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@cache
def _figure_class() -> Any:
    """Return the class of the figures; matplotlib is imported here, because its import is slow."""
    from matplotlib import rc_context  # pyright: ignore[reportUnknownVariableType]  # its stubs are partial
    from matplotlib.figure import Figure

    plain: Any = Figure
    settings: Any = _EMBEDDED
    embedding: Any = rc_context(settings)

    class Drawn(Figure):
        """A figure that notebooks show without pyplot and that embeds its fonts when it is saved."""

        savefig: Any = embedding(plain.savefig)

        def _repr_png_(self) -> bytes:
            written = BytesIO()
            self.savefig(written, format="png", dpi=110)
            return written.getvalue()

    Drawn.__qualname__ = "Drawn"
    return Drawn


@dataclass(frozen=True)
class Arrow:
    """An arrow between two lanes, which are given by their indices, with a label in the middle."""

    start: int
    end: int
    label: str
    dashed: bool = False


def draw_lanes(
    boxes: Sequence[Sequence[str]], arrows: Sequence[Arrow], ax: Any = None, figsize: Size | None = None
) -> Figure:
    """Draw boxes side by side, with a vertical line below each box and arrows between the lines, from top to bottom."""
    given = _check_canvas(ax, figsize, 1)
    apart = max(2.2, 0.6 + 0.085 * max((len(arrow.label) for arrow in arrows), default=0))  # inches
    height = 0.2 * max(map(len, boxes)) + 0.5 * len(arrows) + 0.6
    size = figsize or (apart * (len(boxes) - 1) + 2.4, height)
    figure: Any = given[0].figure if given else _figure_class()(figsize=size, layout="constrained")
    axis: Any = given[0] if given else figure.subplots()
    axis.set_axis_off()
    axis.set_xlim(-1.2, apart * (len(boxes) - 1) + 1.2)
    axis.set_ylim(-0.5 * len(arrows) - 0.4, height - 0.5 * len(arrows) - 0.4)
    for i, lines in enumerate(boxes):
        axis.plot([apart * i] * 2, [-0.5 * len(arrows) - 0.3, 0.1], color="0.6", linewidth=1.0, zorder=0)
        framed = {"boxstyle": "round,pad=0.4", "facecolor": "white", "edgecolor": "0.3"}
        axis.text(apart * i, 0.1, "\n".join(lines), ha="center", va="bottom", fontsize="small", bbox=framed)
    for k, arrow in enumerate(arrows):
        y, start, end = -0.5 * (k + 1), apart * arrow.start, apart * arrow.end
        look = {"arrowstyle": "-|>", "linestyle": "--" if arrow.dashed else "-", "color": _COLORS[0]}
        axis.annotate("", xy=(end, y), xytext=(start, y), arrowprops=look)
        axis.text((start + end) / 2, y + 0.06, arrow.label, ha="center", va="bottom", fontsize="small")
    return figure


def check_format(path: str | Path, formats: Sequence[str] = _FORMATS, what: str = "picture") -> Path:
    """Return the path if its ending is a supported format and the file can be written.

    Raises:
        ProblemError: the ending is not supported, or the folder does not exist or cannot be written to.
    """
    path = Path(path)
    if path.suffix.lower() not in formats:
        raise ProblemError(f"the {what} {str(path)!r} {ending_text(path)}; expected one of {', '.join(formats)}")
    if path.is_dir():
        raise ProblemError(f"the {what} {str(path)!r} is a folder; expected the name of a file")
    if not path.parent.is_dir():
        raise ProblemError(f"the folder {str(path.parent)!r} does not exist; expected a folder to write the {what} to")
    if not os.access(path.parent, os.W_OK):
        raise ProblemError(f"the folder {str(path.parent)!r} cannot be written to; expected a writable folder")
    return path


def save(figure: Figure, path: str | Path, origin: Mapping[str, object] | None = None) -> None:
    """Write a figure as SVG, PNG or PDF, according to the ending of the name.

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


def _plot(axis: Any, series: Series) -> None:
    color = None if series.color is None else _COLORS[series.color % len(_COLORS)]
    marker = _MARKERS[(series.color or 0) % len(_MARKERS)]
    lines = {"line": "-", "dashed": "--", "dotted": ":"}
    if series.style == "steps":
        axis.step(series.x, series.y, where="post", label=series.label, color=color)
    elif series.style == "stems":
        axis.vlines(series.x, 0, series.y, label=series.label, color=color or "0.4", linewidth=0.8)
    elif series.style == "stars":
        axis.plot(series.x, series.y, "*", markersize=9, label=series.label, color=color)
    elif series.style == "below":
        low = axis.get_ylim()[0]
        axis.fill_between(series.x, series.y, low, label=series.label, color=color or "0.85", zorder=0)
        axis.set_ylim(bottom=low)
    elif series.style == "bars":
        axis.errorbar(series.x, series.y, xerr=series.error, fmt=marker, markersize=4, label=series.label, color=color)
    elif series.error is not None:
        axis.errorbar(
            series.x,
            series.y,
            yerr=series.error,
            fmt=marker + "-",
            markersize=4,
            capsize=2,
            label=series.label,
            color=color,
        )
    else:
        axis.plot(series.x, series.y, lines[series.style], markersize=4, label=series.label, color=color)
