"""Nodes add up what their silence costs as the loop does, and a node that has lost its state begins another life."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from math import sqrt
from pathlib import Path

import numpy as np
import pytest
from counts import few
from drawn import law
from hypothesis import strategies as st
from runtime.attacks import await_ticks
from runtime.loops import in_this_process
from runtime.silent import CASES, TANK, Links, Walk, build, concluded, problem_of, simulate
from runtime.test_network import patient

from taciturn import Nodes
from taciturn.loop import Loop
from taciturn.model.packets import inputs_at, outputs_at, roles
from taciturn.model.silence import Certificate, Life
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.study.recorded import recorded_silence
from taciturn_udp.processes import Processes
from taciturn_udp.result import NetworkRun, uncertified
from taciturn_udp.run import run_network
from taciturn_worlds.world import prepare, run_world

TICKS = 60


@pytest.mark.parametrize("name", few(CASES, 4))
def test_nodes_add_up_what_the_loop_adds_up(name: str) -> None:
    """In every bit and at every step: separate nodes, all nodes in one process, and the simulation."""
    loop = build(name)
    path = simulate(loop, TICKS)
    walk, nodes, seen = Walk(loop, path), Nodes(loop), set[Links]()
    for tick, role, _, _, _ in walk.steps(range(TICKS)):
        node = walk.nodes[role]
        last = concluded(node, tick)
        for life in node.silence if last >= 0 else ():
            seen.add(life.links)
            assert (life.total, life.steps) == (path.total[life.links][last], path.lasted[life.links][last])
    assert seen == set(loop.policy.theory.silence)
    for tick in range(TICKS):
        fates = {link: bool(come[tick]) for link, come in path.arrived.items() if path.sent[link][tick]}
        points = path.points[tick] if path.points.size else None
        assert nodes.step(path.y[tick], reference=points, fates=fates).tobytes() == path.applied[tick].tobytes()
        lives = {life.links: (life.total, life.steps) for life in nodes.silence}
        assert lives == {links: (path.total[links][tick], path.lasted[links][tick]) for links in path.total}
    assert all(total[-1] > 0 for total in path.total.values())


@pytest.mark.parametrize("name", few(("held", "losses", "two valves"), 1))
def test_a_life_continues_from_a_saved_state(name: str) -> None:
    """Nodes whose state goes through JSON in the middle add up the same bits."""
    loop = build(name)
    path = simulate(loop, TICKS)
    walk, whole = Walk(loop, path), Walk(loop, path)
    for _ in whole.steps(range(TICKS)):
        pass
    for _ in walk.steps(range(TICKS // 2)):
        pass
    for role, node in walk.nodes.items():
        walk.nodes[role] = Node(loop.policy, role, network=loop.network, epoch=9)
        walk.nodes[role].restore(json.loads(json.dumps(node.save())))
        assert walk.nodes[role].silence == node.silence
    for _ in walk.steps(range(TICKS // 2, TICKS)):
        pass
    assert [node.silence for node in walk.nodes.values()] == [node.silence for node in whole.nodes.values()]


def test_a_node_without_its_state_sends_until_a_packet_has_arrived() -> None:
    """Its steps count from there, and only then it may be silent, here since its measurement does not move."""
    loop = build("losses")
    node, y = Node(loop.policy, "gauge", network=loop.network), 0.0
    told = list[Packet]()
    for tick in range(40, 60):
        (packet,) = node.step(tick, [y], told).packets
        told = []
        assert packet.kind == "data"
        assert node.memory["begun_gauge"] == [0.0]
        assert [life.steps for life in node.silence] == [0]
    told = [Packet("acknowledgement", "gauge", 59, 0)]
    lasted = list[int]()
    silent = 0
    for tick in range(60, 70):
        sent = [one for one in node.step(tick, [y], told).packets if one.kind == "data"]
        told = [Packet("acknowledgement", "gauge", tick, tick - 59)] if sent else []
        silent += not sent
        lasted += [life.steps for life in node.silence]
    assert silent == 10  # y does not move, so silence costs nothing
    assert lasted == list(range(1, 11))
    assert [life.total for life in node.silence] == [0.0]


def run_with_restarts(loop: Loop, ticks: int, seed: int, starts: Sequence[int]) -> tuple[np.ndarray, list[list[Life]]]:
    """Return the costs of a loop whose first sensor loses its state before some steps, and all lives after each."""
    policy = loop.policy
    nodes = {role: Node(policy, role, network=loop.network) for role in roles(policy)}
    boxes: dict[str, list[Packet]] = {role: [] for role in nodes}
    plant, u, ended = SimulatedPlant(loop, seed), np.zeros(policy.model.inputs), list[Life]()
    costs, lives = np.empty(ticks), list[list[Life]]()
    first = next(role for role, node in nodes.items() if node.measures)
    for tick in range(ticks):
        if tick in starts:
            ended += nodes[first].silence
            nodes[first] = Node(policy, first, network=loop.network, epoch=tick)
        for role, node in nodes.items():
            box, boxes[role] = boxes[role], []
            y = [plant.measurement[i] for i in outputs_at(policy, role)]
            packets, given = node.step(tick, y if node.measures else None, box)
            if given is not None:
                u[inputs_at(policy, role)] = given
            for packet in packets:
                boxes[next(name for name, other in nodes.items() if packet.link in other.program.hears)].append(packet)
        costs[tick] = plant.move(u.tolist())
        lives.append([*ended, *(life for node in nodes.values() for life in node.silence)])
    return costs, lives


@law(3, 60, seed=st.integers(0, 2**31), name=st.sampled_from(["one sensor", "held", "relative", "predicted"]))
def test_the_lives_of_a_sensor_together_bound_the_cost_of_every_path(seed: int, name: str) -> None:
    """A sensor that starts again sends at once, and the sums of all its lives bound the difference at every time."""
    loop, draws = build(name), np.random.default_rng(seed)
    starts = [int(at) for at in 1 + draws.choice(TICKS - 1, size=3, replace=False)]
    costs, lives = run_with_restarts(loop, TICKS, seed, starts)
    problem = problem_of(name).changed({"theta": 0.0})
    every = problem.close(problem.design())
    base, silent = run_with_restarts(every, TICKS, seed, ())
    assert all(life.total == 0 for life in silent[-1])
    sums = np.cumsum(costs), np.cumsum(base)
    for tick in range(TICKS):
        root = Certificate(tuple(lives[tick]), 1.0).root
        assert abs(sqrt(sums[0][tick]) - sqrt(sums[1][tick])) <= root + 1e-9 * sqrt(sums[0][tick])
    for tick in starts if name == "one sensor" else ():  # where the last life alone has no sum yet
        assert lives[tick][-1].total == 0
        assert sums[0][tick] == sums[1][tick] or sum(life.total for life in lives[tick]) > 0
    assert len(lives[-1]) == len(loop.policy.theory.silence) + len(starts)


@law(1, 60, seed=st.integers(0, 1000), name=st.sampled_from(["held", "losses", "predicted", "relative"]))
def test_worlds_of_faults_do_not_compare_how_long_nodes_have_lived(seed: int, name: str) -> None:
    """A sensor that has missed steps, or has lost its state, counts fewer steps than the controller ever after."""
    _, copies = prepare(problem_of(name))
    assert not any("lasted" in one[1] for copy in copies for one in copy[:2])
    assert run_world(problem_of(name), seed).broken is None


def test_a_node_whose_numbers_overflow_begins_another_life_and_is_degraded() -> None:
    """What it could not compute is not in its sum, and a run over the network would show no certificate."""
    loop = build("held")
    node, draws = Node(loop.policy, "plc", network=loop.network), np.random.default_rng(1)
    for tick in range(TICKS):
        node.step(tick, packets=[Packet("data", "gauge", tick, tick, (float(draws.normal(0, 0.1)),))])
    (before,) = node.silence
    assert before.total > 0
    done = node.step(TICKS, packets=[Packet("data", "gauge", TICKS, TICKS, (3e38,))])
    assert (done.packets, node.counters["overflowed"]) == ((), 1)
    assert node.degraded
    assert node.reasons["overflow"] == 1
    assert [(life.total, life.steps) for life in node.silence] == [(0.0, 0)]
    (packet,) = node.step(TICKS + 1).packets
    (after,) = node.silence
    assert (packet.link, after.total, after.steps) == ("valve", 0.0, 1)


def reported(name: str, degraded: dict[str, int] | None = None, ticks: int = 5) -> NetworkRun:
    """Return a run with reports of nodes that are made up."""
    loop = build(name)
    lives = [
        {"loop": 0, "links": list(links), "total": 0.5, "steps": ticks - 1, "factor": 1.0}
        for links in loop.policy.theory.silence
    ]
    reports = {"gauge": {"degraded": degraded or {}, "silence": lives}, "valve": {"degraded": {}}, "plant": {}}
    return NetworkRun(
        loop=loop, unit="step", cost=None, rates={}, datagrams={}, reports=reports,
        costs=np.arange(1.0, 1.0 + ticks), sends={}, arrived={}, seed=0, nominal=not loop.violated_assumptions,
        seconds=1.0, notes=uncertified(loop, reports),
    )  # fmt: skip


def test_a_run_with_a_degraded_node_shows_no_certificate() -> None:
    """A node that started without its state has not counted what its silence has cost before."""
    found = reported("held").certificate
    assert found is not None
    assert (found.duration, found.cost) == (5.0, 3.0)
    assert found.root == pytest.approx(2 * sqrt(0.5 / 5))
    restarted = reported("held", {"joined": 1})
    assert restarted.certificate is None
    assert "certificate" not in restarted.document()
    assert restarted.notes == ("no certificate: the gauge reports events that no theory covers: joined (1)",)
    assert "certificate" in reported("held").document()


def test_a_certificate_over_links_that_drop_packets_ends_before_the_last_step() -> None:
    """Of the last packet, no acknowledgement has arrived."""
    found = reported("losses").certificate
    assert found is not None
    assert (found.duration, found.cost) == (4.0, 2.5)


def test_rounded_packets_leave_no_certificate() -> None:
    """The nodes do not count what rounding adds."""
    assert reported("rounded").certificate is None


@pytest.mark.evidence
@pytest.mark.parametrize("name", ["held", "losses", "two valves"])
def test_processes_over_udp_report_the_sums_of_nodes_in_memory(name: str) -> None:
    """Costs and certificate have the same bits."""
    ticks, problem = 120, problem_of(name)
    with patient():
        found = run_network(problem, steps=ticks, seed=2)
    costs, nodes = in_this_process(problem, ticks, 2)
    assert found.costs.tobytes() == costs.tobytes()
    assert found.certificate is not None
    lives = [life for node in nodes.values() for life in node.silence]
    assert sorted(found.certificate.lives, key=lambda one: one.links) == sorted(lives, key=lambda one: one.links)
    assert found.certificate.root > 0
    document = json.loads(json.dumps(found.document()))
    assert [set(one) for one in document["certificate"]["silence"]] == [
        {"links", "total", "steps", "factor", "root"}
    ] * len(lives)


@pytest.mark.evidence
def test_over_udp_without_acknowledgement_there_is_no_certificate() -> None:
    """Senders assume that packets arrive, and their sums are too small."""
    problem = problem_of("losses").changed({f"links.{link}.acknowledged": False for link in ("gauge", "valve")})
    with patient():
        found = run_network(problem, steps=40, seed=2)
    assert found.certificate is None
    assert all(not report.get("silence") for report in found.reports.values())
    assert found.datagrams["gauge"]["lost"] > 0


@pytest.mark.evidence
def test_the_logs_of_running_processes_are_read(tmp_path: Path) -> None:
    """Copies of the logs, taken while nodes run over UDP: the certificate of the steps so far."""
    files = list[Path]()

    def copied(processes: Processes) -> None:
        await_ticks(processes, "valve", 40)
        for role in processes.roles:
            files.append(tmp_path / role)
            files[-1].write_bytes((processes.folder / f"{role}.jsonl").read_bytes()[:-1])  # a line that is cut

    with patient():
        run_network(problem_of("held"), steps=150, seed=2, meanwhile=copied)
    found = recorded_silence(problem_of("held"), files)
    _, nodes = in_this_process(problem_of("held"), found.steps, 2)
    assert found.certificate is not None
    assert found.steps >= 39
    sums = {life.links: life.total for node in nodes.values() for life in node.silence}
    assert all(0 < life.total <= sums[life.links] for life in found.certificate.lives)
    assert any(life.total == sums[life.links] for life in found.certificate.lives)


@pytest.mark.evidence
def test_a_process_that_starts_again_without_its_state_leaves_no_certificate() -> None:
    """In real time; its report has its last life only."""

    def again(processes: Processes) -> None:
        await_ticks(processes, "gauge", 40)
        processes.running.pop("gauge").kill()
        (processes.folder / "gauge.json").unlink()
        processes.start("gauge")

    found = run_network(problem_of("held"), steps=300, tick=0.02, seed=2, meanwhile=again)
    assert found.reports["gauge"]["silence"][0]["steps"] < 300
    assert found.reports["gauge"]["degraded"]["joined"] == 1
    assert found.certificate is None
    assert any("no certificate: the gauge reports events" in note for note in found.notes)


@pytest.mark.evidence
def test_the_command_prints_the_certificate() -> None:
    """As JSON, with the sums of every node that decides."""
    changes = [part for key, value in TANK.items() for part in ("--set", f"{key}={json.dumps(value)}")]
    command = [sys.executable, "-m", "taciturn", "network", "pid-tank", "--steps", "60", "--json", *changes]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=True)
    found = json.loads(done.stdout)["certificate"]
    assert [one["links"] for one in found["silence"]] == [["gauge"], ["valve"]]
    assert found["root"] == pytest.approx(sum(sqrt(one["total"] / 60) for one in found["silence"]))
