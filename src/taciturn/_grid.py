"""Grids of the command line: what ``--over NAME=v1,v2,…`` asks for."""

from __future__ import annotations

import json

from taciturn.errors import ProblemError


def parse_grid(items: list[str]) -> dict[str, list[object]]:
    """Return the values of each name of ``NAME=v1,v2,…``.

    Raises:
        ProblemError: a text of another form, or a name that is given twice.
    """
    grid: dict[str, list[object]] = {}
    for item in items:
        name, _, listed = item.partition("=")
        name, parts = name.strip(), [part.strip() for part in _split(listed)]
        if not all(name.split(".")) or not all(parts):
            raise ProblemError(f"--over {item!r} is not understood; expected NAME=v1,v2,…, as theta=0.1,1")
        if name.removeprefix("policy.") in {known.removeprefix("policy.") for known in grid}:
            raise ProblemError(f"--over {name} is given twice; expected all its values in one list: {name}=v1,v2,…")
        grid[name] = [_parse_value(part) for part in parts]
    return grid


def _split(text: str) -> list[str]:
    """Split at the commas outside brackets."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter == "[") - (letter == "]")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def _parse_value(text: str) -> object:
    if text.startswith("["):
        try:
            return json.loads(text)
        except ValueError:
            return text
    return parse_number(text)


def parse_number(text: str) -> object:
    """Return a number, a whole one as such; what is none as it is."""
    for convert in (int, float):
        try:
            return convert(text)
        except ValueError:
            continue
    return text
