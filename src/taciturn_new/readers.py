"""Functions that convert an answer to a value: a number, signal numbers, limits, or one or several words.

Each function here returns a function of the answer's text, which raises a ``ProblemError`` with the name of the value
if the text does not fit.
"""

from __future__ import annotations

import os.path
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, number
from taciturn.problem.read import changes_of
from taciturn.problem.settings import parse_number
from taciturn_new.matrices import parse_indices, parse_matrix, parse_noise, parse_numbers

NONE, ALL = "none", "all"


def a_number(name: str, low: float = -np.inf, high: float = np.inf, *, closed: bool = False) -> Callable[[str], float]:
    """Return a function that converts an answer to a number, which must lie in an interval."""
    return lambda text: number(name, parse_number(text), low, high, closed=closed)


def numbers(name: str, size: int, each: str) -> Callable[[str], Array]:
    """Return a function that converts an answer to numbers: one for all signals, or one for each signal."""
    return lambda text: parse_numbers(name, text, size, each)


def deviations(name: str, size: int, each: str) -> Callable[[str], Array]:
    """Return a function that converts standard deviations, or a matrix in brackets, to a covariance."""
    return lambda text: parse_noise(name, text, size, each)


def matrix(name: str) -> Callable[[str], Array]:
    """Read a matrix."""
    return lambda text: parse_matrix(name, text)


def indices(name: str, size: int) -> Callable[[str], list[int]]:
    """Return a function that converts signal numbers, counted from 1, or the word "all" to indices."""
    return lambda text: list(range(size)) if text.lower() == ALL else parse_indices(name, text, size)


def some_of(name: str, words: Sequence[str]) -> Callable[[str], list[str]]:
    """Return a function that reads several of the given words: by first letters, by number from 1, "all" or "none"."""

    def one(word: str) -> str:
        if word.isdecimal() and 1 <= int(word) <= len(words):
            return words[int(word) - 1]
        meant = [each for each in words if each == word] or [each for each in words if each.startswith(word)]
        if len(meant) != 1:
            raise ProblemError(
                f"{name} is {word!r}; expected one or several of the answers {', '.join(words)}, or all, or none"
            )
        return meant[0]

    def read(text: str) -> list[str]:
        typed = [word for word in re.split(r"[\s,]+", text.lower()) if word]
        return [] if typed == [NONE] else [*words] if typed == [ALL] else list(dict.fromkeys(map(one, typed)))

    return read


def limits(name: str) -> Callable[[str], tuple[float, float]]:
    """Return a function that reads limits: a lower and an upper one, one number for symmetric limits, or "none"."""

    def read(text: str) -> tuple[float, float]:
        if text.lower() == NONE:
            return -np.inf, np.inf
        try:
            found = [float(word) for word in text.strip("[]").replace(",", " ").split()]
        except ValueError:
            found = []
        low, high = (-found[0], found[0]) if len(found) == 1 else (*found, np.nan, np.nan)[:2]
        if len(found) > 2 or not low < high:
            raise ProblemError(
                f"{name} are {text!r}; expected a lower and an upper limit, such as -5 5 or 0 inf; enter none for no "
                "limits"
            )
        return low, high

    return read


def timetable(name: str, size: int, folder: Path) -> Callable[[str], str]:
    """Return a function that reads the file name of a set-point timetable as a path relative to ``folder``."""

    def read(text: str) -> str:
        found = changes_of({"file": text})
        if found is not None and found.size != size:
            raise ProblemError(f"{name} {text!r} has {found.size} set-points in each row; expected {size} in each row")
        return os.path.relpath(text, folder)

    return read


def node_names(role: str, least: int, most: int, taken: Sequence[str]) -> Callable[[str], list[str]]:
    """Return a function that reads the names of nodes, or how many nodes there are."""

    def read(text: str) -> list[str]:
        words = text.replace(",", " ").split()
        if len(words) == 1 and words[0].isdecimal():
            several = int(words[0])
            words = [role] if several == 1 else [f"{role}-{i + 1}" for i in range(min(several, most + 1))]
        if len(words) < least:
            raise ProblemError("no node is wireless; expected at least one wireless sensor or actuator")
        if len(words) > most:
            raise ProblemError(f"the {role}s are {text}; expected at most {most}, one for each signal of the plant")
        for word in words:
            if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]{0,31}", word) or word in taken or words.count(word) > 1:
                raise ProblemError(
                    f"the name of a node is {word!r}; expected letters, digits and hyphens, with a letter first, and a "
                    f"name other than {', '.join((*taken, *(one for one in words if one != word)))}"
                )
        return words

    return read
