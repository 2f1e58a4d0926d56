"""A problem while it is drawn: its tables and further files, the plant with which it begins, and its file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Tables = dict[str, Any]
STEP = 0.2  # seconds per step of a continuous plant
DIGITS = 4  # of drawn numbers, so that files are readable


class Elsewhere(Exception):  # noqa: N818 - no error
    """A feature has no place in this problem."""


@dataclass
class Draft:
    """A problem while it is drawn.

    Args:
        rng: the random numbers of the feature that is added.
        tables: the tables of the file so far.
        sizes: states, inputs and outputs of the plant.
        files: further files by name, which the tables name.
        unseen: states that the cost does not see.
    """

    rng: np.random.Generator
    tables: Tables
    files: dict[str, str] = field(default_factory=dict)
    unseen: int = 0

    @property
    def plant(self) -> Tables:
        """The table [plant]."""
        return self.tables["plant"]

    @property
    def policy(self) -> Tables:
        """The table [policy]."""
        return self.tables["policy"]

    @property
    def states(self) -> int:
        """Their number."""
        return len(self.plant["A"])

    @property
    def inputs(self) -> int:
        """Their number."""
        return len(self.plant["B"][0])

    @property
    def outputs(self) -> int:
        """Their number."""
        return len(self.plant["C"]) if "C" in self.plant else self.states

    @property
    def continuous(self) -> bool:
        """Whether the plant is in continuous time."""
        return "dt" not in self.plant

    def matrix(self, name: str) -> Array:
        """Return a matrix of the plant."""
        return np.array(self.plant[name], dtype=float)

    def table(self, name: str) -> Tables:
        """Return a table of the file, made if it is missing."""
        return self.tables.setdefault(name, {})

    def positive(self, size: int, scale: float = 1.0) -> list[list[float]]:
        """Return a positive definite matrix."""
        root = self.rng.standard_normal((size, size)) / np.sqrt(size)
        return rows(scale * (root @ root.T + 0.1 * np.eye(size)))


def rows(values: Any) -> Any:
    """Return numbers with few digits as lists."""
    return np.round(np.asarray(values, dtype=float), DIGITS).tolist()


def need(draft: Draft, *keys: str) -> None:
    """Raise ``Elsewhere`` if [plant] has not these keys."""
    if any(key not in draft.plant for key in keys):
        raise Elsewhere


def unneeded(draft: Draft, *names: str) -> None:
    """Raise ``Elsewhere`` if the file has one of these tables."""
    if any(name in draft.tables for name in names):
        raise Elsewhere


def begin(draft: Draft, n: int, m: int, p: int, modes: str) -> None:
    """Draw the plant that all features begin with: discrete in time, measured with noise, clearly reached and seen."""
    rng, p = draft.rng, min(p, n)
    first = {"modes decaying": 0.85, "modes unstable": 1.15, "modes integrating": 1.0, "modes slow": 0.985}
    for _ in range(1000):
        T = rng.standard_normal((n, n))
        values = np.diag(rng.uniform(0.2, 0.8, n) * rng.choice([-1, 1], n))
        if modes == "modes swinging" and n > 1:
            values[:2, :2] = 0.9 * np.array([[np.cos(0.7), np.sin(0.7)], [-np.sin(0.7), np.cos(0.7)]])
        else:
            values[0, 0] = first.get(modes, 0.9)
        B, C = rng.standard_normal((n, m)), rng.standard_normal((p, n))
        if np.linalg.cond(T) > 5:
            continue
        A = T @ values @ np.linalg.inv(T)
        if modes == "modes integrating":  # exactly 1 also in a few digits: the first state adds up the others
            A = np.round(A, DIGITS)
            A[:, 0] = np.eye(n)[0]
        A, B, C = (np.round(one, DIGITS) for one in (A, B, C))
        slow = [value for value in np.linalg.eigvals(A) if abs(value) > 0.8]
        reached = [np.linalg.svd(np.hstack([A - v * np.eye(n), B]), compute_uv=False)[-1] for v in slow]
        seen = [np.linalg.svd(np.hstack([A.T - v * np.eye(n), C.T]), compute_uv=False)[-1] for v in slow]
        if min([*reached, *seen, 1.0]) > 0.2 and np.abs(np.linalg.eigvals(A)).max() < 1.25:
            break
    draft.tables = {
        "plant": {"A": A.tolist(), "B": B.tolist(), "C": C.tolist(), "W": rows(0.2 * np.eye(n)),
                  "V": rows(0.1 * np.eye(p)), "dt": 1.0},
        "cost": {"Q": rows(np.eye(n)), "R": rows(0.5 * np.eye(m))},
        "policy": {"kind": "excess", "theta": 0.3},
    }  # fmt: skip


def write(draft: Draft, folder: Path, text: str) -> Path:
    """Write a problem with the files that it names, and return its place."""
    for name, content in draft.files.items():
        (folder / name).write_text(content, encoding="utf-8")
    place = folder / "problem.toml"
    place.write_text(text, encoding="utf-8")
    return place
