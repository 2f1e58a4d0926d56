"""A recorded run as the page shows it: signals, packets and faults of each step, and the verdict of the run.

A record is read from files, whose kind is known by their content (``read_recording``):

* logs of nodes and of a plant, one file or more (``recorded_nodes``);
* the JSON document of ``taciturn network``, with or without ``--world``, of ``taciturn show --record`` and of
  ``taciturn twin``, or the table of a run of a network (``recorded_runs``);
* the NetCDF file of a twin (``recorded_twins``);
* the folder of ``taciturn network --record`` (``recorded_folder``).

The files may come from a stranger: they are regular files of a limited size, nothing in them is executed, and every
number that is used is checked. A page shows the last ``STEPS`` steps.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from taciturn.errors import ProblemError
from taciturn.extend import Array, Displayed, number_of, percent, quoted, read_bytes, why_unreadable
from taciturn.problem import Problem
from taciturn_explore.network import histogram
from taciturn_explore.response import short
from taciturn_udp.record import PACKETS, SIGNALS

MOST = 2**27  # bytes of a file
STEPS = 50_000  # that a page shows
FAULTS = 400  # that a page lists
LARGEST = 1e300  # of a number that is shown
LONGEST = 200  # characters of a name or a sentence in a file
RECORDS = (
    "logs of nodes (taciturn node --log), the folder of taciturn network --record, the JSON document of taciturn "
    "network, show --record or twin, the table of a run, or the NetCDF file of a twin (--record)"
)

Marks: TypeAlias = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False, repr=False)
class Trace(Displayed):
    """A recorded signal with one value per step; NaN marks steps that were not recorded."""

    title: str
    values: Array
    other: Array | None = None  # the same signal with every sample
    held: bool = False  # whether it keeps each value until the next step
    bound: bool = False  # whether it is what the nodes certify


@dataclass(frozen=True, eq=False, repr=False)
class Lane(Displayed):
    """The packets of a link."""

    link: str
    sender: str
    receiver: str
    sent: Marks  # whether a packet was sent, (steps,)
    dropped: Marks | None = None  # whether it was sent and has not arrived; None if the receiver was not recorded
    other: Marks | None = None  # whether a packet was sent with every sample
    trigger: Array | None = None  # the value of silence: over that of sending (``ratio``), or minus it
    ratio: bool = True


@dataclass(frozen=True, repr=False)
class Fault(Displayed):
    """A fault, or another event that the theory does not cover, with its first step and the first step after it."""

    name: str
    text: str
    first: int
    end: int
    where: str = ""  # the link or the process
    mild: bool = False  # whether it is the effect of other events, or the recovery from them


@dataclass(frozen=True, eq=False, repr=False)
class Recording(Displayed):
    """The record of a run."""

    name: str
    verdict: Sequence[str]
    first: int = 0  # number of the first step
    steps: int = 0
    period: float | None = None  # seconds of a step
    traces: Sequence[Trace] = ()
    lanes: Sequence[Lane] = ()
    faults: Sequence[Fault] = ()
    compared: tuple[str, str] | None = None  # names of the two paths
    table: tuple[Sequence[str], Sequence[Sequence[str]]] | None = None  # the header and the rows
    notes: Sequence[str] = field(default=())

    def document(self) -> dict[str, Any]:
        """Return the data for the page; of a very long recording, the data contain only the last steps."""
        left_out = max(0, self.steps - STEPS)
        first, last, part = self.first + left_out, self.first + self.steps, slice(left_out, None)
        faults = sorted(self.faults, key=lambda one: (one.mild, one.first, one.end))
        shown = [one for one in faults if one.end > first or not self.steps]
        notes = list(self.notes)
        if left_out:
            notes.append(f"the last {STEPS:,} of {self.steps:,} steps are shown")
        if len(shown) > FAULTS:
            notes.append(f"the first {FAULTS} of {number_of(len(shown), 'fault')} are shown")
        return {
            "name": self.name,
            "verdict": list(self.verdict),
            "first": first,
            "period": self.period,
            "time": [short(step * (self.period or 1.0), 9) for step in range(first, last)],
            "unit": "steps" if self.period is None else "s",
            "compared": self.compared,
            "panels": [
                {
                    "title": one.title,
                    "values": _shown(one.values[part]),
                    "other": None if one.other is None else _shown(one.other[part]),
                    "held": one.held,
                    "bound": one.bound,
                }
                for one in self.traces
            ],
            "lanes": [_lane(one, part) for one in self.lanes],
            "faults": [
                {
                    "name": one.name,
                    "text": one.text,
                    "from": max(0, one.first - first),
                    "to": max(1, min(one.end, last) - first) if self.steps else one.end,
                    "where": one.where,
                    "mild": one.mild,
                }
                for one in shown[:FAULTS]
            ],
            "links": [
                {
                    "link": one.link,
                    "sender": one.sender,
                    "receiver": one.receiver,
                    "loss": 0.0 if one.dropped is None else _share(one.dropped, one.sent.sum()),
                    **histogram(np.diff(np.flatnonzero(one.sent))),
                }
                for one in self.lanes
            ],
            "rates": [_rate(one) for one in self.lanes],
            "table": None if self.table is None else {"head": list(self.table[0]), "rows": [*map(list, self.table[1])]},
            "notes": notes,
        }


def read_recording(paths: Sequence[Path], problem: Problem | None) -> Recording:
    """Read a recorded run from files or a folder: logs of nodes, for which ``problem`` names signals, or run results.

    Raises:
        ProblemError: a file cannot be read, is no record, or has a part that no record has.
    """
    from taciturn_explore.recorded_folder import of_folder
    from taciturn_explore.recorded_nodes import is_log, of_nodes
    from taciturn_explore.recorded_runs import of_document, of_table
    from taciturn_explore.recorded_twins import HDF5, of_twin

    folders = [path for path in paths if any((path / name).is_file() for name in (PACKETS, SIGNALS))]
    if folders and len(paths) == 1:
        return of_folder(paths[0], problem)
    if folders:
        raise ProblemError(
            f"the folder {folders[0]} is given with other records; expected one folder, or the logs of all nodes of "
            "one run"
        )
    contents = [_content(path) for path in paths]
    name = ", ".join(path.name for path in paths)
    name = name if len(name) <= 60 else f"{paths[0].name} and {len(paths) - 1} more"
    binary = [content.startswith(HDF5) for content in contents]
    if len(paths) == 1 and binary[0]:
        return of_twin(name, contents[0])
    texts = ["" if hdf5 else _text(path, one) for path, one, hdf5 in zip(paths, contents, binary, strict=True)]
    logs = [is_log(text) for text in texts]
    if all(logs):
        return of_nodes(name, paths, texts, problem)
    if len(paths) > 1:
        other = paths[logs.index(False)]
        raise ProblemError(
            f"the file {other} is not a log of a node; expected one record, or the logs of all nodes of one run"
        )
    if texts[0].lstrip().startswith("{"):
        try:
            document: object = json.loads(texts[0])
        except (ValueError, RecursionError):
            document = None
        if isinstance(document, dict):
            found = of_document(name, cast("dict[str, Any]", document))
            if found is not None:
                return found
    elif texts[0].startswith("tick,"):
        return of_table(name, paths[0], texts[0])
    raise ProblemError(f"the file {paths[0]} is not the record of a run; expected {RECORDS}")


def is_number(value: object) -> bool:
    """Return whether a JSON value is a number that the page can show."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def is_text(value: object) -> bool:
    """Return whether a JSON value is a text that the page can show."""
    return isinstance(value, str) and len(value) <= LONGEST


def _content(path: Path) -> bytes:
    try:
        return read_bytes(path, MOST)
    except OSError as error:
        raise ProblemError(
            f"the record {quoted(str(path))} cannot be read: {why_unreadable(error)}; expected {RECORDS}"
        ) from None


def _text(path: Path, content: bytes) -> str:
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError:
        raise ProblemError(f"the file {path} is not the record of a run; expected {RECORDS}") from None


def _shown(values: Array) -> list[float | None]:
    return [short(value) if np.isfinite(value) else None for value in values.tolist()]


def _lane(one: Lane, part: slice) -> dict[str, Any]:
    def places(marks: Marks | None) -> list[int]:
        return [] if marks is None else np.flatnonzero(marks[part]).tolist()

    return {
        "link": one.link,
        "sent": places(one.sent),
        "dropped": places(one.dropped),
        "known": one.dropped is not None,
        "timed": None if one.other is None else places(one.other),
        "trigger": None if one.trigger is None else _shown(one.trigger[part]),
        "ratio": one.ratio,
    }


def _rate(one: Lane) -> dict[str, Any]:
    share = _share(one.sent, len(one.sent))
    text = percent(share, 1)
    return {"link": one.link, "share": share, "share_text": text, "text": f"{share:.4g}", "price": 1}


def _share(marks: Marks, whole: int) -> float:
    return float(marks.sum()) / whole if whole else 0.0
