"""Which networks a policy runs over: none whose nodes read what they do not hold, and no link that carries nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from taciturn._arrays import instance
from taciturn.errors import InformationError, ProblemError
from taciturn.model.network import Network
from taciturn.model.packets import packet_shapes, told_by
from taciturn.model.policy import (
    ENDS,
    ONE,
    Acknowledged,
    Apply,
    Assign,
    Condition,
    Decide,
    Draw,
    Evaluate,
    LinkName,
    NodeName,
    Policy,
    Received,
    Send,
    Step,
)
from taciturn.model.steps import assigned, read
from taciturn.model.trigger import Form, Scheduled

Site: TypeAlias = frozenset[NodeName]


def check_network(policy: Policy, network: Network) -> None:
    """Refuse a network over which a policy cannot run, or of which it would ignore a part.

    Raises:
        InformationError: a node uses what it cannot know.
        ProblemError: the delay is not the one of the design, something is given for a link that carries nothing, or a
            range is missing or has another number of entries than the packet.
    """
    instance("network", network, Network)
    check_information(policy, network)
    if network.delay != policy.network.delay:
        raise ProblemError(
            f"network.delay is {network.delay}, and {policy.kind} was designed for {policy.network.delay}; "
            "expected the delay of the design"
        )
    packet_shapes(policy, network)
    carrying = links_of(policy)
    if network.payload != "float64" and not any(told_by(policy, link) for link in carrying):
        raise ProblemError(
            f"network.payload is {network.payload!r}, and no packet of {policy.kind} tells its receiver what it does "
            "not hold; expected payload = 'float64', the default: there is nothing to round"
        )
    for link in ENDS:
        given = [name for name in network.given(link) if link not in carrying]
        if given:
            others = " and ".join(f"the {other} link" for other in carrying)
            raise ProblemError(
                f"network.{given[0]} is given, and no node of {policy.kind} receives a packet on the {link} link; "
                f"expected properties of {others or 'no link'} only: remove network.{given[0]}"
            )


def links_of(policy: Policy) -> tuple[LinkName, ...]:
    """Return the links whose packets change what a node does: a step sends them, and their arrival is a condition."""
    sent: list[LinkName] = [step.link for step in policy.steps if isinstance(step, Send)]
    heard = {on.link for on in _conditions(policy) if isinstance(on, Received | Acknowledged)}
    return tuple([link for link in sent if link in heard])


def unheard_acknowledgements(policy: Policy, network: Network) -> bool:
    """Tell whether packets are acknowledged, and nothing that a node does depends on it."""
    return network.protocol == "tcp" and not any(isinstance(on, Acknowledged) for on in _conditions(policy))


def _conditions(policy: Policy) -> list[Condition | None]:
    steps = [step.on for step in policy.steps if isinstance(step, Assign | Evaluate)]
    return steps + [location.on for location in policy.locations]


def check_information(policy: Policy, network: Network) -> None:
    """Refuse a policy whose nodes read what they do not hold.

    A node holds what it or a node at its site assigned, the measurement if the sensor is at its site, and, in the
    branch where a packet has arrived, what was in the packet.

    Args:
        policy: the policy.
        network: the network; only ``"udp"`` keeps outcomes from the sender.

    Raises:
        InformationError: naming node and signal.
    """
    knowledge = _Knowledge(policy, network)
    for step in policy.steps:
        knowledge.check(step)
    for location in policy.locations:
        if location.at is not None:
            knowledge.check_condition(location.on, location.at)


class _Knowledge:
    """Where every signal, decision and packet comes from."""

    def __init__(self, policy: Policy, network: Network) -> None:
        self.policy, self.network = policy, network
        self.home: dict[str, Site] = {"y": policy.site("sensor")}  # ONE is at home everywhere
        self.decided: dict[str, Site] = {}
        self.packets: dict[str, tuple[Site, tuple[str, ...]]] = {}
        for step in policy.steps:
            site = policy.site(step.at)
            if isinstance(step, Decide):
                self.decided[step.decision] = site
            elif isinstance(step, Send):
                self.packets[step.link] = (site, step.payload)
            for name in assigned(step):
                if self.home.setdefault(name, site) != site:
                    raise InformationError(f"{name} is assigned at {step.at} and elsewhere; expected one owner")

    def check(self, step: Step) -> None:
        """Check one step."""
        if isinstance(step, Draw):
            return
        on = None if isinstance(step, Apply | Decide) else step.on
        self.check_condition(on, step.at)
        for outcome, (names, weights) in enumerate(_reads(step)):
            arrived = on.link if isinstance(on, Received) and outcome == 1 else None
            for name in names:
                self._check_read(name, step.at, arrived)
            for weight in weights:
                self._check_schedule(weight, step.at)

    def check_condition(self, condition: Condition | None, at: NodeName) -> None:
        """Check that a node can see an outcome."""
        site = self.policy.site(at)
        if isinstance(condition, str) and self.decided[condition] != site:
            raise InformationError(
                f"{at} uses the decision {condition!r} of another node; "
                "expected its own decisions, or a received packet"
            )
        if isinstance(condition, Received) and ENDS[condition.link] not in site:
            raise InformationError(f"{at} uses what arrived on the {condition.link} link; expected its own links")
        if isinstance(condition, Acknowledged):
            if condition.link not in self.packets or self.packets[condition.link][0] != site:
                raise InformationError(
                    f"{at} uses an acknowledgement of the {condition.link} link; expected a link on which it sends"
                )
            if self.network.protocol == "udp":
                raise InformationError(
                    f"{at} uses an acknowledgement of the {condition.link} link, and udp sends none; "
                    "expected protocol 'tcp'"
                )

    def _check_read(self, name: str, at: NodeName, arrived: str | None) -> None:
        packet = self.packets[arrived][1] if arrived in self.packets else ()
        if name != ONE and self.home.get(name) != self.policy.site(at) and name not in packet:
            raise InformationError(
                f"{at} reads {name!r}, which it does not hold; expected its own signals or a received packet's payload"
            )

    def _check_schedule(self, weight: object, at: NodeName) -> None:
        if not isinstance(weight, Scheduled):
            return
        owner: NodeName | None = next(
            (location.at for location in self.policy.locations if location.name == weight.by), None
        )
        if owner is not None and self.policy.site(owner) != self.policy.site(at):
            raise InformationError(
                f"{at} reads the location {weight.by!r} of {owner}; expected its own location or a shared clock"
            )


def _reads(step: Assign | Evaluate | Apply | Decide | Send) -> list[tuple[Sequence[str], Sequence[object]]]:
    """Return the signals and the weights that each branch of a step reads."""
    if isinstance(step, Assign):
        return [(tuple(terms), tuple(terms.values())) for terms in step.branches]
    if isinstance(step, Apply | Send):
        return [(tuple(read(step)), ())]
    forms: Sequence[Form] = step.forms if isinstance(step, Evaluate) else tuple(step.trigger.options.values())
    return [(form.reads, (form.Psi, form.constant)) for form in forms]
