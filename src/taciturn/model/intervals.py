"""Limits on the intervals between sends of a link, as part of a policy's decisions.

A link with the limits n = ``min_interval`` and N = ``max_interval`` adds to its sender a count c of the steps since
the last send. While c < n, the labels that send are excluded from the decision, and while c ≥ N, those that do not.
The count starts at n, as if the last send had been n steps before the first step. It counts sends: a packet that the
link drops counts as sent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain, pairwise, product
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn.errors import ProblemError
from taciturn.model.coverage import INTERVALS
from taciturn.model.link import IDEAL_LINK, LONGEST, LinkLaw
from taciturn.model.location import fixed_choices
from taciturn.model.steps import ONE, Assign, Decide, Send, Step
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Trigger

if TYPE_CHECKING:
    from taciturn.model.network import Network
    from taciturn.model.policy import Policy

HALF = 0.5  # between two counts of steps


def steps_since(link: str) -> str:
    """Return the name of the signal that counts the steps since the last send on a link."""
    return f"steps since a packet on {link}"


def longest_silence(network: Network, link: str) -> int | None:
    """Return the number of steps after which a packet of a running sender must have arrived.

    It is ``max_interval`` on a link without losses, and otherwise None, because a link that drops packets may drop this
    one.
    """
    law = network.links[link]
    return None if law.mean_loss else law.max_interval


def keep_intervals(policy: Policy) -> Mapping[str, Any]:
    """Return the fields of a policy that change so that its decisions keep the limits of its network; often none.

    Raises:
        ProblemError: packets are sent at fixed steps that break the limits, or the decisions keep other limits already.
    """
    steps, network = policy.steps, policy.network
    sends = {step.link: step for step in steps if isinstance(step, Send)}
    kept = {step.signal for step in steps if isinstance(step, Assign)}
    limited = {link: network.links[link] for link in sends if network.links[link].intervals != IDEAL_LINK.intervals}
    present = [link for link in sends if steps_since(link) in kept]
    if not limited and not present:
        return {}
    deciding = {link: law for link, law in limited.items() if not _fixed(policy, sends[link], law)}
    if present:
        _expect_same(policy, present, deciding)
        return {}
    found = [one for step in steps for one in _kept(step, {link: sends[link] for link in deciding}, deciding)]
    theory, withdrawn = _theory(policy, deciding)
    return {
        "steps": tuple(found),
        "initial": {**policy.initial, **_starts(deciding)},
        "theory": theory,
        "notes": (*policy.notes, *withdrawn),
    }


def _starts(laws: Mapping[str, LinkLaw]) -> dict[str, Any]:
    return {steps_since(link): np.array([float(law.min_interval)]) for link, law in laws.items()}


def _kept(step: Step, sends: Mapping[str, Send], laws: Mapping[str, LinkLaw]) -> list[Step]:
    """Return a step; for a decision on limited links, the decision with the labels that it excludes, and the counts."""
    on = {link: send for link, send in sends.items() if isinstance(step, Decide) and send.on == step.decision}
    if not on or not isinstance(step, Decide):
        return [step]
    labels = step.trigger.labels
    sending = {link: send.labels or labels[1:] for link, send in on.items()}
    _expect_sets(step, sending)
    excluded = {
        label: tuple(form for link in on for form in _forms(link, laws[link], label in sending[link]))
        for label in labels
    }
    trigger = replace(step.trigger, excluded={label: forms for label, forms in excluded.items() if forms})
    return [replace(step, trigger=trigger), *(_count(step, link, sending[link]) for link in on)]


def _forms(link: str, law: LinkLaw, sends: bool) -> list[Form]:
    """Return the forms that are positive while a label that sends, or one that does not, breaks the limits."""
    count = steps_since(link)
    if sends:
        return [Form(constant=law.min_interval - HALF, plus={count: -1.0})] if law.min_interval > 1 else []
    return [] if law.max_interval is None else [Form(constant=HALF - law.max_interval, plus={count: 1.0})]


def _count(step: Decide, link: str, sending: Sequence[str]) -> Assign:
    """Return the step that counts the steps since the last send, for the next step."""
    count, one = steps_since(link), np.ones((1, 1))
    return Assign(
        step.at,
        count,
        tuple({ONE: one} if label in sending else {count: one, ONE: one} for label in step.trigger.labels),
        step.decision,
    )


def _expect_sets(step: Decide, sending: Mapping[str, Sequence[str]]) -> None:
    """Raise an error if a decision on several links has no label for a set of links that the limits may demand."""
    labels = {tuple(label in labels for labels in sending.values()) for label in step.trigger.labels}
    missing = [sets for sets in product((False, True), repeat=len(sending)) if sets not in labels]
    if missing:
        named = " and ".join(link for link, sends in zip(sending, missing[0], strict=True) if sends) or "no link"
        raise ProblemError(
            f"the decision {step.decision!r} has no label that sends on {named} only, which limits of the intervals "
            "between sends may demand; expected a label for each set of links, or no min_interval and max_interval"
        )


def _fixed(policy: Policy, send: Send, law: LinkLaw) -> bool:
    """Return whether packets of a link are sent at fixed steps, after a check that these keep the limits."""
    triggers = policy.decisions
    chosen = ["always"] * 2 if send.on is None else fixed_choices(send.on, policy.locations, triggers)
    if chosen is None:
        return False
    horizon = None if policy.theory.cost is None else policy.theory.cost.horizon
    silent = () if send.on is None else _silent(send, triggers[send.on])
    ticks = [k for k, label in enumerate(chosen[:horizon]) if label not in silent]
    gaps = [after - before for before, after in pairwise(ticks)]
    rest = [] if ticks and horizon is None else [(horizon or LONGEST + 1) - (ticks[-1] if ticks else 0)]
    found = {
        "min_interval": min(gaps, default=law.min_interval),
        "max_interval": max([*gaps, *rest, ticks[0] + 1 if ticks else 0]),
    }
    for name, gap in found.items():
        limit = law.intervals[name]
        if limit is not None and (gap < limit if name == "min_interval" else gap > limit):
            every = f"with an interval of {gap} step{'s' * (gap > 1)}" if ticks else "or never"
            raise ProblemError(
                f"{policy.network.key(send.link, name)} is {limit}, but {policy.kind} sends at fixed steps on the "
                f"{send.link} link, {every}; expected a limit that these steps keep, or other parameters of the policy"
            )
    return True


def _silent(send: Send, trigger: Trigger) -> tuple[str, ...]:
    sending = send.labels or trigger.labels[1:]
    return tuple(label for label in trigger.labels if label not in sending)


def _expect_same(policy: Policy, present: Sequence[str], laws: Mapping[str, LinkLaw]) -> None:
    """Raise an error if the decisions of a policy keep other limits than those of its network."""
    wanted = {link: [_numbers(form) for sends in (True, False) for form in _forms(link, law, sends)]
              for link, law in laws.items()}  # fmt: skip
    for link in dict.fromkeys((*present, *laws)):
        count = steps_since(link)
        forms = chain.from_iterable(trigger.excluded.values() for trigger in policy.decisions.values())
        found = {_numbers(form) for form in chain.from_iterable(forms) if count in form.plus}
        if found != set(wanted.get(link, ())):
            raise ProblemError(
                f"the decisions of this {policy.kind} keep other limits of the intervals between sends on the {link} "
                f"link than the network, {policy.network.links[link].intervals}; expected the limits of the design: "
                "design the policy again"
            )


def _numbers(form: Form) -> tuple[object, ...]:
    return (form.constant, *form.plus.items())


def _theory(policy: Policy, laws: Mapping[str, LinkLaw]) -> tuple[Theory, tuple[str, ...]]:
    """Return the theory that holds with limits, and notes on the claims that do not.

    Identities hold for all times of sends. A bound that limits the cost of each silent step holds with further sends;
    no bound holds if a send is withheld.
    """
    theory = policy.theory
    covers = theory.covers | INTERVALS
    if not laws:
        return replace(theory, covers=covers), ()
    withheld = [policy.network.key(link, "min_interval") for link, law in laws.items() if law.min_interval > 1]
    forced = [policy.network.key(link, "max_interval") for link, law in laws.items() if law.max_interval is not None]
    guarantee, notes = theory.guarantee, tuple[str, ...]()
    if guarantee is not None and (withheld or not guarantee.more_sends):
        effect = f"{withheld[0]} withholds" if withheld else f"{forced[0]} forces"
        notes = (f"{effect} packets against the decision of {policy.kind}, so no bound is claimed",)
        guarantee = None
    slower = max(law.min_interval for law in laws.values())
    changed = replace(
        theory,
        guarantee=guarantee,
        errors={} if withheld else theory.errors,
        closed_form=None,
        fixed_rates={link: rate for link, rate in theory.fixed_rates.items() if link not in laws},
        settling=slower * theory.settling,
        recovery=None if theory.recovery is None else slower * theory.recovery,
        covers=covers,
    )
    return changed, notes
