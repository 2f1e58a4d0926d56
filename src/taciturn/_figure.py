"""Pictures: the one door to matplotlib. A picture is panels of series; the file name's ending picks the format."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from taciturn.errors import ProblemError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".svg", ".png", ".pdf")
Style = Literal["line", "dashed", "dotted", "steps", "stems", "stars", "bars", "below"]


@dataclass(frozen=True)
class Series:
    """One curve: points (x, y), drawn in a style, with an error bar of ±``error`` where given: of x in ``"bars"``."""

    x: Sequence[float]
    y: Sequence[float]
    label: str = ""
    style: Style = "line"
    error: Sequence[float] | None = None
    color: int | None = None


@dataclass(frozen=True)
class Panel:
    """One pair of axes; with ``names``, those of y = 0, 1, …"""

    series: Sequence[Series]
    xlabel: str = ""
    ylabel: str = ""
    title: str = ""
    names: Sequence[str] = ()


def draw(panels: Sequence[Panel], width: float = 7.0, height: float = 4.2) -> Figure:
    """Return a figure of panels under one another, over one axis unless more than the last name their own."""
    from matplotlib.figure import Figure  # imported late: it takes longer than most evaluations

    figure: Any = Figure(figsize=(width, height), layout="constrained")
    shared = not any(panel.xlabel for panel in panels[:-1])
    axes: Any = figure.subplots(len(panels), 1, squeeze=False, sharex=shared)
    for axis, panel in zip(axes[:, 0], panels, strict=True):
        for series in panel.series:
            _plot(axis, series)
        axis.set_xlabel(panel.xlabel)
        axis.set_ylabel(panel.ylabel)
        axis.set_title(panel.title, fontsize="medium")
        axis.grid(True, alpha=0.3)
        if panel.names:
            axis.set_yticks(range(len(panel.names)), panel.names)
        if any(series.label for series in panel.series):
            axis.legend(fontsize="small", framealpha=0.8)
    figure._repr_png_ = partial(_png, figure)  # what a notebook shows; it knows figures of pyplot only
    return figure


@dataclass(frozen=True)
class Arrow:
    """From one lane to another, by index, with a label in its middle."""

    start: int
    end: int
    label: str
    dashed: bool = False


def draw_lanes(boxes: Sequence[Sequence[str]], arrows: Sequence[Arrow]) -> Figure:
    """Return a figure of boxes side by side, a line under each, and arrows from line to line, one under the other."""
    from matplotlib.figure import Figure

    apart = max(2.2, 0.6 + 0.085 * max((len(arrow.label) for arrow in arrows), default=0))  # inches
    height = 0.2 * max(map(len, boxes)) + 0.5 * len(arrows) + 0.6
    figure: Any = Figure(figsize=(apart * (len(boxes) - 1) + 2.4, height), layout="constrained")
    axis: Any = figure.subplots()
    axis.set_axis_off()
    axis.set_xlim(-1.2, apart * (len(boxes) - 1) + 1.2)
    axis.set_ylim(-0.5 * len(arrows) - 0.4, height - 0.5 * len(arrows) - 0.4)
    for i, lines in enumerate(boxes):
        axis.plot([apart * i] * 2, [-0.5 * len(arrows) - 0.3, 0.1], color="0.6", linewidth=1.0, zorder=0)
        framed = {"boxstyle": "round,pad=0.4", "facecolor": "white", "edgecolor": "0.3"}
        axis.text(apart * i, 0.1, "\n".join(lines), ha="center", va="bottom", fontsize="small", bbox=framed)
    for k, arrow in enumerate(arrows):
        y, start, end = -0.5 * (k + 1), apart * arrow.start, apart * arrow.end
        look = {"arrowstyle": "-|>", "linestyle": "--" if arrow.dashed else "-", "color": "C0"}
        axis.annotate("", xy=(end, y), xytext=(start, y), arrowprops=look)
        axis.text((start + end) / 2, y + 0.06, arrow.label, ha="center", va="bottom", fontsize="small")
    figure._repr_png_ = partial(_png, figure)
    return figure


def check_format(path: str | Path, formats: Sequence[str] = FORMATS, what: str = "picture") -> Path:
    """Return the path if its ending is one of ours.

    Raises:
        ProblemError: another ending, or a folder that does not exist.
    """
    path = Path(path)
    if path.suffix.lower() not in formats:
        raise ProblemError(f"the {what} {str(path)!r} ends in {path.suffix!r}; expected one of {', '.join(formats)}")
    if path.is_dir():
        raise ProblemError(f"the {what} {str(path)!r} is a folder; expected the name of a file")
    if not path.parent.is_dir():
        raise ProblemError(f"the folder {str(path.parent)!r} does not exist; expected a folder to write the {what} to")
    if not os.access(path.parent, os.W_OK):
        raise ProblemError(f"the folder {str(path.parent)!r} cannot be written to; expected one that can")
    return path


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as SVG, PNG or PDF, by the ending of the name.

    Raises:
        ProblemError: another ending, or the file cannot be written.
    """
    target = check_format(path)
    from matplotlib import rc_context  # pyright: ignore[reportUnknownVariableType]  # its stubs are partial

    drawn: Any = figure
    try:
        with rc_context({"svg.hashsalt": "taciturn"}):  # equal pictures are equal files
            drawn.savefig(target, dpi=150, metadata={"Date": None} if target.suffix.lower() == ".svg" else None)
    except OSError as error:
        raise ProblemError(f"the picture {str(path)!r} cannot be written ({error}); expected a file that can") from None


def _png(figure: Any) -> bytes:
    written = BytesIO()
    figure.savefig(written, format="png", dpi=110)
    return written.getvalue()


def _plot(axis: Any, series: Series) -> None:
    color = None if series.color is None else f"C{series.color}"
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
        axis.errorbar(series.x, series.y, xerr=series.error, fmt="o", markersize=4, label=series.label, color=color)
    elif series.error is not None:
        axis.errorbar(
            series.x, series.y, yerr=series.error, fmt="o-", markersize=4, capsize=2, label=series.label, color=color
        )
    else:
        axis.plot(series.x, series.y, lines[series.style], markersize=4, label=series.label, color=color)
