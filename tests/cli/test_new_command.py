"""``taciturn new``: what is asked, what is written, and what is refused."""

from __future__ import annotations

import os
import pty
import re
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

WALK = ("continuous", "[0 1; 0 0]", "[0; 1]", "all", "0")  # a double integrator, as far as its noise
STEP = ("discrete", "0.5", "1.1", "1", "all", "0", "0.3", "lqg", "0.7", "1", "none")  # a scalar, up to the policy


def test_answers_become_a_file_that_evaluate_runs(ask: Ask, run: Run) -> None:
    """Usual values where nothing is answered; every key stands below what it means."""
    told = ask((*WALK, "[0 0; 0 2.5]", "", "", "[10]", "", "1", "", ""))
    assert told.code == 0
    assert told.out.endswith(
        "written: new.toml\nnext, in seconds:  taciturn show new.toml\n                   taciturn evaluate new.toml\n"
        "up to minutes:     taciturn tradeoff new.toml --plot new.svg\n"
    )
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
        ("[1, 0.5; 0, 1];", "[0.1]"),
        ("[[1, 0.5], [0, 1.]]", "[0.1 0.1]"),
        ("1 0.5; 0 1", "[[0.1], [0.1]]"),
        ("[1 0.5\n0 1]", "[0.1, 0.1]"),
        ("[1 ...\n 0.5\n 0 1]", "[0.1; 0.1]"),
        ("[[1, 0.5],\n [0, 1]]", "[[1e-1, 0], [0, 1e-1]]"),
    ],
)
def test_matrices_are_taken_as_matlab_and_python_write_them(ask: Ask, A: str, W: str) -> None:
    """In brackets, a number is that times the identity, a vector a diagonal; they may close on a later line."""
    assert ask(("d", "1", A, "[0.5; 1]", "all", "0", W, "", "1", "1", "", "1", "")).code == 0
    plant = tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))["plant"]
    assert plant == {"dt": 1, "A": [[1, 0.5], [0, 1]], "B": [[0.5], [1]], "W": [[0.1, 0], [0, 0.1]]}


@pytest.mark.parametrize(
    ("noise", "W"),
    [
        ("0.3", [[0.09, 0], [0, 0.09]]),
        ("0.3 0.1", [[0.09, 0], [0, 0.01]]),
        ("± 0.3, 0.1", [[0.09, 0], [0, 0.01]]),
        ("inputs 0.2", [[0.01, 0.02], [0.02, 0.04]]),
        ("inputs ± 0.2", [[0.01, 0.02], [0.02, 0.04]]),
    ],
)
def test_noise_is_stated_by_standard_deviations(ask: Ask, noise: str, W: list[list[float]]) -> None:
    """As acceptable sizes are for weights: 1/size² in front of the square of an output or an input."""
    answers = ("d", "1", "[1 0.5; 0 1]", "[0.5; 1]", "2 1", "0.1 0.2", noise, "", "0.5 2", "0.25", "", "excess", "")
    assert ask(answers).code == 0
    tables = tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))
    assert tables["plant"]["C"] == [[0, 1], [1, 0]]
    assert tables["plant"]["V"] == [[0.01, 0], [0, 0.04]]
    assert np.allclose(tables["plant"]["W"], W, rtol=1e-12)
    assert (tables["cost"]["Q"], tables["cost"]["R"]) == ([[0.25, 0], [0, 4]], [[16]])


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
    told = ask((*STEP, goal, "0.3", "0.3"))
    assert told.code == 0
    assert "consistent" not in told.out  # which wants a continuous plant
    assert tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))["policy"]["kind"] == kind


def test_a_margin_with_less_traffic_is_written_as_the_guide_advises(ask: Ask) -> None:
    """The actuator predicts."""
    assert ask((*STEP, "excess", "0.3")).code == 0
    assert taciturn.load("new.toml").parameters == {"theta": 0.3, "actuation": "model"}


def test_help_lists_the_questions_in_their_order(run: Run) -> None:
    """All of them, so that answers can be got ready."""
    words = run("new", "--help").out.split()
    places = [words.index(word) for word in ("dt;", "A;", "B;", "measured,", "LQG", "wireless", "losses,", "goal,")]
    assert places == sorted(places)


def test_lossy_links_are_asked_for_and_have_their_policy(ask: Ask) -> None:
    """With the price of a send that is suggested: a fifth of what a step costs, to a digit."""
    assert ask((*STEP[:-1], "losses", "0.2", "0.4", "no", "1", "")).code == 0
    problem = taciturn.load("new.toml")
    assert (problem.kind, problem.network) == ("lossy-lqg", taciturn.Network("udp", 0.2, 0.4))
    always = taciturn.design.all_time(problem.plant, problem.cost).cost_all_time
    assert problem.parameters["price"] == pytest.approx(0.2 * always, rel=0.3)
    assert f"{problem.parameters['price']:.1g}" == f"{problem.parameters['price']:g}"


def test_outputs_with_noise_are_asked_for(ask: Ask) -> None:
    """C and V; a V of 0 is exact measurement and is not written."""
    answers = ("c", "[0 1; 0 0]", "[0; 1]", "[1 0]", "0.1", "1", "", "1", "1", "", "1", "0.1", "0.1")
    assert ask(answers).code == 0
    plant = tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))["plant"]
    assert (plant["C"], plant["V"]) == ([[1, 0]], [[0.01]])
    Path("new.toml").unlink()
    assert ask((*answers[:4], "0", *answers[5:])).code == 0
    assert "V" not in tomllib.loads(Path("new.toml").read_text(encoding="utf-8"))["plant"]


@pytest.mark.parametrize(
    ("answers", "sentence"),
    [
        (("sometimes",), "the time base is 'sometimes'; expected one of the answers continuous, discrete"),
        (("d", "-1"), "dt is -1; expected 0 < dt"),
        (("d", "fast"), "dt is 'fast'; expected a finite number"),
        (
            ("c", "[1 2; 3]"),
            "A is '[1 2; 3]'; expected a number, or a matrix in the form [1 2; 3 4] or [[1, 2], [3, 4]]",
        ),
        (("c", "[1 x; 3 4]"), "A is '[1 x; 3 4]'; expected a number, or a matrix in the form"),
        (("c", "import os"), "A is 'import os'; expected a number, or a matrix in the form"),
        (("c", "[]"), "A is '[]'"),
        (("c", "[1 nan; 3 4]"), "A contains the number nan at index (0, 1); expected an array of finite numbers"),
        (("c", "[1 2]"), "A has shape (1, 2); expected a square matrix with at least one state"),
        (("c", ""), "A is missing; expected an answer, because there is no default"),
        (
            ("c", "[0 1; 0 0]", "[0 1]"),
            "B has shape (1, 2); expected the shape (2, any) = (states, inputs). Did you pass its",
        ),
        (
            ("c", "[1 0; 0 1]", "[0; 1]"),
            "(A, B) is not stabilisable: no input affects the growing mode with the eigenvalue 1",
        ),
        (("c", "1", "1", "maybe"), "the measured signals is 'maybe'; expected numbers from 1 to 1, such as 1"),
        (("c", "[1 0; 0 2]", "[1; 1]", "1"), "(A, C) is not detectable"),
        (
            ("c", "[1 0; 0 2]", "[1; 1]", "1 1"),
            "the measured signals is '1 1'; expected a list that contains each number only once",
        ),
        (("c", "1", "1", "all", "-1"), "the standard deviation of V is -1; expected at least 0"),
        (("c", "1", "1", "all", "[-1]"), "V has the eigenvalue -1; expected a positive semidefinite matrix"),
        ((*WALK, "1 2 3"), "the standard deviation of W has 3 numbers; expected one number, or 2, one for each state"),
        ((*WALK, "inputs 1 2"), "the standard deviation of W has 2 numbers; expected one number"),
        (
            (*WALK, "[1 2 3]"),
            "W is a matrix of size 1×3; expected one number, 2 numbers for a diagonal matrix, or a 2×2 matrix",
        ),
        ((*WALK, "[1 2; 3 4]"), "W is not symmetric"),
        ((*WALK, "1", "", "[-1]"), "Q has the eigenvalue -1; expected a positive semidefinite matrix"),
        ((*WALK, "1", "", "0"), "the acceptable size of Q is 0; expected more than 0"),
        ((*WALK, "1", "", "1", "[-1]"), "R has the eigenvalue -1; expected a positive semidefinite matrix"),
        ((*WALK, "1", "mpc"), "the controller is 'mpc'; expected one of the answers lqg, pid, gain, matrices, file"),
        (
            (*STEP[:-1], "wifi"),
            "the part is 'wifi'; expected one or several of the answers nodes, losses, batteries, set-points, ",
        ),
        ((*STEP[:-1], "2", "1.5"), "the loss of actuator is 1.5; expected 0 ≤ the loss of actuator ≤ 1"),
        ((*STEP, "9"), "the goal is 9; expected a number from 1 to 6, or a policy kind"),
        ((*STEP[:-1], "losses", "0.9", "0", "no", "lossy-lqg", "1"), "new.toml: the loop is not mean-square stable: n"),
        ((*STEP, "lgq"), "the kind is 'lgq'; expected one of the policy kinds absolute, all-time"),
        ((*STEP, "1", "much"), "policy.theta is 'much'; expected a number"),
        ((*STEP, "1", "-1"), "new.toml: policy.theta is -1; expected 0 ≤ theta"),
        ((*STEP, "periodic", "1.5"), "policy.every is 1.5; expected a whole number"),
        (
            (*STEP, "consistent"),
            "the plant is discrete in time, but the policy kind consistent predicts in continuous time;",
        ),
        (
            (*WALK, "1", "", "1", "1", "", "lossy-lqg"),
            "the plant is continuous in time, and its sampling gives a cross weight that the policy kind",
        ),
        ((*STEP, "1"), "the input ends before theta is given; expected one more answer; no file was written"),
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
    plant = ("discrete", "0", "1", "[1 2]", "1.1", "1", "all", "0", "-1", "0.1")
    told = ask((*plant, "", "1", "1", "", "consistent", "1", "-1", "1", "0.2"), patient=True)
    assert (told.code, told.err) == (0, "")
    for sentence in (
        "dt is 0; expected 0 < dt",
        "A has shape (1, 2); expected a square matrix",
        "the standard deviation of W is -1; expected at least 0",
        "the policy kind consistent predicts in continuous time",
        "theta is -1; expected 0 ≤ theta",
    ):
        assert sentence in " ".join(told.out.split())
    assert taciturn.load("new.toml").parameters == {"theta": 0.2, "actuation": "model"}


def test_at_a_terminal_questions_are_explained_answers_taken_back_and_the_result_evaluated(ask: Ask) -> None:
    """By ? and back; a pipe takes both as answers, and has no first evaluation."""
    told = ask((*STEP[:6], "?", "5", "back", "0.3", *STEP[7:], "1", "0.2"), patient=True)
    assert (told.code, told.err) == (0, "")
    assert "Unknown influences, such as gusts" in told.out
    assert re.search(r"first evaluation: \S+ % of the packets, ", told.out)
    assert pytest.approx(0.09) == taciturn.load("new.toml").plant.W
    Path("new.toml").unlink()
    assert "A is '?'; expected a number" in ask(("d", "1", "?")).err
    assert "A is 'back'; expected a number" in ask(("d", "1", "back")).err


def test_every_explanation_is_a_whole_sentence(ask: Ask) -> None:
    """Of the first question and of the last one, whose text is the note of a parameter with alternatives."""
    for kind in (CATALOGUE[name] for name in CATALOGUE):
        assert not [note for note in kind.notes.values() if note.endswith((" or", ";", ","))]
    told = ask((*STEP[:-1], "batteries", "?", "", "", "", "excess", "?", "0.2"), patient=True)
    assert (told.code, told.err) == (0, "")
    assert "has no more explanation" not in told.out
    assert "how long the battery lasts" in " ".join(told.out.split())


def test_a_kind_that_is_not_for_the_plant_is_told_before_its_parameters_are_asked(ask: Ask) -> None:
    """From a pipe that is the end, at a terminal another one is asked for."""
    told = ask(STEP, "--kind", "integral")
    assert told.err.startswith(
        "taciturn: the plant is discrete in time, but the policy kind integral predicts in continuous time; ex"
    )
    assert ask((*STEP[:10], *STEP[10:], "1", ""), "--kind", "integral", patient=True).code == 0
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
    for kind in (one.name for one in offered_kinds()[0] if one.nodes != "any"):
        period = {"period": 0.2} if kind == "consistent" or (kind != "lossy-lqg" and not dt) else {}
        try:
            CATALOGUE[kind].design(draft.made_plant(), draft.made_cost(), **needed[kind], **period)
            designed = True
        except ProblemError:
            designed = False
        assert draft.fits(CATALOGUE[kind]) == designed, kind


def test_losses_that_no_policy_bears_are_asked_for_again(ask: Ask) -> None:
    """With the other parts of the problem, if no policy is left; else another policy is asked for."""
    wired = ("discrete", "0.5", "1.1", "1", "all", "0", "0.3", "gain", "0.5")
    told = ask((*wired, "losses", "0.1", "0.2", "no", "losses", "0.1", "0", "no", "lqg", "1", "0.2"), patient=True)
    assert told.code == 0
    words = " ".join(told.out.split())
    assert (
        "no policy accepts these parts: network.sensor_loss is given, but no node of the policy excess receives a"
        in words
    )
    assert "the policy kind 'lqg' cannot use a controller of your own; expected another kind, such as 'excess'" in words
    problem = taciturn.load("new.toml")
    assert (problem.kind, problem.network.links["actuator"].loss) == ("excess", 0.1)


def test_the_end_of_the_answers_ends_it_at_a_terminal_too(ask: Ask) -> None:
    """Ctrl-D is no answer that could be asked for again."""
    told = ask(("d",), patient=True)
    assert told.err == (
        "taciturn: the input ends before dt is given; expected one more answer; no file was written; the answers are "
        "in new.answers: taciturn new new.toml --answers new.answers continues\n"
    )
    assert told.code == 2
    assert Path("new.answers").read_text(encoding="utf-8") == "d\n"
    told = ask(("0.5", *STEP[2:], "1", "0.2"), "--answers", "new.answers", patient=True)
    assert (told.code, told.err) == (0, "")
    assert "continuous in time" not in told.out
    assert taciturn.load("new.toml").plant.dt == 0.5
    Path("new.toml").unlink()
    assert "--answers 'no.answers' cannot be read (No such file" in ask((), "--answers", "no.answers").sentence


def test_a_kept_answer_that_does_not_fit_is_asked_again(ask: Ask) -> None:
    """And those after it, which may be answers to other questions, are left out."""
    Path("kept").mkdir()
    Path("kept/bad.answers").write_text("d\nfast\n0.25\n", encoding="utf-8")
    told = ask(("0.5", *STEP[2:], "1", "0.2"), "--answers", "kept/bad.answers", patient=True)
    assert (told.code, told.err) == (0, "")
    assert "dt is 'fast'; expected a finite number" in told.out
    assert taciturn.load("new.toml").plant.dt == 0.5


def test_nothing_is_overwritten(ask: Ask) -> None:
    """Before anything is asked."""
    Path("new.toml").write_text("mine", encoding="utf-8")
    told = ask(())
    assert (
        told.sentence == "the file new.toml already exists; expected the name of a new file: files are not overwritten"
    )
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


@pytest.mark.parametrize("name", ["new", "new.txt", "folder.toml", "nowhere/new.toml"])
def test_a_file_that_cannot_be_written_is_refused_before_anything_is_asked(ask: Ask, run: Run, name: str) -> None:
    """Another ending, a folder, a folder that is not there."""
    ask(())
    Path("folder.toml").mkdir()
    assert "expected" in run("new", name).sentence


@pytest.mark.evidence
@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals here")
def test_at_a_real_terminal_ctrl_c_keeps_the_answers(tmp_path: Path) -> None:
    """A wrong answer is asked again; Ctrl-C ends with a sentence, exit code 130 and a file of answers."""
    above, below = pty.openpty()
    command = [sys.executable, "-m", "taciturn", "new"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdin=below, stdout=below, stderr=below, start_new_session=True, preexec_fn=_control
    ) as process:
        os.close(below)
        shown = ""
        for question, typed in (("continuous]: ", "often\n"), ("continuous]: ", "c\n"), ("-0.5]: ", "\x03")):
            shown += _told(above, question)
            time.sleep(0.3)  # the answer is waited for by now
            os.write(above, typed.encode())
        shown += _told(above)
        os.close(above)
        if "interrupted" not in shown:
            process.kill()
        assert process.wait(30) == 130, shown
    assert "the time base is 'often'; expected one of the answers continuous, discrete" in shown
    assert "interrupted; no file was written; the answers are in problem.answers: taciturn new problem.toml" in shown
    assert "Traceback" not in shown
    assert [path.name for path in tmp_path.iterdir()] == ["problem.answers"]
    assert (tmp_path / "problem.answers").read_text(encoding="utf-8") == "c\n"


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
    plant = ("d", third, f"[{third} 1e-17; 0 0.7]", "[1 0; 0 1]", "all", "0", "1", "")
    assert ask((*plant, "1", "1", "", "1", "")).code == 0
    plant = taciturn.load("new.toml").plant
    assert np.array_equal(plant.A, [[1 / 3, 1e-17], [0, 0.7]])
    assert isinstance(plant, taciturn.Plant)
    assert plant.dt == 1 / 3
