"""Checks that a policy can run over a network, and that each node uses only signals that are available to it.

A policy is a list of steps, each at a node. Nodes at one site share all signals. A node can read

* the signals that are assigned at its site, and the measurements of the nodes there;
* in the branches for a received packet, the signals in this packet;
* the outcome of a decision of its site, of a reception on a link to its site, and of an acknowledgement of a packet
  that its site has sent, if the network sends acknowledgements;
* a step counter that all nodes share, or a location of its own site.

Anything else is an ``InformationError``: such a policy could be simulated, but no nodes could run it.

A network must also have the nodes, the delay and the limits of intervals of the design. Properties of a link on which
no packet is received are refused, and so is a rounding without effect, since the policy would ignore them.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import TypeAlias

import numpy as np

from taciturn._arrays import instance
from taciturn._text import number_of
from taciturn.errors import InformationError, ProblemError
from taciturn.model.coverage import INTERVALS, LATE, STEPS, TRACKING, Coverage
from taciturn.model.network import PROTOCOL, TOO_LATE, Network
from taciturn.model.packets import packet_shapes, told_by
from taciturn.model.policy import Policy, at_rest
from taciturn.model.steps import (
    ONE,
    Acknowledged,
    Acted,
    Apply,
    Assign,
    Condition,
    Decide,
    Draw,
    Evaluate,
    Received,
    Send,
    Step,
    assigned,
    hears,
    read,
    uses_every_packet,
)
from taciturn.model.trigger import Form, Scheduled

INFORMED = Coverage(STEPS | TRACKING | INTERVALS | LATE, "the check of the information pattern does not know")
Site: TypeAlias = frozenset[str]


def check_network(policy: Policy, network: Network) -> None:
    """Raise an error if a policy cannot run over a network, or would ignore a property that the network has."""
    instance("network", network, Network)
    if network.nodes != policy.network.nodes:
        raise ProblemError(
            f"the network has the nodes {', '.join(network.nodes)}, but this {policy.kind} policy was designed for "
            f"the nodes {', '.join(policy.network.nodes)}; expected the nodes of the design, each with its role"
        )
    check_information(policy, network)
    if network.delay != policy.network.delay:
        raise ProblemError(
            f"network.delay is {network.delay}, but the policy {policy.kind} was designed for a delay of "
            f"{policy.network.delay}; expected the delay of the design"
        )
    for link, law in network.links.items():
        kept = policy.network.links[link].intervals
        for name in (name for name, limit in law.intervals.items() if limit != kept[name]):
            raise ProblemError(
                f"{network.key(link, name)} is {law.intervals[name]}, but this {policy.kind} policy was designed for "
                f"{kept[name]}; expected the limits of the design, or the loop that `close` returns, whose policy "
                "keeps the limits of the network"
            )
    for link in network.late:
        expect_held(policy, network, link)
    for link in dict.fromkeys(on.link for on in _conditions(policy) if isinstance(on, Acted)):
        _expect_told(policy, network, link)
    packet_shapes(policy, network)
    _expect_within_ranges(policy, network)
    carrying = links_of(policy)
    if network.rounded and not any(told_by(policy, link) for link in carrying):
        raise ProblemError(
            f"network.payload is {network.payload!r}, but each receiver of the policy {policy.kind} already has the "
            "signals in its packets, so rounding has no effect; expected payload = 'float64', the default"
        )
    for link in network.links:
        limited = [name for name, limit in network.links[link].intervals.items() if limit not in (None, 1)]
        stated = [*network.unusual(link, "loss", "burst", "range"), *(network.key(link, name) for name in limited)]
        if stated and link not in carrying:
            others = " and ".join(f"the {other} link" for other in carrying)
            raise ProblemError(
                f"{stated[0]} is given, but no node of the policy {policy.kind} receives a packet on the {link} link; "
                f"expected properties of {others or 'no link'} only: remove {stated[0].removeprefix(TOO_LATE)}"
            )


def expect_held(policy: Policy, network: Network, link: str) -> None:
    """Raise an error unless the receiver of a link with random delays holds values, or knows the age of each packet."""
    told = network.lateness(link)
    others = [location.on for location in policy.locations]
    others += [step.on for step in policy.steps if isinstance(step, Evaluate)]
    taken = [step for step in policy.steps if isinstance(step, Assign) and hears(step.on, link)]
    sent = next((i for i, step in enumerate(policy.steps) if isinstance(step, Send) and step.link == link), None)
    if sent is None or link not in links_of(policy):
        raise ProblemError(
            f"{told}, but no node of the policy {policy.kind} receives a packet on the {link} link; expected "
            f"a constant delay without losses, or {network.key(link, 'buffer')}, with which samples or inputs are late"
        )
    by = [step.signal for step in policy.steps if isinstance(step, Assign)]
    ages = {step.on.oldest for step in taken if isinstance(step.on, Received)}
    if uses_every_packet(policy.steps, link):
        ages = _all_ages(policy, network, link)
    alone = all(by.count(step.signal) == 1 for step in taken)
    held = (alone and all(map(_is_held, taken))) or (None not in ages and (alone or bool(network.nodes[link].measures)))
    held = held and not any(hears(on, link) for on in others)
    held = held or network.longest(link, policy.tick) == 0  # packets are lost, but none is late
    _expect_oldest(policy, network, link, ages)
    if not held or any(policy.steps.index(step) < sent for step in taken):
        raise ProblemError(
            f"{told}, but a node of the policy {policy.kind} that receives packets on the {link} link does more than "
            "to hold their last value, and would have to know how old a packet is; expected a constant delay, "
            f"{network.key(link, 'buffer')}, a policy whose receiver holds (such as actuation or prediction = 'hold'), "
            "or one that is designed for this link and knows the age of packets (distributed for an average cost, or "
            "excess, with actuation = 'model')"
        )
    if Acknowledged(link) in (others + [step.on for step in policy.steps if isinstance(step, Assign)]):
        raise ProblemError(
            f"{told}, but the policy {policy.kind} needs to know at the end of a step whether its packet on the {link} "
            "link has arrived; expected no delay, the policy kind excess with actuation = 'hold', or a link without "
            f"acknowledgements ({network.key(link, 'acknowledged')})"
        )


def _all_ages(policy: Policy, network: Network, link: str) -> Set[int | None]:
    """Return the largest age of a packet that a receiver uses that uses all packets of a link; it works once a step."""
    conditions = [on for on in _conditions(policy) if isinstance(on, Received) and on.link == link]
    found = {on.of_age for on in conditions}
    if network.nodes[link].measures is False or None in found:
        why = "it acts when a packet arrives" if network.nodes[link].measures is False else "it uses the newest one too"
        raise ProblemError(
            f"a node of the policy {policy.kind} uses the packets of each age on the {link} link (of_age), but {why}; "
            "expected a receiver that works once per step and uses the packet of each age, or Received without of_age"
        )
    return {max(age for age in found if age is not None)}


def _expect_oldest(policy: Policy, network: Network, link: str, ages: Set[int | None]) -> None:
    """Raise an error if packets may be older than the steps of a policy tell apart."""
    longest = network.longest(link, policy.tick)
    for oldest in sorted(age for age in ages if age is not None and age < longest):
        raise ProblemError(
            f"{network.key(link, 'delay')} is up to {number_of(longest, 'step')}, but the receiver of this "
            f"{policy.kind} policy was designed for at most {oldest}; expected a shorter delay, or a policy that is "
            "designed for this network"
        )


def _expect_told(policy: Policy, network: Network, link: str) -> None:
    """Raise an error unless the acknowledgements of a link tell in which pieces of the design packets arrive."""
    pieces, designed = network.cuts(policy.tick), policy.network.cuts(policy.tick)
    if link not in network.late or pieces != designed:
        raise ProblemError(
            f"this {policy.kind} policy uses the times of arrival that the {link} link acknowledges, with random "
            f"delays that end at the parts {list(designed or (0.0,))} of a period, but {network.key(link, 'delay')} "
            f"{'is not random' if link not in network.late else f'ends at the parts {list(pieces or (0.0,))}'}; "
            "expected delays with the parts of the design"
        )
    given, known = (one.links[link].acknowledgement_delay for one in (network, policy.network))
    if given != known:
        raise ProblemError(
            f"{network.key(link, 'acknowledgement_delay')} is {given}, but this {policy.kind} policy was designed for "
            f"{known}; expected acknowledgements as late as those of the design"
        )


def _is_held(step: Assign) -> bool:
    """Return whether a signal keeps its value, or becomes 0, if no packet arrives."""
    silent = step.branches[0]
    if not set(silent) <= {step.signal}:
        return False
    own = silent.get(step.signal)
    return own is None or (isinstance(own, np.ndarray) and (not own.any() or np.array_equal(own, np.eye(len(own)))))


def links_of(policy: Policy) -> tuple[str, ...]:
    """Return the links on which the policy sends and reacts to whether a packet arrives."""
    sent: list[str] = [step.link for step in policy.steps if isinstance(step, Send)]
    heard = {on.link for on in _conditions(policy) if isinstance(on, Received | Acknowledged | Acted)}
    return tuple([link for link in sent if link in heard])


def unheard_acknowledgements(policy: Policy, network: Network) -> bool:
    """Return whether the network acknowledges packets that may be lost or late, but the policy does not use this."""
    told = any(isinstance(on, Acknowledged | Acted) for on in _conditions(policy))
    unsure = [link for link in network.links if network.loss(link) > 0 or link in network.late]
    return any(map(network.acknowledges, unsure)) and not told


def _conditions(policy: Policy) -> list[Condition | None]:
    steps = [step.on for step in policy.steps if isinstance(step, Assign | Evaluate)]
    return steps + [location.on for location in policy.locations]


def check_information(policy: Policy, network: Network) -> None:
    """Raise an error if a node of a policy uses a signal that is not available to it."""
    INFORMED.check(policy.parts)
    knowledge = _Knowledge(policy, network)
    for step in policy.steps:
        knowledge.check(step)
    for location in policy.locations:
        if location.at is not None:
            knowledge.check_condition(location.on, location.at)


class _Knowledge:
    """The sites at which all signals, decisions and packets of a policy originate."""

    def __init__(self, policy: Policy, network: Network) -> None:
        self.policy, self.network = policy, network
        self.home: dict[str, Site] = {name: policy.site(node) for name, (node, _) in policy.measured.items()}
        self.decided: dict[str, Site] = {}
        self.packets: dict[str, tuple[Site, tuple[str, ...]]] = {}
        self.sent = set[str]()  # links on which a packet has been sent by the step that is checked
        for step in policy.steps:
            site = policy.site(step.at)
            if isinstance(step, Decide):
                self.decided[step.decision] = site
            elif isinstance(step, Send):
                self.packets[step.link] = (site, step.payload)
            for name in assigned(step):
                if self.home.setdefault(name, site) != site:
                    raise InformationError(
                        f"the signal {name} is assigned at the node {step.at} and at another site; expected only one "
                        "site that assigns this signal"
                    )

    def check(self, step: Step) -> None:
        """Check that the node of a policy step has all signals and conditions that the step uses."""
        if isinstance(step, Send):
            self.sent.add(step.link)
        if isinstance(step, Draw):
            return
        on = None if isinstance(step, Apply | Decide) else step.on
        self.check_condition(on, step.at)
        for outcome, (names, weights) in enumerate(_reads(step)):
            arrived = on.link if isinstance(on, Received) and outcome >= 1 else None
            for name in names:
                self._check_read(name, step.at, arrived)
            for weight in weights:
                self._check_schedule(weight, step.at)

    def check_condition(self, condition: Condition | None, at: str) -> None:
        """Check that the node ``at`` knows whether a condition holds."""
        site = self.policy.site(at)
        if isinstance(condition, str) and self.decided[condition] != site:
            raise InformationError(
                f"the node {at} uses the decision {condition!r} of another node; expected one of its own decisions, or "
                "a received packet"
            )
        if isinstance(condition, Received) and self.network.receiver(condition.link) not in site:
            raise InformationError(
                f"the node {at} uses packets of the {condition.link} link, which it does not receive; expected a link "
                "on which it receives packets"
            )
        if isinstance(condition, Acknowledged | Acted):
            if condition.link not in self.packets or self.packets[condition.link][0] != site:
                raise InformationError(
                    f"the node {at} uses an acknowledgement of the {condition.link} link; expected a link on which it "
                    "sends"
                )
            if isinstance(condition, Acted) and condition.link not in self.sent:
                raise InformationError(
                    f"the node {at} uses the times of arrival on the {condition.link} link before it sends, but no "
                    "node knows a delay in advance; expected this after its packet, at the end of the step"
                )
            if self.network.links[condition.link].acknowledged is False:
                key = self.network.key(condition.link, "acknowledged")
                sends_none = f"which sends none; expected {key} = true"
                if key == PROTOCOL:
                    sends_none = "but protocol 'udp' sends none; expected protocol 'tcp'"
                raise InformationError(
                    f"the node {at} uses an acknowledgement of the {condition.link} link, {sends_none}"
                )

    def _check_read(self, name: str, at: str, arrived: str | None) -> None:
        packet = self.packets[arrived][1] if arrived in self.packets else ()
        if name != ONE and self.home.get(name) != self.policy.site(at) and name not in packet:
            raise InformationError(
                f"the node {at} reads the signal {name!r}, which is not available there; expected a signal of its site "
                "or of a received packet"
            )

    def _check_schedule(self, weight: object, at: str) -> None:
        if not isinstance(weight, Scheduled):
            return
        owner: str | None = next(
            (location.at for location in self.policy.locations if location.name == weight.by), None
        )
        if owner is not None and self.policy.site(owner) != self.policy.site(at):
            raise InformationError(
                f"the node {at} reads the location {weight.by!r} of the node {owner}; expected a location of its own "
                "or a shared step counter"
            )


def _reads(step: Assign | Evaluate | Apply | Decide | Send) -> list[tuple[Sequence[str], Sequence[object]]]:
    """Return the signals and the weights that each branch of a policy step reads."""
    if isinstance(step, Assign):
        return [(tuple(terms), tuple(terms.values())) for terms in step.branches]
    if isinstance(step, Apply | Send):
        return [(tuple(read(step)), ())]
    forms: Sequence[Form] = step.forms if isinstance(step, Evaluate) else step.trigger.forms
    return [(form.reads, (form.Psi, form.constant)) for form in forms]


def _expect_within_ranges(policy: Policy, network: Network) -> None:
    """Raise an error if a packet cannot carry the values at the operating point."""
    moves = at_rest(policy)
    for step in (step for step in policy.steps if isinstance(step, Send)):
        largest = network.encoding(step.link).full_scale
        values = np.concatenate([moves.get(name, np.zeros(policy.sizes[name])) for name in step.payload])
        if largest and (np.abs(values) > np.array(largest)).any():
            raise ProblemError(
                f"{network.key(step.link, 'range')} is {list(largest)}, but at the operating point a packet of the "
                f"{step.link} link carries {values.tolist()}; expected a range above these values"
            )
