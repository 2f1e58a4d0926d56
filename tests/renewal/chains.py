"""Chains in many dimensions, and a plain simulation of any."""

from __future__ import annotations

import numpy as np

from taciturn.renewal.chain import Chain

KINDS = {"stable": 0.8, "neutral": 1.0, "unstable": 1.15}


def large_chain(seed, states, noises, kind="neutral", delta=2.0, seen=None):
    """Return a random chain whose noise has fewer directions than the error, or as many; δ in units of Ψ's noise."""
    draws = np.random.default_rng(seed)
    F = draws.standard_normal((states, states))
    F *= KINDS[kind] / np.abs(np.linalg.eigvals(F)).max()
    G = draws.standard_normal((states, noises))
    weights = [draws.standard_normal((rank, states)) for rank in (seen or states, 2)]
    Psi, Gamma = (weight.T @ weight / np.trace(weight @ G @ G.T @ weight.T) for weight in weights)
    return Chain(F, G @ G.T, Psi, delta, Gamma)


def simulated(chain, seed, paths=4000, checks=400, burn_in=300):
    """Return rate and excess with their standard errors, over independent paths after the first checks."""
    draws, states = np.random.default_rng(seed), len(chain.F)
    values, vectors = np.linalg.eigh(chain.noise)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    error, sent, cost = np.zeros((paths, states)), np.zeros(paths), np.zeros(paths)
    for check in range(checks + burn_in):
        error = error @ chain.F.T + draws.standard_normal((paths, states)) @ half.T
        over = ((error @ chain.Psi) * error).sum(axis=1) > chain.delta
        error[over] = 0.0
        if check >= burn_in:
            sent += over / checks
            cost += ((error @ chain.Gamma) * error).sum(axis=1) / checks
    return [(seen.mean(), seen.std(ddof=1) / np.sqrt(paths)) for seen in (sent, cost)]
