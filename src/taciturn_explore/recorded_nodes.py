"""Read the recorded signals, packets and faults of a run from the log files of its nodes.

A line of a log has the step and what the node did in it (``taciturn_udp.logs``). A packet is *dropped* if the log of
its sender has it and that of its receiver, which covers the step, does not. The logs of receivers have sequence
numbers, and those of senders have none, so the number of the first packet of a life is the one that most of the
arrivals agree on.

Faults follow from the lines: a new epoch is a start without the saved state; steps without a line are steps that a node
did not execute; ``silent_links`` are links on which a node has heard nothing for too long; and ``degraded``, with
``reasons``, are the steps that depend on an event that no theory covers.
"""

from __future__ import annotations

import json
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, number_of, percent
from taciturn.model.names import Names, Role
from taciturn.model.packets import fingerprint
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.study.recorded import Recorded, recorded_silence
from taciturn_explore.recording import Fault, Lane, Recording, Trace, is_number, is_text

LATEST = 2**53  # step from which on numbers of steps are not exact
WIDEST = 2_000_000  # steps between the first and the last line
ENTRIES, LINKS = 16, 64  # largest number of entries of a signal that is shown, and of links of a node
PLANT = "plant"
Line = Mapping[str, Any]


def is_log(text: str) -> bool:
    """Return whether a text begins with a line of a node's log."""
    return _line(text.partition("\n")[0]) is not None


def _lines_role(text: str) -> str:
    line = _line(text.partition("\n")[0])
    return "" if line is None else str(line["role"])


def of_nodes(name: str, paths: Sequence[Path], texts: Sequence[str], problem: Problem | None) -> Recording:
    """Return the record in logs."""
    logs = defaultdict[str, list[list[Line]]](list)
    for path, text in zip(paths, texts, strict=True):
        found = _lines(path, text)
        logs[found[0]["role"]].append(found)
    nodes = {role: _joined(role, parts) for role, parts in logs.items()}
    ticks = [line["tick"] for lines in nodes.values() for line in (lines[0], lines[-1])]
    first, steps = min(ticks), max(ticks) - min(ticks) + 1
    if steps > WIDEST:
        raise ProblemError(f"the logs span {steps:,} steps; expected at most {WIDEST:,} steps: shorten the logs")
    policy = _policy(nodes, problem)
    own = [path for path, text in zip(paths, texts, strict=True) if _lines_role(text) != PLANT]
    silence, why = _silence(own, problem, policy)
    lanes = list(_lanes(nodes, first, steps))
    faults = [fault for role, lines in nodes.items() for fault in _faults(role, lines, first + steps)]
    certified = list[Trace]()
    if silence is not None and len(silence.ratios):
        certified.append(
            Trace("extra cost certified by the nodes: at most, in %", 100 * (silence.ratios - 1), bound=True)
        )
    elif silence is not None and len(silence.roots):
        certified.append(Trace("silence has changed √J: at most, certified by the nodes", silence.roots, bound=True))
    certified = [one for one in certified if len(one.values) == steps]
    traces = list(_traces(nodes, first, steps, silence, policy, problem))
    compared = ("recorded", "every sample, same noise") if any(one.other is not None for one in traces) else None
    known = silence is not None and (silence.certificate is not None or silence.cost is not None)
    verdict = silence.verdict if silence is not None and known else _verdict(nodes, lanes, faults, steps)
    told = [] if silence is None else [note for note in silence.notes if note not in verdict]
    return Recording(
        name, verdict, first, steps, _period(nodes), [*traces, *certified], lanes, faults, compared,
        notes=[*why, *told],
    )  # fmt: skip


def _line(row: str) -> Line | None:
    """Return a line of a log, checked; None if it is none."""
    try:
        given: object = json.loads(row)
    except (ValueError, RecursionError):
        return None
    if not isinstance(given, dict):
        return None
    line = cast("dict[str, Any]", given)
    tick, links = line.get("tick"), cast("object", line.get("silent_links", []))
    whole = all(type(line.get(name, 0)) is int for name in ("epoch", "loop"))
    if type(tick) is not int or not 0 <= tick < LATEST or not is_text(line.get("role")) or not whole:
        return None
    if not is_number(line.get("timestamp")) or not isinstance(links, list) or len(cast("list[object]", links)) > LINKS:
        return None
    return line if all(map(is_text, cast("list[object]", links))) and all(map(_fits, line.items())) else None


def _fits(entry: tuple[str, object]) -> bool:
    """Return whether an entry of a line has the type that its name tells."""
    name, value = entry
    if len(name) > 200:
        return False
    if name.startswith(("sent_", "option_")) or name == "degraded":
        return is_number(value)
    if name.startswith("arrived_") or name in ("y", "u", "x"):
        listed = cast("list[object]", value if isinstance(value, list) else [""])
        listed = [one for one in listed if one is not None] if name == "y" else listed  # None: a missing sample
        return all(map(is_number, listed)) and (name[0] != "a" or all(type(one) is int for one in listed))
    if name == "reasons":
        return isinstance(value, dict) and all(map(is_number, cast("dict[str, object]", value).values()))
    return True


def _lines(path: Path, text: str) -> list[Line]:
    """Return the lines of the first loop in a log; the last line may be cut, as a killed process leaves it."""
    rows, found = text.rstrip().split("\n"), list[Line]()
    for number, row in enumerate(rows, 1):
        line = _line(row)
        if line is None and number == len(rows) and found:
            break
        if line is None or (found and line["role"] != found[0]["role"]):
            raise ProblemError(
                f"line {number} of {path} is not a line of a node's log; expected JSON with the step, the time and "
                "the role of a node, the same in every line, as `taciturn node --log` writes"
            )
        if line.get("loop", 0) == 0:
            found.append({key: value for key, value in line.items() if key != "memory"})
    if not found:
        raise ProblemError(f"the log {path} has no line of loop 0; expected a line for each step of a node")
    return found


def _joined(role: str, parts: list[list[Line]]) -> list[Line]:
    """Return the lines of the logs of a node in the order of their steps."""
    found = [line for part in sorted(parts, key=lambda part: part[0]["tick"]) for line in part]
    for line, after in pairwise(found):
        if after["tick"] <= line["tick"]:
            raise ProblemError(
                f"the logs of {role} go back from step {line['tick']} to step {after['tick']}; expected the logs of "
                "one run, and each log only once"
            )
    links = {key for line in found for key in line if key.startswith(("sent_", "arrived_"))}
    if len(links) > LINKS:
        raise ProblemError(f"the log of {role} names {number_of(len(links), 'link')}; expected at most {LINKS} links")
    return found


def _period(nodes: Mapping[str, Sequence[Line]]) -> float | None:
    """Return the seconds of a step; None if the time is that in steps."""
    found = [line["timestamp"] / line["tick"] for lines in nodes.values() for line in lines[-1:] if line["tick"] > 0]
    return found[0] if found and found[0] > 0 and found[0] != 1.0 else None


def _policy(nodes: Mapping[str, Sequence[Line]], problem: Problem | None) -> Policy | None:
    """Return the policy of a problem, if the logs are those of its nodes."""
    told = {line["fingerprint"] for lines in nodes.values() for line in lines if "fingerprint" in line}
    if problem is None or len(told) != 1:
        return None
    try:
        policy = problem.designed()
    except ProblemError:
        return None
    same = isinstance(policy, Policy) and told == {f"{fingerprint(policy, problem.network):016x}"}
    return cast("Policy", policy) if same else None


def _silence(
    paths: Sequence[Path], problem: Problem | None, policy: Policy | None
) -> tuple[Recorded | None, Sequence[str]]:
    """Return what silence has cost, or the reason why it is not known."""
    if policy is None or problem is None:
        return None, (
            "no certificate and no path with every sample: they need the problem file that the nodes ran, as in "
            "taciturn explore FILE --recording LOG",
        )
    if not policy.theory.silence:
        return None, (f"{policy.kind} does not measure what its silence costs",)
    try:
        return recorded_silence(problem, paths), ()
    except ProblemError as error:
        return None, (str(error),)


def _column(lines: Iterable[Line], name: str, index: int, first: int, steps: int) -> Array:
    """Return an entry of a signal by step, NaN where it was not recorded."""
    found = np.full(steps, np.nan)
    for line in lines:
        row = line.get(name, ())
        if index < len(row) and row[index] is not None:
            found[line["tick"] - first] = row[index]
    return found


def _traces(
    nodes: Mapping[str, Sequence[Line]],
    first: int,
    steps: int,
    silence: Recorded | None,
    policy: Policy | None,
    problem: Problem | None,
) -> Iterator[Trace]:
    """Yield what the nodes measured, then what they applied; without nodes, what the plant did."""
    rows = {
        (role, name): max(len(line.get(name, ())) for line in lines)
        for role, lines in nodes.items()
        for name in ("y", "u", "x")
        if any(name in line for line in lines)
    }
    for signal, verb in (("y", "measured"), ("x", "state"), ("u", "applied")):
        owners = [role for role, name in rows if name == signal]
        if len(owners) > 1 and PLANT in owners:  # what nodes applied is what the plant was given
            owners.remove(PLANT)
        if signal == "x" and any(name == "y" for _, name in rows):
            continue
        for role in owners:
            many = rows[role, signal]
            places = _places(policy, role, signal, many)
            for k in range(min(many, ENTRIES)):
                values = _column(nodes[role], signal, k, first, steps)
                given = (problem.names if problem is not None else None) or Names()
                title = f"{signal}{k + 1 if many > 1 else ''}, {verb} by {role}"
                if signal == "x":
                    title = given.labels("states", [f"state x{i + 1}" for i in range(many)])[k]
                other = None
                if places is not None and problem is not None:
                    stated: Role = "outputs" if signal == "y" else "inputs"
                    title = given.labels(stated, [title] * (places[k] + 1))[-1]
                    if silence is not None:
                        other = silence.outputs.get(f"{signal}{places[k] + 1}_every_sample")
                fits = other is not None and len(other) == steps
                yield Trace(title, values, other if fits else None, held=signal == "u")


def _places(policy: Policy | None, role: str, signal: str, many: int) -> list[int] | None:
    """Return the numbers of a node's measurements or inputs among all of the plant; None if they are not known."""
    if policy is None or signal == "x" or role not in policy.network.nodes:
        return None
    owned = policy.measured if signal == "y" else policy.applied
    found = [i for node, held in owned.values() if node in policy.site(role) for i in held]
    return found if len(found) == many else None


def _lanes(nodes: Mapping[str, Sequence[Line]], first: int, steps: int) -> Iterator[Lane]:
    """Yield the packets of each link."""
    ends = {"sent_": dict[str, str](), "arrived_": dict[str, str]()}
    for role, lines in nodes.items():
        for key in dict.fromkeys(key for line in lines for key in line):
            for prefix, links in ends.items():
                if key.startswith(prefix):
                    links[key.removeprefix(prefix)] = role
    for link in dict.fromkeys([*ends["sent_"], *ends["arrived_"]]):
        sender, receiver = ends["sent_"].get(link), ends["arrived_"].get(link)
        marks, dropped = np.zeros(steps, dtype=bool), None
        heard: Sequence[Line] = () if receiver is None else nodes[receiver]
        arrivals = [(line["tick"], number) for line in heard for number in line.get(f"arrived_{link}", ())]
        if sender is None:  # the arrivals are all that is known
            marks[[tick - first for tick, _ in arrivals]] = True
            yield Lane(link, "?", str(receiver), marks)
            continue
        sends = [(line["tick"], line.get("epoch", 0)) for line in nodes[sender] if line.get(f"sent_{link}")]
        marks[[tick - first for tick, _ in sends]] = True
        if receiver is not None:
            dropped = np.zeros(steps, dtype=bool)
            last, came = nodes[receiver][-1]["tick"], arrived(sends, arrivals)
            dropped[
                [tick - first for (tick, _), here in zip(sends, came, strict=True) if not here and tick <= last]
            ] = True
        alone = sum(links == sender for links in ends["sent_"].values()) == 1
        trigger, ratio = _trigger(nodes[sender], link, alone, first, steps)
        yield Lane(link, sender, receiver or "?", marks, dropped, None, trigger, ratio)


def arrived(sends: Sequence[tuple[int, int]], arrivals: Sequence[tuple[int, int]]) -> list[bool]:
    """Find the packets that arrived, by comparing the logged sends with the logged sequence numbers of arrivals."""
    ticks, begins = [tick for tick, _ in sends], [0]
    begins += [k for k, (before, one) in enumerate(pairwise(sends), 1) if one[1] != before[1]]
    votes: list[Counter[int]] = [Counter() for _ in begins]
    for tick, number in arrivals:
        latest = bisect_right(ticks, tick) - 1  # of the packets so far; without a delay, it is the one that arrives
        if latest >= 0:
            life = bisect_right(begins, latest) - 1
            votes[life][number - (latest - begins[life])] += 1
    offsets = [counted.most_common(1)[0][0] if counted else 0 for counted in votes]
    found = [False] * len(sends)
    for tick, number in arrivals:
        latest = bisect_right(ticks, tick) - 1
        newest = bisect_right(begins, latest) - 1
        for life in range(newest, max(-1, newest - 2), -1):  # a packet of the life before may arrive late
            place = begins[life] + number - offsets[life]
            if begins[life] <= place <= latest and not found[place]:
                found[place] = True
                break
    return found


def _trigger(lines: Sequence[Line], link: str, alone: bool, first: int, steps: int) -> tuple[Array | None, bool]:
    """Return the value of silence over that of sending, or minus it where that is not positive; None if neither is."""
    keys = dict.fromkeys(key for line in lines for key in line if key.startswith("option_"))
    decided = [key.removesuffix("_silent") for key in keys if key.endswith("_silent")]
    own = [name for name in decided if name == f"option_send_{link}"] or (
        decided if alone and len(decided) == 1 else []
    )
    if not own:
        return None, True
    silent, sending = (
        f"{own[0]}_silent",
        [key for key in keys if key.startswith(f"{own[0]}_") and not key.endswith("_silent")],
    )
    waits, sends = np.full(steps, np.nan), np.full(steps, np.nan)
    for line in lines:
        values = [line[key] for key in sending if key in line]
        if silent in line and values:
            waits[line["tick"] - first], sends[line["tick"] - first] = line[silent], min(values)
    if np.isnan(waits).all():
        return None, True
    return (waits / sends, True) if np.nanmin(sends) > 0 else (waits - sends, False)


def _faults(role: str, lines: Sequence[Line], end: int) -> Iterator[Fault]:
    """Yield the faults in the log of a node."""
    for before, line in pairwise(lines):
        gap, fresh = (before["tick"] + 1, line["tick"]), before.get("epoch", 0) != line.get("epoch", 0)
        without = f"executed no step from {gap[0]} to {gap[1] - 1}" if gap[1] > gap[0] else ""
        if fresh:
            text = f"the {role} {without}{' and ' if without else ''}started again without its state: a new epoch"
            yield Fault(f"{role} killed" if without else f"{role} started again", text, gap[0], gap[1] + 1, role)
        elif without:
            yield Fault(
                f"{role} stopped",
                f"the {role} {without}: it was suspended, started again with its state, or its clock jumped",
                *gap, role,
            )  # fmt: skip
    for link in dict.fromkeys(link for line in lines for link in line.get("silent_links", ())):
        for begin, after in _runs([link in line.get("silent_links", ()) for line in lines]):
            text = f"the {role} has heard nothing on the link {link} for too long: no packet and no mark"
            yield Fault(f"{link} cut", text, lines[begin]["tick"], lines[after - 1]["tick"] + 1, link)
    for begin, after in _runs([bool(line.get("degraded")) for line in lines]):
        continued = begin > 0 and lines[begin - 1].get("epoch") == lines[begin].get("epoch")
        known, news = Counter[str](lines[begin - 1].get("reasons", {}) if continued else {}), Counter[str]()
        for line in lines[begin:after]:
            now = Counter[str](line.get("reasons", {}))
            news += now - known if sum(now.values()) >= sum(known.values()) else now
            known = now
        told = ", ".join(f"{name} ({count:g})" for name, count in news.items()) or "an earlier event"
        text = f"the {role} depends on events that no theory covers: {told}"
        yield Fault(
            f"{role} degraded", text, lines[begin]["tick"], min(end, lines[after - 1]["tick"] + 1), role, mild=True
        )


def _runs(marks: Sequence[bool]) -> Iterator[tuple[int, int]]:
    """Yield the ranges of marks that follow each other."""
    changes = np.flatnonzero(np.diff(np.array([False, *marks, False], dtype=np.int8))).tolist()
    yield from zip(changes[::2], changes[1::2], strict=True)


def _verdict(
    nodes: Mapping[str, Sequence[Line]], lanes: Sequence[Lane], faults: Sequence[Fault], steps: int
) -> list[str]:
    """Return what happened: packets, and faults by their names."""
    sent = sum(int(lane.sent.sum()) for lane in lanes if lane.dropped is not None)
    lost = sum(int(lane.dropped.sum()) for lane in lanes if lane.dropped is not None)
    shares = [f"{lane.link} sent in {percent(lane.sent.mean(), 1)}" for lane in lanes[:3]]
    told = number_of(steps, "step") + (f": {', '.join(shares)}" if shares else "")
    counted = Counter(one.name for one in faults if not one.mild)
    events = ", ".join(name if n == 1 else f"{name} ({n} times)" for name, n in counted.most_common(5))
    return [told + (f"; {lost} of {number_of(sent, 'packet')} dropped" if sent else ""), *([events] if events else [])]
