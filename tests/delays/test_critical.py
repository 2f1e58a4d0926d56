"""The critical delay of a link against eigenvalues of loops with that delay, and random delays against their value."""

from __future__ import annotations

import numpy as np
import pytest
from late_packets import held

import taciturn
from taciturn import ProblemError, UnstableError, critical_delay
from taciturn.problem import Problem, parse

A, B = np.array([[0.0, 1.0], [2.0, -0.5]]), np.array([[0.0], [1.0]])
K, PERIOD = np.array([[6.0, 3.0]]), 0.1


def problem(discrete: bool, **changes: object) -> Problem:
    """Return a plant, continuous or one step of it, whose states are measured, with the controller u = −K x."""
    plant = {"A": A.tolist(), "B": B.tolist(), "W": (0.1 * np.eye(2)).tolist()}
    policy = {"kind": "excess", "theta": 0.1}
    if discrete:
        Phi, Gamma, *_ = held(A, B, np.zeros((3, 3)), np.zeros((2, 2)), PERIOD)
        plant |= {"A": Phi.tolist(), "B": Gamma.tolist(), "dt": PERIOD}
    else:
        policy["period"] = PERIOD
    tables = {
        "plant": plant, "cost": {"Q": np.eye(2).tolist(), "R": [[0.1]]}, "controller": {"D": K.tolist()},
        "policy": policy,
    }  # fmt: skip
    return parse(tables, "critical").changed(changes)


def radius(delay: float) -> float:
    """Return the spectral radius of the loop whose inputs all act so much later, by exponentials over both pieces."""
    whole, rest = int(delay / PERIOD + 1e-9), delay % PERIOD if delay % PERIOD < PERIOD - 1e-9 else 0.0
    late, early = (held(A, B, np.zeros((3, 3)), np.zeros((2, 2)), time)[:2] for time in (rest, PERIOD - rest))
    n, d = 2, whole + 1
    F = np.zeros((n + d, n + d))  # x, u_{k−1}, …, u_{k−d}
    command = -K @ np.eye(n, n + d)
    older = np.vstack([command, np.eye(d, n + d, n)])
    F[:n] = (
        early[0] @ (late[0] @ np.eye(n, n + d) + late[1] @ older[whole + 1 : whole + 2])
        + early[1] @ older[whole : whole + 1]
    )
    F[n:] = older[:d]
    return float(np.abs(np.linalg.eigvals(F)).max())


def test_a_given_controller_has_the_delay_margin_of_its_eigenvalues() -> None:
    """A continuous plant, parts of a period; and whole steps of a discrete one."""
    found = critical_delay(problem(False))
    assert found.in_seconds
    assert found.unstable is not None
    assert 0 < found.unstable - found.stable <= PERIOD / 128
    assert radius(found.stable) < 1 < radius(found.unstable)
    steps = critical_delay(problem(True))
    assert (steps.stable, steps.unstable) == (found.stable // PERIOD, found.stable // PERIOD + 1)
    told = f"may take {steps.stable:.0f} steps longer; with {steps.unstable:.0f} steps more, the loop that sends every"
    assert told in str(steps)


@pytest.mark.evidence
def test_random_delays_have_one_too() -> None:
    """With losses and acknowledgements; a later law is refused with the time by which packets come too late."""
    law = {"seconds": [0.0, 0.05], "probability": [0.5, 0.4]}
    late = problem(False, **{"network.protocol": "tcp", "network.actuator_delay": law})
    found = critical_delay(late)
    assert found.unstable is not None
    assert found.stable < critical_delay(problem(False)).stable
    later = {"seconds": [found.unstable, 0.05 + found.unstable], "probability": [0.5, 0.4]}
    with pytest.raises(UnstableError, match=r"below 1 if every packet arrives (\S+) ms earlier") as caught:
        late.changed({"network.actuator_delay": later}).design()
    told = float(str(caught.value).rpartition(" ms earlier")[0].rpartition(" ")[2]) / 1e3
    earlier = {"seconds": [one - told for one in later["seconds"]], "probability": [0.5, 0.4]}
    assert 0 < told < PERIOD / 32
    late.changed({"network.actuator_delay": earlier}).design()


def test_lqg_has_none_and_wrong_arguments_are_refused() -> None:
    """A design for each delay is stable with all that can be computed; a link that is not there is named."""
    lqg = taciturn.load("two-mass")
    found = critical_delay(lqg)
    assert found.unstable is None
    assert str(found).endswith("longer, the most that can be computed")
    with pytest.raises(ProblemError, match=r"link is 'pump'; expected .*actuator"):
        critical_delay(lqg, "pump")
    with pytest.raises(UnstableError):
        critical_delay(problem(True, **{"network.actuator_delay": 20}))
