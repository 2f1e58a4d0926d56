"""``taciturn new``: what is asked, what is written, and what is refused."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import time
import tomllib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from cli.conftest import Ask, Run
from numpy.typing import ArrayLike
from terminals import in_a_terminal

import taciturn
from taciturn import ProblemError
from taciturn.design.catalogue import CATALOGUE
from taciturn_new.draft import Draft, offered_kinds

WALK = ("continuous", "[0 1; 0 0]", "[0; 1]", "yes")  # a double integrator, as far as its noise
STEP = ("discrete", "0.5", "1.1", "1", "yes", "0.1", "2", "1")  # a scalar, as far as its cost


def test_answers_become_a_file_that_evaluate_runs(ask: Ask, run: Run) -> None:
    """Usual values where nothing is answered; every key stands below what it means."""
    told = ask((*WALK, "[0 0; 0 2.5]", "", "10", "", "1", "", ""))
    assert told.code == 0
    assert told.out.endswith("written: new.toml\nnext: taciturn show new.toml, taciturn evaluate new.toml\n")
    text = Path("new.toml").read_text(encoding="utf-8")
    assert tomllib.loads(text) == {
        "plant": {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "W": [[0, 0], [0, 2.5]]},
        "cost": {"Q": [[1, 0], [0, 1]], "R": [[10]]},
        "policy": {"kind": "excess", "period": 0.4, "theta": 0.1, "actuation": "model"},
    }
    lines = text.splitlines()
    for above, line in pairwise(lines):
        assert "=" not in line or line.startswith("#") or above.startswith("# ") or line.startswith("kind")
    assert "# noise w: intensity per second, in the units of the states squared\nW = " in text
    assert "# share θ ≥ 0, for δ = θ(J_all − c)" in text
    answer = run("evaluate", "new.toml", "--steps", "20000", "--confidence", "0", "--json")
    assert answer.code == 0


@pytest.mark.parametrize(
    ("A", "W"),
    [
        ("[1 0.5; 0 1]", "[0.1 0; 0 0.1]"),
        ("[1, 0.5; 0, 1];", "0.1"),
        ("[[1, 0.5], [0, 1.]]", "[0.1 0.1]"),
        ("1 0.5; 0 1", "[[0.1], [0.1]]"),
        ("[1 0.5\n0 1]", "[0.1, 0.1]"),
        ("[1 ...\n 0.5\n 0 1]", "[0.1; 0.1]"),
        ("[[1, 0.5],\n [0, 1]]", "[[1e-1, 0], [0, 1e-1]]"),
    ],
)
def test_matrices_are_taken_as_matlab_and_python_write_them(ask: Ask, A: str, W: str) -> None:
    """A number is that times the identity, a vector a diagonal; brackets may close on a later line."""
    assert ask(("d", "1", A, "[0.5; 1]", "y", W, "1", "1", "", "1", "")).code == 0
    plant = tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))["plant"]
    assert plant == {"dt": 1, "A": [[1, 0.5], [0, 1]], "B": [[0.5], [1]], "W": [[0.1, 0], [0, 0.1]]}


@pytest.mark.parametrize(
    ("goal", "kind"),
    [
        ("1", "excess"),
        pytest.param("2", "near-optimal", marks=pytest.mark.evidence),
        ("3", "lqg"),
        ("4", "remote-lqg"),
        ("5", "send-on-delta"),
        ("6", "lossy-lqg"),
        ("excess", "excess"),
    ],
)
def test_the_goal_picks_the_policy(ask: Ask, goal: str, kind: str) -> None:
    """By its number in the list, or by its name; what fits the plant is listed."""
    told = ask((*STEP, "", goal, "0.3", "0.3"))
    assert told.code == 0
    assert "consistent" not in told.out  # which wants a continuous plant
    assert tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))["policy"]["kind"] == kind


def test_a_margin_with_less_traffic_is_written_as_the_guide_advises(ask: Ask) -> None:
    """The actuator predicts."""
    assert ask((*STEP, "", "excess", "0.3")).code == 0
    assert taciturn.load("new.toml").parameters == {"theta": 0.3, "actuation": "model"}


def test_help_lists_the_questions_in_their_order(run: Run) -> None:
    """All of them, so that answers can be got ready."""
    words = run("new", "--help").out.split()
    places = [words.index(word) for word in ("dt;", "A;", "B;", "V;", "W;", "Q;", "R;", "network", "goal,")]
    assert places == sorted(places)


def test_lossy_links_are_asked_for_and_have_their_policy(ask: Ask) -> None:
    """With the price of a send that is suggested: a fifth of what a step costs, to a digit."""
    assert ask((*STEP, "udp", "0.2", "0.4", "")).code == 0
    problem = taciturn.load("new.toml")
    assert (problem.kind, problem.network) == ("lossy-lqg", taciturn.Network("udp", 0.2, 0.4))
    always = taciturn.design.all_time(problem.plant, problem.cost).cost_all_time
    assert problem.parameters["price"] == pytest.approx(0.2 * always, rel=0.3)
    assert f"{problem.parameters['price']:.1g}" == f"{problem.parameters['price']:g}"


def test_outputs_with_noise_are_asked_for(ask: Ask) -> None:
    """C and V; a V of 0 is exact measurement and is not written."""
    answers = ("c", "[0 1; 0 0]", "[0; 1]", "n", "[1 0]", "0.01", "1", "1", "1", "", "1", "0.1", "0.1")
    assert ask(answers).code == 0
    plant = tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))["plant"]
    assert (plant["C"], plant["V"]) == ([[1, 0]], [[0.01]])
    Path("new.toml").unlink()
    assert ask(tuple("0" if answer == "0.01" else answer for answer in answers)).code == 0
    assert "V" not in tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))["plant"]


@pytest.mark.parametrize(
    ("answers", "sentence"),
    [
        (("sometimes",), "the time base is 'sometimes'; expected one of continuous, discrete"),
        (("d", "-1"), "dt is -1; expected 0 < dt"),
        (("d", "fast"), "dt is 'fast'; expected a finite number"),
        (("c", "[1 2; 3]"), "A is '[1 2; 3]'; expected a number, or a matrix as [1 2; 3 4] or [[1, 2], [3, 4]]"),
        (("c", "[1 x; 3 4]"), "A is '[1 x; 3 4]'; expected a number, or a matrix as"),
        (("c", "import os"), "A is 'import os'; expected a number, or a matrix as"),
        (("c", "[]"), "A is '[]'"),
        (("c", "[1 nan; 3 4]"), "A contains nan at index (0, 1); expected finite numbers"),
        (("c", "[1 2]"), "A has shape (1, 2); expected a square matrix with at least one state"),
        (("c", ""), "A is missing; expected an answer, because there is no default"),
        (("c", "[0 1; 0 0]", "[0 1]"), "B has shape (1, 2); expected (2, any) = (states, inputs). Did you pass its"),
        (("c", "[1 0; 0 1]", "[0; 1]"), "(A, B) is not stabilisable: no input can move the mode at 1"),
        (("c", "1", "1", "maybe"), "what is measured is 'maybe'; expected one of yes, no"),
        (("c", "[1 0; 0 2]", "[1; 1]", "n", "[1 0]"), "(A, C) is not detectable"),
        (("c", "1", "1", "n", "1", "-1"), "V has the eigenvalue -1; expected a positive semidefinite matrix"),
        ((*WALK, "[1 2 3]"), "W is 1×3; expected one number, 2 for a diagonal, or a matrix 2×2"),
        ((*WALK, "[1 2; 3 4]"), "W is not symmetric"),
        ((*WALK, "1", "-1"), "Q has the eigenvalue -1; expected a positive semidefinite matrix"),
        ((*WALK, "1", "1", "-1"), "R has the eigenvalue -1; expected a positive semidefinite matrix"),
        ((*WALK, "1", "1", "1", "wifi"), "the network is 'wifi'; expected ideal, tcp or udp"),
        ((*WALK, "1", "1", "1", "udp"), "the network is udp, but the policy for this network, lossy-lqg, requires"),
        ((*STEP, "udp", "1.5"), "actuator_loss is 1.5; expected 0 ≤ actuator_loss ≤ 1"),
        ((*STEP, "", "9"), "the goal is 9; expected a number from 1 to 6, or a policy kind"),
        ((*STEP, "", "lgq"), "the kind is 'lgq'; expected one of absolute, all-time"),
        ((*STEP, "", "1", "much"), "policy.theta is 'much'; expected a number"),
        ((*STEP, "", "1", "-1"), "new.toml: policy.theta is -1; expected 0 ≤ theta"),
        ((*STEP, "", "periodic", "1.5"), "policy.every is 1.5; expected a whole number"),
        (
            (*STEP, "", "consistent"),
            "the plant is discrete in time, but consistent predicts in continuous time; expected",
        ),
        (
            (*WALK, "1", "1", "1", "", "lossy-lqg"),
            "the plant is continuous in time, and its sampling gives a cross weight that lossy-lqg does not support",
        ),
        ((*STEP, "", "1"), "the input ends before theta is given; expected one more answer; no file was written"),
        (("c", "[0 1; 0 0", "1"), "the input ends before A is given; expected one more answer; no file was written"),
        ((), "the input ends before the time base is given; expected one more answer; no file was written"),
    ],
)
def test_from_a_pipe_the_first_answer_that_does_not_fit_ends_it(
    ask: Ask, answers: tuple[str, ...], sentence: str
) -> None:
    """In one sentence, and no file was written."""
    told = ask(answers)
    assert (told.code, told.err.count("\n")) == (2, 1)
    assert told.err.startswith(f"taciturn: {sentence}")
    assert "no file was written" in told.err
    assert list(Path().iterdir()) == []


def test_at_a_terminal_it_is_asked_again(ask: Ask) -> None:
    """The sentence, and the same question; a policy that is not for the plant asks for another."""
    answers = (
        "discrete",
        "0",
        "1",
        "[1 2]",
        "1.1",
        "1",
        "y",
        "-1",
        "0.1",
        "1",
        "1",
        "",
        "consistent",
        "1",
        "-1",
        "1",
        "0.2",
    )
    told = ask(answers, patient=True)
    assert (told.code, told.err) == (0, "")
    for sentence in (
        "dt is 0; expected 0 < dt",
        "A has shape (1, 2); expected a square matrix",
        "W has the eigenvalue -1",
        "consistent predicts in continuous time",
        "theta is -1; expected 0 ≤ theta",
    ):
        assert sentence in told.out
    assert taciturn.load("new.toml").parameters == {"theta": 0.2, "actuation": "model"}


def test_a_kind_that_is_not_for_the_plant_is_told_before_its_parameters_are_asked(ask: Ask) -> None:
    """From a pipe that is the end, at a terminal another one is asked for."""
    told = ask(STEP, "--kind", "integral")
    assert told.err.startswith("taciturn: the plant is discrete in time, but integral predicts in continuous time; ex")
    assert ask((*STEP, "", "1", ""), "--kind", "integral", patient=True).code == 0
    assert taciturn.load("new.toml").kind == "excess"


@pytest.mark.parametrize("dt", [0.0, 0.5])
@pytest.mark.parametrize("more", [{}, {"C": [[1.0, 0.0]], "V": 0.1}, {"N": [[0.1], [0.0]]}])
def test_the_kinds_that_are_listed_are_those_that_can_be_designed(dt: float, more: dict[str, ArrayLike]) -> None:
    """For plants of either time, with outputs and with a cross weight; no kind is listed or refused by another rule."""
    draft = Draft(dt=dt)
    for key, value in {
        "A": [[0.9, 0.2], [0.0, 0.8]],
        "B": [[0.0], [1.0]],
        "W": 1.0,
        "Q": 1.0,
        "R": 1.0,
        **more,
    }.items():
        draft.keep(key, value)
    needed = {
        "lqg": {"theta": 0.1},
        "excess": {"theta": 0.1},
        "near-optimal": {"price": 1.0},
        "consistent": {},
        "lossy-lqg": {"price": 1.0},
    }
    needed |= {"remote-lqg": {"theta": 0.1, "zeta": 0.1}, "send-on-delta": {"delta": 0.1}}
    for kind in (one.name for one in offered_kinds()[0]):
        period = {"period": 0.2} if kind == "consistent" or (kind != "lossy-lqg" and not dt) else {}
        try:
            CATALOGUE[kind].design(draft.made_plant(), draft.made_cost(), **needed[kind], **period)
            designed = True
        except ProblemError:
            designed = False
        assert draft.fits(CATALOGUE[kind]) == designed, kind


def test_a_network_that_no_policy_bears_is_asked_for_again(ask: Ask) -> None:
    """As is what matters."""
    told = ask(
        ("discrete", "0.5", "3", "1", "yes", "0.1", "2", "1", "udp", "0.9", "0", "0.1", "ideal", "1", "0.2"),
        patient=True,
    )
    assert told.code == 0
    assert "mean-square stability allows actuator losses below 0.111111" in told.out
    problem = taciturn.load("new.toml")
    assert (problem.kind, problem.network) == ("excess", taciturn.Network())


def test_the_end_of_the_answers_ends_it_at_a_terminal_too(ask: Ask) -> None:
    """Ctrl-D is no answer that could be asked for again."""
    told = ask(("d",), patient=True)
    assert told.err == "taciturn: the input ends before dt is given; expected one more answer; no file was written\n"
    assert (told.code, list(Path().iterdir())) == (2, [])


def test_nothing_is_overwritten(ask: Ask) -> None:
    """Before anything is asked."""
    Path("new.toml").write_text("mine", encoding="utf-8")
    told = ask(())
    assert told.sentence == "new.toml already exists; expected the name of a new file: files are not overwritten"
    assert Path("new.toml").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--kind", "lgq"), "Did you mean 'lqg'?"),
        (("--dt", "-1"), "--dt is -1; expected 0 ≤ --dt"),
        (("--yes",), "--yes is given without --from; expected both options, or neither of them"),
    ],
)
def test_options_that_do_not_fit_are_refused_before_anything_is_asked(
    ask: Ask, options: tuple[str, ...], words: str
) -> None:
    """In one sentence."""
    assert words in ask((), *options).sentence


@pytest.mark.parametrize("name", ["new.txt", "folder.toml", "nowhere/new.toml"])
def test_a_file_that_cannot_be_written_is_refused_before_anything_is_asked(ask: Ask, run: Run, name: str) -> None:
    """Another ending, a folder, a folder that is not there."""
    ask(())
    Path("folder.toml").mkdir()
    assert "expected" in run("new", name).sentence


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals here")
def test_at_a_real_terminal_ctrl_c_leaves_nothing(tmp_path: Path) -> None:
    """A wrong answer is asked again; Ctrl-C ends with a sentence, exit code 130 and an empty folder."""
    above, below = pty.openpty()
    command = [sys.executable, "-m", "taciturn", "new"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdin=below, stdout=below, stderr=below, start_new_session=True, preexec_fn=_control
    ) as process:
        os.close(below)
        shown = ""
        for question, typed in (("continuous]: ", "often\n"), ("continuous]: ", "c\n"), ("3 4]: ", "\x03")):
            shown += _told(above, question)
            time.sleep(0.3)  # the answer is waited for by now
            os.write(above, typed.encode())
        shown += _told(above)
        os.close(above)
        if "interrupted" not in shown:
            process.kill()
        assert process.wait(30) == 130, shown
    assert "the time base is 'often'; expected one of continuous, discrete" in shown
    assert "interrupted; no file was written" in shown
    assert "Traceback" not in shown
    assert list(tmp_path.iterdir()) == []


def _told(terminal: int, until: str | None = None) -> str:
    """Return what is told up to a question, or to the end; at most for 30 seconds."""
    told, last = "", time.monotonic() + 30
    while until is None or until not in told:
        if not select.select([terminal], [], [], max(0.0, last - time.monotonic()))[0]:
            break
        try:
            more = os.read(terminal, 4096)
        except OSError:  # nobody is at the other end
            break
        if not more:
            break
        told += more.decode(errors="replace")
    return told


def _control() -> None:
    """Make the terminal that of the new session, so that Ctrl-C reaches it, whoever runs the tests."""
    import fcntl
    import termios

    in_a_terminal()
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


def test_numbers_are_written_to_their_last_digit(ask: Ask) -> None:
    """What is read back is what was typed."""
    third = repr(1 / 3)
    assert ask(("d", third, f"[{third} 1e-17; 0 0.7]", "[1 0; 0 1]", "y", "1", "1", "1", "", "1", "")).code == 0
    plant = taciturn.load("new.toml").plant
    assert np.array_equal(plant.A, [[1 / 3, 1e-17], [0, 0.7]])
    assert isinstance(plant, taciturn.Plant)
    assert plant.dt == 1 / 3
