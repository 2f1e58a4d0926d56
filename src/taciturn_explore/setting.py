"""A setting of the page: a problem, the changes to it, the random seed, and the events of the simulated path.

A setting is an immutable value with one text form, which is the query of the page's address:

    problem=two-mass&policy.theta=0.08&factor.cost.Q=2&seed=3&load=60:0:0.5

``problem`` is the name of a built-in problem; ``file`` is the compressed text of any other problem file. A change is a
key of ``Problem.changed``, or ``factor.`` with the key of a matrix that is multiplied by a number. If a change names
another policy kind, the parameters of the file's kind do not apply, and the changes state all parameters. Changes that
state what the file states are left out, so that equal problems have equal texts.

The text may come from another person. So changes are those of a few tables, and a file that names Python code or
another file is refused, unless the command line named this file (``Trusted``).
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import tomllib
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast, get_args
from urllib.parse import parse_qsl, quote, urlencode

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, number_of, problem_folders, quoted, read_text
from taciturn.problem import Problem, load, parse
from taciturn.problem.read import locate_functions
from taciturn.problem.settings import parse_settings

Value: TypeAlias = float | int | str | bool | None
EventKind = Literal["load", "step", "drop"]
EVENTS: tuple[EventKind, ...] = get_args(EventKind)
TABLES = ("policy", "network", "links", "nodes")  # whose keys may be changed; none of them names a file
FACTOR = "factor."
FACTORS = ("cost.Q", "cost.R", "plant.W", "plant.V")  # matrices that may be multiplied by a number
READING = ("function", "file", "histogram", "trace")  # keys that name a file to read
LARGEST = 2**18  # bytes of the text of a problem file in an address
STEPS, MOST_STEPS, FEWEST_STEPS = 240, 4000, 20  # of the shown path
MOST_SEED = 10**15 - 1  # which a number of a browser holds exactly
MOST_EVENTS = 32
BUILT_IN, FILE, SEED, SHOWN, COMPARE = "problem", "file", "seed", "steps", "compare"  # names in the text


@dataclass(frozen=True, repr=False)
class Event(Displayed):
    """An event of the simulated path: a load at an input, a set-point step, or a dropped packet."""

    # ``"load"`` adds ``size`` to an input from this step on, ``"step"`` adds it to a set-point, and ``"drop"`` drops
    # the packets of a link in this step
    kind: EventKind
    step: int  # number of the step
    where: str  # number of the input or set-point from 0 on, or name of the link
    size: float = 0.0  # size of the load or of the step

    @property
    def text(self) -> str:
        """The event in the text form of the page's address."""
        return ":".join([str(self.step), self.where, *([] if self.kind == "drop" else [repr(self.size)])])


def event_of(kind: str, text: str) -> Event:
    """Convert the text of an event in the page's address to the event."""
    parts = text.split(":")
    try:
        step, where = int(parts[0]), parts[1]
        size = 0.0 if kind == "drop" else float(parts[2])
        if kind not in EVENTS or len(parts) != 3 - (kind == "drop") or not math.isfinite(size) or step < 0:
            raise ValueError
        return Event(kind, step, where, size)
    except (ValueError, IndexError):
        form = "STEP:LINK" if kind == "drop" else "STEP:NUMBER:SIZE"
        raise ProblemError(f"the event {kind} has the text {quoted(text)}; expected the form {form}") from None


@dataclass(frozen=True, repr=False)
class Trusted(Displayed):
    """The problem file named on the command line; it alone may refer to Python code and other files."""

    text: str = ""  # text of the file
    folder: str = "."  # folder of the file, at which relative paths in it start
    name: str = ""  # name of a built-in problem; empty for another file


@dataclass(frozen=True, repr=False)
class Setting(Displayed):
    """A problem with changed values, a random seed, and the events of the simulated path."""

    name: str = ""  # name of a built-in problem; empty for another file
    file: str = ""  # text of the problem file; empty for a built-in problem
    changes: tuple[tuple[str, Value], ...] = ()  # changed keys with their values, in the order of the keys
    seed: int = 0  # seed of all random draws
    events: tuple[Event, ...] = ()  # events of the shown path
    steps: int = STEPS  # steps of the shown path
    compare: tuple[str, ...] | None = None  # policy kinds whose curves are shown; None for some that suit the problem

    @cached_property
    def text(self) -> str:
        """The setting as text for the query part of the page's address."""
        begin = [(BUILT_IN, self.name)] if self.name else [(FILE, _packed(self.file))]
        more = [(SEED, str(self.seed))] if self.seed else []
        more += [(SHOWN, str(self.steps))] if self.steps != STEPS else []
        more += [] if self.compare is None else [(COMPARE, ",".join(self.compare))]
        changed = [(name, _value_text(value)) for name, value in self.changes]
        happens = [(one.kind, one.text) for one in self.events]
        return urlencode([*begin, *changed, *more, *happens], quote_via=quote, safe=":.,[]")

    @property
    def averaged(self) -> Setting:
        """The setting without events and with the usual number of simulated steps; averages do not depend on either."""
        return replace(self, events=(), steps=STEPS, compare=None)

    def to(self, changes: Mapping[str, Value]) -> Setting:
        """Return the setting with changed values of some keys; the value None restores the original value of a key."""
        found = {**dict(self.changes), **changes}
        kept = {name: value for name, value in found.items() if value is not None and value != _neutral(name)}
        return replace(self, changes=tuple(sorted(kept.items())))

    @property
    def kind(self) -> str | None:
        """Policy kind that replaces the kind of the problem; None if the kind is unchanged."""
        found = dict(self.changes).get("policy.kind")
        return found if isinstance(found, str) else None

    def base(self, trusted: Trusted | None = None) -> Problem:
        """Return the problem without changes."""
        if self.name:
            return load(self.name)
        if trusted is not None and trusted.text == self.file:
            return parse(locate_functions(_tables(self.file), Path(trusted.folder)), trusted.name)
        tables = _tables(self.file)
        _refuse_reading(tables)
        return parse(tables, "the problem")

    def problem(self, base: Problem) -> Problem:
        """Return the setting's problem, with all changes of the setting."""
        other = self.kind is not None and self.kind != base.kind
        values: dict[str, Any] = {f"policy.{name}": None for name in base.parameters} if other else {}
        for name, value in self.changes:
            if name.startswith(FACTOR):
                values[name.removeprefix(FACTOR)] = _scaled(base, name.removeprefix(FACTOR), value)
            else:
                values[name] = value
        return base.changed(values) if values else base

    def stated(self, base: Problem) -> Setting:
        """Return the setting without those changes that repeat the value in the problem file."""
        tables = {**(base.source or {}), "policy": {"kind": base.kind, **base.parameters}}
        other = self.kind is not None and self.kind != base.kind
        kept = [
            (name, value)
            for name, value in self.changes
            if (other and name.startswith("policy.")) or not _same(_at(tables, name), value)
        ]
        return replace(self, changes=tuple(kept))


def setting_of(text: str) -> Setting:
    """Convert the text of a setting in the page's address to the setting."""
    name, file, changes, seed, events, steps = "", "", dict[str, Value](), 0, list[Event](), STEPS
    compare: tuple[str, ...] | None = None  # policy kinds whose curves are shown; None for some that suit the problem
    for key, value in parse_qsl(text, keep_blank_values=True):
        if key == BUILT_IN:
            name = value
        elif key == FILE:
            file = _unpacked(value)
        elif key == SEED:
            seed = whole_number(key, value, MOST_SEED)
        elif key == SHOWN:
            steps = whole_number(key, value, MOST_STEPS, FEWEST_STEPS)
        elif key == COMPARE:
            compare = tuple(kind for kind in value.split(",") if kind)
        elif key in EVENTS:
            events.append(event_of(key, value))
        else:
            changes[key] = _value_of(value)
    return checked(Setting(name, file, (), seed, tuple(events), steps, compare).to(changes))


def checked(setting: Setting) -> Setting:
    """Check those parts of a setting that can be checked without its problem, and return the setting."""
    if bool(setting.name) == bool(setting.file):
        raise ProblemError("the address names no problem; expected problem=NAME, such as problem=two-mass, or file=…")
    if setting.name and not setting.name.replace("-", "").isalnum():  # no path
        raise ProblemError(f"problem is {quoted(setting.name)}; expected the name of a built-in problem")
    for key, value in setting.changes:
        bare = key.removeprefix(FACTOR)
        if bare != key:
            if bare not in FACTORS or isinstance(value, bool | str) or value is None or not 0 < value < math.inf:
                raise ProblemError(
                    f"{key} is {quoted(value)}; expected a positive factor of one of {', '.join(FACTORS)}"
                )
        elif bare.split(".")[0] not in TABLES or bare.split(".")[-1] in READING:
            raise ProblemError(
                f"{key} is not a key that an address may change; expected a key of one of the tables "
                f"{', '.join(TABLES)}"
            )
    if len(setting.events) > MOST_EVENTS:
        raise ProblemError(
            f"there are {number_of(len(setting.events), 'event')}; expected at most {MOST_EVENTS} events"
        )
    return setting


def setting_for(path: str, functions: bool = True) -> tuple[Setting, Trusted | None]:
    """Return the setting of a built-in problem or a problem file, and a file's content as ``Trusted``."""
    file = Path(path)
    if not file.is_file():
        load(path, functions=functions)  # raises an error for a name that is not that of a built-in problem
        return Setting(name=path), None
    load(file, functions=functions)
    text = read_text(file, LARGEST)
    return Setting(file=text), Trusted(text, str(file.absolute().parent), path)


def built_in() -> list[str]:
    """Return the names of the built-in problems."""
    return sorted(file.stem for folder in problem_folders() for file in folder.glob("*.toml"))


def settings_of(setting: Setting, items: list[str], trusted: Trusted | None) -> Setting:
    """Return a setting with the changes that command-line options ``--set NAME=VALUE`` give."""
    values = {
        name if "." in name else f"policy.{name}": cast("Value", value) for name, value in parse_settings(items).items()
    }
    found, base = checked(setting.to(values)), setting.base(trusted)
    found.problem(base)
    return found.stated(base)


def _tables(text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ProblemError(
            "the problem is not valid TOML: its values are nested too deeply; expected tables whose values are at "
            "most matrices"
        ) from None
    except ValueError as error:
        raise ProblemError(f"the problem is not valid TOML: {error}; expected a problem file") from None


def _refuse_reading(tables: Mapping[str, Any]) -> None:
    """Refuse the tables of an address that name a file, since reading it is not the choice of the page's user."""
    for key, value in tables.items():
        if key in READING:
            raise ProblemError(
                f"the problem in this address has the key {key}, which names a file on this machine; expected a "
                "problem without this key: download the file, and open it with taciturn explore FILE"
            )
        for one in cast("list[Any]", value) if isinstance(value, list) else [value]:
            if isinstance(one, Mapping):
                _refuse_reading(cast("Mapping[str, Any]", one))


def _scaled(base: Problem, key: str, factor: Value) -> list[list[float]]:
    rows = _at(base.source or {}, key)
    if not is_matrix(rows):
        raise ProblemError(
            f"the factor {FACTOR}{key} is given, but the file has no matrix {key}; expected no factor {FACTOR}{key}"
        )
    return [[float(cast("float", factor)) * entry for entry in row] for row in rows]


def is_matrix(rows: object) -> bool:
    """Return whether a value is a matrix, that is, a list of rows of numbers."""
    return isinstance(rows, list) and all(isinstance(row, list) for row in cast("list[object]", rows))


def _at(tables: Mapping[str, Any], key: str) -> Any:
    """Return the value at a dotted key of tables, or None."""
    found: Any = tables
    for part in key.split("."):
        found = cast("Mapping[str, Any]", found).get(part) if isinstance(found, Mapping) else None
    return found


def value_at(base: Problem, key: str) -> Any:
    """Return the value of a dotted key in a problem's file; None if the file does not contain the key."""
    return _at(base.source or {}, key)


def _neutral(key: str) -> Value:
    return 1.0 if key.startswith(FACTOR) else None


def _same(stated: object, value: Value) -> bool:
    return (
        type(stated) in (int, float, str, bool)
        and isinstance(stated, str) == isinstance(value, str)
        and (stated == value)
    )


def _value_text(value: Value) -> str:
    if isinstance(value, str):
        return value if isinstance(_value_of(value), str) else json.dumps(value)
    return json.dumps(value)


def _value_of(text: str) -> Value:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return text
    if isinstance(found, float) and not math.isfinite(found):
        raise ProblemError(f"a value is {quoted(text)}; expected a finite number")
    return found if isinstance(found, int | float | str | bool) or found is None else text


def whole_number(key: str, text: str, high: int, low: int = 0) -> int:
    """Convert a text to a whole number, and check that it lies within limits."""
    found = int(text) if text.isascii() and text.isdigit() and len(text) <= len(str(high)) else -1
    if not low <= found <= high:
        raise ProblemError(f"{key} is {text[:40] or 'empty'}; expected a whole number from {low} to {high}")
    return found


def _packed(text: str) -> str:
    return base64.urlsafe_b64encode(zlib.compress(text.encode(), 9)).decode().rstrip("=")


def _unpacked(text: str) -> str:
    try:
        packed = base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))
        opened = zlib.decompressobj()
        found = opened.decompress(packed, LARGEST)
        if not opened.eof:
            raise ValueError
        return found.decode()
    except (binascii.Error, zlib.error, ValueError):
        raise ProblemError(
            "the problem file in this address is damaged; expected the complete address, as the page copied it"
        ) from None
