"""Tables and figures of the thesis, with printed and computed numbers side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from time import perf_counter
from typing import TypeAlias

from taciturn.errors import ProblemError
from taciturn.extend import Progress, find_plugins, in_notebook, load_plugin
from taciturn.problem.schema import suggest
from taciturn_thesis.chapter2 import chapter2
from taciturn_thesis.chapter3 import chapter3
from taciturn_thesis.chapter4 import chapter4
from taciturn_thesis.chapter5 import chapter5
from taciturn_thesis.chapter6 import chapter6
from taciturn_thesis.chapter7 import chapter7
from taciturn_thesis.reproduction import Reproduction

EXPERIMENTS = "taciturn_thesis.experiments"  # group of entry points: functions from seed and progress
Chapter: TypeAlias = Callable[[int, Progress], Reproduction]
CHAPTERS: Mapping[str, Chapter] = {
    "chapter2": chapter2,
    "chapter3": chapter3,
    "chapter4": chapter4,
    "chapter5": chapter5,
    "chapter6": chapter6,
    "chapter7": chapter7,
}


def reproduce(name: str, *, seed: int = 0, progress: Progress | None = None) -> Reproduction:
    """Compute the tables and figures of a chapter of the thesis.

    Args:
        name: name of the chapter, such as ``"chapter2"``.
        seed: seed of the random draws.
        progress: callback that receives the fraction done.

    Returns:
        The tables, with printed and computed numbers side by side, and the pictures.

    Raises:
        ProblemError: there is no such chapter.

    Source: khashooei2017
    """
    if name not in CHAPTERS:
        raise no_chapter(name, list(CHAPTERS))
    return _timed(CHAPTERS[name], seed, progress)


def experiments() -> list[str]:
    """Return the chapters of the thesis whose experiments an installed package can repeat with digital twins."""
    return list(find_plugins(EXPERIMENTS))


def repeat_experiment(name: str, *, seed: int = 0, progress: Progress | None = None) -> Reproduction:
    """Repeat the experiments of a chapter of the thesis with a digital twin.

    Args:
        name: name of the chapter, such as ``"chapter6"``.
        seed: seed of all random draws.
        progress: callback that receives the fraction done.

    Raises:
        ProblemError: no package has an experiment of this chapter, or an optional package or a driver is missing.

    Source: khashooei2017
    """
    if name not in experiments():
        raise no_chapter(name, experiments())
    experiment: Chapter = load_plugin(EXPERIMENTS, name, "--twin")
    return _timed(experiment, seed, progress)


def _timed(chapter: Chapter, seed: int, progress: Progress | None) -> Reproduction:
    """Return what a chapter computes, with its wall time."""
    begun = perf_counter()
    found = chapter(seed, in_notebook(progress) or (lambda fraction: None))
    return replace(found, seconds=perf_counter() - begun)


def no_chapter(name: str, known: Sequence[str]) -> ProblemError:
    """Return the error that says that a chapter does not exist."""
    return ProblemError(
        f"{name!r} is not a reproducible chapter; expected one of {', '.join(known)}, or all{suggest(name, known)}"
    )
