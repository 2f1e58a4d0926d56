"""Values on the command line: the grid of ``--over NAME=v1,v2,…`` and the changes of ``--set NAME=VALUE``."""

from __future__ import annotations

import json

from taciturn.errors import ProblemError


def parse_settings(items: list[str]) -> dict[str, object]:
    """Return the value of each name of ``NAME=VALUE``; ``none`` removes a key.

    Raises:
        ProblemError: a text of another form, several values, or a name that is given twice.
    """
    settings = parse_grid(items, "--set")
    for name, values in settings.items():
        if len(values) > 1:
            raise ProblemError(f"--set {name} has {len(values)} values; expected one: a list is written [v1,v2]")
    return {name: None if values == ["none"] else values[0] for name, values in settings.items()}


def parse_grid(items: list[str], option: str = "--over") -> dict[str, list[object]]:
    """Return the values of each name of ``NAME=v1,v2,…``.

    Args:
        items: one text per option that was given.
        option: its name, for what is refused.

    Raises:
        ProblemError: a text of another form, or a name that is given twice.
    """
    grid: dict[str, list[object]] = {}
    for item in items:
        name, _, listed = item.partition("=")
        name, parts = name.strip(), [part.strip() for part in _split(listed)]
        if not all(name.split(".")) or not all(parts):
            example = "NAME=v1,v2,…, as theta=0.1,1" if option == "--over" else "NAME=VALUE, as theta=0.1"
            raise ProblemError(f"{option} {item!r} is not understood; expected {example}")
        if name.removeprefix("policy.") in {known.removeprefix("policy.") for known in grid}:
            one = f"all its values in one list: {name}=v1,v2,…" if option == "--over" else "it once"
            raise ProblemError(f"{option} {name} is given twice; expected {one}")
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
