"""The network of a control loop: nodes that measure, control or apply inputs, and the links between them.

One node controls. Every other node sends its measurements to it, or receives inputs from it, over a link that has the
name of the node; a node at the controller's place (``site``) needs none. This graph is the only form of a network.

A network that states no nodes has the usual ones: a sensor, a controller and an actuator, each at a place of its own.
Their places are open: a policy kind may put sensor and controller, or controller and actuator, at one place. The
arguments of ``Network`` from ``protocol`` on, and the table ``[network]`` of a problem file, state the links of these
three nodes. Such a network remembers the keys of the table (``stated``), so that messages name what the user has
written: ``network.sensor_loss`` and not ``links.sensor.loss``. Networks that differ only in these keys are equal.

The names of signals follow from the nodes. If one node measures all outputs in their order, its signal is ``y``, and
otherwise that of each node is ``y_NODE``; likewise ``input`` and ``input_NODE``. Names of signals, and the order of the
nodes, enter the fingerprint of a policy, so they belong to the packet format.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from numbers import Integral
from typing import Any, Literal, cast

import numpy as np

from taciturn._arrays import Array, count, flag, instance, number, quoted
from taciturn._display import Displayed
from taciturn._text import number_of, percent
from taciturn.errors import ProblemError
from taciturn.model.delay import WHOLE, DelayLaw
from taciturn.model.key import stated_as
from taciturn.model.link import IDEAL_LINK as IDEAL_LINK
from taciturn.model.link import LinkLaw as LinkLaw
from taciturn.model.link import ProtocolName as ProtocolName
from taciturn.model.link import usual_links
from taciturn.model.losses import LossLaw
from taciturn.model.wire import PLANT, SETPOINT, Encoding, EncodingName

RoleName = Literal["measures", "applies"]
Entries = bool | tuple[int, ...]
ENTRIES: Mapping[str, str] = {"measures": "outputs", "applies": "inputs"}
SHOWN = 3  # consecutive symbols that are named one by one


@dataclass(frozen=True, repr=False)
class NodeRole(Displayed):
    """Role of a node: it measures outputs of the plant, applies inputs, or controls.

    Args:
        measures: indices of the outputs that the node measures; True for all outputs, False for none.
        applies: indices of the inputs that the node applies; True for all inputs, False for none.
        controls: whether the node is the controller, which all other nodes send to or receive from.
        site: name of a node at the same place, with which the node needs no link; None if the node has its own place.

    Raises:
        ProblemError: an index is negative or repeated, or the node has no role.
    """

    measures: Entries = field(default=False, metadata=stated_as(Any))  # checked below, with the remedy
    applies: Entries = field(default=False, metadata=stated_as(Any))
    controls: bool = False
    site: str | None = None

    def __post_init__(self) -> None:
        """Check the indices."""
        for name in ("measures", "applies"):
            value: object = getattr(self, name)
            if isinstance(value, bool):
                continue
            whole = _whole_numbers(value)
            if whole is None:
                raise ProblemError(
                    f"{name} is {quoted(value)}; expected a list of whole numbers, the indices of {ENTRIES[name]} from "
                    "0 on, or true for all"
                )
            if min(whole, default=0) < 0:
                raise ProblemError(
                    f"{name} contains the index {min(whole)}; expected indices of {ENTRIES[name]} from 0 on"
                )
            listed = tuple(whole)
            if len(set(listed)) < len(listed):
                raise ProblemError(f"{name} is {list(listed)}; expected a list that contains each index only once")
            object.__setattr__(self, name, listed or False)
        object.__setattr__(self, "controls", flag("controls", self.controls))
        if self.site is not None and not isinstance(cast("object", self.site), str):
            raise ProblemError(f"site is {quoted(self.site)}; expected the name of a node")
        if not (self.measures or self.applies or self.controls):
            raise ProblemError(
                "the node neither measures, applies nor controls; expected at least one of the keys measures, "
                "applies and controls"
            )

    def entries(self, role: RoleName, size: int) -> tuple[int, ...]:
        """Return the indices of the outputs or inputs of this node, if the plant has ``size`` of them."""
        given: Entries = getattr(self, role)
        return (tuple(range(size)) if given else ()) if isinstance(given, bool) else given

    def text(self, outputs: int, inputs: int) -> str:
        """Describe what the node does with numbered symbols, such as "measures y1, y2"."""
        parts = ["controls"] if self.controls else []
        both: tuple[tuple[RoleName, str, int], ...] = (("measures", "y", outputs), ("applies", "u", inputs))
        for role, letter, size in both:
            found = self.entries(role, size)
            parts += [f"{role} {symbols_text(letter, entry_numbers(found, size))}"] if found else []
        return "; ".join(parts) + ("" if self.site is None else f"; at the place of {self.site}")

    def short(self) -> str:
        """Describe what the node does in few words, such as "measures"."""
        return ", ".join(name for name in ("measures", "controls", "applies") if getattr(self, name))


def entry_numbers(entries: Sequence[int], size: int) -> list[int]:
    """Number the entries of a vector from 1 on for symbols such as y1. A single entry gets the number 0."""
    return [i + 1 if size > 1 else 0 for i in entries]


def symbols_text(letter: str, numbers: Sequence[int]) -> str:
    """Write numbered symbols as text, such as "y1, y2" or "u1 to u6". The number 0 is not written."""
    named = [f"{letter}{number or ''}" for number in numbers]
    run = len(numbers) > SHOWN and list(numbers) == list(range(numbers[0], numbers[0] + len(numbers)))
    return f"{named[0]} to {named[-1]}" if run else ", ".join(named)


def _whole_numbers(value: object) -> list[int] | None:
    """Return a list of whole numbers, or None if the value is something else."""
    if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
        return None
    given = [*cast("Sequence[object]", value)]
    whole = [int(index) for index in given if not isinstance(index, bool) and isinstance(index, Integral)]
    return whole if len(whole) == len(given) else None


USUAL: Mapping[str, NodeRole] = {
    "sensor": NodeRole(measures=True),
    "controller": NodeRole(controls=True),
    "actuator": NodeRole(applies=True),
}
"""The nodes of a network that states none; a policy kind decides which of them share a place."""


TOLD = {"udp": " (no acknowledgement)", "tcp": " (acknowledged)"}
NAME = r"[A-Za-z][A-Za-z0-9_-]{0,31}"
PROTOCOL = "network.protocol"
TOO_LATE = "the loss of packets later than "
SHORT: Mapping[tuple[str, str], str] = {
    (link, name): {"acknowledged": PROTOCOL, "payload": "network.payload"}.get(name, f"network.{link}_{name}")
    for link in ("sensor", "actuator")
    for name in (
        "loss",
        "burst",
        "range",
        "energy",
        "battery",
        "delay",
        "buffer",
        "acknowledged",
        "payload",
        "acknowledgement_delay",
    )
}
"""The keys of the table [network], which states properties of the links between the usual nodes."""
RESERVED = PLANT, SETPOINT  # links that are not those of nodes
REFERENCE = "reference"  # signal of the set-points that the controller is given


@dataclass(frozen=True, init=False, repr=False)
class Network(Displayed):
    """A network: nodes with their roles, and one link for each node that is not at the controller's site.

    A link has the name of its node. A node that measures sends to the controller; a node that applies inputs receives
    from the controller. Without ``nodes``, the network has a sensor, a controller and an actuator, and the other
    arguments describe its two links.

    Args:
        protocol: ``"udp"`` (without acknowledgement), ``"tcp"`` (with acknowledgement) or ``"ideal"``.
        actuator_loss: loss probability of a packet to the actuator, in [0, 1].
        sensor_loss: loss probability of a packet from the sensor, in [0, 1].
        delay: computation delay in steps, at least 0.
        actuator_burst: bursty losses instead of ``actuator_loss``.
        sensor_burst: bursty losses instead of ``sensor_loss``.
        payload: encoding of the numbers in a packet: ``"float64"`` (exact), or ``"float32"`` or ``"int16"`` (rounded).
        actuator_range: with ``"int16"``, full-scale value of packets to the actuator: one number, or one per entry.
        sensor_range: with ``"int16"``, full-scale value of packets from the sensor: one number, or one per entry.
        nodes: the roles of the nodes by name, of which one controls.
        links: the laws of the links by node; a link that is not listed is ideal.
        stated: the key of a problem file by link and property, for messages; default ``links.LINK.PROPERTY``.
        missing: by node that measures, the probability that its sample is missing in a step, or a law of bursts.

    Raises:
        ProblemError: if a probability is outside [0, 1], an ideal network has losses, a link has both loss and burst,
            a range is not positive or is given without ``"int16"``, or the nodes and links do not form a network.

    Example:
        >>> tank = Network(nodes={"level": NodeRole(measures=True), "plc": NodeRole(controls=True),
        ...                       "pump": NodeRole(applies=True, site="plc")}, links={"level": LinkLaw(loss=0.1)})
        >>> tank.receiver("level"), list(tank.links)
        ('plc', ['level'])
    """

    nodes: Mapping[str, NodeRole] = field(default_factory=lambda: USUAL)
    links: Mapping[str, LinkLaw] = field(default_factory=lambda: {"sensor": IDEAL_LINK, "actuator": IDEAL_LINK})
    delay: int = 0
    stated: Mapping[tuple[str, str], str] = field(default_factory=lambda: {}, compare=False)
    missing: Mapping[str, float | LossLaw] = field(default_factory=lambda: {})

    def __init__(
        self,
        protocol: ProtocolName = "ideal",
        actuator_loss: float = 0.0,
        sensor_loss: float = 0.0,
        delay: int = 0,
        actuator_burst: LossLaw | None = None,
        sensor_burst: LossLaw | None = None,
        payload: EncodingName = "float64",
        actuator_range: float | Sequence[float] | None = None,
        sensor_range: float | Sequence[float] | None = None,
        *,
        nodes: Mapping[str, NodeRole] | None = None,
        links: Mapping[str, LinkLaw] | None = None,
        stated: Mapping[tuple[str, str], str] | None = None,
        missing: Mapping[str, float | LossLaw] | None = None,
    ) -> None:
        """Check the arguments and store the graph."""
        object.__setattr__(self, "delay", count("network.delay", delay, 0))
        laws = {
            "sensor": {"loss": sensor_loss, "burst": sensor_burst, "range": sensor_range},
            "actuator": {"loss": actuator_loss, "burst": actuator_burst, "range": actuator_range},
        }
        if nodes is None and links is None:
            object.__setattr__(self, "nodes", USUAL)
            object.__setattr__(self, "links", usual_links(protocol, payload, laws))
            object.__setattr__(self, "stated", SHORT)
            object.__setattr__(self, "missing", self._checked_samples(missing or {}))
            return
        if protocol != "ideal" or payload != "float64" or any(any(law.values()) for law in laws.values()):
            raise ProblemError(
                "nodes or links are given together with the protocol, losses or encodings of a network of three "
                "nodes; expected these properties in 'links'"
            )
        for name, given in (("nodes", nodes), ("links", links)):
            if given is not None:
                instance(name, given, Mapping)
        object.__setattr__(self, "nodes", dict(USUAL if nodes is None else nodes))
        object.__setattr__(self, "stated", dict(stated or {}))
        self._check_nodes()
        object.__setattr__(self, "links", self._checked_links(links or {}))
        object.__setattr__(self, "missing", self._checked_samples(missing or {}))

    def summary(self) -> Mapping[str, object]:
        """Return the values to display: the nodes and their roles, the links, and the delay."""
        nodes = ", ".join(f"{name} {role.short()}" for name, role in self.nodes.items())
        return {"links": self.short(), "nodes": nodes, "delay": self.delay}

    def __hash__(self) -> int:
        """Return the hash of the nodes, the links and the delay."""
        return hash((*self.nodes.items(), *self.links.items(), self.delay, *self.missing.items()))

    def _check_nodes(self) -> None:
        for name, role in self.nodes.items():
            instance(f"nodes.{name}", role, NodeRole)
            if not isinstance(cast("object", name), str) or not re.fullmatch(NAME, name) or name in RESERVED:
                raise ProblemError(
                    f"nodes.{name} has the name {name!r}; expected a name of at most 32 letters, digits, hyphens and "
                    f"underscores that begins with a letter and is not {' or '.join(map(repr, RESERVED))}"
                )
            home = None if role.site is None else self.nodes.get(role.site)
            if role.site is not None and (home is None or home.site is not None or role.site == name):
                first = [other for other, one in self.nodes.items() if one.site is None]
                raise ProblemError(
                    f"nodes.{name}.site is {role.site!r}; expected the name of one of the nodes {', '.join(first)}"
                )
        controllers = [name for name, role in self.nodes.items() if role.controls]
        if len(controllers) != 1:
            raise ProblemError(
                f"{number_of(len(controllers), 'node')} control ({', '.join(controllers) or 'none'}); expected one "
                "node with controls = true"
            )
        for name in self._remote():
            if self.nodes[name].measures and self.nodes[name].applies:
                raise ProblemError(
                    f"nodes.{name} measures outputs and applies inputs, but a link has one direction; expected two "
                    f'nodes, the second with site = "{name}"'
                )

    def _checked_links(self, links: Mapping[str, LinkLaw]) -> dict[str, LinkLaw]:
        remote = self._remote()
        for name, law in links.items():
            instance(f"links.{name}", law, LinkLaw)
            if name not in self.nodes:
                raise ProblemError(
                    f"links.{name} is not the link of a node; expected the name of one of the nodes {', '.join(remote)}"
                )
            if name not in remote:
                raise ProblemError(
                    f"links.{name} is given, but the node {name!r} is at the controller's site; expected no such "
                    f"link: remove links.{name}, or remove nodes.{name}.site"
                )
        return {name: links.get(name, IDEAL_LINK) for name in remote}

    def _checked_samples(self, missing: Mapping[str, float | LossLaw]) -> dict[str, float | LossLaw]:
        """Return the laws by which samples are missing, without those by which none is missing."""
        instance("missing", missing, Mapping)
        found = dict[str, float | LossLaw]()
        for name, law in missing.items():
            key = f"links.{name}.missing"
            if name not in self.sensors:
                raise ProblemError(
                    f"{key} is given, but {name!r} is no node that measures; expected one of the nodes "
                    f"{', '.join(self.sensors)}"
                )
            if not isinstance(law, LossLaw):
                found[name] = number(key, law, 0.0, 1.0, closed=True)
                continue
            law.check()
            found[name] = law.loss if law.constant else law
        return {name: found[name] for name in self.sensors if found.get(name, 0.0) != 0.0}

    def _remote(self) -> list[str]:
        return [name for name in self.nodes if self.place(name) != self.place(self.controller)]

    @property
    def controller(self) -> str:
        """Name of the node that controls."""
        return next(name for name, role in self.nodes.items() if role.controls)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the nodes that measure outputs of the plant."""
        return tuple(name for name, role in self.nodes.items() if role.measures)

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of the nodes that apply inputs."""
        return tuple(name for name, role in self.nodes.items() if role.applies)

    @property
    def sites(self) -> tuple[frozenset[str], ...]:
        """Groups of two or more nodes at the same site."""
        groups: dict[str, list[str]] = {}
        for name in self.nodes:
            groups.setdefault(self.place(name), []).append(name)
        return tuple(frozenset(group) for group in groups.values() if len(group) > 1)

    @property
    def sites_of_controller(self) -> tuple[frozenset[str], ...]:
        """The group of nodes at the controller's site, in a tuple; an empty tuple if the controller is alone there."""
        return tuple(group for group in self.sites if self.controller in group)

    @property
    def own_nodes(self) -> bool:
        """True if the user has defined the nodes. If false, a policy kind may move a default node to the controller."""
        return self.nodes != USUAL

    def beside(self, node: str) -> Network:
        """Move a default node to the controller's site. A network with nodes that the user defined stays as it is."""
        if self.own_nodes:
            return self
        nodes = {**self.nodes, node: replace(self.nodes[node], site=self.controller)}
        return replace(self, nodes=nodes, links={name: law for name, law in self.links.items() if name != node})

    def place(self, node: str) -> str:
        """Return the node that identifies the site of the given node."""
        return self.nodes[node].site or node

    def sender(self, link: str) -> str:
        """Return the node that sends packets on a link."""
        return link if self.nodes[link].measures else self.controller

    def receiver(self, link: str) -> str:
        """Return the node that receives packets on a link."""
        return self.controller if self.nodes[link].measures else link

    def measurements(self, outputs: int, given: int = 0) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        """Return each measured signal by name, with its node and the indices of the outputs that it contains.

        The signal is ``y`` if one node measures all outputs in their order, and ``y_NODE`` otherwise. The set-points
        ``reference`` follow, which the controller is given.

        Raises:
            ProblemError: an output is measured by no node or by several nodes.
        """
        found = self._signals("measures", "y", "output", outputs)
        last = {REFERENCE: (self.controller, tuple(range(outputs, outputs + given)))} if given else {}
        return {**found, **last}

    def applications(self, inputs: int) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        """Return each applied signal, ``input`` or ``input_NODE``, with its node and the indices of its inputs.

        Raises:
            ProblemError: an input is applied by no node or by several nodes.
        """
        return self._signals("applies", "input", "input", inputs)

    def _signals(self, role: RoleName, signal: str, entry: str, size: int) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        held = {name: one.entries(role, size) for name, one in self.nodes.items() if getattr(one, role)}
        for name, listed in held.items():
            if max(listed, default=0) >= size:
                raise ProblemError(
                    f"nodes.{name}.{role} contains the index {max(listed)}; expected indices below {size}, the number "
                    f"of {entry}s of the plant"
                )
        for index in range(size):
            by = [name for name, listed in held.items() if index in listed]
            if len(by) != 1:
                raise ProblemError(
                    f"the plant's {entry} with the index {index} belongs to {' and '.join(by) or 'no node'}; expected "
                    f"exactly one node that {role} it"
                )
        if any(listed == tuple(range(size)) for listed in held.values()):
            return {signal: next(iter(held.items()))}
        return {f"{signal}_{name}": (name, listed) for name, listed in held.items()}

    @property
    def protocol(self) -> str:
        """Protocol of all links, ``"udp"``, ``"tcp"`` or ``"ideal"``; if the links differ, the protocol of each."""
        found = [law.protocol for law in self.links.values()]
        return found[0] if len(set(found)) == 1 else ", ".join(found) or "ideal"

    @property
    def payload(self) -> str:
        """Encoding of the numbers in the packets of all links; if the links differ, the encoding of each."""
        found = [law.payload for law in self.links.values()]
        return found[0] if len(set(found)) == 1 else ", ".join(found) or "float64"

    @property
    def ideal(self) -> bool:
        """True if every link delivers every packet."""
        return all(law.ideal for law in self.links.values())

    def short(self) -> str:
        """Describe the losses, acknowledgements, delay and encodings of the links in a few words."""
        protocols = {law.protocol for law in self.links.values()}
        if protocols <= {"ideal"}:
            text = "ideal: every packet arrives"
        else:
            losses = {
                link: f"{link} drops {percent(law.mean_loss)}{' in bursts' if law.burst else ''}"
                for link, law in self.played().links.items()
                if not law.ideal and (law.mean_loss or law.delay is None)  # a law of delay may lose packets itself
            }
            if len(protocols) == 1:
                text = f"{self.protocol}{TOLD[self.protocol]}" + "; " * bool(losses) + ", ".join(losses.values())
            else:
                text = ", ".join(f"{lost}{TOLD[self.links[link].protocol]}" for link, lost in losses.items())
        if self.delay:
            text += f"; {number_of(self.delay, 'step')} of delay"
        for link, law in self.links.items():
            text += f"; {link}: {', '.join(law.lateness())}" if law.lateness() else ""
        for node, law in self.missing.items():
            share = law.loss if isinstance(law, LossLaw) else law
            text += f"; {percent(share)} of the samples of {node} are missing"
            text += ", in bursts" if isinstance(law, LossLaw) else ""
        text += f"; numbers as {self.payload}" if self.rounded else ""
        return text.removeprefix("; ")

    def key(self, link: str, name: str) -> str:
        """Return the key of problem files that states a property of a link."""
        return self.stated.get((link, name), f"links.{link}.{name}")

    def lost(self, link: str) -> str:
        """Return the key of problem files that states the losses of a link."""
        return self.key(link, "loss" if self.burst(link) is None else "burst")

    def unusual(self, link: str, *names: str) -> list[str]:
        """Return the keys of those named properties of a link that an ideal link does not have."""
        law = self.links[link]
        return [self.key(link, name) for name in names if getattr(law, name) != getattr(IDEAL_LINK, name)]

    @property
    def losing(self) -> str | None:
        """The first key that states random delays, losses, acknowledgements or a delay; None if all links are ideal."""
        lost = [key for link in reversed(tuple(self.links)) for key in self.unusual(link, "loss", "burst")]
        varies = {link: self.key(link, "delay") for link in self.late if not self.acknowledges(link)}
        told = [varies.get(link, key) for link in self.links for key in self.unusual(link, "acknowledged")]
        found = sorted([*lost, *told], key=lambda key: key != PROTOCOL) + ["network.delay"] * (self.delay > 0)
        random = [self.key(link, "delay") for link in self.late]  # which make a link one that may drop packets
        return next(iter([*random, *found]), None)

    def encoding(self, link: str) -> Encoding:
        """Return how the numbers in the packets of a link are encoded.

        Raises:
            ProblemError: if the payload is ``"int16"`` and the link has no range.
        """
        law = self.links[link]
        if law.payload == "int16" and law.range is None:
            raise ProblemError(
                f"{self.key(link, 'range')} is missing, but {self.key(link, 'payload')} is 'int16'; expected the "
                f"largest absolute value of the numbers in a packet of the {link} link"
            )
        return Encoding(law.payload, law.range or ())

    def burst(self, link: str) -> LossLaw | None:
        """Return the model of a link's bursty losses; None if its losses are not bursty."""
        return self.links[link].played().burst

    def loss(self, link: str) -> float:
        """Return the loss probability of a link. If losses are bursty, it is that of the stationary distribution."""
        return self.links[link].played().mean_loss

    def acknowledges(self, link: str) -> bool:
        """Return whether a link drops packets, and its sender receives acknowledgements of those that arrive."""
        return self.links[link].acknowledged is True

    def outage(self, link: str) -> float:
        """Return the probability that a link drops the next packet, in the limit of a long run of dropped packets."""
        turns, losses = self.chain(link)
        return float(np.abs(np.linalg.eigvals(turns * losses)).max())

    def chain(self, link: str) -> tuple[Array, Array]:
        """Return the transition matrix of a link's channel state, (s, s), and the loss probability in each state, (s,).

        A link with a constant loss probability has one state.
        """
        burst = self.burst(link)
        return (np.ones((1, 1)), np.array([self.loss(link)])) if burst is None else (burst.turns, burst.losses)

    def chain_of_samples(self, node: str) -> tuple[Array, Array]:
        """Return the same for the samples of a node: transition matrix, and probability that a sample is missing."""
        law = self.missing.get(node, 0.0)
        return (law.turns, law.losses) if isinstance(law, LossLaw) else (np.ones((1, 1)), np.array([law]))

    def with_laws(self, changes: Mapping[str, Any]) -> Network:
        """Return a copy of the network with changed properties of all links, such as ``loss`` or ``payload``."""
        return self.changed(dict.fromkeys(self.links, changes))

    def changed(self, laws: Mapping[str, Mapping[str, Any]]) -> Network:
        """Return a copy of the network with changed properties of some links, by link and property."""
        links = {name: replace(law, **laws.get(name, {})) for name, law in self.links.items()}
        return replace(self, links=links)

    def without_bursts(self) -> Network:
        """Return a copy of the network whose losses and delays are independent instead of bursty, with the same
        mean.
        """
        laws: dict[str, dict[str, Any]] = {}
        for name, law in self.links.items():
            if law.burst is not None:
                laws[name] = {"loss": law.mean_loss, "burst": None}
                arriving = law.burst.start * (1.0 - law.burst.losses)  # share of the packets that each state delays
                delay = None if law.delay is None else law.delay.mixed(arriving)
                laws[name] |= {"delay": delay}
        return self.changed(laws)

    @property
    def rounded(self) -> bool:
        """True if a link rounds the numbers in its packets."""
        return any(law.payload != "float64" for law in self.links.values())

    @property
    def limited(self) -> bool:
        """True if a link has limits on the number of steps between sends."""
        return any(law.intervals != IDEAL_LINK.intervals for law in self.links.values())

    @property
    def unlimited(self) -> Network:
        """A copy of the network without limits on the number of steps between sends."""
        return self.with_laws(IDEAL_LINK.intervals) if self.limited else self

    def played(self) -> Network:
        """Return a copy of the network without constant delays, which the plant of a design shows instead.

        Losses that are only those of late packets have the name of the buffer in messages.
        """
        late = {name: law for name, law in self.links.items() if law.timed}
        if not late:
            return self
        stated, links = dict(self.stated), {name: law.played() for name, law in late.items()}
        for name, law in late.items():
            if law.loss == 0.0 and law.burst is None and links[name].mean_loss > 0.0:
                told = f"{TOO_LATE}{self.key(name, 'buffer')}"
                stated |= {(name, key): told for key in ("loss", "burst", "acknowledged")}
            if law.buffer is not None:
                stated[name, "delay"] = self.key(name, "buffer")
        return replace(self, links={**self.links, **links}, stated=stated)

    def random_delay(self, link: str, period: float) -> DelayLaw | None:
        """Return the law of the delay of a link in periods, if it is random and the receiver has no buffer."""
        law = self.links[link].played().delay
        return None if law is None else law.in_periods(period)

    def lateness(self, link: str) -> str:
        """Return a clause about a link with random delays, or whose sender learns of a loss only after the delay."""
        law = self.links[link]
        after = law.buffer or (None if law.delay is None else law.delay.constant)
        if law.acknowledgement_delay and (law.delay is None or (after is not None and not any(after))):
            return f"{self.key(link, 'acknowledgement_delay')} is 1, and packets may be lost"
        name = self.key(link, "delay" if law.buffer is None else "buffer")
        return f"{name} is random" if after is None else f"{name} is {after.text()}, and packets may be lost"

    def longest(self, link: str, period: float) -> int:
        """Return the number of steps after which the latest packet of a link with random delays arrives; else 0."""
        law = self.random_delay(link, period)
        return 0 if law is None else ceil(max(law.waits))

    @property
    def remedy(self) -> str:
        """How links that are ``losing`` become ideal, for messages."""
        key = self.losing
        if self.late:
            law, buffer = self.links[self.late[0]], self.key(self.late[0], "buffer")
            told = "" if not law.acknowledgement_delay else ", acknowledgements before the next step"
            return f"expected a constant delay{told}, or {buffer} of at least the largest delay"
        removed = "a buffer that no delay exceeds" if key and key.startswith(TOO_LATE) else f"remove {key}"
        return f"expected ideal links: {removed} (`taciturn network FILE --loss P` drops packets of any policy kind)"

    @property
    def late(self) -> tuple[str, ...]:
        """Names of the links that delay packets at random, and whose receivers have no buffer."""
        return tuple(name for name, law in self.links.items() if law.played().delay is not None)

    def cuts(self, period: float) -> tuple[float, ...]:
        """Return the parts of a period at which packets to actuators may arrive, if delays are random; else nothing."""
        laws = [self.random_delay(name, period) for name in self.links if self.nodes[name].applies]
        parts = sorted({0.0, *(wait % 1.0 for law in laws if law is not None for wait in law.waits)})
        found = tuple(part for i, part in enumerate(parts) if i == 0 or part - parts[i - 1] > WHOLE)
        return found if len(found) > 1 else ()

    def delayed_as(self, other: Network) -> Network:
        """Return a copy of the network whose links have the delays of those of another network.

        A link with the losses of the other one, among them those of late packets, has its law of delay too. A link with
        other losses, as a design assumes that does not know them, has a buffer of the same delay.
        """
        late = {name: law for name, law in other.links.items() if law.timed}
        laws, losses = dict[str, dict[str, Any]](), ("loss", "burst", "acknowledged")
        for name, law in ((name, law) for name, law in late.items() if name in self.links):
            played, mine = law.played(), self.links[name]
            alike = all(getattr(mine, key) == getattr(played, key) for key in losses)
            kept = {key: getattr(law, key) for key in ("delay", "buffer", "acknowledgement_delay", *losses)}
            laws[name] = kept if alike or not any(law.wait) else {"delay": None, "buffer": law.wait}
        return self.changed(laws) if laws else self

    @property
    def delivery(self) -> Network:
        """A copy of the network with losses and delay only: no rounding, prices, energies or limits on intervals, and
        no missing samples.
        """
        usual = {"payload": "float64", "range": None, "price": 1.0, "energy": None, "battery": None}
        found = self.with_laws(usual | IDEAL_LINK.intervals)
        sure = [name for name in found.links if found.loss(name) == 0 and name not in found.late]
        none = {"acknowledged": None, "acknowledgement_delay": 0}  # of packets that all arrive, they tell nothing
        found = found.changed(dict.fromkeys(sure, none))
        return replace(found, missing={}) if found.missing else found

    def with_intervals(self, other: Network) -> Network:
        """Return a copy of this network with the limits on send intervals of another network."""
        changed = {
            name: other.links[name].intervals
            for name, law in self.links.items()
            if law.intervals != other.links[name].intervals
        }
        return self.changed(changed) if changed else self


IDEAL = Network()
