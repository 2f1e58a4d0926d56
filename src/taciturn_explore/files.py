"""Export a setting of the page as a problem file, as Python code, or as a command that prints the same numbers.

A problem file is written from the tables of the changed problem. Numbers are written such that they are read back bit
for bit, so a saved file gives the digits that the page shows.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, cast

from taciturn.extend import Displayed
from taciturn.problem import Problem
from taciturn_explore.setting import FACTOR, Setting

SAVED = "saved.toml"  # name of the file that is taken away
WIDTH = 100  # columns of a line with an array


@dataclass(frozen=True, repr=False)
class Effort(Displayed):
    """The accuracy of an evaluation: a number of steps or a standard error of the cost; else the usual one."""

    steps: int | None = None
    standard_error: float | None = None

    @property
    def option(self) -> str:
        """Command-line option that requests this accuracy."""
        if self.steps:
            return f"--steps {self.steps}"
        return f"--standard-error {self.standard_error!r}" if self.standard_error else ""

    @property
    def argument(self) -> str:
        """The argument in Python."""
        if self.steps:
            return f"steps={self.steps:_}"
        return f"standard_error={self.standard_error!r}" if self.standard_error else ""


def problem_file(setting: Setting, problem: Problem) -> str:
    """Return the text of the problem file for a setting."""
    begun = setting.name or "a problem file"
    changed = ", ".join(f"{name} = {value}" for name, value in setting.changes)
    lines = [f"# Written by taciturn explore, from {begun}{f' with {changed}' if changed else ''}.", ""]
    tables = problem.source or {}
    last = {name: table for name, table in tables.items() if name != "policy"}
    return "\n".join([*lines, *_lines((), {**last, "policy": tables.get("policy", {})})]).rstrip() + "\n"


def python_lines(setting: Setting, effort: Effort) -> str:
    """Return lines of Python code that evaluate a setting and print the result."""
    changes = {name.removeprefix("policy."): value for name, value in setting.changes}
    opened = f'taciturn.load("{setting.name}")'
    if _needs_file(setting):
        opened = f'taciturn.load("{SAVED}")'
    elif changes:
        opened += f".changed({{{', '.join(f'{json.dumps(name)}: {value!r}' for name, value in changes.items())}}})"
    return (
        "import taciturn\n\n"
        f"problem = {opened}\n"
        f"found = taciturn.evaluate({', '.join(filter(None, ('problem', effort.argument, f'seed={setting.seed}')))})\n"
        "print(found)\n"
    )


def command(setting: Setting, effort: Effort) -> str:
    """Return the ``taciturn`` command that evaluates a setting and prints the result."""
    file = SAVED if _needs_file(setting) else setting.name
    changes = (
        ""
        if _needs_file(setting)
        else "".join(
            f" --set {name.removeprefix('policy.')}={value!r}".replace("'", "") for name, value in setting.changes
        )
    )
    return " ".join(filter(None, (f"taciturn evaluate {file}{changes}", effort.option, f"--seed {setting.seed}")))


def _needs_file(setting: Setting) -> bool:
    """Return whether the changes are more than keys of a built-in problem, which the command line can state."""
    return not setting.name or setting.kind is not None or any(name.startswith(FACTOR) for name, _ in setting.changes)


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
