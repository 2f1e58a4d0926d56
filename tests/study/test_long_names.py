"""Comparisons of policies with long names, such as paths: every line fits, and no labels of a figure overlap."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from counts import few

import taciturn
from taciturn import Estimate
from taciturn._figure import Panel, Series, draw
from taciturn._text import PLAIN, folded, table_text, wrapped_text
from taciturn_studies.compare import Comparison, Contestant
from taciturn_studies.compare import _at_rate as at_rate
from taciturn_studies.goal import RateGoal
from taciturn_studies.tune import Parameter, Tuned

PATH = "/home/somebody/experiments/with-event-triggered-control/of-two-masses/theta-0.123456"
PLANT = taciturn.Plant(A=[[1.2]], B=[[1.0]], W=[[0.01]])
COST = taciturn.Cost(Q=[[1.0]], R=[[1.0]])
PROBLEM = taciturn.Problem(PLANT, COST, taciturn.Network(), "excess", {"theta": 0.5, "actuation": "model"})


@cache
def tuned() -> Tuned:
    """Return a policy whose rate jumps across 0.65 sends per step."""
    found = replace(taciturn.evaluate(PROBLEM, steps=2000), notes=(f"a note on {PATH}/{PATH}",))
    low = replace(found, rates={"actuator": Estimate(0.6, 0.003, "simulation")}, cost=Estimate(2.0, 0.0, "exact"))
    high = replace(found, rates={"actuator": Estimate(0.7, 0.001, "simulation")}, cost=Estimate(1.0, 0.0, "exact"))
    first, second = (Parameter("theta", value, None) for value in (0.123456789, 0.123456788))
    beyond = Tuned(RateGoal(0.65, "actuator"), second, PROBLEM, high, None, None)
    return Tuned(beyond.goal, first, PROBLEM, low, beyond, None)


def comparison() -> Comparison:
    """Return a comparison of three policies with long names."""
    one = at_rate(PATH + "/excess.toml", tuned(), 0.65, "actuator")
    names = (one.name, PATH + "/lqg.toml", "short")
    return Comparison(0.65, "step", Estimate(0.02, 0.0, "exact"), tuple(replace(one, name=name) for name in names))


def test_every_line_of_a_comparison_fits_and_every_number_is_whole() -> None:
    """Long names take several lines, of which together nothing is missing."""
    text = str(comparison())
    assert max(map(len, text.splitlines())) <= PLAIN
    one: Contestant = comparison().ranking[0]
    assert text.count(str(one.cost)) == 3
    assert PATH + "/excess.toml" in "".join(line[:28].strip() for line in text.splitlines())


def test_the_error_of_a_share_is_printed_and_moves_the_cost() -> None:
    """Half of the time each: the errors of both rates over their difference, times the difference of the costs."""
    one = at_rate("name", tuned(), 0.65, "actuator")
    assert one.share == pytest.approx(0.5)
    assert one.share_error == pytest.approx(np.hypot(0.5 * 0.003, 0.5 * 0.001) / 0.1)
    assert one.cost.standard_error == pytest.approx(one.share_error * 1.0)


def test_the_share_of_a_comparison_is_printed_with_its_error() -> None:
    """As a percentage of the time."""
    assert "the first value in 50.0 ± 1.6 % of the time" in " ".join(str(comparison()).split())


@pytest.mark.parametrize("width", [1, 7, 20, 200])
def test_a_folded_name_is_whole(width: int) -> None:
    """Its lines are at most as long as allowed, and nothing is lost but blanks at their ends."""
    lines = folded(PATH, width)
    assert "".join(lines) == PATH
    assert max(map(len, lines)) <= width
    assert folded("a b", width) == (["a b"] if width > 1 else ["a", "b"])
    assert folded("", width) == [""]


def test_a_table_with_two_long_names_and_a_wide_number_fits() -> None:
    """The names give way."""
    cells = [PATH, PATH, "0.1234567890 ± 0.0000000012", "1"]
    text = table_text(["", "other", "cost", "rate"], [cells, ["a", "b", "1", "2"]], 2)
    assert max(map(len, text.splitlines())) <= PLAIN
    assert cells[2] in text
    assert max(map(len, wrapped_text(f"name: {PATH}/{PATH}").splitlines())) <= PLAIN


@pytest.mark.parametrize(("columns", "most"), [(30, 40), (60, 60), (100, 100), (300, 120)])
def test_text_has_the_width_of_the_terminal(monkeypatch: pytest.MonkeyPatch, columns: int, most: int) -> None:
    """Between 40 and 120 columns; a wide table is whole there, and a file has 80 columns."""
    header, cells = ["name", *(f"a heading with words {i}" for i in range(6))], ["row", *6 * ["0.1234567"]]
    text = "word " * 60
    in_a_file = table_text(header, [cells], 1)
    assert max(map(len, wrapped_text(text).splitlines())) <= PLAIN
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setattr("shutil.get_terminal_size", lambda fallback: os.terminal_size((columns, 24)))
    assert most - 5 < max(map(len, wrapped_text(text).splitlines())) <= most
    shown = table_text(header, [cells], 1)
    assert max(map(len, shown.splitlines())) <= most
    assert ("\n\n" in shown) == (columns < 80)
    assert (len(shown.splitlines()) < len(in_a_file.splitlines())) == (columns > 80)


@pytest.mark.parametrize("names", [["a", "b"], [PATH, "b"]])
@pytest.mark.parametrize("width", few([4.0, 5.0, 7.0], 1))
def test_labels_of_the_axis_of_costs_do_not_overlap(names: list[str], width: float) -> None:
    """Horizontal labels have a gap; the baselines of rotated ones are farther apart than the letters are high."""
    panel = Panel([Series([0.7341, 0.7345], [0.0, 1.0], "cost", "bars", [0.0, 0.0], 0)], "cost", names=names)
    figure: Any = draw([panel], None, (width, 2.2))
    figure.draw_without_rendering()
    (axis,) = figure.axes
    low, high = axis.get_xlim()
    labels = [label for at, label in zip(axis.get_xticks(), axis.get_xticklabels(), strict=True) if low <= at <= high]
    boxes = [label.get_window_extent() for label in labels]
    assert len(boxes) > 1
    angle = np.radians(labels[0].get_rotation())
    if angle == 0:
        assert all(one.x1 + 2 < other.x0 for one, other in pairwise(boxes))
    else:
        apart = min(other.x1 - one.x1 for one, other in pairwise(boxes))
        assert apart * np.sin(angle) > labels[0].get_fontsize() * figure.dpi / 72
    assert axis.get_position().width > 0.4
