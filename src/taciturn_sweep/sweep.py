"""Sweeps: evaluations of a problem over a grid of values, returned as labelled arrays.

The cells of the grid are computed in blocks on many processors, and each result is kept in a store when it is finished,
so that a sweep continues after a stop (``taciturn_studies.points``). ``SweepTable`` is the result as rows, for pandas,
CSV files and LaTeX.
"""

from __future__ import annotations

import itertools
import math
import platform
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np

from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import (
    HEIGHT,
    Panel,
    Progress,
    Series,
    Size,
    StyleName,
    Thing,
    answered_within,
    draw,
    in_notebook,
    number_of,
    policy_looks,
    symbol,
    table_text,
)
from taciturn.model.estimate import Estimate
from taciturn.model.result import FIRST, LAST, VERDICT, Columns, Field, Tabular
from taciturn.problem import Problem
from taciturn.problem.without_file import Studied, as_problem
from taciturn.simulation.average import check_effort
from taciturn.study.evaluation import Evaluation
from taciturn.study.record import Store, digest, encode, origin
from taciturn_studies.points import (
    LARGEST,
    Cell,
    Cells,
    Effort,
    Refusal,
    check_confidence,
    check_grid,
    label_of,
    labels_of,
    path_of,
    run_cells,
)

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.figure import Figure

MOST_CURVES = 5  # of a figure
WIDE = 10.0  # ratio of the largest and the smallest value above which the axis of the values is logarithmic
TAKEN = ("drop", "method", "tolerance")  # argument names of the selection methods of labelled arrays


def sweep(
    problem: Studied,
    over: Mapping[str, Sequence[object]],
    *,
    executor: Executor | None = None,
    store: str | Path | None = None,
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    confidence: float | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> xarray.Dataset:
    """Compute the cost and the rates of a problem's policy over a grid of values, with one dimension per varied name.

    The seed of a cell is derived from ``seed`` and the cell's values only, so a cell gives the same result in every
    grid, in every order and on every worker. A cell without a result contains NaN or an empty string; the variable
    ``refusal`` gives the reason, and a warning reports the number of such cells.

    Args:
        problem: the problem in which each cell changes the named keys.
        over: the values of each key: a key of ``[policy]``, or a dotted path; several keys make a grid.
        executor: executor that runs blocks of cells: threads, processes, ``dask.distributed``'s
            ``Client.get_executor()``, ``mpi4py.futures.MPIPoolExecutor``, or any other; default: one cell after the
            other in this process, on all processors.
        store: folder with one file per cell; a second run computes only the cells that are missing or belong to another
            problem or version.
        seed: seed of all random draws, at least 0.
        standard_error: absolute standard error of each cost; default: 1e-4 of the cost.
        steps: number of steps of each simulation, instead of a standard error.
        confidence: confidence of a lower bound on the cost of any scheduling, in cells that have one; default: no lower
            bound.
        time_limit: time limit in seconds; default: none. Without a result in time, an error is raised; the cells that
            are stored remain.
        progress: callback that receives the fraction done.

    Returns:
        A dataset with ``cost``, ``cost_standard_error``, ``rate_LINK``, … over the swept names;
        its attributes contain units, problem, version, seed, methods and machine.

    Raises:
        ProblemError: no values are given, a value is given twice, a key is unknown, the data are inconsistent, the
            store cannot be used, or the executor fails; finished cells stay in the store.

    Example:
        >>> from taciturn import load
        >>> found = sweep(load("double-integrator"), {"kind": ["consistent"], "period": [0.25, 0.5]})
        >>> bool(found.cost.sel(period=0.25) < found.cost.sel(period=0.5))
        True
    """
    with answered_within(time_limit):
        problem = as_problem("problem", problem)
        check_effort(seed, standard_error, steps)
        listed = check_grid(over)
        for name in listed:
            if path_of(name) == ["policy", "seed"]:
                raise ProblemError(
                    "seed is not a key of a problem; expected one sweep for each seed (--seed, seed=), with the same "
                    "store"
                )
            if name in TAKEN:
                raise ProblemError(f"the dimension name {name} is reserved by xarray; expected the name policy.{name}")
        axes = {name: labels_of(name, values) for name, values in listed.items()}
        _check_axes(problem, listed, confidence)
        cells = _Grid(listed, seed)
        label = label_of(problem)
        table = _Table(cells.shape)
        kept = None if store is None else Store(store, label)
        bar = in_notebook(progress)
        for index, answer in run_cells(problem, cells, Effort(standard_error, confidence, steps), executor, kept, bar):
            table.put(index, cells[index].seed, answer)
        table.tell(cells)
        methods = ", ".join(sorted(table.methods))
        told = {name: str(value) for name, value in origin(problem, seed, methods).items()}
        return table.dataset(axes, label | told | {"machine": f"{platform.machine()}, {platform.system()}"})


def _check_axes(problem: Problem, listed: Mapping[str, Sequence[object]], confidence: float | None) -> None:
    """Design the policy at the first and last value of every name, to report mistakes before cells run."""
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
    """The cells of a grid, created on demand, since there may be millions; the last name varies fastest."""

    def __init__(self, listed: dict[str, list[object]], seed: int) -> None:
        """Store the values; no cell is created yet."""
        self.shape = tuple(len(values) for values in listed.values())
        self._listed, self._seed = listed, seed

    def __len__(self) -> int:
        """Return the number of cells."""
        return math.prod(self.shape)

    def __getitem__(self, index: int, /) -> Cell:
        """Return the cell at an index."""
        values: dict[str, object] = {}
        for name, listed in reversed(self._listed.items()):
            index, place = divmod(index, len(listed))
            values[name] = listed[place]
        values = dict(reversed(values.items()))
        return Cell(values, _seed_of(self._seed, values))


def _seed_of(seed: int, values: Mapping[str, object]) -> int:
    """Return the seed of a cell, which ``taciturn evaluate --seed`` accepts."""
    stated = {".".join(path_of(name)): _as_float(value) for name, value in values.items()}
    words = np.frombuffer(bytes.fromhex(digest(encode(stated))), dtype=np.uint32)
    return int(np.random.SeedSequence(seed, spawn_key=tuple(int(word) for word in words[:4])).generate_state(1)[0])


def _as_float(value: object) -> object:
    """Return a value with integers converted to floats and −0 to 0."""
    if isinstance(value, list):
        return [_as_float(one) for one in cast("list[object]", value)]
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) >= LARGEST:
        return value
    return float(value) + 0.0


UNKNOWN = Estimate(float("nan"), float("nan"), "simulation")
COST, SENDS = "cost {of.per}", "sends per {of.rate_unit}"
COLUMNS: tuple[Field[Evaluation], ...] = (
    *(Field(f"cost{part}", f"cost.{part[1:] or 'value'}", unit=COST) for part in ("", "_standard_error", "_error")),
    Field("cost_method", "cost.method"),
    *(Field(name, unit=COST) for name in ("cost_all_time", "cost_bound", "cost_bound_at_rate")),
    Field("cost_every_sample", lambda found: found.cost_every_sample or UNKNOWN, unit=COST),
    Field("excess_percent", lambda found: UNKNOWN if found.excess is None else found.excess.scaled(100.0), unit="%"),
    *(Field(f"linearisation_{name}", f"linearisation.{name}", unit=COST) for name in ("cost_all_time", "cost_bound")),
    Field("cost_periodic_same_rate", unit=COST),
    Field("cost_lower_bound", "lower_bound.cost", unit=COST),
    Field("mean_interval", "mean_interval.value", unit="s"),
    Field("steps"),
    Field("reached"),
    Field("rate_lowest", lambda found: found.rate_bounds and found.rate_bounds[0], unit=SENDS),
    Field("rate_highest", lambda found: found.rate_bounds and found.rate_bounds[1], unit=SENDS),
)
"""Variables of the result, in the order of its file; then those of ``Evaluation.FIELDS`` that have a column."""
MISSING = {"steps": 0, "reached": False}  # what stands for no value; else NaN, or no text


def _columns(found: Evaluation) -> list[Field[Evaluation]]:
    """Return the variables of an answer: those of all answers, the rates of its links, and violations of limits."""
    columns = [*COLUMNS, *(Field(one.column, one.of, unit=one.unit) for one in Evaluation.FIELDS if one.column)]
    columns += [
        Field[Evaluation](f"rate_{link}", lambda one, link=link: one.rates[link], unit=SENDS)
        for link in sorted(found.rates)
    ]
    seen = found.violations
    for name, share in () if seen is None else seen.records().items():
        unit = f"per {seen.window}" if seen is not None and name == "violation_within" else "share of the steps"
        columns.append(Field[Evaluation](name, lambda _, share=share: share, unit=unit))
    return columns


class _Table:
    """The columns of a sweep, filled as answers arrive."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.shape, size = shape, math.prod(shape)
        self.refusals, self.seeds = np.full(size, "", dtype=object), np.zeros(size, dtype=np.int64)
        self.columns: dict[str, np.ndarray[Any, Any]] = {}
        self.units: dict[str, str] = {}
        self.refused: list[int] = []
        self.methods: set[str] = set()

    def put(self, index: int, seed: int, answer: Evaluation | Refusal) -> None:
        """Write the results of a cell into the columns."""
        self.seeds[index] = seed
        if isinstance(answer, Refusal):
            self.refusals[index] = str(answer.error)
            self.refused.append(index)
            return
        self.methods.add(answer.method)
        for column in _columns(answer):
            value, unit = column.of(answer), column.unit.format(of=answer)
            parts = {column.name: value}
            if isinstance(value, Estimate):
                parts = {column.name: value.value, f"{column.name}_standard_error": value.standard_error}
            for name, part in parts.items():
                self._write(index, name, part, unit)

    def _write(self, index: int, name: str, value: Any, unit: str) -> None:
        if value is None:
            return
        if name not in self.columns:
            missing = "" if isinstance(value, str) else MISSING.get(name, math.nan)
            kind = object if isinstance(value, str) else np.asarray(missing).dtype
            self.columns[name] = np.full(len(self.seeds), missing, dtype=kind)
            self.units[name] = unit
        elif self.units[name] != unit:
            raise ProblemError(
                f"the grid mixes results with the units {self.units[name]} and {unit}; expected one unit: use two "
                "sweeps"
            )
        self.columns[name][index] = value

    def tell(self, cells: Cells) -> None:
        """Warn that some cells of the grid have no result."""
        if not self.refused:
            return
        first = min(self.refused)
        where = ", ".join(f"{name}={value}" for name, value in cells[first].values.items())
        missing = f"no answer in {len(self.refused)} of {number_of(len(cells), 'cell')}"
        sentence = f"{missing}, first at {where}: {self.refusals[first]}"
        if len(self.refused) == len(cells):
            raise ProblemError(sentence)
        warnings.warn(sentence, stacklevel=3)

    def dataset(self, axes: Mapping[str, Sequence[Any]], attributes: Mapping[str, Any]) -> xarray.Dataset:
        """Return all results as a data set over the grid; the variables are those of ``COLUMNS``, then the rates."""
        import xarray

        held = self.columns | {"seed": self.seeds, "refusal": self.refusals}
        ordered = dict.fromkeys([*(column.name for column in COLUMNS if column.name in held), *held])
        units = {name: {"units": unit} for name, unit in self.units.items() if unit}
        whole = {name: (tuple(axes), held[name].reshape(self.shape), units.get(name, {})) for name in ordered}
        return xarray.Dataset(whole, coords=dict(axes), attrs=dict(attributes))


class SweepTable(Tabular):
    """The results of a sweep as a table: one row per grid cell, one column per varied name and per result.

    Args:
        result: the labelled arrays that ``sweep`` returned, or that were read from its file.
    """

    FIELDS: ClassVar[tuple[Field[SweepTable], ...]] = (
        VERDICT,
        Field("omitted", key="", say="note"),
        Field("method", key="", say="method", part="method"),
        Field("seed", key="", say="seed", part="method"),
    )

    def __init__(self, result: xarray.Dataset) -> None:
        """Store the result."""
        self.result = result

    def summary(self) -> Mapping[str, object]:
        """Return how many values each name of the grid has."""
        return {str(name): size for name, size in self.result.sizes.items()}

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence about the cells with the least and the largest cost, and the number of cells with a result."""
        return tuple(_verdict(self.result))

    @property
    def method(self) -> str:
        """Methods that gave the costs."""
        methods: list[str] = [str(one) for one in self.result.cost_method.values.ravel() if one]
        return ", ".join(dict.fromkeys(methods))

    @property
    def seed(self) -> str:
        """Seed of the sweep, from which the random seed of each cell is derived."""
        return str(self.result.attrs.get("seed", ""))

    @property
    def omitted(self) -> str:
        """Sentence that says how many grid cells the text leaves out."""
        left = self.result.refusal.size - FIRST - LAST
        return f"without {number_of(left, 'cell')}, which the result and --table contain" if left > 0 else ""

    def table_texts(self) -> Sequence[str]:
        """Return a table of values, cost and rates for the first and the last cells of the grid."""
        found, names = self.result, [str(name) for name in self.result.sizes]
        rates = [
            name for name in map(str, found.data_vars) if name.startswith("rate_") and f"{name}_standard_error" in found
        ]
        per = [f"{found[name].units}{f', {name[5:]}' if len(rates) > 1 else ''}" for name in rates]
        shape, count = found.refusal.shape, found.refusal.size
        shown = [*range(count)] if count <= FIRST + LAST else [*range(FIRST), -1, *range(count - LAST, count)]
        rows = list[list[str]]()
        for index in shown:
            if index < 0:
                rows.append(["…"] * (len(names) + 1 + len(rates)))
                continue
            cell = found.isel(dict(zip(names, (int(i) for i in np.unravel_index(index, shape)), strict=True)))
            sends = ["" if math.isnan(cell[name].item()) else f"{cell[name].item():.4g}" for name in rates]
            rows.append([*(str(cell[name].item()) for name in names), _cost(cell), *sends])
        unit = found.cost.attrs.get("units", "cost")
        return (table_text([*names, unit, *per], rows, len(names)),)

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Plot cost and rates along the longest numerical axis of the grid, one curve per combination of other values.

        Args:
            ax: existing axes to draw in instead of a new figure, one above the other: one for the cost, and one for the
                rate of each link.
            figsize: width and height of a new figure, in inches.
            style: ``"light"``, ``"dark"``, ``"paper"`` or ``"paper-wide"``.

        Raises:
            ProblemError: there are more than ``MOST_CURVES`` other cells.
        """
        return draw(panels_of(self.result), ax, figsize, style)

    def about(self) -> dict[str, object]:
        """Return the attributes of the data set: version, seed, digest of the problem, and units."""
        units = {name: array.attrs["units"] for name, array in self.result.items() if "units" in array.attrs}
        return {**self.result.attrs, "units": "; ".join(f"{name}: {unit}" for name, unit in units.items())}

    def columns(self) -> Columns:
        """Return the columns by name; a value and its standard error are one estimate, and a missing value is None."""
        frame: Any = self.to_pandas()  # pandas' types are incomplete
        found: dict[str, list[Any]] = {
            name: [None if one != one else one for one in frame[name].tolist()] for name in frame
        }
        for name in [name for name in found if f"{name}_standard_error" in found]:
            parts = zip(found[name], found.pop(f"{name}_standard_error"), found["cost_method"], strict=True)
            found[name] = [None if value is None else Estimate(value, error, how) for value, error, how in parts]
        return found

    def to_pandas(self) -> pandas.DataFrame:
        """Convert the results to a pandas data frame; its ``attrs`` are the attributes of the data set.

        Raises:
            ProblemError: pandas is not installed.
        """
        frame = self.result.to_dataframe().reset_index()
        frame.attrs.update(self.result.attrs)
        return frame


def panels_of(found: xarray.Dataset) -> list[Panel]:
    """Return the panels of a sweep's figure: one for the cost and one for the rates."""
    sizes = {str(name): size for name, size in found.sizes.items()}
    numeric = [name for name in sizes if found[name].dtype.kind in "iuf"]
    lead = max(numeric or sizes, key=lambda name: sizes[name])
    others = [name for name in sizes if name != lead]
    count = math.prod(sizes[name] for name in others)
    if count > MOST_CURVES:
        raise ProblemError(
            f"the grid has {count} curves over {lead}; expected at most {MOST_CURVES} in a figure: select some cells "
            "of the result, as SweepTable(result.sel(...))"
        )
    values = [float(one) for one in found[lead].values] if numeric else [float(one) for one in range(sizes[lead])]
    wide = min(values) > 0 and max(values) > WIDE * min(values)
    rates = [str(name) for name in found if str(name).startswith("rate_") and f"{name}_standard_error" in found]
    cells = list(itertools.product(*(range(sizes[other]) for other in others)))
    looks = policy_looks([[found[other].values[k] for other, k in zip(others, cell, strict=True)] for cell in cells])
    panels = list[Panel]()
    for name in ("cost", *rates):
        series = [_curve(found, cell, name, lead, values, look) for cell, look in zip(cells, looks, strict=True)]
        unit = str(found[name].attrs.get("units", name))
        label = unit if name == "cost" or len(rates) == 1 else f"{name.removeprefix('rate_')}: {unit}"
        panels.append(
            Panel(
                series if name == "cost" else [replace(one, label="") for one in series],
                "",
                label,
                "" if panels else symbol(next(_verdict(found)).partition("; largest")[0]),
                xlog=wide,
                height=HEIGHT * (1.0 if name == "cost" else 0.5),
            )
        )
    return [*panels[:-1], replace(panels[-1], xlabel=symbol(lead))]


def _curve(
    found: xarray.Dataset, cell: tuple[int, ...], name: str, lead: str, values: Sequence[float], look: Thing | int
) -> Series:
    """Return the curve of one cell of the other axes; cells without an answer are left out."""
    others = [str(other) for other in found.sizes if other != lead]
    one = found.isel(dict(zip(others, cell, strict=True)))
    y, error = one[name].values.tolist(), one[f"{name}_standard_error"].values.tolist()
    kept = [k for k, value in enumerate(y) if value == value]
    words = [f"{symbol(other)} = {one[other].item()}" for other in others]
    return Series(
        [values[k] for k in kept], [y[k] for k in kept], ", ".join(words) or name, error=[error[k] for k in kept],
        thing=look,
    )  # fmt: skip


def _verdict(found: xarray.Dataset) -> Iterator[str]:
    """Yield where the cost is least and largest, and how many cells have an answer."""
    grid = " × ".join(f"{name} ({size})" for name, size in found.sizes.items())
    refused = int((found.refusal != "").sum())
    ends = () if refused == found.refusal.size else (found.cost.argmin, found.cost.argmax)
    cells = [found.isel(find(...)) for find in ends]
    told = [
        f"{word} cost {_cost(cell)} at {', '.join(f'{key} = {cell[key].item()}' for key in found.sizes)}"
        for word, cell in zip(("least", "largest"), cells, strict=False)
    ]
    yield "; ".join(told) or "no cost, since every cell was refused"
    size = found.refusal.size
    yield f"{number_of(size, 'cell')} over {grid}: {size - refused} evaluated, {refused} refused"


def _cost(cell: Any) -> str:
    """Return the cost of a cell, or that it was refused."""
    if cell.refusal.item():
        return "refused"
    return str(
        Estimate(cell.cost.item(), cell.cost_standard_error.item(), cell.cost_method.item(), cell.cost_error.item())
    )
