"""The packets that the nodes of a policy exchange, and the fingerprint by which nodes recognise their policy.

Nodes at one site run in one process, whose role is the name of one of them: the controller, if it is there, and
otherwise the first. Within a step, the processes of sensors run first, then that of the controller, then those of
actuators. The packets between the processes follow from the links of the network; those between the plant and the
processes, from what the nodes measure and apply. Each packet contains the number of its link. The numbers 0 and 1
belong to the first two links of the network and 2 to the plant, as they did before networks could have more links.

All nodes of a loop must run the same policy. A packet therefore contains the fingerprint of the policy: a digest of its
steps, locations and initial values, with six digits of each matrix. It contains the nodes unless they are the usual
ones, which were the only ones in earlier versions.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, NamedTuple, cast

import numpy as np

from taciturn._arrays import Array
from taciturn.errors import ProblemError
from taciturn.model.network import REFERENCE, Network
from taciturn.model.policy import Policy
from taciturn.model.steps import ONE, Acknowledged, Acted, Apply, Assign, Evaluate, Send, assigned
from taciturn.model.wire import PERSON, PLANT, SETPOINT, Encoding, PacketKind

POINTS = 3  # number of points at which a function is evaluated for the fingerprint
LATER: Mapping[str, object] = {
    "Trigger.limit": None,
    "Trigger.excluded": {},
    "Received.oldest": None,
    "Received.of_age": None,
}  # fields of later versions, which fingerprints omit if so
DIGITS = 1e6  # resolution relative to the largest entry of a matrix, to which designs on different machines agree


class PlantLink(NamedTuple):
    """A link between the plant and the processes of the nodes, which carries measured outputs and inputs to apply."""

    measures: str | None  # role of the process that receives the measurements, if any
    applies: str | None  # role of the process that sends the inputs, if any
    outputs: tuple[int, ...]  # outputs of the plant in a measurement, in their order; the set-points follow them
    inputs: tuple[int, ...]  # inputs of the plant in an input, in their order


def place_of(policy: Policy, role: str) -> frozenset[str]:
    """Return the nodes that run in one process, which are all at the same site."""
    names = roles(policy)
    if role not in names:
        site = policy.site(role)
        at = f"at the site of the controller in {policy.kind}" if len(site) > 1 else "not a role"
        raise ProblemError(f"the node is {role!r}, which is {at}; expected one of the nodes {', '.join(names)}")
    return policy.site(role)


def roles(policy: Policy) -> tuple[str, ...]:
    """Return the roles of the processes, in the order of a step. One process runs all nodes of a site.

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
    """Return the outputs of the plant that a process measures, in their order in a measurement."""
    site, measured = policy.site(role), policy.measured.items()
    return [i for signal, (node, outputs) in measured if signal != REFERENCE and node in site for i in outputs]


def inputs_at(policy: Policy, role: str) -> list[int]:
    """Return the inputs of the plant that a process applies, in their order in a packet."""
    return [i for node, inputs in policy.applied.values() if node in policy.site(role) for i in inputs]


def plant_links(policy: Policy) -> dict[str, PlantLink]:
    """Return the links between the plant and the processes of the nodes, by name.

    The link is called ``plant`` if one process measures and one process applies the inputs. Otherwise each of these
    processes has its own link, ``plant/ROLE``. The link ``setpoint`` gives the controller set-points that change.
    """
    names = roles(policy)
    outputs = {role: tuple(outputs_at(policy, role)) for role in names}
    inputs = {role: tuple(inputs_at(policy, role)) for role in names}
    measure, apply = ([role for role in names if held[role]] for held in (outputs, inputs))
    if len(measure) == len(apply) == 1:
        found = {PLANT: PlantLink(measure[0], apply[0], outputs[measure[0]], inputs[apply[0]])}
    else:
        found = {
            f"{PLANT}/{role}": PlantLink(
                role if role in measure else None, role if role in apply else None, outputs[role], inputs[role]
            )
            for role in names
            if role in measure or role in apply
        }
    if REFERENCE in policy.measured:
        node, given = policy.measured[REFERENCE]
        found[SETPOINT] = PlantLink(role_at(policy, node), None, given, ())
    return found


def plant_link(policy: Policy, role: str) -> str | None:
    """Return the link between the plant and a process; None if the process neither measures nor applies inputs."""
    links = [(link, ends) for link, ends in plant_links(policy).items() if link != SETPOINT]
    return next((link for link, ends in links if role in (ends.measures, ends.applies)), None)


def wire_links(policy: Policy) -> tuple[str, ...]:
    """Return all links of a policy and of its plant, in the order of the numbers by which packets name them."""
    links = tuple(policy.network.links)
    return tuple(dict.fromkeys((*links[:2], PLANT, *links[2:], *plant_links(policy))))


def links_to(policy: Policy, role: str) -> tuple[str, ...]:
    """Return the links on which a process receives packets."""
    site = place_of(policy, role)
    return tuple(
        step.link for step in policy.steps if isinstance(step, Send) and policy.network.receiver(step.link) in site
    )


def role_at(policy: Policy, node: str) -> str:
    """Return the role of the process that runs a node."""
    return next(role for role in roles(policy) if node in policy.site(role))


def sender_of(policy: Policy, link: str) -> str:
    """Return the role of the process that sends packets on a link."""
    return role_at(policy, next(step.at for step in policy.steps if isinstance(step, Send) and step.link == link))


def receiver_of(policy: Policy, link: str) -> str:
    """Return the role of the process that receives packets on a link."""
    return role_at(policy, policy.network.receiver(link))


def peers_of(policy: Policy, role: str) -> dict[str, str]:
    """Return, for each link on which this process sends packets or acknowledgements, the process at its other end."""
    found: dict[str, str] = {}
    for link in dict.fromkeys(step.link for step in policy.steps if isinstance(step, Send)):
        ends = sender_of(policy, link), receiver_of(policy, link)
        if role == ends[0] or (role == ends[1] and is_acknowledged(policy, link)):
            found[link] = ends[1 - ends.index(role)]
    return found


def is_acknowledged(policy: Policy, link: str) -> bool:
    """Return whether the policy uses acknowledgements of the packets on a link."""
    conditions = [step.on for step in policy.steps if isinstance(step, Assign | Evaluate)]
    conditions += [place.on for place in policy.locations]
    return any(isinstance(on, Acknowledged | Acted) and on.link == link for on in conditions)


def packet_shapes(policy: Policy, network: Network) -> dict[tuple[PacketKind, str], tuple[Encoding, int]]:
    """Return, for each link and kind of packet, the encoding and the number of entries of the payload."""
    exact, shapes = Encoding(), dict[tuple[PacketKind, str], tuple[Encoding, int]]()
    for step in policy.steps:
        if isinstance(step, Send):
            entries = sum(policy.sizes[name] for name in step.payload)
            (whole,) = network.encoding(step.link).parts([entries])
            shapes |= {
                ("data", step.link): (whole, entries),
                ("acknowledgement", step.link): (exact, int(step.link in network.late)),  # its delay, in pieces
                ("mark", step.link): (exact, 0),
            }
    for link, ends in plant_links(policy).items():
        acting = 1 if ends.applies is None else acting_pieces(policy, network, ends.applies)
        sizes: dict[PacketKind, int] = {"measurement": len(ends.outputs), "input": len(ends.inputs) * acting}
        shapes |= {(kind, link): (exact, size) for kind, size in sizes.items() if size}
        shapes |= {("mark", link): (exact, 0)}
        shapes |= operator_shapes(link, len(ends.outputs), policy.model.inputs) if link == SETPOINT else {}
    return shapes


def acting_pieces(policy: Policy, network: Network, role: str) -> int:
    """Return how many inputs a process applies one after the other within a step, if packets arrive within periods."""
    late = any(network.receiver(link) in policy.site(role) for link in network.late)
    return len(network.cuts(policy.tick) or (0.0,)) if late else 1


def carries_samples(kind: str, link: str) -> bool:
    """Return whether packets are measurements of a plant, in which NaN is a missing output."""
    return kind == "measurement" and link != SETPOINT


def operator_shapes(link: str, set_points: int, inputs: int) -> dict[tuple[PacketKind, str], tuple[Encoding, int]]:
    """Return the packets between an operator and the controller.

    They contain set-points; those received and those in effect; and, given or in effect, 1 and manual inputs, or 0 if
    the operation is automatic.
    """
    sizes: dict[PacketKind, int] = {"setpoint": set_points, "report": 2 * set_points}
    sizes |= {"manual": 1 + inputs, "mode": 1 + inputs}
    return {(kind, link): (Encoding(), size) for kind, size in sizes.items()}


def told_by(policy: Policy, link: str) -> tuple[str, ...]:
    """Return the signals in the packets of a link that the receiver obtains only from these packets."""
    receiver = policy.network.receiver(link)
    homes = {name: step.at for step in policy.steps for name in assigned(step)} | {ONE: receiver}
    homes |= {signal: node for signal, (node, _) in policy.measured.items()}
    names = [name for step in policy.steps if isinstance(step, Send) and step.link == link for name in step.payload]
    return tuple(name for name in dict.fromkeys(names) if homes[name] not in policy.site(receiver))


def fingerprint(policy: Policy, network: Network) -> int:
    """Return a 64-bit digest of a policy's steps, locations and initial values, with six digits of each matrix entry.

    Two machines whose linear algebra rounds differently compute the same fingerprint. A function is identified by its
    values at a few points, not by its source code.
    """
    policy = policy.in_units
    steps = [_sampled(policy, step) if isinstance(step, Apply) else step for step in policy.steps]
    data = (steps, policy.locations, dict(policy.initial), policy.sites, policy.tick, network.protocol)
    data = (*data, network.nodes) if network.own_nodes else data
    rounding = [network.encoding(step.link) for step in policy.steps if isinstance(step, Send)]
    limit, rate = policy.model.input_limit, policy.model.input_rate
    limits = [None if limit is None else _sides(limit), *([] if rate is None else [_sides(rate)])]
    points = None if policy.model.changes is None else policy.model.changes.limits
    if points is not None:  # few of their limits show in the values of their function
        limits += [_sides(np.stack([points.low, points.high], axis=1))]
        limits += [] if points.rate is None else [_sides(points.rate)]
    text = repr(_plain([data, rounding, *limits]))
    return int.from_bytes(hashlib.blake2s(text.encode(), digest_size=8, person=PERSON).digest(), "big")


def _sides(limit: Array) -> object:
    """Return limits as one number per input if all are symmetric, and open sides apart."""
    closed = np.isfinite(limit)
    if not closed.all():
        return np.where(closed, limit, 0.0), closed.astype(np.float64)
    return limit[:, 1] if limit.ndim == 2 and np.array_equal(limit[:, 0], -limit[:, 1]) else limit


def _sampled(policy: Policy, step: Apply) -> object:
    """Return an ``Apply`` step in which the function is replaced by its values at three points."""
    found: list[object] = []
    sizes = [policy.sizes[name] for name in step.reads]
    for point in range(1, 1 + POINTS):
        values = np.modf(np.sqrt(point + 7.0 * np.arange(sum(sizes))))[0]  # spread over [0, 1)
        try:
            with np.errstate(all="ignore"):
                returned = step.function(*np.split(values, np.cumsum(sizes)[:-1]))
        except Exception as error:
            raise ProblemError(
                f"the function that computes {', '.join(step.signals)} fails: {type(error).__name__}: {error}; "
                f"expected a function of the vectors {', '.join(step.reads)}"
            ) from error
        listed = cast("Iterable[Any]", (returned,) if len(step.signals) == 1 else returned)
        found += [np.nan_to_num(np.asarray(one, dtype=np.float64)) for one in listed]
    return ("Apply", step.at, dict(step.signals), step.reads, found)


def _plain(value: object) -> object:
    """Return data as nested tuples of strings and integers."""
    if is_dataclass(value) and not isinstance(value, type):
        named = {f"{type(value).__name__}.{field.name}": getattr(value, field.name) for field in fields(value)}
        held = [_plain(one) for name, one in named.items() if name not in LATER or one != LATER[name]]
        return (type(value).__name__, *held)
    if isinstance(value, np.ndarray | float):
        return _whole(np.asarray(value, dtype=np.float64))
    if isinstance(value, Mapping):
        return tuple((str(key), _plain(one)) for key, one in cast("Mapping[object, object]", value).items())
    if isinstance(value, frozenset):
        return tuple(sorted(cast("frozenset[str]", value)))
    if isinstance(value, list | tuple):
        return tuple(_plain(one) for one in cast("Iterable[object]", value))
    return value


def _whole(values: np.ndarray[Any, Any]) -> object:
    """Return numbers as integers: the largest magnitude, and each number relative to the largest magnitude."""
    largest = float(np.abs(values).max(initial=0.0))
    if largest == 0.0:
        return (values.shape, 0)
    return (values.shape, f"{largest:.5e}", *np.rint(values / largest * DIGITS).astype(np.int64).ravel().tolist())
