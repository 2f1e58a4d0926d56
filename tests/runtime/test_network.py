"""Nodes as processes over UDP: the same run of the same seed, whatever else goes over the network."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from counts import few
from runtime.attacks import CHAPTER_7, KEY, await_ticks, capture, chapter_7, noise, throw
from runtime.loops import by_hand
from runtime.test_nodes import ACKNOWLEDGED

import taciturn
from taciturn.errors import ProblemError
from taciturn_udp.processes import Process, Processes
from taciturn_udp.relay import Fate, losses
from taciturn_udp.result import NetworkRun
from taciturn_udp.run import run_network

Report = Mapping[str, Any]
TICKS = 300
CHANGED = ("theta=1.0",)


def refused(report: Report) -> int:
    """Return the datagrams that were no packets."""
    return sum(report["refused"].values())


def proofs(report: Report) -> int:
    """Return the datagrams that proved that a sender is running, or asked for a proof."""
    return sum(report["proofs"].get(name, 0) for name in ("answered", "proofs", "unasked"))


def assert_added_up(found: NetworkRun) -> None:
    """Check that every datagram is accounted for: at each sender, on each link, at each receiver."""
    for name, report in found.reports.items():
        counters = report.get("counters", {})
        if "kept" in report or name == "plant":
            continue
        assert report["datagrams"]["dropped_by_kernel"] == 0
        if name.startswith("relay"):
            link = name.split()[1]
            sent = sum(
                other["counters"].get(f"{name} data {link}", 0)
                for other in found.reports.values()
                if "counters" in other
                for name in ("sent", "sent again")
            )
            assert counters.get("received", 0) == sent
            copies = counters.get("received", 0) - counters.get("lost", 0) + counters.get("duplicated", 0)
            assert counters.get("delivered", 0) + report["pending"] == copies
            other = sum(counters.get(name, 0) for name in ("marks", "answers", "sent back"))
            assert report["datagrams"]["received"] == counters.get("received", 0) + other
            assert report["datagrams"]["sent"] == counters.get("delivered", 0) + other
            continue
        outcomes = sum(n for what, n in counters.items() if not what.startswith(("sent", "received", "missed")))
        assert counters.get("received", 0) == outcomes + report["waiting"]
        packets = counters.get("received", 0) + report["physical"]
        assert report["datagrams"]["received"] == packets + refused(report) + proofs(report)


@contextmanager
def patient() -> Iterator[None]:
    """Let the plant wait for its nodes, however busy this machine is: what it tells again is counted again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("taciturn_udp.plant.IDLE", 20.0)
        yield


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> NetworkRun:
    """Return a run of 300 steps that nothing disturbs."""
    with patient():
        return run_network(chapter_7(tmp_path_factory.mktemp("quiet")), steps=TICKS, seed=2, key=KEY)


@pytest.mark.evidence
def test_two_sensors_and_two_pumps_run_as_processes() -> None:
    """Five nodes and four relays: the bits of nodes in memory, with a key, losses and acknowledgements on two links."""
    changes = {f"links.{one}.{key}": value for one in ("level-1", "pump-2") for key, value in ACKNOWLEDGED.items()}
    problem = taciturn.load("quadruple-tank").changed(changes)
    with patient():
        found = run_network(problem, steps=TICKS, seed=2, key=KEY)
    assert found.costs.tobytes() == by_hand(problem, TICKS, 2).tobytes()
    assert_added_up(found)
    assert list(found.datagrams) == ["level-1", "level-2", "pump-1", "pump-2"]
    assert [counted["lost"] > 0 for counted in found.datagrams.values()] == [True, False, False, True]


@pytest.mark.evidence
def test_a_run_in_virtual_time_is_that_of_its_seed(tmp_path: Path, quiet: NetworkRun) -> None:
    """Three processes and two relays: the bits of nodes in memory, every datagram accounted for, all of the JSON."""
    assert quiet.costs.tobytes() == by_hand(chapter_7(tmp_path), TICKS, 2).tobytes()
    assert_added_up(quiet)
    lost = quiet.datagrams["sensor"]["lost"]
    again = quiet.datagrams["sensor"]["again"]  # the first packet, after an answer to the challenge that it caused
    assert quiet.datagrams["sensor"] == {
        "sent": TICKS, "delivered": TICKS + again - lost, "lost": lost, "marks": TICKS, "again": again
    }  # fmt: skip
    assert 40 < lost < 110
    document = json.loads(json.dumps(quiet.document()))
    assert {"policy", "unit", "cost", "cost_all_time", "cost_bound", "rates", "datagrams", "seed", "seconds"} <= set(
        document
    )
    assert document["rates"]["actuator"]["value"] == pytest.approx(quiet.sends["actuator"][22:].mean(), abs=0.05)


@pytest.mark.evidence
@pytest.mark.parametrize("case", few([(True, ()), (False, ()), (False, CHANGED)], 1))
def test_nodes_run_for_a_problem_and_a_policy_in_memory_as_for_its_file(case: tuple[bool, Sequence[str]]) -> None:
    """With the same bits; the changes of a problem in memory reach the processes, too."""
    (designed, settings), problem = case, taciturn.load("two-mass-lqg")
    expected = run_network("two-mass-lqg", settings=settings, steps=30, seed=2)
    found = run_network(problem.design() if designed else problem, settings=settings, steps=30, seed=2)
    assert found.costs.tobytes() == expected.costs.tobytes()
    assert found.arrived == expected.arrived


@pytest.mark.evidence
def test_a_run_is_drawn_and_tabled(quiet: NetworkRun) -> None:
    """One row per step, and a picture of costs and sends."""
    table = quiet.to_pandas()
    assert len(table) == len(quiet.costs) == TICKS
    assert table["sent_sensor"].all()
    assert table["cost"].to_numpy().tobytes() == quiet.costs.tobytes()
    assert len(quiet.plot().axes) == 2


LOCATED = """
[plant]
A = [[0.9, 0.2], [0.0, 0.8]]
B = [[0.0], [1.0]]
C = [[1.0, 0.0]]
W = [[0.1, 0.0], [0.0, 0.1]]
V = [[0.2]]
dt = 0.1
input_limit = [[0.0, 9.0]]

[plant.operating_point]
x = [12.4, 3.0]
u = [5.0]

[cost]
Q = [[1.0, 0.0], [0.0, 1.0]]
R = [[0.5]]

[policy]
kind = "excess"
theta = 0.3
"""
DELAYED = CHAPTER_7.replace('protocol = "udp"', 'protocol = "tcp"\ndelay = 1')
BURSTS = (
    CHAPTER_7.replace("actuator_loss = 0.1", "")
    + """
[network.actuator_burst]
to_bad = 0.05
to_good = 0.3
loss_good = 0.01
loss_bad = 0.7
"""
)


def assert_by_hand(folder: Path, problem: str, ticks: int) -> None:
    """Check that processes and nodes in memory cost the same, bit for bit, at every step."""
    if "[plant]" in problem:
        (folder / "problem.toml").write_text(problem, encoding="utf-8")
        problem = str(folder / "problem.toml")
    with patient():
        found = run_network(problem, steps=ticks, seed=2)
    assert found.costs.tobytes() == by_hand(problem, ticks, 2).tobytes()
    assert_added_up(found)


@pytest.mark.parametrize(
    "problem", few(["remote-scalar", "two-mass-lqg", DELAYED], 1, 2), ids=lambda text: text[:16].strip()
)
def test_processes_do_what_nodes_in_memory_do(tmp_path: Path, problem: str) -> None:
    """Whichever node is ahead of another: the same bits as stepping the nodes one after the other."""
    assert_by_hand(tmp_path, problem, 150)


@pytest.mark.evidence
@pytest.mark.parametrize(
    "problem",
    [
        "remote-double-integrator",
        "wiener-double-integrator",
        "inverted-pendulum",
        "double-integrator",
        BURSTS,
        DELAYED,
        LOCATED,
    ],
    ids=["remote", "sampled", "pendulum", "consistent", "bursts", "tcp, delayed", "operating point"],
)
def test_processes_do_what_nodes_in_memory_do_for_long(tmp_path: Path, problem: str) -> None:
    """Every kind of link and place, two thousand steps."""
    horizon = taciturn.load(problem).cost.horizon if "[plant]" not in problem else None
    assert_by_hand(tmp_path, problem, horizon or 2000)


@pytest.mark.evidence
def test_what_a_relay_loses_can_be_told_before(tmp_path: Path, quiet: NetworkRun) -> None:
    """As many packets are lost as the seed names."""
    fate = losses(taciturn.load(chapter_7(tmp_path)).network, 2)["sensor"]
    assert quiet.datagrams["sensor"]["lost"] == sum(fate.lost(k, k) for k in range(TICKS))


@pytest.mark.evidence
def test_attacks_change_nothing(tmp_path: Path, quiet: NetworkRun) -> None:
    """Noise, an old capture, a wrong key, no key and another policy, at once: the same bits, and each counted."""
    file = chapter_7(tmp_path)
    thrown: dict[str, int] = {}

    def attack(processes: Processes) -> None:
        to = processes.addresses["controller"]
        await_ticks(processes, "controller", 50)
        thrown["replayed"] = throw(capture(file, 100, KEY), to, 4000)
        thrown["forged"] = throw(capture(file, 100, bytes(32)), to, 4000)
        thrown["foreign"] = throw(capture(file, 50, None) + capture(file, 50, KEY, price=0.2), to, 4000)
        thrown["noise"] = throw(noise(500, 1), to, 4000)

    found = run_network(file, steps=TICKS, seed=2, key=KEY, meanwhile=attack)
    assert found.costs.tobytes() == quiet.costs.tobytes()
    report = found.reports["controller"]
    handshake = quiet.reports["controller"]["refused"]["unproven"]
    assert report["refused"].pop("unproven") == thrown["replayed"] + handshake
    assert report["refused"]["forged"] == thrown["forged"]
    assert refused(report) == thrown["forged"] + thrown["foreign"] + thrown["noise"]


@pytest.mark.evidence
def test_doubled_packets_change_nothing_and_are_counted(tmp_path: Path, quiet: NetworkRun) -> None:
    """30 % of the packets come twice: the same bits, and as many duplicates as the links have made."""
    file = chapter_7(tmp_path)
    network = taciturn.load(file).network
    fates = {link: Fate(fate.seed, fate.loss, duplicate=0.3) for link, fate in losses(network, 2).items()}
    with patient():
        found = run_network(file, steps=TICKS, seed=2, key=KEY, fates=fates)
    assert found.costs.tobytes() == quiet.costs.tobytes()
    assert_added_up(found)
    assert quiet.nominal
    assert found.document()["cost_bound"] is None
    told = "the actuator link treats packets differently from the network of the design: no guarantee holds"
    assert told in found.notes
    for link, role in (("sensor", "controller"), ("actuator", "actuator")):
        doubled = found.reports[f"relay {link}"]["counters"]["duplicated"]
        assert found.reports[role]["counters"]["duplicate"] == doubled > 15


@pytest.mark.evidence
def test_a_killed_node_rejoins_from_its_state(tmp_path: Path, quiet: NetworkRun) -> None:
    """Every node is killed (SIGKILL) and started again in virtual time: not a bit is lost."""
    killed: list[str] = []

    def kill(processes: Processes) -> None:
        for i, role in enumerate(processes.roles):
            await_ticks(processes, role, 60 * (i + 1))
            processes.running[role].kill()
            processes.start(role)
            killed.append(role)

    found = run_network(chapter_7(tmp_path), steps=TICKS, seed=2, key=KEY, meanwhile=kill)
    assert killed == ["sensor", "controller", "actuator"]
    assert found.costs.tobytes() == quiet.costs.tobytes()
    assert all(not report.get("degraded") for report in found.reports.values())


@pytest.mark.evidence
def test_in_real_time_nothing_is_lost_either(tmp_path: Path) -> None:
    """100 steps at 100 Hz by the clock: every datagram accounted for, lateness told."""
    found = run_network(chapter_7(tmp_path), steps=100, tick=0.01, seed=1)
    assert_added_up(found)
    assert len(found.costs) == 100
    assert np.isfinite(found.costs).all()
    assert set(found.reports["controller"]["lateness_ms"]) == {"p50", "p95", "p99", "max"}


@pytest.mark.evidence
def test_a_process_that_takes_too_long_is_not_told_to_have_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that listens too late, one that does not end when it is asked to, and one that has ended."""
    silent = Process(["export", "two-mass-lqg", "--c", "/dev/null/nodes"], "the export")
    with monkeypatch.context() as patch:
        patch.setattr(Process, "alive", True)
        patch.setattr("taciturn_udp.processes.PATIENCE", 0.0)
        with pytest.raises(ProblemError, match="the export has not started within 0 s; reduce"):
            silent.expect()
    silent.kill()
    process = Process(["relay", "--bind", ":0", "--peer", ":9"], "the relay")
    process.expect()
    os.kill(process._process.pid, signal.SIGSTOP)
    with monkeypatch.context() as patch:
        patch.setattr("taciturn_udp.processes.PATIENCE", 0.1)
        with pytest.raises(ProblemError, match=r"the relay has not ended within 0\.1 s"):
            process.stop()
    assert not process.alive
    ended = Process(["relay", "--bind", ":0"], "the relay")
    with pytest.raises(ProblemError, match=r"--peer|has ended with code 2"):
        ended.expect()
    ended.kill()
