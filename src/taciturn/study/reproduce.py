"""Tables and figures of the thesis, with printed and computed numbers side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from taciturn._progress import Progress, in_notebook
from taciturn.errors import ProblemError
from taciturn.problem.tables import suggest
from taciturn.study.chapter2 import chapter2
from taciturn.study.chapter3 import chapter3
from taciturn.study.chapter4 import chapter4
from taciturn.study.chapter5 import chapter5
from taciturn.study.chapter6 import chapter6
from taciturn.study.chapter7 import chapter7
from taciturn.study.reproduction import Reproduction

CHAPTERS: Mapping[str, Callable[[int, Progress], Reproduction]] = {
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
    return CHAPTERS[name](seed, in_notebook(progress) or (lambda fraction: None))


def no_chapter(name: str, known: Sequence[str]) -> ProblemError:
    """Return the error for an unknown chapter name."""
    return ProblemError(
        f"{name!r} is not a reproducible chapter; expected one of {', '.join(known)}, or all{suggest(name, known)}"
    )
