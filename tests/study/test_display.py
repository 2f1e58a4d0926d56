"""Objects show themselves in one line, as HTML, and as tables for pandas, text and papers."""

from __future__ import annotations

import csv
import dataclasses
import importlib
import pkgutil
import re
from collections.abc import Iterator, Mapping
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from counts import few
from test_house import SATELLITES

import taciturn
from taciturn._display import LONGEST, Displayed
from taciturn.model.result import Tabular
from taciturn_sweep.sweep import SweepTable
from taciturn_thesis.reproduction import Reproduction, Row, Table


@cache
def shown() -> dict[str, Any]:
    """Return what users hold in a session: problems, policies, loops, results."""
    problem = taciturn.load("two-mass-lqg")
    policy = problem.design()
    loop = problem.close(policy)
    rough = 1e-2
    compared = taciturn.compare(
        {"a": problem, "b": problem.changed({"kind": "periodic", "theta": None, "every": 2})},
        0.5,
        standard_error=rough,
    )
    return {
        "plant": problem.plant,
        "continuous plant": taciturn.load("double-integrator").plant,
        "cost": problem.cost,
        "network": problem.network,
        "problem": problem,
        "policy": policy,
        "event policy": taciturn.load("double-integrator")
        .changed({"kind": "integral", "period": None, "slope": 2.0, "alpha": 0.4})
        .designed(),
        "loop": loop,
        "averages": taciturn.average(loop, steps=20_000),
        "evaluation": taciturn.evaluate(problem, steps=20_000),
        "sweep": SweepTable(taciturn.sweep(problem, {"theta": [0.1, 1.0]}, standard_error=rough)),
        "tradeoff": taciturn.tradeoff(problem, {"theta": [0.1, 1.0]}, standard_error=rough),
        "comparison": compared,
        "tuned": compared.ranking[0].tuned,
        "trajectory": taciturn.simulate(loop, 20),
        "certificates": taciturn.certify(taciturn.Problem(SCALAR, UNIT, taciturn.Network(), "lqg", {"theta": 0.5})),
        "schedule": taciturn.load("rover").design().schedule,
        "channel": taciturn.share_channel(
            {"a": problem}, copies=4, capacity=2, scheduler="round-robin", steps=200, confidence=0
        ),
        "estimate": taciturn.Estimate(0.7441801, 0.0000312, "simulation"),
        "optimal policy": taciturn.load("wiener-double-integrator")
        .changed({"kind": "optimal", "theta": None, "period": 0.25, "price": 1.0})
        .designed(),
        "reproduction": Reproduction("one", (BOTH,), {}, {"two-mass-lqg": problem}),
        "table": BOTH,
    }


BOTH = Table(
    "Table 1",
    (
        Row({"θ": 0.1}, {"cost": 0.75}, {"cost": taciturn.Estimate(0.7441801, 0.0000312, "simulation")}),
        Row({"θ": 1.0}, {}, {"cost": taciturn.Estimate(0.82128, 0.00032, "simulation")}),
    ),
    ("the thesis & its 600 runs",),
)


SCALAR = taciturn.Plant(A=[[1.2]], B=[[1.0]], W=[[0.01]])
UNIT = taciturn.Cost(Q=[[1.0]], R=[[1.0]])
NAMES = (
    "plant", "continuous plant", "cost", "network", "problem", "policy", "event policy", "loop", "averages",
    "evaluation", "tradeoff", "comparison", "tuned", "trajectory", "certificates", "schedule", "channel", "estimate",
    "optimal policy", "reproduction", "sweep", "table",
)  # fmt: skip
TABLES = (
    "evaluation", "tradeoff", "comparison", "tuned", "trajectory", "certificates", "schedule", "channel", "sweep",
    "table",
)  # fmt: skip


class Balanced(HTMLParser):
    """Checks that every tag is closed, and nothing is loaded or run."""

    def __init__(self) -> None:
        """Begin outside of all tags."""
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Enter a tag; an image has its data with it, and words for those who do not see it."""
        if tag == "img":
            given = {name: value or "" for name, value in attrs}
            assert set(given) == {"alt", "style", "src"}
            assert given["alt"]
            assert given["src"].startswith("data:image/svg+xml;base64,")
            return
        assert tag in {"table", "thead", "tbody", "tr", "th", "td", "strong", "div"}
        assert {name for name, _ in attrs} <= {"style"}
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        """Leave it."""
        assert self.open.pop() == tag


@pytest.mark.parametrize("name", few(NAMES, 2))
def test_an_object_shows_itself_in_a_line_and_in_a_notebook(name: str) -> None:
    """At most 200 characters, one line; HTML that is whole."""
    value = shown()[name]
    text = repr(value)
    assert len(text) <= LONGEST
    assert "\n" not in text
    assert text.startswith(type(value).__name__)
    page = Balanced()
    page.feed(value._repr_html_())
    assert not page.open
    assert ("<img" in value._repr_html_()) == hasattr(value, "plot")


def test_every_public_class_of_data_shows_itself_by_one_mechanism() -> None:
    """No public dataclass keeps the repr that lists every entry of its matrices."""
    data: set[type] = set()
    packages = [importlib.import_module(name) for name in ("taciturn", *SATELLITES)]
    for module in (one for home in packages for one in pkgutil.walk_packages(home.__path__, f"{home.__name__}.")):
        path = module.name.split(".")[1:]
        if path[0] not in ("cli", "program") and not any(part.startswith("_") for part in path):
            held = vars(importlib.import_module(module.name))
            public = [one for name, one in held.items() if isinstance(one, type) and not name.startswith("_")]
            data |= {one for one in public if dataclasses.is_dataclass(one) and one.__module__ == module.name}
    assert len(data) > 100
    assert not [one for one in data if one.__repr__ is not Displayed.__repr__]
    tables = {one.__name__ for one in data if issubclass(one, Tabular)}
    assert tables >= {
        "Evaluation", "Tradeoff", "Comparison", "Tuned", "TunedPeriod", "Trajectory", "Schedule", "Sharing", "Losses",
        "Certificates", "NetworkRun", "Bench", "Table",
    }  # fmt: skip


def held_in(value: Any) -> Iterator[Any]:
    """Return every object of data within another one."""
    if dataclasses.is_dataclass(value):
        yield value
        value = tuple(getattr(value, field.name) for field in dataclasses.fields(value))
    if isinstance(value, Mapping):
        value = tuple(value.values())
    if isinstance(value, list | tuple):
        for one in value:
            yield from held_in(one)


def test_what_results_and_policies_hold_fits_a_line_as_well() -> None:
    """Steps, triggers, points, contestants and schedules: a user meets them in a session too."""
    found = [one for name in NAMES for one in held_in(shown()[name])]
    assert {type(one).__name__ for one in found} >= {"Assign", "Decide", "Trigger", "Form", "Point", "Contestant"}
    assert max(len(repr(one)) for one in found) <= LONGEST
    assert not [one for one in found if "\n" in repr(one)]


@pytest.mark.parametrize("name", TABLES)
def test_a_table_of_results_is_the_same_in_pandas_text_and_latex(name: str, tmp_path: Path) -> None:
    """The rows of the records; an estimate is one entry in LaTeX, and two columns elsewhere."""
    value = shown()[name]
    records = value.records()
    table = value.to_pandas()
    assert len(table) == len(records)
    assert value.to_csv(tmp_path / "table.csv") == value.to_csv() == (tmp_path / "table.csv").read_text("utf-8")
    with (tmp_path / "table.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(records)
    tex = value.to_latex(tmp_path / "table.tex")
    assert (tmp_path / "table.tex").read_text(encoding="utf-8") == tex
    assert tex.count(r"\\") == len(records) + 1
    estimates = [entry for row in records for entry in row.values() if isinstance(entry, taciturn.Estimate)]
    assert tex.count(r"\pm") == sum("±" in str(entry) for entry in estimates)
    above, _, below = tex.partition(r"\begin{tabular}")
    assert not re.search(r"(?<!\\)[%#]", below)
    assert all(line.startswith("% ") for line in above.splitlines())
    assert f"Taciturn {taciturn.__version__}" in above
    if estimates:
        assert any(column.endswith("_standard_error") for column in table.columns)


def test_an_estimate_has_the_digits_that_its_error_supports() -> None:
    """Two digits of the error, and the value to the same decimal: in a line, in a notebook and in LaTeX."""
    found = shown()["estimate"]
    assert str(found) == "0.744180 ± 0.000031"
    assert repr(found) == "Estimate(value=0.744180 ± 0.000031, method='simulation')"
    assert ">0.744180 ± 0.000031<" in found.html()
    assert r"$0.1$ & $0.75$ & $0.744180 \pm 0.000031$ \\" in BOTH.to_latex()


@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("evaluation", ("cost=0.74403 ± 0.00046", "rates={actuator: 0.5936 ± 0.0044}", "cost_bound=0.806826")),
        ("tradeoff", ("theta=[0.1, 1]", "rate_actuator=[0.58", "cost=[0.744")),
        ("comparison", ("rate=0.5", "a: 0.7547", "b: 0.768473")),
        ("tuned", ("theta = 0.19", "cost=0.7548", "rates={actuator: 0.49")),
        ("problem", ("parameters={theta: 0.1}",)),
        ("several parameters", ("parameters={theta: 0.0516, actuation: 'model', delta: 0.25, h_min: 2}",)),
        ("plant", ("poles='marginally stable: 0.809017",)),
        ("loop", ("policy='lqg'", "cost_all_time=0.733478", "nominal=True")),
        ("policy", ("cost_all_time=0.733478", "guarantee='at most 0.806826: ")),
        ("contestant", ("policy='lqg'", "parameter='theta = 0.19", "cost=0.7547")),
        ("trajectory", ("steps=20", "of 20'}")),
    ],
)
def test_a_line_contains_the_key_numbers(name: str, numbers: tuple[str, ...]) -> None:
    """They come first, so that a line of 200 characters always has them."""
    held = shown()
    names = {"theta": 0.0516, "actuation": "model", "delta": 0.25, "h_min": 2}
    more = {
        "several parameters": dataclasses.replace(held["problem"], parameters=names),
        "contestant": held["comparison"].ranking[0],
    }
    text = repr((held | more)[name])
    assert all(number in text for number in numbers), text


@pytest.mark.parametrize("name", [*TABLES, "reproduction"])
def test_a_result_prints_the_table_of_its_command(name: str) -> None:
    """Several lines of at most 80 columns, with its numbers; schedules have no command."""
    text = str(shown()[name])
    if name != "schedule":
        assert len(text.splitlines()) > 1
        assert max(map(len, text.splitlines())) <= 80
        assert re.search(r"\d\.\d", text)


def test_numbers_that_round_to_zero_have_no_sign() -> None:
    """In a line, in an estimate and in LaTeX."""
    assert str(taciturn.Estimate(-0.0, 0.0, "exact")) == "0"
    assert str(taciturn.Estimate(-1e-9, 0.01, "simulation")) == "0.000 ± 0.010"
    path = dataclasses.replace(shown()["trajectory"], input=-0.0 * shown()["trajectory"].input)
    assert "$-0$" not in path.to_latex()


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        (
            "comparison",
            {"ax": 3},
            "ax is 3; expected axes of matplotlib, such as those from figure, ax = matplotlib.pyplot.subplots()",
        ),
        ("policy", {"ax": 3}, "ax is 3; expected axes of matplotlib"),
        ("comparison", {"figsize": "big"}, "figsize is 'big'; expected two positive numbers, the width and the height"),
        ("policy", {"figsize": (1, -2)}, "figsize is (1, -2); expected two positive numbers"),
        ("comparison", {"ax": 3, "figsize": (7, 4)}, "ax and figsize are both given, but figsize is the size of a new"),
        ("comparison", {"style": "papr"}, "style is 'papr'; expected 'light' or 'dark' for a screen, or 'paper' or"),
        ("policy", {"style": 3}, "style is 3; expected 'light' or 'dark' for a screen"),
    ],
)
def test_axes_and_sizes_that_are_none_are_refused(name: str, given: dict[str, Any], message: str) -> None:
    """In one sentence, by figures of results and by diagrams."""
    with pytest.raises(taciturn.ProblemError, match=f"^{re.escape(message)}"):
        shown()[name].plot(**given)


def test_the_column_that_numbers_the_rows_is_written(tmp_path: Path) -> None:
    """Time is the index of a path in pandas, and the first column of its text."""
    path = shown()["trajectory"]
    assert path.to_pandas().index.name == "time"
    path.to_csv(tmp_path / "path.csv")
    with (tmp_path / "path.csv").open(encoding="utf-8") as file:
        times = [float(row["time"]) for row in csv.DictReader(file)]
    assert times == path.time.tolist()


def test_a_notebook_shows_the_ends_of_a_long_table() -> None:
    """The first 20 and the last 10 steps of a path, and words for what was sent."""
    problem = taciturn.load("two-mass-lqg")
    path = taciturn.simulate(problem.close(problem.design()), 1000)
    page = path.html()
    assert page.count("<tr>") == 2 + 1 + 20 + 1 + 10  # unit and notice, heading, first, gap, last
    assert ">970 of 1000 rows; to_pandas() and to_csv() return all<" in page
    assert f">{path.time[-1]:.6g}<" in page
    assert {">yes<", ">no<"} <= set(re.findall(">(?:yes|no)<", page))


def test_a_bound_in_a_table_still_holds() -> None:
    """It has six digits, rounded away from what it bounds."""
    found = shown()["tradeoff"]
    for row, point in zip(found.records(), found.points, strict=True):
        exact = point.evaluation.cost_bound
        assert exact <= row["guarantee"] <= exact * (1 + 1e-5)


def test_rates_of_an_average_and_of_an_evaluation_have_the_same_unit() -> None:
    """Per second of a continuous plant, per step of a discrete one; both name it."""
    for name, changes, unit in (
        ("double-integrator", {"kind": "consistent", "period": 0.25}, "second"),
        ("two-mass-lqg", {}, "step"),
    ):
        problem = taciturn.load(name).changed(changes)
        mean = taciturn.average(problem.close(problem.design()), steps=20_000)
        found = taciturn.evaluate(problem, steps=20_000)
        assert mean.rate_unit == found.rate_unit == found.document()["rate_unit"] == unit
        assert mean.rates == found.rates, "the same draws"


def test_a_table_is_written_as_csv_only() -> None:
    """Another ending is refused before anything is written."""
    with pytest.raises(taciturn.ProblemError, match=r"unknown format; expected a file name that ends in \.csv$"):
        shown()["evaluation"].to_csv("table.xlsx")
