"""Where the guarantee of a linearisation still holds on the plant: the table and the picture of docs/nonlinear.md.

    python benchmarks/nonlinear.py [--json docs/nonlinear.json]

Each cell is a plant that is not linear, under so many times the noise of its problem file, with a policy that was
designed on the linearisation for that noise. Cells that are in the file already are kept: it can be interrupted, and
continues where it was.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import taciturn
from taciturn import Plant, UnstableError

SCALES = {
    "pendulum-on-a-cart": (2.0, 4.0, 6.0, 8.0, 9.0, 10.0, 11.0),
    "omni-heading": (4.0, 8.0, 12.0, 16.0, 20.0, 24.0, 28.0),
}  # standard deviation of the noise, in that of the problem
THETAS = (0.03, 0.1, 0.3, 1.0)
STEPS = 30_000_000  # of a cell, all paths together
SEED = 1


def noisier(plant: Plant, scale: float) -> Plant:
    """Return a plant whose noise has so many times the standard deviation."""
    return Plant(plant.A, plant.B, scale**2 * plant.W, dt=plant.dt, function=plant.function)


def measure(name: str, scale: float, theta: float) -> dict[str, Any]:
    """Return what a cell costs and sends next to what is proved of its linearisation, or why it does not settle."""
    problem = taciturn.load(name)
    plant = noisier(problem.plant, scale)
    policy, always = (taciturn.design.lqg(plant, problem.cost, theta=one) for one in (theta, 0.0))
    loop, other = taciturn.close(plant, policy), taciturn.close(plant, always)
    cell: dict[str, Any] = {"plant": name, "scale": scale, "theta": theta}
    cell |= {"cost_all_time": policy.cost_all_time, "cost_bound": policy.guarantee.cost}
    try:
        found = taciturn.average(loop, seed=SEED, steps=STEPS)
        more = taciturn.difference(loop, other, seed=SEED, steps=STEPS)
        path = taciturn.simulate(loop, 20_000, seed=SEED)
    except UnstableError as error:
        return cell | {"fails": str(error)}
    return cell | {
        "cost": found.cost.value,
        "standard_error": found.cost.standard_error,
        "rate": found.rates["actuator"].value,
        "above_always": more.cost.value,
        "above_always_standard_error": more.cost.standard_error,
        "angle": float(path.state[:, 2].std()),
        "steps": found.steps,
    }


def main() -> None:
    """Compute all cells and write them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="where to write the cells")
    arguments = parser.parse_args()
    cells: list[dict[str, Any]] = []
    if arguments.json and arguments.json.is_file():
        cells = json.loads(arguments.json.read_text(encoding="utf-8"))
    order = [(name, scale, theta) for name, scales in SCALES.items() for scale in scales for theta in THETAS]
    for key in order:
        if any((cell["plant"], cell["scale"], cell["theta"]) == key for cell in cells):
            continue
        cell = measure(*key)
        cells.append(cell)
        cells.sort(key=lambda cell: order.index((cell["plant"], cell["scale"], cell["theta"])))
        shown = cell.get("fails") or (
            f"{cell['cost'] / cell['cost_all_time']:.4f} ± {cell['standard_error'] / cell['cost_all_time']:.4f}"
            f" of the linear all-time cost, at most {1 + key[2]:g}; angle {cell['angle']:.3f} rad"
        )
        print(f"{key[0]:20s}{key[1]:5g}{key[2]:5g}  {shown}", flush=True)
        if arguments.json:
            arguments.json.write_text(json.dumps(cells, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
