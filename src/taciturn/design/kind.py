"""The record of a policy kind: its design function, and all data that commands and pages show of the kind.

The record also says which networks a kind takes, and is the only place that decides this: whether links may drop or
delay packets, and whether there may be several sensors or actuators. ``Kind.network_for`` refuses any other network.

Most design functions know the usual nodes only: a sensor, a controller and an actuator. Their policies are put on the
nodes of a network in two steps, in the same way for problems (``Kind.make``) and for functions that are called in
Python with a network (``on_any_network``):

1. ``usual_nodes`` returns the usual nodes with the laws of the given links, and with their keys for messages. Several
   sensors at one place act as one sensor of all their outputs, and several actuators at one place as one actuator.
2. ``placed`` gives the policy the nodes of the network. A policy is data, so the names of its nodes and links can be
   replaced. If the actuators have several links, the controller decides on sets of them (``several_nodes``).

The places must fit: a kind whose sensor runs the filter needs the sensor at the controller's place, and a kind that
sends measurements needs it at another one.
"""

from __future__ import annotations

import hashlib
import inspect
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeAlias, TypeVar, cast, get_type_hints

import numpy as np

from taciturn._arrays import instance, quoted
from taciturn._display import Displayed
from taciturn._plugins import find_plugins, in_this_wheel
from taciturn.design.missing_samples import for_missing_samples
from taciturn.design.several_nodes import JointSets, decides_on_sets, expect_ideal_sets
from taciturn.errors import PlacementError, ProblemError, TaciturnError
from taciturn.model.coverage import SIMULATED
from taciturn.model.information import expect_held
from taciturn.model.link import LinkLaw
from taciturn.model.network import Network
from taciturn.model.policy import Policy, with_intervals
from taciturn.model.steps import (
    Acknowledged,
    Acted,
    Apply,
    Assign,
    Condition,
    Decide,
    Draw,
    Received,
    Send,
    Step,
    assigned,
)
from taciturn.model.transport import expected_by

if TYPE_CHECKING:
    from taciturn.model.cost import Cost
    from taciturn.model.plant import ContinuousPlant, Plant
    from taciturn.renewal.without_steps import PolicyWithoutSteps

AnyPolicy: TypeAlias = "Policy | PolicyWithoutSteps"
Setting: TypeAlias = float | int | str
PlantClass = Literal["discrete", "continuous", "outputs", "jumps"]
CostClass = Literal["average", "horizon", "discount"]
FollowedClass = Literal["constant", "changing"]
REPAIR = "; expected a policy of this kind, or a ProblemError: repair or remove the package"
IN_PYTHON = ("plants",)  # arguments that no file can state
ANY_PLANT: tuple[PlantClass, ...] = ("discrete", "continuous", "outputs", "jumps")


@dataclass(frozen=True, repr=False)
class TradeoffParameter(Displayed):
    """The main tuning parameter of a policy kind, which trades cost against send rate."""

    name: str  # key of ``[policy]``; if several of the kind's parameters are given, the first is varied
    link: str | None = None  # the link whose rate the parameter changes; default the only link that the policy decides
    least: float = 0.0  # lower limit, which an integer parameter may equal and a real parameter must exceed
    whole: bool = False  # whether the parameter is an integer
    falls: bool = True  # whether the rate decreases when the parameter increases
    continuous: bool | None = None  # whether it applies to continuous-time plants
    cycles: bool = False  # whether the parameter may also be a list of integers; the exact costs select the best list

    def value_in(self, given: Mapping[str, object]) -> float:
        """Return the given value of this parameter. If it is missing or out of range, return a default value."""
        value = given.get(self.name)
        usual = max(self.least, 1) if self.whole else self.least + 1.0
        return value if isinstance(value, int | float) and value > self.least else usual


@dataclass(frozen=True, eq=False, repr=False)
class Kind(Displayed):
    """A policy kind. Its parameters are the keyword-only arguments of its design function.

    The docstring of the design function describes the kind, its parameters (``Args``) and its sources (``Source``).

    Args:
        name: name of the kind in problem files: small letters, digits and hyphens.
        design: function of a plant, a cost and the parameters that returns the policy.
        goal: purpose of the kind, in one phrase.
        tuning: the parameters that trade cost for rate.
        example: values of the parameters for the example of the kind.
        built_in: built-in problem of the example.
        nodes: nodes of the policy: S, C and A are sensor, controller and actuator; a plus joins nodes at the same site.
        plants: properties that the plant may have: ``"discrete"`` or ``"continuous"`` time, ``"outputs"`` with noise
            instead of a measured state, and ``"jumps"``.
        costs: the costs that the design supports: an ``"average"``, a finite ``"horizon"``, a ``"discount"``.
        follows: the set-points of a plant that the design supports: ``"constant"`` ones, which include disturbances,
            and ``"changing"`` ones, at random times or by a timetable. A given controller states its own.
        proved: the proved result, in Markdown.
        relative_to: the control whose cost the bound refers to, in Markdown.
        refused: further conditions under which the design refuses a problem, in Markdown.
        data: data of the policy beyond the matrices, in Markdown.
        order: order of the operations within a step, in Markdown.
        usual: suggested values by parameter. ``taciturn new`` suggests them for the parameters that it asks for, and
            writes those of optional parameters without a question.
        asked: optional parameters that ``taciturn new`` asks for, since the design needs one of several parameters.
        offered: position among the goals that ``taciturn new`` lists; None if the kind is not listed there.
        requires: the condition on plant and cost as a phrase, for messages.
        check: function that raises a ``ProblemError`` if the kind does not support a plant and a cost.
        several_nodes: whether the design takes networks of several sensors or actuators.
        joint_links: whether the controller decides on sets of links to several actuators; then the design is that of
            one actuator, and ``taciturn.design.several_nodes`` derives the decision on sets.
        informed_links: whether the design of a kind with ``joint_links`` has a theory of packets that are late or lost
            on several links, if their fates are acknowledged. It then gets all nodes of the network.
        ideal_links: whether the design takes a network, but refuses links that drop or delay packets.
        runs_with_losses: whether a problem may state losses that the design does not know; the loop is then simulated.
        delay: the largest delay of computations, in steps, that a design with a network supports.
        shares: the parameter that divides a threshold among several links, if there is one.
        for_dropouts: whether ``taciturn new`` offers the kind for links that drop packets.
        keeps_controller: whether the argument ``controller`` of the design is a controller that the user has.

    Raises:
        ProblemError: if the name has other characters.
    """

    name: str
    design: Callable[..., AnyPolicy]
    goal: str
    tuning: tuple[TradeoffParameter, ...] = ()
    example: Mapping[str, Any] = field(default_factory=lambda: {})
    built_in: str = "two-mass"
    nodes: str = "S+C, A"
    plants: tuple[PlantClass, ...] = ANY_PLANT
    costs: tuple[CostClass, ...] = ("average",)
    follows: tuple[FollowedClass, ...] = ("constant", "changing")
    proved: str = "no guarantee"
    relative_to: str = "—"
    refused: str = ""
    data: str = "—"
    order: str = "—"
    usual: Mapping[str, Setting] = field(default_factory=lambda: {})
    asked: tuple[str, ...] = ()
    offered: int | None = None
    requires: str = ""
    check: Callable[[Plant | ContinuousPlant, Cost], object] | None = None
    keeps_controller: bool = False
    for_dropouts: bool = False
    several_nodes: bool = False
    joint_links: bool = False
    informed_links: bool = False
    ideal_links: bool = False
    runs_with_losses: bool = False
    delay: int = 0
    shares: str | None = None

    def __post_init__(self) -> None:
        """Check the name."""
        if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", self.name):
            raise ProblemError(
                f"the name of the policy kind is {self.name!r}; expected lower-case letters and digits, with hyphens "
                "between words"
            )

    def summary(self) -> Mapping[str, object]:
        """Return the values to display: name, goal and parameters of the kind."""
        return {"name": self.name, "goal": self.goal, "parameters": tuple(self.parameters)}

    def short(self) -> str:
        """Return the name of the kind."""
        return self.name

    @cached_property
    def arguments(self) -> Mapping[str, inspect.Parameter]:
        """All arguments of the design function by name."""
        return inspect.signature(self.design).parameters

    @cached_property
    def parameters(self) -> Mapping[str, inspect.Parameter]:
        """Names of the kind's parameters in ``[policy]``: the keyword-only arguments that no other table states."""
        given = self.arguments.items()
        apart = (*self.tables, *IN_PYTHON)
        return {name: one for name, one in given if one.kind is one.KEYWORD_ONLY and name not in apart}

    @cached_property
    def tables(self) -> tuple[str, ...]:
        """Arguments that have tables of their own in problem files, such as ``network`` or ``controller``."""
        names = ("network", "reference", *(("controller",) if self.keeps_controller else ()))
        return tuple(name for name in names if name in self.arguments)

    @property
    def identity(self) -> str:
        """Identifier of the design function in stored results: module, name and, for other packages, a code digest."""
        return self._place if self.in_house else f"{self._place} {code_digest(self.design.__module__)}"

    @property
    def remedy(self) -> str:
        """The remedy in an error message if the policy kind has no tuning parameter."""
        return "another policy kind, such as lqg"

    @cached_property
    def hints(self) -> Mapping[str, Any]:
        """Type annotations of all arguments of the design function, by name."""
        return get_type_hints(self.design)

    @property
    def takes_losses(self) -> bool:
        """True if links may drop packets: the design function accepts them, or the loop is simulated."""
        return ("network" in self.tables and not self.ideal_links) or self.runs_with_losses

    def network_for(self, network: Network | None) -> Network:
        """Return the network that the design function receives: the given one, or the default nodes with its links.

        Args:
            network: the given network; None for ideal links between the usual nodes.

        Raises:
            ProblemError: the record does not list losses or delays that the network has.
            PlacementError: the record does not list so many sensors or actuators as the network has.
        """
        network = Network() if network is None else network
        instance("network", network, Network)
        SIMULATED.check(network)
        if not self.takes_losses and network.losing is not None:
            got = network.lateness(network.late[0]) if network.late else f"{network.losing} is given"
            raise PlacementError(f"{got}, which the policy kind {self.name} does not use; {network.remedy}")
        if self.in_house and network.delay > self.delay:
            few = " or ".join(map(str, range(self.delay + 1)))
            raise ProblemError(
                f"network.delay is {network.delay}; expected a delay of {few} steps with the policy kind {self.name}"
            )
        linked = [node for node in network.actuators if node in network.links]
        if self.informed_links and decides_on_sets(network) and any(map(network.acknowledges, linked)):
            return network.unlimited
        return network if self.several_nodes else usual_nodes(network, self.name, self.joint_links)

    def make(self, plant: Plant | ContinuousPlant, cost: Cost, network: Network, given: Mapping[str, Any]) -> AnyPolicy:
        """Design a policy of this kind for a plant, a cost, a network and the given parameters.

        Raises:
            ProblemError: the record does not list the class of the plant or of the cost or a property of the network,
                or the design function of another package fails or returns no policy of this kind.
        """
        known = "network" in self.tables

        def design(late: Plant | ContinuousPlant, nodes: Network) -> AnyPolicy:
            return self.call(late, cost, {"network": nodes, **given} if known else given)

        return _on(self, plant, network, design)

    def call(self, plant: Plant | ContinuousPlant, cost: Cost, given: Mapping[str, Any]) -> AnyPolicy:
        """Call the design function with all its arguments, and check that it returns a valid policy."""
        design = f"the design function {self._place} of the policy kind {self.name}"
        unlisted = None if self.in_house else self._unlisted(plant, cost)  # the designs of this package check
        try:
            policy = self.design(plant, cost, **given)
        except TaciturnError:
            raise
        except Exception as error:
            if unlisted is None and self.in_house:
                raise
            raise ProblemError(unlisted or f"{design} fails ({type(error).__name__}: {error})" + REPAIR) from error
        if unlisted is not None:
            raise ProblemError(unlisted)
        if getattr(policy, "kind", None) != self.name:
            raise ProblemError(f"{design} returns {quoted(policy)}" + REPAIR)
        return policy

    @property
    def in_house(self) -> bool:
        """True if the design function belongs to a package of the Taciturn project."""
        registered = find_plugins("taciturn.kinds").get(self.name, ())
        return self.design.__module__.startswith("taciturn.") or any(map(in_this_wheel, registered))

    @property
    def _place(self) -> str:
        return f"{self.design.__module__}:{self.design.__qualname__}"

    def _unlisted(self, plant: Plant | ContinuousPlant, cost: Cost) -> str | None:
        """Return a sentence if the record does not list a class of the plant or of the cost, else None."""
        continuous = not hasattr(plant, "dt")
        classes: dict[str, tuple[bool, str]] = {
            "discrete": (not continuous, "the plant is in discrete time"),
            "continuous": (continuous, "the plant is in continuous time"),
            "outputs": (not plant.full_state, "the plant has outputs with noise (plant.C)"),
            "jumps": (getattr(plant, "jumps", None) is not None, "the plant has jumps (plant.jumps)"),
            "average": (not cost.mission, "the cost is an average"),
            "horizon": (cost.horizon is not None, "the cost has a horizon (cost.horizon)"),
            "discount": (cost.discount < 1, "the cost is discounted (cost.discount)"),
        }
        for name, (has, what) in classes.items():
            if has and name not in (*self.plants, *self.costs):
                return f"{what}, which {self.name} does not support; expected another problem, or another policy kind"
        return None

    @property
    def about(self) -> str:
        """The first line of the design function's docstring, which describes the kind in one phrase."""
        return self._text.partition("\n")[0].removeprefix("Design ").rstrip(".:")

    @cached_property
    def notes(self) -> Mapping[str, str]:
        """The descriptions of the design function's arguments, from its docstring."""
        section = re.search(r"\nArgs:\n(.*?)\n\n", self._text, re.DOTALL)
        text = section[1] + "\n" if section else ""
        found = re.findall(r"^    (\w+): (.*?)(?=^    \w+:|\Z)", text, re.M | re.S)
        plain = ((name, " ".join(note.replace("`", "").split())) for name, note in found)
        return {
            name: re.sub(r"(; or|\.)$", "", note) for name, note in plain
        }  # the next argument may be an alternative

    @property
    def sources(self) -> tuple[str, ...]:
        """Keys in ``docs/sources.bib`` of the sources that the design function's docstring cites."""
        found = re.search(r"Source:\s*(.+)", self._text)
        return tuple(re.split(r"[,;]\s*", found[1].strip())) if found else ()

    @property
    def _text(self) -> str:
        return inspect.getdoc(self.design) or ""


@cache
def code_digest(module: str) -> str:
    """Return a digest of the Python files of a module's package, or of its file if it is in no package."""
    top = sys.modules[module.partition(".")[0]]
    paths = [Path(folder) for folder in getattr(top, "__path__", [])]
    files = [file for path in paths for file in sorted(path.rglob("*.py"))] or [Path(top.__file__ or "")]
    read = hashlib.sha256()
    for file in files:
        read.update(file.read_bytes() if file.is_file() else b"")
    return read.hexdigest()


P = ParamSpec("P")
Value = TypeVar("Value")


def on_any_network(design: Callable[P, Policy]) -> Callable[P, Policy]:
    """Wrap a design function for the default nodes, so that it also accepts a network with other nodes."""

    @wraps(design)
    def made(*args: P.args, **named: P.kwargs) -> Policy:
        kind = cast("Kind", vars(sys.modules[design.__module__])["KIND"])  # the record that ends the design's file
        given = cast("dict[str, Any]", named)
        rest = list(cast("tuple[Any, ...]", args))

        def for_nodes(plant: Plant | ContinuousPlant, network: Network) -> Policy:
            changed = {**given, "network": network} | ({} if rest else {"plant": plant})
            return cast("Any", design)(*([plant, *rest[1:]] if rest else []), **changed)

        plant = rest[0] if rest else given.get("plant")
        return cast("Policy", _on(kind, plant, given.get("network"), for_nodes))

    return made


def _on(
    kind: Kind,
    plant: Plant | ContinuousPlant | None,
    network: Network | None,
    design: Callable[[Any, Network], AnyPolicy],
) -> AnyPolicy:
    """Return a policy on a network, from a function that designs it for the nodes that the kind knows.

    The design sees constant delays of links as delays of the plant, and links without them.
    """
    stated = Network() if network is None else network
    instance("network", stated, Network)
    plant, network = plant and expected_by(plant, stated), stated.played()
    known = kind.network_for(network)
    policy = design(plant, known)
    if isinstance(policy, Policy):
        # last, since the laws name nodes of this network
        found = for_missing_samples(placed(policy, network), network)
        for link in network.late:
            expect_held(found, network, link)
        return replace(found, network=found.network.delayed_as(stated))
    if known.nodes != network.nodes:
        raise ProblemError(
            f"the policy {policy.kind} has no sampling steps that nodes could run, but the network has nodes with "
            "names of your own; expected [network], or no network"
        )
    return policy


def usual_nodes(network: Network, kind: str, joint: bool = False) -> Network:
    """Return a network of the default nodes, whose links have the properties of the links of the given network."""
    # without the limits on the intervals between sends, which ``placed`` adds to the policy
    if not network.own_nodes:
        return network.unlimited
    links, stated = dict[str, LinkLaw](), dict[tuple[str, str], str]()
    for name, nodes in (("sensor", network.sensors), ("actuator", network.actuators)):
        at = [node for node in nodes if node in network.links]
        if joint and name == "actuator" and decides_on_sets(network):
            expect_ideal_sets(network, kind, at)
        elif len({network.place(node) for node in nodes}) > 1 or len(at) > 1:
            raise PlacementError(
                f"the policy kind {kind} has only one {name} node, but the network has {' and '.join(nodes)}; expected "
                f"a single {name} node in place of these, or nodes at the controller's site (key 'site')"
            )
        if at:
            links[name] = network.links[at[0]]
            stated |= {(name, one.name): network.key(at[0], one.name) for one in fields(LinkLaw)}
    return Network(delay=network.delay, links=links, stated=stated).unlimited


def placed(policy: Policy, network: Network) -> Policy:
    """Convert a policy of one sensor, one controller and one actuator to the nodes of a given network.

    The decisions keep the network's limits on the intervals between sends.
    """
    instance("policy", policy, Policy)
    instance("network", network, Network)
    if network.nodes == policy.network.nodes or policy.network.own_nodes:
        return with_intervals(policy, network)
    joint, names = decides_on_sets(network), {"controller": network.controller}
    usual_nodes(network, policy.kind, joint)
    sets = JointSets(policy, network) if joint else None
    if sets is not None:
        sets.check()
    for role, nodes in (("sensor", network.sensors), ("actuator", network.actuators)):
        names[role] = next((node for node in nodes if node in network.links), nodes[0])
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
    )


def check_place(kind: str, network: Network, role: str, node: str, together: bool) -> None:
    """Raise an error if policy and network differ on whether a node is at the controller's site."""
    wired = node not in network.links
    if together and not wired:
        raise PlacementError(
            f"the {role} of the policy kind {kind} is at the controller's site, but the node {node!r} has a link; "
            f'expected nodes.{node}.site = "{network.controller}"'
        )
    if wired and not together:
        raise PlacementError(
            f"the policy kind {kind} uses a link between {role} and controller, but the node {node!r} is at the "
            f"controller's site; expected the node {node!r} at another site"
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
    return replace(on, link=names[on.link]) if isinstance(on, Received | Acknowledged | Acted) else on


def _keys(found: Mapping[str, Value], names: Mapping[str, str]) -> dict[str, Value]:
    return {names.get(link, link): value for link, value in found.items()}
