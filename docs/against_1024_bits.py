"""The figure of the page *Limits and accuracy*: errors of sampled Riccati solutions against 1,024 bits."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from flint import arb_mat, ctx
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from taciturn import ContinuousPlant, Cost
from taciturn.lqg.discrete import discretise

Matrix = NDArray[np.float64]


def reference(*given: Matrix) -> Matrix:
    """Return K by doubling: after k turns, that of 2^k steps."""
    A, B, Q, R, N = (arb_mat(part.tolist()) for part in given)
    one, across, free = arb_mat(np.eye(A.nrows()).tolist()), N.transpose(), R.inv()
    A, G, K = A - B * free * across, B * free * B.transpose(), Q - N * free * across
    for _ in range(45):
        inner, turned = (one + G * K).inv().mid(), A.transpose()
        A, G, K = (A * inner * A).mid(), (G + A * inner * G * turned).mid(), (K + turned * K * inner * A).mid()
    return np.array(K.tolist(), dtype=float)


def sampled(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, h: float) -> tuple[Matrix, ...]:
    """Return the problem of one period, by Van Loan's exponential."""
    n, k = len(A), sum(B.shape)
    F, M = np.zeros((k, k)), np.zeros((k, k))
    F[:n, :n], F[:n, n:], M[:n, :n], M[n:, n:] = A, B, Q, R
    found = np.array((arb_mat(np.block([[-F.T, M], [0 * F, F]]).tolist()) * h).exp().tolist())
    moved, weight = found[k:, k:], found[k:, k:].T @ found[:k, k:]
    return moved[:n, :n], moved[:n, n:], weight[:n, :n], weight[n:, n:], weight[:n, n:]


def off(found: Matrix, exact: Matrix) -> float:
    """Return the largest error, each state in the unit of its own cost."""
    unit = np.sqrt(np.diag(exact))
    return np.abs((found - exact) / unit / unit[:, None]).max()


def draw() -> Figure:
    """Return the errors of forty random chains of lags."""
    ctx.prec = 1024  # bits of the reference
    draws, points = np.random.default_rng(1), []
    for h in np.geomspace(1e-6, 1e-1, 40):
        n = draws.integers(2, 7)
        rates, unit = 10 ** draws.uniform(-2, 2, n), 10 ** draws.uniform(-4, 4, n)
        A, B = np.diag(-rates) + np.diag(rates[1:], -1), rates[0] * np.eye(n)[:, :1]
        A, B, Q, R = (
            A / unit[:, None] * unit,
            B / unit[:, None],
            np.diag(np.eye(n)[-1] * unit**2),
            np.full((1, 1), 1e-3),
        )
        K, given = reference(*sampled(A, B, Q, R, h)), discretise(ContinuousPlant(A, B, 0 * A), Cost(Q, R), h)
        found = given.regulator()
        claimed = (np.diag(found.error) / np.diag(found.K)).max()
        doubles = solve_discrete_are(given.plant.A, given.plant.B, given.Q, given.R, s=given.N)
        points.append((h, off(doubles, K), claimed, max(off(found.K, K), 1e-17)))
        assert off(found.K, K) <= claimed + 1e-15 <= 1.1e-9  # the reference is rounded to doubles
    figure, axes = plt.subplots(figsize=(7, 3.6), layout="constrained")
    names = "error of scipy", "proved bound of Taciturn", "error of Taciturn"
    for values, mark, name in zip(np.transpose(points)[1:], "x_.", names, strict=True):
        axes.plot(np.transpose(points)[0], values, mark, label=name)
    axes.set(xscale="log", yscale="log", xlabel="sampling period in s", ylabel="relative error of the cost-to-go")
    axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure
