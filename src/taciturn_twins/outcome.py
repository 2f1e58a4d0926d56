"""The results of a trial, put together from the logs and reports of its processes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taciturn.extend import Array, Displayed
from taciturn.model.estimate import Estimate
from taciturn.problem import Problem
from taciturn_twins.world import TwinPlant
from taciturn_udp.namespaces import KernelLoss, predict_drops

ESTIMATE = "prior"  # name of the predicted state in the policies
Lines = Sequence[Mapping[str, Any]]


@dataclass(frozen=True, eq=False, repr=False)
class Trial(Displayed):
    """Results of the runs of a twin under one policy.

    Args:
        problem: problem of the runs.
        poses: pose at each step, as an ideal camera would measure it, (runs, N + 1, n) for N steps.
        inputs: applied inputs, (runs, N, m).
        costs: cost of each step, (runs, N).
        totals: total cost of each run, including the terminal cost if the run is complete, (runs,).
        estimates: state estimates of the controller before the measurement of each step, (runs, N, n).
        values: trigger values of not sending and of sending, (runs, N, 2); the smaller value decides.
        seen: measurements of the camera, (runs, N, n); NaN for a step without a picture or without a marker in it.
        lights: coordinates of all bodies that the camera renders, (runs, N + 1, coordinates).
        sent: whether a packet was sent, by link, (runs, N); on the sensor link, whether a picture was requested.
        arrived: whether the packet arrived, by link, (runs, N).
        sequences: sequence numbers of the packets that arrived, by link, for each run.
        datagrams: counts of packets sent, delivered and lost, by link, and of ``unaccounted`` datagrams (None if a
            process was killed).
        reports: report of each process, by name.
        seconds: duration in real time.
        notes: remarks on the validity of the results.
    """

    problem: Problem
    poses: Array
    inputs: Array
    costs: Array
    totals: Array
    estimates: Array
    values: Array
    seen: Array
    lights: Array
    sent: Mapping[str, Array]
    arrived: Mapping[str, Array]
    sequences: Mapping[str, tuple[tuple[int, ...], ...]]
    datagrams: Mapping[str, Any]
    reports: Mapping[str, Mapping[str, Any]]
    seconds: float
    notes: tuple[str, ...]

    @property
    def vision(self) -> Array:
        """Error of each measurement from a picture in which the camera found the marker, shape (pictures, n)."""
        off = self.seen - self.poses[:, :-1]
        return off[np.isfinite(off).all(axis=2)]

    @property
    def off(self) -> Array:
        """Distance in metres of each robot from its reference at each step, shape (runs, N + 1)."""
        poses, reference = self.poses[..., :2], self.problem.reference
        away = poses if reference is None else poses - reference.states[: poses.shape[1], :2]
        return np.sqrt((away**2).sum(axis=2))


@dataclass(frozen=True, repr=False)
class Told(Displayed):
    """The logs and the reports of the processes of a trial.

    Args:
        lines: log of each node, by role.
        seen: log of the image processing.
        reports: report of each process, by name.
        drops: packet losses that the kernel applies, by link; empty with relays.
        dropped: number of datagrams that the kernel dropped for this reason.
        killed: whether a process was killed, so that its counters are missing.
    """

    lines: Mapping[str, Lines] = field(hash=False)
    seen: Lines
    reports: Mapping[str, Mapping[str, Any]] = field(hash=False)
    drops: Mapping[str, KernelLoss] = field(hash=False)
    dropped: int
    killed: bool


def put_together(
    problem: Problem, plants: Sequence[TwinPlant], costs: Sequence[Sequence[float]], told: Told, seconds: float
) -> Trial:
    """Put together the results of a trial, up to the last step that all robots have completed."""
    runs, ticks = len(plants), min(map(len, costs))
    horizon = problem.cost.horizon
    paid = np.array([cost[:ticks] for cost in costs])
    final = np.array([plant.final_cost() if ticks == horizon else 0.0 for plant in plants])
    sender = {"sensor": "sensor", "actuator": "controller"}
    sent = {link: _marked(told.lines[role], f"sent_{link}", runs, ticks) for link, role in sender.items()}
    pictures, packets = told.seen, told.lines["actuator"]
    came = {
        "sensor": [(_loop(line), [line["sequence"]]) for line in pictures],
        "actuator": [(_loop(line), line["arrived_actuator"]) for line in packets],
    }
    sequences = {link: tuple(_sequences(came[link], row, run) for run, row in enumerate(sent[link])) for link in sent}
    lines = told.lines["controller"]
    n = len(plants[0].state)
    return Trial(
        problem=problem,
        poses=np.array([plant.poses[: ticks + 1] for plant in plants]),
        inputs=np.array([plant.given[:ticks] for plant in plants]),
        costs=paid,
        totals=paid.sum(axis=1) + final,
        estimates=_gathered(lines, lambda line: line["memory"][ESTIMATE], runs, ticks, n),
        values=_gathered(lines, trigger_values, runs, ticks, len(trigger_values(lines[0])) if lines else 0),
        seen=_gathered(told.seen, lambda line: line["seen"], runs, ticks, n),
        lights=np.array([plant.lights[: ticks + 1] for plant in plants]),
        sent=sent,
        arrived={link: _arrived(sent[link], sequences[link]) for link in sent},
        sequences=sequences,
        datagrams=_datagrams(told, sent, sequences),
        reports=told.reports,
        seconds=seconds,
        notes=_notes(told),
    )


def trigger_values(line: Mapping[str, Any]) -> list[float]:
    """Return the two values that the trigger compared in a step, for not sending and for sending, from a log line."""
    return [value for name, value in line.items() if name.startswith("option_")]


def _loop(line: Mapping[str, Any]) -> int:
    return int(line.get("loop", 0))


def _gathered(lines: Lines, read: Callable[[Mapping[str, Any]], Any], runs: int, ticks: int, size: int) -> Array:
    """Return the values of log lines by run and step, (runs, N, size); NaN for steps without a value."""
    found = np.full((runs, ticks, size), np.nan)
    for line in lines:
        value = read(line)
        if line["tick"] < ticks and value is not None:
            found[_loop(line), line["tick"]] = value
    return found


def _marked(lines: Lines, name: str, runs: int, ticks: int) -> Array:
    return np.nan_to_num(_gathered(lines, lambda line: [line[name]], runs, ticks, 1)[..., 0])


def _sequences(came: Iterable[tuple[int, Sequence[int]]], sent: Array, run: int) -> tuple[int, ...]:
    """Return the sequence numbers of the packets of a run that arrived, in order and without repetitions."""
    numbers = (number for loop, some in came if loop == run for number in some)
    return tuple(dict.fromkeys(number for number in numbers if number < sent.sum()))


def _arrived(sent: Array, sequences: Sequence[Sequence[int]]) -> Array:
    """Return whether the packet of each step arrived; its sequence number is the number of earlier packets."""
    arrived = np.zeros_like(sent)
    for run, numbers in enumerate(sequences):
        ticks = np.flatnonzero(sent[run])
        arrived[run, ticks[list(numbers)]] = 1.0
    return arrived


def _datagrams(
    told: Told, sent: Mapping[str, Array], sequences: Mapping[str, Sequence[Sequence[int]]]
) -> dict[str, Any]:
    """Return the packet counts of each link, and the number of datagrams that are unaccounted for."""
    reports = told.reports
    camera = reports["camera"]["counters"]
    asked = int(sent["sensor"].sum())
    found: dict[str, Any] = {
        "questions": {
            "sent": asked,
            "delivered": camera.get("questions", 0),
            "lost": asked - camera.get("questions", 0),
            "unanswered": camera.get("unanswered", 0),
        }
    }
    for link, number in (("sensor", camera.get("pictures", 0)), ("actuator", int(sent["actuator"].sum()))):
        delivered = sum(map(len, sequences[link]))
        found[link] = {"sent": number, "delivered": delivered, "lost": number - delivered}
    found["sensor"]["unseen"] = _unseen(told)
    for link, drop in told.drops.items():
        wanted = [
            [k for k in range(int(row.sum())) if not predict_drops(drop.seed, drop.permille, [k])[0]]
            for row in sent[link]
        ]
        found[link]["predicted"] = sum(int(row.sum()) for row in sent[link]) - sum(map(len, wanted))
        found[link]["as_predicted"] = None if told.killed else [list(row) for row in sequences[link]] == wanted
    sockets = [report["datagrams"] for report in reports.values()]
    found["dropped_by_full_buffers"] = sum(one["dropped_by_kernel"] or 0 for one in sockets)
    lost = told.dropped + found["dropped_by_full_buffers"]
    found["unaccounted"] = None if told.killed else sum(one["sent"] - one["received"] for one in sockets) - lost
    return found


def _unseen(told: Told) -> int:
    return len({(_loop(line), line["sequence"]) for line in told.seen if line["seen"] is None})


def _notes(told: Told) -> tuple[str, ...]:
    unseen = _unseen(told)
    notes = (f"{unseen} pictures showed no marker, so the estimator ran without a measurement",) if unseen else ()
    if told.killed:
        notes += ("a process was killed, so its counters and unprocessed packets are missing",)
    return notes + tuple(
        f"the {name} was degraded {count} times by an event that its theory excludes: {reason}"
        for name, report in told.reports.items()
        for reason, count in report.get("degraded", {}).items()
    )


def mean(values: Array) -> Estimate:
    """Return the mean over independent runs, with its standard error if there are at least two runs."""
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0
    return Estimate(float(values.mean()), error, "simulation" if len(values) > 1 else "exact")
