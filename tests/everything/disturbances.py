"""Features of disturbances: their shapes, biased sensors, and values that change at stated times."""

from __future__ import annotations

from collections.abc import Callable

from everything.draft import DIGITS, STEP, Draft, Tables, need, rows


def disturbance(kind: str) -> Callable[[Draft], None]:
    """Add a disturbance."""

    def add(draft: Draft) -> None:
        entry: Tables = {"enters": rows(draft.matrix("B")[:, 0]), "kind": kind, "wander": 0.01}
        if kind == "sinusoid":
            entry["frequency"] = 0.3
        if kind == "matrix":
            entry["matrix"] = [[0.0, 1.0], [-1.0, -0.4]] if draft.continuous else [[0.9, 0.3], [-0.3, 0.9]]
        draft.tables.setdefault("disturbance", []).append(entry)

    return add


def load(keys: Tables, file: bool = False) -> Callable[[Draft], None]:
    """Add a disturbance with stated values, two changes within the first steps."""

    def add(draft: Draft) -> None:
        pace = STEP if draft.continuous else 1.0
        entry: Tables = {"enters": rows(draft.rng.standard_normal(draft.states)), "initial": 0.3, **keys}
        if "C" in draft.plant:
            entry["measured"] = rows(0.3 * draft.rng.standard_normal(draft.outputs))
        steps = [[round(4.7 * pace, DIGITS), -0.5], [round(9 * pace, DIGITS), 0.6]]
        if file:
            draft.files["load.csv"] = "".join(f"{time:g},{value:g}\n" for time, value in steps)
        draft.tables.setdefault("disturbance", []).append(entry | ({"file": "load.csv"} if file else {"steps": steps}))

    return add


def bias(draft: Draft) -> None:
    """Add a second disturbance, which biases the first output."""
    need(draft, "C")
    entry: Tables = {"enters": [0.0] * draft.states, "measured": [1.0] + [0.0] * (draft.outputs - 1), "wander": 0.002}
    draft.tables.setdefault("disturbance", []).append(entry)


def stepping_bias(draft: Draft) -> None:
    """Add a bias that the filter estimates, and that changes at a known time."""
    bias(draft)
    draft.tables["disturbance"][-1]["steps"] = [[6 * (STEP if draft.continuous else 1.0), 1.0]]
