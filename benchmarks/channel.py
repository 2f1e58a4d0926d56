"""Many loops on one channel: the tables of docs/channels.md.

    python benchmarks/channel.py [--json docs/channel.json]

Parts that are in the file already are kept: it can be interrupted, and continues where it was.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported: times are of one thread

import taciturn
from taciturn import Problem, share_channel
from taciturn_channel.classes import Kind, gather
from taciturn_channel.prices import Curves
from taciturn_channel.schedulers import SCHEDULERS, Game
from taciturn_channel.simulated import Group, measure_freely

DOUBLE, PENDULUM, MASSES = "wiener-double-integrator", "inverted-pendulum", "two-mass-lqg"
SIZES = (2, 10, 100, 1000, 10_000, 100_000)
BUDGETS = {  # of the cost of a loop, in all-time costs
    DOUBLE: (1.05, 1.1, 1.2, 1.5, 2.0),
    PENDULUM: (1.05, 1.1, 1.2, 1.5, 2.0),
    MASSES: (1.05, 1.1),
}
SLOTS = (1, 10, 100)  # capacities of the table of loops per channel
TICKS = 200  # that are timed
ROUNDS = 5


def mixed() -> dict[str, Problem]:
    """Return the two kinds of loops of most tables: four of five are double integrators."""
    return {DOUBLE: taciturn.load(DOUBLE), PENDULUM: taciturn.load(PENDULUM)}


def split(loops: int) -> list[int]:
    """Return how many of so many loops are of each kind."""
    second = max(1, loops // 5)
    return [loops - second, second]


def gap(loops: int) -> dict[str, Any]:
    """Return what loops on a channel with a slot for every tenth cost, and what none can beat."""
    found = share_channel(mixed(), copies=split(loops), capacity=max(1, loops // 10))
    return found.document()


def schedulers(name: str) -> dict[str, Any]:
    """Return what a thousand loops with a hundred slots cost by a scheduler."""
    return share_channel(mixed(), copies=split(1000), capacity=100, scheduler=name).document()  # pyright: ignore[reportArgumentType]


def twenty() -> dict[str, Any]:
    """Return how long the common price of a thousand loops of twenty plants takes."""
    problems: dict[str, Problem] = {}
    for i in range(20):
        name, factor = (DOUBLE, PENDULUM)[i % 2], 1.15**i
        base = taciturn.load(name)
        W = [[factor * float(entry) for entry in row] for row in base.plant.W]
        R = [[float(base.cost.R[0, 0]) * (0.5 + i / 10)]]
        problems[f"{name} {i}"] = base.changed({"plant.W": W, "cost.R": R})
    began = time.perf_counter()
    game = Game(gather(problems, [50]), 100, 0)
    load = SCHEDULERS["price"](game).load
    seconds = time.perf_counter() - began
    assert load is not None
    return {"kinds": 20, "loops": 1000, "capacity": 100, "seconds": seconds, "price": game.price, "load": load.value,
            "prices_per_kind": len(game.curves.table)}  # fmt: skip


def growth(loops: int) -> dict[str, Any]:
    """Return nanoseconds and bytes per loop: of a step of the price policy, and of memory."""
    game = Game(gather({DOUBLE: taciturn.load(DOUBLE)}, [loops]), loops // 10, 0)
    plan = SCHEDULERS["price"](game)
    channel = game.play(plan, game.channels)
    channel.run(TICKS)
    seconds: list[float] = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        channel.run(TICKS)
        seconds.append((time.perf_counter() - began) / TICKS)
    tracemalloc.start()
    again = game.play(plan, 1)
    again.run(10)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {"loops": loops, "channels": game.channels, "bytes_per_loop": peak / loops,
            "nanoseconds": 1e9 * sorted(seconds)[ROUNDS // 2] / loops / game.channels}  # fmt: skip


def excess_at(kind: Kind, rate: float) -> float:
    """Return what a check costs beyond sending every sample under the nearly best triggers of a rate, by simulation."""
    curve, low, high = Curves([kind]), 1e-9, 1e9
    for _ in range(60):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if curve.rates(middle)[0] > rate else (low, middle)
    group = Group(kind.F, kind.noise, kind.Gamma, curve.settle(high)[0].schedule.urgency, 16_384)
    return float(measure_freely(group, int(60 / rate), seed=0)[1].mean())


def crossing(cost: Callable[[float], float], limit: float, low: float, high: float, digits: float) -> float:
    """Return where a decreasing function of a rate falls below a limit."""
    while high / low > 1 + digits:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if cost(middle) <= limit else (middle, high)
    return high


def carried(name: str, budget: float) -> dict[str, Any]:
    """Return how many loops a slot carries if each may cost so many times what sending every sample costs."""
    problem = taciturn.load(name)
    (kind,) = gather({name: problem}, [1])
    limit = (budget - 1) * kind.cost_all_time
    clock = crossing(kind.clocked.cost, limit, 1e-3, 1.0, 1e-9)
    free = crossing(lambda rate: excess_at(kind, rate), limit, 1e-3, 0.97, 0.005)
    row: dict[str, Any] = {"problem": name, "budget": budget, "clock": 1 / clock, "free": 1 / free}
    for slots in SLOTS:
        low, high = int(slots / clock), int(slots / free) + 2  # loops that fit, and that do not
        while high - low > max(1, 0.01 * low):
            loops = (low + high) // 2
            found = share_channel(
                {name: problem},
                copies=loops,
                capacity=slots,
                standard_error=0.002 * budget * kind.cost_all_time * loops,
                confidence=0,
            )
            low, high = (loops, high) if found.cost.value <= budget * found.cost_all_time else (low, loops)
        row[f"slots {slots}"] = low / slots
    return row


def main() -> None:
    """Compute all tables and write them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, default=Path("docs/channel.json"))
    path: Path = parser.parse_args().json
    done: dict[str, Any] = {"machine": platform.processor()}
    if path.exists():
        done = json.loads(path.read_text(encoding="utf-8"))
    jobs: dict[str, Callable[[], dict[str, Any]]] = {f"gap {loops}": lambda m=loops: gap(m) for loops in SIZES}
    jobs |= {f"scheduler {name}": lambda n=name: schedulers(n) for name in SCHEDULERS}
    jobs |= {"twenty": twenty}
    jobs |= {f"growth {loops}": lambda m=loops: growth(m) for loops in SIZES[3:]}
    jobs |= {
        f"carried {name} {budget}": lambda n=name, b=budget: carried(n, b)
        for name, budgets in BUDGETS.items()
        for budget in budgets
    }
    for name, job in jobs.items():
        if name not in done:
            began = time.perf_counter()
            done[name] = job()
            path.write_text(json.dumps(done, indent=1) + "\n", encoding="utf-8")
            print(f"{name}: {time.perf_counter() - began:.1f} s", flush=True)


if __name__ == "__main__":
    main()
