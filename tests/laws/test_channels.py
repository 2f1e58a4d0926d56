"""Loops on one channel: no scheduler below the dual bound, and the same numbers from plants, filters and models."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from systems import make_system, well_posed

import taciturn
from taciturn import Plant, Problem
from taciturn._modes import factor
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.riccati import regulate
from taciturn.model.network import Network
from taciturn_channel.classes import gather
from taciturn_channel.prices import Curves
from taciturn_channel.schedulers import SCHEDULERS
from taciturn_channel.share import Sharing, share_channel

SOME = settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))


def problem(seed: int, states: int = 2) -> Problem | None:
    """Return a random problem, stable or unstable, with cross terms and several inputs; None if it is ill-posed."""
    draws = np.random.default_rng(seed)
    n = int(draws.integers(1, states + 1))
    system = make_system(seed, n, int(draws.integers(1, n + 1)), n, bool(draws.integers(2)))
    if not (well_posed(system.plant.A, system.plant.B) and well_posed(system.plant.A.T, system.plant.C.T)):
        return None
    return Problem(system.plant, system.cost, Network(), "all-time", {})


def mixed(seed: int, states: int = 2) -> dict[str, Problem]:
    """Return two or three random problems of at most so many states."""
    draws = np.random.default_rng(seed)
    found = [problem(int(draws.integers(2**32)), states) for _ in range(8)]
    kept = [one for one in found if one is not None][: int(draws.integers(2, 4))]
    return {f"kind {i}": one for i, one in enumerate(kept)}


def check_no_scheduler_beats_the_bound(
    seed: int, schedulers: Sequence[str], states: int, most: int, ticks: int
) -> None:
    """Share a channel among random loops, with less than so many of a kind, by these schedulers."""
    draws = np.random.default_rng(seed)
    problems = mixed(seed, states)
    copies = [int(draws.integers(2, most)) for _ in problems]
    capacity = max(1, int(draws.uniform(0.15, 0.7) * sum(copies)))
    bound = None
    for scheduler in schedulers:
        found = share_channel(
            problems,
            copies=copies,
            capacity=capacity,
            scheduler=scheduler,  # pyright: ignore[reportArgumentType]
            seed=seed,
            steps=ticks,
            confidence=0.999 if bound is None else 0,
        )
        bound = found.lower_bound or bound
        assert bound is not None
        assert found.cost.value + 4 * found.cost.standard_error >= bound.cost * (1 - 1e-9), scheduler
        assert found.load.value <= capacity + 1e-9
        if scheduler == "price":
            assert bound.cost <= found.cost_periodic * (1 + 1e-9) <= found.cost_periodic_same_load * (1 + 2e-9)
            assert found.consistent is not False


def test_no_scheduler_costs_less_than_the_dual_bound() -> None:
    """Random loops of one state, several kinds at once; and the price policy is no worse than any clock."""
    check_no_scheduler_beats_the_bound(3, ("price", "largest"), 1, 6, 1000)


@pytest.mark.evidence
@SOME
@given(st.integers(0, 2**32 - 1))
def test_no_scheduler_costs_less_than_the_dual_bound_on_a_dozen_channels(seed: int) -> None:
    """Of one and two states, stable and unstable, by every scheduler."""
    check_no_scheduler_beats_the_bound(seed + 1, tuple(SCHEDULERS), 2, 30, 1500)


def by_hand(problems: dict[str, Problem], copies: list[int], capacity: int, scheduler: str, ticks: int) -> list[float]:
    """Return the mean cost of a step on each of some channels: plants, filters, models and a queue, in plain NumPy."""
    channels, draws = 100, np.random.default_rng(7)

    def drawn(covariance: np.ndarray) -> np.ndarray:
        half = factor(covariance)
        return draws.standard_normal((channels, half.shape[1])) @ half.T

    kinds = gather(problems, copies)
    curves = Curves(kinds)
    settled = curves.settle(curves.price_of(capacity, 1.0)) if scheduler == "price" else [None] * len(kinds)
    loops: list[dict[str, np.ndarray]] = []
    for kind, one, curve in zip(kinds, problems.values(), settled, strict=True):
        plant, cost = one.plant, one.cost
        assert isinstance(plant, Plant)
        best = regulate(plant.A, plant.B, cost.Q, cost.R, cost.N)
        gain = steady_filter(plant.A, plant.C, plant.W, plant.V).gain
        form = None if curve is None else curve.schedule.urgency
        for _ in range(kind.count):
            zero = np.zeros((channels, plant.states))
            loops.append(
                {"A": plant.A, "B": plant.B, "C": plant.C, "W": plant.W, "V": plant.V, "L": best.L, "H": best.H}
                | {"K": gain, "Q": cost.Q, "R": cost.R, "N": cost.N, "x": zero, "seen": zero, "model": zero}
            )
            if form is not None:
                loops[-1] |= {"Psi": form.Psi, "c": np.array(form.constant)}
                loops[-1] |= {"Pi": form.bell.Pi, "h": np.array(form.bell.height)}
    total = np.zeros(channels)
    for tick in range(-60, ticks):
        urgency = np.zeros((channels, len(loops)))
        for i, loop in enumerate(loops):
            y = loop["x"] @ loop["C"].T + drawn(loop["V"])
            loop["seen"] = loop["seen"] + (y - loop["seen"] @ loop["C"].T) @ loop["K"].T
            e = loop["model"] - loop["seen"]
            u = e @ loop["L"].T
            if scheduler == "largest":
                urgency[:, i] = np.einsum("ci,ij,cj->c", u, loop["H"], u)
            elif scheduler == "once-discard":
                urgency[:, i] = (u**2).sum(axis=1)
            else:
                bell = np.exp(-0.5 * np.einsum("ci,ij,cj->c", e, loop["Pi"], e))
                urgency[:, i] = np.einsum("ci,ij,cj->c", e, loop["Psi"], e) + loop["c"] + loop["h"] * bell
        order = np.argsort(-urgency, axis=1)
        rank = np.argsort(order, axis=1)
        sends = rank < capacity
        for i, loop in enumerate(loops):
            loop["model"] = np.where(sends[:, [i]], loop["seen"], loop["model"])
            u, x = loop["model"] @ loop["L"].T, loop["x"]
            stage = np.einsum("ci,ij,cj->c", x, loop["Q"], x) + np.einsum("ci,ij,cj->c", u, loop["R"], u)
            stage += 2 * np.einsum("ci,ij,cj->c", x, loop["N"], u)
            total += stage if tick >= 0 else 0.0
            loop["x"] = x @ loop["A"].T + u @ loop["B"].T + drawn(loop["W"])
            loop["seen"] = loop["seen"] @ loop["A"].T + u @ loop["B"].T
            loop["model"] = loop["model"] @ (loop["A"] + loop["B"] @ loop["L"]).T
    return (total / ticks).tolist()


@pytest.mark.parametrize("scheduler", ["price", "largest", "once-discard"])
@pytest.mark.evidence
def test_whole_plants_with_their_filters_cost_what_errors_alone_say(scheduler: str) -> None:
    """The reduced simulation knows errors and a completed square; this one knows neither."""
    plants = {
        "slow": Plant([[1.0, 0.2], [0.0, 0.9]], [[0.0], [1.0]], 0.1 * np.eye(2), [[1.0, 0.0]], [[0.05]]),
        "fast": Plant([[1.2]], [[1.0]], [[0.3]]),
    }
    costs = {"slow": taciturn.Cost(np.eye(2), [[0.3]], [[0.1], [0.0]]), "fast": taciturn.Cost([[1.0]], [[0.1]])}
    problems = {name: Problem(plants[name], costs[name], Network(), "all-time", {}) for name in plants}
    copies, capacity = [4, 3], 2
    found: Sharing = share_channel(problems, copies=copies, capacity=capacity, scheduler=scheduler, steps=4000)  # pyright: ignore[reportArgumentType]
    plain = np.array(by_hand(problems, copies, capacity, scheduler, 300))
    spread = np.hypot(plain.std(ddof=1) / np.sqrt(len(plain)), found.cost.standard_error)
    assert abs(plain.mean() - found.cost.value) < 4 * spread
    assert spread < 0.03 * found.cost.value
