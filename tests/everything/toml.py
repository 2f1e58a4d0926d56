"""Tables of a problem as the text of a TOML file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any


def text_of(tables: Mapping[str, Any]) -> str:
    """Return a problem file, one table below the other; short tables within a table are written in braces."""
    lines: list[str] = []
    for name, table in tables.items():
        if isinstance(table, list):
            for entry in table:
                lines += [f"[[{name}]]", *_keys(entry), ""]
        elif all(isinstance(value, Mapping) for value in table.values()):  # such as nodes
            for key, value in table.items():
                lines += [f"[{name}.{key}]", *_keys(value), ""]
        else:
            lines += [f"[{name}]", *_keys(table), ""]
    return "\n".join(lines)


def _keys(table: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {value_text(value)}" for key, value in table.items()]


def value_text(value: object) -> str:
    """Return a value in TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {value_text(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(value_text, value)) + "]"
    if isinstance(value, int):
        return str(value)
    assert isinstance(value, float), f"{value!r} has no place in a problem file"
    return repr(value) if math.isfinite(value) else "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
