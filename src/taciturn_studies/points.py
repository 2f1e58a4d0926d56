"""Evaluation of a problem for many values, in this process, in a pool or on a cluster, with a store of results."""

from __future__ import annotations

import itertools
import json
import logging
import math
import pickle
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol, TypeAlias, cast

from taciturn import __version__
from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import (
    Displayed,
    NoTimeLeft,
    Progress,
    check_time,
    expect_unmasked,
    instance,
    number,
    number_of,
    quoted,
    seconds_left,
)
from taciturn.problem import Problem
from taciturn.program.machine import one_thread
from taciturn.study.evaluate import choose_confidence, evaluate, expect_bound
from taciturn.study.evaluation import Evaluation
from taciturn.study.record import Store, digest, encode, fingerprint
from taciturn_studies.workers import Report, accepted, asked, deserted, refuse_other_versions, workers_of

FORMAT = 3  # of a stored answer; files of another format are not used
BLOCK = 1.0  # seconds that a task should take: a thousand times the overhead of a task
ROUNDS = 4  # least number of remaining tasks per worker, so that all workers finish at about the same time
PATIENCE = 5.0  # seconds without an answer, after which missing workers are reported
TOLD = logging.getLogger(__name__)
QUEUED = 3  # tasks per worker that are submitted in advance
LARGEST = 2**63  # limit of the integers that a file can hold


@dataclass(frozen=True, repr=False)
class Cell(Displayed):
    """One evaluation of a sweep."""

    values: Mapping[str, object] = field(hash=False)  # values of the swept keys
    seed: int  # seed of the cell's random draws


@dataclass(frozen=True, repr=False)
class Refusal(Displayed):
    """The error that explains why there is no result for a cell of a grid."""

    error: TaciturnError


Answer: TypeAlias = Evaluation | Refusal


@dataclass(frozen=True, repr=False)
class Effort(Displayed):
    """The accuracy that is requested for each evaluation of a grid."""

    standard_error: float | None = None  # absolute standard error of the cost
    confidence: float | None = None  # confidence of the lower bound, in cells that have one; None for no lower bound
    steps: int | None = None  # number of steps of each simulation, instead of a standard error


class Cells(Protocol):
    """The cells (combinations of values) of a grid in sequence, as a list or created on demand."""

    def __len__(self) -> int:
        """Return the number of cells."""
        ...

    def __getitem__(self, index: int, /) -> Cell:
        """Return the cell at an index."""
        ...


def evaluate_cells(
    problem: Problem,
    cells: Cells,
    effort: Effort,
    executor: Executor | None = None,
    store: Store | None = None,
    progress: Progress | None = None,
) -> list[Evaluation]:
    """Evaluate cells that must all succeed, with the arguments of ``run_cells``."""
    found: dict[int, Evaluation] = {}
    for index, answer in run_cells(problem, cells, effort, executor, store, progress):
        if isinstance(answer, Refusal):
            raise answer.error
        found[index] = answer
    return [found[index] for index in range(len(cells))]


def run_cells(
    problem: Problem,
    cells: Cells,
    effort: Effort,
    executor: Executor | None = None,
    store: Store | None = None,
    progress: Progress | None = None,
) -> Iterator[tuple[int, Answer]]:
    """Evaluate the cells of a grid, and yield each cell's index and result as soon as they are available.

    An error in one cell does not stop the other cells.

    A result depends only on its cell, not on the order of the cells, the workers, or the number of workers.
    """
    if store is not None and problem.own is not None:
        raise ProblemError(
            "a store is given, but the policy comes from Python code, by which a stored result cannot be identified; "
            "expected no store, or a Problem with a policy kind"
        )
    done = 0

    def advance(within: float = 0.0) -> None:
        if progress is not None:
            progress((done + within) / len(cells))

    if executor is not None:
        if hasattr(executor, "get_executor"):
            raise ProblemError(
                f"executor is a {type(executor).__name__}; expected an Executor, such as the one that its method "
                "get_executor() returns"
            )
        instance("executor", executor, Executor)
    kept = _Kept(store, problem, cells, effort)
    if store is not None and store.count():
        store.tell(sum(map(kept.holds, range(len(cells)))), len(cells))
    found = _one_by_one(kept, advance) if executor is None else _spread(kept, executor)
    for index, answer in found:
        done += 1
        advance()
        yield index, answer


@dataclass(frozen=True, eq=False)
class _Kept:
    """The cells, with the store that holds their answers."""

    store: Store | None
    problem: Problem
    cells: Cells
    effort: Effort

    def find(self, index: int) -> Evaluation | None:
        """Return the stored result of a cell; None if it is not stored."""
        found = None if self.store is None else self.store.read(self._key(index))
        return found if isinstance(found, Evaluation) else None

    def holds(self, index: int) -> bool:
        """Return whether the result of a cell is stored."""
        return self.store is not None and self.store.holds(self._key(index))

    def keep(self, index: int, answer: Answer) -> Answer:
        """Store the result of a cell, unless it is an error, and return it."""
        if self.store is not None and isinstance(answer, Evaluation):
            self.store.write(self._key(index), answer)
        return answer

    def _key(self, index: int) -> str:
        """Return the digest of all data that a cell's answer depends on."""
        cell = self.cells[index]
        return digest(encode([self._common, cell.values, cell.seed]))

    @cached_property
    def _common(self) -> str:
        return encode([fingerprint(self.problem), self.effort, __version__, FORMAT])


def _one_by_one(kept: _Kept, advance: Callable[[float], None]) -> Iterator[tuple[int, Answer]]:
    """Yield answers in order, computed in this process."""
    for index in range(len(kept.cells)):
        found = kept.find(index)
        if found is None:
            yield index, kept.keep(index, _answer(kept.problem, kept.cells[index], kept.effort, advance))
        else:
            yield index, found


def _spread(kept: _Kept, executor: Executor) -> Iterator[tuple[int, Answer]]:
    """Yield the answers of an executor that receives blocks of cells; at the end, no block is left in its queue."""
    if not isinstance(executor, ThreadPoolExecutor):
        pickle.dumps(kept.problem)  # raises here for a function that cannot be pickled; a pool would wait forever
    workers, size, total, came = workers_of(executor), 1, len(kept.cells), 0
    told = False
    refuse_other_versions(executor, workers)
    flying: dict[Future[Report[tuple[list[Answer], float]]], list[int]] = {}
    ahead = iter(range(total))
    try:
        while True:
            while len(flying) < QUEUED * workers:
                block: list[int] = []
                for index in ahead:
                    found = kept.find(index)
                    if found is None:
                        block.append(index)
                    else:
                        came += 1
                        yield index, found
                    if len(block) >= min(size, (total - index) / (ROUNDS * workers)):
                        break
                if not block:
                    break
                given = [kept.cells[i] for i in block]
                flying[asked(executor, answer_block, kept.problem, given, kept.effort)] = block
            if not flying:
                return
            ended, _ = wait(flying, timeout=min(PATIENCE, seconds_left()), return_when=FIRST_COMPLETED)
            check_time()
            if not ended and not told and (place := deserted(executor)) is not None:
                TOLD.warning("no workers at %s: waiting for one", place)
                told = True
            for future in sorted(ended, key=_failed):  # accepted answers are stored before a failure ends the run
                block = flying.pop(future)
                answers, seconds = accepted(future.result())
                size = max(1, min(2 * size, math.floor(BLOCK * len(block) / max(seconds, 1e-9))))
                for index, answer in zip(block, answers, strict=True):
                    came += 1
                    yield index, kept.keep(index, answer)
    except (TaciturnError, NoTimeLeft):
        raise
    except Exception as error:
        refuse_other_versions(executor, workers, error)
        why = ": ".join(filter(None, (type(error).__name__, str(error))))
        raise ProblemError(
            f"the executor failed after {came} of {number_of(total, 'cell')} ({why}); "
            "expected workers that stay alive and can import taciturn, and a running scheduler if one is used; with a "
            "store, run again to continue"
        ) from error
    finally:
        for future, block in flying.items():
            if not future.cancel() and future.done() and not _failed(future):  # answered before an interrupt
                for index, answer in zip(block, accepted(future.result())[0], strict=True):
                    kept.keep(index, answer)


def _failed(future: Future[Report[tuple[list[Answer], float]]]) -> bool:
    return future.cancelled() or future.exception() is not None or future.result().answer is None


def answer_block(problem: Problem, cells: Sequence[Cell], effort: Effort) -> tuple[list[Answer], float]:
    """Evaluate some cells on one thread, and return their results and the computing time in seconds."""
    began = time.perf_counter()
    with one_thread():
        return [_answer(problem, cell, effort, None) for cell in cells], time.perf_counter() - began


def _answer(problem: Problem, cell: Cell, effort: Effort, progress: Progress | None) -> Answer:
    try:
        changed, sought = problem.changed(cell.values), None
        if effort.confidence is not None and choose_confidence(changed, None) is not None:
            sought = effort.confidence
        return evaluate(
            changed,
            seed=cell.seed,
            standard_error=effort.standard_error,
            steps=effort.steps,
            confidence=sought,
            after_step=False,
            progress=progress,
        )
    except TaciturnError as error:
        return Refusal(error)
    except ArithmeticError as error:
        return Refusal(ProblemError(f"a number is out of range ({error}); expected sizes nearer to 1"))


def check_confidence(problems: Sequence[Problem], confidence: float | None) -> None:
    """Raise an error if lower bounds are requested but exist for none of the problems."""
    if confidence is None:
        return
    number("confidence", confidence, 0.0, 1.0)
    if all(choose_confidence(problem, None) is None for problem in problems):
        expect_bound(problems[0])


def check_grid(over: Mapping[str, Sequence[object]]) -> dict[str, list[object]]:
    """Check the values of each varied name, and convert them to lists."""
    instance("over", over, Mapping)
    listed: dict[str, list[object]] = {}
    for name, values in over.items():
        instance("a name in over", name, str)
        plain = plain_value(name, values)
        if not isinstance(plain, list):
            raise ProblemError(f"the values of {name} are {quoted(values)}; expected a list such as [0.1, 1.0]")
        listed[name] = cast("list[object]", plain)
        labels_of(name, listed[name])
        path = path_of(name)
        for other in itertools.islice(listed, len(listed) - 1):
            if path[: len(path_of(other))] == path_of(other) or path == path_of(other)[: len(path)]:
                raise ProblemError(
                    f"the keys {other} and {name} are the same, or one contains the other; expected one of them"
                )
    if not listed or not all(listed.values()):
        raise ProblemError("no values are given; expected a name with at least one value, such as theta=0.1,1")
    return listed


def grid_of(listed: Mapping[str, Sequence[object]]) -> list[dict[str, object]]:
    """Return all combinations of the values; the last name varies fastest."""
    return [dict(zip(listed, values, strict=True)) for values in itertools.product(*listed.values())]


def labels_of(name: str, values: Sequence[object]) -> list[Any]:
    """Return the coordinates along one dimension of a grid: numbers and strings unchanged, other values as JSON."""
    numbers = all(isinstance(one, float) or (isinstance(one, int) and abs(one) < LARGEST) for one in values)
    plain = numbers or all(isinstance(one, str) for one in values)
    labels: list[Any] = [one if plain else json.dumps(json.loads(encode(one))) for one in values]
    twice = next((one for one in labels if labels.count(one) > 1), None) if len(set(labels)) < len(labels) else None
    if twice is not None:
        raise ProblemError(f"the list of values for {name} contains {twice} twice; expected each value only once")
    return labels


def path_of(name: str) -> list[str]:
    """Split a dotted name into the tables and the key that it names; a name without a dot is a key of ``policy``."""
    path = name.split(".")
    return path if len(path) > 1 else ["policy", *path]


def plain_value(name: str, value: object) -> object:
    """Return a value in the form that a problem file allows; an array becomes a list of rows."""
    if hasattr(value, "tolist"):  # arrays and numbers of NumPy
        expect_unmasked(f"a value of {name}", value)
        value = cast("Any", value).tolist()
    elif hasattr(value, "values") and not isinstance(value, Mapping):  # labelled arrays
        value = cast("Any", value).values.tolist()
    if isinstance(value, Mapping):
        table = cast("Mapping[object, object]", value)
        return {str(key): plain_value(name, one) for key, one in table.items()}
    if isinstance(value, list | tuple | range):
        return [plain_value(name, one) for one in cast("Iterable[object]", value)]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ProblemError(f"a value of {name} is {quoted(value)}; expected numbers or words, or lists or arrays of these")


def label_of(problem: Problem) -> dict[str, str]:
    """Return the label of a sweep's results, made of the problem's digest and the version of Taciturn."""
    return {"problem": fingerprint(problem), "version": __version__}
