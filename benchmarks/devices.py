"""What nodes take on a Cortex-M3 and M4F, and what one written by hand takes: the tables of docs/devices.json.

    python benchmarks/devices.py [--json docs/devices.json]

Instructions are counted on boards that QEMU emulates. What is in the file already is kept: it can be interrupted, and
continues where it was.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import taciturn
from taciturn._arrays import Array
from taciturn._files import write_whole
from taciturn.loop import Loop
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Decide
from taciturn.program.c import c_literal
from taciturn.program.ops import Precision
from taciturn_boards.cortex import (
    M3,
    M4F,
    EmulatedBoard,
    Main,
    compile_for,
    count_instructions,
    run_on,
    self_check,
)
from taciturn_export.folder import CFolder, print_folder, record_loop
from taciturn_export.sizes import find_tool, measure_sizes

TICKS = 2000  # at most: a finite-horizon run has fewer
POLICIES: dict[str, tuple[str, dict[str, object]]] = {  # problem, and what is changed in it
    "chapter 2, two-mass": ("two-mass-lqg", {}),
    "chapter 2, two-mass, model": ("two-mass-lqg", {"actuation": "model"}),
    "chapter 3, remote-scalar": ("remote-scalar", {}),
    "chapter 3, remote-double-integrator": ("remote-double-integrator", {}),
    "chapter 5, double-integrator, consistent": ("double-integrator", {}),
    "chapter 5, two-mass, absolute": ("two-mass-lqg", {"kind": "absolute", "theta": None, "threshold": 1.0}),
    "chapter 6, rover": ("rover", {}),
    "chapter 7, lossy-double-integrator": ("lossy-double-integrator", {}),
}
DEVICES: dict[str, tuple[EmulatedBoard, Precision]] = {
    "M3 float64": (M3, "float64"),
    "M4F float64": (M4F, "float64"),
    "M4F float32": (M4F, "float32"),
}
CONTESTS = {**DEVICES, "M3 float32": (M3, "float32")}
BY_HAND = Path(__file__).parent / "two_mass_by_hand.c"
UNFUSED = '#pragma GCC optimize("fp-contract=off")'  # of taciturn_packet.h


def loop_of(file: str, changes: dict[str, object], precision: Precision) -> Loop:
    """Return the closed loop of a problem."""
    problem = taciturn.load(file).changed(changes) if changes else taciturn.load(file)
    return replace(problem.close(problem.design()), precision=precision)


def device(policy: str, name: str) -> dict[str, Any]:
    """Return what the nodes of a policy take on a device."""
    board, precision = DEVICES[name]
    loop = loop_of(*POLICIES[policy], precision)
    folder = print_folder(loop, "device")
    sizes = measure_sizes(board.target, folder)
    vector = record_loop(loop, min(TICKS, loop.horizon or TICKS), seed=1)
    counts = count_instructions(board, folder, vector)
    return {
        "nodes": {
            node.role: {
                **sizes[node.role]._asdict(),
                "operations": node.operations,
                "instructions": {what: count._asdict() for what, count in counts[node.role]._asdict().items()},
            }
            for node in folder.nodes
        },
        "core": sizes["core"]._asdict(),
    }


def numbers(policy: Policy, precision: Precision) -> str:
    """Return the matrices of the policy as what the steps by hand read."""
    sums = {step.signal: step.branches[0] for step in policy.steps if isinstance(step, Assign)}
    A, B = np.array(sums["prior"]["estimate"]), np.array(sums["prior"]["held"])
    K, L = np.array(sums["estimate"]["innovation"]), np.array(sums["command"]["estimate"])
    trigger = next(step.trigger for step in policy.steps if isinstance(step, Decide))
    silent, send = trigger.options["silent"], trigger.options["send"]

    def write(values: Array) -> str:
        return "{" + ", ".join(map(write, values)) + "}" if values.ndim else c_literal(float(values), precision)

    found = {"A": A, "B": B.ravel(), "K": K, "L": L.ravel(), "CLOSED": A + B @ L}
    lines = [
        f"static const tac_real {name}{''.join(f'[{size}]' for size in values.shape)} = {write(values)};"
        for name, values in found.items()
    ]
    scalars = {"WEIGHT": -silent.Psi[0, 0], "PRICE": silent.Psi[5, 5], "LEVEL": send.constant}
    scalars["PERIOD"] = A[0, 2] + A[0, 3]  # what two velocities that are equal add to a position
    lines += [f"#define {name} {c_literal(float(value), precision)}" for name, value in scalars.items()]
    return "\n".join(['#include "taciturn.h"', *lines]) + "\n"


def contest(name: str, fused: bool = False) -> dict[str, Any]:
    """Return the instructions of a step of the two masses' controller: generated, and written by hand in three ways."""
    board, precision = CONTESTS[name]
    loop = loop_of(*POLICIES["chapter 2, two-mass"], precision)
    folder = print_folder(loop, "device")
    own = {"by_hand.h": numbers(loop.policy, precision), "two_mass_by_hand.c": BY_HAND.read_text(encoding="utf-8")}
    sources = tuple(name for name in self_check(folder).files if name != "selfcheck.c")
    main = Main(sources, ("-ffp-contract=fast", "-std=gnu99") if fused else (), own)
    with TemporaryDirectory() as into:
        program = compile_for(board, let_fuse(folder) if fused else folder, main, Path(into))
        said = run_on(board, program, counting=True)
    rows = [line.split() for line in said.splitlines()]
    return {
        way: {"mean": int(total) / int(ticks), "longest": int(longest), "other decisions": int(other)}
        for way, total, longest, other, ticks in rows
    }


def let_fuse(folder: CFolder) -> CFolder:
    """Return sources whose products and sums the compiler may fuse, against the design's bits."""
    header = folder.files["taciturn_packet.h"]
    assert UNFUSED in header
    return replace(folder, files={**folder.files, "taciturn_packet.h": header.replace(UNFUSED, "")})


def tools() -> dict[str, str]:
    """Return the versions of compiler and emulator."""
    names = ("arm-none-eabi-gcc", "qemu-system-arm")
    calls = [
        subprocess.run([find_tool(name), "--version"], capture_output=True, text=True, check=True) for name in names
    ]
    return {name: call.stdout.splitlines()[0] for name, call in zip(names, calls, strict=True)}


def main() -> None:
    """Measure what is not in the file yet."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="where to write the tables")
    arguments = parser.parse_args()
    kept: dict[str, Any] = {"tools": tools(), "policies": {}, "by hand": {}}
    if arguments.json and arguments.json.is_file():
        kept = json.loads(arguments.json.read_text(encoding="utf-8"))

    def measure(table: dict[str, Any], name: str, found: Callable[[], Any]) -> None:
        if name not in table:
            table[name] = found()
            print(name, json.dumps(table[name]), flush=True)
            if arguments.json:
                write_whole(arguments.json, (json.dumps(kept, indent=1) + "\n").encode())

    for policy in POLICIES:
        table = kept["policies"].setdefault(policy, {})
        for name in DEVICES:
            measure(table, name, lambda policy=policy, name=name: device(policy, name))
    for name in CONTESTS:
        measure(kept["by hand"], name, lambda name=name: contest(name))
    measure(kept["by hand"], "M4F float32, fused", lambda: contest("M4F float32", fused=True))


if __name__ == "__main__":
    main()
