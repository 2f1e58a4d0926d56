"""Masked arrays are refused wherever an array is accepted: NumPy would return the numbers that the mask hides."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import taciturn
from taciturn import Controller, Cost, Network, Plant, ProblemError, Reference, load
from taciturn.model.limits import Limits
from taciturn.model.signals import RandomSteps, Timetable
from taciturn.model.trigger import Scheduled
from taciturn_new.matrices import square_matrix

ONE, HIDDEN = np.eye(2), np.ma.array([[0.9, 0.1], [0.0, 0.8]], mask=[[False, True], [False, False]])
ROW = HIDDEN[0]


def masked_next(x: np.ndarray, u: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the next state with a mask."""
    return np.ma.array(0.5 * x + u + w, mask=[True, False])


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("A", lambda: Plant(HIDDEN, ONE, ONE)),
        ("A", lambda: Plant([*HIDDEN], ONE, ONE)),  # type: ignore[misc]
        ("C", lambda: Plant(ONE / 2, ONE, ONE, C=HIDDEN, V=ONE)),
        ("initial.mean", lambda: Plant(ONE / 2, ONE, ONE, mean=ROW)),
        ("the value of function", lambda: Plant(ONE / 2, ONE, ONE, function=masked_next)),
        ("Q", lambda: Cost(HIDDEN, ONE)),
        ("Q", lambda: square_matrix("Q", ROW, 2)),
        ("controller.setpoint", lambda: Controller(ONE / 9, ONE, ONE, ONE, setpoint=ROW)),
        ("limits.high", lambda: Limits(ONE, high=ROW)),
        ("reference.states", lambda: Reference(HIDDEN, ONE)),
        ("reference.steps.covariance", lambda: RandomSteps(0.1, HIDDEN)),
        ("reference.file: the set-points", lambda: Timetable([0, 1], HIDDEN)),
        ("the table indexed by 'k'", lambda: Scheduled("k", ROW)),
        ("policy.theta", lambda: load("two-mass").changed({"theta": np.ma.masked})),
        ("a value of theta", lambda: taciturn.sweep(load("two-mass"), over={"theta": ROW})),
        ("measurement", lambda: taciturn.Nodes(load("two-mass").design()).step(ROW)),
    ],
)
def test_a_masked_entry_is_refused_by_name(name: str, made: Callable[[], object]) -> None:
    """One sentence, whatever the array is of."""
    with pytest.raises(ProblemError, match="has masked entries; expected a number in every entry") as refused:
        made()
    assert name in str(refused.value)


def test_an_array_whose_mask_hides_nothing_is_an_array() -> None:
    """Also in a list."""
    free = np.ma.array(0.5 * ONE)
    for A in (free, [*free]):
        assert np.array_equal(Plant(A, ONE, ONE).A, 0.5 * ONE)
    with pytest.raises(ProblemError, match=r"network.actuator_loss is masked; expected a finite number"):
        Network("udp", actuator_loss=np.ma.masked)  # type: ignore[arg-type]
