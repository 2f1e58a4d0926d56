"""Figures as data: lanes of packets, keys and names that cover nothing, gaps, columns, widths for journals."""

from __future__ import annotations

import warnings
from itertools import pairwise
from typing import Any

import matplotlib
import numpy as np
import pytest
from counts import few
from matplotlib.figure import Figure
from matplotlib.text import Text

import taciturn
from taciturn._figure import Band, Lane, Level, Panel, Series, Side, blank_sheet, draw
from taciturn._style import STYLES, StyleName
from taciturn.errors import ProblemError

LINE = Series([0.0, 1.0, 2.0], [0.0, 2.0, 1.0], "a curve", thing="policy")


def drawn(*given: Any, style: StyleName = "light") -> Any:
    """Return a figure whose texts have their places."""
    figure: Any = draw(*given, style=style)
    figure.draw_without_rendering()
    return figure


def test_every_packet_has_one_mark_in_its_lane() -> None:
    """A tick for a delivered one, a cross for a dropped one, an open circle for a late one; and the name and a note."""
    lanes = [Lane("up", [1.0, 2.0, 5.0], [3.0], [4.0], "5 of 9"), Lane("down", [7.0])]
    (axis,) = drawn([Panel(lanes=lanes, xlabel="step")]).axes
    assert [label.get_text() for label in axis.get_yticklabels()] == ["up", "down"]
    ticks = [np.array(line.get_xydata()) for line in axis.get_lines() if line.get_marker() == "None"]
    starts = [{(x, round(float(y))) for x, y in one if not np.isnan(x)} for one in ticks]
    assert starts == [{(1.0, 0), (2.0, 0), (5.0, 0)}, {(7.0, 1)}]
    marks = {line.get_marker(): line.get_xydata().tolist() for line in axis.get_lines() if line.get_marker() != "None"}
    assert marks == {"x": [[3.0, 0.0]], "o": [[4.0, 0.0]]}
    assert "5 of 9" in [text.get_text() for text in axis.texts]


@pytest.mark.parametrize("style", few(STYLES, 1))
def test_a_key_is_above_its_panel_and_within_the_figure(style: StyleName) -> None:
    """However many entries it has, on as many lines as they need; panels below each other keep their distance."""
    many = [Series(LINE.x, LINE.y, f"series number {i}", thing=i) for i in range(8)]
    figure = drawn(
        [Panel(many, title="a title"), Panel([LINE], "x", bands=[Band(1.5, None, label="a region")])], style=style
    )
    for axis in figure.axes:
        key = axis.get_legend().get_window_extent()
        assert key.y0 >= axis.get_window_extent().y1
        assert key.x1 <= figure.bbox.x1
        assert key.y1 <= figure.bbox.y1
    assert figure.axes[1].get_legend().get_window_extent().y1 < figure.axes[0].get_window_extent().y0
    title = figure.axes[0].title.get_window_extent()
    assert title.y0 >= figure.axes[0].get_legend().get_window_extent().y1 - 1


@pytest.mark.parametrize("style", few(STYLES, 1, 1))
def test_the_name_of_a_flat_panel_is_left_of_its_numbers(style: StyleName) -> None:
    """Upright, and for each of several panels whose numbers have different widths."""
    flat = [Panel([Series(LINE.x, [0.0, size, -size])], ylabel="level-1", height=0.55) for size in (0.5, 1000.0)]
    for axis in drawn(flat, style=style).axes:
        name, low = axis.yaxis.label.get_window_extent(), axis.get_window_extent()
        numbers = [label.get_window_extent() for label in axis.get_yticklabels()]
        shown = [box for box in numbers if low.y0 <= (box.y0 + box.y1) / 2 <= low.y1]
        assert shown
        assert name.x1 <= min(box.x0 for box in shown)


@pytest.mark.evidence
def test_names_at_the_ends_of_curves_do_not_overlap() -> None:
    """Curves and a level that end at nearly one place: their names are to the right of the axes, in the same order."""
    ends = [0.0, 0.01, 0.02, 3.0]
    series = [Series([0.0, 1.0], [2.0, end], f"curve {end}", thing=i) for i, end in enumerate(ends)]
    (axis,) = drawn([Panel(series, levels=[Level(0.015, "level")], ends=True)]).axes
    boxes = {text.get_text(): Text.get_window_extent(text) for text in axis.texts}
    order = ["curve 0.0", "curve 0.01", "level", "curve 0.02", "curve 3.0"]
    assert all(boxes[below].y1 <= boxes[above].y0 + 1 for below, above in pairwise(order))
    assert all(boxes[name].x0 > axis.get_window_extent().x1 for name in order)
    assert axis.get_legend() is None


@pytest.mark.evidence
def test_a_logarithmic_axis_has_at_least_two_plain_numbers() -> None:
    """Whether it covers less than a decade or many."""
    for high in (3.0, 30.0, 3e5):
        (axis,) = drawn([Panel([Series([0.0, 1.0], [1.1, high], "curve")], ylog=True)]).axes
        low, most = axis.get_ylim()
        shown = [label.get_text() for label in axis.get_yticklabels() if low <= label.get_position()[1] <= most]
        assert len(shown) >= 2
        assert not [text for text in shown if "$" in text]


def test_an_end_of_an_axis_that_is_not_given_follows_from_the_series() -> None:
    """Also beyond 1, the end of empty axes."""
    (axis,) = drawn([Panel([Series([0.0, 4.0], [0.0, 9.0])], xlim=(0.0, None), ylim=(-1.0, None))]).axes
    assert axis.get_xlim()[0] == 0.0
    assert 4.0 < axis.get_xlim()[1] < 5.0
    assert axis.get_ylim()[0] == -1.0
    assert 9.0 < axis.get_ylim()[1] < 10.0


@pytest.mark.evidence
def test_columns_share_axes_and_one_key() -> None:
    """Each row has equal y axes, each column equal x axes; the names are those of both, once."""
    other = Series([0.0, 4.0], [0.0, 9.0], "another curve", thing="periodic control")
    figure = drawn([Side([Panel([LINE]), Panel([LINE], "time")]), Side([Panel([LINE, other]), Panel([LINE], "time")])])
    first, second, third, fourth = figure.axes
    assert first.get_ylim() == second.get_ylim() != third.get_ylim()
    assert first.get_xlim() == third.get_xlim() != second.get_xlim() == fourth.get_xlim()
    assert [text.get_text() for text in first.get_legend().get_texts()] == ["a curve", "another curve"]
    assert second.get_legend() is None


def test_notes_of_points_are_nearer_to_their_own_point_than_to_others() -> None:
    """Each of many points close to another curve and to a level has its note, in no other curve's way."""
    x = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    curve = Series(x, [8.0, 4.0, 2.0, 1.0, 0.5, 0.25, 0.2], "a", thing="policy", notes=[f"n{k}" for k in range(7)])
    near = Series(x, [12.0, 7.0, 4.0, 2.5, 1.6, 1.0, 0.6], "b", thing="guarantee")
    panel = Panel([curve, near, Series([2.0], [2.0], "", "ring")], ylim=(-2.0, 13.0), levels=[Level(0.0)])
    (axis,) = drawn([panel]).axes
    places = axis.transData.transform([*zip(curve.x, curve.y, strict=True)])
    for k in range(7):
        (box,) = [Text.get_window_extent(text) for text in axis.texts if text.get_text() == f"n{k}"]
        middle = np.array([(box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2])
        assert np.argmin(np.linalg.norm(places - middle, axis=1)) == k


@pytest.mark.parametrize("style", few(STYLES, 1, 2))
def test_the_note_of_a_point_with_a_ring_is_written_among_many_curves(style: StyleName) -> None:
    """Where no place is free, across them; the notes of other points are left out there."""
    x = [0.02 * k for k in range(51)]
    curve = Series([0.4, 0.5, 0.6], [0.5] * 3, "a", thing="policy", notes=["θ = 0.1", "θ = 0.208", "θ = 0.3"])
    many = [Series(x, [0.05 * k] * 51, thing=k) for k in range(21)]
    (axis,) = drawn([Panel([curve, *many, Series([0.5], [0.5], "", "ring")], height=1.5)], style=style).axes
    assert [text.get_text() for text in axis.texts if "θ" in text.get_text()] == ["θ = 0.208"]


def test_a_title_has_the_width_of_its_figure() -> None:
    """It begins at the left edge, and its lines have nearly equal lengths; a percent sign stays with its number."""
    title = "26.7 % of the packets, 1.00 % more cost than every sample, at most 3.81 % proven, and more than that"
    figure = drawn([Panel([LINE], "x", "y", title)])
    (axis,) = figure.axes
    box, lines = axis.title.get_window_extent(), axis.get_title().split("\n")
    assert 0 < box.x0 < 0.1 * figure.dpi
    assert box.x1 <= figure.bbox.x1
    assert len(lines) == 2
    assert abs(len(lines[0]) - len(lines[1])) < 20
    assert not lines[1].startswith("%")


@pytest.mark.parametrize(("style", "width"), [("paper", 3.5), ("paper-wide", 7.16)])
def test_a_figure_for_a_journal_has_its_width_and_a_serif_font(style: StyleName, width: float) -> None:
    """Letters of 8 points, also in the labels that are made only when the figure is drawn."""
    figure = drawn([Panel([LINE], "time (s)", "level (cm)")], style=style)
    assert figure.get_figwidth() == width
    (axis,) = figure.axes
    assert {label.get_fontfamily()[0] for label in (*axis.get_xticklabels(), axis.xaxis.label)} == {"STIXGeneral"}
    assert axis.xaxis.label.get_fontsize() == pytest.approx(7.2)
    assert STYLES[style].letters == 8


def test_existing_axes_get_the_style_and_keep_their_figure() -> None:
    """Of matplotlib's own settings nothing changes."""
    before = dict(matplotlib.rcParams)
    figure = Figure()
    axis: Any = figure.subplots()
    assert draw([Panel([LINE])], axis, style="dark") is figure
    assert axis.get_facecolor() == matplotlib.colors.to_rgba(STYLES["dark"].background)
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize("name", STYLES)
def test_figures_of_users_have_the_colours_and_letters_of_a_style(name: StyleName) -> None:
    """Lines in turn, the background, and the size of the letters; matplotlib's own settings stay as they are."""
    style, before = STYLES[name], matplotlib.rcParams["font.size"]
    with matplotlib.rc_context(taciturn.style(name)):
        axes = Figure().subplots()
        lines = [axes.plot([0, 1])[0] for _ in range(3)]
        assert [line.get_color() for line in lines] == [style.color(number) for number in range(3)]
        assert axes.get_facecolor() == matplotlib.colors.to_rgba(style.background)
        assert axes.set_xlabel("x").get_size() == pytest.approx(0.9 * style.letters)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert blank_sheet(1.0, 1.0)[0]._repr_png_()  # a diagram, which has no axes to arrange
    assert matplotlib.rcParams["font.size"] == before


def test_a_style_that_does_not_exist_is_refused() -> None:
    """With the names of those that exist."""
    with pytest.raises(ProblemError, match="style is 'prety'; expected 'light' or 'dark'"):
        taciturn.style("prety")  # type: ignore[arg-type]
