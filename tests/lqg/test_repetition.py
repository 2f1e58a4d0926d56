"""Recursions that stop when they repeat: the bits of those that do not stop."""

from __future__ import annotations

import numpy as np
import pytest
from counts import few
from systems import make_system

from taciturn.lqg.critical_losses import Channel
from taciturn.lqg.lossy import regulate_lossy_finite
from taciturn.lqg.queries import follow_every_query
from taciturn.lqg.riccati import Repetition, regulate_finite

HORIZON = 400


@pytest.mark.parametrize("seed", few(range(60), 4))
def test_gains_and_covariances_have_the_bits_of_a_whole_recursion(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Random plants, unstable ones included, and a chain that alternates at its end."""
    system = make_system(seed, 1 + seed % 4, 1, 1, full_state=False)
    plant, cost = system.plant, system.cost
    size = len(plant.A)

    def computed() -> list[bytes]:
        plain = regulate_finite(plant.A, plant.B, cost.Q, cost.R, cost.N, np.zeros((size, size)), HORIZON)
        lossy = regulate_lossy_finite(
            plant.A, plant.B, cost.Q, cost.R, np.zeros((size, size)), HORIZON, Channel(0.01, 0.02, True, False)
        )
        seen = follow_every_query(plant, plant.W, HORIZON)[0]
        return [part.tobytes() for part in (plain.K, plain.L, plain.H, lossy.K, lossy.P, lossy.L, lossy.Gamma, seen)]

    found = computed()
    monkeypatch.setattr(Repetition, "period", lambda *_: None)
    assert found == computed()


def test_a_repetition_is_seen_at_once_and_a_first_visit_is_none() -> None:
    """States 3, 2, 1, 2: the last step repeats the one two steps before."""
    repetition = Repetition()
    periods = [repetition.period(9 - k, np.array([float(x)]), np.zeros(2)) for k, x in enumerate((3, 2, 1, 2))]
    assert periods == [None, None, None, 2]
