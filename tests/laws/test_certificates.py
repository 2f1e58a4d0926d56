"""No certificate is contradicted by simulation, for random systems, unstable plants and cross terms included."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
import pytest
from catalogue import POLICIES, closed
from counts import scaled
from drawn import over
from hypothesis import strategies as st
from systems import System, systems

from taciturn import Loop
from taciturn.analyse.switched import Switched, switched, switched_innovations
from taciturn.simulation.average import average, plain_average
from taciturn_certify.certificates import (
    SHARES,
    Certificate,
    NoCertificateError,
    bound_cost,
    bound_state,
    find_decay,
    find_gain,
)

Found = TypeVar("Found")
NAMES = (
    "lqg joint hold",
    "lqg joint model",
    "lqg separate hold",
    "absolute",
    "absolute state model",
    "relative",
    "mixed model",
    "send-on-delta",
)
ROUNDING = 1e-9  # relative, of what is simulated


def proved(find: Callable[[Switched], Found], loop: Switched) -> Found | None:
    """Return what is proved, or None."""
    try:
        return find(loop)
    except NoCertificateError:
        return None


def actions(loop: Switched, z: np.ndarray) -> np.ndarray:
    """Return the action that is taken in each column."""
    values = [(z * (Psi @ z)).sum(axis=0) + c for Psi, c in zip(loop.Psi, loop.c, strict=True)]
    return np.argmin(values, axis=0)


def weighed(matrices: tuple[np.ndarray, ...], taken: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return z'M_iz of each column under its action."""
    each = np.stack([(z * (M @ z)).sum(axis=0) for M in matrices])
    return each[taken, np.arange(z.shape[1])]


def moved(loop: Switched, taken: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return F_i z of each column under its action."""
    return np.stack([F @ z for F in loop.F])[taken, :, np.arange(z.shape[1])].T


def sizes(loop: Switched, proof: Certificate, z: np.ndarray) -> np.ndarray:
    """Return |z|² times the largest number in sight, against which rounding is measured."""
    return (np.abs(np.stack(proof.matrices)).max() + np.abs(loop.M).max()) * ((z**2).sum(axis=0) + 1)


def states_at_random(loop: Switched, seed: int, number: int) -> np.ndarray:
    """Return states of all sizes, some of them next to the border between two actions."""
    draws = np.random.default_rng(seed)
    z = draws.standard_normal((loop.states, number)) * draws.lognormal(0.0, 2.0, number)
    for _ in range(5):  # along the loop they come to where it lives
        half = z[:, : number // 2]
        z[:, : number // 2] = moved(loop, actions(loop, half), half)
    return z


def no_decay_is_contradicted(loop: Switched, seed: int) -> bool:
    """V falls by ρ² less β at every state, and a state vanishes no more slowly than ρ^k."""
    found = proved(find_decay, loop)
    if found is None:
        return False
    z = states_at_random(loop, seed, 1000)
    before = actions(loop, z)
    after = moved(loop, before, z)
    P = found.proof.matrices
    V, following = weighed(P, before, z), weighed(P, actions(loop, after), after)
    slack = ROUNDING * sizes(loop, found.proof, z)
    assert (following <= found.rate**2 * V + found.residual + slack).all()
    start = np.linalg.norm(z, axis=0)
    slowest = 1 - min(SHARES) * (1 - found.rate**2)  # by which V falls in the proof of the limit, at least
    ticks = 120 if found.overshoot is not None else int(np.ceil(np.log(1e-14) / np.log(slowest)))
    if ticks > 1000:
        return True
    for tick in range(1, ticks + 1):
        z = moved(loop, actions(loop, z), z)
        if found.overshoot is not None:
            allowed = found.overshoot * found.rate**tick * (1 + ROUNDING) + 1e-12
            assert (np.linalg.norm(z, axis=0) <= allowed * start).all()
    if found.proof_of_limit is not None:
        largest = max(np.linalg.norm(P, 2) for P in found.proof_of_limit.matrices)
        first = 2 * max(np.trace(M) for M in loop.M) * largest * start**2  # V of the start, at most
        late = weighed(loop.M, actions(loop, z), z)
        assert (late <= found.limit * (1 + ROUNDING) + slowest**ticks * first).all()
    return True


def no_gain_is_contradicted(loop: Switched, seed: int) -> bool:
    """Noise of any kind, sinusoids at the peaks of sending every sample among it, costs at most γ²Σ|w|² + β·steps."""
    found = proved(find_gain, loop)
    if found is None:
        return False
    draws, ticks, paths, q = np.random.default_rng(seed), 200, 64, loop.G.shape[1]
    size, angle = draws.lognormal(0.0, 2.0, paths), np.linspace(0.0, np.pi, paths)
    directions, phases = draws.standard_normal((q, paths)), draws.uniform(0.0, 2 * np.pi, (q, paths))
    z, spent, put = np.zeros((loop.states, paths)), np.zeros(paths), np.zeros(paths)
    for tick in range(ticks):
        if tick < ticks // 2:  # then silence, so that all of the answer is counted
            white = draws.standard_normal((q, paths))
            w = size * np.where(np.arange(paths) % 4 == 0, white, directions * np.cos(angle * tick + phases))
            put += (w**2).sum(axis=0)
        else:
            w = np.zeros((q, paths))
        taken = actions(loop, z)
        spent += weighed(loop.M, taken, z)
        z = moved(loop, taken, z) + loop.G @ w
    allowed = found.value**2 * put + found.residual * ticks + found.once
    assert (spent <= allowed * (1 + ROUNDING)).all()
    return True


def no_moment_is_contradicted(loop: Loop, seed: int) -> bool:
    """The simulated cost is below the bound, and so is the mean square of the state under the same inequalities."""
    whole = switched(loop)
    forms = [whole, switched_innovations(loop)] if loop.reducible else [whole]
    bounds = [proved(bound_cost, form) for form in forms]
    if all(bound is None for bound in bounds):
        return False
    found = average(loop, plain_average(loop), seed=seed, steps=50_000, threads=1)
    for bound in bounds:
        if bound is not None and found.reached:
            least = found.cost.value - 4.5 * found.cost.standard_error
            assert least <= loop.problem.per_unit(bound.value)
    z, draws, total = np.zeros((whole.states, 144)), np.random.default_rng(seed), np.zeros(144)
    for _ in range(200):
        z = moved(whole, actions(whole, z), z) + whole.G @ draws.standard_normal((whole.G.shape[1], 144))
        total += ((whole.X @ z) ** 2).sum(axis=0) / 200
    square = proved(bound_state, forms[-1])
    assert square is None or total.mean() - 4.5 * total.std() / 12 <= square.value
    return True


def no_certificate_is_contradicted(system: System, name: str, tally: list[bool]) -> None:
    """Decay, gain and both mean squares of one loop."""
    loop = closed(POLICIES[name](system))
    found = switched(loop)
    tally.append(no_decay_is_contradicted(found, system.seed))
    tally.append(no_gain_is_contradicted(found, system.seed))
    tally.append(no_moment_is_contradicted(loop, system.seed))
    if name == "lqg joint hold":
        law = switched_innovations(loop) if loop.reducible else found
        assert loop.policy.guarantee is not None
        assert loop.problem.per_unit(bound_cost(law).value) <= loop.policy.guarantee.cost * (1 + 1e-4)


def over_systems(count: int) -> None:
    """Draw systems and a policy for each; most of them have certificates."""
    tally: list[bool] = []
    drawn = {"system": systems(states=2, inputs=1), "name": st.sampled_from(NAMES)}
    over(lambda system, name: no_certificate_is_contradicted(system, name, tally), count, **drawn)
    assert np.mean(tally) > scaled(0.8, 0.6)


@pytest.mark.evidence
def test_no_certificate_is_contradicted_by_simulation() -> None:
    """Three systems of at most two states, each with one of the policies."""
    over_systems(3)


@pytest.mark.evidence
def test_no_certificate_is_contradicted_by_simulation_over_200_systems() -> None:
    """200 systems of at most two states, each with one of the policies."""
    over_systems(scaled(200, 20))
