"""``taciturn channel`` as a user runs it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from cli.conftest import COST, PLANT, Run, Write
from counts import few
from terminals import in_a_terminal

import taciturn

SENDS = ["--copies", "20", "--capacity", "4", "--steps", "2000"]


@pytest.mark.evidence
def test_it_prints_one_document(run: Run) -> None:
    """Sum of the costs, the bound below it, the load within the capacity, the best clock above it."""
    answer = run("channel", "wiener-double-integrator", *SENDS, "--json")
    assert answer.code == 0
    found = json.loads(answer.out)
    assert found["cost_all_time"] < found["cost_lower_bound"] < found["cost"]["value"] < found["cost_periodic"]
    assert found["load"]["value"] <= 4
    assert found["load_expected"]["value"] == pytest.approx(4, rel=0.03)
    assert (found["loops"], found["capacity"], found["scheduler"]) == (20, 4, "price")
    assert found["consistent"] is True
    assert found["problems"][0]["copies"] == 20


@pytest.mark.parametrize("scheduler", few(["largest", "round-robin", "tdma", "once-discard", "random-access"], start=1))
def test_every_scheduler_prints_what_it_cost(run: Run, scheduler: str) -> None:
    """The sum of the costs in words and in a table, above a table of the problems."""
    answer = run("channel", "wiener-double-integrator", *SENDS, "--scheduler", scheduler)
    assert answer.code == 0
    assert f"scheduler      {scheduler}" in answer.out
    assert answer.out.startswith("20 loops, at most 4 sends per step: ")
    assert "lower bound, any scheduler" in answer.out
    assert ["wiener-double-integrator", "20"] in [line.split()[:2] for line in answer.out.splitlines()]


@pytest.mark.evidence
def test_loops_of_two_periods_share_their_common_tick(run: Run, tmp_path: Path) -> None:
    """The pendulums look at every step of 20 ms, the double integrators at every fifth."""
    picture = tmp_path / "shares.svg"
    names = ["inverted-pendulum", "wiener-double-integrator"]
    answer = run(
        "channel", *names, "--copies", "6,10", "--capacity", "3", "--scheduler", "tdma", "--steps", "2000", "--plot",
        str(picture),
    )  # fmt: skip
    assert answer.code == 0
    assert picture.read_text(encoding="utf-8").startswith("<?xml")
    assert any(line.split()[:2] == ["inverted-pendulum", "6"] for line in answer.out.splitlines())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--copies", "20", "--capacity", "0"], "capacity is 0; expected"),
        (
            ["--copies", "20", "--capacity", "21"],
            "capacity is 21, but the channel has only 20 loops; expected at most 20",
        ),
        (["--copies", "0", "--capacity", "1"], "copies is 0"),
        (["--copies", "2,3", "--capacity", "1"], "copies has 2 numbers for 1 problem"),
        (["--copies", "many", "--capacity", "1"], "--copies is 'many'"),
        (["--copies", "20", "--capacity", "4", "--scheduler", "prize"], "scheduler is 'prize'; expected"),
        (["--copies", "20", "--capacity", "4", "--steps", "3"], "--steps is 3"),
        ([*SENDS, "--standard-error", "1"], "standard_error and steps=2000 are both given"),
    ],
)
def test_bad_wishes_are_refused(run: Run, arguments: list[str], words: str) -> None:
    """One sentence that says what, got, and what is expected."""
    assert words in run("channel", "wiener-double-integrator", *arguments).sentence


def test_loops_without_a_common_tick_are_refused(run: Run, write: Write, tmp_path: Path) -> None:
    """Periods whose ratio is no fraction of small numbers, a plant without a time base, and other units of cost."""
    first, other = Path(write()), tmp_path / "other.toml"
    text = first.read_text(encoding="utf-8")
    other.write_text(text.replace("dt = 1.0", "dt = 0.7071067811865476"), encoding="utf-8")
    share = ["--copies", "10", "--capacity", "4"]
    assert "the steps have different lengths" in run("channel", str(first), str(other), *share).sentence
    wiener = (Path(taciturn.__file__).parent / "problems" / "wiener-double-integrator.toml").read_text(encoding="utf-8")
    other.write_text(wiener.replace("period = 0.1", "period = 0.07071067811865476"), encoding="utf-8")
    told = run("channel", "wiener-double-integrator", str(other), *share).sentence
    assert "the pattern does not repeat within" in told
    assert "one unit" in run("channel", str(first), "wiener-double-integrator", *share).sentence
    assert "policy.period is missing" in run("channel", write(PLANT.replace("dt = 1.0\n", "")), *share).sentence


def test_a_loop_that_gets_too_little_is_named_with_what_it_needs(run: Run, write: Write) -> None:
    """An error that grows by half per check cannot wait its turn among a hundred."""
    text = write(PLANT.replace("1.2", "1.5"))
    refused = run("channel", text, "--copies", "100", "--capacity", "2", "--scheduler", "round-robin").sentence
    assert "the loops of problem are unstable" in refused
    assert "sends only 0.02 times per check" in refused
    assert "expected at least 0.0" in refused


def test_a_network_or_jumps_are_refused(run: Run, write: Write) -> None:
    """The channel is the network, and errors that jumps move have no known best schedule."""
    lossy = write(more='[network]\nprotocol = "udp"\nactuator_loss = 0.1\n', policy='[policy]\nkind = "all-time"\n')
    share = ["--copies", "10", "--capacity", "4"]
    assert "the shared channel replaces the network" in run("channel", lossy, *share).sentence
    nodes = run("channel", "quadruple-tank", *share).sentence
    assert nodes.endswith(
        "[nodes] is given, but the shared channel replaces the network; expected a problem without [nodes]"
    )
    jumps = Path(write()).with_name("jumps.toml")
    jumps.write_text(
        "[plant]\nA = [[0.0]]\nB = [[1.0]]\n[plant.jumps]\nrate = 1.0\ncovariance = [[1.0]]\n"
        '[cost]\nQ = [[1.0]]\nR = [[1.0]]\n[policy]\nkind = "consistent"\nperiod = 0.1\n',
        encoding="utf-8",
    )
    assert "plant.jumps is given" in run("channel", str(jumps), *share).sentence


@pytest.mark.evidence
def test_workers_print_what_one_process_prints(run: Run) -> None:
    """Two processes work on the kinds; all numbers but the seconds are the same bits."""
    names = ["wiener-double-integrator", "inverted-pendulum"]
    share = ["--copies", "6,4", "--capacity", "2", "--steps", "2000", "--json"]
    found = [json.loads(run("channel", *names, *share, "--workers", workers).out) for workers in ("1", "2")]
    for one in found:
        del one["seconds"]
    assert found[0] == found[1]


def alive(process: str) -> bool:
    """Tell whether a process runs, and is not only still listed."""
    try:
        return Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.evidence
@pytest.mark.skipif(sys.platform != "linux", reason="children are read from /proc")
def test_ctrl_c_ends_it_with_all_its_workers(tmp_path: Path) -> None:
    """One line on standard error, the exit code of an interrupt, and nobody left behind."""
    names = [str(tmp_path / f"plant{i}.toml") for i in range(6)]
    for i, name in enumerate(names):
        text = PLANT.replace("1.2", f"1.{i + 1}") + COST + '[policy]\nkind = "all-time"\n'
        Path(name).write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "taciturn", "channel", *names, "--copies", "20", "--capacity", "60"]
    running = subprocess.Popen(
        [*command, "--workers", "2"],
        preexec_fn=in_a_terminal,
        start_new_session=True,
        stderr=subprocess.PIPE,
        text=True,
    )
    children, told = Path(f"/proc/{running.pid}/task/{running.pid}/children"), ""
    while len(workers := children.read_text(encoding="utf-8").split()) < 3 and running.poll() is None:
        time.sleep(0.01)  # two, and the one that counts semaphores
    time.sleep(1.0)
    os.killpg(running.pid, signal.SIGINT)
    _, told = running.communicate(timeout=60)
    assert (running.returncode, told) == (130, "taciturn: interrupted\n")
    until = time.monotonic() + 30
    while (left := [worker for worker in workers if alive(worker)]) and time.monotonic() < until:
        time.sleep(0.01)
    assert not left
