"""The command ``taciturn channel``."""

from __future__ import annotations

from typing import Annotated, Any, cast

import typer

from taciturn.cli.frame import (
    EXAMPLE,
    Confidence,
    Json,
    NoFunctions,
    PictureStyle,
    Plot,
    Seed,
    Settings,
    TimeLimit,
    Verbose,
    Workers,
    app,
    complete_file,
    complete_from,
    load_all,
    print_result,
    progress_bar,
    refuse,
    save_picture,
)


@app.command(epilog=EXAMPLE + "taciturn channel two-mass --copies 100 --capacity 10")
def channel(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE…", help="Problem files of the loops that share the channel.", autocompletion=complete_file
        ),
    ],
    copies: Annotated[
        str,
        typer.Option(
            metavar="M[,M…]",
            help="Number of loops of each problem: one number per file, or one number for all files.",
        ),
    ],
    capacity: Annotated[
        int, typer.Option(help="Largest number of packets per step on the channel, from 1 to the number of loops.")
    ],
    scheduler: Annotated[
        str,
        typer.Option(
            help="Scheduler of the channel: price, largest, round-robin, tdma, once-discard or random-access.",
            autocompletion=complete_from("price", "largest", "round-robin", "tdma", "once-discard", "random-access"),
        ),
    ] = "price",
    settings: Settings = None,
    no_functions: NoFunctions = False,
    as_json: Json = False,
    verbose: Verbose = False,
    plot: Plot = None,
    style: PictureStyle = None,
    seed: Seed = 0,
    standard_error: Annotated[
        float | None, typer.Option(help="Requested standard error of the total cost. Default: 1e-3 of the total cost.")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help="Number of steps of each simulated channel, in place of --standard-error.")
    ] = None,
    confidence: Confidence = None,
    workers: Workers = 1,
    time: TimeLimit = None,
) -> None:
    """Simulate many loops that share one channel: total cost, lower bound, and the best periodic allocation."""
    import taciturn
    from taciturn.extend import answered_within
    from taciturn.model.theory import LEVEL
    from taciturn_studies.workers import processes

    with answered_within(time):
        problems = load_all(files, settings, no_functions)
        with progress_bar("sharing") as progress, processes(workers) as executor:
            found = taciturn.share_channel(
                problems,
                copies=numbers_of("--copies", copies),
                capacity=capacity,
                scheduler=cast("Any", scheduler),
                seed=seed,
                standard_error=standard_error,
                steps=steps,
                confidence=LEVEL if confidence is None else confidence,
                executor=executor,
                progress=progress,
            )
    print_result(found, as_json, verbose, problems, seed)
    save_picture(found, plot, style, as_json, problems, seed, found.method)
    if not found.reached:
        refuse("the standard error was not reached; give a larger --standard-error")


def numbers_of(option: str, text: str) -> list[int]:
    """Convert a comma-separated text to a list of integers."""
    from taciturn.cli.usage import whole_number
    from taciturn.errors import ProblemError

    try:
        return [int(whole_number(part)) for part in text.split(",")]
    except ValueError:
        raise ProblemError(f"{option} is {text!r}; expected integers, such as 1000 or 500,20") from None
