"""Every result with numbers worth seeing has a picture, which is legible in all styles; and what the pictures show."""

from __future__ import annotations

import importlib
import pkgutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from io import BytesIO
from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from counts import few
from matplotlib.text import Text
from runtime.silent import build, problem_of, simulate, write_logs

import taciturn
from taciturn import cli
from taciturn._figure import Above, Panel, Series, draw
from taciturn._style import STYLES, StyleName, policy_looks
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.limits import Violation, Violations
from taciturn.model.result import Result
from taciturn.model.theory import LowerBound
from taciturn.renewal.chain import Intervals
from taciturn.study.periodic import UNSTABLE
from taciturn.study.recorded import recorded_silence
from taciturn.study.sentences import share_text
from taciturn_events.losing_thresholds import Losses, ThresholdPoint
from taciturn_studies.tune import tune_period
from taciturn_sweep.sweep import SweepTable

WITHOUT = {
    "Tabular": "no result itself",
    "Violation": "a part of Violations",
    "AsWritten": "a sentence of an evaluation",
    "AfterStep": "a sentence of an evaluation",
    "SetPointSteps": "a sentence of an evaluation",
    "WithoutLimits": "a sentence of an evaluation",
    "ClockMix": "a number of an evaluation",
    "Course": "arrays for a figure of the user's own",
    "Description": "has the figure of its diagram",
    "LinkClocks": "a line of a comparison",
    "Parameter": "the title of the figure of Tuned",
    "Contestant": "a row of a comparison",
    "Point": "a point of a trade-off",
    "Row": "a row of a table of the thesis",
    "Table": "printed beside its chapter's figures",
    "Reproduction": "has the figures of its chapter",
    "Calibration": "camera parameters",
    "Identification": "matrices",
    "WorldRun": "invariants that hold or do not",
    "Bench": "speeds of this machine",
    "Fmu": "a file",
    "CFolder": "files",
}
ROOT = Path(__file__).parents[2]
MASSES = taciturn.load("two-mass")
LOOSE = 1e-2


def one_path(problem: taciturn.Problem) -> Any:
    """Return a path of a problem."""
    return taciturn.simulate(problem.close(problem.design()), 80)


def two_paths(one: taciturn.Problem, other: taciturn.Problem) -> Any:
    """Return paths of two problems on the same noise."""
    return taciturn.simulate(one.close(one.design()), 80, versus=other.close(other.design()))


def violations() -> Violations:
    """Return probabilities of which one is 0."""
    rare, none = Estimate(2e-9, 5e-10, "simulation"), Estimate(0.0, 0.0, "simulation")
    each = (Violation(rare, Estimate(7e-5, 2e-5, "simulation"), 3), Violation(none, none, 0))
    return Violations(("-3 ≤ x1 ≤ 3", "x2 ≤ 4"), each, each[0], "hour")


def losses() -> Losses:
    """Return thresholds of which one loses."""
    one = Estimate(0.5, 1e-3, "simulation")
    return Losses(tuple(ThresholdPoint(k, Estimate(1 / k, 1e-3, "simulation"), one, 0.3 + 0.1 * k) for k in (1.0, 3.0)))


def bounded() -> Any:
    """Return a trade-off with lower bounds."""
    found, points = made("trade-off"), list[Any]()
    for point in found.points:
        one = point.evaluation
        bound = LowerBound(0.999 * one.cost.value, 0.999, one.rates["actuator"].value, 0.01)
        points.append(replace(point, evaluation=replace(one, lower_bound=bound)))
    return replace(found, points=tuple(points))


def recorded(folder: Path) -> Any:
    """Return what silence has cost in a recording."""
    return recorded_silence(problem_of("held"), write_logs(build("held"), simulate(build("held"), 40, 1), folder))


def period() -> Any:
    """Return a tuned period."""
    plant, cost = taciturn.ContinuousPlant([[0.0]], [[1.0]], [[1.0]]), taciturn.Cost([[1.0]], [[1.0]])
    walk = taciturn.Problem(plant, cost, taciturn.Network(), "consistent", {"period": 0.5})
    return tune_period(walk, rate=1.0, least=0.1)


MADE: dict[str, Callable[[], Any]] = {
    "trade-off": lambda: taciturn.tradeoff(MASSES, {"theta": [0.005, 0.05, 0.2, 0.3]}, standard_error=LOOSE),
    "trade-off of several links": lambda: taciturn.tradeoff(
        taciturn.load("quadruple-tank"), {"theta": [0.1, 1.0]}, standard_error=LOOSE
    ),
    "trade-off of two actuations": lambda: taciturn.tradeoff(
        MASSES, {"theta": [0.01, 0.2], "actuation": ["model", "hold"]}, standard_error=LOOSE
    ),
    "trade-off with a bound": lambda: bounded(),
    "evaluation": lambda: taciturn.evaluate(MASSES, standard_error=LOOSE),
    "evaluation of several links": lambda: taciturn.evaluate(taciturn.load("quadruple-tank"), standard_error=LOOSE),
    "comparison": lambda: taciturn.compare(
        {"predicted": MASSES, "held, a long name": MASSES.changed({"actuation": "hold"})}, 0.5, standard_error=LOOSE
    ),
    "tuned": lambda: taciturn.tune(MASSES, rate=0.3, standard_error=LOOSE),
    "tuned to a cost": lambda: taciturn.tune(MASSES, cost="+5%", standard_error=LOOSE),
    "tuned period": period,
    "channel": lambda: taciturn.share_channel({"masses": MASSES}, copies=10, capacity=2, steps=500, confidence=0),
    "sweep": lambda: SweepTable(
        taciturn.sweep(MASSES, {"theta": [0.01, 0.2], "actuation": ["model", "hold"]}, standard_error=LOOSE)
    ),
    "certificates": lambda: taciturn.certify(taciturn.load("two-mass-lqg")),
    "path": lambda: one_path(MASSES),
    "path within limits": lambda: one_path(taciturn.load(ROOT / "docs" / "limited-tank.toml")),
    "path of banks": lambda: taciturn.simulate(build("two valves"), 80),
    "paths of one kind": lambda: two_paths(MASSES, MASSES.changed({"theta": 1.0})),
    "violations": violations,
    "losing thresholds": losses,
    "intervals": lambda: Intervals(np.array([1.0, 0.6, 0.3, 0.1]), 0.5),
}  # fmt: skip


@cache
def made(name: str) -> Any:
    """Return a result."""
    return MADE[name]()


def texts(figure: Any, monkeypatch: pytest.MonkeyPatch) -> tuple[dict[Text, Any], Any]:
    """Return each text that is drawn with its place, and the place of the figure."""
    found, plain = dict[Text, Any](), Text.draw

    def drawn(text: Text, renderer: Any, *args: Any) -> None:
        plain(text, renderer, *args)
        if text.get_text().strip():
            found[text] = text.get_window_extent(renderer)

    monkeypatch.setattr(Text, "draw", drawn)
    figure.savefig(BytesIO(), format="png", dpi=100)
    monkeypatch.undo()
    return found, figure.bbox


def overlapping(figure: Any, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the texts that are cut by the edge of a figure, or that cover each other."""
    found, whole = texts(figure, monkeypatch)
    cut = [
        text.get_text()
        for text, box in found.items()
        if box.x0 < -1 or box.y0 < -1 or box.x1 > whole.x1 + 1 or box.y1 > whole.y1 + 1
    ]
    upright = [(text.get_text(), box) for text, box in found.items() if text.get_rotation() in (0.0, 90.0)]
    covered = [
        f"{one} / {other}"
        for (one, a), (other, b) in combinations(upright, 2)
        if min(a.x1, b.x1) - max(a.x0, b.x0) > 1 and min(a.y1, b.y1) - max(a.y0, b.y0) > 2
    ]
    return cut + covered


@pytest.mark.parametrize("case", few([(name, style) for name in MADE for style in STYLES], 2))
def test_every_result_with_numbers_has_a_legible_picture(
    case: tuple[str, StyleName], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In all styles, without a warning, and with no text that is cut or covered by another one."""
    name, style = case
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert overlapping(made(name).plot(style=style), monkeypatch) == []


def test_a_notebook_shows_picture_and_table() -> None:
    """As an image that adapts to the colours of the reader."""
    shown = made("intervals")._repr_html_()
    assert "data:image/svg+xml" in shown
    assert "<table" in shown


@pytest.mark.parametrize("style", few(STYLES, 1))
def test_a_recording_has_a_legible_picture(style: StyleName, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the silence of each node, and the path with every sample beside the recorded one."""
    figure = recorded(tmp_path).plot(style=style)
    assert overlapping(figure, monkeypatch) == []
    assert [axis.get_ylabel() for axis in figure.axes] == ["", "y1", "u1"]


def test_every_result_has_a_picture_or_a_reason_for_none() -> None:
    """Of all packages; and no reason is given for a result that has one."""
    for folder in Path(taciturn.__file__).parents[1].glob("taciturn*/"):
        for module in pkgutil.walk_packages([str(folder)], f"{folder.name}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)

    def kinds(of: type[Any]) -> set[type[Any]]:
        return {one for child in of.__subclasses__() for one in (child, *kinds(child))}

    named = {one.__name__: one for one in kinds(Result) if one.__module__.startswith("taciturn")}
    assert {name for name, one in named.items() if not hasattr(one, "plot")} == WITHOUT.keys()


@pytest.mark.evidence
def test_the_axis_holds_policy_periodic_control_every_sample_and_guarantee() -> None:
    """Whether they are near each other or five times as large."""
    for name in ("trade-off", "trade-off of several links"):
        found = made(name)
        (low, high), answers = found.plot().axes[0].get_ylim(), [point.evaluation for point in found.points]
        for one in answers:
            bounds = [one.cost_bound_at_rate or one.cost_bound, one.cost_periodic_same_rate]
            values = [one.cost.value, one.cost_all_time, *bounds]
            assert all(low < value < high for value in values if value is not None)


def test_the_title_of_a_tradeoff_speaks_of_the_point_in_the_ring() -> None:
    """Its packets; each point has its parameter, and the label of a bent axis says that it is bent."""
    found = made("trade-off with a bound")
    axis = found.plot().axes[0]
    (ring,) = [line for line in axis.get_lines() if line.get_markerfacecolor() == "none"]
    (told,) = [point for point in found.points if point.evaluation.cost.value == ring.get_ydata()[0]]
    assert axis.get_title().startswith(f"{share_text(told.evaluation.share)} of the packets, ")
    written = [text.get_text() for text in axis.texts]
    others = {str(point.values["theta"]) for point in found.points if point is not told}
    assert {*others, f"θ = {told.values['theta']}"} <= {*written}
    assert "no schedule of this controller (99.9 % confidence)" in written
    assert axis.get_ylabel().endswith("(axis: logarithmic far from 0)")


@pytest.mark.evidence
def test_the_title_of_a_picture_says_its_result() -> None:
    """The bound of an evaluation comes last; the parameter and the packets of an answer. A budget has its value."""
    found = made("evaluation")
    packets, extra, bound = found.verdict[0].split(", ")
    told = f"{packets}, {extra.removesuffix(' than every sample')}; proven: {bound.removesuffix(' proven')} more"
    assert found.plot().axes[0].get_title().replace("\n", " ") == told
    tuned = made("tuned").plot().axes[0]
    assert tuned.get_title().startswith(f"θ = {made('tuned').parameter.value:.4g}: 30")
    assert "budget 0.3" in [text.get_text() for text in tuned.texts]


@pytest.mark.evidence
def test_shares_of_the_links_are_drawn_if_they_change_over_the_points() -> None:
    """Nearly constant ones are not, whatever those of every sample are; then the costs have the label of the rates."""
    found = made("trade-off of several links")
    (costs,) = found.plot().axes
    assert costs.get_xlabel() == "traffic per second: price × sends on all links"
    first, *others = found.points
    dear = replace(first.evaluation, prices={"level-1": 100.0})
    axes = replace(found, points=(replace(first, evaluation=dear), *others)).plot().axes
    assert [axis.get_ylabel() for axis in axes[1:]] == ["share (%)"]


@pytest.mark.evidence
def test_rates_that_all_loops_of_a_channel_have_are_not_drawn() -> None:
    """Those of loops of one kind; if periodic control has another rate, they are."""
    found = made("channel")
    assert len(found.plot().axes) == 1
    (share,) = found.shares
    assert len(replace(found, shares=(replace(share, rate_periodic=2 * share.rate_periodic),)).plot().axes) == 2


@pytest.mark.evidence
def test_probabilities_of_zero_are_at_the_axis_and_small_ones_are_powers_of_ten() -> None:
    """A limit has a minus sign."""
    (axis,) = made("violations").plot().axes
    zeros = [text.xy for text in axis.texts if text.get_text() == "0"]
    assert zeros == [(0.0, 1)]
    assert axis.get_title() == "limits violated in $2{\\times}10^{-9}$ of the steps"
    assert axis.get_yticklabels()[-1].get_text() == "−3 ≤ x1 ≤ 3"


@pytest.mark.evidence
def test_only_one_of_two_guarantees_has_a_filled_marker() -> None:
    """That for any rate."""
    (axis, _) = made("evaluation").plot().axes
    marks = [line for line in axis.get_lines() if line.get_marker() == "^"]
    assert [line.get_markerfacecolor() == line.get_color() for line in marks] == [False, True]


def test_held_and_predicted_inputs_have_one_colour_in_any_order() -> None:
    """Periodic control is amber, and the first of the other policies is blue."""
    assert policy_looks([["excess", "model"], ["excess", "hold"]]) == ["policy", "held"]
    assert policy_looks([["excess", "hold"], ["excess", "model"]]) == ["held", "policy"]
    assert policy_looks([["periodic control", "hold"], ["excess"], ["lqg"]]) == ["periodic control", "policy", "held"]
    assert len(set(policy_looks([["hold", 1], ["hold", 2], ["hold", 3]]))) == 3


@pytest.mark.evidence
def test_rates_at_which_periodic_control_is_unstable_are_shaded() -> None:
    """Up to the largest rate of such a point, and named in the key."""
    found = made("trade-off")
    (*others, last) = found.points
    alone = replace(last, evaluation=replace(last.evaluation, clock=None, no_clock=UNSTABLE))
    axis = replace(found, points=(*others, alone)).plot().axes[0]
    assert "periodic control is unstable" in [text.get_text() for text in axis.get_legend().get_texts()]
    assert axis.collections[-1].get_paths()[0].vertices[:, 0].max() == alone.evaluation.rates["actuator"].value
    assert "periodic control is unstable" not in [text.get_text() for text in found.plot().axes[0].get_legend().texts]


def test_values_near_a_base_are_apart_however_far_others_are() -> None:
    """The axis bends if they are more than four times as far, and is linear otherwise."""
    assert Above.of(1.0, [1.1], [1.3]).bend is None
    far = Above.of(1.0, [1.02, 1.1], [6.0])
    assert far.bend is not None
    y = [1.0, 1.02, 1.1, 6.0]
    (axis,) = draw([Panel([Series([0.0, 1.0, 2.0, 3.0], y)], yabove=far)]).axes
    places = [axis.transAxes.inverted().transform(axis.transData.transform((0.0, one)))[1] for one in y]
    assert places[2] - places[0] > 0.2
    shown = [label.get_text() for label in axis.get_yticklabels()]
    assert {"0", "+500 %"} <= set(shown)
    assert shown == sorted(shown, key=lambda text: float(text.replace(" %", "").replace(",", "").replace("−", "-")))


def test_a_histogram_of_measured_intervals_is_beside_their_law() -> None:
    """With the shares of the measured ones, which must be whole numbers of checks."""
    law = Intervals(np.array([1.0, 0.5]), 0.5)
    (axis,) = law.plot(measured=[1, 1, 2, 4]).axes
    stairs = next(one for one in axis.patches if isinstance(one, matplotlib.patches.StepPatch))
    assert stairs.get_data().values[:4].tolist() == [0.5, 0.25, 0.0, 0.25]
    (points,) = (line for line in axis.get_lines() if line.get_marker() == "o")
    assert points.get_ydata()[:3].tolist() == [0.5, 0.25, 0.125]
    with pytest.raises(ProblemError, match="not a positive integer; expected positive integers"):
        law.plot(measured=[0.5])


@pytest.mark.evidence
def test_the_search_is_in_the_document_and_the_answer_lies_on_its_curve() -> None:
    """Each value that was tried, with what the budget limits."""
    found = made("tuned")
    tried = found.document()["tried"]
    assert len(tried) >= 3
    assert [one["value"] for one in tried] == sorted(one["value"] for one in tried)
    assert min(one["limited"] for one in tried) <= 0.3 <= max(one["limited"] for one in tried)


@pytest.mark.parametrize("command", few(["evaluate", "tune", "certify"], 1))
def test_the_command_line_saves_the_picture(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the numbers."""
    picture = tmp_path / "picture.svg"
    more = {"evaluate": ["--standard-error", "1e-2"], "tune": ["--rate", "0.3", "--standard-error", "1e-2"]}
    monkeypatch.setattr("sys.argv", ["taciturn", command, "two-mass", *more.get(command, []), "--plot", str(picture)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0
    assert picture.stat().st_size > 1000
