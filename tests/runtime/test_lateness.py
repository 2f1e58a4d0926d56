"""Packets that arrive after their step are counted as late, by the steps that they are late."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from runtime.virtual import run_virtually

import taciturn
from taciturn.nodes.lateness import Lateness, total_of
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet
from taciturn_udp.relay import Fate
from taciturn_udp.result import NetworkRun
from taciturn_udp.run import run_network

PERIOD = 0.02


@pytest.mark.parametrize(("delay", "late"), [(0.0, 0), (0.002, 0), (0.04, 2), (0.05, 2), (0.061, 3)])
def test_a_delay_that_all_packets_have_makes_them_late(tmp_path: Path, delay: float, late: int) -> None:
    """The receiver takes the delay for the phase of the steps and uses each packet; by the plant's steps it is late."""
    found = run_virtually("two-mass", tmp_path, 80, {"actuator": Fate(delay=delay)}, PERIOD)
    arrived, counted = len(found.logs.arrived("actuator")), found.logs.lateness["actuator"]
    assert arrived > 15
    assert counted.arrived == arrived
    assert dict(counted.steps) == ({late: arrived} if late else {})
    assert found.nodes["actuator"].nodes[0].counters["used"] >= arrived - 1
    inputs = found.plant.lateness["plant"]
    if delay in (0.0, 0.04):  # the actuator is late by as many steps as its packets
        assert dict(inputs.steps) == ({late: inputs.arrived} if late else {})
    assert found.plant.report()["late_packets"]["plant"] == inputs.document()


def test_random_delays_have_the_distribution_of_whole_periods(tmp_path: Path) -> None:
    """Each packet is late by the whole periods in its own delay, whichever the receiver has used."""
    fate = Fate(3, jitter=0.07)
    found = run_virtually("two-mass", tmp_path, 300, {"actuator": fate}, PERIOD)
    rows = [row for row in found.packets[1:] if row[3] in ("delivered", "late")]
    sent = {row[1]: float(row[0]) for row in found.packets[1:] if row[3] == "sent"}
    counted, missed = Lateness(), 0
    for at, step, _, event, delay, *_ in rows:
        assert float(at) - sent[step] == pytest.approx(float(delay))
        late = int(float(at) / PERIOD) - int(step)
        counted.add(late, event == "late")
        assert late == 0 or event == "late"
        missed += late == 0 and event == "late"
    assert counted == found.logs.lateness["actuator"]
    assert set(counted.steps) >= {1, 2, 3}
    assert counted.steps[0] == missed


def test_in_virtual_time_a_packet_that_is_held_is_late_by_the_steps_that_it_was_held(tmp_path: Path) -> None:
    """Nothing is late without ``hold``."""
    held = run_virtually("two-mass", tmp_path / "held", 60, {"actuator": Fate(hold=2)})
    counted = held.logs.lateness["actuator"]
    assert counted.arrived == len(held.logs.arrived("actuator")) > 10
    assert dict(counted.steps) == {2: counted.arrived}
    own = held.nodes["actuator"]
    assert own.lateness["actuator"] == counted
    assert own.report()["late_packets"]["actuator"]["late"] == own.nodes[0].counters["late"] == counted.arrived
    assert {row[3] for row in held.packets[1:]} == {"sent", "late"}
    prompt = run_virtually("two-mass", tmp_path / "prompt", 60, {})
    assert prompt.logs.lateness["actuator"].late == 0


def test_an_inbox_tells_how_late_a_packet_is() -> None:
    """In steps after the step that reads the packet, which with a delay of the network is the next one."""
    for delay in (0, 1):
        changes = {"network.delay": delay, "network.protocol": "tcp"}
        policy = taciturn.load("lossy-double-integrator").changed(changes).design()
        node = Node(policy, "controller")
        for tick in range(8):
            node.step(tick)
        packet = Packet("data", "sensor", 5, 0, (0.5, 0.5))
        assert [node.inbox.late_by(packet, runs) for runs in (4, 5, 6, 8)] == [0, 0, 1 - delay, 3 - delay]
        assert node.sort_in(packet) == "late"


def test_counts_of_late_packets_add_up_and_are_told_in_words() -> None:
    """A packet within its own step that came too late is late by less than a step; a long list is cut."""
    found = Lateness()
    assert (found.late, found.share, found.text()) == (0, 0.0, "0 of 0 packets")
    for late, missed in ((0, False), (0, True), (1, False), (1, True)):
        found.add(late, missed)
    assert found.text() == "3 of 4 packets (75.0 %): 1 by less than a step, 2 by 1 step"
    assert found.document() == {"arrived": 4, "late": 3, "share": 0.75, "steps": {"0": 1, "1": 2}}
    many = Lateness()
    for late in range(1, 21):
        many.add(late)
    assert many.text().endswith("1 by 5 steps, 15 by more, up to 20")
    both = total_of([found, many])
    assert (both.arrived, both.late) == (24, 23)


@pytest.mark.evidence
def test_a_run_of_processes_reports_late_packets() -> None:
    """In text, in JSON and in the report of the receiver, in virtual time with ``hold``."""
    found: NetworkRun = run_network("two-mass", steps=60, seed=1, fates={"actuator": Fate(hold=2)})
    document = found.document()
    late = document["late_packets"]["actuator"]
    assert late["steps"] == {"2": late["arrived"]}
    assert document["processes"]["actuator"]["late_packets"]["actuator"] == late
    assert document["late_packets"]["plant"] == {"arrived": 60, "late": 0, "share": 0.0, "steps": {}}
    assert f"{late['late']} of {late['arrived']} late" in found.verdict[0]
    assert f"{late['late']} by 2 steps" in found.text()
    assert np.isfinite(found.costs).all()
