"""Storage of results in a folder, as text that restores them exactly, with digests of the data they depend on.

``encode`` writes the fields of a result and of its parts as JSON, each with the name of its class. ``decode`` restores
any ``Result``: it finds the class of the result by its name, and those of its parts in the types of its fields. So a
new result, or a new part of one, needs no entry here. A result that contains a problem or a loop is not restored, since
functions of a plant are written as their operations; the problem file states them.

``fingerprint`` is the digest of all data of a problem. A ``Store`` is a folder with one file per cell of a sweep, each
under the digest of the data on which it depends, so that an interrupted sweep can continue.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, get_args, get_type_hints

import numpy as np

from taciturn._files import PART, read_bytes, why_unreadable, write_whole
from taciturn._text import number_of
from taciturn._version import __version__
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.dynamics import Dynamics
from taciturn.model.link import IDEAL_LINK
from taciturn.model.network import Network
from taciturn.model.plant import Plant
from taciturn.model.result import Result
from taciturn.problem import Problem
from taciturn.program.ir import Builder, Program
from taciturn.program.tracing import trace

if TYPE_CHECKING:
    import xarray

STATED = (Problem, Loop)
KIND = "kind of data"  # key for the class of the data in a mapping
NONE = ("operating_point", "drift", "input_rate", "changes", "max_interval", "delay", "buffer", "transport")
NONE += ("oldest", "of_age")
# neutral values that digests do not contain
LATER: Mapping[str, object] = {
    **dict.fromkeys(NONE),
    "min_interval": 1,
    "missing": {},
    "quantities": [],
    "stored": [],
    "acknowledgement_delay": 0,
}


def encode(value: object) -> str:
    """Write data classes, arrays, mappings, sequences, numbers and texts as JSON. Equal data give equal text."""
    return json.dumps(_plain(value), sort_keys=True, separators=(",", ":"))


def decode(text: str) -> Any:
    """Restore the data that ``encode`` has written. Sequences become tuples."""
    try:
        return _restored(json.loads(text))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def digest(text: str) -> str:
    """Compute the SHA-256 digest of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def fingerprint(problem: Problem) -> str:
    """Compute the digest of all data of a problem."""
    network, paid = (problem.network, []) if problem.network.own_nodes else _short(problem.network)
    stated = (problem.plant, problem.cost, network, problem.actual, problem.reference)
    own: list[object] = [] if problem.record.in_house else [problem.record.identity]
    own += [one for one in (problem.controller, problem.limits) if one is not None]
    return digest(encode([stated, problem.kind, problem.parameters, *own, *paid]))


def _short(network: Network) -> tuple[dict[str, object], list[object]]:
    """Return the links of the usual nodes as the arguments that describe them, and what has no argument, if given."""
    laws = network.links.items()
    paid = {link: [law.price, law.energy, law.battery] for link, law in laws if law.price != 1.0 or law.energy}
    limits = {link: law.intervals for link, law in laws if law.intervals != IDEAL_LINK.intervals}
    late = {link: [law.delay, law.buffer] for link, law in laws if law.timed}
    late |= {link: [*late[link], law.acknowledgement_delay] for link, law in laws if law.acknowledgement_delay}
    found: dict[str, object] = {"protocol": network.protocol, "delay": network.delay, "payload": network.payload}
    for link, law in laws:
        found |= {f"{link}_loss": law.loss, f"{link}_burst": law.burst, f"{link}_range": law.range}
    return found | {KIND: "Network"}, [one for one in (paid, limits, dict(network.missing), late) if one]


def origin(
    problem: Problem | Mapping[str, Problem] | None = None, seed: int | None = None, method: str | None = None
) -> dict[str, Any]:
    """Return the data with which a result can be reproduced: version, digest of the problem, seed and method."""
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
    counted = [field.name for field in fields(value) if field.compare and field.name not in apart]
    held = {name: getattr(value, name) for name in counted}
    plain = {name: _plain(one) for name, one in held.items()}
    return {name: one for name, one in plain.items() if name not in LATER or one != LATER[name]}


def _restored(value: object, known: Mapping[str, Callable[..., Any]] | None = None) -> Any:
    """Return the data of JSON, with the classes that can be parts of the result around it."""
    if isinstance(value, list):
        return tuple(_restored(one, known) for one in cast("list[object]", value))
    if not isinstance(value, dict):
        return value
    held = cast("dict[str, Any]", value)
    kind = held.pop(KIND, None)
    if kind is None:
        return {key: _restored(one, known) for key, one in held.items()}
    if kind == "array":
        return np.array(held["values"], dtype=held["type"]).reshape(held["shape"])
    known = _parts(_result(kind)) if known is None else known
    if kind not in known:
        raise ValueError(f"{kind} is not a class of result data")
    try:
        return known[kind](**{key: _restored(one, known) for key, one in held.items()})
    except TypeError as error:
        raise ValueError(str(error)) from None


def _result(name: str) -> type[Result] | None:
    """Return the class of results with a name, if its module is loaded."""
    left = [Result]
    while left:
        kind = left.pop()
        if kind.__name__ == name:
            return kind
        left += kind.__subclasses__()
    return None


@cache
def _parts(result: type[Result] | None) -> Mapping[str, Callable[..., Any]]:
    """Return the classes of a result by name: itself, and all of which its fields can be, however deep."""
    found, left = dict[str, Callable[..., Any]](), list[Any]([result])
    while left:
        kind = left.pop()
        if is_dataclass(kind) and isinstance(kind, type) and kind.__name__ not in found and kind not in STATED:
            found[kind.__name__] = kind
            types = get_type_hints(kind)
            left += [*(types[field.name] for field in fields(kind)), *kind.__subclasses__()]
        left += get_args(kind)
    return found


LABEL = "store.json"
TOLD = logging.getLogger(__name__)
_READ_ONLY = errno.EROFS, errno.EACCES, errno.EPERM
LARGEST = 2**30  # bytes of a file of a store
FORGOTTEN = 3600.0  # seconds after which an incomplete file is deleted


class Store:
    """Folder in which answers are stored. A file's name is the digest of the data on which its answer depends.

    A file contains a digest of its key and its text, then the text, and is renamed to its final name only when it is
    complete. So all stored answers are complete, even after a crash, and a file under the name of another answer is
    detected. Answers for another problem or version stay in the store but are not used. A store on a read-only disk can
    be read.
    """

    def __init__(self, folder: str | Path, label: dict[str, str]) -> None:
        """Open the folder, and check whether another problem or version filled it."""
        self.folder, self._filled_by = Path(folder), ""
        try:
            self._open(label)
        except OSError as error:
            raise ProblemError(
                f"the store {str(folder)!r} cannot be used ({why_unreadable(error)}); expected a writable folder"
            ) from None

    def count(self) -> int:
        """Return the number of stored answers, for all problems and versions."""
        return sum(path.suffix != PART for path in self.folder.glob("cells/*/*"))

    def holds(self, key: str) -> bool:
        """Check whether there is a file for an answer. The file may be damaged."""
        return self._path(key).is_file()

    def tell(self, found: int, asked: int) -> None:
        """Log how many of the requested answers are stored already, and how many other answers the folder contains.

        Warn if no requested answer is found in a store that another problem or version filled.
        """
        others = self.count() - found
        if self._filled_by and not found:
            warnings.warn(
                f"the store {str(self.folder)!r} was filled by another {self._filled_by}: its answers stay in the "
                "store and are not used here",
                stacklevel=2,
            )
        elif found or others:
            rest = (
                f"; {others} other answers in it are for other values, or for another precision, seed, problem or "
                "version: they stay in the store, unused"
            )
            TOLD.info("%d of %s: read from %s%s", found, number_of(asked, "cell"), self.folder, rest if others else "")

    def read(self, key: str) -> object | None:
        """Read the answer stored for a key; return None if there is none.

        A file that is damaged, or that is the file of another key under this name, is deleted with a warning.
        """
        path = self._path(key)
        try:
            kept, _, text = read_bytes(path, LARGEST).decode().partition("\n")
            if _digest_under(key, text) == kept:
                return decode(text)
        except FileNotFoundError:
            return None
        except (OSError, ValueError):
            pass
        warnings.warn(
            f"the file {str(path)!r} of the store is damaged, or is the file of another cell under this name; the cell "
            "is computed again",
            stacklevel=2,
        )
        with suppress(OSError):
            path.unlink()
        return None

    def write(self, key: str, answer: object) -> None:
        """Store an answer for a key."""
        text = encode(answer)
        try:
            write_whole(self._path(key), f"{_digest_under(key, text)}\n{text}".encode())
        except OSError as error:
            raise ProblemError(
                f"the store {str(self.folder)!r} cannot be written to ({error.strerror}); its results are intact: "
                "free disk space, or correct the cause, and run again to continue"
            ) from None

    def _path(self, key: str) -> Path:
        return self.folder / "cells" / key[:2] / key[2:]

    def _open(self, label: dict[str, str]) -> None:
        if self.folder.is_file():
            raise ProblemError(f"the store {str(self.folder)!r} is a file; expected a folder or an unused name")
        sign, cells = self.folder / LABEL, self.folder / "cells"
        self.folder.mkdir(parents=True, exist_ok=True)
        others = sorted(found.name for found in self.folder.iterdir() if found.suffix != PART)
        if others and LABEL not in others and "cells" not in others:
            raise ProblemError(
                f"the folder {str(self.folder)!r} is not a store and contains other files, such as {others[0]!r}; "
                "expected an empty folder, a new folder, or a store"
            )
        text = encode(label)
        before = read_bytes(sign, LARGEST).decode(errors="replace") if LABEL in others else text
        if before != text:
            self._filled_by = self._differences(before, label)
        if before != text or LABEL not in others:
            try:
                write_whole(sign, text.encode())
            except OSError:
                if "cells" not in others:  # otherwise the answers can be read
                    raise
        for part in (*self.folder.glob(f"*{PART}"), *cells.glob(f"*/*{PART}")):
            with suppress(OSError):
                if time.time() - part.stat().st_mtime > FORGOTTEN:
                    part.unlink()

    def _differences(self, before: str, label: dict[str, str]) -> str:
        """Return the differences between the label of the store and the given label."""
        try:
            kept = dict(decode(before))
        except (ValueError, TypeError):
            warnings.warn(f"{LABEL} of the store {str(self.folder)!r} is damaged and is written again", stacklevel=4)
            return ""
        return "; ".join(
            f"{name} {kept.get(name)!s:.12}, now {now:.12}" for name, now in label.items() if kept.get(name) != now
        )


def _digest_under(key: str, text: str) -> str:
    """Return the digest of an answer's text under its key."""
    return digest(f"{key}\n{text}")


def save_whole(result: xarray.Dataset, path: Path) -> tuple[bool, str]:
    """Write a result as netCDF, atomically. If the file exists, it is left if equal, and is renamed if different."""
    whole: Any = result  # xarray's types are incomplete
    content = bytes(whole.to_netcdf(None, engine="h5netcdf"))  # in memory, as HDF5 aborts the process on a full disk
    note = ""
    try:
        before = read_bytes(path, max(LARGEST, len(content))) if path.exists() else None
        if before == content:
            return True, ""
        if before is not None:
            aside = path.with_stem(f"{path.stem}-{hashlib.sha256(before).hexdigest()[:12]}")
            write_whole(aside, before)
            note = f"{path} contained another result, which was renamed to {aside.name}"
        write_whole(path, content)
        return True, note
    except OSError as error:
        if error.errno in _READ_ONLY:
            return False, f"{path} is not written ({error.strerror}); --table writes the results to another folder"
        raise ProblemError(
            f"the file {str(path)!r} cannot be written ({why_unreadable(error)}); the results are in the store: free "
            "disk space, or correct the cause, and run again"
        ) from None
