"""The command ``taciturn sweep``."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from taciturn.cli.frame import (
    EXAMPLE,
    File,
    GivenSeed,
    NoFunctions,
    Over,
    PictureStyle,
    Plot,
    Settings,
    StandardError,
    Steps,
    TimeLimit,
    Verbose,
    app,
    load_changed,
    note_seed,
    progress_bar,
    refuse,
    save_picture,
)

if TYPE_CHECKING:
    import xarray


@app.command(epilog=EXAMPLE + "taciturn sweep two-mass --over theta=0.1,1,10 --store cells --workers 2")
def sweep(
    file: File,
    over: Over,
    store: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder in which results are stored, so that an interrupted run can continue. DIR/result.nc "
            "contains all results.",
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
    verbose: Verbose = False,
    plot: Plot = None,
    style: PictureStyle = None,
    seed: GivenSeed = None,
    standard_error: StandardError = None,
    steps: Steps = None,
    confidence: Annotated[
        float | None, typer.Option(help="Confidence level of lower bounds on the cost. Default: no lower bounds.")
    ] = None,
    time: TimeLimit = None,
) -> None:
    """Evaluate a problem on a grid of parameter values with many processors, and store each finished result."""
    import taciturn
    from taciturn.extend import answered_within, remark
    from taciturn.model.result import check_table, save_table
    from taciturn.problem.settings import parse_grid
    from taciturn.study.record import save_whole
    from taciturn_studies.workers import processes
    from taciturn_sweep.cluster import dask_workers
    from taciturn_sweep.sweep import SweepTable

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
    typer.echo(cells.text(verbose))
    if written:
        typer.echo(f"result: {result}")
    if table is not None:
        save_table(cells.to_pandas(), table)
        typer.echo(f"table: {table}")
    save_picture(cells, plot, style, False, problem, seed or 0)
    missed = ~found.reached & (found.refusal == "")
    if missed.any():
        refuse(_missed(found, missed.values, steps))
    if (found.refusal != "").any():
        raise typer.Exit(2)  # a warning has listed the cells and the reasons


def _missed(found: xarray.Dataset, missed: Any, steps: int | None) -> str:
    """Return the error message for cells whose simulation ended before it settled or reached its standard error."""
    from taciturn.extend import number_of
    from taciturn.simulation.sampling import MOST_OPERATIONS

    cells = [found.isel(dict(zip(found.sizes, place, strict=True))) for place in zip(*missed.nonzero(), strict=True)]
    shown = [
        ", ".join(f"{name}={cell[name].item()}" for name in found.sizes)
        + f" (standard error {cell.cost_standard_error.item():.2g})"
        for cell in cells[:3]
    ]
    listed = "; ".join([*shown, f"and {len(cells) - 3} more"] if len(cells) > 3 else shown)
    count = f"{len(cells)} of {number_of(missed.size, 'cell')}"
    if steps is not None:
        return f"the loop has not settled in {count} within {steps} steps: {listed}; give more --steps"
    return (
        f"the standard error was not reached in {count} within {MOST_OPERATIONS / 1e9:g} billion steps each: {listed}; "
        "give a larger --standard-error"
    )
