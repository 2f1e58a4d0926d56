"""Random plants whose filters settle soon, and what a query is worth, by its definition in sixty digits."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
from digits import exactly
from hypothesis import assume
from hypothesis import strategies as st

from taciturn import Plant, UnstableError
from taciturn._modes import radius
from taciturn.lqg.kalman import steady_filter

SEEDS = st.integers(0, 2**32 - 1)
TIMES = [{}, {"discount": 0.8}, {"discount": 0.5}, {"horizon": 1}, {"horizon": 17}]


def semidefinite(rng: np.random.Generator, size: int, rank: int | None = None) -> np.ndarray:
    """Return a random covariance without rounding errors: one of less than full rank is so exactly."""
    root = np.round(16 * rng.normal(size=(size, size if rank is None else rank))) / 32
    return root @ root.T


def random_plant(seed: int, kind: str = "output", largest: int = 3) -> Plant:
    """Return a plant whose steady filter forgets within a few dozen steps; the noises of its outputs are separate."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, largest + 1))
    m, p = int(rng.integers(1, n + 1)), int(rng.integers(1, n + 1))
    A, B, C = rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.normal(size=(p, n))
    A *= rng.uniform(0.3, 1.2) / radius(A)
    for block in (np.vstack([A, C]), np.hstack([A, B]).T):
        slow = [value for value in np.linalg.eigvals(A) if abs(value) > 0.9]
        M, rest = block[:n], block[n:]
        assume(all(np.linalg.svd(np.vstack([M - s * np.eye(n), rest]))[1][n - 1] > 0.2 for s in slow))
    start = {"mean": rng.normal(size=n), "covariance": semidefinite(rng, n, int(rng.integers(0, n + 1)))}
    if kind == "full state":
        return Plant(A, B, semidefinite(rng, n, int(rng.integers(1, n + 1))), **start)
    W = semidefinite(rng, n, int(rng.integers(0, n)) if kind == "singular W" else None)
    V = np.diag(rng.uniform(0.05, 1, p))
    if kind == "some outputs without noise":
        V = V * (rng.random(p) < 0.5)
    plant = Plant(A, B, W, C, V, **start)
    try:
        found = steady_filter(A, C, W, V)
    except UnstableError:
        assume(False)
    assume(radius(A - A @ found.gain @ C) < (0.75 if kind == "some outputs without noise" else 0.9))
    return plant


def sixty_digits(plant: Plant, Sigma, P, discount: float = 1.0, terms: int | None = None) -> float:
    """Return Σ_s α^{s+1} tr(P_s (Ric^s(AΣA' + W) − Ric^{s+1}(Σ))), subtracting what was iterated, as it is written.

    Outputs are taken one after the other, which is the same where their noises are separate. Rounding errors of what is
    known exactly grow from step to step, so noise-free outputs take more digits.
    """
    size, usual = (60, 300) if (np.diag(plant.V) > 0).all() else (600, 80)
    A, C, W = (exactly(getattr(plant, name)) for name in "ACW")
    noise, alpha = exactly(np.diag(plant.V)), Decimal(discount)

    def silent(X):
        return A @ X @ A.T + W

    def queried(X):
        for row, variance in zip(C, noise, strict=True):
            seen = X @ row
            spread = row @ seen + variance
            X = X - np.outer(seen, seen) / spread if spread > Decimal(10) ** (-size // 2) else X
        return silent(X)

    with localcontext() as context:
        context.prec = size
        Sigma, total = exactly(Sigma), Decimal(0)
        late, early = silent(Sigma), queried(Sigma)
        for s in range((terms or usual) if np.ndim(P) == 2 else len(P)):
            weight = exactly(P if np.ndim(P) == 2 else P[s])
            total += alpha ** (s + 1) * np.sum(weight * (late - early))
            late, early = queried(late), queried(early)
        return float(total)


def follow(plant: Plant, Sigma: np.ndarray, query: bool) -> np.ndarray:
    """Return the next covariance, by the formula."""
    following = plant.A @ Sigma @ plant.A.T + plant.W
    if query:
        cross = plant.A @ Sigma @ plant.C.T
        following = following - cross @ np.linalg.solve(plant.C @ Sigma @ plant.C.T + plant.V, cross.T)
    return (following + following.T) / 2
