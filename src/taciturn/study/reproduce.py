"""The thesis's tables and figures, printed beside computed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from taciturn._progress import Progress
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
        name: such as ``"chapter2"``.
        seed: of the draws.
        progress: called with the fraction done.

    Returns:
        The tables, printed beside computed, and the pictures.

    Raises:
        ProblemError: no such chapter.

    Source: khashooei2017
    """
    if name not in CHAPTERS:
        raise no_chapter(name, list(CHAPTERS))
    return CHAPTERS[name](seed, progress or (lambda fraction: None))


def no_chapter(name: str, known: Sequence[str]) -> ProblemError:
    """Return the refusal of a name that is none of these chapters."""
    return ProblemError(
        f"there is nothing to reproduce by the name {name!r}; expected one of {', '.join(known)}, or all"
        f"{suggest(name, known)}"
    )
