"""Worlds of faults: the nodes of a problem and its plant in one process, with faults that a seed chooses.

The servers of the nodes and of the plant are those that run over UDP, in real time; their clocks and sockets are
virtual. A world breaks if an invariant does not hold (``taciturn.study.testbed.invariants``).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from taciturn._arrays import count
from taciturn._display import Displayed
from taciturn._text import pairs_text
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.problem import Problem
from taciturn.runtime.faults import Fault
from taciturn.study.testbed.devices import NoCompilerError, compile_devices
from taciturn.study.testbed.invariants import INVARIANTS, Copy, find_copies
from taciturn.study.testbed.world import MakeNode, World


@dataclass(frozen=True, eq=False, repr=False)
class WorldRun(Displayed):
    """Result of a world of faults.

    Args:
        seed: seed of the world.
        faults: its faults.
        devices: roles of the nodes that ran as C code.
        keyed: whether the processes had keys.
        broken: sentence on the invariant that does not hold; None if all invariants hold.
        invariant: name of the invariant that does not hold, at which the world ends, or None.
        recovery: steps after the last fault until no node was degraded and all copies agreed.
        promised: steps within which they must.
        steps: steps of the plant.
        ticks: steps of the nodes.
        counters: packets and datagrams counted by each process, and by the network.
        seconds: processor time.
        notes: remarks for the reader.
    """

    seed: int
    faults: tuple[Fault, ...]
    devices: tuple[str, ...]
    keyed: bool
    broken: str | None
    recovery: int | None
    promised: int | None
    steps: int
    ticks: int
    counters: Mapping[str, Mapping[str, int]]
    seconds: float
    notes: tuple[str, ...] = ()
    invariant: str | None = None

    def __str__(self) -> str:
        """Return the text that ``taciturn network --world SEED`` prints."""
        return world_text(self)

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn network --world SEED --json``."""
        plain = {
            name: getattr(self, name) for name in ("seed", "keyed", "broken", "recovery", "promised", "steps", "ticks")
        }
        return plain | {
            "faults": [{"kind": type(fault).__name__, **asdict(fault)} for fault in self.faults],
            "devices": list(self.devices),
            "counters": {name: dict(counted) for name, counted in self.counters.items()},
            "invariants": {name: name != self.invariant for name in INVARIANTS},
            "node_ticks": self.ticks,
            "seconds": round(self.seconds, 4),
            "notes": list(self.notes),
        }


def run_world(
    problem: Problem,
    seed: int,
    faults: Sequence[Fault] | None = None,
    devices: Mapping[str, MakeNode] | None = None,
    keyed: bool | None = None,
) -> WorldRun:
    """Run the nodes of a problem in a world of faults, and check the invariants at each step.

    Args:
        problem: the problem.
        seed: seed of the faults and of the plant.
        faults: the faults; default: those of the seed.
        devices: makers of nodes in C by role (``compile_devices``), of which the seed chooses some; default: all nodes
            run in Python.
        keyed: whether the processes have keys; default: the seed chooses.

    Raises:
        ProblemError: the policy is for a finite horizon, or its nodes cannot be separated.
    """
    count("seed", seed, 0)
    loop, copies = prepare(problem)
    draws = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(3,)))
    chosen = {role: make for role, make in (devices or {}).items() if draws.random() < 0.5}
    if keyed is None:
        keyed = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(4,))).random() < 0.5
    world = World(loop, seed, faults, chosen, keyed)
    began = time.process_time()
    broken = world.run(copies)
    return WorldRun(
        seed, world.faults, tuple(world.made), keyed, broken and str(broken), world.recovery, world.promised,
        int(world.step()), world.monitor.ticks, world.counters(), time.process_time() - began,
        invariant=broken and broken.invariant,
    )  # fmt: skip


def run_world_with_devices(problem: Problem, seed: int) -> WorldRun:
    """Run a world in which the seed also chooses the nodes that run in C; without a C compiler, a note says so.

    Args:
        problem: the problem.
        seed: seed of the world.

    Raises:
        ProblemError: the policy is for a finite horizon, or its nodes cannot be separated.
    """
    try:
        devices = compile_devices(prepare(problem)[0])
    except NoCompilerError as error:
        return replace(run_world(problem, seed), notes=(f"all nodes run in Python: {error}",))
    return run_world(problem, seed, devices=devices)


@lru_cache(maxsize=8)
def prepare(problem: Problem) -> tuple[Loop, Sequence[Copy]]:
    """Return the loop of a problem, and the copies of numbers that its nodes hold, from a run without faults."""
    loop = problem.close(problem.design())
    if loop.horizon is not None:
        raise ProblemError(
            f"the policy {loop.policy.kind} is for a horizon of {loop.horizon} steps, but a world of faults lasts "
            "until the nodes have recovered; expected a policy without horizon"
        )
    quiet = World(loop, 0, (), {}, keyed=False)
    broken = quiet.run_for(200)
    if broken is not None:
        raise ProblemError(f"without any fault, {broken}; expected nodes that run over this network")
    return loop, find_copies(quiet.monitor.snapshots, 20)


def world_text(found: WorldRun) -> str:
    """Return the faults, the counters and the recovery of a world."""
    lines = [("world", f"{found.seed}, {found.steps} steps, {found.ticks} steps of nodes in {found.seconds:.2f} s")]
    lines.append(("nodes in C", ", ".join(found.devices) or "none"))
    lines.append(("keys", "one for each link" if found.keyed else "none"))
    lines += [("fault", fault.text()) for fault in found.faults]
    for name, counted in found.counters.items():
        shown = ", ".join(f"{number} {what}" for what, number in counted.items() if number)
        lines.append((name, shown or "no packets"))
    if found.recovery is not None:
        lines.append(
            ("recovery", f"{found.recovery} steps after the last fault; at most {found.promised} are promised")
        )
    return pairs_text([*lines, ("broken", found.broken or "no invariant"), *(("note", note) for note in found.notes)])
