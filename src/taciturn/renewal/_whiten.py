"""A chain with Gaussian noise as a quadrature sees it: no idle directions, white noise, a diagonal trigger."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._modes import root
from taciturn.renewal.chain import Chain, JumpNoise, NoQuadratureError

CRUMB = 1e-13  # relative: a weight this much smaller than the largest is rounding
RANK = 1e-10  # relative: a direction this much weaker than the strongest is rounding
MOST_STATES = 3
SOFT = np.pi / 2  # exp(−SOFT m x²/2) has the mass of the interval m x² ≤ 1
SETTLED = 1e-6
AGES = 20_000  # checks


@dataclass(frozen=True, eq=False)
class White:
    """The chain x⁺ = F x + w, w ~ N(0, I), kept where Σ_i m_i x_i² ≤ 1, at a cost x'Γx.

    Args:
        F: (n, n).
        m: ascending, so the axes that bind least come first, (n,).
        Gamma: (n, n).
        rows: x = rows e for an error e of the chain it is made of, (n, states).
    """

    F: Array
    m: Array
    Gamma: Array
    rows: Array


@dataclass(frozen=True, eq=False)
class Data:
    """A chain with a threshold of 1.

    Args:
        F: (n, n).
        noise: (n, n).
        Psi: Ψ/δ, (n, n).
        Gamma: (n, n).
        rows: of the coordinates, in those of the chain, (n, states).
    """

    F: Array
    noise: Array
    Psi: Array
    Gamma: Array
    rows: Array

    def seen_in(self, rows: Array, columns: Array) -> Data:
        """Return the data for z = rows e, e = columns z."""
        return Data(
            rows @ self.F @ columns,
            symmetrised(rows @ self.noise @ rows.T),
            symmetrised(columns.T @ self.Psi @ columns),
            symmetrised(columns.T @ self.Gamma @ columns),
            rows @ self.rows,
        )


def reduced(chain: Chain) -> Data:
    """Return the chain without the directions that no noise ever reaches or nothing ever sees.

    Args:
        chain: with Gaussian noise.

    Returns:
        The chain in as few coordinates.

    Raises:
        NoQuadratureError: jumps; nothing is ever sent.

    Source: khashooei2017
    """
    if isinstance(chain.noise, JumpNoise):
        raise NoQuadratureError("the noise comes in jumps; expected Gaussian noise; ask for the quadrature of jumps")
    data = _seen(_reached(Data(chain.F, chain.noise, chain.Psi / chain.delta, chain.Gamma, np.eye(len(chain.F)))))
    if not data.Psi.any():
        raise NoQuadratureError(
            "nothing is ever sent: the noise reaches no direction of the error that is weighed; expected some; give "
            "the plant noise, or weigh the states that it reaches"
        )
    return data


def whiten(chain: Chain, otherwise: str = "simulate instead") -> White:
    """Return the chain without the directions that no noise reaches or nothing sees, its noise white, Ψ diagonal.

    Args:
        chain: with Gaussian noise.
        otherwise: what the reader of a refusal is told to do.

    Returns:
        The chain in at most three coordinates.

    Raises:
        NoQuadratureError: jumps; nothing is ever sent; more than three states; a direction without noise.

    Source: khashooei2017
    """
    data = reduced(chain)
    n = len(data.F)
    if n > MOST_STATES:
        raise NoQuadratureError(
            f"{n} directions of the error are reached by noise and count, and a quadrature takes at most "
            f"{MOST_STATES} of them; {otherwise}"
        )
    half = root(data.noise)
    if half.shape[1] < n:
        raise NoQuadratureError(
            f"the noise of one check fills {half.shape[1]} of the {n} directions of the error that count, and a "
            f"quadrature needs all of them; {otherwise}"
        )
    m, turn = np.linalg.eigh(symmetrised(half.T @ data.Psi @ half))
    inverse: Array = np.asarray(np.linalg.inv(half @ turn), dtype=np.float64)
    white = data.seen_in(inverse, half @ turn)
    return White(white.F, np.where(m > 1e-15 * n * m[-1], m, 0.0), white.Gamma, white.rows)


def spread(white: White) -> Array:
    """Return about the covariance of kept errors: that of the chain kept with probability exp(−½ SOFT Σ m_i x_i²).

    Its errors stay Gaussian at every age, so their covariances and the share that gets so old are known.

    Args:
        white: the chain.

    Returns:
        (n, n), definite; the larger side of the truth where the trigger binds.

    Raises:
        NoQuadratureError: kept errors grow without bound.

    Source: khashooei2017
    """
    unit = np.eye(len(white.m))
    before, last, share = unit, np.zeros_like(unit), 1.0
    total, shares = np.zeros_like(unit), 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(AGES):
            soft = unit + SOFT * before * white.m
            kept = symmetrised(np.asarray(np.linalg.solve(soft, before), dtype=np.float64))
            share /= float(np.sqrt(max(np.linalg.det(soft), 1.0)))
            total, shares = total + share * kept, shares + share
            if not np.isfinite(total).all():
                break
            if np.abs(kept - last).max() <= SETTLED * np.abs(kept).max():
                return kept
            if share <= SETTLED * shares and share * np.abs(kept).max() <= SETTLED * np.abs(total).max():
                return total / shares
            last, before = kept, symmetrised(white.F @ kept @ white.F.T) + unit
        else:
            return total / shares
    raise NoQuadratureError(
        "kept errors grow without bound where Ψ does not see them; expected a Ψ that sees every growing direction of "
        "the error; simulate instead"
    )


def _reached(data: Data) -> Data:
    """Return the data on the span of the noises that add up over the checks."""
    half = root(data.noise)
    size = float(np.linalg.norm(data.F, 2)) if data.F.any() else 1.0
    blocks = [half]
    for _ in range(len(data.F) - 1):
        blocks.append(data.F @ blocks[-1] / size)
    reach = np.hstack(blocks)
    lengths = np.linalg.norm(reach, axis=1)
    unit = np.where(lengths > 0, lengths, 1.0)  # the units of the states decide nothing
    left, values, _ = np.linalg.svd(reach / unit[:, None], full_matrices=False)
    basis: Array = np.asarray(left[:, values > RANK * values.max(initial=0.0)], dtype=np.float64)
    weight: Array = np.asarray(values[: basis.shape[1]], dtype=np.float64)
    # each direction in units of what the noise does to it
    return data.seen_in((basis / weight).T / unit, unit[:, None] * basis * weight)


def _half(weight: Array) -> Array:
    """Return H with H'H = weight but for rounding, of coordinates in units of what the noise does to them."""
    values, vectors = np.linalg.eigh(weight / np.abs(weight).max())
    kept = values > CRUMB * len(weight)
    return (vectors[:, kept] * np.sqrt(values[kept])).T


def _seen(data: Data) -> Data:
    """Return the data without the directions that neither Ψ nor Γ sees, now or later."""
    if not data.F.size:
        return data
    size = float(np.linalg.norm(data.F, 2)) if data.F.any() else 1.0
    halves = [_half(weight) for weight in (data.Psi, data.Gamma) if weight.any()]
    blocks = [np.vstack([np.zeros((1, len(data.F))), *halves])]
    for _ in range(len(data.F) - 1):
        blocks.append(blocks[-1] @ data.F / size)
    _, values, right = np.linalg.svd(np.vstack(blocks), full_matrices=False)
    rows: Array = np.asarray(right[values > RANK * values.max(initial=0.0)], dtype=np.float64)
    return data.seen_in(rows, rows.T)
