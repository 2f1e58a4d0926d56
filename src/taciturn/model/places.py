"""The sites of a policy: the nodes that run in the same process, and the name of that process (its role)."""

from __future__ import annotations

from taciturn.errors import ProblemError
from taciturn.model.policy import ENDS, NODES, LinkName, NodeName, Policy, Send


def place_of(policy: Policy, role: NodeName) -> frozenset[NodeName]:
    """Return the nodes at the same site as a role.

    Raises:
        ProblemError: if there is no such role, or the node belongs to the process of the controller.
    """
    names = roles(policy)
    if role not in names:
        site = policy.site(role)
        at = f"at the site of the controller in {policy.kind}" if len(site) > 1 else "not a role"
        raise ProblemError(f"the node is {role!r}, which is {at}; expected one of {', '.join(names)}")
    return policy.site(role)


def roles(policy: Policy) -> tuple[NodeName, ...]:
    """Return the nodes that run as separate processes, one for each site, in the order of a step."""
    return tuple(role for role in NODES if role == "controller" or "controller" not in policy.site(role))


def links_to(policy: Policy, role: NodeName) -> tuple[LinkName, ...]:
    """Return the links on which a node receives data."""
    site = place_of(policy, role)
    return tuple(step.link for step in policy.steps if isinstance(step, Send) and ENDS[step.link] in site)


def role_at(policy: Policy, node: str) -> NodeName:
    """Return the role of the process that runs a node."""
    return next(role for role in roles(policy) if node in policy.site(role))
