"""Worlds of faults by seed, also with a defect planted in the nodes: for tests and benchmarks."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache, partial

from runtime.defects import Defect

import taciturn
from taciturn.model.packets import roles
from taciturn_worlds.devices import DeviceCode, DeviceNode, compile_devices
from taciturn_worlds.world import WorldRun, prepare, run_world

BUILT_IN = ("remote-scalar", "double-integrator", "lossy-double-integrator", "two-mass")


@cache
def problem(name: str) -> taciturn.Problem:
    """Return a problem whose policy has no horizon."""
    found = taciturn.load(name)
    return found.changed({"cost.horizon": None}) if found.cost.horizon else found


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


def of_seed(seed: int, defect: Defect | None = None) -> WorldRun:
    """Run the world of a seed, perhaps with a defect; the policy, its faults and the nodes in C depend on the seed."""
    chosen = problem(BUILT_IN[seed % len(BUILT_IN)])
    prepare(chosen)  # without the defect
    defect = Defect() if defect is None else defect
    made = devices(chosen, tuple((defect.core or {}).items()))
    with defect.planted():
        return run_world(chosen, seed, devices=made)
