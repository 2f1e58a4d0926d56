"""Recordings of nodes: what their silence has cost, the path with every sample, and sentences about bad logs."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from functools import cache
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from counts import few
from drawn import law
from hypothesis import strategies as st
from runtime.silent import CASES, TANK, Simulated, Walk, build, problem_of, simulate, write_logs

import taciturn
from taciturn import ProblemError, cli
from taciturn.nodes.node import Node
from taciturn.study.recorded import Recorded, recorded_silence
from taciturn_udp.logs import log_line

TICKS = 80
LOSSLESS = [name for name in CASES if "losses" not in name and name != "rounded"]
SETTINGS = [part for key, value in TANK.items() for part in ("--set", f"{key}={json.dumps(value)}")]
command_of = cache(typer.main.get_command)
Lines = list[dict[str, Any]]


@cache
def path_of(name: str) -> Simulated:
    """Return a path of a loop."""
    return simulate(build(name), TICKS, 1)


def logs_of(name: str, folder: Path) -> list[Path]:
    """Return the logs of all nodes on this path."""
    return write_logs(build(name), path_of(name), folder)


def lines_of(file: Path) -> Lines:
    """Return the lines of a log."""
    return [json.loads(row) for row in file.read_text(encoding="utf-8").splitlines()]


def write(file: Path, lines: Lines) -> Path:
    """Write a log."""
    file.write_text("".join(f"{json.dumps(line)}\n" for line in lines), encoding="utf-8")
    return file


@pytest.mark.parametrize("name", few(LOSSLESS, 3))
def test_a_recording_shows_the_path_with_every_sample(name: str, tmp_path: Path) -> None:
    """It is that of a simulation that sends every sample, on the same noise and with the same set-points."""
    found = recorded_silence(problem_of(name), logs_of(name, tmp_path))
    problem = problem_of(name).changed({"theta": 0.0})
    path, every = path_of(name), simulate(problem.close(problem.design()), TICKS, 1)
    assert all(sent.all() for sent in every.sent.values())
    assert np.array_equal(path.points, every.points)
    for signal, told, base in (("y", path.y, every.y), ("u", path.applied, every.applied)):
        assert not np.allclose(told, base, rtol=1e-3)
        for i in range(told.shape[1]):
            assert np.array_equal(found.outputs[f"{signal}{i + 1}"], told[:, i])
            size = np.abs(base[:, i]).max() + np.abs(told[:, i]).max()
            assert np.abs(found.outputs[f"{signal}{i + 1}_every_sample"] - base[:, i]).max() <= 1e-9 * size
    assert np.array_equal(found.times, np.arange(TICKS))
    assert [*found.columns()] == ["tick", *found.outputs]


@pytest.mark.parametrize("name", few(["held", "relative", "threshold", "predicted", "operating point"], 2))
def test_both_costs_and_the_certificate_are_those_of_the_path(name: str, tmp_path: Path) -> None:
    """By hand from the signals; the certificate bounds the difference of the roots and the ratio."""
    found, path = recorded_silence(problem_of(name), logs_of(name, tmp_path)), path_of(name)
    level = 2.0 if name == "operating point" else 0.0
    every = found.outputs["y1_every_sample"], found.outputs["u1_every_sample"]
    by_hand = [np.mean((y - level) ** 2 + 0.05 * u**2) for y, u in ((path.y[:, 0], path.applied[:, 0]), every)]
    assert found.cost == pytest.approx(by_hand[0])
    assert found.cost_every_sample == pytest.approx(by_hand[1])
    certificate = found.certificate
    assert certificate is not None
    assert {life.links: life.total for life in certificate.lives} == {k: v[-1] for k, v in path.total.items()}
    assert {life.links: life.steps for life in certificate.lives} == {k: v[-1] for k, v in path.lasted.items()}
    assert certificate.duration == TICKS
    assert certificate.root == pytest.approx(sum(sqrt(total[-1] / TICKS) for total in path.total.values()))
    assert 0 < abs(sqrt(by_hand[0]) - sqrt(by_hand[1])) <= certificate.root
    totals = [np.sqrt(total / np.arange(1, TICKS + 1)) for total in path.total.values()]
    assert found.roots == pytest.approx(sum(totals))
    assert found.ratios[-1] == pytest.approx(certificate.at_most)
    assert certificate.at_most is not None
    assert by_hand[0] <= certificate.at_most * by_hand[1]


@law(3, 40, seed=st.integers(0, 2**31), first=st.integers(1, TICKS))
def test_every_part_of_a_recording_from_the_start_is_certified(
    tmp_path_factory: pytest.TempPathFactory, seed: int, first: int
) -> None:
    """A recording of any length, of any path."""
    path = simulate(build("held"), TICKS, seed)
    found = recorded_silence(problem_of("held"), write_logs(build("held"), path, tmp_path_factory.mktemp("l"), first))
    assert found.certificate is not None
    assert found.cost is not None
    assert found.cost_every_sample is not None
    assert abs(sqrt(found.cost) - sqrt(found.cost_every_sample)) <= found.certificate.root * (1 + 1e-9)


def test_the_cost_of_a_continuous_plant_is_no_mean_of_samples(tmp_path: Path) -> None:
    """So the certificate gives no ratio; its time is in seconds."""
    found = recorded_silence(problem_of("two valves"), logs_of("two valves", tmp_path))
    assert found.certificate is not None
    assert (found.certificate.duration, found.certificate.at_most) == (2.0 * TICKS, None)
    assert found.unit == "second at the sampling instants"
    assert found.cost is not None


def test_with_losses_the_certificate_ends_before_the_last_step(tmp_path: Path) -> None:
    """Whose acknowledgements have not arrived."""
    found, path = recorded_silence(problem_of("losses"), logs_of("losses", tmp_path)), path_of("losses")
    assert found.certificate is not None
    assert found.certificate.duration == TICKS - 1
    assert {life.links: life.total for life in found.certificate.lives} == {k: v[-2] for k, v in path.total.items()}
    assert found.cost is None
    assert found.notes == ("no path with every sample: links drop packets, and logs do not tell when a node learns it",)


def test_set_points_that_change_leave_no_cost(tmp_path: Path) -> None:
    """The cost counts deviations from them."""
    found = recorded_silence(problem_of("set-points"), logs_of("set-points", tmp_path))
    assert found.certificate is not None
    assert (found.cost, found.certificate.at_most) == (None, None)
    assert "set-points and disturbances" in found.notes[0]


def test_a_range_of_gains_widens_the_certificate_and_a_note_names_the_plant(tmp_path: Path) -> None:
    """The nodes add up the computed cost, and the certificate has the factor of its effect."""
    problem = problem_of("held").changed({"gain_range": [0.8, 1.2]})
    loop = problem.close(problem.design())
    found = recorded_silence(problem, write_logs(loop, simulate(loop, TICKS, 1), tmp_path))
    assert found.certificate is not None
    factors = [life.factor for life in found.certificate.lives]
    assert min(factors) > 1.01
    roots = [factor * sqrt(life.total / TICKS) for factor, life in zip(factors, found.certificate.lives, strict=True)]
    assert found.certificate.root == pytest.approx(sum(roots))
    assert found.notes == (
        "the path with every sample is that of the stated plant, not of every plant within gain_range",
    )


def test_rounded_packets_leave_neither_certificate_nor_path(tmp_path: Path) -> None:
    """The nodes do not count what rounding adds."""
    found = recorded_silence(problem_of("rounded"), logs_of("rounded", tmp_path))
    assert (found.certificate, found.cost, found.outputs) == (None, None, {})
    assert found.notes == ("no certificate: packets contain rounded numbers (int16)",)
    assert "certificate" not in found.document()
    assert "no certificate: packets" in str(found)


def walked(folder: Path, at: int, *roles: str, missed: int = 0) -> Recorded:
    """Return what a recording says in which nodes start again without their state, perhaps some steps later."""
    loop, walk = build("held"), Walk(build("held"), path_of("held"))
    lines: dict[str, Lines] = {role: [] for role in walk.nodes}
    for tick in range(TICKS):
        if tick == at:
            for role in roles:
                walk.nodes[role] = Node(loop.policy, role, epoch=9)
        for _, role, _, y, done in walk.steps([tick]):
            if not (role in roles and at <= tick < at + missed):
                measured = None if y is None else tuple(y)
                lines[role].append(log_line(walk.nodes[role], measured, done.packets, done.input, {}, None))
    return recorded_silence(problem_of("held"), [write(folder / role, lines[role]) for role in lines])


def test_a_sensor_that_starts_again_at_once_has_two_lives(tmp_path: Path) -> None:
    """Each with its own root; the path with every sample is not told."""
    found, path = walked(tmp_path, 50, "gauge"), path_of("held")
    assert found.certificate is not None
    first, second, valve = found.certificate.lives
    assert (first.links, first.total, first.steps) == (("gauge",), path.total["gauge",][49], 50)
    assert (second.links, second.steps, valve.steps) == (("gauge",), 30, 80)
    assert second.total < path.total["gauge",][-1]
    assert found.certificate.root == pytest.approx(sum(sqrt(life.total / TICKS) for life in (first, second, valve)))
    assert "has lost its state" in found.notes[0]


def cut(lines: Lines, at: int, to: int) -> Lines:
    """Return lines of which some are missing."""
    return [line for line in lines if not at <= line["tick"] < to]


def test_a_node_that_has_not_counted_all_its_silence_leaves_no_certificate(tmp_path: Path) -> None:
    """The controller has lost the state of the loop; an actuator its input; a sensor was away for some steps."""
    for i, (roles, missed, words) in enumerate(
        [
            (("plc",), 0, "the plc lost its state before step 50"),
            (("valve",), 0, "the valve lost its state before step 50"),
            (("gauge",), 3, "the gauge lost its state before step 53"),
        ]
    ):
        (tmp_path / str(i)).mkdir()
        found = walked(tmp_path / str(i), 50, *roles, missed=missed)
        assert found.certificate is None
        assert f"no certificate: {words}" in found.notes
        assert found.cost_every_sample is None


def test_events_that_no_theory_covers_leave_no_certificate(tmp_path: Path) -> None:
    """Such as a late packet at a node that does not decide."""
    gauge, plc, valve = logs_of("held", tmp_path)
    lines = lines_of(valve)
    for line in lines[30:]:
        line["reasons"] = {"late": 2}
    found = recorded_silence(problem_of("held"), [gauge, plc, write(valve, lines)])
    assert found.certificate is None
    assert found.notes == ("no certificate: the valve reports events that no theory covers: late (2)",)


def test_missing_lines_of_a_life_leave_a_certificate_and_no_path(tmp_path: Path) -> None:
    """A sum contains the steps of lines that are missing, at the beginning, too."""
    gauge, plc, valve = logs_of("held", tmp_path)
    whole = recorded_silence(problem_of("held"), [gauge, plc, valve]).certificate
    write(gauge, cut(lines_of(gauge), 30, 40))
    found = recorded_silence(problem_of("held"), [gauge, plc, valve])
    assert found.certificate is not None
    assert whole is not None
    assert found.certificate.lives == whole.lives
    assert found.notes == ("no path with every sample: the logs do not have the same steps without a gap",)
    for file in (gauge, plc, valve):
        write(file, cut(lines_of(file), 0, 40))
    later = recorded_silence(problem_of("held"), [gauge, plc, valve])
    assert later.certificate is not None
    assert (later.certificate.lives, later.steps) == (whole.lives, TICKS - 40)
    assert "not recorded from its start on" in later.notes[0]


def test_the_nodes_that_decide_are_enough_for_a_certificate(tmp_path: Path) -> None:
    """Logs may be in parts, in any order; without the actuator, its inputs are not known."""
    gauge, plc, _ = logs_of("held", tmp_path)
    lines = lines_of(gauge)
    parts = [write(tmp_path / "2", lines[40:]), write(tmp_path / "1", lines[:40])]
    found = recorded_silence(problem_of("held"), [*parts, plc])
    assert found.certificate is not None
    assert len(found.certificate.lives) == 2
    assert found.notes == (
        "no path with every sample: a sample, or the log of a node that measures or applies, is missing",
    )
    with pytest.raises(
        ProblemError, match="the log of the node 'plc', which decides when to send on a link, is missing"
    ):
        recorded_silence(problem_of("held"), [gauge])
    with pytest.raises(ProblemError, match="logs of gauge go back from step 79 to step 0"):
        recorded_silence(problem_of("held"), [gauge, gauge, plc])


def test_a_policy_without_a_bound_on_every_path_is_refused(tmp_path: Path) -> None:
    """Its nodes do not measure what silence costs."""
    with pytest.raises(ProblemError, match="the nodes of the policy lqg do not measure the cost of silence"):
        recorded_silence(taciturn.load("two-mass-lqg"), [tmp_path])


def asked(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *logs: Path) -> tuple[int, str, str]:
    """Return exit code, output and message of ``taciturn show pid-tank --record LOG``."""
    monkeypatch.setattr(typer.main, "get_command", command_of)
    given = [part for log in logs for part in ("--record", str(log))]
    monkeypatch.setattr(sys, "argv", ["taciturn", "show", "pid-tank", *SETTINGS, *given])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    code = ended.value.code
    assert isinstance(code, int)
    return code, *capsys.readouterr()


def change(**changes: Any) -> Callable[[Lines], str]:
    """Return what changes entries of the line 11 of a log."""

    def changed(lines: Lines) -> str:
        lines[10] |= changes
        return "\n".join(map(json.dumps, lines))

    return changed


def memory(name: str, value: Any) -> Callable[[Lines], str]:
    """Return what changes a signal in the line 11 of a log."""

    def changed(lines: Lines) -> str:
        return change(memory={**lines[10]["memory"], name: value})(lines)

    return changed


NO_LINE = "line 11 of "
BAD: dict[str, tuple[Callable[[Lines], str | bytes], str]] = {
    "nothing": (lambda _: "", "is empty"),
    "empty lines": (lambda _: "\n\n \n", "is empty"),
    "binary": (lambda _: bytes(range(256)), "it is not UTF-8 text"),
    "text": (lambda _: "level 3\nlevel 4\n", "line 1 of "),
    "another form of JSON": (lambda _: "[1, 2]\n", "line 1 of "),
    "one huge line": (lambda _: "x" * 10**6, "line 1 of "),
    "two huge lines": (lambda _: ("x" * 10**6 + "\n") * 2, "line 1 of "),
    "deep": (lambda _: ("[" * 10**5 + "\n") * 2, "line 1 of "),
    "a gap in the middle": (lambda lines: "\n".join(["", *map(json.dumps, lines)]), "line 1 of "),
    "a step that is none": (change(tick=-1), NO_LINE),
    "a step that is true": (change(tick=True), NO_LINE),
    "a step beyond all": (change(tick=10**400), NO_LINE),
    "steps that go back": (change(tick=3), "the logs of gauge go back from step 9 to step 3"),
    "a role of another problem": (change(role="camera"), NO_LINE),
    "a role that is a list": (change(role=["gauge"]), NO_LINE),
    "another of many loops": (change(loop=1), NO_LINE),
    "no memory": (change(memory=None), NO_LINE),
    "memory that is text": (memory("silence_gauge", ["a"]), NO_LINE),
    "NaN": (memory("silence_gauge", [float("nan")]), NO_LINE),
    "infinity": (memory("silence_gauge", [float("inf")]), NO_LINE),
    "an enormous number": (memory("silence_gauge", [10**400]), NO_LINE),
    "no sum": (memory("silence_gauge", []), "does not have exactly one value"),
    "two sums": (memory("silence_gauge", [1.0, 2.0]), "does not have exactly one value"),
    "no steps": (memory("lasted_gauge", []), "does not have exactly one value"),
    "another policy": (change(fingerprint="0123456789abcdef"), "the log of gauge is that of another policy"),
    "events that are text": (change(reasons="none"), NO_LINE),
    "a measurement that is text": (change(y="high"), NO_LINE),
}  # fmt: skip


@pytest.mark.parametrize("name", few(BAD, 8))
def test_a_bad_log_is_refused_with_one_sentence(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2, nothing on standard output, and no traceback."""
    spoil, words = BAD[name]
    gauge, *rest = logs_of("held", tmp_path)
    text = spoil(lines_of(gauge))
    gauge.write_bytes(text if isinstance(text, bytes) else text.encode())
    code, out, err = asked(monkeypatch, capsys, gauge, *rest)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert err.startswith("taciturn: ")
    assert words in err


@pytest.mark.evidence
def test_files_that_are_none_are_refused_with_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A missing file, a folder, and the log of another policy."""
    gauge, plc, _ = logs_of("held", tmp_path)
    (tmp_path / "tanks").mkdir()
    others: Sequence[tuple[Path, str]] = (
        (tmp_path / "missing", "cannot be read: "),
        (tmp_path, "cannot be read: "),
        (logs_of("two valves", tmp_path / "tanks")[0], "is not a line of a node's log"),
    )
    for other, words in others:
        code, out, err = asked(monkeypatch, capsys, gauge, plc, other)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert words in err
        assert str(other) in err


def test_the_command_reads_logs_whose_last_line_is_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a process leaves it that was killed; also with a byte-order mark and other ends of lines."""
    gauge, plc, valve = logs_of("held", tmp_path)
    text = gauge.read_bytes()
    gauge.write_bytes(b"\xef\xbb\xbf" + text[:-40].replace(b"\n", b"\r\n"))
    code, out, err = asked(monkeypatch, capsys, gauge, plc, valve)
    assert (code, err) == (0, "")
    assert out.startswith(f"in {TICKS} recorded steps: all silence changed √J by at most")
    assert "all silence changed √J by at most" in out
    assert "the logs do not have the same steps" in " ".join(out.split())
