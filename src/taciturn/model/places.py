"""The places of a policy: which of its nodes run together, and under which name."""

from __future__ import annotations

from taciturn.errors import ProblemError
from taciturn.model.policy import NODES, NodeName, Policy


def place_of(policy: Policy, role: NodeName) -> frozenset[NodeName]:
    """Return the nodes that share the place of a role.

    Raises:
        ProblemError: no such role, or the place is the controller's.
    """
    names = roles(policy)
    if role not in names:
        site = policy.site(role)
        at = f"at the place of the controller in {policy.kind}" if len(site) > 1 else "not a role"
        raise ProblemError(f"the node is {role!r}, which is {at}; expected one of {', '.join(names)}")
    return policy.site(role)


def roles(policy: Policy) -> tuple[NodeName, ...]:
    """Return the nodes that run as processes of their own, in the order of a tick: one for each place."""
    return tuple(role for role in NODES if role == "controller" or "controller" not in policy.site(role))


def role_at(policy: Policy, node: str) -> NodeName:
    """Return the role whose process runs a node."""
    return next(role for role in roles(policy) if node in policy.site(role))
