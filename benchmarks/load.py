"""One controller process serves many loops over loopback: how late, how many steps lost, how much of a processor.

    python benchmarks/load.py [--loops 200] [--tick 0.01] [--steps 1000] [--json OUT]

This process plays all sensors and plants: it tells the measurements of every loop at absolute deadlines, and counts the
packets that come back. What it costs itself is told next to, for both share the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path

import numpy as np

import taciturn
from taciturn.nodes.packet import Packet, Wire
from taciturn_udp.endpoint import Endpoint, free_addresses, parse_address
from taciturn_udp.processes import Process


def serve(loops: int, tick: float, ticks: int) -> dict[str, object]:
    """Run one controller process and return its report, with what was sent and came back here."""
    problem = taciturn.load("two-mass-lqg")
    wire = Wire(problem.design(), problem.network)
    here, there = (f"{host}:{port}" for host, port in free_addresses(2))
    endpoint, to = Endpoint(parse_address("here", here)), parse_address("there", there)
    arguments = ["node", "controller", "two-mass-lqg", "--loops", str(loops), "--real-time", "--tick", repr(tick)]
    process = Process([*arguments, "--bind", there, "--peer", here, "--plant", here])
    process.expect()
    draws = np.random.default_rng(0).standard_normal((64, loops, 2))
    back, own, begin = 0, time.process_time(), time.monotonic() + 0.1
    slip: list[float] = []
    for k in range(ticks):
        while (now := time.monotonic()) < begin + k * tick:
            back += len(endpoint.receive(begin + k * tick))
        slip.append(now - begin - k * tick)
        for loop, y in enumerate(draws[k % 64].tolist()):
            endpoint.send(wire.encode(Packet("measurement", "plant", k, k, tuple(y), 0, loop)), to)
    while found := endpoint.receive(time.monotonic() + 0.3):
        back += len(found)
    own = time.process_time() - own
    report = process.stop()
    stepped = report["counters"].get("sent mark actuator", 0)
    answered = back - stepped
    return {
        "loops": loops,
        "rate_hz": 1 / tick,
        "ticks": loops * ticks,
        "lost_ticks": loops * ticks - report["physical"] + report["counters"].get("missed", 0),
        "dropped_by_kernel": report["datagrams"]["dropped_by_kernel"],
        "packets_back": answered,
        "packets_sent": report["counters"]["sent data actuator"],
        "lateness_ms": report["lateness_ms"],
        "cpu_share": round(report["cpu_seconds"] / (ticks * tick), 3),
        "driver_cpu_share": round(own / (ticks * tick), 3),
        "driver_late_ms_p99": round(1e3 * float(np.percentile(slip, 99)), 3),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--loops", type=int, nargs="+", default=[20, 50, 100, 200])
    parser.add_argument("--tick", type=float, default=0.01)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    machine = {"processors": os.cpu_count(), "python": platform.python_version(), "system": platform.system()}
    rows = [serve(loops, given.tick, given.steps) for loops in given.loops]
    for row in rows:
        print(json.dumps(row))
    if given.json:
        given.json.write_text(json.dumps({"machine": machine, "runs": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
