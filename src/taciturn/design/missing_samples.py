"""Policies for sensors whose samples are sometimes missing: their filters get the gain for this law.

A node that predicts its measurement by a filter only predicts while a sample is missing. With steady-state gains, the
error of its prediction then grows, and the next sample deserves more weight. ``for_missing_samples`` replaces the gain
of the filter by the best one for the law (``lqg/missing_samples``), and the covariance by which an alarm judges the
innovations. Filters whose gains change with the steps, and nodes without a filter, stay as they are: nodes that hold a
measurement, that receive it by a link, or that measure the whole state, whose prediction by the model is already the
best one. The network of the policy then states the law, with which its theory claims nothing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from taciturn.base.given_controller import BESIDE_LQG
from taciturn.design.silence import SURPRISE, surprise
from taciturn.lqg.kalman import filter_sampled, taken_over
from taciturn.lqg.missing_samples import gain_for_missing
from taciturn.model.expected import predicted_at, predicted_outputs, sensed_by
from taciturn.model.losses import together
from taciturn.model.network import Network
from taciturn.model.policy import ESTIMATE, Policy
from taciturn.model.steps import Assign, Evaluate, Step
from taciturn.model.theory import INNOVATION

NOTE = "the gain of the filter is the one for the stated law of missing samples"


def for_missing_samples(policy: Policy, network: Network) -> Policy:
    """Return the policy with the gain of its filter for the missing samples of a network.

    Raises:
        UnstableError: with so many missing samples, the error of the estimate grows without limit.
    """
    if not network.missing or NOTE in policy.notes:  # a kind may ask after its design function has asked
        return policy
    # a comparison with LQG is one without missing samples
    notes = tuple(note for note in policy.notes if not note.startswith(BESIDE_LQG))
    found = replace(policy, network=replace(policy.network, missing=network.missing), notes=notes)
    corrections = [i for i, step in enumerate(policy.steps) if _corrects(step)]
    laws, model = _laws(policy, network), policy.model
    if laws is None or not corrections:
        return found
    given, p = model.set_points, model.sensed
    n = model.states - given
    # without the set-points, which the filter takes over and which are never missing
    A, C, W, V = model.A[:n, :n], model.C[:p, :n], model.W[:n, :n], model.V[:p, :p]
    chances = together([network.chain_of_samples(node) for node in network.missing])
    known = np.array([[law is None or not case[law] for law in laws] for case in chances.cases], dtype=np.float64)
    gain, covariance = gain_for_missing(A, C, W, V, filter_sampled(None, A, C, W, V, 0).prior, known, chances)
    gain, covariance = taken_over(gain, model.C, given), np.pad(covariance, (0, given))
    steps: list[Step] = [*policy.steps]
    for i in corrections:
        (terms,) = cast("Assign", steps[i]).branches
        steps[i] = Assign(steps[i].at, ESTIMATE, {**terms, INNOVATION: gain})
    for i, step in enumerate(steps):
        if isinstance(step, Evaluate) and step.signal == SURPRISE:
            steps[i] = surprise(INNOVATION, covariance, step.at, p)
    return replace(found, steps=tuple(steps), notes=(*notes, NOTE))


def _corrects(step: Step) -> bool:
    """Return whether a step corrects a prediction by a constant gain times the innovation."""
    if not isinstance(step, Assign) or step.signal != ESTIMATE or step.on is not None:
        return False
    return isinstance(step.branches[0].get(INNOVATION), np.ndarray)


def _laws(policy: Policy, network: Network) -> list[int | None] | None:
    """Return the index of the law of each output's node; None if a node with a law does not predict by a filter."""
    if predicted_outputs(policy) is None:
        return None
    nodes = [*network.missing]
    laws: list[int | None] = [None] * policy.model.sensed
    for signal, (node, outputs) in sensed_by(policy).items():
        if node not in nodes:
            continue
        if predicted_at(policy, signal) is None:
            return None
        for output in outputs:
            laws[output] = nodes.index(node)
    return laws
