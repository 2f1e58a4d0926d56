"""Commands for several problems: grids, comparisons, and the results of the thesis."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from taciturn._ending import remark
from taciturn.cli.frame import (
    EXAMPLE,
    Confidence,
    File,
    GivenSeed,
    Json,
    Link,
    NoFunctions,
    Plot,
    Seed,
    Settings,
    StandardError,
    Steps,
    TimeLimit,
    app,
    load_changed,
    note_seed,
    print_json,
    progress_bar,
    refuse,
)
from taciturn.cli.words import complete_file, complete_from

if TYPE_CHECKING:
    import xarray

    from taciturn.problem import Problem


OVER = "Key to vary: a key of [policy], or a dotted path such as plant.dt. Repeat the option for a grid."
Over = Annotated[list[str], typer.Option(metavar="NAME=v1,v2,…", help=OVER)]
Workers = Annotated[int, typer.Option(min=1, help="Number of processes. Default: 1 (this process).")]


@app.command(epilog=EXAMPLE + "taciturn tradeoff two-mass --over theta=0.1,1,10 --plot costs.svg")
def tradeoff(
    file: File,
    over: Over,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    as_json: Json = False,
    plot: Plot = None,
    seed: GivenSeed = None,
    standard_error: StandardError = None,
    confidence: Confidence = None,
    store: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the results, so that an interrupted run can continue."),
    ] = None,
    workers: Workers = 1,
    time: TimeLimit = None,
) -> None:
    """Compute cost and rate for several values of a parameter, with periodic control and the guarantee."""
    import taciturn
    from taciturn._figure import check_format, save
    from taciturn._grid import parse_grid
    from taciturn._progress import answered_within
    from taciturn.study.lower import choose_confidence
    from taciturn.study.record import origin
    from taciturn.study.sweeping.workers import processes

    values = parse_grid(over)
    if plot is not None:
        check_format(plot)
    with answered_within(time):
        problem = load_changed(file, settings, no_functions)
        with progress_bar("computing") as progress, processes(workers) as executor:
            found = taciturn.tradeoff(
                problem,
                values,
                seed=seed or 0,
                standard_error=standard_error,
                confidence=choose_confidence(problem, confidence),
                executor=executor,
                store=store,
                progress=progress,
            )
    if as_json:
        print_json(found.document(), origin(problem, seed or 0))
    else:
        typer.echo(found)
        note_seed(seed, any(point.evaluation.drawn for point in found.points))
    if plot is not None:  # after the numbers, which must be printed even if the figure cannot be written
        save(found.plot(), plot, origin(problem, seed or 0, found.method))
        if not as_json:
            typer.echo(f"picture: {plot}")
    missed = [point for point in found.points if not point.evaluation.reached]
    if missed:
        values_text = ", ".join(f"{k}={v}" for k, v in missed[0].values.items())
        refuse(
            f"the standard error was not reached at {len(missed)} of {len(found.points)} points, "
            f"first at {values_text}; give a larger --standard-error"
        )


@app.command(epilog=EXAMPLE + "taciturn sweep two-mass --over theta=0.1,1,10 --store cells --workers 2")
def sweep(
    file: File,
    over: Over,
    store: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder for the results, so that an interrupted run can continue. DIR/result.nc contains all results.",
        ),
    ],
    settings: Settings = None,
    no_functions: NoFunctions = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Number of processes. Default: one per processor.")] = None,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Use the workers of the dask scheduler at this address."),
    ] = None,
    table: Annotated[
        Path | None, typer.Option(metavar="OUT", help="Also write the result as a table: .csv or .parquet.")
    ] = None,
    seed: GivenSeed = None,
    standard_error: StandardError = None,
    steps: Steps = None,
    confidence: Annotated[
        float | None, typer.Option(help="Confidence level of lower bounds on the cost. Default: no lower bounds.")
    ] = None,
    time: TimeLimit = None,
) -> None:
    """Evaluate a grid of problems on many processors, and store each result when it is finished."""
    import taciturn
    from taciturn._dask import dask_workers
    from taciturn._grid import parse_grid
    from taciturn._progress import answered_within
    from taciturn._table import check_table, save_table
    from taciturn.study.sweeping.store import save_whole
    from taciturn.study.sweeping.table import SweepTable
    from taciturn.study.sweeping.workers import processes

    if dask is not None and workers is not None:
        raise taciturn.ProblemError(
            "--workers and --dask are both given; expected one of them: a dask scheduler has its own workers"
        )
    if table is not None:
        check_table(table)
    values, problem = parse_grid(over), load_changed(file, settings, no_functions)
    pool = processes(workers) if dask is None else dask_workers(dask)
    cells = math.prod(map(len, values.values()))
    kept = f"the results so far are in {store}; run the same command to continue"
    with answered_within(time), remark(kept), progress_bar("sweeping", cells) as progress, pool as executor:
        found = taciturn.sweep(
            problem,
            values,
            executor=executor,
            store=store,
            seed=seed or 0,
            standard_error=standard_error,
            steps=steps,
            confidence=confidence or None,
            progress=progress,
        )
    note_seed(seed, bool(confidence) or bool((found.cost_method == "simulation").any()))
    result = store / "result.nc"
    written, note = save_whole(found, result)
    if note:
        print(f"taciturn: {note}", file=sys.stderr)
    cells = SweepTable(found)
    typer.echo(cells)
    if written:
        typer.echo(f"result: {result}")
    if table is not None:
        save_table(cells.to_pandas(), table)
        typer.echo(f"table: {table}")
    missed = ~found.reached & (found.refusal == "")
    if missed.any():
        refuse(_missed(found, missed.values, steps))
    if (found.refusal != "").any():
        raise typer.Exit(2)  # a warning has listed the cells and the reasons


def _missed(found: xarray.Dataset, missed: Any, steps: int | None) -> str:
    """Return the error message for cells whose simulation ended before it settled or reached its standard error."""
    from taciturn.simulation.sampling import MOST_OPERATIONS

    cells = [found.isel(dict(zip(found.sizes, place, strict=True))) for place in zip(*missed.nonzero(), strict=True)]
    shown = [
        ", ".join(f"{name}={cell[name].item()}" for name in found.sizes)
        + f" (standard error {cell.cost_standard_error.item():.2g})"
        for cell in cells[:3]
    ]
    listed = "; ".join([*shown, f"and {len(cells) - 3} more"] if len(cells) > 3 else shown)
    count = f"{len(cells)} of {missed.size} cells"
    if steps is not None:
        return f"the loop has not settled in {count} within {steps} steps: {listed}; give more --steps"
    return (
        f"the standard error was not reached in {count} within {MOST_OPERATIONS / 1e9:g} billion steps each: {listed}; "
        "give a larger --standard-error"
    )


@app.command(epilog=EXAMPLE + "taciturn compare two-mass two-mass-lqg --rate 0.3")
def compare(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE FILE…", help="Problem files that differ in their policies.", autocompletion=complete_file
        ),
    ],
    rate: Annotated[float | None, typer.Option(help="Common rate: sends per step or per second.")] = None,
    traffic: Annotated[
        float | None,
        typer.Option(help="Instead, the common sum of all rates, each times the price of a packet on its link."),
    ] = None,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    link: Link = None,
    as_json: Json = False,
    plot: Plot = None,
    seed: GivenSeed = None,
    standard_error: Annotated[
        float | None, typer.Option(help="Standard error of each cost. Default: 3e-4 of the cost of periodic LQG.")
    ] = None,
    time: TimeLimit = None,
) -> None:
    """Rank several policies at the same rate, with the standard errors of their differences."""
    import taciturn
    from taciturn._figure import check_format, save
    from taciturn._progress import answered_within
    from taciturn.study.record import origin

    if plot is not None:
        check_format(plot)
    with answered_within(time):
        problems = _load_all(files, settings, no_functions)
        with progress_bar("comparing") as progress:
            found = taciturn.compare(
                problems, rate, traffic=traffic, link=cast("Any", link), seed=seed or 0, standard_error=standard_error,
                progress=progress,
            )  # fmt: skip
    if as_json:
        print_json(found.document(), origin(problems, seed or 0))
    else:
        typer.echo(found)
        note_seed(seed, any(one.tuned.evaluation.drawn for one in found.ranking))
    if plot is not None:
        save(found.plot(), plot, origin(problems, seed or 0, found.method))
        if not as_json:
            typer.echo(f"picture: {plot}")
    missed = [one.name for one in found.ranking if not one.reached]
    if missed:
        refuse(f"rate or standard error were not reached by {', '.join(missed)}; give a larger --standard-error")


@app.command(epilog=EXAMPLE + "taciturn channel two-mass --copies 100 --capacity 10")
def channel(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE…", help="Problem files of the loops that share the channel.", autocompletion=complete_file
        ),
    ],
    copies: Annotated[
        str, typer.Option(metavar="M[,M…]", help="Number of loops of each problem, or one number for all.")
    ],
    capacity: Annotated[int, typer.Option(help="Largest number of sends per step, from 1 to the number of loops.")],
    scheduler: Annotated[
        str,
        typer.Option(
            help="Scheduler: price, largest, round-robin, tdma, once-discard or random-access.",
            autocompletion=complete_from("price", "largest", "round-robin", "tdma", "once-discard", "random-access"),
        ),
    ] = "price",
    settings: Settings = None,
    no_functions: NoFunctions = False,
    as_json: Json = False,
    plot: Plot = None,
    seed: Seed = 0,
    standard_error: Annotated[
        float | None, typer.Option(help="Standard error of the total cost. Default: 1e-3 of the total cost.")
    ] = None,
    ticks: Annotated[int | None, typer.Option(help="Fixed number of simulated steps per channel.")] = None,
    confidence: Confidence = None,
    workers: Workers = 1,
    time: TimeLimit = None,
) -> None:
    """Simulate many loops on one channel: total cost, lower bound, and the best periodic allocation."""
    import taciturn
    from taciturn._figure import check_format, save
    from taciturn._progress import answered_within
    from taciturn.analyse.limits import LEVEL
    from taciturn.study.record import origin
    from taciturn.study.sweeping.workers import processes

    if plot is not None:
        check_format(plot)
    with answered_within(time):
        problems = _load_all(files, settings, no_functions)
        with progress_bar("sharing") as progress, processes(workers) as executor:
            found = taciturn.share_channel(
                problems,
                copies=_numbers("--copies", copies),
                capacity=capacity,
                scheduler=cast("Any", scheduler),
                seed=seed,
                standard_error=standard_error,
                ticks=ticks,
                confidence=LEVEL if confidence is None else confidence,
                executor=executor,
                progress=progress,
            )
    if as_json:
        print_json(found.document(), origin(problems, seed))
    else:
        typer.echo(found)
    if plot is not None:
        save(found.plot(), plot, origin(problems, seed, found.method))
        if not as_json:
            typer.echo(f"picture: {plot}")
    if not found.reached:
        refuse("the standard error was not reached; give a larger --standard-error")


def _load_all(files: list[str], settings: list[str] | None, no_functions: bool) -> dict[str, Problem]:
    """Return the problems by name."""
    return dict(zip(_names(files), [load_changed(file, settings, no_functions) for file in files], strict=True))


def _names(files: list[str]) -> list[str]:
    """Return the names of problems: their file names, with numbers if some names are equal."""
    stems = [Path(file).stem for file in files]
    return [stem if stems.count(stem) == 1 else f"{stem} ({i + 1})" for i, stem in enumerate(stems)]


def _numbers(option: str, text: str) -> list[int]:
    """Return the integers of a comma-separated list."""
    from taciturn.errors import ProblemError

    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ProblemError(f"{option} is {text!r}; expected integers, such as 1000 or 500,20") from None
