"""Missing samples: what a node takes in place of a measurement that it does not have.

If the filter that predicts an output is at the site of the node, the node takes the prediction, so that the innovation
is 0 and the filter predicts. A node that measures the whole state and has a copy of the input predicts it by the model,
A y + B û. Otherwise a node holds the last measurement, so that a dead band stays silent; after a gap, a controller at
its site continues as if the samples had lain on a straight line (``gap``), so that a derivative sees the mean slope. A
controller that hears of this node only by the packets of a dead band does not know that there was a gap, and takes its
change as one step. A node that sends its measurement in every step sends no packet in a step without any, so the
receiver takes the packet as lost.

Inputs of the program of a node (``known_of``) state which outputs are missing: 1 for an output that is measured, and 0
otherwise. A simulation draws which are missing (``TimeStep.draw_samples``).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from taciturn._arrays import Array
from taciturn.model.expected import last_of, predicted_at, sensed_by
from taciturn.model.policy import HELD, Policy
from taciturn.program.gap import bridge, gap_memories
from taciturn.program.ir import Truth
from taciturn.program.translation import Operands, TimeStep

SAMPLED = "sampled"  # outputs of the program of a loop: for each output of the plant 1, or 0 if its sample is missing


def known_of(signal: str) -> str:
    """Return the name of the program inputs that state which entries of a signal are measured in this step."""
    return f"{signal} is measured"


def complete(tick: TimeStep, policy: Policy, signal: str, values: Operands, known: Sequence[Truth]) -> None:
    """Assign a measured signal. Entries that are not known are predicted by the filter at the node, or held."""
    b, terms = tick.builder, predicted_at(policy, signal)
    expected = tick.recall(last_of(signal)) if terms is None else tick.combine(terms, len(values))
    found = [b.choose(*one) for one in zip(known, values, expected, strict=True)]
    tick.signals[signal] = found
    if terms is None:
        bridge(tick, policy, signal, values, expected, known)
    if terms is None or last_of(signal) in terms:
        tick.signals[last_of(signal)] = found
    some: Truth = False
    for truth in known:
        some = b.either(some, truth)
    tick.measured[signal] = some


def held_samples(policy: Policy) -> dict[str, Array]:
    """Return the memories of the last samples, with the measurements that are expected at the start."""
    model, found = policy.model, dict[str, Array]()
    expected, drift = model.C @ model.mean, 0.0 if model.drift is None else model.drift
    for signal, (_, outputs) in sensed_by(policy).items():
        terms = predicted_at(policy, signal)
        if terms is None:
            found |= {last_of(signal): expected[[*outputs]], **gap_memories(policy, signal)}
        elif last_of(signal) in terms:  # from which the model leads to the expected state
            moved = expected - model.B @ policy.initial.get(HELD, np.zeros(model.inputs)) - drift
            found[last_of(signal)] = np.asarray(np.linalg.lstsq(model.A, moved, rcond=None)[0], dtype=np.float64)
    return found
