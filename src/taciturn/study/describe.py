"""Description of a problem and its policy without a simulation: plant, gains, guarantee, triggers and network.

``describe`` designs the policy and closes the loop, but runs nothing. Its result lists, as ``Description.FIELDS``, what
``taciturn show`` prints and, with --json, writes:

* the plant with its poles, and the modes that no input moves or no measurement shows,
* the cost, and J_all, the cost of sending every sample,
* feedback gain L, estimator gain, or the given controller in the steps of the policy,
* the guarantee, in general and at a rate r of sends per step: base + per_silence (1 − r), or base + (Σ√(δ(1 − r)))²
  with δ of each group of links that are decided together. It is stated, but not claimed, if the loop violates
  assumptions of its design,
* network, nodes, and links: the contents of a packet and the rule by which it is sent (``model/rule``), with the
  meaning of its symbols and its matrices; decisions of nodes that send no packet,
* the steps for which a fault of a node has an effect.

The document also has the forms of all options of the decisions, as the nodes compare them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, ClassVar, cast

import numpy as np

from taciturn._modes import eigenvalues
from taciturn._rational import Limit, unmoved
from taciturn._text import Lines, number_of, per_unit
from taciturn.base.given_controller import followed_by
from taciturn.design.kind import AnyPolicy
from taciturn.model.controller import Controller, pids_of
from taciturn.model.diagram import Diagram
from taciturn.model.estimate import Estimate, rounded
from taciturn.model.link import LinkLaw
from taciturn.model.load import Load
from taciturn.model.losses import LossLaw
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant, matrix_lines, vector_text
from taciturn.model.policy import Policy
from taciturn.model.result import VERDICT, Field, Result
from taciturn.model.rule import Rule, choice_of
from taciturn.model.saturation import Saturation, limit_entries
from taciturn.model.signals import Changes, Exosystem
from taciturn.model.steps import Assign, Decide, Evaluate
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger
from taciturn.model.words import Words
from taciturn.problem import Problem
from taciturn.problem.without_file import Studied, as_problem
from taciturn.program.node import steps_of_a_fault
from taciturn.renewal.without_steps import PolicyWithoutSteps, nodes_of
from taciturn.study.evaluation import Unit, cost_unit, time_unit
from taciturn.study.sentences import THAN, percent_above, proof_text

ESTIMATES = ("estimate", "deviation")  # signals that a feedback gain multiplies: the state estimate, or its deviation
GAINS = {
    "L": ("feedback gain", "input = + L × estimate; L:"),
    "estimator": ("estimator gain", "estimate = prediction + gain × (measurement − its prediction); gain:"),
}


def _gains(policy: Policy) -> dict[str, Matrix]:
    found: dict[str, Matrix] = {}
    if policy.prediction is not None:
        found["L"] = policy.prediction.L
    for step in policy.steps:
        if isinstance(step, Assign):
            for terms in step.branches:
                for name, value in terms.items():
                    if step.signal == "command" and name in ESTIMATES:
                        found.setdefault("L", value)
                    elif name == "innovation":
                        found.setdefault("estimator", value)
    return dict(sorted(found.items()))


def _plant_document(plant: Plant | ContinuousPlant) -> dict[str, Any]:
    (unmoved, unseen), e = _lost(plant), plant.exosystem
    keys, point = ["A", "B", "C", *([] if plant.D is None else ["D"]), "W", "V", "covariance"], plant.operating_point
    limit, rate = plant.stated_limit, plant.input_rate
    return {
        "states": plant.states,
        "inputs": plant.inputs,
        "outputs": plant.C.shape[0],
        "dt": plant.dt if isinstance(plant, Plant) else None,
        "continuous": isinstance(plant, ContinuousPlant),
        "linear": not (isinstance(plant, Plant) and plant.function is not None),
        "poles": [[float(pole.real), float(pole.imag)] for pole in eigenvalues(plant.A)],
        "controllable": not len(unmoved),
        "observable": not len(unseen),
        **{key: _plain(getattr(plant, key)) for key in keys},
        "mean": _plain(plant.stated_mean),
        **({} if point is None else {"operating_point": {"x": _plain(point.x), "u": _plain(point.u)}}),
        "input_limit": None if limit is None else _plain(limit_entries(limit)),
        **({} if rate is None else {"input_rate": _plain(rate)}),
        **({"loads": [_load_document(one) for one in plant.loads]} if plant.loads else {}),
        **({} if plant.names is None else {"names": plant.names.document()}),
        **({} if e is None else {"exosystem": {name: _plain(value) for name, value in _parts(e).items()}}),
    }


def _load_document(load: Load) -> dict[str, Any]:
    """Return a load as a JSON document."""
    known = load.given or (None if load.signal is None else "estimated")
    steps = np.column_stack([load.times, load.values])
    return {"steps": _plain(steps), "enters": _plain(load.E), "measured": _plain(load.G), "known": known or False}


def _load_line(load: Load, continuous: bool) -> str:
    """Return the values of a load as text."""
    unit = "s" if continuous else "steps"
    parts = [f"{load.values[0]:g}"] + [
        f"{value:g} from {time:g} {unit}" for time, value in zip(load.times[1:], load.values[1:], strict=True)
    ]
    aware = "the controller reads it" if load.given else "the design estimates it"
    return f"{', '.join(parts)}; {aware if load.signal is not None else 'the design does not know it'}"


def _parts(e: Exosystem) -> dict[str, object]:
    """Return the fields of an exosystem by name, D_z only if it has one."""
    found = {field.name: getattr(e, field.name) for field in fields(e)}
    return {name: value for name, value in found.items() if name != "D" or value is not None}


def _limit_lines(limits: Saturation | None, continuous: bool) -> Lines:
    """Return the range and the ramp of set-points, as deviations from the operating point."""
    if limits is None:
        return []
    sides = matrix_lines("range of set-points", np.stack([limits.low, limits.high], axis=1))
    per = "second" if continuous else "step"
    return sides + ([] if limits.rate is None else [(f"ramp, per {per}", vector_text(limits.rate))])


def _lost(plant: Plant | ContinuousPlant) -> tuple[list[complex], list[complex]]:
    """Return the uncontrollable modes and the unobservable modes."""
    limit = Limit(plant.continuous)
    parts = (unmoved(A, B, limit) for A, B in ((plant.A, plant.B), (plant.A.T, plant.C.T)))
    hidden, unseen = ([complex(mode) for part in lost for mode in part] for lost in parts)
    return hidden, unseen


def _plant_lines(plant: Plant | ContinuousPlant) -> Lines:
    rows = plant.summary()
    lines: Lines = [("plant", f"{rows['size']}; {rows['time']}"), ("poles", str(rows["poles"]))]
    lines += [] if plant.names is None else list(plant.names.lines())
    for name, lost, verb in zip(("controllable", "observable"), _lost(plant), ("moves", "shows"), strict=True):
        what = "input" if verb == "moves" else "measurement"
        modes = ", ".join(map(Limit(plant.continuous).named, lost))
        lines.append((name, f"except for the mode {modes}, which no {what} {verb}" if lost else "yes"))
    lines += [(name, text) for name in ("measured", "noise") if isinstance(text := rows[name], str)]
    point = plant.operating_point
    lines += [] if point is None else [("operating point", point.short())]
    D = rows["D"]
    lines += matrix_lines("feedthrough D", D) if isinstance(D, np.ndarray) else []
    for name in ("W", "V"):
        value = rows[name]
        lines += matrix_lines(f"noise {name}", value) if isinstance(value, np.ndarray) else []
    lines += [(name, text) for name in ("input limit", "input rate") if isinstance(text := rows[name], str)]
    lines += [("load", _load_line(one, plant.continuous)) for one in plant.loads]
    if (e := plant.exosystem) is not None:
        moves = "dd/dt = S d + noise" if plant.continuous else "d⁺ = S d + noise"
        q = f"{number_of(len(e.S), 'state')} d"
        z = "C_z x" if e.D is None else "C_z x + D_z u"
        goal = f"and set-points, {q}: {moves}; {z} + F d is to be zero" if len(e.S) else f"none; {z} is to be zero"
        lines.append(("disturbances", goal))
        shown = {"S": e.S, "E": e.E, "G": e.G, "W": e.W, "C_z": e.outputs, "F": e.F + 0.0, "start": e.start[None]}
        shown |= {} if e.D is None else {"D_z": e.D}
        lines += [line for name, value in shown.items() if value.size for line in matrix_lines(f"d, {name}", value)]
        lines += [] if e.changes is None else _limit_lines(e.changes.limits, plant.continuous)
    return lines


def _pids(kept: object) -> list[dict[str, Any]]:
    """Return the values of PID controllers that differ from the defaults; a note states the disturbance."""
    return [
        {
            one.name: value
            for one in fields(loop)
            if one.name != "disturbance" and (value := getattr(loop, one.name)) != one.default
        }
        for loop in pids_of(kept)
    ]


def _controller_lines(found: Description) -> Lines:
    controller = found.controller
    if controller is None:
        return []
    parts = [name for name in "ABCDE" if getattr(controller, name).size and (name != "E" or controller.E.any())]
    state = f"z⁺ = A z + B y{' + E u' if 'E' in parts else ''}, " if len(controller.A) else ""
    lines: Lines = [("controller", f"{state}u = {'C z + ' if len(controller.A) else ''}D y in each step")]
    for name in parts:
        lines += matrix_lines(f"  {name}", getattr(controller, name))
    pids = _pids(found.problem.controller)
    stated = [", ".join(f"{name} = {value:g}" for name, value in pid.items()) for pid in pids]
    lines += [("  PID", text) for text in stated]
    if not stated and controller.setpoint.any():
        lines.append(("  set-point", vector_text(controller.setpoint)))
    return lines


def _plain(value: object) -> Any:
    """Return a value in a form that JSON supports: a table as its index and entries, infinity as "inf" or "-inf"."""
    if isinstance(value, Scheduled):
        return {"by": value.by, "values": value.values.tolist()}
    if isinstance(value, Trigger):
        value = value.options
    if isinstance(value, Form):
        bell = None if value.bell is None else {"height": value.bell.height, "Pi": value.bell.Pi.tolist()}
        parts = {"Psi": _plain(value.Psi), "constant": _plain(value.constant), "plus": dict(value.plus)}
        return {"signals": list(value.signals), **parts, "bell": bell}
    if isinstance(value, Changes | Saturation):
        held = {field.name: getattr(value, field.name) for field in fields(value)}
        return {name: _plain(one) for name, one in held.items() if one is not None}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list):
        return [_plain(one) for one in cast("list[object]", value)]
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in cast("Mapping[str, object]", value).items()}
    return f"{value}" if value in (np.inf, -np.inf) else value


def _policy(found: Description) -> str:
    given = ", ".join(f"{name} = {_plain(value)}" for name, value in found.problem.parameters.items())
    return found.problem.kind + (f" ({given})" if given else "")


def _actual_lines(found: Description) -> Lines:
    actual = found.problem.actual
    return [] if actual is None else [(f"actual {name}".strip(), text) for name, text in _plant_lines(actual)]


def _cost(found: Description) -> dict[str, Any]:
    cost = found.problem.cost
    return {key: _plain(getattr(cost, key)) for key in ("Q", "R", "N", "horizon", "terminal", "discount")}


def _cost_lines(found: Description) -> Lines:
    cost = found.problem.cost
    lines: Lines = [("cost", f"{cost.short()} per {time_unit(found.problem)}")]
    for name, value in cost.summary().items():
        if isinstance(value, np.ndarray):
            lines += matrix_lines("cost, terminal" if name == "terminal" else f"cost {name}", value)
    return lines


def _limits(found: Description) -> str:
    return "" if found.problem.limits is None else found.problem.limits.short()


def _every_sample(found: Description) -> str:
    whose = "; it is that of the loop of the design, and for this loop it is not known"
    own = "" if not found.violated_assumptions else whose
    known = _cost_all_time(found)
    if known is None:
        return "J_all is not known in advance: `taciturn evaluate` simulates it"
    return f"J_all = {known:.6g} {per_unit(found.unit)}{own}"


def _cost_all_time(found: Description) -> float | None:
    policy = found.policy
    return policy.theory.cost_all_time if isinstance(policy, Policy) else policy.cost_all_time


def _gain_lines(found: Description) -> Lines:
    return [line for name, gain in found.gains.items() for line in (GAINS[name], *matrix_lines("", gain))]


def _prediction(found: Description) -> str:
    predicts = found.nodes is not None and found.nodes.prediction is not None
    return "integrates dx̂/dt = (A + BL) x̂ between steps and applies L x̂; it receives x̂" if predicts else ""


def _guarantee_lines(of: Description) -> Lines:
    found = of.guarantee
    if found is None:
        return [("guarantee", "none")]
    if not found["holds"]:
        return [("guarantee", f"none for this loop; for the loop of the design: {found['statement']}")]
    lines = [("guarantee", f"{found['statement']}: at most {rounded(found['cost'], 6, 1)} ({found['source']})")]
    if isinstance(of.policy, Policy):
        lines.append(("proof", proof_text(found["proved"], of.policy.theory.cost_all_time_error is not None)))
    rated = found.get("at_rate")
    if rated is not None and "deciders" in rated:
        deltas = [f"{one['delta']:.4g} ({' and '.join(one['links'])})" for one in rated["deciders"]]
        lines.append(
            ("at the rates r", f"at most {rounded(rated['base'], 6, 1)} + (Σ√(δ(1 − r)))², δ = {', '.join(deltas)}")
        )
    elif rated is not None:
        base, slope = (rounded(rated[name], 6, 1) for name in ("base", "per_silence"))
        lines.append(("at a rate", f"at most {base} + {slope} (1 − sends per step)"))
    return lines


def _decision_lines(found: Description) -> Lines:
    """Return when nodes take decisions that send no packet and that no rule of a link contains."""
    policy = found.policy
    if not isinstance(policy, Policy):
        return []
    links, words = policy.diagram().links, Words(policy)
    told = {link.decision for link in links}.union(*(link.rule.follows for link in links))
    lines: Lines = []
    for step in policy.steps:
        if isinstance(step, Decide) and step.decision not in told:
            rule = choice_of(policy, step)
            lines += [(f"decision, {words.plain(step.decision)}", rule.when), *_rule_lines(rule)]
    return lines


def _rule_lines(rule: Rule) -> Lines:
    """Return the meaning of the symbols of a rule, and its matrices."""
    matrices = [line for letter, value in rule.matrices.items() for line in matrix_lines(f"    {letter}", value)]
    return [*(("", told) for told in rule.explained), *matrices]


def _link_document(law: LinkLaw) -> dict[str, Any]:
    """Return a link as a JSON document, without the packets of a trace."""
    delay, buffer = law.delay, law.buffer
    stated = None if delay is None else {"waits": delay.waits, "odds": delay.odds, "in_seconds": delay.in_seconds}
    plain = asdict(replace(law, delay=None, buffer=None))
    return {**plain, "delay": stated, "buffer": None if buffer is None else buffer._asdict()}


def _delay_document(law: LinkLaw) -> dict[str, Any]:
    """Return the law of delay of a link and its buffer in words, and as numbers in steps or seconds."""
    delay, buffer = law.delay, law.buffer
    seconds = delay.in_seconds if delay is not None else buffer is not None and buffer.seconds > 0
    waits = {"largest": None if delay is None else delay.most, "buffer": buffer}
    return {
        "text": "; ".join(law.lateness()),
        "unit": "seconds" if seconds else "steps",
        "mean": None if delay is None else delay.mean_by(law.states),
        **{key: one and (one.seconds if seconds else one.steps) for key, one in waits.items()},
        "lost": law.late,
    }


def _network_document(network: Network) -> dict[str, Any]:
    return {
        "protocol": network.protocol,
        "delay": network.delay,
        "payload": network.payload,
        "losses": {link: network.loss(link) for link in network.links},
        "delays": {link: _delay_document(law) for link, law in network.links.items() if law.lateness()},
        "nodes": {name: vars(role) for name, role in network.nodes.items()},
        "links": {link: _link_document(law) for link, law in network.links.items()},
        "missing": {
            node: asdict(cast("Any", law)) if isinstance(law, LossLaw) else law for node, law in network.missing.items()
        },
    }


def _network_lines(found: Description) -> Lines:
    problem, nodes, drawn = found.problem, found.nodes, found.diagram
    lines: Lines = [("network", problem.network.short())]
    if nodes is not None and problem.network.own_nodes:
        sizes = nodes.model.outputs, nodes.model.inputs
        lines += [(f"node, {name}", role.text(*sizes)) for name, role in problem.network.nodes.items()]
    if isinstance(found.policy, PolicyWithoutSteps) and drawn is None:
        lines.append(("sends", found.policy.sends_when))
    told = set[str]()
    for link in () if drawn is None else drawn.links:
        known = "; acknowledged" if link.acknowledged else ""
        law = problem.network.links[link.name].spending()
        lines.append((f"link, {link.name}", f"{'; '.join((link.packet, *link.notes))}{known}{law}"))
        if link.decision is None or link.decision not in told:  # links that are decided together have one rule
            lines += _rule_lines(link.rule)
        told |= set() if link.decision is None else {link.decision}
    return lines


def _fault(found: Description) -> str:
    """Return how long a fault has an effect, if it is not until the end of a run."""
    policy = found.policy
    if not isinstance(policy, Policy) or policy.theory.settling == 0:
        return ""
    steps, period = steps_of_a_fault(policy), policy.model.dt
    lasting = number_of(steps, "step") + ("" if period is None else f" ({period * steps:.3g} s)")
    return f"a node is degraded for {lasting}, seven time constants"


def _controller_document(found: Description) -> dict[str, Any] | None:
    controller = found.controller
    if controller is None:
        return None
    matrices = {name: getattr(controller, name) for name in "ABCDE"}
    return {**matrices, "setpoint": controller.setpoint, "pid": _pids(found.problem.controller)}


def _verdict(found: Description) -> str:
    """Return the policy, the links on which it decides, and the proven increase over the cost of every sample."""
    policy, links = found.policy, () if found.nodes is None else found.nodes.scheduled
    where = f" on the link{'s' * (len(links) > 1)} {', '.join(links)}" if links else ""
    exact = policy.theory.closed_form if isinstance(policy, Policy) else None
    base, guarantee = _cost_all_time(found), found.guarantee
    if found.violated_assumptions:
        proven = f"no guarantee, since {'; '.join(found.violated_assumptions)}"
    elif exact is not None:
        proven = f"exact cost, {exact.cost:.6g} {per_unit(found.unit)}"
    elif guarantee is None or base is None:
        proven = "no guarantee"
    elif base > 0:
        above = percent_above(Estimate(guarantee["cost"], 0.0, "bound"), base, 1, signed=False)
        proven = f"at most {above} more cost{THAN}, proven"
    else:
        proven = f"at most {rounded(guarantee['cost'], 6, 1)} {per_unit(found.unit)}, proven"
    return f"{found.problem.kind}{where}: {proven}"


@dataclass(frozen=True, eq=False, repr=False)
class Description(Result):
    """A problem and its policy, described by all that is known without a simulation, such as gains and guarantee."""

    FIELDS: ClassVar[tuple[Field[Description], ...]] = (
        VERDICT,
        Field("policy", "problem.kind", say="policy", text=_policy),
        Field("parameters", "problem.parameters", json=_plain),
        Field("unit"),
        Field("plant", "problem.plant", json=_plant_document, say="", text=lambda of: _plant_lines(of.problem.plant)),
        Field("actual", "problem.actual", json=_plant_document, say="", text=_actual_lines),
        Field("cost", _cost, say="", text=_cost_lines),
        Field("limits", "problem.limits.names", optional=True, say="limits", text=_limits),
        Field("cost_all_time", _cost_all_time, say="every sample", text=_every_sample),
        Field("guarantee", say="", text=_guarantee_lines, after="prediction"),
        Field("gains", json=_plain, say="", text=_gain_lines),
        Field("controller", _controller_document, optional=True, say="", text=_controller_lines, after="cost_all_time"),
        Field("prediction", key="", say="actuator", text=_prediction),
        Field("decisions", json=_plain, say="", text=_decision_lines),
        Field("computed", json=_plain, optional=True),
        Field("network", "problem.network", json=_network_document, say="", text=_network_lines),
        Field("diagram"),
        Field("fault", key="", say="after a fault", text=_fault),
        Field("notes", say="note"),
    )

    problem: Problem  # the problem that the policy was designed for
    policy: AnyPolicy  # the designed policy
    nodes: Policy | None  # the policy that the nodes run
    violated_assumptions: tuple[str, ...]  # differences between the loop and its design
    remarks: tuple[str, ...] = ()  # what the cost counts, if it is not the integral of the stage cost

    @property
    def verdict(self) -> tuple[str, ...]:
        """The policy, its links, and the proven bound on its cost, in words."""
        return (_verdict(self),)

    @property
    def unit(self) -> Unit:
        """Unit of the cost as text, such as per step or per second."""
        return cost_unit(self.problem)

    @property
    def diagram(self) -> Diagram | None:
        """Diagram of the nodes and links; None if the policy sends at any time, not only at sampling instants."""
        if self.nodes is None or not isinstance(self.policy, PolicyWithoutSteps):
            return None if self.nodes is None else self.nodes.diagram()
        drawn, rule = self.nodes.diagram(), Rule(self.policy.sends_when)  # its nodes have another trigger
        return replace(drawn, links=tuple(replace(link, rule=rule) for link in drawn.links))

    @property
    def controller(self) -> Controller | None:
        """The user's controller, discretised for the steps of the policy; None if the design computes the gains."""
        if self.problem.controller is None or self.nodes is None:
            return None
        plant, stated = self.nodes.model, self.problem.controller
        controller = stated.at(plant.dt, plant.inputs, plant.sensed)
        return controller if plant.changes is None else followed_by(self.problem.plant, stated, controller)

    @property
    def gains(self) -> dict[str, Matrix]:
        """Feedback gain L and gain of the estimator, by name, if the policy has them."""
        return {} if self.nodes is None else _gains(self.nodes)

    @property
    def decisions(self) -> Mapping[str, Trigger]:
        """The decisions of the policy, by name, each with its trigger."""
        return self.policy.decisions if isinstance(self.policy, Policy) else {}

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings, remarks, and reasons why no guarantee holds, as texts."""
        return (
            self.policy.notes
            + self.remarks
            + tuple(f"{text}: no guarantee holds" for text in self.violated_assumptions)
        )

    @property
    def guarantee(self) -> dict[str, Any] | None:
        """Proven bound on the cost, and whether it holds for this loop; None if the policy has no bound."""
        policy, holds = self.policy, not self.violated_assumptions
        if isinstance(policy, PolicyWithoutSteps):
            bound = policy.bound()
            if policy.statement is None or bound is None:
                return None
            return {"statement": policy.statement, "cost": bound, "source": policy.source, "holds": holds}
        if policy.guarantee is None:
            return None
        found = policy.guarantee
        deciders = [{"links": list(group), "delta": delta} for group, delta in found.deciders.items()]
        more = {"deciders": deciders} if deciders else {}
        at_rate = None if found.base is None else {"base": found.base, "per_silence": found.per_silence, **more}
        proved = {"statement": found.statement, "cost": found.cost, "source": found.source, "holds": holds}
        return {**proved, "proved": found.proved, "at_rate": at_rate}

    @property
    def computed(self) -> dict[str, Form]:
        """Quadratic forms of all signals that decisions compare, by the signal's name."""
        return {name: form for trigger in self.decisions.values() for name, form in self.compared(trigger).items()}

    def compared(self, trigger: Trigger) -> dict[str, Form]:
        """Return the quadratic forms of all signals that a trigger compares, directly or through other signals."""
        steps = self.policy.steps if isinstance(self.policy, Policy) else ()
        forms = {step.signal: step.forms[0] for step in steps if isinstance(step, Evaluate)}
        waiting, found = [name for form in trigger.options.values() for name in form.plus], dict[str, Form]()
        while waiting:
            name = waiting.pop(0)
            if name in forms and name not in found:
                found[name] = forms[name]
                waiting += forms[name].plus
        return {name: form for name, form in found.items() if form.Psi is not None}


def describe(problem: Studied) -> Description:
    """Design the policy of a problem, and describe problem and policy without a simulation."""
    problem = as_problem("problem", problem)
    policy = problem.designed()
    nodes = nodes_of(policy)
    if nodes is None:
        return Description(problem, policy, None, ())
    loop = problem.close(nodes)
    return Description(problem, policy, nodes, loop.violated_assumptions, loop.problem.remarks)
