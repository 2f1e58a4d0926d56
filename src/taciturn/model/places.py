"""The sites of a policy: the nodes that run in the same process, and the name of that process (its role)."""

from __future__ import annotations

from taciturn.errors import ProblemError
from taciturn.model.policy import Policy, Send


def place_of(policy: Policy, role: str) -> frozenset[str]:
    """Return the roles that are at the same site as the given role.

    Raises:
        ProblemError: if there is no such role, or the node belongs to the process of the controller.
    """
    names = roles(policy)
    if role not in names:
        site = policy.site(role)
        at = f"at the site of the controller in {policy.kind}" if len(site) > 1 else "not a role"
        raise ProblemError(f"the node is {role!r}, which is {at}; expected one of {', '.join(names)}")
    return policy.site(role)


def roles(policy: Policy) -> tuple[str, ...]:
    """Return the nodes that run as separate processes, one for each site, in the order of a step.

    Sensors come first, then the controller, then actuators.
    """
    controller, named = policy.network.controller, dict[frozenset[str], str]()
    for node in policy.network.nodes:
        site = policy.site(node)
        named[site] = controller if controller in site else named.get(site, node)
    order = {
        role: 1 if role == controller else 0 if policy.network.nodes[role].measures else 2 for role in named.values()
    }
    return tuple(sorted(order, key=order.__getitem__))


def outputs_at(policy: Policy, role: str) -> list[int]:
    """Return the outputs of the plant that a process measures, in the order of its measurement."""
    return [i for node, outputs in policy.measured.values() if node in policy.site(role) for i in outputs]


def inputs_at(policy: Policy, role: str) -> list[int]:
    """Return the inputs of the plant that a process applies, in the order of its input."""
    return [i for node, inputs in policy.applied.values() if node in policy.site(role) for i in inputs]


def links_to(policy: Policy, role: str) -> tuple[str, ...]:
    """Return the links on which a node receives data."""
    site = place_of(policy, role)
    return tuple(
        step.link for step in policy.steps if isinstance(step, Send) and policy.network.receiver(step.link) in site
    )


def role_at(policy: Policy, node: str) -> str:
    """Return the role of the process that runs a node."""
    return next(role for role in roles(policy) if node in policy.site(role))


def sender_of(policy: Policy, link: str) -> str:
    """Return the role of the process that sends data on a link."""
    return role_at(policy, next(step.at for step in policy.steps if isinstance(step, Send) and step.link == link))


def receiver_of(policy: Policy, link: str) -> str:
    """Return the role of the process that receives data on a link."""
    return role_at(policy, policy.network.receiver(link))


def link_of(policy: Policy, role: str) -> str | None:
    """Return the link on which a process sends data, or else the one on which it may acknowledge data."""
    site = place_of(policy, role)
    sends: list[str] = [step.link for step in policy.steps if isinstance(step, Send) and step.at in site]
    return next(iter(sends + list(links_to(policy, role))), None)


def peer_of(policy: Policy, role: str) -> str | None:
    """Return the process that receives a process's packets: the next node, or the sender that it acknowledges."""
    link = link_of(policy, role)
    if link is None:
        return None
    sender = sender_of(policy, link)
    return receiver_of(policy, link) if sender == role else sender
