"""The cost of not sending, from logs of nodes: the nodes' own certificate, and the path if every sample had been sent.

The log of a node has a JSON line for each step with its memory, measurement and input (``taciturn node --log``). A node
whose policy has a bound on every path keeps the sum of what its silence costs, so the last line of each of its lives
gives its part of the certificate (``model/silence``). A life ends where this sum begins again, as the node has lost its
state.

From the logs of all nodes follows the *exact* path of the loop that sends every sample, under the same noise and load.
The memory q of a node's response moves by q⁺ = F q + G d, which gives its error d in each step. With the response z of
the whole loop to the errors of all nodes (``base/response``), the outputs and inputs of that loop are

    y_b = y − C z,   u_b = u − K z − D d.

If the cost weighs outputs and inputs, its mean over the recorded samples is known for both paths.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np

from taciturn._arrays import Array, block_diagonal
from taciturn._figure import HEIGHT, Curve, Panel, Series, Size, draw
from taciturn._files import read_text, why_unreadable
from taciturn._style import StyleName, Thing
from taciturn._text import number_of
from taciturn.base.response import EverySample
from taciturn.design.every_path import MeasuredCost, loop_of_every_path
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.network import Network
from taciturn.model.packets import fingerprint
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.model.result import VERDICT, Column, Columns, Field, Tabular, plain_fields
from taciturn.model.silence import Certificate, Life, SilenceCost, lives_of
from taciturn.model.steps import Assign
from taciturn.model.wire import LARGEST
from taciturn.problem import Problem
from taciturn.problem.without_file import Studied, as_problem
from taciturn.study.sentences import compared_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST = 2**30  # bytes of a log
EVERY = "_every_sample"  # end of the name of a signal if every sample had been sent
LATEST = 2**53  # step from which on numbers of steps are not exact
JOINED = "joined"  # the reason of a node that starts while others run
NO_CERTIFICATE = "no certificate"
STATED = ("the path with every sample is that of the stated plant, not of every plant within gain_range",)
Line = Mapping[str, Any]


def _silences(found: Recorded) -> str:
    return "" if found.certificate is None else found.certificate.line()


def _verdict(found: Recorded) -> str:
    """Return the cost of silence on the recorded path, and the certificate of the nodes."""
    told, base = list[str](), found.cost_every_sample
    if found.cost is not None and base is not None and base > 0:
        told.append(compared_text(Estimate(found.cost, 0.0, "exact"), base))
    elif found.cost is not None:
        told.append(f"cost {found.cost:.6g} per {found.unit}")
    told.append(NO_CERTIFICATE if found.certificate is None else found.certificate.verdict())
    return f"in {number_of(found.steps, 'recorded step')}: {', '.join(told)}"


@dataclass(frozen=True, eq=False, repr=False)
class Recorded(Tabular):
    """Cost of not sending, computed from the logs of nodes.

    Args:
        policy: kind of the policy.
        certificate: upper bound on the cost of silence, which the nodes have computed; None if the logs do not contain
            all of it.
        steps: recorded steps.
        cost: mean cost of the recorded samples; None if the cost is not one of outputs and inputs, or if a node that
            measures or applies was not recorded.
        cost_every_sample: mean cost of the same samples if every sample had been sent, under the same noise and load.
        times: numbers of the steps, (steps,).
        outputs: outputs as recorded and with every sample, by name, (steps,) each.
        roots: upper bound on how much silence has changed √J from the first step up to each step, (steps,); empty
            without a certificate.
        ratios: upper bound on the ratio between the cost up to each step and the cost of sending every sample,
            (steps,); NaN while no bound is certified, and empty if the cost is not known.
        notes: reasons why a part is missing.
    """

    FIELDS: ClassVar[tuple[Field[Recorded], ...]] = (
        VERDICT,
        Field("policy", say="policy"),
        Field("steps"),
        Field("certificate", json=Certificate.document, optional=True, say="certificate", text=_silences),
        Field("cost", optional=True, say="cost", text="{:.6g} per {of.unit}"),
        Field(
            "cost_every_sample",
            optional=True,
            say="every sample",
            text="would have cost {:.6g} per {of.unit} on this path",
        ),
        *plain_fields("unit"),
        Field("notes", say="note", text=lambda found: [one for one in found.notes if one not in found.verdict]),
    )
    index: ClassVar[str] = "tick"

    policy: str
    unit: str
    certificate: Certificate | None
    steps: int
    cost: float | None
    cost_every_sample: float | None
    times: Array
    outputs: Mapping[str, Array]
    roots: Array
    ratios: Array
    notes: tuple[str, ...]

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Draw the cost that each node added by not sending, and the recorded path next to that with every sample sent.

        Args:
            ax: existing axes to draw in instead of a new figure, one for each panel.
            figsize: width and height of a new figure, in inches.
            style: ``"light"``, ``"dark"``, ``"paper"`` or ``"paper-wide"``.
        """
        panels = [] if self.certificate is None else [self.certificate.panel()]
        panels += self._paths()
        if not panels:
            raise ProblemError(f"the recording has no numbers to draw: {'; '.join(self.notes)}; expected other logs")
        return draw(panels, ax, figsize, style)

    def _paths(self) -> list[Panel]:
        """Return a panel for each output and input: as recorded, and if every sample had been sent."""
        panels, times = list[Panel](), self.times.tolist()
        for name in [name for name in self.outputs if not name.endswith(EVERY)]:
            curve: Curve = "steps" if name.startswith("u") else "line"
            kinds: tuple[tuple[str, str, Thing], ...] = (
                ("", "recorded", "policy"),
                (EVERY, "every sample", "every sample"),
            )
            series = [
                Series(times, self.outputs[name + end].tolist(), "" if panels else label, curve, thing=thing)
                for end, label, thing in kinds
            ]
            panels.append(Panel(series, ylabel=name, height=0.4 * HEIGHT))
        return [*panels[:-1], *(replace(one, xlabel="step") for one in panels[-1:])]

    @property
    def verdict(self) -> tuple[str, ...]:
        """Cost of not sending on the recorded path, and the bound that the nodes certify, in words."""
        return (_verdict(self), *(note for note in self.notes if note.startswith(NO_CERTIFICATE)))

    def table_texts(self) -> Sequence[str]:
        """Return the table of the cost that each node added by not sending."""
        return () if self.certificate is None else (self.certificate.table(),)

    def columns(self) -> Columns:
        """Return a table with one row per step: recorded outputs and inputs, and those if every sample had been
        sent.
        """
        columns: dict[str, Column] = {"tick": self.times.astype(np.int64)}
        return columns | dict(self.outputs)


def recorded_silence(problem: Studied, logs: Iterable[str | Path]) -> Recorded:
    """Compute the cost of not sending from the logs that the nodes of a problem wrote.

    Args:
        problem: the problem whose policy the nodes ran, with a bound on every path (kind ``distributed``).
        logs: the logs of nodes, in any order: files with a JSON line for each step, as ``taciturn node --log`` writes.
            The node of each link that decides is needed; the cost also needs the nodes that measure and apply.

    Returns:
        The certificate, and if all nodes were recorded the cost of the recorded path and that of sending every sample.

    Raises:
        ProblemError: a log cannot be read or does not belong to a node of the problem, or the policy does not compute
            the cost of silence.
    """
    problem = as_problem("problem", problem)
    policy = problem.designed()
    if not isinstance(policy, Policy) or not policy.theory.silence:
        raise ProblemError(
            f"the nodes of the policy {problem.kind} do not measure the cost of silence; expected the policy kind "
            "'distributed' with a controller or guarantee = 'every path', and links without losses or with "
            "acknowledgements"
        )
    lines = sorted((_lines(Path(path), policy, problem.network) for path in logs), key=lambda log: log[0]["tick"])
    deciding = {links: _of_node(lines, one) for links, one in policy.theory.silence.items()}
    for role in {log[0]["role"] for log in lines}:
        _check_order(role, [line for log in lines if log[0]["role"] == role for line in log])
    ticks = [int(line["tick"]) for found in deciding.values() for line in found]
    first, last = min(ticks), max(ticks)
    uncounted = _uncounted(policy, problem.close(policy).violated_assumptions, lines, deciding)
    path, why = (None, ()) if uncounted else _path(problem, policy, lines, deciding)
    costs = None if path is None else path.costs
    wide = any(one.factor > 1 for one in policy.theory.silence.values())
    continuous, certificate = isinstance(problem.plant, ContinuousPlant), None
    roots = ratios = np.zeros(0)
    if not uncounted:
        lives = tuple(life for links, found in deciding.items() for life in _lives(policy, links, found))
        # a node learns in the next step whether a packet was lost, so what the last step has cost is not in its log
        counted = np.arange(last - first + 1) + (0 if any(map(policy.network.loss, policy.network.links)) else 1)
        each = policy.tick if continuous else 1.0
        durations: Array = (
            np.ones(len(counted)) if problem.cost.mission else counted.astype(np.float64) * float(each or 1.0)
        )
        roots, duration = _roots(policy, deciding, first, durations), float(durations[-1])
        if path is not None and path.stages is not None and not continuous:
            ratios = _ratios(roots, np.cumsum(path.stages) / durations)
        # of a continuous plant, the cost of the path is an integral, which differs from that of the samples
        certificate = Certificate(lives, duration, None if costs is None or continuous else costs[0])
    return Recorded(
        policy.kind,
        "second at the sampling instants" if continuous else "step",
        certificate,
        last - first + 1,
        None if costs is None else costs[0],
        None if costs is None else costs[1],
        np.arange(first, last + 1, dtype=np.float64) if path is None else path.times,
        {} if path is None else path.signals,
        roots,
        ratios,
        (*(f"{NO_CERTIFICATE}: {text}" for text in uncounted), *why, *(STATED if path is not None and wide else ())),
    )


def _lines(path: Path, policy: Policy, network: Network) -> list[Line]:
    """Return the lines of the log of a node."""
    if (path / "packets.csv").is_file():
        raise ProblemError(
            f"the log {path} is the folder of a record, and the packets and signals of a run do not contain what its "
            "silence cost; expected the log of a node, as `taciturn node --log` writes"
        )
    try:
        text = read_text(path, MOST)
    except (OSError, ValueError) as error:
        raise ProblemError(
            f"the log {path} cannot be read: {why_unreadable(error)}; expected a log of a node"
        ) from None
    designed = f"{fingerprint(policy, network):016x}"
    used = {name for one in policy.theory.silence.values() for name in (one.total, one.lasted, one.response)}
    found, rows = list[Line](), text.split("\n")  # JSON may contain other ends of lines
    while rows and not rows[-1].strip():
        rows.pop()
    for number, row in enumerate(rows, 1):
        try:
            line = json.loads(row)
        except (ValueError, RecursionError):
            if number == len(rows) and found:  # of a process that was killed
                break
            line = None
        if not _is_line(line, policy, designed):
            raise ProblemError(
                f"line {number} of {path} is not a line of a node's log; expected JSON with the step, the role and "
                "the memory of a node, as `taciturn node --log` writes"
            )
        found.append(_used(cast("Line", line), used))
    if not found:
        raise ProblemError(f"the log {path} is empty; expected a line for each step of a node")
    return found


def _is_line(line: object, policy: Policy, designed: str) -> bool:
    """Return whether a value has the entries of a log line that are used, with finite numbers."""
    if not isinstance(line, dict):
        return False
    one = cast("dict[str, Any]", line)
    tick, role, memory, reasons = (one.get(name) for name in ("tick", "role", "memory", "reasons"))
    if type(tick) is not int or not 0 <= tick < LATEST or one.get("loop", 0) != 0:
        return False
    if not isinstance(role, str) or role not in policy.network.nodes or not isinstance(memory, dict):
        return False
    if one.get("fingerprint", designed) != designed:
        raise ProblemError(
            f"the log of {role} is that of another policy (fingerprint {one['fingerprint']!r}); expected the log of a "
            f"node that ran this problem file, with the fingerprint {designed!r}"
        )
    if reasons is not None and not (
        isinstance(reasons, dict) and all(map(_is_number, cast("dict[str, object]", reasons).values()))
    ):
        return False
    rows: list[object] = [
        *cast("dict[str, object]", memory).values(),
        *(one[name] for name in ("u",) if name in one),
    ]
    y: object = one.get("y", [])
    rows.append([value for value in cast("list[object]", y) if value is not None] if isinstance(y, list) else y)
    return all(isinstance(row, list) and all(map(_is_number, cast("list[object]", row))) for row in rows)


def _used(line: Line, signals: set[str]) -> Line:
    """Return what is read of a line, so that long logs need little memory."""
    memory = {name: row for name, row in line["memory"].items() if name in signals}
    return {name: line[name] for name in ("tick", "role", "epoch", "reasons", "y", "u") if name in line} | {
        "memory": memory
    }


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _of_node(lines: Sequence[list[Line]], one: SilenceCost) -> list[Line]:
    """Return the lines of the node that decides, by step."""
    found = [line for log in lines for line in log if one.total in line["memory"]]
    if not found:
        raise ProblemError(
            f"the log of the node {one.at!r}, which decides when to send on a link, is missing; expected the logs of "
            "all nodes with such decisions"
        )
    if any(len(line["memory"].get(name, ())) != 1 for line in found for name in (one.total, one.lasted)):
        raise ProblemError(
            f"the log of {one.at} does not have exactly one value of {one.total} and one of {one.lasted} in every "
            "step; expected the log of a node with this policy"
        )
    return found


def _check_order(role: str, lines: Sequence[Line]) -> None:
    """Raise an error if the steps of a node go back."""
    for line, after in pairwise(lines):
        if after["tick"] < line["tick"]:
            raise ProblemError(
                f"the logs of {role} go back from step {line['tick']} to step {after['tick']}; expected the logs of "
                "one run, and each log only once"
            )


def _uncounted(
    policy: Policy,
    violated: Sequence[str],
    lines: Sequence[list[Line]],
    deciding: Mapping[tuple[str, ...], list[Line]],
) -> list[str]:
    """Return why the sums of the nodes do not contain all that silence has cost."""
    found, first = list(violated), min(log[0]["tick"] for log in lines)
    lasted = {line["role"]: policy.theory.silence[links].lasted for links, own in deciding.items() for line in own[:1]}
    for role in dict.fromkeys(log[0]["role"] for log in lines):
        own = [line for log in lines if log[0]["role"] == role for line in log]
        told = {name: n for line in own for name, n in line.get("reasons", {}).items() if name != JOINED and n}
        if told:
            events = ", ".join(f"{name} ({n:g})" for name, n in told.items())
            found.append(f"the {role} reports events that no theory covers: {events}")
        if own[0]["tick"] > first and own[0]["memory"].get(lasted.get(role, ""), [0.0])[0] <= 1:
            found.append(f"the log of the {role} begins at step {own[0]['tick']}, after step {first} of another node")
        sensor = role in policy.network.sensors and role not in policy.network.actuators
        for before, line in pairwise(own):
            at_once = line["tick"] == before["tick"] + 1 and line["memory"].get(lasted.get(role, "")) == [1.0]
            if _restarted(before, line, lasted.get(role)) and not (sensor and at_once):
                found.append(f"the {role} lost its state before step {line['tick']}")
    return found


def _restarted(before: Line, line: Line, lasted: str | None) -> bool:
    """Return whether a node has lost its state between two of its lines."""
    if before.get("epoch") != line.get("epoch"):
        return True
    return lasted is not None and line["memory"][lasted][0] < before["memory"][lasted][0]


def _lives(policy: Policy, links: tuple[str, ...], lines: Sequence[Line]) -> list[Life]:
    """Return the lives of a node."""
    one = policy.theory.silence[links]
    ended = [before for before, line in pairwise(lines) if _restarted(before, line, one.lasted)]
    return [life for line in (*ended, lines[-1]) for life in lives_of({links: one}, line["memory"])]


def _roots(policy: Policy, deciding: Mapping[tuple[str, ...], list[Line]], first: int, durations: Array) -> Array:
    """Return by how much the lives that had begun had changed √J at most, up to each step."""
    found = np.zeros(len(durations))
    for links, lines in deciding.items():
        one = policy.theory.silence[links]
        ends = [k for k, (before, line) in enumerate(pairwise(lines), 1) if _restarted(before, line, one.lasted)]
        for start, end in pairwise([0, *ends, len(lines)]):
            steps = [int(line["tick"]) - first for line in lines[start:end]]
            totals = [max(0.0, line["memory"][one.total][0]) for line in lines[start:end]]
            latest = np.searchsorted(steps, np.arange(len(durations)), side="right")
            found += one.factor * np.sqrt(np.array([0.0, *totals])[latest])
    return np.divide(found, np.sqrt(durations), out=np.zeros(len(durations)), where=durations > 0)


def _ratios(roots: Array, costs: Array) -> Array:
    """Return the largest ratio of the cost to that of every sample, up to each step; NaN where none is known."""
    whole = np.sqrt(np.maximum(costs, 0.0))
    share = np.divide(roots, whole, out=np.ones(len(roots)), where=whole > roots)
    return np.divide(1.0, (1 - share) ** 2, out=np.full(len(roots), np.nan), where=share < 1)


@dataclass(frozen=True, eq=False, repr=False)
class _Path:
    """A recorded path, and the path of the loop that sends every sample."""

    times: Array
    signals: Mapping[str, Array]
    costs: tuple[float, float] | None
    stages: Array | None = None  # the cost of each recorded sample


def _path(
    problem: Problem, policy: Policy, lines: Sequence[list[Line]], deciding: Mapping[tuple[str, ...], list[Line]]
) -> tuple[_Path | None, tuple[str, ...]]:
    """Return both paths, or a reason why they are not known."""
    steps = next(iter(deciding.values()))
    times = np.array([line["tick"] for line in steps])
    if any([line["tick"] for line in found] != times.tolist() for found in deciding.values()) or (
        len(times) > 1 and (np.diff(times) != 1).any()
    ):
        return None, ("no path with every sample: the logs do not have the same steps without a gap",)
    if any(policy.network.loss(link) > 0 for link in policy.network.links):
        return None, ("no path with every sample: links drop packets, and logs do not tell when a node learns it",)
    for links, found in deciding.items():
        one = policy.theory.silence[links]
        if found[0]["memory"][one.lasted][0] > 1 or len(_lives(policy, links, found)) > 1:
            return None, (
                f"no path with every sample: the {one.at} was not recorded from its start on, or has lost its state",
            )
    y, u = _signals(policy, lines, times, "y"), _signals(policy, lines, times, "u")
    if y is None or u is None:
        return None, ("no path with every sample: a sample, or the log of a node that measures or applies, is missing",)
    errors = _errors(policy, deciding)
    if errors is None:
        return None, ("no path with every sample: the response of a node does not determine its errors",)
    period = policy.tick if isinstance(problem.plant, ContinuousPlant) else None
    design = loop_of_every_path(policy.kind, problem.plant, problem.cost, period, problem.controller)
    loop, plant, c = (
        EverySample.of(design.problem, design.control.controller),
        design.problem.plant,
        design.control.controller,
    )
    n, point = plant.states, plant.operating_point
    sensed = plant.sensed  # without the set-points, which no silence moves
    rest_y, rest_u = (0.0, 0.0) if point is None else ((plant.C @ point.x)[:sensed], point.u)
    z, moved_y, moved_u = np.zeros(len(loop.F)), np.zeros(y.shape), np.zeros(u.shape)
    for k, error in enumerate(errors):
        moved_y[k] = (plant.C @ z[:n])[:sensed]
        moved_u[k] = c.D @ plant.C @ z[:n] + c.C @ z[n:] + np.hstack([c.D, np.eye(plant.inputs)]) @ error
        z = loop.F @ z + loop.G @ error
    base_y, base_u = y - moved_y, u - moved_u
    signals = {f"y{i + 1}{end}": rows[:, i] for end, rows in (("", y), (EVERY, base_y)) for i in range(y.shape[1])}
    signals |= {f"u{i + 1}{end}": rows[:, i] for end, rows in (("", u), (EVERY, base_u)) for i in range(u.shape[1])}
    if problem.plant.exosystem is not None:
        return _Path(times, signals, None), (
            "no cost: it counts deviations that depend on set-points and disturbances, which logs do not contain",
        )
    try:
        weights = MeasuredCost.at_samples(problem.plant, problem.cost)
    except ProblemError as error:
        return _Path(times, signals, None), (f"no cost: {error}",)
    rows = [np.hstack([y - rest_y, u - rest_u]), np.hstack([base_y - rest_y, base_u - rest_u])]
    whole = block_diagonal(weights.Q, weights.R)
    stages = [np.sum((one @ whole) * one, axis=1) for one in rows]
    costs = [float(np.sum(one)) / len(one) for one in stages]
    return _Path(times, signals, (costs[0], costs[1]), stages[0]), ()


def _signals(policy: Policy, lines: Sequence[list[Line]], times: Array, name: str) -> Array | None:
    """Return the measurements or the inputs of all nodes, (steps, entries); None if some are missing."""
    owned = policy.measured if name == "y" else policy.applied
    size = policy.model.sensed if name == "y" else policy.model.inputs
    found = np.full((len(times), size), np.nan)
    for log in lines:
        rows = {line["tick"]: line[name] for line in log if name in line}
        role = log[0]["role"]
        entries = [i for node, held in owned.values() if node in policy.site(role) for i in held]
        if not entries or not rows:
            continue
        for k, tick in enumerate(times.tolist()):
            if len(rows.get(tick, ())) == len(entries):
                found[k, entries] = [np.nan if value is None else value for value in rows[tick]]
    return None if np.isnan(found).any() else found


def _errors(policy: Policy, deciding: Mapping[tuple[str, ...], list[Line]]) -> list[Array] | None:
    """Return the errors of all measurements and inputs in each step, as the responses of the nodes show them."""
    p, m = policy.model.outputs, policy.model.inputs
    count = len(next(iter(deciding.values())))
    found = np.zeros((count, p + m))
    places = {node: [*rows] for node, rows in policy.measured.values()}
    places |= {node: [p + i for i in rows] for node, rows in policy.applied.values()}
    for links, lines in deciding.items():
        name = policy.theory.silence[links].response
        moves = [step for step in policy.steps if isinstance(step, Assign) and step.signal == name]
        if not moves:
            return None
        F = cast("Array", moves[0].branches[0][name])
        G = np.hstack([cast("Array", matrix) for signal, matrix in moves[0].branches[0].items() if signal != name])
        if np.linalg.matrix_rank(G) < G.shape[1]:
            return None
        if any(len(line["memory"].get(name, ())) != len(F) for line in lines):
            raise ProblemError(
                f"the signal {name} does not have {number_of(len(F), 'entry')} in every line of the logs, unlike in "
                "this policy; expected the problem file that the nodes ran"
            )
        q = np.array([[0.0] * len(F), *(cast("list[float]", line["memory"][name]) for line in lines)])
        # the rule counts the value of a packet minus the one that is used in silence; the error is the opposite
        d = -(q[1:] - q[:-1] @ F.T) @ np.linalg.pinv(G).T
        found[:, [i for link in links for i in places[link]]] = d
    return [*found]
