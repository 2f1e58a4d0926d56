"""The cost of silence as forms of a policy, with the belief about the state of a channel with bursts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.design.base import Advantage, Attempts
from taciturn.design.estimation import SEND, by_clock
from taciturn.design.routes import Route
from taciturn.model.policy import ONE, Acknowledged, Apply, Assign, Evaluate, Step
from taciturn.model.trigger import Form

BELIEF = "belief"
GOOD_OR_BAD = ("cost if good", "cost if bad")


@dataclass(frozen=True, eq=False, repr=False)
class Silence(Displayed):
    """The cost of silence, and the policy steps that it needs.

    Args:
        cost: the cost of silence, at the decision.
        identity: the cost beyond that of the base, in a silent step and in a step with a packet.
        before: policy steps before the decision.
        after: policy steps after the packet.
        initial: initial values of the memories.
    """

    cost: Form
    identity: tuple[Form, Form]
    before: tuple[Step, ...] = ()
    after: tuple[Step, ...] = ()
    initial: Mapping[str, Array] = field(default_factory=lambda: {})


def cost_of_silence(
    found: Advantage, route: Route, attempts: Attempts, link: str, phases: Sequence[int], unit: float
) -> Silence:
    """Return the cost of silence for the node that decides.

    Args:
        found: the value of the base.
        route: the signals of the loop.
        attempts: the attempts of the base.
        link: the link.
        phases: step of the pattern in each state of the step counter, or a single one.
        unit: seconds by which a cost per step is divided in the identity.
    """
    n = found.slope.shape[-1]
    none = np.zeros((*found.H.shape[:2], n, n))
    whole: Any = np.block([[found.H, found.slope], [found.slope.swapaxes(2, 3), none]])  # type: ignore[arg-type]
    square: Array = whole[list(phases)]
    tried = np.array([attempts.pattern[phase] for phase in phases])
    signals = ("error", *route.state)
    if len(attempts.losses) == 1:
        values, identity = square[:, 0], signals
        silence = Silence(Form(signals, _by_clock(values)), (Form(), Form()))
    else:
        states = range(len(attempts.losses))
        names = GOOD_OR_BAD if len(states) == 2 else tuple(f"cost in state {m}" for m in states)
        forms = [Form(signals, _by_clock(square[:, m])) for m in states]
        half = 0.5 * np.eye(len(states))
        product = np.block([[0.0 * half, half], [half, 0.0 * half]])  # of the belief and the costs
        values, identity = np.tile(product, (len(phases), 1, 1)), (BELIEF, *names)
        known = (({ONE: np.zeros((1, 1))}, {ONE: np.ones((1, 1))}),) * 2
        silence = Silence(
            Form(identity, values[0]),
            (Form(), Form()),
            (
                # first the update by the previous step, so that decision and identity read the same belief
                Apply(
                    route.node,
                    {BELIEF: len(states)},
                    ChannelBelief(attempts.turns, attempts.losses, attempts.start),
                    (BELIEF, "attempted", "arrived"),
                ),
                *(Evaluate(route.node, name, (form,)) for name, form in zip(names, forms, strict=True)),
            ),
            (
                Assign(route.node, "attempted", known[0], SEND),
                Assign(route.node, "arrived", known[1], Acknowledged(link)),
            ),
            {BELIEF: attempts.start},
        )
    here = values / unit
    saved = Form() if tried.all() else Form(identity, _by_clock(np.where(tried[:, None, None], 0.0, -here)))
    added = Form(identity, _by_clock(np.where(tried[:, None, None], here, 0.0)))
    return replace(silence, identity=(added, saved))


@dataclass(frozen=True, eq=False, repr=False)
class ChannelBelief(Displayed):
    """The update of the distribution of the channel state by the fate of an attempt, and by a step of the channel.

    After a fate that the law excludes, such as an acknowledgement that a fault has lost, it begins again at ``start``.
    """

    turns: Array
    losses: Array
    start: Array

    def __call__(self, belief: Any, attempted: Any, arrived: Any) -> Any:
        """Return the distribution at the next step; ``attempted`` and ``arrived`` are 0 or 1."""
        a, r, p = attempted[0], arrived[0], self.losses
        likelihood = 1.0 - a + a * (r * (1.0 - p) + (1.0 - r) * p)
        weights = belief * likelihood
        total = sum(weights[i] for i in range(len(p)))
        known = np.where(total > 0.0, weights / np.where(total > 0.0, total, 1.0), self.start)
        return self.turns.T @ known


def _by_clock(values: Array) -> Any:
    return by_clock(values[0] if len(values) == 1 else values)
