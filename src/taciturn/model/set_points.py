"""Set-points within their limits: the policy steps with which a controller enforces a range and a largest change.

An operator, or another controller, gives a controller set-points at any time. If their form states limits
(``Changes.limits``), the controller first moves the set-point that is in effect towards the one that is given, by at
most ``rate`` in a step, and brings it between ``low`` and ``high``. These are two policy steps before all others: a
function, as for the limits of an actuator, and a sum that puts the result in the place of the set-point. So everything
that runs a policy, such as nodes, exported code and simulations, enforces the limits with the same operations.

As long as the set-points need not be limited, the steps change nothing, so the theory of the policy holds. The theory
does not cover changes that are larger than the limits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn.model.coverage import SET_POINT_LIMITS
from taciturn.model.network import REFERENCE
from taciturn.model.plant import Plant
from taciturn.model.steps import Apply, Assign, Step, assigned
from taciturn.model.theory import Theory

IN_EFFECT = "set-point in effect"  # signal of the set-points within their limits


def keep_set_points(
    steps: Sequence[Step], model: Plant, theory: Theory, initial: Mapping[str, Array], controller: str
) -> Mapping[str, Any]:
    """Return the changed fields of a policy whose controller brings its set-points within their limits."""
    changes = model.changes
    limits = None if changes is None else changes.limits
    if changes is None or limits is None or any(IN_EFFECT in assigned(step) for step in steps):
        return {}
    reads = (REFERENCE, IN_EFFECT) if limits.moves else (REFERENCE,)
    limited = Apply(controller, {IN_EFFECT: changes.size}, limits, reads)
    copied = Assign(controller, REFERENCE, {IN_EFFECT: np.eye(changes.size)})
    covers = theory.covers | (frozenset[str]() if changes.exceed else SET_POINT_LIMITS)
    return {
        "steps": (limited, copied, *steps),
        "initial": {**initial, IN_EFFECT: model.given},
        "theory": replace(theory, functions=theory.functions | {IN_EFFECT}, covers=covers),
    }
