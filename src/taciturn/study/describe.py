"""What a problem and its policy are, before anything runs: plant, gains, guarantee, triggers, and the diagram."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import eigenvalues, mode_text, uncontrollable_modes
from taciturn.design.catalogue import AnyPolicy
from taciturn.model.diagram import Diagram
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Assign, Policy
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger
from taciturn.problem import Problem, expect_problem
from taciturn.renewal.policy import EventPolicy, OptimalPolicy
from taciturn.study.units import cost_unit, time_unit

BLUR = 1e-6  # relative: what rounding makes of poles that coincide
WIDEST = 12  # columns of a matrix that is printed whole
SHOWN_OPTIONS = 4  # of a decision
ESTIMATES = ("estimate", "deviation")  # what a gain multiplies: the state as it is known, or its deviation
GAINS = {
    "L": ("feedback gain", "input = + L × estimate; L:"),
    "estimator": ("estimator gain", "the estimate moves by + gain × (measurement − its prediction):"),
}
Lines = list[tuple[str, str]]


@dataclass(frozen=True, eq=False)
class Description:
    """What is known of a problem's policy without running it.

    Args:
        problem: what it was designed for.
        policy: as designed.
        nodes: the policy that nodes run; of ``optimal`` one of the same nodes; None where it has no ticks.
        departures: in what the loop is not the one of the design; with any, no guarantee holds.
    """

    problem: Problem
    policy: AnyPolicy
    nodes: Policy | None
    departures: tuple[str, ...]

    @property
    def diagram(self) -> Diagram | None:
        """Its nodes and links; None where it has no ticks."""
        return None if self.nodes is None else self.nodes.diagram()

    @property
    def gains(self) -> dict[str, Matrix]:
        """L of the feedback, and that of the estimator, where the policy has them."""
        return {} if self.nodes is None else _gains(self.nodes)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the reader must know."""
        told = () if isinstance(self.policy, OptimalPolicy) else self.policy.notes
        return told + tuple(f"{text}: no guarantee holds" for text in self.departures)

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn show --json``."""
        cost, network, drawn = self.problem.cost, self.problem.network, self.diagram
        return {
            "policy": self.problem.kind,
            "parameters": {name: _plain(value) for name, value in self.problem.parameters.items()},
            "unit": cost_unit(self.problem),
            "plant": _plant_document(self.problem.plant),
            "actual": None if self.problem.actual is None else _plant_document(self.problem.actual),
            "cost": {key: _plain(getattr(cost, key)) for key in ("Q", "R", "N", "horizon", "terminal", "discount")},
            "cost_all_time": self.policy.cost_all_time,
            "guarantee": self._guarantee(),
            "gains": {name: _plain(value) for name, value in self.gains.items()},
            "decisions": {
                name: {label: _form_document(form) for label, form in trigger.options.items()}
                for name, trigger in self._decisions.items()
            },
            "network": {
                "protocol": network.protocol,
                "delay": network.delay,
                "payload": network.payload,
                "losses": {link: network.loss(link) for link in ("actuator", "sensor")},
            },
            "diagram": None if drawn is None else drawn.document(),
            "notes": list(self.notes),
        }

    def lines(self) -> Lines:
        """Return what is printed of it: names, and what stands behind them."""
        problem, per = self.problem, cost_unit(self.problem)
        given = ", ".join(f"{name} = {_plain(value)}" for name, value in problem.parameters.items())
        lines: Lines = [("policy", problem.kind + (f" ({given})" if given else ""))]
        lines += _plant_lines(problem.plant)
        if problem.actual is not None:
            lines += [(f"actual {name}".strip(), text) for name, text in _plant_lines(problem.actual)]
        lines += _cost_lines(problem)
        lines.append(("sending always", f"J_all = {self.policy.cost_all_time:.6g} per {per}"))
        for name, value in self.gains.items():
            lines.append(GAINS[name])
            lines += _matrix_lines("", value)
        if self.nodes is not None and self.nodes.prediction is not None:
            lines.append(("actuator", "runs dx̂/dt = (A + BL) x̂ between ticks and applies L x̂; its input is x̂"))
        lines += self._guarantee_lines()
        for name, trigger in self._decisions.items():
            lines += _decision_lines(name, trigger.options)
        lines += _network_lines(problem)
        if self.diagram is not None:
            for link in self.diagram.links:
                told = ", acknowledged" if link.acknowledged else ""
                lines.append((f"link, {link.name}", f"{link.packet}: {link.condition}{told}"))
        return [*lines, *(("note", note) for note in self.notes)]

    @property
    def _decisions(self) -> Mapping[str, Trigger]:
        return self.policy.decisions if isinstance(self.policy, Policy) else {}

    def _guarantee(self) -> dict[str, Any] | None:
        """Return what is proved, and whether it holds of this loop."""
        policy, holds = self.policy, not self.departures
        if isinstance(policy, EventPolicy):
            bound = policy.bound()
            if policy.statement is None or bound is None:
                return None
            return {"statement": policy.statement, "cost": bound, "source": policy.source, "holds": holds}
        if isinstance(policy, OptimalPolicy) or policy.guarantee is None:
            return None
        found = policy.guarantee
        at_rate = None if found.base is None else {"base": found.base, "per_silence": found.per_silence}
        proved = {"statement": found.statement, "cost": found.cost, "source": found.source, "holds": holds}
        return {**proved, "at_rate": at_rate}

    def _guarantee_lines(self) -> Lines:
        found = self._guarantee()
        if found is None:
            return [("guarantee", "none is proved")]
        if not found["holds"]:
            return [("guarantee", f"none of this loop; of the design: {found['statement']}")]
        lines = [("guarantee", f"{found['statement']}: at most {found['cost']:.6g} ({found['source']})")]
        rated = found.get("at_rate")
        if rated is not None:
            lines.append(
                ("at a rate", f"at most {rated['base']:.6g} + {rated['per_silence']:.6g} (1 − sends per tick)")
            )
        return lines


def describe(problem: Problem) -> Description:
    """Return what a problem's policy is: designed, and not run.

    Args:
        problem: from ``load`` or ``Problem``.

    Returns:
        Data, and what is printed of it.

    Raises:
        ProblemError: data that do not fit.
        UnstableError: no stabilising gain.

    Example:
        >>> from taciturn import load
        >>> describe(load("two-mass")).gains["L"].shape
        (1, 4)
    """
    expect_problem("problem", problem)
    policy = problem.designed()
    if isinstance(policy, EventPolicy):
        return Description(problem, policy, None, ())
    nodes = policy.looked_at if isinstance(policy, OptimalPolicy) else policy
    return Description(problem, policy, nodes, problem.close(nodes).departures)


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
    unmoved, unseen = _lost(plant)
    keys = ("A", "B", "C", "W", "V", "mean", "covariance", "input_limit")
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
    }


def _lost(plant: Plant | ContinuousPlant) -> tuple[list[complex], list[complex]]:
    """Return the modes that no input moves, and those that no measurement shows."""
    unmoved, unseen = uncontrollable_modes(plant.A, plant.B), uncontrollable_modes(plant.A.T, plant.C.T)
    return [complex(mode) for mode in unmoved], [complex(mode) for mode in unseen]


def _plant_lines(plant: Plant | ContinuousPlant) -> Lines:
    continuous = isinstance(plant, ContinuousPlant)
    if isinstance(plant, ContinuousPlant):
        time = "continuous in time"
    else:
        time = "discrete in time" + (f", {plant.dt:g} s per step" if plant.dt is not None else "")
    sizes = ((plant.states, "state"), (plant.inputs, "input"), (plant.C.shape[0], "output"))
    counted = ", ".join(f"{count} {name}{'s' * (count != 1)}" for count, name in sizes)
    poles = eigenvalues(plant.A)
    size = 1.0 if not continuous else max(float(np.abs(poles).max()), 1e-300)
    margin = float(poles.real.max() if continuous else np.abs(poles).max() - 1) / size
    stable = "on the edge of stability" if abs(margin) < BLUR else "stable" if margin < 0 else "unstable"
    measured = "the full state, exactly" if plant.full_state else "y = C x + v"
    lines: Lines = [
        ("plant", f"{counted}; {time}" + (", not linear" if _is_function(plant) else "")),
        ("poles", f"{', '.join(_pole_text(complex(pole)) for pole in poles)}: {stable}"),
    ]
    for name, lost, verb in zip(("controllable", "observable"), _lost(plant), ("moves", "shows"), strict=True):
        what = "input" if verb == "moves" else "measurement"
        modes = ", ".join(mode_text(mode) for mode in lost)
        lines.append((name, f"but for the mode {modes}, which no {what} {verb}" if lost else "yes"))
    lines.append(("measured", measured))
    jumps = plant.jumps if isinstance(plant, ContinuousPlant) else None
    if jumps is not None:
        lines.append(("noise", f"{jumps.rate:g} jumps per second, {jumps.distribution}, W their rate times covariance"))
    lines += _matrix_lines("noise W", plant.W)
    if not plant.full_state:
        lines += _matrix_lines("noise V", plant.V)
    if plant.input_limit is not None:
        lines.append(("input limit", _row(plant.input_limit)))
    return lines


def _pole_text(pole: complex) -> str:
    return mode_text(complex(pole.real) if abs(pole.imag) < BLUR * abs(pole) else pole)


def _is_function(plant: Plant | ContinuousPlant) -> bool:
    return isinstance(plant, Plant) and plant.function is not None


def _cost_lines(problem: Problem) -> Lines:
    cost = problem.cost
    kind = "an average"
    if cost.horizon is not None:
        kind = f"a mission of {cost.horizon} steps"
    elif cost.discount < 1:
        kind = f"a discounted sum, factor {cost.discount:g} per tick"
    cross = " + 2x'Nu" if cost.N.any() else ""
    lines: Lines = [("cost", f"{kind} of x'Qx + u'Ru{cross} per {time_unit(problem)}")]
    lines += [*_matrix_lines("cost Q", cost.Q), *_matrix_lines("cost R", cost.R)]
    if cost.N.any():
        lines += _matrix_lines("cost N", cost.N)
    if cost.terminal is not None:
        lines += _matrix_lines("cost, terminal", cost.terminal)
    return lines


def _network_lines(problem: Problem) -> Lines:
    network = problem.network
    if network.protocol == "ideal":
        text = "ideal: nothing is lost"
    else:
        told = "acknowledged" if network.protocol == "tcp" else "no acknowledgement"
        losses = [
            f"{link} loses {100 * network.loss(link):g} %{' in bursts' if network.burst(link) else ''}"
            for link in ("actuator", "sensor")
        ]
        text = f"{network.protocol} ({told}); {', '.join(losses)}"
    if network.delay:
        text += f"; {network.delay} step{'s' * (network.delay > 1)} of delay"
    return [("network", text + (f"; numbers as {network.payload}" if network.payload != "float64" else ""))]


def _decision_lines(name: str, options: Mapping[str, Form]) -> Lines:
    """Return the least of which forms decides."""
    lines: Lines = [(f"decision {name}", "the label whose form is least; of equal ones the first")]
    for label, form in list(options.items())[:SHOWN_OPTIONS]:
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
            terms.append(f"a number by {constant.by}, {constant.values.min():.6g} to {constant.values.max():.6g}")
        elif constant or not terms:
            terms.append(f"{constant:.6g}")
        lines.append((f"  {label}", " + ".join(terms)))
        if form.Psi is not None:
            lines += _matrix_lines("    Ψ", form.Psi)
        if form.bell is not None:
            lines += _matrix_lines("    Π", form.bell.Pi)
    left = len(options) - SHOWN_OPTIONS
    return [*lines, ("", f"and {left} more, as --json has them")] if left > 0 else lines


def _matrix_lines(name: str, value: Matrix) -> Lines:
    """Return a matrix row by row; one of a known form in a word, one of a table with how many there are."""
    if isinstance(value, Scheduled):
        first = value.values[0]
        if len(value.values) == 1:
            return _matrix_lines(name, first)
        note = (name, f"by {value.by}, {len(value.values)} of them; the first:")
        return [note, *(("", text) for _, text in _matrix_lines("", first))]
    rows, columns = value.shape
    diagonal = np.diag(value) if rows == columns else value[:0, 0]
    if not value.any():
        return [(name, f"0 ({rows}×{columns})")]
    if rows == columns > 1 and np.array_equal(value, np.diag(diagonal)):
        same = (diagonal == diagonal[0]).all()
        factor = "" if diagonal[0] == 1 else f"{diagonal[0]:.6g} "
        return [(name, f"{factor}I ({rows}×{rows})" if same else f"diag({', '.join(f'{d:.4g}' for d in diagonal)})")]
    if columns > WIDEST:
        return [(name, f"{rows}×{columns}, entries from {value.min():.4g} to {value.max():.4g}")]
    return [(name if i == 0 else "", _row(row)) for i, row in enumerate(value)]


def _row(values: Array) -> str:
    return f"[{' '.join(f'{value:10.4g}' for value in values)}]" if len(values) > 1 else f"[{values[0]:.6g}]"


def _form_document(form: Form) -> dict[str, Any]:
    return {
        "signals": list(form.signals),
        "Psi": _plain(form.Psi),
        "constant": _plain(form.constant),
        "plus": dict(form.plus),
        "bell": None if form.bell is None else {"height": form.bell.height, "Pi": form.bell.Pi.tolist()},
    }


def _plain(value: object) -> Any:
    """Return a value as JSON holds it; a table as what it is read by, and its entries; what is endless as a word."""
    if isinstance(value, Scheduled):
        return {"by": value.by, "values": value.values.tolist()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return "inf" if value == np.inf else value
