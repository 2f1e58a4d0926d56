"""Many evaluations of one problem with different values: here, on a pool or on a cluster, kept as they come."""

from __future__ import annotations

import logging
import math
import pickle
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeAlias

from taciturn._arrays import instance, number
from taciturn._progress import Progress
from taciturn._version import __version__
from taciturn.errors import ProblemError, TaciturnError
from taciturn.problem import Problem
from taciturn.program.machine import one_thread
from taciturn.study.evaluate import Evaluation, evaluate
from taciturn.study.lower import choose_confidence, expect_bound
from taciturn.study.record import digest, encode, fingerprint
from taciturn.study.store import Store
from taciturn.study.workers import deserted, workers_of

BLOCK = 1.0  # seconds that a task should take: a thousand times what it costs to send one
ROUNDS = 4  # tasks left to each worker, at least, so that all end at about the same time
PATIENCE = 5.0  # seconds without an answer, after which workers are looked for
TOLD = logging.getLogger(__name__)
QUEUED = 3  # tasks per worker that are handed over before they can be begun


@dataclass(frozen=True)
class Cell:
    """One evaluation of a sweep.

    Args:
        values: of the keys that are swept.
        seed: of its draws.
    """

    values: Mapping[str, object]
    seed: int


@dataclass(frozen=True)
class Refusal:
    """Why a cell has no answer."""

    error: TaciturnError


@dataclass(frozen=True)
class Effort:
    """What is asked of every cell.

    Args:
        standard_error: absolute, of the cost; None: 1e-4 of it, or what the steps give.
        confidence: of a lower bound, in cells that have one; None: none is sought.
        steps: of each simulation, instead of a standard error.
    """

    standard_error: float | None = None
    confidence: float | None = None
    steps: int | None = None


Answer: TypeAlias = Evaluation | Refusal


class Cells(Protocol):
    """Cells in a row, as a list, or made when they are asked for."""

    def __len__(self) -> int:
        """Return how many there are."""
        ...

    def __getitem__(self, index: int, /) -> Cell:
        """Return one of them."""
        ...


def run_cells(
    problem: Problem,
    cells: Cells,
    effort: Effort,
    executor: Executor | None = None,
    store: Store | None = None,
    progress: Progress | None = None,
) -> Iterator[tuple[int, Answer]]:
    """Yield each cell's index and answer, in the order in which they come; a cell that is refused does not stop others.

    An answer depends on its cell alone: not on the order, the workers, or their number.

    Args:
        problem: of which each cell changes the named keys.
        cells: what is evaluated.
        effort: what is asked of each.
        executor: runs blocks of cells, each on one thread; None: here, one after the other, on all processors.
        store: answers that it holds are not computed again, and others are kept in it as they come.
        progress: called with the fraction done.

    Raises:
        ProblemError: the executor fails, or the store's disk does.
    """
    done = 0

    def advance(within: float = 0.0) -> None:
        if progress is not None:
            progress((done + within) / len(cells))

    if executor is not None:
        if hasattr(executor, "get_executor"):
            raise ProblemError(
                f"executor is a {type(executor).__name__}; expected an Executor: its get_executor() is one"
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
    """The cells, beside the store in which their answers are sought and kept."""

    store: Store | None
    problem: Problem
    cells: Cells
    effort: Effort

    def find(self, index: int) -> Evaluation | None:
        """Return the answer that is kept, if there is one."""
        found = None if self.store is None else self.store.read(self._key(index))
        return found if isinstance(found, Evaluation) else None

    def holds(self, index: int) -> bool:
        """Tell whether an answer is kept."""
        return self.store is not None and self.store.holds(self._key(index))

    def keep(self, index: int, answer: Answer) -> Answer:
        """Return an answer, which is kept unless it is a refusal."""
        if self.store is not None and isinstance(answer, Evaluation):
            self.store.write(self._key(index), answer)
        return answer

    def _key(self, index: int) -> str:
        """Return the digest of all that an answer depends on."""
        cell = self.cells[index]
        return digest(encode([self._common, cell.values, cell.seed]))

    @cached_property
    def _common(self) -> str:
        return encode([fingerprint(self.problem), self.effort, __version__])


def evaluate_cells(
    problem: Problem,
    cells: Cells,
    effort: Effort,
    executor: Executor | None = None,
    store: Store | None = None,
    progress: Progress | None = None,
) -> list[Evaluation]:
    """Return the evaluations of cells that must all have one, arguments as in ``run_cells``.

    Raises:
        TaciturnError: why one of them has none.
    """
    found: dict[int, Evaluation] = {}
    for index, answer in run_cells(problem, cells, effort, executor, store, progress):
        if isinstance(answer, Refusal):
            raise answer.error
        found[index] = answer
    return [found[index] for index in range(len(cells))]


def check_confidence(problems: Sequence[Problem], confidence: float | None) -> None:
    """Refuse a lower bound that is asked of problems of which none has one.

    Raises:
        ProblemError: a confidence outside (0, 1), or why the first of them has no lower bound.
    """
    if confidence is None:
        return
    number("confidence", confidence, 0.0, 1.0)
    if all(choose_confidence(problem, None) is None for problem in problems):
        expect_bound(problems[0])


def _one_by_one(kept: _Kept, advance: Callable[[float], None]) -> Iterator[tuple[int, Answer]]:
    """Yield answers in order, computed here."""
    for index in range(len(kept.cells)):
        found = kept.find(index)
        if found is None:
            yield index, kept.keep(index, _answer(kept.problem, kept.cells[index], kept.effort, advance))
        else:
            yield index, found


def _spread(kept: _Kept, executor: Executor) -> Iterator[tuple[int, Answer]]:
    """Yield answers of an executor, to which blocks are handed as it takes them; in the end, nothing is left there."""
    if not isinstance(executor, ThreadPoolExecutor):
        pickle.dumps(kept.problem)  # a function that no other process has is told here; a pool would wait
    workers, size, total, came = workers_of(executor), 1, len(kept.cells), 0
    told = False
    flying: dict[Future[tuple[list[Answer], float]], list[int]] = {}
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
                flying[executor.submit(answer_block, kept.problem, [kept.cells[i] for i in block], kept.effort)] = block
            if not flying:
                return
            ended, _ = wait(flying, timeout=PATIENCE, return_when=FIRST_COMPLETED)
            if not ended and not told and (place := deserted(executor)) is not None:
                TOLD.warning("no workers at %s: waiting for one", place)
                told = True
            for future in sorted(ended, key=_failed):  # what came is kept before a failure ends it all
                block = flying.pop(future)
                answers, seconds = future.result()
                size = max(1, min(2 * size, math.floor(BLOCK * len(block) / max(seconds, 1e-9))))
                for index, answer in zip(block, answers, strict=True):
                    came += 1
                    yield index, kept.keep(index, answer)
    except TaciturnError:
        raise
    except Exception as error:
        why = ": ".join(filter(None, (type(error).__name__, str(error))))
        raise ProblemError(
            f"the executor failed after {came} of {total} cells ({why}); "
            "expected a scheduler, if there is one, and workers that live and can import taciturn: with a store, run "
            "again to go on"
        ) from error
    finally:
        for future in flying:
            future.cancel()


def _failed(future: Future[tuple[list[Answer], float]]) -> bool:
    return future.cancelled() or future.exception() is not None


def answer_block(problem: Problem, cells: Sequence[Cell], effort: Effort) -> tuple[list[Answer], float]:
    """Return the answers of some cells, computed on one thread, and the seconds that they took."""
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
            progress=progress,
        )
    except TaciturnError as error:
        return Refusal(error)
    except ArithmeticError as error:
        return Refusal(ProblemError(f"a number is out of range ({error}); expected sizes nearer to 1"))
