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

from collections.abc import Mapping, Sequence

import numpy as np

from taciturn._arrays import Array
from taciturn.model.network import REFERENCE
from taciturn.model.policy import HELD, Policy
from taciturn.model.steps import ONE, Assign, Terms, assigned
from taciturn.model.theory import INNOVATION
from taciturn.model.trigger import Scheduled
from taciturn.program.gap import bridge, gap_memories
from taciturn.program.ir import Truth
from taciturn.program.translation import Operands, TimeStep

SAMPLED = "sampled"  # outputs of the program of a loop: for each output of the plant 1, or 0 if its sample is missing


def known_of(signal: str) -> str:
    """Return the name of the program inputs that state which entries of a signal are measured in this step."""
    return f"{signal} is measured"


def sensed_by(policy: Policy) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return the signals that nodes measure, each with its node and the indices of its outputs; no set-points."""
    return {signal: of for signal, of in policy.measured.items() if signal != REFERENCE}


def complete(tick: TimeStep, policy: Policy, signal: str, values: Operands, known: Sequence[Truth]) -> None:
    """Assign a measured signal. Entries that are not known are predicted by the filter at the node, or held."""
    b, terms = tick.builder, _predicted_at(policy, signal)
    expected = tick.recall(_last(signal)) if terms is None else tick.combine(terms, len(values))
    found = [b.choose(*one) for one in zip(known, values, expected, strict=True)]
    tick.signals[signal] = found
    if terms is None:
        bridge(tick, policy, signal, values, expected, known)
    if terms is None or _last(signal) in terms:
        tick.signals[_last(signal)] = found
    some: Truth = False
    for truth in known:
        some = b.either(some, truth)
    tick.measured[signal] = some


def held_samples(policy: Policy) -> dict[str, Array]:
    """Return the memories of the last samples, with the measurements that are expected at the start."""
    model, found = policy.model, dict[str, Array]()
    expected, drift = model.C @ model.mean, 0.0 if model.drift is None else model.drift
    for signal, (_, outputs) in sensed_by(policy).items():
        terms = _predicted_at(policy, signal)
        if terms is None:
            found |= {_last(signal): expected[[*outputs]], **gap_memories(policy, signal)}
        elif _last(signal) in terms:  # from which the model leads to the expected state
            moved = expected - model.B @ policy.initial.get(HELD, np.zeros(model.inputs)) - drift
            found[_last(signal)] = np.asarray(np.linalg.lstsq(model.A, moved, rcond=None)[0], dtype=np.float64)
    return found


def predicted_outputs(policy: Policy) -> Terms | None:
    """Return the filter's prediction of the outputs one step ahead as a sum of signals; None without a filter."""
    innovations, model = policy.theory.innovations, policy.model
    if innovations is not None and innovations.signal is None:
        return innovations.predicted
    name = INNOVATION if innovations is None else innovations.signal
    found = [step for step in policy.steps if isinstance(step, Assign) and step.signal == name and step.on is None]
    if not found:
        return None
    places = {signal: outputs for signal, (_, outputs) in policy.measured.items()} | {"y": range(model.sensed)}
    measured, predicted = np.zeros((model.outputs, model.outputs)), dict[str, Array]()
    for signal, weight in found[0].branches[0].items():
        if isinstance(weight, Scheduled):
            return None
        if signal in places:
            measured[:, [*places[signal]]] += weight
        else:
            predicted[signal] = -weight
    return predicted if np.array_equal(measured, np.eye(model.outputs)) else None


def _predicted_at(policy: Policy, signal: str) -> Mapping[str, Array] | None:
    """Return the prediction of a measured signal from signals of its node's site; None if the node has none."""
    predicted, (node, outputs) = predicted_outputs(policy), policy.measured[signal]
    homes = {name: policy.site(step.at) for step in policy.steps for name in assigned(step)}
    if predicted is None:
        model = policy.model
        state = model.full_state and model.function is None and [*outputs] == [*range(model.states)]
        if not state or homes.get(HELD) != policy.site(node):
            return None
        drift = {} if model.drift is None else {ONE: model.drift[:, None]}
        return {_last(signal): model.A, HELD: model.B, **drift}
    terms = {name: np.asarray(weight)[[*outputs]] for name, weight in predicted.items()}
    terms = {name: weight for name, weight in terms.items() if weight.any() or name != ONE}
    known = all(name == ONE or homes.get(name) == policy.site(node) for name in terms)
    return terms if known and terms else None


def _last(signal: str) -> str:
    """Return the name of the memory of a node's last measurement."""
    return f"last {signal}"
