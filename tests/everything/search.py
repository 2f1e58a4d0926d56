"""Which problems are examined: pairs of features first, then more features at once; and how a failing one shrinks.

The table of pairs counts what was drawn, accepted, refused and without place. Problems are numbered: number ``i`` of a
seed is always the same problem, so a run can be interrupted, resumed and divided among processes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from everything.checks import EXPENSIVE, Fault, Report, examine
from everything.delays import RANDOM_INPUTS
from everything.draft import Elsewhere, write
from everything.features import FEATURES, build, by_name
from everything.fingerprints import differing
from everything.toml import text_of

MOST = 6  # features of a deep problem beside its kind
TRIES = 30  # draws of a deep problem until its features find a place
ROTATION = 4
"""One of so many problems has an expensive check: each in turn, or the next that exists for the problem; and of one of
so many what is signed is compared under several seeds of hashes."""


@dataclass
class Outcome:
    """What became of one problem.

    Args:
        number: its number.
        names: its features.
        drawn: whether a problem was built at all.
        report: what was found.
        smallest: the features of the smallest problem with each fault, and its file.
    """

    number: int
    names: tuple[str, ...]
    drawn: bool
    report: Report
    smallest: dict[str, tuple[tuple[str, ...], str]] = field(default_factory=dict)


@cache
def pairs(seed: int) -> tuple[tuple[str, str], ...]:
    """Return every pair of features that can be in one problem, in the order of a seed."""
    names = [(a.name, b.name) for a, b in combinations(FEATURES, 2) if a.group != b.group]
    order = np.random.default_rng([seed, 1]).permutation(len(names))
    return tuple(names[i] for i in order)


def seed_of_problem(seed: int, number: int) -> int:
    """Return the seed with which a numbered problem is built and examined."""
    return int(np.random.default_rng([seed, 3, number]).integers(2**31))


def features_of(seed: int, number: int) -> tuple[str, ...]:
    """Return the features of a numbered problem: a pair, and later more."""
    listed = pairs(seed)
    rng = np.random.default_rng([seed, 2, number])
    if number < len(listed):
        chosen = list(listed[number])
        return complete(chosen, rng)
    own, names = seed_of_problem(seed, number), tuple[str, ...]()
    for again in range(TRIES):  # most sets of features find no place in one problem
        names = _deep(np.random.default_rng([seed, 2, number, again]))
        if is_placed(names, own):
            break
    return names


def _deep(rng: np.random.Generator) -> tuple[str, ...]:
    """Return several features of different groups, with what they need."""
    chosen: list[str] = []
    count = int(rng.integers(3, MOST + 1))
    groups: set[str] = set()
    for i in rng.permutation(len(FEATURES)):
        feature = FEATURES[i]
        if feature.group not in groups and len(chosen) < count:
            groups.add(feature.group)
            chosen.append(feature.name)
    return complete(chosen, rng)


def is_placed(names: tuple[str, ...], own: int) -> bool:
    """Tell whether features find a place in one problem."""
    try:
        build(names, own)
    except Elsewhere:
        return False
    return True


NEEDS: Mapping[str, tuple[str, ...]] = {
    "link probe": ("one sensor by name", "two sensors"),
    "link valve": ("one sensor by name", "two actuators"),
    "nodes": ("one sensor by name", "wired sensor", "two sensors", "four nodes"),
    "controller": ("proportional and integral", "PID", "linear controller"),
    "pid": ("proportional and integral", "PID"),
    "reference": ("set-point",),
    "controlled": ("gain", "proportional", "linear controller"),
    "every path": ("every path", "proportional and integral", "PID", "linear controller"),
}
"""What some features need beside them, from which one is drawn."""
REQUIRED: Mapping[str, str] = {
    "lossy probes": "link probe", "rounded probes": "link probe", "energy of probes": "link probe",
    "unacknowledged": "nodes", "lossy valves": "link valve", "bursty valves": "link valve", "prices": "link valve",
    "shares": "nodes", "weights of the set-point": "pid", "tracking time": "pid", "start input": "pid",
    "inputs for set-points": "reference",
    "no drift": "controller", "stated drift": "controller", "weights as the controller": "controller",
    "controller's set-point": "controller", "controller per second": "linear",
    "bank": "every path", "relative bank": "every path", "relative bank of a share": "every path",
    "threshold of silence": "every path", "spending": "every path", "range of gains": "every path",
    "late probes": "link probe", "probes in buffers": "link probe", "probes too late": "link probe",
    "probes at random times": "link probe", "acknowledged probes at random times": "link probe",
    "valves at random times": "link valve", "acknowledged valves at random times": "link valve",
    "samples at random times": "controlled", "sensor at random times": "controlled",
    "late valves": "link valve", "valves too late": "link valve",
    "inputs told late": "controller", "losses told late": "controller", "sets of valves told late": "controller",
}  # fmt: skip
PARTNERS: Mapping[str, tuple[str, ...]] = {
    "terminal weight": ("horizon",), "trajectory": ("horizon", "kind lossy-lqg", "measured state"),
    "some inputs without cost": ("two inputs",),
    "normal jumps": ("continuous",), "uniform jumps": ("continuous",), "two-point jumps": ("continuous",),
    "two sensors": ("two outputs",), "two wired sensors": ("two outputs",), "two actuators": ("two inputs",),
    "actuators of a wired sensor": ("two inputs",), "four nodes": ("two outputs", "two inputs"),
    "inputs for set-points": ("linear controller",), "controller per second": ("linear controller",),
    "kind lossy-lqg": ("measured state",), "kind consistent": ("continuous", "measured state"),
    "kind integral": ("continuous", "measured state"), "kind optimal": ("measured state",),
    "kind event-pid": ("PID",), "kind event-pid-saturated": ("PID",),
    "kind symmetric-send-on-delta": ("proportional and integral",),
    "relative bank": ("variances",), "relative bank of a share": ("variances",),
    "each link for itself": ("two inputs", "two actuators", "every path"),
    "probes of different delays": ("two outputs", "two sensors"),
    "valves of different delays": ("two inputs", "two actuators"),
    "samples late by a part": ("continuous",), "inputs late by a part": ("continuous",),
    "inputs late by more": ("continuous",), "inputs too late by a part": ("continuous",),
    "probes at random times": ("gain",), "acknowledged probes at random times": ("gain",),
    "inputs at random parts": ("continuous",), "acknowledged inputs at random parts": ("continuous",),
    "inputs by a trace": ("continuous",), "inputs by a histogram": ("continuous",),
    "acknowledged sets of valves": ("two inputs", "actuators of a wired sensor"),
    "late sets of valves": ("continuous", "two inputs", "actuators of a wired sensor"),
    "sets of valves told late": ("two inputs", "actuators of a wired sensor", "linear controller"),
    "acknowledged samples at random times": ("sensor decides",),
    "inputs told late": ("linear controller",), "losses told late": ("linear controller",),
    "probes late by a part": ("continuous", "two outputs", "two sensors"),
    "valves late by a part": ("continuous", "two inputs", "two actuators"),
}  # fmt: skip
KINDS_FOR: Mapping[str, tuple[str, ...]] = {
    "horizon": ("excess", "remote-lqg", "lossy-lqg"), "discount": ("excess", "remote-lqg"),
    "two sensors": ("distributed", "send-on-delta", "variance"), "two actuators": ("distributed", "send-on-delta"),
    "four nodes": ("distributed", "send-on-delta"), "one sensor by name": ("distributed", "send-on-delta"),
    "wired sensor": ("distributed", "excess", "lqg"), "two wired sensors": ("distributed", "excess", "lqg"),
    "actuators of a wired sensor": ("excess", "lqg", "distributed"), "wired actuator": ("distributed", "variance"),
    "losses": ("lossy-lqg", "distributed", "excess"), "acknowledged losses": ("excess", "lossy-lqg"),
    "acknowledged losses of sensors": ("excess", "lossy-lqg"), "bursts": ("excess", "lossy-lqg"),
    "bursts by a chain": ("excess", "lossy-lqg"), "bursts without acknowledgement": ("lossy-lqg", "excess"),
    "delay": ("lossy-lqg",), "samples too late": ("lossy-lqg", "distributed", "excess"),
    "inputs too late": ("lossy-lqg", "distributed", "excess"), "inputs too late by a part": ("distributed", "excess"),
    "samples at random times": ("distributed",), "sensor at random times": ("distributed",),
    "probes at random times": ("distributed",), "acknowledged probes at random times": ("distributed",),
    "valves at random times": ("distributed",), "acknowledged valves at random times": ("distributed",),
    "acknowledged sets of valves": ("excess",), "late sets of valves": ("excess",),
    "sets of valves told late": ("excess",), "acknowledged samples at random times": ("excess",),
    **dict.fromkeys(RANDOM_INPUTS, ("excess", "excess", "distributed", "all-time", "periodic")),
    "probes too late": ("distributed",), "valves too late": ("distributed",),
    "proportional and integral": ("excess", "send-on-delta", "distributed", "all-time", "periodic"),
    "PID": ("excess", "event-pid", "distributed", "all-time", "periodic"),
    "proportional": ("excess", "send-on-delta", "distributed", "all-time", "periodic"),
    "gain": ("excess", "send-on-delta", "distributed", "all-time", "periodic"),
    "linear controller": ("excess", "send-on-delta", "distributed", "all-time", "periodic"),
    "linear controller that is told": ("excess", "send-on-delta", "distributed", "all-time", "periodic"),
    "positive sign": ("excess", "send-on-delta", "distributed", "all-time", "periodic"),
    "predicted probes": ("distributed",),
    "joint": ("distributed",), "shares": ("distributed", "send-on-delta"),
    "sensor decides": ("excess", "send-on-delta"), "actuator link": ("send-on-delta", "excess"),
    "slower base": ("excess",), "gains for losses": ("excess",), "retry": ("excess",), "plan": ("excess",),
    "separate trigger": ("lqg",),
    "error of the state": ("absolute",), "threshold itself": ("excess", "consistent", "distributed"),
    "a cycle": ("periodic",), "controller at the actuator": ("remote-lqg",),
    "controller at the sensor": ("remote-lqg",), "longest silence": ("event-pid",), "every path": ("distributed",),
    "bank": ("distributed",), "relative bank": ("distributed",), "relative bank of a share": ("distributed",),
    "threshold of silence": ("distributed",), "spending": ("distributed",), "range of gains": ("distributed",),
    "each link for itself": ("distributed",),
}  # fmt: skip

KEEPING = ("distributed", "excess", "send-on-delta", "all-time", "periodic", "event-pid", "symmetric-send-on-delta")
FOLLOWED = frozenset({"changes", "set-point limits", "outputs to follow"})
"""Groups of what a given controller has with some kinds only."""


def complete(chosen: Iterable[str], rng: np.random.Generator) -> tuple[str, ...]:
    """Return features with what they need beside them, and with a kind for which they are made."""
    found, known = list(dict.fromkeys(chosen)), by_name()

    def add(name: str) -> None:
        if all(known[one].group != known[name].group for one in found):
            found.append(name)

    for _ in range(3):
        for name in tuple(found):
            need = REQUIRED.get(name)
            if need == "linear":
                add("linear controller")
            elif need is not None and not any(one in found for one in NEEDS[need]):
                add(str(rng.choice(NEEDS[need])))
            for partner in PARTNERS.get(name, ()):
                add(partner)
    groups = {known[name].group for name in found}
    if "controller" in groups and groups & FOLLOWED:
        add(f"kind {rng.choice([*KEEPING])}")
    wishes = [kind for name in found for kind in KINDS_FOR.get(name, ())]
    if wishes:
        add(f"kind {rng.choice(wishes)}")
    elif rng.random() < 0.7:
        kinds = [one.name for one in FEATURES if one.group == "kind"]
        add(str(rng.choice(kinds)))
    for name in tuple(found):  # of the kind
        for partner in PARTNERS.get(name, ()):
            add(partner)
    return tuple(found)


def draw(seed: int, number: int) -> Outcome:
    """Examine a numbered problem, and shrink it if it fails."""
    names, own = features_of(seed, number), seed_of_problem(seed, number)
    turn = number // ROTATION % len(EXPENSIVE)
    more = EXPENSIVE[turn:] + EXPENSIVE[:turn] if number % ROTATION == 0 else ()
    report = tried(names, own, more)
    outcome = Outcome(number, names, report is not None, report or Report())
    if report is None:
        return outcome
    for fault in report.faults:
        made = tuple(name for name in more if name in report.compared or fault.check.startswith(name))
        smaller = shrunk(names, lambda fewer, fault=fault, made=made: fails(fewer, own, made, fault))
        outcome.smallest[fault.check] = (smaller, file_of(smaller, own))
    return outcome


def hashed(seed: int, numbers: Iterable[int]) -> list[Outcome]:
    """Return those of numbered problems of which something that is signed depends on the order of a hash."""

    def different(problems: Iterable[tuple[Iterable[str], int]]) -> dict[int, str]:
        with TemporaryDirectory() as folder:
            files: list[Path] = []
            for i, (names, own) in enumerate(problems):
                (place := Path(folder) / str(i)).mkdir()
                drawn = build(tuple(names), own)
                files.append(write(drawn, place, text_of(drawn.tables)))
            return differing(files)

    def still(fewer: tuple[str, ...], own: int) -> bool:
        try:
            return bool(different([(fewer, own)]))
        except Elsewhere:
            return False

    listed = [(number, features_of(seed, number), seed_of_problem(seed, number)) for number in numbers]
    outcomes: list[Outcome] = []
    for i, text in different((names, own) for _, names, own in listed).items():
        number, names, own = listed[i]
        smaller = shrunk(names, lambda fewer, own=own: still(fewer, own))
        report = Report(faults=[Fault("hash seeds", text)])
        outcomes.append(Outcome(number, names, True, report, {"hash seeds": (smaller, file_of(smaller, own))}))
    return outcomes


def tried(names: Iterable[str], seed: int, more: tuple[str, ...]) -> Report | None:
    """Return the report of a problem, or None if its features find no place."""
    with TemporaryDirectory() as folder:
        try:
            drawn = build(tuple(names), seed)
        except Elsewhere:
            return None
        write(drawn, Path(folder), text_of(drawn.tables))
        return examine(drawn.tables, Path(folder), seed, more)


def file_of(names: Iterable[str], seed: int) -> str:
    """Return the file of a problem, with the files that it names as comments."""
    drawn = build(tuple(names), seed)
    beside = [
        f"# {name}:\n" + "".join(f"#   {line}\n" for line in text.splitlines()) for name, text in drawn.files.items()
    ]
    return "".join(beside) + text_of(drawn.tables)


def fails(names: tuple[str, ...], seed: int, more: tuple[str, ...], fault: Fault) -> bool:
    """Tell whether a problem has the same fault."""
    report = tried(names, seed, more)
    return report is not None and any(one.check == fault.check for one in report.faults)


def shrunk(names: tuple[str, ...], still: Callable[[tuple[str, ...]], bool]) -> tuple[str, ...]:
    """Return the names without those that a fault does not need, left out one at a time."""
    kept, changed = names, True
    while changed:
        changed = False
        for name in kept:
            fewer = tuple(one for one in kept if one != name)
            if still(fewer):
                kept, changed = fewer, True
                break
    return kept


@dataclass
class Tally:
    """What was drawn, and what became of it.

    Args:
        done: numbers of the problems that were examined.
        counts: for each pair of features: accepted, refused, without place.
        faults: by the name of the check and the features of the smallest problem.
        compared: how often each check was made, and how often a problem had none, by the reason.
        reasons: the sentence of a refusal, for each pair that was never accepted.
        unhashed: numbers of accepted problems whose fingerprints are to be compared.
    """

    done: set[int] = field(default_factory=set)
    counts: dict[str, list[int]] = field(default_factory=dict)
    faults: dict[str, dict[str, Any]] = field(default_factory=dict)
    compared: dict[str, int] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    unhashed: list[int] = field(default_factory=list)

    def add(self, outcome: Outcome) -> list[str]:
        """Count an outcome; return the faults that no problem before it has shown."""
        self.done.add(outcome.number)
        refused = outcome.report.refused
        place = 2 if not outcome.drawn else 1 if refused is not None else 0
        for pair in map(" + ".join, combinations(sorted(outcome.names), 2)):
            self.counts.setdefault(pair, [0, 0, 0])[place] += 1
            if refused is not None:
                self.reasons.setdefault(pair, re.sub(r"^\S*problem\.toml: ", "", refused))
            if self.counts[pair][0]:
                self.reasons.pop(pair, None)
        if place == 0 and outcome.number % ROTATION == ROTATION // 2:
            self.unhashed.append(outcome.number)
        for name in outcome.report.compared:
            self.compared[name] = self.compared.get(name, 0) + 1
        for name, why in outcome.report.skipped.items():
            key = f"{name} left out: {why}"
            self.compared[key] = self.compared.get(key, 0) + 1
        return self.blame(outcome)

    def hashed(self, numbers: Iterable[int], outcomes: Iterable[Outcome]) -> list[str]:
        """Count problems whose fingerprints were compared; return the faults that no problem before has shown."""
        numbers = set(numbers)
        self.unhashed = [number for number in self.unhashed if number not in numbers]
        self.compared["hash seeds"] = self.compared.get("hash seeds", 0) + len(numbers)
        return [key for outcome in outcomes for key in self.blame(outcome)]

    def blame(self, outcome: Outcome) -> list[str]:
        """Count the faults of an outcome; return those that no problem before it has shown."""
        new: list[str] = []
        for fault in outcome.report.faults:
            names, text = outcome.smallest.get(fault.check, (outcome.names, ""))
            key = f"{fault.check} | {', '.join(sorted(names))}"
            if key not in self.faults:
                new.append(key)
                self.faults[key] = {"number": outcome.number, "text": fault.text, "file": text, "times": 0}
            self.faults[key]["times"] += 1
        return new

    def document(self) -> dict[str, Any]:
        """Return it as JSON."""
        return {"done": sorted(self.done), "counts": self.counts, "faults": self.faults, "compared": self.compared,
                "reasons": self.reasons, "unhashed": self.unhashed}  # fmt: skip

    @staticmethod
    def of(document: Mapping[str, Any]) -> Tally:
        """Return what a document holds."""
        rest = document.get("reasons", {}), document.get("unhashed", [])
        return Tally(set(document["done"]), document["counts"], document["faults"], document["compared"], *rest)

    def summary(self) -> str:
        """Return the numbers of problems and pairs."""
        accepted, refused, without = self.fates()
        return (
            f"{len(self.done)} problems, {len(self.counts)} pairs of features drawn: {len(accepted)} accepted at least "
            f"once, {len(refused)} only refused, {len(without)} without place; {len(self.faults)} faults"
        )

    def fates(self) -> tuple[list[str], list[str], list[str]]:
        """Return the pairs that were accepted at least once, those that were only refused, and those without place."""
        found: tuple[list[str], list[str], list[str]] = [], [], []
        for pair, (accepted, refused, _) in sorted(self.counts.items()):
            found[0 if accepted else 1 if refused else 2].append(pair)
        return found

    def table(self) -> str:
        """Return all pairs that were drawn with their numbers, those that were never accepted first, and the checks."""
        accepted, refused, without = self.fates()
        lines = [self.summary(), "", f"{len(refused)} pairs that were only refused: times, and a sentence"]
        lines += [f"{self.counts[pair][1]:8d}  {pair}: {self.reasons.get(pair, 'unknown')}" for pair in refused]
        lines += ["", f"{len(without)} pairs whose features found no place in one problem: times"]
        lines += [f"{self.counts[pair][2]:8d}  {pair}" for pair in without]
        lines += ["", f"{len(accepted)} pairs that were accepted: times accepted, refused, without place"]
        lines += ["{:8d} {:8d} {:8d}  {}".format(*self.counts[pair], pair) for pair in accepted]
        return "\n".join([*lines, "", "checks: times", *self.checks(), ""])

    def checks(self) -> list[str]:
        """Return how often each check was made, and how often there was none, a line each."""
        checks = sorted(self.compared.items(), key=lambda one: -one[1])
        return [f"{times:8d}  {name}" for name, times in checks]
