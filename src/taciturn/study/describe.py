"""Description of a problem and its policy without a simulation: plant, gains, guarantee, triggers, diagram."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, cast

import numpy as np

from taciturn._display import Displayed
from taciturn._modes import eigenvalues
from taciturn._rational import Limit, unmoved
from taciturn._text import Lines, per_unit
from taciturn.design.kind import AnyPolicy
from taciturn.model.controller import Controller, pids_of
from taciturn.model.diagram import Diagram
from taciturn.model.estimate import rounded
from taciturn.model.plant import ContinuousPlant, Plant, matrix_lines, vector_text
from taciturn.model.policy import Policy
from taciturn.model.saturation import limit_entries
from taciturn.model.signals import Changes, Exosystem
from taciturn.model.steps import Assign, Evaluate
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger
from taciturn.problem import Problem
from taciturn.problem.bare import Studied, as_problem
from taciturn.program.node import steps_of_a_fault
from taciturn.renewal.without_steps import PolicyWithoutSteps, nodes_of
from taciturn.study.evaluation import cost_unit, proof_text, time_unit

SHOWN_OPTIONS = 4  # options of a decision that are printed
ESTIMATES = ("estimate", "deviation")  # signals that a feedback gain multiplies: the state estimate, or its deviation
GAINS = {
    "L": ("feedback gain", "input = + L × estimate; L:"),
    "estimator": ("estimator gain", "estimate = prediction + gain × (measurement − its prediction); gain:"),
}


@dataclass(frozen=True, eq=False, repr=False)
class Description(Displayed):
    """Properties of a problem's policy that are known without a simulation."""

    problem: Problem  # the problem that the policy was designed for
    policy: AnyPolicy  # the designed policy
    nodes: Policy | None  # the policy that the nodes run
    violated_assumptions: tuple[str, ...]  # differences between the loop and its design
    remarks: tuple[str, ...] = ()  # what the cost counts, if it is not the integral of the stage cost

    @property
    def diagram(self) -> Diagram | None:
        """Diagram of the nodes and links, or None if the policy has no sampling steps."""
        return None if self.nodes is None else self.nodes.diagram()

    @property
    def controller(self) -> Controller | None:
        """The given controller in the steps of the policy, or None."""
        if self.problem.controller is None or self.nodes is None:
            return None
        plant = self.nodes.model
        return self.problem.controller.at(plant.dt, plant.inputs, plant.outputs)

    @property
    def gains(self) -> dict[str, Matrix]:
        """Feedback gain L and estimator gain, if the policy has them."""
        return {} if self.nodes is None else _gains(self.nodes)

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings and remarks."""
        return (
            self.policy.notes
            + self.remarks
            + tuple(f"{text}: no guarantee holds" for text in self.violated_assumptions)
        )

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn show --json``."""
        cost, network, drawn = self.problem.cost, self.problem.network, self.diagram
        computed = {
            name: _form_document(form)
            for trigger in self._decisions.values()
            for name, form in self._computed(trigger).items()
        }
        return {
            "policy": self.problem.kind,
            "parameters": {name: _plain(value) for name, value in self.problem.parameters.items()},
            "unit": cost_unit(self.problem),
            "plant": _plant_document(self.problem.plant),
            "actual": None if self.problem.actual is None else _plant_document(self.problem.actual),
            "cost": {key: _plain(getattr(cost, key)) for key in ("Q", "R", "N", "horizon", "terminal", "discount")},
            **({} if self.problem.limits is None else {"limits": list(self.problem.limits.names)}),
            "cost_all_time": self.policy.cost_all_time,
            "guarantee": self._guarantee(),
            "gains": {name: _plain(value) for name, value in self.gains.items()},
            **({} if self.controller is None else {"controller": self._controller_document(self.controller)}),
            "decisions": {
                name: {label: _form_document(form) for label, form in trigger.options.items()}
                for name, trigger in self._decisions.items()
            },
            **({"computed": computed} if computed else {}),
            "network": {
                "protocol": network.protocol,
                "delay": network.delay,
                "payload": network.payload,
                "losses": {link: network.loss(link) for link in network.links},
                "nodes": {name: vars(role) for name, role in network.nodes.items()},
                "links": {link: asdict(law) for link, law in network.links.items()},
            },
            "diagram": None if drawn is None else drawn.document(),
            "notes": list(self.notes),
        }

    def lines(self) -> Lines:
        """Return the printed lines as pairs of name and value."""
        problem, per = self.problem, cost_unit(self.problem)
        given = ", ".join(f"{name} = {_plain(value)}" for name, value in problem.parameters.items())
        lines: Lines = [("policy", problem.kind + (f" ({given})" if given else ""))]
        lines += _plant_lines(problem.plant)
        if problem.actual is not None:
            lines += [(f"actual {name}".strip(), text) for name, text in _plant_lines(problem.actual)]
        lines += _cost_lines(problem)
        lines += [] if problem.limits is None else [("limits", problem.limits.short())]
        whose = "; it is that of the loop of the design, and for this loop it is not known" * bool(
            self.violated_assumptions
        )
        lines.append(("every sample", f"J_all = {self.policy.cost_all_time:.6g} {per_unit(per)}{whose}"))
        if self.controller is not None:
            lines += _controller_lines(self.problem.controller, self.controller)
        for name, value in self.gains.items():
            lines.append(GAINS[name])
            lines += matrix_lines("", value)
        if self.nodes is not None and self.nodes.prediction is not None:
            lines.append(("actuator", "integrates dx̂/dt = (A + BL) x̂ between steps and applies L x̂; it receives x̂"))
        lines += self._guarantee_lines()
        for name, trigger in self._decisions.items():
            lines += _decision_lines(name, trigger)
            lines += [line for name, form in self._computed(trigger).items() for line in _form_lines(name, form)]
        lines.append(("network", problem.network.short()))
        if self.nodes is not None and problem.network.own_nodes:
            sizes = self.nodes.model.outputs, self.nodes.model.inputs
            lines += [(f"node, {name}", role.text(*sizes)) for name, role in problem.network.nodes.items()]
        if self.diagram is not None:
            for link in self.diagram.links:
                told = ", acknowledged" if link.acknowledged else ""
                law = problem.network.links[link.name].spending()
                lines.append((f"link, {link.name}", f"{link.packet}: {link.condition}{told}{law}"))
        lines += self._fault_lines()
        return [*lines, *(("note", note) for note in self.notes)]

    def _controller_document(self, controller: Controller) -> dict[str, Any]:
        matrices = {name: getattr(controller, name).tolist() for name in "ABCDE"}
        return {**matrices, "setpoint": controller.setpoint.tolist(), "pid": _pids(self.problem.controller)}

    def _computed(self, trigger: Trigger) -> dict[str, Form]:
        """Return the quadratic forms of the signals that a decision compares, also of signals that pass them on."""
        steps = self.policy.steps if isinstance(self.policy, Policy) else ()
        forms = {step.signal: step.forms[0] for step in steps if isinstance(step, Evaluate)}
        waiting, found = [name for form in trigger.options.values() for name in form.plus], dict[str, Form]()
        while waiting:
            name = waiting.pop(0)
            if name in forms and name not in found:
                found[name] = forms[name]
                waiting += forms[name].plus
        return {name: form for name, form in found.items() if form.Psi is not None}

    def _fault_lines(self) -> Lines:
        """Return how long a fault has an effect, if it is not until the end of a run."""
        policy = self.policy
        if not isinstance(policy, Policy) or policy.theory.settling == 0:
            return []
        steps, per = steps_of_a_fault(policy), policy.model.dt
        lasting = f"{steps} steps" if per is None else f"{steps} steps ({per * steps:.3g} s)"
        return [("after a fault", f"a node is degraded for {lasting}, seven time constants")]

    @property
    def _decisions(self) -> Mapping[str, Trigger]:
        return self.policy.decisions if isinstance(self.policy, Policy) else {}

    def _guarantee(self) -> dict[str, Any] | None:
        """Return the proven guarantee, and whether it holds for this loop."""
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
        proved |= {"proved": found.proved}
        return {**proved, "at_rate": at_rate}

    def _guarantee_lines(self) -> Lines:
        found = self._guarantee()
        if found is None:
            return [("guarantee", "none")]
        if not found["holds"]:
            return [("guarantee", f"none for this loop; for the loop of the design: {found['statement']}")]
        lines = [("guarantee", f"{found['statement']}: at most {rounded(found['cost'], 6, 1)} ({found['source']})")]
        if isinstance(self.policy, Policy):
            lines.append(("proof", proof_text(found["proved"], self.policy.theory.cost_all_time_error is not None)))
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


def describe(problem: Studied) -> Description:
    """Design a problem's policy and describe it, without a simulation."""
    problem = as_problem("problem", problem)
    policy = problem.designed()
    nodes = nodes_of(policy)
    if nodes is None:
        return Description(problem, policy, None, ())
    loop = problem.close(nodes)
    return Description(problem, policy, nodes, loop.violated_assumptions, loop.problem.remarks)


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
        **({} if e is None else {"exosystem": {name: _plain(value) for name, value in _parts(e).items()}}),
    }


def _parts(e: Exosystem) -> dict[str, object]:
    """Return the fields of an exosystem by name, D_z only if it has one."""
    found = {field.name: getattr(e, field.name) for field in fields(e)}
    return {name: value for name, value in found.items() if name != "D" or value is not None}


def _lost(plant: Plant | ContinuousPlant) -> tuple[list[complex], list[complex]]:
    """Return the uncontrollable modes and the unobservable modes."""
    limit = Limit(plant.continuous)
    parts = (unmoved(A, B, limit) for A, B in ((plant.A, plant.B), (plant.A.T, plant.C.T)))
    hidden, unseen = ([complex(mode) for part in lost for mode in part] for lost in parts)
    return hidden, unseen


def _plant_lines(plant: Plant | ContinuousPlant) -> Lines:
    rows = plant.summary()
    lines: Lines = [("plant", f"{rows['size']}; {rows['time']}"), ("poles", str(rows["poles"]))]
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
    if (e := plant.exosystem) is not None:
        moves = "dd/dt = S d + noise" if plant.continuous else "d⁺ = S d + noise"
        q = f"{len(e.S)} state{'s' * (len(e.S) > 1)} d"
        z = "C_z x" if e.D is None else "C_z x + D_z u"
        goal = f"and set-points, {q}: {moves}; {z} + F d is to be zero" if len(e.S) else f"none; {z} is to be zero"
        lines.append(("disturbances", goal))
        shown = {"S": e.S, "E": e.E, "G": e.G, "W": e.W, "C_z": e.outputs, "F": e.F + 0.0, "start": e.start[None]}
        shown |= {} if e.D is None else {"D_z": e.D}
        lines += [line for name, value in shown.items() if value.size for line in matrix_lines(f"d, {name}", value)]
    return lines


def _cost_lines(problem: Problem) -> Lines:
    lines: Lines = [("cost", f"{problem.cost.short()} per {time_unit(problem)}")]
    for name, value in problem.cost.summary().items():
        if isinstance(value, np.ndarray):
            lines += matrix_lines("cost, terminal" if name == "terminal" else f"cost {name}", value)
    return lines


def _decision_lines(name: str, trigger: Trigger) -> Lines:
    """Return the printed lines of a decision."""
    options, rule = trigger.options, "the option with the least value; in a tie, the first"
    if trigger.limit is not None:
        rule = f"the first option whose value is at most {trigger.limit:.6g}; the last if there is none"
    lines: Lines = [(f"decision {name}", rule)]
    for label, form in list(options.items())[:SHOWN_OPTIONS]:
        lines += _form_lines(f"  {label}", form)
    left = len(options) - SHOWN_OPTIONS
    return [*lines, ("", f"and {left} more, which --json lists")] if left > 0 else lines


def _form_lines(name: str, form: Form) -> Lines:
    """Return the printed lines of a quadratic form."""
    terms: list[str] = []
    if form.Psi is not None:
        terms.append(f"η'Ψη, η = [{'; '.join(form.signals)}]")
    if form.bell is not None:
        terms.append(f"{form.bell.height:.6g} exp(−½ η'Πη)")
    terms += [f"{weight:g} {signal}" for signal, weight in form.plus.items()]
    constant = form.constant
    if isinstance(constant, Scheduled) and len(constant.values) == 1:
        constant = float(constant.values[0])
    if isinstance(constant, Scheduled):
        terms.append(f"a constant indexed by {constant.by}, {constant.values.min():.6g} to {constant.values.max():.6g}")
    elif constant or not terms:
        terms.append(f"{constant:.6g}")
    lines: Lines = [(name, " + ".join(terms))]
    if form.Psi is not None:
        lines += matrix_lines("    Ψ", form.Psi)
    if form.bell is not None:
        lines += matrix_lines("    Π", form.bell.Pi)
    return lines


def _pids(kept: object) -> list[dict[str, Any]]:
    """Return what PID controllers state, other than the default values and the disturbance, of which a note speaks."""
    return [
        {
            one.name: value
            for one in fields(loop)
            if one.name != "disturbance" and (value := getattr(loop, one.name)) != one.default
        }
        for loop in pids_of(kept)
    ]


def _controller_lines(kept: object, controller: Controller) -> Lines:
    """Return the printed lines of a controller."""
    parts = [name for name in "ABCDE" if getattr(controller, name).size and (name != "E" or controller.E.any())]
    state = f"z⁺ = A z + B y{' + E u' if 'E' in parts else ''}, " if len(controller.A) else ""
    lines: Lines = [("controller", f"{state}u = {'C z + ' if len(controller.A) else ''}D y in each step")]
    for name in parts:
        lines += matrix_lines(f"  {name}", getattr(controller, name))
    stated = [", ".join(f"{name} = {value:g}" for name, value in pid.items()) for pid in _pids(kept)]
    lines += [("  PID", text) for text in stated]
    if not stated and controller.setpoint.any():
        lines.append(("  set-point", vector_text(controller.setpoint)))
    return lines


def _form_document(form: Form) -> dict[str, Any]:
    return {
        "signals": list(form.signals),
        "Psi": _plain(form.Psi),
        "constant": _plain(form.constant),
        "plus": dict(form.plus),
        "bell": None if form.bell is None else {"height": form.bell.height, "Pi": form.bell.Pi.tolist()},
    }


def _plain(value: object) -> Any:
    """Return a value in a form that JSON supports: a table as its index and entries, infinity as "inf" or "-inf"."""
    if isinstance(value, Scheduled):
        return {"by": value.by, "values": value.values.tolist()}
    if isinstance(value, Changes):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list):
        return [_plain(one) for one in cast("list[object]", value)]
    return f"{value}" if value in (np.inf, -np.inf) else value
