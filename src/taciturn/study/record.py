"""Encoding of results as text that restores them exactly, and digests of the data behind the results."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, cast, get_args, get_type_hints

import numpy as np

from taciturn._version import __version__
from taciturn.model.dynamics import Dynamics
from taciturn.model.link import IDEAL_LINK
from taciturn.model.plant import Plant
from taciturn.problem import Problem
from taciturn.program.ir import Builder, Program
from taciturn.program.trace import trace
from taciturn.study.evaluation import Evaluation

KIND = "kind of data"  # key for the class of the data in a mapping
NONE = ("operating_point", "drift", "input_rate", "changes", "max_interval")
LATER: Mapping[str, object] = {**dict.fromkeys(NONE), "min_interval": 1}  # neutral values that digests do not contain


def encode(value: object) -> str:
    """Return data classes, arrays, mappings, sequences, numbers and words as JSON; equal data give equal text."""
    return json.dumps(_plain(value), sort_keys=True, separators=(",", ":"))


def decode(text: str) -> Any:
    """Return the data of an encoded text; sequences become tuples.

    Raises:
        ValueError: the text is not JSON, is nested too deeply, or names an unknown class of data.
    """
    try:
        return _restored(json.loads(text))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def digest(text: str) -> str:
    """Return the SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def fingerprint(problem: Problem) -> str:
    """Return the digest of all data of a problem."""
    short = problem.network.shorthand
    network = problem.network if short is None else {**short, KIND: "Network"}
    stated = (problem.plant, problem.cost, network, problem.actual, problem.reference)
    own: list[object] = [] if problem.record.in_house else [problem.record.identity]
    own += [one for one in (problem.controller, problem.limits) if one is not None]
    if short is not None:  # it has no prices, energies and limits of intervals
        laws = problem.network.links.items()
        paid = {link: [law.price, law.energy, law.battery] for link, law in laws if law.price != 1.0 or law.energy}
        limits = {link: law.intervals for link, law in laws if law.intervals != IDEAL_LINK.intervals}
        own += [found for found in (paid, limits) if found]
    return digest(encode([stated, problem.kind, problem.parameters, *own]))


def origin(
    problem: Problem | Mapping[str, Problem] | None = None, seed: int | None = None, method: str | None = None
) -> dict[str, Any]:
    """Return the data needed to reproduce a result, as JSON documents and files contain them.

    Args:
        problem: the problem that was solved, or several by name; None for no problem.
        seed: seed of the random numbers; None if nothing was drawn.
        method: method that gave the numbers; None if nothing was computed.

    Returns:
        ``version``, ``seed``, ``method``, and ``problem_digest``: one digest, or one for each name.
    """
    found: dict[str, Any] = {"version": __version__}
    found |= {} if seed is None else {"seed": seed}
    found |= {} if method is None else {"method": method}
    if isinstance(problem, Mapping):
        return found | {"problem_digest": {name: fingerprint(one) for name, one in problem.items()}}
    return found if problem is None else found | {"problem_digest": fingerprint(problem)}


def _operations(plant: Plant, function: Dynamics) -> Program:
    """Return the operations of a plant's function, which include the effect of variables in its scope."""
    builder, sizes = Builder(), {"x": plant.states, "u": plant.inputs, "w": plant.states}
    given = {name: [builder.input(f"{name} {i}") for i in range(size)] for name, size in sizes.items()}
    moved = trace(builder, function.function, given, {"x": plant.states})["x"]
    return builder.finish([], {}, {f"x {i}": index for i, index in enumerate(moved)})


def _plain(value: object) -> object:
    if isinstance(value, Plant):
        held = _fields(value, "function")
        moved = {} if value.function is None else {"function": _plain(_operations(value, value.function))}
        return held | moved | {KIND: "Plant"}
    if is_dataclass(value) and not isinstance(value, type):
        return _fields(value) | {KIND: type(value).__name__}
    if isinstance(value, np.ndarray):
        array = cast("np.ndarray[Any, Any]", value)
        return {KIND: "array", "type": array.dtype.str, "shape": array.shape, "values": array.ravel().tolist()}
    if isinstance(value, np.generic):
        return cast("Any", value).item()
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in cast("Mapping[object, object]", value).items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in cast("Iterable[object]", value)]
    return value


def _fields(value: Any, *apart: str) -> dict[str, object]:
    """Return the fields of a dataclass, without later ones that are neutral, which digests of earlier versions lack."""
    held = {field.name: getattr(value, field.name) for field in fields(value) if field.name not in apart}
    plain = {name: _plain(one) for name, one in held.items()}
    return {name: one for name, one in plain.items() if name not in LATER or one != LATER[name]}


def _restored(value: object) -> Any:
    if isinstance(value, list):
        return tuple(_restored(one) for one in cast("list[object]", value))
    if not isinstance(value, dict):
        return value
    held = cast("dict[str, Any]", value)
    kind = held.pop(KIND, None)
    if kind is None:
        return {key: _restored(one) for key, one in held.items()}
    if kind == "array":
        return np.array(held["values"], dtype=held["type"]).reshape(held["shape"])
    if kind not in _recorded():
        raise ValueError(f"{kind} is not a class of result data")
    try:
        return _recorded()[kind](**{key: _restored(one) for key, one in held.items()})
    except TypeError as error:
        raise ValueError(str(error)) from None


@cache
def _recorded() -> Mapping[str, Callable[..., Any]]:
    """Return the classes of an evaluation by name: itself, and all of which its fields can be, however deep."""
    found, left = dict[str, Callable[..., Any]](), list[Any]([Evaluation])
    while left:
        kind = left.pop()
        if is_dataclass(kind) and isinstance(kind, type) and kind.__name__ not in found:
            found[kind.__name__] = kind
            left += get_type_hints(kind).values()
        left += get_args(kind)
    return found
