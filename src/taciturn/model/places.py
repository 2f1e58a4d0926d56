"""The sites of a policy: the nodes that run in the same process, and the name of that process (its role)."""

from __future__ import annotations

from typing import NamedTuple

from taciturn.errors import ProblemError
from taciturn.model.network import REFERENCE
from taciturn.model.policy import Acknowledged, Assign, Evaluate, Policy, Send
from taciturn.model.wire import PLANT, SETPOINT


class PlantLink(NamedTuple):
    """The packets between the plant and a process: the outputs in a measurement, and the inputs in an input.

    Args:
        measures: role of the process that receives the measurements, if any.
        applies: role of the process that sends the inputs, if any.
        outputs: outputs of the plant in a measurement, in their order.
        inputs: inputs of the plant in an input, in their order.
    """

    measures: str | None
    applies: str | None
    outputs: tuple[int, ...]
    inputs: tuple[int, ...]


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
    measured = [ends for signal, ends in policy.measured.items() if signal != REFERENCE]
    return [i for node, outputs in measured if node in policy.site(role) for i in outputs]


def set_points_at(policy: Policy, role: str) -> list[int]:
    """Return the set-points that a process is given while the loop runs, as numbers of outputs of the plant."""
    node, given = policy.measured.get(REFERENCE, ("", ()))
    return [*given] if node in policy.site(role) else []


def inputs_at(policy: Policy, role: str) -> list[int]:
    """Return the inputs of the plant that a process applies, in the order of its input."""
    return [i for node, inputs in policy.applied.values() if node in policy.site(role) for i in inputs]


def plant_links(policy: Policy) -> dict[str, PlantLink]:
    """Return the links between the plant and the processes by name.

    The link is called ``plant`` if one process measures and one process applies the inputs. Otherwise each of these
    processes has its own link, ``plant/ROLE``. The link ``setpoint`` gives the controller set-points that change.
    """
    names = roles(policy)
    measure = [role for role in names if outputs_at(policy, role)]
    apply = [role for role in names if inputs_at(policy, role)]
    if len(measure) == len(apply) == 1:
        ends = {PLANT: (measure[0], apply[0])}
    else:
        ends = {
            f"{PLANT}/{role}": (role if role in measure else None, role if role in apply else None)
            for role in names
            if role in measure or role in apply
        }
    found = {
        link: PlantLink(
            one, other, tuple(outputs_at(policy, one) if one else ()), tuple(inputs_at(policy, other) if other else ())
        )
        for link, (one, other) in ends.items()
    }
    given = [PlantLink(role, None, tuple(points), ()) for role in names if (points := set_points_at(policy, role))]
    return {**found, **({SETPOINT: given[0]} if given else {})}


def plant_link(policy: Policy, role: str) -> str | None:
    """Return the link between the plant and a process, or None if the process neither measures nor applies inputs."""
    links = [(link, ends) for link, ends in plant_links(policy).items() if link != SETPOINT]
    return next((link for link, ends in links if role in (ends.measures, ends.applies)), None)


def wire_links(policy: Policy) -> tuple[str, ...]:
    """Return the links of a policy and its plant; a packet contains the index of its link."""
    links = tuple(policy.network.links)
    return tuple(dict.fromkeys((*links[:2], PLANT, *links[2:], *plant_links(policy))))


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


def peers_of(policy: Policy, role: str) -> dict[str, str]:
    """Return the process at the other end of each link on which a process sends data or acknowledgements."""
    found: dict[str, str] = {}
    for link in dict.fromkeys(step.link for step in policy.steps if isinstance(step, Send)):
        ends = sender_of(policy, link), receiver_of(policy, link)
        if role == ends[0] or (role == ends[1] and is_acknowledged(policy, link)):
            found[link] = ends[1 - ends.index(role)]
    return found


def is_acknowledged(policy: Policy, link: str) -> bool:
    """Return whether a policy uses the acknowledgements of a link."""
    conditions = [step.on for step in policy.steps if isinstance(step, Assign | Evaluate)]
    conditions += [place.on for place in policy.locations]
    return any(isinstance(on, Acknowledged) and on.link == link for on in conditions)
