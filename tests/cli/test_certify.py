"""``taciturn certify`` as a user runs it."""

from __future__ import annotations

import json

import pytest
from cli.conftest import Run, Write

import taciturn
from taciturn.study.record import origin


def test_certify_prints_what_is_proved_beside_sending_always(run: Run, write: Write) -> None:
    """One line for each number after the verdict, and the scalar plant vanishes."""
    answer = run("certify", write())
    assert answer.code == 0
    verdict, table, details = answer.out.split("\n\n")
    assert verdict.startswith("proven: at most ")
    assert " more cost than every sample; without noise, decay by " in " ".join(verdict.split())
    heading, *rows = table.splitlines()
    assert heading.split() == ["proved", "every", "sample"]
    assert [line.split()[0] for line in rows] == ["decay", "gain", "cost", "E|x|²"]
    assert [line.split()[0] for line in details.splitlines()] == ["decay", "gain", "cost", "E|x|²", "policy"]
    assert details.splitlines()[0].endswith("factor per step without noise, to 0")
    assert details.splitlines()[-1] == "policy         lqg, 2 states, actions silent, send"


def test_certify_prints_one_document(run: Run, write: Write) -> None:
    """The document holds what the function returns."""
    file = write()
    answer = run("certify", file, "--json")
    assert answer.code == 0
    problem = taciturn.load(file)
    document, found = json.loads(answer.out), taciturn.certify(problem).document() | origin(problem)
    assert document | found | {"seconds": 0.0} == document | {"seconds": 0.0}
    assert len(document["problem_digest"]) == 64
    assert document["cost_all_time"] <= document["cost_bound"] <= 1.5 * document["cost_all_time"] * (1 + 1e-6)
    assert document["decay_all_time"] <= document["decay"] < 1


@pytest.mark.evidence
def test_a_threshold_leaves_a_residual(run: Run, write: Write) -> None:
    """The lines name what the constants of the trigger leave."""
    answer = run("certify", write(policy='[policy]\nkind = "absolute"\nthreshold = 0.2\n'))
    assert "until the cost is at most" in answer.unwrapped
    assert "from noise to the square root of the stage cost, and " in answer.unwrapped


def test_another_plant_is_certified_with_a_note(run: Run, write: Write) -> None:
    """What is proved is proved of the plant that is simulated."""
    actual = "[plant.actual]\nA = [[1.1]]\nB = [[1.0]]\nW = [[0.01]]\ndt = 1.0\n"
    answer = run("certify", write(more=actual))
    assert answer.code == 0
    assert "proved for the simulated plant: the plant is not the one of the design" in answer.unwrapped


@pytest.mark.parametrize(
    ("policy", "words"),
    [
        ('kind = "dynamic"\nsigma = 0.1\nrho = 0.8\ngain = 2.0', "dynamic triggers on credit"),
        ('kind = "periodic"\nevery = 2', "periodic decides by the clock"),
        ('kind = "relative"\nsigma = 20.0', "nothing could be proved for this loop"),
        ('kind = "self-triggered"\nbeta = 1.5\nmax_interval = 4', "makes"),
        ('kind = "lqg"', "policy.theta is missing"),
    ],
)
def test_what_cannot_be_certified_is_one_sentence(run: Run, write: Write, policy: str, words: str) -> None:
    """Exit code 2, one sentence, no traceback, nothing on standard output."""
    sentence = run("certify", write(policy=f"[policy]\n{policy}\n")).sentence
    assert words in sentence
    assert "expected" in sentence or "missing" in sentence


@pytest.mark.evidence
def test_a_policy_without_ticks_is_one_sentence(run: Run, write: Write) -> None:
    """A trigger in continuous time has no map from step to step."""
    plant = "[plant]\nA = [[0.5]]\nB = [[1.0]]\n[plant.jumps]\nrate = 2.0\ncovariance = [[1.0]]\n"
    policy = '[policy]\nkind = "integral"\nslope = 0.05\nalpha = 0.1\nh_max = 2.0\n'
    assert (
        "cannot run as a loop of nodes; expected policy.period"
        in run("certify", write(plant=plant, policy=policy)).sentence
    )


def test_a_missing_file_and_a_missing_solver_are_one_sentence(
    run: Run, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The remedy of the second is the extra."""
    assert "there is no file" in run("certify", "nowhere.toml").sentence

    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr("taciturn_certify.inequalities.import_module", missing)
    assert "pip install 'taciturn[certify]'" in run("certify", write()).sentence
