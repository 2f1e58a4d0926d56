"""Worlds of faults: nothing breaks in the nodes, and planted defects are found, shrunk and replayed."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from counts import few
from hypothesis import HealthCheck, find, settings
from hypothesis import strategies as st
from runtime.defects import DEFECTS, SHOWN
from runtime.late import STATES, late_sensor
from runtime.seeded import of_seed, problem
from runtime.test_nodes import TANKS

import taciturn
from taciturn.errors import ProblemError
from taciturn.problem import parse
from taciturn_worlds.devices import compile_devices
from taciturn_worlds.faults import Crash, Fault, Forgery, Jump, KeyChange, Loss, Pause, Recording, Replay
from taciturn_worlds.world import prepare, run_world, run_world_with_devices

CUT = ("controller", "actuator")


@pytest.mark.evidence
@pytest.mark.parametrize("first", few([32 * i + policy for i in range(32) for policy in range(4)], quick=0))
def test_no_invariant_breaks(first: int) -> None:
    """A thousand worlds of four policies, on the host and in C; every one holds a fault."""
    for seed in range(first, first + 32, 4):  # of one policy
        found = of_seed(seed)
        assert found.faults
        assert found.broken is None, f"world {seed}: {found.broken}"
        assert found.recovery is not None
        assert found.promised is not None
        assert found.recovery <= found.promised


@pytest.mark.parametrize("first", few([0, 8], quick=0))
@pytest.mark.parametrize("changes", [TANKS["tank, losses"], TANKS["tank, crossed"]], ids=["losses", "crossed"])
def test_no_invariant_breaks_with_several_sensors(first: int, changes: Mapping[str, object]) -> None:
    """Worlds of the four tanks: five processes, with acknowledgements, on the host and in C."""
    chosen = taciturn.load("quadruple-tank").changed(changes)
    for seed in range(first, first + 8):
        found = run_world_with_devices(chosen, seed)
        assert found.faults
        assert found.broken is None, f"world {seed}: {found.broken}"


@pytest.mark.evidence
@pytest.mark.parametrize("changes", [{}, STATES], ids=["fused", "states"])
def test_no_invariant_breaks_with_late_measurements(changes: Mapping[str, object]) -> None:
    """A filter also uses packets that newer ones have overtaken; on the host and in C."""
    for seed in range(3):
        found = run_world_with_devices(late_sensor(**changes), seed)
        assert found.faults
        assert found.broken is None, f"world {seed}: {found.broken}"


@pytest.mark.evidence
@pytest.mark.parametrize("seed", few([4, 8], quick=1, start=1))
def test_a_seed_gives_the_same_world_again(seed: int) -> None:
    """Keys, nonces, faults, counters and recovery are equal; another seed gives another world."""
    runs = [replace(of_seed(number), seconds=0.0) for number in (seed, seed, seed + 20)]
    assert runs[0].keyed == (seed == 8)
    assert runs[0].document() == runs[1].document()
    assert runs[0].document() != runs[2].document()


@pytest.mark.parametrize(
    "fault",
    [
        Jump(50, 1, "actuator", 6.0),
        Jump(50, 1, "actuator", 60.0),
        Jump(50, 1, "actuator", -60.0),
        Pause(50, 70, "actuator"),
        Crash(50, 30, "actuator", False),
        Crash(50, 30, "controller", True),
        Replay(50, 10, CUT, 40),
        Loss(0, 40, CUT),
    ],
    ids=lambda fault: fault.what(),
)
def test_a_fault_alone_is_survived(fault: Fault) -> None:
    """Each was not, or could be survived by chance only: jumps of a few steps made a node deaf for thousands."""
    found = run_world(problem("remote-scalar"), 1, [fault])
    assert found.broken is None
    assert found.counters["network"]["sent"] > 300


@pytest.mark.parametrize(
    ("fault", "counter"),
    [
        (Recording(60, 8, CUT, 500, 1_000_000), "unproven"),
        (Recording(60, 8, CUT, -500, 5), "unproven"),
        (Recording(60, 8, CUT), "replayed"),
        (Forgery(60, 8, CUT, former=False), "forged"),
        (Forgery(60, 8, CUT, former=True), "forged"),
    ],
    ids=["a session far ahead", "a session that seems to go on", "this session", "an unknown key", "another key"],
)
@pytest.mark.parametrize(
    "in_c", [False, pytest.param(True, marks=(pytest.mark.evidence, pytest.mark.daily))], ids=["Python", "C"]
)
def test_with_a_key_no_packet_of_an_attacker_is_used(fault: Fault, counter: str, in_c: bool) -> None:
    """It is counted, while the actuator has started again and believes nobody yet, and after a change of the key."""
    if in_c and shutil.which("cc") is None:
        pytest.skip("NOT SHOWN: nodes in C need a compiler, and there is no `cc`")
    faults = [KeyChange(1, 42, "actuator"), Crash(55, 5, "actuator", False), fault]
    chosen = problem("remote-scalar")
    devices = {"actuator": compile_devices(prepare(chosen)[0])["actuator"]} if in_c else {}
    found = run_world(chosen, 0 if in_c else 1, faults, devices, keyed=True)
    assert found.broken is None
    assert found.devices == (("actuator",) if in_c else ())
    refused = {"unproven": 1, "duplicate": 1, "replayed": 1} if counter == "replayed" else {counter: 1}
    assert sum(found.counters["actuator"].get(name, 0) for name in refused) > 5


@pytest.mark.parametrize(
    ("name", "seed", "faults"),
    [
        ("remote-scalar", 1, [Jump(50, 1, "actuator", 80.0), Loss(45, 40, CUT)]),
        ("remote-scalar", 1, [Loss(40, 60, CUT), *(Jump(45 + i, 1, "actuator", 9.0) for i in range(6))]),
        ("remote-scalar", 1, [Jump(49, 1, "actuator", -60.0), Loss(53, 40, CUT)]),
        ("two-mass", 199, [Loss(26, 11, ("actuator", "plant")), Jump(49, 1, "actuator", -51.23)]),
    ],
    ids=[
        "a jump while a node is cut",
        "small jumps that add up",
        "a jump back before a node is cut",
        "a slow clock behind the packets",
    ],
)
def test_nodes_keep_the_time_or_say_that_they_are_cut(name: str, seed: int, faults: list[Fault]) -> None:
    """A node has executed steps of the future, has made up for 11 steps at once, or has waited without a word."""
    assert run_world(problem(name), seed, faults).broken is None


INTEGRATING = {
    "plant": {
        "A": [[0.9, 0.2], [0.0, 0.8]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]],
        "W": [[0.01, 0.0], [0.0, 0.01]], "V": [[0.001]], "dt": 1.0,
    },
    "cost": {"Q": [[1.0, 0.0], [0.0, 0.1]], "R": [[0.1]]},
    "controller": {"pid": {"kp": 0.25, "ki": 0.03}},
}  # fmt: skip


@pytest.mark.parametrize(
    ("policy", "seed"),
    [
        ({"kind": "excess", "theta": 0.3}, 0),
        ({"kind": "excess", "theta": 0.3, "actuation": "model"}, 2),
        ({"kind": "send-on-delta", "delta": 0.2}, 1),
    ],
    ids=lambda value: str(value.get("actuation", value["kind"])) if isinstance(value, dict) else "",
)
def test_a_sensor_and_an_integrating_controller_agree_after_every_fault(policy: dict[str, object], seed: int) -> None:
    """An integral keeps a difference for ever: a sensor that decides on the controller's state sends this state."""
    found = run_world(parse({**INTEGRATING, "policy": {**policy, "link": "sensor"}}, "an integrating controller"), seed)
    assert found.broken is None


def test_a_sensor_that_is_never_queried_has_no_world() -> None:
    """Its controller hears nothing, so there is nothing to watch."""
    unheard = {"plant.A": [[0.5]], "plant.covariance": None, "zeta": 100.0}
    with pytest.raises(ProblemError, match="a watchdog is given for the controller, which receives no packets"):
        run_world(problem("remote-scalar").changed(unheard), 1, [])


@pytest.mark.evidence
def test_keys_are_those_of_every_link_of_the_plant(tmp_path: Path) -> None:
    """The plant sends measurements and set-points that change over one path: each link has its key."""
    (tmp_path / "levels.csv").write_text("0,0\n20,1\n35,-1\n60,0\n", encoding="utf-8")
    file = tmp_path / "loop.toml"
    file.write_text(
        "plant = {A = [[0.8]], B = [[1.0]], C = [[1.0]], W = [[0.1]], V = [[0.1]], dt = 1.0}\n"
        'cost = {Q = [[1.0]], R = [[0.5]]}\nreference = {file = "levels.csv"}\n'
        'policy = {kind = "excess", theta = 0.3}\n',
        encoding="utf-8",
    )
    for seed in range(3):
        assert run_world(taciturn.load(file), seed, keyed=True).broken is None


def test_a_clock_is_corrected_after_the_clock_that_it_follows() -> None:
    """A clock jumps while its node is cut, and the actuator follows it: each needs packets of a right clock."""
    mild = problem("remote-scalar").changed({"plant.A": [[1.2]]})
    found = run_world(mild, 400)
    assert any(isinstance(fault, Jump) for fault in found.faults)
    assert found.broken is None


def test_an_unstable_plant_that_is_cut_off_for_long_starts_again() -> None:
    """The world goes on where the numbers of its plant leave the range of packets, and counts this."""
    found = run_world(problem("remote-scalar"), 1, [Loss(10, 200, CUT)])
    assert found.broken is None
    assert found.counters["plant"]["starts again"] == 1


@pytest.mark.parametrize("name", few(sorted(SHOWN), quick=1))
def test_a_planted_defect_is_found_in_a_world(name: str) -> None:
    """One at a time; the world holds without it. The benchmark finds such worlds."""
    defect, seed = DEFECTS[name], SHOWN[name]
    if defect.core is not None and shutil.which("cc") is None:
        pytest.skip("NOT SHOWN: a defect in C needs a compiler, and there is no `cc`")
    assert seed < 1000
    assert of_seed(seed).broken is None
    found = of_seed(seed, defect)
    assert found.broken is not None
    print(f"\n{name}: world {found.seed}, {found.broken}")


def test_all_planted_defects_but_one_are_found() -> None:
    """Each within the first thousand worlds."""
    assert len(DEFECTS) == 27
    assert SHOWN.keys() <= DEFECTS.keys()
    assert len(SHOWN) >= len(DEFECTS) - 1


def shortest(faults: Sequence[Fault], broken: Callable[[Sequence[Fault]], bool]) -> list[Fault]:
    """Return a shortest list of short faults that still breaks a world."""
    shorter = st.sampled_from(faults).flatmap(
        lambda fault: st.integers(1, fault.steps).map(lambda steps: replace(fault, steps=steps))
    )
    lists = st.lists(shorter, min_size=1, max_size=len(faults))
    how = settings(max_examples=100, database=None, suppress_health_check=list(HealthCheck), derandomize=True)
    return find(lists, broken, settings=how)


@pytest.mark.evidence
def test_a_failing_seed_shrinks_to_a_shortest_list_of_faults() -> None:
    """Of four faults, only the jump of the actuator's clock matters for a defect of its correction; it lasts a step."""
    defect, chosen = DEFECTS["a clock that is some steps fast is not corrected"], problem("remote-scalar")
    jump = Jump(40, 3, "actuator", 5.0)
    faults = [Loss(10, 5, CUT), jump, Pause(30, 4, "sensor"), Replay(20, 2, CUT, 5)]
    prepare(chosen)
    with defect.planted():
        found = shortest(faults, lambda given: run_world(chosen, 1, given).broken is not None)
    assert found == [replace(jump, steps=1)]
