"""Policies of a sensor, a controller and an actuator on a network whose nodes have other names.

A policy is data, so the names of its nodes and links can be replaced. Several sensors at one place act as one sensor of
all their outputs, and several actuators at one place as one actuator.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeVar

import numpy as np

from taciturn._arrays import instance
from taciturn.errors import PlacementError, TaciturnError
from taciturn.model.joint import JointSets
from taciturn.model.link import LinkLaw
from taciturn.model.network import Network
from taciturn.model.policy import Acknowledged, Apply, Assign, Condition, Decide, Draw, Policy, Received, Send, Step
from taciturn.model.roles import TRIANGLE
from taciturn.model.steps import assigned

Value = TypeVar("Value")


def three_nodes(network: Network, kind: str, joint: bool = False) -> Network:
    """Return the network of a sensor, a controller and an actuator whose links have the laws of a given network.

    The limits on the intervals between sends are left out; ``placed`` adds them to the policy.

    Args:
        network: the given network.
        kind: name of the policy kind, for messages.
        joint: whether the controller may decide on sets of links to several actuators, which must be ideal.

    Raises:
        PlacementError: sensors or actuators are at several places, or several of them share a place with several links.
    """
    if network.triangle:
        return network.with_intervals(None)
    links = dict[str, LinkLaw]()
    for name, nodes in (("sensor", network.sensors), ("actuator", network.actuators)):
        at = [node for node in nodes if node in network.links]
        if joint and name == "actuator" and _apart(network):
            _expect_ideal(network, kind, at)
        elif len({network.place(node) for node in nodes}) > 1 or len(at) > 1:
            raise PlacementError(
                f"{kind} has one {name} node, but the network has {' and '.join(nodes)}; expected one {name} node with "
                "all of these, or nodes at the controller's place (site)"
            )
        if at:
            links[name] = network.links[at[0]]
    return Network(delay=network.delay, nodes=TRIANGLE, links=links).with_intervals(None)


@contextmanager
def renamed_keys(network: Network) -> Generator[None]:
    """Name the keys of a given network in the errors of a design for three nodes."""
    try:
        yield
    except TaciturnError as error:
        raise type(error)(_with_keys(str(error), network)) from None


def _with_keys(text: str, network: Network) -> str:
    for name, nodes in (("sensor", network.sensors), ("actuator", network.actuators)):
        for node in [node for node in nodes if node in network.links and not network.triangle][:1]:
            text = text.replace(f"network.{name}_", f"links.{node}.")
    return text


def _apart(network: Network) -> bool:
    """Return whether the actuators have several links, or some of them have a link and others have none."""
    linked = [node for node in network.actuators if node in network.links]
    return len(linked) > 1 or (bool(linked) and len(linked) < len(network.actuators))


def _expect_ideal(network: Network, kind: str, links: Sequence[str]) -> None:
    for link in links:
        if not network.links[link].ideal:
            law, name = network.links[link], "acknowledged"
            name = "burst" if law.burst is not None else "loss" if law.loss else name
            raise PlacementError(
                f"{network.key(link, name)} is {getattr(law, name)}, and {kind} decides on sets of the links "
                f"{', '.join(links)}; expected ideal links"
            )


def placed(policy: Policy, network: Network) -> Policy:
    """Return a policy of a sensor, a controller and an actuator with the nodes of a given network.

    The decisions keep the network's limits on the intervals between sends.

    Raises:
        PlacementError: the network does not correspond to three nodes, or places them elsewhere than the policy.
    """
    instance("policy", policy, Policy)
    instance("network", network, Network)
    if network.nodes == policy.network.nodes or not policy.network.triangle:
        return with_intervals(policy, network)
    joint = _apart(network)
    three_nodes(network, policy.kind, joint)
    sets = JointSets(policy, network) if joint else None
    if sets is not None:
        sets.check()
    names = {"controller": network.controller, "sensor": network.sensors[0], "actuator": network.actuators[0]}
    if joint:
        names["actuator"] = next(node for node in network.actuators if node in network.links)
    for role in ("sensor", "actuator"):
        check_place(policy.kind, network, role, names[role], "controller" in policy.site(role))
    links = {
        names[link]: replace(network.links[names[link]], loss=law.loss, burst=law.burst, acknowledged=law.acknowledged)
        for link, law in policy.network.links.items()
        if names[link] in network.links
    }
    theory, closed, schedule = policy.theory, policy.theory.closed_form, policy.schedule
    renamed = replace(
        theory,
        fixed_rates=_keys(theory.fixed_rates, names),
        errors=_keys(theory.errors, names),
        closed_form=None if closed is None else replace(closed, rates=_keys(closed.rates, names)),
        guarantee=None if theory.guarantee is None else replace(
            theory.guarantee,
            deciders={tuple(names[link] for link in group): d for group, d in theory.guarantee.deciders.items()},
        ),
    )  # fmt: skip
    locations = tuple(
        replace(one, at=None if one.at is None else names[one.at], on=_condition(one.on, names))
        for one in policy.locations
    )
    return replace(
        policy,
        steps=_steps(policy, network, names, sets),
        theory=renamed if sets is None else sets.theory(renamed),
        sites=network.sites,
        locations=locations,
        schedule=None if schedule is None else replace(schedule, links=tuple(names[link] for link in schedule.links)),
        network=replace(network, links={**network.links, **links}, delay=policy.network.delay),
        notes=tuple(_with_keys(note, network) for note in policy.notes),
    )


def with_intervals(policy: Policy, network: Network) -> Policy:
    """Return a policy whose decisions keep the limits of a network on the intervals between sends."""
    designed = policy.network
    instance("network", network, Network)
    if network.nodes != designed.nodes or network.with_intervals(designed) is network:
        return policy
    return replace(policy, network=designed.with_intervals(network))


def expect_ideal_links(kind: str, network: Network) -> None:
    """Raise a ``PlacementError`` if links drop, acknowledge or delay packets, which a kind does not use."""
    if network.unusual:
        raise PlacementError(
            f"{network.unusual[0]} is given, which {kind} does not use; expected ideal links: remove it (`taciturn "
            "network FILE --loss P` drops packets of policies of any kind)"
        )


def check_place(kind: str, network: Network, role: str, node: str, together: bool) -> None:
    """Raise an error if a node is at the controller's place in a policy or in the network, but not in both.

    Args:
        kind: name of the policy kind.
        network: the given network.
        role: the role of the node in the policy: ``"sensor"`` or ``"actuator"``.
        node: the node of the given network.
        together: whether the node is at the controller's place in the policy.

    Raises:
        PlacementError: the places differ.
    """
    wired = node not in network.links
    if together and not wired:
        raise PlacementError(
            f"the {role} of {kind} is at the controller's place, but {node} has a link; expected "
            f'nodes.{node}.site = "{network.controller}"'
        )
    if wired and not together:
        raise PlacementError(
            f"{kind} uses a link between {role} and controller, but {node} is at the controller's place; "
            f"expected {node} at another place"
        )


def _steps(policy: Policy, network: Network, names: Mapping[str, str], sets: JointSets | None) -> tuple[Step, ...]:
    """Return the policy steps with other names of nodes and links, between the signals that the nodes share."""
    plant, found = policy.model, list[Step]()
    measured, applied = network.measurements(plant.sensed), network.applications(plant.inputs)
    if "y" not in measured:
        terms = {signal: np.eye(plant.sensed)[:, [*outputs]] for signal, (_, outputs) in measured.items()}
        found.append(Assign(names["sensor"], "y", terms))
    for step in policy.steps:
        if sets is not None:
            found += sets.of(_renamed(step, names))
            continue
        found.append(_renamed(step, names))
        if "input" in assigned(step) and "input" not in applied:
            unit = np.eye(plant.inputs)
            found += [Assign(node, name, {"input": unit[[*inputs]]}) for name, (node, inputs) in applied.items()]
    return tuple(found)


def _renamed(step: Step, names: Mapping[str, str]) -> Step:
    at = names[step.at]
    if isinstance(step, Apply | Draw | Decide):
        return replace(step, at=at)
    if isinstance(step, Send):
        return replace(step, at=at, link=names[step.link])
    if isinstance(step, Assign):
        branches = step.branches[0] if step.on is None else step.branches
        return Assign(at, step.signal, branches, _condition(step.on, names))
    return replace(step, at=at, on=_condition(step.on, names))


def _condition(on: Condition | None, names: Mapping[str, str]) -> Condition | None:
    return replace(on, link=names[on.link]) if isinstance(on, Received | Acknowledged) else on


def _keys(found: Mapping[str, Value], names: Mapping[str, str]) -> dict[str, Value]:
    return {names.get(link, link): value for link, value in found.items()}
