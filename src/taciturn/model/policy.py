"""Policies as data: nodes that compute, decide and exchange packets, and the theory that holds for them.

A policy lists the policy steps of all nodes within one sampling step, in order. A signal that is read before it is
assigned has its value of the previous sampling step. Memories and delays are expressed by this order. The signal
``ONE``, the number 1, is available at every node; its weights are constants.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn._arrays import Array, array, frozen, number
from taciturn._display import Displayed
from taciturn._figure import Size
from taciturn.errors import ProblemError
from taciturn.model.cost import Cost
from taciturn.model.coverage import uncovered
from taciturn.model.diagram import DRAWN, Diagram, Link, Place
from taciturn.model.disturbance import Disturbance
from taciturn.model.intervals import keep_intervals
from taciturn.model.location import Location, joint_cycle
from taciturn.model.network import Network
from taciturn.model.plant import Plant, Prediction
from taciturn.model.reference import Tracking
from taciturn.model.schedule import Schedule
from taciturn.model.steps import (
    ONE,
    Acknowledged,
    Apply,
    Assign,
    Condition,
    Decide,
    Draw,
    Evaluate,
    Send,
    Step,
    assigned,
    site_of,
)
from taciturn.model.steps import Received as Received
from taciturn.model.steps import Terms as Terms
from taciturn.model.theory import Guarantee, Theory
from taciturn.model.trigger import Form, Scheduled, Trigger, shape_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class Policy(Displayed):
    """A control policy as data: the policy steps that its nodes execute, in order, within each sampling step.

    If the network limits the intervals between sends, the decisions of the policy keep these limits
    (``taciturn.model.intervals``).

    Args:
        kind: name of the policy kind in the catalogue.
        steps: policy steps within a sampling step, in order; they compute deviations from the operating point of the
            model, if it has one.
        model: the discrete-time plant for which the policy was designed.
        theory: what is known about the policy, such as a bound on its cost; default: nothing.
        sites: groups of nodes at the same site, which have access to the same signals.
        locations: finite discrete states.
        initial: initial values of memories by signal; default 0.
        tick: seconds per step; 1 if time is counted in steps.
        network: the network for which the policy was designed.
        prediction: the model of an actuator that predicts in continuous time between steps, or None.
        tracking: the signals of a reference that the policy tracks, or None.
        schedule: the offline schedule of a link, or None.
        notes: remarks that a reader of the results should know.
        disturbance: the slow disturbance at the inputs that the model contains and ``close`` adds to plants, or None.

    Raises:
        ProblemError: if a signal, decision or location is not defined, a matrix has the wrong size, a link has two
            packets, a cost is not finite, or theory for linear steps is given with a step that is a function.
    """

    kind: str
    steps: tuple[Step, ...]
    model: Plant
    theory: Theory = field(default_factory=Theory)
    sites: tuple[frozenset[str], ...] = ()
    locations: tuple[Location, ...] = ()
    initial: Mapping[str, Array] = field(default_factory=lambda: {})
    tick: float = 1.0
    network: Network = field(default_factory=Network)
    prediction: Prediction | None = None
    tracking: Tracking | None = None
    schedule: Schedule | None = None
    notes: tuple[str, ...] = ()
    disturbance: Disturbance | None = None
    sizes: Mapping[str, int] = field(init=False)

    def __post_init__(self) -> None:
        """Check that all parts of the policy are consistent."""
        number("tick", self.tick, 0.0)
        for name, value in keep_intervals(self).items():
            object.__setattr__(self, name, value)
        computed = [name for step in self.steps if isinstance(step, Apply) for name in step.signals]
        self.theory.check(self.kind, computed)
        sizes = {ONE: 1, **{signal: len(entries) for signal, (_, entries) in self.measured.items()}}
        for step in self.steps:
            for name, size in assigned(step).items():
                if name == ONE:
                    raise ProblemError(
                        f"{ONE!r} is assigned, but this name denotes the number 1; expected another name"
                    )
                if sizes.setdefault(name, size) != size:
                    raise ProblemError(
                        f"{name} has {sizes[name]} entries in one step and {size} in another; expected equal sizes"
                    )
        object.__setattr__(self, "sizes", sizes)
        initial = {  # + 0.0: a program merges states that start equal, and −0.0 equals 0.0
            name: frozen(array(f"initial {name}", value, (self._size(name),)) + 0.0)
            for name, value in self.initial.items()
        }
        object.__setattr__(self, "initial", initial)
        decided: list[str] = []
        for step in self.steps:
            if isinstance(step, Decide):
                decided.append(step.decision)
            elif not isinstance(step, Apply | Draw) and isinstance(step.on, str) and step.on not in decided:
                raise ProblemError(
                    f"the condition {step.on!r} is used before it is decided; expected one of the earlier decisions "
                    f"{decided}"
                )
            self._check(step)
        links = [step.link for step in self.steps if isinstance(step, Send)]
        for link in set(links):
            if links.count(link) > 1:
                raise ProblemError(
                    f"a step sends {links.count(link)} packets over the {link} link; "
                    "expected a single Send with the signals and labels of all these packets"
                )
        for location in self.locations:
            if location.on is not None and location.table.shape[1] != self.outcomes(location.on):
                raise ProblemError(
                    f"location {location.name} has {location.table.shape[1]} columns; "
                    f"expected {self.outcomes(location.on)}, one per outcome of {location.on}"
                )
        for signal, (node, entries) in self.applied.items():
            if sizes.get(signal) != len(entries):
                got = f"has {sizes[signal]} entries" if signal in sizes else "is never assigned"
                raise ProblemError(
                    f"{signal} {got}; expected a signal with {len(entries)} entries that is assigned at the {node}"
                )

    def summary(self) -> Mapping[str, object]:
        """Return the kind, cost, guarantee, plant, decisions, links and network of the policy by name."""
        proved = self.guarantee
        per = None if self.tick == 1 else f"{self.tick:g} s"
        return {
            "kind": self.kind,
            "cost_all_time": self.theory.cost_all_time,
            "guarantee": None if proved is None else f"at most {proved.cost:.6g}: {proved.statement}",
            "period": per,
            "plant": self.model.short(None if self.prediction is None else len(self.prediction.L)),
            "decisions": [f"{name}: {' or '.join(one.labels)}" for name, one in self.decisions.items()],
            "links": [f"{link.name}: {link.packet}, {link.condition}" for link in self.diagram().links],
            "network": self.network.short(),
            "notes": self.notes,
        }

    def short(self) -> str:
        """Return the policy kind."""
        return self.kind

    @property
    def cost(self) -> Cost | None:
        """The cost for which the policy was designed, or None."""
        return self.theory.cost

    @property
    def cost_all_time(self) -> float:
        """Cost of sending at every step, in the units of the cost.

        Raises:
            ProblemError: the theory of the policy does not contain it.
        """
        if self.theory.cost_all_time is None:
            raise ProblemError(
                f"the cost of sending every sample is unknown for {self.kind}; expected Theory(cost_all_time=…) in the "
                "policy"
            )
        return self.theory.cost_all_time

    @property
    def parts(self) -> tuple[object, ...]:
        """The parts that every interpreter of the policy must cover: steps, locations and reference signals."""
        return self.steps, self.locations, self.tracking

    @property
    def designed_for(self) -> tuple[object, ...]:
        """Plant, network and cost of the design."""
        return self.model, self.network, self.theory.cost

    @property
    def guarantee(self) -> Guarantee | None:
        """The proven upper bound on the cost, or None if it is unknown or if the theory does not cover the steps."""
        return None if uncovered(self.theory.covers, self.parts) else self.theory.guarantee

    @property
    def measured(self) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        """The node and the outputs of each measured signal by name: ``y``, or ``y_NODE``, and ``reference``."""
        return self.network.measurements(self.model.sensed, self.model.set_points)

    @property
    def applied(self) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        """The node and the inputs of each applied signal by name: ``input``, or ``input_NODE``."""
        return self.network.applications(self.model.inputs)

    @property
    def scheduled(self) -> tuple[str, ...]:
        """The links on which a decision sends; without decisions, all links."""
        sends = [step for step in self.steps if isinstance(step, Send)]
        return tuple(step.link for step in sends if step.on is not None) or tuple(step.link for step in sends)

    def holds(self, link: str) -> bool:
        """Return whether the receiver of a link keeps the last received value in silence."""
        received = [step for step in self.steps if isinstance(step, Assign) and step.on == Received(link)]
        kept = [(step.size, step.branches[0].get(step.signal)) for step in received if len(step.branches[0]) == 1]
        return any(isinstance(own, np.ndarray) and np.array_equal(own, np.eye(size)) for size, own in kept)

    @property
    def decisions(self) -> Mapping[str, Trigger]:
        """The trigger of each decision by name."""
        return {step.decision: step.trigger for step in self.steps if isinstance(step, Decide)}

    @property
    def cycle(self) -> int:
        """Number of steps after which all locations that are independent of data, such as step counters, repeat."""
        return joint_cycle(self.locations, self.decisions)

    @cached_property
    def in_units(self) -> Policy:
        """The policy in the units of the plant, as nodes carry it out.

        The steps of a policy compute deviations from the operating point of its model. Here measurements, inputs,
        estimates and their copies, also in packets, include the point.
        """
        from taciturn.model.coordinates import in_units

        return in_units(self)

    def outcomes(self, condition: Condition) -> int:
        """Return the number of outcomes of a condition."""
        if not isinstance(condition, str):
            return 2
        if condition not in self.decisions:
            raise ProblemError(f"the condition {condition!r} is not a decision; expected one of {list(self.decisions)}")
        return len(self.decisions[condition].labels)

    def site(self, node: str) -> frozenset[str]:
        """Return the nodes at the same site as this node."""
        return site_of(node, self.sites)

    def diagram(self) -> Diagram:
        """Return the nodes and links of the policy as a diagram that can be printed or plotted.

        Example:
            >>> from taciturn import load
            >>> [link.packet for link in load("rover").design().diagram().links]
            ['command (1)', 'y (1)']
        """
        DRAWN.check(self.parts, self.designed_for)
        return draw_diagram(self)

    def plot(self, ax: Any = None, figsize: Size | None = None) -> Figure:
        """Return a figure of the nodes and of the packets that they exchange within a step."""
        return self.diagram().plot(ax, figsize)

    def _size(self, name: str) -> int:
        if name not in self.sizes:
            raise ProblemError(f"the signal {name!r} is never assigned; expected one of {sorted(self.sizes)}")
        return self.sizes[name]

    def _check(self, step: Step) -> None:
        if isinstance(step, Assign | Evaluate) and step.on is not None:
            found = len(step.branches if isinstance(step, Assign) else step.forms)
            if found != self.outcomes(step.on):
                raise ProblemError(
                    f"{step.signal} has {found} branches; "
                    f"expected {self.outcomes(step.on)}, one per outcome of {step.on}"
                )
        if isinstance(step, Assign):
            for terms in step.branches:
                for name, value in terms.items():
                    self._check_schedule(value)
                    rows, columns = shape_of(value)
                    if columns != self._size(name):
                        hint = ". Did you pass its transpose?" if rows == self._size(name) else ""
                        raise ProblemError(
                            f"the weight of {name} in {step.signal} has shape {(rows, columns)}; "
                            f"expected {self._size(name)} columns, the entries of {name}{hint}"
                        )
        elif isinstance(step, Evaluate):
            for form in step.forms:
                self._check_form(form)
        elif isinstance(step, Decide):
            for form in step.trigger.forms:
                self._check_form(form)
        elif isinstance(step, Apply):
            for name in step.reads:
                self._size(name)
        elif isinstance(step, Send):
            for name in step.payload:
                self._size(name)
            unknown = [label for label in step.labels if step.on is None or label not in self.decisions[step.on].labels]
            if unknown:
                raise ProblemError(
                    f"the packet of the {step.link} link is sent for the label {unknown[0]!r}; "
                    f"expected a label of its decision ({step.on})"
                )

    def __str__(self) -> str:
        """Return the kind, the cost of sending every sample, the guarantee and the diagram as text."""
        all_time, proved = self.theory.cost_all_time, self.guarantee
        known = [] if all_time is None else [f"J_all = {all_time:.6g}"]
        known += [] if proved is None else [f"{proved.statement}: at most {proved.cost:.6g}"]
        return f"{self.kind}{': ' if known else ''}{'; '.join(known)}\n{self.diagram().text()}"

    def _check_form(self, form: Form) -> None:
        self._check_schedule(form.Psi)
        self._check_schedule(form.constant)
        size = sum(self._size(name) for name in form.signals)
        if form.Psi is not None and shape_of(form.Psi) != (size, size):
            raise ProblemError(f"Psi for {form.signals} has shape {shape_of(form.Psi)}; expected {(size, size)}")
        if form.bell is not None and len(form.bell.Pi) != size:
            raise ProblemError(f"Pi for {form.signals} has shape {form.bell.Pi.shape}; expected {(size, size)}")
        for name in form.plus:
            if self._size(name) != 1:
                raise ProblemError(f"{name} has {self._size(name)} entries; expected a scalar signal")

    def _check_schedule(self, value: object) -> None:
        if not isinstance(value, Scheduled):
            return
        sizes = {location.name: len(location.table) for location in self.locations}
        if sizes.get(value.by) != len(value.values):
            got = f"it has {sizes[value.by]} states" if value.by in sizes else f"the policy has only {list(sizes)}"
            raise ProblemError(
                f"a table has {len(value.values)} entries selected by the location {value.by!r}, but {got}; "
                "expected one entry per state of the location"
            )


def draw_diagram(policy: Policy) -> Diagram:
    """Return the nodes of a policy and the links between them, derived from its policy steps.

    Example:
        >>> from taciturn import Cost, Plant, design
        >>> policy = design.lqg(Plant([[2.0]], [[1.0]], [[0.01]]), Cost([[1.0]], [[2.0]]), theta=0.1)
        >>> draw_diagram(policy).links[0].condition
        'if send, by estimate, candidate, error'
    """
    sends = [step for step in policy.steps if isinstance(step, Send)]
    sites = dict.fromkeys(policy.site(node) for node in policy.network.nodes)
    return Diagram(tuple(_place(policy, site) for site in sites), tuple(_link(policy, step) for step in sends))


def _place(policy: Policy, site: frozenset[str]) -> Place:
    measures = sum(len(entries) for node, entries in policy.measured.values() if node in site)
    applies = sum(len(entries) for node, entries in policy.applied.values() if node in site)
    applied, predicted = (applies, 0) if policy.prediction is None or not applies else policy.prediction.L.shape
    decisions = [step.decision for step in policy.steps if isinstance(step, Decide) and step.at in site]
    nodes = tuple(node for node in policy.network.nodes if node in site)
    return Place(nodes, measures, tuple(decisions), applied, predicted)


def _link(policy: Policy, step: Send) -> Link:
    steps, locations = policy.steps, policy.locations
    payload = {name: policy.sizes[name] for name in step.payload}
    conditions = [other.on for other in steps if isinstance(other, Assign | Evaluate)]
    conditions += [location.on for location in locations]
    told = any(isinstance(on, Acknowledged) and on.link == step.link for on in conditions)
    ends = (step.link, step.at, policy.network.receiver(step.link), payload)
    if step.on is None:
        return Link(*ends, "always", acknowledged=told)
    trigger = next(other.trigger for other in steps if isinstance(other, Decide) and other.decision == step.on)
    labels = step.labels or trigger.labels[1:]
    decided = (step.on, labels, tuple(label for label in trigger.labels if label not in labels))
    read_by = {by for form in trigger.forms for by in _tables(form)}
    tables = [location for location in locations if location.name in read_by]
    turning = tuple(location.name for location in tables if len(location.table) > 1)
    if trigger.reads or any(location.on is not None for location in tables):
        return Link(*ends, "decision", *decided, (*trigger.reads, *turning), acknowledged=told)
    return Link(*ends, "schedule", *decided, turning, *_pattern(trigger, tables, labels), told)


def _tables(form: Form) -> list[str]:
    """Return the names of the locations that select the weights of a form."""
    return [value.by for value in (form.Psi, form.constant) if isinstance(value, Scheduled)]


def _pattern(trigger: Trigger, clocks: Sequence[Location], labels: Sequence[str]) -> tuple[tuple[bool, ...], int]:
    """Return whether a packet is sent at each step, and the step from which this pattern repeats."""
    here = {clock.name: clock.initial for clock in clocks}
    visited: dict[tuple[int, ...], int] = {}
    pattern: list[bool] = []
    while tuple(here.values()) not in visited:
        visited[tuple(here.values())] = len(pattern)
        constants = [form.constant for form in trigger.options.values()]
        values = [float(c.values[here[c.by]]) if isinstance(c, Scheduled) else c for c in constants]
        pattern.append(trigger.labels[int(np.argmin(values))] in labels)
        here = {clock.name: int(clock.table[here[clock.name]]) for clock in clocks}
    return tuple(pattern), visited[tuple(here.values())]
