"""Plants and policies in other coordinates: in deviations from another operating point, or in the units of the plant.

A design counts states and inputs from the operating point of its plant. Nodes, packets and trajectories are in the
units of the plant. ``in_units`` adds the point to the signals of a policy: measurements, inputs, estimates, and the
signals that are copied from them. A sum of signals gets a constant term. Any other policy step that reads such a signal
reads its deviation from the point.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from taciturn._arrays import Array
from taciturn.model.display import about
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.steps import ONE, Apply, Assign, Decide, Evaluate, Received, Step, Terms, assigned, read
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Matrix, Scheduled, shape_of

if TYPE_CHECKING:
    from taciturn.model.policy import Policy

ESTIMATE, HELD = "estimate", "held"  # names of signals of all designs


def in_units(policy: Policy) -> Policy:
    """Return a policy in the units of the plant, which nodes carry out; without an operating point, it is the same."""
    point = policy.model.operating_point
    if point is None:
        return policy
    moves, theory = _moves(policy, point), policy.theory
    sums = {name: _moved_terms(terms, moves.get(name), moves) for name, terms in theory.sums.items()}
    assigns = {name for step in policy.steps for name in assigned(step)}
    told = theory.innovations
    if told is not None:
        y = policy.model.C @ point.x
        told = replace(told, predicted=_moved_terms(told.predicted, y, moves)) if told.signal is None else None
    initial = {name: moves[name] + policy.initial.get(name, 0.0) for name in moves if name in assigns}
    functions = theory.functions | {_deviation(name) for name in theory.functions}
    return replace(
        policy,
        steps=tuple(found for step in policy.steps for found in _moved(step, moves)),
        model=about(policy.model, None),
        theory=Theory(
            cost=theory.cost,
            cost_all_time=theory.cost_all_time,
            cost_all_time_error=theory.cost_all_time_error,
            settling=theory.settling,
            recovery=theory.recovery,
            sums=sums,
            innovations=told,
            functions=functions,
        ),
        initial={**policy.initial, **initial},
    )


def at_rest(policy: Policy) -> dict[str, Array]:
    """Return the values of signals at the operating point, of which the steps of a policy compute deviations."""
    return {} if policy.model.operating_point is None else _moves(policy, policy.model.operating_point)


def _moves(policy: Policy, point: OperatingPoint) -> dict[str, Array]:
    """Return what is added to each signal: the point to measurements, inputs and the estimate, and to their copies."""
    y, sizes = policy.model.C @ point.x, policy.sizes
    found = {name: point.u[[*inputs]] for name, (_, inputs) in policy.applied.items()}
    held = {f"{HELD}_{node}": point.u[[*inputs]] for node, inputs in policy.applied.values()} | {HELD: point.u}
    found |= {name: value for name, value in held.items() if sizes.get(name) == len(value)}
    found |= {name: y[[*outputs]] for name, (_, outputs) in policy.measured.items()}
    if sizes.get(ESTIMATE, len(point.x)) == len(point.x):  # it may be a sum of signals of several nodes
        found[ESTIMATE] = point.x
    copies = list[tuple[str, str]]()
    for step in (step for step in policy.steps if isinstance(step, Assign)):
        alone = [next(iter(terms.items())) for terms in step.branches if len(terms) == 1]
        copies += [(step.signal, name) for name, matrix in alone if name != ONE and _is_identity(matrix)]
    waiting = [*found]
    while waiting:
        name = waiting.pop(0)
        for one, other in (*copies, *((other, one) for one, other in copies)):
            if one == name and other not in found:
                found[other] = found[name]
                waiting.append(other)
    followed = () if policy.tracking is None else (policy.tracking.state, policy.tracking.input)  # deviations
    return {name: value for name, value in found.items() if value.any() and name not in followed}


def _is_identity(matrix: Matrix) -> bool:
    return isinstance(matrix, np.ndarray) and np.array_equal(matrix, np.eye(len(matrix)))


def _moved(step: Step, moves: Mapping[str, Array]) -> tuple[Step, ...]:
    """Return the steps that compute in the units of the plant what a policy step computes in deviations."""
    if isinstance(step, Assign):
        return _moved_sum(step, moves)
    known = [name for name in dict.fromkeys(read(step)) if name in moves]
    before = _deviations(step, known, moves)
    if isinstance(step, Evaluate):
        return *before, replace(step, forms=tuple(_renamed(form, moves) for form in step.forms))
    if isinstance(step, Decide):
        options = {label: _renamed(form, moves) for label, form in step.trigger.options.items()}
        return *before, replace(step, trigger=replace(step.trigger, options=options))
    if not isinstance(step, Apply):
        return (step,)
    results = [name for name in step.signals if name in moves]
    signals = {_deviation(name) if name in moves else name: size for name, size in step.signals.items()}
    reads = tuple(_deviation(name) if name in moves else name for name in step.reads)
    after = (
        Assign(step.at, name, {_deviation(name): np.eye(len(moves[name])), ONE: moves[name][:, None]})
        for name in results
    )
    return *before, replace(step, signals=signals, reads=reads), *after


def _moved_sum(step: Assign, moves: Mapping[str, Array]) -> tuple[Step, ...]:
    """Return a sum with the constant by which its signals are moved; a table reads the deviation of a moved signal."""
    tables = [
        name
        for name in dict.fromkeys(read(step))
        if name in moves and any(isinstance(terms.get(name), Scheduled) for terms in step.branches)
    ]
    branches = list[Terms]()
    for terms in step.branches:
        renamed = {_deviation(name) if name in tables else name: matrix for name, matrix in terms.items()}
        branches.append(_moved_terms(renamed, moves.get(step.signal), moves))
    before = _deviations(step, tables, moves)
    return *before, Assign(step.at, step.signal, tuple(branches) if step.on else branches[0], step.on)


def _moved_terms(terms: Terms, move: Array | None, moves: Mapping[str, Array]) -> Terms:
    """Return the terms of a sum with the constant by which it and its signals are moved."""
    constant = np.zeros(shape_of(next(iter(terms.values())))[0]) if move is None else move
    for name, matrix in terms.items():
        if name in moves and not isinstance(matrix, Scheduled):
            constant = constant - matrix @ moves[name]
    if not constant.any():
        return terms
    stated = terms.get(ONE)
    if isinstance(stated, Scheduled):
        return {**terms, ONE: Scheduled(stated.by, stated.values + constant[:, None])}
    return {**terms, ONE: constant[:, None] if stated is None else stated + constant[:, None]}


def _deviations(step: Step, names: list[str], moves: Mapping[str, Array]) -> tuple[Step, ...]:
    """Return the steps that compute the deviations of signals that a policy step reads, also from a packet."""
    found = list[Step]()
    for name in names:
        deviation: Terms = {name: np.eye(len(moves[name])), ONE: -moves[name][:, None]}
        if not isinstance(step, Assign | Evaluate) or not isinstance(step.on, Received):
            found.append(Assign(step.at, _deviation(name), deviation))
            continue
        listed = step.branches if isinstance(step, Assign) else [form.reads for form in step.forms]
        none: Terms = {ONE: np.zeros((len(moves[name]), 1))}
        found.append(
            Assign(step.at, _deviation(name), tuple(deviation if name in one else none for one in listed), step.on)
        )
    return tuple(found)


def _renamed(form: Form, moves: Mapping[str, Array]) -> Form:
    """Return a form of the deviations of moved signals."""
    signals = tuple(_deviation(name) if name in moves else name for name in form.signals)
    plus = {_deviation(name) if name in moves else name: weight for name, weight in form.plus.items()}
    return Form(signals, form.Psi, form.constant, plus, form.bell)


def _deviation(name: str) -> str:
    return f"{name} from the operating point"
