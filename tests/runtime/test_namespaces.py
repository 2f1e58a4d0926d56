"""The kernel drops packets, and which ones is known before."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from counts import few

import taciturn
from taciturn import Burst, cli
from taciturn.errors import ProblemError
from taciturn.model.network import Network
from taciturn.model.steps import Send
from taciturn.nodes.packet import Packet, Wire
from taciturn_udp.endpoint import Endpoint, parse_address
from taciturn_udp.namespaces import KernelLoss, Namespaces, kernel_losses, predict_drops
from taciturn_udp.result import NetworkRun
from taciturn_udp.run import run_network

POLICY = taciturn.load("lossy-double-integrator").design()
NAMES = Path("/var/run/netns")
ROOT = Path(__file__).parents[2]


@pytest.fixture
def file(tmp_path: Path) -> str:
    """Return the double integrator of chapter 7 without an end, over links that lose 25 and 10 % of the packets."""
    text = (files("taciturn") / "problems" / "lossy-double-integrator.toml").read_text(encoding="utf-8")
    for old, new in (
        ("horizon = 100", ""), ("sensor_loss = 0.6", "sensor_loss = 0.25"),
        ("actuator_loss = 0.3", "actuator_loss = 0.1"),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "chapter7.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def left_behind(pid: int) -> list[str]:
    """Return the namespaces of a process."""
    return [path.name for path in NAMES.glob(f"taciturn-{pid}-*")]


def arriving(loss: KernelLoss, sequences: list[int]) -> tuple[list[int], int, tuple[int, int]]:
    """Send data and marks of these numbers over a sensor's link; return which data came, how many marks, the counts."""
    size = next(sum(POLICY.sizes[name] for name in s.payload) for s in POLICY.steps if isinstance(s, Send))
    wire, got = Wire(POLICY), list[Packet]()
    with Namespaces(POLICY, {"sensor": loss}) as spaces:
        ends: dict[str, Endpoint] = {}
        for place in ("sensor", "controller"):
            with spaces.visit(place):
                ends[place] = Endpoint(parse_address(place, spaces.addresses[place]))
        for k in sequences:
            for packet in (Packet("data", "sensor", 0, k, (0.0,) * size), Packet("mark", "sensor", 0, k)):
                ends["sensor"].send(wire.encode(packet), ends["controller"].address)
            got += [p for p in map(wire.decode, ends["controller"].receive(0.0)) if not isinstance(p, str)]
        while found := ends["controller"].receive(time.monotonic() + 0.1):
            got += [p for p in map(wire.decode, found) if not isinstance(p, str)]
        for endpoint in ends.values():
            endpoint.close()
        counts = spaces.counted("sensor")
    return [p.sequence for p in got if p.kind == "data"], sum(p.kind == "mark" for p in got), counts


def assert_as_predicted(found: NetworkRun, seed: int) -> None:
    """Check every sequence number that came, and four counts of what was lost: of nodes, rule, kernel, and log."""
    for link, loss in kernel_losses(found.loop.network, seed).items():
        counted = found.datagrams[link]
        lost = predict_drops(loss.seed, loss.permille, range(counted["sent"]))
        assert counted["sent"] == found.sends[link].sum() > 0
        assert found.arrived[link] == tuple(np.flatnonzero(~lost))
        assert counted["lost"] == counted["predicted"] == counted["sent"] - len(found.arrived[link])
        again = found.reports["plant"]["measured_again"]  # then all was sent again, and counted by the kernel again
        assert counted["nft_dropped"] == counted["lost"] or (again and counted["nft_dropped"] > counted["lost"])
    nodes = [report for name, report in found.reports.items() if name != "plant"]
    assert [node["counters"].get("late", 0) for node in nodes] == [0] * len(nodes)  # no mark overtook its data
    assert not any("not the" in note for note in found.notes)


@pytest.mark.usefixtures("kernel")
@pytest.mark.parametrize("of", few([(0, 250), (42, 100), (0xFFFFFFFF, 999), (7, 0), (7, 1000)], 2), ids=str)
def test_what_arrives_is_what_the_hash_says(of: tuple[int, int]) -> None:
    """2,000 numbers of all 32 bits through real namespaces: the data that are predicted come, and every mark."""
    seed, permille = of
    sequences = [*range(1200), *range(2**31 - 200, 2**31 + 200), *range(2**32 - 400, 2**32)]
    came, marks, counts = arriving(KernelLoss(seed, permille), sequences)
    lost = predict_drops(seed, permille, sequences)
    assert came == [k for k, drop in zip(sequences, lost, strict=True) if not drop]
    assert marks == len(sequences) == 2000
    assert counts == (2000, lost.sum())


@pytest.mark.parametrize("permille", [1, 100, 250, 900])
def test_the_hash_loses_the_share_that_is_asked_for(permille: int) -> None:
    """Of many seeds and numbers the share lost is within four standard errors of the permille."""
    lost = np.mean([predict_drops(seed, permille, range(5000)) for seed in range(40)])
    share = permille / 1000
    assert abs(lost - share) < 4 * np.sqrt(share * (1 - share) / 200_000)


@pytest.mark.usefixtures("kernel")
@pytest.mark.evidence
def test_a_loop_receives_exactly_what_is_predicted(file: str) -> None:
    """Chapter 7 in lockstep: data, marks and losses in their order, and nothing is left behind."""
    found = run_network(file, steps=400, seed=3, namespaces=True)
    assert_as_predicted(found, 3)
    assert len(found.arrived["sensor"]) > 270
    assert left_behind(os.getpid()) == []


@pytest.mark.evidence
@pytest.mark.usefixtures("kernel")
def test_two_processes_run_from_the_command_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two nodes that share no place with a third, over an ideal link: nothing is lost."""
    monkeypatch.setattr(sys, "argv", ["taciturn", "network", "two-mass-lqg", "--namespaces", "--steps", "50"])
    with pytest.raises(SystemExit, match=r"^0$"):
        cli.main()
    link = re.search(r"link, actuator(.*?)(\n\S|\Z)", capsys.readouterr().out, re.DOTALL)
    assert link
    sent, delivered, *rest = map(int, re.findall(r"\d+", link[1]))
    assert sent == delivered > 0
    assert rest == [0, 50, 0, sent, 0]


@pytest.mark.usefixtures("kernel")
def test_nothing_is_left_behind_by_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither where the block fails, nor where namespaces are there and the rules are refused."""

    def fail() -> None:
        with Namespaces(POLICY, {}):
            assert len(left_behind(os.getpid())) == 4
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert left_behind(os.getpid()) == []
    fake(tmp_path / "nft", "no such expression", monkeypatch, beside=True)
    with pytest.raises(ProblemError, match=r"nft -f -` has failed \(no such expression\); expected .*nftables"):
        Namespaces(POLICY, {"sensor": KernelLoss(1, 1)}).__enter__()
    assert left_behind(os.getpid()) == []


@pytest.mark.usefixtures("kernel")
def test_what_a_killed_run_left_is_removed_by_the_next() -> None:
    """Its namespaces, and the processes in them."""
    code = (
        "import os, subprocess, taciturn\n"
        "from taciturn_udp.namespaces import Namespaces\n"
        "spaces = Namespaces(taciturn.load('lossy-double-integrator').design(), {}).__enter__()\n"
        "orphan = subprocess.Popen([*spaces.before('sensor'), 'sleep', '300'], stdout=subprocess.DEVNULL)\n"
        "while 'sleep' not in open(f'/proc/{orphan.pid}/cmdline').read().split('\\0'): pass\n"
        "print(os.getpid(), orphan.pid, flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=False)
    owner, orphan = map(int, done.stdout.split())
    assert (done.returncode, len(left_behind(owner))) == (-9, 4)
    with Namespaces(POLICY, {}):
        assert left_behind(owner) == []
    state = Path(f"/proc/{orphan}/stat")
    for _ in range(100):
        if not state.exists() or state.read_text(encoding="utf-8").rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("the orphan still runs")


def fake(path: Path, says: str, monkeypatch: pytest.MonkeyPatch, beside: bool = False) -> None:
    """Put a program on the path, alone or first, that says something and fails."""
    path.write_text(f'#!/bin/sh\necho "{says}" >&2\nexit 1\n', encoding="utf-8")
    path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{path.parent}:{os.environ['PATH']}" if beside else str(path.parent))


def test_missing_programs_and_rights_are_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is missing, and what to do."""
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ProblemError, match=r"^the program ip is missing; expected .* iproute2 and nftables$"):
        run_network("two-mass-lqg", steps=10, namespaces=True)
    fake(tmp_path / "ip", "Operation not permitted", monkeypatch)
    with pytest.raises(ProblemError, match=r"^the program nft is missing; expected .* iproute2 and nftables$"):
        run_network("two-mass-lqg", steps=10, namespaces=True)
    fake(tmp_path / "nft", "Operation not permitted", monkeypatch)
    with pytest.raises(ProblemError, match=r"has failed \(Operation not permitted\); expected the rights of root"):
        run_network("two-mass-lqg", steps=10, namespaces=True)


@pytest.mark.evidence
def test_what_is_not_shown_stands_at_the_end_of_a_test_run(tmp_path: Path) -> None:
    """Without the programs the tests of the kernel are skipped, and a line of its own says so."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", __file__, "-k", "hash_says"]
    environment = {**os.environ, "PATH": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=ROOT)
    assert "2 skipped" in done.stdout, done.stdout
    assert re.search(r"^NOT SHOWN: kernel loss; the program ip is missing", done.stdout, re.MULTILINE)


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda: KernelLoss(permille=1001), "permille is 1001; expected a value of at most 1000"),
        (lambda: predict_drops(2**32, 1, []), "seed is 4294967296; expected a value of at most 4294967295"),
        (
            lambda: predict_drops(1, 1, [-1, 5]),
            "'sequences' has numbers from -1 to 5; expected numbers from 0 to 4294967295",
        ),
        (
            lambda: kernel_losses(Network(protocol="udp", sensor_loss=0.1234), 0),
            "sensor_loss is 0.1234; expected a multiple of 0.001",
        ),
        (
            lambda: kernel_losses(Network(protocol="udp", actuator_burst=Burst(0.1, 0.2, 0.0, 0.5)), 0),
            "network.actuator_burst is given, but the kernel cannot drop packets in bursts; expected network",
        ),
        (lambda: run_network("two-mass-lqg", fates={}, namespaces=True), "fates and namespaces are both given"),
    ],
)
def test_what_the_kernel_cannot_lose_is_refused(ask: Callable[[], object], says: str) -> None:
    """Numbers out of range, bursts, parts of a permille, and a relay's fates."""
    with pytest.raises(ProblemError, match=says):
        ask()


@pytest.mark.evidence
@pytest.mark.usefixtures("kernel")
def test_twenty_runs_cost_and_send_what_the_theory_says(file: str) -> None:
    """20 seeds of 3,000 steps: cost and rate within three standard errors of ``evaluate``, packets as predicted."""
    with ThreadPoolExecutor(2) as pool:
        runs = list(pool.map(lambda seed: run_network(file, steps=3000, seed=seed, namespaces=True), range(20)))
    for seed, found in enumerate(runs):
        assert_as_predicted(found, seed)
    expected = taciturn.evaluate(taciturn.load(file), seed=1)
    costs = np.array([found.cost.value for found in runs if found.cost is not None])
    rates = np.array([found.rates["actuator"].value for found in runs])
    for values, known in ((costs, expected.cost), (rates, expected.rates["actuator"])):
        error = np.hypot(values.std(ddof=1) / np.sqrt(len(values)), known.standard_error)
        assert len(values) == 20
        assert abs(values.mean() - known.value) < 3 * error
