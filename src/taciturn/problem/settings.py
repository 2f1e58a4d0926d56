"""Reading of the values of the command-line options ``--set`` and ``--over``.

``--over NAME=v1,v2,…`` gives several values of a key, ``--set NAME=VALUE`` one.
"""

from __future__ import annotations

import tomllib

from taciturn._text import number_of
from taciturn.errors import ProblemError


def parse_settings(items: list[str]) -> dict[str, object]:
    """Read ``NAME=VALUE`` texts; return the values by name. ``none`` removes a key, and ``"none"`` in quotes is
    text.
    """
    settings = parse_grid(items, "--set")
    for name, values in settings.items():
        if len(values) > 1:
            raise ProblemError(
                f"--set {name} has {number_of(len(values), 'value')}; expected one value: write a list as [v1,v2]"
            )
    texts = {name.strip(): text.strip() for name, _, text in (item.partition("=") for item in items)}
    return {name: None if texts[name] == "none" else values[0] for name, values in settings.items()}


def parse_grid(items: list[str], option: str = "--over") -> dict[str, list[object]]:
    """Read ``NAME=v1,v2,…`` texts; return the lists of values by name."""
    grid: dict[str, list[object]] = {}
    for item in items:
        name, _, listed = item.partition("=")
        name, parts = name.strip(), [part.strip() for part in _split(listed)]
        if not all(name.split(".")) or not all(parts):
            example = "NAME=v1,v2,…, such as theta=0.1,1" if option == "--over" else "NAME=VALUE, such as theta=0.1"
            raise ProblemError(f"the option {option} {item!r} is malformed; expected {example}")
        if name.removeprefix("policy.") in {known.removeprefix("policy.") for known in grid}:
            one = f"all its values in one list: {name}=v1,v2,…" if option == "--over" else "it only once"
            raise ProblemError(f"the option {option} {name} is given twice; expected {one}")
        grid[name] = [_parse_value(part) for part in parts]
    return grid


def _split(text: str) -> list[str]:
    """Split at the commas outside brackets and braces."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "[{") - (letter in "]}")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def _parse_value(text: str) -> object:
    if text.startswith(("[", "{", '"', "'")):
        try:
            return tomllib.loads(f"value = {text}")["value"]
        except ValueError:
            return text
    return {"true": True, "false": False}.get(text, parse_number(text))


def parse_number(text: str) -> object:
    """Convert a text to an integer or a float. If it is not a number, return it unchanged."""
    for convert in (int, float):
        try:
            return convert(text)
        except ValueError:
            continue
    return text
