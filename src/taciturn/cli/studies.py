"""Commands for several problems: grids, comparisons, and the results of the thesis."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, cast

import typer

from taciturn.cli.frame import (
    EXAMPLE,
    Confidence,
    File,
    GivenSeed,
    Json,
    Link,
    NoFunctions,
    Over,
    Plot,
    Settings,
    StandardError,
    TimeLimit,
    Workers,
    app,
    complete_file,
    load_all,
    load_changed,
    print_result,
    progress_bar,
    refuse,
    save_picture,
)


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
    from taciturn._progress import answered_within
    from taciturn.problem.settings import parse_grid
    from taciturn.study.evaluate import choose_confidence
    from taciturn.study.workers import processes

    values = parse_grid(over)
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
    drawn = any(point.evaluation.drawn for point in found.points)
    print_result(found, as_json, problem, seed or 0, unused=None if drawn else seed)
    save_picture(found, plot, as_json, problem, seed or 0, found.method)
    missed = [point for point in found.points if not point.evaluation.reached]
    if missed:
        values_text = ", ".join(f"{k}={v}" for k, v in missed[0].values.items())
        refuse(
            f"the standard error was not reached at {len(missed)} of {len(found.points)} points, "
            f"first at {values_text}; give a larger --standard-error"
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
    from taciturn._progress import answered_within

    with answered_within(time):
        problems = load_all(files, settings, no_functions)
        with progress_bar("comparing") as progress:
            found = taciturn.compare(
                problems, rate, traffic=traffic, link=cast("Any", link), seed=seed or 0, standard_error=standard_error,
                progress=progress,
            )  # fmt: skip
    drawn = any(one.tuned.evaluation.drawn for one in found.ranking)
    print_result(found, as_json, problems, seed or 0, unused=None if drawn else seed)
    save_picture(found, plot, as_json, problems, seed or 0, found.method)
    missed = [one.name for one in found.ranking if not one.reached]
    if missed:
        refuse(f"rate or standard error were not reached by {', '.join(missed)}; give a larger --standard-error")
