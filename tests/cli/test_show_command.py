"""``taciturn show``: what is known of a problem before anything runs."""

from __future__ import annotations

import io
import json
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import taciturn
from taciturn.design.catalogue import CATALOGUE
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.riccati import regulate
from taciturn.model.estimate import rounded
from taciturn.model.steps import Send
from taciturn.study.describe import describe
from taciturn_new.draft import example_of

if TYPE_CHECKING:
    from conftest import Run, Write

WALK = "[plant]\nA = [[0, 1], [0, 0]]\nB = [[0], [1]]\nW = [[0.1, 0], [0, 1]]\n"
WEIGHTS = "[cost]\nQ = [[1, 0], [0, 1]]\nR = [[1]]\n"
JUMPS = "[plant]\nA = [[0]]\nB = [[1]]\n[plant.jumps]\nrate = 2\ncovariance = [[0.5]]\n"
ONE = "[cost]\nQ = [[1]]\nR = [[1]]\n"
INTEGRAL = '[policy]\nkind = "integral"\nslope = 0.4\nalpha = 1.0\nh_max = 5.0\n'
SLOW = ("near-optimal", "integral")  # to design: a second


def document(run: Run, *arguments: str) -> dict[str, Any]:
    """Return what ``taciturn show --json`` prints."""
    told = run("show", *arguments, "--json")
    assert (told.code, told.err) == (0, "")
    return json.loads(told.out)


def rows(text: str) -> dict[str, str]:
    """Return what stands behind each name of the details, which follow the verdict."""
    text = re.sub(r"\n {15}(?=[^\s\[])", " ", text)  # of values in several lines
    return {line[:14].strip(): line[15:] for line in text.split("\n\n")[:2][-1].splitlines() if line[:14].strip()}


def test_set_points_that_change_are_shown_as_data(run: Run, tmp_path: Path) -> None:
    """As JSON and as text: steps at random times, and a timetable."""
    text = "[plant]\nA = [[0.9]]\nB = [[1.0]]\nW = [[0.1]]\nC = [[1.0]]\nV = [[0.1]]\ndt = 0.5\n" + ONE
    text += '[policy]\nkind = "excess"\ntheta = 0.1\n[reference]\n'
    (tmp_path / "levels.csv").write_text("0, 1\n20, 3\n50, 1\n", encoding="utf-8")
    expected: dict[str, dict[str, object]] = {
        "steps = {rate = 0.01, covariance = [[4.0]]}": {"rate": 0.01, "covariance": [[4.0]]},
        'file = "levels.csv"': {"times": [0.0, 20.0, 50.0], "values": [[1.0], [3.0], [1.0]]},
    }
    for line, changes in expected.items():
        path = tmp_path / "p.toml"
        path.write_text(text + line, encoding="utf-8")
        assert document(run, str(path))["plant"]["exosystem"]["changes"] == changes
        assert run("show", str(path)).code == 0


def test_outputs_to_be_zero_are_shown_without_the_states_that_there_are_not(run: Run, tmp_path: Path) -> None:
    """With the key outputs alone; a value makes one state."""
    text = "[plant]\nA = [[0.9, 0.1], [0, 0.8]]\nB = [[0], [1]]\nC = [[1, 0]]\ndt = 1.0\n"
    text += "W = [[0.1, 0], [0, 0.1]]\nV = [[1]]\n" + WEIGHTS
    text += '[policy]\nkind = "excess"\ntheta = 0.1\n[reference]\noutputs = [[1.0, 0.0]]\n'
    for line, told, matrices in (
        ("", "none; C_z x is to be zero", {"C_z"}),
        (
            "value = [3.0]",
            "and set-points, 1 state d: d⁺ = S d + noise; C_z x + F d is to be zero",
            {*"SEGWF", "C_z", "start"},
        ),
    ):
        path = tmp_path / "p.toml"
        path.write_text(text + line, encoding="utf-8")
        found = rows(run("show", str(path)).out)
        assert found["disturbances"] == told
        assert {name.removeprefix("d, ") for name in found if name.startswith("d, ")} == matrices
        shown = document(run, str(path))["plant"]["exosystem"]
        assert (shown["outputs"], len(shown["S"])) == ([[1.0, 0.0]], len(line) > 0)


def test_plant_gains_and_guarantee_are_those_of_the_design(run: Run) -> None:
    """The gains are found in the steps; here they are computed from the matrices."""
    problem = taciturn.load("two-mass-lqg")
    plant, cost, policy = problem.plant, problem.cost, problem.design()
    assert isinstance(plant, taciturn.Plant)
    shown = document(run, "two-mass-lqg")
    assert np.allclose(shown["gains"]["L"], regulate(plant.A, plant.B, cost.Q, cost.R, cost.N).L, rtol=1e-12)
    assert np.allclose(shown["gains"]["estimator"], steady_filter(plant.A, plant.C, plant.W, plant.V).gain, rtol=1e-12)
    assert shown["cost_all_time"] == policy.cost_all_time
    assert shown["guarantee"]["cost"] == pytest.approx(1.1 * policy.cost_all_time)
    assert shown["guarantee"]["holds"] is True
    assert np.allclose(sorted(abs(complex(*pole)) for pole in shown["plant"]["poles"]), 1, atol=1e-6)
    silent = shown["decisions"]["send"]["silent"]
    assert silent["signals"] == ["estimate", "candidate", "error"]
    assert np.array_equal(silent["Psi"], policy.decisions["send"].options["silent"].Psi)
    assert shown["diagram"] == policy.diagram().document()


def test_the_text_shows_the_outputs_and_inputs_of_each_node(run: Run, tmp_path: Path) -> None:
    """By number, also of a node with all of them, and the place that nodes share; not of the three usual nodes."""
    nodes = "\n".join([
        "[nodes.level-2]", "measures = [1]", "[nodes.level-1]", "measures = [0]", "[nodes.plc]", "controls = true",
        "[nodes.pumps]", "applies = true", 'site = "plc"',
    ])  # fmt: skip
    plant = "[plant]\nA = [[0.5, 0], [0, 0.5]]\nB = [[1, 0], [0, 1]]\nC = [[1, 0], [0, 1]]\nV = [[1, 0], [0, 1]]\n"
    weights = "W = [[1, 0], [0, 1]]\ndt = 1\n[cost]\nQ = [[1, 0], [0, 1]]\nR = [[1, 0], [0, 1]]\n"
    file = tmp_path / "tanks.toml"
    file.write_text(f'{plant}{weights}{nodes}\n[policy]\nkind = "distributed"\ntheta = 1.0\n', encoding="utf-8")
    found = [" ".join(line.split()) for line in run("show", str(file)).out.splitlines() if line.startswith("node,")]
    assert found == [
        "node, level-2 measures y2",
        "node, level-1 measures y1",
        "node, plc controls",
        "node, pumps applies u1, u2; at the place of plc",
    ]
    assert "node," not in run("show", "two-mass").out


def test_the_text_says_what_the_document_says(run: Run) -> None:
    """Sizes, poles, guarantee, the rule of the link with its symbols and matrices; the diagram stands below."""
    told = run("show", "two-mass-lqg")
    found = rows(told.out)
    assert found["plant"] == "4 states, 1 input, 2 outputs; discrete in time, 0.1 s per step"
    assert found["poles"].startswith("marginally stable: ")
    assert (found["controllable"], found["observable"], found["noise W"]) == ("yes", "yes", "0.01 I (4×4)")
    assert found["guarantee"].startswith("J ≤ (1+θ) J_all, mean-square stable: at most 0.8068")
    policy = taciturn.load("two-mass-lqg").design()
    silent, send = policy.decisions["send"].options.values()
    weight = np.asarray(silent.Psi)[-1, -1]  # of the error e, next to parts of the state and the input
    assert found["link, actuator"].startswith(f"input u; sends when {weight:.3g} e² > 0.01 |x̂|² + ")
    assert f"+ {send.constant:.3g} " in found["link, actuator"]
    assert "e: input without a packet minus computed input" in found["link, actuator"]
    assert told.out.endswith(f"\n\n{policy.diagram().text(legend=False)}\n")


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.evidence) if kind in SLOW else kind for kind in CATALOGUE]
)
def test_every_kind_is_shown(kind: str) -> None:
    """As text and as JSON; the rule of every link, every note and every further decision of its policy is named."""
    found = describe(example_of(CATALOGUE[kind]))
    shown = json.loads(json.dumps(found.document(), allow_nan=False))
    told = "\n".join(f"{name:14s} {text}" for name, text in found.lines())
    policy = found.policy
    assert rows(told)["policy"].split()[0] == shown["policy"] == policy.kind == kind
    rules = [] if found.diagram is None else [link.rule for link in found.diagram.links]
    sending = {link["decision"] for link in (shown["diagram"] or {"links": []})["links"]}
    for name in shown["decisions"].keys() - sending.union(*(rule.follows for rule in rules)):
        assert f"decision, {name}" in told
    words = " ".join(told.split())
    assert all(" ".join(text.split()) in words for rule in rules for text in (rule.sentence, *rule.explained))
    said = " ".join(text for name, text in rows(told).items() if name.startswith(("link", "decision")))
    assert not re.search("_|≠|least value", said)
    links = [] if found.nodes is None else [step for step in found.nodes.steps if isinstance(step, Send)]
    assert [link["link"] for link in (shown["diagram"] or {"links": []})["links"]] == [step.link for step in links]
    assert (shown["diagram"] is None) == (found.nodes is None)
    proved = isinstance(policy, taciturn.Policy) and policy.guarantee is not None
    if isinstance(policy, taciturn.Policy) and policy.guarantee is not None:
        bound = policy.guarantee
        assert rows(told)["guarantee"] == f"{bound.statement}: at most {rounded(bound.cost, 6, 1)} ({bound.source})"
    assert (shown["guarantee"] is None) == (not proved)
    assert all(note in told for note in getattr(policy, "notes", ()))


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("pendulum-by-encoders", "the plant is not linear (A and B are its linearisation): no guarantee holds"),
        ("limited", "inputs are clipped (input_limit): no guarantee holds"),
    ],
)
def test_a_guarantee_that_does_not_hold_is_not_claimed(run: Run, write: Write, file: str, words: str) -> None:
    """Where the loop is not the one of the design."""
    if file == "limited":
        file = write(plant="[plant]\nA = [[1.2]]\nB = [[1.0]]\nW = [[0.01]]\ndt = 1.0\ninput_limit = [9.0]\n")
    found = rows(run("show", file).out)
    assert found["guarantee"] == "none for this loop; for the loop of the design: J ≤ (1+θ) J_all, mean-square stable"
    assert found["every sample"].endswith("; it is that of the loop of the design, and for this loop it is not known")
    shown = document(run, file)
    assert (shown["guarantee"]["holds"], words in shown["notes"]) == (False, True)


def test_modes_that_no_input_moves_are_told(run: Run, write: Write) -> None:
    """And those that no measurement shows; they decay, or the plant is refused."""
    path = write(
        plant="[plant]\nA = [[1.2, 0], [0, 0.5]]\nB = [[1], [0]]\nC = [[1, 0]]\nW = [[1, 0], [0, 1]]\ndt = 1\n",
        cost=WEIGHTS,
    )
    found = rows(run("show", path).out)
    assert found["poles"] == "unstable: 1.2, 0.5"
    assert found["controllable"] == "except for the mode 0.5, which no input moves"
    assert found["observable"] == "except for the mode 0.5, which no measurement shows"
    hardly = write(
        plant="[plant]\nA = [[1.2, 0], [0, 0.5]]\nB = [[1], [1e-13]]\nC = [[1, 1e-13]]\nW = [[1, 0], [0, 1]]\ndt = 1\n",
        cost=WEIGHTS,
    )
    assert rows(run("show", hardly).out)["controllable"] == "yes"  # what hardly moves is moved


def test_a_mode_that_an_input_hardly_moves_counts_as_controllable(run: Run, write: Write) -> None:
    """As in the design, whose gain stabilises it: 1e-12 of a mode in turned coordinates."""
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    A, B = (turn @ np.diag([1.2, -0.5]) @ turn.T).tolist(), (turn @ np.array([[1e-12], [1.0]])).tolist()
    path = write(plant=f"[plant]\nA = {A}\nB = {B}\nW = [[1, 0], [0, 1]]\ndt = 1\n", cost=WEIGHTS)
    assert rows(run("show", path).out)["controllable"] == "yes"


def test_missions_links_and_tables_are_told(run: Run) -> None:
    """Gains by the clock, the network, the schedule of queries."""
    shown = run("show", "rover").out
    rover = rows(shown)
    assert rover["cost"] == "a finite-horizon run of 60 steps of x'Qx + u'Ru per step"
    assert "input = + L × estimate; L:\n               the first of 60, selected by clock:" in shown
    assert rover["link, sensor"].startswith("measurement y; sends at 11 of the first 59 steps")
    lossy = rows(run("show", "lossy-double-integrator").out)
    assert lossy["network"] == "udp (no acknowledgement); sensor drops 60 %, actuator drops 30 %"
    assert lossy["at a rate"] == "at most 63.7761 + 10 (1 − sends per step)"


def test_a_picture_is_written(run: Run, tmp_path: Path) -> None:
    """With the words of the text."""
    picture = tmp_path / "nodes.svg"
    assert f"picture: {picture}" in run("show", "two-mass-lqg", "--plot", str(picture)).out
    assert picture.read_text(encoding="utf-8").startswith("<?xml")


@pytest.mark.evidence
def test_what_has_no_nodes_is_not_drawn(run: Run, tmp_path: Path, write: Write) -> None:
    """And says how it would have some."""
    path = write(plant=JUMPS, cost=ONE, policy=INTEGRAL)
    told = run("show", path, "--plot", str(tmp_path / "nodes.svg"))
    assert told.sentence.startswith(
        "the policy kind integral without policy.period has no nodes that --plot could draw"
    )


def test_a_terminal_without_boxes_gets_plain_ones(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """What its encoding lacks is not escaped into the picture."""
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    monkeypatch.setattr(sys, "stdout", terminal)
    assert run("show", "two-mass-lqg").code == 0
    drawn = terminal.buffer.getvalue().decode("latin-1").split("\n\n")[2]
    assert drawn.isascii()
    assert drawn.startswith("+-----")


@pytest.mark.evidence
def test_the_packets_of_the_nodes_are_printed_for_other_languages(run: Run, write: Write) -> None:
    """``--wire``: one JSON document with fingerprint, packets and computations; refused where there are no nodes."""
    told = run("show", "two-mass", "--wire")
    assert (told.code, told.err) == (0, "")
    found = json.loads(told.out)
    assert [entry["offset"] + entry["bytes"] for entry in found["wire"]["header"]][-1] == 32
    assert [node["role"] for node in found["nodes"]] == ["controller", "actuator"]
    assert found["problem_digest"]
    both = run("show", "two-mass", "--wire", "--plot", "x.svg")
    assert (both.code, both.out) == (2, "")
    assert "--wire and --plot are both given" in both.err
    policy = INTEGRAL
    none = run("show", write(JUMPS, ONE, policy), "--wire")
    assert (none.code, none.out) == (2, "")
    assert "integral without a period is triggered in continuous time and cannot run as a loop of nodes" in none.err
