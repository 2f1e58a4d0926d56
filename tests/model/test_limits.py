"""Limits of states: their texts, and what they refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taciturn import ProblemError
from taciturn.model.limits import Limits


def test_each_limit_reads_as_a_formula() -> None:
    """Signs, weights and missing bounds are those of the rows."""
    found = Limits([[1.0, 0.0], [0.0, -2.0], [1.0, -1.0]], low=[-1.0, -np.inf, 0.5], high=[1.0, 3.0, np.inf])
    assert found.names == ("-1 ≤ x1 ≤ 1", "−2 x2 ≤ 3", "0.5 ≤ x1 − x2")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            {"outputs": [[1.0, 0.0]]},
            "limits.outputs[0] has neither a lower nor an upper limit; expected limits.low, limits.high or both",
        ),
        ({"outputs": [[0.0, 0.0]], "high": [1.0]}, "limits.outputs[0] contains only zeros"),
        ({"outputs": [[1.0]], "low": [1.0], "high": [1.0]}, "limits.low[0] is 1 and limits.high[0] is 1; expected low"),
        ({"outputs": [[1.0]], "high": [1.0, 2.0]}, "limits.high has shape (2,); expected the shape (1,)"),
        ({"outputs": [[1.0]], "high": [-np.inf]}, "limits.high contains -inf; expected numbers, or inf for no limit"),
        (
            {"outputs": [[1.0]], "low": [np.nan]},
            "limits.low contains the number nan at index (0,); expected an array of finite numbers",
        ),
        ({"outputs": [[1.0]], "high": "much"}, "limits.high"),
        ({"outputs": [1.0], "high": [1.0]}, "limits.outputs has shape (1,)"),
    ],
)
def test_limits_that_cannot_be_are_one_sentence(arguments: dict[str, Any], words: str) -> None:
    """The sentence names the key, the value and what is expected."""
    with pytest.raises(ProblemError) as caught:
        Limits(**arguments)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
