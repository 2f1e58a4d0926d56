"""Examines problems in which features meet, for as long as wanted; an interrupted run is resumed from its file.

    python tests/everything/run.py --problems 10000 --seed 2025-01-31 --minutes 60 --resume run.json --processes 2
    python tests/everything/run.py --only 4711 --seed 2025-01-31     # one problem again, with its file

The seed is a number or a day. Problems are numbered: first every pair of features, then more features at once. A fault
is printed with the smallest file that still shows it. A process that dies is a fault of its problem.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing as mp
import os
import sys
import time
from multiprocessing.connection import Connection, wait
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parent.parent))

from everything.checks import Fault, Report
from everything.search import Outcome, Tally, draw, features_of, hashed, pairs

HASHES = -1  # begins the list of the problems whose fingerprints are compared
BATCH = 24  # accepted problems whose fingerprints are compared in one process for each seed of hashes
SHOWN, CHECKS = 5, 20  # pairs and checks on the screen; the file has all
LONGEST = 900.0  # seconds of a problem with its shrinking, after which its process is ended


def seed_of(text: str) -> int:
    """Return a number, or that of a day."""
    return int(text.replace("-", ""))


def work(seed: int, pipe: Connection) -> None:
    """Examine each problem whose number arrives, or the fingerprints of several behind a mark."""
    while (job := pipe.recv()) is not None:
        pipe.send([draw(seed, job[0])] if len(job) == 1 else hashed(seed, job[1:]))


class Worker:
    """A process that examines problems, and is started again where one of them ends it."""

    def __init__(self, seed: int) -> None:
        """Start."""
        self.seed, self.job, self.began = seed, tuple[int, ...](), 0.0
        self._start()

    def _start(self) -> None:
        self.pipe, theirs = mp.Pipe()
        self.process = mp.get_context("spawn").Process(target=work, args=(self.seed, theirs), daemon=True)
        self.process.start()
        theirs.close()

    def give(self, job: tuple[int, ...]) -> None:
        """Let it examine a problem, or the fingerprints of several behind ``HASHES``."""
        self.job, self.began = job, time.monotonic()
        self.pipe.send(job)

    def take(self) -> list[Outcome] | None:
        """Return its answer, or a fault if it has died or takes too long; None while it works."""
        try:
            if self.pipe.poll():
                return self.pipe.recv()
        except EOFError:
            pass
        late = time.monotonic() - self.began > LONGEST
        if self.process.is_alive() and not late:
            return None
        self.process.kill()
        self.process.join()
        text = f"after {LONGEST:g} s" if late else f"exit code {self.process.exitcode}"
        self._start()
        number = self.job[-1]
        names = features_of(self.seed, number)
        return [Outcome(number, names, True, Report(faults=[Fault("the process dies", text)]))]

    def end(self) -> None:
        """End it."""
        self.process.kill()
        self.process.join()


def search(seed: int, numbers: list[int], tally: Tally, seconds: float, processes: int, file: Path | None) -> None:
    """Examine problems until they end or the time is over; what is found is printed and kept."""
    began, last = time.monotonic(), 0.0
    todo = [(number,) for number in numbers if number not in tally.done]
    workers = [Worker(seed) for _ in range(min(processes, max(len(todo), 1)))]
    free, busy = list(workers), list[Worker]()
    try:
        while (todo or busy or tally.unhashed) and time.monotonic() - began < seconds:
            if not any(one.job[0] == HASHES for one in busy):  # one batch at a time
                ready = tally.unhashed[:BATCH]
                if len(ready) == BATCH or (ready and not todo and not busy):
                    todo.insert(0, (HASHES, *ready))
            while free and todo:
                one = free.pop()
                one.give(todo.pop(0))
                busy.append(one)
            wait([one.pipe for one in busy], timeout=1.0)
            for one in tuple(busy):
                outcomes = one.take()
                if outcomes is None:
                    continue
                busy.remove(one)
                free.append(one)
                for key in tally.hashed(one.job[1:], outcomes) if one.job[0] == HASHES else tally.add(outcomes[0]):
                    show(key, tally)
            if time.monotonic() - last > 10.0:
                last = time.monotonic()
                if file is not None:
                    keep(file, seed, tally)
                print(f"[{last - began:6.0f} s] {tally.summary()}", file=sys.stderr, flush=True)
    finally:
        for one in workers:
            one.end()
        if file is not None:
            keep(file, seed, tally)


def show(key: str, tally: Tally) -> None:
    """Print a fault."""
    found = tally.faults[key]
    print(f"\n== {key} (problem {found['number']})\n{found['text'].strip()}\n{found['file']}", flush=True)


def keep(file: Path, seed: int, tally: Tally) -> None:
    """Write the state of a run, all of it or nothing."""
    part = file.with_suffix(".part")
    part.write_text(json.dumps({"seed": seed, **tally.document()}), encoding="utf-8")
    part.replace(file)


def main() -> int:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first problem")
    parser.add_argument("--seed", default="0")
    parser.add_argument("--minutes", type=float, default=1e9)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--resume", type=Path, help="file of the run, which is made if it is missing")
    parser.add_argument("--table", type=Path, help="file into which the table of pairs is written")
    parser.add_argument("--only", type=int, help="number of a single problem")
    given = parser.parse_args()
    seed = seed_of(given.seed)
    if given.only is not None:
        names = features_of(seed, given.only)
        print(", ".join(names))
        outcome = draw(seed, given.only)
        tally = Tally()
        for key in tally.add(outcome):
            show(key, tally)
        print(outcome.report.refused or f"accepted; {outcome.report.compared}; {outcome.report.skipped}")
        return bool(outcome.report.faults)
    tally = Tally()
    if given.resume is not None and given.resume.exists():
        document = json.loads(given.resume.read_text(encoding="utf-8"))
        if document["seed"] != seed:
            parser.error(f"{given.resume} has the seed {document['seed']}, and --seed is {seed}")
        tally = Tally.of(document)
    numbers = list(range(given.first, given.first + given.problems))
    print(f"seed {seed}, {len(pairs(seed))} pairs of features", file=sys.stderr)
    try:
        search(seed, numbers, tally, 60 * given.minutes, given.processes, given.resume)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    print(tally.summary())
    if given.table is not None:
        given.table.write_text(tally.table(), encoding="utf-8")
    _, refused, without = tally.fates()
    for title, found in (("only refused", refused), ("without place", without)):
        print(f"{len(found)} pairs {title}{': ' if found else ''}{', '.join(found[:SHOWN])}"
              f"{f' and {len(found) - SHOWN} more (--table FILE)' if len(found) > SHOWN else ''}")  # fmt: skip
    print("checks", *tally.checks()[:CHECKS], sep="\n")
    return bool(tally.faults)


if __name__ == "__main__":
    sys.exit(main())
