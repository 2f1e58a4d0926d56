"""Worlds of faults: how many hold, how soon nodes recover, and how many steps of nodes run per second.

    python benchmarks/worlds.py [--worlds 10000] [--first 0] [--processes 2] [--json OUT]

World k runs the policy k mod 4 of the four below, and about half of its nodes in C if there is a compiler.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import taciturn
from taciturn.study.worlds import run_world_with_devices

BUILT_IN = ("remote-scalar", "double-integrator", "lossy-double-integrator", "two-mass")


@cache
def problem(name: str) -> taciturn.Problem:
    """Return a problem whose policy has no horizon."""
    found = taciturn.load(name)
    return found.changed({"cost.horizon": None}) if found.cost.horizon else found


def run(seed: int) -> dict[str, Any]:
    """Return what happened in the world of a seed."""
    found = run_world_with_devices(problem(BUILT_IN[seed % len(BUILT_IN)]), seed)
    counted = {"faults": len(found.faults), "devices": len(found.devices), "ticks": found.ticks, "steps": found.steps}
    return counted | {
        "seed": seed, "broken": found.broken, "recovery": found.recovery, "promised": found.promised,
        "seconds": found.seconds,
    }  # fmt: skip


def main() -> None:
    """Run the worlds, and print one line per policy and one for all."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--worlds", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    began = time.monotonic()
    with ProcessPoolExecutor(asked.processes) as pool:
        found = list(pool.map(run, range(asked.first, asked.first + asked.worlds), chunksize=20))
    rows: list[dict[str, Any]] = []
    for i, name in enumerate(BUILT_IN):
        here = [world for world in found if world["seed"] % len(BUILT_IN) == i]
        good = [world for world in here if world["broken"] is None]
        rows.append({
            "policy": name, "worlds": len(here), "broken": len(here) - len(good),
            "faults": sum(world["faults"] for world in here), "ticks": sum(world["ticks"] for world in here),
            "nodes_in_c": sum(world["devices"] for world in here),
            "largest_recovery": max((world["recovery"] for world in good), default=None),
            "largest_share_of_promise": max((world["recovery"] / world["promised"] for world in good), default=None),
            "ticks_per_processor_second": sum(w["ticks"] for w in here) / max(1e-9, sum(w["seconds"] for w in here)),
        })  # fmt: skip
        print(
            ", ".join(
                f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
                for key, value in rows[-1].items()
            )
        )
    seconds = time.monotonic() - began
    for world in found:
        if world["broken"]:
            print(f"{BUILT_IN[world['seed'] % len(BUILT_IN)]}, world {world['seed']}: {world['broken']}")
    ticks = sum(world["ticks"] for world in found)
    print(f"{len(found)} worlds, {ticks} steps of nodes in {seconds:.0f} s: {ticks / seconds:.0f} per second")
    if asked.json is not None:
        machine = {"python": platform.python_version(), "machine": platform.machine(), "processes": asked.processes}
        document = {"rows": rows, "seconds": seconds, "ticks_per_second": ticks / seconds, "machine": machine}
        asked.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
