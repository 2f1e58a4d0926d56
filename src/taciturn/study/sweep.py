"""Sweeps: a problem over a grid of its values, as labelled arrays."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import platform
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from taciturn._arrays import instance, quoted
from taciturn._files import write_whole
from taciturn._progress import Progress
from taciturn._version import __version__
from taciturn.errors import ProblemError, TaciturnError
from taciturn.problem import Problem, expect_problem
from taciturn.simulation.average import check_effort
from taciturn.study.cells import Cell, Cells, Effort, Refusal, check_confidence, run_cells
from taciturn.study.evaluate import Evaluation
from taciturn.study.record import digest, encode, fingerprint
from taciturn.study.store import Store

if TYPE_CHECKING:
    import pandas
    import xarray

LARGEST = 2**63  # of whole numbers that a file holds
TAKEN = ("drop", "method", "tolerance")  # what the selection of labelled arrays calls its own arguments


def sweep(
    problem: Problem,
    over: Mapping[str, Sequence[object]],
    *,
    executor: Executor | None = None,
    store: str | Path | None = None,
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    confidence: float | None = None,
    progress: Progress | None = None,
) -> xarray.Dataset:
    """Return cost and rates of a problem's policy over a grid, one dimension per name.

    Each cell has a seed of its own, from ``seed`` and its values alone, so that a cell is the same in every grid, in
    every order, on every worker. What a cell cannot answer is missing there (NaN, an empty word), its reason in the
    variable ``refusal``, and a warning says how many there are.

    Args:
        problem: each cell changes the named keys.
        over: the values of each key (of ``[policy]``, or dotted); several keys make a grid.
        executor: runs blocks of cells: threads, processes, ``dask.distributed``'s ``Client.get_executor()``,
            ``mpi4py.futures.MPIPoolExecutor``, or any other; omitted: cell after cell here, on all processors.
        store: folder that keeps one file per cell; a second run computes only what is missing, or belonged to another
            problem or version.
        seed: of all draws, at least 0.
        standard_error: absolute, of each cost; omitted: 1e-4 of it.
        steps: of each simulation, instead of a standard error.
        confidence: with which a lower bound is to hold of the cost of any scheduling, in cells that have one; omitted:
            none is sought.
        progress: called with the fraction done.

    Returns:
        ``cost``, ``cost_standard_error``, ``rate_actuator``, ``rate_sensor``, … over the swept names; units, problem,
        version, seed and machine in the attributes.

    Raises:
        ProblemError: no values, values that are given twice, an unknown key, data that do not fit, a store that cannot
            be used, or an executor that fails; what was computed stays in the store.

    Example:
        >>> from taciturn import load
        >>> found = sweep(load("double-integrator"), {"kind": ["consistent"], "period": [0.25, 0.5]})
        >>> bool(found.cost.sel(period=0.25) < found.cost.sel(period=0.5))
        True
    """
    expect_problem("problem", problem)
    check_effort(seed, standard_error, steps)
    listed = check_grid(over)
    for name in listed:
        if _path(name) == ["policy", "seed"]:
            raise ProblemError(
                "seed is no key of a problem; expected a sweep for each seed (--seed, seed=), all into one store"
            )
        if name in TAKEN:
            raise ProblemError(f"{name} names a dimension that labels cannot select; expected policy.{name}")
    axes = {name: _labels(name, values) for name, values in listed.items()}
    _check_axes(problem, listed, confidence)
    cells = _Grid(listed, seed)
    label = label_of(problem)
    table = _Table(cells.shape)
    kept = None if store is None else Store(store, label)
    for index, answer in run_cells(problem, cells, Effort(standard_error, confidence, steps), executor, kept, progress):
        table.put(index, cells[index].seed, answer)
    table.tell(cells)
    label |= {"seed": str(seed), "machine": f"{platform.machine()}, {platform.system()}"}
    return table.dataset(axes, label)


def label_of(problem: Problem) -> dict[str, str]:
    """Return what tells a sweep's results from others': problem and version."""
    return {"problem": fingerprint(problem), "version": __version__}


def check_grid(over: Mapping[str, Sequence[object]]) -> dict[str, list[object]]:
    """Return the values of each name as lists.

    Raises:
        ProblemError: no names, no values, a value twice, or no list.
    """
    instance("over", over, Mapping)
    listed: dict[str, list[object]] = {}
    for name, values in over.items():
        instance("a name in over", name, str)
        plain = _plain(name, values)
        if not isinstance(plain, list):
            raise ProblemError(f"the values of {name} are {quoted(values)}; expected a list of values, as [0.1, 1.0]")
        listed[name] = cast("list[object]", plain)
        _labels(name, listed[name])
        path = _path(name)
        for other in itertools.islice(listed, len(listed) - 1):
            if path[: len(_path(other))] == _path(other) or path == _path(other)[: len(path)]:
                raise ProblemError(f"{other} and {name} are the same, or one in the other; expected one of them")
    if not listed or not all(listed.values()):
        raise ProblemError("there are no values; expected a name with at least one value, as theta=0.1,1")
    return listed


def _path(name: str) -> list[str]:
    """Return the tables and the key that a name stands for."""
    path = name.split(".")
    return path if len(path) > 1 else ["policy", *path]


def _plain(name: str, value: object) -> object:
    """Return a value as a file would state it: arrays as rows.

    Raises:
        ProblemError: no file can state it.
    """
    if hasattr(value, "tolist"):  # arrays and numbers of NumPy
        value = cast("Any", value).tolist()
    elif hasattr(value, "values") and not isinstance(value, Mapping):  # labelled arrays
        value = cast("Any", value).values.tolist()
    if isinstance(value, Mapping):
        table = cast("Mapping[object, object]", value)
        return {str(key): _plain(name, one) for key, one in table.items()}
    if isinstance(value, list | tuple | range):
        return [_plain(name, one) for one in cast("Iterable[object]", value)]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ProblemError(f"a value of {name} is {quoted(value)}; expected numbers, words, lists or arrays of them")


def grid_of(listed: Mapping[str, Sequence[object]]) -> list[dict[str, object]]:
    """Return every combination of values, the last name fastest."""
    return [dict(zip(listed, values, strict=True)) for values in itertools.product(*listed.values())]


def _labels(name: str, values: Sequence[object]) -> list[Any]:
    """Return the coordinates of a dimension: numbers or words as they are, anything else as JSON.

    Raises:
        ProblemError: two are the same.
    """
    numbers = all(isinstance(one, float) or (isinstance(one, int) and abs(one) < LARGEST) for one in values)
    plain = numbers or all(isinstance(one, str) for one in values)
    labels: list[Any] = [one if plain else json.dumps(json.loads(encode(one))) for one in values]
    twice = next((one for one in labels if labels.count(one) > 1), None) if len(set(labels)) < len(labels) else None
    if twice is not None:
        raise ProblemError(f"{name} has the value {twice} twice; expected each once")
    return labels


def _check_axes(problem: Problem, listed: Mapping[str, Sequence[object]], confidence: float | None) -> None:
    """Design the policy at the first value of every name, and at the end of each; tell mistakes before cells run.

    Raises:
        TaciturnError: what is wrong with the first of them, where no other is right, or that none has the lower bound
            that is asked for.
    """
    first = {name: values[0] for name, values in listed.items()}
    checked = [first] + [first | {name: values[-1]} for name, values in listed.items() if len(values) > 1]
    problems: list[Problem] = []
    wrong: list[TaciturnError] = []
    for values in checked:
        try:
            problems.append(problem.changed(values))
            problems[-1].designed()
        except TaciturnError as error:
            wrong.append(error)
    if len(wrong) == len(checked):
        raise wrong[0]
    check_confidence(problems, confidence)


class _Grid:
    """The cells of a grid, the last name fastest; each is made when it is asked for, since there may be millions.

    Args:
        listed: the values of each name.
        seed: of the sweep.
    """

    def __init__(self, listed: dict[str, list[object]], seed: int) -> None:
        """Make none yet."""
        self.shape = tuple(len(values) for values in listed.values())
        self._listed, self._seed = listed, seed

    def __len__(self) -> int:
        """Return how many there are."""
        return math.prod(self.shape)

    def __getitem__(self, index: int, /) -> Cell:
        """Return one of them."""
        values: dict[str, object] = {}
        for name, listed in reversed(self._listed.items()):
            index, place = divmod(index, len(listed))
            values[name] = listed[place]
        values = dict(reversed(values.items()))
        return Cell(values, _seed_of(self._seed, values))


def _seed_of(seed: int, values: Mapping[str, object]) -> int:
    """Return a cell's own seed, one that ``taciturn evaluate --seed`` takes."""
    stated = {".".join(_path(name)): _as_float(value) for name, value in values.items()}
    words = np.frombuffer(bytes.fromhex(digest(encode(stated))), dtype=np.uint32)
    return int(np.random.SeedSequence(seed, spawn_key=tuple(int(word) for word in words[:4])).generate_state(1)[0])


def _as_float(value: object) -> object:
    """Return a value in which 1 is 1.0, and −0 is 0."""
    if isinstance(value, list):
        return [_as_float(one) for one in cast("list[object]", value)]
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) >= LARGEST:
        return value
    return float(value) + 0.0


@dataclass(frozen=True)
class _Column:
    """A number or a word of every answer, None where it has none; what stands there instead, and the unit."""

    of: Callable[[Evaluation], float | str | None]
    unit: Callable[[Evaluation], str] = lambda found: ""
    missing: float | str = math.nan


def _per(found: Evaluation) -> str:
    return f"cost per {found.unit}"


def _sends(found: Evaluation) -> str:
    return f"sends per {found.rate_unit}"


COLUMNS = {
    "cost": _Column(lambda found: found.cost.value, _per),
    "cost_standard_error": _Column(lambda found: found.cost.standard_error, _per),
    "cost_error": _Column(lambda found: found.cost.error, _per),
    "cost_method": _Column(lambda found: found.cost.method, missing=""),
    "cost_all_time": _Column(lambda found: found.cost_all_time, _per),
    "cost_bound": _Column(lambda found: found.cost_bound, _per),
    "cost_bound_at_rate": _Column(lambda found: found.cost_bound_at_rate, _per),
    **{
        f"linearisation_{name}": _Column(lambda found, name=name: getattr(found.linearisation, name, None), _per)
        for name in ("cost_all_time", "cost_bound")
    },
    "cost_periodic_same_rate": _Column(lambda found: found.cost_periodic_same_rate, _per),
    "cost_lower_bound": _Column(lambda found: None if found.lower_bound is None else found.lower_bound.cost, _per),
    "mean_interval": _Column(
        lambda found: None if found.mean_interval is None else found.mean_interval.value, lambda found: "s"
    ),
    "steps": _Column(lambda found: found.steps, missing=0),
    "reached": _Column(lambda found: found.reached, missing=False),
    **{
        f"rate_{link}{suffix}": _Column(
            lambda found, link=link, part=part: getattr(found.rates[link], part) if link in found.rates else None,
            _sends,
        )
        for link in ("actuator", "sensor")
        for suffix, part in (("", "value"), ("_standard_error", "standard_error"))
    },
    "rate_lowest": _Column(lambda found: None if found.rate_bounds is None else found.rate_bounds[0], _sends),
    "rate_highest": _Column(lambda found: None if found.rate_bounds is None else found.rate_bounds[1], _sends),
}


class _Table:
    """The columns of a sweep, filled as answers come."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.shape, size = shape, math.prod(shape)
        self.refusals, self.seeds = np.full(size, "", dtype=object), np.zeros(size, dtype=np.int64)
        self.columns: dict[str, np.ndarray[Any, Any]] = {}
        self.units: dict[str, str] = {}
        self.refused: list[int] = []

    def put(self, index: int, seed: int, answer: Evaluation | Refusal) -> None:
        """Write the answer of a cell."""
        self.seeds[index] = seed
        if isinstance(answer, Refusal):
            self.refusals[index] = str(answer.error)
            self.refused.append(index)
            return
        for name, column in COLUMNS.items():
            value = column.of(answer)
            if value is None:
                continue
            if name not in self.columns:
                kind = object if isinstance(value, str) else np.asarray(column.missing).dtype
                self.columns[name] = np.full(len(self.seeds), column.missing, dtype=kind)
                self.units[name] = column.unit(answer)
            elif self.units[name] != column.unit(answer):
                raise ProblemError(
                    f"the grid mixes {self.units[name]} and {column.unit(answer)}; expected one: sweep them apart"
                )
            self.columns[name][index] = value

    def tell(self, cells: Cells) -> None:
        """Warn of cells without an answer.

        Raises:
            ProblemError: none has one.
        """
        if not self.refused:
            return
        first = min(self.refused)
        where = ", ".join(f"{name}={value}" for name, value in cells[first].values.items())
        sentence = f"{len(self.refused)} of {len(cells)} cells have no answer, first at {where}: {self.refusals[first]}"
        if len(self.refused) == len(cells):
            raise ProblemError(sentence)
        warnings.warn(sentence, stacklevel=3)

    def dataset(self, axes: Mapping[str, Sequence[Any]], attributes: Mapping[str, Any]) -> xarray.Dataset:
        """Return the columns over the grid, in the order in which they are listed here."""
        import xarray

        held = self.columns | {"seed": self.seeds, "refusal": self.refusals}
        ordered = [name for name in (*COLUMNS, "seed", "refusal") if name in held]
        units = {name: {"units": unit} for name, unit in self.units.items() if unit}
        whole = {name: (tuple(axes), held[name].reshape(self.shape), units.get(name, {})) for name in ordered}
        return xarray.Dataset(whole, coords=dict(axes), attrs=dict(attributes))


def save_whole(result: xarray.Dataset, path: Path) -> Path | None:
    """Write a result as netCDF, under its name once it is whole.

    Returns:
        Where another result that had the name is kept: its digest is put after the name.

    Raises:
        ProblemError: a file cannot be written.
    """
    whole: Any = result  # whose types are open
    content = bytes(whole.to_netcdf(None, engine="h5netcdf"))  # HDF5 itself ends the process where a disk is full
    aside: Path | None = None
    try:
        before = path.read_bytes() if path.exists() else content
        if before != content:
            aside = path.with_stem(f"{path.stem}-{hashlib.sha256(before).hexdigest()[:12]}")
            write_whole(aside, before)
        write_whole(path, content)
        return aside
    except OSError as error:
        raise ProblemError(
            f"{str(path)!r} cannot be written ({error.strerror}); what was computed is kept: make room, or mend "
            "what is wrong, and run again"
        ) from None


def table_of(result: xarray.Dataset) -> pandas.DataFrame:
    """Return a result as a table: a row for each cell, a column for each name; its attributes in ``attrs``.

    Raises:
        ProblemError: pandas is not installed.
    """
    frame = result.to_dataframe().reset_index()
    frame.attrs.update(result.attrs)
    return frame
