"""Results as text that gives the same bits again, and digests of what they were computed from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, cast

import numpy as np

from taciturn.analyse.limits import LowerBound
from taciturn.model.dynamics import Dynamics
from taciturn.model.estimate import Estimate
from taciturn.model.plant import Plant
from taciturn.model.schedule import Schedule
from taciturn.problem import Problem
from taciturn.program.ir import Builder, Program
from taciturn.program.trace import trace
from taciturn.study.clock import ClockMix, ClockPoint
from taciturn.study.evaluate import Evaluation, Linearisation

KIND = "kind of data"  # key of what a mapping stands for
RECORDED = {
    known.__name__: known for known in (Evaluation, Estimate, Linearisation, LowerBound, Schedule, ClockMix, ClockPoint)
}


def encode(value: object) -> str:
    """Return JSON text of data classes, arrays, mappings, sequences, numbers and words; equal data give equal text."""
    return json.dumps(_plain(value), sort_keys=True, separators=(",", ":"))


def decode(text: str) -> Any:
    """Return what was encoded; sequences come back as tuples.

    Raises:
        ValueError: the text is not JSON, or names data that are unknown here.
    """
    return _restored(json.loads(text))


def digest(text: str) -> str:
    """Return the SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def fingerprint(problem: Problem) -> str:
    """Return the digest of all that a problem states."""
    stated = (problem.plant, problem.cost, problem.network, problem.actual, problem.reference)
    return digest(encode([stated, problem.kind, problem.parameters]))


def _operations(plant: Plant, function: Dynamics) -> Program:
    """Return what a plant's function computes, in which all shows that its text, or values in its scope, decide."""
    builder, sizes = Builder(), {"x": plant.states, "u": plant.inputs, "w": plant.states}
    given = {name: [builder.input(f"{name} {i}") for i in range(size)] for name, size in sizes.items()}
    moved = trace(builder, function.function, given, {"x": plant.states})["x"]
    return builder.finish([], {}, {f"x {i}": index for i, index in enumerate(moved)})


def _plain(value: object) -> object:
    if isinstance(value, Plant):
        held = {field.name: _plain(getattr(value, field.name)) for field in fields(value) if field.name != "function"}
        moved = {} if value.function is None else {"function": _plain(_operations(value, value.function))}
        return held | moved | {KIND: "Plant"}
    if is_dataclass(value) and not isinstance(value, type):
        held = {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
        return held | {KIND: type(value).__name__}
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
    if kind not in RECORDED:
        raise ValueError(f"{kind} is no data of a result")
    try:
        return RECORDED[kind](**{key: _restored(one) for key, one in held.items()})
    except TypeError as error:
        raise ValueError(str(error)) from None
