"""Full counts of what nodes bear: seeds, faults one by one with their cost, and many loops in one process."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from counts import scaled
from runtime.attacks import KEY, await_ticks, capture, chapter_7, noise, throw
from runtime.test_network import assert_added_up, proofs, refused

import taciturn
from taciturn_udp.processes import Processes
from taciturn_udp.relay import losses
from taciturn_udp.result import NetworkRun
from taciturn_udp.run import run_network

pytestmark = pytest.mark.evidence
TICK = 0.02  # at which a machine that does other things as well is in time


def shown(name: str, found: NetworkRun) -> None:
    """Print the figures of a fault."""
    state = found.reports["plant"]["largest_state"]
    degraded = {role: report["degraded"] for role, report in found.reports.items() if report.get("degraded")}
    print(f"\n{name}: cost {found.cost}, largest state {state:.2f}, held {found.reports['plant']['held']}, {degraded}")


def standard(found: NetworkRun) -> tuple[float, float]:
    """Return the cost of a run and its standard error."""
    assert found.cost is not None
    return found.cost.value, found.cost.standard_error


def changed(fates: dict, **what: float) -> dict:
    """Return links that do something else as well."""
    return {link: replace(fate, **what) for link, fate in fates.items()}


def test_chapter_7_over_three_processes_costs_and_sends_what_the_loop_does(tmp_path: Path) -> None:
    """20 seeds of 1,000 steps, or fewer: cost and rate within three standard errors of the simulated loop."""
    file = chapter_7(tmp_path)
    expected = taciturn.evaluate(taciturn.load(file))
    runs = [run_network(file, steps=scaled(1000, 400), seed=seed) for seed in range(20)]
    for run in runs:
        assert_added_up(run)
    for what, wanted in (("costs", expected.cost), ("sends", expected.rates["actuator"])):
        values = np.array([(run.costs if what == "costs" else run.sends["actuator"])[100:].mean() for run in runs])
        error = values.std(ddof=1) / np.sqrt(len(values))
        print(f"\n{what}: {values.mean():.4f} ± {error:.4f}, the simulated loop {wanted}")
        assert abs(values.mean() - wanted.value) <= 3 * np.hypot(error, wanted.standard_error)


@pytest.mark.parametrize(("fault", "what"), [("duplicate", 0.3), ("reorder", 0.3), ("corrupt", 0.1)])
def test_links_that_do_worse_cost_what_their_losses_cost(tmp_path: Path, fault: str, what: float) -> None:
    """Doubled packets cost nothing; reordered and corrupted ones as much as lost ones, and all add up."""
    file = chapter_7(tmp_path)
    problem = taciturn.load(file)
    found = run_network(file, steps=4000, seed=8, fates=changed(losses(problem.network, 8), **{fault: what}))
    shown(f"{fault} {what:.0%}", found)
    assert_added_up(found)
    counters = {name: report["counters"] for name, report in found.reports.items() if "counters" in report}
    lost = {}
    for link, role in (("sensor", "controller"), ("actuator", "actuator")):
        used, sent = counters[role]["used"], found.datagrams[link]["sent"]
        lost[f"network.{link}_loss"] = 1 - used / sent
    actual = problem.changed(lost)
    expected = taciturn.average(
        taciturn.close(problem.plant, problem.design(), actual.network, problem.cost), steps=2_000_000
    ).cost
    value, error = standard(found)
    print(f"a loop that loses as much: {expected}")
    assert abs(value - expected.value) <= 4 * np.hypot(error, expected.standard_error)


@pytest.mark.parametrize("kept", [True, False], ids=["with its state", "without its state"])
@pytest.mark.parametrize("role", ["sensor", "controller", "actuator"])
def test_a_node_that_is_killed_in_real_time_rejoins(tmp_path: Path, role: str, kept: bool) -> None:
    """kill -9 at 50 Hz, and a start a moment later: the state stays bounded, and the loop continues by itself."""
    away = []

    def kill(processes: Processes) -> None:
        await_ticks(processes, role, 60)
        processes.running[role].kill()
        killed, known = time.monotonic(), (processes.folder / f"{role}.jsonl").read_bytes().count(b"\n")
        if not kept:
            (processes.folder / f"{role}.json").unlink(missing_ok=True)
            time.sleep(1.1)  # an epoch is a second
        processes.start(role)
        await_ticks(processes, role, known + 1)
        away.append(time.monotonic() - killed)

    found = run_network(chapter_7(tmp_path), steps=450, tick=TICK, seed=1, key=KEY, meanwhile=kill)
    shown(f"{role} killed, {'with' if kept else 'without'} its state", found)
    assert found.reports["plant"]["largest_state"] < 100 * max(1.0, away[0]) ** 2  # an input held moves masses as time²
    assert found.costs[-50:].mean() < 10.0  # hundreds if it had not rejoined
    assert found.reports[role]["tick"] >= 440


@pytest.mark.parametrize("role", ["sensor", "controller", "actuator"])
def test_a_clock_that_stands_still_and_jumps_is_borne(tmp_path: Path, role: str) -> None:
    """A node is stopped for half a second and continues: to it, the clock has jumped by 25 steps."""

    def pause(processes: Processes) -> None:
        await_ticks(processes, role, 60)
        processes.running[role].pause(0.5)

    found = run_network(chapter_7(tmp_path), steps=250, tick=TICK, seed=2, meanwhile=pause)
    shown(f"{role} stopped for 25 steps", found)
    assert_added_up(found)
    assert found.reports["plant"]["largest_state"] < 100
    assert found.costs[-50:].mean() < 10.0
    assert found.reports[role]["tick"] >= 240


def test_a_flood_of_foreign_packets_is_borne(tmp_path: Path) -> None:
    """50,000 datagrams a second for three seconds at the controller: refused or dropped by the kernel, all counted."""
    thrown = []

    def flood(processes: Processes) -> None:
        await_ticks(processes, "controller", 50)
        thrown.append(throw(noise(1000, 3) * 150, processes.addresses["controller"], 50_000))

    found = run_network(chapter_7(tmp_path), steps=300, tick=TICK, seed=3, key=KEY, meanwhile=flood)
    shown("flood", found)
    report = found.reports["controller"]
    datagrams, genuine = report["datagrams"], report["counters"]["received"]
    print(f"thrown {thrown[0]}, refused {refused(report)}, dropped by the kernel {datagrams['dropped_by_kernel']}")
    assert datagrams["received"] == genuine + refused(report) + proofs(report)
    relays = [found.reports[f"relay {link}"] for link in ("sensor", "actuator")]
    relayed = relays[0]["datagrams"]["sent"] - relays[0]["counters"]["sent back"]
    challenged = relays[1]["counters"]["sent back"]  # by the actuator
    assert datagrams["received"] + datagrams["dropped_by_kernel"] == thrown[0] + relayed + challenged
    assert found.reports["plant"]["largest_state"] < 100


@pytest.mark.parametrize("what", ["an old capture", "a wrong key", "another policy"])
def test_packets_of_others_change_nothing(tmp_path: Path, what: str) -> None:
    """Ten thousand of each in virtual time: the bits of the run that nobody disturbs."""
    file = chapter_7(tmp_path)
    quiet = run_network(file, steps=1000, seed=5, key=KEY)
    packets = {
        "an old capture": lambda: capture(file, 5000, KEY),
        "a wrong key": lambda: capture(file, 5000, bytes(32)),
        "another policy": lambda: capture(file, 5000, KEY, price=0.2),
    }[what]()
    thrown = []

    def attack(processes: Processes) -> None:
        await_ticks(processes, "controller", 100)
        thrown.append(throw(packets, processes.addresses["controller"], 10_000))

    found = run_network(file, steps=1000, seed=5, key=KEY, meanwhile=attack)
    shown(what, found)
    report = found.reports["controller"]
    handshake = refused(quiet.reports["controller"])
    assert refused(report) - handshake + report["datagrams"]["dropped_by_kernel"] == thrown[0] == 10_000
    assert found.costs.tobytes() == quiet.costs.tobytes()
