"""Numbers with their errors, as JSON holds them."""

from __future__ import annotations

from taciturn.model.estimate import Estimate


def test_a_document_has_the_parts_that_are_asked_for_in_their_order() -> None:
    """By default what every reader wants; the error of a quadrature on request."""
    found = Estimate(2.0, 0.5, "simulation")
    assert list(found.document().items()) == [("value", 2.0), ("standard_error", 0.5), ("method", "simulation")]
    assert found.document("value", "standard_error") == {"value": 2.0, "standard_error": 0.5}
    assert Estimate(2.0, 0.0, "quadrature", 0.1).document("error") == {"error": 0.1}
