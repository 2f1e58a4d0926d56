"""The printed lines of a twin's run."""

from __future__ import annotations

import numpy as np

from taciturn_twins.catalogue import ROBOTS
from taciturn_twins.identification import Identification
from taciturn_twins.report import model_lines


def test_an_identified_rate_has_the_digits_of_its_standard_error() -> None:
    """Per second and per unit of the input, with the number of the data sheet as a number."""
    robot, one = ROBOTS["rover"], np.eye(1)
    rate, error = 0.0021602 * one, 0.00007 * one
    found = Identification(
        "rover", 10, robot.tick * rate, robot.tick * error, robot.B, one, 0 * one, one, one, np.ones(1)
    )
    assert model_lines(found, robot) == [("dx/dt per input", "0.002160 ± 0.000070   (data sheet: 0.0023)")]
