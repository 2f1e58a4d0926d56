"""The text of a problem file from its tables.

Numbers are written such that they are read back bit for bit, so a written file gives the digits of the problem.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any, cast

WIDTH = 100  # columns of a line with an array


def tables_text(tables: Mapping[str, Any]) -> str:
    """Return tables as TOML."""
    return "\n".join(_lines((), tables)).rstrip() + "\n"


def _lines(path: tuple[str, ...], table: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of a table: its values, then the tables in it."""
    inner: dict[str, Any] = {
        key: value for key, value in table.items() if isinstance(value, Mapping) or _is_tables(value)
    }
    plain = {key: value for key, value in table.items() if key not in inner and value is not None}
    if path and (plain or not inner):
        yield f"[{'.'.join(path)}]"
    for key, value in plain.items():
        yield f"{_key(key)} = {_value(value)}"
    if plain or path:
        yield ""
    for key, value in inner.items():
        if isinstance(value, Mapping):
            yield from _lines((*path, _key(key)), cast("Mapping[str, Any]", value))
            continue
        for one in cast("list[Mapping[str, Any]]", value):
            yield f"[[{'.'.join((*path, _key(key)))}]]"
            yield from (f"{_key(name)} = {_value(part)}" for name, part in one.items() if part is not None)
            yield ""


def _is_tables(value: object) -> bool:
    listed = cast("list[object]", value if isinstance(value, list | tuple) else [])
    return bool(listed) and all(isinstance(one, Mapping) for one in listed)


def _key(name: str) -> str:
    bare = name.replace("-", "").replace("_", "")
    return name if bare.isascii() and bare.isalnum() else json.dumps(name)


def _value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):
        entries = (f"{_key(name)} = {_value(one)}" for name, one in cast("Mapping[str, object]", value).items())
        return f"{{{', '.join(entries)}}}"
    listed = cast("list[object]", value)
    short = f"[{', '.join(map(_value, listed))}]"
    if len(short) <= WIDTH or not any(isinstance(one, list | tuple) for one in listed):
        return short
    return "[\n" + "".join(f"  {_value(one)},\n" for one in listed) + "]"
