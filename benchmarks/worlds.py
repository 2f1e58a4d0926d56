"""Worlds of faults: how many hold, how soon nodes recover, and how many steps of nodes run per second.

    python benchmarks/worlds.py [--worlds 10000] [--first 0] [--processes 2] [--store FILE] [--json OUT]
    python benchmarks/worlds.py --defects [--worlds 1000] [--processes 2] [--store FILE] [--json OUT]

World k runs the policy k mod 4 of the four below, about half of its nodes in C if there is a compiler, and about half
of all worlds have keys. With
--store, finished worlds are kept, one line of JSON each, so that a stopped run continues.

With --defects, the nodes have one planted defect at a time: the table tells in which world each defect is found first.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from taciturn_worlds.world import WorldRun

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from runtime.defects import DEFECTS
from runtime.seeded import BUILT_IN, of_seed

TOGETHER = 20  # worlds that a process runs in one go


def described(found: WorldRun) -> dict[str, Any]:
    """Return what happened in a world."""
    return {
        "faults": len(found.faults), "devices": len(found.devices), "ticks": found.ticks, "steps": found.steps,
        "seed": found.seed, "keyed": found.keyed, "broken": found.broken, "recovery": found.recovery,
        "promised": found.promised, "seconds": found.seconds,
    }  # fmt: skip


def run_some(seeds: list[int]) -> list[dict[str, Any]]:
    """Return what happened in the worlds of some seeds."""
    return [described(of_seed(seed)) for seed in seeds]


def find_defect(task: tuple[str, int, int]) -> list[dict[str, Any]]:
    """Return the first of some worlds that a planted defect breaks."""
    name, first, worlds = task
    for seed in range(first, first + worlds):
        found = of_seed(seed, DEFECTS[name])
        if found.broken is not None:
            return [{"defect": name, "worlds": seed - first + 1} | described(found)]
    return [{"defect": name, "worlds": worlds, "broken": None}]


def spread(
    work: Callable[[Any], list[dict[str, Any]]], tasks: list[Any], processes: int, store: Path | None
) -> Iterator[dict[str, Any]]:
    """Yield the results of all tasks as they come, and append them to the store."""
    with ProcessPoolExecutor(processes) as pool, ExitStack() as stack:
        kept = None if store is None else stack.enter_context(store.open("a", encoding="utf-8"))
        for done in as_completed([pool.submit(work, task) for task in tasks]):
            for result in done.result():
                if kept is not None:
                    print(json.dumps(result), file=kept, flush=True)
                yield result


def read(store: Path | None) -> list[dict[str, Any]]:
    """Return the results of an earlier run."""
    if store is None or not store.exists():
        return []
    return [json.loads(line) for line in store.read_text(encoding="utf-8").splitlines()]


def tell(sentence: str) -> None:
    """Print a line at once."""
    print(sentence, flush=True)


def processor() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def run_worlds(asked: argparse.Namespace) -> dict[str, Any]:
    """Run the worlds, and print one line per policy and one for all."""
    wanted = range(asked.first, asked.first + asked.worlds)
    found = [world for world in read(asked.store) if world["seed"] in wanted]
    known = {world["seed"] for world in found}
    left = [seed for seed in wanted if seed not in known]
    groups = [left[i : i + TOGETHER] for i in range(0, len(left), TOGETHER)]
    began, new = time.monotonic(), 0
    for world in spread(run_some, groups, asked.processes, asked.store):
        found.append(world)
        new += world["ticks"]
        if world["broken"]:
            tell(f"{BUILT_IN[world['seed'] % len(BUILT_IN)]}, world {world['seed']}: {world['broken']}")
        if len(found) % 500 == 0:
            tell(f"{len(found)} of {asked.worlds} worlds, {sum(w['broken'] is not None for w in found)} broken")
    seconds = time.monotonic() - began
    rows: list[dict[str, Any]] = []
    for i, name in enumerate(BUILT_IN):
        here = [world for world in found if world["seed"] % len(BUILT_IN) == i]
        good = [world for world in here if world["broken"] is None]
        rows.append({
            "policy": name, "worlds": len(here), "broken": len(here) - len(good),
            "keyed": sum(world["keyed"] for world in here),
            "faults": sum(world["faults"] for world in here), "ticks": sum(world["ticks"] for world in here),
            "nodes_in_c": sum(world["devices"] for world in here),
            "largest_recovery": max((world["recovery"] for world in good), default=None),
            "largest_share_of_promise": max((world["recovery"] / world["promised"] for world in good), default=None),
            "ticks_per_processor_second": sum(w["ticks"] for w in here) / max(1e-9, sum(w["seconds"] for w in here)),
        })  # fmt: skip
        pairs = rows[-1].items()
        tell(", ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in pairs))
    ticks, spent = sum(world["ticks"] for world in found), sum(world["seconds"] for world in found)
    broken = sorted(world["seed"] for world in found if world["broken"])
    tell(
        f"{len(found)} worlds, {len(broken)} broken{': ' if broken else ''}{', '.join(map(str, broken))}; "
        f"{ticks} steps of nodes, {ticks / max(1e-9, spent):.0f} per second of one processor ({processor()})"
    )
    if new:
        tell(f"this run: {new} steps in {seconds:.0f} s, {new / seconds:.0f} per second, {asked.processes} processes")
    return {"rows": rows, "broken": broken, "ticks_per_processor_second": ticks / max(1e-9, spent)}


def run_defects(asked: argparse.Namespace) -> dict[str, Any]:
    """Find each planted defect, and print in which world it was found."""
    found = [result for result in read(asked.store) if result["defect"] in DEFECTS]
    known = {result["defect"] for result in found}
    tasks = [(name, asked.first, asked.worlds) for name in DEFECTS if name not in known]
    for result in spread(find_defect, tasks, asked.processes, asked.store):
        found.append(result)
        tell(f"{len(found)} of {len(DEFECTS)}: {result['defect']}")
    tell("| defect | worlds | what breaks |\n|---|---|---|")
    for result in sorted(found, key=lambda result: list(DEFECTS).index(result["defect"])):
        tell(f"| {result['defect']} | {result['worlds']} | {result['broken'] or 'nothing'} |")
    shown = sum(result["broken"] is not None for result in found)
    tell(f"{shown} of {len(DEFECTS)} defects found, each within {asked.worlds} worlds")
    return {"defects": found}


def main() -> None:
    """Run worlds, or find planted defects."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--worlds", type=int)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--defects", action="store_true")
    parser.add_argument("--store", type=Path)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    if asked.worlds is None:
        asked.worlds = 1_000 if asked.defects else 10_000
    document = run_defects(asked) if asked.defects else run_worlds(asked)
    if asked.json is not None:
        machine = {"python": platform.python_version(), "processor": processor(), "processes": asked.processes}
        asked.json.write_text(json.dumps(document | {"machine": machine}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
