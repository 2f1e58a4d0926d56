"""A setting, its text and its problem file are the same thing: whatever a user changes comes back as it was."""

from __future__ import annotations

import re
import tomllib
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from counts import few
from hypothesis import given
from hypothesis import strategies as some

import taciturn
from taciturn.errors import ProblemError
from taciturn.study.record import fingerprint
from taciturn_explore.answers import Answers
from taciturn_explore.controls import controls_of, with_kind
from taciturn_explore.disturbed import run_path
from taciturn_explore.files import Effort, command, problem_file, python_lines
from taciturn_explore.setting import Event, Setting, Trusted, built_in, setting_for, setting_of
from taciturn_studies.periodic_links import clocks_of_links

PROBLEMS = ("two-mass", "pid-tank", "quadruple-tank", "lossy-double-integrator", "omni-heading", "rover")
WORDS = some.text("abcdefghijklmnopqrstuvwxyz-&=#:%ä 0123", min_size=1, max_size=8)
NUMBERS = some.floats(1e-9, 1e20) | some.integers(-5, 10**6)
SETTINGS = some.builds(
    lambda name, file, numbers, words, factors, seed, events, steps, compare: Setting(
        name if file is None else "", file or "", (), seed, tuple(events), steps, compare
    ).to({**numbers, **words, **factors}),
    some.sampled_from(PROBLEMS),
    some.none() | some.text(min_size=1, max_size=40),
    some.dictionaries(some.sampled_from(["policy.theta", "policy.period", "network.delay"]), NUMBERS),
    some.dictionaries(some.sampled_from(["policy.kind", "policy.gains"]), WORDS),
    some.dictionaries(some.sampled_from(["factor.cost.Q", "factor.plant.W"]), some.floats(1e-3, 1e3)),
    some.integers(0, 2**40),
    some.lists(
        some.builds(Event, some.just("load"), some.integers(0, 99), some.just("0"), some.floats(-9, 9)), max_size=3
    ),
    some.integers(20, 4000),
    some.none() | some.lists(some.sampled_from(["lqg", "relative"]), max_size=2).map(tuple),
)
TWO_LINKS = """
[plant]
A = [[0.9]]
B = [[1.0]]
C = [[1.0]]
W = [[1.0]]
V = [[0.5]]
dt = 1.0
[cost]
Q = [[1.0]]
R = [[0.5]]
[nodes]
gauge.measures = [0]
plc.controls = true
valve.applies = [0]
[policy]
kind = "distributed"
theta = 0.5
"""


@given(SETTINGS)
def test_the_text_of_a_setting_is_that_setting(setting: Setting) -> None:
    """Read again, it is equal in all its parts; equal settings have one text."""
    assert setting_of(setting.text) == setting
    assert setting_of(setting_of(setting.text).text).text == setting.text


@pytest.mark.parametrize("name", few(PROBLEMS, 3))
def test_the_file_of_a_changed_problem_is_read_back_bit_for_bit(name: str, tmp_path: Path) -> None:
    """Each control is moved; the file has the digest of all data of the problem."""
    setting = Setting(name=name)
    base = setting.base()
    draws = np.random.default_rng(3)
    moved = {
        one.key: float(one.value) * float(draws.uniform(1.01, 1.2))  # type: ignore[arg-type]
        for one in controls_of(setting, base)
        if one.form == "ratio"
    }
    changed = setting.to(moved).problem(base)
    assert len(moved) > 2
    assert fingerprint(changed) != fingerprint(base)
    file = tmp_path / "saved.toml"
    file.write_text(problem_file(setting.to(moved), changed), encoding="utf-8")
    assert fingerprint(taciturn.load(file)) == fingerprint(changed)
    again, trusted = setting_for(str(file))
    assert fingerprint(again.problem(again.base(trusted))) == fingerprint(changed)


def test_every_built_in_problem_is_written_and_read_back(tmp_path: Path) -> None:
    """Tables, lists of tables, names with hyphens and functions included."""
    for name in built_in():
        problem = taciturn.load(name)
        file = tmp_path / f"{name}.toml"
        file.write_text(problem_file(Setting(name=name), problem), encoding="utf-8")
        assert fingerprint(taciturn.load(file)) == fingerprint(problem), name


def test_python_and_command_name_the_changes_and_the_effort() -> None:
    """The lines of Python run, and give the numbers of the setting."""
    setting = Setting(name="two-mass", seed=4).to({"policy.theta": 0.08})
    assert command(setting, Effort(steps=400_000)) == (
        "taciturn evaluate two-mass --set theta=0.08 --steps 400000 --seed 4"
    )
    assert command(setting, Effort()) == "taciturn evaluate two-mass --set theta=0.08 --seed 4"
    assert "evaluate(problem, seed=4)" in python_lines(setting, Effort())
    scope: dict[str, object] = {"print": lambda _: None}
    exec(python_lines(setting, Effort(steps=2048)), scope)
    expected = taciturn.evaluate(taciturn.load("two-mass").changed({"theta": 0.08}), steps=2048, seed=4)
    assert scope["found"].cost == expected.cost  # type: ignore[attr-defined]
    assert "saved.toml" in command(setting.to({"factor.cost.Q": 2.0}), Effort(standard_error=1e-3))


def test_a_change_that_states_the_value_of_the_file_is_no_change() -> None:
    """Another kind keeps the parameters that it shares, and the way back leaves no trace."""
    base = taciturn.load("two-mass")
    same = Setting(name="two-mass").to({"policy.theta": 0.052, "factor.cost.Q": 1.0})
    assert same.stated(base) == Setting(name="two-mass")
    other = with_kind(same, base, base, "lqg")
    assert dict(other.changes) == {"policy.kind": "lqg", "policy.theta": 0.052, "policy.actuation": "model"}
    assert other.problem(base).kind == "lqg"
    assert with_kind(other, base, other.problem(base), base.kind).changes == ()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("policy.theta=1", "names no problem"),
        ("problem=../../etc/passwd", "name of a built-in problem"),
        ("problem=two-mass&plant.function=a.py:f", "may change"),
        ("problem=two-mass&policy.file=x", "may change"),
        ("problem=two-mass&factor.cost.Q=-1", "positive factor"),
        ("problem=two-mass&factor.plant.A=2", "positive factor"),
        ("problem=two-mass&load=5:0", "STEP:NUMBER:SIZE"),
        ("problem=two-mass&steps=1000000", "steps is 1000000; expected a whole number from 20 to 4000"),
        ("problem=two-mass&seed=-1", "seed is -1; expected a whole number from 0"),
        ("problem=two-mass&seed=12345678901234567890", "seed is 12345678901234567890; expected"),
        ("file=AAAA", "damaged"),
    ],
)
def test_an_address_that_is_no_setting_is_refused_with_a_sentence(text: str, sentence: str) -> None:
    """Each part that an address may contain is checked."""
    with pytest.raises(ProblemError, match=sentence):
        setting_of(text)


@pytest.mark.parametrize("given", ["-5", -5, "1.5", 1.5, "12345678901234567890", "", True])
def test_a_control_refuses_what_an_address_refuses(given: object) -> None:
    """Seed and steps are whole numbers within limits, however the page sends them."""
    answers = Answers()
    for name in ("seed", "steps"):
        with pytest.raises(ProblemError, match=f"{name} is .*; expected a whole number from"):
            answers.settle("problem=two-mass", {}, {name: given})
    assert answers.settle("problem=two-mass", {}, {"seed": "7"})["text"] == "problem=two-mass&seed=7"


@pytest.mark.evidence
def test_the_verdict_and_the_notes_are_those_of_the_library(tmp_path: Path) -> None:
    """Line by line, also on the plant as written; a first answer says that it is on another plant."""
    tank = Path(str(files("taciturn") / "problems" / "pid-tank.toml")).read_text(encoding="utf-8")
    (path := tmp_path / "tank.toml").write_text(re.sub(r"^disturbance = .*$", "", tank, flags=re.MULTILINE))
    answers, text = Answers(), setting_for(str(path))[0].to({"policy.theta": 0.8}).text
    first, refined = answers.point(text, False), answers.point(text, True)
    error = float(refined["effort"].split()[1])
    found = taciturn.evaluate(taciturn.load(path).changed({"theta": 0.8}), standard_error=error)
    assert refined["verdict"] == list(found.verdict)
    assert refined["verdict"][0].startswith("plant as written: ")
    assert [line.partition(": ")[0] for line in first["verdict"]] == ["with a slow disturbance by default"]
    assert refined["notes"] == list(found.remarks)
    written, base = refined["written"], refined["every"]["cost"]
    assert found.as_written is not None
    assert written["cost"] / base == pytest.approx(found.as_written.cost.value / (found.as_written.cost_all_time or 0))


@pytest.mark.parametrize("name", ["two-mass", "quadruple-tank"])
def test_packets_are_as_far_apart_as_their_rate_states(name: str) -> None:
    """The mean interval is the inverse of the rate, and the histogram has no mean of its own."""
    answers = Answers()
    for rate in answers.point(f"problem={name}", False)["rates"]:
        assert float(rate["apart"]) * rate["share"] == pytest.approx(1.0, abs=5e-3)
    assert all("mean" not in link for link in answers.network(f"problem={name}")["links"])


def test_signals_have_the_names_of_the_file() -> None:
    """Panels and tables have them with the units, and the controls of events have the unit apart."""
    source = problem_file(Setting(name="pid-tank"), taciturn.load("pid-tank"))
    named = source.replace('["level"]', '["level (cm)"]').replace('["valve"]', '["valve (%)"]')
    found = Answers().response(Setting(file=named).text)
    assert (found["outputs"], found["inputs"]) == (["level (cm)"], ["valve (%)"])
    assert found["loads"] == [("valve", "%")]


def test_an_event_that_is_added_again_has_the_size_of_the_first() -> None:
    """It does not grow with the deviations that the events before have caused."""
    answers = Answers()
    (size,) = answers.response("problem=two-mass")["sizes"]["load"]
    once = answers.response(f"problem=two-mass&load=80:0:{size}")
    twice = answers.response(f"problem=two-mass&load=80:0:{size}&load=90:0:{size}")
    assert once["sizes"]["load"] == twice["sizes"]["load"] == [size]
    assert max(map(abs, twice["policy"]["inputs"][0])) > 1.5 * size
    assert answers.response("problem=two-mass&load=80:0:0.25")["sizes"]["load"] == [0.25]


@pytest.mark.evidence
def test_several_links_have_a_row_of_periodic_control() -> None:
    """At the refined traffic of the policy, with the cost that a trade-off states; or the reason why there is none."""
    answers, setting = Answers(), Setting(file=TWO_LINKS)
    refined = answers.point(setting.text, True)
    assert refined["beside"]
    assert refined["periodic"] is None
    expected = clocks_of_links(setting.base(), refined["traffic"]["value"])
    assert answers.beside(setting.text)["periodic"]["value"] == expected.cost
    with pytest.raises(ProblemError, match="ideal links, which deliver every packet"):
        answers.beside(setting.to({"links.gauge.loss": 0.1}).text)


def test_a_file_in_an_address_reads_no_file_of_this_machine(tmp_path: Path) -> None:
    """The same text is read if the command line has named it."""
    source = (Path(taciturn.__file__).parent / "problems" / "pendulum-on-a-cart.toml").read_text(encoding="utf-8")
    assert "function" in source
    setting = Setting(file=source)
    with pytest.raises(ProblemError, match="has the key function"):
        setting.base()
    folder = str(Path(taciturn.__file__).parent / "problems")
    assert setting.base(Trusted(source, folder, "mine.toml")).nonlinear
    nested = source.replace("function", "other") + '\n[reference]\nfile = "/etc/hostname"\n'
    assert tomllib.loads(nested)
    with pytest.raises(ProblemError, match="has the key file"):
        Setting(file=nested).base()
    plain = (Path(taciturn.__file__).parent / "problems" / "two-mass.toml").read_text(encoding="utf-8")
    for key in ("histogram", "trace"):
        for law in (f'{{{key} = "/etc/hostname"}}', f'{{states = [1, {{{key} = "/etc/hostname"}}]}}'):
            with pytest.raises(ProblemError, match=f"has the key {key}, which names a file on this machine"):
                Setting(file=f"{plain}[network]\nactuator_delay = {law}\n").base()
        with pytest.raises(ProblemError, match="is not a key that an address may change"):
            setting_of(f"problem=two-mass&network.actuator_delay.{key}=/etc/hostname")


def test_delays_that_a_problem_states_have_controls() -> None:
    """Steps or seconds, of the usual nodes or of others; a moved one changes the problem; the page states them."""
    plain = (Path(taciturn.__file__).parent / "problems" / "two-mass-continuous.toml").read_text(encoding="utf-8")
    setting = Setting(file=plain + "[network]\nactuator_delay = {seconds = 0.004}\nsensor_buffer = 2\n")
    base = setting.base()
    found = {one.key: one for one in controls_of(setting, base) if one.group == "Network"}
    seconds, steps = found["network.actuator_delay.seconds"], found["network.sensor_buffer"]
    assert (seconds.form, seconds.value, steps.form, steps.value, steps.low) == ("ratio", 0.004, "whole", 2, 1)
    moved = setting.to({seconds.key: 0.01, steps.key: 1}).problem(base).network.links
    assert (moved["actuator"].wait, moved["sensor"].wait) == ((0, 0.01), (1, 0.0))
    assert not any("delay" in one.key for one in controls_of(Setting(name="two-mass"), taciturn.load("two-mass")))
    links = Answers().network(setting.text)["links"]
    assert [one["delay"] for one in links] == ["delay 4 ms"]


@pytest.mark.parametrize("name", ["two-mass", "pid-tank", "quadruple-tank"])
def test_a_path_without_events_is_that_of_simulate(name: str) -> None:
    """Bit for bit, also over several links."""
    problem = taciturn.load(name)
    loop = problem.close(problem.design())
    ours, theirs = run_path(loop, 100, 5), taciturn.simulate(loop, 100, seed=5)
    np.testing.assert_array_equal(ours.inputs, theirs.input)
    assert {link: sent.tolist() for link, sent in ours.sent.items()} == {
        link: sent.tolist() for link, sent in theirs.sends.items()
    }


def test_an_event_changes_nothing_before_it() -> None:
    """A load moves the output by its static gain in the end; a dropped packet is sent and does not arrive."""
    problem = taciturn.load("pid-tank")
    loop = problem.close(problem.design())
    plain = run_path(loop, 400, 5)
    (link,) = plain.sent
    step = int(np.flatnonzero(plain.sent[link])[20])
    dropped = run_path(loop, 400, 5, [Event("drop", step, link)])
    np.testing.assert_array_equal(dropped.outputs[: step + 1], plain.outputs[: step + 1])
    assert dropped.sent[link][step]
    assert not dropped.arrived[link][step]
    assert (dropped.outputs[step + 1 :] != plain.outputs[step + 1 :]).any()
    loaded = run_path(loop, 400, 5, [Event("load", 50, "0", 0.5)])
    np.testing.assert_array_equal(loaded.outputs[:51], plain.outputs[:51])
    late = slice(250, 400)  # the controller integrates: its input takes the load away
    assert loaded.inputs[late].mean() - plain.inputs[late].mean() == pytest.approx(-0.5, abs=0.05)
    with pytest.raises(ProblemError, match="expected one of 0"):
        run_path(loop, 100, 5, [Event("load", 5, "1", 0.5)])


def test_every_answer_of_a_setting_is_data_of_the_library() -> None:
    """The point has the digits of ``evaluate``, and a curve those of its parameter."""
    answers = Answers()
    settled = answers.settle("problem=two-mass", {"policy.theta": 0.1}, {})
    point = answers.point(settled["text"], False)
    expected = taciturn.evaluate(taciturn.load("two-mass").changed({"theta": 0.1}), steps=400_000)
    assert point["cost"]["text"] == str(expected.cost)
    assert point["traffic"]["text"] == str(expected.traffic)
    along = answers.along(settled["text"], "")
    assert along is not None
    on = answers.curve_point(along["text"], along["key"], along["value"])
    steps = taciturn.evaluate(taciturn.load("two-mass").changed({"theta": along["value"]}), steps=100_000)
    assert on["cost"] == steps.cost.value
    assert settled["curve"] == "problem=two-mass"


@pytest.mark.evidence
def test_a_point_of_a_curve_is_an_evaluation_of_a_loop_that_has_settled() -> None:
    """With more steps where it needs them; a point that does not settle is not drawn."""
    answers = Answers()
    along = answers.along("problem=two-mass", "send-on-delta")
    assert along is not None
    point = answers.curve_point(along["text"], along["key"], along["value"])
    assert 0 < point["share"] < 1
    assert 0 < point["error"] <= 0.002 * point["cost"]
    along = answers.along("problem=pid-tank", "distributed")
    assert along is not None
    assert answers.curve_point(along["text"], along["key"], 1.0)["share"] > 0
    assert answers.curve_point(along["text"], along["key"], 1e8)["share"] is None


@pytest.mark.parametrize("name", ["two-mass", "pid-tank"])
def test_a_load_moves_the_plant_from_its_step_on(name: str) -> None:
    """As an input that is larger by the load would, until a node answers; a dropped packet does not arrive."""
    problem = taciturn.load(name)
    loop = problem.close(problem.design())
    alone, plant = run_path(loop, 12, 0), loop.problem.plant
    loaded = run_path(loop, 12, 0, [Event("load", 5, "0", 3.0)])
    assert (loaded.outputs[:6] == alone.outputs[:6]).all()
    pushed, first = plant.B[:, 0] * 3.0, 6
    while not (plant.C[: plant.sensed] @ pushed).any():  # until an output shows it, no node answers
        pushed, first = plant.A @ pushed + plant.B[:, 0] * 3.0, first + 1
    assert loaded.outputs[first] - alone.outputs[first] == pytest.approx(plant.C[: plant.sensed] @ pushed, rel=1e-9)
    step = int(np.flatnonzero(alone.sent["actuator"])[2])
    dropped = run_path(loop, 12, 0, [Event("drop", step, "actuator", 1.0)])
    assert not dropped.arrived["actuator"][step]
    assert (dropped.outputs[: step + 1] == alone.outputs[: step + 1]).all()
