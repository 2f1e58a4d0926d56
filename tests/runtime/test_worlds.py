"""Worlds of faults: nothing breaks in the nodes, and planted defects are found, shrunk and replayed."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial

import pytest
from counts import few
from hypothesis import HealthCheck, find, settings
from hypothesis import strategies as st
from runtime.defects import DEFECTS, Defect

import taciturn
from taciturn.model.places import roles
from taciturn.runtime.faults import Crash, Fault, Jump, Loss, Pause, Replay
from taciturn.study.devices import DeviceCode, DeviceNode, compile_devices
from taciturn.study.worlds import WorldRun, prepare, run_world

BUILT_IN = ("remote-scalar", "double-integrator", "lossy-double-integrator", "two-mass")
CUT = ("controller", "actuator")


@cache
def problem(name: str) -> taciturn.Problem:
    """Return a problem whose policy has no horizon."""
    found = taciturn.load(name)
    return found.changed({"cost.horizon": None}) if found.cost.horizon else found


def of_seed(seed: int, core: dict[str, str] | None = None) -> WorldRun:
    """Run the world of a seed: the policy, its faults and the nodes in C depend on it."""
    chosen = problem(BUILT_IN[seed % len(BUILT_IN)])
    return run_world(chosen, seed, devices=devices(chosen, tuple((core or {}).items())))


@cache
def devices(chosen: taciturn.Problem, core: tuple[tuple[str, str], ...]) -> dict[str, Callable[..., DeviceNode]] | None:
    """Return the nodes in C, with a changed core; None without a compiler."""
    if shutil.which("cc") is None:
        return None
    loop, _ = prepare(chosen)
    if not core:
        return dict(compile_devices(loop))
    changed = {role: DeviceCode(loop.policy, role, loop.network, dict(core)) for role in roles(loop.policy)}
    return {role: partial(DeviceNode, code) for role, code in changed.items()}


@pytest.mark.parametrize("first", few(range(0, 1000, 8), quick=1))
def test_no_invariant_breaks(first: int) -> None:
    """A thousand worlds of four policies, on the host and in C; every one holds a fault."""
    for seed in range(first, first + 8):
        found = of_seed(seed)
        assert found.faults
        assert found.broken is None, f"world {seed}: {found.broken}"
        assert found.recovery is not None
        assert found.promised is not None
        assert found.recovery <= found.promised


def test_a_seed_gives_the_same_world_again() -> None:
    """Faults, counters and recovery are equal; another seed gives another world."""
    runs = [replace(of_seed(seed), seconds=0.0) for seed in (4, 4, 8)]
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


def first_broken(defect: Defect, most: int) -> WorldRun:
    """Return the first world that a defect breaks."""
    for name in BUILT_IN:
        prepare(problem(name))
    if defect.core is not None and shutil.which("cc") is None:
        pytest.skip("NOT SHOWN: a defect in C needs a compiler, and there is no `cc`")
    with defect.planted():
        runs = (of_seed(seed, defect.core) for seed in range(most))
        return next(run for run in runs if run.broken)


QUICK = ("marks are sent in every step", "the watchdog never expires")
FOUND = (  # defects that a few worlds show; the others of DEFECTS take more worlds than a test may
    "a late packet replaces a newer command", "an old packet silences a fresh node", "marks are never sent",
    "a clock that is some steps slow is not corrected", "steps are caught up without a limit",
    "a clock that is some steps fast is not corrected", "the checksum is not checked",
    "marks do not stop the watchdog",
)  # fmt: skip


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(name, marks=pytest.mark.evidence) for name in FOUND)])
def test_a_planted_defect_is_found_within_a_hundred_worlds(name: str) -> None:
    """Ten defects, one at a time."""
    found = first_broken(DEFECTS[name], 100)
    print(f"\n{name}: world {found.seed}, {found.broken}")


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
