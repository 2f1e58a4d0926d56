"""Policies as data: nodes that compute, decide and exchange packets, and the theory that holds for the policy.

A policy lists the policy steps of all nodes within one sampling step, in order. A signal that is read before it is
assigned has its value of the previous sampling step. Memories and delays are expressed by this order. The signal
``ONE``, the number 1, is available at every node; its weights are constants.

**Intervals between sends.** A link with the limits n = ``min_interval`` and N = ``max_interval`` adds to its sender a
count c of the steps since the last send. While c < n, the labels that send are excluded from the decision, and while
c ≥ N, those that do not. The count starts at n, as if the last send had been n steps before the first step. It counts
sends: a packet that the link drops counts as sent. Identities of the theory hold for all times of sends. A bound that
limits the cost of each silent step holds with further sends; no bound holds if a send is withheld.

**Units.** A design counts states and inputs from the operating point of its plant. Nodes, packets and trajectories are
in the units of the plant. ``in_units`` adds the point to the signals of a policy: measurements, inputs, estimates, and
the signals that are copied from them. A sum of signals gets a constant term. Any other policy step that reads such a
signal reads its deviation from the point, which a further step computes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, pairwise, product
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn._arrays import Array, array, frozen, instance, number
from taciturn._display import Displayed
from taciturn._figure import Size, StyleName
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.cost import Cost
from taciturn.model.coverage import INTERVALS, uncovered
from taciturn.model.diagram import DRAWN, Diagram, diagram_of
from taciturn.model.disturbance import Disturbance, Tracking
from taciturn.model.link import IDEAL_LINK, LONGEST, LinkLaw
from taciturn.model.network import Network
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.plant import Plant, Prediction, about
from taciturn.model.schedule import Schedule
from taciturn.model.set_points import keep_set_points
from taciturn.model.steps import (
    ONE,
    Apply,
    Assign,
    Condition,
    Decide,
    Draw,
    Evaluate,
    Location,
    Received,
    Send,
    Step,
    Terms,
    assigned,
    fixed_choices,
    hears,
    joint_cycle,
    read,
    site_of,
)
from taciturn.model.theory import Guarantee, Theory
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger, shape_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


ESTIMATE, HELD = "estimate", "held"  # names of signals of all designs
HALF = 0.5  # between two counts of steps


@dataclass(frozen=True, eq=False, repr=False)
class Policy(Displayed):
    """A control policy as data: the ordered list of policy steps that its nodes execute at each sampling instant.

    If the network limits the intervals between sends, the decisions of the policy keep these limits
    (``taciturn.model.policy``). If the model limits the set-points, its controller keeps these limits
    (``taciturn.model.set_points``).

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
        kept = keep_set_points(self.steps, self.model, self.theory, self.initial, self.network.controller)
        for name, value in kept.items():
            object.__setattr__(self, name, value)
        computed = [name for step in self.steps if isinstance(step, Apply) for name in step.signals]
        self.theory.check(self.kind, computed)
        sizes = {ONE: 1, **{signal: len(entries) for signal, (_, entries) in self.measured.items()}}
        for step in self.steps:
            for name, size in assigned(step).items():
                if name == ONE:
                    raise ProblemError(
                        f"a policy step assigns {ONE!r}, but this name denotes the number 1; expected another name"
                    )
                if sizes.setdefault(name, size) != size:
                    raise ProblemError(
                        f"the signal {name} has {number_of(sizes[name], 'entry')} in one step and {size} in another; "
                        "expected equal sizes"
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
                    f"the table of the location {location.name} has {number_of(location.table.shape[1], 'column')}; "
                    f"expected {number_of(self.outcomes(location.on), 'column')}, one for each outcome of {location.on}"
                )
        for signal, (node, entries) in self.applied.items():
            if sizes.get(signal) != len(entries):
                got = f"has {number_of(sizes[signal], 'entry')}" if signal in sizes else "is never assigned"
                raise ProblemError(
                    f"the signal {signal} {got}; expected a signal with {number_of(len(entries), 'entry')} that is "
                    f"assigned at the node {node}"
                )

    def summary(self) -> Mapping[str, object]:
        """Return the values to display: kind, cost, guarantee, plant, decisions, links and network of the policy."""
        proved = self.guarantee
        per = None if self.tick == 1 else f"{self.tick:g} s"
        return {
            "kind": self.kind,
            "cost_all_time": self.theory.cost_all_time,
            "guarantee": None if proved is None else f"at most {proved.cost:.6g}: {proved.statement}",
            "period": per,
            "plant": self.model.short(None if self.prediction is None else len(self.prediction.L)),
            "links": [f"{link.name} {link.rule.sentence}: {link.packet}" for link in self.diagram().links],
            "network": self.network.short(),
            "notes": self.notes,
        }

    def short(self) -> str:
        """Return the policy kind."""
        return self.kind

    @property
    def cost(self) -> Cost | None:
        """Cost for which the policy was designed; None if the design states none."""
        return self.theory.cost

    @property
    def cost_all_time(self) -> float:
        """Cost of sending every sample: an average per step or second, a total over the horizon, or a discounted sum.

        Raises:
            ProblemError: the theory of the policy does not contain it.
        """
        if self.theory.cost_all_time is None:
            raise ProblemError(
                f"the cost of sending every sample is unknown for the policy {self.kind}; expected "
                "Theory(cost_all_time=…) in the policy"
            )
        return self.theory.cost_all_time

    @property
    def parts(self) -> tuple[object, ...]:
        """All parts of the policy that a program which runs it must support: steps, states and reference signals."""
        return self.steps, self.locations, self.tracking

    @property
    def targets(self) -> Mapping[str, str]:
        """Names of the reference signals for the state ``x`` and the input ``applied``; empty without a reference."""
        return {} if self.tracking is None else {"x": self.tracking.state, "applied": self.tracking.input}

    @property
    def designed_for(self) -> tuple[object, ...]:
        """Plant, network and cost of the policy's design."""
        return self.model, self.network, self.theory.cost

    @property
    def guarantee(self) -> Guarantee | None:
        """Proven upper bound on the cost; None if there is none, or if a policy step is not covered by the theory."""
        return None if uncovered(self.theory.covers, self.parts) else self.theory.guarantee

    @property
    def measured(self) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        """Each measured signal (``y``, ``y_NODE`` or ``reference``), with its node and the indices of its outputs."""
        return self.network.measurements(self.model.sensed, self.model.set_points)

    @property
    def applied(self) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        """Each applied signal (``input`` or ``input_NODE``), with its node and the indices of its inputs."""
        return self.network.applications(self.model.inputs)

    @property
    def scheduled(self) -> tuple[str, ...]:
        """Links on which a decision determines when to send; all links if the policy has no such decision."""
        sends = [step for step in self.steps if isinstance(step, Send)]
        return tuple(step.link for step in sends if step.on is not None) or tuple(step.link for step in sends)

    def holds(self, link: str) -> bool:
        """Return whether the receiver of a link uses the last received value as long as no new packet arrives."""
        received = [step for step in self.steps if isinstance(step, Assign) and hears(step.on, link)]
        kept = [step.branches[0].get(step.signal) for step in received if len(step.branches[0]) == 1]
        return any(own is not None and _is_identity(own) for own in kept)

    @property
    def decisions(self) -> Mapping[str, Trigger]:
        """The trigger of each decision, by the decision's name."""
        return {step.decision: step.trigger for step in self.steps if isinstance(step, Decide)}

    @property
    def cycle(self) -> int:
        """Number of steps after which all discrete states that do not depend on data, such as step counters, repeat."""
        return joint_cycle(self.locations, self.decisions)

    @cached_property
    def in_units(self) -> Policy:
        """The policy in the units of the plant, in which nodes run it, instead of in deviations.

        The steps of a policy compute deviations from the operating point of its model. Here measurements, inputs,
        estimates and their copies, also in packets, include the point.
        """
        return in_units(self)

    def outcomes(self, condition: Condition) -> int:
        """Return how many outcomes a condition can have."""
        if not isinstance(condition, str):
            return condition.outcomes if isinstance(condition, Received) else 2
        if condition not in self.decisions:
            raise ProblemError(
                f"the condition {condition!r} is not a decision; expected one of the decisions {list(self.decisions)}"
            )
        return len(self.decisions[condition].labels)

    def site(self, node: str) -> frozenset[str]:
        """Return all nodes at the site of the given node."""
        return site_of(node, self.sites)

    def diagram(self) -> Diagram:
        """Return a diagram of the policy's nodes and links, to print or to plot.

        Example:
            >>> from taciturn import load
            >>> [link.packet for link in load("rover").design().diagram().links]
            ['input u', 'measurement y']
        """
        DRAWN.check(self.parts, self.designed_for)
        return diagram_of(self)

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Draw the nodes of the policy and the packets that they exchange within a step."""
        return self.diagram().plot(ax, figsize, style)

    def _size(self, name: str) -> int:
        if name not in self.sizes:
            raise ProblemError(
                f"the signal {name!r} is never assigned; expected one of the signals {sorted(self.sizes)}"
            )
        return self.sizes[name]

    def _check(self, step: Step) -> None:
        if isinstance(step, Assign | Evaluate) and step.on is not None:
            found = len(step.branches if isinstance(step, Assign) else step.forms)
            if found != self.outcomes(step.on):
                raise ProblemError(
                    f"the step that computes {step.signal} has {found} branches; expected {self.outcomes(step.on)} "
                    f"branches, one for each outcome of {step.on}"
                )
        if isinstance(step, Assign):
            for terms in step.branches:
                for name, value in terms.items():
                    self._check_schedule(value)
                    rows, columns = shape_of(value)
                    if columns != self._size(name):
                        hint = ". Did you pass its transpose?" if rows == self._size(name) else ""
                        raise ProblemError(
                            f"the weight of {name} in {step.signal} has shape {(rows, columns)}; expected "
                            f"{number_of(self._size(name), 'column')}, one for each entry of {name}{hint}"
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
            raise ProblemError(
                f"the matrix Psi for the signals {form.signals} has shape {shape_of(form.Psi)}; expected the shape "
                f"{(size, size)}"
            )
        if form.bell is not None and len(form.bell.Pi) != size:
            raise ProblemError(
                f"the matrix Pi for the signals {form.signals} has shape {form.bell.Pi.shape}; expected the shape "
                f"{(size, size)}"
            )
        for name in form.plus:
            if self._size(name) != 1:
                raise ProblemError(f"the signal {name} has {self._size(name)} entries; expected a scalar signal")

    def _check_schedule(self, value: object) -> None:
        if not isinstance(value, Scheduled):
            return
        sizes = {location.name: len(location.table) for location in self.locations}
        if sizes.get(value.by) != len(value.values):
            got = (
                f"it has {number_of(sizes[value.by], 'state')}"
                if value.by in sizes
                else f"the policy has only {list(sizes)}"
            )
            raise ProblemError(
                f"a table has {number_of(len(value.values), 'entry')} selected by the location {value.by!r}, but "
                f"{got}; expected one entry per state of the location"
            )


def _is_identity(matrix: Matrix) -> bool:
    return isinstance(matrix, np.ndarray) and np.array_equal(matrix, np.eye(len(matrix)))


def own_problem(policy: Policy) -> tuple[Plant, Cost, Network]:
    """Return the plant, the cost and the network of a policy's design."""
    if policy.cost is None:
        raise ProblemError(
            f"the policy {policy.kind} contains no cost; expected a policy with the cost for which it was designed: "
            "theory=Theory(cost=…)"
        )
    if policy.tick != 1.0 or policy.theory.noise_cost or policy.prediction is not None:
        raise ProblemError(
            f"the policy {policy.kind} has steps of {policy.tick:g} s, so its cost refers to a continuous plant, which "
            "a policy does not contain; expected a Problem with this plant and a policy kind"
        )
    return policy.model.alone or policy.model, policy.cost, policy.network


def in_units(policy: Policy) -> Policy:
    """Convert a policy in deviations to the units of the plant. Without an operating point, the two are equal."""
    point = policy.model.operating_point
    if point is None:
        return policy
    moves, theory = _moves(policy, point), policy.theory
    sums = {name: _moved_terms(terms, moves.get(name), moves) for name, terms in theory.sums.items()}
    assigns = {name for step in policy.steps for name in assigned(step)}
    told = theory.innovations
    if told is not None:
        y = policy.model.C @ point.x
        told = replace(told, predicted=_moved_terms(told.predicted, y, moves)) if told.signal is None else None
    initial = {name: moves[name] + policy.initial.get(name, 0.0) for name in moves if name in assigns}
    functions = theory.functions | {_deviation(name) for name in theory.functions}
    return replace(
        policy,
        steps=tuple(found for step in policy.steps for found in _moved(step, moves)),
        model=about(policy.model, None),
        theory=Theory(
            cost=theory.cost,
            cost_all_time=theory.cost_all_time,
            cost_all_time_error=theory.cost_all_time_error,
            settling=theory.settling,
            recovery=theory.recovery,
            sums=sums,
            silence=theory.silence,
            innovations=told,
            functions=functions,
        ),
        initial={**policy.initial, **initial},
    )


def at_rest(policy: Policy) -> dict[str, Array]:
    """Return the values of the signals at the operating point, by which plant units exceed deviations."""
    return {} if policy.model.operating_point is None else _moves(policy, policy.model.operating_point)


def _moves(policy: Policy, point: OperatingPoint) -> dict[str, Array]:
    """Return the offset of each signal: the operating point for measurements, inputs, estimate, and their copies."""
    y, sizes = policy.model.C @ point.x, policy.sizes
    found = {name: point.u[[*inputs]] for name, (_, inputs) in policy.applied.items()}
    held = {f"{HELD}_{node}": point.u[[*inputs]] for node, inputs in policy.applied.values()} | {HELD: point.u}
    found |= {name: value for name, value in held.items() if sizes.get(name) == len(value)}
    found |= {name: y[[*outputs]] for name, (_, outputs) in policy.measured.items()}
    if sizes.get(ESTIMATE, len(point.x)) == len(point.x):  # it may be a sum of signals of several nodes
        found[ESTIMATE] = point.x
    copies = list[tuple[str, str]]()
    for step in (step for step in policy.steps if isinstance(step, Assign)):
        alone = [next(iter(terms.items())) for terms in step.branches if len(terms) == 1]
        copies += [(step.signal, name) for name, matrix in alone if name != ONE and _is_identity(matrix)]
    waiting = [*found]
    while waiting:
        name = waiting.pop(0)
        for one, other in (*copies, *((other, one) for one, other in copies)):
            if one == name and other not in found:
                found[other] = found[name]
                waiting.append(other)
    targets = policy.targets.values()  # deviations
    return {name: value for name, value in found.items() if value.any() and name not in targets}


def _moved(step: Step, moves: Mapping[str, Array]) -> tuple[Step, ...]:
    """Return the steps of a policy step in the units of the plant instead of deviations."""
    if isinstance(step, Assign):
        return _moved_sum(step, moves)
    known = [name for name in dict.fromkeys(read(step)) if name in moves]
    before = _deviations(step, known, moves)
    if isinstance(step, Evaluate):
        return *before, replace(step, forms=tuple(_renamed(form, moves) for form in step.forms))
    if isinstance(step, Decide):
        options = {label: _renamed(form, moves) for label, form in step.trigger.options.items()}
        return *before, replace(step, trigger=replace(step.trigger, options=options))
    if not isinstance(step, Apply):
        return (step,)
    results = [name for name in step.signals if name in moves]
    signals = {_deviation(name) if name in moves else name: size for name, size in step.signals.items()}
    reads = tuple(_deviation(name) if name in moves else name for name in step.reads)
    after = (
        Assign(step.at, name, {_deviation(name): np.eye(len(moves[name])), ONE: moves[name][:, None]})
        for name in results
    )
    return *before, replace(step, signals=signals, reads=reads), *after


def _moved_sum(step: Assign, moves: Mapping[str, Array]) -> tuple[Step, ...]:
    """Return a sum with the constant by which its signals are moved; a table reads the deviation of a moved signal."""
    tables = [
        name
        for name in dict.fromkeys(read(step))
        if name in moves and any(isinstance(terms.get(name), Scheduled) for terms in step.branches)
    ]
    branches = list[Terms]()
    for terms in step.branches:
        renamed = {_deviation(name) if name in tables else name: matrix for name, matrix in terms.items()}
        branches.append(_moved_terms(renamed, moves.get(step.signal), moves))
    before = _deviations(step, tables, moves)
    return *before, Assign(step.at, step.signal, tuple(branches) if step.on else branches[0], step.on)


def _moved_terms(terms: Terms, move: Array | None, moves: Mapping[str, Array]) -> Terms:
    """Return the terms of a sum with the constant by which it and its signals are moved."""
    constant = np.zeros(shape_of(next(iter(terms.values())))[0]) if move is None else move
    for name, matrix in terms.items():
        if name in moves and not isinstance(matrix, Scheduled):
            constant = constant - matrix @ moves[name]
    if not constant.any():
        return terms
    stated = terms.get(ONE)
    if isinstance(stated, Scheduled):
        return {**terms, ONE: Scheduled(stated.by, stated.values + constant[:, None])}
    return {**terms, ONE: constant[:, None] if stated is None else stated + constant[:, None]}


def _deviations(step: Step, names: list[str], moves: Mapping[str, Array]) -> tuple[Step, ...]:
    """Return the steps that compute the deviations of signals that a policy step reads, also from a packet."""
    found = list[Step]()
    for name in names:
        deviation: Terms = {name: np.eye(len(moves[name])), ONE: -moves[name][:, None]}
        if not isinstance(step, Assign | Evaluate) or not isinstance(step.on, Received):
            found.append(Assign(step.at, _deviation(name), deviation))
            continue
        listed = step.branches if isinstance(step, Assign) else [form.reads for form in step.forms]
        none: Terms = {ONE: np.zeros((len(moves[name]), 1))}
        found.append(
            Assign(step.at, _deviation(name), tuple(deviation if name in one else none for one in listed), step.on)
        )
    return tuple(found)


def _renamed(form: Form, moves: Mapping[str, Array]) -> Form:
    """Return a form of the deviations of moved signals."""
    signals = tuple(_deviation(name) if name in moves else name for name in form.signals)
    plus = {_deviation(name) if name in moves else name: weight for name, weight in form.plus.items()}
    return Form(signals, form.Psi, form.constant, plus, form.bell)


def _deviation(name: str) -> str:
    return f"{name} from the operating point"


def with_intervals(policy: Policy, network: Network) -> Policy:
    """Change a policy, so that its decisions respect a network's limits on the number of steps between sends."""
    designed = policy.network
    instance("network", network, Network)
    if network.nodes != designed.nodes or network.with_intervals(designed) is network:
        return policy
    return replace(policy, network=designed.with_intervals(network))


def steps_since(link: str) -> str:
    """Return the name of the signal that counts the steps since a link last sent."""
    return f"steps since a packet on {link}"


def longest_silence(network: Network, link: str) -> int | None:
    """Return the largest number of steps between arrivals; None if it is unlimited, or packets are dropped."""
    law = network.links[link]
    return None if network.loss(link) else law.max_interval


def keep_intervals(policy: Policy) -> Mapping[str, Any]:
    """Return the changed fields of a policy whose decisions respect a network's limits on send intervals."""
    steps, network = policy.steps, policy.network
    sends = {step.link: step for step in steps if isinstance(step, Send)}
    kept = {step.signal for step in steps if isinstance(step, Assign)}
    limited = {link: network.links[link] for link in sends if network.links[link].intervals != IDEAL_LINK.intervals}
    present = [link for link in sends if steps_since(link) in kept]
    if not limited and not present:
        return {}
    deciding = {link: law for link, law in limited.items() if not _fixed(policy, sends[link], law)}
    if present:
        _expect_same(policy, present, deciding)
        return {}
    found = [one for step in steps for one in _kept(step, {link: sends[link] for link in deciding}, deciding)]
    theory, withdrawn = _theory(policy, deciding)
    starts = {steps_since(link): np.array([float(law.min_interval)]) for link, law in deciding.items()}
    return {
        "steps": tuple(found),
        "initial": {**policy.initial, **starts},
        "theory": theory,
        "notes": (*policy.notes, *withdrawn),
    }


def _kept(step: Step, sends: Mapping[str, Send], laws: Mapping[str, LinkLaw]) -> list[Step]:
    """Return a step; for a decision on limited links, the decision with the labels that it excludes, and the counts."""
    on = {link: send for link, send in sends.items() if isinstance(step, Decide) and send.on == step.decision}
    if not on or not isinstance(step, Decide):
        return [step]
    labels = step.trigger.labels
    sending = {link: send.sending(labels) for link, send in on.items()}
    _expect_sets(step, sending)
    excluded = {
        label: tuple(form for link in on for form in _forms(link, laws[link], label in sending[link]))
        for label in labels
    }
    excluded = {label: (*step.trigger.excluded.get(label, ()), *forms) for label, forms in excluded.items()}
    trigger = replace(step.trigger, excluded={label: forms for label, forms in excluded.items() if forms})
    return [replace(step, trigger=trigger), *(_count(step, link, sending[link]) for link in on)]


def _forms(link: str, law: LinkLaw, sends: bool) -> list[Form]:
    """Return the forms that are positive while a label that sends, or one that does not, breaks the limits."""
    count = steps_since(link)
    if sends:
        return [Form(constant=law.min_interval - HALF, plus={count: -1.0})] if law.min_interval > 1 else []
    return [] if law.max_interval is None else [Form(constant=HALF - law.max_interval, plus={count: 1.0})]


def _count(step: Decide, link: str, sending: Sequence[str]) -> Assign:
    """Return the step that counts the steps since the last send, for the next step."""
    count, one = steps_since(link), np.ones((1, 1))
    return Assign(
        step.at,
        count,
        tuple({ONE: one} if label in sending else {count: one, ONE: one} for label in step.trigger.labels),
        step.decision,
    )


def _expect_sets(step: Decide, sending: Mapping[str, Sequence[str]]) -> None:
    """Raise an error if a decision on several links has no label for a set of links that the limits may demand."""
    labels = {tuple(label in labels for labels in sending.values()) for label in step.trigger.labels}
    missing = [sets for sets in product((False, True), repeat=len(sending)) if sets not in labels]
    if missing:
        named = " and ".join(link for link, sends in zip(sending, missing[0], strict=True) if sends) or "no link"
        raise ProblemError(
            f"the decision {step.decision!r} has no label that sends only on {named}, but min_interval or "
            "max_interval may require this; expected a label for each set of links, or neither min_interval nor "
            "max_interval"
        )


def _fixed(policy: Policy, send: Send, law: LinkLaw) -> bool:
    """Return whether packets of a link are sent at fixed steps, after a check that these keep the limits."""
    triggers = policy.decisions
    horizon = None if policy.theory.cost is None else policy.theory.cost.horizon
    chosen = ["always"] * (horizon or 2) if send.on is None else fixed_choices(send.on, policy.locations, triggers)
    if chosen is None:
        return False
    sending = chosen if send.on is None else send.sending(triggers[send.on].labels)
    ticks = [k for k, label in enumerate(chosen[:horizon]) if label in sending]
    gaps = [after - before for before, after in pairwise(ticks)]
    rest = [] if ticks and horizon is None else [(horizon or LONGEST + 1) - (ticks[-1] if ticks else 0)]
    found = {
        "min_interval": min(gaps, default=law.min_interval),
        "max_interval": max([*gaps, *rest, ticks[0] + 1 if ticks else 0]),
    }
    for name, gap in found.items():
        limit = law.intervals[name]
        if limit is not None and (gap < limit if name == "min_interval" else gap > limit):
            every = f"with an interval of {number_of(gap, 'step')}" if ticks else "or never"
            raise ProblemError(
                f"{policy.network.key(send.link, name)} is {limit}, but the policy {policy.kind} sends at fixed steps "
                f"on the {send.link} link, {every}; expected a limit that these steps satisfy, or other parameters of "
                "the policy"
            )
    return True


def _expect_same(policy: Policy, present: Sequence[str], laws: Mapping[str, LinkLaw]) -> None:
    """Raise an error if the decisions of a policy keep other limits than those of its network."""
    wanted = {link: [_numbers(form) for sends in (True, False) for form in _forms(link, law, sends)]
              for link, law in laws.items()}  # fmt: skip
    for link in dict.fromkeys((*present, *laws)):
        count = steps_since(link)
        forms = chain.from_iterable(trigger.excluded.values() for trigger in policy.decisions.values())
        found = {_numbers(form) for form in chain.from_iterable(forms) if count in form.plus}
        if found != set(wanted.get(link, ())):
            raise ProblemError(
                f"this {policy.kind} policy was designed for other limits of the intervals between sends on the "
                f"{link} link than those of the network, {policy.network.links[link].intervals}; expected the limits "
                "of the design: design the policy again"
            )


def _numbers(form: Form) -> tuple[object, ...]:
    return (form.constant, *form.plus.items())


def _theory(policy: Policy, laws: Mapping[str, LinkLaw]) -> tuple[Theory, tuple[str, ...]]:
    """Return the theory that holds with limits, and notes on the claims that do not."""
    theory = policy.theory
    covers = theory.covers | INTERVALS
    if not laws:
        return replace(theory, covers=covers), ()
    withheld = [policy.network.key(link, "min_interval") for link, law in laws.items() if law.min_interval > 1]
    forced = [policy.network.key(link, "max_interval") for link, law in laws.items() if law.max_interval is not None]
    guarantee, notes = theory.guarantee, tuple[str, ...]()
    if guarantee is not None and (withheld or not guarantee.more_sends):
        effect = f"{withheld[0]} withholds" if withheld else f"{forced[0]} forces"
        notes = (f"{effect} packets against the decision of {policy.kind}, so no guarantee is claimed",)
        guarantee = None
    slower = max(law.min_interval for law in laws.values())
    changed = replace(
        theory,
        guarantee=guarantee,
        errors={} if withheld else theory.errors,
        closed_form=None,
        fixed_rates={link: rate for link, rate in theory.fixed_rates.items() if link not in laws},
        settling=slower * theory.settling,
        recovery=None if theory.recovery is None else slower * theory.recovery,
        covers=covers,
    )
    return changed, notes
