"""Numbers with their errors, as JSON holds them."""

from __future__ import annotations

import pytest

from taciturn.model.estimate import Estimate


def test_a_document_has_the_parts_that_are_asked_for_in_their_order() -> None:
    """By default what every reader wants; the error of a quadrature on request."""
    found = Estimate(2.0, 0.5, "simulation")
    assert list(found.document().items()) == [("value", 2.0), ("standard_error", 0.5), ("method", "simulation")]
    assert found.document("value", "standard_error") == {"value": 2.0, "standard_error": 0.5}
    assert Estimate(2.0, 0.0, "quadrature", 0.1).document("error") == {"error": 0.1}


@pytest.mark.parametrize(
    ("value", "error", "shown"),
    [
        (13_518_762_963.0, 494_109.0, "1.351876e+10 ± 4.9e+05"),
        (-2.5e7, 300.0, "-2.500000e+07 ± 3.0e+02"),
        (1.34408e10, 0.0, "1.34408e+10"),
        (1_234_567.891234, 1e-4, "1.23456789e+06"),
        (8.574e-5, 1.2e-6, "8.57e-05 ± 1.2e-06"),
        (1e3, 1e7, "0 ± 1.0e+07"),
        (0.74087, 0.000028, "0.740870 ± 0.000028"),
        (0.000857745169, 1e-15, "0.000857745169"),
        (0.5, 0.0, "0.5"),
    ],
)
def test_value_and_error_have_one_notation_and_two_digits_of_the_error(value: float, error: float, shown: str) -> None:
    """A number from a million on or below 1e-4 has an exponent, and a mere rounding error is not printed."""
    assert str(Estimate(value, error, "simulation")) == shown
