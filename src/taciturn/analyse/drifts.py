"""Links whose decisions depend on disturbances and set-points that wander without limit, so that no rate is an average.

Let d⁺ = Sd be disturbances and set-points, and let every link send in every step. Then the loop is linear, and all its
other states approach the response z = Πd that satisfies

    F_zz Π + F_zd = Π S.

A trigger compares quadratic forms. Let η be the rows of their difference. If η(Π, I)d does not forget the noise that
moves d, the difference grows without limit although everything is sent: the longer the loop has run, the more the
decision depends on the size of d alone. Its rate then has no average below its limit, which is usually to send every
sample.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import balancing
from taciturn.analyse.switched import FixedStep, attempt_of
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.lqg._followed import CANCELS
from taciturn.model.policy import Draw, Evaluate, Send, Step
from taciturn.model.trigger import Form
from taciturn.program.names import Name, Option
from taciturn.program.quadratic import as_form, read_polynomials

MOST = 4000  # entries of Π for which the equations are solved
RANK = 1e-12  # eigenvalue of a form, or entry of its rows, relative to the largest, that is a rounding error


def drifting(loop: Loop, noise: Array) -> tuple[str, ...]:
    """Return the links whose decisions depend on disturbances or set-points that wander, even if everything is sent.

    Args:
        loop: the closed loop.
        noise: covariance of the noise that moves the states of the plant, (n, n).
    """
    policy, needs = loop.policy, loop.problem.followed
    always = attempt_of(policy)
    if needs is None or always is None or not noise[np.ix_(needs.states, needs.states)].any():
        return ()
    try:
        program = loop.whole_program(supplied=True, begin=partial(_Compared, policy.kind, always))
        states = len(program.states)
        nothing: dict[Name, Array] = {name: np.zeros(states + 1) for name in program.inputs}
        values = read_polynomials(program, states, nothing)
    except ProblemError:
        return ()
    F = np.array([values[op] for op in program.following])[:, :states]
    d: list[int] = np.flatnonzero(needs.states).tolist()  # the states of the plant come first
    response = _response(F, d)
    if response is None:
        return ()
    forms = {name: as_form(values[op]) for name, op in program.outputs.items() if isinstance(name, Option)}
    found = list[str]()
    for decision, trigger in policy.decisions.items():
        sent = trigger.labels[always.taken[decision]]
        rows = [_rows(forms[Option(decision, label)] - forms[Option(decision, sent)]) for label in trigger.labels]
        compared = np.vstack(rows)[:, :states]
        seen = np.zeros((len(compared), loop.problem.plant.states))
        seen[:, d] = compared @ response
        seen[np.abs(seen) <= CANCELS * (np.abs(compared) @ np.abs(response)).max(axis=1, keepdims=True)] = 0.0
        if needs.wanders(seen, noise):
            found += [step.link for step in policy.steps if isinstance(step, Send) and step.on == decision]
    return tuple(found)


def _response(F: Array, d: list[int]) -> Array | None:
    """Return all states as a response to the states d in the long run, (states, q), or None if there is none."""
    rest, size = [i for i in range(len(F)) if i not in d], balancing(np.abs(F))
    F = F / size[:, None] * size  # so that an entry that is a rounding error can be told from a small one
    q, response = len(d), np.zeros((len(F), len(d)))
    response[d] = np.eye(q)
    if len(rest) * q > MOST:
        return None
    S, same = F[np.ix_(d, d)], np.eye(q)
    matrix = np.kron(same, F[np.ix_(rest, rest)]) - np.kron(S.T, np.eye(len(rest)))
    right = -F[np.ix_(rest, d)].T.ravel()
    found: Array = np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0], dtype=np.float64)
    if np.abs(matrix @ found - right).max() > CANCELS * max(1.0, float(np.abs(found).max())):
        return None
    response[rest] = found.reshape(q, len(rest)).T
    response[np.abs(response) <= CANCELS * np.abs(response).max(axis=0)] = 0.0
    return response * size[:, None] / size[d]


def _rows(form: Array) -> Array:
    """Return rows η such that the quadratic part of a form depends on ηz alone."""
    values, vectors = np.linalg.eigh(form)
    large = np.abs(values) > RANK * np.abs(values).max(initial=0.0)
    rows = np.sqrt(np.abs(values[large]))[:, None] * vectors[:, large].T
    return np.where(np.abs(rows) > RANK * np.abs(rows).max(initial=0.0), rows, 0.0)


class _Compared(FixedStep):
    """A fixed decision, of whose trigger only the quadratic terms count: memories and random numbers are bounded."""

    def take(self, step: Step) -> None:
        """Take a memory of a quadratic form or a random number as zero."""
        if isinstance(step, Evaluate | Draw):
            self.signals[step.signal] = [self.builder.constant(0.0)]
        else:
            super().take(step)

    def form(self, form: Form) -> int:
        """Return the quadratic terms of a form."""
        return super().form(Form(form.signals if form.Psi is not None else (), form.Psi, form.constant))
