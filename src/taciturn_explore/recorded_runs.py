"""Read a recorded run from its JSON document or its table: counters and, for a world of faults, the faults.

A document has no steps, so the page shows its sentence and the counters of its links, and the steps of its faults. The
table of a run has one row per step, with its cost and the packets that were sent.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, number_of, percent
from taciturn_explore.recording import LARGEST, Fault, Lane, Recording, Trace, is_number, is_text

WIDEST = 1_000_000  # steps of a world
HEAD = ("tick", "cost")  # the first columns of the table of a run
ROWS, COLUMNS = 200, 12  # of a table that is shown
# the faults of worlds (taciturn_worlds.faults) by their kinds
FAULTS = {
    "Loss": "packets dropped",
    "Delay": "packets late",
    "Duplicate": "packets twice",
    "Corruption": "bits inverted",
    "Replay": "packets again",
    "Recording": "old packets again",
    "Forgery": "forged packets",
    "KeyChange": "key changed",
    "Crash": "{} killed",
    "Pause": "{} suspended",
    "Jump": "clock of {} jumps",
    "Skew": "clock of {} drifts",
}
# the faults of twins (taciturn_twins.faults)
OF_TWINS = {
    "camera": "camera silent",
    "cover": "marker covered",
    "light": "light × {}",
    "actuator": "link cut",
    "kidnap": "displaced",
    "push": "pushed",
    "gain": "gain error {}",
    "controller": "controller killed",
}
FORM = re.compile(r"([a-z]{1,20})(?:@([\d.e+-]{1,20}?))?(?:\+([\d.e-]{1,20}))?(?:=([\d.e,+-]{1,60}))?")
LATEST = 1e9  # seconds
COUNTED = {"again": "sent again", "lost": "dropped"}
WITHOUT = "this document counts packets and has no steps: logs of the nodes (taciturn node --log) have them"
WITHOUT_TWIN = "this document has no steps: taciturn twin --record OUT.nc writes them"


def of_document(name: str, document: Mapping[str, Any]) -> Recording | None:
    """Read a recorded run from a JSON document; return None if the document is not the result of a run."""
    verdict, notes = document.get("verdict"), _texts(document.get("notes"))
    if is_text_of_result(verdict) and isinstance(document.get("faults"), list) and "recovery" in document:
        return _of_world(name, str(verdict), document, notes)
    if is_text_of_result(verdict) and isinstance(document.get("datagrams"), Mapping) and "processes" in document:
        return Recording(name, [str(verdict)], table=_links(document), notes=[*notes, WITHOUT])
    if is_text_of_result(verdict) and "certificate" in document and "steps" in document:
        return Recording(name, [str(verdict)], table=_lives(document["certificate"]), notes=[*notes, WITHOUT])
    if is_text(document.get("robot")) and isinstance(document.get("datagrams"), Mapping):
        faults = [Fault(one.title, one.told, 0, 1) for one in faults_of_twin(document)]
        told = [*notes, WITHOUT_TWIN]
        return Recording(name, verdict_of_twin(document, faults), faults=faults, table=_links(document), notes=told)
    return None


def is_text_of_result(value: object) -> bool:
    """Return whether a value can be the verdict of a result, that is, a text of 1 to 2000 characters."""
    return isinstance(value, str) and 0 < len(value) <= 2000


@dataclass(frozen=True, repr=False)
class TwinFault(Displayed):
    """A fault of a robot's twin: its kind, its title, its duration in words, and its start and duration in seconds."""

    name: str
    title: str
    told: str
    start: float
    lasts: float


def faults_of_twin(document: Mapping[str, Any]) -> list[TwinFault]:
    """Convert texts of the form ``NAME@START+SECONDS=SIZE`` to the faults of a robot's twin.

    Raises:
        ProblemError: a fault has another form.
    """
    found = list[TwinFault]()
    for text in _texts(document.get("faults")):
        form = FORM.fullmatch(text)
        name, start, lasts, size = form.groups() if form is not None else ("", "", "", "")
        try:
            begin, long = float(start or 0.0), float(lasts or 0.0)
        except ValueError:
            begin = long = -1.0
        if not name or not 0 <= begin < LATEST or not 0 <= long < LATEST:
            raise ProblemError(
                f"the fault {text[:60]!r} of the record cannot be read; expected NAME@START+SECONDS=SIZE"
            )
        told = "from the beginning" if name == "gain" else f"at {begin:g} s" + (f", for {long:g} s" if long else "")
        title = OF_TWINS.get(name, name).format(size or "")
        found.append(TwinFault(name, title, f"{told}: {text}", begin, long))
    return found


def verdict_of_twin(document: Mapping[str, Any], faults: Sequence[Fault]) -> list[str]:
    """Return sentences about the runs of a twin: their cost, their packets, and their faults."""
    told, cost, base = (
        [str(document["robot"])[:60]],
        _value(document.get("cost")),
        _value(document.get("cost_all_time")),
    )
    if cost is not None and base is not None and base > 0:
        told.append(f"{abs(100 * (cost / base - 1)):.3g} % {'more' if cost >= base else 'less'} cost than every sample")
    elif cost is not None:
        told.append(f"cost {cost:.6g}")
    rates: object = document.get("rates")
    for link, rate in cast("Mapping[str, object]", rates if isinstance(rates, Mapping) else {}).items():
        share = _value(rate)
        told += [f"{link[:60]} sent in {percent(share, 1)} of the steps"] if share is not None else []
    return [", ".join(told), *([", ".join(one.name for one in faults)] if faults else [])]


def of_table(name: str, path: Path, text: str) -> Recording:
    """Read a recorded network run from its table, which has one row per step.

    Raises:
        ProblemError: the table has a row or a column that no such table has.
    """
    rows = csv.reader(text.splitlines())
    head = next(rows)
    if tuple(head[:2]) != HEAD or not all(one.startswith("sent_") for one in head[2:]) or len(head) > 66:
        raise ProblemError(
            f"the table {path} has the columns {', '.join(head[:6])[:120]}; expected the columns {', '.join(HEAD)}, "
            "and sent_LINK for each link, as the run of a network writes with to_csv"
        )
    columns: list[list[float]] = [[] for _ in head]
    for number, row in enumerate(rows, 2):
        try:
            values = [{"True": 1.0, "False": 0.0}[one] if one in ("True", "False") else float(one) for one in row]
        except ValueError:
            values = []
        if len(values) != len(head) or not all(abs(one) <= LARGEST for one in values):
            raise ProblemError(
                f"line {number} of {path} is {','.join(row)[:80]!r}; expected {number_of(len(head), 'number')}"
            )
        for column, value in zip(columns, values, strict=True):
            column.append(value)
    steps, costs = len(columns[0]), np.array(columns[1])
    if not steps:
        raise ProblemError(f"the table {path} has no rows; expected one row for each step")
    if columns[0] != [columns[0][0] + k for k in range(steps)]:
        raise ProblemError(f"the steps of {path} do not follow each other; expected one row for each step")
    lanes = [Lane(one[5:], "?", "?", np.array(column) > 0) for one, column in zip(head[2:], columns[2:], strict=True)]
    shares = [f"{lane.link} sent in {percent(lane.sent.mean(), 1)}" for lane in lanes]
    return Recording(
        name, [number_of(steps, "step") + (f": {', '.join(shares)}" if shares else "")], int(columns[0][0]), steps,
        traces=[Trace("cost of a step", costs, held=True)], lanes=lanes,
        notes=["a table tells which packets were sent, and not which ones were dropped: logs of the nodes do"],
    )  # fmt: skip


def _of_world(name: str, verdict: str, document: Mapping[str, Any], notes: Sequence[str]) -> Recording:
    """Return the record of a world of faults.

    Raises:
        ProblemError: the document has no steps, or a fault without a first step.
    """
    steps = document.get("steps")
    if type(steps) is not int or not 0 < steps <= WIDEST:
        raise ProblemError(f"{name} has {str(steps)[:40]} steps; expected a number from 1 to {WIDEST}")
    faults = list[Fault]()
    for given in cast("list[object]", document["faults"]):
        one = cast("Mapping[str, Any]", given if isinstance(given, Mapping) else {})
        first, lasts, kind = one.get("first"), one.get("steps"), one.get("kind")
        if type(first) is not int or type(lasts) is not int or first < 0 or not isinstance(kind, str):
            raise ProblemError(
                f"a fault in {name} has no kind, no first step or no number of steps; expected faults as a world of "
                "faults records them"
            )
        path = _texts(one.get("path"))
        where = f"{path[0]} → {path[1]}" if len(path) == 2 else str(one.get("role", ""))[:60]
        words = "link cut" if kind == "Loss" and one.get("share") == 1.0 else FAULTS.get(kind, kind[:40]).format(where)
        title = words if where in words else f"{words}, {where}"
        text = one["text"] if is_text(one.get("text")) else title
        faults.append(Fault(title, text, min(first, steps - 1), min(steps, first + max(1, lasts)), where))
    if is_number(document.get("recovery")) and faults:
        end = max(fault.end for fault in faults)
        last = min(steps, end + max(1, int(document["recovery"])))
        text = f"until step {last} no node is degraded any more and all copies agree"
        faults.append(Fault("recovery", text, end, last, mild=True))
    rows = [[one, ", ".join(f"{n:g} {name}" for name, n in some.items() if n)] for one, some in _counted(document)]
    table = (["process", "datagrams and packets"], rows) if rows else None
    return Recording(name, [verdict], 0, steps, faults=faults, table=table, notes=notes)


def _counted(document: Mapping[str, Any], key: str = "counters") -> list[tuple[str, dict[str, float]]]:
    """Return the counters in a document by link or process."""
    given: object = document.get(key)
    return [
        (one[:60], {str(name)[:60]: n for name, n in cast("Mapping[str, Any]", some).items() if is_number(n)})
        for one, some in cast("Mapping[str, object]", given if isinstance(given, Mapping) else {}).items()
        if isinstance(some, Mapping)
    ][:ROWS]


def _links(document: Mapping[str, Any]) -> tuple[Sequence[str], Sequence[Sequence[str]]] | None:
    """Return the packets of each link as a table."""
    rows = _counted(document, "datagrams")
    names = list(dict.fromkeys(name for _, numbers in rows for name in numbers))[:COLUMNS]
    told = [[one, *(f"{numbers[name]:g}" if name in numbers else "" for name in names)] for one, numbers in rows]
    return (["link", *(COUNTED.get(name, name.replace("_", " ")) for name in names)], told) if names else None


def _lives(certificate: object) -> tuple[Sequence[str], Sequence[Sequence[str]]] | None:
    """Return what the silence of each node has cost as a table."""
    given = cast("Mapping[str, object]", certificate if isinstance(certificate, Mapping) else {}).get("silence")
    rows = [*_life_rows(cast("list[object]", given if isinstance(given, list) else []))]
    return (["silence of", "changed √J by at most", "steps"], rows[:ROWS]) if rows else None


def _life_rows(lives: Sequence[object]) -> Iterator[list[str]]:
    for life in lives:
        one = cast("Mapping[str, Any]", life if isinstance(life, Mapping) else {})
        if is_number(one.get("root")) and is_number(one.get("steps")):
            yield [" and ".join(_texts(one.get("links"))), f"{one['root']:.6g}", f"{one['steps']:g}"]


def _texts(given: object) -> list[str]:
    listed = cast("list[object]", given if isinstance(given, list | tuple) else [])
    return [one[:400] for one in listed if isinstance(one, str)][:ROWS]


def _value(estimate: object) -> float | None:
    given = cast("Mapping[str, Any]", estimate if isinstance(estimate, Mapping) else {}).get("value", estimate)
    return float(given) if is_number(given) else None
