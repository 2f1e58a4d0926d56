"""Read the record of a run in a folder, ``packets.csv`` and ``signals.csv`` (``taciturn network --record``).

A page shows the measurements, the inputs and the set-points of each step, and the packets of each link. A packet that
was neither delivered nor late when the record ended counts as dropped only if the record says ``lost``. The last line
of a file may be cut, if the run was ended at once.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import number_of, percent, quoted, read_text, why_unreadable
from taciturn.model.names import Names, Role
from taciturn.model.packets import receiver_of, sender_of
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn_explore.recording import LARGEST, LONGEST, MOST, Fault, Lane, Marks, Recording, Trace
from taciturn_udp.record import EVENTS, HEAD, PACKETS, SIGNALS

LINKS, ENTRIES, STEPS = 64, 64, 2_000_000  # largest numbers of links, of signals, and of steps
KINDS: dict[str, tuple[str, Role]] = {"y": ("measured", "outputs"), "u": ("applied", "inputs")}


def of_folder(folder: Path, problem: Problem | None) -> Recording:
    """Read the record in a folder; ``problem`` gives the names of signals and the ends of links.

    Raises:
        ProblemError: a file is missing or cannot be read, or has a line or a column that no record has.
    """
    path = folder / SIGNALS
    head, rows = _table(path)
    if tuple(head[:2]) != ("time", "step") or len(head) > ENTRIES:
        raise ProblemError(
            f"{path} has the columns {', '.join(head[:6])[:120]}; expected time, step, and the signals that "
            "`taciturn network --record` writes"
        )
    values = np.array([[_number(path, number, one) for one in row] for number, row in rows]).reshape(-1, len(head))
    steps = len(values)
    if not 0 < steps <= STEPS or not (np.abs(values[:, 1]) <= 2**53).all() or (np.diff(values[:, 1]) != 1).any():
        raise ProblemError(
            f"{path} has {number_of(steps, 'row')}, or steps that do not follow each other; expected one row for each "
            f"of at most {STEPS} steps"
        )
    first = int(values[0, 1])
    lanes, late, arrived = _lanes(folder / PACKETS, first, steps, problem)
    sent = sum(int(lane.sent.sum()) for lane in lanes)
    lost = sum(0 if lane.dropped is None else int(lane.dropped.sum()) for lane in lanes)
    shares = [f"{lane.link} sent in {percent(lane.sent.mean(), 1)}" for lane in lanes[:3]]
    told = [f"{lost} of {number_of(sent, 'packet')} dropped", f"{late.total()} of {arrived} late"] if sent else []
    verdict = "; ".join([number_of(steps, "step") + (f": {', '.join(shares)}" if shares else ""), *told])
    faults = [
        Fault(f"late on {link}", f"a packet of step {step} on the {link} link arrived late", step, step + 1, link, True)
        for link, step in late
        if first <= step < first + steps
    ]
    times = values[:, 0]
    period = float(times[-1] - times[0]) / (steps - 1) if steps > 1 and times[-1] > times[0] else None
    return Recording(
        str(folder.name) or str(folder), [verdict], first, steps, None if period == 1.0 else period,
        list(_traces(head, values, problem)), lanes, faults,
        notes=["a record has no memory of the nodes: their logs (taciturn node --log) have certificates and triggers"],
    )  # fmt: skip


def _traces(head: Sequence[str], values: np.ndarray, problem: Problem | None) -> Iterator[Trace]:
    """Yield a trace for each signal, with the names of the problem if it has as many."""
    names = (problem.names if problem is not None else None) or Names()
    for letter, (verb, role) in KINDS.items():
        own = [i for i, name in enumerate(head) if name[:1] == letter and name[1:].isdigit()]
        titles = [f"{head[i]}, {verb}" for i in own]
        for i, title in zip(own, names.labels(role, titles), strict=True):
            yield Trace(title, values[:, i], held=letter == "u")
    for i, name in enumerate(head):
        if name.startswith("set_point"):
            yield Trace(name.replace("_", "-")[:LONGEST], values[:, i], held=True)


def _lanes(
    path: Path, first: int, steps: int, problem: Problem | None
) -> tuple[list[Lane], Counter[tuple[str, int]], int]:
    """Return the packets of each link, the late ones by link and step, and the number of those that arrived."""
    head, rows = _table(path)
    if tuple(head) != HEAD:
        raise ProblemError(f"{path} has the columns {', '.join(head)[:120]}; expected {', '.join(HEAD)}")
    sent, dropped, late, arrived = dict[str, Marks](), dict[str, Marks](), Counter[tuple[str, int]](), 0
    for number, (_, step_text, link, event, *_) in rows:
        step = _number(path, number, step_text)
        if event not in EVENTS or not link or len(link) > LONGEST or step != int(step) or len(sent) > LINKS:
            raise ProblemError(
                f"line {number} of {path} has the event {event[:40]!r} on the link {link[:40]!r}; expected one of "
                f"{', '.join(EVENTS)} on one of at most {LINKS} links, and the step of a packet"
            )
        place = int(step) - first
        for marks in (sent, dropped):
            marks.setdefault(link, np.zeros(steps, dtype=bool))
        arrived += event in ("delivered", "late")
        late[link, int(step)] += event == "late"
        if 0 <= place < steps and event in ("sent", "lost"):
            (sent if event == "sent" else dropped)[link][place] = True
    late = +late
    return [Lane(link, *_ends(link, problem), marks, dropped[link]) for link, marks in sent.items()], late, arrived


def _ends(link: str, problem: Problem | None) -> tuple[str, str]:
    """Return the sender and the receiver of a link, if the problem has this link."""
    try:
        policy = None if problem is None else problem.designed()
    except ProblemError:
        return "?", "?"
    if not isinstance(policy, Policy) or link not in policy.network.links:
        return "?", "?"
    return sender_of(policy, link), receiver_of(policy, link)


def _table(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the first row of a file, and the other rows with the numbers of their lines."""
    try:
        text = read_text(path, MOST)
    except (OSError, ValueError) as error:
        raise ProblemError(
            f"the record {quoted(str(path))} cannot be read: {why_unreadable(error)}; expected a folder that "
            "`taciturn network --record` has written"
        ) from None
    lines = text.split("\n")[:-1]  # without the end of a line, a row is not whole
    try:
        rows = list(csv.reader(lines))
    except csv.Error:
        rows = list[list[str]]()
    if not rows or len(rows) != len(lines):
        raise ProblemError(
            f"{path} is no table with a row on each line; expected a file that `taciturn network --record` has written"
        )
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(rows[0]):
            raise ProblemError(
                f"line {number} of {path} has {number_of(len(row), 'entry')}; expected {len(rows[0])}, one for each "
                "column"
            )
    return rows[0], list(enumerate(rows[1:], 2))


def _number(path: Path, line: int, text: str) -> float:
    """Return a number of a table, NaN for an empty entry."""
    try:
        found = float(text) if text else np.nan
    except ValueError:
        found = np.inf
    if abs(found) > LARGEST:
        raise ProblemError(f"line {line} of {path} has {text[:40]!r}; expected a finite number, or an empty entry")
    return found
