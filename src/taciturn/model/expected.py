"""The measurements that the nodes of a policy expect: predictions by a filter, or by the model of a measured state.

A filter computes the innovation ν = y − Σ weight·signal, so its prediction of the outputs can be read from the policy
steps. A node that measures the whole state, and has a copy of the input, predicts it by the model, A y + B û.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from taciturn._arrays import Array
from taciturn.model.network import REFERENCE
from taciturn.model.policy import HELD, Policy
from taciturn.model.steps import ONE, Assign, Terms, assigned
from taciturn.model.theory import INNOVATION
from taciturn.model.trigger import Scheduled


def sensed_by(policy: Policy) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return the signals that nodes measure, each with its node and the indices of its outputs; no set-points."""
    return {signal: of for signal, of in policy.measured.items() if signal != REFERENCE}


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


def predicted_at(policy: Policy, signal: str) -> Mapping[str, Array] | None:
    """Return the prediction of a measured signal from signals of its node's site; None if the node has none."""
    predicted, (node, outputs) = predicted_outputs(policy), policy.measured[signal]
    homes = {name: policy.site(step.at) for step in policy.steps for name in assigned(step)}
    if predicted is None:
        model = policy.model
        state = model.full_state and model.function is None and [*outputs] == [*range(model.states)]
        if not state or homes.get(HELD) != policy.site(node):
            return None
        drift = {} if model.drift is None else {ONE: model.drift[:, None]}
        return {last_of(signal): model.A, HELD: model.B, **drift}
    terms = {name: np.asarray(weight)[[*outputs]] for name, weight in predicted.items()}
    terms = {name: weight for name, weight in terms.items() if weight.any() or name != ONE}
    known = all(name == ONE or homes.get(name) == policy.site(node) for name in terms)
    return terms if known and terms else None


def last_of(signal: str) -> str:
    """Return the name of the memory of a node's last measurement."""
    return f"last {signal}"
