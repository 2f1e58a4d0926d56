"""Commands that answer for many problems: grids, comparisons, the thesis."""

from __future__ import annotations

import math
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from taciturn import _print
from taciturn.cli.frame import (
    Confidence,
    File,
    GivenSeed,
    Json,
    Link,
    Plot,
    Seed,
    StandardError,
    Steps,
    app,
    check_effort,
    note_seed,
    print_json,
    progress_bar,
    refuse,
)
from taciturn.cli.words import complete_file, complete_from

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure


Over = Annotated[
    list[str], typer.Option(metavar="NAME=v1,v2,…", help="A key of [policy], or dotted; repeat for a grid.")
]
Workers = Annotated[int, typer.Option(min=1, help="Processes; 1: the threads of this one.")]


@app.command(epilog="Example: taciturn tradeoff two-mass --over theta=0.1,1,10 --plot two-mass.svg")
def tradeoff(
    file: File,
    over: Over,
    as_json: Json = False,
    plot: Plot = None,
    seed: GivenSeed = None,
    standard_error: StandardError = None,
    confidence: Confidence = None,
    store: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Keeps every point, so that a second run goes on.")
    ] = None,
    workers: Workers = 1,
) -> None:
    """Cost against rate over a parameter, beside fair clocks and the guarantee."""
    import taciturn
    from taciturn._figure import check_format, save
    from taciturn._grid import parse_grid
    from taciturn.study.lower import choose_confidence
    from taciturn.study.workers import processes

    check_effort(standard_error)
    values = parse_grid(over)
    if plot is not None:
        check_format(plot)
    problem = taciturn.load(file)
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
        print_json(found.document())
    else:
        _print.tradeoff(found)
        note_seed(seed, any(point.evaluation.drawn for point in found.points))
    if plot is not None:  # after the numbers, which a picture that cannot be written must not take away
        save(found.plot(), plot)
        if not as_json:
            typer.echo(f"picture: {plot}")
    missed = [point for point in found.points if not point.evaluation.reached]
    if missed:
        values_text = ", ".join(f"{k}={v}" for k, v in missed[0].values.items())
        refuse(
            f"the standard error was not reached at {len(missed)} of {len(found.points)} points, "
            f"first at {values_text}: ask for a larger --standard-error"
        )


@contextmanager
def told_of(store: Path) -> Generator[None]:
    """Tell whoever presses Ctrl-C that what is computed is kept."""
    try:
        yield
    except KeyboardInterrupt:
        print(f"taciturn: interrupted; what is computed is kept in {store}: the same command goes on", file=sys.stderr)
        raise


@app.command(epilog="Example: taciturn sweep two-mass --over theta=0.1,1,10 --over actuation=hold,model --store cells")
def sweep(
    file: File,
    over: Over,
    store: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Keeps every cell, so that a second run goes on; ends in result.nc, another one kept beside it.",
        ),
    ],
    workers: Annotated[int | None, typer.Option(min=1, help="Processes. Default: one for each processor.")] = None,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Of a dask scheduler whose workers are used instead.")
    ] = None,
    table: Annotated[
        Path | None, typer.Option(metavar="OUT", help="The result as a table as well: .csv or .parquet.")
    ] = None,
    seed: GivenSeed = None,
    standard_error: StandardError = None,
    steps: Steps = None,
    confidence: Annotated[float | None, typer.Option(help="Of lower bounds. Default: none is sought.")] = None,
) -> None:
    """A grid of evaluations on many processors, kept cell by cell."""
    import taciturn
    from taciturn._dask import dask_workers
    from taciturn._grid import parse_grid
    from taciturn._table import check_table, save_table
    from taciturn.study.sweep import save_whole, table_of
    from taciturn.study.workers import processes

    check_effort(standard_error, steps)
    if dask is not None and workers is not None:
        raise taciturn.ProblemError("--workers and --dask are both given; expected one: a scheduler has its own")
    if table is not None:
        check_table(table)
    values, problem = parse_grid(over), taciturn.load(file)
    pool = processes(workers) if dask is None else dask_workers(dask)
    cells = math.prod(map(len, values.values()))
    with told_of(store), progress_bar("sweeping", cells) as progress, pool as executor:
        found = taciturn.sweep(
            problem,
            values,
            executor=executor,
            store=store,
            seed=seed or 0,
            standard_error=standard_error,
            steps=steps,
            confidence=confidence,
            progress=progress,
        )
    note_seed(seed, confidence is not None or bool((found.cost_method == "simulation").any()))
    result = store / "result.nc"
    aside = save_whole(found, result)
    if aside is not None:
        print(f"taciturn: {result} held another result, which is kept as {aside.name}", file=sys.stderr)
    _print.sweep(found, result)
    if table is not None:
        save_table(table_of(found), table)
        typer.echo(f"table: {table}")
    missed = ~found.reached & (found.refusal == "")
    if missed.any():
        refuse(_missed(found, missed.values, steps))
    if (found.refusal != "").any():
        raise typer.Exit(2)  # which cells and why has been told


def _missed(found: xarray.Dataset, missed: Any, steps: int | None) -> str:
    """Return the sentence about cells whose simulation ended before it had settled, or before it was precise."""
    from taciturn.simulation.sampling import BUDGET

    cells = [found.isel(dict(zip(found.sizes, place, strict=True))) for place in zip(*missed.nonzero(), strict=True)]
    shown = [
        ", ".join(f"{name}={cell[name].item()}" for name in found.sizes)
        + f" (standard error {cell.cost_standard_error.item():.2g})"
        for cell in cells[:3]
    ]
    listed = "; ".join([*shown, f"and {len(cells) - 3} more"] if len(cells) > 3 else shown)
    count = f"{len(cells)} of {missed.size} cells"
    if steps is not None:
        return f"the loop has not settled in {count} within {steps} steps: {listed}: ask for more --steps"
    return (
        f"the standard error was not reached in {count} within {BUDGET / 1e9:g} billion steps each: {listed}: "
        "ask for a larger --standard-error"
    )


@app.command(epilog="Example: taciturn compare two-mass mine.toml --rate 0.3")
def compare(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE FILE…", help="Problems that differ in their policies.", autocompletion=complete_file
        ),
    ],
    rate: Annotated[float, typer.Option(help="Sends per step or per second, the same for all.")],
    link: Link = None,
    as_json: Json = False,
    plot: Plot = None,
    seed: GivenSeed = None,
    standard_error: Annotated[float | None, typer.Option(help="Of each cost. Default: 3e-4 of all-time's.")] = None,
) -> None:
    """Several policies at the same rate, ranked, with the standard errors of their differences."""
    import taciturn
    from taciturn._figure import check_format, save

    check_effort(standard_error)
    if plot is not None:
        check_format(plot)
    problems = {name: taciturn.load(file) for name, file in zip(_names(files), files, strict=True)}
    with progress_bar("comparing") as progress:
        found = taciturn.compare(
            problems, rate, link=cast("Any", link), seed=seed or 0, standard_error=standard_error, progress=progress
        )
    if as_json:
        print_json(found.document())
    else:
        _print.comparison(found)
        note_seed(seed, any(one.tuned.evaluation.drawn for one in found.ranking))
    if plot is not None:
        save(found.plot(), plot)
        if not as_json:
            typer.echo(f"picture: {plot}")
    missed = [one.name for one in found.ranking if not one.reached]
    if missed:
        refuse(f"rate or standard error were not reached by {', '.join(missed)}: ask for a larger --standard-error")


@app.command(epilog="Example: taciturn channel two-mass --copies 100 --capacity 10")
def channel(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE…", help="Problems: the loops that share the channel.", autocompletion=complete_file
        ),
    ],
    copies: Annotated[str, typer.Option(metavar="M[,M…]", help="Loops of each problem: one number, or one for each.")],
    capacity: Annotated[int, typer.Option(help="Sends per tick at most, from 1 to the number of loops.")],
    scheduler: Annotated[
        str,
        typer.Option(
            help="price, largest, round-robin, tdma, once-discard or random-access.",
            autocompletion=complete_from("price", "largest", "round-robin", "tdma", "once-discard", "random-access"),
        ),
    ] = "price",
    as_json: Json = False,
    plot: Plot = None,
    seed: Seed = 0,
    standard_error: Annotated[float | None, typer.Option(help="Of the sum of costs. Default: 1e-3 of it.")] = None,
    ticks: Annotated[int | None, typer.Option(help="Measure so many ticks of each channel instead.")] = None,
    confidence: Confidence = None,
    workers: Workers = 1,
) -> None:
    """Many loops on one channel: the sum of their costs, beside what none can beat and the best periodic allocation."""
    import taciturn
    from taciturn._figure import check_format, save
    from taciturn.analyse.limits import USUAL
    from taciturn.study.workers import processes

    check_effort(standard_error)
    if plot is not None:
        check_format(plot)
    problems = {name: taciturn.load(file) for name, file in zip(_names(files), files, strict=True)}
    with progress_bar("sharing") as progress, processes(workers) as executor:
        found = taciturn.share_channel(
            problems,
            copies=_numbers("--copies", copies),
            capacity=capacity,
            scheduler=cast("Any", scheduler),
            seed=seed,
            standard_error=standard_error,
            ticks=ticks,
            confidence=USUAL if confidence is None else confidence,
            executor=executor,
            progress=progress,
        )
    if as_json:
        print_json(found.document())
    else:
        _print.sharing(found)
    if plot is not None:
        save(found.plot(), plot)
        if not as_json:
            typer.echo(f"picture: {plot}")
    if not found.reached:
        refuse("the standard error was not reached: ask for a larger --standard-error")


def _names(files: list[str]) -> list[str]:
    """Return what problems are called: their files' names, numbered where they are alike."""
    stems = [Path(file).stem for file in files]
    return [stem if stems.count(stem) == 1 else f"{stem} ({i + 1})" for i, stem in enumerate(stems)]


def _numbers(option: str, text: str) -> list[int]:
    """Return the whole numbers of a list that is separated by commas."""
    from taciturn.errors import ProblemError

    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ProblemError(f"{option} is {text!r}; expected whole numbers, as 1000 or 500,20") from None


@app.command(epilog="Example: taciturn reproduce chapter2 --out pictures")
def reproduce(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME…]",
            help="chapter2 to chapter7, or all (the default).",
            autocompletion=complete_from("all", *(f"chapter{i}" for i in range(2, 8))),
        ),
    ] = None,
    as_json: Json = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the pictures. Default: here.")] = None,
    seed: Seed = 0,
    twin: Annotated[bool, typer.Option("--twin", help="The experiments of chapters 6 and 7, with twins.")] = False,
) -> None:
    """The thesis's tables and figures, printed beside computed.

    With other parameters: taciturn tradeoff FILE --over NAME=v1,v2,…
    """
    from taciturn._figure import save
    from taciturn.errors import ProblemError
    from taciturn.study.reproduce import CHAPTERS, no_chapter
    from taciturn.study.reproduce import reproduce as compute

    known, make = list(CHAPTERS), compute
    if twin:
        from taciturn.twin.reproduction import EXPERIMENTS, reproduce_with_twin

        known, make = list(EXPERIMENTS), reproduce_with_twin
    chosen = known if not names or "all" in names else names
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise no_chapter(unknown[0], known)
    folder = out or Path()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ProblemError(
            f"the folder {str(folder)!r} cannot be made ({error.strerror}); expected one that can be written to"
        ) from None
    documents: list[dict[str, Any]] = []
    pictures: dict[Path, Figure] = {}
    for name in chosen:
        with progress_bar(name) as progress:
            found = make(name, seed=seed, progress=progress)
        documents.append(found.document())
        pictures |= {folder / f"{file}.svg": picture for file, picture in found.pictures.items()}
        if not as_json:
            _print.reproduction(found)
    if as_json:
        print_json(documents)
    for path, picture in pictures.items():  # after the numbers, which must not be lost with a picture
        if out is not None or not as_json:
            save(picture, path)
            if not as_json:
                typer.echo(f"picture: {path}")
